"""Mechanical systems with constraints: closed forms, published states, and SymPy's own equations."""

import dataclasses
import pickle

import numpy as np
import pytest
import sympy
from numba import njit
from scipy.integrate import solve_ivp
from scipy.special import ellipk
from sympy.physics import mechanics as me

from eip_scipy import EIPDOP853, EIPRadau, Invariant, ProjectionWarning, ensemble, integrate
from eip_scipy.engine.native import BUILD
from eip_scipy.problems import mechanics, mechanism
from eip_scipy.problems.multibody import motion
from eip_scipy_studies.bench import mechanisms as examples

G = 9.81


def run(problem, tolerance, **options):
    return integrate(problem, method=EIPDOP853, rtol=tolerance, atol=tolerance, **options)


# The solver.


def solved(M, F, rows, gamma, tolerance=1e-9):
    accelerations, multipliers = np.empty(len(F)), np.empty(len(rows))
    matrices = np.concatenate([M.ravel(), F, rows.ravel(), gamma])
    pointers = accelerations.ctypes.data, multipliers.ctypes.data
    rank = motion.SOLVE(matrices.ctypes.data, len(F), len(rows), tolerance, *pointers)
    return rank, accelerations, multipliers


@pytest.mark.parametrize(
    ("n", "m", "rank"), [(3, 2, 2), (6, 4, 3), (5, 5, 5), (4, 0, 0), (6, 8, 4), (7, 7, 0), (9, 3, 1)]
)
def test_the_solution_is_that_of_the_whole_matrix(n, m, rank):
    rng = np.random.default_rng(10 * n + m)
    A = rng.normal(size=(n, n))
    M, F = A @ A.T + np.eye(n), rng.normal(size=n)
    rows = rng.normal(size=(m, rank)) @ rng.normal(size=(rank, n))
    gamma = -rows @ rng.normal(size=n)
    found, accelerations, multipliers = solved(M, F, rows, gamma)
    sizes = np.linalg.norm(rows, axis=1)
    sizes[sizes == 0] = 1
    unit = rows / sizes[:, None]
    whole = np.block([[M, unit.T], [unit, np.zeros((m, m))]])
    expected = np.linalg.lstsq(whole, np.append(F, -gamma / sizes), rcond=1e-10)[0]
    assert found == rank
    np.testing.assert_allclose(accelerations, expected[:n], rtol=0, atol=1e-11)
    np.testing.assert_allclose(multipliers * sizes, expected[n:], rtol=0, atol=1e-10)


def test_contradicting_rows_are_met_in_the_mean():
    _, accelerations, _ = solved(np.eye(2), np.zeros(2), np.array([[1.0, 0], [2.0, 0]]), np.array([-1.0, -4.0]))
    np.testing.assert_allclose(accelerations, [1.5, 0], atol=1e-15)


def test_speeds_without_mass_need_constraints():
    M, rows = np.diag([1.0, 0, 0, 1]), np.array([[0, 1.0, 0, 0], [0, 1, 1, 0]])
    rank, accelerations, multipliers = solved(M, np.ones(4), rows, np.ones(2))
    assert rank == 2
    np.testing.assert_allclose(accelerations, [1, -1, 0, 1], atol=1e-15)
    np.testing.assert_allclose(multipliers, [0, 1], atol=1e-15)
    assert solved(M, np.ones(4), 0 * rows, np.ones(2))[0] == BUILD.multibody.MASS_IS_SINGULAR
    assert solved(M, np.full(4, np.nan), rows, np.ones(2))[0] == BUILD.multibody.NOT_FINITE


# From functions of arrays.


def length(t, q):
    return np.array([(q[0] ** 2 + q[1] ** 2 - 1) / 2])


def height(t, q):
    return G * q[1]


compiled_length, compiled_height = njit(length), njit(height)
PLAIN = {"q0": [1, 0], "u0": [0, 0], "potential_energy": height}
PENDULUM = PLAIN | {"potential_energy": compiled_height}
STATE = np.array([0.8, -0.6, 0.3, 0.4])


@pytest.fixture(scope="module")
def pendulum():
    return mechanism([1, 1], [0, -G], compiled_length, t_span=(0.0, 4 * float(ellipk(0.5)) / np.sqrt(G)), **PENDULUM)


def test_a_pendulum_returns_after_its_period_with_the_known_tension(pendulum):
    last = run(pendulum, 1e-9)
    assert last.trusted
    np.testing.assert_allclose(last.y[:, -1], [1, 0, 0, 0], atol=1e-7)
    t = np.linspace(*pendulum.t_span, 7)
    found = run(pendulum, 1e-9, t_eval=t)
    forces = pendulum.multipliers(t, found.y)
    # The rod pulls with 3 m g |y|, along -q: -G^T lambda = -lambda q.
    np.testing.assert_allclose(forces.values[0], -3 * G * found.y[1], atol=1e-6)
    assert forces.unique.all()
    assert forces.names == ("g1'",)
    with pytest.raises(ValueError, match="a column for each time"):
        pendulum.multipliers(t, found.y.T)


