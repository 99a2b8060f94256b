"""Problems with invariants, each a function that returns a `Problem`."""

from ._problem import Problem
from .harmonic import harmonic
from .kepler import kepler
from .nbody import nbody
from .solar_data import SolarSystemData
from .solar_system import solar_system

__all__ = ["Problem", "SolarSystemData", "harmonic", "kepler", "nbody", "solar_system"]
