"""Periodic grids, and real factors of the Fourier modes along some of their axes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ...core.inputs import real_array
from .pointwise import multiply, weighted_square
from .transforms import Axes, Transforms

__all__ = ["Grid", "Multiplier", "SpectralSum"]

MOST_AXES = 3
STRIP = 64  # columns of a field of two dimensions that are transformed together along x
SLAB = 2**19  # bytes of a field that stay in a processor's cache together with others


class Grid:
    """A uniform periodic grid in d = one, two or three dimensions.

    Parameters
    ----------
    shape : int or sequence of int
        Numbers of points along x, y and z, at least two each.
    lower, upper : float or sequence of float
        Ends of the box; a single number applies to all axes. A field has the same values at both ends; only the lower
        ends are points of the grid.

    Attributes
    ----------
    shape : tuple of int
    lower, upper, spacing : ndarray, shape (d,)
    cell : float
        Length, area or volume of a cell, which belongs to one point; h_x h_y in two dimensions.

    Raises
    ------
    ValueError
        If shapes disagree, or ends are not finite or in the wrong order.

    Examples
    --------
    >>> from eip_scipy.problems import Grid
    >>> grid = Grid((128, 64), (-4, -2), (4, 2))
    >>> grid.size, grid.cell
    (8192, 0.00390625)
    """

    def __init__(self, shape: Any, lower: Any, upper: Any) -> None:
        given = np.atleast_1d(np.asarray(shape))
        if given.ndim != 1 or not 1 <= given.size <= MOST_AXES or given.dtype.kind not in "iu" or np.any(given < 2):
            raise ValueError(f"Grid: shape must be one to three integers >= 2, got {shape!r}.")
        self.shape: tuple[int, ...] = tuple(int(n) for n in given)
        self.lower, self.upper = (self._ends(name, a) for name, a in (("lower", lower), ("upper", upper)))
        if np.any(self.upper <= self.lower):
            raise ValueError(f"Grid: upper must be above lower, got lower = {lower!r}, upper = {upper!r}.")
        self.spacing = (self.upper - self.lower) / self.shape
        self.cell = float(np.prod(self.spacing))

    def _ends(self, name: str, value: Any) -> np.ndarray:
        ends = real_array(name, value)
        if ends.ndim > 1 or (ends.ndim == 1 and ends.size != self.dim) or not np.isfinite(ends).all():
            raise ValueError(f"Grid: {name} must be a finite number or {self.dim} of them, got {value!r}.")
        return np.broadcast_to(ends, (self.dim,)).copy()

    def __repr__(self) -> str:
        return f"Grid({self.shape}, {tuple(self.lower.tolist())}, {tuple(self.upper.tolist())})"

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of points."""
        return int(np.prod(self.shape))

    def points(self, axis: int) -> np.ndarray:
        """Return the coordinates of the points along one axis, lower + j spacing."""
        return self.lower[axis] + self.spacing[axis] * np.arange(self.shape[axis])

    def mesh(self) -> tuple[np.ndarray, ...]:
        """Return the coordinates as arrays that broadcast to fields, for two axes of the shapes (J, 1) and (1, K)."""
        return tuple(self._along(axis, self.points(axis)) for axis in range(self.dim))

    def wavenumbers(self, axis: int, *, odd: bool = False) -> np.ndarray:
        """Return the wavenumbers along one axis, shaped as in `mesh`; if `odd`, that of the Nyquist mode is set to 0.

        The Nyquist mode, the highest mode of an even number of points, has no sign: odd derivatives of it are 0 at the
        points, even derivatives are not.
        """
        n = self.shape[axis]
        k = 2 * np.pi / (self.upper[axis] - self.lower[axis]) * np.fft.fftfreq(n, 1 / n)
        if odd and n % 2 == 0:
            k[n // 2] = 0.0
        return self._along(axis, k)

    def _along(self, axis: int, values: np.ndarray) -> np.ndarray:
        return values.reshape([-1 if k == axis else 1 for k in range(self.dim)])

    def field(self, y: Any) -> np.ndarray:
        """Return states as fields; the result is a view if `y` is contiguous.

        Parameters
        ----------
        y : array_like, shape (n,) or (n, m)
            One state, or m of them as the columns of ``sol.y``.

        Returns
        -------
        ndarray, shape (J[, K[, L]]) or (m, J[, K[, L]])

        Raises
        ------
        ValueError
            If y does not belong to this grid.
        """
        y = np.asarray(y)
        if y.ndim not in (1, 2) or y.shape[0] != self.size:
            raise ValueError(f"field: got shape {y.shape}, expected ({self.size},) or ({self.size}, m) for {self!r}.")
        return y.reshape(self.shape) if y.ndim == 1 else y.T.reshape(-1, *self.shape)


class Multiplier:
    """A real factor of the Fourier modes along some axes: transform, multiply, transform back.

    Parameters
    ----------
    grid : Grid
    axes : tuple of int
        The axes that are transformed.
    factor : array_like
        Array that broadcasts to fields. Along the axes that are not transformed it may vary with the position.
    """

    def __init__(self, grid: Grid, axes: Axes, factor: Any) -> None:
        self.axes = axes
        # A factor that does not change along the last axis is one number for each row.
        columns = 1 if np.shape(factor)[-1:] in ((), (1,)) and grid.dim > 1 else grid.shape[-1]
        full = np.broadcast_to(factor, (*grid.shape[:-1], columns))
        points = int(np.prod([grid.shape[axis] for axis in axes]))
        self._rows = int(np.prod(grid.shape[1:-1]))  # of one x
        self._factor = np.ascontiguousarray(full, dtype=float).reshape(-1, columns) / points
        self._strips: list[tuple[slice, np.ndarray, np.ndarray]] = []
        if axes == (0,) and self._factor.shape == grid.shape and columns > STRIP:
            strips = [slice(begin, begin + STRIP) for begin in range(0, columns, STRIP)]
            factors = [np.ascontiguousarray(self._factor[:, part]) for part in strips]
            rooms = {part.shape: np.empty(part.shape, complex) for part in factors}  # shared by strips of equal widths
            self._strips = [(part, f, rooms[f.shape]) for part, f in zip(strips, factors, strict=True)]

    def apply(self, fft: Transforms, psi: np.ndarray, out: np.ndarray, first: int = 0) -> None:
        """Fill `out` with the field whose modes are those of `psi` times the factor; `psi` is not changed.

        If x is not among the transformed axes, `psi` and `out` may be a slab of the field that begins at index `first`
        along x.
        """
        if self._strips and fft.gains_by_strips:
            for columns, factor, work in self._strips:
                fft.forward(psi[:, columns], self.axes, work)
                multiply(work, factor)
                fft.backward(work, self.axes)
                out[:, columns] = work
            return
        fft.forward(psi, self.axes, out)
        begin = first * self._rows
        multiply(out, self._factor[begin : begin + len(out) * self._rows])
        fft.backward(out, self.axes)

    def expectation(self, fft: Transforms, psi: np.ndarray, work: np.ndarray) -> float:
        """Return the grid's sum of conj(psi) times the field of `apply`, by one transform into `work` (Parseval)."""
        fft.forward(psi, self.axes, work)
        return float(weighted_square(work, self._factor))


class SpectralSum:
    """A sum of objects of `Multiplier`, a linear operator that is Hermitian to round-off.

    Parameters
    ----------
    grid : Grid
    fft : Transforms
    terms : sequence of Multiplier
        At least one multiplier.

    Attributes
    ----------
    single : bool
        True if there is only one term.
    """

    def __init__(self, grid: Grid, fft: Transforms, terms: Sequence[Multiplier]) -> None:
        self._fft, self._terms = fft, tuple(terms)
        self.single = len(self._terms) == 1
        self._work = np.empty(grid.shape, complex)
        whole = 0 in self._terms[-1].axes
        self._slab = grid.shape[0] if whole else max(1, SLAB // max(1, 16 * int(np.prod(grid.shape[1:]))))

    def parts(self, psi: np.ndarray, out: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Fill `out` with the sum of all terms except the last, applied to `psi`, and yield the last by slabs.

        A slab is a range of indices along x. It is yielded while it is in the cache. A single term is written to `out`.

        Yields
        ------
        (int, ndarray)
            Index along x, and a buffer to be added to `out` from there on. With only one term nothing is yielded.
        """
        first, *others = self._terms
        first.apply(self._fft, psi, out)
        for term in others[:-1]:
            term.apply(self._fft, psi, self._work)
            out += self._work
        for begin in range(0, out.shape[0], self._slab) if others else ():
            part = psi[begin : begin + self._slab]
            rest = self._work[: part.shape[0]]
            others[-1].apply(self._fft, part, rest, begin)
            yield begin, rest

    def apply(self, psi: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the operator applied to `psi`."""
        for begin, rest in self.parts(psi, out):
            out[begin : begin + rest.shape[0]] += rest

    def expectation(self, psi: np.ndarray) -> float:
        """Return the sum over the grid of conj(psi) times the operator applied to `psi`."""
        return sum(term.expectation(self._fft, psi, self._work) for term in self._terms)
