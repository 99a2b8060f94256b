"""The array kernels one by one, against exact fractions, NumPy, SciPy and their formulas."""

import math
from fractions import Fraction

import numpy as np
import pytest

from eip_scipy.core.blocks import blocks_of
from eip_scipy.core.frame import frame_rows
from eip_scipy.engine import kernels as kn
from eip_scipy.engine.data import make_inner
from eip_scipy.engine.trust import N_FIGURES, TERMS

EPS = np.finfo(float).eps
RNG = np.random.default_rng


@pytest.fixture(autouse=True)
def quiet():
    """Plain Python warns where compiled code is silent."""
    with np.errstate(all="ignore"):
        yield


def exact(x):
    return [Fraction(float(value)) for value in x]


def grouping(blocks, n, width=1):
    return blocks_of(blocks, n, width)


# Norms and finiteness.


@pytest.mark.parametrize("unit", [1.0, 1e-170, 1e170, 1e-307])
def test_norm(unit):
    """Also where the squares vanish or overflow."""
    a = np.array([3.0, -4.0, 12.0])
    assert kn.norm(a * unit) == pytest.approx(13.0 * unit, rel=4 * EPS)


def test_norm_of_nothing_and_of_what_is_not_finite():
    assert kn.norm(np.zeros(3)) == 0.0
    for bad in (math.inf, -math.inf, math.nan):
        assert not math.isfinite(kn.norm(np.array([1.0, bad])))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 7, 9])
def test_all_finite(bad, place):
    a = np.full(10, 1e300)  # the sum of squares overflows
    assert kn.all_finite(a)
    a[place] = bad
    assert not kn.all_finite(a)
    a[:] = 1.0
    assert kn.all_finite(a)
    a[place] = bad
    assert not kn.all_finite(a)


# Weighted sums.


def test_combine_takes_the_first_stages_and_skips_zero_weights():
    y, K = RNG(1).standard_normal(5), RNG(2).standard_normal((4, 5))
    K[1], K[3] = math.nan, math.nan
    out = np.empty(5)
    kn.combine(y, 0.25, np.array([0.5, 0.0, -2.0, 1.0]), K, 3, out)
    np.testing.assert_allclose(out, y + 0.25 * (0.5 * K[0] - 2.0 * K[2]), rtol=4 * EPS)
    kn.combine(y, 0.25, np.zeros(4), K, 4, out)
    np.testing.assert_array_equal(out, y)


def test_weighted_sum_of_a_part_of_the_rows():
    K, out = RNG(3).standard_normal((3, 6)), np.full(2, math.nan)
    K[1] = math.nan
    kn.weighted_sum(np.array([2.0, 0.0, -1.0]), K, 3, 0.5, out)
    np.testing.assert_allclose(out, 0.5 * (2.0 * K[0, 3:5] - K[2, 3:5]), rtol=4 * EPS)


def test_nystrom_sums_take_weights_of_one_and_skip_those_of_zero():
    """q + c h v + h^2 (a_0 - a_2) of the first three rows, v + h (a_0 - a_2 + a_3) of four; dyadic, so exact."""
    y, h, weights = np.array([1.0, 2.0, 3.0, 5.0]), 0.5, np.array([1.0, 0.0, -1.0, 1.0])
    K, out = np.full((4, 4), math.nan), np.full(4, math.nan)
    K[[0, 2, 3], 2:] = [[4.0, 8.0], [16.0, -8.0], [2.0, 32.0]]
    kn.nystrom_position(y, h, 0.25, weights, K, 3, out)
    np.testing.assert_array_equal(out, [1 + 0.125 * 3 + 0.25 * -12, 2 + 0.125 * 5 + 0.25 * 16, math.nan, math.nan])
    kn.nystrom_velocity(y, h, weights, K, 4, out)
    np.testing.assert_array_equal(out[2:], [3 + 0.5 * -10, 5 + 0.5 * 48])


# Compensated arithmetic: exact, or to the square of a rounding.


@pytest.mark.parametrize("pair", [(1.0, 2.0**-60), (2.0**-60, 1.0), (0.1, -0.3), (1e16, 1.1), (-1e300, 1e280)])
def test_sum_and_what_it_lost(pair):
    s, lost = kn.two_sum(*pair)
    assert s == sum(pair)
    assert sum(exact([s, lost])) == sum(exact(pair))


