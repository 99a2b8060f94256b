"""Interface of the methods of integration: everything that a run asks of the method that makes its steps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from ..engine.data import CUBIC, NO_METHOD, Work
from ..engine.native import Hooks

if TYPE_CHECKING:
    from ..core.runs import Run, Start

__all__ = ["PROJECTION_ONLY", "DenseForm", "Method"]


class DenseForm(NamedTuple):
    """Form of a run's interpolants, as the engine needs it; `kind` is one of the engine's codes.

    An interpolant consists of the states (n,) at both ends of its step and of `rows` further arrays (n,), which are
    computed from derivatives in the step, with `weights` if the kind needs any. `A` and `c` are the coefficients of
    further stages, if the kind has some. With `own_slopes` the derivatives at both ends are evaluated, because the
    steps do not provide them.
    """

    kind: int
    rows: int
    weights: np.ndarray = np.zeros((0, 0))
    A: np.ndarray = np.zeros((0, 0))
    c: np.ndarray = np.zeros(0)
    own_slopes: bool = False


class Method:
    """A method with an `order`, and an `error_estimator_order` that is None without an error estimate.

    Runs call the functions below, in this order: `checked`, `for_engine`, `begin`, `hooks`, `dense_form`.
    """

    name: str
    order: int
    error_estimator_order: int | None
    reference: str = ""  # the source of the method
    # True if the equations are q'' = a(t, q), and the state is (q, v).
    of_second_order: ClassVar[bool] = False
    # True if steps use results of earlier steps. Such a method starts once and uses compensated sums, and its history
    # is projected.
    has_history: ClassVar[bool] = False
    # True if the steps are made in Python, by a user's function or by a solver of SciPy.
    in_python: ClassVar[bool] = False
    # True if a solver of SciPy makes the steps, and controls their error and their length.
    drives: ClassVar[bool] = False

    @property
    def has_estimate(self) -> bool:
        """True if there is an error estimate."""
        return self.error_estimator_order is not None

    @property
    def fixed_steps_only(self) -> bool:
        """True if the length of the step cannot be controlled, because there is no suitable error estimate."""
        return not self.has_estimate

    @property
    def metric_exponent(self) -> float:
        """Exponent of the error metric, (order + 1) / (order of the estimate + 1), or 1 without an estimate."""
        if self.error_estimator_order is None:
            return 1.0
        return (self.order + 1) / (self.error_estimator_order + 1)

    @property
    def exponent(self) -> float:
        """Power of the norm of the error estimate by which adaptive steps change."""
        return -1.0 / ((self.error_estimator_order or 0) + 1)

    def class_attributes(self) -> dict[str, Any]:
        """Return the attributes of solver classes, as in SciPy's RungeKutta, by name; those that are None are left out.

        The names are order, error_estimator_order, n_stages, A, B, C, E, P, E3 and E5.
        """
        names = ("order", "error_estimator_order", "n_stages")
        return {name: value for name in names if (value := getattr(self, name, None)) is not None}

    def checked(self, run: Run, start: Start) -> Method:
        """Return the method for the equations of `run`, or raise ValueError if it cannot integrate them."""
        return self

    def for_engine(self, sees_velocity: bool = False) -> Any:
        """Return what makes the steps of one run: coefficients (`data.Method`), or an object with the same attributes.

        `sees_velocity` is True if accelerations come from a function that is called with velocities too.
        """
        raise NotImplementedError

    def begin(self, run: Run, start: Start) -> None:
        """Prepare the steps of a run from `start`."""

    def hooks(self, stepper: Any, work: Work) -> Hooks:
        """Return the parts of a step that are in Python; `stepper` is the output of `for_engine`."""
        return Hooks()

    def dense_form(self, stepper: Any) -> DenseForm:
        """Return the form of the interpolants of a run; the default is a cubic, from derivatives at both ends."""
        return DenseForm(CUBIC, 3, own_slopes=True)

    def rated_stages(self) -> np.ndarray:
        """Return a mask (s,) of the stages at which the rate of a `Balance` is needed; ValueError if unsupported."""
        raise ValueError(
            f"invariants: {self.name} does not carry a Balance, because it does not provide the whole state at its "
            "stages, where rates would be evaluated. Use EIPRK4, EIPDOP853, eip_method(tableau) or EIPGJ12, or omit "
            "the balances."
        )

    def contradiction(self, run: Run, start: Start) -> str | None:
        """Return a sentence if the steps do not solve the equation of `run`, as only user-defined ones may."""
        return None


class _ProjectionOnly(Method):
    """Stand-in for a method, for the projection of a single state without steps."""

    name = "project"
    order = 0
    error_estimator_order = None

    def for_engine(self, sees_velocity: bool = False) -> Any:
        return NO_METHOD


PROJECTION_ONLY = _ProjectionOnly()
