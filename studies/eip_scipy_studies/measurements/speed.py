"""``eip-scipy study speed``: speed of the step, as ratios measured in one run on one core.

1. Compiled Kepler EIP-RK4 with H and L against a loop in which the same step (stages, metric, projection) is fused by
   hand for this one problem. The times per step of EIP-RK4, and of EIP-RK45 with adaptive steps, are also compared with
   that of solve_ivp with SciPy's RK45.
2. Whole calls of `integrate`, and of SciPy's solve_ivp with RK45, with one step: the time before and after the steps.
3. A process: from the start of its program to the end of its first compiled run, with user functions that are not in
   any cache.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, EIPRK45, EIPRKN12, Invariant, integrate
from eip_scipy.problems import kepler, solar_system

from ..report import needed, table
from ..study import Measurement, Session, option
from ..timing import clocked, least, many_calls

njit = needed("numba", '"eip_scipy[numba]"').njit


class Turns(NamedTuple):
    """Numbers of timed runs, of timed whole calls, and of timed processes.

    Runs are short, because other load on a shared machine disturbs long ones.
    """

    runs: int = 60
    calls: int = 7
    processes: int = 4


QUICK = Turns(1, 1, 2)
STEPS = 20_000  # of a run
H = 0.03
MU = 0.005


@njit
def kepler_array(t, y):
    r2 = y[0] * y[0] + y[1] * y[1]
    w = 1.0 / (r2 * sqrt(r2))
    w += 1.5 * MU * w / r2
    return np.array([y[2], y[3], -w * y[0], -w * y[1]])


@njit
def energy(t, y):
    r2 = y[0] * y[0] + y[1] * y[1]
    r = sqrt(r2)
    return 0.5 * (y[2] * y[2] + y[3] * y[3]) - 1.0 / r - 0.5 * MU / (r * r2)


@njit
def energy_gradient(t, y):
    r2 = y[0] * y[0] + y[1] * y[1]
    w = 1.0 / (r2 * sqrt(r2))
    w += 1.5 * MU * w / r2
    return np.array([w * y[0], w * y[1], y[2], y[3]])


@njit
def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


@njit
def momentum_gradient(t, y):
    return np.array([y[3], -y[2], -y[1], y[0]])


@njit
def _pull(a, b):
    r2 = a * a + b * b
    w = 1.0 / (r2 * sqrt(r2))
    return w + 1.5 * MU * w / r2


@njit
def _weight(err, old, new, rtol, atol):
    return abs(err) / (atol + rtol * max(abs(old), abs(new)))


@njit
def fused(a, b, c, d, h, steps, energy0, momentum0, error_metric):
    """Run EIP-RK4 on Kepler's problem, written out by hand: stages, metric, normal equations, residuals.

    The start is the position (a, b) with the velocity (c, d). `steps` steps of length h keep the energy `energy0` and
    the angular momentum `momentum0`. With `error_metric` the metric is that of the local error, otherwise
    euclidean. Return the four components of the final state, and the largest residual of an invariant.
    """
    rtol, atol = 1e-3, 1e-6
    worst = 0.0
    w = _pull(a, b)
    for _ in range(steps):
        a1, b1, c1, d1 = c, d, -w * a, -w * b
        x, y, u, v = a + 0.5 * h * a1, b + 0.5 * h * b1, c + 0.5 * h * c1, d + 0.5 * h * d1
        w = _pull(x, y)
        a2, b2, c2, d2 = u, v, -w * x, -w * y
        x, y, u, v = a + 0.5 * h * a2, b + 0.5 * h * b2, c + 0.5 * h * c2, d + 0.5 * h * d2
        w = _pull(x, y)
        a3, b3, c3, d3 = u, v, -w * x, -w * y
        x, y, u, v = a + h * a3, b + h * b3, c + h * c3, d + h * d3
        w = _pull(x, y)
        a4, b4, c4, d4 = u, v, -w * x, -w * y
        x = a + h / 6 * (a1 + 2 * (a2 + a3) + a4)
        y = b + h / 6 * (b1 + 2 * (b2 + b3) + b4)
        u = c + h / 6 * (c1 + 2 * (c2 + c3) + c4)
        v = d + h / 6 * (d1 + 2 * (d2 + d3) + d4)
        w = _pull(x, y)
        s0 = s1 = s2 = s3 = 1.0
        if error_metric:
            s0 = _weight(h / 6 * (a4 - u), a, x, rtol, atol)
            s1 = _weight(h / 6 * (b4 - v), b, y, rtol, atol)
            s2 = _weight(h / 6 * (c4 + w * x), c, u, rtol, atol)
            s3 = _weight(h / 6 * (d4 + w * y), d, v, rtol, atol)
            top = max(max(s0, s1), max(s2, s3))
            s0, s1, s2, s3 = s0 / top, s1 / top, s2 / top, s3 / top
            s0 = (atol + rtol * max(abs(a), abs(x))) * (s0 * sqrt(sqrt(s0)) + 1e-7)
            s1 = (atol + rtol * max(abs(b), abs(y))) * (s1 * sqrt(sqrt(s1)) + 1e-7)
            s2 = (atol + rtol * max(abs(c), abs(u))) * (s2 * sqrt(sqrt(s2)) + 1e-7)
            s3 = (atol + rtol * max(abs(d), abs(v))) * (s3 * sqrt(sqrt(s3)) + 1e-7)
            top = max(max(s0, s1), max(s2, s3))
            s0, s1, s2, s3 = (s0 / top) ** 2, (s1 / top) ** 2, (s2 / top) ** 2, (s3 / top) ** 2
        r2 = x * x + y * y
        r = sqrt(r2)
        g0 = 0.5 * (u * u + v * v) - 1.0 / r - 0.5 * MU / (r * r2) - energy0
        g1 = x * v - y * u - momentum0
        G0, G1 = w * x, w * y
        m00 = s0 * G0 * G0 + s1 * G1 * G1 + s2 * u * u + s3 * v * v
        m01 = s0 * G0 * v - s1 * G1 * u - s2 * u * y + s3 * v * x
        m11 = s0 * v * v + s1 * u * u + s2 * y * y + s3 * x * x
        det = m00 * m11 - m01 * m01
        p, q = -(m11 * g0 - m01 * g1) / det, -(m00 * g1 - m01 * g0) / det
        a, b = x + s0 * (p * G0 + q * v), y + s1 * (p * G1 - q * u)
        c, d = u + s2 * (p * u - q * y), v + s3 * (p * v + q * x)
        r2 = a * a + b * b
        r = sqrt(r2)
        worst = max(worst, abs(0.5 * (c * c + d * d) - 1.0 / r - 0.5 * MU / (r * r2) - energy0))
        worst = max(worst, abs(a * d - b * c - momentum0))
        if not error_metric:
            w = _pull(a, b)
    return a, b, c, d, worst


def per_step(seconds: Callable[[int], float], runs: int) -> float:
    """Return the seconds of one step, without the start of a run, from the least times of `runs` runs of two lengths.

    ``seconds(n)`` is the time of a run of n steps; the lengths are `STEPS` and 0.2 of it.
    """
    few = STEPS // 5
    best = least({n: partial(seconds, n) for n in (few, STEPS)}, turns=runs)
    return (best[STEPS] - best[few]) / (STEPS - few)


def call_time(action: Callable[[], Any], calls: int) -> float:
    """Return the least wall time of `action` in seconds over several calls, after one that is not counted."""
    action()
    return least({"": clocked(action)}, turns=calls)[""]


def of_integrate(h: float, **arguments: Any) -> Callable[[int], float]:
    """Return a function of n: the seconds of a run of n steps by `integrate`, without the time before the steps."""
    return lambda n: integrate(t_span=(0.0, n * h), h=h, **arguments).wall_time


def kepler_speed(turns: Turns) -> dict[str, float]:
    problem = kepler(relativistic=MU)
    y0 = problem.y0
    targets = [energy(0.0, y0), momentum(0.0, y0)]
    arrays = [Invariant(energy, energy_gradient, name="H"), Invariant(momentum, momentum_gradient, name="L")]
    own: dict[str, Any] = {"fun": kepler_array, "y0": y0, "method": EIPRK4, "invariants": arrays, "compiled": True}
    out = {}

    def hand_fused(error_metric: bool, n: int) -> float:
        return clocked(lambda: fused(*y0, H, n, *targets, error_metric))()

    for metric in ("euclidean", "error"):
        hand = per_step(partial(hand_fused, metric == "error"), turns.runs)
        in_place = per_step(of_integrate(H, fun=problem, method=EIPRK4, metric=metric), turns.runs)
        array = per_step(of_integrate(H, **own, metric=metric), turns.runs)
        out[f"{metric}: hand-fused loop [us/step]"] = 1e6 * hand
        out[f"{metric}: in place / hand-fused"] = in_place / hand
        out[f"{metric}: array-returning / hand-fused"] = array / hand
        out[f"{metric}: in place [us/step]"] = 1e6 * in_place
    solution = solve_ivp(kepler_array, (0, 60), y0, rtol=1e-6, atol=1e-9)
    scipy_call = call_time(lambda: solve_ivp(kepler_array, (0, 60), y0, rtol=1e-6, atol=1e-9), turns.calls)
    scipy_step = scipy_call / (solution.t.size - 1)
    adaptive: dict[str, Any] = {**own, "t_span": (0, 600), "method": EIPRK45, "rtol": 1e-6, "atol": 1e-9}
    steps = integrate(**adaptive, save_every=1).t.size - 1
    adaptive_step = min(integrate(**adaptive).wall_time for _ in range(turns.runs)) / steps
    options: dict[str, Any] = {"method": EIPRK4, "h": H, "invariants": arrays}
    fixed = call_time(lambda: solve_ivp(kepler_array, (0, 60), y0, **options), turns.calls) / round(60 / H)
    out["solve_ivp RK45 [us/step]"] = 1e6 * scipy_step
    out["solve_ivp EIPRK4 with H and L [us/step]"] = 1e6 * fixed
    out["solve_ivp RK45 / compiled EIPRK4 (array-returning), per step"] = scipy_step / array
    out["compiled EIPRK45, adaptive, with H and L [us/step]"] = 1e6 * adaptive_step
    out["solve_ivp RK45 / compiled EIPRK45 (array-returning), per step"] = scipy_step / adaptive_step
    return out


def start_times(turns: Turns) -> dict[str, float]:
    """Return the times in ms of whole calls with one step."""
    planets, invariants = solar_system(years=1.0), Invariant(energy, energy_gradient)
    y0 = kepler().y0
    calls: dict[str, Callable[[], Any]] = {
        "kepler(), EIPRK4": partial(integrate, kepler(), (0.0, H), method=EIPRK4, h=H),
        "solar_system(), EIPRKN12": partial(integrate, planets, (0.0, 0.01), method=EIPRKN12, h=0.01),
        "jitted fun, H and its gradient, EIPRK4": partial(
            integrate, kepler_array, (0.0, H), y0, method=EIPRK4, h=H, invariants=invariants
        ),
        "solve_ivp, RK45": partial(solve_ivp, kepler_array, (0.0, H), y0, first_step=H, rtol=1e-2),
    }
    best = least({name: many_calls(call) for name, call in calls.items()}, turns=10 * turns.calls)
    return {f"a call with one step: {name} [ms]": 1e3 * seconds for name, seconds in best.items()}


USER = """
import time
begin = time.perf_counter()
import numpy as np
from numba import njit
from eip_scipy import EIPRK4, Invariant, integrate
imported = time.perf_counter()
@njit
def fun(t, y):
    return np.array([y[1], -np.sin(y[0]) * %r])
