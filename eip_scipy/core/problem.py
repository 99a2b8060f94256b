"""Definition of an initial value problem: equations, state, invariants, and options that suit them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..engine.native import library
from .functions import by_pointer
from .inputs import real_array, shown
from .invariants import Invariant, as_invariants
from .names import nearest

__all__ = [
    "PROBLEM_DEFAULTS", "Deferred", "Problem", "bind", "component_names", "library_variational", "made",
    "native_invariant",
]  # fmt: skip

# Options of the projection that a problem brings.
PROBLEM_DEFAULTS = ("invariants", "metric", "blocks", "linear_invariants")
MOST = 12  # components that are printed


class Deferred:
    """A function that is created, by ``make()``, when it is first called."""

    def __init__(self, make: Callable[[], Callable[..., Any]]) -> None:
        self._make = make

    def __call__(self, *args: Any) -> Any:
        """Return the value of the function, which is created in the first call."""
        return self.function(*args)

    @cached_property
    def function(self) -> Callable[..., Any]:
        """Return the function, which is created when this attribute is first read."""
        return self._make()


def made(function: Any) -> Any:
    """Return the function of a `Deferred`; any other function is returned unchanged."""
    return function.function if isinstance(function, Deferred) else function


@dataclass(frozen=True, eq=False, repr=False)
class Problem:
    """A conservative initial value problem.

    `integrate` accepts a problem instead of a function: ``integrate(problem, method=EIPRK4)``; with SciPy, use
    ``problem.solve_ivp(method=EIPRK4)``. A problem prints in five lines. It can be pickled if its functions can: those
    of this package and functions of a module can, C functions and lambdas cannot.

    Attributes
    ----------
    name : str
        Short name, as used on the command line.
    fun : callable
        ``fun(t, y) -> (n,)`` with bound parameters, as SciPy needs it.
    y0 : ndarray, shape (n,)
        Initial state, float64 or complex128.
    t_span : tuple of float
        Start and end in the unit of time of the problem.
    invariants : tuple of Invariant
        Invariants of the equations, with ``args=(params,)``; linear ones are in `linear_invariants`. They can be given
        as an Invariant, a function, or a sequence of them.
    rhs : callable, optional
        Compiled right-hand side in place: ``rhs(t, y, out, params)``, or a `scipy.LowLevelCallable`.
    acc : callable, optional
        For q'' = a(t, q): ``acc(t, q, params) -> (n/2,)``, compiled; the state is (q, v).
    h : float, optional
        A suitable fixed step.
    params : ndarray, optional
        Parameters of `rhs`, `acc` and the invariants' functions.
    metric, blocks, linear_invariants
        Options of the projection that suit the problem (see `EIPSolver`).
    method : Tableau, NystromTableau, GaussJackson or OneStepMethod, optional
        Method that suits the problem, in a form that `eip_method` accepts; `integrate` uses it by default.
    variational : callable, optional
        ``variational(parameters) -> rhs``: the right-hand side ``rhs(t, Y, out, params)``, in place, of Y = (y, first
        column, second column, ...), n numbers each: (f(t, y), Df(t, y) times each column). The last columns are the
        derivatives with respect to the parameters with these indices in `params`. It raises ValueError for parameters
        without such derivatives. If it returns a function of the library by parameters, such as
        "gravity.variational_by_parameters", the run binds it to its own.
    canonical : bool, optional
        True if the state is (q, p) of a Hamiltonian system: tangent maps are then symplectic.
    units : str
        Units of the state and of time. `eip_scipy.integrations.astropy` understands the form "AU, yr", a length and a
        time.
    jacobian : callable, optional
        For q'' = a(t, q): ``jacobian(t, q, dq, out, params)`` fills `out` with the derivative of the accelerations
        along dq, or with its largest part; for multistep methods such as `EIPGJ14`.
    frequencies : callable, optional
        ``frequencies(y, duration) -> (bodies, others)``: the largest angular frequency, within a run of this signed
        length, of each body on its orbit about the central body of the Jacobian (0 for the central body itself), and
        the largest of all other motions.
    reference : callable, optional
        ``reference(t) -> y``: a closed form, or stored reference states; it returns None at other times.
    source : str
        Source of the equations and data.
    component_names : tuple of str, optional
        Names of the components of the state, for tables and figures.
    epoch : (float, float), optional
        Date of t = 0: a Julian date in TDB, in two parts, because a single float is rounded to 20 microseconds. One
        number is converted to such a pair.
    G : float, optional
        Gravitational constant by which the masses of bodies are multiplied in `params`, if it is known.
    events : callable or sequence of callable, optional
        Events that `integrate`, `ensemble` and `solve_ivp` use if their argument `events` is not given; with
        ``events=()`` they use none.

    See Also
    --------
    eip_scipy.integrate, eip_scipy.hamiltonian, nbody, mechanism

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPDOP853
    >>> from eip_scipy.problems import Problem
    >>> turning, square = lambda t, y: np.array([y[1], -y[0]]), lambda t, y: y @ y
    >>> Problem("turning", turning, np.array([1.0, 0.0]), (0, 9), square).solve_ivp(method=EIPDOP853).success
    True
    """

    name: str
    fun: Callable[..., Any]
    y0: np.ndarray
    t_span: tuple[float, float]
    invariants: tuple[Any, ...] = ()
    rhs: Callable[..., None] | None = None
    acc: Callable[..., np.ndarray] | None = None
    h: float | None = None
    params: np.ndarray | None = None
    metric: Any = None
    blocks: Any = None
    linear_invariants: tuple[np.ndarray, np.ndarray] | None = None
    units: str = ""
    reference: Callable[[float], np.ndarray | None] | None = None
    source: str = ""
    jacobian: Callable[..., None] | None = None
    frequencies: Callable[[np.ndarray, float], tuple[np.ndarray, float]] | None = None
    component_names: tuple[str, ...] | None = None
    epoch: tuple[float, float] | None = None
    G: float | None = None
    method: Any = None
    variational: Callable[[tuple[int, ...]], Callable[..., None]] | None = None
    canonical: bool = False
    events: Any = None

    def __post_init__(self) -> None:
        if not _has_params(self.fun, self.params):
            raise ValueError(
                f"params: the functions of the problem {self.name!r} contain other parameters, so that a copy of it "
                "cannot have these. Make the problem with them, or pass params=... to integrate."
            )
        if self.epoch is not None:
            parts = real_array("epoch", self.epoch).ravel().tolist()
            if len(parts) not in (1, 2) or not np.isfinite(parts).all():
                raise ValueError(f"epoch: expected a Julian date in TDB, in one or two parts, got {shown(self.epoch)}.")
            object.__setattr__(self, "epoch", (*parts, 0.0)[:2])
        object.__setattr__(self, "rhs", by_pointer(self.rhs, "rhs"))
        object.__setattr__(self, "invariants", as_invariants(self.invariants))
        if self.component_names is not None:
            n = None if self.y0 is None else np.size(self.y0)
            object.__setattr__(self, "component_names", component_names(self.component_names, n))

    def solve_ivp(self, t_span: Any = None, y0: Any = None, *, method: Any, **options: Any) -> Any:
        """Solve the problem by `scipy.integrate.solve_ivp`, with the options of the problem that the method supports.

        Parameters
        ----------
        t_span, y0 : optional
            Interval and initial state; default: those of the problem.
        method : type or str
            An EIP method, which receives the invariants, linear ones too, metric, blocks, and the step `h` unless rtol,
            atol, first_step, max_step or h is given; or a method of SciPy, which receives none of these. Implicit EIP
            methods receive `stiff_invariants` and no step. All methods receive the events.
        **options
            Options of `solve_ivp` and of the method; they take precedence.

        Returns
        -------
        OdeResult
            Result of `eip_scipy.solve_ivp` with the additional fields ``units``, ``epoch``, and ``component_names`` if
            there are names.

        Examples
        --------
        >>> from eip_scipy import EIPRK4
        >>> from eip_scipy.problems import kepler
        >>> sol = kepler().solve_ivp((0, 20), method=EIPRK4)
        >>> sol.success, sol.y.shape
        (True, (4, 668))
        """
        from ..run.solve_ivp import solve_ivp  # which imports this module

        t_span, y0 = self.t_span if t_span is None else t_span, self.y0 if y0 is None else y0
        if t_span is None or y0 is None:
            missing = "t_span" if t_span is None else "y0"
            raise TypeError(f"{self.name}: the problem has no {missing}; pass {missing} to solve_ivp.")
        brought: dict[str, Any] = {"events": self.events}
        if hasattr(method, "TABLEAU"):  # an EIP method
            brought |= {name: value for name in PROBLEM_DEFAULTS if (value := getattr(self, name)) is not None}
            if method.TABLEAU.drives:
                brought["invariants"] = self.stiff_invariants
            elif self.h is not None and not {"rtol", "atol", "first_step", "max_step"} & options.keys():
                brought["h"] = self.h
        sol: Any = solve_ivp(self.fun, t_span, y0, method, **{**brought, **options})
        if self.component_names is not None and len(self.component_names) == len(sol.y):
            sol.component_names = self.component_names
        sol.units, sol.epoch = self.units, self.epoch
        return sol

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters by name; empty for problems that do not name them."""
        return {}

    @property
    def stiff_invariants(self) -> tuple[Any, ...]:
        """Invariants that implicit methods keep by default: all except objects of the class `Balance`.

        A subclass that knows which of the invariants is an energy excludes it: implicit methods damp fast oscillations,
        and a projection onto an energy that contains them would transfer the lost part to the slow motion.
        """
        return tuple(item for item in self.invariants if not item.is_balance)

    def observed(self, t: Any, y: Any, params: Any = None) -> dict[str, Any]:
        """Return further fields of the result of a run, by name, computed from the states of a run; {} for this class.

        Parameters
        ----------
        t : ndarray, shape (m,)
        y : ndarray, shape (n, m)
        params : mapping or ndarray, optional
            Parameters of the run. Default: those of the problem.
        """
        return {}

    def at_events(self, events: Sequence[Any], times: Any, states: Any, params: np.ndarray) -> dict[str, Any]:
        """Return further fields of the result of a run, by name, computed from its events; {} for this class.

        `times` (m,) and `states` (m, n) are those of each event, and `params` (p,) the parameters of the run.
        """
        return {}

    @property
    def has_second_order(self) -> bool:
        """True if the problem has a method ``second_order()``, which returns the same problem with the state (q, v)."""
        return False

    def named_parameters(self, given: Mapping[str, Any]) -> np.ndarray:
        """Return the values (p,) of all parameters, by default those of the problem; (members, p) for arrays."""
        known = self.parameters
        if not known:
            raise TypeError(
                f"params: the problem {self.name!r} has no names for its parameters; give an array of numbers in the "
                f"order of problem.params, got {shown(given)}."
            )
        for name in given:
            if name not in known:
                hint = nearest(str(name), known)
                raise ValueError(f"params: {self.name} has no parameter {name!r}{hint}. It has {', '.join(known)}.")
        columns = [real_array(f"params[{name!r}]", value) for name, value in {**known, **given}.items()]
        return np.stack(np.broadcast_arrays(*columns), axis=-1)

    def __repr__(self) -> str:
        def having(names: Iterable[str]) -> list[str]:
            return [name for name in names if getattr(self, name) is not None]

        n = MOST if self.y0 is None else np.size(self.y0)
        names = self.component_names or component_names(None, min(n, MOST + 1))
        state = ", ".join(names[:MOST]) + (", ..." if len(names) > MOST else "")
        start = "without a start" if self.y0 is None else f"{n} components, {np.asarray(self.y0).dtype}"
        interval = [] if self.t_span is None else ["t from {:g} to {:g}".format(*self.t_span)]
        interval += [] if self.h is None else [f"h = {self.h:g}"]
        zero = "" if self.epoch is None else f"t = 0 at JD {sum(self.epoch):.13g} TDB"
        kept = ", ".join(item.name or "one without a name" for item in self.invariants)
        functions = ", ".join(["fun", *having(("rhs", "acc", "jacobian", "reference", "events"))])
        lines = [
            f"{self.name}: y = ({state}), {start}",
            f"  interval    {'; '.join(filter(None, (', '.join(interval) or 'none', self.units, zero)))}",
            f"  invariants  {kept or 'none'}",
            f"  functions   {functions}; options {', '.join(having(PROBLEM_DEFAULTS[1:])) or 'none'}",
            f"  source      {self.source or 'not given'}",
        ]
        return "\n".join(lines)


