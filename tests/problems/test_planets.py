"""Functions for many planets: derivatives and rates in one pass over the pairs, and in two; wrong input."""

import numpy as np
import pytest

from eip_scipy import EIPDOP853, EIPGJ14, EIPRK4, Balance, integrate
from eip_scipy.engine.native import library
from eip_scipy.problems import nbody, solar_system
from eip_scipy.problems.gravity.orbits import orbital_balances

NAMES = [name for name in library if name.startswith("planets.")]
ALL = ("energy", "momentum", "laplace")
# Bodies whose pulls are summed in each of the ways of pair_sums.hpp.
SIZES = [2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 16, 17, 18, 26, 131]


def planets(n, heaviest=0):
    """Return G m and the state of n bodies, planets on orbits of eccentricity about 0.1 and, at any place, a star."""
    rng = np.random.default_rng(n)
    gm, q, v = np.r_[40.0, 10 ** rng.uniform(-6, -3, n - 1)], np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(1, n):
        radial, along, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
        q[k] = (1 + 0.3 * k) * radial
        v[k] = np.sqrt(40.0 / (1 + 0.3 * k)) * (rng.uniform(0.95, 1.05) * along + 0.05 * radial)
    order = np.roll(np.arange(n), heaviest)
    return gm[order], q[order], v[order]


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize(("method", "h"), [(EIPDOP853, 0.02), (EIPGJ14, 0.002)])
def test_the_derivative_that_comes_with_the_rates_has_the_same_bits(n, method, h):
    problem = nbody(*planets(n), t_span=(0.0, 50 * h), h=h, balances="kepler")
    alone = integrate(problem, method=method, invariants=(), compensated=True).y
    kept = integrate(problem, method=method, every=1000, compensated=True)
    np.testing.assert_array_equal(kept.y[:, :-1], alone[:, :-1])
    assert kept.diagnostics.n_projections == 1  # of the last state


def in_python(balance):
    """Return the same balance, whose functions are called from Python, and so its rates apart from the derivative."""
    fun, rate, grad = balance.fun, balance.rate, balance.grad

    def filled(t, y, f, out):
        grad(t, y, f, out)

    found = Balance(
        lambda t, y: fun(t, y),
        lambda t, y, f: rate(t, y, f),
        filled,
        size=balance.size,
        name=balance.name,
        in_place=True,
        uses_f=True,
    )
    found.subspaces, found.most_slowness = balance.subspaces, balance.most_slowness
    return found


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize(("method", "h"), [(EIPDOP853, 0.02), (EIPGJ14, 0.002)])
@pytest.mark.parametrize("heaviest", [0, 1])
def test_runs_with_rates_of_the_same_pass_and_of_a_pass_of_their_own(n, method, h, heaviest):
    gm, q, v = planets(n, heaviest)
    y0 = np.concatenate([q.ravel(), v.ravel()])
    items = orbital_balances(gm, y0, ALL if n < 6 else "kepler", newton=True)
    options = {"t_span": (0.0, 40 * h), "h": h, "y0": y0, "method": method, "frame": None}
    fused = integrate(acceleration=library["gravity.acc"], params=gm, invariants=items, **options)
    acceleration = library["gravity.acc"]
    apart = integrate(
        acceleration=lambda t, q: acceleration(t, q, gm), invariants=[in_python(item) for item in items], **options
    )
    assert (fused.calls["acceleration"], apart.calls["acceleration"]) == ("native", "python")
    np.testing.assert_array_equal(fused.y, apart.y)
    np.testing.assert_array_equal(fused.invariants, apart.invariants)


def test_other_masses_than_those_of_the_balances():
    """The rates are those of the balances' own masses, from which no pull on the way is taken then."""
    gm, q, v = planets(10)
    y0, others = np.concatenate([q.ravel(), v.ravel()]), gm * np.r_[1.0, 1.001 * np.ones(9)]
    items = orbital_balances(gm, y0, newton=True)
    options = {"t_span": (0.0, 0.4), "h": 0.02, "y0": y0, "method": EIPRK4, "check": False}
    rhs = library["gravity.rhs"]

    def fun(t, y):
        out = np.empty_like(y)
        rhs(t, y, out, others)
        return out

    native = integrate(fun=rhs, in_place=True, params=others, invariants=items, **options)
    python = integrate(fun=fun, invariants=[in_python(item) for item in items], **options)
    np.testing.assert_array_equal(native.y, python.y)


