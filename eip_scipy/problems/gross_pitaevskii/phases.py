"""Exact flows by phases of the modes along one axis after another, eight lines at a time; in place.

The transforms are those of `lines`, the phases tables of octets in the order in which these leave the modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from ..._octets import LANES
from .grid import Grid
from .lines import backward, forward, in_parts, load_block, order_of_modes, points, quarters, times
from .vectors import aligned, load_pair, octets, store_pair

__all__ = ["LineFlow"]

_jit = njit(cache=True, error_model="numpy", nogil=True, _nrt=False)


class Phases(NamedTuple):
    """Factors exp(-i phase) / n of the modes along an axis of n points.

    ``cosines[k]`` and ``sines[k]`` (n, 8) are those of `repeat` blocks of eight lines one after another, then those of
    the next ones follow; `roots` holds exp(-2 pi i j / n).
    """

    roots: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    repeat: int


def make_phases(phase: np.ndarray, repeat: int, alike: bool) -> Phases:
    """From the phases (lines, n), the modes in their usual order: eight lines in a block, or one for all eight."""
    n = phase.shape[1]
    roots = np.exp(-2j * np.pi / n * np.arange(n)).view(float)
    factor = np.exp(-1j * phase[:, order_of_modes(n)]) / n
    blocks = np.repeat(factor[:, None], LANES, axis=1) if alike else factor.reshape(-1, LANES, n)
    cosines, sines = aligned(2, blocks.shape[0], n, LANES)
    cosines[:], sines[:] = (part.swapaxes(1, 2) for part in (blocks.real, blocks.imag))
    return Phases(roots, cosines, sines, repeat)


@_jit
def turn_fours(re, im, cosine, sine):
    """The last pass there on blocks of four, the phases, and the first pass back."""
    for b in range(0, len(re), 4):
        y = quarters(re[b], im[b], re[b + 1], im[b + 1], re[b + 2], im[b + 2], re[b + 3], im[b + 3])
        p, q = times(cosine[b], sine[b], y[0], y[1])
        r, s = times(cosine[b + 1], sine[b + 1], y[2], y[3])
        t, u = times(cosine[b + 2], sine[b + 2], y[4], y[5])
        v, w = times(cosine[b + 3], sine[b + 3], y[6], y[7])
        re[b], im[b], re[b + 1], im[b + 1], re[b + 2], im[b + 2], re[b + 3], im[b + 3] = quarters(
            p, q, v, w, t, u, r, s
        )


@_jit
def turn_twos(re, im, cosine, sine):
    """The same on blocks of two, where the number of points is no power of four."""
    for b in range(0, len(re), 2):
        sr, si = times(cosine[b], sine[b], re[b] + re[b + 1], im[b] + im[b + 1])
        dr, di = times(cosine[b + 1], sine[b + 1], re[b] - re[b + 1], im[b] - im[b + 1])
        re[b], im[b], re[b + 1], im[b + 1] = sr + dr, si + di, sr - dr, si - di


@_jit
def turn_lines(re, im, phases, block):
    """Turn the modes of eight lines, (n,) octets each."""
    k = block // phases.repeat
    cosine, sine = octets(phases.cosines[k], 0), octets(phases.sines[k], 0)
    size = len(re)
    while size > 4:
        forward(re, im, size, phases.roots)
        size //= 4
    if size == 4:
        turn_fours(re, im, cosine, sine)
    else:
        turn_twos(re, im, cosine, sine)
    while size < len(re):
        size *= 4
        backward(re, im, size, phases.roots)


@_jit
def turn_columns(psi, phases, begin, end, buffer):
    """Turn the modes along the second axis of (slabs, n, floats), of some blocks of eight lines."""
    _, n, width = psi.shape
    blocks = width // (2 * LANES)
    re, im = octets(buffer[0], 0), octets(buffer[1], 0)
    field = psi.reshape(-1)
    for block in range(begin, end):
        slab = block // blocks
        first = slab * n * width + 2 * LANES * (block - slab * blocks)
        for r in range(n):
            re[r], im[r] = load_pair(field, first + r * width)
        turn_lines(re, im, phases, block)
        for r in range(n):
            store_pair(re[r], im[r], field, first + r * width)


@_jit
def turn_rows(psi, phases, begin, end, buffer):
    """Turn the modes along the rows of (rows, floats), of some blocks of eight rows."""
    _, width = psi.shape
    re, im = octets(buffer[0], 0), octets(buffer[1], 0)
    field = psi.reshape(-1)
    for block in range(begin, end):
        first = block * LANES * width
        for k in range(0, width // 2, LANES):
            load_block(field, first + 2 * k, width, re, im, k)
        turn_lines(re, im, phases, block)
        for k in range(0, width // 2, LANES):
            i = first + 2 * k
            a, c, e, g, p, r, t, v = points(re, k)
            b, d, f, h, q, s, u, w = points(im, k)
            store_pair(a, b, field, i)
            store_pair(c, d, field, i + width)
            store_pair(e, f, field, i + 2 * width)
            store_pair(g, h, field, i + 3 * width)
            store_pair(p, q, field, i + 4 * width)
            store_pair(r, s, field, i + 5 * width)
            store_pair(t, u, field, i + 6 * width)
            store_pair(v, w, field, i + 7 * width)


class LineFlow:
    """Phases along one axis after another.

    Parameters
    ----------
    grid : Grid
        Of a shape that `lines.fits`.
    passes : sequence of (int, ndarray, ndarray)
        The axis, and the modes' phases there: the first array, plus the second times y for the axis x, x for the axis
        y. Each holds an entry for each mode in the usual order.
    threads : int
    """

    def __init__(self, grid: Grid, passes: Sequence[tuple[int, np.ndarray, np.ndarray]], threads: int) -> None:
        self._shapes = [
            (int(np.prod(grid.shape[:k])), n, 2 * int(np.prod(grid.shape[k + 1 :]))) for k, n in enumerate(grid.shape)
        ]
        self._passes = [(axis, self._phases(grid, axis, still, turning)) for axis, still, turning in passes]
        self._buffers = {n: aligned(threads, 2, n, LANES) for n in grid.shape}

    @staticmethod
    def _phases(grid: Grid, axis: int, still: np.ndarray, turning: np.ndarray) -> Phases:
        if not np.any(turning):
            return make_phases(still.reshape(1, -1), grid.size, alike=True)
        phase = still.ravel() + grid.points(1 - axis)[:, None] * turning.ravel()
        # Neighbouring lines lie along z, if there is one.
        return make_phases(phase, grid.shape[2] // LANES, True) if grid.dim == 3 else make_phases(phase, 1, False)

    def apply(self, psi: np.ndarray) -> None:
        """Turn a contiguous field in place."""
        flat = psi.reshape(-1).view(float)
        for axis, phases in self._passes:
            buffers = self._buffers[psi.shape[axis]]
            if axis == psi.ndim - 1:
                in_parts(turn_rows, (flat.reshape(-1, 2 * psi.shape[-1]), phases), (), buffers, flat.size)
            else:
                in_parts(turn_columns, (flat.reshape(self._shapes[axis]), phases), (), buffers, flat.size)
