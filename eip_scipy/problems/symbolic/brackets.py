"""Whether a quantity is kept: its rate along the equations, {I, H} where they are Hamilton's."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import sympy

__all__ = ["how_kept"]

POINTS, TRIES = 8, 200
DIGITS = 30
ROUND_OFF = 1e-20  # of a rate that is 0, to its terms, when computed with DIGITS
# Beyond these the algebra may take minutes where numbers take milliseconds.
EXPANDED_TERMS, SIMPLIFIED_OPERATIONS = 2000, 120


class Rate(NamedTuple):
    """The rate of a quantity, and the terms that it is the sum of."""

    terms: list[Any]

    @property
    def total(self) -> Any:
        """Their sum."""
        return sympy.Add(*self.terms)

    def at(self, point: Mapping[Any, Any]) -> tuple[Any, Any] | None:
        """The sum, and that of the absolute values, at a point; None where they are not all finite and real."""
        values = [term.evalf(DIGITS, subs=point) for term in self.terms]
        if not all(value.is_Float or value.is_Integer or value.is_zero for value in values):
            return None
        return sum(values), sum(map(abs, values))


def how_kept(
    name: str, quantity: Any, variables: Sequence[Any], rates: Sequence[Any], parameters: Mapping[Any, float]
) -> str:
    """Say how it is known that a quantity is kept.

    Parameters
    ----------
    name : str
    quantity : sympy.Expr
    variables, rates : sequence of sympy.Expr
        The components of the state, and their derivatives in time.
    parameters : mapping
        Values by symbols.

    Raises
    ------
    ValueError
        When it is not, naming a point and the rate there; when the rate is finite at no point that was tried.
    """
    time = sympy.Symbol("t", real=True)
    terms = [sympy.diff(quantity, variable) * f for variable, f in zip(variables, rates, strict=True)]
    rate = Rate([term for term in [*terms, sympy.diff(quantity, time)] if term != 0])
    if not rate.terms or _is_zero(rate.total):
        return "symbolically"
    points = list(_points([*variables, time], rate, parameters))
    if not points:
        raise ValueError(f"invariant {name!r}: its rate {_cut(rate.total)} is finite and real at no point tried.")
    for point, (total, size) in points:
        if abs(total) > ROUND_OFF * size:
            place = ", ".join(f"{key}={float(value):.3g}" for key, value in point.items())
            raise ValueError(
                f"{name!r} is no invariant of these equations: its rate is {_cut(rate.total)}, at {place} "
                f"{float(total):.3g} where its terms sum to {float(size):.3g}."
            )
    return f"numerically, at {len(points)} points" + (" with the parameters given" if parameters else "")


def _is_zero(expression: Any) -> bool:
    """Whether algebra shows it, where that is quick."""
    if _terms(expression) > EXPANDED_TERMS:
        return False
    expanded = sympy.expand(expression)
    if expanded == 0:
        return True
    return expression.count_ops() <= SIMPLIFIED_OPERATIONS and bool(sympy.simplify(expanded) == 0)


def _terms(expression: Any) -> int:
    """How many terms there are at most once it is expanded."""
    match expression:
        case sympy.Add():
            return sum(map(_terms, expression.args))
        case sympy.Mul():
            return math.prod(map(_terms, expression.args))
        case sympy.Pow(args=(base, sympy.Integer() as exponent)):
            terms, power = _terms(base), min(abs(int(exponent)), EXPANDED_TERMS)
            return math.comb(terms + power - 1, power)
    return 1


def _points(variables: Sequence[Any], rate: Rate, parameters: Mapping[Any, float]) -> Iterator[tuple[Any, Any]]:
    """Random points where the rate is finite and real; of both signs, or positive where roots and logarithms ask."""
    draw = random.Random(20220)
    found = 0
    for k in range(TRIES):
        signs = (-1, 1) if k < TRIES // 2 else (1,)
        point = {item: draw.choice(signs) * sympy.Rational(draw.randint(300, 1700), 1000) for item in variables}
        values = rate.at(point | {item: sympy.Rational(value) for item, value in parameters.items()})
        if values is not None:
            yield point, values
            found += 1
        if found == POINTS:
            return


def _cut(expression: Any) -> str:
    text = str(expression)
    return text if len(text) <= 120 else f"{text[:120]}..."
