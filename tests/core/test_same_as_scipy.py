"""Without invariants the adaptive pairs take the steps of SciPy's classes."""

import math

import numpy as np
import pytest
from scipy.integrate import DOP853, RK23, RK45, solve_ivp
from systems import orbit, pericentre, spin, van_der_pol

from eip_scipy import EIPDOP853, EIPRK23, EIPRK45, eip_method

SCIPY = {EIPRK23: RK23, EIPRK45: RK45, EIPDOP853: DOP853}
# Pairs with the package's own steps, whatever the classes do if nothing is projected.
OWN = {eip_method(cls.TABLEAU): theirs for cls, theirs in SCIPY.items()}
# How far the states may be apart. The estimate is a difference of terms h K_i, so round-off of them, eps h |f|, is a
# share eps h |f| / (estimate) of it, and 1/8 to 1/3 of that share goes into the next h. The estimate is 1e-3 to 1e-6
# with RK23 and RK45, but where the tolerance has left DOP853's step behind (its e5 is a high power of h) 1e-10
# and less; van der Pol's jumps then multiply a shift in time by another 1e3.
LEVEL = dict.fromkeys(SCIPY, 1e-12) | dict(zip(OWN, (1e-9, 1e-6, 2e-3), strict=True))
METHODS = SCIPY | OWN
pairs = pytest.mark.parametrize("method", METHODS, ids=lambda m: m.__name__)
KEPLER = orbit, (0.0, 20.0), pericentre(0.6)
CASES = {
    "Kepler e=.6": KEPLER,
    "Kepler e=.9": (orbit, (0.0, 7.0), pericentre(0.9)),
    "van der Pol": (van_der_pol, (0.0, 30.0), [2.0, 0.0]),
    "complex": (lambda t, y: spin(t, y) - 0.1 * abs(y) ** 2 * y, (0.0, 20.0), [1.0 + 0j, 0.2j, 0.1]),
    "driven rotor": (lambda t, y: np.array([y[1], -math.sin(y[0]) + 0.1 * math.cos(t)]), (-1.0, 20.0), [1.5, 0.0]),
    "backward Kepler": (orbit, (3.0, -20.0), pericentre(0.6)),
    "backward complex": (spin, (5.0, 0.0), [1.0 + 0j, 0.2j, 0.1]),
    "one component": (lambda t, y: np.array([math.cos(t) * y[0]]), (0.0, 10.0), [1.0]),
    "one component at zero": (lambda t, y: np.array([t]), (0.0, 10.0), [0.0]),
    "from rest": (lambda t, y: np.zeros(2), (0.0, 10.0), [1.0, -1.0]),
    "lists": (lambda t, y: [y[1], -y[0]], (0, 10), [1, 0]),
    "a number": (lambda t, y: -y[0], (0.0, 2.0), [1.0]),
    "a complex number": (lambda t, y: -1j * y[0], (0.0, 2.0), [1.0 + 0j]),
}


def crossing(direction=0, terminal=False):
    def event(t, y):
        return y[0].real - 0.3

    event.direction, event.terminal = direction, terminal
    return event


