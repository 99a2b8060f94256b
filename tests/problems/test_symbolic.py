"""Problems written as expressions: the reader, the functions, the brackets, runs against other implementations."""

import copy
import dataclasses
import math
import os
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
import sympy
from hypothesis import assume, given
from hypothesis import strategies as st
from numba import config
from scipy.integrate import solve_ivp

from eip_scipy import (
    EIPDOP853,
    EIPGJ12,
    EIPRK4,
    EIPRK45,
    EIPRKN12,
    check_gradient,
    ensemble,
    equations,
    hamiltonian,
    integrate,
)
from eip_scipy.ensembles import tasks
from eip_scipy.problems import kepler
from eip_scipy.problems.symbolic.parser import as_expression, as_names
from eip_scipy_studies.comparators import stormer_verlet

HENON_HEILES = "(px**2 + py**2 + x**2 + y**2)/2 + x**2*y - y**3/3"
KEPLER = "(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2) - eps/(2*(x**2 + y**2)**1.5)"
L = {"L": "x*py - y*px"}
Q = sympy.Symbol("q", real=True)
SO3 = [[0, "-m3", "m2"], ["m3", 0, "-m1"], ["-m2", "m1", 0]]
TOP = "(m1**2/I1 + m2**2/I2 + m3**2/I3)/2"
INERTIA = {"I1": 1.0, "I2": 2.0, "I3": 3.0}
DOUBLE_PENDULUM = (
    "(m2*l2**2*p1**2 + (m1 + m2)*l1**2*p2**2 - 2*m2*l1*l2*p1*p2*cos(th1 - th2))"
    " / (2*m2*l1**2*l2**2*(m1 + m2*sin(th1 - th2)**2)) - (m1 + m2)*g*l1*cos(th1) - m2*g*l2*cos(th2)"
)
PENDULUM_PARAMS = {"m1": 1.0, "m2": 0.5, "l1": 1.0, "l2": 0.7, "g": 9.81}


def read(text):
    return as_expression("H", text)


# --- the reader ---


@pytest.mark.parametrize("name", "E,I,S,N,Q,O,C,beta,gamma,zeta,pi_,lamda,oo,nan,zoo,true,Symbol,cos,exp".split(","))  # noqa: SIM905
def test_names_that_are_not_called_are_the_users(name):
    assert read(f"2*{name}") == 2 * sympy.Symbol(name, real=True)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2*pi", 2 * sympy.pi),
        (".1 + .2", sympy.Rational(3, 10)),
        ("1e-3", sympy.Rational(1, 1000)),
        ("2**0.5", sympy.sqrt(2)),
        ("-2**2", -4),
        ("2 - 3 - 4", -5),
        ("8/4/2", 1),
        ("2**3**2", 512),
        ("+1_000", 1000),
        ("exp(0) + ln(1) + hypot(3, 4) + abs(-2) + max(1, 2) + min(1, 2)", 11),
        ("arcsin(1) - asin(1)", 0),
        ("1 +\n 2", 3),
        ("+".join(["1"] * 700), 700),
    ],
)
def test_values_of_text(text, value):
    assert read(text) == value


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


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: text[:20])
def test_what_is_not_allowed_is_refused(text):
    with pytest.raises(ValueError, match="not a known function" if text == "(sqrt)(x)(y)" else "^H: ") as found:
        read(text)
    assert len(str(found.value)) < 700


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x^2", r"'x\^2' has \^; powers are written \*\*"),
        ("lambda*x", "lambda is a keyword of Python; use another name"),
        ("x.real", "'x.real' is not allowed. Allowed are numbers, names, pi"),
        ("gamma(x)", "'gamma' is not a known function"),
        ("sin(x, y)", "because sin takes 1 argument"),
        ("9**9**9", r"'9\*\*9' is an exponent above 1000"),
    ],
)
def test_errors_say_what_came_and_what_is_allowed(text, says):
    with pytest.raises(ValueError, match=says):
        read(text)


@given(st.text(alphabet="xyp12.+-*/()e _,sincoqrtlambda[]{}='\"\\\n#:@%^&|<>", max_size=40))
def test_any_text_is_read_or_refused(text):
    try:
        found = read(text)
    except ValueError:
        return
    assert isinstance(found, sympy.Expr)


def test_exact_constants_of_moderate_size_are_computed():
    assert read("1.0001**365").evalf(20) == pytest.approx(1.0001**365, rel=1e-14)
    assert read("(1 + 1e-290)**4").is_Rational


