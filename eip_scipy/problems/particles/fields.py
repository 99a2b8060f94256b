"""Fields for charged particles: those of Experiment III of Cai, Gong & Wang, and the class for user-defined fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from math import isfinite, log, log2, sqrt
from typing import Any

import numpy as np

from ...core.derivatives import DIFFERENCE_WEIGHTS
from ...core.functions import compilable, compiled_like, jitted, own_values
from .motion import FieldFunctions, Function, no_force, no_potential

__all__ = ["TOKAMAK", "UNIFORM", "ParticleField"]

DIFFERENCE_STEP = 2.0**-7  # step of differences, in units of `length`
AGREEMENT = 1e-6  # largest relative difference of functions that must agree
ROUND_OFF = 1e-10  # bound for the rounding of a difference whose true value is 0
SHAPES = {"vector_potential": (3,), "jacobian": (3, 3), "potential": (), "electric": (3,), "magnetic": (3,)}


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

    See Also
    --------
    charged_particle, tokamak, uniform_field

    Notes
    -----
    Differences are central and of order 6, with step length / 128: relative errors of about 1e-12, and 18 evaluations
    of A in each evaluation of the equations. If you give `jacobian` and `electric`, no differences are needed.

    Examples
    --------
    >>> from eip_scipy.problems import ParticleField, charged_particle
    >>> field = ParticleField(lambda x, y, z: (-y / 2, x / 2, 0.0), axisymmetric=True)
    >>> [item.name for item in charged_particle(field, [1, 0, 0], [0, 1, 0], t_span=(0, 9)).invariants]
    ['H', 'L']
    """

    vector_potential: Callable[..., Any] | None = None
    jacobian: Callable[..., Any] | None = None
    potential: Callable[..., Any] | None = None
    electric: Callable[..., Any] | None = None
    magnetic: Callable[..., Any] | None = None
    axisymmetric: bool = False
    varies: bool = False
    length: float = 1.0

    def __post_init__(self) -> None:
        for key in SHAPES:
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

    @cached_property
    def functions(self) -> FieldFunctions:
        """Return all functions of the field; those that were not given are computed from the others if possible."""
        A, jacobian, phi, E, B = (self._of_time(jitted(getattr(self, key))) for key in SHAPES)
        if A is not None and jacobian is None:
            jacobian = self._derivatives(A)
        if E is None and phi is None:
            E, phi = (compiled_like(fun, *filter(None, (A, B))) for fun in (no_force, no_potential))
        if E is None:
            E = _force(self._derivatives(_as_vector(phi)))
        return FieldFunctions(A, jacobian, phi, E, _curl(jacobian) if B is None else B)

    @cached_property
    def fill(self) -> Callable[..., None]:
        """Return ``fill(t, x, out)``, which writes E to out[:3] and B to out[3:], for methods such as Boris's."""
        E, B = self.functions.E, self.functions.B

        def fields(t, x, out):
            e, b = E(t, x[0], x[1], x[2]), B(t, x[0], x[1], x[2])
            out[0], out[1], out[2], out[3], out[4], out[5] = e[0], e[1], e[2], b[0], b[1], b[2]

        return compiled_like(fields, E, B)

    def _of_time(self, fun: Any) -> Any:
        """Return a given function, or None, as a function of (t, x, y, z)."""
        if fun is None:
            return None
        own = own_values(fun)
        return own if self.varies else compiled_like(lambda t, x, y, z: own(x, y, z), own)

    def _derivatives(self, A: Function) -> Function:
        """Return a function of the rows dA_i/dx_j, computed by central differences of order 6."""
        # A power of two, so that adding it to a position causes almost no rounding.
        step = float(2.0 ** round(log2(DIFFERENCE_STEP * self.length)))

        def along(t, x, y, z, dx, dy, dz):
            d0 = d1 = d2 = 0.0
            for k, weight in DIFFERENCE_WEIGHTS:
                right = A(t, x + k * dx, y + k * dy, z + k * dz)
                left = A(t, x - k * dx, y - k * dy, z - k * dz)
                d0 += weight * (right[0] - left[0])
                d1 += weight * (right[1] - left[1])
                d2 += weight * (right[2] - left[2])
            return d0 / step, d1 / step, d2 / step

        along = compiled_like(along, A)

        def rows(t, x, y, z):
            a = along(t, x, y, z, step, 0.0, 0.0)
            b = along(t, x, y, z, 0.0, step, 0.0)
            c = along(t, x, y, z, 0.0, 0.0, step)
            return (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])

        return compiled_like(rows, A)

    def check(self, position: np.ndarray, t: float = 0.0) -> None:
        """Raise ValueError if functions return wrong numbers of values, or contradict each other, at a point (3,)."""
        where = (t, *position)
        # As partial functions, which are not compiled: that takes longer than a few calls.
        plain = {key: self._of_time(partial(fun)) for key in SHAPES if (fun := getattr(self, key))}
        found = {key: _value(key, fun, where) for key, fun in plain.items()}
        for key, (source, derived, what) in CLAIMS.items():
            if not {key, source} <= found.keys() or (self.varies and key == "electric"):
                continue
            rows = self._derivatives(_as_vector(plain[source]) if source == "potential" else plain[source])
            slack = AGREEMENT * np.abs(rows(*where)).max() + ROUND_OFF * np.abs(found[source]).max() / self.length
            expected = np.array(derived(rows)(*where))
            if np.abs(found[key] - expected).max() > slack:
                raise ValueError(
                    f"ParticleField: {key} returned {found[key].tolist()}, but {what} there is {expected.tolist()}; "
                    "correct one of them (or `length`, if the field changes over shorter distances)."
                )

    def along(self, key: str, position: Any, t: Any = 0.0) -> np.ndarray:
        """Return "A", "E", "B" (3, m) or "phi" (m,) at points (3, m), and times (m,) for a field that varies."""
        fun, points = getattr(self.functions, key), np.transpose(position)
        times = np.broadcast_to(t, len(points))
        return np.array([fun(time, *point) for time, point in zip(times, points, strict=True)]).T


