"""``eip-scipy study written``: cost of a problem written as an expression, compared with functions written by hand.

Henon and Heiles' Hamiltonian to t = 10 000. The time of a fresh process includes the start of Python, imports, the
work of SymPy, Numba's compilation and the run. The compiled runs are measured in turn, and their least times compared.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, Invariant, hamiltonian, integrate

from ..report import needed, table
from ..study import Measurement, Session, option
from ..timing import clocked, least

njit = needed("numba", '"eip_scipy[numba]"').njit

H = "(px**2 + py**2 + x**2 + y**2)/2 + x**2*y - y**3/3"
SPAN, Y0 = (0.0, 1e4), [0.0, 0.1, 0.5, 0.0]
FRESH = (
    "from eip_scipy import EIPDOP853, hamiltonian, integrate\n"
    f"run = integrate(hamiltonian({H!r}), {SPAN}, {Y0}, method=EIPDOP853, rtol=1e-10)\n"
    "assert run.compiled and run.success"
)
PROCESSES, TURNS = 3, 10


@njit
def rhs(t, y, out):
    out[0], out[1] = y[2], y[3]
    out[2] = -y[0] - 2 * y[0] * y[1]
    out[3] = -y[1] - y[0] * y[0] + y[1] * y[1]


@njit
def energy(t, y):
    return (y[2] ** 2 + y[3] ** 2 + y[0] ** 2 + y[1] ** 2) / 2 + y[0] ** 2 * y[1] - y[1] ** 3 / 3


@njit
def gradient(t, y):
    return np.array([y[0] + 2 * y[0] * y[1], y[1] + y[0] * y[0] - y[1] * y[1], y[2], y[3]])


CASES: dict[str, dict[str, Any]] = {
    "EIPDOP853, rtol = 1e-10": {"method": EIPDOP853, "rtol": 1e-10, "atol": 1e-10},
    "EIPRK4, h = 0.02": {"method": EIPRK4, "h": 0.02},
}


@dataclass(frozen=True, kw_only=True)
class Written(Measurement[dict[str, Any]]):
    """Command ``eip-scipy study written``."""

    quick: bool = option(False, "measure everything only once")

    def measure(self, session: Session) -> dict[str, Any]:
        processes, turns = (1, 1) if self.quick else (PROCESSES, TURNS)
        fresh = clocked(lambda: subprocess.run([sys.executable, "-c", FRESH], check=True))
        found: dict[str, Any] = {"fresh process [s]": least({"": fresh}, turns=processes)[""]}
        problem, kept = hamiltonian(H), Invariant(energy, gradient, name="H")
        for name, options in CASES.items():
            runs = {
                "written": lambda o=options: integrate(problem, SPAN, Y0, **o).wall_time,
                "by hand": lambda o=options: integrate(rhs, SPAN, Y0, in_place=True, invariants=kept, **o).wall_time,
            }
            best = least(runs, turns=turns)
            found[name] = best | {"ratio": best["written"] / best["by hand"]}
        return found

    def table(self, found: dict[str, Any]) -> str:
        body = [
            (name, [f"{1e3 * row['written']:.1f}", f"{1e3 * row['by hand']:.1f}", f"{row['ratio']:.2f}"])
            for name, row in found.items()
            if name in CASES
        ]
        fresh = f"A fresh process, from Python's start to the end of the run: {found['fresh process [s]']:.2f} s"
        return f"{table([['written', '[ms]'], ['by hand', '[ms]'], ['ratio', '']], body)}\n\n{fresh}"
