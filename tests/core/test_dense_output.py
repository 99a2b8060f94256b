"""Dense output: exactly y_k at t_k, on the manifold in between, of SciPy's orders, and safe brackets for events."""

import functools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import H_USES_F, SPIN_NORM, SPIN_START, H, L, energy, momentum, orbit, pericentre, spin

from eip_scipy import EIPDOP853, EIPRK2, EIPRK4, EIPRK5, EIPRK23, EIPRK45, Invariant, eip_method
from eip_scipy.problems import solar_system

EPS = np.finfo(float).eps
NIGHTLY = [pytest.mark.nightly, pytest.mark.slow]
PAIRS = [EIPRK23, EIPRK45, EIPDOP853]
OWN = {cls: eip_method(cls.TABLEAU) for cls in PAIRS}
pairs = pytest.mark.parametrize("method", PAIRS, ids=lambda m: m.__name__)

Y0 = pericentre(0.6)
I0 = np.array([energy(0, Y0), momentum(0, Y0)])
COMPLEX = {"invariants": SPIN_NORM, "fun": spin, "y0": SPIN_START}
VARIANTS = {
    "plain": {"invariants": ()},
    "H, L": {"invariants": [H, L]},
    "backward": {"invariants": [H, L], "t_span": (8.0, 0.0)},
    "uses_f, reuse_f off": {"invariants": [H_USES_F, L], "reuse_f": False},
    "every 3": {"invariants": [H, L], "every": 3},
    "every 4, reuse_f off": {"invariants": [H, L], "every": 4, "reuse_f": False},
    "fixed": {"invariants": [H, L], "h": 0.07},
    "fixed, every 3": {"invariants": [H, L], "h": 0.07, "every": 3},
    "fixed, euclidean, uses_f": {"invariants": [H_USES_F, L], "h": 0.07, "metric": "euclidean"},
    "blocks, backward": {"invariants": [H, L], "blocks": 2, "t_span": (8.0, 0.0)},
    "weights": {"invariants": H, "metric": [1.0, 0.1, 2.0, 0.3]},
    "midpoint, 3 iterations": {"invariants": [H, L], "direction": "midpoint", "iterations": 3},
    "complex": COMPLEX,
    "complex every 2, backward": {**COMPLEX, "every": 2, "t_span": (8.0, 0.0)},
    "complex plain": {**COMPLEX, "invariants": ()},
}
SOME = "H, L", "complex", "fixed, every 3"
CASES = [
    *((method, variant) for method in (EIPRK45, EIPDOP853) for variant in VARIANTS),
    *((method, variant) for method in (EIPRK23, EIPRK4) for variant in SOME),
    *(pytest.param(method, variant, marks=NIGHTLY) for method in (EIPRK2, EIPRK5) for variant in SOME),
]


def residuals(y):
    """Return invariant errors of states (4, m)."""
    y = np.asarray(y).reshape(4, -1)
    return np.abs(np.array([energy(0, y), momentum(0, y)]) - I0[:, None])


def solve(method, **options):
    options = {"fun": orbit, "t_span": (0.0, 8.0), "y0": Y0, "rtol": 1e-4, "atol": 1e-7, **options}
    fun, t_span, y0 = (options.pop(key) for key in ("fun", "t_span", "y0"))
    return solve_ivp(fun, t_span, y0, method=method, **options)


@functools.cache
def solved(method, variant):
    """Return a run whose dense output several tests use."""
    return solve(method, **VARIANTS[variant], dense_output=True)


def items_of(variant):
    given = VARIANTS[variant]["invariants"]
    return [given] if isinstance(given, Invariant) else given


# At the steps, between them, beyond them.


@pytest.mark.parametrize(("method", "variant"), CASES)
def test_exactly_the_steps(method, variant):
    sol = solved(method, variant)
    assert sol.status == 0
    assert len(sol.t) > 5
    np.testing.assert_array_equal(np.array([sol.sol(t) for t in sol.t]).T, sol.y)
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    # From the left and from the right: neighbours of a step share its value.
    for left, right, y in zip(sol.sol.interpolants, sol.sol.interpolants[1:], sol.y.T[1:-1], strict=False):
        assert left.t == right.t_old
        np.testing.assert_array_equal(left(left.t), y)
        np.testing.assert_array_equal(right(right.t_old), y)
    np.testing.assert_array_equal(sol.sol.interpolants[0](sol.t[0]), VARIANTS[variant].get("y0", Y0))
    sol.sol(sol.t)[:] = 99.0  # states that are given out are copies
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)


