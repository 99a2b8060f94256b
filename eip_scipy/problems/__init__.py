"""Problems with invariants: functions that return a `Problem`, and `hard_cases`, which returns many with solutions."""

from ._problem import Problem
from .forces import ForceConstants
from .hard_cases import HardCase, hard_cases
from .harmonic import harmonic
from .kepler import kepler
from .nbody import nbody
from .solar_data import SolarSystemData
from .solar_system import solar_system

__all__ = [
    "ForceConstants",
    "HardCase",
    "Problem",
    "SolarSystemData",
    "hard_cases",
    "harmonic",
    "kepler",
    "nbody",
    "solar_system",
]
