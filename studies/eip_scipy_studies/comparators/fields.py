"""Implicit schemes of order 2 for the Gross-Pitaevskii equation, those of the paper's test of efficiency.

With the linear part ``K = -Laplace / 2`` diagonal in the modes, ``1 + i c K`` is inverted by one pair of transforms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from eip_scipy.problems import GrossPitaevskii

from . import _kernels
from ._steps import FixedSteps, Result

MOST_ITERATIONS = 100
WARM_STEPS = 3  # after which each branch of a scheme has been taken


def crank_nicolson(
    gpe: GrossPitaevskii, t_span: tuple[float, float], y0: Any, h: float, *, tol: float = 1e-12,
    save_every: int | None = None,
) -> Result:  # fmt: skip
    """Integrate the Gross-Pitaevskii equation by the energy-preserving Crank-Nicolson scheme, fully implicit.

    ``i (psi' - psi) / h = (K + V - Omega Lz + beta / 2 (|psi'|^2 + |psi|^2)) (psi' + psi) / 2``, K = -Laplace / 2.
    psi' is the state at the end of the step. The scheme keeps mass and energy up to the residual. See T. Wang, B. Guo,
    Q. Xu, J. Comput. Phys. 243 (2013) 382-399; Cai, Gong & Wang, section 3.4.1.

    Each step solves for the mean of its two states by a fixed-point iteration, which is preconditioned in Fourier space
    and starts from the parabola through the three previous means. An iteration takes a pair of transforms. It converges
    if h / 2 times half the range of ``V + beta |psi|^2`` is well below 1. A rotation takes two more pairs of transforms
    along one axis and needs h below about 2 / (Omega r)^2, where r is the largest distance from the axis.

    Parameters
    ----------
    gpe : GrossPitaevskii
    t_span, h, save_every
        As for `stormer_verlet`.
    y0 : array_like
        Initial field, of the grid's shape or flat; the states of the result are flat.
    tol : float, optional
        Bound on the norm of each step's residual, relative to the norm of the state.

    Examples
    --------
    >>> from eip_scipy_studies.comparators import crank_nicolson
    >>> from eip_scipy_studies.condensates.problems import soliton
    >>> problem = soliton(points=128)
    >>> run = crank_nicolson(problem.equation, (0.0, 1.0), problem.y0, 0.01)
    >>> bool(abs(run.y[:, -1] - problem.reference(1.0)).max() < 1e-3)
    True
    """
    return _march(lambda psi: CrankNicolson(gpe, psi, tol), gpe, t_span, y0, h, save_every)


def linearly_implicit(
    gpe: GrossPitaevskii, t_span: tuple[float, float], y0: Any, h: float, *, tol: float = 1e-12,
    save_every: int | None = None,
) -> Result:  # fmt: skip
    """Integrate the Gross-Pitaevskii equation by the linearly implicit central difference scheme, in two steps.

    ``i (psi'' - psi) / (2 h) = (K + V - Omega Lz + beta |psi'|^2) (psi'' + psi) / 2``, where psi, psi', psi'' are three
    successive states: one linear system per step, with coefficients that vary in space. See F. Zhang, V. M.
    Perez-Garcia, L. Vazquez, Appl. Math. Comput. 71 (1995) 165-177. Parameters are those of `crank_nicolson`.

    The first step, and a shorter last one, are steps of `crank_nicolson`. The systems are solved by the same iteration;
    the bounds on h for its convergence are half of those there. The scheme keeps the mass and, with L = K + V - Omega
    Lz, ``(<psi'', L psi''> + <psi', L psi'>) / 2 + beta / 2 <|psi'|^2, |psi''|^2>``.
    """
    return _march(lambda psi: LinearlyImplicit(gpe, psi, tol), gpe, t_span, y0, h, save_every)


def sav_crank_nicolson(
    gpe: GrossPitaevskii, t_span: tuple[float, float], y0: Any, h: float, *, shift: float | None = None,
    save_every: int | None = None,
) -> Result:  # fmt: skip
    """Integrate the equation without rotation by Crank-Nicolson with a scalar auxiliary variable (SAV).

    With ``E1 = <V, |psi|^2> + beta / 2 <|psi|^2, |psi|^2>``, ``r = sqrt(E1 + C)``, ``b = (V + beta |psi|^2) psi / r``:

    - ``i (psi' - psi) / h = K (psi' + psi) / 2 + (r' + r) / 2 b*``,
    - ``r' - r = Re <b*, psi' - psi>``,

    where primes denote the end of the step, and b* is b at the middle of the step, from an extrapolation of the last
    two states; the first step is taken twice. The scheme has constant coefficients, and so one pair of transforms per
    step. It keeps the modified energy ``<psi, K psi> + r^2 - C``, and mass and energy to order 2 only. See J. Shen, J.
    Xu, J. Yang, J. Comput. Phys. 353 (2018) 407-416. Parameters are those of `crank_nicolson`, and `shift`, the
    constant C, which must keep E1 + C positive (default: 1, plus ten times the magnitude of a negative E1 at the
    start).
    """
    run = _march(lambda psi: ScalarAuxiliary(gpe, psi, shift), gpe, t_span, y0, h, save_every)
    kinetic = [gpe.energy(psi) - _interaction(gpe, psi) for psi in run.y.T]
    return replace(run, modified_energy=np.add(kinetic, run.modified_energy))


class Scheme:
    """A scheme in a run: `psi` (n,) is the state, flat, and `nfev` the number of pairs of transforms so far."""

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray) -> None:
        self.gpe, self.nfev, self.V = gpe, 0, gpe.V.reshape(-1)
        self.axes, self.shape = tuple(range(gpe.grid.dim)), gpe.grid.shape
        self.kinetic = np.broadcast_to(sum(map(gpe.kinetic_factor, self.axes)), self.shape)
        self.psi = psi.copy()
        self.auxiliary = math.nan  # r^2 - C of SAV

    def step(self, h: float) -> str:
        """Advance `psi` by the signed step `h`; return the reason for a failure, or ""."""
        raise NotImplementedError

    def forward(self, field: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the Fourier modes of `field`; both are flat."""
        self.gpe.transforms.forward(field.reshape(self.shape), self.axes, out.reshape(self.shape))

    def backward(self, field: np.ndarray) -> None:
        """Replace the modes in `field` by the field that they describe, times the number of points."""
        self.gpe.transforms.backward(field.reshape(self.shape), self.axes)


class Implicit(Scheme):
    """Base class of schemes whose step solves for the mean of two states that are 2 c apart in time.

    The mean fulfils ``mean = start - i c (K + W - Omega Lz) mean`` with a pointwise potential W. K and a constant w are
    implicit, W - w comes from the previous iterate: ``mean <- (1 + i c (K + w))^-1 rhs(mean)``. This contracts by about
    ``c max|W - w|``, least if w is the middle of the range of W. The change of `rhs` from one iterate to the next is
    the residual of the equation itself, not of the preconditioned one, and costs no transform.
    """

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray, tol: float) -> None:
        if not 1e-15 <= tol < 1:
            raise ValueError(f"tol must be a number from 1e-15 to 1, exclusive of 1, got {tol!r}")
        super().__init__(gpe, psi)
        W = self.V + gpe.beta * (psi.real**2 + psi.imag**2)
        self.w, self.tol, self.c = 0.5 * float(W.min() + W.max()), tol, math.nan
        self.W, self.values = np.empty_like(self.V), np.empty_like(psi)
        self.rotation = np.empty(gpe.grid.size if gpe.Omega else 0, complex)
        self.means: list[np.ndarray] = []

    def potential(self, start: np.ndarray, mean: np.ndarray) -> None:
        """Fill `W` (n,) with the potential for a step from `start` whose two states have the mean `mean`."""
        raise NotImplementedError

    def begins(self, c: float) -> bool:
        """Prepare for steps with `c`; return whether it is new, so that there are no earlier means."""
        new = self.c != c
        if new:
            self.c, self.means = c, []
            self.inverse = (1 / (1 + 1j * c * (self.kinetic + self.w)) / self.psi.size).reshape(-1)
        return new

    def cross(self, start: np.ndarray) -> str:
        """Replace `start` by the state at the other end of the step; return the reason for a failure, or ""."""
        if len(self.means) < 3:
            mean = self.psi.copy()
        else:  # the parabola through the last three
            mean = self.means.pop(0)
            _kernels.extrapolate(self.means[1], self.means[0], mean)
        self.means.append(mean)
        bound = self.tol * float(np.linalg.norm(self.psi))
        self._residual(start, mean)
        for _ in range(MOST_ITERATIONS):
            self.forward(self.values, mean)
            _kernels.multiply_modes(mean, self.inverse)
            self.backward(mean)
            self.nfev += 1
            residual = self._residual(start, mean)
            if residual <= bound:
                _kernels.other_end(mean, start)
                return ""
        return (
            f"the iteration left a residual of {residual:.1e}, expected {bound:.1e}; take a smaller h or a larger tol"
        )

    def _residual(self, start: np.ndarray, mean: np.ndarray) -> float:
        """Fill `values` with the right-hand side, and return the norm of its change."""
        self.potential(start, mean)
        if self.gpe.Omega:
            self.gpe.angular(mean.reshape(self.shape), self.rotation.reshape(self.shape))
            self.rotation *= -self.gpe.Omega
        return float(_kernels.right_side(start, mean, self.rotation, self.W, self.w, self.c, self.values))


class CrankNicolson(Implicit):
    """The scheme of `crank_nicolson`."""

    def step(self, h: float) -> str:
        self.begins(0.5 * h)
        return self.cross(self.psi)

    def potential(self, start: np.ndarray, mean: np.ndarray) -> None:
        _kernels.mean_density(start, mean, self.V, self.gpe.beta, self.W)


class LinearlyImplicit(Implicit):
    """The scheme of `linearly_implicit`."""

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray, tol: float) -> None:
        super().__init__(gpe, psi, tol)
        self.single, self.before = CrankNicolson(gpe, psi, tol), psi.copy()

    def step(self, h: float) -> str:
        if not self.begins(h):
            failure = self.cross(self.before)
            self.psi, self.before = self.before, self.psi
            return failure
        self.before[:] = self.single.psi[:] = self.psi
        failure = self.single.step(h)
        self.nfev += self.single.nfev
        self.psi[:] = self.single.psi
        return failure

    def potential(self, start: np.ndarray, mean: np.ndarray) -> None:
        _kernels.density(self.psi, self.V, self.gpe.beta, self.W)


class ScalarAuxiliary(Scheme):
    """The scheme of `sav_crank_nicolson`."""

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray, shift: float | None) -> None:
        if gpe.Omega:
            raise ValueError(f"SAV/CN needs Omega = 0, got {gpe.Omega:g}. Use EIPRK4 or crank_nicolson.")
        super().__init__(gpe, psi)
        energy = _interaction(gpe, psi)
        self.shift = 1.0 + 10 * max(-energy, 0.0) if shift is None else shift
        if not 0 < energy + self.shift < math.inf:
            raise ValueError(f"shift must be finite and exceed {-energy:g} for this start, got {shift!r}")
        self.r, self.last_h, self.c = math.sqrt(energy + self.shift), math.nan, math.nan
        self.auxiliary = self.r**2 - self.shift
        self.modes, self.new_modes, self.force, self.new, self.before = (np.empty_like(psi) for _ in range(5))
        self.forward(self.psi, self.modes)

    def step(self, h: float) -> str:
        if self.c != 0.5 * h:
            self.c = 0.5 * h
            self.inverse = (1 / (1 + 1j * self.c * self.kinetic)).reshape(-1)
        if math.isnan(self.last_h):
            self._new_state(self.psi, 0.0)
            self.r, failure = self._new_state(self.new, -0.5)
        else:
            self.r, failure = self._new_state(self.before, 0.5 * h / self.last_h)
        self.last_h, self.auxiliary = h, self.r**2 - self.shift
        self.before, self.psi, self.new = self.psi, self.new, self.before
        self.modes, self.new_modes = self.new_modes, self.modes
        return failure

    def _new_state(self, other: np.ndarray, a: float) -> tuple[float, str]:
        """Take a step with b* at the state psi + a (psi - other), and write the result to `new` and `new_modes`.

        Return r at the end of the step, and the reason for a failure, or "".
        """
        gpe, force = self.gpe, self.force
        square = gpe.grid.cell * _kernels.nonlinear_force(self.psi, other, a, self.V, gpe.beta, force) + self.shift
        if not square > 0:
            return math.nan, f"E1 + C is {square:.2g}, which must be positive; take a larger shift"
        s = 1 / math.sqrt(square)
        self.forward(force, self.new)
        along, norm = _kernels.projections(self.new, self.modes, self.inverse, self.c)
        weight = gpe.grid.cell / self.psi.size  # Parseval
        r_mean = (self.r + s * weight * along) / (1 + s * s * weight * norm)
        _kernels.advance(self.modes, self.inverse, self.c * r_mean * s, self.new_modes, self.new)
        self.backward(self.new)
        self.nfev += 1
        return 2 * r_mean - self.r, ""


