"""SciPy's own suite for `solve_ivp`, test_ivp.py of its wheel, run over the adaptive classes.

It runs as shipped, except for the name of the method: literal lists of methods contain the class only, without the
other methods. Those of the 25 tests that take the default method, RK45, or Radau, keep it, except that the class takes
the place of RK45.

A stricter test runs each of them once per class, which also replaces the default method and implicit methods that are
not the subject of the test. The same holds for `eip_scipy.solve_ivp` with the class EIPRK45, and with SciPy's own
methods by name, where all tests run as they are shipped.
"""

import ast
import importlib.util
import itertools
import types
from contextlib import nullcontext
from pathlib import Path

import pytest
from scipy import integrate

from eip_scipy import EIPBDF, EIPDOP853, EIPRK23, EIPRK45, EIPRadau, eip_method, solve_ivp
from eip_scipy.core.stepping import Stepping
from eip_scipy.engine.data import Span

NIGHTLY = [pytest.mark.nightly, pytest.mark.slow]
SCIPY = {"RK23": integrate.RK23, "RK45": integrate.RK45, "DOP853": integrate.DOP853}
# The classes, and a tableau through `eip_method`, where the steps are always the package's own.
METHODS = {
    "EIPRK23": ("RK23", EIPRK23),
    "EIPRK45": ("RK45", EIPRK45),
    "EIPDOP853": ("DOP853", EIPDOP853),
    "own RK45": ("RK45", eip_method(EIPRK45.TABLEAU)),
    "typed RK45": ("RK45", EIPRK45),
}
ALL = {*SCIPY, "Radau", "BDF", "LSODA"}

DOES_NOT_APPLY = {
    "test_integration_complex_sparse": "implicit methods: a sparse Jacobian of complex numbers",
    "test_integration_sparse_difference": "implicit methods: differences of a sparse Jacobian",
    "test_integration_const_jac": "implicit methods: a constant Jacobian",
    "test_integration_stiff": "implicit methods: stiffness",
    "test_event_dense_output_LSODA": "LSODA's own interpolant",
    "test_num_jac": "SciPy's numerical Jacobian, no method in it",
    "test_num_jac_sparse": "SciPy's numerical Jacobian, no method in it",
    "test_ConstantDenseOutput": "SciPy's own class, no method in it",
    "test_OdeSolution": "SciPy's own class, no method in it",
}
# Written for one method, the default RK45 or Radau, with numbers that SciPy's own class of this name misses too.
MISSED_BY_SCIPY = [
    ("test_args", "RK23"),
    ("test_args", "RK45"),
    ("test_args", "DOP853"),
    ("test_args_single_value", "RK23"),
    ("test_duplicate_timestamps", "DOP853"),  # extrapolates an interpolant of degree 7 by 1600 steps
    ("test_array_rtol", "DOP853"),  # both its errors are far below the tolerance
]
# Tests that Radau and BDF miss: neither takes an array `rtol`.
MISSED_BY_IMPLICIT = {
    "Radau": {"test_array_rtol"},
    "BDF": {"test_args_single_value", "test_array_rtol", "test_duplicate_timestamps"},
}
# Radau takes no complex states; test_args names Radau.
WITHOUT_THEM = {("test_integration_complex", "Radau"), ("test_args", "BDF")}
IMPLICIT = {"test_integration_sparse_difference", "test_integration_const_jac", "test_integration_stiff"}
QUICK = {"test_integration", "test_integration_const_jac", "test_events", "test_max_step", "test_first_step"}
# None of these may be missing.
EXPECTED = {
    *("test_duplicate_timestamps", "test_integration", "test_integration_complex", "test_events", "test_max_step"),
    *("test_event_terminal_integer", "test_event_terminal_iv", "test_first_step", "test_t_eval", "test_classes"),
    *("test_t_eval_dense_output", "test_t_eval_early_event", "test_no_integration", "test_no_integration_class"),
    *("test_empty", "test_args", "test_array_rtol", "test_integration_zero_rhs", "test_args_single_value"),
    *("test_initial_state_finiteness", "test_zero_interval", "test_tbound_respected_small_interval"),
    *("test_tbound_respected_larger_interval", "test_tbound_respected_oscillator", "test_inital_maxstep"),
}


