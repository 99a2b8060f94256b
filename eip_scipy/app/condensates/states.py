"""``eip-scipy gpe ground-state``: ground states in a harmonic trap, the paper's ring, and its vortex lines."""

from __future__ import annotations

import argparse
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...problems.gross_pitaevskii import (
    Grid,
    GrossPitaevskii,
    GroundState,
    ground_state,
    harmonic_trap,
    imprint,
    line_condensate,
    lowest_ring,
    polygon,
    ring_condensate,
    vortex_starts,
    vortices,
    with_noise,
)
from ..report import (
    UsageError,
    check_outputs,
    compact,
    deliver,
    describe_machine,
    table,
    warn,
    write_file,
)

__all__ = [
    "LINES",
    "LINES_ENERGY",
    "SADDLE_ENERGY",
    "SADDLE_LINES",
    "SCENES",
    "Found",
    "kept_state",
    "leave_saddle",
    "load_state",
    "run",
    "save_state",
    "search_ring",
    "search_saddle",
    "searching",
]

DONE, FAILED, INTERRUPTED = 0, 1, 130
# V = r^2 / 2, beta = 100: angular velocity and published energy.
PUBLISHED = {0.0: 3.9459469, 0.65: 3.6506129, 0.71: 3.4997148, 0.76: 3.3475310, 0.80: 3.1904172}
PUBLISHED_DIGITS = 1e-5
RING_ENERGY, LINES_ENERGY, LINES = -115.270, 3.3029, 2
SADDLE_ENERGY, SADDLE_LINES = 3.3293, 4  # of the state in the paper's figure
TRAP_POINTS, RING_POINTS, LINE_POINTS = 128, 256, 64
TRAP_TOLERANCE, RING_TOLERANCE, LINES_TOLERANCE, SADDLE_TOLERANCE = 1e-6, 1e-8, 1e-5, 1e-8
MOST_LINES, LINES_RADIUS, LINES_ITERATIONS = 4, 1.5, 1000
VISIBLE, MARGIN = 1e-3, 1.15  # part of the density that a figure shows, and the room around it
Update = Callable[[str], Any]
Ends = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Found:
    """A stationary state and where it came from.

    Attributes
    ----------
    label : str
        What told its start from the others.
    equation : GrossPitaevskii
    state : GroundState
    published : float or None
    """

    label: str
    equation: GrossPitaevskii
    state: GroundState
    published: float | None = None

    @property
    def count(self) -> int:
        """Number of vortices, in three dimensions in the middle plane."""
        return len(vortices(self.equation, self.state.psi).charges)


def trap(args: argparse.Namespace, update: Update) -> list[Found]:
    """The lowest of several starts for each rotation."""
    grid = Grid((TRAP_POINTS, TRAP_POINTS), -10.0, 10.0)
    found = []
    for Omega, published in PUBLISHED.items():
        gpe = GrossPitaevskii(grid, harmonic_trap(1.0, 1.0), Omega=Omega, beta=100.0)
        states = []
        for start in vortex_starts(gpe, args.starts if Omega else 1, args.seed):
            update(f"trap, Omega = {Omega:g}")
            states.append(ground_state(gpe, start, tol=TRAP_TOLERANCE))
        best = min(states, key=lambda state: state.energy)
        found.append(Found(f"Omega = {Omega:.2f}", gpe, best, published))
    return found


def ring(args: argparse.Namespace, update: Update) -> list[Found]:
    """The paper's ring."""
    return [search_ring(args.seed, update)]


def search_ring(seed: int, update: Update) -> Found:
    """Walk over numbers of vortices and windings to the ground state of the paper's ring."""
    gpe = ring_condensate(points=RING_POINTS)
    tried: list[tuple[float, int, int]] = []

    def report(count: int, winding: int, energy: float) -> None:
        tried.append((energy, count, winding))
        update(f"ring, {count} vortices around a winding of {winding}")

    state = lowest_ring(gpe, tol=RING_TOLERANCE, seed=seed, report=report)
    _, count, winding = min(tried)
    return Found(f"{count} around {winding}", gpe, state)


