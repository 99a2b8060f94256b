"""Projection of heyoka's Taylor integrator onto invariants; public in `integrations.heyoka`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import heyoka
import numpy as np

from eip_scipy.core.inputs import count, refuse_units, shown
from eip_scipy.engine.data import EPS, LARGE_SHARE
from eip_scipy.engine.trust import ProjectionWarning

# Gradients that are linearly dependent up to this factor reduce the rank: the square of that of the engine.
DEPENDENT = EPS
# Expressions with more products than this are compiled in heyoka's compact mode, which takes less time to compile.
MOST_PRODUCTS = 200
# A rate of change along the flow is a rounding error up to this fraction of its terms, as in all runs of the package.
RATE = 1e-8
# Residuals of correct runs after a projection are below this number of rounding errors of their terms.
REMAINS = 400.0
POINTS = 1024  # of a grid that are handed to heyoka at once, because it copies them
TIME_LIMIT, STEP_LIMIT = heyoka.taylor_outcome.time_limit, heyoka.taylor_outcome.step_limit


class ProjectedTaylor:
    """Taylor integrator of heyoka whose state is projected onto invariants after every few steps.

    heyoka makes the steps, with its own step sizes, events and dense output. The projection is one Newton step, which
    heyoka compiles together with the gradients of the expressions.

    Parameters
    ----------
    integrator : heyoka.taylor_adaptive
        In double precision, at the state at which the invariants have their targets. It is used, not copied: its
        ``state``, ``time`` and ``pars`` are those of the run.
    invariants : sequence or mapping of heyoka.expression
        Expressions of the state variables and of the integrator's parameters; a mapping gives them names.
    every : int, optional
        Number of steps between two projections. A projection takes about as long as 10 steps of a small system; if a
        step takes more than a few microseconds, a smaller number gives smaller errors at the same cost.
    sigma : array_like, shape (n,), optional
        Weights of the components in the projection: components with larger weights move more. Default: all 1.

    Attributes
    ----------
    integrator : heyoka.taylor_adaptive
    names : tuple of str
        Of the invariants.
    targets : ndarray, shape (l,)
        Values that are kept. After you have changed the state of the integrator, assign `values` to it.
    max_residual : ndarray, shape (l,)
        Largest magnitude of each invariant error before a projection.
    n_projections : int

    Raises
    ------
    TypeError
        If the integrator is not a ``heyoka.taylor_adaptive`` in double precision.
    ValueError
        If an invariant has other variables or parameters than the integrator, depends on time, or is not finite.

    Warns
    -----
    UserWarning
        If the rate of change of an expression along the flow is not zero: it is not an invariant of the system.
    ProjectionWarning
        By the methods, if invariant errors are too large to be errors of the steps, or remain after the projection.

    Notes
    -----
    States between two projections are off the invariants by the errors of at most `every` steps. Rows of
    `propagate_grid` and values of the dense output are projected, too. Dependent gradients reduce the rank, as in
    `eip_scipy.project`.

    The page :doc:`/how-to/other-packages` has an example.
    """

    def __init__(self, integrator: Any, invariants: Any, *, every: int = 256, sigma: Any = None) -> None:
        refuse_units(sigma=sigma)
        if not isinstance(integrator, heyoka.taylor_adaptive_dbl) or integrator.is_variational:
            raise TypeError(
                f"ProjectedTaylor: expected a heyoka.taylor_adaptive in double precision, without variational "
                f"equations, got {shown(integrator)}."
            )
        self.integrator, self._every = integrator, count("every", every)
        named = _named(invariants, integrator)
        self.names, expressions = tuple(named), list(named.values())
        weights = np.ones(integrator.dim) if sigma is None else np.array(sigma, dtype=float)
        if weights.shape != (integrator.dim,) or not (np.isfinite(weights).all() and (weights > 0).all()):
            raise ValueError(f"sigma: expected {integrator.dim} positive numbers, got {shown(sigma)}.")
        self._function = _projection(integrator, expressions, weights)
        self._checked = _examination(integrator, expressions)
        self.n_projections, self.max_residual = 0, np.zeros(len(expressions))
        self.targets = self.values
        self._refuse_others()

    @property
    def values(self) -> np.ndarray:
        """Values of the invariants at the present state, shape (l,)."""
        return self._examined()[0]

    def propagate_until(self, t: float, *, c_output: bool = False, **options: Any) -> tuple[Any, ...]:
        """Integrate to `t`, as ``heyoka.taylor_adaptive.propagate_until``.

        Parameters
        ----------
        t : float
            End, before or after the present time.
        c_output : bool, optional
            Return a dense output, too.
        **options
            Options ``max_delta_t`` and ``callback`` of heyoka; a callback sees states before their projection.

        Returns
        -------
        tuple
            heyoka's: outcome, smallest and largest step, number of steps, the dense output or None, callback. The
            dense output is a function of one time or of times (m,) that returns states (n,) or (m, n). It stores one
            state for each projection, and integrates again from there.
        """
        starts = [self._clock()] if c_output else None
        found = self._run(lambda: self.integrator.propagate_until(t, max_steps=self._every, **options), starts)
        return (*found[:4], None if starts is None else TaylorOutput(self, starts, self.integrator.dtime), found[5])

    def propagate_grid(self, grid: Any, **options: Any) -> tuple[Any, ...]:
        """Integrate over a grid of times, as ``heyoka.taylor_adaptive.propagate_grid``.

        Parameters
        ----------
        grid : array_like, shape (m,)
            Monotonic times; the first one is the present time.
        **options
            As for `propagate_until`.

        Returns
        -------
        tuple
            heyoka's: outcome, smallest and largest step, number of steps, callback, and the states (m, n), fewer if an
            event or a callback ended the run.
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
        """Return the projections of states (m, n) with known parameters and targets."""
        z = np.concatenate([y.T, np.repeat(known[:, None], len(y), axis=1)])
        return self._function(np.ascontiguousarray(z))[: y.shape[1]].T.copy()

    def _run(self, advance: Any, starts: list[Any] | None) -> tuple[Any, ...]:
        """Call `advance` and project until it does not end by its number of steps; return what heyoka returns."""
        state, function = self.integrator.state, self._function
        z, out = np.concatenate([state, self._known()]), np.empty(state.size + len(self.names))
        at, projected, residuals = z[: state.size], out[: state.size], out[state.size :]
        largest, steps, least, most = self.max_residual, 0, np.inf, 0.0
        while True:
            found = advance()
            steps += found[3]
            least, most = min(least, found[1]), max(most, found[2])
            at[:] = state
            function(z, out)
            state[:] = projected
            np.maximum(largest, np.abs(residuals, out=residuals), out=largest)
            self.n_projections += 1
            if found[0] != STEP_LIMIT:
                break
            if starts is not None:
                starts.append(self._clock())
        self._judge(residuals)
        return (found[0], least, most, steps, *found[4:])

    def _clock(self) -> tuple[tuple[float, float], np.ndarray]:
        return self.integrator.dtime, self.integrator.state.copy()

    def _known(self) -> np.ndarray:
        return np.concatenate([self.integrator.pars, self.targets])

    def _examined(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the invariants, the size of their terms, their rates and the sizes of these, each (l,)."""
        integrator, l = self.integrator, len(self.names)  # noqa: E741
        more = {"time": integrator.time} if self._checked.is_time_dependent else {}
        found = self._checked(integrator.state, pars=integrator.pars, **more)
        values, gradients, f = np.split(found, [l, l * (1 + integrator.dim)])
        gradients = gradients.reshape(l, -1)
        terms, products = np.abs(gradients) @ np.abs(integrator.state), gradients * f
        return values, terms, products.sum(axis=1), np.abs(products).sum(axis=1)

    def _refuse_others(self) -> None:
        """Look at the invariants and at their rates at the start."""
        values, _, rates, sizes = self._examined()
        for name, value, rate, size in zip(self.names, values, rates, sizes, strict=True):
            if not np.isfinite([value, rate]).all():
                raise ValueError(f"invariant {name!r} has the value {value} and the rate {rate} at the start.")
            if abs(rate) > RATE * size:
                warnings.warn(
                    f"{name!r} changes at the rate {rate:.3g} along the flow, with terms of size {size:.3g}: it is not "
                    "an invariant of this system. Correct the expression, or leave it out.",
                    UserWarning,
                    stacklevel=3,
                )

    def _judge(self, before: np.ndarray) -> None:
        """Warn if the errors `before` the last projection, or of the run, are not those of accurate steps."""
        values, terms, *_ = self._examined()
        after = np.abs(self.targets - values)
        for k, name in enumerate(self.names):
            remains = not after[k] <= max(before[k], REMAINS * EPS * terms[k])
            if remains or self.max_residual[k] > LARGE_SHARE * max(terms[k], abs(self.targets[k])):
                warnings.warn(
                    f"invariant {name!r} had errors of up to {self.max_residual[k]:.3g} before projections, and "
                    f"{after[k]:.3g} after the last one, with terms of size {terms[k]:.3g}. Decrease tol or every, "
                    "and check that it is an invariant.",
                    ProjectionWarning,
                    stacklevel=4,
                )


class TaylorOutput:
    """Dense output of `ProjectedTaylor`: a function of time.

    Parameters
    ----------
    flow : ProjectedTaylor
    starts : sequence of ((float, float), ndarray)
        Times, in two parts, and states after the projections.
    end : (float, float)
        End of the run.

    Attributes
    ----------
    bounds : (float, float)
    """

    def __init__(self, flow: ProjectedTaylor, starts: Sequence[Any], end: tuple[float, float]) -> None:
        own = flow.integrator
        self.bounds = float(starts[0][0][0]), float(end[0])
        self._flow, self._starts, self._known = flow, starts, flow._known()
        self._sign = 1.0 if self.bounds[1] >= self.bounds[0] else -1.0
        self._times = np.array([time[0] for time, _ in starts])
        self._again = heyoka.taylor_adaptive(
            own.sys, own.state, pars=own.pars, tol=own.tol,
            high_accuracy=own.high_accuracy, compact_mode=own.compact_mode,
        )  # fmt: skip

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
    """Return the expressions by name, checked."""
    if isinstance(invariants, heyoka.expression):
        invariants = [invariants]
    if not isinstance(invariants, Mapping):
        invariants = {f"invariant {k}": item for k, item in enumerate(invariants)}
    named = {str(name): heyoka.expression(item) for name, item in invariants.items()}
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
            raise ValueError(f"invariant {name!r} depends on time, which is not supported; write time as a variable.")
    return named


def _projection(integrator: Any, expressions: list[Any], sigma: np.ndarray) -> Any:
    """Compile the Newton step: of a state, parameters and targets, the projected state and the residuals.

    Parameters and targets are further variables, because heyoka takes several microseconds to look at parameters. The
    correction is sigma * x, where x has the smallest norm with (G sigma) x = residuals; the rows of G sigma are made
    orthogonal one after the other.
    """
    names = [name for name, _ in integrator.sys]
    pars = [heyoka.make_vars(f"__par_{k}") for k in range(len(integrator.pars))]
    targets = [heyoka.make_vars(f"__target_{k}") for k in range(len(expressions))]
    expressions = [heyoka.subs(item, {heyoka.par[k]: par for k, par in enumerate(pars)}) for item in expressions]
    basis: list[list[Any]] = []
    moves: list[Any] = []
    residuals = [target - item for target, item in zip(targets, expressions, strict=True)]
    for item, residual in zip(expressions, residuals, strict=True):
        row = [heyoka.diff(item, name) * weight for name, weight in zip(names, sigma.tolist(), strict=True)]
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
        name + weight * heyoka.sum([move * direction[k] for move, direction in zip(moves, basis, strict=True)])
        for k, (name, weight) in enumerate(zip(names, sigma.tolist(), strict=True))
    ]
    compact = len(names) * len(expressions) ** 2 > MOST_PRODUCTS
    return heyoka.cfunc([*projected, *residuals], [*names, *pars, *targets], compact_mode=compact)


def _examination(integrator: Any, expressions: list[Any]) -> Any:
    """Compile the invariants, their derivatives by the state, and the right-hand sides."""
    names, rates = [name for name, _ in integrator.sys], [rate for _, rate in integrator.sys]
    gradients = [heyoka.diff(item, name) for item in expressions for name in names]
    return heyoka.cfunc([*expressions, *gradients, *rates], names, compact_mode=len(gradients) > MOST_PRODUCTS)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return heyoka.sum([p * q for p, q in zip(a, b, strict=True)])
