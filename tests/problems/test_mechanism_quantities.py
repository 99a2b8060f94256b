"""Mechanical systems: inputs, outputs, parameters, momenta, quaternions, and constraints that depend on time."""

import pickle

import numba
import numpy as np
import pytest
import sympy
from sympy.physics import mechanics as me

from eip_scipy import EIPDOP853, EIPRK4, ensemble, integrate, load
from eip_scipy.problems import kepler, mechanics, mechanism

G = 9.81
TIME = me.dynamicsymbols._t
x, y, u, v, push, pull, shift = me.dynamicsymbols("x y u v push pull shift")
k, m = sympy.symbols("k m")


def run(problem, tolerance=1e-9, **options):
    return integrate(problem, method=EIPDOP853, rtol=tolerance, atol=tolerance, **options)


@numba.njit
def length(t, q):
    return np.array([q[0] ** 2 + q[1] ** 2 - 1])


@numba.njit
def potential(t, q):
    return G * q[1]


def height(t, q, u):
    return q[1]


def energy(t, q, u):
    return (u @ u) / 2 + G * q[1]


OUTPUTS = {"height": height, "energy": energy}


@pytest.fixture(scope="module")
def pendulum():
    return mechanism([1, 1], [0, -G], length, q0=[1, 0], u0=[0, 0], t_span=(0, 2), outputs=OUTPUTS,
                     potential_energy=potential)  # fmt: skip


@pytest.fixture(scope="module")
def swing(pendulum):
    return run(pendulum, t_eval=np.linspace(0, 2, 5))


# Outputs and multipliers.


def test_a_run_has_outputs_and_multipliers(pendulum, swing, tmp_path):
    found = swing
    np.testing.assert_array_equal(found.outputs["height"], found.y[1])
    np.testing.assert_allclose(found.outputs["energy"], 0, atol=1e-13)
    # The rod pulls with 3 m g |y|, and G = 2 q.
    np.testing.assert_allclose(2 * found.multipliers.values[0], -3 * G * found.y[1], atol=1e-6)
    assert found.multipliers.unique.all()
    found.save(tmp_path / "run.npz")
    longer = found.continue_to(3.0)
    assert longer.outputs["height"].shape == longer.t.shape == longer.multipliers.rank.shape
    np.testing.assert_array_equal(longer.outputs["height"], longer.y[1])
    for again in (load(tmp_path / "run.npz"), pickle.loads(pickle.dumps(found))):
        np.testing.assert_array_equal(again.outputs["energy"], found.outputs["energy"])
        np.testing.assert_array_equal(again.multipliers.values, found.multipliers.values)
        assert again.multipliers.names == ("g1'",)
    assert pickle.loads(pickle.dumps(pendulum)).outputs(0.0, pendulum.y0) == {"height": 0.0, "energy": 0.0}


def test_tables_have_outputs_and_multipliers(swing):
    found = swing
    frame, data = found.to_dataframe(), found.to_xarray()
    assert list(frame.columns)[-3:] == ["height", "output energy", "multiplier g1'"]  # the energy is an invariant
    np.testing.assert_array_equal(data.outputs.sel(output="height"), found.y[1])
    np.testing.assert_array_equal(data.multipliers.sel(constraint="g1'"), found.multipliers.values[0])
    assert data.constraint_rank.values.tolist() == [1] * 5


def test_outputs_that_branch_are_called_as_they_are():
    problem = mechanism([1], [-1], q0=[1], u0=[0], outputs={"side": lambda t, q, u: 1.0 if q[0] > 0 else -1.0})
    assert problem.outputs([0.0, 0.0], [[1.0, -2.0], [0.0, 0.0]])["side"].tolist() == [1, -1]


def test_what_is_wrong_with_outputs_is_said(pendulum):
    def refused(outputs, match, error=ValueError):
        with pytest.raises(error, match=match):
            mechanism([1], [0], q0=[1], u0=[0], outputs=outputs)

    refused({"q1": lambda t, q, u: 0.0}, "has the name of a component")
    refused({"both": lambda t, q, u: q}, r"has the shape \(1,\); expected a number")
    refused({"one": 1.0}, "must be a function", TypeError)
    refused([1], "must be a mapping", TypeError)
    with pytest.raises(ValueError, match="outputs: y has the shape"):
        pendulum.outputs([0.0, 1.0], pendulum.y0)
    plain = integrate(kepler(), (0, 1), method=EIPRK4)
    for name in ("outputs", "multipliers"):
        with pytest.raises(AttributeError, match=f"this result has no {name}"):
            getattr(plain, name)


