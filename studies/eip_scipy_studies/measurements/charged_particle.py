"""``eip-scipy study charged-particle``: speed of the compiled step, and error against cost, for charged particles.

1. Time of a step in the tokamak: plain RK4, EIP-HL with both metrics, projected at each or each fifth step, Boris,
   implicit midpoint; and the same EIP-HL through solve_ivp, from the first 200 000 of the paper's steps (solve_ivp:
   5000). Runs take turns, and the least time of each counts, without the time before the first step. Ratios are those
   within one process.
2. Error against cost in the uniform field and on both orbits of the tokamak: error of position and of the guiding
   centre (averaged over a gyration) at the end of the paper's interval, EIP methods and the same without projection in
   the canonical form, Boris and heyoka (if installed) in the form (x, v).

Times are processor times of the thread. On an idle machine they are wall times; on a busy one they are still
meaningful.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, integrate
from eip_scipy.problems import ParticleProblem, tokamak

from ..comparators import boris, implicit_midpoint
from ..particles.orbits import ParticleOrbit
from ..particles.runs import SCENES, scene
from ..report import compact, describe_machine, needed, table
from ..study import Figures, Measurement, Rows, Session, option
from ..timing import clocked, least
from ..work_precision import curves

TAIL = 60  # states of the reference, three gyrations, at the end of the interval
SPEED_STEPS, SOLVE_IVP_STEPS = 200_000, 5000
ROUNDS = 5


def speed(turns: int, share: float) -> dict[str, float]:
    """Return the microseconds per step of each method on the banana orbit, the least of `turns` measurements.

    A measured run has `share` times `SPEED_STEPS` steps, or `share` times `SOLVE_IVP_STEPS` in solve_ivp.
    """
    problem, other = tokamak(), tokamak(form="velocity")
    h, rhs = problem.h, problem.rhs
    assert h is not None
    assert rhs is not None
    rk4 = partial(integrate, method=EIPRK4)
    plain: dict[str, Any] = {"invariants": ()}
    euclidean: dict[str, Any] = {"metric": "euclidean"}
    runs: dict[str, Callable[[tuple[float, float]], Any]] = {
        "RK4": lambda span: rk4(problem, span, **plain),
        "EIP-HL, euclidean": lambda span: rk4(problem, span, **euclidean),
        "EIP-HL": lambda span: rk4(problem, span),
        "EIP-HL, euclidean, every=5": lambda span: rk4(problem, span, every=5, **euclidean),
        "EIP-HL, every=5": lambda span: rk4(problem, span, every=5),
        "(x, v): RK4": lambda span: rk4(other, span, **plain),
        "(x, v): EIP-HL, euclidean": lambda span: rk4(other, span, **euclidean),
        "(x, v): EIP-HL": lambda span: rk4(other, span),
        "(x, v): Boris": lambda span: boris(other.field.fill, span, other.y0, h),
        "implicit midpoint": lambda span: implicit_midpoint(rhs, span, problem.y0, h, params=problem.params),
        "EIP-HL, euclidean, through solve_ivp": lambda span: through_solve_ivp(problem, span, **euclidean),
        "EIP-HL, through solve_ivp": lambda span: through_solve_ivp(problem, span, blocks=3),
    }
    counts = {name: round(share * (SOLVE_IVP_STEPS if "solve_ivp" in name else SPEED_STEPS)) for name in runs}
    actions = {
        (name, n): clocked(partial(run, (0.0, n * h)), thread_time)
        for name, run in runs.items()
        for n in (1, counts[name])
    }
    best = least(actions, turns=turns)
    return {name: 1e6 * (best[name, n] - best[name, 1]) / (n - 1) for name, n in counts.items()}


def through_solve_ivp(problem: ParticleProblem, span: tuple[float, float], **options: Any) -> Any:
    kept = problem.invariants
    return solve_ivp(problem.fun, span, problem.y0, EIPRK4, t_eval=[0], h=problem.h, invariants=kept, **options)


def speed_text(best: dict[str, float]) -> str:
    plain = {True: best["(x, v): RK4"], False: best["RK4"]}
    head = [["us per", "step"], ["times", "plain RK4"]]
    body = [(name, [compact(us, 3), compact(us / plain[name.startswith("(x")], 3)]) for name, us in best.items()]
    ratios = [
        f"through solve_ivp / compiled: {best[f'{name}, through solve_ivp'] / best[name]:.0f} ({name})"
        for name in ("EIP-HL, euclidean", "EIP-HL")
    ]
    title = "Steps of the banana orbit, canonical form where nothing else is said"
    return "\n".join([title, "", table(head, body), "", *ratios])


def particle_equations(name: str, potential: Any) -> list[tuple[Any, Any]]:
    """Return pairs (variable, rate) of the equations of motion in (x, v) in the field `name`, as expressions of heyoka.

    `potential` is the factor of 1/r in the electric potential of the field "uniform"; other fields do not use it.
    """
    heyoka = needed("heyoka", '"eip_scipy[heyoka]"')
    x, y, z, u, v, w = state = heyoka.make_vars("x", "y", "z", "u", "v", "w")
    r2 = x * x + y * y
    if name == "uniform":
        field = potential * r2 ** (-1.5)
        acceleration = (field * x + v, field * y - u, 0.0 * z)
    else:
        half = 0.5 / r2
        b = (-half * (2.0 * y + x * z), half * (2.0 * x - y * z), half * (r2 - heyoka.sqrt(r2)))
        acceleration = (v * b[2] - w * b[1], w * b[0] - u * b[2], u * b[1] - v * b[0])
    return list(zip(state, (u, v, w, *acceleration), strict=True))


class Point(NamedTuple):
    """Result of a method on a problem at one setting: seconds, and errors of position and guiding centre at the end.

    The setting is a step in units of the paper's step, or a tolerance.
    """

    scene: str
    method: str
    setting: float
    wall_time: float
    position: float
    guiding_centre: float


class Case(NamedTuple):
    """One method at one setting.

    ``seconds()`` runs it without saving states and returns the seconds that this took; ``states()`` returns saved times
    (m,) and states (6, m), which include the last gyrations.
    """

    method: str
    setting: float
    seconds: Callable[[], float]
    states: Callable[[], tuple[np.ndarray, np.ndarray]]
    problem: ParticleProblem


def cases(problem: ParticleProblem, other: ParticleProblem, with_heyoka: bool) -> Iterator[Case]:
    """Yield all methods with their settings, which are steps in units of the paper's step, or tolerances.

    `other` is the same problem as `problem`, but with states (x, v).
    """
    fine, wide, wider = (1.0, 0.5, 0.25, 0.125), (2.0, 1.0, 0.5, 0.25), (4.0, 2.0, 1.0, 0.5)
    for name, method, factors in (("RK4", EIPRK4, fine), ("RK45", EIPRK45, wide), ("DOP853", EIPDOP853, wider)):
        ways = {f"EIP-HL, {name}": problem.invariants} | ({} if name == "RK45" else {name: ()})
        for label, kept in ways.items():
            own = partial(integrate, problem, method=method, invariants=kept)
            yield from (stepped(label, problem, own, factor) for factor in factors)
    for rtol in (1e-6, 1e-8, 1e-10, 1e-12):
        yield adaptive(problem, rtol)
    assert problem.rhs is not None
    for factor in (1.0, 0.5, 0.25):
        run = partial(implicit_midpoint, problem.rhs, problem.t_span, problem.y0, params=problem.params)
        yield stepped("implicit midpoint", problem, run, factor)
    for factor in (1.0, 0.5, 0.25, 0.125, 0.0625):
        yield stepped("Boris", other, partial(boris, other.field.fill, other.t_span, other.y0), factor)
    for tolerance in (1e-6, 1e-9, 1e-12, 1e-15) if with_heyoka else ():
        yield taylor(other, tolerance)


def spacing(factor: float) -> int:
    """Return the number of steps between two saved states for steps of `factor` times the paper's.

    The saved states are then at multiples of the paper's step.
    """
    return max(round(1 / factor), 1)


def stepped(name: str, problem: ParticleProblem, method: Callable[..., Any], factor: float) -> Case:
    """Return the case of ``method(h=..., save_every=...)`` with `factor` times the paper's step."""
    assert problem.h is not None
    run = partial(method, h=factor * problem.h)
    return Case(
        name, factor, lambda: clocked(run, thread_time)(), lambda: states_of(run(save_every=spacing(factor))), problem
    )


