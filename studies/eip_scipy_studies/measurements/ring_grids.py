"""``eip-scipy study ring-grids``: the paper's ring on several grids, errors of the grid and of the steps.

All runs start from the ground state for kappa = 0.3 on the paper's 256 x 256 points, by its Fourier modes, in the trap
of kappa = 0.7. They are splittings of order 4 with both invariants kept, in the frame at rest; the last one is what
`eip-scipy gpe ring` does, RK4 in the rotating frame on 256 x 256 points. Error: the norm of the difference from the
finest grid's field, with modes that a grid lacks counted as 0. Edge: the largest amplitude among the modes with one of
the three highest wavenumbers, divided by the largest of all amplitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import resample

from eip_scipy import EIPRK4, eip_method, integrate
from eip_scipy.problems import Splitting
from eip_scipy.problems.gross_pitaevskii import at_rest, ground_state, ring_condensate, ring_start, rotated

from ..condensates.ring import Ring
from ..condensates.runs import motion
from ..condensates.states import load_state
from ..report import table
from ..study import Measurement, Rows, Session, option

START_POINTS, TOLERANCE = 256, 1e-8  # of the ground state
SPLITTING_STEP = 1.25e-3
RING = Ring()


def ground(file, points, tol):
    gpe = ring_condensate(RING.kappas[0], points=points)
    return ground_state(gpe, ring_start(gpe, 38, 123), tol=tol).psi if file is None else load_state(file, gpe)


def on_grid(field, points):
    """Return the square `field` on `points` points along each axis, by its Fourier modes."""
    return resample(resample(field, points, axis=0), points, axis=1)


def edge(field):
    amplitude = np.abs(np.fft.fft2(field))
    n = field.shape[0] // 2
    highest = amplitude[n - 1 : n + 2].max(), amplitude[:, n - 1 : n + 2].max()
    return float(max(highest) / amplitude.max())


class GridRun:
    """A run on `points` x `points` points, by RK4 in the rotating frame if `turning`, otherwise by splitting at rest.

    The run starts from the square field `psi`, which may have another number of points. `shown` is the option
    `progress` of `integrate`.

    Attributes for each snapshot are the field in the frame at rest, the number of vortices (`counts`), and the angle in
    rad by which the vortices have turned in the rotating frame (`turned`).
    """

    def __init__(self, psi, points, t_end, *, shown, turning=False):
        gpe = ring_condensate(RING.kappas[1], points=points)
        problem = gpe.problem(on_grid(psi, points), t_end, RING.step if turning else SPLITTING_STEP)
        problem = problem if turning else at_rest(problem)
        assert problem.equation is not None
        assert problem.h is not None
        method = EIPRK4 if turning else eip_method(Splitting(problem.equation))
        result = integrate(problem, method=method, save_every=round(RING.saved / problem.h), progress=shown)
        self.label = f"{points} x {points}, {'turning, RK4' if turning else 'at rest, splitting'}"
        self.wall_time = result.wall_time
        # The phases of a field at rest are those of the rotating one at rotated points: vortices are found in either.
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


@dataclass(frozen=True, kw_only=True)
class RingGrids(Measurement[list[dict[str, Any]]]):
    """Command ``eip-scipy study ring-grids``."""

    writes_files = True
    points: Sequence[int] = option((192, 256, 384, 512), "points along each axis of the grids", type=int, nargs="+")
    t_end: float = option(1.0, "end of the runs (default: %(default)s)", type=float)
    start: Path | None = option(
        None, "ring.npz that `eip-scipy gpe ground-state` has written", type=Path, metavar="FILE"
    )
    quick: bool = option(False, "a trial: a rough start on few points, two grids, a short interval")

    def measure(self, session: Session) -> list[dict[str, Any]]:
        start, tolerance, points, t_end = START_POINTS, TOLERANCE, self.points, self.t_end
        if self.quick:
            start, tolerance, points, t_end = 64, 1e-2, (64, 96), RING.saved
        psi = ground(self.start, start, tolerance)
        runs = [GridRun(psi, count, t_end, shown=session.shown) for count in sorted(points)]
        fine = runs[-1]
        runs.append(GridRun(psi, start, t_end, shown=session.shown, turning=True))
        return [
            {"run": run.label, "seconds": run.wall_time, "t": t, "error": error, "edge": edge(field),
             "vortices": count, "turned": turned}
            for run in runs
            for t, error, field, count, turned in zip(
                run.times, run.errors(fine), run.fields, run.counts, run.turned, strict=True
            )
        ]  # fmt: skip

    def table(self, found: list[dict[str, Any]]) -> str:
        parts = []
        for label in dict.fromkeys(row["run"] for row in found):
            own = [row for row in found if row["run"] == label]
            body = [
                (
                    f"t = {r['t']:.2f}",
                    [f"{r['error']:.1e}", f"{r['edge']:.1e}", str(r["vortices"]), f"{r['turned']:+.3f}"],
                )
                for r in own
            ]
            head = [["error of psi"], ["edge"], ["vortices"], ["turned [rad]"]]
            parts.append(f"{label}, {own[0]['seconds']:.0f} s\n{table(head, body)}")
        return "\n\n".join(parts)

    def tables(self, found: list[dict[str, Any]]) -> dict[str, Rows]:
        return {"ring-grids.csv": found}
