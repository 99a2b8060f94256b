"""Dense output: exactly y_k at t_k, on the manifold in between, of SciPy's orders, and safe brackets for events."""

import functools
import math

import numpy as np
import pytest
from orders import observed_order
from scipy.integrate import solve_ivp
from systems import H_USES_F, H, L, energy, momentum, orbit, pericentre

from eip_scipy import EIPDOP853, EIPRK2, EIPRK4, EIPRK5, EIPRK23, EIPRK45, Invariant, eip_method, integrate
from eip_scipy.problems import solar_system

EPS = np.finfo(float).eps
PAIRS = [EIPRK23, EIPRK45, EIPDOP853]
OWN = {cls: eip_method(cls.TABLEAU) for cls in PAIRS}
pairs = pytest.mark.parametrize("method", PAIRS, ids=lambda m: m.__name__)
second_order = pytest.param(EIPRK2, marks=[pytest.mark.nightly, pytest.mark.slow])  # in thousands of steps
fifth_order = pytest.param(EIPRK5, marks=[pytest.mark.nightly, pytest.mark.slow])
every_class = pytest.mark.parametrize("method", [*PAIRS, second_order, EIPRK4, fifth_order], ids=lambda m: m.__name__)

Y0 = pericentre(0.6)
I0 = np.array([energy(0, Y0), momentum(0, Y0)])


def defects(y):
    """Return invariant errors of states (4, m)."""
    y = np.asarray(y).reshape(4, -1)
    return np.abs(np.array([energy(0, y), momentum(0, y)]) - I0[:, None])


def spin(t, y):
    """Three complex amplitudes under a Hermitian matrix and a cubic phase; the norm is kept."""
    return -1j * (np.array([0.3 * y[1], 0.3 * y[0] + 0.7j * y[2], -0.7j * y[1]]) + np.arange(3) * abs(y) ** 2 * y)


NORM = Invariant(lambda t, y: np.vdot(y, y).real, lambda t, y: 2 * y, name="N")
SPIN0 = np.array([0.8, 0.6j, 0.1 - 0.2j])

VARIANTS = {
    "plain": {"invariants": ()},
    "H": {"invariants": H},
    "H, L": {"invariants": [H, L]},
    "backward": {"invariants": [H, L], "t_span": (8.0, 0.0)},
    "uses_f": {"invariants": [H_USES_F, L]},
    "reuse_f off": {"invariants": [H, L], "reuse_f": False},
    "uses_f, reuse_f off": {"invariants": [H_USES_F, L], "reuse_f": False},
    "every 3": {"invariants": [H, L], "every": 3},
    "every 4, reuse_f off": {"invariants": [H, L], "every": 4, "reuse_f": False},
    "fixed": {"invariants": [H, L], "h": 0.07},
    "fixed, every 3": {"invariants": [H, L], "h": 0.07, "every": 3},
    "fixed, euclidean": {"invariants": [H, L], "h": 0.07, "metric": "euclidean"},
    "fixed, euclidean, uses_f": {"invariants": [H_USES_F, L], "h": 0.07, "metric": "euclidean"},
    "fixed, plain": {"h": 0.07},
    "blocks": {"invariants": [H, L], "blocks": 2},
    "blocks, backward": {"invariants": [H, L], "blocks": 2, "t_span": (8.0, 0.0)},
    "weights": {"invariants": [H, L], "metric": [1.0, 0.1, 2.0, 0.3]},
    "old": {"invariants": [H, L], "direction": "old"},
    "midpoint, 3 iterations": {"invariants": [H, L], "direction": "midpoint", "iterations": 3},
    "complex": {"invariants": NORM, "fun": spin, "y0": SPIN0},
    "complex backward": {"invariants": NORM, "fun": spin, "y0": SPIN0, "t_span": (8.0, 0.0)},
    "complex every 2": {"invariants": NORM, "fun": spin, "y0": SPIN0, "every": 2},
    "complex fixed": {"invariants": NORM, "fun": spin, "y0": SPIN0, "h": 0.1},
    "complex plain": {"fun": spin, "y0": SPIN0},
}


