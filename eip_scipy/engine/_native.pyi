"""Engine of eip_scipy in C++. Written by .ci/stub."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy
import numpy.typing

def work_alone(alone: bool) -> bool:
    """
    If `alone` is True, keep the calling thread from sharing sums over many bodies with other threads; if False, let it share them. Return the previous setting.
    """

def call(arg0: Callable, /, *args: Any) -> object:
    """Return ``fun(*args)``, with subnormal numbers."""

def end_threads() -> None:
    """
    End the threads that share sums over many bodies. They are not started again.
    """
OK: int = 0
NOT_FINITE: int = 1
FAILED_PROJECTION: int = 2
TOO_SMALL: int = 3
POSTPONED: int = 4
UNSTABLE: int = 5
NEAR_SINGULAR: int = 6
BY_VELOCITY: int = 7
PAUSE: int = 10
FULL: int = 11
ENDED: int = 12
DOUBTFUL: int = 13
NEW: int = 0
OLD: int = 1
MIDPOINT: int = 2
EUCLIDEAN: int = 0
BY_ERROR: int = 1
GIVEN: int = 2
NFEV: int = 0
NJEV: int = 1
NLU: int = 2
PROJECTIONS: int = 3
SKIPPED: int = 4
RANK_REDUCED: int = 5
REJECTED: int = 6
LAST_RANK: int = 7
HAVE_F: int = 8
HAVE_ERROR: int = 9
BEGUN: int = 10
WAITED: int = 11
FOUND: int = 12
F_AT_RAW: int = 13
INDEPENDENT: int = 14
TRIED_INDEPENDENT: int = 15
STUCK: int = 16
FROM_F: int = 17
N_COUNTERS: int = 18
TIME: int = 0
TIME_NEW: int = 1
LENGTH: int = 2
NEXT_LENGTH: int = 3
STEP: int = 0
ROW: int = 1
PENDING: int = 2
HAVE_NODES: int = 0
NEWEST: int = 1
NEWEST_ROW: int = 2
SINCE: int = 3
SEEN: int = 4
N_NODE_PLACES: int = 5
CUBIC: int = 0
QUINTIC: int = 1
POLYNOMIAL: int = 2
SEVENTH: int = 3
HISTORY: int = 4
NYSTROM: int = 5
START: int = 0
TERMS: int = 1
NOTED: int = 2
LEFT: int = 3
SHARE: int = 4
SHARE_AT: int = 5
RAW: int = 6
RAW_AT: int = 7
RAW_MANY: int = 8
NU: int = 9
AT: int = 10
MANY: int = 11
FIRST: int = 12
SUM: int = 13
EXPECTED: int = 14
JUDGED: int = 15
RATE: int = 16
RATE_TERMS: int = 17
RATE_NOTED: int = 18
ROUGH_NOTED: int = 19
FAR_FROM: int = 20
BY_VALUES: int = 21
EXAMINED: int = 22
N_FIGURES: int = 23
REASON: int = 0
SUSPECT_FROM: int = 1
SUSPECT_TO: int = 2
SUSPECT_WAITED: int = 3
N_SUSPECT: int = 4
NOTHING: int = 0
LARGE_CORRECTION: int = 1
LARGE_ERROR: int = 2
CHANGES_ALONG_FLOW: int = 3
ALL_RATES: int = 0
ALL_TERMS: int = 1
LATE_RATES: int = 2
LATE_TERMS: int = 3
SAMPLES: int = 4
N_SLOW: int = 5
AUTO: int = 0
MOST_ARGUMENTS: int = 8
MOST_CROSSINGS: int = 3
EPS: float = 2.220446049250313e-16
LATE_SHARE: float = 0.125
LARGE: float = 50.0
DISTANT: float = 0.03
LARGE_SHARE: float = 0.01
LEAST_CHANGE: float = 0.01
SOURCES: str = ...
COMPILER: str
HAS_V3: bool

def new_work(n: int, dtype: Any, stages: int, n_invariants: int, n_blocks: int, n_balances: int = 0) -> Work:
    """Return the buffers of a run."""

class Engine:
    """
    Engine of one run, which makes its steps on its arrays. ``functions.native`` is True if `functions` holds addresses.
    """

    def __init__(self, method: Any, options: Options, work: Work, functions: Any, schedule: Schedule | None = None, hooks: Any = None) -> None: ...

    def advance(self, k_end: int, y: object, y_new: object, t_saved: object, y_saved: object, pieces: object | None) -> int:
        """
        Make steps up to step `k_end`, or until something else stops the loop, and return the reason as a code. With dense output, `pieces` (rows, floats) is filled with the interpolants of all steps if it has rows.
        """

    def side_by_side(self, functions: object) -> None:
        """
        Let `sweep` run members in batches of eight from now on, with these functions for eight members.
        """

    def sweep(self, members: object, steps: int, y: object, y_new: object) -> int:
        """
        Run members of an ensemble for `steps` steps in all, or slightly more. Return OK, or a code for what happened to the current member. A member of a batch whose status is not set must be run alone.
        """

    def step(self, k: int, t: float, y: object, f: object) -> tuple[int, float, numpy.ndarray, numpy.ndarray]:
        """
        Make step `k` from the state `y` at time `t`, where the derivative is `f`. Return (status, t_new, y_new, f_new).
        """

    def project(self, t_old: float, y: object, t: float, last: bool, y_new: object) -> int:
        """
        Project the state work.y_hat onto the invariants, write the result to `y_new`, and return the code.
        """

    def values(self, t: object, y: object, out: object, params: object | None = None) -> None:
        """
        Fill `out` (m, l) with the invariants at the times `t` (m,) and states `y` (m, n), each with its own row of parameters if `params` (m, p) is given.
        """

    def start(self, y: object, f: object, tau: float) -> None:
        """
        Set the sizes of the invariants' terms at the start, where work.values and work.G are known.
        """

    def sample(self, dense: object) -> None:
        """Make dense output from now on, as the record `dense` says."""

    def describe(self, t_old: float, y_old: object, t: float, y: object, piece: object) -> None:
        """
        Fill `piece` with the interpolant over the last step, from (t_old, y_old) to (t, y).
        """

    def interpolate(self, piece: object, t: object, out: object) -> None:
        """
        Fill `out` (m, n) with the states at the times `t` (m,), computed with the interpolant `piece`.
        """

    def show(self, t: float, y: object, out: object) -> None:
        """
        Fill `out` (n,) with the state `y` at `t` in the form in which the run saves its last state.
        """

class LibraryFunction:
    __name__: str
    """A function in C++ of one of the package's problems."""

    def __call__(self, /, *args: Any) -> Any:
        """Call self as a function."""

    @property
    def takes_f(self) -> bool:
        """True if the function takes the derivative f of the state."""

    @property
    def in_place(self) -> bool:
        """
        True if the function fills an argument `out`; False if it returns its value.
        """

    @property
    def handle(self) -> int:
        """First argument of the function at `call_address`."""

    @property
    def call_address(self) -> int:
        """Address of `call_by_handle`, whose signature is in library.cpp."""

    @property
    def numbers(self) -> int:
        """
        Number of numbers, or of rows of the state's size, that are filled; if negative, that for each orbit.
        """

    @property
    def returns_numbers(self) -> bool:
        """
        True if the function returns as many numbers for states of any size, and does not take f.
        """

    @property
    def lanes8_address(self) -> int:
        """Address of the version for eight states at once; 0 if there is none."""

    def bound(self, params: object) -> LibraryFunction:
        """
        Return the function with fixed parameters, which it uses instead of those of a run.
        """

    @property
    def own(self) -> list[float]:
        """
        Fixed parameters of the function; empty if it uses the parameters of a run.
        """

    def __repr__(self) -> str: ...

    def __reduce__(self) -> tuple[Any, ...]: ...
