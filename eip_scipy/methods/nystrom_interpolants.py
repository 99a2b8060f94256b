"""Interpolants of Nystrom methods: further stages within a step, and the polynomial through their accelerations."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from .nystrom import NystromTableau, NystromTree, _density, nystrom_trees

__all__ = ["LEAST_ORDER", "Interpolant", "interpolant"]

# Methods of lower order use the quintic through positions, velocities and accelerations at both ends.
LEAST_ORDER = 6
# Number of stages in a group that precedes the others, and how often groups are added.
GROUP, MOST_GROUPS = 6, 3
# Number of Newton iterations for a node, and their precision in bits.
ITERATIONS, BITS = 12, 120
# A condition is dependent on others if its residual relative to its size is below the first number, and met if it is
# below the second.
DEPENDENT, MET = 1e-10, 1e-11

Array = np.ndarray


class Interpolant(NamedTuple):
    """Further stages of a step, and the polynomial through the accelerations at some of them.

    The rows of accelerations are those of the stages of the method, the one at the end of the step, and those of the
    further stages, in this order. `legendre` has weights over all rows of the coefficients of the polynomial of degree
    k - 1 through the accelerations at both ends and at the last k - 2 further stages, in Legendre polynomials of
    2 theta - 1.
    """

    A: Array  # (further, rows): weights of the position of a further stage over the preceding rows
    c: Array  # (further,): nodes of the further stages
    legendre: Array  # (k, rows)


@cache
def interpolant(tableau: NystromTableau) -> Interpolant:
    """Return the interpolant of a tableau whose order p is at least `LEAST_ORDER`.

    The velocity of a step is interpolated by the integral of the polynomial through accelerations at Gauss-Lobatto
    nodes, and the position by the integral of the velocity. If the error of the position at such a node is O(h^s), the
    velocity between the nodes has an error of O(h^(s + 1)). Groups of stages at equidistant nodes are therefore
    inserted before the stages at Gauss-Lobatto nodes, until s is at least p - 1 or no further group helps.
    """
    s = tableau.n_stages - tableau.fsal
    A, c = np.zeros((s + 1, s + 1)), np.ones(s + 1)
    A[:s, :s], A[s, :s], c[:s] = tableau.A[:s, :s], tableau.b[:s], tableau.c[:s]
    nodes = _lobatto_nodes(tableau.order - 3)
    reached, weights = _stages(A, c, nodes, tableau.order)
    for k in range(1, MOST_GROUPS + 1):
        if reached >= tableau.order - 1:
            break
        group = np.arange(1, GROUP * k + 1) / (GROUP * k + 1)
        longer = _extended(A, c, group, _stages(A, c, group, tableau.order)[1])
        better, further = _stages(*longer, nodes, tableau.order)
        if better <= reached:
            break
        (A, c), reached, weights = longer, better, further
    A, c = _extended(A, c, nodes, weights)
    used = np.array([0, *range(c.size - nodes.size, c.size), s])
    legendre = np.zeros((used.size, c.size))
    legendre[:, used] = _legendre_weights(c[used])
    return Interpolant(A[s + 1 :], c[s + 1 :], legendre)


def _extended(A: Array, c: Array, nodes: Array, weights: Array) -> tuple[Array, Array]:
    """Return `A` and `c` with further stages at `nodes`, whose rows of `A` are `weights` (nodes, stages)."""
    known = c.size
    longer = np.zeros((known + nodes.size, known + nodes.size))
    longer[:known, :known], longer[known:, :known] = A, weights
    return longer, np.concatenate([c, nodes])


def _stages(A: Array, c: Array, nodes: Array, order: int) -> tuple[int, Array]:
    """Return the order of the error of positions at `nodes`, at most `order`, and the weights (nodes, stages).

    The weights meet the order conditions of all trees with up to k vertices, for the largest k for which this is
    possible at all nodes, and among such weights they have the smallest norm. The conditions are made orthonormal one
    after the other by sums over columns, because a library's solver would give other bits on another processor.
    """
    rows, met = np.zeros((c.size, 0)), np.zeros((0, nodes.size))
    power = 2
    for vertices in range(1, order - 1):
        before = rows.shape[1]
        for tree in nystrom_trees(vertices):
            factors = _stage_factors(A, c, tree)
            size = float(np.sqrt((factors * factors).sum())) or 1.0
            row, right = factors / size, nodes ** (vertices + 1) / ((vertices + 1) * _density(tree) * size)
            for _ in range(2):
                products = (rows * row[:, None]).sum(axis=0)
                row, right = row - (rows * products).sum(axis=1), right - (products[:, None] * met).sum(axis=0)
            length = float(np.sqrt((row * row).sum()))
            if length >= DEPENDENT:
                rows, met = np.column_stack([rows, row / length]), np.vstack([met, right / length])
            elif np.abs(right).max() >= MET:
                return power, _smallest(rows[:, :before], met[:before])
        power = vertices + 2
    return power, _smallest(rows, met)


def _smallest(rows: Array, met: Array) -> Array:
    """Return the weights of smallest norm (nodes, stages) that meet orthonormal conditions: weights @ rows = met.T."""
    return np.array([(rows * column).sum(axis=1) for column in met.T])


def _stage_factors(A: Array, c: Array, tree: NystromTree) -> Array:
    """Return phi_i(tree), the factor of stage i in the order condition of a tree, (s,), see `nystrom_residuals`."""
    factors = c**tree.leaves
    for sub in tree.subtrees:
        factors = factors * (A.T * _stage_factors(A, c, sub)[:, None]).sum(axis=0)
    return factors


def _lobatto_nodes(interior: int) -> Array:
    """Return the k = `interior` Gauss-Lobatto nodes inside the interval from 0 to 1, correctly rounded.

    They are the zeros of the derivative of the Legendre polynomial P_(k + 1), moved from [-1, 1] to [0, 1].
    """
    n = interior + 1
    nodes = []
    for i in range(n - 1, 0, -1):
        x = Fraction(math.cos(math.pi * i / n))
        for _ in range(ITERATIONS):
            values = _legendre(n, x)
            slope = n * (values[n - 1] - x * values[n]) / (1 - x * x)
            x -= slope * (1 - x * x) / (2 * x * slope - n * (n + 1) * values[n])
            x = Fraction(round(x * 2**BITS), 2**BITS)
        nodes.append(float((x + 1) / 2))
    return np.array(nodes)


def _legendre(degree: int, x: Any) -> list[Any]:
    """Return the Legendre polynomials of degrees 0 to `degree` at x."""
    values = [x * 0 + 1, x]
    for j in range(1, degree):
        values.append(((2 * j + 1) * x * values[j] - j * values[j - 1]) / (j + 1))
    return values


def _legendre_weights(nodes: Array) -> Array:
    """Return the weights (k, k) of Legendre coefficients over values at k Gauss-Lobatto nodes of [0, 1]."""
    k = nodes.size
    values = np.array(_legendre(k - 1, 2.0 * nodes - 1.0))
    factors = np.arange(k) + 0.5
    factors[-1] = 0.5 * (k - 1)
    return factors[:, None] * values * (2.0 / (k * (k - 1) * values[-1] ** 2))
