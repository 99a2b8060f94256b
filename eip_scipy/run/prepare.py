"""Preparation of a run from the arguments of `integrate`, of which `as_problem` is the door; ensembles share it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..core.bound_problem import FORMS, BoundProblem
from ..core.derivatives import First
from ..core.events import Events, JittedEvent, as_events, replaced
from ..core.functions import (
    GRADIENT,
    AccelerationField,
    PointerFunction,
    are_same,
    by_pointer,
    extra_arguments,
    floats,
    is_compiled,
    is_jitted,
)
from ..core.inputs import count, flag, initial_state, real_array, shown
from ..core.invariants import as_invariants, with_args
from ..core.particles import compiled_items
from ..core.problem import PROBLEM_DEFAULTS, Problem
from ..core.projection import ProjectionOptions
from ..core.results import Diagnostics
from ..core.runs import Run
from ..core.solvers import EIPSolver, class_named, eip_method
from ..core.step_control import ATOL, StepControl, interval
from ..core.tangent_vectors import tangent_vectors
from ..core.variations import Variations, augmented_rhs
from ..engine.data import NFEV, Schedule, Span
from ..engine.native import LibraryFunction
from ..methods.base import Method
from ..methods.implicit import Jacobian
from .driver import check_bytes, check_memory, saved_rows
from .resume import plain, settings

__all__ = [
    "DEFAULT",
    "RunArguments",
    "as_problem",
    "check_watching",
    "default_method",
    "identity",
    "prepared",
    "started_at",
]


class _Default:
    def __repr__(self) -> str:
        return "<default>"

    def __reduce__(self) -> str:
        return "DEFAULT"


DEFAULT: Any = _Default()


class RunArguments(NamedTuple):
    """The arguments of `integrate` as given; `projection` contains only the projection options that were given."""

    fun: Any = None
    acceleration: Any = None
    t_span: Any = None
    y0: Any = None
    method: Any = None
    h: Any = DEFAULT
    args: Any = None
    params: Any = None
    in_place: bool = False
    jacobian: Any = None
    jac: Any = None
    variations: Any = None
    jvp: Any = None
    symplectic: Any = None
    save_every: Any = None
    t_eval: Any = None
    events: Any = None
    dense_output: bool = False
    callback: Any = None
    progress: bool = False
    compiled: bool | None = None
    max_bytes: Any = None
    diagnostics: Any = None
    rtol: Any = DEFAULT
    atol: Any = DEFAULT
    first_step: Any = None
    max_step: Any = np.inf
    max_steps: int | None = None
    projection: Mapping[str, Any] = MappingProxyType({})

    @classmethod
    def of(cls, **keywords: Any) -> RunArguments:
        """Return the arguments made from keywords, including options of the projection."""
        projection, others = ProjectionOptions.split(keywords)
        return cls(projection=projection, **others)

    def sendable(self) -> RunArguments:
        """Return the arguments in a form for other processes: jitted events keep their attributes.

        C functions are wrapped, so that an error says why they cannot be pickled.
        """
        fun, acceleration = by_pointer(self.fun, "fun"), by_pointer(self.acceleration, "acceleration")
        jacobian = by_pointer(self.jacobian, "jacobian", GRADIENT, takes_f=True)
        events = self.fun.events if self.events is None and isinstance(self.fun, Problem) else self.events
        items = as_events(events)
        events = replaced(items, [JittedEvent(item) if is_jitted(item) else item for item in items]) or events
        return self._replace(fun=fun, acceleration=acceleration, events=events, jacobian=jacobian)

    def steps(self, own: Problem | None, method: Method) -> dict[str, Any]:
        """Return the options of the step size: the step of the problem, or the defaults, for what was not given."""
        h, no_bound = self.h, isinstance(self.max_step, float) and self.max_step == np.inf
        if h is DEFAULT:
            adaptive = not (self.rtol is DEFAULT and self.atol is DEFAULT and self.first_step is None and no_bound)
            h = None if own is None or adaptive or method.drives else own.h
        rtol, atol = 1e-3 if self.rtol is DEFAULT else self.rtol, ATOL if self.atol is DEFAULT else self.atol
        control = {"first_step": self.first_step, "max_step": self.max_step}
        return {"h": h, **control, "rtol": rtol, "atol": atol}


def prepared(given: RunArguments, *, check_start: bool = True) -> Run:
    """Check the arguments of `integrate`, and return a run at its start; for `check_start` see `Run.start_at`."""
    own = given.fun if isinstance(given.fun, Problem) else None
    solver: Any = default_method(own) if given.method is None else given.method
    method = _method(solver)
    _check_choices(given)
    problem, projection = as_problem(given, method, solver)
    events, t_span = problem.events, _start(given, own)[0]
    ends = t0, t_bound = interval(t_span)
    if math.isinf(t_bound) and not (events.terminal or (given.callback is not None and given.save_every is not None)):
        raise ValueError(
            f"t_span must be finite unless a terminal event ends the run, got {shown(t_span)}; a callback may "
            "end it too, at the steps that save_every=... saves."
        )
    stepping = StepControl.of(solver.__name__, method, ends, problem.n, **given.steps(own, method))
    run = Run(problem, solver.__name__, method, stepping, projection).start_at(problem.y0, check=check_start)
    run.schedule = schedule = _schedule(stepping.span, run.start.tau, given, events)
    check_memory(saved_rows(schedule), run, given.max_bytes)
    # `attach` sets all attributes of a new record.
    run.attach(Diagnostics.__new__(Diagnostics) if given.diagnostics is None else given.diagnostics)
    schedule.g[:] = events.at_start(t0, run.y0, run.start.f, run.start.tau * schedule.span.sign)
    run.work.K[0] = run.start.f
    run.work.counters[NFEV] = problem.count
    return run


def as_problem(given: RunArguments, method: Method, solver: Any) -> tuple[BoundProblem, ProjectionOptions]:
    """Look at a user's functions, arguments, start and options, and return what a run needs.

    `method` is that of the class `solver`, for which implicit methods keep other invariants by default.
    """
    own = given.fun if isinstance(given.fun, Problem) else None
    fun, form = _function(given, own)
    extra = extra_arguments(given.args, given.params if own is None else _parameters(given, own))
    y0 = initial_state(_start(given, own)[1])
    if y0.size == 0:
        raise ValueError("y0 is empty; integrate needs a state with at least one component.")
    events = as_events(own.events if own is not None and given.events is None else given.events)
    jacobian, acc = by_pointer(given.jacobian, "jacobian", GRADIENT, takes_f=True), None
    if own is not None:
        jacobian = own.jacobian if jacobian is None else jacobian
        acc = own.acc if method.of_second_order else None
    if given.jac is not None and not method.drives:
        name = solver.__name__
        raise TypeError(f"jac is the Jacobian for EIPRadau and EIPBDF, but {name} does not use one. Omit jac.")
    projection, variations = _projection(given, own, fun, method, extra), None
    if given.variations is not None:
        variations = _variations(given, own, fun, form, y0, extra, solver, projection)
        fun, form, acc, jacobian = variations.rhs, FORMS[False, True], None, None
        y0 = variations.tangents.augmented(y0, floats(extra))
        events = replaced(events, map(variations.event, events))
        projection = replace(projection, invariants=variations.invariants)
    elif given.jvp is not None or given.symplectic is not None:
        raise TypeError("jvp and symplectic need variations=...; pass variations, or omit jvp and symplectic.")
    functions = [fun, *(item.function for item in projection.invariants)]
    return BoundProblem(
        fun, y0, form, extra, problem=own, events=Events(events, extra) if events else None, acc=acc, jacobian=jacobian,
        jac=Jacobian(given.jac), variations=variations, explains=True,
        by_address=given.compiled is not False and all(map(is_jitted, functions)),
    ), projection  # fmt: skip


def _function(given: RunArguments, own: Problem | None) -> tuple[Any, str]:
    """Return the function that the engine calls, and its form in `FORMS`; C functions so that Python can call them."""
    fun: Any = given.fun
    in_place, name = flag("in_place", given.in_place), "fun"
    if given.acceleration is not None:
        if fun is not None:
            raise TypeError(
                "give fun or acceleration, not both: acceleration=a replaces fun(t, y) = (v, a(t, q)) with "
                "y = (q, v), and a Problem has its own function."
            )
        fun, name = given.acceleration, "acceleration"
    elif fun is None:
        raise TypeError("integrate: fun is missing; give a function fun(t, y), a Problem, or acceleration=a(t, q).")
    elif own is not None:
        fun, in_place = (own.fun, False) if own.rhs is None else (own.rhs, True)
    elif isinstance(fun, AccelerationField):
        fun, in_place, name = fun.acceleration, fun.in_place, "acceleration"
    fun = by_pointer(fun, name)
    if not callable(fun):
        what = "callable or a Problem" if name == "fun" else "callable"
        raise TypeError(f"integrate: {name} must be {what}, got {fun!r}.")
    return fun, FORMS[name == "acceleration", in_place or isinstance(fun, PointerFunction)]


def _parameters(given: RunArguments, own: Problem) -> Any:
    """Return the option `params`, with values that a problem has or knows by name."""
    if given.args is not None:
        raise TypeError("args: a Problem has params; pass params=..., or its functions instead of the Problem.")
    if isinstance(given.params, Mapping):
        return own.named_parameters(given.params)
    return own.params if given.params is None and own.rhs is not None else given.params


def _projection(given: RunArguments, own: Problem | None, fun: Any, method: Method, extra: tuple) -> ProjectionOptions:
    """Return the options of the projection, completed by those of the problem and by defaults for compiled functions.

    Invariants lose args that equal the last arguments of the run, which are passed to them anyway.
    """
    options, known = dict(given.projection), [extra]
    if own is not None:
        brought = {name: getattr(own, name) for name in PROBLEM_DEFAULTS}
        if own.linear_invariants is None:
            del brought["linear_invariants"]  # they may be found
        elif isinstance(options.get("linear_invariants"), str):
            del options["linear_invariants"]
        if method.drives:
            brought["invariants"] = own.stiff_invariants
        options = brought | options
        if own.params is not None:
            known.insert(0, (own.params,))  # the same object as in the problem's own invariants
    items = as_invariants(options.get("invariants", ()))
    if any([item.args for item in items]):
        known = [args for args in known if args]
        items = tuple(with_args(x, ()) if any(are_same(x.args, args) for args in known) else x for x in items)
    if is_compiled(fun) or isinstance(fun, PointerFunction):
        items = compiled_items(items)
        if not isinstance(fun, LibraryFunction):  # problems have their own
            options.setdefault("linear_invariants", "auto")
    return ProjectionOptions(**options | {"invariants": items})


def _variations(
    given: RunArguments,
    own: Problem | None,
    fun: Any,
    form: str,
    y0: np.ndarray,
    extra: tuple,
    solver: Any,
    projection: ProjectionOptions,
) -> Variations:
    """Return the `Variations` for the option `variations`."""
    if given.symplectic is not None:
        flag("symplectic", given.symplectic)
    names = () if own is None else tuple(own.parameters)
    tangents = tangent_vectors(given.variations, solver, y0, floats(extra), names)
    if projection.project_initial and tangents.parameters:
        raise ValueError(
            "variations: project_initial cannot be combined with derivatives with respect to parameters. Omit it, "
            "and pass y0 = eip_scipy.project(y0, ...).y."
        )
    first = First(interval(_start(given, own)[0])[0], y0, extra)
    items = projection.invariants
    canonical, variational = (False, None) if own is None else (own.canonical, own.variational)
    reason = None if items else "without invariants no step is projected; give the energy, at least"
    if solver.TABLEAU.has_history:
        reason = "a multistep method projects no vectors; use EIPRKN12"
    tangents = tangents.kept_symplectic(given.symplectic, canonical, reason)
    rhs, source = augmented_rhs(tangents, fun, form, first, given.jvp, variational)
    return Variations.of(tangents, rhs, source, first, items)


def default_method(fun: Any) -> type[EIPSolver] | None:
    """Return the solver class of a problem's own method, or None if there is none."""
    return eip_method(fun.method) if isinstance(fun, Problem) and fun.method is not None else None


