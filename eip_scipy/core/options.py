"""The options of the projection: names, defaults, documentation, checks, and the identity of a run.

A new option is a field here, a keyword, and, if the step needs it, a field of `Options` in engine/cpp/data.hpp.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..engine import data
from ..engine.data import EPS, Options
from ..engine.trust import FAR_IN_TOLERANCES, MOST_FAR
from ..methods.base import PROJECTION_ONLY, Method
from .blocks import blocks_of, kinds_of
from .frame import frame_rows
from .inputs import count, flag, real_array
from .invariants import TARGET_TOLERANCE, Invariant, InvariantSet
from .step_control import StepControl

__all__ = [
    "Options", "ProjectionDetails", "ProjectionKeywords", "ProjectionOptions", "takes_projection_options", "weights",
]  # fmt: skip

DIRECTIONS = {"new": data.NEW, "old": data.OLD, "midpoint": data.MIDPOINT}
MOST_ITERATIONS = 1000
# One tenth of the error with respect to a given target that is allowed at the start.
MOST_LEFT = 0.1 * TARGET_TOLERANCE
# These lines of docstrings are replaced by the options with their texts, or by their names.
WHOLE, NAMES = "{ProjectionOptions}", "{names of ProjectionOptions}"

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
    """The options of the projection as given by the user; `settled` checks them for a run. Nothing changes them.

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
    def constraints(self) -> Any:
        """Return the pair (C, S) if one was given as `linear_invariants`, not yet checked, else None."""
        return None if self.is_searched else self.linear_invariants

    @property
    def is_searched(self) -> bool:
        """Return True if linear invariants are to be found."""
        return isinstance(self.linear_invariants, str) and self.linear_invariants == "auto"

    def settled(
        self, method: Method, stepping: StepControl, y0: np.ndarray, f0: np.ndarray, known: InvariantSet
    ) -> tuple[Options, np.ndarray | None, Callable[[], dict[str, Any]]]:
        """Check the options for a run with the `known` invariants, and return them in the form that the step needs.

        The second item are the weights of the metric if the user gave an array, else None. The third one returns the
        identity of the run: the effective value of each option that affects its bits, by name.
        """
        n, width = y0.size, 2 if y0.dtype.kind == "c" else 1
        kind, sigma = self._metric(method, n, width)
        balance_groups = _groups(known, n, width)
        if balance_groups is not data.NO_GROUPS:
            self._require_plain()
            kind = data.EUCLIDEAN  # the groups have their own weights
        if not isinstance(self.direction, str) or self.direction not in DIRECTIONS:
            raise ValueError(f"direction must be 'new', 'old' or 'midpoint', got {self.direction!r}.")
        if method.has_history and self.direction != "new":
            raise ValueError(
                f"direction={self.direction!r}: the multistep method {method.name} projects along the gradients at the "
                "new state only; omit direction."
            )
        compensated = self._compensated(method)
        band = data.BAND_COMPENSATED if compensated else data.BAND
        rtol, atol = stepping.rtol, stepping.atol
        groups = blocks_of(self.blocks, n, width)
        block_atol = atol[: groups.start.size - 1].copy()
        if groups.size != 1 and np.count_nonzero(atol):
            squares = np.repeat(atol, width)[groups.member] ** 2 / width
            block_atol = np.sqrt(np.add.reduceat(squares, groups.start[:-1].astype(np.intp)))
        check, distant = flag("check", self.check), data.DISTANT
        if stepping.h is None:
            distant = min(max(FAR_IN_TOLERANCES * float(rtol.max(initial=0.0)), data.DISTANT), MOST_FAR)
        options = Options(
            rtol=rtol.repeat(width),
            atol=atol,
            block_atol=block_atol,
            groups=groups,
            frame=frame_rows(self.constraints, n, width),
            balances=_balances(method, known),
            balance_groups=balance_groups,
            columns=data.no_columns(known.size),
            target=known.target,
            scales=known.scales,
            computed=known.computed.astype(float),
            # Multistep methods pass the errors instead of the targets; the remaining errors are negligible.
            most_left=np.where(known.given & (not method.has_history), MOST_LEFT, np.inf),
            kinds=kinds_of(groups, y0, f0),
            kappa=method.kappa,
            metric=kind,
            direction=DIRECTIONS[self.direction],
            iterations=count("iterations", self.iterations, MOST_ITERATIONS),
            every=self._every(method),
            # The steps of a one-step method do not use f: there is no evaluation that could replace f(y_hat).
            reuse_f=flag("reuse_f", self.reuse_f) or method.in_python,
            uses_f=known.uses_f,
            compensated=compensated,
            adaptive=stepping.h is None,
            # Multistep methods correct only a part of an error within rounding.
            per_band=1.0 / ((data.BAND_MULTISTEP if method.has_history else band) * EPS),
            watched=check and known.size > 0,
            limit=(data.LARGE_SHARE if stepping.h is None else 1.0) if check else np.inf,
            distant=distant,
        )
        if _can_project_jointly(options, known):
            options = options._replace(joint=known.items)
        flag("project_initial", self.project_initial)
        return options, sigma, partial(self._identity, options, sigma, y0, known)

    def _identity(self, o: Options, sigma: np.ndarray | None, y0: np.ndarray, known: InvariantSet) -> dict[str, Any]:
        carried = [known.labels[k] for k in known.balances.items]
        grouped = o.balance_groups is not data.NO_GROUPS
        return {
            **({"balances": carried} if carried else {}),
            **({"components": list(o.balance_groups)} if grouped else {}),
            "rtol": o.rtol,
            "atol": o.atol,
            "invariants": [
                (label, item.target, item.scale) for label, item in zip(known.labels, known.items, strict=True)
            ],
            "metric": {data.EUCLIDEAN: "euclidean", data.BY_ERROR: "error"}.get(o.metric, sigma),
            "blocks": (o.groups.start, o.groups.member),
            # The given value, because the one in `o` comes from LAPACK, whose last bits differ between machines.
            "linear_invariants": "auto"
            if self.is_searched
            else self.constraints and [np.asarray(a, y0.dtype) for a in self.constraints],
            "direction": self.direction,
            "iterations": o.iterations,
            "every": "auto" if o.every == data.AUTO else o.every,
            "reuse_f": o.reuse_f,
            "uses_f": o.uses_f,
            "project_initial": bool(self.project_initial),
            "compensated": o.compensated,
        }

    def _require_plain(self) -> None:
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

    def _metric(self, method: Method, n: int, width: int) -> tuple[int, np.ndarray | None]:
        metric = self.metric
        if isinstance(metric, str | None):
            if metric == "euclidean":
                return data.EUCLIDEAN, None
            if metric in ("error", None):
                return (data.BY_ERROR if method.has_estimate else data.EUCLIDEAN), None
            raise ValueError(f"metric must be 'error', 'euclidean' or an array of n weights, got {metric!r}.")
        return data.GIVEN, np.repeat(weights("metric", metric, n), width)