def states_of(run: Any) -> tuple[np.ndarray, np.ndarray]:
    return run.t, run.y


def adaptive(problem: ParticleProblem, rtol: float) -> Case:
    free = replace(problem, h=None)
    run = partial(integrate, free, method=EIPDOP853, invariants=(), rtol=rtol, atol=1e-3 * rtol)
    states = lambda: states_of(run(t_eval=tail_times(problem)))  # noqa: E731
    return Case("DOP853, adaptive", rtol, lambda: clocked(run, thread_time)(), states, problem)


def taylor(problem: ParticleProblem, tolerance: float) -> Case:
    heyoka = needed("heyoka", '"eip_scipy[heyoka]"')

    def integrator() -> Any:
        return heyoka.taylor_adaptive(particle_equations(problem.field.name, 1e-2), problem.y0, tol=tolerance)

    def seconds() -> float:
        made = integrator()  # its compilation is not counted
        return clocked(lambda: made.propagate_until(problem.t_span[1]), thread_time)()

    def states() -> tuple[np.ndarray, np.ndarray]:
        made, times = integrator(), tail_times(problem)
        made.propagate_until(times[0])
        return times, np.asarray(made.propagate_grid(times)[-1]).T

    return Case("heyoka", tolerance, seconds, states, problem)


def tail_times(problem: ParticleProblem) -> np.ndarray:
    assert problem.h is not None
    steps = round(problem.t_span[1] / problem.h)
    return np.append(np.arange(steps - TAIL, steps) * problem.h, problem.t_span[1])


