"""Problems written as expressions: the reader, the functions, the brackets, runs against other implementations."""

import contextlib
import copy
import dataclasses
import math
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
import sympy
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from systems import DOUBLE_PENDULUM, HENON_HEILES, INERTIA, RELATIVISTIC_KEPLER, RIGID_BODY, SO3, TWO_RODS

from eip_scipy import EIPDOP853, EIPGJ12, EIPRK4, EIPRKN12, check_gradient, ensemble, equations, hamiltonian, integrate
from eip_scipy.problems import kepler

MOMENTUM = {"L": "x*py - y*px"}
DRIVEN = "p**2/2 + x**2/2 - x*cos(2*t)"  # from rest: x = (cos t - cos 2t) / 3
ADAPTIVE = {"method": EIPDOP853, "rtol": 1e-10, "atol": 1e-10}


@pytest.fixture(scope="module")
def orbit():
    return hamiltonian(RELATIVISTIC_KEPLER, params={"eps": 0.005}, invariants=MOMENTUM)


def values(problem, y):
    """Return the derivatives, by the functions as they are written: compiling each of many problems takes long."""
    out = np.empty(len(y))
    function = getattr(problem.rhs, "py_func", problem.rhs)
    function(0.0, np.array(y, dtype=float), out, *([] if problem.params is None else [problem.params]))
    return out


VALUES = {
    "2*pi": 2 * math.pi, ".1 + .2": 0.3, "1e-3": 0.001, "2**0.5": math.sqrt(2), "-2**2": -4, "2 - 3 - 4": -5,
    "8/4/2": 1, "2**3**2": 512, "+1_000": 1000, "1 +\n 2": 3, "+".join(["1"] * 700): 700, "arcsin(1) - asin(1)": 0,
    "exp(0) + ln(1) + hypot(3, 4) + abs(-2) + max(1, 2) + min(1, 2)": 11, "(1 + 1e-290)**4": 1, "cbrt(-8)": -2,
    "1.0001**365": pytest.approx(1.0001**365, rel=1e-14),
}  # fmt: skip


def test_values_of_text():
    found = values(equations({f"x{k}": text for k, text in enumerate(VALUES)}), np.zeros(len(VALUES)))
    assert dict(zip(VALUES, found, strict=True)) == VALUES


def test_names_that_are_not_called_are_the_users():
    names = "E,I,S,N,Q,O,C,beta,gamma,zeta,pi_,lamda,oo,nan,zoo,true,Symbol,cos,exp".split(",")  # noqa: SIM905
    problem = equations({name: f"2*{name}" for name in names})
    np.testing.assert_array_equal(values(problem, np.arange(19)), 2 * np.arange(19))


HOSTILE = [
    "__import__('os').system('true')", "x.__class__", "(1).real", "lambda: 1", "lambda*x", "[x for x in y]", "{x: y}",
    "x if y else z", "x < y", "x == y", "x and y", "not x", "~x", "x // y", "x % y", "x @ y", "x << 2", "x ^ 2", "x[0]",
    "x, y", "(x := 3)", "*x", "f'{x}'", "'x'", "b'x'", "True", "None", "...", "1j", "sqrt(*x)", "sqrt(x=1)",
    "sqrt(**x)", "sqrt(x, y)", "sqrt()", "f(x)", "eval('1')", "(sqrt)(x)(y)", "x(y)", "await x", "(yield)", "x; y",
    "x\ny", "x) + (y", "2x", "", "   ", "# only this", "x\0", "x = 1", "import os", "1/0", "0**-1", "log(0)",
    "sqrt(-1)", "x # y", "# x\n+ y",
    "asin(2)", "(-1)**0.5", "1e999", "10**400", "9**9**9", "9**99**9", "2**2**2**2**2", "x**(10**9)", "exp(1000)",
    "exp(exp(exp(9)))", "2**sqrt(-1)", "x**(1/0)", "10**200*10**200", "(9**300)**9", "atan2(0, 0)",
    "(" * 500 + "x" + ")" * 500, "-" * 100_000 + "x", "x" + "**x" * 5000,
    "x+" * 90_000 + "x", "1" * 5000, "x*" * 110_000 + "x",
]  # fmt: skip


