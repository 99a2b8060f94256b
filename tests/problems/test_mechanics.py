"""Models of SymPy as mechanical systems: their equations, energies, momenta, inputs, parameters, and wrong input."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from numba import extending, njit
from scipy.integrate import solve_ivp
from sympy.physics import mechanics as me

from eip_scipy import EIPDOP853, ensemble, integrate
from eip_scipy.problems import mechanics
from eip_scipy_studies.bench import mechanisms as examples

G = 9.81
TIME = me.dynamicsymbols._t
x, y, u, v, push, pull, shift = me.dynamicsymbols("x y u v push pull shift")
k, l, m, g = sympy.symbols("k l m g")  # noqa: E741
FRAME, ORIGIN = me.ReferenceFrame("N"), me.Point("O")
ORIGIN.set_vel(FRAME, 0)
WEIGHT = {m: 1, g: G}
LAGRANGIAN = (x.diff() ** 2 + y.diff() ** 2) / 2 - G * y


def run(problem, tolerance=1e-9, **options):
    return integrate(problem, method=EIPDOP853, rtol=tolerance, atol=tolerance, **options)


def interpreted(function):
    """Return a function that is not compiled, for a single call."""
    return getattr(function, "py_func", function)


def moving(velocity, place=None):
    """Return a point of this velocity, at a place or anywhere."""
    point = me.Point("P") if place is None else ORIGIN.locatenew("P", place)
    point.set_vel(FRAME, velocity)
    return point


IN_THE_PLANE = x * FRAME.x + y * FRAME.y


def on_a_line(force, mass=1, speed=u, **options):
    """Return a particle at x with a force along x, by Kane's method."""
    point = moving((x.diff() if options.pop("by_rate", False) else speed) * FRAME.x)
    model = me.KanesMethod(FRAME, [x], [speed], kd_eqs=[x.diff() - speed], **options)
    model.kanes_equations([me.Particle("A", point, mass)], [(point, force * FRAME.x)])
    return model


def on_a_parabola(constrained_speeds):
    """Return a particle on the parabola y = x^2, with or without the velocity constraint."""
    point = moving(u * FRAME.x + v * FRAME.y, IN_THE_PLANE)
    dependent = {"u_dependent": [v], "velocity_constraints": [v - 2 * x * u]} if constrained_speeds else {}
    model = me.KanesMethod(
        FRAME, [x], [u] if dependent else [u, v], kd_eqs=[x.diff() - u, y.diff() - v], q_dependent=[y],
        configuration_constraints=[y - x**2], **dependent,
    )  # fmt: skip
    model.kanes_equations([me.Particle("A", point, m)], [(point, -m * g * FRAME.y)])
    return model


def parabola_by_lagrange():
    L = m * (x.diff() ** 2 + y.diff() ** 2) / 2 - m * g * y
    return me.LagrangesMethod(L, [x, y], hol_coneqs=[y - x**2])


def parabola_as_system(by_speeds):
    """Return the particle as a System of SymPy, whose equations are not formed yet."""
    velocity = u * FRAME.x + v * FRAME.y if by_speeds else x.diff() * FRAME.x + y.diff() * FRAME.y
    system = me.System(FRAME, ORIGIN)
    system.add_bodies(me.Particle("A", moving(velocity, IN_THE_PLANE), m))
    system.add_coordinates(x)
    system.add_coordinates(y, independent=not by_speeds)
    if by_speeds:
        system.add_speeds(u)
        system.add_speeds(v, independent=False)
        system.add_kdes(x.diff() - u, y.diff() - v)
    system.add_holonomic_constraints(y - x**2)
    system.apply_uniform_gravity(-g * FRAME.y)
    if not by_speeds:
        system.form_eoms(eom_method=me.LagrangesMethod)
    return system


FALL = -(4 * 0.25 + 2 * G) / 5  # (1 + 4 x^2) x'' + 4 x x'^2 + 2 g x = 0 at x = 1, x' = 0.5
START = {"x": 1, "y": 0.9}
LOADS = "invariant, kinetic energy of the bodies and potential of constant loads"


