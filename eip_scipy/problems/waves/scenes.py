"""Solitons with closed forms: breathers and kinks of the sine-Gordon equation, solitons of Korteweg and de Vries."""

from __future__ import annotations

from functools import partial
from itertools import combinations, product
from math import ceil, sqrt
from typing import Any

import numpy as np

from ..gross_pitaevskii.grid import Grid
from .korteweg_de_vries import KortewegDeVries
from .modes import WaveProblem
from .sine_gordon import SineGordon

__all__ = ["korteweg_de_vries_solitons", "sine_gordon_breather", "sine_gordon_kinks"]


def sine_gordon_breather(
    points: int = 512,
    frequency: float = 0.6,
    velocity: float = 0.0,
    length: float = 80.0,
    t_end: float = 20.0,
    h: float | None = None,
) -> WaveProblem:
    """Return the problem of a breather of the sine-Gordon equation, at rest or moving, with its closed form.

    ``tan(q / 4) = b / w sin(w s) / cosh(b z)``, b = sqrt(1 - w^2), with s and z the time and place in the frame that
    moves with the breather, on a ring of the given length.

    Parameters
    ----------
    points : int
    frequency : float
        w, between 0 and 1.
    velocity : float
        Between -1 and 1.
    length : float
        Length of the ring; exp(-b length / 2) is the error of the closed form there.
    t_end : float
    h : float, optional
        Default: half of `SineGordon.largest_step`.

    Returns
    -------
    WaveProblem
        With the closed form as `reference`.

    Raises
    ------
    ValueError
        If the frequency or the velocity is out of range, or the velocity so high that the breather is narrower than two
        spacings of the grid.
    """
    if not 0 < frequency < 1 or not -1 < velocity < 1:
        raise ValueError(f"a breather needs 0 < frequency < 1 and |velocity| < 1, got {frequency!r} and {velocity!r}.")
    _require_resolved(f"a breather with velocity = {velocity:g}", sqrt(1 - velocity**2), length, points)
    return _sine_gordon("sine-gordon-breather", partial(_breather, frequency, velocity), points, length, t_end, h)


def sine_gordon_kinks(
    points: int = 512, velocity: float = 0.5, length: float = 80.0, t_end: float = 20.0, h: float | None = None
) -> WaveProblem:
    """Return the problem of a kink and an antikink of the sine-Gordon equation that collide, with its closed form.

    ``tan(q / 4) = sinh(v c s) / (v cosh(c x))``, with c = 1 / sqrt(1 - v^2) and s = t - t_end / 2. The kinks meet in
    the middle of the run, at the middle of the ring.

    Parameters
    ----------
    points : int
    velocity : float
        v, the velocity of the kink, between 0 and 1; the antikink has the velocity -v.
    length : float
        Length of the ring; the error of the closed form there is exp(-c (length - v t_end) / 2).
    t_end : float
    h : float, optional
        Default: half of `SineGordon.largest_step`.

    Returns
    -------
    WaveProblem
        With the closed form as `reference`.

    Raises
    ------
    ValueError
        If the velocity is out of range, or so high that the kinks are narrower than two spacings of the grid.
    """
    if not 0 < velocity < 1:
        raise ValueError(f"kinks need 0 < velocity < 1, got {velocity!r}.")
    _require_resolved(f"kinks with velocity = {velocity:g}", sqrt(1 - velocity**2), length, points)
    return _sine_gordon("sine-gordon-kinks", partial(_kinks, velocity, t_end / 2), points, length, t_end, h)


def _require_resolved(what: str, width: float, length: float, points: int) -> None:
    """Refuse a grid with a spacing of more than half of the width of a wave, as sqrt(1 - v^2) if motion contracts it.

    With two points in its width 2 / sqrt(c) a soliton of the Korteweg-de Vries equation has errors of about 1e-3.
    """
    if length / points > width / 2:
        raise ValueError(
            f"{what} has the width {width:.3g}, but {points} points on a ring of length {length:g} are "
            f"{length / points:.3g} apart. Give points >= {ceil(2 * length / width)}."
        )


def _sine_gordon(name: str, closed: Any, points: int, length: float, t_end: float, h: float | None) -> WaveProblem:
    equation = SineGordon(Grid(points, -length / 2, length / 2))
    exact = partial(closed, equation.grid.points(0), length)
    start = exact(0.0)
    step = 0.5 * equation.largest_step() if h is None else h
    return equation.problem(start[:points], start[points:], t_end, step, name=name, reference=exact)


