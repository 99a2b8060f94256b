"""Calls of a user, which mypy checks as by --strict: correct ones, then wrong ones whose errors types show."""

import numpy as np
from numpy.typing import NDArray

from eip_scipy import EIPDOP853, EIPRK4, Diagnostics, Invariant, ensemble, integrate, recommend, solve_ivp
from eip_scipy.results import OdeResult

Array = NDArray[np.float64]


def fun(t: float, y: Array, k: float) -> list[float]:
    return [y[1], -k * y[0]]


def energy(t: float, y: Array, k: float) -> float:
    return float(0.5 * (y[1] ** 2 + k * y[0] ** 2))


def run(tight: float) -> OdeResult:
    sol = solve_ivp(
        fun,
        (0, 1),
        [1.0, 0.0],
        EIPDOP853,
        np.linspace(0, 1, 3),
        events=[energy],
        args=(2.0,),
        rtol=tight,
        atol=[1e-9, 1e-12],
        invariants=[energy, Invariant(energy, name="H")],
        metric="euclidean",
        every="auto",
        direction="old",
        blocks=[[0, 1]],
        project_initial=False,
        diagnostics=Diagnostics(),
    )
    residual: float = sol.diagnostics.max_residual.max()
    text: str = sol.message
    print(sol.y[:, -1], sol["t"], residual, text, sol.t_events[0] if sol.t_events else None)
    plain: OdeResult = solve_ivp(fun, [0, 1], np.ones(2), "Radau", args=[2.0], jac=lambda t, y, k: np.eye(2))
    return sol if sol.trusted and plain.success else plain


longer = integrate(fun, (0, 1), [1.0, 0.0], method=EIPDOP853, invariants=energy, blocks=2).continue_to(3)
members = ensemble(fun, (0, 1), np.ones((3, 2)), h=0.1, method=EIPRK4, invariants=energy, args=(2.0,), every=2)
largest: float = max(longer.max_residual.max(), members.max_residual.max())
choice = recommend(fun, (0, 1), [1.0, 0.0], invariants=energy, params=[2.0], metric="euclidean")
print(longer.diagnostics.moved + longer.message, members.reduced, choice.reason, largest)
# Each statement below has the error that is named: where types do not show it, mypy reports an unused ignore.
solve_ivp(fun, (0, 1), [1.0, 0.0], hh=0.01)  # type: ignore[call-arg]
solve_ivp(fun, (0, 1), [1.0, 0.0], invariants=3)  # type: ignore[arg-type]
solve_ivp(fun, (0, 1), [1.0, 0.0], iterations="two")  # type: ignore[arg-type]
solve_ivp(fun, (0, 1), [1.0, 0.0], metric="taxicab")  # type: ignore[arg-type]
solve_ivp(fun, (0, 1), [1.0, 0.0], direction="up")  # type: ignore[arg-type]
print(solve_ivp(fun, (0, 1), [1.0, 0.0]).succes)  # type: ignore[attr-defined]
integrate(fun, (0, 1), [1.0, 0.0], hh=0.01)  # type: ignore[call-arg]
ensemble(fun, (0, 1), np.ones((3, 2)), hh=0.1)  # type: ignore[call-arg]
recommend(fun, (0, 1), [1.0, 0.0], every=2)  # type: ignore[call-arg]
print(longer.trustd)  # type: ignore[attr-defined]
print(members.trustd)  # type: ignore[attr-defined]
