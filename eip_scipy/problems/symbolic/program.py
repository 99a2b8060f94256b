"""Functions from SymPy expressions: each statement has one operation, and common subexpressions are computed once.

A function is compiled from a tree of `ast` nodes. No text of the user is executed, unlike in SymPy's `lambdify`, which
writes source that contains the user's names and calls `exec`. The nodes are assignments of sums, products, powers,
choices and calls of functions in the lists below, checks of array sizes, and in `variational` a loop over the columns.
The names are those of the arguments, `k`, and `v` and `d` with a number; everything else is a number.
"""

from __future__ import annotations

import ast
import builtins
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from types import CodeType, FunctionType
from typing import Any

import numpy as np
import sympy

from ...core.functions import compilable, is_jitted, jitted
from .parser import cbrt, with_powers_of_roots

__all__ = ["Arguments", "function", "variational"]

# SymPy's functions and their names, which are the same in math and NumPy.
CALLS: dict[Any, str] = {
    getattr(sympy, name): name
    for name in (
        "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh",
        "atanh",
    )
}  # fmt: skip
# Functions that are reciprocals of others.
RECIPROCALS: dict[Any, str] = {sympy.sec: "cos", sympy.csc: "sin", sympy.cot: "tan"}
COMPARISONS: dict[Any, type[ast.cmpop]] = {
    sympy.Lt: ast.Lt, sympy.Le: ast.LtE, sympy.Gt: ast.Gt, sympy.Ge: ast.GtE, sympy.Eq: ast.Eq, sympy.Ne: ast.NotEq,
}  # fmt: skip
OTHERS = (sympy.Abs, sympy.Max, sympy.Min, sympy.sign, sympy.Heaviside, sympy.erf, cbrt, sympy.Piecewise, *RECIPROCALS)
ROOTS = ("sqrt", "copysign")  # functions of roots, which have these names in both libraries
COMMON = {name: getattr(builtins, name) for name in ("abs", "max", "min", "range", "ValueError")} | {"erf": math.erf}
COMPILED = {name: getattr(math, name) for name in (*ROOTS, *CALLS.values())} | COMMON
# Functions for runs without Numba. They are NumPy's because those of math raise an error outside their domain, while
# the NaN of NumPy's functions shortens the step.
INTERPRETED = {name: getattr(np, name) for name in (*ROOTS, *CALLS.values())} | COMMON
# The choice by the sign of a value, with numbers for a negative value, and for 0 or NaN.
BY_SIGN = "1.0 if value > 0.0 else {} if value < 0.0 else {}"
LARGEST_PRODUCT = 64  # largest exponent of a power that is computed by multiplications


class Arguments:
    """Names of the entries of the arrays that a function reads: y, params, and dy, the direction of a derivative."""

    def __init__(self, components: Sequence[str], parameters: Sequence[str], directions: Sequence[str] = ()) -> None:
        self.arrays = {"y": tuple(components), "dy": tuple(directions), "params": tuple(parameters)}

    @property
    def places(self) -> dict[str, tuple[str, int | None]]:
        """Return for each name the name of its array and its index in this array; for the time, ("t", None)."""
        places = {name: (array, k) for array, names in self.arrays.items() for k, name in enumerate(names)}
        return {**places, "t": ("t", None)}


def function(
    what: str,
    expressions: Sequence[Any],
    arguments: Arguments,
    *,
    in_place: bool,
    places: Sequence[Any] | None = None,
) -> Callable[..., Any]:
    """Return a function of ``(t, y[, dy][, out][, params])``, jitted if Numba is installed.

    It fills `out` with the values of the expressions if `in_place`, otherwise it returns the value of the only one.
    `places` are the places of the expressions in `out`, indices or tuples of them, by default 0, 1, ...; the other
    entries become 0. `what` describes the values in tracebacks and errors. A ValueError is raised if an expression
    contains a function that is not supported.
    """
    return _fastest(_compiled(what, _statements(what, expressions, arguments, in_place, places), arguments, in_place))