# Inputs. x'' = (push - 3 x) / 2 with push = sin t has the solution x = sin t.


@pytest.fixture(scope="module")
def pushed():
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, u * N.x)
    model = me.KanesMethod(N, [x], [u], kd_eqs=[x.diff() - u])
    model.kanes_equations([me.Particle("A", P, m)], [(P, (push - k * x) * N.x)])
    return model


def late(t, y):
    return np.sin(t) if t < 10 else 0.0


def pickled(problem):
    return pickle.loads(pickle.dumps(problem))


@pytest.mark.parametrize("given", [sympy.sin(TIME), late, numba.njit(late)])
def test_inputs_are_expressions_or_functions(pushed, given):
    outputs = {"acceleration": u.diff(), "again": x.diff(TIME, 2), "force": push, "spring": "k*x"}
    problem = mechanics(pushed, {m: 2, k: 3}, [0], [1], t_span=(0, 2), inputs={push: given}, outputs=outputs)
    jitted = numba.extending.is_jitted(given)
    assert numba.extending.is_jitted(problem.rhs) is (jitted or not callable(given))
    assert problem.energy is None
    assert problem.momenta == ()
    state = np.array([np.sin(0.5), np.cos(0.5)])
    for one in (problem, pickled(problem)) if given is late else (problem,):
        np.testing.assert_allclose(one.motion_at(0.5, state), [np.cos(0.5), -np.sin(0.5)], rtol=1e-15)
        found = one.outputs(0.5, state)
        assert found["again"] == found["acceleration"] == pytest.approx(-np.sin(0.5), rel=1e-15)
        assert found["force"] == pytest.approx(np.sin(0.5), rel=1e-15)
        assert found["spring"] == pytest.approx(3 * np.sin(0.5), rel=1e-15)
    if given is late:
        found = run(problem, 1e-6)
        np.testing.assert_allclose(found.y[:, -1], [np.sin(2), np.cos(2)], atol=1e-5)


def test_a_function_of_an_input_may_change_its_argument(pushed):
    def halving(t, y):
        y[0] *= 0.5
        return y[0] if t < 10 else 0.0

    for given in (halving, numba.njit(halving)):
        problem = mechanics(pushed, {m: 2, k: 3}, [0], [1], inputs={push: given})
        state = np.array([0.2, 1.0])
        for call in (problem.motion_at, problem.fun):
            np.testing.assert_allclose(call(0.5, state), [1.0, -0.25], rtol=1e-15)
            np.testing.assert_array_equal(state, [0.2, 1.0])


def test_one_function_may_give_several_inputs():
    model = me.LagrangesMethod(x.diff() ** 2 / 2 + y.diff() ** 2 / 2, [x, y], forcelist=_pushes(), frame=FRAME)
    expected = [0.1, 0.2, np.sin(0.5), 0.1]
    for given in (lambda t, y: [np.sin(t), y[2]], lambda t, y: [np.sin(t), y[2]] if t < 9 else [0.0, 0.0]):
        problem = mechanics(model, {}, [0, 0], [0, 0], inputs={(push, pull): given})
        np.testing.assert_allclose(problem.motion_at(0.5, np.array([0.3, 0.4, 0.1, 0.2])), expected, rtol=1e-15)

    class System:  # as PyDy's, whose functions take (x, t)
        eom_method, constants, initial_conditions = model, {}, {x: 0, y: 0, x.diff(): 0, y.diff(): 0}
        specifieds = {(push, pull): lambda x, t: np.array([np.sin(t), x[2]])}  # noqa: RUF012

    np.testing.assert_allclose(mechanics(System()).motion_at(0.5, np.array([0.3, 0.4, 0.1, 0.2])), expected, rtol=1e-15)


FRAME = me.ReferenceFrame("N")


def _pushes():
    P = me.Point("P")
    P.set_vel(FRAME, x.diff() * FRAME.x + y.diff() * FRAME.y)
    return [(P, push * FRAME.x + pull * FRAME.y)]


