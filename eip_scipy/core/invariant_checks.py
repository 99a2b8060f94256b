"""Checks of invariants at a state: their gradients, their precision, and whether the system keeps them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..engine import data
from ..engine.data import EPS
from ..engine.trust import ROUNDING_OF_DIFFERENCES, ProjectionWarning
from .callers import users_level
from .conditional import is_kept_on_a_surface, on_targets
from .gradients import DIFFERENCE_WEIGHTS, random_directions, time_of_motion

if TYPE_CHECKING:
    from .invariants import InvariantSet

__all__ = ["Complaint", "complaints", "listed", "reported", "time_derivative"]

Array = np.ndarray
Derivative = Callable[[float, Array], Array]

# Lengths of difference steps. Shorter ones decide if the function is not smooth over the first one.
CHECK_STEPS = (data.CHECK_STEP, 6e-8, 6e-10)
# Bounds for the error of the rate of a balance, relative to its terms. If a rate is 1e-6 of its terms, an error of 1e-3
# of the rate is 1e-9 of the terms. Correct rates differ by 1e-16, those from numerical gradients by 1e-12.
RATE_TOLERANCE, RATE_TOLERANCE_OF_DIFFERENCES = 1e-11, 1e-9
# Single precision leaves this share of the terms of a rate.
SINGLE_TOLERANCE = 1e-5
# Values below this share of their terms have at most half of the bits of single precision, if their terms have it.
CANCELLED = 2.0**-12
# Components smaller than this share of the largest one are not examined for single precision.
LEAST_SINGLE = 1e-3
# A gradient may consist of rounding alone, such as a numerical gradient of a square at 0. It is evaluated at states
# that differ by BLUR roundings, and BLUR times its changes count as its rounding; BLURRED is for right-hand sides.
BLUR, BLURRED = 4.0, 3
# The rounding of a rate, in roundings of the largest derivatives of the same kind. Accelerations that come from a
# system of linear equations, such as those of constrained bodies, have errors of tens of roundings.
RATE_ROUNDINGS = 100.0
# Length of difference steps along the flow, in steps or in times in which the state moves by its size, and the error of
# such differences, in roundings of the terms of an invariant.
FLOW_SHARE, FLOW_ROUNDINGS = 1e-3, 20.0
# One-sided differences of order 6: weights of the values at 0, 1, ... 6 steps.
ONE_SIDED_WEIGHTS = (-49 / 20, 6.0, -15 / 2, 20 / 3, -15 / 4, 6 / 5, -1 / 6)
MOST_NAMES = 3
DOUBLE = (
    "Compute it in double precision: with JAX call jax.config.update('jax_enable_x64', True), with PyTorch use tensors "
    "and parameters of torch.float64"
)
NO_INVARIANT = (
    "{name!r} is not an invariant of this system: at t={t:.6g} it changes at the rate {rate:.3g}, and the absolute "
    "values of the terms of that rate sum to {terms:.3g}"
)
DEPENDS_ON_OTHERS = (
    "{name!r} is kept only where its rate of change is 0, as a length is while the velocity along it is 0, but at "
    "t={t:.6g} that rate is {rate:.3g}, and the absolute values of its terms sum to {terms:.3g}: a constraint on "
    "which {name!r} depends is missing or not met, such as the velocity constraint that belongs to a length"
)
WRONG = "Projecting on it gives a wrong solution: omit it, correct it, or pass a Balance if it changes slowly"
MISSING = "Add that constraint to the invariants, and start on it"


class Complaint(NamedTuple):
    """Something that a check of the invariants has found to be wrong: the `text`, and the `advice` about it.

    The run must not start if it `is_error`; otherwise there is a warning of the class `category` at the start. A
    finding is `dependent` if it is about an invariant that the system keeps only if other invariants hold.
    """

    is_error: bool
    text: str
    advice: str = ""
    dependent: bool = False
    category: type[Warning] = UserWarning


def reported(found: Iterable[Complaint]) -> list[str]:
    """Raise ValueError or warn about the findings of a check at the start; return the texts of the warnings."""
    texts = []
    for complaint in found:
        if complaint.is_error:
            raise ValueError(f"{complaint.text}. {complaint.advice}, or pass check=False to skip this check.")
        advice = f" {complaint.advice}." if complaint.advice else ""
        warnings.warn(
            f"{complaint.text}.{advice} (check=False skips this check.)",
            complaint.category,
            stacklevel=users_level(),
        )
        texts.append(complaint.text)
    return texts


class _Samples(NamedTuple):
    """A state, its derivative, and the gradients `G` (l, n) and values `here` (l,) at the state.

    `tau` is the length of a step. `span` (n,) is |y| plus the distance that each component moves in a step, or while
    the state changes by its own size if that is sooner. `directions` (2, n) are random vectors times `span`. `ends` (2,
    2, l) are the values at y + s * directions and y - s * directions, where s is the first of `CHECK_STEPS`.
    """

    t: float
    y: Array
    f: Array
    tau: float
    span: Array
    directions: Array
    G: Array
    here: Array
    ends: Array


def complaints(
    known: InvariantSet,
    t: float,
    y: Array,
    f: Array,
    tau: float,
    rhs: Derivative | None,
    evaluated: tuple[Array, Array] | None = None,
) -> Iterator[Complaint]:
    """Yield a `Complaint` for everything that is wrong with the invariants at a state (n,) with the derivative f.

    The precision of the invariants is checked first; if it is sufficient, then the gradients; and if these are correct,
    the rates of change. `tau` is the length of a step. If the right-hand side `rhs` is given, invariants that hold only
    together with others are examined at a state where all of them hold. `evaluated` are the gradients (l, n) and the
    values (l,) at the state, if they are known.
    """
    if known.size == 0 or y.size == 0:
        return
    G, here = (known.gradients(t, y, f), known.values(t, y)) if evaluated is None else evaluated
    directions = random_directions(y.size, y.dtype.kind == "c")
    if not known.balances.items and known.functions.is_in_order(t, y, f, G, here, tau, known.t_span, directions):
        return
    # The test points are at most as far away as the state moves while it changes by its own size, which is far less
    # than a step close to a singularity.
    span = np.abs(y) + min(tau, time_of_motion(y, f)) * np.abs(f)
    directions = directions * span
    ends = _values_at_ends(known, t, y, directions, CHECK_STEPS[0])
    at = _Samples(t, y, f, tau, span, directions, G, here, ends)
    for check in (_single_precision, _wrong_gradients):
        found = list(check(known, at))
        if found:
            yield from found
            return
    yield from _wrong_rates(known, at, rhs)


def listed(names: list[str]) -> str:
    """Return at most three names in quotes, and the number of the other names, as one text."""
    quoted = [repr(name) for name in names[:MOST_NAMES]]
    more = len(names) - len(quoted)
    return ", ".join(quoted) + (f" and {more} more" if more else "")


def _values_at_ends(known: InvariantSet, t: float, y: Array, directions: Array, step: float) -> Array:
    return np.array([[known.values(t, state) for state in y + side * directions] for side in (step, -step)])


def _blurred(at: _Samples) -> list[Array]:
    """Return three states that differ from `at.y` by a few roundings."""
    return [at.y + BLUR * EPS * d for d in (*at.directions, -at.directions[0])]


def _rounding(known: InvariantSet, at: _Samples, ways: Array) -> Array:
    """Return the rounding errors (k, l) of the derivatives of invariants along the vectors `ways` (k, n)."""
    blurred = [known.gradients(at.t, state, at.f) - at.G for state in _blurred(at)]
    return BLUR * np.abs(np.array(blurred)[:, None] * ways[:, None]).sum(axis=3).max(axis=0)


def _rounding_of_rates(known: InvariantSet, at: _Samples, unit: float, rhs: Derivative | None) -> Array:
    """Return the rounding errors (l,) of the rates of invariants, in units of `unit`, due to gradients and `rhs`."""
    found = _rounding(known, at, at.f[None] / unit)[0]
    if rhs is None:
        return found
    # The right-hand side is evaluated at more states, because forces that cancel may have no rounding at some of them.
    states = [*_blurred(at), *(at.y * (1.0 + BLUR * EPS * k) for k in range(-BLURRED, BLURRED + 1))]
    changes = [np.abs(at.G) @ np.abs(rhs(at.t, state) / unit - at.f / unit) for state in states]
    return found + BLUR * np.max(changes, axis=0)


def _are_single(values: Array) -> Array:
    """Return a mask of the columns of `values` (m, k) that are exact in float32 and use more than half of its bits."""
    values = np.ascontiguousarray(values, float)
    with np.errstate(over="ignore", invalid="ignore"):
        exact = values.astype(np.float32).astype(float) == values
    long = (values.view(np.int64) & (2**40 - 1)) != 0
    return exact.all(axis=0) & long.any(axis=0)


def _single_precision(known: InvariantSet, at: _Samples) -> Iterator[Complaint]:
    values = np.concatenate([at.ends.reshape(-1, known.size), at.here[None]])
    # A constraint that is nearly met is the difference of terms that cancel, of which few bits are left.
    terms = known.sizes_of_terms(at.y, at.G, at.here) + known.norm_products(at.G, at.y)
    cancels = np.abs(values).max(axis=0) < CANCELLED * terms
    single = _are_single(values) & ~cancels
    names = [name for name, found in zip(known.names, single, strict=True) if found]
    if names:
        yield Complaint(
            True,
            f"the values of invariant {listed(names)} have single precision (float32): their rounding, about 1e-7 of "
            "them, is larger than what a projection corrects",
            DOUBLE,
        )


def _in_single_precision(known: InvariantSet, at: _Samples, rhs: Derivative | None) -> str:
    """Return a text that says that fun or a gradient has single precision; "" if neither has."""
    states = at.y + CHECK_STEPS[0] * at.directions
    if rhs is not None and _vary_in_single([rhs(at.t, state) for state in states]):
        return "fun returns numbers of single precision (float32)"
    rows = [known.gradients(at.t, state, at.f) for state in states]
    for k, name in enumerate(known.names):
        if _vary_in_single([row[k] for row in rows]):
            return f"the gradient of invariant {name!r} has single precision (float32)"
    return ""


def _large_and_single(found: list[Array]) -> Array:
    """Return a mask of the floats that have single precision in all arrays `found` and are not relatively small.

    Small components are left out because a sum of terms that cancel, as next to an equilibrium, has few digits too.
    """
    values = np.array(found).view(float)
    sizes = np.abs(values).max(axis=0)
    return _are_single(values) & (sizes >= LEAST_SINGLE * sizes.max(initial=0.0))


def _vary_in_single(found: list[Array]) -> bool:
    """Return True if a component that varies between the arrays `found` has single precision in all of them."""
    varies = np.ptp(np.array(found).view(float), axis=0) != 0
    return bool((_large_and_single(found) & varies).any())


def _wrong_gradients(known: InvariantSet, at: _Samples) -> Iterator[Complaint]:
    """Yield a `Complaint` for each gradient that is wrong in the first test direction in which any one is wrong."""
    along, terms = (at.directions @ at.G.conj().T).real, np.abs(at.directions) @ np.abs(at.G).T
    # The terms inside an invariant may be larger than its value and than the products of gradient and state.
    inner = known.norm_products(at.G, at.span)
    wrong, ends = np.array(True), at.ends
    for step in CHECK_STEPS:
        if step != CHECK_STEPS[0]:
            ends = _values_at_ends(known, at.t, at.y, at.directions, step)
        difference = (ends[0] - ends[1]) * (0.5 / step)
        sizes, moves = np.abs(ends), np.abs(ends - at.here)
        noise = (data.CHECK_NOISE / step) * (EPS * np.maximum(np.maximum(sizes[0], sizes[1]), inner) + 5e-324)
        # At an extremum both ends move alike; their difference is then the rounding inside the invariant.
        allowed = data.CHECK_TOLERANCE * (terms + (moves[0] + moves[1]) * (0.5 / step))
        agrees = ~(np.abs(difference - along) > allowed + noise)
        if step != CHECK_STEPS[0]:
            agrees &= noise <= allowed
        wrong = wrong & ~agrees
        if not wrong.any():
            return
    wrong &= ~(_rounding(known, at, at.directions) > np.abs(difference - along))
    # Different slopes on both sides mean a kink, where no gradient of a function can be correct.
    kink = np.abs(ends[0] + ends[1] - 2 * at.here) / step > np.abs(along) * 0.01 + noise
    wrong &= ~(known.computed & kink)
    way = int(wrong.any(axis=1).argmax())
    for k in np.flatnonzero(wrong[way]):
        yield _wrong_gradient(known, int(k), at.t, difference[way, k], along[way, k])


def _wrong_gradient(known: InvariantSet, k: int, t: float, difference: float, along: float) -> Complaint:
    name = known.names[k]
    where = f"the derivative of the invariant along a test direction at t={t:.6g} is {difference:.6g}"
    if known.computed[k]:
        return Complaint(
            False,
            f"the gradient of invariant {name!r}, which is computed from its values, is not accurate: {where} by short "
            f"differences and {along:.6g} by the gradient. The function is not smooth there, or its values have few "
            "digits",
            "Pass the gradient to Invariant as grad=",
        )
    return Complaint(
        True,
        f"gradient of invariant {name!r} is wrong: {where} by differences and {along:.6g} by grad",
        "Correct grad, or omit it to have it computed",
    )


class _Rates(NamedTuple):
    """Rates of change of the invariants along the flow.

    `rate` (l,) contains the rates; `terms` (l,) the sums of the absolute values of the terms of each rate; `in_time`
    (l,) the partial time derivatives, divided by the largest component of the derivative of the state. `wrong` (l,) is
    a mask of the rates that exceed their errors. The given rate of a balance is subtracted from its rate of change, and
    `rate` is NaN for balances without a given rate.
    """

    rate: Array
    terms: Array
    in_time: Array
    wrong: Array


def _wrong_rates(known: InvariantSet, at: _Samples, rhs: Derivative | None) -> Iterator[Complaint]:
    found = _rates(known, at, rhs)
    if found is None:
        return
    wrong = found.wrong
    # Single precision is reported for small rates only, because it does not explain large ones.
    small = wrong & (np.abs(found.rate) <= SINGLE_TOLERANCE * found.terms)
    if (small.any() or _large_and_single([at.f]).any()) and (what := _in_single_precision(known, at, rhs)):
        names = [name for name, hidden in zip(known.names, small | ~wrong, strict=True) if hidden]
        if names:
            yield Complaint(
                False,
                f"{what}, which hides whether this system keeps {listed(names)}: rates of change below about 1e-7 of "
                "their terms are rounding",
                DOUBLE,
            )
        wrong = wrong & ~small
    carried = wrong & known.balances.mask
    if carried.any():
        yield _wrong_rate_of_balance(known, at, found, carried)
    wrong = wrong & ~carried
    if not wrong.any():
        return
    if rhs is not None and (moved := on_targets(known, at.t, at.y, at.span, rhs)) is not None:
        f = rhs(at.t, moved)
        G, here = known.gradients(at.t, moved, f), known.values(at.t, moved)
        nearest = at._replace(y=moved, f=f, G=G, here=here)
        if (there := _rates(known, nearest, rhs)) is not None:
            at, found, wrong = nearest, there, wrong & there.wrong
    yield from _complaints_of_rates(known, at, found, wrong, rhs)


def _complaints_of_rates(
    known: InvariantSet, at: _Samples, found: _Rates, wrong: Array, rhs: Derivative | None
) -> Iterator[Complaint]:
    """Yield a `Complaint` about the quantities that change, and one about those that are kept only if constraints hold.

    Before these there is one for each quantity that changes only by the rate that its gradient gives. `wrong` (l,) is a
    mask of all these quantities. Each text first names the one with the largest relative rate.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        order = np.argsort(-np.nan_to_num(np.abs(found.rate) / found.terms), kind="stable")
    by_values, misled = _misled_rates(known, at, found, wrong)
    conditional: list[int] = []
    plain: list[int] = []
    for k in (int(k) for k in order if wrong[k]):
        if misled[k]:
            text = (
                f"gradient of invariant {known.names[k]!r} is wrong: at t={at.t:.6g} the invariant changes at the rate "
                f"{found.rate[k]:.3g} by grad and {by_values[k]:.3g} by differences of its values"
            )
            yield Complaint(False, text, "Correct grad, or omit it to have it computed")
            continue
        free = rhs is not None and found.in_time[k] == 0
        kept = free and rhs is not None and is_kept_on_a_surface(known, k, ~found.wrong, at.t, at.y, at.f, rhs)
        (conditional if kept else plain).append(k)
    for those, words, advice in ((plain, NO_INVARIANT, WRONG), (conditional, DEPENDS_ON_OTHERS, MISSING)):
        if those:
            others = [known.names[k] for k in those[1:]]
            first = those[0]
            text = words.format(name=known.names[first], t=at.t, rate=found.rate[first], terms=found.terms[first])
            text += f"; the same holds for {listed(others)}" if others else ""
            yield Complaint(False, text, advice, those is conditional)


