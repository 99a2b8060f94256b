"""Dense output: interpolants of SciPy's orders that meet the projected states and stay on the manifold."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853 as SCIPY_DOP853
from scipy.integrate import DenseOutput

from ..engine.counters import NFEV
from ..engine.data import ERROR, GIVEN, NEW, OK, Grouping
from ..methods.nystrom import NystromTableau
from ..methods.runge_kutta import DOP853, Tableau
from .inputs import refuse_units, shown
from .one_step import OneStep
from .setup import Projection, Run

__all__ = ["End", "ExactEnds", "ManifoldDenseOutput", "dense_output"]

Array = np.ndarray
ITERATIONS = 5


class End(NamedTuple):
    """One end of a step: time, state and slope."""

    t: float
    y: Array
    f: Array


def dense_output(
    rhs: Callable[..., None],
    run: Run,
    tableau: Tableau | NystromTableau | OneStep,
    old: End,
    new: End,
    params: Any = None,
) -> ManifoldDenseOutput:
    """Dense output over the step that `run` made last, from its `old` end to its `new` one."""
    if isinstance(tableau, OneStep):  # whose steps do not take f
        old, new = (end._replace(f=np.empty_like(end.y)) for end in (old, new))
        for t, y, f in (old, new):
            rhs(t, y, f, params)
        run.work.counters[NFEV] += 2
    K = run.work.K.copy()
    if isinstance(tableau, NystromTableau):
        base = _quintic(old, new)
    elif tableau is DOP853:
        base = _dop853(rhs, params, old, new, K, run.work.counters)
    elif isinstance(tableau, Tableau) and tableau.P is not None:
        base = _polynomial(old, new, K, tableau.P)
    else:
        base = _hermite(old, new)
    old, new = (end._replace(y=end.y.copy()) for end in (old, new))
    return ManifoldDenseOutput(rhs, run, old, new, base, params)


class _AtRealTimes(DenseOutput):
    """A dense output that says what is wrong with times that are no real numbers."""

    def __call__(self, t: Any) -> Array:
        """The states at a time or at times (m,), as (n,) or (n, m).

        Raises
        ------
        TypeError
            For times that are no real numbers, or have a unit.
        """
        real = np.asarray(t).dtype.kind in "fiub"
        if not real or type(t) not in (float, np.float64, Array):
            refuse_units(t=t)
        if not real:
            raise TypeError(f"dense output is defined at real times, got {shown(t)}.")
        return super().__call__(t)


class ExactEnds(_AtRealTimes):
    """Another dense output, but for the step's own states at both ends, which interpolants miss by their rounding."""

    def __init__(self, inner: DenseOutput, y_old: Array, y: Array) -> None:
        super().__init__(inner.t_old, inner.t)
        self._inner, self._y_old, self._y = inner, y_old, y

    def _call_impl(self, t: Array) -> Array:
        column = (slice(None),) + (None,) * t.ndim
        out = np.where(t == self.t_old, self._y_old[column], self._inner(t))
        return np.where(t == self.t, self._y[column], out)


class ManifoldDenseOutput(_AtRealTimes):
    """An interpolant, projected onto the invariants' levels between those of the step's two ends.

    The levels are linear between the defects of the two ends, which are 1e-15 to 1e-12 after a projection, and what
    the step left where it was not projected: the ends themselves are met exactly.
    """

    def __init__(
        self, rhs: Callable[..., None], run: Run, old: End, new: End, base: Callable[[Array], Array], params: Any
    ) -> None:
        super().__init__(old.t, new.t)
        self._rhs, self._invariants, self._params = rhs, run.invariants, params
        self._y_old, self._y, self._base = old.y, new.y, base
        self._sigma = run.work.sigma
        if run.invariants.size and run.options.metric == ERROR:
            h = new.t - old.t
            self._sigma = _travelled(old.y, new.y, h * old.f, h * new.f, run.options.groups)
        plain = run.options._replace(metric=GIVEN, direction=NEW, every=1, compensated=False)
        self._options = plain._replace(
            iterations=ITERATIONS, watched=False, limit=math.inf, target=np.zeros(run.invariants.size)
        )
        self._counters = run.work.counters
        self._levels: tuple[Array, Array] | None = None
        self._projection: Projection

    def _call_impl(self, t: Array) -> Array:
        times = np.atleast_1d(t)
        theta = (times - self.t_old) / (self.t - self.t_old)
        out = self._base(theta)
        for k in range(times.size):
            if times[k] == self.t:
                out[:, k] = self._y
            elif times[k] == self.t_old:
                out[:, k] = self._y_old
            elif self._invariants.size:
                out[:, k] = self._projected(float(times[k]), float(theta[k]), np.ascontiguousarray(out[:, k]))
        return out[:, 0] if t.ndim == 0 else out

    def _projected(self, t: float, theta: float, y: Array) -> Array:
        if self._levels is None:
            self._levels = self._prepare()
        at_old, at_new = self._levels
        share = min(1.0, max(0.0, theta))
        projection = self._projection
        self._options.target[:] = (1 - share) * at_old + share * at_new
        if self._options.uses_f:
            self._rhs(t, y, projection.work.K[-1], self._params)
            self._counters[NFEV] += 1
        out, status = projection(t, y)
        if status == OK:
            return out
        if theta == share:  # an extrapolation may lead anywhere
            warnings.warn(
                f"dense output at t={t}: no state near the interpolant meets the invariants' levels "
                f"(they miss by {projection.work.defect}); it is given as it is",
                RuntimeWarning,
                stacklevel=2,
            )
        return y

    def _prepare(self) -> tuple[Array, Array]:
        invariants = self._invariants

        def rhs(t: float, y: Array) -> Array:
            f = np.empty_like(y)
            self._rhs(t, y, f, self._params)
            return f

        self._projection = Projection(invariants, self._options, rhs)
        self._projection.work.sigma[:] = self._sigma
        return invariants.values(self.t_old, self._y_old), invariants.values(self.t, self._y)


