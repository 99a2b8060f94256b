"""Tables, checks, files and figures of the charged particles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ..report import compact, table
from ..study import Check
from .orbits import ParticleOrbit
from .runs import PAPER_METHODS, ParticleRun, ParticleStudy

CURVE_POINTS = 40_000  # largest number of points, approximately, of an orbit's curve in a figure
ROWS = 1000  # number of rows of each run in the CSV file
ROUND_OFF = 1e-9  # relative bound for H and L to count as kept
TIP = 1.0095
TITLES = {
    "uniform": "Charged particle, uniform magnetic field and radial electric field",
    "tokamak-banana": "Charged particle, axisymmetric tokamak, banana orbit",
    "tokamak-transit": "Charged particle, axisymmetric tokamak, transit orbit",
}


def range_check(scene: str, what: str, value: float, low: float, high: float) -> Check:
    """Return the check that a number, named `what`, lies between two bounds in the problem `scene`; nan does not."""
    passed = low <= value <= high
    whole = float(value).is_integer() and low == high
    number = f"{value:.0f}" if whole else compact(value, 5 if "tip" in what else 4)
    if low == high:
        expected = f"expected {low:g}"
    elif low == 0:
        expected = f"at most {compact(high)}"
    elif high == np.inf:
        expected = f"at least {compact(low)}"
    else:
        expected = f"between {compact(low, 5)} and {compact(high, 5)}"
    record = {"scene": scene, "what": what, "value": value, "low": low, "high": high, "passed": passed}
    return Check(f"{what}: {number}, {expected}", passed, record)


def checks(found: ParticleStudy) -> list[Check]:
    """Compare the runs with the reference, and with the known behaviour of the methods over the paper's interval."""
    got = found.numbers
    kept = [
        range_check(found.scene, f"{name}, largest relative error of {symbol}", got[name][key], 0.0, ROUND_OFF)
        for name in _keepers(found)
        for symbol, key in (("H", "energy_error"), ("L", "momentum_error"))
    ]
    reference = range_check(found.scene, "reference, distance from the stored states", found.reference_error, 0.0, 2e-9)
    special = {"uniform": _uniform_checks, "tokamak-banana": _banana_checks, "tokamak-transit": _transit_checks}
    return [reference, *kept, *special[found.scene](found.scene, got, _keepers(found))]


def _keepers(found: ParticleStudy) -> list[str]:
    """Return the names of the methods that keep both invariants, H and L."""
    return [name for name in found.lines if name.startswith("EIP-HL")]


def _uniform_checks(scene: str, got: Mapping[str, Mapping[str, float]], keepers: list[str]) -> list[Check]:
    true = got["reference"]["gyroradius_first"]
    found = [range_check(scene, "RK4, gyroradius in the last turn", got["RK4"]["gyroradius_last"], 0.0, 0.02)]
    for name in keepers:
        for turn in ("first", "last"):
            value = got[name][f"gyroradius_{turn}"]
            found.append(range_check(scene, f"{name}, gyroradius in the {turn} turn", value, true - 1e-4, true + 1e-4))
        found.append(
            range_check(
                scene, f"{name}, error of the guiding centre's angle [rad]", got[name]["angle_error"], 0.0, 2e-3
            )
        )
    lost = "EIP-H, error of the guiding centre's angle [rad]: one invariant of two is not enough"
    return [*found, range_check(scene, lost, got["EIP-H"]["angle_error"], 5.0, np.inf)]


def _banana_checks(scene: str, got: Mapping[str, Mapping[str, float]], keepers: list[str]) -> list[Check]:
    found = [
        range_check(scene, "RK4, banana tips: then it circulates", got["RK4"]["tips"], 2, 2),
        range_check(scene, "EIP-H, banana tips", got["EIP-H"]["tips"], 3, 3),
    ]
    for name in keepers:
        found.append(range_check(scene, f"{name}, banana tips", got[name]["tips"], 8, 8))
        for end in ("nearest", "farthest"):
            value = got[name][f"tip_{end}"]
            found.append(range_check(scene, f"{name}, R of the {end} tip", value, TIP - 2e-4, TIP + 2e-4))
        found.append(_moment(scene, name, got))
    return found


