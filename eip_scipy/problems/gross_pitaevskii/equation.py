"""The rotating Gross-Pitaevskii equation on a periodic grid: right-hand side, invariants, and initial value problem.

With phenomenological damping and losses, mass and energy are balances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from ...core.balances import Balance
from ...core.inputs import is_number, real_array, shown
from ...core.invariants import Invariant, JointInvariants
from ...core.problem import Problem
from ..named_invariants import checked_damping, damped_invariant, named_invariant
from .grid import Grid, Multiplier, SpectralSum
from .pointwise import Energy, Joint, Moments, add_potential, derivative, derivative_at_once, moments, total_mass
from .splitting import Splitting
from .transforms import Axes, make_transforms

__all__ = ["DampedGrossPitaevskii", "FieldProblem", "GrossPitaevskii", "on_grid"]

NYQUIST = ("true", "zero")
MOMENTA = ("momentum_x", "momentum_y", "momentum_z")
INVARIANTS = ("mass", "energy", *MOMENTA, "angular_momentum")
SOURCE = "Cai, Gong & Wang, section 3.4 (eq. 3.9, 3.10), the quartic term as the sum of |psi|^4"


@dataclass(frozen=True, eq=False, repr=False)
class FieldProblem(Problem):
    """A `Problem` whose state is a field on a grid.

    Attributes
    ----------
    equation : GrossPitaevskii
        The equation. ``equation.grid`` is the grid, and ``equation.grid.field(y)`` returns states as fields. The other
        attributes are those of `Problem`.
    """

    equation: GrossPitaevskii | None = None


class GrossPitaevskii:
    """The equation ``i psi_t = H(psi) psi`` with ``H = -Laplace / 2 + V - Omega Lz + beta |psi|^2``.

    Here ``Lz = -i (x d_y - y d_x)``. The discretisation in space is Fourier pseudospectral. The linear part is a sum of
    real factors of Fourier modes: ``k^2 / 2 + Omega y k`` for the modes along x, and ``q^2 / 2 - Omega x q`` for those
    along y. One pair of transforms along each axis is enough for the linear part, including the rotation.

    Parameters
    ----------
    grid : Grid
    potential : callable or array_like, optional
        ``potential(x[, y[, z]])``, real, of coordinates that broadcast, or its values on the grid. Default: 0.
    Omega : float, optional
        Angular velocity about the z axis; needs two dimensions at least.
    beta : float, optional
        Strength of the interaction: > 0 repulsive, < 0 attractive.
    nyquist : {"true", "zero"}, optional
        Factor of the Nyquist mode in the second derivative: that of its own wavenumber, or 0, as if the first
        derivative was applied twice (as in the tables of Cai, Gong & Wang).
    fft : {"auto", "ducc0", "scipy"}, optional
        See `make_transforms`.
    threads : int, optional
        Threads of the transforms.

    Attributes
    ----------
    grid, Omega, beta, nyquist
        As given.
    V : ndarray
        The potential on the grid.
    transforms : Transforms
        The Fourier transforms of the library `fft`.
    fft : str
        Name of the library of the transforms.

    Raises
    ------
    ValueError
        If a value is wrong, the potential is complex, not finite or of a wrong shape, or `Omega` is not 0 in 1D.

    Notes
    -----
    Each object has its own buffers; use a separate object in each thread.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import EIPRK4
    >>> from eip_scipy.problems import GrossPitaevskii, Grid, harmonic_trap
    >>> gpe = GrossPitaevskii(Grid((32, 32), -6, 6), harmonic_trap(1, 1), Omega=0.5, beta=10)
    >>> x, y = gpe.grid.mesh()
    >>> psi = (x + 1j * y) * np.exp(-(x**2 + y**2) / 2)
    >>> sol = solve_ivp(gpe.fun, (0, 0.1), psi.ravel(), method=EIPRK4, h=0.01, metric="euclidean",
    ...                 invariants=gpe.invariants())
    >>> gpe.grid.field(sol.y).shape
    (11, 32, 32)
    """

    def __init__(
        self,
        grid: Grid,
        potential: Any = None,
        *,
        Omega: float = 0.0,
        beta: float = 0.0,
        nyquist: str = "true",
        fft: str = "auto",
        threads: int = 1,
    ) -> None:
        if nyquist not in NYQUIST:
            raise ValueError(f"nyquist must be 'true' or 'zero', got {nyquist!r}.")
        for name, value in (("Omega", Omega), ("beta", beta)):
            if not isinstance(value, (int, float, np.integer, np.floating)) or not np.isfinite(value):
                raise ValueError(f"{name} must be a finite number, got {value!r}.")
        if Omega != 0 and grid.dim == 1:
            raise ValueError(
                f"a rotation needs at least two dimensions, got Omega = {Omega!r} on {grid!r}; use Omega=0."
            )
        self.grid, self.Omega, self.beta, self.nyquist = grid, float(Omega), float(beta), nyquist
        self.V = on_grid(potential, grid)
        self.transforms = make_transforms(fft, threads)
        self.fft = self.transforms.name
        self._options = {"nyquist": nyquist, "fft": fft, "threads": threads}
        terms = [self._multiplier(*term) for term in self.linear_terms()]
        self._linear = SpectralSum(grid, self.transforms, terms)

    def __repr__(self) -> str:
        return f"GrossPitaevskii({self.grid!r}, Omega={self.Omega:g}, beta={self.beta:g})"

    def changed(self, **options: Any) -> GrossPitaevskii:
        """Return the equation on the same grid with other values of `potential`, `Omega`, `beta` and other options."""
        options = {"potential": self.V, "Omega": self.Omega, "beta": self.beta, **self._options, **options}
        return type(self)(self.grid, **options)

    def kinetic_factor(self, axis: int) -> np.ndarray:
        """Return the factor k^2 / 2 of the modes along one axis, as an array that broadcasts to fields."""
        k = self.grid.wavenumbers(axis, odd=self.nyquist == "zero")
        return 0.5 * k * k

    def rotation_factors(self) -> list[np.ndarray]:
        """Return the factors of Lz = x q - y k: -y k of the modes along x, and x q of the modes along y.

        Both are arrays that broadcast to fields.

        Raises
        ------
        ValueError
            If the grid has one dimension.
        """
        if self.grid.dim == 1:
            raise ValueError("rotation_factors: the grid has one dimension; a rotation needs two or three.")
        x, y, *_ = self.grid.mesh()
        k, q = (self.grid.wavenumbers(axis, odd=True) for axis in (0, 1))
        return [-y * k, x * q]

    @cached_property
    def _turning(self) -> SpectralSum:
        if self.grid.dim == 1:
            raise ValueError("the grid has one dimension; angular momentum needs two or three.")
        terms = [self._multiplier((axis,), factor) for axis, factor in enumerate(self.rotation_factors())]
        return SpectralSum(self.grid, self.transforms, terms)

    @cached_property
    def _moving(self) -> tuple[SpectralSum, ...]:
        """Return the operators -i times the first derivative, one for each axis."""
        factors = [self.grid.wavenumbers(axis, odd=True) for axis in range(self.grid.dim)]
        terms = [self._multiplier((axis,), factor) for axis, factor in enumerate(factors)]
        return tuple(SpectralSum(self.grid, self.transforms, [term]) for term in terms)

    # These four a field on several ranks does in another way (`eip_scipy.integrations.mpi_fields`).

    def _method(self) -> Splitting | None:
        """Return the method that problems of the equation use by default; None for the default of `integrate`."""
        return Splitting(self)

    def _total(self, sums: Any) -> Any:
        """Return the sums over the whole grid, from the sums over the part of this process (here the whole grid)."""
        return sums

    def _multiplier(self, axes: Axes, factor: Any) -> Multiplier:
        return Multiplier(self.grid, axes, factor)

    def _largest(self, a: np.ndarray) -> float:
        return float(np.abs(a).max())

    def linear_terms(self) -> list[tuple[Axes, Any]]:
        """Return the linear part, kinetic energy and rotation, as pairs (axes, factor of the modes along them).

        The terms are chosen so that the number of transforms is smallest: without rotation one term of all axes,
        otherwise one term of x and one of y and z.
        """
        kinetic = [self.kinetic_factor(axis) for axis in range(self.grid.dim)]
        if self.Omega == 0:
            return [(tuple(range(self.grid.dim)), sum(kinetic))]
        along_x, along_y = self.rotation_factors()
        others = tuple(range(1, self.grid.dim))
        return [((0,), kinetic[0] - self.Omega * along_x), (others, sum(kinetic[1:]) - self.Omega * along_y)]

    def as_field(self, psi: Any) -> np.ndarray:
        """Return `psi`, a field or a flat state, as a contiguous complex field.

        Raises
        ------
        ValueError
            If `psi` has another shape.
        """
        psi = np.ascontiguousarray(psi, dtype=complex)
        if psi.shape not in (self.grid.shape, (self.grid.size,)):
            raise ValueError(f"psi has shape {psi.shape}, expected {self.grid.shape} or ({self.grid.size},).")
        return psi.reshape(self.grid.shape)

    def rhs(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with -i H(psi) psi; `y` and `out` are flat, contiguous, and different arrays."""
        linear, psi, image = self._linear, y.reshape(self.grid.shape), out.reshape(self.grid.shape)
        for begin, rest in linear.parts(psi, image):
            part = slice(begin, begin + len(rest))
            derivative(rest, psi[part], self.V[part], self.beta, image[part])
        if linear.single:
            derivative_at_once(psi, self.V, self.beta, image)

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
        """Fill `out` with Lz psi; `psi` and `out` are fields.

        Raises
        ------
        ValueError
            If the grid has one dimension.
        """
        self._turning.apply(psi, out)

    def hamiltonian(self, psi: Any) -> np.ndarray:
        """Return H(psi) psi as a field."""
        psi = self.as_field(psi)
        out = np.empty_like(psi)
        self.linear(psi, out)
        add_potential(psi, self.V, self.beta, out)
        return out

    def mass(self, psi: Any) -> float:
        """Return the sum of ``|psi|^2`` over the grid, times the size of a cell; it is 1 for a normalised state."""
        return float(self.grid.cell * self._total(total_mass(self.as_field(psi))))

    def energy(self, psi: Any) -> float:
        """Return the sum of kinetic, potential, rotational and interaction energy.

        The interaction energy is beta / 2 times the sum of ``|psi|^4`` over the grid, times the size of a cell.
        """
        psi = self.as_field(psi)
        return self.grid.cell * self.moments(psi, self.fun(0.0, psi.reshape(-1))).energy(self.beta)

    def moments(self, psi: np.ndarray, f: np.ndarray) -> Moments:
        """Return the sums over the grid that give mass, energy and products of their gradients; f is fun(t, psi)."""
        return Moments(*map(float, self._total(moments(psi, f))))

    def angular_momentum(self, psi: Any) -> float:
        """Return the angular momentum, the mean of Lz times the mass.

        Raises
        ------
        ValueError
            If the grid has one dimension.
        """
        return float(self.grid.cell * self._total(self._turning.expectation(self.as_field(psi))))

    def momentum(self, psi: Any) -> np.ndarray:
        """Return the momenta (d,) along the d axes: the means of -i times the derivatives, times the mass."""
        psi = self.as_field(psi)
        return self.grid.cell * np.array([self._total(along.expectation(psi)) for along in self._moving])

    def chemical_potential(self, psi: Any) -> float:
        """Return the chemical potential, the mean of H: mu = Re <H(psi) psi, psi> / <psi, psi>."""
        psi = self.as_field(psi)
        above, below = self._total((np.vdot(psi, self.hamiltonian(psi)).real, np.vdot(psi, psi).real))
        return float(above / below)

    def _mass_gradient(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        np.multiply(y.view(float), 2 * self.grid.cell, out=out.view(float))

    def _angular_momentum_gradient(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        self.angular(y.reshape(self.grid.shape), out.reshape(self.grid.shape))
        out *= 2 * self.grid.cell

    def _momentum_along(self, axis: int, psi: np.ndarray) -> float:
        return float(self.grid.cell * self._total(self._moving[axis].expectation(self.as_field(psi))))

    def _momentum_gradient(self, axis: int, t: float, y: np.ndarray, out: np.ndarray) -> None:
        self._moving[axis].apply(y.reshape(self.grid.shape), out.reshape(self.grid.shape))
        out *= 2 * self.grid.cell

    def invariants(self, names: Sequence[str] = ("mass", "energy")) -> tuple[Invariant, ...]:
        """Return those invariants of the equation that `names` lists.

        Parameters
        ----------
        names : sequence of {"mass", "energy", "momentum_x", "momentum_y", "momentum_z", "angular_momentum"}, optional
            Mass and energy are invariants of the equations on the grid for every field. The others are conserved to
            spectral accuracy only, as far as the grid resolves the field: a momentum if the potential does not change
            along its axis and `Omega` is 0; the angular momentum if the potential is symmetric about the z axis and the
            field vanishes at the ends of the box.

        Returns
        -------
        tuple of Invariant
            The gradients of mass, energy, momentum and angular momentum are 2 w psi, 2 w H psi, -2 i w d psi and 2 w Lz
            psi, with the size w of a cell and the derivative d along an axis. The gradient of the energy is a multiple
            of the right-hand side, which the step evaluates only once for this gradient and for the first stage of the
            next step (`reuse_f`). Mass and energy, or one of them without other invariants, are returned as
            `JointInvariants`. If this object is passed on unchanged, a projection takes two passes over the field.

        Raises
        ------
        ValueError
            If a name is unknown.
        """
        names = (names,) if isinstance(names, str) else tuple(names)
        items = tuple(self._invariant(name) for name in names)
        if not items or not {"mass", "energy"}.issuperset(names) or len(set(names)) < len(names):
            return items
        joint = Joint(self, names)
        return JointInvariants(items, joint.moments, joint.shift)

    def _invariant(self, name: str) -> Invariant:
        energy = Energy(self)
        made: dict[str, tuple[Callable[..., float], Callable[..., None]]] = {
            "mass": (self.mass, self._mass_gradient),
            "energy": (energy.value, energy.gradient),
            "angular_momentum": (self.angular_momentum, self._angular_momentum_gradient),
        }
        for axis, along in enumerate(MOMENTA[: self.grid.dim]):
            made[along] = partial(self._momentum_along, axis), partial(self._momentum_gradient, axis)
        if name in MOMENTA and name not in made:
            raise ValueError(f"{name!r} needs an axis that {self.grid!r} does not have; omit this invariant.")
        return named_invariant(name, made, INVARIANTS, uses_f=name == "energy")

    def problem(
        self,
        psi0: Any,
        t_end: float,
        h: float | None = None,
        *,
        name: str = "gross-pitaevskii",
        invariants: Sequence[str] = ("mass", "energy"),
        reference: Callable[[float], np.ndarray | None] | None = None,
        source: str = SOURCE,
    ) -> FieldProblem:
        """Return the initial value problem.

        Parameters
        ----------
        psi0 : array_like
            The field at t = 0, of the grid's shape or flat.
        t_end : float
            End of the interval that starts at 0.
        h : float, optional
            Length of the step. An explicit method needs one below `largest_step`.
        name : str, optional
            See `Problem`.
        invariants : sequence of str, optional
            Names of the invariants, see `invariants`.
        reference : callable, optional
            ``reference(t) -> y``, the exact solution as a flat array, or None where it is not known.
        source : str, optional
            See `Problem`.

        Returns
        -------
        FieldProblem
            The problem. Its metric is "euclidean", because all points of the grid are equivalent. Its method is
            `Splitting`, of order 4; a `DampedGrossPitaevskii` has the default method of `integrate`.
        """
        return FieldProblem(
            name=name,
            fun=self.fun,
            rhs=self.rhs,
            y0=self.as_field(psi0).reshape(-1).copy(),
            t_span=(0.0, t_end),
            h=h,
            invariants=self.invariants(invariants),
            metric="euclidean",
            method=self._method(),
            reference=reference,
            units="dimensionless",
            source=source,
            equation=self,
        )

    def largest_frequency(self) -> float:
        """Return an upper bound of the norm of the linear part and the potential: the sum of the terms' bounds."""
        kinetic = sum(float(self.kinetic_factor(axis).max()) for axis in range(self.grid.dim))
        turning = sum(self._largest(f) for f in self.rotation_factors()) if self.Omega else 0.0
        return kinetic + abs(self.Omega) * turning + self._largest(self.V)

    def largest_step(self, psi: Any, limit: float = 2 * 2**0.5) -> float:
        """Return a step up to which an explicit method is stable.

        Parameters
        ----------
        psi : array_like
            A field whose largest density ``|psi|^2`` is typical of the run.
        limit : float, optional
            Largest stable value of h times the largest frequency for the method; default: that of RK4, 2 sqrt(2).

        Returns
        -------
        float
            The step for an upper bound of the largest frequency, which is the sum of bounds of the terms of H. Somewhat
            longer steps may be stable too.
        """
        # Twice the interaction: the linearised term is 2 beta |psi|^2 u + beta psi^2 conj(u).
        local = 2 * abs(self.beta) * self._largest(self.as_field(psi)) ** 2
        return float(limit / (self.largest_frequency() + local))


def on_grid(potential: Any, grid: Grid, name: str = "potential") -> np.ndarray:
    """Return the values (J[, K[, L]]) of a real quantity on the grid; `name` is its name in messages."""
    given = potential(*grid.mesh()) if callable(potential) else 0.0 if potential is None else potential
    values = real_array(name, given)
    try:
        values = np.broadcast_to(values, grid.shape)
    except ValueError:
        raise ValueError(f"{name} has shape {values.shape}, which does not fit {grid!r}.") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{name} is not finite everywhere on the grid.")
    return np.ascontiguousarray(values, dtype=float)


class DampedGrossPitaevskii(GrossPitaevskii):
    """The equation ``psi_t = -(i + damping) (H(psi) - mu) psi - loss / 2 psi``, with H of `GrossPitaevskii`.

    Parameters
    ----------
    grid, potential
        As for `GrossPitaevskii`.
    damping : float, optional
        Pitaevskii's phenomenological damping, a number >= 0 without unit: the strength of the exchange with a thermal
        cloud.
    chemical_potential : float, optional
        mu, the chemical potential of the thermal cloud. `damping` relaxes the field to a state of this chemical
        potential, which is at rest in these equations.
    loss : float, callable or array_like, optional
        Rate at which ``|psi|^2`` decays at each point, in one of the forms of `potential`.
    **options
        As for `GrossPitaevskii`: Omega, beta, nyquist, fft, threads.

    Raises
    ------
    ValueError
        As for `GrossPitaevskii`, and if `damping` is negative or not finite.

    Notes
    -----
    Mass, energy and momenta change at the rate Re <G, d>, with the gradient G and the terms d that damping and losses
    add to psi_t. The derivative at a stage contains H psi, so that the rates of mass and energy need no transform.
    `invariants` returns these quantities as `Balance` objects, and `problem` keeps them, with the Runge-Kutta methods
    that support balances. `Splitting` solves the equation without damping and losses.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import DampedGrossPitaevskii, Grid
    >>> equation = DampedGrossPitaevskii(Grid(64, -10, 10), beta=-1.0, loss=1e-3)
    >>> start = 1 / np.cosh(equation.grid.points(0))
    >>> run = integrate(equation.problem(start, t_end=2.0, h=0.01), method=EIPRK4)
    >>> bool(abs(equation.mass(run.y[:, -1]) / equation.mass(start) - np.exp(-2e-3)) < 1e-9)
    True
    """

    def __init__(
        self,
        grid: Grid,
        potential: Any = None,
        *,
        damping: float = 0.0,
        chemical_potential: float = 0.0,
        loss: Any = 0.0,
        **options: Any,
    ) -> None:
        damping = checked_damping(damping)
        if not (is_number(chemical_potential) and np.isfinite(chemical_potential)):
            raise ValueError(f"chemical_potential must be a finite number, got {shown(chemical_potential)}.")
        super().__init__(grid, potential, **options)
        self.damping, self.mu = damping, float(chemical_potential)
        self.loss = on_grid(loss, grid, "loss")
        self._options |= {"damping": damping, "chemical_potential": chemical_potential, "loss": self.loss}
        self._growth = (self.damping * self.mu - 0.5 * self.loss).reshape(-1)

    def __repr__(self) -> str:
        return f"Damped{super().__repr__()[:-1]}, damping={self.damping:g}, chemical_potential={self.mu:g})"

    def _method(self) -> None:
        return None

    def rhs(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with psi_t; `y` and `out` are flat, contiguous, and different arrays."""
        super().rhs(t, y, out)
        out *= 1 - 1j * self.damping
        out += (self._growth + 1j * self.mu) * y

    def energy(self, psi: Any) -> float:
        """Return the energy of a state, defined as in `GrossPitaevskii`, without damping and losses."""
        psi = self.as_field(psi)
        f = np.empty(psi.size, complex)
        super().rhs(0.0, psi.reshape(-1), f)
        return self.grid.cell * self.moments(psi, f).energy(self.beta)

    def _parts(self, y: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return -i H psi, and what damping and losses add; i mu psi, which changes no invariant, is in neither."""
        turning = (f - (self._growth + 1j * self.mu) * y) / (1 - 1j * self.damping)
        return turning, self._growth * y - 1j * self.damping * turning

    def invariants(self, names: Sequence[str] = ("mass", "energy")) -> tuple[Balance, ...]:
        """Return invariants of the undamped equation as balances, with their rates by damping and losses.

        Parameters
        ----------
        names : sequence of str, optional
            As for `GrossPitaevskii.invariants`.

        Returns
        -------
        tuple of Balance

        Raises
        ------
        ValueError
            If a name is unknown.
        """
        names = (names,) if isinstance(names, str) else tuple(names)
        return tuple(
            damped_invariant(self._invariant(name), self._invariant(name), self._parts, self._total) for name in names
        )
