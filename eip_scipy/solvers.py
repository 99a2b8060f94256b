"""Base class of the solvers, and the function that makes one from a tableau or a user-defined one-step method."""

from .core.one_step import OneStepMethod
from .core.solvers import EIPSolver, eip_method

__all__ = ["EIPSolver", "OneStepMethod", "eip_method"]