def test_what_is_wrong_with_inputs_is_said(pushed):
    def refused(inputs, match, error=ValueError):
        with pytest.raises(error, match=match):
            mechanics(pushed, {m: 2, k: 3}, [0], [1], inputs=inputs)

    refused({push: lambda t, y: np.array([1.0, 2.0])}, "returns 2 numbers; expected 1")
    refused({"pusk": 1}, "did you mean 'push'")
    refused({x: 1}, "is a component of the state")
    refused({push: None}, "expected a number, an expression", TypeError)
    refused([1], "must be a mapping", TypeError)
    lagrangian = (x.diff() ** 2 + y.diff() ** 2) / 2 - G * y
    model = me.LagrangesMethod(lagrangian, [x, y], hol_coneqs=[(x - shift) ** 2 + y**2 - 1])
    with pytest.raises(ValueError, match=r"contain the derivative .* of an input that is a function"):
        mechanics(model, {}, [0, -1], [0, 0], inputs={shift: late})


# Constraints that depend on time.


def test_a_pendulum_hangs_on_a_point_that_moves():
    lagrangian = (x.diff() ** 2 + y.diff() ** 2) / 2 - G * y
    model = me.LagrangesMethod(lagrangian, [x, y], hol_coneqs=[(x - shift) ** 2 + y**2 - 1])
    inputs = {shift: sympy.sin(3 * TIME) / 10}
    problem = mechanics(model, {}, [0, -1], [0.4, 0], t_span=(0, 2), inputs=inputs, independent=["y", "v_x"])
    assert "not kept" in problem.energy_kept
    # The angle a: a'' = -g sin a - shift'' cos a.
    t, a, rate = 0.7, 0.4, 1.3
    by_angle = -G * np.sin(a) + 0.9 * np.sin(3 * t) * np.cos(a)
    state = [np.sin(3 * t) / 10 + np.sin(a), -np.cos(a), 0.3 * np.cos(3 * t) + np.cos(a) * rate, np.sin(a) * rate]
    found = problem.motion_at(t, np.array(state))[2:]
    expected = [-0.9 * np.sin(3 * t), 0] + by_angle * np.array([np.cos(a), np.sin(a)])
    np.testing.assert_allclose(found, expected - rate**2 * np.array([np.sin(a), -np.cos(a)]), rtol=1e-14)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_run_keeps_constraints_that_depend_on_time():
    rod = numba.njit(lambda t, q: np.array([q[0] * np.sin(2 * t) - q[1] * np.cos(2 * t)]))
    problem = mechanism([1, 1], [0, 0], rod, q0=[1, 0], u0=[0, 2])
    found = run(problem, t_span=(0, 1))
    assert found.trusted
    r, speed = np.cosh(2), 2 * np.sinh(2)
    along, across = np.array([np.cos(2), np.sin(2)]), np.array([-np.sin(2), np.cos(2)])
    np.testing.assert_allclose(found.y[:, -1], np.append(r * along, speed * along + 2 * r * across), atol=1e-8)


# Momenta and quaternions.


def test_momenta_of_cyclic_coordinates_are_kept():
    # A bead on a cone z = r, in cylindrical coordinates: p_phi = r^2 phi'.
    r, phi, z = me.dynamicsymbols("r phi z")
    L = (r.diff() ** 2 + r**2 * phi.diff() ** 2 + z.diff() ** 2) / 2 - G * z
    problem = mechanics(me.LagrangesMethod(L, [r, phi, z], hol_coneqs=[z - r]), {}, [1, 0, 1], [0, 2, 0], t_span=(0, 5))
    assert [item.name for item in problem.momenta] == ["p_phi"]
    assert "momenta     p_phi" in repr(problem)
    assert [item.name for item in pickled(problem).momenta] == ["p_phi"]


def test_momenta_of_speeds_that_are_combinations_of_rates():
    # Two particles on a line, at x and x + y: the momentum of x is that of both.
    P, Q = me.Point("P"), me.Point("Q")
    P.set_vel(FRAME, u * FRAME.x)
    Q.set_vel(FRAME, v * FRAME.x)
    model = me.KanesMethod(FRAME, [x, y], [u, v], kd_eqs=[u - x.diff(), v - x.diff() - y.diff()])
    bodies = [me.Particle("A", P, m), me.Particle("B", Q, 2 * m)]
    model.kanes_equations(bodies, [(P, y * FRAME.x), (Q, -y * FRAME.x)])
    problem = mechanics(model, {"m": 3}, [0, 1], [0.5, 0.25], energy=3 * u**2 / 2 + 3 * v**2 + y**2 / 2)
    assert problem.energy_kept == "invariant, energy="
    (momentum,) = problem.momenta
    assert momentum.name == "p_x"
    assert momentum.function.py_func(0.0, problem.y0, problem.params) == pytest.approx(3 * 0.5 + 6 * 0.25)