@pytest.mark.parametrize(
    ("make", "speeds", "says"),
    [
        (lambda: on_a_parabola(True), ("u", "v"), [LOADS]),
        (lambda: on_a_parabola(False), ("u", "v"), [LOADS, "velocity constraints were added for g1"]),
        (parabola_by_lagrange, ("v_x", "v_y"), ["invariant, of the Lagrangian"]),
        (lambda: parabola_as_system(True), ("u", "v"), [LOADS]),
        (lambda: parabola_as_system(False), ("v_x", "v_y"), ["not kept: of the Lagrangian"]),
    ],
)
def test_all_kinds_of_models_give_the_same_motion(make, speeds, says):
    start = START, {speeds[0]: 0.5, speeds[1]: 0}
    problem = mechanics(make(), {"m": 1, "g": G}, *start, independent=["x", speeds[0]])
    assert problem.names.speeds == speeds
    np.testing.assert_allclose(problem.y0, [1, 1, 0.5, 1], rtol=1e-14)
    np.testing.assert_allclose(problem.motion_at(0.0, problem.y0)[2], FALL, rtol=1e-14)
    assert all(text in repr(problem) for text in says)
    assert ("constraints were added" in repr(problem)) is (len(says) > 1)


def test_a_system_of_pydy_brings_constants_and_start():
    start = {x: 1, y: 1, x.diff(): 0.5, y.diff(): 1.0}
    system = SimpleNamespace(eom_method=parabola_by_lagrange(), constants=WEIGHT, initial_conditions=start)
    assert mechanics(system).parameters == {"m": 1, "g": G}
    np.testing.assert_array_equal(mechanics(system).y0, [1, 1, 0.5, 1])
    # A constant that is given goes before that of the model.
    lighter = mechanics(system, {"g": 1.0})
    np.testing.assert_allclose(lighter.motion_at(0.0, lighter.y0)[2], -(4 * 0.25 + 2) / 5, rtol=1e-13)


def test_a_model_moves_as_its_own_equations_say():
    (model, constants), problem = examples.four_bar_model(), examples.four_bar()
    gradient, state = np.empty((4, 6)), problem.y0.copy()
    interpreted(problem.constraints[0].gradient)(0.0, state, gradient, problem.params)
    state[3:] = 1.3 * np.linalg.svd(gradient[2:, 3:])[2][-1]
    known = dict(zip([*model.q, *model.u], state, strict=True)) | constants
    M, f = (np.array(item.xreplace(known), float) for item in (model.mass_matrix, model.forcing))
    np.testing.assert_allclose(problem.motion_at(0.0, state)[3:], np.linalg.solve(M, f)[:, 0], rtol=1e-9)
    assert "q2 0.1 to" in repr(problem)
    again = problem.start({"q1": 0.2, "q2": 0.1, "q3": -2.6}, {"u1": 0.5}, constants)
    np.testing.assert_array_equal(again[[0, 3]], [0.2, 0.5])  # the model calls the others dependent


@pytest.mark.parametrize(
    ("order", "attitude"), [("321", (0, 0, np.pi / 2)), ("313", (0, 0.5, 0)), ("123", (0, 0.4, 0))]
)
def test_euler_angles_of_a_body_with_body_rates(order, attitude):
    q, speeds = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    B = FRAME.orientnew("B", "Body", q, order)
    rates = B.ang_vel_in(FRAME)
    B.set_ang_vel(FRAME, sum((a * axis for a, axis in zip(speeds, B, strict=True)), 0 * FRAME.x))
    model = me.KanesMethod(FRAME, q, speeds, kd_eqs=[a - rates.dot(axis) for a, axis in zip(speeds, B, strict=True)])
    model.kanes_equations([me.RigidBody("A", ORIGIN, B, 1, (me.inertia(B, 1, 2, 3), ORIGIN))], [])
    w = np.array([0.1, 1.0, 0.2])
    problem = mechanics(model, {}, attitude, w)
    found = problem.motion_at(0.0, problem.y0)
    known = dict(zip([a.diff() for a in q], found[:3], strict=True))
    turned = [rates.dot(axis).xreplace(known).xreplace(dict(zip(q, attitude, strict=True))) for axis in B]
    np.testing.assert_allclose(np.array(turned, float), w, atol=1e-15)
    np.testing.assert_allclose(found[3:], [-w[1] * w[2], w[2] * w[0], -w[0] * w[1] / 3], atol=1e-15)
    if order == "313":
        with pytest.raises(ValueError, match="divide by zero at the start"):
            mechanics(model, {}, [0, 0, 0], w)


