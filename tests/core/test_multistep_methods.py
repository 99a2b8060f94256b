"""Multistep methods through integrate and solve_ivp: orders, values between steps, and refused arguments."""

import numba
import numpy as np
import pytest
from closed_forms import kepler_state
from scipy.integrate import solve_ivp
from systems import JIT_H, JIT_L, orbit, pericentre

from eip_scipy import EIPGJ12, EIPGJ14, EIPRKN8, EIPRKN12, Invariant, eip_method, ensemble, integrate
from eip_scipy.methods import GaussJackson
from eip_scipy.problems import solar_data, solar_system

both = pytest.mark.parametrize("method", [EIPGJ12, EIPGJ14])
Y0 = pericentre(0.2)
STEP = 2 * np.pi / 256


@numba.njit
def acceleration(t, q):
    return -q / (q[0] ** 2 + q[1] ** 2) ** 1.5


@numba.njit
def jacobian(t, q, dq, out):
    square = q[0] ** 2 + q[1] ** 2
    along = 3 * (q[0] * dq[0] + q[1] * dq[1]) / square
    for k in range(2):
        out[k] = (along * q[k] - dq[k]) / square**1.5


INVARIANTS = (JIT_H, JIT_L)
KEPT = {"invariants": INVARIANTS, "blocks": 2}


def exact(times, y0=Y0):
    """Return states of Kepler's problem from this start."""
    return np.array([kepler_state(y0, t) for t in np.atleast_1d(times)]).T


def run(end, y0=Y0, **options):
    """Integrate the orbit by its acceleration, with its Jacobian and by default in steps of 1/256 of its period."""
    options = {"acceleration": acceleration, "jacobian": jacobian, "h": STEP} | options
    return integrate(t_span=(0, end), y0=y0, **options)


# Numbers of steps in a revolution for each order.
COUNTS = {8: (160, 200), 9: (160, 200), 10: (140, 180), 11: (80, 100), 12: (80, 100), 13: (100, 130), 14: (100, 140)}


@pytest.mark.parametrize("order", COUNTS)
def test_order(order):
    """The error after ten revolutions falls with the order, in steps that truncation decides."""
    method, end, counts = eip_method(GaussJackson(order=order, corrected=True)), 20 * np.pi, COUNTS[order]
    ends = [run(end, method=method, h=2 * np.pi / n, compiled=False).y[:, -1] for n in counts]
    errors = [np.abs(found - exact(end)[:, 0]).max() for found in ends]
    assert errors[1] > 1e-13
    assert order - 1 < np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0]) < order + 4


@both
@pytest.mark.needs_jit
def test_a_long_run_keeps_its_invariants_and_its_orbit(method):
    """A hundred revolutions, both errors near round-off; without invariants the truncation of long steps adds up."""
    found = run(200 * np.pi, method=method, save_every=999, **KEPT)
    assert found.trusted
    assert found.compiled
    assert found.calls.get("jacobian") == ("jitted" if method is EIPGJ14 else None)
    assert np.all(found.max_residual < 1e-15)
    assert np.abs(found.y - exact(found.t)).max() < 2e-11
    assert found.nfev < 256 * 100 + 600
    assert found.diagnostics.n_projections + found.diagnostics.n_skipped > 100
    h, end = 2 * np.pi / (190 if method is EIPGJ12 else 90), 400 * np.pi
    kept, left = (np.abs(run(end, method=method, h=h, **o).y[:, -1:] - exact(end)).max() for o in (KEPT, {}))
    assert kept < 0.3 * left


def test_roundings_in_a_long_run_are_no_failure():
    """A residual of some roundings may grow by a rounding when it is projected, here at t = 273."""

    def pull(t, q):
        return np.array([-q[0] - 2 * q[0] * q[1], -q[1] - q[0] ** 2 + q[1] ** 2])

    energy = Invariant(
        lambda t, y: 0.5 * (y @ y) + y[0] ** 2 * y[1] - y[1] ** 3 / 3,
        lambda t, y: np.concatenate([-pull(t, y[:2]), y[2:]]),
    )
    y0 = [0.0, 0.55, 0.2416954005906332, 0.0]
    found = run(300, y0, acceleration=pull, jacobian=None, method=EIPGJ12, h=1 / 60, every=10, invariants=energy)
    assert found.success, found.message
    assert found.max_residual[0] < 2e-16


