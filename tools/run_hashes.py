#!/usr/bin/env python3
"""Print a hash of the bits of each of some 250 short runs, to compare the package before and after a change.

    python tools/run_hashes.py > before.txt      # then the change
    python tools/run_hashes.py | diff before.txt -

The runs cover all problems, tableaux, kinds of weights, options of a step, and interfaces, with built-in and with a
user's functions, called from Python and jitted. Compare files of one machine and one compiler only.
"""

from __future__ import annotations

import hashlib
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
import scipy.integrate
import sympy

import eip_scipy
from eip_scipy import Balance, Invariant, ensemble, equations, hamiltonian, integrate, project
from eip_scipy import problems as library
from eip_scipy.problems import nbody
from eip_scipy_studies.hard_cases import hard_cases

ADAPTIVE = ("EIPRK23", "EIPRK45", "EIPDOP853", "EIPRKN8", "EIPRKN12")
FIXED = ("EIPRK1", "EIPRK2", "EIPRK3", "EIPRK4", "EIPRK5", "EIPRK23", "EIPRK45", "EIPDOP853", "EIPRKN8", "EIPRKN12")
MULTISTEP = ("EIPGJ12", "EIPGJ14")
IMPLICIT = ("EIPRadau", "EIPBDF")
Y0 = np.array([0.4, 0.0, 0.0, 2.0])
Run = Callable[[], Any]


def fun(t, y):
    """Kepler's problem as a user of SciPy writes it."""
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return np.array([y[2], y[3], -y[0] / r3, -y[1] / r3])


def energy(t, y):
    """Energy of Kepler's problem."""
    return (y[2] ** 2 + y[3] ** 2) / 2 - (y[0] ** 2 + y[1] ** 2) ** -0.5


def momentum(t, y):
    """Angular momentum."""
    return y[0] * y[3] - y[1] * y[2]


def dragged(t, y):
    """Kepler's problem with drag."""
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return np.array([y[2], y[3], -y[0] / r3 - 1e-4 * y[2], -y[1] / r3 - 1e-4 * y[3]])


def drag(t, y):
    """Rate of the energy under drag."""
    return -1e-4 * (y[2] ** 2 + y[3] ** 2)


def method(name: str) -> Any:
    """Return a solver class by its name."""
    return getattr(eip_scipy, name)


def own_functions() -> Iterator[tuple[str, Run]]:
    """Yield runs of a user's functions by each interface."""
    jitted = [numba.njit(function) for function in (fun, energy, momentum)]
    for kind, (f, H, L) in (("python", (fun, energy, momentum)), ("jitted", jitted)):
        kept = [Invariant(H), Invariant(L)]
        for name in FIXED:
            yield (
                f"own {kind} {name}",
                lambda f=f, kept=kept, name=name: integrate(
                    f, (0, 10), Y0, method=method(name), h=0.02, invariants=kept
                ),
            )
        for name in (*ADAPTIVE, *IMPLICIT):
            yield (
                f"own {kind} {name} adaptive",
                lambda f=f, kept=kept, name=name: integrate(
                    f, (0, 10), Y0, method=method(name), rtol=1e-6, atol=1e-9, invariants=kept, dense_output=True
                ),
            )
        for name in MULTISTEP:
            yield (
                f"own {kind} {name}",
                lambda f=f, kept=kept, name=name: integrate(
                    f, (0, 10), Y0, method=method(name), h=0.005, invariants=kept
                ),
            )
    kept = [Invariant(energy), Invariant(momentum)]
    for name in (*ADAPTIVE, *IMPLICIT):
        yield (
            f"SciPy's solve_ivp {name}",
            lambda name=name: scipy.integrate.solve_ivp(
                fun,
                (0, 10),
                Y0,
                method=method(name),
                rtol=1e-6,
                atol=1e-9,
                invariants=kept,
                t_eval=np.linspace(0, 10, 31),
            ),
        )
    for name in (*ADAPTIVE, *FIXED):
        yield (
            f"solve_ivp {name} h",
            lambda name=name: eip_scipy.solve_ivp(
                fun, (0, 10), Y0, method=method(name), h=0.05, invariants=kept, dense_output=True
            ),
        )
    for name in ("RK23", "RK45", "DOP853"):
        yield (
            f"no invariants {name}",
            lambda name=name: scipy.integrate.solve_ivp(fun, (0, 10), Y0, method("EIP" + name)),
        )
    for function in (dragged, numba.njit(dragged)):
        balance = Balance(energy, drag) if function is dragged else Balance(numba.njit(energy), numba.njit(drag))
        yield (
            f"balance {function is dragged}",
            lambda function=function, balance=balance: integrate(
                function, (0, 10), Y0, method=eip_scipy.EIPRK45, rtol=1e-7, invariants=[balance]
            ),
        )


