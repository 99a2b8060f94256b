"""Solvers of a state that is distributed over several processes, which compute the projection together.

A subclass connects this module to a library for messages: it defines `place` and `gathered`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..engine.data import NO_METHOD, Work
from ..engine.native import Call, Engine, PythonFunctions
from .blocks import blocks_of
from .invariants import InvariantSet
from .solvers import EIPSolver

__all__ = ["SolverOfParts"]

DEPENDENT = 2.0**-26  # bound for the remainder of a normalised gradient that is a combination of others
SCALARS = {"values", "g", "band", "before", "defect", "max_defect", "max_correction", "norm", "counters"}


class SolverOfParts(EIPSolver):
    """Base class of solvers of a distributed state; every process creates a solver with its part of the state.

    The right-hand side fills a part of the derivative. An invariant returns the same number on every process, and its
    gradient returns only the components of this process's part. Only fixed steps and the Euclidean metric are
    supported.
    """

    _in_parts = True
    _fails_elsewhere = False

    @property
    def place(self) -> tuple[int, int]:
        """Return the number of this process, counted from 0, and the number of processes."""
        raise NotImplementedError

    def gathered(self, a: Any) -> np.ndarray:
        """Return the arrays `a` that all processes pass to this method, stacked in the order of the processes."""
        raise NotImplementedError

    @property
    def known(self) -> InvariantSet:
        """Return the invariants of the run."""
        return self._run.invariants

    def _hooks(self) -> dict[str, Any]:
        if self.known.balances.items:
            raise ValueError("invariants: a Balance is not supported for a state on several processes; omit it.")
        return {"agree": self._all_agree, "project": _Coordinates(self).project}

    def _all_agree(self, here: bool) -> bool:
        """Return True if the step succeeded on all processes; `here`: whether it did so on this one.

        A step that fails on one process must fail on all of them, because they must take the same steps.
        """
        agreed = bool(self.gathered(here).all())
        self._fails_elsewhere = here and not agreed
        return agreed

    def _step_impl(self) -> tuple[bool, str | None]:
        done, message = super()._step_impl()
        if self._fails_elsewhere:
            message = f"the state is no longer finite on another process, in the step from t={self.t:.10g}"
        return done, message


class _Coordinates:
    """The projection in coordinates of the space that the gradients span; the origin is the unprojected state.

    The engine calls `rhs`, `inv` and `grad` with the coordinates c of all processes: ``c[rank * l + i]`` multiplies row
    i of the orthonormal basis on process number `rank`.
    """

    def __init__(self, solver: SolverOfParts) -> None:
        run, size = solver._run, solver.known.size
        rank, ranks = solver.place
        self._gathered, self._derivative, self._run = solver.gathered, solver._derivative, run
        self._own, n = slice(rank * size, (rank + 1) * size), ranks * size
        each = blocks_of(None, n, 1)
        # `scales` will hold the sizes of the invariants' terms, which do not follow from the coordinates.
        self._options = run.options._replace(
            rtol=np.zeros(n), atol=np.zeros(n), block_atol=np.zeros(n), groups=each, kinds=each, joint=None,
            scales=np.empty(size), computed=np.zeros(size),
        )  # fmt: skip
        self._work = Work(n, float, 0, size, n)
        self._work.share(run.work, SCALARS)
        functions = PythonFunctions(
            Call(self.rhs, (), (n,), _given),
            (Call(self.inv, (), (size,), _given),),
            (Call(self.grad, (), (size, n), _given),),
            (),
            second_order=False,
        )
        self._engine = Engine(NO_METHOD, self._options, self._work, functions)
        self._origin, self._moved = np.zeros(n), np.zeros(n)
        self._basis = run.work.Q
        self._begins = False

    def project(self, t_old: float, t: float, last: bool, y_new: np.ndarray) -> int:
        """Project the unprojected state of the run, write the result to `y_new`, and return the engine's status."""
        self._begins = True
        status: int = self._engine.project(t_old, self._origin, t, last, self._moved)
        y_new[:] = self._at(self._moved)
        return status

    def rhs(self, t: float, c: np.ndarray) -> np.ndarray:
        """Compute the derivative at c and store it for `grad`; the returned coordinates are not used."""
        self._run.work.f_point[:] = self._derivative(t, self._at(c))
        return self._origin

    def inv(self, t: float, c: np.ndarray) -> np.ndarray:
        """Return the invariants (l,) at c."""
        return self._run.invariants.values(t, self._at(c))

    def grad(self, t: float, c: np.ndarray) -> np.ndarray:
        """Return the coordinates (l, ranks * l) of the gradients; the basis is chosen at the start of a projection."""
        w, size = self._run.work, self._options.scales.size
        begins, self._begins = self._begins, False
        w.G[:] = self._run.invariants.gradients(t, self._at(c), w.K[-1] if begins else w.f_point)
        if begins:
            _orthonormal_rows(w.G.view(float), self._basis)
        part = np.empty((size, size + 1))
        # NumPy loops instead of BLAS, whose threads on each of the ranks would compete.
        np.einsum("ij,kj->ik", w.G.view(float), self._basis, out=part[:, :-1])
        np.einsum("ij,j->i", np.abs(w.G.view(float)), np.abs(w.y_hat.view(float)), out=part[:, -1])
        parts = self._gathered(part)
        if begins:
            np.maximum(self._run.options.scales, parts[:, :, -1].sum(axis=0), out=self._options.scales)
        return parts[:, :, :-1].swapaxes(0, 1).reshape(size, -1)

    def _at(self, c: np.ndarray) -> np.ndarray:
        """Return this process's part of the state at c, in a buffer."""
        w = self._run.work
        if not c.any():
            return w.y_hat
        np.einsum("i,ij->j", c[self._own], self._basis, out=w.stage.view(float))
        np.add(w.y_hat.view(float), w.stage.view(float), out=w.stage.view(float))
        return w.stage


def _given(value: Any, t: float) -> np.ndarray:
    return np.ascontiguousarray(value, float)


def _orthonormal_rows(rows: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` with an orthonormal basis of the space of the rows; a row that depends on earlier rows gives zeros.

    If the rows are not finite, `out` is filled with NaN. Two passes of Gram-Schmidt give orthogonality to round-off.
    """
    for k, row in enumerate(rows):
        unit, before = out[k], out[:k]
        unit[:] = row
        length = _length(unit)
        if not np.isfinite(length):
            out[:] = np.nan
            return
        if length > 0.0:
            unit /= length
        for _ in range(2):
            unit -= np.einsum("i,ij->j", np.einsum("ij,j->i", before, unit), before)
            length = _length(unit)
            unit *= 1.0 / length if length > DEPENDENT else 0.0


def _length(row: np.ndarray) -> float:
    return float(np.sqrt(np.einsum("i,i->", row, row)))