def _interaction(gpe: GrossPitaevskii, psi: np.ndarray) -> float:
    """Return E1, the sum of the potential energy and the interaction energy."""
    density = np.abs(gpe.as_field(psi)) ** 2
    return gpe.grid.cell * float(np.vdot(density, gpe.V + 0.5 * gpe.beta * density))


def _march(
    make: Callable[[np.ndarray], Scheme], gpe: Any, t_span: Any, y0: Any, h: Any, save_every: int | None
) -> Result:
    """Run the scheme ``make(psi)`` from ``psi = y0`` over `t_span`; `modified_energy` has its `auxiliary` numbers."""
    if not isinstance(gpe, GrossPitaevskii):
        raise TypeError(
            f"gpe must be a GrossPitaevskii, got {type(gpe).__name__}; for a problem, pass problem.equation"
        )
    steps = FixedSteps.of(t_span, h, save_every)
    psi = gpe.as_field(y0).reshape(-1)
    if not np.isfinite(psi).all():
        raise ValueError("All components of the initial state `y0` must be finite.")
    if math.isclose(steps.h, steps.last, rel_tol=1e-9):
        steps = steps._replace(last=steps.h)  # a difference in round-off only does not make a step of another length
    ys, kept = np.full((steps.saved.size, psi.size), np.nan, complex), np.full(steps.saved.size, np.nan)
    warm, scheme = make(psi), make(psi)
    for _ in range(WARM_STEPS):  # measures plans of transforms
        warm.step(steps.h)
    ys[0], kept[0], message, row, n_steps = psi, scheme.auxiliary, "completed", 1, int(steps.saved[-1])
    begin = perf_counter()
    for k in range(n_steps):
        failure = scheme.step(steps.last if k == n_steps - 1 else steps.h)
        if failure:
            message = f"failed in the step from t={steps.t0 + k * steps.h!r}: {failure}"
            break
        if k + 1 == steps.saved[row]:
            ys[row], kept[row] = scheme.psi, scheme.auxiliary
            row += 1
    return Result(steps.t, ys.T, scheme.nfev, perf_counter() - begin, message, kept)
