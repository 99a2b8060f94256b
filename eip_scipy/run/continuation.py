"""Continuation of a run from its end, unchanged, or restarted with a change of its state, its parameters or equations.

A restart compares the run at its end with the same run after the change: invariants whose values are the same keep
their targets, the others get new ones, and tangent vectors pass through the change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..checkpoint import first_difference
from ..core.bound_problem import BoundProblem
from ..core.derivatives import difference_gradient, random_directions
from ..core.events import ContinuedEvents, as_events
from ..core.inputs import initial_state, is_number, real_array, shown
from ..core.invariants import Invariant, as_invariants, with_targets
from ..core.names import nearest
from ..core.problem import Problem
from ..core.projection import ProjectionOptions
from ..core.tangent_vectors import TangentVectors
from ..engine.data import EPS
from .fields import OBSERVED, OF_EVENTS, joined
from .integrate import integrate, used_up
from .origin import Origin
from .prepare import RunArguments, as_problem, default_method, started_at
from .results import IntegrationResult, described

__all__ = ["continue_to", "continued", "repeated"]

Array = np.ndarray
# Options of `integrate` that may change where a run continues, apart from what makes a restart.
CHANGING = (
    *("method", "h", "rtol", "atol", "first_step", "max_step", "max_steps"),
    *("save_every", "t_eval", "events", "callback", "progress", "compiled", "max_bytes"),
    *("checkpoint", "checkpoint_every", "resume", "check", "project_initial"),
)
RESTARTING = ("y", "params", "fun", "acceleration", "invariants")
SHOWN = (*RESTARTING, "method", "h", "rtol", "atol", "first_step", "max_step", "events", "check")  # in `restarts`
DEFINING = ("t_span", "y0")
# Options that concern what a run saves and shows, and not its steps.
SAVING = ("t_eval", "save_every", "callback", "checkpoint", "diagnostics")
FIRST_PART = ("t_eval", "diagnostics")  # arguments that apply to the first part only
OF_FUNCTION = ("jvp", "jac", "jacobian", "symplectic")  # arguments that belong to the right-hand side
SAME_ROUNDINGS = 64.0  # of the terms of an invariant, by which equal values may differ
WRONG_JACOBIAN = 1e-3  # as for a jvp, which may consist of differences itself


def continue_to(result: IntegrationResult, t: float, options: dict[str, Any]) -> IntegrationResult:
    """Continue a run to the time t, see `IntegrationResult.continue_to`; `options` are those that were given."""
    for name in options.keys() - {*CHANGING, *RESTARTING, "jacobian"}:
        if name not in {*RunArguments._fields, *ProjectionOptions.names()}:
            raise TypeError(f"continue_to() has no option {name!r}{nearest(name, (*RESTARTING, *CHANGING))}")
        error = TypeError if name in DEFINING else ValueError
        raise error(
            f"continue_to: {name} cannot be changed in a run that continues; start a new run with integrate from its "
            f"last state. These may change: {', '.join((*RESTARTING, *CHANGING))}."
        )
    return continued(result, t, options)


def continued(result: IntegrationResult, t: float, options: dict[str, Any]) -> IntegrationResult:
    """Return a run and its continuation to the time t, with `options` of `integrate` and of `continue_to`."""
    origin, options = with_functions(result, options)
    if not is_number(t, "t") or not origin.sign * (t - origin.t) > 0:
        raise ValueError(f"continue_to: t must lie beyond the end of the run, {origin.t:.10g}, got {shown(t)}.")
    _require_same_functions(origin)
    changes = {name: value for name, value in options.items() if name in RESTARTING}
    asked = {name: value for name, value in origin.arguments.items() if name not in FIRST_PART}
    asked |= {"t_span": (origin.t, t), "y0": origin.y, "invariants": origin.kept()}
    if result.t_events is not None:
        asked["events"] = ContinuedEvents(_events(asked), result.t_events)
    if changes:
        asked = _Restart(result, origin, asked, changes, options).arguments()
    elif options.get("jacobian") is not None:
        raise ValueError("continue_to: jacobian is the derivative of the change y=..., which is missing. Give both.")
    if options.get("t_eval") is not None:
        asked["save_every"] = None
    asked |= {name: value for name, value in options.items() if name not in (*RESTARTING, "jacobian")}
    if "events" in options and options["events"] is None:
        asked["events"] = ()  # None would stand for the events of the problem
    what = ", ".join(name for name in SHOWN if name in changes or (name in options and name not in RESTARTING))
    try:
        return _joined(result, origin, integrate(**asked), changes, what)
    except BaseException as error:
        partial = getattr(error, "partial", None)
        if isinstance(partial, IntegrationResult):  # without an origin if it failed before the first step
            known = "_origin" in vars(partial)
            error.partial = _joined(result, origin, partial, changes, what) if known else result  # type: ignore[attr-defined]
        raise


def repeated(result: IntegrationResult, events: Sequence[Any]) -> IntegrationResult:
    """Return the same run again, see `IntegrationResult._repeated`."""
    origin: Origin = vars(result)["_origin"]
    given = origin.arguments
    t0 = started_at(RunArguments.of(**given | {"variations": None}))[0]
    if origin.sign * (t0 - result.t[0]) > 0:
        raise ValueError(
            f"transits: the run was continued at t={t0:.10g}. Pass a run of integrate(problem, ({result.t[0]:.10g}, "
            f"{origin.t:.10g}), ...) in one call; or if the run was changed there, one run for each part."
        )
    if result.t[0] != t0:
        raise ValueError(
            f"transits: the run begins at t={t0:.10g}, but its first saved state is at t={result.t[0]:.10g}. Pass a "
            "run that saves its start: omit t_eval, or let it begin there."
        )
    asked = given | dict.fromkeys(SAVING) | {"t_span": (t0, origin.t), "events": tuple(events)}
    if isinstance(tangents := given["variations"], TangentVectors):  # those at the end of the run
        p = len(tangents.parameters)
        at_start = np.vstack([result.variations[0], np.eye(p, tangents.count, tangents.count - p)])
        asked["variations"] = replace(tangents, initial=at_start)
    return integrate(**asked | {"progress": False, "dense_output": False, "resume": False})


class _Restart:
    """The arguments of a run that is restarted with `changes`, from those of the run that ended, `asked`."""

    def __init__(
        self,
        result: IntegrationResult,
        origin: Origin,
        asked: dict[str, Any],
        changes: dict[str, Any],
        options: dict[str, Any],
    ) -> None:
        self.result, self.origin, self.changes, self.jacobian = result, origin, changes, options.get("jacobian")
        self.asked, self.new = asked, dict(asked)
        self.steps_are_new = any(name in options for name in ("h", "rtol", "atol", "first_step", "max_step"))

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `integrate`."""
        changes, new = self.changes, self.new
        new["method"] = new["method"] or default_method(new["fun"])
        if "params" in changes:
            new["params"] = self._params(changes["params"])
        if "fun" in changes or "acceleration" in changes:
            new |= {name: changes.get(name) for name in ("fun", "acceleration")} | dict.fromkeys(OF_FUNCTION)
            if isinstance(changes.get("fun"), Problem):
                new |= {"params": changes.get("params"), "args": None}
                new["events"] = None if changes["fun"].events else new["events"]
                del new["invariants"]
            elif isinstance(self.asked["fun"], Problem):  # which has brought its invariants, and maybe the step
                new |= {"invariants": ()} | ({} if self.steps_are_new else {"h": self.result.h})
        if "invariants" in changes:
            new["invariants"] = as_invariants(changes["invariants"])
        if "y" in changes:
            new["y0"] = self._state(changes["y"])
        tangents, keeps = new["variations"], new.get("invariants") is self.asked["invariants"]
        if not isinstance(tangents, TangentVectors) and self.jacobian is not None:
            raise ValueError("continue_to: jacobian belongs to a run with derivatives (variations=...). Omit it.")
        if tangents is None and not (keeps and len(new["invariants"])):
            return new  # nothing passes through the change
        problem, items = _bound(new)
        if keeps:
            new["invariants"] = self._retargeted(problem, items)
        if isinstance(tangents, TangentVectors):
            new |= {"variations": self._passed(tangents, problem), "symplectic": False}  # the change need not be
        return new

    def _params(self, given: Any) -> Any:
        """Return the new parameters; those that a mapping does not name keep their values."""
        problem, now = self.asked["fun"], self.asked["params"]
        had, size = getattr(problem, "params", now), np.size(given)  # compiled code does not check the size
        is_known = not (had is None or isinstance(given, Mapping) or {"fun", "acceleration"} & self.changes.keys())
        if is_known and size != np.size(had):
            differs = f"params has {size} values, and the run had {np.size(had)}"
            raise ValueError(f"continue_to: {differs}. Give as many, or fun=... too.")
        if not (isinstance(given, Mapping) and isinstance(problem, Problem)) or now is None:
            return given
        known = now if isinstance(now, Mapping) else zip(problem.parameters, np.ravel(now).tolist(), strict=False)
        return dict(known) | dict(given)

    def _state(self, y: Any) -> Array:
        """Return the new state from an array or a function of the state."""
        before = self.origin.y
        found = initial_state(y(before.copy()) if callable(y) else y, "y")
        if found.shape != before.shape:
            raise ValueError(
                f"continue_to: y has {found.size} components, but the state has {before.size}; start a new run with "
                "integrate for another number of components."
            )
        return found.astype(np.result_type(found, before), copy=False)

    def _retargeted(self, problem: BoundProblem, items: tuple[Invariant, ...]) -> tuple[Invariant, ...]:
        """Return the invariants with new targets where the change has changed their values."""
        kept, t, y = self.asked["invariants"], self.origin.t, self.new["y0"]
        values = _values(problem, items, t, y)
        after, before = np.concatenate([*values, np.zeros(0)]), self.origin.values()
        terms = np.where(np.isfinite(self.origin.terms), self.origin.terms, 0.0)
        sizes = np.maximum(np.maximum(np.abs(before), np.abs(after)), terms)
        same = np.abs(after - before) <= SAME_ROUNDINGS * EPS * sizes
        place, targets = 0, list[Any]()
        for item, value in zip(kept, values, strict=True):
            here = slice(place, place := place + value.size)
            keeps = item.is_measured and item.target is not None
            targets.append(np.where(same[here], item.target, value) if keeps else item.target)
        return with_targets(kept, targets)

    def _passed(self, tangents: TangentVectors, problem: BoundProblem) -> TangentVectors:
        """Return the tangent vectors behind the change, whose time shifts with the event at which it happens."""
        known = [list(getattr(fun, "parameters", ())) for fun in (self.asked["fun"], self.new["fun"])]
        if tangents.parameters and known[0] != known[1]:
            raise ValueError(
                f"continue_to: the run carries derivatives by parameters, and fun has others, {known[1]}, than before, "
                f"{known[0]}. Start a new run from the last state."
            )
        n, vectors, k = tangents.n, tangents.initial.copy(), self.origin.event
        in_time = np.zeros(tangents.count)
        if k is not None:
            in_time, vectors[:n] = self.result.time_derivatives[k][-1], self.result.state_derivatives[k][-1]
            if not np.isfinite(in_time).all():
                raise ValueError(
                    f"continue_to: event {k}, at which the run ended, has no derivatives, so that they cannot pass "
                    f"through a change there: {self.result.message}. Start a run without variations."
                )
        J = self._jacobian(n, tangents.size)
        after: Array = vectors[:n] if J is None else J @ vectors[: J.shape[1]]
        vectors[:n] = after - np.outer(problem.derivative(self.origin.t, self.new["y0"]), in_time)
        return replace(tangents, initial=vectors)

    def _jacobian(self, n: int, size: int) -> Array | None:
        """Return the derivative of the new state by the old one, and maybe by the parameters, after checks."""
        y, before = self.changes.get("y"), self.origin.y
        if y is None and self.jacobian is None:
            return None
        if y is None or self.jacobian is None:
            raise ValueError(
                "continue_to: the run carries derivatives, which pass through a change y=... by jacobian=..., the "
                f"derivative ({n}, {n}) of the new state with respect to the old one. Give both."
            )
        given = self.jacobian(before.copy()) if callable(self.jacobian) else self.jacobian
        J = real_array("jacobian", given)
        if J.shape not in ((n, n), (n, size)):
            raise ValueError(f"continue_to: jacobian has shape {J.shape}, expected {(n, n)}.")
        if callable(y):
            way = (np.abs(before) + np.abs(before).max(initial=0.0)) * random_directions(n, False)[0]
            right = difference_gradient(lambda s: y(before + s[0] * way), np.zeros(1), np.full(1, 1e-2))[..., 0]
            if np.abs(J[:, :n] @ way - right).max() > WRONG_JACOBIAN * max(np.abs(right).max(), np.abs(way).max()):
                raise ValueError(
                    "continue_to: jacobian is not the derivative of y(state): along a random direction it gives "
                    f"{shown(J[:, :n] @ way)}, and differences of y give {shown(right)}. Correct jacobian."
                )
        return J


