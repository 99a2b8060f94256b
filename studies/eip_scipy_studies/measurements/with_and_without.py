"""``eip-scipy study with-and-without``: the README's figure, a comet by RK45 and by EIPRK45.

SciPy's `solve_ivp` runs both; EIPRK45 keeps the two invariants. The numbers are calls of `fun` and the largest errors
of energy and position in the first and the last period; positions are compared with Kepler's equation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK45, Invariant
from eip_scipy.problems import kepler

from ..report import table
from ..study import Figures, Session, Study

__all__ = ["WithAndWithout"]

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


class Errors(NamedTuple):
    """Times of a run, its errors of the energy and of the place, and its calls of `fun`."""

    t: np.ndarray
    energy: np.ndarray
    place: np.ndarray
    nfev: int

    def largest(self) -> dict[str, float]:
        """Return the largest errors of the first and of the last period."""
        ends = {"first": self.t <= PERIOD, "last": self.t >= T_END - PERIOD}
        return {
            f"{what}, {when} period": float(getattr(self, what)[where].max())
            for what in ("energy", "place")
            for when, where in ends.items()
        }


@dataclass(frozen=True, kw_only=True)
class WithAndWithout(Study[dict[str, Errors]]):
    """The command."""

    def measure(self, session: Session) -> dict[str, Errors]:
        kept = {"invariants": [Invariant(energy), Invariant(momentum)]}
        ways: dict[str, dict[str, Any]] = {"RK45": {"method": "RK45"}, "EIPRK45": {"method": EIPRK45, **kept}}
        reference = kepler(relativistic=0.0).reference
        assert reference is not None
        found = {}
        for name, options in ways.items():
            run = solve_ivp(fun, (0, T_END), START, **options, **TOLERANCES)
            defect = np.abs(energy(run.t, run.y) - energy(0, np.asarray(START))) * 2  # |H| is 1/2
            exact = np.array([reference(time) for time in run.t]).T
            found[name] = Errors(run.t, defect, np.hypot(*(run.y[:2] - exact[:2])), run.nfev)
        return found

    def text(self, found: dict[str, Errors]) -> str:
        body = [(name, [str(run.nfev), *(f"{x:.1e}" for x in run.largest().values())]) for name, run in found.items()]
        heads = [["calls"], ["|dH/H|", "first period"], ["", "last"], ["place", "first period"], ["", "last"]]
        return table(heads, body)

    def numbers(self, found: dict[str, Errors]) -> dict[str, Any]:
        return {"errors": {name: {"nfev": run.nfev, **run.largest()} for name, run in found.items()}}

    def figures(self, found: dict[str, Errors]) -> Figures:
        from eip_scipy.plotting import PALETTE

        from ..plotting import blank_figure

        looks = {"RK45": (PALETTE[2], "RK45"), "EIPRK45": (PALETTE[0], "EIPRK45, energy and angular momentum kept")}
        figure = blank_figure(9, 3.6)
        energies, places = figure.subplots(1, 2)
        for name, run in found.items():
            colour, label = looks[name]
            energies.semilogy(run.t[1:] / PERIOD, np.maximum(run.energy[1:], 1e-16), color=colour, lw=1.2, label=label)
            places.semilogy(run.t[1:] / PERIOD, run.place[1:], color=colour, lw=1.2)
        energies.set(xlabel="periods of the comet", ylabel="error of the energy, |ΔH/H|")
        places.set(xlabel="periods of the comet", ylabel="error of the place [semi-major axes]", ylim=(1e-7, 1e-1))
        for axes in (energies, places):
            axes.grid(alpha=0.3)
            axes.set_xlim(0, T_END / PERIOD)
        figure.legend(loc="outside upper center", ncols=2, frameon=False)
        yield "with-and-without.png", figure
