"""Tangent maps against closed forms, complex steps and REBOUND; exponents and MEGNO."""

import numpy as np
import pytest
from numba import njit
from systems import refuse

from eip_scipy import EIPDOP853, EIPRK4, hamiltonian, integrate
from eip_scipy.chaos import lyapunov_exponent, lyapunov_spectrum, megno
from eip_scipy.problems import nbody

pytestmark = pytest.mark.needs_jit

PERIOD = 2 * np.pi


@pytest.fixture(scope="module")
def pendulum():
    return hamiltonian("p**2/2 - k*cos(q)", params={"k": 1.0})


# Sensitivities.


def attracted(t, y, p):
    w = p[0] / (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return np.array([y[2], y[3], -w * y[0], -w * y[1]])


def volterra(t, y, p):
    return np.array([y[0] * (p[0] - p[1] * y[1]), y[1] * (p[2] * y[0] - p[3])])


def duffing(t, y, p):
    return np.array([y[1], y[0] - y[0] ** 3 - p[0] * y[1] + p[1] * np.cos(p[2] * t)])


SYSTEMS = {  # the function, its parameters, invariants, and the start
    "Kepler": (
        attracted,
        [1.1],
        [
            lambda t, y, p: (y[2] * y[2] + y[3] * y[3]) / 2 - p[0] / np.sqrt(y[0] * y[0] + y[1] * y[1]),
            lambda t, y, p: y[0] * y[3] - y[1] * y[2],
        ],
        [1.0, 0.0, 0.1, 1.0],
    ),
    "Lotka-Volterra": (
        volterra,
        [1.0, 0.8, 0.6, 0.9],
        [lambda t, y, p: p[2] * y[0] - p[3] * np.log(y[0]) + p[1] * y[1] - p[0] * np.log(y[1])],
        [1.5, 1.0],
    ),
    "forced Duffing": (duffing, [0.2, 0.3, 1.1], [], [0.5, 0.1]),
}
NIGHTLY = [pytest.mark.slow, pytest.mark.nightly]  # they compile for seconds to minutes
CASES = [(name, "complex steps") for name in SYSTEMS]
CASES.append(pytest.param("Lotka-Volterra", "dual numbers", marks=NIGHTLY))
STEP, STEPS = 0.0625, 16


def through_steps(f, y0, params, h, steps):
    """Return derivatives (n, n + p) of the state after some steps, by complex steps through the steps themselves."""
    A, b, c = (np.asarray(getattr(EIPDOP853.TABLEAU, item)) for item in "Abc")
    columns = []
    for k in range(len(y0) + len(params)):
        y, p = np.array(y0, complex), np.array(params, complex)
        (y if k < len(y0) else p)[k if k < len(y0) else k - len(y0)] += 1e-30j
        for step in range(steps):
            K = []
            for i in range(len(b)):
                K.append(f((step + c[i]) * h, y + h * sum((A[i, j] * K[j] for j in range(i)), 0 * y), p))
            y = y + h * sum(b[i] * K[i] for i in range(len(b)))
        columns.append(y.imag / 1e-30)
    return np.array(columns).T


@pytest.mark.parametrize(("name", "source"), CASES)
def test_sensitivities(name, source):
    """The columns of a plain run are derivatives of its steps, those of a projected run are those of the flow."""
    f, params, kept, y0 = SYSTEMS[name]
    jit = njit if source == "dual numbers" else lambda function: function
    options = {"t_span": (0, STEP * STEPS), "y0": y0, "params": params, "variations": ["state", *range(len(params))]}
    for h, invariants, error in ((STEP, (), 1e-12), (STEP / 4, [jit(item) for item in kept], 1e-10)):
        run = integrate(jit(f), method=EIPDOP853, h=h, invariants=invariants, **options)
        exact = through_steps(f, y0, params, h, round(STEP * STEPS / h))
        assert run.columns["source"] == source
        assert np.abs(run.variations[-1] - exact).max() < error * np.abs(exact).max()


# Exponents and MEGNO.


def test_spectrum_of_a_linear_system():
    # The columns grow apart by e^93 in 30, which is halved therefore.
    run = lyapunov_spectrum(lambda t, y: np.array([0.3, -2.0, 1.1]) * y, 400, np.ones(3) * 1e-60, method=EIPRK4,
                            h=0.1, every=30.0)  # fmt: skip
    assert run.exponents == pytest.approx([1.1, 0.3, -2.0], abs=0.01)
    assert run.running.shape == (run.t.size, 3)
    assert run.t[-1] == 400
    assert run.success
    assert run.trusted


def test_megno_of_a_regular_orbit(pendulum):
    run = megno(pendulum, (0, 20000), [0.0, 1.5], method=EIPDOP853, h=0.2)
    assert run.megno == pytest.approx(2.0, abs=0.01)
    assert abs(run.lyapunov) < 1e-3
    assert run.Y[0] == run.mean[0] == 0
    assert run.t.size == run.Y.size == run.mean.size == 101


def test_megno_by_its_definition(pendulum):
    """MEGNO agrees with the integral itself, by the trapezoidal rule over small steps."""
    run = megno(pendulum, 20, [0.5, 1.0], deviation=[1.0, 2.0], method=EIPDOP853, h=0.1, every=1.25)
    fine = integrate(pendulum, (0, 20), [0.5, 1.0], method=EIPDOP853, h=0.0025, save_every=1,
                     variations=np.array([[1.0], [2.0]]))  # fmt: skip
    dq, dp = fine.variations[:, :, 0].T
    rate = (dq * dp - dp * np.cos(fine.y[0]) * dq) / (dq**2 + dp**2)
    Y = (
        2
        / fine.t[1:]
        * np.cumsum(np.diff(fine.t) * (fine.t * rate)[:-1] / 2 + np.diff(fine.t) * (fine.t * rate)[1:] / 2)
    )
    assert np.interp(run.t[1:], fine.t[1:], Y) == pytest.approx(run.Y[1:], abs=3e-4)
    mean = np.cumsum((Y[1:] + Y[:-1]) / 2 * np.diff(fine.t[1:])) / fine.t[2:]
    assert np.interp(run.t[1:], fine.t[2:], mean) == pytest.approx(run.mean[1:], abs=3e-3)
    adaptive = megno(pendulum, 20, [0.5, 1.0], deviation=[1.0, 2.0], method=EIPDOP853, rtol=1e-9, atol=1e-9)
    assert adaptive.Y[-1] == pytest.approx(run.Y[-1], abs=1e-5)


def test_backward_runs(pendulum):
    there = megno(pendulum, (0, 200), [0.0, 1.0], deviation=[1, 2], method=EIPDOP853, h=0.1)
    back = megno(pendulum, (0, -200), [0.0, 1.0], deviation=[-1, 2], method=EIPDOP853, h=0.1)
    assert back.t[-1] == -200
    assert back.megno == pytest.approx(there.megno, rel=1e-10)
    spectrum = lyapunov_spectrum(lambda t, y: 0.5 * y, (0, -10), [1.0], method=EIPRK4, h=0.1)
    assert spectrum.exponents == pytest.approx([-0.5])


def test_runs_that_end_early():
    def stop(t, y):
        return y[0] - 2

    stop.terminal = True
    run = lyapunov_spectrum(lambda t, y: y, (0, 10), [1.0], method=EIPRK4, h=0.01, events=stop)
    assert run.t[-1] == pytest.approx(np.log(2))
    assert run.exponents == pytest.approx([1.0])
    assert run.status == "stop"
    for every in (0.7, 0.5):  # within a segment, and at the start of one
        fails = megno(lambda t, y: y if t < 1 else y * np.nan, (0, 3), [1.0, 1.0], method=EIPRK4, h=0.1, every=every)
        assert not fails.success
        assert fails.status == "failed"
        assert "non-finite" in str(fails.message)
        assert fails.t[-1] <= 1
        assert np.isnan(fails.megno)


def test_interrupted_runs_have_what_is_done():
    def ends(t, y):
        if t > 1:
            raise KeyboardInterrupt
        return y

    with pytest.raises(KeyboardInterrupt) as info:
        lyapunov_spectrum(ends, 2, [1.0], method=EIPRK4, h=0.1, every=0.5)
    assert info.value.partial.t.tolist() == [0, 0.5, 1.0]
    assert info.value.partial.lyapunov == pytest.approx(1.0, abs=1e-5)


def test_figures():
    pytest.importorskip("matplotlib")
    from eip_scipy import plotting

    def swings(t, y):
        return np.array([y[1], -np.sin(y[0])])

    run = megno(swings, (0, 5), [0.5, 0.0], method=EIPRK4, h=0.1)
    (axis,) = run.plot().axes
    np.testing.assert_array_equal(axis.lines[1].get_ydata(), run.mean)
    spectrum = lyapunov_spectrum(swings, (0, 5), [0.5, 0.0], method=EIPRK4, h=0.1, every=1.0)
    (axis,) = spectrum.plot().axes
    np.testing.assert_array_equal(axis.lines[1].get_ydata(), spectrum.running[:, 1])
    values = np.array([[2.0, np.inf, 1.9], [np.nan, 5.0, -1.0]])
    figure = plotting.map([1, 2, 3], [0.1, 0.2], values, xlabel="a", ylabel="e", title="T")
    axis, bar = figure.axes

    def drawn(k):
        return np.ma.filled(axis.collections[k].get_array(), np.nan).reshape(2, 3)

    np.testing.assert_array_equal(drawn(0), [[2, 8, 1.9], [np.nan, 5, 0]])
    assert (axis.get_xlabel(), axis.get_ylabel(), bar.get_ylabel()) == ("a", "e", "mean MEGNO (2: regular)")
    found = megno(swings, 5, np.full((2, 3, 2), [0.5, 0.0]), method=EIPRK4, h=0.1)
    found.status = np.array([["ok", "escaped", "ok"], ["ok", "ok", "failed"]])
    found.megno[:] = values
    axis, _ = plotting.map([1, 2, 3], [0.1, 0.2], found).axes
    np.testing.assert_array_equal(drawn(0), [[2, np.nan, 1.9], [np.nan, 5, np.nan]])
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["escaped", "failed"]
    np.testing.assert_array_equal(drawn(1), [[np.nan, 1, np.nan], [np.nan, np.nan, np.nan]])
    with pytest.raises(ValueError, match="draws one orbit"):
        found.plot()
    with pytest.raises(ValueError, match=r"shape \(2, 3\)"):
        plotting.map([1, 2, 3], [0.1, 0.2], np.ones((3, 2)))
    with pytest.raises(ValueError, match="most must be above 0"):
        plotting.map([1, 2, 3], [0.1, 0.2], values, most=0.0)


# Grids.


def test_spectra_over_a_grid_of_starts():
    """The exponents of Hamiltonian flows come in pairs of opposite sign. Each orbit has the values of its own run."""
    henon_heiles = hamiltonian("(px**2 + py**2 + x**2 + y**2)/2 + x**2*y - y**3/3")
    y0s = np.array([[[0.0, y, 0.3, 0.1], [0.1, y, 0.35, 0.0]] for y in (-0.2, 0.1, 0.45)])
    steps = {"method": EIPDOP853, "h": 0.1, "every": 20.0}
    found = lyapunov_spectrum(henon_heiles, 200, y0s, **steps)
    assert found.exponents.shape == (3, 2, 4)
    assert found.running.shape == (11, 3, 2, 4)
    assert np.abs(found.exponents.sum(axis=-1)).max() < 1e-9
    assert np.abs(found.exponents + found.exponents[..., ::-1]).max() < 5e-3  # which falls as 1 / t
    alone = lyapunov_spectrum(henon_heiles, 200, y0s[2, 1], **steps)
    np.testing.assert_array_equal(alone.exponents, found.exponents[2, 1])
    largest = lyapunov_exponent(henon_heiles, 200, y0s, **steps)
    assert largest.lyapunov == pytest.approx(found.running[-1, ..., 0], abs=1e-9)
    map_of_megno = megno(henon_heiles, 200, y0s, **steps)
    assert map_of_megno.megno[2, 1] == megno(henon_heiles, 200, y0s[2, 1], **steps).megno


def escaped(t, y, k):
    return 3 - abs(y[0])


escaped.terminal = True


def test_status_of_the_orbits_of_a_grid():
    """Orbits that end early do not end the others; parameters may vary over the grid, too."""

    def fun(t, y, k):  # grows at the rate k
        return k * y if abs(y[0]) < 1e3 else y * np.nan

    rates, y0s = np.array([[0.1, -0.2, 0.2], [1.0, 0.15, -1.0]]), [1.0, 0.0]
    found = lyapunov_exponent(
        fun, 5, y0s, params=rates[..., None], events=escaped, method=EIPDOP853, rtol=1e-10, every=1
    )
    assert found.status.tolist() == [["ok", "ok", "ok"], ["escaped", "ok", "ok"]]
    assert found.lyapunov == pytest.approx(rates, abs=1e-7)
    assert found.y[1, 0, 0] == pytest.approx(3)
    assert np.isnan(found.t[-1]).tolist() == [[False] * 3, [True, False, False]]
    assert found.t[2, 1, 0] == pytest.approx(np.log(3))
    starts = [[1.0, 0.0], [400.0, 0.0]]
    failed = megno(fun, 5, starts, params=[0.5], method=EIPDOP853, h=0.01)
    assert failed.status.tolist() == ["ok", "failed"]
    assert np.isnan([failed.megno[1], failed.lyapunov[1]]).all()
    assert failed.lyapunov[0] == pytest.approx(0.5, abs=1e-3)
    assert not failed.success


# Two planets, against REBOUND.


def two_planets(a, e_outer):
    """Return masses and the state of two planets at their pericentres, on opposite sides."""
    m, q, v = np.array([1.0, 1e-3, 1e-3]), np.zeros((3, 3)), np.zeros((3, 3))
    for k, (axis, e, side) in enumerate(((1.0, 0.02, 1), (a, e_outer, -1)), 1):
        q[k, 0], v[k, 1] = side * axis * (1 - e), side * np.sqrt((1 + e) / (axis * (1 - e)))
    return m, np.concatenate([(q - m @ q / m.sum()).ravel(), (v - m @ v / m.sum()).ravel()])


def as_problem(m, y0, **options):
    return nbody(m, y0[:9].reshape(3, 3), y0[9:].reshape(3, 3), t_span=(0, 1), **options)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::eip_scipy.ProjectionWarning")  # the chaotic orbit has a close encounter
@pytest.mark.parametrize(("a", "regular"), [(1.8, True), (1.38, False)])
def test_megno_of_planets_is_that_of_rebound(a, regular):
    pytest.importorskip("rebound")
    from eip_scipy.integrations import rebound

    m, y0 = two_planets(a, 0.02 if regular else 0.1)
    t_end = 2000 * PERIOD
    theirs, slope, deviation = rebound.megno(m, y0, t_end=t_end, dt=PERIOD / 60, seed=3)
    run = megno(as_problem(m, y0), (0, t_end), deviation=deviation, method=EIPDOP853, h=PERIOD / 40)
    if regular:
        assert run.trusted
        assert theirs == pytest.approx(2.0, abs=0.01)
        assert run.megno == pytest.approx(2.0, abs=0.01)
        assert run.megno == pytest.approx(theirs, abs=2e-3)
    else:
        assert min(run.megno, theirs) > 20
        assert run.lyapunov == pytest.approx(2 * slope, rel=0.5)


# Bad input.


def test_bad_input():
    given = {"fun": lambda t, y: -y, "t": (0, 1), "y0s": [0, 1], "method": EIPRK4, "h": 0.1}
    spectrum = [
        ({"count": 3}, ValueError, "2 components"),
        ({"count": 0}, ValueError, "count"),
        ({"every": -1}, ValueError, "every"),
        ({"t": 0}, ValueError, "two different ends"),
        ({"variations": "state"}, TypeError, "set the option 'variations'"),
        ({"y0s": np.zeros((2, 3, 2)), "params": np.zeros((3, 1))}, ValueError, r"params must have the shape \(p,\) or"),
        *(
            ({"y0s": y0s}, ValueError, "y0s must have the shape .* and hold one state")
            for y0s in (3.0, np.zeros((0, 2)))
        ),
    ]
    indicator = [
        ({"t": (2, 2)}, ValueError, "two different ends"),
        ({"deviation": [0, 0]}, ValueError, "deviation"),
        ({"deviation": "x"}, ValueError, "deviation"),
        ({"metod": EIPRK4}, TypeError, "did you mean"),
        ({"samples": 0}, ValueError, "samples"),
    ]
    for call, rows in ((lyapunov_spectrum, spectrum), (megno, indicator)):
        refuse(call, [(given | options, *rest) for options, *rest in rows])
