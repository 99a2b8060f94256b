"""``eip-scipy study overhead``: cost of an EIP class in solve_ivp compared with SciPy's own class, per step.

Kepler's problem in plain NumPy, e = 0.6, two invariants (H, L) with analytic gradients. Numbers are medians of pairs of
runs: each class runs in turn with SciPy's on the same right-hand side, so that a drifting speed of the machine affects
both. Next to the median of the ratios is the ratio of the least times, which other load on the machine hardly affects.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, EIPRK23, EIPRK45, Invariant

from ..report import table
from ..study import Measurement, Session, option

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
TOLERANCES: dict[str, float] = {"rtol": 1e-6, "atol": 1e-9}
STEPS = solve_ivp(fun, SPAN, Y0, **TOLERANCES).t.size - 1  # of RK45; the projection does not change their number
SAMPLES = np.linspace(*SPAN, 10 * STEPS)
CASES: dict[str, dict[str, Any]] = {
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


def per_step(options: dict[str, Any]) -> float:
    """Return the wall time in seconds per step of a run of `solve_ivp` with these options."""
    begin = time.perf_counter()
    solution = solve_ivp(fun, SPAN, Y0, **options)
    steps = STEPS if "t_eval" in options else solution.t.size - 1
    return (time.perf_counter() - begin) / steps


@dataclass(frozen=True, kw_only=True)
class Overhead(Measurement[dict[str, dict[str, Any]]]):
    """Command ``eip-scipy study overhead``."""

    pairs: int = option(15, "pairs of runs (default: %(default)s)", type=int, metavar="N")

    def measure(self, session: Session) -> dict[str, dict[str, Any]]:
        found = {}
        with session.bar(len(CASES), "overhead", "class") as bar:
            for name, options in CASES.items():
                peer: dict[str, Any] = {"method": PEERS[options["method"]], **TOLERANCES}
                if "t_eval" in options:
                    peer["t_eval"] = options["t_eval"]
                per_step(options), per_step(peer)
                pairs = np.array([(per_step(options), per_step(peer)) for _ in range(self.pairs)])
                ours, theirs = 1e6 * np.median(pairs, axis=0)
                found[name] = {
                    "us per step": ours,
                    "peer": peer["method"],
                    "peer's us per step": theirs,
                    "ratio": float(np.median(pairs[:, 0] / pairs[:, 1])),
                    "ratio of the least": float(np.divide(*pairs.min(axis=0))),
                }
                bar.update()
        return found

    def table(self, found: dict[str, dict[str, Any]]) -> str:
        forms = (".1f", "", ".1f", ".2f", ".2f")
        body = [
            (name, [f"{value:{form}}" for value, form in zip(row.values(), forms, strict=True)])
            for name, row in found.items()
        ]
        return table(
            [["us per", "step"], ["SciPy's", ""], ["us per", "step"], ["ratio", ""], ["of the", "least"]], body
        )