@pytest.mark.parametrize("quantities", ["kepler", ALL])
def test_energies_of_planets_are_those_of_any_orbits(quantities):
    """Ten years by the functions for planets, and with the Sun in the middle of the list by those for orbits."""
    problem = solar_system(years=10.0, h=1 / 256, balances=quantities)
    order = np.r_[1:4, 0, 4:10]
    q, v = problem.y0.reshape(2, 10, 3)[:, order]
    moved = nbody(problem.params[order], q, v, t_span=(0.0, 10.0), h=1 / 256, balances=quantities)
    runs = [integrate(item, method=EIPDOP853).y[:, -1].reshape(2, 10, 3) for item in (problem, moved)]
    np.testing.assert_allclose(runs[0][:, order], runs[1], rtol=0, atol=2e-12)


def test_a_frame_does_what_neutral_directions_do():
    """A planet that moves alone, before all bodies are shifted, and one that the others move against."""
    problem = solar_system(years=12.0, h=1 / 256, balances="kepler")
    neutral = orbital_balances(problem.params, problem.y0, newton=True)
    assert [len(components[0]) for components, _ in problem.invariants[0].subspaces] == [1] * 9
    assert [len(components[0]) for components, _ in neutral[0].subspaces] == [10] * 9
    runs = [
        integrate(problem, method=EIPDOP853, **options)
        for options in ({}, {"invariants": neutral, "frame": None}, {"invariants": neutral})
    ]
    centre, _ = problem.frame
    drift = [centre @ (run.y[:, -1] - run.y[:, 0]) for run in runs]
    start = centre @ problem.y0
    for run, moved in zip(runs, drift, strict=True):
        np.testing.assert_allclose(moved[:3], 12 * start[3:], rtol=0, atol=2e-16)
        np.testing.assert_allclose(run.y[:30, -1], runs[0].y[:30, -1], rtol=0, atol=1e-13)


@pytest.mark.parametrize("quantities", ["kepler", ALL])
def test_directions_of_x_y_and_z_are_moved_together_as_they_are_one_by_one(quantities):
    problem = solar_system(years=2.0, h=1 / 256)
    items = orbital_balances(problem.params, problem.y0, quantities, newton=True)
    together = integrate(problem, method=EIPDOP853, invariants=items, frame=None)
    for item in items:  # directions in another order, of which no three are those of a body
        item.subspaces = tuple((components[::-1], weights[::-1]) for components, weights in item.subspaces)
    alone = integrate(problem, method=EIPDOP853, invariants=items, frame=None)
    np.testing.assert_allclose(together.y, alone.y, rtol=0, atol=4e-15)


@pytest.mark.parametrize("name", NAMES)
def test_sizes_that_do_not_fit_are_refused(name):
    function = library[name]

    def call(n, p):
        first = (0.0, np.ones(n), np.ones(n)) if function.takes_f else (0.0, np.ones(n))
        return function(*first, *([np.zeros(n * (n // 6 - 1))] if function.in_place else []), np.ones(p))

    for n, p in [(6, 1), (11, 3), (12, 2), (12, 4), (60, 10), (0, 0)]:
        with pytest.raises(ValueError, match="expects positions and velocities"):
            call(n, p)


@pytest.mark.parametrize(("name", "n"), [(name, n) for name in NAMES for n in (2, 3, 4, 5, 6, 10)])
def test_nothing_is_written_outside(name, n):
    function, (gm, q, v) = library[name], planets(n)
    y, params = np.concatenate([q.ravel(), v.ravel()]), np.r_[gm, np.zeros(n - 1)]
    first = (0.0, y, y[::-1].copy()) if function.takes_f else (0.0, y)
    if function.in_place:
        wide = np.full(6 * n * (n - 1) + 20, 7.0)
        function(*first, wide[10:-10], params)
        assert (wide[:10] == 7.0).all()
        assert (wide[-10:] == 7.0).all()
        assert np.isfinite(wide).all()
        assert np.count_nonzero(wide[10:-10]) == 12 * (n - 1)
    else:
        found = np.atleast_1d(function(*first, params))
        assert found.shape == (n - 1,)
        assert np.isfinite(found).all()
