"""Mistakes of users: each one is reported at once, and computed results are not lost.

Failures on the way (NaN, blow-up, contradicting invariants, vanishing gradients) are in test_guards.
"""

import math
import warnings

import numba
import numpy as np
import pytest
from numba import njit
from scipy.integrate import RK45, solve_ivp
from systems import SQUARE, jit_oscillator, orbit, oscillator

import eip_scipy
from eip_scipy import EIPRK1, EIPRK3, EIPRK4, EIPRK45, Invariant, ensemble, integrate, project, recommend
from eip_scipy.solvers import EIPSolver

EPS = np.finfo(float).eps
NIGHTLY = pytest.mark.nightly
Y0 = [1.0, 2.0]
FIXED = {"method": EIPRK4, "h": 0.1}
square, square_gradient = SQUARE.fun, SQUARE.grad


def by_scipy(fun=oscillator, t_span=(0, 1), y0=Y0, **options):
    return solve_ivp(fun, t_span, y0, **{**FIXED, **options})


def by_integrate(fun=oscillator, t_span=(0, 1), y0=Y0, **options):
    return integrate(fun, t_span, y0, **{**FIXED, **options})


def by_ensemble(fun=oscillator, t_span=(0, 1), y0=Y0, **options):
    return ensemble(fun, t_span, [y0, y0], **{**FIXED, "compiled": False, **options})


DRIVERS = by_scipy, by_integrate, by_ensemble
both = pytest.mark.parametrize("driver", DRIVERS[:2], ids=["solve_ivp", "integrate"])


def kept(value=square, grad=square_gradient, **options):
    return {"invariants": Invariant(value, grad, name="H", **options)}


# Those of hard-cases.json that are mistakes in arguments or in what functions return, by its names.
BAD_INPUTS = {
    "y0_nan": ({"y0": [1.0, math.nan]}, ValueError, r"All components of the initial state `y0` must be finite\."),
    "y0_2d": ({"y0": [[1.0, 2.0]]}, ValueError, r"`y0` must be 1-dimensional\."),
    "y0_masked": ({"y0": np.ma.array(Y0, mask=[False, True])}, ValueError, "masked values in y0"),
    "f_none": ({"fun": lambda t, y: None}, TypeError, "fun returned None, expected 2 numbers"),
    "f_scalar": ({"fun": lambda t, y: 1.0}, ValueError, r"fun returned shape \(\), expected \(2,\)"),
    "f_wrong_n": ({"fun": lambda t, y: [1, 2, 3]}, ValueError, r"fun returned shape \(3,\), expected \(2,\)"),
    "f_column": ({"fun": lambda t, y: np.ones((2, 1))}, ValueError, r"fun returned shape \(2, 1\), expected \(2,\)"),
    "f_complex": ({"fun": lambda t, y: 1j * y}, ValueError, "y0 is real; pass y0.astype"),
    "step_tiny": ({"h": 1e-20, "t_span": (5, 6)}, ValueError, "`h` is too small"),
    "rtol_neg": ({"rtol": -1e-3}, ValueError, "`rtol` must be positive"),
    "atol_shape": ({"atol": [1e-6]}, ValueError, "`atol` has wrong shape"),
    "inv_nan_0": (kept(lambda t, y: math.nan), ValueError, "invariant 'H' is not finite at y0"),
    "inv_shape": (kept(lambda t, y: np.ones((2, 2))), ValueError, r"invariant 'H' returned shape \(2, 2\)"),
    "grad_shape": (kept(grad=lambda t, y: 2 * y[:1]), ValueError, r"gradient .*'H' has shape \(1,\), expected \(2,\)"),
    "grad_wrong": (kept(grad=lambda t, y: -2 * y), ValueError, "gradient of .*'H' is wrong: .* by differences and"),
    "weak_start": (kept(target=5.001), ValueError, r"start violates invariant 'H' by -0\.001; .*project_initial=True"),
}


@pytest.mark.parametrize("name", BAD_INPUTS)
def test_bad_inputs(name):
    options, error, match = BAD_INPUTS[name]
    for driver in DRIVERS[: 2 if name in ("y0_2d", "y0_masked") else 3]:  # the states of an ensemble are a matrix
        with pytest.raises(error, match=match):
            driver(**options)


def event(terminal=None, direction=0):
    def passing(t, y):
        return y[0]

    passing.terminal, passing.direction = terminal, direction
    return passing


