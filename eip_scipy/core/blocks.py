"""Blocks: groups of components with a common weight in the error metric."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from ..engine.data import Grouping
from .inputs import shown

__all__ = ["INDEX", "blocks_of", "kinds_of"]

# Unsigned integers: Numba then omits the test for negative indices, which costs more than the access itself.
INDEX = np.uint64
# Blocks of states with at most this many components are kept between runs: making them takes longer than a short run.
SMALL = 2**10


def blocks_of(blocks: Any, n: int, width: int) -> Grouping:
    """Return the checked option ``blocks`` as groups of floats of a state of n components of `width` floats each."""
    if blocks is None:
        return _consecutive(1, n, width)
    if isinstance(blocks, (int, np.integer)) and not isinstance(blocks, bool):
        if blocks < 1 or n % blocks:
            raise ValueError(f"blocks = {blocks} does not divide the state's {n} components; give a positive divisor.")
        return _consecutive(int(blocks), n, width)
    groups = _block_lists(blocks, n)
    if width == 2:
        groups = [np.column_stack([2 * g, 2 * g + 1]).ravel() for g in groups]
    start = np.concatenate([[0], np.cumsum([len(g) for g in groups])]).astype(INDEX)
    member = np.concatenate([*groups, []]).astype(INDEX)
    regular = len({len(g) for g in groups}) == 1 and np.array_equal(member, np.arange(member.size))
    return Grouping(member, start, width, len(groups[0]) if regular else 0)


def kinds_of(groups: Grouping, y: np.ndarray, f: np.ndarray) -> Grouping:
    """Return the groups of floats of a state y with the derivative f that have the same unit, as far as that is known.

    The floats of a block have the same unit. Without blocks, a real state with an even number n of components is taken
    as (q, p), and the two halves are the groups, if ``f[: n // 2]`` and ``p = y[n // 2 :]`` are both zero or both
    nonzero, and the sum of ``f[: n // 2] * sign(p)`` is not negative.
    """
    n = y.size
    if len(groups.start) - 1 < n or n % 2 or n == 0 or y.dtype.kind == "c":
        return groups
    q_dot, p = f[: n // 2], y[n // 2 :]
    with np.errstate(over="ignore", invalid="ignore"):  # not by BLAS, whose rounding differs between processors
        like = q_dot.any() == p.any() and (q_dot * np.sign(p)).sum() >= 0
    return _consecutive(n // 2, n, 1) if like else groups


def _consecutive(size: int, n: int, width: int) -> Grouping:
    """Return blocks of `size` consecutive components."""
    return (_made if n <= SMALL else _made.__wrapped__)(size, n, width)


@lru_cache(maxsize=64)
def _made(size: int, n: int, width: int) -> Grouping:
    """Make such blocks without a loop, because a field may have a million of them."""
    floats = n * width
    start = np.arange(0, floats + 1, size * width, dtype=INDEX)
    return Grouping(np.arange(floats, dtype=INDEX), start, width, size * width if n else 0)


def _block_lists(blocks: Any, n: int) -> list[np.ndarray]:
    try:
        groups = [np.atleast_1d(np.asarray(b)) for b in blocks]
    except (TypeError, ValueError):
        raise ValueError(f"blocks must be an integer or a sequence of index arrays, got {shown(blocks)}.") from None
    groups = [g for g in groups if g.size]
    for g in groups:
        if g.dtype.kind not in "iu" or g.ndim != 1 or g.min() < 0 or g.max() >= n:
            raise ValueError(f"blocks: {shown(g)} is not an array of indices from 0 to {n - 1}.")
    used = np.concatenate([*groups, np.array([], dtype=int)]).astype(int)
    if np.unique(used).size != used.size:
        raise ValueError("blocks: a component is in two blocks; each component may be in one block only.")
    return groups + [np.array([i]) for i in np.setdiff1d(np.arange(n), used)]
