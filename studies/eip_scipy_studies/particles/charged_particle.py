"""``eip-scipy charged-particle``: the paper's Experiment III by several methods, numbers, checks and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fnmatch import filter as matching
from functools import cached_property, partial
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, EIPRK5, integrate
from eip_scipy.problems import ParticleProblem, tokamak, uniform_field
from eip_scipy.problems.particles.charged_particle import ORBITS

from ..comparators import boris, implicit_midpoint
from ..output import Output
from ..report import compact, table, warn
from .orbits import ParticleOrbit

SCENES: dict[str, Callable[..., ParticleProblem]] = {
    "uniform": uniform_field,
    **{f"tokamak-{orbit}": partial(tokamak, orbit) for orbit in ORBITS},
}
TITLES = {"uniform": "uniform magnetic field and radial electric field", "tokamak": "axisymmetric tokamak"}
PAPER = ("reference", "RK4", "EIP-H", "EIP-HL")

# Columns of the table: heading, number of digits, and name in the checks.
COLUMNS = {
    "gyroradius_first": ("gyroradius", "first turn", 4, "gyroradius in the first turn"),
    "gyroradius_last": ("gyroradius", "last turn", 4, "gyroradius in the last turn"),
    "angle_error": ("guiding", "angle", 2, "error of the guiding centre's angle [rad]"),
    "tips": ("banana", "tips", 0, "banana tips"),
    "tip_nearest": ("least R", "of tips", 5, "R of the nearest tip"),
    "tip_farthest": ("largest R", "of tips", 5, "R of the farthest tip"),
    "extrema_error": ("extrema", "of R, z", 2, "error of the extrema of R and z in a turn"),
    "moment_change": ("magnetic", "moment", 2, "change of the magnetic moment"),
    "energy_error": ("error", "of H", 2, "largest relative error of H"),
    "momentum_error": ("error", "of L", 2, "largest relative error of L"),
    "phase_error": ("gyro-", "phase", 2, "error of the gyrophase"),
    "position_error": ("position", "", 2, "error of the position"),
    "nfev": ("evalu-", "ations", 0, "evaluations"),
    "wall_time": ("time", "[s]", 2, "time"),
    "distance": ("", "", 2, "distance from the stored states"),
}
LEGEND = """\
gyroradius: half the range of R in one turn around the origin; last turn: the 100th, or the last there is.
guiding angle: largest error of the guiding centre's angle [rad], averaged over a gyration.
extrema: largest error of the extrema of R and z in a poloidal turn of the reference.
magnetic moment: last over first such turn, less 1.
gyrophase [rad] and position: errors at the end. H, L: largest relative errors."""

Numbers = dict[str, float]


def change(values: np.ndarray) -> np.ndarray:
    """Return the relative errors of an invariant."""
    return np.abs(values / values[0] - 1)


def methods(problem: ParticleProblem, other: ParticleProblem) -> dict[str, Callable[[], Any]]:
    """Return functions that run the reference and each method; only Boris has states (x, v), those of `other`."""
    span, h, rhs = problem.t_span, problem.h, problem.rhs
    assert h is not None
    assert rhs is not None

    def eip(method: Any, kept: str, **options: Any) -> Callable[[], Any]:
        invariants = [item for item in problem.invariants if item.name in kept]
        return partial(integrate, problem, method=method, save_every=1, invariants=invariants, **options)

    paper: dict[str, Any] = {"metric": "euclidean", "reuse_f": False}
    return {
        "reference": partial(
            integrate, problem, method=EIPDOP853, h=h / 4, save_every=4, invariants=(), compensated=True
        ),
        "RK4": eip(EIPRK4, ""),
        "EIP-H": eip(EIPRK4, "H", **paper),
        "EIP-HL": eip(EIPRK4, "HL", **paper),
        "EIP-HL, error metric": eip(EIPRK4, "HL"),
        "EIP-HL, RK5": eip(EIPRK5, "HL"),
        "implicit midpoint": partial(implicit_midpoint, rhs, span, problem.y0, h, params=problem.params, save_every=1),
        "Boris": partial(boris, other.field.fill, span, other.y0, h, save_every=1),
    }


class Experiment:
    """Orbits in one of `SCENES`, with its options, by methods: all, or `only` some; `tick` is called after each."""

    def __init__(self, scene: str, only: Sequence[str] = (), tick: Callable[[], Any] = int, **options: Any) -> None:
        self.scene, self.problem = scene, SCENES[scene](**options)
        self.orbits: dict[str, ParticleOrbit] = {}
        self.costs: dict[str, Numbers] = {}
        other = SCENES[scene](form="velocity", **options)
        for name, run in methods(self.problem, other).items():
            if not only or name in only:
                made = run()
                self.orbits[name] = ParticleOrbit(other if name == "Boris" else self.problem, made.t, made.y)
                self.costs[name] = {"nfev": made.nfev, "wall_time": made.wall_time}
                tick()
        self.truth = self.orbits["reference"]

    @cached_property
    def numbers(self) -> dict[str, Numbers]:
        """Results of each method, see `COLUMNS`; the reference has its `distance` from the problem's stored states."""
        special = self._uniform if self.scene == "uniform" else self._tokamak
        found = {name: {**self._common(name, orbit), **special(orbit)} for name, orbit in self.orbits.items()}
        found["reference"]["distance"] = self._distance()
        return found

    def _common(self, name: str, orbit: ParticleOrbit) -> Numbers:
        return {
            "energy_error": float(change(orbit.energy).max()),
            "momentum_error": float(change(orbit.momentum).max()),
            "phase_error": float(orbit.gyrophase[-1] - self.truth.gyrophase[-1]),
            "position_error": float(np.linalg.norm(orbit.x[:, -1] - self.truth.x[:, -1])),
            **self.costs[name],
        }

    def _uniform(self, orbit: ParticleOrbit) -> Numbers:
        error, turned = orbit.averaged(orbit.guiding_angle - self.truth.guiding_angle), float(orbit.turns()[-1])
        return {
            "gyroradius_first": orbit.radial_range(min(1.0, turned)),
            "gyroradius_last": orbit.radial_range(min(100.0, turned)),
            "angle_error": float(np.abs(error).max()),
        }

    def _tokamak(self, orbit: ParticleOrbit) -> Numbers:
        parts, tips = self.truth.poloidal_turns(), orbit.bounce_points()
        off = [abs(edge(x[part]) - edge(exact[part]))
               for x, exact in ((orbit.R, self.truth.R), (orbit.z, self.truth.z))
               for edge in (np.min, np.max) for part in parts]  # fmt: skip
        moments = [orbit.magnetic_moment[part].mean() for part in parts]
        return {
            "tips": tips.size,
            "tip_nearest": float(min(tips, default=np.nan)),
            "tip_farthest": float(max(tips, default=np.nan)),
            "extrema_error": float(max(off, default=np.nan)),
            "moment_change": float(moments[-1] / moments[0] - 1) if moments else float("nan"),
        }

    def _distance(self) -> float:
        """Return the reference's largest distance from the stored positions; nan if none of their times is saved."""
        t, x, reference = self.truth.t, self.truth.x, self.problem.reference
        assert reference is not None
        every = max((t.size - 1) // 100, 1)
        known = [(k, reference(float(t[k]))) for k in range(every, t.size, every)]
        return float(max((np.linalg.norm(x[:, k] - y[:3]) for k, y in known if y is not None), default=np.nan))

    def text(self) -> str:
        """Return the numbers as a table."""
        columns = {key: column for key, column in COLUMNS.items() if key in self.numbers["RK4"]}
        cell = lambda value, digits: compact(value, digits) if digits else f"{value:.0f}"  # noqa: E731
        body = [
            (name, [cell(got[key], column[2]) for key, column in columns.items()]) for name, got in self.numbers.items()
        ]
        steps = f"{self.truth.t.size - 1} steps, h = {self.problem.h:.5g}"
        made = table([column[:2] for column in columns.values()], body)
        return f"\nCharged particle, {self.scene}: {steps}\n\n{made}\n\n{LEGEND}\n"

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of the CSV file, about a thousand for each method."""
        names = ("t", "x", "y", "z", "v_x", "v_y", "v_z", "energy_error", "momentum_error")
        for name, orbit in self.orbits.items():
            columns = (orbit.t, *orbit.x, *orbit.v, change(orbit.energy), change(orbit.momentum))
            for k in range(0, orbit.t.size, max((orbit.t.size - 1) // 1000, 1)):
                values = (column[k] for column in columns)
                yield {"scene": self.scene, "method": name, **dict(zip(names, values, strict=True))}

    def check(self, out: Output) -> None:
        """Check the runs with the reference, and with the known behaviour of the methods over the paper's interval."""
        for pattern, key, low, high in bounds(self.scene, self.numbers["reference"]):
            for name in matching(self.numbers, pattern):
                value, words = self.numbers[name][key], COLUMNS[key][-1]
                record = {"scene": self.scene, "method": name, "value": value, "low": low, "high": high}
                text = f"{name}, {words}: {compact(value, 5)}, expected {low:.6g} to {high:.6g}"
                out.check(text, low <= value <= high, **record)


def bounds(scene: str, truth: Numbers) -> list[tuple[str, str, float, float]]:
    """Return what is known of a problem: the names of methods as a pattern, a number, its least and largest value."""
    both = "EIP-HL*"  # the methods that keep both invariants
    known = [("reference", "distance", 0.0, 2e-9), (both, "energy_error", 0.0, 1e-9)]
    known.append((both, "momentum_error", 0.0, 1e-9))
    if scene == "uniform":
        radius = truth["gyroradius_first"]
        return [
            *known,
            ("RK4", "gyroradius_last", 0.0, 0.02),
            *((both, f"gyroradius_{turn}", radius - 1e-4, radius + 1e-4) for turn in ("first", "last")),
            (both, "angle_error", 0.0, 2e-3),
            ("EIP-H", "angle_error", 5.0, np.inf),  # one invariant of two is not enough
        ]
    known.append((both, "moment_change", -5e-4, 5e-4))
    if scene == "tokamak-transit":
        return [*known, ("RK4", "extrema_error", 5e-3, np.inf), (both, "extrema_error", 0.0, 5e-4)]
    known += [(name, "tips", count, count) for name, count in (("RK4", 2), ("EIP-H", 3), (both, 8))]
    return known + [(both, f"tip_{end}", 1.0093, 1.0097) for end in ("nearest", "farthest")]


def charged_particle(
    out: Output,
    field: tuple[Literal["uniform", "tokamak", "tokamak-banana", "tokamak-transit"], ...] = ("uniform", "tokamak"),
) -> None:
    """Run charged particles in two fields by several methods (the paper's Experiment III).

    Parameters
    ----------
    field : tuple of str
        uniform, tokamak or one orbit of it, tokamak-banana or tokamak-transit (default: all)
    """
    compare(out, "charged-particle", [scene for scene in SCENES if scene.startswith(tuple(field))])


def paper_figure(out: Output, name: Literal["fig-particle", "fig-tokamak"]) -> None:
    """Do the runs of a figure of the paper and draw it: RK4 and EIP-HL, and EIP-H in the uniform field."""
    compare(out, name, [scene for scene in SCENES if (scene == "uniform") == (name == "fig-particle")], PAPER)


def compare(out: Output, stem: str, scenes: Sequence[str], only: Sequence[str] = ()) -> None:
    """Run methods on some of `SCENES`, write, print and check what they find, and draw each field."""
    if find_spec("numba") is None:
        warn('without Numba the runs take hours instead of a minute: pip install "eip_scipy[numba]"')
    with out.bar(None, "charged particle", unit="run", total=len(scenes) * (len(only) or 8)) as bar:
        found = [Experiment(scene, only, bar.update) for scene in scenes]
    out.rows(f"{stem}.csv", [row for each in found for row in each.rows()])
    out.numbers["scenes"] = {each.scene: each.numbers for each in found}
    for each in found:
        out.text(each.text())
        each.check(out)
    for field in dict.fromkeys(scene.partition("-")[0] for scene in scenes):
        own = {each.scene: each for each in found if each.scene.startswith(field)}
        names = [name for name in found[0].orbits if name != "reference" and (name, stem) != ("EIP-H", "fig-tokamak")]
        out.figure(f"{stem}.png" if only else f"{stem}-{field}.png", "particles.figures:particle_figure", own, names)
