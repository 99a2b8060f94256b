"""Interval and saved steps, as all comparators take them."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["check_span", "saved_steps"]


def check_span(t_span: Any) -> tuple[float, float]:
    """Start and end as floats.

    Raises
    ------
    ValueError
        When these are not two finite numbers.
    """
    span = np.asarray(t_span, dtype=float)
    if span.shape != (2,) or not np.isfinite(span).all():
        raise ValueError(f"t_span must hold two finite numbers, got {t_span!r}")
    return float(span[0]), float(span[1])


def saved_steps(n_steps: int, save_every: int | None) -> np.ndarray:
    """Numbers of the steps after which the state is saved; 0, the start, is the first of them.

    Raises
    ------
    ValueError
        When `save_every` is neither a positive integer nor None.
    """
    if save_every is None:
        save_every = max(n_steps, 1)
    if isinstance(save_every, bool) or not isinstance(save_every, (int, np.integer)) or save_every < 1:
        raise ValueError(f"save_every must be a positive integer or None, got {save_every!r}")
    return np.unique(np.append(np.arange(0, n_steps + 1, save_every, dtype=np.int64), np.int64(n_steps)))
