"""Solvers of the bench: this package with a user's functions and with its own problems, and other packages.

A solver's ``prepare(case)`` imports its package and returns ``solve(setting)``, one whole call that returns the state
at the end. A setting is a relative tolerance (absolute ones are 0.001 of it, for all), or a number of steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from .cases import Case
from .mechanisms import with_baumgarte

USER, READY, OTHER = "a user's functions", "the library's problem", "other packages"
ATOL = 1e-3
LANES = 4  # width of heyoka's batches: four doubles are a vector of AVX2

Solve = Callable[[Any], np.ndarray]


class Solver(NamedTuple):
    """A method of a package; `kind` is `USER`, `READY` or `OTHER`, and `fits(case)` says which cases it runs.

    `steps` is the name under which a case has numbers of steps, empty for tolerances. A solver that compiles for each
    setting is `warm`: an uncounted call comes first.
    """

    name: str
    package: str
    kind: str
    prepare: Callable[[Case], Solve]
    fits: Callable[[Case], bool]
    steps: str = ""
    warm: bool = False


def tolerances(setting: float) -> dict[str, float]:
    """Return the arguments rtol and atol."""
    return {"rtol": setting, "atol": ATOL * setting}


def checked(result: Any) -> np.ndarray:
    """Return the last state of a result in SciPy's form, or raise its message."""
    if not result.success:
        raise RuntimeError(result.message)
    return result.y[:, -1]


def plain(case: Case) -> bool:
    """Return True for one start that is not stiff, and no mechanism."""
    return not (case.members or case.stiff or case.mechanism)


def small(case: Case) -> bool:
    """Return True if the equations are expressions of components."""
    return plain(case) and case.scalar


def moving(case: Case) -> bool:
    """Return True for a mechanism."""
    return case.mechanism is not None


# This package.


def control(case: Case, setting: Any) -> dict[str, Any]:
    """Return the arguments of `integrate` for a number of steps or a tolerance."""
    return {"h": case.t_end / setting} if isinstance(setting, int) else {**tolerances(setting), "h": None}


def ours(method: str, case: Case) -> Solve:
    """Return whole calls of `integrate` with functions as a user of SciPy writes them."""
    eip = import_module("eip_scipy")
    functions = case.jitted
    second = method.startswith(("EIPRKN", "EIPGJ"))
    equations = {"acceleration": functions.acceleration} if second else {"fun": functions.fun}

    def solve(setting: Any) -> np.ndarray:
        kept = [eip.Invariant(item, name=name) for name, item in functions.invariants.items()]
        options = {"method": getattr(eip, method), "invariants": kept, **control(case, setting)}
        return checked(eip.integrate(**equations, t_span=(0.0, case.t_end), y0=case.y0, **options))

    return solve


def in_solve_ivp(case: Case) -> Solve:
    """Return whole calls of SciPy's solve_ivp with our class, and a user's jitted functions."""
    eip, solve_ivp = import_module("eip_scipy"), import_module("scipy.integrate").solve_ivp

    def solve(setting: float) -> np.ndarray:
        kept = [eip.Invariant(item, name=name) for name, item in case.jitted.invariants.items()]
        options = {"method": eip.EIPDOP853, "invariants": kept, **tolerances(setting)}
        return checked(solve_ivp(case.jitted.fun, (0.0, case.t_end), case.y0, **options))

    return solve


def our_members(method: str, case: Case) -> Solve:
    """Return whole calls of `ensemble` on one core."""
    eip, functions = import_module("eip_scipy"), case.jitted
    equations = {"acceleration": functions.acceleration} if "RKN" in method else {"fun": functions.fun}

    def solve(setting: Any) -> np.ndarray:
        kept = [eip.Invariant(item, name=name) for name, item in functions.invariants.items()]
        options = {"method": getattr(eip, method), "invariants": kept, "executor": 1, **control(case, setting)}
        return eip.ensemble(**equations, t_span=(0.0, case.t_end), y0s=case.y0, **options).y

    return solve