def options() -> Iterator[tuple[str, Run]]:
    """Yield runs of one problem by each kind of weights and each option of a step."""
    C = np.array([[1.0, 0.0, 0.0, 0.0]])
    table: dict[str, dict[str, Any]] = {
        "error": {},
        "euclidean": {"metric": "euclidean"},
        "sigma": {"metric": np.array([1.0, 2.0, 3.0, 4.0])},
        "blocks": {"blocks": 2},
        "index blocks": {"blocks": [np.array([0, 2])]},
        "old": {"direction": "old"},
        "midpoint": {"direction": "midpoint"},
        "twice": {"iterations": 2},
        "every": {"every": 3},
        "auto": {"every": "auto"},
        "compensated": {"compensated": True},
        "no reuse": {"reuse_f": False},
        "no check": {"check": False},
        "frame": {("frame" if hasattr(library.kepler(), "frame") else "linear_invariants"): (C, C.T)},
        "tangent": {"variations": "state"},
        "samples": {"t_eval": np.linspace(0, 20, 41)},
        "rows": {"save_every": 7},
    }
    for label, chosen in table.items():
        for name in ("EIPRK4", "EIPDOP853", "EIPRKN12"):
            yield (
                f"{label} {name}",
                lambda name=name, chosen=chosen: integrate(
                    library.kepler(), (0, 20), method=method(name), h=0.02, **chosen
                ),
            )
        if label != "compensated":
            yield (
                f"{label} EIPRK45 adaptive",
                lambda chosen=chosen: integrate(
                    library.kepler(), (0, 20), method=eip_scipy.EIPRK45, rtol=1e-7, atol=1e-9, **chosen
                ),
            )
    yield "project", lambda: project(Y0 + 1e-3, [Invariant(energy, target=-0.5)], sigma=np.arange(1.0, 5.0))


def ready_problems() -> Iterator[tuple[str, Run]]:
    """Yield runs of the library's problems."""
    H = "(px**2 + py**2)/2 + (x**2 + y**2)/2 + x**2*y - y**3/3"
    made: dict[str, Any] = {
        "kepler": library.kepler(),
        "harmonic": library.harmonic(),
        "pythagorean": library.pythagorean(),
        "figure eight": library.figure_eight(),
        "satellite": library.satellite(
            [7000.0, 0, 0], [0, 4.0, 6.0], mu=398600.4, radius=6378.1, j2=1.08e-3, t_span=(0, 6e4), h=60.0
        ),
        "uniform field": library.uniform_field(),
        "uniform field, velocity": library.uniform_field(form="velocity"),
        "tokamak": library.tokamak(),
        "hamiltonian": hamiltonian(H),
        "equations": equations(["y1", "-y0"], ["y0", "y1"], invariants={"E": "y0**2 + y1**2"}),
    }
    starts = {"hamiltonian": [0.1, 0.2, 0.3, 0.1], "equations": [1.0, 0.0]}
    for name, problem in made.items():
        h = problem.h or 0.02
        span = (0.0, 200 * h)
        start = starts.get(name, problem.y0)
        for solver in ("EIPRK4", "EIPDOP853"):
            yield (
                f"{name} {solver}",
                lambda problem=problem, span=span, start=start, solver=solver, h=h: integrate(
                    problem, span, start, method=method(solver), h=h, check=False
                ),
            )
    comet, solar = library.comet(), {
        "solar system": {}, "relativity": {"forces": ("eih",)}, "balances": {"balances": "kepler"},
        "quantities": {"balances": ("kepler", "momentum", "laplace")},
    }  # fmt: skip
    yield "comet", lambda: integrate(comet, (0, 20), method=eip_scipy.EIPRKN12, rtol=1e-9, atol=1e-12)
    for label, chosen in solar.items():
        for name, h in (("EIPRK4", 0.002), ("EIPRKN12", 0.01), ("EIPGJ14", 1 / 600)):
            if name == "EIPRKN12" and chosen:  # forces that depend on velocities, and balances, are refused
                continue
            yield (
                f"{label} {name}",
                lambda chosen=chosen, name=name, h=h: integrate(
                    library.solar_system(**chosen), (0, 300 * h), method=method(name), h=h, check=False
                ),
            )
    rng = np.random.default_rng(5)
    bodies = nbody(
        rng.uniform(0.5, 1, 12), rng.standard_normal((12, 3)), rng.standard_normal((12, 3)) / 9, t_span=(0, 0.2), h=1e-3
    )
    yield "twelve bodies", lambda: integrate(bodies, (0, 0.2), method=eip_scipy.EIPRK4, h=1e-3)
    yield "twelve bodies, eight", lambda: ensemble(bodies, (0, 0.2), [bodies.y0] * 9, method=eip_scipy.EIPRKN8, h=1e-3)
    transformed = library.time_transformed(library.pythagorean(), 5.0)
    yield "time transformed", lambda: integrate(transformed, method=eip_scipy.EIPDOP853, rtol=1e-9, atol=1e-9)


