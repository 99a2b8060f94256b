"""Work and precision of base methods on the paper's ring: RK4 and splittings, projected and not.

    python -m eip_scipy_studies.measurements.gpe_methods [--points N] [--t-end T] [--only NAME ...] [--repeats N] [--csv FILE]

The ring's ground state for kappa = 0.3, one row of 38 vortices around a winding of 123, in the trap of kappa = 0.7.
Errors at the end: that of the field is the norm of its difference from EIPDOP853 with h = 2.5e-4 on the same grid in
the same frame, which shares no part of its step with the others but the right-hand side. It is the error of the steps
alone: the grid's own is larger, and another one in the frame at rest. Times are processor seconds, the least of
several, all points in turn.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, eip_method, integrate
from eip_scipy.problems import Splitting
from eip_scipy.problems.gross_pitaevskii import at_rest, ground_state, ring_condensate, ring_start, rotated

from ..report import table, write_csv
from ..work_precision import cost_to_reach, work_precision

KEPT = ("mass", "energy")
LEVELS = (1e-5, 1e-6, 1e-7)
REFERENCE_STEP = 2.5e-4
RK_STEPS = (2.8e-4, 2e-4, 1.4e-4, 1e-4)
STRANG_STEPS = (1.25e-3, 6.25e-4, 3.125e-4)
SPLITTING_STEPS = (2.5e-3, 2e-3, 1.6e-3, 1.25e-3, 1e-3)


def start_of_the_ring(points):
    gpe = ring_condensate(0.3, points=points)
    state = ground_state(gpe, ring_start(gpe, 38, 123), tol=1e-6)
    print(f"start: E = {state.energy:.6f}, residual {state.residual:.1e}")
    return state.psi


def grid_error(gpe, turning, resting):
    """Norm of the difference of the two frames' solutions, which is the grid's doing."""
    angle = gpe.Omega * turning[0].t_span[1]
    return float(np.sqrt(gpe.mass(rotated(gpe, resting[1], angle).ravel() - turning[1])))


def runners(psi, t_end, points=256):
    """Of each method (run, steps), where ``run(h) -> (seconds, y)``; the defects by (method, h); and the error.

    The states are the differences from the reference of their frame.
    """
    gpe = ring_condensate(0.7, points=points)
    problem = gpe.problem(psi, t_end)
    frames = []
    for scene in (problem, at_rest(problem)):
        run = integrate(scene, method=EIPDOP853, h=REFERENCE_STEP)
        frames.append((scene, run.y[:, -1]))
    turning, resting = frames
    print(f"the grid's part: the frames differ by {grid_error(gpe, turning, resting):.1e} at t = {t_end:g}")
    made: dict = {}
    defects = {}

    def add(name, frame, method, steps, kept=()):
        scene, reference = frame

        def run(h):
            begin = time.process_time()
            result = integrate(scene, method=method, h=h, invariants=scene.equation.invariants(kept))
            seconds = time.process_time() - begin
            y = result.y[:, -1]
            defects[name, h] = tuple(abs(f(y) - f(psi)) for f in (scene.equation.mass, scene.equation.energy))
            return seconds, y - reference

        made[name] = (run, steps)

    for label, kept in (("", ()), ("-EIP", KEPT)):
        add(f"RK4{label}", turning, EIPRK4, RK_STEPS, kept)
        for scheme, steps in (("strang", STRANG_STEPS), ("s6", SPLITTING_STEPS), ("rkn6", SPLITTING_STEPS)):
            add(f"{scheme}{label}", turning, eip_method(Splitting(gpe, scheme)), steps, kept)
            rest = eip_method(Splitting(resting[0].equation, scheme))
            add(f"{scheme}{label}, at rest", resting, rest, steps, kept)
    return made, defects, lambda difference: float(np.sqrt(gpe.mass(difference)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--t-end", type=float, default=0.2)
    parser.add_argument("--points", type=int, default=256, help="of the grid along each axis")
    parser.add_argument("--only", metavar="NAME", nargs="+", help="methods, by the names of the table")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--csv", metavar="FILE")
    arguments = parser.parse_args()
    made, defects, error = runners(start_of_the_ring(arguments.points), arguments.t_end, arguments.points)
    made = {name: made[name] for name in arguments.only or made}
    result = work_precision(made, error, repeats=arguments.repeats, enough_seconds=5.0)
    print(result.machine)
    rows, body = [], []
    for point in result.points:
        mass, energy = defects[point.method, point.step]
        per_time = point.wall_time / arguments.t_end
        body.append(
            (
                point.method,
                [f"{point.step:.3g}", f"{point.error:.2e}", f"{per_time:.2f}", f"{mass:.1e}", f"{energy:.1e}"],
            )
        )
        rows.append({**point._asdict(), "mass_error": mass, "energy_error": energy})
    print(table([["h"], ["error of psi"], ["s per unit", "of time"], ["mass"], ["energy"]], body))
    body = []
    for name in made:
        points = [point for point in result.points if point.method == name]
        costs = [cost_to_reach([p.wall_time for p in points], [p.error for p in points], level) for level in LEVELS]
        body.append((name, [f"{cost / arguments.t_end:.2f}" for cost in costs]))
    print("\nProcessor seconds per unit of time to reach an error\n")
    print(table([[f"{level:.0e}"] for level in LEVELS], body))
    if arguments.csv:
        write_csv(Path(arguments.csv), rows)


if __name__ == "__main__":
    main()
