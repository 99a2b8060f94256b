"""Methods with which EIP methods are compared; none of them uses a solver of `eip_scipy`.

`stormer_verlet` is the symplectic leapfrog of order 2 for q'' = a(t, q), in both of its forms, with `newton` for
gravitating bodies; `boris` the pusher for charged particles; `implicit_midpoint` a symplectic method of order 2 for any
Hamiltonian. `crank_nicolson`, `linearly_implicit` and `sav_crank_nicolson` are the implicit schemes of the paper's test
of efficiency, for the Gross-Pitaevskii equation (the last one without rotation).
"""

from ._steps import FixedSteps, Result
from .fields import crank_nicolson, linearly_implicit, sav_crank_nicolson
from .fixed_steps import boris, implicit_midpoint, newton, stormer_verlet

__all__ = [
    "FixedSteps", "Result", "boris", "crank_nicolson", "implicit_midpoint", "linearly_implicit", "newton",
    "sav_crank_nicolson", "stormer_verlet",
]  # fmt: skip
