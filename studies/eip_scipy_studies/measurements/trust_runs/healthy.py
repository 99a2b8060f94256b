"""Correct runs, which must not be reported as faulty: the invariants are true ones, and the steps are suitable."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from eip_scipy.problems import (
    Problem,
    centre_time,
    comet,
    figure_eight,
    harmonic,
    kepler,
    pythagorean,
    solar_system,
    time_transformed,
    tokamak,
    uniform_field,
)

from ...condensates.problems import plane_wave, rotating_packet, soliton
from ...hard_cases import double_pendulum, hard_cases, rigid_body, sir
from . import systems as s
from .record import Run, runs

HARD, OWN, SOLAR, PAPER, SYSTEMS, EVERY, KINKS, LOOSE, MEMBERS = (
    "the hard cases",
    "the problems at their own steps",
    "the solar system over 100 years",
    "the paper's runs",
    "further systems",
    "every, compensated, metric, direction",
    "kinked forces and cut-offs",
    "loose tolerances",
    "ensembles",
)
SPACINGS = ("", "compensated", "every=10", "every=10 compensated", "every=auto", "every=auto compensated")
THREE = ", ".join(f"{method} {rtol}" for method in ("RK45", "DOP853", "RK5") for rtol in ("1e-4", "1e-6", "1e-9"))


def healthy_runs() -> list[Run]:
    """Return all correct runs."""
    parts = (hard(), own_steps(), solar(), paper(), systems(), spacing(), kinks(), loose(), ensembles())
    return [replace(run, sick=False) for part in parts for run in part]


def hard_case(name: str) -> Problem:
    return hard_cases([name])[0].problem


def short(make: Callable[[], Problem], end: float) -> Problem:
    """Return the problem that `make` makes, with its interval ending at `end`."""
    problem = make()
    return replace(problem, t_span=(problem.t_span[0], end))


def fictitious() -> Problem:
    return time_transformed(kepler(0.9, 0.0), 40.0, centre_time)


def top(*start: float) -> Problem:
    return s.equations(rigid_body(1.0, 2.0, 3.0), start, 25.0)


def two_pendulums() -> Problem:
    return s.equations(double_pendulum(9.81), [1.0, 0.5, 0.0, 0.0], 10.0)


def each(before: str, options: Iterable[str], after: str = "") -> str:
    """Return the argument `ways` of `runs`: a text "before option after" for each option, separated by commas.

    `before` and `after`, such as a method and further options, are the same for all.
    """
    return ", ".join(f"{before} {option} {after}" for option in options)


def hard() -> Iterator[Run]:
    for case in hard_cases():
        yield from runs(HARD, case.name, partial(hard_case, case.name), THREE)


def own_steps() -> Iterator[Run]:
    own = partial(runs, OWN)
    for method in ("RK2", "RK3", "RK4", "RK5"):
        yield from own("harmonic oscillator", harmonic, each(f"{method} h=0.02", ("", "integrate")))
    yield from own(
        "Kepler", kepler, "RK4, RK4 interpreted, RK4 integrate, RK5 integrate, RK45 integrate, DOP853 integrate"
    )
    yield from own("Kepler", kepler, "RKN8 integrate, RKN12 integrate, RK3 h=0.01 integrate")
    yield from own("Kepler without 1/r^3", partial(kepler, 0.6, 0.0), "RK4 integrate, RK2 h=2e-3 integrate")
    three = "RK4 integrate, RKN12 integrate, DOP853 1e-8"
    yield from own("Kepler, e = 0", partial(kepler, 0.0, 0.0), three)
    yield from own("Kepler, e = 0.9", partial(kepler, 0.9, 0.0, 50.0, 2e-3), three)
    yield from own("Kepler, e = 0.99", partial(kepler, 0.99, 0.0, 50.0, 2e-4), three)
    yield from own("Kepler, e = 0.9, in fictitious time", fictitious, "RK4 h=0.03, DOP853 1e-8")
    eight = partial(figure_eight, 10.0)
    yield from own("figure eight", eight, "RKN12 integrate, RK4 h=0.01 integrate, RKN8 h=0.02 integrate, DOP853 1e-8")
    near = partial(short, pythagorean, 10.0)
    yield from own("Pythagorean bodies to t = 10", near, "DOP853 1e-10, RK45 1e-8, RKN12 1e-10")
    yield from own("Pythagorean bodies", pythagorean, "DOP853 1e-13 integrate, RKN12 1e-13 integrate")
    yield from own("comet", comet, "DOP853 1e-9, DOP853 1e-12 integrate, RKN12 1e-11 integrate, RK45 1e-7")
    fields: dict[str, Callable[[], Problem]] = {
        "uniform field": uniform_field,
        "tokamak": tokamak,
        "tokamak, transit": partial(tokamak, "transit"),
    }
    for name, field in fields.items():
        orbit = partial(short, field, 2000.0)
        yield from own(f"particle, {name}", orbit, "RK4 integrate, RK5 integrate, DOP853 integrate, RK45 1e-6")
        yield from own(f"particle, {name}", orbit, "RK4 metric=euclidean integrate")
    yield from own("soliton", partial(soliton, 128, t_end=2.0), "RK4 integrate, RK45 1e-6, DOP853 1e-8")
    yield from own("plane wave", partial(plane_wave, (16, 16)), "RK4 integrate, RK45 1e-6")
    for Omega in (0.0, 0.5, 0.9):
        packet = partial(rotating_packet, Omega, 32, 0.2, 1e-3)
        yield from own(f"rotating packet, {Omega:g}", packet, "RK4 integrate, RK3 integrate, DOP853 1e-7")


def solar() -> Iterator[Run]:
    own, years = partial(runs, SOLAR), partial(solar_system, years=100.0)
    for h in ("0.015625", "0.02", "0.01", "5e-3"):
        yield from own("Newton", years, each(f"RKN12 h={h}", SPACINGS, "integrate"))
    yield from own("Newton", years, each("RK4 h=2e-3", ("", "every=10", "metric=euclidean"), "integrate"))
    yield from own("Newton", years, "RK4 h=1e-3 compensated integrate, RK5 h=2e-3 integrate, RKN8 h=0.01 integrate")
    yield from own("Newton", years, "RKN8 h=0.01 every=auto integrate, DOP853 h=0.01 integrate, DOP853 1e-10 integrate")
    for name in ("gr-potential", "j2"):
        yield from own(name, partial(years, forces=name), "RKN12 h=0.015625 every=10 integrate")
    einstein = partial(solar_system, years=10.0, forces="eih")
    yield from own("eih, 10 years", einstein, "RK4 h=2e-3 integrate, DOP853 h=0.01 integrate")


def paper() -> Iterator[Run]:
    own = partial(runs, PAPER, metric="euclidean", reuse_f=False)
    yield from own("table 2, harmonic oscillator", harmonic, each("RK2", ("h=0.05", "h=0.025", "h=0.0125")))
    yield from own(
        "table 2, harmonic oscillator", harmonic, "RK1 h=0.0125, RK3 h=0.05, RK3 h=0.025, RK4 h=0.05, RK4 h=0.025"
    )
    orbit = partial(kepler, t_end=1.0)
    yield from own("tables 3 and 4, Kepler", orbit, each("RK4", ("h=0.02", "h=0.01", "h=5e-3"), "interpreted"))
    yield from own("tables 3 and 4, Kepler", orbit, each("RK3", ("h=0.01", "h=5e-3"), "interpreted"))
    packet = partial(rotating_packet, 0.5, 32, 0.1, 2e-4, nyquist="zero")
    yield from own("table 5, rotating packet", packet, "RK4 integrate")
    yield from own("figures 1 and 2, Kepler", kepler, "RK4 h=0.03 integrate")
    yield from own("solar system", partial(solar_system, years=100.0), "RK4 h=2e-3 integrate")
    yield from own("particle, uniform field", partial(short, uniform_field, 5000.0), "RK4 integrate")
    yield from own("particle, tokamak", partial(short, tokamak, 5000.0), "RK4 integrate")


def systems() -> Iterator[Run]:
    other = partial(runs, SYSTEMS)
    several: dict[str, Callable[[], Problem]] = {
        "pendulum": s.pendulum,
        "Duffing": s.duffing,
        "Henon-Heiles": s.henon_heiles,
        "double pendulum": two_pendulums,
        "top, from a plane of symmetry": partial(top, 0.0, 1.0, 1.0),
        "top, near its unstable axis": partial(top, 1e-3, 1.0, 1e-3),
        "Toda lattice": s.toda,
        "FPUT chain": s.fput,
        "sine-Gordon": s.sine_gordon,
    }
    for name, make in several.items():
        yield from other(name, make, "RK45 1e-3, RK45 1e-6, DOP853 1e-8, RK23 1e-4, RK4 h=0.02")
    yield from other("pendulum, Verlet's method", s.pendulum, "user h=0.02", user=s.Verlet(lambda t, q, v: -np.sin(q)))
    jitted = "RK4 h=0.02 integrate, RK45 1e-6 integrate, RK2 h=0.01 integrate, RK1 h=1e-3 integrate"
    yield from other("pendulum", s.compiled_pendulum, jitted)
    yield from other("Henon-Heiles", s.henon_heiles, "RKN8 1e-8, RKN12 h=0.3")
    for name, beta in (("Schroedinger", 0.0), ("condensate on a line", 5.0)):
        wave = partial(s.waves, 2.0, beta=beta)
        yield from other(name, wave, "RK45 1e-6, DOP853 1e-8, RK4 h=4e-3")
        yield from other(name, wave, each("RK4 metric=euclidean", ("h=4e-3", "h=0.02")))
    spring = partial(s.compiled_spring, end=100.0)
    yield from other(
        "spring", spring, "RK4 h=0.05 integrate, RK4 h=0.5 integrate, RKN12 h=1 integrate, RKN8 1e-8 integrate"
    )
    yield from other("spring", spring, "RK23 1e-3 integrate, RK45 1e-4 integrate, RK45 1e-10 integrate")
    fast = partial(s.compiled_spring, 1e8, end=0.1)
    yield from other("spring of frequency 1e4", fast, "RK4 h=1e-5 integrate, RK45 1e-6 integrate")
    trap = partial(s.compiled_trap, 1.0)
    yield from other("L in an isotropic trap", trap, "RK4 h=0.05 integrate, RK45 1e-6 integrate, RKN12 h=0.1 integrate")


def spacing() -> Iterator[Run]:
    some, points = partial(runs, EVERY), ("metric=euclidean", "direction=old", "direction=midpoint", "iterations=3")
    yield from some("Kepler", kepler, each("RK4 h=0.01", (*SPACINGS[1:], *points), "integrate"))
    yield from some("Kepler", kepler, each("RKN12 h=0.03", (*SPACINGS[1:], *points), "integrate"))
    yield from some("Kepler", kepler, each("RK45 1e-6", ("every=10", "every=auto", *points)))
    yield from some("pendulum", s.pendulum, each("RK4 h=0.02", ("every=10", "every=auto", *points)))


def one_coordinate(
    slope: Callable[[float], float], potential: Callable[[float], float], q0: float, v0: float
) -> Problem:
    return s.mechanics(
        lambda t, q, v: -slope(q[0]), lambda q: potential(q[0]), lambda q: np.array([slope(q[0])]), q0, v0, 20.0
    )


def huber(width: float) -> Problem:
    """Return a body on a spring whose force is constant beyond the elongation `width`."""
    return one_coordinate(
        lambda q: min(max(q, -width), width),
        lambda q: 0.5 * q * q if abs(q) < width else width * (abs(q) - width / 2),
        1.0,
        0.1,
    )


def contact(stiffness: float) -> Problem:
    """Return a ball that falls onto a spring of this stiffness."""
    return one_coordinate(
        lambda q: 1 + stiffness * min(q, 0.0), lambda q: q + 0.5 * stiffness * min(q, 0.0) ** 2, 1.0, 0.2
    )


def hertz(stiffness: float) -> Problem:
    """Return a ball that falls onto a fixed ball, with Hertz's contact force."""
    return one_coordinate(
        lambda q: 1 - stiffness * max(-q, 0.0) ** 1.5, lambda q: q + 0.4 * stiffness * max(-q, 0.0) ** 2.5, 1.0, 0.0
    )