def test_its_repr_says_what_is_kept(pendulum):
    text = repr(pendulum)
    assert "1 on velocities of rank 1, 1 degree of freedom" in text
    assert "energy      invariant, u M u / 2 + potential_energy" in text


def test_it_pickles_and_its_members_keep_the_constraints(pendulum):
    chosen = dataclasses.replace(pendulum, invariants=pendulum.constraints)
    again = pickle.loads(pickle.dumps(chosen))
    assert [item.name for item in again.invariants] == ["constraints"]
    one, two = (run(problem, 1e-6, t_span=(0, 1)) for problem in (chosen, again))
    assert np.array_equal(one.y, two.y)
    starts = np.array([[1.0, 0, 0, 0], [0, -1, 2, 0]])
    found = ensemble(pendulum, (0, 1), starts, method=EIPDOP853, rtol=1e-6, atol=1e-6)
    assert np.abs(found.y[:, 0] ** 2 + found.y[:, 1] ** 2 - 1).max() < 1e-12


@pytest.mark.needs_jit
def test_plain_and_jitted_functions_give_the_same_motion(pendulum):
    plain = mechanism([1, 1], [0, -G], length, **PLAIN)
    assert "called from Python: constraints is not jitted by Numba" in repr(plain)
    assert pendulum.notes == ()
    for problem in (plain, pendulum):
        # M u' + G^T lambda = F with G = q, and G u' = -u.u
        pull = STATE[2:] @ STATE[2:] - G * STATE[1]
        np.testing.assert_allclose(problem.fun(0.0, STATE)[2:], [-pull * STATE[0], -G - pull * STATE[1]], atol=1e-12)
        np.testing.assert_allclose(problem.motion_at(0.0, STATE), problem.fun(0.0, STATE), atol=1e-14)
        found = np.empty((2, 4))
        problem.constraints[0].gradient(0.0, STATE, found)
        np.testing.assert_allclose(found, [[0.8, -0.6, 0, 0], [0.3, 0.4, 0.8, -0.6]], atol=1e-11)
    found = run(plain, 1e-6, t_span=(0, 1))
    assert found.trusted
    assert np.abs(found.y[0] ** 2 + found.y[1] ** 2 - 1).max() < 1e-12


def test_functions_may_change_their_arguments_and_return_the_same_array():
    kept = np.empty(1)

    def changing(function):
        def call(*args):
            value = function(*args)
            for array in args[isinstance(args[0], float) :]:
                array *= 0.5
            return value

        return call

    def sideways(t, q, u):
        kept[:] = np.real(u[0] * np.sin(q[2]) - u[1] * np.cos(q[2]))
        return kept

    def forces(t, q, u):
        return np.array([-u[0], -q[1], q[0] * u[2]])

    start = {"q0": [0.1, 0.2, 0.3], "u0": [np.cos(0.3), np.sin(0.3), 0.5]}
    options = {"kinematics": lambda t, q, u: u.copy(), "outputs": {"x": lambda t, q, u: q[0] + 0}}
    exact = mechanism(np.eye(3), forces, velocity_constraints=lambda t, q, u: np.array(sideways(t, q, u)), **start)
    changed = {"kinematics": changing(options["kinematics"]), "outputs": {"x": changing(options["outputs"]["x"])}}
    found = mechanism(changing(lambda q: np.eye(3)), changing(forces), velocity_constraints=changing(sideways),
                      energy=changing(lambda t, q, u: u @ u), **changed, **start)  # fmt: skip
    state = found.y0.copy()
    np.testing.assert_allclose(found.fun(0.0, state), exact.fun(0.0, state), atol=1e-8)
    assert found.outputs(0.0, state)["x"] == 0.1
    np.testing.assert_array_equal(state, found.y0)


