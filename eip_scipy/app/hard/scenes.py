"""``eip-scipy hard-scenes``: high eccentricities, chaos, close encounters; error against cost beside other methods."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ...core.names import nearest
from ..kepler.cost import CostCurve
from ..report import (
    check_outputs,
    compact,
    deliver,
    describe_machine,
    table,
    warn,
)
from ..work_precision import cost_to_reach
from .runs import ATOL_PER_RTOL, REPEATS, SCENES, HardScene, Point, measure, methods, scene

__all__ = ["add_arguments", "run", "text", "works"]

DONE, INTERRUPTED = 0, 130

Results = dict[str, tuple[HardScene, list[Point]]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``hard-scenes``."""
    parser.add_argument(
        "--scene",
        action="append",
        type=_known,
        metavar="NAME",
        help=f"one scene, may be repeated; default: all ({', '.join(SCENES)})",
    )


def _known(name: str) -> str:
    if name in SCENES:
        return name
    raise argparse.ArgumentTypeError(
        f"unknown scene {name!r}, expected one of {', '.join(SCENES)}{nearest(name, SCENES)}"
    )


def works(points: Sequence[Point]) -> dict[str, CostCurve]:
    """Group a scene's points by their methods."""
    found: dict[str, list[Point]] = {}
    for point in points:
        found.setdefault(point.method, []).append(point)
    return {
        name: CostCurve(
            *(np.array([getattr(p, key) for p in group]) for key in ("value", "nfev", "wall_time", "error"))
        )
        for name, group in found.items()
    }


def text(results: Results, machine: str) -> str:
    """Lay out a table for each scene, and what each method costs at one error."""
    lines = [
        "Hard scenes: error against cost",
        f"{machine}; one thread, least of at most {REPEATS} runs.",
        "error: largest distance of a body from its true position at the end, in the scene's unit.",
        "dH, dL: largest error along the run, relative (L absolute where it is zero).",
        "EIPDOP853, EIPRKN12: H and L kept. DOP853: the same compiled loop without them.",
        "IAS15: prs23 is REBOUND's own step criterion, global that of 2015; on Kepler it moves two bodies.",
        f"rtol: adaptive, atol = {ATOL_PER_RTOL:g} rtol. ds: fixed steps in fictitious time. h: fixed steps in time.",
    ]
    columns = [["setting"], ["evaluations"], ["time [ms]"], ["error"], ["dH"], ["dL"]]
    for of, points in results.values():
        lines += ["", f"{of.name}: {of.title}", table(columns, [(p.method, _cells(p)) for p in points])]
    failures = [
        f"{p.scene}, {p.method}, {_setting(p)}: {p.failure}" for _, ps in results.values() for p in ps if p.failure
    ]
    lines += ["", *_failures(failures), *_costs(results)]
    return "\n".join(lines)


def _cells(point: Point) -> list[str]:
    errors = (point.error, point.energy_error, point.momentum_error)
    return [_setting(point), str(point.nfev), compact(1e3 * point.wall_time, 3), *map(compact, errors)]


def _setting(point: Point) -> str:
    return f"{point.setting} {compact(point.value)}"


def _failures(failures: list[str]) -> list[str]:
    return ["Did not reach the end:", *(f"  {line}" for line in failures), ""] if failures else []


def _cost(work: CostCurve, level: float, key: str) -> float:
    return cost_to_reach(getattr(work, key), work.error, level)


def _costs(results: Results) -> list[str]:
    """What each method costs at each scene's error level, evaluations and time."""
    scenes = [of for of, _ in results.values()]
    names = list(dict.fromkeys(p.method for _, points in results.values() for p in points))
    lines = []
    for key, label, factor in (("nfev", "1000 evaluations", 1e-3), ("wall_time", "milliseconds", 1e3)):
        costs = {
            name: [factor * _cost(works(points)[name], of.level, key) for of, points in results.values()]
            for name in names
        }
        body = [(name, [compact(cost) for cost in row]) for name, row in costs.items()]
        head = [[of.name, compact(of.level, 1)] for of in scenes]
        cheapest = []
        for k in range(len(scenes)):
            known = {name: row[k] for name, row in costs.items() if np.isfinite(row[k])}
            cheapest.append(min(known, key=known.__getitem__) if known else "none")
        least = [f"  least for {of.name}: {name}" for of, name in zip(scenes, cheapest, strict=True)]
        lines += [f"{label.capitalize()} for an error of", table(head, body), *least, ""]
    return [*lines, '"-": no run is as accurate.']


def run(args: argparse.Namespace, rebound: Any) -> int:
    """Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        Options of `add_arguments`, and ``out``, ``json`` (Path or None) and ``quiet``.
    rebound : module or None
        `eip_scipy.integrations.rebound`, None without REBOUND.

    Returns
    -------
    int
        Exit status: 0 done, 130 interrupted.
    """
    from tqdm import tqdm

    check_outputs(args.out, args.json)
    scenes = [scene(name) for name in dict.fromkeys(args.scene or SCENES)]
    total = sum(len(method.settings) for of in scenes for method in methods(of, rebound).values())
    try:
        with tqdm(total=total, desc="hard scenes", unit="point", disable=args.quiet, leave=False) as bar:
            results = {of.name: (of, list(measure(of, rebound, REPEATS, bar.update))) for of in scenes}
    except KeyboardInterrupt:
        warn("interrupted; nothing was written")
        return INTERRUPTED
    machine = describe_machine()
    found = rows(results)
    arguments = {"scenes": list(results)}
    deliver(
        args,
        "hard-scenes",
        text(results, machine),
        {"hard-scenes.csv": found},
        _figures(results, machine),
        arguments,
        points=found,
    )
    return DONE


def rows(results: Results) -> list[dict[str, Any]]:
    """Make the lines of the CSV file."""
    return [
        {
            "scene": p.scene,
            "method": p.method,
            "setting": p.setting,
            "value": p.value,
            "nfev": p.nfev,
            "wall_time_s": p.wall_time,
            "position_error": p.error,
            "error_H": p.energy_error,
            "error_L": p.momentum_error,
            "failure": p.failure or None,
        }
        for _, points in results.values()
        for p in points
    ]


def _figures(results: Results, machine: str) -> Iterator[Any]:
    from ...plotting import scenes_figure

    panels: Mapping[str, Any] = {
        of.title: {name: vars(work) for name, work in works(points).items()} for of, points in results.values()
    }
    yield (
        "hard-scenes.png",
        scenes_figure(
            panels,
            error="error of position at the end",
            title="Hard scenes: error against cost (errors above 1 left out)",
            largest=1.0,
            footnote=f"{machine}; one thread, least of at most {REPEATS}",
        ),
    )