LIBRARY: dict[Any, Any] = ...

def are_finite(numbers: object) -> bool:
    """Return True if no number is NaN or infinite."""

class RightHandSide:
    """
    The right-hand side of a run, from a `Call` of the function, which returns the accelerations if the equations are of `second_order`.
    """

    def __init__(self, call: object, n: int, is_complex: bool, second_order: bool) -> None: ...

    def __call__(self, t: object, y: object) -> numpy.ndarray:
        """Return the derivative (n,) at (t, y), a new array."""

    def derivatives(self, times: object, y: object) -> numpy.ndarray:
        """
        Return the derivatives (m, n) at times (m,) and states (m, n); NaN where the function raises an exception.
        """

class InvariantFunctions:
    """The invariants of a run and their gradients, each as a `Call`."""

    def __init__(self, values: tuple[Any, ...], gradients: tuple[Any, ...], n: int, is_complex: bool) -> None: ...

    def values(self, t: float, y: object) -> numpy.ndarray:
        """Return all values (l,)."""

    def gradients(self, t: float, y: object, f: object) -> numpy.ndarray:
        """Return all gradients (l, n)."""

    def is_in_order(self, t: float, y: object, f: object, G: object, here: object, tau: float, interval: tuple[float, float], directions: object) -> bool:
        """
        Return True if the checks of precision, gradients `G` and invariance find nothing.
        """

    def look(self, figures: object, t: float, y: object, f: object, target: object, scales: object, tau: float, interval: tuple[float, float], directions: object) -> bool:
        """
        Call `note_rates` and return `is_in_order`, for a state of a run without balances.
        """

    def rates_by_values(self, t: float, y: object, f: object, G: object, here: object, target: object, scales: object) -> numpy.ndarray:
        """
        Return the rates of change (l,) of the invariants along `f`, by short differences.
        """

    def note_rates(self, figures: object, t: float, y: object, f: object, G: object, here: object, target: object, scales: object, own: object | None = None) -> None:
        """Update the largest rates of change along `f` in `figures`."""
