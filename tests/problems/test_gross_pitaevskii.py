"""The Gross-Pitaevskii equation: its parts against closed forms and dense matrices, its invariants, and its steps."""

import copy
import pickle
from functools import partial

import numpy as np
import pytest
from orders import observed_order
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, EIPRK45, ProjectionWarning, check_gradient, integrate
from eip_scipy.problems import Grid, GrossPitaevskii
from eip_scipy_studies.condensates.problems import harmonic_trap, quartic_trap, rotating_packet, soliton


def noise(grid):
    return np.random.default_rng(7).standard_normal(2 * grid.size).view(complex).reshape(grid.shape)


def hamiltonian(gpe, psi):
    return 1j * gpe.fun(0.0, psi)


def derivatives(n, length):
    """Return the spectral derivatives on n (even) points, the second with the Nyquist mode's own factor.

    L. N. Trefethen, Spectral methods in MATLAB, SIAM 2000, eq. 3.10 and 3.12.
    """
    d = np.arange(n)[:, None] - np.arange(n)
    with np.errstate(divide="ignore"):
        first, second = 0.5 * (-1.0) ** d / np.tan(d * np.pi / n), -0.5 * (-1.0) ** d / np.sin(d * np.pi / n) ** 2
    first[d == 0], second[d == 0] = 0.0, -(n**2 + 2) / 12
    return 2 * np.pi / length * first, (2 * np.pi / length) ** 2 * second


@pytest.mark.parametrize("nyquist", ["true", "zero"])
@pytest.mark.parametrize("Omega", [0.0, 0.7])
def test_two_dimensions_are_the_papers_dense_matrices(Omega, nyquist):
    """Return equation (3.10) with D1 of the y axis transposed; the paper's D2 is D1 applied twice."""
    grid = Grid((12, 16), (-2, -3), (2, 4))
    gpe = GrossPitaevskii(grid, quartic_trap(1.2, 0.3, 1, 2), Omega=Omega, beta=1.5, nyquist=nyquist)
    psi, (x, y) = noise(grid), grid.mesh()
    (D1x, D2x), (D1y, D2y) = derivatives(12, 4), derivatives(16, 7)
    if nyquist == "zero":
        D2x, D2y = D1x @ D1x, D1y @ D1y
    s = x**2 + 4 * y**2
    V = -0.1 * s + 0.075 * s**2
    Lz = -1j * (x * (psi @ D1y.T) - (D1x @ psi) * y)
    free = -0.5 * (D2x @ psi + psi @ D2y.T) - Omega * Lz
    linear = free + V * psi
    expected, w, out = linear + 1.5 * abs(psi) ** 2 * psi, 4 / 12 * 7 / 16, np.empty_like(psi)
    size = np.abs(expected).max()
    np.testing.assert_allclose(gpe.fun(0, psi.ravel()), -1j * expected.ravel(), atol=1e-13 * size)
    assert gpe.mass(psi) == pytest.approx(w * np.sum(abs(psi) ** 2), rel=1e-14)
    energy = w * (np.vdot(psi, linear).real + 0.75 * np.sum(abs(psi) ** 4))
    assert gpe.energy(psi) == pytest.approx(energy, rel=1e-13)
    assert gpe.angular_momentum(psi) == pytest.approx(w * np.vdot(psi, Lz).real, rel=1e-12)
    gpe.linear(psi, out)
    np.testing.assert_allclose(out, free, atol=1e-13 * size)


@pytest.mark.parametrize("Omega", [0.0, 0.6])
@pytest.mark.parametrize(("shape", "gamma"), [((32, 32), (1, 1)), ((24, 24, 24), (1, 1, 2))])
def test_vortex_of_the_harmonic_trap(shape, gamma, Omega):
    """(x + i y) exp(-V) is an eigenstate of energy 2 + gamma_z / 2 - Omega and angular momentum 1."""
    ends, tolerance = np.array([6.5, 6.5, 4.5])[: len(shape)], 1e-6  # what the grid resolves
    grid = Grid(shape, -ends, ends)
    gpe = GrossPitaevskii(grid, harmonic_trap(*gamma), Omega=Omega)
    x, y, *_ = grid.mesh()
    psi = (x + 1j * y) * np.exp(-0.5 * sum(g * a**2 for g, a in zip(gamma, grid.mesh(), strict=True)))
    level = 2 + (gamma[2] / 2 if len(gamma) == 3 else 0) - Omega
    np.testing.assert_allclose(hamiltonian(gpe, psi), level * psi, atol=tolerance)
    assert gpe.energy(psi) / gpe.mass(psi) == pytest.approx(level, rel=tolerance)
    assert gpe.angular_momentum(psi) / gpe.mass(psi) == pytest.approx(1, rel=tolerance)


