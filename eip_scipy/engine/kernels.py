"""Array kernels of the step and the projection, always compiled.

Every state enters as a float64 view: a complex state of n components is 2 n floats, and Re<., .> is then the
ordinary inner product, so that one set of kernels serves both. Sums run in a fixed order: the same bits whether a
kernel is called from Python or inlined in a compiled driver.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from .caching import cached_njit
from .data import BAND, BAND_COMPENSATED, EPS, FAILED_PROJECTION, OK
from .octets import is_not, no_lane, where
from .sums import abs_dot, combined_rows, dot, largest, out_of_line, remove_component, weighted_rows
from .triples import shift_and_weigh, shift_bodies, sum_bodies
from .trust import (
    AT,
    EXPECTED,
    FAR,
    FIRST,
    JUDGED,
    LARGE,
    LARGE_SHARE,
    LEFT,
    MANY,
    NOTED,
    NU,
    RAW,
    RAW_AT,
    RAW_MANY,
    SHARE,
    SHARE_AT,
    START,
    SUM,
    TERMS,
)

METRIC_FLOOR = 1e-7
RANK_TOLERANCE = sqrt(EPS)
# Below this length one Gram-Schmidt pass would leave errors of 1e-13 and more of the defects uncorrected.
REORTHOGONALISE = 0.05
TINY = 1e-290
FAILURE_BANDS = 100.0
NOISE_BANDS = 3.0
# Terms that vanish for a moment, where an invariant's own pass through zero, count as this share of those at the start.
LEAST_SHARE = 1e-3
SPLITTER = 134217729.0  # 2**27 + 1 (Dekker)


_jit = cached_njit(error_model="numpy", _nrt=False)
_jit_inline = cached_njit(error_model="numpy", _nrt=False, forceinline=True)


@_jit
def copy(a, out):
    """out = a."""
    for i in range(a.size):
        out[i] = a[i]


@_jit
def fill(a, value):
    """Set every entry of a."""
    for i in range(a.size):
        a[i] = value


@_jit
def largest_abs(a):
    top = 0.0
    for i in range(a.size):
        top = max(top, abs(a[i]))
    return top


@_jit
def norm(a):
    square = dot(a, a)
    if 1e-200 < square < 1e200:
        return sqrt(square)
    top = largest_abs(a)
    if top == 0.0 or not np.isfinite(top):
        return square - square + top
    total = 0.0
    for i in range(a.size):
        total += (a[i] / top) ** 2
    return top * sqrt(total)


@_jit
def all_finite(a):
    """Whether no entry is NaN or infinite: the sum of squares is finite too unless it overflows; x - x is 0 then."""
    if np.isfinite(dot(a, a)):
        return True
    total = 0.0
    for i in range(a.size):
        total += a[i] - a[i]
    return total == 0.0


@_jit_inline
def combine(y, h, weights, K, stages, out):
    """out = y + h sum_j weights[j] K[j] over the first `stages` rows, zero weights skipped."""
    combined_rows(y, h, weights, K, stages, 0, out)


@_jit_inline
def weighted_sum(weights, K, first, scale, out):
    """out = scale sum_j weights[j] K[j, first:]."""
    weighted_rows(scale, weights, K, weights.size, first, out)


@_jit_inline
def nystrom_position(y, h, c, weights, K, stages, out):
    """First half of out = q + c h v + h^2 sum_j weights[j] a_j, for y = (q, v) and a_j the second half of K[j]."""
    half = out.size // 2
    weighted_rows(1.0, weights, K, stages, half, out[:half])
    for i in range(half):
        out[i] = y[i] + h * (c * y[half + i] + h * out[i])


@_jit_inline
def nystrom_velocity(y, h, weights, K, stages, out):
    """Second half of out = v + h sum_j weights[j] a_j."""
    half = out.size // 2
    combined_rows(y[half:], h, weights, K, stages, half, out[half:])


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
def compensated_nystrom(y, carry, h, b, b_low, b_v, b_v_low, K, out, carry_out):
    """The same for q + h v + h^2 sum_j (b + b_low)[j] a_j and v + h sum_j (b_v + b_v_low)[j] a_j."""
    half = y.size // 2
    for i in range(half):
        k = half + i
        place = place_low = speed = speed_low = 0.0
        for j in range(b.size):
            place += b[j] * K[j, k]
            place_low += b_low[j] * K[j, k]
            speed += b_v[j] * K[j, k]
            speed_low += b_v_low[j] * K[j, k]
        drift, drift_rest = two_product(h, y[k])
        half_kick, lost = two_product(h, place)
        kick, kick_rest = two_product(h, half_kick)
        rest = drift_rest + kick_rest + h * (carry[k] + lost + h * place_low) + carry[i]
        s, first = two_sum(y[i], drift)
        s, second = two_sum(s, kick)
        out[i], carry_out[i] = two_sum(s, first + second + rest)
        increment, rest = two_product(h, speed)
        s, lost = two_sum(y[k], increment)
        out[k], carry_out[k] = two_sum(s, lost + (rest + h * speed_low + carry[k]))


@_jit
def compensated_add(y, carry, move):
    """y + carry += move, in place."""
    for i in range(y.size):
        s, lost = two_sum(y[i], move[i])
        y[i], carry[i] = two_sum(s, lost + carry[i])


@_jit
def quadrature(a, b, out):
    """out = sqrt(a^2 + b^2), by component; components whose squares would vanish or overflow by hypot."""
    lost = 0
    for i in range(out.size):
        size = abs(a[i]) + abs(b[i])
        lost += (size > 1e140) | ((size < 1e-140) & (size > 0.0))
    if lost == 0:
        for i in range(out.size):
            out[i] = sqrt(a[i] * a[i] + b[i] * b[i])
        return
    for i in range(out.size):
        size = abs(a[i]) + abs(b[i])
        extreme = (size > 1e140) | ((size < 1e-140) & (size > 0.0))
        out[i] = np.hypot(a[i], b[i]) if extreme else sqrt(a[i] * a[i] + b[i] * b[i])


@_jit
def positive(x):
    """x, or 1 in place of 0: a divisor where the quotient does not count."""
    return where(x > 0.0, x, 1.0)


@_jit
def powers(x, exponent):
    """x <- x**exponent, x in [0, 1]; for RK4 and DOP853 by square roots, several times faster than pow."""
    if exponent == 1.25:
        for i in range(x.size):
            x[i] *= sqrt(sqrt(x[i]))
    elif exponent == 1.125:
        for i in range(x.size):
            x[i] *= sqrt(sqrt(sqrt(x[i])))
    else:
        for i in range(x.size):
            x[i] = x[i] ** exponent


@_jit
def block_square(a, b, unit, groups):
    """Squared norm of block b of a, in units of 1 / unit."""
    if groups.size == 3:
        x, y, z = a[3 * b] * unit, a[3 * b + 1] * unit, a[3 * b + 2] * unit
        return x * x + y * y + z * z
    total = 0.0
    for p in range(groups.start[b], groups.start[b + 1]):
        x = a[groups.member[p]] * unit
        total += x * x
    return total


@_jit
def block_sums(a, groups, out):
    """Per block the sum of a; consecutive blocks of one or three without looking places up."""
    if groups.size == 3:
        for b in range(out.size):
            out[b] = a[3 * b] + a[3 * b + 1] + a[3 * b + 2]
    elif groups.size == 1:
        copy(a, out)
    else:
        for b in range(out.size):
            total = 0.0
            for p in range(groups.start[b], groups.start[b + 1]):
                total += a[groups.member[p]]
            out[b] = total


@_jit
def weighted_squares(weights, a, out):
    """out = (weights a)^2, by component."""
    for i in range(a.size):
        x = weights[i] * a[i]
        out[i] = x * x


@_jit
def block_sizes(y, y_hat, err, rounding, rtol, groups, scratch, sizes, errors):
    """Per block: sizes = max(|rtol y|, |rtol y_hat|), errors = |(err, rounding y_hat)|.

    Returns whether some sizes are too extreme.
    """
    weighted_squares(rtol, y, scratch)
    block_sums(scratch, groups, errors)
    weighted_squares(rtol, y_hat, scratch)
    block_sums(scratch, groups, sizes)
    extreme = False
    for b in range(sizes.size):
        square = max(sizes[b], errors[b])
        extreme = extreme | is_not((square > 1e-280) & (square < 1e280))
        sizes[b] = sqrt(square)
    for i in range(err.size):
        x = rounding * y_hat[i]
        scratch[i] = err[i] * err[i] + x * x
    block_sums(scratch, groups, errors)
    for b in range(sizes.size):
        errors[b] = sqrt(errors[b])
    return extreme


@_jit
def extreme_block_sizes(y, y_hat, err, rounding, rtol, groups, sizes, errors):
    """The same, squares taken in a unit of each block's own, so that they neither vanish nor overflow."""
    for b in range(sizes.size):
        top = 0.0
        for p in range(groups.start[b], groups.start[b + 1]):
            i = groups.member[p]
            top = max(top, max(rtol[i] * max(abs(y[i]), abs(y_hat[i])), abs(err[i])))
        unit = 1.0 / top if top > 0.0 else 1.0
        old = new = error = 0.0
        for p in range(groups.start[b], groups.start[b + 1]):
            i = groups.member[p]
            weight = rtol[i] * unit
            x = weight * y[i]
            old += x * x
            x = weight * y_hat[i]
            new += x * x
            x = err[i] * unit
            error += x * x
            x = rounding * unit * y_hat[i]
            error += x * x
        sizes[b] = sqrt(max(old, new)) / unit
        errors[b] = sqrt(error) / unit


