"""What the commands `eip-scipy gpe` are made of: ground states, vortices, splittings."""

import numpy as np
import pytest
from orders import observed_order

from eip_scipy import EIPDOP853, eip_method, integrate
from eip_scipy.problems import Grid, GrossPitaevskii
from eip_scipy_studies.condensates.ground_state import ground_state, imprint, polygon, ring_start, thomas_fermi
from eip_scipy_studies.condensates.problems import harmonic_trap, quartic_trap
from eip_scipy_studies.condensates.splitting import Splitting
from eip_scipy_studies.condensates.vortices import vortices

pytestmark = pytest.mark.needs_jit


def trap(Omega=0.0, points=64, half=8.0):
    return GrossPitaevskii(Grid((points, points), -half, half), harmonic_trap(1, 1), Omega=Omega, beta=100.0)


def test_ground_state_without_rotation_and_thomas_fermi_density():
    """In V = r^2 / 2 the density's radius is (4 beta / pi)^(1/4), and mu = R^2 / 2.

    The energy is that of u'' + u'/r = 2 (r^2 / 2 + beta u^2 - mu) u, by SciPy's `solve_bvp` at a tolerance of 1e-9.
    """
    gpe = trap()
    state = ground_state(gpe, np.sqrt(thomas_fermi(gpe)))
    assert state.converged
    assert state.residual <= 1e-8
    assert state.energy == pytest.approx(3.945944195, abs=1e-8)
    assert gpe.mass(state.psi) == pytest.approx(1, abs=1e-14)
    residual = 1j * gpe.fun(0.0, state.psi) - state.mu * state.psi
    assert np.sqrt(gpe.mass(residual)) == pytest.approx(state.residual, rel=1e-3)
    gpe = trap(points=256)
    R2, (x, y) = (4 * 100 / np.pi) ** 0.5, gpe.grid.mesh()
    np.testing.assert_allclose(thomas_fermi(gpe), np.maximum(R2 - x**2 - y**2, 0) / 200, atol=2e-5)
    with pytest.raises(ValueError, match="does not fit into the box"):
        thomas_fermi(trap(half=2.0))


def test_vortices_are_found_where_they_are():
    """In the fast ring the phase turns by 2.3 between two points at Omega r = 24; near a vortex by more than pi."""
    places = polygon(5, 1.7) + [0.11, -0.07]
    for Omega, charge in ((0.5, 1), (-0.5, -1)):
        gpe = trap(Omega, points=96)
        psi = imprint(gpe, [*places, [5.5, 0.0]])  # the last one far outside
        found = vortices(gpe, psi + 1e-6 if charge > 0 else psi.conj())
        assert found.charges.tolist() == [charge] * 5
        assert all(np.hypot(*(found.positions - place).T).min() < 0.02 for place in places)
    gpe = GrossPitaevskii(Grid((210, 210), -10, 10), quartic_trap(1.2, 0.3, 1, 1), Omega=3.5, beta=1000)
    assert len(vortices(gpe, ring_start(gpe, 38, 123)).charges) == 38


@pytest.mark.parametrize(("scheme", "steps"), [("strang", (0.025, 0.0125)), ("rkn6", (0.05, 0.025))])
def test_splittings_of_a_rotating_condensate(scheme, steps):
    """The error has at least the order of the method, and a step back undoes a step."""
    grid = Grid((96, 96), -8, 8)
    gpe = GrossPitaevskii(grid, harmonic_trap(1, 1), Omega=0.6, beta=20.0)
    x, y = grid.mesh()
    psi = (x - 0.7 + 1j * y) * (x + 1j * (y - 0.5)) * np.exp(-(x**2 + y**2) / 2)
    problem = gpe.problem(psi / np.sqrt(gpe.mass(psi)), 0.5)
    exact = integrate(problem, method=EIPDOP853, h=0.005, invariants=()).y[:, -1]
    method = Splitting(gpe, scheme)
    runs = [integrate(problem, method=eip_method(method), h=h) for h in steps]
    errors = [np.sqrt(gpe.mass(run.y[:, -1] - exact)) for run in runs]
    assert observed_order(errors, steps)[0] > method.order - 0.25
    assert errors[-1] < 2e-3
    there = method.one_step(0.0, problem.y0.copy(), 0.05).copy()
    np.testing.assert_allclose(method.one_step(0.05, there, -0.05), problem.y0, atol=1e-12)
