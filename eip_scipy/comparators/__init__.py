"""Methods that the projection is measured against; each stands alone and knows no solver of this package.

`stormer_verlet` is the symplectic leapfrog of order 2 for q'' = a(t, q), in both of its forms.
"""

from eip_scipy.comparators.stormer_verlet import StormerVerletResult, stormer_verlet

__all__ = ["StormerVerletResult", "stormer_verlet"]
