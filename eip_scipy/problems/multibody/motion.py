"""Right-hand side of a constrained system, from a function that evaluates its matrices."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ...core.functions import compilable, compiled_like, is_jitted, jitted
from ...engine.native import BUILD

__all__ = [
    "Motion", "changed", "complex_parts", "motion", "new_floats", "new_like", "plain", "put_complex", "solve",
    "solve_changed", "vector",
]  # fmt: skip

SOLVE = ctypes.CFUNCTYPE(
    ctypes.c_int64, ctypes.c_void_p, *[ctypes.c_int64] * 2, ctypes.c_double, *[ctypes.c_void_p] * 2
)(BUILD.multibody.solve_address())
SINGULAR, NOT_FINITE = BUILD.multibody.MASS_IS_SINGULAR, BUILD.multibody.NOT_FINITE
SINGULAR_MASS = (
    "the mass matrix is singular for motions that the constraints allow: some speeds have no inertia. Give their "
    "bodies a mass or an inertia, or constrain them"
)


class Motion(NamedTuple):
    """The functions of the motion of a system with constraints, with the state y = (q, u).

    ``rhs(t, y, out, *params)`` fills `out` with (q', u'). ``solved(t, y, rates, accelerations, multipliers, *params)``
    fills the arrays with q' (the first entries of `rates`), u' and lambda, and returns the rank of the constraints, or
    `NOT_FINITE`. It raises ValueError if the mass matrix is singular.
    """

    rhs: Callable[..., None]
    solved: Callable[..., int]


def plain(function: Any) -> Callable[..., Any]:
    """Return the Python function of a jitted function, for a few calls that are not worth compilation."""
    return function.py_func if is_jitted(function) else function


def solve(matrices, n, m, tolerance, accelerations, multipliers):
    """Fill `accelerations` (n,) and `multipliers` (m,) with the solution of M u' + G^T lambda = F, G u' = -gamma.

    `matrices` begins with M, F, G and gamma, arrays of floats by rows, and `tolerance` is that of `motion`. Return the
    rank of G, or a negative number: `SINGULAR`, `NOT_FINITE`, or another one if there was too little memory.
    """
    return SOLVE(matrices.ctypes.data, n, m, tolerance, accelerations.ctypes.data, multipliers.ctypes.data)


def changed(matrices, changes, n, m, tolerance, solution, found):
    """Fill `found` with the derivatives (u', lambda) of `solution`, and return the output of `solve`.

    `changes` are the derivatives of `matrices`, the argument of `solve`. The differentiated equations are
    M du' + G^T dlambda = dF - dM u' - dG^T lambda and G du' = -dgamma - dG u'. They have the same matrices M and G.
    """
    (u, multipliers), F, G, gamma = solution, n * n, n * n + n, n * n + n + m * n
    work = matrices.copy()
    for i in range(n):
        work[F + i] = changes[F + i]
        for j in range(n):
            work[F + i] -= changes[i * n + j] * u[j]
        for k in range(m):
            work[F + i] -= changes[G + k * n + i] * multipliers[k]
    for k in range(m):
        work[gamma + k] = changes[gamma + k]
        for j in range(n):
            work[gamma + k] += changes[G + k * n + j] * u[j]
    return SOLVE(work.ctypes.data, n, m, tolerance, found[0].ctypes.data, found[1].ctypes.data)


def solve_changed(solve, changed, lanes, parts_of, put):
    """Return `solve` for numbers with derivatives in several directions, `lanes`.

    ``parts_of(numbers, lane, values, slopes)`` fills two arrays with the values and their derivatives in one direction,
    and ``put(values, slopes, lane, numbers)`` writes them.
    """

    def solved(matrices, n, m, tolerance, accelerations, multipliers):
        values, changes = np.empty(matrices.size), np.empty(matrices.size)
        solution, found, rank = (np.empty(n), np.empty(m)), (np.empty(n), np.empty(m)), 0
        for lane in range(lanes):
            parts_of(matrices, lane, values, changes)
            if lane == 0:
                rank = solve(values, n, m, tolerance, solution[0], solution[1])
            changed(values, changes, n, m, tolerance, solution, found)
            put(solution[0], found[0], lane, accelerations)
            put(solution[1], found[1], lane, multipliers)
        return rank

    return solved


def complex_parts(numbers, lane, values, slopes):
    """Fill two arrays with the real parts of complex numbers and the imaginary ones, derivatives by complex steps."""
    values[:], slopes[:] = numbers.real, numbers.imag


def put_complex(values, slopes, lane, numbers):
    """Write real and imaginary parts to an array of complex numbers."""
    numbers[:] = values + 1j * slopes


_solve_complex = solve_changed(solve, changed, 1, complex_parts, put_complex)


def _solve_any(matrices, n, m, tolerance, accelerations, multipliers):
    """Call `solve` for floats, or for complex numbers."""
    function = solve if matrices.dtype.kind == "f" else _solve_complex
    return function(matrices, n, m, tolerance, accelerations, multipliers)


def _solve_duals(dual: Any) -> Callable[..., int]:
    """Return `solve` for arrays of numbers of the type `dual`, for compiled code."""
    from .duals import solve_duals  # which loads Numba

    return solve_duals(dual)


solve.for_duals = _solve_duals  # type: ignore[attr-defined]


def new_floats(size, like):
    """Return a new array of floats, so that no function is compiled for complex states, which C code would misread."""
    return np.empty(size)


def new_like(size, like):
    """Return a new array with the dtype of the array `like`: for complex steps, that of complex numbers."""
    return np.empty(size, like.dtype)


@lru_cache(maxsize=64)
def motion(fill: Callable[..., None], sizes: tuple[int, int, int], tolerance: float) -> Motion:
    """Return the functions of the motion that satisfies M u' + G^T lambda = F and G u' = -gamma.

    ``fill(t, y, out, *params)`` fills `out` with M (by rows), F, G (by rows), gamma and q', one after the other.
    `sizes` are the numbers of coordinates, speeds and constraints on the speeds. Gradients of constraints within the
    distance `tolerance`, each scaled to length 1, count as dependent.
    """
    (nq, n, m), compiles = sizes, is_jitted(fill)
    matrices = (n + m + 1) * n + m
    solve_now, new = (jitted(compilable(item)) for item in (solve, new_floats)) if compiles else (_solve_any, new_like)

    def solved(t, y, rates, accelerations, multipliers, *params):
        work = new(matrices + nq, rates)
        fill(t, y, work, *params)
        for k in range(nq):  # assignments to slices take Numba seconds to compile
            rates[k] = work[matrices + k]
        rank = solve_now(work, n, m, tolerance, accelerations, multipliers)
        if rank == SINGULAR:
            raise ValueError(SINGULAR_MASS)
        if rank < NOT_FINITE:
            raise MemoryError
        return rank

    fast = compiled_like(solved, fill)

    def rhs(t, y, out, *params):
        accelerations, multipliers = new(n, out), new(m, out)
        fast(t, y, out, accelerations, multipliers, *params)
        for k in range(n):
            out[nq + k] = accelerations[k]

    rhs.not_jitted = getattr(fill, "not_jitted", "")  # type: ignore[attr-defined]
    return Motion(compiled_like(rhs, fast), fast)


@lru_cache(maxsize=64)
def vector(fill: Callable[..., None], size: int) -> Callable[..., np.ndarray]:
    """Return a function of ``(t, y, *params)`` that returns a new array of length `size`, filled by `fill`."""

    def value(t, y, *params):
        out = np.empty(size)
        fill(t, y, out, *params)
        return out

    return compiled_like(value, fill)