def _transit_checks(scene: str, got: Mapping[str, Mapping[str, float]], keepers: list[str]) -> list[Check]:
    what = "error of the extrema of R and z in a turn"
    found = [range_check(scene, f"RK4, {what}", got["RK4"]["extrema_error"], 5e-3, np.inf)]
    for name in keepers:
        found.append(range_check(scene, f"{name}, {what}", got[name]["extrema_error"], 0.0, 5e-4))
        found.append(_moment(scene, name, got))
    return found


def _moment(scene: str, name: str, got: Mapping[str, Mapping[str, float]]) -> Check:
    value = abs(got[name]["moment_change"])
    return range_check(scene, f"{name}, change of the magnetic moment", value, 0.0, 5e-4)


COMMON = {
    "energy_error": ["error", "of H"],
    "momentum_error": ["error", "of L"],
    "phase_error": ["gyro-", "phase"],
    "position_error": ["position", ""],
    "nfev": ["evalu-", "ations"],
    "wall_time": ["time", "[s]"],
}
UNIFORM = {
    "gyroradius_first": ["gyroradius", "first turn"],
    "gyroradius_last": ["gyroradius", "last turn"],
    "angle_error": ["guiding", "angle"],
}
TRANSIT = {
    "extrema_error": ["extrema", "of R, z"],
    "moment_change": ["magnetic", "moment"],
}
BANANA = {
    "tips": ["banana", "tips"],
    "tip_nearest": ["least R", "of tips"],
    "tip_farthest": ["largest R", "of tips"],
    **TRANSIT,
}
SPECIAL = {"uniform": UNIFORM, "tokamak-banana": BANANA, "tokamak-transit": TRANSIT}
PRECISE = {"gyroradius_first": 4, "gyroradius_last": 4, "tip_nearest": 5, "tip_farthest": 5}
LEGEND = {
    "uniform": [
        "gyroradius: half the range of R in one turn around the origin; last turn: the 100th, or the last there is.",
        "guiding angle: largest error of the guiding centre's angle [rad], averaged over a gyration.",
    ],
    "tokamak": [
        "extrema: largest error of the extrema of R and z in a poloidal turn of the reference.",
        "magnetic moment: last over first such turn, less 1.",
    ],
}


def text(found: ParticleStudy) -> str:
    """Lay out the numbers and the checks of one problem."""
    got, problem = found.numbers, found.problem
    columns = {**SPECIAL[found.scene], **COMMON}
    body = [(name, [_cell(key, values[key]) for key in columns]) for name, values in got.items()]
    steps = found.reference.orbit.t.size - 1
    lines = [
        f"{TITLES[found.scene]}: {steps} steps, h = {problem.h:.5g}",
        "",
        table(list(columns.values()), body),
        "",
        *LEGEND["uniform" if found.scene == "uniform" else "tokamak"],
        "gyrophase [rad] and position: errors at the end. H, L: largest relative errors.",
        "",
        *(check.line for check in checks(found)),
    ]
    return "\n".join(lines)


def _cell(key: str, value: float) -> str:
    return str(int(value)) if key in ("nfev", "tips") else compact(value, PRECISE.get(key, 2))


