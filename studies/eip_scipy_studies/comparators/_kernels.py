"""Loops over the points of complex fields, one for each part of a step of the implicit schemes, compiled by Numba.

Fields are flat and complex, (n,). Sums may be computed in any order, which lets the compiler use vectors.
"""

# mypy: disallow-untyped-defs = false, disallow-incomplete-defs = false

from __future__ import annotations

import math

from ._steps import njit

loop = njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})


@loop
def extrapolate(last, before, first):
    """Replace `first` by the parabola through first, before and last, equally spaced, one spacing further."""
    for i in range(first.size):
        change = last[i] - before[i]
        first[i] += complex(3.0 * change.real, 3.0 * change.imag)


@loop
def multiply_modes(modes, factor):
    """Multiply `modes` by complex factors."""
    for i in range(modes.size):
        modes[i] *= factor[i]


@loop
def right_side(start, mean, rotation, W, w, c, out):
    """Write start - i c ((W - w) mean + rotation) to `out`, and return the norm of its change; no `rotation`: empty."""
    total = 0.0
    rotates = rotation.size > 0
    for i in range(out.size):
        s = c * (W[i] - w)
        re, im = start[i].real + s * mean[i].imag, start[i].imag - s * mean[i].real
        if rotates:
            re += c * rotation[i].imag
            im -= c * rotation[i].real
        x, y = re - out[i].real, im - out[i].imag
        total += x * x + y * y
        out[i] = complex(re, im)
    return math.sqrt(total)


@loop
def other_end(mean, start):
    """Replace `start` by 2 mean - start."""
    for i in range(start.size):
        start[i] = mean[i] + mean[i] - start[i]


@loop
def mean_density(start, mean, V, beta, out):
    """Write V + beta / 2 (|2 mean - start|^2 + |start|^2) to `out`."""
    for i in range(out.size):
        x, y = start[i].real, start[i].imag
        p, q = 2.0 * mean[i].real - x, 2.0 * mean[i].imag - y
        out[i] = V[i] + 0.5 * beta * (x * x + y * y + p * p + q * q)


@loop
def density(psi, V, beta, out):
    """Write V + beta |psi|^2 to `out`."""
    for i in range(out.size):
        out[i] = V[i] + beta * (psi[i].real * psi[i].real + psi[i].imag * psi[i].imag)


@loop
def nonlinear_force(psi, other, a, V, beta, out):
    """Write (V + beta |p|^2) p, p = psi + a (psi - other), to `out`; return the sum of V |p|^2 + beta / 2 |p|^4."""
    total = 0.0
    for i in range(out.size):
        x, y = psi[i].real, psi[i].imag
        p, q = x + a * (x - other[i].real), y + a * (y - other[i].imag)
        n = p * p + q * q
        v = V[i] + beta * n
        out[i] = complex(v * p, v * q)
        total += (V[i] + 0.5 * beta * n) * n
    return total


@loop
def projections(force, modes, inverse, c):
    """Return the sums of Re conj(force) (inverse - 1) modes and of Re conj(force) i c inverse force."""
    along = norm = 0.0
    for i in range(force.size):
        g, k, q, r = force[i].real, force[i].imag, inverse[i].real, inverse[i].imag
        a, b = modes[i].real, modes[i].imag
        along += g * ((q * a - r * b) - a) + k * ((q * b + r * a) - b)
        norm -= c * r * (g * g + k * k)
    return along, norm


@loop
def advance(modes, inverse, factor, new_modes, force):
    """Write 2 inverse (modes - i factor force) - modes to `new_modes`, and that divided by its size to `force`."""
    n = modes.size
    for i in range(n):
        a, b, q, r = modes[i].real, modes[i].imag, inverse[i].real, inverse[i].imag
        x, y = a + factor * force[i].imag, b - factor * force[i].real
        re, im = 2.0 * (q * x - r * y) - a, 2.0 * (q * y + r * x) - b
        new_modes[i] = complex(re, im)
        force[i] = complex(re / n, im / n)
