"""Waves by lines: closed forms, invariants of the equations on the grid, and the methods of the problems."""

import pickle

import numpy as np
import pytest
from orders import observed_order

from eip_scipy import EIPDOP853, EIPRKN12, Invariant, ProjectionWarning, check_gradient, eip_method, integrate
from eip_scipy.methods.runge_kutta import DOP853, RK3, RK4, RK45
from eip_scipy.problems import (
    Grid,
    GrossPitaevskii,
    KortewegDeVries,
    Lawson,
    SineGordon,
    Splitting,
    breather,
    kepler,
    korteweg_de_vries_solitons,
    plane_wave,
    sine_gordon_breather,
    sine_gordon_kinks,
    soliton,
)

SCENES = {
    "soliton": lambda: soliton(length=80.0, points=512),
    "breather": breather,
    "breather that moves": lambda: breather(amplitude=0.7, velocity=1.3, beta=-2.0, length=80.0),
    "sine-Gordon breather": lambda: sine_gordon_breather(points=1024),
    "sine-Gordon breather that moves": lambda: sine_gordon_breather(points=1024, velocity=-0.4),
    "kinks": lambda: sine_gordon_kinks(points=1024),
    "KdV soliton": lambda: korteweg_de_vries_solitons(2.0, 5.0, 384),
    "KdV solitons": lambda: korteweg_de_vries_solitons(points=384, length=80.0),
    "three KdV solitons": lambda: korteweg_de_vries_solitons((2.0, 1.4, 0.8), (-14.0, 0.0, 12.0), 512, 110.0),
}
WEIGHTS = (4 / 5, -1 / 5, 4 / 105, -1 / 280)


@pytest.fixture(params=SCENES)
def scene(request):
    return SCENES[request.param]()


def rough(n, dtype=float, seed=1):
    """Return a field with all of its modes, which no grid resolves."""
    parts = np.random.default_rng(seed).standard_normal((2, n))
    return parts[0] + 1j * parts[1] if dtype is complex else parts[0]


def slope_in_time(closed, t, d=2e-3):
    return sum(w * (closed(t + k * d) - closed(t - k * d)) for k, w in enumerate(WEIGHTS, 1)) / d


def rate(item, fun, y):
    """Return the rate of an invariant, and its bound, the product of the gradient's norm and that of f."""
    f, gradient = fun(0.0, y), np.empty_like(y)
    item.grad(0.0, y, *((f,) if item.uses_f else ()), gradient)
    return abs(np.vdot(gradient, f).real), np.linalg.norm(gradient) * np.linalg.norm(f)


# Closed forms.


@pytest.mark.parametrize("t", [0.0, 1.3, 7.0])
def test_closed_form_solves_the_equation(scene, t):
    """The equation on the grid, whose slopes know nothing of the closed form's; around the ring too."""
    f = scene.fun(t, scene.reference(t))
    assert np.abs(f).max() > 0.01
    np.testing.assert_allclose(f, slope_in_time(scene.reference, t), rtol=0, atol=1e-8 * (1 + np.abs(f).max()))


def test_closed_forms_are_the_well_known_ones():
    x = np.linspace(-5, 5, 17)
    at = breather(points=16, length=10.0).reference
    np.testing.assert_allclose(abs(at(0.0)), 2 / np.cosh(x[:-1]), rtol=1e-14)
    np.testing.assert_allclose(abs(at(np.pi / 2)), abs(at(0.0)), rtol=1e-13)
    one = korteweg_de_vries_solitons(2.0, 1.0, points=16, length=10.0).reference(0.25)
    distance = np.remainder(x[:-1] - 1.5 + 5, 10) - 5
    np.testing.assert_allclose(one, 1 / np.cosh(distance / np.sqrt(2)) ** 2, rtol=1e-13)


@pytest.mark.parametrize("t", [60.0, -40.0])
def test_solitons_go_around_the_ring(t):
    """After some turns the same soliton is elsewhere, as high and as wide."""
    scene = korteweg_de_vries_solitons(2.0, 0.0, points=350)
    u = scene.reference(t)
    assert u.max() == pytest.approx(1.0, abs=1e-2)
    np.testing.assert_allclose(np.sort(np.roll(u, 3)), np.sort(u))
    assert scene.equation.mass(u) == pytest.approx(2 * np.sqrt(2.0), rel=1e-12)
    assert scene.equation.momentum(u) == pytest.approx(4 * np.sqrt(2.0) / 3, rel=1e-12)


