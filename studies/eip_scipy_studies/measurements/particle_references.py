"""Reference states of the charged particles, by Taylor's method in extended precision (heyoka, ``pip install heyoka``).

    python -m eip_scipy_studies.measurements.particle_references [--bits 113] [--points 100] [--out FILE]

writes ``particle_references.json`` anew: position, velocity and canonical momentum at each hundredth of the paper's
intervals, with the largest difference of a position from the same run in double precision. heyoka integrates the form
(x, v) with B written out; so the canonical equations and A are tested by the states, not used for them. The first
momentum is that of the problem, rounded to double precision as there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy.problems import ParticleProblem, tokamak, uniform_field
from eip_scipy.problems.particles.charged_particle import ORBITS

from .installed import peer

heyoka = peer("heyoka", '"eip_scipy[heyoka]"')

TARGET = Path(__file__).parents[1] / "eip_scipy" / "data" / "particle_references.json"
BITS, POINTS = 113, 100


def system(name: str, potential: Any) -> list[tuple[Any, Any]]:
    """The equations of motion in (x, v), as symbols."""
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


def vector_potential(name: str, x: Any, number: Any) -> list[Any]:
    """A in the arithmetic of `number`, for the canonical momenta."""
    half, one = number(0.5), number(1.0)
    if name == "uniform":
        return [-half * x[1], half * x[0], number(0.0)]
    r2 = x[0] * x[0] + x[1] * x[1]
    r = r2**half
    a = half * x[2] / r2
    b = half * half * ((one - r) * (one - r) + x[2] * x[2]) / r2
    return [a * x[0] - b * x[1], a * x[1] + b * x[0], -half * log(r, number)]


def log(r: Any, number: Any) -> Any:
    """Logarithm of numbers near 1: Newton's method on exp, whose series is short there."""
    result = number(float(np.log(float(r))))
    for _ in range(3):
        term = total = number(1.0)
        for k in range(1, 60):
            term = term * result / number(float(k))
            total = total + term
        result = result + (r - total) / total
    return result


def states(problem: ParticleProblem, times: np.ndarray, bits: int | None) -> np.ndarray:
    """Rows (x, v, p) at `times`; `bits` None: in double precision."""

    def number(value: float) -> Any:
        return float(value) if bits is None else heyoka.real(float(value), bits)

    name = problem.field.name
    x = [number(c) for c in problem.y0[:3]]
    v = [number(p) - a for p, a in zip(problem.y0[3:], vector_potential(name, x, number), strict=True)]
    options = {} if bits is None else {"fp_type": heyoka.real}
    # 1 / 100 would not be the double 1e-2 in more bits.
    integrator = heyoka.taylor_adaptive(system(name, number(1e-2)), [*x, *v], **options)
    rows = []
    for t in times:
        integrator.propagate_until(number(t))
        now = list(integrator.state)
        momentum = [v + a for v, a in zip(now[3:], vector_potential(name, now[:3], number), strict=True)]
        rows.append([float(c) for c in (*now, *momentum)])
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bits", type=int, default=BITS)
    parser.add_argument("--points", type=int, default=POINTS, help="how many of the hundred, from the first on")
    parser.add_argument("--out", type=Path, default=TARGET)
    args = parser.parse_args()
    stored = {}
    for problem in (uniform_field(), *map(tokamak, ORBITS)):
        assert problem.h is not None
        steps = round(problem.t_span[1] / problem.h)
        times = np.arange(1, args.points + 1) * (steps // POINTS) * problem.h
        rows, double = states(problem, times, args.bits), states(problem, times, None)
        apart = np.linalg.norm(rows[:, :3] - double[:, :3], axis=1).max()
        print(f"{problem.name:16} to t = {times[-1]:g}: from double precision {apart:.1e}", flush=True)
        stored[problem.name] = [
            {"t": float(t), "position": row[:3].tolist(), "velocity": row[3:6].tolist(), "momentum": row[6:].tolist()}
            for t, row in zip(times, rows, strict=True)
        ]
    about = (
        "Charged particles of problems/charged_particle.py at each hundredth of the paper's intervals: heyoka "
        f"{heyoka.__version__}, Taylor, {args.bits}-bit arithmetic; made by benchmarks/particle_references.py."
    )
    args.out.write_text(json.dumps({"about": about, "states": stored}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
