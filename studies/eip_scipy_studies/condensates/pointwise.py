"""Functions of fields point by point, and sums over fields with the same bits on every machine, compiled by Numba.

Fields are contiguous complex arrays, which the functions see as floats (Re, Im, Re, Im ...).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..report import needed

njit = needed("numba", '"eip_scipy[numba]"').njit

BLOCK, LANES = 512, 8  # points in one part of a sum, and partial sums
# pi / 2 in two parts (Cody & Waite): whole multiples of the first, up to 2^20 of them, are exact.
QUARTER, QUARTER_LOW = float.fromhex("0x1.921fb544p+0"), float.fromhex("0x1.0b4611a626331p-34")
QUARTERS, SHIFT = float.fromhex("0x1.45f306dc9c883p-1"), float.fromhex("0x1.8p52")


def of_fields(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of fields and numbers that calls `function`, compiled, with flat arrays of floats."""
    compiled = njit(error_model="numpy")(function)
    return lambda *arguments: compiled(
        *(a.reshape(-1).view(float) if isinstance(a, np.ndarray) else a for a in arguments)
    )


@of_fields
def add_potential(psi, V, beta, out):
    """Add ``(V + beta |psi|^2) psi`` to `out`."""
    for i in range(V.size):
        a, b = psi[2 * i], psi[2 * i + 1]
        v = V[i] + beta * (a * a + b * b)
        out[2 * i] += v * a
        out[2 * i + 1] += v * b


@of_fields
def divide_by_root(a, psi, V, beta, shift, out):
    """Fill `out`, which may be `a`, with ``a / sqrt(shift + V + beta |psi|^2)``."""
    for i in range(V.size):
        x, y = psi[2 * i], psi[2 * i + 1]
        weight = 1 / np.sqrt(shift + V[i] + beta * (x * x + y * y))
        out[2 * i] = weight * a[2 * i]
        out[2 * i + 1] = weight * a[2 * i + 1]


@of_fields
def rotate(a, b, c, s):
    """Replace `a` by c a + s b."""
    for i in range(a.size):
        a[i] = c * a[i] + s * b[i]


@of_fields
def inner(a, b):
    """Return Re <a, b>, the sum of Re(conj(a) b)."""
    lane, rest = np.zeros(LANES), 0.0
    whole = a.size - a.size % LANES
    for i in range(0, whole, LANES):
        for k in range(LANES):
            lane[k] += a[i + k] * b[i + k]
    for i in range(whole, a.size):
        rest += a[i] * b[i]
    return ((lane[0] + lane[4]) + (lane[2] + lane[6])) + ((lane[1] + lane[5]) + (lane[3] + lane[7])) + rest


@of_fields
def quartic_sums(psi, p):
    """Return the sums of nn, nq, mm, mq and qq, with n = ``|psi|^2``, m = Re(conj(psi) p) and q = ``|p|^2``."""
    total, part = np.zeros(5), np.zeros(5)
    for begin in range(0, psi.size // 2, BLOCK):
        part[:] = 0.0
        for i in range(begin, min(begin + BLOCK, psi.size // 2)):
            x, y, u, v = psi[2 * i], psi[2 * i + 1], p[2 * i], p[2 * i + 1]
            n, m, q = x * x + y * y, x * u + y * v, u * u + v * v
            part[0] += n * n
            part[1] += n * q
            part[2] += m * m
            part[3] += m * q
            part[4] += q * q
        total += part
    return total


@of_fields
def local_flow(psi, V, beta, h):
    """Multiply psi by ``exp(-i h (V + beta |psi|^2))``, by Taylor polynomials: to 1e-15 for angles up to 1e6."""
    for i in range(V.size):
        x, y = psi[2 * i], psi[2 * i + 1]
        angle = h * (V[i] + beta * (x * x + y * y))
        k = (angle * QUARTERS + SHIFT) - SHIFT  # the nearest whole number
        r = (angle - k * QUARTER) - k * QUARTER_LOW
        q = r * r
        s = 1.0 / 362880 + q * (-1.0 / 39916800 + q * (1.0 / 6227020800 + q * (-1.0 / 1307674368000)))
        s = r * (1 + q * (-1.0 / 6 + q * (1.0 / 120 + q * (-1.0 / 5040 + q * s))))
        c = -1.0 / 3628800 + q * (1.0 / 479001600 + q * (-1.0 / 87178291200 + q * (1.0 / 20922789888000)))
        c = 1 - q * (0.5 - q * (1.0 / 24 + q * (-1.0 / 720 + q * (1.0 / 40320 + q * c))))
        turn = k - 4 * ((0.25 * k - 0.375 + SHIFT) - SHIFT)  # 0, 1, 2 or 3 quarters
        cosine, sine = (s, c) if (turn == 1.0) | (turn == 3.0) else (c, s)
        re = -cosine if (turn == 1.0) | (turn == 2.0) else cosine
        im = sine if turn >= 2.0 else -sine
        psi[2 * i] = re * x - im * y
        psi[2 * i + 1] = re * y + im * x