def test_energies_are_those_of_the_closed_forms():
    """The integrals are in the literature: two kinks 16 / sqrt(1 - v^2), a breather 16 sqrt(1 - w^2)."""
    kinks, beats = sine_gordon_kinks(velocity=0.5), sine_gordon_breather(frequency=0.6)
    assert kinks.equation.energy(kinks.y0) == pytest.approx(16 / np.sqrt(0.75), rel=1e-12)
    assert beats.equation.energy(beats.y0) == pytest.approx(16 * 0.8, rel=1e-12)
    moves = sine_gordon_breather(frequency=0.6, velocity=0.4)
    c = 1 / np.sqrt(1 - 0.16)
    assert moves.equation.energy(moves.y0) == pytest.approx(16 * 0.8 * c, rel=1e-10)
    assert moves.equation.momentum(moves.y0) == pytest.approx(16 * 0.8 * c * 0.4, rel=1e-10)


# Invariants.


def gross_pitaevskii(shape, names):
    gpe = GrossPitaevskii(Grid(shape, -3, 3), beta=-1.0)
    return gpe, gpe.invariants(names), rough(gpe.grid.size, complex)


def real(equation, names):
    n = equation.grid.size * (2 if isinstance(equation, SineGordon) else 1)
    return equation, equation.invariants(names), rough(n)


EXACT = {
    "NLS": lambda: gross_pitaevskii((16,), ("mass", "energy")),
    "NLS in 3D": lambda: gross_pitaevskii((6, 7, 8), ("mass", "energy")),
    "sine-Gordon": lambda: real(SineGordon(Grid(16, 0, 7)), "energy"),
    "sine-Gordon, odd": lambda: real(SineGordon(Grid(17, 0, 7)), "energy"),
    "sine-Gordon in 3D": lambda: real(SineGordon(Grid((6, 7, 8), 0, 7)), "energy"),
    "KdV": lambda: real(KortewegDeVries(Grid(16, 0, 7)), ("mass", "momentum", "energy")),
    "KdV, odd": lambda: real(KortewegDeVries(Grid(17, 0, 7)), ("mass", "momentum", "energy")),
}
NEAR = {
    "NLS": lambda: gross_pitaevskii((16,), ("momentum_x",)),
    "NLS in 3D": lambda: gross_pitaevskii((6, 7, 8), ("momentum_x", "momentum_y", "momentum_z")),
    "sine-Gordon": lambda: real(SineGordon(Grid(16, 0, 7)), "momentum_x"),
    "sine-Gordon in 2D": lambda: real(SineGordon(Grid((8, 9), 0, 7)), ("momentum_x", "momentum_y")),
}


@pytest.mark.parametrize("made", EXACT)
def test_invariants_of_the_equations_on_the_grid(made):
    """The invariants are kept for any field, however rough, to rounding."""
    equation, items, y = EXACT[made]()
    for item in items:
        found, size = rate(item, equation.fun, y)
        assert found <= 4e-15 * size


@pytest.mark.parametrize("made", NEAR)
def test_momenta_are_none_of_the_equations_on_the_grid(made):
    """Momenta of a field that the grid does not resolve are not kept, as the documentation says."""
    equation, items, y = NEAR[made]()
    for item in items:
        found, size = rate(item, equation.fun, y)
        assert found > 1e-4 * size


def test_momenta_are_kept_where_the_grid_resolves_the_field():
    for scene in (breather(velocity=1.3), soliton(points=512), sine_gordon_breather(velocity=0.4)):
        (item,) = scene.equation.invariants(("momentum_x",))
        found, size = rate(item, scene.fun, scene.reference(0.6))
        assert found < 1e-9 * size


ALL = EXACT | {f"{name}, momenta": make for name, make in NEAR.items()}


@pytest.mark.parametrize("made", ALL)
def test_gradients(made):
    """Gradients agree with differences of the values."""
    equation, items, y = ALL[made]()
    for item in items:

        def gradient(t, y, item=item):
            out = np.empty_like(y)
            item.grad(t, y, *((equation.fun(t, y),) if item.uses_f else ()), out)
            return out

        check_gradient(Invariant(item.fun, gradient), 0.0, y)


