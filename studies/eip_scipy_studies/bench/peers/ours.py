"""Our own methods, in the form of the other packages' adapters."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ..equations import EQUATIONS, Functions, Scene
from ._common import ATOL, COMPILED, OWN, PYTHON, Peer, Solve

SECOND_ORDER = ("kepler", "henon_heiles", "bodies")


def _end(result: Any) -> np.ndarray:
    if not result.success:
        raise RuntimeError(result.message)
    return result.y[:, -1]


def _kept(functions: Functions) -> Any:
    return import_module("eip_scipy").Invariant(functions.values, functions.gradients)


def _problem(scene: Scene) -> Any:
    q, v = scene.y0.reshape(2, -1, 3)
    return import_module("eip_scipy.problems").nbody(scene.params["gm"], q, v, t_span=(0.0, scene.t_end))


def _run(method: str, arguments: dict[str, Any], t_end: float, options: dict[str, Any], setting: float) -> np.ndarray:
    eip = import_module("eip_scipy")
    if method in ("EIPRKN12", "EIPGJ14", "EIPGJ12", "EIPRK4"):
        control: dict[str, Any] = {"h": t_end / setting}
    else:
        control = {"rtol": setting, "atol": ATOL * setting, "h": None}
    result = eip.integrate(**arguments, t_span=(0.0, t_end), method=getattr(eip, method), **control, **options)
    return _end(result)


def _right_hand_side(method: str, functions: Functions) -> dict[str, Any]:
    """Return the keyword argument of `integrate` that gives the equations: `acceleration` or `fun`.

    It is `acceleration` for the methods that need only the accelerations.
    """
    if method in ("EIPRKN12", "EIPGJ12", "EIPGJ14"):
        return {"acceleration": functions.acc}
    return {"fun": functions.fun}


def _python(method: str, scene: Scene, every: int = 1, **extra: Any) -> Solve:
    functions = scene.plain()
    options = {"invariants": _kept(functions), "every": every, **extra}
    return partial(_run, method, {**_right_hand_side(method, functions), "y0": scene.y0}, scene.t_end, options)


def _in_solve_ivp(scene: Scene, **extra: Any) -> Solve:
    solve_ivp, method = import_module("scipy.integrate").solve_ivp, import_module("eip_scipy").EIPDOP853
    functions = scene.plain()
    options = {"method": method, "invariants": _kept(functions), **extra}

    def solve(setting: float) -> np.ndarray:
        return _end(
            solve_ivp(functions.fun, (0.0, scene.t_end), scene.y0, rtol=setting, atol=ATOL * setting, **options)
        )

    return solve


def _compiled(method: str, scene: Scene, every: int = 1, **extra: Any) -> Solve:
    functions = scene.compiled()
    options = {"compiled": True, "every": every, **extra}
    if scene.equations == "bodies":
        return partial(_run, method, {"fun": _with_own_function(scene, functions)}, scene.t_end, options)
    arguments = {"y0": scene.y0, "in_place": True, "invariants": _kept(functions)}
    arguments |= _right_hand_side(method, functions)
    return partial(_run, method, arguments, scene.t_end, options)


def _with_own_function(scene: Scene, functions: Functions) -> Any:
    """Return the problem that `nbody` makes, with its compiled invariants and the jitted equations of `functions`."""
    njit, right = import_module("numba").njit, functions.fun
    filling: Any = functions.acc

    @njit
    def acc(t, q, params):  # type: ignore[no-untyped-def]
        out = np.empty_like(q)
        filling(t, q, out)
        return out

    @njit
    def rhs(t, y, out, params):  # type: ignore[no-untyped-def]
        right(t, y, out)

    return replace(_problem(scene), rhs=rhs, acc=acc)


def _native(method: str, scene: Scene, every: int = 1, **extra: Any) -> Solve:
    return partial(_run, method, {"fun": _problem(scene)}, scene.t_end, {"every": every, **extra})


def _each(takes: str, make: Any, scenes: tuple[str, ...]) -> list[Peer]:
    """Return EIPDOP853, EIPRKN12 and EIPGJ12 as `Peer` objects, for functions of the kind `takes`.

    `takes` is `PYTHON`, `COMPILED` or `OWN`. ``make(method, scene, ...)`` prepares a method, and `scenes` selects
    problems, as `prepare` and `scenes` of `Peer` do. The last two methods are only for problems q'' = a(q).
    """
    label = {PYTHON: "", COMPILED: " (jitted)", OWN: " (problem)"}[takes]
    second = scenes or SECOND_ORDER
    return [
        Peer(f"EIPDOP853{label}", "eip_scipy", takes, partial(make, "EIPDOP853"), scenes=scenes),
        Peer(f"EIPRKN12{label}", "eip_scipy", takes, partial(make, "EIPRKN12", every=10), True, second),
        Peer(f"EIPGJ12{label}", "eip_scipy", takes, partial(make, "EIPGJ12", every=10), True, second),
    ]


PEERS = (
    *_each(PYTHON, _python, ()),
    Peer("EIPDOP853, every=10", "eip_scipy", PYTHON, partial(_python, "EIPDOP853", every=10)),
    Peer("EIPDOP853 in solve_ivp", "eip_scipy", PYTHON, _in_solve_ivp),
    *_each(COMPILED, _compiled, ()),
    Peer(
        "EIPDOP853, every=10 (jitted)",
        "eip_scipy",
        COMPILED,
        partial(_compiled, "EIPDOP853", every=10),
        scenes=tuple(EQUATIONS),
    ),
    *_each(OWN, _native, ("bodies",)),
    Peer("EIPGJ14 (problem)", "eip_scipy", OWN, partial(_native, "EIPGJ14", every=10), True, ("bodies",)),
)
