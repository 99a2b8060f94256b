"""Problems with invariants: functions that return a `Problem`."""

from ..core.problem import Problem
from .gravity import solar_data as solar_data
from .gravity.approaches import Transits, transits
from .gravity.forces import ForceConstants
from .gravity.nbody import nbody
from .gravity.orbital_elements import OrbitalElements, orbital_elements
from .gravity.orbits import orbital_balances
from .gravity.satellite import satellite
from .gravity.scenes import comet, figure_eight, pythagorean
from .gravity.solar_data import SolarSystemData
from .gravity.solar_system import solar_system
from .gross_pitaevskii import FieldProblem, Grid, GrossPitaevskii
from .invariant_search import find_invariants
from .kepler import harmonic, kepler
from .multibody import MechanicsProblem, mechanism
from .particles.charged_particle import ParticleProblem, charged_particle, tokamak, uniform_field
from .particles.fields import TOKAMAK, UNIFORM, ParticleField
from .symbolic import equations, hamiltonian, mechanics
from .time_transformed import centre_time, pair_time, reaches, time_transformed

__all__ = [
    "TOKAMAK",
    "UNIFORM",
    "FieldProblem",
    "ForceConstants",
    "Grid",
    "GrossPitaevskii",
    "MechanicsProblem",
    "OrbitalElements",
    "ParticleField",
    "ParticleProblem",
    "Problem",
    "SolarSystemData",
    "Transits",
    "centre_time",
    "charged_particle",
    "comet",
    "equations",
    "figure_eight",
    "find_invariants",
    "hamiltonian",
    "harmonic",
    "kepler",
    "mechanics",
    "mechanism",
    "nbody",
    "orbital_balances",
    "orbital_elements",
    "pair_time",
    "pythagorean",
    "reaches",
    "satellite",
    "solar_system",
    "time_transformed",
    "tokamak",
    "transits",
    "uniform_field",
]
