"""Potentials of conservative forces, by integration along one coordinate after another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy
from sympy.integrals.manualintegrate import manualintegrate

__all__ = ["at_rest", "potential_of"]

# Forces with more operations in all are not integrated, because that may take long.
MOST_OPERATIONS = 1000
# Largest number of factors of an integrand, and largest power of its sines and cosines.
MOST_FACTORS = 4
KNOWN = (sympy.sin, sympy.cos, sympy.exp)
# Points from which integrals are taken: the second one if forces are infinite at the first.
BASES = (0, 1)


def at_rest(forces: Sequence[Any], speeds: Sequence[Any], others: set[Any]) -> list[Any]:
    """Return the forces at zero speeds as expressions, without their terms that contain a symbol of `others`."""
    still = [sympy.expand_mul(sympy.sympify(item).subs(dict.fromkeys(speeds, 0))) for item in forces]
    return [sympy.Add(*(term for term in sympy.Add.make_args(F) if not term.free_symbols & others)) for F in still]


def potential_of(forces: Sequence[Any], coordinates: Sequence[Any]) -> Any:
    """Return V with forces = -dV/dq if the forces are conservative, None if no such expression is found.

    V may be wrong if the forces, which contain no speeds, are not conservative: the caller must check whether the
    energy that contains V is conserved.
    """
    if sum(item.count_ops() for item in forces) > MOST_OPERATIONS:
        return None
    forces = [sympy.expand_mul(item) for item in forces]
    lengths, forces = _of_lengths(forces, coordinates)
    for base in BASES:
        rest = _along_axes(forces, coordinates, base)
        if rest is not None:
            return lengths + rest
    return None


def _of_lengths(forces: Sequence[Any], coordinates: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Return the potential of the force terms along the gradient of a length, and the forces without these terms.

    Springs and gravitation have such terms. With S, the square of the length, such a term of the force of coordinate q
    is c S^p with c = a dS/dq / 2, where a does not depend on the coordinates. Its potential is
    -a S^(p + 1) / (2 p + 2).
    """
    potential, forces = sympy.Integer(0), list(forces)
    powers = set().union(*(item.atoms(sympy.Pow) for item in forces))
    powers = {item for item in powers if item.exp.is_Rational and item.exp < 0 and item.exp != -1 and item.base.is_Add}
    for inverse in sorted(powers, key=str):
        slopes = [sympy.diff(inverse.base, q) / 2 for q in coordinates]
        parts = [item.coeff(inverse) for item in forces]
        pairs = [(part, slope) for part, slope in zip(parts, slopes, strict=True) if part != 0 and slope != 0]
        if not pairs:
            continue
        factor = sympy.cancel(sympy.expand_trig(pairs[0][0]) / sympy.expand_trig(pairs[0][1]))
        if not factor.free_symbols & set(coordinates):
            potential -= factor * inverse.base ** (inverse.exp + 1) / (2 * inverse.exp + 2)
            forces = [sympy.expand_mul(item - part * inverse) for item, part in zip(forces, parts, strict=True)]
    return potential, forces


def _along_axes(forces: Sequence[Any], coordinates: Sequence[Any], base: int) -> Any:
    """Return minus the integral of the forces along a path, None if SymPy cannot integrate it quickly.

    The path starts at the point whose coordinates are all `base` and moves along one at a time, the last one first.
    """
    potential = sympy.Integer(0)
    for k, (force, q) in enumerate(zip(forces, coordinates, strict=True)):
        integrand = force.subs(dict.fromkeys(coordinates[:k], base))
        terms = sympy.Add.make_args(sympy.expand(integrand))
        if not all(_is_simple(term, q) for term in terms):
            return None
        integral = sympy.Add(*(manualintegrate(term, q) for term in terms))
        if integral.has(sympy.Integral):
            return None
        potential -= integral - integral.subs(q, base)
    is_finite = not potential.has(sympy.zoo, sympy.oo, -sympy.oo, sympy.nan, sympy.I)
    return potential if is_finite else None


def _is_simple(term: Any, q: Any) -> bool:
    """Return True if SymPy can integrate a term over q quickly; the integration of other terms may not end.

    Such a term has at most `MOST_FACTORS` factors that depend on q: powers of q and of one polynomial of degree at most
    2 in q, or powers of q and of sines, cosines and exponentials of linear functions of q.
    """
    powers = [item.as_base_exp() for item in sympy.Mul.make_args(term) if item.has(q)]
    if len(powers) > MOST_FACTORS:
        return False
    roots = [base for base, exponent in powers if base != q and not isinstance(base, sympy.Function | sympy.exp)]
    waves = [(base, exponent) for base, exponent in powers if isinstance(base, sympy.sin | sympy.cos)]
    others = [base for base, exponent in powers if base.has(q) and base != q and base not in roots]
    if any(exponent.has(q) or not exponent.is_Rational for base, exponent in powers if base is not sympy.E):
        return False
    own = [exponent for base, exponent in powers if base == q] if others else []  # such a term is integrated by parts
    if any(not (exponent.is_Integer and 0 < exponent <= MOST_FACTORS) for exponent in (*own, *(n for _, n in waves))):
        return False
    if any(not _degree(base.args[0], q) <= 1 or not isinstance(base, KNOWN) for base in others):
        return False
    return len(roots) <= 1 and all(_degree(base, q) <= 2 for base in roots) and not (roots and others)


def _degree(expression: Any, q: Any) -> float:
    return float(sympy.degree(expression, q)) if expression.is_polynomial(q) else float("inf")
