"""The one copy of the step: Runge-Kutta stages, then the projection.

The functions here take callables. They are plain Python when called from Python (`EIPSolver`, interpreted
`integrate`) and are compiled when a compiled driver calls them. All work on buffers made once:

- ``rhs(t, y, out, params)`` fills the derivative,
- ``inv(t, y, values, params)`` fills the values of all invariants (l,),
- ``grad(t, y, f, G, params)`` fills their gradients (l, n); ``f`` is the derivative there where `uses_f` asks for it.
"""

from __future__ import annotations

from math import isfinite, isnan, sqrt

import numpy as np
from numba.extending import overload, register_jitable

from . import kernels as kn
from .counters import (
    BEGUN,
    FOUND,
    HAVE_ERROR,
    HAVE_F,
    LAST_RANK,
    NFEV,
    NJEV,
    NLU,
    PROJECTIONS,
    RANK_REDUCED,
    REJECTED,
    SKIPPED,
    SOFTENED,
    WAITED,
)
from .data import (
    AUTO,
    EPS,
    ERROR,
    FAILED_PROJECTION,
    LENGTH,
    NEW,
    NEXT_LENGTH,
    NOT_FINITE,
    OK,
    OLD,
    POSTPONED,
    TIME,
    TIME_NEW,
    TOO_SMALL,
    Method,
)
from .joint import project_jointly
from .sums import out_of_line

# Without reference counting and inlined, the driver runs 20 times faster: it hands records of some 40 arrays down.
_INLINED = {"_nrt": False, "error_model": "numpy", "forceinline": True}
_jitable = register_jitable(**_INLINED)

# every="auto": each AUTO_SPACING-th step asks whether a projection is worth it.
AUTO_SPACING = 5
# Without an estimate of their own, the first so many projections are compared with one, then one in as many.
SAMPLED_FIRST, SAMPLED_EACH = 8, 16


# Step control, as in SciPy's Runge-Kutta classes; a failed projection shrinks the step as CVODE does.
SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0
RETRY_FACTOR, MAX_RETRIES = 0.25, 10
HEALTHY, MAX_SOFTENED = 5.0, 3


@_jitable
def rk_step(rhs, params, t, y, y_r, h, m, o, w):
    """Raw Runge-Kutta step: y_hat (and its carry) from y, with K[0] = f(t, y)."""
    for i in range(1, m.b.size):
        kn.combine(y_r, h, m.A[i], w.K_r, i, w.stage_r)
        rhs(t + m.c[i] * h, w.stage, w.K[i], params)
    if o.compensated:
        kn.compensated_step(y_r, w.carry, h, m.b, m.b_low, w.K_r, w.y_hat_r, w.carry_hat)
    else:
        kn.combine(y_r, h, m.b, w.K_r, m.b.size, w.y_hat_r)


@_jitable
def rkn_step(rhs, params, t, y_r, h, m, o, w):
    """Raw Runge-Kutta-Nystrom step of y = (q, v): the stages keep v, which the accelerations do not see."""
    kn.copy(y_r, w.stage_r)
    for i in range(1, m.b.size):
        kn.nystrom_position(y_r, h, m.c[i], m.A[i], w.K_r, i, w.stage_r)
        rhs(t + m.c[i] * h, w.stage, w.K[i], params)
    if o.compensated:
        kn.compensated_nystrom(y_r, w.carry, h, m.b, m.b_low, m.b_v, m.b_v_low, w.K_r, w.y_hat_r, w.carry_hat)
    else:
        kn.nystrom_position(y_r, h, 1.0, m.b, w.K_r, m.b.size, w.y_hat_r)
        kn.nystrom_velocity(y_r, h, m.b_v, w.K_r, m.b.size, w.y_hat_r)


@_jitable
def raw_step(rhs, params, t, y, y_r, t_new, h, project, m, o, w):
    """Raw step; f(y_hat) in K[-1], the local error in w.err and its norm in w.norm where they are wanted."""
    advance_raw(rhs, params, t, y, y_r, h, m, o, w)
    if not kn.all_finite(w.y_hat_r):
        return NOT_FINITE
    look_back(rhs, params, t_new, y_r, h, project, m, o, w)
    return OK


@_jitable
def advance_raw(rhs, params, t, y, y_r, h, m, o, w):
    """The stages and their sum, w.y_hat."""
    if m.nystrom:
        rkn_step(rhs, params, t, y_r, h, m, o, w)
    else:
        rk_step(rhs, params, t, y, y_r, h, m, o, w)
    w.counters[NFEV] += m.b.size - 1