def rows(found: ParticleStudy) -> Iterator[dict[str, Any]]:
    """Yield the lines of the CSV file, about a thousand for each method."""
    for name, line in {"reference": found.reference, **found.lines}.items():
        every = max((line.orbit.t.size - 1) // ROWS, 1)
        for k in range(0, line.orbit.t.size, every):
            yield {
                "scene": found.scene,
                "method": name,
                "t": line.orbit.t[k],
                **dict(zip("xyz", line.orbit.x[:, k], strict=True)),
                **dict(zip(("v_x", "v_y", "v_z"), line.orbit.v[:, k], strict=True)),
                "energy_error": line.energy_error[k],
                "momentum_error": line.momentum_error[k],
            }


def figures(studies: Mapping[str, ParticleStudy], *, paper_only: bool = False) -> Iterator[tuple[str, Any]]:
    """Make the figures one by one: one for the uniform field, and one for both orbits in the tokamak.

    `studies` are the runs by problem. With `paper_only` only the rows of the paper's figures are drawn: RK4 and EIP-HL,
    and EIP-H in the uniform field. File names are without their ending.
    """
    from ..plotting import particle_figure

    if "uniform" in studies:
        found = studies["uniform"]
        names = list(PAPER_METHODS) if paper_only else list(found.lines)
        lines = {name: found.lines[name] for name in names}
        yield (
            "uniform",
            particle_figure({name: _uniform_row(found, line) for name, line in lines.items()}, title=TITLES["uniform"]),
        )
    orbits = {scene: found for scene, found in studies.items() if scene != "uniform"}
    if orbits:
        first = next(iter(orbits.values()))
        names = ["RK4", "EIP-HL"] if paper_only else list(first.lines)
        yield (
            "tokamak",
            particle_figure(
                {name: _tokamak_row(orbits, name) for name in names}, title="Charged particle, axisymmetric tokamak"
            ),
        )


def _uniform_row(found: ParticleStudy, line: ParticleRun) -> Any:
    from ..plotting import Curves, ParticleRow

    turns, reference = line.orbit.turns(), found.reference.orbit
    last = min(100.0, float(turns[-1]))
    first = min(1.0, last)
    parts = {
        "first turn": turns <= first,
        "100th turn" if last == 100 else "last turn": (turns >= last - 1) & (turns <= last),
    }
    orbits = {name: Curves("x", "y", {"": line.orbit.x[:2, part]}) for name, part in parts.items()}
    phase = line.orbit.gyrophase - reference.gyrophase
    angle = line.orbit.averaged(line.orbit.guiding_angle - reference.guiding_angle)
    trajectory = {
        "gyrophase": (line.orbit.t, phase),
        "guiding centre": (line.orbit.averaged(line.orbit.t), angle),
    }
    return ParticleRow(orbits, _invariant_errors({"": line}), "error of angle [rad]", trajectory)


def _tokamak_row(orbits: Mapping[str, ParticleStudy], name: str) -> Any:
    from ..plotting import Curves, ParticleRow

    lines = {scene.removeprefix("tokamak-"): found.lines[name] for scene, found in orbits.items()}
    panels = {f"{kind} orbit": Curves("R", "z", {"": _thin(line.orbit)}) for kind, line in lines.items()}
    trajectory = {}
    for scene, found in orbits.items():
        truth, line = found.reference.orbit, found.lines[name]
        apart = np.linalg.norm(line.orbit.averaged(line.orbit.guiding_centre - truth.guiding_centre), axis=0)
        trajectory[scene.removeprefix("tokamak-")] = (line.orbit.averaged(line.orbit.t), apart)
    return ParticleRow(panels, _invariant_errors(lines), "error of guiding centre", trajectory)


def _thin(orbit: ParticleOrbit) -> np.ndarray:
    """Return some points (R, z) of a long orbit, shape (2, m): a few of each gyration are enough for the eye."""
    every = max(orbit.t.size // CURVE_POINTS, 1)
    return np.stack([orbit.R[::every], orbit.z[::every]])


def _invariant_errors(lines: Mapping[str, ParticleRun]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    found = {}
    for kind, line in lines.items():
        end = f", {kind}" if kind else ""
        found[f"H{end}"] = (line.orbit.t, line.energy_error)
        found[f"L{end}"] = (line.orbit.t, line.momentum_error)
    return found
