"""Ground states: minima of the energy among fields of mass 1, by preconditioned nonlinear conjugate gradients.

X. Antoine, A. Levitt, Q. Tang, "Efficient spectral computation of the stationary states of rotating Bose-Einstein
condensates by preconditioned nonlinear conjugate gradient methods", J. Comput. Phys. 343 (2017) 92-109.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, sqrt
from typing import Any

import numpy as np

from .equation import GrossPitaevskii
from .grid import Multiplier
from .pointwise import add_potential, divide_by_root, inner, quartic_sums, rotate

__all__ = ["GroundState", "ground_state"]

REFRESH = 20  # iterations between two evaluations of what is carried along otherwise
Progress = Callable[[int, float, float], Any]


@dataclass(frozen=True, eq=False)
class GroundState:
    """A stationary state, a minimum of the energy unless the start had a symmetry that the minimum lacks.

    Attributes
    ----------
    psi : ndarray, shape (J[, K[, L]])
        The field, of mass 1.
    energy, mu : float
        Energy and chemical potential.
    residual : float
        Norm of H psi - mu psi, the root of the sum of squares times the size of a cell.
    iterations : int
        Number of iterations.
    converged : bool
        True if the residual is at most `tol` of `ground_state`.
    message : str
        Why the iteration ended.
    """

    psi: np.ndarray
    energy: float
    mu: float
    residual: float
    iterations: int
    converged: bool
    message: str

    def __repr__(self) -> str:
        numbers = f"energy={self.energy:.10g}, mu={self.mu:.10g}, residual={self.residual:.1e}"
        return f"GroundState({numbers}, iterations={self.iterations}: {self.message})"


def ground_state(
    gpe: GrossPitaevskii,
    start: Any,
    *,
    tol: float = 1e-8,
    max_iterations: int = 10_000,
    progress: Progress | None = None,
) -> GroundState:
    """Minimise the energy among fields of mass 1, from a given start.

    Parameters
    ----------
    gpe : GrossPitaevskii
    start : array_like
        A field, normalised or not, see `vortex_starts` and `imprint`.
    tol : float, optional
        Bound for the norm of H psi - mu psi.
    max_iterations : int, optional
        Largest number of iterations.
    progress : callable, optional
        ``progress(iteration, energy, residual)``, called in each iteration; a true return value ends the search.

    Returns
    -------
    GroundState
        If the search ended early, `converged` is False, and `message` has the reason.

    Raises
    ------
    ValueError
        If the start is zero or not finite, or an option has a wrong value.

    Notes
    -----
    The method uses the combined preconditioner and the coefficient of Polak and Ribiere of the paper by Antoine, Levitt
    and Tang (2017), with an exact line search: the energy of cos(a) psi + sin(a) p is a polynomial of degree 4 in
    cosine and sine, whose coefficients need no further transform. One iteration costs the linear part of one field, and
    one pair of transforms for the preconditioner.
    """
    if not tol > 0 or isinstance(max_iterations, bool) or not isinstance(max_iterations, int) or max_iterations < 1:
        raise ValueError(f"tol must be > 0 and max_iterations an integer >= 1, got {tol!r} and {max_iterations!r}.")
    psi = gpe.as_field(start)
    mass = gpe.mass(psi)
    if not 0 < mass < np.inf:
        raise ValueError(f"the start must be finite and not zero everywhere; its mass is {mass}.")
    return _Descent(gpe, psi / sqrt(mass)).run(tol, max_iterations, progress)


class _Descent:
    """State of the search: psi, the direction p, and their images under the linear part plus the potential."""

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray) -> None:
        self.gpe, self.psi = gpe, psi
        self.residual, self.old_residual = np.empty_like(psi), np.zeros_like(psi)
        self.p, self.image, self.p_image = np.zeros_like(psi), np.empty_like(psi), np.empty_like(psi)
        self.slope = 0.0  # <residual, preconditioned residual> of the last iteration
        self.preconditioner = _Preconditioner(gpe)

    def inner(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return Re <a, b>, with the size of a cell as weight."""
        return self.gpe.grid.cell * float(inner(a, b))

    def apply(self, field: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the linear part and the potential applied to `field`."""
        self.gpe.linear(field, out)
        add_potential(field, self.gpe.V, 0.0, out)

    def run(self, tol: float, max_iterations: int, progress: Progress | None) -> GroundState:
        """Iterate, and return the result, once it converged, `progress` says so, or no direction descends."""
        message, iteration = "", 0
        while not message:
            if iteration % REFRESH == 0:
                self.refresh()
            mu, norm = self.gradient()
            if norm <= tol:
                message = "converged"
            elif iteration == max_iterations:
                message = f"not converged in {max_iterations} iterations"
            elif progress is not None and progress(iteration, self.energy(mu), norm):
                message = "stopped by progress"
            elif not (self.turn() and self.advance()):
                message = "stalled: round-off leaves no descent"
            else:
                iteration += 1
        return GroundState(self.psi, self.gpe.energy(self.psi), mu, norm, iteration, norm <= tol, message)

    def energy(self, mu: float) -> float:
        """Return the energy, which is mu minus beta / 2 times the integral of ``|psi|^4``."""
        density = np.abs(self.psi) ** 2
        return mu - 0.5 * self.gpe.beta * self.gpe.grid.cell * float(np.vdot(density, density))

    def refresh(self) -> None:
        """Normalise psi, recompute its `image` by `apply` to remove rounding errors, and adapt the preconditioner."""
        self.psi /= sqrt(self.inner(self.psi, self.psi))
        self.apply(self.psi, self.image)
        self.preconditioner.fit(self.psi)

    def gradient(self) -> tuple[float, float]:
        """Compute the residual H psi - mu psi; return mu and the norm of the residual."""
        r = self.residual
        np.copyto(r, self.image)
        add_potential(self.psi, self.preconditioner.zero, self.gpe.beta, r)
        mu = self.inner(self.psi, r)
        rotate(r, self.psi, 1.0, -mu)
        return mu, sqrt(self.inner(r, r))

    def turn(self) -> bool:
        """Choose the next direction: conjugate, or steepest if that does not descend; return False if neither does."""
        r, old = self.residual, self.old_residual
        d = self.preconditioner(r, self.psi)
        slope = self.inner(r, d)
        factor = max((slope - self.inner(old, d)) / self.slope, 0.0) if self.slope > 0 else 0.0
        self.slope, self.residual, self.old_residual = slope, old, r
        for weight in (factor, 0.0):
            rotate(self.p, d, weight, -1.0)
            rotate(self.p, self.psi, 1.0, -self.inner(self.psi, self.p))
            if self.inner(r, self.p) < 0:
                return True
        return False

    def advance(self) -> bool:
        """Move to the smallest energy along the great circle through psi and p; return False if psi does not move."""
        r, norm = self.old_residual, sqrt(self.inner(self.p, self.p))
        self.apply(self.p, self.p_image)
        g = 0.5 * self.gpe.beta * self.gpe.grid.cell
        nn, nq, mm, mq, qq = g * np.array(quartic_sums(self.psi, self.p)) / norm ** np.array([0, 2, 2, 3, 4])
        a, b = self.inner(self.psi, self.image), self.inner(self.p, self.image) / norm
        c = self.inner(self.p, self.p_image) / norm**2
        tangent = _least_energy(
            (a + nn, 2 * self.inner(r, self.p) / norm, a + c + 2 * nq + 4 * mm, 2 * b + 4 * mq, c + qq)
        )
        cosine = 1 / hypot(1.0, tangent)
        sine = tangent * cosine / norm
        rotate(self.psi, self.p, cosine, sine)
        rotate(self.image, self.p_image, cosine, sine)
        return tangent != 0.0


def _least_energy(e: tuple[float, float, float, float, float]) -> float:
    """Return t = tan(a) for the angle a at which sum_k e_k cos(a)^(4 - k) sin(a)^k is smallest; e_1 < 0."""
    e0, e1, e2, e3, e4 = e
    roots = np.roots([-e3, 4 * e4 - 2 * e2, 3 * (e3 - e1), 2 * e2 - 4 * e0, e1])
    t = roots[np.abs(roots.imag) <= 1e-6 * np.abs(roots)].real
    values = (e0 + t * (e1 + t * (e2 + t * (e3 + t * e4)))) / (1 + t * t) ** 2
    return float(t[np.argmin(values)]) if t.size else 0.0


class _Preconditioner:
    """Operator D (a - Laplace / 2)^(-1) D with D = (a + W)^(-1/2), for a typical energy a.

    W is V minus its minimum plus ``|beta| |psi|^2``, so that D is defined for every sign of V and beta.
    """

    def __init__(self, gpe: GrossPitaevskii) -> None:
        self._gpe = gpe
        self._axes = tuple(range(gpe.grid.dim))
        self._kinetic: Any = sum(gpe.kinetic_factor(axis) for axis in self._axes)
        self._V = gpe.V - gpe.V.min()
        self._energy = Multiplier(gpe.grid, self._axes, self._kinetic)
        self._scaled, self._out = np.empty(gpe.grid.shape, complex), np.empty(gpe.grid.shape, complex)
        self.zero = np.zeros(gpe.grid.size)

    def fit(self, psi: np.ndarray) -> None:
        """Compute a from a field: its kinetic energy plus the sum of W ``|psi|^2`` times the size of a cell."""
        gpe = self._gpe
        density = np.abs(psi) ** 2
        local = float(np.vdot(density, self._V + abs(gpe.beta) * density))
        self._a = gpe.grid.cell * (self._energy.expectation(gpe.transforms, psi, self._scaled) + local)
        self._inverse = Multiplier(gpe.grid, self._axes, 1 / (self._a + self._kinetic))

    def __call__(self, r: np.ndarray, psi: np.ndarray) -> np.ndarray:
        """Return the preconditioned residual `r` in a buffer, which the next call overwrites."""
        local = (psi, self._V, abs(self._gpe.beta), self._a)
        divide_by_root(r, *local, self._scaled)
        self._inverse.apply(self._gpe.transforms, self._scaled, self._out)
        divide_by_root(self._out, *local, self._out)
        return self._out
