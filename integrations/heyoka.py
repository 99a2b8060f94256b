"""heyoka: its Taylor integrator with the projection onto invariants.

heyoka (F. Biscani, D. Izzo, MNRAS 504 (2021) 2614-2628) is free software under the MPL and not distributed with this
package; versions from 7.10 are tested.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eip_scipy.core.inputs import count, shown
from eip_scipy.engine.data import EPS, LARGE_SHARE
from eip_scipy.engine.trust import ProjectionWarning

try:
    import heyoka
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.heyoka needs heyoka: pip install "eip_scipy[heyoka]"', name="heyoka"
    ) from error

__all__ = ["ProjectedTaylor", "TaylorOutput"]

# Gradients that are linearly dependent up to this factor reduce the rank: the square of that of the engine.
DEPENDENT = EPS
# Expressions with more products than this are compiled in heyoka's compact mode, which takes less time to compile.
MOST_PRODUCTS = 200
# Residuals of correct runs after a projection are below this number of rounding errors of their terms.
REMAINS = 400.0
POINTS = 1024  # of a grid that are handed to heyoka at once, because it copies them
TIME_LIMIT, STEP_LIMIT = heyoka.taylor_outcome.time_limit, heyoka.taylor_outcome.step_limit


class ProjectedTaylor:
    """Taylor integrator of heyoka whose state is projected onto invariants after every `every` steps.

    heyoka makes the steps, with its own events and dense output, and compiles the projection, which is one Newton step.
    Rows of `propagate_grid` and values of the dense output are projected, too. Where gradients are linearly dependent,
    the projection has a smaller rank. The methods warn with a `ProjectionWarning` if invariant errors are too large to
    be errors of accurate steps.

    Parameters
    ----------
    integrator : heyoka.taylor_adaptive
        Integrator in double precision. Its present state defines the values that are kept. It is used, not copied.
    invariants : sequence or mapping of heyoka.expression
        Expressions of the state variables and of the integrator's parameters; a mapping gives them names.
    every : int, optional
        Number of steps between two projections, each of which takes about 10 microseconds: if a step takes longer than
        that, small numbers are better. Default: 1024 if the integrator's tolerance is at most 1e-12, else 256.

    Attributes
    ----------
    targets : ndarray, shape (l,)
        Values of the invariants that are kept. After you have changed the state of the integrator, assign
        ``targets = values``.
    max_residual : ndarray, shape (l,)
        Largest magnitude of each invariant error before a projection, since this object was made.
    n_projections : int
        Number of projections of the integrator's state.

    Raises
    ------
    TypeError
        If the integrator is not a ``heyoka.taylor_adaptive`` in double precision, or has variational equations.
    ValueError
        If there are no invariants, or an invariant contains variables or parameters that the integrator does not have,
        depends on time, or is not finite at the present state.
    """

    def __init__(self, integrator: Any, invariants: Any, *, every: int | None = None) -> None:
        if not isinstance(integrator, heyoka.taylor_adaptive_dbl) or integrator.is_variational:
            raise TypeError(
                f"ProjectedTaylor: expected a heyoka.taylor_adaptive in double precision, without variational "
                f"equations, got {shown(integrator)}."
            )
        every = (1024 if integrator.tol <= 1e-12 else 256) if every is None else every
        self.integrator, self._every = integrator, count("every", every)
        named = _named(invariants, integrator)
        # Parameters and targets are variables of the compiled functions: heyoka takes microseconds to read parameters.
        names, pars = [name for name, _ in integrator.sys], _variables("__par", len(integrator.pars))
        replaced = {heyoka.par[k]: par for k, par in enumerate(pars)}
        self.names, expressions = tuple(named), [heyoka.subs(item, replaced) for item in named.values()]
        self._function = _projection(names, pars, expressions)
        self._checked = _examination(names, pars, expressions)
        self.n_projections, self.max_residual = 0, np.zeros(len(expressions))
        self.targets = self.values
        if not np.isfinite(self.targets).all():
            raise ValueError(
                f"the invariants {self.names} have the values {self.targets} at the start; expected finite numbers."
            )

    @property
    def values(self) -> np.ndarray:
        """Values of the invariants at the present state, shape (l,)."""
        return self._examined()[0]

    def propagate_until(self, t: float, *, c_output: bool = False, **options: Any) -> tuple[Any, ...]:
        """Integrate to `t`, before or after the present time, as ``heyoka.taylor_adaptive.propagate_until``.

        Parameters
        ----------
        t : float
        c_output : bool, optional
            Return a dense output, too.
        **options
            Options ``max_delta_t`` and ``callback`` of heyoka; a callback sees states before their projection.

        Returns
        -------
        tuple
            As by heyoka: outcome, smallest and largest step, number of steps, the dense output or None, callback. The
            dense output, a function of times, stores one state for each projection and integrates again from there.
        """
        starts: list[Any] | None = [] if c_output else None
        found = self._run(lambda: self.integrator.propagate_until(t, max_steps=self._every, **options), starts)
        return (*found[:4], None if starts is None else TaylorOutput(self, starts), found[5])

    def propagate_grid(self, grid: Any, **options: Any) -> tuple[Any, ...]:
        """Integrate over a grid of times (m,), as ``heyoka.taylor_adaptive.propagate_grid``.

        Options are those of `propagate_until`. Returns, as by heyoka, outcome, smallest and largest step, number of
        steps, callback, and the states (m, n), fewer if an event or a callback ended the run.
        """
        grid = np.ascontiguousarray(grid, dtype=float)
        rows = [self.integrator.state[None].copy()]
        at, done = grid[:1], 1

        def advance() -> tuple[Any, ...]:
            nonlocal at, done
            ahead = np.concatenate([at, grid[done : done + POINTS]])
            found = self.integrator.propagate_grid(ahead, max_steps=self._every, **options)
            at = [self.integrator.time]
            rows.append(found[-1][1:])
            done += len(rows[-1])
            return (STEP_LIMIT if found[0] == TIME_LIMIT and done < grid.size else found[0], *found[1:])

        found = self._run(advance, None) if grid.size > 1 else self.integrator.propagate_grid(grid, **options)
        return (*found[:5], self._projected(np.concatenate(rows), self._known()))

    def _projected(self, y: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return the projections (m, n) of the states `y` (m, n); `known` are the parameters and then the targets."""
        z = np.concatenate([y.T, np.repeat(known[:, None], len(y), axis=1)])
        return self._function(np.ascontiguousarray(z))[: y.shape[1]].T.copy()

    def _run(self, advance: Any, starts: list[Any] | None) -> tuple[Any, ...]:
        """Alternate calls of `advance` and projections until a call ends for another reason than its number of steps.

        ``advance()`` lets heyoka make up to `every` steps; this and `_run` return what heyoka returns. If `starts` is a
        list, the time and state at the start of each call are appended to it.
        """
        state, function = self.integrator.state, self._function
        z, out = np.concatenate([state, self._known()]), np.empty(state.size + len(self.names))
        at, projected, residuals = z[: state.size], out[: state.size], out[state.size :]
        largest, steps, least, most = self.max_residual, 0, np.inf, 0.0
        found: tuple[Any, ...] = (STEP_LIMIT,)
        while found[0] == STEP_LIMIT:
            if starts is not None:
                starts.append((self.integrator.dtime, state.copy()))
            found = advance()
            steps += found[3]
            least, most = min(least, found[1]), max(most, found[2])
            at[:] = state
            function(z, out)
            state[:] = projected
            np.maximum(largest, np.abs(residuals, out=residuals), out=largest)
            self.n_projections += 1
        self._judge(residuals)
        return (found[0], least, most, steps, *found[4:])

    def _known(self) -> np.ndarray:
        return np.concatenate([self.integrator.pars, self.targets])

    def _examined(self) -> list[np.ndarray]:
        return np.split(self._checked(np.concatenate([self.integrator.state, self.integrator.pars])), 2)

    def _judge(self, before: np.ndarray) -> None:
        """Warn about each invariant whose errors are too large to be errors of accurate steps.

        The last projection did not reduce them from `before` (l,), or they were a large share of the invariant's terms.
        """
        values, terms = self._examined()
        after = np.abs(self.targets - values)
        for k, name in enumerate(self.names):
            remains = not after[k] <= max(before[k], REMAINS * EPS * terms[k])
            if remains or self.max_residual[k] > LARGE_SHARE * terms[k]:
                warnings.warn(
                    f"invariant {name!r} had errors of up to {self.max_residual[k]:.3g} before projections, and "
                    f"{after[k]:.3g} after the last one; its terms are of size {terms[k]:.3g}. Decrease tol or every, "
                    "and check that it is an invariant of this system.",
                    ProjectionWarning,
                    stacklevel=4,
                )