def test_what_is_not_allowed_is_refused():
    for text in HOSTILE:
        with pytest.raises(ValueError, match=r"^H: ") as found:
            hamiltonian(text)
        assert len(str(found.value)) < 700


@given(st.text(alphabet="xyp12.+-*/()e _,sincoqrtlambda[]{}='\"\\\n#:@%^&|<>", max_size=40))
def test_any_text_is_read_or_refused(text):
    with contextlib.suppress(ValueError):
        equations({name: text for name in "xyp"})


LEAVES = st.sampled_from(["x", "y", "k", "2", "0.25", "pi", "(-3)"])
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda part: f"({part[0]} {part[1]} {part[2]})"),
        st.tuples(
            st.sampled_from(
                ["sin({})", "sqrt(1 + {}**2)", "exp(-{}**2)", "(1 + {}**2)**-1.5", "(-{}**3)", "abs({})", "cbrt({})",
                 "({0} / (2 + cos({0})))", "max({0}, atan({0}))"]
            ),
            inner,
        ).map(lambda part: part[0].format(part[1])),
    ),
    max_leaves=8,
)  # fmt: skip


@given(TREES)
def test_functions_compute_what_the_text_says(text):
    try:
        problem = equations({"x": text, "y": "k*x"}, params={"k": 0.9})
    except ValueError as error:
        assume("too large" not in str(error) and "that a float can represent" not in str(error))
        raise
    known = {name: getattr(np, name) for name in ("sin", "cos", "sqrt", "exp", "pi", "cbrt")}
    known |= {"atan": np.arctan, "x": 0.7, "y": -1.3, "k": 0.9, "abs": abs, "max": max}
    assert values(problem, [0.7, -1.3]) == pytest.approx([eval(text, known), 0.63], rel=1e-11, abs=1e-11)


def test_a_declared_name_is_neither_a_constant_nor_a_function():
    """pi' = -phi and phi' = pi for H = pi^2/2 + phi^2/2, where pi is the momentum."""
    for problem in (
        hamiltonian("pi**2/2 + phi**2/2", "phi", "pi"),
        equations({"phi": "pi", "pi": "-phi"}, invariants={"H": "pi**2/2 + phi**2/2"}),
        equations(["pi", "-phi"], "phi pi"),
    ):
        assert values(problem, [1.0, 2.0]).tolist() == [2, -1]
    problem = hamiltonian("p**2/2 + pi*q**2/2", params={"pi": 2.0}, invariants={"twice": "p**2 + pi*q**2"})
    assert values(problem, [1.0, 3.0]).tolist() == [3, -2]
    matrix = [[0, "-pi", 0], ["pi", 0, 0], [0, 0, 0]]
    problem = hamiltonian("m1*m2*m3*pi", "m1 m2 m3", poisson=matrix, params={"pi": 3.0})
    assert values(problem, [1.0, 2.0, 5.0]).tolist() == [-9 * 5, 9 * 2 * 5, 0]
    assert values(hamiltonian("p**2/2 + pi*q**2/2"), [1.0, 3.0])[1] == -math.pi
    # Python reads the sign for micro as the Greek letter.
    assert values(hamiltonian("p**2/2 + µ*q**2", params={"μ": 2.0}), [1.0, 0.5]).tolist() == [0.5, -4]


def test_expressions_of_sympy():
    x, p, k = sympy.symbols("x p k", positive=True)
    problem = hamiltonian(p**2 / 2 + k * sympy.sqrt(x**2 + 1), [x], [p], params={k: 2.0})
    assert values(problem, [-1.0, 0.5]) == pytest.approx([0.5, 2 / math.sqrt(2)])


