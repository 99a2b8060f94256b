"""Gauss-Jackson methods of any order: summed multistep methods for q'' = a(t, q) with a fixed step.

The coefficients of a method come first, then the limits of its stability, then its history in a run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache, partial
from math import comb
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..engine import data
from ..engine.data import AUTO, Multistep
from .base import DenseForm, Method
from .nystrom import RKN1210, NystromTableau, depends_on_velocity
from .runge_kutta import DOP853, Tableau

if TYPE_CHECKING:
    from ..core.runs import Run, Start

__all__ = [
    "GaussJackson",
    "Weights",
    "jacobian_product",
    "longest_stable",
    "stability_limit",
    "weights",
]

LEAST_ORDER, LARGEST_ORDER = 4, 16
# Order of the difference that has the shape of the errors and is still far above rounding at small steps.
ESTIMATE = 8
# Largest growth of a mode in a step with which the method is called stable.
GROWTH = 1e-4
# Number of moments that the rounded weights must have, and the length of a step in their unit of time.
MOMENTS, STEP = 4, 1 / 16
# Steps between projections with every="auto"; the second number is for balances that are projected by themselves.
AUTO_SPACING, AUTO_SPACING_OF_GROUPS = 64, 32
# Steps of DOP853, which starts where accelerations depend on velocities, in one step.
SUBSTEPS = 4
ROWS = 4  # of the history's window, in orders of the method
ALIGNMENT = 64
# Bodies whose frequency is above this share of what is stable without the Jacobian are corrected by it.
CORRECTED_SHARE = 0.8
# The largest differences of a smooth history, relative to the accelerations; for low orders, in units of those that
# the largest stable step has.
SMOOTH, SMOOTH_LOW = 1e-2, 30.0
ROUNDS = 12  # of the power iterations
DIFFERENCE = 1e-6

Array = np.ndarray
Series = list[Fraction]


@dataclass(frozen=True, eq=False, kw_only=True)
class GaussJackson(Method):
    """Gauss-Jackson method of a given order in summed form, with one evaluation per step.

    With the accelerations a_n at the ends of the steps, s_n = a_n + a_(n-1) + ... and S_n = s_n + s_(n-1) + ...,
    positions and velocities are

        q_(n+1) = h^2 (S_n + sum_j P_j a_(n-j)),    v_n = h (s_n + sum_j V_j a_(n-j)),    j < order,

    so that rounding errors are those of two sums, which are stored as pairs of floats. The position is predicted, the
    acceleration is evaluated there, and it is added to both sums (PEC).

    Parameters
    ----------
    order : int
        Order from 4 to 16, which is the number of accelerations in a formula.
    corrected : bool, optional
        If True and a run has a Jacobian, each acceleration is changed by the Jacobian times the change of the position
        by the corrector: this is nearly as stable as a second evaluation, without its cost.
    name : str, optional
        Name of the method.
    velocities : bool, optional
        True if the accelerations depend on velocities, which are then predicted too. A run determines this itself.

    Raises
    ------
    ValueError
        If the order is not allowed.

    Notes
    -----
    x = 1 - E^-1 is the backward difference and L = -log(1 - x) / x; the predicted position is the series of
    L^-2 / (1 - x), the position i steps back that of L^-2 (1 - x)^i, the velocity there that of L^-1 (1 - x)^i, after
    the leading terms, which are contained in the sums. All coefficients are fractions, rounded once.

    References
    ----------
    .. [1] P. Henrici, "Discrete Variable Methods in Ordinary Differential Equations", 1962, chapters 5 and 6.
    .. [2] M. M. Berry, L. M. Healy, "Implementation of Gauss-Jackson integration for orbit propagation", J. Astronaut.
       Sci. 52 (2004) 331, doi:10.1007/BF03546367.
    """

    of_second_order = has_history = True
    fixed_steps_only = True  # the estimate has the shape of the errors, but no size that could control a step

    order: int
    corrected: bool = False
    name: str = ""
    velocities: bool = False
    error_estimator_order: int = field(init=False)
    reference: str = field(
        init=False, default="Berry & Healy, J. Astronaut. Sci. 52 (2004) 331, doi:10.1007/BF03546367"
    )

    def __post_init__(self) -> None:
        order = self.order
        known = isinstance(order, (int, np.integer)) and not isinstance(order, bool)
        if not (known and LEAST_ORDER <= order <= LARGEST_ORDER):
            raise ValueError(f"order must be an integer from {LEAST_ORDER} to {LARGEST_ORDER}, got {order!r}.")
        object.__setattr__(self, "name", self.name or f"GJ{order}")
        object.__setattr__(self, "error_estimator_order", min(ESTIMATE, order - 2))

    def __repr__(self) -> str:
        corrected = ", corrected by the Jacobian" if self.corrected else ""
        return f"<GaussJackson {self.name}: order {self.order}{corrected}>"

    @property
    def metric_exponent(self) -> float:
        """Exponent of the error metric: (order + 2) / (order of the estimate + 2)."""
        return (self.order + 2) / (self.error_estimator_order + 2)

    @property
    def _starter(self) -> Tableau | NystromTableau:
        """Method that makes the first states."""
        return DOP853 if self.velocities else RKN1210

    def checked(self, run: Run, start: Start) -> GaussJackson:
        """Return the method with the attribute `velocities` of a run, see `Method.checked`.

        Accelerations that do not depend on velocities at the start may do so later, as with drag that acts in a part of
        an orbit. Therefore `velocities` is True if they come from a function that is called with velocities.
        """
        depends_on_velocity(run, start)  # raises an error if the state is not (q, v)
        return replace(self, velocities=run.problem.sees_velocity)

    def for_engine(self, sees_velocity: bool = False) -> data.Method:
        """Return the coefficients of the method that makes the first states; `begin` adds the history."""
        return self._starter.for_engine(sees_velocity)

    def begin(self, run: Run, start: Start) -> None:
        """Check the step at the start, and add the history of the method to the run.

        Raise ValueError if the step is not stable (not checked with ``check=False``), or if a run with balances has too
        few steps for a history.
        """
        n_steps, balanced = run.stepping.span.n_steps, run.work.level.size > 0
        shorter = n_steps - 1 < self.order
        if shorter and balanced and n_steps > 0:
            raise ValueError(
                f"{run.name} carries a Balance in its history, which needs more than {self.order} steps, but this run "
                f"has {n_steps}. Take a shorter step, or a Runge-Kutta method such as EIPDOP853."
            )
        corrected = slice(0, 0) if shorter else _System(self, run, start).corrected(check=run.options.limit < math.inf)
        # The engine takes balances with the room of a history, also in a run without steps.
        history = self._history(run, corrected, shorter_than_history=shorter and not balanced)
        run.stepper = run.stepper._replace(multistep=history)

    def _history(self, run: Run, corrected: slice, *, shorter_than_history: bool) -> Multistep:
        """Return the record and the buffers of the history; `corrected` are the floats that the Jacobian corrects."""
        order, half, span = self.order, run.work.err.size // 2, run.stepping.span
        pitch = -(-half // 4) * 4  # whole vectors
        limit, grouped = stability_limit(order, self.corrected), run.options.balance_groups.value.size > 0
        auto = AUTO_SPACING_OF_GROUPS if grouped else AUTO_SPACING
        return Multistep(
            **weights(order)._asdict(),
            growth=max(SMOOTH, min(SMOOTH_LOW * limit**order, 2.0 ** (order - 2))),
            middle=order // 2,
            brief=shorter_than_history,
            level=run.level,
            uses_v=self.velocities,
            t0=span.t0,
            h=span.h,
            substeps=SUBSTEPS if self.velocities else 1,
            spacing=auto if run.options.every == AUTO else run.options.every,
            corrected_first=corrected.start,
            corrected_count=corrected.stop - corrected.start,
            nodes=_aligned((ROWS * order, pitch)),
            sums=_aligned((4, pitch)),
            predicted=_aligned((3, pitch)),
            change=_aligned((half,)),
            levels=np.zeros((3, run.invariants.size)),
            rates=np.zeros((ROWS * order, run.work.level.size)),
            rate_sums=np.zeros((2, run.work.level.size)),
            place=np.zeros(data.N_NODE_PLACES, np.int64),
        )

    def dense_form(self, stepper: Any) -> DenseForm:
        """Return the form of the interpolants: of the history, or of the starting method if it makes all steps."""
        if not stepper.multistep.brief:
            weights = interpolation_weights(self.order).reshape(-1, self.order)
            return DenseForm(data.HISTORY, (self.order + 1) // 2 + 2, weights)
        # With velocities, the starting method makes several steps for each step.
        return DenseForm(data.QUINTIC, 3, own_slopes=True) if self.velocities else self._starter.dense_form(stepper)

    def rated_stages(self) -> Array:
        return np.zeros(self.for_engine().b.size, np.int64)  # rates are evaluated at the nodes of the history


@cache
def _inverse_powers(power: int, terms: int) -> Array:
    """Return the first `terms` coefficients of the series of L^-power in x; `GaussJackson` defines L and x."""
    inverse = [Fraction(1)]
    for k in range(1, terms):
        # The coefficients of L are 1, 1/2, 1/3 ...
        inverse.append(-sum((x / (k - j + 1) for j, x in enumerate(inverse)), Fraction(0)))
    return np.array(inverse) if power == 1 else np.convolve(inverse, _inverse_powers(power - 1, terms))[:terms]


def _series(power: int, back: int, terms: int) -> Series:
    """Return `terms` coefficients of the series in x of the position or velocity `back` steps before the newest node.

    `power` is 2 for the position and 1 for the velocity. The factor (1 - x)^back shifts a series back; back = -1 is one
    step ahead. The first `power` coefficients of the series, 1 and -1 - back, are left out, see `GaussJackson`.
    """
    n = terms + power
    shift = [Fraction((-1) ** k * comb(back, k) if back >= 0 else 1) for k in range(n)]
    return np.convolve(_inverse_powers(power, n), shift)[power:n].tolist()


def _weights(power: int, back: int, order: int) -> Series:
    """Return the weights of a_n, a_(n-1), ... in the position or velocity `back` steps before the newest node n."""
    series = _series(power, back, order)  # over backward differences of a_n
    return [(-1) ** j * sum((series[k] * comb(k, j) for k in range(j, order)), Fraction(0)) for j in range(order)]


position_series, velocity_series = partial(_series, 2), partial(_series, 1)
position_weights, velocity_weights = partial(_weights, 2), partial(_weights, 1)


def correction_weights(order: int) -> Series:
    """Return the order + 1 weights of a_(n+1), a_n, ... in the corrected minus the predicted position at n + 1."""
    corrected = [*position_weights(0, order), Fraction(0)]
    predicted = [Fraction(0), *position_weights(-1, order)]
    return [c - p for c, p in zip(corrected, predicted, strict=True)]


class Weights(NamedTuple):
    """The weights of a method as floats, from the oldest node to the newest."""

    predict_q: Array  # (order,): of the predicted position
    predict_v: Array
    states_q: Array  # (order, order): row k for the position k steps before the newest node
    states_v: Array
    correction: Array  # (order + 1,): of the corrected minus the predicted position
    shape_q: Array  # (order + 1,): of the difference that has the shape of the errors of positions
    shape_v: Array
    size: Array  # (order + 1,): of the highest difference
    error_constant: float  # size of the first omitted term of the series of the predicted position


@cache
def weights(order: int) -> Weights:
    """Return the weights of the method of this order.

    The difference that has the shape of the errors is one order higher for velocities than for positions.
    """
    back, estimate = range(order), min(ESTIMATE, order - 2)

    def difference(k: int) -> Array:
        return np.array([float((-1) ** j * comb(k, j)) for j in reversed(range(order + 1))])

    return Weights(
        predict_q=_balanced(position_weights(-1, order))[::-1].copy(),
        predict_v=_balanced(velocity_weights(-1, order))[::-1].copy(),
        states_q=np.array([position_weights(k, order)[::-1] for k in back], float),
        states_v=np.array([velocity_weights(k, order)[::-1] for k in back], float),
        correction=_balanced(correction_weights(order))[::-1].copy(),
        shape_q=difference(estimate),
        shape_v=difference(estimate + 1),
        size=difference(order),
        error_constant=abs(float(position_series(-1, order + 1)[order])),
    )


def _balanced(exact: Series) -> Array:
    """Round each weight to one of two neighbouring floats, so that the moments of orders 0 to 3 are kept best.

    The sum of the absolute errors of these moments of the weights is the smallest of all choices. Rounding to the
    nearest floats would change weights of 100 to 200 (order 14) by about 1e-14, by the same amounts in every step: this
    acts as a force along the motion, by which Mercury would drift by 2e-9 AU in 1000 years.
    """
    nearest = np.array([float(weight) for weight in exact])
    missed = np.array([float(weight - Fraction(rounded)) for weight, rounded in zip(exact, nearest, strict=True)])
    other = np.nextafter(nearest, np.where(missed > 0, np.inf, -np.inf))
    gap = other - nearest
    times = (np.arange(len(exact)) + 1.0) * STEP
    moments = times ** np.arange(MOMENTS)[:, None]
    choices = np.arange(2 ** len(exact))[:, None] >> np.arange(len(exact)) & 1
    left = np.abs(moments @ (missed - choices * gap).T).sum(axis=0)
    return np.asarray(np.where(choices[np.argmin(left)], other, nearest))


@cache
def interpolation_weights(order: int) -> Array:
    """Return the coefficients [back, node, power] of the Lagrange polynomials in theta.

    Node j is j steps before the newest one. theta counts steps from the node that is `back` steps before the newest
    one.
    """
    out = np.zeros((order, order, order))
    for back in range(order):
        for j in range(order):
            polynomial = [Fraction(1)]
            for other in (k for k in range(order) if k != j):
                # theta_j - theta_other = (back - j) - (back - other) = other - j
                pairs = zip([Fraction(0), *polynomial], [*polynomial, Fraction(0)], strict=True)
                polynomial = [(raised - (back - other) * same) / (other - j) for raised, same in pairs]
            out[back, j] = [float(c) for c in polynomial]
    return out


@cache
def _step_weights(order: int) -> tuple[Array, Array, Array, Array]:
    """Return the weights of a_n, a_(n-1), ... in differences of what the method predicts, newest first.

    They are those of the second difference of the position, over h^2; of the second difference of the position that is
    corrected minus the predicted one, by the newest node and by the others; and of the first difference of the
    velocity, over h.
    """
    P, V, D = (
        np.array([float(c) for c in weights])
        for weights in (position_weights(-1, order), velocity_weights(-1, order), correction_weights(order))
    )
    positions, velocities = np.convolve(P, [1.0, -2.0, 1.0]), np.convolve(V, [1.0, -1.0])
    positions[0] += 1.0
    velocities[0] += 1.0
    return positions, D[:1], np.convolve(np.append(0.0, D[1:]), [1.0, -2.0, 1.0]), velocities


def _growth(order: int, corrected: bool, square: float, damping: complex) -> float:
    """Return the largest modulus of a root of the characteristic polynomial for h^2 q'' = -square q - damping h v."""
    positions, newest, others, velocities = _step_weights(order)
    predicted = square * positions + damping * np.convolve(velocities, [1.0, -1.0])
    polynomial = np.zeros(order + 3, complex)
    polynomial[:3] += [1.0, -2.0, 1.0]
    polynomial[1:] += (1.0 - square * newest[0]) * predicted if corrected else predicted
    if corrected:
        polynomial += square * others
    return float(np.abs(np.roots(polynomial)).max())


def longest_stable(order: int, corrected: bool, fast: float, damped: float) -> float:
    """Return the largest part of a step h, at most 1, with which a method is stable.

    `fast` is h omega, for q'' = -omega^2 q, and `damped` h c, for the additional term -c v (friction) or i c v
    (rotation). `order` and `corrected` are those of `GaussJackson`. The method is stable if no root of the
    characteristic polynomial has a modulus above 1 + `GROWTH`, including the two roots of the solution.
    """

    def stable(part: float) -> bool:
        square, damping = (part * fast) ** 2, part * damped
        return all(_growth(order, corrected, square, w) <= 1.0 + GROWTH for w in {damping, 1j * damping})

    if stable(1.0):
        return 1.0
    low, high = 0.0, 1.0
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


@cache
def stability_limit(order: int, corrected: bool) -> float:
    """Return the largest h omega for which the method is stable without forces that depend on velocities."""
    return 2.0 * longest_stable(order, corrected, 2.0, 0.0)


def jacobian_product(jacobian: Callable[..., None], *extra: Array) -> Callable[[float, Array, Array], Array]:
    """Return ``product(t, q, dq)``, the Jacobian times dq, made from a user's ``jacobian(t, q, dq, out, *extra)``."""

    def product(t: float, q: Array, dq: Array) -> Array:
        out = np.empty_like(q)
        out.fill(np.nan)
        jacobian(t, q.copy(), dq.copy(), out, *extra)
        return out

    return product