def solve(method, **options):
    options = {"fun": orbit, "t_span": (0.0, 8.0), "y0": Y0, "rtol": 1e-4, "atol": 1e-7, **options}
    fun, t_span, y0 = (options.pop(key) for key in ("fun", "t_span", "y0"))
    return solve_ivp(fun, t_span, y0, method=method, **options)


@functools.cache
def solved(method, variant):
    """Return a run whose dense output several tests use."""
    return solve(method, **VARIANTS[variant], dense_output=True)


def levels(invariants, sol):
    """Return values of the invariants at the steps (l, m)."""
    items = invariants if isinstance(invariants, (list, tuple)) else [invariants]
    return np.array([[item.fun(t, y) for t, y in zip(sol.t, sol.y.T, strict=True)] for item in items])


# At the steps, between them, beyond them.


@every_class
@pytest.mark.parametrize("variant", VARIANTS)
def test_exactly_the_steps(method, variant):
    sol = solved(method, variant)
    assert sol.status == 0
    assert len(sol.t) > 5
    for k, t in enumerate(sol.t):
        assert np.array_equal(sol.sol(t), sol.y[:, k]), f"step {k} of {len(sol.t)}"
    assert np.array_equal(sol.sol(sol.t), sol.y)
    # From the left and from the right: neighbours of a step share its value.
    for left, right, y in zip(sol.sol.interpolants, sol.sol.interpolants[1:], sol.y.T[1:-1], strict=False):
        assert left.t == right.t_old
        assert np.array_equal(left(left.t), y)
        assert np.array_equal(right(right.t_old), y)
    assert np.array_equal(sol.sol.interpolants[0](sol.t[0]), sol.y[:, 0])
    assert np.array_equal(sol.y[:, 0], VARIANTS[variant].get("y0", Y0))


@every_class
@pytest.mark.parametrize("variant", [name for name, options in VARIANTS.items() if options.get("invariants")])
def test_on_the_level_between_the_ends(method, variant):
    """The level is linear between the residuals at a step's ends, whatever they are."""
    options, sol = VARIANTS[variant], solved(method, variant)
    items = options["invariants"] if isinstance(options["invariants"], list) else [options["invariants"]]
    values = levels(items, sol)
    for k in np.unique(np.linspace(0, len(sol.t) - 2, 12).astype(int)):
        piece = sol.sol.interpolants[k]
        for share in (1e-9, 0.1, 0.5, 0.83, 1 - 1e-9):
            t = sol.t[k] + share * (sol.t[k + 1] - sol.t[k])
            found = np.array([item.fun(t, piece(t)) for item in items])
            level = (1 - share) * values[:, k] + share * values[:, k + 1]
            np.testing.assert_allclose(found, level, rtol=0, atol=2e-13 * (1 + np.abs(level).max()))


@pairs
def test_unprojected_interpolation_leaves_the_manifold(method):
    """Interpolation without projection leaves the manifold, which shows that the test above is able to fail."""
    sol = solve(method, dense_output=True)
    t = np.linspace(0, 8, 500)
    assert defects(sol.sol(t)).max() > 1e-5


@every_class
@pytest.mark.parametrize("variant", ["plain", "H, L", "backward", "complex", "every 3", "fixed", "uses_f"])
def test_scalar_and_array_times_agree(method, variant):
    sol = solved(method, variant)
    t = np.random.default_rng(0).permutation(np.linspace(sol.t[0], sol.t[-1], 60))
    together = sol.sol(t)
    assert together.shape == (len(sol.y), 60)
    assert together.dtype == sol.y.dtype
    for k in range(60):
        assert sol.sol(t[k]).shape == (len(sol.y),)
        np.testing.assert_allclose(sol.sol(t[k]), together[:, k], rtol=0, atol=3e-15)
    # The solution is a function: a second call returns the same values, and does not change the run's numbers.
    assert np.array_equal(sol.sol(t), together)


@every_class
@pytest.mark.parametrize("variant", VARIANTS)
def test_extrapolation_is_finite(method, variant):
    sol = solved(method, variant)
    t0, t1 = sorted((sol.t[0], sol.t[-1]))
    near = np.array([t0 - 0.01, t1 + 0.01])
    assert np.isfinite(sol.sol(near)).all()
    assert np.abs(sol.sol(near[0]) - sol.sol(t0)).max() < 0.1
    assert np.isfinite(sol.sol(np.array([t0 - 3.0, t1 + 3.0]))).all()


