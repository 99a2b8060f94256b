"""Stiff problems that have invariants, from chemistry, magnetism, mechanics and phase separation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import Invariant

from .mechanisms import chain, chain_by_angles, governor, governor_by_angles

Array = np.ndarray
TIGHT = 1e-11


@dataclass
class Case:
    """A stiff problem on an interval from 0 to `end`, and its reference.

    `size` is the typical size of the components, to which the absolute tolerance and errors are relative. `view` is the
    function of the last state whose values are compared with the reference; default: the state divided by `size`.
    ``truth()`` returns the true value of `view`; default: that by SciPy's Radau at small tolerances.
    """

    fun: Callable[[float, Array], Array]
    end: float
    y0: Array
    invariants: list[Invariant]
    size: Any = 1.0
    view: Callable[[Array], Any] | None = None
    truth: Callable[[], Any] | None = None
    calls: int = field(default=0, init=False)

    def counted(self, t: float, y: Array) -> Array:
        """Evaluate the right-hand side and count the call."""
        self.calls += 1
        return self.fun(t, y)

    @cached_property
    def reference(self) -> Array:
        """Return the true value of `view` at the end of the interval."""
        if self.truth is not None:
            return np.asarray(self.truth())
        atol = 1e-2 * TIGHT * self.size
        return self._viewed(solve_ivp(self.fun, (0, self.end), self.y0, method="Radau", rtol=TIGHT, atol=atol).y[:, -1])

    def _viewed(self, y: Array) -> Any:
        return y / self.size if self.view is None else self.view(y)

    def error(self, method: Any, rtol: float, share: float = 1e-2, **options: Any) -> tuple[float, int]:
        """Run the problem; return the error of the last state and the number of calls of `fun`.

        Calls for Jacobians are included. The error is the largest difference of a value of `view` from the reference.
        The absolute tolerance is ``share * rtol * size``, and `options` are those of `solve_ivp`.
        """
        self.calls = 0
        run = solve_ivp(
            self.counted, (0, self.end), self.y0, method=method, rtol=rtol, atol=share * rtol * self.size, **options
        )
        if not run.success:
            raise RuntimeError(run.message)
        return float(np.max(np.abs(self._viewed(run.y[:, -1]) - self.reference))), self.calls


def _linear(weights: Any, name: str = "mass") -> Invariant:
    row = np.array(weights, float)
    return Invariant(lambda t, y: row @ y, lambda t, y: row, name=name)


def robertson() -> Case:
    """Return Robertson's autocatalytic reaction; its invariant is the mass."""

    def fun(t: float, y: Array) -> Array:
        a, b, c = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
        return np.array([b - a, a - b - c, c])

    return Case(fun, 1e4, np.array([1.0, 0.0, 0.0]), [_linear([1, 1, 1])], np.array([1.0, 1e-5, 1.0]))


def hires() -> Case:
    """Return HIRES of the test set for initial value problem solvers; the sum of the last two species is invariant."""

    def fun(t: float, y: Array) -> Array:
        bound = 280 * y[5] * y[7]
        return np.array(
            [
                -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
                1.71 * y[0] - 8.75 * y[1],
                -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
                8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
                -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
                -bound + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
                bound - 1.81 * y[6],
                -bound + 1.81 * y[6],
            ]
        )

    start = np.array([1, 0, 0, 0, 0, 0, 0, 0.0057])
    return Case(fun, 321.8122, start, [_linear([0] * 6 + [1, 1])], np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.01, 0.01]))


def pyrolysis() -> Case:
    """Return E5 of the test set, the pyrolysis of a gas; its invariant is a linear relation between species."""
    A, B, M, C = 7.89e-10, 1.1e7, 1e6, 1.13e3

    def fun(t: float, y: Array) -> Array:
        first, second, third, fourth = A * y[0], B * y[0] * y[2], M * C * y[1] * y[2], C * y[3]
        return np.array([-first - second, first - third, first - second - third + fourth, second - fourth])

    size = np.array([1.76e-3, 1e-10, 1e-10, 1e-13])
    kept = Invariant(
        lambda t, y: y[1] - y[2] - y[3], lambda t, y: np.array([0.0, 1.0, -1.0, -1.0]), scale=1e-10, name="balance"
    )
    return Case(fun, 1e5, np.array([1.76e-3, 0, 0, 0]), [kept], size)


def enzyme() -> Case:
    """Return the reaction of Michaelis and Menten with fast binding; its invariants are total enzyme and substrate."""

    def fun(t: float, y: Array) -> Array:
        binding, back, made = 1e6 * y[0] * y[1], 1e3 * y[2], 1e1 * y[2]
        return np.array([back + made - binding, back - binding, binding - back - made, made])

    kept = [_linear([1, 0, 1, 0], "enzyme"), _linear([0, 1, 1, 1], "substrate")]
    return Case(fun, 20.0, np.array([0.01, 1.0, 0.0, 0.0]), kept, np.array([0.01, 1.0, 0.01, 1.0]))


def ozone() -> Case:
    """Return Chapman's ozone chemistry, in units of the oxygen; its invariant is the number of oxygen atoms."""

    def fun(t: float, y: Array) -> Array:
        atom, molecule, ozone = y
        split, joined, light, lost = 1e-3 * molecule, 1e5 * atom * molecule, 1e1 * ozone, 1e3 * atom * ozone
        return np.array([2 * split - joined + light - lost, -split - joined + light + 2 * lost, joined - light - lost])

    return Case(fun, 100.0, np.array([0.0, 1.0, 0.0]), [_linear([1, 2, 3], "atoms")], np.array([1e-5, 1.0, 1e-2]))


