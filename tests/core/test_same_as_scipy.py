"""Without invariants the adaptive pairs take the steps of SciPy's classes; `integrate` takes those of the classes."""

import math

import numpy as np
import pytest
from numba import njit
from scipy.integrate import DOP853, RK23, RK45, solve_ivp
from systems import JIT_H, JIT_L, JIT_NORM, jit_orbit, jit_spin, orbit, pericentre

from eip_scipy import EIPDOP853, EIPRK4, EIPRK23, EIPRK45, EIPRKN12, Diagnostics, eip_method, integrate

EPS = np.finfo(float).eps
SCIPY = {"RK23": RK23, "RK45": RK45, "DOP853": DOP853}
OURS = {"RK23": EIPRK23, "RK45": EIPRK45, "DOP853": EIPDOP853}
# Pairs with the package's own steps, whatever the classes do if nothing is projected.
OWN = {name: eip_method(cls.TABLEAU) for name, cls in OURS.items()}
PAIRS = [(name, cls) for table in (OURS, OWN) for name, cls in table.items()]
# How far their states may be apart at default tolerances. The estimate is a difference of terms h K_i, so round-off of
# them, eps h |f|, is a share eps h |f| / (estimate) of it, and 1/8 to 1/3 of that share goes into the next h.
# The estimate is 1e-3 to 1e-6 with RK23 and RK45, but where the tolerance has left DOP853's step behind (its e5 is a
# high power of h) 1e-10 and less; van der Pol's jumps then multiply a shift in time by another 1e3.
OWN_LEVEL = {"RK23": 1e-9, "RK45": 1e-6, "DOP853": 2e-3}
pairs = pytest.mark.parametrize(("name", "method"), PAIRS, ids=[cls.__name__ for _, cls in PAIRS])


def van_der_pol(t, y, mu=5.0):
    return np.array([y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]])


def spin(t, y):
    """Two coupled complex amplitudes, driven."""
    return np.array([-1j * y[0] + 0.5j * y[1], -2j * y[1] + 0.5j * y[0] - 0.1 * abs(y[1]) ** 2 * y[1]])


def rotor(t, y):
    return np.array([y[1], -math.sin(y[0]) + 0.1 * math.cos(t)])


CASES = {
    "Kepler e=.6": (orbit, (0.0, 20.0), pericentre(0.6)),
    "Kepler e=.9": (orbit, (0.0, 7.0), pericentre(0.9)),
    "van der Pol": (van_der_pol, (0.0, 30.0), [2.0, 0.0]),
    "complex": (spin, (0.0, 20.0), [1.0 + 0j, 0.2j]),
    "driven rotor": (rotor, (-1.0, 20.0), [1.5, 0.0]),
    "backward Kepler": (orbit, (3.0, -20.0), pericentre(0.6)),
    "backward complex": (spin, (5.0, 0.0), [1.0 + 0j, 0.2j]),
    "one component": (lambda t, y: np.array([math.cos(t) * y[0]]), (0.0, 10.0), [1.0]),
    "one component at zero": (lambda t, y: np.array([t]), (0.0, 10.0), [0.0]),
    "from rest": (lambda t, y: np.zeros(2), (0.0, 10.0), [1.0, -1.0]),
}


def level(name, method):
    return 1e-12 if method is OURS[name] else OWN_LEVEL[name]


# Roots are right to 4 eps (1 + |t|) in SciPy, and to 4 eps (h + |t|) in `integrate`. States move by this times a slope.
ROOTS = 256 * EPS


def assert_close(ours, theirs, rtol):
    """Compare to rtol of the largest size that a component takes."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert ours.shape == theirs.shape
    assert ours.dtype == theirs.dtype
    size = np.abs(theirs).max(axis=-1, keepdims=True, initial=0.0)
    assert (np.abs(ours - theirs) <= rtol * size + 5e-324).all(), np.abs(ours - theirs).max()


def assert_same(ours, theirs, rtol=1e-12):
    assert ours.status == theirs.status
    assert ours.success == theirs.success
    assert ours.message == theirs.message
    assert (ours.nfev, ours.njev, ours.nlu) == (theirs.nfev, 0, 0)
    assert len(ours.t) == len(theirs.t)
    assert_close(ours.t, theirs.t, rtol)
    assert_close(ours.y, theirs.y, rtol)
    assert (ours.t_events is None) == (theirs.t_events is None)
    for kind in ("t_events", "y_events") if theirs.t_events is not None else ():
        for mine, other in zip(ours[kind], theirs[kind], strict=True):
            assert_close(mine.T, other.T, rtol)
    if theirs.sol is not None:
        times = np.linspace(theirs.t[0], theirs.t[-1], 137)
        assert_close(ours.sol(times), theirs.sol(times), rtol)


def both(method, name, fun, t_span, y0, **options):
    """Return our result and SciPy's."""
    return (solve_ivp(fun, t_span, y0, method=m, **options) for m in (method, SCIPY[name]))