def test_a_declared_name_is_neither_a_constant_nor_a_function():
    """pi' = -phi and phi' = pi for H = pi^2/2 + phi^2/2, where pi is the momentum."""
    for problem in (
        hamiltonian("pi**2/2 + phi**2/2", "phi", "pi"),
        equations({"phi": "pi", "pi": "-phi"}, invariants={"H": "pi**2/2 + phi**2/2"}),
        equations(["pi", "-phi"], "phi pi"),
    ):
        np.testing.assert_array_equal(problem.fun(0.0, np.array([1.0, 2.0])), [2.0, -1.0])
    problem = hamiltonian("p**2/2 + pi*q**2/2", params={"pi": 2.0}, invariants={"twice": "p**2 + pi*q**2"})
    np.testing.assert_array_equal(problem.fun(0.0, np.array([1.0, 3.0])), [3.0, -2.0])
    problem = hamiltonian(
        "m1*m2*m3*pi", "m1 m2 m3", poisson=[[0, "-pi", 0], ["pi", 0, 0], [0, 0, 0]], params={"pi": 3.0}
    )
    np.testing.assert_array_equal(problem.fun(0.0, np.array([1.0, 2.0, 5.0])), [-9 * 5.0, 9 * 2.0 * 5.0, 0.0])
    assert hamiltonian("p**2/2 + pi*q**2/2").fun(0.0, np.array([1.0, 3.0]))[1] == -math.pi
    with pytest.raises(ValueError, match="calls log, which is a component or parameter; rename that"):
        hamiltonian("log**2/2 + log(q)", "q", "log")


LEAVES = st.sampled_from(["x", "y", "k", "2", "0.25", "pi", "(-3)"])
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda part: f"({part[0]} {part[1]} {part[2]})"),
        inner.map(lambda part: f"sin({part})"),
        inner.map(lambda part: f"sqrt(1 + {part}**2)"),
        inner.map(lambda part: f"({part} / (2 + cos({part})))"),
        inner.map(lambda part: f"exp(-{part}**2)"),
        inner.map(lambda part: f"(1 + {part}**2)**-1.5"),
        inner.map(lambda part: f"(-{part}**3)"),
        inner.map(lambda part: f"abs({part})"),
        inner.map(lambda part: f"max({part}, atan({part}))"),
    ),
    max_leaves=8,
)


@given(TREES)
def test_functions_compute_what_the_text_says(text):
    """The expression agrees with Python's own arithmetic of the text; it is not compiled, because there are many."""
    from eip_scipy.problems.symbolic import program

    try:
        expression = read(text)
    except ValueError as error:
        assume("too large" not in str(error) and "that a float can represent" not in str(error))
        raise
    arguments = program.Arguments(["x", "y"], ["k"])
    code = program._compiled("test", program._statements("test", [expression], arguments, False), arguments, False)
    y, params = np.array([0.7, -1.3]), np.array([0.9])
    functions = {name: getattr(np, name) for name in ("sin", "cos", "sqrt", "exp", "pi")}
    functions |= {"atan": np.arctan, "x": y[0], "y": y[1], "k": params[0], "abs": abs, "max": max}
    expected = eval(text, functions)
    for known in (program.COMPILED, program.INTERPRETED):
        found = program._made(code, known)(0.0, y, params)
        assert found == pytest.approx(expected, rel=1e-11, abs=1e-11)
    assert set(code.co_names) <= {"size", *program.COMPILED}


def test_names():
    assert as_names("q", "a, b  c") == as_names("q", ["a", sympy.Symbol("b"), "c"]) == ("a", "b", "c")
    for wrong in (["a", "a"], "a-b", "lambda", ["x y"], "t", ["2x"], [""]):
        with pytest.raises(ValueError, match=r"^q: "):
            as_names("q", wrong)
    for wrong in (3, [3], None):
        with pytest.raises(TypeError, match=r"^q: expected names"):
            as_names("q", wrong)


def test_a_name_is_spelled_as_python_spells_it():
    """Python reads the sign for micro as the Greek letter."""
    problem = hamiltonian("p**2/2 + µ*q**2", params={"μ": 2.0})
    assert problem.fun(0.0, [1.0, 0.5]).tolist() == [0.5, -4.0]


def test_expressions_of_sympy():
    x, p, k = sympy.symbols("x p k", positive=True)
    problem = hamiltonian(p**2 / 2 + k * sympy.sqrt(x**2 + 1), [x], [p], params={k: 2.0})
    assert problem.fun(0.0, [-1.0, 0.5]) == pytest.approx([0.5, 2 / math.sqrt(2)])
    for wrong, kind, says in [
        (sympy.I * x, ValueError, "expected a finite real expression"),
        (sympy.Symbol("x") * x, ValueError, "two different symbols called x"),
        (sympy.Function("f")(x) * p**2, ValueError, "is not supported. Supported are"),
        (sympy.Symbol("a b"), ValueError, "not a name"),
        ([x], TypeError, "expected an expression"),
        (True, TypeError, "expected an expression"),
        (1j, TypeError, "expected an expression"),
        (None, TypeError, "expected an expression"),
    ]:
        with pytest.raises(kind, match=says):
            hamiltonian(wrong, [x], [p])


