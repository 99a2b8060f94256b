"""The Gross-Pitaevskii equation with phenomenological damping and losses; mass and energy are balances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.balances import Balance
from ...core.inputs import is_number, refuse_units, shown
from ..named_invariants import checked_damping, damped_invariant
from .equation import GrossPitaevskii, on_grid
from .grid import Grid

__all__ = ["DampedGrossPitaevskii"]


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
        refuse_units(chemical_potential=chemical_potential, loss=loss)
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
