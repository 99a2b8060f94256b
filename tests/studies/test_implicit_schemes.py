"""Crank-Nicolson, linearly implicit and SAV schemes: order, what each keeps, dense solutions, and bad input."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from eip_scipy.problems import Grid, GrossPitaevskii
from eip_scipy_studies.comparators import crank_nicolson, linearly_implicit, sav_crank_nicolson
from eip_scipy_studies.condensates.problems import harmonic_trap, plane_wave, rotating_packet, soliton

SCHEMES = (crank_nicolson, linearly_implicit, sav_crank_nicolson)
ITERATED = (crank_nicolson, linearly_implicit)
TOL = 1e-12


def modulated(shape=(16, 16), beta=1.0, potential=None):
    """Return a plane wave with bumps, which is not a stationary state, and its equation on a box of sides 2 pi."""
    gpe = GrossPitaevskii(Grid(shape, 0, 2 * np.pi), potential, beta=beta)
    axes = gpe.grid.mesh()
    return gpe, (np.exp(1j * sum(axes)) * (1 + 0.25 * sum(np.cos(a + k) for k, a in enumerate(axes)))).ravel()


def lattice(*axes):
    return 1.5 + sum(np.cos(a) for a in axes)


def largest(values):
    return np.abs(values - values[0]).max()


# Order.


@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_two_on_the_plane_wave(scheme):
    problem = plane_wave((16, 16), modes=(1, 2), beta=1.5)
    exact = problem.reference(1.0)
    errors = [
        abs(scheme(problem.equation, (0, 1), problem.y0, h).y[:, -1] - exact).max() for h in (5e-3, 2.5e-3, 1.25e-3)
    ]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2, atol=0.05)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_two_on_the_soliton(scheme):
    problem = soliton()
    exact = problem.reference(1.0)
    errors = [abs(scheme(problem.equation, (0, 1), problem.y0, h).y[:, -1] - exact).max() for h in (1e-2, 5e-3)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.02)


@pytest.mark.parametrize("potential", [None, lattice], ids=["free", "lattice"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_two_against_scipys_dop853(scheme, potential):
    gpe, psi0 = modulated(potential=potential)
    fine = solve_ivp(gpe.fun, (0, 0.5), psi0, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    errors = [abs(scheme(gpe, (0, 0.5), psi0, h).y[:, -1] - fine).max() for h in (5e-3, 2.5e-3)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.03)
    assert errors[1] < 5e-4


@pytest.mark.parametrize("scheme", SCHEMES)
def test_three_dimensions(scheme):
    problem = plane_wave((8, 4, 6), modes=(1, 0, -1))
    run = scheme(problem.equation, (0, 0.5), problem.y0, 0.005)
    assert abs(run.y[:, -1] - problem.reference(0.5)).max() < 1e-4


# A step, solved by other means.


def kinetic_matrix(grid):
    """Return -Laplace / 2 as a dense matrix, with NumPy's transforms."""
    total = 0.0
    for axis, n in enumerate(grid.shape):
        k = 2 * np.pi * np.fft.fftfreq(n, grid.spacing[axis])
        along = np.fft.ifft(0.5 * k[:, None] ** 2 * np.fft.fft(np.eye(n), axis=0), axis=0)
        ones = [np.eye(m) for m in grid.shape]
        ones[axis] = along
        total = total + np.kron(*ones)
    return total


def both_parts(psi):
    return psi.view(float)


def test_crank_nicolson_solves_the_papers_equation():
    """Return a step of the fully implicit scheme from dense matrices and SciPy's root finder."""
    gpe, psi0 = modulated((6, 4), beta=2.0, potential=lattice)
    K, h = kinetic_matrix(gpe.grid), 0.1

    def residual(x):
        new = x.view(complex)
        mean = 0.5 * (new + psi0)
        density = 0.5 * gpe.beta * (abs(new) ** 2 + abs(psi0) ** 2)
        return both_parts(1j * (new - psi0) / h - K @ mean - (gpe.V.ravel() + density) * mean)

    solution = root(residual, both_parts(psi0).copy(), tol=1e-13)
    run = crank_nicolson(gpe, (0, h), psi0, h)
    np.testing.assert_allclose(run.y[:, -1], solution.x.view(complex), rtol=0, atol=1e-11)


