"""A user's program with types, which uses each public name and the fields of each result.

mypy checks it as by --strict, and tests/acceptance/test_user_code.py runs it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import integrate as scipy_integrate

from eip_scipy import (
    EIPBDF,
    EIPDOP853,
    EIPGJ12,
    EIPGJ14,
    EIPRK1,
    EIPRK2,
    EIPRK3,
    EIPRK4,
    EIPRK5,
    EIPRK23,
    EIPRK45,
    EIPRKN8,
    EIPRKN12,
    Balance,
    Diagnostics,
    EIPRadau,
    Invariant,
    ProjectionWarning,
    check_gradient,
    eip_method,
    ensemble,
    equations,
    find_invariants,
    hamiltonian,
    integrate,
    load,
    particle_invariants,
    project,
    recommend,
    show_config,
    solve_ivp,
)
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.methods import Tableau
from eip_scipy.problems import kepler, nbody, solar_system
from eip_scipy.results import EnsembleResult, IntegrationResult, OdeResult, ProjectionResult, Recommendation
from eip_scipy.solvers import EIPSolver

Vector = NDArray[np.float64]


def fun(t: float, y: Vector) -> Vector:
    return np.array([y[1], -np.sin(y[0])])


def energy(t: float, y: Vector) -> float:
    return float(0.5 * y[1] ** 2 - np.cos(y[0]))


def gradient(t: float, y: Vector) -> Vector:
    return np.array([np.sin(y[0]), y[1]])


def crossing(t: float, y: Vector, params: Vector) -> float:
    return float(y[0])


def damped(t: float, y: Vector) -> Vector:
    return np.array([y[1], -np.sin(y[0]) - 1e-4 * y[1]])


H = Invariant(energy, gradient, name="H", target=None, scale=1.0)
E = Balance(energy, rate=lambda t, y: -1e-4 * y[1] ** 2, grad=gradient, name="E")
METHODS: list[type[EIPSolver]] = [EIPRK1, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPDOP853]
METHODS += [EIPRKN8, EIPRKN12, EIPGJ12, EIPGJ14, EIPRadau, EIPBDF, eip_method(scipy_integrate.RK45)]
METHODS += [eip_method(Tableau(A=[[0.0]], b=[1.0], order=1, name="Euler", reference="Euler"))]


def one_run() -> tuple[float, Vector, str, bool]:
    record = Diagnostics()
    sol: OdeResult = solve_ivp(fun, (0.0, 1.0), [1.0, 0.0], method=EIPRK4, h=0.1, invariants=[H], diagnostics=record)
    trusted: bool = sol.trusted
    message: str = sol.message
    states: Vector = sol.y
    largest: Vector = record.max_residual
    return float(largest.max()), states, message, trusted


def slow() -> float:
    run: OdeResult = solve_ivp(damped, (0.0, 1.0), [1.0, 0.0], method=EIPDOP853, h=0.1, invariants=[E])
    slowness: Vector = run.diagnostics.slowness
    return float(slowness[0])


def long_run(path: Path) -> int:
    run: IntegrationResult = integrate(
        kepler(), (0.0, 10.0), method=EIPRK4, save_every=2, events=crossing, dense_output=True
    )
    times: Vector = run.t
    roots: list[Any] = run.t_events or []
    seconds: float = run.wall_time
    names: tuple[str, ...] | None = run.component_names
    h: float | None = run.h
    evaluations: int = run.nfev + run.njev + run.nlu
    run.save(path)
    try:
        again = load(path)
    except CheckpointError as error:
        print(error)
        return -1
    print(again.status, seconds, names, h, roots, times.size, run.compiled, run.diagnostics.trusted)
    further = run.continue_to(20.0)
    return evaluations + further.status


def members() -> Vector:
    starts = np.array([[1.0, 0.0], [0.5, 0.0]])
    run: EnsembleResult = ensemble(fun, (0.0, 1.0), starts, method=EIPRK4, h=0.1, invariants=H)
    status: NDArray[np.int64] = run.status
    assert (status == 0).all()
    return run.y


def others() -> list[str]:
    back: ProjectionResult = project([1.0, 0.1], H, target=energy(0.0, np.array([1.0, 0.0])))
    y: Vector = back.y
    rank: int = back.rank
    momenta: list[Invariant] = particle_invariants([1.0, 2.0], dimension=2)
    found = [item.name for item in find_invariants(fun, [1.0, 0.0])]
    oscillator = hamiltonian("p**2/2 + q**2/2")
    lotka = equations({"x": "x*(1 - y)", "y": "y*(x - 1)"}, ["x", "y"])
    advice: Recommendation = recommend(oscillator, (0.0, 10.0), [1.0, 0.0], error=1e-6)
    difference: float = check_gradient(H, 0.0, [1.0, 0.0])
    planets = solar_system(years=1.0)
    two = nbody([1.0, 1e-3], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0]], t_span=(0.0, 1.0), G=1.0)
    right: Callable[..., Any] | None = planets.rhs
    warning: type[RuntimeWarning] = ProjectionWarning
    print(show_config(), y, rank, found, momenta, lotka.name, advice.reason, difference, two.h, right, warning)
    return [name for name in found if name is not None]
