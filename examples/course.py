"""For a course: a pendulum and Kepler's orbit by RK4, by leapfrog, and by EIPRK4, with as many evaluations each.

The script prints the errors of the energy and of the state at t = 100, and draws course.png: a flat energy does not
make an orbit right.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import eip_scipy
from eip_scipy import EIPRK4, eip_method


def pendulum(t, y):
    """Return the derivatives of angle and angular velocity."""
    return np.array([y[1], -np.sin(y[0])])


def kepler(t, y):
    """Return the derivatives of place and velocity in the plane."""
    return np.concatenate([y[2:], -y[:2] / (y[:2] @ y[:2]) ** 1.5])


class Leapfrog:
    """Half a step of the velocity, a step of the place, half a step of the velocity."""

    order = 2

    def __init__(self, fun):
        self.fun = fun

    def one_step(self, t, y, h):
        """Return the state after a step."""
        place, speed = np.split(y, 2)
        speed = speed + h / 2 * np.split(self.fun(t, y), 2)[1]
        place = place + h * speed
        return np.append(place, speed + h / 2 * np.split(self.fun(t, np.append(place, speed)), 2)[1])


energies = {
    pendulum: lambda t, y: y[1] ** 2 / 2 - np.cos(y[0]),
    kepler: lambda t, y: y[2:] @ y[2:] / 2 - (y[:2] @ y[:2]) ** -0.5,
}
cases = [
    (pendulum, [2.5, 0.0], 0.2, []),
    (kepler, [0.5, 0.0, 0.0, 3**0.5], 0.05, [lambda t, y: y[0] * y[3] - y[1] * y[2]]),
]
times = np.arange(101.0)
figure, axes = plt.subplots(2, 2, figsize=(9, 5.5), sharex=True, layout="constrained")
for (fun, y0, h, others), row in zip(cases, axes, strict=True):
    H = energies[fun]
    truth = solve_ivp(fun, (0, 100), y0, "DOP853", times, rtol=1e-12, atol=1e-12).y
    ways = {
        "RK4": {"method": EIPRK4, "h": h},
        "leapfrog": {"method": eip_method(Leapfrog(fun)), "h": h / 4},  # f at the end of a step is that of the next
        "EIPRK4": {"method": EIPRK4, "h": h, "invariants": [H, *others]},
    }
    for (name, options), colour in zip(ways.items(), ("#a33", "#888", "#27c"), strict=True):
        y = eip_scipy.solve_ivp(fun, (0, 100), y0, t_eval=times, **options).y
        lost = np.array([abs(H(0, state) - H(0, y[:, 0])) for state in y.T])
        off = np.linalg.norm(y - truth, axis=0)
        print(f"{fun.__name__} by {name}: energy off by {lost[-1]:.0e}, state by {off[-1]:.0e}")
        for axis, error in zip(row, (lost, off), strict=True):
            axis.semilogy(times[1:], np.maximum(error[1:], 1e-16), color=colour, label=name)
            axis.grid(alpha=0.3)
    row[0].set_ylabel(f"{fun.__name__}: error of the energy")
    row[1].set_ylabel("error of the state")
figure.supxlabel("t")
figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
figure.savefig("course.png", dpi=120)
