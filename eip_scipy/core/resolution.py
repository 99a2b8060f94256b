"""Comparison of a few steps with shorter ones, which shows whether the steps resolve each part of the state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..engine.data import LEAST_CHANGE, Grouping, Method
from ..methods.runge_kutta import DOP853

__all__ = ["runge_kutta_step", "unresolved"]

# Consecutive steps that are compared, each with SUBSTEPS of DOP853. At most one of them passes a kink, so the step with
# the largest error counts only from the share LOST on: what a close passage throws out moves freely from then on. Steps
# over kinks have up to 0.11 (a ball that bounces on a stiff spring, by RK5).
STEPS, SUBSTEPS = 3, 4
# A block is not resolved if a step errs by this share of the block's size, or of what the step changes in it, by the
# least number of stages. Correct runs have up to 0.034 by RK2 (table 2 of the paper) and 0.0074 by RK4 (the pericentre
# of Kepler's orbit with e = 0.6 and h = 0.1).
UNRESOLVED = {2: 0.1, 3: 0.03, 4: 1e-2, 8: 2e-3}
LOST = 0.3
# Share of its length by which a whole number of steps may miss an interval.
ROUNDING = 1e-12

Array = np.ndarray


def unresolved(
    method: Any, groups: Grouping, rhs: Callable[[float, Array], Array], t: float, h: float, y: Array, end_of_run: float
) -> str | None:
    """Return a sentence on the part of the state that steps of length h from (t, y) do not resolve, or None.

    `method` is `Run.method`, and `groups` are the blocks of the state. Methods of one stage, and user-defined methods,
    are not judged: the error of a method of order 1 in a first step from rest is as large as the motion in this step.
    `rhs` is not called at times after `end_of_run`.
    """
    steps = int(min(STEPS, (end_of_run - t) / h * (1 + ROUNDING)))
    if method.b.size == 1 or steps < 2:
        return None
    shares, end = [], y
    for k in range(steps):
        begin, at = end, t + k * h
        end = begin
        for part in range(SUBSTEPS):
            end = runge_kutta_step(DOP853.A, DOP853.b, DOP853.c, rhs, at + part * h / SUBSTEPS, h / SUBSTEPS, end)
        own = _nystrom_step(method, rhs, at, h, begin) if method.nystrom else runge_kutta_step(
            method.A, method.b, method.c, rhs, at, h, begin
        )  # fmt: skip
        size = np.max([_norms(part, groups) for part in (end - begin, h * rhs(at, begin), begin)], axis=0)
        if not (np.isfinite(end).all() and np.isfinite(own).all() and size.max() > 0):
            return None
        # Rounding in the tails of a field is not resolved.
        shares.append(_norms(own - end, groups) / (size + LEAST_CHANGE * size.max()))
    second, largest = np.sort(shares, axis=0)[-2:]
    errors = np.where(largest > LOST, largest, second)
    block = int(errors.argmax())
    if errors[block] < next(share for stages, share in reversed(UNRESOLVED.items()) if method.b.size >= stages):
        return None
    return (
        f"steps of h={abs(h):g} do not resolve the motion of component{_components(groups, block)} of the state: at "
        f"t={t:.6g} the error of one step is {errors[block]:.2g} of the size of this part or of its change; take a "
        "shorter step"
    )


def runge_kutta_step(
    A: Array, b: Array, c: Array, rhs: Callable[[float, Array], Array], t: float, h: float, y: Array
) -> Array:
    """Return the state (n,) after a step of length h, which may be negative, by the Runge-Kutta method (A, b, c)."""
    K = np.empty((b.size, y.size), y.dtype)
    for i in range(b.size):
        K[i] = rhs(t + c[i] * h, y + h * (A[i, :i] @ K[:i]))
    return y + h * (b @ K)


def _nystrom_step(method: Method, rhs: Callable[[float, Array], Array], t: float, h: float, y: Array) -> Array:
    q, v = np.split(y, 2)
    a = np.empty((method.b.size, q.size), y.dtype)
    for i in range(method.b.size):
        stage = q + h * (method.c[i] * v + h * (method.A[i, :i] @ a[:i]))
        a[i] = rhs(t + method.c[i] * h, np.concatenate([stage, v]))[q.size :]
    return np.concatenate([q + h * (v + h * (method.b @ a)), v + h * (method.b_v @ a)])


def _norms(state: Array, groups: Grouping) -> Array:
    """Return an array with the 2-norm of each block of a state."""
    squares = np.ascontiguousarray(state).view(float)[groups.member] ** 2
    return np.sqrt(np.add.reduceat(squares, groups.start[:-1].astype(np.intp)))


def _components(groups: Grouping, block: int) -> str:
    """Return the text after "component" in a message that names the components of a block: " 3" or "s 0, 1, 2"."""
    floats = groups.member[groups.start[block] : groups.start[block + 1]].astype(int)
    places = np.unique(floats // groups.width).tolist()
    return f" {places[0]}" if len(places) == 1 else "s " + ", ".join(map(str, places[:6])) + ", ..." * (len(places) > 6)
