"""Pointwise kernels on complex fields, as float views (Re, Im, Re, Im ...), and sums over them, always compiled.

Sums run row by row in four accumulators: the same bits on every machine, and the error of a sum over a few hundred
numbers, not of one over all.
"""

from __future__ import annotations

import numpy as np

from ...engine.caching import cached_njit

__all__ = [
    "add_potential",
    "derivative",
    "derivative_at_once",
    "divide_by_root",
    "interaction_energy",
    "local_flow",
    "multiply",
    "quartic_sums",
    "rotate",
    "turn",
    "weighted_square",
]

_jit = cached_njit(error_model="numpy")

# pi / 2 in two parts (Cody & Waite): whole multiples of the first, up to 2^20 of them, are exact.
QUARTER = float.fromhex("0x1.921fb544p+0")
QUARTER_LOW = float.fromhex("0x1.0b4611a626331p-34")


@_jit
def multiply(first, field, factor):
    """Field (rows, 2 m) times real factors (more rows, m) or, one for each row, (more rows, 1), from `first` on."""
    for r in range(field.shape[0]):
        row, factors = field[r], factor[first + r]
        if factors.size == 1:
            a = factors[0]
            for i in range(row.size):
                row[i] *= a
        else:
            for i in range(factors.size):
                row[2 * i] *= factors[i]
                row[2 * i + 1] *= factors[i]


@_jit
def weighted_square(field, weight):
    """Sum of ``weight |field|^2``; shapes as in `multiply`."""
    total = 0.0
    for r in range(field.shape[0]):
        row, w = field[r], weight[r]
        total += w[0] * row_square(row) if w.size == 1 else weighted_row_square(row, w)
    return total


@_jit
def row_square(row):
    a = b = c = d = 0.0
    whole = row.size - row.size % 4
    for i in range(0, whole, 4):
        a += row[i] * row[i]
        b += row[i + 1] * row[i + 1]
        c += row[i + 2] * row[i + 2]
        d += row[i + 3] * row[i + 3]
    for i in range(whole, row.size):
        a += row[i] * row[i]
    return (a + b) + (c + d)


@_jit
def weighted_row_square(row, w):
    a = b = c = d = 0.0
    whole = w.size - w.size % 4
    for i in range(0, whole, 4):
        k = 2 * i
        a += w[i] * (row[k] * row[k] + row[k + 1] * row[k + 1])
        b += w[i + 1] * (row[k + 2] * row[k + 2] + row[k + 3] * row[k + 3])
        c += w[i + 2] * (row[k + 4] * row[k + 4] + row[k + 5] * row[k + 5])
        d += w[i + 3] * (row[k + 6] * row[k + 6] + row[k + 7] * row[k + 7])
    for i in range(whole, w.size):
        a += w[i] * (row[2 * i] * row[2 * i] + row[2 * i + 1] * row[2 * i + 1])
    return (a + b) + (c + d)


@_jit
def interaction_energy(psi, V, beta):
    """Sum of ``V |psi|^2 + beta / 2 |psi|^4``; psi (rows, 2 m), V (rows, m)."""
    total = 0.0
    half = 0.5 * beta
    for r in range(V.shape[0]):
        row, v = psi[r], V[r]
        a = b = 0.0
        whole = v.size - v.size % 2
        for i in range(0, whole, 2):
            k = 2 * i
            n = row[k] * row[k] + row[k + 1] * row[k + 1]
            m = row[k + 2] * row[k + 2] + row[k + 3] * row[k + 3]
            a += (v[i] + half * n) * n
            b += (v[i + 1] + half * m) * m
        if whole < v.size:
            k = 2 * whole
            n = row[k] * row[k] + row[k + 1] * row[k + 1]
            a += (v[whole] + half * n) * n
        total += a + b
    return total


@_jit
def derivative(first, rest, psi, V, beta, out):
    """out = ``-i (out + rest + (V + beta |psi|^2) psi)``, in as many rows from `first` on as `rest` has.

    Out and psi (rows, 2 m), V (rows, m), rest (some rows, 2 m).
    """
    for r in range(rest.shape[0]):
        more, field, potential, image = rest[r], psi[first + r], V[first + r], out[first + r]
        for i in range(potential.size):
            a, b = field[2 * i], field[2 * i + 1]
            v = potential[i] + beta * (a * a + b * b)
            re, im = image[2 * i] + more[2 * i] + v * a, image[2 * i + 1] + more[2 * i + 1] + v * b
            image[2 * i], image[2 * i + 1] = im, -re


