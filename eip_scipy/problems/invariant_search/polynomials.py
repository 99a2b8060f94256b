"""Sums of monomials and of further functions: their products, their names, and their values and gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from ...core.functions import compiled_like, is_compiled

__all__ = ["LARGEST_DENOMINATOR", "Functions", "Monomial", "Polynomial", "Term", "functions", "product_of", "written"]

Monomial = tuple[int, ...]  # the variables that it is the product of: (0, 0, 3) is y0**2 y3
Polynomial = dict[Monomial, float]

LARGEST_DENOMINATOR = 64
LONGEST_NAME = 200


class Term(NamedTuple):
    """A given function of the state, with its gradient and its name, in addition to the monomials."""

    fun: Callable[..., float]
    grad: Callable[..., np.ndarray]
    name: str


class Functions(NamedTuple):
    """Value and gradient of a quantity, as functions of (t, y)."""

    value: Callable[..., float]
    gradient: Callable[..., np.ndarray]


def product_of(a: Polynomial, b: Polynomial) -> Polynomial:
    """Return the product of two polynomials."""
    out: Polynomial = {}
    for x, u in a.items():
        for y, v in b.items():
            item = tuple(sorted(x + y))
            out[item] = out.get(item, 0.0) + u * v
    return out


def functions(
    polynomial: Polynomial, terms: Sequence[tuple[Term, float]], n: int, like: Callable[..., object]
) -> Functions:
    """Return value and gradient of a polynomial of n variables plus multiples of given functions.

    Both are jitted if the given functions and `like`, the user's right-hand side, are jitted. Otherwise they can be
    pickled if the given functions can.
    """
    compiled = [function for term, _ in terms for function in (term.fun, term.grad)]
    if not all(map(is_compiled, [like, *compiled])):
        return Functions(*(_Interpreted(polynomial, terms, n, which) for which in Functions._fields))
    found = _of_polynomial(polynomial, n)
    for term, coefficient in terms:
        found = _with_term(Functions(*(compiled_like(item, *compiled) for item in found)), term, coefficient)
    return Functions(*(compiled_like(item, *compiled) for item in found))


class _Interpreted:
    """One of the functions of a quantity, named in `Functions`, in Python; pickles contain its arguments."""

    def __init__(self, polynomial: Polynomial, terms: Sequence[tuple[Term, float]], n: int, which: str) -> None:
        self._arguments, found = (polynomial, terms, n, which), _of_polynomial(polynomial, n)
        for term, coefficient in terms:
            found = _with_term(found, term, coefficient)
        self._function = getattr(found, which)

    def __call__(self, t: float, y: np.ndarray) -> Any:
        return self._function(t, y)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._arguments


def _of_polynomial(polynomial: Polynomial, n: int) -> Functions:
    coefficients = np.array(list(polynomial.values()))
    factors = np.array([variable for item in polynomial for variable in item], dtype=np.int64)
    starts = np.cumsum([0, *map(len, polynomial)])

    def value(t, y):
        total = 0.0
        for k in range(coefficients.size):
            product = coefficients[k]
            for i in range(starts[k], starts[k + 1]):
                product *= y[factors[i]]
            total += product
        return total

    def gradient(t, y):
        out = np.zeros(n)
        for k in range(coefficients.size):
            for j in range(starts[k], starts[k + 1]):
                product = coefficients[k]
                for i in range(starts[k], starts[k + 1]):
                    if i != j:
                        product *= y[factors[i]]
                out[factors[j]] += product
        return out

    return Functions(value, gradient)


def _with_term(others: Functions, term: Term, coefficient: float) -> Functions:
    fun, grad = others
    g, slope = term.fun, term.grad

    def value(t, y):
        return fun(t, y) + coefficient * g(y)

    def gradient(t, y):
        return grad(t, y) + coefficient * slope(y)

    return Functions(value, gradient)


def written(polynomial: Polynomial, terms: Sequence[tuple[Term, float]], names: Sequence[str]) -> str:
    """Return a polynomial plus multiples of given functions as text such as "y0*y3 - y1*y2"."""
    factors = [(_product(item, names), c) for item, c in polynomial.items()] + [(term.name, c) for term, c in terms]
    text = ""
    for name, coefficient in factors:
        fraction = Fraction(abs(coefficient)).limit_denominator(LARGEST_DENOMINATOR)
        number = str(fraction) if float(fraction) == abs(coefficient) else f"{abs(coefficient):.6g}"
        sign = "-" if coefficient < 0 else "+"
        text += f" {sign} " if text else sign.strip("+")
        text += name if number == "1" else f"{number}*{name}"
    return text if len(text) <= LONGEST_NAME else f"{text[:LONGEST_NAME]}..."


def _product(item: Monomial, names: Sequence[str]) -> str:
    powers = {variable: item.count(variable) for variable in item}
    return "*".join(names[k] if power == 1 else f"{names[k]}**{power}" for k, power in powers.items())
