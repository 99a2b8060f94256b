"""The coefficients of Gauss-Jackson's methods, and the limits of their stability."""

import math
from fractions import Fraction

import numpy as np
import pytest

from eip_scipy import EIPGJ12, eip_method, integrate
from eip_scipy.methods import GaussJackson
from eip_scipy.methods.gauss_jackson import (
    longest_stable,
    position_series,
    position_weights,
    stability_limit,
    velocity_series,
    weights,
)

ORDERS = (4, 7, 10, 12, 14, 16)


def test_published_coefficients():
    """Coefficients agree with Henrici (1962), tables 5.1, 6.1 and 6.2, and Berry and Healy (2004)."""
    stormer = ["1/12", "1/12", "19/240", "3/40", "863/12096", "275/4032", "33953/518400", "8183/129600"]
    cowell = ["1/12", "0", "-1/240", "-1/240", "-221/60480", "-19/6048", "-9829/3628800", "-407/172800"]
    moulton = ["-1/2", "-1/12", "-1/24", "-19/720", "-3/160", "-863/60480", "-275/24192", "-33953/3628800"]
    assert position_series(-1, 8) == [Fraction(c) for c in stormer]
    assert position_series(0, 8) == [Fraction(c) for c in cowell]
    assert velocity_series(0, 8) == [Fraction(c) for c in moulton]


@pytest.mark.parametrize("order", ORDERS)
def test_rounded_weights_keep_their_moments(order):
    """Coefficients are rounded such that together they miss their moments by far less than the nearest floats."""
    exact = position_weights(-1, order)[::-1]

    def missed(values):
        errors = [Fraction(v) - e for v, e in zip(values, exact, strict=True)]
        moments = [abs(float(sum(e * (order - i) ** k for i, e in enumerate(errors)))) for k in range(3)]
        return np.dot(moments, [1, 1 / 16, 1 / 256])

    nearest, rounded = [float(e) for e in exact], weights(order).predict_q
    assert all(abs(r - n) <= np.spacing(abs(n)) for r, n in zip(rounded, nearest, strict=True))
    assert missed(rounded) <= min(missed(nearest), 5e-15)


def test_stability_with_weak_damping():
    """A step within the limits for both alone may be unstable, as the error of a damped oscillator shows."""
    fast, damped = 0.05, 5e-4
    assert fast < stability_limit(12, False) < stability_limit(12, True) / 3
    assert longest_stable(12, False, 0.0, damped) == 1.0
    part = longest_stable(12, False, fast, damped)
    assert 0.5 < part < 1.0
    assert longest_stable(12, False, 0.9 * part * fast, 0.9 * part * damped) == 1.0

    def fun(t, y):
        return np.array([y[1], -y[0] - 0.01 * y[1]])

    with pytest.raises(ValueError, match=r"h = 0.05 is not stable, .* Take h <= 0\.0[34]"):
        integrate(fun, (0, 50), [1.0, 0.0], method=EIPGJ12, h=fast)
    run = integrate(fun, (0, 50), [1.0, 0.0], method=EIPGJ12, h=0.95 * part * fast)
    omega = math.sqrt(1 - 0.005**2)
    exact = math.exp(-0.25) * (math.cos(50 * omega) + 0.005 / omega * math.sin(50 * omega))
    assert abs(run.y[0, -1] - exact) < 1e-13


def test_orders_and_names():
    for order in (3, 17, 4.0, True, "12"):
        with pytest.raises(ValueError, match=r"order must be an integer from 4 to 16, got"):
            GaussJackson(order=order)
    assert eip_method(GaussJackson(order=10)).__name__ == "EIP_GJ10"
    assert repr(GaussJackson(order=14, corrected=True)) == "<GaussJackson GJ14: order 14, corrected by the Jacobian>"
