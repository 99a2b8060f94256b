"""Tangent vectors: derivatives of a state that are integrated with it, together as one augmented state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import OdeSolution

from ..engine.data import EUCLIDEAN, GIVEN
from ..engine.data import Columns as EngineVectors
from .inputs import reals, shown
from .projection import INDEX

__all__ = ["NO_TANGENT_VECTORS", "StateSolution", "TangentVectors", "tangent_vectors"]

Array = np.ndarray
STATE = "state"


@dataclass(frozen=True)
class TangentVectors:
    """The tangent vectors at the start of a run, and the places of all numbers in the augmented state (m,).

    `initial` (n + p, k) has the vectors as columns; the last p rows belong to the parameters with the indices
    `parameters` and are constant. The first n vectors are the state-transition matrix from the first start if
    `is_transition`, which is kept symplectic if `symplectic`. An augmented state consists of the state, the p
    parameters and the vectors, one after the other; or of all positions and then all velocities, as Nystrom methods
    need it, if `in_halves`. Without vectors (`NO_TANGENT_VECTORS`) it is the state.
    """

    initial: Array
    parameters: tuple[int, ...] = ()
    is_transition: bool = False
    in_halves: bool = False
    symplectic: bool = False

    @property
    def size(self) -> int:
        """Return the length n + p of a vector."""
        return len(self.initial)

    @property
    def n(self) -> int:
        """Return the number of components of the state."""
        return self.size - len(self.parameters)

    @property
    def count(self) -> int:
        """Return the number k of vectors."""
        return self.initial.shape[1]

    @cached_property
    def order(self) -> Array:
        """Return places (1 + k, n + p) in the augmented state: row 0 of the state and parameters, row j of vector j."""
        places = np.arange(self.size * (1 + self.count))
        if not self.in_halves:
            return places.reshape(1 + self.count, self.size)
        return np.concatenate(places.reshape(2, 1 + self.count, self.n // 2), axis=1)

    @cached_property
    def _places(self) -> Array | slice:
        """Return the places of the state; NumPy is faster with a slice."""
        return self.order[0] if self.in_halves else slice(self.n)

    def augmented(self, y: Array, params: Array, vectors: Array | None = None) -> Array:
        """Return augmented states (..., m) of `y` (..., n), the entries of `params` for `parameters`, and vectors.

        The `vectors` (..., k, n + p) are rows; `initial` if they are None.
        """
        out = np.empty((*y.shape[:-1], self.order.size))
        out[..., self.order[0]] = np.concatenate([y, params[..., list(self.parameters)]], axis=-1)
        out[..., self.order[1:]] = self.initial.T if vectors is None else vectors
        return out

    def state(self, rows: Array) -> Array:
        """Return the states (..., n) in augmented states (..., m), as copies; `rows` itself without vectors."""
        if not self.count or rows.shape == (0,):  # the empty array of an event that did not happen
            return rows
        return np.array(rows[..., self._places])

    def split(self, rows: Array) -> tuple[Array, Array]:
        """Return states (..., n) and vectors (..., n, k) of augmented states (..., m)."""
        blocks = rows[..., self.order]
        return blocks[..., 0, : self.n], blocks[..., 1:, : self.n].swapaxes(-1, -2)

    def with_state(self, rows: Array, y: Array) -> Array:
        """Return a copy of the augmented state `rows` with another state; `y` itself without vectors."""
        if not self.count:
            return y
        out = rows.copy()
        out[self._places] = y
        return out

    def of_state(self, rhs: Callable[..., Array], rows: Array) -> Callable[..., Array]:
        """Return a right-hand side of augmented states as one of states, with the vectors of `rows`."""
        return (lambda t, y: self.state(rhs(t, self.with_state(rows, y)))) if self.count else rhs

    def arguments(self, rows: Array, extra: tuple) -> tuple:
        """Return the arguments ``(params,)`` with the parameters that are in an augmented state."""
        params = extra[0].copy()
        params[list(self.parameters)] = rows[self.n : self.size]
        return (params,)

    def spread(self, values: Any, shape: tuple[int, ...] = (), by_parameters: Any = 0.0) -> Array:
        """Return an array (*shape, m) of `values` for the state, of others for the parameters, and of 0 elsewhere."""
        out = np.zeros((*shape, self.order.size))
        out[..., self._places] = values
        if self.parameters:
            out[..., self.n : self.size] = by_parameters
        return out

    def options(self, options: Any, sigma: Array | None, G: Array) -> tuple[Any, Array | None]:
        """Return the options and the weights (m,) of the error metric for augmented states from those for the state.

        `G` (l, m) contains the gradients of the invariants at the start, with respect to the augmented state.
        """
        if not self.count:
            return options, sigma
        places = self.order[0]

        def moved(indices: Array) -> Array:
            return places[indices.astype(np.intp)].astype(INDEX)

        vectors = EngineVectors(
            kept=np.cumsum(G[:, places, None] * self.initial, axis=1)[:, -1].copy(), size=self.size, seen=self.n,
            half=self.n // 2 if self.in_halves else 0, symplectic=self.symplectic,
        )  # fmt: skip
        blocks, kinds = (item._replace(member=moved(item.member), size=0) for item in (options.blocks, options.kinds))
        options = options._replace(
            rtol=self.spread(options.rtol), atol=self.spread(options.atol), blocks=blocks, kinds=kinds, columns=vectors,
            joint=None, metric=GIVEN if options.metric == EUCLIDEAN and self.parameters else options.metric,
            frame=options.frame._replace(bodies=np.zeros((2, 0, 0)), place=moved(options.frame.place)),
        )  # fmt: skip
        return options, self.spread(1.0 if sigma is None else sigma)

    @property
    def identity(self) -> dict[str, Any]:
        """Return by name the properties that a checkpoint stores, because results depend on them."""
        return {"variations": self.initial, "derivatives by": self.parameters, "symplectic": self.symplectic}

    def restarted(self, rows: Array) -> TangentVectors:
        """Return the vectors at the start of a run that continues from an augmented state."""
        return replace(self, initial=rows[self.order[1:]].T.copy())

    def kept_symplectic(self, asked: bool | None, canonical: bool, reason: str | None) -> TangentVectors:
        """Return the vectors with `symplectic` as `asked`, by default as `canonical`, the problem's, where possible.

        `reason` says why the steps do not project vectors, or is None if they do.
        """
        if not self.is_transition or self.parameters:
            reason = (
                "derivatives with respect to parameters or along given directions are not a state-transition matrix; "
                'use variations="state"'
            )
        elif self.n % 2:
            reason = f"a state of {self.n} components is not (q, p); omit symplectic"
        if asked and reason is not None:
            raise ValueError(f"symplectic=True: {reason}.")
        return replace(self, symplectic=reason is None and (canonical if asked is None else bool(asked)))


NO_TANGENT_VECTORS = TangentVectors(np.zeros((0, 0)))


class StateSolution(OdeSolution):
    """Dense output of the state alone, made from the dense output of an augmented state."""

    def __init__(self, solution: OdeSolution, tangents: TangentVectors) -> None:
        super().__init__(solution.ts, solution.interpolants)
        self.tangents = tangents

    def __call__(self, t: Any) -> Array:
        """Return the state (n,) at the time t, or the states (n, m) at m times."""
        return self.tangents.state(super().__call__(t).T).T


def tangent_vectors(asked: Any, method: Any, y0: Array, params: Array, names: Sequence[str] = ()) -> TangentVectors:
    """Return the vectors for the option `variations`, `asked`; `params` and `names` are the run's parameters."""
    if method.TABLEAU.in_python:
        raise ValueError(
            f"variations: {method.__name__} carries no derivatives, because its steps do not consist of stages of a "
            "tableau or of a multistep formula. Use EIPDOP853, EIPRKN12, EIPGJ12 or another explicit method."
        )
    in_halves = method.TABLEAU.of_second_order
    if isinstance(asked, TangentVectors):  # of a run that is continued
        return replace(asked, in_halves=in_halves)
    if y0.dtype.kind == "c":
        raise ValueError("variations: the state is complex; write it in real and imaginary parts.")
    items = [asked] if _is_name(asked) else asked
    if isinstance(items, list | tuple) and items and all(map(_is_name, items)):
        own = tuple(_parameter(item, params, names) for item in items if item != STATE)
        if own and in_halves:
            raise ValueError(
                f"variations: {method.__name__} gives no derivatives with respect to parameters. Use EIPDOP853 or "
                "another Runge-Kutta method."
            )
        if len(set(own)) < len(own) or list(items).count(STATE) > 1:
            raise ValueError(f"variations: {shown(asked)} asks for the same derivatives twice.")
        identity = np.eye(y0.size + len(own))
        return TangentVectors(identity[:, 0 if STATE in items else y0.size :], own, STATE in items, in_halves)
    found = reals("variations", asked)
    initial: Array = np.zeros(0) if found is None else np.array(found, float)
    if initial.shape == y0.shape:
        initial = initial[:, None]
    if initial.ndim != 2 or len(initial) != y0.size or not initial.size or not np.isfinite(initial).all():
        raise ValueError(
            f'variations must be "state" for all {y0.size} columns of the state-transition matrix, names or indices of '
            f"parameters, a list of these, or an array ({y0.size}, k) of finite initial columns, got {shown(asked)}."
        )
    return TangentVectors(initial, in_halves=in_halves)


def _is_name(item: Any) -> bool:
    """Return True if an item is "state", or the name or the index of a parameter."""
    return isinstance(item, str | int | np.integer) and not isinstance(item, bool)


def _parameter(item: Any, params: Array, names: Sequence[str]) -> int:
    """Return the index of a parameter from its name or index."""
    if isinstance(item, str):
        if item not in names:
            known = f"; it has {', '.join(names)}" if names else "; give its index in params instead"
            raise ValueError(f"variations: the run has no parameter {item!r}{known}.")
        return list(names).index(item)
    if not 0 <= item < params.size:
        raise ValueError(f"variations: there is no parameter {item}; params has {params.size} entries, counted from 0.")
    return int(item)
