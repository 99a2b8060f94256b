"""Orders of convergence, and the moments of weights."""

import math
from fractions import Fraction

import numpy as np


def observed_order(errors, steps):
    """Return the orders between neighbours, (k - 1,) or (k - 1, m), of errors (k,) or (k, m) at steps (k,)."""
    return (np.diff(np.log(np.abs(errors)), axis=0).T / np.diff(np.log(steps))).T


def weighted_moments(b, low, c, count, of_position=False):
    """Yield sum (b + low) c^k minus its exact value, in fractions, for the doubles of a step, in least units.

    That is half a unit in the last place of each low part, which are the sums' only numbers that can be chosen.
    """
    b, low, c = ([Fraction(x) for x in values] for values in (b, low, c))
    for k in range(count):
        missed = sum((w + x) * node**k for w, x, node in zip(b, low, c, strict=True))
        missed -= Fraction(1, (k + 1) * (k + 2 if of_position else 1))
        least = sum(Fraction(math.ulp(float(x))) / 2 * node**k for w, x, node in zip(b, low, c, strict=True) if w or x)
        yield abs(missed) / least
