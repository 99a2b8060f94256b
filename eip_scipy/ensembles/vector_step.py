"""The loop over steps for members of an ensemble side by side, eight to a vector.

All lanes take the same fixed steps. What is added and multiplied component by component (stages, error estimates) runs
over (n, lanes) as over one long state, by the code of the single run; the projection runs octet by octet, by kernels
that Numba compiles for floats and for octets from one source. So each member gets the bits of a run of its own.

What only some members need has no place in a vector. Where gradients are nearly parallel, the member's Newton step is
solved by itself. Where more is needed (softened weights, a second try after a projection that failed, squares that
overflow) the member leaves: its state at the start of that step is put aside, NaN takes its lane, and the driver of
single runs takes it from there.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from ..engine import kernels as kn
from ..engine.counters import HAVE_ERROR, N_COUNTERS, NJEV, WAITED
from ..engine.data import EPS, ERROR, OK, FrameRows, Work, make_work
from ..engine.octets import LANES, any_lane, is_not, lane_of, octets, spread, where
from ..engine.step import HEALTHY, _jitable, advance_raw, close_step, look_back
from ..engine.sums import abs_dot, dot, largest, out_of_line
from ..engine.trust import EXPECTED, FAR, LARGE, LARGE_SHARE, LEFT, N_FIGURES, START, SUM, TERMS

__all__ = ["Lanes", "Leavers", "finish_batch", "make_advance_batch", "make_lanes", "make_lanes_work"]


class Leavers(NamedTuple):
    """Members that left: `step` (lanes,) is the step that they have not done, -1 for those still here.

    Their states and slopes (n, lanes) at its start, the errors gathered, and the run's counters (N_COUNTERS, lanes).
    """

    step: np.ndarray
    y: np.ndarray
    f: np.ndarray
    err_sum: np.ndarray
    counters: np.ndarray


class Single(NamedTuple):
    """Buffers of a Newton step for one member, as in `Work`."""

    G: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    inverse_norms: np.ndarray
    pivots: np.ndarray
    g: np.ndarray
    mu: np.ndarray
    sigma: np.ndarray
    y_hat: np.ndarray
    move: np.ndarray
    y_new: np.ndarray


class Lanes(NamedTuple):
    """What the projection of all members needs: the arrays of `Work`, options and counts with one lane per member.

    `alive` is 1 or 0. What has one number per member has one row. `trust` holds the figures of `Trust`, as far as they
    tell which members are `suspect`: these run again by themselves, which then finds all of them.
    """

    rtol: np.ndarray
    target: np.ndarray
    err: np.ndarray
    sigma: np.ndarray
    move: np.ndarray
    scale: np.ndarray
    ratio: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    mu: np.ndarray
    values: np.ndarray
    g: np.ndarray
    band: np.ndarray
    before: np.ndarray
    defect: np.ndarray
    products: np.ndarray
    max_defect: np.ndarray
    max_correction: np.ndarray
    projections: np.ndarray
    skips: np.ndarray
    reduced: np.ndarray
    rank: np.ndarray
    doubtful: np.ndarray
    outside: np.ndarray
    correction: np.ndarray
    alive: np.ndarray
    trust: np.ndarray
    suspect: np.ndarray
    start_counts: np.ndarray
    single: Single
    left: Leavers


def make_lanes_work(n: int, lanes: int, stages: int, n_invariants: int) -> Work:
    """Buffers of the raw step for (n, lanes); those of the projection are in `Lanes`."""
    w = make_work(n * lanes, np.dtype(float), stages, n_invariants, 0)
    state = (n, lanes)
    return w._replace(
        K=w.K.reshape(stages + 1, *state),
        stage=w.stage.reshape(state),
        y_hat=w.y_hat.reshape(state),
        f_point=w.f_point.reshape(state),
        G=w.G.reshape(n_invariants, *state),
    )


def make_lanes(w: Work, rtol: np.ndarray, n_blocks: int, n_products: int) -> Lanes:
    """Buffers of the projection beside those of `make_lanes_work`."""
    rows, n, lanes = w.G.shape
    state, small = (n, lanes), (rows, lanes)
    names = ("target", "mu", "values", "g", "band", "before", "defect", "max_defect")
    one = ("max_correction", "projections", "skips", "reduced", "rank", "doubtful", "outside", "correction")
    return Lanes(
        **{name: np.zeros(small) for name in names},
        **{name: np.zeros((1, lanes)) for name in one},
        rtol=rtol,
        err=w.err.reshape(state),
        sigma=w.sigma.reshape(state),
        move=w.move.reshape(state),
        scale=np.zeros((n_blocks, lanes)),
        ratio=np.zeros((n_blocks, lanes)),
        Q=np.zeros((rows, *state)),
        R=np.zeros((rows, *small)),
        products=np.zeros((n_products, lanes)),
        alive=np.ones((1, lanes)),
        trust=np.zeros((rows, N_FIGURES, lanes)),
        suspect=np.zeros((1, lanes)),
        start_counts=np.zeros(N_COUNTERS, np.int64),
        single=_make_single(n, rows),
        left=Leavers(
            np.full(lanes, -1), np.zeros(state), np.zeros(state), np.zeros(state),
            np.zeros((N_COUNTERS, lanes), np.int64),
        ),
    )  # fmt: skip


def _make_single(n: int, rows: int) -> Single:
    states = {name: np.zeros(n) for name in ("sigma", "y_hat", "move", "y_new")}
    small = {name: np.zeros(rows) for name in ("inverse_norms", "g", "mu")}
    return Single(
        **states,
        **small,
        G=np.zeros((rows, n)),
        Q=np.zeros((rows, n)),
        R=np.zeros((rows, rows)),
        pivots=np.zeros(rows, np.int64),
    )


@_jitable
def all_finite(a):
    """Per lane, whether the sum of squares is finite; states so large that it overflows are for the single run."""
    square = dot(a, a)
    return square - square == 0.0


@_jitable
def correct_octet(c, o, w, s, y, all_new):
    """Defects, weights and the Newton step of eight members, from w.y_hat into all_new."""
    y, y_hat, y_new = octets(y, c), octets(w.y_hat, c), octets(all_new, c)
    G, Q, R = octets(w.G, c), octets(s.Q, c), octets(s.R, c)
    sigma, scale, ratio, move = octets(s.sigma, c), octets(s.scale, c), octets(s.ratio, c), octets(s.move, c)
    g, mu = octets(s.g, c), octets(s.mu, c)
    frame = FrameRows(o.frame.start, o.frame.place, o.frame.value, octets(s.products, c), o.frame.bodies)
    outside = kn.defects(
        octets(s.values, c), octets(s.target, c), G, y_hat, o.scales, False, g, octets(s.band, c), octets(s.before, c)
    )
    doubtful = is_not(outside) & outside
    largest_error = spread(0.0)
    if o.metric == ERROR:
        err = octets(s.err, c)
        doubtful = doubtful | kn.block_sizes(y, y_hat, err, EPS, s.rtol, o.groups, sigma, scale, ratio)
        largest_error = kn.weights_from_sizes(o.block_atol, o.groups, o.kappa, sigma, scale, ratio)
    kn.weigh_rows(G, sigma, frame, Q)
    dependent = outside & is_not(kn.solve_gram(Q, g, R, mu))
    kn.move_along(mu, Q, sigma, frame, y_hat, move, y_new)
    octets(s.rank, c)[0] = spread(1.0 * g.size)
    if any_lane(dependent):
        for lane in range(LANES):
            if lane_of(dependent, lane):
                solve_alone(c + lane, o, w, s, all_new)
    correction = kn.correction_in_local_errors(move, scale, o.groups, largest_error)
    if scale.size == sigma.size:
        doubtful = doubtful | (correction > HEALTHY)
    for i in range(y_new.size):
        y_new[i] = where(outside, y_new[i], y_hat[i])
    octets(s.outside, c)[0] = where(outside, 1.0, 0.0)
    octets(s.doubtful, c)[0] = where(outside & doubtful, 1.0, 0.0)
    octets(s.correction, c)[0] = correction


@_jitable
def solve_alone(lane, o, w, s, all_new):
    """The Newton step of one member, whose gradients are nearly parallel or vanish, by pivoted QR."""
    out_of_line()
    one = s.single
    for i in range(one.y_hat.size):
        one.sigma[i] = s.sigma[i, lane]
        one.y_hat[i] = w.y_hat[i, lane]
        for j in range(one.g.size):
            one.G[j, i] = w.G[j, i, lane]
    for j in range(one.g.size):
        one.g[j] = s.g[j, lane]
    kn.weigh_rows(one.G, one.sigma, o.frame, one.Q)
    rank = kn.factor(one.Q, one.inverse_norms, one.R, one.pivots)
    s.rank[0, lane] = rank
    if rank >= 0:
        kn.least_norm(one.g, one.inverse_norms, one.R, one.pivots, rank, one.mu)
        kn.move_along(one.mu, one.Q, one.sigma, o.frame, one.y_hat, one.move, one.y_new)
    for i in range(one.y_hat.size):
        s.move[i, lane] = one.move[i] if rank >= 0 else np.nan
        all_new[i, lane] = one.y_new[i] if rank >= 0 else np.nan


@_jitable
def judge_octet(c, k, o, w, s, y, y_new):
    """Count what has been done, and let those members leave for whom it was not enough."""
    new, defect = octets(y_new, c), octets(s.defect, c)
    held = kn.defects_held(octets(s.values, c), octets(s.target, c), octets(s.before, c), octets(s.band, c), defect)
    alive = octets(s.alive, c)[0] > 0.0
    good = held & all_finite(new) & (octets(s.doubtful, c)[0] == 0.0)
    outside = octets(s.outside, c)[0] > 0.0
    done = alive & good
    record, correction = octets(s.max_defect, c), octets(s.max_correction, c)
    for i in range(defect.size):
        record[i] = where(done, max(record[i], abs(defect[i])), record[i])
    correction[0] = where(done & outside, max(correction[0], octets(s.correction, c)[0]), correction[0])
    octets(s.projections, c)[0] += where(done & outside, 1.0, 0.0)
    reduced = octets(s.rank, c)[0] < 1.0 * defect.size
    octets(s.reduced, c)[0] += where(done & outside & reduced, 1.0, 0.0)
    octets(s.skips, c)[0] += where(done & is_not(outside), 1.0, 0.0)
    if o.watched:
        watch_octet(c, done, o, w, s, defect)
    let_leave(alive & is_not(good), c, k, w, s, y, y_new)


@_jitable
def watch_octet(c, done, o, w, s, defect):
    """What `take_note` and `note` do for one member, as far as it tells whether something stands out."""
    G, err, trust = octets(w.G, c), octets(s.err, c), octets(s.trust, c)
    band, before = octets(s.band, c), octets(s.before, c)
    steps = 1.0 + w.counters[WAITED]
    errors = sqrt(steps) if o.metric == ERROR else steps
    suspect = octets(s.suspect, c)[0] > 0.0
    for i in range(defect.size):
        terms = o.per_band * band[i]
        own = min(max(terms, kn.LEAST_SHARE * trust[i, START]), trust[i, TERMS]) + kn.TINY
        far = abs(defect[i]) > LARGE_SHARE * own
        known = where(trust[i, TERMS] < np.inf, trust[i, TERMS], 0.0)
        trust[i, TERMS] = where(far, trust[i, TERMS], max(known, terms))
        suspect = suspect | (done & (far | (abs(before[i]) > FAR * own)))
        if w.counters[HAVE_ERROR]:
            change = before[i] - trust[i, LEFT]
            local = abs_dot(G[i], err)
            expected = errors * local + EPS * sqrt(steps) * terms + kn.TINY
            judged = done & (local > 0.0)
            trust[i, SUM] += where(judged, abs(change), 0.0)
            trust[i, EXPECTED] += where(judged, expected, 0.0)
            suspect = suspect | (judged & (abs(change) > LARGE * expected))
        trust[i, LEFT] = where(done, defect[i], trust[i, LEFT])
    octets(s.suspect, c)[0] = where(suspect, 1.0, 0.0)


@_jitable
def let_leave(those, c, k, w, s, y, y_new):
    """Members of the octet at column c that cannot do step k here."""
    if any_lane(those):
        for lane in range(LANES):
            if lane_of(those, lane):
                put_aside(c + lane, k, w, s, y, y_new)


@_jitable
def put_aside(lane, k, w, s, y, y_new):
    out_of_line()
    left = s.left
    s.alive[0, lane] = 0.0
    left.step[lane] = k
    for i in range(y.shape[0]):
        left.y[i, lane] = y[i, lane]
        left.f[i, lane] = w.K[0, i, lane]
        left.err_sum[i, lane] = w.err_sum[i * y.shape[1] + lane]
        y_new[i, lane] = np.nan
    for i in range(s.start_counts.size):
        left.counters[i, lane] = s.start_counts[i]


@_jitable
def finish_batch(rhs, inv, grad, params, k, t_new, project, o, w, s, y, y_new, y_new_r):
    """The rest of step k: the projection of all members, and what the next step needs."""
    kn.copy(w.y_hat_r, y_new_r)
    if project:
        grad(t_new, w.y_hat, w.K[-1], w.G, params)
        w.counters[NJEV] += 1
        if o.every != 1 and o.metric == ERROR:
            kn.quadrature(w.err, w.err_sum, w.err)
        inv(t_new, w.y_hat, s.values, params)
        for c in range(0, y.shape[1], LANES):
            correct_octet(c, o, w, s, y, y_new)
        inv(t_new, y_new, s.values, params)
        for c in range(0, y.shape[1], LANES):
            judge_octet(c, k, o, w, s, y, y_new)
    else:
        for c in range(0, y.shape[1], LANES):
            alive = octets(s.alive, c)[0] > 0.0
            let_leave(alive & is_not(all_finite(octets(w.y_hat, c))), c, k, w, s, y, y_new)
    close_step(rhs, params, t_new, y_new, project, OK, o, w)


def make_advance_batch(stamp):
    """The loop over steps; `stamp` enters the key of its cache (see `numba_driver.source_stamp`)."""

    def advance_batch(rhs, inv, grad, params, span, k, k_end, m, o, w, s, y, y_r, y_new, y_new_r):
        """Steps k ... k_end - 1 while a member is alive; K[0] = f(t, y) on entry and at the end."""
        _ = stamp
        while k < k_end and largest(s.alive[0]) > 0.0:
            kn.copy(w.counters, s.start_counts)
            t = span.t0 + k * span.h
            last = k + 1 >= span.n_steps
            t_new = span.t_bound if last else span.t0 + (k + 1) * span.h
            h = t_new - t if last else span.h
            project = o.target.size > 0 and (last or (k + 1) % o.every == 0)
            advance_raw(rhs, params, t, y, y_r, h, m, o, w)
            look_back(rhs, params, t_new, y_r, h, project, m, o, w)
            finish_batch(rhs, inv, grad, params, k, t_new, project, o, w, s, y, y_new, y_new_r)
            kn.copy(w.K_r[-1], w.K_r[0])
            kn.copy(y_new_r, y_r)
            k += 1
        return OK

    return advance_batch