def takes_more(t, y, m):
    return m * (y @ y)


def takes_more_gradient(t, y, m):
    return 2 * m * y


HUGE = 10**400
TERMINALS = [event(value) for value in (math.nan, "a", -1, 1.5, [1])]
DIRECTIONS = [event(True, value) for value in (None, math.nan, "a")]
# The option, its wrong values, the error, and words of its message.
WRONG = [
    ("y0", [["a", "b"], [[1.0], [1.0, 2.0]], [HUGE, 1]], TypeError, "`y0` must hold numbers"),
    ("y0", [[]], ValueError, "y0 is empty"),
    ("y0", [None], TypeError, "y0 is missing"),
    ("fun", [3], TypeError, "fun must be callable or a Problem, got 3"),
    ("fun", [lambda t, y: "ab"], TypeError, "fun returned 'ab', expected 2 numbers"),
    ("fun", [lambda t, y, p: y], TypeError, r"fun is called with \(t, y\): missing .* 'p'.*params=\.\.\."),
    ("t_span", [(0, 1, 2), (0, None), (0, 1j), (0, HUGE)], ValueError, "t_span must hold two numbers"),
    ("t_span", [(0, math.inf)], ValueError, "t_span must be finite unless a terminal event"),
    ("t_span", [(math.nan, 1)], ValueError, "t_span must be finite"),
    ("h", [0, -0.1, math.nan, math.inf, True, "0.1", 0.1 + 0j], ValueError, r"`h` must be positive\. Got "),
    ("first_step", [0.1], ValueError, "are for adaptive steps"),
    ("rtol", ["tight", None, 1j, [[1e-3], 1e-3]], ValueError, "`rtol` must be a number or an array of 2 numbers. Got"),
    ("atol", [[1e-3, math.inf]], ValueError, "`atol` must be finite. Got .*; to exclude a component"),
    ("diagnostics", [{}], TypeError, r"must be a Diagnostics\(\) object"),
    # Options of the projection.
    ("metric", ["errors"], ValueError, "metric must be 'error', 'euclidean' or an array"),
    ("metric", [[1.0, 2.0, 3.0]], ValueError, r"metric: weights have shape \(3,\), the state has 2"),
    ("metric", [[1.0, -1.0]], ValueError, "metric: weights must be finite, >= 0"),
    ("metric", [[0.0, 0.0]], ValueError, "and not all 0"),
    ("metric", [["a", "b"]], ValueError, r"metric must be an array of numbers, got \['a', 'b'\]"),
    ("blocks", [3, 0], ValueError, "blocks = [30] does not divide the state's 2 components"),
    ("blocks", [1.5], ValueError, "blocks must be an integer or a sequence of index arrays"),
    ("blocks", [[[0, 1], [1]]], ValueError, "blocks: a component is in two blocks"),
    ("blocks", [[[0, 2]], [[0.5]]], ValueError, "blocks: .* not an array of indices from 0 to 1"),
    ("linear_invariants", [3], ValueError, "linear_invariants must be .auto., None, or a pair"),
    ("linear_invariants", [(np.ones((1, 3)), np.ones((3, 1)))], ValueError, r"linear_invariants: C has shape \(1, 3\)"),
    ("linear_invariants", [(np.eye(1, 2), np.eye(1, 2, 1).T)], ValueError, "linear_invariants: C S is singular"),
    (
        "linear_invariants",
        [(1j * np.eye(1, 2), np.ones((2, 1)))],
        ValueError,
        "linear_invariants: C and S must be real",
    ),
    ("direction", ["newest"], ValueError, "direction must be 'new', 'old' or 'midpoint', got 'newest'"),
    ("every", [2**70], ValueError, "every must be at most 9223372036854775807, got 1180591620717411303424"),
    ("iterations", [1001], ValueError, "iterations must be at most 1000, got 1001"),
    ("iterations", [0, 1.0, "2", True], ValueError, "iterations must be an integer >= 1"),
    *((name, [1], ValueError, f"{name} must be True or False") for name in ("reuse_f", "check", "project_initial")),
    *((name, [1], ValueError, f"{name} must be True or False") for name in ("in_place", "progress", "compensated")),
    # Options of runs.
    ("resume", ["yes"], ValueError, "resume must be True or False, got"),
    ("compiled", ["a"], ValueError, "compiled must be True, False or None .compile if possible., got"),
    ("max_bytes", ["a", math.nan, -1, True], ValueError, "max_bytes must be a number of bytes >= 0"),
    ("save_every", [0, 1.5, "1", True], ValueError, "save_every must be an integer >= 1"),
    ("save_every", [10**30], ValueError, "save_every must be at most 9223372036854775807, got 1000"),
    ("callback", [1], TypeError, "callback must be a function callback"),
    ("events", [1], TypeError, "events must be callable, or a sequence of callables, got 1"),
    ("events", [[None]], TypeError, "events must be callable, got None"),
    ("events", TERMINALS, ValueError, "`terminal` .* must be a boolean or positive integer"),
    ("events", DIRECTIONS, ValueError, "`direction` attribute of each event must be a number"),
    ("checkpoint_every", [HUGE], ValueError, "checkpoint_every must be a number of seconds > 0, got 1000"),
    ("params", [[HUGE], [None], 1j, [[1], [2, 3]]], TypeError, "params must be an array of numbers, got"),
    ("params", [{"k": 1.0}], TypeError, r"Give the values .* params=\[1.0, 2.0\], .* args=\(mapping,\)"),
    ("params", [[1.0]], TypeError, r"fun is called with \(t, y, params\): too many"),
    ("in_place", [True], TypeError, r"fun is called with \(t, y, out\): too many"),
    ("t_eval", [[1j], "ab", [None], [HUGE]], ValueError, "t_eval must be an array of numbers"),
    ("t_eval", [[0.2, math.nan], [0.2, math.inf]], ValueError, "t_eval must be finite"),
    ("t_eval", [[0.5, 1.1], [-0.1, 0.5]], ValueError, "`t_eval` are not within `t_span`"),
    ("t_eval", [[0.5, 0.2], [0.5, 0.5]], ValueError, "`t_eval` are not properly sorted"),
    ("t_eval", [[[0.5]], 0.5], ValueError, "`t_eval` must be 1-dimensional"),
    ("t_eval", [[]], ValueError, "1-dimensional and not empty"),
    # Methods and invariants.
    ("method", [EIPSolver, 4], TypeError, "method must be an EIP class such as EIPRK4"),
    ("method", ["rk45", RK45], TypeError, r"Give the class: from eip_scipy import EIPRK45\.$"),
    ("method", ["Radau"], TypeError, r"Give the class: from eip_scipy import EIPRadau\.$"),
    ("method", [None], TypeError, "method is missing"),
    ("method", ["LSODA"], TypeError, r"got 'LSODA'\.$"),
    ("invariants", [Invariant, None], TypeError, r"invariants: got .*; expected an Invariant, a function f\(t, y\)"),
    ("invariants", [[SQUARE, Invariant], [SQUARE, None]], TypeError, "the sequence contains .*; expected Invariant"),
]
NAMED = r".*Invariant\(\.\.\., args=\(\.\.\.,\)\)"
TIME = "The first argument is always the time: .* lambda "
# The arguments of an invariant of the name H.
WRONG_KEPT = [
    (kept(lambda t, y: np.array([1.0, math.nan]), None), ValueError, r"invariant 'H\[1\]' is not finite at y0"),
    (kept(lambda t, y: 1j * (y @ y)), ValueError, "invariant 'H' returned complex values"),
    (kept(lambda t, y: None), TypeError, "invariant 'H' returned .*None"),
    (kept(lambda t, y: None, None), TypeError, "invariant 'H' returned .*None"),
    (kept(grad=lambda t, y: None), TypeError, "gradient of invariant 'H' returned None"),
    (kept(grad=lambda t, y: 2j * y), ValueError, "gradient of invariant 'H' is complex, but y0 is real"),
    (kept(grad=lambda t, y: math.nan * y), ValueError, "gradient of invariant 'H' is not finite at y0"),
    (kept(lambda t, y: np.full(3, y @ y)), ValueError, r"gradient .*'H' has shape \(2,\), expected \(3, 2\)"),
    (kept(grad=lambda t, y: 2.002 * y), ValueError, "gradient of invariant 'H' is wrong"),
    (kept(target=math.nan), ValueError, "invariant 'H': target must be finite"),
    (kept(target=[1.0, 2.0]), ValueError, r"invariant 'H': target has shape \(2,\)"),
    (kept(takes_more, takes_more_gradient), TypeError, rf"invariant 'H' is called with \(t, y\): .*'m'{NAMED}"),
    (kept(takes_more, None), TypeError, rf"invariant 'H' is called with \(t, y\): .*'m'{NAMED}"),
    (kept(grad=takes_more_gradient), TypeError, rf"gradient of invariant 'H' is called with \(t, y\): .*'m'{NAMED}"),
    (kept(args=(1.0,)), TypeError, rf"invariant 'H' is called with \(t, y, args\[0\]\): too many{NAMED}"),
    (kept(uses_f=True), TypeError, rf"gradient of invariant 'H' .* \(t, y, f\): too many{NAMED}"),
    (kept(lambda y: y @ y, None), TypeError, rf"'H' is called with \(t, y\): .* {TIME}t, y: "),
    (kept(lambda y: y @ y), TypeError, rf"'H' is called with \(t, y\): .* {TIME}t, y: "),
    (kept(grad=lambda y: 2 * y), TypeError, rf"'H' is called with \(t, y\): .* {TIME}t, y: "),
    (kept(lambda y, m: m * (y @ y), None, args=(2.0,)), TypeError, rf"'H' is called .* {TIME}t, y, args\[0\]: "),
    # From within: unchanged.
    (kept(lambda t, y: takes_more(t, y)), TypeError, r"takes_more\(\) missing 1 required positional argument: 'm'$"),
]
WRONG_TOGETHER = [
    ({"h": None, "method": EIPRK1}, ValueError, "EIPRK1 has no error estimate and needs the step h="),
    ({"t_eval": [0.2, 0.5], "t_span": (1, 0)}, ValueError, "`t_eval` are not properly sorted"),
    ({"t_eval": [0.5], "save_every": 1}, ValueError, "save_every or t_eval, not both"),
    ({"h": 1e-12, "save_every": 1}, MemoryError, "by default half of the free memory"),
    ({"h": None, "method": EIPRK45, "first_step": 11.0}, ValueError, "`first_step` exceeds bounds"),
    ({"h": None, "method": EIPRK45, "first_step": math.inf}, ValueError, "`first_step` exceeds bounds"),
    *(
        ({"h": None, "method": EIPRK45, name: x}, ValueError, f"`{name}` must be positive. Got .*; give a real number")
        for name in ("first_step", "max_step")
        for x in (HUGE, 1j, "a", True, -1, math.nan)
    ),
    ({"in_place": True, "params": 1.0}, TypeError, r"fun is called with \(t, y, out, params\): too many"),
    ({"events": event(True), "params": 1.0, "fun": lambda t, y, p: y}, TypeError, r"event 0 is .* \(t, y, params\)"),
]


