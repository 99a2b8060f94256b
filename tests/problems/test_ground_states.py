"""Ground states against published energies and a radial solution, how the search ends, and the counting of vortices."""

import numpy as np
import pytest
from scipy.integrate import simpson, solve_bvp

from eip_scipy import EIPRK4, Diagnostics, integrate
from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap, quartic_trap
from eip_scipy.problems.gross_pitaevskii import (
    ground_state,
    imprint,
    lowest_ring,
    lowest_state,
    polygon,
    ring_start,
    thomas_fermi,
    vortex_starts,
    vortices,
)
from eip_scipy.problems.gross_pitaevskii.ground_state import _least_energy


def trap(Omega=0.0, points=64, half=8.0, beta=100.0):
    return GrossPitaevskii(Grid((points, points), -half, half), harmonic_trap(1, 1), Omega=Omega, beta=beta)


# The states.


def radial_energy(beta):
    """Return the energy of the vortex-free state of V = r^2 / 2, from its radial equation as a boundary value problem.

    With the norm N(r) as third component: u'' + u'/r = 2 (r^2 / 2 + beta u^2 - mu) u, N' = 2 pi r u^2.
    """

    def rhs(r, y, p):
        u, du, _ = y
        return np.array([du, 2 * (0.5 * r**2 + beta * u**2 - p[0]) * u, 2 * np.pi * r * u**2])

    def ends(a, b, p):
        return np.array([a[1], a[2], b[0], b[2] - 1])

    r = np.linspace(0, 8, 401)
    u = np.exp(-(r**2) / 12) / np.sqrt(6 * np.pi)
    guess = np.array([u, -r / 6 * u, 1 - np.exp(-(r**2) / 6)])
    singular = np.diag([0.0, -1.0, 0.0])  # -u'/r
    sol = solve_bvp(rhs, ends, r, guess, p=[5.7], S=singular, tol=1e-9, max_nodes=20_000)
    assert sol.success
    r = np.linspace(0, 8, 20_001)
    u = sol.sol(r)[0]
    return sol.p[0] - 0.5 * beta * simpson(2 * np.pi * r * u**4, x=r)


def test_without_rotation_it_is_the_radial_solution():
    gpe = trap()
    state = ground_state(gpe, np.sqrt(thomas_fermi(gpe)))
    assert state.converged
    assert state.residual <= 1e-8
    assert state.energy == pytest.approx(radial_energy(100.0), abs=1e-8)
    assert state.energy == pytest.approx(3.9459469, abs=1e-5)  # published
    assert gpe.mass(state.psi) == pytest.approx(1, abs=1e-14)
    assert gpe.chemical_potential(state.psi) == pytest.approx(state.mu, abs=1e-12)
    residual = gpe.hamiltonian(state.psi) - state.mu * state.psi
    assert np.sqrt(gpe.mass(residual)) == pytest.approx(state.residual, rel=1e-3)


@pytest.mark.needs_jit
@pytest.mark.slow
@pytest.mark.parametrize(
    ("Omega", "published", "count"),
    [
        (0.65, 3.6506129, 3),
        pytest.param(0.71, 3.4997148, 4, marks=pytest.mark.nightly),
        pytest.param(0.76, 3.3475310, 5, marks=pytest.mark.nightly),
    ],
)
def test_published_energies_and_their_vortices(Omega, published, count):
    gpe = trap(Omega)
    states = lowest_state(gpe, vortex_starts(gpe, 4), tol=1e-5)
    best = min(states, key=lambda s: s.energy)
    assert best.energy == pytest.approx(published, abs=1e-5)
    assert (vortices(gpe, best.psi).charges == 1).all()
    assert len(vortices(gpe, best.psi).charges) == count


@pytest.mark.needs_jit
def test_soliton_is_the_ground_state_of_attraction():
    """sech(x) / sqrt(2) of mass 1 for beta = -2: E = -1/6, mu = -1/2; a constant V adds itself."""
    gpe = GrossPitaevskii(Grid(256, -20, 20), np.full(256, 7.0), beta=-2.0)
    x = gpe.grid.points(0)
    state = ground_state(gpe, np.exp(-((x - 0.3) ** 2) / 4))
    assert state.converged
    assert (state.energy - 7, state.mu - 7) == (pytest.approx(-1 / 6, abs=1e-9), pytest.approx(-1 / 2, abs=1e-9))


