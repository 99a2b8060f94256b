"""The first look at invariants, in C++, lets nothing pass that the examination in Python objects to."""

import numpy as np
import pytest
from systems import oscillator

from eip_scipy import Invariant
from eip_scipy.core.derivatives import random_directions
from eip_scipy.core.invariant_checks import findings
from eip_scipy.core.invariant_set import InvariantSet

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
            known = InvariantSet(item, t, y, f, TAU, t_bound=t + 5.0)
            at = t, y, f, known.gradients(t, y, f), known.values(t, y), TAU, known.t_span, random_directions(2, False)
            in_order.append(known.functions.is_in_order(*at))
            known.functions = Unsure(known.functions)
            found.append(bool(findings(known, t, y, f, TAU, fun)))
    assert all(in_order[:3])
    assert not any(found[:3])
    assert any(found)
    assert not np.any(np.array(in_order) & np.array(found))


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
