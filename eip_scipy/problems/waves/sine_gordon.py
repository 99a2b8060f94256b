"""The sine-Gordon equation on a periodic grid: right-hand side, invariants, and initial value problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...core.invariants import Invariant
from ...methods.nystrom import RKN1210
from ...methods.runge_kutta import DOP853
from ..gross_pitaevskii.grid import Grid
from ..named_invariants import checked_damping, damped_invariant, named_invariant
from .modes import RealModes, WaveProblem

__all__ = ["SineGordon"]

MOMENTA = ("momentum_x", "momentum_y", "momentum_z")
INVARIANTS = ("energy", *MOMENTA)
SOURCE = "Ablowitz & Segur, Solitons and the Inverse Scattering Transform (SIAM 1981), section 1.5"


class SineGordon:
    """The equation ``q_tt = Laplace q - sin q - damping q_t`` in one to three dimensions, pseudospectral in space.

    The state is (q, p), two flat fields with p = q_t. Without damping this is a system of second order, for Nystrom
    methods.

    Parameters
    ----------
    grid : Grid
    damping : float, optional
        Damping rate, >= 0. With damping, energy and momenta are balances, and Nystrom methods cannot be used.

    Attributes
    ----------
    grid : Grid
    damping : float

    Notes
    -----
    The energy ``w sum ((p^2 + |grad q|^2) / 2 + 1 - cos q)``, with w the size of a cell, is an invariant of the
    equations on the grid for every field. The momenta ``-w sum p dq``, with dq the derivative of q along an axis, are
    conserved to spectral accuracy only, because sin q has modes that the grid does not have; their aliases do not
    vanish if the field is not resolved.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import integrate
    >>> from eip_scipy.problems import Grid, SineGordon
    >>> equation = SineGordon(Grid(64, 0, 2 * np.pi))
    >>> x = equation.grid.points(0)
    >>> run = integrate(equation.problem(np.cos(x), np.sin(x), t_end=5.0, h=0.05))
    >>> run.success, bool(run.max_defect[0] < 1e-13)
    (True, True)
    """

    def __init__(self, grid: Grid, damping: float = 0.0) -> None:
        self.grid, self.damping = grid, checked_damping(damping)
        self._modes = RealModes(grid)
        self._square = np.zeros(self._modes.shape)
        for axis in range(grid.dim):
            self._square += self._modes.wavenumbers(axis) ** 2

    def __repr__(self) -> str:
        return f"SineGordon({self.grid!r}{f', damping={self.damping:g}' if self.damping else ''})"

    def acceleration(self, q: np.ndarray) -> np.ndarray:
        """Return Laplace q - sin q, the acceleration without damping, at the points of the grid as a flat array."""
        modes = self._modes.forward(q)
        modes *= -self._square
        out = self._modes.backward(modes)
        out -= np.sin(q)
        return out

    def rhs(self, t: float, y: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with (p, Laplace q - sin q - damping p)."""
        n = self.grid.size
        out[:n] = y[n:]
        out[n:] = self.acceleration(y[:n])
        if self.damping:
            out[n:] -= self.damping * y[n:]

    def fun(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the right-hand side as a new array, as `solve_ivp` needs it."""
        out = np.empty_like(y)
        self.rhs(t, y, out)
        return out

    def energy(self, y: np.ndarray) -> float:
        """Return the energy ``w sum ((p^2 + |grad q|^2) / 2 + 1 - cos q)``, where w is the size of a cell."""
        n = self.grid.size
        q, p = y[:n], y[n:]
        laplacian = self._modes.backward(-self._square * self._modes.forward(q))
        # 1 - cos q without the cancellation where q is small.
        density = 0.5 * (p @ p - q @ laplacian) + 2 * np.sum(np.sin(0.5 * q) ** 2)
        return float(self.grid.cell * density)

    def momentum(self, y: np.ndarray) -> np.ndarray:
        """Return the momenta ``-w sum p dq``, one for each axis of the grid.

        Here w is the size of a cell, and dq the derivative of q along the axis.
        """
        return np.array([self._momentum_along(axis, y) for axis in range(self.grid.dim)])

    def _momentum_along(self, axis: int, y: np.ndarray) -> float:
        n = self.grid.size
        return float(-self.grid.cell * (y[n:] @ self._slope(axis, y[:n])))

    def _slope(self, axis: int, field: np.ndarray) -> np.ndarray:
        return self._modes.backward(1j * self._modes.wavenumbers(axis, odd=True) * self._modes.forward(field))

    def _parts(self, y: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the two parts of the derivative `f`: the derivative without damping, and the damping term."""
        lost = np.zeros_like(y)
        lost[self.grid.size :] = -self.damping * y[self.grid.size :]
        return f - lost, lost

    def _energy_gradient(self, t: float, y: np.ndarray, f: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the gradient of the energy, (-w a, w p), from f = (p, a)."""
        n, cell = self.grid.size, self.grid.cell
        np.multiply(f[n:], -cell, out=out[:n])
        np.multiply(y[n:], cell, out=out[n:])

    def _momentum_gradient(self, axis: int, t: float, y: np.ndarray, out: np.ndarray) -> None:
        n, cell = self.grid.size, self.grid.cell
        np.multiply(self._slope(axis, y[n:]), cell, out=out[:n])
        np.multiply(self._slope(axis, y[:n]), -cell, out=out[n:])

    def invariants(self, names: Sequence[str] = ("energy",)) -> tuple[Invariant, ...]:
        """Return the invariants of the equation.

        Parameters
        ----------
        names : sequence of {"energy", "momentum_x", "momentum_y", "momentum_z"}, optional
            The momenta are conserved as far as the grid resolves the field; see the notes of `SineGordon`.

        Returns
        -------
        tuple of Invariant
            Invariants, or with damping objects of the class `Balance`. The gradient of the energy is computed from the
            right-hand side, which the step has already evaluated.

        Raises
        ------
        ValueError
            If a name is unknown, or the grid does not have the axis of a momentum.
        """
        names = (names,) if isinstance(names, str) else tuple(names)
        return tuple(self._invariant(name) for name in names)

    def _invariant(self, name: str) -> Invariant:
        made: dict[str, tuple[Callable[..., float], Callable[..., None]]] = {
            along: (partial(self._momentum_along, axis), partial(self._momentum_gradient, axis))
            for axis, along in enumerate(MOMENTA[: self.grid.dim])
        }
        made["energy"] = self.energy, self._energy_gradient
        known = [name for name in INVARIANTS if name in made]
        item = named_invariant(name, made, known, uses_f=name == "energy", where=f" on {self.grid!r}")
        return damped_invariant(item, item, self._parts) if self.damping else item

    def largest_step(self, limit: float = 8.0) -> float:
        """Return the step above which an explicit method is unstable.

        Parameters
        ----------
        limit : float, optional
            Largest stable value of h times the largest frequency for the method. Default: that of `EIPRKN12`; the value
            of `EIPRKN8` is 3.3.

        Returns
        -------
        float
        """
        return float(limit / np.sqrt(1.0 + self._square.max()))

    def problem(
        self,
        q0: Any,
        p0: Any,
        t_end: float,
        h: float | None = None,
        *,
        name: str = "sine-gordon",
        invariants: Sequence[str] = ("energy",),
        reference: Callable[[float], np.ndarray | None] | None = None,
        source: str = SOURCE,
    ) -> WaveProblem:
        """Return the initial value problem.

        Parameters
        ----------
        q0, p0 : array_like
            The field and its derivative in time at t = 0, of the grid's shape or flat.
        t_end : float
            End of the interval that starts at 0.
        h : float, optional
            The step, which must be below `largest_step`. Default: the problem has no step.
        name : str, optional
        invariants : sequence of str, optional
            See `invariants`.
        reference : callable, optional
            ``reference(t) -> y``, a closed form of the solution.
        source : str, optional
            Source of the equation and data, see `Problem`.

        Returns
        -------
        WaveProblem
            The problem. Its method is the Nystrom method of `EIPRKN12`, or with damping that of `EIPDOP853`.

        Raises
        ------
        ValueError
            If a field is not of the grid's shape.
        """
        grid, fields = self.grid, [np.asarray(a, dtype=float) for a in (q0, p0)]
        for a in fields:
            if a.shape not in (grid.shape, (grid.size,)):
                raise ValueError(f"q0 or p0 has shape {a.shape}, expected {grid.shape} or ({grid.size},).")
        return WaveProblem(
            name=name,
            fun=self.fun,
            rhs=self.rhs,
            y0=np.concatenate([a.ravel() for a in fields]),
            t_span=(0.0, t_end),
            h=h,
            invariants=self.invariants(invariants),
            metric="euclidean",
            method=DOP853 if self.damping else RKN1210,
            reference=reference,
            units="dimensionless",
            source=source,
            equation=self,
        )
