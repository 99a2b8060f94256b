"""The rotating Gross-Pitaevskii equation in one, two and three dimensions."""

from .equation import DampedGrossPitaevskii, FieldProblem, GrossPitaevskii
from .grid import Grid, Multiplier, SpectralSum
from .ground_state import (
    GroundState,
    ground_state,
    imprint,
    lowest_ring,
    lowest_state,
    polygon,
    ring_start,
    thomas_fermi,
    vortex_starts,
    with_noise,
)
from .scenes import (
    breather,
    harmonic_trap,
    line_condensate,
    plane_wave,
    quartic_trap,
    ring_condensate,
    rotating_packet,
    soliton,
)
from .splitting import RKN6, S6, STRANG, LinearFlow, Scheme, Splitting, at_rest, rotated
from .transforms import make_transforms
from .vortices import Surface, Vortices, density_surface, vortices

__all__ = [
    "RKN6",
    "S6",
    "STRANG",
    "DampedGrossPitaevskii",
    "FieldProblem",
    "Grid",
    "GrossPitaevskii",
    "GroundState",
    "LinearFlow",
    "Multiplier",
    "Scheme",
    "SpectralSum",
    "Splitting",
    "Surface",
    "Vortices",
    "at_rest",
    "breather",
    "density_surface",
    "ground_state",
    "harmonic_trap",
    "imprint",
    "line_condensate",
    "lowest_ring",
    "lowest_state",
    "make_transforms",
    "plane_wave",
    "polygon",
    "quartic_trap",
    "ring_condensate",
    "ring_start",
    "rotated",
    "rotating_packet",
    "soliton",
    "thomas_fermi",
    "vortex_starts",
    "vortices",
    "with_noise",
]