# --- what is paired ---


@pytest.mark.parametrize(
    ("H", "names"),
    [
        (HENON_HEILES, "x y px py"),
        ("p1**2/q1 + p2**2*q2 + p10*q10", "q1 q2 q10 p1 p2 p10"),
        ("p1**2 + p2**2", "q1 q2 p1 p2"),
        ("p_1**2 + p_2**2*q_1", "q_1 q_2 p_1 p_2"),
        ("p**2 - cos(theta)", "theta p"),
        ("p**2", "q p"),
        ("pr**2 + ptheta**2/r**2", "r theta pr ptheta"),
        ("p_r**2 + p_theta**2/r**2", "r theta p_r p_theta"),
        ("p_a**2 + b*p_b", "a b p_a p_b"),
        ("E*pE + I*pI", "E I pE pI"),
    ],
)
def test_pairs(H, names):
    problem = hamiltonian(H)
    half = len(names.split()) // 2
    assert problem.component_names == tuple(names.split())
    assert problem.pairs == tuple(zip(names.split()[:half], names.split()[half:], strict=True))
    assert all(f"{q} with {p}" in repr(problem) for q, p in problem.pairs)


@pytest.mark.parametrize(
    ("H", "match"),
    [
        ("px**2 + k*x**2", r"not clear what k is: .* goes with it \(pairs found: x with px\).*params={'k': 1.0}"),
        ("p**2/(2*m) + k*q**2/2", r"not clear what k and m are: .*pairs found: q with p\).*{'k': 1.0, 'm': 1.0}\. "),
        ("p**2/(2*m*l**2) - m*g*l*cos(theta)", r"not clear what g and l and m are: .*pairs found: theta with p\)"),
        ("px**2 + y", r"not clear what y is: .*params={'y': 1.0}"),
        ("p**2 + a*b", r"not clear what a and b and p are: .* goes with them \(pairs found: none\).*'p': 1.0}"),
        ("3", r"H contains neither coordinates nor momenta\. Names are paired as x with px"),
        ("k", r"not clear what k is"),
    ],
)
def test_names_without_a_partner(H, match):
    with pytest.raises(ValueError, match=match):
        hamiltonian(H)


def test_parameters_by_name_in_runs():
    """Parameters that are not named keep their values; an ensemble takes one for each member."""
    problem, start = hamiltonian("p**2/(2*m) + k*q**2/2", params={"m": sympy.Integer(2), "k": 1.0}), [1.0, 0.0]
    options = {"method": EIPDOP853, "rtol": 1e-9, "atol": 1e-9}
    run = integrate(problem, (0, 3), start, params={"k": 4.0}, **options)
    np.testing.assert_array_equal(run.y, integrate(problem, (0, 3), start, params=[2.0, 4.0], **options).y)
    members = ensemble(problem, (0, 3), start, params={"k": [1.0, 4.0]}, **options)
    np.testing.assert_array_equal(members.y[1], run.y[:, -1])
    for call in (integrate, ensemble):
        with pytest.raises(ValueError, match=r"hamiltonian has no parameter 'K'\. It has m, k\."):
            call(problem, (0, 3), start, params={"K": 4.0}, **options)
        with pytest.raises(TypeError, match=r"the problem 'kepler' has no names for its parameters"):
            call(kepler(), (0, 3), params={"eps": 0.0}, **options)


def test_nystrom_methods_say_what_works():
    """The problem in (q, v) where there is one, and not where there is none."""
    options = {"method": EIPRKN12, "h": 0.1}
    with pytest.raises(ValueError, match=r"Use a Runge-Kutta .*problem\.second_order\(\) returns this problem"):
        integrate(hamiltonian("px**2/4 + x**2/2"), (0, 1), [1.0, 2.0], **options)
    prey = equations({"x": "x*(1 - y)", "y": "y*(x - 1)"})
    for problem in (prey, hamiltonian("px**2*x + x**2")):
        with pytest.raises(ValueError, match=r"Use a Runge-Kutta method such as EIPDOP853, .* half of the state\.$"):
            integrate(problem, (0, 1), [1.0, 2.0], **options)


# --- equations, energies, gradients ---


