"""Derivatives of functions with branches: abs, max, min, sign and steps."""

from __future__ import annotations

from typing import Any

import sympy

from .brackets import vanishes

__all__ = ["slope"]


def slope(expression: Any, variable: Any) -> Any:
    """Return the derivative of an expression, without impulses at places where the expression does not jump.

    SymPy's derivative of q**2 sign(q) contains q**2 DiracDelta(q), which is 0. An impulse that remains belongs to a
    jump, or to a function of several branches at one place that was not understood.
    """
    found = sympy.diff(expression, variable)
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
