"""What a problem written as an expression costs: a fresh process, and the run beside functions written by hand.

    python -m eip_scipy_studies.measurements.written [--quick] [--json FILE]

Henon and Heiles' Hamiltonian to t = 10 000. The fresh process counts all from the start of Python: imports, the use of
SymPy, Numba's compilation, the run. The compiled runs are measured in turn, and the least times compared.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, Invariant, hamiltonian, integrate

from .installed import peer

njit = peer("numba", '"eip_scipy[numba]"').njit

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="each once")
    parser.add_argument("--json", help="write the numbers to this file")
    arguments = parser.parse_args()
    processes, turns = (1, 1) if arguments.quick else (PROCESSES, TURNS)
    fresh = []
    for _ in range(processes):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", FRESH], check=True)
        fresh.append(time.perf_counter() - start)
    rows = {"fresh process [s]": min(fresh)}
    print(f"fresh process, from Python's start to the end of the run: {min(fresh):.2f} s (least of {len(fresh)})")
    problem = hamiltonian(H)
    by_hand = {"in_place": True, "invariants": Invariant(energy, gradient, name="H")}
    cases = {
        "EIPDOP853, rtol = 1e-10": {"method": EIPDOP853, "rtol": 1e-10, "atol": 1e-10},
        "EIPRK4, h = .02": {"method": EIPRK4, "h": 0.02},
    }
    for name, options in cases.items():
        times: dict[str, list[float]] = {"written": [], "by hand": []}
        for _ in range(turns):
            times["written"].append(integrate(problem, SPAN, Y0, **options).wall_time)
            times["by hand"].append(integrate(rhs, SPAN, Y0, **by_hand, **options).wall_time)
        least = {key: min(values) for key, values in times.items()}
        rows[name] = least | {"ratio": least["written"] / least["by hand"]}
        print(f"{name}: written {least['written'] * 1e3:.1f} ms, by hand {least['by hand'] * 1e3:.1f} ms: "
              f"ratio {rows[name]['ratio']:.2f}")  # fmt: skip
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
