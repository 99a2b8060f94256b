"""The rotating Gross-Pitaevskii equation in one, two and three dimensions."""

from .equation import FieldProblem, GrossPitaevskii
from .grid import Grid, Multiplier, SpectralSum
from .potentials import harmonic_trap, quartic_trap
from .scenes import plane_wave, rotating_packet, soliton
from .transforms import make_transforms

__all__ = [
    "FieldProblem",
    "Grid",
    "GrossPitaevskii",
    "Multiplier",
    "SpectralSum",
    "harmonic_trap",
    "make_transforms",
    "plane_wave",
    "quartic_trap",
    "rotating_packet",
    "soliton",
]
