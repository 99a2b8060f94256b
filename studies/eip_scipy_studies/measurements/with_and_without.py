"""``eip-scipy study with-and-without``: a comet by RK45 and by EIPRK45, a satellite with drag by DOP853 and EIPDOP853.

SciPy's `solve_ivp` runs all of them. EIPRK45 keeps the comet's energy and angular momentum. The numbers are calls of
`fun` and the largest errors of energy and position in the first and the last period; positions are compared with
Kepler's equation. EIPDOP853 keeps the balances of the satellite; its positions are compared with those of a run with
tolerances of 1e-13.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK45, Invariant, integrate
from eip_scipy.problems import Problem, kepler, satellite

from ..report import table
from ..study import Figures, Session, Study

PERIOD = 2 * np.pi
T_END = 32 * PERIOD
TOLERANCES = {"rtol": 1e-6, "atol": 1e-9}
START = [0.4, 0, 0, 2]
DAY, DAYS = 86400, 10
EARTH: dict[str, Any] = {"mu": 398600.4418, "radius": 6378.137, "j2": 1.08262668e-3}  # km and s
AIR: dict[str, Any] = {"drag": 3.3e-11, "height": 400, "scale_height": 60}
ALTITUDE, INCLINATION = 420, np.radians(51.6)
FLIGHT = {"rtol": 3e-10, "atol": 1e-11}


def fun(t, y):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / r3, -y[1] / r3]


def energy(t, y):
    return (y[2] ** 2 + y[3] ** 2) / 2 - (y[0] ** 2 + y[1] ** 2) ** -0.5


def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


class Errors(NamedTuple):
    """Times (m,) of a run of the comet, relative errors of its energy (m,), and errors of its position (m,).

    Errors of the position are in units of the semi-major axis; `nfev` is the number of calls of `fun`.
    """

    t: np.ndarray
    energy: np.ndarray
    place: np.ndarray
    nfev: int

    def largest(self) -> dict[str, float]:
        """Return, by name, the largest errors of the energy and of the position in the first and in the last period."""
        ends = {"first": self.t <= PERIOD, "last": self.t >= T_END - PERIOD}
        return {
            f"{what}, {when} period": float(getattr(self, what)[where].max())
            for what in ("energy", "place")
            for when, where in ends.items()
        }


class Flight(NamedTuple):
    """Times of a run [days], and the satellite's Kepler energy [km^2/s^2] and errors of position [m] at these times.

    `nfev` is the number of calls of `fun`.
    """

    t: np.ndarray
    energy: np.ndarray
    metres: np.ndarray
    nfev: int


class Found(NamedTuple):
    """Runs of the comet and of the satellite, each by the name of its method."""

    comet: dict[str, Errors]
    satellite: dict[str, Flight]


def low_orbit() -> Problem:
    """Return a satellite 420 km above an oblate Earth with an atmosphere."""
    a = EARTH["radius"] + ALTITUDE
    velocity = np.sqrt(EARTH["mu"] / a) * np.array([0, np.cos(INCLINATION), np.sin(INCLINATION)])
    return satellite([a, 0, 0], velocity, **EARTH, **AIR, t_span=(0, DAYS * DAY))


def flights() -> dict[str, Flight]:
    """Run the satellite without and with its balances kept, and return the runs by the names of their methods."""
    problem = low_orbit()
    times = np.linspace(0, DAYS * DAY, 721)
    common: dict[str, Any] = {"fun": problem.fun, "t_span": problem.t_span, "y0": problem.y0, "t_eval": times}
    # Without invariants EIPDOP853 takes the steps of DOP853, compiled here.
    truth = integrate(problem, method=EIPDOP853, rtol=1e-13, atol=1e-13, t_eval=times, invariants=()).y[3:6]
    ways: dict[str, dict[str, Any]] = {
        "DOP853": {"method": "DOP853"},
        "EIPDOP853": {"method": EIPDOP853, "invariants": problem.invariants},
    }
    found = {}
    for name, options in ways.items():
        run = solve_ivp(**common, **options, **FLIGHT)
        place, velocity = run.y[3:6], run.y[9:12]  # the Earth rests in the origin
        kinetic = (velocity**2).sum(axis=0) / 2
        kepler_energy = kinetic - EARTH["mu"] / np.linalg.norm(place, axis=0)
        found[name] = Flight(times / DAY, kepler_energy, 1e3 * np.linalg.norm(place - truth, axis=0), run.nfev)
    return found


@dataclass(frozen=True, kw_only=True)
class WithAndWithout(Study[Found]):
    """Command ``eip-scipy study with-and-without``."""

    def measure(self, session: Session) -> Found:
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
        return Found(found, flights())

    def text(self, found: Found) -> str:
        comet = [
            (name, [str(run.nfev), *(f"{x:.1e}" for x in run.largest().values())]) for name, run in found.comet.items()
        ]
        heads = [["calls"], ["|dH/H|", "first period"], ["", "last"], ["place", "first period"], ["", "last"]]
        low = [(name, [str(run.nfev), f"{run.metres[-1]:.2f}"]) for name, run in found.satellite.items()]
        return table(heads, comet) + "\n\n" + table([["calls"], ["off after", f"{DAYS} days [m]"]], low)

    def numbers(self, found: Found) -> dict[str, Any]:
        low = {name: {"nfev": run.nfev, "metres": float(run.metres[-1])} for name, run in found.satellite.items()}
        return {
            "errors": {name: {"nfev": run.nfev, **run.largest()} for name, run in found.comet.items()},
            "satellite": low,
        }

    def figures(self, found: Found) -> Figures:
        yield "with-and-without.png", comet_figure(found.comet)
        yield "low-orbit.png", satellite_figure(found.satellite)


def comet_figure(found: dict[str, Errors]) -> Any:
    """Draw the errors of the energy and of the position of the comet."""
    labels = {"RK45": "RK45", "EIPRK45": "EIPRK45, energy and angular momentum kept"}
    figure, energies, places, colours = two_panels(
        "periods of the comet", T_END / PERIOD, "error of the energy, |ΔH/H|"
    )
    for (name, run), colour in zip(found.items(), colours, strict=True):
        t = run.t[1:] / PERIOD
        energies.semilogy(t, np.maximum(run.energy[1:], 1e-16), color=colour, lw=1.2, label=labels[name])
        places.semilogy(t, run.place[1:], color=colour, lw=1.2)
    places.set(ylabel="error of the place [semi-major axes]", ylim=(1e-7, 1e-1))
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def satellite_figure(found: dict[str, Flight]) -> Any:
    """Draw the energy of the satellite, which decreases, and the error of its position."""
    labels = {"DOP853": "DOP853", "EIPDOP853": "EIPDOP853, balances kept"}
    figure, energies, places, colours = two_panels("days", DAYS, "change of the energy [km²/s²]")
    for (name, run), colour in zip(found.items(), colours, strict=True):
        places.semilogy(run.t[1:], np.maximum(run.metres[1:], 1e-3), color=colour, lw=1.2, label=labels[name])
    run = found["EIPDOP853"]
    energies.plot(run.t, run.energy - run.energy[0], color=colours[1], lw=0.8)
    places.set_ylabel("error of the place [m]")
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def two_panels(time: str, end: float, energy: str) -> tuple[Any, Any, Any, tuple[str, str]]:
    """Return a figure, its panels for energies and positions, and the colours of runs without and with invariants kept.

    The panels go from time 0 to `end`; `time` and `energy` are labels.
    """
    from eip_scipy.plotting import PALETTE

    from ..plotting import blank_figure

    figure = blank_figure(9, 3.6)
    energies, places = figure.subplots(1, 2)
    for axes in (energies, places):
        axes.grid(alpha=0.3)
        axes.set(xlabel=time, xlim=(0, end))
    energies.set_ylabel(energy)
    return figure, energies, places, (PALETTE[2], PALETTE[0])
