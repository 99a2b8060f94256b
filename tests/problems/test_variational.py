"""Variational equations of problems: against differences of order 8 of their right-hand sides, at random states."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numba import njit
from systems import DOUBLE_PENDULUM, HENON_HEILES, INERTIA, RELATIVISTIC_KEPLER, RIGID_BODY, SO3, TWO_RODS

from eip_scipy import EIPDOP853, equations, hamiltonian, integrate
from eip_scipy.problems import ForceConstants, ParticleField, charged_particle, harmonic, kepler, nbody

WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}  # of central differences of order 8
STEP = 2.0**-7
RTOL = 1e-9  # of the largest number in a column
SYMBOLIC = {
    "henon-heiles": lambda: hamiltonian(HENON_HEILES),
    "kepler": lambda: hamiltonian(RELATIVISTIC_KEPLER, params={"eps": 0.1}),
    "double pendulum": lambda: hamiltonian(DOUBLE_PENDULUM, "th1 th2", "p1 p2", params=TWO_RODS),
    "rigid body": lambda: hamiltonian(RIGID_BODY, "m1 m2 m3", poisson=SO3, params=INERTIA),
    "driven": lambda: hamiltonian("p**2/2 - cos(q) + a*q*sin(w*t)", params={"a": 0.3, "w": 1.7}, extended=True),
    "friction": lambda: hamiltonian("p**2/2 + q**4/4", dissipation={"p": "-c*p"}, params={"c": 0.2}),
    "lorenz": lambda: equations(
        {"x": "s*(y - x)", "y": "x*(r - z) - y", "z": "x*y - b*z"}, params={"s": 10.0, "r": 28.0, "b": 8 / 3}
    ),
    "functions": lambda: equations({"x": "a*x*abs(x) + atan2(y, 2 + x**2)", "y": "max(x, 3*y)"}, params={"a": 2.0}),
    "constant": lambda: equations({"x": "1", "y": "0"}),
}


def difference(fun, x, along):
    """Return the derivative of fun(x) along a direction."""
    steps = STEP / np.abs(along).max()
    return sum(w * (fun(x + k * steps * along) - fun(x - k * steps * along)) for k, w in WEIGHTS.items()) / steps


def in_place(rhs, t, y, params):
    """Return what a function writes, which is not compiled: there are many, and the expressions are the same."""
    out = np.full_like(y, np.nan)
    getattr(rhs, "py_func", rhs)(t, y, out, *(() if params is None else (params,)))
    return out


def assert_variational(problem, y, rng, parameters=(), columns=3, t=0.4, rtol=RTOL):
    """Compare all columns with differences, and the state's derivative with the problem's own, bit for bit."""
    n, params = y.size, problem.params
    directions = rng.standard_normal((columns + len(parameters), n))
    Y = np.concatenate([y, directions.ravel()])
    found = in_place(problem.variational(parameters), t, Y, params).reshape(-1, n)
    np.testing.assert_array_equal(found[0], in_place(problem.rhs, t, y, params))
    for k, (direction, column) in enumerate(zip(directions, found[1:], strict=True)):
        expected = difference(lambda y: in_place(problem.rhs, t, y, params), y, direction)
        if k >= columns:
            unit = np.eye(params.size)[parameters[k - columns]]
            expected += difference(lambda p: in_place(problem.rhs, t, y, p), params, unit)
        np.testing.assert_allclose(column, expected, rtol=0, atol=rtol * max(np.abs(expected).max(), 1e-300))


# --- problems of expressions ---


@pytest.mark.parametrize("name", SYMBOLIC)
def test_expressions(name):
    problem, rng = SYMBOLIC[name](), np.random.default_rng(1)
    count = len(problem.parameters)
    for parameters in {(), tuple(range(count)), tuple(range(count))[::-2]}:
        y = rng.uniform(0.3, 1.3, len(problem.component_names))
        assert_variational(problem, y, rng, parameters, columns=0 if parameters else 3)
        assert_variational(problem, y, rng, parameters, columns=2)


@pytest.mark.needs_jit
def test_compiled_columns_are_those_of_the_expressions_and_check_sizes():
    problem, Y, out = SYMBOLIC["lorenz"](), np.random.default_rng(2).uniform(0.3, 1.3, 9), np.empty(9)
    columns, params = problem.variational((0,)), problem.params
    columns(0.4, Y, out, params)
    np.testing.assert_allclose(out, in_place(columns, 0.4, Y, params), rtol=1e-14)
    for arguments, says in [
        ((np.ones(3), np.ones(3), params), "3 numbers each, and at least 1 columns"),
        ((np.ones(7), np.ones(7), params), "3 numbers each"),
        ((np.ones(6), np.ones(3), params), "out must be as long as y"),
        ((np.ones(6), np.ones(6), params[:2]), "params must hold as many numbers"),
    ]:
        with pytest.raises(ValueError, match=says):
            columns(0.0, *arguments)


BRANCHES = {  # forces that are continuous where the functions change their branches
    "abs": lambda: hamiltonian("p**2/2 + abs(q)**3"),
    "max": lambda: hamiltonian("p**2/2 + max(q - k, 0)**4 + min(q, 0)**2", params={"k": 0.3}),
    "sign": lambda: hamiltonian("p**2/2 + sign(q)*q**2/2 + sign(2*q - 1)*(q - 0.5)**2"),
    "of a function": lambda: hamiltonian("p**2/2 + sign(sin(q))*sin(q)**3"),
    "of a product": lambda: hamiltonian("(p**2 + q**2)/2 + abs(p*q)**3"),
    "of time": lambda: equations({"x": "y", "y": "-x + sign(sin(t))"}),
}


def test_continuous_forces_with_branches_have_derivatives():
    """States are away from the branches, where differences of order 8 would not have their order."""
    rng = np.random.default_rng(4)
    for make in BRANCHES.values():
        problem = make()
        for y in ([0.9, 0.4], [-0.8, 0.7], [0.7, -0.5]):
            assert_variational(problem, np.array(y), rng, tuple(range(len(problem.parameters))), rtol=1e-6)


def test_what_has_no_derivative():
    for H in ("abs(q)", "max(q, 0)", "max(q, p)**3", "sign(q)*q", "sign(q)*abs(q)", "sign(q)**3*q"):
        with pytest.raises(ValueError, match=r"the derivative of [qp] jumps where .* is 0, or is not seen to be cont"):
            hamiltonian(f"p**2/2 + {H}").variational(())
    problem = equations({"x": "y", "y": "sign(x)"}, params={"a": 1.0})
    for parameters, says in [
        ((), "the derivative of y jumps where x is 0"),
        ((1,), "no parameter 1; expected indices of"),
        ((-1,), "no parameter -1"),
    ]:
        with pytest.raises(ValueError, match=says):
            problem.variational(parameters)


def test_derivatives_of_a_run_through_branches():
    """The force has a kink at q = 0.5, through which the run passes."""
    problem = hamiltonian("p**2/2 + q**2/2 + max(q - 0.5, 0)**2 + sign(q)*q**2/4")
    options, step = {"method": EIPDOP853, "h": 0.002}, 1e-6
    run = integrate(problem, (0, 5), [1.0, 0.2], variations="state", **options)
    for k, unit in enumerate(step * np.eye(2)):
        ends = [integrate(problem, (0, 5), [1.0, 0.2] + side * unit, **options).y[:, -1] for side in (1, -1)]
        assert run.stm[-1][:, k] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-4)


# --- problems of the library ---


@pytest.mark.parametrize("problem", [kepler(relativistic=0.3), harmonic(omega=1.7)], ids=["kepler", "harmonic"])
def test_kepler_and_harmonic(problem):
    rng = np.random.default_rng(3)
    for columns, parameters in product((0, 1, 4), ((), (0,))):
        assert_variational(problem, rng.uniform(0.5, 1.5, problem.y0.size), rng, parameters, columns)
        with pytest.raises(ValueError, match=r"columns of [24] numbers, and 1 parameter"):
            in_place(problem.variational(parameters), 0.0, np.ones(7), problem.params)
    with pytest.raises(ValueError, match=r"by its state and only by parameter 0, .*; got parameters=\(1,\)"):
        problem.variational((1,))


def bodies(rng, n, test_particles=False):
    """Return random bodies that are not close to each other."""
    gm = rng.uniform(0.1, 1.0, n)
    if test_particles:
        gm[1::2] = 0.0
    places = np.array([(i, j, k) for i in range(3) for j in range(3) for k in range(3)], dtype=float)
    return gm, rng.permutation(places)[:n] + rng.uniform(-0.2, 0.2, (n, 3)), rng.uniform(-0.5, 0.5, (n, 3))


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 16, 17, 18, 27])
def test_newton(n):
    rng = np.random.default_rng(n)
    for columns in (1, 3, 11):
        problem = nbody(*bodies(rng, n, test_particles=columns == 3), t_span=(0.0, 1.0))
        assert_variational(problem, problem.y0, rng, (), columns)


RELATIVITY = [(), ("1pn",), ("eih",), ("gr-potential",)]
OTHERS = [(), ("j2",), ("j4",), ("moon-quadrupole",), ("j2", "j4", "moon-quadrupole"), ("drag",)]
OTHERS += [("j2", "drag", "radiation")]
# They make all forces as large as Newton's.
CONSTANTS = ForceConstants(
    c=1.5,
    j2=0.4,
    j4=-0.1,
    pole=[1.0, -2.0, 0.5],
    moon_body=1,
    moon=0.3,
    drag=0.2,
    drag_radius=0.9,
    scale_height=1.1,
    spin=0.3,
)


def constants(n):
    """Return the constants for n bodies, the last of which stands for two; radiation acts on some that have a mass."""
    acts = [True] if n == 2 else np.arange(1, n) % 2 == 0
    return replace(CONSTANTS, moon_body=n - 1, beta=np.append(0.0, 0.1 * np.array(acts)))


@pytest.mark.parametrize("n", [2, 4, 10])
def test_forces(n):
    options = {"t_span": (0.0, 1.0), "constants": constants(n)}
    for relativity, others in product(RELATIVITY, OTHERS):
        rng = np.random.default_rng(n)
        for particles in (False, True):
            problem = nbody(*bodies(rng, n, particles), forces=(*relativity, *others), **options)
            assert_variational(problem, problem.y0, rng, (), 5)


@pytest.mark.parametrize("relativity", RELATIVITY)
@pytest.mark.parametrize("others", OTHERS)
@pytest.mark.parametrize("n", [2, 5])
def test_derivatives_by_masses_and_constants(n, relativity, others):
    """Sensitivities of short runs against differences of order 8 in each parameter."""
    rng = np.random.default_rng(n)
    options = {"constants": constants(n), "forces": (*relativity, *others)}
    problem = nbody(*bodies(rng, n, test_particles=n > 2), t_span=(0.0, 0.1), **options)
    names = [name for name, value in problem.parameters.items() if name[:3] == "gm_" or value != 0]
    names = [name for name in names if name not in ("relativity", "moon_body")]
    run = integrate(problem, method=EIPDOP853, h=0.01, variations=["state", *names], check=False)
    bare = integrate(problem, method=EIPDOP853, h=0.01, variations=["state", *names], invariants=())
    for k, name in enumerate(names):
        unit = np.eye(problem.params.size)[list(problem.parameters).index(name)]

        def end(p):
            return integrate(problem, params=p, method=EIPDOP853, h=0.01, invariants=()).y[:, -1]

        expected = difference(end, problem.params, unit * min(1.0, 4 * (problem.params @ unit) or 1.0))
        expected /= min(1.0, 4 * (problem.params @ unit) or 1.0)
        for found in (run.sensitivities[-1][:, k], bare.sensitivities[-1][:, k]):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * max(np.abs(expected).max(), 1e-3))


def test_what_is_no_constant_has_no_derivative():
    problem = nbody(*bodies(np.random.default_rng(0), 3), t_span=(0.0, 1.0), forces="1pn", constants=CONSTANTS)
    assert list(problem.parameters)[:4] == ["gm_0", "gm_1", "gm_2", "relativity"]
    with pytest.raises(
        ValueError, match="the parameter 'relativity' chooses a force, or belongs to one that the problem does"
    ):
        integrate(problem, method=EIPDOP853, h=0.1, variations=["relativity"])
    with pytest.raises(ValueError, match="the parameter 'j2' chooses a force, or belongs to one that"):
        integrate(problem, method=EIPDOP853, h=0.1, variations=["gm_0", "j2"])
    with pytest.raises(ValueError, match="the parameter 'beta' chooses a force, or belongs to one that"):
        integrate(problem, method=EIPDOP853, h=0.1, variations=["beta_1"])
    particle = [1.0, 0.0], np.eye(3)[:2], np.eye(3)[:2][::-1]
    problem = nbody(*particle, t_span=(0.0, 1.0), forces="radiation", constants=constants(2))
    with pytest.raises(ValueError, match="derivative by G m of body 1, which is 0, while radiation acts on it"):
        integrate(problem, method=EIPDOP853, h=0.1, variations=["gm_1"])


def test_columns_do_not_depend_on_each_other():
    """A column has the bits that it has alone."""
    rng = np.random.default_rng(4)
    problem = nbody(*bodies(rng, 10), t_span=(0.0, 1.0))
    columns = rng.standard_normal((19, 60))
    together = in_place(problem.variational(()), 0.0, np.append(problem.y0, columns), problem.params)
    for column, found in zip(columns, together.reshape(-1, 60)[1:], strict=True):
        alone = in_place(problem.variational(()), 0.0, np.append(problem.y0, column), problem.params)
        np.testing.assert_array_equal(alone[60:], found)


# --- charged particles, by dual numbers ---


@pytest.mark.needs_jit
@pytest.mark.slow
@pytest.mark.nightly
def test_flow_of_a_particle():
    """Sensitivities of a projected run, against complex steps through the closed form: drift in constant fields."""
    E, B = 0.3, 1.7

    def exact(s, t):  # s: x, y, u, v, mass, charge; E along x, B along z
        x, y, u, v, m, q = s
        w, drift = q * B / m, -E / B
        c, n, v = np.cos(w * t), np.sin(w * t), v - drift
        return np.array([x + (u * n + v * (1 - c)) / w, y + drift * t + (v * n - u * (1 - c)) / w,
                         u * c + v * n, drift + v * c - u * n])  # fmt: skip

    field = ParticleField(
        magnetic=njit(lambda x, y, z: (0.0, 0.0, B)), potential=njit(lambda x, y, z: -E * x),
        electric=njit(lambda x, y, z: (E, 0.0, 0.0)),
    )  # fmt: skip
    s, t = np.array([0.2, 0.1, 0.4, -0.3, 1.2, 0.9]), 40.0
    problem = charged_particle(
        field, [*s[:2], 0.0], [*s[2:4], 0.0], t_span=(0, t), mass=s[4], charge=s[5], form="velocity"
    )
    run = integrate(problem, method=EIPDOP853, h=0.1, variations=["state", "mass", "charge"])
    slopes = np.array([exact(s + 1e-30j * unit, t).imag / 1e-30 for unit in np.eye(6)]).T
    columns = run.variations[-1][np.ix_([0, 1, 3, 4], [0, 1, 3, 4, 6, 7])]
    assert np.abs(columns - slopes).max() < 1e-10 * np.abs(slopes).max()
    alone, wide = (integrate(problem, method=EIPDOP853, h=0.1, variations=asked) for asked in (None, "state"))
    np.testing.assert_array_equal(wide.y, alone.y)
