"""``eip-scipy gpe ring``: the paper's ring after its trap is tightened; vortices and invariants in time."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ..longrun import integrate
from ..problems import FieldProblem, GrossPitaevskii
from ..problems.gross_pitaevskii import Vortices, ring_condensate, vortices
from ..report import (
    check_outputs,
    compact,
    describe_machine,
    document,
    say,
    table,
    warn,
    write_csv,
    write_file,
    write_json,
)
from ..solvers import EIPDOP853, EIPRK4, EIPSolver
from .gpe_states import cropped, load_state, search_ring

__all__ = ["Line", "run", "study"]

DONE, FAILED, INTERRUPTED = 0, 1, 130
POINTS, STEP, T_END = 256, 2e-4, 1.0
REFERENCE_STEP = 2.5e-4
SAVED = 0.02  # time between two saved states
KAPPA_BEFORE, KAPPA_AFTER = 0.3, 0.7
SNAPSHOTS = (0.0, 0.24, 0.44, 0.72, 0.8, 1.0)
METHODS = {"EIP-M": ("mass",), "EIP-E": ("energy",), "EIP-ME": ("mass", "energy"), "RK4": ()}
MASS_KEPT, ENERGY_KEPT = 1e-14, 1e-12
FRAMES_PER_SECOND = 8


@dataclass(frozen=True, eq=False)
class Line:
    """One method's run.

    Attributes
    ----------
    t : ndarray, shape (m,)
    y : ndarray, shape (n, m)
    mass_error, energy_error, field_error : ndarray, shape (m,)
        Absolute; the last is the norm of the difference from the reference.
    wall_time : float
    nfev : int
    """

    t: np.ndarray
    y: np.ndarray
    mass_error: np.ndarray
    energy_error: np.ndarray
    field_error: np.ndarray
    wall_time: float
    nfev: int


@dataclass(frozen=True, eq=False)
class Motion:
    """The vortices in time.

    Attributes
    ----------
    t : ndarray, shape (m,)
    found : list of Vortices
    angle : ndarray, shape (m,)
        By how much they have turned about the centre, on average, positive anticlockwise [rad].
    """

    t: np.ndarray
    found: list[Vortices]
    angle: np.ndarray


def study(problem: FieldProblem, update: Any = lambda what: None) -> dict[str, Line]:
    """Run each of `METHODS` and compare with the method of order 8.

    Parameters
    ----------
    problem : FieldProblem
    update : callable, optional
        ``update(text)`` before each run.

    Returns
    -------
    dict of str to Line
    """
    update("reference")
    tight = _run(problem, EIPDOP853, REFERENCE_STEP, ("mass", "energy"))
    lines = {}
    for name, kept in METHODS.items():
        update(name)
        lines[name] = _line(problem, _run(problem, EIPRK4, STEP, kept), tight.y)
    return lines


def _run(problem: FieldProblem, method: type[EIPSolver], h: float, kept: tuple[str, ...]) -> Any:
    chosen = [item for item in problem.invariants if item.name in kept]
    run = integrate(problem, method=method, h=h, invariants=chosen, save_every=round(SAVED / h))
    if not run.success:
        raise RuntimeError(f"{method.__name__} failed: {run.message}")
    return run


def _line(problem: FieldProblem, run: Any, tight: np.ndarray) -> Line:
    gpe = _equation(problem)
    mass, energy = (np.array([value(y) for y in run.y.T]) for value in (gpe.mass, gpe.energy))
    difference = np.sqrt([gpe.mass(y) for y in (run.y - tight).T])
    errors = np.abs(mass - mass[0]), np.abs(energy - energy[0])
    return Line(run.t, run.y, *errors, difference, run.wall_time, run.nfev)


def _equation(problem: FieldProblem) -> GrossPitaevskii:
    assert problem.equation is not None
    return problem.equation


def motion(gpe: GrossPitaevskii, line: Line) -> Motion:
    """Follow the vortices: each goes on as before, then to the nearest one in the next state; the median counts.

    Parameters
    ----------
    gpe : GrossPitaevskii
    line : Line

    Returns
    -------
    Motion
    """
    found = [vortices(gpe, y) for y in line.y.T]
    angles = [np.arctan2(*v.positions.T[::-1]) for v in found]
    turned, step = [0.0], 0.0
    for old, new in pairwise(angles):
        step = _mean_turn(old, new, step)
        turned.append(turned[-1] + step)
    return Motion(line.t, found, np.array(turned))


def _mean_turn(old: np.ndarray, new: np.ndarray, guess: float) -> float:
    """Median of the turns from each old angle, `guess` added, to the nearest new one."""
    if not (old.size and new.size):
        return guess
    difference = np.angle(np.exp(1j * (new[None, :] - old[:, None] - guess)))
    nearest = np.abs(difference).argmin(axis=1)
    return guess + float(np.median(difference[np.arange(old.size), nearest]))


def checks(lines: dict[str, Line], moved: Motion) -> list[dict[str, Any]]:
    """What must hold: vortices keep their count, and each invariant that is kept is kept.

    Returns
    -------
    list of dict
        With `what`, `value` and `passed`.
    """
    counts = [len(moved.found[k].charges) for k in _snapshots(moved.t)]
    found = [_check("vortices in the snapshots", counts, len(set(counts)) == 1)]
    for name, kept in METHODS.items():
        for item, bound in (("mass", MASS_KEPT), ("energy", ENERGY_KEPT)):
            if item in kept:
                error = float(getattr(lines[name], f"{item}_error").max())
                found.append(_check(f"{name}: error of the {item} below {bound:.0e}", error, error < bound))
    return found


def _check(what: str, value: Any, passed: bool) -> dict[str, Any]:
    return {"what": what, "value": value, "passed": bool(passed)}


def _snapshots(t: np.ndarray) -> list[int]:
    return [int(np.argmin(np.abs(t - at))) for at in SNAPSHOTS if at <= t[-1] + 1e-9]


def text(lines: dict[str, Line], moved: Motion, machine: str) -> str:
    """Lay out the errors, the vortices and the checks."""
    head = [["wall time", "[s]"], ["evaluations", "of f"], ["error of", "mass"], ["error of", "energy"]]
    head += [["error of", "psi"]]
    body = [
        (name, [compact(line.wall_time, 3), str(line.nfev), *(compact(float(e.max())) for e in _errors(line))])
        for name, line in lines.items()
    ]
    where = [
        (f"t = {moved.t[k]:.2f}", [str(len(moved.found[k].charges)), _radius(moved.found[k]), f"{moved.angle[k]:+.3f}"])
        for k in _snapshots(moved.t)
    ]
    out = [
        f"Ring, kappa = {KAPPA_BEFORE:g} -> {KAPPA_AFTER:g}, RK4, h = {STEP:g}",
        machine,
        f"Largest errors, absolute; that of psi is the norm of the difference from EIPDOP853, h = {REFERENCE_STEP:g}",
        "",
        table(head, body),
        "",
        "Vortices, in the rotating frame; turned: anticlockwise seen from above (y up, x to the right)",
        "",
        table([["number"], ["mean radius"], ["turned [rad]"]], where),
        "",
    ]
    for check in checks(lines, moved):
        value = check["value"] if isinstance(check["value"], list) else compact(check["value"])
        out.append(f"{'ok' if check['passed'] else 'FAILED':<6} {check['what']}: {value}")
    return "\n".join(out)


def _errors(line: Line) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return line.mass_error, line.energy_error, line.field_error


def _radius(found: Vortices) -> str:
    return f"{np.hypot(*found.positions.T).mean():.3f}" if found.charges.size else "-"


def rows(lines: dict[str, Line]) -> list[dict[str, Any]]:
    """Make the lines of the CSV file."""
    return [
        {
            "method": name,
            "t": line.t[k],
            "mass_error": line.mass_error[k],
            "energy_error": line.energy_error[k],
            "field_error": line.field_error[k],
        }
        for name, line in lines.items()
        for k in range(line.t.size)
    ]


def run(args: argparse.Namespace) -> int:
    """Run ``gpe ring``; see `eip_scipy.commands.gpe.run`."""
    from tqdm import tqdm

    check_outputs(args.out, args.json)
    before = ring_condensate(KAPPA_BEFORE, POINTS)
    after = ring_condensate(KAPPA_AFTER, POINTS)
    start = None if args.start is None else load_state(args.start, before)
    try:
        with tqdm(bar_format="{desc} [{elapsed}]", disable=args.quiet, leave=False) as bar:
            if start is None:
                start = search_ring(args.seed, bar.set_description_str).state.psi
            problem = after.problem(start, T_END, STEP, name="ring")
            lines = study(problem, bar.set_description_str)
    except KeyboardInterrupt:
        warn("interrupted; nothing was written")
        return INTERRUPTED
    moved = motion(after, lines["EIP-ME"])
    if not args.quiet:
        say(text(lines, moved, describe_machine()))
        say()
    _write(args, after, lines, moved)
    return DONE if all(check["passed"] for check in checks(lines, moved)) else FAILED


def _write(args: argparse.Namespace, gpe: GrossPitaevskii, lines: dict[str, Line], moved: Motion) -> None:
    written = [write_csv(args.out / "ring.csv", rows(lines))]
    if args.json is not None:
        numbers = {
            "errors": rows(lines),
            "wall_time_s": {name: line.wall_time for name, line in lines.items()},
            "vortices": [len(v.charges) for v in moved.found],
            "turned_rad": moved.angle,
            "checks": checks(lines, moved),
        }
        written.append(write_json(args.json, document("gpe ring", {"h": STEP, "t_end": T_END}, **numbers)))
    try:
        from ..plotting import ErrorSeries, errors_figure, fields_figure, fields_movie
    except ImportError as error:
        warn(f"no figures: {error}")
    else:
        every = _panels(gpe, lines["EIP-ME"], moved)
        shown = {f"t = {moved.t[k]:.2f}": every[k] for k in _snapshots(moved.t)}
        title = "Ring, kappa = 0.3 -> 0.7: density and vortices, EIP-ME"
        figure = fields_figure(shown, title=title, shared=True)
        written.append(write_file(args.out / "ring-snapshots.png", figure.savefig))
        mass, energy = (abs(value(lines["RK4"].y[:, 0])) for value in (gpe.mass, gpe.energy))
        series = {
            name: ErrorSeries(
                line.t, {"mass": line.mass_error / mass, "energy": line.energy_error / energy}, line.field_error
            )
            for name, line in lines.items()
        }
        figure = errors_figure(series, time="t", trajectory=r"error of $\psi$ (norm)", title=f"Ring, RK4, h = {STEP:g}")
        written.append(write_file(args.out / "ring-errors.png", figure.savefig))
        if args.movie:
            titles = [f"t = {t:.2f}" for t in moved.t]

            def film(path: Any) -> None:
                fields_movie(path, every, titles, per_second=FRAMES_PER_SECOND)

            written.append(write_file(args.out / "ring.gif", film))
    if not args.quiet:
        say("\n".join(f"wrote {path}" for path in written))


def _panels(gpe: GrossPitaevskii, line: Line, moved: Motion) -> list[Any]:
    """One panel for each saved state, all of the first one's size, which is the largest."""
    from ..plotting import FieldPanel

    fields = np.abs(gpe.grid.field(line.y)) ** 2
    largest = fields.max(axis=0)
    _, ends = cropped(largest, gpe.grid, (0, 1))
    keep = [
        np.flatnonzero((gpe.grid.points(axis) > ends[2 * axis]) & (gpe.grid.points(axis) < ends[2 * axis + 1]))
        for axis in (0, 1)
    ]
    return [
        FieldPanel(field[np.ix_(*keep)], ends, ("x", "y"), found.positions)
        for field, found in zip(fields, moved.found, strict=True)
    ]
