"""Condensates and waves with damping: rates against sums and closed forms, and the gain by their balances."""

import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, Balance, eip_method, integrate
from eip_scipy.methods.runge_kutta import RK4
from eip_scipy.problems import (
    DampedGrossPitaevskii,
    Grid,
    GrossPitaevskii,
    KortewegDeVries,
    Lawson,
    SineGordon,
    harmonic_trap,
)

ALL = ("mass", "energy", "momentum_x", "momentum_y", "angular_momentum")


def lossy(x, y):
    return 0.02 * np.exp(-((x - 1) ** 2) - y**2)


def condensate(**options):
    given = {"Omega": 0.3, "beta": 8.0, "damping": 0.03, "chemical_potential": 1.7, "loss": lossy} | options
    return DampedGrossPitaevskii(Grid((24, 20), (-6, -5), (6, 5)), harmonic_trap(1, 1.3), **given)


def packet(equation):
    x, y = equation.grid.mesh()
    return np.exp(-((x - 0.6) ** 2) / 2 - y**2 / 1.5 + 0.7j * x - 0.2j * y)


def test_the_equation_is_the_one_without_damping_and_what_is_said():
    equation = condensate()
    plain = GrossPitaevskii(equation.grid, equation.V, Omega=0.3, beta=8.0)
    psi = packet(equation)
    H = plain.hamiltonian(psi)
    loss = np.broadcast_to(lossy(*equation.grid.mesh()), psi.shape)
    expected = -(1j + 0.03) * (H - 1.7 * psi) - 0.5 * loss * psi
    np.testing.assert_allclose(equation.fun(0.0, psi.ravel()), expected.ravel(), rtol=0, atol=1e-13)
    assert equation.energy(psi) == pytest.approx(plain.energy(psi), rel=1e-15)
    np.testing.assert_array_equal(equation.changed(beta=8.0).fun(0.0, psi.ravel()), equation.fun(0.0, psi.ravel()))
    assert "damping=0.03" in repr(equation)


@pytest.mark.parametrize("name", ALL)
def test_rates_are_derivatives_along_the_flow(name):
    """Rates agree with differences of the values along psi_t and those of its derivatives that matter at 1e-9."""
    equation = condensate()
    y = packet(equation).ravel()
    (item,) = equation.invariants(name)
    assert isinstance(item, Balance)
    f = equation.fun(0.0, y)
    rate = item.rate(0.0, y, f)
    G = np.empty_like(y)
    item.grad(0.0, y, f, G)
    # The trap has neither momentum nor angular momentum; their rates are those of damping and losses alone.
    (free,) = GrossPitaevskii(equation.grid, equation.V, Omega=0.3, beta=8.0).invariants(name)
    step = 1e-4
    damped = f + 1j * (equation.hamiltonian(y).ravel() - 1.7 * y)
    ends = [free.fun(0.0, y + k * step * damped) for k in (-2, -1, 1, 2)]
    slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
    assert rate == pytest.approx(slope, rel=1e-8)
    assert np.vdot(G, damped).real == pytest.approx(rate, rel=1e-9)


@pytest.mark.parametrize(("damping", "loss"), [(0.0, 0.05), (0.02, 0.0), (0.01, 0.02)])
def test_a_plane_wave(damping, loss):
    """The density n follows Bernoulli's equation n' = -a n - b n^2, and the phase the integral of k^2 / 2 - mu + n."""
    mu, beta, k, n0, t = 0.4, 1.5, 2 * np.pi / 8, 0.8, 3.0
    equation = DampedGrossPitaevskii(Grid(16, 0, 8), beta=beta, damping=damping, chemical_potential=mu, loss=loss)
    x = equation.grid.points(0)
    run = integrate(equation.problem(np.sqrt(n0) * np.exp(1j * k * x), t, 0.01), method=EIPDOP853)
    assert run.trusted
    a, b = 2 * damping * (k * k / 2 - mu) + loss, 2 * damping * beta
    decay = -np.expm1(-a * t) / a
    n = n0 * np.exp(-a * t) / (1 + b * n0 * decay)
    filled = np.log1p(b * n0 * decay) / b if b else n0 * decay
    phase = (k * k / 2 - mu) * t + beta * filled
    np.testing.assert_allclose(run.y[:, -1], np.sqrt(n) * np.exp(1j * (k * x - phase)), rtol=0, atol=1e-13)