@_jit_inline
def error_metric(err, rounding, y, y_hat, rtol, atol, groups, kappa, sigma, scale, ratio):
    """Weights sigma of the error metric and the blocks' scales; returns the largest relative error r.

    The error is the estimate and `rounding` times the state, in quadrature. `atol` is by block. r = 0 (no error at all)
    leaves the euclidean metric. `ratio` is scratch.
    """
    if block_sizes(y, y_hat, err, rounding, rtol, groups, sigma, scale, ratio):
        extreme_block_sizes(y, y_hat, err, rounding, rtol, groups, scale, ratio)
    return weights_from_sizes(atol, groups, kappa, sigma, scale, ratio)


@_jit_inline
def weights_from_sizes(atol, groups, kappa, sigma, scale, ratio):
    """The rest of `error_metric`, from what `block_sizes` has put into `scale` and `ratio`."""
    for b in range(scale.size):
        scale[b] += atol[b]
        # Over a scale of 0 there is no error to speak of.
        ratio[b] = where(scale[b] > 0.0, ratio[b], 0.0) / max(scale[b], TINY)
    largest_ratio = largest(ratio)
    inverse = 1.0 / positive(largest_ratio)
    for b in range(ratio.size):
        ratio[b] = min(1.0, ratio[b] * inverse)
    powers(ratio, kappa)
    for b in range(ratio.size):
        ratio[b] = scale[b] * (ratio[b] + METRIC_FLOOR)
    inverse = 1.0 / positive(largest(ratio))
    for b in range(ratio.size):
        weight = where(largest_ratio > 0.0, ratio[b] * inverse, 1.0)
        if groups.size == 3:
            sigma[3 * b] = sigma[3 * b + 1] = sigma[3 * b + 2] = weight
        else:
            for p in range(groups.start[b], groups.start[b + 1]):
                sigma[groups.member[p]] = weight
    return largest_ratio