@_jitable
def look_back(rhs, params, t_new, y_r, h, project, m, o, w):
    """f(y_hat) in K[-1], the local error in w.err and its norm in w.norm where they are wanted."""
    w.counters[HAVE_F] = 0
    estimate = o.adaptive or ((o.metric == ERROR or o.every == AUTO) and o.target.size > 0)
    w.counters[HAVE_ERROR] = estimate
    if (estimate and m.fsal) or (project and o.uses_f):
        rhs(t_new, w.y_hat, w.K[-1], params)
        w.counters[NFEV] += 1
        w.counters[HAVE_F] = 1
    if estimate:
        estimate_error(y_r, h, m, o, w)
    elif project and is_sampled(o, w):
        sample_error(rhs, params, t_new, y_r, h, m, o, w)


@_jitable
def is_sampled(o, w):
    """Whether this projection, which needs no estimate, is compared with one all the same."""
    w.counters[BEGUN] += 1
    begun = w.counters[BEGUN]
    return o.watched and (begun <= SAMPLED_FIRST or begun % SAMPLED_EACH == 0)


@_jitable
def sample_error(rhs, params, t_new, y_r, h, m, o, w):
    """The local error in w.err, by an evaluation of f that is not counted and serves nothing else."""
    out_of_line()
    if w.counters[HAVE_F] == 0:
        rhs(t_new, w.y_hat, w.K[-1], params)
    if kn.largest_abs(m.e) > 0.0 or kn.largest_abs(m.e_v) > 0.0:
        estimate_error(y_r, h, m, o, w)
    else:
        kn.trapezoid_error(y_r, w.y_hat_r, h, w.K_r[0], w.K_r[-1], w.err)
    w.counters[HAVE_ERROR] = 1


def any_raw_step(rhs, params, t, y, y_r, t_new, h, project, m, o, w):
    """`raw_step` of a tableau, or that of a user's one-step method, which only interpreted runs take."""
    if isinstance(m, Method):
        return raw_step(rhs, params, t, y, y_r, t_new, h, project, m, o, w)
    return m.raw_step(rhs, params, t, y, y_r, t_new, h, project, o, w)


@overload(any_raw_step, jit_options=_INLINED, strict=False)
def _compiled_raw_step(rhs, params, t, y, y_r, t_new, h, project, m, o, w):
    return raw_step


@_jitable
def estimate_error(y_r, h, m, o, w):
    """Fill w.err, and w.norm for the step control."""
    width = o.groups.width
    if m.nystrom:
        half = w.err.size // 2
        kn.weighted_sum(m.e, w.K_r, half, h * h, w.err[:half])
        kn.weighted_sum(m.e_v, w.K_r, half, h, w.err[half:])
        if o.adaptive:
            w.norm[0] = kn.error_norm(w.err, y_r, w.y_hat_r, o.rtol, o.atol, width)
    elif m.paired:
        kn.weighted_sum(m.e, w.K_r, 0, h, w.err)
        kn.weighted_sum(m.e_low, w.K_r, 0, h, w.err_low)
        w.norm[0] = kn.paired_error_norm(w.err, w.err_low, y_r, w.y_hat_r, o.rtol, o.atol, width)
    else:
        w.norm[0] = kn.estimate(m.e, w.K_r, h, w.err, y_r, w.y_hat_r, o.rtol, o.atol, width, o.adaptive)


@_jitable
def close_step(rhs, params, t_new, y_new, project, status, o, w):
    """After the projection: the carry, the errors gathered, and f for the next step's first stage in K[-1]."""
    if o.compensated:
        kn.copy(w.carry_hat, w.carry)
    if not project or status == POSTPONED:
        w.counters[WAITED] += 1
    else:
        w.counters[WAITED] = 0
    if o.every != 1:
        if status == POSTPONED:
            kn.copy(w.err, w.err_sum)
        elif project:
            kn.fill(w.err_sum, 0.0)
        elif o.metric == ERROR or o.every == AUTO or o.adaptive:
            kn.quadrature(w.err, w.err_sum, w.err_sum)
    if w.counters[HAVE_F] == 0 or (project and status == OK and not o.reuse_f):
        rhs(t_new, y_new, w.K[-1], params)
        w.counters[NFEV] += 1


@_jitable
def evaluate_invariants(inv, params, t, y, o, w):
    """w.values = I(y); compensated runs add what the carry is worth, by the gradients at hand."""
    inv(t, y, w.values, params)
    if o.compensated:
        kn.add_products(w.G_r, w.carry_hat, w.values)


