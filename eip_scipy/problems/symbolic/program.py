"""Programs that compute SymPy expressions: statements of one operation each, none of which occurs twice.

A program is text that contains no name of a user: its names are the arguments, variables v0, v1, ..., constants c0,
c1, ... and functions. It runs with three sets of functions: those of math, compiled by Numba; those of NumPy without
Numba; and those of mpmath with 50 digits, by which conserved quantities are examined.
"""

from __future__ import annotations

import builtins
import math
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, reduce
from types import CodeType, FunctionType
from typing import Any, NamedTuple

import mpmath
import numpy as np
import sympy

from ...core.functions import compilable, is_jitted, jitted
from .parser import LARGEST, cbrt, symbol, with_powers_of_roots

__all__ = ["Arguments", "function", "precise", "variational"]

NAMES = (
    "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh",
    "atanh",
)  # fmt: skip
OPERATIONS = {getattr(sympy, name): f"{name}({{0}})" for name in NAMES} | {
    sympy.atan2: "atan2({0}, {1})", sympy.Abs: "abs({0})", sympy.erf: "erf({0})",
    sympy.sec: "1.0 / cos({0})", sympy.csc: "1.0 / sin({0})", sympy.cot: "1.0 / tan({0})",
    sympy.sign: "1.0 if {0} > 0.0 else -1.0 if {0} < 0.0 else 0.0",
    sympy.Heaviside: "1.0 if {0} > 0.0 else 0.0 if {0} < 0.0 else 0.5",
    cbrt: "copysign(abs({0}) ** third, {0})",
    sympy.Lt: "{0} < {1}", sympy.Le: "{0} <= {1}", sympy.Gt: "{0} > {1}", sympy.Ge: "{0} >= {1}",
    sympy.Eq: "{0} == {1}", sympy.Ne: "{0} != {1}", sympy.Not: "not {0}",
}  # fmt: skip
# Operations on two values at a time.
CHAINS = {sympy.Max: "max({}, {})", sympy.Min: "min({}, {})", sympy.And: "{} and {}", sympy.Or: "{} or {}"}
SUPPORTED = ", ".join(sorted(item.__name__ for item in (*OPERATIONS, *CHAINS, sympy.Piecewise)))
LARGEST_PRODUCT = 64  # largest exponent of a square root that is computed by multiplications

COMMON = {name: getattr(builtins, name) for name in ("abs", "max", "min", "range", "ValueError")}
COMMON |= {"erf": math.erf, "nan": math.nan, "third": 1 / 3}
COMPILED = COMMON | {name: getattr(math, name) for name in ("sqrt", "copysign", *NAMES)}
# The functions of math raise an error outside their domain; the NaN of NumPy's shortens the step.
INTERPRETED = COMMON | {name: getattr(np, name) for name in ("sqrt", "copysign", *NAMES)}
MP = mpmath.MPContext()
MP.dps, MP.trap_complex = 50, True  # roots and logarithms of negative numbers raise an error


def _bounded(name: str) -> Callable[..., Any]:
    """Return a function of mpmath with an error for values above 1e300: a sine of a tower of powers takes hours."""
    function = getattr(MP, name)

    def value(*x: Any) -> Any:
        if not abs(found := function(*x)) < LARGEST:
            raise OverflowError
        return found

    return value


PRECISE = COMMON | {name: _bounded(name) for name in ("sqrt", "erf", *NAMES)}
PRECISE |= {"third": MP.mpf(1) / 3, "copysign": lambda x, y: x * MP.sign(y)}


class Arguments(NamedTuple):
    """Names of the entries of the arrays that a function reads: y, params, and dy, the direction of a derivative."""

    y: tuple[str, ...]
    params: tuple[str, ...] = ()
    dy: tuple[str, ...] = ()


@lru_cache(maxsize=512)
def function(
    what: str, expressions: tuple[Any, ...], arguments: Arguments, *, in_place: bool = True, shape: Any = None
) -> Callable[..., Any]:
    """Return a function of ``(t, y[, dy][, out][, params])``, jitted if Numba is installed.

    It fills `out` with the values of the expressions if `in_place`, otherwise it returns the value of the only one. If
    the `shape` of `out` is given, most expressions may be 0, for which there are no statements. `what` describes the
    values in tracebacks and errors. A ValueError is raised if an expression contains a function that is not supported.
    """
    writer = _Writer(what, arguments)
    places = [k for k, item in enumerate(expressions) if shape is None or item != 0]
    values = writer.values([expressions[k] for k in places])
    lines = [] if shape is None else ["out[:] = 0.0"]
    for k, value in zip(places, values, strict=True):
        index = np.unravel_index(k, shape or (len(expressions),))
        lines.append(f"out[{', '.join(map(str, index))}] = {value}" if in_place else f"return {value}")
    return writer.function(lines, in_place)