def _misled_rates(known: InvariantSet, at: _Samples, found: _Rates, wrong: Array) -> tuple[Array, Array]:
    """Return rates of change (l,) from values along the flow, and a mask of those that gradients have made wrong.

    Small errors of a gradient, which `_wrong_gradients` allows, still make a rate that exceeds its rounding. Only
    gradients of the user are considered.
    """
    given = wrong & ~known.computed
    motion = time_of_motion(at.y, at.f)
    if not given.any() or motion == math.inf:
        return np.full(known.size, np.nan), np.zeros(known.size, bool)
    length = FLOW_SHARE * min(at.tau, motion)

    def along(step: float) -> Array:
        total = np.zeros(known.size)
        for multiple, weight in DIFFERENCE_WEIGHTS:
            shift = multiple * step * at.f
            total += weight * (known.values(at.t, at.y + shift) - known.values(at.t, at.y - shift))
        return total / step

    slopes = along(length)
    terms = known.sizes_of_terms(at.y, at.G, at.here) + known.norm_products(at.G, at.span)
    errors = np.abs(slopes - along(0.5 * length)) + FLOW_ROUNDINGS * EPS * terms / length
    by_values = found.in_time * np.abs(at.f).max() + slopes
    misled = np.abs(found.rate - by_values) > 0.5 * np.abs(found.rate)
    return by_values, given & misled & (errors < 0.1 * np.abs(found.rate))


