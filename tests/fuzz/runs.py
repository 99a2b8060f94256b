"""The runs that are killed, and the process that runs them."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, EIPRKN12, Invariant, ensemble, integrate

from . import families

OFTEN = 0.02
ORBIT = families.kepler(np.random.default_rng(5))
KEPT = [Invariant(k.fun, k.grad, name=k.name) for k in ORBIT.kept]
STARTS = ORBIT.y0 * np.linspace(0.95, 1.05, 30)[:, None]


def crossing(t: float, y: np.ndarray) -> float:
    """An event."""
    return y[1]


def ending(t: float, y: np.ndarray) -> float:
    """An event that ends a member."""
    return y[0] - 1e3


ending.terminal = True  # type: ignore[attr-defined]


def highest(run: Any) -> Any:
    """Reduce a member."""
    return run.y.max(axis=1)


def fixed(**options: Any) -> Any:
    """Run fixed steps with many saved states."""
    given = {"method": EIPRK4, "h": 0.01, "every": "auto", "invariants": KEPT, "save_every": 5}
    return integrate(ORBIT.fun, (0, 60), ORBIT.y0, **given | options)


def adaptive(**options: Any) -> Any:
    """Run adaptive steps with events and samples."""
    given = {"method": EIPDOP853, "rtol": 1e-8, "invariants": KEPT, "events": crossing}
    return integrate(ORBIT.fun, (0, 120), ORBIT.y0, t_eval=np.arange(0, 120, 0.5), **given | options)


def nystrom(**options: Any) -> Any:
    """Run compensated steps that are projected now and then."""
    given = {"method": EIPRKN12, "h": 0.05, "every": 7, "compensated": True, "invariants": KEPT, "save_every": 10}
    return integrate(acceleration=ORBIT.acc, t_span=(0, 200), y0=ORBIT.y0, **given | options)


def members(**options: Any) -> Any:
    """Run an ensemble, a few members at a time."""
    given = {"method": EIPRK4, "h": 0.02, "invariants": KEPT, "chunk": 2, "save_every": 20, "reduce": highest}
    return ensemble(ORBIT.fun, (0, 3), STARTS, **given | options)


def trajectories(**options: Any) -> Any:
    """Run an ensemble with adaptive steps, events and saved states."""
    given = {"method": EIPRK4, "rtol": 1e-6, "invariants": KEPT, "chunk": 2, "events": ending}
    return ensemble(ORBIT.fun, (0, 3), STARTS, t_eval=[0.0, 1.0, 2.5], **given | options)


SINGLE = {run.__name__: run for run in (fixed, adaptive, nystrom)}
KINDS: dict[str, Callable[..., Any]] = SINGLE | {run.__name__: run for run in (members, trajectories)}


def kept_in(kind: str, path: Path) -> dict[str, Any]:
    """Return the options that keep a run of that kind in `path`."""
    return {"checkpoint": path, "checkpoint_every": OFTEN, "resume": True, "compiled": False}


def work(kind: str, path: Path) -> None:
    """Run the process that is killed."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # Ctrl-C prints where it came
    KINDS[kind](**kept_in(kind, path))


@cache
def whole(kind: str) -> Any:
    """Return the run without kills."""
    return KINDS[kind](compiled=False)