def test_piecewise_and_reciprocals_are_those_of_sympy():
    x, y = sympy.symbols("x y", real=True)
    steps = sympy.Piecewise((x**2, x < 1), (sympy.sec(x) + sympy.cot(x), (x >= 1) & (x < 2)), (3, True))
    others = sympy.Piecewise((sympy.csc(y), sympy.Not(sympy.Eq(x, y)) | (x > 5)), (x, x <= y))
    problem = equations({"x": steps, "y": others})
    for point in ((0.5, 0.7), (1.0, 0.7), (1.5, 0.7), (2.0, 2.0), (2.5, 0.7), (6.0, 6.0)):
        expected = [float(item.subs({x: point[0], y: point[1]})) for item in (steps, others)]
        np.testing.assert_allclose(values(problem, point), expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("H", "names"),
    [
        (HENON_HEILES, "x y px py"),
        ("p1**2/q1 + p2**2*q2 + p10*q10", "q1 q2 q10 p1 p2 p10"),
        ("p1**2 + p2**2", "q1 q2 p1 p2"),
        ("p_1**2 + p_2**2*q_1", "q_1 q_2 p_1 p_2"),
        ("p**2 - cos(theta)", "theta p"),
        ("p_r**2 + p_theta**2/r**2", "r theta p_r p_theta"),
        ("E*pE + I*pI", "E I pE pI"),
    ],
)
def test_pairs(H, names):
    problem, names = hamiltonian(H), tuple(names.split())
    half = len(names) // 2
    assert problem.component_names == names
    assert problem.pairs == tuple(zip(names[:half], names[half:], strict=True))
    assert all(f"{q} with {p}" in repr(problem) for q, p in problem.pairs)


def test_parameters_by_name_in_runs(orbit):
    """Parameters that are not named keep their values; an ensemble takes one for each member."""
    problem, start = hamiltonian("p**2/(2*m) + k*q**2/2", params={"m": sympy.Integer(2), "k": 1.0}), [1.0, 0.0]
    run = integrate(problem, (0, 3), start, params={"k": 4.0}, **ADAPTIVE)
    np.testing.assert_array_equal(run.y, integrate(problem, (0, 3), start, params=[2.0, 4.0], **ADAPTIVE).y)
    members = ensemble(problem, (0, 3), start, params={"k": [1.0, 4.0]}, **ADAPTIVE)
    np.testing.assert_array_equal(members.y[1], run.y[:, -1])
    for call in (integrate, ensemble):
        with pytest.raises(ValueError, match=r"hamiltonian has no parameter 'K'\. It has m, k\."):
            call(problem, (0, 3), start, params={"K": 4.0}, **ADAPTIVE)
        with pytest.raises(TypeError, match=r"the problem 'kepler' has no names for its parameters"):
            call(kepler(), (0, 3), params={"eps": 0.0}, **ADAPTIVE)
    # Compiled code would read memory behind arrays of another length.
    for y0, params in (([1.0, 0.0, 0.0], None), (np.ones(6), None), (np.ones(4), [1.0, 2.0]), (np.ones(4), [])):
        with pytest.raises(ValueError, match="must hold as many numbers as there are names in"):
            integrate(orbit, (0, 1), y0, params=params, method=EIPRK4, h=0.1)


def test_nystrom_and_multistep_methods_take_it(orbit):
    own, q, dq, out = kepler(), np.array([0.7, -0.4]), np.array([0.3, 0.9]), np.empty(2)
    assert dict(orbit.checks) == {"H": "by construction", "L": "symbolically"}
    for method, h in ((EIPRKN12, 0.05), (EIPGJ12, 0.01)):
        run = integrate(orbit, (0, 20), own.y0, method=method, h=h)
        assert run.y[:, -1] == pytest.approx(integrate(own, (0, 20), method=EIPRKN12, h=0.01).y[:, -1], abs=1e-10)
    orbit.jacobian(0.0, q, dq, out, orbit.params)
    ends = [orbit.acc(0.0, q + sign * 1e-5 * dq, orbit.params) for sign in (1, -1)]
    assert out == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-8)
    assert hamiltonian("p**2/2 + abs(q)").jacobian is None  # it has no derivative at 0
    for H in ("p**2/4 + q**2", "p**2*q", "p**2/2 + p*q"):  # q' is not p, or p' depends on it
        assert hamiltonian(H).acc is None


