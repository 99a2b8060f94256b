"""The methods to compare with: their orders, against closed forms, and what each keeps."""

import math

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from systems import pericentre

from eip_scipy.problems import Grid, GrossPitaevskii
from eip_scipy_studies import comparators as schemes
from eip_scipy_studies.condensates.problems import plane_wave, rotating_packet, soliton

SCHEMES = (schemes.crank_nicolson, schemes.linearly_implicit, schemes.sav_crank_nicolson)
ORBIT, Y0 = pericentre(0.5), np.array([0.5, 1.0, 0.2, 0.3, -0.1, 0.25])
OTHER = {"form": "drift-kick-drift"}
kepler = njit(lambda t, q: -q / (q[0] ** 2 + q[1] ** 2) ** 1.5)
scaled = njit(lambda t, q, params: -params[0] * q)


@njit
def crossed(t, x, out, params):
    """Write E = params[0] e_y and B = params[1] e_z."""
    out[:] = 0.0
    out[1], out[5] = params


@njit
def oscillator(t, y, out):
    out[0], out[1] = y[1], -y[0]


@njit
def driven(t, y, out, params):
    out[0] = params[0] * math.cos(params[0] * t)


def gyrated(t, omega):
    c, s = math.cos(omega * t), math.sin(omega * t)
    v = np.array([c * Y0[3] + s * Y0[4], -s * Y0[3] + c * Y0[4], Y0[5]])
    x = Y0[:3] + np.array([(s * Y0[3] + (1 - c) * Y0[4]) / omega, ((c - 1) * Y0[3] + s * Y0[4]) / omega, Y0[5] * t])
    return np.concatenate([x, v])


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    ("method", "fun", "t_end", "y0", "exact", "n", "options"),
    [
        (schemes.stormer_verlet, kepler, 2 * np.pi, ORBIT, ORBIT, 4000, {}),
        (schemes.stormer_verlet, kepler, 2 * np.pi, ORBIT, ORBIT, 4000, OTHER),
        (schemes.stormer_verlet, scaled, 10.0, [1.0, 0.0], [math.cos(30), -3 * math.sin(30)], 4000, {"params": [9.0]}),
        (schemes.boris, crossed, 5.0, Y0, gyrated(5.0, -3.0), 1000, {"mass": 2.0, "charge": -3.0, "params": [0, 2]}),
        (schemes.implicit_midpoint, oscillator, 10.0, [1.0, 0.0], [math.cos(10), -math.sin(10)], 100, {}),
        (schemes.implicit_midpoint, driven, 3.0, [0.0], [math.sin(6.0)], 1000, {"params": [2.0]}),
    ],
)
def test_order_two_reversible_and_the_same_bits_interpreted(method, fun, t_end, y0, exact, n, options):
    runs = [method(fun, (0.0, t_end), y0, t_end / k, **options) for k in (n, 2 * n)]
    coarse, fine = (np.linalg.norm(run.y[:, -1] - exact) for run in runs)
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.03)
    compiled, interpreted = (
        method(f, (0.3, 5.0), y0, 0.07, save_every=3, **options) for f in (fun, lambda *args: fun(*args))
    )
    assert (compiled.message, interpreted.message) == ("compiled", "interpreted")
    np.testing.assert_array_equal(compiled.t, interpreted.t)
    np.testing.assert_array_equal(compiled.y, interpreted.y)
    assert compiled.nfev == interpreted.nfev
    np.testing.assert_allclose(compiled.t[:-1], 0.3 + 0.21 * np.arange(compiled.t.size - 1))
    if method is not schemes.implicit_midpoint:  # reversible to round-off, if the last step is not shorter
        back = method(fun, (t_end, 0.0), runs[0].y[:, -1], t_end / n, **options)
        np.testing.assert_allclose(back.y[:, -1], y0, rtol=0, atol=1e-11)


def modulated(shape=(16, 16), beta=1.0):
    """Return a plane wave with bumps in a lattice, which is not a stationary state, on a box of sides 2 pi."""
    lattice = lambda *axes: 1.5 + sum(np.cos(a) for a in axes)  # noqa: E731
    gpe = GrossPitaevskii(Grid(shape, 0, 2 * np.pi), lattice, beta=beta)
    axes = gpe.grid.mesh()
    return gpe, (np.exp(1j * sum(axes)) * (1 + 0.25 * sum(np.cos(a + k) for k, a in enumerate(axes)))).ravel()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_two_of_fields(scheme):
    ring, packet = soliton(), rotating_packet(0.9, points=32)
    cases = [(ring.equation, ring.y0, 1.0, 1e-2), (*modulated(), 0.5, 5e-3)]
    if scheme is not schemes.sav_crank_nicolson:
        cases.append((packet.equation, packet.y0, 0.1, 1e-3))
    for gpe, psi, t_end, h in cases:
        fine = solve_ivp(gpe.fun, (0, t_end), psi, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        errors = [abs(scheme(gpe, (0, t_end), psi, step).y[:, -1] - fine).max() for step in (h, h / 2)]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)
    wave = plane_wave((8, 8))
    run = scheme(wave.equation, (0.5, 1.505), wave.reference(0.5), 0.01, save_every=30)
    np.testing.assert_allclose(run.t, [0.5, 0.8, 1.1, 1.4, 1.505], rtol=0, atol=1e-14)
    assert max(abs(y - wave.reference(t)).max() for t, y in zip(run.t, run.y.T, strict=True)) < 1e-3


def test_invariants_of_the_schemes():
    gpe, psi0 = modulated()
    free, changes = GrossPitaevskii(gpe.grid, gpe.V), {}
    for scheme in SCHEMES:
        run = scheme(gpe, (0, 2), psi0, 0.01, save_every=1)
        values = [np.array([value(psi) for psi in run.y.T]) for value in (gpe.mass, gpe.energy)]
        changes[scheme] = [np.abs(value / value[0] - 1).max() for value in values]
        if scheme is schemes.linearly_implicit:
            quadratic, density = np.array([free.energy(psi) for psi in run.y.T]), abs(run.y) ** 2
            mixed = gpe.grid.cell * np.sum(density[:, 1:] * density[:, :-1], axis=0)
            assert np.ptp(0.5 * (quadratic[1:] + quadratic[:-1]) + 0.5 * gpe.beta * mixed) < 1e-8
    assert changes[schemes.crank_nicolson][0] < 1e-9 > changes[schemes.crank_nicolson][1]
    assert changes[schemes.linearly_implicit][0] < 1e-9 < 1e-7 < changes[schemes.linearly_implicit][1]
    assert run.modified_energy[0] == pytest.approx(values[1][0], rel=1e-14)
    assert np.ptp(run.modified_energy) < 1e-12 * values[1][0]
    assert changes[schemes.sav_crank_nicolson][1] > 1e-7
    assert run.nfev == 201  # the first step twice