def lines(args: argparse.Namespace, update: Update) -> list[Found]:
    """States of the paper's 3D condensate from starts with 0 ... 4 lines, and the saddle with four."""
    gpe = line_condensate(points=LINE_POINTS)
    rng = np.random.default_rng(args.seed)
    found = []
    for count in range(MOST_LINES + 1):
        update(f"lines, {count} imprinted")
        start = with_noise(imprint(gpe, polygon(count, LINES_RADIUS if count > 1 else 0.0)), rng)
        state = ground_state(gpe, start, tol=LINES_TOLERANCE, max_iterations=LINES_ITERATIONS)
        found.append(Found(f"{count} imprinted", gpe, state))
    return [*found, search_saddle(update)]


def search_saddle(update: Update) -> Found:
    """The paper's state with four lines, a saddle: the start has a square's symmetry, and the descent keeps it."""
    update(f"lines, {SADDLE_LINES} imprinted without noise")
    gpe = line_condensate(points=LINE_POINTS)
    start = imprint(gpe, polygon(SADDLE_LINES, LINES_RADIUS))
    return Found(f"{SADDLE_LINES} without noise: a saddle", gpe, ground_state(gpe, start, tol=SADDLE_TOLERANCE))


def leave_saddle(gpe: GrossPitaevskii, saddle: np.ndarray, seed: int, update: Update) -> Found:
    """Where the descent goes from a state with a little noise: from a saddle to a lower state."""
    update("lines, down from the saddle")
    start = with_noise(saddle, np.random.default_rng(seed))
    state = ground_state(gpe, start, tol=LINES_TOLERANCE, max_iterations=LINES_ITERATIONS)
    return Found("down from the saddle", gpe, state)


SCENES: dict[str, Callable[[argparse.Namespace, Update], list[Found]]] = {"trap": trap, "ring": ring, "lines": lines}
TITLES = {
    "trap": "trap: V = r^2 / 2, beta = 100; lowest of {starts} starts for each Omega",
    "ring": "ring: V = -0.1 r^2 + 0.075 r^4, beta = 1000, Omega = 3.5; a row of vortices around a winding",
    "lines": "lines: V = (x^2 + y^2 + z^2 / 4) / 2, beta = 400, Omega = 0.7; by lines imprinted on the start",
}
Results = dict[str, list[Found]]


def checks(results: Results) -> list[dict[str, Any]]:
    """Compare with known energies.

    Returns
    -------
    list of dict
        With `quantity`, `known`, `ours`, `matched` and `note`. A lower energy than a published one is no miss.
    """
    found = []
    for item in results.get("trap", ()):
        known, ours = PUBLISHED[item.equation.Omega], item.state.energy
        below = ours < known - PUBLISHED_DIGITS
        matched = item.state.converged and (below or abs(ours - known) <= PUBLISHED_DIGITS)
        found.append(_check(f"trap, {item.label}: E", known, ours, matched, "lower" if below else ""))
    for item in results.get("ring", ()):
        good = item.state.converged and item.state.energy <= RING_ENERGY
        found.append(_check("ring: E at most", RING_ENERGY, item.state.energy, good))
    if "lines" in results:
        best = min(results["lines"], key=lambda item: item.state.energy)
        good = best.state.converged and abs(best.state.energy - LINES_ENERGY) < 1e-4
        found.append(_check("lines: lowest E", LINES_ENERGY, best.state.energy, good))
        found.append(_check("lines: of the lowest", LINES, best.count, best.count == LINES))
        saddle = results["lines"][-1]
        good = saddle.state.converged and abs(saddle.state.energy - SADDLE_ENERGY) < 1e-4
        found.append(_check("lines: E of the saddle", SADDLE_ENERGY, saddle.state.energy, good))
        found.append(_check("lines: of the saddle", SADDLE_LINES, saddle.count, saddle.count == SADDLE_LINES))
    return found


def _check(quantity: str, known: float, ours: float, matched: bool, note: str = "") -> dict[str, Any]:
    return {"quantity": quantity, "known": known, "ours": ours, "matched": bool(matched), "note": note}