SECOND_ORDER = "p1**2/(2*m) + p2**2/4 + p1*p2/10 + q1**2/2 + q2**2*cos(q1)**2"


def test_second_order_of_masses():
    problem = hamiltonian(SECOND_ORDER, params={"m": 3.0})
    other, y0 = problem.second_order(), np.array([0.3, 0.2, 0.1, -0.4])
    assert other.component_names == ("q1", "q2", "v_q1", "v_q2")
    assert other.acc is not None
    inverse_masses = np.array([[1 / 3, 0.1], [0.1, 0.5]])
    start = np.concatenate([y0[:2], inverse_masses @ y0[2:]])
    rates = values(problem, y0)
    assert values(other, start) == pytest.approx([*rates[:2], *(inverse_masses @ rates[2:])])
    energies = [item.invariants[0] for item in (problem, other)]
    one, two = (item.fun(0.0, y, problem.params) for item, y in zip(energies, (y0, start), strict=True))
    assert one == pytest.approx(two)


@pytest.mark.parametrize(
    ("make", "says"),
    [(lambda: hamiltonian("px**2/4 + x**2/2"), r"Use a Runge-Kutta .*problem\.second_order\(\) returns this problem"),
     (lambda: hamiltonian("px**2*x + x**2"), r"Use a Runge-Kutta method such as EIPDOP853, .* half of the state\.$"),
     (lambda: equations({"x": "x*(1 - y)", "y": "y*(x - 1)"}), r"Use a Runge-Kutta method .* half of the state\.$")],
)  # fmt: skip
def test_nystrom_methods_say_what_works(make, says):
    with pytest.raises(ValueError, match=says):
        integrate(make(), (0, 1), [1.0, 2.0], method=EIPRKN12, h=0.1)


def pendulum():
    return hamiltonian(DOUBLE_PENDULUM, "th1 th2", "p1 p2", params=TWO_RODS)


@pytest.mark.parametrize(
    ("make", "y0", "end"),
    [(lambda: hamiltonian(HENON_HEILES), [0.0, 0.1, 0.5, 0.0], 100),
     pytest.param(pendulum, [1.0, 0.5, 0.2, -0.1], 5, marks=pytest.mark.nightly)],
)  # fmt: skip
def test_runs_are_those_of_scipy_and_forces_are_gradients(make, y0, end):
    problem, y0, grad = make(), np.array(y0), np.empty(4)
    (energy,) = problem.invariants
    energy.grad(0.0, y0, grad, *energy.args)
    assert problem.fun(0.0, y0) == pytest.approx([grad[2], grad[3], -grad[0], -grad[1]], rel=1e-13)
    assert check_gradient(energy, 0.0, y0) < 1e-10
    run = integrate(problem, (0, end), y0, **ADAPTIVE)
    expected = solve_ivp(problem.fun, (0, end), y0, method="DOP853", rtol=1e-12, atol=1e-12)
    assert run.y[:, -1] == pytest.approx(expected.y[:, -1], abs=1e-8)
    assert run.trusted
    assert run.max_residual[0] < 1e-12


def test_rigid_body_by_its_poisson_matrix():
    kept = {"C": "m1**2 + m2**2 + m3**2"}
    problem = hamiltonian(RIGID_BODY, "m1 m2 m3", poisson=SO3, params=INERTIA, invariants=kept)
    euler = equations(
        {"m1": "m2*m3*(1/I3 - 1/I2)", "m2": "m3*m1*(1/I1 - 1/I3)", "m3": "m1*m2*(1/I2 - 1/I1)"},
        params=INERTIA, invariants={"H": RIGID_BODY, **kept},
    )  # fmt: skip
    y0 = np.array([1.0, 0.2, 0.3])
    assert values(problem, y0) == pytest.approx(values(euler, y0), rel=1e-14)
    assert dict(euler.checks) == {"H": "symbolically", "C": "symbolically"}
    assert (integrate(problem, (0, 20), y0, **ADAPTIVE).max_residual < 1e-13).all()