def _start(given: RunArguments, own: Problem | None) -> list[Any]:
    """Return t_span and y0; those of the problem for what is not given."""
    found = []
    for name in ("t_span", "y0"):
        value = getattr(given, name)
        if value is None and own is not None:
            value = getattr(own, name)
        if value is None:
            raise TypeError(f"integrate: {name} is missing; it can be omitted only for a Problem that has its own.")
        found.append(value)
    return found


def started_at(given: RunArguments) -> tuple[float, np.ndarray]:
    """Return time and state at the start; those of the problem if none are given."""
    t_span, y0 = _start(given, given.fun if isinstance(given.fun, Problem) else None)
    return interval(t_span)[0], initial_state(y0)


def _method(method: Any) -> Any:
    if method is None:
        raise TypeError(
            "integrate: method is missing. Use EIPDOP853 with rtol=1e-9 for adaptive steps, EIPRK4 with h=... for "
            "fixed steps, or EIPRKN12 for q'' = a(t, q); eip_scipy.recommend(...) finds method and step."
        )
    if not (isinstance(method, type) and issubclass(method, EIPSolver) and hasattr(method, "TABLEAU")):
        hint = "" if (name := class_named(method)) is None else f". Give the class: from eip_scipy import {name}"
        raise TypeError(
            f"integrate: method must be an EIP class such as EIPRK4, or a class made by eip_method; got {method!r}"
            f"{hint}."
        )
    return method.TABLEAU


