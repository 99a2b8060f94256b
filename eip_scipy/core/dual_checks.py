"""Comparison, at the start of a run, of a right-hand side compiled for dual numbers with the function itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .gradients import unless_error
from .states import as_derivative

if TYPE_CHECKING:
    from .variations import Columns

__all__ = ["shifted", "wrong_duals"]

Array = np.ndarray
# Largest difference between values with dual numbers and without, in units of their size and of their differences.
ROUNDED = 1e-6
# Largest difference between derivatives and their approximations by differences, in the same units.
CLOSE = 1e-3
# Lengths of differences in units of the state, and their rounding in units of the largest value.
LENGTHS = 10.0 ** -np.arange(2, 13)
NOISE = 1e-12
# Distance, in units of the state, of the second state at which they are compared.
NEARBY = 1e-6


def wrong_duals(
    columns: Columns,
    rhs: Callable[..., Any],
    derivative: Callable[..., Array],
    t0: float,
    y0: Array,
    way: tuple[Array, Array],
    extra: tuple,
) -> str | None:
    """Return a clause about what is wrong in `rhs`, the output of `rhs_by_duals`; None if nothing is found.

    ``derivative(t, y, extra)`` returns the derivative (n,) of the state. `way` is a direction: dy, of the size of the
    state y0, and dp, of the size 1, for the parameters by which derivatives are taken. The values and products of `rhs`
    are compared with the value of `derivative`, and its differences along the direction, at the start and near it. At a
    kink or a jump neither need be wrong, so that a component counts as wrong only if it is so at both states.
    """
    as_derivative(derivative(t0, y0, extra), y0.size, y0.dtype, t0, "fun")  # an error of fun has its own message
    looks: list[tuple[Array, Array, Array]] = []
    wrong = np.ones((1 + columns.count, y0.size), bool)
    places = list(columns.parameters)
    if places:
        sizes = np.abs(extra[0][places])
        way = way[0], way[1] * np.where(sizes > 0, sizes, 1.0)
    for share in (0.0, NEARBY):
        y = y0 + share * way[0]
        own, slopes = _secants(derivative, t0, y, way, places, extra)
        try:
            found = _products_of(columns, rhs, t0, y, way, extra)
        except MemoryError:
            raise
        except Exception as error:  # fun itself raises none at the start
            return f"it raises {type(error).__name__} with dual numbers" if share == 0.0 else None
        wrong = wrong & _differ(found, own, slopes)
        looks.append((found, own, slopes[len(slopes) // 2]))
    if not wrong.any():
        return None
    (row, k), (found, own, slope) = np.argwhere(wrong)[0], looks[0]
    if row == 0:
        return f"component {k} of its value at the start is {own[k]:.6g}, but {found[0, k]:.6g} with dual numbers"
    return (
        f"component {k} of its derivative along a test direction is {slope[k]:.6g} at the start, but "
        f"{found[row, k]:.6g} with dual numbers"
    )


def _differ(found: Array, own: Array, slopes: Array) -> Array:
    """Return for each number in `found`, the output of `_products_of`, whether it differs from what it must be.

    `own` and `slopes` are the output of `_secants`. Products agree if they do so for one of the lengths. Nothing
    differs from NaN.
    """
    with np.errstate(invalid="ignore"):
        sizes = np.nanmax(np.abs([own, *slopes]), axis=0, initial=0.0)
        least = NOISE * sizes.max()
        # A value is a sum of terms that may cancel. Their sizes are estimated from the differences.
        same = (np.abs(found[0] - own) <= ROUNDED * sizes + least) | ~np.isfinite(own)
        close = np.abs(found[1:, None] - slopes) <= CLOSE * np.abs(slopes) + least
    return ~np.vstack([same, close.any(axis=1) | ~np.isfinite(slopes).any(axis=0)])


def _products_of(
    columns: Columns, rhs: Callable[..., Any], t: float, y: Array, way: tuple[Array, Array], extra: tuple
) -> Array:
    """Return the derivatives (1 + k, n) of the state and of k columns that all are `way`, by `rhs`."""
    wide = np.tile(np.concatenate(way), 1 + columns.count)
    wide[: columns.size] = np.concatenate([y, extra[0][list(columns.parameters)] if columns.parameters else []])
    out = np.empty_like(wide)
    rhs(t, wide, out, *extra)
    return out.reshape(-1, columns.size)[:, : columns.n]


def _secants(
    derivative: Callable[..., Array], t: float, y: Array, way: tuple[Array, Array], places: list[int], extra: tuple
) -> tuple[Array, Array]:
    """Return the value (n,) and differences (k, n) along `way` of k lengths; they are NaN where `derivative` raises."""
    direction = np.concatenate(way)

    def at(s: float) -> Array:
        found: Array | None = unless_error(shifted, derivative, t, y, s * direction, places, extra)
        return np.full(y.size, np.nan) if found is None else found

    with np.errstate(all="ignore"):
        return at(0.0), np.array([(at(s) - at(-s)) / (2.0 * s) for s in LENGTHS])


def shifted(
    derivative: Callable[..., Array], t: float, y: Array, shift: Array, places: list[int], extra: tuple
) -> Array:
    """Return ``derivative(t, y, extra)`` with y and the parameters `places` shifted by the n + p floats of `shift`."""
    if places:
        params = extra[0].astype(shift.dtype)
        params[places] += shift[y.size :]
        extra = (params,)
    return derivative(t, y + shift[: y.size], extra)
