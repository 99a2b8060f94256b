"""``eip-scipy study exoplanets``: EIPGJ14 and EIPRKN12 compared with WHFast and IAS15 on three systems of exoplanets.

A resonant chain (seven planets with the periods, masses and transits of TRAPPIST-1's, on circles at the start), a
planet of eccentricity 0.6 with one further out, and a hot Jupiter with two companions under the relativistic potential
in 1/r^2, which REBOUNDx has as `gr_potential`. Errors of position [AU], of the innermost planet and the largest of the
others, are those against heyoka in 80-bit arithmetic, which is run each time. Wall times are the least of three runs,
which take turns on one core. ``pip install reboundx heyoka``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12
from eip_scipy.problems import Problem, nbody
from eip_scipy.problems.gravity.forces import ForceConstants
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import needed
from ..solar.cost import by_us, timed
from ..study import Measurement, Session, option
from .orbits import Methods, Row, by_rebound, one_each, orbit_table, rows
from .relativity import potential, reference, speed_of_light

REPEATS = 3
GM_SUN = 4 * math.pi**2  # AU^3/yr^2, to four digits
EARTH = 3.003e-6  # solar masses


class System(NamedTuple):
    """A system of planets and the steps with which it is run.

    The fields are a problem, the period of its innermost planet [yr], whether it has relativity, and numbers of steps
    per period for EIPGJ14 (`multistep`), EIPRKN12 (`nystrom`) and WHFast (`whfast`).
    """

    problem: Problem
    period: float
    relativity: bool
    multistep: tuple[int, ...]
    nystrom: tuple[int, ...]
    whfast: tuple[int, ...]


def planets(
    star: float, elements: list[tuple[float, float, float, float, float, float]], years: float, relativity: bool = False
) -> Problem:
    """Return the problem of planets on ellipses about a star of mass `star` [solar masses], to t = `years`.

    The units are AU and years, and the barycentre is at rest at the origin. With `relativity` the potential of the star
    has a relativistic term in 1/r^2.

    `elements` of each planet: mass [solar masses], semi-major axis [AU], eccentricity, inclination, argument of the
    pericentre and mean anomaly [rad].
    """
    gm, q, v = [GM_SUN * star], [np.zeros(3)], [np.zeros(3)]
    for mass, axis, e, tilt, turn, mean in elements:
        angle = mean
        for _ in range(50):
            angle -= (angle - e * math.sin(angle) - mean) / (1 - e * math.cos(angle))
        side, speed = math.sqrt(1 - e * e), math.sqrt(GM_SUN * (star + mass) / axis) / (1 - e * math.cos(angle))
        c, s = math.cos(turn), math.sin(turn)
        along = np.array([c, s * math.cos(tilt), s * math.sin(tilt)])
        across = np.array([-s, c * math.cos(tilt), c * math.sin(tilt)])
        gm.append(GM_SUN * mass)
        q.append(axis * ((math.cos(angle) - e) * along + side * math.sin(angle) * across))
        v.append(speed * (-math.sin(angle) * along + side * math.cos(angle) * across))
    masses, place, speeds = np.array(gm), np.array(q), np.array(v)
    share = masses / masses.sum()
    options: dict[str, Any] = (
        {"forces": "gr-potential", "constants": ForceConstants(c=speed_of_light)} if relativity else {}
    )
    return nbody(masses, place - share @ place, speeds - share @ speeds, t_span=(0.0, years), **options)


def chain(share: float) -> System:
    """Return seven planets with period ratios near 8:5, 5:3, 3:2, 3:2, 4:3, 3:2, for `share` times 6 years."""
    star = 0.0898
    days = np.array([1.510826, 2.421937, 4.049219, 6.101013, 9.207540, 12.352446, 18.772866])
    transits = np.array([7.55044, 8.58728, 7.06768, 7.82771, 7.07426, 7.71462, -0.39324])
    masses = np.array([1.374, 1.308, 0.388, 0.692, 1.039, 1.321, 0.326]) * EARTH
    axes = (star * (days / YEAR_D) ** 2) ** (1 / 3)
    phases = 2 * np.pi * (7.93 - transits) / days
    elements = [(mass, axis, 0.0, 0.0, 0.0, phase) for mass, axis, phase in zip(masses, axes, phases, strict=True)]
    problem = planets(star, elements, 6.0 * share)
    return System(problem, days[0] / YEAR_D, False, (60, 70, 80, 100), (8, 10, 12, 16), (18, 30, 60, 120, 240))


def eccentric(share: float) -> System:
    """Return two planets, one at 0.5 AU with eccentricity 0.6, the other at 5 AU, for `share` times 300 years."""
    elements = [(1e-3, 0.5, 0.6, 0.1, 0.3, 1.0), (2e-3, 5.0, 0.1, 0.0, 2.0, 4.0)]
    problem = planets(1.0, elements, 300.0 * share)
    return System(problem, 0.5**1.5, False, (240, 280, 320, 400), (32, 40, 50, 64), (30, 60, 120, 240, 480))


def hot_jupiter(share: float) -> System:
    """Return three planets with relativity, the innermost at 0.04 AU, for `share` times 10 years."""
    elements = [
        (1e-3, 0.04, 0.02, 0.0, 1.0, 0.0), (3e-5, 0.09, 0.01, 0.02, 2.0, 2.0), (3e-3, 1.4, 0.1, 0.05, 0.0, 4.0),
    ]  # fmt: skip
    problem = planets(1.0, elements, 10.0 * share, relativity=True)
    return System(problem, 0.04**1.5, True, (60, 70, 80, 100), (8, 10, 12, 16), (18, 30, 60, 120, 240))


SYSTEMS = {"resonant chain": chain, "e = .6": eccentric, "hot Jupiter": hot_jupiter}


def methods(system: System) -> Methods:
    """Return the runs of a system: of each method with each of its numbers of steps per period, and of IAS15."""
    problem, period, force = system.problem, system.period, {"prepare": potential} if system.relativity else {}

    def some(name: str, run: Any, counts: tuple[int, ...]) -> Methods:
        return one_each(lambda h: f"{name}, {round(period / h)}", run, [period / n for n in counts])

    return {
        **some("EIPGJ14", by_us(problem, EIPGJ14), system.multistep),
        **some("EIPRKN12", by_us(problem, EIPRKN12, every=10, compensated=True), system.nystrom),
        **some("WHFast c17", by_rebound(problem, "whfast-c17", **force), system.whfast),
        "IAS15": (by_rebound(problem, "ias15", **force), [math.nan]),
    }


@dataclass(frozen=True, kw_only=True)
class Exoplanets(Measurement[dict[str, dict[str, Row]]]):
    """Command ``eip-scipy study exoplanets``."""

    share: float = option(1.0, "part of the full time spans that is run (default: %(default)s)", type=float)

    def measure(self, session: Session) -> dict[str, dict[str, Row]]:
        needed("reboundx", "reboundx")
        found = {}
        for name, make in SYSTEMS.items():
            system = make(self.share)
            problem = system.problem
            assert problem.params is not None
            gm = problem.params[: problem.y0.size // 6]
            truth = np.zeros_like(problem.y0)
            c = speed_of_light if system.relativity else None
            truth[: truth.size // 2] = reference(gm, problem.y0, problem.t_span[1], c)
            found[name] = rows([timed(methods(system), truth, repeats=REPEATS)])
        return found

    def table(self, found: dict[str, dict[str, Row]]) -> str:
        parts = []
        for name, own in found.items():
            system = SYSTEMS[name](self.share)
            years = system.problem.t_span[1]
            title = f"{name}: {years:g} years, {years / system.period:.0f} revolutions; steps in the innermost period"
            parts.append(f"{title}\n\n{orbit_table(own, 'innermost')}")
        return "\n\n".join(parts)
