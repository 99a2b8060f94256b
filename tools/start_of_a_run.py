#!/usr/bin/env python3
"""Print what the start of a run costs: functions of the package that are entered before the first step, and time.

    python tools/start_of_a_run.py

For a user's jitted functions with two invariants, with and without a search for linear invariants, for kepler(), and
for a solver as SciPy's solve_ivp makes it. Times are the least of 300 starts, in milliseconds.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

import eip_scipy
from eip_scipy import EIPRK4, Invariant, integrate
from eip_scipy.problems import kepler
from eip_scipy.run.driver import Driver

FOLDER = str(Path(eip_scipy.__file__).parent)
Y0 = np.array([0.4, 0.0, 0.0, 2.0])
STEP = {"method": EIPRK4, "h": 0.03}
STARTS = 300


@njit
def fun(t, y):
    """Kepler's problem."""
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return np.array([y[2], y[3], -y[0] / r3, -y[1] / r3])


@njit
def energy(t, y):
    """Energy."""
    return 0.5 * (y[2] ** 2 + y[3] ** 2) - 1.0 / np.sqrt(y[0] ** 2 + y[1] ** 2)


@njit
def energy_gradient(t, y):
    """Gradient of the energy."""
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return np.array([y[0] / r3, y[1] / r3, y[2], y[3]])


@njit
def momentum(t, y):
    """Angular momentum."""
    return y[0] * y[3] - y[1] * y[2]


@njit
def momentum_gradient(t, y):
    """Gradient of the angular momentum."""
    return np.array([y[3], -y[2], -y[1], y[0]])


KEPT = [Invariant(energy, energy_gradient), Invariant(momentum, momentum_gradient)]
PROBLEM = kepler()
CASES: dict[str, Callable[[], Any]] = {
    "jitted functions": lambda: integrate(fun, (0, 0.03), Y0, invariants=KEPT, linear_invariants=None, **STEP),
    "jitted, with the search": lambda: integrate(fun, (0, 0.03), Y0, invariants=KEPT, **STEP),
    "kepler()": lambda: integrate(PROBLEM, (0, 0.03), **STEP),
    "a solver": lambda: EIPRK4(fun, 0.0, Y0, 0.03, h=0.03, invariants=KEPT),
}


def functions_entered(start: Callable[[], Any]) -> int:
    """Return the number of different functions of the package that are entered before the first step."""
    found: set[tuple[str, str, int]] = set()

    def note(frame: Any, event: str, argument: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(FOLDER):
            found.add((code.co_filename, code.co_name, code.co_firstlineno))
            if code is Driver.advance.__code__:
                sys.setprofile(None)

    sys.setprofile(note)
    try:
        start()
    finally:
        sys.setprofile(None)
    return len(found)


def seconds(start: Callable[[], Any]) -> float:
    """Return the time until the first step, or until a solver is made."""
    first: list[float] = []
    advance = Driver.advance

    def timed(self: Driver, k_end: int) -> int:
        first.append(time.perf_counter())
        return advance(self, k_end)

    Driver.advance = timed  # type: ignore[method-assign]
    try:
        begin = time.perf_counter()
        start()
        return (first or [time.perf_counter()])[0] - begin
    finally:
        Driver.advance = advance  # type: ignore[method-assign]


def main() -> None:
    """Print a line for each case."""
    print(f"{'':24}{'functions':>10}{'ms':>8}")
    for name, start in CASES.items():
        start()  # compiles
        least = min(seconds(start) for _ in range(STARTS))
        print(f"{name:24}{functions_entered(start):10}{1e3 * least:8.3f}")


if __name__ == "__main__":
    main()
