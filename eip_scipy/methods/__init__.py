"""Integration methods: their coefficients and orders."""

from .multistep import GaussJackson
from .nystrom import NystromTableau
from .runge_kutta import Tableau

__all__ = ["GaussJackson", "NystromTableau", "Tableau"]