def test_h_that_depends_on_time():
    with pytest.warns(UserWarning, match=r"H depends on t, so that it is not an invariant.*extended=True") as told:
        plain = hamiltonian(DRIVEN)
    assert told[0].filename == __file__
    assert plain.invariants == ()
    assert "invariants  none" in repr(plain)
    extended = hamiltonian(DRIVEN, extended=True)
    assert extended.component_names == ("x", "p", "p_t")
    for problem in (plain, extended):
        run = integrate(problem, (0, 3), np.zeros(len(problem.component_names)), **ADAPTIVE)
        assert run.y[0, -1] == pytest.approx((math.cos(3) - math.cos(6)) / 3, abs=1e-9)
        assert run.max_residual.max(initial=0) < 1e-14
    assert run.trusted


# How invariants are known. The last: also next to q = 2 and q = -2.

SWITCHED = {"H^30": "(p**2/2 + max(abs(q) - 2, 0)**2/2 + sin(p)**2 + cos(p)**2)**30"}
ROOTS = {"E": "y**2/2 + 3*cbrt(x)**4/4", "F": "cbrt(y**2/2 + 3*cbrt(x)**4/4 - 1)"}


@pytest.mark.parametrize(
    ("make", "how"),
    [
        (lambda: hamiltonian(RELATIVISTIC_KEPLER, params={"eps": 0.1}, invariants=MOMENTUM), "symbolically"),
        (lambda: equations({"x": "y", "y": "-cbrt(x)"}, invariants=ROOTS), "symbolically"),
        (lambda: hamiltonian("(px**2 + py**2)/2 + (x**2 + k*y**2)/2", params={"k": 1.0}, invariants=MOMENTUM),
         "numerically, at 8 points with the parameters given"),
        # A function of the energy, whose bracket would take minutes to expand.
        (lambda: hamiltonian(HENON_HEILES, invariants={"H^20": f"({HENON_HEILES} + 1)**20"}),
         "numerically, at 8 points"),
        (lambda: hamiltonian("p**2/2 + max(abs(q) - k, 0)**2/2", params={"k": 2.0}, invariants=SWITCHED),
         "numerically, at 48 points with the parameters given"),
    ],
)  # fmt: skip
def test_how_invariants_are_known(make, how):
    problem = make()
    assert {text for name, text in problem.checks.items() if name != "H"} == {how}
    assert how in repr(problem)


# Errors: the function, its arguments, the kind, and some words of the message.

OSCILLATOR = "(p**2 + q**2)/2"
X, P = sympy.Symbol("x", positive=True), sympy.Symbol("p", positive=True)
FRICTIONLESS = {"x": "y", "y": "-cbrt(x)"}


def kept(quantity, H=HENON_HEILES):
    return H, {"invariants": {"I": quantity}}


def rigid(poisson=SO3, **options):
    return RIGID_BODY, {"poisson": poisson, "params": INERTIA, "q": "m1 m2 m3", **options}