def test_a_pole_of_dependent_speeds_is_none_of_the_motion():
    # At y = x^2, x = 0 the other choice of dependent speeds, u by v, is singular.
    problem = mechanics(on_a_parabola(True), WEIGHT, [0, 0], [0.7, 0])
    assert solve_ivp(problem.motion_at, (0, 0.1), problem.y0, rtol=1e-9, atol=1e-9).success


def test_springs_of_a_model_belong_to_its_energy():
    q1, q2, u1, u2 = me.dynamicsymbols("q1 q2 u1 u2")
    A = FRAME.orientnew("A", "Axis", [q1, FRAME.z])
    A.set_ang_vel(FRAME, u1 * FRAME.z)
    P, Q = ORIGIN.locatenew("P", A.x), ORIGIN.locatenew("Q", q2 * FRAME.x + 2 * FRAME.y)
    P.v2pt_theory(ORIGIN, FRAME, A)
    Q.set_vel(FRAME, u2 * FRAME.x)
    pathway = me.LinearPathway(P, Q)
    model = me.KanesMethod(FRAME, [q1, q2], [u1, u2], kd_eqs=[q1.diff() - u1, q2.diff() - u2])
    loads = [*me.LinearSpring(k, pathway, l).to_loads(), (P, -m * g * FRAME.y)]
    model.kanes_equations([me.Particle("A", P, m), me.Particle("B", Q, m)], loads)
    start = WEIGHT | {k: 5, l: 1}, [0.3, 0.2], [0, 1]
    assert mechanics(model, *start).energy_kept.startswith("not kept")
    kept = mechanics(model, *start, potential_energy=k * (pathway.length - l) ** 2 / 2).energy_kept
    assert kept.startswith("invariant, kinetic energy of the bodies and potential of constant loads and pot")


def test_forces_of_a_lagrangian_may_have_a_potential():
    model = me.LagrangesMethod(m * x.diff() ** 2 / 2, [x], forcelist=[(moving(x.diff() * FRAME.x), -k * x * FRAME.x)],
                               frame=FRAME)  # fmt: skip
    problem = mechanics(model, {k: 5, m: 1}, [0.3], [0], potential_energy=k * x**2 / 2)
    assert problem.energy_kept == "invariant, of the Lagrangian and potential_energy="


@pytest.mark.parametrize("real", [None, True])
def test_a_lagrangian_has_branches(real):
    q = me.dynamicsymbols("q", real=real)
    kink = lambda q: -2 * max(q - 1, 0)  # noqa: E731
    for potential, force in [
        (sympy.Abs(q) ** sympy.Rational(5, 2), lambda q: -2.5 * abs(q) ** 1.5 * np.sign(q)),
        (sympy.Heaviside(q - 1) * (q - 1) ** 2, kink),
        (sympy.Piecewise(((q - 1) ** 2, q > 1), (0, True)), kink),
    ]:
        problem = mechanics(me.LagrangesMethod(q.diff() ** 2 / 2 - potential, [q]), {}, [1.5], [1])
        assert problem.energy_kept == "invariant, of the Lagrangian"
        for place in (-1.3, 0.4, 2.5):
            np.testing.assert_allclose(problem.motion_at(0.0, np.array([place, 1.0])), [1, force(place)], rtol=1e-14)


