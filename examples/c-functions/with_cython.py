"""An oscillator by the functions of oscillator.pyx."""

import oscillator
from scipy import LowLevelCallable

from eip_scipy import EIPRK4, Invariant, integrate

names = ("oscillator", "energy", "energy_gradient")
functions = [LowLevelCallable.from_cython(oscillator, name) for name in names]
fun, energy, energy_gradient = functions
run = integrate(
    fun,
    (0, 100),
    [1, 0, 0, 0.5],
    method=EIPRK4,
    h=0.03,
    params=[2.0],
    invariants=Invariant(energy, energy_gradient, name="H"),
)
print(run.compiled, run.calls)
print(f"energy kept: {run.max_residual.max() < 1e-12}")
