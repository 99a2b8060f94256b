"""Faulty runs whose fault is invisible at the start or hardly affects the invariants: late leaks, light bodies."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from eip_scipy import Invariant
from eip_scipy.problems import Problem, nbody

from . import systems as s
from .record import Run, runs

LATE, LIGHT = "leak that starts late, or acts in places", "light body faster than the steps"
STRENGTHS = (1e-1, 1e-2, 1e-3, 1e-4)
FIXED = "RK2 h=0.01, RK3 h=0.02, RK4 h=0.02, RK5 h=0.02 integrate"
ADAPTIVE = "RK23 1e-5, RK45 1e-6, DOP853 1e-9 integrate"
# For accelerations that do not depend on velocities.
NYSTROM = "RKN8 h=0.05 integrate, RKN12 1e-9"


def friction_from_5(strength: float) -> Problem:
    return s.mechanics(
        lambda t, q, v: -np.sin(q) - strength * v * (t > 5), lambda q: -np.cos(q[0]), np.sin, 2.0, 0.0, 30.0
    )


def drag_at_pericentre(strength: float) -> Problem:
    def extra(t, y):
        return -strength * np.exp(-((np.hypot(y[0], y[1]) / 0.5) ** 8)) * y[2:]

    return s.central(extra, [1.6, 0.0, 0.0, 0.5], 40.0, s.kepler_energy())


def inelastic_bumper(strength: float) -> Problem:
    """Return a ball that falls onto a spring with friction."""
    return s.mechanics(
        lambda t, q, v: -1 - 400 * np.minimum(q, 0.0) - 10 * strength * v * (q < 0),
        lambda q: q[0] + 200 * min(q[0], 0.0) ** 2,
        lambda q: 1 + 400 * np.minimum(q, 0.0),
        1.0,
        0.0,
        15.0,
    )


def kicks(strength: float) -> Problem:
    """Return a pendulum that is pushed three times for a short time; the claimed energy is that of a free one."""

    def push(t):
        return 10 * strength * sum(np.exp(-(((t - at) / 0.2) ** 2)) for at in (6.1, 11.7, 17.3))

    return s.mechanics(lambda t, q, v: -np.sin(q) + push(t), lambda q: -np.cos(q[0]), np.sin, 2.0, 0.0, 25.0)


def one_bead(strength: float) -> Problem:
    """Return a chain of eight beads, of which the last one is braked."""
    friction = np.zeros(8)
    friction[-1] = strength
    return s.fput(n=8, end=60.0, friction=friction)


def light_planet(mass: float) -> Problem:
    """Return a star with G M = 1, a giant planet at the distance 5.2, and a planet with G M = `mass` at 0.2.

    The period of the latter is 0.56.
    """
    q = [[0.0, 0.0, 0.0], [5.2, 0.0, 0.0], [0.2, 0.0, 0.0]]
    v = [[0.0, 0.0, 0.0], [0.0, 5.2**-0.5, 0.0], [0.0, 0.2**-0.5, 0.0]]
    return nbody([1.0, 1e-3, mass], q, v, t_span=(0.0, 200.0))


def two_oscillators() -> Problem:
    """Return two oscillators of periods 0.25 and 6.3; the claimed energy is that of the slow one only."""
    slow = Invariant(
        lambda t, y: 0.5 * (y[0] ** 2 + y[1] ** 2), lambda t, y: np.array([y[0], y[1], 0.0, 0.0]), name="energy"
    )
    return s.claimed(lambda t, y: np.array([y[1], -y[0], y[3], -625 * y[2]]), [1.0, 0.0, 1.0, 0.0], 20.0, slow)


def late_leaks() -> Iterator[Run]:
    """Yield faulty runs of five systems whose energy changes only at some times or places."""
    leak = partial(runs, LATE)
    for make, more in (
        (friction_from_5, ""),
        (drag_at_pericentre, ""),
        (inelastic_bumper, ""),
        (kicks, NYSTROM),
        (one_bead, ""),
    ):
        for strength in STRENGTHS:
            name = f"{make.__name__.replace('_', ' ')}, {strength:g}"
            yield from leak(name, partial(make, strength), ", ".join(filter(None, (FIXED, ADAPTIVE, more))))


def light_bodies() -> Iterator[Run]:
    """Yield faulty runs with a light body whose period is at most six steps."""
    light = partial(runs, LIGHT)
    for mass in (1e-9, 0.0):
        yield from light(
            f"planet of mass {mass:g} at 0.2",
            partial(light_planet, mass),
            "RK2 h=0.3, RK3 h=0.3, RK4 h=0.3 integrate, RK5 h=0.3 integrate, RK45 h=0.3, DOP853 h=0.3 integrate, "
            "RKN8 h=0.3 integrate, RK4 h=0.1, RK5 h=0.1, RK45 h=0.1 integrate",
            truth=False,
        )
    yield from light("oscillator unknown to the energy", two_oscillators, "RK4 h=0.2, RK5 h=0.2 integrate, RKN8 h=0.4")