@pytest.mark.parametrize(("name", "values", "error", "match"), WRONG)
def test_wrong_options(name, values, error, match):
    for value in values:
        check_refused({"invariants": SQUARE, name: value}, error, match)


@pytest.mark.parametrize(("options", "error", "match"), WRONG_KEPT + WRONG_TOGETHER)
def test_wrong_invariants_and_combinations(options, error, match):
    check_refused(options, error, match)


def check_refused(options, error, match):
    with pytest.raises(error, match=match) as info:
        by_integrate(**options)
    assert len(str(info.value)) < 400


@both
def test_y0_without_masked_values_and_unchanged(driver):
    plain, unmasked = driver(), driver(y0=np.ma.array(Y0, mask=[False, False]))
    np.testing.assert_array_equal(np.asarray(unmasked.y), plain.y)
    y0 = np.array(Y0)
    driver(y0=y0, invariants=Invariant(square, square_gradient, target=5.1), project_initial=True)
    np.testing.assert_array_equal(y0, Y0)
    assert by_scipy(lambda t, y: y, y0=[]).y.shape[0] == 0  # which SciPy's own suite asks for


@both
@pytest.mark.parametrize("invariants", [(), SQUARE])
def test_fun_that_keeps_overwrites_or_reuses_arrays(driver, invariants):
    """Each call of fun gets fresh arrays, as in SciPy, and what it returns is copied."""
    kept, buffer = [], np.zeros(2)

    def reusing(t, y):
        buffer[:] = y[1], -y[0]
        return buffer

    def careless(t, y):
        kept.append((y, y.copy()))
        return oscillator(t, y)

    def destructive(t, y):
        f = oscillator(t, y)
        y[:] = 1e9
        return f

    good = driver(invariants=invariants).y
    for fun in (reusing, careless, destructive):
        np.testing.assert_array_equal(driver(fun, invariants=invariants).y, good)
    assert all((now == then).all() for now, then in kept)