@pairs
@pytest.mark.parametrize("case", CASES)
def test_default_tolerances(name, method, case):
    ours, theirs = both(method, name, *CASES[case])
    assert theirs.success
    assert_same(ours, theirs, level(name, method))
    assert_same(*both(method, name, *CASES[case], dense_output=True), level(name, method))


@pairs
@pytest.mark.parametrize("case", CASES)
def test_tight_tolerances(name, method, case):
    rtol = {"RK23": 1e-6, "RK45": 1e-8, "DOP853": 1e-11}[name]
    ours, theirs = both(method, name, *CASES[case], rtol=rtol, atol=rtol * 1e-3)
    assert theirs.success
    if method is OURS[name]:
        assert_same(ours, theirs)
        return
    # Round-off may tip the scale of a step that is just accepted; the end is the same to the method's own error.
    assert abs(ours.nfev - theirs.nfev) <= 0.01 * theirs.nfev
    assert abs(len(ours.t) - len(theirs.t)) <= 0.01 * len(theirs.t)
    assert ours.t[-1] == theirs.t[-1]
    assert_close(ours.y[:, -1], theirs.y[:, -1], 10 * rtol)


OPTIONS = {
    "array rtol and atol": {"rtol": [1e-3, 1e-4, 1e-5, 1e-3], "atol": [1e-6, 1e-7, 1e-8, 1e-4]},
    "atol = 0": {"atol": 1e-30},
    "loose": {"rtol": 0.1, "atol": 0.1},
    "max_step": {"max_step": 0.05},
    "first_step": {"first_step": 0.01},
    "first_step too large": {"first_step": 10.0},
    "first_step and max_step": {"first_step": 1e-3, "max_step": 0.3},
    "integers": {"rtol": 1, "atol": 1, "max_step": 1, "first_step": 1},
    "t_eval": {"t_eval": np.linspace(0.0, 20.0, 33)},
    "t_eval inside": {"t_eval": [0.3, 0.31, 7.0, 19.999]},
    "t_eval and dense_output": {"t_eval": np.linspace(0.0, 20.0, 33), "dense_output": True},
}


@pairs
@pytest.mark.parametrize("option", OPTIONS)
def test_options(name, method, option):
    ours, theirs = both(method, name, *CASES["Kepler e=.6"], **OPTIONS[option])
    assert_same(ours, theirs, level(name, method))


def crossing(direction=0, terminal=False):
    def event(t, y):
        return y[0].real - 0.3

    event.direction, event.terminal = direction, terminal
    return event


@pairs
@pytest.mark.parametrize(("direction", "terminal"), [(0, False), (1, True), (-1, 2), (0, 3)])
@pytest.mark.parametrize("case", ["Kepler e=.6", "van der Pol", "complex", "backward Kepler", "driven rotor"])
def test_events(name, method, case, direction, terminal):
    events = [crossing(direction, terminal), lambda t, y: t - 4.0, crossing()]
    ours, theirs = both(method, name, *CASES[case], events=events)
    assert theirs.status == bool(terminal)
    assert sum(t.size for t in theirs.t_events) > 0
    assert_same(ours, theirs, level(name, method))


@pairs
def test_terminal_event_with_t_eval_on_an_endless_interval(name, method):
    fun, (t0, _), y0 = CASES["Kepler e=.6"]
    options = {"events": crossing(terminal=4), "t_eval": np.linspace(0.0, 100.0, 500), "dense_output": True}
    ours, theirs = both(method, name, fun, (t0, np.inf), y0, **options)
    assert theirs.status == 1
    assert_same(ours, theirs, level(name, method))