class TaylorOutput:
    """Dense output of a run: a function of times between ``bounds[0]`` and ``bounds[1]`` that returns projected states.

    `flow` made the run. `starts` contains the time and state at the start of the run and after each projection except
    the last, as `ProjectedTaylor._run` stores them; the output integrates again from these.
    """

    def __init__(self, flow: ProjectedTaylor, starts: Sequence[Any]) -> None:
        own = flow.integrator
        self.bounds = float(starts[0][0][0]), float(own.time)
        self._flow, self._starts, self._known = flow, starts, flow._known()
        self._sign = 1.0 if self.bounds[1] >= self.bounds[0] else -1.0
        self._times = np.array([time[0] for time, _ in starts])
        alike = {name: getattr(own, name) for name in ("pars", "tol", "high_accuracy", "compact_mode")}
        self._again = heyoka.taylor_adaptive(own.sys, own.state, **alike)

    def __call__(self, t: Any) -> np.ndarray:
        """Return the state (n,) at one time, or states (m, n) at times (m,)."""
        times = np.atleast_1d(np.asarray(t, dtype=float))
        if not ((times - self.bounds[0]) * (times - self.bounds[1]) <= 0).all():
            raise ValueError(f"the dense output reaches from {self.bounds[0]} to {self.bounds[1]}, got t={shown(t)}.")
        order = np.argsort(self._sign * times, kind="stable")
        block = np.searchsorted(self._sign * self._times, self._sign * times[order], side="right") - 1
        rows = np.empty((times.size, self._again.dim))
        for k in np.unique(block):
            chosen = order[block == k]
            self._again.dtime, self._again.state[:] = self._starts[k]
            ahead, place = np.unique(self._sign * np.append(times[chosen], self._times[k]), return_inverse=True)
            rows[chosen] = self._again.propagate_grid(self._sign * ahead)[-1][place[:-1]]
        rows = self._flow._projected(rows, self._known)
        return rows if np.ndim(t) else rows[0]