@pytest.mark.nightly
@pytest.mark.slow
def test_kepler_as_the_packages_own():
    own, problem = kepler(), hamiltonian(KEPLER, params={"eps": 0.005}, invariants=L)
    rng = np.random.default_rng(1)
    for y in rng.normal(size=(20, 4)):
        assert problem.fun(0.0, y) == pytest.approx(own.fun(0.0, y), rel=1e-13)
        for written, known in zip(problem.invariants, own.invariants, strict=True):
            assert written.fun(0.0, y, *written.args) == pytest.approx(known.fun(0.0, y, *known.args), rel=1e-13)
            assert check_gradient(written, 0.0, y) < 1e-10
    run, expected = (
        integrate(problem, own.t_span, own.y0, method=EIPRK4, h=0.03, blocks=2),
        integrate(own, method=EIPRK4),
    )
    assert run.y[:, -1] == pytest.approx(expected.y[:, -1], abs=1e-10)
    assert run.compiled == (not config.DISABLE_JIT)
    assert [item.name for item in problem.invariants] == ["H", "L"]
    assert dict(problem.checks) == {"H": "by construction", "L": "symbolically"}


def test_second_order_methods_take_it():
    own, problem = kepler(), hamiltonian(KEPLER, params={"eps": 0.005}, invariants=L)
    run = integrate(problem, (0, 50), own.y0, method=EIPRKN12, h=0.05)
    expected = integrate(own, (0, 50), method=EIPRKN12, h=0.05, blocks=None)
    assert run.y[:, -1] == pytest.approx(expected.y[:, -1], abs=1e-11)
    steps = stormer_verlet(problem.acc, (0, 5), own.y0, 0.01, params=problem.params)
    others = stormer_verlet(own.acc, (0, 5), own.y0, 0.01, params=own.params)
    assert steps.y[:, -1] == pytest.approx(others.y[:, -1], abs=1e-12)
    oscillator = hamiltonian("(p**2 + q**2)/2")
    assert oscillator.acc(0.0, np.array([3.0])).tolist() == [-3.0]
    for H in ("p**2/4 + q**2", "p**2*q", "p**2/2 + p*q"):  # q' is not p, or p' depends on it
        assert hamiltonian(H).acc is None


def test_multistep_methods_take_their_jacobian():
    problem = hamiltonian(KEPLER, params={"eps": 0.005}, invariants=L)
    q, dq, out, step = np.array([0.7, -0.4]), np.array([0.3, 0.9]), np.empty(2), 1e-5
    problem.jacobian(0.0, q, dq, out, problem.params)
    ends = [problem.acc(0.0, q + sign * step * dq, problem.params) for sign in (1, -1)]
    assert out == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-8)
    own = kepler()
    run = integrate(problem, (0, 20), own.y0, method=EIPGJ12, h=0.01)
    assert run.y[:, -1] == pytest.approx(integrate(own, (0, 20), method=EIPRKN12, h=0.01).y[:, -1], abs=1e-10)
    assert hamiltonian("p**2/2 + abs(q)").jacobian is None  # it has no derivative at 0


@pytest.mark.nightly
@pytest.mark.slow
def test_second_order_of_masses():
    problem = hamiltonian("p1**2/(2*m) + p2**2/4 + p1*p2/10 + q1**2/2 + q2**2*cos(q1)**2", params={"m": 3.0})
    other = problem.second_order()
    assert other.component_names == ("q1", "q2", "v_q1", "v_q2")
    y0 = np.array([0.3, 0.2, 0.1, -0.4])
    W = np.array([[1 / 3, 0.1], [0.1, 0.5]])
    start = np.concatenate([y0[:2], W @ y0[2:]])
    run = integrate(other, (0, 5), start, method=EIPRKN12, h=0.05)
    expected = integrate(problem, (0, 5), y0, method=EIPDOP853, rtol=1e-11, atol=1e-11)
    assert run.y[:2, -1] == pytest.approx(expected.y[:2, -1], abs=1e-8)
    assert other.invariants[0].fun(0.0, start, other.params) == pytest.approx(
        problem.invariants[0].fun(0.0, y0, problem.params)
    )
    assert other.acc is not None
    for H in ("p**2*q", "(p - q)**2/2", "p**4", "sqrt(1 + p**2)"):
        with pytest.raises(ValueError, match="second_order needs"):
            hamiltonian(H).second_order()
    with pytest.raises(ValueError, match="second_order needs"):
        equations(["v", "-x"], "x v").second_order()
    with pytest.raises(ValueError, match="second_order needs"):
        hamiltonian(DRIVEN, extended=True).second_order()


def test_henon_heiles_as_written_by_hand():
    def rhs(t, y):
        return [y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] * y[0] + y[1] * y[1]]

    y0 = [0.0, 0.1, 0.5, 0.0]
    run = integrate(hamiltonian(HENON_HEILES), (0, 100), y0, method=EIPDOP853, rtol=1e-10, atol=1e-10)
    expected = solve_ivp(rhs, (0, 100), y0, method="DOP853", rtol=1e-12, atol=1e-12)
    assert run.y[:, -1] == pytest.approx(expected.y[:, -1], abs=1e-8)
    assert run.trusted
    assert run.max_defect[0] < 1e-14


