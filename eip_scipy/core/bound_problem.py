"""The right-hand side of a run with its arguments: below it, no interface looks at a user's functions again."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..engine.native import BUILD, LibraryFunction, NativeFunctions, PythonFunctions, call
from ..methods.base import Method
from ..methods.gauss_jackson import jacobian_product
from ..methods.implicit import Jacobian
from ..methods.nystrom import check_halves
from .events import Events
from .functions import (
    BY_NAME,
    Kind,
    NotCompilableError,
    PointerFunction,
    by_address,
    floats,
    jit_is_off,
    names,
    native_functions,
    scalars,
)
from .inputs import as_vector, filled, numbers, require_arguments, shown
from .problem import Problem, made
from .tangent_vectors import NO_TANGENT_VECTORS

if TYPE_CHECKING:
    from .runs import Run
    from .variations import Variations

__all__ = ["FORMS", "BoundProblem"]

Array = np.ndarray
FORMS = {  # (given as an acceleration, in place) -> name of the form of the user's function
    (False, False): "value",
    (False, True): "in place",
    (True, False): "acceleration",
    (True, True): "acceleration in place",
}
NO_EVENTS, NO_JACOBIAN = Events(None), Jacobian()
CALLED = "It takes (t, y), then out if in_place=True, then the arguments from params=... or args=(...)."
CALLED_ACCELERATION = (
    "It takes (t, q), then out if in_place=True, then the arguments from params=... or args=(...). If accelerations "
    "depend on the velocity, pass the right-hand side fun(t, y) of y = (q, v) instead."
)


class BoundProblem:
    """A user's right-hand side `fun` of a form in `FORMS`, for states of the size and type of `y0`.

    `extra` are the last arguments of all functions. `problem` is the `Problem` that was given instead of a function,
    `acc` is the acceleration of a problem that has one, if the method needs nothing else, ``jacobian(t, q, dq, out,
    *extra)`` is for multistep methods, and `jac` for implicit ones. `variations` are the functions of an augmented
    state, `tangents` the vectors in it, and `n` is the number of components without them. A `vectorized` function takes
    states (n, 1). With `explains`, errors name the arguments of a call that fails. With `by_address`, Numba functions
    are called as C functions also outside of the steps. `kind` has the arguments of compiled functions, if there are
    such; `called_kind` is None unless `by_address`. ``evaluate(t, y)`` returns the derivative, and does not count.
    """

    def __init__(
        self,
        fun: Any,
        y0: Array,
        form: str = "value",
        extra: tuple = (),
        *,
        problem: Problem | None = None,
        events: Events | None = None,
        acc: Any = None,
        jacobian: Any = None,
        jac: Jacobian = NO_JACOBIAN,
        variations: Variations | None = None,
        vectorized: bool = False,
        explains: bool = False,
        by_address: bool = False,
    ) -> None:
        self.y0, self.form, self.extra, self.problem = y0, form, extra, problem
        self.events = NO_EVENTS if events is None else events
        self.acc, self.jacobian, self.jac, self.variations = acc, jacobian, jac, variations
        self.tangents = NO_TANGENT_VECTORS if variations is None else variations.tangents
        self.n = self.tangents.state(y0).size
        if problem is not None and problem.y0 is not None and self.n != (size := np.size(problem.y0)):
            # Compiled functions would read and write memory beyond the state.
            raise ValueError(f"y0 has {self.n} components, and the problem {problem.name!r} has {size}.")
        self.vectorized, self._explains = vectorized, explains
        self.parameters = floats(extra)
        self.second_order, self._in_place = form.startswith("acceleration"), form.endswith("in place")
        self.name = "acceleration" if self.second_order else "fun"
        # Accelerations may depend on velocities if they come from a function that is called with these.
        self.sees_velocity = not self.second_order and (problem is None or problem.acc is None)
        self.count = 0  # of the calls of `derivative`
        types, p = scalars(extra), self.parameters.size if extra else -1
        self.kind = None if types is None else Kind((), y0.size, p, y0.dtype.char, scalars=types)
        self.called_kind = self.kind if by_address and not jit_is_off() else None
        self.bind(fun)
        if jacobian is not None and not callable(jacobian):
            raise TypeError(f"jacobian must be a function jacobian(t, q, dq, out[, params]), got {shown(jacobian)}.")

    def bind(self, fun: Any) -> None:
        """Use `fun`, of the same form, from now on."""
        self.fun, acc = fun, self.acc
        self.native_form = fun, self.form  # what the engine calls: `acc` if it is in the same library as `fun`
        own = isinstance(fun, LibraryFunction) and isinstance(acc, LibraryFunction)
        if own and fun.__name__.partition(".")[0] == acc.__name__.partition(".")[0]:
            self.native_form = acc, "acceleration"
        self.is_second_order = self.native_form[1].startswith("acceleration")  # (v, a) by its construction
        n, dtype, name = self.y0.size, self.y0.dtype, self.name
        if self.second_order:
            check_halves(n)
        size = n // 2 if self.second_order else n

        def convert(f: Any, t: float) -> Array:
            return np.array(as_vector(f, size, dtype, f"{name} returned", t), dtype, order="C")

        called = _flat(fun, n) if self.vectorized else fun
        found = call(called, self.extra, (size,), convert, in_place=self._in_place)
        self.call = by_address(found, name, self.called_kind, self.parameters, size)
        self._is_filled = not self._in_place or isinstance(fun, LibraryFunction)  # once that is checked
        self.evaluate = BUILD.RightHandSide(self.call, n, dtype.kind == "c", self.second_order)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("evaluate", "call")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.bind(self.fun)

    def __deepcopy__(self, memo: dict[int, Any]) -> BoundProblem:
        new = object.__new__(BoundProblem)
        new.__setstate__(self.__getstate__())  # with the same functions
        return new

    def derivative(self, t: float, y: Array) -> Array:
        """Return the derivative (n,) at (t, y) as a new array, and count the call."""
        self.count += 1
        try:
            return self.evaluate(t, y) if self._is_filled else self._filled(t, y)
        except TypeError:
            if self._explains:
                third = ("out",) if self._in_place else ()
                state, advice = ("q", CALLED_ACCELERATION) if self.second_order else ("y", CALLED)
                require_arguments(self.fun, ("t", state, *third, *names(self.extra)), self.name, advice)
            raise

    def _filled(self, t: float, y: Array) -> Array:
        """Return the derivative by a user's in-place function, after a check that it fills its argument out."""
        self._is_filled, half = True, y.size // 2 if self.second_order else 0
        q = y[: half or None]
        f = filled(lambda out: self.fun(t, q.copy(), out, *self.extra), q.shape, y.dtype, self.name, t)
        return np.concatenate([y[half:], f]) if half else f

    @property
    def left_out(self) -> str:
        """A possible cause of NaN in the value of the function, for messages; "" if none is known."""
        if self.variations is not None:
            return (
                f"components from {self.n} on are derivatives, which overflow in long chaotic runs: shorten the "
                "interval, or use megno or lyapunov_spectrum, which rescale them"
            )
        if isinstance(self.fun, PointerFunction):
            return "components are NaN if the C function does not fill them, and all are if its status is above 0"
        return "with in_place=True it must fill all of out" if self._in_place else ""

    @property
    def component_names(self) -> tuple[str, ...] | None:
        """Names of the components from the problem, or None if it has none for this state."""
        names = None if self.problem is None else self.problem.component_names
        return names if names is not None and len(names) == self.n else None

    @property
    def described_columns(self) -> dict[str, Any]:
        """The field ``columns`` of the result of a run that carries derivatives."""
        assert self.variations is not None
        tangents = self.tangents
        known = {} if self.problem is None else dict(enumerate(self.problem.parameters))
        return {
            "state": tangents.is_transition,
            "parameters": len(tangents.parameters),
            "names": [known.get(k, f"params[{k}]") for k in tangents.parameters],
            "symplectic": tangents.symplectic,
            "source": self.variations.source,
        }

    def hint(self) -> str:
        """Return the end of a message: how to write the equations for a method of second order."""
        if self.problem is None:
            return f". If fun is the acceleration a(t, q), {BY_NAME}"
        hint = "; problem.second_order() returns this problem in that form, for a start (q, v)"
        return hint if self.problem.has_second_order else ""

    def jacobian_for(self, method: Method) -> Any:
        """Return the Jacobian as the method needs it: a `Jacobian`, or ``product(t, q, dq)`` or None."""
        if method.drives:
            jac, extra = self.jac.jac, self.extra
            return self.jac._replace(jac=lambda t, y: jac(t, y, *extra)) if callable(jac) and extra else self.jac
        self.jacobian = made(self.jacobian)
        return None if self.jacobian is None else jacobian_product(self.jacobian, *self.extra)

    def functions(self, run: Run, wanted: bool | None) -> tuple[PythonFunctions | NativeFunctions, str | None]:
        """Return the functions that the loop calls, and None if all are called natively.

        Otherwise the second item is a text that says which functions are called from Python, and why. `wanted` is the
        option `compiled`; if it is True, NotCompilableError is raised instead.
        """
        if wanted is False:
            return self.in_python(run), "interpreted: compiled=False"
        try:
            functions, reason = native_functions(run)
        except NotCompilableError as error:
            if wanted:
                raise
            return self.in_python(run), f"interpreted: {error}"
        if not reason:
            return functions, None
        if wanted:
            raise NotCompilableError(reason)
        return functions._replace(python=self.in_python(run)), f"events are called from Python: {reason}"

    def pointers(self, run: Run) -> list[PointerFunction]:
        """Return the C functions of a run that were given as pointers."""
        functions = [self.fun, *self.events.functions]
        for item in run.invariants.items:
            functions += [item.function, item.gradient, item.rate_function]
        return [function for function in functions if isinstance(function, PointerFunction)]

    def in_python(self, run: Run) -> PythonFunctions:
        """Return all functions as Python calls them."""
        jacobian, half = None, (self.y0.size // 2,)
        if run.uses_jacobian:
            jacobian = call(self.jacobian, self.extra, half, self.call.convert, in_place=True, takes_f=True)
        rates = run.invariants.rates(run.options.adaptive)
        inv, grad = run.invariants.calls
        return PythonFunctions(self.call, inv, grad, self.events.calls, self.second_order, jacobian, rates)

    def calls(self, run: Run, functions: PythonFunctions | NativeFunctions) -> dict[str, str]:
        """Return how each function is called, as the attribute `calls` of `IntegrationResult`."""

        def kind(fun: Any, in_python: bool) -> str:
            if in_python:
                return "python"
            if fun is None:
                return "differences"
            if isinstance(fun, LibraryFunction):
                return "native"
            return "pointer" if isinstance(fun, PointerFunction) else "jitted"

        in_python = isinstance(functions, PythonFunctions)
        events_in_python = isinstance(functions, PythonFunctions) or functions.python is not None
        called = {self.name: self.fun}
        for item, label in zip(run.invariants.items, run.invariants.labels, strict=True):
            item = item if item.unaugmented is None else item.unaugmented.function
            called |= {label: item.function, f"gradient of {label}": item.gradient}
            if item.rate_function is not None:
                called[f"rate of {label}"] = item.rate_function
        if run.uses_jacobian:
            called["jacobian"] = self.jacobian
        found = {name: kind(fun, in_python) for name, fun in called.items()}
        return found | {f"event {k}": kind(event, events_in_python) for k, event in enumerate(self.events.functions)}


def _flat(fun: Callable[..., Any], n: int) -> Callable[..., Any]:
    """Return a vectorized function as one of a single state; SciPy broadcasts a single number."""

    def flat(t: float, y: Array) -> Any:
        f = fun(t, y[:, None])
        found = numbers("fun returned", f)
        return f if found is None else np.resize(found, n) if found.size == 1 else found.reshape(-1)

    return flat
