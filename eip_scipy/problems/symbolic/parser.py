"""Expressions from text: Python's grammar, of which a short list of nodes, operators and functions is let through.

Nothing of the text is ever run. SymPy's own reader (`sympify`, `parse_expr`) calls `eval` and takes E, I, S, N, Q, beta
and gamma for objects of its own; here every name that is not called is the user's, and pi too if the user declares it.
"""

from __future__ import annotations

import ast
import keyword
import math
import re
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import sympy
from sympy.core.function import AppliedUndef

from .sizes import TooLargeError, require_constant, require_function, require_power, require_product, require_sum

__all__ = ["as_expression", "as_names", "symbol"]

TIME = sympy.Symbol("t")  # of dynamicsymbols
ONE_ARGUMENT = (
    "sqrt", "cbrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
    "atanh", "erf", "sign",
)  # fmt: skip
FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    **{name: (getattr(sympy, name), 1) for name in ONE_ARGUMENT},
    **{name.replace("a", "arc", 1): (getattr(sympy, name), 1) for name in ONE_ARGUMENT if name.startswith("a")},
    "ln": (sympy.log, 1),
    "abs": (sympy.Abs, 1),
    "atan2": (sympy.atan2, 2),
    "arctan2": (sympy.atan2, 2),
    "hypot": (lambda x, y: sympy.sqrt(x**2 + y**2), 2),
    "max": (sympy.Max, 2),
    "min": (sympy.Min, 2),
}
ALLOWED = f"numbers, names, pi, + - * / **, parentheses, and the functions {', '.join(sorted(FUNCTIONS))}"
LONGEST = 200_000
DEEPEST = 100
LARGEST_SIZE = 20_000  # operations
LARGEST_EXPONENT = 1000
LARGEST = sympy.Integer(10) ** 300


def symbol(name: str) -> sympy.Symbol:
    """The symbol of a name; real, so that sqrt(x**2) is abs(x)."""
    return sympy.Symbol(name, real=True)


def as_names(what: str, names: Any) -> tuple[str, ...]:
    """Names from "x y", "x, y", or a sequence of strings, SymPy symbols and dynamicsymbols.

    Raises
    ------
    ValueError
        If it is not a name, or occurs twice.
    """
    items = names.replace(",", " ").split() if isinstance(names, str) else _items(what, names)
    found = tuple(_name(what, item) for item in items)
    twice = next((name for k, name in enumerate(found) if name in found[:k]), None)
    if twice is not None:
        raise ValueError(f"{what}: {twice!r} stands twice in {', '.join(found)}.")
    if "t" in found:
        raise ValueError(f"{what}: t is the time; give the variable another name.")
    return found


def as_expression(what: str, given: Any, declared: Iterable[str] = ()) -> sympy.Expr:
    """A SymPy expression in real symbols from text, a number or an expression of SymPy's.

    A name that is `declared`, as a component of the state or a parameter, is neither a constant nor a function.

    Raises
    ------
    TypeError, ValueError
        Naming what came, `what` it is, and what is allowed.
    """
    if isinstance(given, str):
        found = Reader(what, given, declared).read()
    elif isinstance(given, (bool, complex)) or not isinstance(given, (int, float, sympy.Expr)):
        raise TypeError(f"{what}: expected an expression, as text or of SymPy's, got {_cut(given)}.")
    else:
        found = _with_real_symbols(what, sympy.sympify(given))  # a number or an expression: no text reaches sympify
    if found.has(sympy.I, sympy.nan, sympy.zoo, sympy.oo, -sympy.oo):
        raise ValueError(f"{what}: {_cut(given)} is {_cut(found)}; expected a finite real expression.")
    return found


def _items(what: str, names: Any) -> list[Any]:
    if isinstance(names, sympy.Symbol | AppliedUndef):
        return [names]
    if not isinstance(names, Iterable):
        raise TypeError(f"{what}: expected names, as 'x y' or ['x', 'y'], got {_cut(names)}.")
    return list(names)


