"""Dense output: exactly y_k at t_k, on the manifold in between, safe brackets for events, and pickles."""

import copy
import functools
import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import H_USES_F, SPIN_NORM, SPIN_START, H, L, energy, momentum, orbit, pericentre, spin

import eip_scipy
from eip_scipy import EIPDOP853, EIPRK2, EIPRK4, EIPRK5, EIPRK23, EIPRK45, Invariant, integrate
from eip_scipy.problems import solar_system

EPS = np.finfo(float).eps
NIGHTLY = pytest.mark.nightly
PAIRS = [EIPRK23, EIPRK45, EIPDOP853]
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


@pytest.mark.parametrize(("method", "variant"), CASES)
def test_steps_and_what_is_between_and_beyond_them(method, variant):
    """States at the steps are exact, on the level in between, and a function of the time alone.

    The level is linear between the residuals at a step's ends, whatever they are.
    """
    items, sol = VARIANTS[variant]["invariants"], solved(method, variant)
    items = [items] if isinstance(items, Invariant) else items
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
    t = np.random.default_rng(0).permutation(np.linspace(sol.t[0], sol.t[-1], 60))
    together = sol.sol(t)
    assert together.shape == (len(sol.y), 60)
    assert together.dtype == sol.y.dtype
    np.testing.assert_allclose(np.array([sol.sol(s) for s in t]).T, together, rtol=0, atol=3e-15)
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


def thresholds(sol, shifts, components=(0, 2), most=10):
    """Return pairs (component, value): thresholds within some relative shifts of states at up to `most` steps."""
    steps = np.unique(np.linspace(1, len(sol.t) - 2, most).astype(int))
    return [(i, sol.y[i, k].real * (1 + shift)) for k in steps for i in components for shift in shifts]


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
    found = solve(method, **options, events=[lambda t, y, i=i, value=value: y[i].real - value for i, value in cases])
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


# Pickles have no functions of their run: the interpolant, whose samples are not projected.

TIMES = np.linspace(0, 3, 203)
PICKLED = {name: {"rtol": 1e-6, "atol": 1e-9} for name in ("EIPRK45", "EIPDOP853", "EIPRKN8", "EIPRKN12", "EIPRadau")}
PICKLED |= {"EIPRK4": {"h": 0.02}, "EIPGJ12": {"h": 0.008}, "EIPGJ14": {"h": 0.008}}


def runs(name, **options):
    options |= {"method": getattr(eip_scipy, name), "dense_output": True} | PICKLED[name]
    for solve in (integrate, eip_scipy.solve_ivp):
        yield solve(lambda t, y: orbit(t, y), (0, 3), Y0, **options)


@pytest.mark.parametrize("name", PICKLED)
def test_without_invariants_it_is_the_same(name):
    for run in runs(name):
        found = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(run.sol))))
        np.testing.assert_allclose(found(TIMES), run.sol(TIMES), rtol=1e-12, atol=1e-13)
        np.testing.assert_array_equal(found(run.sol.ts), run.sol(run.sol.ts))
        np.testing.assert_allclose(found(TIMES[5]), found(TIMES)[:, 5], rtol=1e-14, atol=1e-15)  # BLAS sums in two ways


@pytest.mark.parametrize("name", PICKLED)
def test_with_invariants_samples_are_not_projected(name):
    for run in runs(name, invariants=[H, L]):
        found, projected = pickle.loads(pickle.dumps(run.sol)), run.sol(TIMES)
        np.testing.assert_allclose(found(TIMES), projected, rtol=0, atol=1e-4)
        np.testing.assert_array_equal(found(run.sol.ts), run.sol(run.sol.ts))
        np.testing.assert_array_equal(copy.deepcopy(run.sol)(TIMES), projected)
        drift = [max(abs(energy(0, y) - energy(0, Y0)) for y in states.T) for states in (found(TIMES), projected)]
        assert drift[0] > drift[1] or name.startswith("EIPGJ")


@pytest.mark.parametrize("method", [EIPRK4, EIPRK45, EIPDOP853])
@pytest.mark.parametrize("factor", [1.0, 1j])
def test_complex_states_and_odd_numbers_of_components(method, factor):
    run = integrate(lambda t, y: factor * y, (0, 1), [1.0 * factor], method=method, dense_output=True, rtol=1e-6)
    np.testing.assert_allclose(pickle.loads(pickle.dumps(run.sol))(TIMES / 3), run.sol(TIMES / 3), rtol=1e-14)
