"""Problems for the Gross-Pitaevskii equation: closed forms of the NLS equation, condensates of "the paper", and traps.

The paper is Cai, Gong & Wang; the condensates are those of its Experiment IV.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import ceil, pi, sqrt
from typing import Any

import numpy as np

from .equation import FieldProblem, GrossPitaevskii
from .grid import Grid

__all__ = [
    "breather",
    "harmonic_trap",
    "line_condensate",
    "plane_wave",
    "quartic_trap",
    "ring_condensate",
    "rotating_packet",
    "soliton",
]

Potential = Callable[..., Any]
# Wavenumbers of a soliton on both sides of v, in units of a. A grid whose largest one, pi divided by the spacing, is at
# least |v| + 5 a has errors of about 1e-3 at t = 10 / a^2; at |v| + 3 a they are 2e-2.
SOLITON_WAVENUMBERS = 5.0


def harmonic_trap(*gamma: float) -> Potential:
    """Harmonic trap, V = sum_a (gamma_a x_a)^2 / 2.

    Parameters
    ----------
    *gamma : float
        The frequency along each axis.

    Returns
    -------
    callable
        ``V(x[, y[, z]])``.

    Raises
    ------
    ValueError
        If called with another number of coordinates.
    """
    return lambda *x: 0.5 * _squares(gamma, x)


def quartic_trap(alpha: float, kappa: float, *gamma: float) -> Potential:
    """Quadratic-plus-quartic trap, V = (1 - alpha) / 2 s + kappa / 4 s^2 with s = sum_a (gamma_a x_a)^2.

    Parameters
    ----------
    alpha, kappa : float
    *gamma : float
        The frequency along each axis.

    Returns
    -------
    callable
        ``V(x[, y[, z]])``.
    """

    def potential(*x: np.ndarray) -> np.ndarray:
        s = _squares(gamma, x)
        return 0.5 * (1 - alpha) * s + 0.25 * kappa * s * s

    return potential


def _squares(gamma: tuple[float, ...], x: tuple[np.ndarray, ...]) -> Any:
    if len(gamma) != len(x):
        raise ValueError(
            f"a trap of {len(gamma)} frequencies does not fit {len(x)} coordinates; give one frequency for each."
        )
    return sum((g * a) ** 2 for g, a in zip(gamma, x, strict=True))


def soliton(
    points: int = 256,
    amplitude: float = 1.0,
    velocity: float = 1.0,
    beta: float = -1.0,
    length: float = 40.0,
    t_end: float = 10.0,
    h: float | None = None,
    **options: Any,
) -> FieldProblem:
    """Return the problem of a bright soliton of the focusing NLS equation in 1D, with its closed form.

    ``psi = a / sqrt(-beta) sech(a (x - v t)) exp(i (v x + (a^2 - v^2) t / 2))``, on a ring of the given length.

    Parameters
    ----------
    points : int
        Number of points of the grid.
    amplitude, velocity : float
        a and v.
    beta : float
        < 0.
    length : float
        Length of the ring; on the ring the closed form has an error of exp(-a length / 2).
    t_end : float
    h : float, optional
        Default: half of the largest stable step of RK4, `GrossPitaevskii.largest_step`.
    **options
        Options of `GrossPitaevskii`.

    Returns
    -------
    FieldProblem
        With the closed form as `reference`.

    Raises
    ------
    ValueError
        If beta is not negative, the amplitude is not positive, or the grid is too coarse for the soliton.
    """
    gpe = _focusing("bright soliton", points, length, amplitude, beta, options)
    largest = abs(velocity) + SOLITON_WAVENUMBERS * amplitude
    if pi * points / length < largest:
        raise ValueError(
            f"a bright soliton with amplitude = {amplitude:g} and velocity = {velocity:g} needs points at most "
            f"{pi / largest:.3g} apart, but {points} points on a ring of length {length:g} are {length / points:.3g} "
            f"apart. Give points >= {ceil(length * largest / pi)}."
        )
    x = gpe.grid.points(0)
    exact = partial(_soliton, x, length, amplitude, velocity, beta)
    start = exact(0.0)
    step = 0.5 * gpe.largest_step(start) if h is None else h
    return gpe.problem(start, t_end, step, name="soliton", reference=exact, source="Zakharov & Shabat 1972, eq. 2")


def breather(
    points: int = 1024,
    amplitude: float = 1.0,
    velocity: float = 0.0,
    beta: float = -1.0,
    length: float = 50.0,
    t_end: float = 5.0,
    h: float | None = None,
    **options: Any,
) -> FieldProblem:
    """Return the problem of two solitons of the focusing NLS equation in 1D at one place, with the closed form.

    At t = 0 it is ``psi = 2 a / sqrt(-beta) sech(a x) exp(i v x)``, the wave of Satsuma and Yajima, on a ring of the
    given length. Its modulus is periodic in time with the period pi / (2 a^2).

    Parameters
    ----------
    points, amplitude, velocity, beta, length, t_end
        As for `soliton`; a and v are amplitude and velocity.
    h : float, optional
        Default: 0.005 / a^2, a step for `Splitting`. The step of other methods must be below
        `GrossPitaevskii.largest_step`.
    **options
        Options of `GrossPitaevskii`.

    Returns
    -------
    FieldProblem
        With the closed form as `reference`.

    Raises
    ------
    ValueError
        If beta is not negative or the amplitude not positive.
    """
    gpe = _focusing("breather", points, length, amplitude, beta, options)
    exact = partial(_breather, gpe.grid.points(0), length, amplitude, velocity, beta)
    step = 0.005 / amplitude**2 if h is None else h
    source = "Satsuma & Yajima, Prog. Theor. Phys. Suppl. 55 (1974) 284"
    return gpe.problem(exact(0.0), t_end, step, name="breather", reference=exact, source=source)


def _focusing(
    kind: str, points: int, length: float, amplitude: float, beta: float, options: dict[str, Any]
) -> GrossPitaevskii:
    if not beta < 0 or not amplitude > 0:
        raise ValueError(f"a {kind} needs beta < 0 and amplitude > 0, got {beta!r} and {amplitude!r}.")
    return GrossPitaevskii(Grid(points, -length / 2, length / 2), beta=beta, **options)


def plane_wave(
    shape: Any = (64, 64),
    modes: Any = (1, 1),
    amplitude: float = 1.0,
    beta: float = 1.0,
    t_end: float = 1.0,
    h: float | None = None,
    **options: Any,
) -> FieldProblem:
    """Return the problem of a plane wave of the NLS equation, a stationary state H psi = omega psi.

    ``psi = A exp(i (k . x - omega t))``, ``omega = |k|^2 / 2 + beta A^2``, on a box of sides 2 pi. The gradients of
    mass and energy are parallel: a projection onto both has rank 1.

    Parameters
    ----------
    shape : int or sequence of int
        Numbers of points along the axes.
    modes : int or sequence of int
        k, a whole number along each axis.
    amplitude, beta, t_end : float
    h : float, optional
        Default: half of the largest stable step of RK4, `GrossPitaevskii.largest_step`.
    **options
        Options of `GrossPitaevskii`.

    Returns
    -------
    FieldProblem
        With the closed form as `reference`.

    Raises
    ------
    ValueError
        If the modes are not whole numbers, one for each axis.
    """
    gpe = GrossPitaevskii(Grid(shape, 0.0, 2 * pi), beta=beta, **options)
    k = np.atleast_1d(modes)
    if k.shape != (gpe.grid.dim,) or np.any(k != np.round(k)):
        raise ValueError(f"modes must be whole numbers, one for each axis of {gpe.grid!r}; got {modes!r}.")
    phase = sum(n * x for n, x in zip(k, gpe.grid.mesh(), strict=True))
    omega = 0.5 * float(k @ k) + beta * amplitude**2
    exact = partial(_plane_wave, amplitude, phase, omega)
    start = exact(0.0)
    step = 0.5 * gpe.largest_step(start) if h is None else h
    return gpe.problem(start, t_end, step, name="plane-wave", reference=exact)


def rotating_packet(
    Omega: float = 0.5, points: int = 128, t_end: float = 0.5, h: float = 2e-4, **options: Any
) -> FieldProblem:
    """Return the rotating wave packet of the paper's table 5, psi0 = 2 / sqrt(pi) (x + i y) exp(-8 (x^2 + y^2)).

    The box is [-2, 2]^2, V = (x^2 + y^2) / 2 and beta = 1.

    Parameters
    ----------
    Omega : float
        Angular velocity; the paper's are 0, 0.5 and 0.9.
    points : int
        Number of points along each axis.
    t_end, h : float
    **options
        Options of `GrossPitaevskii`; use ``nyquist="zero"`` for the paper's numbers.

    Returns
    -------
    FieldProblem
    """
    grid = Grid((points, points), -2.0, 2.0)
    gpe = GrossPitaevskii(grid, harmonic_trap(1.0, 1.0), Omega=Omega, beta=1.0, **options)
    x, y = grid.mesh()
    psi0 = 2 / sqrt(pi) * (x + 1j * y) * np.exp(-8 * (x**2 + y**2))
    return gpe.problem(psi0, t_end, h, name="rotating-packet")


def ring_condensate(kappa: float = 0.3, points: int = 256, **options: Any) -> GrossPitaevskii:
    """Return the paper's fast rotating ring: V = -0.1 r^2 + kappa / 4 r^4 on [-10, 10]^2, Omega = 3.5, beta = 1000.

    Parameters
    ----------
    kappa : float
        The paper computes the ground state for 0.3, and starts the dynamics by a change of kappa to 0.7.
    points : int
        Number of points along each axis. With the paper's 256, the phase at the ring's radius r turns by
        Omega r dx = 1.8 between neighbouring points, which are dx apart.
    **options
        Options of `GrossPitaevskii`.

    Returns
    -------
    GrossPitaevskii
    """
    grid = Grid((points, points), -10.0, 10.0)
    return GrossPitaevskii(grid, quartic_trap(1.2, kappa, 1.0, 1.0), Omega=3.5, beta=1000.0, **options)


def line_condensate(Omega: float = 0.7, points: int = 64, **options: Any) -> GrossPitaevskii:
    """Return the paper's condensate with vortex lines: V = (x^2 + y^2 + z^2 / 4) / 2, beta = 400.

    The box is [-10, 10]^2 x [-15, 15].

    Parameters
    ----------
    Omega : float
        0.7 for the paper's ground state, 0.9 for its dynamics.
    points : int
        Number of points along each axis.
    **options
        Options of `GrossPitaevskii`.

    Returns
    -------
    GrossPitaevskii
    """
    grid = Grid((points, points, points), (-10.0, -10.0, -15.0), (10.0, 10.0, 15.0))
    return GrossPitaevskii(grid, harmonic_trap(1.0, 1.0, 0.5), Omega=Omega, beta=400.0, **options)


def _soliton(x: np.ndarray, length: float, amplitude: float, velocity: float, beta: float, t: float) -> np.ndarray:
    s, moving = _moving(x, length, velocity, t)
    turn = np.exp(0.5j * amplitude**2 * t)
    return amplitude / sqrt(-beta) / np.cosh(amplitude * s) * turn * moving


def _breather(x: np.ndarray, length: float, amplitude: float, velocity: float, beta: float, t: float) -> np.ndarray:
    s, moving = _moving(x, length, velocity, t)
    s, t = np.abs(amplitude * s), amplitude**2 * t
    # All hyperbolic cosines of the closed form times 2 exp(-4 |s|): nothing overflows.
    above = np.exp(-s) + np.exp(-7 * s) + 3 * np.exp(4j * t) * (np.exp(-3 * s) + np.exp(-5 * s))
    below = 1 + np.exp(-8 * s) + 4 * (np.exp(-2 * s) + np.exp(-6 * s)) + 6 * np.cos(4 * t) * np.exp(-4 * s)
    return 4 * amplitude / sqrt(-beta) * np.exp(0.5j * t) * above / below * moving


def _moving(x: np.ndarray, length: float, velocity: float, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distances of points from a moving centre on the ring, and factors that make a field move."""
    # The phase follows the distance, so that nothing jumps where it turns.
    s = np.remainder(x - velocity * t + length / 2, length) - length / 2
    return s, np.exp(1j * (velocity * (s + velocity * t) - 0.5 * velocity**2 * t))


def _plane_wave(amplitude: float, phase: np.ndarray, omega: float, t: float) -> np.ndarray:
    return (amplitude * np.exp(1j * (phase - omega * t))).ravel()
