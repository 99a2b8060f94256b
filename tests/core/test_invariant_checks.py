"""Gradients that are not given, and the checks of invariants: detected faults, and correct runs without reports."""

import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import PENDULUM_ENERGY, SQUARE, oscillator, pendulum
from systems import pendulum_energy as energy
from systems import pendulum_gradient as energy_gradient

from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, EIPRKN12, Invariant, ensemble, integrate, project, recommend
from eip_scipy.problems import Problem

NO_COMPLEX_STEP = "has no grad and allows no complex step"


def said(call):
    """Return the result of a call, or its error, and the texts of its warnings."""
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        result = call()
    return result, [str(item.message) for item in record]


# A function represents its invariant.


def test_a_function_stands_for_its_invariant_everywhere():
    given, fixed = SQUARE.fun, {"method": EIPRK4, "h": 0.1}
    span, y0 = (0, 1), [1.0, 0.0]
    wanted = integrate(oscillator, span, y0, invariants=Invariant(given), **fixed).y[:, -1]
    problem = Problem("two", oscillator, np.array(y0), span, invariants=given)
    for run in (
        integrate(oscillator, span, y0, invariants=given, **fixed),
        integrate(oscillator, span, y0, invariants=[given], **fixed),
        solve_ivp(oscillator, span, y0, invariants=given, **fixed),
        integrate(problem, **fixed),
    ):
        np.testing.assert_array_equal(run.y[:, -1], wanted)
    np.testing.assert_array_equal(ensemble(oscillator, span, [y0], invariants=given, **fixed).y[0], wanted)
    assert recommend(oscillator, span, y0, invariants=given).options["invariants"]
    assert project([0.6, 0.81], given, target=[1.0], iterations=5).residual == pytest.approx(0, abs=1e-15)

    def scaled(t, y, k):
        return k * (y @ y)

    run = integrate(lambda t, y, k: k * oscillator(t, y), span, y0, args=(2.0,), invariants=[scaled], **fixed)
    assert run.diagnostics.names == ("scaled",)
    np.testing.assert_allclose(run.invariants, 2.0, rtol=1e-12)  # the run's own arguments come last


def wall(t, y):
    beyond = np.maximum(abs(y[0]) - 1, 0)
    return np.array([y[1], -y[0] - 150 * beyond**2 * np.sign(y[0])])


WALLS = {
    "abs": lambda x: np.maximum(np.abs(x) - 1, 0),
    "norm": lambda x: np.maximum(np.linalg.norm(np.array([x])) - 1, 0),
    "real": lambda x: max(x.real - 1, 0) + max(-x.real - 1, 0),
}


@pytest.mark.parametrize("kind", WALLS)
def test_a_complex_step_that_is_wrong_later_is_replaced_there(kind):
    """A soft wall that is not felt at the start: beyond it, a complex step sees no slope of abs, norm or real part."""

    def wall_energy(t, y):
        return 0.5 * y[1] ** 2 + 0.5 * y[0] ** 2 + 50 * WALLS[kind](y[0]) ** 3

    options = {"method": EIPRK45, "rtol": 1e-6, "save_every": 1}
    run, texts = said(lambda: integrate(wall, (0, 20), [0.5, 2.0], invariants=wall_energy, **options))
    assert (texts, run.trusted) == ([], True)
    assert np.abs(run.y[0]).max() > 1.2
    given = Invariant(wall_energy, lambda t, y: np.array([-wall(t, y)[1], y[1]]))
    by_hand = integrate(wall, (0, 20), [0.5, 2.0], invariants=given, **options)
    np.testing.assert_allclose(run.y, by_hand.y, rtol=0, atol=1e-9)