class MineError(Exception):
    pass


@pytest.mark.parametrize("error", [MineError("here"), KeyboardInterrupt()])
@pytest.mark.parametrize("part", ["fun", "value", "grad", "callback"])
def test_exceptions_of_the_user_pass_unchanged(part, error):
    """Nothing is lost, though the function raises again when the partial result is made."""
    broken = False

    def raising(name, t, ok=None):
        nonlocal broken
        broken = broken or (part == name and t > 0.5)
        if broken:
            raise error
        return ok

    item = Invariant(lambda t, y: raising("value", t, y @ y), lambda t, y: raising("grad", t, 2 * y))
    options = {"fun": lambda t, y: raising("fun", t, oscillator(t, y)), "h": 0.01, "invariants": item}
    with pytest.raises(type(error)) as info:
        by_integrate(**options, save_every=10, callback=lambda t, y, d: raising("callback", t))
    assert info.value is error
    partial = error.partial
    np.testing.assert_allclose(partial.t, np.arange(7 if part == "callback" else 6) / 10, atol=1e-15)
    np.testing.assert_allclose(partial.y[0], np.cos(partial.t) + 2 * np.sin(partial.t), atol=1e-8)
    assert (partial.status, partial.success) == (-1, False)
    assert "interrupted" in partial.message
    broken = False
    if part != "callback":
        with pytest.raises(type(error)) as info:
            by_scipy(**options)
        assert info.value is error


