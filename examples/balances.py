"""Where a balance helps and where it does not: errors of EIPDOP853 with and without it, at equal numbers of calls.

A planet with drag, and the oscillator x'' = -a x - b x^3 - c x' + d cos(w t), weakly and strongly driven, in resonance,
on its attractor, each with its energy and the rate at which that changes; and the planet with a wrong rate. References
are runs with steps of a sixteenth. The script prints the median error over six directions or phases.
"""

import math
import warnings

import numpy as np
from numba import njit

from eip_scipy import EIPDOP853, Balance, integrate


@njit
def dragged(t, y, c, factor):
    """Return the derivative for Kepler's motion with the drag -c v."""
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return np.array([y[2], y[3], -y[0] / r3 - c * y[2], -y[1] / r3 - c * y[3]])


@njit
def kepler_energy(t, y, c, factor):
    """Return Kepler's energy."""
    return 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)


@njit
def loss(t, y, c, factor):
    """Return the rate of Kepler's energy, times a factor that is 1 for the right one."""
    return -factor * c * (y[2] ** 2 + y[3] ** 2)


@njit
def swinging(t, y, a, b, c, d, w, phase):
    """Return the derivative for the oscillator."""
    return np.array([y[1], -a * y[0] - b * y[0] ** 3 - c * y[1] + d * np.cos(w * t + phase)])


@njit
def swing_energy(t, y, a, b, c, d, w, phase):
    """Return the energy of the oscillator without damping and driving."""
    return 0.5 * y[1] ** 2 + 0.5 * a * y[0] ** 2 + 0.25 * b * y[0] ** 4


@njit
def power(t, y, a, b, c, d, w, phase):
    """Return the rate of the oscillator's energy."""
    return -c * y[1] ** 2 + d * y[1] * np.cos(w * t + phase)


PLANET, SWING = (dragged, kepler_energy, loss, 2 * math.pi / 16), (swinging, swing_energy, power, 0.4)
CASES = {  # functions, step, end, arguments
    "planet, drag 1e-6, 1000 revolutions": (*PLANET, 2000 * math.pi, 1e-6, 1),
    "planet, drag 1e-2, 5 revolutions": (*PLANET, 10 * math.pi, 1e-2, 1),
    "planet, drag 1e-6, twice the rate": (*PLANET, 400 * math.pi, 1e-6, 2),
    "Duffing, driven by 1e-3": (*SWING, 1000, 1, 1, 0, 1e-3, 0.4),
    "Duffing, driven by 1": (*SWING, 200, 1, 1, 0, 1.0, 0.4),
    "linear oscillator in resonance": (*SWING, 500, 1, 0, 0, 1e-2, 1.0),
    "attractor of Duffing, damped by 0.02": (*SWING, 2000, 1, 1, 0.02, 0.05, 1.2),
    "linear attractor, damped by 0.01": (*SWING, 2000, 1, 0, 0.01, 0.01, 2.0),
}
for name, (fun, energy, rate, h, end, *args) in CASES.items():
    errors, warned, planet = {"without": [], "with": []}, 0, fun is dragged
    for k in range(6):
        c, s = math.cos(k), math.sin(k)
        y0 = [0.8 * c, 0.8 * s, -(1.5**0.5) * s, 1.5**0.5 * c] if planet else [1.0, 0.3]
        given = {"t_span": (0, end), "y0": y0, "method": EIPDOP853, "args": args if planet else (*args, float(k))}
        exact = integrate(fun, **given, h=h / 16, invariants=(), compensated=True).y[:2, -1]
        for kind, kept in (("without", ()), ("with", [Balance(energy, rate)])):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                run = integrate(fun, **given, h=h, invariants=kept)
            errors[kind].append(np.linalg.norm(run.y[:2, -1] - exact))
            warned += bool(kept) and (bool(caught) or not run.trusted)
    without, within = (np.median(errors[kind]) for kind in ("without", "with"))
    print(f"{name}: without {without:.1e}, with {within:.1e}, ratio {without / within:.2g}, {warned} of 6 warned")