@pytest.mark.filterwarnings(f"ignore:.*{NO_COMPLEX_STEP}")
@pytest.mark.parametrize("number", [np.asarray, lambda y: np.array(y, float)], ids=["complex", "real"])
def test_a_computed_gradient_close_to_a_singularity(number):
    """A body on a circle about a mass at (1, 1): shifts of 5e-3 of a component's size reach far beyond that mass."""

    def pull(t, y):
        r = y[:2] - 1.0
        return np.concatenate([y[2:], -r / (r @ r) ** 1.5])

    def kept(t, y):
        x, y, u, v = number(y)
        return 0.5 * (u**2 + v**2) - ((x - 1) ** 2 + (y - 1) ** 2) ** -0.5

    for distance in (3e-4, 3e-5, 3e-6):
        turn, y0 = 2 * np.pi * distance**1.5, np.array([1.0 + distance, 1.0, 0.0, distance**-0.5])
        run = integrate(pull, (0, turn / 4), y0, method=EIPDOP853, rtol=1e-9, atol=1e-14, invariants=kept)
        assert run.trusted
        np.testing.assert_allclose(run.y[:2, -1], [1.0, 1.0 + distance], rtol=0, atol=1e-6 * distance)


class RefusedError(Exception):
    """Error of a library that does not accept complex numbers."""


@pytest.mark.parametrize("error", [RuntimeError, AssertionError, KeyError, RefusedError])
def test_functions_that_refuse_complex_numbers(error):
    """At the start they are reported; later, differences take over silently."""

    def refuses(t, y):
        if np.iscomplexobj(y) and (t == 0 or y[0].real < 0):
            raise error("no complex numbers")
        return energy(t, y)

    options = {"method": EIPRK4, "h": 0.05, "save_every": 20}
    late = lambda t, y: refuses(max(t, 1.0), y)  # noqa: E731
    wanted = integrate(pendulum, (0, 5), [1.0, 0.3], invariants=PENDULUM_ENERGY, **options)
    longer = lambda t, y: np.append(pendulum(t, y[:2]), 0.0)  # noqa: E731 # whose components are not those of a gradient
    for kept, count in ((refuses, 1), (late, 0)):
        run, texts = said(lambda kept=kept: integrate(longer, (0, 5), [1.0, 0.3, 0.0], invariants=kept, **options))
        assert [NO_COMPLEX_STEP in text for text in texts] == [True] * count
        assert run.trusted
        np.testing.assert_allclose(run.y[:2], wanted.y, rtol=0, atol=1e-11)


def test_a_gradient_that_was_not_given_is_not_blamed():
    """A function of few digits: its differences are noise, and no gradient was given that could be wrong."""
    rounded = Invariant(lambda t, y: round(float(y @ y), 7), name="S")
    run, texts = said(lambda: integrate(oscillator, (0, 1), [1.0, 0.3], method=EIPRK4, h=0.1, invariants=rounded))
    assert not any("is wrong" in text or "by grad" in text for text in (*texts, run.message))
    assert any("computed from its values, is not accurate" in text for text in texts)


# Single precision.


def in_single(fun):
    return lambda t, y: np.asarray(fun(t, np.asarray(y, np.float32)), np.float32)


class Tensor:
    """A tensor of PyTorch, as far as it matters here."""

    dtype = "torch.float32"

    def __init__(self, values):
        self._values = np.float32(values)

    def __array__(self, dtype=None, copy=None):
        return np.array(self._values, dtype)


SINGLE = {
    "value": (pendulum, Invariant(in_single(energy), energy_gradient, name="E")),
    "gradient": (pendulum, Invariant(energy, lambda t, y: np.float32(energy_gradient(t, y)), name="E")),
    "field": (in_single(pendulum), Invariant(energy, energy_gradient, name="E")),
    # The rate of change is smaller than what differences of values show.
    "field, with a computed gradient": (in_single(pendulum), Invariant(energy, name="E")),
    "tensor": (lambda t, y: Tensor(pendulum(t, y)), Invariant(energy, energy_gradient, name="E")),
    "list": (lambda t, y: list(in_single(pendulum)(t, y)), Invariant(energy, energy_gradient, name="E")),
}


