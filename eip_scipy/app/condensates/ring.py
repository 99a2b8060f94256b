"""``eip-scipy gpe ring``: the paper's ring after its trap is tightened; vortices and invariants in time."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...problems import GrossPitaevskii
from ...problems.gross_pitaevskii import ring_condensate
from .. import long_runs
from ..report import UsageError, check_outputs, warn
from .runs import SHOWN, Figures, Motion, Quench, QuenchStudy, conclude, motion, study
from .states import cropped, kept_state, load_state, search_ring

__all__ = ["T_END", "run"]

INTERRUPTED = 130
POINTS, STEP, T_END = 256, 2e-4, 1.0
REFERENCE_STEP = 5e-4
SAVED = 0.02  # time between two saved states
KAPPA_BEFORE, KAPPA_AFTER = 0.3, 0.7
SNAPSHOTS = (0.0, 0.24, 0.44, 0.72, 0.8, 1.0)
# The tightened ring contracts, keeps its angular momentum, and so turns faster than the frame.
SENSE = 1
ENERGY_KEPT = 1e-12
FRAMES_PER_SECOND = 8


def run(args: argparse.Namespace) -> int:
    """Run ``gpe ring``; see `eip_scipy.app.condensates.gpe.run`."""
    if args.t_end < REFERENCE_STEP:
        raise UsageError(f"--t-end: expected at least {REFERENCE_STEP:g}, the reference's step, got {args.t_end:g}")
    check_outputs(args.out, args.json)
    long_runs.check(args)
    after = ring_condensate(KAPPA_AFTER, POINTS)
    try:
        start = _start(args)
    except KeyboardInterrupt:
        warn("interrupted in the search for the ground state; nothing was written")
        return INTERRUPTED
    quench = Quench(
        name="ring",
        title=f"Ring, kappa = {KAPPA_BEFORE:g} -> {KAPPA_AFTER:g}",
        problem=after.problem(start, args.t_end, STEP, name="ring"),
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
    return conclude(args, made, moved, figures=partial(_figures, args, made, moved))


def _start(args: argparse.Namespace) -> np.ndarray:
    """The ground state: from a file, from beside the checkpoints, or searched."""
    before = ring_condensate(KAPPA_BEFORE, POINTS)
    if args.start is not None:
        return load_state(args.start, before)
    return kept_state(args, before, partial(search_ring, args.seed))


def _figures(args: argparse.Namespace, made: QuenchStudy, moved: Motion) -> Figures:
    from ...plotting import fields_figure, fields_movie

    quench, fields = made.quench, made.fields
    assert fields is not None
    every = _panels(quench.equation, fields, moved)
    shown = {f"t = {moved.t[k]:.2f}": every[k] for k in quench.shown(moved.t)}
    figure = fields_figure(shown, title=f"{quench.title}: density and vortices, {SHOWN}", shared=True)
    yield "ring-snapshots.png", figure.savefig
    if args.movie:
        titles = [f"t = {t:.2f}" for t in moved.t]

        def film(path: Path) -> None:
            fields_movie(path, every, titles, per_second=FRAMES_PER_SECOND)

        yield "ring.gif", film


def _panels(gpe: GrossPitaevskii, y: np.ndarray, moved: Motion) -> list[Any]:
    """One panel for each saved state, all of the first one's size, which is the largest."""
    from ...plotting import FieldPanel

    fields = np.abs(gpe.grid.field(y)) ** 2
    largest = fields.max(axis=0)
    _, ends = cropped(largest, gpe.grid, (0, 1))
    keep = [
        np.flatnonzero((gpe.grid.points(axis) > ends[2 * axis]) & (gpe.grid.points(axis) < ends[2 * axis + 1]))
        for axis in (0, 1)
    ]
    return [
        FieldPanel(field[np.ix_(*keep)], ends, ("x", "y"), moved.vortices[k].positions, moved.followed(k))
        for k, field in enumerate(fields)
    ]
