"""Differences between the families of methods in a run; no other module depends on the family of a method.

Facts that need no more than a flag are attributes of `eip_scipy.methods.orders.Ordered`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, singledispatch
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853 as SCIPY_DOP853

from ..engine.data import CUBIC, HISTORY, NO_METHOD, NYSTROM, POLYNOMIAL, QUINTIC, SEVENTH, Method
from ..methods.multistep import GaussJackson, interpolation_weights
from ..methods.nystrom import RKN1210, NystromTableau
from ..methods.nystrom_interpolants import LEAST_ORDER
from ..methods.nystrom_interpolants import interpolant as nystrom_interpolant
from ..methods.orders import AtRest
from ..methods.runge_kutta import DOP853, Tableau
from .driven import Driven, Stepper
from .one_step import OneStep

__all__ = ["Form", "arrays", "check_halves", "checked", "depends_on_velocity", "form", "of_another_equation", "rated"]

Array = np.ndarray
Derivative = Callable[[float, Array], Array]


@singledispatch
def arrays(method: Any) -> Method | OneStep | Stepper:
    """Return a method as the engine uses it for its steps: coefficients, or an object that makes steps."""
    raise TypeError(
        f"{type(method).__name__} is not a known kind of method; expected Tableau, NystromTableau, GaussJackson, "
        "OneStep or Driven."
    )


@arrays.register
def _(method: OneStep) -> OneStep:
    return method


@arrays.register
def _(method: Driven) -> Stepper:
    return method.stepper()


@arrays.register
def _(method: AtRest) -> Method:
    return NO_METHOD


@arrays.register
def _(method: GaussJackson) -> Any:
    # The engine needs the coefficients of the method that makes the first states.
    return arrays(DOP853 if method.velocities else RKN1210)


@arrays.register
@lru_cache(maxsize=32)
def _(method: Tableau) -> Method:
    none = np.zeros(method.b.size)
    return Method(  # of copies, because the engine only takes arrays that can be written to
        A=method.A.copy(),
        b=method.b.copy(),
        b_low=method.b_low.copy(),
        b_v=none,
        b_v_low=none,
        c=method.c.copy(),
        e=method.e.copy(),
        e_v=none,
        e_low=method.e_low.copy(),
        nystrom=False,
        sees_velocity=False,
        fsal=method.fsal,
        paired=method.paired,
        exponent=-1.0 / ((method.error_estimator_order or 0) + 1),
    )


@arrays.register
@lru_cache(maxsize=32)
def _(method: NystromTableau) -> Method:
    # If the last stage is the first stage of the next step, it is f at the new point and is evaluated after the step.
    s = method.n_stages - method.fsal

    def weights(e: Array) -> Array:
        return np.concatenate([e, np.zeros(s + 1 - e.size)])

    e, e_v = weights(method.e), weights(method.e_prime)
    return Method(
        A=method.A[:s, :s].copy(),
        b=method.b[:s].copy(),
        b_low=method.b_low[:s].copy(),
        b_v=method.b_prime[:s].copy(),
        b_v_low=method.b_prime_low[:s].copy(),
        c=method.c[:s].copy(),
        e=e,
        e_v=e_v,
        e_low=np.zeros(s + 1),
        nystrom=True,
        sees_velocity=False,
        fsal=bool(e[-1] != 0.0 or e_v[-1] != 0.0),
        paired=False,
        exponent=-1.0 / ((method.error_estimator_order or 0) + 1),
    )


@singledispatch
def of_another_equation(method: Any, rhs: Derivative, start: Any, sign: float, called: str) -> str | None:
    """Return a sentence if the steps of a method do not solve the equation of `rhs`, as only user-defined ones may."""
    return None


@of_another_equation.register
def _(method: OneStep, rhs: Derivative, start: Any, sign: float, called: str) -> str | None:
    return method.of_another_equation(rhs, start, sign, called)


@singledispatch
def rated(method: Any) -> Array:
    """Return a mask (s,) of the stages at which the rate of a `Balance` is needed; ValueError if unsupported."""
    raise ValueError(
        f"invariants: {method.name} does not carry a Balance, because it does not provide the whole state at its "
        "stages, where rates would be evaluated. Use EIPRK4, EIPDOP853, eip_method(tableau) or EIPGJ12, or omit the "
        "balances."
    )


@rated.register
def _(method: GaussJackson) -> Array:
    coefficients: Any = arrays(method)
    return np.zeros(coefficients.b.size, np.int64)  # rates are evaluated at the nodes of the history


@rated.register
def _(method: Tableau) -> Array:
    stages = (method.b != 0) | (method.b_low != 0)
    if method.P is not None:
        stages |= np.any(method.P[: stages.size] != 0, axis=1)
    stages[0] = True  # interpolants need the rate at the start of a step
    return stages.astype(np.int64)


class Form(NamedTuple):
    """Form of a run's interpolants, as the engine needs it; `kind` is one of the engine's codes.

    An interpolant consists of the states (n,) at both ends of its step and of `rows` further arrays (n,), which are
    computed from derivatives in the step, with `weights` if the kind needs any. `A` and `c` are the coefficients of
    further stages, if the kind has some. With `own_slopes` the derivatives at both ends are evaluated, because the
    steps do not provide them.
    """

    kind: int
    rows: int
    weights: Array = np.zeros((0, 0))
    A: Array = np.zeros((0, 0))
    c: Array = np.zeros(0)
    own_slopes: bool = False


@singledispatch
def form(method: Any, brief: bool) -> Form:
    """Return the form of a method's interpolants; a `brief` run has too few steps for a multistep history."""
    return Form(CUBIC, 3, own_slopes=True)  # of a user's one-step method


