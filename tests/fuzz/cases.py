"""Random systems with random options, one for each number: arguments of a run, and known properties of its result."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import eip_scipy
from eip_scipy import Invariant
from eip_scipy_studies.bench.families import Array, Quantity, System, random_system

from . import jitted

METHODS = {  # least and largest h times the fastest rate of the system; least rtol
    "EIPRK1": (0.002, 0.02, None),
    "EIPRK2": (0.01, 0.1, 1e-5),
    "EIPRK3": (0.02, 0.2, 1e-7),
    "EIPRK4": (0.03, 0.4, 1e-9),
    "EIPRK5": (0.05, 0.5, 1e-10),
    "EIPRK23": (0.02, 0.2, 1e-6),
    "EIPRK45": (0.05, 0.5, 1e-10),
    "EIPDOP853": (0.1, 1.0, 1e-12),
    "EIPRKN8": (0.1, 1.0, 1e-11),
    "EIPRKN12": (0.2, 1.5, 1e-12),
}
NYSTROM = ("EIPRKN8", "EIPRKN12")
PHASES = (3.0, 15.0)  # length of a run times the fastest rate
MOST_STEPS, MOST_CALLS = 200, 50_000
SAMPLES = 4
NEARBY, REGULAR = 1e-6, 1e3


class TooManyCallsError(Exception):
    """Error of a run that takes far more evaluations than any that ends."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A system and the options of its runs.

    `sick`: one of the invariants is false. `truth` holds the true states at `times`, `size` the largest value of each
    component, `growth` the factor by which the motion stretches a small change of the start.
    """

    seed: int
    system: System
    invariants: tuple[Invariant, ...]
    sick: bool
    method: str
    t_span: tuple[float, float]
    steps: dict[str, Any]
    projection: dict[str, Any]
    compensated: bool
    params: Array | None
    in_place: bool
    events: tuple[Callable[..., float], ...]
    times: Array
    truth: Array
    size: Array
    growth: float

    @property
    def regular(self):
        """Return whether neighbouring motions stay neighbours, so that a run can be compared with the true one."""
        return self.growth < REGULAR

    @property
    def native(self):
        return self.system.name == jitted.NAME

    def error(self, y):
        """Return the largest error of the states (n, SAMPLES), in units of the components' sizes."""
        return float(np.max(np.abs(y - self.truth) / self.size[:, None]))

    def solve_ivp(self, **options):
        fun = counted(self.system.fun)
        given = {"invariants": self.invariants, **self.steps, **self.projection}
        if self.params is not None and not self.native:
            fun, given["args"] = with_params(fun), (self.params,)
        if self.events:
            given["events"] = self.events
        return solve_ivp(fun, self.t_span, self.system.y0.copy(), method=method(self.method), **given | options)

    @property
    def fun(self):
        """Return the right-hand side, or the acceleration, as `integrate` and `ensemble` take it."""
        if self.native:
            return jitted.acceleration if self.method in NYSTROM else jitted.motion
        fun = self.system.acc if self.method in NYSTROM else self.system.fun
        assert fun is not None
        fun = counted(fun)
        if self.params is not None:
            fun = with_params(fun)
        return filling(fun) if self.in_place else fun

    @property
    def takes(self):
        return "acceleration" if self.method in NYSTROM else "fun"

    @property
    def options(self):
        given = {
            "method": method(self.method),
            "invariants": self.invariants,
            "in_place": self.in_place,
            "compensated": self.compensated,
            "compiled": False,
            **self.steps,
            **self.projection,
        }
        if self.params is not None:
            given["params"] = self.params
        if self.events:
            given["events"] = self.events
        return given

    def integrate(self, **options):
        given = {self.takes: options.pop("fun", None) or self.fun, "t_span": self.t_span}
        return eip_scipy.integrate(**given, y0=self.system.y0.copy(), **self.options | options)

    def __str__(self):
        kept = ", ".join(str(item.name) for item in self.invariants) or "nothing"
        shown = [f"{name}={value!r}" for name, value in (self.steps | self.projection).items()]
        shown += [name for name in ("compensated", "in_place", "sick") if getattr(self, name)]
        shown += ["params"] if self.params is not None else []
        shown += [f"event(terminal={e.terminal}, direction={e.direction})" for e in self.events]
        notes = "".join(f", {note}" for note in self.system.notes)
        return (
            f"{self.system.name}, {self.system.y0.size} components{notes}; kept: {kept}; {self.method} on "
            f"({self.t_span[0]:.6g}, {self.t_span[1]:.6g}); {', '.join(shown)}"
        )


