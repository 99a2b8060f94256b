"""``eip-scipy gpe ground-state``: ground states in a harmonic trap, the paper's ring, and its vortex lines."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from eip_scipy.problems import Grid, GrossPitaevskii

from ..output import Output, require_positive
from ..report import UsageError, compact, describe_machine, table
from .ground_state import GroundState, ground_state, imprint, lowest_ring, polygon, vortex_starts, with_noise
from .problems import harmonic_trap, line_condensate, ring_condensate
from .vortices import vortices

# V = r^2 / 2, beta = 100: angular velocity and published energy.
PUBLISHED = {0.0: 3.9459469, 0.65: 3.6506129, 0.71: 3.4997148, 0.76: 3.3475310, 0.80: 3.1904172}
RING_ENERGY = -115.270
# Energy and number of vortex lines of the ground state, and of the saddle in the paper's figure.
LOWEST, SADDLE = (3.3029, 2), (3.3293, 4)
LINE_POINTS, LINES_RADIUS = 64, 1.5
ROUGH: dict[str, Any] = {"tol": 1e-5, "max_iterations": 1000}
TITLES = {
    "trap": "trap: V = r^2 / 2, beta = 100; lowest of {starts} starts for each Omega",
    "ring": "ring: V = -0.1 r^2 + 0.075 r^4, beta = 1000, Omega = 3.5; a row of vortices around a winding",
    "lines": "lines: V = (x^2 + y^2 + z^2 / 4) / 2, beta = 400, Omega = 0.7; by lines imprinted on the start",
}
OTHER = "Give another file, or leave out --start."
Update = Callable[[str], Any]


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

    def row(self, scene: str) -> dict[str, Any]:
        """Return the line of the CSV file."""
        gpe, state = self.equation, self.state
        known = {"Omega": gpe.Omega, "beta": gpe.beta, "energy": state.energy, "published": self.published}
        found = {name: getattr(state, name) for name in ("mu", "residual", "iterations", "converged")}
        return {"scene": scene, "start": self.label, **known, **found, "vortices": self.count}


def trap(starts: int, seed: int, update: Update, points: int = 128) -> list[Found]:
    """Return, for each angular velocity, the state of lowest energy; ``update(text)`` shows what is being computed."""
    found = []
    for Omega, published in PUBLISHED.items():
        update(f"trap, Omega = {Omega:g}")
        gpe = GrossPitaevskii(Grid((points, points), -10.0, 10.0), harmonic_trap(1.0, 1.0), Omega=Omega, beta=100.0)
        states = (ground_state(gpe, start, tol=1e-6) for start in vortex_starts(gpe, starts if Omega else 1, seed))
        found.append(Found(f"Omega = {Omega:.2f}", gpe, min(states, key=lambda state: state.energy), published))
    return found


def search_ring(seed: int, update: Update) -> Found:
    """Search over numbers of vortices and windings for the ground state of the paper's ring; see `lowest_ring`."""
    gpe = ring_condensate()
    report = lambda count, winding, energy: update(f"ring, {count} vortices around a winding of {winding}")  # noqa: E731
    state, (count, winding) = lowest_ring(gpe, seed=seed, report=report)
    return Found(f"{count} around {winding}", gpe, state)


def lines(seed: int, update: Update) -> list[Found]:
    """Return states of the paper's 3D condensate from noisy starts with 0 ... 4 vortex lines, and last the saddle."""
    gpe, rng, found = line_condensate(points=LINE_POINTS), np.random.default_rng(seed), []
    for count in range(SADDLE[1] + 1):
        update(f"lines, {count} imprinted")
        start = with_noise(imprint(gpe, polygon(count, LINES_RADIUS if count > 1 else 0.0)), rng)
        found.append(Found(f"{count} imprinted", gpe, ground_state(gpe, start, **ROUGH)))
    return [*found, search_saddle(LINE_POINTS, update)]


def search_saddle(points: int, update: Update) -> Found:
    """Return the paper's state with four lines, a saddle that the descent reaches as it keeps the start's symmetry."""
    update("lines, 4 imprinted without noise")
    gpe = line_condensate(points=points)
    return Found("4 without noise: a saddle", gpe, ground_state(gpe, imprint(gpe, polygon(4, LINES_RADIUS))))


def ground_states(
    out: Output, *, scene: tuple[Literal["trap", "ring", "lines"], ...] = ("trap", "ring", "lines"), starts: int = 4,
    seed: int = 0,
) -> None:  # fmt: skip
    """Find ground states of the rotating Gross-Pitaevskii equation (the paper's Experiment IV).

    Parameters
    ----------
    scene : tuple of str
        problems (default: all)
    starts : int
        starts for each angular velocity in the trap (default: 4)
    seed : int
        seed of the random starts (default: 0)
    """
    require_positive(starts=starts)
    searches: dict[str, Callable[[Update], list[Found]]] = {
        "trap": partial(trap, starts, seed),
        "ring": lambda update: [search_ring(seed, update)],
        "lines": partial(lines, seed),
    }
    with searching(out) as bar:
        found = {str(name): searches[name](bar.set_description_str) for name in dict.fromkeys(scene)}
    report(out, found, starts)


