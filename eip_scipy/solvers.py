"""What all solver classes have in common, and what becomes one: a tableau, or a one-step method of your own."""

from .core.one_step import OneStepMethod
from .core.solvers import EIPSolver, eip_method

__all__ = ["EIPSolver", "OneStepMethod", "eip_method"]