def method(name):
    return getattr(eip_scipy, name)


def counted(fun):
    """Return the function with a bound on the number of calls."""
    calls = 0

    def bounded(*args):
        nonlocal calls
        calls += 1
        if calls > MOST_CALLS:
            raise TooManyCallsError
        return fun(*args)

    return bounded


def with_params(fun):
    """Return the function with one more argument, whose first number is 1."""
    return lambda t, y, p: fun(t, y) * p[0]


def filling(fun):
    def fill(t, y, out, *params):
        out[:] = fun(t, y, *params)

    return fill


def random_case(seed):
    rng = np.random.default_rng(seed)
    params, in_place, sick = None, False, False
    if rng.random() < 0.15:
        system, invariants, params = jitted.jitted_system(rng)
        in_place = True
    else:
        system = random_system(rng)
        kept = _chosen(rng, system)
        if kept and rng.random() < 0.08:
            kept, sick = (*kept[:-1], _leaking(rng, system, kept[-1])), True
        if rng.random() < 0.15:
            params = np.array([1.0, rng.uniform(0.5, 2.0)])
        in_place = bool(rng.random() < 0.2)
        invariants = tuple(_formed(rng, quantity, system, params) for quantity in kept)
    sign = -1.0 if rng.random() < 0.25 else 1.0
    name = str(rng.choice([m for m in METHODS if system.acc is not None or m not in NYSTROM]))
    low, high, least_rtol = METHODS[name]
    rate = _rate(system, sign)
    h = 10 ** rng.uniform(math.log10(low), math.log10(high)) / rate
    length = min(rng.uniform(*PHASES) / rate, MOST_STEPS * h)
    t_span = (system.t0, system.t0 + sign * length)
    times = np.linspace(*t_span, SAMPLES + 1)[1:]
    truth, growth = _truth(rng, system, times)
    size = np.abs(np.column_stack([system.y0, truth])).max(axis=1)
    size = np.maximum(size, 1e-3 * np.max(size * system.unit) / system.unit)
    options = {
        "steps": _steps(rng, system, min(h, length), length, least_rtol, size),
        "projection": _projection(rng, system, size, name != "EIPRK1"),
        "compensated": bool(rng.random() < 0.15),
        "events": () if system.name == jitted.NAME else _events(rng, size),
    }
    known = {"times": times, "truth": truth, "size": size, "growth": growth}
    given = {"invariants": invariants, "sick": sick, "params": params, "in_place": in_place}
    return Case(seed=seed, system=system, method=name, t_span=t_span, **given, **options, **known)


def _chosen(rng, system):
    """Return some preserved quantities, in any order, perhaps with a dependent one, or two of them as one vector."""
    kept = system.kept
    if rng.random() < 0.05:
        return ()
    chosen = [kept[k] for k in rng.permutation(len(kept))[: rng.integers(1, len(kept) + 1)]]
    if rng.random() < 0.25:
        made, of = (_multiple, _square)[rng.integers(2)], chosen[rng.integers(len(chosen))]
        if made is _multiple or not _vanishes(of, system):
            chosen.append(made(rng, of))
    if len(chosen) > 1 and rng.random() < 0.2:
        chosen = [_stacked(chosen[0], chosen[1]), *chosen[2:]]
    return tuple(chosen)


def _vanishes(a, system):
    """Return whether a part of it is rounding at the start: the square of that has no gradient to project along."""
    t, y = system.t0, system.y0
    return bool(np.any(np.abs(a.fun(t, y)) <= 1e-8 * (np.abs(a.grad(t, y)) @ np.abs(y))))