def report(out: Output, found: Mapping[str, list[Found]], starts: int) -> None:
    """Write, print, check and draw the states of each problem."""
    out.numbers["states"] = [item.row(name) for name, items in found.items() for item in items]
    out.rows("ground-states.csv", out.numbers["states"])
    out.text("Ground states of the rotating Gross-Pitaevskii equation")
    out.text(f"{describe_machine()}; residual: norm of H psi - mu psi.")
    head = [["E"], ["mu"], ["residual"], ["iterations"], ["vortices"], ["published"], ["difference"]]
    for name, items in found.items():
        size, body = " x ".join(map(str, items[0].equation.grid.shape)), []
        for item in items:
            state, known = item.state, item.published
            cells = [f"{state.energy:.8f}", f"{state.mu:.8f}", compact(state.residual), f"{state.iterations}"]
            compared = ["-", "-"] if known is None else [f"{known:.7f}", f"{state.energy - known:+.1e}"]
            body.append((item.label, [*cells, f"{item.count}", *compared]))
        out.text(f"\n{TITLES[name].format(starts=starts)}\n{size} points\n\n{table(head, body)}")
        out.text("\n".join(f"  {item.label}: {item.state.message}" for item in items if not item.state.converged))
    for text, value, ours, matched in checks(found):
        out.check(f"{text} {value:.10g}, ours {ours:.10g}", matched, known=value, ours=ours)
    for name in found.keys() & {"ring", "lines"}:
        out.file(f"{name}.npz", partial(_save, min(found[name], key=lambda item: item.state.energy)))
    for name, items in found.items():
        out.figure(f"ground-state-{name}.png", "condensates.figures:states_figure", items, TITLES[name].split(";")[0])


def checks(found: Mapping[str, list[Found]]) -> Iterator[tuple[str, float, float, bool]]:
    """Yield known energies and numbers of lines, ours, and whether they match; in the trap lower energies do."""
    for item in found.get("trap", ()):
        known, state = item.published or 0.0, item.state
        yield f"trap, {item.label}: E", known, state.energy, state.converged and state.energy <= known + 1e-5
    for item in found.get("ring", ()):
        state = item.state
        yield "ring: E at most", RING_ENERGY, state.energy, state.converged and state.energy <= RING_ENERGY
    if items := found.get("lines"):
        best = min(items, key=lambda item: item.state.energy)
        for name, item, (energy, count) in (("lowest", best, LOWEST), ("saddle", items[-1], SADDLE)):
            state = item.state
            good = state.converged and abs(state.energy - energy) < 1e-4
            yield f"lines: E of the {name}", energy, state.energy, good
            yield f"lines: number in the {name}", count, item.count, item.count == count


def _save(item: Found, path: Path) -> None:
    """Write a state and its equation as an npz file without pickled objects."""
    numbers: dict[str, Any] = {name: getattr(item.state, name) for name in ("psi", "energy", "mu", "residual")}
    np.savez_compressed(path, **numbers, **_content(item.equation))


def _content(gpe: GrossPitaevskii) -> dict[str, Any]:
    return {"lower": gpe.grid.lower, "upper": gpe.grid.upper, "Omega": gpe.Omega, "beta": gpe.beta, "V": gpe.V}


def searching(out: Output) -> Any:
    """Make a bar that shows the elapsed time of a search and, by its `set_description_str`, the subject."""
    return out.bar(bar_format="{desc} [{elapsed}]")


def load_state(path: Path, gpe: GrossPitaevskii) -> np.ndarray:
    """Read the field of a state that `ground_states` has written; UsageError if it does not belong to `gpe`."""
    known = _content(gpe)
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            psi, content = file["psi"], {name: file[name] for name in known}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UsageError(f"cannot read a state from {str(path)!r}: {error}. {OTHER}") from error
    for name, value in known.items():
        if np.shape(value) != content[name].shape or not np.allclose(value, content[name], rtol=1e-12):
            raise UsageError(f"{str(path)!r} is for another equation: its {name} is not that of {gpe!r}. {OTHER}")
    if psi.shape != gpe.grid.shape or psi.dtype.kind != "c" or not np.isfinite(psi).all():
        raise UsageError(f"{str(path)!r}: psi must be a finite complex field of shape {gpe.grid.shape}. {OTHER}")
    return psi
