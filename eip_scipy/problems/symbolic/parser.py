"""Expressions from text in Python's grammar, of which a short list of nodes, operators and functions is allowed.

The text is never executed. SymPy's own parser (`sympify`, `parse_expr`) calls `eval` and reads E, I, S, N, Q, beta and
gamma as its own objects. Here every name that is not called is a symbol of the user, even pi if the user declares it.
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

__all__ = ["as_expression", "as_names", "cbrt", "symbol", "with_powers_of_roots"]


class cbrt(sympy.Function):  # noqa: N801  # expressions show this name
    """Real cube root of a real argument, as NumPy's ``cbrt``: -2 for -8.

    SymPy's function of this name is the power 1/3, which is not real for a negative number.
    """

    nargs = 1

    @classmethod
    def eval(cls, x: Any) -> Any:
        """Return the root as a power if the sign of x is known, or without a factor of x; None to leave it as it is."""
        if x.is_extended_nonnegative:
            return x ** sympy.Rational(1, 3)
        if x.is_extended_nonpositive or x.could_extract_minus_sign():
            return -cls(-x)
        factor, rest = x.as_coeff_Mul(rational=True)
        return None if factor == 1 else factor ** sympy.Rational(1, 3) * cls(rest)

    def fdiff(self, argindex: int = 1) -> Any:
        """Return the derivative."""
        return 1 / (3 * self**2)

    def _eval_is_real(self) -> Any:
        return self.args[0].is_real

    def _eval_power(self, exponent: Any) -> Any:
        # Reciprocals are left, so that they cancel in derivatives: those of cbrt(x)**4 are finite at 0.
        whole = exponent.is_Integer and exponent > 0 and exponent % 3 == 0
        return self.args[0] ** (exponent / 3) if whole else None


def with_powers_of_roots(expression: Any) -> Any:
    """Return an expression with x**m cbrt(x)**n in products written as cbrt(x)**(3 m + n).

    The derivative of x cbrt(x) contains x/cbrt(x)**2, which would be NaN at 0.
    """
    if not expression.has(cbrt):
        return expression
    return expression.replace(lambda item: item.is_Mul and item.has(cbrt), _merged)


def _merged(product: Any) -> Any:
    powers = product.as_powers_dict()
    for root in [item for item in powers if isinstance(item, cbrt)]:
        n, m = powers[root], powers.get(root.args[0], sympy.Integer(0))
        if n.is_Integer and m.is_Integer and m != 0:
            product = product / (root**n * root.args[0] ** m) * root ** (3 * m + n)
    return product


TIME = sympy.Symbol("t")  # the time in dynamicsymbols
ONE_ARGUMENT = (
    "sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
    "atanh", "erf", "sign",
)  # fmt: skip
FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    **{name: (getattr(sympy, name), 1) for name in ONE_ARGUMENT},
    **{name.replace("a", "arc", 1): (getattr(sympy, name), 1) for name in ONE_ARGUMENT if name.startswith("a")},
    "ln": (sympy.log, 1),
    "cbrt": (cbrt, 1),
    "abs": (sympy.Abs, 1),
    "atan2": (sympy.atan2, 2),
    "arctan2": (sympy.atan2, 2),
    "hypot": (lambda x, y: sympy.sqrt(x**2 + y**2), 2),
    "max": (sympy.Max, 2),
    "min": (sympy.Min, 2),
}
ALLOWED = f"numbers, names, pi, + - * / **, parentheses, and the functions {', '.join(sorted(FUNCTIONS))}"
LARGEST_EXPONENT = 1000
LARGEST = sympy.Integer(10) ** 300


def symbol(name: str) -> sympy.Symbol:
    """Return the symbol of a name. It is real, so that sqrt(x**2) is abs(x)."""
    return sympy.Symbol(name, real=True)


def as_names(what: str, names: Any) -> tuple[str, ...]:
    """Return the names in "x y", "x, y", or a sequence of strings, SymPy symbols and dynamicsymbols.

    An error that begins with `what` is raised if an item is not a name, is t, or occurs twice.
    """
    items = names.replace(",", " ").split() if isinstance(names, str) else _items(what, names)
    found = tuple(_name(what, item) for item in items)
    twice = next((name for k, name in enumerate(found) if name in found[:k]), None)
    if twice is not None:
        raise ValueError(f"{what}: {twice!r} occurs twice in {', '.join(found)}; expected different names.")
    if "t" in found:
        raise ValueError(f"{what}: t is the time; give the variable another name.")
    return found


def as_expression(what: str, given: Any, declared: Iterable[str] = ()) -> sympy.Expr:
    """Return a SymPy expression in real symbols from text, a number or a SymPy expression.

    A name in `declared`, such as a component of the state or a parameter, is neither a constant nor a function. An
    error that begins with `what` is raised if `given` is not such an expression.
    """
    if isinstance(given, str):
        found = Reader(what, given, declared).read()
    elif isinstance(given, (bool, complex)) or not isinstance(given, (int, float, sympy.Expr)):
        raise TypeError(f"{what}: expected an expression, as text or from SymPy, got {_cut(given)}.")
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
        raise TypeError(f"{what}: expected names, as 'x y' or ['x', 'y'], but one item is {_cut(item)}.")
    if not item.isidentifier() or keyword.iskeyword(item):
        raise ValueError(f"{what}: {_cut(item)} is not a name; use letters, digits and _, and no keyword of Python.")
    return str(ast.parse(item, mode="eval").body.id)  # type: ignore[attr-defined]  # Python normalises names


def _is_float(number: sympy.Expr) -> bool:
    """Return True if a number is real and a float can represent it."""
    value = number if isinstance(number, sympy.Rational) else sympy.N(number)
    return bool(value == 0 or ((value.is_Float or value.is_Rational) and 1 / LARGEST < abs(value) < LARGEST))


def _cut(value: Any) -> str:
    text = " ".join((repr(value) if isinstance(value, str) else str(value)).split())
    return text if len(text) <= 120 else f"{text[:120]}..."


def _with_real_symbols(what: str, given: sympy.Expr) -> sympy.Expr:
    if derivatives := given.atoms(sympy.Derivative):
        raise ValueError(
            f"{what}: the expression contains {_cut(min(derivatives, key=str))}; expected an expression of the state "
            "without derivatives. Only `equations` accepts derivatives of components of the state."
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
        raise ValueError(f"{what}: the expression has two different symbols called {twice}; rename one.")
    return given.xreplace({item: symbol(name) for item, name in zip(symbols, names, strict=True)})


class Reader:
    """Converter of one text to a SymPy expression; names in `declared` are neither constants nor functions."""

    def __init__(self, what: str, text: str, declared: Iterable[str] = ()) -> None:
        self.what, self.text = what, " ".join(text.split())  # the text may have several lines
        self.declared = frozenset(declared)

    def read(self) -> sympy.Expr:
        """Return the expression."""
        if "\0" in self.text:  # Python 3.11 before 3.11.4 and later versions refuse it in different ways
            raise ValueError(f"{self.what}: {_cut(self.text)} has a null character. Allowed are {ALLOWED}.")
        if "#" in self.text:  # Python would ignore all of the text that follows
            raise ValueError(f"{self.what}: {_cut(self.text)} has a comment. Allowed are {ALLOWED}.")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", (SyntaxWarning, DeprecationWarning))  # for text such as "1or 2"
                return self._expression(ast.parse(self.text, mode="eval").body)
        except SyntaxError as error:
            raise ValueError(f"{self.what}: {_cut(self.text)} is not an expression: {self._mistake(error)}") from None
        except (RecursionError, MemoryError):
            raise ValueError(
                f"{self.what}: {_cut(self.text)} is too long or nests too deep; put parts of long sums in parentheses, "
                "or give it as a SymPy expression."
            ) from None

    def _mistake(self, error: SyntaxError) -> str:
        words = [word for word in re.findall(r"[^\W\d]\w*", self.text) if keyword.iskeyword(word)]
        if words:
            return f"{words[0]} is a keyword of Python; use another name, such as {words[0][:3]} or {words[0]}_."
        return f"{error.msg}. Allowed are {ALLOWED}."

    def _refuse(self, node: ast.AST, why: str) -> ValueError:
        part = ast.get_source_segment(self.text, node) or type(node).__name__
        return ValueError(f"{self.what}: {_cut(part)} {why}. Allowed are {ALLOWED}.")

    def _expression(self, node: ast.expr) -> sympy.Expr:
        found = self._converted(node)
        # Checked at every level: an operation on numbers that floats can represent takes no time.
        if found.is_number and not _is_float(found):
            raise self._refuse(node, "is not a number that a float can represent")
        return found

    def _converted(self, node: ast.expr) -> sympy.Expr:
        match node:
            case ast.Constant():
                return self._number(node)
            case ast.Name():
                return sympy.pi if node.id == "pi" and "pi" not in self.declared else symbol(node.id)
            case ast.UnaryOp(op=ast.UAdd()):
                return self._expression(node.operand)
            case ast.UnaryOp(op=ast.USub()):
                return -self._expression(node.operand)
            case ast.BinOp(op=ast.Add() | ast.Sub()):
                return sympy.Add(*self._chain(node, (ast.Add, ast.Sub), lambda x: -x))
            case ast.BinOp(op=ast.Mult() | ast.Div()):
                return sympy.Mul(*self._chain(node, (ast.Mult, ast.Div), lambda x: x**-1))
            case ast.BinOp(op=ast.Pow()):
                return self._power(node)
            case ast.Call():
                return self._call(node)
            case ast.BinOp(op=ast.BitXor()):
                raise self._refuse(node, "has ^; powers are written **")
        raise self._refuse(node, "is not allowed")

    def _chain(self, node: ast.expr, pair: tuple[type, type], inverse: Any) -> list[sympy.Expr]:
        """Return the operands of a chain such as a + b - c, nested left; `inverse` is applied after ``pair[1]``."""
        found = []
        while isinstance(node, ast.BinOp) and isinstance(node.op, pair):
            item = self._expression(node.right)
            found.append(inverse(item) if isinstance(node.op, pair[1]) else item)
            node = node.left
        found.append(self._expression(node))
        return found[::-1]

    def _number(self, node: ast.Constant) -> sympy.Expr:
        value: Any = node.value
        if type(value) not in (int, float):
            raise self._refuse(node, "is not a real number")
        if abs(value) > LARGEST:
            raise self._refuse(node, "is too large")
        # Decimals are read exactly, 0.1 as 1/10, so that sums and cancellations of constants are exact.
        return sympy.Rational(repr(value)) if isinstance(value, float) else sympy.Integer(value)

    def _power(self, node: ast.BinOp) -> sympy.Expr:
        base, exponent = self._expression(node.left), self._expression(node.right)
        if exponent.is_number:
            size = abs(float(exponent))
            if size > LARGEST_EXPONENT:
                raise self._refuse(node.right, f"is an exponent above {LARGEST_EXPONENT} in size")
            if base.is_number and base != 0 and size * abs(math.log(abs(float(base)))) > math.log(LARGEST):
                raise self._refuse(node, "is too large, or too small")
        return base**exponent

    def _call(self, node: ast.Call) -> sympy.Expr:
        name = node.func.id if isinstance(node.func, ast.Name) else None
        if name in self.declared:
            raise self._refuse(node, f"calls {name}, which is a component or parameter; rename that to call {name}")
        if name not in FUNCTIONS:
            raise self._refuse(node.func, "is not a known function")
        function, count = FUNCTIONS[name]
        if node.keywords or len(node.args) != count:
            raise self._refuse(node, f"is wrong, because {name} takes {count} argument{'s' * (count > 1)}")
        return function(*map(self._expression, node.args))
