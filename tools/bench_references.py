#!/usr/bin/env python3
"""Compute the reference states of the bench in 80-bit arithmetic, and write them to the studies' data.

    python tools/bench_references.py [NAME ...]

Extrapolation of Gragg's midpoint rule to order 20, and of the linearly implicit Euler rule for stiff systems (Hairer,
Norsett and Wanner, Solving Ordinary Differential Equations I, II.9, and II, IV.9), with steps of fixed length. The
result is that of the finer of two runs; their difference, which is printed, estimates the error of the coarser one.
Bodies come from stored states of the library where it has them, mechanisms from publications or from other coordinates.
NumPy's longdouble must have 80 bits or more.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from solar_reference import Gravity

from eip_scipy_studies.bench import mechanisms
from eip_scipy_studies.bench.cases import ATOMS, CASES, Case

DATA = Path(__file__).parent.parent / "studies/eip_scipy_studies/data/bench_references.json"
Vector = Any
COLUMNS = 10
STEPS = {  # of the coarser run; the finer one takes 1.5 times as many
    "perturbed Kepler": 50_000, "Hénon-Heiles": 2500, "double pendulum": 300, "halo orbit": 4000, "rigid body": 2000,
    "Lennard-Jones": 200, "charged particle": 60_000, "Robertson": 900, "magnet": 16_000,
    "resonant chain": 6000,
}  # fmt: skip


def lennard_jones(t: Any, y: Vector) -> Vector:
    """Return the same forces as `cases.atoms`, by whole arrays."""
    q = y[: 3 * ATOMS].reshape(ATOMS, 3)
    d = q[:, None] - q[None, :]
    r2 = (d * d).sum(-1)
    np.fill_diagonal(r2, 1)
    s6 = r2**-3
    w = 24 * s6 * (2 * s6 - 1) / r2
    np.fill_diagonal(w, 0)
    return np.concatenate([y[3 * ATOMS :], (w[..., None] * d).sum(1).ravel()])


def gragg(f: Callable[..., Vector], y: Vector, h: Any) -> Vector:
    """Take one step of the extrapolated midpoint rule."""
    start, columns, counts = f(0, y), [], [2 * (k + 1) for k in range(COLUMNS)]
    for n in counts:
        part = h / n
        before, now = y, y + part * start
        for _ in range(n - 1):
            before, now = now, before + 2 * part * f(0, now)
        columns.append((before + now + part * f(0, now)) / 2)
    return extrapolated(columns, [np.longdouble(n) ** 2 for n in counts])


def implicit(f: Callable[..., Vector], y: Vector, h: Any) -> Vector:
    """Take one step of the extrapolated linearly implicit Euler rule, with the Jacobian of Robertson's reactions."""
    b, c = y[1:]
    number = np.longdouble
    J = np.array([[number("-0.04"), 1e4 * c, 1e4 * b], [number("0.04"), -1e4 * c - 6e7 * b, -1e4 * b], [0, 6e7 * b, 0]])
    columns = []
    for n in range(1, COLUMNS + 1):
        inverse, now = inverted(np.eye(3) - h / n * J), y
        for _ in range(n):
            now = now + inverse @ (h / n * f(0, now))
        columns.append(now)
    return extrapolated(columns, [number(n) for n in range(1, COLUMNS + 1)])


def inverted(A: Vector) -> Vector:
    """Return the inverse of a 3 by 3 matrix by its cofactors, which NumPy's linear algebra lacks in 80 bits."""
    rows = np.array([np.cross(A[1], A[2]), np.cross(A[2], A[0]), np.cross(A[0], A[1])])
    return rows.T / (A[0] @ rows[0])


def extrapolated(columns: list[Vector], powers: list[Any]) -> Vector:
    """Return the limit by Neville's scheme, for errors in powers of 1 / `powers`."""
    for k in range(1, len(columns)):
        for j in range(len(columns) - 1, k - 1, -1):
            columns[j] = columns[j] + (columns[j] - columns[j - 1]) / (powers[j] / powers[j - k] - 1)
    return columns[-1]


def end(case: Case, steps: int) -> Vector:
    """Return the state at the end."""
    y, t_end = case.y0.astype(np.longdouble), np.longdouble(case.t_end)
    if case.gm is not None:
        half, newton = y.size // 2, Gravity(case.gm.astype(np.longdouble))
        return steady(lambda _, y: np.append(y[half:], newton(y[:half].reshape(-1, 3))), y, t_end, steps)
    if not case.scalar:
        return steady(lennard_jones, y, t_end, steps)
    parts = case.make(np).fun
    if case.name == "Robertson":  # steps that grow from 1e-6 to the end
        for h in np.diff(np.concatenate([[0], np.geomspace(np.longdouble(1e-6), t_end, steps)])):
            y = implicit(lambda t, y: np.array(parts(t, y)), y, h)
        return y
    return steady(lambda _, y: np.array([*parts(y[-1], y[:-1]), 1]), np.append(y, 0), t_end, steps)[:-1]


def steady(f: Callable[..., Vector], y: Vector, t_end: Any, steps: int) -> Vector:
    """Return the state at the end by steps of equal length."""
    for _ in range(steps):
        y = gragg(f, y, t_end / steps)
    return y


def four_bar(steps: int) -> Vector:
    """Return the positions of the four-bar linkage at the end, by its equations without projection."""
    matrices, y = mechanisms.four_bar_matrices(0.0), mechanisms.four_bar().y0.astype(np.longdouble)

    def f(t: Any, y: Vector) -> Vector:
        M, forces = matrices(y)
        return np.append(y[3:], inverted(M) @ forces.ravel())

    return steady(f, y, np.longdouble(CASES["four-bar"].t_end), steps)[:3]


def disc(digits: int) -> Vector:
    """Return the positions of the disc at the end, by its reference in coordinates that need no constraints."""
    problem = mechanisms.disc(True)
    return problem.reference(problem.t_span[1])[: len(problem.names.coordinates)]


MECHANISMS: dict[str, tuple[Callable[[int], Vector], int, int]] = {
    "four-bar": (four_bar, 6000, 9000),
    "andrews": (lambda _: np.array(mechanisms.END), 0, 0),  # as published
    "wobbling disc": (disc, 0, 0),
}


def main() -> None:
    """Compute the references that are named, or all of them."""
    known = json.loads(DATA.read_text(encoding="utf-8")) if DATA.exists() else {}
    for name in sys.argv[1:] or [name for name, case in CASES.items() if not case.members]:
        case = CASES[name]
        known_state = None if case.gm is None else case.ready().reference
        final = known_state and known_state(case.t_end)
        if final is not None:
            print(f"{name}: a stored state of the library")
        else:
            compute, few, more = MECHANISMS.get(name) or (partial(end, case), STEPS[name], STEPS[name] * 3 // 2)
            coarse, final = compute(few), compute(more)
            print(f"{name}: {float(np.abs(coarse - final).max() / np.abs(final).max()):.1e}", flush=True)
        known[name] = [float(value) for value in final]
        DATA.write_text(json.dumps(known, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
