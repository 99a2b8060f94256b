"""Fourier multipliers along one axis, eight lines of the grid at a time: transform, multiply, transform back.

A line's modes are multiplied as soon as they are there, in the order in which the transform leaves them, and go back
without having been sorted: decimation in frequency (Gentleman & Sande 1966) on the way there, in time on the way back.
Eight lines, one in each lane, stay in the processor's first cache meanwhile. So the field is read and written once for
each axis, and the right-hand side costs less than a library's transforms alone.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit

from ..._octets import LANES, multiply_add
from .grid import Grid
from .vectors import aligned, load, load_pair, octets, spread, store_pair, transpose

__all__ = ["LineSum", "fits"]

_jit = njit(cache=True, error_model="numpy", nogil=True, _nrt=False)
_jit_inline = njit(cache=True, error_model="numpy", nogil=True, _nrt=False, forceinline=True)

NOTHING = np.zeros(0)


class Axis(NamedTuple):
    """A factor ``kinetic[mode] + turning[mode] place[line]`` of the modes along an axis, divided by their number.

    `roots` holds exp(-2 pi i j / n); the modes are in the order of the transform, the lines in that of the field.
    """

    roots: np.ndarray
    kinetic: np.ndarray
    turning: np.ndarray
    place: np.ndarray


def fits(shape: tuple[int, ...]) -> bool:
    """Whether `LineSum` takes grids of this shape: two axes or three, each a power of two, 8 or more."""
    return len(shape) > 1 and all(n >= LANES and n & (n - 1) == 0 for n in shape)


def order_of_modes(n: int) -> np.ndarray:
    """Which mode stands where after the passes of radix 4, and 2 at the end, of n points."""
    modes = np.arange(n)
    size = n
    while size > 1:
        radix = 4 if size > 2 else 2
        modes = modes.reshape(-1, size // radix, radix).swapaxes(1, 2).reshape(-1)
        size //= radix
    return modes


def make_axis(kinetic: np.ndarray, turning: np.ndarray, place: np.ndarray) -> Axis:
    """The factor of the modes in their usual order, (n,) and (n,), on lines at `place`."""
    n = kinetic.size
    roots = np.exp(-2j * np.pi / n * np.arange(n)).view(float)
    order = order_of_modes(n)
    return Axis(roots, kinetic[order] / n, turning[order] / n, np.ascontiguousarray(place, dtype=float).reshape(-1))


@_jit
def times(wr, wi, re, im):
    """W (re + i im)."""
    return multiply_add(-wi, im, wr * re), multiply_add(wi, re, wr * im)


@_jit
def times_conjugate(wr, wi, re, im):
    """The conjugate of w, times (re + i im)."""
    return multiply_add(wi, im, wr * re), multiply_add(-wi, re, wr * im)


@_jit
def quarters(a, b, c, d, e, f, g, h):
    """The transform of the four numbers a + i b, c + i d, e + i f and g + i h."""
    sr, si, dr, di = a + e, b + f, a - e, b - f
    ur, ui, vr, vi = c + g, d + h, d - h, g - c
    return sr + ur, si + ui, dr + vr, di + vi, sr - ur, si - ui, dr - vr, di - vi


@_jit
def forward(re, im, size, roots):
    """Split each block of `size` points into four, of the modes that leave 0, 1, 2 and 3 when divided by 4."""
    n = len(re)
    m, step = size // 4, 2 * (n // size)
    for j in range(m):
        k = j * step
        ur, ui = roots[k], roots[k + 1]
        vr, vi = roots[2 * k], roots[2 * k + 1]
        wr, wi = roots[3 * k], roots[3 * k + 1]
        for b in range(j, n, size):
            p, q, r = b + m, b + 2 * m, b + 3 * m
            y = quarters(re[b], im[b], re[p], im[p], re[q], im[q], re[r], im[r])
            re[b], im[b] = y[0], y[1]
            re[p], im[p] = times(ur, ui, y[2], y[3])
            re[q], im[q] = times(vr, vi, y[4], y[5])
            re[r], im[r] = times(wr, wi, y[6], y[7])


@_jit
def backward(re, im, size, roots):
    """The inverse of `forward`, times 4."""
    n = len(re)
    m, step = size // 4, 2 * (n // size)
    for j in range(m):
        k = j * step
        ur, ui = roots[k], roots[k + 1]
        vr, vi = roots[2 * k], roots[2 * k + 1]
        wr, wi = roots[3 * k], roots[3 * k + 1]
        for b in range(j, n, size):
            p, q, r = b + m, b + 2 * m, b + 3 * m
            cr, ci = times_conjugate(ur, ui, re[p], im[p])
            er, ei = times_conjugate(vr, vi, re[q], im[q])
            gr, gi = times_conjugate(wr, wi, re[r], im[r])
            # An inverse transform is one with the second and the last number exchanged.
            re[b], im[b], re[p], im[p], re[q], im[q], re[r], im[r] = quarters(re[b], im[b], gr, gi, er, ei, cr, ci)


@_jit
def multiply_fours(re, im, kinetic, turning, place):
    """The last pass there on blocks of four, the factor, and the first pass back."""
    for b in range(0, len(re), 4):
        y = quarters(re[b], im[b], re[b + 1], im[b + 1], re[b + 2], im[b + 2], re[b + 3], im[b + 3])
        f = multiply_add(spread(turning[b]), place, spread(kinetic[b]))
        g = multiply_add(spread(turning[b + 1]), place, spread(kinetic[b + 1]))
        h = multiply_add(spread(turning[b + 2]), place, spread(kinetic[b + 2]))
        k = multiply_add(spread(turning[b + 3]), place, spread(kinetic[b + 3]))
        re[b], im[b], re[b + 1], im[b + 1], re[b + 2], im[b + 2], re[b + 3], im[b + 3] = quarters(
            f * y[0], f * y[1], k * y[6], k * y[7], h * y[4], h * y[5], g * y[2], g * y[3]
        )


@_jit
def multiply_twos(re, im, kinetic, turning, place):
    """The same on blocks of two, where the number of points is no power of four."""
    for b in range(0, len(re), 2):
        f = multiply_add(spread(turning[b]), place, spread(kinetic[b]))
        g = multiply_add(spread(turning[b + 1]), place, spread(kinetic[b + 1]))
        sr, si = f * (re[b] + re[b + 1]), f * (im[b] + im[b + 1])
        dr, di = g * (re[b] - re[b + 1]), g * (im[b] - im[b + 1])
        re[b], im[b], re[b + 1], im[b + 1] = sr + dr, si + di, sr - dr, si - di


@_jit
def multiply_lines(re, im, axis, place):
    """Multiply the modes of eight lines, (n,) octets each."""
    size = len(re)
    while size > 4:
        forward(re, im, size, axis.roots)
        size //= 4
    if size == 4:
        multiply_fours(re, im, axis.kinetic, axis.turning, place)
    else:
        multiply_twos(re, im, axis.kinetic, axis.turning, place)
    while size < len(re):
        size *= 4
        backward(re, im, size, axis.roots)


@_jit
def along_columns(psi, axis, add, begin, end, out, buffer):
    """Out = the multiplied field, or out += that; psi and out (slabs, n, floats), lines along the second axis.

    Of all blocks of eight lines, those from `begin` on up to `end`.
    """
    _, n, width = psi.shape
    blocks = width // (2 * LANES)
    re, im = octets(buffer[0], 0), octets(buffer[1], 0)
    source, target = psi.reshape(-1), out.reshape(-1)
    for block in range(begin, end):
        slab = block // blocks
        first = slab * n * width + 2 * LANES * (block - slab * blocks)
        for r in range(n):
            re[r], im[r] = load_pair(source, first + r * width)
        multiply_lines(re, im, axis, load(axis.place, LANES * block))
        if add:
            for r in range(n):
                x, y = load_pair(target, first + r * width)
                store_pair(x + re[r], y + im[r], target, first + r * width)
        else:
            for r in range(n):
                store_pair(re[r], im[r], target, first + r * width)


@_jit
def along_rows(psi, axis, rest, V, beta, begin, end, out, buffer):
    """Out = the multiplied field + rest, lines along rows; with a potential -i (that + (V + beta |psi|^2) psi).

    All (rows, floats) but V, which is flat and may be empty. Of all blocks of eight rows, those from `begin` up to
    `end`.
    """
    _, width = psi.shape
    re, im = octets(buffer[0], 0), octets(buffer[1], 0)
    source, others, target = psi.reshape(-1), rest.reshape(-1), out.reshape(-1)
    for block in range(begin, end):
        first = block * LANES * width
        for k in range(0, width // 2, LANES):
            load_block(source, first + 2 * k, width, re, im, k)
        multiply_lines(re, im, axis, load(axis.place, LANES * block))
        for k in range(0, width // 2, LANES):
            i = first + 2 * k
            a, c, e, g, p, r, t, v = points(re, k)
            b, d, f, h, q, s, u, w = points(im, k)
            finish(a, b, source, others, V, beta, target, i)
            finish(c, d, source, others, V, beta, target, i + width)
            finish(e, f, source, others, V, beta, target, i + 2 * width)
            finish(g, h, source, others, V, beta, target, i + 3 * width)
            finish(p, q, source, others, V, beta, target, i + 4 * width)
            finish(r, s, source, others, V, beta, target, i + 5 * width)
            finish(t, u, source, others, V, beta, target, i + 6 * width)
            finish(v, w, source, others, V, beta, target, i + 7 * width)


@_jit_inline
def points(part, k):
    """Points k ... k + 7 of eight lines, one in each lane, as eight rows."""
    return transpose(
        (part[k], part[k + 1], part[k + 2], part[k + 3], part[k + 4], part[k + 5], part[k + 6], part[k + 7])
    )


@_jit_inline
def finish(re, im, psi, rest, V, beta, out, i):
    """Eight points of the field: see `along_rows`."""
    a, b = load_pair(rest, i)
    a, b = a + re, b + im
    if V.size > 0:
        x, y = load_pair(psi, i)
        v = multiply_add(spread(beta), multiply_add(x, x, y * y), load(V, i // 2))
        store_pair(multiply_add(v, y, b), -multiply_add(v, x, a), out, i)
    else:
        store_pair(a, b, out, i)


@_jit
def load_block(source, i, width, re, im, k):
    """Eight points of eight rows: points k ... k + 7 of (re, im), the rows in the lanes."""
    a, b = load_pair(source, i)
    c, d = load_pair(source, i + width)
    e, f = load_pair(source, i + 2 * width)
    g, h = load_pair(source, i + 3 * width)
    p, q = load_pair(source, i + 4 * width)
    r, s = load_pair(source, i + 5 * width)
    t, u = load_pair(source, i + 6 * width)
    v, w = load_pair(source, i + 7 * width)
    re[k], re[k + 1], re[k + 2], re[k + 3], re[k + 4], re[k + 5], re[k + 6], re[k + 7] = transpose(
        (a, c, e, g, p, r, t, v)
    )
    im[k], im[k + 1], im[k + 2], im[k + 3], im[k + 4], im[k + 5], im[k + 6], im[k + 7] = transpose(
        (b, d, f, h, q, s, u, w)
    )


class LineSum:
    """The linear part of the equation, ``kinetic + Omega times turning`` along each axis, and f with it.

    Parameters
    ----------
    grid : Grid
        Of a shape that `fits`.
    kinetic : sequence of ndarray
        For each axis a factor of its modes.
    turning : sequence of ndarray
        For x and y a factor of the modes that is multiplied by y and by x.
    threads : int, optional
    """

    def __init__(
        self, grid: Grid, kinetic: Sequence[np.ndarray], turning: Sequence[np.ndarray], threads: int = 1
    ) -> None:
        nx, ny, *nz = grid.shape
        x, y = grid.points(0), grid.points(1)
        columns = nz[0] if nz else 1
        self._rows = grid.size // grid.shape[-1], 2 * grid.shape[-1]
        along_x = make_axis(kinetic[0].ravel(), turning[0].ravel(), np.repeat(y, columns))
        along_y = make_axis(kinetic[1].ravel(), turning[1].ravel(), np.repeat(x, columns))
        self._columns = [(along_x, (1, nx, 2 * ny * columns), False)]
        if nz:
            self._columns.append((along_y, (nx, ny, 2 * columns), True))
        still = np.zeros(grid.shape[-1]), np.zeros(nx * ny)
        self._last = make_axis(kinetic[2].ravel(), *still) if nz else along_y
        self._rest = aligned(grid.size * 2)
        self._buffers = {n: aligned(threads, 2, n, LANES) for n in grid.shape}

    def apply(self, psi: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the operator's image of `psi`."""
        self._fill(psi, NOTHING, 0.0, out)

    def derivative(self, psi: np.ndarray, V: np.ndarray, beta: float, out: np.ndarray) -> None:
        """Fill `out` with -i times that of the whole equation, V and beta |psi|^2 included."""
        self._fill(psi, V.reshape(-1), beta, out)

    def _fill(self, psi: np.ndarray, V: np.ndarray, beta: float, out: np.ndarray) -> None:
        source, target = (a.reshape(-1).view(float) for a in (psi, out))
        for axis, shape, add in self._columns:
            columns, last = (source.reshape(shape), axis, add), (self._rest.reshape(shape),)
            in_parts(along_columns, columns, last, self._buffers[axis.kinetic.size], source.size)
        field, rest, image = (a.reshape(self._rows) for a in (source, self._rest, target))
        rows, buffers = (field, self._last, rest, V, beta), self._buffers[self._last.kinetic.size]
        in_parts(along_rows, rows, (image,), buffers, source.size)


def in_parts(kernel: Callable[..., None], first: tuple, last: tuple, buffers: np.ndarray, floats: int) -> None:
    """Call ``kernel(*first, begin, end, *last, buffer)`` for all blocks of eight lines of a field of so many floats.

    In as many threads as there are buffers (2, n, 8), n the points of a line.
    """
    blocks, threads = floats // (2 * LANES * buffers.shape[2]), buffers.shape[0]
    if threads == 1:
        kernel(*first, 0, blocks, *last, buffers[0])
        return
    ends = [blocks * k // threads for k in range(threads + 1)]
    pool = _pool(threads, os.getpid())
    parts = [
        pool.submit(kernel, *first, begin, end, *last, buffer)
        for begin, end, buffer in zip(ends[:-1], ends[1:], buffers, strict=True)
    ]
    for part in parts:
        part.result()


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """One for all equations of a process; a forked one has no threads of its parent's."""
    return ThreadPoolExecutor(threads, thread_name_prefix="gross-pitaevskii")
