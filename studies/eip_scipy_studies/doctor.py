"""``eip-scipy doctor``: a list of what is installed, and short trials that show whether it computes correctly."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from contextlib import redirect_stdout
from time import perf_counter
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, EIPRKN12, ensemble, integrate, show_config
from eip_scipy.problems import kepler, solar_system

from .output import Output
from .report import compact, describe_machine, table, warn

RESIDUAL, DISTANCE, PLANETS = 1e-13, 1e-11, 1e-7


class Trial(NamedTuple):
    """Result of a trial: its subject, the error that was found, the largest acceptable one, and the seconds it took."""

    name: str
    found: float
    bound: float
    seconds: float

    @property
    def passed(self) -> bool:
        return bool(self.found <= self.bound)

    def cells(self) -> tuple[str, ...]:
        verdict = "ok" if self.passed else "FAILED"
        return compact(self.found), compact(self.bound), f"{self.seconds:.2f}", verdict


def _timed(name: str, bound: float, measure: Callable[[], float]) -> Trial:
    begin = perf_counter()
    try:
        found = measure()
    except Exception as error:  # the command looks for parts that fail, whatever the error
        warn(f"{name}: {type(error).__name__}: {error}")
        found = math.nan
    return Trial(name, found, bound, perf_counter() - begin)


def _residuals() -> float:
    """Return the largest change of energy or angular momentum in a run, computed by their formulas."""
    problem = kepler(relativistic=0.0)
    run = solve_ivp(problem.fun, (0, 20), problem.y0, method=EIPRK4, h=0.02, invariants=problem.invariants)
    x, y, vx, vy = run.y
    values = (vx**2 + vy**2) / 2 - 1 / np.hypot(x, y), x * vy - y * vx
    return max(float(np.abs(value - value[0]).max()) for value in values)


def _bits() -> float:
    """Return the largest difference between final states by Python functions and by native ones, which must be 0."""
    problem = kepler()
    runs = problem.solve_ivp((0, 20), method=EIPRK4, h=0.02), integrate(problem, (0, 20), method=EIPRK4, h=0.02)
    return float(np.abs(runs[0].y[:, -1] - runs[1].y[:, -1]).max())


def _orbit() -> float:
    problem = kepler(relativistic=0.0)
    assert problem.reference is not None
    run = integrate(problem, (0, 20), method=EIPRKN12, h=0.1)
    return float(np.abs(run.y[:, -1] - problem.reference(run.t[-1])).max())


def _planets() -> float:
    """Integrate a year of the solar system by two methods; return the largest difference of positions, in AU."""
    problem = solar_system()
    runs = [integrate(problem, (0, 1), method=method, h=1 / n) for method, n in ((EIPRKN12, 64), (EIPRK4, 2000))]
    half = problem.y0.size // 2
    return float(np.abs(runs[0].y[:half, -1] - runs[1].y[:half, -1]).max())


def _members() -> float:
    """Return the largest difference between members of an ensemble and single runs, which must be 0."""
    problem = kepler()
    starts = problem.y0 * np.linspace(0.9, 1.1, 16)[:, None]
    together = ensemble(problem, (0, 5), starts, method=EIPRK4, h=0.05, progress=False)
    alone = [integrate(problem, (0, 5), start, method=EIPRK4, h=0.05).y[:, -1] for start in starts]
    return float(np.abs(together.y - alone).max())


CHECKS = (
    ("solve_ivp keeps H and L", RESIDUAL, _residuals),
    ("Python and native functions: the same bits", 0.0, _bits),
    ("Kepler's orbit: the closed form", DISTANCE, _orbit),
    ("a year of the planets by two methods, AU", PLANETS, _planets),
    ("members of an ensemble: the bits of single runs", 0.0, _members),
)


def doctor(out: Output) -> None:
    """List what is installed, and test in seconds whether it works."""
    installation = io.StringIO()
    with redirect_stdout(installation):
        show_config()
    out.text(f"{installation.getvalue().rstrip()}\n\nmachine: {describe_machine()}\n")
    trials = [_timed(*trial) for trial in CHECKS]
    out.text(table((("found",), ("at most",), ("s",), ("",)), [(trial.name, trial.cells()) for trial in trials]))
    out.passed = all(trial.passed for trial in trials)
    out.numbers |= {
        "installation": show_config("dicts"),
        "checks": [{**trial._asdict(), "passed": trial.passed} for trial in trials],
    }
    if failed := [trial.name for trial in trials if not trial.passed]:
        names = ", ".join(failed)
        warn(f"failed: {names}. This installation computes wrong results; reinstall eip_scipy and its dependencies.")