@njit
def energy(t, y):
    return 0.5 * y[1] ** 2 - np.cos(y[0]) * %r
@njit
def gradient(t, y):
    return np.array([np.sin(y[0]) * %r, y[1]])
run = integrate(fun, (0.0, 1.0), [1.0, 0.0], method=EIPRK4, h=0.1, invariants=Invariant(energy, gradient))
assert run.compiled
print(imported - begin, time.perf_counter() - begin)
"""


def process_times(turns: Turns) -> dict[str, float]:
    firsts = []
    for k in range(turns.processes):
        code = USER % ((1.0 + 0.001 * k,) * 3)
        printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        firsts.append([float(x) for x in printed.split()])
    rest = np.median(np.array(firsts[1:]), axis=0)  # the first process may write bytecode
    return {
        "a process: import [s]": float(rest[0]),
        "a process: start to the end of its first compiled run [s]": float(rest[1]),
    }


@dataclass(frozen=True, kw_only=True)
class Speed(Measurement[dict[str, float]]):
    """Command ``eip-scipy study speed``."""

    quick: bool = option(False, "measure everything only once")

    def measure(self, session: Session) -> dict[str, float]:
        turns = QUICK if self.quick else Turns()
        found: dict[str, float] = {}
        with session.bar(3, "speed", "part") as bar:
            for part in (kepler_speed, start_times, process_times):
                found |= part(turns)
                bar.update()
        return found

    def table(self, found: dict[str, float]) -> str:
        return table([[""]], [(name, [f"{value:.3f}"]) for name, value in found.items()])
