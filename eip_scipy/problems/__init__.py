"""Problems with invariants: functions that return a `Problem`, and `hard_cases`, which returns many with solutions."""

from ._problem import Problem
from .forces import ForceConstants
from .hard_cases import HardCase, hard_cases
from .harmonic import harmonic
from .kepler import kepler
from .nbody import nbody
from .scenes import comet, figure_eight, pythagorean
from .solar_data import SolarSystemData
from .solar_system import solar_system
from .time_transformed import centre_time, pair_time, reaches, time_transformed

__all__ = [
    "ForceConstants",
    "HardCase",
    "Problem",
    "SolarSystemData",
    "centre_time",
    "comet",
    "figure_eight",
    "hard_cases",
    "harmonic",
    "kepler",
    "nbody",
    "pair_time",
    "pythagorean",
    "reaches",
    "solar_system",
    "time_transformed",
]