@pytest.mark.parametrize("t_span", [None, (0, 10)])
def test_constraints_that_depend_on_time_are_met_nearly_at_rest(t_span):
    # The pivot of a pendulum turns back at t = 0.
    def swing(t, q):
        return np.array([(q[0] - 0.3 * np.cos(2 * t)) ** 2 + q[1] ** 2 - 1])

    def gamma(t, q, u):
        away, speed = q[0] - 0.3 * np.cos(2 * t), u[0] + 0.6 * np.sin(2 * t)
        return [2 * (speed**2 + u[1] ** 2 + away * 1.2 * np.cos(2 * t))]

    start = {"q0": [0.9, -0.8], "u0": [0, 0], "t_span": t_span}
    exact = mechanism([1, 1], [0, -G], swing, gamma=gamma, **start)
    plain, compiled = (mechanism([1, 1], [0, -G], fun, **start) for fun in (swing, njit(swing)))
    for slow in (0, 1e-14, 1e-8, 1e-3, 1):
        state = np.array([0.9, -0.8, 0.8 * slow, 0.6 * slow])
        for found in (plain, compiled):
            np.testing.assert_allclose(found.motion_at(0.0, state), exact.motion_at(0.0, state), atol=1e-11)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_skate_does_not_slip():
    problem = examples.knife_edge()
    found = run(problem, 1e-9)
    assert found.trusted
    np.testing.assert_allclose(found.y[:, -1], problem.reference(10.0), atol=1e-7)


def test_a_start_is_found_and_what_is_set_is_not_moved():
    names = {"coordinates": "x y", "speeds": "vx vy"}
    problem = mechanism([1, 1], [0, -G], length, q0=[0.6, 0.7], u0=[0.5, 0], independent=["x", "vx"], **names)
    np.testing.assert_allclose(problem.y0, [0.6, 0.8, 0.5, -0.375], rtol=1e-14)
    assert problem.y0[0] == 0.6
    assert problem.y0[2] == 0.5
    assert "y 0.7 to 0.8" in repr(problem)
    below = problem.start({"x": 0.6, "y": -0.5}, {"vx": 0.5}, independent=["x", "vx"])
    np.testing.assert_allclose(below, [0.6, -0.8, 0.5, 0.375], rtol=1e-14)


def refused(match, *args, error=ValueError, **options):
    given = {"q0": [1, 0], "u0": [0, 0], **options}
    with pytest.raises(error, match=match):
        mechanism(*(args or ([1, 1], [0, -G], length)), **given)


def test_mass_matrices_are_symmetric():
    refused(r"entries \[0, 1\] and \[1, 0\] are 0.05 and 0.* only the diagonal", [[1, 0.05], [0, 1]], [0, -G])
    refused("mass must be a symmetric matrix", lambda q: np.array([[1, q[0]], [0, 1]]), [0, -G])
    rounded = np.array([[1.0, 0.1 * 3], [0.3, 1.0]])
    assert rounded[0, 1] != rounded[1, 0]
    mechanism(rounded, [0, -G], q0=[1, 0], u0=[0, 0])


@pytest.mark.parametrize("masses", [[1, -1e-9], [-1, -1], [[0, 1], [1, 0]]], ids=str)
def test_masses_are_positive(masses):
    refused("mass must be positive for motions that the constraints allow", masses, [0, -G])


def test_masses_are_positive_for_motions_that_are_allowed():
    """On the circle, at (1, 0), only the second component moves; massless coordinates may follow others."""
    refused(r"u M u / 2 is -0.5 for u1 = 0, u2 = 1. Correct", [1, -1], [0, -G], length)
    mechanism([-0.5, 1], [0, -G], lambda t, q: [q[0] - 1], q0=[1, 0], u0=[0, 0])
    mechanism([1, 0], [0, -G], lambda t, q: [q[0] - q[1]], q0=[1, 1], u0=[0.5, 0.5])
    mechanism([1e3, 1e-3, 0], [0, -G, 0], lambda t, q: [q[1] - q[2]], q0=[1, 1, 1], u0=[0.5, 0.5, 0.5])


def test_what_is_wrong_is_said():
    refused('violates the constraint "g1\'": it is 0.5', u0=[0.5, 0])
    refused("violates the constraint 'rod': it is 1.5", q0=[2, 0], constraint_names="rod")
    refused("no start was found that meets the constraint", q0=[2, 0], independent=["q1"])
    refused("'x1' is not a component", independent=["x1"])
    refused("mass matrix is singular", [1, 0], [0, -G], lambda t, q: [q[0] - 1])
    refused("mass has the shape", np.eye(3), [0, -G], length)
    refused("forces has the shape", [1, 1], [0, -G, 0], length)
    refused("Give as many speeds as coordinates, or kinematics", [1], [0], None, u0=[0])
    refused("jacobian differs from the derivatives", jacobian=lambda t, q: [[q[1], q[0]]])
    refused("gamma differs", gamma=lambda t, q, u: [2 * u @ u])  # which is right at rest
    refused("constraints must be a function", [1, 1], [0, -G], [1.0], error=TypeError)
    refused("t is the time", [1], [0], q0=[1], u0=[0], coordinates="t")
    refused("t is the time", [1], [0], q0=[1], u0=[0], speeds="t")
    for wrong in (-1, 0, 1, np.nan, "1"):
        refused("rank_tolerance must be a number between 0 and 1", rank_tolerance=wrong)

    def contradicting(t, q):
        return [q[0] - 1, q[0] - 1.5]

    refused("'g1': it is 0.25, expected 0. It contradicts 'g2'", [1, 1], [0, -G], contradicting, independent=[])
    refused("does not depend on any component that is computed", q0=[0.6, 0.7], independent=["q1", "q2"])
    parallel = lambda t, q: [q[0] - 1, q[0] - 1 - t**2]  # noqa: E731
    refused('no accelerations meet the constraints "g1\'" and "g2\'"', [1, 1], [0, -G], parallel)
    skate = {"velocity_constraints": lambda t, q, u: [u[0] ** 2 - u[1]]}
    refused("velocity_constraints must be linear in the speeds", [1, 1], [0, -G], None, **skate)


