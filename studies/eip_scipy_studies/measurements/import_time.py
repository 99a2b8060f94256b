"""How long imports take: the package, and the names most runs begin with, beside `scipy.integrate` and Numba.

    python -m eip_scipy_studies.measurements.import_time [--rounds N] [--json FILE]

Each import in a fresh process, all in turn, so that a machine whose speed drifts does not decide; processor time less
that of an empty process in the same round. The first round is not counted: it writes the bytecode. The median over
the rounds, and that of the ratio to `import scipy.integrate` in the same round.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from statistics import median

from eip_scipy.core.versions import versions

from ..report import describe_machine

ROUNDS = 7
REFERENCE = "import scipy.integrate"
IMPORTS = (
    REFERENCE,
    "import numba, scipy.integrate",
    "import eip_scipy",
    "from eip_scipy import EIPRK4, Invariant",
    "from eip_scipy import integrate",
    "from eip_scipy.problems import kepler",
)


def seconds(code):
    """Processor time of a fresh process."""
    writing = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    before = os.times()
    subprocess.run([sys.executable, "-c", code], check=True, env=writing)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def measure(rounds):
    found = {code: [] for code in IMPORTS}
    for turn in range(rounds + 1):
        empty = seconds("")
        for code, times in found.items():
            taken = seconds(code) - empty
            if turn:
                times.append(taken)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=ROUNDS, metavar="N", help="of fresh processes (%(default)s)")
    parser.add_argument("--json", metavar="FILE", help="the numbers as JSON")
    args = parser.parse_args()
    found = measure(args.rounds)
    print(describe_machine())
    rows = []
    for code, times in found.items():
        ratio = median(t / s for t, s in zip(times, found[REFERENCE], strict=True))
        rows.append({"import": code, "seconds": median(times), "ratio": ratio})
        print(f"{code:<42} {median(times):5.2f} s {ratio:5.2f}")
    if args.json:
        with open(args.json, "w", encoding="utf-8") as out:
            json.dump({"machine": describe_machine(), "versions": versions(), "imports": rows}, out, indent=1)


if __name__ == "__main__":
    main()
