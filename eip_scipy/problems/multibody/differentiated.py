"""Functions of a problem from those of a mechanism, compiled if all of them are jitted, else called from Python.

First derivatives of the constraints on positions come from dual numbers in compiled code, and from complex steps or
differences in Python. Second derivatives are differences of order 6 of the first ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from ...core.derivatives import (
    DIFFER,
    DIFFERENCE_WEIGHTS,
    FIRST_SHIFT,
    LEAST,
    LOWER_WEIGHTS,
    MOST_SHIFTS,
    ROUNDINGS,
    SHORTER,
    NumericalGradient,
    time_of_motion,
)
from ...core.derivatives import by_duals as with_duals
from ...core.functions import NotCompilableError, compilable, is_jitted, jit_is_off, jitted
from ...engine.data import EPS
from .motion import new_floats, new_like
from .parts import Energy, Given, Outputs, Parts, on_copies
from .start import Names

__all__ = ["parts_of_functions"]

Array = np.ndarray
ENERGY = ("mass", "energy", "potential_energy", "power")  # functions of which the energy is made
WEIGHTS = tuple(weight for _, weight in DIFFERENCE_WEIGHTS)


def parts_of_functions(
    given: Given, names: Names, t: float, q: Array, u: Array, interval: float, compiles: bool = True
) -> Parts:
    """Return the `Parts` of a mechanism that starts at t, q, u; `interval` is its duration, infinite if not known.

    The functions are compiled if `compiles`, and all functions of the user are jitted.
    """
    why = _not_compiled(given) if compiles else ""
    if why is None:
        try:
            return _Maker(given, names, t, q, u, interval, compiles=True).parts()
        except NotCompilableError as error:
            why = str(error)
    note = f"derivatives that are not given are numerical, and functions are called from Python: {why}"
    return _Maker(given, names, t, q, u, interval, compiles=False).parts()._replace(note=note)


def _not_compiled(given: Given) -> str | None:
    """Return why the functions of a mechanism cannot be compiled; None if they can."""
    functions = {name: item for name, item in given._asdict().items() if name != "outputs" and callable(item)}
    plain = [name for name, item in functions.items() if not is_jitted(item)]
    if plain:
        return f"{plain[0]} is not jitted by Numba"
    return "Numba is not installed, or disabled" if jit_is_off() or find_spec("numba") is None else None


class _Maker:
    """Maker of the functions of a problem from the functions of a mechanism, compiled or not."""

    def __init__(
        self, given: Given, names: Names, t: float, q: Array, u: Array, interval: float, *, compiles: bool
    ) -> None:
        self.origin = (parts_of_functions, (given, names, t, q, u, interval))
        self.compiles, self.start = compiles, (t, q, u)
        self.new: Any = jitted(compilable(new_floats)) if compiles else new_like
        self.given = given.compiled() if compiles else given.called()
        self.nq, self.n, self.m = q.size, u.size, len(names.positions)
        self.rows = len(names.velocities)
        # Constraints may depend on time. Differences over more time than this would be wrong while little moves.
        self.longest = interval if 0 < interval < np.inf else np.inf

    def _made(self, function: Callable[..., Any]) -> Any:
        return jitted(compilable(function)) if self.compiles else function

    def parts(self) -> Parts:
        """Return the functions of the problem."""
        rates, along, jacobian = self._rates(), *self._first_derivatives()
        velocities = self._velocities(rates, along)
        difference = self._difference(velocities)
        speeds = self._speed_gradient(rates, jacobian)
        if self.longest == np.inf:
            q = self.start[1]
            dq = np.empty(q.size)
            rates(*self.start, dq)
            duration = time_of_motion(q, dq)
            self.longest = max(1.0, duration if np.isfinite(duration) else 1.0)
        return Parts(
            self._fill(rates, speeds, self._gamma(rates, difference)),
            self._values(velocities),
            self._gradient(jacobian, speeds, difference),
            self._energies(),
            outputs=self._outputs(),
            origin=self.origin,
        )

    def _rates(self) -> Any:
        """Return ``rates(t, q, u, out)``, which fills `out` with q'."""
        kinematics = self.given.kinematics

        def as_speeds(t, q, u, out):
            for k in range(u.size):
                out[k] = u[k]

        def as_given(t, q, u, out):
            found = kinematics(t, q.copy(), u.copy())
            for k in range(out.size):
                out[k] = found[k]

        return self._made(as_speeds if kinematics is None else as_given)

    def _first_derivatives(self) -> tuple[Any, Any]:
        """Return two functions of the constraints on positions.

        ``along(t, q, dq, out)`` fills the first entries of `out` with their rates of change for q' = dq, and
        ``jacobian(t, q, out)`` fills `out` (m, nq) with their derivatives with respect to q.
        """
        constraints, given, nq, m = self.given.constraints, self.given.jacobian, self.nq, self.m
        if constraints is None:
            return self._made(lambda t, q, dq, out: None), self._made(lambda t, q, out: None)

        def as_given(t, q, out):
            found = given(t, q.copy())
            for i in range(m):
                for k in range(nq):
                    out[i, k] = found[i][k]

        if self.compiles:
            rate = with_duals("rate", constraints, nq, (m,), False)

            def along_by_duals(t, q, dq, out):
                found = rate(t, q, dq)
                for i in range(m):
                    out[i] = found[i]

            by_duals = with_duals("gradient", constraints, nq, (m,), False) if given is None else self._made(as_given)
            return self._made(along_by_duals), by_duals

        slopes = self._numerical_slopes()

        def along(t, q, dq, out):
            found = slopes(t, q)
            out[:m] = found[:, :-1] @ dq + found[:, -1]

        def jacobian(t, q, out):
            out[:] = slopes(t, q)[:, :-1]

        return along, jacobian if given is None else as_given

    def _numerical_slopes(self) -> Callable[[float, Array], Array]:
        """Return ``slopes(t, q)``, the numerical derivatives (m, nq + 1) of the constraints by q and t."""
        constraints: Any = self.given.constraints
        t, q, _ = self.start
        first = np.append(q, t)
        sizes = np.where(first != 0, np.abs(first), np.abs(first).max(initial=0.0) or 1.0)
        by_steps = NumericalGradient(
            lambda _, x: np.asarray(constraints(x[-1], x[:-1])), (), True, 0.0, first, sizes, ()
        )

        def value(t, x, _, out):
            out[:] = constraints(x[-1], x[:-1])

        difference = self._difference(value)

        def slopes(t, q):
            x = np.append(q, t)
            if x.dtype.kind == "f":
                return by_steps(0.0, x)
            found = np.empty((self.m, x.size), x.dtype)  # for complex steps of the whole motion
            for k, size in enumerate(sizes):
                column = np.empty(self.m, x.dtype)
                difference(0.0, x, x, 0.0, (np.arange(x.size) == k) * size, 1.0, column)
                found[:, k] = column / size
            return found

        return slopes

    def _velocities(self, rates: Any, along: Any) -> Any:
        """Return ``velocities(t, q, u, out)``: rates of the constraints on positions, then the other constraints."""
        others, new, m = self.given.velocity_constraints, self.new, self.m

        def of_positions(t, q, u, out):
            dq = new(q.size, q)
            rates(t, q, u, dq)
            along(t, q, dq, out)

        of_positions = self._made(of_positions)

        def velocities(t, q, u, out):
            of_positions(t, q, u, out)
            found = others(t, q.copy(), u.copy())
            for k in range(m, out.size):
                out[k] = found[k - m]

        return of_positions if others is None else self._made(velocities)

    def _difference(self, function: Any) -> Any:
        """Return the derivative of ``function(t, x, u, out)`` along a direction, by differences of order 6.

        ``difference(t, x, u, dt, dx, unit, out)`` fills `out` with the derivative along (dt, dx). The shifts, which
        begin at 5e-3 times `unit`, are chosen as in `difference_gradient`.
        """
        return self._made(_difference_of(function, self.new))

    def _speed_gradient(self, rates: Any, jacobian: Any) -> Any:
        """Return ``speeds(t, q, out)``, which fills `out` (rows, n) with the constraints' derivatives by the speeds."""
        others, new, nq, n, m, rows = self.given.velocity_constraints, self.new, self.nq, self.n, self.m, self.rows
        as_speeds = self.given.kinematics is None

        def of_positions(t, q, out):
            J = new(m * nq, q).reshape(m, nq)
            jacobian(t, q, J)
            unit, rest, found = new(n, q), new(nq, q), new(nq, q)
            unit[:] = 0.0
            rates(t, q, unit, rest)
            for j in range(n):
                if as_speeds:
                    for i in range(m):
                        out[i, j] = J[i, j]
                    continue
                unit[j] = 1.0
                rates(t, q, unit, found)
                unit[j] = 0.0
                for i in range(m):
                    out[i, j] = 0.0
                    for k in range(nq):
                        out[i, j] += J[i, k] * (found[k] - rest[k])

        of_positions = self._made(of_positions)

        def speeds(t, q, out):
            of_positions(t, q, out)
            unit, rest = new(n, q), new(rows - m, q)
            unit[:] = 0.0
            zero = others(t, q.copy(), unit.copy())
            for i in range(m, rows):
                rest[i - m] = zero[i - m]
            for j in range(n):
                unit[j] = 1.0
                found = others(t, q.copy(), unit.copy())
                unit[j] = 0.0
                for i in range(m, rows):
                    out[i, j] = found[i - m] - rest[i - m]

        return of_positions if others is None else self._made(speeds)

    def _gamma(self, rates: Any, difference: Any) -> Any:
        """Return ``gamma(t, q, u, out)``, which fills `out` with the rates of the velocity constraints for u' = 0."""
        given, new, longest = self.given.gamma, self.new, self.longest
        if self.rows == 0:
            return self._made(lambda t, q, u, out: None)

        def as_given(t, q, u, out):
            found = given(t, q.copy(), u.copy())
            for k in range(out.size):
                out[k] = found[k]

        def along_motion(t, q, u, out):
            dq = new(q.size, q)
            rates(t, q, u, dq)
            size, moving = 0.0, 0.0
            for k in range(q.size):
                size, moving = max(size, abs(q[k])), max(moving, abs(dq[k]))
            duration = size / moving if moving > 0.0 and size > 0.0 else 1.0
            difference(t, q, u, 1.0, dq, min(duration, longest), out)

        return self._made(along_motion if given is None else as_given)

    def _fill(self, rates: Any, speeds: Any, gamma: Any) -> Any:
        """Return the argument ``fill(t, y, out)`` of `motion`."""
        mass, forces, nq, n, rows = self.given.mass, self.given.forces, self.nq, self.n, self.rows

        def fill(t, y, out):
            q, u = y[:nq].copy(), y[nq:].copy()
            M = mass(q.copy())
            for i in range(n):
                for j in range(n):
                    out[i * n + j] = M[i][j]
            F, end = forces(t, q.copy(), u.copy()), n * n
            for i in range(n):
                out[end + i] = F[i]
            end += n
            speeds(t, q, out[end : end + rows * n].reshape(rows, n))
            end += rows * n
            gamma(t, q, u, out[end : end + rows])
            rates(t, q, u, out[end + rows :])

        fast = self._made(fill)
        if self.compiles:
            difference = self._difference(self._made(lambda t, y, _, out: fast(t, y, out)))
            fill.for_duals = partial(_for_duals, fast, difference)  # type: ignore[attr-defined]
        return fast

    def _values(self, velocities: Any) -> Any:
        constraints, nq, m = self.given.constraints, self.nq, self.m

        def of_velocities(t, y, out):
            velocities(t, y[:nq].copy(), y[nq:].copy(), out[m:])

        of_velocities = self._made(of_velocities)

        def values(t, y, out):
            found = constraints(t, y[:nq].copy())
            for i in range(m):
                out[i] = found[i]
            of_velocities(t, y, out)

        return of_velocities if constraints is None else self._made(values)

    def _gradient(self, jacobian: Any, speeds: Any, difference: Any) -> Any:
        """Return ``gradient(t, y, out)``, the derivatives of all constraints with respect to the state."""
        new, nq, n, m, rows = self.new, self.nq, self.n, self.m, self.rows

        def gradient(t, y, out):
            q, u = y[:nq].copy(), y[nq:].copy()
            out[:] = 0.0
            J, G = new(m * nq, q).reshape(m, nq), new(rows * n, q).reshape(rows, n)
            jacobian(t, q, J)
            speeds(t, q, G)
            largest = 0.0
            for k in range(nq):
                largest = max(largest, abs(q[k]))
            unit, column = new(nq, q), new(rows, q)
            unit[:] = 0.0
            for k in range(nq):
                for i in range(m):
                    out[i, k] = J[i, k]
                unit[k] = 1.0
                size = abs(q[k]) if q[k] != 0.0 else largest
                difference(t, q, u, 0.0, unit, size if size > 0.0 else 1.0, column)
                unit[k] = 0.0
                for i in range(rows):
                    out[m + i, k] = column[i]
            for i in range(rows):
                for k in range(n):
                    out[m + i, nq + k] = G[i, k]

        return self._made(gradient)

    def _energies(self) -> tuple[Energy, ...]:
        mass, energy, potential, power = (getattr(self.given, name) for name in ENERGY)
        nq, n = self.nq, self.n
        if energy is None and potential is None:
            return ()

        def with_potential(t, y):
            u, M, total = y[nq:], mass(y[:nq].copy()), 0.0
            for i in range(n):
                for j in range(n):
                    total += 0.5 * u[i] * M[i][j] * u[j]
            return total + potential(t, y[:nq].copy())

        def as_given(t, y):
            return energy(t, y[:nq].copy(), y[nq:].copy())

        value = self._made(with_potential if energy is None else as_given)
        rate = None if power is None else self._made(lambda t, y: power(t, y[:nq].copy(), y[nq:].copy()))
        described = "u M u / 2 + potential_energy" if energy is None else "energy"
        if self.compiles:
            by_duals = with_duals("gradient", value, nq + n, (), False)

            def gradient(t, y, out):  # Python may call this function, but not what `by_duals` is made of
                by_duals(t, y, out)

        else:
            t, q, u = self.start
            y = np.append(q, u)
            sizes = np.where(y != 0, np.abs(y), np.abs(y).max(initial=0.0) or 1.0)
            slopes = NumericalGradient(value, (), True, t, y, sizes, ())

            def gradient(t, y, out):
                out[:] = slopes(t, y)

        return (Energy(described, value, self._made(gradient), rate),)

    def _outputs(self) -> Outputs | None:
        """Return `Outputs` that call the user's functions."""
        functions = [on_copies(item) for item in self.given.outputs.values()]
        nq, n = self.nq, self.n

        def fill(t, x, out):
            out[:] = [function(t, x[:nq], x[nq : nq + n]) for function in functions]

        return Outputs(tuple(self.given.outputs), fill) if functions else None


