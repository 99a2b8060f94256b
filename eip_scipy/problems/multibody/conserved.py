"""Momenta of cyclic coordinates and norms of quaternions, which a mechanical system conserves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...core.invariants import Invariant
from ...core.jitted import compiled_like
from .energies import CONSTANT, FEWEST, Energy, rates_of
from .motion import Sizes, plain
from .parts import Parts
from .start import Names

__all__ = ["momenta_of", "norms_of"]

# Bound for the rounding of a rate, relative to the gradient times the largest derivative.
ROUNDING = 1e-12
# A gradient depends on those of other invariants if its distance from their span is below this share of its length.
DEPENDENT = 1e-6


def momenta_of(
    candidates: Sequence[Energy],
    kept: Sequence[Invariant],
    derivative: Callable[[float, np.ndarray], np.ndarray],
    states: Sequence[tuple],
    params: np.ndarray | None,
) -> tuple[Invariant, ...]:
    """Return the candidates that are constant and independent of the invariants in `kept` and of each other.

    The functions of `kept` are not compiled, and `derivative(t, y)` returns y'. If there are fewer than 3 `states`,
    pairs (t, y) that meet the constraints, no momenta are returned.
    """
    args = () if params is None else (params,)
    found: list[Invariant] = []
    if len(states) < FEWEST:
        return ()
    known = [_rows(kept, t, y) for t, y in states]
    for item in candidates:
        rates, terms = rates_of(item, derivative, states, args)
        slopes = [_slope(plain(item.gradient), t, y, args) for t, y in states]
        rounding = [np.abs(g).sum() * np.abs(derivative(t, y)).max() for g, (t, y) in zip(slopes, states, strict=True)]
        if not (np.abs(rates) <= CONSTANT * terms + ROUNDING * np.array(rounding)).all():
            continue
        if not any(_is_independent(g, rows) for g, rows in zip(slopes, known, strict=True)):
            continue
        found.append(Invariant(item.value, item.gradient, args=args, in_place=True, name=item.description))
        known = [np.vstack([rows, g]) for g, rows in zip(slopes, known, strict=True)]
    return tuple(found)


def norms_of(
    parts: Parts, names: Names, kept: Sequence[Invariant], states: Sequence[tuple], params: np.ndarray | None
) -> tuple[Invariant, ...]:
    """Return the sums of squares of coordinates, such as a quaternion's, whose sum of q q' is 0 for all speeds.

    Those that depend on the invariants in `kept` are left out.
    """
    t, y = states[-1]
    if _speeds_are_rates(parts, names, t, y, params):
        return ()
    products = np.array([row for t, y in states for row in _products(parts, names, t, y, params)])
    found = []
    for places in _sets(products):
        item = _sum_of_squares(parts, names, places, params)
        if any(_is_independent(_rows([item], t, y)[0], _rows(kept, t, y)) for t, y in states):
            found.append(item)
    return tuple(found)


def _rows(items: Sequence[Invariant], t: float, y: np.ndarray) -> np.ndarray:
    """Return the gradients of the values of all invariants at a state as rows (l, n)."""
    found = [np.zeros((0, y.size))]
    for item in items:
        out = np.empty((item.size, y.size) if item.size else y.size)
        plain(item.gradient)(t, y, out, *item.args)
        found.append(np.atleast_2d(out))
    return np.vstack(found)


def _slope(gradient: Callable[..., None], t: float, y: np.ndarray, args: tuple[Any, ...]) -> np.ndarray:
    out = np.empty(y.size)
    gradient(t, y, out, *args)
    return out


def _is_independent(gradient: np.ndarray, rows: np.ndarray) -> bool:
    """Return True if a gradient is not a linear combination of `rows`."""
    sizes = np.linalg.norm(rows, axis=1)
    rows = rows[sizes > 0] / sizes[sizes > 0, None]
    _, values, directions = np.linalg.svd(rows, full_matrices=False)
    directions = directions[values > DEPENDENT * values.max(initial=0.0)]
    left = gradient - directions.T @ (directions @ gradient)
    return bool(np.linalg.norm(left) > DEPENDENT * np.linalg.norm(gradient))


def _rates(parts: Parts, names: Names, t: float, y: np.ndarray, params: np.ndarray | None) -> np.ndarray:
    """Return q', the derivatives of the coordinates at a state."""
    sizes = Sizes(len(names.coordinates), len(names.speeds), len(names.velocities))
    out = np.empty(sizes.matrices + sizes.coordinates)
    plain(parts.fill)(t, y, out, *(() if params is None else (params,)))
    return out[sizes.matrices :]


def _speeds_are_rates(parts: Parts, names: Names, t: float, y: np.ndarray, params: np.ndarray | None) -> bool:
    nq, n = len(names.coordinates), len(names.speeds)
    speeds = np.arange(1.0, n + 1.0)
    return nq == n and np.array_equal(_rates(parts, names, t, np.append(y[:nq], speeds), params), speeds)


def _products(parts: Parts, names: Names, t: float, y: np.ndarray, params: np.ndarray | None) -> list[np.ndarray]:
    """Return the products q_i q_i' (nq,) of all coordinates: at zero speeds, then with each speed in turn set to 1."""
    nq, n = len(names.coordinates), len(names.speeds)
    speeds = np.vstack([np.zeros(n), np.eye(n)])
    return [y[:nq] * _rates(parts, names, t, np.append(y[:nq], u), params) for u in speeds]


def _sets(products: np.ndarray) -> list[tuple[int, ...]]:
    """Return the sets of at least two columns of `products` whose sum is 0 in each row, as tuples of their indices."""
    if not np.isfinite(products).all():
        return []
    size = np.abs(products).max(initial=0.0)
    moving = np.flatnonzero(np.abs(products).max(axis=0, initial=0.0) > CONSTANT * size)
    if moving.size < 2:
        return []
    _, values, directions = np.linalg.svd(products[:, moving])
    rank = int((values > CONSTANT * values.max(initial=0.0)).sum())
    basis = _reduced(directions[rank:])
    chosen = np.abs(basis) > 0.5
    whole = np.abs(basis - chosen).max(axis=1, initial=0.0) < DEPENDENT
    return [
        tuple(int(k) for k in moving[row]) for row, fits in zip(chosen, whole, strict=True) if fits and row.sum() > 1
    ]


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Return the reduced row echelon form of independent rows."""
    rows, top = rows.copy(), 0
    for k in range(rows.shape[1]):
        if top == len(rows):
            break
        best = top + int(np.argmax(np.abs(rows[top:, k])))
        if abs(rows[best, k]) < DEPENDENT:
            continue
        rows[[top, best]] = rows[[best, top]]
        rows[top] /= rows[top, k]
        others = np.arange(len(rows)) != top
        rows[others] -= np.outer(rows[others, k], rows[top])
        top += 1
    return rows


def _sum_of_squares(parts: Parts, names: Names, places: tuple[int, ...], params: np.ndarray | None) -> Invariant:
    def value(t, y, *params):
        total = 0.0
        for k in places:
            total += y[k] * y[k]
        return total

    def gradient(t, y, out, *params):
        for k in range(y.size):
            out[k] = 0.0
        for k in places:
            out[k] = 2.0 * y[k]

    functions = compiled_like(value, parts.fill), compiled_like(gradient, parts.fill)
    args = () if params is None else (params,)
    name = " + ".join(f"{names.coordinates[k]}^2" for k in places)
    return Invariant(*functions, args=args, in_place=True, name=name)
