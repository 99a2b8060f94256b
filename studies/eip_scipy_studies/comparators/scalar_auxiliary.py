"""Crank-Nicolson with a scalar auxiliary variable (SAV) for the Gross-Pitaevskii equation: keeps a modified energy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy.problems import GrossPitaevskii

from . import _kernels
from ._fields import FieldResult, FieldScheme, march

__all__ = ["SAVResult", "sav_crank_nicolson"]


@dataclass(frozen=True)
class SAVResult(FieldResult):
    """Result of `sav_crank_nicolson`: a `FieldResult` with one more array.

    Attributes
    ----------
    modified_energy : ndarray, shape (m,)
        ``<psi, K psi> + r^2 - C`` at `t`, which the scheme keeps, with r and C as in `sav_crank_nicolson`. The true
        energy is ``gpe.energy``.
    """

    modified_energy: np.ndarray


def sav_crank_nicolson(
    gpe: GrossPitaevskii,
    t_span: tuple[float, float],
    y0: Any,
    h: float,
    *,
    shift: float | None = None,
    save_every: int | None = None,
) -> SAVResult:
    """Integrate the Gross-Pitaevskii equation without rotation by the SAV approach with Crank-Nicolson.

    With ``E1 = <V, |psi|^2> + beta / 2 <|psi|^2, |psi|^2>``, ``r = sqrt(E1 + C)``, ``b = (V + beta |psi|^2) psi / r``:

    - ``i (psi' - psi) / h = K (psi' + psi) / 2 + (r' + r) / 2 b*``,
    - ``r' - r = Re <b*, psi' - psi>``,

    where primes denote the end of the step, and b* is b at the middle of the step, from an extrapolation of the last
    two states. The scheme is linear with constant coefficients: one pair of transforms per step. It has order 2 and
    keeps a modified energy, but mass and energy to order 2 only.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation with Omega = 0.
    t_span, y0, h, save_every
        As for `crank_nicolson`.
    shift : float, optional
        The constant C, which must keep E1 + C positive. Default: 1, plus ten times the magnitude of a negative E1 at
        the start.

    Returns
    -------
    SAVResult
        A record with t (m,), y (n, m), nfev, wall_time [s], message and modified_energy (m,).

    Raises
    ------
    TypeError, ValueError
        As for `crank_nicolson`; if `gpe` rotates; if `shift` is not finite or does not make E1 + C positive.

    Notes
    -----
    The first step is taken twice: with b* of the start, then with b* of the mean of its ends.

    References
    ----------
    J. Shen, J. Xu, J. Yang, The scalar auxiliary variable (SAV) approach for gradient flows, J. Comput. Phys. 353
    (2018) 407-416; Cai, Gong & Wang, section 3.4.1.

    Examples
    --------
    >>> from eip_scipy_studies.comparators import sav_crank_nicolson
    >>> from eip_scipy_studies.condensates.problems import soliton
    >>> problem = soliton(points=128)
    >>> run = sav_crank_nicolson(problem.equation, (0.0, 1.0), problem.y0, 0.01, save_every=1)
    >>> bool(abs(run.modified_energy - run.modified_energy[0]).max() < 1e-12)
    True
    """

    def make(gpe: GrossPitaevskii, psi: np.ndarray) -> FieldScheme:
        if gpe.Omega:
            raise ValueError(
                f"SAV/CN needs Omega = 0, where the linear part is diagonal in the modes; got Omega = {gpe.Omega:g}. "
                "Use EIPRK4 or crank_nicolson, or, if the trap is round, the equation in the frame at rest (Omega = 0)"
            )
        return _SAV(gpe, _shift(gpe, psi, shift))

    run, modified = march(make, gpe, t_span, y0, h, save_every, lambda scheme: scheme.r**2 - scheme.shift)
    kinetic = [gpe.energy(psi) - interaction(gpe, psi) for psi in run.y.T]
    return SAVResult(**vars(run), modified_energy=kinetic + modified)


def interaction(gpe: GrossPitaevskii, psi: np.ndarray) -> float:
    """Return E1, the sum of the potential energy and the interaction energy."""
    density = np.abs(gpe.as_field(psi)) ** 2
    return gpe.grid.cell * float(np.vdot(density, gpe.V + 0.5 * gpe.beta * density))


def _shift(gpe: GrossPitaevskii, psi: np.ndarray, shift: Any) -> float:
    energy = interaction(gpe, psi)
    if shift is None:
        return 1.0 + 10 * max(-energy, 0.0)
    if isinstance(shift, bool) or not isinstance(shift, (int, float, np.integer, np.floating)):
        raise ValueError(f"shift must be a number or None, got {shift!r}")
    if not (math.isfinite(shift) and energy + shift > 0):
        raise ValueError(f"shift must be finite and exceed {-energy:g} for this start, got {shift!r}")
    return float(shift)


class _SAV(FieldScheme):
    """The scheme of `sav_crank_nicolson`; the attributes `r` and `shift` are its r and C."""

    def __init__(self, gpe: GrossPitaevskii, shift: float) -> None:
        super().__init__(gpe)
        self.shift, self.r = shift, math.nan
        self._modes, self._new_modes, self._force, self._new, self._before = (np.empty_like(self.psi) for _ in range(5))
        self._h: float | None = None  # that of the previous step
        self._c = math.nan
        self._inverse = self._modes

    def restart(self) -> None:
        self.r = math.sqrt(interaction(self.gpe, self.psi) + self.shift)
        self.forward(self.psi, self._modes)
        self._h = None

    def step(self, h: float) -> str:
        if self._c != 0.5 * h:
            self._c = 0.5 * h
            self._inverse = (1 / (1 + 1j * self._c * self.kinetic)).reshape(-1)
        if self._h is None:
            self._new_state(self.psi, 0.0)
            r, failure = self._new_state(self._new, -0.5)
        else:
            r, failure = self._new_state(self._before, 0.5 * h / self._h)
        self.r, self._h = r, h
        self._before, self.psi, self._new = self.psi, self._new, self._before
        self._modes, self._new_modes = self._new_modes, self._modes
        return failure

    def _new_state(self, other: np.ndarray, a: float) -> tuple[float, str]:
        """Take a step with b* at the state psi + a (psi - other), and write the result to `_new` and `_new_modes`.

        Return r at the end of the step, and the reason for a failure, or "".
        """
        gpe, force = self.gpe, self._force
        square = gpe.grid.cell * _kernels.nonlinear_force(self.psi, other, a, self.V, gpe.beta, force) + self.shift
        if not square > 0:
            return math.nan, f"E1 + C is {square:.2g}, which must be positive; take a larger shift"
        s = 1 / math.sqrt(square)
        self.forward(force, self._new)
        along, norm = _kernels.projections(self._new, self._modes, self._inverse, self._c)
        weight = gpe.grid.cell / self.psi.size  # Parseval
        r_mean = (self.r + s * weight * along) / (1 + s * s * weight * norm)
        _kernels.advance(self._modes, self._inverse, self._c * r_mean * s, self._new_modes, self._new)
        self.backward(self._new)
        self.nfev += 1
        return 2 * r_mean - self.r, ""