def _bound(arguments: dict[str, Any]) -> tuple[BoundProblem, tuple[Invariant, ...]]:
    """Return the right-hand side and the invariants of a run with these arguments of `integrate`, without vectors."""
    request = RunArguments.of(**arguments | {"variations": None, "jvp": None, "symplectic": None})
    problem, projection = as_problem(request, request.method.TABLEAU, request.method)
    return problem, projection.invariants


def _values(problem: BoundProblem, items: Sequence[Invariant], t: float, y: Array) -> list[Array]:
    """Return the values of each invariant at a state."""
    return [np.ravel(item.function(t, y.copy(), *item.args, *problem.extra)) for item in items]


def with_functions(result: IntegrationResult, options: dict[str, Any]) -> tuple[Origin, dict[str, Any]]:
    """Return the origin of a result, and the options that remain; a loaded result takes its functions from these."""
    origin: Origin | None = vars(result).get("_origin")
    if origin is None:
        raise ValueError(
            "continue_to: this result does not know its functions, because it was unpickled or copied, or because they "
            "raised an error when it was saved. Save and load it instead, or continue from its last state: "
            "integrate(fun, (result.t[-1], t), result.y[:, -1], ...)."
        )
    if origin.loaded is None:
        return origin, options
    stored, options = origin.loaded, dict(options)
    given = {name: options.pop(name, None) for name in ("fun", "acceleration", "invariants")}
    if given["fun"] is None and given["acceleration"] is None:
        raise ValueError(
            "continue_to: a file does not hold functions. Give the loaded run those that it had: fun= or "
            "acceleration=, and invariants= unless fun is a Problem."
        )
    if missing := [name for name in stored["missing"] if name not in options]:
        raise ValueError(
            f"continue_to: the file of this run could not hold its {' and '.join(missing)}; give the loaded run the "
            "same again, or events=() to continue without events."
        )
    arguments = origin.arguments | {name: given[name] for name in ("fun", "acceleration")}
    if given["invariants"] is not None or not isinstance(given["fun"], Problem):
        arguments["invariants"] = as_invariants(() if given["invariants"] is None else given["invariants"])
    else:
        del arguments["invariants"]
    if (events := options.get("events")) is not None and len(as_events(events)) == len(result.t_events or ()):
        arguments["events"] = options.pop("events")  # the same again, which go on counting
    method: Any = options.get("method") or arguments["method"] or default_method(given["fun"])
    at_end = {"method": method, "t_span": (origin.t, origin.t + origin.sign), "y0": origin.y}
    problem, items = _bound(arguments | at_end)
    values = _values(problem, items, origin.t, origin.y)
    _require_stored(origin, problem.derivative(origin.t, origin.y), values)
    parts = np.split(stored["targets"], np.cumsum([value.size for value in values], dtype=int))[:-1]
    items = with_targets(items, [None if np.isnan(x).any() else x for x in parts])
    origin = origin._replace(
        arguments=arguments, loaded=None, kept=lambda: items, values=lambda: np.concatenate([*values, np.zeros(0)])
    )
    return origin, options


