"""Array kernels of the step and the projection, always compiled.

Every state enters as a float64 view: a complex state of n components is 2 n floats, and Re<., .> is then the
ordinary inner product, so that one set of kernels serves both. Sums run in a fixed order with eight partial
sums: the same bits whether a kernel is called from Python or inlined in a compiled driver.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

OK, NOT_FINITE, FAILED_PROJECTION = 0, 1, 2

EPS = 2.220446049250313e-16
BAND_FACTOR = 4.0
METRIC_FLOOR = 1e-7
RANK_TOLERANCE = sqrt(EPS)
TINY = 1e-290
FAILURE_BANDS = 100.0
SPLITTER = 134217729.0  # 2**27 + 1 (Dekker)


class Grouping(NamedTuple):
    """Blocks as index lists: block b holds components ``index[start[b]:start[b + 1]]``; width 2 for complex."""

    index: np.ndarray
    start: np.ndarray
    width: int


class FrameRows(NamedTuple):
    """Non-zeros of C and of the transpose of S (C S)^-1, row by row."""

    c_start: np.ndarray
    c_index: np.ndarray
    c_value: np.ndarray
    m_start: np.ndarray
    m_index: np.ndarray
    m_value: np.ndarray


class Inner(NamedTuple):
    """Scratch of the small Newton systems."""

    matrix: np.ndarray
    g: np.ndarray
    norms: np.ndarray
    R: np.ndarray
    pivots: np.ndarray
    mu: np.ndarray


def make_inner(size: int) -> Inner:
    """Scratch for systems of up to `size` invariants."""
    square = (size, size)
    return Inner(
        np.zeros(square), np.zeros(size), np.zeros(size), np.zeros(square), np.zeros(size, np.int64), np.zeros(size)
    )


_jit = njit(cache=True, error_model="numpy", _nrt=False)
_jit_inline = njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)


@_jit
def copy(a, out):
    """Out = a."""
    for i in range(a.size):
        out[i] = a[i]


@_jit
def fill(a, value):
    """Set every entry of a."""
    for i in range(a.size):
        a[i] = value


@_jit
def dot(a, b):
    n = a.size
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0
    i = 0
    while i + 7 < n:
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
        s4 += a[i + 4] * b[i + 4]
        s5 += a[i + 5] * b[i + 5]
        s6 += a[i + 6] * b[i + 6]
        s7 += a[i + 7] * b[i + 7]
        i += 8
    if i + 3 < n:
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
        i += 4
    while i < n:
        s4 += a[i] * b[i]
        i += 1
    return ((s0 + s4) + (s1 + s5)) + ((s2 + s6) + (s3 + s7))


@_jit
def abs_dot(a, b):
    n = a.size
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0
    i = 0
    while i + 7 < n:
        s0 += abs(a[i] * b[i])
        s1 += abs(a[i + 1] * b[i + 1])
        s2 += abs(a[i + 2] * b[i + 2])
        s3 += abs(a[i + 3] * b[i + 3])
        s4 += abs(a[i + 4] * b[i + 4])
        s5 += abs(a[i + 5] * b[i + 5])
        s6 += abs(a[i + 6] * b[i + 6])
        s7 += abs(a[i + 7] * b[i + 7])
        i += 8
    if i + 3 < n:
        s0 += abs(a[i] * b[i])
        s1 += abs(a[i + 1] * b[i + 1])
        s2 += abs(a[i + 2] * b[i + 2])
        s3 += abs(a[i + 3] * b[i + 3])
        i += 4
    while i < n:
        s4 += abs(a[i] * b[i])
        i += 1
    return ((s0 + s4) + (s1 + s5)) + ((s2 + s6) + (s3 + s7))


@_jit
def norm(a):
    square = dot(a, a)
    if 1e-200 < square < 1e200:
        return sqrt(square)
    largest = 0.0
    for i in range(a.size):
        largest = max(largest, abs(a[i]))
    if largest == 0.0 or not np.isfinite(largest):
        return largest
    total = 0.0
    for i in range(a.size):
        total += (a[i] / largest) ** 2
    return largest * sqrt(total)


@_jit
def all_finite(a):
    """Whether no entry is NaN or infinite: x - x is 0 for finite x only."""
    total = 0.0
    for i in range(a.size):
        total += a[i] - a[i]
    return total == 0.0


@_jit_inline
def combine(y, h, weights, K, stages, out):
    """out = y + h sum_j weights[j] K[j] over the first `stages` rows, zero weights skipped."""
    n = y.size
    used = 0
    for j in range(stages):
        w = weights[j]
        if w == 0.0:
            continue
        if used == 0:
            for i in range(n):
                out[i] = w * K[j, i]
        else:
            for i in range(n):
                out[i] += w * K[j, i]
        used += 1
    if used == 0:
        for i in range(n):
            out[i] = y[i]
    else:
        for i in range(n):
            out[i] = y[i] + h * out[i]


@_jit_inline
def weighted_sum(weights, K, scale, out):
    """out = scale sum_j weights[j] K[j]."""
    n = out.size
    for i in range(n):
        out[i] = 0.0
    for j in range(weights.size):
        w = weights[j]
        if w != 0.0:
            for i in range(n):
                out[i] += w * K[j, i]
    for i in range(n):
        out[i] *= scale


@_jit
def two_sum(a, b):
    s = a + b
    v = s - a
    return s, (a - (s - v)) + (b - v)


@_jit
def two_product(a, b):
    p = a * b
    x = SPLITTER * a
    a_high = x - (x - a)
    a_low = a - a_high
    x = SPLITTER * b
    b_high = x - (x - b)
    b_low = b - b_high
    return p, ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low


@_jit
def compensated_step(y, carry, h, weights, weights_low, K, out, carry_out):
    """(out, carry_out) = y + carry + h sum_j (weights + weights_low)[j] K[j], rounded once to two doubles."""
    for i in range(y.size):
        main = 0.0
        low = 0.0
        for j in range(weights.size):
            main += weights[j] * K[j, i]
            low += weights_low[j] * K[j, i]
        increment, rest = two_product(h, main)
        s, lost = two_sum(y[i], increment)
        out[i], carry_out[i] = two_sum(s, lost + (rest + h * low + carry[i]))


@_jit
def compensated_add(y, carry, move):
    """Y + carry += move, in place."""
    for i in range(y.size):
        s, lost = two_sum(y[i], move[i])
        y[i], carry[i] = two_sum(s, lost + carry[i])


@_jit
def quadrature_add(err, total):
    """Total = hypot(total, err), by component."""
    for i in range(err.size):
        total[i] = np.hypot(total[i], err[i])


@_jit
def power(x, exponent):
    """x**exponent for x in [0, 1]; the exponents of RK4 and DOP853 by square roots, several times faster."""
    if x == 0.0 or x == 1.0:
        return x
    if exponent == 1.25:
        return x * sqrt(sqrt(x))
    if exponent == 1.125:
        return x * sqrt(sqrt(sqrt(x)))
    return x**exponent


@_jit
def magnitude(a, i, width):
    if width == 1:
        return abs(a[i])
    return np.hypot(a[2 * i], a[2 * i + 1])


@_jit
def block_square(a, b, unit, groups):
    """Square of the norm of block b of a, in units of `unit`."""
    total = 0.0
    for p in range(groups.start[b], groups.start[b + 1]):
        i = groups.index[p]
        for part in range(groups.width):
            total += (a[groups.width * i + part] / unit) ** 2
    return total


@_jit_inline
def error_metric(err, y, y_hat, rtol, atol, groups, kappa, sigma, scale):
    """Weights sigma of the error metric and the blocks' scales; returns the largest relative error r.

    r = 0 (no error at all) leaves the euclidean metric.
    """
    blocks = groups.start.size - 1
    width = groups.width
    largest = 0.0
    for b in range(blocks):
        first = groups.index[groups.start[b]]
        if groups.start[b + 1] - groups.start[b] == 1:
            s = atol[first] + rtol[first] * max(magnitude(y, first, width), magnitude(y_hat, first, width))
            scale[b] = s if s >= TINY else 0.0
            r = magnitude(err, first, width) / s if s >= TINY else 0.0
            sigma[width * first] = r
            largest = max(largest, r)
            continue
        unit = 0.0
        for p in range(groups.start[b], groups.start[b + 1]):
            i = groups.index[p]
            s = atol[i] + rtol[i] * max(magnitude(y, i, width), magnitude(y_hat, i, width))
            sigma[width * i] = s
            unit = max(unit, s)
        if unit < TINY:
            scale[b] = 0.0
            sigma[width * first] = 0.0
            continue
        inverse = 1.0 / unit
        scale_square = 0.0
        error_square = 0.0
        for p in range(groups.start[b], groups.start[b + 1]):
            i = groups.index[p]
            scale_square += (sigma[width * i] * inverse) ** 2
            error_square += (magnitude(err, i, width) * inverse) ** 2
        scale[b] = unit * sqrt(scale_square)
        r = sqrt(error_square / scale_square)
        sigma[width * first] = r
        largest = max(largest, r)
    if largest == 0.0:
        fill(sigma, 1.0)
        return 0.0
    top = 0.0
    for b in range(blocks):
        first = width * groups.index[groups.start[b]]
        weight = scale[b] * (power(sigma[first] / largest, kappa) + METRIC_FLOOR)
        sigma[first] = weight
        top = max(top, weight)
    for b in range(blocks):
        weight = sigma[width * groups.index[groups.start[b]]] / top
        for p in range(groups.start[b], groups.start[b + 1]):
            i = groups.index[p]
            for part in range(width):
                sigma[width * i + part] = weight
    return largest


@_jit_inline
def correction_in_local_errors(move, scale, groups, largest_error, record):
    """Raise record[0] to the largest ratio over the blocks of the correction to the step's largest local error."""
    largest = 0.0
    for b in range(scale.size):
        if scale[b] > 0.0:
            largest = max(largest, block_square(move, b, scale[b], groups))
    record[0] = max(record[0], sqrt(largest) / largest_error)