def test_odd_numbers_of_points_and_one_dimension():
    """exp(i k x) has the energy k^2 / 2 per mass, and the derivative of the highest mode of an odd grid has a sign."""
    grid = Grid(9, 0, 2 * np.pi)
    gpe = GrossPitaevskii(grid)
    for k in range(-4, 5):
        psi = np.exp(1j * k * grid.points(0))
        np.testing.assert_allclose(hamiltonian(gpe, psi), 0.5 * k * k * psi, atol=1e-13)
    np.testing.assert_array_equal(grid.wavenumbers(0, odd=True), grid.wavenumbers(0))


@pytest.mark.parametrize("library", ["ducc0", "scipy"])
def test_transforms_are_numpys_with_any_library_and_threads(library, monkeypatch):
    """Along x SciPy transforms some columns at a time, the last strip a narrower one."""
    pytest.importorskip(library)
    if library == "scipy":
        monkeypatch.setattr("eip_scipy.problems.gross_pitaevskii.find_spec", lambda name: None)
    for shape in ((10,), (8, 6), (4, 6, 10)):
        grid = Grid(shape, -1, 1)
        fft, psi = GrossPitaevskii(grid).transforms, noise(grid)
        assert fft.gains_by_strips == (library == "scipy")
        for axes in [(0,), tuple(range(len(shape))), tuple(range(1, len(shape))) or (0,)]:
            kept, out = psi.copy(), np.empty_like(psi)
            fft.forward(psi, axes, out)
            np.testing.assert_allclose(out, np.fft.fftn(psi, axes=axes), atol=1e-13)
            fft.backward(out, axes)
            np.testing.assert_allclose(out, psi * np.prod([shape[a] for a in axes]), atol=1e-12)
            np.testing.assert_array_equal(psi, kept)
    grid, options = Grid((24, 150), -4, 5), {"Omega": 0.4, "beta": 2.0}
    one, two = (GrossPitaevskii(grid, harmonic_trap(1, 1), threads=n, **options) for n in (1, 2))
    psi = noise(grid).ravel()
    found = one.fun(0.0, psi)
    np.testing.assert_array_equal(found, two.fun(0.0, psi))
    one.transforms.gains_by_strips = False
    np.testing.assert_allclose(found, one.fun(0.0, psi), rtol=0, atol=1e-15 * abs(found).max())


@pytest.mark.parametrize("shape", [(8,), (6, 8), (4, 6, 4)])
def test_gradients(shape):
    grid = Grid(shape, -2, 2)
    gpe = GrossPitaevskii(grid, harmonic_trap(*[1.0] * grid.dim), Omega=0.6 * (grid.dim > 1), beta=-2.0)
    for invariant in gpe.invariants(("mass", "energy", "angular_momentum")[: 2 + (grid.dim > 1)]):
        assert check_gradient(invariant, 0.0, noise(grid).ravel(), gpe.fun) < 1e-10


def test_energy_near_a_known_one_is_the_energy():
    """The energy knows its value and f at a state of unit size."""
    grid = Grid((16, 16), -3, 3)
    gpe = GrossPitaevskii(grid, harmonic_trap(1, 2), Omega=0.7, beta=30.0)
    x, y = grid.mesh()
    psi = ((x + 1j * y) * np.exp(-(x**2) - y**2) + 0.01 * noise(grid)).ravel()
    (energy,) = gpe.invariants(["energy"])
    energy.grad(0.0, psi, gpe.fun(0.0, psi), np.empty_like(psi))
    assert energy.fun(0.0, psi) == gpe.energy(psi)
    for size in (0.0, 1e-16, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3, 1.0):
        other = psi + size * noise(grid).ravel()
        assert energy.fun(0.0, other) == pytest.approx(gpe.energy(other), rel=2e-15)


def test_angular_momentum_is_kept_where_the_trap_is_round_and_refused_where_not():
    grid = Grid((48, 48), -7, 7)  # 32 points do not resolve it: the angular momentum of the grid leaks
    x, y = grid.mesh()
    psi = (1 + x + (1 + 1j) * y) * np.exp(-0.5 * (x**2 + y**2))
    names = ("mass", "energy", "angular_momentum")
    gpe = GrossPitaevskii(grid, harmonic_trap(1, 1), Omega=0.4, beta=1.0)
    p = gpe.problem(psi, 0.2, 0.01, invariants=names)
    run = integrate(p, method=EIPRK4)
    assert run.max_residual.max() < 1e-13
    assert run.diagnostics.n_rank_reduced == 0
    oval = GrossPitaevskii(grid, harmonic_trap(1, 2), Omega=0.4, beta=1.0).problem(psi, 0.2, 0.01, invariants=names)
    with (
        pytest.warns(UserWarning, match="'angular_momentum' is not an invariant of this system"),
        pytest.warns(ProjectionWarning, match="'angular_momentum'"),
    ):
        integrate(oval, method=EIPRK4)


