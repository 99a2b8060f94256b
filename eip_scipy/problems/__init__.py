"""Problems with invariants: functions that return a `Problem`."""

from ..core.invariants import JointInvariants
from ..core.problem import Problem
from .gravity import solar_data as solar_data
from .gravity.forces import ForceConstants
from .gravity.nbody import nbody
from .gravity.orbital_elements import OrbitalElements, orbital_elements
from .gravity.orbits import orbital_balances
from .gravity.scenes import comet, figure_eight, pythagorean, satellite
from .gravity.solar_data import SolarSystemData
from .gravity.solar_system import solar_system
from .gross_pitaevskii import (
    DampedGrossPitaevskii,
    FieldProblem,
    Grid,
    GrossPitaevskii,
    Splitting,
    breather,
    harmonic_trap,
    plane_wave,
    quartic_trap,
    rotating_packet,
    soliton,
)
from .invariant_search import find_invariants
from .kepler import harmonic, kepler
from .multibody import MechanicsProblem, mechanism
from .particles.charged_particle import ParticleProblem, charged_particle, tokamak, uniform_field
from .particles.fields import TOKAMAK, UNIFORM, ParticleField
from .symbolic import equations, hamiltonian, mechanics
from .time_transformed import centre_time, pair_time, reaches, time_transformed
from .waves import (
    KortewegDeVries,
    Lawson,
    SineGordon,
    WaveProblem,
    korteweg_de_vries_solitons,
    sine_gordon_breather,
    sine_gordon_kinks,
)

__all__ = [
    "TOKAMAK",
    "UNIFORM",
    "DampedGrossPitaevskii",
    "FieldProblem",
    "ForceConstants",
    "Grid",
    "GrossPitaevskii",
    "JointInvariants",
    "KortewegDeVries",
    "Lawson",
    "MechanicsProblem",
    "OrbitalElements",
    "ParticleField",
    "ParticleProblem",
    "Problem",
    "SineGordon",
    "SolarSystemData",
    "Splitting",
    "WaveProblem",
    "breather",
    "centre_time",
    "charged_particle",
    "comet",
    "equations",
    "figure_eight",
    "find_invariants",
    "hamiltonian",
    "harmonic",
    "harmonic_trap",
    "kepler",
    "korteweg_de_vries_solitons",
    "mechanics",
    "mechanism",
    "nbody",
    "orbital_balances",
    "orbital_elements",
    "pair_time",
    "plane_wave",
    "pythagorean",
    "quartic_trap",
    "reaches",
    "rotating_packet",
    "satellite",
    "sine_gordon_breather",
    "sine_gordon_kinks",
    "solar_system",
    "soliton",
    "time_transformed",
    "tokamak",
    "uniform_field",
]