@pytest.mark.parametrize("kind", SINGLE)
def test_single_precision_is_named(kind):
    fun, kept = SINGLE[kind]
    options = {"method": EIPRK4, "h": 0.05, "invariants": kept}
    if kind.startswith("value"):
        with pytest.raises(
            ValueError, match=r"'E' returned .* single precision \(float32\).*jax_enable_x64.*torch.float64"
        ):
            integrate(fun, (0, 5), [1.0, 0.3], **options)
        return
    run, texts = said(lambda: integrate(fun, (0, 5), [1.0, 0.3], **options))
    assert all("single precision (float32)" in text and "no invariant" not in text for text in texts)
    assert "single precision (float32)" in run.message


@pytest.mark.parametrize("grad", [None, lambda t, y: y])
@pytest.mark.parametrize(("method", "step"), [(EIPRK4, {"h": 0.05}), (EIPDOP853, {"rtol": 1e-9})])
def test_a_field_in_single_precision_is_named_from_every_start(method, step, grad):
    """The field is named even if a rate of change is 0 by chance."""
    kept = Invariant(lambda t, y: 0.5 * (y[0] ** 2 + y[1] ** 2), grad, name="E")
    for y0 in ([1.0, 0.2], [1.0, 0.0], [0.3, 0.7], [0.25, 0.5]):
        run, _ = said(lambda: integrate(in_single(oscillator), (0, 10), y0, method=method, invariants=kept, **step))  # noqa: B023
        assert "fun returned numbers of single precision (float32), which hides whether" in run.message


def test_a_constant_in_single_precision_is_no_field_in_single_precision():
    g = float(np.float32(9.81))
    kept = Invariant(lambda t, y: 0.5 * y[1] ** 2 + g * y[0], name="E")
    run, texts = said(
        lambda: integrate(lambda t, y: np.array([y[1], -g]), (0, 1), [0.1, 2.0], method=EIPRK4, h=0.05, invariants=kept)
    )
    assert run.trusted
    assert not texts


@pytest.mark.parametrize("end", [5.0, 20.0, 40.0])
def test_next_to_an_equilibrium_few_digits_are_no_single_precision(end):
    """Brockett's flow sorts the eigenvalues of a matrix; at the end only rounding remains of its derivative."""
    L0, N = np.random.default_rng(0).normal(size=(5, 5)), np.diag(np.arange(5.0))
    rows, columns = np.triu_indices(5)

    def matrix(y):
        L = np.zeros((5, 5))
        L[rows, columns] = L[columns, rows] = y
        return L

    def fun(t, y):
        L = matrix(y)
        bracket = L @ N - N @ L
        return (L @ bracket - bracket @ L)[rows, columns]

    once = np.where(rows == columns, 1.0, 2.0)  # number of times that an entry occurs in the matrix
    traces = Invariant(
        lambda t, y: np.array([np.trace(matrix(y)), np.trace(matrix(y) @ matrix(y))]),
        lambda t, y: np.array([rows == columns, 2 * once * y], float),
    )
    for method in (EIPRK45, EIPDOP853):
        given = {"y0": (L0 + L0.T)[rows, columns], "method": method, "invariants": traces, "rtol": 1e-9}
        run, texts = said(lambda given=given: integrate(fun, (0, end), **given))
        assert (texts, run.trusted) == ([], True), run.message


def test_single_precision_explains_no_friction():
    friction = in_single(lambda t, y: pendulum(t, y) - np.array([0.0, 0.1 * y[1]], np.float32))
    _, texts = said(lambda: integrate(friction, (0, 5), [1.0, 0.3], method=EIPRK4, h=0.05, invariants=PENDULUM_ENERGY))
    assert "'energy' is not an invariant of this system" in texts[0]


