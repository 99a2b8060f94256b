"""``eip-scipy transits``: transit times and their derivatives, against heyoka in 80 bits and REBOUND's IAS15."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRKN12, integrate
from eip_scipy.problems import Problem, nbody, transits

from .output import Output
from .report import compact, needed, table

SUN = 0.01720209895**2  # G times the mass of the star, in AU and days
SYSTEMS: dict[str, tuple[Any, Any, float]] = {  # periods in days, masses in those of the star, eccentricities
    "Kepler-36": ([13.84, 16.23], [4.15e-6, 7.56e-6], 0.02),
    "seven planets": ([1.511, 2.422, 4.050, 6.100, 9.207, 12.353, 18.767], np.linspace(1e-6, 1.4e-5, 7), 0.005),
}
KEYS = ("transits", "error", "IAS15", "seconds")
AXIS = (1.0, 0.0, 0.0)
BOUND = 1e-8  # days
SHARE, AGREE = 1e-8, 1e-6  # of a component or the star's mass, for differences; of the largest derivative of a kind


def system(name: str, days: float) -> Problem:
    """Return a system whose planets are seen edge-on along the x axis, in AU and days."""
    periods, masses, e = SYSTEMS[name]
    n = 2 * np.pi / np.array(periods)
    a, k = (SUN / n**2) ** (1 / 3), np.arange(n.size)
    E, turned = 2.4 * k + 0.5, np.exp(1.3j * k)  # eccentric anomalies, and the directions of the pericentres
    X = a * (np.cos(E) - e + 1j * np.sqrt(1 - e**2) * np.sin(E)) * turned
    V = a * n / (1 - e * np.cos(E)) * (-np.sin(E) + 1j * np.sqrt(1 - e**2) * np.cos(E)) * turned
    q, v = (np.vstack([np.zeros(3), np.stack([z.real, z.imag, 0 * a], axis=-1)]) for z in (X, V))
    return nbody(SUN * np.append(1.0, masses), q, v, t_span=(0.0, days), name=name)


class Reference:
    """States by heyoka's Taylor series in 80 bits, for any start and masses, which is compiled once."""

    def __init__(self, n: int) -> None:
        hy, number = needed("heyoka"), np.longdouble
        equations = hy.model.nbody(n, masses=[hy.par[k] for k in range(n)], Gconst=number(1))
        self._run = hy.taylor_adaptive(equations, np.zeros(6 * n, number), fp_type=number, compact_mode=True)

    def offsets(self, problem: Problem, z: np.ndarray, times: np.ndarray, planets: np.ndarray) -> np.ndarray:
        """Return the `offsets` of states that start from z, the state and the masses."""
        n = problem.y0.size // 6
        self._run.time, self._run.pars[:] = np.longdouble(0), z[6 * n :]
        self._run.state[:] = np.moveaxis(z[: 6 * n].reshape(2, n, 3), 0, 1).ravel()
        rows = []
        for t in times:
            self._run.propagate_until(np.longdouble(t))
            rows.append(np.moveaxis(self._run.state.reshape(n, 2, 3), 1, 0).ravel())
        return offsets(problem, rows, planets)


def offsets(problem: Problem, states: list[np.ndarray], planets: np.ndarray) -> np.ndarray:
    """Return how long after the time of each state (6 N,) its planet transits, in first order."""
    found = []
    for y, j in zip(states, planets, strict=True):
        all_three = *y.reshape(2, -1, 3), problem.fun(0.0, y.astype(float)).reshape(2, -1, 3)[1]
        x, u, b = (part[j, 1:] - part[0, 1:] for part in all_three)
        found.append(-(x @ u) / (u @ u + x @ b))
    return np.array(found)


def ias15(problem: Problem) -> Any:
    """Return a simulation of REBOUND that uses IAS15."""
    sim = needed("eip_scipy.integrations.rebound").to_simulation(problem)
    sim.integrator = "ias15"
    return sim


