"""Real fields on periodic grids: their Fourier modes, the class of their problems, and Lawson's method for modes.

Only half of the modes are stored, the others are conjugates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.fft

from ...core.problem import Problem
from ...methods.runge_kutta import DOP853, Tableau
from ..gross_pitaevskii.grid import Grid

if TYPE_CHECKING:
    from .korteweg_de_vries import KortewegDeVries
    from .sine_gordon import SineGordon

__all__ = ["Lawson", "RealModes", "WaveProblem"]


class RealModes:
    """Transforms of real fields on a grid, and the modes' wavenumbers.

    Parameters
    ----------
    grid : Grid

    Attributes
    ----------
    grid : Grid
    shape : tuple of int
        Shape of the modes: along the last axis only those with wavenumbers >= 0.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.shape = (*grid.shape[:-1], grid.shape[-1] // 2 + 1)

    def forward(self, field: np.ndarray) -> np.ndarray:
        """Return the modes sum_j field_j exp(-i k x_j) of a field, which may be flat.

        Here x_j is the position of the point j relative to the first point of the grid.
        """
        return scipy.fft.rfftn(field.reshape(self.grid.shape))

    def backward(self, modes: np.ndarray) -> np.ndarray:
        """Return the field with these modes as a flat array; `modes` is overwritten."""
        return scipy.fft.irfftn(modes, s=self.grid.shape, overwrite_x=True).ravel()

    def wavenumbers(self, axis: int, *, odd: bool = False) -> np.ndarray:
        """Return the wavenumbers along one axis, of a shape that broadcasts to `shape`.

        If `odd`, for derivatives of odd order, the wavenumber of the Nyquist mode is 0.
        """
        k = self.grid.wavenumbers(axis, odd=odd)
        return np.abs(k[..., : self.shape[-1]]) if axis == self.grid.dim - 1 else k


@dataclass(frozen=True, eq=False, repr=False)
class WaveProblem(Problem):
    """A `Problem` of real waves on a grid.

    Attributes
    ----------
    equation : SineGordon or KortewegDeVries
        The equation, with the attribute `grid` and functions of the state such as ``equation.energy(y)``. The other
        attributes are those of `Problem`.
    """

    equation: SineGordon | KortewegDeVries | None = None


class Lawson:
    """One-step method: a Runge-Kutta step for the modes ``exp(i w t) u``, which only the nonlinear term changes.

    Parameters
    ----------
    equation : KortewegDeVries
        The equation, or another object with the attribute `frequencies` (w) and the methods `modes`, `field` and
        `nonlinear`.
    tableau : Tableau, optional
        Runge-Kutta method, by default that of `EIPDOP853`. If it has an error estimate, `one_step` returns the estimate
        too.

    Attributes
    ----------
    equation, tableau
    order : int
    error_estimator_order : int or None
    evaluations : int
        Number of evaluations of the nonlinear term in a step.
    name : str

    Raises
    ------
    TypeError
        If `tableau` is not a `Tableau`.

    Notes
    -----
    The linear part, which is stiff, only multiplies each mode by a factor and does not limit the step; the nonlinear
    term limits it. If the frequencies are real (without damping), the factors have the modulus 1.

    References
    ----------
    J. D. Lawson, "Generalized Runge-Kutta processes for stable systems with large Lipschitz constants", SIAM J. Numer.
    Anal. 4 (1967) 372-380.

    Examples
    --------
    >>> from eip_scipy import eip_method, integrate
    >>> from eip_scipy.methods.runge_kutta import RK4
    >>> from eip_scipy.problems import Lawson, korteweg_de_vries_solitons
    >>> scene = korteweg_de_vries_solitons(t_end=1.0)
    >>> run = integrate(scene, h=0.01, method=eip_method(Lawson(scene.equation, RK4)))
    >>> bool(abs(run.y[:, -1] - scene.reference(1.0)).max() < 1e-5)
    True
    """

    def __init__(self, equation: KortewegDeVries, tableau: Tableau = DOP853) -> None:
        if not isinstance(tableau, Tableau):
            raise TypeError(f"Lawson: expected a Tableau, such as that of EIPDOP853, got {tableau!r}.")
        self.equation, self.tableau = equation, tableau
        self.order, self.error_estimator_order = tableau.order, tableau.error_estimator_order
        self.evaluations = tableau.n_stages + tableau.fsal
        self.name = f"Lawson-{tableau.name}"
        self._kept: tuple[float, list[np.ndarray], list[np.ndarray]] | None = None

    def __repr__(self) -> str:
        return f"Lawson({self.equation!r}, {self.tableau!r})"

    def _factors(self, h: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the factors of the modes by the linear part up to each node of a step, and their inverses."""
        kept = self._kept
        if kept is None or kept[0] != h:
            phases = [1j * h * c * self.equation.frequencies for c in (*self.tableau.c, 1.0)]
            # Replaced as a whole: another thread may be in a step of another length.
            kept = self._kept = h, [np.exp(-x) for x in phases], [np.exp(x) for x in phases]
        return kept[1:]

    def one_step(self, t: float, y: np.ndarray, h: float) -> Any:
        """Make one step of length h from the state y at t.

        Return the new state, or the new state and its error estimate if the tableau has one.
        """
        equation, tableau = self.equation, self.tableau
        turns, back = self._factors(h)
        modes = equation.modes(y)
        slopes = np.empty((tableau.n_stages + tableau.fsal, modes.size), complex)

        def slope(stage: int, moved: np.ndarray) -> None:
            np.multiply(equation.nonlinear(turns[stage] * moved), back[stage], out=slopes[stage])

        slope(0, modes)
        for stage in range(1, tableau.n_stages):
            slope(stage, modes + (h * tableau.A[stage, :stage]) @ slopes[:stage])
        new = modes + (h * tableau.b) @ slopes[: tableau.n_stages]
        end = turns[-1]
        if not tableau.has_estimate:
            return equation.field(end * new)
        if tableau.fsal:
            slope(tableau.n_stages, new)
        err, rough = (equation.field(end * ((h * e[: len(slopes)]) @ slopes)) for e in (tableau.e, tableau.e_low))
        if tableau.paired:
            size = np.hypot(err, 0.1 * rough)
            err *= np.divide(np.abs(err), size, out=np.zeros_like(size), where=size > 0)
        return equation.field(end * new), err