CHECK_STEP: float = 6e-06
CHECK_TOLERANCE: float = 0.0001
CHECK_NOISE: float = 6.0
INVARIANCE_TOLERANCE: float = 1e-08
TIME_SHARE: float = 0.01
TIME_ROOM: float = 5.0

def time_of_motion(y: object, f: object) -> float:
    """
    Return the time in which a state changes by its own size; infinite if it or its derivative `f` is 0.
    """

def typical_sizes(y: object, f: object, tau: float) -> numpy.ndarray:
    """
    Return for each component a size that is added to |y_k|, so that shifts do not vanish with the component: ``abs(tau * f[k])``, the motion in a step of length `tau`, and at least 1e-3 |y_k|. If both are 0, it is the largest size of the other components, or 1 if all are 0.
    """

def is_canonical(y: object, f: object) -> bool:
    """
    Return True if a state y with the derivative f is taken as (q, p): it is real and has an even number n of components, ``f[: n // 2]`` and ``p = y[n // 2 :]`` are both zero or both nonzero, and the sum of ``f[: n // 2] * sign(p)`` is not negative.
    """

def states_near(y: object, sizes: object, ways: object) -> numpy.ndarray:
    """
    Return the states ``y + ways * sizes``, (m, n). Components that are 0 at y become positive.
    """

def are_independent(F: object) -> bool:
    """
    Return True if the columns of F (m, n), with rows and then columns in units of their largest entries, are clearly independent; False too if there are more than 24 columns, or a number is not finite.
    """

def raise_residuals(largest: object, values: object, target: object) -> None:
    """
    Raise `largest` (l,) to the distances of the values (m, l) from the target (l,); NaN does not count.
    """

class FailedCallError(Exception): ...

class Span(NamedTuple):
    t0: float
    h: float
    t_bound: float
    sign: float
    n_steps: int
    max_step: float