def test_an_energy_is_examined_away_from_singular_positions():
    # A parallelogram, from whose neighbourhood Newton's method may end in its flat position.
    q1, q2, q3 = me.dynamicsymbols("q1:4")
    angles = q1, q1 + q2, q1 + q2 + q3
    ends = [(sympy.cos(angle), sympy.sin(angle)) for angle in angles]
    across, up = (sympy.Add(*(end[j] for end in ends)) for j in range(2))
    speeds = [(ends[0][j] + ends[1][j] * n / 2).diff() for n in range(2) for j in range(2)]
    lagrangian = sympy.Add(*(v**2 for v in speeds)) / 2 - G * (ends[0][1] + (ends[0][1] + ends[1][1] / 2))
    model = me.LagrangesMethod(lagrangian + q3.diff() ** 2 / 20, [q1, q2, q3], hol_coneqs=[across - 1, up])
    problem = mechanics(model, {}, [1, 1.5, 1.5], [1, 0, 0], independent=["q1", "v_q1"])
    assert problem.energy_kept == "invariant, of the Lagrangian"


# Inputs. x'' = (push - 3 x) / 2 with push = sin t has the solution x = sin t.


@pytest.fixture(scope="module")
def pushed():
    return on_a_line(push - k * x, m)


def late(t, y):
    return np.sin(t) if t < 10 else 0.0


def halving(t, y):
    y[0] *= 0.5
    return y[0] if t < 10 else 0.0


@pytest.mark.parametrize("given", [sympy.sin(TIME), late, njit(late)])
def test_inputs_are_expressions_or_functions(pushed, given):
    outputs = {"acceleration": u.diff(), "again": x.diff(TIME, 2), "force": push, "spring": "k*x"}
    problem = mechanics(pushed, {m: 2, k: 3}, [0], [1], t_span=(0, 2), inputs={push: given}, outputs=outputs)
    assert extending.is_jitted(problem.rhs) is (extending.is_jitted(given) or not callable(given))
    assert problem.energy is None
    assert problem.momenta == ()
    state = np.array([np.sin(0.5), np.cos(0.5)])
    for one in (problem, pickle.loads(pickle.dumps(problem))) if given is late else (problem,):
        np.testing.assert_allclose(one.motion_at(0.5, state), [np.cos(0.5), -np.sin(0.5)], rtol=1e-15)
        found = one.outputs(0.5, state)
        assert found == pytest.approx(
            {"acceleration": -np.sin(0.5), "again": -np.sin(0.5), "force": np.sin(0.5), "spring": 3 * np.sin(0.5)}
        )
    if given is late:
        np.testing.assert_allclose((found := run(problem, 1e-6)).y[:, -1], [np.sin(2), np.cos(2)], atol=1e-5)
        assert "input 'push' is a Python function; jit it by numba.njit" in found.message


@pytest.mark.parametrize(
    ("given", "force"), [(halving, 0.1), (njit(halving), 0.1), (sympy.sin(TIME) - 3 * x, np.sin(0.5) - 0.6), (0, 0)]
)
def test_inputs_of_the_state_do_not_change_it(pushed, given, force):
    problem = mechanics(pushed, {m: 2, k: 3}, [0], [1], inputs={"push": given})
    state = np.array([0.2, 1.0])
    for call in (problem.motion_at, problem.fun):
        np.testing.assert_allclose(call(0.5, state), [1.0, (force - 0.6) / 2], rtol=1e-15)
        np.testing.assert_array_equal(state, [0.2, 1.0])


def test_one_function_may_give_several_inputs():
    point = moving(x.diff() * FRAME.x + y.diff() * FRAME.y)
    model = me.LagrangesMethod(
        x.diff() ** 2 / 2 + y.diff() ** 2 / 2, [x, y], forcelist=[(point, push * FRAME.x + pull * FRAME.y)], frame=FRAME
    )

    start = dict.fromkeys([x, y, x.diff(), y.diff()], 0)
    system = SimpleNamespace(eom_method=model, constants={}, initial_conditions=start)  # as PyDy's
    system.specifieds = {(push, pull): lambda x, t: np.array([np.sin(t), x[2]])}
    functions = lambda t, y: [np.sin(t), y[2]], lambda t, y: [np.sin(t), y[2]] if t < 9 else [0.0, 0.0]
    problems = [mechanics(model, {}, [0, 0], [0, 0], inputs={(push, pull): given}) for given in functions]
    for problem in (*problems, mechanics(system)):
        found = problem.motion_at(0.5, np.array([0.3, 0.4, 0.1, 0.2]))
        np.testing.assert_allclose(found, [0.1, 0.2, np.sin(0.5), 0.1], rtol=1e-15)