def dead_zone(width: float) -> Problem:
    """Return a body on a spring without force within the distance `width` of the origin (backlash)."""
    return one_coordinate(
        lambda q: np.sign(q) * max(abs(q) - width, 0.0), lambda q: 0.5 * max(abs(q) - width, 0.0) ** 2, 1.0, 0.3
    )


def cubic_walls(stiffness: float) -> Problem:
    """Return a body that moves freely between soft walls."""
    return one_coordinate(
        lambda q: stiffness * np.sign(q) * max(abs(q) - 1, 0.0) ** 3,
        lambda q: stiffness / 4 * max(abs(q) - 1, 0.0) ** 4,
        0.0,
        1.0,
    )


def kinks() -> Iterator[Run]:
    some = partial(runs, KINKS)
    steps = "RK5 h=0.02, RK5 h=0.01 integrate, RK2 h=0.01, RK45 1e-6, RK45 1e-9 integrate, DOP853 1e-6, DOP853 1e-9"
    for make, size in (
        *((huber, width) for width in (0.1, 0.3, 0.7)),
        *((contact, stiffness) for stiffness in (30.0, 100.0)),
        *((hertz, stiffness) for stiffness in (100.0, 1000.0)),
        *((dead_zone, width) for width in (0.1, 0.5)),
        (cubic_walls, 100.0),
    ):
        yield from some(f"{make.__name__.replace('_', ' ')}, {size:g}", partial(make, size), steps)