@pytest.fixture(scope="module")
def top():
    """Return a free rigid body, by a quaternion and the speeds of its centre."""
    e, w = me.dynamicsymbols("e0:4"), me.dynamicsymbols("w1:4")
    place, velocity = me.dynamicsymbols("x y z"), me.dynamicsymbols("v1:4")
    N, B, C = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("C")
    B.orient_quaternion(N, e)
    a, b, c, d = e
    E = sympy.Matrix([[-b, -c, -d], [a, -d, c], [d, a, -b], [-c, b, a]]) / 2
    rates = [item.diff() - value for item, value in zip(e, E * sympy.Matrix(w), strict=True)]
    rates += [item.diff() - value for item, value in zip(place, velocity, strict=True)]
    B.set_ang_vel(N, w[0] * B.x + w[1] * B.y + w[2] * B.z)
    C.set_vel(N, velocity[0] * N.x + velocity[1] * N.y + velocity[2] * N.z)
    model = me.KanesMethod(N, e + place, w + velocity, kd_eqs=rates)
    model.kanes_equations([me.RigidBody("A", C, B, 1, (me.inertia(B, 1, 2, 3), C))], [(C, -G * N.z)])
    return model


def test_norms_of_quaternions_are_kept(top):
    speeds = [1, 0.1, 0.2, 1, 0, 0]
    problem = mechanics(top, {}, [0.6, 0.8, 0, 0, 0, 0, 0], speeds)
    assert [item.name for item in problem.norms] == ["e0^2 + e1^2 + e2^2 + e3^2"]
    assert [item.name for item in problem.momenta] == ["p_x", "p_y"]
    gradient, state = np.empty(13), np.arange(1.0, 14.0)
    assert problem.norms[0].function.py_func(0.0, state) == 30
    problem.norms[0].gradient.py_func(0.0, state, gradient)
    assert gradient.tolist() == [2, 4, 6, 8, *[0] * 9]
    with pytest.raises(ValueError, match="expected 1, because the quaternion of a rotation"):
        mechanics(top, {}, [1, 0.1, 0, 0, 0, 0, 0], speeds)


# Parameters.


def test_parameters_are_given_by_name_or_symbol(pushed):
    options = {"t_span": (0, 2), "inputs": {push: 0}, "outputs": {"spring": k * x}}
    problem = mechanics(pushed, {m: 2, "k": 3}, [1], [0], **options)
    members = ensemble(problem, params={k: [2.0, 8.0]}, method=EIPDOP853, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(members.y[:, 0], np.cos([2.0, 4.0]), atol=1e-7)
    one = run(problem, params={m: 0.5})
    np.testing.assert_allclose(one.y[0, -1], np.cos(np.sqrt(6) * 2), atol=1e-7)
    np.testing.assert_array_equal(
        run(problem, params={k: 0.5}).outputs["spring"], 0.5 * run(problem, params={k: 0.5}).y[0]
    )
    with pytest.raises(ValueError, match="has no parameter 'q'"):
        run(problem, params={sympy.Symbol("q"): 1})


def test_outputs_and_starts_take_the_parameters_of_the_run():
    l = sympy.Symbol("l")  # noqa: E741
    lagrangian = (x.diff() ** 2 + y.diff() ** 2) / 2 - G * y
    model = me.LagrangesMethod(lagrangian, [x, y], hol_coneqs=[x**2 + y**2 - l**2])
    problem = mechanics(model, {l: 1}, [0, -1], [1, 0], outputs={"slope": x / l})
    free = ["x", "v_x"]
    starts = problem.start({x: 0.6, y: -1}, {x.diff(): 0.5}, {l: [1, 0.75]}, independent=free)
    np.testing.assert_allclose(starts, [[0.6, -0.8, 0.5, 0.375], [0.6, -0.45, 0.5, 2 / 3]], rtol=1e-14)
    assert problem.outputs(0.0, starts[1], {l: 0.75})["slope"] == pytest.approx(0.8, rel=1e-15)
    # -G^T lambda = -2 lambda q is the centripetal force and what holds the weight along the rod.
    _, height, vx, vy = starts[1]
    expected = (vx**2 + vy**2 - G * height) / (2 * 0.75**2)
    np.testing.assert_allclose(problem.multipliers(0.0, starts[1], {l: 0.75}).values, [expected], rtol=1e-14)
