"""The real cube root as a function of SymPy."""

from __future__ import annotations

from typing import Any

import sympy

__all__ = ["cbrt", "with_powers_of_roots"]


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
