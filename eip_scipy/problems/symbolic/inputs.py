"""Inputs of mechanical models: functions of time in the equations that are neither coordinates nor speeds."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import sympy
from sympy.core.function import AppliedUndef
from sympy.physics.mechanics import dynamicsymbols

from ...core.inputs import is_number, shown
from ...core.jitted import compiled_like, is_jitted
from ...core.names import nearest
from .parser import symbol
from .traced import NotTraceableError, traced

__all__ = ["Inputs", "name_of", "read_inputs"]

TIME = dynamicsymbols._t
# A traced function agrees with the function itself up to rounding errors; this bound is relative.
AGREES = 1e-9


def name_of(item: Any) -> str:
    """Return the name of a dynamicsymbol, a symbol or a string; the derivative of x is the speed ``v_x``."""
    if isinstance(item, sympy.Derivative):
        return f"v_{name_of(item.expr)}"
    text = item if isinstance(item, str) else item.func.__name__ if isinstance(item, AppliedUndef) else str(item)
    return re.sub(r"\W", "_", text.replace("'", "_prime"))


class Inputs(NamedTuple):
    """Values of functions of time as `expressions`, or as `called` functions ``f(t, y)`` by name, and `notes`."""

    expressions: dict[Any, Any]
    called: tuple[tuple[str, Callable[..., float]], ...]
    notes: tuple[str, ...]


def read_inputs(
    given: Any, known: Mapping[str, Any], state: Mapping[Any, str], start: tuple[float, np.ndarray]
) -> Inputs:
    """Return the inputs, converted into expressions where that is possible.

    `given` are those of `mechanics`. `known` are the functions of time in the model by name, `state` the names of
    coordinates and speeds in the order of the state, and `start` a time and a state at which functions are called. A
    ValueError or TypeError is raised if a key is not an input, or a value has the wrong type or size.
    """
    if not isinstance(given, Mapping):
        raise TypeError(
            f"inputs must be a mapping of functions of time to expressions or functions, got {shown(given)}."
        )
    expressions: dict[Any, Any] = {}
    called: list[tuple[str, Callable[..., float]]] = []
    for key, value in given.items():
        keys = [_function_of_time(item, known, state) for item in (key if isinstance(key, tuple) else (key,))]
        if callable(value) and not isinstance(value, sympy.Basic):
            found = _traced(keys, value, state, start)
            if found is None:
                called += _called(keys, value)
            else:
                expressions |= found
        else:
            expressions |= _as_expressions(keys, value)
    notes = tuple(f"the input {name} is called as a function, not converted to an expression" for name, _ in called)
    return Inputs(expressions, tuple(called), notes)


def _function_of_time(key: Any, known: Mapping[str, Any], state: Mapping[Any, str]) -> Any:
    if key in state or key in state.values():
        raise ValueError(f"inputs: {key} is a component of the state; inputs are the other functions of time.")
    if not isinstance(key, str):
        return key
    if key not in known:
        raise ValueError(f"inputs: the model has no function {key!r}{nearest(key, known)}.")
    return known[key]


def _as_expressions(keys: Sequence[Any], value: Any) -> dict[Any, Any]:
    """Return the numbers or expressions in `value` as a dictionary with the functions of time `keys`."""
    values = [value] if len(keys) == 1 and not isinstance(value, (tuple, list, np.ndarray)) else list(value)
    if len(values) != len(keys):
        raise ValueError(f"inputs: got {len(values)} values for {', '.join(map(str, keys))}; expected {len(keys)}.")
    for item in values:
        if not (is_number(item) or isinstance(item, sympy.Expr)):
            raise TypeError(
                f"inputs: {keys[0]} is {shown(item)}; expected a number, an expression of t and the state, or a "
                "function f(t, y)."
            )
    return dict(zip(keys, map(sympy.sympify, values), strict=True))


def _traced(
    keys: Sequence[Any], fun: Any, state: Mapping[Any, str], start: tuple[float, np.ndarray]
) -> dict[Any, Any] | None:
    """Return the values of `fun` as expressions, by the functions of time in `keys`; None if that is impossible."""
    names = tuple(state.values())
    try:
        found = traced(keys[0].func.__name__, fun, "t", names).ravel()
    except NotTraceableError:
        return None
    if found.size != len(keys):
        raise ValueError(
            f"inputs: the function of {', '.join(map(str, keys))} returns {found.size} numbers; expected {len(keys)}."
        )
    t, y = start
    values = {symbol("t"): t, **{symbol(name): x for name, x in zip(names, y, strict=True)}}
    own = [float(sympy.sympify(item).xreplace(values)) for item in found]
    if not np.allclose(own, np.ravel(fun(t, y)), rtol=AGREES, atol=AGREES):  # `fun` depends on more than its arguments
        return None
    back = {symbol(name): item for item, name in state.items()} | {symbol("t"): TIME}
    return {key: sympy.sympify(item).xreplace(back) for key, item in zip(keys, found, strict=True)}


def _called(keys: Sequence[Any], fun: Any) -> list[tuple[str, Callable[..., float]]]:
    """Return for each function of time in `keys` its name, and a function ``f(t, y)`` of this component of `fun`."""
    return [(name_of(key), _part(fun, k if len(keys) > 1 else None)) for k, key in enumerate(keys)]


def _part(fun: Any, k: int | None) -> Callable[..., float]:
    if not is_jitted(fun):
        return partial(_called_in_python, fun, k)
    if k is None:
        return fun
    return compiled_like(lambda t, y: fun(t, y)[k], fun)


def _called_in_python(fun: Callable[..., Any], k: int | None, t: float, y: np.ndarray) -> float:
    return float(fun(t, y) if k is None else fun(t, y)[k])
