"""``eip-scipy gpe ground-state``: ground states in a harmonic trap, the paper's ring, and its vortex lines."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy.problems import Grid, GrossPitaevskii

from ..long_runs import Checkpoints, number
from ..report import UsageError, compact, describe_machine, table, write_file
from ..study import Check, Figures, Rows, Session, Study, option, some_of
from .ground_state import GroundState, ground_state, imprint, lowest_ring, polygon, vortex_starts, with_noise
from .problems import harmonic_trap, line_condensate, ring_condensate
from .vortices import vortices

# V = r^2 / 2, beta = 100: angular velocity and published energy.
PUBLISHED = {0.0: 3.9459469, 0.65: 3.6506129, 0.71: 3.4997148, 0.76: 3.3475310, 0.80: 3.1904172}
PUBLISHED_DIGITS = 1e-5
RING_ENERGY, LINES_ENERGY, LINES = -115.270, 3.3029, 2
SADDLE_ENERGY, SADDLE_LINES = 3.3293, 4  # the state in the paper's figure
RING_POINTS, LINE_POINTS = 256, 64
TRAP_TOLERANCE, RING_TOLERANCE, LINES_TOLERANCE, SADDLE_TOLERANCE = 1e-6, 1e-8, 1e-5, 1e-8
MOST_LINES, LINES_RADIUS, LINES_ITERATIONS = 4, 1.5, 1000
VISIBLE, MARGIN = 1e-3, 1.15  # part of the density that a figure shows, and the margin around it
COUNT = number("an integer >= 1", lambda value: value >= 1, int)
Update = Callable[[str], Any]
OTHER = "Give another file, or leave out --resume or --start."
Ends = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Found:
    """A stationary state, and the `label` of the start from which it was found or, in the trap, of the equation."""

    label: str
    equation: GrossPitaevskii
    state: GroundState
    published: float | None = None

    @property
    def count(self) -> int:
        """Return the number of vortices; in three dimensions of those in the middle plane."""
        return len(vortices(self.equation, self.state.psi).charges)


def trap(settings: GroundStates, update: Update) -> list[Found]:
    """Return, for each angular velocity, the state of lowest energy; ``update(text)`` shows what is being computed."""
    grid = Grid((settings.trap_points, settings.trap_points), -10.0, 10.0)
    found = []
    for Omega, published in settings.published.items():
        gpe = GrossPitaevskii(grid, harmonic_trap(1.0, 1.0), Omega=Omega, beta=100.0)
        states = []
        for start in vortex_starts(gpe, settings.starts if Omega else 1, settings.seed):
            update(f"trap, Omega = {Omega:g}")
            states.append(ground_state(gpe, start, tol=TRAP_TOLERANCE))
        best = min(states, key=lambda state: state.energy)
        found.append(Found(f"Omega = {Omega:.2f}", gpe, best, published))
    return found


def search_ring(seed: int, update: Update) -> Found:
    """Search over numbers of vortices and windings for the ground state of the paper's ring; see `lowest_ring`."""
    gpe = ring_condensate(points=RING_POINTS)
    tried: list[tuple[float, int, int]] = []

    def report(count: int, winding: int, energy: float) -> None:
        tried.append((energy, count, winding))
        update(f"ring, {count} vortices around a winding of {winding}")

    state = lowest_ring(gpe, tol=RING_TOLERANCE, seed=seed, report=report)
    _, count, winding = min(tried)
    return Found(f"{count} around {winding}", gpe, state)


def lines(settings: GroundStates, update: Update) -> list[Found]:
    """Return states of the paper's 3D condensate from noisy starts with 0 ... 4 vortex lines, and last the saddle."""
    gpe = line_condensate(points=LINE_POINTS)
    rng = np.random.default_rng(settings.seed)
    found = []
    for count in range(MOST_LINES + 1):
        update(f"lines, {count} imprinted")
        start = with_noise(imprint(gpe, polygon(count, LINES_RADIUS if count > 1 else 0.0)), rng)
        state = ground_state(gpe, start, tol=LINES_TOLERANCE, max_iterations=LINES_ITERATIONS)
        found.append(Found(f"{count} imprinted", gpe, state))
    return [*found, search_saddle(LINE_POINTS, update)]


def search_saddle(points: int, update: Update) -> Found:
    """Return the paper's state with four vortex lines, on a grid with `points` points along each axis.

    It is a saddle of the energy, which the descent reaches because it keeps the square symmetry of the start.
    """
    update(f"lines, {SADDLE_LINES} imprinted without noise")
    gpe = line_condensate(points=points)
    start = imprint(gpe, polygon(SADDLE_LINES, LINES_RADIUS))
    return Found(f"{SADDLE_LINES} without noise: a saddle", gpe, ground_state(gpe, start, tol=SADDLE_TOLERANCE))