def test_momentum_of_a_field_that_the_grid_does_not_resolve_is_not_trusted():
    scene = breather(points=256, velocity=1.3, t_end=1.0)
    with pytest.warns(ProjectionWarning, match="'momentum_x' is not an invariant of this system"):
        run = integrate(scene, invariants=scene.equation.invariants(("mass", "energy", "momentum_x")))
    assert not run.trusted


def test_momentum_of_plane_waves():
    scene = plane_wave((8, 12, 10), (1, -2, 3), amplitude=0.5)
    gpe = scene.equation
    np.testing.assert_allclose(gpe.momentum(scene.y0), gpe.mass(scene.y0) * np.array([1, -2, 3]), rtol=1e-12)
    items = gpe.invariants(("momentum_x", "momentum_y", "momentum_z"))
    np.testing.assert_allclose([item.fun(0.0, scene.y0) for item in items], gpe.momentum(scene.y0), rtol=1e-15)


def test_highest_mode_of_an_even_number_takes_no_part():
    equation = KortewegDeVries(Grid(8, 0, 7))
    waves = (-1.0) ** np.arange(8)
    smooth = np.cos(2 * np.pi * np.arange(8) / 8)
    assert np.abs(equation.fun(0.0, waves)).max() < 1e-14
    np.testing.assert_allclose(equation.fun(0.0, smooth + waves), equation.fun(0.0, smooth), atol=1e-13)
    np.testing.assert_allclose(equation.problem(smooth + waves, 1.0).y0, smooth, atol=1e-15)


# Runs.

RUNS = {  # t_end, error, with its margin for other machines
    "soliton": (2.0, 2e-8),
    "breather": (1.6, 2e-7),
    "breather that moves": (1.6, 2e-8),
    "sine-Gordon breather": (4.0, 1e-11),
    "sine-Gordon breather that moves": (4.0, 1e-11),
    "kinks": (20.0, 5e-11),
    "KdV soliton": (2.0, 1e-7),
    "KdV solitons": (20.0, 2e-6),
    "three KdV solitons": (1.0, 1e-6),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "KdV solitons" else name for name in RUNS]
)
def test_run_by_the_problems_own_method(name):
    scene, (t_end, error) = SCENES[name](), RUNS[name]
    run = integrate(scene, (0, t_end))
    assert run.trusted
    values = np.abs([float(item.fun(0.0, scene.y0)) for item in scene.invariants])
    assert (run.max_defect <= 2e-13 * (1 + values)).all()
    assert np.abs(run.y[:, -1] - scene.reference(t_end)).max() < error


def test_corrections_leave_the_mass_alone():
    scene = korteweg_de_vries_solitons()
    run = integrate(scene, (0, 2), h=0.02)
    assert scene.equation.mass(run.y[:, -1]) == pytest.approx(scene.equation.mass(scene.y0), rel=1e-14)


def test_methods_that_problems_bring():
    assert isinstance(soliton().method, Splitting)
    assert integrate(soliton(), (0, 0.1)).method == "EIP_splitting-rkn6"
    assert integrate(soliton(), (0, 0.1), method=EIPDOP853).method == "EIPDOP853"
    scene = sine_gordon_kinks()
    mine, named = integrate(scene, (0, 0.2)), integrate(scene, (0, 0.2), method=EIPRKN12)
    np.testing.assert_array_equal(mine.y, named.y)


def test_a_problem_without_a_method_needs_one():
    with pytest.raises(TypeError, match=r"^integrate: method is missing\. Use EIPDOP853 .*eip_scipy\.recommend"):
        integrate(kepler())


def test_a_run_goes_on_by_the_problems_method():
    scene = korteweg_de_vries_solitons()
    whole, half = integrate(scene, (0, 0.8), h=0.02), integrate(scene, (0, 0.4), h=0.02)
    np.testing.assert_allclose(half.continue_to(0.8).y[:, -1], whole.y[:, -1], rtol=0, atol=1e-12)


def test_problems_pickle():
    for scene in (korteweg_de_vries_solitons(), sine_gordon_kinks(), breather()):
        other = pickle.loads(pickle.dumps(scene))
        assert repr(other) == repr(scene)
        ends = [integrate(made, (0, 5 * scene.h)).y[:, -1] for made in (scene, other)]
        np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("shape", [(12, 10), (6, 8, 7)])
