"""What every method has: an order, and perhaps an embedded error estimate of another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

__all__ = ["AT_REST", "AtRest", "Ordered", "named_constant"]


def named_constant(value: Any, names: Mapping[str, Any]) -> str | None:
    """Return the name under which a module has an object, for pickles: it comes back as the same object."""
    return next((name for name, own in names.items() if own is value), None)


class Ordered:
    """A method with an `order`, and an `error_estimator_order` that is None without an estimate."""

    order: int
    error_estimator_order: int | None
    # Whether the equations are q'' = a(t, q), and the state is (q, v).
    of_second_order: ClassVar[bool] = False
    # Whether steps use what earlier ones left. Such a method starts once and carries its rounding, and its history is
    # what is projected.
    has_history: ClassVar[bool] = False
    # Whether the steps are made by a user's Python function, without calls of the right-hand side.
    in_python: ClassVar[bool] = False
    # True if a solver of SciPy makes the steps, and controls their error and their length.
    drives: ClassVar[bool] = False

    @property
    def has_estimate(self) -> bool:
        """Whether there is an error estimate."""
        return self.error_estimator_order is not None

    @property
    def fixed_steps_only(self) -> bool:
        """Whether the estimate, or its lack, leaves no way to control the step."""
        return not self.has_estimate

    @property
    def kappa(self) -> float:
        """Exponent of the error metric, (p + 1) / (p_hat + 1); 1 without an estimate."""
        if self.error_estimator_order is None:
            return 1.0
        return (self.order + 1) / (self.error_estimator_order + 1)


class AtRest(Ordered):
    """No method: a state is projected where it is."""

    name = "project"
    order = 0
    error_estimator_order = None


AT_REST = AtRest()