def component_names(names: Any, n: int | None) -> tuple[str, ...]:
    """Return names of n components, of any number if n is None: from a sequence, text such as "x y", or y0, y1 ...."""
    if names is None and n is not None:
        return tuple(f"y{k}" for k in range(n))
    if isinstance(names, str):
        names = names.replace(",", " ").split()
    if not isinstance(names, Iterable):
        raise TypeError(f"names of components must be a sequence of strings, got {shown(names)}.")
    found = tuple(names)
    wrong = [name for name in found if not isinstance(name, str)]
    if wrong:
        raise TypeError(f"names of components must be strings, got {shown(wrong[0])}.")
    if n is not None and len(found) != n:
        raise ValueError(f"there are {len(found)} names for {n} components: {shown(found)}.")
    if len(set(found)) < len(found):
        twice = next(name for k, name in enumerate(found) if name in found[:k])
        raise ValueError(f"{twice!r} names two components; names must be different.")
    return found


def bind(rhs: Callable[..., None], params: np.ndarray | None) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return ``fun(t, y)`` made from ``rhs(t, y, out[, params])``; it can be pickled if `rhs` can."""
    return partial(_derivative, rhs, () if params is None else (params,))


def _has_params(fun: Callable[..., Any], params: Any) -> bool:
    """Return False if `fun` was made by `bind` with other parameters than `params`."""
    if not (isinstance(fun, partial) and fun.func is _derivative and fun.args[1]):
        return True
    return params is fun.args[1][0] or np.array_equal(params, fun.args[1][0])


def _derivative(rhs: Callable[..., None], extra: tuple[np.ndarray, ...], t: float, y: np.ndarray) -> np.ndarray:
    y = np.ascontiguousarray(y)
    out = np.empty_like(y)
    rhs(t, y, out, *extra)
    return out


def native_invariant(function: str, name: str, params: np.ndarray) -> Invariant:
    """Return the invariant `name`, made from the functions `function` and ``{function}_gradient`` of `library`."""
    fun, grad = library[function], library[f"{function}_gradient"]
    return Invariant(fun, grad, args=(params,), in_place=True, uses_f=grad.takes_f, name=name)


def library_variational(function: str, names: tuple[str, ...], parameters: tuple[int, ...]) -> Callable[..., None]:
    """Return `library`'s function for ``Problem.variational(parameters)``; `names`: its parameter with a derivative."""
    if not parameters:
        return library[function]
    if tuple(parameters) != (0,):
        raise ValueError(
            f"variational: {function.partition('.')[0]} has derivatives by its state and only by parameter 0, "
            f"{names[0]}; got parameters={tuple(parameters)}. For others, call integrate with a jitted function "
            "fun(t, y, params) as fun."
        )
    return library[f"{function}_by_parameter"]
