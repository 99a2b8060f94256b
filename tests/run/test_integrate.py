"""`integrate`: saved and returned values, counts, interpolation, compensation, computed gradients, and checks."""

import math
from itertools import product

import mpmath
import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import SQUARE, oscillator, pendulum, pendulum_energy, pendulum_gradient

import eip_scipy
from eip_scipy import EIPRK2, EIPRK3, EIPRK4, EIPRK5, Diagnostics, Invariant, check_gradient, integrate, project
from eip_scipy.problems import Problem, kepler

EPS = np.finfo(float).eps
Y0 = np.array([1.0, 2.0])


def exact(t):
    return np.array([np.cos(t) + 2 * np.sin(t), 2 * np.cos(t) - np.sin(t)])


PAIR = Invariant(lambda t, y: np.array([y @ y, y @ y + 1]), lambda t, y: np.array([2 * y, 2 * y]), name="P")


def run(t_span=(0, 1), y0=Y0, fun=oscillator, **options):
    return integrate(fun, t_span, y0, **{"method": EIPRK4, "h": 0.1, **options})


@pytest.mark.parametrize("t_span", [(0.0, 1.0), (1.0, 0.0)])
def test_save_every(t_span):
    every = run(t_span, save_every=1, invariants=SQUARE)
    for number, steps in ((None, [0, 10]), (3, [0, 3, 6, 9, 10]), (5, [0, 5, 10]), (99, [0, 10])):
        some = run(t_span, save_every=number, invariants=SQUARE)
        np.testing.assert_array_equal(some.t, every.t[steps])
        np.testing.assert_array_equal(some.y, every.y[:, steps])
        np.testing.assert_array_equal(some.invariants, every.invariants[:, steps])
        assert some.t[-1] == t_span[1]


FAR = 2.2e11  # where times are 3e-5 apart
SECOND = {"fun": None, "acceleration": lambda t, q: -q}
WAYS = [(EIPRK5, {}), (EIPRK4, {}), (eip_scipy.EIPRKN12, SECOND), (eip_scipy.EIPGJ12, SECOND)]


@pytest.mark.parametrize(("method", "how"), WAYS, ids=[method.__name__ for method, _ in WAYS])
def test_an_autonomous_system_does_not_see_the_time(method, how):
    """The lengths of steps, of the last one too, are not differences of times, which have lost their last digits."""
    options = {"fun": oscillator, "method": method, "h": 0.02, "check": False, "save_every": 100, **how}
    for t0, length in ((FAR, 19.875), (FAR, 0.125), (-FAR / 8, 20.0)):
        end = float(t0 + length)
        far = integrate(t_span=(t0, end), y0=Y0, **options)
        np.testing.assert_allclose(far.y[:, -1], exact(end - t0), rtol=0, atol=2e-7 if method is EIPRK4 else 1e-9)
        near = integrate(t_span=(0.0, end - t0), y0=Y0, **options)
        np.testing.assert_allclose(far.y[:, -1], near.y[:, -1], rtol=0, atol=1e-14)
        assert far.t[-1] == end
        members = eip_scipy.ensemble(t_span=(t0, end), y0s=np.tile(Y0, (8, 1)), **options)
        np.testing.assert_array_equal(members.y[3], far.y[:, -1])


@pytest.mark.parametrize("t_span", [(0.0, 1.0), (1.0, 0.0), (-0.3, 0.75)])
def test_t_eval_meets_both_ends_exactly(t_span):
    times = np.linspace(*t_span, 23)
    result = run(t_span, t_eval=times, invariants=SQUARE)
    np.testing.assert_array_equal(result.t, times)
    np.testing.assert_array_equal(result.y[:, 0], Y0)
    np.testing.assert_array_equal(result.y[:, -1], run(t_span, invariants=SQUARE).y[:, -1])
    np.testing.assert_allclose(result.y, exact(times - t_span[0]), atol=3e-6)
    (inside,) = times[10:11]
    alone = run(t_span, t_eval=[inside], invariants=SQUARE)
    np.testing.assert_array_equal(alone.y[:, 0], result.y[:, 10])
    assert (alone.t.tolist(), alone.status, alone.nfev) == ([inside], 0, run(t_span, invariants=SQUARE).nfev)


