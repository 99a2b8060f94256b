"""Crank-Nicolson for the Gross-Pitaevskii equation, fully implicit: keeps mass and energy."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..problems import GrossPitaevskii
from ._fields import FieldResult, FixedPoint, Scheme, check_tol, jit, march, middle

__all__ = ["CrankNicolson", "crank_nicolson"]


def crank_nicolson(
    gpe: GrossPitaevskii,
    t_span: tuple[float, float],
    y0: Any,
    h: float,
    *,
    tol: float = 1e-12,
    save_every: int | None = None,
) -> FieldResult:
    """Integrate the Gross-Pitaevskii equation by the energy-preserving Crank-Nicolson scheme.

    ``i (psi' - psi) / h = (K + V - Omega Lz + beta / 2 (|psi'|^2 + |psi|^2)) (psi' + psi) / 2``, K = -Laplace / 2.
    Order 2; keeps mass and energy to the residual that the solver leaves.

    Parameters
    ----------
    gpe : GrossPitaevskii
    t_span : tuple of float
        Start and end; a smaller end integrates backward.
    y0 : array_like
        Initial field, of the grid's shape or flat.
    h : float
        Length of a step, positive in both directions; the last one is shortened where `h` does not divide the interval.
    tol : float, optional
        Bound of the norm of each step's residual, relative to that of the state.
    save_every : int, optional
        Save each `save_every`-th state besides the first and the last; default: these two only.

    Returns
    -------
    FieldResult
        A record with t (m,), y (n, m), nfev, wall_time [s] and message.

    Raises
    ------
    TypeError
        `gpe` is no `GrossPitaevskii`.
    ValueError
        An argument has a wrong value. The message says what came and what was expected.

    Notes
    -----
    Each step is solved for the mean of its two states by a fixed point that is preconditioned in the modes and starts
    from a parabola through the three means before; an iteration takes a pair of transforms. It contracts where
    h / 2 times half the range of ``V + beta |psi|^2`` is well below 1. A rotation, which is not diagonal in the modes,
    takes two more pairs along one axis and asks for h below about 2 / (Omega r)^2, r the largest distance from the
    axis.

    References
    ----------
    T. Wang, B. Guo, Q. Xu, Fourth-order compact and energy conservative difference schemes for the nonlinear
    Schrodinger equation in two dimensions, J. Comput. Phys. 243 (2013) 382-399; Cai, Gong & Wang, section 3.4.1.

    Examples
    --------
    >>> from eip_scipy.comparators import crank_nicolson
    >>> from eip_scipy.problems import soliton
    >>> problem = soliton(points=128)
    >>> run = crank_nicolson(problem.equation, (0.0, 1.0), problem.y0, 0.01)
    >>> bool(abs(run.y[:, -1] - problem.reference(1.0)).max() < 1e-3)
    True
    """
    tol = check_tol(tol)
    return march(lambda gpe, psi: CrankNicolson(gpe, psi, tol), gpe, t_span, y0, h, save_every)[0]


class CrankNicolson(Scheme):
    """The scheme of `crank_nicolson`; psi (n,) is a typical state."""

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray, tol: float) -> None:
        super().__init__(gpe)
        self._tol, self._w = tol, middle(self.V, gpe.beta, psi)
        self._solver: FixedPoint | None = None

    def restart(self) -> None:
        """See `Scheme`."""
        self._solver = None

    def step(self, h: float) -> str:
        """See `Scheme`."""
        if self._solver is None or self._solver.c != 0.5 * h:
            self._solver = FixedPoint(self, self._tol, 0.5 * h, self._w)
        solver = self._solver

        def rhs(mean: np.ndarray, values: np.ndarray) -> float:
            return float(
                right_side(self.psi, mean, self.rotation(mean), self.V, self.gpe.beta, solver.w, solver.c, values)
            )

        mean, failure = solver.solve(rhs, self.psi)
        other_end(mean, self.psi, self.psi)
        return failure


@jit
def right_side(psi, mean, rotation, V, beta, w, c, out):
    """Out <- psi - i c ((V + beta / 2 (|2 mean - psi|^2 + |psi|^2) - w) mean + rotation); the norm of its change.

    `rotation` may be empty.
    """
    total = 0.0
    for i in range(psi.size):
        a, m = psi[i], mean[i]
        b = 2.0 * m - a
        density = a.real * a.real + a.imag * a.imag + b.real * b.real + b.imag * b.imag
        s = c * (V[i] + 0.5 * beta * density - w)
        value = complex(a.real + s * m.imag, a.imag - s * m.real)
        if rotation.size > 0:
            value += complex(c * rotation[i].imag, -c * rotation[i].real)
        change = value - out[i]
        total += change.real * change.real + change.imag * change.imag
        out[i] = value
    return np.sqrt(total)


@jit
def other_end(mean, psi, out):
    """Out <- 2 mean - psi."""
    for i in range(psi.size):
        out[i] = 2.0 * mean[i] - psi[i]
