"""Functions of a problem from those of a mechanism, compiled if all of them are jitted, else called from Python.

First derivatives of the constraints on positions come from dual numbers in compiled code, and from complex steps or
differences in Python. Second derivatives are differences of order 6 of the first ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from ...core import derivatives as steps
from ...core.functions import NotCompilableError, compilable, is_jitted, jit_is_off, jitted, own_values
from ...engine.data import EPS
from .motion import complex_parts, put_complex
from .parts import Energy, Outputs, Parts
from .start import Names

__all__ = ["TAKES", "difference", "fill_changed", "of_state", "parts_of_functions"]

Array = np.ndarray
# The arguments of the functions of a mechanism: some of t, q and u.
TAKES = {
    "mass": "q", "forces": "tqu", "constraints": "tq", "velocity_constraints": "tqu", "kinematics": "tqu",
    "jacobian": "tq", "gamma": "tqu", "energy": "tqu", "potential_energy": "tq", "power": "tqu",
}  # fmt: skip
WEIGHTS, ROUNDING, BETTER = tuple(weight for _, weight in steps.DIFFERENCE_WEIGHTS), steps.ROUNDINGS * EPS, 10.0


def of_state(item: Any, takes: str, nq: int) -> Callable[[float, Array], Any]:
    """Return a user's array, or function of the arguments in `takes`, as ``f(t, y)`` of states with `nq` coordinates.

    The user's function may change its arguments, and return the same array at each call.
    """
    if not callable(item):
        kept = np.array(item)  # which the user does not change
        return lambda t, y: kept
    own = own_values(item)
    if takes == "q":
        return lambda t, y: own(y[:nq].copy())
    if takes == "tq":
        return lambda t, y: own(t, y[:nq].copy())
    return lambda t, y: own(t, y[:nq].copy(), y[nq:].copy())


def put(values, out):
    """Write `values`, a sequence of any type, to the array `out`."""
    for k in range(len(out)):
        out[k] = values[k]


def difference(function, t, y, dt, dy, longest, out):
    """Fill `out` with the derivative of ``function(t, y, out)`` along (dt, dy), by differences of order 6.

    `dy` has the directions of the first components; the others stay. The shifts are chosen as in `difference_gradient`,
    from 5e-3 times the way on which the components that move change by their size, which is at most `longest`.
    """
    size, moved, moving, least = 0.0, 0.0, 0.0, 0.0
    for k in range(dy.size):
        size, moving = max(size, abs(y[k])), max(moving, abs(dy[k]))
        if dy[k] != 0.0:
            moved = max(moved, abs(y[k]))
    way = (moved if moved > 0.0 else size if size > 0.0 else 1.0) / moving if moving > 0.0 else 1.0
    shift = 2.0 ** np.floor(np.log2(steps.FIRST_SHIFT * min(way, longest)) + 0.5)
    x, ends, sums, lower = y.copy(), np.empty((2, out.size)), out.copy(), out.copy()
    for attempt in range(steps.MOST_SHIFTS):
        largest, excess = 0.0, 0.0
        for i in range(out.size):
            sums[i] = lower[i] = 0.0
        for j in range(3):
            for side in range(2):
                s = (j + 1) * shift * (1 - 2 * side)
                for k in range(dy.size):
                    x[k] = y[k] + s * dy[k]
                function(t + s * dt, x, ends[side])
            for i in range(out.size):
                sums[i] += WEIGHTS[j] * (ends[0, i] - ends[1, i])
                lower[i] += steps.LOWER_WEIGHTS[j] * (ends[0, i] - ends[1, i])
                largest = max(largest, abs(ends[0, i]), abs(ends[1, i]))
        for i in range(out.size):
            share = abs(sums[i] - lower[i]) / (steps.DIFFER * abs(sums[i]) + ROUNDING * largest + steps.LEAST)
            excess = share if share > excess else excess if share <= excess else np.inf
        # Shorter shifts have larger rounding errors: one is used only if the orders agree much better.
        if attempt == 0 or BETTER * excess < least:
            least = excess
            for i in range(out.size):
                out[i] = sums[i] / shift
        if least <= 1.0:
            break
        shift *= steps.SHORTER


def fill_changed(fill, difference, lanes, parts_of, put):
    """Return ``fill(t, y, out)`` for numbers with derivatives in several directions; see `solve_changed`."""

    def filled(t, y, out):
        values, way, found, changes = np.empty(y.size), np.empty(y.size), np.empty(out.size), np.empty(out.size)
        for lane in range(lanes):
            parts_of(y, lane, values, way)
            if lane == 0:
                fill(t, values, found)
            difference(fill, t, values, 0.0, way, np.inf, changes)
            put(found, changes, lane, out)

    return filled


def parts_of_functions(
    given: Mapping[str, Any], outputs: Mapping[str, Any], names: Names, start: tuple[float, Array], longest: float
) -> Parts:
    """Return the `Parts` of a mechanism, compiled if all functions of the user are jitted.

    `given` has its arrays and functions, with the names in `TAKES`. `start` is a time and a state, and differences in
    time extend over at most `longest`.
    """
    plain = [name for name, item in given.items() if callable(item) and not is_jitted(item)]
    why = f"{plain[0]} is not jitted by Numba; decorate it with @numba.njit" if plain else ""
    if not why and (jit_is_off() or find_spec("numba") is None):
        why = "Numba is not installed, or disabled"
    made, note = None, "derivatives that are not given are numerical, and functions are called from Python: "
    if not why:
        try:
            made = _Maker(given, names, start, longest, compiles=True).parts()
        except NotCompilableError as error:
            why = str(error)
    if made is None:
        made = _Maker(given, names, start, longest, compiles=False).parts()._replace(note=note + why)
        made.fill.not_jitted = why  # type: ignore[attr-defined]
    functions = [of_state(item, "tqu", len(names.coordinates)) for item in outputs.values()]

    def observed(t, x, out):
        out[:] = [function(t, x[: len(names.state)]) for function in functions]

    origin = (parts_of_functions, (given, outputs, names, start, longest))
    return made._replace(outputs=Outputs(tuple(outputs), observed) if functions else None, origin=origin)


class _Maker:
    """Maker of the functions of a problem from the functions of a mechanism, compiled or not.

    The functions of the user are called as functions of (t, y), `of`.
    """

    def __init__(
        self, given: Mapping[str, Any], names: Names, start: tuple[float, Array], longest: float, *, compiles: bool
    ) -> None:
        self.given, self.start, self.longest, self.compiles = given, start, longest, compiles
        nq, _, _, _ = self.sizes = [len(item) for item in names]
        self.of: Any = {name: self.made(of_state(item, TAKES[name], nq)) for name, item in given.items()}
        self.kinematics = self.of.get("kinematics") or self.made(lambda t, y: y[nq:])
        self.missing = self.made(lambda t, y: y)  # stands for constraints that are missing; no value of it is used
        self.put, self.difference = self.made(put), self.made(difference)

    def made(self, function: Callable[..., Any]) -> Any:
        """Return a function compiled if those of the mechanism are."""
        return jitted(compilable(function)) if self.compiles else function

    def parts(self) -> Parts:
        """Return the functions of the problem."""
        rate, jacobian = self._first_derivatives()
        values, velocities = self._values(rate)
        slopes, gradient = self._slopes(jacobian, velocities)
        return Parts(self._fill(velocities, slopes), values, gradient, self._energies())

    def _gradient_of(self, function: Any, x: Array, shape: tuple[int, ...] = ()) -> Any:
        """Return ``grad(t, x, out)`` of a function whose value has this `shape`; `x` is its argument at the start."""
        if self.compiles:
            by_duals = steps.by_duals("gradient", function, x.size, shape, False)
            # Python may call this function, but not what `by_duals` is made of.
            return self.made(lambda t, x, out: by_duals(t, x, out))
        sizes = np.where(x != 0, np.abs(x), np.abs(x).max(initial=0.0) or 1.0)
        numerical = steps.NumericalGradient(function, (), True, self.start[0], x, sizes, ())
        return lambda t, x, out: put(numerical(t, x), out)

    def _first_derivatives(self) -> tuple[Any, Any]:
        """Return two functions of the constraints on positions.

        ``rate(t, y, dq, out)`` fills `out` (m,) with their rates of change for q' = dq, and ``jacobian(t, y, out)``
        fills `out` (m, nq) with their derivatives with respect to q.
        """
        given, constraints, (nq, _, m, _), put = *map(self.of.get, ("jacobian", "constraints")), self.sizes, self.put
        q = self.start[1][:nq]

        def as_given(t, y, out):
            found = given(t, y)
            for i in range(m):
                put(found[i], out[i])

        if m == 0:
            return self.made(lambda t, y, dq, out: None), self.made(lambda t, y, out: None)
        if self.compiles:
            along = steps.by_duals("rate", self.given["constraints"], nq, (m,), False)
            rate = self.made(lambda t, y, dq, out: put(along(t, y[:nq], dq), out))
            slopes: Any = None if given else self._gradient_of(self.given["constraints"], q, (m,))
            return rate, self.made(as_given if given else lambda t, y, out: slopes(t, y[:nq], out))
        slopes = self._gradient_of(lambda _, x: np.asarray(constraints(x[-1], x)), np.append(q, self.start[0]))

        def by_q_and_t(t, y):
            found = np.empty((m, nq + 1))
            slopes(0.0, np.append(y[:nq], t), found)
            return found

        rate = lambda t, y, dq, out: put(by_q_and_t(t, y) @ np.append(dq, 1.0), out)  # noqa: E731
        return rate, as_given if given else lambda t, y, out: put(by_q_and_t(t, y)[:, :nq], out)

    def _values(self, rate: Any) -> tuple[Any, Any]:
        """Return ``values(t, y, out)``, all constraints, and ``velocities(t, y, out)``, those on velocities.

        The latter are the rates of the constraints on positions, and then `velocity_constraints`.
        """
        positions, others = (self.of.get(name, self.missing) for name in ("constraints", "velocity_constraints"))
        kinematics, put, (nq, _, m, _) = self.kinematics, self.put, self.sizes

        def velocities(t, y, out):
            dq = np.empty(nq)
            put(kinematics(t, y), dq)
            rate(t, y, dq, out[:m])
            put(others(t, y), out[m:])

        velocities = self.made(velocities)

        def values(t, y, out):
            put(positions(t, y), out[:m])
            velocities(t, y, out[m:])

        return self.made(values), velocities

    def _slopes(self, jacobian: Any, velocities: Any) -> tuple[Any, Any]:
        """Return ``slopes(t, y, J, G)`` and ``gradient(t, y, out)``, derivatives of the constraints.

        `slopes` fills J (m, nq) with those of positions by the coordinates, and G (rows, n) with those of velocities by
        the speeds; `gradient` fills `out` with all derivatives by the state.
        """
        kinematics, others = self.kinematics, self.of.get("velocity_constraints", self.missing)
        (nq, n, m, rows), put, difference = self.sizes, self.put, self.difference

        def slopes(t, y, J, G):
            jacobian(t, y, J)
            x, rest, zero = y.copy(), np.empty(nq), np.empty(rows - m)
            x[nq:] = 0.0
            put(kinematics(t, x), rest)
            put(others(t, x), zero)
            G[:] = 0.0
            for j in range(n):
                x[nq + j] = 1.0
                rates, found = kinematics(t, x), others(t, x)
                for k in range(nq):
                    change = rates[k] - rest[k]
                    if change != 0.0:
                        for i in range(m):
                            G[i, j] += J[i, k] * change
                for i in range(m, rows):
                    G[i, j] = found[i - m] - zero[i - m]
                x[nq + j] = 0.0

        slopes = self.made(slopes)

        def gradient(t, y, out):
            J, G, column, unit = np.empty((m, nq)), np.empty((rows, n)), np.empty(rows), np.zeros(nq)
            slopes(t, y, J, G)
            out[:] = 0.0
            for i in range(m):
                put(J[i], out[i][:nq])
            for i in range(rows):
                put(G[i], out[m + i][nq:])
            for k in range(nq):
                unit[k] = 1.0
                difference(velocities, t, y, 0.0, unit, np.inf, column)
                unit[k] = 0.0
                put(column, out[m:, k])

        return slopes, self.made(gradient)

    def _fill(self, velocities: Any, slopes: Any) -> Any:
        """Return the argument ``fill(t, y, out)`` of `motion`."""
        mass, forces, given, kinematics = self.of["mass"], self.of["forces"], self.of.get("gamma"), self.kinematics
        put, difference, longest, (nq, n, m, rows) = self.put, self.difference, self.longest, self.sizes
        F, G = n * n, n * n + n
        gamma, rates = G + rows * n, G + rows * n + rows

        def along_motion(t, y, out):
            dq = np.empty(nq)
            put(kinematics(t, y), dq)
            difference(velocities, t, y, 1.0, dq, longest, out)

        gamma_of = self.made(along_motion if given is None else lambda t, y, out: put(given(t, y), out))

        def fill(t, y, out):
            M = mass(t, y)
            for i in range(n):
                put(M[i], out[i * n : i * n + n])
            put(forces(t, y), out[F:G])
            if rows:
                slopes(t, y, np.empty((m, nq)), out[G:gamma].reshape(rows, n))
                gamma_of(t, y, out[gamma:rates])
            put(kinematics(t, y), out[rates:])

        if not self.compiles:
            of_complex = fill_changed(fill, difference, 1, complex_parts, put_complex)
            return lambda t, y, out: (fill if y.dtype.kind == "f" else of_complex)(t, y, out)
        from .duals import fill_duals  # which loads Numba

        found = self.made(fill)
        fill.for_duals = partial(fill_duals, found)  # type: ignore[attr-defined]
        return found

    def _energies(self) -> tuple[Energy, ...]:
        """Return the energy, if it is known."""
        mass, potential, total, power = map(self.of.get, ("mass", "potential_energy", "energy", "power"))
        (nq, n, _, _), described = self.sizes, "energy" if total else "u M u / 2 + potential_energy"

        def with_potential(t, y):
            M, kinetic = mass(t, y), 0.0
            for i in range(n):
                for j in range(n):
                    kinetic += 0.5 * y[nq + i] * M[i][j] * y[nq + j]
            return kinetic + potential(t, y)

        if not (total or potential):
            return ()
        value = total or self.made(with_potential)
        return (Energy(described, value, self._gradient_of(value, self.start[1]), power),)