class Schedule(NamedTuple):
    span: Span
    save_every: int
    t_eval: numpy.typing.NDArray[numpy.float64]
    place: numpy.typing.NDArray[numpy.int64]
    clock: numpy.typing.NDArray[numpy.float64]
    g: numpy.typing.NDArray[numpy.float64]
    g_new: numpy.typing.NDArray[numpy.float64]
    rate: numpy.typing.NDArray[numpy.float64]
    rate_new: numpy.typing.NDArray[numpy.float64]
    g_direction: numpy.typing.NDArray[numpy.float64]

class Multistep(NamedTuple):
    predict_q: numpy.typing.NDArray[numpy.float64]
    predict_v: numpy.typing.NDArray[numpy.float64]
    states_q: numpy.typing.NDArray[numpy.float64]
    states_v: numpy.typing.NDArray[numpy.float64]
    correction: numpy.typing.NDArray[numpy.float64]
    shape_q: numpy.typing.NDArray[numpy.float64]
    shape_v: numpy.typing.NDArray[numpy.float64]
    size: numpy.typing.NDArray[numpy.float64]
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
    nodes: numpy.typing.NDArray[numpy.float64]
    sums: numpy.typing.NDArray[numpy.float64]
    predicted: numpy.typing.NDArray[numpy.float64]
    change: numpy.typing.NDArray[numpy.float64]
    levels: numpy.typing.NDArray[numpy.float64]
    rates: numpy.typing.NDArray[numpy.float64]
    rate_sums: numpy.typing.NDArray[numpy.float64]
    place: numpy.typing.NDArray[numpy.int64]

class Method(NamedTuple):
    b: numpy.typing.NDArray[numpy.float64]
    c: numpy.typing.NDArray[numpy.float64]
    exponent: float
    A: numpy.typing.NDArray[numpy.float64]
    b_low: numpy.typing.NDArray[numpy.float64]
    b_v: numpy.typing.NDArray[numpy.float64]
    b_v_low: numpy.typing.NDArray[numpy.float64]
    e: numpy.typing.NDArray[numpy.float64]
    e_v: numpy.typing.NDArray[numpy.float64]
    e_low: numpy.typing.NDArray[numpy.float64]
    nystrom: bool
    fsal: bool
    paired: bool
    sees_velocity: bool
    multistep: Multistep | None = ...

class Grouping(NamedTuple):
    member: numpy.typing.NDArray[numpy.uint64]
    start: numpy.typing.NDArray[numpy.uint64]
    width: int
    size: int

class FrameRows(NamedTuple):
    start: numpy.typing.NDArray[numpy.uint64]
    place: numpy.typing.NDArray[numpy.uint64]
    value: numpy.typing.NDArray[numpy.float64]
    products: numpy.typing.NDArray[numpy.float64]
    bodies: numpy.typing.NDArray[numpy.float64]

class Balances(NamedTuple):
    place: numpy.typing.NDArray[numpy.int64]
    rated: numpy.typing.NDArray[numpy.int64]

class Groups(NamedTuple):
    value: numpy.typing.NDArray[numpy.int64]
    first_value: numpy.typing.NDArray[numpy.int64]
    first_direction: numpy.typing.NDArray[numpy.int64]
    first_float: numpy.typing.NDArray[numpy.int64]
    place: numpy.typing.NDArray[numpy.int64]
    weight: numpy.typing.NDArray[numpy.float64]
    size: int

class Columns(NamedTuple):
    kept: numpy.typing.NDArray[numpy.float64]
    size: int
    seen: int
    half: int
    symplectic: bool

class Options(NamedTuple):
    rtol: numpy.typing.NDArray[numpy.float64]
    atol: numpy.typing.NDArray[numpy.float64]
    block_atol: numpy.typing.NDArray[numpy.float64]
    blocks: Grouping
    frame: FrameRows
    balances: Balances
    balance_groups: Groups
    columns: Columns
    target: numpy.typing.NDArray[numpy.float64]
    scales: numpy.typing.NDArray[numpy.float64]
    computed: numpy.typing.NDArray[numpy.float64]
    most_left: numpy.typing.NDArray[numpy.float64]
    kinds: Grouping
    masses: numpy.typing.NDArray[numpy.float64]
    kappa: float
    metric: int
    direction: int
    iterations: int
    every: int
    reuse_f: bool
    uses_f: bool
    compensated: bool
    adaptive: bool
    per_band: float
    watched: bool
    limit: float
    distant: float
    joint: Any = ...