@pytest.fixture(scope="module")
def hanging():
    """Return a pendulum that hangs on a point at x = shift."""
    return me.LagrangesMethod(LAGRANGIAN, [x, y], hol_coneqs=[(x - shift) ** 2 + y**2 - 1])


def test_a_pendulum_hangs_on_a_point_that_moves(hanging):
    inputs = {shift: sympy.sin(3 * TIME) / 10}
    problem = mechanics(hanging, {}, [0, -1], [0.4, 0], t_span=(0, 2), inputs=inputs, independent=["y", "v_x"])
    assert "not kept" in problem.energy_kept
    # The angle a: a'' = -g sin a - shift'' cos a.
    t, a, rate = 0.7, 0.4, 1.3
    by_angle = -G * np.sin(a) + 0.9 * np.sin(3 * t) * np.cos(a)
    state = [np.sin(3 * t) / 10 + np.sin(a), -np.cos(a), 0.3 * np.cos(3 * t) + np.cos(a) * rate, np.sin(a) * rate]
    found = problem.motion_at(t, np.array(state))[2:]
    expected = [-0.9 * np.sin(3 * t), 0] + by_angle * np.array([np.cos(a), np.sin(a)])
    np.testing.assert_allclose(found, expected - rate**2 * np.array([np.sin(a), -np.cos(a)]), rtol=1e-14)


def test_momenta_of_cyclic_coordinates_are_kept():
    # A bead on a cone z = r, in cylindrical coordinates: p_phi = r^2 phi'.
    r, phi, z = me.dynamicsymbols("r phi z")
    L = (r.diff() ** 2 + r**2 * phi.diff() ** 2 + z.diff() ** 2) / 2 - G * z
    problem = mechanics(me.LagrangesMethod(L, [r, phi, z], hol_coneqs=[z - r]), {}, [1, 0, 1], [0, 2, 0], t_span=(0, 5))
    for one in (problem, pickle.loads(pickle.dumps(problem))):
        assert [item.name for item in one.momenta] == ["p_phi"]
    assert "momenta     p_phi" in repr(problem)


def test_a_momentum_that_an_input_may_change_later_is_not_kept():
    for given, names in ((0, ["p_x"]), (lambda t, y: 1.0 if t > 5 else 0.0, [])):
        problem = mechanics(on_a_line(push), {}, [0], [1], t_span=(0, 2), inputs={push: given})
        assert [item.name for item in problem.momenta] == names


def test_momenta_of_speeds_that_are_combinations_of_rates():
    # Two particles on a line, at x and x + y: the momentum of x is that of both.
    P, Q = moving(u * FRAME.x), moving(v * FRAME.x)
    model = me.KanesMethod(FRAME, [x, y], [u, v], kd_eqs=[u - x.diff(), v - x.diff() - y.diff()])
    bodies = [me.Particle("A", P, m), me.Particle("B", Q, 2 * m)]
    model.kanes_equations(bodies, [(P, y * FRAME.x), (Q, -y * FRAME.x)])
    problem = mechanics(model, {"m": 3}, [0, 1], [0.5, 0.25], energy=3 * u**2 / 2 + 3 * v**2 + y**2 / 2)
    assert problem.energy_kept == "invariant, energy="
    (momentum,) = problem.momenta
    assert momentum.name == "p_x"
    assert interpreted(momentum.function)(0.0, problem.y0, problem.params) == pytest.approx(3 * 0.5 + 6 * 0.25)