def expression(method: str, case: Case) -> Solve:
    """Return whole calls of `integrate` for the problem that `hamiltonian` makes once."""
    eip = import_module("eip_scipy")
    assert case.hamiltonian is not None
    problem = eip.hamiltonian(*case.hamiltonian)
    return lambda setting: checked(
        eip.integrate(problem, (0.0, case.t_end), case.y0, method=getattr(eip, method), **control(case, setting))
    )


def ready(method: str, case: Case) -> Solve:
    """Return whole calls of `integrate` for a problem of the library."""
    eip = import_module("eip_scipy")
    assert case.ready is not None
    problem = case.ready()
    return lambda setting: case.to_own(
        checked(eip.integrate(problem, (0.0, case.t_end), method=getattr(eip, method), **control(case, setting)))
    )


# Mechanisms: all packages get the right-hand side that `mechanism` or `mechanics` makes.


def ours_mechanism(kept: str, case: Case) -> Solve:
    """Return whole calls of `integrate` with the invariants in the problem's attribute `kept`."""
    eip, problem = import_module("eip_scipy"), _problem(case)
    options = {"method": eip.EIPDOP853, "invariants": getattr(problem, kept)}
    return lambda setting: checked(eip.integrate(problem, **options, **control(case, setting)))


def scipy_mechanism(method: str, factor: float, case: Case) -> Solve:
    """Return calls of SciPy's solve_ivp, with Baumgarte's terms if `factor` is not 0."""
    solve_ivp, problem = import_module("scipy.integrate").solve_ivp, _problem(case)
    fun = with_baumgarte(problem, factor) if factor else problem.fun
    return lambda setting: checked(
        solve_ivp(fun, problem.t_span, problem.y0, method=method, rtol=setting, atol=ATOL * setting)
    )


def ida(case: Case) -> Solve:
    """Return calls of SUNDIALS' IDA, with the constraints on positions and velocities as equations.

    The multipliers move q' and u' along the gradients of the constraints (Gear, Gupta and Leimkuhler 1985); they are 0
    in the exact motion, since the accelerations satisfy the constraints already.
    """
    solver, problem = import_module("sksundae.ida").IDA, _problem(case)
    (item,) = problem.constraints
    n, nq, m = problem.y0.size, len(problem.names.coordinates), item.size
    on_positions, gradient = len(problem.names.positions), np.empty((m, n))

    def residual(t: float, y: np.ndarray, rates: np.ndarray, out: np.ndarray) -> None:
        state = y[:n].copy()  # IDA's own array is read-only, for which functions would be compiled again
        item.gradient(t, state, gradient, *item.args)
        out[:n] = rates[:n] - problem.fun(t, state)
        out[:nq] -= gradient[:on_positions, :nq].T @ y[n : n + on_positions]
        out[nq:n] -= gradient[on_positions:, nq:].T @ y[n + on_positions :]
        out[n:] = item.function(t, state, *item.args)

    options = {"algebraic_idx": list(range(n, n + m)), "max_num_steps": 10**6}
    start = np.append(problem.y0, np.zeros(m)), np.append(problem.fun(problem.t_span[0], problem.y0), np.zeros(m))

    def solve(setting: float) -> np.ndarray:
        atol = np.append(np.full(n, ATOL * setting), np.full(m, 1e10))  # multipliers are not part of the motion
        found = solver(residual, rtol=setting, atol=atol, **options).solve(np.array(problem.t_span), *start)
        if not found.success:
            raise RuntimeError(found.message)
        return found.y[-1, :n]

    return solve


def _problem(case: Case) -> Any:
    assert case.mechanism is not None
    return case.mechanism()


# Packages with SciPy's call.


def by_solve_ivp(solver: Any, method: Any, case: Case, name: str = "solve_ivp") -> Solve:
    """Return calls of a function like SciPy's solve_ivp."""
    solve_ivp, fun = getattr(import_module(solver), name), case.jitted.fun
    chosen = method() if callable(method) else method

    def solve(setting: float) -> np.ndarray:
        starts = case.y0 if case.members else [case.y0]
        options = {"method": chosen, **tolerances(setting)}
        ends = [checked(solve_ivp(fun, (0.0, case.t_end), y0, **options)) for y0 in starts]
        return np.array(ends) if case.members else ends[0]

    return solve


