"""Energies of mechanisms: potential_energy=, power=, and those of models of SymPy."""

import numpy as np
import pytest
import sympy
from numba import njit
from sympy.physics import mechanics as me

from eip_scipy import EIPDOP853, EIPRK4, Balance, integrate
from eip_scipy.problems import mechanics, mechanism

k, l, m, g = sympy.symbols("k l m g", positive=True)  # noqa: E741
G = 9.81


def rod(t, q):
    return [q[0] ** 2 + q[1] ** 2 - 1]


def height(t, q):
    return G * q[1]


DRAG = lambda c: lambda t, q, u: np.array([0, -G]) - c * u  # noqa: E731
TURNING = {"constraints": lambda t, q: [q[0] * np.sin(2 * t) - q[1] * np.cos(2 * t)], "q0": [1, 0], "u0": [0, 2]}
PENDULUM = {"constraints": rod, "q0": [1, 0], "u0": [0, 0]}
FORCED = {"q0": [0], "u0": [0], "potential_energy": lambda t, q: q[0] ** 2 / 2}


@pytest.mark.parametrize(
    ("mass", "forces", "options", "kept"),
    [
        ([1, 1], [0, -G], PENDULUM, "not known; give energy= or potential_energy="),
        ([1, 1], [0, -G], PENDULUM | {"potential_energy": height}, "invariant, u M u / 2 + potential_energy"),
        ([1, 1], [0, -G], PENDULUM | {"energy": lambda t, q, u: u @ u / 2 + G * q[1]}, "invariant, energy"),
        ([1, 1], DRAG(1e-3), PENDULUM | {"potential_energy": height}, "balance, u M u / 2 + potential_energy"),
        ([1, 1], DRAG(5.0), PENDULUM | {"potential_energy": height}, "not kept"),
        # The force is 0 at the start, at which the system is in equilibrium.
        ([1], lambda t, q, u: [np.sin(t) - q[0]], FORCED, "not kept"),
        ([1], lambda t, q, u: [-q[0]], FORCED, "invariant"),
        # On a rod that turns at the rate 2, E - 2 L is kept, and E is not.
        ([1, 1], [0, 0], TURNING | {"energy": lambda t, q, u: u @ u / 2}, "not kept"),
        (
            [1, 1],
            [0, 0],
            TURNING | {"energy": lambda t, q, u: u @ u / 2 - 2 * (q[0] * u[1] - q[1] * u[0])},
            "invariant",
        ),
    ],
)
def test_energies_are_kept_if_they_are_constant_or_slow(mass, forces, options, kept):
    problem = mechanism(mass, forces, **options)
    assert problem.energy_kept.startswith(kept)
    assert (problem.energy is None) is kept.startswith("not")
    assert isinstance(problem.energy, Balance) is kept.startswith("balance")


@pytest.mark.needs_jit
def test_a_given_power_is_that_of_the_energy():
    options = {"potential_energy": height, **PENDULUM}
    for jit in (lambda f: f, njit):
        power = jit(lambda t, q, u: -1e-3 * (u[0] * u[0] + u[1] * u[1]))
        forces = jit(lambda t, q, u: np.array([-1e-3 * u[0], -G - 1e-3 * u[1]]))
        given = {name: jit(item) if callable(item) else item for name, item in options.items()}
        problem = mechanism([1, 1], forces, power=power, **given)
        assert problem.energy.rate_function is not None
        assert (problem.notes == ()) is (jit is njit)
    with pytest.raises(ValueError, match="Correct power or the energy"):
        mechanism([1, 1], DRAG(1e-3), power=lambda t, q, u: -2e-3 * u @ u, **options)


def test_plain_functions_are_called_with_the_values_that_their_coefficients_have():
    stiffness = np.array([1.0])
    problem = mechanism([1.0], lambda t, q, u: [-stiffness[0] * q[0]], q0=[1.0], u0=[0], t_span=(0, 3))
    integrate(problem, method=EIPRK4, h=0.01)
    stiffness[0] = 4.0
    assert integrate(problem, method=EIPDOP853, h=0.05).y[0, -1] == pytest.approx(np.cos(6.0), abs=1e-10)


