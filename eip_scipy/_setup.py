"""From a user's options to what the step needs: validation, in one place for `solve_ivp` and `integrate`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import OdeSolver
from scipy.linalg import block_diag

from . import _kernels as kn
from ._inputs import count, flag, is_number, real_array, reals, refuse_units, shown
from ._kernels import BAND, BAND_COMPENSATED, EPS, NOT_FINITE, FrameRows, Grouping
from ._step import (
    AUTO,
    ERROR,
    EUCLIDEAN,
    GIVEN,
    MIDPOINT,
    NEW,
    OLD,
    T_NEW,
    TOO_SMALL,
    H,
    Method,
    Options,
    Span,
    T,
    Work,
    make_work,
    project_step,
)
from ._trust import LARGE_SHARE, Trust
from .invariants import InvariantSet, JointInvariants, as_it_is
from .nystrom import NystromTableau
from .one_step import OneStep, as_vector
from .result import LAST_RANK, Diagnostics
from .tableaux import Tableau

__all__ = ["ProjectionOptions", "Run", "Stepping", "as_derivative", "fixed_steps", "prepare"]

AnyMethod = Tableau | NystromTableau | OneStep
# Unsigned: Numba then leaves out the test for negative indices, which costs more than the access itself.
INDEX = np.uint64
DIRECTIONS = {"new": NEW, "old": OLD, "midpoint": MIDPOINT}
START_ITERATIONS = 50
# Steps after which the invariants are checked once more.
LOOKS = (10, 100)
UNBOUNDED = 2**62
LEAST_RTOL = 100 * EPS  # SciPy's
MOST_ITERATIONS = 1000


@dataclass(frozen=True, kw_only=True)
class ProjectionOptions:
    """The options of the projection as a user gives them; see `EIPSolver`."""

    invariants: Any = ()
    metric: Any = None
    blocks: Any = None
    frame: Any = None
    direction: str = "new"
    iterations: int = 1
    every: int | str = 1
    reuse_f: bool = True
    check: bool = True
    project_initial: bool = False


@dataclass(frozen=True)
class Stepping:
    """How a run steps: by a fixed `h`, or, where that is None, by tolerances, from `first_step` (None: estimated)."""

    span: Span
    h: float | None
    first_step: float | None
    rtol: np.ndarray
    atol: np.ndarray

    def first(
        self,
        rhs: Callable[[float, np.ndarray], np.ndarray],
        y0: np.ndarray,
        f0: np.ndarray,
        tableau: AnyMethod,
    ) -> float:
        """Length of the first step.

        Raises
        ------
        ValueError
            When it is to be estimated and the error of a component has no scale.
        """
        if self.h is not None:
            return self.h
        if self.first_step is not None:
            return self.first_step
        self.require_scale(y0)
        t0, t_bound, max_step = self.span.t0, self.span.t_bound, self.span.max_step
        order = tableau.error_estimator_order or 0
        return initial_step(rhs, t0, y0, t_bound, max_step, f0, order, self.rtol, self.atol)

    def require_scale(self, y0: np.ndarray) -> None:
        """Refuse tolerances that leave the error of a component at the start without a scale."""
        none = np.flatnonzero(self.atol + self.rtol * np.abs(y0) == 0)
        if none.size:
            raise ValueError(
                f"the tolerances of component {none[0]} are 0: y0 is 0 there, and so is `atol`. Its error has no "
                "scale; give atol > 0, or a fixed step h."
            )


@dataclass
class Run:
    """All that a driver needs besides the user's functions; `in_place` says what the right-hand side is."""

    y0: np.ndarray
    method: Method | OneStep
    options: Options
    work: Work
    invariants: InvariantSet
    frame: Any  # the pair (C, S) as it was given: what `options` hold comes from LAPACK, whose last bits differ
    trust: Trust
    check: bool
    tau: float
    in_place: bool = False
    looked: int = -1

    def look(self, steps: int, ended: bool, t: float, y: np.ndarray, derivative: Callable[[], np.ndarray]) -> bool:
        """Look at a run after so many steps, or where it ends: whether something speaks against it, to be said now.

        The invariants are checked at LOOKS (a run that ends before them: there), as their rates and gradients may
        vanish at the start, and where the corrections are too large, to tell why.
        """
        if not self.options.watched:
            return False
        early = steps != self.looked and (steps in LOOKS or (ended and steps < LOOKS[0]))
        doubtful = self.trust.beyond_doubt or (ended and bool(self.trust.sick.any()))
        found: list[str] = []
        if self.check and (early or doubtful) and not self.trust.doubts:
            self.looked = steps
            f = derivative()
            if np.isfinite(f).all():
                found = [complaint.text for complaint in self.invariants.complaints(t, y, f, self.tau)][:1]
            self.trust.doubts += found
        return doubtful or bool(found)