def source():
    try:
        spec = importlib.util.find_spec("scipy.integrate._ivp.tests.test_ivp")
    except ModuleNotFoundError:
        spec = None
    if spec is None or spec.origin is None:
        pytest.skip("this build of SciPy ships without its tests", allow_module_level=True)
    return Path(spec.origin).read_text(encoding="utf-8"), spec.origin


class OneMethod(ast.NodeTransformer):
    """Reduce lists of methods to one; leave out decorators that only SciPy's test runner knows."""

    def __init__(self, name):
        self.name = name

    def visit_List(self, node):
        names = {e.value if isinstance(e, ast.Constant) else getattr(e, "id", None) for e in node.elts}
        if names and names <= ALL and self.name in names:
            first = node.elts[0]
            new = ast.Constant(self.name) if isinstance(first, ast.Constant) else ast.Name(self.name, ast.Load())
            return ast.copy_location(ast.List([new], ast.Load()), node)
        return self.generic_visit(node)

    def visit_FunctionDef(self, node):
        node.decorator_list = [d for d in node.decorator_list if "parametrize" in ast.unparse(d)]
        return self.generic_visit(node)


def module_of(name):
    """Return SciPy's module with its lists of methods reduced to one, or with all of them if the name is empty."""
    text, path = SOURCE
    tree = ast.fix_missing_locations(OneMethod(name).visit(ast.parse(text)))
    module = types.ModuleType("scipy_suite_" + name)
    exec(compile(tree, path, "exec"), module.__dict__)
    return module


def suite(name, method, as_shipped=False, solver=integrate.solve_ivp):
    """SciPy's module with the class `method` in the place of `name`, and what counts its uses.

    The class takes the place of all other methods too, unless the suite is left `as_shipped`. `solver` is the function
    in the place of `solve_ivp`.
    """
    module = module_of(name)
    used = []
    order = getattr(getattr(method, "TABLEAU", method), "error_estimator_order", None)

    class Counting(method):
        error_estimator_order = order  # what one of the tests reads

        def __init__(self, *args, **options):
            used.append(name)
            super().__init__(*args, **options)

    Counting.__name__ = method.__name__

    def solve_ivp(*args, method=name, **options):
        assert method in (name, Counting, "Radau"), f"{method} is not the method under test"
        if "jac" not in options or (options["jac"] is None and solver is not integrate.solve_ivp):
            return solver(*args, method=Counting, **options)
        with pytest.warns(UserWarning, match="have no effect for a chosen solver: `jac`"):
            return solver(*args, method=Counting, **options)

    def as_called(*args, method="RK45", **options):
        return solver(*args, method=Counting if method == name else method, **options)

    def select_initial_step(fun, t0, y0, t_bound, max_step, f0, direction, order, rtol, atol):
        used.append("initial_step")
        span = Span(t0, 0.0, t_bound, direction, 0, max_step)
        return Stepping(span, None, None, rtol, atol).estimated(fun, y0, f0, order)

    solve = as_called if as_shipped else solve_ivp
    module.__dict__.update({"solve_ivp": solve, "select_initial_step": select_initial_step, name: Counting})
    return module, used


def call(module, key, name, case):
    function = getattr(module, key)
    arguments = function.__code__.co_varnames[: function.__code__.co_argcount]
    known = {"method": name, "num_parallel_threads": 1, **case}
    function(**{argument: known[argument] for argument in arguments})


def cases_of(function):
    """Return the arguments of a parametrised test, without the method and SciPy's own fixture."""
    marks = [m.args for m in getattr(function, "pytestmark", []) if m.args[0] != "method"]
    assert len(marks) <= 1
    return [{marks[0][0]: value} for value in marks[0][1]] if marks else [{}]


