"""Make the states of the solar system in 80 bits that the library carries as data: ``python tools/solar_reference.py``.

Ten bodies under Newton's gravitation, from the state and the masses of `solar_system` in AU and Julian years, as the
library's own runs have them. The method is the summed predictor of Gauss and Jackson of order 14, written here in
NumPy's long double, with compensated sums. It evaluates the accelerations at the predicted positions and has no
corrector. The truncation error of 2000 steps a year is below the rounding error; the difference from a run with other
steps shows how large the rounding error is. With ``--taylor YEARS`` the states are compared with heyoka up to then.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import accumulate
from math import comb
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy.problems import Problem, solar_system

Array = np.ndarray
FLOAT = np.longdouble
ORDER = 14
TERMS = 30  # of the Taylor series that makes the first states
WINDOWS = 64  # lengths of the history that are kept before it moves to the first rows
TIMES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)


class Gravity:
    """Accelerations of N bodies, and Taylor steps of their motion, in the floating-point type of the masses."""

    def __init__(self, gm: Array) -> None:
        self.first, self.second = np.triu_indices(gm.size, 1)
        pairs = np.arange(self.first.size)
        # Times w_p (q_j - q_i) of the pairs p = (i, j).
        self.pulls = np.zeros((gm.size, pairs.size), gm.dtype)
        self.pulls[self.first, pairs] = gm[self.second]
        self.pulls[self.second, pairs] = -gm[self.first]

    def __call__(self, q: Array) -> Array:
        """Return the accelerations (N, 3) at the positions `q` (N, 3)."""
        d = q[self.second] - q[self.first]
        r2 = (d * d).sum(axis=1)
        return self.pulls @ (d / (r2 * np.sqrt(r2))[:, None])

    def stepped(self, q: Array, v: Array, h: Any) -> tuple[Array, Array]:
        """Return positions and velocities (N, 3) after a time `h`, by the Taylor series with `TERMS` terms."""
        qs, ds, r2, w = [q, v], [], [], []
        for k in range(TERMS):
            ds.append(qs[k][self.second] - qs[k][self.first])
            r2.append(sum((ds[j] * ds[k - j]).sum(axis=1) for j in range(k + 1)))
            # w = r2^(-3/2), from r2 w' = -3/2 r2' w.
            if k == 0:
                w.append(1 / (r2[0] * np.sqrt(r2[0])))
            else:
                parts = [(FLOAT(-3 * j) / 2 - (k - j)) * r2[j] * w[k - j] for j in range(1, k + 1)]
                w.append(sum(parts) / (k * r2[0]))
            terms = sum(w[j][:, None] * ds[k - j] for j in range(k + 1))
            qs.append(self.pulls @ terms / ((k + 1) * (k + 2)))
        position, velocity = np.zeros_like(q), np.zeros_like(q)
        for k in range(TERMS + 1, 0, -1):
            position, velocity = (position + qs[k]) * h, velocity * h + k * qs[k]
        return q + position, velocity


def inverse_powers(power: int, terms: int) -> list[Fraction]:
    """Return the first `terms` coefficients of the power series of (-log(1 - x) / x)^-power."""
    L = [Fraction(1, k + 1) for k in range(terms)]
    series = [Fraction(1)] + [Fraction(0)] * (terms - 1)
    for _ in range(power):
        quotient: list[Fraction] = []
        for k in range(terms):
            quotient.append(series[k] - sum((L[k - j] * quotient[j] for j in range(k)), Fraction(0)))
        series = quotient
    return series


def ordinates(series: Sequence[Fraction]) -> Array:
    """Convert coefficients of backward differences at the newest node to weights of the nodes, the oldest first."""
    n = len(series)
    weights = [(-1) ** j * sum((series[k] * comb(k, j) for k in range(j, n)), Fraction(0)) for j in range(n)]
    return np.array([FLOAT(w.numerator) / FLOAT(w.denominator) for w in reversed(weights)])


def two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """Return a + b and its rounding error (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def states(problem: Problem, years: Sequence[float], steps: int) -> Iterator[Array]:
    """Yield the states (6 N,) at ascending times `years`, by the Gauss-Jackson method with `steps` steps a year."""
    q, v = problem.y0.astype(FLOAT).reshape(2, -1, 3)
    gravity, per_year = Gravity(problem.params.astype(FLOAT)), FLOAT(steps)
    squares, one = inverse_powers(2, ORDER + 2), inverse_powers(1, ORDER + 1)
    sums = list(accumulate(squares))  # one step ahead
    ahead, of_q, of_v = (ordinates(series) for series in (sums[2:], squares[2:], one[1:]))
    nodes = np.empty((WINDOWS * ORDER, q.size), FLOAT)
    for k in range(ORDER):
        q, v = gravity.stepped(q, v, 1 / per_year) if k else (q, v)
        nodes[k] = gravity(q).ravel()
    s, s_rest = two_sum(v.ravel() * per_year, -(of_v @ nodes[:ORDER]))
    S, S_rest = two_sum(q.ravel() * per_year**2, s)
    S_rest = S_rest + (s_rest - of_q @ nodes[:ORDER])
    row = step = ORDER - 1
    for year in years:
        for _ in range(step, round(year * steps)):
            window = nodes[row + 1 - ORDER : row + 1]
            y = (S + (S_rest + ahead @ window)) / per_year**2
            if row + 1 == len(nodes):
                nodes[:ORDER], row = window.copy(), ORDER - 1
            row += 1
            nodes[row] = gravity(y.reshape(-1, 3)).ravel()
            s, lost = two_sum(s, nodes[row])
            s_rest = s_rest + lost
            S, lost = two_sum(S, s)
            S_rest = S_rest + (lost + s_rest)
        step = round(year * steps)
        window = nodes[row + 1 - ORDER : row + 1]
        position = ((S - s) + ((S_rest - s_rest) + of_q @ window)) / per_year**2
        yield np.concatenate([position, (s + (s_rest + of_v @ window)) / per_year])


def by_taylor(problem: Problem, years: Sequence[float]) -> Iterator[Array]:
    """Yield the states (6 N,) at ascending times `years`, by heyoka in 80 bits."""
    import heyoka

    gm, start = problem.params.astype(FLOAT), problem.y0.astype(FLOAT).reshape(2, -1, 3)
    equations = heyoka.model.nbody(gm.size, masses=list(gm), Gconst=FLOAT(1))
    integrator = heyoka.taylor_adaptive(
        equations, start.swapaxes(0, 1).ravel(), fp_type=FLOAT, tol=FLOAT(1e-22), high_accuracy=True, compact_mode=True
    )
    for year in years:
        integrator.propagate_until(FLOAT(year))
        yield integrator.state.copy().reshape(-1, 2, 3).swapaxes(0, 1).ravel()


def apart(a: Array, b: Array) -> Array:
    """Return, for each of N bodies, the distance between its positions in the states `a` and `b` (6 N,)."""
    return np.linalg.norm((a - b)[: a.size // 2].astype(float).reshape(-1, 3), axis=1)


def main() -> None:
    """Write the states, and print their distances from those of other runs."""
    parser = argparse.ArgumentParser(description="Make the states of the solar system in 80 bits.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--years", type=float, nargs="+", default=TIMES)
    parser.add_argument("--steps", type=int, default=2000, help="steps a year")
    parser.add_argument("--others", type=int, default=1500, help="steps a year of a run that shows the rounding error")
    parser.add_argument("--taylor", type=float, default=0.0, help="compare with heyoka up to this time in years")
    given = parser.parse_args()
    years, problem = sorted(given.years), solar_system()
    rows = list(states(problem, years, given.steps))
    others = {f"{given.others} steps a year": states(problem, years, given.others)}
    others["heyoka, 80 bits"] = by_taylor(problem, [year for year in years if year <= given.taylor])
    print("distances [AU] from other states: Mercury, and the largest of the others")
    for name, series in others.items():
        for year, row, other in zip(years, rows, series, strict=False):
            distance = apart(row, other)
            print(f"  {name:20} {year:8g} yr: {distance[1]:.1e} {np.delete(distance, 1).max():.1e}")
    about = (
        "Newtonian ten-body solar system from the state of problems.solar_system() in AU and Julian years: all "
        "positions [AU], then all velocities [AU/yr], by time in Julian years; Gauss-Jackson of order 14 in 80 "
        f"bits, {given.steps} steps a year; made by `python tools/solar_reference.py`"
    )
    kept = {
        f"{year:g}": [np.format_float_scientific(x, precision=19) for x in row]
        for year, row in zip(years, rows, strict=True)
    }
    given.file.write_text(json.dumps({"about": about, "states": kept}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