class Counted:
    """A right-hand side that counts its calls and returns new arrays."""

    __slots__ = ("_rhs", "count")

    def __init__(self, rhs: Callable[[float, np.ndarray], np.ndarray]) -> None:
        self._rhs = rhs
        self.count = 0

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        self.count += 1
        return self._rhs(t, y).copy()


def as_derivative(value: Any, n: int, dtype: np.dtype, t: float) -> np.ndarray:
    """The value of a user's right-hand side at t as an array (n,), or an error; see `as_vector`."""
    return as_vector(value, n, dtype, "fun returned", t)


def initial_state(y0: Any, name: str = "y0") -> np.ndarray:
    """y0 as a new float64 or complex128 array (n,), with SciPy's messages for what is no state."""
    y = states(name, y0)
    if y.ndim != 1:
        raise ValueError(f"`{name}` must be 1-dimensional.")
    if not np.isfinite(y).all():
        raise ValueError(f"All components of the initial state `{name}` must be finite.")
    return y


def states(name: str, value: Any) -> np.ndarray:
    """A state, or several, as a new float64 or complex128 array of any shape.

    Raises
    ------
    TypeError
        For what holds no numbers, or numbers with a unit.
    ValueError
        For masked values.
    """
    refuse_units(**{name: value})
    if np.ma.isMaskedArray(value) and np.ma.is_masked(value):
        raise ValueError(f"masked values in {name}; fill or drop them first.")
    found = reals(value)
    if found is not None:
        return found
    try:
        y = np.asarray(value)
    except ValueError:  # rows of different lengths
        raise ValueError(f"`{name}` must be an array of numbers, got {shown(value)}.") from None
    if y.dtype.kind != "c":
        raise TypeError(f"`{name}` must hold numbers, got {shown(value)}, dtype {y.dtype}.")
    return np.array(y, dtype=complex, order="C")


def interval(t_span: Any) -> tuple[float, float]:
    """Start and end of an interval, whose end may be infinite.

    Raises
    ------
    TypeError
        For values with a unit, and dates.
    ValueError
        For what are not two real numbers, NaN, and an infinite start.
    """
    refuse_units(t_span=t_span)
    ends = reals(t_span)
    if ends is None or ends.shape != (2,):
        raise ValueError(f"t_span must hold two numbers, got {shown(t_span)}.")
    t0, t_bound = ends.tolist()
    if not math.isfinite(t0) or math.isnan(t_bound):
        raise ValueError(f"t_span must be finite, got {shown(t_span)}; only its end may be infinite.")
    return t0, t_bound


def check_halves(n: int) -> None:
    """A state (q, v) has an even number of components."""
    if n % 2:
        raise ValueError(f"a Nystrom method needs the state (q, v), an even number of components; y0 has {n}.")


def check_second_order(
    rhs: Callable[[float, np.ndarray], np.ndarray], t0: float, y0: np.ndarray, f0: np.ndarray, method: str
) -> None:
    """Whether the right-hand side is that of q'' = a(t, q) for y = (q, v), by one more evaluation.

    Raises
    ------
    ValueError
        When the first half of the derivative is not v, or the second changes with v.
    """
    check_halves(y0.size)
    half = y0.size // 2
    other = y0.copy()
    other[half:] = 1.5 * y0[half:] + 1.0
    f = rhs(t0, other)
    if not (np.array_equal(f0[:half], y0[half:]) and np.array_equal(f[:half], other[half:])):
        raise ValueError(
            f"{method} integrates q'' = a(t, q) with the state (q, v): the first {half} components of fun must be v, "
            f"the second half of the state. Reorder the state, or take a Runge-Kutta method such as EIPDOP853."
        )
    if not np.array_equal(f[half:], f0[half:], equal_nan=True):
        raise ValueError(
            f"{method} integrates q'' = a(t, q), but fun's accelerations change with the velocity; take a Runge-Kutta "
            f"method such as EIPDOP853."
        )


