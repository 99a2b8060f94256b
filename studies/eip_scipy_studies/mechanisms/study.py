"""``eip-scipy study mechanisms``: mechanisms with constraints and energy kept, compared with other ways to run them.

Each mechanism runs by DOP853 without projection, with its constraints kept, and with its energy as well; by SciPy's
LSODA and Radau; the four-bar linkage also with Baumgarte's terms, -2 alpha g' - alpha^2 g in the accelerations'
equations of the constraints. The error is the largest one of the last positions, against a closed form, a published
state, or a run at a tolerance of 1e-13. Calls are those of the right-hand side.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import MechanicsProblem

from ..report import table
from ..study import Check, Figures, Rows, Session, Study, some_of
from .examples import EXAMPLES, four_bar_model

__all__ = ["Mechanisms"]

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
FACTORS = (1.0, 5.0, 10.0)  # of Baumgarte
BOTH, CONSTRAINTS, NEITHER = "constraints and energy", "constraints", "DOP853"
# A run of another method ends with an error after this number of calls.
MOST_CALLS = 150_000
CALLS = 2000  # of a right-hand side that is timed


class Line(NamedTuple):
    """A run: the error is NaN where it did not come to its end."""

    mechanism: str
    method: str
    tolerance: float
    error: float
    calls: int
    reliable: bool


class Speed(NamedTuple):
    """Microseconds of a right-hand side, and seconds of processor time from a model to its first result."""

    compiled: float
    lambdified: float
    first: float


class Found(NamedTuple):
    """Everything that was measured."""

    lines: list[Line]
    speed: Speed | None


@dataclass(frozen=True, kw_only=True)
class Mechanisms(Study[Found]):
    """See the file's docstring."""

    only: Sequence[str] | None = some_of("mechanism", EXAMPLES)
    tolerances: tuple[float, ...] = TOLERANCES

    def measure(self, session: Session) -> Found:
        names = list(self.only or EXAMPLES)
        lines: list[Line] = []
        speed = None
        with session.bar(len(names), "mechanisms", "mechanism") as bar:
            for name in names:
                began = time.process_time()
                problem = EXAMPLES[name]()
                first = _kept(problem, problem.invariants, 1e-8)
                seconds = time.process_time() - began
                error = partial(_distance, _end(problem)[: len(problem.names.coordinates)])
                for tolerance in self.tolerances:
                    lines += _lines(name, problem, tolerance, error)
                if name == "four-bar":
                    speed = Speed(_compiled_microseconds(problem), _lambdified_microseconds(problem), seconds)
                assert first.success
                bar.update()
        return Found(lines, speed)

    def text(self, found: Found) -> str:
        parts = []
        for name in dict.fromkeys(line.mechanism for line in found.lines):
            own = [line for line in found.lines if line.mechanism == name]
            methods = list(dict.fromkeys(line.method for line in own))
            rows = [(f"{x:g}", [_cell(own, method, x) for method in methods]) for x in self.tolerances]
            heads = [method.split(" and ") for method in methods]
            parts.append(f"{name}: error of the last position (calls)\n{table(heads, rows)}")
        if (speed := found.speed) is not None:
            parts.append(
                f"right-hand side of the four-bar linkage: {speed.compiled:.2f} us compiled, steps included; "
                f"{speed.lambdified:.0f} us by lambdify and numpy.linalg.solve. From the model to the first result: "
                f"{speed.first:.1f} s of processor time"
            )
        return "\n\n".join([*parts, *(check.line for check in self.checks(found))])

    def tables(self, found: Found) -> dict[str, Rows]:
        return {"mechanisms.csv": [line._asdict() for line in found.lines]}

    def numbers(self, found: Found) -> dict[str, Any]:
        return {
            "runs": [line._asdict() for line in found.lines],
            "speed": None if found.speed is None else found.speed._asdict(),
        }

    def checks(self, found: Found) -> Sequence[Check]:
        return [*_four_bar_checks(found), *_others(found.lines)]

    def figures(self, found: Found) -> Figures:
        from ..plotting import blank_figure

        names = list(dict.fromkeys(line.mechanism for line in found.lines))
        width, height = 4 * min(3, len(names)), 3.2 * -(-len(names) // 3)
        figure = blank_figure(width, height, "Mechanisms: error of the last positions")
        for k, name in enumerate(names):
            axes = figure.add_subplot(-(-len(names) // 3), min(3, len(names)), k + 1)
            for method in dict.fromkeys(line.method for line in found.lines if line.mechanism == name):
                own = [line for line in found.lines if (line.mechanism, line.method) == (name, method)]
                axes.loglog([line.calls for line in own], [line.error for line in own], ".-", label=method)
            axes.set(title=name, xlabel="calls", ylabel="error")
            axes.legend(fontsize=6)
        yield "mechanisms.png", figure


def _kept(problem: MechanicsProblem, invariants: Any, tolerance: float) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a run that is not reliable is marked
        return integrate(problem, invariants=invariants, method=EIPDOP853, rtol=tolerance, atol=tolerance)


def _end(problem: MechanicsProblem) -> np.ndarray:
    """Return the last state, by a closed form or a published one, else by a run of the highest accuracy."""
    known = None if problem.reference is None else problem.reference(problem.t_span[1])
    return _kept(problem, problem.invariants, 1e-13).y[:, -1] if known is None else known


def _distance(end: np.ndarray, y: np.ndarray) -> float:
    return float(np.abs(y[: end.size] - end).max())


def _lines(
    name: str, problem: MechanicsProblem, tolerance: float, error: Callable[[np.ndarray], float]
) -> Iterable[Line]:
    for method, invariants in ((NEITHER, ()), (CONSTRAINTS, problem.constraints), (BOTH, problem.invariants)):
        run = _kept(problem, invariants, tolerance)
        wrong = error(run.y[:, -1]) if run.success else np.nan
        yield Line(name, method, tolerance, wrong, run.nfev, run.trusted)
    for method in ("LSODA", "Radau"):
        yield _by_scipy(name, method, problem.fun, problem, method, tolerance, error)
    if name == "four-bar":
        for factor in FACTORS:
            fun = _lambdified(problem, factor)
            yield _by_scipy(name, f"Baumgarte {factor:g}", fun, problem, "DOP853", tolerance, error)


class _TooManyCallsError(Exception):
    """A run is not waited for."""


def _by_scipy(
    name: str, label: str, fun: Any, problem: MechanicsProblem, method: str, tolerance: float, error: Any
) -> Line:
    calls = 0

    def counted(t: float, y: np.ndarray) -> np.ndarray:
        nonlocal calls
        calls += 1
        if calls > MOST_CALLS:
            raise _TooManyCallsError
        return fun(t, y)

    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            run = solve_ivp(counted, problem.t_span, problem.y0, method=method, rtol=tolerance, atol=tolerance)
    except (_TooManyCallsError, ValueError):  # Radau's Jacobian by differences overflows for a cyclic coordinate
        return Line(name, label, tolerance, np.nan, calls, True)
    return Line(name, label, tolerance, error(run.y[:, -1]) if run.success else np.nan, calls, True)


def _lambdified(problem: MechanicsProblem, factor: float) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return the right-hand side of the four-bar linkage as users write it: lambdify and numpy.linalg.solve."""
    import sympy

    model, constants = four_bar_model()
    state = [*model.q, *model.u]
    u = sympy.Matrix(model.u)
    rates = model._k_nh * u + model._f_nh
    rows = sympy.zeros(1, 1).col_join(-2 * factor * rates - factor**2 * model._f_h)
    plain = [sympy.Dummy() for _ in state]
    by_plain = dict(zip(state, plain, strict=True))
    expressions = [
        item.xreplace({sympy.Symbol(k.name): v for k, v in constants.items()}).xreplace(by_plain)
        for item in (model.mass_matrix, model.forcing + rows)
    ]
    matrices = sympy.lambdify([plain], expressions, cse=True)

    def fun(t: float, y: np.ndarray) -> np.ndarray:
        M, forces = matrices(y)
        return np.append(y[3:], np.linalg.solve(M, forces.ravel()))

    return fun


def _compiled_microseconds(problem: MechanicsProblem) -> float:
    runs = (_kept(problem, (), 1e-10) for _ in range(5))
    return min(run.wall_time / run.nfev for run in runs) * 1e6


def _lambdified_microseconds(problem: MechanicsProblem) -> float:
    fun, least = _lambdified(problem, 0.0), np.inf
    for _ in range(5):
        began = time.perf_counter()
        for _ in range(CALLS):
            fun(0.0, problem.y0)
        least = min(least, (time.perf_counter() - began) / CALLS)
    return least * 1e6


def _cell(lines: Iterable[Line], method: str, tolerance: float) -> str:
    line = next(line for line in lines if (line.method, line.tolerance) == (method, tolerance))
    return f"{line.error:.1e} ({line.calls})" + ("" if line.reliable else "!")


def _four_bar_checks(found: Found) -> Iterable[Check]:
    by = {(line.method, line.tolerance): line for line in found.lines if line.mechanism == "four-bar"}
    tolerances = [tolerance for method, tolerance in by if method == BOTH]
    if not tolerances:
        return
    for tolerance in tolerances:
        ours, plain = by[BOTH, tolerance], by[NEITHER, tolerance]
        best = min(by[f"Baumgarte {factor:g}", tolerance].error for factor in FACTORS)
        yield Check(
            f"four-bar at {tolerance:g}: {plain.error / ours.error:.0f} times nearer than DOP853 (at least 30), "
            f"{ours.calls / plain.calls:.3f} times its calls (at most 1.05)",
            ours.error <= plain.error / 30 and ours.calls <= 1.05 * plain.calls,
        )
        yield Check(
            f"four-bar at {tolerance:g}: {best / ours.error:.1f} times nearer than the best of Baumgarte (at least 1)",
            ours.error <= best,
        )
    if (speed := found.speed) is not None:
        ratio = speed.lambdified / speed.compiled
        yield Check(f"the compiled right-hand side is {ratio:.0f} times faster (at least 20)", ratio >= 20)
        yield Check(f"{speed.first:.1f} s from the model to the first result (at most 5)", speed.first <= 5)


def _others(lines: Iterable[Line]) -> Iterable[Check]:
    for line in lines:
        if line.method in (CONSTRAINTS, BOTH) and not line.reliable:
            yield Check(f"{line.mechanism} with {line.method} at {line.tolerance:g} is reliable", False)
