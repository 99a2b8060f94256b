"""Test whether a quantity is conserved: its rate along the equations, {I, H} for Hamilton's equations.

Algebra shows it if that is quick. Otherwise the rate is computed with 50 digits at states of moderate size, and on both
sides of each place at which functions such as abs and max change their branches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache, partial
from itertools import combinations, islice
from typing import Any

import numpy as np
import sympy

from .parser import symbol
from .program import Arguments, precise

__all__ = [
    "BRANCHES", "Equations", "NotConservedError", "derivative", "drop_dirac_deltas", "sampled_values", "shortened",
    "vanishes",
]  # fmt: skip

POINTS, TRIES = 8, 200
ROUND_OFF = 1e-30  # bound for the rounding of a rate that is 0, relative to its terms
# Algebra of expressions with more operations, or of powers of sums with more terms, may take minutes.
EXPANDED_OPERATIONS, SIMPLIFIED_OPERATIONS, EXPANDED_TERMS = 1200, 120, 2000
# Functions with branches. A change of sign is searched on this number of lines, at these places, and then bisected.
BRANCHES = (sympy.Max, sympy.Min, sympy.Abs, sympy.sign, sympy.Heaviside)
LINES, BISECTIONS = 4, 40
PLACES = [0.0, *(side * 2.0**power for power in range(-40, 101, 4) for side in (-1, 1))]
# Constraints are met, and rates at such states are 0, within these shares of their terms. Singular values of gradients
# below the share DEPENDENT of the largest one are 0.
NEWTON_STEPS, MET, CONSTANT, DEPENDENT = 30, 1e-12, 1e-9, 1e-9

Point = np.ndarray  # the components of the state, and the time


class NotConservedError(ValueError):
    """Error for a quantity that is not an invariant."""


def sampled_states(n: int) -> Iterator[Point]:
    """Yield random states of n components, and times, between 0.3 and 1.7 in size; half of them are positive."""
    rng = np.random.default_rng(20220)
    for k in range(TRIES):
        signs = rng.choice([-1.0, 1.0], n + 1) if k < TRIES // 2 else 1.0
        yield signs * rng.uniform(0.3, 1.7, n + 1)


class Equations:
    """Equations y' = `rates` of the `components`, with the `values` of the parameters by name.

    `constraints` are expressions by name that are 0 at the states of interest.
    """

    def __init__(self, components: Any, rates: Any, values: Mapping[str, float], constraints: Any = None) -> None:
        self.components, self.rates, self.values = tuple(components), tuple(rates), values
        self.constraints, self._variables = constraints or {}, [symbol(name) for name in (*components, "t")]
        arguments = Arguments(self.components, tuple(values))
        self._precise = partial(precise, arguments=arguments, params=list(values.values()))

    def check_conserved(self, name: str, quantity: Any) -> str:
        """Return how a quantity was shown to be conserved, such as "symbolically" or "numerically, at 8 points".

        NotConservedError, which names a point and the rate there, is raised if the quantity is not conserved, at all
        states or else at those that meet the constraints. ValueError is raised if the rate is not finite at any point,
        or cannot be examined in all branches of functions such as max.
        """
        changes = zip(self._variables, (*self.rates, sympy.Integer(1)), strict=True)
        terms = [sympy.diff(quantity, x) * change for x, change in changes]
        # The points are not at jumps, which are refused when the gradient is compiled.
        terms = [x for term in terms if (x := term.replace(sympy.DiracDelta, lambda *_: sympy.Integer(0))) != 0]
        rate = sympy.Add(*terms)
        if _expands_to_zero(rate):
            return "symbolically"
        evaluated = self._precise(f"rate of {name}", terms)

        def count(points: Iterable[Point], most: int | None, bound: float = ROUND_OFF) -> int:
            """Return the number of points, up to `most`, at which the rate is finite; raise an error if it is not 0."""
            finite = ((x, values) for x in points if (values := evaluated(x)) is not None)
            found = list(islice(finite, most))
            for x, values in found:
                total, size = sum(values), sum(map(abs, values))
                if abs(total) > bound * size:
                    raise self._not_conserved(name, rate, x, f"{float(total):.3g}", f"{float(size):.3g}")
            return len(found)

        try:
            number = count(sampled_states(len(self.components)), POINTS)
            if _is_short(rate, SIMPLIFIED_OPERATIONS) and sympy.simplify(sympy.expand(rate)) == 0:
                return "symbolically"
            number += count(self._beside_switches(name, [quantity, *self.rates, *terms]), None)
            where = " with the parameters given" if self.values else ""
        except NotConservedError:
            if not self.constraints:
                raise
            number, where = count(self._constrained_points, None, CONSTANT), " that meet the constraints"
        if number == 0:
            raise ValueError(
                f"{name!r}: its rate {shortened(rate)} is not finite and real at any point that was tried. The "
                "variables were between 0.3 and 1.7 in size; choose units in which the rate exists there, or omit this "
                "quantity."
            )
        return f"numerically, at {number} points{where}"

    def _not_conserved(self, name: str, rate: Any, point: Point, total: str, size: str) -> NotConservedError:
        where, hint = "", ""
        if self.constraints:
            where = f", even where the constraints {', '.join(map(repr, self.constraints))} hold"
            hint = " If the rate is 0 at your states, because of a constraint on velocities, add that to constraints."
        place = ", ".join(f"{x}={value:.3g}" for x, value in zip(self._variables, point, strict=True))
        return NotConservedError(
            f"{name!r} is not an invariant of these equations{where}: its rate is {shortened(rate)}. At {place} the "
            f"rate is {total}, and the absolute values of its terms sum to {size}.{hint}"
        )

    def _beside_switches(self, name: str, expressions: Sequence[Any]) -> Iterator[Point]:
        """Yield points on both sides of each place at which a max, min, abs or the like changes its branch."""
        differences: dict[Any, Any] = {}  # those whose signs choose branches, and the functions
        for atom in sorted({atom for item in expressions for atom in item.atoms(*BRANCHES)}, key=str):
            several = isinstance(atom, (sympy.Max, sympy.Min))
            found = [a - b for a, b in combinations(atom.args, 2)] if several else [atom.args[0]]
            differences |= dict.fromkeys(found, atom)
        for difference, atom in differences.items():
            places = [k for k, x in enumerate(self._variables) if x in difference.free_symbols]
            at = self._precise("difference", [difference])
            lines = islice(sampled_states(len(self.components)), LINES if places else 0)
            sides = [side for point in lines for side in _sides(at, point, places)]
            if places and not (sides or difference.is_nonnegative or difference.is_nonpositive):
                raise ValueError(
                    f"invariant {name!r}: no point was found where {shortened(atom)} changes its branch, so that it "
                    "cannot be checked in all branches. Give each branch as a problem of its own, or omit this "
                    "invariant."
                )
            yield from sides

    @cached_property
    def _constrained_points(self) -> list[Point]:
        """Return states that meet the constraints; Newton's method finds them from random states."""
        items, states = list(self.constraints.values()), self._variables[:-1]
        both = self._precise("constraints", [*items, *(sympy.diff(item, x) for item in items for x in states)])
        projected = (_projected(both, len(items), point) for point in sampled_states(len(states)))
        found = list(islice((point for point in projected if point is not None), POINTS))
        if not found:
            raise ValueError(
                f"constraints: no state was found that meets {', '.join(map(repr, self.constraints))}. Constraints are "
                "expressions that are 0; a length l is the constraint x**2 + y**2 - l**2."
            )
        return found


