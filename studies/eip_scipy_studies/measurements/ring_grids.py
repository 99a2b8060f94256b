"""The paper's ring on several grids: what the grid's own error is, beside that of the steps.

    python -m eip_scipy_studies.measurements.ring_grids [--points N ...] [--t-end T] [--start FILE] [--csv FILE] [--quick]

All runs start from the ground state for kappa = 0.3 on the paper's 256 x 256 points, by its Fourier modes, in the trap
of kappa = 0.7. They are splittings of order 4 with both invariants kept, in the frame at rest; the last one is what
`eip-scipy gpe ring` does, RK4 in the rotating frame on 256 x 256 points. Error: the norm of the
difference from the finest grid's field, modes that a grid lacks included. Edge: the largest amplitude among the modes
with one of the three highest wavenumbers, as a part of the largest of all.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.signal import resample

from eip_scipy import EIPRK4, eip_method, integrate
from eip_scipy.problems import Splitting
from eip_scipy.problems.gross_pitaevskii import (
    at_rest,
    ground_state,
    ring_condensate,
    ring_start,
    rotated,
)

from ..condensates.ring import Ring
from ..condensates.runs import motion
from ..condensates.states import load_state
from ..report import describe_machine, table, write_csv

START_POINTS, TOLERANCE = 256, 1e-8  # of the ground state
SPLITTING_STEP = 1.25e-3
RING = Ring()


def ground(file, points, tol):
    gpe = ring_condensate(RING.kappas[0], points=points)
    return ground_state(gpe, ring_start(gpe, 38, 123), tol=tol).psi if file is None else load_state(file, gpe)


def on_grid(field, points):
    """The field on another number of points along each axis, by its Fourier modes."""
    return resample(resample(field, points, axis=0), points, axis=1)


def edge(field):
    amplitude = np.abs(np.fft.fft2(field))
    n = field.shape[0] // 2
    highest = amplitude[n - 1 : n + 2].max(), amplitude[:, n - 1 : n + 2].max()
    return float(max(highest) / amplitude.max())


class Run:
    """A run's fields at the snapshots in the frame at rest, and its vortices seen from the rotating one."""

    def __init__(self, psi, points, t_end, *, turning=False):
        gpe = ring_condensate(RING.kappas[1], points=points)
        problem = gpe.problem(on_grid(psi, points), t_end, RING.step if turning else SPLITTING_STEP)
        problem = problem if turning else at_rest(problem)
        method = EIPRK4 if turning else eip_method(Splitting(problem.equation))
        result = integrate(problem, method=method, save_every=round(RING.saved / problem.h), progress=True)
        self.label = f"{points} x {points}, {'turning, RK4' if turning else 'at rest, splitting'}"
        self.wall_time = result.wall_time
        # The phases of a field at rest are those of the turning one at turned points: vortices are found in either.
        moved = motion(gpe, result.t, result.y)
        self.times = [at for at in RING.snapshots if at <= t_end + 1e-9]
        at = [int(np.argmin(np.abs(result.t - t))) for t in self.times]
        self.counts = [len(moved.vortices[k].charges) for k in at]
        self.turned = [moved.angle[k] - (0.0 if turning else gpe.Omega * result.t[k]) for k in at]
        fields = [gpe.grid.field(result.y[:, k]) for k in at]
        angles = [-gpe.Omega * t if turning else 0.0 for t in self.times]
        self.fields = [
            rotated(gpe, field, angle) if angle else field for field, angle in zip(fields, angles, strict=True)
        ]

    def errors(self, fine):
        cell = ring_condensate(RING.kappas[1], points=fine.fields[0].shape[0]).grid.cell
        pairs = zip(self.fields, fine.fields, strict=True)
        return [float(np.sqrt(cell) * np.linalg.norm(on_grid(a, len(b)) - b)) for a, b in pairs]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[192, 256, 384, 512], help="the last is the finest")
    parser.add_argument("--t-end", type=float, default=1.0)
    parser.add_argument("--start", type=Path, help="ring.npz of `eip-scipy gpe ground-state`")
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--quick", action="store_true", help="a rough start on few points, two grids, a short interval")
    arguments = parser.parse_args()
    start, tolerance = START_POINTS, TOLERANCE
    if arguments.quick:
        start, tolerance, arguments.points, arguments.t_end = 64, 1e-2, [64, 96], RING.saved
    psi = ground(arguments.start, start, tolerance)
    runs = [Run(psi, points, arguments.t_end) for points in sorted(arguments.points)]
    fine = runs[-1]
    runs.append(Run(psi, start, arguments.t_end, turning=True))
    print(describe_machine())
    rows = [
        {"run": run.label, "t": t, "error": error, "edge": edge(field), "vortices": count, "turned": turned}
        for run in runs
        for t, error, field, count, turned in zip(
            run.times, run.errors(fine), run.fields, run.counts, run.turned, strict=True
        )
    ]
    for run in runs:
        body = [
            (f"t = {r['t']:.2f}", [f"{r['error']:.1e}", f"{r['edge']:.1e}", str(r["vortices"]), f"{r['turned']:+.3f}"])
            for r in rows
            if r["run"] == run.label
        ]
        head = [["error of psi"], ["edge"], ["vortices"], ["turned [rad]"]]
        print(f"\n{run.label}, {run.wall_time:.0f} s\n{table(head, body)}")
    if arguments.csv:
        print(f"\nwrote {write_csv(arguments.csv, rows)}")


if __name__ == "__main__":
    main()