@pytest.mark.parametrize("span", [(0.0, 1.0), (1.0, 0.0), (2.0, 2.0), (5.0, 5.001), (0.0, 1e-9)])
def test_no_function_is_called_outside_the_interval(span):
    """Tables end where the run does."""
    low, high = min(span), max(span)

    def table(t):
        assert low <= t <= high
        return np.cos(t)

    def driven(t, y):  # the last component is the work of the force
        return np.array([y[1], table(t) - y[0], -y[0] * np.sin(t)])

    work = Invariant(lambda t, y: 0.5 * y[1] ** 2 + 0.5 * y[0] ** 2 - y[0] * table(t) + y[2])
    watched = Invariant(lambda t, y: y @ y + 0 * table(t))  # an autonomous one that looks at the table
    runs = [
        (driven, [1.0, 0.0, 0.0], {"method": EIPRK4, "h": max((high - low) / 10, 1e-12), "invariants": work}),
        (driven, [1.0, 0.0, 0.0], {"method": EIPDOP853, "rtol": 1e-8, "atol": 1e-10, "invariants": work}),
        (lambda t, y: oscillator(t, y) + 0 * table(t), [1.0, 0.0], {"method": EIPRKN12, "invariants": watched}),
    ]
    for fun, y0, options in runs:
        run, texts = said(lambda: integrate(fun, span, y0, **options))  # noqa: B023
        assert (texts, run.status) == ([], 0)


# Constraints, which hold only together.


G = 9.81


def chain(n, dim, anchors, rods):
    """Particles of mass 1 on rods, to anchors (i, place) and between pairs (i, j), under gravity along the last axis.

    Accelerations by Lagrange's multipliers of the constraints, differentiated twice; where these depend on each other,
    the least ones. Returns the right-hand side and the invariants: half the squares of the lengths, the velocities
    along the rods, and the energy.
    """
    down = np.zeros((n, dim))
    down[:, -1] = -G

    def differences(a, at_rest):
        a = a.reshape(n, dim)
        return [a[i] - a[j] for i, j in rods] + [a[i] - (0 if at_rest else place) for i, place in anchors]

    def rows(parts):
        out = np.zeros((len(parts), n, dim))
        for k, part in enumerate(parts):
            out[k, (rods[k] if k < len(rods) else anchors[k - len(rods)])[0]] = part
            if k < len(rods):
                out[k, rods[k][1]] = -part
        return out.reshape(len(parts), n * dim)

    def fun(t, y):
        q, v = np.split(y, 2)
        J, curvature = rows(differences(q, False)), np.array([d @ d for d in differences(v, True)])
        multipliers = np.linalg.lstsq(J @ J.T, J @ down.ravel() + curvature, rcond=1e-10)[0]
        return np.concatenate([v, down.ravel() - J.T @ multipliers])

    def halves(y):
        return np.split(y, 2)

    lengths = Invariant(
        lambda t, y: np.array([d @ d for d in differences(halves(y)[0], False)]) / 2,
        lambda t, y: np.hstack([J := rows(differences(halves(y)[0], False)), 0 * J]),
        name="lengths",
    )
    velocities = Invariant(
        lambda t, y: rows(differences(halves(y)[0], False)) @ halves(y)[1],
        lambda t, y: np.hstack([rows(differences(halves(y)[1], True)), rows(differences(halves(y)[0], False))]),
        name="velocities",
        target=0.0,
    )
    kept = Invariant(
        lambda t, y: 0.5 * halves(y)[1] @ halves(y)[1] - down.ravel() @ halves(y)[0],
        lambda t, y: np.concatenate([-down.ravel(), halves(y)[1]]),
        name="energy",
    )
    return fun, lengths, velocities, kept


