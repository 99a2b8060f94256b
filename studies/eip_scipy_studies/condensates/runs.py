"""Condensates after a quench, a sudden change of their equation, for ``gpe ring`` and ``gpe vortex-lines``."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, integrate
from eip_scipy.problems import FieldProblem, GrossPitaevskii
from eip_scipy.problems.gross_pitaevskii import Vortices, vortices
from eip_scipy.solvers import EIPSolver

from ..long_runs import Checkpoints, named
from ..report import compact, describe_machine, table
from ..study import Check, Figures, PartlyDone, Rows, Session, Study, option

METHODS = {"EIP-M": ("mass",), "EIP-E": ("energy",), "EIP-ME": ("mass", "energy"), "RK4": ()}
SHOWN = "EIP-ME"  # fields of this method are kept, for the figures
REFERENCE = "EIPDOP853"
MASS_KEPT = 1e-14
SMALL = 1e-3
AXES = "seen from above, with x to the right and y up"
SENSES = {1: "anticlockwise", -1: "clockwise"}


def field_check(what: str, value: Any, passed: bool) -> Check:
    """Return a check with its condition in words and the measured value."""
    return Check(f"{what}: {_value(value)}", passed, {"what": what, "value": value, "passed": passed})


@dataclass(frozen=True, eq=False)
class Quench:
    """A condensate whose trap or rotation changes at t = 0, and the settings of its report.

    `name` is the stem of the names of the files. `problem` is the one after the quench, with the step of RK4; it starts
    from the stationary state before the quench. The reference, with which the other runs are compared, is a run by
    EIPDOP853 with `reference_step`. `interval` is the time between two saved states, short enough to follow the
    vortices. At the times `snapshots` fields are drawn and vortices are counted. `sense` is the direction in which the
    vortices turn in the rotating frame: 1 anticlockwise, -1 clockwise. `energy_kept` is the bound on the absolute error
    of the energy in runs that keep it.
    """

    name: str
    title: str
    problem: FieldProblem
    reference_step: float
    interval: float
    snapshots: tuple[float, ...]
    sense: int
    energy_kept: float

    @property
    def equation(self) -> GrossPitaevskii:
        """Return the equation after the quench."""
        assert self.problem.equation is not None
        return self.problem.equation

    @property
    def step(self) -> float:
        """Return the step of RK4."""
        assert self.problem.h is not None
        return self.problem.h

    @property
    def t_end(self) -> float:
        """Return the time at which the run ends."""
        return self.problem.t_span[1]

    def shown(self, t: np.ndarray) -> list[int]:
        """Return the indices in the saved times `t` of those snapshots that the run has reached."""
        return [int(np.argmin(np.abs(t - at))) for at in self.snapshots if at <= t[-1] + 1e-9]


@dataclass(frozen=True, eq=False)
class FieldRun:
    """One method's run: saved times (m,), absolute errors (m,), seconds, and evaluations of the right-hand side.

    The errors of mass and energy are their changes since the start, that of the field is the norm of the difference
    from the reference. `n_rank_reduced` is the number of projections in which the gradients were parallel, as at a
    stationary state.
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

    `reference` and `fields` are the states (n, m) of the reference and of the method `SHOWN`, whose fields are drawn,
    and `moved` are the vortices in the run of `SHOWN`. `more` are checks in addition to those of all quenches, and
    `notes` lines for the head of the table.
    """

    quench: Quench
    lines: dict[str, FieldRun] = field(default_factory=dict)
    reference: np.ndarray | None = None
    fields: np.ndarray | None = None
    moved: Motion | None = None
    more: list[Check] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Motion:
    """The vortices at the times `t` (m,); in three dimensions their positions in the middle plane.

    `angle` (m,) is the angle by which the vortices have turned about the centre since the start, positive anticlockwise
    [rad]: the sum of the medians of their turns from one state to the next.
    """

    t: np.ndarray
    vortices: list[Vortices]
    angle: np.ndarray

    def off(self, k: int, x: Any, y: Any) -> Any:
        """Return polar angles of points (x, y) relative to that of a reference vortex in the k-th state, in (-pi, pi].

        The reference is the vortex with the largest x at the start, turned by `angle`.
        """
        a, b = self.vortices[0].positions[np.argmax(self.vortices[0].positions[:, 0])]
        return np.angle(np.exp(1j * (np.arctan2(y, x) - np.arctan2(b, a) - self.angle[k])))

    def followed(self, k: int) -> int | None:
        """Return the index of the vortex closest to the reference of `off` in the k-th state; None without vortices."""
        if not (self.vortices[0].charges.size and self.vortices[k].charges.size):
            return None
        return int(np.abs(self.off(k, *self.vortices[k].positions.T)).argmin())


def _run(
    quench: Quench,
    progress: bool,
    checkpoint_of: Callable[[str], dict[str, Any]],
    name: str,
    method: type[EIPSolver],
    h: float,
    invariants: Sequence[str],
) -> Any:
    chosen = quench.equation.invariants(invariants)
    run = integrate(
        quench.problem,
        method=named(method, name),
        h=h,
        invariants=chosen,
        save_every=round(quench.interval / h),
        progress=progress,
        **checkpoint_of(name),
    )
    if not run.success:
        raise RuntimeError(f"{name} failed: {run.message}")
    return run


def _line(quench: Quench, run: Any, reference: np.ndarray) -> FieldRun:
    gpe = quench.equation
    mass, energy = (np.array([value(y) for y in run.y.T]) for value in (gpe.mass, gpe.energy))
    difference = np.sqrt([gpe.mass(y - tight) for y, tight in zip(run.y.T, reference.T, strict=True)])
    errors = np.abs(mass - mass[0]), np.abs(energy - energy[0])
    return FieldRun(run.t, *errors, difference, run.wall_time, run.nfev, run.diagnostics.n_rank_reduced)


def motion(gpe: GrossPitaevskii, t: np.ndarray, fields: np.ndarray) -> Motion:
    """Find the vortices in all states `fields` (n, m) at the times `t` (m,), and the angle by which they have turned.

    From one state to the next, the angle of each vortex is extrapolated and matched with the nearest one; the angle of
    `Motion` increases by the median of the turns.
    """
    found = [vortices(gpe, y) for y in fields.T]
    angles = [np.arctan2(*v.positions.T[::-1]) for v in found]
    turned, step = [0.0], 0.0
    for old, new in pairwise(angles):
        step = _mean_turn(old, new, step)
        turned.append(turned[-1] + step)
    return Motion(t, found, np.array(turned))


def _mean_turn(old: np.ndarray, new: np.ndarray, guess: float) -> float:
    """Return the median turn of vortices from angles `old` to `new`.

    Each old angle plus `guess` is matched with the nearest new one. Without vortices the turn is `guess`.
    """
    if not (old.size and new.size):
        return guess
    difference = np.angle(np.exp(1j * (new[None, :] - old[:, None] - guess)))
    nearest = np.abs(difference).argmin(axis=1)
    return guess + float(np.median(difference[np.arange(old.size), nearest]))


def _checks(made: QuenchRuns) -> list[Check]:
    """Check that vortices keep their number and turn as expected, and that each preserved invariant is kept."""
    found, quench, moved = [], made.quench, made.moved
    if moved is not None:
        at = quench.shown(moved.t)
        counts = [len(moved.vortices[k].charges) for k in at]
        found.append(field_check("vortices in the snapshots", counts, counts[0] > 0 and len(set(counts)) == 1))
        if len(at) > 1:
            turned = float(moved.angle[at[-1]])
            sense = f"vortices turn {SENSES[quench.sense]}, angle at t = {moved.t[at[-1]]:g} [rad]"
            found.append(field_check(sense, turned, quench.sense * turned > 0))
    for name, line in made.lines.items():
        for item, bound in (("mass", MASS_KEPT), ("energy", quench.energy_kept)):
            if item in METHODS[name]:
                error = float(getattr(line, f"{item}_error").max())
                found.append(field_check(f"{name}: error of the {item} below {bound:.0e}", error, error < bound))
    return found


def _text(made: QuenchRuns, found: Sequence[Check]) -> str:
    """Return the errors, the vortices and the checks as text."""
    quench, moved = made.quench, made.moved
    head = [["wall time", "[s]"], ["evaluations", "of f"], ["error of", "mass"], ["error of", "energy"]]
    head += [["error of", "psi"], ["rank", "reduced"]]
    body = [(name, _cells(line)) for name, line in made.lines.items()]
    out = [
        f"{quench.title}, RK4, h = {quench.step:g}, to t = {quench.t_end:g}",
        describe_machine(),
        f"Largest errors, absolute; that of psi is the norm of the difference from {REFERENCE}, "
        f"h = {quench.reference_step:g}",
        *made.notes,
        "",
        table(head, body),
        "",
    ]
    if moved is not None:
        where = [
            (f"t = {moved.t[k]:.2f}", [str(len(v.charges)), _radius(v), f"{moved.angle[k]:+.3f}"])
            for k in quench.shown(moved.t)
            for v in (moved.vortices[k],)
        ]
        out += [
            f"Vortices, in the rotating frame; turned: positive anticlockwise, {AXES}",
            "",
            table([["number"], ["mean radius"], ["turned [rad]"]], where),
            "",
        ]
    out += [check.line for check in found]
    if moved is not None and len(quench.shown(moved.t)) < 2:
        before = f"the run ends before t = {quench.snapshots[1]:g}"
        out.append(f"{'-':<6} not checked: in which sense the vortices turn, for {before}")
    return "\n".join(out)


def _value(value: Any) -> str:
    """Format the value of a check: floats below `SMALL`, which are errors, with 3 digits, other floats with 6."""
    if isinstance(value, float):
        return compact(value, 3) if abs(value) < SMALL else f"{value:.6g}"
    return str(value)


def _cells(line: FieldRun) -> list[str]:
    errors = (compact(float(e.max())) for e in (line.mass_error, line.energy_error, line.field_error))
    return [compact(line.wall_time, 3), str(line.nfev), *errors, str(line.n_rank_reduced)]


def _radius(found: Vortices) -> str:
    return f"{np.hypot(*found.positions.T).mean():.3f}" if found.charges.size else "-"


@dataclass(frozen=True, kw_only=True)
class QuenchStudy(Checkpoints, Study[QuenchRuns]):
    """Base class of the commands on quenches."""

    seed: int = option(0, "seed of the random starts (default: %(default)s)", type=int, metavar="N")

    def do_runs(self, quench: Quench, session: Session) -> QuenchRuns:
        """Run the reference and each of `METHODS`, and follow the vortices in the run of `SHOWN`.

        A RuntimeError is raised if a run fails, and PartlyDone with the completed runs if the user interrupts them
        after at least one of `METHODS`.
        """
        made = QuenchRuns(quench)
        run = partial(_run, quench, session.shown, self.checkpoint_options)
        try:
            made.reference = run(REFERENCE, EIPDOP853, quench.reference_step, METHODS[SHOWN]).y
            for name, invariants in METHODS.items():
                done = run(name, EIPRK4, quench.step, invariants)
                made.lines[name] = _line(quench, done, made.reference)
                if name == SHOWN:
                    made.fields = done.y
        except KeyboardInterrupt:
            if not made.lines:
                raise
            made.moved = _moved(made)
            raise PartlyDone(made) from None
        made.moved = _moved(made)
        return made

    def text(self, found: QuenchRuns) -> str:
        return _text(found, self.checks(found))

    def checks(self, found: QuenchRuns) -> list[Check]:
        return [*_checks(found), *found.more]

    def tables(self, found: QuenchRuns) -> dict[str, Rows]:
        return {f"{found.quench.name}.csv": _rows(found)}

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

        quench = found.quench
        mass, energy = (abs(value(quench.problem.y0)) for value in (quench.equation.mass, quench.equation.energy))
        series = {
            name: ErrorSeries(
                line.t, {"mass": line.mass_error / mass, "energy": line.energy_error / energy}, line.field_error
            )
            for name, line in found.lines.items()
        }
        title = f"{quench.title}, RK4, h = {quench.step:g}"
        figure = errors_figure(series, time="t", trajectory=r"error of $\psi$ (norm)", title=title)
        yield f"{quench.name}-errors.png", figure
        yield from self.pictures(found)

    @abstractmethod
    def pictures(self, found: QuenchRuns) -> Figures:
        """Draw the fields at the times `snapshots`; yield the file names and figures."""


def _moved(made: QuenchRuns) -> Motion | None:
    return None if made.fields is None else motion(made.quench.equation, made.lines[SHOWN].t, made.fields)


def _rows(made: QuenchRuns) -> Rows:
    """Make the lines of the CSV file."""
    return [
        {
            "method": name,
            "t": line.t[k],
            "mass_error": line.mass_error[k],
            "energy_error": line.energy_error[k],
            "field_error": line.field_error[k],
        }
        for name, line in made.lines.items()
        for k in range(line.t.size)
    ]
