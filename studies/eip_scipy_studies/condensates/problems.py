"""Problems for the Gross-Pitaevskii equation: traps, closed forms of the NLS equation, and condensates of "the paper".

The paper is Cai, Gong & Wang; the condensates are those of its Experiment IV. `options` are those of `GrossPitaevskii`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import pi, sqrt
from typing import Any

import numpy as np

from eip_scipy.problems import FieldProblem, Grid, GrossPitaevskii


def quartic_trap(alpha: float, kappa: float, *gamma: float) -> Callable[..., Any]:
    """Return the trap V = (1 - alpha) / 2 s + kappa / 4 s^2, s = sum_a (gamma_a x_a)^2, one gamma for each axis."""

    def potential(*x: np.ndarray) -> Any:
        s: Any = sum((g * a) ** 2 for g, a in zip(gamma, x, strict=True))
        return 0.5 * (1 - alpha) * s + 0.25 * kappa * s * s

    return potential


harmonic_trap = partial(quartic_trap, 0.0, 0.0)
"""``harmonic_trap(*gamma)``: the trap V = s / 2."""


def soliton(
    points: int = 256, length: float = 40.0, t_end: float = 10.0, velocity: float = 1.0, beta: float = -1.0
) -> FieldProblem:
    """Return the problem of a bright soliton of the focusing NLS equation (beta < 0) on a ring, with its closed form.

    ``psi = sech(x - v t) / sqrt(-beta) exp(i (v x + (1 - v^2) t / 2))``, with an error of exp(-length / 2) on the ring
    (Zakharov & Shabat 1972, eq. 2). The step is half of the largest stable one of RK4.
    """
    gpe = GrossPitaevskii(Grid(points, -length / 2, length / 2), beta=beta)
    exact = partial(_soliton, gpe.grid.points(0), length, velocity, beta)
    start = exact(0.0)
    return gpe.problem(start, t_end, 0.5 * gpe.largest_step(start), name="soliton", reference=exact)


def _soliton(x: np.ndarray, length: float, velocity: float, beta: float, t: float) -> np.ndarray:
    s = np.remainder(x - velocity * t + length / 2, length) - length / 2  # the distance, with its sign, on the ring
    # The phase follows the distance, so that nothing jumps where it turns.
    moving = np.exp(1j * (velocity * (s + velocity * t) - 0.5 * velocity**2 * t))
    return 1 / sqrt(-beta) / np.cosh(s) * np.exp(0.5j * t) * moving


def plane_wave(
    shape: Any = (64, 64), modes: Any = (1, 1), amplitude: float = 1.0, beta: float = 1.0, t_end: float = 1.0
) -> FieldProblem:
    """Return the problem of a plane wave of the NLS equation, a stationary state H psi = omega psi.

    ``psi = A exp(i (k . x - omega t))``, ``omega = |k|^2 / 2 + beta A^2``, on a box of sides 2 pi, k = `modes`.
    """
    gpe = GrossPitaevskii(Grid(shape, 0.0, 2 * pi), beta=beta)
    k = np.atleast_1d(modes)
    phase = sum(n * x for n, x in zip(k, gpe.grid.mesh(), strict=True))
    exact = partial(_plane_wave, amplitude, phase, 0.5 * float(k @ k) + beta * amplitude**2)
    start = exact(0.0)
    return gpe.problem(start, t_end, 0.5 * gpe.largest_step(start), name="plane-wave", reference=exact)


def _plane_wave(amplitude: float, phase: np.ndarray, omega: float, t: float) -> np.ndarray:
    return (amplitude * np.exp(1j * (phase - omega * t))).ravel()


def rotating_packet(
    Omega: float = 0.5, points: int = 128, t_end: float = 0.5, h: float = 2e-4, **options: Any
) -> FieldProblem:
    """Return the rotating wave packet of the paper's table 5, psi0 = 2 / sqrt(pi) (x + i y) exp(-8 (x^2 + y^2)).

    The box is [-2, 2]^2, V = (x^2 + y^2) / 2 and beta = 1. The paper's numbers need ``nyquist="zero"``.
    """
    grid = Grid((points, points), -2.0, 2.0)
    gpe = GrossPitaevskii(grid, harmonic_trap(1.0, 1.0), Omega=Omega, beta=1.0, **options)
    x, y = grid.mesh()
    psi0 = 2 / sqrt(pi) * (x + 1j * y) * np.exp(-8 * (x**2 + y**2))
    return gpe.problem(psi0, t_end, h, name="rotating-packet")


def ring_condensate(kappa: float = 0.3, points: int = 256) -> GrossPitaevskii:
    """Return the paper's fast rotating ring: V = -0.1 r^2 + kappa / 4 r^4 on [-10, 10]^2, Omega = 3.5, beta = 1000."""
    grid = Grid((points, points), -10.0, 10.0)
    return GrossPitaevskii(grid, quartic_trap(1.2, kappa, 1.0, 1.0), Omega=3.5, beta=1000.0)


def line_condensate(Omega: float = 0.7, points: int = 64) -> GrossPitaevskii:
    """Return the paper's condensate with vortex lines: V = (x^2 + y^2 + z^2 / 4) / 2, beta = 400.

    The box is [-10, 10]^2 x [-15, 15], with `points` points along each axis.
    """
    grid = Grid((points, points, points), (-10.0, -10.0, -15.0), (10.0, 10.0, 15.0))
    return GrossPitaevskii(grid, harmonic_trap(1.0, 1.0, 0.5), Omega=Omega, beta=400.0)
