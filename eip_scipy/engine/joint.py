"""The projection where a problem knows its invariants' inner products: two passes over the state instead of twenty."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import kernels as kn
from .counters import FOUND, HAVE_ERROR, LAST_RANK, NJEV, NLU, PROJECTIONS, SKIPPED, WAITED
from .data import EPS

__all__ = ["project_jointly"]


def project_jointly(t: float, o: Any, w: Any, y_new: np.ndarray, y_new_r: np.ndarray) -> bool:
    """One Newton step from w.y_hat into y_new by the functions of o.joint (`JointInvariants`).

    The same step as `project_step` takes in the euclidean metric, its dead bands, bounds and verdict included. False
    where that needs more: gradients nearly parallel, or a projection that does not hold; nothing is counted then.
    """
    joint, f_hat, counters = o.joint, w.K[-1], w.counters
    joint.moments(t, w.y_hat, f_hat, w.values, w.R, w.inverse_norms)
    lengths = np.sqrt(np.diagonal(w.R)) if o.watched and counters[HAVE_ERROR] else None
    terms = np.maximum(w.inverse_norms, o.scales)
    outside = kn.defects(w.values, o.target, w.G_r[:, :0], w.y_hat_r[:0], terms, False, w.g, w.band, w.before)
    if outside:
        if not kn.gram_solution(w.R, w.g, w.mu):
            return False
        joint.shift(t, w.y_hat, f_hat, w.mu, y_new, w.values)
    else:
        kn.copy(w.y_hat_r, y_new_r)
    if not kn.defects_held(w.values, o.target, w.before, w.band, w.defect):
        return False
    if not kn.small_shares(w.defect, w.band, w.trust, o.per_band, o.limit):
        return False
    counters[NJEV] += 1
    if outside:
        counters[NLU] += 1
        counters[PROJECTIONS] += 1
        counters[LAST_RANK] = o.target.size
    else:
        counters[SKIPPED] += 1
    _take_note(t, lengths, o, w)
    return True


def _take_note(t: float, lengths: np.ndarray | None, o: Any, w: Any) -> None:
    """As `take_note` of the step does, with |G_i| |err| in place of the sum over all components."""
    if not o.watched:
        kn.raise_to(w.defect, w.max_defect)
        return
    steps = 1.0 + w.counters[WAITED]
    G = np.zeros((o.target.size, 1)) if lengths is None else lengths[:, None]
    err = np.full(1, 0.0 if lengths is None else kn.norm(w.err))
    w.counters[FOUND] += kn.note(
        w.defect, w.max_defect, w.before, w.band, G, err, w.trust, o.per_band, t,
        0.0 if lengths is None else steps, EPS * steps**0.5,
    )  # fmt: skip
