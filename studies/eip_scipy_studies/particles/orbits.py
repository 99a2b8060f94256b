"""Analysis of the states of a charged particle: guiding centre, gyrophase, magnetic moment, banana tips."""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from eip_scipy.problems import ParticleProblem


class ParticleOrbit:
    """States y (6, m) of a charged particle at the times t (m,), and the quantities that are computed from them.

    Guiding centre and magnetic moment, of lowest order, oscillate with the gyration, which `averaged` removes.
    """

    def __init__(self, problem: ParticleProblem, t: np.ndarray, y: np.ndarray) -> None:
        self.problem, self.t, self.y = problem, t, y
        self.x, self.z = y[:3], y[2]
        self.R = np.hypot(y[0], y[1])  # the distance from the z axis

    def _field(self, name: str) -> np.ndarray:
        return self.problem.field.along(name, self.x, self.t)

    @cached_property
    def v(self) -> np.ndarray:
        """Velocities (3, m)."""
        return self.problem.velocity(self.y)

    @cached_property
    def energy(self) -> np.ndarray:
        """H = m v^2 / 2 + q phi (m,)."""
        return 0.5 * self.problem.mass * (self.v * self.v).sum(axis=0) + self.problem.charge * self._field("phi")

    @cached_property
    def momentum(self) -> np.ndarray:
        """L = x p_y - y p_x with the canonical p = m v + q A (m,)."""
        canonical = self.problem.form == "canonical"
        p = self.y[3:] if canonical else self.problem.mass * self.v + self.problem.charge * self._field("A")
        return self.y[0] * p[1] - self.y[1] * p[0]

    @cached_property
    def _magnetic(self) -> tuple[np.ndarray, np.ndarray]:
        """B (3, m) and its magnitude (m,)."""
        B = self._field("B")
        return B, np.sqrt((B * B).sum(axis=0))

    @cached_property
    def parallel_velocity(self) -> np.ndarray:
        """Component of v along B (m,)."""
        B, strength = self._magnetic
        return (self.v * B).sum(axis=0) / strength

    @cached_property
    def _gyrating(self) -> np.ndarray:
        """Velocity across B without the drift E x B / B^2, (3, m)."""
        B, strength = self._magnetic
        across = self.v - self.parallel_velocity / strength * B
        return across - np.cross(self._field("E"), B, axis=0) / strength**2

    @cached_property
    def magnetic_moment(self) -> np.ndarray:
        """Moment ``m v_perp^2 / (2 B)`` (m,), with v_perp relative to the drift E x B / B^2; an adiabatic invariant."""
        return 0.5 * self.problem.mass * (self._gyrating**2).sum(axis=0) / self._magnetic[1]

    @cached_property
    def guiding_centre(self) -> np.ndarray:
        """Positions x + m v x B / (q B^2), (3, m)."""
        B, strength = self._magnetic
        return self.x + self.problem.mass / self.problem.charge * np.cross(self.v, B, axis=0) / strength**2

    @cached_property
    def guiding_angle(self) -> np.ndarray:
        """Angle of the guiding centre around the z axis in rad, without jumps (m,)."""
        return np.unwrap(np.arctan2(self.guiding_centre[1], self.guiding_centre[0]))

    @cached_property
    def gyrophase(self) -> np.ndarray:
        """Angle of the gyration around B in rad, from the direction away from the z axis, without jumps (m,)."""
        b = self._magnetic[0] / self._magnetic[1]
        away = np.stack([self.y[0], self.y[1], np.zeros_like(self.t)]) / self.R
        first = away - (away * b).sum(axis=0) * b
        first = first / np.sqrt((first * first).sum(axis=0))
        second = np.cross(b, first, axis=0)
        return np.unwrap(np.arctan2((self._gyrating * second).sum(axis=0), (self._gyrating * first).sum(axis=0)))

    @cached_property
    def _edges(self) -> np.ndarray:
        """Times (m + 1,) since the first state at which one state's share of time ends and the next one's begins."""
        since = np.abs(self.t - self.t[0])
        return np.concatenate([[-since[1] / 2], (since[1:] + since[:-1]) / 2, [1.5 * since[-1] - since[-2] / 2]])

    @cached_property
    def _gyration(self) -> tuple[float, int]:
        """Duration of the averages, one gyration, and number of them."""
        spacing = float(np.median(np.abs(np.diff(self.t))))
        turning = abs(self.problem.charge) * self._magnetic[1][0] / self.problem.mass
        count = round(2 * np.pi / (turning * spacing))
        # For equal times the averages are then over whole states. A small part of the spacing allows for rounding.
        last = self._edges[-1] - (count - 1e-6) * spacing
        return count * spacing, int(np.searchsorted(self._edges, last, side="right"))

    def averaged(self, values: Any) -> np.ndarray:
        """Return the running means (..., k) of a quantity (..., m) over one gyration, weighted by the spacing of times.

        Each state that is followed by a whole gyration begins one mean; ``averaged(orbit.t)`` are their times.
        """
        duration, k = self._gyration
        edges, values = self._edges, np.asarray(values, dtype=float)
        # About the first value, so that a long sum does not lose digits of what varies.
        about = values - values[..., :1]
        sums = np.cumsum(about * np.diff(edges), axis=-1)
        sums = np.concatenate([np.zeros_like(sums[..., :1]), sums], axis=-1)
        ends = edges[:k] + duration
        last = np.minimum(np.searchsorted(edges, ends, side="right"), self.t.size) - 1
        upper = sums[..., last] + (ends - edges[last]) * about[..., last]
        return (upper - sums[..., :k]) / duration + values[..., :1]

    def bounce_points(self) -> np.ndarray:
        """Return the distances R, interpolated, at which the averaged guiding centre turns along B: banana tips."""
        along = self.averaged(self.parallel_velocity)
        k = np.flatnonzero(np.sign(along[1:]) * np.sign(along[:-1]) < 0)
        R = self.averaged(np.hypot(self.guiding_centre[0], self.guiding_centre[1]))
        return R[k] + along[k] / (along[k] - along[k + 1]) * (R[k + 1] - R[k])

    def turns(self) -> np.ndarray:
        """Return the net revolutions (m,) of the guiding centre around the z axis since the first state, all >= 0."""
        return np.abs(self.guiding_angle - self.guiding_angle[0]) / (2 * np.pi)

    def radial_range(self, turn: float) -> float:
        """Return half of the range of R in the turn of the guiding centre that ends at `turn`, 1 the first.

        For a guiding centre at constant R this is the gyroradius. It is nan if the run does not reach the turn's end.
        """
        turns = self.turns()
        if not turns[-1] >= turn:
            return float("nan")
        return float(np.ptp(self.R[(turns >= turn - 1) & (turns <= turn)])) / 2

    def poloidal_turns(self) -> list[slice]:
        """Return slices of the states between two passages of the averaged guiding centre upward through z = 0."""
        height = self.averaged(self.guiding_centre[2])
        up = np.flatnonzero((height[:-1] < 0) & (height[1:] >= 0))
        middles = self._edges[up] + (0.5 + 1e-9) * self._gyration[0]  # at equal times, some lie on an edge
        states = np.searchsorted(self._edges, middles, side="right") - 1
        return [slice(a, b) for a, b in pairwise(states.tolist())]
