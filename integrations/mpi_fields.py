"""The rotating Gross-Pitaevskii equation with its field cut into slabs, one for each rank of an MPI communicator.

A rank holds the field at some of the points x, for all y and z. It transforms along y and z directly, and along x after
a transposition, after which it holds some of the points y, for all x and z. A right-hand side takes two transpositions,
and so does an energy, unless the right-hand side at the same state is known already.

Needs ``pip install "eip_scipy[mpi]"`` and an MPI library.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from eip_scipy.problems.gross_pitaevskii import Grid, GrossPitaevskii, Multiplier
from eip_scipy.problems.gross_pitaevskii.transforms import Axes, Transforms

from .mpi import MPI, gathered, total

__all__ = ["Slab", "SlabGrossPitaevskii", "Transposition"]


class Slab(Grid):
    """Part of a grid: consecutive points along one axis, and all points along the others.

    Parameters
    ----------
    whole : Grid
    axis : int
        Axis along which this is a part of the grid.
    part : slice
        Range of the points along `axis`; it must have a start and a stop.

    Attributes
    ----------
    whole, part
        The parameters of these names.
    shape : tuple of int
        Number of points of the part along each axis. The other attributes are those of the whole grid.
    """

    def __init__(self, whole: Grid, axis: int, part: slice) -> None:
        super().__init__(whole.shape, whole.lower, whole.upper)
        self.whole, self.part, self._axis = whole, part, axis
        self.shape = tuple(part.stop - part.start if k == axis else n for k, n in enumerate(whole.shape))

    def __repr__(self) -> str:
        return f"Slab({self.whole!r}, {self._axis}, {self.part!r})"

    def points(self, axis: int) -> np.ndarray:
        """Return the coordinates along one axis of the points of this part."""
        points = self.whole.points(axis)
        return points[self.part] if axis == self._axis else points

    def wavenumbers(self, axis: int, *, odd: bool = False) -> np.ndarray:
        """Return all wavenumbers of the whole grid along one axis, see `Grid.wavenumbers`."""
        return self.whole.wavenumbers(axis, odd=odd)


class Transposition:
    """Distribution of a field over the ranks in slabs of x or, after a transposition, in slabs of y.

    `turn` and `turn_back` send the points from one distribution to the other.

    Parameters
    ----------
    grid : Grid
        The whole grid.
    comm : mpi4py.MPI.Comm

    Attributes
    ----------
    slab, turned : Slab
        This rank's parts of the grid (J, K[, L]) in the two distributions: `slab` has j of the J points x, shape
        (j, K[, L]), and `turned` has k of the K points y, shape (J, k[, L]).
    here, image : ndarray, shape (J, k[, L])
        Buffers: the field that `turn` fills, and the one that `turn_back` reads.

    Raises
    ------
    ValueError
        If the grid has one dimension, or there are more ranks than points along x or y.
    """

    def __init__(self, grid: Grid, comm: MPI.Comm) -> None:
        if grid.dim == 1 or comm.size > min(grid.shape[:2]):
            raise ValueError(
                f"{comm.size} ranks need at least {comm.size} points along x and along y, got {grid!r}. Use fewer "
                "ranks or a larger grid, of two or three dimensions."
            )
        self._comm = comm
        cuts = ([n * rank // comm.size for rank in range(comm.size + 1)] for n in grid.shape[:2])
        xs, ys = ([slice(*ends) for ends in pairwise(places)] for places in cuts)
        self.slab, self.turned = Slab(grid, 0, xs[comm.rank]), Slab(grid, 1, ys[comm.rank])
        self.here, self.image = np.empty(self.turned.shape, complex), np.empty(self.turned.shape, complex)
        self._sent = np.empty(self.slab.size, complex)
        # Sizes and offsets of the data that MPI carries. The part that remains on this rank has size 0.
        away = [rank != comm.rank for rank in range(comm.size)]
        along_y, along_x = self.slab.size // grid.shape[1], self.turned.size // grid.shape[0]
        sizes = [along_y * (y.stop - y.start) * far for y, far in zip(ys, away, strict=True)]
        places = [sum(sizes[:rank]) for rank in range(comm.size)]
        self._apart = sizes, places
        self._turned = (
            [along_x * (x.stop - x.start) * far for x, far in zip(xs, away, strict=True)],
            [along_x * x.start for x in xs],
        )
        j, _, *columns = self.slab.shape
        self._blocks = [
            (y, self._sent[place : place + size].reshape(j, -1, *columns))
            for y, place, size in zip(ys, places, sizes, strict=True)
            if size
        ]

    def turn(self, field: np.ndarray) -> None:
        """Fill `here` with the transposed form of `field` (j, K[, L]), after checking that no rank has failed."""
        gathered(self._comm, ())
        for y, block in self._blocks:
            np.copyto(block, field[:, y])
        self.here[self.slab.part] = field[:, self.turned.part]
        self._comm.Alltoallv([self._sent, self._apart], [self.here, self._turned])

    def turn_back(self, out: np.ndarray) -> None:
        """Fill `out` (j, K[, L]) with the field whose transposed form is in `image`."""
        self._comm.Alltoallv([self.image, self._turned], [self._sent, self._apart])
        for y, block in self._blocks:
            np.copyto(out[:, y], block)
        out[:, self.turned.part] = self.image[self.slab.part]


class _TurnedMultiplier(Multiplier):
    """Multiplier of the modes along x, between two transpositions by `way`, by a real `factor` on the whole grid.

    `factor` (J, K[, L]) may have the length 1 along axes on which it does not depend.
    """

    def __init__(self, way: Transposition, factor: np.ndarray) -> None:
        self._way = way
        here = factor[:, way.turned.part] if factor.shape[1] > 1 else factor
        super().__init__(way.turned, (0,), here)

    def apply(self, fft: Transforms, psi: np.ndarray, out: np.ndarray, first: int = 0) -> None:
        """Fill `out` with the field `psi` whose modes along x are multiplied by the factor."""
        self._way.turn(psi)
        super().apply(fft, self._way.here, self._way.image)
        self._way.turn_back(out)

    def expectation(self, fft: Transforms, psi: np.ndarray, work: np.ndarray) -> float:
        """Return this rank's part of the sum over the grid of conj(psi) times the field of `apply`."""
        self._way.turn(psi)
        return super().expectation(fft, self._way.here, self._way.image)


