"""Computation of start states that meet the constraints of a mechanical system."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ...core.inputs import real_array, shown
from ...core.invariants import Invariant, with_args
from ...core.names import nearest
from ...core.project import project
from ...engine.trust import ProjectionWarning

__all__ = ["MET", "Names", "by_name", "name_of", "nearest_start", "started"]

# A constraint is met if its residual is at most this share of its terms; the same bound holds for given targets.
MET = 1e-8
NEWTON_STEPS = 40
# Gradients depend on each other if a combination of them is below this share of the gradients.
DEPENDENT = 1e-6
# A computed component is reported if it differs from its guess by this share of its size.
SEEN = 1e-8


class Names(NamedTuple):
    """Names of coordinates, speeds, constraints on positions, and constraints on velocities."""

    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]

    @property
    def state(self) -> tuple[str, ...]:
        """Return the names of all components."""
        return (*self.coordinates, *self.speeds)

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Return the numbers of coordinates, speeds and constraints on velocities."""
        return len(self.coordinates), len(self.speeds), len(self.velocities)


def name_of(key: Any) -> str:
    """Return the name of a component from a string, or from a symbol or function of SymPy."""
    if isinstance(key, str):
        return key
    from ..symbolic.models import name_of as of_symbol

    return of_symbol(key)


def by_name(what: str, given: Mapping[Any, Any], named: Callable[[Any], str] = name_of) -> dict[str, Any]:
    """Return a mapping with names as keys; raise ValueError if two keys, such as different symbols, have one name."""
    found: dict[str, Any] = {}
    for key, value in given.items():
        name = named(key)
        if name in found:
            raise ValueError(f"{what}: two keys are called {name!r}; expected different names. Rename one.")
        found[name] = value
    return found


def started(
    what: str, names: Names, constraints: Sequence[Invariant], q0: Any, u0: Any, params: np.ndarray | None, t: float,
    independent: Iterable[Any] | None,
) -> tuple[np.ndarray, tuple[str, ...]]:  # fmt: skip
    """Return a state that meets the constraints, and notes on computed components; see `MechanicsProblem.start`.

    `constraints` is empty, or contains one `Invariant` for all constraints. `what` names the problem in messages.
    """
    held = _independent(names, independent)
    y = np.append(_numbers("q0", q0, names.coordinates, held), _numbers("u0", u0, names.speeds, held))
    if not constraints:
        return y, ()
    item = constraints[0] if params is None else with_args(constraints[0], (params,))
    sigma = np.array([0.0 if name in held else 1.0 for name in names.state])
    found = nearest_start(y, item, t, sigma) if sigma.any() else y
    if sigma.any() and not _shares(found, item, t).max() <= MET:
        # The state with the smallest sum of squares of the residuals may be nearer to a solution.
        free = np.eye(y.size)[:, sigma > 0]
        lowest = least_squares(
            lambda x: item.fun(t, y + free @ x), np.zeros(free.shape[1]),
            lambda x: _gradient(item, t, y + free @ x) @ free, x_scale="jac",
        )  # fmt: skip
        found = nearest_start(y + free @ lowest.x, item, t, sigma)
    _require_met(what, found, item, t, sigma)
    moved = [
        f"{name} {before:.6g} to {after:.6g}"
        for name, before, after in zip(names.state, y, found, strict=True)
        if abs(after - before) > SEEN * max(abs(before), abs(after))
    ]
    return found, (f"the start was solved for, from guesses: {', '.join(moved)}",) if moved else ()


def _independent(names: Names, independent: Iterable[Any] | None) -> set[str]:
    """Return the names of the components whose given values are kept: all components if `independent` is None."""
    if independent is None:
        return set(names.state)
    found = {name_of(name) for name in ([independent] if isinstance(independent, str) else independent)}
    for name in sorted(found - set(names.state)):
        raise ValueError(
            f"independent: {name!r} is not a component of the state{nearest(name, names.state)}; expected names of "
            f"{', '.join(names.state)}."
        )
    return found