@pytest.mark.nightly
@pytest.mark.slow
def test_double_pendulum_against_scipy():
    problem = hamiltonian(DOUBLE_PENDULUM, "th1 th2", "p1 p2", params=PENDULUM_PARAMS)
    y0 = np.array([1.0, 0.5, 0.2, -0.1])
    (energy,) = problem.invariants
    grad = np.empty(4)
    energy.grad(0.0, y0, grad, *energy.args)
    assert problem.fun(0.0, y0) == pytest.approx([grad[2], grad[3], -grad[0], -grad[1]], rel=1e-13)
    assert check_gradient(energy, 0.0, y0) < 1e-10
    run = integrate(problem, (0, 5), y0, method=EIPDOP853, rtol=1e-11, atol=1e-11)
    sol = solve_ivp(problem.fun, (0, 5), y0, method="DOP853", rtol=1e-12, atol=1e-12)
    assert run.y[:, -1] == pytest.approx(sol.y[:, -1], abs=1e-8)


def test_rigid_body_by_its_poisson_matrix():
    problem = hamiltonian(TOP, "m1 m2 m3", poisson=SO3, params=INERTIA, invariants={"C": "m1**2 + m2**2 + m3**2"})
    euler = equations(
        {"m1": "m2*m3*(1/I3 - 1/I2)", "m2": "m3*m1*(1/I1 - 1/I3)", "m3": "m1*m2*(1/I2 - 1/I1)"},
        params=INERTIA,
        invariants={"H": TOP, "C": "m1**2 + m2**2 + m3**2"},
    )
    y0 = np.array([1.0, 0.2, 0.3])
    assert problem.fun(0.0, y0) == pytest.approx(euler.fun(0.0, y0), rel=1e-14)
    assert dict(euler.checks) == {"H": "symbolically", "C": "symbolically"}
    runs = [integrate(item, (0, 100), y0, method=EIPDOP853, rtol=1e-9, atol=1e-9) for item in (problem, euler)]
    assert runs[0].y[:, -1] == pytest.approx(runs[1].y[:, -1], abs=1e-6)
    assert (runs[0].max_defect < 1e-13).all()
    for poisson, says in [
        ([[0, 1], [-1, 0]], r"shape \(3, 3\)"),
        ([[0, 1, 0], [1, 0, 0], [0, 0, 0]], "must be antisymmetric"),
        ([[1, 0, 0], [0, 0, 0], [0, 0, 0]], "must be antisymmetric"),
    ]:
        with pytest.raises(ValueError, match=says):
            hamiltonian(TOP, "m1 m2 m3", poisson=poisson, params=INERTIA)
    for names in ({}, {"q": "m1 m2 m3", "p": "a b c"}):
        with pytest.raises(TypeError, match="names of the whole state as q"):
            hamiltonian(TOP, poisson=SO3, params=INERTIA, **names)


# A driven oscillator, x'' = -x + cos(2 t) from rest: x = (cos t - cos 2t) / 3.
DRIVEN = "p**2/2 + x**2/2 - x*cos(2*t)"


def test_h_that_depends_on_time():
    with pytest.warns(UserWarning, match=r"H depends on t, so that it is not an invariant.*extended=True") as told:
        problem = hamiltonian(DRIVEN)
    assert told[0].filename == __file__
    assert problem.invariants == ()
    assert "invariants  none" in repr(problem)
    run = integrate(problem, (0, 3), [0.0, 0.0], method=EIPDOP853, rtol=1e-10, atol=1e-12)
    assert run.y[0, -1] == pytest.approx((math.cos(3) - math.cos(6)) / 3, abs=1e-9)


def test_h_that_depends_on_time_extended():
    problem = hamiltonian(DRIVEN, extended=True)
    assert problem.component_names == ("x", "p", "p_t")
    run = integrate(problem, (0, 3), [0.0, 0.0, 0.0], method=EIPDOP853, rtol=1e-10, atol=1e-12)
    assert run.y[0, -1] == pytest.approx((math.cos(3) - math.cos(6)) / 3, abs=1e-9)
    assert run.max_defect[0] < 1e-14
    assert run.trusted


def test_invariants_of_time():
    """x - v t of a free particle."""
    problem = equations(["v", "0"], "x v", invariants={"start": "x - v*t"})
    run = integrate(problem, (1, 3), [0.5, 2.0], method=EIPRK4, h=0.1)
    assert run.y[:, -1] == pytest.approx([4.5, 2.0])
    assert run.max_defect[0] < 1e-14


# --- invariants by their brackets ---