def _wrong_rate_of_balance(known: InvariantSet, at: _Samples, found: _Rates, wrong: Array) -> Complaint:
    """Return one `Complaint` about the balances in the mask `wrong`, whose rates are wrong, with the worst first."""
    shares = np.where(wrong, np.abs(found.rate) / np.where(found.terms > 0, found.terms, 1.0), 0.0)
    worst = int(np.argmax(shares))
    others = [name for k, name in enumerate(known.names) if wrong[k] and k != worst]
    rate = known.balances.known(at.t, at.y, at.f)[worst]
    text = (
        f"the rate of balance {known.names[worst]!r} is wrong: at t={at.t:.6g} rate returned {rate:.10g}, and "
        f"grad @ f + dF/dt is {rate + found.rate[worst]:.10g}, and the absolute values of the terms of this sum add up "
        f"to {found.terms[worst]:.3g}"
    )
    text += f"; the same holds for {listed(others)}" if others else ""
    return Complaint(False, text, "Correct rate, or omit it to have it computed", category=ProjectionWarning)


def _rates(known: InvariantSet, at: _Samples, rhs: Derivative | None) -> _Rates | None:
    """Return the rates of change at a state, or None if the state's derivative is too small to compute them."""
    # Rates are divided by the largest component of f, because they could overflow for large states otherwise.
    unit = np.abs(at.f).max()
    if 0 < unit < np.finfo(float).tiny / EPS:
        return None
    unit = unit or 1.0
    in_time, noise = time_derivative(known, at.t, at.y, at.G, at.here, at.tau)
    in_time, noise = in_time / unit, noise / unit
    products = at.G.conj() * (at.f / unit)
    carried = known.balances.mask
    own = known.balances.known(at.t, at.y, at.f) / unit
    rate, terms = in_time + products.sum(axis=1).real - own, np.abs(in_time) + np.abs(products).sum(axis=1)
    noise = noise + RATE_ROUNDINGS * EPS * known.norm_products(at.G, at.f / unit)
    of_balances = np.where(known.by_values, RATE_TOLERANCE_OF_DIFFERENCES, RATE_TOLERANCE)
    wrong = np.abs(rate) > np.where(carried, of_balances, data.INVARIANCE_TOLERANCE) * terms + noise
    computed = known.computed & (known.by_values | ~carried)
    if (wrong & computed).any():
        # A gradient that is computed across a kink is wrong, and so is the rate that follows from it.
        where = at.t, at.y, at.f, at.G, at.here
        by_values = known.functions.rates_by_values(*where, known.target, known.scales) / unit
        near = np.abs(in_time + by_values - own) > ROUNDING_OF_DIFFERENCES * terms
        wrong &= near | ~computed
    if wrong.any():
        wrong &= ~(_rounding_of_rates(known, at, unit, rhs) > np.abs(rate))
    with np.errstate(over="ignore"):
        return _Rates(rate * unit, terms * unit, in_time, wrong)


