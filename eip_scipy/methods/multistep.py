"""Gauss-Jackson methods of any order: summed multistep methods for q'' = a(t, q) with a fixed step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from math import comb
from typing import NamedTuple

import numpy as np

from .orders import Ordered

__all__ = [
    "GaussJackson",
    "Weights",
    "damping_limit",
    "interpolation_weights",
    "longest_stable",
    "stability_limit",
    "weights",
]

LEAST_ORDER, LARGEST_ORDER = 4, 16
# Order of the difference that has the shape of the errors and is still far above rounding at small steps.
ESTIMATE = 8
# Largest growth of a mode in a step with which the method is called stable.
GROWTH = 1e-4
# Number of moments that the rounded weights must have, and the length of a step in their unit of time.
MOMENTS, STEP = 4, 1 / 16

Series = list[Fraction]


@dataclass(frozen=True, eq=False, kw_only=True)
class GaussJackson(Ordered):
    """Gauss-Jackson method of a given order in summed form, with one evaluation per step.

    With the accelerations a_n at the ends of the steps, s_n = a_n + a_(n-1) + ... and S_n = s_n + s_(n-1) + ...,
    positions and velocities are

        q_(n+1) = h^2 (S_n + sum_j P_j a_(n-j)),    v_n = h (s_n + sum_j V_j a_(n-j)),    j < order,

    so that rounding errors are those of two sums, which are stored as pairs of floats. The position is predicted, the
    acceleration is evaluated there, and it is added to both sums (PEC).

    Parameters
    ----------
    order : int
        Order from 4 to 16, which is the number of accelerations in a formula.
    corrected : bool, optional
        If True and a run has a Jacobian, each acceleration is changed by the Jacobian times the change of the position
        by the corrector: this is nearly as stable as a second evaluation, without its cost.
    name : str, optional
        Name of the method.
    velocities : bool, optional
        True if the accelerations depend on velocities, which are then predicted too. A run determines this itself.

    Raises
    ------
    ValueError
        If the order is not allowed.

    Notes
    -----
    x = 1 - E^-1 is the backward difference and L = -log(1 - x) / x; the predicted position is the series of
    L^-2 / (1 - x), the position i steps back that of L^-2 (1 - x)^i, the velocity there that of L^-1 (1 - x)^i, after
    the leading terms, which are contained in the sums. All coefficients are fractions, rounded once.

    References
    ----------
    .. [1] P. Henrici, "Discrete Variable Methods in Ordinary Differential Equations", 1962, chapters 5 and 6.
    .. [2] M. M. Berry, L. M. Healy, "Implementation of Gauss-Jackson integration for orbit propagation", J. Astronaut.
       Sci. 52 (2004) 331.
    """

    of_second_order = has_history = True

    order: int
    corrected: bool = False
    name: str = ""
    velocities: bool = False
    error_estimator_order: int | None = field(init=False)

    def __post_init__(self) -> None:
        order, known = self.order, isinstance(self.order, (int, np.integer)) and not isinstance(self.order, bool)
        if not (known and LEAST_ORDER <= order <= LARGEST_ORDER):
            raise ValueError(f"order must be an integer from {LEAST_ORDER} to {LARGEST_ORDER}, got {order!r}.")
        object.__setattr__(self, "name", self.name or f"GJ{order}")
        object.__setattr__(self, "error_estimator_order", min(ESTIMATE, order - 2))

    def __repr__(self) -> str:
        corrected = ", corrected by the Jacobian" if self.corrected else ""
        return f"<GaussJackson {self.name}: order {self.order}{corrected}>"

    @property
    def kappa(self) -> float:
        """Exponent of the error metric: (order + 2) / (order of the estimate + 2)."""
        return (self.order + 2) / (min(ESTIMATE, self.order - 2) + 2)

    @property
    def fixed_steps_only(self) -> bool:
        """True, because the estimate has the shape of the errors, but no size that could control a step."""
        return True

    @property
    def middle(self) -> int:
        """Number of steps from the centre of the history to its newest node."""
        return self.order // 2


@cache
def _inverse_powers(power: int, terms: int) -> Series:
    """Return the first `terms` coefficients of the series of L^-power in x; `GaussJackson` defines L and x."""
    inverse = [Fraction(1)]
    for k in range(1, terms):
        # The coefficients of L are 1, 1/2, 1/3 ...
        inverse.append(-sum((x / (k - j + 1) for j, x in enumerate(inverse)), Fraction(0)))
    return inverse if power == 1 else _product(inverse, _inverse_powers(power - 1, terms))


def _product(a: Series, b: Series) -> Series:
    return [sum((a[j] * b[k - j] for j in range(k + 1)), Fraction(0)) for k in range(len(a))]


def _shifted(series: Series, back: int) -> Series:
    """Return the series times (1 - x)^back, which shifts it back by `back` steps; back = -1 is one step ahead."""
    binomial = [Fraction((-1) ** k * comb(back, k) if back >= 0 else 1) for k in range(len(series))]
    return _product(series, binomial)


def _ordinates(series: Series) -> Series:
    """Return the coefficients of a_n, a_(n-1), ... for a sum over backward differences of a_n."""
    n = len(series)
    return [(-1) ** j * sum((series[k] * comb(k, j) for k in range(j, n)), Fraction(0)) for j in range(n)]


def position_series(back: int, terms: int) -> Series:
    """Return `terms` coefficients of the series in x of the position `back` steps before the newest node.

    The first two coefficients of the series, 1 and -1 - back, are left out, see `GaussJackson`.
    """
    return _shifted(_inverse_powers(2, terms + 2), back)[2:]


def velocity_series(back: int, terms: int) -> Series:
    """Return `terms` coefficients of the series in x of the velocity `back` steps before the newest node.

    The first coefficient of the series, 1, is left out, see `GaussJackson`.
    """
    return _shifted(_inverse_powers(1, terms + 1), back)[1:]


def position_weights(back: int, order: int) -> Series:
    """Return the weights of a_n, a_(n-1), ... in the position `back` steps before the newest node n."""
    return _ordinates(position_series(back, order))


def velocity_weights(back: int, order: int) -> Series:
    """Return the weights of a_n, a_(n-1), ... in the velocity `back` steps before the newest node n."""
    return _ordinates(velocity_series(back, order))


def correction_weights(order: int) -> Series:
    """Return the order + 1 weights of a_(n+1), a_n, ... in the corrected minus the predicted position at n + 1."""
    corrected = [*position_weights(0, order), Fraction(0)]
    predicted = [Fraction(0), *position_weights(-1, order)]
    return [c - p for c, p in zip(corrected, predicted, strict=True)]


class Weights(NamedTuple):
    """The weights of a method as floats, from the oldest node to the newest."""

    predict_q: np.ndarray  # (order,): of the predicted position
    predict_v: np.ndarray
    states_q: np.ndarray  # (order, order): row k for the position k steps before the newest node
    states_v: np.ndarray
    correction: np.ndarray  # (order + 1,): of the corrected minus the predicted position
    shape_q: np.ndarray  # (order + 1,): of the difference that has the shape of the errors of positions
    shape_v: np.ndarray
    size: np.ndarray  # (order + 1,): of the highest difference
    error_constant: float  # size of the first omitted term of the series of the predicted position


@cache
def weights(order: int) -> Weights:
    """Return the weights of the method of this order.

    The difference that has the shape of the errors is one order higher for velocities than for positions.
    """
    back = range(order)
    estimate = min(ESTIMATE, order - 2)

    def difference(k: int) -> np.ndarray:
        return _oldest_first([(-1) ** j * Fraction(comb(k, j)) for j in range(order + 1)])

    return Weights(
        predict_q=_balanced(position_weights(-1, order))[::-1].copy(),
        predict_v=_balanced(velocity_weights(-1, order))[::-1].copy(),
        states_q=np.array([_oldest_first(position_weights(k, order)) for k in back]),
        states_v=np.array([_oldest_first(velocity_weights(k, order)) for k in back]),
        correction=_balanced(correction_weights(order))[::-1].copy(),
        shape_q=difference(estimate),
        shape_v=difference(estimate + 1),
        size=difference(order),
        error_constant=abs(float(position_series(-1, order + 1)[order])),
    )


def _balanced(exact: Series) -> np.ndarray:
    """Round each weight to one of two neighbouring floats, so that the moments of orders 0 to 3 are kept best.

    The sum of the absolute errors of these moments of the weights is the smallest of all choices. Rounding to the
    nearest floats would change weights of 100 to 200 (order 14) by about 1e-14, by the same amounts in every step: this
    acts as a force along the motion, by which Mercury would drift by 2e-9 AU in 1000 years.
    """
    nearest = np.array([float(weight) for weight in exact])
    missed = np.array([float(weight - Fraction(rounded)) for weight, rounded in zip(exact, nearest, strict=True)])
    other = np.nextafter(nearest, np.where(missed > 0, np.inf, -np.inf))
    gap = other - nearest
    times = (np.arange(len(exact)) + 1.0) * STEP
    moments = times ** np.arange(MOMENTS)[:, None]
    choices = np.arange(2 ** len(exact))[:, None] >> np.arange(len(exact)) & 1
    left = np.abs(moments @ (missed - choices * gap).T).sum(axis=0)
    return np.asarray(np.where(choices[np.argmin(left)], other, nearest))


def _oldest_first(values: Series) -> np.ndarray:
    return np.array([float(value) for value in reversed(values)])


@cache
def interpolation_weights(order: int) -> np.ndarray:
    """Return the coefficients [back, node, power] of the Lagrange polynomials in theta.

    Node j is j steps before the newest one. theta counts steps from the node that is `back` steps before the newest
    one.
    """
    out = np.zeros((order, order, order))
    for back in range(order):
        for j in range(order):
            polynomial = [Fraction(1)]
            for other in (k for k in range(order) if k != j):
                # theta_j - theta_other = (back - j) - (back - other) = other - j
                pairs = zip([Fraction(0), *polynomial], [*polynomial, Fraction(0)], strict=True)
                polynomial = [(raised - (back - other) * same) / (other - j) for raised, same in pairs]
            out[back, j] = [float(c) for c in polynomial]
    return out


@cache
def _step_weights(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the weights of a_n, a_(n-1), ... in differences of what the method predicts, newest first.

    They are those of the second difference of the position, over h^2; of the second difference of the position that is
    corrected minus the predicted one, by the newest node and by the others; and of the first difference of the
    velocity, over h.
    """
    P, V, D = (
        np.array([float(c) for c in weights])
        for weights in (position_weights(-1, order), velocity_weights(-1, order), correction_weights(order))
    )
    positions, velocities = np.convolve(P, [1.0, -2.0, 1.0]), np.convolve(V, [1.0, -1.0])
    positions[0] += 1.0
    velocities[0] += 1.0
    return positions, D[:1], np.convolve(np.append(0.0, D[1:]), [1.0, -2.0, 1.0]), velocities