def _multiple(rng, a):
    factor = float(rng.choice([1.0, -2.5, 1e4]))
    return Quantity(f"{factor:g} {a.name}", lambda t, y: factor * a.fun(t, y), lambda t, y: factor * a.grad(t, y))


def _square(rng, a):
    def gradient(t, y):
        return 2 * np.asarray(a.fun(t, y))[..., None] * a.grad(t, y)

    return Quantity(f"{a.name}^2", lambda t, y: a.fun(t, y) ** 2, gradient)


def _stacked(a, b):
    def value(t, y):
        return np.concatenate([np.atleast_1d(a.fun(t, y)), np.atleast_1d(b.fun(t, y))])

    return Quantity(f"({a.name}, {b.name})", value, lambda t, y: np.vstack([a.grad(t, y), b.grad(t, y)]))


def _leaking(rng, system, a):
    """Return a quantity that is nearly kept, with a further term whose rate may vanish at the start."""
    y0, unit, power = system.y0, system.unit, int(rng.integers(1, 3))
    amount = 10 ** rng.uniform(-4, 0) * np.max(np.abs(a.fun(system.t0, y0)))
    way = rng.standard_normal(y0.size)

    def moved(y):
        return float(np.real(way @ ((y - y0) * unit)))

    def gradient(t, y):
        return a.grad(t, y) + amount * power * moved(y) ** (power - 1) * way * unit

    return Quantity(f"leaking {a.name}", lambda t, y: a.fun(t, y) + amount * moved(y) ** power, gradient)


def _formed(rng, a, system, params):
    """Return an `Invariant`, with or without a gradient, in place or not, by f or not."""

    def factor(args):
        return args[0][1] if args else 1.0

    def fun(t, y, *args):
        return a.fun(t, y) * factor(args)

    by_f = a.by_f if rng.random() < 0.4 else None
    in_place = bool(rng.random() < 0.3)

    def value(*arguments):
        """Return the gradient for (t, y, [f], *args)."""
        if by_f is None:
            t, y, *args = arguments
            return a.grad(t, y) * factor(tuple(args))
        t, y, f, *args = arguments
        return by_f(t, y, f) * factor(tuple(args))

    def fill(*arguments):
        at = 2 if by_f is None else 3
        arguments[at][...] = value(*arguments[:at], *arguments[at + 1 :])

    options = {"name": a.name, "args": () if params is None else (params,)}
    start = fun(system.t0, system.y0, *options["args"])
    if rng.random() < 0.08:
        options["target"] = start
    if rng.random() < 0.05:
        options["scale"] = float(np.max(np.abs(start)))
    if rng.random() < 0.15 and _floats(system.y0).size <= 8:  # each gradient costs 12 evaluations for each float
        return Invariant(fun, **options)
    return Invariant(fun, fill if in_place else value, in_place=in_place, uses_f=by_f is not None, **options)


def _steps(rng, system, h, length, least_rtol, size):
    if least_rtol is None or rng.random() < 0.5:
        # The default atol is for states of about 1.
        return {"h": float(h)} | ({} if np.ndim(system.unit) == 0 else {"atol": 1e-6 * size})
    rtol = float(10 ** rng.uniform(math.log10(least_rtol), -3))
    steps = {"rtol": rtol, "atol": rtol * float(rng.choice([1e-3, 1.0])) * size}
    if rng.random() < 0.2:
        steps["first_step"] = float(h * rng.uniform(0.01, 1.0))
    if rng.random() < 0.2:
        steps["max_step"] = float(length * rng.uniform(0.05, 0.5))
    return steps