SOURCE = source()
SUITES = {
    label: (name, *suite(name, method, solver=solve_ivp if label.startswith("typed") else integrate.solve_ivp))
    for label, (name, method) in METHODS.items()
}
CASES = [
    (label, key)
    for label, (name, module, _) in SUITES.items()
    for key in vars(module)
    if key.startswith("test_") and key not in DOES_NOT_APPLY and (key, name) not in MISSED_BY_SCIPY
]


@pytest.mark.parametrize("method", [EIPRK45, *(pytest.param(m, marks=NIGHTLY) for m in (EIPRK23, EIPDOP853))])
def test_as_shipped(method):
    """All tests run for each class; only the name differs, and two private functions of SciPy's."""
    name = method._SCIPY.__name__
    module, used = suite(name, method, as_shipped=True)
    for key in sorted(EXPECTED):
        for case in cases_of(getattr(module, key)):
            call(module, key, name, case)
    assert len(EXPECTED) == 25
    assert used.count(name) > 40


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=[] if key in QUICK else NIGHTLY) for key in sorted(EXPECTED | IMPLICIT)]
)
@pytest.mark.parametrize("method", [EIPRadau, EIPBDF, integrate.Radau, integrate.BDF], ids=lambda m: m.__name__)
def test_as_shipped_for_implicit_methods(method, key):
    """All tests, with the class in the place of Radau or BDF and of the default; those left out, SciPy's miss too."""
    name = method.__name__.removeprefix("EIP")
    module, used = suite(name, method, as_shipped=True)
    solve = module.solve_ivp
    module.solve_ivp = lambda *args, method=name, **options: solve(*args, method=method, **options)
    missed = (
        pytest.raises((AssertionError, TypeError, ValueError)) if key in MISSED_BY_IMPLICIT[name] else nullcontext()
    )
    with missed:
        for case in cases_of(getattr(module, key)):
            call(module, key, name, case)
    assert used or (key, name) in WITHOUT_THEM


def test_all_methods_through_the_typed_function():
    """All tests of the wheel, with each method of SciPy by its name or class; a result has what SciPy's has."""
    module, count, used = module_of(""), 0, []

    def typed(*args, method="RK45", **options):
        used.append(method)
        return solve_ivp(*args, method=method, **options)

    module.solve_ivp = typed
    for key in sorted(EXPECTED):
        function = getattr(module, key)
        marks = [m.args for m in getattr(function, "pytestmark", []) if m.name == "parametrize"]
        for values in itertools.product(*(values for _, values in marks)):
            arguments = dict(zip((name for name, _ in marks), values, strict=True))
            call(module, key, None, arguments)
            count += 1
    assert count >= len(EXPECTED)
    assert len(used) > 100


@pytest.mark.parametrize(("label", "key"), CASES)
def test_of_scipy(label, key):
    name, module, used = SUITES[label]
    for case in cases_of(getattr(module, key)):
        used.clear()
        call(module, key, name, case)
        assert used, f"{key} never used {label}"


@pytest.mark.parametrize(("key", "name"), MISSED_BY_SCIPY)
def test_what_is_left_out_is_missed_by_scipy_too(key, name):
    """They were written for RK45 or Radau and ask for more accuracy than the pair of this name has."""
    module, used = suite(name, SCIPY[name])
    with pytest.raises(AssertionError):
        call(module, key, name, {})
    assert used


@pytest.mark.parametrize("as_shipped", [True, False])
def test_the_harness_can_fail(as_shipped):
    """A class that takes no notice of first_step and max_step, and whose states are off, must not get through."""
    module, used = suite("RK45", EIPRK45, as_shipped)
    solve = module.solve_ivp

    def spoiled(*args, first_step=None, max_step=None, **options):
        res = solve(*args, **options)
        res.y = res.y * (1 + 1e-2)
        return res

    module.solve_ivp = spoiled
    for key in ("test_first_step", "test_integration", "test_max_step"):
        with pytest.raises(AssertionError):
            call(module, key, "RK45", {})
    assert used
