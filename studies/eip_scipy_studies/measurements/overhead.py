"""What an EIP class costs in solve_ivp beside SciPy's own, per step on the same right-hand side.

    python -m eip_scipy_studies.measurements.overhead [--pairs 15] [--json FILE]

Kepler's problem in plain NumPy, e = .6, two invariants (H, L) with analytic gradients; medians of paired runs, each
class in turn with SciPy's, so that a machine whose speed drifts does not decide. Beside the median of the ratios stands
the ratio of the least times, which other load on the machine hardly touches.
"""

from __future__ import annotations

import argparse
import json
import math
import time

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, EIPRK23, EIPRK45, Invariant

SPAN = (0.0, 60.0)
Y0 = np.array([0.4, 0.0, 0.0, 2.0])


def fun(t, y):
    r = math.hypot(y[0], y[1])
    w = -1.0 / (r * r * r)
    return np.array([y[2], y[3], w * y[0], w * y[1]])


def energy(t, y):
    return 0.5 * (y[2] * y[2] + y[3] * y[3]) - 1.0 / math.hypot(y[0], y[1])


def energy_gradient(t, y):
    r = math.hypot(y[0], y[1])
    w = 1.0 / (r * r * r)
    return np.array([w * y[0], w * y[1], y[2], y[3]])


def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


def momentum_gradient(t, y):
    return np.array([y[3], -y[2], -y[1], y[0]])


BOTH = [Invariant(energy, energy_gradient, name="H"), Invariant(momentum, momentum_gradient, name="L")]
TOLERANCES = {"rtol": 1e-6, "atol": 1e-9}
STEPS = solve_ivp(fun, SPAN, Y0, **TOLERANCES).t.size - 1  # with RK45; the projection does not change their number
SAMPLES = np.linspace(*SPAN, 10 * STEPS)
CASES = {
    "EIPRK4, h = .03, H and L": {"method": EIPRK4, "h": 0.03, "invariants": BOTH},
    "EIPRK23, H and L": {"method": EIPRK23, "invariants": BOTH, **TOLERANCES},
    "EIPRK45, H and L": {"method": EIPRK45, "invariants": BOTH, **TOLERANCES},
    "EIPDOP853, H and L": {"method": EIPDOP853, "invariants": BOTH, **TOLERANCES},
    "EIPRK45, H and L, every 10th step": {"method": EIPRK45, "invariants": BOTH, "every": 10, **TOLERANCES},
    "EIPRK45, H and L, 10 samples a step": {"method": EIPRK45, "invariants": BOTH, "t_eval": SAMPLES, **TOLERANCES},
    "EIPRK23, no invariants": {"method": EIPRK23, **TOLERANCES},
    "EIPRK45, no invariants": {"method": EIPRK45, **TOLERANCES},
    "EIPDOP853, no invariants": {"method": EIPDOP853, **TOLERANCES},
    "EIPRK4, h = .03, no invariants": {"method": EIPRK4, "h": 0.03},
}
PEERS = {EIPRK4: "RK45", EIPRK45: "RK45", EIPRK23: "RK23", EIPDOP853: "DOP853"}


def per_step(options) -> float:
    begin = time.perf_counter()
    solution = solve_ivp(fun, SPAN, Y0, **options)
    steps = STEPS if "t_eval" in options else solution.t.size - 1
    return (time.perf_counter() - begin) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=15, metavar="N", help="of runs (%(default)s)")
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    results = {}
    for name, options in CASES.items():
        peer = {"method": PEERS[options["method"]], **TOLERANCES}
        if "t_eval" in options:
            peer["t_eval"] = options["t_eval"]
        per_step(options), per_step(peer)
        pairs = np.array([(per_step(options), per_step(peer)) for _ in range(arguments.pairs)])
        ours, theirs = np.median(pairs, axis=0)
        ratio, least = float(np.median(pairs[:, 0] / pairs[:, 1])), float(np.divide(*pairs.min(axis=0)))
        results[name] = {
            "us per step": 1e6 * ours,
            f"{peer['method']} us per step": 1e6 * theirs,
            "ratio": ratio,
            "ratio of the least": least,
        }
        print(
            f"{name:36} {1e6 * ours:7.1f} us   SciPy's {peer['method']:7}{1e6 * theirs:7.1f} us   ratio {ratio:5.2f}"
            f", of the least {least:5.2f}"
        )
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main()
