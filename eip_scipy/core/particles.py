"""Particles with states (q, v): their angular momentum, and whether a system keeps it together with the momentum."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from .inputs import real_array, shown
from .invariants import Invariant, copied
from .jitted import compilable, is_jitted, jitted
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
    >>> float(L.fun(0.0, np.array([1.0, 0, 0, 0, 0, 3.0, 0, 0])))
    6.0
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
    share, axes, zero = m / m.max(), np.eye(dimension), np.zeros((dimension, dimension))
    A = np.block([[zero, axes], [zero, zero]])
    item.linear = LinearInvariants(np.kron(np.eye(2), np.kron(share, axes)), A)
    return [item]


@lru_cache(maxsize=32)
def _functions(masses: tuple[float, ...], about: tuple[float, ...]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the angular momentum and its gradient in place, which Numba can compile."""
    m, a, d = np.array(masses), np.array(about), len(about)
    half = d * m.size

    def plane(t: float, y: Array, *params: Any) -> Any:
        q, v = y[:half].reshape(-1, 2) - a, y[half:].reshape(-1, 2)
        return (m * (q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0])).sum()

    def plane_gradient(t: float, y: Array, out: Array, *params: Any) -> None:
        out[0:half:2], out[1:half:2] = m * y[half + 1 :: 2], -m * y[half::2]
        out[half::2], out[half + 1 :: 2] = -m * (y[1:half:2] - a[1]), m * (y[0:half:2] - a[0])

    def space(t: float, y: Array, *params: Any) -> Any:
        q, v, out = y[:half].reshape(-1, 3) - a, y[half:].reshape(-1, 3), np.empty(3)
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            out[k] = (m * (q[:, i] * v[:, j] - q[:, j] * v[:, i])).sum()
        return out

    def space_gradient(t: float, y: Array, out: Array, *params: Any) -> None:
        out[:] = 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            out[k, i:half:3], out[k, j:half:3] = m * y[half + j :: 3], -m * y[half + i :: 3]
            out[k, half + i :: 3], out[k, half + j :: 3] = -m * (y[j:half:3] - a[j]), m * (y[i:half:3] - a[i])

    chosen = (plane, plane_gradient) if d == 2 else (space, space_gradient)
    return compilable(chosen[0]), compilable(chosen[1])


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


def missing_particles(
    y: Array, f: Array, G: Array, C: Array, sample: Callable[[], Iterable[tuple[Array, Array, Array]]]
) -> Particles | None:
    """Return the particles of a state (q, v) whose momentum and angular momentum the run does not keep; else None.

    `G` (l, n) are the gradients of the invariants, one of which is the energy, and `C` (k, n) the linear invariants
    that the corrections leave unchanged. ``sample()`` returns states near y with their derivatives and gradients.
    """
    half = y.size // 2
    if y.size % 2 or not np.array_equal(f[:half], y[half:]):
        return None
    for d in (3, 2):
        for row in range(len(G)) if half % d == 0 and half >= 2 * d else ():
            m = _masses(G[row, half:], y[half:], d)
            if m is None or not ((m > 0) | np.isnan(m)).all() or not _is_free(m, d, y, f):
                continue
            if not np.isnan(m).any() and not _lacks(particle_invariants(m, d)[0], y, np.concatenate([G, C])):
                continue
            states = list(sample())
            found = [_masses(slopes[row, half:], x[half:], d) for x, _, slopes in states]
            m = found[0]
            if m is None or not (m > 0).all() or not all(n is not None and _agree(n, m) for n in found):
                continue
            (own,) = particle_invariants(m, d)
            lacks = (_lacks(own, x, np.concatenate([slopes, C])) for x, _, slopes in states)
            if all(_is_free(m, d, x, rate) for x, rate, _ in states) and all(lacks):
                return Particles(m, d)
    return None


def _masses(slope: Array, v: Array, d: int) -> Array | None:
    """Return the masses (N,) of which `slope` is the momentum of the velocities v (N d,); None if there are none.

    The mass of a particle at rest is NaN.
    """
    p, u = slope.reshape(-1, d), v.reshape(-1, d)
    squares = (u * u).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        m: Array = (p * u).sum(axis=1) / squares
        agrees = np.abs(p - m[:, None] * u) <= SMALL * np.abs(p).max(axis=1, keepdims=True)
    return m if (agrees.all(axis=1) | ((squares == 0) & ~p.any(axis=1))).all() else None


def _agree(one: Array, two: Array) -> bool:
    return bool((np.abs(one - two) <= SMALL * two).all())


def _is_free(m: Array, d: int, y: Array, f: Array) -> bool:
    """Return True if the total force and the total torque on the particles are 0, or if masses are unknown."""
    if np.isnan(m).any():
        return True
    q, force = y[: y.size // 2].reshape(-1, d), m[:, None] * f[y.size // 2 :].reshape(-1, d)
    axes = ((0, 1),) if d == 2 else ((1, 2), (2, 0), (0, 1))
    parts = [force, *([q[:, i] * force[:, j], -q[:, j] * force[:, i]] for i, j in axes)]
    return all(
        bool((np.abs(np.sum(x, axis=0)) <= SMALL * np.sum(np.abs(x), axis=0)).all())
        for x in (parts[0], *(np.concatenate(pair) for pair in parts[1:]))
    )


def _lacks(item: Invariant, y: Array, kept: Array) -> bool:
    """Return True if momentum or angular momentum (`item`) at the state y does not follow from the gradients `kept`."""
    assert item.linear is not None
    assert item.gradient is not None
    d = len(item.linear.C) // 2
    rows, slope = item.linear.C[d:], np.empty((1 if d == 2 else 3, y.size))
    item.gradient(0.0, y, slope[0] if d == 2 else slope)
    kept = kept / np.maximum(np.linalg.norm(kept, axis=1, keepdims=True), np.finfo(float).tiny)
    for wanted, known in ((rows, kept), (slope, np.concatenate([kept, rows]))):
        rest = wanted.T - known.T @ np.linalg.lstsq(known.T, wanted.T, rcond=SMALL)[0]
        if (np.linalg.norm(rest, axis=0) > REMAINDER * np.linalg.norm(wanted, axis=1)).any():
            return True
    return False


def compiled_items(items: tuple[Invariant, ...]) -> tuple[Invariant, ...]:
    """Return the invariants, with those of particles jitted if Numba is installed."""
    return tuple(map(_compiled, items)) if any(item.linear is not None for item in items) else items


def _compiled(item: Invariant) -> Invariant:
    new: Invariant = copied(item)
    if item.linear is not None and not is_jitted(item.function):  # those of a continued run are jitted already
        new.function, new.gradient = jitted(item.function), jitted(item.gradient)
    return new