def time_derivative(known: InvariantSet, t: float, y: Array, G: Array, here: Array, tau: float) -> tuple[Array, Array]:
    """Return the partial time derivatives (l,) of the invariants and their rounding errors (l,).

    Only times inside the run's interval are used. A derivative that is unknown has the value 0 and an infinite error:
    if the interval contains no time other than t, or if `tau`, the length of a step, is 0, infinite, or too short to
    change t.
    """
    none = np.zeros(known.size)
    low, high = min(known.t_span), max(known.t_span)
    before, after = t - low, high - t
    side, room = (1, after) if after >= before else (-1, before)
    far = t + side * min(room, tau)
    if far == t or not 0 < tau < math.inf:
        return none, np.full(known.size, np.inf)
    with np.errstate(over="ignore"):
        rounding = EPS * known.sizes_of_terms(y, G, here)
        hidden = 4 * rounding / abs(far - t)
    fixed = known.values(far, y) == here  # True for almost all invariants
    step, centred = data.TIME_SHARE * tau, min(before, after) >= data.TIME_ROOM * data.TIME_SHARE * tau
    step = 2.0 ** (round(math.log2(step)) if centred else math.floor(math.log2(min(step, room / 6))))
    if fixed.all() and (known.values(t + side * step, y) == here).all():
        return none, hidden
    if not step > 100 * np.spacing(abs(t)):
        return none, np.where(fixed, hidden, np.inf)
    if centred:
        weights = {sign * multiple: sign * weight for multiple, weight in DIFFERENCE_WEIGHTS for sign in (1, -1)}
    else:
        weights = {side * k: side * weight for k, weight in enumerate(ONE_SIDED_WEIGHTS)}
    values = {multiple: known.values(t + multiple * step, y) for multiple in weights}
    changed = np.any([value != here for value in values.values()], axis=0)
    total = np.where(changed, sum(weight * values[multiple] for multiple, weight in weights.items()), 0.0)
    total[~np.isfinite(total)] = 0.0
    with np.errstate(over="ignore"):
        # A function of the time also has the rounding of its argument, such as of the phase omega t.
        of_time = EPS * abs(t) * np.abs(total / step)
        return total / step, np.where(fixed & ~changed, hidden, 50 * (rounding + of_time) / step)
