"""``eip-scipy gpe vortex-lines``: the paper's condensate in three dimensions, turned faster; its lines in time."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import numpy as np

from ...problems import GrossPitaevskii
from ...problems.gross_pitaevskii import density_surface, line_condensate, rotated, vortices
from .. import long_runs
from ..report import check_outputs, compact, warn
from .runs import REFERENCE, SHOWN, Figures, Motion, Quench, QuenchStudy, check, conclude, motion, study
from .states import (
    LINE_POINTS,
    LINES,
    LINES_ENERGY,
    SADDLE_ENERGY,
    SADDLE_LINES,
    Found,
    cropped,
    kept_state,
    leave_saddle,
    search_saddle,
    searching,
)

__all__ = ["run"]

INTERRUPTED = 130
STEP, T_END = 5e-3, 20.0
REFERENCE_STEP = 1e-2
SAVED = 1.0  # time between two saved states
OMEGA_BEFORE, OMEGA_AFTER = 0.7, 0.9
SNAPSHOTS = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0)
# The trap is round: what stands still in the slower frame goes on with it, and stays behind the faster one.
SENSE = -1
ENERGY_KEPT = 1e-13
TURN_KNOWN = 0.02  # rad: at the lines a tenth of the distance between two points of the grid
ENERGIES_KNOWN = 1e-4
LEVEL = 1e-3  # of the paper's surfaces
SLICE = 5.0  # half the side of the paper's slices
ROOM = ((-4.0, 4.0), (-4.0, 4.0), (-6.0, 6.0))


def run(args: argparse.Namespace) -> int:
    """Run ``gpe vortex-lines``; see `eip_scipy.app.condensates.gpe.run`."""
    check_outputs(args.out, args.json)
    long_runs.check(args)
    before, after = (line_condensate(Omega, LINE_POINTS) for Omega in (OMEGA_BEFORE, OMEGA_AFTER))
    try:
        start = kept_state(args, before, search_saddle)
        with searching(args) as update:
            lower = leave_saddle(before, start, args.seed, update)
    except KeyboardInterrupt:
        warn("interrupted in the search for the stationary state; nothing was written")
        return INTERRUPTED
    quench = Quench(
        name="vortex-lines",
        title=f"Vortex lines, Omega = {OMEGA_BEFORE:g} -> {OMEGA_AFTER:g}",
        problem=after.problem(start, T_END, STEP, name="vortex-lines"),
        reference_step=REFERENCE_STEP,
        interval=SAVED,
        snapshots=SNAPSHOTS,
        sense=SENSE,
        energy_kept=ENERGY_KEPT,
    )
    made = study(quench, progress=not args.quiet, checkpoint_of=partial(long_runs.checkpoint_options, args))
    if made.fields is None:
        return conclude(args, made, None)
    moved = motion(after, made.lines[SHOWN].t, made.fields)
    return conclude(
        args,
        made,
        moved,
        more=[*_state_checks(before, start, lower), _turn_check(moved)],
        notes=[*_state_notes(before, start, lower), _grid_note(before, made, moved.t)],
        figures=partial(_figures, made, moved),
    )


def _state_checks(gpe: GrossPitaevskii, start: np.ndarray, lower: Found) -> list[dict[str, Any]]:
    saddle, count = gpe.energy(start), len(vortices(gpe, start).charges)
    return [
        check(f"E of the start {SADDLE_ENERGY}", saddle, abs(saddle - SADDLE_ENERGY) < ENERGIES_KNOWN),
        check(f"lines of the start, {SADDLE_LINES}", count, count == SADDLE_LINES),
        check(
            f"E below that saddle {LINES_ENERGY}",
            lower.state.energy,
            lower.state.converged and abs(lower.state.energy - LINES_ENERGY) < ENERGIES_KNOWN,
        ),
        check(f"lines there, {LINES}", lower.count, lower.count == LINES),
    ]


def _turn_check(moved: Motion) -> dict[str, Any]:
    """The lines turn by the difference of the rotations times t."""
    off = float(np.abs(moved.angle - (OMEGA_BEFORE - OMEGA_AFTER) * moved.t).max())
    return check(f"angle off {OMEGA_BEFORE - OMEGA_AFTER:.1f} t by less than {TURN_KNOWN:g} rad", off, off < TURN_KNOWN)


def _state_notes(gpe: GrossPitaevskii, start: np.ndarray, lower: Found) -> list[str]:
    residual = gpe.hamiltonian(start) - gpe.chemical_potential(start) * start
    return [
        f"Start: {len(vortices(gpe, start).charges)} lines, E = {gpe.energy(start):.8f}, residual "
        f"{compact(float(np.sqrt(gpe.mass(residual))))}: a saddle. A little noise, and the descent",
        f"goes on to {lower.count} lines, E = {lower.state.energy:.8f}, residual {compact(lower.state.residual)}",
    ]


def _grid_note(before: GrossPitaevskii, made: QuenchStudy, t: np.ndarray) -> str:
    """How far the reference ends from the closed form, the start turned and with the phase of mu t."""
    assert made.reference is not None
    start = made.quench.problem.y0
    mu, turn = before.chemical_potential(start), OMEGA_AFTER - OMEGA_BEFORE
    exact = rotated(before, start, turn * t[-1]).reshape(-1) * np.exp(-1j * mu * t[-1])
    off = np.sqrt(before.mass(made.reference[:, -1] - exact))
    return (
        f"{REFERENCE} ends {compact(float(off))} from the start turned by {-turn * t[-1]:g} rad: the error of the grid"
    )


def _figures(made: QuenchStudy, moved: Motion) -> Figures:
    from ...plotting import fields_figure, surfaces_figure

    title, times = f"{made.quench.title}, {SHOWN}", made.quench.shown(moved.t)
    slices = {f"t = {moved.t[k]:g}": _slice(made, moved, k) for k in times}
    figure = fields_figure(slices, title=f"{title}: density in the plane z = 0", shared=True)
    yield "vortex-lines-slices.png", figure.savefig
    try:
        surfaces = {f"t = {moved.t[k]:g}": _surface(made, moved, k) for k in times}
    except ImportError as error:
        warn(f"no surfaces: {error}")
        return
    figure = surfaces_figure(surfaces, ROOM, title=rf"{title}: $|\psi|^2$ = {LEVEL:g}")
    yield "vortex-lines-surfaces.png", figure.savefig


def _slice(made: QuenchStudy, moved: Motion, k: int) -> Any:
    from ...plotting import FieldPanel

    grid = made.quench.equation.grid
    density = np.abs(_field(made, k)[:, :, grid.shape[2] // 2]) ** 2
    shown = cropped(density, grid, (0, 1), SLICE)
    return FieldPanel(*shown, ("x", "y"), moved.vortices[k].positions, moved.followed(k))


def _surface(made: QuenchStudy, moved: Motion, k: int) -> Any:
    """The surface, and the sector of it in which the line is that is followed."""
    from ...plotting import SurfacePanel

    surface = density_surface(made.quench.equation, _field(made, k), LEVEL)
    x, y, _ = surface.corners.mean(axis=1).T
    followed = np.abs(moved.off(k, x, y)) < np.pi / len(moved.vortices[k].charges)
    return SurfacePanel(surface.corners, np.where(surface.inside, 1 + followed, 0))


def _field(made: QuenchStudy, k: int) -> np.ndarray:
    assert made.fields is not None
    return made.quench.equation.as_field(made.fields[:, k])