class Members(NamedTuple):
    starts: numpy.typing.NDArray[Any]
    params: numpy.typing.NDArray[numpy.float64]
    first_steps: numpy.typing.NDArray[numpy.float64]
    events: numpy.typing.NDArray[numpy.float64]
    evaluations: int
    sigma: numpy.typing.NDArray[numpy.float64]
    left: numpy.typing.NDArray[numpy.float64]
    t_saved: numpy.typing.NDArray[numpy.float64]
    kept: bool
    rows: numpy.typing.NDArray[Any]
    y: numpy.typing.NDArray[Any]
    t: numpy.typing.NDArray[numpy.float64]
    status: numpy.typing.NDArray[numpy.int64]
    max_residual: numpy.typing.NDArray[numpy.float64]
    counters: numpy.typing.NDArray[numpy.int64]
    max_correction: numpy.typing.NDArray[numpy.float64]
    figures: numpy.typing.NDArray[numpy.float64]
    suspects: numpy.typing.NDArray[numpy.float64]
    where: numpy.typing.NDArray[numpy.int64]

class Dense(NamedTuple):
    kind: int
    weights: numpy.typing.NDArray[numpy.float64]
    c: numpy.typing.NDArray[numpy.float64]
    A: numpy.typing.NDArray[numpy.float64]
    own_slopes: bool
    by_travel: bool
    shows: bool
    options: Options
    work: Work
    missed: numpy.typing.NDArray[numpy.float64]
    waiting: numpy.typing.NDArray[numpy.int64]
    piece: numpy.typing.NDArray[numpy.float64]
    event: numpy.typing.NDArray[numpy.int64]
    t: numpy.typing.NDArray[numpy.float64]
    y: numpy.typing.NDArray[Any]
    counts: numpy.typing.NDArray[numpy.int64]
    left: numpy.typing.NDArray[numpy.float64]
    pending_event: numpy.typing.NDArray[numpy.int64]
    pending_t: numpy.typing.NDArray[numpy.float64]

class Work(NamedTuple):
    K: numpy.typing.NDArray[Any]
    stage: numpy.typing.NDArray[Any]
    y_hat: numpy.typing.NDArray[Any]
    f_point: numpy.typing.NDArray[Any]
    G: numpy.typing.NDArray[Any]
    err: numpy.typing.NDArray[numpy.float64]
    err_low: numpy.typing.NDArray[numpy.float64]
    err_sum: numpy.typing.NDArray[numpy.float64]
    sigma: numpy.typing.NDArray[numpy.float64]
    move: numpy.typing.NDArray[numpy.float64]
    shift: numpy.typing.NDArray[numpy.float64]
    unit: numpy.typing.NDArray[numpy.float64]
    carry: numpy.typing.NDArray[numpy.float64]
    carry_hat: numpy.typing.NDArray[numpy.float64]
    scale: numpy.typing.NDArray[numpy.float64]
    inverse: numpy.typing.NDArray[numpy.float64]
    ratio: numpy.typing.NDArray[numpy.float64]
    remembered: numpy.typing.NDArray[numpy.float64]
    memory: numpy.typing.NDArray[numpy.float64]
    memory_new: numpy.typing.NDArray[numpy.float64]
    B: numpy.typing.NDArray[numpy.float64]
    Q: numpy.typing.NDArray[numpy.float64]
    R: numpy.typing.NDArray[numpy.float64]
    inverse_norms: numpy.typing.NDArray[numpy.float64]
    mu: numpy.typing.NDArray[numpy.float64]
    values: numpy.typing.NDArray[numpy.float64]
    g: numpy.typing.NDArray[numpy.float64]
    band: numpy.typing.NDArray[numpy.float64]
    before: numpy.typing.NDArray[numpy.float64]
    worth: numpy.typing.NDArray[numpy.float64]
    residual: numpy.typing.NDArray[numpy.float64]
    max_residual: numpy.typing.NDArray[numpy.float64]
    max_correction: numpy.typing.NDArray[numpy.float64]
    norm: numpy.typing.NDArray[numpy.float64]
    trust: numpy.typing.NDArray[numpy.float64]
    flow: numpy.typing.NDArray[numpy.float64]
    rates: numpy.typing.NDArray[numpy.float64]
    level: numpy.typing.NDArray[numpy.float64]
    level_old: numpy.typing.NDArray[numpy.float64]
    level_carry: numpy.typing.NDArray[numpy.float64]
    level_carry_new: numpy.typing.NDArray[numpy.float64]
    slow: numpy.typing.NDArray[numpy.float64]
    suspect: numpy.typing.NDArray[numpy.float64]
    pivots: numpy.typing.NDArray[numpy.int64]
    counters: numpy.typing.NDArray[numpy.int64]
    inner_matrix: numpy.typing.NDArray[numpy.float64]
    inner_R: numpy.typing.NDArray[numpy.float64]
    inner_g: numpy.typing.NDArray[numpy.float64]
    inner_inverse_norms: numpy.typing.NDArray[numpy.float64]
    inner_mu: numpy.typing.NDArray[numpy.float64]
    inner_pivots: numpy.typing.NDArray[numpy.int64]

