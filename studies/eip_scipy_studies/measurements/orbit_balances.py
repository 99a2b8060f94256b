"""``eip-scipy study orbit-balances``: cost and accuracy of runs that keep quantities of each planet's orbit.

Runs that keep energies, angular momenta and Laplace vectors of all orbits (``balances=`` of `nbody`), in six
combinations, are compared with runs without projection and with runs that keep the totals. All runs are made in the six
orders of the coordinate axes, in turns. Times are processor times, the least of the six; errors of position are
medians.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from eip_scipy import EIPDOP853, EIPGJ14, integrate
from eip_scipy.problems import Problem, nbody, solar_system
from eip_scipy.problems.gravity.solar_data import reference_states

from ..report import table
from ..study import Measurement, Session, option
from .orbits import ORDERS, reordered

KEPT: dict[str, tuple[str, ...] | None] = {
    "the totals": None,
    "nothing": (),
    "E": ("energy",),
    "h": ("momentum",),
    "e": ("laplace",),
    "E, h": ("energy", "momentum"),
    "E, e": ("energy", "laplace"),
    "E, h, e": ("energy", "momentum", "laplace"),
}
TILTED = Rotation.from_euler("xyz", [0.3, 0.5, 0.7])
UNIT = "E"  # the set whose time is 1


class System(NamedTuple):
    """A function that makes the problem with given `balances`, the exact final state, and the options of its runs."""

    problem: Callable[..., Problem]
    truth: np.ndarray
    options: dict[str, Any]


def ten_bodies(years: float, **options: Any) -> System:
    """Return the solar system with its packaged state after `years`, one of the times of `reference_states`.

    `options` are those of `integrate`.
    """
    return System(partial(solar_system, years=years), reference_states()[years], options)


def eccentric(years: float, **options: Any) -> System:
    """Return a planet with a = 1 AU, e = 0.6 and a heavier one outside, over `years`.

    `options` are those of `integrate`. The exact final state comes from EIPDOP853 with steps of ``options["h"] / 20``.
    """
    sun, masses, e = 4 * math.pi**2, (1e-4, 1e-3), 0.6
    gm = sun * np.array([1, *masses])
    speed = math.sqrt(sun * (1 + masses[0]) * (1 + e) / (1 - e))
    far = math.sqrt(sun * (1 + masses[1]) / 6 * 1.05 / 0.95)
    q = np.array([[0, 0, 0], [1 - e, 0, 0], [0, 6 * 0.95, 0]])
    v = np.array([[0, 0, 0], [0, speed * math.cos(0.1), speed * math.sin(0.1)], [-far, 0, 0]])
    # The planes contain no axis: components of h that are 0 would change fast relative to their size.
    q, v = (TILTED.apply(values - gm @ values / gm.sum()) for values in (q, v))
    problem = partial(nbody, gm, q, v, t_span=(0.0, years))
    fine = integrate(problem(), method=EIPDOP853, h=options["h"] / 20, invariants=(), compensated=True)
    return System(problem, fine.y[:, -1], options)


# Makers of the systems, by the share of the span that is run.
SYSTEMS: dict[str, Callable[[float], System]] = {
    "ten bodies, 1000 years, EIPGJ14, 1/512 yr": lambda share: ten_bodies(1000 * share, method=EIPGJ14, h=1 / 512),
    "ten bodies, 100 years, EIPDOP853, 1/256 yr": lambda share: ten_bodies(100 * share, method=EIPDOP853, h=1 / 256),
    "e = 0.6, 200 years, EIPDOP853, 1/100 yr": lambda share: eccentric(200 * share, method=EIPDOP853, h=1 / 100),
}


class Cost(NamedTuple):
    """Seconds of the processor, and position errors [AU] of the innermost planet and of the worst other one."""

    seconds: float
    innermost: float
    others: float


@dataclass(frozen=True, kw_only=True)
class OrbitBalances(Measurement[dict[str, dict[str, Cost]]]):
    """Command ``eip-scipy study orbit-balances``."""

    quick: bool = option(False, "a trial: 0.1 of the time spans")

    def measure(self, session: Session) -> dict[str, dict[str, Cost]]:
        found = {}
        with session.bar(len(SYSTEMS), "orbit-balances", "system") as bar:
            for name, make in SYSTEMS.items():
                system = make(0.1 if self.quick else 1.0)
                found[name] = costs(system)
                bar.update()
        return found

    def table(self, found: dict[str, dict[str, Cost]]) -> str:
        head = [["time [s]"], ["time over", f"that of {UNIT}"], ["innermost", "[AU]"], ["others", "[AU]"]]
        lines: list[tuple[str, list[str]]] = []
        for name, own in found.items():
            lines.append((name, []))
            for kept, (seconds, innermost, others) in own.items():
                share = seconds / own[UNIT].seconds
                lines.append((f"  {kept}", [f"{seconds:.3f}", f"{share:.2f}", f"{innermost:.1e}", f"{others:.1e}"]))
        return table(head, lines)


def costs(system: System) -> dict[str, Cost]:
    """Return, for each entry of `KEPT`, the least processor time and the median errors over six orders of the axes."""
    problems = {kept: system.problem(balances=quantities or None) for kept, quantities in KEPT.items()}
    problems["nothing"] = replace(problems["nothing"], invariants=())
    found: dict[str, list[Cost]] = {kept: [] for kept in KEPT}
    for axes in ORDERS:
        truth = reordered(system.truth, axes)
        for kept, problem in problems.items():
            start = replace(problem, y0=reordered(problem.y0, axes))
            begin = process_time()
            run = integrate(start, **system.options)
            seconds = process_time() - begin
            off = np.linalg.norm((run.y[:, -1] - truth).reshape(2, -1, 3)[0], axis=1)
            found[kept].append(Cost(seconds, off[1], off[2:].max()))
    return {kept: best(own) for kept, own in found.items()}


def best(runs: list[Cost]) -> Cost:
    """Combine runs of one set of balances: the least time, and the median errors."""
    seconds, innermost, others = zip(*runs, strict=True)
    return Cost(min(seconds), float(np.median(innermost)), float(np.median(others)))
