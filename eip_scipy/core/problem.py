"""The record that a scene hands to a driver: equations, state, invariants, and what the step needs to know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..engine.native import library
from .inputs import refuse_units
from .invariants import Invariant
from .pointers import by_pointer

__all__ = ["Problem", "bind", "native_invariant"]


@dataclass(frozen=True, eq=False)
class Problem:
    """A conservative initial value problem.

    A problem knows no solver. `integrate` takes it whole: ``integrate(problem, method=EIPRK4)``; through SciPy it is
    ``solve_ivp(problem.fun, problem.t_span, problem.y0, method=EIPRK4, h=problem.h, invariants=problem.invariants,
    blocks=problem.blocks, frame=problem.frame)``.

    Attributes
    ----------
    name : str
        Short name, as on the command line.
    fun : callable
        ``fun(t, y) -> (n,)``, parameters bound: what SciPy takes.
    y0 : ndarray, shape (n,)
        Initial state, float64 or complex128.
    t_span : tuple of float
        Start and end in the problem's unit of time.
    invariants : tuple of Invariant
        The invariants that the equations have (linear ones in `frame`), with ``args=(params,)``.
    rhs : callable, optional
        Compiled right-hand side in place: ``rhs(t, y, out, params)``, or a C function by pointer.
    acc : callable, optional
        For q'' = a(t, q): ``acc(t, q, params) -> (n/2,)``, compiled; the state is (q, v).
    h : float, optional
        A sensible fixed step.
    params : ndarray, optional
        Parameters of `rhs`, `acc` and the invariants' functions.
    metric, blocks, frame
        Options of the projection that suit the problem (see `EIPSolver`).
    units : str
        Units of the state and of time.
    jacobian : callable, optional
        For q'' = a(t, q): ``jacobian(t, q, dq, out, params)`` fills `out` with the derivative of the accelerations
        along dq, or with its largest part; for multistep methods such as `EIPGJ14`.
    frequencies : callable, optional
        ``frequencies(y) -> (bodies, others)``: the largest angular frequency of each body on its orbit about the body
        that the Jacobian takes as the centre, which has 0 itself, and the largest of all other motions.
    reference : callable, optional
        ``reference(t) -> y``: a closed form, or stored reference states; None at times without one.
    source : str
        Where the equations and data come from.
    """

    name: str
    fun: Callable[..., Any]
    y0: np.ndarray
    t_span: tuple[float, float]
    invariants: tuple[Any, ...] = ()
    rhs: Callable[..., None] | None = None
    acc: Callable[..., np.ndarray] | None = None
    h: float | None = None
    params: np.ndarray | None = None
    metric: Any = None
    blocks: Any = None
    frame: tuple[np.ndarray, np.ndarray] | None = None
    units: str = ""
    reference: Callable[[float], np.ndarray | None] | None = None
    source: str = ""
    jacobian: Callable[..., None] | None = None
    frequencies: Callable[[np.ndarray], tuple[np.ndarray, float]] | None = None

    def __post_init__(self) -> None:
        refuse_units(y0=self.y0, t_span=self.t_span, h=self.h, params=self.params, metric=self.metric, frame=self.frame)
        object.__setattr__(self, "rhs", by_pointer(self.rhs, "rhs"))


def bind(rhs: Callable[..., None], params: np.ndarray | None) -> Callable[[float, np.ndarray], np.ndarray]:
    """``fun(t, y)`` from ``rhs(t, y, out, params)``, or ``rhs(t, y, out)`` without; it pickles where `rhs` does."""
    return partial(_derivative, rhs, () if params is None else (params,))


def _derivative(rhs: Callable[..., None], extra: tuple[np.ndarray, ...], t: float, y: np.ndarray) -> np.ndarray:
    y = np.ascontiguousarray(y)
    out = np.empty_like(y)
    rhs(t, y, out, *extra)
    return out


def native_invariant(function: str, name: str, params: np.ndarray) -> Invariant:
    """An invariant by the function of `library` of that name and its gradient."""
    fun, grad = library[function], library[f"{function}_gradient"]
    return Invariant(fun, grad, args=(params,), in_place=True, uses_f=grad.takes_f, name=name)