def variational(
    what: str,
    rates: Sequence[Any],
    jacobian: Mapping[tuple[int, int], Any],
    by_parameters: Sequence[Mapping[int, Any]],
    arguments: Arguments,
) -> Callable[..., None]:
    """Return a function of ``(t, Y, out[, params])`` that fills `out` with dY/dt.

    Y is the state, n numbers, followed by columns of derivatives, n numbers each. The rates of the state agree bit by
    bit with those of ``function(what, rates, ...)``, because their statements come first, and the columns use their
    intermediate results. `jacobian` holds the nonzero derivatives of the rates by row and column. `by_parameters`
    holds, for each of the last columns, the nonzero derivatives of the rates with respect to its parameter, by row.
    """
    n = len(rates)
    writer = Writer(what, arguments)
    values = writer.values(rates)
    derivatives = [*jacobian.values(), *(item for column in by_parameters for item in column.values())]
    found = iter(writer.values(derivatives))
    entries = {place: next(found) for place in jacobian}
    added = [{row: next(found) for row in column} for column in by_parameters]
    columns = f"y must hold the state and columns of derivatives, {n} numbers each, and at least {len(added)} columns"
    body = _written(
        f"""
if y.size % {n} != 0 or y.size < {n * (len(added) + 1)}:
    raise ValueError(columns)
if out.size != y.size:
    raise ValueError("out must be as long as y")
""",
        columns=ast.Constant(value=columns),
    )
    body += [*_checks(Arguments((), arguments.arrays["params"])), *writer.body]
    for k, value in enumerate(values):
        body += _written(f"out[{k}] = value", value=value)
    (loop,) = _written(f"for k in range({n}, y.size, {n}): pass")
    loop.body = _products(n, entries)  # type: ignore[attr-defined]
    body.append(loop)
    for behind, column in enumerate(reversed(added), 1):
        for row, value in column.items():
            body += _written(f"out[y.size - {behind * n} + {row}] += value", value=value)
    return _fastest(_compiled(what, body, arguments, in_place=True))


def _fastest(code: CodeType) -> Callable[..., Any]:
    fast = jitted(compilable(_made(code, COMPILED)))
    return fast if is_jitted(fast) else _made(code, INTERPRETED)


def _made(code: CodeType, functions: Mapping[str, Any]) -> FunctionType:
    return FunctionType(code, {"__name__": __name__, "__builtins__": {}, **functions})


def _compiled(what: str, body: list[ast.stmt], arguments: Arguments, in_place: bool) -> CodeType:
    given = {"t": True, "y": True, "dy": arguments.arrays["dy"], "out": in_place, "params": arguments.arrays["params"]}
    names = ", ".join(name for name, there in given.items() if there)
    module = ast.parse(f"def written({names}): pass")
    (definition,) = module.body
    assert isinstance(definition, ast.FunctionDef)
    definition.body = body
    ast.fix_missing_locations(module)
    (code,) = (item for item in compile(module, f"<{what}>", "exec").co_consts if isinstance(item, CodeType))
    return code


def _statements(
    what: str, expressions: Sequence[Any], arguments: Arguments, in_place: bool, places: Sequence[Any] | None = None
) -> list[ast.stmt]:
    writer = Writer(what, arguments)
    values = writer.values(expressions)
    body = [*_checks(arguments), *writer.body]
    if places is not None:
        body += _written("out[:] = 0.0")
    if in_place:
        for k, value in zip(range(len(values)) if places is None else places, values, strict=True):
            body += _written(f"out[{k}] = value", value=value)
        return body
    (value,) = values
    return [*body, ast.Return(value=value)]


def _products(n: int, entries: Mapping[tuple[int, int], ast.expr]) -> list[ast.stmt]:
    """Return statements that set the column of `out` from index k on to the Jacobian times the same column of `y`.

    `entries` holds the nonzero entries of the Jacobian (n, n), by row and column.
    """
    # The column of y is read first, because compiled code would read it again after each number that it writes.
    body = [item for j in sorted({j for _, j in entries}) for item in _written(f"d{j} = y[k + {j}]")]
    for i in range(n):
        terms: list[ast.expr] = [
            ast.BinOp(left=value, op=ast.Mult(), right=_load(f"d{j}"))
            for (row, j), value in entries.items()
            if row == i
        ]
        total = reduce(lambda a, b: ast.BinOp(left=a, op=ast.Add(), right=b), terms or [ast.Constant(value=0.0)])
        body += _written(f"out[k + {i}] = total", total=total)
    return body