@form.register
def _(method: Driven, brief: bool) -> Form:
    return Form(POLYNOMIAL, 1 + len(method.weights), method.weights)


@form.register
def _(method: Tableau, brief: bool) -> Form:
    if method is DOP853:
        return Form(SEVENTH, 3 + len(SCIPY_DOP853.D), SCIPY_DOP853.D, SCIPY_DOP853.A_EXTRA, SCIPY_DOP853.C_EXTRA)
    return Form(CUBIC, 3) if method.P is None else Form(POLYNOMIAL, 1 + method.P.shape[1], method.P.T)


@form.register
def _(method: NystromTableau, brief: bool) -> Form:
    if method.order < LEAST_ORDER:
        return Form(QUINTIC, 3)
    A, c, weights = nystrom_interpolant(method)
    return Form(NYSTROM, (weights.shape[0] + 1) // 2 + 1, weights, A, c)


@form.register
def _(method: GaussJackson, brief: bool) -> Form:
    if not brief:
        weights = interpolation_weights(method.order).reshape(-1, method.order)
        return Form(HISTORY, (method.order + 1) // 2 + 2, weights)
    # The starting method makes all steps, and several for each step if accelerations depend on velocities.
    return Form(QUINTIC, 3, own_slopes=True) if method.velocities else form(RKN1210, brief)


def checked(method: Any, rhs: Derivative, start: Any, name: str, hint: Callable[[], str], sees_velocity: bool) -> Any:
    """Return the method after a check that the equations are of second order, if the method needs that.

    `rhs` is then evaluated once more, with other velocities. `name` is that of the solver class, and ``hint()`` returns
    further advice for the message. The attribute `velocities` of a `GaussJackson` method is set to `sees_velocity`,
    whether the accelerations come from a function that is called with velocities too: accelerations that do not depend
    on velocities at the start may do so later, as with drag that acts in a part of an orbit.
    """
    if not method.of_second_order:
        return method
    depends = depends_on_velocity(rhs, start, name, hint)  # raises an exception if the state is not (q, v)
    if method.has_history:
        return replace(method, velocities=sees_velocity)
    if depends:
        raise ValueError(
            f"{name} integrates q'' = a(t, q), but the accelerations in fun depend on the velocity; use a Runge-Kutta "
            f"method such as EIPDOP853."
        )
    return method


def check_halves(n: int) -> None:
    """Raise a ValueError if a state of n components cannot be (q, v), because n is odd."""
    if n % 2:
        raise ValueError(
            "a Nystrom or Gauss-Jackson method needs the state (q, v) with an even number of components, but y0 has "
            f"{n}. Use a Runge-Kutta method such as EIPDOP853."
        )


def depends_on_velocity(rhs: Derivative, start: Any, name: str, hint: Callable[[], str] = str) -> bool:
    """Return True if accelerations depend on v at the start; raise ValueError if the state is not (q, v)."""
    t0, y0, f0, _ = start
    check_halves(y0.size)
    half = y0.size // 2
    other = y0.copy()
    other[half:] = 1.5 * y0[half:] + 1.0
    f = rhs(t0, other)
    if not (np.array_equal(f0[:half], y0[half:]) and np.array_equal(f[:half], other[half:])):
        raise ValueError(
            f"{name} integrates q'' = a(t, q) with the state (q, v): the first {half} components of fun must be v, "
            f"the second half of the state, but are not. Use a Runge-Kutta method such as EIPDOP853, or, if the system "
            f"is of second order, write it with the velocities as the second half of the state{hint()}."
        )
    return not np.array_equal(f[half:], f0[half:], equal_nan=True)
