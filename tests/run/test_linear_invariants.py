"""Linear invariants that are found and kept, momenta of particles that are missing, and times far from 0."""

import numpy as np
import pytest
from numba import njit

import eip_scipy
from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, EIPRadau, Invariant, integrate, particle_invariants, solve_ivp

MASSES = np.array([3.0, 1.0, 2.0])
START = np.array([0, 0, 1.1, 0, -0.2, 0.9, 0.3, -0.1, 0.2, 0.4, -0.3, 0.1])


@njit
def forces(y, out):
    """Write the forces of three springs between particles in a plane to out[6:], and return their energy."""
    out[6:], potential = 0.0, 0.0
    for i in (0, 2, 4):
        for j in range(0, i, 2):
            dx, dy = y[i] - y[j], y[i + 1] - y[j + 1]
            r = np.sqrt(dx * dx + dy * dy)
            potential += 5 * (r - 1) ** 2
            for k, d in ((0, dx), (1, dy)):
                out[6 + i + k] -= 10 * (r - 1) / r * d
                out[6 + j + k] += 10 * (r - 1) / r * d
    return potential


@njit
def springs(t, y, m):
    out = np.empty(12)
    forces(y, out)
    for i in range(6):
        out[i], out[6 + i] = y[6 + i], out[6 + i] / m[i // 2]
    return out


@njit
def energy(t, y, m):
    total = forces(y, np.empty(12))
    for i in range(6):
        total += 0.5 * m[i // 2] * y[6 + i] ** 2
    return total


@njit
def slope(t, y, f, out, m):
    for i in range(6):
        out[i], out[6 + i] = -m[i // 2] * f[6 + i], m[i // 2] * y[6 + i]


@njit
def momentum(t, y, m):
    out = np.zeros(2)
    for i in range(6):
        out[i % 2] += m[i // 2] * y[6 + i]
    return out


H = Invariant(energy, slope, in_place=True, uses_f=True, name="H")
P = Invariant(momentum, name="P")
L = particle_invariants(MASSES, 2)
FIXED = {"method": EIPRK4, "h": 0.05, "params": MASSES}
OFF = {"linear_invariants": None}


def drift(y):
    """Return the largest change of the total momentum between the first and the last of the states y (12, m)."""
    return np.abs(momentum(0.0, y[:, -1], MASSES) - momentum(0.0, y[:, 0], MASSES)).max()


def plain(t, y):
    return springs(t, y, MASSES)


def in_trap(t, y):
    return plain(t, y) - np.concatenate([np.zeros(6), y[:6]])


def energy_of(potential):
    """Return the energy of the springs and of another potential of y, whose gradient follows from the derivative."""
    value = lambda t, y: energy(t, y, MASSES) + potential(y)  # noqa: E731
    return Invariant(value, lambda *given: slope(*given, MASSES), in_place=True, uses_f=True, name="H")


ENERGY = energy_of(lambda y: 0.0)
TRAPPED = energy_of(lambda y: 0.5 * np.repeat(MASSES, 2) @ y[:6] ** 2)


def test_momentum_and_centre_of_mass_are_found_and_kept():
    """The corrections for the energy change neither the momentum nor the number of counted evaluations."""
    run, without = (integrate(springs, (0, 20), START, invariants=H, **FIXED, **more) for more in ({}, OFF))
    assert drift(run.y) < 1e-13 < 1e-9 < drift(without.y)
    centre = np.repeat(MASSES, 2).reshape(3, 2) * (run.y[:6, -1] - START[:6] - 20 * START[6:]).reshape(3, 2)
    assert np.abs(centre.sum(axis=0)).max() < 1e-12
    assert run.diagnostics.remarks[0].startswith("linear invariants: 4 found by 20 evaluations (not in nfev), 4 kept")
    assert "linear invariants: 4" in repr(run.diagnostics)
    assert run.nfev == without.nfev
    assert without.diagnostics.remarks[0].startswith("momentum and angular momentum")


@pytest.mark.parametrize("kept", [(H, P), (H, *L, P)], ids=["H and P", "H, L and P"])
def test_given_momentum_is_projected(kept):
    """Corrections may change a linear invariant that is given, and a quantity whose rate it is."""
    run, without = (integrate(springs, (0, 5), START, invariants=kept, **FIXED, **more) for more in ({}, OFF))
    np.testing.assert_array_equal(run.y, without.y)
    assert "4 found" in run.diagnostics.remarks[0]
    assert "0 kept" in run.diagnostics.remarks[0]


def test_mass_of_robertson_is_projected():
    """An implicit method with the mass as its invariant makes the same steps as without the search."""

    @njit
    def robertson(t, y):
        a, b = 1e4 * y[1] * y[2] - 0.04 * y[0], 3e7 * y[1] ** 2
        return np.array([a, -a - b, b])

    mass = Invariant(njit(lambda t, y: y[0] + y[1] + y[2]))
    options = {"method": EIPRadau, "invariants": mass, "rtol": 1e-4, "atol": 1e-8}
    run, without = (integrate(robertson, (0, 1e4), [1.0, 0, 0], **options, **more) for more in ({}, OFF))
    np.testing.assert_array_equal(run.y, without.y)
    assert run.diagnostics.remarks[0].startswith("linear invariants: 1 found by 11 evaluations (not in nfev), 0 kept")


AUTO = {"method": EIPRK4, "h": 0.02, "linear_invariants": "auto"}


def test_only_what_the_invariants_determine_is_left_out():
    """The given one of two masses may be changed, as the energy of a free particle changes all of its velocities."""

    def decays(t, y):
        a, b = y[0] ** 2 - y[1], y[2] * y[3] - y[3] ** 2
        return np.array([-a, a, -b, b])

    mass = Invariant(lambda t, y: y[0] + y[1], lambda t, y: np.array([1.0, 1, 0, 0]))
    options = AUTO | {"fun": decays, "t_span": (0, 1), "y0": [1.0, 0, 2, 1], "invariants": mass}
    run, wide = integrate(**options), integrate(**options, variations="state")
    assert run.diagnostics.remarks[0].startswith("linear invariants: 2 found by 12 evaluations (not in nfev), 1 kept")
    assert wide.diagnostics.remarks == run.diagnostics.remarks
    np.testing.assert_array_equal(wide.y, run.y)
    speed = Invariant(lambda t, y: y[2] ** 2 + y[3] ** 2, lambda t, y: np.append([0, 0], 2 * y[2:]))
    run = integrate(lambda t, y: np.append(y[2:], [0, 0]), (0, 1), [1.0, 2, 3, 4], invariants=speed, **AUTO)
    assert "4 found by 12 evaluations (not in nfev), 0 kept" in run.diagnostics.remarks[0]


def test_contact_after_the_start_drops_what_was_found(fine, stopped, tmp_path):
    """Two balls on a spring have a constant momentum until one of them reaches a wall, far from the start."""

    def fun(t, y):
        force = np.sin(y[1] - y[0])
        return np.array([y[2], y[3], force - 4 * max(0.0, y[0] - 4) ** 3, -force])

    energy = Invariant(
        lambda t, y: 0.5 * (y[2] ** 2 + y[3] ** 2) + max(0.0, y[0] - 4) ** 4 - np.cos(y[1] - y[0]),
        lambda t, y: np.append(-fun(t, y)[2:], y[2:]),
    )
    assert "2 found" in integrate(fun, (0, 1), [1.0, 0.5, 1, 1], invariants=energy, **AUTO).diagnostics.remarks[0]
    C = np.kron(np.eye(2), np.ones((1, 2)))
    options = AUTO | {"fun": fun, "t_span": (0, 20.0), "y0": [1.0, 0.5, 1.0, 1.0], "invariants": energy, "h": 0.0034}
    run, kept = integrate(**options), integrate(**options | {"linear_invariants": (C, C.T)})
    assert run.trusted
    assert "does not hold later: none is kept since then" in str(run.diagnostics)
    exact = integrate(**options | {"method": EIPDOP853, "h": None, "rtol": 1e-12, "atol": 1e-13, "invariants": ()}).y[
        :, -1
    ]
    errors = [np.abs(found.y[:, -1] - exact).max() for found in (run, kept)]
    assert errors[0] < 0.85 * errors[1]
    for chunks in (4, 9):  # before the check at which they are dropped, and after it
        path = tmp_path / f"{chunks}.npz"
        with stopped(chunks):
            integrate(checkpoint=path, **options)
        resumed = integrate(checkpoint=path, resume=True, **options)
        np.testing.assert_array_equal(resumed.y, run.y)
        assert resumed.diagnostics.remarks == run.diagnostics.remarks


def test_nothing_is_found():
    """Functions in Python and runs with a given frame are not searched; a value that is not finite ends a search."""
    C = np.kron(np.eye(2), np.kron(MASSES, np.eye(2)))
    given = integrate(springs, (0, 1), START, invariants=[H, *L], linear_invariants=(C, C.T), **FIXED)
    same = integrate(springs, (0, 1), START, invariants=[H, *L], linear_invariants=(C, C.T), **FIXED)
    assert given.diagnostics.remarks == same.diagnostics.remarks == ()
    np.testing.assert_array_equal(given.y, same.y)
    first = Invariant(lambda t, y: y[0], lambda t, y: np.array([1.0, 0]))
    options = AUTO | {"check": False, "invariants": first, "t_span": (0, 0.02), "y0": [0.1, 1.0 + 1e-9]}
    with np.errstate(invalid="ignore"):
        run = integrate(lambda t, y: np.array([1.0, -1.0]) * np.log(y[1] - 1.0), **options)
    assert run.diagnostics.remarks == ()
    for wrong in ("all", 3.0, (C,)):
        with pytest.raises(ValueError, match="linear_invariants must be 'auto', None, or a pair"):
            integrate(springs, (0, 1), START, invariants=H, linear_invariants=wrong, **FIXED)


def test_members_and_resumed_runs_have_the_same_bits(fine, stopped, tmp_path):
    """The points of the search are the same in each run; an ensemble keeps what holds for all of its members."""
    starts = START * np.linspace(0.9, 1.1, 9)[:, None]
    options = FIXED | {"invariants": [H, *L]}
    alone = [integrate(springs, (0, 2), start, **options).y[:, -1] for start in starts]
    np.testing.assert_array_equal(eip_scipy.ensemble(springs, (0, 2), starts, **options).y, alone)
    with stopped(2):
        integrate(springs, (0, 2), START, checkpoint=tmp_path / "run", **options)
    resumed = integrate(springs, (0, 2), START, checkpoint=tmp_path / "run", resume=True, **options)
    np.testing.assert_array_equal(resumed.y, integrate(springs, (0, 2), START, **options).y)
    continued = integrate(springs, (0, 1), START, **options).continue_to(2)
    assert drift(continued.y) < 1e-13
    assert continued.diagnostics.remarks == resumed.diagnostics.remarks
    options = FIXED | {"invariants": H}
    for powers, more in ([1, 1, 1], {}), ([1, 2, 3], OFF):  # equal and different linear invariants
        masses = MASSES * np.linspace(0.9, 1.1, 9)[:, None] ** powers
        found = eip_scipy.ensemble(springs, (0, 2), starts, **options | {"params": masses}).y
        for start, m, end in zip(starts, masses, found, strict=True):
            run = integrate(springs, (0, 2), start, **options | more | {"params": m})
            np.testing.assert_array_equal(run.y[:, -1], end)


@pytest.mark.parametrize("dimension", [2, 3])
def test_particle_invariants_are_angular_momenta(dimension):
    (q, v), about = np.random.default_rng(1).standard_normal((2, 3, dimension)), np.arange(1.0, 1 + dimension)
    (item,) = particle_invariants(MASSES, dimension, about=about)
    y = np.concatenate([q.ravel(), v.ravel()])
    pad = [(0, 0), (0, 3 - dimension)]
    expected = (MASSES[:, None] * np.cross(np.pad(q - about, pad), np.pad(v, pad))).sum(axis=0)
    for value, fill in ((item.fun, item.grad), (njit(item.fun), njit(item.grad))):
        np.testing.assert_allclose(value(0.0, y), expected[2:] if dimension == 2 else expected, rtol=1e-14)
        assert eip_scipy.check_gradient(Invariant(value, fill, in_place=True), 0.0, y) < 1e-10


def test_particle_invariants_keep_momentum_in_each_interface():
    """Momentum is kept also for functions in Python, and not where the system does not keep it, as in a trap."""
    kept = {"invariants": [ENERGY, *L], "rtol": 1e-6, "atol": 1e-9}
    sol = solve_ivp(plain, (0, 20), START, EIPDOP853, **kept)
    run = integrate(plain, (0, 20), START, method=EIPDOP853, **kept)
    alone = integrate(plain, (0, 20), START, method=EIPDOP853, **kept | {"invariants": ENERGY})
    assert max(drift(sol.y), drift(run.y)) < 1e-12 < 1e-8 < drift(alone.y)
    trapped = solve_ivp(in_trap, (0, 2), START, EIPRK45, invariants=[TRAPPED, *L], rtol=1e-8, atol=1e-10)
    assert trapped.trusted
    assert trapped.diagnostics.remarks == ()
    centre = (np.repeat(MASSES, 2)[:, None] * trapped.y[:6]).reshape(3, 2, -1).sum(axis=0)
    speed = momentum(0.0, START, MASSES)
    np.testing.assert_allclose(centre[:, -1], np.cos(2.0) * centre[:, 0] + np.sin(2.0) * speed, atol=1e-6)


def test_wrong_particles_are_refused():
    for wrong, match in (
        ({"masses": [1.0, -1.0]}, "masses must be finite numbers >= 0"),
        ({"masses": [1.0], "dimension": 4}, "dimension must be 2 or 3"),
        ({"masses": [1.0], "about": [0.0, 0.0]}, "about must be a point with 3 finite"),
    ):
        with pytest.raises(ValueError, match=match):
            particle_invariants(**wrong)


def test_missing_momenta_are_named_once():
    """The line to write is in the message, unless it has been followed or the system does not keep them."""
    line = "invariants=[H, *particle_invariants(masses, dimension=2)]"
    options = {"method": EIPRK4, "h": 0.05}
    assert line in integrate(plain, (0, 1), START, invariants=ENERGY, **options).message
    assert line in solve_ivp(plain, (0, 1), START, EIPRK4, h=0.05, invariants=ENERGY).message
    assert "particle_inv" not in integrate(plain, (0, 1), START, invariants=[ENERGY, *L], **options).message
    assert "particle_inv" not in integrate(in_trap, (0, 1), START, invariants=TRAPPED, **options).message
    choice = eip_scipy.recommend(springs, (0, 2), START, invariants=H, params=MASSES, error=1e-4)
    assert [item.name for item in choice.options["invariants"]] == ["H", "L"]


@pytest.mark.parametrize("driver", ["integrate", "solve_ivp"])
def test_time_far_from_zero(driver):
    """The rounding of t, by which an invariant that depends on t changes, is not projected onto the state."""
    w, t0 = 2.0, 1e8

    def forced(t):
        return np.array([np.cos(w * t), -w * np.sin(w * t)]) / (1 - w * w)

    def fun(t, y):
        return np.array([y[1], -y[0] + np.cos(w * t)])

    kept = Invariant(lambda t, y: ((y - forced(t)) @ (y - forced(t))) / 2, name="rest")
    c, s = np.cos(50.0), np.sin(50.0)
    exact = forced(t0 + 50) + np.array([[c, s], [-s, c]]) @ (np.array([1.0, 0.0]) - forced(t0))
    call = {"integrate": integrate, "solve_ivp": solve_ivp}[driver]
    runs = [call(fun, (t0, t0 + 50), [1.0, 0.0], method=EIPRK4, h=0.02, invariants=k) for k in ([kept], [])]
    found, without = (np.abs(run.y[:, -1] - exact).max() for run in runs)
    assert found < 1.2 * without < 1e-7
    assert runs[0].trusted