def costs(name: str, repeats: int, share: float, with_heyoka: bool) -> list[Point]:
    """Return the results of all methods on `share` of the interval of one problem.

    The methods run in turn, and the least time of `repeats` turns counts.
    """
    problem, other = (shortened(scene(name, form=form), share) for form in ("canonical", "velocity"))
    assert problem.h is not None
    # The reference has 1/4 of the paper's step, compensated: it is 1e-9 from the states stored with the problem.
    run = integrate(problem, method=EIPDOP853, h=problem.h / 4, save_every=4, compensated=True, invariants=())
    truth = ParticleOrbit(problem, run.t[-TAIL - 1 :], run.y[:, -TAIL - 1 :])
    chosen = list(cases(problem, other, with_heyoka))
    off = [errors(ParticleOrbit(case.problem, *case.states()), truth) for case in chosen]
    best = least({k: case.seconds for k, case in enumerate(chosen)}, turns=repeats)
    return [
        Point(name, case.method, case.setting, best[k], *error)
        for k, (case, error) in enumerate(zip(chosen, off, strict=True))
    ]


def shortened(problem: ParticleProblem, share: float) -> ParticleProblem:
    """Return the problem over about `share` of its interval, rounded to a whole number of the longest steps."""
    assert problem.h is not None
    if share == 1:
        return problem
    longest = 4 * problem.h
    return replace(problem, t_span=(0.0, round(share * problem.t_span[1] / longest) * longest))


def errors(orbit: ParticleOrbit, truth: ParticleOrbit) -> tuple[float, float]:
    """Return the errors at the end of the position and of the guiding centre averaged over a gyration, as distances.

    They are nan if the last states of `orbit` are not finite.
    """
    step = round(float(np.median(np.diff(orbit.t))) / float(np.median(np.diff(truth.t))))
    count = TAIL // step + 1
    tail = ParticleOrbit(orbit.problem, orbit.t[-count:], np.ascontiguousarray(orbit.y[:, -count:]))
    same = slice(None, None, step)
    if not np.isfinite(tail.y).all():
        return float("nan"), float("nan")
    apart = tail.averaged(tail.guiding_centre - truth.guiding_centre[:, same])[:, -1]
    return float(np.linalg.norm(tail.x[:, -1] - truth.x[:, -1])), float(np.linalg.norm(apart))


class Found(NamedTuple):
    """Microseconds for a step by the names of the methods, and the points of error against cost."""

    speed: dict[str, float]
    points: list[Point]


@dataclass(frozen=True, kw_only=True)
class ParticleCost(Measurement[Found]):
    """Command ``eip-scipy study charged-particle``."""

    writes_files = True
    repeats: int = option(3, "runs of each method at each setting (default: %(default)s)", type=int)
    quick: bool = option(False, "a hundredth of the steps, each run once")

    def measure(self, session: Session) -> Found:
        share, repeats, rounds = (0.01, 1, 1) if self.quick else (1.0, self.repeats, ROUNDS)
        with_heyoka = session.peer("heyoka", "heyoka") is not None
        with session.bar(1 + len(SCENES), "charged-particle", "part") as bar:
            best = speed(rounds * repeats, share)
            bar.update()
            points: list[Point] = []
            for name in SCENES:
                points += costs(name, repeats, share, with_heyoka)
                bar.update()
        return Found(best, points)

    def table(self, found: Found) -> str:
        body = [
            (
                f"{point.scene}, {point.method}",
                [f"{point.setting:g}", *(compact(x) for x in (point.wall_time, point.position, point.guiding_centre))],
            )
            for point in found.points
        ]
        heads = [["step or", "tolerance"], ["time [s]"], ["position"], ["guiding", "centre"]]
        return f"{speed_text(found.speed)}\n\n{table(heads, body)}"

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"microseconds_per_step": found.speed, "points": self.tables(found)["charged-particle-cost.csv"]}

    def tables(self, found: Found) -> dict[str, Rows]:
        return {"charged-particle-cost.csv": [point._asdict() for point in found.points]}

    def figures(self, found: Found) -> Figures:
        """Draw one figure for each problem."""
        from ..plotting import CostPanel, cost_figure

        kinds = {"position": "position", "guiding_centre": "guiding centre"}
        for name in dict.fromkeys(point.scene for point in found.points):
            mine = [point for point in found.points if point.scene == name]
            panels = [CostPanel(title, "processor time [s]", curves(mine, error=key)) for key, title in kinds.items()]
            title = (
                f"Charged particle, {name.replace('-', ', ')}: error at the end of the paper's interval against cost"
            )
            footnote = f"{describe_machine()}; one thread"
            figure = cost_figure([panels], error="error [system size]", title=title, footnote=footnote)
            yield f"charged-particle-cost-{name}.png", figure
