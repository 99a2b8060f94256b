"""``eip-scipy study control``: adaptive steps controlled by the error after the projection.

The projection removes the part of the estimate e along the directions M G^T of its corrections, so that
P e = e - M G^T (G M G^T)^-1 G e remains. The runs compare the norm of e, by which the methods choose their steps, with
that of P e in the metric M of the run, with ``max(|P e|, 0.3 |e|)``, and with P in the Euclidean metric. Each number
is the geometric mean, over errors of the final state, of the calls of f relative to those of the control by e at the
same error. The last column is the largest ratio of the errors of P e and e with the same tolerance.

Result: none of these controls saves calls in the mean. The estimate is the error of a result of lower order, and its
direction differs from that of the error of the step. P e is small where the corrections happen to be along e, although
the error of the projected step is as large as elsewhere.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK23, EIPRK45, eip_method
from eip_scipy.solvers import EIPSolver

from ..hard.cases import ATOL_PER_RTOL, geometric_mean
from ..hard_cases import HardCase, hard_cases
from ..report import table
from ..study import Measurement, Session, some_of
from ..work_precision import cost_to_reach

NAMES = (
    *("kepler_e06", "kepler_e09", "outer_solar_system", "pythagorean_t10", "arenstorf", "henon_heiles_regular"),
    *("spherical_pendulum", "euler_top", "boris_2d", "schwarzschild", "heisenberg", "three_wave"),
)
METHODS = {"EIPRK23": EIPRK23, "EIPRK45": EIPRK45, "EIPDOP853": EIPDOP853}
EXPONENTS = np.arange(4, 10.1, 0.5)  # of the tolerances; those of EIPRK23 end at LAST
LAST, LEVELS, EPS, LARGEST = 7, 30, 2.0**-52, 0.1
# The norm that controls the step. norm(weights): of what a projection leaves of the estimate; None: of all of it.
CONTROLS: dict[str, Callable[[Callable[[Any], float], np.ndarray], float]] = {
    "before": lambda norm, sigma: norm(None),  # that of the package
    "after": lambda norm, sigma: norm(sigma),
    "guarded": lambda norm, sigma: max(norm(sigma), 0.3 * norm(None)),
    "Euclidean": lambda norm, sigma: norm(np.ones(sigma.size)),
}
CHANGED = [*CONTROLS][1:]


def floats(a: np.ndarray) -> np.ndarray:
    """Return real or complex numbers as floats; the real and imaginary part of a number become neighbours."""
    return np.ascontiguousarray(a).view(float)


def correction(change: np.ndarray, G: np.ndarray, weights: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return the shortest correction (n,) that changes the invariants by `change` (l,).

    Its length is the norm of its components divided by `weights` (n,). `G` are the gradients as rows of floats, see
    `floats`. The correction has the dtype of the state `like`.
    """
    sigma = np.repeat(weights / weights.max(), G.shape[1] // like.size)
    sizes = np.maximum(np.linalg.norm(G * sigma, axis=1), 1e-290)
    x = np.linalg.lstsq(G * sigma / sizes[:, None], change / sizes, rcond=np.sqrt(EPS))[0]
    return (sigma * x).view(like.dtype)


class Projected:
    """The projected step of a method with another step control, in the form of a `OneStepMethod`.

    `one_step` projects the state and returns an error estimate whose norm is the one that controls the step. Runs with
    this method are therefore given no invariants. `control` is one of the names in `CONTROLS`.
    """

    def __init__(self, case: HardCase, method: type[EIPSolver], rtol: float, control: str) -> None:
        pair: Any = method.TABLEAU
        self.problem, self.pair, self.rtol, self.control = case.problem, pair, rtol, CONTROLS[control]
        self.order, self.error_estimator_order, self.evaluations = pair.order, pair.error_estimator_order, pair.n_stages
        (self.kept,) = case.problem.invariants
        self.target = self.kept.fun(0.0, np.asarray(case.problem.y0))
        self.ends: dict[bytes, tuple[np.ndarray, Any]] = {}  # memory of the metric and f at ends of trial steps

    def one_step(self, t: float, y: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        fun, pair, begin = self.problem.fun, self.pair, y.tobytes()
        memory, f = self.ends.get(begin) or (np.zeros(y.size), fun(t, y))
        self.ends = {begin: (memory, f)}
        K = np.array([f] * (pair.n_stages + 1))
        for i in range(1, pair.n_stages):
            K[i] = fun(t + pair.c[i] * h, y + h * (pair.A[i, :i] @ K[:i]))
        y_hat = y + h * (pair.b @ K[:-1])
        K[-1] = fun(t + h, y_hat)
        if not np.isfinite(K).all():
            return y_hat + np.nan, y_hat
        err, low = (h * (e @ K) for e in (pair.e, pair.e_low))
        scale = self.rtol * (ATOL_PER_RTOL + np.maximum(abs(y), abs(y_hat)))
        estimate = abs(err) ** 2 / np.maximum(np.hypot(abs(err), 0.1 * abs(low)), 1e-290)
        ratio = np.hypot(estimate, EPS * abs(y_hat)) / scale
        memory = np.maximum(ratio / ratio.max(), 0.9 * memory)
        sigma = scale * (memory**pair.kappa + 1e-7)
        values, G = self.kept.fun(t + h, y_hat), floats(np.asarray(self.kept.grad(t + h, y_hat), y.dtype))
        terms = np.maximum(abs(values), np.abs(G * floats(y_hat)).sum(axis=1))
        g = np.where(abs(values - self.target) > 4 * EPS * terms, values - self.target, 0.0)
        y_new = y_hat - correction(g, G, sigma, y)
        self.ends[y_new.tobytes()] = memory, K[-1]

        def norm(weights: Any) -> float:
            """Return SciPy's norm of the estimate after a projection with these weights, or of all of it for None."""
            left = [e if weights is None else e - correction(G @ floats(e), G, weights, y) for e in (err, low)]
            fine, coarse = (((abs(e) / scale) ** 2).sum() for e in left)
            return float(fine / np.sqrt((fine + 0.01 * coarse) * y.size or 1.0))

        # An estimate whose norm in the solver is the one that controls the step.
        return y_new, self.control(norm, sigma) * self.rtol * (ATOL_PER_RTOL + np.maximum(abs(y), abs(y_new)))


def run_one(case: HardCase, name: str, exponent: float, control: str) -> dict[str, Any]:
    rtol, problem = 10.0**-exponent, case.problem
    options: dict[str, Any] = {"method": METHODS[name], "rtol": rtol, "atol": ATOL_PER_RTOL * rtol}
    if control == "before":
        options["invariants"] = problem.invariants
    else:
        options["method"] = eip_method(Projected(case, METHODS[name], rtol, control))
    with np.errstate(all="ignore"), warnings.catch_warnings():  # trial steps may leave the domain
        warnings.simplefilter("ignore")
        sol = solve_ivp(problem.fun, problem.t_span, problem.y0, **options)
    error = case.error(sol.y[:, -1]) if sol.success else math.inf
    made = {"case": case.name, "method": name, "control": control, "rtol": rtol}
    return made | {"error": error, "nfev": sol.nfev, "steps": sol.t.size - 1}


def relative_cost(found: Sequence[dict[str, Any]], control: str) -> float:
    """Return the calls of f of a control divided by those of the package's control ("before") at the same error.

    `found` are results of `run_one` for one method and case, and `control` is one of the names in `CONTROLS`. The
    number is the geometric mean over the errors that both reach; nan if one of them has no run with an error below
    `LARGEST`.
    """
    runs = [[row for row in found if row["control"] == x and row["error"] < LARGEST] for x in ("before", control)]
    curves = [([row["nfev"] for row in rows], [row["error"] for row in rows]) for rows in runs]
    if not all(runs):
        return math.nan
    levels = np.geomspace(min(errors[0] for _, errors in curves), max(min(errors) for _, errors in curves), LEVELS)
    return geometric_mean(cost_to_reach(*curves[1], level) / cost_to_reach(*curves[0], level) for level in levels)


def lines(found: Sequence[dict[str, Any]], method: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the table's rows for a method: its name, a row of relative costs for each case, and geometric means.

    `found` are results of `run_one`. A case's last number is the largest ratio of the errors of "after" and "before".
    """
    own, costs = [row for row in found if row["method"] == method], []
    yield method, []
    for case in dict.fromkeys(row["case"] for row in own):
        rows = [row for row in own if row["case"] == case]
        costs.append([relative_cost(rows, control) for control in CHANGED])
        before, after = ([row["error"] for row in rows if row["control"] == control] for control in ("before", "after"))
        worst = max(b / a for a, b in zip(before, after, strict=True))
        yield f"  {case}", [*(f"{cost:.2f}" for cost in costs[-1]), f"{worst:.1f}"]
    yield "  geometric mean", [*(f"{geometric_mean(column):.2f}" for column in zip(*costs, strict=True)), ""]


@dataclass(frozen=True, kw_only=True)
class Control(Measurement[list[dict[str, Any]]]):
    """Command ``eip-scipy study control``."""

    method: Sequence[str] | None = some_of("method", METHODS)
    case: Sequence[str] | None = some_of("case", NAMES)

    def measure(self, session: Session) -> list[dict[str, Any]]:
        cases, names = hard_cases(self.case or NAMES), self.method or METHODS
        found = []
        with session.bar(len(cases) * len(names), "control", "case") as bar:
            for name in names:
                for case in cases:
                    exponents = EXPONENTS if name != "EIPRK23" else EXPONENTS[EXPONENTS <= LAST]
                    found += [run_one(case, name, x, control) for control in CONTROLS for x in exponents]
                    bar.update()
        return found

    def table(self, found: list[dict[str, Any]]) -> str:
        heads = [["calls", name] for name in CHANGED] + [["error", "after / before"]]
        methods = dict.fromkeys(row["method"] for row in found)
        return table(heads, [line for method in methods for line in lines(found, method)])