@both
@pytest.mark.parametrize("sign", [1, -1])
def test_between_steps(method, sign):
    """t_eval, dense output and saved steps, backward too, to 1e-12 of the closed form; the two agree in bits."""
    end, given = 20.3, {"method": method, **KEPT}
    y0, times = Y0 * [1, 1, sign, sign], np.linspace(0, end, 111)
    found = run(sign * end, y0, dense_output=True, save_every=1, **given)
    flip = np.array([1, 1, sign, sign])[:, None]
    assert np.abs(found.y * flip - exact(np.abs(found.t))).max() < 2e-13
    assert np.abs(found.sol(sign * times) * flip - exact(times)).max() < 1e-12
    assert np.array_equal(run(sign * end, y0, t_eval=sign * times, **given).y, found.sol(sign * times))
    assert np.array_equal(found.sol(found.t), found.y)
    for other in ({}, {"save_every": 77}, {"events": lambda t, y: y[0]}):
        assert np.array_equal(run(sign * end, y0, **other, **given).y[:, -1], found.y[:, -1])


@both
def test_intervals_far_below_the_step(method):
    """An interval that is not empty takes a step; y(t) = y0 + t y'(t0) to rounding, because end^2 is below that."""
    rates = np.concatenate([Y0[2:], acceleration(0.0, Y0[:2])])
    given = {"acceleration": acceleration, "method": method, "h": STEP, "jacobian": jacobian, **KEPT}
    for end in (1e-9, 1e-12, 1e-300):
        found = integrate(y0=Y0, t_span=(0, end), **given)
        assert (found.status, found.t[-1]) == (0, end)
        assert np.abs(found.y[:, -1] - (Y0 + end * rates)).max() < 1e-15
        members = ensemble(y0s=np.array([Y0, Y0]), t_span=(0, end), **given)
        assert (members.status == 0).all()
        assert (members.t == end).all()


@both
def test_few_steps(method):
    """Runs shorter than a history use the starting method."""
    for count in (1, 2, 5, 11, 12, 13, 14, 15, 16, 17, 20, 27):
        for extra in (0.0, 0.3):
            end = (count + extra) * STEP
            found = run(end, method=method, save_every=1, **KEPT)
            assert found.t.size == count + 1 + (extra > 0)
            assert np.abs(found.y - exact(found.t)).max() < 3e-15


def test_velocities_are_found_in_solve_ivp():
    """A damped oscillator: of the order that the method has, whatever the forces see."""

    def damped(t, y):
        return np.array([y[1], -y[0] - 0.1 * y[1]])

    errors, w = [], np.sqrt(1 - 0.05**2)
    for h in (0.1, 0.08):
        solution = solve_ivp(damped, (0, 20), [1.0, 0.0], method=eip_method(GaussJackson(order=8)), h=h)
        t = solution.t
        errors.append(np.abs(solution.y[0] - np.exp(-0.05 * t) * (np.cos(w * t) + 0.05 / w * np.sin(w * t))).max())
    assert 8 < np.log(errors[0] / errors[1]) / np.log(0.1 / 0.08) < 12
    with pytest.raises(ValueError, match=r"velocity is too large: .* 0\.1\. Take h <= 0\.00872, or"):
        solve_ivp(damped, (0, 20), [1.0, 0.0], method=EIPGJ12, h=0.05)


def later_damped(t, y):
    """An oscillator with a damper that begins to act, smoothly, at t = 3; before, other velocities change nothing."""
    c = 0.05 * np.exp(-20.0 / (t - 3.0)) if t > 3.0 else 0.0
    return np.array([y[1], -y[0] - c * y[1]])