@pytest.mark.parametrize(
    ("H", "invariants", "params", "how"),
    [
        (KEPLER, L, {"eps": 0.1}, "symbolically"),
        ("(p1**2 + p2**2)/2 + exp(q1 - q2)", {"P": "p1 + p2"}, None, "symbolically"),
        ("(px**2 + py**2)/2 + (x**2 + k*y**2)/2", L, {"k": 1.0}, "numerically, at 8 points with the parameters given"),
        # A function of the energy, whose bracket would take minutes to expand.
        (HENON_HEILES, {"H^20": f"({HENON_HEILES} + 1)**20"}, None, "numerically, at 8 points"),
        # Next to q = 2 and q = -2 too.
        (
            "p**2/2 + max(abs(q) - k, 0)**2/2",
            {"H^30": "(p**2/2 + max(abs(q) - 2, 0)**2/2 + sin(p)**2 + cos(p)**2)**30"},
            {"k": 2.0},
            "numerically, at 48 points with the parameters given",
        ),
    ],
)
def test_how_invariants_are_known(H, invariants, params, how):
    problem = hamiltonian(H, params=params, invariants=invariants)
    (name,) = invariants
    assert problem.checks[name] == how
    assert how in repr(problem)


@pytest.mark.parametrize(
    ("H", "invariants", "says"),
    [
        ("(px**2 + py**2)/2 + x**2 + 2*y**2", L, r"'L' is not an invariant of these equations: its rate is .*\. At x="),
        (HENON_HEILES, {"I": f"({HENON_HEILES})**13 + 1e-9*x"}, "'I' is not an invariant"),
        (HENON_HEILES, {"I": "z"}, "contains z, which is neither a component of the state nor a parameter"),
        (HENON_HEILES, {"I": "3"}, "does not depend on x, y, px, py"),
        (HENON_HEILES, {"H": "x"}, "H is already the name of an invariant"),
        (HENON_HEILES, {"I": "sqrt(-2 - x**2)"}, "not finite and real at any point"),
        # Constant in one branch, which all points of moderate size are in.
        ("(p**2 + q**2)/2", {"I": "max(q, 3)"}, r"its rate is p\*Heaviside\(q - 3\)\. At q="),
        ("(p**2 + q**2)/2", {"I": "max(q**2, 1e8)"}, "'I' is not an invariant"),
        ("(p**2 + q**2)/2", {"I": "max(q, 3) - max(q, 3.001)"}, "'I' is not an invariant"),
        ("(p**2 + q**2)/2", {"I": "min(-7, q)*abs(p)"}, "'I' is not an invariant"),
        ("(p**2 + q**2)/2", {"I": "abs(q + 9) - q"}, "'I' is not an invariant"),
        ("(p**2 + q**2)/2", {"I": "max(sin(q), 2)"}, r"changes its branch, so that it cannot be checked"),
    ],
)
def test_what_is_no_invariant_is_refused(H, invariants, says):
    with pytest.raises(ValueError, match=says):
        hamiltonian(H, invariants=invariants)


# --- errors of the arguments ---


@pytest.mark.parametrize(
    ("call", "kind", "says"),
    [
        (lambda: hamiltonian("p**2", "q"), TypeError, "give both q and p, or neither"),
        (lambda: hamiltonian("p**2", "q r", "p"), ValueError, "2 coordinates"),
        (lambda: hamiltonian("p**2", "q", "q"), ValueError, "occurs twice"),
        (lambda: hamiltonian("p**2*k", "q", "p"), ValueError, "contains k, which is neither"),
        (lambda: hamiltonian("a**2", "q", "p", params={"a": 1}), ValueError, "does not depend on q, p"),
        (lambda: hamiltonian("p**2", "q", "p", params={"q": 1}), ValueError, "of the state and of a parameter"),
        (lambda: hamiltonian("p**2", params=3), TypeError, "params must be a mapping"),
        (lambda: hamiltonian("p**2", params={"k": math.inf}), ValueError, "k must be a finite number, got inf"),
        (lambda: hamiltonian("p**2", params={"k": "1"}), ValueError, "k must be a finite number, got '1'"),
        (lambda: hamiltonian("p**2", params={"k": sympy.I}), ValueError, "k must be a finite number, got I"),
        (lambda: hamiltonian("p**2", params={"k": sympy.Symbol("a")}), ValueError, "k must be a finite number, got a"),
        (lambda: hamiltonian("p**2", invariants=["p"]), TypeError, "invariants must be a mapping"),
        (lambda: hamiltonian("p**2", invariants={1: "p"}), TypeError, "names must be strings"),
        (lambda: hamiltonian("p**2", name=3), TypeError, "name must be a string"),
        (lambda: equations(["y", "-x"]), TypeError, "y is missing"),
        (lambda: equations(["y"], "x y"), ValueError, "1 derivatives for the 2 components"),
        (lambda: equations({"x": "y", "y": "-x"}, "x z"), ValueError, "f has derivatives of x, y, but y is x, z"),
        (lambda: equations({"x": "y", "y": "-z"}), ValueError, "contains z, which is neither"),
        (lambda: hamiltonian("p**2/2 + sign(q - 1)"), ValueError, "function that jumps where q - 1 is 0"),
    ],
)
def test_wrong_arguments(call, kind, says):
    with pytest.raises(kind, match=says):
        call()


