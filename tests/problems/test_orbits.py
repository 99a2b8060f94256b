"""Balances of orbits: values and rates against mpmath, the choice of centres, their runs, and wrong input."""

import pickle

import mpmath
import numpy as np
import pytest

from eip_scipy import EIPDOP853, EIPGJ14, EIPRK4, EIPRKN12, Balance, integrate
from eip_scipy.engine.native import library
from eip_scipy.problems import nbody, orbital_balances, solar_data, solar_system
from eip_scipy.problems.gravity.orbits import centres

EPS = np.finfo(float).eps
MP = mpmath.mp.clone()
MP.dps = 40
ALL = ("energy", "momentum", "laplace")


def system(n, seed=0, moons=True):
    """A star, a planet, two moons of it or none, a test particle of mass 0, further planets: the first n of them."""
    rng = np.random.default_rng(seed)
    gm, q, v = [40.0], [rng.normal(size=3)], [rng.normal(size=3)]

    def add(mass, centre, distance):
        a, b, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
        gm.append(mass)
        q.append(q[centre] + distance * a)
        v.append(v[centre] + np.sqrt(gm[centre] / distance) * (rng.uniform(0.95, 1.05) * b + 0.05 * a))

    add(1e-2, 0, 1.0)
    for kind in range(n - 2) if moons else range(2, n):
        if kind < 2:
            add(1e-7 if kind else 1e-5, 1, (0.005, 0.01)[kind])
        elif kind == 2:
            add(0.0, 0, 2.3)
        else:
            add(10 ** rng.uniform(-5, -2), 0, 1.5 * kind)
    return np.array(gm), np.concatenate([*q, *v])


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


def groups(gm, y0):
    about = centres(gm, y0)

    def below(k, top):
        return k == top or (about[k] >= 0 and below(about[k], top))

    return [(k, int(about[k]), [j for j in range(gm.size) if below(j, k)]) for k in range(gm.size) if about[k] >= 0]


def accelerations(gm, q):
    """Return Newton's accelerations, in mpmath; q (N, 3) of mpmath numbers."""
    n, out = len(gm), np.array([[MP.mpf(0)] * 3 for _ in gm])
    for i in range(n):
        for j in range(n):
            if i != j:
                d = q[j] - q[i]
                out[i] = out[i] + gm[j] * d / MP.sqrt(d @ d) ** 3
    return out


def exact(gm, y, y0):
    """Return the values of each orbit, and their rates by Newton's law, in mpmath."""
    big = np.array([MP.mpf(float(x)) for x in gm])
    q, v = np.array([MP.mpf(float(x)) for x in y]).reshape(2, -1, 3)
    a = accelerations(big, q)
    found = []
    for _, centre, group in groups(gm, y0):
        total = float(gm[group].sum())
        shares = [MP.mpf(float(s)) for s in (gm[group] / total if total else np.ones(1))]
        shares[0] = 1 - sum(shares[1:])
        r, u, w = (sum(s * x[k] for s, k in zip(shares, group, strict=True)) - x[centre] for x in (q, v, a))
        mu, length = sum(big[k] for k in [centre, *group]), MP.sqrt(r @ r)
        P = w + mu * r / length**3
        energy, h = (u @ u) / 2 - mu / length, cross(r, u)
        laplace = cross(u, h) - mu * r / length
        rates = u @ P, cross(r, P), cross(P, h) + cross(u, cross(r, P))
        found.append(((energy, h, laplace), rates, (r, u, P)))
    return found


def cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def floats(values):
    return np.array([float(x) for value in values for x in np.atleast_1d(value)])


def derivative(gm, y):
    """Return the right-hand side, computed by mpmath."""
    half = y.size // 2
    q = np.array([MP.mpf(float(x)) for x in y[:half]]).reshape(-1, 3)
    return np.concatenate([y[half:], floats(accelerations([MP.mpf(float(x)) for x in gm], q))])