@_jit_inline
def correction_in_local_errors(move, scale, groups, largest_error):
    """Largest ratio over the blocks of the correction to the step's largest local error; 0 where there is none."""
    if no_lane(largest_error > 0.0):
        return 0.0 * largest_error
    top = 0.0
    for b in range(scale.size):
        square = block_square(move, b, 1.0 / positive(scale[b]), groups)
        top = where(scale[b] > 0.0, max(top, square), top)
    return where(largest_error > 0.0, sqrt(top) / positive(largest_error), 0.0)


@_jit
def soften(err, scale, groups, sigma):
    """Half way, on a log scale, from the error metric to equal relative errors; blocks without error stay put."""
    inverse = 1.0 / largest(scale)
    for b in range(scale.size):
        if scale[b] == 0.0 or block_square(err, b, 1.0 / scale[b], groups) == 0.0:
            continue
        for p in range(groups.start[b], groups.start[b + 1]):
            i = groups.member[p]
            sigma[i] = sqrt(sigma[i] * (scale[b] * inverse))


@_jit
def defects(values, target, G, y_hat, scales, compensated, g, band, raw):
    """Defects g = values - target and their dead bands; inside its band a defect is set to 0.

    `raw` keeps all of them. Returns whether anything is left to project.
    """
    outside = False
    for i in range(g.size):
        size = max(abs(values[i]), abs(target[i]))
        size = max(max(size, scales[i]), abs_dot(G[i], y_hat))
        band[i] = (BAND_COMPENSATED if compensated else BAND) * EPS * size
        raw[i] = values[i] - target[i]
        inside = (band[i] < np.inf) & (abs(raw[i]) <= band[i])
        g[i] = where(inside, 0.0, raw[i])
        outside = outside | is_not(inside)
    return outside


