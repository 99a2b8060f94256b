"""Many members of Kepler's problem at once, on one core."""

from __future__ import annotations

import math
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ..equations import EQUATIONS, Scene
from ._common import ATOL, COMPILED, OWN, PYTHON, Peer, Solve

MEMBERS = ("members",)
LANES = 4  # width of heyoka's batches: four doubles are a vector of AVX2


def _ours(method: str, scene: Scene) -> Solve:
    eip, functions = import_module("eip_scipy"), scene.compiled()
    second = method != "EIPDOP853"
    kept = eip.Invariant(functions.values, functions.gradients)
    right_hand_side = {"acceleration": functions.acc} if second else {"fun": functions.fun}

    def solve(setting: float) -> np.ndarray:
        control = {"h": scene.t_end / setting, "every": 10} if second else {"rtol": setting, "atol": ATOL * setting}
        run = eip.ensemble(
            **right_hand_side, t_span=(0.0, scene.t_end), y0s=scene.y0, method=getattr(eip, method), invariants=kept,
            executor=1, in_place=True, compiled=True, **control,
        )  # fmt: skip
        return run.y

    return solve


def _scipy(scene: Scene) -> Solve:
    solve_ivp, kepler = import_module("scipy.integrate").solve_ivp, EQUATIONS["kepler"](math.sqrt).fun

    def one(y0: np.ndarray, tolerance: float) -> np.ndarray:
        control = {"method": "DOP853", "rtol": tolerance, "atol": ATOL * tolerance}
        return solve_ivp(lambda t, y: np.array(kepler(t, y)), (0.0, scene.t_end), y0, **control).y[:, -1]

    return lambda setting: np.array([one(y0, setting) for y0 in scene.y0])


def _numbalsoda(scene: Scene) -> Solve:
    peer, numba, filling = import_module("numbalsoda"), import_module("numba"), scene.compiled().fun
    dop853, times, params, n = peer.dop853, np.array([0.0, scene.t_end]), np.zeros(1), scene.y0.shape[1]

    @numba.cfunc(peer.lsoda_sig)
    def fun(t, y, out, params):  # type: ignore[no-untyped-def]
        filling(t, numba.carray(y, (n,)), numba.carray(out, (n,)))

    address = fun.address

    @numba.njit
    def each(starts, rtol, atol):  # type: ignore[no-untyped-def]
        ends = np.empty_like(starts)
        for k in range(len(starts)):
            states, _ = dop853(address, starts[k], times, params, rtol=rtol, atol=atol, mxstep=10**7)
            ends[k] = states[-1]
        return ends

    return lambda setting: each(scene.y0, setting, ATOL * setting)


def _heyoka(scene: Scene) -> Solve:
    heyoka = import_module("heyoka")
    names = heyoka.make_vars("x", "y", "u", "v")
    system = list(zip(names, EQUATIONS["kepler"](heyoka.sqrt).fun(0.0, names), strict=True))
    made: dict[float, Any] = {}

    def solve(setting: float) -> np.ndarray:
        if setting not in made:
            made[setting] = heyoka.taylor_adaptive_batch(system, np.ones((4, LANES)), tol=setting)
        integrator, ends = made[setting], np.empty_like(scene.y0)
        for k in range(0, len(ends), LANES):
            integrator.set_time(0.0)
            integrator.state[:] = scene.y0[k : k + LANES].T
            integrator.propagate_until(scene.t_end)
            ends[k : k + LANES] = integrator.state.T
        return ends

    return solve


def _diffrax(scene: Scene) -> Solve:
    jax = import_module("jax")
    jax.config.update("jax_enable_x64", True)
    jnp, diffrax = import_module("jax.numpy"), import_module("diffrax")
    kepler = EQUATIONS["kepler"](jnp.sqrt).fun
    term = diffrax.ODETerm(lambda t, y, _: jnp.stack(kepler(t, y)))

    def one(y0: Any, tolerance: Any) -> Any:
        control = diffrax.PIDController(rtol=tolerance, atol=ATOL * tolerance)
        options = {"stepsize_controller": control, "max_steps": 2**20}
        return diffrax.diffeqsolve(term, diffrax.Dopri8(), 0.0, scene.t_end, None, y0, **options).ys[-1]

    run, y0s = jax.jit(jax.vmap(one, in_axes=(0, None))), jnp.array(scene.y0)
    return lambda setting: np.array(run(y0s, setting))


PEERS = (
    Peer("ensemble, EIPDOP853", "eip_scipy", COMPILED, partial(_ours, "EIPDOP853"), scenes=MEMBERS),
    Peer("ensemble, EIPRKN12", "eip_scipy", COMPILED, partial(_ours, "EIPRKN12"), True, MEMBERS),
    Peer("SciPy DOP853, a loop", "scipy", PYTHON, _scipy, scenes=MEMBERS),
    Peer("numbalsoda dop853, a jitted loop", "numbalsoda", COMPILED, _numbalsoda, scenes=MEMBERS),
    Peer(f"heyoka, batches of {LANES}", "heyoka", OWN, _heyoka, scenes=MEMBERS, warm=True),
    Peer("diffrax Dopri8, vmap", "diffrax", OWN, _diffrax, scenes=MEMBERS),
)
