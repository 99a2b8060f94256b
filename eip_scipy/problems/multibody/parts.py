"""Functions of a mechanism: those of the user, and those that a problem is made of, with numerical derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ...core.gradients import NumericalGradient, difference_gradient, time_of_motion
from ...core.inputs import shown
from ...core.states import own_values
from .motion import plain
from .start import Names

__all__ = [
    "Energy",
    "Given",
    "Outputs",
    "Parts",
    "columns_of",
    "numerical_parts",
    "on_copies",
    "outputs_as_given",
    "required_outputs",
]


class Outputs(NamedTuple):
    """Names of outputs, and ``fill(t, x, out, *params)``, which computes them from x = (q, u, u')."""

    names: tuple[str, ...]
    fill: Callable[..., None]


def columns_of(what: str, t: Any, y: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times as an array (k,) and the states as columns (n, k); ValueError if they do not fit."""
    times, states = np.atleast_1d(np.asarray(t, float)), np.asarray(y, float)
    columns = states.reshape(len(states), -1)
    if np.ndim(t) != states.ndim - 1 or columns.shape != (n, times.size):
        raise ValueError(
            f"{what}: y has the shape {states.shape} for {times.size} times; expected ({n},) for a number t, or a "
            "column for each time."
        )
    return times, columns


def required_outputs(what: str, outputs: Any, taken: Any) -> dict[str, Any]:
    """Return `outputs` as a dictionary; raise an error if a key is not a string, or is `taken` by a component."""
    if outputs is None:
        return {}
    if not isinstance(outputs, Mapping):
        raise TypeError(f"{what}: outputs must be a mapping of names to quantities, got {shown(outputs)}.")
    for name in outputs:
        if not isinstance(name, str):
            raise TypeError(f"{what}: names of outputs must be strings, got {shown(name)}.")
        if name in taken:
            raise ValueError(f"{what}: the output {name!r} has the name of a component of the state; rename it.")
    return dict(outputs)


class Given(NamedTuple):
    """The functions of a mechanism, see `mechanism`; None for those that the user did not give."""

    mass: Any
    forces: Any
    constraints: Any
    velocity_constraints: Any
    kinematics: Any
    jacobian: Any
    gamma: Any
    energy: Any
    potential: Any
    power: Any
    outputs: Any = None  # a mapping


def on_copies(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Return `fun` with copies of its arguments and of its value, if these are arrays.

    A function of the user may then change its arguments, which are parts of the state, and may return the same array
    at each call.
    """
    own = own_values(fun)
    return lambda *args: own(*(item.copy() if isinstance(item, np.ndarray) else item for item in args))


class Energy(NamedTuple):
    """Description of a quantity that may be constant, ``value(t, y, *params)``, and ``gradient(t, y, out, *params)``.

    `power` is the given rate of change, ``power(t, y, *params)``, or None.
    """

    description: str
    value: Callable[..., float]
    gradient: Callable[..., None]
    power: Callable[..., float] | None = None


class Parts(NamedTuple):
    """The functions of which a problem is made.

    ``fill`` is the argument of `motion`. ``values(t, y, out, *params)`` fills `out` with the constraints on positions
    and then those on velocities, m in total, and ``gradient`` with their derivatives (m, n). `energies` and `momenta`
    may be constant, and `note` is a line for the repr.
    """

    fill: Callable[..., None]
    values: Callable[..., None]
    gradient: Callable[..., None]
    energies: tuple[Energy, ...]
    note: str = ""
    momenta: tuple[Energy, ...] = ()
    outputs: Outputs | None = None
    origin: Any = None  # arguments of `parts_of` in symbolic/constrained.py, if that made the functions

    def matrices(self, names: Names, t: float, y: np.ndarray, args: tuple[Any, ...] = ()) -> list[np.ndarray]:
        """Return M, F, G, gamma and q' at a state, computed by functions that are not compiled."""
        n, m = len(names.speeds), len(names.velocities)
        out = np.empty(names.sizes.matrices + len(names.coordinates))
        plain(self.fill)(t, y, out, *args)
        M, F, G, gamma, rates = np.split(out, np.cumsum([n * n, n, m * n, m]))
        return [M.reshape(n, n), F, G.reshape(m, n), gamma, rates]


Array = np.ndarray


def numerical_parts(
    given: Given, names: Names, t: float, q: Array, u: Array, why: str, *, interval: float = np.inf
) -> Parts:
    """Return the `Parts` of a mechanism, with numerical derivatives where the user gave none; `why` is for the repr.

    `interval` is the length of the interval of the problem, infinite if it is not known.
    """
    found = _Numerical(given, names, t, q, u, interval)
    nq, energies = q.size, []
    energy, potential, power = given.energy, given.potential, given.power
    if energy is None and potential is not None:
        energy = lambda t, q, u: 0.5 * (u @ given.mass(q) @ u) + potential(t, q)  # noqa: E731
    if energy is not None:
        y = np.concatenate([q, u])
        fun = lambda t, y: energy(t, y[:nq], y[nq:])  # noqa: E731
        slopes = NumericalGradient(fun, (), True, t, y, _sizes(y), ())

        def energy_gradient(t: float, y: Array, out: Array) -> None:
            out[:] = slopes(t, y)

        rate = None if power is None else (lambda t, y: float(power(t, y[:nq], y[nq:])))
        energies.append(Energy("energy" if given.energy else "u M u / 2 + potential", fun, energy_gradient, rate))
    return Parts(
        found.fill,
        found.values,
        found.gradient,
        tuple(energies),
        f"functions are not converted to expressions, and derivatives that are not given are numerical: {why}",
        outputs=outputs_as_given(given, nq, u.size),
    )


def outputs_as_given(given: Given, nq: int, n: int) -> Outputs | None:
    """Return `Outputs` that call the user's functions in ``given.outputs``; None if there are no such functions."""
    functions = tuple(given.outputs.values())

    def fill(t: float, x: Array, out: Array) -> None:
        out[:] = [function(t, x[:nq], x[nq : nq + n]) for function in functions]

    return Outputs(tuple(given.outputs), fill) if functions else None


def _sizes(y: Array) -> Array:
    """Return ``|y_k|``, or the largest ``|y_j|`` where y_k is 0: the units of steps for differences."""
    return np.where(y != 0, np.abs(y), np.abs(y).max(initial=0.0) or 1.0)


class _Numerical:
    """Matrices and constraints of a mechanism, and their derivatives, from the user's functions."""

    def __init__(self, given: Given, names: Names, t: float, q: Array, u: Array, interval: float) -> None:
        self.given, self._nq = given, q.size
        self._positions, self._rows = len(names.positions), len(names.velocities)
        # The function of (q, t) gives the derivatives by q and by t together.
        constraints, joint = given.constraints, np.append(q, t)
        self._slopes = None
        if constraints is not None:
            self._slopes = NumericalGradient(
                lambda _, x: np.asarray(constraints(x[-1], x[:-1])), (), True, 0.0, joint, _sizes(joint), ()
            )
        # Constraints may depend on time. Differences over more time than this would be wrong while little moves.
        is_known = 0 < interval < np.inf
        self._longest = interval if is_known else max(1.0, self._duration(q, self.rates(t, q, u)))

    def fill(self, t: float, y: Array, out: Array) -> None:
        """Fill `out` with M, F, G, gamma and q'."""
        q, u = y[: self._nq], y[self._nq :]
        F = self.given.forces(t, q, u)
        parts = (self.given.mass(q), F, self.speed_gradient(t, q, u), self.gamma(t, q, u), self.rates(t, q, u))
        out[:] = np.concatenate([np.ravel(part) for part in parts])

    def values(self, t: float, y: Array, out: Array) -> None:
        """Fill `out` with the values of the constraints on positions, and then of those on velocities."""
        q, u = y[: self._nq], y[self._nq :]
        m = self._positions
        if m > 0:
            out[:m] = self.given.constraints(t, q)
        out[m:] = self.velocities(t, q, u)

    def gradient(self, t: float, y: Array, out: Array) -> None:
        """Fill `out` with the derivatives of all constraints (rows) with respect to the state (q, u)."""
        q, u, m, nq = y[: self._nq], y[self._nq :], self._positions, self._nq
        out[:] = 0.0
        out[:m, :nq] = self.jacobian(t, q)[0]
        if self._rows > 0:
            out[m:, :nq] = difference_gradient(lambda x: self.velocities(t, x, u), q, _sizes(q))
            out[m:, nq:] = self.speed_gradient(t, q, u)

    def rates(self, t: float, q: Array, u: Array) -> Array:
        """Return q', the derivatives of the coordinates."""
        return u if self.given.kinematics is None else np.asarray(self.given.kinematics(t, q, u))

    def jacobian(self, t: float, q: Array) -> tuple[Array, Array]:
        """Return the derivatives of the constraints on positions with respect to q, (m, nq), and to t, (m,)."""
        if self._slopes is None:
            return np.zeros((0, q.size)), np.zeros(0)
        slopes = self._slopes(0.0, np.append(q, t))
        own = slopes[:, :-1] if self.given.jacobian is None else np.asarray(self.given.jacobian(t, q), float)
        return own, slopes[:, -1]

    def velocities(self, t: float, q: Array, u: Array) -> Array:
        """Return the values of the constraints on velocities: first the time derivatives of those on positions."""
        J, explicit = self.jacobian(t, q)
        others = self.given.velocity_constraints
        own = [] if others is None else [np.asarray(others(t, q, u), float)]
        return np.concatenate([J @ self.rates(t, q, u) + explicit, *own])

    def speed_gradient(self, t: float, q: Array, u: Array) -> Array:
        """Return G, the derivatives of the constraints on velocities with respect to the speeds."""
        n, others = u.size, self.given.velocity_constraints
        J, _ = self.jacobian(t, q)
        speeds = np.eye(n)

        def linear(fun: Callable[..., Any]) -> Array:
            zero = np.asarray(fun(t, q, np.zeros(n)), float)
            return np.stack([np.asarray(fun(t, q, unit), float) - zero for unit in speeds], axis=1)

        G = J if self.given.kinematics is None else J @ linear(self.given.kinematics)
        return G if others is None else np.concatenate([G, linear(others)])

    def gamma(self, t: float, q: Array, u: Array) -> Array:
        """Return gamma, the time derivatives of the constraints on velocities for u' = 0."""
        if self.given.gamma is not None:
            return np.asarray(self.given.gamma(t, q, u), float)
        if self._rows == 0:
            return np.zeros(0)
        rates = self.rates(t, q, u)
        duration = min(self._duration(q, rates), self._longest)
        return difference_gradient(
            lambda s: self.velocities(t + s[0], q + s[0] * rates, u), np.zeros(1), np.array([duration])
        )[:, 0]

    def _duration(self, q: Array, rates: Array) -> float:
        """Return the time in which coordinates change by their size; 1 if this is not finite, or if they are 0."""
        duration = time_of_motion(q, rates)
        return duration if np.isfinite(duration) else 1.0
