"""Kepler's problem by the functions of kepler.c."""

import ctypes

from scipy import LowLevelCallable

from eip_scipy import EIPRK4, Invariant, integrate

library = ctypes.CDLL("./libkepler.so")
floats = ctypes.POINTER(ctypes.c_double)
for function in (library.kepler, library.kept, library.turn):
    function.argtypes = [ctypes.c_double, floats, floats, floats]
library.kept_gradient.argtypes = [ctypes.c_double, floats, floats, floats, floats]

library.turn.direction = 1  # from approach to departure: the pericentre
energy_and_momentum = Invariant(
    LowLevelCallable(library.kept), LowLevelCallable(library.kept_gradient), size=2, name="HL"
)
run = integrate(
    LowLevelCallable(library.kepler),
    (0, 200),
    [1.6, 0, 0, 0.5],
    method=EIPRK4,
    h=0.03,
    params=[1.0],
    invariants=energy_and_momentum,
    events=LowLevelCallable(library.turn),
)
print(run.compiled, set(run.calls.values()))
kept = run.max_residual.max() < 1e-11
print(f"{run.t_events[0].size} pericentres, energy and angular momentum kept: {kept}")
