"""Right-hand side of a constrained system, from a function that evaluates its matrices."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ...core.jitted import compiled_like, is_jitted
from ...engine.native import BUILD

__all__ = ["Motion", "Sizes", "motion", "plain", "vector"]

SOLVE = ctypes.CFUNCTYPE(
    ctypes.c_int64, ctypes.c_void_p, *[ctypes.c_int64] * 2, ctypes.c_double, *[ctypes.c_void_p] * 2
)(BUILD.multibody.solve_address())
SINGULAR, NOT_FINITE = BUILD.multibody.MASS_IS_SINGULAR, BUILD.multibody.NOT_FINITE
SINGULAR_MASS = (
    "the mass matrix is singular for motions that the constraints allow: some speeds have no inertia. Give their "
    "bodies a mass or an inertia, or constrain them"
)


class Sizes(NamedTuple):
    """Numbers of coordinates, speeds and constraints on the speeds."""

    coordinates: int
    speeds: int
    constraints: int

    @property
    def matrices(self) -> int:
        """Return the total number of entries of M, F, G and gamma."""
        n, m = self.speeds, self.constraints
        return n * n + n + m * n + m


class Motion(NamedTuple):
    """The functions of the motion of a system with constraints, with the state y = (q, u).

    Attributes
    ----------
    rhs : callable
        ``rhs(t, y, out, *params)`` fills `out` with (q', u').
    solved : callable
        ``solved(t, y, rates, accelerations, multipliers, *params)`` fills the arrays with q' (the first entries of
        `rates`), u' and lambda. It returns the rank of the constraints, or `NOT_FINITE` if a matrix is not finite, and
        raises ValueError if the mass matrix is singular.
    """

    rhs: Callable[..., None]
    solved: Callable[..., int]


def plain(function: Any) -> Callable[..., Any]:
    """Return the Python function of a jitted function, for a few calls that are not worth compilation.

    A function that is not jitted is returned unchanged.
    """
    return function.py_func if is_jitted(function) else function


@lru_cache(maxsize=64)
def motion(fill: Callable[..., None], sizes: Sizes, tolerance: float) -> Motion:
    """Return the functions of the motion that satisfies M u' + G^T lambda = F and G u' = -gamma.

    Parameters
    ----------
    fill : callable
        ``fill(t, y, out, *params)`` fills `out` with M (by rows), F, G (by rows), gamma and q', one after the other.
    sizes : Sizes
    tolerance : float
        Distance within which gradients of constraints, each scaled to length 1, count as dependent.
    """
    nq, n, m = sizes
    matrices = sizes.matrices

    def solved(t, y, rates, accelerations, multipliers, *params):
        work = np.empty(matrices + nq)
        fill(t, y, work, *params)
        for k in range(nq):  # assignments to slices take Numba seconds to compile
            rates[k] = work[matrices + k]
        rank = SOLVE(work.ctypes.data, n, m, tolerance, accelerations.ctypes.data, multipliers.ctypes.data)
        if rank == SINGULAR:
            raise ValueError(SINGULAR_MASS)
        if rank < NOT_FINITE:
            raise MemoryError
        return rank

    fast = compiled_like(solved, fill)

    def rhs(t, y, out, *params):
        accelerations, multipliers = np.empty(n), np.empty(m)
        fast(t, y, out, accelerations, multipliers, *params)
        for k in range(n):
            out[nq + k] = accelerations[k]

    return Motion(compiled_like(rhs, fast), fast)


@lru_cache(maxsize=64)
def vector(fill: Callable[..., None], size: int) -> Callable[..., np.ndarray]:
    """Return a function of ``(t, y, *params)`` that returns a new array of length `size`, filled by `fill`."""

    def value(t, y, *params):
        out = np.empty(size)
        fill(t, y, out, *params)
        return out

    return compiled_like(value, fill)
