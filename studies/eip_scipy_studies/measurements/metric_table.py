"""``eip-scipy study metric-table``: effect of the projection's metric on the solar system.

RK4, h = 0.002 yr, DE440 system barycentres, invariants H and L: every EIP row keeps both to 1e-15; the rows differ in
the planets that the corrections move. Errors are those of unwrapped heliocentric ecliptic longitudes [rad] against the
packaged reference states after 100 and 2000 years. Below them, for random rotations of the axes: the position error of
Mercury by plain RK4 divided by that by EIP, with blocks of 3 and without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import nbody, solar_system
from eip_scipy.problems.gravity.solar_data import load

from ..comparators import stormer_verlet
from ..report import table
from ..study import Session, Study, option
from ..work_precision import known_end

STEP = 0.002
SAVE_EVERY = 20
GRAVITATION = 6.6743e-11  # converts G m [m^3/s^2] to masses [kg] for the row in SI momenta
OBLIQUITY = np.deg2rad(84381.448 / 3600)
PLANETS = ("Mercury", "Venus", "EMB", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto")


def longitudes(y: np.ndarray) -> np.ndarray:
    """Return unwrapped heliocentric ecliptic longitudes (9, m) in rad of states (60, m)."""
    q = y[:30].reshape(10, 3, -1)
    q = q[1:] - q[:1]
    north = np.cos(OBLIQUITY) * q[:, 1] + np.sin(OBLIQUITY) * q[:, 2]
    return np.unwrap(np.arctan2(north, q[:, 0]), axis=1)


def turn(angle: np.ndarray) -> np.ndarray:
    """Return the angle in (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def reference_longitudes(near: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return longitudes (9,) of the reference state (60,) in rad, plus the whole turns that a nearby run has made.

    `near` are the states (60, m) of that run, whose errors of longitude must be below pi.
    """
    last = longitudes(near)[:, -1]
    return last + turn(longitudes(reference[:, None])[:, 0] - last)


def position_errors(y: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the distances (9,) in AU between the planets' positions in the states `y` and `reference` (60,)."""
    return np.linalg.norm((y - reference)[:30].reshape(10, 3), axis=1)[1:]


def momentum_weights(masses: np.ndarray) -> np.ndarray:
    """Return the weights (60,) of the metric in (q, v) that corresponds to the euclidean metric in (q, p)."""
    return np.concatenate([np.ones(30), np.repeat(1 / masses, 3)])


def metric_rows(years: float) -> dict[str, np.ndarray]:
    """Return, for each row of the table, the planets' errors of longitude (9,) in rad after `years` years."""
    problem, si = solar_system(years=years), solar_system(years=years, units="SI")
    assert problem.params is not None
    assert si.params is not None
    suns = problem.params / problem.params[0]
    half = np.repeat(1 / np.sqrt(suns), 3)
    common: dict[str, Any] = {"method": EIPRK4, "save_every": SAVE_EVERY}
    runs = {
        "RK4 alone": integrate(problem, invariants=(), **common).y,
        "EIP, euclidean, SI (q, p)": integrate(si, metric=momentum_weights(si.params / GRAVITATION), **common).y,
        "EIP, euclidean, AU/yr (q, p)": integrate(problem, metric=momentum_weights(suns), **common).y,
        "EIP, euclidean, AU/yr (q, v)": integrate(problem, metric="euclidean", **common).y,
        "EIP, mass-weighted": integrate(problem, metric=np.concatenate([half, half]), **common).y,
        "EIP, error-weighted, blocks, frame": integrate(problem, **common).y,
    }
    runs["EIP, euclidean, SI (q, p)"] = runs["EIP, euclidean, SI (q, p)"] / 1.495978707e11
    assert problem.acc is not None
    verlet = stormer_verlet(problem.acc, problem.t_span, problem.y0, STEP, params=problem.params, save_every=SAVE_EVERY)
    reference = known_end(problem)
    truth = reference_longitudes(runs["EIP, error-weighted, blocks, frame"], reference)
    rows = {"Stoermer-Verlet (kick-drift-kick)": longitudes(verlet.y)[:, -1] - truth}
    return rows | {name: longitudes(y)[:, -1] - truth for name, y in runs.items()}


def rotation_gains(rotations: int, seed: int = 1) -> list[dict[str, float]]:
    """Return, for each random rotation of the axes, Mercury's position error by plain RK4 divided by that by EIP.

    The keys are "blocks of 3" and "no blocks" (of the metric). The runs end after 100 years.
    """
    data = load("de440")
    scale = 365.25
    out = []
    for turned in Rotation.random(rotations, rng=seed).as_matrix():
        problem = nbody(
            data.gm * scale**2,
            data.position @ turned.T,
            data.velocity @ turned.T * scale,
            t_span=(0.0, 100.0),
            h=STEP,
        )
        reference = (known_end(solar_system(years=100.0)).reshape(20, 3) @ turned.T).ravel()
        ways: dict[str, dict[str, Any]] = {
            "plain": {"invariants": ()},
            "blocks of 3": {},
            "no blocks": {"blocks": None},
        }
        errors = {
            name: position_errors(integrate(problem, method=EIPRK4, **options).y[:, -1], reference)[0]
            for name, options in ways.items()
        }
        out.append({name: errors["plain"] / errors[name] for name in errors if name != "plain"})
    return out


@dataclass(frozen=True, kw_only=True)
class MetricTable(Study[dict[str, Any]]):
    """Command ``eip-scipy study metric-table``."""

    writes_files = False
    years: Sequence[float] = option(
        (100.0, 2000.0), "lengths of the runs in Julian years", type=float, nargs="+", choices=(100.0, 1000.0, 2000.0)
    )
    rotations: int = option(5, "number of random rotations of the axes (default: %(default)s)", type=int)

    def measure(self, session: Session) -> dict[str, Any]:
        found: dict[str, Any] = {f"{years:g} years": metric_rows(years) for years in self.years}
        return found | {"rotations": rotation_gains(self.rotations)}

    def text(self, found: dict[str, Any]) -> str:
        parts = []
        for span, rows in found.items():
            if span == "rotations":
                continue
            body = [(name, [f"{value:.1e}" for value in row]) for name, row in rows.items()]
            title = f"Error of longitude after {span}, h = {STEP} yr [rad]"
            parts.append(f"{title}\n\n{table([[planet] for planet in PLANETS], body)}")
        gains = ["   ".join(f"{name}: {value:.4g}" for name, value in gain.items()) for gain in found["rotations"]]
        title = "Mercury after 100 years, random axes: plain RK4's position error over EIP's"
        return "\n\n".join([*parts, "\n".join([title, *gains])])

    def numbers(self, found: dict[str, Any]) -> dict[str, Any]:
        return found