@pytest.mark.parametrize("fun", [later_damped, numba.njit(later_damped)], ids=["python", "jitted"])
def test_accelerations_that_come_to_depend_on_velocities(fun):
    """They do not at the start, where a run looks."""
    truth = solve_ivp(fun, (0, 20), [1.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    options = {"method": EIPGJ12, "h": 0.01}
    for run in (integrate(fun, (0, 20), [1.0, 0.0], **options), solve_ivp(fun, (0, 20), [1.0, 0.0], **options)):
        assert run.success
        assert np.abs(run.y[:, -1] - truth).max() < 1e-10


@pytest.mark.parametrize("fun", [later_damped, numba.njit(later_damped)], ids=["python", "jitted"])
@pytest.mark.parametrize("method", [EIPRKN8, EIPRKN12])
def test_nystrom_methods_end_where_accelerations_come_to_depend_on_velocities(fun, method):
    for steps in ({"h": 0.02}, {"rtol": 1e-8, "atol": 1e-8}):
        for solve in (integrate, solve_ivp):
            found = solve(fun, (0, 20), [1.0, 0.0], method=method, **steps)
            assert not found.success
            assert "depend on the velocity" in found.message
            assert 3 < found.t[-1] < 12
            early = found.t < 3
            np.testing.assert_allclose(found.y[0, early], np.cos(found.t[early]), rtol=0, atol=1e-7)


def test_a_step_that_is_not_stable_is_refused_with_one_that_is():
    """The step is refused at the start, from the orbits or from the accelerations alone."""
    problem = solar_system(years=10)
    with pytest.raises(ValueError, match=r"EIPGJ12: h = 0\.004 is not stable .* Take h <= (0\.00\d+)") as error:
        integrate(problem, method=EIPGJ12, h=0.004)
    longest = float(str(error.value).split("Take h <= ")[1].split(",")[0])
    assert integrate(problem, method=EIPGJ12, h=0.99 * longest).trusted
    moons = solar_system(solar_data.load("de440-moon"), years=1)  # 27 days: the Jacobian of the Sun corrects no moon
    with pytest.raises(ValueError, match=r"EIPGJ14: h = 0\.001 .* \(period 0\.07\d+\)\. Take h <= 0\.0003"):
        integrate(moons, method=EIPGJ14, h=0.001)
    springs = lambda t, q: -np.array([1.0, 9.0]) * q  # noqa: E731
    with pytest.raises(ValueError, match=r"of angular frequency 3 \(period 2\.094\)\. Take h <= 0\.0217"):
        run(10, [1.0, 1.0, 0.0, 0.0], acceleration=springs, jacobian=None, method=EIPGJ12, h=0.05)
    with pytest.raises(ValueError, match="is not stable"):
        solve_ivp(orbit, (0, 20), Y0, method=EIPGJ14, h=STEP)  # which has no Jacobian here


def test_a_passage_is_told_at_whichever_step_it_comes():
    """Not only where it falls near a projection: here none is made, and it comes later by two steps each time."""
    for later in range(0, 70, 2):
        start = np.array([(1 + later * 0.005 / 1.11) ** (2 / 3), 0.0, 0.0, 0.02])
        found = run(3, start, method=EIPGJ12, h=0.005, save_every=10)
        passage = np.pi * np.sqrt((start[0] / 2) ** 3)
        assert (found.status, found.trusted) == (-1, False)
        assert passage - 0.1 < found.t[-1] < passage + 0.1
        assert np.isfinite(found.y).all()
    assert "the step is too long, or the motion not smooth" in found.message


def test_a_force_that_jumps_or_is_not_finite_is_told():
    """Differences of its history do not fall."""
    jumping = lambda t, q: -q * (1.0 if t < 3 else 1.5)  # noqa: E731
    broken = lambda t, q: -q if t < 1 else q * np.nan  # noqa: E731
    found, ended = (
        run(20, [1.0, 0.0], acceleration=force, jacobian=None, method=EIPGJ12, h=0.03) for force in (jumping, broken)
    )
    assert found.status == ended.status == -1
    assert "or forces that jump" in found.message
    assert 3 <= float(found.message.split("at t=")[1].split(":")[0]) < 6
    assert "acceleration returned a non-finite value at t=1.02" in ended.message


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"direction": "old"}, ValueError, "projects along the gradients at the"),
        ({"compensated": False}, ValueError, "always uses compensated sums"),
        ({"h": None}, ValueError, "takes fixed steps and needs the step h"),
        ({"rtol": 1e-6, "h": None}, ValueError, "takes fixed steps"),
        ({"jacobian": 3}, TypeError, r"jacobian must be a function jacobian\(t, q, dq, out"),
    ],
)
def test_bad_options(options, error, message):
    """Messages give the value, and what to do."""
    with pytest.raises(error, match=message):
        run(1, **{"method": EIPGJ12, "h": 0.01, "jacobian": None, **KEPT, **options})
    for n, words in ((4, "first 2 components of fun must be v"), (3, "an even number of components")):
        with pytest.raises(ValueError, match=words):
            solve_ivp(lambda t, y: -y, (0, 1), np.ones(n), method=EIPGJ12, h=0.01)
