"""Particles with states (q, v): their angular momentum, and whether a system keeps it together with the momentum."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from .functions import compilable, jitted
from .inputs import real_array, shown
from .invariants import Invariant, copied
from .linear import LinearInvariants

__all__ = ["Particles", "compiled_items", "missing_particles", "particle_invariants"]

# The largest share of their terms that total forces and torques, and changes of a mass between states, may have; and
# the smallest share of a gradient that is not a combination of others.
SMALL, REMAINDER = 1e-9, 1e-7

Array = np.ndarray


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
        by their corrections, as with the option `frame`, in those directions in which `fun` keeps them; see
        :doc:`/explanation/metric`. Together with the energy these are all ten integrals of free particles.

    Raises
    ------
    ValueError
        If a mass is negative or not finite, all are 0, or `dimension` or `about` are wrong.

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


class Particles(NamedTuple):
    """Masses (N,) of particles with this number of coordinates, whose momentum or angular momentum no run keeps yet."""

    masses: Array
    dimension: int

    def __str__(self) -> str:
        given = "masses" if self.dimension == 3 else "masses, dimension=2"
        return (
            "momentum and angular momentum of the particles are conserved too, and the run does not keep all of them, "
            "without which keeping the energy can make the motion less accurate. Write "
            f"invariants=[H, *particle_invariants({given})], with the masses of the energy H"
        )


def missing_particles(samples: Any, C: Array) -> Particles | None:
    """Return the particles of a state (q, v) whose momentum and angular momentum the run does not keep; else None.

    `samples` are the `Samples` around the start. One of the invariants is the energy, whose gradient gives the masses,
    and `C` (k, n) are the linear invariants that the corrections leave unchanged.
    """
    y, half = samples.y0, samples.y0.size // 2
    if y.size % 2 or not np.array_equal(samples.f0[:half], y[half:]):
        return None
    for d, row in product((3, 2), range(len(samples.G0))):
        if half % d or half < 2 * d or _masses(y, samples.f0, samples.G0[row], d) is None:
            continue
        states = list(zip(*samples.points, samples.gradients, strict=False))
        m, *others = (_masses(x, f, G[row], d) for x, f, G in states)
        if m is None or not all(found is not None and (np.abs(found - m) <= SMALL * m).all() for found in others):
            continue
        if _lacks(particle_invariants(m, d)[0], states[0][0], np.concatenate([states[0][2], C])):
            return Particles(m, d)
    return None


def _masses(y: Array, f: Array, slope: Array, d: int) -> Array | None:
    """Return masses (N,) for which `slope` has the momenta, and total force and torque are 0; None if there are none.

    The mass of a particle at rest is unknown, NaN, and then forces and torques are not examined.
    """
    (q, v), (_, a), (_, p) = (x.reshape(2, -1, d) for x in (y, f, slope))
    m: Array = (p * v).sum(axis=1) / (v * v).sum(axis=1)
    if (np.abs(p - m[:, None] * v) > SMALL * np.abs(p).max(axis=1, keepdims=True)).any() or (m <= 0).any():
        return None
    if np.isnan(m).any():
        return m
    force = m[:, None] * a
    turns = q[:, :, None] * force[:, None, :]
    torque, sizes = turns.sum(axis=0), np.abs(turns).sum(axis=0)
    is_free = (np.abs(force.sum(axis=0)) <= SMALL * np.abs(force).sum(axis=0)).all()
    return m if is_free and (np.abs(torque - torque.T) <= SMALL * (sizes + sizes.T)).all() else None


def _lacks(item: Invariant, y: Array, known: Array) -> bool:
    """Return True if momentum or angular momentum, `item`, at the state y do not follow from the gradients `known`."""
    assert item.linear is not None
    assert item.gradient is not None
    d = len(item.linear.C) // 2
    slope = np.empty((1 if d == 2 else 3, y.size))
    item.gradient(0.0, y, slope)
    wanted = np.concatenate([item.linear.C[d:], slope]).T
    known = known.T / np.maximum(np.linalg.norm(known, axis=1), np.finfo(float).tiny)
    rest = wanted - known @ np.linalg.lstsq(known, wanted, rcond=SMALL)[0]
    return bool((np.linalg.norm(rest, axis=0) > REMAINDER * np.linalg.norm(wanted, axis=0)).any())


def compiled_items(items: tuple[Invariant, ...]) -> tuple[Invariant, ...]:
    """Return the invariants, with those of particles jitted if Numba is installed."""
    return tuple(item if item.linear is None else _compiled(item) for item in items)


def _compiled(item: Invariant) -> Invariant:
    new: Invariant = copied(item)
    new.function, new.gradient = jitted(item.function), jitted(item.gradient)
    return new