WRONG = {
    hamiltonian: [
        (("x^2",), ValueError, r"'x\^2' has \^; powers are written \*\*"),
        (("lambda*x",), ValueError, "lambda is a keyword of Python; use another name"),
        (("x.real",), ValueError, "'x.real' is not allowed. Allowed are numbers, names, pi"),
        (("gamma(x)",), ValueError, "'gamma' is not a known function"),
        (("sin(x, y)",), ValueError, "because sin takes 1 argument"),
        (("9**9**9",), ValueError, r"'9\*\*9' is an exponent above 1000"),
        (("log**2/2 + log(q)", "q", "log"), ValueError, "calls log, which is a component or parameter"),
        ((sympy.I * X, [X], [P]), ValueError, "expected a finite real expression"),
        ((sympy.Symbol("x") * X, [X], [P]), ValueError, "two different symbols called x"),
        ((sympy.Function("f")(X) * P**2, [X], [P]), ValueError, "is not supported. Supported are"),
        ((sympy.Symbol("a b"), [X], [P]), ValueError, "not a name"),
        *(((wrong, [X], [P]), TypeError, "expected an expression") for wrong in ([X], True, 1j, None)),
        (("px**2 + k*x**2",), ValueError, r"not clear what k is: .* goes with it \(pairs found: x with px\)"),
        (("p**2 + a*b",), ValueError, r"a and b and p are: .* goes with them \(pairs found: none\).*'p': 1.0}"),
        (("3",), ValueError, r"H contains neither coordinates nor momenta\. Names are paired as x with px"),
        (("p**2", "q"), TypeError, "give both q and p, or neither"),
        (("p**2", "q r", "p"), ValueError, "2 coordinates"),
        (("p**2", "q", "q"), ValueError, "occurs twice"),
        (("p**2", "q r", "p a-b"), ValueError, "'a-b' is not a name"),
        (("p**2", "t", "p"), ValueError, "t is the time"),
        (("p**2", 3, "p"), TypeError, "expected names"),
        (("p**2", [3], "p"), TypeError, "expected names"),
        (("p**2*k", "q", "p"), ValueError, "contains k, which is neither"),
        (("a**2", "q", "p", {"params": {"a": 1}}), ValueError, "does not depend on q, p"),
        (("p**2", "q", "p", {"params": {"q": 1}}), ValueError, "of the state and of a parameter"),
        (("p**2", {"params": 3}), TypeError, "params must be a mapping"),
        *((("p**2", {"params": {"k": k}}), ValueError, "k must be a finite number, got")
          for k in (math.inf, "1", sympy.I, sympy.Symbol("a"))),
        (("p**2", {"invariants": ["p"]}), TypeError, "invariants must be a mapping"),
        (("p**2", {"invariants": {1: "p"}}), TypeError, "names must be strings"),
        (("p**2", {"name": 3}), TypeError, "name must be a string"),
        (("p**2/2 + sign(q - 1)",), ValueError, "function that jumps where q - 1 is 0"),
        (rigid([[0, 1], [-1, 0]]), ValueError, r"shape \(3, 3\)"),
        (rigid([[0, 1, 0], [1, 0, 0], [0, 0, 0]]), ValueError, "must be antisymmetric"),
        (rigid(q=None), TypeError, "names of the whole state as q"),
        (("(px**2 + py**2)/2 + x**2 + 2*y**2", {"invariants": MOMENTUM}), ValueError,
         r"'L' is not an invariant of these equations: its rate is .*\. At x="),
        (kept(f"({HENON_HEILES})**13 + 1e-9*x"), ValueError, "'I' is not an invariant"),
        (kept("3"), ValueError, "does not depend on x, y, px, py"),
        ((HENON_HEILES, {"invariants": {"H": "x"}}), ValueError, "H is already the name of an invariant"),
        (kept("sqrt(-2 - x**2)"), ValueError, "not finite and real at any point"),
        # Constant in one branch, which all points of moderate size are in.
        (kept("max(q, 3)", OSCILLATOR), ValueError, r"its rate is p\*Heaviside\(q - 3\)\. At q="),
        *((kept(quantity, OSCILLATOR), ValueError, "'I' is not an invariant") for quantity in
          ("max(q**2, 1e8)", "max(q, 3) - max(q, 3.001)", "min(-7, q)*abs(p)", "(p**2 + q**2)**12 + abs(q + 9) - q")),
        (kept("max(sin(q), 2)", OSCILLATOR), ValueError, r"changes its branch, so that it cannot be checked"),
    ],
    equations: [
        ((["y", "-x"],), TypeError, "y is missing"),
        ((["y"], "x y"), ValueError, "1 derivatives for the 2 components"),
        (({"x": "y", "y": "-x"}, "x z"), ValueError, "f has derivatives of x, y, but y is x, z"),
        ((FRICTIONLESS, {"invariants": {"E": "y**2/2 + 3*abs(x)*cbrt(x)/4"}}), ValueError, "not an invariant"),
    ],
    lambda *args, **options: hamiltonian(*args, **options).second_order(): [
        *(((H,), ValueError, "second_order needs") for H in ("p**2*q", "(p - q)**2/2", "p**4", "sqrt(1 + p**2)")),
        ((DRIVEN, {"extended": True}), ValueError, "second_order needs"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("call", WRONG, ids=["hamiltonian", "equations", "second_order"])
def test_wrong_arguments(call):
    for arguments, kind, says in WRONG[call]:
        options = arguments[-1] if len(arguments) > 1 and isinstance(arguments[-1], dict) else {}
        with pytest.raises(kind, match=says):
            call(*arguments[: len(arguments) - bool(options)], **options)


def test_cube_roots_are_real():
    problem, gradient = hamiltonian("p**2/2 + 3*cbrt(q)**4/4 + q*cbrt(2*q)", name="root"), np.empty(2)
    (energy,) = problem.invariants
    columns = problem.variational(())
    for q in (-8.0, -0.3, 0.0, 0.7):
        root, two = np.cbrt(q), np.cbrt(2.0)
        force = -(root + 4 / 3 * two * root)
        y, out = np.array([q, 0.5]), np.empty(4)
        assert problem.fun(0.0, y) == pytest.approx([0.5, force], rel=1e-14, abs=1e-300)
        assert energy.fun(0.0, y) == pytest.approx(0.125 + (0.75 + two) * root**4, rel=1e-14)
        energy.grad(0.0, y, gradient)
        assert gradient == pytest.approx([-force, 0.5], rel=1e-14, abs=1e-300)
        if q:
            columns(0.0, np.array([*y, 1.0, 0.0]), out)
            assert out[3] == pytest.approx(-(1 + 4 / 3 * two) / 3 / root**2, rel=1e-14)


def test_problems_share_functions_pickle_and_copy(orbit):
    two = [hamiltonian(RELATIVISTIC_KEPLER, params={"eps": eps}, invariants=MOMENTUM) for eps in (0.1, 0.2)]
    assert two[0].rhs is two[1].rhs
    assert values(two[0], np.ones(4)).tolist() != values(two[1], np.ones(4)).tolist()
    whole = dataclasses.replace(orbit, y0=kepler().y0, t_span=(0.0, 5.0))
    for item in (whole, dataclasses.replace(whole, invariants=whole.invariants[1:])):
        run = integrate(item, method=EIPRK4, h=0.03)
        for again in (pickle.loads(pickle.dumps(item)), copy.deepcopy(item)):
            assert repr(again) == repr(item)
            assert len(again.invariants) == len(item.invariants)
            np.testing.assert_array_equal(integrate(again, method=EIPRK4, h=0.03).y, run.y)


@pytest.mark.usefixtures("in_vectors")
def test_members_are_single_runs(orbit):
    y0s = kepler().y0 * np.linspace(0.99, 1.01, 64)[:, None]
    found = ensemble(orbit, (0, 10), y0s, method=EIPRK4, h=0.01)
    assert found.one_by_one == ""
    np.testing.assert_array_equal(found.y[5], integrate(orbit, (0, 10), y0s[5], method=EIPRK4, h=0.01).y[:, -1])


def printed(code, **variables):
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_code_is_the_same_in_every_process():
    """The result does not depend on the order of sets; this process has its own seed."""
    code = (
        "from eip_scipy import hamiltonian\n"
        f"rhs = hamiltonian({DOUBLE_PENDULUM!r}, 'th1 th2', 'p1 p2', params={TWO_RODS!r}).rhs\n"
        "print(rhs.__code__.co_code.hex(), rhs.__code__.co_consts)"
    )
    rhs = pendulum().rhs
    here = getattr(rhs, "py_func", rhs).__code__
    # The code, not what becomes of it.
    assert printed(code, PYTHONHASHSEED="1", NUMBA_DISABLE_JIT="1") == f"{here.co_code.hex()} {here.co_consts}\n"