SINGLE_PENDULUM = chain(1, 2, [(0, np.zeros(2))], [])
DOUBLE_PENDULUM = chain(2, 3, [(0, np.zeros(3))], [(0, 1)])
FOUR_BAR = chain(2, 2, [(0, np.zeros(2)), (1, np.array([1.0, 0.0]))], [(0, 1)])
AT_REST = np.zeros(6)
CONSTRAINED = {
    "pendulum, horizontal": (SINGLE_PENDULUM, [1, 0, 0, 0]),
    "pendulum, moving": (SINGLE_PENDULUM, [0.6, -0.8, 0.8, 0.6]),
    "pendulum, hanging": (SINGLE_PENDULUM, [0, -1, 0, 0]),
    "double pendulum, horizontal": (DOUBLE_PENDULUM, [1, 0, 0, 2, 0, 0, *AT_REST]),
    "double pendulum, horizontal except for rounding": (DOUBLE_PENDULUM, [1, 0, -6e-17, 2, 0, -1.2e-16, *AT_REST]),
    "double pendulum, hanging": (DOUBLE_PENDULUM, [0, 0, -1, 0, 0, -2, *AT_REST]),
    "double pendulum, pushed": (DOUBLE_PENDULUM, [0, 0, -1, 0, 0, -2, 0.5, 0, 0, 0, 0.3, 0]),
    "four-bar, upright": (FOUR_BAR, [0, 1, 1, 1, 1, 0, 1, 0]),
    "four-bar, slanted": (FOUR_BAR, [0.6, 0.8, 1.6, 0.8, 0, 0, 0, 0]),
    "four-bar, flat": (FOUR_BAR, [1, 0, 2, 0, 0, 0, 0, 0]),
}
STEPS = {"loose": (EIPRK45, {}), "tight": (EIPDOP853, {"rtol": 1e-8, "atol": 1e-8}), "fixed": (EIPRK4, {"h": 0.01})}


@pytest.mark.parametrize("name", CONSTRAINED)
def test_constraints_are_not_accused(name):
    """Positions and velocities together: terms of either vanish at rest, along the axes and where rods are flat."""
    (fun, lengths, velocities, kept), y0 = CONSTRAINED[name]
    for steps, (method, options) in STEPS.items():
        if name.startswith("four-bar") and steps == "loose":
            continue  # loose steps do not resolve the passage through the flat position
        for items in ([lengths, velocities], [lengths, velocities, kept]):
            run, texts = said(lambda: integrate(fun, (0, 2), y0, method=method, invariants=items, **options))  # noqa: B023
            assert (texts, run.trusted, run.status) == ([], True, 0)


def geodesic(t, y):
    q, v = y[:3], y[3:]
    return np.concatenate([v, -(v @ v) * q])


RADIUS = Invariant(lambda t, y: y[:3] @ y[:3], lambda t, y: np.concatenate([2 * y[:3], 0 * y[:3]]), name="|q|^2")
TANGENT = Invariant(lambda t, y: y[:3] @ y[3:], lambda t, y: np.concatenate([y[3:], y[:3]]), name="q.v")


@pytest.mark.parametrize("steps", STEPS)
def test_a_geodesic_on_the_sphere(steps):
    """|q|^2 is kept only where q.v = 0, and that only where |q| = 1: a great circle at constant speed."""
    method, options = STEPS[steps]
    options = {"method": method, "invariants": [RADIUS, TANGENT], **options}
    for y0 in ([1, 0, 0, 0, 1, 0], [0.6, 0.8, 0, -0.8, 0.6, 0.5]):
        run, texts = said(lambda: integrate(geodesic, (0, 20), y0, **options))  # noqa: B023
        assert (texts, run.trusted) == ([], True)
        q, v = np.split(np.array(y0, float), 2)
        speed = np.linalg.norm(v)
        wanted = q * np.cos(20 * speed) + v / speed * np.sin(20 * speed)
        np.testing.assert_allclose(run.y[:3, -1], wanted, rtol=0, atol=0.5 if steps == "loose" else 1e-5)


MISSING = {
    "|q|^2 alone": (geodesic, [1, 0, 0, 0, 1, 0], [RADIUS]),
    "q.v alone": (geodesic, [1, 0, 0, 0, 1, 0], [TANGENT]),
    "lengths of a double pendulum": (DOUBLE_PENDULUM[0], CONSTRAINED["double pendulum, pushed"][1], DOUBLE_PENDULUM[1]),
    "energy of a pendulum": (SINGLE_PENDULUM[0], [0.6, -0.8, 0.8, 0.6], SINGLE_PENDULUM[3]),
    "energy of a four-bar linkage": (FOUR_BAR[0], [0, 1, 1, 1, 1, 0, 1, 0], FOUR_BAR[3]),
    "all of a pendulum with friction": (
        lambda t, y: SINGLE_PENDULUM[0](t, y) - 1e-3 * np.concatenate([0 * y[2:], y[2:]]),
        [0.6, -0.8, 0.8, 0.6],
        SINGLE_PENDULUM[1:],
    ),
}