def test_a_stalled_or_short_search_says_so():
    gpe = trap(points=32)
    start = np.sqrt(thomas_fermi(gpe))
    short = ground_state(gpe, start, max_iterations=2)
    assert (short.converged, short.iterations, short.message) == (False, 2, "not converged in 2 iterations")
    seen = []
    stopped = ground_state(
        gpe, start, progress=lambda i, energy, residual: seen.append((i, energy, residual)) or i == 3
    )
    assert (stopped.converged, stopped.message, len(seen)) == (False, "stopped by progress", 4)
    assert seen[-1][1] == pytest.approx(stopped.energy, rel=1e-12)
    assert seen[-1][2] == stopped.residual
    energies = [energy for _, energy, _ in seen]
    assert energies == sorted(energies, reverse=True)
    endless = ground_state(gpe, start, tol=1e-300, max_iterations=400)
    assert not endless.converged
    assert endless.residual < 1e-11
    assert "GroundState(energy=3.94" in repr(endless)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tol": 0}, "tol must be > 0"),
        ({"tol": float("nan")}, "tol must be > 0"),
        ({"max_iterations": 0}, "max_iterations an integer >= 1"),
        ({"max_iterations": 1.5}, "max_iterations an integer >= 1"),
        ({"start": np.zeros((16, 16))}, "its mass is 0.0"),
        ({"start": np.full((16, 16), np.nan)}, "its mass is nan"),
        ({"start": np.ones((4, 4))}, r"psi has shape \(4, 4\)"),
    ],
)
def test_bad_searches(options, message):
    gpe = trap(points=16)
    arguments = {"start": np.ones((16, 16)), **options}
    with pytest.raises(ValueError, match=message):
        ground_state(gpe, **arguments)


def test_line_search_finds_the_least_point_of_the_curve():
    rng = np.random.default_rng(3)
    angles = np.linspace(-np.pi / 2, np.pi / 2, 200_001)
    c, s = np.cos(angles), np.sin(angles)
    for _ in range(20):
        e = tuple(rng.standard_normal(5))
        values = sum(a * c ** (4 - k) * s**k for k, a in enumerate(e))
        t = np.arctan(_least_energy(e))
        ours = sum(a * np.cos(t) ** (4 - k) * np.sin(t) ** k for k, a in enumerate(e))
        assert ours <= values.min() + 1e-12


# Starts.


def test_thomas_fermi_density():
    """In V = r^2 / 2 its radius is (4 beta / pi)^(1/4), and mu = R^2 / 2."""
    gpe = trap(points=256)
    density = thomas_fermi(gpe)
    assert gpe.grid.cell * density.sum() == pytest.approx(1, abs=1e-10)
    R = (4 * 100 / np.pi) ** 0.25
    x, y = gpe.grid.mesh()
    np.testing.assert_allclose(density, np.maximum(R**2 - x**2 - y**2, 0) / 200, atol=2e-5)
    with pytest.raises(ValueError, match="does not fit into the box"):
        thomas_fermi(trap(half=2.0))
    with pytest.raises(ValueError, match="does not fit into the box"):
        thomas_fermi(trap(Omega=1.5))
    with pytest.raises(ValueError, match="needs beta > 0"):
        thomas_fermi(trap(beta=0.0))


def test_starts_differ_and_repeat_with_their_seed():
    gpe = trap(0.8)
    first, second = vortex_starts(gpe, 2, seed=5)
    np.testing.assert_array_equal(first, next(vortex_starts(gpe, 1, seed=5)))
    assert np.abs(first - second).max() > 0.01
    assert all(len(vortices(gpe, psi, threshold=0.1).charges) >= 2 for psi in (first, second))


@pytest.mark.needs_jit
def test_ring_search_wants_a_hole():
    with pytest.raises(ValueError, match="has no hole with a radius above 4 grid spacings; use lowest_state"):
        lowest_ring(trap(0.5))


