"""Surfaces of equal density: against known surfaces, and the part of them around a vortex."""

import sys

import numpy as np
import pytest

from eip_scipy.problems.gross_pitaevskii import Grid, GrossPitaevskii, density_surface, harmonic_trap, imprint, vortices

pytest.importorskip("skimage")


def trap(shape=(32, 32, 24)):
    return GrossPitaevskii(Grid(shape, (-6, -6, -9), (6, 6, 9)), harmonic_trap(1, 1, 0.5), Omega=0.5, beta=200)


def test_an_ellipsoid():
    gpe = trap()
    x, y, z = gpe.grid.mesh()
    psi = np.exp(-(x**2 + y**2 + z**2 / 4) / 4)  # a density exp(-r^2 / 2)
    surface = density_surface(gpe, psi, np.exp(-2.0))
    a, b, c = surface.corners.reshape(-1, 3).T
    np.testing.assert_allclose(np.sqrt(a**2 + b**2 + c**2 / 4), 2.0, atol=0.01)
    assert not surface.inside.any()


def test_tubes_around_vortices():
    gpe = trap((48, 48, 32))
    places = np.array([[1.0, 0.3], [-1.1, 0.0]])
    psi = imprint(gpe, places)
    surface = density_surface(gpe, psi, 0.1 * np.abs(psi).max() ** 2)
    middle = surface.corners.mean(axis=1)
    tubes = middle[surface.inside & (np.abs(middle[:, 2]) < 2)]
    away = np.hypot(*(tubes[:, None, :2] - places).transpose(2, 0, 1))
    assert away.min(axis=1).max() < 0.5
    assert set(away.argmin(axis=1)) == {0, 1}
    # The outside is farther out than the vortices, except for their mouths at the ends.
    outside = middle[~surface.inside & (np.abs(middle[:, 2]) < 2)]
    assert np.hypot(*outside[:, :2].T).min() > 2
    assert len(vortices(gpe, psi).charges) == 2


@pytest.mark.parametrize(
    ("gpe", "level", "message"),
    [
        (GrossPitaevskii(Grid((8, 8), -1, 1)), 0.5, "needs three dimensions"),
        (trap((8, 8, 8)), 2.0, "between 0 and the largest density 1, got 2.0"),
        (trap((8, 8, 8)), 0.0, "between 0 and the largest density 1, got 0.0"),
    ],
)
def test_wrong_arguments(gpe, level, message):
    psi = np.zeros(gpe.grid.shape)
    psi.flat[gpe.grid.size // 2] = 1.0
    with pytest.raises(ValueError, match=message):
        density_surface(gpe, psi, level)


def test_without_scikit_image(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(ImportError, match=r"need scikit-image: pip install \"eip_scipy\[surfaces\]\""):
        density_surface(trap((8, 8, 8)), np.exp(-sum(a**2 for a in trap((8, 8, 8)).grid.mesh())), 0.1)