def weights(name: str, sigma: Any, n: int) -> np.ndarray:
    """Return weights of n components, scaled so that the largest is 1, after checks."""
    a = real_array(name, sigma)
    if a.shape != (n,):
        raise ValueError(f"{name}: weights have shape {a.shape}, the state has {n} components.")
    if not np.all(np.isfinite(a)) or np.any(a < 0) or not np.any(a > 0):
        raise ValueError(f"{name}: weights must be finite, >= 0 and not all 0.")
    return a / a.max()


def _balances(method: Method, known: InvariantSet) -> data.Balances:
    """Return the engine's record of the balances of a run; it is empty if `project` projects a single state."""
    if not known.balances.items or method is PROJECTION_ONLY:
        return data.NO_BALANCES
    return data.Balances(known.balances.places, method.rated_stages())


def _groups(known: InvariantSet, n: int, width: int) -> data.Groups:
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
    groups: dict[Any, tuple[np.ndarray, np.ndarray, list[int]]] = {}
    for k, item in enumerate(known.items):
        values = range(known.starts[k], known.starts[k + 1])
        each = [values] if len(item.subspaces) == 1 else [range(v, v + 1) for v in values]
        for (components, weight), own in zip(item.subspaces, each, strict=True):
            key = components.shape, components.tobytes(), weight.tobytes()
            groups.setdefault(key, (components, weight, []))[2].extend(own)
    size = 3 if all(_are_of_bodies(components, weight) for components, weight, _ in groups.values()) else 1
    directions = [(components[::size], weight[::size]) for components, weight, _ in groups.values()]
    if max(int(components.max()) for components, _, _ in groups.values()) >= n:
        raise ValueError(f"invariants: the components of a balance are outside the state, which has {n} components.")
    return data.Groups(
        value=np.concatenate([np.array(values, np.int64) for _, _, values in groups.values()]),
        first_value=_starts([len(values) for _, _, values in groups.values()]),
        first_direction=_starts([len(components) for components, _ in directions]),
        first_float=_starts([row.size for components, _ in directions for row in components]),
        place=np.concatenate([components.ravel() for components, _ in directions]),
        weight=np.concatenate([weight.ravel() for _, weight in directions]),
        size=size,
    )


def _are_of_bodies(components: np.ndarray, weight: np.ndarray) -> bool:
    """Return True if the rows of `components` (s, k) are triples x, y, z of k bodies with the same `weight` (s, k)."""
    if len(components) % 3:
        return False
    alike = (weight.reshape(-1, 3, weight.shape[1]) == weight[::3, None]).all()
    return bool(alike and (np.diff(components.reshape(-1, 3, components.shape[1]), axis=1) == 1).all())


def _starts(sizes: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


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