@_jit
def defects(values, target, G, y_hat, scales, g, band):
    """Defects g = values - target and their dead bands; inside its band a defect is set to 0.

    Returns whether anything is left to project.
    """
    outside = False
    for i in range(g.size):
        size = max(abs(values[i]), abs(target[i]))
        size = max(max(size, scales[i]), abs_dot(G[i], y_hat))
        band[i] = BAND_FACTOR * EPS * size
        g[i] = values[i] - target[i]
        if abs(g[i]) <= band[i]:
            g[i] = 0.0
        else:
            outside = True
    return outside


@_jit_inline
def apply_frame(row, frame):
    """Row of gradients <- row (1 - S (C S)^-1 C)."""
    for k in range(frame.c_start.size - 1):
        t = 0.0
        for p in range(frame.m_start[k], frame.m_start[k + 1]):
            t += row[frame.m_index[p]] * frame.m_value[p]
        for p in range(frame.c_start[k], frame.c_start[k + 1]):
            row[frame.c_index[p]] -= t * frame.c_value[p]


@_jit_inline
def weigh_rows(G, sigma, frame, B):
    """Rows B_i = sigma * (G_i projected along the frame)."""
    for i in range(B.shape[0]):
        row = B[i]
        for j in range(row.size):
            row[j] = G[i, j]
        apply_frame(row, frame)
        for j in range(row.size):
            row[j] *= sigma[j]


