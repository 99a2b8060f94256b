"""Hard problems: their starts, invariants and references; fictitious time."""

import math
import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numba import njit
from systems import refuse

from eip_scipy import EIPDOP853, EIPRK4, Invariant, check_gradient, hamiltonian, integrate, problems
from eip_scipy.problems import centre_time, figure_eight, harmonic, kepler, pair_time, pythagorean, time_transformed

TIGHT = {"method": EIPDOP853, "rtol": 1e-13, "atol": 1e-16}


def values(problem, y):
    return [np.atleast_1d(item.fun(0.0, y, *item.args)) for item in problem.invariants]


def distance(problem, y, t):
    half = y.size // 2
    return np.linalg.norm((y - problem.reference(t))[:half].reshape(-1, 3), axis=1).max()


def test_pythagorean_energy_and_momentum():
    problem = pythagorean()
    energy, momentum = values(problem, problem.y0)
    # G sum m_i m_j / r_ij over the sides 3, 4, 5: 12 / 5 + 15 / 4 + 20 / 3.
    assert energy[0] == pytest.approx(-769 / 60, rel=1e-15)
    assert np.all(momentum == 0)
    assert problem.reference(69.0) is None


def test_functions_of_invariants_take_their_own_parameters():
    """Kepler's energy v^2 / 2 - 1 / r and angular momentum, and their gradients, with parameters and without."""
    problem, y = kepler(relativistic=0), np.array([2.0, 0.0, 0.5, 0.25])
    H, L = problem.invariants
    assert (H.fun(0.0, y), L.fun(0.0, y)) == (0.5**2 / 2 + 0.25**2 / 2 - 0.5, 0.5)
    assert H.fun(0.0, y, problem.params + 0.1) != H.fun(0.0, y) == H.fun(0.0, y, problem.params)
    out, again = np.empty(4), np.empty(4)
    for given in ((), (problem.params,)):
        L.grad(0.0, y, out, *given)
        np.testing.assert_array_equal(out, [0.25, -0.5, 0.0, 2.0])
    f = problem.fun(0.0, y)
    same = Invariant(H.fun, H.grad, in_place=H.in_place, uses_f=H.uses_f)
    for item in (H, same):
        item.grad(0.0, y, *((f,) if H.uses_f else ()), again)
        np.testing.assert_allclose(again, [0.25, 0.0, 0.5, 0.25], rtol=1e-15)
    assert (same.args, same.function) == (H.args, H.function)
    runs = [integrate(problem, (0, 1), method=EIPRK4, h=0.1, invariants=items) for items in ((H, L), (same, L))]
    np.testing.assert_array_equal(runs[0].y, runs[1].y)
    assert pickle.loads(pickle.dumps(H.fun))(0.0, y) == H.fun(0.0, y)
    spring = hamiltonian("p**2/(2*m) + k*q**2/2", params={"m": 2.0, "k": 3.0})
    assert spring.invariants[0].fun(0.0, np.array([1.0, 2.0])) == 2.5
    assert spring.invariants[0].fun(0.0, np.array([1.0, 2.0]), np.array([1.0, 1.0])) == 2.5


@pytest.mark.needs_jit
def test_pythagorean_closest_approach_and_escape():
    problem = pythagorean()
    run = integrate(problem, (0, 20), save_every=1, **TIGHT)
    q = run.y[:9].reshape(3, 3, -1)
    pairs = {(i, j): np.linalg.norm(q[i] - q[j], axis=0) for i, j in ((0, 1), (0, 2), (1, 2))}
    closest = min(pairs, key=lambda pair: pairs[pair].min())
    k = pairs[closest].argmin()
    assert closest == (1, 2)
    assert run.t[k] == pytest.approx(15.83, abs=0.005)
    assert 3e-4 < pairs[closest][k] < 6e-4
    q, v = problem.reference(70.0).reshape(2, 3, 3)
    outwards = q[0] - (4 * q[1] + 5 * q[2]) / 9
    assert np.linalg.norm(outwards) > 20
    # Body 3 leaves for good: the energy of its motion relative to the binary's centre is positive.
    relative = v[0] - (4 * v[1] + 5 * v[2]) / 9
    assert 0.5 * relative @ relative - 12 / np.linalg.norm(outwards) > 0
    assert np.linalg.norm(q[1] - q[2]) < 2


def test_figure_eight_returns_and_has_no_momentum():
    problem = figure_eight(1)
    energy, momentum = values(problem, problem.y0)
    assert energy[0] == pytest.approx(-1.287142, abs=1e-6)
    assert np.abs(momentum).max() < 1e-16
    assert problem.t_span == (0.0, 6.32591398)
    assert np.abs(problem.reference(6.32591398) - problem.y0).max() < 2e-7


@pytest.mark.needs_jit
@pytest.mark.parametrize("periods", [1, 10])
def test_figure_eight_meets_its_reference(periods):
    problem = figure_eight(periods)
    run = integrate(problem, first_step=1e-3, **TIGHT)
    assert distance(problem, run.y[:, -1], problem.t_span[1]) < 1e-11


