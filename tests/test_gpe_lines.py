"""The right-hand side's own transforms, and the moments that stand in for transforms in the projection."""

import numpy as np
import pytest

from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap, quartic_trap
from eip_scipy.problems.gross_pitaevskii import LinearFlow
from eip_scipy.problems.gross_pitaevskii.lines import LineSum, fits, order_of_modes
from eip_scipy.problems.gross_pitaevskii.moments import expansion, moments, shifted, total_mass
from eip_scipy.problems.gross_pitaevskii.phases import LineFlow

SHAPES = [(8, 8), (8, 32), (64, 16), (128, 8), (256, 512), (8, 16, 32), (64, 8, 8), (16, 128, 8)]


def noise(grid, seed=7):
    return np.random.default_rng(seed).standard_normal(2 * grid.size).view(complex).reshape(grid.shape)


def by_numpy(gpe, psi):
    """The linear part by NumPy's transforms, each term by itself."""
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


# Transforms.


@pytest.mark.parametrize("shape", [(8, 8), (8, 16), (16, 8, 8), (8, 8, 32)])
def test_transforms_by_themselves(shape):
    """Also without the JIT, where the equation leaves them alone."""
    grid = Grid(shape, -2, 3)
    gpe = GrossPitaevskii(grid, lambda *a: sum(a) ** 2, Omega=0.7, beta=2.0, fft="scipy")
    kinetic = [gpe.kinetic_factor(axis) for axis in range(grid.dim)]
    k, q = (grid.wavenumbers(axis, odd=True) for axis in (0, 1))
    lines = LineSum(grid, kinetic, [0.7 * k, -0.7 * q], threads=2)
    psi = noise(grid)
    linear = by_numpy(gpe, psi)
    out, size = np.empty_like(psi), np.abs(linear).max()
    lines.apply(psi, out)
    np.testing.assert_allclose(out, linear, rtol=0, atol=4e-15 * size)
    lines.derivative(psi, gpe.V, gpe.beta, out)
    expected = -1j * (linear + (gpe.V + 2.0 * np.abs(psi) ** 2) * psi)
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-14 * size)
    flow = LineFlow(grid, [(0, kinetic[0], 0.3 * k), (1, kinetic[1], 0.0 * q)], threads=2)
    modes = np.fft.fft(psi, axis=0)
    y = grid.mesh()[1]
    modes = np.fft.ifft(np.exp(-1j * (kinetic[0] + 0.3 * k * y)) * modes, axis=0)
    expected = np.fft.ifft(np.exp(-1j * kinetic[1]) * np.fft.fft(modes, axis=1), axis=1)
    flow.apply(psi)
    np.testing.assert_allclose(psi, expected, rtol=0, atol=1e-13)


@pytest.mark.needs_jit
@pytest.mark.parametrize("nyquist", ["true", "zero"])
@pytest.mark.parametrize("shape", SHAPES)
def test_right_hand_side_is_numpys(shape, nyquist):
    """An array of any alignment, and a box and a potential without symmetry."""
    dim = len(shape)
    grid = Grid(shape, np.array([-3.0, -2.0, -1.0])[:dim], np.array([2.0, 4.0, 2.5])[:dim])
    gpe = GrossPitaevskii(grid, lambda *a: sum((k + 1) * c**2 for k, c in enumerate(a)), Omega=0.7, beta=-3.0,
                          nyquist=nyquist)  # fmt: skip
    assert gpe.own_transforms
    raw = np.zeros(grid.size + 1, complex)
    for start in (0, 1):
        psi = raw[start : start + grid.size].reshape(shape)
        psi[...] = noise(grid)
        linear = by_numpy(gpe, psi)
        size = np.abs(linear).max()
        out = np.empty_like(psi)
        gpe.linear(psi, out)
        np.testing.assert_allclose(out, linear, rtol=0, atol=4e-15 * size)
        expected = -1j * (linear + (gpe.V - 3.0 * np.abs(psi) ** 2) * psi)
        np.testing.assert_allclose(gpe.fun(0.0, psi.ravel()), expected.ravel(), rtol=0, atol=4e-15 * size)
        np.testing.assert_array_equal(psi, noise(grid))