def spread(y, r, u):
    """Return the loss of digits in the difference of two positions and velocities."""
    q, v = y.reshape(2, -1)
    return np.abs(q).max() / float(MP.sqrt(r @ r)) + np.abs(v).max() / float(MP.sqrt(u @ u))


@pytest.mark.parametrize(
    ("n", "moons"), [*((n, True) for n in (3, 4, 5, 7, 12)), *((n, False) for n in (2, 4, 5, 6, 9, 10, 18))]
)
def test_values_gradients_and_rates_are_those_of_mpmath(n, moons):
    gm, y0 = system(n, n, moons)
    y = y0 * (1 + 1e-6 * np.random.default_rng(n).normal(size=y0.size))
    f = derivative(gm, y)
    pull = np.linalg.norm(f[3 * n :].reshape(-1, 3), axis=1).max()
    right, start = exact(gm, y, y0), exact(gm, y0, y0)
    for kind, quantity in enumerate(ALL):
        (balance,) = orbital_balances(gm, y0, quantity)
        (newton,) = orbital_balances(gm, y0, quantity, newton=True)
        assert newton.fun.__name__ == ("planets" if kind == 0 and not (moons and n > 2) else "orbits") + f".{quantity}"
        each, gradient = (1 if kind == 0 else 3), np.empty(((1 if kind == 0 else 3) * (n - 1), 6 * n))
        values = np.reshape(balance.fun(0.0, y), (-1, each))
        balance.grad(0.0, y, f, gradient)
        rates, by_law = (np.reshape(b.rate(0.0, y, f), (-1, each)) for b in (balance, newton))
        for k, ((values_k, rates_k, (r, u, _)), (start_k, _, _)) in enumerate(zip(right, start, strict=True)):
            (e, h, _), distance, speed = values_k, float(MP.sqrt(r @ r)), float(MP.sqrt(u @ u))
            size = (speed**2 + float(abs(e)), float(MP.sqrt(h @ h)), speed**2 * distance)[kind]
            if kind == 0:
                change = float(e - MP.mpf(float(start_k[0])))
                assert abs(values[k, 0] - change) < EPS * abs(change) + 1e-29 * size
            else:
                assert np.abs(values[k] - floats([values_k[kind]])).max() < 20 * EPS * size * (1 + spread(y, r, u))
            loose = 50 * EPS * (speed, distance, speed * distance)[kind] * pull * (1 + spread(y, r, u))
            for found in (rates, by_law):
                assert np.abs(found[k] - floats([rates_k[kind]])).max() < loose
        by_chain = np.reshape(gradient @ f, (-1, each))
        assert np.allclose(by_chain, rates, rtol=0, atol=1e-9 * np.abs(gradient).max() * np.abs(f).max())
        for component in range(0, 6 * n, max(1, n // 2)):
            step = np.zeros(6 * n)
            step[component] = 1e-4 * max(abs(y[component]), 1e-2) * (0.01 if n > 2 else 1.0)
            ahead, back, far, farther = (np.ravel(balance.fun(0.0, y + s * step)) for s in (1, -1, 2, -2))
            slope = (8 * (ahead - back) - (far - farther)) / (12 * step[component])
            assert np.allclose(gradient[:, component], slope, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("data", ["de440", "de440-moon"])
def test_rates_by_newtons_law_round_less(data):
    """The star's pull cancels before it is rounded, also on a planet with a moon, and wherever the star is listed."""
    problem = solar_system(data, years=1)
    n = problem.params.size
    for heaviest in (0, 3):
        order = np.roll(np.arange(n), heaviest)
        gm, y = problem.params[order], problem.y0.reshape(2, n, 3)[:, order].ravel()
        right, f = floats([rates[0] for _, rates, _ in exact(gm, y, y)]), derivative(gm, y)
        by_f, by_law = (orbital_balances(gm, y, newton=newton)[0].rate(0.0, y, f) for newton in (False, True))
        errors = np.abs(by_f - right), np.abs(by_law - right)
        assert errors[1].sum() < 1e-3 * errors[0].sum()
        assert (errors[1] < 20 * EPS * np.abs(right) + 4e-16).all()


def test_many_bodies():
    """Up to 64 bodies the masses and pulls of Newton's law are on the stack."""
    for n in (64, 65, 70):
        rng = np.random.default_rng(n)
        gm, y, out = np.r_[40.0, rng.uniform(0, 1e-6, n - 1)], rng.normal(size=6 * n), np.empty(6 * n)
        library["gravity.rhs"](0.0, y, out, gm)
        by_f, by_law = (orbital_balances(gm, y, newton=newton)[0].rate(0.0, y, out) for newton in (False, True))
        assert np.allclose(by_f, by_law, rtol=0, atol=1e-12 * np.abs(out).max())
        assert np.abs(by_law).max() > 0


def test_the_moon_moves_about_the_earth():
    problem = solar_system("de440-moon", years=1)
    bodies = list(solar_data.load("de440-moon").bodies)
    earth, moon = bodies.index("Earth"), bodies.index("Moon")
    about = centres(problem.params, problem.y0)
    expected = np.where(np.arange(len(bodies)) == bodies.index("Sun"), -1, bodies.index("Sun"))
    expected[moon] = earth
    assert np.array_equal(about, expected)
    (kept,) = orbital_balances(problem.params, problem.y0, bodies=bodies)
    assert "energy of Moon" in kept.value_names
    assert len(kept.value_names) == len(bodies) - 1
    components, weights = kept.subspaces[kept.value_names.index("energy of Moon")]
    assert components[:3].tolist() == [[3 * earth + c, 3 * moon + c] for c in range(3)]
    assert np.allclose(weights[:, 0] * problem.params[earth], -weights[:, 1] * problem.params[moon], rtol=1e-14)


def test_moons_of_moons_and_a_passing_body():
    """Star, planet, moon, moon of the moon, and a body within the planet's Hill sphere that is too fast to be bound."""
    gm = np.array([40.0, 1e-1, 1e-4, 1e-9, 1e-8])
    q, v = np.zeros((2, 5, 3))
    q[1:, 0] = 1.0, 1.02, 1.0205, 1.0
    q[4, 1] = 0.02
    v[1:, 1] = np.sqrt(40.1) + np.array([0, np.sqrt(5.0), np.sqrt(5.0) + np.sqrt(1e-4 / 5e-4), 0])
    v[4, 2] = 20.0
    y = np.concatenate([q.ravel(), v.ravel()])
    assert centres(gm, y).tolist() == [-1, 0, 1, 2, 0]
    for order in ([4, 3, 2, 1, 0], [2, 0, 4, 1, 3]):
        place = np.argsort(order)
        shuffled = np.concatenate([q[order].ravel(), v[order].ravel()])
        expected = [-1 if k == 0 else place[[0, 0, 1, 2, 0][k]] for k in order]
        assert centres(gm[order], shuffled).tolist() == expected
    (kept,) = orbital_balances(gm, y)
    for body, moving, staying in [(1, [1, 2, 3], [0, 4]), (2, [2, 3], [1]), (3, [3], [2]), (4, [4], [0, 1, 2, 3])]:
        components, weights = kept.subspaces[kept.value_names.index(f"energy of {body}")]
        along = dict(zip(components[0] // 3, weights[0], strict=True))
        assert sorted(along) == sorted(moving + staying)
        assert all(along[k] > 0 for k in moving)
        assert all(along[k] < 0 for k in staying)
        assert abs(sum(gm[k] * along[k] for k in along)) < 1e-15  # the centre of mass stays


@pytest.mark.parametrize(
    ("distance", "speed", "bound"), [(0.9, 0.0, True), (1.1, 0.0, False), (0.5, 0.95, True), (0.5, 1.05, False)]
)
def test_a_moon_is_inside_the_hill_sphere_and_slower_than_escape(distance, speed, bound):
    """In units of a (m / 3 M)^(1/3) of the planet and of the moon's speed of escape."""
    gm, hill = np.array([1.0, 1e-3, 1e-9]), (1e-3 / 3) ** (1 / 3)
    q, v = np.zeros((2, 3, 3))
    q[1:, 0] = 1.0, 1.0 + distance * hill
    v[1:, 1] = 1.0, 1.0 + speed * np.sqrt(2e-3 / (distance * hill))
    assert centres(gm, np.concatenate([q.ravel(), v.ravel()])).tolist() == [-1, 0, 1 if bound else 0]


def test_quantities_and_bodies_of_the_same_mass():
    gm, y = system(4)
    for given, names in [("kepler", ["energy"]), (["laplace", "energy", "kepler"], ["energy", "laplace"]), ((), [])]:
        assert [kept.name for kept in orbital_balances(gm, y, given)] == names
    gm, y = np.ones(3), np.random.default_rng(3).normal(size=18)
    assert centres(gm, y)[0] == -1
    assert np.isfinite(orbital_balances(gm, y)[0].fun(0.0, y)).all()


def test_balances_are_pickled():
    for balance in orbital_balances(GM, Y, ALL):
        again = pickle.loads(pickle.dumps(balance))
        assert again.value_names == balance.value_names
        np.testing.assert_array_equal(again.fun(0.0, Y), balance.fun(0.0, Y))
        for one, other in zip(balance.subspaces, again.subspaces, strict=True):
            np.testing.assert_array_equal(one[0], other[0])
            np.testing.assert_array_equal(one[1], other[1])


GM, Y = system(5)
WRONG = [
    ((GM, Y[:-1]), {}, r"expected \(N,\) and \(6 N,\)"),
    ((GM[:, None], Y), {}, r"expected \(N,\) and \(6 N,\)"),
    (([1.0], np.ones(6)), {}, r"N >= 2"),
    ((GM * 1j, Y), {}, "gm must be an array of numbers"),
    ((GM, ["x"] * 30), {}, "y0 must be an array of numbers"),
    *(((gm, Y), {}, "gm must hold finite numbers .*at least one > 0") for gm in (-GM, 0 * GM, GM * np.nan)),
    ((GM, Y * np.inf), {}, "y0 must be finite"),
    ((GM, Y, "enrgy"), {}, "unknown quantity 'enrgy'.*did you mean 'energy'"),
    *(((GM, Y, given), {}, "unknown quantity") for given in (None, ["energy", 3])),
    ((GM, Y), {"bodies": ["a", "b"]}, "bodies has 2 names, but gm has 5 masses"),
    ((GM, Y), {"newton": 1}, "newton must be True or False"),
]


def test_wrong_input():
    for arguments, options, message in WRONG:
        with pytest.raises(ValueError, match=message):
            orbital_balances(*arguments, **options)
    with pytest.raises(ValueError, match="unknown quantity 'enrgy'; known: 'kepler', 'energy'"):
        nbody([1.0, 1e-3], np.eye(2, 3), np.eye(2, 3)[:, ::-1], t_span=(0, 1), balances="enrgy")
    with pytest.raises(ValueError, match="does not carry a Balance"):
        integrate(solar_system(years=1.0, balances="kepler"), method=EIPRKN12, h=1 / 64)


ORBIT = [0.0, 2.0, 0.0, -1.0, 1.0, 1.0]
NOT_AN_ORBIT = {1: (1.0, 4.0, np.nan, np.inf, -3.0, 1e300), 2: (-1.0, 3.0), 4: (np.nan, np.inf, -np.inf, 3.0, -0.5)}


def forged():
    """Return parameters of three bodies whose second orbit is not an orbit, or that are too few."""
    gm = [39.0, 1.0, 0.5]
    for place, value in ((place, value) for place, values in NOT_AN_ORBIT.items() for value in values):
        orbit = [*ORBIT[:place], value, *ORBIT[place + 1 :]]
        yield from ([*gm, *ORBIT, *orbit], [*gm, *orbit, *ORBIT])
    for length in range(4, 15):
        yield [*gm, *ORBIT, *ORBIT][:length]


def called(bound, y, rows):
    """Return the values of a function of the library, for a state whose derivative is reversed; none is outside."""
    wide = np.full(rows + 20, 7.0)
    found = bound(0.0, y, *([y[::-1].copy()] if bound.takes_f else []), *([wide[10:-10]] if bound.in_place else []))
    assert (np.delete(wide, np.s_[10:-10]) == 7.0).all()
    return wide[10:-10] if bound.in_place else np.atleast_1d(found)


@pytest.mark.parametrize("name", [name for name in library if name.startswith(("orbits.", "planets."))])
def test_functions_read_and_write_nothing_beyond_their_arrays(name):
    function, each = library[name], 1 if ".energy" in name else 3
    planar, y = name.startswith("planets."), np.random.default_rng(5).normal(size=18)
    for params in () if planar else forged():
        assert np.isnan(called(function.bound(params), y, 36 * each)).all()
    for n in (2, 3, 4, 5, 6, 10) if planar else ():
        gm, q, v = planets(n)
        found = called(function.bound(np.r_[gm, np.zeros(n - 1)]), np.concatenate([q, v], axis=None), 6 * n * (n - 1))
        assert np.isfinite(found).all()
        assert np.count_nonzero(found) == 12 * (n - 1) if function.in_place else found.size == n - 1
    wrong = [(6, 1), (11, 3), (12, 2), (12, 4), (60, 10)] if planar else [(n, 15) for n in (0, 6, 11, 17)]
    for n, p in wrong:
        with pytest.raises(ValueError, match="expects positions and velocities"):
            called(function.bound(np.ones(p)), np.ones(n), n)
    with pytest.raises(TypeError, match=r"arguments \(t, y.*\); got 1"):
        function.bound([1.0])(0.0)


# Derivatives and rates in one pass over the pairs, and in two. Sizes: all ways of pair_sums.hpp.


def in_python(balance):
    """Return the same balance, whose functions are called from Python, and so its rates apart from the derivative."""
    fun, rate, grad = balance.fun, balance.rate, balance.grad
    functions = (lambda t, y: fun(t, y)), (lambda t, y, f: rate(t, y, f)), (lambda t, y, f, out: grad(t, y, f, out))
    found = Balance(*functions, size=balance.size, name=balance.name, in_place=True, uses_f=True)
    found.subspaces, found.most_slowness = balance.subspaces, balance.most_slowness
    return found


@pytest.mark.parametrize("n", [2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 16, 17, 18, 26, 131])
def test_rates_of_the_same_pass_and_of_a_pass_of_their_own_have_the_same_bits(n):
    for method, h in ((EIPDOP853, 0.02), (EIPGJ14, 0.002)):
        problem = nbody(*planets(n), t_span=(0.0, 50 * h), h=h, balances="kepler")
        alone = integrate(problem, method=method, invariants=(), compensated=True).y
        kept = integrate(problem, method=method, every=1000, compensated=True)
        np.testing.assert_array_equal(kept.y[:, :-1], alone[:, :-1])
        assert kept.diagnostics.n_projections == 1  # of the last state
        for heaviest in (0, 1):
            gm, q, v = planets(n, heaviest)
            y0 = np.concatenate([q, v], axis=None)
            items = orbital_balances(gm, y0, ALL if n < 6 else "kepler", newton=True)
            options = {"t_span": (0.0, 40 * h), "h": h, "y0": y0, "method": method, "linear_invariants": None}
            acc = library["gravity.acc"]
            fused = integrate(acceleration=acc, params=gm, invariants=items, **options)
            items = [in_python(item) for item in items]
            apart = integrate(acceleration=lambda t, q, gm=gm, acc=acc: acc(t, q, gm), invariants=items, **options)
            assert (fused.calls["acceleration"], apart.calls["acceleration"]) == ("native", "python")
            np.testing.assert_array_equal(fused.y, apart.y)
            np.testing.assert_array_equal(fused.invariants, apart.invariants)


@pytest.mark.parametrize("quantities", ["kepler", ALL])
def test_other_orders_of_bodies_and_of_directions_change_nothing(quantities):
    """With the Sun first the functions for planets are used, with the Sun in the middle those for orbits."""
    problem, order = solar_system(years=5.0, h=1 / 256, balances=quantities), np.r_[1:4, 0, 4:10]
    q, v = problem.y0.reshape(2, 10, 3)[:, order]
    moved = nbody(problem.params[order], q, v, t_span=problem.t_span, h=problem.h, balances=quantities)
    runs = [integrate(item, method=EIPDOP853).y[:, -1].reshape(2, 10, 3) for item in (problem, moved)]
    np.testing.assert_allclose(runs[0][:, order], runs[1], rtol=0, atol=2e-12)
    items = orbital_balances(problem.params, problem.y0, quantities, newton=True)
    together = integrate(problem, (0, 2), method=EIPDOP853, invariants=items, linear_invariants=None)
    for item in items:  # directions in another order, of which no three are those of a body
        item.subspaces = tuple((components[::-1], weights[::-1]) for components, weights in item.subspaces)
    alone = integrate(problem, (0, 2), method=EIPDOP853, invariants=items, linear_invariants=None)
    np.testing.assert_allclose(together.y, alone.y, rtol=0, atol=4e-15)


def test_a_frame_does_what_neutral_directions_do():
    """A planet that moves alone, before all bodies are shifted, and one that the others move against."""
    problem = solar_system(years=12.0, h=1 / 256, balances="kepler")
    neutral = orbital_balances(problem.params, problem.y0, newton=True)
    for items, count in ((problem.invariants, 1), (neutral, 10)):
        assert [len(components[0]) for components, _ in items[0].subspaces] == [count] * 9
    choices = {}, {"invariants": neutral, "linear_invariants": None}, {"invariants": neutral}
    runs = [integrate(problem, method=EIPDOP853, **options) for options in choices]
    for run in runs:
        moved = problem.linear_invariants[0] @ (run.y[:, -1] - run.y[:, 0])
        np.testing.assert_allclose(moved[:3], 12 * (problem.linear_invariants[0] @ problem.y0)[3:], rtol=0, atol=2e-16)
        np.testing.assert_allclose(run.y[:30, -1], runs[0].y[:30, -1], rtol=0, atol=1e-13)
    run = runs[0]
    assert tuple(run.diagnostics.names[:2]) == ("energy of Mercury", "energy of Venus")
    assert run.trusted
    np.testing.assert_allclose(run.invariants[:, 0], 0.0, atol=1e-14)  # the energies less those at the start


def errors(problem, run):
    """Return distances of Mercury, and of the worst of the others, from the state that was computed in 80 bits."""
    apart = np.linalg.norm((run.y[:, -1] - problem.reference(100.0))[:30].reshape(10, 3), axis=1)
    return apart[1], apart[2:].max()


@pytest.mark.parametrize(
    ("method", "h", "balances", "mercury", "others", "gain"),
    [
        (EIPGJ14, 1 / 512, "kepler", 4e-13, 5e-14, 500),
        (EIPDOP853, 1 / 256, "kepler", 9e-10, 1e-12, 200),
        (EIPDOP853, 1 / 256, ALL, 3e-10, 6e-13, 700),
        (EIPRK4, 1 / 512, ALL, 5e-5, 3e-7, 1000),
    ],
)
def test_a_hundred_years(method, h, balances, mercury, others, gain):
    problem = solar_system(years=100.0, balances=balances)
    run = integrate(problem, method=method, h=h)
    kept, plain = errors(problem, run), errors(problem, integrate(problem, method=method, h=h, invariants=()))
    assert kept[0] < mercury
    assert kept[1] < others
    assert gain * kept[0] < plain[0]
    if method is EIPGJ14:  # totals stay at rounding, though nothing projects them
        energy, momentum = (np.array([item.fun(0, y) for y in run.y.T]) for item in solar_system().invariants)
        assert abs(energy[1] / energy[0] - 1) < 1e-14
        np.testing.assert_allclose(momentum[1], momentum[0], rtol=0, atol=1e-14 * np.linalg.norm(momentum[0]))