@_jitable
def other_directions(rhs, grad, params, t_old, y, y_r, t, o, w, y_new_r):
    """The first Newton step along the gradients at y or at the midpoint; w.G holds those at y_hat. Returns the rank."""
    kn.weigh_rows(w.G_r, w.sigma, o.frame, w.B)
    if o.direction == OLD:
        grad(t_old, y, w.K[0], w.G, params)
    else:
        kn.midpoint(y_r, w.y_hat_r, w.stage_r)
        t_mid = 0.5 * (t_old + t)
        if o.uses_f:
            rhs(t_mid, w.stage, w.f_point, params)
            w.counters[NFEV] += 1
        grad(t_mid, w.stage, w.f_point, w.G, params)
    w.counters[NJEV] += 1
    kn.weigh_rows(w.G_r, w.sigma, o.frame, w.Q)
    rank = kn.factor(w.Q, w.inverse_norms, w.R, w.pivots)
    if rank >= 0:
        kn.fill(w.mu, 0.0)
        kn.newton_matrix_solve(w.B, w.g, w.Q, w.pivots, rank, w.inner, w.mu)
        w.counters[NLU] += 1
        kn.move_along(w.mu, w.Q, w.sigma, o.frame, w.y_hat_r, w.move, y_new_r)
    return rank


@_jitable
def newton_iteration(rhs, inv, grad, params, t, rank, o, w, y_new, y_new_r):
    """One more Newton step along the same directions; False when every defect is inside its dead band."""
    inv(t, y_new, w.values, params)
    if o.uses_f:
        rhs(t, y_new, w.f_point, params)
        w.counters[NFEV] += 1
    grad(t, y_new, w.f_point, w.G, params)
    w.counters[NJEV] += 1
    if not kn.defects(w.values, o.target, w.G_r, y_new_r, o.scales, o.compensated, w.g, w.band, w.defect):
        return False
    kn.weigh_rows(w.G_r, w.sigma, o.frame, w.B)
    kn.newton_matrix_solve(w.B, w.g, w.Q, w.pivots, rank, w.inner, w.mu)
    w.counters[NLU] += 1
    kn.move_along(w.mu, w.Q, w.sigma, o.frame, w.y_hat_r, w.move, y_new_r)
    return True


@_jitable
def project_step(rhs, inv, grad, params, t_old, y, y_r, t, last, o, w, y_new, y_new_r):
    """Project w.y_hat into y_new by o.iterations Newton steps; returns OK, FAILED_PROJECTION or POSTPONED.

    w.err holds the local error of y_hat where the metric wants it, w.K[-1] f there where a gradient does. POSTPONED:
    with o.every == AUTO, while the invariants know no more than round-off (y_new is then y_hat).
    """
    counters = w.counters
    grad(t, w.y_hat, w.K[-1], w.G, params)
    counters[NJEV] += 1
    if o.every != 1 and (o.metric == ERROR or o.every == AUTO or o.adaptive):
        kn.quadrature(w.err, w.err_sum, w.err)
        if o.every == AUTO and not last and not kn.tells_more(w.err, w.G_r, w.y_hat_r):
            kn.copy(w.y_hat_r, y_new_r)
            return POSTPONED
    evaluate_invariants(inv, params, t, w.y_hat, o, w)
    outside = kn.defects(w.values, o.target, w.G_r, w.y_hat_r, o.scales, o.compensated, w.g, w.band, w.before)
    if not outside:
        counters[SKIPPED] += 1
        kn.copy(w.y_hat_r, y_new_r)
        status = kn.judge(w.values, o.target, w.before, w.band, y_new_r, w.defect, w.trust, o.per_band, o.limit)
        if status == OK:
            take_note(t, o, w)
        return status
    weigh = o.metric == ERROR
    largest_error, rank, correction = move(rhs, grad, params, t_old, y, y_r, t, weigh, 0.0, o, w, y_new_r)
    status = correct(rhs, inv, grad, params, t, rank, o, w, y_new, y_new_r)
    if o.direction == NEW and o.iterations == 1 and not o.compensated:
        alone = w.scale.size * o.groups.width == w.sigma.size
        doubtful = kn.all_finite(w.defect) if status != OK else alone and correction > HEALTHY
        if largest_error > 0.0 and doubtful:
            status, rank, correction = correct_softly(
                rhs, inv, grad, params, t_old, y, y_r, t, largest_error, alone, o, w, y_new, y_new_r
            )
        if status != OK and rank > 1:
            status, rank = correct_with_fewer(inv, params, t, rank - 1, o, w, y_new, y_new_r)
    counters[LAST_RANK] = max(rank, 0)
    if rank >= 0:
        counters[PROJECTIONS] += 1
        counters[RANK_REDUCED] += rank < w.g.size
    if status == OK:
        take_note(t, o, w)
        w.max_correction[0] = max(w.max_correction[0], correction)
    return status