def test_norms_of_quaternions_are_kept():
    """A free rigid body, by a quaternion and the speeds of its centre."""
    e, w = me.dynamicsymbols("e0:4"), me.dynamicsymbols("w1:4")
    place, velocity = me.dynamicsymbols("x y z"), me.dynamicsymbols("v1:4")
    B = me.ReferenceFrame("B")
    B.orient_quaternion(FRAME, e)
    a, b, c, d = e
    E = sympy.Matrix([[-b, -c, -d], [a, -d, c], [d, a, -b], [-c, b, a]]) / 2
    rates = [item.diff() - value for item, value in zip([*e, *place], [*(E * sympy.Matrix(w)), *velocity], strict=True)]
    B.set_ang_vel(FRAME, w[0] * B.x + w[1] * B.y + w[2] * B.z)
    C = moving(velocity[0] * FRAME.x + velocity[1] * FRAME.y + velocity[2] * FRAME.z)
    model = me.KanesMethod(FRAME, e + place, w + velocity, kd_eqs=rates)
    model.kanes_equations([me.RigidBody("A", C, B, 1, (me.inertia(B, 1, 2, 3), C))], [(C, -G * FRAME.z)])
    speeds = [1, 0.1, 0.2, 1, 0, 0]
    problem = mechanics(model, {}, [0.6, 0.8, 0, 0, 0, 0, 0], speeds)
    (norm,) = problem.norms
    assert norm.name == "e0^2 + e1^2 + e2^2 + e3^2"
    assert [item.name for item in problem.momenta] == ["p_x", "p_y"]
    gradient, state = np.empty(13), np.arange(1.0, 14.0)
    assert interpreted(norm.function)(0.0, state) == 30
    interpreted(norm.gradient)(0.0, state, gradient)
    assert gradient.tolist() == [2, 4, 6, 8, *[0] * 9]
    with pytest.raises(ValueError, match="expected 1, because the quaternion of a rotation"):
        mechanics(model, {}, [1, 0.1, 0, 0, 0, 0, 0], speeds)


