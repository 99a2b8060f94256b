"""Runs of the charged particles: the paper's method and others, and the numbers that distinguish them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, EIPRK5, integrate
from eip_scipy.problems import ParticleProblem, tokamak, uniform_field
from eip_scipy.problems.particles.charged_particle import ORBITS
from eip_scipy.solvers import EIPSolver

from ..comparators import boris, implicit_midpoint
from ..long_runs import named
from .orbits import ParticleOrbit, radial_range

PAPER_SETTING: dict[str, Any] = {"metric": "euclidean", "reuse_f": False}
REFINEMENT = 4  # number of steps of the reference in one step
LAST_TURN = 100
SCENES = ("uniform", *(f"tokamak-{orbit}" for orbit in ORBITS))

Runner = Callable[[ParticleProblem], Any]


@dataclass(frozen=True, eq=False)
class ParticleRun:
    """One method's run, saved at each step, with the relative errors of H and L (m,), calls of f and seconds."""

    orbit: ParticleOrbit
    energy_error: np.ndarray
    momentum_error: np.ndarray
    nfev: int
    wall_time: float


@dataclass(frozen=True, eq=False)
class ParticleStudy:
    """All runs of one problem, whose name `scene` is one of `SCENES`; `lines` has the runs by the methods' names.

    `reference` is a run by DOP853 with 1/4 of the step and compensated sums, and `reference_error` its largest distance
    from the states stored with the problem, nan if none of their times is saved.
    """

    scene: str
    problem: ParticleProblem
    reference: ParticleRun
    reference_error: float
    lines: dict[str, ParticleRun]

    @cached_property
    def numbers(self) -> dict[str, dict[str, float]]:
        """Return the results of each method, the reference first; distances and angles are relative to the reference.

        All problems have ``energy_error``, ``momentum_error`` (relative, largest), ``phase_error`` (of the gyration at
        the end, rad), ``position_error`` (at the end), ``nfev`` and ``wall_time``. Uniform field: ``gyroradius_first``
        and ``gyroradius_last`` (half the range of R in the first and the 100th turn, or the last where there are
        fewer), and ``angle_error`` (of the guiding centre, averaged over a gyration; largest). Tokamak: ``tips``
        (number of banana tips), ``tip_nearest`` and ``tip_farthest`` (least and largest R of the guiding centre at a
        tip), ``extrema_error`` (largest error of the extrema of R and z in a poloidal turn of the reference) and
        ``moment_change`` (relative, of the magnetic moment averaged over a turn, from the first to the last of these
        turns).
        """
        special = _uniform_numbers if self.scene == "uniform" else _tokamak_numbers
        return {
            name: {**_common_numbers(self, line), **special(self, line)}
            for name, line in {"reference": self.reference, **self.lines}.items()
        }


def scene(name: str, **options: Any) -> ParticleProblem:
    """Make a problem by its name, one of `SCENES`; the options are those of `uniform_field` or `tokamak`."""
    return uniform_field(**options) if name == "uniform" else tokamak(name.removeprefix("tokamak-"), **options)


def _eip(method: type[EIPSolver], kept: str, **options: Any) -> Runner:
    def run(problem: ParticleProblem) -> Any:
        chosen = [item for item in problem.invariants if item.name in kept]
        name = f"{method.__name__} keeping {kept or 'nothing'}, {problem.name}"
        return integrate(problem, method=named(method, name), save_every=1, invariants=chosen, **options)

    return run


def _midpoint(problem: ParticleProblem) -> Any:
    assert problem.rhs is not None
    assert problem.h is not None
    return implicit_midpoint(problem.rhs, problem.t_span, problem.y0, problem.h, params=problem.params, save_every=1)


PAPER_METHODS: dict[str, Runner] = {
    "RK4": _eip(EIPRK4, ""),
    "EIP-H": _eip(EIPRK4, "H", **PAPER_SETTING),
    "EIP-HL": _eip(EIPRK4, "HL", **PAPER_SETTING),
}
METHODS: dict[str, Runner] = {
    **PAPER_METHODS,
    "EIP-HL, error metric": _eip(EIPRK4, "HL"),
    "EIP-HL, RK5": _eip(EIPRK5, "HL"),
    "implicit midpoint": _midpoint,
}
BORIS = "Boris"


