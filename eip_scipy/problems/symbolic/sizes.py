"""Checks, before an expression is built, that SymPy will not need too much work for it.

SymPy adds, multiplies and raises rational numbers exactly, collects equal terms and factors, and expands some arguments
of functions. Each of these can take hours, within one operation that no signal interrupts.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import sympy

__all__ = [
    "EXPANDED_TERMS",
    "TooLargeError",
    "expanded_terms",
    "require_constant",
    "require_function",
    "require_power",
    "require_product",
    "require_sum",
]

# Largest number of bits of a numerator and its denominator. 1.0001**365 has 10 000 bits, a float at most 2100.
MOST_BITS = 2**14
# Largest number of terms of an expanded polynomial. With more terms algebra may take minutes.
EXPANDED_TERMS = 2000
# Largest number of arguments of one max or min, and of all of them. SymPy compares all pairs of them.
MOST_COMPARED, MOST_COMPARED_IN_ALL = 12, 400
# Largest number of factors of a product. The derivatives of n factors have n terms with n factors each.
MOST_FACTORS = 200
# Largest number of operations of a constant that is not rational. SymPy evaluates such a constant to find its sign.
LARGEST_CONSTANT = 64
ZERO, ONE = sympy.Integer(0), sympy.Integer(1)


class TooLargeError(ValueError):
    """Error for an expression for which SymPy would need too much work."""


def require_sum(items: Iterable[Any]) -> None:
    """Raise TooLargeError if a coefficient of the sum of `items` has too many digits."""
    coefficients: dict[Any, Any] = defaultdict(lambda: ZERO)
    for item in items:
        for term in sympy.Add.make_args(item):
            factor, rest = term.as_coeff_Mul(rational=True)
            coefficients[rest] += factor
            _require(_bits(coefficients[rest]))


def require_product(items: Iterable[Any]) -> None:
    """Raise TooLargeError if the product of `items` has too many factors, or a number in it has too many digits."""
    coefficient, roots = ONE, 0
    exponents: dict[Any, Any] = defaultdict(lambda: ZERO)
    for item in items:
        for factor in sympy.Mul.make_args(item):
            base, exponent = factor.as_base_exp()
            if factor.is_Rational:
                coefficient *= factor
                _require(_bits(coefficient))
            elif exponent.is_Rational:
                exponents[base] += exponent
                _require(_bits(exponents[base]))
                if base.is_Rational:  # SymPy multiplies bases that have equal exponents
                    roots += _bits(base) * math.ceil(abs(exponent))
                    _require(roots)
    if len(exponents) > MOST_FACTORS:
        raise TooLargeError(f"has {len(exponents)} factors, more than {MOST_FACTORS}")


def require_power(base: Any, exponent: Any) -> None:
    """Raise TooLargeError if a number in `base`, raised to `exponent`, has too many digits."""
    if not exponent.is_Rational:
        return
    numbers = [factor.as_base_exp() for factor in sympy.Mul.make_args(base)]
    total = sum(_bits(number) * math.ceil(abs(power)) for number, power in numbers if _rational(number, power))
    _require(total * math.ceil(abs(exponent)))


def require_function(name: str, arguments: Iterable[Any], compared: int) -> int:
    """Raise TooLargeError if SymPy would compare or expand too much to build the function.

    Return the number of values that max and min compare in the text, `compared` before this function.
    """
    if name in ("max", "min"):
        kind = sympy.Max if name == "max" else sympy.Min
        count = sum(len(item.args) if isinstance(item, kind) else 1 for item in arguments)
        compared += count
        if count > MOST_COMPARED or compared > MOST_COMPARED_IN_ALL:
            raise TooLargeError(
                f"compares {count} values, and the text compares {compared} in all; the limits are {MOST_COMPARED} and "
                f"{MOST_COMPARED_IN_ALL}"
            )
    if name == "abs":
        for item in arguments:
            if not item.is_extended_real and expanded_terms(item) > EXPANDED_TERMS:
                raise TooLargeError(f"takes an argument that may be complex and has more than {EXPANDED_TERMS} terms")
    return compared


def require_constant(number: Any) -> None:
    """Raise TooLargeError if `number` is not rational and has more than `LARGEST_CONSTANT` operations."""
    if not number.is_Rational and number.count_ops() > LARGEST_CONSTANT:
        raise TooLargeError(
            f"is a constant of more than {LARGEST_CONSTANT} operations; write its value, or make it a parameter"
        )


def expanded_terms(expression: Any) -> int:
    """Return an upper bound for the number of terms of the expanded expression, at most `EXPANDED_TERMS` + 1."""
    most = EXPANDED_TERMS + 1
    match expression:
        case sympy.Add():
            return min(most, sum(map(expanded_terms, expression.args)))
        case sympy.Mul():
            product = 1
            for factor in expression.args:
                product = min(most, product * expanded_terms(factor))
            return product
        case sympy.Pow(args=(base, sympy.Integer() as exponent)):
            terms, power = expanded_terms(base), min(abs(int(exponent)), most)
            return min(most, math.comb(terms + power - 1, power)) if terms > 1 else 1
    return 1


def _rational(number: Any, power: Any) -> bool:
    return bool(number.is_Rational and power.is_Rational)


def _bits(number: Any) -> int:
    return int(number.p).bit_length() + int(number.q).bit_length()


def _require(bits: int) -> None:
    if bits > MOST_BITS:
        raise TooLargeError(f"has a number of {round(bits * math.log10(2))} digits or more when it is computed exactly")