def magnet() -> Case:
    """Return a magnetic moment in a rotating field, with strong Landau-Lifshitz damping.

    The invariant is the squared length of the moment.
    """

    def fun(t: float, m: Array) -> Array:
        field_ = 1e3 * np.array([np.cos(t), np.sin(t), 0.5]) + 1e3 * np.array([0.0, 0.0, m[2]])
        turn = np.cross(m, field_)
        return -turn - 5.0 * np.cross(m, turn)

    length = Invariant(lambda t, m: m @ m, lambda t, m: 2 * m, name="length")
    return Case(fun, 5.0, np.array([0.6, 0.0, 0.8]), [length])


def dumbbell() -> Case:
    """Return two masses in the plane on a stiff spring with friction, in a harmonic trap; the invariant is L_z."""
    k, c = 1e6, 1e4

    def fun(t: float, y: Array) -> Array:
        q, v = y[:4].reshape(2, 2), y[4:].reshape(2, 2)
        along, moving = q[1] - q[0], v[1] - v[0]
        length = np.sqrt(along @ along)
        pull = (k * (length - 1) + c * (along @ moving) / length) * along / length
        return np.concatenate([y[4:], (pull - q[0]), 0.5 * (-pull - 2 * q[1])])

    mass = np.array([1.0, 1.0, 2.0, 2.0])

    def momentum(t: float, y: Array) -> Any:
        q, p = y[:4], mass * y[4:]
        return q[0] * p[1] - q[1] * p[0] + q[2] * p[3] - q[3] * p[2]

    def gradient(t: float, y: Array) -> Array:
        q, p = y[:4], mass * y[4:]
        return np.concatenate([[p[1], -p[0], p[3], -p[2]], mass * np.array([-q[1], q[0], -q[3], q[2]])])

    start = np.array([-1.0, 0.2, 0.0, 0.2, 0.1, -0.8, -0.2, 0.6])
    return Case(fun, 10.0, start, [Invariant(momentum, gradient, name="L")])


def satellite() -> Case:
    """Return a tumbling body with a fluid inside that hardly slips; the invariant is the length of angular momentum.

    The kinetic energy changes slowly and is not kept. Keeping the length alone increases the errors of the direction.
    """
    inertia, fluid, friction = np.array([1.0, 2.0, 3.0]), 0.5, 1e4

    def fun(t: float, y: Array) -> Array:
        L, slip = y[:3], y[3:]
        turned = np.cross(L, (L - fluid * slip) / inertia)
        return np.concatenate([turned, -friction * slip - turned / inertia])

    length = Invariant(lambda t, y: y[:3] @ y[:3], lambda t, y: np.concatenate([2 * y[:3], np.zeros(3)]), name="|L|^2")
    return Case(fun, 50.0, np.array([1.0, 0.9, 0.3, 0.1, 0.0, 0.2]), [length], np.array([1.0] * 3 + [1e-4] * 3))


def separation() -> Case:
    """Return the equation of Cahn and Hilliard on a ring of 48 points; its invariant is the mass."""
    n = 48
    ring = np.roll(np.eye(n), 1, axis=0) + np.roll(np.eye(n), -1, axis=0) - 2 * np.eye(n)
    step = 1.0 / n
    laplace = ring / step**2
    start = 0.1 + 0.2 * np.cos(2 * np.pi * np.arange(n) / n) + 0.1 * np.sin(6 * np.pi * np.arange(n) / n)

    def fun(t: float, u: Array) -> Array:
        return laplace @ (u**3 - u - 2e-3 * laplace @ u)

    return Case(fun, 0.2, start, [_linear(np.full(n, step))])


def chain_case(angles: Sequence[float] = (1.2, 0.9, 0.5), end: float = 5.0) -> Case:
    """Return the chain with dampers, see `chain`, with its constraints as invariants.

    `angles` are the angles of the links from the vertical at the start, in radians. The reference is a run of
    `chain_by_angles`, the same chain with the angles of the links as coordinates.
    """
    made, (fun, start, state) = chain(angles), chain_by_angles(angles)

    def truth() -> Array:
        return state(solve_ivp(fun, (0, end), start, method="Radau", rtol=1e-12, atol=1e-13).y[:, -1])

    return Case(made.fun, end, made.y0, made.invariants, truth=truth)


def governor_case(end: float = 5.0) -> Case:
    """Return the flyball governor, with its constraints and L_z as invariants.

    The height of the slider is compared with that in a run of `governor_by_angles`.
    """
    made, (fun, start, height) = governor(), governor_by_angles()

    def truth() -> Array:
        return height(solve_ivp(fun, (0, end), start, method="Radau", rtol=1e-12, atol=1e-14).y[:, -1])

    return Case(made.fun, end, made.y0, made.invariants, view=lambda y: 1.0 + y[2], truth=truth)


CASES: dict[str, Callable[[], Case]] = {
    "Robertson": robertson,
    "HIRES": hires,
    "E5": pyrolysis,
    "enzyme": enzyme,
    "ozone": ozone,
    "magnet": magnet,
    "dumbbell": dumbbell,
    "satellite": satellite,
    "Cahn-Hilliard": separation,
    "chain": chain_case,
    "governor": governor_case,
}
