"""Test whether a quantity is conserved: its rate along the equations, {I, H} for Hamilton's equations.

Functions with branches, such as abs and max, are examined on both sides of each place at which they change, and their
derivatives have no impulses where they do not jump. A quantity may be conserved only at states that meet constraints.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import sympy

from ..multibody.motion import plain
from .program import Arguments, function

__all__ = ["Manifold", "NotKeptError", "Rate", "how_kept", "shortened", "slope", "vanishes"]

POINTS, TRIES = 8, 200
DIGITS = 50
LARGEST = sympy.Integer(10) ** 300
ROUND_OFF = 1e-20  # bound for the rounding of a rate that is 0, relative to its terms, when computed with DIGITS
# Largest number of terms of an expanded polynomial. With more terms algebra may take minutes.
EXPANDED_TERMS = 2000
# Beyond this number of operations `simplify` may take minutes, while an evaluation at points takes milliseconds.
SIMPLIFIED_OPERATIONS = 120
# Functions with branches, and the search for places where they change.
KINDS = (sympy.Max, sympy.Min, sympy.Abs, sympy.sign, sympy.Heaviside)
MOST = 60  # largest number of differences whose signs choose branches
LINES = 4  # number of lines on which a change of sign is searched for each difference
POWERS = range(-40, 101, 4)  # the places on a line are these powers of 2
BISECTIONS = 40  # after them the relative distance is 1e-11
# The search for states that meet constraints.
STARTS, NEWTON_STEPS = 100, 30
# A constraint is met, and a rate is 0, within this share of its terms.
MET, CONSTANT = 1e-12, 1e-9
# Singular values of the gradients below this share of the largest one do not count for the rank.
DEPENDENT = 1e-9
BEYOND = (ValueError, ZeroDivisionError, OverflowError)  # errors of functions outside their domain


class NotKeptError(ValueError):
    """Error for a quantity that is not an invariant."""


class Rate(NamedTuple):
    """Rate of change of a quantity, as the terms of a sum."""

    terms: list[Any]

    @property
    def total(self) -> Any:
        """Return the sum of the terms."""
        return sympy.Add(*self.terms)

    def at(self, point: Mapping[Any, Any]) -> tuple[Any, Any] | None:
        """Return the sums of the terms and their absolute values at a point; None if a term is not finite and real."""
        known = {item: value.evalf(DIGITS) for item, value in point.items()}
        values = [_value(term, known) for term in self.terms]
        if any(value is None for value in values):
            return None
        return sum(values), sum(map(abs, values))


def how_kept(
    name: str, quantity: Any, variables: Sequence[Any], rates: Sequence[Any], parameters: Mapping[Any, float]
) -> str:
    """Return how a quantity was shown to be conserved, such as "symbolically" or "numerically, at 8 points".

    `variables` and `rates` are the components of the state and their derivatives, and `parameters` are values by
    symbols. NotKeptError, which names a point and the rate there, is raised if the quantity is not conserved.
    ValueError is raised if the rate is not finite at any point, or cannot be examined in all branches of functions such
    as max.
    """
    time = sympy.Symbol("t", real=True)
    terms = [sympy.diff(quantity, variable) * f for variable, f in zip(variables, rates, strict=True)]
    rate = Rate([term for term in [*terms, sympy.diff(quantity, time)] if term != 0])
    if not rate.terms or _expands_to_zero(rate.total):
        return "symbolically"
    points = list(_points([*variables, time], rate, parameters))
    _require_kept(name, rate, points)  # this takes milliseconds, while `simplify` may take minutes
    if _simplifies_to_zero(rate.total):
        return "symbolically"
    try:
        points += _beside_switches([quantity, *rates, *rate.terms], [*variables, time], rate, parameters)
    except ValueError as error:
        raise ValueError(
            f"invariant {name!r}: {error}, so that it cannot be checked in all branches. Give each branch as a problem "
            "of its own, or omit this invariant."
        ) from None
    if not points:
        raise ValueError(
            f"invariant {name!r}: its rate {shortened(rate.total)} is not finite and real at any point that was tried. "
            "The variables were between 0.3 and 1.7 in size; choose units in which the rate exists there, "
            "or omit this invariant."
        )
    _require_kept(name, rate, points)
    return f"numerically, at {len(points)} points" + (" with the parameters given" if parameters else "")


def _require_kept(name: str, rate: Rate, points: Sequence[Any]) -> None:
    for point, (total, size) in points:
        if abs(total) > ROUND_OFF * size:
            place = ", ".join(f"{key}={float(value):.3g}" for key, value in point.items())
            raise NotKeptError(
                f"{name!r} is not an invariant of these equations: its rate is {shortened(rate.total)}. At {place} the "
                f"rate is {float(total):.3g}, and the absolute values of its terms sum to {float(size):.3g}."
            )


def _value(expression: Any, known: dict[Any, Any]) -> Any:
    """Return the value of an expression, computed from its parts; None if a part is not finite and real.

    `known` holds the values of symbols and parts. SymPy's own evaluation has no bound for the size of a part: a tower
    of exponentials would need more digits than there is memory.
    """
    if expression not in known:
        known[expression] = None
        parts = [_value(part, known) for part in expression.args]
        if all(part is not None for part in parts):
            value = expression if expression.is_Rational else (expression.func(*parts) if parts else expression)
            value = value if value.is_Rational else value.evalf(DIGITS)
            if (value.is_Float or value.is_Rational) and abs(value) < LARGEST:
                known[expression] = value
    return known[expression]


def vanishes(expression: Any) -> bool:
    """Return True if an expression is 0, by algebra if that is quick, otherwise at random points."""
    if _expands_to_zero(expression):
        return True
    rate = Rate([expression])
    points = list(_points(sorted(expression.free_symbols, key=str), rate, {}))
    return bool(points) and all(abs(total) <= ROUND_OFF for _, (total, _) in points)


def _expanded_terms(expression: Any) -> int:
    """Return an upper bound for the number of terms of the expanded expression, at most `EXPANDED_TERMS` + 1."""
    most = EXPANDED_TERMS + 1
    match expression:
        case sympy.Add():
            return min(most, sum(map(_expanded_terms, expression.args)))
        case sympy.Mul():
            product = 1
            for factor in expression.args:
                product = min(most, product * _expanded_terms(factor))
            return product
        case sympy.Pow(args=(base, sympy.Integer() as exponent)):
            terms, power = _expanded_terms(base), min(abs(int(exponent)), most)
            return min(most, math.comb(terms + power - 1, power)) if terms > 1 else 1
    return 1


def _expands_to_zero(expression: Any) -> bool:
    return _expanded_terms(expression) <= EXPANDED_TERMS and sympy.expand(expression) == 0


def _simplifies_to_zero(expression: Any) -> bool:
    """Return True if algebra shows quickly that an expression is 0."""
    if _expanded_terms(expression) > EXPANDED_TERMS or expression.count_ops() > SIMPLIFIED_OPERATIONS:
        return False
    return bool(sympy.simplify(sympy.expand(expression)) == 0)


def _points(variables: Sequence[Any], rate: Rate, parameters: Mapping[Any, float]) -> Iterator[tuple[Any, Any]]:
    """Yield random points where the rate is finite and real, with ``rate.at``; in the second half they are positive."""
    draw = random.Random(20220)
    given = {item: sympy.Rational(value) for item, value in parameters.items()}
    found = 0
    for k in range(TRIES):
        point = _drawn(draw, variables, (-1, 1) if k < TRIES // 2 else (1,))
        values = rate.at(point | given)
        if values is not None:
            yield point, values
            found += 1
        if found == POINTS:
            return


def _beside_switches(
    expressions: Sequence[Any], variables: Sequence[Any], rate: Rate, parameters: Mapping[Any, float]
) -> Iterator[tuple[Any, Any]]:
    """Yield points on both sides of each place at which a max, min, abs or the like changes, with ``rate.at``."""
    differences: dict[Any, Any] = {}  # those whose signs choose branches, and the functions
    for atom in sorted({atom for item in expressions for atom in item.atoms(*KINDS)}, key=str):
        several = isinstance(atom, (sympy.Max, sympy.Min))
        found = [a - b for a, b in combinations(atom.args, 2)] if several else [atom.args[0]]
        differences |= {item: atom for item in found if item.free_symbols & set(variables)}
    if len(differences) > MOST:
        raise ValueError(f"its functions change branches at {len(differences)} places, more than {MOST}")
    draw = random.Random(20221)
    given = {item: sympy.Rational(value) for item, value in parameters.items()}
    for difference, atom in differences.items():
        known = sorted(difference.free_symbols & set(variables), key=str)
        sides = [
            side for _ in range(LINES) for side in _sides(difference, known, _drawn(draw, variables, (-1, 1)), given)
        ]
        if not (sides or difference.is_nonnegative or difference.is_nonpositive):
            raise ValueError(f"no point was found where {shortened(atom)} changes its branch")
        for point in sides:
            values = rate.at(point | given)
            if values is not None:
                yield point, values


def _sides(difference: Any, variables: Sequence[Any], point: dict[Any, Any], given: dict[Any, Any]) -> list[Any]:
    """Return two points on a line through `point` on an axis at which `difference` has opposite signs, or []."""

    def at(variable: Any, place: Any) -> Any:
        return _value(
            difference, {k: number.evalf(DIGITS) for k, number in (point | {variable: place} | given).items()}
        )

    for variable in variables:
        places = [sign * sympy.Integer(2) ** power for sign in (-1, 1) for power in POWERS]
        places = [sympy.Integer(0), point[variable], *places]
        signs: dict[int, Any] = {}
        for place in sorted(places, key=abs):
            value = at(variable, place)
            if value is not None and value != 0:
                signs.setdefault(1 if value > 0 else -1, place)
            if len(signs) < 2:
                continue
            below, above = signs[-1], signs[1]
            for _ in range(BISECTIONS):
                middle = (below + above) / 2
                value = at(variable, middle)
                if value is None or value == 0:
                    break
                below, above = (middle, above) if value < 0 else (below, middle)
            return [point | {variable: place} for place in (below, above)]
    return []


def _drawn(draw: random.Random, variables: Sequence[Any], signs: Sequence[int]) -> dict[Any, Any]:
    return {item: draw.choice(signs) * sympy.Rational(draw.randint(300, 1700), 1000) for item in variables}


def shortened(expression: Any) -> str:
    """Return an expression as text, of which at most 120 characters are kept."""
    text = str(expression)
    return text if len(text) <= 120 else f"{text[:120]}..."


def slope(expression: Any, variable: Any) -> Any:
    """Return the derivative of an expression, without impulses at places where the expression does not jump."""
    return without_impulses(sympy.diff(expression, variable))


def without_impulses(found: Any) -> Any:
    """Return a derivative without impulses whose factor is 0 where they occur.

    SymPy's derivative of q**2 sign(q) contains q**2 DiracDelta(q), which is 0. An impulse that remains belongs to a
    jump, or to a function of several branches at one place that was not understood.
    """
    for impulse in sorted(found.atoms(sympy.DiracDelta), key=str):
        stands_for = sympy.Dummy()
        factor = sympy.diff(found.xreplace({impulse: stands_for}), stands_for)
        if len(impulse.args) == 1 and not factor.has(stands_for) and _vanishes_at(factor, impulse.args[0]):
            found = found.xreplace({impulse: sympy.Integer(0)})
    return found


def _vanishes_at(factor: Any, place: Any) -> bool:
    """Return True if a factor is 0 wherever `place` is 0, whatever the values of signs and steps in it are."""
    if place.is_Mul:
        return all(_vanishes_at(factor, item) for item in place.args if item.free_symbols)
    # The value of sign(q) at 0 says nothing about an impulse there: sign(q)**3 jumps.
    factor = factor.xreplace({item: sympy.Dummy(real=True) for item in factor.atoms(sympy.sign, sympy.Heaviside)})
    for variable in sorted(place.free_symbols, key=str):
        rate = sympy.diff(place, variable)
        if rate.is_number and rate != 0:
            return vanishes(factor.xreplace({variable: sympy.expand(variable - place / rate)}))
    return vanishes(factor.xreplace({place: sympy.Integer(0), -place: sympy.Integer(0)}))


class Manifold:
    """The states at which `constraints`, expressions by name, are 0; `rates` are the derivatives of the `components`.

    A ValueError is raised if no state is found that meets the constraints.
    """

    def __init__(
        self,
        constraints: Mapping[str, Any],
        components: Sequence[str],
        rates: Sequence[Any],
        parameters: Mapping[str, float],
    ) -> None:
        self._names, self._rates = tuple(constraints), tuple(rates)
        self._arguments = Arguments(components, tuple(parameters))
        self._params = (np.array(list(parameters.values())),) if parameters else ()
        self._variables = [sympy.Symbol(name, real=True) for name in components]
        self._components = tuple(components)
        items = list(constraints.values())
        self._values = self._function("constraints", items)
        slopes = [sympy.diff(item, variable) for item in items for variable in self._variables]
        self._slopes = self._function("gradients of constraints", slopes)
        self._points = list(self._found())
        if not self._points:
            raise ValueError(
                f"constraints: no state was found that meets {', '.join(map(repr, self._names))}. Constraints are "
                "expressions that are 0; a length l is the constraint x**2 + y**2 - l**2."
            )

    def how_kept(self, name: str, quantity: Any) -> str:
        """Return how a quantity was shown to be conserved, as text such as "numerically, at 8 points ...".

        A ValueError is raised if the quantity is not conserved, or its rate is not finite at any of the points.
        """
        terms = [sympy.diff(quantity, y) * f for y, f in zip(self._variables, self._rates, strict=True)]
        terms = [item for item in [*terms, sympy.diff(quantity, sympy.Symbol("t", real=True))] if item != 0]
        evaluated = self._function(f"rate of {name}", terms)
        count = 0
        for t, y in self._points:
            values = evaluated(t, y)
            if values is None:
                continue
            count += 1
            if abs(values.sum()) > CONSTANT * np.abs(values).sum():
                raise self._not_kept(name, Rate(terms).total, t, y, values)
        if count == 0:
            raise ValueError(
                f"{name!r}: its rate is not finite at any of the points that meet the constraints."
                " Choose units in which it exists at values of about 1, or omit this quantity."
            )
        return f"numerically, at {count} points that meet the constraints"

    def _not_kept(self, name: str, rate: Any, t: float, y: np.ndarray, values: np.ndarray) -> ValueError:
        constraints = ", ".join(map(repr, self._names))
        place = ", ".join(f"{key}={value:.3g}" for key, value in zip((*self._components, "t"), (*y, t), strict=True))
        return ValueError(
            f"{name!r} is not an invariant of these equations, even where the constraints {constraints} hold: its "
            f"rate is {shortened(rate)}. At {place} the rate is {values.sum():.3g}, and the absolute values of its "
            f"terms sum to {np.abs(values).sum():.3g}. If the rate is 0 at your states, because of a constraint on "
            "velocities, add that to constraints."
        )

    def _function(self, what: str, items: Sequence[Any]) -> Callable[[float, np.ndarray], np.ndarray | None]:
        """Return a function of (t, y) that returns the values of expressions, or None if one of them is not finite."""
        places = {k: item for k, item in enumerate(items) if item != 0}
        fill = plain(function(what, list(places.values()), self._arguments, in_place=True, places=list(places)))

        def value(t: float, y: np.ndarray) -> np.ndarray | None:
            out = np.empty(len(items))
            try:
                with np.errstate(all="ignore"):
                    fill(t, y, out, *self._params)
            except BEYOND:
                return None
            return out if np.isfinite(out).all() else None

        return value

    def _found(self) -> Iterator[tuple[float, np.ndarray]]:
        """Yield times and states that meet the constraints."""
        rng, found = np.random.default_rng(20222), 0
        n = len(self._components)
        for k in range(STARTS):
            signs = rng.choice([-1.0, 1.0], n) if k < STARTS // 2 else np.ones(n)
            t = float(rng.uniform(0.3, 1.7))
            y = self._projected(t, signs * rng.uniform(0.3, 1.7, n))
            if y is not None:
                yield t, y
                found += 1
            if found == POINTS:
                return

    def _projected(self, t: float, y: np.ndarray) -> np.ndarray | None:
        """Return the state on the constraints that Newton's method finds from y, or None if it does not converge."""
        for _ in range(NEWTON_STEPS):
            values, slopes = self._values(t, y), self._slopes(t, y)
            if values is None or slopes is None:
                return None
            slopes = slopes.reshape(values.size, y.size)
            if (np.abs(values) <= MET * (np.abs(slopes) @ np.abs(y))).all():
                return y
            y = y - np.linalg.lstsq(slopes, values, DEPENDENT)[0]
        return None