def leave_saddle(gpe: GrossPitaevskii, saddle: np.ndarray, seed: int, update: Update) -> Found:
    """Return the lower state to which the descent of the energy leads from the field `saddle` with a little noise."""
    update("lines, down from the saddle")
    start = with_noise(saddle, np.random.default_rng(seed))
    state = ground_state(gpe, start, tol=LINES_TOLERANCE, max_iterations=LINES_ITERATIONS)
    return Found("down from the saddle", gpe, state)


Scene = Callable[["GroundStates", Update], list[Found]]
SCENES: dict[str, Scene] = {
    "trap": trap,
    "ring": lambda settings, update: [search_ring(settings.seed, update)],
    "lines": lines,
}
TITLES = {
    "trap": "trap: V = r^2 / 2, beta = 100; lowest of {starts} starts for each Omega",
    "ring": "ring: V = -0.1 r^2 + 0.075 r^4, beta = 1000, Omega = 3.5; a row of vortices around a winding",
    "lines": "lines: V = (x^2 + y^2 + z^2 / 4) / 2, beta = 400, Omega = 0.7; by lines imprinted on the start",
}
Results = dict[str, list[Found]]


def _known(quantity: str, known: float, ours: float, matched: bool, note: str = "") -> Check:
    text = f"{quantity} {known:.10g}, ours {ours:.10g}{f' ({note})' if note else ''}"
    return Check(text, matched, {"quantity": quantity, "known": known, "ours": ours, "matched": matched, "note": note})


@dataclass(frozen=True, kw_only=True)
class GroundStates(Study[Results]):
    """Command ``eip-scipy gpe ground-state``."""

    scene: Sequence[str] | None = some_of("scene", SCENES)
    starts: int = option(
        4,
        "starts for each angular velocity in the trap (default: %(default)s)",
        type=COUNT,
        metavar="N",
    )
    seed: int = option(0, "seed of the random starts (default: %(default)s)", type=int, metavar="N")
    scenes: Mapping[str, Scene] = field(default_factory=lambda: SCENES)
    published: Mapping[float, float] = field(default_factory=lambda: PUBLISHED)
    trap_points: int = 128

    def arguments(self) -> dict[str, Any]:
        return {"scenes": list(dict.fromkeys(self.scene or self.scenes)), "starts": self.starts, "seed": self.seed}

    def measure(self, session: Session) -> Results:
        with searching(session) as update:
            return {name: self.scenes[name](self, update) for name in self.arguments()["scenes"]}

    def checks(self, found: Results) -> list[Check]:
        """Compare energies and numbers of vortex lines with known ones; lower energies in the trap are no failures."""
        checks = []
        for item in found.get("trap", ()):
            known, ours = self.published[item.equation.Omega], item.state.energy
            below = ours < known - PUBLISHED_DIGITS
            matched = item.state.converged and (below or abs(ours - known) <= PUBLISHED_DIGITS)
            checks.append(_known(f"trap, {item.label}: E", known, ours, matched, "lower" if below else ""))
        for item in found.get("ring", ()):
            good = item.state.converged and item.state.energy <= RING_ENERGY
            checks.append(_known("ring: E at most", RING_ENERGY, item.state.energy, good))
        if "lines" in found:
            best = min(found["lines"], key=lambda item: item.state.energy)
            good = best.state.converged and abs(best.state.energy - LINES_ENERGY) < 1e-4
            checks.append(_known("lines: lowest E", LINES_ENERGY, best.state.energy, good))
            checks.append(_known("lines: of the lowest", LINES, best.count, best.count == LINES))
            saddle = found["lines"][-1]
            good = saddle.state.converged and abs(saddle.state.energy - SADDLE_ENERGY) < 1e-4
            checks.append(_known("lines: E of the saddle", SADDLE_ENERGY, saddle.state.energy, good))
            checks.append(_known("lines: of the saddle", SADDLE_LINES, saddle.count, saddle.count == SADDLE_LINES))
        return checks

    def text(self, found: Results) -> str:
        head = [["E"], ["mu"], ["residual"], ["iterations"], ["vortices"]]
        machine = f"{describe_machine()}; residual: norm of H psi - mu psi."
        out = ["Ground states of the rotating Gross-Pitaevskii equation", machine]
        for name, states in found.items():
            size = " x ".join(map(str, states[0].equation.grid.shape))
            out += ["", f"{TITLES[name].format(starts=self.starts)}", f"{size} points", ""]
            known = [["published"], ["difference"]] if name == "trap" else []
            out.append(table([*head, *known], [(item.label, _cells(item)) for item in states]))
            out += [f"  {item.label}: {item.state.message}" for item in states if not item.state.converged]
        return "\n".join([*out, "", *(check.line for check in self.checks(found))])

    def tables(self, found: Results) -> dict[str, Rows]:
        return {"ground-states.csv": _rows(found)}

    def numbers(self, found: Results) -> dict[str, Any]:
        return {"states": _rows(found), "checks": [check.entry for check in self.checks(found)]}

    def figures(self, found: Results) -> Figures:
        """Write the lowest states of the ring, for ``gpe ring``, and of the lines, and draw densities and vortices."""
        for name, states in found.items():
            if name != "trap":
                yield f"{name}.npz", partial(_save, min(states, key=lambda item: item.state.energy))

        from ..plotting import fields_figure

        for name, states in found.items():
            shown = panels(name, states)
            figure = fields_figure(shown, title=TITLES[name].split(";")[0], columns=3 if len(shown) <= 6 else 4)
            yield f"ground-state-{name}.png", figure


