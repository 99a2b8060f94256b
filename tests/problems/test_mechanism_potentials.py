"""Potentials that are integrated from conservative forces."""

import numpy as np
import pytest
import sympy
from sympy.physics import mechanics as me

from eip_scipy import Balance
from eip_scipy.problems import mechanics, mechanism
from eip_scipy.problems.symbolic.constrained import potential_of

x, y, a, b = sympy.symbols("x y a b", real=True)
k, l, m, g = sympy.symbols("k l m g", positive=True)  # noqa: E741
TRIANGLE = (sympy.cos(a) + sympy.cos(a + b) - 1) ** 2 + (sympy.sin(a) + sympy.sin(a + b)) ** 2


@pytest.mark.parametrize(
    ("potential", "coordinates"),
    [
        (k * x**2 / 2 + m * g * y, [x, y]),
        (k * (sympy.sqrt(x**2 + y**2) - l) ** 2 / 2, [x, y]),
        (k * (sympy.sqrt((x + l * sympy.cos(a)) ** 2 + (y + l * sympy.sin(a)) ** 2) - l) ** 2 / 2, [x, y, a]),
        (k * (sympy.sqrt(TRIANGLE) - l) ** 2 / 2, [a, b]),
        (m * g * (sympy.cos(a) + sympy.cos(a + b)) + k * b**2 / 2, [a, b]),
        (-k / x + sympy.exp(-y), [x, y]),
        (-k / sympy.sqrt(x**2 + (y - 1) ** 2), [x, y]),
    ],
)
def test_forces_have_the_potential_that_they_come_from(potential, coordinates):
    forces = [-sympy.diff(potential, q) for q in coordinates]
    found = potential_of(forces, coordinates)
    place = {x: 0.7, y: 0.4, a: 0.3, b: 1.1, k: 1.3, l: 0.9, m: 0.6, g: 9.81}
    for q, force in zip(coordinates, forces, strict=True):
        assert float((sympy.diff(found, q) + force).subs(place)) == pytest.approx(0, abs=1e-14)


def test_there_is_none_of_what_cannot_be_integrated():
    assert potential_of([sympy.sin(x * sympy.cos(x))], [x]) is None
    assert potential_of([sympy.Add(*(sympy.cos(n * x) * x**n for n in range(200)))], [x]) is None
    assert potential_of([sympy.Piecewise((1 - x, x > 1), (0, True))], [x]) is None


def test_the_energy_of_a_mechanism_needs_no_potential():
    rod = lambda t, q: [q[0] ** 2 + q[1] ** 2 - 1]  # noqa: E731
    start = {"q0": [1, 0], "u0": [0, 0]}
    hanging = mechanism([1, 1], [0, -9.81], rod, **start)
    assert hanging.energy_kept == "invariant, u M u / 2 + the potential of the forces"
    assert hanging.energy.function.py_func(0.0, np.array([0.6, -0.8, 3, 4])) == pytest.approx(12.5 - 0.8 * 9.81)
    damped = mechanism([1, 1], lambda t, q, u: -1e-3 * u - [q[0], 9.81 - np.sin(t) / 100], rod, **start)
    assert isinstance(damped.energy, Balance)
    assert "not kept" in mechanism([1, 1], lambda t, q, u: [-q[1], q[0]], q0=[1, 0], u0=[0, 1]).energy_kept


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
    problem = mechanics(model, {k: 5, l: 1, m: 1, g: 9.81}, [0.3, 0.2], [0, 1])
    assert problem.energy_kept.startswith("invariant, kinetic and potential energy of the bodies and potential of the")

    place = origin.locatenew("R", q1 * N.x + q2 * N.y)
    place.set_vel(N, q1.diff() * N.x + q2.diff() * N.y)
    forces = [(place, -k * q1 * N.x - m * g * N.y)]
    model = me.LagrangesMethod(m * (q1.diff() ** 2 + q2.diff() ** 2) / 2, [q1, q2], forcelist=forces, frame=N)
    problem = mechanics(model, {k: 5, m: 1, g: 9.81}, [0.3, 0.2], [0, 1])
    assert problem.energy_kept == "invariant, of the Lagrangian and potential of the loads"


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