def precise(
    what: str, expressions: Sequence[Any], arguments: Arguments, params: Sequence[float] = ()
) -> Callable[[np.ndarray], list[Any] | None]:
    """Return a function of a point (y, t) that returns the values of expressions with 50 digits.

    It returns None if a value or an intermediate result is not finite and real.
    """
    writer = _Writer(what, arguments)
    writer.checks = []  # arrays are lists
    code = writer.code([f"return [{', '.join(writer.values(expressions))}]"], in_place=False)
    call = FunctionType(code, PRECISE | {name: MP.convert(item.evalf(60)) for item, name in writer.constants.items()})
    extra = [[MP.mpf(x) for x in params]] if params else []

    def value(point: np.ndarray) -> list[Any] | None:
        *y, t = map(MP.mpf, point.tolist())
        try:
            found = call(t, y, *extra)
        except (ValueError, ArithmeticError):
            return None
        return found if all(map(MP.isfinite, found)) else None

    return value


@lru_cache(maxsize=64)
def variational(
    rates: tuple[Any, ...],
    jacobian: tuple[tuple[int, int, Any], ...],
    by_parameters: tuple[tuple[tuple[int, Any], ...], ...],
    arguments: Arguments,
) -> Callable[..., None]:
    """Return a function of ``(t, Y, out[, params])`` that fills `out` with dY/dt.

    Y is the state, n numbers, followed by columns of derivatives, n numbers each. The rates of the state agree bit by
    bit with those of `function`, because their statements come first. `jacobian` holds the nonzero derivatives of the
    rates as (row, column, expression). `by_parameters` holds, for each of the last columns, those with respect to its
    parameter as (row, expression).
    """
    n, count, writer = len(rates), len(by_parameters), _Writer("variational equations", arguments)
    state = writer.values(rates)
    slopes = iter(writer.values([item for *_, item in (*jacobian, *(x for column in by_parameters for x in column))]))
    products: dict[int, list[str]] = {i: [] for i in range(n)}
    for i, j, _ in jacobian:
        products[i].append(f"{next(slopes)} * d{j}")
    text = f"y must hold the state and columns of derivatives, {n} numbers each, and at least {count} columns"
    writer.checks = [
        f"if y.size % {n} != 0 or y.size < {n * (count + 1)}: raise ValueError({text!r})",
        "if out.size != y.size: raise ValueError('out must be as long as y')",
        *_checks(arguments._replace(y=())),
    ]
    lines = [
        *(f"out[{i}] = {x}" for i, x in enumerate(state)),
        f"for k in range({n}, y.size, {n}):",
        # The column of y is read first, because compiled code would read it again after each number that it writes.
        *(f"    d{j} = y[k + {j}]" for j in sorted({j for _, j, _ in jacobian})),
        *(f"    out[k + {i}] = {' + '.join(terms) or 0.0}" for i, terms in products.items()),
    ]
    for behind, column in zip(range(count, 0, -1), by_parameters, strict=True):
        lines += [f"out[y.size - {behind * n - i}] += {next(slopes)}" for i, _ in column]
    return writer.function(lines)


def _checks(arguments: Arguments) -> list[str]:
    """Return statements that check the sizes of arrays, because compiled code does not check indices."""
    lines = []
    for array, names in arguments._asdict().items():
        text = f"{array} must hold as many numbers as there are names in ({', '.join(names)}): {len(names)}"
        lines += [f"if {array}.size != {len(names)}: raise ValueError({text!r})"] * bool(names)
    return lines