@_jitable
def take_note(t, o, w):
    """Defects and corrections of an accepted projection; estimates gathered in quadrature are of errors that add."""
    if not o.watched:
        kn.raise_to(w.defect, w.max_defect)
        return
    waited = w.counters[WAITED]
    rounding = EPS
    errors = 1.0 if w.counters[HAVE_ERROR] else 0.0
    if waited > 0:
        rounding *= sqrt(1.0 + waited)
        gathered = o.metric == ERROR or o.every == AUTO or o.adaptive
        errors *= sqrt(1.0 + waited) if gathered else 1.0 + waited
    w.counters[FOUND] += kn.note(
        w.defect, w.max_defect, w.before, w.band, w.G_r, w.err, w.trust, o.per_band, t, errors, rounding
    )


def project_any(rhs, inv, grad, params, t_old, y, y_r, t, last, o, w, y_new, y_new_r):
    """`project_step`, or the shorter way of joint invariants, which only interpreted runs take, where that will do."""
    if o.joint is not None and project_jointly(t, o, w, y_new, y_new_r):
        return OK
    return project_step(rhs, inv, grad, params, t_old, y, y_r, t, last, o, w, y_new, y_new_r)


@overload(project_any, jit_options=_INLINED, strict=False)
def _compiled_projection(rhs, inv, grad, params, t_old, y, y_r, t, last, o, w, y_new, y_new_r):
    return project_step


@_jitable
def move(rhs, grad, params, t_old, y, y_r, t, weigh, largest_error, o, w, y_new_r):
    """The first Newton step; returns the largest relative error, the rank and the correction in local errors.

    `weigh`: fill the weights of the error metric before; else they stand, for the `largest_error` given.
    """
    w.counters[NLU] += 1
    # The state's own rounding is an error of the step, and at small steps the largest, unless it is carried along.
    rounding = 0.0 if o.compensated else EPS
    if o.direction == NEW:
        return kn.weighted_move(
            weigh, largest_error, w.err, rounding, y_r, w.y_hat_r, o.rtol, o.block_atol, o.groups, o.kappa, w.sigma,
            w.scale, w.ratio, w.G_r, o.frame, w.Q, w.inverse_norms, w.R, w.pivots, w.g, w.mu, w.move, y_new_r,
            o.iterations > 1,
        )  # fmt: skip
    if weigh:
        largest_error = kn.error_metric(
            w.err, rounding, y_r, w.y_hat_r, o.rtol, o.block_atol, o.groups, o.kappa, w.sigma, w.scale, w.ratio
        )
    rank = other_directions(rhs, grad, params, t_old, y, y_r, t, o, w, y_new_r)
    return largest_error, rank, kn.correction_in_local_errors(w.move, w.scale, o.groups, largest_error)


@_jitable
def correct(rhs, inv, grad, params, t, rank, o, w, y_new, y_new_r):
    """What follows the first Newton step: further ones, and whether the projection holds."""
    if rank < 0:
        kn.copy(w.before, w.defect)
        return FAILED_PROJECTION
    for _ in range(1, o.iterations):
        if not newton_iteration(rhs, inv, grad, params, t, rank, o, w, y_new, y_new_r):
            break
    if o.compensated:
        kn.copy(w.y_hat_r, y_new_r)
        kn.compensated_add(y_new_r, w.carry_hat, w.move)
    evaluate_invariants(inv, params, t, y_new, o, w)
    return kn.judge(w.values, o.target, w.before, w.band, y_new_r, w.defect, w.trust, o.per_band, o.limit)


@_jitable
def correct_softly(rhs, inv, grad, params, t_old, y, y_r, t, largest_error, alone, o, w, y_new, y_new_r):
    """Further tries with weights ever nearer to equal relative errors; at most MAX_SOFTENED.

    An estimate can vanish in a component, by symmetry, where the error does not; the others then carry a correction
    far larger than any error of the step. Components that stand alone are prone to it; a block's length is not.
    """
    out_of_line()
    w.counters[SOFTENED] += 1
    status, rank, correction = FAILED_PROJECTION, 0, np.inf
    for _ in range(MAX_SOFTENED):
        kn.soften(w.err, w.scale, o.groups, w.sigma)
        _, rank, correction = move(rhs, grad, params, t_old, y, y_r, t, False, largest_error, o, w, y_new_r)
        status = correct(rhs, inv, grad, params, t, rank, o, w, y_new, y_new_r)
        if status == OK and not (alone and correction > HEALTHY):
            break
    return status, rank, correction


