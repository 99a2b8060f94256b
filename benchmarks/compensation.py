"""What each part of the compensated update brings: ten bodies, 1000 years, EIPRKN12, h = 1/64 yr, every 10.

    python benchmarks/compensation.py [--years 1000] [--h 0.015625]

The parts: the state's lost low bits carried along (two-sum); the increments' products exact; the low parts of the
weights; the carry used when the invariants are evaluated. They are switched on one after the other, in interpreted
runs, which take the same steps as compiled ones to the last bit. Errors of position [AU] against the packaged
reference states.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
from numba import njit

from eip_scipy import EIPRKN12, integrate
from eip_scipy.app.report import describe_machine
from eip_scipy.engine import kernels as kn
from eip_scipy.problems import Problem, solar_system

PLANETS = {"Mercury": 1, "Venus": 2, "Earth-Moon": 3, "Mars": 4, "Jupiter": 5, "Neptune": 8}
two_sum, two_product = kn.two_sum, kn.two_product


@njit
def with_two_sums(y, carry, h, b, b_low, b_v, b_v_low, K, out, carry_out):
    """The update with rounded products and weights."""
    half = y.size // 2
    for i in range(half):
        k = half + i
        place = speed = 0.0
        for j in range(b.size):
            place += b[j] * K[j, k]
            speed += b_v[j] * K[j, k]
        s, first = two_sum(y[i], h * y[k])
        s, second = two_sum(s, h * (h * place))
        out[i], carry_out[i] = two_sum(s, first + second + carry[i])
        s, lost = two_sum(y[k], h * speed)
        out[k], carry_out[k] = two_sum(s, lost + carry[k])


def without_low_weights(*args: Any) -> None:
    """The package's own update, the weights rounded."""
    y, carry, h, b, b_low, b_v, b_v_low, *rest = args
    kernel(y, carry, h, b, np.zeros_like(b_low), b_v, np.zeros_like(b_v_low), *rest)


def no_carry(*args: Any) -> None:
    """Invariants of the rounded state."""


kernel, add_products = kn.compensated_nystrom, kn.add_products
PARTS: dict[str, tuple[Callable[..., None], Callable[..., None]] | None] = {
    "not compensated": None,
    "two-sums": (with_two_sums, no_carry),
    "+ exact products": (without_low_weights, no_carry),
    "+ low parts of the weights": (kernel, no_carry),
    "+ carry in the invariants (compensated=True)": (kernel, add_products),
}


@contextmanager
def parts(functions: tuple[Callable[..., None], Callable[..., None]]) -> Iterator[None]:
    update, values = functions
    with mock.patch.object(kn, "compensated_nystrom", update), mock.patch.object(kn, "add_products", values):
        yield


def errors(problem: Problem, years: float, **options: Any) -> list[float]:
    result = integrate(problem, (0.0, years), method=EIPRKN12, compiled=False, **options)
    assert problem.reference is not None
    truth = problem.reference(years)
    if truth is None:
        raise SystemExit(f"there is no reference state at {years:g} yr")
    return [float(np.linalg.norm((result.y[:, -1] - truth)[3 * k : 3 * k + 3])) for k in PLANETS.values()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, default=1000.0)
    parser.add_argument("--h", type=float, default=1 / 64)
    args = parser.parse_args()
    problem = replace(solar_system(years=args.years), h=args.h)
    print(f"{describe_machine()}; {args.years:g} years, h = {args.h:g} yr, errors of position [AU]")
    for title, options in (("every 10", {"every": 10}), ("no projection", {"invariants": ()})):
        print(f"\n{title:46}" + "".join(f"{name:>11}" for name in PLANETS))
        for name, functions in PARTS.items():
            if functions is None:
                found = errors(problem, args.years, **options)
            else:
                with parts(functions):
                    found = errors(problem, args.years, compensated=True, **options)
            print(f"{name:46}" + "".join(f"{x:11.1e}" for x in found), flush=True)


if __name__ == "__main__":
    main()