@pytest.fixture(params=[(8, 16), (6, 7), (5, 9, 21)], ids=str)
def state(request):
    grid = Grid(request.param, -2, 3)
    gpe = GrossPitaevskii(grid, harmonic_trap(*[1.0] * grid.dim), Omega=0.4, beta=20.0)
    psi = noise(grid).ravel()
    return gpe, psi, gpe.fun(0.0, psi)


@pytest.mark.parametrize("names", [("mass",), ("energy",), ("mass", "energy"), ("energy", "mass")], ids=str)
def test_joint_is_the_invariants_one_by_one(state, names):
    gpe, psi, f = state
    count, joint = len(names), gpe.invariants(names)
    values, gram, terms = np.empty(count), np.empty((count, count)), np.empty(count)
    joint.moments(0.0, psi, f, values, gram, terms)
    G = np.empty((count, psi.size), complex)
    for item, row in zip(joint, G, strict=True):
        item.grad(0.0, psi, f, row) if item.uses_f else item.grad(0.0, psi, row)
    reals = G.view(float)
    np.testing.assert_allclose(values, [item.fun(0.0, psi) for item in joint], rtol=1e-13)
    np.testing.assert_allclose(gram, reals @ reals.T, rtol=1e-12)
    np.testing.assert_allclose(terms, np.abs(reals * psi.view(float)).sum(axis=1), rtol=1e-12)
    for size in (1e-15, 1e-6):  # near the state, and far from it
        mu = size * np.arange(1.0, 1.0 + count)
        out, moved = np.empty_like(psi), np.empty(count)
        joint.shift(0.0, psi, f, mu, out, moved)
        np.testing.assert_allclose(out, psi + mu @ G, rtol=0, atol=1e-14)
        exact = [{"mass": gpe.mass, "energy": gpe.energy}[name](out) for name in names]
        np.testing.assert_allclose(moved, exact, rtol=4e-15)


@pytest.mark.parametrize(
    ("options", "joint"),
    [
        ({}, True),
        ({"metric": "error"}, False),
        ({"direction": "midpoint"}, False),
        ({"iterations": 2}, False),
        ({"every": "auto"}, False),
        ({"linear_invariants": (np.ones((1, 256)), np.ones((256, 1)))}, False),
    ],
)
def test_joint_steps_are_those_of_the_items(options, joint, monkeypatch):
    p, calls = rotating_packet(0.9, points=16, t_end=0.2, h=0.004), []
    shift = type(p.invariants).shift
    monkeypatch.setattr(type(p.invariants), "shift", lambda *args: calls.append(1) or shift(*args))
    options = {"h": p.h, "method": EIPRK4, "metric": "euclidean", **options}
    for call in (partial(integrate, p), partial(solve_ivp, p.fun, p.t_span, p.y0)):
        calls.clear()
        found = call(invariants=p.invariants, **options).y[:, -1]
        assert (len(calls) > 30) == joint
        expected = call(invariants=list(p.invariants), **options).y[:, -1]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 if joint else 0)


def test_joint_invariants_fail_are_copied_and_continued(monkeypatch):
    p = rotating_packet(0.9, points=16, t_end=0.02, h=0.004)
    joint, single = (integrate(p, invariants=kept, method=EIPRK4) for kept in (p.invariants, list(p.invariants)))
    found, expected = (run.continue_to(0.04).y[:, -1] for run in (joint, single))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
    for copied in (copy.deepcopy(p.invariants), pickle.loads(pickle.dumps(p.invariants))):
        assert type(copied) is type(p.invariants)
        assert [item.name for item in copied] == ["mass", "energy"]
    shift = type(p.invariants).shift  # one that fails is not taken
    wrong = lambda self, t, y, f, mu, out, values: shift(self, t, y, f, -1e3 * mu, out, values)  # noqa: E731
    monkeypatch.setattr(type(p.invariants), "shift", wrong)
    np.testing.assert_array_equal(integrate(p, method=EIPRK4).y[:, -1], single.y[:, -1])


def test_the_stable_step_knows_the_interaction():
    """The largest frequency is the free one plus 2 beta |psi|^2, of the field that is linearised."""
    equation = soliton(points=64, length=20.0, t_end=0.1).equation
    psi = np.full(64, 0.3 + 0.4j)
    free = 1 / equation.largest_step(0 * psi, 1.0)
    assert 1 / equation.largest_step(2 * psi, 1.0) - free == pytest.approx(2 * abs(equation.beta), rel=1e-12)