def test_times_of_the_solver_class():
    """A run from an infinite start never arrives; the end may be infinite, because a terminal event may end the run."""
    infinite = [(-math.inf, 0), (math.inf, math.inf), (math.nan, 1), (0, math.nan)]
    spans = [(span, "be finite, got .*; only its end may be infinite") for span in infinite]
    spans += [(span, "hold two numbers, got") for span in ((0j, 1.0), (None, 1.0), (0.0, HUGE))]
    for span, match in spans:
        with pytest.raises(ValueError, match=f"t_span must {match}"):
            EIPRK4(oscillator, span[0], Y0, span[1], h=0.1)


@pytest.mark.parametrize("driver", DRIVERS)
def test_h_longer_than_the_interval(driver):
    """One step of the interval's length, as restart loops need it at their end."""
    for span in ((0, 1), (1, 0), (100, 101)):
        long, exact = driver(t_span=span, h=1.1), driver(t_span=span, h=1.0)
        np.testing.assert_array_equal(long.y, exact.y)
        np.testing.assert_array_equal(long.t, exact.t)


@both
def test_h_of_ten_spacings(driver):
    for t in (5.0, 1e6, -3e9):
        end = t + 100 * float(np.spacing(abs(t)))
        spacing = float(np.spacing(max(abs(t), abs(end))))
        with pytest.raises(ValueError, match=r"`h` is too small: h = .* below 10 spacings of t"):
            driver(t_span=(t, end), h=9.5 * spacing)
        run = driver(t_span=(t, end), h=10 * spacing)
        assert (run.status, run.t[-1]) == (0, end)
        assert (np.diff(run.t) > 0).all()


STEPS_OF_SPANS = [((0, 1), 0.3, 4), ((1, 0), 0.3, 4), ((0, 1), 0.1, 10), ((0, 0.3), 0.1, 3), ((0.1, 0.7), 0.1, 6)]
STEPS_OF_SPANS += [((0, 1), part / 3, n) for part, n in ((1, 3), (1 - 1e-12, 3), (1 - 1e-6, 4))]
STEPS_OF_SPANS += [((1e6, 1e6 + 1), 1e-3, 1000), ((-2.5, 1.0), 0.7, 5)]


@both
def test_steps_end_on_t_bound(driver):
    """All steps have the nominal length except the last one; none has the length of round-off."""
    for span, h, n in STEPS_OF_SPANS:
        run = driver(t_span=span, h=h, **({"save_every": 1} if driver is by_integrate else {}))
        assert len(run.t) == n + 1
        assert (run.t[0], run.t[-1]) == span
        sign = np.sign(span[1] - span[0])
        np.testing.assert_array_equal(run.t[:-1], span[0] + np.arange(n) * (sign * h))
        assert (sign * np.diff(run.t) > 1e-7 * h).all()


