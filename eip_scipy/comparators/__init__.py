"""Methods that the projection is measured against; each stands alone and knows no solver of this package.

`stormer_verlet` is the symplectic leapfrog of order 2 for q'' = a(t, q), in both of its forms; `boris` the pusher for
charged particles; `implicit_midpoint` the symplectic method of order 2 for any Hamiltonian.
"""

from eip_scipy.comparators._common import FixedStepResult
from eip_scipy.comparators.boris import boris
from eip_scipy.comparators.implicit_midpoint import implicit_midpoint
from eip_scipy.comparators.stormer_verlet import StormerVerletResult, stormer_verlet

__all__ = ["FixedStepResult", "StormerVerletResult", "boris", "implicit_midpoint", "stormer_verlet"]