def _checks(arguments: Arguments) -> Iterable[ast.stmt]:
    """Yield statements that check the sizes of arrays, because compiled code does not check indices."""
    for array, names in arguments.arrays.items():
        if names:
            text = f"{array} must hold as many numbers as there are names in ({', '.join(names)}): {len(names)}"
            template = f"if {array}.size != {len(names)}: raise ValueError(text)"
            yield from _written(template, text=ast.Constant(value=text))


def _written(template: str, **nodes: ast.expr) -> list[ast.stmt]:
    """Return the statements of `template`, which has no names of users, with `nodes` in place of its names."""
    return _Filled(nodes).visit(ast.parse(template)).body


class _Filled(ast.NodeTransformer):
    def __init__(self, nodes: Mapping[str, ast.expr]) -> None:
        self.nodes = nodes

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return self.nodes.get(node.id, node)


def _load(name: str) -> ast.expr:
    return ast.Name(id=name, ctx=ast.Load())


class Writer:
    """Writer of statements that compute expressions, appended to `body`; the same operation is written once."""

    def __init__(self, what: str, arguments: Arguments) -> None:
        self.what = what
        self.body: list[ast.stmt] = []
        self.known: dict[Any, ast.expr] = {}
        self._common: dict[Any, Any] = {}  # symbols of `cse` and their expressions
        self._written: dict[str, ast.expr] = {}
        self._places = arguments.places

    def values(self, expressions: Sequence[Any]) -> list[ast.expr]:
        """Write statements that compute expressions; return the variables or constants that hold their values."""
        written = [with_powers_of_roots(item) for item in expressions]
        common, reduced = sympy.cse(written, symbols=sympy.numbered_symbols(cls=sympy.Dummy), list=True)
        for name, expression in common:
            self._common[name] = expression
            self.known[name] = self.value(expression)
        return [self.value(expression) for expression in reduced]

    def value(self, expression: Any) -> ast.expr:
        """Return the variable or constant that holds the value of an expression; write its statements if it is new."""
        if expression not in self.known:
            self.known[expression] = self._write(expression)
        return self.known[expression]

    def _write(self, expression: Any) -> ast.expr:
        match expression:
            case sympy.Symbol():
                return self._variable(expression.name)
            case sympy.Rational():
                return ast.Constant(value=int(expression.p) / int(expression.q))
            case sympy.Float() | sympy.NumberSymbol():
                return ast.Constant(value=float(expression))
            case sympy.Add():
                return self._sum(expression.args)
            case sympy.Mul():
                return self._product(expression)
            case sympy.Pow():
                return self._power(*expression.args)
            case sympy.Piecewise():
                return self._cases(expression)
            case sympy.Function() | sympy.Max() | sympy.Min():
                return self._call(expression)
        raise self._unknown(expression)

    def _unknown(self, expression: Any) -> ValueError:
        for name, meaning in reversed(self._common.items()):
            expression = expression.xreplace({name: meaning})
        if isinstance(expression, sympy.DiracDelta):
            return ValueError(
                f"{self.what}: it is the derivative of a function that jumps where {expression.args[0]} is 0. Use a "
                "continuous function, such as abs, max or min, or write the equations with `equations`."
            )
        allowed = ", ".join(sorted(item.__name__ for item in (*CALLS, *OTHERS)))
        kind = type(expression).__name__
        return ValueError(f"{self.what}: {kind} in {expression} is not supported. Supported are {allowed}.")

    def _name(self, operation: ast.expr) -> ast.expr:
        """Return the variable for an operation on names and constants; write the operation if it is new."""
        text = ast.dump(operation)
        if text not in self._written:
            name = f"v{len(self._written)}"
            self.body.append(ast.Assign(targets=[ast.Name(id=name, ctx=ast.Store())], value=operation))
            self._written[text] = _load(name)
        return self._written[text]

    def _variable(self, name: str) -> ast.expr:
        array, place = self._places[name]
        return _load(array) if place is None else self._expression(f"{array}[{place}]")

    def _expression(self, template: str, **nodes: ast.expr) -> ast.expr:
        return self._name(_written(template, **nodes)[0].value)  # type: ignore[attr-defined]

    def _binary(self, left: ast.expr, operator: ast.operator, right: ast.expr) -> ast.expr:
        return self._name(ast.BinOp(left=left, op=operator, right=right))

    def _sum(self, terms: Sequence[Any]) -> ast.expr:
        # Negative terms come last, because a sum that starts with one would need a negation.
        signed = sorted(((term.could_extract_minus_sign(), term) for term in terms), key=lambda item: item[0])
        (negative, first), *others = signed
        total = self.value(first)
        for negative, term in others:
            total = self._binary(total, ast.Sub() if negative else ast.Add(), self.value(-term if negative else term))
        return total

    def _product(self, expression: Any) -> ast.expr:
        factor, rest = expression.as_coeff_Mul()
        if factor < 0:
            return self._name(ast.UnaryOp(op=ast.USub(), operand=self.value(-expression)))
        over, under = [], []
        for item in sympy.Mul.make_args(rest):
            base, exponent = item.as_base_exp()
            if exponent.is_Rational and exponent < 0:
                under.append(self.value(base**-exponent))
            else:
                over.append(self.value(item))
        if factor != 1:
            over.append(self.value(factor))
        top = self._all(over) if over else ast.Constant(value=1.0)
        return self._binary(top, ast.Div(), self._all(under)) if under else top

    def _all(self, factors: Sequence[ast.expr]) -> ast.expr:
        return reduce(lambda a, b: self._binary(a, ast.Mult(), b), factors)

    def _power(self, base: Any, exponent: Any) -> ast.expr:
        whole = 2 * exponent if exponent.is_Rational else exponent
        if not (whole.is_Integer and abs(whole) <= LARGEST_PRODUCT):
            return self._binary(self.value(base), ast.Pow(), self.value(exponent))
        if whole < 0:
            return self._binary(ast.Constant(value=1.0), ast.Div(), self.value(base**-exponent))
        value = self.value(base)
        count, half = divmod(int(whole), 2)
        root = [self._function("sqrt", value)] if half else []
        return self._all([*([self._repeated(value, count)] if count else []), *root])

    def _repeated(self, value: ast.expr, count: int) -> ast.expr:
        if count == 1:
            return value
        half = self._repeated(value, count // 2)
        square = self._binary(half, ast.Mult(), half)
        return self._binary(square, ast.Mult(), value) if count % 2 else square

    def _function(self, name: str, *arguments: ast.expr) -> ast.expr:
        return self._name(ast.Call(func=_load(name), args=list(arguments), keywords=[]))

    def _call(self, expression: Any) -> ast.expr:
        kind, arguments = type(expression), [self.value(item) for item in expression.args]
        if kind in CALLS:
            return self._function(CALLS[kind], *arguments)
        if kind in RECIPROCALS:
            return self._expression("1.0 / value", value=self._function(RECIPROCALS[kind], *arguments))
        match expression:
            case sympy.Abs() | sympy.erf():
                return self._function(kind.__name__.lower(), *arguments)
            case cbrt():
                root = self._expression(f"value ** {1 / 3!r}", value=self._function("abs", *arguments))
                return self._function("copysign", root, *arguments)
            case sympy.Max() | sympy.Min():
                name = kind.__name__.lower()
                return reduce(lambda a, b: self._function(name, a, b), arguments)
            case sympy.sign():
                return self._expression(BY_SIGN.format(-1.0, 0.0), value=arguments[0])
            case sympy.Heaviside():
                return self._expression(BY_SIGN.format(0.0, 0.5), value=arguments[0])
        raise self._unknown(expression)

    def _cases(self, expression: Any) -> ast.expr:
        """Return the first value of a Piecewise whose condition holds, NaN if none holds; all values are computed."""
        chosen: ast.expr = ast.Constant(value=math.nan)
        for value, condition in reversed(expression.args):
            found = self.value(value)
            if condition == sympy.true:
                chosen = found
            else:
                chosen = self._name(ast.IfExp(test=self._condition(condition), body=found, orelse=chosen))
        return chosen

    def _condition(self, condition: Any) -> ast.expr:
        kind = type(condition)
        if kind in COMPARISONS:
            left, right = (self.value(item) for item in condition.args)
            return ast.Compare(left=left, ops=[COMPARISONS[kind]()], comparators=[right])
        match condition:
            case sympy.And() | sympy.Or():
                parts = [self._condition(item) for item in condition.args]
                return ast.BoolOp(op=ast.And() if isinstance(condition, sympy.And) else ast.Or(), values=parts)
            case sympy.Not():
                return ast.UnaryOp(op=ast.Not(), operand=self._condition(condition.args[0]))
        raise self._unknown(condition)