def fields() -> Iterator[tuple[str, Run]]:
    """Yield runs of the Gross-Pitaevskii equation."""
    grid = library.Grid((16, 16), (-4, -4), (4, 4))
    x, y = grid.mesh()
    psi = (np.exp(-(x**2 + y**2) / 2) * (1 + 0.3 * x + 0.2j * y)).astype(complex)
    for label, chosen in (("at rest", {}), ("rotating", {"Omega": 0.6}), ("zero", {"Omega": 0.3, "nyquist": "zero"})):
        gpe = library.GrossPitaevskii(grid, lambda x, y: 0.5 * (x**2 + 1.2**2 * y**2), beta=2.0, **chosen)
        for name in ("EIPRK4", "EIPDOP853"):
            yield (
                f"condensate {label} {name}",
                lambda gpe=gpe, name=name: integrate(gpe.problem(psi, 0.5), method=method(name), h=0.005),
            )


def mechanisms() -> Iterator[tuple[str, Run]]:
    """Yield runs of mechanisms, from SymPy and from functions."""
    from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

    x, y = dynamicsymbols("x y")
    L = (x.diff() ** 2 + y.diff() ** 2) / 2 - sympy.Float(9.81) * y
    slide = eip_scipy.problems.mechanics(
        LagrangesMethod(L, [x, y], hol_coneqs=[y - x**2]),
        {},
        {x: 1, y: 1},
        {x.diff(): 0.5, y.diff(): 1.0},
        t_span=(0, 2),
    )
    yield "slide", lambda: integrate(slide, method=eip_scipy.EIPDOP853, rtol=1e-8, atol=1e-8)
    pendulum = library.mechanism(
        [1, 1], [0, -9.81], numba.njit(lambda t, q: np.array([q[0] ** 2 + q[1] ** 2 - 1])),
        q0=[1.0, 0.0], u0=[0.0, 0.0], t_span=(0, 2),
    )  # fmt: skip
    yield "pendulum", lambda: integrate(pendulum, method=eip_scipy.EIPDOP853, rtol=1e-8, atol=1e-8)


def members() -> Iterator[tuple[str, Run]]:
    """Yield ensembles."""
    starts = Y0 * np.linspace(0.9, 1.1, 13)[:, None]
    kept = [Invariant(numba.njit(energy)), Invariant(numba.njit(momentum))]
    for name in ("EIPRK4", "EIPDOP853"):
        yield (
            f"members {name}",
            lambda name=name: ensemble(library.kepler(), (0, 20), starts, method=method(name), h=0.02),
        )
        yield (
            f"own members {name}",
            lambda name=name: ensemble(numba.njit(fun), (0, 20), starts, method=method(name), h=0.02, invariants=kept),
        )
    yield "adaptive members", lambda: ensemble(library.kepler(), (0, 20), starts, method=eip_scipy.EIPRK45, rtol=1e-7)


def hard() -> Iterator[tuple[str, Run]]:
    """Yield the hard cases by two methods."""
    for case in hard_cases():
        for name, rtol in (("EIPRK45", 1e-5), ("EIPDOP853", 1e-8)):
            yield (
                f"hard {case.name} {name}",
                lambda case=case, name=name, rtol=rtol: integrate(
                    case.problem, method=method(name), rtol=rtol, atol=rtol, max_step=np.inf
                ),
            )


def digest(result: Any) -> str:
    """Return a hash of the numbers of a result."""
    found = hashlib.sha256()
    for name in ("t", "y", "invariants", "stm", "nfev", "status", "correction"):
        value = getattr(result, name, None)
        if value is not None:
            found.update(np.ascontiguousarray(value).tobytes())
    if getattr(result, "sol", None) is not None:
        found.update(np.ascontiguousarray(result.sol(np.linspace(result.t[0], result.t[-1], 17))).tobytes())
    return found.hexdigest()[:16]


def main() -> None:
    """Print a line for each run; an argument keeps the runs whose names contain it."""
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    warnings.simplefilter("ignore")
    for group in (own_functions, options, ready_problems, fields, mechanisms, members, hard):
        for name, run in group():
            if wanted in name:
                try:
                    line = digest(run())
                except (ValueError, TypeError, NotImplementedError) as error:  # a combination that is refused stays so
                    line = f"{type(error).__name__}: {str(error)[:60]!r}"
                print(f"{name:44} {line}", flush=True)


if __name__ == "__main__":
    main()