@pytest.mark.parametrize(
    "options", [{"save_every": 2}, {"t_eval": np.linspace(0, 1, 21)}, {"t_eval": [0.0, 0.37, 0.41, 0.9]}]
)
def test_callback_sees_the_saved_points_and_stops_the_run(options):
    """The last point is the one at which the callback stopped the run."""
    seen = []

    def callback(t, y, residuals):
        seen.append((t, y.copy(), residuals.copy()))
        y[:], residuals[:] = 1e9, 1e9  # cannot spoil the run
        return np.bool_(t >= 0.35)

    options = options | {"invariants": SQUARE, "h": 0.25 if "t_eval" in options else 0.1}
    result, whole = run(callback=callback, **options), run(**options)
    assert (result.status, result.success, result.message[:23]) == (1, True, "stopped by the callback")
    assert result.t.tolist() == [t for t, _, _ in seen] == whole.t[: len(seen)].tolist()
    assert 0.35 <= result.t[-1] < 0.5
    np.testing.assert_array_equal(result.y, whole.y[:, : len(seen)])
    np.testing.assert_array_equal([y for _, y, _ in seen], result.y.T)
    np.testing.assert_array_equal([d for _, _, d in seen], (result.invariants - 5.0).T)
    assert run(callback=lambda t, y, residuals: True).t.tolist() == [0.0]


@pytest.mark.parametrize(
    "options", [{"h": 0.01}, {"method": eip_scipy.EIPRK45, "h": None, "max_step": 0.01, "rtol": 1e-3}]
)
def test_a_callback_at_every_step(options):
    """Also in endless runs, and in runs of more steps than there are doublings of a float's range."""
    seen = []
    result = run((0, 12), save_every=1, callback=lambda t, y, residuals: seen.append(t), invariants=SQUARE, **options)
    assert result.t.size >= 1200
    assert seen == result.t.tolist()
    endless = run((0, math.inf), save_every=5, callback=lambda t, y, residuals: t > 3, invariants=SQUARE, **options)
    assert endless.status == 1
    assert 3 < endless.t[-1] <= 3.06
    np.testing.assert_allclose(endless.y, exact(endless.t), atol=1e-3)
    stop = {"callback": lambda t, y, residuals: t > 3}
    for without in (stop, stop | {"t_eval": [1.0, 2.0]}, {"save_every": 1}):  # it would not be called to the end
        with pytest.raises(ValueError, match=r"t_span must be finite unless .*callback.*save_every"):
            run((0, math.inf), **without)


def test_params_reach_every_function():
    seen = set()

    def noted(name, value):
        return lambda t, y, *args: seen.add((name, *args[:-1], *args[-1].tolist())) or args[-1][0] * value(t, y)

    kept = Invariant(noted("value", SQUARE.fun), noted("grad", SQUARE.grad), args=("extra",))
    result = run((0, 0.5), fun=noted("fun", oscillator), params=[2.0, 3.0], invariants=kept, h=0.05)
    assert seen == {("fun", 2.0, 3.0), ("value", "extra", 2.0, 3.0), ("grad", "extra", 2.0, 3.0)}
    np.testing.assert_allclose(result.y[:, -1], exact(1.0), atol=1e-5)
    assert result.invariants[0, 0] == 10.0


def test_params_override_the_problem_s_everywhere():
    """The parameters are replaced in the equations and in the invariants; otherwise H would not be kept."""
    problem = kepler(0.6, 0.0)
    stronger = integrate(problem, (0, 5), method=EIPRK4, params=[0.05], h=0.01)
    same = integrate(kepler(0.6, 0.05), (0, 5), method=EIPRK4, h=0.01)
    assert stronger.status == 0
    np.testing.assert_allclose(stronger.y, same.y, rtol=0, atol=1e-14)
    np.testing.assert_allclose(stronger.invariants, same.invariants, rtol=0, atol=1e-14)
    assert (stronger.max_residual < 1e-12).all()


