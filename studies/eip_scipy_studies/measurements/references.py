"""``eip-scipy study particle-reference`` and ``scene-reference``: states in extended precision.

heyoka's Taylor series in 80 to 160 bits give the reference states that the library and the studies carry as data:
``particle_references.json`` and ``scene_references.json``. Each command writes its states as a file in the folder of
``--out`` and prints their distances from other known states.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eip_scipy.problems import ParticleProblem, Problem, comet, figure_eight, pythagorean, tokamak, uniform_field
from eip_scipy.problems.particles.charged_particle import ORBITS

from ..report import needed
from ..study import Figures, Session, Study, option

FLOAT = np.longdouble
CHECK_BITS, POINTS = 113, 100


def _heyoka() -> Any:
    return needed("heyoka", '"eip_scipy[heyoka]"')


class Found(NamedTuple):
    """Lines to print, a text about the origin of the states, and the states by problem, as they are written as JSON."""

    lines: list[str]
    about: str
    states: dict[str, Any]


class Reference(Study[Found]):
    """Base class of a study that makes reference states."""

    file = ""

    @abstractmethod
    def measure(self, session: Session) -> Found:
        """Compute the states, and return them with the lines to print."""

    def text(self, found: Found) -> str:
        return "\n".join(found.lines)

    def figures(self, found: Found) -> Figures:
        """Yield the JSON file of the states. It is written with the figures, because tables are CSV files."""
        text = json.dumps({"about": found.about, "states": found.states}, indent=1) + "\n"
        yield self.file, lambda path: path.write_text(text, encoding="utf-8")


# Charged particles. heyoka integrates the form (x, v) with B written out; therefore the states test the canonical
# equations and A and do not use them. The first momentum is that of the problem, rounded to double precision as there.


def particle_equations(name: str, potential: Any) -> list[tuple[Any, Any]]:
    """Return pairs (variable, rate) of the equations of motion in (x, v) in the field `name`, as expressions of heyoka.

    `potential` is the factor of 1/r in the electric potential of the field "uniform"; other fields do not use it.
    """
    heyoka = _heyoka()
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
    """Return the vector potential of the field `name` at `x`, for the canonical momenta, in the arithmetic of `number`.

    ``number(value)`` converts a float to this arithmetic.
    """
    half, one = number(0.5), number(1.0)
    if name == "uniform":
        return [-half * x[1], half * x[0], number(0.0)]
    r2 = x[0] * x[0] + x[1] * x[1]
    r = r2**half
    a = half * x[2] / r2
    b = half * half * ((one - r) * (one - r) + x[2] * x[2]) / r2
    return [a * x[0] - b * x[1], a * x[1] + b * x[0], -half * _log(r, number)]


def _log(r: Any, number: Any) -> Any:
    """Return the logarithm of a number near 1 in the arithmetic of `number`, by Newton's method on exp."""
    result = number(float(np.log(float(r))))
    for _ in range(3):
        term = total = number(1.0)
        for k in range(1, 60):
            term = term * result / number(float(k))
            total = total + term
        result = result + (r - total) / total
    return result


def particle_states(problem: ParticleProblem, times: np.ndarray, bits: int | None) -> np.ndarray:
    """Return rows (x, v, p) at `times` (m,), an array (m, 9), computed with `bits` bits; None: in double precision."""
    heyoka = _heyoka()

    def number(value: float) -> Any:
        return float(value) if bits is None else heyoka.real(float(value), bits)

    name = problem.field.name
    x = [number(c) for c in problem.y0[:3]]
    v = [number(p) - a for p, a in zip(problem.y0[3:], vector_potential(name, x, number), strict=True)]
    options = {} if bits is None else {"fp_type": heyoka.real}
    # 1 / 100 would not be the double 1e-2 in more bits.
    integrator = heyoka.taylor_adaptive(particle_equations(name, number(1e-2)), [*x, *v], **options)
    rows = []
    for t in times:
        integrator.propagate_until(number(t))
        now = list(integrator.state)
        momentum = [v + a for v, a in zip(now[3:], vector_potential(name, now[:3], number), strict=True)]
        rows.append([float(c) for c in (*now, *momentum)])
    return np.array(rows)