@pytest.mark.parametrize("pair", [(0.1, 0.3), (1 + 2.0**-30, 1 - 2.0**-31), (-1 / 3, 3e8), (1e-3, math.pi)])
def test_product_and_what_it_lost(pair):
    p, lost = kn.two_product(*pair)
    assert p == pair[0] * pair[1]
    assert sum(exact([p, lost])) == math.prod(exact(pair))


def test_products_of_numbers_with_all_their_bits():
    for a, b in RNG(16).standard_normal((300, 2)):
        assert sum(exact(kn.two_product(a, b))) == Fraction(a) * Fraction(b)


def test_compensated_step_is_rounded_once_to_two_doubles():
    rng = RNG(4)
    y, K = rng.standard_normal(6), rng.standard_normal((3, 6))
    carry, h = 1e-17 * rng.standard_normal(6), 0.1
    weights, low = np.array([1 / 3, 0.0, 1 / 7]), np.array([1e-17, 0.0, -3e-18])
    out, rest = np.empty(6), np.empty(6)
    kn.compensated_step(y, carry, h, weights, low, K, out, rest)
    both = [w + v for w, v in zip(exact(weights), exact(low), strict=True)]
    for i in range(6):
        slope = sum(w * k for w, k in zip(both, exact(K[:, i]), strict=True))
        expected = Fraction(y[i]) + Fraction(carry[i]) + Fraction(h) * slope
        # The sum over the stages is a plain one: half a rounding of h * slope for each.
        assert abs(sum(exact([out[i], rest[i]])) - expected) <= 3 * EPS * h * max(abs(K[:, i]))
        assert abs(rest[i]) <= 0.5 * EPS * abs(out[i])


def test_compensated_step_loses_nothing_of_a_small_increment():
    """One stage: only the product h K is left to round, and that is carried."""
    y, carry, K = np.array([1.0]), np.array([2.0**-58]), np.array([[1 / 3]])
    out, rest = np.empty(1), np.empty(1)
    h, low = 0.1 * 2.0**-40, 2.0**-56
    kn.compensated_step(y, carry, h, np.array([1.0]), np.array([low]), K, out, rest)
    expected = 1 + Fraction(2) ** -58 + Fraction(h) * Fraction(1 / 3) * (1 + Fraction(low))
    assert abs(sum(exact([out[0], rest[0]])) - expected) < 2.0**-106


def test_compensated_nystrom_step():
    """To the square of a rounding but for the sums over the stages, which are plain."""
    rng = RNG(14)
    y, K = rng.standard_normal(4), rng.standard_normal((2, 4))
    carry, h = 1e-17 * rng.standard_normal(4), 0.1
    b, b_v = np.array([0.0, 0.3]), np.array([0.7, 0.0])
    b_low, b_v_low = np.array([0.0, 1e-17]), np.array([-2e-17, 0.0])
    out, rest = np.empty(4), np.empty(4)
    kn.compensated_nystrom(y, carry, h, b, b_low, b_v, b_v_low, K, out, rest)
    q, v = (np.array(exact(part)) for part in (y[:2], y[2:]))
    dq, dv = (np.array(exact(part)) for part in (carry[:2], carry[2:]))
    a, step = (np.array(exact(row[2:])) for row in K), Fraction(h)
    first, second = a
    weight, weight_v = Fraction(0.3) + Fraction(1e-17), Fraction(0.7) - Fraction(2e-17)
    place = q + dq + step * (v + dv) + step**2 * weight * second
    speed = v + dv + step * weight_v * first
    found = [Fraction(x) + Fraction(r) for x, r in zip(out, rest, strict=True)]
    # Each sum over the stages is one product, rounded once.
    bounds = EPS * np.abs(np.concatenate([h * h * 0.3 * K[1, 2:], h * 0.7 * K[0, 2:]]))
    assert (np.abs(np.array(found) - np.concatenate([place, speed])) <= bounds).all()
    assert (np.abs(rest) <= 0.5 * EPS * np.abs(out)).all()


