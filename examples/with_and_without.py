"""A comet of eccentricity 0.6 by SciPy's RK45, and by EIPRK45 with its energy and angular momentum kept.

SciPy's `solve_ivp` runs both. The script prints the calls of `fun` and the largest errors of energy and position in the
first and in the last of 32 periods, compared with Kepler's equation, and draws with-and-without.png.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK45, Invariant
from eip_scipy.problems import kepler

PERIOD, PERIODS = 2 * np.pi, 32
START = [0.4, 0, 0, 2]
TOLERANCES = {"rtol": 1e-6, "atol": 1e-9}


def fun(t, y):
    """Return the velocity and the acceleration."""
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / r3, -y[1] / r3]


def energy(t, y):
    """Return the energy, which is -1/2."""
    return (y[2] ** 2 + y[3] ** 2) / 2 - (y[0] ** 2 + y[1] ** 2) ** -0.5


def momentum(t, y):
    """Return the angular momentum."""
    return y[0] * y[3] - y[1] * y[2]


exact = kepler(relativistic=0.0).reference
ways = {
    "RK45": {"method": "RK45"},
    "EIPRK45": {"method": EIPRK45, "invariants": [Invariant(energy), Invariant(momentum)]},
}
labels = {"RK45": "RK45", "EIPRK45": "EIPRK45, energy and angular momentum kept"}
figure, (energies, places) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for (name, options), colour in zip(ways.items(), ("#a33", "#27c"), strict=True):
    run = solve_ivp(fun, (0, PERIODS * PERIOD), START, **options, **TOLERANCES)
    drift = np.maximum(np.abs(energy(0, run.y) - energy(0, START)) * 2, 1e-16)
    place = np.hypot(*(run.y[:2] - np.transpose([exact(t)[:2] for t in run.t])))  # the semi-major axis is 1
    first, last = run.t <= PERIOD, run.t >= (PERIODS - 1) * PERIOD
    print(f"{name}: {run.nfev} calls")
    for what, error in (("energy", drift), ("place", place)):
        print(f"  {what} off by {error[first].max():.1e} in the first and {error[last].max():.1e} in the last period")
    energies.semilogy(run.t[1:] / PERIOD, drift[1:], color=colour, label=labels[name])
    places.semilogy(run.t[1:] / PERIOD, place[1:], color=colour)
energies.set(ylabel="error of the energy, |ΔH/H|")
places.set(ylabel="error of the place [semi-major axes]", ylim=(1e-7, 1e-1))
for axis in (energies, places):
    axis.set(xlabel="periods of the comet", xlim=(0, PERIODS))
    axis.grid(alpha=0.3)
figure.legend(loc="outside upper center", ncols=2, frameon=False, title="rtol = 1e-6, atol = 1e-9")
figure.savefig("with-and-without.png", dpi=120)
