"""Integration methods: their coefficients and orders."""

from .gauss_jackson import GaussJackson
from .nystrom import NystromTableau
from .runge_kutta import Tableau

__all__ = ["GaussJackson", "NystromTableau", "Tableau"]