@both
@pytest.mark.parametrize(("method", "invariants"), [(EIPRK4, SQUARE), (EIPRK45, ())])
def test_tolerances_without_a_scale(driver, method, invariants):
    """An error has no scale if both the start and atol are 0; the message says so and does not mention h."""
    options = {"h": None, "method": method, "atol": [1e-6, 0.0], "invariants": invariants}
    with pytest.raises(ValueError, match="error of component 1 has no scale, because y0 and `atol` are 0 there"):
        driver(y0=[1.0, 0.0], **options)
    assert driver(y0=[1.0, 0.0], **{**options, "first_step": 0.01}).status == 0
    assert driver(y0=[1.0, 0.0], **{**options, "h": 0.1, "metric": "error"}).status == 0


@pytest.mark.parametrize(("wrong", "nearest"), [("invarients", "invariants"), ("Rtol", "rtol")])
def test_unknown_options_name_the_nearest(wrong, nearest):
    with pytest.raises(TypeError, match=f"no option '{wrong}'.*did you mean '{nearest}'"):
        by_integrate(**{wrong: 1})
    with pytest.warns(UserWarning, match=f"solver: `{wrong}`.*did you mean '{nearest}'") as record:
        by_scipy(**{wrong: 1})
    assert len(record) == 1
    assert record[0].filename == __file__


@pytest.mark.parametrize("names", [("jac",), ("uband", "jac", "jac_sparsity")])
def test_options_of_other_solvers_warn_as_scipy_s(names):
    """The text is SciPy's word for word, so that a filter of SciPy's warning filters this one."""
    options = dict.fromkeys(names)
    with pytest.warns(UserWarning, match="chosen solver") as theirs:
        solve_ivp(oscillator, (0, 1), Y0, method=RK45, **options)
    with pytest.warns(UserWarning, match="chosen solver") as ours:
        by_scipy(**options)
    (their,), (our,) = theirs, ours
    assert (str(our.message), our.category) == (str(their.message), their.category)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The following arguments have no effect for a chosen solver", UserWarning)
        by_scipy(**options, invarients=3)


def test_terminal_as_scipy_takes_it():
    for value in (None, False, 0, True, 1, 2, 1.0, np.int64(3), np.True_):
        run, sol = (driver(events=event(value), t_span=(0, 20)) for driver in (by_integrate, by_scipy))
        assert run.status == sol.status
        np.testing.assert_allclose(run.t_events[0], sol.t_events[0], atol=1e-10)


def test_times_of_dense_output_are_real():
    """A complex one would write complex states into real buffers."""
    sol = by_scipy(method=EIPRK45, invariants=SQUARE, dense_output=True).sol
    for t in (np.complex128(0.05), [0.05j], "0.05", ["a"]):
        for call in (sol, sol.interpolants[0]):
            with pytest.raises(TypeError, match=r"dense output is defined at real times|not supported for the input"):
                call(t)
    assert sol([0, 1]).shape == (2, 2)
    with pytest.raises(TypeError, match="dense output is defined at real times, got"):
        by_scipy(t_eval=[0.5 + 0j], invariants=SQUARE)


WRONG_INVARIANTS = [
    ((3,), {}, TypeError, "fun must be callable, got 3"),
    ((square, 3), {}, TypeError, "grad must be callable or None, got 3"),
    ((square,), {"in_place": True}, ValueError, "in_place and uses_f describe grad"),
    ((square,), {"uses_f": True}, ValueError, "in_place and uses_f describe grad"),
    *(((square,), {"scale": v}, ValueError, "scale must be a finite number >= 0") for v in (-1.0, math.nan, True)),
    ((square,), {"args": 3}, TypeError, r"args must be a tuple, got 3; write args=\(x,\)"),
    *(((square,), {"target": v}, ValueError, "target must be a number or") for v in ("x", 1j, HUGE, [[1], [1, 2]])),
    ((square, square), {"in_place": 1}, ValueError, "in_place must be True or False, got"),
    ((square, square), {"uses_f": 1}, ValueError, "uses_f must be True or False, got"),
    ((square,), {"name": 3}, TypeError, "name must be a string, got 3"),
]


