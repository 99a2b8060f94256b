"""The figure of an ensemble."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.problem import component_names
from .tasks import FAILED, NOT_RUN

__all__ = ["plot"]

AT_MOST = 10_000  # members whose errors are drawn


def plot(result: Any, names: Any = None) -> Any:
    """Draw an ensemble, see `EnsembleResult.plot`."""
    from ..plotting.ensembles import ensemble_figure

    labels = component_names(result.component_names if names is None else names, result.y.shape[1])
    times, states = _states(result)
    step = "adaptive steps" if result.h is None else f"h = {result.h:g}"
    members = np.unique(np.linspace(0, len(result.t) - 1, min(len(result.t), AT_MOST)).round().astype(int))
    return ensemble_figure(
        times,
        {label: states[:, k] for k, label in enumerate(labels)},
        members=result.first + members,
        errors={name: result.max_residual[members, k] for k, name in enumerate(result.names)},
        failed=result.status[members] == FAILED,
        counts=_counts(result),
        title=f"{len(result.t)} members, {result.method}, {step}",
    )


def _states(result: Any) -> tuple[np.ndarray | None, np.ndarray]:
    """Return saved times and states (members, n, m); None and last states (members, n, 1) if none are saved."""
    if result.trajectories is not None and result.times.size > 1:
        return result.times, result.trajectories
    last = np.where((result.status >= 0)[:, None], result.y, np.nan)
    return None, last[:, :, None]


def _counts(result: Any) -> dict[str, int]:
    """Return the number of members by the way in which they ended."""
    doubtful = (result.status >= 0) & ~result.trusted
    found = {
        "reached the end": (result.status == 0) & ~doubtful,
        "ended by an event": (result.status == 1) & ~doubtful,
        "not to be trusted": doubtful,
        "failed": result.status == FAILED,
        "did not run": result.status == NOT_RUN,
    }
    return {what: int(np.count_nonzero(those)) for what, those in found.items()}
