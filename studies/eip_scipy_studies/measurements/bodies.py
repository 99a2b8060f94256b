"""Growth of the cost with the number of bodies: EIPRKN12 and REBOUND's IAS15 on N = 10, 30, 100, 300.

    python -m eip_scipy_studies.measurements.bodies [--periods 20] [--bodies 10 30 100 300]

A star with N - 1 light planets (G m = 1e-9 of the star's) on nearly circular, nearly coplanar orbits of semi-major axes
from 1 to 30, random phases. EIPRKN12 with 25 steps in the innermost period, every = 10, compensated; IAS15 with its
own steps. Wall times per innermost period, least of three, one core; the energy's relative error, and the largest
distance between the two final states as a measure of agreement.
"""

from __future__ import annotations

import argparse

import numpy as np

from eip_scipy import EIPRKN12, integrate
from eip_scipy.problems import Problem, nbody

from ..report import describe_machine
from .installed import peer

rebound = peer("eip_scipy.integrations.rebound")

REPEATS = 3
PERIOD = 2 * np.pi
STEPS = 25


def system(bodies: int, periods: float) -> Problem:
    rng = np.random.default_rng(bodies)
    a = np.geomspace(1.0, 30.0, bodies - 1)
    phase, tilt = rng.uniform(0, 2 * np.pi, a.size), rng.normal(0, 0.01, a.size)
    flat = np.array([np.cos(phase), np.sin(phase) * np.cos(tilt), np.sin(phase) * np.sin(tilt)]).T
    along = np.array([-np.sin(phase), np.cos(phase) * np.cos(tilt), np.cos(phase) * np.sin(tilt)]).T
    gm = np.concatenate([[1.0], np.full(a.size, 1e-9)])
    q = np.concatenate([np.zeros((1, 3)), a[:, None] * flat])
    v = np.concatenate([np.zeros((1, 3)), along / np.sqrt(a)[:, None]])
    share = gm / gm.sum()
    return nbody(gm, q - share @ q, v - share @ v, t_span=(0.0, periods * PERIOD), h=PERIOD / STEPS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--periods", type=int, default=20)
    parser.add_argument("--bodies", type=int, nargs="+", default=[10, 30, 100, 300])
    args = parser.parse_args()
    print(f"{describe_machine()}; milliseconds per innermost period")
    print(f"{'N':>5}{'EIPRKN12':>12}{'IAS15':>12}{'ratio':>8}{'dH/H':>10}{'IAS15 dE/E':>12}{'distance':>10}")
    for bodies in args.bodies:
        problem = system(bodies, args.periods)
        own = [integrate(problem, method=EIPRKN12, every=10, compensated=True) for _ in range(REPEATS)]
        peers = [
            rebound.run(problem.params, problem.y0, "ias15", h=problem.t_span[1], n_steps=1) for _ in range(REPEATS)
        ]
        seconds, theirs = (min(run.wall_time for run in runs) for runs in (own, peers))
        energy = [problem.invariants[0].fun(0.0, y, problem.params) for y in (problem.y0, own[0].y[:, -1])]
        distance = np.linalg.norm((own[0].y[:, -1] - peers[0].y[:, -1])[: 3 * bodies].reshape(-1, 3), axis=1).max()
        print(
            f"{bodies:5}{1e3 * seconds / args.periods:12.3f}{1e3 * theirs / args.periods:12.3f}{theirs / seconds:8.1f}"
            f"{abs(energy[1] / energy[0] - 1):10.1e}{peers[0].energy_error[-1]:12.1e}{distance:10.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