@pytest.mark.needs_jit
@pytest.mark.parametrize("jit", [lambda f: f, njit])
def test_given_derivatives_are_compared_and_taken(jit):
    problem = mechanism(
        [1, 1], [0, -G], jit(length), q0=[1, 0], u0=[0, 0], jacobian=jit(lambda t, q: np.array([[q[0], q[1]]])),
        gamma=jit(lambda t, q, u: np.array([u[0] ** 2 + u[1] ** 2])),
    )  # fmt: skip
    pull = STATE[2:] @ STATE[2:] - G * STATE[1]
    np.testing.assert_allclose(problem.fun(0.0, STATE)[2:], [-pull * STATE[0], -G - pull * STATE[1]], atol=1e-14)


# Mechanisms with known motions.


@pytest.mark.nightly
@pytest.mark.slow
def test_the_n_four_bar_mechanism_passes_its_singular_positions():
    problem = examples.n_four_bar(1)
    for tolerance, error in ((1e-5, 1e-4), (1e-8, 1e-6)):
        found = run(problem, tolerance)
        assert found.trusted
        assert found.nfev < 3000
        np.testing.assert_allclose(found.y[:4, -1], problem.reference(10.0)[:4], atol=error)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 5, 20])
def test_longer_ones_do_too(n):
    problem = examples.n_four_bar(n)
    end = problem.reference(10.0)[: 2 * n + 2]
    for tolerance in np.logspace(-4, -10, 7):
        for invariants, calls, error in ((problem.constraints, 6000, 1e3), (problem.invariants, 3000, 30)):
            found = run(problem, tolerance, invariants=invariants)
            assert found.trusted
            assert found.nfev < calls
            assert np.abs(found.y[: 2 * n + 2, -1] - end).max() < error * tolerance


def interpreted(problem):
    """Return the equations and the constraints of a problem, not compiled."""
    (kept,) = problem.constraints
    target = np.zeros(kept.size)
    options = {"target": target, "size": target.size, "in_place": True, "name": "constraints"}
    return problem.motion_at, Invariant(kept.function.py_func, kept.gradient.py_func, **options)


@pytest.mark.parametrize("tolerance", [3e-11, 1e-11])
def test_no_step_ends_next_to_a_singular_position(tolerance):
    problem = examples.n_four_bar(1, t_end=3.0)
    fun, constraints = interpreted(problem)
    given = {"invariants": constraints, "blocks": problem.blocks, "method": EIPDOP853, "save_every": 1}
    found = integrate(fun, problem.t_span, problem.y0, rtol=tolerance, atol=tolerance, **given)
    assert found.trusted
    assert found.diagnostics.n_rejected_projections == 0
    assert found.nfev < 1500
    np.testing.assert_allclose(found.y[:, -1], problem.reference(3.0), atol=1e-7)
    crossed = np.flatnonzero(np.diff(np.sign(found.y[1])))
    assert crossed.size == 3
    assert np.abs(found.y[1]).min() > 3e-3  # nearer, steps would become as short as 1e-8


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("lab", ["constraints", "invariants"])
def test_singular_positions_are_passed_at_any_tolerance(lab):
    problem = examples.n_four_bar(5)
    end = problem.reference(10.0)[:12]
    for tolerance in np.logspace(-4, -10, 37):
        found = run(problem, tolerance, invariants=getattr(problem, lab))
        assert found.trusted
        assert found.nfev < 6000
        assert np.abs(found.y[:12, -1] - end).max() < 1e3 * tolerance


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-5, 1e-8])
def test_a_leak_at_singular_positions_is_reported(tolerance):
    right = examples.n_four_bar(1)

    def forces(t, q, u):
        drag = 0.1 * np.exp(-((q[1] / 0.02) ** 2))  # where all rods are horizontal
        return np.array([0, -G - drag * u[1], 0, -G - drag * u[3]])

    M = np.kron(np.eye(2) / 3 + np.array([[2, 1], [1, 2]]) / 6, np.eye(2))

    def lengths(t, q):
        left, right = q[0] ** 2 + q[1] ** 2 - 1, (q[2] - 1) ** 2 + q[3] ** 2 - 1
        return np.array([left, right, (q[2] - q[0]) ** 2 + (q[3] - q[1]) ** 2 - 1]) / 2

    def gamma(t, q, u):
        last = (u[2] - u[0]) ** 2 + (u[3] - u[1]) ** 2
        return np.array([u[0] ** 2 + u[1] ** 2, u[2] ** 2 + u[3] ** 2, last])

    leaky = mechanism(
        M, njit(forces), njit(lengths), q0=right.y0[:4], u0=right.y0[4:], t_span=(0, 10), gamma=njit(gamma),
        potential_energy=njit(lambda t, q: G * (q[1] + q[3])),
    )  # fmt: skip
    assert not leaky.energy.is_balance  # the drag is not seen near the start
    with pytest.warns(ProjectionWarning, match="energy"):
        found = run(leaky, tolerance)
    assert not found.trusted