@_jit
def sparse_products(frame, which, a, out):
    """out[k] = row k of C (`which` = 0) or of M^T (1) times a."""
    for k in range(out.size):
        total = 0.0
        for p in range(frame.start[which, k], frame.start[which, k + 1]):
            total += frame.value[p] * a[frame.place[p]]
        out[k] = total


@_jit
def subtract_sparse(frame, which, factors, a):
    """Subtract factors[k] times that row from a, for all k."""
    for k in range(factors.size):
        for p in range(frame.start[which, k], frame.start[which, k + 1]):
            a[frame.place[p]] -= factors[k] * frame.value[p]


@_jit_inline
def weigh_rows(G, sigma, frame, B):
    """Rows B_i = sigma * (G_i projected along the frame)."""
    _, groups, bodies = frame.bodies.shape
    for i in range(B.shape[0]):
        row = B[i]
        if groups > 0:
            for k in range(groups):
                first = 3 * bodies * k
                x, y, z = sum_bodies(frame.bodies[1, k], G[i], first, bodies)
                shift_and_weigh(G[i], frame.bodies[0, k], x, y, z, sigma, row, first, bodies)
        elif frame.products.size > 0:
            copy(G[i], row)
            sparse_products(frame, 1, row, frame.products)
            subtract_sparse(frame, 0, frame.products, row)
            for j in range(row.size):
                row[j] *= sigma[j]
        else:
            for j in range(row.size):
                row[j] = G[i, j] * sigma[j]


@_jit_inline
def keep_frame(move, frame, out):
    """out = move - M C move, neutral to the frame."""
    _, groups, bodies = frame.bodies.shape
    for k in range(groups):
        first = 3 * bodies * k
        x, y, z = sum_bodies(frame.bodies[0, k], move, first, bodies)
        shift_bodies(move, frame.bodies[1, k], x, y, z, out, first, bodies)
    if groups == 0:
        copy(move, out)
        sparse_products(frame, 0, out, frame.products)
        subtract_sparse(frame, 1, frame.products, out)


@_jit
def scale_row(row, factor):
    for j in range(row.size):
        row[j] *= factor


