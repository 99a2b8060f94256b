"""heyoka as a reference: its Taylor integrator in double precision, for states in the form of `nbody`.

heyoka (F. Biscani, D. Izzo, MNRAS 504 (2021) 2614-2628) is free software under the MPL and not distributed with this
package.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from time import perf_counter
from typing import Any

import numpy as np

try:
    heyoka: Any = import_module("heyoka")
except ModuleNotFoundError as error:
    raise ImportError(
        'the comparison with heyoka needs heyoka: pip install "eip_scipy[heyoka]"', name="heyoka"
    ) from error

__all__ = ["HeyokaRun", "run"]


@dataclass(frozen=True)
class HeyokaRun:
    """Result of `run`.

    Attributes
    ----------
    version : str
        heyoka's version.
    t : float
        The end.
    y : ndarray, shape (6 N,)
        The state (q, v) at the end.
    wall_time : float
        Seconds spent in the integration, without making and compiling the integrator.
    steps : int
        Number of steps.
    """

    version: str
    t: float
    y: np.ndarray
    wall_time: float
    steps: int


def run(gm: Any, y0: Any, *, t_end: float, tolerance: float | None = None) -> HeyokaRun:
    """Integrate N bodies under their mutual gravity from t = 0 to `t_end` by heyoka's Taylor integrator.

    Parameters
    ----------
    gm : array_like, shape (N,)
        G times the masses.
    y0 : array_like, shape (6 N,)
        Initial state (q, v).
    t_end : float
    tolerance : float, optional
        Tolerance of heyoka; default: the spacing of floating-point numbers at 1.

    Returns
    -------
    HeyokaRun

    Raises
    ------
    ValueError
        If shapes disagree, `t_end` or the tolerance is not a positive number, or the integration does not reach the
        end.
    """
    gm, y0 = np.array(gm, dtype=float), np.array(y0, dtype=float)
    if gm.ndim != 1 or y0.shape != (6 * gm.size,):
        raise ValueError(f"gm has shape {gm.shape} and the state {y0.shape}; expected (N,) and (6 N,)")
    if not (t_end > 0 and (tolerance is None or tolerance > 0)):
        raise ValueError(f"t_end and the tolerance must be positive, got {t_end!r} and {tolerance!r}")
    equations = heyoka.model.nbody(gm.size, masses=gm.tolist(), Gconst=1.0)
    by_body = y0.reshape(2, -1, 3).swapaxes(0, 1).ravel()
    options = {} if tolerance is None else {"tol": float(tolerance)}
    integrator = heyoka.taylor_adaptive(equations, by_body, **options)
    start = perf_counter()
    outcome, *_, steps = integrator.propagate_until(float(t_end))[:4]
    wall_time = perf_counter() - start
    if outcome != heyoka.taylor_outcome.time_limit:
        raise ValueError(f"heyoka stopped at t = {integrator.time:g}, before the end: {outcome}")
    y = integrator.state.reshape(-1, 2, 3).swapaxes(0, 1).ravel()
    return HeyokaRun(heyoka.__version__, float(t_end), y, wall_time, int(steps))
