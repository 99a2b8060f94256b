"""User-defined one-step methods: their protocol, and their unprojected steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from ..core.derivatives import random_directions, time_of_motion, unless_error
from ..core.inputs import as_vector
from ..engine.data import EPS, NFEV, Work
from ..engine.native import BUILD, Hooks
from .base import Method
from .runge_kutta import check_integer

if TYPE_CHECKING:
    from ..core.runs import Run, Start

__all__ = ["OneStep", "OneStepMethod"]

# Length of the first step that is compared with the derivative, in times in which the state moves by its size; the
# factor from one step to the next, because only short steps show the derivative of a stiff system; their number.
SHORT, SHORTER, MOST_STEPS = 1e-4, 1 / 16, 5
# Largest difference of the rate in a short step from the derivative, in units of both. A difference above it is that of
# two equations if it is the same in the next step up to the share SAME, and larger by CLEAR than the change of the
# derivative in the step and than its rounding, that is its change between states that differ by PERTURBATION roundings.
DIFFERS, SAME, CLEAR, PERTURBATION = 1e-3, 0.01, 10.0, 4.0

Array = np.ndarray


@runtime_checkable
class OneStepMethod(Protocol):
    """A one-step method, which `eip_method` accepts instead of a tableau.

    Any object with these members is accepted; it need not be a subclass.

    Attributes
    ----------
    order : int
        Order p: the error of one step is O(h^(p + 1)).
    error_estimator_order : int, optional
        Order of the second, less accurate result, whose difference from y_hat is the error estimate. It is required if
        `one_step` returns an estimate. Without an estimate the step is fixed and the default metric is euclidean.
    evaluations : int, optional
        Evaluations of the right-hand side, or of a part of it, in one step: each step adds this number to ``nfev``.
        Default: 0, because evaluations inside a user-defined method cannot be counted.
    name : str, optional
        Name in messages. Default: the name of the object's class.
    """

    order: int

    def one_step(self, t: float, y: np.ndarray, h: float) -> Any:
        """Make one step from (t, y) to t + h.

        Parameters
        ----------
        t : float
        y : ndarray, shape (n,)
            A copy for this call: it may be overwritten and returned.
        h : float
            Negative in backward runs; shorter than usual in the last step, and after a step that was rejected.

        Returns
        -------
        y_hat : ndarray, shape (n,)
            State at t + h. If the method has `error_estimator_order`, the pair ``(y_hat, err)`` with the error estimate
            `err` (n,). The result must depend on the arguments only, not on earlier calls.
        """
        ...  # pragma: no cover


class OneStep(Method):
    """A user's one-step method after checks.

    `name`, `order`, `error_estimator_order` (None without an estimate) and `evaluations` are as in `OneStepMethod`. `b`
    and `c`, 1 and 0, are those of a tableau with a single stage at the start of the step, for code that reads the
    stages of any method.

    The steps do not use the right-hand side f. It is evaluated only for gradients that take f, at the start to compare
    it with a short step, and in a few steps to judge the projections. ``nfev`` counts the evaluations for gradients
    and, for each step that is tried, the `evaluations`.
    """

    in_python = True
    multistep = None

    def __init__(self, method: OneStepMethod) -> None:
        if not isinstance(method, OneStepMethod) or isinstance(method, type) or not callable(method.one_step):
            raise TypeError(
                f"expected a Tableau, a NystromTableau or an object with one_step(t, y, h) and order, got {method!r}."
            )
        name = str(getattr(method, "name", type(method).__name__))
        estimate = getattr(method, "error_estimator_order", None)
        self.name, self.order = name, check_integer(name, "order", method.order)
        self.evaluations = check_integer(name, "evaluations", getattr(method, "evaluations", 0), least=0)
        self.error_estimator_order = (
            None if estimate is None else check_integer(name, "error_estimator_order", estimate)
        )
        self._one_step: Callable[[float, Array, float], Any] = method.one_step
        self.b, self.c = np.ones(1), np.zeros(1)

    def __repr__(self) -> str:
        return f"<OneStep {self.name}: order {self.order}>"

    def for_engine(self, sees_velocity: bool = False) -> OneStep:
        return self

    def hooks(self, stepper: Any, work: Work) -> Hooks:
        return Hooks(one_step=partial(self._fill, work), estimates=self.has_estimate)

    def _fill(self, w: Work, t: float, y: Array, h: float) -> None:
        """Make one step and write the state, and the error estimate if there is one, to the buffers `w`."""
        result, estimate = self._made(t, y, h)
        w.counters[NFEV] += self.evaluations
        if self.has_estimate:
            w.err[:] = self._vector(estimate, "an estimate", t, y).view(float)
        w.y_hat[:] = self._vector(result, "a state", t, y)

    def _made(self, t: float, y: Array, h: float) -> tuple[Any, Any]:
        """Return the state after a step and its error estimate, None without one, as `one_step` returns them."""
        result = self._one_step(float(t), y.copy(), float(h))
        if not self.has_estimate:
            return result, None
        if not isinstance(result, tuple) or len(result) != 2:
            raise TypeError(
                f"{self.name}.one_step returned {type(result).__name__}, expected the pair (y_hat, err), because the "
                "method has error_estimator_order; return both, or remove this attribute."
            )
        return result

    def contradiction(self, run: Run, start: Start) -> str | None:
        """Return a sentence if short steps from the `start` do not solve the equation of `run`, or None.

        The rate of change in a step of a method tends to the derivative as the step becomes shorter. The two are
        compared for each half of a state (q, p), and for any other state as a whole. None is returned if the method or
        the right-hand side raises an exception, or if the method does not move the state, as an iteration whose
        tolerance is larger than the step.
        """
        with np.errstate(all="ignore"):
            found = unless_error(self._difference, run.problem.derivative, start, run.stepping.span.sign)
        if found is None:
            return None
        k, own, given, h = found
        return (
            f"the steps of {self.name} do not solve the equation of {run.problem.name}: at the start, in a step of "
            f"h={h:.2g}, component {k} changes at the rate {own:.6g}, and {run.problem.name} gives {given:.6g}"
        )

    def _difference(
        self, rhs: Callable[[float, Array], Array], start: Start, sign: float
    ) -> tuple[int, Any, Any, float] | None:
        """Return the component that differs most, its rates by a step and by `rhs`, and the step; None if none does."""
        t, y, f, tau = start
        motion = time_of_motion(y, f)
        motion = tau if motion == np.inf else motion
        h, last = sign * min(SHORT * motion, tau), np.full_like(y, np.nan)
        is_real = y.dtype.kind == "f"
        parts = 2 if BUILD.is_canonical(y, f) or (is_real and y.size == 2) else 1

        def norms(x: Array) -> Array:
            return np.linalg.norm(x.reshape(parts, -1), axis=1)

        for _ in range(MOST_STEPS):
            end = self._vector(self._made(t, y, h)[0], "a state", t, y)
            difference = (end - y) / h - f
            sizes = norms(difference)
            differs = sizes > DIFFERS * (norms(f) + norms(y) / motion)
            if not differs.any():
                return None
            change = norms(rhs(t + h, y + h * f) - f)
            stays = (norms(difference - last) <= SAME * sizes) & (sizes > CLEAR * change)
            wrong = differs & stays & (norms(end - y) > 0)
            if wrong.any():
                perturbed = [y + PERTURBATION * EPS * np.abs(y) * d for d in random_directions(y.size, not is_real)]
                wrong &= sizes > CLEAR * np.max([norms(rhs(t, state) - f) for state in perturbed], axis=0)
            if wrong.any():
                k = int(np.argmax(np.abs(difference) * np.repeat(wrong, y.size // parts)))
                return k, difference[k] + f[k], f[k], h
            last, h = difference, h * SHORTER
        return None

    def _vector(self, value: Any, what: str, t: float, y: np.ndarray) -> np.ndarray:
        vector = as_vector(value, y.size, y.dtype, f"{self.name}.one_step returned {what}:", t)
        return np.ascontiguousarray(vector, dtype=y.dtype)
