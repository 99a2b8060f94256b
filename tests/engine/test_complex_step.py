"""The engine's complex steps: gradients of functions in Python, and what such functions may return."""

import numpy as np
import pytest

from eip_scipy.engine.native import BUILD

complex_step = BUILD.gradients.complex_step
Y = np.array([0.3, -0.4, 1.2])
STEP = 1e-100


def product(t, y, *args):
    return t * y[0] ** 3 * y[1] * sum(args, start=1.0)


GRADIENT = 2.0 * np.array([3 * Y[0] ** 2 * Y[1], Y[0] ** 3, 0.0])
KINDS = [
    product,
    lambda t, y: complex(product(t, y)),
    lambda t, y: np.array(product(t, y)),
    lambda t, y: np.complex64(0) + product(t, y),
    lambda t, y: np.clongdouble(product(t, y)),
]


def test_numbers():
    for kind in KINDS:
        G = complex_step(kind, 2.0, Y, (), STEP)
        assert (G.dtype, G.shape) == (float, (3,))
        np.testing.assert_allclose(G, GRADIENT, rtol=4e-16)


def test_several_values_and_further_arguments():
    for kind in (np.array, list, tuple):
        G = complex_step(lambda t, y, a, b: kind([product(t, y, a), b * product(t, y)]), 2.0, Y, (4.0, 3), STEP)  # noqa: B023
        np.testing.assert_allclose(G, [5 * GRADIENT, 3 * GRADIENT], rtol=4e-16)
        assert G.flags.c_contiguous


def test_what_cannot_be_taken():
    shapes = iter([np.zeros(2), np.zeros(3), np.zeros(2)])
    for fun in (lambda t, y: next(shapes), lambda t, y: np.zeros(2) if y[0].imag else 1j):
        with pytest.raises(ValueError, match="values of different shapes"):
            complex_step(fun, 0.0, Y, (), STEP)
    with pytest.raises(TypeError, match="returned None, expected numbers"):
        complex_step(lambda t, y: None, 0.0, Y, (), STEP)
    with pytest.raises(ZeroDivisionError):
        complex_step(lambda t, y: 1 / 0, 0.0, Y, (), STEP)
    for y in ([0.3], Y.astype(complex), Y.astype(np.float32), Y[::2], np.zeros((2, 2)), None):
        with pytest.raises((TypeError, ValueError), match=r"engine: y is .*expected|incompatible"):
            complex_step(product, 0.0, y, (), STEP)
    with pytest.raises(ValueError, match="one number or more"):
        complex_step(product, 0.0, np.empty(0), (), STEP)