@pytest.mark.nightly
@pytest.mark.slow
def test_andrews_squeezing_mechanism_ends_where_it_is_known_to():
    problem = examples.andrews()
    found = run(problem, 1e-11)
    assert found.trusted
    np.testing.assert_allclose(found.y[:7, -1], examples.END, rtol=1e-8)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_car_axis_ends_where_it_is_known_to():
    problem = examples.car_axis()
    found = run(problem, 1e-12)
    assert found.trusted
    np.testing.assert_allclose(found.y[:, -1], examples.CAR_END, rtol=1e-8)


@pytest.mark.nightly
@pytest.mark.slow
def test_bricards_mechanism_has_redundant_constraints():
    problem = examples.bricard()
    assert "24 on velocities of rank 23, 1 degree of freedom" in repr(problem)
    found = run(problem, 1e-8)
    assert found.trusted
    np.testing.assert_allclose(found.y[6:9, -1], [1, -1.00027, 0.99973], atol=5e-6)  # as published
    assert np.abs(found.invariants[-1] + 29.43).max() < 1e-9
    again = run(problem, 1e-8, t_span=(4.0, 5.0), y0=run(problem, 1e-8, t_span=(0, 4)).y[:, -1])
    assert again.trusted


@pytest.mark.nightly
@pytest.mark.slow
def test_it_moves_the_same_in_other_coordinates():
    states = [run(examples.bricard(0.0, axes, 1.0), 1e-8).y[:12, -1] for axes in (True, False)]
    np.testing.assert_allclose(*states, atol=1e-6)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("wobbling", [False, True])
def test_a_disc_rolls(wobbling):
    problem = examples.disc(wobbling)
    found = run(problem, 1e-10)
    assert found.trusted
    np.testing.assert_allclose(found.y[:, -1], problem.reference(5.0), atol=1e-6)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_four_bar_linkage_keeps_constraints_and_energy():
    problem = examples.four_bar()
    best = run(problem, 1e-13).y[:, -1]
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        plain = run(problem, tolerance, invariants=())
        kept = run(problem, tolerance)
        assert kept.trusted
        if tolerance < 1e-4:  # at 1e-4 DOP853 alone is wrong by 0.4, and its steps are those of another motion
            assert kept.nfev <= 1.05 * plain.nfev
        assert np.abs(kept.y[:, -1] - best).max() <= np.abs(plain.y[:, -1] - best).max() / 30


# Models of SymPy.


@pytest.fixture(scope="module")
def four_bar():
    return examples.four_bar()


def test_a_model_moves_as_its_own_equations_say(four_bar):
    model, constants = examples.four_bar_model()
    y = four_bar.y0.copy()
    y[3:] = 1.3 * np.linalg.svd(_speed_gradient(four_bar, y))[2][-1]
    state = dict(zip([*model.q, *model.u], y, strict=True)) | constants
    M, f = (np.array(item.xreplace(state), float) for item in (model.mass_matrix, model.forcing))
    np.testing.assert_allclose(four_bar.motion_at(0.0, y)[3:], np.linalg.solve(M, f)[:, 0], rtol=1e-9)
    assert "potential of constant loads" in four_bar.energy_kept
    assert "q2 0.1 to" in repr(four_bar)


def _speed_gradient(problem, y):
    out = np.empty((4, 6))
    problem.constraints[0].gradient.py_func(0.0, y, out, problem.params)
    return out[2:, 3:]