@pytest.mark.parametrize("scheme", ITERATED)
def test_order_two_in_a_rotating_trap(scheme):
    """The packet of the paper's table 5, with mass and energy kept as without rotation."""
    problem = rotating_packet(0.9, points=32)
    gpe, t_span = problem.equation, (0, 0.1)
    fine = solve_ivp(gpe.fun, t_span, problem.y0, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    runs = [scheme(gpe, t_span, problem.y0, h) for h in (1e-3, 5e-4)]
    errors = [abs(run.y[:, -1] - fine).max() for run in runs]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)
    assert gpe.mass(runs[0].y[:, -1]) == pytest.approx(gpe.mass(problem.y0), rel=100 * 4 * TOL)
    if scheme is crank_nicolson:
        assert gpe.energy(runs[0].y[:, -1]) == pytest.approx(gpe.energy(problem.y0), rel=100 * 4 * TOL)


def test_linearly_implicit_solves_the_papers_equation():
    """The second step is a dense linear system; the first is one of Crank-Nicolson."""
    gpe, psi0 = modulated((6, 4), beta=2.0, potential=lattice)
    K, h = kinetic_matrix(gpe.grid), 0.05
    run = linearly_implicit(gpe, (0, 2 * h), psi0, h, save_every=1)
    psi1 = crank_nicolson(gpe, (0, h), psi0, h).y[:, -1]
    np.testing.assert_allclose(run.y[:, 1], psi1, rtol=0, atol=1e-13)
    A = 1j * h * (K + np.diag(gpe.V.ravel() + gpe.beta * abs(psi1) ** 2))
    one = np.eye(psi0.size)
    np.testing.assert_allclose(run.y[:, 2], np.linalg.solve(one + A, (one - A) @ psi0), rtol=0, atol=1e-11)


def test_sav_solves_its_equations():
    """The scheme solves the coupled system for (psi', r'), here a dense one with separate real and imaginary parts."""
    gpe, psi0 = modulated((6, 4), beta=2.0, potential=lattice)
    K, h, w, V, shift = kinetic_matrix(gpe.grid), 0.05, gpe.grid.cell, gpe.V.ravel(), 3.0

    def root_of_energy(p):
        return np.sqrt(w * np.sum(V * abs(p) ** 2 + 0.5 * gpe.beta * abs(p) ** 4) + shift)

    def step(psi, r, ahead):
        b = (V + gpe.beta * abs(ahead) ** 2) * ahead / root_of_energy(ahead)

        def residual(x):
            new, r_new = x[:-1].view(complex), x[-1]
            equation = 1j * (new - psi) / h - K @ (new + psi) / 2 - (r_new + r) / 2 * b
            return np.append(both_parts(equation), r_new - r - w * np.vdot(b, new - psi).real)

        unit = np.eye(2 * psi.size + 1)
        at_zero = residual(0 * unit[0])
        x = np.linalg.solve(np.transpose([residual(e) - at_zero for e in unit]), -at_zero)
        return x[:-1].view(complex).copy(), x[-1]

    r0 = root_of_energy(psi0)
    predicted, _ = step(psi0, r0, psi0)
    psi1, r1 = step(psi0, r0, 0.5 * (psi0 + predicted))
    psi2, _ = step(psi1, r1, 1.5 * psi1 - 0.5 * psi0)
    run = sav_crank_nicolson(gpe, (0, 2 * h), psi0, h, shift=shift, save_every=1)
    np.testing.assert_allclose(run.y[:, 1], psi1, rtol=0, atol=1e-11)
    np.testing.assert_allclose(run.y[:, 2], psi2, rtol=0, atol=1e-11)


# Preserved quantities.


@pytest.mark.parametrize("potential", [None, lattice], ids=["free", "lattice"])
def test_crank_nicolson_keeps_mass_and_energy(potential):
    gpe, psi0 = modulated(potential=potential)
    run = crank_nicolson(gpe, (0, 2), psi0, 0.01, save_every=1)
    mass, energy = (np.array([value(psi) for psi in run.y.T]) for value in (gpe.mass, gpe.energy))
    # A residual d of the mean, 2 d of the step, changes the mass by 4 |psi| d at most, the energy by 4 |H psi| d.
    bound = 200 * 4 * TOL * np.sqrt(mass[0])
    assert largest(mass) <= bound * np.sqrt(mass[0])
    norms = [np.sqrt(gpe.grid.cell) * np.linalg.norm(gpe.fun(0.0, psi)) for psi in run.y.T]
    assert largest(energy) <= bound * max(norms)


def test_a_looser_solver_keeps_less():
    gpe, psi0 = modulated()
    errors = []
    for tol in (1e-6, 1e-10):
        run = crank_nicolson(gpe, (0, 1), psi0, 0.01, tol=tol)
        errors.append(abs(gpe.mass(run.y[:, -1]) - gpe.mass(psi0)))
    assert errors[0] > 1e3 * errors[1] > 0