def test_states_and_parameters_of_another_length():
    """Compiled code would read memory behind them."""
    problem = hamiltonian(KEPLER, params={"eps": 0.005})
    for y0, params in (([1.0, 0.0, 0.0], None), (np.ones(6), None), (np.ones(4), [1.0, 2.0]), (np.ones(4), [])):
        with pytest.raises(ValueError, match="must hold as many numbers as there are names in"):
            integrate(problem, (0, 1), y0, params=params, method=EIPRK4, h=0.1)


def test_a_start_and_an_interval_are_for_the_run():
    problem = hamiltonian(HENON_HEILES, name="Henon-Heiles")
    with pytest.raises(TypeError, match="y0 is missing"):
        integrate(problem, (0, 1), method=EIPRK4, h=0.1)
    with pytest.raises(TypeError, match="y0s is missing"):
        ensemble(problem, (0, 1), method=EIPRK4, h=0.1)
    start = dataclasses.replace(problem, y0=np.array([0.0, 0.1, 0.5, 0.0]), t_span=(0.0, 1.0))
    assert integrate(start, method=EIPRK4, h=0.1).success
    assert repr(start).startswith("Henon-Heiles: y = (x, y, px, py), pairs x with px, y with py\n")


# --- functions: jitted or not, in ensembles, in other processes ---


def test_cube_roots_are_real():
    problem = hamiltonian("p**2/2 + 3*cbrt(q)**4/4 + q*cbrt(2*q)", name="root")
    for q in (-8.0, -0.3, 0.0, 0.7):
        root, two = np.cbrt(q), np.cbrt(2.0)
        force = -(root + 4 / 3 * two * root)
        y, out = np.array([q, 0.5]), np.empty(4)
        assert problem.fun(0.0, y) == pytest.approx([0.5, force], rel=1e-14, abs=1e-300)
        (energy,) = problem.invariants
        assert energy.fun(0.0, y) == pytest.approx(0.125 + (0.75 + two) * root**4, rel=1e-14)
        gradient = np.empty(2)
        energy.grad(0.0, y, gradient)
        assert gradient == pytest.approx([-force, 0.5], rel=1e-14, abs=1e-300)
        if q:
            problem.variational(())(0.0, np.array([*y, 1.0, 0.0]), out)
            assert out[3] == pytest.approx(-(1 + 4 / 3 * two) / 3 / root**2, rel=1e-14)
    run = integrate(problem, (0, 10), [-1.0, 0.0], method=EIPDOP853, rtol=1e-9, atol=1e-9, save_every=1)
    assert run.success
    assert run.y[0].max() > 0.9
    assert repr(pickle.loads(pickle.dumps(problem))) == repr(problem)


@pytest.mark.parametrize(
    ("text", "root"),
    [("cbrt(-8)", "-2"), ("cbrt(-x)", "-cbrt(x)"), ("cbrt(x)**3", "x"), ("cbrt(x**2 + 1)", "(x**2 + 1)**(1/3)"),
     ("cbrt(-16*x)/cbrt(-2*x)", "2")],
)  # fmt: skip
def test_algebra_of_cube_roots(text, root):
    assert str(as_expression("x", text)) == root


def test_roots_are_kept_for_both_signs():
    kept = {"E": "y**2/2 + 3*cbrt(x)**4/4", "F": "cbrt(y**2/2 + 3*cbrt(x)**4/4 - 1)"}
    assert equations({"x": "y", "y": "-cbrt(x)"}, invariants=kept).checks == dict.fromkeys(kept, "symbolically")
    with pytest.raises(ValueError, match="not an invariant"):
        equations({"x": "y", "y": "-cbrt(x)"}, invariants={"E": "y**2/2 + 3*abs(x)*cbrt(x)/4"})


def test_without_numba(monkeypatch):
    H = "(px**2 + py**2)/2 + log(x) + atan2(y, x) + sqrt(1 + y**2) + abs(y) + max(x, y) + cbrt(x) + y*cbrt(y)"
    y = np.array([1.2, -0.4, 0.3, 0.1])
    compiled = hamiltonian(H, name="one")
    from eip_scipy.core import jitted as module
    from eip_scipy.problems.symbolic import system

    monkeypatch.setattr(module, "find_spec", lambda name: None)
    system._functions.cache_clear()
    plain = hamiltonian(H, name="one")
    system._functions.cache_clear()
    assert "plain Python" in repr(plain)
    assert plain.fun(0.0, y) == pytest.approx(compiled.fun(0.0, y), rel=1e-14)
    assert plain.invariants[0].fun(0.0, y) == pytest.approx(compiled.invariants[0].fun(0.0, y), rel=1e-14)
    runs = [integrate(item, (0, 0.5), y, method=EIPRK45, rtol=1e-9) for item in (plain, compiled)]
    assert not runs[0].compiled
    assert runs[0].y[:, -1] == pytest.approx(runs[1].y[:, -1], rel=1e-9)
    with np.errstate(all="ignore"):  # where a step reaches too far there is no exception
        assert np.isnan(plain.invariants[0].fun(0.0, np.array([-1.0, 0.1, 0.0, 0.0])))


