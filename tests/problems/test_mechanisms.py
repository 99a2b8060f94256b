"""Mechanical systems from functions of arrays: closed forms, published states, energies, outputs, and wrong input."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from scipy.special import ellipk

from eip_scipy import EIPDOP853, EIPRK4, Balance, EIPRadau, Invariant, ensemble, integrate, load
from eip_scipy.problems import kepler, mechanism
from eip_scipy_studies.bench import mechanisms as examples

G = 9.81
STATE = np.array([0.8, -0.6, 0.3, 0.4])
NIGHTLY = pytest.mark.nightly


def plain(function):
    return function


# Functions that are jitted take many seconds to compile: most tests are of plain ones.
JITS = pytest.mark.parametrize("jit", [plain, pytest.param(njit, marks=[NIGHTLY, pytest.mark.needs_jit])])


def run(problem, tolerance, **options):
    return integrate(problem, method=EIPDOP853, rtol=tolerance, atol=tolerance, **options)


# A pendulum: a particle on a circle, released at the height of the pivot.


def length(t, q):
    return np.array([(q[0] ** 2 + q[1] ** 2 - 1) / 2])


def potential(t, q):
    return G * q[1]


def height(t, q, u):
    return q[1]


def energy(t, q, u):
    return u @ u / 2 + G * q[1]


def pendulum(jit=plain, **options):
    given = {"q0": [1, 0], "u0": [0, 0], "potential_energy": jit(potential), **options}
    return mechanism([1, 1], [0, -G], jit(length), **given)


def off_the_circle(y):
    return np.abs(y[0] ** 2 + y[1] ** 2 - 1).max()


@pytest.fixture(scope="module")
def released():
    return pendulum(outputs={"height": height, "energy": energy}, t_span=(0.0, 2.0))


@pytest.fixture(scope="module")
def swing(released):
    return run(released, 1e-9, t_eval=np.linspace(0, 2, 5))


@pytest.mark.needs_jit
def test_a_jitted_pendulum_returns_after_its_period_with_the_known_tension():
    problem = pendulum(njit, t_span=(0.0, 4 * float(ellipk(0.5)) / np.sqrt(G)))
    t = np.linspace(*problem.t_span, 7)
    found = run(problem, 1e-9, t_eval=t)
    assert problem.notes == ()
    assert found.compiled
    assert found.trusted
    np.testing.assert_allclose(found.y[:, -1], [1, 0, 0, 0], atol=1e-7)
    forces = problem.multipliers(t, found.y)
    # The rod pulls with 3 m g |y|, along -q: -G^T lambda = -lambda q.
    np.testing.assert_allclose(forces.values[0], -3 * G * found.y[1], atol=1e-6)
    assert forces.unique.all()
    assert forces.names == ("g1'",)
    np.testing.assert_allclose(problem.fun(0.0, STATE), pendulum().fun(0.0, STATE), rtol=1e-14, atol=1e-14)
    text = repr(problem)
    assert "1 on velocities of rank 1, 1 degree of freedom" in text
    assert "energy      invariant, u M u / 2 + potential_energy" in text
    with pytest.raises(ValueError, match="a column for each time"):
        problem.multipliers(t, found.y.T)


@JITS
@pytest.mark.parametrize("given", [False, True])
def test_the_motion_is_that_of_the_equations(jit, given):
    derivatives = {"jacobian": lambda t, q: np.array([[q[0], q[1]]]), "gamma": lambda t, q, u: np.array([u @ u])}
    problem = pendulum(jit, **({name: jit(item) for name, item in derivatives.items()} if given else {}))
    assert ("called from Python: constraints is not jitted by Numba" in repr(problem)) is (jit is plain)
    # M u' + G^T lambda = F with G = q, and G u' = -u.u
    pull = STATE[2:] @ STATE[2:] - G * STATE[1]
    np.testing.assert_allclose(problem.fun(0.0, STATE)[2:], [-pull * STATE[0], -G - pull * STATE[1]], atol=1e-12)
    np.testing.assert_allclose(problem.motion_at(0.0, STATE), problem.fun(0.0, STATE), atol=1e-14)
    found = np.empty((2, 4))
    problem.constraints[0].gradient(0.0, STATE, found)
    np.testing.assert_allclose(found, [[0.8, -0.6, 0, 0], [0.3, 0.4, 0.8, -0.6]], atol=1e-11)


def test_it_pickles_and_its_members_and_implicit_methods_keep_the_constraints(released):
    chosen = replace(released, invariants=released.constraints)
    again = pickle.loads(pickle.dumps(chosen))
    assert [item.name for item in again.invariants] == ["constraints"]
    one, two = (run(problem, 1e-6, t_span=(0, 1)) for problem in (chosen, again))
    np.testing.assert_array_equal(one.y, two.y)
    starts = np.array([[1.0, 0, 0, 0], [0, -1, 2, 0]])
    options = {"method": EIPDOP853, "rtol": 1e-6, "atol": 1e-6}
    members, saved = (ensemble(released, (0, 1), starts, t_eval=t, **options) for t in (None, [0, 0.5, 1]))
    assert off_the_circle(members.y.T) < 1e-12
    for found, y in ((members, members.y), (pickle.loads(pickle.dumps(saved)), saved.trajectories)):
        np.testing.assert_array_equal(found.outputs["height"], y[:, 1])
        forces = (y[:, 2:] ** 2).sum(axis=1) - G * y[:, 1]
        np.testing.assert_allclose(found.multipliers.values[:, 0], forces, rtol=1e-12)
        assert found.multipliers.unique.all()
    implicit = {"t_span": (0, 1.0), "method": EIPRadau, "rtol": 1e-6, "atol": 1e-6}
    found = integrate(released, **implicit)
    assert len(found.target) == 2
    assert found.trusted
    assert off_the_circle(found.y) < 1e-14
    assert len(integrate(released, invariants=released.invariants, **implicit).target) == 3


def test_a_run_has_outputs_and_multipliers(released, swing, tmp_path):
    np.testing.assert_array_equal(swing.outputs["height"], swing.y[1])
    np.testing.assert_allclose(swing.outputs["energy"], 0, atol=1e-13)
    np.testing.assert_allclose(swing.multipliers.values[0], -3 * G * swing.y[1], atol=1e-6)
    swing.save(tmp_path / "run.npz")
    longer = swing.continue_to(3.0)
    assert longer.outputs["height"].shape == longer.t.shape == longer.multipliers.rank.shape
    np.testing.assert_array_equal(longer.outputs["height"], longer.y[1])
    cut = swing.continue_to(3.0, fun=lambda t, y: np.array([*y[2:], 0, -G]))  # the string, whose force ends there
    first = np.arange(cut.t.size) < swing.t.size
    np.testing.assert_array_equal(np.isnan(cut.outputs["height"]), ~first)
    np.testing.assert_array_equal(cut.multipliers.values[:, first], swing.multipliers.values)
    np.testing.assert_array_equal(cut.multipliers.rank, first)
    assert cut.y[1, -1] == pytest.approx(swing.y[1, -1] + swing.y[3, -1] - G / 2)
    assert {"height", "multiplier g1'"} < set(cut.to_dataframe().columns)
    for again in (load(tmp_path / "run.npz"), pickle.loads(pickle.dumps(swing))):
        np.testing.assert_array_equal(again.outputs["energy"], swing.outputs["energy"])
        np.testing.assert_array_equal(again.multipliers.values, swing.multipliers.values)
        assert again.multipliers.names == ("g1'",)
    assert pickle.loads(pickle.dumps(released)).outputs(0.0, released.y0) == {"height": 0.0, "energy": 0.0}


def test_tables_have_outputs_and_multipliers(swing):
    frame, data = swing.to_dataframe(), swing.to_xarray()
    assert list(frame.columns)[-3:] == ["height", "output energy", "multiplier g1'"]  # the energy is an invariant
    np.testing.assert_array_equal(data.outputs.sel(output="height"), swing.y[1])
    np.testing.assert_array_equal(data.multipliers.sel(constraint="g1'"), swing.multipliers.values[0])
    assert data.constraint_rank.values.tolist() == [1] * 5


def test_results_and_states_without_outputs(released):
    with pytest.raises(ValueError, match="outputs: y has the shape"):
        released.outputs([0.0, 1.0], released.y0)
    result = integrate(kepler(), (0, 1), method=EIPRK4)
    for name in ("outputs", "multipliers"):
        with pytest.raises(AttributeError, match=f"this result has no {name}"):
            getattr(result, name)


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
    exact = mechanism(np.eye(3), forces, velocity_constraints=lambda t, q, u: np.array(sideways(t, q, u)), **start)
    found = mechanism(
        changing(lambda q: np.eye(3)), changing(forces), velocity_constraints=changing(sideways),
        energy=changing(lambda t, q, u: u @ u),
        kinematics=changing(lambda t, q, u: u.copy()), outputs={"x": changing(lambda t, q, u: q[0] + 0)}, **start,
    )  # fmt: skip
    state = found.y0.copy()
    np.testing.assert_allclose(found.fun(0.0, state), exact.fun(0.0, state), atol=1e-8)
    assert found.outputs(0.0, state)["x"] == 0.1
    np.testing.assert_array_equal(state, found.y0)


def test_functions_are_called_as_they_are():
    """Outputs that branch, and functions whose coefficients change."""
    stiffness = np.array([1.0])
    outputs = {"side": lambda t, q, u: 1.0 if q[0] > 0 else -1.0}
    force = lambda t, q, u: [-stiffness[0] * q[0]]  # noqa: E731
    problem = mechanism([1.0], force, q0=[1.0], u0=[0], t_span=(0, 3), outputs=outputs)
    assert problem.outputs([0.0, 0.0], [[1.0, -2.0], [0.0, 0.0]])["side"].tolist() == [1, -1]
    integrate(problem, method=EIPRK4, h=0.01)
    stiffness[0] = 4.0
    assert integrate(problem, method=EIPDOP853, h=0.05).y[0, -1] == pytest.approx(np.cos(6.0), abs=1e-10)


@JITS
@pytest.mark.parametrize("t_span", [None, (0, 10)])
def test_constraints_that_depend_on_time_are_met_nearly_at_rest(jit, t_span):
    # The pivot of a pendulum turns back at t = 0.
    def pivot(t, q):
        return np.array([(q[0] - 0.3 * np.cos(2 * t)) ** 2 + q[1] ** 2 - 1])

    def gamma(t, q, u):
        away, speed = q[0] - 0.3 * np.cos(2 * t), u[0] + 0.6 * np.sin(2 * t)
        return [2 * (speed**2 + u[1] ** 2 + away * 1.2 * np.cos(2 * t))]

    start = {"q0": [0.9, -0.8], "u0": [0, 0], "t_span": t_span}
    exact = mechanism([1, 1], [0, -G], pivot, gamma=gamma, **start)
    found = mechanism([1, 1], [0, -G], jit(pivot), **start)
    for slow in (0, 1e-14, 1e-8, 1e-3, 1):
        state = np.array([0.9, -0.8, 0.8 * slow, 0.6 * slow])
        np.testing.assert_allclose(found.motion_at(0.0, state), exact.motion_at(0.0, state), atol=1e-11)


@JITS
def test_a_run_keeps_constraints_that_depend_on_time(jit):
    rod = jit(lambda t, q: np.array([q[0] * np.sin(2 * t) - q[1] * np.cos(2 * t)]))
    found = run(mechanism([1, 1], [0, 0], rod, q0=[1, 0], u0=[0, 2]), 1e-9, t_span=(0, 1))
    assert found.trusted
    r, speed = np.cosh(2), 2 * np.sinh(2)
    along, across = np.array([np.cos(2), np.sin(2)]), np.array([-np.sin(2), np.cos(2)])
    np.testing.assert_allclose(found.y[:, -1], np.append(r * along, speed * along + 2 * r * across), atol=1e-8)


def test_a_start_is_found_and_what_is_set_is_not_moved():
    names = {"coordinates": "x y", "speeds": "vx vy"}
    problem = pendulum(q0=[0.6, 0.7], u0=[0.5, 0], independent=["x", "vx"], **names)
    np.testing.assert_allclose(problem.y0, [0.6, 0.8, 0.5, -0.375], rtol=1e-14)
    assert (problem.y0[0], problem.y0[2]) == (0.6, 0.5)
    assert "y 0.7 to 0.8" in repr(problem)
    below = problem.start({"x": 0.6, "y": -0.5}, {"vx": 0.5}, independent=["x", "vx"])
    np.testing.assert_allclose(below, [0.6, -0.8, 0.5, 0.375], rtol=1e-14)


PENDULUM = {"constraints": length, "q0": [1, 0], "u0": [0, 0]}
WITH_POTENTIAL = PENDULUM | {"potential_energy": potential}
SPRING = {"q0": [0], "u0": [0], "potential_energy": lambda t, q: q[0] ** 2 / 2}
TURNING = {"constraints": lambda t, q: [q[0] * np.sin(2 * t) - q[1] * np.cos(2 * t)], "q0": [1, 0], "u0": [0, 2]}
JACOBI = TURNING | {"energy": lambda t, q, u: u @ u / 2 - 2 * (q[0] * u[1] - q[1] * u[0])}


def drag(c):
    return lambda t, q, u: np.array([0, -G]) - c * u


@pytest.mark.parametrize(
    ("mass", "forces", "options", "kept"),
    [
        ([1, 1], [0, -G], PENDULUM, "not known; give energy= or potential_energy="),
        ([1, 1], [0, -G], WITH_POTENTIAL, "invariant, u M u / 2 + potential_energy"),
        ([1, 1], [0, -G], PENDULUM | {"energy": energy}, "invariant, energy"),
        ([1, 1], drag(1e-3), WITH_POTENTIAL, "balance, u M u / 2 + potential_energy"),
        ([1, 1], drag(5.0), WITH_POTENTIAL, "not kept"),
        # The force is 0 at the start, at which the system is in equilibrium.
        ([1], lambda t, q, u: [np.sin(t) - q[0]], SPRING, "not kept"),
        ([1], lambda t, q, u: [-q[0]], SPRING, "invariant"),
        # On a rod that turns at the rate 2, E - 2 L is kept, and E is not.
        ([1, 1], [0, 0], TURNING | {"energy": lambda t, q, u: u @ u / 2}, "not kept"),
        ([1, 1], [0, 0], JACOBI, "invariant"),
    ],
)
def test_energies_are_kept_if_they_are_constant_or_slow(mass, forces, options, kept):
    problem = mechanism(mass, forces, **options)
    assert problem.energy_kept.startswith(kept)
    assert (problem.energy is None) is kept.startswith("not")
    assert isinstance(problem.energy, Balance) is kept.startswith("balance")


@JITS
def test_a_given_power_is_that_of_the_energy(jit):
    power = jit(lambda t, q, u: -1e-3 * (u[0] * u[0] + u[1] * u[1]))
    forces = jit(lambda t, q, u: np.array([-1e-3 * u[0], -G - 1e-3 * u[1]]))
    given = {name: jit(item) if callable(item) else item for name, item in WITH_POTENTIAL.items()}
    problem = mechanism([1, 1], forces, power=power, **given)
    assert problem.energy.rate_function is not None
    assert (problem.notes == ()) is (jit is njit)


# Wrong input. Each row: some words, what differs from the pendulum, and the kind of error.


def on_a_line(t, q):
    return [q[0] - 1]


WRONG = [
    ('violates the constraint "g1\'": it is 0.5', {"u0": [0.5, 0]}),
    ("violates the constraint 'rod': it is 1.5", {"q0": [2, 0], "constraint_names": "rod"}),
    ("no start was found that meets the constraint", {"q0": [2, 0], "independent": ["q1"]}),
    ("does not depend on any component that is computed", {"q0": [0.6, 0.7], "independent": ["q1", "q2"]}),
    ("'x1' is not a component", {"independent": ["x1"]}),
    ("t is the time", {"coordinates": "t x"}),
    ("t is the time", {"speeds": "t x"}),
    (r"entries \[0, 1\] and \[1, 0\] are 0.05 and 0.* only the diagonal", {"mass": [[1, 0.05], [0, 1]]}),
    ("mass must be a symmetric matrix", {"mass": lambda q: np.array([[1, q[0]], [0, 1]])}),
    *(("mass must be positive for motions that the constraints allow", {"mass": mass, "constraints": None})
      for mass in ([1, -1e-9], [-1, -1], [[0, 1], [1, 0]])),
    # On the circle, at (1, 0), only the second component moves.
    (r"u M u / 2 is -0.5 for u1 = 0, u2 = 1. Correct", {"mass": [1, -1]}),
    ("mass matrix is singular", {"mass": [1, 0], "constraints": on_a_line}),
    ("mass has the shape", {"mass": np.eye(3)}),
    ("forces has the shape", {"forces": [0, -G, 0]}),
    ("Give as many speeds as coordinates, or kinematics", {"mass": [1], "forces": [0], "constraints": None, "u0": [0]}),
    ("jacobian differs from the derivatives", {"jacobian": lambda t, q: [[q[1], q[0]]]}),
    ("gamma differs", {"gamma": lambda t, q, u: [2 * u @ u]}),  # which is right at rest
    ("constraints must be a function", {"constraints": [1.0]}, TypeError),
    *(("rank_tolerance must be a number between 0 and 1", {"rank_tolerance": wrong}) for wrong in (-1, 1, np.nan, "1")),
    ("'g1': it is 0.25, expected 0. It contradicts 'g2'",
     {"constraints": lambda t, q: [q[0] - 1, q[0] - 1.5], "independent": []}),
    ('no accelerations meet the constraints "g1\'" and "g2\'"',
     {"constraints": lambda t, q: [q[0] - 1, q[0] - 1 - t**2]}),
    ("velocity_constraints must be linear in the speeds",
     {"constraints": None, "velocity_constraints": lambda t, q, u: [u[0] ** 2 - u[1]]}),
    ("Correct power or the energy",
     {"forces": drag(1e-3), "power": lambda t, q, u: -2e-3 * u @ u, "potential_energy": potential}),
    ("has the name of a component", {"outputs": {"q1": height}}),
    (r"has the shape \(2,\); expected a number", {"outputs": {"both": lambda t, q, u: q}}),
    ("must be a function", {"outputs": {"one": 1.0}}, TypeError),
    ("must be a mapping", {"outputs": [1]}, TypeError),
]  # fmt: skip


def test_what_is_wrong_is_said():
    for says, options, *kind in WRONG:
        with pytest.raises(kind[0] if kind else ValueError, match=says):
            mechanism(**({"mass": [1, 1], "forces": [0, -G], **PENDULUM} | options))


def test_masses_that_the_constraints_make_positive():
    """Massless coordinates may follow others, and entries of a symmetric matrix may differ by rounding."""
    mechanism([-0.5, 1], [0, -G], on_a_line, q0=[1, 0], u0=[0, 0])
    mechanism([1, 0], [0, -G], lambda t, q: [q[0] - q[1]], q0=[1, 1], u0=[0.5, 0.5])
    mechanism([1e3, 1e-3, 0], [0, -G, 0], lambda t, q: [q[1] - q[2]], q0=[1, 1, 1], u0=[0.5, 0.5, 0.5])
    mechanism([[1.0, 0.1 * 3], [0.3, 1.0]], [0, -G], q0=[1, 0], u0=[0, 0])


def test_no_step_ends_next_to_a_singular_position():
    problem = examples.n_four_bar(1, t_end=3.0)
    (kept,) = problem.constraints
    functions = [getattr(item, "py_func", item) for item in (kept.function, kept.gradient)]
    kept = Invariant(*functions, target=kept.target, size=kept.size, in_place=True, name="constraints")
    given = {"invariants": kept, "blocks": problem.blocks, "method": EIPDOP853, "save_every": 1}
    found = integrate(problem.motion_at, problem.t_span, problem.y0, rtol=3e-11, atol=3e-11, **given)
    assert found.trusted
    assert found.diagnostics.n_rejected_projections == 0
    assert found.nfev < 1500
    np.testing.assert_allclose(found.y[:, -1], problem.reference(3.0), atol=1e-7)
    assert np.count_nonzero(np.diff(np.sign(found.y[1]))) == 3
    assert np.abs(found.y[1]).min() > 3e-3  # nearer, steps would become as short as 1e-8


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("make", "tolerance", "end", "error"),
    [
        (examples.knife_edge, 1e-9, lambda problem: problem.reference(10.0), 1e-7),
        (examples.andrews, 1e-11, lambda problem: examples.END, {"rtol": 1e-8}),
        (examples.car_axis, 1e-12, lambda problem: examples.CAR_END, {"rtol": 1e-8}),
        (lambda: examples.disc(False), 1e-10, lambda problem: problem.reference(5.0), 1e-6),
        (lambda: examples.disc(True), 1e-10, lambda problem: problem.reference(5.0), 1e-6),
    ],
)
def test_known_motions(make, tolerance, end, error):
    problem = make()
    found, expected = run(problem, tolerance), end(problem)
    assert found.trusted
    options = error if isinstance(error, dict) else {"rtol": 0, "atol": error}
    np.testing.assert_allclose(found.y[: len(expected), -1], expected, **options)


@pytest.mark.nightly
def test_bricards_mechanism_has_redundant_constraints():
    problem = examples.bricard()
    assert "24 on velocities of rank 23, 1 degree of freedom" in repr(problem)
    found = run(problem, 1e-8)
    assert found.trusted
    np.testing.assert_allclose(found.y[6:9, -1], [1, -1.00027, 0.99973], atol=5e-6)  # as published
    assert np.abs(found.invariants[-1] + 29.43).max() < 1e-9
    assert run(problem, 1e-8, t_span=(4.0, 5.0), y0=run(problem, 1e-8, t_span=(0, 4)).y[:, -1]).trusted
    states = [run(examples.bricard(0.0, axes, 1.0), 1e-8).y[:12, -1] for axes in (True, False)]
    np.testing.assert_allclose(*states, atol=1e-6)  # in other coordinates