@_jit
def scale_row(row, factor):
    for j in range(row.size):
        row[j] *= factor


@_jit
def remove_component(row, unit_row):
    r = dot(unit_row, row)
    for j in range(row.size):
        row[j] -= r * unit_row[j]
    return r


@_jit
def factor(B, norms, R, pivots):
    """Pivoted QR of the normalised rows of B, in place; returns the numerical rank.

    Row pivots[k] of B becomes the k-th orthonormal direction, R[k, i] the component of normalised row i along it.
    Modified Gram-Schmidt, with a second pass where cancellation would have spoilt the first.
    """
    rows = B.shape[0]
    first = 0
    for i in range(rows):
        pivots[i] = i
        norms[i] = norm(B[i])
        if norms[i] > 0.0:
            scale_row(B[i], 1.0 / norms[i])
            if norms[first] == 0.0:
                first = i
    if rows == 0 or norms[first] == 0.0:
        return 0
    pivots[0], pivots[first] = first, 0
    R[0, first] = 1.0
    for k in range(1, rows):
        best, length = k, -1.0
        for p in range(k, rows):
            row = pivots[p]
            R[k - 1, row] = remove_component(B[row], B[pivots[k - 1]])
            left = norm(B[row])
            if left > length:
                best, length = p, left
        pivots[k], pivots[best] = pivots[best], pivots[k]
        row = pivots[k]
        if RANK_TOLERANCE < length < 0.5:
            for q in range(k):
                R[q, row] += remove_component(B[row], B[pivots[q]])
            length = norm(B[row])
        if length <= RANK_TOLERANCE:
            return k
        R[k, row] = length
        scale_row(B[row], 1.0 / length)
    return rows