def _growth(order: int, corrected: bool, square: float, damping: complex) -> float:
    """Return the largest modulus of a root of the characteristic polynomial for h^2 q'' = -square q - damping h v."""
    positions, newest, others, velocities = _step_weights(order)
    predicted = square * positions + damping * np.convolve(velocities, [1.0, -1.0])
    polynomial = np.zeros(order + 3, complex)
    polynomial[:3] += [1.0, -2.0, 1.0]
    polynomial[1:] += (1.0 - square * newest[0]) * predicted if corrected else predicted
    if corrected:
        polynomial += square * others
    return float(np.abs(np.roots(polynomial)).max())


def longest_stable(order: int, corrected: bool, fast: float, damped: float) -> float:
    """Return the largest part of a step h, at most 1, with which a method is stable.

    `fast` is h omega, for q'' = -omega^2 q, and `damped` h c, for the additional term -c v (friction) or i c v
    (rotation). `order` and `corrected` are those of `GaussJackson`.
    """

    def stable(part: float) -> bool:
        square = (part * fast) ** 2
        return all(_growth(order, corrected, square, part * w) <= 1.0 + GROWTH for w in (damped, 1j * damped))

    return 1.0 if stable(1.0) else _largest(stable, 1.0)


@cache
def damping_limit(order: int) -> float:
    """Return the largest h c for which the method is stable for q'' = -c v (friction) and q'' = i c v (rotation).

    Velocities are predicted as in Adams-Bashforth methods.
    """
    return _largest(lambda x: max(_growth(order, False, 0.0, w) for w in (x, 1j * x)) <= 1.0 + GROWTH)


@cache
def stability_limit(order: int, corrected: bool) -> float:
    """Return the largest h omega for which the method is stable for q'' = -omega^2 q.

    `corrected` is that of `GaussJackson`. The method is called stable if no root of the characteristic polynomial has a
    modulus above 1 + `GROWTH`, including the two roots of the solution.
    """
    return _largest(lambda x: _growth(order, corrected, x * x, 0.0) <= 1.0 + GROWTH)


def _largest(stable: Callable[[float], bool], high: float = 2.0) -> float:
    low = 0.0
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low
