"""The class of problems whose state is one real field, or several."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...core.problem import Problem

if TYPE_CHECKING:
    from .korteweg_de_vries import KortewegDeVries
    from .sine_gordon import SineGordon

__all__ = ["WaveProblem"]


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