def test_linearly_implicit_keeps_mass_and_its_form_of_neighbours():
    gpe, psi0 = modulated(potential=lattice)
    run = linearly_implicit(gpe, (0, 2), psi0, 0.01, save_every=1)
    mass = np.array([gpe.mass(psi) for psi in run.y.T])
    assert largest(mass) <= 200 * 4 * TOL * mass[0]
    linear = GrossPitaevskii(gpe.grid, gpe.V, Omega=gpe.Omega)
    quadratic = np.array([linear.energy(psi) for psi in run.y.T])
    density = abs(run.y) ** 2
    mixed = gpe.grid.cell * np.sum(density[:, 1:] * density[:, :-1], axis=0)
    form = 0.5 * (quadratic[1:] + quadratic[:-1]) + 0.5 * gpe.beta * mixed
    assert largest(form) < 1e-8
    assert largest(np.array([gpe.energy(psi) for psi in run.y.T])) > 1e-5


@pytest.mark.parametrize("potential", [None, lattice], ids=["free", "lattice"])
@pytest.mark.parametrize("shift", [None, 25.0])
def test_sav_keeps_its_modified_energy_and_no_more(shift, potential):
    gpe, psi0 = modulated(potential=potential)
    run = sav_crank_nicolson(gpe, (0, 2), psi0, 0.01, shift=shift, save_every=1)
    energy = np.array([gpe.energy(psi) for psi in run.y.T])
    assert run.modified_energy[0] == pytest.approx(energy[0], rel=1e-14)
    assert largest(run.modified_energy) < 1e-12 * energy[0]
    assert largest(energy) > 1e-5
    assert largest(np.array([gpe.mass(psi) for psi in run.y.T])) > 1e-5


def test_sav_takes_a_pair_of_transforms_a_step():
    gpe, psi0 = modulated()
    assert sav_crank_nicolson(gpe, (0, 1), psi0, 0.01).nfev == 101  # the first step twice


def test_plane_wave_needs_no_iteration_of_the_linear_scheme():
    """|psi|^2 is constant there: the preconditioner is the inverse."""
    problem = plane_wave((8, 8))
    assert linearly_implicit(problem.equation, (0, 1), problem.y0, 0.01).nfev < 110


# The contract of the driver.


@pytest.mark.parametrize("scheme", SCHEMES)
def test_saved_states_and_a_shorter_last_step(scheme):
    problem = plane_wave((8, 8))
    run = scheme(problem.equation, (0.5, 1.505), problem.reference(0.5), 0.01, save_every=30)
    np.testing.assert_allclose(run.t, [0.5, 0.8, 1.1, 1.4, 1.505], rtol=0, atol=1e-14)
    for t, y in zip(run.t, run.y.T, strict=True):
        assert abs(y - problem.reference(t)).max() < 1e-3
    assert run.message == "completed"
    assert run.wall_time > 0


@pytest.mark.parametrize("scheme", SCHEMES)
def test_empty_interval(scheme):
    problem = plane_wave((8, 8))
    run = scheme(problem.equation, (1.0, 1.0), problem.y0, 0.1)
    assert (run.t.tolist(), run.nfev, run.message) == ([1.0], 0, "completed")
    np.testing.assert_array_equal(run.y[:, 0], problem.y0)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_backward(scheme):
    problem = plane_wave((8, 8))
    run = scheme(problem.equation, (1.0, 0.0), problem.reference(1.0), 0.01)
    assert abs(run.y[:, -1] - problem.y0).max() < 1e-3