def point_in_a_plane():
    """Return coordinates and speeds, mass and gravity, and the frame with its origin and a point at (x, y)."""
    x, y, u, v = me.dynamicsymbols("x y u v")
    N, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(N, 0)
    return (x, y, u, v), sympy.symbols("m g"), (N, origin, origin.locatenew("P", x * N.x + y * N.y))


def particle(constrained_speeds):
    """Return a particle on the parabola y = x^2, with or without the velocity constraint."""
    (x, y, u, v), (m, g), (N, _, P) = point_in_a_plane()
    P.set_vel(N, u * N.x + v * N.y)
    dependent = {"u_dependent": [v], "velocity_constraints": [v - 2 * x * u]} if constrained_speeds else {}
    model = me.KanesMethod(
        N, [x], [u] if dependent else [u, v], kd_eqs=[x.diff() - u, y.diff() - v], q_dependent=[y],
        configuration_constraints=[y - x**2], **dependent,
    )  # fmt: skip
    model.kanes_equations([me.Particle("A", P, m)], [(P, -m * g * N.y)])
    return model


def test_a_configuration_constraint_without_velocity_constraint_is_added():
    states = []
    for constrained in (True, False):
        problem = mechanics(particle(constrained), {"m": 1, "g": G}, {"x": 1}, {"u": 0.5}, independent=["x", "u"])
        assert ("velocity constraints were added for g1" in repr(problem)) is not constrained
        assert "energy      invariant" in repr(problem)
        states.append(problem.motion_at(0.0, problem.y0))
    # (1 + 4 x^2) x'' + 4 x x'^2 + 2 g x = 0
    np.testing.assert_allclose(states[0][2], -(4 * 0.25 + 2 * G) / 5, rtol=1e-14)
    np.testing.assert_allclose(states[0], states[1], rtol=1e-14)


def test_lagranges_method_and_a_system_give_the_same_motion():
    x, y = me.dynamicsymbols("x y")
    m, g = sympy.symbols("m g")
    L = m * (x.diff() ** 2 + y.diff() ** 2) / 2 - m * g * y
    model = me.LagrangesMethod(L, [x, y], hol_coneqs=[y - x**2])
    problem = mechanics(model, {m: 1, g: G}, [1, 1], {"v_x": 0.5, y.diff(): 1.0})
    np.testing.assert_allclose(problem.motion_at(0.0, problem.y0)[2], -(4 * 0.25 + 2 * G) / 5, rtol=1e-14)
    assert problem.energy_kept == "invariant, of the Lagrangian"

    class System:  # as PyDy's
        eom_method, constants, initial_conditions = model, {m: 1, g: G}, {x: 1, y: 1, x.diff(): 0.5, y.diff(): 1.0}

    np.testing.assert_array_equal(mechanics(System()).y0, problem.y0)


def parabola_as_system(by_speeds):
    """Return the particle as a System of SymPy, whose equations are not formed yet."""
    (x, y, u, v), (m, g), (N, origin, P) = point_in_a_plane()
    P.set_vel(N, u * N.x + v * N.y if by_speeds else x.diff() * N.x + y.diff() * N.y)
    system = me.System(N, origin)
    system.add_bodies(me.Particle("A", P, m))
    system.add_coordinates(x)
    system.add_coordinates(y, independent=not by_speeds)
    if by_speeds:
        system.add_speeds(u)
        system.add_speeds(v, independent=False)
        system.add_kdes(x.diff() - u, y.diff() - v)
    system.add_holonomic_constraints(y - x**2)
    system.apply_uniform_gravity(-g * N.y)
    return system


@pytest.mark.parametrize("by_speeds", [True, False])
def test_a_system_of_sympy_gives_the_same_motion(by_speeds):
    system = parabola_as_system(by_speeds)
    if not by_speeds:
        system.form_eoms(eom_method=me.LagrangesMethod)
    names = ("u", "v") if by_speeds else ("v_x", "v_y")
    start = {"x": 1, "y": 0.9}, dict(zip(names, (0.5, 0), strict=True))
    problem = mechanics(system, {"m": 1, "g": G}, *start, independent=["x", names[0]])
    assert problem.names.speeds == names
    np.testing.assert_allclose(problem.y0, [1, 1, 0.5, 1], rtol=1e-14)
    np.testing.assert_allclose(problem.motion_at(0.0, problem.y0)[2], -(4 * 0.25 + 2 * G) / 5, rtol=1e-14)
    if by_speeds:
        assert "potential of constant loads" in problem.energy_kept


