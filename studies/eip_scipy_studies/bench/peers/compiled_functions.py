"""Packages that take functions compiled by Numba, by pointer: their loop contains no Python."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ..equations import Scene
from ._common import ATOL, COMPILED, Peer, Solve


def _cyrk(method: str, scene: Scene, **extra: Any) -> Solve:
    cyrk, numba, filling, n = import_module("CyRK"), import_module("numba"), scene.compiled().fun, scene.y0.size

    def fun(out, t, y, params):  # type: ignore[no-untyped-def]
        filling(t, numba.carray(y, (n,)), numba.carray(out, (n,)))

    address = cyrk.nb_diffeq_addr(fun)

    def solve(setting: float) -> np.ndarray:
        options = {"method": method, "rtol": setting, "atol": ATOL * setting, **extra}
        solution = cyrk.nbsolve2_ivp(address, (0.0, scene.t_end), scene.y0, **options)
        if not solution.success:
            raise RuntimeError(solution.message)
        return np.array(solution.y[:, -1])

    return solve


def _numbalsoda(method: str, scene: Scene, **extra: Any) -> Solve:
    peer, numba, filling, n = import_module("numbalsoda"), import_module("numba"), scene.compiled().fun, scene.y0.size

    @numba.cfunc(peer.lsoda_sig)
    def fun(t, y, out, params):  # type: ignore[no-untyped-def]
        filling(t, numba.carray(y, (n,)), numba.carray(out, (n,)))

    call, times = getattr(peer, method), np.array([0.0, scene.t_end])
    params = np.zeros(1)

    def solve(setting: float) -> np.ndarray:
        options = {"rtol": setting, "atol": ATOL * setting, "mxstep": 10**7, **extra}
        states, success = call(fun.address, scene.y0, times, params, **options)
        if not success:
            raise RuntimeError("numbalsoda says success = False")
        return states[-1]

    return solve


PEERS = (
    Peer("CyRK Vern8 (jitted)", "CyRK", COMPILED, partial(_cyrk, "Vern8")),
    *(Peer(f"numbalsoda {name}", "numbalsoda", COMPILED, partial(_numbalsoda, name)) for name in ("lsoda", "dop853")),
)