def _breather(frequency: float, velocity: float, x: np.ndarray, length: float, t: float) -> np.ndarray:
    b, c = sqrt(1 - frequency**2), 1 / sqrt(1 - velocity**2)
    distance = _around(x - velocity * t, length)
    z, s = c * distance, t / c - c * velocity * distance  # c (x - v t) and c (t - v x)
    ratio, sech = b / frequency, 1 / np.cosh(b * z)
    sine, cosine = np.sin(frequency * s), np.cos(frequency * s)
    u = ratio * sine * sech
    # The rates of s and z are c and -c v.
    u_t = ratio * sech * c * (frequency * cosine + velocity * b * sine * np.tanh(b * z))
    return np.concatenate([4 * np.arctan(u), 4 * u_t / (1 + u * u)])


def _kinks(velocity: float, middle: float, x: np.ndarray, length: float, t: float) -> np.ndarray:
    c = 1 / sqrt(1 - velocity**2)
    s = velocity * c * (t - middle)
    sech = 1 / (velocity * np.cosh(c * x))
    u, u_t = np.sinh(s) * sech, velocity * c * np.cosh(s) * sech
    return np.concatenate([4 * np.arctan(u), 4 * u_t / (1 + u * u)])


def korteweg_de_vries_solitons(
    speeds: Any = (2.0, 1.0),
    places: Any = (-8.0, 4.0),
    points: int = 256,
    length: float = 64.0,
    t_end: float = 20.0,
    h: float | None = None,
) -> WaveProblem:
    """Return the problem of Korteweg-de Vries solitons that overtake each other, with its closed form.

    One soliton is ``u = c / 2 sech^2(sqrt(c) (x - c t - x0) / 2)``; for several solitons the closed form is Hirota's.

    Parameters
    ----------
    speeds : float or sequence of float
        c of each soliton, positive and all different.
    places : float or sequence of float
        x0 of each soliton. At the start only a soliton to the left of all others is at its x0; the interaction with the
        others has shifted the rest.
    points : int
    length : float
        Length of the ring. The closed form is that of an infinite line: all solitons must stay well within half of the
        ring around the point that starts at the mean of the places and moves with the mean of the speeds.
    t_end : float
    h : float, optional
        Default: 1/3 of `KortewegDeVries.largest_step`.

    Returns
    -------
    WaveProblem
        With the closed form as `reference`.

    Raises
    ------
    ValueError
        If speeds are not positive or not different, the numbers of speeds and places differ, or the fastest soliton is
        narrower than two spacings of the grid.
    """
    c, x0 = np.atleast_1d(np.asarray(speeds, dtype=float)), np.atleast_1d(np.asarray(places, dtype=float))
    if c.ndim != 1 or not np.all(c > 0) or np.unique(c).size != c.size or x0.shape != c.shape:
        raise ValueError(
            f"solitons need positive speeds, all different, and a place for each; got {speeds!r} and {places!r}."
        )
    equation = KortewegDeVries(Grid(points, -length / 2, length / 2))
    _require_resolved(f"a soliton of the speed {c.max():g}", 2 / sqrt(c.max()), length, points)
    exact = partial(_solitons, equation.grid.points(0), length, np.sqrt(c), x0)
    start = exact(0.0)
    step = equation.largest_step(0.5 * c.max()) / 3 if h is None else h
    return equation.problem(start, t_end, step, name="korteweg-de-vries-solitons", reference=exact)


def _solitons(x: np.ndarray, length: float, k: np.ndarray, x0: np.ndarray, t: float) -> np.ndarray:
    """Return the field of the solitons at the points x and the time t, 2 (log F)_xx.

    `k` are the square roots of the speeds. F is the sum over all sets of solitons of the exponential of the sum of k (x
    - x0 - k^2 t) over the set and of the shifts of its pairs. With the terms of F as weights the field is twice the
    variance of the sum of k over a set.
    """
    centre = np.mean(x0) + np.mean(k**2) * t
    place = _around(x - centre, length) + centre
    sets = np.array(list(product((0.0, 1.0), repeat=k.size)))
    exponent = sets @ (k[:, None] * (place - x0[:, None] - (k * k * t)[:, None]))
    for i, j in combinations(range(k.size), 2):
        both = sets[:, i] * sets[:, j]
        exponent += (2 * both * np.log(abs(k[i] - k[j]) / (k[i] + k[j])))[:, None]
    weights = np.exp(exponent - exponent.max(axis=0))
    weights /= weights.sum(axis=0)
    slopes = sets @ k
    away = slopes[:, None] - slopes @ weights
    return 2 * np.sum(weights * away * away, axis=0)


def _around(x: np.ndarray, length: float) -> np.ndarray:
    """Return the shortest distances on the ring, with signs, from distances on the line."""
    return np.remainder(x + length / 2, length) - length / 2
