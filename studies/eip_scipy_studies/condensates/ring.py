"""``eip-scipy gpe ring``: the paper's ring after its trap is tightened; vortices and invariants in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy.problems import GrossPitaevskii

from ..long_runs import positive
from ..report import UsageError
from ..study import Figures, Session, option
from .problems import ring_condensate
from .runs import SHOWN, Motion, QuenchRuns, QuenchStudy
from .states import cropped, kept_state, load_state, search_ring

FRAMES_PER_SECOND = 8


@dataclass(frozen=True, kw_only=True)
class Ring(QuenchStudy):
    """Command ``eip-scipy gpe ring``.

    The tightened ring contracts, keeps its angular momentum, and so turns faster than the rotating frame, in which its
    vortices turn anticlockwise. `kappas` determine the trap before and after the quench.
    """

    start: Path | None = option(
        None,
        "ring.npz that `gpe ground-state` has written; default: the ground state is searched first",
        type=Path,
        metavar="FILE",
    )
    t_end: float = option(
        1.0, "end of the run (default: %(default)s); 10 in the paper's figure of the errors", type=positive, metavar="T"
    )
    movie: bool = option(False, "write ring.gif, too")
    condensate: Callable[[float, int], GrossPitaevskii] = ring_condensate
    points: int = 256
    kappas: tuple[float, float] = (0.3, 0.7)
    stem: str = "ring"
    step: float = 2e-4
    reference_step: float = 5e-4
    saved: float = 0.02
    snapshots: tuple[float, ...] = (0.0, 0.24, 0.44, 0.72, 0.8, 1.0)
    energy_kept: float = 1e-12

    def check_settings(self) -> None:
        """Raise an error if the run is shorter than a step of the reference."""
        if self.t_end < self.reference_step:
            least = f"{self.reference_step:g}, the reference's step"
            raise UsageError(f"--t-end: expected at least {least}, got {self.t_end:g}")
        super().check_settings()

    @property
    def title(self) -> str:
        return f"Ring, kappa = {self.kappas[0]:g} -> {self.kappas[1]:g}"

    def measure(self, session: Session) -> QuenchRuns:
        """Do all runs from the ground state."""
        before, after = (self.condensate(kappa, self.points) for kappa in self.kappas)
        if self.start is not None:
            start = load_state(self.start, before)
        else:
            start = kept_state(self, session, before, partial(search_ring, self.seed))
        return self.do_runs(after, start, session)

    def pictures(self, found: QuenchRuns) -> Figures:
        """Draw density and vortices at the times `snapshots` and, if `movie`, at all saved times as a movie."""
        from ..plotting import fields_figure, fields_movie

        fields, moved = found.fields, found.moved
        assert fields is not None
        assert moved is not None
        every = _panels(found.equation, fields, moved)
        shown = {f"t = {moved.t[k]:.2f}": every[k] for k in self.shown(moved.t)}
        yield (
            "ring-snapshots.png",
            fields_figure(shown, title=f"{self.title}: density and vortices, {SHOWN}", shared=True),
        )
        if self.movie:
            titles = [f"t = {t:.2f}" for t in moved.t]

            def film(path: Path) -> None:
                fields_movie(path, every, titles, per_second=FRAMES_PER_SECOND)

            yield "ring.gif", film


def _panels(gpe: GrossPitaevskii, y: np.ndarray, moved: Motion) -> list[Any]:
    """Return one panel for each saved state, a column of `y`, cropped to the region that the condensate reaches."""
    from ..plotting import FieldPanel

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