def _travelled(y_old: Array, y: Array, step_old: Array, step: Array, groups: Grouping) -> Array:
    """Weights of the interpolant's correction: how far each block goes within the step.

    The weights of the step itself do not fit: an interpolant errs in other components than the end of a step does.
    A slope that passes through zero within the step does not make a block immobile, hence the second term.
    """
    a, b, u, v = (x.view(float) for x in (y_old, y, step_old, step))
    sigma = np.empty(a.size)
    for first, last in pairwise(groups.start):
        i = groups.member[first:last]
        size, slope = (max(np.linalg.norm(p[i]), np.linalg.norm(q[i])) for p, q in ((a, b), (u, v)))
        sigma[i] = math.hypot(slope, math.sqrt(size) * math.sqrt(np.linalg.norm(u[i] - v[i])))
    largest = sigma.max()
    return sigma / largest if largest > 0.0 else np.ones_like(sigma)


def _hermite(old: End, new: End) -> Callable[[Array], Array]:
    """The cubic through both ends with their slopes."""
    (t_old, y_old, f_old), (t, y, f) = old, new
    h = t - t_old
    change = y - y_old
    left, right = (h * f_old - change)[:, None], (h * f - change)[:, None]
    y_old, change = y_old[:, None].copy(), change[:, None]

    def base(theta: Array) -> Array:
        rest = 1 - theta
        return y_old + theta * change + theta * rest * (rest * left - theta * right)

    return base


def _quintic(old: End, new: End) -> Callable[[Array], Array]:
    """For y = (q, v): the quintic through positions, velocities and accelerations at both ends, and its slope."""
    (t_old, y_old, f_old), (t, y, f) = old, new
    h = t - t_old
    half = y.size // 2
    q, v, a = y_old[:half], y_old[half:], f_old[half:]
    # What the Taylor polynomial at the old end misses at the new one: in the position, the slope and the curvature.
    place = y[:half] - q - h * v - 0.5 * h * h * a
    slope = h * (y[half:] - v - h * a)
    curvature = h * h * (f[half:] - a)
    rows = [
        q,
        h * v,
        0.5 * h * h * a,
        10 * place - 4 * slope + 0.5 * curvature,
        -15 * place + 7 * slope - curvature,
        6 * place - 3 * slope + 0.5 * curvature,
    ]
    position = np.stack(rows, axis=1)
    velocity = position[:, 1:] * np.arange(1, 6) / h

    def base(theta: Array) -> Array:
        powers = theta ** np.arange(6)[:, None]
        return np.concatenate([position @ powers, velocity @ powers[:5]])

    return base


def _polynomial(old: End, new: End, K: Array, P: Array) -> Callable[[Array], Array]:
    """The tableau's interpolant, bent at its end to the projected state and the slope there."""
    (t_old, y_old, _), (t, y, f) = old, new
    h = t - t_old
    Q = h * (K.T @ P)
    moved = (y - y_old - Q.sum(axis=1))[:, None]
    turned = (h * (f - K[-1]))[:, None]
    y_old = y_old[:, None].copy()

    def base(theta: Array) -> Array:
        powers = theta ** np.arange(1, P.shape[1] + 1)[:, None]
        square = theta * theta
        return y_old + Q @ powers + moved * (square * (3 - 2 * theta)) + turned * (square * (theta - 1))

    return base


def _dop853(
    rhs: Callable[..., None], params: Any, old: End, new: End, K: Array, counters: Array
) -> Callable[[Array], Array]:
    """SciPy's interpolant of order 7, from three more evaluations of the right-hand side."""
    (t_old, y_old, _), (t, y, f) = old, new
    h = t - t_old
    stages = K.shape[0]
    K = np.concatenate([K, np.zeros((3, y.size), K.dtype)])
    rows = zip(SCIPY_DOP853.A_EXTRA, SCIPY_DOP853.C_EXTRA, strict=True)
    for s, (a, c) in enumerate(rows, start=stages):
        stage = y_old + h * (K[:s].T @ a[:s])
        rhs(t_old + c * h, stage, K[s], params)
        counters[NFEV] += 1
    change = y - y_old
    F = [change, h * K[0] - change, 2 * change - h * (f + K[0]), *(h * (SCIPY_DOP853.D @ K))]
    y_old = y_old[:, None].copy()

    def base(theta: Array) -> Array:
        out = np.zeros((y.size, theta.size), K.dtype)
        for i, part in enumerate(reversed(F)):
            out = (out + part[:, None]) * (theta if i % 2 == 0 else 1 - theta)
        return out + y_old

    return base
