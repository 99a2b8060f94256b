"""Problems with invariants: functions that return a `Problem`, and `hard_cases`, which returns many with solutions."""

from ._problem import Problem
from .charged_particle import ParticleProblem, charged_particle, tokamak, uniform_field
from .forces import ForceConstants
from .gross_pitaevskii import (
    FieldProblem,
    Grid,
    GrossPitaevskii,
    Splitting,
    harmonic_trap,
    plane_wave,
    quartic_trap,
    rotating_packet,
    soliton,
)
from .hard_cases import HardCase, hard_cases
from .harmonic import harmonic
from .kepler import kepler
from .nbody import nbody
from .particle_fields import TOKAMAK, UNIFORM, ParticleField
from .scenes import comet, figure_eight, pythagorean
from .solar_data import SolarSystemData
from .solar_system import solar_system
from .time_transformed import centre_time, pair_time, reaches, time_transformed

__all__ = [
    "TOKAMAK",
    "UNIFORM",
    "FieldProblem",
    "ForceConstants",
    "Grid",
    "GrossPitaevskii",
    "HardCase",
    "ParticleField",
    "ParticleProblem",
    "Problem",
    "SolarSystemData",
    "Splitting",
    "centre_time",
    "charged_particle",
    "comet",
    "figure_eight",
    "hard_cases",
    "harmonic",
    "harmonic_trap",
    "kepler",
    "nbody",
    "pair_time",
    "plane_wave",
    "pythagorean",
    "quartic_trap",
    "reaches",
    "rotating_packet",
    "solar_system",
    "soliton",
    "time_transformed",
    "tokamak",
    "uniform_field",
]
