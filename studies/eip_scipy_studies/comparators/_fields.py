"""Common part of the implicit schemes for the Gross-Pitaevskii equation: their loop, result and iterative solver.

With the linear part ``K = -Laplace / 2`` diagonal in the modes, ``1 + i c K`` is inverted by one pair of transforms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from eip_scipy.problems import GrossPitaevskii

from . import _kernels
from ._steps import FixedSteps

__all__ = ["FieldResult", "FieldScheme", "FixedPoint", "Implicit", "march"]

MOST_ITERATIONS = 100
WARM_STEPS = 3  # after which each branch of a scheme has been taken


@dataclass(frozen=True)
class FieldResult:
    """Result of `crank_nicolson` and `linearly_implicit`.

    Attributes
    ----------
    t : ndarray, shape (m,)
        Saved times, including the first and the last of the interval.
    y : ndarray, shape (n, m)
        States at `t`, flat and complex; ``gpe.grid.field(y)`` has the shape of the grid. After a failure they are nan.
    nfev : int
        Number of evaluations of the nonlinear term, each with one linear solve, which is a pair of transforms.
    wall_time : float
        Seconds spent in the integration, without planning the transforms.
    message : str
        "completed", or why and where the scheme failed.
    """

    t: np.ndarray
    y: np.ndarray
    nfev: int
    wall_time: float
    message: str


class FieldScheme:
    """Base class of a scheme and its state during a run; subclasses implement `restart` and `step`.

    `psi` (n,) is the state, flat, and `nfev` the number of pairs of transforms since `start`.
    """

    def __init__(self, gpe: GrossPitaevskii) -> None:
        self.gpe = gpe
        self.V = gpe.V.reshape(-1)
        self.kinetic = np.broadcast_to(sum(gpe.kinetic_factor(axis) for axis in range(gpe.grid.dim)), gpe.grid.shape)
        self.axes = tuple(range(gpe.grid.dim))
        self.psi = np.empty(gpe.grid.size, complex)
        self.nfev = 0
        self._rotation = np.empty(gpe.grid.size if gpe.Omega else 0, complex)

    def start(self, psi: np.ndarray) -> None:
        """Set the state to a copy of `psi`, the number of transforms to 0, and discard earlier states."""
        self.psi = psi.copy()
        self.nfev = 0
        self.restart()

    def restart(self) -> None:
        """Discard everything that was computed from earlier states."""
        raise NotImplementedError

    def step(self, h: float) -> str:
        """Advance `psi` by the signed step `h`; return the reason for a failure, or ""."""
        raise NotImplementedError

    def rotation(self, field: np.ndarray) -> np.ndarray:
        """Return -Omega Lz `field`, flat and in a buffer that is used again; an empty array if Omega is 0."""
        if self.gpe.Omega:
            shape = self.gpe.grid.shape
            self.gpe.angular(field.reshape(shape), self._rotation.reshape(shape))
            self._rotation *= -self.gpe.Omega
        return self._rotation

    def forward(self, field: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the Fourier modes of `field`; both are flat."""
        shape = self.gpe.grid.shape
        self.gpe.transforms.forward(field.reshape(shape), self.axes, out.reshape(shape))

    def backward(self, field: np.ndarray) -> None:
        """Replace the modes in `field` by the field that they describe, times the number of points."""
        self.gpe.transforms.backward(field.reshape(self.gpe.grid.shape), self.axes)


class FixedPoint:
    """Solver of ``m = psi - i c (K + W(m)) m``: K and a constant w are implicit, W - w comes from the previous iterate.

    The iteration ``m <- (1 + i c (K + w))^-1 rhs(m)``, ``rhs(m) = psi - i c (W(m) - w) m``, contracts by about ``c
    max|W - w|`` if W is pointwise; it converges fastest if w is the middle of the range of W. The change of `rhs` from
    one iterate to the next is the residual of the equation itself, not of the preconditioned one, and costs no
    transform.

    The transforms and K are those of `scheme`, whose ``nfev`` counts the iterations. `tol` is the bound on the norm of
    the residual relative to that of the state.
    """

    def __init__(self, scheme: FieldScheme, tol: float, c: float, w: float) -> None:
        self.scheme, self.tol, self.c, self.w = scheme, tol, c, w
        self._inverse = (1 / (1 + 1j * c * (scheme.kinetic + w)) / scheme.psi.size).reshape(-1)
        self._rhs = np.empty_like(scheme.psi)
        self._means: list[np.ndarray] = []

    def solve(self, rhs: Callable[[np.ndarray, np.ndarray], float], guess: np.ndarray) -> tuple[np.ndarray, str]:
        """Find m (n,), and return it with the reason why the iteration failed, or "".

        The array that is returned is overwritten in the third call after this one. ``rhs(m, values)`` replaces `values`
        (n,) by the right-hand side at m, and returns the norm of their change. The first iterate is `guess` (n,) until
        three solutions are known; then a parabola through these is extrapolated.
        """
        scheme, values = self.scheme, self._rhs
        if len(self._means) < 3:
            mean = guess.copy()
        else:
            mean = self._means.pop(0)
            _kernels.extrapolate(self._means[1], self._means[0], mean)
        bound = self.tol * float(np.linalg.norm(scheme.psi))
        rhs(mean, values)
        residual = math.inf
        for _ in range(MOST_ITERATIONS):
            scheme.forward(values, mean)
            _kernels.multiply_modes(mean, self._inverse)
            scheme.backward(mean)
            scheme.nfev += 1
            residual = rhs(mean, values)
            if not residual > bound:
                break
        self._means.append(mean)
        if residual <= bound:
            return mean, ""
        return mean, (
            f"the iteration left a residual of {residual:.1e}, expected {bound:.1e}; take a smaller h or a larger tol"
        )