def _require_stored(origin: Origin, f: Array, values: list[Array]) -> None:
    """Raise ValueError if functions differ at the last state from those of the run that was saved."""
    stored: Any = origin.loaded
    found = np.concatenate([f, *values])
    there = np.concatenate([stored["f"], stored["values"]])
    if found.shape != there.shape:
        raise ValueError(
            f"continue_to: the run had invariants with {stored['values'].size} values ({', '.join(origin.names)}), and "
            f"those given have {found.size - f.size}. Give the loaded run the invariants that it had."
        )
    sizes = np.concatenate([np.full(f.size, np.abs(stored["f"]).max(initial=0.0)), origin.terms])
    names = ["fun"] * f.size + [f"the invariant {name!r}" for name in origin.names]
    advice = "Give the loaded run the functions that it had; change them in a later call."
    _require_same(origin, names, there, found, sizes, advice)


def _require_same_functions(origin: Origin) -> None:
    """Raise ValueError if an invariant has another value in the last state now than at the end of the run."""
    if origin.before is None:
        return  # the last state was not saved, or the run was loaded
    names = [f"the invariant {name!r}" for name in origin.names]
    advice = (
        "Its function, or a value that it uses, has changed since the first run. Give a change to continue_to instead: "
        "params=..., fun=..., invariants=..."
    )
    sizes = np.maximum(np.abs(origin.before), origin.terms)
    _require_same(origin, names, origin.before, origin.values(), sizes, advice)


