"""Figures of condensates: densities with vortices, surfaces in space, errors in time, error against cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

# Imported first, because its error says how matplotlib is installed.
from eip_scipy.plotting import PALETTE, log_errors, method_styles, typeset  # isort: skip
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource, to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from eip_scipy.problems import Grid

from ..plot import blank_figure, cost_figure, envelope, legend_below
from .vortices import density_surface, vortices

if TYPE_CHECKING:
    from .efficiency import Trial
    from .quench import Quench
    from .states import Found

DENSITY = r"density $|\psi|^2$"
VISIBLE, MARGIN = 1e-3, 1.15  # part of the density that a figure shows, and the margin around it
ROOM, VIEW = ((-4, 4), (-4, 4), (-6, 6)), (28.0, -62.0)  # ends of x, y and z, and view point of surfaces [degrees]
LEVEL, VEIL = 1e-3, 0.13  # density on the paper's surfaces, and opacity of their outside


class Panel(NamedTuple):
    """A density in a plane, its ends along x and y, positions to mark, and the index of one of them."""

    density: np.ndarray
    ends: tuple[float, float, float, float]
    vortices: np.ndarray
    followed: int | None = None


def cropped(density: np.ndarray, grid: Grid, half: float | None = None) -> tuple[Any, Any]:
    """Return the middle part of a density in the plane of x and y, to `half` or its visible end, and its ends."""
    if half is None:
        seen = (np.any(density > VISIBLE * density.max(), axis=1 - k) for k in (0, 1))
        half = MARGIN * max(float(np.abs(grid.points(axis)[there]).max()) for axis, there in enumerate(seen))
    keep = [np.flatnonzero(np.abs(grid.points(axis)) <= half) for axis in (0, 1)]
    ends = tuple(
        float(grid.points(axis)[k[edge]] + shift * grid.spacing[axis])
        for axis, k in enumerate(keep)
        for edge, shift in ((0, -0.5), (-1, 0.5))
    )
    return density[np.ix_(*keep)], ends


def states_figure(found: Sequence[Found], title: str) -> Figure:
    """Draw densities; those in three dimensions are shown in the plane z = 0."""
    shown, volume = {}, found[0].equation.grid.dim == 3
    for item in found:
        grid, density = item.equation.grid, np.abs(item.state.psi) ** 2
        plane = density[:, :, grid.shape[2] // 2] if volume else density
        name = f"{item.label}\nE = {item.state.energy:.6f}, {'lines' if volume else 'vortices'}: {item.count}"
        shown[name] = Panel(*cropped(plane, grid), vortices(item.equation, item.state.psi).positions)
    return fields_figure(shown, title)


def moving_panels(quench: Quench, densities: np.ndarray, half: float | None = None) -> list[Panel]:
    """Return a panel for each of the densities in one plane, which all show what the condensate reaches in any."""
    grid, moved = quench.equation.grid, quench.moved
    assert moved is not None
    if half is None:
        half = cropped(densities.max(axis=0), grid)[1][1] - 0.5 * float(grid.spacing[0]) + 1e-9
    return [
        Panel(*cropped(density, grid, half), moved.vortices[k].positions, moved.followed(k))
        for k, density in enumerate(densities)
    ]


def snapshots_figure(quench: Quench, densities: np.ndarray, half: float | None) -> Figure:
    """Draw densities in a plane at the snapshots."""
    panels = moving_panels(quench, densities, half)
    shown = {name: panels[k] for name, k in quench.shown().items()}
    return fields_figure(shown, f"{quench.title}: density and vortices, EIP-ME")


def movie(quench: Quench, densities: np.ndarray) -> Callable[[Path], None]:
    """Return a function that writes an animated GIF with a frame for each density, on one colour scale."""
    panels, times = moving_panels(quench, densities), quench.runs["EIP-ME"].t
    figure = Figure(figsize=(5.2, 4.6), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    axis, top = figure.subplots(), float(densities.max())

    def frame(k: int) -> Any:
        axis.clear()
        return _draw(axis, f"t = {times[k]:.2f}", panels[k], top)

    figure.colorbar(frame(0), ax=axis, shrink=0.84, pad=0.02, label=DENSITY)
    film, writer = FuncAnimation(figure, frame, frames=len(panels)), PillowWriter(fps=8)
    return lambda path: film.save(path, writer=writer)


def fields_figure(panels: Mapping[str, Panel], title: str) -> Figure:
    """Draw densities by title with their vortices, on one colour scale."""
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = blank_figure(max(4.1 * columns, 6.5), 3.9 * rows + 0.4, title)
    axes = figure.subplots(rows, columns, squeeze=False)
    top = max(float(np.max(panel.density)) for panel in panels.values())
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (name, panel) in zip(axes.flat, panels.items(), strict=False):
        image = _draw(axis, name, panel, top)
    figure.colorbar(image, ax=list(axes.flat), shrink=0.8, pad=0.02, label=DENSITY)
    return figure


def _draw(axis: Any, title: str, panel: Panel, top: float) -> Any:
    """Draw one density and its vortices, with colours up to `top`, and return the image, for a colour scale."""
    density, ends, where, followed = panel
    image = axis.imshow(
        density.T, origin="lower", extent=ends, cmap="viridis", vmin=0.0, vmax=top, interpolation="bilinear"
    )
    if where.size:
        axis.plot(*where.T, ls="", marker="o", mfc="none", mec=PALETTE[1], mew=0.9, ms=5)
    if followed is not None:
        axis.plot(*where[followed], ls="", marker="o", mfc=PALETTE[2], mec="white", mew=0.9, ms=7)
    axis.set_title(typeset(title), fontsize="medium")
    axis.set(xlabel="x", ylabel="y")
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10)))
    return image


def surfaces_figure(quench: Quench) -> Figure:
    """Draw surfaces of equal density, transparent outside, opaque around vortex lines, the followed one in red."""
    moved, fields, shown = quench.moved, quench.equation.grid.field(quench.runs["EIP-ME"].y), quench.shown()
    assert moved is not None
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    title = rf"{quench.title}, EIP-ME: $|\psi|^2$ = {LEVEL:g}"
    figure = blank_figure(3.4 * columns, 4.1 * rows + 0.4, title)
    for place, (name, k) in enumerate(shown.items(), 1):
        corners, inside = density_surface(quench.equation, fields[k], LEVEL)
        x, y, _ = corners.mean(axis=1).T
        followed = np.abs(moved.off(k, x, y)) < np.pi / len(moved.vortices[k].charges)
        axis: Any = figure.add_subplot(rows, columns, place, projection="3d", proj_type="ortho")
        colours = np.array([to_rgba(PALETTE[5], VEIL), to_rgba(PALETTE[0]), to_rgba(PALETTE[2])])
        shown_part = np.where(inside, 1 + followed, 0)
        light = LightSource(VIEW[1] - 30, VIEW[0] + 15)
        axis.add_collection3d(
            Poly3DCollection(corners, facecolors=colours[shown_part], lw=0, shade=True, lightsource=light)
        )
        axis.view_init(*VIEW)
        axis.set(xlim=ROOM[0], ylim=ROOM[1], zlim=ROOM[2], xlabel="x", ylabel="y", zlabel="z")
        axis.set_box_aspect([high - low for low, high in ROOM], zoom=0.98)
        axis.set_title(name, fontsize="medium")
        for side in (axis.xaxis, axis.yaxis, axis.zaxis):
            side.set_major_locator(MaxNLocator(4, steps=(2, 5, 10)))
    return figure


def errors_figure(quench: Quench) -> Figure:
    """Draw the errors of mass and energy, relative, and of the field in time."""
    sizes = {"mass": abs(quench.equation.mass(quench.start)), "energy": abs(quench.equation.energy(quench.start))}
    labels = {
        "mass": "relative error of mass",
        "energy": "relative error of energy",
        "field": r"error of $\psi$ (norm)",
    }
    figure = blank_figure(11.7, 4.4, f"{quench.title}, RK4, h = {quench.h:g}")
    axes = figure.subplots(1, 3, sharex=True)
    styles = method_styles(name for name in quench.runs if name != "EIPDOP853")
    for axis, (item, label) in zip(axes, labels.items(), strict=True):
        for name, style in styles.items():
            envelope(axis, quench.runs[name].t, quench.errors[name][f"{item}_error"] / sizes.get(item, 1.0), style)
        log_errors(axis, "t", label)
    legend_below(figure, axes[0])
    return figure


def efficiency_figure(found: Mapping[str, Trial], key: str, cost: str) -> Figure:
    """Draw the errors of each wave against one of the columns."""
    panels = [
        (wave, {name: (trial.column(name, key), trial.column(name, "error_max")) for name in trial.single})
        for wave, trial in found.items()
    ]
    return cost_figure(panels, cost=cost, error=r"max $|\delta\psi|$ at t = 1", title="NLS equation: accuracy and cost")
