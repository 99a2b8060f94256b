"""``eip-scipy study gpe-methods``: error against cost of base methods on the paper's ring, projected and not.

RK4 and splittings. The start is the ring's ground state for kappa = 0.3, one row of 38 vortices around a winding of
123, in the trap of kappa = 0.7. Errors at the end: that of the field is the norm of its difference from EIPDOP853 with
h = 2.5e-4 on the same grid in the same frame, which shares only the right-hand side with the others. It is the error of
the steps alone: the error of the grid is larger, and differs in the frame at rest. Times are processor seconds, the
least of several, all points in turn.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, eip_method, integrate
from eip_scipy.problems import Splitting
from eip_scipy.problems.gross_pitaevskii import at_rest, ground_state, ring_condensate, ring_start, rotated

from ..report import table
from ..study import Measurement, Rows, Session, option
from ..work_precision import WorkPoint, cost_to_reach, curves, work_precision

KEPT = ("mass", "energy")
LEVELS = (1e-5, 1e-6, 1e-7)
REFERENCE_STEP = 2.5e-4
RK_STEPS = (2.8e-4, 2e-4, 1.4e-4, 1e-4)
STRANG_STEPS = (1.25e-3, 6.25e-4, 3.125e-4)
SPLITTING_STEPS = (2.5e-3, 2e-3, 1.6e-3, 1.25e-3, 1e-3)


def grid_error(gpe, turning, resting):
    """Return the norm of the difference between the final fields in the rotating frame and in the frame at rest.

    `turning` and `resting` are pairs (problem, final state). The difference is caused by the grid.
    """
    angle = gpe.Omega * turning[0].t_span[1]
    return float(np.sqrt(gpe.mass(rotated(gpe, resting[1], angle).ravel() - turning[1])))


def runners(psi, t_end, points):
    """Return the methods to run from the field `psi` to the time `t_end`, and what is needed to judge the runs.

    The grid has `points` points along each axis. The four results are a dict of (run, steps) by method; a dict of
    (change of mass, change of energy) by (method, h), which the runs fill in; the result of `grid_error`; and a
    function that returns the norm of a field. ``run(h) -> (seconds, y)``, where y is the difference of the final state
    from the reference in the same frame.
    """
    gpe = ring_condensate(0.7, points=points)
    problem = gpe.problem(psi, t_end)
    frames = []
    for scene in (problem, at_rest(problem)):
        run = integrate(scene, method=EIPDOP853, h=REFERENCE_STEP)
        frames.append((scene, run.y[:, -1]))
    turning, resting = frames
    at_rest_equation = resting[0].equation
    assert at_rest_equation is not None
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
            rest = eip_method(Splitting(at_rest_equation, scheme))
            add(f"{scheme}{label}, at rest", resting, rest, steps, kept)
    apart = grid_error(gpe, turning, resting)
    return made, defects, apart, lambda difference: float(np.sqrt(gpe.mass(difference)))


class Found(NamedTuple):
    """Results of all methods and steps, changes of (mass, energy) by (method, h), and the result of `grid_error`."""

    points: tuple[WorkPoint, ...]
    defects: dict[tuple[str, float], tuple[float, float]]
    grid: float


@dataclass(frozen=True, kw_only=True)
class BaseMethods(Measurement[Found]):
    """Command ``eip-scipy study gpe-methods``."""

    writes_files = True
    t_end: float = option(0.2, "end of the runs (default: %(default)s)", type=float)
    points: int = option(256, "points of the grid along each axis (default: %(default)s)", type=int)
    only: Sequence[str] | None = option(
        None, "methods to run, by their names in the table (default: all)", nargs="+", metavar="NAME"
    )
    repeats: int = option(3, "runs of each method and step (default: %(default)s)", type=int)

    def measure(self, session: Session) -> Found:
        gpe = ring_condensate(0.3, points=self.points)
        state = ground_state(gpe, ring_start(gpe, 38, 123), tol=1e-6)
        made, defects, grid, error = runners(state.psi, self.t_end, self.points)
        made = {name: made[name] for name in self.only or made}
        total = self.repeats * sum(len(steps) for _, steps in made.values())
        with session.bar(total, "gpe-methods") as bar:
            result = work_precision(made, error, repeats=self.repeats, enough_seconds=5.0, callback=bar.update)
        return Found(result.points, defects, grid)

    def table(self, found: Found) -> str:
        body = []
        for point in found.points:
            kept = [f"{x:.1e}" for x in found.defects[point.method, point.step]]
            cells = [f"{point.step:.3g}", f"{point.error:.2e}", f"{point.wall_time / self.t_end:.2f}", *kept]
            body.append((point.method, cells))
        costs = [
            (name, [f"{cost_to_reach(*curve, level) / self.t_end:.2f}" for level in LEVELS])
            for name, curve in curves(found.points).items()
        ]
        return "\n\n".join(
            [
                f"The grid's part: the frames differ by {found.grid:.1e} at t = {self.t_end:g}",
                table([["h"], ["error of psi"], ["s per unit", "of time"], ["mass"], ["energy"]], body),
                "Processor seconds per unit of time to reach an error",
                table([[f"{level:.0e}"] for level in LEVELS], costs),
            ]
        )

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"points": self.tables(found)["gpe-methods.csv"]}

    def tables(self, found: Found) -> dict[str, Rows]:
        pairs = [(point, found.defects[point.method, point.step]) for point in found.points]
        rows = [{**point._asdict(), "mass_error": mass, "energy_error": energy} for point, (mass, energy) in pairs]
        return {"gpe-methods.csv": rows}
