"""Points on both sides of each place at which max, min, abs, sign or a step changes its branch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

import sympy

__all__ = ["Switches"]

KINDS = (sympy.Max, sympy.Min, sympy.Abs, sympy.sign, sympy.Heaviside)
MOST = 60  # largest number of differences whose signs choose branches
LINES = 4  # number of lines on which a change of sign is searched for each difference
POWERS = range(-40, 101, 4)  # the places on a line are these powers of 2
BISECTIONS = 40  # after them the relative distance is 1e-11


class Switches:
    """The differences of `variables` whose signs choose the branches of some expressions."""

    def __init__(self, expressions: Iterable[Any], variables: Sequence[Any]) -> None:
        atoms = sorted({atom for item in expressions for atom in item.atoms(*KINDS)}, key=str)
        self._variables = variables
        self._differences: dict[Any, Any] = {}
        for atom in atoms:
            several = isinstance(atom, (sympy.Max, sympy.Min))
            found = [a - b for a, b in combinations(atom.args, 2)] if several else [atom.args[0]]
            self._differences |= {item: atom for item in found if item.free_symbols & set(variables)}

    def points(self, draw: Callable[[], dict[Any, Any]], at: Callable[[Any, Mapping[Any, Any]], Any]) -> list[Any]:
        """Return points on both sides of all places at which a function changes its branch.

        ``draw()`` returns a random point, and ``at(expression, point)`` a value, None if it is not finite and real. A
        ValueError is raised if there are too many branches, or one of them is not found.
        """
        if len(self._differences) > MOST:
            raise ValueError(f"its functions change branches at {len(self._differences)} places, more than {MOST}")
        found = []
        for difference, atom in self._differences.items():
            sides = [side for _ in range(LINES) for side in self._sides(difference, draw(), at)]
            one_sided = difference.is_nonnegative or difference.is_nonpositive
            if not sides and not one_sided:
                raise ValueError(f"no point was found where {_cut(atom)} changes its branch")
            found += sides
        return found

    def _sides(self, difference: Any, point: dict[Any, Any], at: Callable[[Any, Mapping[Any, Any]], Any]) -> list[Any]:
        """Return two points on a line through `point` on an axis at which `difference` has opposite signs, or []."""
        for variable in sorted(difference.free_symbols & set(self._variables), key=str):
            places = [sign * sympy.Integer(2) ** power for sign in (-1, 1) for power in POWERS]
            places = [sympy.Integer(0), point[variable], *places]
            signs: dict[int, Any] = {}
            for place in sorted(places, key=abs):
                value = at(difference, point | {variable: place})
                if value is not None and value != 0:
                    signs.setdefault(1 if value > 0 else -1, place)
                if len(signs) == 2:
                    return self._closer(difference, point, variable, signs, at)
        return []

    def _closer(self, difference: Any, point: Any, variable: Any, signs: Any, at: Any) -> list[Any]:
        below, above = signs[-1], signs[1]
        for _ in range(BISECTIONS):
            middle = (below + above) / 2
            value = at(difference, point | {variable: middle})
            if value is None or value == 0:
                break
            below, above = (middle, above) if value < 0 else (below, middle)
        return [point | {variable: place} for place in (below, above)]


def _cut(expression: Any) -> str:
    text = str(expression)
    return text if len(text) <= 120 else f"{text[:120]}..."
