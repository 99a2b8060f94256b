"""Moments, which replace transforms in the projection of the Gross-Pitaevskii equation."""

import numpy as np
import pytest

from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap
from eip_scipy.problems.gross_pitaevskii.pointwise import Joint, expansion, moments, shifted, total_mass


def noise(grid, seed=7):
    return np.random.default_rng(seed).standard_normal(2 * grid.size).view(complex).reshape(grid.shape)


def by_numpy(gpe, psi):
    """Return the linear part by NumPy's transforms, each term by itself."""
    grid = gpe.grid
    out = np.zeros_like(psi)
    x, y, *_ = grid.mesh()
    for axis in range(grid.dim):
        modes = np.fft.fft(psi, axis=axis)
        n = grid.shape[axis]
        k = 2 * np.pi * np.fft.fftfreq(n, grid.spacing[axis]).reshape([-1 if a == axis else 1 for a in range(grid.dim)])
        odd = np.where((n % 2 == 0) & (np.abs(k) == np.abs(k).max()), 0.0, k)
        even = odd if gpe.nyquist == "zero" else k
        factor = 0.5 * even**2 + gpe.Omega * ({0: y, 1: -x}.get(axis, 0.0) * odd)
        out += np.fft.ifft(factor * modes, axis=axis)
    return out


@pytest.fixture(params=[(8, 16), (6, 7), (5, 9, 21)], ids=str)
def state(request):
    grid = Grid(request.param, -2, 3)
    gpe = GrossPitaevskii(grid, harmonic_trap(*[1.0] * grid.dim), Omega=0.4, beta=20.0)
    psi = noise(grid).ravel()
    return gpe, psi, gpe.fun(0.0, psi)


def test_moments_are_sums_over_the_grid(state):
    gpe, psi, f = state
    found = moments(psi, f)
    n, image = np.abs(psi) ** 2, 1j * f
    sizes = np.abs(psi.real * image.real) + np.abs(psi.imag * image.imag)
    expected = (n.sum(), np.vdot(psi, image).real, np.vdot(f, f).real, (n**2).sum(), sizes.sum())
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert total_mass(psi) == pytest.approx(found[0], rel=1e-14)
    assert gpe.mass(psi) == pytest.approx(gpe.grid.cell * found[0], rel=1e-14)


def test_energy_from_moments_is_that_of_the_modes(state):
    """The energy agrees with Parseval's theorem, and the local terms are summed point by point."""
    gpe, psi, _ = state
    field = psi.reshape(gpe.grid.shape)
    local = np.sum((gpe.V + 10.0 * np.abs(field) ** 2) * np.abs(field) ** 2)
    expected = gpe.grid.cell * (np.vdot(field, by_numpy(gpe, field)).real + local)
    assert gpe.energy(psi) == pytest.approx(expected, rel=1e-13)


def test_shifted_field_and_its_sums(state):
    _, psi, f = state
    out = np.empty_like(psi)
    mass, square, slope = shifted(psi, f, 0.1, -0.02, out)
    np.testing.assert_allclose(out, 1.1 * psi - 0.02j * f, rtol=0, atol=1e-14 * np.abs(f).max())
    d = out - psi
    assert mass == pytest.approx(np.vdot(out, out).real, rel=1e-13)
    assert square == pytest.approx(np.vdot(d, d).real, rel=1e-13)
    assert slope == pytest.approx(np.vdot(1j * f, d).real, rel=1e-12)
    np.testing.assert_allclose(expansion(out, psi, f), (square, slope), rtol=1e-13)


# Mass and energy as one.


@pytest.mark.parametrize("names", [("mass",), ("energy",), ("mass", "energy"), ("energy", "mass")], ids=str)
def test_joint_is_the_invariants_one_by_one(state, names):
    gpe, psi, f = state
    count, kept = len(names), gpe.invariants(names)
    values, gram, terms = np.empty(count), np.empty((count, count)), np.empty(count)
    joint = Joint(gpe, names)
    joint.moments(0.0, psi, f, values, gram, terms)
    G = np.empty((count, psi.size), complex)
    for item, row in zip(kept, G, strict=True):
        item.grad(0.0, psi, f, row) if item.uses_f else item.grad(0.0, psi, row)
    reals = G.view(float)
    np.testing.assert_allclose(values, [item.fun(0.0, psi) for item in kept], rtol=1e-13)
    np.testing.assert_allclose(gram, reals @ reals.T, rtol=1e-12)
    np.testing.assert_allclose(terms, np.abs(reals * psi.view(float)).sum(axis=1), rtol=1e-12)
    for size in (1e-15, 1e-6):  # near the state, and far from it
        mu = size * np.arange(1.0, 1.0 + count)
        out, moved = np.empty_like(psi), np.empty(count)
        joint.shift(0.0, psi, f, mu, out, moved)
        np.testing.assert_allclose(out, psi + mu @ G, rtol=0, atol=1e-14)
        exact = [{"mass": gpe.mass, "energy": gpe.energy}[name](out) for name in names]
        np.testing.assert_allclose(moved, exact, rtol=4e-15)