def test_problem_s_metric_blocks_and_frame_are_used():
    blocks, frame = [[0, 1]], (np.array([[1.0, 0.0]]), np.array([[1.0], [0.0]]))
    for name, value_of in (("metric", "euclidean"), ("blocks", blocks), ("linear_invariants", frame)):
        problem = Problem("p", oscillator, Y0, (0.0, 1.0), invariants=(SQUARE,), h=0.25, **{name: value_of})
        given = run(h=0.25, invariants=SQUARE, **{name: value_of})
        np.testing.assert_array_equal(integrate(problem, method=EIPRK4).y, given.y)
        assert (given.y[:, -1] != run(h=0.25, invariants=SQUARE).y[:, -1]).any()
        np.testing.assert_array_equal(
            integrate(problem, method=EIPRK4, **{name: None}).y, run(h=0.25, invariants=SQUARE).y
        )


F_SQUARE = Invariant(lambda t, y: y @ y, lambda t, y, f: 2 * np.array([-f[1], f[0]]), uses_f=True, name="S")
N, WIDE = 10, 0.3
FORMULAS = [
    # method, options, nfev per step, njev per step, nlu per step
    (EIPRK4, {}, 4, 0, 0),
    (EIPRK5, {}, 6, 0, 0),
    (EIPRK3, {"invariants": SQUARE}, 3, 1, 1),
    (EIPRK5, {"invariants": SQUARE}, 6, 1, 1),
    # RK4's estimate needs f at the raw result, which serves the next step too.
    (EIPRK4, {"invariants": SQUARE}, 4, 1, 1),
    (EIPRK4, {"invariants": SQUARE, "reuse_f": False}, 5, 1, 1),
    (EIPRK4, {"invariants": SQUARE, "metric": "euclidean"}, 4, 1, 1),
    (EIPRK4, {"invariants": SQUARE, "metric": "euclidean", "reuse_f": False}, 4, 1, 1),
    # So does a gradient that uses f.
    (EIPRK4, {"invariants": F_SQUARE}, 4, 1, 1),
    (EIPRK3, {"invariants": F_SQUARE}, 3, 1, 1),
    (EIPRK3, {"invariants": F_SQUARE, "reuse_f": False}, 4, 1, 1),
    (EIPRK4, {"invariants": F_SQUARE, "metric": "euclidean"}, 4, 1, 1),
    (EIPRK4, {"invariants": F_SQUARE, "metric": "euclidean", "reuse_f": False}, 5, 1, 1),
    # Each Newton step takes a gradient (with f there) and a factorisation.
    (EIPRK2, {"invariants": SQUARE, "iterations": 2}, 2, 2, 2),
    (EIPRK2, {"invariants": F_SQUARE, "iterations": 2}, 3, 2, 2),
    # Other directions need one more gradient, and a small Newton system in addition to their factorisation.
    (EIPRK4, {"invariants": SQUARE, "direction": "old"}, 4, 2, 2),
    (EIPRK4, {"invariants": SQUARE, "direction": "midpoint"}, 4, 2, 2),
    (EIPRK4, {"invariants": F_SQUARE, "direction": "midpoint"}, 5, 2, 2),
    (EIPRK4, {"invariants": F_SQUARE, "direction": "old"}, 4, 2, 2),
]


@pytest.mark.filterwarnings("ignore:.*not to be trusted:eip_scipy.ProjectionWarning")
def test_counts_by_formula():
    for solve, (method, options, nfev, njev, nlu) in product((integrate, solve_ivp), FORMULAS):
        calls, given = [], {"h": WIDE, "method": method, "check": False, **options}
        found = solve(lambda t, y, c=calls: c.append(t) or oscillator(t, y), (0, N * WIDE), Y0, **given)
        assert (found.nfev, found.njev, found.nlu) == (1 + nfev * N, njev * N, nlu * N), (method, options)
        assert len(calls) == found.nfev


