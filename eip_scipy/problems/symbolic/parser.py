"""Expressions from text in Python's grammar, of which a short list of nodes, operators and functions is allowed.

The text is never executed, unlike in SymPy's `sympify`, which also reads E, I, S, N and beta as its own objects. Here
every name that is not called is a symbol of the user, even pi if the user declares it.
"""

from __future__ import annotations

import ast
import keyword
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import sympy
from sympy.core.function import AppliedUndef

from ...core.inputs import shown

__all__ = ["LARGEST", "TIME", "as_expression", "as_mapping", "as_names", "cbrt", "symbol", "with_powers_of_roots"]


class cbrt(sympy.Function):  # noqa: N801  # expressions show this name
    """Real cube root, -2 for -8; SymPy's function of this name is the power 1/3, which is complex for -8."""

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
    """Return an expression with x**m cbrt(x)**n written as cbrt(x)**(3 m + n), so that x/cbrt(x)**2 is 0 at x = 0."""
    return (
        expression.replace(lambda item: item.is_Mul and item.has(cbrt), _merged) if expression.has(cbrt) else expression
    )


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
    **{f"arc{name[1:]}": (getattr(sympy, name), 1) for name in ONE_ARGUMENT if name.startswith("a")},
    "ln": (sympy.log, 1), "cbrt": (cbrt, 1), "abs": (sympy.Abs, 1), "max": (sympy.Max, 2), "min": (sympy.Min, 2),
    "atan2": (sympy.atan2, 2), "arctan2": (sympy.atan2, 2), "hypot": (lambda x, y: sympy.sqrt(x**2 + y**2), 2),
}  # fmt: skip
CHAINS = {ast.Add: sympy.Add, ast.Sub: sympy.Add, ast.Mult: sympy.Mul, ast.Div: sympy.Mul}
ALLOWED = f"numbers, names, pi, + - * / **, parentheses, and the functions {', '.join(sorted(FUNCTIONS))}"
LARGEST_EXPONENT, LARGEST = 1000, 10**300


def symbol(name: str) -> sympy.Symbol:
    """Return the symbol of a name. It is real, so that sqrt(x**2) is abs(x)."""
    return sympy.Symbol(name, real=True)


def as_mapping(what: str, given: Any) -> dict[Any, Any]:
    """Return a mapping as a dictionary, {} for None; raise TypeError for other objects."""
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(f"{what} must be a mapping of names to values or expressions, got {shown(given)}.")
    return dict(given or {})


def as_names(what: str, names: Any) -> tuple[str, ...]:
    """Return the names in "x y", "x, y", or a sequence of strings, SymPy symbols and dynamicsymbols.

    An error that begins with `what` is raised if an item is not a name, is t, or occurs twice.
    """
    if isinstance(names, str):
        names = names.replace(",", " ").split()
    elif isinstance(names, sympy.Symbol | AppliedUndef):
        names = [names]
    elif not isinstance(names, Iterable):
        raise TypeError(f"{what}: expected names, as 'x y' or ['x', 'y'], got {shown(names)}.")
    found = tuple(_name(what, item) for item in names)
    for k, name in enumerate(found):
        if name in found[:k]:
            raise ValueError(f"{what}: {name!r} occurs twice in {', '.join(found)}; expected different names.")
    if "t" in found:
        raise ValueError(f"{what}: t is the time; give the variable another name.")
    return found


def as_expression(what: str, given: Any, declared: Iterable[str] = ()) -> sympy.Expr:
    """Return a SymPy expression in real symbols from text, a number or a SymPy expression.

    A name in `declared`, such as a component of the state or a parameter, is neither a constant nor a function. An
    error that begins with `what` is raised if `given` is not such an expression.
    """
    if isinstance(given, str):
        found = _Reader(what, given, declared).read()
    elif isinstance(given, (bool, complex)) or not isinstance(given, (int, float, sympy.Expr)):
        raise TypeError(f"{what}: expected an expression, as text or from SymPy, got {shown(given)}.")
    else:
        found = _with_real_symbols(what, sympy.sympify(given))  # a number or an expression: no text reaches sympify
    if found.has(sympy.I, sympy.nan, sympy.zoo, sympy.oo, -sympy.oo):
        raise ValueError(f"{what}: {shown(given)} is {shown(found)}; expected a finite real expression.")
    return found


def _name(what: str, item: Any) -> str:
    if isinstance(item, sympy.Symbol):
        item = item.name
    elif isinstance(item, AppliedUndef) and item.args == (TIME,):
        item = item.func.__name__
    if not isinstance(item, str):
        raise TypeError(f"{what}: expected names, as 'x y' or ['x', 'y'], but one item is {shown(item)}.")
    if not item.isidentifier() or keyword.iskeyword(item):
        raise ValueError(f"{what}: {shown(item)} is not a name; use letters, digits and _, and no keyword of Python.")
    return str(ast.parse(item, mode="eval").body.id)  # type: ignore[attr-defined]  # Python normalises names