def test_springs_of_a_model_belong_to_its_energy():
    q1, q2, u1, u2 = me.dynamicsymbols("q1 q2 u1 u2")
    N, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(N, 0)
    A = N.orientnew("A", "Axis", [q1, N.z])
    A.set_ang_vel(N, u1 * N.z)
    P, Q = origin.locatenew("P", A.x), origin.locatenew("Q", q2 * N.x + 2 * N.y)
    P.v2pt_theory(origin, N, A)
    Q.set_vel(N, u2 * N.x)
    loads = [*me.LinearSpring(k, me.LinearPathway(P, Q), l).to_loads(), (P, -m * g * N.y)]
    model = me.KanesMethod(N, [q1, q2], [u1, u2], kd_eqs=[q1.diff() - u1, q2.diff() - u2])
    model.kanes_equations([me.Particle("A", P, m), me.Particle("B", Q, m)], loads)
    start = {k: 5, l: 1, m: 1, g: 9.81}, [0.3, 0.2], [0, 1]
    assert mechanics(model, *start).energy_kept.startswith("not kept")
    spring = k * (me.LinearPathway(P, Q).length - l) ** 2 / 2
    problem = mechanics(model, *start, potential_energy=spring)
    assert problem.energy_kept.startswith(
        "invariant, kinetic energy of the bodies and potential of constant loads and pot"
    )

    place = origin.locatenew("R", q1 * N.x + q2 * N.y)
    place.set_vel(N, q1.diff() * N.x + q2.diff() * N.y)
    forces = [(place, -k * q1 * N.x - m * g * N.y)]
    model = me.LagrangesMethod(m * (q1.diff() ** 2 + q2.diff() ** 2) / 2, [q1, q2], forcelist=forces, frame=N)
    potential = k * q1**2 / 2 + m * g * q2
    problem = mechanics(model, {k: 5, m: 1, g: 9.81}, [0.3, 0.2], [0, 1], potential_energy=potential)
    assert problem.energy_kept == "invariant, of the Lagrangian and potential_energy="


@pytest.mark.parametrize(
    ("potential", "force"),
    [
        (lambda q: sympy.Abs(q) ** sympy.Rational(5, 2), lambda q: -2.5 * abs(q) ** 1.5 * np.sign(q)),
        (lambda q: sympy.Heaviside(q - 1) * (q - 1) ** 2, lambda q: -2 * max(q - 1, 0)),
        (lambda q: sympy.Piecewise(((q - 1) ** 2, q > 1), (0, True)), lambda q: -2 * max(q - 1, 0)),
    ],
)
@pytest.mark.parametrize("real", [None, True])
def test_a_lagrangian_has_branches(potential, force, real):
    q = me.dynamicsymbols("q", real=real)
    problem = mechanics(me.LagrangesMethod(q.diff() ** 2 / 2 - potential(q), [q]), {}, [1.5], [1])
    assert problem.energy_kept == "invariant, of the Lagrangian"
    for place in (-1.3, 0.4, 2.5):
        np.testing.assert_allclose(problem.motion_at(0.0, np.array([place, 1.0])), [1.0, force(place)], rtol=1e-14)


def test_a_jump_of_a_lagrangian_is_named_in_the_symbols_of_the_user():
    q = me.dynamicsymbols("q")
    with pytest.raises(ValueError, match="a function that jumps where q - 1 is 0"):
        mechanics(me.LagrangesMethod(q.diff() ** 2 / 2 - sympy.Heaviside(q - 1) * q, [q]), {}, [0.5], [1])


def test_an_energy_is_examined_away_from_singular_positions():
    # A parallelogram, from whose neighbourhood Newton's method may end in its flat position.
    q1, q2, q3 = me.dynamicsymbols("q1:4")
    angles = q1, q1 + q2, q1 + q2 + q3
    ends = [(sympy.cos(angle), sympy.sin(angle)) for angle in angles]
    across, up = (sympy.Add(*(end[j] for end in ends)) for j in range(2))
    speeds = [(ends[0][j] + ends[1][j] * n / 2).diff() for n in range(2) for j in range(2)]
    lagrangian = sympy.Add(*(v**2 for v in speeds)) / 2 - 9.81 * (ends[0][1] + (ends[0][1] + ends[1][1] / 2))
    model = me.LagrangesMethod(lagrangian + q3.diff() ** 2 / 20, [q1, q2, q3], hol_coneqs=[across - 1, up])
    problem = mechanics(model, {}, [1, 1.5, 1.5], [1, 0, 0], independent=["q1", "v_q1"])
    assert problem.energy_kept == "invariant, of the Lagrangian"
