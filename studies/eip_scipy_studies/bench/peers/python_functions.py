"""Packages that take the user's plain Python function, the same one for all."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ..equations import Scene
from ._common import ATOL, COMPILED, PYTHON, Peer, Solve


def _by_solve_ivp(solve_ivp: Any, method: Any, fun: Any, scene: Scene, extra: dict[str, Any]) -> Solve:
    def solve(setting: float) -> np.ndarray:
        options = {"method": method, "rtol": setting, "atol": ATOL * setting, **extra}
        solution = solve_ivp(fun, (0.0, scene.t_end), scene.y0, **options)
        if not solution.success:
            raise RuntimeError(solution.message)
        return solution.y[:, -1]

    return solve


def _scipy(method: str, scene: Scene, **extra: Any) -> Solve:
    return _by_solve_ivp(import_module("scipy.integrate").solve_ivp, method, scene.plain().fun, scene, extra)


def _scipy_jitted(method: str, scene: Scene, **extra: Any) -> Solve:
    filling = scene.compiled().fun

    @import_module("numba").njit
    def fun(t, y):  # type: ignore[no-untyped-def]
        out = np.empty_like(y)
        filling(t, y, out)
        return out

    return _by_solve_ivp(import_module("scipy.integrate").solve_ivp, method, fun, scene, extra)


def _extensisq(method: str, scene: Scene, **extra: Any) -> Solve:
    found = getattr(import_module("extensisq"), method)
    return _by_solve_ivp(import_module("scipy.integrate").solve_ivp, found, scene.plain().fun, scene, extra)


def _cyrk(method: str, scene: Scene, **extra: Any) -> Solve:
    return _by_solve_ivp(import_module("CyRK").pysolve_ivp, method, scene.plain().fun, scene, extra)


def _sundae(scene: Scene, **extra: Any) -> Solve:
    cvode, fun = import_module("sksundae.cvode").CVODE, scene.plain().fun

    def fill(t: float, y: np.ndarray, out: np.ndarray) -> None:
        out[:] = fun(t, y)

    def solve(setting: float) -> np.ndarray:
        options = {"method": "Adams", "rtol": setting, "atol": ATOL * setting, "max_num_steps": 10**8, **extra}
        solution = cvode(fill, **options).solve(np.array([0.0, scene.t_end]), scene.y0)
        if not solution.success:
            raise RuntimeError(solution.message)
        return solution.y[-1]

    return solve


def _homproj(scene: Scene, **extra: Any) -> Solve:
    functions = scene.plain()
    count = np.size(functions.values(0.0, scene.y0))

    def one(k: int) -> dict[str, Any]:
        # The package passes the components as separate arguments.
        return {
            "invariants": lambda *y: np.atleast_1d(functions.values(0.0, np.array(y)))[k],
            "gradients": lambda *y: np.atleast_2d(functions.gradients(0.0, np.array(y)))[k],
        }

    pairs = [one(k) for k in range(count)]
    options = {name: [pair[name] for pair in pairs] for name in ("invariants", "gradients")}
    return _by_solve_ivp(import_module("homproj").solve_ivp, "DOP853", functions.fun, scene, options | extra)


def _desolver(method: str, scene: Scene, **extra: Any) -> Solve:
    desolver, fun = import_module("desolver"), scene.plain().fun

    def solve(setting: float) -> np.ndarray:
        system = desolver.OdeSystem(
            lambda t, y, **_: fun(t, y),
            y0=scene.y0,
            t=(0.0, scene.t_end),
            dt=1e-2 * scene.t_end,
            rtol=setting,
            atol=ATOL * setting,
        )
        system.method = method
        system.integrate(**extra)
        return np.asarray(system.y[-1])

    return solve


PEERS = (
    *(Peer(f"SciPy {name}", "scipy", PYTHON, partial(_scipy, name)) for name in ("RK45", "DOP853", "LSODA")),
    *(Peer(f"extensisq {name}", "extensisq", PYTHON, partial(_extensisq, name)) for name in ("Pr9", "SWAG")),
    *(Peer(f"CyRK {name}", "CyRK", PYTHON, partial(_cyrk, name)) for name in ("DOP853", "Vern8", "LSODA")),
    Peer("scikit-SUNDAE CVODE", "scikit-sundae", PYTHON, _sundae),
    Peer("homproj DOP853", "homproj", PYTHON, _homproj, projects=True),
    Peer("desolver RK87", "desolver", PYTHON, partial(_desolver, "RK87")),
    Peer("SciPy DOP853 (jitted)", "scipy", COMPILED, partial(_scipy_jitted, "DOP853")),
)
