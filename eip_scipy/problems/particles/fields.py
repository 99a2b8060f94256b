"""Fields for charged particles: those of Experiment III of Cai, Gong & Wang, and the class for user-defined fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import isfinite, log, log2, sqrt
from typing import Any

import numpy as np

from ...core.functions import compilable, jitted, own_values
from ._equations import (
    FieldFunctions,
    at_any_time,
    curl,
    difference_force,
    difference_jacobian,
    jit_like,
    no_force,
    no_potential,
)

__all__ = ["TOKAMAK", "UNIFORM", "ParticleField"]

DIFFERENCE_STEP = 2.0**-7  # step of differences, in units of `length`
AGREEMENT = 1e-6  # largest relative difference of functions that must agree
ROUND_OFF = 1e-10  # bound for the rounding of a difference whose true value is 0


@dataclass(frozen=True, eq=False)
class ParticleField:
    """An electromagnetic field, defined by functions of ``(x, y, z)``, or of ``(t, x, y, z)`` if it varies in time.

    Give A, with its derivatives if they are known, or B, or both; and phi or E, or both, if there is an electric field.
    With Numba functions, which return a float or a tuple of floats, the equations of a particle are compiled.

    Attributes
    ----------
    vector_potential : callable, optional
        ``A(x, y, z) -> (A_x, A_y, A_z)``. Needed for the canonical form, and for L in the form (x, v).
    jacobian : callable, optional
        ``(x, y, z) -> 3 rows``, whose row i is (dA_i/dx, dA_i/dy, dA_i/dz). Default: differences of A.
    potential : callable, optional
        ``phi(x, y, z) -> float``. Default: 0 if `electric` is not given either; otherwise phi is not known, and the
        energy is not an invariant.
    electric : callable, optional
        ``E(x, y, z) -> (E_x, E_y, E_z)``, which is -grad phi. Default: differences of phi.
    magnetic : callable, optional
        ``B(x, y, z) -> (B_x, B_y, B_z)``, which is curl A. Default: computed from the jacobian.
    axisymmetric : bool
        Whether A and phi do not change under rotations about the z axis; then L = x p_y - y p_x is an invariant.
    varies : bool
        Whether the first argument of all functions is the time, ``A(t, x, y, z)`` and so on. `electric`, the whole
        field ``-grad phi - dA/dt``, is then needed.
    length : float
        A length over which the field changes by some tens of per cent, in the unit of the positions. It determines the
        step of the differences. The default does not fit positions in metres in the field of a planet or a star, or
        in a trap of micrometres.
    name : str

    Notes
    -----
    Differences are central and of order 6, with step length / 128: relative errors of about 1e-12, and 18 evaluations
    of A in each evaluation of the equations. If you give `jacobian` and `electric`, no differences are needed.
    """

    vector_potential: Callable[..., Any] | None = None
    jacobian: Callable[..., Any] | None = None
    potential: Callable[..., Any] | None = None
    electric: Callable[..., Any] | None = None
    magnetic: Callable[..., Any] | None = None
    axisymmetric: bool = False
    varies: bool = False
    length: float = 1.0
    name: str = "field"

    def __post_init__(self) -> None:
        for key in ("vector_potential", "jacobian", "potential", "electric", "magnetic"):
            given = getattr(self, key)
            if not (given is None or callable(given)):
                raise TypeError(f"ParticleField: {key} must be a function of (x, y, z) or None, got {given!r}.")
        if self.vector_potential is None and self.magnetic is None:
            raise ValueError("ParticleField: give vector_potential, or magnetic, or both; got neither.")
        if self.vector_potential is None and self.jacobian is not None:
            raise ValueError("ParticleField: jacobian is given without vector_potential; give both, or omit jacobian.")
        if self.varies and self.electric is None:
            raise ValueError("ParticleField: a field that varies needs electric, -grad phi - dA/dt; give it.")
        if not (self.length > 0 and isfinite(self.length)):
            raise ValueError(f"ParticleField: length must be positive and finite, got {self.length!r}.")

    @property
    def _step(self) -> float:
        # A power of two, so that adding it to a position causes almost no rounding.
        return float(2.0 ** round(log2(DIFFERENCE_STEP * self.length)))

    @cached_property
    def functions(self) -> FieldFunctions:
        """Return all functions of the field; those that were not given are computed from the others if possible."""
        step = self._step
        given = self.vector_potential, self.jacobian, self.potential, self.electric, self.magnetic
        own = (None if fun is None else own_values(jitted(fun)) for fun in given)
        A, jacobian, phi, E, B = (fun if fun is None or self.varies else at_any_time(fun) for fun in own)
        if A is not None and jacobian is None:
            jacobian = difference_jacobian(A, step)
        if E is None and phi is None:
            E, phi = jit_like(no_force, A, B), jit_like(no_potential, A, B)
        if E is None:
            assert phi is not None
            E = difference_force(phi, step)
        if B is None:
            assert jacobian is not None
            B = curl(jacobian)
        return FieldFunctions(A, jacobian, phi, E, B)

    @cached_property
    def fill(self) -> Callable[..., None]:
        """Return ``fill(t, x, out)``, which writes E to out[:3] and B to out[3:], for the Boris pusher."""
        E, B = self.functions.E, self.functions.B

        def fields(t: float, x: np.ndarray, out: np.ndarray) -> None:
            e = E(t, x[0], x[1], x[2])
            b = B(t, x[0], x[1], x[2])
            out[0] = e[0]
            out[1] = e[1]
            out[2] = e[2]
            out[3] = b[0]
            out[4] = b[1]
            out[5] = b[2]

        return jit_like(fields, E, B)

    def _plain(self, key: str) -> Callable[..., Any]:
        """Return the given function in the attribute `key` as an interpreted function of (t, x, y, z)."""
        fun = getattr(self, key)
        return own_values((lambda *where: fun(*where)) if self.varies else (lambda t, *where: fun(*where)))

    def check(self, position: np.ndarray, t: float = 0.0) -> None:
        """Raise ValueError if functions return wrong numbers of values, or contradict each other, at a point (3,)."""
        step, where = self._step, (t, *position)
        found = {key: self._value(key, shape, where) for key, shape in SHAPES.items() if getattr(self, key)}
        if self.vector_potential is not None:
            truth = np.array(difference_jacobian(self._plain("vector_potential"), step)(*where))
            slack = AGREEMENT * np.abs(truth).max() + ROUND_OFF * np.abs(found["vector_potential"]).max() / self.length
            _compare("jacobian", found.get("jacobian"), truth, slack, "the derivatives of vector_potential")
            expected = np.array([truth[2, 1] - truth[1, 2], truth[0, 2] - truth[2, 0], truth[1, 0] - truth[0, 1]])
            _compare("magnetic", found.get("magnetic"), expected, slack, "the curl of vector_potential")
        if self.potential is not None and not self.varies:
            truth = np.array(difference_force(self._plain("potential"), step)(*where))
            slack = AGREEMENT * np.abs(truth).max() + ROUND_OFF * abs(found["potential"]) / self.length
            _compare("electric", found.get("electric"), truth, slack, "minus the gradient of potential")

    def _value(self, key: str, shape: tuple[int, ...], where: tuple[float, ...]) -> np.ndarray:
        value = np.asarray(self._plain(key)(*where))
        if value.shape != shape or value.dtype.kind not in "fiu" or not np.isfinite(value).all():
            raise ValueError(
                f"ParticleField: {key} returned {value!r} at {np.array(where[1:])}; expected "
                f"{'a finite number' if shape == () else f'finite numbers of shape {shape}'}."
            )
        return value

    def along(self, key: str, position: Any, t: Any = 0.0) -> np.ndarray:
        """Return "A", "E", "B" (3, m) or "phi" (m,) at points (3, m), and times (m,) for a field that varies."""
        fun, points = getattr(self.functions, key), np.ascontiguousarray(np.transpose(position), dtype=float)
        size = 1 if key == "phi" else 3
        out = np.empty((len(points), size))
        for row, time, point in zip(out, np.broadcast_to(t, len(points)), points, strict=True):
            row[:] = fun(time, *point)
        return out[:, 0] if size == 1 else out.T


SHAPES = {"vector_potential": (3,), "jacobian": (3, 3), "potential": (), "electric": (3,), "magnetic": (3,)}


def _compare(key: str, given: np.ndarray | None, expected: np.ndarray, slack: float, what: str) -> None:
    if given is not None and np.abs(given - expected).max() > slack:
        raise ValueError(
            f"ParticleField: {key} returned {given.tolist()}, but {what} there is {expected.tolist()}; correct one of "
            "them (or `length`, if the field changes over shorter distances)."
        )


# Uniform B = e_z with the potential 1e-2 / R.

POTENTIAL = 1e-2


@compilable
def _uniform_vector_potential(x, y, z):
    return -0.5 * y, 0.5 * x, 0.0


@compilable
def _uniform_jacobian(x, y, z):
    return (0.0, -0.5, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, 0.0)


@compilable
def _uniform_potential(x, y, z):
    return POTENTIAL / sqrt(x * x + y * y)


@compilable
def _uniform_electric(x, y, z):
    r2 = x * x + y * y
    w = POTENTIAL / (r2 * sqrt(r2))
    return w * x, w * y, 0.0


@compilable
def _uniform_magnetic(x, y, z):
    return 0.0, 0.0, 1.0


# Tokamak: A = (a x - b y, a y + b x, -log(R) / 2) with a = z / (2 R^2), b = ((1 - R)^2 + z^2) / (4 R^2).


@compilable
def _tokamak_vector_potential(x, y, z):
    r2 = x * x + y * y
    u = 1.0 / r2
    s = 1.0 - sqrt(r2)
    a = 0.5 * z * u
    b = 0.25 * (s * s + z * z) * u
    return a * x - b * y, a * y + b * x, -0.25 * log(r2)


@compilable
def _tokamak_jacobian(x, y, z):
    r2 = x * x + y * y
    u = 1.0 / r2
    r = sqrt(r2)
    s = 1.0 - r
    a = 0.5 * z * u
    b = 0.25 * (s * s + z * z) * u
    # With da/dx = da x and so on: a and b depend on x and y through R alone.
    da = -2.0 * a * u
    db = -u * (0.5 * s * r * u + 2.0 * b)
    radial = da * x - db * y
    across = da * y + db * x
    c = 0.5 * u
    d = c * z
    return (
        (a + x * radial, y * radial - b, c * x - d * y),
        (b + x * across, a + y * across, c * y + d * x),
        (-c * x, -c * y, 0.0),
    )


@compilable
def _tokamak_magnetic(x, y, z):
    r2 = x * x + y * y
    c = 0.5 / r2
    r = sqrt(r2)
    return -c * (2.0 * y + x * z), c * (2.0 * x - y * z), c * (r2 - r)


UNIFORM = ParticleField(
    vector_potential=_uniform_vector_potential,
    jacobian=_uniform_jacobian,
    potential=_uniform_potential,
    electric=_uniform_electric,
    magnetic=_uniform_magnetic,
    axisymmetric=True,
    name="uniform",
)
"""Uniform magnetic field e_z and potential 1e-2 / R (Cai, Gong & Wang, section 3.3); axisymmetric about z."""

TOKAMAK = ParticleField(
    vector_potential=_tokamak_vector_potential,
    jacobian=_tokamak_jacobian,
    magnetic=_tokamak_magnetic,
    axisymmetric=True,
    name="tokamak",
)
"""Axisymmetric tokamak of major radius 1 without inductive electric field (Cai, Gong & Wang, section 3.3)."""