@pytest.mark.needs_jit  # plain Python adds one number after the other, which rounds more
def test_soliton_travels_at_order_four_with_mass_and_energy_kept():
    """One evaluation of f serves grad E and the next first stage: the error is the same to 5 %."""
    travelling, steps = soliton(points=320, velocity=4.0, length=48.0, t_end=0.48), [0.012, 0.006, 0.003]
    solve = partial(integrate, travelling, method=EIPRK4)
    runs, others = ([solve(h=h, reuse_f=reuse) for h in steps] for reuse in (True, False))
    exact = travelling.reference(0.48)
    errors, without = ([np.abs(run.y[:, -1] - exact).max() for run in made] for made in (runs, others))
    assert errors[-1] < 1e-6
    np.testing.assert_allclose(observed_order(errors, steps), 4, atol=0.1)
    np.testing.assert_allclose(errors, without, rtol=0.05)
    assert max(run.max_residual.max() for run in runs) < 2e-14
    assert (runs[0].nfev, others[0].nfev) == (1 + 4 * 40, 1 + 5 * 40)
    mass_only = solve(h=0.012, invariants=travelling.equation.invariants(["mass"]))
    assert mass_only.nfev == 1 + 4 * 40  # its gradient needs no f: plain RK4's cost
    # Plain RK4 loses both.
    bare, gpe = solve(h=0.012, invariants=()), travelling.equation
    assert abs(gpe.mass(bare.y[:, -1]) - gpe.mass(bare.y[:, 0])) > 1e-6
    kept = solve(h=0.012, save_every=1)
    assert np.ptp(kept.invariants, axis=1).max() < 2e-14


def test_fields_of_a_run_and_adaptive_steps():
    p = rotating_packet(0.9, points=16, t_end=0.02, h=0.004)
    run = integrate(p, method=EIPRK4, save_every=1)
    assert "interpreted" in run.message
    fields = p.equation.grid.field(run.y)
    assert fields.shape == (6, 16, 16)
    assert np.shares_memory(fields, run.y)
    np.testing.assert_array_equal(p.equation.grid.field(run.y[:, -1]), fields[-1])
    p = soliton(points=160, length=40.0, t_end=0.5)
    sol = solve_ivp(p.fun, p.t_span, p.y0, method=EIPRK45, rtol=1e-8, atol=1e-10, invariants=p.invariants)
    np.testing.assert_allclose(sol.y[:, -1], p.reference(0.5), atol=1e-6)


SQUARE, LINE = Grid((8, 8), -1, 1), Grid(8, -1, 1)
WRONG = [
    *((lambda shape=shape: Grid(shape, 0, 1), "one to three integers") for shape in ((8, 8, 8, 8), (8, 1), (8.5, 8))),
    (lambda: Grid((8, 8), 1, 0), "upper must be above lower"),
    (lambda: Grid((8, 8), (0, 0, 0), 1), "lower must be a finite number or 2"),
    (lambda: Grid((8, 8), 0, np.inf), "upper must be a finite number or 2"),
    (lambda: GrossPitaevskii(SQUARE, lambda x, y: x * 1j), "potential must be real and finite"),
    (lambda: GrossPitaevskii(SQUARE, lambda x, y: np.where(x > 0, np.nan, 1.0) + y), "potential must be real and fini"),
    (lambda: GrossPitaevskii(SQUARE, np.zeros((3, 3))), r"shape \(3, 3\), which does not fit Grid\(\(8, 8\)"),
    (lambda: GrossPitaevskii(SQUARE, Omega=np.nan), "Omega must be a finite number"),
    (lambda: GrossPitaevskii(SQUARE, beta="1"), "beta must be a finite number"),
    (lambda: GrossPitaevskii(SQUARE, nyquist="half"), "nyquist must be 'true' or 'zero', got 'half'"),
    (lambda: GrossPitaevskii(SQUARE, threads=0), "threads must be an integer >= 1"),
    (lambda: GrossPitaevskii(SQUARE).energy(np.zeros((8, 7))), r"psi has shape \(8, 7\), expected \(8, 8\) or \(64,\)"),
    (lambda: SQUARE.field(np.zeros(63)), r"got shape \(63,\), expected \(64,\)"),
    (lambda: GrossPitaevskii(SQUARE).invariants(["energie"]), "did you mean 'energy'"),
    (lambda: GrossPitaevskii(LINE, Omega=0.5), "a rotation needs two or three dimensions"),
    (lambda: GrossPitaevskii(LINE).angular_momentum(np.zeros(8)), "angular momentum need two or three"),
]


def test_what_is_wrong_is_said():
    for call, message in WRONG:
        with pytest.raises(ValueError, match=message):
            call()
