"""``eip-scipy gpe ring`` and ``gpe vortex-lines``: condensates after a quench, a sudden change of their equation."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, integrate
from eip_scipy.problems import GrossPitaevskii

from ..output import Output, checkpoint_options, require_positive
from ..report import UsageError, compact, describe_machine, named, table
from . import states
from .ground_state import ground_state, with_noise
from .problems import line_condensate, ring_condensate
from .splitting import rotated
from .vortices import Motion, vortices

METHODS = {"EIP-M": ("mass",), "EIP-E": ("energy",), "EIP-ME": ("mass", "energy"), "RK4": ()}
SHOWN = "EIP-ME"  # fields of this method are drawn
REFERENCE = "EIPDOP853"
SENSES = {1: "anticlockwise", -1: "clockwise"}
SLOWER = 0.7 - 0.9  # change of the lines' rotation relative to the frame


class Quench:
    """Runs of an equation from a state of another one: by RK4 with each of `METHODS`, and a reference by EIPDOP853.

    `h` are the steps of both, and `saved` the time between two saved states, short enough to follow the vortices. At
    the times `snapshots` fields are drawn and vortices counted. `sense` is the direction in which the vortices turn in
    the rotating frame: 1 anticlockwise, -1 clockwise. `kept` bounds the errors of mass and energy where they are kept.

    `runs` are the results by method, and `errors` the changes of mass and energy and the norm of the difference of the
    field from the reference, all absolute.
    """

    def __init__(
        self, stem: str, title: str, equation: GrossPitaevskii, start: np.ndarray, t_end: float, *,
        h: tuple[float, float], saved: float, snapshots: Sequence[float], sense: int, kept: tuple[float, float],
    ) -> None:  # fmt: skip
        self.stem, self.title, self.equation, self.start, self.t_end = stem, title, equation, start, t_end
        (self.h, self.reference_h), self.saved, self.snapshots, self.sense, self.kept = h, saved, snapshots, sense, kept
        self.runs: dict[str, Any] = {}
        self.errors: dict[str, dict[str, np.ndarray]] = {}
        self.moved: Motion | None = None

    def run(self, out: Output, checkpoint: Path | None, resume: bool) -> None:
        """Run the reference and each of `METHODS`, and follow the vortices in the run of `SHOWN`."""
        gpe, problem = self.equation, self.equation.problem(self.start, self.t_end, self.h, name=self.stem)
        with out.keep(checkpoint):
            for name, kept in {REFERENCE: METHODS[SHOWN], **METHODS}.items():
                base, h = (EIPDOP853, self.reference_h) if name == REFERENCE else (EIPRK4, self.h)
                run = integrate(
                    problem, method=named(base, name), h=h, invariants=gpe.invariants(kept),
                    save_every=round(self.saved / h), progress=out.shows_progress,
                    **checkpoint_options(checkpoint, resume, name),
                )  # fmt: skip
                if not run.success:
                    raise RuntimeError(f"{name} failed: {run.message}")
                self.runs[name] = run
                mass, energy = (np.array([value(y) for y in run.y.T]) for value in (gpe.mass, gpe.energy))
                apart = [gpe.mass(a - b) for a, b in zip(run.y.T, self.runs[REFERENCE].y.T, strict=True)]
                changes = {"mass_error": np.abs(mass - mass[0]), "energy_error": np.abs(energy - energy[0])}
                self.errors[name] = {**changes, "field_error": np.sqrt(apart)}
                if name == SHOWN:
                    self.moved = Motion(gpe, run.t, run.y)

    def shown(self) -> dict[str, int]:
        """Return the indices of the snapshots that the run has reached, by titles."""
        t = self.runs[SHOWN].t
        at = [int(np.argmin(np.abs(t - time))) for time in self.snapshots if time <= t[-1] + 1e-9]
        return {f"t = {t[k]:.2f}": k for k in at}

    def report(self, out: Output, notes: Sequence[str] = ()) -> None:
        """Write and print the results of the methods that were run, and check them."""
        lines = {name: self.runs[name] for name in METHODS if name in self.runs}
        if not lines:
            return
        out.numbers["errors"] = [
            {"method": name, "t": t, **{key: values[k] for key, values in self.errors[name].items()}}
            for name, run in lines.items()
            for k, t in enumerate(run.t)
        ]
        out.rows(f"{self.stem}.csv", out.numbers["errors"])
        out.numbers["rank_reduced"] = {name: run.diagnostics.n_rank_reduced for name, run in lines.items()}
        out.numbers["wall_time_s"] = {name: run.wall_time for name, run in lines.items()}
        out.text(f"{self.title}, RK4, h = {self.h:g}, to t = {self.t_end:g}\n{describe_machine()}")
        out.text("Largest errors, absolute; that of psi is the norm of the difference from the reference:")
        out.text("\n".join([f"{REFERENCE}, h = {self.reference_h:g}", *notes, ""]))
        head = [["wall time", "[s]"], ["evaluations", "of f"], *(["error of", x] for x in ("mass", "energy", "psi"))]
        largest = {name: [float(values.max()) for values in self.errors[name].values()] for name in lines}
        body = [
            (name, [compact(run.wall_time, 3), str(run.nfev), *map(compact, largest[name]),
                    str(run.diagnostics.n_rank_reduced)])
            for name, run in lines.items()
        ]  # fmt: skip
        out.text(f"{table([*head, ['rank', 'reduced']], body)}\n")
        if self.moved is not None:
            self._report_motion(out, self.moved)
        for name in lines:
            for item, bound, error in zip(("mass", "energy"), self.kept, largest[name], strict=False):
                if item in METHODS[name]:
                    checked(out, f"{name}: error of the {item} below {bound:.0e}", error, error < bound)

    def _report_motion(self, out: Output, moved: Motion) -> None:
        """Print where the vortices are, and check that they keep their number and turn as expected."""
        counts, at = [len(each.charges) for each in moved.vortices], self.shown()
        out.numbers |= {"vortices": counts, "turned_rad": moved.angle}
        body = []
        for name, k in at.items():
            radius = np.hypot(*moved.vortices[k].positions.T).mean() if counts[k] else np.nan
            body.append((name, [str(counts[k]), compact(radius, 4), f"{moved.angle[k]:+.3f}"]))
        out.text("Vortices, in the rotating frame; turned: positive anticlockwise, with x to the right and y up\n")
        out.text(f"{table([['number'], ['mean radius'], ['turned [rad]']], body)}\n")
        seen = [counts[k] for k in at.values()]
        checked(out, "vortices in the snapshots", seen, seen[0] > 0 and len(set(seen)) == 1)
        sense, turned = f"vortices turn {SENSES[self.sense]}", float(moved.angle[[*at.values()][-1]])
        if len(at) > 1:
            checked(out, f"{sense}, angle at {[*at][-1]} [rad]", turned, self.sense * turned > 0)
        else:
            out.text(f"{'-':<6} not checked: that {sense}, because the run ends before t = {self.snapshots[1]:g}")


def checked(out: Output, what: str, value: Any, passed: bool) -> None:
    """Check a condition in words, with the value that was found."""
    shown = f"{value:.6g}" if isinstance(value, float) else str(value)
    out.check(f"{what}: {shown}", passed, what=what, value=value)


def check_options(t_end: float, least: float, checkpoint: Path | None, resume: bool) -> None:
    """Check options of both commands before the search for the start."""
    if not least <= t_end < np.inf:
        raise UsageError(f"--t-end: expected at least {least:g}, the reference's step, got {t_end:g}")
    checkpoint_options(checkpoint, resume, "runs")


def ring(
    out: Output, *, start: Path | None = None, t_end: float = 1.0, movie: bool = False, seed: int = 0,
    checkpoint: Path | None = None, resume: bool = False,
) -> None:  # fmt: skip
    """Run the paper's ring of vortices after its trap is tightened: it contracts, and turns faster than the frame.

    Parameters
    ----------
    start : Path
        ring.npz that `gpe ground-state` has written (default: the ground state is searched first)
    t_end : float
        end of the run (default: 1); 10 in the paper's figure of the errors
    movie : bool
        write ring.gif, too
    seed : int
        seed of the random starts (default: 0)
    checkpoint : Path
        folder for checkpoints of the runs
    resume : bool
        continue from the checkpoints in the folder of --checkpoint
    """
    check_options(t_end, 5e-4, checkpoint, resume)
    before, after = (ring_condensate(kappa) for kappa in (0.3, 0.7))
    with states.searching(out) as bar:
        psi = states.load_state(start, before) if start else states.search_ring(seed, bar.set_description_str).state.psi
    quench = Quench(
        "ring", "Ring, kappa = 0.3 -> 0.7", after, psi, t_end, h=(2e-4, 5e-4), saved=0.02,
        snapshots=(0.0, 0.24, 0.44, 0.72, 0.8, 1.0), sense=1, kept=(1e-14, 1e-12),
    )  # fmt: skip
    run_ring(out, quench, movie, checkpoint, resume)


def run_ring(out: Output, quench: Quench, movie: bool, checkpoint: Path | None, resume: bool) -> None:
    """Run a condensate in two dimensions, and draw its density at the snapshots and as a movie."""
    quench.run(out, checkpoint, resume)
    quench.report(out)
    if not out.interrupted:
        densities = np.abs(quench.equation.grid.field(quench.runs[SHOWN].y)) ** 2
        out.figure("ring-errors.png", "condensates.figures:errors_figure", quench)
        out.figure("ring-snapshots.png", "condensates.figures:snapshots_figure", quench, densities, None)
        if movie:
            out.figure("ring.gif", "condensates.figures:movie", quench, densities)


def vortex_lines(
    out: Output, *, t_end: float = 20.0, points: int = states.LINE_POINTS, seed: int = 0,
    checkpoint: Path | None = None, resume: bool = False,
) -> None:  # fmt: skip
    """Run the paper's condensate in 3D, a saddle of the energy, after its rotation is made faster: it lags behind.

    Parameters
    ----------
    t_end : float
        end of the run (default: 20)
    points : int
        points of the grid along each axis (default: 64)
    seed : int
        seed of the noise (default: 0)
    checkpoint : Path
        folder for checkpoints of the runs
    resume : bool
        continue from the checkpoints in the folder of --checkpoint
    """
    require_positive(points=points)
    check_options(t_end, 1e-2, checkpoint, resume)
    before, after = (line_condensate(Omega, points) for Omega in (0.7, 0.9))
    with states.searching(out) as bar:
        start = states.search_saddle(points, bar.set_description_str).state.psi
        bar.set_description_str("lines, down from the saddle")
        lower = ground_state(before, with_noise(start, np.random.default_rng(seed)), **states.ROUGH)
    quench = Quench(
        "vortex-lines", "Vortex lines, Omega = 0.7 -> 0.9", after, start, t_end, h=(5e-3, 1e-2),
        saved=1e-2 * max(round(5 * t_end), 1), snapshots=[0.2 * k * t_end for k in range(6)], sense=-1,
        kept=(1e-14, 1e-13),
    )  # fmt: skip
    quench.run(out, checkpoint, resume)
    quench.report(out, _notes(before, start, quench.runs.get(REFERENCE)))
    near, finest = (1e-4 if points >= states.LINE_POINTS else 1e-3), 0.02 * states.LINE_POINTS / points
    for name, psi, known, count, converged in (
        ("the start, a saddle", start, *states.SADDLE, True),
        ("the state below", lower.psi, *states.LOWEST, lower.converged),
    ):
        energy, found = before.energy(psi), len(vortices(before, psi).charges)
        checked(out, f"E of {name}, {known}", energy, converged and abs(energy - known) < near)
        checked(out, f"lines of {name}, {count}", found, found == count)
    if not out.interrupted and (moved := quench.moved) is not None:
        off = float(np.abs(moved.angle - SLOWER * moved.t).max())  # at most 0.1 of the distance between two points
        checked(out, f"angle off {SLOWER:.1f} t by less than {finest:.2g} rad", off, off < finest)
        planes = np.abs(after.grid.field(quench.runs[SHOWN].y)[..., points // 2]) ** 2
        out.figure("vortex-lines-errors.png", "condensates.figures:errors_figure", quench)
        out.figure("vortex-lines-slices.png", "condensates.figures:snapshots_figure", quench, planes, 5.0)
        if find_spec("skimage"):
            out.figure("vortex-lines-surfaces.png", "condensates.figures:surfaces_figure", quench)
        else:
            out.missing('no surfaces of equal density without scikit-image: pip install "eip_scipy[surfaces]"')


def _notes(before: GrossPitaevskii, start: np.ndarray, reference: Any) -> list[str]:
    """Return the residual of the start, and how far the reference ends from the start, turned, times a phase."""
    psi = start.reshape(-1)
    H_psi = 1j * before.fun(0.0, psi)
    mu = float(np.vdot(psi, H_psi).real / np.vdot(psi, psi).real)
    notes = [f"residual of the start: {compact(float(np.sqrt(before.mass(H_psi - mu * psi))))}"]
    if reference is not None:
        t = reference.t[-1]
        exact = rotated(before, start, -SLOWER * t).reshape(-1) * np.exp(-1j * mu * t)
        off = compact(float(np.sqrt(before.mass(reference.y[:, -1] - exact))))
        notes.append(f"{REFERENCE} ends {off} from the start turned by {SLOWER * t:g} rad: the error of the grid")
    return notes