def test_counts_of_spaced_projections():
    for every, reuse in product((2, 3, 10, 11), (True, False)):
        projected = N // every + (N % every > 0)
        result = run((0, N * WIDE), h=WIDE, invariants=SQUARE, every=every, reuse_f=reuse)
        assert result.njev == result.nlu == result.diagnostics.n_projections == projected
        assert result.nfev == 1 + 4 * N + (0 if reuse else projected)


def test_diagnostics_are_filled():
    diagnostics = Diagnostics()
    result = run(invariants=[SQUARE, PAIR], diagnostics=diagnostics, save_every=1)
    assert result.diagnostics is diagnostics
    assert diagnostics.n_projections == 10
    assert diagnostics.n_rank_reduced == 10
    assert (diagnostics.n_skipped, diagnostics.n_rejected_projections) == (0, 0)
    np.testing.assert_array_equal(diagnostics.max_residual, result.max_residual)
    last = np.abs(result.invariants[:, -1] - [5.0, 5.0, 6.0])
    np.testing.assert_array_equal(diagnostics.last_residual, last)
    assert 0 < diagnostics.max_correction < 5
    text = repr(diagnostics)
    assert "10 projections" in text
    assert all(name in text for name in ("S", "P[0]", "P[1]"))
    assert len(text.splitlines()) == 5
    assert repr(Diagnostics()) == "Diagnostics: no invariants"
    assert math.isnan(Diagnostics().max_correction)


def test_max_residual_is_that_of_the_steps():
    """Every step counts, saved or not; interpolated states are not steps."""
    options = {"h": 0.25, "invariants": SQUARE, "method": EIPRK2}
    every, ends = run(save_every=1, **options), run(**options)
    assert every.max_residual == ends.max_residual == np.abs(every.invariants - 5.0).max()
    assert run(t_eval=[0.1, 0.9], **options).diagnostics.max_residual == ends.max_residual
    seldom = [run(save_every=n, every=2, **options).diagnostics.max_residual for n in (1, None)]
    assert seldom[0] == seldom[1]


def round_off(h, steps, **options):
    """Error of RK4 on the oscillator against its own map, R(-ih)^N, in 40 digits: round-off alone."""
    with mpmath.workdps(40):
        t_bound = steps * h
        last = mpmath.mpf(t_bound) - (steps - 1) * h

        def factor(h):
            return sum((-1j * mpmath.mpf(h)) ** k / mpmath.factorial(k) for k in range(5))

        wanted = mpmath.mpc(1.0, 0.3) * factor(h) ** (steps - 1) * factor(last)
        result = integrate(options.pop("fun", oscillator), (0, t_bound), [1.0, 0.3], method=EIPRK4, h=h, **options)
        return float(abs(mpmath.mpc(*map(float, result.y[:, -1])) - wanted))


@pytest.mark.parametrize("h", [2.0**-8, 0.003])
def test_compensation_in_five_thousand_steps(h):
    """Measured for h = 1/256: 1.6e-15 without it and 6e-17 with it."""
    plain, compensated = (round_off(h, 5_000, compensated=c) for c in (False, True))
    assert compensated < 2e-16
    assert plain > 5 * compensated


def same_as_by_gradient(value, y0, **options):
    """The run without grad agrees with the one that has it; a third component keeps it from being made of f."""
    options = {"fun": lambda t, y: np.append(pendulum(t, y[:2]), 0.0), "y0": [*y0, 0.0], "h": 0.1, **options}
    options["metric"] = "euclidean"
    gradient = lambda t, y: np.append(pendulum_gradient(t, y), 0.0)  # noqa: E731
    by_hand = run((0, 20), invariants=Invariant(pendulum_energy, gradient), **options)
    computed = run((0, 20), invariants=Invariant(value, name="H"), **options)
    assert computed.status == 0
    assert (computed.max_residual <= 1e-14).all()
    np.testing.assert_allclose(computed.y[:, -1], by_hand.y[:, -1], rtol=0, atol=1e-9)