def test_joints_of_a_system_of_sympy():
    """The model has two rods on pins; the end of the second one slides along the line of x through the first pin."""
    m, g = sympy.symbols("m g")
    ground, rods = me.RigidBody("ground"), [me.RigidBody(f"rod{k}", mass=m) for k in range(2)]
    for rod in rods:
        rod.central_inertia = me.inertia(rod.frame, 0, m / 12, m / 12)
    system = me.System.from_newtonian(ground)
    for k, (parent, place) in enumerate(((ground, None), (rods[0], rods[0].x / 2))):
        pin = me.PinJoint(
            f"pin{k}", parent, rods[k], joint_axis=parent.z, parent_point=place, child_point=-rods[k].x / 2
        )
        system.add_joints(pin)
    (first, second), (one, two) = system.q, system.u
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [first], [second], [one], [two]
    end = rods[1].masscenter.locatenew("end", rods[1].x / 2)
    system.add_holonomic_constraints(end.pos_from(system.fixed_point).dot(ground.y))
    system.apply_uniform_gravity(-g * ground.x)
    angle, rate = 0.7, 0.3
    problem = mechanics(system, {m: 2.0, g: G}, {first: angle, second: -1.3}, {one: rate})
    np.testing.assert_allclose(problem.y0, [angle, -2 * angle, rate, -2 * rate], rtol=1e-13)
    # Rods of 1 m at the angles q and -q from the direction of x: T = (1/3 + sin^2 q) m q'^2, V = 2 m g cos q.
    sin, cos = np.sin(angle), np.cos(angle)
    expected = (G - cos * rate**2) * sin / (1 / 3 + sin**2)
    np.testing.assert_allclose(problem.motion_at(0.0, problem.y0)[2:], [expected, -2 * expected], rtol=1e-12)


def test_a_system_of_pydy_brings_constants_and_start():
    pydy = pytest.importorskip("pydy.system", reason="needs PyDy: python -m pip install pydy")
    model = particle(True)
    m, g = sympy.symbols("m g")
    start = dict(zip([*model.q, *model.u], (1.0, 1.0, 0.5, 1.0), strict=True))
    system = pydy.System(model, constants={m: 2.0, g: G}, initial_conditions=start, times=np.linspace(0, 1, 5))
    problem = mechanics(system)
    assert problem.parameters == {"m": 2.0, "g": G}
    np.testing.assert_allclose(problem.motion_at(0.0, problem.y0), system.evaluate_ode(), rtol=1e-13)
    times, states = system.times, system.integrate(rtol=1e-10, atol=1e-10)
    found = solve_ivp(problem.motion_at, (0, 1), problem.y0, t_eval=times, method="DOP853", rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(found.y.T, states, atol=1e-8)
    # A constant that is given goes before that of the model.
    lighter = mechanics(system, {"g": 1.0})
    np.testing.assert_allclose(lighter.motion_at(0.0, lighter.y0)[2], -(4 * 0.25 + 2) / 5, rtol=1e-13)


def test_what_is_wrong_with_a_model_is_said():
    model, start = particle(True), ({"x": 1}, {"u": 0.5})
    with pytest.raises(ValueError, match="value of 'g' is missing"):
        mechanics(model, {"m": 1}, *start)
    with pytest.raises(TypeError, match="expected a KanesMethod"):
        mechanics(object(), {}, *start)
    with pytest.raises(TypeError, match="q0 or u0 is missing"):
        mechanics(model, {"m": 1, "g": G})
    x, u, aux = me.dynamicsymbols("x u aux")
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, u * N.x + aux * N.y)
    kane = me.KanesMethod(N, [x], [u], kd_eqs=[x.diff() - u], u_auxiliary=[aux])
    kane.kanes_equations([me.Particle("A", P, 1)], [])
    with pytest.raises(ValueError, match="auxiliary speeds"):
        mechanics(kane, {}, [0], [0])