def _value(key: str, fun: Function, where: tuple[float, ...]) -> np.ndarray:
    value, shape = np.asarray(fun(*where)), SHAPES[key]
    if value.shape != shape or value.dtype.kind not in "fiu" or not np.isfinite(value).all():
        raise ValueError(
            f"ParticleField: {key} returned {value!r} at {np.array(where[1:])}; expected "
            f"{'a finite number' if shape == () else f'finite numbers of shape {shape}'}."
        )
    return value


# Functions of a field that follow from the rows dA_i/dx_j; a potential counts as the vector (phi, 0, 0).


def _as_vector(phi: Function) -> Function:
    return compiled_like(lambda t, x, y, z: (phi(t, x, y, z), 0.0, 0.0), phi)


def _curl(rows: Function) -> Function:
    def magnetic(t, x, y, z):
        d = rows(t, x, y, z)
        return d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]

    return compiled_like(magnetic, rows)


def _force(rows: Function) -> Function:
    def electric(t, x, y, z):
        slope = rows(t, x, y, z)[0]
        return -slope[0], -slope[1], -slope[2]

    return compiled_like(electric, rows)


CLAIMS: dict[str, tuple[str, Callable[[Function], Function], str]] = {
    "jacobian": ("vector_potential", lambda rows: rows, "the derivatives of vector_potential"),
    "magnetic": ("vector_potential", _curl, "the curl of vector_potential"),
    "electric": ("potential", _force, "minus the gradient of potential"),
}


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


UNIFORM = ParticleField(
    _uniform_vector_potential, _uniform_jacobian, _uniform_potential, _uniform_electric, axisymmetric=True
)
"""Uniform magnetic field e_z and potential 1e-2 / R (Cai, Gong & Wang, section 3.3); axisymmetric about z."""

TOKAMAK = ParticleField(_tokamak_vector_potential, _tokamak_jacobian, axisymmetric=True)
"""Axisymmetric tokamak of major radius 1 without inductive electric field (Cai, Gong & Wang, section 3.3)."""
