"""``eip-scipy study gradients``: cost of a compiled gradient compared with one written by hand.

Each system runs by `integrate` in turn with hand-written jitted gradients and without any, so that the gradients are
compiled from the invariants. The ratio is that of the least times. The hand-written gradients compute common terms
once, as an author would write them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from eip_scipy import EIPRK4, Invariant, integrate

from ..report import needed, table
from ..study import Measurement, Session, option
from ..timing import least

njit = needed("numba", '"eip_scipy[numba]"').njit
STEPS, H = 50_000, 0.01


@njit
def kepler(t, y, out):
    r = math.sqrt(y[0] * y[0] + y[1] * y[1])
    w = 1.0 / (r * r * r)
    out[0], out[1], out[2], out[3] = y[2], y[3], -w * y[0], -w * y[1]


@njit
def kepler_energy(t, y):
    return 0.5 * (y[2] * y[2] + y[3] * y[3]) - 1.0 / math.sqrt(y[0] * y[0] + y[1] * y[1])


@njit
def kepler_energy_gradient(t, y, out):
    r = math.sqrt(y[0] * y[0] + y[1] * y[1])
    w = 1.0 / (r * r * r)
    out[0], out[1], out[2], out[3] = w * y[0], w * y[1], y[2], y[3]


@njit
def kepler_momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


@njit
def kepler_momentum_gradient(t, y, out):
    out[0], out[1], out[2], out[3] = y[3], -y[2], -y[1], y[0]


INERTIA = np.array([1.0, 2.0, 3.5])


@njit
def rigid(t, y, out):
    w = y / INERTIA
    out[0], out[1], out[2] = y[1] * w[2] - y[2] * w[1], y[2] * w[0] - y[0] * w[2], y[0] * w[1] - y[1] * w[0]


@njit
def rigid_energy(t, y):
    return 0.5 * (y[0] * y[0] / INERTIA[0] + y[1] * y[1] / INERTIA[1] + y[2] * y[2] / INERTIA[2])


@njit
def rigid_energy_gradient(t, y, out):
    for i in range(3):
        out[i] = y[i] / INERTIA[i]


@njit
def casimir(t, y):
    return y[0] * y[0] + y[1] * y[1] + y[2] * y[2]


@njit
def casimir_gradient(t, y, out):
    for i in range(3):
        out[i] = 2.0 * y[i]


MASSES = np.array([1.0, 0.1])


@njit
def bodies(t, y, out):
    dx, dy, dz = y[3] - y[0], y[4] - y[1], y[5] - y[2]
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    w = 1.0 / (r * r * r)
    for k, d in enumerate((dx, dy, dz)):
        out[k], out[3 + k] = y[6 + k], y[9 + k]
        out[6 + k], out[9 + k] = MASSES[1] * w * d, -MASSES[0] * w * d


@njit
def bodies_energy(t, y):
    kinetic, square = 0.0, 0.0
    for k in range(3):
        kinetic += MASSES[0] * y[6 + k] ** 2 + MASSES[1] * y[9 + k] ** 2
        square += (y[3 + k] - y[k]) ** 2
    return 0.5 * kinetic - MASSES[0] * MASSES[1] / math.sqrt(square)


@njit
def bodies_energy_gradient(t, y, out):
    dx, dy, dz = y[3] - y[0], y[4] - y[1], y[5] - y[2]
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    w = MASSES[0] * MASSES[1] / (r * r * r)
    for k, d in enumerate((dx, dy, dz)):
        out[k], out[3 + k] = -w * d, w * d
        out[6 + k], out[9 + k] = MASSES[0] * y[6 + k], MASSES[1] * y[9 + k]


@njit
def bodies_momentum(t, y):
    return (
        MASSES[0] * (y[1] * y[8] - y[2] * y[7]) + MASSES[1] * (y[4] * y[11] - y[5] * y[10]),
        MASSES[0] * (y[2] * y[6] - y[0] * y[8]) + MASSES[1] * (y[5] * y[9] - y[3] * y[11]),
        MASSES[0] * (y[0] * y[7] - y[1] * y[6]) + MASSES[1] * (y[3] * y[10] - y[4] * y[9]),
    )


@njit
def bodies_momentum_gradient(t, y, out):
    out[:] = 0.0
    for b in range(2):
        q, v, m = 3 * b, 6 + 3 * b, MASSES[b]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[i, q + j], out[i, q + k] = m * y[v + k], -m * y[v + j]
            out[i, v + k], out[i, v + j] = m * y[q + j], -m * y[q + k]


TWO_BODIES = [-0.05, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, -0.15, -0.01, 0.0, 1.4, 0.1]
SYSTEMS = {
    "Kepler, n = 4, H": (kepler, [0.5, 0, 0, math.sqrt(3.0)], [(kepler_energy, kepler_energy_gradient)]),
    "Kepler, n = 4, H and L": (
        kepler,
        [0.5, 0, 0, math.sqrt(3.0)],
        [(kepler_energy, kepler_energy_gradient), (kepler_momentum, kepler_momentum_gradient)],
    ),
    "rigid body, n = 3, H and C": (
        rigid,
        [0.3, 1.0, 0.2],
        [(rigid_energy, rigid_energy_gradient), (casimir, casimir_gradient)],
    ),
    "two bodies, n = 12, H": (bodies, TWO_BODIES, [(bodies_energy, bodies_energy_gradient)]),
    "two bodies, n = 12, H and L": (
        bodies,
        TWO_BODIES,
        [(bodies_energy, bodies_energy_gradient), (bodies_momentum, bodies_momentum_gradient)],
    ),
}


def seconds(name: str, written: bool) -> float:
    """Return the seconds per step of a run of the system `name`.

    Gradients are those written by hand if `written` is true, otherwise they are compiled from the invariants.
    """
    fun, y0, pairs = SYSTEMS[name]
    kept = [Invariant(value, gradient if written else None, in_place=written) for value, gradient in pairs]
    options: dict[str, Any] = {"method": EIPRK4, "h": H, "in_place": True, "invariants": kept, "compiled": True}
    return integrate(fun, (0.0, STEPS * H), y0, **options).wall_time / STEPS


@dataclass(frozen=True, kw_only=True)
class Gradients(Measurement[dict[str, dict[str, float]]]):
    """Command ``eip-scipy study gradients``."""

    repeats: int = option(
        7, "runs of each system with each kind of gradient (default: %(default)s)", type=int, metavar="N"
    )

    def measure(self, session: Session) -> dict[str, dict[str, float]]:
        kinds = {"by hand": True, "compiled": False}
        found = {}
        with session.bar(len(SYSTEMS), "gradients", "system") as bar:
            for name in SYSTEMS:
                actions = {kind: partial(seconds, name, written) for kind, written in kinds.items()}
                best = least(actions, turns=self.repeats)
                found[name] = best | {"ratio": best["compiled"] / best["by hand"]}
                bar.update()
        return found

    def table(self, found: dict[str, dict[str, float]]) -> str:
        body = [
            (name, [f"{1e6 * row['by hand']:.3f}", f"{1e6 * row['compiled']:.3f}", f"{row['ratio']:.2f}"])
            for name, row in found.items()
        ]
        return table([["by hand", "[us a step]"], ["compiled", "[us a step]"], ["ratio"]], body)