@pytest.mark.needs_jit
@pytest.mark.parametrize("shape", [(32, 64), (8, 16, 32)])
def test_without_rotation_a_plane_wave_is_multiplied_by_its_energy(shape):
    grid = Grid(shape, 0, 2 * np.pi)
    gpe = GrossPitaevskii(grid)
    modes = (3, -7, 5)[: grid.dim]
    psi = np.exp(1j * sum(k * x for k, x in zip(modes, grid.mesh(), strict=True)))
    out = np.empty_like(psi)
    gpe.linear(psi, out)
    level = 0.5 * sum(k * k for k in modes)
    highest = sum(n * n for n in shape) / 8  # multiplies what is rounded in psi
    np.testing.assert_allclose(out, level * psi, rtol=0, atol=1e-14 * highest)


@pytest.mark.parametrize("n", [8, 16, 32, 64, 128])
def test_order_of_modes_has_each_once(n):
    order = order_of_modes(n)
    np.testing.assert_array_equal(np.sort(order), np.arange(n))
    np.testing.assert_array_equal(order[: n // 4] % 4, 0)


@pytest.mark.needs_jit
@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("shape", [(32, 64), (8, 16, 32)])
def test_threads_give_the_same_bits(shape, threads):
    grid = Grid(shape, -2, 3)
    one, many = (
        GrossPitaevskii(grid, harmonic_trap(*[1.0] * grid.dim), Omega=0.4, beta=2.0, threads=n) for n in (1, threads)
    )
    y = noise(grid).ravel()
    np.testing.assert_array_equal(many.fun(0.0, y), one.fun(0.0, y))


@pytest.mark.needs_jit
def test_which_grids_have_own_transforms():
    assert all(fits(shape) for shape in SHAPES)
    assert not any(fits(shape) for shape in [(64,), (4, 8), (8, 4, 8), (48, 64), (64, 96), (8, 8, 12)])
    grid = Grid((16, 16), -1, 1)
    assert GrossPitaevskii(grid).own_transforms
    assert not GrossPitaevskii(grid, fft="scipy").own_transforms
    assert not GrossPitaevskii(Grid((12, 16), -1, 1)).own_transforms


@pytest.mark.needs_jit
def test_libraries_and_own_transforms_agree():
    grid = Grid((64, 32), (-6, -7), (6, 5))
    own, other = (
        GrossPitaevskii(grid, quartic_trap(1.2, 0.3, 1, 1), Omega=1.5, beta=10.0, fft=fft) for fft in ("auto", "scipy")
    )
    y = noise(grid).ravel()
    f = other.fun(0.0, y)
    np.testing.assert_allclose(own.fun(0.0, y), f, rtol=0, atol=4e-15 * np.abs(f).max())
    assert own.energy(y) == pytest.approx(other.energy(y), rel=1e-14)


@pytest.mark.needs_jit
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("angle", [0.0, 0.3, -0.6])
@pytest.mark.parametrize("shape", [(8, 64), (32, 16), (8, 16, 8), (16, 8, 32)])
def test_own_flows_are_the_libraries(shape, angle, threads):
    grid = Grid(shape, np.array([-3.0, -2.0, -1.0])[: len(shape)], 2.0)
    own, other = (
        LinearFlow(GrossPitaevskii(grid, nyquist="zero", fft=fft, threads=threads), 0.07, angle)
        for fft in ("auto", "scipy")
    )
    psi = noise(grid)
    images = [flow.apply(psi.copy(), np.empty_like(psi))[0] for flow in (own, other)]
    np.testing.assert_allclose(*images, rtol=0, atol=1e-13)
    assert np.abs(images[0] - psi).max() > 0.1


# Moments.


@pytest.fixture(params=[(8, 16), (6, 7), (5, 9, 21)], ids=str)
def state(request):
    grid = Grid(request.param, -2, 3)
    gpe = GrossPitaevskii(grid, harmonic_trap(*[1.0] * grid.dim), Omega=0.4, beta=20.0)
    psi = noise(grid).ravel()
    return gpe, psi, gpe.fun(0.0, psi)


def test_moments_are_sums_over_the_grid(state):
    gpe, psi, f = state
    found = moments(gpe.rows(psi), gpe.rows(f))
    n, image = np.abs(psi) ** 2, 1j * f
    sizes = np.abs(psi.real * image.real) + np.abs(psi.imag * image.imag)
    expected = (n.sum(), np.vdot(psi, image).real, np.vdot(f, f).real, (n**2).sum(), sizes.sum(), n.max())
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert total_mass(gpe.rows(psi)) == found.mass
    assert gpe.mass(psi) == gpe.grid.cell * found.mass


def test_energy_from_moments_is_that_of_the_modes(state):
    """By Parseval's theorem, and the local terms point by point."""
    gpe, psi, _ = state
    field = psi.reshape(gpe.grid.shape)
    local = np.sum((gpe.V + 10.0 * np.abs(field) ** 2) * np.abs(field) ** 2)
    expected = gpe.grid.cell * (np.vdot(field, by_numpy(gpe, field)).real + local)
    assert gpe.energy(psi) == pytest.approx(expected, rel=1e-13)


def test_shifted_field_and_its_sums(state):
    gpe, psi, f = state
    out = np.empty_like(psi)
    mass, square, slope = shifted(gpe.rows(psi), gpe.rows(f), 0.1, -0.02, gpe.rows(out))
    np.testing.assert_allclose(out, 1.1 * psi - 0.02j * f, rtol=0, atol=1e-14 * np.abs(f).max())
    d = out - psi
    assert mass == pytest.approx(np.vdot(out, out).real, rel=1e-13)
    assert square == pytest.approx(np.vdot(d, d).real, rel=1e-13)
    assert slope == pytest.approx(np.vdot(1j * f, d).real, rel=1e-12)
    np.testing.assert_allclose(expansion(*map(gpe.rows, (out, psi, f))), (square, slope), rtol=1e-13)


# Mass and energy as one.


@pytest.mark.parametrize("names", [("mass",), ("energy",), ("mass", "energy"), ("energy", "mass")], ids=str)
def test_joint_is_the_invariants_one_by_one(state, names):
    gpe, psi, f = state
    count, kept = len(names), gpe.invariants(names)
    values, gram, terms = np.empty(count), np.empty((count, count)), np.empty(count)
    joint = gpe.joint(names)
    joint.moments(0.0, psi, f, values, gram, terms)
    G = np.empty((count, psi.size), complex)
    for item, row in zip(kept, G, strict=True):
        item.grad(0.0, psi, f, row) if item.uses_f else item.grad(0.0, psi, row)
    reals = G.view(float)
    np.testing.assert_allclose(values, [item.fun(0.0, psi) for item in kept], rtol=1e-13)
    np.testing.assert_allclose(gram, reals @ reals.T, rtol=1e-12)
    np.testing.assert_allclose(terms, np.abs(reals * psi.view(float)).sum(axis=1), rtol=1e-12)
    for size in (1e-15, 1e-6):  # beside the state, and far from it
        mu = size * np.arange(1.0, 1.0 + count)
        out, moved = np.empty_like(psi), np.empty(count)
        joint.shift(0.0, psi, f, mu, out, moved)
        np.testing.assert_allclose(out, psi + mu @ G, rtol=0, atol=1e-14)
        exact = [{"mass": gpe.mass, "energy": gpe.energy}[name](out) for name in names]
        np.testing.assert_allclose(moved, exact, rtol=4e-15)


def test_joint_takes_mass_and_energy_only():
    gpe = GrossPitaevskii(Grid((8, 8), -1, 1))
    with pytest.raises(ValueError, match="unknown invariant 'angular_momentum'"):
        gpe.joint(["mass", "angular_momentum"])
    with pytest.raises(ValueError, match="must be 'mass', 'energy' or both"):
        gpe.joint(["mass", "mass"])
