"""`Invariant`: a conserved quantity of a system."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .functions import GRADIENT, PointerFunction, by_pointer
from .inputs import count, flag, reals, shown

if TYPE_CHECKING:
    from .particles import LinearInvariants

__all__ = ["Invariant", "as_invariants", "copied", "with_args", "with_targets"]

Array = np.ndarray


class OwnArguments:
    """A function that is called with an invariant's own `args` after the `first` arguments if a call omits them."""

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...], first: int) -> None:
        self.function, self.args, self.first = function, args, first
        self.__name__ = getattr(function, "__name__", type(function).__name__)

    def __call__(self, *given: Any) -> Any:
        """Return the value of the function."""
        return self.function(*given, *(self.args if len(given) == self.first else ()))


def copied(original: Any) -> Any:
    """Return a shallow copy of an object, about 5 times faster than `copy.copy`."""
    new = object.__new__(type(original))
    vars(new).update(vars(original))
    return new


class Invariant:
    """A conserved quantity of a system, or several at once.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> float or (l_i,)``, real. Or, like `grad`, a `scipy.LowLevelCallable` (see Notes).
    grad : callable, optional
        ``grad(t, y, *args) -> (n,) or (l_i, n)``. For complex y, dI = Re sum_k conj(g_k) dy_k. Default: the gradient
        is made of the components of f where f has them (an energy of q'' = a(t, q), or of (q, p); for compiled
        functions from 26 components on), or else computed. If `fun` is jitted by Numba, y is real and there are no
        `args`, dual numbers give a compiled gradient, exact to rounding. The gradient of a C function comes from
        central differences of order 6, in the engine. For any other function it comes from a complex step if `fun`
        allows one, otherwise from such differences (with a warning; not compiled). A complex step takes n + 1
        evaluations of `fun`, differences take 6 n and more. If a complex step is wrong for some states only, as for a
        norm or an absolute value, differences replace it at these states.
    target : float or array_like, shape (l_i,), optional
        The value to keep. Default: the value at the start. If a target is given, the start must meet it to 1e-8 of the
        largest of ``|I|``, ``|target|``, ``sum_k |G_k y_k|`` (G is the gradient) and `scale`. Steps meet it to 1e-9,
        with further Newton steps if the first one leaves more.
    args : tuple, optional
        Further arguments of `fun` and `grad`. The ``args`` of `eip_scipy.solve_ivp` and of `integrate` follow these;
        SciPy's own solve_ivp does not pass its ``args`` to invariants.
    size : int, optional
        Number l_i of the values of `fun`. It is needed for a C function that returns more than one value.
    name : str, optional
        Name in messages and diagnostics. Default: the name of the function.
    scale : float or array_like, shape (l_i,), optional
        Size of the terms that cancel in `fun`, in the unit of `fun`: residuals below four rounding errors of this size
        are not corrected. Needed only if neither the value nor ``sum_k |G_k y_k|`` has that size.
    in_place : bool, optional
        ``grad(t, y, out, *args)`` fills ``out``, (n,) for a scalar invariant, else (l_i, n).
    uses_f : bool, optional
        ``grad(t, y, f, *args)`` also receives the derivative f = fun(t, y) of the system, which the step has often
        evaluated already.

    See Also
    --------
    Balance, check_gradient, find_invariants, particle_invariants

    Notes
    -----
    Every Runge-Kutta method keeps linear invariants by itself, so that they need not be listed. `integrate` finds them
    in compiled functions, and the option ``linear_invariants`` takes them, so that corrections do not change them.

    C functions are given as `scipy.LowLevelCallable`, of the signatures
    ``int I(double t, const double *y, double *values, const double *params)`` and
    ``int G(double t, const double *y, const double *f, double *out, const double *params)``; f is the derivative of
    the state only with ``uses_f=True``; otherwise its content is undefined. See :doc:`/tutorials/compiled-functions`.

    Examples
    --------
    >>> from eip_scipy import Invariant
    >>> energy = Invariant(lambda t, y: 0.5 * (y @ y), grad=lambda t, y: y, name="energy")
    """

    # These are attributes of balances, see `Balance`.
    is_balance = False
    unaugmented: Any = None  # for invariants of augmented states, see `variations.Unaugmented`
    # The linear invariants that corrections leave unchanged in runs with this one, see `particle_invariants`.
    linear: LinearInvariants | None = None
    rate_function: Callable[..., Any] | None = None
    rate_uses_f = False
    # Components and weights (s, k) of the s directions along which all values are projected, or one such pair for every
    # value. Invariants without such pairs are projected together, along all components.
    subspaces: tuple[tuple[Array, Array], ...] = ()
    value_names: tuple[str, ...] = ()
    # A run warns that a balance hardly helps if its rate is above this share of the terms of the rate.
    most_slowness = 0.05

    def __init__(
        self,
        fun: Callable[..., Any],
        grad: Callable[..., Any] | None = None,
        *,
        target: Any = None,
        args: Sequence[Any] = (),
        size: int | None = None,
        name: str | None = None,
        scale: Any = None,
        in_place: bool = False,
        uses_f: bool = False,
    ) -> None:
        own = type(self).__name__
        in_place, uses_f = flag(f"{own}: in_place", in_place), flag(f"{own}: uses_f", uses_f)
        size = None if size is None else count(f"{own}: size", size)
        what = "an invariant" if name is None else f"invariant {name!r}"
        for given in (fun, grad):  # of another invariant, whose arguments take the place of `args` if it is empty
            args = args or given.args if isinstance(given, OwnArguments) else args
        functions: list[Any] = [item.function if isinstance(item, OwnArguments) else item for item in (fun, grad)]
        fun, grad = functions
        fun = by_pointer(fun, what, shape=(size,) if size and size > 1 else ())
        grad = by_pointer(grad, f"gradient of {what}", GRADIENT, takes_f=uses_f)
        if not callable(fun):
            raise TypeError(f"{own}: fun must be callable, got {fun!r}.")
        if grad is not None and not callable(grad):
            raise TypeError(f"{own}: grad must be callable or None, got {grad!r}.")
        if grad is None and (in_place or uses_f):
            raise ValueError(f"{own}: in_place and uses_f describe grad, but grad is missing. Give grad or omit them.")
        if not isinstance(args, tuple):
            raise TypeError(f"{own}: args must be a tuple, got {shown(args)}; write args=(x,) for a single argument.")
        if name is not None and not isinstance(name, str):
            raise TypeError(f"{own}: name must be a string, got {shown(name)}.")
        self.function, self.gradient = fun, grad
        self.target = None if target is None else _target(target)
        self.is_measured = False  # whether the target is the value at the start of an earlier run
        self.args = args
        self.size = size
        self.name = name
        self.scale = None if scale is None else _scale(scale)
        self.in_place = in_place or isinstance(grad, PointerFunction)
        self.uses_f = uses_f

    @property
    def fun(self) -> Callable[..., Any]:
        """Return the function; `args` are passed to it if a call omits them."""
        return OwnArguments(self.function, self.args, 2) if self.args else self.function

    @property
    def grad(self) -> Callable[..., Any] | None:
        """Return the gradient, to which `args` are passed if a call omits them; None if the gradient is computed."""
        if self.gradient is None or not self.args:
            return self.gradient
        return OwnArguments(self.gradient, self.args, 2 + self.uses_f + self.in_place)

    def __repr__(self) -> str:
        name = self.name or getattr(self.function, "__name__", "?")
        return f"{type(self).__name__}({name})"