def _for_duals(fill: Any, difference: Any, dual: Any) -> Callable[..., None]:
    """Return `fill` for arrays of numbers of the type `dual`, for compiled code."""
    from .duals import by_differences  # which loads Numba

    return by_differences(fill, difference, dual)


def _difference_of(function: Any, new: Any) -> Callable[..., None]:
    """Return the function that `_Maker._difference` describes, which is not compiled yet."""

    def difference(t, x, u, dt, dx, unit, out):
        shift, least = 2.0 ** np.floor(np.log2(FIRST_SHIFT * unit) + 0.5), np.inf
        above, below, sums, lower = new(out.size, out), new(out.size, out), new(out.size, out), new(out.size, out)
        largest = np.empty(out.size)
        for i in range(out.size):
            out[i] = np.nan
        for _ in range(MOST_SHIFTS):
            excess = 0.0
            for i in range(out.size):
                sums[i] = lower[i] = largest[i] = 0.0
            for j in range(3):
                s = (j + 1) * shift
                function(t + s * dt, x + s * dx, u, above)
                function(t - s * dt, x - s * dx, u, below)
                for i in range(out.size):
                    sums[i] += WEIGHTS[j] * (above[i] - below[i])
                    lower[i] += LOWER_WEIGHTS[j] * (above[i] - below[i])
                    largest[i] = max(largest[i], abs(above[i]), abs(below[i]))
            for i in range(out.size):
                share = abs(sums[i] - lower[i]) / (DIFFER * abs(sums[i]) + ROUNDINGS * EPS * largest[i] + LEAST)
                excess = share if share > excess else excess if share <= excess else np.inf
            if excess < least:
                least = excess
                for i in range(out.size):
                    out[i] = sums[i] / shift
            if least <= 1.0:
                break
            shift *= SHORTER

    return difference
