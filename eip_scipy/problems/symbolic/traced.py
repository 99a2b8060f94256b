"""Conversion of functions of NumPy arrays to expressions: they are called once with symbols in place of numbers."""

from __future__ import annotations

import math
import operator
import types
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import sympy

from ...core.jitted import is_jitted
from ..multibody.parts import Given, Parts, outputs_as_given
from ..multibody.start import Names
from .constrained import Constrained, conservative, cyclic, own_speed, parts_of
from .parser import symbol

__all__ = ["NotTraceableError", "traced", "traced_parts"]

LIBRARIES = ("numpy", "scipy", "numba", "builtins")  # functions of these packages are not copied
MOST_OPERATIONS = 20_000  # largest number of operations of one expression
FUNCTIONS: dict[str, Any] = {
    **{name: getattr(sympy, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"arc{name}": getattr(sympy, f"a{name}") for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "sign": sympy.sign,
    "fabs": sympy.Abs,
}


class NotTraceableError(TypeError):
    """Error for a function that cannot be converted to an expression, for example because it branches on a value."""


def _binary(operation: Callable[[Any, Any], Any], *, swapped: bool = False) -> Callable[[Number, Any], Any]:
    """Return a method of `Number` that applies an operation to the expressions of both numbers."""

    def method(self: Number, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented
        found = _number(other)
        first, second = (found, self) if swapped else (self, found)
        return Number(operation(first.expression, second.expression), self.size + found.size + 1)

    return method


class Number:
    """Expression in place of a number; `size` counts its operands and operations, at most `MOST_OPERATIONS`."""

    __slots__ = ("expression", "size")

    def __init__(self, expression: Any, size: int = 1) -> None:
        if size > MOST_OPERATIONS:
            raise NotTraceableError("an expression is too long")
        self.expression, self.size = expression, size

    __add__ = __radd__ = _binary(operator.add)
    __sub__, __rsub__ = _binary(operator.sub), _binary(operator.sub, swapped=True)
    __mul__ = __rmul__ = _binary(operator.mul)
    __truediv__, __rtruediv__ = _binary(operator.truediv), _binary(operator.truediv, swapped=True)
    __pow__, __rpow__ = _binary(operator.pow), _binary(operator.pow, swapped=True)
    arctan2 = _binary(sympy.atan2)
    hypot = _binary(lambda x, y: sympy.sqrt(x**2 + y**2))

    def __neg__(self) -> Number:
        return Number(-self.expression, self.size + 1)

    def __pos__(self) -> Number:
        return self

    def __abs__(self) -> Number:
        return Number(sympy.Abs(self.expression), self.size + 1)

    def conjugate(self) -> Number:
        """Return the number itself, because traced numbers are real."""
        return self

    def __getattr__(self, name: str) -> Any:  # NumPy calls the method of each element
        if name in FUNCTIONS:
            return lambda: Number(FUNCTIONS[name](self.expression), self.size + 1)
        raise AttributeError(name)

    def _refuse(self, *_: Any) -> Any:
        raise NotTraceableError("a branch, an index or a conversion depends on a value")

    __bool__ = __float__ = __int__ = __index__ = __complex__ = _refuse
    __lt__ = __le__ = __gt__ = __ge__ = _refuse


def _number(value: Any) -> Number:
    if isinstance(value, Number):
        return value
    plain = float(value)
    if not math.isfinite(plain):
        raise NotTraceableError("a constant is not finite")
    return Number(sympy.Integer(int(plain)) if plain.is_integer() and abs(plain) < 2**53 else sympy.Float(plain))


def traced(what: str, fun: Any, *groups: Any) -> np.ndarray:
    """Return the value of the function `fun` as an array of expressions; `what` describes it in messages.

    Each of `groups` stands for an argument: a name for a number, a sequence of names for an array. NotTraceableError is
    raised if the value cannot be written as an expression of the arguments.
    """
    arguments = [
        Number(symbol(names)) if isinstance(names, str) else _array([Number(symbol(name)) for name in names])
        for names in groups
    ]
    copied = _replaced(fun.py_func if is_jitted(fun) else fun, {})
    try:
        found = np.asarray(copied(*arguments), dtype=object)
        flat = [_number(item).expression for item in found.ravel()]
    except MemoryError:
        raise
    except Exception as error:  # NumPy and the user's function may raise any error
        raise NotTraceableError(f"{what}: {error}") from error
    return np.array([*flat, None], dtype=object)[:-1].reshape(found.shape)


def _array(items: Sequence[Any]) -> np.ndarray:
    out = np.empty(len(items), dtype=object)
    out[:] = items
    return out


class _NumPy(types.ModuleType):
    """Module that replaces NumPy: its zeros, ones, eye and similar functions return arrays that can hold `Number`."""

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)


def _made(maker: Callable[..., Any], shape: Any, *args: Any, dtype: Any = None, **kwargs: Any) -> Any:
    found = maker(shape, *args, **kwargs)
    return found.astype(object) if dtype in (None, float, np.float64) else found.astype(dtype)


def _of_math(name: str, *arguments: Any) -> Any:
    if not any(isinstance(item, Number) for item in arguments):
        return getattr(math, name)(*arguments)
    first, *others = map(_number, arguments)
    inverse = name in ("asin", "acos", "atan", "asinh", "acosh", "atanh", "atan2")
    return getattr(first, "__pow__" if name == "pow" else name.replace("a", "arc", 1) if inverse else name)(*others)


NUMPY = _NumPy("numpy")
MATH = types.ModuleType("math")
for _name in ("zeros", "ones", "empty"):
    setattr(NUMPY, _name, partial(_made, np.zeros if _name == "empty" else getattr(np, _name)))
for _name in ("zeros_like", "empty_like"):
    setattr(NUMPY, _name, lambda a, *args, **kwargs: np.zeros(np.shape(a), dtype=object))
NUMPY.eye = NUMPY.identity = lambda *args, **kwargs: np.eye(*args, **kwargs).astype(object)  # type: ignore[attr-defined]
for _name in dir(math):
    _item = getattr(math, _name)
    setattr(MATH, _name, partial(_of_math, _name) if callable(_item) else _item)


def _replaced(item: Any, known: dict[int, Any]) -> Any:
    """Return the replacement of a global or closure variable, or the variable itself if it needs none.

    A Python or Numba function is replaced by a copy whose own variables are replaced; `known` holds the copies by id.
    """
    if item is np:
        return NUMPY
    if item is math:
        return MATH
    for module, others in ((np, NUMPY), (math, MATH)):
        name = getattr(item, "__name__", None)
        if callable(item) and isinstance(name, str) and name in vars(others) and getattr(module, name, None) is item:
            return getattr(others, name)
    if is_jitted(item):
        item = item.py_func
    library = str(getattr(item, "__module__", "")).partition(".")[0] in LIBRARIES
    if not isinstance(item, types.FunctionType) or library or id(item) in known:
        return known.get(id(item), item)
    names, cells = dict(item.__globals__), [types.CellType() for _ in item.__closure__ or ()]
    copied = types.FunctionType(item.__code__, names, item.__name__, item.__defaults__, tuple(cells))
    copied.__kwdefaults__ = item.__kwdefaults__
    known[id(item)] = copied
    for name in _names(item.__code__) & names.keys():
        names[name] = _replaced(names[name], known)
    for cell, own in zip(cells, item.__closure__ or (), strict=True):
        cell.cell_contents = _replaced(own.cell_contents, known)
    return copied


def _names(code: types.CodeType) -> set[str]:
    inside = (_names(item) for item in code.co_consts if isinstance(item, types.CodeType))
    return set(code.co_names).union(*inside)


# Relative bound for the difference between a traced function and the function itself at the start.
AGREES = 1e-9


def traced_parts(given: Given, names: Names, t: float, q: np.ndarray, u: np.ndarray) -> Parts:
    """Return the `Parts` of a mechanism, made from expressions for the functions that `mechanism` was given.

    NotTraceableError is raised if a function cannot be converted, or its expression has another value at the start.
    """
    by_name = {"t": ("t", t), "q": (names.coordinates, q), "u": (names.speeds, u)}

    values = {symbol("t"): t, **{symbol(k): x for k, x in zip(names.state, (*q, *u), strict=True)}}

    def converted(what: str, fun: Any, arguments: str) -> tuple[Any, ...]:
        symbols, numbers = zip(*(by_name[letter] for letter in arguments), strict=True)
        found = traced(what, fun, *symbols).ravel()
        wanted = np.asarray(fun(*numbers), float).ravel()
        own = np.array([float(sympy.sympify(item).xreplace(values)) for item in found])
        if not np.allclose(own, wanted, rtol=AGREES, atol=AGREES * max(1.0, np.abs(wanted).max(initial=0.0))):
            raise NotTraceableError(f"{what}: its value depends on more than its arguments")
        return tuple(found)

    def expressions(what: str, arguments: str) -> tuple[Any, ...]:
        fun = getattr(given, what)
        return () if fun is None else converted(what, fun, arguments)

    speeds = [symbol(name) for name in names.speeds]
    system = Constrained(
        names.coordinates,
        names.speeds,
        (),
        expressions("kinematics", "tqu") or tuple(speeds),
        expressions("mass", "q"),
        expressions("forces", "tqu"),
        expressions("constraints", "tq"),
        expressions("velocity_constraints", "tqu"),
    ).with_velocities()
    power = (expressions("power", "tqu") or (None,))[0]
    energies = []
    M, column = sympy.Matrix(len(speeds), len(speeds), system.mass), sympy.Matrix(speeds)
    kinetic = (column.T * M * column)[0] / 2
    if given.energy is not None:
        energies.append(("energy", expressions("energy", "tqu")[0], power))
    elif given.potential is not None:
        energies.append(("u M u / 2 + potential", kinetic + expressions("potential", "tq")[0], power))
    elif (potential := conservative(system, system.forces, partial(own_speed, system))) is not None:
        energies.append(("u M u / 2 + the potential of the forces", kinetic + potential, power))
    try:
        outputs = [(name, converted(name, fun, "tqu")[0]) for name, fun in given.outputs.items()]
    except NotTraceableError:
        outputs = []
    parts = parts_of(system, energies, tuple(_momenta(system)), outputs)
    called = given.outputs and parts.outputs is None
    return parts._replace(outputs=outputs_as_given(given, q.size, u.size)) if called else parts


def _momenta(system: Constrained) -> Iterator[tuple[str, Any]]:
    """Yield the name and the expression of the momentum of each coordinate that may be cyclic."""
    n = len(system.speeds)
    momenta = sympy.Matrix(n, n, system.mass) * sympy.Matrix([symbol(name) for name in system.speeds])
    for k in cyclic(system, partial(own_speed, system)):
        yield f"p_{system.coordinates[k]}", sympy.Matrix([own_speed(system, k)]).dot(momenta)