@_jit
def least_norm(g, norms, R, pivots, rank, mu):
    """Coefficients mu along the orthonormal directions of the least-norm x with (row_i . x) = -g_i on the pivot rows."""
    for k in range(rank):
        row = pivots[k]
        value = -g[row] / norms[row]
        for q in range(k):
            value -= R[q, row] * mu[q]
        mu[k] = value / R[k, row]


@_jit_inline
def newton_matrix_solve(rows, g, Q, pivots, rank, inner, mu):
    """Add to mu the Newton step of (rows . Q) step = -g, on the rows that the first factorisation chose."""
    matrix = inner.matrix[:rank, :rank]
    for k in range(rank):
        for q in range(rank):
            matrix[k, q] = dot(rows[pivots[k]], Q[pivots[q]])
        inner.g[k] = g[pivots[k]]
    inner_rank = factor(matrix, inner.norms, inner.R, inner.pivots)
    least_norm(inner.g, inner.norms, inner.R, inner.pivots, inner_rank, inner.mu)
    for k in range(inner_rank):
        row = matrix[inner.pivots[k]]
        for q in range(rank):
            mu[q] += inner.mu[k] * row[q]


@_jit_inline
def move_along(mu, Q, pivots, rank, sigma, frame, y_hat, move, out):
    """Move = (1 - S (C S)^-1 C) sigma * (Q^T mu), the correction, neutral to the frame; out = y_hat + move."""
    n = move.size
    if rank == 0:
        fill(move, 0.0)
    else:
        first = Q[pivots[0]]
        for j in range(n):
            move[j] = mu[0] * first[j]
        for k in range(1, rank):
            row = Q[pivots[k]]
            for j in range(n):
                move[j] += mu[k] * row[j]
        for j in range(n):
            move[j] *= sigma[j]
    for k in range(frame.c_start.size - 1):
        t = 0.0
        for p in range(frame.c_start[k], frame.c_start[k + 1]):
            t += frame.c_value[p] * move[frame.c_index[p]]
        for p in range(frame.m_start[k], frame.m_start[k + 1]):
            move[frame.m_index[p]] -= t * frame.m_value[p]
    for j in range(n):
        out[j] = y_hat[j] + move[j]


@_jit
def subtract(a, b, out):
    """Out = a - b."""
    for i in range(a.size):
        out[i] = a[i] - b[i]


@_jit
def add_products(rows, a, out):
    """Out[i] += rows[i] . a."""
    for i in range(out.size):
        out[i] += dot(rows[i], a)


@_jit
def judge(values, target, before, band, y, defect, max_defect):
    """Defects after a projection: FAILED_PROJECTION where something is not finite, or a defect has grown and stands
    above FAILURE_BANDS dead bands; else OK, with the largest defects so far noted."""
    good = all_finite(y)
    for i in range(defect.size):
        defect[i] = values[i] - target[i]
        size = abs(defect[i])
        if not np.isfinite(size) or (size > abs(before[i]) and size > FAILURE_BANDS * band[i]):
            good = False
    if not good:
        return FAILED_PROJECTION
    for i in range(defect.size):
        max_defect[i] = max(max_defect[i], abs(defect[i]))
    return OK


@_jit
def midpoint(a, b, out):
    """Out = (a + b) / 2."""
    for i in range(a.size):
        out[i] = 0.5 * (a[i] + b[i])


@_jit
def hermite(theta, h, y_old, f_old, y, f, out):
    """Cubic Hermite interpolation at t_old + theta h."""
    rest = 1.0 - theta
    for i in range(y.size):
        change = y[i] - y_old[i]
        out[i] = (
            y_old[i]
            + theta * change
            + theta * rest * (rest * (h * f_old[i] - change) - theta * (h * f[i] - change))
        )


@_jit
def sample(t_eval, place, t, t_new, h, y, K, y_new, t_saved, y_saved):
    """Save the states at those t_eval that the step from t to t_new has reached; place[1] counts the rows."""
    sign = 1.0 if h > 0 else -1.0
    while place[1] < t_eval.size and sign * (t_eval[place[1]] - t_new) <= 0:
        row = place[1]
        t_saved[row] = t_eval[row]
        if t_eval[row] == t_new:
            copy(y_new, y_saved[row])
        else:
            hermite((t_eval[row] - t) / h, h, y, K[0], y_new, K[-1], y_saved[row])
        place[1] = row + 1