def tolerances(rtol: Any, atol: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Both tolerances as arrays (n,).

    Raises
    ------
    TypeError
        For values with a unit.
    ValueError
        For NaN, infinite or negative values or a wrong shape.
    """
    refuse_units(rtol=rtol, atol=atol)
    out = []
    for name, value in (("rtol", rtol), ("atol", atol)):
        a = reals(value)
        if a is None:
            raise ValueError(f"`{name}` must be a number or an array of {n} numbers. Got {shown(value)}.")
        if a.ndim > 0 and a.shape != (n,):
            raise ValueError(f"`{name}` has wrong shape. It has {a.shape}, the state ({n},).")
        if not np.all(a >= 0):
            raise ValueError(f"`{name}` must be positive. Got {shown(value)}.")
        if not np.all(np.isfinite(a)):
            raise ValueError(
                f"`{name}` must be finite. Got {shown(value)}; a large number such as 1e30 leaves a component out of "
                "the step control."
            )
        out.append(np.array(np.broadcast_to(a, (n,)), order="C"))
    return out[0], out[1]


def check_fixed_step(h: Any, t0: float, t_bound: float) -> float:
    """H as a positive float.

    Raises
    ------
    TypeError
        When it has a unit.
    ValueError
        When it is no positive number, longer than the interval, or below ten spacings of t.
    """
    refuse_units(h=h)
    if not is_number(h) or not 0 < h < math.inf:
        raise ValueError(f"`h` must be positive. Got {shown(h)}; give a real number > 0.")
    h = float(h)
    span = abs(t_bound - t0)
    if span == 0:
        return h
    if h > span * (1 + _slack(h, t0, t_bound)):
        raise ValueError(f"`h` exceeds bounds. Got h = {h:g} for an interval of length {span:g}.")
    largest = max(abs(t0), abs(t_bound)) if math.isfinite(t_bound) else abs(t0)
    spacing = float(np.spacing(largest))
    if h < 10 * spacing:
        raise ValueError(
            f"`h` is too small: h = {h:g} is below 10 spacings of t, which are {spacing:.3g} at t = {largest:g}."
        )
    return h


def _slack(h: float, t0: float, t_bound: float) -> float:
    """How far T/h may be from a whole number and still count as one."""
    if not math.isfinite(t_bound):
        return 0.0
    return max(1e-9, 8 * EPS * (abs(t_bound - t0) + abs(t0) + abs(t_bound)) / h)


def fixed_steps(h: float, t0: float, t_bound: float) -> int:
    """Number of steps of length h from t0 to t_bound, UNBOUNDED for an endless interval.

    T/h rounded where it is a whole number but for round-off, else the next larger one; the last step is then shorter.
    """
    ratio = abs(t_bound - t0) / h
    if not ratio < UNBOUNDED:
        return UNBOUNDED
    whole = round(ratio)
    return whole if abs(ratio - whole) <= _slack(h, t0, t_bound) else math.ceil(ratio)


def step_bounds(first_step: Any, max_step: Any, t0: float, t_bound: float) -> tuple[float | None, float]:
    """first_step and max_step, with SciPy's messages for what they must not be."""
    refuse_units(first_step=first_step, max_step=max_step)
    if not is_number(max_step) or not max_step > 0:
        raise ValueError(f"`max_step` must be positive. Got {shown(max_step)}; give a real number > 0.")
    if first_step is None:
        return None, float(max_step)
    if not is_number(first_step) or not first_step > 0:
        raise ValueError(f"`first_step` must be positive. Got {shown(first_step)}; give a real number > 0.")
    if first_step > abs(t_bound - t0):
        raise ValueError(
            f"`first_step` exceeds bounds. Got {first_step:g} for an interval of length {abs(t_bound - t0):g}."
        )
    return float(first_step), float(max_step)


def stepping(
    name: str,
    tableau: AnyMethod,
    t0: float,
    t_bound: float,
    n: int,
    h: Any,
    first_step: Any,
    max_step: Any,
    rtol: Any,
    atol: Any,
    *,
    stacklevel: int,
) -> Stepping:
    """Validate the options of the step size; `stacklevel` is that of the user, for a warning.

    Raises
    ------
    ValueError
        For options with wrong values, for `h` beside those of adaptive steps, and without `h` where the method `name`
        has no error estimate.
    """
    if h is None and not tableau.has_estimate:
        raise ValueError(
            f"{name} has no error estimate and needs the step h=...: without it, and where rtol, atol, first_step or "
            "max_step ask for them, steps are adaptive."
        )
    if h is not None and (first_step is not None or max_step != np.inf):
        raise ValueError(
            "h sets a fixed step; first_step and max_step belong to adaptive steps: give one or the other."
        )
    first_step, max_step = step_bounds(first_step, max_step, t0, t_bound)
    rtol, atol = tolerances(rtol, atol, n)
    if h is not None:
        h = check_fixed_step(h, t0, t_bound)
    elif np.any(rtol < LEAST_RTOL):
        message = f"At least one element of `rtol` is too small. Setting `rtol = np.maximum(rtol, {LEAST_RTOL})`."
        warnings.warn(message, stacklevel=stacklevel)
        rtol = np.maximum(rtol, LEAST_RTOL)
    sign = -1.0 if t_bound < t0 else 1.0
    n_steps = UNBOUNDED if h is None else fixed_steps(h, t0, t_bound)
    return Stepping(Span(t0, sign * (h or 0.0), t_bound, sign, n_steps, max_step), h, first_step, rtol, atol)


def initial_step(
    rhs: Callable[[float, np.ndarray], np.ndarray],
    t0: float,
    y0: np.ndarray,
    t_bound: float,
    max_step: float,
    f0: np.ndarray,
    order: int,
    rtol: np.ndarray,
    atol: np.ndarray,
) -> float:
    """First step of an adaptive run (Hairer, Norsett & Wanner I, II.4), one more call of `rhs`; NaN for such an f0."""
    if y0.size == 0:
        return math.inf
    length = abs(t_bound - t0)
    if length == 0.0:
        return 0.0
    direction = 1.0 if t_bound > t0 else -1.0
    scale = atol + np.abs(y0) * rtol

    def size(x: np.ndarray) -> float:
        return float(np.linalg.norm(x / scale)) / math.sqrt(x.size)

    d0, d1 = size(y0), size(f0)
    if not math.isfinite(d1):
        return math.nan
    h0 = 1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1
    h0 = min(h0, length)
    d2 = size(rhs(t0 + h0 * direction, y0 + h0 * direction * f0) - f0) / h0
    if d1 <= 1e-15 and d2 <= 1e-15:
        h1 = max(1e-6, h0 * 1e-3)
    else:
        h1 = (0.01 / max(d1, d2)) ** (1 / (order + 1))
    return min(100 * h0, h1, length, max_step)


def _every(value: Any, tableau: AnyMethod) -> int:
    if not isinstance(value, str):
        return count("every", value)
    if value != "auto":
        raise ValueError(f"every must be an integer >= 1 or 'auto', got {value!r}.")
    if not tableau.has_estimate:
        raise ValueError(f"every='auto' needs an error estimate, and {tableau.name} has none; give an integer.")
    return AUTO


def _metric(metric: Any, tableau: AnyMethod, n: int, width: int) -> tuple[int, np.ndarray | None]:
    if metric is None:
        return (ERROR if tableau.has_estimate else EUCLIDEAN), None
    if isinstance(metric, str):
        if metric == "euclidean":
            return EUCLIDEAN, None
        if metric == "error":
            return (ERROR if tableau.has_estimate else EUCLIDEAN), None
        raise ValueError(f"metric must be 'error', 'euclidean' or an array of n weights, got {metric!r}.")
    return GIVEN, np.repeat(weights("metric", metric, n), width)


def weights(name: str, sigma: Any, n: int) -> np.ndarray:
    a = real_array(name, sigma)
    if a.shape != (n,):
        raise ValueError(f"{name}: weights have shape {a.shape}, the state has {n} components.")
    if not np.all(np.isfinite(a)) or np.any(a < 0) or not np.any(a > 0):
        raise ValueError(f"{name}: weights must be finite, >= 0 and not all 0.")
    return a / a.max()


def blocks_of(blocks: Any, n: int, width: int) -> Grouping:
    refuse_units(blocks=blocks)
    if blocks is None:
        return _consecutive(1, n, width)
    if isinstance(blocks, (int, np.integer)) and not isinstance(blocks, bool):
        if blocks < 1 or n % blocks:
            raise ValueError(f"blocks = {blocks} does not divide the state's {n} components.")
        return _consecutive(int(blocks), n, width)
    groups = _block_lists(blocks, n)
    if width == 2:
        groups = [np.column_stack([2 * g, 2 * g + 1]).ravel() for g in groups]
    start = np.concatenate([[0], np.cumsum([len(g) for g in groups])]).astype(INDEX)
    member = np.concatenate([*groups, []]).astype(INDEX)
    regular = len({len(g) for g in groups}) == 1 and np.array_equal(member, np.arange(member.size))
    return Grouping(member, start, width, len(groups[0]) if regular else 0)


def _consecutive(size: int, n: int, width: int) -> Grouping:
    """Blocks of `size` components each, in their order; no list of them, for a field has a million."""
    floats = n * width
    start = np.arange(0, floats + 1, size * width, dtype=INDEX)
    return Grouping(np.arange(floats, dtype=INDEX), start, width, size * width if n else 0)


def _block_lists(blocks: Any, n: int) -> list[np.ndarray]:
    try:
        groups = [np.atleast_1d(np.asarray(b)) for b in blocks]
    except (TypeError, ValueError):
        raise ValueError(f"blocks must be an integer or a sequence of index arrays, got {shown(blocks)}.") from None
    groups = [g for g in groups if g.size]
    for g in groups:
        if g.dtype.kind not in "iu" or g.ndim != 1 or g.min() < 0 or g.max() >= n:
            raise ValueError(f"blocks: {shown(g)} is no array of indices from 0 to {n - 1}.")
    used = np.concatenate([*groups, np.array([], dtype=int)]).astype(int)
    if np.unique(used).size != used.size:
        raise ValueError("blocks: a component stands in two blocks.")
    return groups + [np.array([i]) for i in np.setdiff1d(np.arange(n), used)]


def frame_rows(frame: Any, n: int, width: int) -> FrameRows:
    """The frame (C, S) as sparse rows of C and of the transpose of S (C S)^-1, over float views.

    Raises
    ------
    ValueError
        When the shapes disagree or C S is singular.
    """
    if frame is None:
        C, M = np.zeros((0, n * width)), np.zeros((0, n * width))
    else:
        C, M = _frame_matrices(frame, n, width)
    starts, index, value = _sparse_rows(np.concatenate([C, M]))
    k = C.shape[0]
    weights = _by_bodies(C), _by_bodies(M)
    bodies = np.array(weights) if weights[0].size and weights[1].size else np.zeros((2, 0, 0))
    return FrameRows(np.array([starts[: k + 1], starts[k:]]), index, value, np.zeros(k), bodies)


def _frame_matrices(frame: Any, n: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    refuse_units(frame=frame)
    try:
        C, S = (np.atleast_2d(np.asarray(a)) for a in frame)
    except (TypeError, ValueError):
        raise ValueError("frame must be a pair (C, S) of matrices of shapes (k, n) and (n, k).") from None
    k = C.shape[0]
    if k == 0 or C.shape != (k, n) or S.shape != (n, k) or C.dtype.kind not in "fiuc" or S.dtype.kind not in "fiuc":
        raise ValueError(f"frame: C has shape {C.shape} and S {S.shape}; expected (k, {n}) and ({n}, k).")
    if width == 2:
        C, S = _real_form(C), _real_form(S)
    elif C.dtype.kind == "c" or S.dtype.kind == "c":
        raise ValueError("frame: C and S must be real for a real state.")
    # Rows of C and columns of S in units of their own: only then does the condition number tell singular from scaled.
    C = C / np.maximum(np.abs(C).max(axis=1, keepdims=True), np.finfo(float).tiny)
    S = S / np.maximum(np.abs(S).max(axis=0, keepdims=True), np.finfo(float).tiny)
    product = C @ S
    if not np.all(np.isfinite(product)) or not np.linalg.cond(product) < 1e12:
        raise ValueError("frame: C S is singular; S must span shifts that change every row of C y.")
    return C, np.ascontiguousarray(np.linalg.solve(product.T, S.T))


def _real_form(a: np.ndarray) -> np.ndarray:
    """The matrix that acts on (Re, Im) pairs as `a` does on complex components."""
    out = np.empty((a.shape[0], 2, a.shape[1], 2))
    out[:, 0, :, 0] = out[:, 1, :, 1] = a.real
    out[:, 1, :, 0], out[:, 0, :, 1] = a.imag, -a.imag
    return out.reshape(2 * a.shape[0], 2 * a.shape[1])


def _by_bodies(a: np.ndarray) -> np.ndarray:
    """Weights (k, b) of b bodies, where `a` (3 k, 3 k b) sums the x, y and z of k groups of them; else none."""
    groups = a.shape[0] // 3
    if groups == 0 or a.shape[1] % (3 * groups):
        return np.zeros((0, 0))
    weights = np.array([a[3 * k, part] for k, part in enumerate(np.arange(a.shape[1]).reshape(groups, -1)[:, ::3])])
    return weights if np.array_equal(a, np.kron(block_diag(*weights), np.eye(3))) else np.zeros((0, 0))


def _sparse_rows(a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = [np.flatnonzero(row) for row in a]
    start = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(INDEX)
    index = np.concatenate([*rows, []]).astype(INDEX)
    value = np.concatenate([*(row[r] for row, r in zip(a, rows, strict=True)), []]).astype(float)
    return start, index, value


def method_arrays(tableau: AnyMethod) -> Method | OneStep:
    """A tableau as the arrays that the step takes (writable copies: compiled code has one array type for all)."""
    if isinstance(tableau, OneStep):
        return tableau
    exponent = -1.0 / ((tableau.error_estimator_order or 0) + 1)
    if isinstance(tableau, NystromTableau):
        return _nystrom_arrays(tableau, exponent)
    none = np.zeros(tableau.b.size)
    return Method(
        A=tableau.A.copy(),
        b=tableau.b.copy(),
        b_low=tableau.b_low.copy(),
        b_v=none,
        b_v_low=none,
        c=tableau.c.copy(),
        e=tableau.e.copy(),
        e_v=none,
        e_low=tableau.e_low.copy(),
        nystrom=False,
        fsal=tableau.fsal,
        paired=tableau.paired,
        exponent=exponent,
    )


def _nystrom_arrays(tableau: NystromTableau, exponent: float) -> Method:
    """A last stage that is the next step's first one is f at the new point, after the step."""
    s = tableau.n_stages - tableau.fsal

    def weights(e: np.ndarray) -> np.ndarray:
        return np.concatenate([e, np.zeros(s + 1 - e.size)])

    e, e_v = weights(tableau.e), weights(tableau.e_prime)
    return Method(
        A=tableau.A[:s, :s].copy(),
        b=tableau.b[:s].copy(),
        b_low=tableau.b_low[:s].copy(),
        b_v=tableau.b_prime[:s].copy(),
        b_v_low=tableau.b_prime_low[:s].copy(),
        c=tableau.c[:s].copy(),
        e=e,
        e_v=e_v,
        e_low=np.zeros(s + 1),
        nystrom=True,
        fsal=bool(e[-1] != 0.0 or e_v[-1] != 0.0),
        paired=False,
        exponent=exponent,
    )


def prepare(
    tableau: AnyMethod,
    rhs: Callable[[float, np.ndarray], np.ndarray],
    t0: float,
    y0: np.ndarray,
    f0: np.ndarray,
    tau: float,
    projection: ProjectionOptions,
    stepping: Stepping,
    *,
    extra: tuple = (),
    compensated: bool = False,
    check_start: bool = True,
    hand: Any = as_it_is,
) -> Run:
    """Validate a run's options and make its buffers; the invariants are checked at the start.

    Parameters
    ----------
    tableau : Tableau, NystromTableau or OneStep
    rhs : callable
        ``rhs(t, y) -> (n,)``, checked; called only where an invariant's start must be projected.
    t0, y0, f0 : float, ndarray, ndarray
        Start, and the derivative there.
    tau : float
        Step or initial step: the scale of time of the checks.
    projection : ProjectionOptions
    stepping : Stepping
    extra : tuple
        Further arguments of the invariants' functions (``(params,)`` or nothing).
    compensated : bool
    check_start : bool
        False: the invariants have been checked at the start of another run like this.
    hand : callable
        See `InvariantSet`.
    """
    if compensated and isinstance(tableau, OneStep):
        raise ValueError(f"compensated=True carries the rounding of a tableau's sums; {tableau.name} is no tableau.")
    n, width = y0.size, 2 if y0.dtype.kind == "c" else 1
    kind, sigma = _metric(projection.metric, tableau, n, width)
    if not isinstance(projection.direction, str) or projection.direction not in DIRECTIONS:
        raise ValueError(f"direction must be 'new', 'old' or 'midpoint', got {projection.direction!r}.")
    rtol, atol = stepping.rtol, stepping.atol
    groups = blocks_of(projection.blocks, n, width)
    invariants = InvariantSet(projection.invariants, t0, y0, f0, tau, extra, hand)
    options = Options(
        rtol=np.repeat(rtol, width),
        atol=atol,
        block_atol=np.sqrt(
            np.add.reduceat(np.repeat(atol, width)[groups.member] ** 2 / width, groups.start[:-1].astype(np.intp))
        ),
        groups=groups,
        frame=frame_rows(projection.frame, n, width),
        target=invariants.target,
        scales=invariants.scales,
        kappa=tableau.kappa,
        metric=kind,
        direction=DIRECTIONS[projection.direction],
        iterations=count("iterations", projection.iterations, MOST_ITERATIONS),
        every=_every(projection.every, tableau),
        # The steps of a one-step method do not take f: there is nothing to evaluate in the place of f(y_hat).
        reuse_f=flag("reuse_f", projection.reuse_f) or isinstance(tableau, OneStep),
        uses_f=invariants.uses_f,
        compensated=flag("compensated", compensated),
        adaptive=stepping.h is None,
        per_band=1.0 / ((BAND_COMPENSATED if compensated else BAND) * EPS),
        watched=flag("check", projection.check) and invariants.size > 0,
        limit=(LARGE_SHARE if stepping.h is None else 1.0) if projection.check else np.inf,
    )
    if _can_project_jointly(options, invariants):
        options = options._replace(joint=invariants.items)
    arrays = method_arrays(tableau)
    work = make_work(n, y0.dtype, arrays.b.size, invariants.size, groups.start.size - 1)
    if sigma is not None:
        work.sigma[:] = sigma
    check = bool(projection.check)
    trust = Trust(invariants.names, work.trust)
    run = Run(y0, arrays, options, work, invariants, projection.frame, trust, check, tau)
    if flag("project_initial", projection.project_initial):
        run.y0 = projected_start(run, rhs, t0, f0)
        f0 = rhs(t0, run.y0)
    violation = invariants.start_violation(t0, run.y0, f0)
    if violation:
        raise ValueError(f"{violation}; mend y0 or the target, or pass project_initial=True to project y0 first.")
    if options.watched:
        _note_terms(run, t0, f0)
    if check and check_start and np.isfinite(f0).all():
        run.trust.doubts += invariants.check(t0, run.y0, f0, tau)
    return run


def _note_terms(run: Run, t0: float, f0: np.ndarray) -> None:
    """The invariants' terms at the start, by which defects are measured."""
    known, y0 = run.invariants, run.y0
    G = known.gradients(t0, y0, f0).view(float)
    values, state, slope = known.values(t0, y0), y0.view(float), f0.view(float)
    kn.start_figures(values, known.target, known.scales, G, state, slope, run.tau, run.work.trust)


def _can_project_jointly(options: Options, invariants: InvariantSet) -> bool:
    """Whether the step is the one that `JointInvariants` take a shorter way to."""
    plain = (options.metric, options.direction, options.iterations) == (EUCLIDEAN, NEW, 1)
    free = options.frame.products.size == 0 and options.every != AUTO and not options.compensated
    return isinstance(invariants.items, JointInvariants) and plain and free


def projected_start(run: Run, rhs: Callable[[float, np.ndarray], np.ndarray], t0: float, f0: np.ndarray) -> np.ndarray:
    """y0 on the targets, by full Newton steps in the euclidean metric."""
    options = run.options._replace(
        metric=EUCLIDEAN, direction=NEW, iterations=START_ITERATIONS, compensated=False, watched=False, limit=np.inf
    )
    work = make_work(run.y0.size, run.y0.dtype, 0, run.invariants.size, 0)
    work.y_hat[:] = run.y0
    work.K[-1] = f0
    y = np.empty_like(run.y0)

    def fill(t: float, state: np.ndarray, out: np.ndarray, params: Any) -> None:
        out[:] = rhs(t, state)

    status = project_step(
        fill,
        run.invariants.inv,
        run.invariants.grad,
        None,
        t0,
        run.y0,
        run.y0.view(float),
        t0,
        True,
        options,
        work,
        y,
        y.view(float),
    )
    missed = np.abs(work.defect) > 1e-8 * run.invariants.term_sizes(t0, y, f0) if status == 0 else [True]
    if np.any(missed):
        raise ValueError(projection_failure(run.invariants, work, t0))
    return y


def projection_failure(invariants: InvariantSet, work: Work, t: float) -> str:
    """Which invariant a failed projection left worst, by how much, and the rank it had."""
    excess = np.abs(work.defect) / np.maximum(work.band, np.finfo(float).tiny)
    worst = int(np.argmax(np.where(np.isfinite(excess), excess, np.inf)))
    broken = [name for name, row in zip(invariants.names, work.G, strict=True) if not np.isfinite(row).all()]
    because = f"; the gradient of {broken[0]!r} is not finite there" if broken else ""
    return (
        f"projection failed at t={t:g}: invariant {invariants.names[worst]!r}, residual {work.defect[worst]:.3g}, "
        f"rank {int(work.counters[LAST_RANK])} of {invariants.size}{because}"
    )


def failure(status: int, run: Run, clock: Sequence[float] | np.ndarray) -> str:
    """Why a step failed."""
    if status == NOT_FINITE:
        return not_finite(run, clock[T], clock[H])
    if status == TOO_SMALL:
        return OdeSolver.TOO_SMALL_STEP
    return projection_failure(run.invariants, run.work, clock[T_NEW])


def not_finite(run: Run, t: float, h: float) -> str:
    """Why a step was not finite: the first stage that was not, overflow of the sum, or the error estimate."""
    work, method = run.work, run.method
    for i in range(method.b.size):
        if not np.isfinite(work.K[i]).all():
            return _bad_value(run, work.K[i], t + method.c[i] * h)
    if not np.isfinite(work.y_hat).all():
        return f"the state is no longer finite at t={t + h:.10g}: it overflowed, or h is too large"
    if not np.isfinite(work.K[-1]).all():
        return _bad_value(run, work.K[-1], t + h)
    return f"the error estimate is not finite at t={t + h:.10g}: it overflowed, or y and `atol` are 0 in a component"


def _bad_value(run: Run, f: np.ndarray, t: float) -> str:
    unset = np.flatnonzero(np.isnan(f))
    hint = ""
    if run.in_place and unset.size:
        hint = f" (component {unset[0]} is NaN; with in_place=True it must fill all of out)"
    return f"fun returned a non-finite value at t={t:.10g}{hint}"


def attach(diagnostics: Any, run: Run) -> None:
    """Let `diagnostics` read the run's buffers."""
    if diagnostics is None:
        return
    if not isinstance(diagnostics, Diagnostics):
        raise TypeError(f"diagnostics must be a Diagnostics() object, got {diagnostics!r}.")
    w = run.work
    diagnostics._attach(
        w.max_defect,
        w.defect,
        w.max_correction,
        w.counters,
        run.trust,
        estimated=run.options.metric == ERROR,
    )