@pytest.mark.parametrize("name", MISSING)
def test_a_missing_constraint_or_friction_is_reported(name):
    fun, y0, kept = MISSING[name]
    run, texts = said(lambda: integrate(fun, (0, 10), y0, method=EIPRK4, h=0.05, invariants=kept))
    assert not run.trusted
    assert all("not an invariant of this system" in text for text in (run.message, *texts))


def test_a_start_off_a_constraint_is_reported():
    """The velocity along the rod is taken as a level where it should be 0: the length cannot be kept."""
    fun, lengths, velocities, _ = SINGLE_PENDULUM
    level = Invariant(velocities.fun, velocities.grad, name="velocities")
    y0 = [0.6, -0.8, 0.8006, 0.5992]
    _, texts = said(lambda: integrate(fun, (0, 1), y0, method=EIPRK4, h=0.05, invariants=[lengths, level]))
    assert "'lengths[0]' is not an invariant of this system" in texts[0]
    assert "add the constraint on which it depends" in texts[0]


@pytest.mark.parametrize("y0", [[0.6, -0.8, 0.8, 0.6], [0.6, -0.8, 1.6, 1.2]])
@pytest.mark.parametrize("force", [lambda t, y: -1e-3 * y[2:], lambda t, y: np.array([0.3 * np.cos(3 * t + 1), 0.0])])
def test_the_rate_of_a_constrained_system_is_the_power_of_its_force(force, y0):
    fun, _, _, kept = SINGLE_PENDULUM

    def moved(t, y):
        rod = y[:2] / (y[:2] @ y[:2])
        return fun(t, y) + np.concatenate([0 * y[2:], force(t, y) - rod * (y[:2] @ force(t, y))])

    _, texts = said(lambda: integrate(moved, (0, 1), y0, method=EIPRK4, h=0.05, invariants=kept))
    assert "not an invariant of this system" in texts[0]
    assert f"at the rate {force(0, np.array(y0)) @ y0[2:]:.3g}" in texts[0]


def test_one_warning_names_three_of_many():
    """17 components that all decay: the worst first, the others counted."""
    many = Invariant(lambda t, y: y**2, lambda t, y: 2 * np.diag(y), name="squares")
    _, texts = said(lambda: integrate(lambda t, y: -y, (0, 1), np.ones(17), method=EIPRK4, h=0.1, invariants=many))
    assert [text for text in texts if "not an invariant" in text and "13 more" in text and len(text) < 600]


# Gradients that are slightly wrong.


@pytest.mark.parametrize("error", [1e-4, 1e-5, 1e-7])
def test_a_gradient_that_is_slightly_wrong_is_named_as_the_cause(error):
    for since in (-1.0, 1.0):
        wrong = Invariant(energy, lambda t, y: energy_gradient(t, y) * [1.0 + error * (t > since), 1.0], name="H")  # noqa: B023
        run, texts = said(lambda: integrate(pendulum, (0, 5), [1.0, 0.5], method=EIPRK4, h=0.01, invariants=wrong))  # noqa: B023
        assert (run.success, run.trusted) == (True, False)
        assert texts
        for text in (run.message, *texts):
            assert "gradient of invariant 'H' is wrong" in text
            assert "not an invariant" not in text


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_correct_gradient_of_no_invariant_is_not_accused(offset):
    # With an offset the values have few digits, so that their differences do not show the change.
    def damped(t, y):
        return pendulum(t, y) - 1e-5 * np.array([0.0, y[1]])

    item = Invariant(lambda t, y: energy(t, y) + offset, energy_gradient, name="H")
    run, texts = said(lambda: integrate(damped, (0, 5), [1.0, 0.5], method=EIPRK4, h=0.01, invariants=item))
    assert not run.trusted
    assert texts
    for text in (run.message, *texts):
        assert "'H' is not an invariant of this system" in text
        assert "is wrong" not in text
