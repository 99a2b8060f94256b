"""Balances: quantities that change slowly and at a known rate, and onto whose values a run projects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .functions import GRADIENT, by_pointer
from .inputs import flag, reals, shown
from .invariants import Invariant, OwnArguments

__all__ = ["Balance"]

LARGEST_INDEX = 2**53  # floats represent all integers up to this one


class Balance(Invariant):
    """A quantity F that changes slowly and at a known rate, such as an energy with friction; or several at once.

    Add it to the list of invariants of a run. The run integrates the rate with the stages of each step and projects the
    state onto the resulting value. The error of this value is about r times the error that F has without projection,
    where r is the size of the rate divided by that of the terms of ``grad @ f`` (see `Diagnostics.slowness`).

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> float or (l_i,)``, as for `Invariant`.
    rate : callable, optional
        ``rate(t, y, *args) -> float or (l_i,)``, the total derivative of `fun` in time along the solutions; a Python or
        Numba function, or a `scipy.LowLevelCallable` (see Notes). Default: the rate is computed as ``grad @ f + dF/dt``
        with f = fun(t, y) of the system, exactly to rounding for a jitted function of a real state, otherwise with the
        gradient and differences in time. The rounding error is then that of the terms of ``grad @ f``. If relative
        errors below 1e-10 matter, give a rate that is written without the terms that cancel.
    grad : callable, optional
        As for `Invariant`.
    args : tuple, optional
        Further arguments of `fun`, `rate` and `grad`, as for `Invariant`.
    size, name, scale, in_place
        As for `Invariant`.
    components : array_like of int, shape (s,) or (s, k), optional
        The components of the state that the projection onto this balance may move. The k components of a row move by
        the same amount. Balances with the same components and weights are projected together, as a group. Each group is
        projected separately, from the same state, without the corrections of other groups. Afterwards all components
        together restore the given `linear_invariants`. Either all invariants of a run have components, or none has.
        `metric`, `direction` and `iterations` must be omitted if there are components.
    weights : array_like of float, shape (s,), optional
        Weights of the components, or of the rows of components, such as their typical sizes. The correction is the
        shortest in units of these weights. Default: 1.
    uses_f : bool, optional
        ``rate(t, y, f, *args)`` and ``grad(t, y, f, *args)``, if they are given, also receive f, the derivative of the
        state.

    See Also
    --------
    Invariant, integrate, eip_scipy.problems.orbital_balances

    Notes
    -----
    Balances need a Runge-Kutta method (`EIPRK1` to `EIPRK5`, `EIPRK23`, `EIPRK45`, `EIPDOP853`, or one that
    `eip_method` makes from a tableau), which evaluates the rates at its stages, or a multistep method (`EIPGJ12`,
    `EIPGJ14`), which sums them as it sums accelerations. Nystrom methods cannot be used because their stages have no
    velocities. The integrated value starts as F at the start of the run. It is set to F again if a user sets the state
    between two steps of a solver. It is a compensated sum, is not part of the error control, and is not changed by the
    projection. Between the steps it is interpolated as the state is, and states between the steps are projected onto
    the interpolated value.

    A given rate is compared with ``grad @ f + dF/dt`` at the start and during the run. A wrong rate is reported by a
    `ProjectionWarning`. `Diagnostics.slowness` is the size of the rate, compared with the terms of ``grad @ f``. If
    the slowness is above 0.05, the balance hardly helps, and there is a warning. Balances do not help in chaotic motion
    and with strong driving.

    The partial derivative dF/dt is computed as a difference of order 6, within the interval of the run, over 3/32 of a
    fixed step or 3/8 of the first adaptive step to both sides (to one side next to the ends of the interval). The
    difference is exactly zero if `fun` does not depend on t. For jitted functions dual numbers are used instead, which
    are exact.

    A C function for the rate has the signature of a gradient,
    ``int r(double t, const double *y, const double *f, double *values, const double *params)``.

    Examples
    --------
    A planet with a little drag, whose energy decreases at the rate -c v²:

    >>> import numpy as np
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import Balance, EIPDOP853
    >>> c = 1e-6
    >>> def fun(t, y):
    ...     return np.concatenate([y[2:], -y[:2] / np.hypot(*y[:2]) ** 3 - c * y[2:]])
    >>> def energy(t, y):
    ...     return 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)
    >>> E = Balance(energy, rate=lambda t, y: -c * (y[2] ** 2 + y[3] ** 2), name="energy")
    >>> sol = solve_ivp(fun, (0, 200), [0.8, 0, 0, 1.225], method=EIPDOP853, h=0.4, invariants=E)
    >>> bool(energy(0, sol.y[:, -1]) < energy(0, sol.y[:, 0]))
    True
    """

    is_balance = True

    def __init__(
        self,
        fun: Callable[..., Any],
        rate: Callable[..., Any] | None = None,
        grad: Callable[..., Any] | None = None,
        *,
        args: Sequence[Any] = (),
        size: int | None = None,
        name: str | None = None,
        scale: Any = None,
        in_place: bool = False,
        uses_f: bool = False,
        components: Any = None,
        weights: Any = None,
    ) -> None:
        uses_f = flag("Balance: uses_f", uses_f)
        if uses_f and rate is None and grad is None:
            raise ValueError(
                "Balance: uses_f describes rate and grad, but both are missing. Give one of them, or omit uses_f."
            )
        own: Any = rate
        if isinstance(own, OwnArguments):
            rate, args = own.function, args or own.args
        by_grad = uses_f and grad is not None
        super().__init__(fun, grad, args=args, size=size, name=name, scale=scale, in_place=in_place, uses_f=by_grad)
        what = "rate of a balance" if name is None else f"rate of balance {name!r}"
        shape = (self.size,) if self.size and self.size > 1 else ()
        rate = by_pointer(rate, what, GRADIENT, takes_f=uses_f, shape=shape)
        if rate is not None and not callable(rate):
            raise TypeError(f"Balance: rate must be callable or None, got {rate!r}.")
        directions = _directions(components, weights)
        self.subspaces = () if directions is None else (directions,)
        self.rate_function = rate
        self.rate_uses_f = uses_f and rate is not None

    @property
    def rate(self) -> Callable[..., Any] | None:
        """Return the rate, to which `args` are passed if a call omits them; None if the rate is computed."""
        if self.rate_function is None or not self.args:
            return self.rate_function
        return OwnArguments(self.rate_function, self.args, 2 + self.rate_uses_f)


def _directions(components: Any, weights: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Return `components` as integers (s, k), and the weights (s, k) of the components; None without components."""
    if components is None:
        if weights is not None:
            raise ValueError("Balance: weights are given without components; give both, or omit weights.")
        return None
    found = reals("components", components)
    if (
        found is None
        or found.ndim not in (1, 2)
        or found.size == 0
        or not np.isfinite(found).all()
        or (found % 1 != 0).any()
    ):
        raise ValueError(f"Balance: components must be integers of shape (s,) or (s, k), got {shown(components)}.")
    if found.min() < 0 or found.max() > LARGEST_INDEX or np.unique(found).size < found.size:
        raise ValueError(f"Balance: components must be different indices >= 0, got {shown(components)}.")
    places = found.astype(np.int64).reshape(len(found), -1)
    sizes = np.ones(len(places)) if weights is None else reals("weights", weights)
    if sizes is None or sizes.shape != (len(places),) or not ((sizes > 0) & (sizes < np.inf)).all():
        raise ValueError(f"Balance: weights must be {len(places)} positive numbers, got {shown(weights)}.")
    return places, np.repeat(sizes[:, None], places.shape[1], 1)