def test_complex_step():
    """No warning: filterwarnings is "error"."""
    for y0, iterations in product(([1.0, 0.3], [1.0, 0.0], [0.0, 1.0]), (1, 2)):
        same_as_by_gradient(pendulum_energy, y0, iterations=iterations)
    several = Invariant(lambda t, y: np.array([pendulum_energy(t, y), 2 * pendulum_energy(t, y)]))
    assert run(fun=pendulum, y0=[1.0, 0.3], invariants=several).status == 0


NOT_ANALYTIC = {
    "float": lambda t, y: float(0.5 * y[1] ** 2 - math.cos(y[0])),
    "abs": lambda t, y: 0.5 * np.abs(y[1]) ** 2 - np.cos(y[0]),
    "norm": lambda t, y: 0.5 * np.linalg.norm(y[1:]) ** 2 - np.cos(y[0]),
    "real": lambda t, y: 0.5 * np.real(y[1]) ** 2 - np.cos(np.real(y[0])),
    "vdot": lambda t, y: 0.5 * np.vdot(y[1:], y[1:]) - np.cos(y[0]),
}


@pytest.mark.parametrize("kind", NOT_ANALYTIC)
def test_differences_with_a_warning_where_no_complex_step_is_valid(kind):
    for y0 in ([1.0, 0.3], [1.0, 0.0]):  # from rest too
        with pytest.warns(UserWarning, match="'H' has no grad and allows no complex step: .* central differences"):
            same_as_by_gradient(NOT_ANALYTIC[kind], y0)


def mass(t, y):
    return np.vdot(y, y).real


def test_complex_states_need_differences_unless_the_invariant_is_a_quadratic_form():
    options = {"fun": lambda t, y: 1j * np.abs(y) ** 2 * y, "y0": np.array([1 + 1j, 0.5]), "h": 0.05}
    by_hand = run((0, 5), invariants=Invariant(mass, lambda t, y: 2 * y), check=False, **options)
    computed = run((0, 5), invariants=mass, **options)
    np.testing.assert_allclose(computed.y[:, -1], by_hand.y[:, -1], rtol=0, atol=1e-12)
    with pytest.warns(UserWarning, match="'squared' has no grad"):
        computed = run((0, 5), invariants=Invariant(lambda t, y: mass(t, y) ** 2, name="squared"), **options)
    np.testing.assert_allclose(computed.y[:, -1], by_hand.y[:, -1], rtol=0, atol=1e-10)


def test_a_unitary_matrix_without_gradients():
    """16 invariants: no warning, and hardly more evaluations of them than with gradients."""
    rng, calls = np.random.default_rng(0), [0]
    hermitian = (lambda a: a + a.conj().T)(rng.standard_normal((4, 4)) + 1j * rng.standard_normal((4, 4)))

    def products(t, y):
        calls[0] += 1
        U = y.reshape(4, 4)
        P = U.conj().T @ U
        return np.concatenate([P.real[np.triu_indices(4)], P.imag[np.triu_indices(4, 1)]])

    fun = lambda t, y: -1j * (hermitian @ y.reshape(4, 4)).ravel()  # noqa: E731
    found = run((0, 5), fun=fun, y0=np.eye(4, dtype=complex).ravel(), invariants=products, h=0.05, t_eval=[1.0, 5.0])
    U = found.y[:, -1].reshape(4, 4)
    assert np.abs(U.conj().T @ U - np.eye(4)).max() < 1e-12
    assert calls[0] < 2000  # differences take 192 for each gradient


WITH_ARGS = Invariant(lambda t, y, a: a * (y @ y), lambda t, y, a: 2 * a * y, args=(3.0,))
IN_PLACE = Invariant(SQUARE.fun, lambda t, y, out: np.multiply(2, y, out=out), in_place=True)
QUADRATIC = Invariant(lambda t, y: y[0] ** 2 + 3 * y[1] ** 2 + y[0], lambda t, y: np.array([2 * y[0] + 1, 6 * y[1]]))
ORBIT = kepler()