@pytest.mark.parametrize(("method", "variant"), CASES)
def test_on_the_level_between_the_ends(method, variant):
    """The level is linear between the residuals at a step's ends, whatever they are."""
    items, sol = items_of(variant), solved(method, variant)
    for k in np.unique(np.linspace(0, len(sol.t) - 2, 12).astype(int)):
        piece = sol.sol.interpolants[k]
        ends = [[item.fun(sol.t[j], sol.y[:, j]) for item in items] for j in (k, k + 1)]
        for share in (1e-9, 0.1, 0.5, 0.83, 1 - 1e-9):
            t = sol.t[k] + share * (sol.t[k + 1] - sol.t[k])
            level = (1 - share) * np.array(ends[0]) + share * np.array(ends[1])
            found = np.array([item.fun(t, piece(t)) for item in items])
            np.testing.assert_allclose(found, level, rtol=0, atol=2e-13 * (1 + np.abs(level).max(initial=0.0)))
    if not items and np.isrealobj(sol.y):  # the test above is able to fail
        assert residuals(sol.sol(np.linspace(*sol.t[[0, -1]], 500))).max() > 1e-5 * (method is not EIPDOP853)


@pytest.mark.parametrize(("method", "variant"), CASES)
def test_a_function_of_the_time_also_beyond_the_ends(method, variant):
    sol = solved(method, variant)
    t = np.random.default_rng(0).permutation(np.linspace(sol.t[0], sol.t[-1], 60))
    together = sol.sol(t)
    assert together.shape == (len(sol.y), 60)
    assert together.dtype == sol.y.dtype
    np.testing.assert_allclose(np.array([sol.sol(s) for s in t]).T, together, rtol=0, atol=3e-15)
    np.testing.assert_array_equal(sol.sol(t), together)
    low, high = sorted((sol.t[0], sol.t[-1]))
    assert np.abs(sol.sol(low - 0.01) - sol.sol(low)).max() < 0.1
    assert np.isfinite(sol.sol(np.array([low - 3.0, low - 0.01, high + 0.01, high + 3.0]))).all()


@pairs
@pytest.mark.parametrize("invariants", [(), [H, L], [H_USES_F]], ids=["plain", "projected", "uses_f"])
def test_late_calls_do_not_disturb_a_running_solver(method, invariants):
    """A dense output that is kept and called while the solver continues gives the same steps, and the same values."""
    quiet, asked = (method(orbit, 0.0, Y0, 8.0, rtol=1e-4, invariants=invariants) for _ in range(2))
    pieces, at_once = [], []
    while asked.status == "running":
        quiet.step()
        asked.step()
        np.testing.assert_array_equal(quiet.y, asked.y)
        assert quiet.t == asked.t
        pieces.append(asked.dense_output())
        at_once.append(pieces[-1](0.4 * pieces[-1].t_old + 0.6 * pieces[-1].t))
        pieces[0](0.3 * pieces[0].t_old + 0.7 * pieces[0].t)
    assert quiet.status == "finished"
    for piece, y in zip(pieces, at_once, strict=True):
        np.testing.assert_array_equal(piece(0.4 * piece.t_old + 0.6 * piece.t), y)


# Order of the interpolants: SciPy's.


def interpolation_errors(method, h, t_span=(0.0, 1.0), **options):
    """Return the largest error anywhere, and at the steps, of fixed steps of size h."""
    problem = {"fun": orbit, "y0": Y0, **options}
    sol = solve(method, t_span=t_span, h=h, dense_output=True, **problem)
    t = np.unique(np.concatenate([np.linspace(*t_span, 400), sol.t]))[:: np.sign(t_span[1] - t_span[0]).astype(int)]
    exact = solve_ivp(problem["fun"], t_span, problem["y0"], method="DOP853", rtol=3e-14, atol=1e-16, t_eval=t)
    errors = np.abs(sol.sol(t) - exact.y).max(axis=0)
    return errors.max(), errors[np.isin(t, sol.t)].max()


