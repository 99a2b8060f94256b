"""Time of the equations of N point masses and of their invariants [ns].

    python benchmarks/gravity.py [N ...]

Each evaluation needs the one before it, as the stages of a step do.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from numba import njit

from eip_scipy.problems import nbody

REPEATS = 60


@njit
def repeat_rhs(rhs, times, y, out, params):
    for _ in range(times):
        rhs(0.0, y, out, params)
        y[0] += 1e-30 * out[-1]


@njit
def repeat_value(fun, times, y, params):
    for _ in range(times):
        y[0] += 1e-30 * fun(0.0, y, params)


@njit
def repeat_vector(fun, times, y, params):
    for _ in range(times):
        y[0] += 1e-30 * fun(0.0, y, params)[-1]


@njit
def repeat_uses_f(grad, times, y, f, out, params):
    for _ in range(times):
        grad(0.0, y, f, out, params)
        y[0] += 1e-30 * out[-1]


@njit
def repeat_rows(grad, times, y, out, params):
    for _ in range(times):
        grad(0.0, y, out, params)
        y[0] += 1e-30 * out[-1, -2]


def least(repeat, function, times, *arguments) -> float:
    repeat(function, 1, *arguments)
    best = np.inf
    for _ in range(REPEATS):
        begin = time.perf_counter()
        repeat(function, times, *arguments)
        best = min(best, time.perf_counter() - begin)
    return 1e9 * best / times


def times_of(n: int) -> list[float]:
    rng = np.random.default_rng(n)
    gm, (q, v) = 1e-6 * rng.random(n), rng.standard_normal((2, n, 3))
    problem = nbody(gm, q, 1e-3 * v, t_span=(0.0, 1.0))
    H, L = problem.invariants
    y, gm, out = problem.y0.copy(), problem.params, np.empty(6 * n)
    times = 20 + 200_000 // (n * n + 10)
    return [
        least(repeat_rhs, problem.rhs, times, y, out, gm),
        least(repeat_value, H.fun, times, y, gm),
        least(repeat_vector, L.fun, times, y, gm),
        least(repeat_uses_f, H.grad, times, y, y.copy(), out, gm),
        least(repeat_rows, L.grad, times, y, np.empty((3, 6 * n)), gm),
    ]


def main() -> None:
    print("     N " + "".join(f"{name:>11}" for name in ("equations", "H", "L", "grad H", "grad L")))
    for n in [int(x) for x in sys.argv[1:]] or (2, 3, 10, 30, 100, 300):
        print(f"{n:6} " + "".join(f"{x:11.1f}" for x in times_of(n)))


if __name__ == "__main__":
    main()