def _check_choices(request: RunArguments) -> None:
    compiled = request.compiled
    check_watching(request.callback, request.progress, request.max_steps)
    flag("dense_output", request.dense_output)
    if compiled is not None and not isinstance(compiled, (bool, np.bool_)):
        raise ValueError(f"compiled must be True, False or None (compile if possible), got {shown(compiled)}.")
    check_bytes(request.max_bytes)


def check_watching(callback: Any, progress: Any, max_steps: Any) -> None:
    """Check the options `callback`, `progress` and `max_steps`."""
    if callback is not None and not callable(callback):
        raise TypeError(f"callback must be a function callback(t, y, residuals), got {shown(callback)}.")
    flag("progress", progress)
    if max_steps is not None:
        count("max_steps", max_steps)


def _schedule(span: Span, tau: float, request: RunArguments, events: Events) -> Schedule:
    save_every, t_eval, times = request.save_every, request.t_eval, np.zeros(0)
    if t_eval is not None:
        if save_every is not None:
            raise ValueError("give save_every or t_eval, not both.")
        times = evaluation_times(t_eval, span.t0, span.t_bound)
    every, n = 0 if save_every is None else count("save_every", save_every), len(events.functions)
    return Schedule(
        span=span, save_every=every, t_eval=times, place=np.zeros(3, np.int64),
        clock=np.array([span.t0, span.t0, 0.0, tau]), g=np.zeros(n), g_new=np.zeros(n), rate=np.array([math.nan] * n),
        rate_new=np.zeros(n), g_direction=events.directions,
    )  # fmt: skip


def evaluation_times(t_eval: Any, t0: float, t_bound: float) -> np.ndarray:
    """Return the times of `t_eval`, checked as SciPy does."""
    times = real_array("t_eval", t_eval)
    if times.ndim != 1 or times.size == 0:
        raise ValueError("`t_eval` must be 1-dimensional and not empty.")
    if not np.isfinite(times).all():
        raise ValueError("t_eval must be finite.")
    if np.any(times < min(t0, t_bound)) or np.any(times > max(t0, t_bound)):
        raise ValueError("Values in `t_eval` are not within `t_span`.")
    if np.any(np.sign(t_bound - t0) * np.diff(times) <= 0):
        raise ValueError("Values in `t_eval` are not properly sorted.")
    return times


def identity(run: Run, y0: Any, params: Any) -> dict[str, Any]:
    """Return all settings except functions, by users' names, that determine the result of a run to the last bit."""
    found = settings(run.name, y0, params, run, run.schedule, run.problem.events)
    return found | {name: plain(value) for name, value in run.tangents.identity.items() if run.problem.variations}
