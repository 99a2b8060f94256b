"""The step in C++. Written by .ci/stub."""

from typing import Any, NamedTuple

import numpy
import numpy.typing

OK: int = 0
NOT_FINITE: int = 1
FAILED_PROJECTION: int = 2
TOO_SMALL: int = 3
POSTPONED: int = 4
UNSTABLE: int = 5
NEAR_SINGULAR: int = 6
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
SOFTENED: int = 9
HAVE_ERROR: int = 10
BEGUN: int = 11
WAITED: int = 12
FOUND: int = 13
F_AT_RAW: int = 14
INDEPENDENT: int = 15
TRIED_INDEPENDENT: int = 16
N_COUNTERS: int = 17
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

def spanned(frame: object, G: numpy.typing.NDArray[numpy.float64], share: float) -> list:
    """
    Return for each row of G whether the frame removes all but this share of it.
    """

class Work:
    """
    Buffers of a run, in memory of the engine; each attribute is an array over one.
    """

    def __init__(self, n: int, dtype: object, stages: int, n_invariants: int, n_blocks: int, n_balances: int = 0) -> None: ...

    def arrays(self) -> dict[str, numpy.typing.NDArray[Any]]:
        """Return all arrays by name."""

    def share(self, other: Work, names: set[Any]) -> None:
        """Use the buffers of these names of others from now on."""

    def __getstate__(self) -> tuple[Any, ...]: ...

    def __setstate__(self, arg: tuple[Any, ...], /) -> None: ...

    @property
    def K(self, /) -> numpy.ndarray: ...

    @property
    def stage(self, /) -> numpy.ndarray: ...

    @property
    def y_hat(self, /) -> numpy.ndarray: ...

    @property
    def f_point(self, /) -> numpy.ndarray: ...

    @property
    def G(self, /) -> numpy.ndarray: ...

    @property
    def err(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def err_low(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def err_sum(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def sigma(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def move(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def carry(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def carry_hat(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def scale(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def ratio(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def memory(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def memory_new(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def B(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def Q(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def R(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def inverse_norms(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def mu(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def values(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def g(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def band(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def before(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def worth(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def defect(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def max_defect(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def max_correction(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def norm(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def trust(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def flow(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def rates(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def level(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def level_old(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def level_carry(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def level_carry_new(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def slow(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def suspect(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def pivots(self, /) -> numpy.typing.NDArray[numpy.int64]: ...

    @property
    def counters(self, /) -> numpy.typing.NDArray[numpy.int64]: ...

    @property
    def inner_matrix(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def inner_R(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def inner_g(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def inner_inverse_norms(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def inner_mu(self, /) -> numpy.typing.NDArray[numpy.float64]: ...

    @property
    def inner_pivots(self, /) -> numpy.typing.NDArray[numpy.int64]: ...

class Engine:
    """
    The step of one run, on its arrays. `functions` says in `native` whether it holds addresses.
    """

    def __init__(self, method: Any, options: Options, work: Work, functions: Any, schedule: Schedule | None = None, hooks: Any = None) -> None: ...

    def advance(self, k_end: int, y: numpy.typing.NDArray[numpy.inexact], y_new: numpy.typing.NDArray[numpy.inexact], t_saved: numpy.typing.NDArray[numpy.float64], y_saved: numpy.typing.NDArray[numpy.inexact], pieces: numpy.typing.NDArray[numpy.float64] | None) -> int:
        """
        Step on to step k_end, or to what stops the loop. pieces (rows, floats) receives the interpolants of all steps if it has rows.
        """

    def sweep(self, members: object, steps: int, y: numpy.typing.NDArray[numpy.inexact], y_new: numpy.typing.NDArray[numpy.inexact], t_saved: numpy.typing.NDArray[numpy.float64]) -> int:
        """
        Run members of an ensemble one after the other, so many steps in all; the `where` of the record `members` says how far they are.
        """

    def side_by_side(self, functions: object) -> None:
        """
        Functions of eight members, by which `sweep_octets` runs them from now on; `functions` holds addresses, as those of the run.
        """

    def sweep_octets(self, members: object, steps: int, y: numpy.typing.NDArray[numpy.inexact], y_new: numpy.typing.NDArray[numpy.inexact], t_saved: numpy.typing.NDArray[numpy.float64]) -> int:
        """
        Do what `sweep` does with eight members side by side, by steps of all eight. Whose status is not set has to run by itself.
        """

    def step(self, k: int, t: float, y: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact]) -> tuple[int, float, numpy.ndarray, numpy.ndarray]:
        """
        Step k from the state y at t with the derivative f. Returns (status, t_new, y_new, f_new).
        """

    def project(self, t_old: float, y: numpy.typing.NDArray[numpy.inexact], t: float, last: bool, y_new: numpy.typing.NDArray[numpy.inexact]) -> int:
        """Project work.y_hat into y_new."""

    def values(self, t: numpy.typing.NDArray[numpy.float64], y: numpy.typing.NDArray[numpy.inexact], out: numpy.typing.NDArray[numpy.float64], params: numpy.typing.NDArray[numpy.float64] | None = None) -> None:
        """
        Fill out (m, l) with the invariants at states y (m, n), each with its own params (m, p) where they are given.
        """

    def start(self, y: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact], tau: float) -> None:
        """Set the invariants' terms at the start, from work.values and work.G."""

    def sample(self, dense: object) -> None:
        """Make dense output from now on by this record."""

    def describe(self, t_old: float, y_old: numpy.typing.NDArray[numpy.inexact], t: float, y: numpy.typing.NDArray[numpy.inexact], piece: numpy.typing.NDArray[numpy.float64]) -> None:
        """Fill piece with the interpolant over the step made last."""

    def interpolate(self, piece: numpy.typing.NDArray[numpy.float64], t: numpy.typing.NDArray[numpy.float64], out: numpy.typing.NDArray[numpy.inexact]) -> None:
        """Fill out (m, n) with the states at times t (m,) by an interpolant."""

    def show(self, t: float, y: numpy.typing.NDArray[numpy.inexact], out: numpy.typing.NDArray[numpy.inexact]) -> None:
        """Fill out (n,) with the last state, y at t, as the run hands it out."""

class LibraryFunction:
    __name__: str
    """A function of one of the library's problems."""

    def __call__(self, /, *args: Any) -> Any:
        """Call self as a function."""

    @property
    def takes_f(self) -> bool:
        """Whether it takes the derivative of the state."""

    @property
    def in_place(self) -> bool:
        """Whether it fills an array."""

    @property
    def handle(self) -> int:
        """The first argument of the function at `call_address`."""

    @property
    def call_address(self) -> int:
        """Address of `call_by_handle`, whose signature is in library.cpp."""

    @property
    def fits_address(self) -> int:
        """Of ``bool fits(int64_t n, int64_t p)``."""

    @property
    def numbers(self) -> int:
        """How many numbers, or states, it fills."""

    @property
    def fills_states(self) -> bool:
        """Whether these are of the state's size."""

    @property
    def octet_address(self) -> int:
        """For eight states side by side, 0 where there is none."""

    def bound(self, params: object) -> LibraryFunction:
        """
        Return the function with parameters of its own, which replace those of a run.
        """

    @property
    def own(self) -> list[float]:
        """Its own parameters; empty if it takes those of the run."""

    def __repr__(self) -> str: ...

    def __reduce__(self) -> tuple[Any, ...]: ...
LIBRARY: dict[Any, Any] = ...

def are_finite(numbers: numpy.typing.NDArray[numpy.float64]) -> bool:
    """Return True if no number is NaN or infinite."""

def are_calm(figures: numpy.typing.NDArray[numpy.float64], beyond_doubt: float, together: float) -> bool:
    """
    Return True if no figure, (..., N_FIGURES), may be that of a faulty run.
    """

class InvariantFunctions:
    """The invariants of a run and their gradients, each as a `Call`."""

    def __init__(self, values: tuple[Any, ...], gradients: tuple[Any, ...], n: int, is_complex: bool) -> None: ...

    def values(self, t: float, y: numpy.typing.NDArray[numpy.inexact]) -> numpy.ndarray:
        """Return all values (l,)."""

    def gradients(self, t: float, y: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact]) -> numpy.ndarray:
        """Return all gradients (l, n)."""

    def is_in_order(self, t: float, y: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact], G: numpy.typing.NDArray[numpy.inexact], here: numpy.typing.NDArray[numpy.float64], tau: float, interval: tuple[float, float], directions: numpy.typing.NDArray[numpy.inexact]) -> bool:
        """
        Whether precision, gradients and invariance are beyond doubt at a state with these gradients and values.
        """

    def rates_by_values(self, t: float, y: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact], G: numpy.typing.NDArray[numpy.inexact], here: numpy.typing.NDArray[numpy.float64], target: numpy.typing.NDArray[numpy.float64], scales: numpy.typing.NDArray[numpy.float64]) -> numpy.ndarray:
        """
        Return rates of change along f by short differences to both sides, (l,); NaN where these differ at a kink. Rates that are within the rounding of the values are 0.
        """

    def note_rates(self, figures: numpy.typing.NDArray[numpy.float64], t: float, y: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact], G: numpy.typing.NDArray[numpy.inexact], here: numpy.typing.NDArray[numpy.float64], target: numpy.typing.NDArray[numpy.float64], scales: numpy.typing.NDArray[numpy.float64], own: numpy.typing.NDArray[numpy.float64] | None = None) -> None:
        """
        Raise the largest rates of change along f, by gradients and by values, in the figures (l, N_FIGURES): without the rates `own`, in units of their terms.
        """
CHECK_STEP: float = 6e-06
CHECK_TOLERANCE: float = 0.0001
CHECK_NOISE: float = 6.0
INVARIANCE_TOLERANCE: float = 1e-08
TIME_SHARE: float = 0.01
TIME_ROOM: float = 5.0

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
    groups: Grouping
    frame: FrameRows
    balances: Balances
    balance_groups: Groups
    columns: Columns
    target: numpy.typing.NDArray[numpy.float64]
    scales: numpy.typing.NDArray[numpy.float64]
    computed: numpy.typing.NDArray[numpy.float64]
    most_left: numpy.typing.NDArray[numpy.float64]
    kinds: Grouping
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
    watched: bool = ...
    limit: float = ...
    distant: float = ...
    joint: Any = ...

class Members(NamedTuple):
    starts: numpy.typing.NDArray[numpy.inexact]
    params: numpy.typing.NDArray[numpy.float64]
    first_steps: numpy.typing.NDArray[numpy.float64]
    evaluations: int
    sigma: numpy.typing.NDArray[numpy.float64]
    left: numpy.typing.NDArray[numpy.float64]
    kept: bool
    rows: numpy.typing.NDArray[numpy.inexact]
    y: numpy.typing.NDArray[numpy.inexact]
    t: numpy.typing.NDArray[numpy.float64]
    status: numpy.typing.NDArray[numpy.int64]
    max_defect: numpy.typing.NDArray[numpy.float64]
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
    y: numpy.typing.NDArray[numpy.inexact]
    counts: numpy.typing.NDArray[numpy.int64]
    left: numpy.typing.NDArray[numpy.float64]
    pending_event: numpy.typing.NDArray[numpy.int64]
    pending_t: numpy.typing.NDArray[numpy.float64]

class condensates:
    @staticmethod
    def multiply(field: numpy.typing.NDArray[numpy.inexact], factor: numpy.typing.NDArray[numpy.float64]) -> None: ...
    @staticmethod
    def derivative(rest: numpy.typing.NDArray[numpy.inexact], psi: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def derivative_at_once(psi: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def add_potential(psi: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def local_flow(psi: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float, h: float) -> None: ...
    @staticmethod
    def turn(f: numpy.typing.NDArray[numpy.inexact], factor: float, out: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def divide_by_root(a: numpy.typing.NDArray[numpy.inexact], psi: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float, shift: float, out: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def rotate(a: numpy.typing.NDArray[numpy.inexact], b: numpy.typing.NDArray[numpy.inexact], c: float, s: float) -> None: ...
    @staticmethod
    def moments(psi: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact]) -> list[float]: ...
    @staticmethod
    def total_mass(psi: numpy.typing.NDArray[numpy.inexact]) -> float: ...
    @staticmethod
    def expansion(psi: numpy.typing.NDArray[numpy.inexact], near: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact]) -> list[float]: ...
    @staticmethod
    def shifted(psi: numpy.typing.NDArray[numpy.inexact], f: numpy.typing.NDArray[numpy.inexact], a: float, b: float, out: numpy.typing.NDArray[numpy.inexact]) -> list[float]: ...
    @staticmethod
    def inner(a: numpy.typing.NDArray[numpy.inexact], b: numpy.typing.NDArray[numpy.inexact]) -> float: ...
    @staticmethod
    def weighted_square(field: numpy.typing.NDArray[numpy.inexact], weight: numpy.typing.NDArray[numpy.float64]) -> float: ...
    @staticmethod
    def interaction_energy(psi: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float) -> float: ...
    @staticmethod
    def quartic_sums(psi: numpy.typing.NDArray[numpy.inexact], p: numpy.typing.NDArray[numpy.inexact]) -> list[float]: ...

class fields:
    @staticmethod
    def extrapolate(last: numpy.typing.NDArray[numpy.inexact], before: numpy.typing.NDArray[numpy.inexact], first: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def multiply_modes(modes: numpy.typing.NDArray[numpy.inexact], factor: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def right_side(start: numpy.typing.NDArray[numpy.inexact], mean: numpy.typing.NDArray[numpy.inexact], rotation: numpy.typing.NDArray[numpy.inexact], W: numpy.typing.NDArray[numpy.float64], w: float, c: float, out: numpy.typing.NDArray[numpy.inexact]) -> float: ...
    @staticmethod
    def other_end(mean: numpy.typing.NDArray[numpy.inexact], start: numpy.typing.NDArray[numpy.inexact]) -> None: ...
    @staticmethod
    def mean_density(start: numpy.typing.NDArray[numpy.inexact], mean: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.float64]) -> None: ...
    @staticmethod
    def density(psi: numpy.typing.NDArray[numpy.inexact], V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.float64]) -> None: ...
    @staticmethod
    def nonlinear_force(psi: numpy.typing.NDArray[numpy.inexact], other: numpy.typing.NDArray[numpy.inexact], a: float, V: numpy.typing.NDArray[numpy.float64], beta: float, out: numpy.typing.NDArray[numpy.inexact]) -> float: ...
    @staticmethod
    def projections(force: numpy.typing.NDArray[numpy.inexact], modes: numpy.typing.NDArray[numpy.inexact], inverse: numpy.typing.NDArray[numpy.inexact], c: float) -> list[float]: ...
    @staticmethod
    def advance(modes: numpy.typing.NDArray[numpy.inexact], inverse: numpy.typing.NDArray[numpy.inexact], factor: float, new_modes: numpy.typing.NDArray[numpy.inexact], force: numpy.typing.NDArray[numpy.inexact]) -> None: ...

class comparators:
    @staticmethod
    def take_steps(scheme: str, constant: float, functions: object, work: Work, steps: object, y: numpy.typing.NDArray[numpy.float64], rows: numpy.typing.NDArray[numpy.inexact]) -> int:
        """
        Take all steps from y, which moves; rows (saved, n) receives the states to save. Returns the number of evaluations.
        """

class gradients:
    @staticmethod
    def complex_step(fun: object, t: object, y: numpy.typing.NDArray[numpy.float64], args: tuple[Any, ...], step: float) -> numpy.ndarray:
        """
        Return the gradient (..., n) of ``fun(t, y, *args)`` along the components of y (n,): the imaginary parts over the step.
        """
    @staticmethod
    def checked_complex_step(fun: object, t: object, y: numpy.typing.NDArray[numpy.float64], args: tuple[Any, ...], step: float, direction: numpy.typing.NDArray[numpy.float64], floors: numpy.typing.NDArray[numpy.float64]) -> numpy.ndarray | None:
        """
        Return the same, or None where it disagrees with a difference of ``fun`` along ``direction * (abs(y) + floors)``, as that of a function does which is not analytic.
        """

class gravity:
    @staticmethod
    def frequencies(gm: numpy.typing.NDArray[numpy.float64], y: numpy.typing.NDArray[numpy.float64], duration: float) -> tuple[numpy.ndarray, float]:
        """
        Return the largest angular frequency of each body on its orbit about the heaviest one, and that of all other pairs.
        """
    @staticmethod
    def work_alone(alone: bool) -> bool:
        """
        Keep the calling thread from sharing the sums over many bodies with other threads, or let it share them. Returns the previous setting.
        """
    @staticmethod
    def end_threads() -> None:
        """End the threads that share these sums, for good."""

class multibody:
    @staticmethod
    def solve(matrices: numpy.typing.NDArray[numpy.float64], tolerance: float, acceleration: numpy.typing.NDArray[numpy.float64], multipliers: numpy.typing.NDArray[numpy.float64]) -> int:
        """
        Fill u' (n,) and the multipliers (m,) of M u' + G^T lambda = F, G u' = -gamma, from M, F, G and gamma one after the other. Returns the rank of G, or MASS_IS_SINGULAR or NOT_FINITE.
        """
    @staticmethod
    def solve_address() -> int:
        """Return the address of `solve` in multibody.cpp, for compiled code."""
    MASS_IS_SINGULAR: int = -1
    NOT_FINITE: int = -2