@pytest.mark.parametrize("places", [(30, 20), (1, 40)])
def test_compensated_nystrom_step_carries_every_rounding(places):
    """Weights and accelerations that are powers of two: nothing but the carried products is rounded."""
    up, down = (2.0**-k for k in places)
    y, carry = np.array([1.0, 1 / 3]), np.array([2.0**-57, -(2.0**-59)])
    K, h, low = np.array([[0.0, up]]), 0.1 * down, np.array([2.0**-56])
    out, rest = np.empty(2), np.empty(2)
    kn.compensated_nystrom(y, carry, h, np.array([0.5]), low, np.array([1.0]), low, K, out, rest)
    q, v, dq, dv, step, a, more = map(Fraction, (*y, *carry, h, up, low[0]))
    place = q + dq + step * (v + dv) + step**2 * a * (Fraction(1, 2) + more)
    speed = v + dv + step * a * (1 + more)
    for x, r, wanted in zip(out, rest, (place, speed), strict=True):
        assert abs(Fraction(x) + Fraction(r) - wanted) < 2.0**-106


def test_compensated_add():
    y, carry = np.array([1.0, -3.0]), np.array([2.0**-55, 2.0**-57])
    move = np.array([2.0**-54, 1.0 + 2.0**-52])
    expected = [sum(exact(parts)) for parts in zip(y, carry, move, strict=True)]
    kn.compensated_add(y, carry, move)
    assert [sum(exact(parts)) for parts in zip(y, carry, strict=True)] == expected
    assert (np.abs(carry) <= EPS * np.abs(y)).all()


@pytest.mark.parametrize("unit", [1.0, 1e-160, 1e160])
def test_quadrature(unit):
    a, b, out = np.array([3.0, 0.0, -5.0]) * unit, np.array([4.0, 0.0, 12.0]) * unit, np.empty(3)
    kn.quadrature(a, b, out)
    np.testing.assert_allclose(out, np.array([5.0, 0.0, 13.0]) * unit, rtol=2 * EPS)


@pytest.mark.parametrize("unit", [1e-160, 1e160])
def test_quadrature_with_one_component_whose_square_does_not_fit(unit):
    out = np.empty(2)
    kn.quadrature(np.array([3.0 * unit, -5.0]), np.array([4.0 * unit, 12.0]), out)
    np.testing.assert_allclose(out, [5.0 * unit, 13.0], rtol=2 * EPS)


@pytest.mark.parametrize("exponent", [1.25, 1.125, 1.5, 2.0, 2.25, 2.5])
def test_powers(exponent):
    x = np.array([0.0, 1e-200, 1e-5, 0.3, 1.0])
    expected = x**exponent
    kn.powers(x, exponent)
    np.testing.assert_allclose(x, expected, rtol=4 * EPS)


# Blocks: the weights' softening, corrections in local errors.

BLOCKS = {
    "components": (None, [[0], [1], [2], [3], [4], [5]]),
    "threes": (3, [[0, 1, 2], [3, 4, 5]]),
    "twos": (2, [[0, 1], [2, 3], [4, 5]]),
    "lists": ([[0, 5], [3]], [[0, 5], [3], [1], [2], [4]]),
}


@pytest.mark.parametrize("layout", BLOCKS)
def test_correction_in_local_errors(layout):
    blocks, lists = BLOCKS[layout]
    move, scale = RNG(5).standard_normal(6), RNG(6).uniform(0.1, 1.0, len(lists))
    sizes = np.array([np.linalg.norm(move[b]) for b in lists])
    found = kn.correction_in_local_errors(move, scale, grouping(blocks, 6), 0.3)
    assert found == pytest.approx((sizes / scale).max() / 0.3, rel=8 * EPS)
    scale[np.argmax(sizes / scale)] = 0.0  # such a block has no unit
    expected = max(size / unit for size, unit in zip(sizes, scale, strict=True) if unit) / 0.3
    assert kn.correction_in_local_errors(move, scale, grouping(blocks, 6), 0.3) == pytest.approx(expected, rel=8 * EPS)


def test_correction_is_none_where_there_is_no_error_or_no_scale():
    groups, move = grouping(None, 2), np.array([3.0, 4.0])
    assert kn.correction_in_local_errors(move, np.ones(2), groups, 0.0) == 0.0
    assert kn.correction_in_local_errors(move, np.zeros(2), groups, 0.5) == 0.0