def _name(what: str, item: Any) -> str:
    if isinstance(item, sympy.Symbol):
        item = item.name
    elif isinstance(item, AppliedUndef) and item.args == (TIME,):
        item = item.func.__name__
    if not isinstance(item, str):
        raise TypeError(f"{what}: expected names, as 'x y' or ['x', 'y'], got {_cut(item)} among them.")
    if not item.isidentifier() or keyword.iskeyword(item):
        raise ValueError(f"{what}: {_cut(item)} is not a name; use letters, digits and _, and no keyword of Python.")
    return str(ast.parse(item, mode="eval").body.id)  # type: ignore[attr-defined]  # as Python spells it in expressions


def _is_float(number: sympy.Expr) -> bool:
    """Return True if it is real and a float can represent it."""
    value = number if isinstance(number, sympy.Rational) else sympy.N(number)
    return bool(value == 0 or ((value.is_Float or value.is_Rational) and 1 / LARGEST < abs(value) < LARGEST))


def _cut(value: Any) -> str:
    text = " ".join((repr(value) if isinstance(value, str) else str(value)).split())
    return text if len(text) <= 120 else f"{text[:120]}..."


def _with_real_symbols(what: str, given: sympy.Expr) -> sympy.Expr:
    if derivatives := given.atoms(sympy.Derivative):
        raise ValueError(
            f"{what}: it contains {_cut(min(derivatives, key=str))}; expected an expression of the state without "
            "derivatives. equations takes those of components of the state."
        )
    functions = {item for item in given.atoms(AppliedUndef) if item.args == (TIME,)}
    if functions:
        symbols = given.xreplace({item: sympy.Dummy() for item in functions}).free_symbols
        symbols = sorted({*functions, *(item for item in symbols if not isinstance(item, sympy.Dummy))}, key=str)
    else:
        symbols = sorted(given.free_symbols, key=str)
    names = [_name(what, item) for item in symbols]
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise ValueError(f"{what}: it has two different symbols called {twice}.")
    return given.xreplace({item: symbol(name) for item, name in zip(symbols, names, strict=True)})