def _projected(constraints: Callable[[Point], list[Any] | None], m: int, point: Point) -> Point | None:
    """Return a point that meets m constraints, found by Newton's method, or None if it does not converge.

    The function returns their values and then their gradients.
    """
    point = point.copy()
    for _ in range(NEWTON_STEPS):
        found = constraints(point)
        if found is None or not np.isfinite(values := np.array(found, float)).all():
            return None
        values, slopes = values[:m], values[m:].reshape(m, -1)
        if (np.abs(values) <= MET * (np.abs(slopes) @ np.abs(point[:-1]))).all():
            return point
        point[:-1] -= np.linalg.lstsq(slopes, values, DEPENDENT)[0]
    return None


def _sides(difference: Callable[[Point], list[Any] | None], point: Point, places: Sequence[int]) -> list[Point]:
    """Return two points on a line through `point` along an axis at which a difference has opposite signs, or []."""

    def moved(x: float) -> Point:
        return np.where(np.arange(point.size) == k, x, point)

    for k in places:
        ends: dict[bool, float] = {}  # the places of a negative and a positive value
        for x in sorted([point[k], *PLACES], key=abs):
            (value,) = difference(moved(x)) or [0]
            if value != 0:
                ends.setdefault(value > 0, x)
            if len(ends) == 2:
                break
        else:
            continue
        for _ in range(BISECTIONS):
            middle = sum(ends.values()) / 2
            (value,) = difference(moved(middle)) or [0]
            if value == 0:
                break
            ends[value > 0] = middle
        return [moved(x) for x in ends.values()]
    return []


