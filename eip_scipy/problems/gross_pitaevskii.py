"""The rotating Gross-Pitaevskii equation in one, two and three dimensions: right-hand side, invariants, and problem.

Within a step mass and energy follow from psi and f = -i H psi without transforms. The engine computes sums over the
grid in blocks of a few hundred points. Therefore they have the same bits on every machine, and their rounding error is
that of a sum over one block.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import scipy.fft

from ..core.invariants import Invariant
from ..core.names import nearest
from ..core.problem import Problem
from ..engine.native import BUILD

__all__ = ["FieldProblem", "Grid", "GrossPitaevskii", "Multiplier"]

Axes = tuple[int, ...]
STRIP = 64  # columns of a field of two dimensions that are transformed together along x
SLAB = 2**19  # bytes of a field that stay in a processor's cache together with others
NEGLIGIBLE = 1e-16  # less than half a rounding, of a bound that is far too large
INVARIANTS = ("mass", "energy", "angular_momentum")
SOURCE = "Cai, Gong & Wang, section 3.4 (eq. 3.9, 3.10), the quartic term as the sum of |psi|^4"


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
    dim, size : int
        Numbers of axes and of points.
    lower, upper, spacing : ndarray, shape (d,)
    cell : float
        Length, area or volume of a cell, which belongs to one point; h_x h_y in two dimensions.

    See Also
    --------
    GrossPitaevskii

    Examples
    --------
    >>> from eip_scipy.problems import Grid
    >>> Grid((128, 64), (-4, -2), (4, 2)).cell
    0.00390625
    """

    lower: np.ndarray
    upper: np.ndarray

    def __init__(self, shape: Any, lower: Any, upper: Any) -> None:
        given = np.atleast_1d(np.asarray(shape))
        if given.ndim != 1 or not 1 <= given.size <= 3 or given.dtype.kind not in "iu" or np.any(given < 2):
            raise ValueError(f"Grid: shape must be one to three integers >= 2, got {shape!r}.")
        self.shape: tuple[int, ...] = tuple(int(n) for n in given)
        self.dim, self.size = len(self.shape), int(np.prod(self.shape))
        for name, value in (("lower", lower), ("upper", upper)):
            ends = np.asarray(value, dtype=float)
            if ends.ndim > 1 or (ends.ndim == 1 and ends.size != self.dim) or not np.isfinite(ends).all():
                raise ValueError(f"Grid: {name} must be a finite number or {self.dim} of them, got {value!r}.")
            setattr(self, name, np.broadcast_to(ends, (self.dim,)).copy())
        if np.any(self.upper <= self.lower):
            raise ValueError(f"Grid: upper must be above lower, got lower = {lower!r}, upper = {upper!r}.")
        self.spacing = (self.upper - self.lower) / self.shape
        self.cell = float(np.prod(self.spacing))

    def __repr__(self) -> str:
        return f"Grid({self.shape}, {tuple(self.lower.tolist())}, {tuple(self.upper.tolist())})"

    def points(self, axis: int) -> np.ndarray:
        """Return the coordinates of the points along one axis, lower + j spacing."""
        return self.lower[axis] + self.spacing[axis] * np.arange(self.shape[axis])

    def mesh(self) -> tuple[np.ndarray, ...]:
        """Return the coordinates as arrays that broadcast to fields, for two axes of the shapes (J, 1) and (1, K)."""
        return tuple(self._along(axis, self.points(axis)) for axis in range(self.dim))

    def wavenumbers(self, axis: int, *, odd: bool = False) -> np.ndarray:
        """Return the wavenumbers along one axis, shaped as in `mesh`; if `odd`, that of the Nyquist mode is set to 0.

        The Nyquist mode is the highest one of an even number of points. Its odd derivatives are 0 at the points.
        """
        n = self.shape[axis]
        k = 2 * np.pi / (self.upper[axis] - self.lower[axis]) * np.fft.fftfreq(n, 1 / n)
        if odd and n % 2 == 0:
            k[n // 2] = 0.0
        return self._along(axis, k)

    def _along(self, axis: int, values: np.ndarray) -> np.ndarray:
        return values.reshape([-1 if k == axis else 1 for k in range(self.dim)])

    def field(self, y: Any) -> np.ndarray:
        """Return a state (n,), or the columns of ``sol.y`` (n, m), as fields: (J[, K[, L]]) or (m, J[, K[, L]])."""
        y = np.asarray(y)
        if y.ndim not in (1, 2) or y.shape[0] != self.size:
            raise ValueError(f"field: got shape {y.shape}, expected ({self.size},) or ({self.size}, m) for {self!r}.")
        return y.reshape(self.shape) if y.ndim == 1 else y.T.reshape(-1, *self.shape)


class Transforms:
    """Fourier transforms of contiguous complex fields along some axes, without normalisation in both directions.

    They are those of ducc0 if it is installed, which is about twice as fast, otherwise those of SciPy.
    """

    def __init__(self, threads: int) -> None:
        if isinstance(threads, bool) or not isinstance(threads, (int, np.integer)) or threads < 1:
            raise ValueError(f"threads must be an integer >= 1, got {threads!r}.")
        self._threads = int(threads)
        self._c2c = None if find_spec("ducc0") is None else import_module("ducc0").fft.c2c
        # SciPy's transforms along x are faster for some copied columns at a time than for a whole field.
        self.gains_by_strips = self._c2c is None

    def forward(self, field: np.ndarray, axes: Axes, out: np.ndarray) -> None:
        """Fill `out` with the transform of `field`, sum_j field_j exp(-i k x_j), along `axes`."""
        if self._c2c is None:
            np.copyto(out, field)
            self._in_place(scipy.fft.fftn, out, axes, "backward")
        else:
            self._c2c(field, axes=axes, forward=True, out=out, nthreads=self._threads)

    def backward(self, field: np.ndarray, axes: Axes) -> None:
        """Replace `field` by its inverse transform along `axes`, times the number of points along them."""
        if self._c2c is None:
            self._in_place(scipy.fft.ifftn, field, axes, "forward")
        else:
            self._c2c(field, axes=axes, forward=False, out=field, nthreads=self._threads)

    def _in_place(self, transform: Any, field: np.ndarray, axes: Axes, norm: str) -> None:
        # SciPy may, but need not, overwrite what it is given.
        result = transform(field, axes=axes, norm=norm, overwrite_x=True, workers=self._threads)
        if result is not field:
            np.copyto(field, result)


class Multiplier:
    """A real factor of the Fourier modes along some axes: transform, multiply, transform back.

    The array `factor` broadcasts to fields. Along the axes that are not transformed it may vary with the position.
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
        """Fill `out` with the field whose modes are those of `psi` times the factor.

        If x is not transformed, `psi` and `out` may be a slab of the field that begins at index `first` along x.
        """
        if self._strips and fft.gains_by_strips:
            for columns, factor, work in self._strips:
                fft.forward(psi[:, columns], self.axes, work)
                BUILD.condensates.multiply(work, factor)
                fft.backward(work, self.axes)
                out[:, columns] = work
            return
        fft.forward(psi, self.axes, out)
        begin = first * self._rows
        BUILD.condensates.multiply(out, self._factor[begin : begin + len(out) * self._rows])
        fft.backward(out, self.axes)

    def expectation(self, fft: Transforms, psi: np.ndarray, work: np.ndarray) -> float:
        """Return the grid's sum of conj(psi) times the field of `apply`, by one transform into `work` (Parseval)."""
        fft.forward(psi, self.axes, work)
        return float(BUILD.condensates.weighted_square(work, self._factor))


class SpectralSum:
    """A sum of one (if `single`) or more objects of `Multiplier`, a linear operator that is Hermitian to round-off."""

    def __init__(self, grid: Grid, fft: Transforms, terms: Sequence[Multiplier]) -> None:
        self._fft, self._terms = fft, tuple(terms)
        self.single = len(self._terms) == 1
        self._work = np.empty(grid.shape, complex)
        whole = 0 in self._terms[-1].axes
        self._slab = grid.shape[0] if whole else max(1, SLAB // max(1, 16 * int(np.prod(grid.shape[1:]))))

    def parts(self, psi: np.ndarray, out: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Fill `out` with the first term applied to `psi`, and yield the others by slabs along x, while in the cache.

        A slab is its first index and a buffer to be added to `out` from there on.
        """
        first, *others = self._terms
        first.apply(self._fft, psi, out)
        for term in others:
            for begin in range(0, out.shape[0], self._slab):
                part = psi[begin : begin + self._slab]
                rest = self._work[: part.shape[0]]
                term.apply(self._fft, part, rest, begin)
                yield begin, rest

    def apply(self, psi: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the operator applied to `psi`."""
        for begin, rest in self.parts(psi, out):
            out[begin : begin + rest.shape[0]] += rest

    def expectation(self, psi: np.ndarray) -> float:
        """Return the sum over the grid of conj(psi) times the operator applied to `psi`."""
        return sum(term.expectation(self._fft, psi, self._work) for term in self._terms)


@dataclass(frozen=True, eq=False, repr=False)
class FieldProblem(Problem):
    """A `Problem` whose state is a field on the grid of its `equation`; ``equation.grid.field(y)`` shapes states.

    See Also
    --------
    GrossPitaevskii, Problem

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy.problems import Grid, GrossPitaevskii
    >>> problem = GrossPitaevskii(Grid((32,), -8, 8), lambda x: x**2 / 2).problem(np.ones(32) / 4, 1.0)
    >>> problem.equation.grid.field(problem.y0).shape
    (32,)
    """

    equation: GrossPitaevskii = None  # type: ignore[assignment]  # always given


class GrossPitaevskii:
    """The equation ``i psi_t = H(psi) psi`` with ``H = -Laplace / 2 + V - Omega Lz + beta |psi|^2``.

    Here ``Lz = -i (x d_y - y d_x)``. The discretisation in space is Fourier pseudospectral. The linear part takes one
    pair of transforms along each axis, for real factors ``k^2 / 2 + Omega y k`` of the modes along x, and ``q^2 / 2 -
    Omega x q`` of those along y.

    Parameters
    ----------
    grid : Grid
    potential : callable or array_like, optional
        ``potential(x[, y[, z]])``, real, of coordinates that broadcast, or its values on the grid. Default: 0.
    Omega : float, optional
        Angular velocity about the z axis, in two or three dimensions.
    beta : float, optional
        Strength of the interaction: > 0 repulsive, < 0 attractive.
    nyquist : {"true", "zero"}, optional
        Factor of the Nyquist mode in the second derivative: that of its own wavenumber, or 0, as if the first
        derivative was applied twice (as in the tables of Cai, Gong & Wang).
    threads : int, optional
        Threads of the Fourier transforms. These are about twice as fast with ``pip install "eip_scipy[fft]"``, which
        installs ducc0 (under the GPL licence).

    Attributes
    ----------
    grid, Omega, beta, nyquist
        As given.
    V : ndarray
        The potential on the grid.

    Raises
    ------
    ValueError
        If a value is wrong, the potential is complex, not finite or of a wrong shape, or `Omega` is not 0 in 1D.

    See Also
    --------
    Grid, FieldProblem

    Notes
    -----
    Each object has its own buffers; use a separate object in each thread.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import GrossPitaevskii, Grid
    >>> gpe = GrossPitaevskii(Grid((32, 32), -6, 6), lambda x, y: (x**2 + y**2) / 2, Omega=0.5, beta=10)
    >>> x, y = gpe.grid.mesh()
    >>> psi = (x + 1j * y) * np.exp(-(x**2 + y**2) / 2)
    >>> run = integrate(gpe.problem(psi, t_end=0.1, h=0.01), method=EIPRK4)
    >>> gpe.grid.field(run.y[:, -1]).shape
    (32, 32)
    """

    def __init__(
        self,
        grid: Grid,
        potential: Any = None,
        *,
        Omega: float = 0.0,
        beta: float = 0.0,
        nyquist: str = "true",
        threads: int = 1,
    ) -> None:
        if nyquist not in ("true", "zero"):
            raise ValueError(f"nyquist must be 'true' or 'zero', got {nyquist!r}.")
        for name, value in (("Omega", Omega), ("beta", beta)):
            if not isinstance(value, (int, float, np.integer, np.floating)) or not np.isfinite(value):
                raise ValueError(f"{name} must be a finite number, got {value!r}.")
        if Omega != 0 and grid.dim == 1:
            raise ValueError(f"a rotation needs two or three dimensions, got Omega={Omega!r} on {grid!r}; use Omega=0.")
        self.grid, self.Omega, self.beta, self.nyquist = grid, float(Omega), float(beta), nyquist
        self.V = _on_grid(potential, grid)
        self.transforms = Transforms(threads)
        self._linear = self._operator(self._linear_terms())

    def __repr__(self) -> str:
        return f"GrossPitaevskii({self.grid!r}, Omega={self.Omega:g}, beta={self.beta:g})"

    def kinetic_factor(self, axis: int) -> np.ndarray:
        """Return the factor k^2 / 2 of the modes along one axis, as an array that broadcasts to fields."""
        k = self.grid.wavenumbers(axis, odd=self.nyquist == "zero")
        return 0.5 * k * k

    def rotation_factors(self) -> list[np.ndarray]:
        """Return the factors of Lz = x q - y k: -y k of the modes along x, and x q of the modes along y."""
        if self.grid.dim == 1:
            raise ValueError("the grid has one dimension; a rotation and angular momentum need two or three.")
        x, y, *_ = self.grid.mesh()
        k, q = (self.grid.wavenumbers(axis, odd=True) for axis in (0, 1))
        return [-y * k, x * q]

    def _linear_terms(self) -> list[tuple[Axes, Any]]:
        # With the fewest transforms.
        kinetic = [self.kinetic_factor(axis) for axis in range(self.grid.dim)]
        if self.Omega == 0:
            return [(tuple(range(self.grid.dim)), sum(kinetic))]
        along_x, along_y = self.rotation_factors()
        others = tuple(range(1, self.grid.dim))
        return [((0,), kinetic[0] - self.Omega * along_x), (others, sum(kinetic[1:]) - self.Omega * along_y)]

    def _operator(self, terms: Sequence[tuple[Axes, Any]]) -> SpectralSum:
        return SpectralSum(self.grid, self.transforms, [Multiplier(self.grid, *term) for term in terms])

    @cached_property
    def _rotation(self) -> SpectralSum:
        return self._operator([((axis,), factor) for axis, factor in enumerate(self.rotation_factors())])

    def as_field(self, psi: Any) -> np.ndarray:
        """Return `psi`, a field or a flat state, as a contiguous complex field; ValueError for another shape."""
        psi = np.ascontiguousarray(psi, dtype=complex)
        if psi.shape not in (self.grid.shape, (self.grid.size,)):
            raise ValueError(f"psi has shape {psi.shape}, expected {self.grid.shape} or ({self.grid.size},).")
        return psi.reshape(self.grid.shape)

    def rhs(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with -i H(psi) psi; `y` and `out` are flat, contiguous, and different arrays."""
        linear, psi, image = self._linear, y.reshape(self.grid.shape), out.reshape(self.grid.shape)
        for begin, rest in linear.parts(psi, image):
            part = slice(begin, begin + len(rest))
            BUILD.condensates.derivative(rest, psi[part], self.V[part], self.beta, image[part])
        if linear.single:
            BUILD.condensates.derivative_at_once(psi, self.V, self.beta, image)

    def fun(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return -i H(psi) psi as a new flat array, as `solve_ivp` needs it."""
        y = np.ascontiguousarray(y, dtype=complex)
        out = np.empty_like(y)
        self.rhs(t, y, out)
        return out

    def linear(self, psi: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with (-Laplace / 2 - Omega Lz) psi; `psi` and `out` are fields."""
        self._linear.apply(psi, out)

    def angular(self, psi: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with Lz psi; `psi` and `out` are fields in two or three dimensions."""
        self._rotation.apply(psi, out)

    def mass(self, psi: Any) -> float:
        """Return the sum of ``|psi|^2`` over the grid, times the size of a cell; it is 1 for a normalised state."""
        return float(self.grid.cell * BUILD.condensates.total_mass(self.as_field(psi)))

    def energy(self, psi: Any) -> float:
        """Return the kinetic, potential and rotational energy, plus beta / 2 times the sum of ``|psi|^4``."""
        psi = self.as_field(psi)
        return self._energy(BUILD.condensates.moments(psi, self.fun(0.0, psi.reshape(-1))))

    def _energy(self, sums: Any) -> float:
        # The second sum, of Re(conj(psi) H psi), has the interaction energy, beta / 2 times the fourth one, twice.
        return float(self.grid.cell * (sums[1] - 0.5 * self.beta * sums[3]))

    def angular_momentum(self, psi: Any) -> float:
        """Return the angular momentum, the mean of Lz times the mass, in two or three dimensions."""
        return float(self.grid.cell * self._rotation.expectation(self.as_field(psi)))

    def invariants(self, names: Sequence[str] = ("mass", "energy")) -> tuple[Invariant, ...]:
        """Return those invariants of the equation that `names` lists.

        Parameters
        ----------
        names : sequence of {"mass", "energy", "angular_momentum"}, optional
            Mass and energy are invariants of the equations on the grid for every field. The angular momentum is
            conserved only as far as the grid resolves the field, if the potential is symmetric about the z axis and the
            field vanishes at the ends of the box.

        Returns
        -------
        tuple of Invariant
            The gradients are 2 w psi, 2 w H psi and 2 w Lz psi, with the size w of a cell. That of the energy is a
            multiple of the right-hand side, which the step evaluates once for it and for the first stage of the next
            step (`reuse_f`). If mass and energy, or one of them, are passed on unchanged and without other invariants,
            a projection takes two passes over the field.
        """
        names = (names,) if isinstance(names, str) else tuple(names)
        items = tuple(self._invariant(name) for name in names)
        joint = items and len(set(names)) == len(names) and "angular_momentum" not in names
        return _MassAndEnergy(items, self) if joint else items

    def _invariant(self, name: str) -> Invariant:
        if name == "mass":
            return Invariant(partial(_at, self.mass), self._mass_gradient, name=name, in_place=True)
        if name == "energy":
            known = _KnownEnergy(self)
            return Invariant(known.value, known.gradient, name=name, in_place=True, uses_f=True)
        if name == "angular_momentum":
            return Invariant(partial(_at, self.angular_momentum), self._angular_gradient, name=name, in_place=True)
        expected = f"{', '.join(INVARIANTS)}{nearest(name, INVARIANTS)}"
        raise ValueError(f"unknown invariant {name!r}, expected {expected}")

    def _mass_gradient(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        np.multiply(y.view(float), 2 * self.grid.cell, out=out.view(float))

    def _angular_gradient(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        self.angular(y.reshape(self.grid.shape), out.reshape(self.grid.shape))
        out *= 2 * self.grid.cell

    def problem(
        self,
        psi0: Any,
        t_end: float,
        h: float | None = None,
        *,
        invariants: Sequence[str] = ("mass", "energy"),
        **options: Any,
    ) -> FieldProblem:
        """Return the initial value problem. Its metric is Euclidean, because all points of the grid are equivalent.

        Parameters
        ----------
        psi0 : array_like
            The field at t = 0, of the grid's shape or flat.
        t_end : float
            End of the interval that starts at 0.
        h : float, optional
            Length of the step. An explicit method needs one below `largest_step`.
        invariants : sequence of str, optional
            Names of the invariants, see `invariants`.
        **options
            Further fields of `Problem`, such as `name` and `reference`.
        """
        options = {"name": "gross-pitaevskii", "source": SOURCE, **options}
        return FieldProblem(
            fun=self.fun,
            rhs=self.rhs,
            y0=self.as_field(psi0).reshape(-1).copy(),
            t_span=(0.0, t_end),
            h=h,
            invariants=self.invariants(invariants),
            metric="euclidean",
            units="dimensionless",
            equation=self,
            **options,
        )

    def largest_frequency(self) -> float:
        """Return an upper bound of the norm of the linear part and the potential, the sum of bounds of the terms."""
        kinetic = sum(float(self.kinetic_factor(axis).max()) for axis in range(self.grid.dim))
        turning = sum(float(np.abs(f).max()) for f in self.rotation_factors()) if self.Omega else 0.0
        return kinetic + abs(self.Omega) * turning + float(np.abs(self.V).max())

    def largest_step(self, psi: Any, limit: float = 2 * 2**0.5) -> float:
        """Return a step up to which an explicit method is stable; somewhat longer ones may be stable too.

        Parameters
        ----------
        psi : array_like
            A field whose largest density ``|psi|^2`` is typical of the run.
        limit : float, optional
            Largest stable value of h times the largest frequency for the method; default: that of RK4, 2 sqrt(2).
        """
        # Twice the interaction: the linearised term is 2 beta |psi|^2 u + beta psi^2 conj(u).
        local = 2 * abs(self.beta) * float(np.abs(self.as_field(psi)).max()) ** 2
        return float(limit / (self.largest_frequency() + local))


def _at(value: Any, t: float, y: np.ndarray) -> float:
    return float(value(y))


def _on_grid(potential: Any, grid: Grid) -> np.ndarray:
    """Return the values (J[, K[, L]]) of a potential on the grid."""
    values = np.asarray(potential(*grid.mesh()) if callable(potential) else 0.0 if potential is None else potential)
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise ValueError(f"potential must be real and finite everywhere on the grid, got {values.dtype} values.")
    try:
        values = np.broadcast_to(values, grid.shape)
    except ValueError:
        raise ValueError(f"potential has shape {values.shape}, which does not fit {grid!r}.") from None
    return np.ascontiguousarray(values, dtype=float)


class _KnownEnergy:
    """Energy of a state at which f = -i H psi is known, and, by an expansion, of states at distances of about 1e-12."""

    def __init__(self, gpe: GrossPitaevskii) -> None:
        self._gpe, self._norm = gpe, gpe.largest_frequency()
        self.energy, self._peak = 0.0, np.inf  # the latter a bound of |psi|^2
        self._near: tuple[np.ndarray, np.ndarray] | None = None  # the state of the last `gradient` and f there

    def note(self, psi: np.ndarray, f: np.ndarray) -> Any:
        """Store the energy of a state, computed from f at this state, and return the sums from which it follows."""
        sums = BUILD.condensates.moments(psi, f)
        self.energy, self._peak = self._gpe._energy(sums), sums[3] ** 0.5
        return sums

    def beside(self, square: float, slope: float) -> float | None:
        """Return the energy of psi + d, where psi is the state of the last `note`, or None if it is not accurate.

        `square` is the sum of ``|d|^2``, and `slope` that of Re(conj(H psi) d).
        """
        cell = self._gpe.grid.cell
        density = 3 * self._peak + 2 * (self._peak * square) ** 0.5 + 0.5 * square
        rest = (self._norm + abs(self._gpe.beta) * density) * square
        return self.energy + 2 * cell * slope if cell * rest <= NEGLIGIBLE * abs(self.energy) else None

    def value(self, t: float, y: np.ndarray) -> float:
        """Return the energy of a state, without a transform if the state is very near that of the last `gradient`."""
        energy = None
        if self._near is not None:
            energy = self.beside(*BUILD.condensates.expansion(self._gpe.as_field(y), *self._near))
        return self._gpe.energy(y) if energy is None else energy

    def gradient(self, t: float, y: np.ndarray, f: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the gradient 2 w i f at `y`, with the right-hand side f and the size w of a cell."""
        BUILD.condensates.turn(f, 2 * self._gpe.grid.cell, out)  # 2 w H psi, and H psi = i f
        if self._near is None:
            self._near = np.empty_like(y), np.empty_like(f)  # copies, for the caller may use its arrays again
        for kept, given in zip(self._near, (y, f), strict=True):
            kept[:] = given
        self.note(y, f)


class _MassAndEnergy(tuple[Invariant, ...]):
    """The invariants "mass" and "energy", or one of them, whose projection takes two passes over the field.

    The gradients 2 w psi and 2 w H psi = 2 w i f are never stored: their products and the energy are sums over psi and
    f. Runs for which `core.projection` allows it call `moments` and `shift`. All other runs, and steps whose gradients
    are nearly parallel, call the values and gradients of the items.
    """

    _gpe: GrossPitaevskii
    _known: _KnownEnergy
    _mass: int | None
    _energy: int | None

    def __new__(cls, items: Iterable[Invariant], gpe: GrossPitaevskii) -> _MassAndEnergy:
        self = super().__new__(cls, items)
        self._gpe, self._known = gpe, _KnownEnergy(gpe)
        names = [item.name for item in self]
        self._mass, self._energy = (names.index(name) if name in names else None for name in ("mass", "energy"))
        return self

    def __getnewargs__(self) -> tuple[Any, ...]:
        return tuple(self), self._gpe

    def replaced(self, items: Iterable[Invariant]) -> _MassAndEnergy:
        """Return the same invariants with other targets; `items` are copies of them."""
        return type(self)(items, self._gpe)

    def moments(
        self, t: float, y: np.ndarray, f: np.ndarray, values: np.ndarray, gram: np.ndarray, terms: np.ndarray
    ) -> None:
        """Fill in the invariants (l,), the products of their gradients (l, l), and the sums ``|G_k y_k|`` (l,) at y."""
        (mass, along, square, _, sizes), w = self._known.note(y, f), self._gpe.grid.cell
        m, e = self._mass, self._energy
        if m is not None:
            values[m], gram[m, m], terms[m] = w * mass, 4 * w * w * mass, 2 * w * mass
        if e is not None:
            values[e], gram[e, e], terms[e] = self._known.energy, 4 * w * w * square, 2 * w * sizes
        if m is not None and e is not None:
            gram[m, e] = gram[e, m] = 4 * w * w * along

    def shift(
        self, t: float, y: np.ndarray, f: np.ndarray, mu: np.ndarray, out: np.ndarray, values: np.ndarray
    ) -> None:
        """Fill `out` with ``y + sum_i mu_i G_i(y)``, and `values` with the invariants there.

        y and f are those of the last `moments`. Only a large shift needs a transform for the energy.
        """
        gpe, w = self._gpe, self._gpe.grid.cell
        a, b = (0.0 if k is None else 2 * w * mu[k] for k in (self._mass, self._energy))
        mass, square, slope = BUILD.condensates.shifted(y, f, a, b, out)
        if self._mass is not None:
            values[self._mass] = w * mass
        if self._energy is not None:
            energy = self._known.beside(square, slope)
            values[self._energy] = gpe.energy(out) if energy is None else energy
