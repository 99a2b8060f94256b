"""Closed forms in many digits."""

import mpmath
import numpy as np


def kepler_flow(start, t):
    """Return the state after a time t, by Lagrange's coefficients and Kepler's equation (Battin 1987, 4.41)."""
    x, y, u, v = start
    r0 = mpmath.hypot(x, y)
    a = 1 / (2 / r0 - u * u - v * v)
    mean = a ** mpmath.mpf(-1.5)
    c0, s0 = 1 - r0 / a, (x * u + y * v) / mpmath.sqrt(a)
    angle = mpmath.findroot(lambda d: d - c0 * mpmath.sin(d) + s0 * (1 - mpmath.cos(d)) - mean * t, mean * t)
    sin, cos = mpmath.sin(angle), mpmath.cos(angle)
    r = a * (1 - c0 * cos + s0 * sin)
    f, g = 1 - a / r0 * (1 - cos), t - (angle - sin) / mean
    f_dot, g_dot = -mpmath.sqrt(a) / (r * r0) * sin, 1 - a / r * (1 - cos)
    return [f * x + g * u, f * y + g * v, f_dot * x + g_dot * u, f_dot * y + g_dot * v]


def kepler_state(start, t, digits=40):
    """Return the same as floats, computed with that many digits."""
    with mpmath.workdps(digits):
        return np.array([float(x) for x in kepler_flow([mpmath.mpf(float(x)) for x in start], mpmath.mpf(float(t)))])