def _named(invariants: Any, integrator: Any) -> dict[str, Any]:
    """Check the invariants, and return their expressions by name."""
    if not isinstance(invariants, Mapping):
        invariants = {f"invariant {k}": item for k, item in enumerate(invariants)}
    named = {str(name): item for name, item in invariants.items()}
    if not named:
        raise ValueError("ProjectedTaylor: expected at least one invariant; without any, use heyoka's integrator.")
    known = {str(name) for name, _ in integrator.sys}
    own = {str(heyoka.par[k]) for k in range(len(integrator.pars))}
    for name, item in named.items():
        others = set(heyoka.get_variables(item)) - known | set(map(str, heyoka.get_params(item))) - own
        if others:
            raise ValueError(
                f"invariant {name!r} contains {', '.join(sorted(others))}, which the integrator does not have; its "
                f"variables are {', '.join(sorted(known))}, and it has {len(own)} parameters."
            )
        if heyoka.cfunc([item], [variable for variable, _ in integrator.sys]).is_time_dependent:
            raise ValueError(f"invariant {name!r} depends on time; make time a variable of the system.")
    return named


def _projection(names: list[Any], pars: list[Any], expressions: list[Any]) -> Any:
    """Compile a function of state, parameters and targets that returns the projected state and the residuals.

    The residuals (l,) are the targets minus the invariants `expressions`. The function adds the correction x of
    smallest norm with G x = residuals to the state; the rows of G, the gradients, are made orthogonal in turn.
    """
    targets = _variables("__target", len(expressions))
    basis: list[list[Any]] = []
    moves: list[Any] = []
    residuals = [target - item for target, item in zip(targets, expressions, strict=True)]
    for item, residual in zip(expressions, residuals, strict=True):
        row = [heyoka.diff(item, name) for name in names]
        size, rest = _dot(row, row), residual
        for direction, move in zip(basis, moves, strict=True):
            share = _dot(row, direction)
            row = [a - share * b for a, b in zip(row, direction, strict=True)]
            rest = rest - share * move
        left = _dot(row, row)
        inverse = heyoka.select(heyoka.gt(left, DEPENDENT * size), 1.0 / heyoka.sqrt(left), heyoka.expression(0.0))
        basis.append([a * inverse for a in row])
        moves.append(rest * inverse)
    projected = [
        name + heyoka.sum([move * direction[k] for move, direction in zip(moves, basis, strict=True)])
        for k, name in enumerate(names)
    ]
    compact = len(names) * len(expressions) ** 2 > MOST_PRODUCTS
    return heyoka.cfunc([*projected, *residuals], [*names, *pars, *targets], compact_mode=compact)


def _examination(names: list[Any], pars: list[Any], expressions: list[Any]) -> Any:
    """Compile a function of state and parameters that returns the invariants (l,) and the sizes of their terms (l,).

    A size is the norm of the products of the components of the gradient and the state.
    """
    terms = [_dot(row := [heyoka.diff(item, name) * name for name in names], row) for item in expressions]
    return heyoka.cfunc(
        [*expressions, *map(heyoka.sqrt, terms)], [*names, *pars], compact_mode=len(names) > MOST_PRODUCTS
    )


def _variables(name: str, n: int) -> list[Any]:
    return [heyoka.make_vars(f"{name}_{k}") for k in range(n)]


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return heyoka.sum([p * q for p, q in zip(a, b, strict=True)])
