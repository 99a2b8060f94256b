"""Names of the components of a state: coordinates with their momenta, and functions of time with derivatives."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import sympy
from sympy.core.function import AppliedUndef

from .parser import TIME, as_names

__all__ = ["Timed", "paired"]

# Coordinates whose momenta may occur alone in H: a coordinate that H does not depend on is cyclic.
KNOWN = ("x", "y", "z", "r", "rho", "theta", "phi", "psi", "X", "Y", "Z", "R")


def paired(names: Iterable[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the coordinates and, in the same order, the momenta for the names in a Hamiltonian.

    A coordinate on which the Hamiltonian does not depend may be missing from `names`. Pairs are x and px, q1 and p1,
    theta and p_theta or ptheta; p belongs to the one remaining coordinate, or to q. A ValueError is raised if a name
    has no partner.
    """
    free = set(names)
    pairs = []
    for momentum in sorted(free, key=_natural):
        coordinate = _coordinate(momentum, free)
        if coordinate is not None:
            pairs.append((coordinate, momentum))
    left = sorted(free - {name for pair in pairs for name in pair}, key=_natural)
    if "p" in left and (coordinate := _partner_of_p([name for name in left if name != "p"])) is not None:
        pairs.append((coordinate, "p"))
        left = [name for name in left if name not in ("p", coordinate)]
    if left or not pairs:
        raise ValueError(_unpaired(left, pairs))
    pairs.sort(key=lambda pair: _natural(pair[0]))
    return tuple(q for q, _ in pairs), tuple(p for _, p in pairs)


def _unpaired(left: list[str], pairs: list[tuple[str, str]]) -> str:
    """Return the error message for the names `left`, which have no partner, or for an H without names."""
    rule = "Names are paired as x with px, q1 with p1, theta with p_theta; others by hamiltonian(H, 'a b', 'pa pb')."
    if not left:
        return f"hamiltonian: H contains neither coordinates nor momenta. {rule}"
    are = "is" if len(left) == 1 else "are"
    known = "; ".join(f"{q} with {p}" for q, p in pairs) or "none"
    values = ", ".join(f"{name!r}: 1.0" for name in left)
    return (
        f"hamiltonian: it is not clear what {' and '.join(left)} {are}: no coordinate or momentum among the names of H "
        f"goes with {'it' if len(left) == 1 else 'them'} (pairs found: {known}). A constant needs a value: "
        f"params={{{values}}}. {rule}"
    )


def _coordinate(momentum: str, free: set[str]) -> str | None:
    """Return the coordinate, perhaps not in H, to which `momentum` belongs; None if it is not a momentum."""
    if not momentum.startswith("p") or momentum == "p":
        return None
    rest = momentum[1:].removeprefix("_")
    if rest.isdigit():
        likely = (f"q{momentum[1:]}", f"q{rest}", f"x{momentum[1:]}", f"x{rest}")
        return next((name for name in likely if name in free), likely[0])
    return rest if rest in free or rest in KNOWN or (momentum.startswith("p_") and rest.isidentifier()) else None


def _partner_of_p(others: list[str]) -> str | None:
    """Return q, the only usual name of a coordinate, or the only name among `others`; None if that is not clear."""
    if "q" in others or not others:
        return "q"
    likely = [name for name in others if name in KNOWN] or others
    return likely[0] if len(likely) == 1 else None


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key for sorting that puts q2 before q10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


class Timed:
    """Names of the components of a state, and the `values` of their derivatives; components may be functions of time.

    A derivative that is a component itself, such as x' in the state (x, x'), is called ``v_x``. Any other derivative of
    a component is replaced by its right-hand side; a call with an expression makes these replacements in it. `f` and
    `y` are the arguments of `equations`.
    """

    def __init__(self, f: Any, y: Any) -> None:
        keys = list(f) if isinstance(f, Mapping) else None
        if y is not None:
            given = y.replace(",", " ").split() if isinstance(y, str) else _listed(y)
        elif keys is not None:
            given = [key.expr if _is_rate(key) and key.expr not in keys else key for key in keys]
        else:
            raise TypeError("equations: y is missing; give the names of the components, or f as a mapping by names.")
        self._speeds = {item: _speed(item) for item in given if isinstance(item, sympy.Derivative)}
        self.names = as_names("the keys of f" if y is None else "y", [self._speeds.get(item, item) for item in given])
        values = list(f.values()) if isinstance(f, Mapping) else _listed(f)
        if keys is not None:
            whole = [key.expr if _is_rate(key) and key not in given else key for key in keys]
            found = [self._speeds.get(key, key) for key in whole]
            by_name = dict(zip(as_names("the keys of f", found), values, strict=True))
            if set(by_name) != set(self.names):
                raise ValueError(
                    f"equations: f has derivatives of {', '.join(by_name)}, but y is {', '.join(self.names)}."
                )
            values = [by_name[name] for name in self.names]
        if len(values) != len(self.names):
            raise ValueError(
                f"equations: {len(values)} derivatives for the {len(self.names)} components {', '.join(self.names)}."
            )
        self._rates = {
            sympy.Derivative(item, TIME): value
            for item, value in zip(given, values, strict=True)
            if isinstance(item, AppliedUndef) and sympy.Derivative(item, TIME) not in self._speeds
        }
        self._rates |= {item.diff(TIME): f for item, f in zip(given, values, strict=True) if item in self._speeds}
        self.values = [self(value) for value in values]

    def __call__(self, expression: Any) -> Any:
        """Return an expression with the derivatives of components replaced; return text and numbers unchanged."""
        if not isinstance(expression, sympy.Expr):
            return expression
        expression = self._with_speeds(expression)
        expressions = {
            key: self._with_speeds(value) for key, value in self._rates.items() if isinstance(value, sympy.Expr)
        }
        for _ in expressions:
            if not expression.has(sympy.Derivative):
                break
            expression = expression.xreplace(expressions)
        return expression

    def _with_speeds(self, expression: Any) -> Any:
        return expression.xreplace({item: sympy.Symbol(name) for item, name in self._speeds.items()})


def _listed(given: Any) -> list[Any]:
    return [given] if isinstance(given, (str, sympy.Expr)) else list(given)


def _is_rate(key: Any) -> bool:
    """Return True if `key`, a key of the mapping `f` of `Timed`, is a first derivative with respect to time."""
    return isinstance(key, sympy.Derivative) and key.variables == (TIME,)


def _speed(item: Any) -> str:
    return f"v_{item.expr.func.__name__}" if isinstance(item.expr, AppliedUndef) else str(item)
