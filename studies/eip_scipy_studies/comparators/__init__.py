"""Methods with which EIP methods are compared; none of them uses a solver of `eip_scipy`.

`stormer_verlet` is the symplectic leapfrog of order 2 for q'' = a(t, q), in both of its forms, with `newton` for
gravitating bodies; `boris` the pusher for
charged particles; `implicit_midpoint` a symplectic method of order 2 for any Hamiltonian. `crank_nicolson`,
`linearly_implicit` and `sav_crank_nicolson` are the implicit schemes of the paper's test of efficiency, for the
Gross-Pitaevskii equation (the last one without rotation).
"""

from ._fields import FieldResult
from ._steps import FixedStepResult, FixedSteps
from .boris import boris
from .crank_nicolson import crank_nicolson
from .implicit_midpoint import implicit_midpoint
from .linearly_implicit import linearly_implicit
from .scalar_auxiliary import SAVResult, sav_crank_nicolson
from .stormer_verlet import StormerVerletResult, newton, stormer_verlet

__all__ = [
    "FieldResult",
    "FixedStepResult",
    "FixedSteps",
    "SAVResult",
    "StormerVerletResult",
    "boris",
    "crank_nicolson",
    "implicit_midpoint",
    "linearly_implicit",
    "newton",
    "sav_crank_nicolson",
    "stormer_verlet",
]