@pytest.mark.needs_jit
def test_comet_passes_jupiter_and_is_thrown_out():
    problem = problems.comet()
    run = integrate(problem, save_every=1, **TIGHT)
    q, v = run.y.reshape(2, 4, 3, -1)
    apart = np.linalg.norm(q[3] - q[1], axis=0)
    k = apart.argmin()
    assert run.t[k] == pytest.approx(10.0, abs=1e-4)
    assert apart[k] * problems.solar_data.AU_KM / 71492 == pytest.approx(3.0, abs=0.01)
    axes = []
    for column in (0, -1):
        relative = v[3, :, column] - v[0, :, column]
        energy = 0.5 * relative @ relative - problem.params[0] / np.linalg.norm(q[3, :, column] - q[0, :, column])
        axes.append(-problem.params[0] / 2 / energy)
    assert axes[0] == pytest.approx(3.17, abs=0.01)
    assert axes[1] == pytest.approx(502, abs=1)
    assert distance(problem, run.y[:, -1], 20.0) < 1e-7
    centre = problem.linear_invariants[0] @ problem.y0
    assert np.abs(centre).max() < 1e-15


@pytest.mark.slow
@pytest.mark.needs_jit
def test_pythagorean_to_its_end():
    problem = pythagorean()
    kept = integrate(problem, **TIGHT)
    plain = integrate(problem, invariants=(), **TIGHT)
    assert distance(problem, kept.y[:, -1], 70.0) < 5e-3
    assert distance(problem, plain.y[:, -1], 70.0) > 5 * distance(problem, kept.y[:, -1], 70.0)


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    ("make", "g"),
    [
        (lambda: kepler(0.6, 0.0), centre_time),
        pytest.param(pythagorean, pair_time, marks=pytest.mark.nightly),
    ],
)
def test_transformed_problem_has_the_same_invariants(make, g):
    problem = make()
    other = time_transformed(problem, 1.0, g)
    rng = np.random.default_rng(1)
    y = np.append(problem.y0 + 0.1 * rng.standard_normal(problem.y0.size), 3.0)
    out = np.empty_like(y)
    other.rhs(0.0, y, out, other.params)
    weight = g(y[:-1], problem.params)
    assert out[-1] == weight
    np.testing.assert_allclose(out[:-1], weight * problem.fun(3.0, y[:-1]), rtol=1e-14)
    for before, after in zip(values(problem, y[:-1]), values(other, y), strict=True):
        np.testing.assert_array_equal(before, after)
    for item in other.invariants:
        assert check_gradient(item, 0.0, y, fun=other.fun) < 1e-6


@pytest.mark.needs_jit
@pytest.mark.parametrize("forces", ["j2", pytest.param("1pn", marks=pytest.mark.nightly)])
def test_fictitious_time_of_problems_whose_parameters_are_more_than_the_masses(forces):
    problem = problems.solar_system(years=1, forces=forces)
    run = integrate(time_transformed(problem, 1e6), method=EIPDOP853, h=0.05, events=problems.reaches(1.0))
    assert run.success
    truth = integrate(problem, method=EIPDOP853, h=1 / 400)
    np.testing.assert_allclose(run.y[:-1, -1], truth.y[:, -1], rtol=0, atol=1e-9)


@pytest.mark.needs_jit
def test_circular_orbit_takes_two_pi():
    problem = kepler(0.0, 0.0)
    run = integrate(time_transformed(problem, 2 * math.pi, centre_time), method=EIPRK4, h=0.01)
    assert run.y[-1, -1] == pytest.approx(2 * math.pi, abs=1e-8)
    one, gm = kepler(0.9, 0.0), np.array([0.5, 0.5])
    q, v = np.pad(one.y0.reshape(2, 1, 2) / 2, ((0, 0), (0, 0), (0, 1)))  # two bodies around their centre
    pair = np.concatenate([q, -q, v, -v]).ravel()
    assert pair_time(pair, gm) == pytest.approx(centre_time(one.y0, one.params), rel=1e-14)


@pytest.mark.needs_jit
def test_fictitious_time_with_invariants_of_a_user():
    """Without a gradient, and with one that is returned."""
    energy = njit(lambda t, y, params: 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.hypot(y[0], y[1]))
    slope = njit(lambda t, y, params: y[::-1] * np.array([1, -1, -1, 1]))
    momentum = Invariant(njit(lambda t, y, params: y[0] * y[3] - y[1] * y[2]), slope)
    problem = replace(kepler(0.9, 0.0), invariants=(energy, momentum))
    run = integrate(time_transformed(problem, 50.0, centre_time), method=EIPRK4, h=0.02)
    assert run.compiled
    assert run.max_residual.max() < 1e-13


def test_what_is_refused():
    wrong = {"rhs": "has no compiled right-hand side", "y0": "has no y0 or no t_span"}
    rows = [({"problem": replace(harmonic(), **{name: None})}, ValueError, words) for name, words in wrong.items()]
    refuse(partial(time_transformed, s_end=1.0), rows)
    periods = 0, -1.0, math.inf, math.nan
    refuse(figure_eight, [({"periods": n}, ValueError, "periods must be positive and finite") for n in periods])