def test_sine_gordon_in_more_dimensions(shape):
    """Small waves go by their dispersion relation; the energy is kept."""
    grid = Grid(shape, 0, 2 * np.pi)
    phase = grid.mesh()[0] + 2 * grid.mesh()[1] + 0 * sum(grid.mesh())
    omega, small = np.sqrt(6.0), 1e-5
    equation = SineGordon(grid)
    problem = equation.problem(small * np.cos(phase), small * omega * np.sin(phase), 3.0, h=0.05)
    run = integrate(problem, project_initial=False)
    exact = small * np.cos(phase - 3 * omega).ravel()
    np.testing.assert_allclose(run.y[: grid.size, -1], exact, atol=1e-9 * small + small**3)
    np.testing.assert_allclose(equation.momentum(run.y[:, -1])[:2], equation.momentum(problem.y0)[:2], rtol=1e-9)


# Lawson's method.

TABLEAUX = {
    "RK3": (RK3, (0.05, 0.025)),
    "RK4": (RK4, (0.05, 0.025)),
    "RK45": (RK45, (0.1, 0.05)),
    "DOP853": (DOP853, (0.2, 0.1)),
}


@pytest.mark.parametrize("kept", [False, True], ids=["raw", "EIP"])
@pytest.mark.parametrize("name", TABLEAUX)
def test_order_of_lawson(name, kept):
    """The order is the tableau's for a smooth field; its highest modes turn by up to 8 in a step."""
    tableau, steps = TABLEAUX[name]
    equation = KortewegDeVries(Grid(24, 0, 20))
    problem = equation.problem(0.2 * np.cos(2 * np.pi * equation.grid.points(0) / 20), 1.0, h=0.01)
    end = integrate(problem).y[:, -1]
    options = {} if kept else {"invariants": ()}
    method = eip_method(Lawson(equation, tableau))
    errors = [np.abs(integrate(problem, h=h, method=method, **options).y[:, -1] - end).max() for h in steps]
    assert observed_order(errors, np.array(steps))[0] == pytest.approx(tableau.order, abs=0.5)


@pytest.mark.parametrize("tableau", [RK45, DOP853], ids=["fsal", "paired"])
def test_adaptive_steps_of_lawson(tableau):
    scene = korteweg_de_vries_solitons()
    method = eip_method(Lawson(scene.equation, tableau))
    errors = []
    for tolerance in (1e-5, 1e-8):
        run = integrate(scene, (0, 2), method=method, rtol=tolerance, atol=tolerance, metric="euclidean")
        errors.append(np.abs(run.y[:, -1] - scene.reference(2.0)).max())
    assert errors[0] < 1e-2
    assert errors[1] < 1e-2 * errors[0]


@pytest.mark.parametrize("tableau", [RK3, RK4, DOP853], ids=lambda tableau: tableau.name)
def test_lawson_counts_what_it_evaluates(tableau, monkeypatch):
    """And the derivative at the start; the energy's gradient takes none."""
    scene = korteweg_de_vries_solitons(points=96, t_end=1.0)
    equation, calls = scene.equation, []
    plain = equation.nonlinear
    monkeypatch.setattr(equation, "nonlinear", lambda modes: calls.append(1) or plain(modes))
    run = integrate(scene, (0, 0.1), method=eip_method(Lawson(equation, tableau)), h=0.01, check=False)
    assert run.nfev == len(calls) > 10 * tableau.n_stages


@pytest.mark.parametrize(("scheme", "flows"), [("strang", 1), ("s6", 6), ("rkn6", 6)])
def test_splittings_count_their_pairs_of_transforms(scheme, flows):
    scene = soliton(points=80, t_end=0.1)
    run = integrate(scene, method=eip_method(Splitting(scene.equation, scheme)), h=0.01, invariants=())
    assert run.nfev == 1 + 10 * flows


@pytest.mark.parametrize(
    ("scene", "h"),
    [
        (soliton(points=77), 0.02),
        (soliton(points=115, velocity=4.0), 0.01),
        (soliton(points=78, amplitude=0.5, velocity=1.0, length=70.0, t_end=20.0), 0.05),
        (korteweg_de_vries_solitons(points=92), 0.02),
        (korteweg_de_vries_solitons(4.0, 0.0, points=128, t_end=5.0), 0.005),
    ],
)
def test_the_coarsest_grids_that_are_taken_have_small_errors(scene, h):
    method = {"method": eip_method(Lawson(scene.equation, RK4))} if "korteweg" in scene.name else {}
    end = scene.t_span[1]
    run = integrate(scene, h=h, invariants=(), **method)
    assert 1e-5 < np.abs(run.y[:, -1] - scene.reference(end)).max() / np.abs(scene.y0).max() < 4e-3