@pytest.mark.nightly
@pytest.mark.needs_jit
@pytest.mark.slow
def test_small_ring_search_ends_below_all_its_neighbours():
    gpe = GrossPitaevskii(Grid((96, 96), -6, 6), quartic_trap(1.2, 0.6, 1, 1), Omega=2.5, beta=300)
    tried = {}
    state = lowest_ring(gpe, tol=1e-4, report=lambda n, w, energy: tried.update({(n, w): energy}))
    assert state.converged
    n, w = min(tried, key=tried.get)
    assert {(n + 1, w), (n - 1, w), (n, w + 1), (n, w - 1)} <= tried.keys()
    assert state.energy <= tried[n, w] + 1e-9
    assert len(vortices(gpe, state.psi).charges) == n


# Vortices.


@pytest.mark.parametrize("Omega", [0.5, -0.5])
def test_imprinted_vortices_are_found_where_they_are(Omega):
    gpe = trap(Omega, points=96)
    places = polygon(5, 1.7) + [0.11, -0.07]
    psi = imprint(gpe, places)
    if Omega < 0:
        psi = psi.conj()
    found = vortices(gpe, psi)
    assert found.charges.tolist() == [1 if Omega > 0 else -1] * 5
    for place in places:
        assert np.min(np.hypot(*(found.positions - place).T)) < 0.02


def test_phantom_vortices_outside_the_condensate_do_not_count():
    gpe = trap(points=96)
    psi = imprint(gpe, [[0.0, 0.0], [5.5, 0.0]])  # the second far outside
    assert len(vortices(gpe, psi + 1e-6).charges) == 1
    assert len(vortices(gpe, imprint(gpe, np.zeros((0, 2)))).charges) == 0


def test_a_core_finer_or_coarser_resolved_counts_once():
    for points in (48, 200):
        gpe = trap(0.5, points=points)
        assert len(vortices(gpe, imprint(gpe, [[0.013, 0.02]])).charges) == 1


def test_fast_rotation_needs_its_own_frame_to_be_counted():
    """At Omega r = 24 the phase turns by 2.3 between two points; near a vortex by more than pi."""
    gpe = GrossPitaevskii(Grid((210, 210), -10, 10), quartic_trap(1.2, 0.3, 1, 1), Omega=3.5, beta=1000)
    psi = ring_start(gpe, 38, 123)
    assert len(vortices(gpe, psi).charges) == 38
    assert len(vortices(gpe, psi, Omega=0).charges) != 38


def test_lines_in_three_dimensions_are_counted_in_a_plane():
    gpe = GrossPitaevskii(Grid((32, 32, 16), (-6, -6, -9), (6, 6, 9)), harmonic_trap(1, 1, 0.5), Omega=0.5, beta=200)
    psi = imprint(gpe, [[1.0, 0.2], [-1.0, 0.1]])
    assert len(vortices(gpe, psi).charges) == 2
    assert len(vortices(gpe, psi, plane=0).charges) == 0  # beyond the condensate's end


def test_vortices_of_nothing():
    with pytest.raises(ValueError, match="psi is zero"):
        vortices(trap(), np.zeros(64 * 64))
    with pytest.raises(ValueError, match="two or three dimensions"):
        vortices(GrossPitaevskii(Grid(8, 0, 1)), np.ones(8))


# As a start of dynamics.


@pytest.mark.needs_jit
def test_a_ground_state_stands_still_with_rank_one():
    """H psi = mu psi: both gradients are parallel, and nothing happens but the phase."""
    gpe = trap(0.4, points=32, half=7.0)
    state = ground_state(gpe, np.sqrt(thomas_fermi(gpe)), tol=1e-10)
    p = gpe.problem(state.psi, 0.25)
    diagnostics = Diagnostics()
    run = integrate(p, method=EIPRK4, h=0.0025, diagnostics=diagnostics)
    assert run.success
    assert np.isfinite(run.y).all()
    assert diagnostics.n_rank_reduced == diagnostics.n_projections > 0
    expected = state.psi.ravel() * np.exp(-1j * state.mu * 0.25)
    assert np.abs(run.y[:, -1] - expected).max() < 1e-7 * np.abs(expected).max()
    assert run.max_defect.max() < 1e-14
