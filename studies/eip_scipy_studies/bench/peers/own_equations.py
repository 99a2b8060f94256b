"""Packages that need the equations in their own form: heyoka's expressions, JAX's arrays, REBOUND's bodies."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ..equations import EQUATIONS, Scene
from ._common import ATOL, OWN, Peer, Solve


def _heyoka(scene: Scene, **extra: Any) -> Solve:
    heyoka = import_module("heyoka")
    bodies = scene.equations == "bodies"
    if bodies:
        gm = scene.params["gm"]
        system = heyoka.model.nbody(len(gm), masses=gm, Gconst=1.0)
        start = scene.y0.reshape(2, -1, 3).swapaxes(0, 1).ravel()
    else:
        names = heyoka.make_vars(*(f"y{k}" for k in range(scene.y0.size)))
        system = list(zip(names, EQUATIONS[scene.equations](heyoka.sqrt).fun(0.0, names), strict=True))
        start = scene.y0
    made: dict[float, Any] = {}

    def solve(setting: float) -> np.ndarray:
        if setting not in made:  # compiled for each tolerance, before the timed run
            made[setting] = heyoka.taylor_adaptive(system, start, tol=setting, **extra)
        integrator = made[setting]
        integrator.time, integrator.state[:] = 0.0, start
        outcome = integrator.propagate_until(scene.t_end)[0]
        if outcome != heyoka.taylor_outcome.time_limit:
            raise RuntimeError(str(outcome))
        state = np.array(integrator.state)
        return state.reshape(-1, 2, 3).swapaxes(0, 1).ravel() if bodies else state

    return solve


def _diffrax(scene: Scene, **extra: Any) -> Solve:
    jax = import_module("jax")
    jax.config.update("jax_enable_x64", True)
    jnp, diffrax = import_module("jax.numpy"), import_module("diffrax")
    fun = _jax_bodies(jnp, scene) if scene.equations == "bodies" else EQUATIONS[scene.equations](jnp.sqrt).fun
    term = diffrax.ODETerm(lambda t, y, _: jnp.stack(fun(t, y)) if isinstance(value := fun(t, y), tuple) else value)

    @jax.jit
    def run(y0: Any, tolerance: Any) -> Any:
        control = diffrax.PIDController(rtol=tolerance, atol=ATOL * tolerance)
        options = {"stepsize_controller": control, "max_steps": 2**24, **extra}
        return diffrax.diffeqsolve(term, diffrax.Dopri8(), 0.0, scene.t_end, None, y0, **options).ys[-1]

    y0 = jnp.array(scene.y0)
    return lambda setting: np.array(run(y0, setting))


def _jax_bodies(jnp: Any, scene: Scene) -> Any:
    m, n = jnp.array(scene.params["gm"]), len(scene.params["gm"])
    alone = jnp.eye(n)

    def fun(t: Any, y: Any) -> Any:
        q = y[: 3 * n].reshape(n, 3)
        d = q[:, None] - q[None, :]
        r2 = (d * d).sum(axis=-1) + alone
        a = -jnp.einsum("ij,j,ijk->ik", 1.0 / (r2 * jnp.sqrt(r2)), m, d)
        return jnp.concatenate([y[3 * n :], a.ravel()])

    return fun


def _rebound(integrator: str, scene: Scene, **extra: Any) -> Solve:
    run = import_module("eip_scipy.integrations.rebound").run
    gm = np.array(scene.params["gm"])
    centre, drift = (gm / gm.sum()) @ scene.y0.reshape(2, -1, 3)  # REBOUND subtracts it
    moved = np.concatenate([np.tile(centre + scene.t_end * drift, gm.size), np.tile(drift, gm.size)])

    def solve(setting: float) -> np.ndarray:
        # IAS15 uses its own tolerance; for the other methods the setting is the number of steps.
        if integrator == "ias15":
            options = {"h": scene.t_end, "n_steps": 1, "epsilon": setting}
        else:
            options = {"h": scene.t_end / setting, "n_steps": round(setting)}
        return run(gm, scene.y0, integrator, **options, **extra).y[:, -1] + moved

    return solve


PEERS = (
    Peer("heyoka", "heyoka", OWN, _heyoka, scenes=(*EQUATIONS, "bodies"), warm=True),
    Peer("diffrax Dopri8", "diffrax", OWN, _diffrax, scenes=(*EQUATIONS, "bodies")),
    Peer("REBOUND IAS15", "rebound", OWN, partial(_rebound, "ias15"), scenes=("bodies",)),
    Peer("REBOUND WHFast c17", "rebound", OWN, partial(_rebound, "whfast-c17"), True, scenes=("bodies",)),
)
