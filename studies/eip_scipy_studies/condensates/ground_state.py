"""Ground states: minima of the energy among fields of mass 1, by preconditioned nonlinear conjugate gradients.

X. Antoine, A. Levitt, Q. Tang, "Efficient spectral computation of the stationary states of rotating Bose-Einstein
condensates by preconditioned nonlinear conjugate gradient methods", J. Comput. Phys. 343 (2017) 92-109.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import cos, hypot, pi, sin, sqrt
from typing import Any

import numpy as np
from scipy.optimize import brentq

from eip_scipy.problems import GrossPitaevskii
from eip_scipy.problems.gross_pitaevskii import Multiplier

from .pointwise import add_potential, divide_by_root, inner, quartic_sums, rotate

REFRESH = 20  # iterations between two evaluations of what is carried along otherwise
NOISE, BREAK_SYMMETRY = 0.05, 1e-3  # of an amplitude: enough to leave a symmetry at once, or in the end
# The search of `lowest_ring` over numbers of vortices and windings.
WALK_TOLERANCE, WALK_ITERATIONS = 1e-3, 150
NEIGHBOURS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1))
ROW = 0.4  # of the vortices of a rigid rotation are in a single row in the ring, where the walk starts


@dataclass(frozen=True, eq=False)
class GroundState:
    """A stationary state: a field of mass 1, its energy and chemical potential, and the norm of H psi - mu psi."""

    psi: np.ndarray
    energy: float
    mu: float
    residual: float
    iterations: int
    converged: bool
    message: str


def ground_state(gpe: GrossPitaevskii, start: Any, *, tol: float = 1e-8, max_iterations: int = 10_000) -> GroundState:
    """Minimise the energy among fields of mass 1 from the field `start`, until the residual is at most `tol`.

    The method uses the combined preconditioner and the coefficient of Polak and Ribiere of the paper, with an exact
    line search: the energy of cos(a) psi + sin(a) p is a polynomial of degree 4 in cosine and sine, whose coefficients
    need no further transform.
    """
    psi = gpe.as_field(start)
    return _Descent(gpe, psi / sqrt(gpe.mass(psi))).run(tol, max_iterations)


class _Descent:
    """State of the search: psi, the direction p, and their images under the linear part plus the potential.

    The preconditioner is D (a - Laplace / 2)^(-1) D, D = (a + W)^(-1/2), W = V - min V + ``|beta| |psi|^2``, where the
    typical energy a is that of psi every `REFRESH` iterations.
    """

    def __init__(self, gpe: GrossPitaevskii, psi: np.ndarray) -> None:
        self.gpe, self.psi = gpe, psi
        self.residual, self.old_residual = np.empty_like(psi), np.zeros_like(psi)
        self.p, self.image, self.p_image = np.zeros_like(psi), np.empty_like(psi), np.empty_like(psi)
        self.slope = 0.0  # <residual, preconditioned residual> of the last iteration
        self.axes, self.V, self.zero = tuple(range(gpe.grid.dim)), gpe.V - gpe.V.min(), np.zeros(gpe.grid.shape)
        self.kinetic: Any = sum(gpe.kinetic_factor(axis) for axis in self.axes)
        self.energy = Multiplier(gpe.grid, self.axes, self.kinetic)
        self.scaled, self.out = np.empty_like(psi), np.empty_like(psi)

    def inner(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return Re <a, b>, with the size of a cell as weight."""
        return self.gpe.grid.cell * float(inner(a, b))

    def apply(self, field: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the linear part and the potential applied to `field`."""
        self.gpe.linear(field, out)
        add_potential(field, self.gpe.V, 0.0, out)

    def run(self, tol: float, max_iterations: int) -> GroundState:
        """Iterate, and return the result once it converged or no direction descends."""
        message, iteration = "", 0
        while not message:
            if iteration % REFRESH == 0:  # removes rounding errors of what is carried along
                self.psi /= sqrt(self.inner(self.psi, self.psi))
                self.apply(self.psi, self.image)
                self.fit()
            mu, norm = self.gradient()
            if norm <= tol:
                message = "converged"
            elif iteration == max_iterations:
                message = f"not converged in {max_iterations} iterations"
            elif not (self.conjugate_direction() and self.line_search()):
                message = "stalled: round-off leaves no descent"
            else:
                iteration += 1
        return GroundState(self.psi, self.gpe.energy(self.psi), mu, norm, iteration, norm <= tol, message)

    def fit(self) -> None:
        """Compute a: the kinetic energy plus the sum of W ``|psi|^2`` times the size of a cell."""
        density = np.abs(self.psi) ** 2
        local = float(np.vdot(density, self.V + abs(self.gpe.beta) * density))
        self.a = self.gpe.grid.cell * (self.energy.expectation(self.gpe.transforms, self.psi, self.scaled) + local)
        self.inverse = Multiplier(self.gpe.grid, self.axes, 1 / (self.a + self.kinetic))

    def preconditioned(self, r: np.ndarray) -> np.ndarray:
        """Return the preconditioned residual `r` in a buffer, which the next call overwrites."""
        local = (self.psi, self.V, abs(self.gpe.beta), self.a)
        divide_by_root(r, *local, self.scaled)
        self.inverse.apply(self.gpe.transforms, self.scaled, self.out)
        divide_by_root(self.out, *local, self.out)
        return self.out

    def gradient(self) -> tuple[float, float]:
        """Compute the residual H psi - mu psi; return mu and the norm of the residual."""
        r = self.residual
        np.copyto(r, self.image)
        add_potential(self.psi, self.zero, self.gpe.beta, r)
        mu = self.inner(self.psi, r)
        rotate(r, self.psi, 1.0, -mu)
        return mu, sqrt(self.inner(r, r))

    def conjugate_direction(self) -> bool:
        """Choose the next direction: conjugate, or steepest if that does not descend; return False if neither does."""
        r, old = self.residual, self.old_residual
        d = self.preconditioned(r)
        slope = self.inner(r, d)
        factor = max((slope - self.inner(old, d)) / self.slope, 0.0) if self.slope > 0 else 0.0
        self.slope, self.residual, self.old_residual = slope, old, r
        for weight in (factor, 0.0):
            rotate(self.p, d, weight, -1.0)
            rotate(self.p, self.psi, 1.0, -self.inner(self.psi, self.p))
            if self.inner(r, self.p) < 0:
                return True
        return False

    def line_search(self) -> bool:
        """Move to the smallest energy along the great circle through psi and p; return False if psi does not move."""
        r, norm = self.old_residual, sqrt(self.inner(self.p, self.p))
        self.apply(self.p, self.p_image)
        g = 0.5 * self.gpe.beta * self.gpe.grid.cell
        nn, nq, mm, mq, qq = g * np.array(quartic_sums(self.psi, self.p)) / norm ** np.array([0, 2, 2, 3, 4])
        a, b = self.inner(self.psi, self.image), self.inner(self.p, self.image) / norm
        c = self.inner(self.p, self.p_image) / norm**2
        slope = 2 * self.inner(r, self.p) / norm
        tangent = _least_energy(a + nn, slope, a + c + 2 * nq + 4 * mm, 2 * b + 4 * mq, c + qq)
        cosine = 1 / hypot(1.0, tangent)
        sine = tangent * cosine / norm
        rotate(self.psi, self.p, cosine, sine)
        rotate(self.image, self.p_image, cosine, sine)
        return tangent != 0.0


def _least_energy(e0: float, e1: float, e2: float, e3: float, e4: float) -> float:
    """Return t = tan(a) for the angle a at which sum_k e_k cos(a)^(4 - k) sin(a)^k is smallest; e_1 < 0."""
    roots = np.roots([-e3, 4 * e4 - 2 * e2, 3 * (e3 - e1), 2 * e2 - 4 * e0, e1])
    t = roots[np.abs(roots.imag) <= 1e-6 * np.abs(roots)].real
    values = (e0 + t * (e1 + t * (e2 + t * (e3 + t * e4)))) / (1 + t * t) ** 2
    return float(t[np.argmin(values)]) if t.size else 0.0


def _square(gpe: GrossPitaevskii) -> Any:
    """Return r^2 = x^2 + y^2, of the grid's dimension."""
    return sum(a**2 for a in gpe.grid.mesh()[:2])


def thomas_fermi(gpe: GrossPitaevskii) -> np.ndarray:
    """Return the Thomas-Fermi density of mass 1, (mu - V + Omega^2 r^2 / 2) / beta where this is positive, and else 0.

    A ValueError is raised if the density reaches the ends of the box.
    """
    well = gpe.V - 0.5 * gpe.Omega**2 * (_square(gpe) if gpe.Omega else 0.0)
    cell, low = gpe.grid.cell, float(well.min())
    excess = lambda mu: cell * float(np.maximum(mu - well, 0.0).sum()) / gpe.beta - 1.0  # noqa: E731
    mu = brentq(excess, low, float(well.max()) + gpe.beta / (cell * gpe.grid.size), xtol=1e-12)
    density = np.maximum(mu - well, 0.0) / gpe.beta
    if any(np.any(np.take(density, 0, axis=axis)) for axis in range(gpe.grid.dim)):
        raise ValueError("the condensate does not fit into the box of the grid: enlarge the box, or lower Omega.")
    return density


def imprint(gpe: GrossPitaevskii, positions: Any) -> np.ndarray:
    """Return the Thomas-Fermi amplitude with singly charged vortices, or lines along z, at the `positions` (k, 2)."""
    density = thomas_fermi(gpe)
    x, y, *_ = gpe.grid.mesh()
    psi = np.sqrt(density).astype(complex)
    core2 = 1 / (2 * gpe.beta * float(density.max()))  # the square of the healing length
    for a, b in np.asarray(positions, dtype=float).reshape(-1, 2):
        z = (x - a) + 1j * (y - b)
        psi *= z / np.sqrt(np.abs(z) ** 2 + core2)
    return psi


def polygon(count: int, radius: float) -> np.ndarray:
    """Return the corners (count, 2) of a regular polygon about the origin, the first on the x axis."""
    angle = 2 * pi * np.arange(count) / max(count, 1)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def ring_start(gpe: GrossPitaevskii, count: int, winding: int) -> np.ndarray:
    """Return the Thomas-Fermi amplitude of a ring with `count` vortices on its mean circle, around a `winding`."""
    psi = imprint(gpe, polygon(count, sqrt(_mean_square_radius(gpe))))
    x, y, *_ = gpe.grid.mesh()
    return psi * np.exp(1j * winding * np.arctan2(y, x))


def _mean_square_radius(gpe: GrossPitaevskii) -> float:
    density = thomas_fermi(gpe)
    return float((_square(gpe) * density).sum() / density.sum())


def with_noise(psi: np.ndarray, rng: np.random.Generator, size: float = NOISE) -> np.ndarray:
    """Return `psi` plus complex noise of `size` times the modulus at each point, so that the field has no symmetry."""
    noise = rng.standard_normal((2, *psi.shape))
    return psi + size * np.abs(psi) * (noise[0] + 1j * noise[1])


def vortex_starts(gpe: GrossPitaevskii, count: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Yield fields with triangular lattices of 0.6 to 1.2 times a rigid body's vortices, at random, with some noise."""
    rng = np.random.default_rng(seed)
    density = thomas_fermi(gpe)
    for _ in range(count):
        psi = imprint(gpe, _lattice(gpe, density, rng)) if gpe.Omega else np.sqrt(density).astype(complex)
        yield with_noise(psi, rng)


def _lattice(gpe: GrossPitaevskii, density: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the points (k, 2) of a random triangular lattice within the outer radius of the condensate."""
    radius = sqrt(float(np.max(_square(gpe) * (density > 0))))
    area = pi / abs(gpe.Omega) / rng.uniform(0.6, 1.2)
    side, angle = sqrt(2 * area / sqrt(3.0)), rng.uniform(0, pi / 3)
    reach = int(2 * radius / side) + 2
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1) + rng.uniform(size=(2, 1))
    a, b = side * (i + 0.5 * j), side * sqrt(0.75) * j
    points = np.column_stack([cos(angle) * a - sin(angle) * b, sin(angle) * a + cos(angle) * b])
    return points[np.hypot(*points.T) < radius]


def lowest_ring(
    gpe: GrossPitaevskii, *, tol: float = 1e-8, seed: int = 0, report: Callable[[int, int, float], Any]
) -> tuple[GroundState, tuple[int, int]]:
    """Search for the lowest state of a two-dimensional condensate with a row of vortices around a hole, and its pair.

    No descent leads from a state to one with another winding of the phase around the hole. Therefore short searches are
    made from starts with pairs (count of vortices, winding), and ``report(count, winding, energy)`` is called for each:
    from each pair the search goes on to its neighbour of lowest energy, until no neighbour is lower. The last search
    starts from the best state with noise, to break its symmetry.
    """
    r2 = _square(gpe)[thomas_fermi(gpe) > 0]
    count = round(ROW * abs(gpe.Omega) * (r2.max() - r2.min()))
    best = count, round(abs(gpe.Omega) * _mean_square_radius(gpe) - count / 2)
    found: dict[tuple[int, int], GroundState] = {}

    def energy(pair: tuple[int, int]) -> float:
        if pair not in found:
            start = ring_start(gpe, *pair)
            found[pair] = ground_state(gpe, start, tol=WALK_TOLERANCE, max_iterations=WALK_ITERATIONS)
            report(*pair, found[pair].energy)
        return found[pair].energy

    here = None
    while here != best:
        here = best
        best = min([here, *((here[0] + a, here[1] + b) for a, b in NEIGHBOURS)], key=energy)
    start = with_noise(found[best].psi, np.random.default_rng(seed), BREAK_SYMMETRY)
    return ground_state(gpe, start, tol=tol), best
