"""Charged particles: speed of the compiled step, and error against cost beside other methods.

    python benchmarks/charged_particle.py [--out DIR] [--json FILE] [--repeats 3]

1. Seconds for the paper's 500 000 steps in the tokamak: plain RK4, EIP-HL with both metrics and with wider spacings,
   Boris, implicit midpoint; and the same EIP-HL through solve_ivp, from 10 000 steps. Runs are interleaved, the least
   time of each counts, and the ratios are of one and the same process.
2. Error against cost in the uniform field and on both orbits of the tokamak: error of position and of the guiding
   centre (averaged over a gyration) at the end of the paper's interval, EIP methods and the same without projection in
   the canonical form, Boris and heyoka (where installed) in the form (x, v). Figures in DIR, default docs/_static.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, EIPSolver, integrate
from eip_scipy.commands.particle_runs import SCENES, scene
from eip_scipy.comparators import boris, implicit_midpoint
from eip_scipy.plotting import frontier_figure
from eip_scipy.problems import ParticleProblem, tokamak
from eip_scipy.problems.particle_orbits import ParticleOrbit
from eip_scipy.report import compact, describe_machine, document, table, write_json

STATIC = Path(__file__).parents[1] / "docs" / "_static"
TAIL = 60  # states of the reference, three gyrations, at the end of the interval
SOLVE_IVP_STEPS = 10_000


# 1. Speed.


def speed(repeats: int) -> dict[str, float]:
    """Seconds for the paper's banana orbit."""
    problem, other = tokamak(), tokamak(form="velocity")
    span, y0, h = problem.t_span, problem.y0, problem.h
    runs: dict[str, Callable[[], float]] = {
        "RK4": lambda: integrate(problem, method=EIPRK4, invariants=()).wall_time,
        "EIP-HL, euclidean": lambda: integrate(problem, method=EIPRK4, metric="euclidean").wall_time,
        "EIP-HL": lambda: integrate(problem, method=EIPRK4).wall_time,
        "EIP-HL, euclidean, every=5": lambda: integrate(problem, method=EIPRK4, metric="euclidean", every=5).wall_time,
        "EIP-HL, every=5": lambda: integrate(problem, method=EIPRK4, every=5).wall_time,
        "(x, v): RK4": lambda: integrate(other, method=EIPRK4, invariants=()).wall_time,
        "(x, v): EIP-HL": lambda: integrate(other, method=EIPRK4).wall_time,
        "(x, v): Boris": lambda: boris(other.field.fill, span, other.y0, h).wall_time,
        "implicit midpoint": lambda: implicit_midpoint(problem.rhs, span, y0, h, params=problem.params).wall_time,
        "EIP-HL, euclidean, through solve_ivp": partial(through_solve_ivp, problem, metric="euclidean"),
        "EIP-HL, through solve_ivp": partial(through_solve_ivp, problem, metric="error", blocks=3),
    }
    best = dict.fromkeys(runs, np.inf)
    for _ in range(repeats + 1):  # the first may compile
        for name, run in runs.items():
            best[name] = min(best[name], run())
    return best


def through_solve_ivp(problem: ParticleProblem, **options: Any) -> float:
    """Seconds that all steps would take, from the first of them."""
    assert problem.h is not None
    span = (0.0, SOLVE_IVP_STEPS * problem.h)
    start = perf_counter()
    solve_ivp(
        problem.fun, span, problem.y0, method=EIPRK4, h=problem.h, invariants=problem.invariants, t_eval=[0], **options
    )
    return (perf_counter() - start) * round(problem.t_span[1] / problem.h) / SOLVE_IVP_STEPS


def speed_text(best: dict[str, float]) -> str:
    plain = {True: best["(x, v): RK4"], False: best["RK4"]}
    head = [["seconds", ""], ["us per", "step"], ["times", "plain RK4"]]
    body = [
        (name, [compact(s), compact(s / 0.5), compact(s / plain[name.startswith("(x")], 3)]) for name, s in best.items()
    ]
    ratios = [
        f"through solve_ivp / compiled: {best[f'{name}, through solve_ivp'] / best[name]:.0f} ({name})"
        for name in ("EIP-HL, euclidean", "EIP-HL")
    ]
    return "\n".join(["500 000 steps of the banana orbit, canonical form where nothing else is said", "",
                      table(head, body), "", *ratios])  # fmt: skip


# 2. Error against cost.


class Point(NamedTuple):
    """One method at one setting: seconds, and errors of position and guiding centre at the end."""

    scene: str
    method: str
    setting: float
    wall_time: float
    position: float
    guiding_centre: float


Run = Callable[[float], tuple[float, np.ndarray, np.ndarray]]
"""``run(setting) -> (seconds, t, y)``, the latter of the last gyrations at least."""


def methods(problem: ParticleProblem, other: ParticleProblem) -> Iterator[tuple[str, Run, tuple[float, ...], bool]]:
    """Name, what runs it, its settings, and whether its states are (x, v)."""
    wide, fine = (2.0, 1.0, 0.5, 0.25), (1.0, 0.5, 0.25, 0.125)
    for name, method, factors in (
        ("RK4", EIPRK4, fine),
        ("RK45", EIPRK45, wide),
        ("DOP853", EIPDOP853, (4.0, 2.0, 1.0, 0.5)),
    ):
        yield f"EIP-HL, {name}", partial(fixed, problem, method, problem.invariants), factors, False
        if name != "RK45":
            yield name, partial(fixed, problem, method, ()), factors, False
    yield "DOP853, adaptive", partial(adaptive, problem), (1e-6, 1e-8, 1e-10, 1e-12), False
    yield "implicit midpoint", partial(midpoint, problem), (1.0, 0.5, 0.25), False
    yield "Boris", partial(pushed, other), (1.0, 0.5, 0.25, 0.125, 0.0625), True
    try:
        import heyoka  # noqa: F401
    except ImportError:
        return
    yield "heyoka", partial(taylor, other), (1e-6, 1e-9, 1e-12, 1e-15), True