@_jitable
def correct_with_fewer(inv, params, t, rank, o, w, y_new, y_new_r):
    """A last try with the first `rank` directions only; returns the status and the rank.

    Where gradients are nearly parallel, as on a nearly circular orbit, states near y_hat may not reach a target at
    all: the distance is of second order, and no shorter step mends it. What the directions left out would have
    corrected stays, so that a defect may grow to the sum of all.
    """
    out_of_line()
    kn.weigh_rows(w.G_r, w.sigma, o.frame, w.Q)
    found = kn.factor(w.Q, w.inverse_norms, w.R, w.pivots)
    rank = max(0, min(rank, found))
    kn.least_norm(w.g, w.inverse_norms, w.R, w.pivots, rank, w.mu)
    kn.move_along(w.mu, w.Q, w.sigma, o.frame, w.y_hat_r, w.move, y_new_r)
    evaluate_invariants(inv, params, t, y_new, o, w)
    kn.shared_defects(w.before, w.inverse_norms, w.g)
    return kn.judge(w.values, o.target, w.g, w.band, y_new_r, w.defect, w.trust, o.per_band, o.limit), rank


@_jitable
def finish_step(rhs, inv, grad, params, t, y, y_r, t_new, project, last, m, o, w, y_new, y_new_r):
    """The rest of a step whose raw result is accepted; returns OK or FAILED_PROJECTION."""
    status = OK
    if project:
        status = project_any(rhs, inv, grad, params, t, y, y_r, t_new, last, o, w, y_new, y_new_r)
        if status == FAILED_PROJECTION:
            w.counters[REJECTED] += 1
            return status
    else:
        kn.copy(w.y_hat_r, y_new_r)
    close_step(rhs, params, t_new, y_new, project, status, o, w)
    return OK


@_jitable
def next_step(finish, rhs, inv, grad, params, clock, k, span, m, o, w, y, y_r, y_new, y_new_r):
    """Step k: fixed, or the first one that the error control accepts; K[0] = f(t, y) on entry, K[-1] = f at its end.

    `finish` is `finish_step` or does as much. The control is SciPy's; a failed projection shortens the step, at most
    MAX_RETRIES times in a row. Returns OK, NOT_FINITE, FAILED_PROJECTION or TOO_SMALL.
    """
    adaptive = span.h == 0.0
    spacing = AUTO_SPACING if o.every == AUTO else o.every
    if not adaptive:
        clock[TIME] = span.t0 + k * span.h
    t = clock[TIME]
    least = kn.least_step(t, span.sign) if adaptive else 0.0
    h_abs = clock[NEXT_LENGTH]
    if h_abs > span.max_step:
        h_abs = span.max_step
    elif h_abs < least:
        h_abs = least
    rejected = False
    retries = 0
    status = NOT_FINITE if isnan(h_abs) else TOO_SMALL
    while h_abs >= least:
        if adaptive:
            t_new = t + h_abs * span.sign
            last = span.sign * (t_new - span.t_bound) >= 0
        else:
            t_new = span.t0 + (k + 1) * span.h
            last = k + 1 >= span.n_steps
        clock[TIME_NEW] = span.t_bound if last else t_new
        clock[LENGTH] = span.h if not (adaptive or last) else clock[TIME_NEW] - t
        h_abs = abs(clock[LENGTH])
        project = o.target.size > 0 and (last or spacing == 1 or (k + 1) % spacing == 0)
        status = any_raw_step(rhs, params, t, y, y_r, clock[TIME_NEW], clock[LENGTH], project, m, o, w)
        norm = w.norm[0] if adaptive else 0.0
        if status == OK and not isfinite(norm):
            status = NOT_FINITE
        if status == OK and norm < 1.0:
            status = finish(rhs, inv, grad, params, t, y, y_r, clock[TIME_NEW], project, last, m, o, w, y_new, y_new_r)
            if status == OK:
                factor = MAX_FACTOR if norm == 0.0 else min(MAX_FACTOR, SAFETY * norm**m.exponent)
                clock[NEXT_LENGTH] = h_abs * (min(1.0, factor) if rejected else factor)
                return OK
            if retries == MAX_RETRIES:
                return status
            retries += 1
            h_abs *= RETRY_FACTOR
        elif status == OK:
            h_abs *= max(MIN_FACTOR, SAFETY * norm**m.exponent)
            status = TOO_SMALL
        else:
            h_abs *= MIN_FACTOR
        if not adaptive:
            return status
        rejected = True
    return status
