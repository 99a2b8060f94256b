"""Runs of orbits in galaxies with their invariants kept; `integrations.gala` and `integrations.galpy` use them."""

from __future__ import annotations

from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, Invariant, integrate

# A rate of change along the flow, which is computed by a difference, is zero up to this fraction of its terms.
RATE = 1e-6
STATES = 6  # at which rates are looked at


def run_orbits(
    system: Any, starts: np.ndarray, times: np.ndarray, options: dict[str, Any], pattern_speed: float = 0.0
) -> np.ndarray:
    """Integrate the states (q, p) of `starts` (orbits, 2 n); return the states (orbits, m, 2 n) at `times` (m,).

    ``system(t, w)`` is the derivative (dH/dp, -dH/dq), and ``system.energy(t, w)`` is H. `options` are those of
    `integrate`; by default the method is `EIPDOP853`, the tolerances (without `h`) are 1e-10, and the invariants are
    those that `kept_invariants` finds for the first orbit and `pattern_speed`. RuntimeError is raised if a run does not
    reach its end.
    """
    starts = np.ascontiguousarray(starts)
    options = {"method": EIPDOP853} | ({} if "h" in options else {"rtol": 1e-10, "atol": 1e-10}) | options
    if "invariants" not in options:
        options["invariants"] = kept_invariants(system, starts[0], times, pattern_speed)
    rows = np.empty((len(starts), times.size, starts.shape[1]))
    for k, start in enumerate(starts):
        run = integrate(system, (times[0], times[-1]), start, t_eval=times, **options)
        if not run.success:
            raise RuntimeError(f"orbit {k}: {run.message}")
        rows[k] = run.y.T
    return rows


def kept_invariants(system: Any, w: np.ndarray, times: np.ndarray, pattern_speed: float) -> list[Invariant]:
    """Return those of the energy and L_z whose rates of change are 0 at random states of the size of w = (q, p).

    The times of these states are random, between the first and the last of `times`. If `pattern_speed` is not 0,
    Jacobi's integral, the energy minus `pattern_speed` times L_z, replaces the energy.
    """
    n = w.size // 2

    def momentum(t: float, y: np.ndarray) -> float:
        return float(y[0] * y[n + 1] - y[1] * y[n])

    def momentum_gradient(t: float, y: np.ndarray, f: np.ndarray) -> np.ndarray:
        out = np.zeros(2 * n)
        out[[0, 1, n, n + 1]] = y[n + 1], -y[n], -y[1], y[0]
        return out

    def energy(t: float, y: np.ndarray) -> float:
        return system.energy(t, y) - (pattern_speed * momentum(t, y) if pattern_speed else 0.0)

    def energy_gradient(t: float, y: np.ndarray, f: np.ndarray) -> np.ndarray:
        out = np.concatenate([-f[n:], f[:n]])
        return out - pattern_speed * momentum_gradient(t, y, f) if pattern_speed else out

    found: list[tuple[str, Any, Any]] = [("Jacobi" if pattern_speed else "energy", energy, energy_gradient)]
    if n > 1:
        found.append(("L_z", momentum, momentum_gradient))
    rng, distance = np.random.default_rng(1), np.linalg.norm(w[:n]) or 1.0
    speed = np.linalg.norm(w[n:]) + (distance * np.linalg.norm(system(times[0], w)[n:])) ** 0.5
    apart = 1e-5 * distance / speed
    for _ in range(STATES):
        t = times[0] + rng.random() * (times[-1] - times[0])
        y = np.concatenate([size * rng.normal(size=n) / n**0.5 for size in (distance, speed)])
        f = system(t, y)
        changes = [fun(t + apart, y + apart * f) - fun(t - apart, y - apart * f) for _, fun, _ in found]
        sizes = [2 * apart * np.abs(grad(t, y, f) * f).sum() for _, _, grad in found]
        found = [x for x, change, size in zip(found, changes, sizes, strict=True) if abs(change) <= RATE * size]
    return [Invariant(fun, grad, uses_f=True, name=name) for name, fun, grad in found]
