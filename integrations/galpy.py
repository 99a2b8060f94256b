"""galpy: orbits in galpy's potentials, with the energy (or Jacobi's integral) and L_z kept.

galpy (J. Bovy, Astrophysical Journal Supplement 216 (2015) 29) is free software under the BSD licence and not
distributed with this package; version 1.12 is tested.
"""

from __future__ import annotations

import ctypes
import weakref
from typing import Any

import numpy as np

from ._orbits import run_orbits

try:
    import galpy
    from galpy.orbit import integrateFullOrbit
    from galpy.potential import evaluatephitorques, evaluatePotentials, evaluateRforces, evaluatezforces
    from galpy.util import conversion
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.galpy needs galpy: pip install "eip_scipy[galpy]"', name="galpy"
    ) from error

__all__ = ["integrate"]

# Versions whose C functions are called; they are not documented, and others may have other arguments.
KNOWN_IN_C = "1.12."
ROOM = 8192  # bytes for galpy's description of one potential in C, which are more than it needs


def integrate(orbit: Any, t: Any, pot: Any, *, pattern_speed: float = 0.0, **options: Any) -> None:
    """Integrate orbits as ``orbit.integrate(t, pot)`` does, with the invariants kept.

    The energy (or Jacobi's integral, see `pattern_speed`) is kept unless the potential makes it change in time, and L_z
    if the potential is symmetric about the z axis. To find out, the rates of change of both are computed at random
    states. Forces come from galpy's C functions, called from Python, if galpy's version is 1.12, its C library is
    loaded, and all potentials have C functions that need no Python function of time; otherwise from its Python
    functions.

    Parameters
    ----------
    orbit : galpy.orbit.Orbit
        One orbit in three dimensions or several, each of which is integrated by itself. The orbit holds the result as
        after ``orbit.integrate``, so that all its other methods work; an earlier integration is replaced.
    t : array_like or Quantity, shape (m,)
        Times, of which the first is that of the initial conditions.
    pot : galpy.potential.Potential or sum of potentials
    pattern_speed : float, optional
        Angular velocity, in galpy's units, of a potential that rotates about the z axis. If it is not 0, Jacobi's
        integral is kept in place of the energy.
    **options
        Options of `eip_scipy.integrate`. Defaults: ``method`` `EIPDOP853`, ``rtol`` and ``atol`` 1e-10 unless ``h`` is
        given, and the invariants above.

    Raises
    ------
    ValueError
        If the orbit is not one in three dimensions.
    RuntimeError
        If a run does not reach its end.
    """
    if orbit.dim() != 3:
        raise ValueError(f"orbit has {orbit.dim()} dimensions; expected 3. Give an Orbit of [R, vR, vT, z, vz, phi].")
    times = np.asarray(conversion.parse_time(t, ro=orbit._ro, vo=orbit._vo), dtype=float)
    starts = orbit.vxvv if orbit.phasedim() == 6 else np.pad(orbit.vxvv, ((0, 0), (0, 1)))
    rows = _cylindrical(run_orbits(_System(pot), _rectangular(starts), times, options, pattern_speed))
    vars(orbit).pop("_orbInterp", None)
    orbit.t, orbit._integrate_t_asQuantity = times, hasattr(t, "unit")
    orbit._pot = orbit._orig_pot = pot
    orbit.orbit = rows[..., : orbit.phasedim()]


class _System:
    """Motion in potentials of galpy: a call with a time and one state (q, v) returns its derivative, shape (6,).

    `energy` returns the energy per unit mass. All numbers are in galpy's internal units.
    """

    def __init__(self, pot: Any) -> None:
        self._pot = pot
        parts = list(pot) if hasattr(pot, "__iter__") else [pot]
        self._derivative: Any = None
        in_c = galpy.__version__.startswith(KNOWN_IN_C) and all(part.hasC for part in parts)
        if in_c and integrateFullOrbit._ext_loaded:
            count, kinds, numbers, functions = integrateFullOrbit._parse_pot(parts)
            if not functions:  # of time, in Python
                self._bind(integrateFullOrbit._lib, ctypes.c_int(count), kinds, numbers)

    def _bind(self, library: Any, count: Any, kinds: np.ndarray, numbers: np.ndarray) -> None:
        pointer, self._count, self._room = ctypes.c_void_p, count, ctypes.create_string_buffer(count.value * ROOM)
        library.init_potentialArgs(count, self._room)
        places = pointer(kinds.ctypes.data), pointer(numbers.ctypes.data), pointer()
        library.parse_leapFuncArgs_Full(count, self._room, *map(ctypes.byref, places))
        weakref.finalize(self, library.free_potentialArgs, count, self._room)
        derivative = ctypes.CFUNCTYPE(None, ctypes.c_double, pointer, pointer, ctypes.c_int, pointer)
        self._derivative = derivative(("evalRectDeriv", library))

    def __call__(self, t: float, w: np.ndarray) -> np.ndarray:
        out = np.empty(6)
        if self._derivative is not None:
            self._derivative(t, w.ctypes.data, out.ctypes.data, self._count, self._room)
            return out
        R, forces = np.hypot(w[0], w[1]), (evaluateRforces, evaluatephitorques, evaluatezforces)
        radial, torque, out[5] = (self._at(force, t, w) for force in forces)
        out[:3] = w[3:]
        out[3] = (w[0] * radial - w[1] * torque / R) / R
        out[4] = (w[1] * radial + w[0] * torque / R) / R
        return out

    def energy(self, t: float, w: np.ndarray) -> float:
        return float(w[3:] @ w[3:] / 2 + self._at(evaluatePotentials, t, w))

    def _at(self, function: Any, t: float, w: np.ndarray) -> Any:
        return function(self._pot, np.hypot(w[0], w[1]), w[2], phi=np.arctan2(w[1], w[0]), t=t, use_physical=False)


def _rectangular(rows: np.ndarray) -> np.ndarray:
    """Convert states (R, vR, vT, z, vz, phi) to Cartesian states (q, v); both have shape (..., 6)."""
    R, vR, vT, z, vz, phi = np.moveaxis(rows, -1, 0)
    c, s = np.cos(phi), np.sin(phi)
    return np.stack([R * c, R * s, z, vR * c - vT * s, vR * s + vT * c, vz], axis=-1)


def _cylindrical(rows: np.ndarray) -> np.ndarray:
    """Convert Cartesian states (q, v) to states (R, vR, vT, z, vz, phi); both have shape (..., 6)."""
    x, y, z, vx, vy, vz = np.moveaxis(rows, -1, 0)
    R = np.hypot(x, y)
    return np.stack([R, (x * vx + y * vy) / R, (x * vy - y * vx) / R, z, vz, np.arctan2(y, x)], axis=-1)
