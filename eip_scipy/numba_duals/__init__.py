"""Derivatives of functions jitted by Numba, exact to rounding, by dual numbers.

A package of its own, which knows nothing of the rest; importing it loads Numba. `gradient`, `rate`, `pushforward` and
`parameter_gradient` compile derivatives of functions with the arguments of a user's; `Dual` and what belongs to it are
for compiled code that carries derivatives along by itself.
"""

from .arrays import for_duals, inside, refuse_addresses
from .compiled import NotDifferentiableError, gradient, parameter_gradient, pushforward, rate
from .numbers import Dual, put_slope, seed, slope, value_of

__all__ = [
    "Dual", "NotDifferentiableError", "for_duals", "gradient", "inside", "parameter_gradient", "pushforward",
    "put_slope", "rate", "refuse_addresses", "seed", "slope", "value_of",
]  # fmt: skip
