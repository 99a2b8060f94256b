"""Mechanical systems with constraints."""

from .callables import mechanism
from .problem import MechanicsProblem

__all__ = ["MechanicsProblem", "mechanism"]