def test_different_quantities_have_different_names():
    def refused(one, two, force, params, match=None):
        expected = match or f"two different quantities are called .*{one}.* and .*{two}"
        with pytest.raises(ValueError, match=expected):
            mechanics(spring(force), params, [1], [0])
        with pytest.raises(ValueError, match=expected):
            mechanics(me.LagrangesMethod(x.diff() ** 2 / 2 + x * force, [x]), params, [1], [0])

    def spring(force):
        N, P = me.ReferenceFrame("N"), me.Point("P")
        P.set_vel(N, x.diff() * N.x)
        kane = me.KanesMethod(N, [x], [speed], kd_eqs=[x.diff() - speed])
        kane.kanes_equations([me.Particle("A", P, 1)], [(P, force * N.x)])
        return kane

    x, speed, push = me.dynamicsymbols("x v_x push")
    one, two = sympy.symbols("k"), sympy.symbols("k", positive=True)
    named, rate = sympy.symbols("x v_x")
    refused(r"x\(t\)", r"Symbol\('x'\)", -named * x, {named: 4})
    refused("v_x|Derivative", r"Symbol\('v_x'\)", -rate * x, {rate: 4})
    refused(r"Symbol\('k'\)", r"Symbol\('k', positive=True\)", -(one + two) * x, {"k": 1})
    refused("", "", -(one + two) * x, {one: 1, two: 3}, "two keys are called 'k'")
    refused("the time", r"Symbol\('t', real=True\)", sympy.Symbol("t", real=True) * x, {})
    refused("", "", -x, {"x": 1}, "'x' is the name of a parameter, and of a component")
    braces, brackets = sympy.symbols("k{1} k[1]", cls=sympy.Symbol)
    refused(r"Symbol\('k\[1\]'\)", r"Symbol\('k\{1\}'\)", -(braces + brackets) * x, {"k{1}": 1})
    # The amplitude of an input may have its name, and quantities of the user may contain names of the state.
    amplitude = sympy.Symbol("push")
    driven = mechanics(spring(push), {amplitude: 3}, [1], [2], inputs={push: amplitude * x}, outputs={"v": rate})
    np.testing.assert_array_equal(driven.motion_at(0.0, driven.y0), [2, 3])
    assert driven.outputs(0.0, driven.y0) == {"v": 2}


@pytest.mark.parametrize(
    ("order", "attitude"), [("321", (0, 0, 0)), ("321", (0, 0, np.pi / 2)), ("313", (0, 0.5, 0)), ("123", (0, 0.4, 0))]
)
def test_euler_angles_of_a_body_with_body_rates(order, attitude):
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    N, centre = me.ReferenceFrame("N"), me.Point("C")
    B = N.orientnew("B", "Body", q, order)
    rates = B.ang_vel_in(N)
    B.set_ang_vel(N, sum((a * axis for a, axis in zip(u, B, strict=True)), 0 * N.x))
    centre.set_vel(N, 0)
    model = me.KanesMethod(N, q, u, kd_eqs=[a - rates.dot(axis) for a, axis in zip(u, B, strict=True)])
    model.kanes_equations([me.RigidBody("A", centre, B, 1, (me.inertia(B, 1, 2, 3), centre))], [])
    w = np.array([0.1, 1.0, 0.2])
    problem = mechanics(model, {}, attitude, w)
    state = dict(zip(q, attitude, strict=True))
    found = problem.motion_at(0.0, problem.y0)
    turned = [rates.dot(axis).xreplace(dict(zip([a.diff() for a in q], found[:3], strict=True))) for axis in B]
    np.testing.assert_allclose([float(item.xreplace(state)) for item in turned], w, atol=1e-15)
    np.testing.assert_allclose(found[3:], [-w[1] * w[2], w[2] * w[0], -w[0] * w[1] / 3], atol=1e-15)
    if order == "313":
        with pytest.raises(ValueError, match="divide by zero at the start"):
            mechanics(model, {}, [0, 0, 0], w)


def test_inputs_are_expressions_of_time_and_state():
    x, u, push = me.dynamicsymbols("x u push")
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, u * N.x)
    kane = me.KanesMethod(N, [x], [u], kd_eqs=[x.diff() - u])
    kane.kanes_equations([me.Particle("A", P, 2)], [(P, push * N.x)])
    with pytest.raises(ValueError, match=r"push.* is neither a coordinate nor a speed"):
        mechanics(kane, {}, [0], [1])
    problem = mechanics(kane, {}, [0], [1], inputs={"push": sympy.sin(me.dynamicsymbols._t) - 3 * x})
    np.testing.assert_allclose(problem.motion_at(0.5, np.array([0.2, 1.0])), [1.0, (np.sin(0.5) - 0.6) / 2], rtol=1e-15)


def test_a_pole_of_dependent_speeds_is_none_of_the_motion():
    # At y = x^2, x = 0 the other choice of dependent speeds, u by v, is singular.
    problem = mechanics(particle(True), {"m": 1, "g": G}, [0, 0], [0.7, 0])
    found = solve_ivp(lambda t, y: problem.motion_at(t, y), (0, 0.1), problem.y0, rtol=1e-9, atol=1e-9)
    assert found.success


def test_implicit_methods_keep_the_constraints_alone():
    pendulum = mechanism([1, 1], [0, -G], compiled_length, **PENDULUM)
    options = {"t_span": (0, 1.0), "method": EIPRadau, "rtol": 1e-6, "atol": 1e-6}
    found = integrate(pendulum, **options)
    assert len(found.target) == 2
    assert found.trusted
    assert np.abs(found.y[0] ** 2 + found.y[1] ** 2 - 1).max() < 1e-14
    both = integrate(pendulum, invariants=pendulum.invariants, **options)
    assert len(both.target) == 3