@pytest.mark.parametrize("layout", BLOCKS)
def test_softening_is_half_way_on_a_log_scale(layout):
    blocks, lists = BLOCKS[layout]
    rng = RNG(7)
    err, scale = rng.standard_normal(6), rng.uniform(0.1, 1.0, len(lists))
    sigma = np.empty(6)
    for b in lists:
        sigma[b] = rng.uniform(0.1, 1.0)
    err[lists[0]], scale[-1] = 0.0, 0.0
    expected = sigma.copy()
    for b, unit in list(zip(lists, scale, strict=True))[1:-1]:
        expected[b] = np.sqrt(sigma[b] * unit / scale.max())
    kn.soften(err, scale, grouping(blocks, 6), sigma)
    np.testing.assert_allclose(sigma, expected, rtol=4 * EPS)


def test_softening_tends_to_equal_relative_errors():
    err, scale, sigma = np.ones(3), np.array([0.5, 1.0, 0.25]), np.array([1e-7, 1.0, 1e-3])
    for _ in range(60):
        kn.soften(err, scale, grouping(None, 3), sigma)
    np.testing.assert_allclose(sigma, scale, rtol=1e-12)


def by_block(lists, x):
    """The blocks' lengths, without overflow."""
    return np.array([math.hypot(*x[b]) for b in lists])


@pytest.mark.parametrize("rounding", [0.0, 2.0**-10])
@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-160, 1e-160), (1e160, 1e160), (1e-160, 1.0), (1e160, 1.0)])
@pytest.mark.parametrize("layout", BLOCKS)
def test_error_metric(layout, units, rounding):
    """Weights, scales and the largest relative error by their formulas; also where squares vanish or overflow.

    The first block may stand alone with that.
    """
    blocks, lists = BLOCKS[layout]
    rng, unit = RNG(15), np.full(6, units[1])
    unit[lists[0]] = units[0]
    y, y_hat, err = rng.standard_normal((3, 6)) * [[1.0], [1.0], [1e-3]] * unit
    rtol, atol = rng.uniform(1e-6, 1e-3, 6), rng.uniform(1e-6, 1e-4, len(lists)) * [unit[b[0]] for b in lists]
    sigma, scale, ratio = np.full(6, math.nan), np.empty(len(lists)), np.empty(len(lists))
    largest = kn.error_metric(err, rounding, y, y_hat, rtol, atol, grouping(blocks, 6), 1.25, sigma, scale, ratio)
    sizes = atol + np.maximum(by_block(lists, rtol * y), by_block(lists, rtol * y_hat))
    relative = by_block(lists, np.hypot(err, rounding * y_hat)) / sizes
    weights = sizes * ((relative / relative.max()) ** 1.25 + 1e-7)
    np.testing.assert_allclose(scale, sizes, rtol=8 * EPS)
    assert largest == pytest.approx(relative.max(), rel=16 * EPS)
    for b, weight in zip(lists, weights / weights.max(), strict=True):
        np.testing.assert_allclose(sigma[b], weight, rtol=32 * EPS)


def test_error_metric_of_a_block_that_is_nothing():
    """Without size, tolerance or error it has no weight, and the others' are theirs."""
    y, err, rtol = np.array([0.0, 2.0]), np.array([0.0, 1e-3]), np.full(2, 0.5)
    sigma, scale, ratio = (np.full(2, math.nan) for _ in range(3))
    assert kn.error_metric(err, 0.0, y, y, rtol, np.zeros(2), grouping(None, 2), 1.25, sigma, scale, ratio) == 1e-3
    np.testing.assert_array_equal(scale, [0.0, 1.0])
    np.testing.assert_array_equal(sigma, [0.0, 1.0])


# Orthogonal directions, ranks, least norms.


def factored(rows):
    B = np.array(rows, dtype=float)
    size = len(B)
    norms, R, pivots = np.full(size, math.nan), np.full((size, size), math.nan), np.empty(size, np.int64)
    rank = kn.factor(B, norms, R, pivots)
    return rank, B, norms, R, pivots


def test_factorisation_is_a_pivoted_qr():
    rows = RNG(8).standard_normal((4, 9)) * np.array([[1.0], [1e6], [1e-6], [1.0]])
    rank, Q, norms, R, pivots = factored(rows)
    assert rank == 4
    assert sorted(pivots) == [0, 1, 2, 3]
    directions = Q[pivots]
    np.testing.assert_allclose(directions @ directions.T, np.eye(4), atol=4 * EPS)
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    np.testing.assert_allclose(norms, 1 / np.linalg.norm(rows, axis=1), rtol=4 * EPS)
    parts = unit @ directions.T
    left = []
    for k, row in enumerate(pivots):
        np.testing.assert_allclose(R[:k, row], parts[row, :k], atol=4 * EPS)
        assert R[k, row] == pytest.approx(1 / parts[row, k], rel=1e-13)
        rest = np.sqrt(np.maximum(1 - (parts[pivots[k:], :k] ** 2).sum(axis=1), 0))
        assert rest[0] == pytest.approx(rest.max())  # the longest that is left comes next
        left.append(rest[0])
    assert left == sorted(left, reverse=True)


