"""One family of compiled functions whose coefficients come through params: Numba compiles them once for all systems.

Particles in the plane in an anharmonic trap, each tied to the next one by a spring: they keep the energy.
The state is (x1, y1, x2, y2, ..., their velocities), params are (k, b, c) of the trap and springs.
"""

import numpy as np
from numba import njit

from eip_scipy import Invariant
from eip_scipy_studies.bench.families import System


@njit
def acceleration(t, q, out, p):
    k, b, c = p
    n = q.size // 2
    for i in range(n):
        s = k + b * (q[2 * i] ** 2 + q[2 * i + 1] ** 2)
        before, after = (i - 1) % n, (i + 1) % n
        for j in range(2):
            x = q[2 * i + j]
            out[2 * i + j] = -s * x + c * (q[2 * before + j] - 2.0 * x + q[2 * after + j])


@njit
def motion(t, y, out, p):
    half = y.size // 2
    for i in range(half):
        out[i] = y[half + i]
    acceleration(t, y[:half], out[half:], p)


@njit
def energy(t, y, p):
    k, b, c = p
    half = y.size // 2
    total = 0.0
    for i in range(0, half, 2):
        s = y[i] ** 2 + y[i + 1] ** 2
        after = (i + 2) % half
        d = (y[i] - y[after]) ** 2 + (y[i + 1] - y[after + 1]) ** 2
        total += 0.5 * (y[half + i] ** 2 + y[half + i + 1] ** 2 + k * s + 0.5 * b * s * s + c * d)
    return total


@njit
def energy_gradient(t, y, out, p):
    half = y.size // 2
    acceleration(t, y[:half], out[:half], p)
    for i in range(half):
        out[i] = -out[i]
        out[half + i] = y[half + i]


@njit
def energy_gradient_by_f(t, y, f, out, p):
    half = y.size // 2
    for i in range(half):
        out[i] = -f[half + i]
        out[half + i] = f[i]


NAME = "jitted"
KEPT = {"energy": (energy, energy_gradient, False), "energy by f": (energy, energy_gradient_by_f, True)}
# Few, since Numba compiles each choice by itself.
CHOICES = ((), ("energy",), ("energy by f",), ("energy", "energy by f"))


def jitted_system(rng):
    """A system of the family, what is to be kept of it, and its params."""
    n = int(rng.integers(1, 5))
    p = np.array([rng.uniform(0.3, 2.0), rng.uniform(0.0, 0.5), rng.uniform(0.0, 0.5)])
    chosen = CHOICES[rng.integers(len(CHOICES))]
    kept = tuple(
        Invariant(fun, grad, name=name, args=(p,), in_place=True, uses_f=by_f)
        for name, (fun, grad, by_f) in ((name, KEPT[name]) for name in chosen)
    )

    def fun(t, y):
        out = np.empty_like(y)
        motion(t, y, out, p)
        return out

    def acc(t, q):
        out = np.empty_like(q)
        acceleration(t, q, out, p)
        return out

    start = 0.7 * rng.standard_normal(4 * n)
    return System(NAME, fun, start, (), acc=acc, t0=float(rng.choice([0.0, 3.0]))), kept, p
