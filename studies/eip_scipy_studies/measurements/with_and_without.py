"""The README's figure: a comet by SciPy's `solve_ivp` with RK45, and with its two invariants kept by EIPRK45.

    python -m eip_scipy_studies.measurements.with_and_without [--figure docs/_static/with-and-without.png]

It prints the calls of `fun` and the largest errors of energy and of place in the first and the last period; the places
are compared with Kepler's equation.
"""

import argparse

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK45, Invariant
from eip_scipy.problems import kepler

PERIOD = 2 * np.pi
T_END = 32 * PERIOD
TOLERANCES = {"rtol": 1e-6, "atol": 1e-9}
START = [0.4, 0, 0, 2]


def fun(t, y):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / r3, -y[1] / r3]


def energy(t, y):
    return (y[2] ** 2 + y[3] ** 2) / 2 - (y[0] ** 2 + y[1] ** 2) ** -0.5


def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


def runs():
    """By name: SciPy's results."""
    invariants = [Invariant(energy), Invariant(momentum)]
    return {
        "RK45": solve_ivp(fun, (0, T_END), START, method="RK45", **TOLERANCES),
        "EIPRK45": solve_ivp(fun, (0, T_END), START, method=EIPRK45, invariants=invariants, **TOLERANCES),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--figure", metavar="FILE", help="draw it")
    args = parser.parse_args()
    reference = kepler(relativistic=0.0).reference
    errors = {}
    for name, sol in runs().items():
        defect = np.abs(energy(sol.t, sol.y) - energy(0, np.asarray(START))) * 2  # |H| is 1/2
        exact = np.array([reference(time) for time in sol.t]).T
        errors[name] = sol.t, defect, np.hypot(*(sol.y[:2] - exact[:2]))
        first, last = sol.t <= PERIOD, sol.t >= T_END - PERIOD
        figures = (f"{part[where].max():.1e}" for part in errors[name][1:] for where in (first, last))
        row = "{:8} {} calls, |dH/H| {} in the first period, {} in the last; place {}, {}"
        print(row.format(name, sol.nfev, *figures))
    if args.figure:
        draw(args.figure, errors)


def draw(file, errors):
    from matplotlib.figure import Figure

    colours = {"RK45": "#D55E00", "EIPRK45": "#0072B2"}  # Okabe and Ito
    labels = {"RK45": "RK45", "EIPRK45": "EIPRK45, energy and angular momentum kept"}
    figure = Figure(figsize=(9, 3.6), dpi=150, layout="constrained")
    energies, places = figure.subplots(1, 2)
    for name, (t, defect, place) in errors.items():
        line = {"color": colours[name], "lw": 1.2}
        energies.semilogy(t[1:] / PERIOD, np.maximum(defect[1:], 1e-16), label=labels[name], **line)
        places.semilogy(t[1:] / PERIOD, place[1:], **line)
    energies.set(xlabel="periods of the comet", ylabel="error of the energy, |ΔH/H|")
    places.set(xlabel="periods of the comet", ylabel="error of the place [semi-major axes]")
    places.set_ylim(1e-7, 1e-1)
    for axes in (energies, places):
        axes.grid(alpha=0.3)
        axes.set_xlim(0, T_END / PERIOD)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(file)


if __name__ == "__main__":
    main()
