"""Stiff mechanisms in natural coordinates: a chain with dampers, and Watt's governor with stiff couplers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import Invariant

Array = np.ndarray
GRAVITY = 9.81
# The governor of the multibody benchmark library (A05), SI units: distance of the rods' joints from the axis, length
# and mass of a rod, mass of a ball and of the slider, inertia of slider and shaft; springs, dampers, start.
JOINT, ROD, ROD_MASS, BALL, SLIDER = 0.05, 1.0, 0.3, 5.0, 3.0
AXIS_INERTIA = SLIDER * (0.1**2 + 0.1**2) / 12 + 0.3 * (0.01**2 + 0.01**2) / 12
STIFFNESS, DAMPING, REST, HEIGHT = 8e5, 4e4, 0.5, 0.5
ANGLE, SPEED = np.pi / 6, 2 * np.pi


@dataclass(frozen=True)
class Natural:
    """A mechanism with a constant mass matrix and constraints q H q / 2 = value, in coordinates q.

    `mass` is (n, n), `forms` are the symmetric matrices H (k, n, n) and `values` their values (k,). ``forces(q, v)``
    returns the forces (n,), and `y0` (2 n,) is the state (q, v) at the start, which satisfies the constraints. `turn`
    (n, n) is the generator of the rotation under which the system is invariant: (turn q) . M v is the angular momentum.
    """

    mass: Array
    forms: Array
    values: Array
    forces: Callable[[Array, Array], Array]
    y0: Array
    turn: Array | None = None

    def fun(self, t: float, y: Array) -> Array:
        """Return the right-hand side (v, dv/dt), with the multipliers eliminated."""
        q, v = np.split(y, 2)
        G = self.forms @ q
        free = np.linalg.solve(self.mass, np.column_stack([self.forces(q, v), G.T]))
        multipliers = np.linalg.solve(G @ free[:, 1:], -(self.forms @ v) @ v - G @ free[:, 0])
        return np.concatenate([v, free[:, 0] + free[:, 1:] @ multipliers])

    @property
    def invariants(self) -> list[Invariant]:
        """Return the constraints on positions and velocities, and the angular momentum if `turn` is given."""
        k, H = len(self.values), self.forms

        def places(t: float, y: Array) -> Array:
            q = np.split(y, 2)[0]
            return 0.5 * (H @ q) @ q - self.values

        def places_gradient(t: float, y: Array) -> Array:
            q = np.split(y, 2)[0]
            return np.hstack([H @ q, np.zeros((k, q.size))])

        def speeds(t: float, y: Array) -> Array:
            q, v = np.split(y, 2)
            return (H @ q) @ v

        def speeds_gradient(t: float, y: Array) -> Array:
            q, v = np.split(y, 2)
            return np.hstack([H @ v, H @ q])

        zero = np.zeros(k)
        kept = [
            Invariant(places, places_gradient, target=zero, name="g"),
            Invariant(speeds, speeds_gradient, target=zero, name="dg/dt"),
        ]
        if self.turn is not None:
            R, M = self.turn, self.mass

            def momentum(t: float, y: Array) -> Any:
                q, v = np.split(y, 2)
                return (R @ q) @ (M @ v)

            def momentum_gradient(t: float, y: Array) -> Array:
                q, v = np.split(y, 2)
                return np.concatenate([R.T @ (M @ v), M @ (R @ q)])

            kept.append(Invariant(momentum, momentum_gradient, name="L_z"))
        return kept


def chain(angles: Sequence[float], damping: float = 1e4) -> Natural:
    """Make a plane chain of links of 1 m with 1 kg at their ends, at rest, and rotational dampers between the links.

    `angles` are those of the links from the vertical [rad], and `damping` is the damping constant [N m s].
    """
    n = len(angles)
    link = np.kron(np.eye(n) - np.eye(n, k=-1), np.eye(2)).reshape(n, 2, 2 * n)  # the vector along a link, by q
    weight = np.tile([0.0, -GRAVITY], n)

    def forces(q: Array, v: Array) -> Array:
        along, moving = link @ q, link @ v
        turned = np.column_stack([-along[:, 1], along[:, 0]]) / (along**2).sum(axis=1)[:, None]
        torque = damping * np.diff((turned * moving).sum(axis=1))
        torques = np.append(torque, 0.0) - np.append(0.0, torque)
        return weight + np.einsum("i,ij,ijk->k", torques, turned, link)

    start = np.cumsum(np.column_stack([np.sin(angles), -np.cos(angles)]), axis=0).ravel()
    forms = np.einsum("ijk,ijl->ikl", link, link)
    return Natural(np.eye(2 * n), forms, np.full(n, 0.5), forces, np.concatenate([start, 0 * start]))


def chain_by_angles(angles: Sequence[float], damping: float = 1e4) -> tuple[Any, Array, Any]:
    """Make the chain of `chain` with the angles of the links as coordinates.

    Return the right-hand side, the start (angles, rates), and a function that converts a state to that of `chain`.
    """
    n = len(angles)
    places = np.arange(n)
    beyond = n - np.maximum.outer(places, places)

    def fun(t: float, y: Array) -> Array:
        angle, speed = np.split(y, 2)
        between = angle[:, None] - angle
        torque = damping * np.diff(speed)
        right = np.append(torque, 0.0) - np.append(0.0, torque) - (beyond * np.sin(between)) @ speed**2
        right -= GRAVITY * (n - places) * np.sin(angle)
        return np.concatenate([speed, np.linalg.solve(beyond * np.cos(between), right)])

    def state(y: Array) -> Array:
        angle, speed = np.split(y, 2)
        q = np.cumsum(np.column_stack([np.sin(angle), -np.cos(angle)]), axis=0)
        v = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]) * speed[:, None], axis=0)
        return np.concatenate([q.ravel(), v.ravel()])

    return fun, np.concatenate([angles, np.zeros(n)]), state


def governor() -> Natural:
    """Make the flyball governor: rods whose couplers to the slider are stiff springs with dampers.

    The coordinates are the direction u of the shaft (2), the height of the slider, and the balls (3 each); heights are
    measured from the rods' joints. The rods are uniform bars from the joints, ``u JOINT`` and ``-u JOINT``, to the
    balls. The constraints are ``|u| = 1``, the rods' lengths, and that the balls stay in the plane of u and the axis.
    """
    n = 9
    pick = np.eye(n)
    u, s, balls = pick[:2], pick[2], (pick[3:6], pick[6:9])
    level = np.array([0.0, 0.0, 1.0])
    mass = AXIS_INERTIA * u.T @ u + SLIDER * np.outer(s, s)
    weight, forms, values = -SLIDER * GRAVITY * s, [u.T @ u], [0.5]
    for sign, ball in zip((1.0, -1.0), balls, strict=True):
        joint = np.vstack([sign * JOINT * u, 0 * s])
        pair = joint.T @ ball
        mass = mass + ROD_MASS / 3 * (joint.T @ joint + ball.T @ ball + 0.5 * (pair + pair.T)) + BALL * ball.T @ ball
        weight = weight - (BALL + 0.5 * ROD_MASS) * GRAVITY * (level @ ball)
        forms.append((ball - joint).T @ (ball - joint))
        values.append(0.5 * ROD**2)
        beside = np.outer(u[0], ball[1]) - np.outer(u[1], ball[0])
        forms.append(beside + beside.T)
        values.append(0.0)

    couplers = [
        0.5 * (ball + np.vstack([sign * JOINT * u, 0 * s])) - np.vstack([sign * JOINT * u, s])
        for sign, ball in zip((1.0, -1.0), balls, strict=True)
    ]

    def forces(q: Array, v: Array) -> Array:
        total = weight.copy()
        for coupler in couplers:
            along = coupler @ q
            length = np.sqrt(along @ along)
            along = along / length
            pull = STIFFNESS * (length - REST) + DAMPING * (along @ (coupler @ v))
            total -= pull * (along @ coupler)
        return total

    turn = np.zeros((n, n))
    for first in (0, 3, 6):
        turn[first, first + 1], turn[first + 1, first] = -1.0, 1.0
    out = JOINT + ROD * np.cos(ANGLE)
    q = np.array([1.0, 0.0, HEIGHT - 1.0, out, 0.0, -ROD * np.sin(ANGLE), -out, 0.0, -ROD * np.sin(ANGLE)])
    return Natural(mass, np.array(forms), np.array(values), forces, np.concatenate([q, SPEED * turn @ q]), turn)


def governor_by_angles() -> tuple[Any, Array, Any]:
    """Make the governor of `governor` with two coordinates: the rods' angle below the level, and the slider's height.

    The height is measured from the ground, 1 m below the rods' joints. The shaft's speed comes from the angular
    momentum. Return the right-hand side, the start (angle, height and their rates), and a function of a state that
    returns the height.
    """
    swing = 2 * (ROD_MASS / 3 + BALL) * ROD**2  # of both rods

    def inertia(angle: float) -> tuple[float, float]:
        """Return the moment of inertia about the axis, and its derivative by the angle."""
        out, slope = ROD * np.cos(angle), -ROD * np.sin(angle)
        rods = ROD_MASS * (JOINT**2 + JOINT * out + out**2 / 3) + BALL * (JOINT + out) ** 2
        return AXIS_INERTIA + 2 * rods, 2 * slope * (ROD_MASS * (JOINT + out / 1.5) + 2 * BALL * (JOINT + out))

    momentum = inertia(ANGLE)[0] * SPEED

    def fun(t: float, y: Array) -> Array:
        angle, height, turning, rising = y
        total, slope = inertia(angle)
        half = 0.5 * ROD * np.array([np.cos(angle), -np.sin(angle)])
        along = half - [0.0, height - 1.0]
        length = np.hypot(*along)
        along /= length
        by_angle = along @ (0.5 * ROD * np.array([-np.sin(angle), -np.cos(angle)]))
        pull = STIFFNESS * (length - REST) + DAMPING * (by_angle * turning - along[1] * rising)
        torque = 0.5 * momentum**2 * slope / total**2 - 2 * pull * by_angle
        torque += 2 * (BALL + 0.5 * ROD_MASS) * GRAVITY * ROD * np.cos(angle)
        return np.array([turning, rising, torque / swing, 2 * pull * along[1] / SLIDER - GRAVITY])

    return fun, np.array([ANGLE, HEIGHT, 0.0, 0.0]), lambda y: y[1]