@_jit
def derivative_at_once(psi, V, beta, out):
    """out = ``-i (out + (V + beta |psi|^2) psi)``; psi and out (rows, 2 m), V (rows, m)."""
    for r in range(V.shape[0]):
        field, potential, image = psi[r], V[r], out[r]
        for i in range(potential.size):
            a, b = field[2 * i], field[2 * i + 1]
            v = potential[i] + beta * (a * a + b * b)
            re, im = image[2 * i] + v * a, image[2 * i + 1] + v * b
            image[2 * i], image[2 * i + 1] = im, -re


@_jit
def add_potential(psi, V, beta, out):
    """out += ``(V + beta |psi|^2) psi``, all flat."""
    for i in range(V.size):
        a, b = psi[2 * i], psi[2 * i + 1]
        v = V[i] + beta * (a * a + b * b)
        out[2 * i] += v * a
        out[2 * i + 1] += v * b


@_jit
def local_flow(psi, V, beta, h):
    """psi <- ``exp(-i h (V + beta |psi|^2)) psi``, flat.

    The sine and cosine are their Taylor polynomials on [-pi/4, pi/4], without a branch: the loop becomes vector code,
    three times as fast as with the library's functions. To 1e-15 for angles up to 1e6.
    """
    for i in range(V.size):
        x, y = psi[2 * i], psi[2 * i + 1]
        angle = h * (V[i] + beta * (x * x + y * y))
        k = np.floor(angle / QUARTER + 0.5)
        r = (angle - k * QUARTER) - k * QUARTER_LOW
        q = r * r
        s = 1 / 362880 + q * (-1 / 39916800 + q * (1 / 6227020800 - q / 1307674368000))
        s = r * (1 + q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * s))))
        c = 1 / 40320 + q * (-1 / 3628800 + q * (1 / 479001600 + q * (-1 / 87178291200 + q / 20922789888000)))
        c = 1 - q * (0.5 - q * (1 / 24 + q * (-1 / 720 + q * c)))
        turn = k - 4 * np.floor(0.25 * k)
        odd = (turn == 1.0) | (turn == 3.0)
        cosine, sine = s if odd else c, c if odd else s
        cosine = -cosine if (turn == 1.0) | (turn == 2.0) else cosine
        sine = -sine if turn >= 2.0 else sine
        psi[2 * i], psi[2 * i + 1] = cosine * x + sine * y, cosine * y - sine * x


@_jit
def turn(f, factor, out):
    """out = i factor f, flat."""
    for i in range(f.size // 2):
        re, im = f[2 * i], f[2 * i + 1]
        out[2 * i], out[2 * i + 1] = -factor * im, factor * re


@_jit
def quartic_sums(psi, p, out):
    """Fill out (5,) with the sums of nn, nq, mm, mq and qq; all (rows, 2 m).

    Here ``n = |psi|^2``, ``m = Re(conj(psi) p)``, ``q = |p|^2``.
    """
    out[:] = 0.0
    for r in range(psi.shape[0]):
        nn = nq = mm = mq = qq = 0.0
        a, b = psi[r], p[r]
        for i in range(a.size // 2):
            x, y, u, v = a[2 * i], a[2 * i + 1], b[2 * i], b[2 * i + 1]
            n, m, q = x * x + y * y, x * u + y * v, u * u + v * v
            nn += n * n
            nq += n * q
            mm += m * m
            mq += m * q
            qq += q * q
        out[0] += nn
        out[1] += nq
        out[2] += mm
        out[3] += mq
        out[4] += qq


@_jit
def divide_by_root(a, psi, V, beta, shift, out):
    """out = ``a / sqrt(shift + V + beta |psi|^2)``, all flat."""
    for i in range(V.size):
        x, y = psi[2 * i], psi[2 * i + 1]
        weight = 1 / np.sqrt(shift + V[i] + beta * (x * x + y * y))
        out[2 * i], out[2 * i + 1] = weight * a[2 * i], weight * a[2 * i + 1]


@_jit
def rotate(a, b, c, s):
    """A <- c a + s b, flat."""
    for i in range(a.size):
        a[i] = c * a[i] + s * b[i]


def float_rows(field: np.ndarray, columns: int) -> np.ndarray:
    """A contiguous field as floats (rows, 2 columns), without a copy."""
    return field.reshape(-1, columns).view(np.float64)
