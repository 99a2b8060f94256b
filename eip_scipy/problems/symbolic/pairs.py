"""Names of the components of a state: coordinates with their momenta, and functions of time with derivatives."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import sympy
from sympy.core.function import AppliedUndef

from .parser import TIME, as_names

__all__ = ["paired", "without_derivatives"]

# Coordinates whose momenta may occur alone in H: a coordinate that H does not depend on is cyclic.
KNOWN = ("x", "y", "z", "r", "rho", "theta", "phi", "psi", "X", "Y", "Z", "R")


def paired(names: Iterable[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the coordinates and, in the same order, the momenta for the names in a Hamiltonian.

    A coordinate on which the Hamiltonian does not depend may be missing from `names`. Pairs are x and px, q1 and p1,
    theta and p_theta or ptheta; p belongs to the one remaining coordinate, or to q. A ValueError is raised if a name
    has no partner.
    """
    free = set(names)
    found = {name: _coordinate(name, free) for name in sorted(free, key=_natural)}
    pairs = [(q, p) for p, q in found.items() if q is not None]
    left = sorted(free - {name for pair in pairs for name in pair}, key=_natural)
    if "p" in left:
        others = [name for name in left if name != "p"]
        likely = ["q"] if "q" in others or not others else [name for name in others if name in KNOWN] or others
        if len(likely) == 1:
            pairs.append((likely[0], "p"))
            left = [name for name in others if name != likely[0]]
    if left or not pairs:
        raise ValueError(_unpaired(left, pairs))
    pairs.sort(key=lambda pair: _natural(pair[0]))
    return tuple(q for q, _ in pairs), tuple(p for _, p in pairs)


def _unpaired(left: list[str], pairs: list[tuple[str, str]]) -> str:
    """Return the error message for the names `left`, which have no partner, or for an H without names."""
    rule = "Names are paired as x with px, q1 with p1, theta with p_theta; others by hamiltonian(H, 'a b', 'pa pb')."
    if not left:
        return f"hamiltonian: H contains neither coordinates nor momenta. {rule}"
    are, them = ("is", "it") if len(left) == 1 else ("are", "them")
    known = "; ".join(f"{q} with {p}" for q, p in pairs) or "none"
    values = ", ".join(f"{name!r}: 1.0" for name in left)
    return (
        f"hamiltonian: it is not clear what {' and '.join(left)} {are}: no coordinate or momentum among the names of H "
        f"goes with {them} (pairs found: {known}). A constant needs a value: params={{{values}}}. {rule}"
    )


def _coordinate(momentum: str, free: set[str]) -> str | None:
    """Return the coordinate, perhaps not in H, to which `momentum` belongs; None if it is not a momentum."""
    if not momentum.startswith("p") or momentum == "p":
        return None
    rest = momentum[1:].removeprefix("_")
    if rest.isdigit():
        likely = [f"{letter}{digits}" for letter in "qx" for digits in (momentum[1:], rest)]
        return next((name for name in likely if name in free), likely[0])
    return rest if rest in free or rest in KNOWN or (momentum.startswith("p_") and rest.isidentifier()) else None


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key for sorting that puts q2 before q10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def without_derivatives(f: Any, y: Any, *others: Any) -> tuple[tuple[str, ...], list[Any], list[Any]]:
    """Return the names of the components, their derivatives, and mappings of further expressions, for `equations`.

    Components may be functions of time. A derivative that is a component itself, such as x' in the state (x, x'), is
    called ``v_x``. Any other derivative of a component is replaced by its right-hand side. `f` and `y` are the
    arguments of `equations`.
    """
    keys = list(f) if isinstance(f, Mapping) else []
    if y is None and not isinstance(f, Mapping):
        raise TypeError("equations: y is missing; give the names of the components, or f as a mapping by names.")
    if isinstance(y, str):
        y = y.replace(",", " ").split()
    given = [key.expr if _is_rate(key) and key.expr not in keys else key for key in keys] if y is None else _listed(y)
    speeds = {item: _speed(item) for item in given if isinstance(item, sympy.Derivative)}
    names = as_names("the keys of f" if y is None else "y", [speeds.get(item, item) for item in given])
    values = _listed(f.values() if isinstance(f, Mapping) else f)
    if isinstance(f, Mapping):
        whole = [key.expr if _is_rate(key) and key not in given else key for key in keys]
        found = as_names("the keys of f", [speeds.get(key, key) for key in whole])
        if set(found) != set(names):
            raise ValueError(f"equations: f has derivatives of {', '.join(found)}, but y is {', '.join(names)}.")
        values = [values[found.index(name)] for name in names]
    if len(values) != len(names):
        raise ValueError(f"equations: {len(values)} derivatives for the {len(names)} components {', '.join(names)}.")
    own = {item: sympy.Symbol(name) for item, name in speeds.items()}
    rates = {
        item.diff(TIME): value.xreplace(own)
        for item, value in zip(given, values, strict=True)
        if isinstance(item, AppliedUndef | sympy.Derivative)
        and isinstance(value, sympy.Expr)
        and item.diff(TIME) not in own
    }

    def replaced(expression: Any) -> Any:
        if isinstance(expression, sympy.Expr):
            expression = expression.xreplace(own)
            for _ in rates:  # a right-hand side may contain the derivative of another component
                expression = expression.xreplace(rates)
        return expression

    mapped = [{k: replaced(v) for k, v in x.items()} if isinstance(x, Mapping) else x for x in others]
    return names, [replaced(value) for value in values], mapped


def _listed(given: Any) -> list[Any]:
    return [given] if isinstance(given, str | sympy.Expr) else list(given)


def _is_rate(key: Any) -> bool:
    return isinstance(key, sympy.Derivative) and key.variables == (TIME,)


def _speed(item: Any) -> str:
    return f"v_{item.expr.func.__name__}" if isinstance(item.expr, AppliedUndef) else str(item)