def by_rebound(problem: Problem, times: np.ndarray) -> list[np.ndarray]:
    """Return the states (6 N,) at the times by IAS15."""
    sim, rows, both = ias15(problem), [], np.empty((2, problem.y0.size // 6, 3))
    for t in times:
        sim.integrate(t)
        sim.serialize_particle_data(xyz=both[0], vxvyvz=both[1])
        rows.append(both.ravel().copy())
    return rows


def compare_derivatives(problem: Problem, reference: Reference) -> tuple[float, float, float]:
    """Return the largest error of derivatives, relative to the largest of its kind, and the seconds of us and of IAS15.

    Both compute the derivatives by all components of the start and all masses; four of them are compared.
    """
    z, n = np.append(problem.y0, np.asarray(problem.params)), problem.y0.size // 6
    begin = perf_counter()
    run = integrate(problem, method=EIPDOP853, rtol=1e-12, atol=1e-14, variations=["state", *range(n)])
    times, planets, slopes = transits(run, axis=AXIS)
    seconds, sim, errors = perf_counter() - begin, ias15(problem), []
    assert slopes is not None
    for k in (3, 3 * n + 4, 6 * n, 7 * n - 1):  # x and vy of the first planet, the masses of the star and the last one
        ends = [z + side * SHARE * z[min(k, 6 * n)] * (np.arange(7 * n) == k) for side in (1, -1)]
        above, below = (reference.offsets(problem, end, times, planets) for end in ends)
        expected = (above - below) / (ends[0][k] - ends[1][k])
        errors.append(float(np.abs(expected - slopes[:, k]).max() / np.abs(slopes[:, k]).max()))
    for k in range(n):
        for name in ("x", "y", "z", "vx", "vy", "vz", "m"):
            setattr(sim.add_variation().particles[k], name, 1.0)
    begin = perf_counter()
    sim.integrate(problem.t_span[1])
    return max(errors), seconds, perf_counter() - begin


def transit_times(out: Output, *, years: float = 10.0, derivative_years: float = 1.0) -> None:
    """Compare transit times and their derivatives with heyoka in 80 bits, and times with REBOUND.

    Parameters
    ----------
    years : float
        Length of the runs.
    derivative_years : float
        Length of those with derivatives by all masses and components of the start; REBOUND takes minutes for ten years.
    """
    rows: list[dict[str, Any]] = []
    for name in SYSTEMS:
        problem, reference = system(name, years * 365.25), Reference(len(SYSTEMS[name][0]) + 1)
        for method in (EIPRKN12, EIPDOP853):
            begin = perf_counter()
            times, planets, _ = transits(integrate(problem, method=method, rtol=1e-13, atol=1e-16), axis=AXIS)
            seconds = perf_counter() - begin
            exact = reference.offsets(problem, np.append(problem.y0, np.asarray(problem.params)), times, planets)
            theirs = float(np.abs(offsets(problem, by_rebound(problem, times), planets) - exact).max())
            values: Any = times.size, float(np.abs(exact).max()), theirs, seconds
            rows.append({"system": f"{name}, {method.__name__}", **dict(zip(KEYS, values, strict=True))})
            right = rows[-1]["error"] < max(BOUND, 2 * theirs)
            out.check(f"{rows[-1]['system']}: transit times are right to 1e-8 days, or twice IAS15's error", right)
        error, seconds, theirs = compare_derivatives(system(name, derivative_years * 365.25), reference)
        values = (None, error, theirs, seconds)
        rows.append({"system": f"{name}, derivatives", **dict(zip(KEYS, values, strict=True))})
        out.check(f"{name}: derivatives agree with differences of the reference", error < AGREE)
    out.text(table([(key,) for key in KEYS], [(row["system"], [compact(row[k], 3) for k in KEYS]) for row in rows]))
    out.text("Errors in days, of derivatives relative; IAS15: its error, or in rows of derivatives its seconds.")
    out.rows("transits.csv", rows)