def _require_same(origin: Origin, names: Sequence[str], there: Array, now: Array, sizes: Array, advice: str) -> None:
    """Raise ValueError with this advice if values at the last state of a run differ, up to terms of `sizes`."""
    k = first_difference(there, now, sizes)
    if k is not None:
        raise ValueError(
            f"continue_to: {names[k]} was {there[k]:.12g} at t={origin.t:.10g} and is {now[k]:.12g} in the same state "
            f"now. {advice}"
        )


def _events(arguments: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the events of a run with these arguments of `integrate`, by default those of its problem."""
    events, fun = arguments["events"], arguments["fun"]
    return as_events(fun.events if events is None and isinstance(fun, Problem) else events)


def _joined(
    one: IntegrationResult, first: Origin, two: IntegrationResult, changes: dict[str, Any], what: str
) -> IntegrationResult:
    """Return one result for a run, which has the origin `first`, and its continuation, which begins with `changes`."""
    last = vars(two)["_origin"]
    before, after = (
        [getattr(event, "pointer", event) for event in _events(origin.arguments)] for origin in (first, last)
    )
    if changes or any(name in one for name in OBSERVED):  # the functions that compute them may have changed
        one._observe()
        two._observe()
    two["restarts"] = [(first.t, what)] if what else []
    grown = dict(vars(one).get("_grown", {}))
    fields = joined(one, two, grown, apart=bool(changes), but=() if before == after else OF_EVENTS)
    both = IntegrationResult(fields)
    trust, known = one.diagnostics._trust, both.diagnostics._trust.doubts
    if one.status < 0 and first.ended == used_up(first.arguments.get("max_steps") or 0, first.t):
        both["trusted"] = two.trusted and not (trust.doubts or trust.exceeds_bounds)
    elif one.status < 0:
        known.append(f"the part of the run up to t={first.t:.6g} did not end regularly: {first.ended}")
    last = last._replace(notes=tuple(dict.fromkeys(first.notes + last.notes)))
    both["message"] = described(last.ended, both.diagnostics, last.notes)
    object.__setattr__(both, "_origin", last)
    object.__setattr__(both, "_grown", grown)
    return both
