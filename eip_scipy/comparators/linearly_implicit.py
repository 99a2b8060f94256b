"""The linearly implicit central difference scheme for the Gross-Pitaevskii equation: two steps, keeps the mass."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..problems import GrossPitaevskii
from ._fields import FieldResult, FixedPoint, Scheme, check_tol, jit, march, middle
from .crank_nicolson import CrankNicolson, other_end

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

    ``i (psi'' - psi) / (2 h) = (K + V - Omega Lz + beta |psi'|^2) (psi'' + psi) / 2`` with K = -Laplace / 2: one linear
    system a step, with coefficients that vary in space. Order 2; keeps the mass, and a form of two neighbours
    in the place of the energy.

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
        As `crank_nicolson`.

    Notes
    -----
    The first step, and a last one that is shorter, are steps of `crank_nicolson`, which has the same order and keeps
    the mass. The linear systems are solved as there, by a fixed point preconditioned in the modes; the bounds of h for
    its convergence are half of those there.

    What is kept is ``(<psi'', L psi''> + <psi', L psi'>) / 2 + beta / 2 <|psi'|^2, |psi''|^2>``, L = K + V - Omega Lz.

    References
    ----------
    F. Zhang, V. M. Perez-Garcia, L. Vazquez, Numerical simulation of nonlinear Schrodinger systems: a new conservative
    scheme, Appl. Math. Comput. 71 (1995) 165-177; Cai, Gong & Wang, section 3.4.1.

    Examples
    --------
    >>> from eip_scipy.comparators import linearly_implicit
    >>> from eip_scipy.problems import soliton
    >>> problem = soliton(points=128)
    >>> run = linearly_implicit(problem.equation, (0.0, 1.0), problem.y0, 0.01)
    >>> bool(abs(run.y[:, -1] - problem.reference(1.0)).max() < 1e-3)
    True
    """
    tol = check_tol(tol)
    return march(lambda gpe, psi: LinearlyImplicit(gpe, psi, tol), gpe, t_span, y0, h, save_every)[0]


class LinearlyImplicit(Scheme):
    """The scheme of `linearly_implicit`; psi (n,) is a typical state."""

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray, tol: float) -> None:
        super().__init__(gpe)
        self._tol, self._w = tol, middle(self.V, gpe.beta, psi)
        self._starter = CrankNicolson(gpe, psi, tol)
        self._before = np.empty_like(self.psi)
        self._solver: FixedPoint | None = None

    def restart(self) -> None:
        """See `Scheme`."""
        self._solver = None

    def step(self, h: float) -> str:
        """See `Scheme`."""
        # 2 h is the distance between the ends, c half of it.
        if self._solver is None or self._solver.c != h:
            self._solver = FixedPoint(self, self._tol, h, self._w)
            return self._single_step(h)
        solver, before = self._solver, self._before

        def rhs(mean: np.ndarray, values: np.ndarray) -> float:
            return float(
                right_side(
                    before, self.psi, mean, self.rotation(mean), self.V, self.gpe.beta, solver.w, solver.c, values
                )
            )

        mean, failure = solver.solve(rhs, self.psi)
        other_end(mean, before, before)
        self.psi, self._before = before, self.psi
        return failure

    def _single_step(self, h: float) -> str:
        self._before[:] = self.psi
        self._starter.start(self.psi)
        failure = self._starter.step(h)
        self.nfev += self._starter.nfev
        self.psi[:] = self._starter.psi
        return failure


@jit
def right_side(before, psi, mean, rotation, V, beta, w, c, out):
    """Out <- before - i c ((V + beta |psi|^2 - w) mean + rotation), `rotation` may be empty; the norm of its change."""
    total = 0.0
    for i in range(psi.size):
        a, m = psi[i], mean[i]
        s = c * (V[i] + beta * (a.real * a.real + a.imag * a.imag) - w)
        value = complex(before[i].real + s * m.imag, before[i].imag - s * m.real)
        if rotation.size > 0:
            value += complex(c * rotation[i].imag, -c * rotation[i].real)
        change = value - out[i]
        total += change.real * change.real + change.imag * change.imag
        out[i] = value
    return np.sqrt(total)