class _System:
    """A system q'' = a(t, q[, v]) at the start of a run, whose fast motions limit the step of a method."""

    def __init__(self, method: GaussJackson, run: Run, start: Start) -> None:
        self.method, self.run, self.start, self.half = method, run, start, start.y.size // 2
        # (t, q, dq) -> (n/2,), the derivative of the accelerations along dq, or None
        self.jacobian = run.problem.jacobian_for(method)
        self.corrects = method.corrected and self.jacobian is not None

    def corrected(self, *, check: bool) -> slice:
        """Return the slice of the accelerations' floats that the Jacobian corrects; `check` that the step is stable."""
        (fastest, limit, places), strongest = self._fastest(), 0.0
        if self.method.velocities:
            strongest = _largest_eigenvalue(lambda d: self._difference(d, slice(self.half, None)), self.start.y)
        if check:
            self._require_stable(fastest, limit, strongest)
        width = 2 if self.start.y.dtype.kind == "c" else 1
        return slice(width * int(places[0]), width * int(places[-1] + 1)) if places.size else slice(0, 0)

    def _fastest(self) -> tuple[float, float, Array]:
        """Return the highest frequency, the largest stable product with h, and the components to correct."""
        problem, span = self.run.problem.problem, self.run.stepping.span
        plain, limit = (stability_limit(self.method.order, corrects) for corrects in (False, self.corrects))
        corrected = np.full(self.half, self.corrects)
        if problem is None or problem.frequencies is None:
            return self._largest_frequency(), limit, np.flatnonzero(corrected)
        bodies, moons = problem.frequencies(self.run.tangents.state(self.start.y), span.t_bound - span.t0)
        if self.corrects:
            fast = abs(span.h) * bodies > CORRECTED_SHARE * plain
            corrected = np.repeat(fast | (fast.any() & (bodies == 0.0)), self.half // bodies.size)
        planets = float(bodies.max(initial=0.0))
        # Nothing corrects moons.
        fastest, limit = (planets, limit) if planets * plain >= moons * limit else (moons, plain)
        return fastest, limit, np.flatnonzero(corrected)

    def _require_stable(self, fastest: float, limit: float, strongest: float) -> None:
        """Raise ValueError if h is not stable: h times the highest frequency, `fastest`, must be at most `limit`.

        `strongest` is the largest modulus of an eigenvalue of the accelerations' derivative by the velocities.
        """
        h, name = abs(self.run.stepping.span.h), self.run.name
        if not h * fastest <= limit:
            raise ValueError(
                f"{name}: h = {h:g} is not stable for the fastest motion at the start, of angular frequency "
                f"{fastest:.4g} (period {2 * np.pi / fastest:.4g}). Take h <= {limit / fastest:.3g}, or a method that "
                "is stable with longer steps, such as EIPRKN12."
            )
        if strongest == 0.0:
            return
        part = longest_stable(self.method.order, self.corrects, h * fastest, h * strongest)
        if part < 1.0:
            raise ValueError(
                f"{name}: h = {h:g} is not stable, because the derivative of the accelerations with respect to the "
                f"velocity is too large: its largest eigenvalue at the start has the size {strongest:.4g}. Take h <= "
                f"{part * h:.3g}, or a Runge-Kutta method such as EIPDOP853."
            )

    def _largest_frequency(self) -> float:
        """Return the largest angular frequency of small motions at the start, from the Jacobian's least eigenvalue."""
        (t, y, _, _), half = self.start, self.half

        def along(d: Array) -> Array:
            return self._difference(d, slice(0, half)) if self.jacobian is None else self.jacobian(t, y[:half], d)

        if half <= ROUNDS and y.dtype.kind == "f":
            columns = np.array([along(unit) for unit in np.eye(half)])
            if not np.isfinite(columns).all():
                return 0.0
            return math.sqrt(max(0.0, -np.linalg.eigvals(columns).real.min()))
        top = _largest_eigenvalue(along, y)
        return float(np.sqrt(max(0.0, _largest_eigenvalue(lambda d: top * d - along(d), y) - top))) if top else 0.0

    def _difference(self, d: Array, part: slice) -> Array:
        """Return the derivative (n/2,) of the accelerations at the start along d in `part`, positions or velocities."""
        t, y, f, _ = self.start
        length, moved = DIFFERENCE * (float(np.linalg.norm(y[part])) or 1.0), y.copy()
        moved[part] += length * d
        return np.asarray((self.run.problem.derivative(t, moved)[self.half :] - f[self.half :]) / length)


def _largest_eigenvalue(product: Callable[[Array], Array], y: Array) -> float:
    """Return the largest modulus of an eigenvalue of a matrix, to a few per cent; 0 if products are 0 or not finite.

    ``product(d)`` is the matrix times d. The vectors d have the type and half the size of the state y.
    """
    d, found = np.random.default_rng(0).standard_normal(y.size // 2).astype(y.dtype), 0.0
    for _ in range(ROUNDS):
        d = product(d / np.sqrt(np.vdot(d, d).real))
        found = float(np.sqrt(np.vdot(d, d).real))
        if not np.isfinite(found) or found == 0.0:
            return 0.0
    return found


def _aligned(shape: tuple[int, ...]) -> Array:
    """Return an array of zeros aligned to a cache line, because unaligned loads of vectors may take twice as long."""
    size = math.prod(shape)
    memory = np.zeros(size * 8 + ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    return memory[first : first + size * 8].view(np.float64).reshape(shape)