@pairs
def test_states_given_out_are_copies(method):
    sol = solve(method, invariants=[H, L], dense_output=True)
    keep = sol.y.copy()
    sol.sol(sol.t[3])[:] = 99.0
    sol.sol(sol.t)[:] = 99.0
    assert np.array_equal(sol.sol(sol.t), keep)
    assert np.array_equal(sol.y, keep)


@pairs
@pytest.mark.parametrize("invariants", [(), [H, L], [H_USES_F]], ids=["plain", "projected", "uses_f"])
def test_late_calls_do_not_disturb_a_running_solver(method, invariants):
    """A dense output that is kept and called while the solver continues gives the same steps, and the same values."""
    quiet, asked = (method(orbit, 0.0, Y0, 8.0, rtol=1e-4, invariants=invariants) for _ in range(2))
    pieces, at_once = [], []
    while asked.status == "running":
        quiet.step()
        asked.step()
        assert np.array_equal(quiet.y, asked.y)
        assert quiet.t == asked.t
        pieces.append(asked.dense_output())
        t = 0.4 * pieces[-1].t_old + 0.6 * pieces[-1].t
        at_once.append(pieces[-1](t))
        pieces[0](0.3 * pieces[0].t_old + 0.7 * pieces[0].t)
    assert quiet.status == "finished"
    for piece, y in zip(pieces, at_once, strict=True):
        assert np.array_equal(piece(0.4 * piece.t_old + 0.6 * piece.t), y)


# Order of the interpolants: SciPy's.


def interpolation_errors(method, h, t_span=(0.0, 1.0), **options):
    """Return the largest error anywhere, and at the steps, of fixed steps of size h."""
    problem = {"fun": orbit, "y0": Y0, **options}
    sol = solve(method, t_span=t_span, h=h, dense_output=True, **problem)
    t = np.unique(np.concatenate([np.linspace(*t_span, 400), sol.t]))[:: np.sign(t_span[1] - t_span[0]).astype(int)]
    exact = solve_ivp(problem["fun"], t_span, problem["y0"], method="DOP853", rtol=3e-14, atol=1e-16, t_eval=t)
    errors = np.abs(sol.sol(t) - exact.y).max(axis=0)
    return errors.max(), errors[np.isin(t, sol.t)].max()


ORDERS = [
    (EIPRK23, 3, (0.02, 0.01)),
    (EIPRK45, 4, (0.04, 0.02)),
    (EIPDOP853, 7, (0.1, 0.05)),
    (EIPRK4, 4, (0.02, 0.01)),
    (EIPRK5, 4, (0.02, 0.01)),
]
ORDER_OPTIONS = {
    "plain": {},
    "H, L": {"invariants": [H, L]},
    "H, L, reuse_f off": {"invariants": [H, L], "reuse_f": False},
    "uses_f": {"invariants": [H_USES_F]},
    "euclidean": {"invariants": [H, L], "metric": "euclidean"},
    "every 3": {"invariants": [H, L], "every": 3},
    "backward": {"invariants": [H, L], "t_span": (1.0, 0.0)},
    "complex": {"invariants": NORM, "fun": spin, "y0": SPIN0, "t_span": (0.0, 4.0)},
    "complex plain": {"fun": spin, "y0": SPIN0, "t_span": (0.0, 4.0)},
}


@pytest.mark.parametrize(("method", "order", "steps"), ORDERS, ids=[case[0].__name__ for case in ORDERS])
@pytest.mark.parametrize("option", ORDER_OPTIONS)
def test_order_of_interpolation(method, order, steps, option):
    factor = 4 if "complex" in option else 1
    coarse, fine = (interpolation_errors(method, factor * h, **ORDER_OPTIONS[option]) for h in steps)
    assert fine[0] > 1e-13, "too near to round-off to tell"
    found, of_steps = (math.log2(a / b) for a, b in zip(coarse, fine, strict=True))
    assert found > min(order, of_steps) - 0.3, (found, of_steps, coarse, fine)
    # The interpolant's own O(h^order), not far above that of the steps' plain method.
    plain = {key: value for key, value in ORDER_OPTIONS[option].items() if key in ("fun", "y0", "t_span")}
    assert fine[0] <= 2 * fine[1] + 4 * interpolation_errors(method, factor * steps[1], **plain)[0]


