"""The projection of a run: its options, the metric, the blocks, and linear invariants that it leaves unchanged.

A new option is a field of `ProjectionOptions` with its text there, a keyword in `ProjectionDetails`, and a check in
`validate`. If the step needs it, it is also a field of `Options` in engine/cpp/data.hpp, `is_plain` in system.hpp must
know which value is neutral, and `not_batched_because` in ensembles/members.py whether eight members may run at once.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..engine import data
from ..engine.data import EPS, FrameRows, Grouping, Options
from ..engine.native import BUILD
from ..engine.trust import FAR_IN_TOLERANCES, MOST_FAR
from ..methods.base import PROJECTION_ONLY, Method
from .inputs import count, flag, numbers, real_array, shown
from .invariant_set import TARGET_TOLERANCE, InvariantSet
from .invariants import Invariant
from .step_control import StepControl

__all__ = [
    "INDEX", "ProjectionDetails", "ProjectionKeywords", "ProjectionOptions", "are_combinations",
    "linear_rows", "takes_projection_options", "weights",
]  # fmt: skip

DIRECTIONS = {"new": data.NEW, "old": data.OLD, "midpoint": data.MIDPOINT}
MOST_ITERATIONS = 1000
# One tenth of the error with respect to a given target that is allowed at the start.
MOST_LEFT = 0.1 * TARGET_TOLERANCE
# A gradient is a combination of linear invariants if its remainder is below this share of it.
REMAINDER = 1e-9
# Unsigned integers: Numba then omits the test for negative indices, which costs more than the access itself.
INDEX = np.uint64
# Blocks of states with at most this many components, and linear invariants with at most this many entries, are kept
# between runs: making them takes longer than a short run.
SMALL_STATE, SMALL_MATRIX = 2**10, 2**14
NO_LINEAR_ROWS = FrameRows(np.zeros((2, 1), INDEX), np.zeros(0, INDEX), np.zeros(0), np.zeros(0), np.zeros((2, 0, 0)))
# These lines of docstrings are replaced by the options with their texts, or by their names.
WHOLE, NAMES = "{ProjectionOptions}", "{names of ProjectionOptions}"

Array = np.ndarray
Documented = TypeVar("Documented", bound=Any)
Metric = Literal["error", "euclidean"] | Sequence[float] | np.ndarray | None
Blocks = int | Sequence[ArrayLike] | None
LinearConstraints = Literal["auto"] | tuple[ArrayLike, ArrayLike] | None


class ProjectionDetails(TypedDict, total=False):
    """The options of the projection as keywords, without the invariants, for type checkers."""

    metric: Metric
    blocks: Blocks
    linear_invariants: LinearConstraints
    direction: Literal["new", "old", "midpoint"]
    iterations: int
    every: int | Literal["auto"] | None
    reuse_f: bool
    compensated: bool | None
    check: bool
    project_initial: bool


class ProjectionKeywords(ProjectionDetails, total=False):
    """The options of the projection as keywords, with the invariants, for type checkers."""

    invariants: Invariant | Callable[..., Any] | Iterable[Invariant | Callable[..., Any]]


@dataclass(kw_only=True)
class ProjectionOptions:
    """The options of the projection as given by the user; `validate` checks them for a run. Nothing changes them.

    Parameters
    ----------
    invariants : Invariant or sequence of Invariant, optional
        Invariants to keep.
    metric : {"error", "euclidean"} or array_like, shape (n,), optional
        Weights of the components of the correction. "error" (default if the method has an error estimate) minimises the
        correction in units of the local error of the step; "euclidean" minimises its 2-norm; an array contains the
        weights themselves (components with larger weights move more).
    blocks : int or sequence of index arrays, optional
        Groups of components with a common weight in the error metric: the number of consecutive components in each
        group, or index arrays. For positions and velocities of bodies in 3 dimensions use ``blocks=3``. Default: each
        component has its own weight.
    linear_invariants : (C, S), "auto" or None, optional
        Linear invariants C y, with C of shape (k, n), that the correction leaves unchanged, and S, of shape (n, k),
        whose columns are the directions in which the correction is shifted for that; C S must be invertible. "auto":
        they are found at the start, from values of `fun` at points near the start and a few at larger distances, whose
        number is not in ``nfev``: quantities c y with c f = 0, as momentum, and those whose rates are such quantities,
        as the centre of mass. Those that the `invariants` determine are left out. Nothing is found for complex states,
        more than 300 components, balances, user-defined one-step methods, or if a value is not finite. None: only
        those of `particle_invariants`. `Diagnostics.remarks` has their number. Default: "auto" for the compiled
        functions of `integrate` and `ensemble`, otherwise None; a `Problem` may have its own.
    direction : {"new", "old", "midpoint"}, optional
        State at which the gradients that span the correction are evaluated: the raw result of the step (default), its
        start, or the midpoint.
    iterations : int, optional
        Number of Newton steps of the projection. 1 (default) gives the EIP method, more the standard projection.
    every : int or "auto", optional
        Project every `every`-th step and the last one. "auto": project when the error estimates, added in quadrature
        since the last projection, make an invariant more uncertain than round-off (checked at every fifth step and
        after a projection). In between, states are returned as projected copies. Default: "auto" for a multistep method
        and 1 for others.
    reuse_f : bool, optional
        If the step evaluates f at its raw result anyway, use it as the first stage of the next step.
    compensated : bool, optional
        Use compensated summation for the state (for steps so small that round-off dominates). Default: True for a
        multistep method and False for others.
    check : bool, optional
        True: check the invariants and their gradients at the start and again after some steps, monitor whether the
        errors of the steps explain the corrections, fail if a projection leaves an error as large as the terms of the
        invariant, and compare a short step of a user-defined one-step method with `fun` at the start. False: none of
        these.
    project_initial : bool, optional
        Project y0 onto given targets before the first step, by the correction with the smallest 2-norm: all components
        have equal weights, regardless of `metric` and `blocks`, and linear invariants stay unchanged.
        `Diagnostics.moved` says how far y0 moved. To fix components, call `project` with ``sigma=``.
    """

    invariants: Any = ()
    metric: Any = None
    blocks: Any = None
    linear_invariants: Any = None
    direction: str = "new"
    iterations: int = 1
    every: int | str | None = None
    reuse_f: bool = True
    compensated: bool | None = None
    check: bool = True
    project_initial: bool = False

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of the options."""
        return tuple(cls.__dataclass_fields__)

    @classmethod
    def split(cls, keywords: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return two dictionaries: the keywords that are options of the projection, and the other keywords."""
        names = cls.names()
        own = {name: value for name, value in keywords.items() if name in names}
        return own, {name: value for name, value in keywords.items() if name not in own}

    @property
    def given_linear_invariants(self) -> Any:
        """Return the pair (C, S) if one was given, not yet checked; None if there are none or they are searched for."""
        linear = self.linear_invariants
        return None if isinstance(linear, str) and linear == "auto" else linear

    def validate(
        self, method: Method, stepping: StepControl, y0: Array, f0: Array, known: InvariantSet
    ) -> tuple[Options, Array | None]:
        """Check the options for a run with the `known` invariants, and return them in the form that the step needs.

        The second item are the weights of the metric if the user gave an array, else None.
        """
        n, width = y0.size, 2 if y0.dtype.kind == "c" else 1
        compensated, check = self._compensated(method), flag("check", self.check)
        flag("project_initial", self.project_initial)
        metric, sigma = self._metric(method, n, width)
        balances, balance_groups = data.NO_BALANCES, data.NO_GROUPS
        if known.balances.items:
            balance_groups = _balance_groups(known, n, width)
            if method is not PROJECTION_ONLY:
                balances = data.Balances(known.balances.places, method.rated_stages())
        if balance_groups is not data.NO_GROUPS:
            self._require_defaults()
            metric = data.EUCLIDEAN  # the groups have their own weights
        groups, linear = _blocks(self.blocks, n, width), self.given_linear_invariants
        adaptive, distant = stepping.h is None, data.DISTANT
        if adaptive:
            largest = float(np.maximum.reduce(stepping.rtol, initial=0.0))
            distant = min(max(FAR_IN_TOLERANCES * largest, distant), MOST_FAR)
        band = data.BAND_COMPENSATED if compensated else data.BAND
        bound = [given and not method.has_history for given in known.given]
        options = Options(
            rtol=stepping.rtol.repeat(width),
            atol=stepping.atol,
            block_atol=_block_atol(stepping.atol, groups),
            blocks=groups,
            frame=NO_LINEAR_ROWS if linear is None else linear_rows(linear, n, width),
            balances=balances,
            balance_groups=balance_groups,
            columns=data.no_columns(known.size),
            target=known.target,
            scales=known.scales,
            computed=known.computed.astype(float),
            # Multistep methods pass the errors instead of the targets; the remaining errors are negligible.
            most_left=known.of_values([MOST_LEFT if given else np.inf for given in bound], float),
            kinds=_unit_groups(groups, y0, f0),
            masses=np.zeros((known.size, 0)),
            kappa=method.metric_exponent,
            metric=metric,
            direction=self._direction(method),
            iterations=count("iterations", self.iterations, MOST_ITERATIONS),
            every=self._every(method),
            # The steps of a one-step method do not use f: there is no evaluation that could replace f(y_hat).
            reuse_f=flag("reuse_f", self.reuse_f) or method.in_python,
            uses_f=known.uses_f,
            compensated=compensated,
            adaptive=adaptive,
            # Multistep methods correct only a part of an error within rounding.
            per_band=1.0 / ((data.BAND_MULTISTEP if method.has_history else band) * EPS),
            watched=check and known.size > 0,
            limit=(data.LARGE_SHARE if adaptive else 1.0) if check else np.inf,
            distant=distant,
        )
        return (options._replace(joint=known.items) if _can_project_jointly(options, known) else options), sigma

    def identity(self, options: Options, known: InvariantSet) -> dict[str, Any]:
        """Return by name the effective value of each option that affects the bits of a run with `options`."""
        metric: Any = "error" if options.metric == data.BY_ERROR else "euclidean"
        if not isinstance(self.metric, str | None):
            metric = weights("metric", self.metric, np.size(self.metric))
        # The given pair, because the rows in `options` come from LAPACK, whose last bits differ between machines.
        linear = self.given_linear_invariants
        found: dict[str, Any] = {name: getattr(self, name) for name in self.names() if name != "check"} | {
            "rtol": options.rtol,
            "atol": options.atol,
            "invariants": [
                (label, item.target, item.scale) for label, item in zip(known.labels, known.items, strict=True)
            ],
            "metric": metric,
            "blocks": (options.blocks.start, options.blocks.member),
            "every": "auto" if options.every == data.AUTO else options.every,
            "project_initial": bool(self.project_initial),
        }
        found |= {name: getattr(options, name) for name in ("iterations", "reuse_f", "uses_f", "compensated")}
        if linear is not None:
            found["linear_invariants"] = [np.asarray(a, known.dtype) for a in linear]
        if known.balances.items:
            found["balances"] = [known.labels[k] for k in known.balances.items]
        if options.balance_groups.value.size:
            found["components"] = list(options.balance_groups)
        return found

    def _require_defaults(self) -> None:
        """Raise ValueError if an option is given that does not apply to balances with components."""
        if self.metric is not None or self.direction != "new" or self.iterations != 1:
            raise ValueError(
                "metric, direction and iterations do not apply to balances with components, which have their own "
                "weights and use one Newton step; omit these options."
            )

    def _compensated(self, method: Method) -> bool:
        if self.compensated is None:
            return method.has_history
        compensated = flag("compensated", self.compensated)
        if method.has_history and not compensated:
            raise ValueError(f"compensated=False: {method.name} always uses compensated sums; omit compensated.")
        if compensated and method.in_python:
            raise ValueError(
                f"compensated=True is available for methods made from a tableau, and {method.name} is not a tableau; "
                "omit compensated."
            )
        return compensated

    def _every(self, method: Method) -> int:
        if self.every is None:
            return data.AUTO if method.has_history else 1
        if not isinstance(self.every, str):
            return count("every", self.every)
        if self.every != "auto":
            raise ValueError(f"every must be an integer >= 1 or 'auto', got {self.every!r}.")
        if not method.has_estimate:
            raise ValueError(f"every='auto' needs an error estimate, and {method.name} has none; give an integer.")
        return data.AUTO

    def _direction(self, method: Method) -> int:
        if not isinstance(self.direction, str) or self.direction not in DIRECTIONS:
            raise ValueError(f"direction must be 'new', 'old' or 'midpoint', got {self.direction!r}.")
        if method.has_history and self.direction != "new":
            raise ValueError(
                f"direction={self.direction!r}: the multistep method {method.name} projects along the gradients at the "
                "new state only; omit direction."
            )
        return DIRECTIONS[self.direction]

    def _metric(self, method: Method, n: int, width: int) -> tuple[int, Array | None]:
        metric = self.metric
        if isinstance(metric, str | None):
            if metric == "euclidean":
                return data.EUCLIDEAN, None
            if metric in ("error", None):
                return (data.BY_ERROR if method.has_estimate else data.EUCLIDEAN), None
            raise ValueError(f"metric must be 'error', 'euclidean' or an array of n weights, got {metric!r}.")
        return data.GIVEN, np.repeat(weights("metric", metric, n), width)


def weights(name: str, sigma: Any, n: int) -> Array:
    """Return weights of n components, scaled so that the largest is 1, after checks."""
    a = real_array(name, sigma)
    if a.shape != (n,):
        raise ValueError(f"{name}: weights have shape {a.shape}, the state has {n} components.")
    if not np.all(np.isfinite(a)) or np.any(a < 0) or not np.any(a > 0):
        raise ValueError(f"{name}: weights must be finite, >= 0 and not all 0.")
    return a / a.max()


def _blocks(blocks: Any, n: int, width: int) -> Grouping:
    """Return the checked option ``blocks`` as groups of floats of a state of n components of `width` floats each."""
    if blocks is None:
        blocks = 1
    if isinstance(blocks, (int, np.integer)) and not isinstance(blocks, bool):
        if blocks < 1 or n % blocks:
            raise ValueError(f"blocks = {blocks} does not divide the state's {n} components; give a positive divisor.")
        return (_consecutive if n <= SMALL_STATE else _consecutive.__wrapped__)(int(blocks), n, width)
    groups = _block_lists(blocks, n)
    member = np.concatenate([*groups, []]).astype(INDEX)
    if width == 2:
        member = np.column_stack([2 * member, 2 * member + 1]).ravel()
    start = (_starts(groups) * width).astype(INDEX)
    regular = len(set(map(len, groups))) == 1 and np.array_equal(member, np.arange(member.size))
    return Grouping(member, start, width, int(start[1]) if regular else 0)


@lru_cache(maxsize=64)
def _consecutive(size: int, n: int, width: int) -> Grouping:
    """Return blocks of `size` consecutive components, made without a loop: a field may have a million of them."""
    floats = n * width
    start = np.arange(0, floats + 1, size * width, dtype=INDEX)
    return Grouping(np.arange(floats, dtype=INDEX), start, width, size * width if n else 0)


def _block_lists(blocks: Any, n: int) -> list[Array]:
    try:
        groups = [np.atleast_1d(np.asarray(b)) for b in blocks]
    except (TypeError, ValueError):
        raise ValueError(f"blocks must be an integer or a sequence of index arrays, got {shown(blocks)}.") from None
    groups = [g for g in groups if g.size]
    for g in groups:
        if g.dtype.kind not in "iu" or g.ndim != 1 or g.min() < 0 or g.max() >= n:
            raise ValueError(f"blocks: {shown(g)} is not an array of indices from 0 to {n - 1}.")
    used = np.concatenate([*groups, np.array([], dtype=int)]).astype(int)
    if np.unique(used).size != used.size:
        raise ValueError("blocks: a component is in two blocks; each component may be in one block only.")
    return groups + [np.array([i]) for i in np.setdiff1d(np.arange(n), used)]


def _starts(parts: Iterable[Sized]) -> Array:
    """Return the index of the first element of each part among the elements of all parts, and their number."""
    return np.array([0, *accumulate(map(len, parts))], np.int64)


def _block_atol(atol: Array, groups: Grouping) -> Array:
    """Return the absolute tolerances of the blocks: the 2-norms of those of their components."""
    if groups.size == 1 or not np.count_nonzero(atol):
        return atol[: groups.start.size - 1].copy()
    squares = np.repeat(atol, groups.width)[groups.member] ** 2 / groups.width
    return np.sqrt(np.add.reduceat(squares, groups.start[:-1].astype(np.intp)))


def _unit_groups(groups: Grouping, y: Array, f: Array) -> Grouping:
    """Return the floats in groups with a common unit: the blocks, or without blocks the halves of a state (q, p)."""
    halves = 0 < y.size < len(groups.start) and BUILD.is_canonical(y, f)
    return _blocks(y.size // 2, y.size, 1) if halves else groups


def linear_rows(given: Any, n: int, width: int) -> FrameRows:
    """Return linear invariants (C, S) as sparse rows of C and of the transpose of S (C S)^-1, after checks.

    The rows act on the floats of the state, `width` of which represent a component: 2 for a complex state, else 1.
    """
    pair = tuple(given) if np.iterable(given) else ()
    matrices = [matrix for a in pair if (matrix := numbers("linear_invariants", a)) is not None]
    if len(pair) != 2 or len(matrices) != 2:
        raise ValueError(
            "linear_invariants must be 'auto', None, or a pair (C, S) of matrices of shapes (k, n) and (n, k), "
            f"got {shown(given)}."
        )
    C, S = map(np.atleast_2d, matrices)
    k = C.shape[0]
    if k == 0 or C.shape != (k, n) or S.shape != (n, k):
        raise ValueError(
            f"linear_invariants: C has shape {C.shape} and S {S.shape}; expected real or complex numbers of shapes "
            f"(k, {n}) and ({n}, k) with k >= 1."
        )
    rows = _rows if C.size <= SMALL_MATRIX else _rows.__wrapped__
    found = rows((C.tobytes(), C.dtype.str), (S.tobytes(), S.dtype.str), n, width)
    return found._replace(products=np.zeros(len(found.products)))  # which each run writes


@lru_cache(maxsize=8)
def _rows(given_C: tuple[bytes, str], given_S: tuple[bytes, str], n: int, width: int) -> FrameRows:
    C, S = np.frombuffer(*given_C).reshape(-1, n), np.frombuffer(*given_S).reshape(n, -1)
    if width == 2:
        C, S = _real_form(C), _real_form(S)
    elif C.dtype.kind == "c" or S.dtype.kind == "c":
        raise ValueError("linear_invariants: C and S must be real for a real state.")
    # Rows of C and columns of S in units of their own: only then does the condition number tell singular from scaled.
    C = C / np.maximum(np.abs(C).max(axis=1, keepdims=True), np.finfo(float).tiny)
    S = S / np.maximum(np.abs(S).max(axis=0, keepdims=True), np.finfo(float).tiny)
    shifts, k = C @ S, len(C)
    if not np.all(np.isfinite(shifts)) or not np.linalg.cond(shifts) < 1e12:
        raise ValueError(
            "linear_invariants: C S is singular; S must span shifts that change every row of C y, the rows of C must "
            "be linearly independent, and C and S must be finite."
        )
    both = np.concatenate([C, np.linalg.solve(shifts.T, S.T)])
    rows, index = np.nonzero(both)
    starts = np.concatenate([[0], np.cumsum(np.count_nonzero(both, axis=1))]).astype(INDEX)
    weights = [_body_weights(both[:k]), _body_weights(both[k:])]
    bodies = np.array(weights) if all(a.size for a in weights) else np.zeros((2, 0, 0))
    indices = np.array([starts[: k + 1], starts[k:]])
    return FrameRows(indices, index.astype(INDEX), both[rows, index], np.zeros(k), bodies)


def _real_form(a: Array) -> Array:
    """Return the real matrix (2 k, 2 n) that acts on pairs (Re, Im) as `a` (k, n) acts on complex components."""
    out = np.empty((a.shape[0], 2, a.shape[1], 2))
    out[:, 0, :, 0] = out[:, 1, :, 1] = a.real
    out[:, 1, :, 0], out[:, 0, :, 1] = a.imag, -a.imag
    return out.reshape(2 * a.shape[0], 2 * a.shape[1])


def _body_weights(a: Array) -> Array:
    """Return the weights (k, b) if rows of `a` (3 k, 3 k b) sum x, y, z over b bodies of k groups, else no weights."""
    groups = a.shape[0] // 3
    if groups == 0 or a.shape[0] % 3 or a.shape[1] % (3 * groups):
        return np.zeros((0, 0))
    entries = a.reshape(groups, 3, groups, -1, 3)
    weights = np.einsum("kkb->kb", entries[:, 0, :, :, 0])
    expected = np.einsum("kb,kg,ij->kigbj", weights, np.eye(groups), np.eye(3))
    return weights if np.array_equal(entries, expected) else np.zeros((0, 0))


def are_combinations(linear: FrameRows, G: Array) -> Array:
    """Return a mask (l,) of the gradients, rows of G, that combine linear invariants: no correction is along them."""
    left = G.copy()
    for (begin, end), (first, last) in zip(*(pairwise(rows.tolist()) for rows in linear.start), strict=True):
        products = G[:, linear.place[first:last]] @ linear.value[first:last]
        left[:, linear.place[begin:end]] -= products[:, None] * linear.value[begin:end]
    sizes, rest = (np.abs(rows).max(axis=1, initial=0.0) for rows in (G, left))
    return (sizes > 0.0) & (rest <= REMAINDER * sizes)


def _balance_groups(known: InvariantSet, n: int, width: int) -> data.Groups:
    """Return the balances in groups of the same components and weights, each of which is projected by itself."""
    lacking = [label for item, label in zip(known.items, known.labels, strict=True) if not item.subspaces]
    if len(lacking) == len(known.items):
        return data.NO_GROUPS
    if lacking:
        raise ValueError(
            f"invariants: {lacking[0]!r} has no components, but others have. Give components to all balances or to "
            "none; an invariant of the whole state cannot be combined with balances of components."
        )
    if width == 2:
        raise ValueError(
            "invariants: a balance has components=, but the state is complex. Write the state in real and imaginary "
            "parts."
        )
    groups: dict[Any, tuple[Array, Array, list[int]]] = {}
    for item, (first, last) in zip(known.items, pairwise(known.starts), strict=True):
        values = [range(first, last)] if len(item.subspaces) == 1 else [range(v, v + 1) for v in range(first, last)]
        for (components, sizes), own in zip(item.subspaces, values, strict=True):
            key = components.shape, components.tobytes(), sizes.tobytes()
            groups.setdefault(key, (components, sizes, []))[2].extend(own)
    places, weights, values = zip(*groups.values(), strict=True)
    if max(int(components.max()) for components in places) >= n:
        raise ValueError(f"invariants: the components of a balance are outside the state, which has {n} components.")
    size = 3 if all(map(_are_of_bodies, places, weights)) else 1
    return data.Groups(
        value=np.concatenate([np.array(own, np.int64) for own in values]),
        first_value=_starts(values),
        first_direction=_starts(components[::size] for components in places),
        first_float=_starts(row for components in places for row in components[::size]),
        place=np.concatenate([components[::size].ravel() for components in places]),
        weight=np.concatenate([weight[::size].ravel() for weight in weights]),
        size=size,
    )


def _are_of_bodies(components: Array, weight: Array) -> bool:
    """Return True if the rows of `components` (s, k) are triples x, y, z of k bodies with the same `weight` (s, k)."""
    if len(components) % 3:
        return False
    alike = (weight.reshape(-1, 3, weight.shape[1]) == weight[::3, None]).all()
    return bool(alike and (np.diff(components.reshape(-1, 3, components.shape[1]), axis=1) == 1).all())


def _can_project_jointly(options: Options, known: InvariantSet) -> bool:
    """Return True if the invariants have functions `moments` and `shift`, by which the run can project them."""
    if not hasattr(known.items, "shift"):
        return False
    plain = (options.metric, options.direction, options.iterations) == (data.EUCLIDEAN, data.NEW, 1)
    free = options.frame.products.size == 0 and options.every != data.AUTO and not options.compensated
    return plain and free and not known.balances.items


def takes_projection_options(documented: Documented) -> Documented:
    """Return a function or class that accepts the options as keywords, with these in its signature and docstring."""
    function: Any = vars(documented)["__init__"] if isinstance(documented, type) else documented
    signature = inspect.signature(function)
    *own, rest = signature.parameters.values()
    options = [
        inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, default=option.default, annotation=option.type)
        for option in fields(ProjectionOptions)
    ]
    others = [rest] if isinstance(documented, type) else []  # solvers accept and ignore options of other solvers
    function.__signature__ = signature.replace(parameters=[*own, *options, *others])
    if documented.__doc__ and ProjectionOptions.__doc__:  # python -OO removes docstrings
        text = documented.__doc__.replace(NAMES, ", ".join(ProjectionOptions.names()))
        documented.__doc__ = text.replace(WHOLE, ProjectionOptions.__doc__.partition("----------\n")[2].strip())
    return documented