def extensisq(name: str) -> Callable[[], Any]:
    """Return a function that imports a class of extensisq."""
    return lambda: getattr(import_module("extensisq"), name)


def cyrk(method: str, case: Case) -> Solve:
    """Return calls of CyRK with a compiled function."""
    package, numba, fun, n = import_module("CyRK"), import_module("numba"), case.jitted.fun, case.y0.size

    def filled(out, t, y, params):  # type: ignore[no-untyped-def]
        numba.carray(out, (n,))[:] = fun(t, numba.carray(y, (n,)))

    address = package.nb_diffeq_addr(filled)
    return lambda setting: np.array(
        checked(package.nbsolve2_ivp(address, (0.0, case.t_end), case.y0, method=method, **tolerances(setting)))
    )


def numbalsoda(method: str, case: Case) -> Solve:
    """Return calls of numbalsoda; many members in a jitted loop."""
    package, numba, fun, n = import_module("numbalsoda"), import_module("numba"), case.jitted.fun, case.y0.shape[-1]
    call, times, params = getattr(package, method), np.array([0.0, case.t_end]), np.zeros(1)

    @numba.cfunc(package.lsoda_sig)
    def filled(t, y, out, params):  # type: ignore[no-untyped-def]
        numba.carray(out, (n,))[:] = fun(t, numba.carray(y, (n,)))

    address = filled.address

    @numba.njit
    def each(starts, rtol, atol):  # type: ignore[no-untyped-def]
        ends = np.empty_like(starts)
        for k in range(len(starts)):
            states, success = call(address, starts[k], times, params, rtol=rtol, atol=atol, mxstep=10**8)
            ends[k] = states[-1]
            if not success:
                ends[k, :] = np.nan
        return ends

    return lambda setting: each(np.atleast_2d(case.y0), setting, ATOL * setting).reshape(case.y0.shape)


def sundae(case: Case) -> Solve:
    """Return calls of CVODE by scikit-SUNDAE."""
    cvode, fun = import_module("sksundae.cvode").CVODE, case.jitted.fun
    method = "BDF" if case.stiff else "Adams"

    def fill(t: float, y: np.ndarray, out: np.ndarray) -> None:
        out[:] = fun(t, y)

    def solve(setting: float) -> np.ndarray:
        solver = cvode(fill, method=method, max_num_steps=10**8, **tolerances(setting))
        solution = solver.solve(np.array([0.0, case.t_end]), case.y0)
        if not solution.success:
            raise RuntimeError(solution.message)
        return solution.y[-1]

    return solve


# Packages that take the equations in a form of their own.


def heyoka(case: Case) -> Solve:
    """Return calls of heyoka, with an integrator that is compiled once for each tolerance."""
    package = import_module("heyoka")
    n = case.y0.shape[-1]
    if case.gm is not None:
        system = package.model.nbody(len(case.gm), masses=list(case.gm), Gconst=1.0)
        order = np.arange(n).reshape(2, -1, 3).swapaxes(0, 1).ravel()
    else:
        names = package.make_vars(*(f"y{k}" for k in range(n)))
        system, order = list(zip(names, case.make(package).fun(0.0, names), strict=True)), np.arange(n)
    made: dict[float, Any] = {}

    def single(setting: float) -> np.ndarray:
        if setting not in made:
            made[setting] = package.taylor_adaptive(system, case.y0[order], tol=setting)
        integrator = made[setting]
        integrator.time, integrator.state[:] = 0.0, case.y0[order]
        outcome = integrator.propagate_until(case.t_end)[0]
        if outcome != package.taylor_outcome.time_limit:
            raise RuntimeError(str(outcome))
        end = np.empty(n)
        end[order] = integrator.state
        return end

    def batch(setting: float) -> np.ndarray:
        if setting not in made:
            made[setting] = package.taylor_adaptive_batch(system, np.ones((n, LANES)), tol=setting)
        integrator, ends = made[setting], np.empty_like(case.y0)
        for k in range(0, len(ends), LANES):
            integrator.set_time(0.0)
            integrator.state[:] = case.y0[k : k + LANES].T
            integrator.propagate_until(case.t_end)
            ends[k : k + LANES] = integrator.state.T
        return ends

    return batch if case.members else single