def _boris(problem: ParticleProblem) -> Any:
    assert problem.h is not None
    return boris(problem.field.fill, problem.t_span, problem.y0, problem.h, save_every=1)


def study(
    name: str, *, paper_only: bool = False, callback: Callable[[], Any] = lambda: None, **options: Any
) -> ParticleStudy:
    """Run the methods on one problem, one of `SCENES`, and call `callback()` after each run.

    All use the canonical form of the equations, except Boris, which is a method for (x, v). With `paper_only` the runs
    that the paper's figures do not need are left out. The options are those of the problem, such as ``t_end``.
    """
    problem, other = scene(name, **options), scene(name, form="velocity", **options)
    assert problem.h is not None
    tight = integrate(
        problem,
        method=EIPDOP853,
        h=problem.h / REFINEMENT,
        save_every=REFINEMENT,
        invariants=(),
        compensated=True,
    )
    reference = _line(problem, tight)
    callback()
    lines = {}
    for method, run in (PAPER_METHODS if paper_only else METHODS).items():
        lines[method] = _line(problem, run(problem))
        callback()
    if not paper_only:
        lines[BORIS] = _line(other, _boris(other))
        callback()
    return ParticleStudy(name, problem, reference, _distance(problem, reference.orbit), lines)


def _line(problem: ParticleProblem, run: Any) -> ParticleRun:
    orbit = ParticleOrbit(problem, run.t, run.y)
    energy, momentum = (np.abs(values / values[0] - 1) for values in (orbit.energy, orbit.momentum))
    return ParticleRun(orbit, energy, momentum, run.nfev, run.wall_time)


def _distance(problem: ParticleProblem, orbit: ParticleOrbit) -> float:
    """Return the largest distance of an orbit from the stored positions; nan if none of their times is saved."""
    assert problem.reference is not None
    every = max((orbit.t.size - 1) // 100, 1)
    known = [(k, problem.reference(float(orbit.t[k]))) for k in range(every, orbit.t.size, every)]
    apart = [np.linalg.norm(orbit.x[:, k] - state[:3]) for k, state in known if state is not None]
    return float(max(apart)) if apart else float("nan")


def _common_numbers(found: ParticleStudy, line: ParticleRun) -> dict[str, float]:
    truth = found.reference.orbit
    return {
        "energy_error": float(line.energy_error.max()),
        "momentum_error": float(line.momentum_error.max()),
        "phase_error": float(line.orbit.gyrophase[-1] - truth.gyrophase[-1]),
        "position_error": float(np.linalg.norm(line.orbit.x[:, -1] - truth.x[:, -1])),
        "nfev": line.nfev,
        "wall_time": line.wall_time,
    }


def _uniform_numbers(found: ParticleStudy, line: ParticleRun) -> dict[str, float]:
    error = line.orbit.averaged(line.orbit.guiding_angle - found.reference.orbit.guiding_angle)
    return {
        "gyroradius_first": radial_range(line.orbit, min(1.0, float(line.orbit.turns()[-1]))),
        "gyroradius_last": radial_range(line.orbit, min(LAST_TURN, float(line.orbit.turns()[-1]))),
        "angle_error": float(np.abs(error).max()),
    }


def _tokamak_numbers(found: ParticleStudy, line: ParticleRun) -> dict[str, float]:
    orbit, truth = line.orbit, found.reference.orbit
    parts = list(truth.poloidal_turns())
    tips = orbit.bounce_points()
    off = [abs(a - b) for part in parts for a, b in zip(_extrema(orbit, part), _extrema(truth, part), strict=True)]
    moments = [orbit.magnetic_moment[part].mean() for part in parts]
    return {
        "tips": tips.size,
        "tip_nearest": float(min(tips, default=np.nan)),
        "tip_farthest": float(max(tips, default=np.nan)),
        "extrema_error": float(max(off, default=np.nan)),
        "moment_change": float(moments[-1] / moments[0] - 1) if moments else float("nan"),
    }


def _extrema(orbit: ParticleOrbit, part: slice) -> Iterable[float]:
    R, z = orbit.R[part], orbit.z[part]
    return R.min(), R.max(), z.min(), z.max()