ORDER_OPTIONS = {
    "plain": {},
    "H, L, reuse_f off": {"invariants": [H, L], "reuse_f": False},
    "every 3, euclidean": {"invariants": [H_USES_F, L], "metric": "euclidean", "every": 3},
    "backward": {"invariants": [H, L], "t_span": (1.0, 0.0)},
    "complex": {**COMPLEX, "t_span": (0.0, 4.0)},
}


@pytest.mark.parametrize(
    ("method", "order", "h"), [(EIPRK23, 3, 0.02), (EIPRK45, 4, 0.04), (EIPDOP853, 7, 0.1), (EIPRK4, 4, 0.02)]
)
@pytest.mark.parametrize("option", ORDER_OPTIONS)
def test_order_of_interpolation(method, order, h, option):
    h, options = h * (4 if option == "complex" else 1), ORDER_OPTIONS[option]
    coarse, fine = (interpolation_errors(method, step, **options) for step in (h, h / 2))
    assert fine[0] > 1e-13, "too near to round-off to tell"
    found, of_steps = (math.log2(a / b) for a, b in zip(coarse, fine, strict=True))
    assert found > min(order, of_steps) - 0.3, (found, of_steps, coarse, fine)
    # The interpolant's own O(h^order), not far above that of the steps' plain method.
    plain = {key: value for key, value in options.items() if key in ("fun", "y0", "t_span")}
    assert fine[0] <= 2 * fine[1] + 4 * interpolation_errors(method, h / 2, **plain)[0]


@pairs
def test_interpolation_is_as_good_as_scipy_s(method):
    """Errors between the steps of the plain method are SciPy's, and a projected piece is not much worse than a step."""
    name = method.__name__.removeprefix("EIP")
    t = np.linspace(0, 8, 997)
    exact = solve_ivp(orbit, (0, 8), Y0, method="DOP853", rtol=3e-14, atol=1e-16, t_eval=t).y
    theirs, own = (np.abs(solve(m, dense_output=True).sol(t) - exact).max() for m in (name, OWN[method]))
    assert own == pytest.approx(theirs, rel=0.05)
    (inside, _), (projected, end) = (
        np.max([piece_errors(*pair) for pair in zip(sol.sol.interpolants, sol.y.T, strict=False)], axis=0)
        for sol in (solve(OWN[method], dense_output=True, invariants=items) for items in ((), [H, L]))
    )
    assert projected < 2.5 * max(inside, end)


def piece_errors(piece, y):
    """Return the largest error inside a step, and that at its end, of the flow from its start."""
    t = np.linspace(piece.t_old, piece.t, 9)
    exact = solve_ivp(orbit, (t[0], t[-1]), y, method="DOP853", rtol=1e-12, atol=1e-14, t_eval=t).y
    errors = np.abs(piece(t) - exact).max(axis=0)
    return errors.max(), errors[-1]


# Events near the ends of steps.


def thresholds(sol, shifts, components=(0, 2), most=10):
    """Return pairs (component, value): thresholds within some relative shifts of states at up to `most` steps."""
    steps = np.unique(np.linspace(1, len(sol.t) - 2, most).astype(int))
    return [(i, sol.y[i, k].real * (1 + shift)) for k in steps for i in components for shift in shifts]


def passing(component, value):
    return lambda t, y: y[component].real - value


SHIFTS = (0.0, EPS, -EPS, 1e-13, -1e-13, 1e-9, -1e-9, 1e-6, -1e-6, 5e-5, -5e-5)
LEVELS = {"default": {}, "backward": {"t_span": (8.0, 0.0)}, "every 3": {"every": 3}, "reuse_f off": {"reuse_f": False}}