@_jit
def factor(B, inverse_norms, R, pivots):
    """Pivoted QR of the normalised rows of B, in place; returns the numerical rank, -1 where B is not finite.

    `inverse_norms` normalise the rows (0 for a zero row). Row pivots[k] of B becomes the k-th orthonormal direction;
    R[k, i] is the component of normalised row i along it, but for i = pivots[k] its reciprocal. By modified
    Gram-Schmidt, with a second pass where cancellation would have spoilt the first.
    """
    out_of_line()
    rows = B.shape[0]
    first = 0
    for i in range(rows):
        pivots[i] = i
        length = norm(B[i])
        if not np.isfinite(length):
            return -1
        inverse_norms[i] = 1.0 / length if length > 0.0 else 0.0
        scale_row(B[i], inverse_norms[i])
        if inverse_norms[first] == 0.0:
            first = i
    if rows == 0 or inverse_norms[first] == 0.0:
        return 0
    pivots[0], pivots[first] = first, 0
    R[0, first] = 1.0
    for k in range(1, rows):
        best, left = k, -1.0
        for p in range(k, rows):
            row = pivots[p]
            R[k - 1, row], square = remove_component(B[row], B[pivots[k - 1]])
            if square > left:
                best, left = p, square
        length = sqrt(left)
        pivots[k], pivots[best] = pivots[best], pivots[k]
        row = pivots[k]
        if RANK_TOLERANCE < length < REORTHOGONALISE:
            for q in range(k):
                again, left = remove_component(B[row], B[pivots[q]])
                R[q, row] += again
            length = sqrt(left)
        if length <= RANK_TOLERANCE:
            return k
        R[k, row] = 1.0 / length
        scale_row(B[row], R[k, row])
    return rows


@_jit
def solve_gram(B, g, R, mu):
    """Coefficients mu of the rows of B in the least-norm x with B x = -g, if the rows are far from dependent."""
    for i in range(B.shape[0]):
        for j in range(i + 1):
            R[i, j] = dot(B[i], B[j])
    return gram_solution(R, g, mu)


@_jit
def gram_solution(R, g, mu):
    """The same, from the rows' Gram matrix in the lower half of R, which is overwritten.

    By its factorisation L D L^T, which costs a third of `factor` and squares the condition number: whether it will do
    shows on the way, by the same bound below which one pass of Gram-Schmidt would not. The diagonal of R then holds
    1/D. Two rows, the usual case, by Cramer's rule: one division to wait for.
    """
    rows = g.size
    good = True
    for i in range(rows):
        good = good & (R[i, i] > 1e-140) & (R[i, i] < 1e140)
    if no_lane(good):
        return good
    if rows == 2:
        determinant = R[0, 0] * R[1, 1] - R[1, 0] * R[1, 0]
        inverse = 1.0 / positive(determinant)
        mu[0] = (R[1, 0] * g[1] - R[1, 1] * g[0]) * inverse
        mu[1] = (R[1, 0] * g[0] - R[0, 0] * g[1]) * inverse
        return good & (determinant > REORTHOGONALISE * REORTHOGONALISE * (R[0, 0] * R[1, 1]))
    for i in range(rows):
        for j in range(1, i):
            for k in range(j):
                R[i, j] -= R[i, k] * R[j, k]
        square = R[i, i]
        least = REORTHOGONALISE * REORTHOGONALISE * square
        mu[i] = -g[i]
        for j in range(i):
            x = R[i, j] * R[j, j]
            square -= x * R[i, j]
            mu[i] -= x * mu[j]
            R[i, j] = x
        good = good & (square > least)
        if no_lane(good):
            return good
        R[i, i] = 1.0 / square
    for i in range(rows - 1, -1, -1):
        mu[i] *= R[i, i]
        for j in range(i + 1, rows):
            mu[i] -= R[j, i] * mu[j]
    return good


@_jit
def least_norm(g, inverse_norms, R, pivots, rank, mu):
    """Coefficients mu of the rows that `factor` left, of the least-norm x with row_i . x = -g_i; 0 beyond the rank."""
    fill(mu, 0.0)
    for k in range(rank):
        row = pivots[k]
        value = -g[row] * inverse_norms[row]
        for q in range(k):
            value -= R[q, row] * mu[pivots[q]]
        mu[row] = value * R[k, row]


