"""The README's figure: a comet by SciPy's `solve_ivp` with RK4, with its two invariants kept and without.

    python benchmarks/with_and_without.py [--figure docs/_static/with-and-without.png]

It prints the largest errors of energy and of place in the first and the last period; the places are compared with
Kepler's equation.
"""

import argparse

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, Invariant
from eip_scipy.problems import kepler

PERIOD = 2 * np.pi
T_END, H = 32 * PERIOD, 0.03
START = [0.4, 0, 0, 2]


def fun(t, y):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / r3, -y[1] / r3]


def energy(t, y):
    return (y[2] ** 2 + y[3] ** 2) / 2 - (y[0] ** 2 + y[1] ** 2) ** -0.5


def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


def runs():
    """Times, and states by name."""
    invariants = [Invariant(energy), Invariant(momentum)]
    with_them = solve_ivp(fun, (0, T_END), START, method=EIPRK4, h=H, invariants=invariants)
    without = solve_ivp(fun, (0, T_END), START, method=EIPRK4, h=H)
    return with_them.t, {"without": without.y, "with": with_them.y}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--figure", metavar="FILE", help="draw it")
    args = parser.parse_args()
    t, states = runs()
    reference = kepler(relativistic=0.0).reference
    exact = np.array([reference(time) for time in t]).T
    errors = {}
    for name, y in states.items():
        defect = np.abs(energy(t, y) - energy(0, np.asarray(START))) * 2  # |H| is 1/2
        errors[name] = defect, np.hypot(*(y[:2] - exact[:2]))
        first, last = t <= PERIOD, t >= T_END - PERIOD
        figures = (f"{part[where].max():.1e}" for part in errors[name] for where in (first, last))
        print("{:8} |dH/H| {} in the first period, {} in the last; place {}, {}".format(name, *figures))
    if args.figure:
        draw(args.figure, t, errors)


def draw(file, t, errors):
    from matplotlib.figure import Figure

    colours = {"without": "#D55E00", "with": "#0072B2"}  # Okabe and Ito
    labels = {"without": "RK4", "with": "RK4, energy and angular momentum kept"}
    figure = Figure(figsize=(9, 3.6), dpi=150, layout="constrained")
    energies, places = figure.subplots(1, 2)
    for name, (defect, place) in errors.items():
        line = {"color": colours[name], "lw": 1.2}
        energies.semilogy(t[1:] / PERIOD, np.maximum(defect[1:], 1e-16), label=labels[name], **line)
        places.semilogy(t[1:] / PERIOD, place[1:], **line)
    energies.set(xlabel="periods of the comet", ylabel="error of the energy, |ΔH/H|")
    places.set(xlabel="periods of the comet", ylabel="error of the place [semi-major axes]")
    for axes in (energies, places):
        axes.grid(alpha=0.3)
        axes.set_xlim(0, T_END / PERIOD)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(file)


if __name__ == "__main__":
    main()