def test_lawson_is_exact_for_linear_waves():
    equation = KortewegDeVries(Grid(32, 0, 2 * np.pi))
    x, small = equation.grid.points(0), 1e-9
    moved, err = Lawson(equation).one_step(0.0, small * np.cos(5 * x), 0.7)
    np.testing.assert_allclose(moved, small * np.cos(5 * x + 125 * 0.7), atol=1e-13 * small + 100 * small**2)
    assert np.abs(err).max() < 100 * small**2


# Refused arguments.


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: KortewegDeVries(Grid((4, 4), 0, 1)), "needs a grid of one dimension"),
        (lambda: KortewegDeVries(Grid(8, 0, 1)).problem(np.zeros(9), 1.0), r"u0 has shape \(9,\), expected \(8,\)"),
        (lambda: SineGordon(Grid(8, 0, 1)).problem(np.zeros(8), 0.0, 1.0), r"q0 or p0 has shape \(\), expected \(8,\)"),
        (lambda: SineGordon(Grid(8, 0, 1)).invariants("momentum_y"), "expected energy, momentum_x"),
        (lambda: KortewegDeVries(Grid(8, 0, 1)).invariants("enrgy"), "did you mean 'energy'"),
        (lambda: soliton().equation.invariants("momentum_y"), "needs an axis that"),
        (lambda: sine_gordon_breather(frequency=1.0), "0 < frequency < 1"),
        (lambda: sine_gordon_breather(velocity=-1.0), "velocity"),
        (lambda: sine_gordon_kinks(velocity=1.5), "0 < velocity < 1"),
        (lambda: sine_gordon_kinks(velocity=0.99), "width 0.141, but 512 points .* Give points >= 1135"),
        (lambda: sine_gordon_breather(velocity=-0.99), "Give points >= 1135"),
        (lambda: KortewegDeVries(Grid(8, 0, 1), damping=1.0).problem(np.ones(8), 400.0), "End the run before t = 350"),
        (lambda: korteweg_de_vries_solitons((1.0, 1.0)), "all different"),
        (lambda: korteweg_de_vries_solitons((1.0, 2.0), 0.0), "a place for each"),
        (lambda: korteweg_de_vries_solitons(points=32), "a soliton of the speed 2 has the width 1.41, .* points >= 91"),
        (lambda: soliton(points=32), "points at most 0.524 apart, but 32 .* are 1.25 apart. Give points >= 77"),
        (lambda: soliton(velocity=-20.0), "Give points >= 319"),
        (lambda: breather(beta=1.0), "beta < 0"),
    ],
)
def test_wrong_values(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_decay_counts_for_the_invariants_that_are_kept():
    equation = KortewegDeVries(Grid(8, 0, 1), damping=1.0)
    assert equation.problem(np.ones(8), 400.0, invariants=()).t_span == (0.0, 400.0)
    assert equation.problem(np.ones(8), 400.0, invariants="mass").t_span == (0.0, 400.0)


@pytest.mark.parametrize(
    ("make", "of", "at", "scene"),
    [(Lawson, "nonlinear", 3, korteweg_de_vries_solitons), (Splitting, "grid", 1, breather)],
    ids=["Lawson", "Splitting"],
)
def test_a_step_may_be_interrupted_by_one_of_another_length(make, of, at, scene):
    # Another thread that runs the same problem does so.
    scene = scene()
    method, known = make(scene.equation), type(scene.equation)
    alone = method.one_step(0.0, scene.y0.copy(), 0.01)
    uses = []

    class Interrupted(known):
        def __getattribute__(self, name):
            uses.extend([name] * (name == of))
            if name == of and len(uses) == at:
                method.one_step(0.0, scene.y0.copy(), 0.004)
            return super().__getattribute__(name)

    scene.equation.__class__ = Interrupted
    try:
        found = method.one_step(0.0, scene.y0.copy(), 0.01)
    finally:
        scene.equation.__class__ = known
    assert len(uses) > at
    for one, other in zip(np.atleast_2d(found), np.atleast_2d(alone), strict=True):
        np.testing.assert_array_equal(one, other)


def test_lawson_takes_tableaux():
    with pytest.raises(TypeError, match="expected a Tableau"):
        Lawson(KortewegDeVries(Grid(8, 0, 1)), EIPDOP853)