@_jit_inline
def newton_matrix_solve(rows, g, Q, pivots, rank, inner, mu):
    """Add to mu the Newton step of (rows . Q) step = -g, on the rows that the first factorisation chose."""
    matrix = inner.matrix[:rank, :rank]
    for k in range(rank):
        for q in range(rank):
            matrix[k, q] = dot(rows[pivots[k]], Q[pivots[q]])
        inner.g[k] = g[pivots[k]]
    inner_rank = factor(matrix, inner.inverse_norms, inner.R, inner.pivots)
    if inner_rank < 0:
        fill(mu, np.nan)
    least_norm(inner.g, inner.inverse_norms, inner.R, inner.pivots, inner_rank, inner.mu)
    for k in range(rank):
        for q in range(rank):
            mu[pivots[q]] += inner.mu[k] * matrix[k, q]


@_jit_inline
def move_along(mu, Q, sigma, frame, y_hat, move, out):
    """Move = (1 - S (C S)^-1 C) sigma * (Q^T mu), the correction, neutral to the frame; out = y_hat + move."""
    n = out.size
    # Row by row: what the next loop reads was then written in pieces as long as those that it reads.
    first = Q[0]
    for j in range(n):
        out[j] = mu[0] * first[j]
    for k in range(1, mu.size):
        row = Q[k]
        for j in range(n):
            out[j] += mu[k] * row[j]
    if frame.products.size > 0:
        for j in range(n):
            out[j] *= sigma[j]
        keep_frame(out, frame, move)
        for j in range(n):
            out[j] = y_hat[j] + move[j]
    else:
        for j in range(n):
            x = sigma[j] * out[j]
            move[j] = x
            out[j] = y_hat[j] + x


@_jit_inline
def first_move(G, sigma, frame, Q, inverse_norms, R, pivots, g, mu, y_hat, move, out, more):
    """The whole first Newton step along the gradients at y_hat: out = y_hat + move; returns the rank.

    `more`: other steps follow, for which the directions in Q must be orthonormal.
    """
    weigh_rows(G, sigma, frame, Q)
    rank = Q.shape[0]
    if more or not solve_gram(Q, g, R, mu):
        rank = factor(Q, inverse_norms, R, pivots)
        least_norm(g, inverse_norms, R, pivots, rank, mu)
    if rank >= 0:
        move_along(mu, Q, sigma, frame, y_hat, move, out)
    return rank


@_jit_inline
def weighted_move(
    weigh, largest_error, err, rounding, y, y_hat, rtol, atol, groups, kappa, sigma, scale, ratio,
    G, frame, Q, inverse_norms, R, pivots, g, mu, move, out, more,
):  # fmt: skip
    """`error_metric` if `weigh`, `first_move`, `correction_in_local_errors`: from Python each call takes its time."""
    if weigh:
        largest_error = error_metric(err, rounding, y, y_hat, rtol, atol, groups, kappa, sigma, scale, ratio)
    rank = first_move(G, sigma, frame, Q, inverse_norms, R, pivots, g, mu, y_hat, move, out, more)
    return largest_error, rank, correction_in_local_errors(move, scale, groups, largest_error)


@_jit
def add_products(rows, a, out):
    """out[i] += rows[i] . a."""
    for i in range(out.size):
        out[i] += dot(rows[i], a)


@_jit
def judge(values, target, before, band, y, defect, trust, per_band, limit):
    """Note the defects after a projection; OK or FAILED_PROJECTION.

    It has failed where something is not finite, or a defect has grown and stands above FAILURE_BANDS dead bands, or it
    is more than `limit` times the terms of its invariant.
    """
    good = all_finite(y) & defects_held(values, target, before, band, defect)
    return OK if good and small_shares(defect, band, trust, per_band, limit) else FAILED_PROJECTION


@_jit
def defects_held(values, target, before, band, defect):
    """Note the defects; whether all are finite and none has grown beyond what round-off explains."""
    good = True
    for i in range(defect.size):
        defect[i] = values[i] - target[i]
        size = abs(defect[i])
        grown = (size > abs(before[i])) & (size > FAILURE_BANDS * band[i])
        good = good & (size < np.inf) & is_not(grown)
    return good