@pytest.mark.nightly
@pytest.mark.slow
def test_balances_of_a_condensate_help():
    grid = Grid(32, -7, 7)
    equation = DampedGrossPitaevskii(grid, harmonic_trap(1), beta=10.0, damping=1e-4, chemical_potential=3.0, loss=1e-4)
    psi = np.exp(-((grid.points(0) - 1) ** 2) / 4)
    psi /= np.sqrt(equation.mass(psi))
    problem = equation.problem(psi, 60.0, 0.85 * equation.largest_step(psi))
    exact = solve_ivp(problem.fun, problem.t_span, problem.y0, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    runs = [integrate(problem, method=EIPRK4, invariants=kept) for kept in ((), problem.invariants)]
    assert runs[1].trusted
    assert runs[0].nfev == runs[1].nfev
    plain, kept = (np.linalg.norm(run.y[:, -1] - exact) for run in runs)
    assert 1.3 * kept < plain


def test_a_damped_condensate_pickles_and_refuses():
    problem = pickle.loads(pickle.dumps(condensate().problem(packet(condensate()), 0.1, 0.01)))
    assert [item.name for item in problem.invariants] == ["mass", "energy"]
    assert problem.method is None
    for options, match in (
        ({"damping": -0.1}, "damping must be a finite number >= 0"),
        ({"chemical_potential": np.inf}, "chemical_potential must be a finite number"),
        ({"loss": np.ones(3)}, "loss has shape"),
    ):
        with pytest.raises(ValueError, match=match):
            condensate(**options)


def sine_gordon(damping=0.05):
    equation = SineGordon(Grid((16, 12), (0, 0), (5, 4)), damping)
    x, y = equation.grid.mesh()
    q = 0.3 * np.cos(2 * np.pi * x / 5) + 0.1 * np.sin(2 * np.pi * (x / 5 + y / 4))
    return equation, np.concatenate([q.ravel(), (0.2 * np.sin(2 * np.pi * (x / 5 - y / 4))).ravel()])


def test_damped_waves():
    equation, y = sine_gordon()
    plain, n = SineGordon(equation.grid), equation.grid.size
    f = plain.fun(0.0, y)
    f[n:] -= 0.05 * y[n:]
    np.testing.assert_array_equal(equation.fun(0.0, y), f)
    energy, along_x, along_y = equation.invariants(("energy", "momentum_x", "momentum_y"))
    assert energy.rate(0.0, y, f) == pytest.approx(-0.05 * equation.grid.cell * (y[n:] @ y[n:]), rel=1e-14)
    for item, momentum in zip((along_x, along_y), plain.momentum(y), strict=True):
        assert item.rate(0.0, y, f) == pytest.approx(-0.05 * momentum, rel=1e-12)
    problem = equation.problem(y[:n], y[n:], 40.0, 0.3)
    exact = solve_ivp(problem.fun, problem.t_span, problem.y0, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    run = integrate(problem)  # by DOP853
    assert run.trusted
    np.testing.assert_allclose(run.y[:, -1], exact, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="damping must be a finite number >= 0"):
        SineGordon(equation.grid, -1.0)


def test_a_uniform_wave_is_a_damped_pendulum():
    """The energy of a damped pendulum decays; small ones by exp(-damping t) on average, as in the linear equation."""
    equation = SineGordon(Grid(8, 0, 1), 0.02)
    problem = equation.problem(np.full(8, 1e-6), np.zeros(8), 20.0, 0.05)
    omega = np.sqrt(1 - 0.01**2)
    expected = 1e-6 * np.exp(-0.2) * (np.cos(20 * omega) + 0.01 / omega * np.sin(20 * omega))
    np.testing.assert_allclose(integrate(problem, method=EIPDOP853).y[:8, -1], expected, rtol=1e-9)


DAMPING = 1e-2


def soliton(damping=DAMPING):
    """Return the equation on a ring of length 32, and a soliton of speed 1."""
    equation = KortewegDeVries(Grid(64, -16, 16), damping)
    return equation, 0.5 / np.cosh(equation.grid.points(0) / 2) ** 2


def written_again(t, u):
    """Return -6 u u_x - u_xxx - damping u at the points, by NumPy."""
    k = 2j * np.pi * np.fft.rfftfreq(64, 0.5)
    return np.fft.irfft(-3 * k * np.fft.rfft(u * u) - k**3 * np.fft.rfft(u)) - DAMPING * u


def test_damped_korteweg_de_vries_against_scipy():
    equation, start = soliton()
    problem = equation.problem(start, 20.0)
    exact = solve_ivp(written_again, (0, 20), problem.y0, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    step = eip_method(Lawson(equation, RK4))
    plain = integrate(problem, method=step, h=0.04, invariants=())
    kept = integrate(problem, method=step, h=0.04)
    assert kept.trusted
    errors = [np.linalg.norm(run.y[:, -1] - exact) for run in (plain, kept)]
    assert 2 * errors[1] < errors[0] < 1e-4
    mass, momentum = (getattr(equation, name) for name in ("mass", "momentum"))
    assert mass(kept.y[:, -1]) == pytest.approx(np.exp(-20 * DAMPING) * mass(problem.y0), rel=1e-13)
    assert momentum(kept.y[:, -1]) == pytest.approx(np.exp(-40 * DAMPING) * momentum(problem.y0), rel=1e-13)


def test_a_damped_soliton_decays_as_perturbation_theory_says():
    """The speed falls as exp(-4 damping t / 3) (Ott & Sudan, Phys. Fluids 13 (1970) 1432), to the first order."""
    equation, start = soliton(1e-3)
    run = integrate(equation.problem(start, 20.0, 0.05))
    modes = equation.modes(run.y[:, -1])
    fine = 64 * np.fft.irfft(modes, 4096) * 64
    assert 2 * fine.max() == pytest.approx(np.exp(-4 * 20e-3 / 3), rel=2e-3)


def test_invariants_of_the_damped_equation():
    equation, start = soliton()
    assert [item.name for item in equation.invariants()] == ["momentum"]
    for item in equation.invariants(("mass", "momentum")):
        G, step = np.empty(64), 1e-6 * np.cos(np.arange(64))
        item.grad(3.0, start, G)
        slope = (item.fun(3.0, start + step) - item.fun(3.0, start - step)) / 2
        assert G @ step == pytest.approx(slope, rel=1e-8)
    with pytest.raises(ValueError, match="unknown invariant 'energy' with damping"):
        equation.invariants("energy")
    with pytest.raises(ValueError, match="damping must be"):
        KortewegDeVries(equation.grid, -1.0)