@pairs
def test_interpolation_is_as_good_as_scipy_s(method):
    """Errors between the steps of the plain method are within 1/3 of SciPy's own interpolants."""
    name = {EIPRK23: "RK23", EIPRK45: "RK45", EIPDOP853: "DOP853"}[method]
    t = np.linspace(0, 8, 997)
    exact = solve_ivp(orbit, (0, 8), Y0, method="DOP853", rtol=3e-14, atol=1e-16, t_eval=t).y
    theirs, own = (np.abs(solve(m, dense_output=True).sol(t) - exact).max() for m in (name, OWN[method]))
    assert own == pytest.approx(theirs, rel=0.05)
    # Projected, with the error of the earlier steps taken out: each piece from its own start, inside and at its end.
    inside, ends = {}, {}
    for label, options in (("plain", {"invariants": ()}), ("projected", {"invariants": [H, L]})):
        sol = solve(OWN[method], dense_output=True, **options)
        errors = np.array([piece_errors(piece, y) for piece, y in zip(sol.sol.interpolants, sol.y.T, strict=False)])
        inside[label], ends[label] = errors.max(axis=0)
    assert inside["projected"] < 2.5 * max(inside["plain"], ends["projected"])


def piece_errors(piece, y):
    """Return the largest error inside a step, and that at its end, of the flow from its start."""
    t = np.linspace(piece.t_old, piece.t, 9)
    exact = solve_ivp(orbit, (t[0], t[-1]), y, method="DOP853", rtol=1e-12, atol=1e-14, t_eval=t).y
    errors = np.abs(piece(t) - exact).max(axis=0)
    return errors.max(), errors[-1]


@every_class
def test_no_kink_inside_a_step(method):
    """Between steps the curve is smooth: second differences go with the square of the spacing."""
    sol = solve(method, invariants=[H, L], dense_output=True, rtol=1e-3)
    worst = 0.0
    for piece in sol.sol.interpolants:
        t = np.linspace(piece.t_old, piece.t, 33)
        y = piece(t)
        fine, coarse = (np.abs(np.diff(y[:, ::k], 2, axis=1)).max() for k in (1, 2))
        if fine > 1e-11:
            worst = max(worst, fine / coarse)
    assert worst > 0.0
    assert worst < 0.5


# Events near the ends of steps.


def thresholds(sol):
    """Component and value: thresholds within rounding of the steps' states, and at what SciPy's interpolant says."""
    steps = np.unique(np.linspace(1, len(sol.t) - 2, 10).astype(int))
    shifts = (0.0, EPS, -EPS, 1e-13, -1e-13, 1e-9, -1e-9, 1e-6, -1e-6, 5e-5, -5e-5)
    return [(i, sol.y[i, k] * (1 + shift), k) for k in steps for i in (0, 2) for shift in shifts]


def passing(component, value):
    def event(t, y):
        return y[component].real - value

    return event


LEVELS = {"default": {}, "backward": {"t_span": (8.0, 0.0)}, "every 3": {"every": 3}, "reuse_f off": {"reuse_f": False}}