def text(results: Results, starts: int, machine: str) -> str:
    """Lay out a table for each scene, and the checks."""
    head = [["E"], ["mu"], ["residual"], ["iterations"], ["vortices"]]
    out = ["Ground states of the rotating Gross-Pitaevskii equation", f"{machine}; residual: norm of H psi - mu psi."]
    for name, found in results.items():
        gpe = found[0].equation
        size = " x ".join(map(str, gpe.grid.shape))
        out += ["", f"{TITLES[name].format(starts=starts)}", f"{size} points", ""]
        known = [["published"], ["difference"]] if name == "trap" else []
        out.append(table([*head, *known], [(item.label, _cells(item)) for item in found]))
        out += [f"  {item.label}: {item.state.message}" for item in found if not item.state.converged]
    out.append("")
    for check in checks(results):
        note = f" ({check['note']})" if check["note"] else ""
        numbers = f"{check['known']:.10g}, ours {check['ours']:.10g}{note}"
        out.append(f"{'ok' if check['matched'] else 'FAILED':<6} {check['quantity']} {numbers}")
    return "\n".join(out)


def _cells(item: Found) -> list[str]:
    state = item.state
    numbers = [f"{state.energy:.8f}", f"{state.mu:.8f}", compact(state.residual), str(state.iterations)]
    known = [] if item.published is None else [f"{item.published:.7f}", f"{state.energy - item.published:+.1e}"]
    return [*numbers, str(item.count), *known]


def rows(results: Results) -> list[dict[str, Any]]:
    """Make the lines of the CSV file."""
    return [
        {
            "scene": name,
            "start": item.label,
            "Omega": item.equation.Omega,
            "beta": item.equation.beta,
            "energy": item.state.energy,
            "published": item.published,
            "mu": item.state.mu,
            "residual": item.state.residual,
            "iterations": item.state.iterations,
            "converged": item.state.converged,
            "vortices": item.count,
        }
        for name, found in results.items()
        for item in found
    ]


def run(args: argparse.Namespace) -> int:
    """Run ``gpe ground-state``; see `eip_scipy.app.condensates.gpe.run`."""
    check_outputs(args.out, args.json)
    names = list(dict.fromkeys(args.scene or SCENES))
    try:
        with searching(args) as update:
            results = {name: SCENES[name](args, update) for name in names}
    except KeyboardInterrupt:
        warn("interrupted; nothing was written")
        return INTERRUPTED
    found, judged = rows(results), checks(results)
    arguments = {"scenes": list(results), "starts": args.starts, "seed": args.seed}
    tables = {"ground-states.csv": found}
    deliver(
        args,
        "gpe ground-state",
        text(results, args.starts, describe_machine()),
        tables,
        _figures(results),
        arguments,
        also=_states(args, results),
        states=found,
        checks=judged,
    )
    return DONE if all(check["matched"] for check in judged) else FAILED


def _states(args: argparse.Namespace, results: Results) -> Iterator[Path]:
    for name, found in results.items():
        if name != "trap":
            yield save_state(args.out / f"{name}.npz", min(found, key=lambda item: item.state.energy))


def _figures(results: Results) -> Iterator[tuple[str, Any]]:
    from ...plotting import fields_figure

    for name, found in results.items():
        shown = panels(name, found)
        figure = fields_figure(shown, title=TITLES[name].split(";")[0], columns=3 if len(shown) <= 6 else 4)
        yield f"ground-state-{name}.png", figure