def diffrax(solver: str, case: Case) -> Solve:
    """Return calls of diffrax; the equations are those of the case with JAX's functions."""
    jax = import_module("jax")
    jax.config.update("jax_enable_x64", True)
    jnp, package = import_module("jax.numpy"), import_module("diffrax")
    fun = _jax_pairs(jnp, case) if not case.scalar else case.make(jnp).fun
    term = package.ODETerm(lambda t, y, _: jnp.stack(fun(t, y)) if case.scalar else fun(t, y))

    def one(y0: Any, tolerance: Any) -> Any:
        step = package.PIDController(rtol=tolerance, atol=ATOL * tolerance)
        options = {"stepsize_controller": step, "max_steps": 2**24}
        return package.diffeqsolve(term, getattr(package, solver)(), 0.0, case.t_end, None, y0, **options).ys[-1]

    run = jax.jit(jax.vmap(one, in_axes=(0, None)) if case.members else one)
    y0 = jnp.array(case.y0)
    return lambda setting: np.array(run(y0, setting))


def _jax_pairs(jnp: Any, case: Case) -> Any:
    n = case.y0.size // 6
    alone, gm = jnp.eye(n), None if case.gm is None else jnp.array(case.gm)

    def fun(t: Any, y: Any) -> Any:
        q = y[: 3 * n].reshape(n, 3)
        d = q[:, None] - q[None, :]
        r2 = (d * d).sum(axis=-1) + alone
        if gm is None:
            s6 = r2**-3
            w = 24.0 * s6 * (2.0 * s6 - 1.0) / r2
        else:
            w = -gm[None, :] / (r2 * jnp.sqrt(r2))
        return jnp.concatenate([y[3 * n :], (w[..., None] * d).sum(1).ravel()])

    return fun


def rebound(integrator: str, case: Case) -> Solve:
    """Return calls of REBOUND; IAS15 and the like get a tolerance, others a number of steps."""
    package, keep_ctrl_c = import_module("rebound"), import_module("eip_scipy.integrations.rebound").keep_ctrl_c
    q, v = case.y0.reshape(2, -1, 3)
    name = integrator.partition(" ")[0].lower()

    def solve(setting: Any) -> np.ndarray:
        simulation = package.Simulation()
        simulation.integrator = name
        # Version 4 keeps an integrator's options in simulation.ri_<name>, version 5 in simulation.integrator.
        options = getattr(simulation, f"ri_{name}", None) or simulation.integrator
        for mass, position, velocity in zip(case.gm, q, v, strict=True):
            names = dict(zip(("x", "y", "z", "vx", "vy", "vz"), (*position, *velocity), strict=True))
            simulation.add(m=mass, **names)
        if integrator == "IAS15":
            options.epsilon = setting
        else:
            simulation.dt = case.t_end / setting
        if integrator == "WHFast c17":
            options.corrector, options.safe_mode = 17, 0
        with keep_ctrl_c():
            simulation.integrate(case.t_end)
        found = np.empty((2, len(case.gm), 3))
        simulation.serialize_particle_data(xyz=found[0], vxvyvz=found[1])
        return found.ravel()

    return solve


