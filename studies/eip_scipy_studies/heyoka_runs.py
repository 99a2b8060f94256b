"""heyoka as a reference: its Taylor integrator in double precision, for states in the form of `nbody`.

heyoka (F. Biscani, D. Izzo, MNRAS 504 (2021) 2614-2628) is free software under the MPL and not distributed with this
package.
"""

from __future__ import annotations

from importlib import import_module
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

try:
    heyoka: Any = import_module("heyoka")
except ModuleNotFoundError as error:
    raise ImportError(
        'the comparison with heyoka needs heyoka: pip install "eip_scipy[heyoka]"', name="heyoka"
    ) from error

__all__ = ["HeyokaRun", "run"]


class HeyokaRun(NamedTuple):
    """Result of `run`: heyoka's version, the state (q, v) (6 N,) at the end, seconds without compilation, and steps."""

    version: str
    y: np.ndarray
    wall_time: float
    steps: int


def run(gm: Any, y0: Any, *, t_end: float, tolerance: float | None = None) -> HeyokaRun:
    """Integrate N bodies under their mutual gravity from t = 0 to `t_end` by heyoka's Taylor integrator.

    `gm` (N,) is G times the masses, and `y0` (6 N,) the state (q, v). The default of `tolerance` is heyoka's: the
    spacing of floating-point numbers at 1. A ValueError is raised if the integration does not reach the end.
    """
    gm, y0 = np.array(gm, dtype=float), np.array(y0, dtype=float)
    equations = heyoka.model.nbody(gm.size, masses=gm.tolist(), Gconst=1.0)
    options = {} if tolerance is None else {"tol": float(tolerance)}
    integrator = heyoka.taylor_adaptive(equations, y0.reshape(2, -1, 3).swapaxes(0, 1).ravel(), **options)
    start = perf_counter()
    outcome, *_, steps = integrator.propagate_until(float(t_end))[:4]
    wall_time = perf_counter() - start
    if outcome != heyoka.taylor_outcome.time_limit:
        raise ValueError(f"heyoka stopped at t = {integrator.time:g}, before the end: {outcome}")
    y = integrator.state.reshape(-1, 2, 3).swapaxes(0, 1).ravel()
    return HeyokaRun(heyoka.__version__, y, wall_time, int(steps))
