"""gala: orbits in gala's potentials, with the energy (or Jacobi's integral) and L_z kept.

gala (A. M. Price-Whelan, Journal of Open Source Software 2 (2017) 388) is free software under the MIT licence and not
distributed with this package; version 1.11 is tested.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ._orbits import run_orbits

try:
    from gala.dynamics import Orbit, PhaseSpacePosition
    from gala.integrate import parse_time_specification
    from gala.potential import Hamiltonian
except ModuleNotFoundError as error:
    raise ImportError('eip_scipy.integrations.gala needs gala: pip install "eip_scipy[gala]"', name="gala") from error

__all__ = ["integrate_orbit"]


def integrate_orbit(hamiltonian: Any, w0: Any, *, options: dict[str, Any] | None = None, **time_spec: Any) -> Orbit:
    """Integrate orbits as ``integrate_orbit`` of gala's potentials does, with the invariants kept.

    The energy (Jacobi's integral in a rotating frame) is kept unless the potential depends on time, and L_z if the
    potential is symmetric about the z axis and the frame does not rotate about another axis. To find out, the rates of
    change of both are computed at random states. Forces come from gala's C functions, called from Python, if the
    potential has them. gala's own ``integrate_orbit`` accepts only gala's integrators.

    Parameters
    ----------
    hamiltonian : gala.potential.PotentialBase or gala.potential.Hamiltonian
    w0 : gala.dynamics.PhaseSpacePosition or array_like
        One initial state (positions and velocities) or several, each of which is integrated by itself. An array, shape
        (2 n,) or (2 n, orbits) in n dimensions, has the units of the potential.
    options : dict, optional
        Options of `eip_scipy.integrate`. Defaults: ``method`` `EIPDOP853`, ``rtol`` and ``atol`` 1e-10 (as gala's
        integrator "dopri853" in C) unless ``h`` is given, and the invariants above.
    **time_spec
        Times as gala takes them: ``dt, n_steps``; ``dt, t1, t2``; ``t``.

    Returns
    -------
    gala.dynamics.Orbit

    Raises
    ------
    RuntimeError
        If a run does not reach its end.
    """
    system = _System(Hamiltonian(hamiltonian))
    units = system.hamiltonian.units
    start = w0 if isinstance(w0, PhaseSpacePosition) else PhaseSpacePosition.from_w(np.asarray(w0, dtype=float), units)
    times = parse_time_specification(units, **time_spec)
    rows = run_orbits(system, start.w(units).T, times, options or {})
    w = rows.T if start.shape else rows[0].T
    return Orbit.from_w(w, units=units, t=times * units["time"], hamiltonian=system.hamiltonian)


class _System:
    """Hamiltonian of gala: a call with a time and one state (q, p) returns its derivative, shape (2 n,).

    `energy` returns the value of the Hamiltonian, which in a rotating frame is Jacobi's integral.
    """

    def __init__(self, hamiltonian: Any) -> None:
        self.hamiltonian = hamiltonian
        self._potential = potential = hamiltonian.potential
        self._forces = potential.c_instance if hamiltonian.c_enabled else None
        self._n = n = potential.ndim
        omega = np.ravel(hamiltonian.frame.parameters["Omega"].value) if hamiltonian.frame.parameters else np.zeros(3)
        x, y, z = omega if omega.size == 3 else (0, 0, omega[0])
        # Omega x q in matrix form; 0 in a frame at rest.
        self._turn = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])[:n, :n] if omega.any() else None

    def __call__(self, t: float, w: np.ndarray) -> np.ndarray:
        n, at, out = self._n, np.array([t]), np.empty(w.size)
        q = w[:n].reshape(n, 1)
        gradient = self._potential._gradient(q, t=at) if self._forces is None else self._forces.gradient(q, at)
        out[:n] = w[n:]
        np.negative(gradient[:, 0], out=out[n:])
        if self._turn is not None:
            out[:n] -= self._turn @ w[:n]
            out[n:] -= self._turn @ w[n:]
        return out

    def energy(self, t: float, w: np.ndarray) -> float:
        n, at = self._n, np.array([t])
        q, p = w[:n].reshape(1, n), w[n:]
        value = self._potential._energy(q, t=at) if self._forces is None else self._forces.energy(q, at)
        return float(p @ p / 2 + value[0] - (0 if self._turn is None else p @ self._turn @ w[:n]))