def _cells(item: Found) -> list[str]:
    state = item.state
    numbers = [f"{state.energy:.8f}", f"{state.mu:.8f}", compact(state.residual), str(state.iterations)]
    known = [] if item.published is None else [f"{item.published:.7f}", f"{state.energy - item.published:+.1e}"]
    return [*numbers, str(item.count), *known]


def _rows(results: Results) -> Rows:
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


def panels(name: str, found: list[Found]) -> dict[str, Any]:
    """Return the densities to draw by title; lines are shown in the plane z = 0, the lowest state also in x = 0."""
    from ..plotting import FieldPanel

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
    """Return the middle part of a density in a plane, and its ends: lower and upper along the first and second axis.

    `axes` are those of `grid` in this plane. The part reaches to `half`, by default beyond the condensate.
    """
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
    """Write a state and its equation as an npz file without pickled objects."""
    return write_file(path, partial(_save, item))


def _save(item: Found, path: Path) -> None:
    state = item.state
    numbers: dict[str, Any] = {"energy": state.energy, "mu": state.mu, "residual": state.residual}
    np.savez_compressed(path, psi=state.psi, **_content(item.equation), **numbers)


def _content(gpe: GrossPitaevskii) -> dict[str, Any]:
    """Return what a file has of the equation."""
    grid = gpe.grid
    return {"lower": grid.lower, "upper": grid.upper, "Omega": gpe.Omega, "beta": gpe.beta, "V": gpe.V}


@contextmanager
def searching(session: Session) -> Iterator[Update]:
    """Show the elapsed time of a search and its subject, which the function that is yielded sets."""
    with session.bar(None, "", bar_format="{desc} [{elapsed}]") as bar:
        yield bar.set_description_str


def kept_state(
    settings: Checkpoints, session: Session, gpe: GrossPitaevskii, search: Callable[[Update], Found]
) -> np.ndarray:
    """Return the initial field: with ``--resume`` the one in the folder of the checkpoints, else that of `search`."""
    kept = None if settings.checkpoint is None else settings.checkpoint / "state.npz"
    if kept is not None and settings.resume and kept.exists():
        return load_state(kept, gpe)
    with searching(session) as update:
        found = search(update)
    if kept is not None:
        save_state(kept, found)
    return found.state.psi


def load_state(path: Path, gpe: GrossPitaevskii) -> np.ndarray:
    """Read the field of a state that `save_state` has written; UsageError if it does not belong to `gpe`."""
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            content = {name: file[name] for name in ("psi", "V", "lower", "upper", "Omega", "beta")}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UsageError(f"cannot read a state from {str(path)!r}: {error}. {OTHER}") from error
    for name, value in _content(gpe).items():
        if np.shape(value) != content[name].shape or not np.allclose(value, content[name], rtol=1e-12):
            raise UsageError(
                f"{str(path)!r} holds a state of another equation: its {name} differs from that of {gpe!r}. {OTHER}"
            )
    psi = content["psi"]
    if psi.shape != gpe.grid.shape or psi.dtype.kind != "c" or not np.isfinite(psi).all():
        raise UsageError(f"{str(path)!r}: psi must be a finite complex field of shape {gpe.grid.shape}. {OTHER}")
    return psi
