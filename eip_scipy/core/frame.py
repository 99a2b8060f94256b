"""The frame (C, S): linear constraints that the correction leaves unchanged."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise, product
from typing import Any

import numpy as np

from ..engine.data import FrameRows
from .blocks import INDEX
from .inputs import numbers, shown

__all__ = ["frame_rows", "spanned"]

SPANNED = 1e-9
# Frames with at most this many entries in C are kept between runs: the checks take longer than a run of a few steps.
SMALL = 2**14
# Rows of a run without a frame.
NO_FRAME = FrameRows(np.zeros((2, 1), INDEX), np.zeros(0, INDEX), np.zeros(0), np.zeros(0), np.zeros((2, 0, 0)))


def frame_rows(frame: Any, n: int, width: int) -> FrameRows:
    """Return the frame (C, S) as sparse rows of C and of the transpose of S (C S)^-1, after checks.

    The rows act on the floats of the state, `width` of which represent a component: 2 for a complex state, else 1.
    """
    if frame is None:
        return NO_FRAME
    pair = tuple(frame) if np.iterable(frame) else ()
    matrices = [matrix for a in pair if (matrix := numbers("linear_invariants", a)) is not None]
    if len(pair) != 2 or len(matrices) != 2:
        raise ValueError(
            "linear_invariants must be 'auto', None, or a pair (C, S) of matrices of shapes (k, n) and (n, k), "
            f"got {shown(frame)}."
        )
    C, S = map(np.atleast_2d, matrices)
    k = C.shape[0]
    if k == 0 or C.shape != (k, n) or S.shape != (n, k):
        raise ValueError(
            f"linear_invariants: C has shape {C.shape} and S {S.shape}; expected real or complex numbers of shapes "
            f"(k, {n}) and ({n}, k) with k >= 1."
        )
    rows = _rows if C.size <= SMALL else _rows.__wrapped__
    found = rows((C.tobytes(), C.dtype.str), (S.tobytes(), S.dtype.str), n, width)
    return found._replace(products=np.zeros_like(found.products))  # which each run writes


@lru_cache(maxsize=8)
def _rows(given_C: tuple[bytes, str], given_S: tuple[bytes, str], n: int, width: int) -> FrameRows:
    C, S = (np.frombuffer(*given) for given in (given_C, given_S))
    C, M = _frame_matrices(C.reshape(-1, n), S.reshape(n, -1), width)
    both, k = np.concatenate([C, M]), C.shape[0]
    rows, index = np.nonzero(both)
    starts = np.concatenate([[0], np.cumsum(np.count_nonzero(both, axis=1))]).astype(INDEX)
    weights = _by_bodies(C), _by_bodies(M)
    bodies = np.array(weights) if weights[0].size and weights[1].size else np.zeros((2, 0, 0))
    indices = np.array([starts[: k + 1], starts[k:]])
    return FrameRows(indices, index.astype(INDEX), both[rows, index], np.zeros(k), bodies)


def spanned(frame: FrameRows, G: np.ndarray) -> np.ndarray:
    """Return a mask (l,) of gradients, rows of G, that combine rows of C: the frame removes corrections along them."""
    left = G.copy()
    for (begin, end), (first, last) in zip(*(pairwise(rows.tolist()) for rows in frame.start), strict=True):
        products = G[:, frame.place[first:last]] @ frame.value[first:last]
        left[:, frame.place[begin:end]] -= products[:, None] * frame.value[begin:end]
    sizes, rest = (np.abs(rows).max(axis=1, initial=0.0) for rows in (G, left))
    return (sizes > 0.0) & (rest <= SPANNED * sizes)


def _frame_matrices(C: np.ndarray, S: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    if width == 2:
        C, S = _real_form(C), _real_form(S)
    elif C.dtype.kind == "c" or S.dtype.kind == "c":
        raise ValueError("linear_invariants: C and S must be real for a real state.")
    # Rows of C and columns of S in units of their own: only then does the condition number tell singular from scaled.
    C = C / np.maximum(np.abs(C).max(axis=1, keepdims=True), np.finfo(float).tiny)
    S = S / np.maximum(np.abs(S).max(axis=0, keepdims=True), np.finfo(float).tiny)
    shifts = C @ S
    if not np.all(np.isfinite(shifts)) or not np.linalg.cond(shifts) < 1e12:
        raise ValueError(
            "linear_invariants: C S is singular; S must span shifts that change every row of C y, the rows of C must "
            "be linearly independent, and C and S must be finite."
        )
    return C, np.ascontiguousarray(np.linalg.solve(shifts.T, S.T))


def _real_form(a: np.ndarray) -> np.ndarray:
    """Return the real matrix (2 k, 2 n) that acts on pairs (Re, Im) as `a` (k, n) acts on complex components."""
    out = np.empty((a.shape[0], 2, a.shape[1], 2))
    out[:, 0, :, 0] = out[:, 1, :, 1] = a.real
    out[:, 1, :, 0], out[:, 0, :, 1] = a.imag, -a.imag
    return out.reshape(2 * a.shape[0], 2 * a.shape[1])


def _by_bodies(a: np.ndarray) -> np.ndarray:
    """Return the weights (k, b) if rows of `a` (3 k, 3 k b) sum x, y, z over b bodies of k groups, else no weights."""
    groups = a.shape[0] // 3
    if groups == 0 or a.shape[0] % 3 or a.shape[1] % (3 * groups):
        return np.zeros((0, 0))
    entries = a.reshape(groups, 3, groups, -1, 3)
    weights = np.array([entries[k, 0, k, :, 0] for k in range(groups)])
    expected = np.zeros_like(entries)
    for k, axis in product(range(groups), range(3)):
        expected[k, axis, k, :, axis] = weights[k]
    return weights if np.array_equal(entries, expected) else np.zeros((0, 0))