def _with_real_symbols(what: str, given: sympy.Expr) -> sympy.Expr:
    if derivatives := given.atoms(sympy.Derivative):
        raise ValueError(
            f"{what}: the expression contains {shown(min(derivatives, key=str))}; expected an expression of the state "
            "without derivatives. Only `equations` accepts derivatives of components of the state."
        )
    functions = {item: sympy.Dummy() for item in given.atoms(AppliedUndef) if item.args == (TIME,)}
    free = given.xreplace(functions).free_symbols - set(functions.values())
    by_name: dict[str, sympy.Expr] = {}
    for item in (*functions, *free):
        if by_name.setdefault(name := _name(what, item), item) != item:
            raise ValueError(f"{what}: the expression has two different symbols called {name}; rename one.")
    return given.xreplace({item: symbol(name) for name, item in by_name.items()})


class _Reader:
    """Converter of one text to a SymPy expression; names in `declared` are neither constants nor functions."""

    def __init__(self, what: str, text: str, declared: Iterable[str]) -> None:
        self.what, self.text = what, " ".join(text.split())  # the text may have several lines
        self.declared = frozenset(declared)

    def read(self) -> sympy.Expr:
        try:
            if "#" in self.text or "\0" in self.text:  # Python would ignore the text after #
                raise SyntaxError("it has a comment or a null character")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", (SyntaxWarning, DeprecationWarning))  # for text such as "1or 2"
                return self._expression(ast.parse(self.text, mode="eval").body)
        except SyntaxError as error:
            words = [word for word in re.findall(r"[^\W\d]\w*", self.text) if keyword.iskeyword(word)]
            why = f"{words[0]} is a keyword of Python; use another name" if words else error.msg
            raise ValueError(
                f"{self.what}: {shown(self.text)} is not an expression: {why}. Allowed are {ALLOWED}."
            ) from None
        except (RecursionError, MemoryError):
            raise ValueError(
                f"{self.what}: {shown(self.text)} is too long or nests too deep; put parts of long sums in "
                "parentheses, or give it as a SymPy expression."
            ) from None

    def _refuse(self, node: ast.AST, why: str) -> ValueError:
        part = ast.get_source_segment(self.text, node) or type(node).__name__
        return ValueError(f"{self.what}: {shown(part)} {why}. Allowed are {ALLOWED}.")

    def _expression(self, node: ast.expr) -> sympy.Expr:
        found = self._converted(node)
        # Checked at every level: an operation on numbers that floats can represent takes no time.
        if found.is_number and found != 0:
            value = found if found.is_Rational else sympy.N(found)
            if not ((value.is_Float or value.is_Rational) and 1 / LARGEST < abs(value) < LARGEST):
                raise self._refuse(node, "is not a number that a float can represent")
        return found

    def _converted(self, node: ast.expr) -> sympy.Expr:
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool) and abs(value) < LARGEST:
                # Decimals are read exactly, 0.1 as 1/10, so that sums and cancellations of constants are exact.
                return sympy.Rational(repr(value)) if isinstance(value, float) else sympy.Integer(value)
            case ast.Name(id=name):
                return sympy.pi if name == "pi" and name not in self.declared else symbol(name)
            case ast.UnaryOp(op=ast.UAdd() | ast.USub() as sign):
                found = self._expression(node.operand)
                return -found if isinstance(sign, ast.USub) else found
            case ast.BinOp(op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div() as op):
                return self._chain(node, CHAINS[type(op)])
            case ast.BinOp(op=ast.Pow()):
                return self._power(node)
            case ast.Call():
                return self._call(node)
            case ast.BinOp(op=ast.BitXor()):
                raise self._refuse(node, "has ^; powers are written **")
        raise self._refuse(node, "is not allowed")

    def _chain(self, node: ast.expr, made: Any) -> sympy.Expr:
        """Return the sum or product of the operands of a chain such as a + b - c, which is nested to the left."""
        found = []
        while isinstance(node, ast.BinOp) and CHAINS.get(type(node.op)) is made:
            item = self._expression(node.right)
            found.append(-item if isinstance(node.op, ast.Sub) else 1 / item if isinstance(node.op, ast.Div) else item)
            node = node.left
        return made(self._expression(node), *found[::-1])

    def _power(self, node: ast.BinOp) -> sympy.Expr:
        base, exponent = self._expression(node.left), self._expression(node.right)
        if exponent.is_number and abs(exponent) > LARGEST_EXPONENT:
            raise self._refuse(node.right, f"is an exponent above {LARGEST_EXPONENT} in size")
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