def _numbers(what: str, given: Any, names: Sequence[str], held: set[str]) -> np.ndarray:
    """Return the values of a mapping or an array in the order of `names`.

    Names that are missing from a mapping have the value 0; a ValueError is raised if one of them is in `held`.
    """
    if isinstance(given, Mapping):
        found = by_name(what, given)
        for name in found.keys() - set(names):
            raise ValueError(f"{what}: unknown name {name!r}{nearest(name, names)}; expected {', '.join(names)}.")
        for name in names:
            if name in held and name not in found:
                raise ValueError(
                    f"{what}: {name} is missing; give its value, or list in independent= the components whose values "
                    "are kept, so that the others are computed."
                )
        given = [found.get(name, 0.0) for name in names]
    values = np.atleast_1d(real_array(what, given)).astype(float)
    if values.shape != (len(names),):
        raise ValueError(f"{what}: got {shown(given)}; expected {len(names)} numbers, for {', '.join(names)}.")
    return values


def nearest_start(y: np.ndarray, item: Invariant, t: float, sigma: np.ndarray) -> np.ndarray:
    """Return the state near `y` at which the residuals of `item` are 0, found by Newton's method in units of `sigma`.

    Components with `sigma` 0 do not change. Residuals remain if Newton's method does not converge.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ProjectionWarning)  # callers examine the remaining residuals
            return project(y, item, t=t, sigma=sigma, iterations=NEWTON_STEPS).y
    except ValueError:
        return y


def _gradient(item: Invariant, t: float, y: np.ndarray) -> np.ndarray:
    out = np.empty((item.size or 0, y.size))
    assert item.grad is not None
    item.grad(t, y, out)
    return out


def _shares(y: np.ndarray, item: Invariant, t: float) -> np.ndarray:
    """Return the residuals of all constraints relative to the size of their terms."""
    gradient = np.abs(_gradient(item, t, y))
    # A constraint whose terms are small has the size of its change while a component changes by 1.
    size = np.maximum(gradient @ np.abs(y), gradient.max(axis=1))
    return np.abs(item.fun(t, y)) / np.where(size > 0, size, 1.0)


def _require_met(what: str, y: np.ndarray, item: Invariant, t: float, sigma: np.ndarray) -> None:
    """Raise ValueError if a constraint is violated by more than `MET` times its size; `sigma` is 0 for kept ones."""
    shares, values, gradient = _shares(y, item, t), item.fun(t, y), _gradient(item, t, y)[:, sigma > 0]
    if shares.max() <= MET:
        return
    worst = int(np.argmax(shares))
    violated = f"the constraint {item.value_names[worst]!r}: it is {values[worst]:.3g}, expected 0."
    if not sigma.any():
        raise ValueError(
            f"{what}: the start violates {violated} List in independent= the components whose values are to be kept; "
            "the others are then computed."
        )
    sizes = np.linalg.norm(gradient, axis=1)
    found = np.linalg.svd(gradient[sizes > 0] / sizes[sizes > 0, None], compute_uv=False)
    left, why = np.abs(values) / np.where(sizes > 0, sizes, np.inf), ""
    others = [repr(item.value_names[k]) for k in np.flatnonzero(left > SEEN * left[worst]) if k != worst]
    if sizes[worst] <= DEPENDENT * sizes.max():
        why = "It does not depend on any component that is computed. "
    elif others and np.count_nonzero(found > DEPENDENT * found.max()) < np.count_nonzero(sizes):
        why = (
            f"It contradicts {', '.join(others)}, because the gradients of these constraints depend on each other "
            "at the end of the search. If no start can meet all of them, remove one. "
        )
    raise ValueError(
        f"{what}: no start was found that meets {violated} {why}List fewer components in independent=, or give a guess "
        "that is nearer to a solution."
    )