@pytest.mark.slow
@pytest.mark.slow_without_jit
@pairs
@pytest.mark.parametrize("kind", LEVELS)
@pytest.mark.parametrize("rtol", [1e-4, pytest.param(1e-8, marks=[pytest.mark.nightly, pytest.mark.slow])])
def test_adversarial_thresholds(method, kind, rtol):
    """No event raises "f(a) and f(b) must have different signs", none is lost, and all are on the manifold."""
    options = {"invariants": [H, L], "rtol": rtol, "atol": rtol * 1e-3, **LEVELS[kind]}
    sol = solve(method, **options)
    cases = thresholds(sol)
    assert len(cases) >= 57
    events = [passing(i, value) for i, value, _ in cases]
    found = solve(method, **options, events=events)
    np.testing.assert_array_equal(found.y, sol.y)
    assert sum(len(t) > 0 for t in found.t_events) >= 57
    # The steps' own level: what they have left of the invariants (unprojected ones, of every k-th, included).
    level = defects(sol.y).max()
    if rtol == 1e-4 and "every" not in options:
        assert level <= 1e-7
    for (i, value, k), t, y in zip(cases, found.t_events, found.y_events, strict=True):
        signs = np.sign(sol.y[i] - value)
        crossings = np.count_nonzero(signs[:-1] * signs[1:] <= 0)
        assert len(t) == crossings, f"component {i} passes {value} at step {k}"
        y = y.reshape(-1, 4)
        # The correction itself carries round-off: residuals of eps, divided by gradients that are nearly dependent.
        assert np.abs(y[:, i] - value).max(initial=0.0) <= 1e-11
        assert defects(y.T).max(initial=0.0) <= max(level, 1e-14) * (1 + 1e-3) + 4e-15
        assert (np.diff(t) * np.sign(sol.t[-1] - sol.t[0]) >= 0).all()


@pairs
def test_thresholds_one_by_one_and_terminal(method):
    """As a terminal event each ends the run at its own place, exactly on the value."""
    options = {"invariants": [H, L]}
    sol = solve(method, **options)
    for i, value, k in thresholds(sol)[::4]:
        event = passing(i, value)
        event.terminal = True
        found = solve(method, **options, events=event)
        signs = np.sign(sol.y[i] - value)
        assert found.status == (signs[:-1] * signs[1:] <= 0).any(), f"component {i} passes {value} at step {k}"
        if found.status == 0:
            continue
        assert found.t[-1] == found.t_events[0][-1]
        assert np.array_equal(found.y[:, -1], found.y_events[0][-1])
        assert abs(found.y[i, -1] - value) <= 1e-13
        assert defects(found.y[:, -1]).max() <= 1e-7


@pytest.mark.parametrize("method", [*PAIRS, *OWN.values()], ids=lambda m: m.__name__)
@pytest.mark.parametrize(
    "variant", [pytest.param("plain", marks=[pytest.mark.nightly, pytest.mark.slow]), "complex plain"]
)
def test_thresholds_without_invariants(method, variant):
    """SciPy's own RK45 raises here: its interpolant misses the end of a step by an ulp."""
    sol = solve(method, **VARIANTS[variant])
    shifts = (0.0, EPS, -EPS, 1e-12, -1e-12)
    cases = [(i, sol.y[i, k].real * (1 + s)) for k in range(1, len(sol.t) - 1) for i in (0, 1, 2) for s in shifts]
    assert len(cases) >= 57
    found = solve(method, **VARIANTS[variant], events=[passing(i, value) for i, value in cases])
    np.testing.assert_array_equal(found.y, sol.y)
    assert sum(len(t) > 0 for t in found.t_events) >= 57


@pairs
def test_thresholds_for_complex_states(method):
    options = {"fun": spin, "y0": SPIN0, "invariants": NORM}
    sol = solve(method, **options)
    cases = [(i, sol.y[i, k].real * (1 + s), k) for k in range(1, len(sol.t) - 1) for i in (0, 1) for s in (0.0, 1e-9)]
    found = solve(method, **options, events=[passing(i, value) for i, value, _ in cases])
    for (i, value, _), t, y in zip(cases, found.t_events, found.y_events, strict=True):
        signs = np.sign(sol.y[i].real - value)
        assert len(t) == np.count_nonzero(signs[:-1] * signs[1:] <= 0)
        if len(t) == 0:
            continue
        assert np.abs(y[:, i].real - value).max() <= 1e-13
        assert np.abs((np.abs(y) ** 2).sum(axis=1) - NORM.fun(0, SPIN0)).max() <= 1e-7


