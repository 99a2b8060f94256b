"""The first look at invariants, in C++, lets nothing pass that the examination in Python objects to."""

import numpy as np
import pytest
from systems import oscillator

from eip_scipy import Invariant
from eip_scipy.core.gradients import random_directions
from eip_scipy.core.invariant_checks import complaints
from eip_scipy.core.invariants import InvariantSet, with_args
from eip_scipy.engine.data import N_FIGURES
from eip_scipy.problems import kepler

SIZES = [0.0, *10.0 ** np.arange(-13.0, 0.5, 0.5)]
TAU = 0.1
ENERGY = Invariant(lambda t, y: 0.5 * (y @ y), lambda t, y: y)


def with_friction(size):
    return ENERGY, lambda t, y: np.array([y[1], -y[0] - size * y[1]])


def with_wrong_gradient(size):
    return Invariant(ENERGY.fun, lambda t, y: np.array([1.0, 1.0 + size]) * y), oscillator


def with_time(size):
    return Invariant(lambda t, y: 0.5 * (y @ y) + size * np.sin(t), ENERGY.grad), oscillator


def with_few_digits(size):
    def value(t, y):
        exact = 0.5 * (y @ y)
        return float(np.float32(exact)) if size > 1e-7 else exact * (1 + size * np.sign(np.sin(1e9 * exact)))

    return Invariant(value, ENERGY.grad), oscillator


def with_single_derivative(size):
    kind = np.float32 if size > 0 else float
    return ENERGY, lambda t, y: oscillator(t, y).astype(kind).astype(float)


CASES = [with_friction, with_wrong_gradient, with_time, with_few_digits, with_single_derivative]


class Unsure:
    """Functions of invariants that are never found in order."""

    def __init__(self, functions):
        self._functions = functions

    def __getattr__(self, name):
        return getattr(self._functions, name)

    def is_in_order(self, *args):
        return False


@pytest.mark.parametrize("case", CASES)
def test_what_is_found_in_order_passes_the_examination(case):
    rng = np.random.default_rng(5)
    in_order, found = [], []
    for size in SIZES:
        item, fun = case(size)
        for scale in (1e-3, 1.0, 1e4):
            t, y = rng.uniform(0, 10), scale * rng.standard_normal(2)
            f = fun(t, y)
            known = InvariantSet(item, t, y, f, TAU, t_bound=t + 5.0, rhs=fun)
            at = t, y, f, known.gradients(t, y, f), known.values(t, y), TAU, known.t_span, random_directions(2, False)
            in_order.append(known.functions.is_in_order(*at))
            known.functions = Unsure(known.functions)
            found.append(bool(list(complaints(known, t, y, f, TAU, fun))))
    assert all(in_order[:3])
    assert not any(found[:3])
    assert any(found)
    assert not np.any(np.array(in_order) & np.array(found))


@pytest.mark.parametrize("case", CASES)
def test_a_look_notes_rates_and_looks(case):
    rng = np.random.default_rng(6)
    for size in SIZES[::6]:
        item, fun = case(size)
        t, y = rng.uniform(0, 10), rng.standard_normal(2)
        f = fun(t, y)
        known = InvariantSet(item, t, y, f, TAU, t_bound=t - 5.0, rhs=fun)
        G, here, directions = known.gradients(t, y, f), known.values(t, y), random_directions(2, False)
        looked, noted = np.zeros((2, 1, N_FIGURES))
        known.note_rates(noted, t, y, f, G, here)
        of_run = known.target, known.scales, TAU, known.t_span, directions
        found = known.functions.look(looked, t, y, f, *of_run)
        assert found == known.functions.is_in_order(t, y, f, G, here, TAU, known.t_span, directions)
        assert np.array_equal(looked, noted)
        assert known.functions.look(looked, t, y, np.array([np.nan, 1.0]), *of_run)
        assert np.array_equal(looked, noted)


def with_own(item, params):
    """Return an invariant of functions of the library that contain their parameters."""
    own = item.function.bound(params), item.gradient.bound(params)
    return Invariant(*own, in_place=True, uses_f=item.uses_f)


@pytest.mark.parametrize("changed", [with_own, lambda item, params: with_args(item, (params,))], ids=["own", "args"])
def test_functions_of_the_library_have_their_bits(changed):
    """Python does not call them then."""
    problem, y, f = kepler(), np.array([0.7, -0.2, 0.3, 1.1]), np.ones(4)
    params = 1.5 * problem.params
    known = InvariantSet([changed(item, params) for item in problem.invariants], 0.0, y, f, TAU)
    assert np.array_equal(known.values(0.3, y), [item.function(0.3, y, params) for item in problem.invariants])
    rows = np.empty((len(problem.invariants), 4))
    for item, row in zip(problem.invariants, rows, strict=True):
        item.gradient(0.3, y, *([f] if item.uses_f else []), row, params)
    assert np.array_equal(known.gradients(0.3, y, f), rows)


def test_rates_by_values_next_to_a_kink():
    """NaN where the slopes to both sides differ by more than the rate, else the rate, and 0 for what is rounding."""
    items = [
        Invariant(lambda t, y: abs(y[0] - 1.0) + y[1], lambda t, y: [1.0, 1.0]),
        Invariant(lambda t, y: y[0] ** 2, lambda t, y: [2 * y[0], 0.0]),
        Invariant(lambda t, y: y @ y, lambda t, y: 2 * y),
    ]
    y, f = np.array([1.0, 0.0]), np.array([0.5, 0.25])
    known = InvariantSet(items, 0.0, y, f, TAU)
    at = known.gradients(0.0, y, f), known.values(0.0, y), known.target, known.scales
    np.testing.assert_allclose(known.functions.rates_by_values(0.0, y, f, *at), [np.nan, 1.0, 1.0], rtol=1e-7)
    across = np.array([0.0, 0.25])
    np.testing.assert_allclose(known.functions.rates_by_values(0.0, y, across, *at), [0.25, 0.0, np.nan], rtol=1e-7)


def test_functions_are_not_called_with_states_of_another_kind():
    known = InvariantSet(ENERGY, 0.0, np.ones(2), np.ones(2), TAU)
    with pytest.raises(ValueError, match="y has another dtype or size"):
        known.values(0.0, np.ones(3))
    with pytest.raises(ValueError, match="y has another dtype or size"):
        known.values(0.0, np.ones(2, complex))