class condensates:
    @staticmethod
    def multiply(field: numpy.typing.NDArray[numpy.complex128], factor: numpy.typing.NDArray[numpy.float64]) -> None: ...
    @staticmethod
    def derivative(rest: numpy.typing.NDArray[numpy.complex128], psi: numpy.typing.NDArray[numpy.complex128], V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.complex128]) -> None: ...
    @staticmethod
    def derivative_at_once(psi: numpy.typing.NDArray[numpy.complex128], V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.complex128]) -> None: ...
    @staticmethod
    def turn(f: numpy.typing.NDArray[numpy.complex128], factor: float, out: numpy.typing.NDArray[numpy.complex128]) -> None: ...
    @staticmethod
    def moments(psi: numpy.typing.NDArray[numpy.complex128], f: numpy.typing.NDArray[numpy.complex128]) -> list[float]: ...
    @staticmethod
    def total_mass(psi: numpy.typing.NDArray[numpy.complex128]) -> float: ...
    @staticmethod
    def expansion(psi: numpy.typing.NDArray[numpy.complex128], near: numpy.typing.NDArray[numpy.complex128], f: numpy.typing.NDArray[numpy.complex128]) -> list[float]: ...
    @staticmethod
    def shifted(psi: numpy.typing.NDArray[numpy.complex128], f: numpy.typing.NDArray[numpy.complex128], a: float, b: float, out: numpy.typing.NDArray[numpy.complex128]) -> list[float]: ...
    @staticmethod
    def weighted_square(field: numpy.typing.NDArray[numpy.complex128], weight: numpy.typing.NDArray[numpy.float64]) -> float: ...

class gradients:
    @staticmethod
    def complex_step(fun: object, t: object, y: object, args: tuple[Any, ...], step: float) -> numpy.ndarray:
        """
        Return the derivatives (..., n) of ``fun(t, y, *args)`` by `y` (n,), by complex steps of this length.
        """
    @staticmethod
    def checked_complex_step(fun: object, t: object, y: object, args: tuple[Any, ...], step: float, direction: object, floors: object) -> numpy.ndarray | None:
        """
        Return `complex_step`, or None if differences along ``direction * (abs(y) + floors)`` disagree with it.
        """

class multibody:
    @staticmethod
    def solve_address() -> int:
        """Return the address of `solve` in multibody.cpp, for compiled code."""
    MASS_IS_SINGULAR: int = -1
    NOT_FINITE: int = -2