class _Writer:
    """Writer of functions that compute expressions; `constants` holds the names of constants by value."""

    def __init__(self, what: str, arguments: Arguments) -> None:
        self.what, self.arguments, self.checks = what, arguments, _checks(arguments)
        self.constants: dict[Any, str] = {}
        self._body: list[str] = []
        self._places = {
            name: f"{array}[{k}]" for array, names in arguments._asdict().items() for k, name in enumerate(names)
        }
        self._known: dict[Any, str] = {symbol("t"): "t"}  # names of values
        self._variables: dict[str, str] = {}  # by operation
        self._common: dict[Any, Any] = {}  # symbols of `cse` and their expressions

    def code(self, lines: Sequence[str], in_place: bool) -> CodeType:
        """Return the code of a function: checks, the statements that were written, and `lines`."""
        given = {"dy": self.arguments.dy, "out": in_place, "params": self.arguments.params}
        names = ", ".join(["t", "y", *(name for name, there in given.items() if there)])
        source = "\n    ".join([f"def written({names}):", *self.checks, *self._body, *lines])
        return next(x for x in compile(source, f"<{self.what}>", "exec").co_consts if isinstance(x, CodeType))

    def function(self, lines: Sequence[str], in_place: bool = True) -> Callable[..., Any]:
        """Return the function that ends with the statements `lines`, jitted if Numba is installed."""
        code, numbers = self.code(lines, in_place), {name: float(item) for item, name in self.constants.items()}
        numbers |= {"__name__": __name__, "__builtins__": {}}  # type: ignore[dict-item]
        fast = jitted(compilable(FunctionType(code, COMPILED | numbers)))
        return fast if is_jitted(fast) else FunctionType(code, INTERPRETED | numbers)

    def values(self, expressions: Sequence[Any]) -> list[str]:
        """Write statements that compute expressions; return the names of their values."""
        written = [with_powers_of_roots(item) for item in expressions]
        common, reduced = sympy.cse(written, symbols=sympy.numbered_symbols(cls=sympy.Dummy), list=True)
        for name, expression in common:
            self._common[name] = expression
            self._known[name] = self._value(expression)
        return [self._value(expression) for expression in reduced]

    def _value(self, item: Any) -> str:
        """Return the name of the value of an expression; write its statements if it is new."""
        if item not in self._known:
            self._known[item] = self._written(item)
        return self._known[item]

    def _assign(self, operation: str) -> str:
        """Return the name of the variable for an operation; write the operation if it is new."""
        if operation not in self._variables:
            self._variables[operation] = name = f"v{len(self._variables)}"
            self._body.append(f"{name} = {operation}")
        return self._variables[operation]

    def _chain(self, operation: str, values: Iterable[str]) -> str:
        return reduce(lambda a, b: self._assign(operation.format(a, b)), values)

    def _written(self, item: Any) -> str:
        if operation := OPERATIONS.get(type(item)):
            return self._assign(operation.format(*map(self._value, item.args)))
        if operation := CHAINS.get(type(item)):
            return self._chain(operation, map(self._value, item.args))
        match item:
            case sympy.Symbol():
                return self._assign(self._places[item.name])
            case sympy.Rational() | sympy.Float() | sympy.NumberSymbol():
                return self.constants.setdefault(item, f"c{len(self.constants)}")
            case sympy.Add():
                return self._sum(item.args)
            case sympy.Mul():
                return self._product(item)
            case sympy.Pow():
                return self._power(*item.args)
            case sympy.Piecewise():
                return self._cases(item)
        for name, meaning in reversed(self._common.items()):
            item = item.xreplace({name: meaning})
        if isinstance(item, sympy.DiracDelta):
            raise ValueError(
                f"{self.what}: it is the derivative of a function that jumps where {item.args[0]} is 0. Use a "
                "continuous function, such as abs, max or min, or write the equations with `equations`."
            )
        raise ValueError(f"{self.what}: {type(item).__name__} in {item} is not supported. Supported are {SUPPORTED}.")

    def _sum(self, terms: Sequence[Any]) -> str:
        # Negative terms come last, because a sum that starts with one would need a negation.
        first, *others = sorted(terms, key=lambda term: term.could_extract_minus_sign())
        total = self._value(first)
        for term in others:
            negative = term.could_extract_minus_sign()
            total = self._assign(f"{total} {'-' if negative else '+'} {self._value(-term if negative else term)}")
        return total

    def _product(self, item: Any) -> str:
        factor, rest = item.as_coeff_Mul()
        if factor < 0:
            return self._assign(f"-{self._value(-item)}")
        over, under = [], []
        for part in sympy.Mul.make_args(rest):
            base, exponent = part.as_base_exp()
            if exponent.is_Rational and exponent < 0:
                under.append(self._value(base**-exponent))
            else:
                over.append(self._value(part))
        if factor != 1:
            over.append(self._value(factor))
        top = self._chain("{} * {}", over) if over else "1.0"
        return self._assign(f"{top} / {self._chain('{} * {}', under)}") if under else top

    def _power(self, base: Any, exponent: Any) -> str:
        whole = 2 * exponent if exponent.is_Rational else exponent
        if not (whole.is_Integer and abs(whole) <= LARGEST_PRODUCT):
            return self._assign(f"{self._value(base)} ** {self._value(exponent)}")
        if whole < 0:
            return self._assign(f"1.0 / {self._value(base**-exponent)}")
        value, (count, half) = self._value(base), divmod(int(whole), 2)
        factors = ([self._repeated(value, count)] if count else []) + ([self._assign(f"sqrt({value})")] if half else [])
        return self._chain("{} * {}", factors)

    def _repeated(self, value: str, count: int) -> str:
        """Return the name of a power of a value, by squares."""
        if count == 1:
            return value
        half = self._repeated(value, count // 2)
        square = self._assign(f"{half} * {half}")
        return self._assign(f"{square} * {value}") if count % 2 else square

    def _cases(self, item: Any) -> str:
        """Return the first value of a Piecewise whose condition holds, NaN if none holds; all values are computed."""
        chosen = "nan"
        for value, condition in reversed(item.args):
            found = self._value(value)
            is_last = condition == sympy.true
            chosen = found if is_last else self._assign(f"{found} if {self._value(condition)} else {chosen}")
        return chosen