OPTIONS = {
    "array rtol and atol": {"rtol": [1e-3, 1e-4, 1e-5, 1e-3], "atol": [1e-6, 1e-7, 1e-8, 1e-4]},
    "atol = 0": {"atol": 1e-30},
    "loose": {"rtol": 0.1, "atol": 0.1},
    "max_step": {"max_step": 0.05},
    "first_step too large": {"first_step": 10.0},
    "first_step and max_step": {"first_step": 1e-3, "max_step": 0.3},
    "integers": {"rtol": 1, "atol": 1, "max_step": 1, "first_step": 1},
    "t_eval": {"t_eval": [0.3, 0.31, 7.0, 19.999]},
    "t_eval and dense_output": {"t_eval": np.linspace(0.0, 20.0, 33), "dense_output": True},
    "events": {"events": [crossing(), crossing(1), crossing(-1), lambda t, y: t - 4.0]},
    "first passage upward": {"events": [crossing(1, True), crossing()]},
    "second passage downward": {"events": [lambda t, y: t - 4.0, crossing(-1, 2)]},
    "third passage": {"events": crossing(0, 3), "t_eval": np.linspace(0.0, 20.0, 500), "dense_output": True},
}
CASES |= {f"Kepler, {name}": (*KEPLER, options) for name, options in OPTIONS.items()}
CASES["an endless interval"] = orbit, (0.0, np.inf), pericentre(0.6), {"events": crossing(terminal=4)}
CASES["complex events"] = *CASES["complex"], {"events": [crossing(), crossing(-1, True)]}
CASES["args"] = van_der_pol, (0.0, 10.0), [2.0, 0.0], {"args": (3.0,)}
CASES["vectorized"] = lambda t, y: np.vstack([y[1], -y[0] - y[0] ** 3]), (0, 9), [1.0, 0.0], {"vectorized": True}
CASES["vectorized complex"] = lambda t, y: np.vstack([-1j * y[1], -1j * y[0]]), (0, 9), [1j, 0], {"vectorized": True}


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
    assert_close(ours.t, theirs.t, rtol)
    assert_close(ours.y, theirs.y, rtol)
    assert (ours.t_events is None) == (theirs.t_events is None)
    for kind in ("t_events", "y_events") if theirs.t_events is not None else ():
        for mine, other in zip(ours[kind], theirs[kind], strict=True):
            assert_close(mine.T, other.T, rtol)
    if theirs.sol is not None:
        times = np.linspace(theirs.t[0], theirs.t[-1], 137)
        assert_close(ours.sol(times), theirs.sol(times), rtol)


def both(method, fun, t_span, y0, options=None, **more):
    """Return our result and SciPy's."""
    return (solve_ivp(fun, t_span, y0, method=m, **{**(options or {}), **more}) for m in (method, METHODS[method]))


@pairs
@pytest.mark.parametrize("case", CASES)
def test_a_run(method, case):
    ours, theirs = both(method, *CASES[case])
    assert theirs.success
    assert theirs.t_events is None or sum(t.size for t in theirs.t_events) > 0
    assert_same(ours, theirs, LEVEL[method])
    if "," not in case:
        assert_same(*both(method, *CASES[case], dense_output=True), LEVEL[method])


@pairs
def test_tight_tolerances(method):
    rtol = {RK23: 1e-6, RK45: 1e-8, DOP853: 1e-11}[METHODS[method]]
    for case in ("Kepler e=.6", "van der Pol", "complex", "driven rotor", "backward Kepler"):
        ours, theirs = both(method, *CASES[case], rtol=rtol, atol=rtol * 1e-3)
        assert theirs.success
        if method in SCIPY:
            assert_same(ours, theirs)
        # Round-off may tip the scale of a step that is just accepted; the end is the same to the method's own error.
        assert abs(ours.nfev - theirs.nfev) <= 0.01 * theirs.nfev
        assert abs(len(ours.t) - len(theirs.t)) <= 0.01 * len(theirs.t)
        assert ours.t[-1] == theirs.t[-1]
        assert_close(ours.y[:, -1], theirs.y[:, -1], 10 * rtol)


@pytest.mark.parametrize(
    ("fun", "options"),
    [
        (van_der_pol, {"rtol": [1e-6]}),
        (van_der_pol, {"max_step": math.nan}),
        (lambda t, y: np.full((1, 1), 0.5), {"vectorized": True}),
    ],
)
def test_unusual_values_that_scipy_takes(fun, options):
    for method in SCIPY:
        own, theirs = (solve_ivp(fun, (0, 3), [2.0, 0.0], method=m, **options) for m in (method, SCIPY[method]))
        np.testing.assert_array_equal(own.y, theirs.y)


@pairs
def test_failures(method):
    """A step size below the spacing of t fails at the same place."""
    with np.errstate(all="ignore"):
        ours, theirs = both(method, lambda t, y: y * y, (0.0, 2.0), [1.0])
    assert theirs.status == ours.status == -1
    assert ours.message == theirs.message == "Required step size is less than spacing between numbers."
    if method in SCIPY:
        assert_same(ours, theirs)
    # At the pole the last digits of t decide on the number of steps.
    assert abs(len(ours.t) - len(theirs.t)) <= 0.05 * len(theirs.t)
    assert ours.t[-1] == pytest.approx(theirs.t[-1], abs=1e-12 + LEVEL[method])
    assert np.isfinite(ours.y).all()
