"""``eip-scipy study import-time``: duration of imports, compared with `scipy.integrate` and Numba.

Each import runs in a fresh process. A round runs all of them in turn, so that a drifting speed of the machine affects
all. A time is the processor time minus that of an empty process in the same round. The first round, which writes the
bytecode, is not counted. The table has the median over the rounds of the time, and of its ratio to that of `import
scipy.integrate` in the same round.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from statistics import median

from ..report import table
from ..study import Measurement, Session, option

REFERENCE = "import scipy.integrate"
IMPORTS = (
    REFERENCE,
    "import numba, scipy.integrate",
    "import eip_scipy",
    "from eip_scipy import EIPRK4, Invariant",
    "from eip_scipy import integrate",
    "from eip_scipy.problems import kepler",
)


def seconds(code: str) -> float:
    """Return the processor time in seconds of a fresh process that runs `code`."""
    writing = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    before = os.times()
    subprocess.run([sys.executable, "-c", code], check=True, env=writing)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


@dataclass(frozen=True, kw_only=True)
class ImportTime(Measurement[dict[str, dict[str, float]]]):
    """Command ``eip-scipy study import-time``."""

    rounds: int = option(7, "rounds of fresh processes (default: %(default)s)", type=int, metavar="N")

    def measure(self, session: Session) -> dict[str, dict[str, float]]:
        times: dict[str, list[float]] = {code: [] for code in IMPORTS}
        with session.bar(self.rounds + 1, "import-time", "round") as bar:
            for turn in range(self.rounds + 1):
                empty = seconds("")
                for code, own in times.items():
                    taken = seconds(code) - empty
                    if turn:
                        own.append(taken)
                bar.update()
        ratios = {code: [t / s for t, s in zip(own, times[REFERENCE], strict=True)] for code, own in times.items()}
        return {code: {"seconds": median(own), "ratio": median(ratios[code])} for code, own in times.items()}

    def table(self, found: dict[str, dict[str, float]]) -> str:
        body = [(code, [f"{row['seconds']:.2f}", f"{row['ratio']:.2f}"]) for code, row in found.items()]
        return table([["seconds"], ["ratio"]], body)