def test_parameters_are_given_by_name_or_symbol(pushed):
    options = {"t_span": (0, 2), "inputs": {push: 0}, "outputs": {"spring": k * x}}
    problem = mechanics(pushed, {m: 2, "k": 3}, [1], [0], **options)
    members = ensemble(problem, params={k: [2.0, 8.0]}, method=EIPDOP853, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(members.y[:, 0], np.cos([2.0, 4.0]), atol=1e-7)
    np.testing.assert_allclose(run(problem, params={m: 0.5}).y[0, -1], np.cos(np.sqrt(6) * 2), atol=1e-7)
    found = run(problem, params={k: 0.5})
    np.testing.assert_array_equal(found.outputs["spring"], 0.5 * found.y[0])
    with pytest.raises(ValueError, match="has no parameter 'q'"):
        run(problem, params={sympy.Symbol("q"): 1})


def test_outputs_and_starts_take_the_parameters_of_the_run():
    model = me.LagrangesMethod(LAGRANGIAN, [x, y], hol_coneqs=[x**2 + y**2 - l**2])
    problem = mechanics(model, {l: 1}, [0, -1], [1, 0], outputs={"slope": x / l})
    starts = problem.start({x: 0.6, y: -1}, {x.diff(): 0.5}, {l: [1, 0.75]}, independent=["x", "v_x"])
    np.testing.assert_allclose(starts, [[0.6, -0.8, 0.5, 0.375], [0.6, -0.45, 0.5, 2 / 3]], rtol=1e-14)
    assert problem.outputs(0.0, starts[1], {l: 0.75})["slope"] == pytest.approx(0.8, rel=1e-15)
    # -G^T lambda = -2 lambda q is the centripetal force and what holds the weight along the rod.
    _, height, vx, vy = starts[1]
    expected = (vx**2 + vy**2 - G * height) / (2 * 0.75**2)
    np.testing.assert_allclose(problem.multipliers(0.0, starts[1], {l: 0.75}).values, [expected], rtol=1e-14)


def two_quantities(one, two):
    return f"two different quantities are called .*{one}.* and .*{two}"


POSITIVE, LATER = sympy.Symbol("k", positive=True), sympy.Symbol("t", real=True)
BRACES, BRACKETS = sympy.Symbol("k{1}"), sympy.Symbol("k[1]")
NAME_OF_X, NAME_OF_RATE, RATE = sympy.Symbol("x"), sympy.Symbol("v_x"), me.dynamicsymbols("v_x")


@pytest.mark.parametrize(
    ("force", "params", "says"),
    [
        (-NAME_OF_X * x, {NAME_OF_X: 4}, two_quantities(r"x\(t\)", r"Symbol\('x'\)")),
        (-NAME_OF_RATE * x, {NAME_OF_RATE: 4}, two_quantities("v_x|Derivative", r"Symbol\('v_x'\)")),
        (-(k + POSITIVE) * x, {"k": 1}, two_quantities(r"Symbol\('k'\)", r"Symbol\('k', positive=True\)")),
        (-(k + POSITIVE) * x, {k: 1, POSITIVE: 3}, "two keys are called 'k'"),
        (LATER * x, {}, two_quantities("the time", r"Symbol\('t', real=True\)")),
        (-x, {"x": 1}, "'x' is the name of a parameter, and of a component"),
        (-(BRACES + BRACKETS) * x, {"k{1}": 1}, two_quantities(r"Symbol\('k\[1\]'\)", r"Symbol\('k\{1\}'\)")),
    ],
)
def test_different_quantities_have_different_names(force, params, says):
    for model in (on_a_line(force, speed=RATE, by_rate=True), me.LagrangesMethod(x.diff() ** 2 / 2 + x * force, [x])):
        with pytest.raises(ValueError, match=says):
            mechanics(model, params, [1], [0])


def test_names_of_inputs_and_outputs():
    """The amplitude of an input may have its name, and quantities of the user may contain names of the state."""
    amplitude, model = sympy.Symbol("push"), on_a_line(push, speed=RATE, by_rate=True)
    problem = mechanics(model, {amplitude: 3}, [1], [2], inputs={push: amplitude * x}, outputs={"v": NAME_OF_RATE})
    np.testing.assert_array_equal(problem.motion_at(0.0, problem.y0), [2, 3])
    assert problem.outputs(0.0, problem.y0) == {"v": 2}


def auxiliary():
    model = me.KanesMethod(FRAME, [x], [u], kd_eqs=[x.diff() - u], u_auxiliary=[v])
    model.kanes_equations([me.Particle("A", moving(u * FRAME.x + v * FRAME.y), 1)], [])
    return model


def test_what_is_wrong_is_said(pushed, hanging):
    parabola, start, given = on_a_parabola(True), ({"x": 1}, {"u": 0.5}), ({m: 2, k: 3}, [0], [1])
    jump = me.LagrangesMethod(x.diff() ** 2 / 2 - sympy.Heaviside(x - 1) * x, [x])
    for arguments, inputs, kind, says in [
        ((parabola, {"m": 1}, *start), None, ValueError, "value of 'g' is missing"),
        ((object(), {}, *start), None, TypeError, "expected a KanesMethod"),
        ((parabola, WEIGHT), None, TypeError, "q0 or u0 is missing"),
        ((auxiliary(), {}, [0], [0]), None, ValueError, "auxiliary speeds"),
        ((jump, {}, [0.5], [1]), None, ValueError, "a function that jumps where x - 1 is 0"),
        ((pushed, *given), None, ValueError, r"push.* is neither a coordinate nor a speed"),
        ((pushed, *given), {push: lambda t, y: np.array([1.0, 2.0])}, ValueError, "returns 2 numbers; expected 1"),
        ((pushed, *given), {"pusk": 1}, ValueError, "did you mean 'push'"),
        ((pushed, *given), {x: 1}, ValueError, "is a component of the state"),
        ((pushed, *given), {push: None}, TypeError, "expected a number, an expression"),
        ((pushed, *given), [1], TypeError, "must be a mapping"),
        ((hanging, {}, [0, -1], [0, 0]), {shift: late}, ValueError, "contain the derivative .* of an input that is a"),
    ]:
        with pytest.raises(kind, match=says):
            mechanics(*arguments, inputs=inputs)
