"""Preparation of a run: from the arguments of `integrate` to a run that is ready to step; ensembles share it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..core.acceleration import BY_NAME, AccelerationField
from ..core.arguments import Packed, are_same, extra_arguments, floats, names, scalars
from ..core.driven import Jacobian
from ..core.inputs import count, flag, real_array, require_arguments, shown
from ..core.invariants import as_invariants, with_args
from ..core.jitted import NotCompilableError, is_compiled
from ..core.multistep import times
from ..core.native_functions import native_functions, with_events
from ..core.options import ProjectionOptions
from ..core.particles import compiled_items
from ..core.pointers import GRADIENT, PointerFunction, by_pointer
from ..core.problem import BROUGHT, Problem, made
from ..core.results import Diagnostics
from ..core.run_spec import RunSpec
from ..core.runs import Counted, Run
from ..core.solvers import EIPSolver, class_named, eip_method
from ..core.states import as_derivative, initial_state
from ..core.stepping import ATOL, StepOptions, Stepping, interval
from ..core.variations import Variations, asked_columns, kept_symplectic, require_tableau, right_hand_side
from ..engine.data import NFEV, Schedule, Span
from ..engine.native import LibraryFunction, NativeFunctions, PythonFunctions, call
from .driver import check_memory, saved_rows
from .events import Events, as_events, replaced
from .interpreted_functions import FORMS, interpreted
from .memory import check_bytes
from .resume import plain, settings

__all__ = ["DEFAULT", "Prepared", "Request", "default_method", "prepared", "started_at"]

CALLED = "fun", "It takes (t, y), then out if in_place=True, then the arguments from params=... or args=(...)."
CALLED_ACCELERATION = (
    "acceleration",
    "It takes (t, q), then out if in_place=True, then the arguments from params=... or args=(...). If accelerations "
    "depend on the velocity, pass the right-hand side fun(t, y) of y = (q, v) instead.",
)


class _Default:
    def __repr__(self) -> str:
        return "<default>"

    def __reduce__(self) -> str:
        return "DEFAULT"


DEFAULT: Any = _Default()


class Request(NamedTuple):
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
    projection: Mapping[str, Any] = MappingProxyType({})

    @classmethod
    def of(cls, **keywords: Any) -> Request:
        """Return a request made from keywords, including projection options."""
        projection, others = ProjectionOptions.split(keywords)
        return cls(projection=projection, **others)

    def with_own_events(self) -> Request:
        """Return the request with the events of its problem if no others are given."""
        has_own = self.events is None and isinstance(self.fun, Problem) and self.fun.events is not None
        return self._replace(events=self.fun.events) if has_own else self

    def with_pointers(self) -> Request:
        """Return the request with C functions wrapped so that Python can call them."""
        given = self.fun, self.acceleration, self.jacobian
        if self.events is None and all(item is None or isinstance(item, Problem) for item in given):
            return self
        jacobian = by_pointer(self.jacobian, "jacobian", GRADIENT, takes_f=True)
        fun, acceleration = by_pointer(self.fun, "fun"), by_pointer(self.acceleration, "acceleration")
        return self._replace(fun=fun, acceleration=acceleration, events=as_events(self.events), jacobian=jacobian)

    @property
    def function(self) -> Any:
        """Return the function that was given as the right-hand side or as the acceleration."""
        return self.fun if self.acceleration is None else self.acceleration

    @property
    def adaptive(self) -> bool:
        """Return True if an option of adaptive steps was given: `rtol`, `atol`, `first_step` or `max_step`."""
        no_bound = isinstance(self.max_step, float) and self.max_step == np.inf
        return not (self.rtol is DEFAULT and self.atol is DEFAULT and self.first_step is None and no_bound)

    @property
    def steps(self) -> StepOptions:
        """Return the options of the step size, with the defaults for those that were not given."""
        return StepOptions(
            h=None if self.h is DEFAULT else self.h,
            first_step=self.first_step,
            max_step=self.max_step,
            rtol=1e-3 if self.rtol is DEFAULT else self.rtol,
            atol=ATOL if self.atol is DEFAULT else self.atol,
        )


class System:
    """The user's functions of a run: `fun` as given, and `rhs`, the interpreted form that the loop calls.

    `form` is the form of `fun`, a name in `FORMS`. `acc` is the acceleration of a problem that has one, if the method
    needs nothing else.
    """

    def __init__(self, request: Request, form: str, acc: Any) -> None:
        self.fun, self.form = request.fun, form
        self.extra = extra_arguments(request.args, request.params)
        self.parameters = floats(self.extra)
        self.events = Events(request.events, self.extra)
        self.acc, self.jacobian, self.jac = acc, request.jacobian, request.jac
        if self.jacobian is not None and not callable(self.jacobian):
            raise TypeError(
                f"jacobian must be a function jacobian(t, q, dq, out[, params]), got {shown(self.jacobian)}."
            )
        self.rhs: Callable[..., None]  # for states of the shape and type of y0, set when these are known

    @property
    def name(self) -> str:
        """Name of the argument of `integrate` with which the function was given."""
        return "acceleration" if self.form.startswith("acceleration") else "fun"

    @property
    def left_out(self) -> str:
        """Return a possible cause of NaN in the value of the function, for messages; "" if none is known."""
        if isinstance(self.fun, PointerFunction):
            return "components are NaN if the C function does not fill them, and all are if its status is above 0"
        return "with in_place=True it must fill all of out" if "in place" in self.form else ""

    def derivative(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the derivative at (t, y) as a new array; raise TypeError if the function takes other arguments."""
        out = np.empty_like(y)
        try:
            self.rhs(t, y, out)
        except TypeError:
            third = ("out",) if "in place" in self.form else ()
            state, called = ("y", CALLED) if self.name == "fun" else ("q", CALLED_ACCELERATION)
            require_arguments(self.fun, ("t", state, *third, *names(self.extra)), *called)
            raise
        return out

    def product(self) -> Callable[..., np.ndarray] | None:
        """Return the option `jacobian`, made now if it is `Deferred`, as ``product(t, q, dq)``; None without it."""
        self.jacobian = made(self.jacobian)
        return None if self.jacobian is None else times(self.jacobian, *self.extra)

    def matrix(self) -> Jacobian:
        """Return the option `jac`, with the arguments of `fun` bound, as SciPy's implicit solvers take it."""
        jac = self.jac
        return Jacobian((lambda t, y: jac(t, y, *self.extra)) if callable(jac) and self.extra else jac)

    def functions(self, run: Run, wanted: bool | None) -> tuple[PythonFunctions | NativeFunctions, str | None]:
        """Return the functions that the loop calls, and None if all are called natively.

        Otherwise the second item is a text that says which functions are called from Python, and why. `wanted` is the
        option `compiled`; if it is True, NotCompilableError is raised instead.
        """
        numbers = scalars(self.extra)
        if wanted is False:
            return self._in_python(run), "interpreted: compiled=False"
        try:
            if run.tableau.in_python:
                kind = "a solver" if run.tableau.drives else "a one-step method"
                raise NotCompilableError(f"{run.tableau.name} is {kind} in Python")
            if numbers is None:
                raise NotCompilableError("args are neither numbers nor one array of floats")
            params = Packed(self.parameters, numbers) if self.extra else None
            functions = native_functions(*self.native_form, params, run, self.jacobian if self._corrects(run) else None)
        except NotCompilableError as reason:
            if wanted:
                raise
            return self._in_python(run), f"interpreted: {reason}"
        if not self.events.functions:
            return functions, None
        try:
            return with_events(functions, self.events.functions, params, run.y0), None
        except NotCompilableError as reason:
            if wanted:
                raise
            return functions._replace(python=self._in_python(run)), f"events are called from Python: {reason}"

    @cached_property
    def native_form(self) -> tuple[Any, str]:
        """Return the function to compile and its form: `acc` if it comes from the same library as `fun`, else `fun`."""
        own = isinstance(self.fun, LibraryFunction) and isinstance(self.acc, LibraryFunction)
        if own and self.fun.__name__.partition(".")[0] == self.acc.__name__.partition(".")[0]:
            return self.acc, "acceleration"
        return self.fun, self.form

    def calls(self, run: Run, functions: PythonFunctions | NativeFunctions) -> dict[str, str]:
        """Return how each function is called, as the attribute `calls` of `IntegrationResult`."""

        def kind(fun: Any, in_python: bool) -> str:
            if in_python:
                return "python"
            if isinstance(fun, LibraryFunction):
                return "native"
            return "pointer" if isinstance(fun, PointerFunction) else "jitted"

        in_python = isinstance(functions, PythonFunctions)
        found = {self.name: kind(self.fun, in_python)}
        for wide, label in zip(run.invariants.items, run.invariants.labels, strict=True):
            item = wide if wide.of_state is None else wide.of_state.function
            found[label] = kind(item.function, in_python)
            differences = item.gradient is None and not in_python
            found[f"gradient of {label}"] = "differences" if differences else kind(item.gradient, in_python)
            if item.rate_function is not None:
                found[f"rate of {label}"] = kind(item.rate_function, in_python)
        if self._corrects(run):
            found["jacobian"] = kind(self.jacobian, in_python)
        in_python = isinstance(functions, PythonFunctions) or functions.python is not None
        return found | {f"event {k}": kind(event, in_python) for k, event in enumerate(self.events.functions)}

    def _corrects(self, run: Run) -> bool:
        history = run.method.multistep
        return history is not None and history.corrected_count > 0

    def _in_python(self, run: Run) -> PythonFunctions:
        n, dtype = run.y0.size, run.y0.dtype
        second_order, in_place = self.form.startswith("acceleration"), "in place" in self.form
        size = n // 2 if second_order else n

        def convert(f: Any, t: float) -> np.ndarray:
            return np.array(as_derivative(f, size, dtype, t, self.name), dtype, order="C")

        rhs = call(self.fun, self.extra, (size,), convert, in_place=in_place)
        jacobian = None
        if self._corrects(run):
            jacobian = call(self.jacobian, self.extra, (n // 2,), convert, in_place=True, takes_f=True)
        rates = run.invariants.rates(run.options.adaptive)
        return PythonFunctions(rhs, *run.invariants.calls, self.events.calls, second_order, jacobian, rates)


@dataclass
class Prepared:
    """A validated run whose functions have not been compiled yet.

    `asked` is the request as given; `request` also contains what a problem provides.
    """

    asked: Request
    request: Request
    system: System
    schedule: Schedule
    run: Run
    diagnostics: Diagnostics
    variations: Variations | None = None

    @property
    def n(self) -> int:
        """Return the number of components of the user's state."""
        return self.run.y0.size if self.variations is None else self.variations.columns.n

    @property
    def label(self) -> str:
        """Name of the method's class."""
        return str(self.request.method.__name__)

    @property
    def described_columns(self) -> dict[str, Any]:
        """Return the field ``columns`` of a result of this run, which carries derivatives."""
        assert self.variations is not None
        columns = self.variations.columns
        known = {} if self.problem is None else dict(enumerate(self.problem.parameters))
        return {
            "state": columns.is_transition,
            "parameters": len(columns.parameters),
            "names": [known.get(k, f"params[{k}]") for k in columns.parameters],
            "symplectic": columns.symplectic,
            "source": self.variations.source,
        }

    @property
    def problem(self) -> Problem | None:
        """Return the problem, if one was given instead of a function."""
        return self.asked.fun if isinstance(self.asked.fun, Problem) else None

    @property
    def component_names(self) -> tuple[str, ...] | None:
        """Names of the components from the problem, or None if it has none for this state."""
        names = None if self.problem is None else self.problem.component_names
        return names if names is not None and len(names) == self.n else None

    @property
    def pointers(self) -> list[PointerFunction]:
        """Return the C functions given as pointers."""
        items = self.run.invariants.items
        functions = [self.system.fun, *self.system.events.functions]
        functions += [function for item in items for function in (item.function, item.gradient, item.rate_function)]
        return [function for function in functions if isinstance(function, PointerFunction)]

    def identity(self, y0: Any, params: Any) -> dict[str, Any]:
        """Return all settings except functions, by users' names, that determine the result of a run to the last bit."""
        found = settings(self.label, y0, params, self.run, self.schedule, self.system.events)
        if self.variations is not None:
            found |= {name: plain(value) for name, value in self.variations.columns.identity.items()}
        return found


def prepared(request: Request, *, check_start: bool = True) -> Prepared:
    """Check a request and prepare its run; for `check_start` see `RunSpec.build`."""
    request = _with_named_parameters(request).with_own_events()
    if request.method is None:
        request = request._replace(method=default_method(request.fun))
    method = _method(request.method)
    _check_choices(request)
    if request.jac is not None and not method.drives:
        raise TypeError(
            f"jac is the Jacobian for EIPRadau and EIPBDF, but {request.method.__name__} does not use one. Omit jac."
        )
    asked, request = request, request.with_pointers()
    acc = request.fun.acc if method.of_second_order and isinstance(request.fun, Problem) else None
    request, form = _with_problem(request)
    if is_compiled(request.fun) or isinstance(request.fun, PointerFunction):
        request = _with_linear_invariants(request)
    variations = _variations(asked.fun, request, form)
    if variations is not None:
        request, form, acc = _widened(request, variations), FORMS[False, True], None
    system = System(request, form, acc)
    t0, t_bound = _span(request, system.events)
    y0 = _state(request.y0)
    n = y0.size if variations is None else variations.columns.n
    stepping = request.steps.checked(request.method.__name__, method, t0, t_bound, n, stacklevel=4)
    system.rhs = interpreted(form, system.fun, system.extra, y0)
    calls = Counted(system.derivative)
    spec = _spec(asked.fun, request, system, calls, stepping)
    if variations is not None:
        hint = (
            f"components from {variations.columns.n} on are derivatives, which overflow in long chaotic runs: shorten "
            "the interval, or use megno or lyapunov_spectrum, which rescale them"
        )
        spec = spec._replace(columns=variations.columns, left_out=hint)
    run = spec.build(y0, check_start=check_start)
    schedule = _schedule(stepping.span, run.start.tau, request, system.events)
    check_memory(saved_rows(schedule), run, request.max_bytes)
    # `attach` sets all attributes of a new record.
    record = Diagnostics.__new__(Diagnostics) if request.diagnostics is None else request.diagnostics
    run.attach(record)
    schedule.g[:] = system.events.values(t0, run.y0)
    run.work.K[0] = run.start.f
    system.events.leave(t0, run.y0, run.work.K[0], run.start.tau * schedule.span.sign, schedule.g)
    run.work.counters[NFEV] = calls.count
    return Prepared(asked, request, system, schedule, run, record, variations)


def _with_linear_invariants(request: Request) -> Request:
    """Return the request of a run with a compiled function, which keeps linear invariants unless another is asked.

    Ready problems have frames of their own.
    """
    own = {} if isinstance(request.fun, LibraryFunction) else {"linear_invariants": "auto"}
    projection = own | dict(request.projection)
    if "invariants" in projection:
        projection["invariants"] = compiled_items(as_invariants(projection["invariants"]))
    return request._replace(projection=projection)


def _spec(given: Any, request: Request, system: System, calls: Counted, stepping: Stepping) -> RunSpec:
    """Return the specification of the run; `given` is the function or problem as given, `calls` the right-hand side."""
    problem = given if isinstance(given, Problem) else None
    return RunSpec(
        name=request.method.__name__,
        method=request.method.TABLEAU,
        rhs=calls,
        stepping=stepping,
        projection=ProjectionOptions(**request.projection),
        extra=system.extra,
        jacobian=system.matrix if request.method.TABLEAU.drives else system.product,
        frequencies=None if problem is None else problem.frequencies,
        hint=partial(_second_order_hint, given),
        called=system.name,
        left_out=system.left_out,
        sees_velocity=system.name == "fun" and (problem is None or problem.acc is None),
        is_second_order=system.native_form[1].startswith("acceleration"),
        uncounted=system.derivative,
    )


def _variations(given: Any, request: Request, form: str) -> Variations | None:
    """Return the `Variations` for the option `variations` of the request, or None if it was not given."""
    if request.variations is None:
        if request.jvp is not None or request.symplectic is not None:
            raise TypeError("jvp and symplectic need variations=...; pass variations, or omit jvp and symplectic.")
        return None
    require_tableau(request.method)
    y0 = _state(request.y0)
    problem = given if isinstance(given, Problem) else None
    extra = extra_arguments(request.args, request.params)
    projection = ProjectionOptions(**request.projection)
    if request.symplectic is not None:
        flag("symplectic", request.symplectic)
    names = () if problem is None else tuple(problem.parameters)
    columns = asked_columns(request.variations, y0, floats(extra), names, request.method.TABLEAU.of_second_order)
    if projection.project_initial and columns.parameters:
        raise ValueError(
            "variations: project_initial cannot be combined with derivatives with respect to parameters. Omit it, "
            "and pass y0 = eip_scipy.project(y0, ...).y."
        )
    own = None if problem is None else problem.variational
    t0 = interval(_required("t_span", request.t_span))[0]
    items = as_invariants(projection.invariants)
    canonical = problem is not None and problem.canonical
    columns = kept_symplectic(columns, request.symplectic, canonical, items)
    products = right_hand_side(columns, request.fun, form, t0, y0, extra, request.jvp, own)
    return Variations.of(columns, products, t0, y0, extra, items)


def _widened(request: Request, variations: Variations) -> Request:
    """Return the request for the state followed by its columns of derivatives, with functions for this longer state."""
    extra, events = extra_arguments(request.args, request.params), as_events(request.events)
    return request._replace(
        fun=variations.rhs,
        y0=variations.columns.wide(_state(request.y0), floats(extra)),
        jacobian=None,
        events=replaced(events, variations.events(events)),
        projection={**request.projection, "invariants": variations.invariants},
    )


def default_method(fun: Any) -> type[EIPSolver] | None:
    """Return the solver class of a problem's own method, or None if there is none."""
    return eip_method(fun.method) if isinstance(fun, Problem) and fun.method is not None else None


def started_at(request: Request) -> tuple[float, np.ndarray]:
    """Return time and state at the start; those of the problem if none are given."""
    t_span, y0 = _given_or_brought(request)
    return interval(t_span)[0], _state(y0)


def _with_named_parameters(request: Request) -> Request:
    """Return the request with the values of all parameters if some are given by name, which a `Problem` knows."""
    if not (isinstance(request.fun, Problem) and isinstance(request.params, Mapping)):
        return request
    return request._replace(params=request.fun.named_parameters(request.params))


def _second_order_hint(fun: Any) -> str:
    """Return advice on how to write the problem in (q, v) or how to pass an acceleration, for the end of a message."""
    if not isinstance(fun, Problem):
        return f". If fun is the acceleration a(t, q), {BY_NAME}"
    hint = "; problem.second_order() returns this problem in that form, for a start (q, v)"
    return hint if fun.has_second_order else ""


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


def _check_choices(request: Request) -> None:
    callback, compiled = request.callback, request.compiled
    if callback is not None and not callable(callback):
        raise TypeError(f"callback must be a function callback(t, y, residuals), got {shown(callback)}.")
    flag("progress", request.progress)
    flag("dense_output", request.dense_output)
    if compiled is not None and not isinstance(compiled, (bool, np.bool_)):
        raise ValueError(f"compiled must be True, False or None (compile if possible), got {shown(compiled)}.")
    check_bytes(request.max_bytes)


def _given_or_brought(request: Request) -> tuple[Any, Any]:
    """Return t_span and y0 of the request; those of the problem if they are not given."""
    problem, t_span, y0 = request.fun, request.t_span, request.y0
    if isinstance(problem, Problem):
        return problem.t_span if t_span is None else t_span, problem.y0 if y0 is None else y0
    return t_span, y0


def _function_and_form(fun: Any, in_place: bool) -> tuple[Any, str]:
    """Return the function that the engine calls, and the name of its form in `FORMS`."""
    acceleration = isinstance(fun, AccelerationField)
    if acceleration:
        fun, in_place = fun.acceleration, fun.in_place
    if not callable(fun):
        name, what = ("acceleration", "callable") if acceleration else ("fun", "callable or a Problem")
        raise TypeError(f"integrate: {name} must be {what}, got {fun!r}.")
    return fun, FORMS[acceleration, in_place or isinstance(fun, PointerFunction)]


def _with_problem(request: Request) -> tuple[Request, str]:
    """Return the request, completed by the attributes of its `Problem`, and its function's form, a name in `FORMS`."""
    t_span, y0 = _given_or_brought(request)
    projection, params = dict(request.projection), request.params
    problem, in_place = request.fun, flag("in_place", request.in_place)
    if request.acceleration is not None:
        if problem is not None:
            raise TypeError(
                "give fun or acceleration, not both: acceleration=a replaces fun(t, y) = (v, a(t, q)) with "
                "y = (q, v), and a Problem has its own function."
            )
        problem = AccelerationField(request.acceleration, in_place)
    elif problem is None:
        raise TypeError("integrate: fun is missing; give a function fun(t, y), a Problem, or acceleration=a(t, q).")
    if not isinstance(problem, Problem):
        projection |= _without_own(projection, extra_arguments(request.args, params))
        fun, form = _function_and_form(problem, in_place)
        return request._replace(fun=fun, t_span=t_span, y0=y0, projection=projection), form
    if request.args is not None:
        raise TypeError("args: a Problem has params; pass params=..., or its functions instead of the Problem.")
    brought = BROUGHT if isinstance(projection.get("linear_invariants", ""), str) else BROUGHT[:-1]
    own_options = {name: getattr(problem, name) for name in brought}
    if request.method.TABLEAU.drives:
        own_options["invariants"] = problem.stiff_invariants
    projection = own_options | projection
    if params is None and problem.rhs is not None:
        params = problem.params
    projection |= _without_own(projection, *((values,) for values in (problem.params, params) if values is not None))
    own = problem.fun if problem.rhs is None else problem.rhs
    fun, form = _function_and_form(own, problem.rhs is not None)
    jacobian = problem.jacobian if request.jacobian is None else request.jacobian
    fixed = request.h is DEFAULT and not request.adaptive and not request.method.TABLEAU.drives
    h = problem.h if fixed else request.h
    found = {"fun": fun, "t_span": t_span, "y0": y0, "params": params, "h": h, "projection": projection}
    return request._replace(**found, jacobian=jacobian), form


def _without_own(projection: Mapping[str, Any], *extra: tuple[Any, ...]) -> dict[str, Any]:
    """Return the option `invariants`, if given, without args that equal one of `extra`, which the run passes on."""
    if "invariants" not in projection:
        return {}
    items = as_invariants(projection["invariants"])
    if any(item.args for item in items):
        known = [given for given in extra if given]
        items = tuple(
            with_args(item, ()) if any(are_same(item.args, given) for given in known) else item for item in items
        )
    return {"invariants": items}


def _required(name: str, value: Any) -> Any:
    if value is None:
        raise TypeError(f"integrate: {name} is missing; it can be omitted only for a Problem that has its own.")
    return value


def _state(y0: Any) -> np.ndarray:
    start = initial_state(_required("y0", y0))
    if start.size == 0:
        raise ValueError("y0 is empty; integrate needs a state with at least one component.")
    return start


def _span(request: Request, events: Events) -> tuple[float, float]:
    """Return the interval; it may be infinite only if something can end the run."""
    t0, t_bound = interval(request.t_span)
    ends = events.terminal or (request.callback is not None and request.save_every is not None)
    if math.isinf(t_bound) and not ends:
        raise ValueError(
            f"t_span must be finite unless a terminal event ends the run, got {shown(request.t_span)}; a callback may "
            "end it too, at the steps that save_every=... saves."
        )
    return t0, t_bound


def _schedule(span: Span, tau: float, request: Request, events: Events) -> Schedule:
    save_every, t_eval, times = request.save_every, request.t_eval, np.zeros(0)
    if t_eval is not None:
        if save_every is not None:
            raise ValueError("give save_every or t_eval, not both.")
        times = evaluation_times(t_eval, span.t0, span.t_bound)
    n_events = len(events.functions)
    return Schedule(
        span=span,
        save_every=0 if save_every is None else count("save_every", save_every),
        t_eval=times,
        place=np.zeros(3, np.int64),
        clock=np.array([span.t0, span.t0, 0.0, tau]),
        g=np.zeros(n_events),
        g_new=np.zeros(n_events),
        rate=np.array([math.nan] * n_events),
        rate_new=np.zeros(n_events),
        g_direction=events.directions,
    )


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