@pairs
def test_an_invariant_as_an_event(method):
    """The energy itself against its own level: noise crosses it, and no bracket fails."""
    sol = solve(method, invariants=[H, L])
    at_steps = np.array([energy(t, y) for t, y in zip(sol.t, sol.y.T, strict=True)])
    events = [lambda t, y, k=k: energy(t, y) - at_steps[k] for k in range(0, len(sol.t), 3)]
    found = solve(method, invariants=[H, L], events=events)
    assert found.status == 0
    assert all(len(t) > 0 for t in found.t_events)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.slow_without_jit
@pairs
def test_adversarial_thresholds_of_integrate(method):
    options = {"method": method, "rtol": 1e-4, "atol": 1e-7, "invariants": [H, L], "save_every": 1}
    run = integrate(orbit, (0.0, 8.0), Y0, **options)
    cases = [(i, value, k) for i, value, k in thresholds(run) if i == 0]
    assert len(cases) >= 57
    crossed = 0
    for _, value, k in cases:
        found = integrate(orbit, (0.0, 8.0), Y0, events=passing(0, value), **options)
        np.testing.assert_array_equal(found.y, run.y)
        signs = np.sign(run.y[0] - value)
        signs = signs[signs != 0]  # a state on the threshold is one event, not one of each of its steps
        y = found.y_events[0].reshape(-1, 4)
        within_steps = len(y) - np.count_nonzero(signs[:-1] != signs[1:])
        assert within_steps in (0, 2), f"{value} at step {k}"  # twice within one step, around the next pericentre
        assert np.abs(y[:, 0] - value).max(initial=0.0) <= 1e-13
        assert defects(y.T).max(initial=0.0) <= 1e-7
        crossed += len(y) > 0
    assert crossed >= 57


# Samples on the manifold.


@pairs
def test_frame_and_blocks(method):
    """Planets: samples keep energy and angular momentum, and the frame's linear invariants to round-off."""
    problem = solar_system()
    options = {"invariants": problem.invariants, "blocks": problem.blocks, "frame": problem.frame}
    assert problem.frame is not None
    span = (0.0, 0.3)
    sol = solve(
        method, fun=problem.fun, y0=problem.y0, t_span=span, rtol=1e-7, atol=1e-10, dense_output=True, **options
    )
    assert sol.status == 0
    for k, t in enumerate(sol.t):
        assert np.array_equal(sol.sol(t), sol.y[:, k])
    t = np.linspace(*span, 301)
    y = sol.sol(t)
    C = np.atleast_2d(problem.frame[0])
    drift = np.abs(C @ y - (C @ sol.y[:, 0])[:, None])
    kept = np.abs(C @ sol.y - (C @ sol.y[:, 0])[:, None]).max()
    assert (drift <= kept + 1e-13 * np.abs(C).sum(axis=1, keepdims=True)).all() or drift.max() <= 1e-12
    for item in problem.invariants:
        at = np.array([np.atleast_1d(item.fun(s, row, *item.args)) for s, row in zip(t, y.T, strict=True)])
        steps = np.array([np.atleast_1d(item.fun(s, row, *item.args)) for s, row in zip(sol.t, sol.y.T, strict=True)])
        size = np.abs(at).max()
        assert np.abs(at - at[0]).max() <= np.abs(steps - steps[0]).max() + 1e-13 * size


@pytest.mark.parametrize(
    "blocks",
    [
        pytest.param(
            None, marks=pytest.mark.xfail(strict=True, reason="see test_order_of_the_solution_without_blocks")
        ),
        2,
    ],
)
@pytest.mark.parametrize(("method", "order", "steps"), [(EIPRK23, 3, 0.005), (EIPRK45, 5, 0.02)], ids=["RK23", "RK45"])
def test_order_of_the_projected_steps(method, order, steps, blocks):
    """Order p is kept, whatever the metric groups together."""
    exact = solve_ivp(orbit, (0, 1), Y0, method="DOP853", rtol=3e-14, atol=1e-16).y[:, -1]
    h = steps * 0.5 ** np.arange(3)
    options = {"invariants": [H, L], "t_span": (0.0, 1.0), "blocks": blocks}
    errors = [np.abs(solve(method, h=x, **options).y[:, -1] - exact).max() for x in h]
    assert observed_order(errors, h)[-1] > order - 0.2, errors
