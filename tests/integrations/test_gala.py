"""Orbits in gala's potentials against gala's own integrators."""

import numpy as np
import pytest

gala = pytest.importorskip("gala", reason='needs gala: pip install "eip_scipy[gala]"')

from astropy import units as u  # noqa: E402
from gala import potential as gp  # noqa: E402
from gala.dynamics import PhaseSpacePosition  # noqa: E402
from gala.integrate import DOPRI853Integrator  # noqa: E402
from gala.potential.common import PotentialParameter  # noqa: E402
from gala.units import dimensionless, galactic  # noqa: E402

from eip_scipy.integrations.gala import integrate_orbit  # noqa: E402

W = np.array([8.0, 0.0, 0.5, 0.03, 0.2, 0.05])
DISK = gp.MiyamotoNagaiPotential(m=6e10, a=3, b=0.3, units=galactic)
HALO = gp.CCompositePotential(disk=DISK, halo=gp.NFWPotential(m=6e11, r_s=15, units=galactic))
BAR = gp.LongMuraliBarPotential(m=1e10, a=4, b=0.5, c=0.3, alpha=0.3, units=galactic)
BAR = gp.CCompositePotential(disk=DISK, bar=BAR)
SPEED = [0, 0, -40] * u.km / u.s / u.kpc
TIMES = {"dt": 5.0, "n_steps": 400}


class Ring(gp.PotentialBase):
    """A harmonic potential in Python, in two dimensions."""

    k = PotentialParameter("k", physical_type=None)
    ndim = 2

    def _energy(self, q, t=0.0):
        return 0.5 * self.parameters["k"] * (q**2).sum(axis=1)

    def _gradient(self, q, t=0.0):
        return self.parameters["k"] * q


@pytest.mark.parametrize(
    ("hamiltonian", "turns"),
    [
        (HALO, True),
        (gp.Hamiltonian(HALO, gp.ConstantRotatingFrame([10, 0, 40] * u.km / u.s / u.kpc, units=galactic)), False),
        (gp.Hamiltonian(BAR, gp.ConstantRotatingFrame(SPEED, units=galactic)), False),
    ],
)
def test_orbits(hamiltonian, turns):
    """In each frame: gala's orbit at tight tolerances, its energy, and the angular momentum where it is kept."""
    h = gp.Hamiltonian(hamiltonian)
    w0 = PhaseSpacePosition.from_w(np.stack([W, 1.1 * W], axis=-1), galactic)
    orbits = integrate_orbit(h, w0, **TIMES)
    assert orbits.shape == (401, 2)
    truth = h.integrate_orbit(
        w0, Integrator=DOPRI853Integrator, Integrator_kwargs={"rtol": 1e-13, "atol": 1e-13}, **TIMES
    )
    assert np.abs((orbits.xyz - truth.xyz).to_value(u.kpc)).max() < 1e-5
    usual = h.integrate_orbit(w0, Integrator=DOPRI853Integrator, **TIMES)

    def spread(found):
        w = found.w(galactic)
        energies = [h._energy(np.ascontiguousarray(w[:, :, k].T), np.zeros(1)) for k in range(2)]
        return np.abs(np.ptp(energies, axis=1) / np.mean(energies, axis=1)).max()

    assert spread(orbits) < 1e-11
    assert spread(usual) > 1e-9
    if turns:
        assert np.ptp(orbits.angular_momentum()[2], axis=0).value.max() < 1e-13


def test_potentials_in_python_and_options():
    """A harmonic potential in two dimensions: the closed form, back in time, from an array."""
    potential = Ring(k=4.0, units=dimensionless)
    orbit = integrate_orbit(potential, [1.0, 0.0, 0.0, 1.0], t=np.linspace(0, -3, 7), options={"h": 0.01})
    t = orbit.t.value
    assert np.abs(orbit.xyz.value - [np.cos(2 * t), np.sin(2 * t) / 2]).max() < 1e-12
    with np.errstate(all="ignore"), pytest.raises(RuntimeError, match="orbit 0: "):
        integrate_orbit(
            potential, [1.0, 0.0, 0.0, 1.0], t=np.linspace(0, 1e5, 3), options={"h": 10.0, "invariants": ()}
        )
