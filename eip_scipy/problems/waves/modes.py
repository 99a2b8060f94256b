"""Real fields on periodic grids: the class of their problems, and their Fourier modes.

Only half of the modes are stored, the others are conjugates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from ...core.problem import Problem
from ..gross_pitaevskii.grid import Grid

if TYPE_CHECKING:
    from .korteweg_de_vries import KortewegDeVries
    from .sine_gordon import SineGordon

__all__ = ["RealModes", "WaveProblem"]


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
