"""The Korteweg-de Vries equation on a ring: right-hand side, invariants, and initial value problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import exp
from typing import Any

import numpy as np
import scipy.fft

from ...core.invariants import Invariant
from ..gross_pitaevskii.grid import Grid
from ..named_invariants import checked_damping, named_invariant
from .modes import Lawson, WaveProblem

__all__ = ["KortewegDeVries"]

SOURCE = "Gardner, Greene, Kruskal & Miura, Phys. Rev. Lett. 19 (1967) 1095"

DECAYS = {"mass": 1, "momentum": 2}  # rates with damping, in units of it
MOST_DECAY = 700.0  # exponent of the smallest decay that is divided by


class KortewegDeVries:
    """The equation ``u_t + 6 u u_x + u_xxx + damping u = 0`` on a ring, by Galerkin's method in Fourier modes.

    The state is u at the grid's points. The square u^2 is computed on a finer grid, on which its modes are not aliased
    (the 3/2 rule), so that the equations for the modes are exact projections of the partial differential equation.

    Parameters
    ----------
    grid : Grid
        Grid of one dimension.
    damping : float, optional
        Damping rate, >= 0.

    Attributes
    ----------
    grid : Grid
    damping : float
    frequencies : ndarray
        Frequencies of the linear part: the modes of u_t = -u_xxx - damping u change as exp(-i frequency t). They are
        complex with damping.

    Raises
    ------
    ValueError
        If the grid has more than one dimension, or `damping` is negative or not finite.

    Notes
    -----
    Because of the finer grid for u^2, the mass ``w sum u``, the momentum ``w sum u^2`` and the energy
    ``int u_x^2 / 2 - u^3``, with the size w of a cell, are invariants of the equations on the grid for every field:
    ``u_t = d_x grad H`` with a skew d_x, and H does not change when u is moved along the ring. (With the square at the
    points of the grid alone, its highest modes would be wrong, and the momentum would not be conserved.) The highest of
    an even number of modes has no derivative and is not used: `problem` removes it from the start.

    With damping, the mass decays exactly as exp(-damping t) and the momentum as exp(-2 damping t), also on the grid.
    Both, divided by these factors, are invariants that depend on time. The energy has no such law.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import integrate
    >>> from eip_scipy.problems import Grid, KortewegDeVries
    >>> equation = KortewegDeVries(Grid(64, 0, 20))
    >>> start = 1 / np.cosh(equation.grid.points(0) - 10) ** 2
    >>> run = integrate(equation.problem(start, t_end=1.0, h=0.02))
    >>> run.success, bool((run.max_defect < 1e-12).all())
    (True, True)
    """

    def __init__(self, grid: Grid, damping: float = 0.0) -> None:
        if grid.dim != 1:
            raise ValueError(f"the Korteweg-de Vries equation needs a grid of one dimension, got {grid!r}.")
        self.grid, self.damping = grid, checked_damping(damping)
        self._n = grid.size
        most = (self._n - 1) // 2  # the highest mode that has a sign
        self._kept = most + 1
        self._fine = scipy.fft.next_fast_len(3 * most + 1, real=True)
        self._k = grid.wavenumbers(0)[: self._kept]
        self.frequencies = -(self._k**3) - 1j * self.damping if self.damping else -(self._k**3)
        self._flux = -3j * self._k

    def __repr__(self) -> str:
        return f"KortewegDeVries({self.grid!r}{f', damping={self.damping:g}' if self.damping else ''})"

    # In modes: what `Lawson` takes.

    def modes(self, u: np.ndarray) -> np.ndarray:
        """Return the modes with k >= 0 that the equation keeps, the means of ``u_j exp(-i k x_j)``.

        Here x_j is the distance of the point j from the first point of the grid.
        """
        return scipy.fft.rfft(u, norm="forward")[: self._kept]

    def field(self, modes: np.ndarray) -> np.ndarray:
        """Return the field at the points of the grid, (n,), from its `modes` with k >= 0."""
        return scipy.fft.irfft(modes, self._n, norm="forward")

    def nonlinear(self, modes: np.ndarray) -> np.ndarray:
        """Return the modes of ``-3 (u^2)_x`` for the field u with the given `modes`."""
        return self._flux * self._square(modes)

    def _square(self, modes: np.ndarray) -> np.ndarray:
        """Return the modes of u^2 for the field u with the given `modes`."""
        u = self._finer(modes)
        u *= u
        return scipy.fft.rfft(u, norm="forward")[: self._kept]

    def _finer(self, modes: np.ndarray) -> np.ndarray:
        """Return the field with the given `modes` at the points of the finer grid."""
        return scipy.fft.irfft(modes, self._fine, norm="forward")

    # In points.

    def rhs(self, t: float, u: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with -6 u u_x - u_xxx - damping u."""
        modes = self.modes(u)
        out[:] = self.field(self.nonlinear(modes) - 1j * self.frequencies * modes)

    def fun(self, t: float, u: np.ndarray) -> np.ndarray:
        """Return the right-hand side as a new array, as `solve_ivp` needs it."""
        out = np.empty_like(u)
        self.rhs(t, u, out)
        return out

    def mass(self, u: np.ndarray) -> float:
        """Return the mass ``w sum u``, where w is the length of a cell."""
        return float(self.grid.cell * np.sum(u))

    def momentum(self, u: np.ndarray) -> float:
        """Return the momentum ``w sum u^2``, where w is the length of a cell."""
        return float(self.grid.cell * (u @ u))

    def energy(self, u: np.ndarray) -> float:
        """Return the energy, the integral of u_x^2 / 2 - u^3, exact for the modes that the equation keeps."""
        modes = self.modes(u)
        fine = self._finer(modes)
        slope = self.field(1j * self._k * modes)
        cubic = (fine * fine) @ fine / self._fine
        return float(self.grid.cell * (0.5 * (slope @ slope) - self._n * cubic))

    def _mass_gradient(self, t: float, u: np.ndarray, out: np.ndarray) -> None:
        out[:] = self.grid.cell

    def _momentum_gradient(self, t: float, u: np.ndarray, out: np.ndarray) -> None:
        np.multiply(u, 2 * self.grid.cell, out=out)

    def _energy_gradient(self, t: float, u: np.ndarray, out: np.ndarray) -> None:
        modes = self.modes(u)
        found = self._k**2 * modes - 3 * self._square(modes)
        np.multiply(self.field(found), self.grid.cell, out=out)

    def invariants(self, names: Sequence[str] | None = None) -> tuple[Invariant, ...]:
        """Return the invariants of the equation.

        Parameters
        ----------
        names : sequence of {"mass", "momentum", "energy"}, optional
            Default: momentum and energy; with damping the momentum divided by exp(-2 damping t). The mass is linear:
            every method keeps it, and the `frame` of `problem` prevents corrections from changing it.

        Returns
        -------
        tuple of Invariant

        Raises
        ------
        ValueError
            If a name is unknown, or is "energy" for an equation with damping.
        """
        if names is None:
            names = ("momentum",) if self.damping else ("momentum", "energy")
        names = (names,) if isinstance(names, str) else tuple(names)
        return tuple(self._invariant(name) for name in names)

    def _invariant(self, name: str) -> Invariant:
        made: dict[str, tuple[Callable[..., float], Callable[..., None]]] = {
            "mass": (self.mass, self._mass_gradient),
            "momentum": (self.momentum, self._momentum_gradient),
            "energy": (self.energy, self._energy_gradient),
        }
        if not self.damping:
            return named_invariant(name, made, tuple(made))
        del made["energy"]
        item = named_invariant(name, made, tuple(made), where=" with damping")
        rate = self.damping * DECAYS[name]
        return Invariant(partial(_value, rate, item), partial(_gradient, rate, item), name=name, in_place=True)

    def largest_step(self, u: Any, limit: float = 2.8) -> float:
        """Return the step above which `Lawson` is unstable; the nonlinear term limits it, as the linear one is exact.

        Parameters
        ----------
        u : array_like
            A typical field.
        limit : float, optional
            Largest stable value of h times the largest frequency for the method; default: about that of RK4.

        Returns
        -------
        float
        """
        return float(limit / (6 * np.abs(u).max() * self._k[-1]))

    def problem(
        self,
        u0: Any,
        t_end: float,
        h: float | None = None,
        *,
        name: str = "korteweg-de-vries",
        invariants: Sequence[str] | None = None,
        reference: Callable[[float], np.ndarray | None] | None = None,
        source: str = SOURCE,
    ) -> WaveProblem:
        """Return the initial value problem.

        Parameters
        ----------
        u0 : array_like
            The field at t = 0. The highest of an even number of modes is removed from it.
        t_end : float
            End of the interval that starts at 0.
        h : float, optional
            The step, which must be below `largest_step`. Default: the problem has no step.
        name : str, optional
        invariants : sequence of str, optional
            See `invariants`.
        reference : callable, optional
            ``reference(t) -> u``, a closed form of the solution.
        source : str, optional

        Returns
        -------
        WaveProblem
            The problem. Its method is `Lawson` with the tableau DOP853, and its `frame` keeps the mass.

        Raises
        ------
        ValueError
            If the field is not of the grid's shape, or an invariant decays below what floats can hold before `t_end`.
        """
        start = np.asarray(u0, dtype=float)
        if start.shape != self.grid.shape:
            raise ValueError(f"u0 has shape {start.shape}, expected {self.grid.shape}.")
        kept = self.invariants(invariants)
        _growth(self.damping * max((DECAYS.get(str(item.name), 0) for item in kept), default=0), t_end)
        return WaveProblem(
            name=name,
            fun=self.fun,
            rhs=self.rhs,
            y0=self.field(self.modes(start)),
            t_span=(0.0, t_end),
            h=h,
            invariants=kept,
            metric="euclidean",
            frame=(np.ones((1, self._n)), np.ones((self._n, 1))),
            method=Lawson(self),
            reference=reference,
            units="dimensionless",
            source=source,
            equation=self,
        )


def _value(rate: float, item: Invariant, t: float, u: np.ndarray) -> float:
    """Return the invariant divided by the factor exp(-rate t) of its decay."""
    return _growth(rate, t) * item.fun(t, u)


def _gradient(rate: float, item: Invariant, t: float, u: np.ndarray, out: np.ndarray) -> None:
    assert item.gradient is not None
    item.gradient(t, u, out)
    out *= _growth(rate, t)


def _growth(rate: float, t: float) -> float:
    if rate * t > MOST_DECAY:
        raise ValueError(
            f"with damping, invariants are divided by their decay exp(-{rate:g} t), which floats cannot hold at t = "
            f"{t:g}. End the run before t = {MOST_DECAY / rate:.6g}."
        )
    return exp(rate * t)
