"""gala: orbits in gala's potentials, with the energy (or Jacobi's integral) and L_z kept.

gala (A. M. Price-Whelan, Journal of Open Source Software 2 (2017) 388) is free software under the MIT licence and not
distributed with this package; version 1.11 is tested.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, Invariant, integrate

try:
    from gala.dynamics import Orbit, PhaseSpacePosition
    from gala.integrate import parse_time_specification
    from gala.potential import Hamiltonian
except ModuleNotFoundError as error:
    raise ImportError('eip_scipy.integrations.gala needs gala: pip install "eip_scipy[gala]"', name="gala") from error

__all__ = ["integrate_orbit"]


def integrate_orbit(hamiltonian: Any, w0: Any, *, options: dict[str, Any] | None = None, **time_spec: Any) -> Orbit:
    """Integrate orbits as ``integrate_orbit`` of gala's potentials does, with the invariants kept.

    The energy (Jacobi's integral in a rotating frame) and L_z are kept if their rates of change are 0 at random states.

    Parameters
    ----------
    hamiltonian : gala.potential.PotentialBase or gala.potential.Hamiltonian
    w0 : gala.dynamics.PhaseSpacePosition or array_like, shape (2 n,) or (2 n, orbits)
        One initial state or several. An array has the units of the potential.
    options : dict, optional
        Options of `eip_scipy.integrate`. Default: `EIPDOP853`, ``rtol = atol = 1e-10``, and the invariants above.
    **time_spec
        Times as gala takes them: ``dt, n_steps``; ``dt, t1, t2``; ``t``.

    Raises
    ------
    RuntimeError
        If a run does not reach its end.
    """
    system = _System(Hamiltonian(hamiltonian))
    units = system.hamiltonian.units
    start = w0 if isinstance(w0, PhaseSpacePosition) else PhaseSpacePosition.from_w(np.asarray(w0, dtype=float), units)
    starts, times = np.ascontiguousarray(start.w(units).T), parse_time_specification(units, **time_spec)
    given = {"method": EIPDOP853} | ({} if "h" in (options or {}) else {"rtol": 1e-10, "atol": 1e-10}) | (options or {})
    given.setdefault("invariants", _conserved(system, starts[0], times))
    runs = [integrate(system, (times[0], times[-1]), w, t_eval=times, **given) for w in starts]
    for k, run in enumerate(runs):
        if not run.success:
            raise RuntimeError(f"orbit {k}: {run.message}")
    w = np.stack([run.y for run in runs], axis=-1) if start.shape else runs[0].y
    return Orbit.from_w(w, units=units, t=times * units["time"], hamiltonian=system.hamiltonian)


def _conserved(system: _System, w: np.ndarray, times: np.ndarray) -> list[Invariant]:
    """Return those of the energy and L_z whose rates of change are 0 at random states of the size of w = (q, p)."""
    n, rng = system.n, np.random.default_rng(1)
    J = np.zeros((2 * n, 2 * n))
    found: list[Any] = [("energy", system.energy, lambda t, y, f: np.append(-f[n:], f[:n]))]
    if n > 1:
        J[[0, n + 1], [n + 1, 0]], J[[1, n], [n, 1]] = 1.0, -1.0
        found.append(("L_z", lambda t, y: float(y @ J @ y / 2), lambda t, y, f: J @ y))
    distance = np.linalg.norm(w[:n]) or 1.0
    speed = np.linalg.norm(w[n:]) + (distance * np.linalg.norm(system(times[0], w)[n:])) ** 0.5
    for _ in range(6):
        t, apart = times[0] + rng.random() * (times[-1] - times[0]), 1e-5 * distance / speed
        y = np.append(distance * rng.normal(size=n), speed * rng.normal(size=n)) / n**0.5
        f = system(t, y)
        sizes = [2 * apart * np.abs(grad(t, y, f) * f).sum() for _, _, grad in found]
        changes = [fun(t + apart, y + apart * f) - fun(t - apart, y - apart * f) for _, fun, _ in found]
        found = [item for item, change, size in zip(found, changes, sizes, strict=True) if abs(change) <= 1e-6 * size]
    return [Invariant(fun, grad, uses_f=True, name=name) for name, fun, grad in found]


class _System:
    """Derivative and energy of a state (q, p), by the C functions of gala if the potential has them."""

    def __init__(self, hamiltonian: Any) -> None:
        self.hamiltonian, potential = hamiltonian, hamiltonian.potential
        c = potential.c_instance if hamiltonian.c_enabled else None
        self._gradient, self._energy = (potential._gradient, potential._energy) if c is None else (c.gradient, c.energy)
        self.n = n = potential.ndim
        omega = np.ravel(hamiltonian.frame.parameters["Omega"].value) if hamiltonian.frame.parameters else np.zeros(3)
        x, y, z = omega if omega.size == 3 else (0, 0, omega[0])
        self._turn = np.array([[0.0, -z, y], [z, 0, -x], [-y, x, 0]])[:n, :n]  # Omega x q in matrix form

    def __call__(self, t: float, w: np.ndarray) -> np.ndarray:
        q, p = w[: self.n], w[self.n :]
        force = self._gradient(q.reshape(self.n, 1), np.array([t]))[:, 0]
        return np.append(p - self._turn @ q, -force - self._turn @ p)

    def energy(self, t: float, w: np.ndarray) -> float:
        q, p = w[: self.n], w[self.n :]
        return float(p @ p / 2 + self._energy(q.reshape(1, self.n), np.array([t]))[0] - p @ self._turn @ q)