def test_check_gradient():
    y = np.array([0.3, -0.4])
    for right in (SQUARE, PAIR, F_SQUARE, WITH_ARGS, IN_PLACE):
        assert check_gradient(right, 0.0, y, oscillator) < 1e-10
    assert check_gradient(Invariant(mass, lambda t, y: 2 * y), 0.0, y + 1j) < 1e-10
    assert max(check_gradient(item, 0.0, ORBIT.y0 + 0.01, ORBIT.fun) for item in ORBIT.invariants) < 1e-9
    for place in (y, [0.0, 0.0], [1e-9, 1e9], [1e150, 1.0]):
        assert check_gradient(QUADRATIC, 0.0, place) < 1e-8
    for factor in (-1.0, 0.5, 1.001):
        wrong = Invariant(SQUARE.fun, lambda t, y, factor=factor: np.array([2 * y[0], factor * 2 * y[1]]))
        wanted = abs(1 - factor) / max(abs(factor), 0.09 / 0.16)
        assert check_gradient(wrong, 0.0, y) == pytest.approx(wanted)
    assert check_gradient(Invariant(SQUARE.fun, lambda t, y: np.zeros(2)), 0.0, y) > 0.1
    assert check_gradient(Invariant(mass, lambda t, y: 2 * y.conj()), 0.0, [1 + 1j]) > 0.1


def test_project_initial():
    """y0 moves to the targets by the least amount; gradients that use f see f at the moved state."""
    problem = kepler(0.6, 0.0)
    wanted = np.array([-0.49, 0.81])
    kept = [
        Invariant(i.fun, i.grad, args=i.args, in_place=i.in_place, uses_f=i.uses_f, name=i.name, target=w)
        for i, w in zip(problem.invariants, wanted, strict=True)
    ]
    options = {"method": EIPRK4, "h": 0.01, "invariants": kept, "project_initial": True}
    result = integrate(problem, (0, 2), save_every=1, compiled=False, **options)
    assert result.status == 0
    np.testing.assert_allclose(result.invariants, wanted[:, None] * np.ones(201), rtol=0, atol=1e-13)
    moved = project(problem.y0, kept, iterations=20, f=problem.fun).y
    np.testing.assert_allclose(result.y[:, 0], moved, rtol=0, atol=1e-13)


def test_targets():
    """A target is given, or is the value at the start by default; one number holds for several values too."""
    given = Invariant(SQUARE.fun, SQUARE.grad, target=5.0)
    for more in ({}, {"project_initial": True}):
        np.testing.assert_array_equal(run(invariants=given, **more).y, run(invariants=SQUARE).y)
    near = Invariant(SQUARE.fun, SQUARE.grad, target=5.0 * (1 + 5e-9))
    assert run(invariants=near).invariants[0, -1] == pytest.approx(5.0 * (1 + 5e-9), rel=2 * EPS)
    both = Invariant(lambda t, y: np.array([y @ y, y @ y]), PAIR.grad, target=5.0)
    assert (run(invariants=both).max_residual < 1e-14).all()
    zero = Invariant(lambda t, y: y @ y - 5.0, SQUARE.grad, target=0.0, name="0")
    np.testing.assert_allclose(run(invariants=zero).y, run(invariants=SQUARE).y, rtol=0, atol=4 * EPS)
    assert run(invariants=zero).diagnostics.n_projections == 10
    # homproj never preserves 0: the start may miss it by 1e-8 of the terms.
    off = Invariant(lambda t, y: y[0] ** 2 + y[1] ** 2 - 5.0 - 2e-8, SQUARE.grad, target=0.0)
    assert max(abs(run(invariants=off).invariants[0, -1]), run(invariants=off).max_residual[0]) < 8 * EPS
    # A residual below four rounding errors of the scale is not corrected.
    wide = run(invariants=Invariant(SQUARE.fun, SQUARE.grad, scale=1e12))
    assert wide.diagnostics.n_skipped == 10
    np.testing.assert_array_equal(wide.y, run().y)


@pytest.mark.needs_jit
def test_a_jitted_function_that_returns_a_list_is_told_what_to_return():
    run = integrate(numba.njit(lambda t, y: [y[1], -y[0]]), (0, 1), [1.0, 0.0], method=EIPRK4, h=0.1)
    assert "returns a list or a tuple: return np.array([...])" in run.message
