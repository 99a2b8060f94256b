"""Particles with states (q, v): their angular momentum as an invariant, with which runs keep linear invariants."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from .functions import compilable, jitted
from .inputs import real_array, shown
from .invariants import Invariant, copied

__all__ = ["LinearInvariants", "compiled_items", "particle_invariants"]

Array = np.ndarray


class LinearInvariants(NamedTuple):
    """Quantities C y, with C of shape (k, n), and their rates A C y, with A of shape (k, k)."""

    C: Array
    A: Array

    def only(self, rows: Array) -> LinearInvariants:
        """Return those of the `rows`, a mask (k,), whose rates are 0 or among them too."""
        kept = rows & ~(self.A[:, ~rows] != 0).any(axis=1)
        return LinearInvariants(self.C[kept], self.A[np.ix_(kept, kept)])


def particle_invariants(masses: Any, dimension: int = 3, *, about: Any = None) -> list[Invariant]:
    """Return the angular momentum of particles as an invariant; its runs also keep momentum and centre of mass.

    Parameters
    ----------
    masses : array_like, shape (N,)
        Masses of the particles, in any unit; 0 for a particle that does not act on the others.
    dimension : {3, 2}, optional
        Number of coordinates of each particle. The state is (q_1, ..., q_N, v_1, ..., v_N), each with this many
        components.
    about : array_like, shape (dimension,), optional
        Point about which the angular momentum is taken. Default: the origin.

    Returns
    -------
    list of Invariant
        The angular momentum L, the sum of m q x v, with its gradient: 3 values in three dimensions, one value in two,
        in the unit of mass times that of q times that of v. Runs with it leave momentum and centre of mass unchanged
        by their corrections, as with the option `linear_invariants`, in those directions in which `fun` keeps them; see
        :doc:`/explanation/metric`. Together with the energy these are all ten integrals of free particles.

    Raises
    ------
    ValueError
        If a mass is negative or not finite, all are 0, or `dimension` or `about` are wrong.

    See Also
    --------
    find_invariants, Invariant, eip_scipy.problems.nbody

    Notes
    -----
    The functions are jitted if those of the run are. They accept the ``params`` of a run and do not use them.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import particle_invariants
    >>> (L,) = particle_invariants([2.0, 1.0], dimension=2)
    >>> L.fun(0.0, np.array([1.0, 0, 0, 0, 0, 3.0, 0, 0]))
    array([6.])
    """
    m = real_array("masses", masses)
    if m.ndim != 1 or not (np.isfinite(m).all() and (m >= 0).all() and m.any()):
        raise ValueError(f"masses must be finite numbers >= 0, not all 0, of shape (N,); got {shown(masses)}.")
    if dimension not in (2, 3):
        raise ValueError(f"dimension must be 2 or 3, got {shown(dimension)}.")
    centre = np.zeros(dimension) if about is None else real_array("about", about)
    if centre.shape != (dimension,) or not np.isfinite(centre).all():
        raise ValueError(f"about must be a point with {dimension} finite coordinates, got {shown(about)}.")
    value, gradient = _functions(tuple(m.tolist()), tuple(centre.tolist()))
    item = Invariant(value, gradient, in_place=True, name="L")
    item.value_names = () if dimension == 3 else ("L",)
    share, axes = m / m.max(), np.eye(dimension)
    item.linear = LinearInvariants(np.kron(np.eye(2), np.kron(share, axes)), np.kron(np.eye(2, k=1), axes))
    return [item]


@lru_cache(maxsize=32)
def _functions(masses: tuple[float, ...], about: tuple[float, ...]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the angular momentum and its gradient in place, in loops, which Numba compiles 10 times faster."""
    m, a, d = np.array(masses), np.array(about), len(about)
    half, planes = d * m.size, np.array([(0, 1)] if d == 2 else [(1, 2), (2, 0), (0, 1)])

    def value(t: float, y: Array, *params: Any) -> Any:
        L = np.zeros(len(planes))
        for b in range(m.size):
            q, v = d * b, half + d * b
            for k in range(len(planes)):
                i, j = planes[k]
                L[k] += m[b] * ((y[q + i] - a[i]) * y[v + j] - (y[q + j] - a[j]) * y[v + i])
        return L

    def gradient(t: float, y: Array, out: Array, *params: Any) -> None:
        out[:] = 0.0
        for b in range(m.size):
            q, v = d * b, half + d * b
            for k in range(len(planes)):
                i, j = planes[k]
                out[k, q + i], out[k, q + j] = m[b] * y[v + j], -m[b] * y[v + i]
                out[k, v + i], out[k, v + j] = -m[b] * (y[q + j] - a[j]), m[b] * (y[q + i] - a[i])

    return compilable(value), compilable(gradient)


def compiled_items(items: tuple[Invariant, ...]) -> tuple[Invariant, ...]:
    """Return the invariants, with those of particles jitted if Numba is installed."""
    found = list(items)
    for k, item in enumerate(items):
        if item.linear is not None:
            found[k] = new = copied(item)
            new.function, new.gradient = jitted(item.function), jitted(item.gradient)
    return tuple(found)
