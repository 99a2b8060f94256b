"""Multistep methods in a run: their history, the check that the step is stable, and the use of the Jacobian."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..engine.data import AUTO, N_NODE_PLACES, Multistep
from ..methods.multistep import GaussJackson, longest_stable, stability_limit, weights
from .runs import Run, Start
from .stepping import Stepping

__all__ = ["SecondOrder", "attach_history", "times"]

Array = np.ndarray
AUTO_SPACING, OF_GROUPS = 64, 32  # the second one for balances that are projected by themselves
# Steps of DOP853, which starts where accelerations depend on velocities, in one step.
SUBSTEPS = 4
ROWS = 4  # of the history's window, in orders of the method
ALIGNMENT = 64
# Bodies whose frequency is above this share of what is stable without the Jacobian are corrected by it.
CORRECTED_SHARE = 0.8
# The largest differences of a smooth history, relative to the accelerations; for low orders, in units of those that
# the largest stable step has.
SMOOTH, SMOOTH_LOW = 1e-2, 30.0
ROUNDS = 12  # of the power iterations
DIFFERENCE = 1e-6


class SecondOrder(NamedTuple):
    """A system q'' = a(t, q[, v]) in the form that a multistep method needs.

    ``rhs(t, y) -> (n,)`` is that of y = (q, v), ``jacobian(t, q, dq) -> (n/2,)`` the derivative of the accelerations
    along dq, or None, and `frequencies` the pair (bodies, others) of ``Problem.frequencies``, or None.
    """

    rhs: Callable[[float, Array], Array]
    start: Start
    jacobian: Callable[[float, Array, Array], Array] | None
    frequencies: tuple[Array, float] | None


def times(jacobian: Callable[..., None], *extra: Array) -> Callable[[float, Array, Array], Array]:
    """Return ``product(t, q, dq)``, the Jacobian times dq, made from a user's ``jacobian(t, q, dq, out, *extra)``."""

    def product(t: float, q: Array, dq: Array) -> Array:
        out = np.empty_like(q)
        out.fill(np.nan)
        jacobian(t, q.copy(), dq.copy(), out, *extra)
        return out

    return product


def attach_history(run: Run, name: str, system: SecondOrder, stepping: Stepping, *, level: bool) -> None:
    """Check the step of a run of a multistep method, and add the history of the method to the run.

    `name` is the name of the method in messages. For `level`, see `RunSpec`. Raise ValueError if the step is not stable
    at the start (not checked with ``check=False``), or if a run with balances has too few steps for a history.
    """
    method: Any = run.tableau
    assert stepping.h is not None
    brief, balanced = stepping.span.n_steps - 1 < method.order, run.work.level.size > 0
    if brief and balanced and stepping.span.n_steps > 0:
        raise ValueError(
            f"{name} carries a Balance in its history, which needs more than {method.order} steps, but this run has "
            f"{stepping.span.n_steps}. Take a shorter step, or a Runge-Kutta method such as EIPDOP853."
        )
    check = run.options.limit < math.inf  # the option of this name bounds the shares of corrections
    corrected = slice(0, 0) if brief else _stable(method, name, system, stepping.h, check)
    brief = brief and not balanced  # the engine takes balances with the room of a history, also without steps
    run.method = run.method._replace(multistep=_record(run, method, corrected, stepping, brief=brief, level=level))


