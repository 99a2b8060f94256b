"""What a run holds, as the engine reads it: its method, options, buffers, clock and schedule."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .counters import N_COUNTERS
from .trust import N_FIGURES, N_SUSPECT, TERMS

# Codes of a step; those of the loop.
OK, NOT_FINITE, FAILED_PROJECTION, TOO_SMALL, POSTPONED, UNSTABLE = range(6)
PAUSE, FULL, ENDED, DOUBTFUL = 10, 11, 12, 13
# Interpolants of dense output.
CUBIC, QUINTIC, POLYNOMIAL, SEVENTH, HISTORY, NYSTROM = range(6)

EPS = 2.220446049250313e-16
# Dead band in roundings of an invariant's terms; where the state's own roundings are carried, the values' remain.
BAND, BAND_COMPENSATED, BAND_MULTISTEP = 4.0, 1.0, 1 / 64

NEW, OLD, MIDPOINT = range(3)
EUCLIDEAN, ERROR, GIVEN = range(3)
# every="auto".
AUTO = 0

# Places in the clock of a run: the current time, the time and length of the step tried last, the length to try next.
TIME, TIME_NEW, LENGTH, NEXT_LENGTH = range(4)
# Places in the place of a run.
STEP, ROW, PENDING = range(3)
# Places in that of a multistep method's history: whether there is one, the newest node and its row, nodes since the
# last projection, estimates collected.
HAVE_NODES, NEWEST, NEWEST_ROW, SINCE, SEEN, N_NODE_PLACES = range(6)


class Span(NamedTuple):
    """Where a run steps: t_k = t0 + k h (h = 0: adaptive steps), the last one on t_bound."""

    t0: float
    h: float
    t_bound: float
    sign: float
    n_steps: int
    max_step: float


class Schedule(NamedTuple):
    """Where a run steps and what it saves.

    `place` holds [step, row, pending]: pending is 1 between a step and its becoming the current state, so that whoever
    is called in between sees both of its ends. `clock` is that of the step. `g` and `rate` are the events' values and
    their rates of change at the start of a step, `g_new` and `rate_new` those at its end; a rate that is not known yet
    is NaN. An event looks in `g_direction`.
    """

    span: Span
    save_every: int
    t_eval: np.ndarray
    place: np.ndarray
    clock: np.ndarray
    g: np.ndarray
    g_new: np.ndarray
    rate: np.ndarray
    rate_new: np.ndarray
    g_direction: np.ndarray


def bare_schedule(span: Span, first: float) -> Schedule:
    """One that saves nothing; `first` is the length of the first step."""
    none = np.zeros(0)
    clock = np.array([span.t0, span.t0, 0.0, first])
    return Schedule(span, 0, none, np.zeros(3, np.int64), clock, none, none, none, none, none)


class Multistep(NamedTuple):
    """What a multistep method holds of a run (engine/cpp/multistep.hpp); weights go from the oldest node to the newest.

    `states_q` and `states_v` are rows of weights for the state so many nodes before the newest one. `correction` is
    the corrector less the predictor. `shape_q`, `shape_v`: differences that have the errors' shape; `size`: the highest
    one, which beside the accelerations must stay below `growth`. `brief`: too few steps for a history. `level`: states
    are those of the newest node, else `middle` nodes behind it. `substeps`: of the method that starts, in a step.
    `spacing`: nodes from one projection to the next. `corrected_first`, `corrected_count`: the floats of the
    accelerations that the Jacobian corrects.
    """

    predict_q: np.ndarray
    predict_v: np.ndarray
    states_q: np.ndarray
    states_v: np.ndarray
    correction: np.ndarray
    shape_q: np.ndarray
    shape_v: np.ndarray
    size: np.ndarray
    error_constant: float
    growth: float
    middle: int
    brief: bool
    level: bool
    uses_v: bool
    t0: float
    h: float
    substeps: int
    spacing: int
    corrected_first: int
    corrected_count: int
    nodes: np.ndarray
    sums: np.ndarray
    predicted: np.ndarray
    change: np.ndarray
    levels: np.ndarray
    place: np.ndarray


class Method(NamedTuple):
    """A tableau as arrays. `e` weighs the rows of K in the error estimate; `fsal` when it uses f at the new point.

    Names ending in _v are a Nystrom method's weights of the velocity. With `multistep` it makes that one's first
    states.
    """

    A: np.ndarray
    b: np.ndarray
    b_low: np.ndarray
    b_v: np.ndarray
    b_v_low: np.ndarray
    c: np.ndarray
    e: np.ndarray
    e_v: np.ndarray
    e_low: np.ndarray
    nystrom: bool
    fsal: bool
    paired: bool
    exponent: float
    multistep: Multistep | None = None


# That of an engine which only projects.
_none = np.zeros(0)
NO_METHOD = Method(
    A=np.zeros((0, 0)), b=_none, b_low=_none, b_v=_none, b_v_low=_none, c=_none, e=_none, e_v=_none, e_low=_none,
    nystrom=False, fsal=False, paired=False, exponent=0.0,
)  # fmt: skip


class Grouping(NamedTuple):
    """Blocks as lists of floats' indices: ``member[start[b]:start[b + 1]]``; width 2 for a complex state.

    `size` is that of consecutive blocks of one size, 0 for others.
    """

    member: np.ndarray
    start: np.ndarray
    width: int
    size: int


class FrameRows(NamedTuple):
    """Non-zeros of C and, after them, of M^T, M = S (C S)^-1: row k of the first is ``start[0, k]:start[0, k + 1]``.

    Where x, y and z of bodies have rows alike, `bodies` (2, groups, bodies) holds the weights of a state of (groups,
    bodies, 3) floats instead; else it is empty. `products` is scratch.
    """

    start: np.ndarray
    place: np.ndarray
    value: np.ndarray
    products: np.ndarray
    bodies: np.ndarray


class Inner(NamedTuple):
    """Scratch of the small Newton systems."""

    matrix: np.ndarray
    g: np.ndarray
    inverse_norms: np.ndarray
    R: np.ndarray
    pivots: np.ndarray
    mu: np.ndarray


def make_inner(size: int) -> Inner:
    """Scratch for systems of up to `size` invariants."""
    square = (size, size)
    return Inner(
        np.zeros(square), np.zeros(size), np.zeros(size), np.zeros(square), np.zeros(size, np.int64), np.zeros(size)
    )


class Work(NamedTuple):
    """Buffers of a run; names ending in _r are the float64 views of those before them."""

    K: np.ndarray
    K_r: np.ndarray
    stage: np.ndarray
    stage_r: np.ndarray
    y_hat: np.ndarray
    y_hat_r: np.ndarray
    f_point: np.ndarray
    G: np.ndarray
    G_r: np.ndarray
    err: np.ndarray
    err_low: np.ndarray
    err_sum: np.ndarray
    sigma: np.ndarray
    scale: np.ndarray
    ratio: np.ndarray
    memory: np.ndarray
    memory_new: np.ndarray
    move: np.ndarray
    carry: np.ndarray
    carry_hat: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    inverse_norms: np.ndarray
    pivots: np.ndarray
    mu: np.ndarray
    values: np.ndarray
    g: np.ndarray
    band: np.ndarray
    before: np.ndarray
    worth: np.ndarray
    defect: np.ndarray
    max_defect: np.ndarray
    max_correction: np.ndarray
    trust: np.ndarray
    suspect: np.ndarray
    norm: np.ndarray
    counters: np.ndarray
    inner: Inner


def make_work(n: int, dtype: np.dtype, stages: int, n_invariants: int, n_blocks: int) -> Work:
    """All buffers of a run of n components and n_invariants invariants."""

    def pair(*shape: int) -> tuple[np.ndarray, np.ndarray]:
        a = np.zeros(shape, dtype=dtype)
        return a, a.view(np.float64)

    width = 2 if np.dtype(dtype).kind == "c" else 1
    m = n * width
    K, K_r = pair(stages + 1, n)
    stage, stage_r = pair(n)
    y_hat, y_hat_r = pair(n)
    G, G_r = pair(n_invariants, n)
    floats = {name: np.zeros(m) for name in ("err", "err_low", "err_sum", "sigma", "move", "carry", "carry_hat")}
    names = "inverse_norms", "mu", "values", "g", "band", "before", "worth", "defect"
    small = {name: np.zeros(n_invariants) for name in names}
    floats["sigma"][:] = 1.0
    trust = np.zeros((n_invariants, N_FIGURES))
    trust[:, TERMS] = np.inf
    return Work(
        K=K,
        K_r=K_r,
        stage=stage,
        stage_r=stage_r,
        y_hat=y_hat,
        y_hat_r=y_hat_r,
        f_point=np.zeros(n, dtype),
        G=G,
        G_r=G_r,
        **floats,
        **small,
        scale=np.zeros(n_blocks),
        ratio=np.zeros(n_blocks),
        memory=np.zeros(n_blocks),
        memory_new=np.zeros(n_blocks),
        B=np.zeros((n_invariants, m)),
        Q=np.zeros((n_invariants, m)),
        R=np.zeros((n_invariants, n_invariants)),
        pivots=np.zeros(n_invariants, np.int64),
        max_defect=np.zeros(n_invariants),
        max_correction=np.zeros(1),
        trust=trust,
        suspect=np.zeros(N_SUSPECT + 2 * m),
        norm=np.zeros(1),
        counters=np.zeros(N_COUNTERS, np.int64),
        inner=make_inner(n_invariants),
    )


def copied_work(work: Work) -> Work:
    """Return buffers of their own with the same numbers, views of each other as those of `make_work` are."""
    n = work.stage.size
    new = make_work(n, work.stage.dtype, len(work.K) - 1, len(work.G), work.scale.size)
    for name, array in new._asdict().items():
        if isinstance(array, np.ndarray):
            array[...] = getattr(work, name)
    return new


class Members(NamedTuple):
    """Members of an ensemble as the engine runs them, on the buffers of one run; by member, what each brings and gets.

    They bring `starts` (m, n), `params` (m, p) and `first_steps` (m,), and share the number of `evaluations` before the
    first step, the weights `sigma` at the start and, of each event, how often it may happen before it ends a member,
    `left`. They get last states `y` (m, n) and times `t`, `status` (0 or 1), saved `rows` (m, rows, n), or if they are
    not `kept` scratch (1, rows, n), and what a run's `Work` has: `figures` are its `trust`, `suspects` its
    `suspect`. `where` holds the member at hand, and 1 where it has begun.
    """

    starts: np.ndarray
    params: np.ndarray
    first_steps: np.ndarray
    evaluations: int
    sigma: np.ndarray
    left: np.ndarray
    kept: bool
    rows: np.ndarray
    y: np.ndarray
    t: np.ndarray
    status: np.ndarray
    max_defect: np.ndarray
    counters: np.ndarray
    max_correction: np.ndarray
    figures: np.ndarray
    suspects: np.ndarray
    where: np.ndarray


class Dense(NamedTuple):
    """What dense output is made with, and what the loop samples by it.

    `weights` are rows over the stages, of a tableau's own polynomial or of that of DOP853 or a Nystrom method, which
    have further stages, A and c. `own_slopes`: the steps leave no f at their ends. `by_travel`: corrections are weighed
    by what each block travels within the step, else by the run's weights. `shows`: states that a step leaves
    unprojected are handed out as projected copies. `missed`: how many states were left unprojected, and the time of the
    first. `waiting`: whether the states at both ends of the step at hand are not projected. `event`, `t`, `y`: roots of
    events that the loop has found, ``counts[0]`` of them; ``counts[1]`` interpolants are kept. `left`: how often each
    event may still happen before it ends the run. `pending_event`, `pending_t`: the ``counts[2]`` roots of a step for
    whose states there is no room.
    """

    kind: int
    weights: np.ndarray
    A: np.ndarray
    c: np.ndarray
    own_slopes: bool
    by_travel: bool
    shows: bool
    options: Any
    work: Work
    missed: np.ndarray
    waiting: np.ndarray
    piece: np.ndarray
    event: np.ndarray
    t: np.ndarray
    y: np.ndarray
    counts: np.ndarray
    left: np.ndarray
    pending_event: np.ndarray
    pending_t: np.ndarray