def test_zero_rows_are_never_chosen():
    rank, _, norms, _, pivots = factored([[0, 0, 0], [0, 0, 0], [0, 2, 0], [0, 0, 0], [3, 0, 0]])
    assert rank == 2
    assert sorted(pivots[:2]) == [2, 4]
    np.testing.assert_array_equal(norms, [0, 0, 0.5, 0, 1 / 3])
    assert factored(np.zeros((3, 2)))[0] == 0
    assert factored(np.zeros((0, 2)))[0] == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_rows_that_are_not_finite(bad):
    assert factored([[1.0, 2.0], [bad, 1.0]])[0] == -1


@pytest.mark.parametrize(("angle", "rank"), [(1.2e-8, 1), (1.8e-8, 2), (1e-6, 2)])
def test_rank_of_nearly_parallel_rows(angle, rank):
    """Dependent below the root of a rounding, 1.5e-8."""
    first = np.array([0.6, 0.8, 0.0])
    found, Q, _, _, pivots = factored([first, first + angle * np.array([0.0, 0.0, 1.0])])
    assert found == rank
    if rank == 2:
        assert abs(Q[pivots[0]] @ Q[pivots[1]]) < 4 * EPS


@pytest.mark.parametrize("angle", [1e-1, 4e-2, 1e-3, 1e-6])
def test_second_pass_where_the_first_would_have_cancelled(angle):
    """Directions and components stay good when rows stand at small angles to the plane of two others."""
    rng = RNG(9)
    basis = np.linalg.qr(rng.standard_normal((8, 8)))[0][:3]
    rows = np.array([basis[0], 0.6 * basis[0] + 0.8 * basis[1], basis[:2].sum(axis=0) + angle * basis[2]])
    rank, Q, _, R, pivots = factored(rows)
    assert rank == 3
    directions = Q[pivots]
    assert np.abs(directions @ directions.T - np.eye(3)).max() < (4e-16 if angle < 0.05 else 1e-14)
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    last = pivots[2]
    np.testing.assert_allclose(R[:2, last], directions[:2] @ unit[last], atol=4 * EPS)


def least_norm(rows, g):
    """The smallest x with rows @ x = -g, in fractions: rounded once, on every machine."""
    R = [exact(row) for row in rows]
    system = [
        [sum(a * b for a, b in zip(r, q, strict=True)) for q in R] + [-y] for r, y in zip(R, exact(g), strict=True)
    ]
    for i, pivot in enumerate(system):
        pivot[:] = [a / pivot[i] for a in pivot]
        for row in system[:i] + system[i + 1 :]:
            row[:] = [a - row[i] * b for a, b in zip(row, pivot, strict=True)]
    return np.array(
        [float(sum(m[-1] * a for m, a in zip(system, column, strict=True))) for column in zip(*R, strict=True)]
    )