def test_wrong_invariants():
    for arguments, options, error, match in WRONG_INVARIANTS:
        with pytest.raises(error, match=match):
            Invariant(*arguments, **options)


def test_gradients_vanish_at_an_extremum():
    """The squares vanish at the start up to rounding, which is all that differences see."""

    def lenz(t, y):
        q, v = y[:2], y[2:]
        return (v @ v) * q - (q @ v) * v - q / np.sqrt(q @ q)

    def gradient(t, y):
        q, v = y[:2], y[2:]
        by_q = (v @ v - (q @ q) ** -0.5) * np.eye(2) - np.outer(v, v) + np.outer(q, q) / (q @ q) ** 1.5
        by_v = 2 * np.outer(q, v) - np.outer(v, q) - (q @ v) * np.eye(2)
        return 2 * lenz(t, y)[:, None] * np.hstack([by_q, by_v])

    squares = Invariant(lambda t, y: lenz(t, y) ** 2, gradient)
    wrong = Invariant(squares.fun, lambda t, y: gradient(t, y) + [1e-6, 0.0, 0.0, 0.0])
    for angle in (0.0, np.pi, 0.3):
        c, s = np.cos(angle), np.sin(angle)
        assert by_integrate(orbit, (0.0, 0.01), [c, s, -s, c], h=0.01, invariants=squares).success
        with pytest.raises(ValueError, match=r"gradient of invariant .* is wrong"):
            by_integrate(orbit, (0.0, 0.01), [c, s, -s, c], h=0.01, invariants=wrong)


@pytest.mark.parametrize(
    ("call", "size"),
    [
        ("solve_ivp(fun, (0, 0.1), y0, method=EIPRK4, h=0.1, invariants=first)", 2),
        ("solve_ivp(fun, (0, 0.1), y0, method=EIPRK4, h=0.1, invariants=first)", 200),  # warns of its cost too
        ("integrate(fun, (0, 0.1), y0, method=EIPRK4, h=0.1, invariants=first)", 200),
        ("ensemble(fun, (0, 0.1), [y0, y0, y0], method=EIPRK4, h=0.1, invariants=first)", 200),
        ("recommend(fun, (0, 0.1), y0, invariants=first)", 2),
    ],
)
def test_warnings_come_once_and_name_the_line_that_a_user_wrote(call, size):
    """That of a script: nothing of this file is between it and the package."""
    names = {"__name__": "__main__", "fun": lambda t, y: 1.0 + 0.1 * np.abs(y), "y0": np.ones(size)}
    names |= {"first": Invariant(lambda t, y: abs(y[0])), "EIPRK4": EIPRK4, "solve_ivp": solve_ivp}
    names |= {"integrate": integrate, "ensemble": ensemble, "recommend": recommend}
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        exec(compile(call, "script.py", "exec"), names)
    said = [(str(item.message), item.filename) for item in record if item.category is UserWarning]
    of_cost = ["no grad is given"] if size > 2 else []
    for words in ("allows no complex step", "is not an invariant of this system", *of_cost):
        assert [place for text, place in said if words in text] == ["script.py"]


WRONG_OF_PROJECT = [
    ({}, "invariant 'S' has no target"),
    *(({"target": v}, "target must be 1 finite numbers") for v in ([1.0, 2.0], math.nan, 1j, [[1.0]])),
    *(({"target": 1.0, "t": v}, "t must be a finite number, got") for v in (None, math.nan, 1j)),
    ({"target": 1.0, "sigma": [1.0]}, r"sigma: weights have shape \(1,\)"),
    ({"target": 1.0, "sigma": [0.0, 0.0]}, "sigma: weights must be finite"),
    ({"target": 1.0, "sigma": "a"}, "sigma must be an array of numbers, got"),
    ({"target": 1.0, "iterations": 0}, "iterations must be an integer >= 1"),
    ({"target": 1.0, "iterations": 2**70}, "iterations must be at most 1000"),
    ({"target": 1.0, "linear_invariants": 3}, "linear_invariants must be"),
    ({"target": 1.0, "f": [1.0]}, r"f has shape \(1,\), expected \(2,\)"),
    ({"target": 1.0, "y": [1.0, math.nan]}, "must be finite"),
    ({"target": 1.0, "y": [Y0]}, "1-dimensional"),
    (
        {"target": 1.0, "t": 3.0, "y": [0.6, 0.81], **kept(grad=lambda t, y: -2 * y)},
        r"projection failed at t=3: invariant 'H', residual .*, rank 1 of 1",
    ),
]


