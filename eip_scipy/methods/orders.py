"""Base class of methods: an order, and optionally an embedded error estimate of another order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

__all__ = ["AT_REST", "AtRest", "Ordered", "named_constant"]


def named_constant(value: Any, names: Mapping[str, Any]) -> str | None:
    """Return the name of `value` in `names`, the globals of a module, for pickling by name; None if it is not there."""
    return next((name for name, own in names.items() if own is value), None)


class Ordered:
    """A method with an `order`, and an `error_estimator_order` that is None without an estimate."""

    order: int
    error_estimator_order: int | None
    # True if the equations are q'' = a(t, q), and the state is (q, v).
    of_second_order: ClassVar[bool] = False
    # True if steps use results of earlier steps. Such a method starts once and uses compensated sums, and its history
    # is projected.
    has_history: ClassVar[bool] = False
    # True if the steps are made by a user's Python function, without calls of the right-hand side.
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
    def kappa(self) -> float:
        """Exponent of the error metric, (order + 1) / (order of the estimate + 1), or 1 without an estimate."""
        if self.error_estimator_order is None:
            return 1.0
        return (self.order + 1) / (self.error_estimator_order + 1)


class AtRest(Ordered):
    """Stand-in for a method, for the projection of a single state without steps."""

    name = "project"
    order = 0
    error_estimator_order = None


AT_REST = AtRest()