def _projection(rng, system, size, has_estimate):
    n = size.size
    one_unit = np.ndim(system.unit) == 0
    found = {}
    weights = rng.uniform(0.2, 1.0, n) / system.unit
    if rng.random() < 0.4:
        # The euclidean metric, also the one in the place of a missing estimate, is for components of one unit.
        found["metric"] = ["error", "euclidean" if one_unit else "error", weights][rng.integers(3)]
    if not (one_unit or has_estimate):
        found["metric"] = weights
    if rng.random() < 0.25 and one_unit:
        divisors = [b for b in range(1, n + 1) if n % b == 0]
        lists = np.array_split(rng.permutation(n), rng.integers(1, n + 1))
        found["blocks"] = lists[1:] or lists if rng.random() < 0.5 else int(rng.choice(divisors))
    if system.linear_invariants is not None and rng.random() < 0.4:
        found["linear_invariants"] = system.linear_invariants
    if rng.random() < 0.3:
        found["direction"] = str(rng.choice(["old", "midpoint"]))
    every = [2, 3, 10, "auto" if has_estimate else 5]
    others = {"iterations": int(rng.integers(2, 4)), "every": every[rng.integers(4)]}
    others |= {"reuse_f": False, "project_initial": True, "check": False}
    shares = {"iterations": 0.2, "every": 0.4, "reuse_f": 0.2, "project_initial": 0.05, "check": 0.05}
    found |= {name: others[name] for name, share in shares.items() if rng.random() < share}
    return found


def _events(rng, size):
    if rng.random() < 0.7:
        return ()
    return tuple(_event(rng, int(rng.integers(size.size)), size) for _ in range(rng.integers(1, 3)))


def _event(rng, k, size):
    level = rng.uniform(-0.5, 0.5) * size[k]

    def event(t, y, *args):
        return float(y[k].real - level)

    event.terminal = [False, False, True, 2][rng.integers(4)]
    event.direction = float(rng.integers(-1, 2))
    return event


def _rate(system, sign):
    """Return the fastest rate along the motion: that of the linearised equations, or of the state as a whole."""

    def at(t, y):
        x, unit = _floats(y), np.repeat(np.broadcast_to(system.unit, y.size), 2 if y.dtype.kind == "c" else 1)
        step = 1e-6 * np.max(np.abs(x * unit)) / unit
        columns = []
        for k in range(x.size):
            shift = np.zeros(x.size)
            shift[k] = step[k]
            ahead, behind = (_floats(system.fun(t, (x + s * shift).view(y.dtype))) for s in (1, -1))
            columns.append((ahead - behind) / (2 * step[k]))
        whole = np.linalg.norm(_floats(system.fun(t, y)) * unit) / np.linalg.norm(x * unit)
        return max(system.rate, whole, float(np.abs(np.linalg.eigvals(np.array(columns).T)).max()))

    t0, y0 = system.t0, system.y0
    rate = at(t0, y0)
    scale = np.max(np.abs(y0 * system.unit)) / system.unit
    end = t0 + sign * PHASES[1] / rate
    sol = solve_ivp(counted(system.fun), (t0, end), y0, rtol=1e-4, atol=1e-5 * scale, t_eval=np.linspace(t0, end, 6))
    return max(at(t, y) for t, y in zip(sol.t, sol.y.T.copy(), strict=True))


def _floats(y):
    return np.ascontiguousarray(y).view(float)


def _truth(rng, system, times):
    """Return the states (n, SAMPLES) at `times`, and the separation of neighbours."""
    if system.exact is not None:
        return np.column_stack([system.exact(t) for t in times]), 1.0
    scale = np.max(np.abs(system.y0 * system.unit)) / system.unit
    truth = _states(system, system.y0, times, 1e-13, 1e-15 * scale)
    size = np.abs(truth).max(axis=1) + scale
    change = NEARBY * size * rng.standard_normal(size.size)
    other = _states(system, system.y0 + change, times, 1e-10, 1e-12 * scale)
    return truth, max(1.0, float(np.max(np.abs(other - truth) / size[:, None])) / NEARBY)


def _states(system, y0, times, rtol, atol):
    """Return states by SciPy's DOP853, from one of the times to the next."""
    found, t, y = [], system.t0, y0
    for end in times:
        y = solve_ivp(counted(system.fun), (t, end), y, method="DOP853", rtol=rtol, atol=atol).y[:, -1]
        t = end
        found.append(y)
    return np.column_stack(found)
