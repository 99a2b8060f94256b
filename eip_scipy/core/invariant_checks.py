"""Checks of invariants at a state: whether their gradients are correct, and whether the system keeps them.

The derivative of an invariant along a vector follows from its gradient and from differences of its values. Along two
random vectors both must agree, and along the flow the derivative must vanish, or be the given rate of a balance.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..engine import data
from ..engine.data import EPS
from ..engine.trust import ROUNDING_OF_DIFFERENCES, ProjectionWarning
from .callers import users_level
from .derivatives import DIFFERENCE_WEIGHTS, random_directions, time_of_motion
from .inputs import converted_from_single

if TYPE_CHECKING:
    from .invariant_set import InvariantSet

__all__ = ["Finding", "findings", "listed", "reported", "time_derivative"]

Array = np.ndarray
Derivative = Callable[[float, Array], Array]

# Lengths of difference steps. Shorter ones decide if the function is not smooth over the first one.
CHECK_STEPS = (data.CHECK_STEP, 6e-8, 6e-10)
# Bounds for the error of the rate of a balance, relative to its terms. If a rate is 1e-6 of its terms, an error of 1e-3
# of the rate is 1e-9 of the terms. Correct rates differ by 1e-16, those from numerical gradients by 1e-12.
RATE_TOLERANCE, RATE_TOLERANCE_OF_DIFFERENCES = 1e-11, 1e-9
# Single precision leaves this share of the terms of a rate.
SINGLE_TOLERANCE = 1e-5
# A derivative may consist of rounding alone, such as a numerical gradient of a square at 0, or forces that cancel. It
# is evaluated at states that differ by BLUR roundings, and BLUR times its changes count as its rounding. Forces that
# cancel may have no rounding at some states, so that there are more of them: BLURRED to each side.
BLUR, BLURRED = 4.0, 3
# The rounding of a rate, in roundings of the largest derivatives of the same kind. Accelerations that come from a
# system of linear equations, such as those of constrained bodies, have errors of tens of roundings.
RATE_ROUNDINGS = 100.0
# `rates_by_values` of the engine takes differences over this share of the time in which the state moves by its size,
# with an error of VALUE_ROUNDINGS roundings of the terms of an invariant.
FLOW_SHARE, VALUE_ROUNDINGS = 1e-6, 4.0
# Newton's method for the targets of all invariants: most steps, error at which it ends, in roundings, and least
# singular value of the gradients that counts.
NEWTON_STEPS, ROUNDINGS, RANK_TOLERANCE = 10, 8.0, 1e-8
# One-sided differences of order 6: weights of the values at 0, 1, ... 6 steps.
ONE_SIDED_WEIGHTS = (-49 / 20, 6.0, -15 / 2, 20 / 3, -15 / 4, 6 / 5, -1 / 6)
MOST_NAMES = 3
DOUBLE = (
    "Compute it in double precision: with JAX call jax.config.update('jax_enable_x64', True), with PyTorch use tensors "
    "and parameters of torch.float64"
)
WRONG = (
    "Projecting on it gives a wrong solution: omit it, correct it, add the constraint on which it depends, or pass a "
    "Balance if it changes slowly"
)
CORRECT_GRAD = "Correct grad, or omit it to have it computed"


class Finding(NamedTuple):
    """Something that a check of the invariants has found to be wrong: the `text`, and the `advice` about it.

    The run must not start if it `is_error`; otherwise there is a warning of the class `category` at the start.
    """

    is_error: bool
    text: str
    advice: str
    category: type[Warning] = UserWarning


def reported(found: Iterable[Finding]) -> list[str]:
    """Raise ValueError or warn about the findings of a check at the start; return the texts of the warnings."""
    texts = []
    for finding in found:
        if finding.is_error:
            raise ValueError(f"{finding.text}. {finding.advice}, or pass check=False to skip this check.")
        text = f"{finding.text}. {finding.advice}. (check=False skips this check.)"
        warnings.warn(text, finding.category, stacklevel=users_level())
        texts.append(finding.text)
    return texts


def listed(names: list[str]) -> str:
    """Return at most three names in quotes, and the number of the other names, as one text."""
    more = len(names) - MOST_NAMES
    return ", ".join(map(repr, names[:MOST_NAMES])) + (f" and {more} more" if more > 0 else "")


class _State(NamedTuple):
    """A state, its derivative, and the gradients `G` (l, n) and `values` (l,) of the invariants there.

    `tau` is the length of a step. `span` (n,) is |y| plus the distance that each component moves in a step, or while
    the state changes by its own size if that is sooner, as close to a singularity.
    """

    t: float
    y: Array
    f: Array
    G: Array
    values: Array
    tau: float
    span: Array


def findings(
    known: InvariantSet,
    t: float,
    y: Array,
    f: Array,
    tau: float,
    rhs: Derivative,
    evaluated: tuple[Array, Array] | None = None,
) -> list[Finding]:
    """Return a `Finding` for everything that is wrong with the invariants at a state (n,) with the derivative f.

    The gradients are checked first, and if these are correct, the rates of change. `tau` is the length of a step.
    `evaluated` are the gradients (l, n) and the values (l,) at the state, if they are known.

    Single precision is named as the cause if a function returns float32 numbers of NumPy, JAX or PyTorch, also in a
    list. If the function converts them to double precision, another cause is named, and small errors may be missed.
    """
    if known.size == 0 or y.size == 0:
        return []
    G, values = (known.gradients(t, y, f), known.values(t, y)) if evaluated is None else evaluated
    directions = random_directions(y.size, y.dtype.kind == "c")
    if not known.balances.items and known.functions.is_in_order(t, y, f, G, values, tau, known.t_span, directions):
        return []
    with np.errstate(all="ignore"):
        span = np.abs(y) + min(tau, time_of_motion(y, f)) * np.abs(f)
        at = _State(t, y, f, G, values, tau, span)
        return _wrong_gradients(known, at, directions * span) or _wrong_rates(known, at, rhs)


def _rounding(at: _State, products: Callable[[Array], Array]) -> Array:
    """Return the rounding errors of ``products(state).sum(axis=-1)`` at a state, from its changes next to the state."""
    scaled = np.outer([k for k in range(-BLURRED, BLURRED + 1) if k], at.y)
    ways = random_directions(at.y.size, at.y.dtype.kind == "c") * at.span
    here = products(at.y)
    states = at.y + BLUR * EPS * np.concatenate([ways, -ways[:1], scaled])
    return BLUR * np.max([np.abs(products(state) - here).sum(axis=-1) for state in states], axis=0)


def _wrong_gradients(known: InvariantSet, at: _State, ways: Array) -> list[Finding]:
    """Return a `Finding` for each gradient that is wrong in the first of the directions `ways` with a wrong one."""
    along, terms = (ways @ at.G.conj().T).real, np.abs(ways) @ np.abs(at.G).T
    # The terms inside an invariant may be larger than its value and than the products of gradient and state.
    inner = known.norm_products(at.G, at.span)
    wrong = np.ones(along.shape, bool)
    for step in CHECK_STEPS:
        ends = np.array([[known.values(at.t, at.y + shift * way) for way in ways] for shift in (step, -step)])
        difference = (ends[0] - ends[1]) * (0.5 / step)
        noise = (data.CHECK_NOISE / step) * (EPS * np.maximum(np.abs(ends).max(axis=0), inner) + 5e-324)
        # At an extremum both ends move alike; their difference is then the rounding inside the invariant.
        allowed = data.CHECK_TOLERANCE * (terms + np.abs(ends - at.values).sum(axis=0) * (0.5 / step))
        agrees = ~(np.abs(difference - along) > allowed + noise)
        wrong &= ~(agrees & ((noise <= allowed) | (step == CHECK_STEPS[0])))
        if not wrong.any():
            return []
    wrong &= ~(_rounding(at, lambda y: known.gradients(at.t, y, at.f) * ways[:, None]) > np.abs(difference - along))
    # Different slopes on both sides mean a kink, where no gradient of a function can be correct.
    kink = np.abs(ends[0] + ends[1] - 2 * at.values) / step > np.abs(along) * 0.01 + noise
    wrong &= ~(known.computed & kink)
    if wrong.any() and (single := converted_from_single(lambda: known.values(at.t, at.y))):
        text = f"{single} numbers of single precision (float32), whose rounding exceeds what a projection corrects"
        return [Finding(True, text, DOUBLE)]
    way = int(wrong.any(axis=1).argmax())
    places = np.flatnonzero(wrong[way]).tolist()
    return [_wrong_gradient(known, k, at.t, difference[way, k], along[way, k]) for k in places]


def _wrong_gradient(known: InvariantSet, k: int, t: float, difference: float, along: float) -> Finding:
    name = known.names[k]
    where = f"the derivative of the invariant along a test direction at t={t:.6g} is {difference:.6g}"
    if not known.computed[k]:
        text = f"gradient of invariant {name!r} is wrong: {where} by differences and {along:.6g} by grad"
        return Finding(True, text, CORRECT_GRAD)
    return Finding(
        False,
        f"the gradient of invariant {name!r}, which is computed from its values, is not accurate: {where} by short "
        f"differences and {along:.6g} by the gradient. The function is not smooth there, or its values have few digits",
        "Pass the gradient to Invariant as grad=",
    )


class _Rates(NamedTuple):
    """Rates of change of the invariants along the flow, in units of `unit`, without the given rates of balances.

    `rate` (l,) contains the rates from gradients, NaN for balances without a given rate, and `terms` (l,) the sums of
    the absolute values of the terms of each rate. A mask (l,) of the rates that exceed a share of their terms is
    `large`. Those among them that are neither rounding nor caused by a kink are `wrong`. `by_values` (l,) are the rates
    from differences of values, if there are large ones.
    """

    unit: float
    rate: Array
    terms: Array
    large: Array
    wrong: Array
    by_values: Array


def _rates(known: InvariantSet, at: _State, rhs: Derivative) -> _Rates:
    # Rates could overflow for large states if they were not divided by the largest component of f.
    unit = float(np.abs(at.f).max()) or 1.0
    in_time, noise = (part / unit for part in time_derivative(known, at.t, at.y, at.G, at.values, at.tau))
    products, own = at.G.conj() * (at.f / unit), known.balances.known(at.t, at.y, at.f) / unit
    rate, terms = in_time + products.sum(axis=1).real - own, np.abs(in_time) + np.abs(products).sum(axis=1)
    noise = noise + RATE_ROUNDINGS * EPS * known.norm_products(at.G, at.f / unit)
    of_balances = np.where(known.by_values, RATE_TOLERANCE_OF_DIFFERENCES, RATE_TOLERANCE)
    tolerance = np.where(known.balances.mask, of_balances, data.INVARIANCE_TOLERANCE)
    large = np.abs(rate) > tolerance * terms + noise
    if not large.any():
        return _Rates(unit, rate, terms, large, large, rate)
    along = known.functions.rates_by_values(at.t, at.y, at.f, at.G, at.values, known.target, known.scales)
    by_values = in_time + along / unit - own
    # A gradient that is computed across a kink is wrong, and so is the rate that follows from it.
    trusted = ~known.computed | (known.balances.mask & ~known.by_values)
    wrong = large & (trusted | (np.abs(by_values) > ROUNDING_OF_DIFFERENCES * terms))
    if wrong.any():
        wrong &= ~(_rounding(at, lambda y: known.gradients(at.t, y, at.f) * (rhs(at.t, y) / unit)) > np.abs(rate))
    return _Rates(unit, rate, terms, large, wrong, by_values)


def _wrong_rates(known: InvariantSet, at: _State, rhs: Derivative) -> list[Finding]:
    """Return one `Finding` about single precision, one about balances, and those about quantities that change."""
    if 0 < np.abs(at.f).max() < np.finfo(float).tiny / EPS:  # the rates would have too few digits
        return []
    findings, found = [], _rates(known, at, rhs)
    wrong = found.wrong
    # Single precision does not explain large rates.
    small = found.large & (np.abs(found.rate) <= SINGLE_TOLERANCE * found.terms)
    if small.any() and (single := converted_from_single(lambda: known.gradients(at.t, at.y, rhs(at.t, at.y)))):
        text = (
            f"{single} numbers of single precision (float32), which hides whether this system keeps "
            f"{_names(known, np.flatnonzero(small))}: rates of change below about 1e-7 of their terms are rounding"
        )
        findings.append(Finding(False, text, DOUBLE))
        wrong = wrong & ~small
    if (carried := wrong & known.balances.mask).any():
        findings.append(_wrong_rate_of_balance(known, at, found, carried))
        wrong = wrong & ~carried
    if not wrong.any():
        return findings
    if (nearest := _on_targets(known, at, rhs)) is not at:
        at, found = nearest, _rates(known, nearest, rhs)
        wrong = wrong & found.wrong
    return findings + _changing(known, at, found, wrong)


def _names(known: InvariantSet, places: Iterable[int]) -> str:
    return listed([known.names[k] for k in places])


def _largest_first(found: _Rates, wrong: Array) -> list[int]:
    """Return the indices of the quantities in the mask `wrong`, those with the largest relative rates first."""
    order = np.argsort(-np.nan_to_num(np.abs(found.rate) / found.terms), kind="stable")
    return [int(k) for k in order if wrong[k]]


def _changing(known: InvariantSet, at: _State, found: _Rates, wrong: Array) -> list[Finding]:
    """Return one `Finding` about each gradient that is slightly wrong, and one about the quantities that change.

    Small errors of a user's gradient, which `_wrong_gradients` allows, make rates that differences of values lack.
    """
    size, motion = np.abs(found.rate), time_of_motion(at.y, at.f)
    rounding = VALUE_ROUNDINGS * EPS * known.sizes_of_terms(at.y, at.G, at.values) / (FLOW_SHARE * found.unit)
    shown = (np.abs(found.rate - found.by_values) > 0.5 * size) & (rounding < 0.1 * size * motion) & (motion < math.inf)
    misled = shown & ~known.computed
    findings = []
    for k in _largest_first(found, wrong & misled):
        text = (
            f"gradient of invariant {known.names[k]!r} is wrong: at t={at.t:.6g} the invariant changes at the rate "
            f"{found.rate[k] * found.unit:.3g} by grad and {found.by_values[k] * found.unit:.3g} by differences of its "
            "values"
        )
        findings.append(Finding(False, text, CORRECT_GRAD))
    if changing := _largest_first(found, wrong & ~misled):
        k, *others = changing
        text = (
            f"{known.names[k]!r} is not an invariant of this system: at t={at.t:.6g} it changes at the rate "
            f"{found.rate[k] * found.unit:.3g}, and the absolute values of the terms of that rate sum to "
            f"{found.terms[k] * found.unit:.3g}"
        )
        text += f"; the same holds for {_names(known, others)}" if others else ""
        findings.append(Finding(False, text, WRONG))
    return findings


def _wrong_rate_of_balance(known: InvariantSet, at: _State, found: _Rates, wrong: Array) -> Finding:
    """Return one `Finding` about the balances in the mask `wrong`, whose rates are wrong, with the worst first."""
    worst, *others = _largest_first(found, wrong)
    rate = known.balances.known(at.t, at.y, at.f)[worst]
    text = (
        f"the rate of balance {known.names[worst]!r} is wrong: at t={at.t:.6g} rate returned {rate:.10g}, and "
        f"grad @ f + dF/dt is {rate + found.rate[worst] * found.unit:.10g}, and the absolute values of the terms of "
        f"this sum add up to {found.terms[worst] * found.unit:.3g}"
    )
    text += f"; the same holds for {_names(known, others)}" if others else ""
    return Finding(False, text, "Correct rate, or omit it to have it computed", ProjectionWarning)


def _on_targets(known: InvariantSet, at: _State, rhs: Derivative) -> _State:
    """Return the state with the smallest residual that Newton's method finds on the way to the targets.

    Some quantities are kept only where others have their targets, such as a length while the velocity along it is 0.
    The residual is the largest of all invariants, relative to their terms. Steps are the shortest in units of `span`.
    """
    state, best, least = at, at, np.inf
    weights = np.repeat(at.span, at.y.view(float).size // at.y.size)
    for _ in range(NEWTON_STEPS):
        size = known.sizes_of_terms(state.y, state.G, state.values) + known.norm_products(state.G, state.y)
        residual = state.values - known.target
        worst = (np.abs(residual) / np.where(size > 0, size, 1.0)).max()
        if not worst < least:
            break
        best, least = state, worst
        if worst <= ROUNDINGS * EPS:
            break
        rows = state.G.view(float) * weights
        lengths = np.linalg.norm(rows, axis=1)
        lengths[lengths == 0] = 1.0
        move = np.linalg.lstsq(rows / lengths[:, None], residual / lengths, rcond=RANK_TOLERANCE)[0]
        y = (state.y.view(float) - weights * move).view(at.y.dtype)
        f = rhs(at.t, y)
        state = at._replace(y=y, f=f, G=known.gradients(at.t, y, f), values=known.values(at.t, y))
    return best


def time_derivative(known: InvariantSet, t: float, y: Array, G: Array, here: Array, tau: float) -> tuple[Array, Array]:
    """Return the partial time derivatives (l,) of the invariants and their rounding errors (l,).

    Only times inside the run's interval are used. A derivative that is unknown has the value 0 and an infinite error:
    if the interval contains no time other than t, or if `tau`, the length of a step, is 0, infinite, or too short to
    change t.
    """
    none = np.zeros(known.size)
    before, after = t - min(known.t_span), max(known.t_span) - t
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
    values = [known.values(t + multiple * step, y) for multiple in weights]
    changed = (np.array(values) != here).any(axis=0)
    total = np.where(changed, sum(weight * value for weight, value in zip(weights.values(), values, strict=True)), 0.0)
    total[~np.isfinite(total)] = 0.0
    with np.errstate(over="ignore"):
        # A function of the time also has the rounding of its argument, such as of the phase omega t.
        of_time = EPS * abs(t) * np.abs(total / step)
        return total / step, np.where(fixed & ~changed, hidden, 50 * (rounding + of_time) / step)