def as_invariants(invariants: Any) -> tuple[Invariant, ...]:
    """Return invariants or functions f(t, y, *args) as a tuple of `Invariant`; tuples of these stay unchanged."""
    if isinstance(invariants, tuple) and all(isinstance(item, Invariant) for item in invariants):
        return invariants
    if isinstance(invariants, Invariant) or (callable(invariants) and not isinstance(invariants, type)):
        return (_as_invariant(invariants),)
    try:
        items = tuple(invariants)
    except TypeError:
        raise TypeError(
            f"invariants: got {shown(invariants)}; expected an Invariant, a function f(t, y), or a sequence of them."
        ) from None
    return tuple(map(_as_invariant, items))


def _as_invariant(item: Any) -> Invariant:
    if isinstance(item, Invariant):
        return item
    if not callable(item) or isinstance(item, type):
        raise TypeError(
            f"invariants: the sequence contains {shown(item)}; expected Invariant objects or functions f(t, y)."
        )
    name = getattr(item, "__name__", "<")
    return Invariant(item, name=None if name.startswith("<") else name)


def with_args(item: Invariant, args: tuple[Any, ...]) -> Invariant:
    """Return a copy of an invariant with `args` as its own arguments."""
    new: Invariant = copied(item)
    new.args = args
    return new


def with_targets(items: tuple[Invariant, ...], targets: Iterable[Any]) -> tuple[Invariant, ...]:
    """Return copies of invariants with the `targets`, arrays or None, of a run that continues."""
    kept = list(map(copied, items))
    for item, target in zip(kept, targets, strict=True):
        item.is_measured = item.is_measured or item.target is None
        item.target = target
    # Those of a field, which are projected together, see `problems.gross_pitaevskii`.
    return items.replaced(kept) if hasattr(items, "replaced") else tuple(kept)


def _target(target: Any) -> Array:
    found = reals("target", target)
    if found is None:
        raise ValueError(f"Invariant: target must be a number or an array of numbers, got {shown(target)}.")
    return found


def _scale(scale: Any) -> Any:
    """Return a scale as a float, or as an array with one entry for each value of the invariant."""
    found = None if isinstance(scale, bool | np.bool_) else reals("scale", scale)
    if found is None or found.ndim > 1 or found.size == 0 or not ((found >= 0) & (found < np.inf)).all():
        raise ValueError(
            "Invariant: scale must be a finite number >= 0, or an array with one such number for each value of fun, "
            f"got {shown(scale)}."
        )
    return float(found) if found.ndim == 0 else found