def epidemic(infection: float, recovery: float, infected: float) -> Problem:
    return s.equations(sir(infection, recovery), [1 - infected, infected, 0.0], 60.0)


def loose() -> Iterator[Run]:
    some, tolerances = partial(runs, LOOSE), "RK45 1e-2, RK23 1e-2, DOP853 1e-2, RK45 1e-3"
    for start in ((0.1, 1.0, 0.1), (0.0, 1.0, 1.0), (0.5, 0.7, 0.3)):
        default = "RK45 rtol=1e-3, DOP853 rtol=1e-3, RK23 rtol=1e-3"
        yield from some(f"rigid body from {start}", partial(top, *start), default)
    for rates in ((0.5, 0.2), (0.4, 0.1), (1.0, 0.3), (2.0, 1.0)):
        for infected in (0.1, 1e-2, 1e-3):
            yield from some(f"SIR {rates}, {infected:g}", partial(epidemic, *rates, infected), tolerances)


def ensembles() -> Iterator[Run]:
    def near(y0: np.ndarray, spread: float) -> np.ndarray:
        return y0 * (1 + spread * np.random.default_rng(1).standard_normal((100, y0.size)))

    many, around = partial(runs, MEMBERS), near(kepler().y0, 1e-2)
    yield from many("100 orbits", kepler, "RK4 ensemble, RKN12 every=10 ensemble", y0s=around)
    free = partial(replace, kepler(t_end=30.0), h=None)
    yield from many("100 orbits", free, "RK45 1e-6 ensemble", y0s=around)
    lifted = np.linspace([0.1, 0.0], [3.0, 0.0], 100)
    yield from many("100 pendulums", s.bare_pendulum, "RK4 h=0.02 ensemble", params=np.zeros((100, 1)), y0s=lifted)
    planets = partial(solar_system, years=10.0)
    yield from many("100 solar systems", planets, "RKN12 h=0.015625 every=10 ensemble", y0s=near(planets().y0, 1e-6))
    crowd = kepler(0.3, 0.0).y0 * (1 + 1e-5 * np.arange(2000)[:, None])
    yield from many("2000 orbits, in vectors", partial(kepler, 0.3, 0.0, 200.0), "RK4 h=0.05 ensemble", y0s=crowd)