@_jit
def start_figures(values, target, scales, G, y, f, tau, trust):
    """The first figures of a run: its invariants' terms; those that vanish at the start, as they are a step later."""
    for i in range(target.size):
        terms = max(max(abs(values[i]), abs(target[i])), max(scales[i], abs_dot(G[i], y)))
        terms = max(terms, tau * abs_dot(G[i], f))
        for k in range(trust.shape[1]):
            trust[i, k] = 0.0
        trust[i, LEFT] = values[i] - target[i]
        trust[i, START] = terms if terms < np.inf else 0.0
        trust[i, TERMS] = terms if terms > 0.0 else np.inf


@_jit
def own_terms(band, per_band, trust, i):
    """Terms of invariant i to measure a defect by: those now, at most the largest of a state that was on the manifold.

    A state that blows up carries terms as large as its defect. TINY, for what underflows.
    """
    return min(max(per_band * band[i], LEAST_SHARE * trust[i, START]), trust[i, TERMS]) + TINY


@_jit
def small_shares(defect, band, trust, per_band, limit):
    """Whether no defect is more than `limit` times its invariant's terms."""
    good = True
    for i in range(defect.size):
        good = good & (abs(defect[i]) <= limit * own_terms(band, per_band, trust, i))
    return good


@_jit
def note(defect, max_defect, before, band, G, err, trust, per_band, t, errors, rounding):
    """What an accepted projection leaves: its defects, and whether the errors of the steps explain its corrections.

    An invariant's local errors since the last projection are worth ``errors sum_k |G_k err_k|``, their rounding
    `rounding` times its terms; with ``errors = 0`` nothing is known of them. Returns how many invariants stand out.
    """
    found = 0
    for i in range(defect.size):
        size = abs(defect[i])
        max_defect[i] = max(max_defect[i], size)
        terms = per_band * band[i]
        own = own_terms(band, per_band, trust, i)
        trust[i, NOTED] += 1.0
        if abs(before[i]) > FAR * own:
            found += note_share(abs(before[i]) / own, t, trust[i], RAW, RAW_AT)
            trust[i, RAW_MANY] += 1.0
        if size > LARGE_SHARE * own:
            found += note_share(size / own, t, trust[i], SHARE, SHARE_AT)
        else:
            known = trust[i, TERMS] if trust[i, TERMS] < np.inf else 0.0
            trust[i, TERMS] = max(known, terms)
        # An estimate that vanishes tells nothing: that of RK4 does where f depends on t alone.
        local = abs_dot(G[i], err) if errors > 0.0 else 0.0
        if local > 0.0:
            expected = errors * local + rounding * terms + TINY
            found += weigh_change(abs(before[i] - trust[i, LEFT]), expected, t, trust[i])
        trust[i, LEFT] = defect[i]
    return found


@_jit
def note_share(share, t, trust, largest_so_far, at):
    """A defect that is large beside its invariant's terms."""
    if share > trust[largest_so_far]:
        trust[largest_so_far] = share
        trust[at] = t
    return 1


@_jit_inline
def weigh_change(size, expected, t, trust):
    """What an invariant changed by since its last projection beside what the steps' errors explain; 1 if LARGE."""
    trust[JUDGED] += 1.0
    trust[SUM] += size
    trust[EXPECTED] += expected
    if size > trust[NU] * expected:
        trust[NU] = size / expected
        trust[AT] = t
    if size > LARGE * expected:
        if trust[MANY] == 0.0:
            trust[FIRST] = t
        trust[MANY] += 1.0
        return 1
    return 0


@_jit
def trapezoid_error(y, y_hat, h, f, f_hat, err):
    """err = y_hat - y - h (f + f_hat) / 2: the size of the local error for orders 1 and 2, above it for others."""
    for i in range(err.size):
        err[i] = y_hat[i] - y[i] - 0.5 * h * (f[i] + f_hat[i])


