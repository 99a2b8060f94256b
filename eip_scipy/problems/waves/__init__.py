"""Waves on periodic grids, by the method of lines: the sine-Gordon and the Korteweg-de Vries equation."""

from .korteweg_de_vries import KortewegDeVries
from .modes import Lawson, RealModes, WaveProblem
from .scenes import korteweg_de_vries_solitons, sine_gordon_breather, sine_gordon_kinks
from .sine_gordon import SineGordon

__all__ = [
    "KortewegDeVries",
    "Lawson",
    "RealModes",
    "SineGordon",
    "WaveProblem",
    "korteweg_de_vries_solitons",
    "sine_gordon_breather",
    "sine_gordon_kinks",
]