class SlabGrossPitaevskii(GrossPitaevskii):
    """`GrossPitaevskii` on the ranks of an MPI communicator.

    Fields, states, gradients and right-hand sides are this rank's part of them. Mass, energy, angular momentum,
    chemical potential and the bounds of frequencies and steps are those of the whole field, the same number on every
    rank. All ranks must call these methods, in the same order.

    Parameters
    ----------
    grid : Grid
        The whole grid, in two or three dimensions.
    potential : callable or array_like, optional
        A callable gets the coordinates of this rank's points; values are given on the whole grid or on this part.
    comm : mpi4py.MPI.Comm, optional
        Default: ``MPI.COMM_WORLD``.
    **options
        Parameters of `GrossPitaevskii`.

    Attributes
    ----------
    comm : mpi4py.MPI.Comm
    grid : Slab
        This rank's part of the grid; the other attributes are those of `GrossPitaevskii`.

    Raises
    ------
    ValueError
        As for `GrossPitaevskii`, in one dimension, and if there are more ranks than points along x or y.

    Notes
    -----
    Splitting methods, ground states and vortices need the whole field: `gather` it.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import EIPRK4
    >>> from eip_scipy.integrations.mpi import over_ranks
    >>> from eip_scipy.integrations.mpi_fields import SlabGrossPitaevskii
    >>> from eip_scipy.problems import Grid, harmonic_trap
    >>> gpe = SlabGrossPitaevskii(Grid((32, 32), -6, 6), harmonic_trap(1, 1), Omega=0.5, beta=10)
    >>> x, y = gpe.grid.mesh()
    >>> psi = (x + 1j * y) * np.exp(-(x**2 + y**2) / 2)
    >>> sol = solve_ivp(gpe.fun, (0, 0.1), psi.ravel(), method=over_ranks(EIPRK4), h=0.01, invariants=gpe.invariants())
    >>> whole = gpe.gather(sol.y[:, -1])
    >>> whole is None or whole.shape == (32, 32)  # None except on rank 0
    True
    """

    grid: Slab

    def __init__(self, grid: Grid, potential: Any = None, *, comm: MPI.Comm | None = None, **options: Any) -> None:
        whole = grid.whole if isinstance(grid, Slab) else grid
        self.comm = MPI.COMM_WORLD if comm is None else comm
        self._way = Transposition(whole, self.comm)
        if np.shape(potential) == whole.shape:
            potential = np.asarray(potential)[self._way.slab.part]
        super().__init__(self._way.slab, potential, **options)
        self._options["comm"] = comm

    def part(self, whole: Any) -> np.ndarray:
        """Return this rank's part of a field that every rank has as a whole."""
        return np.ascontiguousarray(np.reshape(whole, self.grid.whole.shape)[self.grid.part], dtype=complex)

    def linear_terms(self) -> list[tuple[Axes, Any]]:
        """Return the terms of `GrossPitaevskii.linear_terms`.

        Without rotation, the kinetic term along x, which needs transpositions, is separate from that along other axes.
        """
        if self.Omega != 0:
            return super().linear_terms()
        along_x, *others = (self.kinetic_factor(axis) for axis in range(self.grid.dim))
        return [((0,), along_x), (tuple(range(1, self.grid.dim)), sum(others))]

    def gather(self, psi: Any) -> np.ndarray | None:
        """Return on rank 0 the whole field, of which `psi` is this rank's part, and None on other ranks."""
        field = self.as_field(psi)
        sizes = self.comm.gather(field.size)
        whole = np.empty(self.grid.whole.shape, complex) if self.comm.rank == 0 else None
        self.comm.Gatherv(field, None if whole is None else [whole, sizes])
        return whole

    def _method(self) -> None:
        return None

    def _total(self, sums: Any) -> Any:
        return total(self.comm, sums)

    def _largest(self, a: np.ndarray) -> float:
        return float(gathered(self.comm, super()._largest(a)).max())

    def _multiplier(self, axes: Axes, factor: Any) -> Multiplier:
        return _TurnedMultiplier(self._way, factor) if 0 in axes else Multiplier(self.grid, axes, factor)
