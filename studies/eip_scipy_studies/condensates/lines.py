"""``eip-scipy gpe vortex-lines``: the paper's condensate in three dimensions after its rotation is made faster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy.problems import GrossPitaevskii

from ..report import compact, warn
from ..study import Check, Figures, Session
from .problems import line_condensate
from .runs import REFERENCE, SHOWN, Motion, QuenchRuns, QuenchStudy, field_check
from .splitting import rotated
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
from .vortices import density_surface, vortices

OMEGA_BEFORE, OMEGA_AFTER = 0.7, 0.9
LEVEL = 1e-3  # of the paper's surfaces
SLICE = 5.0  # half the side of the paper's slices
ROOM = ((-4.0, 4.0), (-4.0, 4.0), (-6.0, 6.0))


@dataclass(frozen=True, kw_only=True)
class VortexLines(QuenchStudy):
    """Command ``eip-scipy gpe vortex-lines``: in the round trap the state keeps its slower rotation, and lags behind.

    `energies_known` is the allowed error of the known energies, of the start (a saddle) and of the lower state, and
    `turn_known` that of the angle of the lines [rad], 0.1 of the distance between two points of the grid there.
    """

    points: int = LINE_POINTS
    t_end: float = 20.0
    stem: str = "vortex-lines"
    step: float = 5e-3
    reference_step: float = 1e-2
    saved: float = 1.0
    snapshots: tuple[float, ...] = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0)
    sense: int = -1
    energy_kept: float = 1e-13
    energies_known: float = 1e-4
    turn_known: float = 0.02

    @property
    def title(self) -> str:
        return f"Vortex lines, Omega = {OMEGA_BEFORE:g} -> {OMEGA_AFTER:g}"

    def measure(self, session: Session) -> QuenchRuns:
        """Find the stationary state, show that it is a saddle of the energy, and do all runs from it."""
        before, after = (line_condensate(Omega, self.points) for Omega in (OMEGA_BEFORE, OMEGA_AFTER))
        start = kept_state(self, session, before, lambda update: search_saddle(self.points, update))
        with searching(session) as update:
            lower = leave_saddle(before, start, self.seed, update)
        made = self.do_runs(after, start, session)
        assert made.moved is not None
        made.more = [*self._state_checks(before, start, lower), self._turn_check(made.moved)]
        made.notes = [*_state_notes(before, start, lower), _grid_note(before, made, made.moved.t)]
        return made

    def _state_checks(self, gpe: GrossPitaevskii, start: np.ndarray, lower: Found) -> list[Check]:
        saddle, count, state = gpe.energy(start), len(vortices(gpe, start).charges), lower.state
        below = state.converged and abs(state.energy - LINES_ENERGY) < self.energies_known
        return [
            field_check(f"E of the start {SADDLE_ENERGY}", saddle, abs(saddle - SADDLE_ENERGY) < self.energies_known),
            field_check(f"lines of the start, {SADDLE_LINES}", count, count == SADDLE_LINES),
            field_check(f"E below that saddle {LINES_ENERGY}", state.energy, below),
            field_check(f"lines there, {LINES}", lower.count, lower.count == LINES),
        ]

    def _turn_check(self, moved: Motion) -> Check:
        """Check the angle by which the lines turn, which should be the difference of the rotations times t."""
        slower = OMEGA_BEFORE - OMEGA_AFTER
        off = float(np.abs(moved.angle - slower * moved.t).max())
        return field_check(f"angle off {slower:.1f} t by less than {self.turn_known:g} rad", off, off < self.turn_known)

    def pictures(self, found: QuenchRuns) -> Figures:
        """Draw the plane z = 0, and surfaces of equal density."""
        from ..plotting import fields_figure, surfaces_figure

        moved = found.moved
        assert moved is not None
        title, times = f"{self.title}, {SHOWN}", self.shown(moved.t)
        slices = {f"t = {moved.t[k]:g}": _slice(found, moved, k) for k in times}
        yield (
            "vortex-lines-slices.png",
            fields_figure(slices, title=f"{title}: density in the plane z = 0", shared=True),
        )
        try:
            surfaces = {f"t = {moved.t[k]:g}": _surface(found, moved, k) for k in times}
        except ImportError as error:
            warn(f"no surfaces: {error}")
            return
        yield "vortex-lines-surfaces.png", surfaces_figure(surfaces, ROOM, title=rf"{title}: $|\psi|^2$ = {LEVEL:g}")


def _state_notes(gpe: GrossPitaevskii, start: np.ndarray, lower: Found) -> list[str]:
    residual = 1j * gpe.fun(0.0, start) - chemical_potential(gpe, start) * start
    return [
        f"Start: {len(vortices(gpe, start).charges)} lines, E = {gpe.energy(start):.8f}, residual "
        f"{compact(float(np.sqrt(gpe.mass(residual))))}: a saddle. A little noise, and the descent",
        f"goes on to {lower.count} lines, E = {lower.state.energy:.8f}, residual {compact(lower.state.residual)}",
    ]


def chemical_potential(gpe: GrossPitaevskii, psi: np.ndarray) -> float:
    """Return the mean of H."""
    return float(np.vdot(psi, 1j * gpe.fun(0.0, psi)).real / np.vdot(psi, psi).real)


def _grid_note(before: GrossPitaevskii, made: QuenchRuns, t: np.ndarray) -> str:
    """Return a line with the distance of the reference's end from the start, turned and multiplied by exp(-i mu t)."""
    assert made.reference is not None
    start = made.problem.y0
    mu, turn = chemical_potential(before, start), OMEGA_AFTER - OMEGA_BEFORE
    exact = rotated(before, start, turn * t[-1]).reshape(-1) * np.exp(-1j * mu * t[-1])
    off = np.sqrt(before.mass(made.reference[:, -1] - exact))
    return (
        f"{REFERENCE} ends {compact(float(off))} from the start turned by {-turn * t[-1]:g} rad: the error of the grid"
    )


def _slice(made: QuenchRuns, moved: Motion, k: int) -> Any:
    from ..plotting import FieldPanel

    grid = made.equation.grid
    density = np.abs(_field(made, k)[:, :, grid.shape[2] // 2]) ** 2
    shown = cropped(density, grid, (0, 1), SLICE)
    return FieldPanel(*shown, ("x", "y"), moved.vortices[k].positions, moved.followed(k))


def _surface(made: QuenchRuns, moved: Motion, k: int) -> Any:
    """Return the surface of equal density `LEVEL` in the k-th saved state, with the line `Motion.followed` marked."""
    from ..plotting import SurfacePanel

    surface = density_surface(made.equation, _field(made, k), LEVEL)
    x, y, _ = surface.corners.mean(axis=1).T
    followed = np.abs(moved.off(k, x, y)) < np.pi / len(moved.vortices[k].charges)
    return SurfacePanel(surface.corners, np.where(surface.inside, 1 + followed, 0))


def _field(made: QuenchRuns, k: int) -> np.ndarray:
    assert made.fields is not None
    return made.equation.as_field(made.fields[:, k])
