"""Orbits in galpy's potentials against galpy's own integrators."""

import numpy as np
import pytest

galpy = pytest.importorskip("galpy", reason='needs galpy: pip install "eip_scipy[galpy]"')

from astropy import units as u  # noqa: E402
from galpy.orbit import Orbit  # noqa: E402
from galpy.potential import MWPotential2014, SoftenedNeedleBarPotential, evaluatePotentials  # noqa: E402

from eip_scipy.integrations.galpy import KNOWN_IN_C, _System, integrate  # noqa: E402

START = [1.0, 0.1, 1.1, 0.1, 0.05, 0.3]
BAR = MWPotential2014 + SoftenedNeedleBarPotential(amp=0.3, a=0.5, b=0.1, c=0.1, omegab=1.3)
TIMES = np.linspace(0, 40, 81)


@pytest.mark.parametrize("pattern_speed", [0.0, 1.3])
def test_orbits(pattern_speed):
    potential = BAR if pattern_speed else MWPotential2014
    truth, usual, ours = Orbit(START), Orbit(START), Orbit(START)
    truth.integrate(TIMES, potential, method="dop853_c", rtol=1e-14, atol=1e-14)
    usual.integrate(TIMES, potential, method="dop853_c", rtol=1e-8, atol=1e-8)
    integrate(ours, TIMES, potential, pattern_speed=pattern_speed)
    assert np.abs(ours.x(TIMES) - truth.x(TIMES)).max() < 1e-6
    assert np.abs(ours.vz(TIMES) - truth.vz(TIMES)).max() < 1e-6
    if pattern_speed:
        kept = [orbit.Jacobi(TIMES, OmegaP=pattern_speed, pot=potential) for orbit in (ours, usual)]
    else:
        kept = [orbit.E(TIMES) for orbit in (ours, usual)]
        assert np.ptp(ours.Lz(TIMES)) < 1e-13
    assert np.ptp(kept[0]) < 1e-12
    assert np.ptp(kept[1]) > 1e-8


def test_the_orbit_is_galpys():
    """Methods of an orbit work after the run: interpolation, radii, units; also without an azimuth, and backward."""
    ours, theirs = Orbit(START, ro=8.0, vo=220.0), Orbit(START, ro=8.0, vo=220.0)
    times = np.linspace(0, 1, 101) * u.Gyr
    integrate(ours, times, MWPotential2014)
    theirs.integrate(times, MWPotential2014, method="dop853_c")
    for orbit in (ours, theirs):
        assert orbit.R(0.123 * u.Gyr) == pytest.approx(theirs.R(0.123 * u.Gyr), rel=1e-6)
        assert orbit.rap() == pytest.approx(theirs.rap(), rel=1e-6)
    pair = Orbit([START[:5], [1.0, 0.2, 1.0, 0.1, 0.05]])
    integrate(pair, -TIMES, MWPotential2014)
    assert pair.orbit.shape == (2, 81, 5)
    assert np.ptp(pair.E(-TIMES), axis=-1).max() < 1e-12


def test_forces_of_python_are_those_of_c():
    rng = np.random.default_rng(2)
    system, again = _System(MWPotential2014), _System(MWPotential2014)
    assert again._derivative is not None or not galpy.__version__.startswith(KNOWN_IN_C)
    again._derivative = None
    for w in rng.uniform(-1, 1, size=(5, 6)):
        assert np.allclose(system(0.0, w), again(0.0, w), rtol=1e-13)
    assert system.energy(0.0, w) - w[3:] @ w[3:] / 2 == pytest.approx(
        evaluatePotentials(MWPotential2014, np.hypot(*w[:2]), w[2]), rel=1e-14
    )


def test_planar_orbits_are_refused():
    with pytest.raises(ValueError, match="orbit has 2 dimensions; expected 3"):
        integrate(Orbit([1.0, 0.1, 1.1, 0.0]), TIMES, MWPotential2014)