def _ours() -> Iterator[Solver]:
    stepped = lambda method: lambda case: method in case.steps and not case.members  # noqa: E731
    second = lambda case: plain(case) and case.plain.acceleration is not None  # noqa: E731
    for kind, prepare, fits, label in (
        (USER, ours, plain, ""),
        (USER, expression, lambda case: case.hamiltonian is not None, ", hamiltonian"),
        (READY, ready, lambda case: case.ready is not None, ", ready"),
    ):
        both = lambda other, fits=fits: lambda case: fits(case) and other(case)  # noqa: E731
        yield Solver(f"EIPDOP853{label}", "eip_scipy", kind, partial(prepare, "EIPDOP853"), fits)
        for method in ("EIPRKN12", "EIPGJ14"):
            yield Solver(f"{method}{label}", "eip_scipy", kind, partial(prepare, method), both(stepped(method)), method)
        yield Solver(f"EIPRKN12 adaptive{label}", "eip_scipy", kind, partial(prepare, "EIPRKN12"), both(second))
    yield Solver("EIPDOP853 in solve_ivp", "eip_scipy", USER, in_solve_ivp, plain)
    for method in ("EIPRadau", "EIPBDF"):
        yield Solver(method, "eip_scipy", USER, partial(ours, method), lambda case: case.stiff)
    members = lambda case: case.members  # noqa: E731
    for kept in ("invariants", "constraints"):
        yield Solver(f"EIPDOP853, {kept}", "eip_scipy", USER, partial(ours_mechanism, kept), moving)
    yield Solver("ensemble, EIPDOP853", "eip_scipy", USER, partial(our_members, "EIPDOP853"), members)
    yield Solver("ensemble, EIPRKN12", "eip_scipy", USER, partial(our_members, "EIPRKN12"), members, "EIPRKN12")


def _others() -> Iterator[Solver]:
    anything, stiff = lambda case: not (case.stiff or case.mechanism), lambda case: case.stiff
    scipy = partial(by_solve_ivp, "scipy.integrate")
    for method in ("RK45", "DOP853"):
        yield Solver(f"SciPy {method}", "scipy", OTHER, partial(scipy, method), plain)
    yield Solver("SciPy DOP853, a loop", "scipy", OTHER, partial(scipy, "DOP853"), lambda case: case.members)
    for method in ("Radau", "BDF", "LSODA"):
        yield Solver(f"SciPy {method}", "scipy", OTHER, partial(scipy, method), stiff)
    for method in ("Pr9", "SWAG"):
        yield Solver(f"extensisq {method}", "extensisq", OTHER, partial(scipy, extensisq(method)), plain)
    for method in ("DOP853", "Vern8"):
        yield Solver(f"CyRK {method}", "CyRK", OTHER, partial(cyrk, method), plain)
    single = lambda case: not (case.members or case.mechanism)  # noqa: E731
    yield Solver("numbalsoda dop853", "numbalsoda", OTHER, partial(numbalsoda, "dop853"), anything)
    yield Solver("numbalsoda lsoda", "numbalsoda", OTHER, partial(numbalsoda, "lsoda"), single)
    yield Solver("CVODE (scikit-SUNDAE)", "scikit-sundae", OTHER, sundae, lambda case: small(case) or case.stiff)
    taylor = lambda case: (case.scalar or case.gm is not None) and not case.stiff  # noqa: E731
    yield Solver("heyoka", "heyoka", OTHER, heyoka, taylor, warm=True)
    yield Solver("diffrax Dopri8", "diffrax", OTHER, partial(diffrax, "Dopri8"), anything)
    yield Solver("diffrax Kvaerno5", "diffrax", OTHER, partial(diffrax, "Kvaerno5"), stiff)
    for method in ("DOP853", "LSODA", "Radau"):
        yield Solver(f"SciPy {method}, mechanism", "scipy", OTHER, partial(scipy_mechanism, method, 0.0), moving)
    baumgarte = partial(scipy_mechanism, "DOP853", 5.0)
    yield Solver("SciPy DOP853, Baumgarte 5", "scipy", OTHER, baumgarte, lambda case: case.name == "four-bar")
    yield Solver("IDA (scikit-SUNDAE)", "scikit-sundae", OTHER, ida, moving)
    planets = lambda case: case.gm is not None  # noqa: E731
    yield Solver("REBOUND IAS15", "rebound", OTHER, partial(rebound, "IAS15"), planets)
    for method in ("WHFast c17", "TRACE", "MERCURIUS"):
        yield Solver(f"REBOUND {method}", "rebound", OTHER, partial(rebound, method), planets, "WHFast")


SOLVERS: tuple[Solver, ...] = (*_ours(), *_others())
