"""The mass of a star and the start of its planet, fitted to noisy positions of the planet.

The residuals and their derivatives by the start, `run.stm`, and by the mass, `run.sensitivities`, come from one run.
"""

from functools import lru_cache

import numpy as np
from numba import njit
from scipy.optimize import least_squares

from eip_scipy import EIPDOP853, Invariant, integrate
from eip_scipy.problems import kepler

NOISE = 1e-5
TRUTH = np.array([0.4, 0.0, 0.0, 2.0, 1.0])  # x, y, vx, vy and the mass; the eccentricity is 0.6
TIMES = 2 * np.pi * np.arange(1, 301) / 10  # 30 revolutions


@njit
def planet(t, s, p):
    """Return the velocity and the acceleration."""
    r3 = (s[0] * s[0] + s[1] * s[1]) ** 1.5
    return np.array([s[2], s[3], -p[0] * s[0] / r3, -p[0] * s[1] / r3])


@njit
def kept(t, s, p):
    """Return the energy and the angular momentum of a planet of unit mass."""
    energy = 0.5 * (s[2] * s[2] + s[3] * s[3]) - p[0] / np.sqrt(s[0] * s[0] + s[1] * s[1])
    return np.array([energy, s[0] * s[3] - s[1] * s[2]])


OPTIONS = {"method": EIPDOP853, "h": 2 * np.pi / 50, "t_eval": TIMES, "invariants": Invariant(kept, size=2)}


@lru_cache(maxsize=1)  # least_squares asks for the residuals and for their derivatives at the same numbers
def run_of(*x):
    """Return the run with its derivatives by the start and by the mass, which is parameter 0."""
    return integrate(planet, (0, TIMES[-1]), x[:4], params=x[4:], variations=["state", 0], **OPTIONS)


def residuals(x):
    """Return (model - data) / noise of all coordinates."""
    return ((run_of(*x).y[:2].T - measured) / NOISE).ravel()


def jacobian(x):
    """Return the derivatives of the residuals by x."""
    run = run_of(*x)
    return (np.concatenate([run.stm, run.sensitivities], axis=2)[:, :2] / NOISE).reshape(-1, 5)


exact = np.array([kepler(relativistic=0.0).reference(t)[:2] for t in TIMES])  # by Kepler's equation
measured = exact + NOISE * np.random.default_rng(1).standard_normal((TIMES.size, 2))
found = least_squares(residuals, TRUTH + [1e-4, 0, 0, -1e-4, 1e-4], jac=jacobian, x_scale="jac")
errors = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
for name, value, error, truth in zip(("x", "y", "vx", "vy", "mass"), found.x, errors, TRUTH, strict=True):
    print(f"{name:>4} {value:10.7f} ± {error:.1e}, truth {truth:.1f}, off by {(value - truth) / error:+.1f} errors")
print(f"{found.nfev} runs, mean square of the residuals {2 * found.cost / (measured.size - 5):.2f}")