def _stable(method: GaussJackson, name: str, system: SecondOrder, h: float, check: bool) -> slice:
    """Return the slice of the accelerations' floats that the Jacobian corrects; `check` that the step h is stable."""
    y0 = system.start.y
    half = y0.size // 2
    plain = stability_limit(method.order, False)
    corrects = method.corrected and system.jacobian is not None
    limit = stability_limit(method.order, True) if corrects else plain
    corrected = np.full(half, corrects)
    if system.frequencies is None:
        fastest = _largest_frequency(system)
    else:
        bodies, moons = system.frequencies
        if corrects:
            fast = h * bodies > CORRECTED_SHARE * plain
            corrected = np.repeat(fast | (fast.any() & (bodies == 0.0)), half // bodies.size)
        planets = float(bodies.max(initial=0.0))
        # Nothing corrects moons.
        fastest, limit = (planets, limit) if planets * plain >= moons * limit else (moons, plain)
    if check and not h * fastest <= limit:
        raise ValueError(
            f"{name}: h = {h:g} is not stable for the fastest motion at the start, of angular frequency {fastest:.4g} "
            f"(period {2 * np.pi / fastest:.4g}). Take h <= {limit / fastest:.3g}, or a method that is stable with "
            "longer steps, such as EIPRKN12."
        )
    if method.velocities:
        # The largest modulus of an eigenvalue of the accelerations' derivative by the velocities.
        strongest = _largest(lambda d: _difference(system, d, slice(half, None)), y0)
        part = longest_stable(method.order, corrects, h * fastest, h * strongest) if check and strongest > 0.0 else 1.0
        if part < 1.0:
            raise ValueError(
                f"{name}: h = {h:g} is not stable, because the derivative of the accelerations with respect to the "
                f"velocity is too large: its largest eigenvalue at the start has the size {strongest:.4g}. Take h <= "
                f"{part * h:.3g}, or a Runge-Kutta method such as EIPDOP853."
            )
    width = 2 if y0.dtype.kind == "c" else 1
    places = np.flatnonzero(corrected)
    return slice(width * int(places[0]), width * int(places[-1] + 1)) if places.size else slice(0, 0)


def _largest_frequency(system: SecondOrder) -> float:
    """Return the largest angular frequency of small motions at the start, from the Jacobian's least eigenvalue."""
    t, y, _, _ = system.start
    half = y.size // 2

    def along(d: Array) -> Array:
        return _difference(system, d, slice(0, half)) if system.jacobian is None else system.jacobian(t, y[:half], d)

    if half <= ROUNDS and y.dtype.kind == "f":
        columns = [along(unit) for unit in np.eye(half)]
        return (
            math.sqrt(max(0.0, -np.linalg.eigvals(np.array(columns)).real.min())) if np.isfinite(columns).all() else 0.0
        )
    top = _largest(along, y)
    return float(np.sqrt(max(0.0, _largest(lambda d: top * d - along(d), y) - top))) if top else 0.0


def _difference(system: SecondOrder, d: Array, part: slice) -> Array:
    """Return the derivative (n/2,) of the accelerations at the start along d in `part`, positions or velocities."""
    t, y, f, _ = system.start
    half, length = y.size // 2, DIFFERENCE * (float(np.linalg.norm(y[part])) or 1.0)
    moved = y.copy()
    moved[part] += length * d
    return np.asarray((system.rhs(t, moved)[half:] - f[half:]) / length)


def _largest(product: Callable[[Array], Array], y: Array) -> float:
    """Return the largest modulus of an eigenvalue of a matrix, to a few per cent; 0 if products are 0 or not finite.

    ``product(d)`` is the matrix times d. The vectors d have the type and half the size of the state y.
    """
    d, found = np.random.default_rng(0).standard_normal(y.size // 2).astype(y.dtype), 0.0
    for _ in range(ROUNDS):
        d = product(d / np.sqrt(np.vdot(d, d).real))
        found = float(np.sqrt(np.vdot(d, d).real))
        if not np.isfinite(found) or found == 0.0:
            return 0.0
    return found


def _record(
    run: Run, method: GaussJackson, corrected: slice, stepping: Stepping, *, brief: bool, level: bool
) -> Multistep:
    order, half = method.order, run.work.err.size // 2
    pitch = -(-half // 4) * 4  # whole vectors
    limit, grouped = stability_limit(order, method.corrected), run.options.balance_groups.value.size > 0
    return Multistep(
        **weights(order)._asdict(),
        growth=max(SMOOTH, min(SMOOTH_LOW * limit**order, 2.0 ** (order - 2))),
        middle=method.middle,
        brief=brief,
        level=level,
        uses_v=method.velocities,
        t0=stepping.span.t0,
        h=stepping.span.h,
        substeps=SUBSTEPS if method.velocities else 1,
        spacing=run.options.every if run.options.every != AUTO else OF_GROUPS if grouped else AUTO_SPACING,
        corrected_first=corrected.start,
        corrected_count=corrected.stop - corrected.start,
        nodes=_aligned((ROWS * order, pitch)),
        sums=_aligned((4, pitch)),
        predicted=_aligned((3, pitch)),
        change=_aligned((half,)),
        levels=np.zeros((3, run.invariants.size)),
        rates=np.zeros((ROWS * order, run.work.level.size)),
        rate_sums=np.zeros((2, run.work.level.size)),
        place=np.zeros(N_NODE_PLACES, np.int64),
    )


def _aligned(shape: tuple[int, ...]) -> Array:
    """Return an array of zeros aligned to a cache line, because unaligned loads of vectors may take twice as long."""
    size = math.prod(shape)
    memory = np.zeros(size * 8 + ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    return memory[first : first + size * 8].view(np.float64).reshape(shape)