@dataclass(frozen=True, kw_only=True)
class ParticleReference(Reference):
    """Command ``eip-scipy study particle-reference``.

    It computes position, velocity and canonical momentum at each hundredth of the paper's time intervals.
    """

    file = "particle_references.json"
    bits: int = option(113, "precision in bits (default: %(default)s)", type=int)
    points: int = option(
        POINTS, "number of states to compute, from the first of the hundred on (default: %(default)s)", type=int
    )

    def measure(self, session: Session) -> Found:
        heyoka, lines, stored = _heyoka(), [], {}
        for problem in (uniform_field(), *map(tokamak, ORBITS)):
            assert problem.h is not None
            steps = round(problem.t_span[1] / problem.h)
            times = np.arange(1, self.points + 1) * (steps // POINTS) * problem.h
            rows, double = (particle_states(problem, times, bits) for bits in (self.bits, None))
            apart = np.linalg.norm(rows[:, :3] - double[:, :3], axis=1).max()
            lines.append(f"{problem.name:16} to t = {times[-1]:g}: from double precision {apart:.1e}")
            stored[problem.name] = [
                {
                    "t": float(t),
                    **dict(zip(("position", "velocity", "momentum"), row.reshape(3, 3).tolist(), strict=True)),
                }
                for t, row in zip(times, rows, strict=True)
            ]
        about = (
            "Charged particles of problems/charged_particle.py at each hundredth of the paper's intervals: heyoka "
            f"{heyoka.__version__}, Taylor, {self.bits}-bit arithmetic; made by `eip-scipy study particle-reference`."
        )
        return Found(lines, about, stored)


# Hard problems. The order of the Taylor series and the tolerance follow the precision. The differences say how well a
# problem can be solved: 64 bits are not enough for the three bodies of Burrau at t = 70.


def scenes() -> list[tuple[Problem, list[float]]]:
    """Return the problems without a closed form, with the times of the states to store."""
    return [
        (pythagorean(), [10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0]),
        (figure_eight(), [figure_eight(n).t_span[1] for n in (1, 10, 100)]),
        (comet(), [20.0]),
    ]


def scene_states(problem: Problem, times: Sequence[float], bits: int) -> np.ndarray:
    """Return states (q, v) of N bodies at `times` (m,), shape (m, 6 N), rounded from numbers of `bits` bits."""
    heyoka = _heyoka()

    def real(x: float) -> Any:
        return heyoka.real(float(x), bits)

    assert problem.params is not None
    n = problem.params.size
    system = heyoka.model.nbody(n, masses=[real(m) for m in problem.params])
    # heyoka's state is body by body.
    start = [real(x) for x in problem.y0.reshape(2, n, 3).swapaxes(0, 1).ravel()]
    integrator = heyoka.taylor_adaptive(system, start, fp_type=heyoka.real)
    rows = []
    for t in times:
        integrator.propagate_until(real(t))
        rows.append(np.array([float(x) for x in integrator.state]).reshape(n, 2, 3).swapaxes(0, 1).ravel())
    return np.array(rows)


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return, for each row of the states `a` and `b` (m, 6 N), the largest distance between the positions of a body."""
    positions = (a - b)[:, : a.shape[1] // 2].astype(float).reshape(len(a), -1, 3)
    return np.linalg.norm(positions, axis=2).max(axis=1)


@dataclass(frozen=True, kw_only=True)
class SceneReference(Reference):
    """Command ``eip-scipy study scene-reference``: states of the problems without a closed form, see `scenes`.

    It prints their differences from states computed in `CHECK_BITS` bits and, if REBOUND is installed, by IAS15.
    """

    file = "scene_references.json"
    bits: int = option(160, "precision in bits (default: %(default)s)", type=int)

    def measure(self, session: Session) -> Found:
        heyoka, lines, stored = _heyoka(), [], {}
        rebound = session.peer("rebound", "IAS15")
        for problem, times in scenes():
            rows, fewer = (scene_states(problem, times, bits) for bits in (self.bits, CHECK_BITS))
            stored[problem.name] = [{"t": t, "state": row.tolist()} for t, row in zip(times, rows, strict=True)]
            double = np.full_like(rows, np.nan)
            if rebound is not None:
                runs = [rebound.run(problem.params, problem.y0, "ias15", h=t, n_steps=1) for t in times]
                double = np.array([run.y[:, -1] for run in runs])
            for t, a, b in zip(times, difference(rows, fewer), difference(rows, double), strict=True):
                lines.append(f"{problem.name:14} t = {t:<12.6g} from {CHECK_BITS} bits: {a:.1e}   from IAS15: {b:.1e}")
        about = (
            "Final states (q of all bodies, v of all bodies) of the problems in problems/gravity/scenes.py: heyoka "
            f"{heyoka.__version__}, Taylor, {self.bits}-bit arithmetic; made by `eip-scipy study scene-reference`."
        )
        return Found(lines, about, stored)