def test_equal_systems_share_their_functions():
    a, b = (hamiltonian(KEPLER, params={"eps": eps}, invariants=L) for eps in (0.005, 0.1))
    assert a.rhs is b.rhs
    assert a.fun(0.0, np.ones(4)).tolist() != b.fun(0.0, np.ones(4)).tolist()


def test_problems_pickle_and_copy():
    y0 = kepler().y0
    problem = dataclasses.replace(hamiltonian(KEPLER, params={"eps": 0.005}, invariants=L), y0=y0, t_span=(0.0, 5.0))
    own = dataclasses.replace(problem, invariants=(problem.invariants[1],))
    for item in (problem, own):
        for other in (pickle.loads(pickle.dumps(item)), copy.deepcopy(item)):
            assert repr(other) == repr(item)
            runs = [integrate(one, method=EIPRK4, h=0.03) for one in (item, other)]
            assert np.array_equal(runs[0].y, runs[1].y)
            assert len(other.invariants) == len(item.invariants)


@pytest.mark.slow
def test_members_side_by_side_and_in_other_processes(monkeypatch):
    monkeypatch.setattr(tasks, "LEAST_WORK", 0.0)
    problem = hamiltonian(KEPLER, params={"eps": 0.005}, invariants=L)
    y0s = kepler().y0 * np.linspace(0.99, 1.01, 64)[:, None]
    options = {"method": EIPRK4, "h": 0.01}
    found = ensemble(problem, (0, 10), y0s, **options)
    assert found.one_by_one == ""
    single = integrate(problem, (0, 10), y0s[5], **options)
    assert np.array_equal(found.y[5], single.y[:, -1])
    with ProcessPoolExecutor(2) as executor:
        other = ensemble(problem, (0, 10), y0s, executor=executor, **options)
    assert np.array_equal(found.y, other.y)


@pytest.mark.slow
def test_code_is_the_same_in_every_process():
    """The result does not depend on the order of sets; this process has its own seed."""
    code = (
        "from eip_scipy import hamiltonian\n"
        f"rhs = hamiltonian({DOUBLE_PENDULUM!r}, 'th1 th2', 'p1 p2', params={PENDULUM_PARAMS!r}).rhs\n"
        "print(rhs.__code__.co_code.hex(), rhs.__code__.co_consts)"
    )
    seed = {"PYTHONHASHSEED": "1", "NUMBA_DISABLE_JIT": "1"}  # the code, not what becomes of it
    there = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | seed, capture_output=True, text=True, check=True
    )
    rhs = hamiltonian(DOUBLE_PENDULUM, "th1 th2", "p1 p2", params=PENDULUM_PARAMS).rhs
    here = getattr(rhs, "py_func", rhs).__code__
    assert there.stdout == f"{here.co_code.hex()} {here.co_consts}\n"


def test_sympy_is_loaded_by_its_callers_alone():
    code = "import sys; from eip_scipy import hamiltonian, equations, problems; print('sympy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_without_sympy(monkeypatch):
    from eip_scipy.problems import symbolic

    monkeypatch.setattr(symbolic, "find_spec", lambda name: None)
    for call in (lambda: hamiltonian("p**2"), lambda: equations(["x"], "x")):
        with pytest.raises(ImportError, match=r'needs SymPy: python -m pip install "eip_scipy\[sympy\]"'):
            call()


def test_piecewise_and_reciprocals_are_those_of_sympy():
    x, y = sympy.symbols("x y", real=True)
    steps = sympy.Piecewise((x**2, x < 1), (sympy.sec(x) + sympy.cot(x), (x >= 1) & (x < 2)), (3, True))
    others = sympy.Piecewise((sympy.csc(y), sympy.Not(sympy.Eq(x, y)) | (x > 5)), (x, x <= y))
    problem = equations({"x": steps, "y": others})
    for point in ((0.5, 0.7), (1.0, 0.7), (1.5, 0.7), (2.0, 2.0), (2.5, 0.7), (6.0, 6.0)):
        expected = [float(item.subs({x: point[0], y: point[1]})) for item in (steps, others)]
        np.testing.assert_allclose(problem.fun(0.0, np.array(point)), expected, rtol=1e-14)