@pytest.mark.slow
@pytest.mark.slow_without_jit
@pairs
@pytest.mark.parametrize("kind", LEVELS)
@pytest.mark.parametrize("rtol", [1e-4, pytest.param(1e-8, marks=NIGHTLY)])
def test_adversarial_thresholds(method, kind, rtol):
    """No event raises "f(a) and f(b) must have different signs", none is lost, and all are on the manifold."""
    options = {"invariants": [H, L], "rtol": rtol, "atol": rtol * 1e-3, **LEVELS[kind]}
    sol = solve(method, **options)
    cases = thresholds(sol, SHIFTS)
    found = solve(method, **options, events=[passing(*case) for case in cases])
    np.testing.assert_array_equal(found.y, sol.y)
    assert sum(len(t) > 0 for t in found.t_events) >= 57
    # The steps' own level: what they have left of the invariants (unprojected ones, of every k-th, included).
    level = residuals(sol.y).max()
    assert level <= 1e-7 or rtol != 1e-4 or "every" in options
    for (i, value), t, y in zip(cases, found.t_events, found.y_events, strict=True):
        signs = np.sign(sol.y[i] - value)
        assert len(t) == np.count_nonzero(signs[:-1] * signs[1:] <= 0), f"component {i} passes {value}"
        y = y.reshape(-1, 4)
        # The correction itself carries round-off: residuals of eps, divided by gradients that are nearly dependent.
        assert np.abs(y[:, i] - value).max(initial=0.0) <= 1e-11
        assert residuals(y.T).max(initial=0.0) <= max(level, 1e-14) * (1 + 1e-3) + 4e-15
        assert (np.diff(t) * np.sign(sol.t[-1] - sol.t[0]) >= 0).all()


@pairs
def test_thresholds_as_terminal_events(method):
    """Each ends the run at its own place, exactly on the value."""
    sol = solve(method, invariants=[H, L])
    for i, value in thresholds(sol, SHIFTS)[::4]:
        event = passing(i, value)
        event.terminal = True
        found = solve(method, invariants=[H, L], events=event)
        signs = np.sign(sol.y[i] - value)
        assert found.status == (signs[:-1] * signs[1:] <= 0).any(), f"component {i} passes {value}"
        if found.status:
            assert found.t[-1] == found.t_events[0][-1]
            np.testing.assert_array_equal(found.y[:, -1], found.y_events[0][-1])
            assert abs(found.y[i, -1] - value) <= 1e-13
            assert residuals(found.y[:, -1]).max() <= 1e-7


@pytest.mark.parametrize("method", [*PAIRS, *OWN.values()], ids=lambda m: m.__name__)
@pytest.mark.parametrize("variant", [pytest.param("plain", marks=NIGHTLY), "complex plain"])
def test_thresholds_without_invariants(method, variant):
    """SciPy's own RK45 raises here: its interpolant misses the end of a step by an ulp."""
    sol = solve(method, **VARIANTS[variant])
    cases = thresholds(sol, (0.0, EPS, -EPS, 1e-12, -1e-12), (0, 1, 2), len(sol.t))
    found = solve(method, **VARIANTS[variant], events=[passing(*case) for case in cases])
    np.testing.assert_array_equal(found.y, sol.y)
    assert sum(len(t) > 0 for t in found.t_events) >= 57


@pairs
def test_an_invariant_as_an_event(method):
    """The energy itself against its own level: noise crosses it, and no bracket fails."""
    sol = solve(method, invariants=[H, L])
    events = [lambda t, y, start=start: energy(t, y) - energy(t, start) for start in sol.y.T[::3]]
    found = solve(method, invariants=[H, L], events=events)
    assert found.status == 0
    assert all(len(t) > 0 for t in found.t_events)


# Samples on the manifold.


@pairs
def test_frame_and_blocks(method):
    """Planets: samples keep energy and angular momentum, and the frame's linear invariants to round-off."""
    problem = solar_system()
    options = {
        "invariants": problem.invariants,
        "blocks": problem.blocks,
        "linear_invariants": problem.linear_invariants,
    }
    options |= {"fun": problem.fun, "y0": problem.y0, "t_span": (0.0, 0.3), "rtol": 1e-7, "atol": 1e-10}
    sol = solve(method, dense_output=True, **options)
    assert sol.status == 0
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    y = sol.sol(np.linspace(0.0, 0.3, 301))
    C = np.atleast_2d(problem.linear_invariants[0])
    between, at_steps = (np.abs(C @ (states - problem.y0[:, None])).max() for states in (y, sol.y))
    assert between <= max(at_steps + 1e-13 * np.abs(C).sum(axis=1).max(), 1e-12)
    for item in problem.invariants:
        between, at_steps = (
            np.array([np.atleast_1d(item.fun(0.0, state, *item.args)) for state in states.T]) for states in (y, sol.y)
        )
        assert np.abs(between - between[0]).max() <= np.ptp(at_steps, axis=0).max() + 1e-13 * np.abs(between).max()