def sampled_values(expressions: Sequence[Any], arguments: Arguments, params: Sequence[float] = ()) -> list[list[Any]]:
    """Return the values of expressions, with 50 digits, at random states at which all of them are finite."""
    values = map(precise("values", expressions, arguments, params), sampled_states(len(arguments.y)))
    return list(islice((found for found in values if found is not None), POINTS))


def vanishes(expression: Any) -> bool:
    """Return True if an expression is 0, by algebra if that is quick, otherwise at random points."""
    if _expands_to_zero(expression):
        return True
    names = sorted({item.name for item in expression.free_symbols} - {"t"})
    found = sampled_values([expression], Arguments(tuple(names)))
    return bool(found) and all(abs(value) <= ROUND_OFF for (value,) in found)


def _is_short(expression: Any, operations: int) -> bool:
    """Return True if algebra of an expression takes at most seconds."""
    powers = ((len(x.base.args), abs(x.exp)) for x in expression.atoms(sympy.Pow) if x.base.is_Add and x.exp.is_Integer)
    terms = max((math.comb(n + int(power) - 1, n - 1) for n, power in powers), default=1)
    return terms <= EXPANDED_TERMS and expression.count_ops() <= operations


def _expands_to_zero(expression: Any) -> bool:
    return _is_short(expression, EXPANDED_OPERATIONS) and sympy.expand(expression) == 0


def shortened(expression: Any, length: int = 100) -> str:
    """Return an expression as text, of which at most `length` characters are kept."""
    text = str(expression)
    return text if len(text) <= length else f"{text[:length]}..."


@lru_cache(maxsize=4096)
def derivative(expression: Any, variable: Any) -> Any:
    """Return the derivative of an expression, without impulses at places where the expression does not jump."""
    return drop_dirac_deltas(sympy.diff(expression, variable))


def drop_dirac_deltas(found: Any) -> Any:
    """Return a derivative without impulses whose factor is 0 where they occur.

    SymPy's derivative of q**2 sign(q) contains q**2 DiracDelta(q), which is 0. An impulse that remains belongs to a
    jump, or to a function of several branches at one place that was not understood.
    """
    for impulse in sorted(found.atoms(sympy.DiracDelta), key=str):
        stands_for = sympy.Dummy()
        factor = sympy.diff(found.xreplace({impulse: stands_for}), stands_for)
        # The value of sign(q) at 0 says nothing about an impulse there: sign(q)**3 jumps.
        unknown = factor.atoms(sympy.sign, sympy.Heaviside, sympy.DiracDelta)
        known = factor.xreplace({item: sympy.Dummy(real=True) for item in unknown})
        if len(impulse.args) == 1 and not factor.has(stands_for) and _vanishes_at(known, impulse.args[0]):
            found = found.xreplace({impulse: sympy.Integer(0)})
    return found


def _vanishes_at(factor: Any, place: Any) -> bool:
    """Return True if a factor is 0 wherever `place` is 0."""
    if place.is_Mul:
        return all(_vanishes_at(factor, item) for item in place.args if item.free_symbols)
    for variable in sorted(place.free_symbols, key=str):
        rate = sympy.diff(place, variable)
        if rate.is_number and rate != 0:
            return vanishes(factor.xreplace({variable: sympy.expand(variable - place / rate)}))
    return vanishes(factor.xreplace({place: sympy.Integer(0), -place: sympy.Integer(0)}))
