"""The linearly implicit central difference scheme for the Gross-Pitaevskii equation: a two-step scheme, keeps mass."""

from __future__ import annotations

from typing import Any

import numpy as np

from eip_scipy.problems import GrossPitaevskii

from . import _kernels
from ._fields import FieldResult, Implicit, check_tol, march
from .crank_nicolson import CrankNicolson

__all__ = ["LinearlyImplicit", "linearly_implicit"]


def linearly_implicit(
    gpe: GrossPitaevskii,
    t_span: tuple[float, float],
    y0: Any,
    h: float,
    *,
    tol: float = 1e-12,
    save_every: int | None = None,
) -> FieldResult:
    """Integrate the Gross-Pitaevskii equation by the linearly implicit central difference scheme.

    ``i (psi'' - psi) / (2 h) = (K + V - Omega Lz + beta |psi'|^2) (psi'' + psi) / 2`` with K = -Laplace / 2, where psi,
    psi', psi'' are three successive states: one linear system per step, with coefficients that vary in space. The
    scheme has order 2, and keeps the mass and, in place of the energy, an expression in two successive states (see
    Notes).

    Parameters
    ----------
    gpe, t_span, y0, h, tol, save_every
        As for `crank_nicolson`.

    Returns
    -------
    FieldResult
        A record with t (m,), y (n, m), nfev, wall_time [s] and message.

    Raises
    ------
    TypeError, ValueError
        As for `crank_nicolson`.

    Notes
    -----
    The first step, and a shorter last one, are steps of `crank_nicolson`, which has the same order and keeps
    the mass. The linear systems are solved by the same preconditioned fixed-point iteration; the bounds on h for its
    convergence are half of those of `crank_nicolson`.

    The scheme keeps ``(<psi'', L psi''> + <psi', L psi'>) / 2 + beta / 2 <|psi'|^2, |psi''|^2>``, L = K + V - Omega Lz.

    References
    ----------
    F. Zhang, V. M. Perez-Garcia, L. Vazquez, Numerical simulation of nonlinear Schrodinger systems: a new conservative
    scheme, Appl. Math. Comput. 71 (1995) 165-177; Cai, Gong & Wang, section 3.4.1.

    Examples
    --------
    >>> from eip_scipy_studies.comparators import linearly_implicit
    >>> from eip_scipy_studies.condensates.problems import soliton
    >>> problem = soliton(points=128)
    >>> run = linearly_implicit(problem.equation, (0.0, 1.0), problem.y0, 0.01)
    >>> bool(abs(run.y[:, -1] - problem.reference(1.0)).max() < 1e-3)
    True
    """
    tol = check_tol(tol)
    return march(lambda gpe, psi: LinearlyImplicit(gpe, psi, tol), gpe, t_span, y0, h, save_every)[0]


class LinearlyImplicit(Implicit):
    """The scheme of `linearly_implicit`."""

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray, tol: float) -> None:
        super().__init__(gpe, psi, tol)
        self._starter = CrankNicolson(gpe, psi, tol)
        self._before = np.empty_like(self.psi)

    def step(self, h: float) -> str:
        """See `FieldScheme`."""
        solver, new = self.solver(h)  # 2 h is the distance between the ends
        if new:
            return self._single_step(h)
        failure = self.cross(solver, self._before)
        self.psi, self._before = self._before, self.psi
        return failure

    def potential(self, start: np.ndarray, mean: np.ndarray, out: np.ndarray) -> None:
        """See `Implicit`."""
        _kernels.density(self.psi, self.V, self.gpe.beta, out)

    def _single_step(self, h: float) -> str:
        self._before[:] = self.psi
        self._starter.start(self.psi)
        failure = self._starter.step(h)
        self.nfev += self._starter.nfev
        self.psi[:] = self._starter.psi
        return failure
