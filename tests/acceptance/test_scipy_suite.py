"""SciPy's own suite for `solve_ivp`, test_ivp.py of its wheel, run over the classes.

It runs as shipped, except for the name of the method: literal lists of methods contain the class only, without the
other methods, and the class takes the place of SciPy's method of its name. The same tests run with the methods of SciPy
by their names through `eip_scipy.solve_ivp`, as they are shipped.
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

NIGHTLY = pytest.mark.nightly
ALL = {"RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA"}
# The last explicit one is a tableau through `eip_method`, whose steps are always the package's own.
EXPLICIT = {"EIPRK23": EIPRK23, "EIPRK45": EIPRK45, "EIPDOP853": EIPDOP853, "own RK45": eip_method(EIPRK45.TABLEAU)}
IMPLICIT = {"EIPRadau": EIPRadau, "EIPBDF": EIPBDF, "Radau": integrate.Radau, "BDF": integrate.BDF}
METHODS = EXPLICIT | IMPLICIT
# Tests that Radau and BDF of SciPy miss too: neither takes an array `rtol`.
MISSED_BY_IMPLICIT = {
    "Radau": {"test_array_rtol"},
    "BDF": {"test_args_single_value", "test_array_rtol", "test_duplicate_timestamps"},
}
OF_IMPLICIT = {"test_integration_sparse_difference", "test_integration_const_jac", "test_integration_stiff"}
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


SOURCE = source()


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


def module_of(name, solver):
    """Return SciPy's module with its lists of methods reduced to one, or with all of them if the name is empty."""
    text, path = SOURCE
    tree = ast.fix_missing_locations(OneMethod(name).visit(ast.parse(text)))
    module = types.ModuleType("scipy_suite_" + name)
    exec(compile(tree, path, "exec"), module.__dict__)
    module.solve_ivp = solver
    return module


def suite(label, solver=integrate.solve_ivp):
    """Return the name of SciPy's method, its module with our class in the place of that method, and its uses."""
    method, name, used = METHODS[label], label.split()[-1].removeprefix("EIP"), []

    class Counting(method):
        error_estimator_order = getattr(method, "error_estimator_order", None)  # which one of the tests reads

        def __init__(self, *args, **options):
            used.append(name)
            super().__init__(*args, **options)

    Counting.__name__ = method.__name__
    default = name if label in IMPLICIT else "RK45"

    def called(*args, method=default, **options):
        return solver(*args, method=Counting if method == name else method, **options)

    module = module_of(name, called)
    setattr(module, name, Counting)
    return name, module, used


def call(module, key, name):
    """Run a test with the method of this name (None: with all of them); return the number of runs."""
    function = getattr(module, key)
    marks = [m.args for m in getattr(function, "pytestmark", []) if m.name == "parametrize"]
    marks = [(argument, [name] if name and argument == "method" else values) for argument, values in marks]
    taken = function.__code__.co_varnames[: function.__code__.co_argcount]
    runs = list(itertools.product(*(values for _, values in marks)))
    for values in runs:
        known = {"num_parallel_threads": 1, **dict(zip((argument for argument, _ in marks), values, strict=True))}
        function(**{argument: known[argument] for argument in taken})
    return len(runs)


@pytest.mark.parametrize("label", EXPLICIT)
def test_explicit_methods(label):
    name, module, used = suite(label)
    for key in sorted(EXPECTED):
        call(module, key, name)
    assert len(EXPECTED) == 25
    assert used.count(name) > 40


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=[] if key in QUICK else NIGHTLY) for key in sorted(EXPECTED | OF_IMPLICIT)]
)
@pytest.mark.parametrize("label", IMPLICIT)
def test_implicit_methods(label, key):
    """The class is in the place of the default too; those left out, SciPy's own methods miss too."""
    name, module, used = suite(label)
    missed = key in MISSED_BY_IMPLICIT[name]
    with pytest.raises((AssertionError, TypeError, ValueError)) if missed else nullcontext():
        call(module, key, name)
    unused = {("test_integration_complex", "Radau"), ("test_args", "BDF"), ("test_inital_maxstep", name)}
    assert used or (key, name) in unused  # no complex states; Radau by name; no solver


def test_all_methods_through_the_typed_function():
    """All tests of the wheel, with each method of SciPy by its name or class; a result has what SciPy's has."""
    used = []

    def typed(*args, method="RK45", **options):
        used.append(method)
        return solve_ivp(*args, method=method, **options)

    module = module_of("", typed)
    assert sum(call(module, key, None) for key in EXPECTED) >= len(EXPECTED)
    assert len(used) > 100
    name, module, used = suite("EIPRK45", solve_ivp)
    for key in EXPECTED:
        call(module, key, name)
    assert used.count(name) > 40


def test_the_harness_can_fail():
    """A class that takes no notice of first_step and max_step, and whose states are off, must not get through."""
    name, module, used = suite("EIPRK45")
    solve = module.solve_ivp

    def spoiled(*args, first_step=None, max_step=None, **options):
        res = solve(*args, **options)
        res.y = res.y * (1 + 1e-2)
        return res

    module.solve_ivp = spoiled
    for key in ("test_first_step", "test_integration", "test_max_step"):
        with pytest.raises(AssertionError):
            call(module, key, name)
    assert used