@pairs
def test_args(name, method):
    ours, theirs = both(method, name, van_der_pol, (0.0, 10.0), [2.0, 0.0], args=(3.0,))
    assert_same(ours, theirs, level(name, method))
    assert abs(ours.y[0, -1] - solve_ivp(van_der_pol, (0.0, 10.0), [2.0, 0.0], method=method).y[0, -1]) > 1e-3


@pairs
@pytest.mark.parametrize("case", ["van der Pol", "complex"])
def test_vectorized(name, method, case):
    _, t_span, y0 = CASES[case]

    def fun(t, y):
        assert y.ndim == 2
        if case == "complex":
            return np.vstack([-1j * y[0] + 0.5j * y[1], -2j * y[1] + 0.5j * y[0]])
        return np.vstack([y[1], 5 * (1 - y[0] ** 2) * y[1] - y[0]])

    ours, theirs = both(method, name, fun, t_span, y0, vectorized=True)
    assert_same(ours, theirs, level(name, method))


@pairs
def test_list_valued(name, method):
    ours, theirs = both(method, name, lambda t, y: [y[1], -y[0]], (0, 10), [1, 0], dense_output=True)
    assert_same(ours, theirs, level(name, method))


@pairs
def test_buffer_that_fun_reuses(name, method):
    """SciPy's classes give wrong results with it; ours must not."""
    buffer = np.zeros(4)

    def reusing(t, y):
        buffer[:] = orbit(t, y)
        return buffer

    _, t_span, y0 = CASES["Kepler e=.6"]
    ours = solve_ivp(reusing, t_span, y0, method=method)
    assert_same(ours, solve_ivp(orbit, t_span, y0, method=SCIPY[name]), level(name, method))


@pairs
@pytest.mark.parametrize("value", [lambda x: -x, lambda x: np.array(-x), lambda x: -float(x), lambda x: -1j * x])
def test_a_number_as_the_derivative_of_one_component(name, method, value):
    y0 = [1.0 + 0j] if np.iscomplexobj(value(1.0)) else [1.0]
    ours, theirs = both(method, name, lambda t, y: value(y[0]), (0.0, 2.0), y0)
    assert_same(ours, theirs, level(name, method))
    if not np.iscomplexobj(y0):
        run = integrate(lambda t, y: value(y[0]), (0.0, 2.0), y0, method=method, save_every=1, rtol=1e-3)
        np.testing.assert_allclose(run.y[0], np.exp(-run.t), rtol=0, atol=2e-3)


def test_a_number_for_two_components_is_refused():
    with pytest.raises(ValueError, match=r"fun returned shape \(\), expected \(2,\)"):
        solve_ivp(lambda t, y: -y[0], (0, 1), [1.0, 2.0], method=EIPRK45)


def test_a_number_as_the_acceleration_of_one_component():
    for method, options in ((EIPRK4, {"h": 0.1}), (EIPRKN12, {"h": 0.1, "variations": "state"})):
        one, two = (
            integrate(acceleration=a, t_span=(0, 1), y0=[1.0, 0.0], method=method, **options)
            for a in (lambda t, q: -q[0], lambda t, q: -q)
        )
        np.testing.assert_array_equal(one.y, two.y)
    np.testing.assert_array_equal(one.stm, two.stm)


@pairs
def test_failures(name, method):
    """A step size below the spacing of t fails at the same place."""
    with np.errstate(all="ignore"):
        ours, theirs = both(method, name, lambda t, y: y * y, (0.0, 2.0), [1.0])
    assert theirs.status == ours.status == -1
    assert ours.message == theirs.message == "Required step size is less than spacing between numbers."
    if method is OURS[name]:
        assert_same(ours, theirs)
    # At the pole the last digits of t decide on the number of steps.
    assert abs(len(ours.t) - len(theirs.t)) <= 0.05 * len(theirs.t)
    assert ours.t[-1] == pytest.approx(theirs.t[-1], abs=1e-12 + level(name, method))
    assert np.isfinite(ours.y).all()


@pairs
def test_first_steps_of_the_solver_object(name, method):
    """max_step below the spacing of t: the first step is taken, the second fails, with SciPy's own words."""
    solvers = [m(orbit, 5.0, pericentre(0.6), 9.0, max_step=1e-20) for m in (method, SCIPY[name])]
    for _ in range(2):
        messages = [solver.step() for solver in solvers]
        assert messages[0] == messages[1]
        assert solvers[0].status == solvers[1].status
        assert solvers[0].t == solvers[1].t
    assert solvers[0].status == "failed"
    assert solvers[0].t > 5.0