@_jit
def estimate(weights, K, scale, err, y, y_hat, rtol, atol, width, wanted):
    """`weighted_sum` into err, and its `error_norm` if `wanted`: from Python each call takes its time."""
    weighted_sum(weights, K, 0, scale, err)
    return error_norm(err, y, y_hat, rtol, atol, width) if wanted else 0.0


@_jit
def least_step(t, sign):
    """SciPy's: ten spacings of the numbers at t."""
    return 10.0 * abs(np.nextafter(t, sign * np.inf) - t)


@_jit
def raise_to(sizes, record):
    """Record = the larger of itself and |sizes|, by component."""
    for i in range(record.size):
        record[i] = max(record[i], abs(sizes[i]))


@_jit
def midpoint(a, b, out):
    """out = (a + b) / 2."""
    for i in range(a.size):
        out[i] = 0.5 * (a[i] + b[i])


@_jit
def relative_square(a, i, y, y_hat, rtol, atol, width):
    """Square of component i of a in units of atol + rtol max(|y|, |y_hat|), and 1 for it in a complex state too."""
    if width == 1:
        size = max(abs(y[i]), abs(y_hat[i]))
        part = abs(a[i])
    else:
        size = max(np.hypot(y[2 * i], y[2 * i + 1]), np.hypot(y_hat[2 * i], y_hat[2 * i + 1]))
        part = np.hypot(a[2 * i], a[2 * i + 1])
    scale = atol[i] + rtol[width * i] * size
    if scale == 0.0:
        return 0.0 if part == 0.0 else np.inf
    ratio = part / scale
    return ratio * ratio


@_jit
def error_norm(err, y, y_hat, rtol, atol, width):
    """SciPy's norm of the error: root mean square in units of the tolerance."""
    n = atol.size
    total = 0.0
    for i in range(n):
        total += relative_square(err, i, y, y_hat, rtol, atol, width)
    return sqrt(total / n)


@_jit
def paired_error_norm(err, low, y, y_hat, rtol, atol, width):
    """The same for DOP853's pair of estimates; then err <- err |err| / hypot(err, low / 10), by component."""
    n = atol.size
    fine = coarse = 0.0
    for i in range(n):
        fine += relative_square(err, i, y, y_hat, rtol, atol, width)
        coarse += relative_square(low, i, y, y_hat, rtol, atol, width)
    for i in range(n):
        if width == 1:
            a, b = abs(err[i]), abs(low[i])
        else:
            a = np.hypot(err[2 * i], err[2 * i + 1])
            b = np.hypot(low[2 * i], low[2 * i + 1])
        factor = a / np.hypot(a, 0.1 * b) if a > 0.0 else 0.0
        for part in range(width):
            err[width * i + part] *= factor
    if fine == 0.0 and coarse == 0.0:
        return 0.0
    return fine / sqrt((fine + 0.01 * coarse) * n)


@_jit
def tells_more(err, G, y):
    """Whether the errors gathered make some invariant more uncertain than NOISE_BANDS roundings of its terms."""
    for i in range(G.shape[0]):
        error = noise = 0.0
        for j in range(y.size):
            x = err[j] * G[i, j]
            error += x * x
            noise += abs(G[i, j] * y[j])
        if sqrt(error) > NOISE_BANDS * EPS * noise:
            return True
    return False


@_jit
def crossed(g, g_new, direction):
    """Whether an event changes its sign in the direction that it looks at."""
    for i in range(g.size):
        if g[i] <= 0.0 <= g_new[i] and direction[i] >= 0.0:
            return True
        if g[i] >= 0.0 >= g_new[i] and direction[i] <= 0.0:
            return True
    return False


@_jit
def shared_defects(before, inverse_norms, shared):
    """Per row, twice the defects of all rows in its own unit: what a projection of lower rank may move between them.

    Twice, because what one row loses to second order another may gain.
    """
    total = 0.0
    for i in range(before.size):
        total += abs(before[i]) * inverse_norms[i]
    for i in range(before.size):
        shared[i] = 2.0 * total / inverse_norms[i] if inverse_norms[i] > 0.0 else abs(before[i])
