"""Base class of the solvers, and the function that makes one from a tableau or a user-defined one-step method."""

from .core.solvers import EIPSolver, eip_method
from .methods.one_step import OneStepMethod

__all__ = ["EIPSolver", "OneStepMethod", "eip_method"]