def spacing(factor: float) -> int:
    """Steps between two saved states: those are at multiples of the paper's step."""
    return max(round(1 / factor), 1)


def fixed(problem: ParticleProblem, method: type[EIPSolver], kept: Any, factor: float) -> Any:
    assert problem.h is not None
    options: dict[str, Any] = {"method": method, "invariants": kept, "h": factor * problem.h}
    seconds = integrate(problem, **options).wall_time
    run = integrate(problem, save_every=spacing(factor), **options)
    return seconds, run.t, run.y


def adaptive(problem: ParticleProblem, rtol: float) -> Any:
    options: dict[str, Any] = {"method": EIPDOP853, "invariants": (), "rtol": rtol, "atol": 1e-3 * rtol}
    free = replace(problem, h=None)
    seconds = integrate(free, **options).wall_time
    times = tail_times(problem)
    return seconds, times, integrate(free, t_eval=times, **options).y


def midpoint(problem: ParticleProblem, factor: float) -> Any:
    assert problem.h is not None
    options: dict[str, Any] = {"params": problem.params, "save_every": spacing(factor)}
    run = implicit_midpoint(problem.rhs, problem.t_span, problem.y0, factor * problem.h, **options)
    return run.wall_time, run.t, run.y


def pushed(problem: ParticleProblem, factor: float) -> Any:
    assert problem.h is not None
    run = boris(problem.field.fill, problem.t_span, problem.y0, factor * problem.h, save_every=spacing(factor))
    return run.wall_time, run.t, run.y


def taylor(problem: ParticleProblem, tolerance: float) -> Any:
    import heyoka
    from particle_references import system

    integrator = heyoka.taylor_adaptive(system(problem.field.name, 1e-2), problem.y0, tol=tolerance)
    times = tail_times(problem)
    start = perf_counter()
    integrator.propagate_until(times[0])
    states = integrator.propagate_grid(times)[-1]
    return perf_counter() - start, times, np.asarray(states).T


def tail_times(problem: ParticleProblem) -> np.ndarray:
    assert problem.h is not None
    steps = round(problem.t_span[1] / problem.h)
    return np.append(np.arange(steps - TAIL, steps) * problem.h, problem.t_span[1])


def measure(name: str, repeats: int) -> list[Point]:
    """All methods on one scene; of each setting the least time of several runs."""
    problem, other = scene(name), scene(name, form="velocity")
    assert problem.h is not None
    # A quarter of the paper's step, compensated: 1e-9 from the states stored with the problem.
    tight = {"method": EIPDOP853, "h": problem.h / 4, "compensated": True, "invariants": ()}
    run = integrate(problem, save_every=4, **tight)
    truth = ParticleOrbit(problem, run.t[-TAIL - 1 :], run.y[:, -TAIL - 1 :])
    points = []
    for method, run_method, settings, is_velocity in methods(problem, other):
        for setting in settings:
            results = [run_method(setting) for _ in range(repeats)]
            seconds = min(result[0] for result in results)
            _, t, y = results[0]
            orbit = ParticleOrbit(other if is_velocity else problem, t, y)
            points.append(Point(name, method, setting, seconds, *errors(orbit, truth)))
            print(f"{name:16} {method:18} {setting:8g} {seconds:8.3f} s  position {points[-1].position:.1e}  "
                  f"guiding centre {points[-1].guiding_centre:.1e}", flush=True)  # fmt: skip
    return points


def errors(orbit: ParticleOrbit, truth: ParticleOrbit) -> tuple[float, float]:
    """Errors of position and of the averaged guiding centre at the end."""
    step = round(float(np.median(np.diff(orbit.t))) / float(np.median(np.diff(truth.t))))
    count = TAIL // step + 1
    tail = ParticleOrbit(orbit.problem, orbit.t[-count:], np.ascontiguousarray(orbit.y[:, -count:]))
    same = slice(None, None, step)
    if not np.isfinite(tail.y).all():
        return float("nan"), float("nan")
    apart = tail.averaged(tail.guiding_centre - truth.guiding_centre[:, same])[:, -1]
    return float(np.linalg.norm(tail.x[:, -1] - truth.x[:, -1])), float(np.linalg.norm(apart))


def draw(points: list[Point], folder: Path) -> None:
    """One figure for each scene."""
    for name in dict.fromkeys(point.scene for point in points):
        series = {}
        for method in dict.fromkeys(point.method for point in points):
            mine = [point for point in points if (point.scene, point.method) == (name, method)]
            keys = {"wall_time": "wall_time", "position": "position", "guiding centre": "guiding_centre"}
            series[method] = {key: np.array([getattr(point, field) for point in mine]) for key, field in keys.items()}
        figure = frontier_figure(
            series,
            unit="system size",
            title=f"Charged particle, {name.replace('-', ', ')}: error at the end of the paper's interval against cost",
            footnote=f"{describe_machine()}; one thread",
        )
        figure.savefig(folder / f"charged-particle-cost-{name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=STATIC)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    print(describe_machine(), flush=True)
    best = speed(args.repeats)
    print(speed_text(best), "\n", flush=True)
    points = [point for name in SCENES for point in measure(name, args.repeats)]
    draw(points, args.out)
    if args.json:
        content = {"seconds": best, "points": [point._asdict() for point in points]}
        write_json(args.json, document("benchmarks/charged_particle.py", vars(args), **content))


if __name__ == "__main__":
    main()
