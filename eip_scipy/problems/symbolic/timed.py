"""Equations in SymPy's functions of time, `dynamicsymbols`, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy
from sympy.core.function import AppliedUndef

from .parser import TIME, as_names

__all__ = ["Timed"]


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
        self._rates |= {
            item.diff(TIME): value for item, value in zip(given, values, strict=True) if item in self._speeds
        }
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