@pairs
def test_attributes_step_by_step(name, method):
    ours, theirs = (m(orbit, 0.0, pericentre(0.6), 5.0) for m in (method, SCIPY[name]))
    rtol = level(name, method)
    while theirs.status == "running":
        assert ours.status == "running"
        assert ours.step() == theirs.step()
        for key in ("t", "t_old", "step_size"):
            assert getattr(ours, key) == pytest.approx(getattr(theirs, key), rel=10 * rtol, abs=0)
        for key in ("n", "nfev", "njev", "nlu", "direction", "t_bound", "status"):
            assert getattr(ours, key) == getattr(theirs, key)
        assert_close(ours.y, theirs.y, rtol)
        mine, other = ours.dense_output(), theirs.dense_output()
        assert (mine.t_old, mine.t) == (ours.t_old, ours.t)
        t = 0.3 * theirs.t_old + 0.7 * theirs.t
        assert_close(mine(t), other(t), rtol)
    assert ours.status == "finished"


# `integrate` and the classes: the same steps, bit for bit, from the same jitted functions.


@njit
def jit_event(t, y):
    return y[0].real - 0.3


RUNS = {
    "orbit": (jit_orbit, (0.0, 15.0), pericentre(0.6), [JIT_H, JIT_L]),
    "backward": (jit_orbit, (2.0, -10.0), pericentre(0.6), [JIT_H, JIT_L]),
    "complex": (jit_spin, (0.0, 15.0), np.array([1.0 + 0j, 0.2j]), JIT_NORM),
    "complex backward": (jit_spin, (3.0, -18.0), np.array([1.0 + 0j, 0.2j]), JIT_NORM),
}
# Complex states have a separate driver.
runs = pytest.mark.parametrize(
    "case",
    [pytest.param(name, marks=[pytest.mark.nightly, pytest.mark.slow]) if "complex" in name else name for name in RUNS],
)
projected = pytest.mark.parametrize("projected", [True, False], ids=["projected", "plain"])
drivers = pytest.mark.parametrize(
    "compiled", [pytest.param(True, marks=pytest.mark.needs_jit), False], ids=["compiled", "interpreted"]
)
own = pytest.mark.parametrize("method", [*OWN.values(), EIPRK4], ids=lambda m: m.__name__)


def compare(run, sol, *, counts=True):
    """Results agree bit for bit."""
    assert run.status == sol.status
    np.testing.assert_array_equal(run.t, sol.t)
    np.testing.assert_array_equal(run.y, sol.y)
    if counts:
        assert (run.nfev, run.njev, run.nlu) == (sol.nfev, sol.njev, sol.nlu)


@drivers
@projected
@own
@runs
def test_integrate_takes_the_steps_of_the_class(case, method, projected, compiled):
    fun, t_span, y0, invariants = RUNS[case]
    options = {"invariants": invariants if projected else ()}
    d = Diagnostics()
    sol = solve_ivp(fun, t_span, y0, method=method, diagnostics=d, **options)
    run = integrate(fun, t_span, y0, method=method, save_every=1, compiled=compiled, **options)
    assert run.compiled is compiled
    assert len(sol.t) > 10
    compare(run, sol)
    np.testing.assert_array_equal(run.max_defect, d.max_defect)
    assert repr(run.diagnostics) == repr(d)
    assert run.h is None


@drivers
@pytest.mark.parametrize("method", [OWN["RK45"], EIPRK4], ids=lambda m: m.__name__)
def test_terminal_event_and_t_eval(method, compiled):
    """SciPy drops the samples after the event and does not add its state."""
    fun, (t0, _), y0, invariants = RUNS["orbit"]
    options = {"method": method, "invariants": invariants, "t_eval": np.linspace(0.0, 50.0, 301)}
    jit_event.terminal = 3
    try:
        sol = solve_ivp(fun, (t0, np.inf), y0, events=jit_event, **options)
        run = integrate(fun, (t0, np.inf), y0, events=jit_event, compiled=compiled, **options)
    finally:
        jit_event.terminal = False
    assert sol.status == 1
    assert 10 < len(sol.t) < 301
    np.testing.assert_array_equal(run.t, sol.t)
    assert_close(run.y, sol.y, 8 * EPS)
    for kind in ("t_events", "y_events"):
        assert_close(run[kind][0].T, sol[kind][0].T, ROOTS)