class Reader:
    """One text, read once."""

    def __init__(self, what: str, text: str, declared: Iterable[str] = ()) -> None:
        self.what, self.text = what, " ".join(text.split())  # it may go over several lines
        self.declared = frozenset(declared)
        self.compared = 0  # values in max and min

    def read(self) -> sympy.Expr:
        """The expression."""
        if not self.text or len(self.text) > LONGEST:
            raise ValueError(f"{self.what}: expected an expression of 1 to {LONGEST} characters, got {len(self.text)}.")
        if "#" in self.text:  # Python would leave out what follows, which once was on other lines
            raise ValueError(f"{self.what}: {_cut(self.text)} has a comment. Allowed are {ALLOWED}.")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", (SyntaxWarning, DeprecationWarning))  # of odd numbers: "1or 2"
                tree = ast.parse(self.text, mode="eval")
        except SyntaxError as error:
            raise ValueError(f"{self.what}: {_cut(self.text)} is not an expression: {self._mistake(error)}") from None
        except (RecursionError, MemoryError):
            raise ValueError(
                f"{self.what}: {_cut(self.text)} is too long or nests too deep for Python's parser; put parts of long "
                "sums in parentheses, or give it as a SymPy expression."
            ) from None
        size = sum(isinstance(node, ast.operator | ast.unaryop | ast.Call) for node in ast.walk(tree))
        if size > LARGEST_SIZE:
            raise ValueError(
                f"{self.what}: {_cut(self.text)} has {size} operations, more than {LARGEST_SIZE}. Write the "
                "functions of a system of this size by hand."
            )
        return self._expression(tree.body, 0)

    def _mistake(self, error: SyntaxError) -> str:
        words = [word for word in re.findall(r"[^\W\d]\w*", self.text) if keyword.iskeyword(word)]
        if words:
            return f"{words[0]} is a word of Python's; call it otherwise ({words[0][:3]}, {words[0]}_)."
        return f"{error.msg}. Allowed are {ALLOWED}."

    def _refuse(self, node: ast.AST, why: str) -> ValueError:
        part = ast.get_source_segment(self.text, node) or type(node).__name__
        return ValueError(f"{self.what}: {_cut(part)} {why}. Allowed are {ALLOWED}.")

    def _expression(self, node: ast.expr, depth: int) -> sympy.Expr:
        if depth > DEEPEST:
            raise ValueError(f"{self.what}: {_cut(self.text)} nests more than {DEEPEST} deep.")
        try:
            found = self._converted(node, depth)
            if found.is_number:
                require_constant(found)
        except TooLargeError as error:
            raise self._refuse(node, str(error)) from None
        # At every level: what is built from numbers that floats hold stays small enough to be computed at once.
        if found.is_number and not _is_float(found):
            raise self._refuse(node, "is not a number that a float can represent")
        return found

    def _converted(self, node: ast.expr, depth: int) -> sympy.Expr:
        match node:
            case ast.Constant():
                return self._number(node)
            case ast.Name():
                return sympy.pi if node.id == "pi" and "pi" not in self.declared else symbol(node.id)
            case ast.UnaryOp(op=ast.UAdd()):
                return self._expression(node.operand, depth + 1)
            case ast.UnaryOp(op=ast.USub()):
                return -self._expression(node.operand, depth + 1)
            case ast.BinOp(op=ast.Add() | ast.Sub()):
                terms = self._chain(node, (ast.Add, ast.Sub), lambda x: -x, depth)
                require_sum(terms)
                return sympy.Add(*terms)
            case ast.BinOp(op=ast.Mult() | ast.Div()):
                factors = self._chain(node, (ast.Mult, ast.Div), lambda x: x**-1, depth)
                require_product(factors)
                return sympy.Mul(*factors)
            case ast.BinOp(op=ast.Pow()):
                return self._power(node, depth)
            case ast.Call():
                return self._call(node, depth)
            case ast.BinOp(op=ast.BitXor()):
                raise self._refuse(node, "has ^; powers are written **")
        raise self._refuse(node, "is not allowed")

    def _chain(self, node: ast.expr, pair: tuple[type, type], inverse: Any, depth: int) -> list[sympy.Expr]:
        """The operands of a + b - c, or of a * b / c, which nest to the left as deep as the chain is long."""
        found = []
        while isinstance(node, ast.BinOp) and isinstance(node.op, pair):
            item = self._expression(node.right, depth + 1)
            found.append(inverse(item) if isinstance(node.op, pair[1]) else item)
            node = node.left
        found.append(self._expression(node, depth + 1))
        return found[::-1]

    def _number(self, node: ast.Constant) -> sympy.Expr:
        value: Any = node.value
        if type(value) not in (int, float):
            raise self._refuse(node, "is not a real number")
        if abs(value) > LARGEST:
            raise self._refuse(node, "is too large")
        # Decimals as the user wrote them, 0.1 as 1/10: sums of constants and cancellations are exact.
        return sympy.Rational(repr(value)) if isinstance(value, float) else sympy.Integer(value)

    def _power(self, node: ast.BinOp, depth: int) -> sympy.Expr:
        base, exponent = self._expression(node.left, depth + 1), self._expression(node.right, depth + 1)
        if exponent.is_number:
            size = abs(float(exponent))
            if size > LARGEST_EXPONENT:
                raise self._refuse(node.right, f"is an exponent beyond {LARGEST_EXPONENT}")
            if base.is_number and base != 0 and size * abs(math.log(abs(float(base)))) > math.log(LARGEST):
                raise self._refuse(node, "is too large, or too small")
        require_power(base, exponent)
        return base**exponent

    def _call(self, node: ast.Call, depth: int) -> sympy.Expr:
        name = node.func.id if isinstance(node.func, ast.Name) else None
        if name in self.declared:
            raise self._refuse(node, f"calls {name}, a component or parameter here; rename that to call {name}")
        if name not in FUNCTIONS:
            raise self._refuse(node.func, "is not a known function")
        function, count = FUNCTIONS[name]
        if node.keywords or len(node.args) != count:
            raise self._refuse(node, f"is not as {name} is called, with {count} argument{'s' * (count > 1)}")
        arguments = [self._expression(item, depth + 1) for item in node.args]
        self.compared = require_function(function.__name__.lower(), arguments, self.compared)
        return function(*arguments)
