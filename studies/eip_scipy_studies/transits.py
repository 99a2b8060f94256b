"""``eip-scipy transits``: transit times and their derivatives, against heyoka in 80 bits and REBOUND's IAS15."""

from __future__ import annotations

from itertools import product
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
KEYS = ("transits", "error", "compared", "seconds", "IAS15 s")
AXIS = (1.0, 0.0, 0.0)
BOUND = 1e-8  # days
SHARE, AGREE = 1e-9, 1e-6  # of a component or the star's mass, for differences; of the largest derivative of a kind


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


def compare_derivatives(problem: Problem, reference: Reference, bodies: list[int]) -> tuple[float, float, float, float]:
    """Return the largest error of derivatives, that of the differences, and the seconds of us and of IAS15.

    Both compute the derivatives by all components of the start and all masses. Those by the masses of some `bodies` and
    their places and speeds in the plane are compared, relative to the largest by the same number. Differences of
    order 4 from two widths are compared; their distance from those of order 2 is given as their error.
    """
    z, n = np.append(problem.y0, np.asarray(problem.params)).astype(np.longdouble), problem.y0.size // 6
    begin = perf_counter()
    run = integrate(problem, method=EIPDOP853, rtol=1e-12, atol=1e-14, variations=["state", *range(n)])
    times, planets, slopes = transits(run, axis=AXIS)
    seconds, sim, errors = perf_counter() - begin, ias15(problem), []
    assert slopes is not None
    for j, (kind, axis) in product(bodies, ((0, 0), (0, 1), (3, 0), (3, 1), (6, 0))):
        k, size = kind * n + (3 * j + axis if kind < 6 else j), np.abs(z[kind * n : kind * n + 6]).max()
        near, far = (
            np.subtract(*(reference.offsets(problem, z + side * step * (np.arange(7 * n) == k), times, planets)
                          for side in (1, -1))) / (2 * step)
            for step in (SHARE * size, 2 * SHARE * size)
        )  # fmt: skip
        errors.append(
            np.abs([near + (near - far) / 3 - slopes[:, k], (near - far) / 3]).max(axis=1) / np.abs(near).max()
        )
    for k in range(n):
        for name in ("x", "y", "z", "vx", "vy", "vz", "m"):
            setattr(sim.add_variation().particles[k], name, 1.0)
    begin = perf_counter()
    sim.integrate(problem.t_span[1])
    error, doubt = np.max(errors, axis=0).tolist()
    return error, doubt, seconds, perf_counter() - begin


def transit_times(out: Output, *, years: float = 10.0) -> None:
    """Compare transit times and their derivatives with heyoka in 80 bits and with REBOUND's IAS15.

    Parameters
    ----------
    years : float
        Length of the runs. Ten years take ten minutes.
    """
    rows: list[dict[str, Any]] = []

    def add(row: str, *values: Any) -> None:
        rows.append({"system": row, **dict(zip(KEYS, values, strict=True))})

    for name, bodies in (("Kepler-36", [0, 1, 2]), ("seven planets", [0, 7])):
        problem, reference = system(name, years * 365.25), Reference(len(SYSTEMS[name][0]) + 1)
        for method in (EIPRKN12, EIPDOP853):
            begin = perf_counter()
            times, planets, _ = transits(integrate(problem, method=method, rtol=1e-13, atol=1e-16), axis=AXIS)
            seconds, begin = perf_counter() - begin, perf_counter()
            states = by_rebound(problem, times)
            theirs = perf_counter() - begin
            exact = reference.offsets(problem, np.append(problem.y0, np.asarray(problem.params)), times, planets)
            error, of_ias15 = (float(np.abs(d).max()) for d in (exact, offsets(problem, states, planets) - exact))
            add(f"{name}, {method.__name__}", times.size, error, of_ias15, seconds, theirs)
            right = error < max(BOUND, 2 * of_ias15)
            out.check(f"{rows[-1]['system']}: transit times are right to 1e-8 days, or twice IAS15's error", right)
        add(f"{name}, derivatives", times.size, *compare_derivatives(problem, reference, bodies))
        out.check(f"{name}: derivatives agree with differences of the reference", rows[-1]["error"] < AGREE)
    out.text(table([(key,) for key in KEYS], [(row["system"], [compact(row[k], 3) for k in KEYS]) for row in rows]))
    out.text("Errors in days, of derivatives relative; compared: IAS15's error, or that of the differences.")
    out.rows("transits.csv", rows)
