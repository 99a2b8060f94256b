"""``eip-scipy mechanisms``: mechanisms with constraints and energy kept, compared with other ways to run them.

Each mechanism runs by DOP853 without projection, with its constraints kept, and with its energy as well; by SciPy's
LSODA and Radau; by IDA of SUNDIALS with the constraints as equations, if scikit-sundae is installed; the four-bar
linkage also with Baumgarte's terms, which add -2 alpha g' - alpha^2 g to the constraints on the accelerations. The
error is the largest one of the last positions, against a closed form, a published state, or a run at a tolerance of
1e-13. Calls are those of the right-hand side, or of IDA's residual. Right-hand sides are compiled, except Baumgarte's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..report import compact, describe_machine, table
from ..study import Check, Figures, Rows, Session, Study, some_of
from ..work_precision import costs_at, curves, work_precision
from .examples import EXAMPLES, PUBLISHED
from .figures import four_bar_figures
from .speed import Speed, speed
from .ways import BOTH, CONSTRAINTS, FACTORS, NEITHER, Outcome, Way, kept, ways

TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
LEVELS = (1e-2, 1e-4, 1e-6, 1e-8)  # errors whose costs are compared
FINEST, AGREEMENT = 1e-13, 1e-8  # a run at this tolerance meets published states within this relative distance
# Mechanisms whose errors are compared with those of runs without projection, at tolerances from this one on.
LEAST_WEIGHED = 1e-9
WEIGHED = ("andrews", "bricard", "wobbling disc", "steady disc", "knife edge")


class Line(NamedTuple):
    """Results of a method at one tolerance.

    The error is NaN if the run did not reach its end. The processor time is the least of several runs.
    """

    mechanism: str
    method: str
    tolerance: float
    error: float
    calls: int
    seconds: float
    reliable: bool


class Found(NamedTuple):
    """Everything that was measured.

    `published` has, for each mechanism with a published last state, the largest relative difference of a component from
    it, in a run at the tolerance `FINEST`.
    """

    lines: list[Line]
    published: dict[str, float]
    speed: Speed | None
    machine: str

    @property
    def by_mechanism(self) -> dict[str, list[Line]]:
        """Return the results (`Line`) by the name of their mechanism."""
        names = dict.fromkeys(line.mechanism for line in self.lines)
        return {name: [line for line in self.lines if line.mechanism == name] for name in names}


@dataclass(frozen=True, kw_only=True)
class Mechanisms(Study[Found]):
    """Command ``eip-scipy mechanisms``."""

    only: Sequence[str] | None = some_of("mechanism", EXAMPLES)
    tolerances: tuple[float, ...] = TOLERANCES
    repeats: int = 3

    def measure(self, session: Session) -> Found:
        names = list(self.only or EXAMPLES)
        lines: list[Line] = []
        published: dict[str, float] = {}
        with session.bar(len(names), "mechanisms", "mechanism") as bar:
            for name in names:
                problem = EXAMPLES[name]()
                end = None if problem.reference is None else problem.reference(problem.t_span[1])
                if end is None or name in PUBLISHED:
                    finest = kept(problem, problem.invariants, FINEST).y[:, -1]
                    end = finest if end is None else end
                    published |= {name: float(np.abs(finest[: end.size] / end - 1).max())} if name in PUBLISHED else {}
                lines += self._lines(name, ways(problem, session), end[: len(problem.names.coordinates)])
                bar.update()
        return Found(lines, published, speed() if "four-bar" in names else None, describe_machine())

    def _lines(self, name: str, found: dict[str, Way], end: np.ndarray) -> Iterable[Line]:
        outcomes: dict[tuple[str, float], Outcome] = {}

        def runner(method: str, way: Way) -> Callable[[float], tuple[float, np.ndarray]]:
            def run(tolerance: float) -> tuple[float, np.ndarray]:
                outcome = outcomes[method, tolerance] = way(tolerance)
                return outcome.seconds, outcome.y

            return run

        for way in found.values():
            way(self.tolerances[0])  # compiles
        timed = work_precision(
            {method: (runner(method, way), self.tolerances) for method, way in found.items()},
            lambda y: float(np.abs(y[: end.size] - end).max()),
            repeats=self.repeats,
        )
        for point in timed.points:
            outcome = outcomes[point.method, point.step]
            yield Line(name, point.method, point.step, point.error, outcome.calls, point.wall_time, outcome.reliable)

    def text(self, found: Found) -> str:
        parts = [
            f"Mechanisms, by constraints and energy and by other methods\n{found.machine}; processor time, one thread"
        ]
        for name, own in found.by_mechanism.items():
            methods = list(dict.fromkeys(line.method for line in own))
            rows = [(method, [_cell(own, method, x) for x in self.tolerances]) for method in methods]
            heads = [[f"{x:g}"] for x in self.tolerances]
            parts.append(f"{name}: error of the last position (calls), by tolerance\n{table(heads, rows)}")
            parts.append(f"{name}: calls and milliseconds for an error of\n{_costs(own)}")
        if (times := found.speed) is not None:
            parts.append(
                f"right-hand side of the four-bar linkage: {times.compiled:.2f} us compiled, steps included; "
                f"{times.lambdified:.0f} us by lambdify and numpy.linalg.solve. From the model to the first result: "
                f"{times.first:.1f} s of processor time"
            )
        return "\n\n".join([*parts, "\n".join(check.line for check in self.checks(found))])

    def tables(self, found: Found) -> dict[str, Rows]:
        return {"mechanisms.csv": [line._asdict() for line in found.lines]}

    def numbers(self, found: Found) -> dict[str, Any]:
        return {
            "runs": [line._asdict() for line in found.lines],
            "published": found.published,
            "speed": None if found.speed is None else found.speed._asdict(),
        }

    def checks(self, found: Found) -> Sequence[Check]:
        return [
            *_four_bar_checks(found),
            *_published_checks(found),
            *_weights_checks(found.lines),
            *_others(found.lines),
        ]

    def figures(self, found: Found) -> Figures:
        from ..plotting import CostPanel, cost_figure

        every = [CostPanel(name, "calls", curves(own, "calls")) for name, own in found.by_mechanism.items()]
        settings: dict[str, Any] = {"error": "error of the last position", "size": (4.0, 2.8), "shared": False}
        title, footnote = "Mechanisms: error against calls", "errors above 1 left out"
        rows = [every[k : k + 3] for k in range(0, len(every), 3)]
        yield "mechanisms.png", cost_figure(rows, title=title, footnote=footnote, largest=1.0, **settings)
        if (own := found.by_mechanism.get("four-bar")) is not None:
            costs = {"calls": "calls of the right-hand side", "seconds": "processor time [s]"}
            panels = [CostPanel("", label, curves(own, cost)) for cost, label in costs.items()]
            yield from zip(("four-bar.png", "linkage.png"), four_bar_figures(panels), strict=True)


def _costs(lines: Sequence[Line]) -> str:
    """Lay out the calls and milliseconds with which each method reaches each error of `LEVELS`.

    Runs that did not reach their end are left out.
    """
    done = [line for line in lines if np.isfinite(line.error)]
    by_calls, by_time = curves(done, "calls"), curves(done, "seconds")
    heads = [[f"{level:g}", what] for what in ("calls", "ms") for level in LEVELS]
    body = [(m, [*costs_at(by_calls[m], LEVELS), *costs_at(by_time[m], LEVELS, 1e3)]) for m in by_calls]
    return table(heads, body)


def _cell(lines: Iterable[Line], method: str, tolerance: float) -> str:
    line = next(line for line in lines if (line.method, line.tolerance) == (method, tolerance))
    return f"{compact(line.error)} ({line.calls})" + ("" if line.reliable else "!")


def _four_bar_checks(found: Found) -> Iterable[Check]:
    by = {(line.method, line.tolerance): line for line in found.lines if line.mechanism == "four-bar"}
    for tolerance in (tolerance for method, tolerance in by if method == BOTH):
        ours, plain = by[BOTH, tolerance], by[NEITHER, tolerance]
        best = min(by[f"Baumgarte {factor:g}", tolerance].error for factor in FACTORS)
        yield Check(
            f"four-bar at {tolerance:g}: {plain.error / ours.error:.0f} times smaller error than DOP853 (at least 30), "
            f"{ours.calls / plain.calls:.3f} times its calls (at most 1.05)",
            ours.error <= plain.error / 30 and ours.calls <= 1.05 * plain.calls,
        )
        yield Check(
            f"four-bar at {tolerance:g}: {best / ours.error:.1f} times smaller error than the best of Baumgarte (at "
            "least 1)",
            ours.error <= best,
        )
    if (times := found.speed) is not None:
        ratio = times.lambdified / times.compiled
        yield Check(
            f"the compiled right-hand side is {ratio:.0f} times faster than by lambdify (at least 20)", ratio >= 20
        )
        yield Check(f"{times.first:.1f} s from the model to the first result (at most 5)", times.first <= 5)


def _published_checks(found: Found) -> Iterable[Check]:
    for name, distance in found.published.items():
        text = f"{name} at {FINEST:g}: within {distance:.1e} of the published last state (at most {AGREEMENT:g})"
        yield Check(text, distance <= AGREEMENT)


def _weights_checks(lines: Sequence[Line]) -> Iterable[Check]:
    """Yield checks that errors with projection are hardly larger than without.

    They would be larger if the weights of the corrections were wrong.
    """
    by = {(line.mechanism, line.method, line.tolerance): line.error for line in lines}
    for name in dict.fromkeys(line.mechanism for line in lines if line.mechanism in WEIGHED):
        for what in (CONSTRAINTS, BOTH):
            ratios = [
                error / by[name, NEITHER, x]
                for (which, method, x), error in by.items()
                if (which, method) == (name, what) and x >= LEAST_WEIGHED
            ]
            mean, worst = float(np.exp(np.mean(np.log(ratios)))), max(ratios)
            yield Check(
                f"{name}, {what}: {mean:.2g} times DOP853's error in the mean (at most 1.2), {worst:.2g} times in one "
                "run (at most 3)",
                mean <= 1.2 and worst <= 3,
            )


def _others(lines: Iterable[Line]) -> Iterable[Check]:
    for line in lines:
        if line.method in (CONSTRAINTS, BOTH) and not line.reliable:
            yield Check(f"{line.mechanism} with {line.method} at {line.tolerance:g} is reliable", False)