def test_wrong_arguments_of_project():
    for options, match in WRONG_OF_PROJECT:
        options = {"y": Y0, "invariants": SQUARE} | options
        with pytest.raises(ValueError, match=match):
            project(options.pop("y"), options.pop("invariants"), **options)


def test_project_needs_f_where_a_gradient_uses_it():
    kept = Invariant(square, lambda t, y, f: 2 * y, uses_f=True, target=1.0)
    with pytest.raises(ValueError, match="pass f="):
        project([0.6, 0.81], kept)
    with pytest.raises(ValueError, match=r"function f\(t, y\)"):
        project([0.6, 0.81], kept, f=[1.0, 1.0], iterations=2)
    assert project([0.6, 0.81], kept, f=oscillator, iterations=3).residual[0] == pytest.approx(0, abs=4 * EPS)
    with pytest.raises(ValueError, match="pass fun="):
        eip_scipy.check_gradient(kept, 0.0, Y0)


jit_value, jit_grad = njit(lambda t, y: y[0] * y[0] + y[1] * y[1]), njit(lambda t, y: 2 * y)
NOT_COMPILABLE = {
    "plain fun": ({}, "fun is not a Numba function"),
    "plain grad": (kept(jit_value), "gradient of invariant 'H' is not"),
    "args": (kept(lambda t, y, a: y @ y, lambda t, y, a: 2 * y, args=(1,)), "'H' has args"),
    "plain value": (kept(grad=jit_grad), "invariant 'H' is not a Numba function"),
    "no grad": (kept(njit(lambda t, y: 2 * np.mean(y * y)), None), "'H' has no grad, and it does not compile for dual"),
}


@pytest.mark.needs_jit
@pytest.mark.filterwarnings("ignore:invariant 'H' has no grad")
@pytest.mark.parametrize(
    "case", ["plain fun", "plain grad", "args", *(pytest.param(k, marks=NIGHTLY) for k in ("plain value", "no grad"))]
)
def test_what_does_not_compile_is_named(case):
    options, reason = NOT_COMPILABLE[case]
    fun = oscillator if case == "plain fun" else jit_oscillator
    with pytest.raises(TypeError, match=reason):
        by_integrate(fun, **options, compiled=True)
    run = by_integrate(fun, **options)
    assert (run.status, run.compiled) == (0, False)
    assert "interpreted: " in run.message
    assert reason.lstrip("'") in run.message


@pytest.mark.needs_jit
def test_runs_say_whether_they_are_compiled(monkeypatch):
    with pytest.raises(TypeError, match=r"argument|V"):
        by_integrate(jit_oscillator, invariants=Invariant(jit_value, njit(lambda t, y, p: y), name="V"), compiled=True)
    for compiled, says in ((False, "compiled=False"), (None, "")):
        run = by_integrate(jit_oscillator, compiled=compiled)
        assert run.compiled == (compiled is None)
        assert says in run.message
        assert ("interpreted" in run.message) == (not run.compiled)
    monkeypatch.setattr(numba.config, "DISABLE_JIT", True)
    assert "NUMBA_DISABLE_JIT" in by_integrate(jit_oscillator).message
    with pytest.raises(TypeError, match="NUMBA_DISABLE_JIT"):
        by_integrate(jit_oscillator, compiled=True)


def test_progress_goes_to_stderr(capsys):
    by_integrate(progress=True, invariants=SQUARE)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "EIPRK4" in shown.err
    assert "100%" in shown.err
    by_integrate()
    assert capsys.readouterr().err == ""
    if not numba.config.DISABLE_JIT:
        by_integrate(jit_oscillator, progress=True)
        assert capsys.readouterr().err.strip().startswith("compiling")


def test_no_estimate_no_error_metric():
    """RK1 has no error estimate: metric="error" is then the euclidean one, and the largest correction is unknown."""
    one, other = (by_integrate(method=EIPRK1, metric=m, invariants=SQUARE) for m in ("error", "euclidean"))
    np.testing.assert_array_equal(one.y, other.y)
    assert math.isnan(one.diagnostics.max_correction)
    assert not math.isnan(by_integrate(method=EIPRK3, invariants=SQUARE).diagnostics.max_correction)