def test_crank_nicolson_is_reversible():
    gpe, psi0 = modulated()
    there = crank_nicolson(gpe, (0, 1), psi0, 0.02)
    back = crank_nicolson(gpe, (1, 0), there.y[:, -1], 0.02)
    np.testing.assert_allclose(back.y[:, -1], psi0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_fields_are_states_and_the_start_stays(scheme):
    gpe, psi0 = modulated()
    kept = psi0.copy()
    flat, field = (scheme(gpe, (0, 0.1), y, 0.01).y for y in (psi0, gpe.grid.field(psi0)))
    np.testing.assert_array_equal(flat, field)
    np.testing.assert_array_equal(psi0, kept)
    np.testing.assert_array_equal(flat[:, 0], psi0)


@pytest.mark.parametrize("scheme", ITERATED)
def test_a_step_too_long_for_the_solver_is_reported(scheme):
    grid = Grid((16, 16), -4, 4)
    gpe = GrossPitaevskii(grid, harmonic_trap(9, 9), beta=100.0)
    x, y = grid.mesh()
    run = scheme(gpe, (0, 1), np.exp(-(x**2) - y**2), 0.1, save_every=1)
    assert run.message.startswith("failed in the step from t=0.0: the iteration left a residual of")
    assert "take a smaller h" in run.message
    assert np.isfinite(run.y[:, 0]).all()
    assert np.isnan(run.y[:, 1:]).all()


def test_sav_reports_an_energy_that_falls_below_the_shift():
    """A focusing wave: E1 sinks far below that of the start."""
    gpe, psi0 = modulated((32,), beta=-1.0)
    least = 0.5 * gpe.grid.cell * np.sum(abs(psi0) ** 4)
    run = sav_crank_nicolson(gpe, (0, 2), psi0, 0.01, shift=1.1 * least)
    assert "which must be positive; take a larger shift" in run.message
    assert np.isnan(run.y[:, -1]).all()
    assert sav_crank_nicolson(gpe, (0, 2), psi0, 0.01, shift=20 * least).message == "completed"


# Bad input.


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"gpe": plane_wave((8, 8))}, TypeError, "got FieldProblem; for a problem, pass problem.equation"),
        ({"y0": np.ones(7)}, ValueError, r"psi has shape \(7,\), expected \(8, 8\) or \(64,\)"),
        ({"y0": np.full(64, np.nan)}, ValueError, "must be finite"),
        ({"h": 0.0}, ValueError, "`h` must be positive. Got 0.0"),
        ({"h": 2.0}, ValueError, "`h` exceeds bounds"),
        ({"t_span": (0, np.inf)}, ValueError, "t_span must hold two finite numbers"),
        ({"t_span": 1.0}, ValueError, "t_span must hold two finite numbers"),
        ({"save_every": 0}, ValueError, "save_every must be a positive integer or None, got 0"),
    ],
)
def test_bad_input(scheme, change, error, message):
    arguments = {"gpe": plane_wave((8, 8)).equation, "t_span": (0, 1), "y0": np.ones(64), "h": 0.1, **change}
    with pytest.raises(error, match=message):
        scheme(**arguments)


@pytest.mark.parametrize("scheme", ITERATED)
@pytest.mark.parametrize("tol", [0.0, 1.0, True, "tight", np.nan])
def test_bad_tolerance(scheme, tol):
    problem = plane_wave((8, 8))
    with pytest.raises(ValueError, match=r"tol must be a number from 1e-15 to 1, exclusive of 1, got"):
        scheme(problem.equation, (0, 1), problem.y0, 0.1, tol=tol)


def test_sav_refuses_a_rotation():
    gpe = GrossPitaevskii(Grid((8, 8), 0, 1), Omega=0.5)
    with pytest.raises(ValueError, match=r"needs Omega = 0.*got Omega = 0\.5\. Use EIPRK4"):
        sav_crank_nicolson(gpe, (0, 1), np.ones(64), 0.1)


@pytest.mark.parametrize(
    ("shift", "message"),
    [("one", "number or None"), (True, "number or None"), (np.inf, "finite"), (-1e3, r"exceed -\d+\.?\d* for")],
)
def test_bad_shift(shift, message):
    problem = plane_wave((8, 8))
    with pytest.raises(ValueError, match=message):
        sav_crank_nicolson(problem.equation, (0, 1), problem.y0, 0.1, shift=shift)


# The figure of error against cost.


def test_error_against_cost():
    """Two panels for each problem, in which each method has one style, and lines of the slopes asked for."""
    plotting = pytest.importorskip("eip_scipy_studies.plotting")
    h = np.array([0.1, 0.05, 0.025])
    orders = {"second": 2, "fourth": 4}
    steps, times = ({name: (x, h**p) for name, p in orders.items()} for x in (h, 1 / h))
    rows = [
        [plotting.CostPanel(name, "step h", steps, slopes), plotting.CostPanel(name, "time [s]", times)]
        for name, slopes in (("one", {}), ("two", {"fourth": 4.0}))
    ]
    figure = plotting.cost_figure(rows, error="error")
    axes = np.reshape(figure.axes, (2, 2))
    assert [axis.get_title() for axis in axes.flat] == ["one", "one", "two", "two"]
    assert [axis.get_xlabel() for axis in axes[1]] == ["step h", "time [s]"]
    assert [len(axis.lines) for axis in axes.flat] == [2, 2, 3, 2]
    ends = axes[1, 0].lines[2].get_xydata()
    assert np.diff(np.log(ends[:, 1])) / np.diff(np.log(ends[:, 0])) == pytest.approx(4)
    assert (ends[:, 1] < np.interp(ends[:, 0], h[::-1], h[::-1] ** 4)).all()
    assert [text.get_text() for text in axes[1, 0].texts] == ["slope 4.00"]
    assert axes[0, 1].lines[1].get_color() == axes[1, 0].lines[1].get_color() != axes[0, 1].lines[0].get_color()