def condition(rows):
    """Of the rows in units of their own."""
    return np.linalg.cond(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def test_least_norm_solution():
    rng = RNG(10)
    rows, g = rng.standard_normal((3, 7)) * [[1.0], [50.0], [0.1]], rng.standard_normal(3)
    rank, Q, norms, R, pivots = factored(rows)
    mu = np.full(3, math.nan)
    kn.least_norm(g, norms, R, pivots, rank, mu)
    expected = least_norm(rows, g)
    np.testing.assert_allclose(mu @ Q, expected, rtol=0, atol=10 * EPS * condition(rows) * np.abs(expected).max())


def gram(rows, g):
    size = len(rows)
    mu = np.full(size, math.nan)
    done = kn.solve_gram(np.array(rows), g, np.empty((size, size)), mu)
    return done, mu


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_gram_solution(size):
    rng = RNG(size)
    rows, g = rng.standard_normal((size, 9)) * 10.0 ** rng.integers(-5, 5, (size, 1)), rng.standard_normal(size)
    done, mu = gram(rows, g)
    assert done
    expected = least_norm(rows, g)
    atol = 10 * EPS * condition(rows) ** 2 * np.abs(expected).max()  # squared, as by any Gram matrix
    np.testing.assert_allclose(mu @ rows, expected, rtol=0, atol=atol)


@pytest.mark.parametrize(("angle", "done"), [(0.049, False), (0.051, True), (0.0, False)])
def test_gram_solution_is_refused_where_rows_are_nearly_dependent(angle, done):
    rows = np.array([[3.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.8, angle]])
    assert gram(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.ones(3))[0] == done


@pytest.mark.parametrize("length", [0.0, 1e-71, 1e71, math.nan, math.inf])
def test_gram_solution_is_refused_where_squares_do_not_fit(length):
    assert not gram([[1.0, 0.0], [0.0, length]], np.ones(2))[0]


# The small systems of further Newton steps.


def newton(rows, directions, g, start):
    size = len(rows)
    mu = np.array(start, dtype=float)
    kn.newton_matrix_solve(
        np.array(rows), g, np.array(directions), np.arange(size)[::-1].copy(), size, make_inner(size), mu
    )
    return mu


def test_newton_step_is_added():
    rng = RNG(11)
    rows, directions, g = rng.standard_normal((3, 6)), rng.standard_normal((3, 6)), rng.standard_normal(3)
    found = newton(rows, directions, g, [1.0, 2.0, 3.0])
    expected = np.linalg.solve(rows @ directions.T, -g)
    np.testing.assert_allclose(found, [1.0, 2.0, 3.0] + expected, rtol=1e-11)


def test_newton_step_of_dependent_rows_is_the_smallest():
    rows = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    directions, g = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([0.5, 0.5])
    found = newton(rows, directions, g, [0.0, 0.0])
    np.testing.assert_allclose(found, np.linalg.lstsq(rows @ directions.T, -g, rcond=None)[0], rtol=1e-13)


def test_newton_step_of_rows_that_are_not_finite():
    assert np.isnan(newton([[math.nan, 1.0]], [[1.0, 0.0]], np.array([1.0]), [0.0])).all()


def test_newton_step_where_no_row_sees_a_direction():
    """Zero gradients along the directions: the multipliers stay."""
    np.testing.assert_array_equal(newton([[0.0, 1.0]], [[1.0, 0.0]], np.array([1.0]), [2.0]), [2.0])


# Frames.

PAIR = (np.kron(np.eye(2), [[1.0, 3.0]]), np.kron(np.eye(2), [[1.0], [1.0]]))
BODIES = (np.kron([[2.0, 1.0, 5.0]], np.eye(3)), np.kron([[1.0], [1.0], [1.0]], np.eye(3)))


@pytest.mark.parametrize("frame", [PAIR, BODIES], ids=["rows", "spatial"])
def test_frame_is_a_projector_on_rows_and_moves(frame):
    C, S = frame
    n = C.shape[1]
    P = np.eye(n) - S @ np.linalg.solve(C @ S, C)
    rng = RNG(12)
    rows, G, sigma = frame_rows(frame, n, 1), rng.standard_normal((2, n)), rng.uniform(0.1, 1.0, n)
    B = np.empty((2, n))
    kn.weigh_rows(G, sigma, rows, B)
    np.testing.assert_allclose(B, G @ P * sigma, atol=8 * EPS)
    mu, y_hat, move, out = rng.standard_normal(2), rng.standard_normal(n), np.empty(n), np.empty(n)
    kn.move_along(mu, B, sigma, rows, y_hat, move, out)
    np.testing.assert_allclose(move, P @ (sigma * (mu @ B)), atol=1e-14)
    np.testing.assert_array_equal(out, y_hat + move)
    np.testing.assert_allclose(C @ move, 0, atol=1e-14)


def test_no_directions_no_move():
    move, out = np.full(2, math.nan), np.empty(2)
    free = frame_rows(None, 2, 1)
    kn.move_along(np.zeros(2), np.ones((2, 2)), np.ones(2), free, np.array([1.0, 2.0]), move, out)
    np.testing.assert_array_equal(move, 0.0)
    np.testing.assert_array_equal(out, [1.0, 2.0])


# Verdicts.


def verdict(value, before, y=0.0):
    defect, band = np.empty(2), np.full(2, 2.0**-10)
    values, target = np.array([value, 5.0]), np.array([3.0, 5.0])
    trust = np.zeros((2, N_FIGURES))
    trust[:, TERMS] = np.inf
    status = kn.judge(values, target, np.array([before, 0.0]), band, np.array([y]), defect, trust, 1.0, np.inf)
    return status, defect[0]


@pytest.mark.parametrize(
    ("defect", "before", "good"),
    [
        (0.0625, 0.0, True),  # within 100 bands
        (100 / 1024, 0.0, True),  # neither above them
        (0.25, 0.375, True),  # smaller than before
        (0.25, 0.25, True),
        (-0.25, -0.375, True),
        (0.25, 0.1875, False),
        (-0.25, 0.1875, False),
        (0.25, -0.1875, False),
        (0.125, 0.0, False),
        (math.nan, 1.0, False),
        (math.inf, math.inf, False),
    ],
)
def test_a_projection_has_failed_where_a_defect_grew_beyond_a_hundred_bands(defect, before, good):
    status, noted = verdict(3.0 + defect, before)
    assert status == (kn.OK if good else kn.FAILED_PROJECTION)
    np.testing.assert_array_equal(noted, defect)


def test_a_state_that_is_not_finite_has_failed():
    assert verdict(3.0, 0.0, math.nan)[0] == kn.FAILED_PROJECTION


def test_shared_defects():
    before, norms = np.array([1.0, -2.0, 4.0]), np.array([0.5, 0.25, 0.0])
    shared = np.empty(3)
    kn.shared_defects(before, norms, shared)
    np.testing.assert_array_equal(
        shared, [4.0, 8.0, 4.0]
    )  # 2 (1/2 + 2/4), in each row's unit; a zero row keeps its own


def test_record_of_the_largest():
    record = np.array([1.0, 2.0, 0.0])
    kn.raise_to(np.array([-3.0, 1.0, 0.5]), record)
    np.testing.assert_array_equal(record, [3.0, 2.0, 0.5])


SIDES = (-1.0, 0.0, 1.0)


@pytest.mark.parametrize("before", SIDES)
@pytest.mark.parametrize("after", SIDES)
@pytest.mark.parametrize("direction", [-2.0, 0.0, 2.0])
def test_crossings_are_those_of_scipy(before, after, direction):
    """solve_ivp's find_active_events: (g <= 0) & (g_new >= 0) upwards, (g >= 0) & (g_new <= 0) downwards."""
    up, down = before <= 0 <= after, before >= 0 >= after
    expected = (up and direction > 0) or (down and direction < 0) or ((up or down) and direction == 0)
    quiet = np.array([1.0])
    for g, g_new, sides in (
        ([before], [after], [direction]),
        ([1.0, before], [1.0, after], [0.0, direction]),
    ):
        assert kn.crossed(*map(np.array, (g, g_new, sides))) == expected
    assert not kn.crossed(quiet, quiet, np.zeros(1))


# Norms of the step control.


def control(kind, n=5):
    """States, errors, tolerances, and SciPy's scale of them."""
    rng = RNG(13)
    y, y_hat, fine, coarse = rng.standard_normal((4, n)) + (1j * rng.standard_normal((4, n)) if kind is complex else 0)
    rtol, atol = rng.uniform(1e-6, 1e-2, (2, n))
    width = 2 if kind is complex else 1
    arguments = (y.view(float), y_hat.view(float), np.repeat(rtol, width), atol, width)
    return fine, coarse, arguments, atol + np.maximum(np.abs(y), np.abs(y_hat)) * rtol


@pytest.mark.parametrize("kind", [float, complex])
def test_error_norm_is_a_root_mean_square(kind):
    err, _, arguments, scale = control(kind)
    expected = np.linalg.norm(err / scale) / math.sqrt(err.size)
    assert kn.error_norm(err.view(float), *arguments) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("kind", [float, complex])
def test_paired_norm_is_that_of_dop853(kind):
    """Hairer, Norsett & Wanner I, II.10; the estimate is damped by the one of lower order as its norm is."""
    fine, coarse, arguments, scale = control(kind)
    fine[1] = 0.0
    err = fine.copy()
    found = kn.paired_error_norm(err.view(float), coarse.view(float), *arguments)
    fifth, third = (np.sum(np.abs(e / scale) ** 2) for e in (fine, coarse))
    assert found == pytest.approx(fifth / math.sqrt((fifth + 0.01 * third) * fine.size), rel=1e-13)
    np.testing.assert_allclose(err, fine * np.abs(fine) / np.hypot(np.abs(fine), 0.1 * np.abs(coarse)), rtol=1e-13)


def test_paired_norm_without_the_coarse_error():
    """It is the root mean square of the fine one then, which is not damped."""
    fine, none, one = np.array([3.0, -4.0]), np.zeros(2), np.ones(2)
    err = fine.copy()
    assert kn.paired_error_norm(err, none, none, none, none, one, 1) == pytest.approx(math.sqrt(12.5), rel=4 * EPS)
    np.testing.assert_array_equal(err, fine)


@pytest.mark.parametrize(
    ("t", "sign", "spacing"),
    [(1.0, 1.0, EPS), (1.0, -1.0, EPS / 2), (-4.0, -1.0, 4 * EPS), (-4.0, 1.0, 2 * EPS), (0.0, -1.0, 5e-324)],
)
def test_least_step_is_ten_spacings_of_the_times_ahead(t, sign, spacing):
    assert kn.least_step(t, sign) == 10 * spacing


def test_norms_where_the_tolerance_is_nothing():
    """No error over no scale is none; any error is infinitely large."""
    zero, one, none = np.zeros(2), np.array([0.0, 1.0]), np.zeros(2)
    assert kn.error_norm(zero, zero, zero, none, none, 1) == 0.0
    assert kn.error_norm(one, zero, zero, none, none, 1) == math.inf
    assert kn.paired_error_norm(zero.copy(), zero.copy(), zero, zero, none, none, 1) == 0.0


# Roundings and errors of invariants.


def test_dead_bands_and_the_defects_outside():
    values, target = np.array([1.0, 0.5, -3.0, math.inf]), np.array([1.0, 1.0, -3.0 * (1 + EPS), 1.0])
    G, y_hat = np.array([[2.0, 0.0], [0.0, 0.0], [1.0, -6.0], [1.0, 1.0]]), np.array([1.0, -1.0])
    scales = np.array([0.0, 4.0, 0.0, 0.0])
    g, band, raw = (np.full(4, math.nan) for _ in range(3))
    assert kn.defects(values, target, G, y_hat, scales, False, g, band, raw)
    np.testing.assert_array_equal(raw, values - target)
    np.testing.assert_array_equal(g, [0.0, -0.5, 0.0, math.inf])
    np.testing.assert_allclose(band[:3] / (4 * EPS), [2.0, 4.0, 7.0], rtol=4 * EPS)
    assert not kn.defects(target, target, G, y_hat, scales, False, g, band, raw)
    kn.defects(values, target, G, y_hat, scales, True, g, band, raw)
    np.testing.assert_allclose(band[:3] / EPS, [2.0, 4.0, 7.0], rtol=4 * EPS)


@pytest.mark.parametrize(("value", "target"), [(-8.0, 1.0), (1.0, -8.0), (8.0, 1.0)])
def test_dead_band_goes_with_the_size_of_value_and_target(value, target):
    g, band, raw = np.empty(1), np.empty(1), np.empty(1)
    nothing = np.zeros(1)
    assert kn.defects(np.array([value]), np.array([target]), np.zeros((1, 1)), nothing, nothing, False, g, band, raw)
    assert band[0] == 4 * EPS * 8.0
    assert g[0] == raw[0] == value - target


def test_products_are_added():
    rows, out = np.array([[1.0, 2.0], [0.0, -3.0]]), np.array([10.0, 20.0])
    kn.add_products(rows, np.array([0.5, 4.0]), out)
    np.testing.assert_array_equal(out, [18.5, 8.0])


def test_errors_tell_more_than_round_off_of_the_terms():
    """|err * G| against three roundings of sum |G_j y_j| = 5, for any of the invariants."""
    G, y = np.array([[0.0, 0.0], [3.0, -1.0]]), np.array([1.0, 2.0])
    for errors, more in (([5.1 * EPS, 0.0], True), ([4.9 * EPS, 0.0], False), ([3.6 * EPS, 10.8 * EPS], True)):
        assert kn.tells_more(np.array(errors), G, y) == more
    assert not kn.tells_more(np.zeros(2), G, y)
