"""Condensates after a quench, a sudden change of their equation, for ``gpe ring`` and ``gpe vortex-lines``."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, integrate
from eip_scipy.problems import FieldProblem, GrossPitaevskii
from eip_scipy.solvers import EIPSolver

from ..long_runs import Checkpoints, named
from ..report import compact, describe_machine, table
from ..study import Check, Figures, PartlyDone, Rows, Session, Study, option
from .vortices import Vortices, vortices

METHODS = {"EIP-M": ("mass",), "EIP-E": ("energy",), "EIP-ME": ("mass", "energy"), "RK4": ()}
SHOWN = "EIP-ME"  # fields of this method are kept, for the figures
REFERENCE = "EIPDOP853"
MASS_KEPT = 1e-14
SMALL = 1e-3
AXES = "seen from above, with x to the right and y up"
SENSES = {1: "anticlockwise", -1: "clockwise"}


def field_check(what: str, value: Any, passed: bool) -> Check:
    """Return a check with its condition in words and the measured value."""
    shown = str(value)
    if isinstance(value, float):
        shown = compact(value, 3) if abs(value) < SMALL else f"{value:.6g}"
    return Check(f"{what}: {shown}", passed, {"what": what, "value": value, "passed": passed})


@dataclass(frozen=True, eq=False)
class FieldRun:
    """One method's run: saved times (m,), absolute errors (m,), seconds, and evaluations of the right-hand side.

    The errors of mass and energy are changes since the start, that of the field is the norm of the difference from the
    reference. `n_rank_reduced` counts projections with parallel gradients, as at a stationary state.
    """

    t: np.ndarray
    mass_error: np.ndarray
    energy_error: np.ndarray
    field_error: np.ndarray
    wall_time: float
    nfev: int
    n_rank_reduced: int


@dataclass(eq=False)
class QuenchRuns:
    """The runs of a quench: those of `METHODS` that were done, by name (`lines`).

    `problem` is the one after the quench, with the step of RK4. `reference` and `fields` are the states (n, m) of the
    reference and of the method `SHOWN`, and `moved` are the vortices in the latter.
    """

    problem: FieldProblem
    lines: dict[str, FieldRun] = field(default_factory=dict)
    reference: np.ndarray | None = None
    fields: np.ndarray | None = None
    moved: Motion | None = None
    more: list[Check] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def equation(self) -> GrossPitaevskii:
        """Return the equation after the quench."""
        return self.problem.equation


@dataclass(frozen=True, eq=False)
class Motion:
    """The vortices at the times `t` (m,), and the `angle` (m,) by which they have turned about the centre [rad]."""

    t: np.ndarray
    vortices: list[Vortices]
    angle: np.ndarray

    def off(self, k: int, x: Any, y: Any) -> Any:
        """Return polar angles of points in the k-th state, relative to the first vortex with the largest x, turned."""
        a, b = self.vortices[0].positions[np.argmax(self.vortices[0].positions[:, 0])]
        return np.angle(np.exp(1j * (np.arctan2(y, x) - np.arctan2(b, a) - self.angle[k])))

    def followed(self, k: int) -> int | None:
        """Return the index of the vortex closest to the reference of `off` in the k-th state; None without vortices."""
        if not (self.vortices[0].charges.size and self.vortices[k].charges.size):
            return None
        return int(np.abs(self.off(k, *self.vortices[k].positions.T)).argmin())


def _line(gpe: GrossPitaevskii, run: Any, reference: np.ndarray) -> FieldRun:
    mass, energy = (np.array([value(y) for y in run.y.T]) for value in (gpe.mass, gpe.energy))
    difference = np.sqrt([gpe.mass(y - tight) for y, tight in zip(run.y.T, reference.T, strict=True)])
    errors = np.abs(mass - mass[0]), np.abs(energy - energy[0])
    return FieldRun(run.t, *errors, difference, run.wall_time, run.nfev, run.diagnostics.n_rank_reduced)


def motion(gpe: GrossPitaevskii, t: np.ndarray, fields: np.ndarray) -> Motion:
    """Find the vortices in all states `fields` (n, m) at the times `t` (m,), and the angle by which they have turned.

    From one state to the next, the angle of each vortex is extrapolated and matched with the nearest one.
    """
    found = [vortices(gpe, y) for y in fields.T]
    angles = [np.arctan2(*v.positions.T[::-1]) for v in found]
    turned, step = [0.0], 0.0
    for old, new in pairwise(angles):
        step = _mean_turn(old, new, step)
        turned.append(turned[-1] + step)
    return Motion(t, found, np.array(turned))


def _mean_turn(old: np.ndarray, new: np.ndarray, guess: float) -> float:
    """Return the median turn of vortices; each `old` angle plus `guess` is matched with the nearest `new` one."""
    if not (old.size and new.size):
        return guess
    difference = np.angle(np.exp(1j * (new[None, :] - old[:, None] - guess)))
    nearest = np.abs(difference).argmin(axis=1)
    return guess + float(np.median(difference[np.arange(old.size), nearest]))


def _cells(line: FieldRun) -> list[str]:
    errors = (compact(float(e.max())) for e in (line.mass_error, line.energy_error, line.field_error))
    return [compact(line.wall_time, 3), str(line.nfev), *errors, str(line.n_rank_reduced)]


@dataclass(frozen=True, kw_only=True)
class QuenchStudy(Checkpoints, Study[QuenchRuns]):
    """Base class of the commands on condensates whose trap or rotation changes at t = 0, a quench.

    The runs by RK4 have the step `step`, the reference, by EIPDOP853, `reference_step`. `saved` is the time between two
    saved states, short enough to follow the vortices. At the times `snapshots` fields are drawn and vortices counted.
    `sense` is the direction in which the vortices turn in the rotating frame: 1 anticlockwise, -1 clockwise.
    `energy_kept` is the bound on the absolute error of the energy in runs that keep it.
    """

    seed: int = option(0, "seed of the random starts (default: %(default)s)", type=int, metavar="N")
    if TYPE_CHECKING:
        t_end: float
    stem: str = ""
    step: float = math.nan
    reference_step: float = math.nan
    saved: float = math.nan
    snapshots: tuple[float, ...] = ()
    sense: int = 1
    energy_kept: float = math.nan

    @property
    @abstractmethod
    def title(self) -> str:
        """Return the title of the table and the figures."""

    def arguments(self) -> dict[str, Any]:
        return {"h": self.step, "t_end": self.t_end}

    def shown(self, t: np.ndarray) -> list[int]:
        """Return the indices in `t` of the snapshots that the run has reached."""
        return [int(np.argmin(np.abs(t - at))) for at in self.snapshots if at <= t[-1] + 1e-9]

    def do_runs(self, gpe: GrossPitaevskii, start: np.ndarray, session: Session) -> QuenchRuns:
        """Run the reference and each of `METHODS` from `start`, and follow the vortices in the run of `SHOWN`.

        PartlyDone is raised with the completed runs if the user interrupts them after at least one of `METHODS`.
        """
        made = QuenchRuns(gpe.problem(start, self.t_end, self.step, name=self.stem))
        run = partial(self._run, made, session.shown)
        try:
            made.reference = run(REFERENCE, EIPDOP853, self.reference_step, METHODS[SHOWN]).y
            for name, invariants in METHODS.items():
                done = run(name, EIPRK4, self.step, invariants)
                made.lines[name] = _line(gpe, done, made.reference)
                if name == SHOWN:
                    made.fields = done.y
                    made.moved = motion(gpe, done.t, done.y)
        except KeyboardInterrupt:
            if not made.lines:
                raise
            raise PartlyDone(made) from None
        return made

    def _run(
        self, made: QuenchRuns, progress: bool, name: str, method: type[EIPSolver], h: float, kept: Sequence[str]
    ) -> Any:
        run = integrate(
            made.problem,
            method=named(method, name),
            h=h,
            invariants=made.equation.invariants(kept),
            save_every=round(self.saved / h),
            progress=progress,
            **self.checkpoint_options(name),
        )
        if not run.success:
            raise RuntimeError(f"{name} failed: {run.message}")
        return run

    def checks(self, found: QuenchRuns) -> list[Check]:
        """Check that vortices keep their number and turn as expected, and that each preserved invariant is kept."""
        checks, moved = [], found.moved
        if moved is not None:
            at = self.shown(moved.t)
            counts = [len(moved.vortices[k].charges) for k in at]
            checks.append(field_check("vortices in the snapshots", counts, counts[0] > 0 and len(set(counts)) == 1))
            if len(at) > 1:
                turned = float(moved.angle[at[-1]])
                sense = f"vortices turn {SENSES[self.sense]}, angle at t = {moved.t[at[-1]]:g} [rad]"
                checks.append(field_check(sense, turned, self.sense * turned > 0))
        for name, line in found.lines.items():
            for item, bound in (("mass", MASS_KEPT), ("energy", self.energy_kept)):
                if item in METHODS[name]:
                    error = float(getattr(line, f"{item}_error").max())
                    checks.append(field_check(f"{name}: error of the {item} below {bound:.0e}", error, error < bound))
        return [*checks, *found.more]

    def text(self, found: QuenchRuns) -> str:
        moved = found.moved
        head = [["wall time", "[s]"], ["evaluations", "of f"], ["error of", "mass"], ["error of", "energy"]]
        head += [["error of", "psi"], ["rank", "reduced"]]
        out = [
            f"{self.title}, RK4, h = {self.step:g}, to t = {self.t_end:g}",
            describe_machine(),
            f"Largest errors, absolute; that of psi is the norm of the difference from {REFERENCE}, "
            f"h = {self.reference_step:g}",
            *found.notes,
            "",
            table(head, [(name, _cells(line)) for name, line in found.lines.items()]),
            "",
        ]
        if moved is not None:
            where = [
                (f"t = {moved.t[k]:.2f}", [str(len(v.charges)), radius, f"{moved.angle[k]:+.3f}"])
                for k in self.shown(moved.t)
                for v in (moved.vortices[k],)
                for radius in (f"{np.hypot(*v.positions.T).mean():.3f}" if v.charges.size else "-",)
            ]
            out += [
                f"Vortices, in the rotating frame; turned: positive anticlockwise, {AXES}",
                "",
                table([["number"], ["mean radius"], ["turned [rad]"]], where),
                "",
            ]
        out += [check.line for check in self.checks(found)]
        if moved is not None and len(self.shown(moved.t)) < 2:
            before = f"the run ends before t = {self.snapshots[1]:g}"
            out.append(f"{'-':<6} not checked: in which sense the vortices turn, for {before}")
        return "\n".join(out)

    def tables(self, found: QuenchRuns) -> dict[str, Rows]:
        return {f"{self.stem}.csv": _rows(found)}

    def numbers(self, found: QuenchRuns) -> dict[str, Any]:
        numbers: dict[str, Any] = {
            "errors": _rows(found),
            "wall_time_s": {name: line.wall_time for name, line in found.lines.items()},
            "rank_reduced": {name: line.n_rank_reduced for name, line in found.lines.items()},
            "checks": [check.entry for check in self.checks(found)],
        }
        if found.moved is not None:
            numbers |= {"vortices": [len(v.charges) for v in found.moved.vortices], "turned_rad": found.moved.angle}
        return numbers

    def figures(self, found: QuenchRuns) -> Figures:
        """Draw the errors against time, and the fields (see `pictures`)."""
        from ..plotting import ErrorSeries, errors_figure

        start = found.problem.y0
        mass, energy = abs(found.equation.mass(start)), abs(found.equation.energy(start))
        series = {
            name: ErrorSeries(
                line.t, {"mass": line.mass_error / mass, "energy": line.energy_error / energy}, line.field_error
            )
            for name, line in found.lines.items()
        }
        title = f"{self.title}, RK4, h = {self.step:g}"
        figure = errors_figure(series, time="t", trajectory=r"error of $\psi$ (norm)", title=title)
        yield f"{self.stem}-errors.png", figure
        yield from self.pictures(found)

    @abstractmethod
    def pictures(self, found: QuenchRuns) -> Figures:
        """Draw the fields at the times `snapshots`; yield the file names and figures."""


def _rows(made: QuenchRuns) -> Rows:
    """Make the lines of the CSV file."""
    names = ("t", "mass_error", "energy_error", "field_error")
    return [
        {"method": method, **{name: getattr(line, name)[k] for name in names}}
        for method, line in made.lines.items()
        for k in range(line.t.size)
    ]
