"""Orders of convergence."""

import numpy as np


def observed_order(errors, steps):
    """Return the orders between neighbours, (k - 1,) or (k - 1, m), of errors (k,) or (k, m) at steps (k,)."""
    return (np.diff(np.log(np.abs(errors)), axis=0).T / np.diff(np.log(steps))).T