class Implicit(FieldScheme):
    """Base class of schemes whose step solves, by `FixedPoint`, for the mean of two states that are 2 c apart in time.

    The mean fulfils ``mean = start - i c (K + W - Omega Lz) mean`` with a pointwise potential W, which subclasses
    compute. `psi` (n,) is a typical state, from which the constant w of `FixedPoint` is computed; `tol` is that of
    `FixedPoint`.
    """

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray, tol: float) -> None:
        super().__init__(gpe)
        W = self.V + gpe.beta * (psi.real**2 + psi.imag**2)
        self._w, self._tol = 0.5 * float(W.min() + W.max()), tol
        self._W = np.empty_like(self.V)
        self._solver: FixedPoint | None = None

    def restart(self) -> None:
        """See `FieldScheme`."""
        self._solver = None

    def solver(self, c: float) -> tuple[FixedPoint, bool]:
        """Return the solver for `c`, and True if it has just been made and therefore has no earlier solutions."""
        new = self._solver is None or self._solver.c != c
        if self._solver is None or new:
            self._solver = FixedPoint(self, self._tol, c, self._w)
        return self._solver, new

    def potential(self, start: np.ndarray, mean: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` (n,) with the potential W for a step from `start` whose two states have the mean `mean`."""
        raise NotImplementedError

    def cross(self, solver: FixedPoint, start: np.ndarray) -> str:
        """Replace `start` by the state at the other end of the step; return the reason for a failure, or ""."""

        def rhs(mean: np.ndarray, values: np.ndarray) -> float:
            self.potential(start, mean, self._W)
            return float(_kernels.right_side(start, mean, self.rotation(mean), self._W, solver.w, solver.c, values))

        mean, failure = solver.solve(rhs, self.psi)
        _kernels.other_end(mean, start)
        return failure


def check_tol(tol: Any) -> float:
    """Return `tol` as a float, or raise a ValueError if it is not a number from 1e-15 to 1, exclusive of 1."""
    if isinstance(tol, bool) or not isinstance(tol, (int, float, np.integer, np.floating)) or not 1e-15 <= tol < 1:
        raise ValueError(f"tol must be a number from 1e-15 to 1, exclusive of 1, got {tol!r}")
    return float(tol)


def check_equation(gpe: Any) -> GrossPitaevskii:
    """Return `gpe` if it is a `GrossPitaevskii`, or raise a TypeError."""
    if not isinstance(gpe, GrossPitaevskii):
        raise TypeError(
            f"gpe must be a GrossPitaevskii, got {type(gpe).__name__}; for a problem, pass problem.equation"
        )
    return gpe


def march(
    make: Callable[[GrossPitaevskii, np.ndarray], FieldScheme],
    gpe: GrossPitaevskii,
    t_span: Any,
    y0: Any,
    h: Any,
    save_every: int | None,
    observe: Callable[[Any], float] = lambda scheme: math.nan,
) -> tuple[FieldResult, np.ndarray]:
    """Run the scheme ``make(gpe, psi)`` from ``psi = y0`` over `t_span`.

    Return its result, and the values (m,) of ``observe(scheme)`` at the saved states; they are nan after a failure.
    """
    steps = FixedSteps.of(t_span, h, save_every)
    psi = check_equation(gpe).as_field(y0).reshape(-1)
    if not np.isfinite(psi).all():
        raise ValueError("All components of the initial state `y0` must be finite.")
    if math.isclose(steps.h, steps.last, rel_tol=1e-9):
        steps = steps._replace(last=steps.h)  # a difference in round-off only does not make a step of another length
    ys = np.full((steps.saved.size, psi.size), np.nan, complex)
    observed = np.full(steps.saved.size, np.nan)

    scheme = make(gpe, psi)
    scheme.start(psi)
    for _ in range(WARM_STEPS):  # measures plans of transforms
        scheme.step(steps.h)
    scheme.start(psi)
    ys[0], observed[0] = scheme.psi, observe(scheme)
    message, row = "completed", 1
    begin = perf_counter()
    n_steps = int(steps.saved[-1])
    for k in range(n_steps):
        failure = scheme.step(steps.last if k == n_steps - 1 else steps.h)
        if failure:
            message = f"failed in the step from t={steps.t0 + k * steps.h!r}: {failure}"
            break
        if k + 1 == steps.saved[row]:
            ys[row], observed[row] = scheme.psi, observe(scheme)
            row += 1
    wall_time = perf_counter() - begin
    return FieldResult(steps.t, ys.T, scheme.nfev, wall_time, message), observed
