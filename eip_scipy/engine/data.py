"""Records, codes and indices of a run as the engine declares them (cpp/data.hpp), and functions that create them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .native import BUILD

if TYPE_CHECKING:
    from ._native import *  # noqa: F403
    from ._native import Balances, Columns, Groups, Method, Schedule, Span
else:
    globals().update((name, value) for name, value in vars(BUILD).items() if not name.startswith("_"))

# Dead band in units of the rounding error of the terms of an invariant; compensated runs use the smaller one.
BAND, BAND_COMPENSATED, BAND_MULTISTEP = 4.0, 1.0, 1 / 64


def bare_schedule(span: Span, first: float) -> Schedule:
    """Return a schedule of the interval `span` that saves no states; `first` is the length of the first step."""
    none = np.zeros(0)
    clock = np.array([span.t0, span.t0, 0.0, first])
    return Schedule(span, 0, none, np.zeros(3, np.int64), clock, none, none, none, none, none)


# A run without balances has these; an engine that only projects has this method.
NO_BALANCES = Balances(place=np.zeros(0, np.int64), rated=np.zeros(0, np.int64))
NO_GROUPS = Groups(
    value=np.zeros(0, np.int64), first_value=np.zeros(1, np.int64), first_direction=np.zeros(1, np.int64),
    first_float=np.zeros(1, np.int64), place=np.zeros(0, np.int64), weight=np.zeros(0), size=1,
)  # fmt: skip
_none = np.zeros(0)


def no_columns(values: int) -> Columns:
    """Return the record `Columns` of a run without columns of derivatives whose invariants have `values` values."""
    return Columns(kept=np.zeros((values, 0)), size=0, seen=0, half=0, symplectic=False)


NO_METHOD = Method(
    A=np.zeros((0, 0)), b=_none, b_low=_none, b_v=_none, b_v_low=_none, c=_none, e=_none, e_v=_none, e_low=_none,
    nystrom=False, sees_velocity=False, fsal=False, paired=False, exponent=0.0,
)  # fmt: skip
