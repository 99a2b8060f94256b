"""A satellite 420 km above an oblate Earth with an atmosphere, by DOP853, and by EIPDOP853 with its balances.

No quantity of the orbit is constant, but the rates at which energy, angular momentum and Laplace's vector change are
known. SciPy's `solve_ivp` runs both; a run of EIPDOP853 with tolerances of 1e-13 is the truth. The script prints the
calls of `fun` and the error of the place after ten days, and draws low-orbit.png.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import satellite

DAY, DAYS = 86400, 10
EARTH = {"mu": 398600.4418, "radius": 6378.137, "j2": 1.08262668e-3}  # km and s
AIR = {"drag": 3.3e-11, "height": 400, "scale_height": 60}
TOLERANCES = {"rtol": 3e-10, "atol": 1e-11}

axis, tilt = EARTH["radius"] + 420, np.radians(51.6)
velocity = np.sqrt(EARTH["mu"] / axis) * np.array([0, np.cos(tilt), np.sin(tilt)])
problem = satellite([axis, 0, 0], velocity, **EARTH, **AIR, t_span=(0, DAYS * DAY))
times = np.linspace(0, DAYS * DAY, 721)
truth = integrate(problem, method=EIPDOP853, rtol=1e-13, atol=1e-13, t_eval=times, invariants=()).y


def kepler_energy(y):
    """Return the energy per mass without oblateness and drag, which both change it, in km²/s²."""
    return (y[9:12] ** 2).sum(axis=0) / 2 - EARTH["mu"] / np.linalg.norm(y[3:6], axis=0)


ways = {
    "DOP853": {"method": "DOP853"},
    "EIPDOP853, balances kept": {"method": EIPDOP853, "invariants": problem.invariants},
}
figure, (energies, places) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for (name, options), colour in zip(ways.items(), ("#a33", "#27c"), strict=True):
    run = solve_ivp(problem.fun, problem.t_span, problem.y0, t_eval=times, **options, **TOLERANCES)
    metres = 1e3 * np.linalg.norm((run.y - truth)[3:6], axis=0)  # the Earth rests in the origin
    print(f"{name}: {run.nfev} calls, {metres[-1]:.2f} m off after {DAYS} days")
    places.semilogy(times[1:] / DAY, np.maximum(metres[1:], 1e-3), color=colour, label=name)
    off = kepler_energy(run.y) - kepler_energy(truth)
    energies.semilogy(times[1:] / DAY, np.maximum(1e6 * abs(off[1:]), 1e-7), color=colour, lw=0.8)
energies.set_ylabel("error of the energy [m²/s²]")
places.set_ylabel("error of the place [m]")
for axis in (energies, places):
    axis.set(xlabel="days", xlim=(0, DAYS))
    axis.grid(alpha=0.3)
figure.legend(loc="outside upper center", ncols=2, frameon=False, title="rtol = 3e-10, atol = 1e-11")
figure.savefig("low-orbit.png", dpi=120)