def panels(name: str, found: list[Found]) -> dict[str, Any]:
    """Densities to draw: one panel for each state, of lines in the plane z = 0 and of the lowest in x = 0 too."""
    from ...plotting import FieldPanel

    out = {}
    for item in found:
        grid = item.equation.grid
        density = np.abs(item.state.psi) ** 2
        if grid.dim == 3:
            density = density[:, :, grid.shape[2] // 2]
        where = vortices(item.equation, item.state.psi).positions
        kind = "line" if name == "lines" else "vortex"
        title = f"{item.label}\nE = {item.state.energy:.6f}, {_counted(item.count, kind)}"
        out[title] = FieldPanel(*cropped(density, grid, (0, 1)), ("x", "y"), where)
    if name == "lines":
        item = min(found, key=lambda item: item.state.energy)
        grid = item.equation.grid
        side = np.abs(item.state.psi[grid.shape[0] // 2]) ** 2
        out["the lowest, x = 0"] = FieldPanel(*cropped(side, grid, (1, 2)), ("y", "z"), np.zeros((0, 2)))
    return out


def _counted(count: int, kind: str) -> str:
    plural = {"vortex": "vortices", "line": "lines"}[kind]
    return f"{count or 'no'} {kind if count == 1 else plural}"


def cropped(
    density: np.ndarray, grid: Grid, axes: tuple[int, int], half: float | None = None
) -> tuple[np.ndarray, Ends]:
    """The middle of a plane, by default with little of the empty space around the condensate, and its ends."""
    if half is None:
        seen = (np.any(density > VISIBLE * density.max(), axis=1 - k) for k in (0, 1))
        half = MARGIN * max(float(np.abs(grid.points(a)[there]).max()) for a, there in zip(axes, seen, strict=True))
    keep = [np.flatnonzero(np.abs(grid.points(axis)) <= half) for axis in axes]
    a, b, c, d = (
        float(grid.points(axis)[k[edge]] + shift * grid.spacing[axis])
        for axis, k in zip(axes, keep, strict=True)
        for edge, shift in ((0, -0.5), (-1, 0.5))
    )
    return density[np.ix_(*keep)], (a, b, c, d)


def save_state(path: Path, item: Found) -> Path:
    """Write a state as an npz file without pickled objects."""
    gpe, state = item.equation, item.state
    content: dict[str, Any] = {
        "psi": state.psi,
        "V": gpe.V,
        "lower": gpe.grid.lower,
        "upper": gpe.grid.upper,
        "Omega": gpe.Omega,
        "beta": gpe.beta,
        "energy": state.energy,
        "mu": state.mu,
        "residual": state.residual,
    }
    return write_file(path, lambda temporary: np.savez_compressed(temporary, **content))


@contextmanager
def searching(args: argparse.Namespace) -> Iterator[Update]:
    """Show what is searched, and for how long, unless ``--quiet``; yields what takes the words for it."""
    from tqdm import tqdm

    with tqdm(bar_format="{desc} [{elapsed}]", disable=args.quiet, leave=False) as bar:
        yield bar.set_description_str


def kept_state(args: argparse.Namespace, gpe: GrossPitaevskii, search: Callable[[Update], Found]) -> np.ndarray:
    """The field to start from: with ``--resume`` the one beside the checkpoints, else the one that `search` finds.

    Parameters
    ----------
    args : argparse.Namespace
        With ``checkpoint``, ``resume`` and ``quiet``.
    gpe : GrossPitaevskii
    search : callable
        ``search(update)``.

    Returns
    -------
    ndarray, shape (J, K[, L])
    """
    kept = None if args.checkpoint is None else args.checkpoint / "state.npz"
    if kept is not None and args.resume and kept.exists():
        return load_state(kept, gpe)
    with searching(args) as update:
        found = search(update)
    if kept is not None:
        save_state(kept, found)
    return found.state.psi


def load_state(path: Path, gpe: GrossPitaevskii) -> np.ndarray:
    """Read the field of a state of `save_state`, which must be one of `gpe`.

    Raises
    ------
    UsageError
        When the file cannot be read, or holds a state of another grid or equation.
    """
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            content = {name: file[name] for name in ("psi", "V", "lower", "upper", "Omega", "beta")}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UsageError(f"cannot read a state from {str(path)!r}: {error}") from error
    expected: dict[str, Any] = {
        "lower": gpe.grid.lower,
        "upper": gpe.grid.upper,
        "Omega": gpe.Omega,
        "beta": gpe.beta,
        "V": gpe.V,
    }
    for name, value in expected.items():
        if np.shape(value) != content[name].shape or not np.allclose(value, content[name], rtol=1e-12):
            raise UsageError(f"{str(path)!r} holds a state of another equation: its {name} differs from {gpe!r}")
    psi = content["psi"]
    if psi.shape != gpe.grid.shape or psi.dtype.kind != "c" or not np.isfinite(psi).all():
        raise UsageError(f"{str(path)!r}: psi must be a finite complex field of shape {gpe.grid.shape}")
    return psi
