"""Test whether a quantity is conserved at states that meet constraints, though possibly not at others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import sympy

from ..multibody.motion import plain
from .brackets import Rate, shortened
from .program import Arguments, function

__all__ = ["Manifold"]

POINTS, TRIES, NEWTON_STEPS = 8, 100, 30
# A constraint is met, and a rate is 0, within this share of its terms.
MET, CONSTANT = 1e-12, 1e-9
# Singular values of the gradients below this share of the largest one do not count for the rank.
DEPENDENT = 1e-9
BEYOND = (ValueError, ZeroDivisionError, OverflowError)  # errors of functions outside their domain


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
        for k in range(TRIES):
            signs = rng.choice([-1.0, 1.0], n) if k < TRIES // 2 else np.ones(n)
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
