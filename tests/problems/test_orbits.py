"""Orbits in systems of N bodies: their balances against mpmath, the choice of centres, and wrong input."""

import pickle

import mpmath
import numpy as np
import pytest

from eip_scipy import EIPDOP853, EIPGJ14, integrate
from eip_scipy.engine.native import library
from eip_scipy.problems import solar_data, solar_system
from eip_scipy.problems.gravity.nbody import common_shift
from eip_scipy.problems.gravity.orbits import centres, orbital_balances

EPS = np.finfo(float).eps
MP = mpmath.mp.clone()
MP.dps = 40
NAMES = [name for name in library if name.startswith("orbits.")]
QUANTITIES = ("energy", "momentum", "laplace")


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


@pytest.mark.parametrize(
    ("n", "seed", "moons"),
    [(n, seed, True) for n in (2, 3, 4, 5, 7, 12) for seed in (1, 2)]
    + [(n, 3, False) for n in (3, 4, 5, 6, 9, 10, 18)],
)
def test_values_gradients_and_rates_are_those_of_mpmath(n, seed, moons):
    gm, y0 = system(n, seed, moons)
    y = y0 * (1 + 1e-6 * np.random.default_rng(seed).normal(size=y0.size))
    a = floats(
        accelerations([MP.mpf(float(x)) for x in gm], np.array([MP.mpf(float(x)) for x in y[: 3 * n]]).reshape(-1, 3))
    )
    f = np.concatenate([y[3 * n :], a])
    right, start = exact(gm, y, y0), exact(gm, y0, y0)
    sizes = [
        (float(u @ u) + float(abs(e)), float(MP.sqrt(h @ h)), float(u @ u) * float(MP.sqrt(r @ r)))
        for (e, h, _), _, (r, u, _) in right
    ]
    strong = [float(MP.sqrt(u @ u)) for *_, (_, u, _) in right]
    pull = [float(MP.sqrt(sum(x * x for x in w))) for w in a.reshape(-1, 3)]
    for kind, quantity in enumerate(QUANTITIES):
        (balance,) = orbital_balances(gm, y0, quantity)
        (newton,) = orbital_balances(gm, y0, quantity, newton=True)
        side_by_side = kind == 0 and not (moons and n > 2)
        assert newton.fun.__name__ == ("planets" if side_by_side else "orbits") + f".{quantity}"
        each = 1 if kind == 0 else 3
        values = np.reshape(balance.fun(0.0, y), (-1, each))
        gradient = np.empty((each * (n - 1), 6 * n))
        balance.grad(0.0, y, f, gradient)
        rates, newton_rates = (np.reshape(b.rate(0.0, y, f), (-1, each)) for b in (balance, newton))
        for k, ((values_k, rates_k, (r, u, _)), (start_k, _, _)) in enumerate(zip(right, start, strict=True)):
            wanted = floats([values_k[kind]])
            if kind == 0:
                exact_change = float(values_k[0] - MP.mpf(float(start_k[0])))
                assert abs(values[k, 0] - exact_change) < EPS * abs(exact_change) + 1e-29 * sizes[k][0]
            else:
                assert np.abs(values[k] - wanted).max() < 20 * EPS * sizes[k][kind] * (1 + spread(y, r, u))
            scale = (strong[k], float(MP.sqrt(r @ r)), strong[k] * float(MP.sqrt(r @ r)))[kind]
            loose = 50 * EPS * scale * max(pull) * (1 + spread(y, r, u))
            assert np.abs(rates[k] - floats([rates_k[kind]])).max() < loose
            assert np.abs(newton_rates[k] - floats([rates_k[kind]])).max() < loose
        by_chain = np.reshape(gradient @ f, (-1, each))
        assert np.allclose(by_chain, rates, rtol=0, atol=1e-9 * np.abs(gradient).max() * np.abs(f).max())
        for component in range(0, 6 * n, max(1, n // 2)):
            step = np.zeros(6 * n)
            step[component] = 1e-4 * max(abs(y[component]), 1e-2) * (0.01 if n > 2 else 1.0)
            ahead, back = (np.ravel(balance.fun(0.0, y + s * step)) for s in (1, -1))
            far, farther = (np.ravel(balance.fun(0.0, y + s * step)) for s in (2, -2))
            slope = (8 * (ahead - back) - (far - farther)) / (12 * step[component])
            assert np.allclose(gradient[:, component], slope, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())


def spread(y, r, u):
    """Return the loss of digits in the difference of two positions and velocities."""
    q, v = y.reshape(2, -1)
    return np.abs(q).max() / float(MP.sqrt(r @ r)) + np.abs(v).max() / float(MP.sqrt(u @ u))


@pytest.mark.parametrize("data", ["de440", "de440-moon"])
@pytest.mark.parametrize("heaviest", [0, 3])
def test_rates_by_newtons_law_round_less(data, heaviest):
    """The star's pull cancels before it is rounded, also on a planet with a moon, and wherever the star is listed."""
    problem = solar_system(data, years=1)
    n = problem.params.size
    order = np.roll(np.arange(n), heaviest)
    gm, y = problem.params[order], problem.y0.reshape(2, n, 3)[:, order].ravel()
    right = floats([rates[0] for _, rates, _ in exact(gm, y, y)])
    f = np.concatenate(
        [
            y[3 * n :],
            floats(accelerations([MP.mpf(x) for x in gm], np.array([MP.mpf(x) for x in y[: 3 * n]]).reshape(-1, 3))),
        ]
    )
    by_f, by_law = (orbital_balances(gm, y, newton=newton)[0].rate(0.0, y, f) for newton in (False, True))
    errors = np.abs(by_f - right), np.abs(by_law - right)
    assert errors[1].sum() < 1e-3 * errors[0].sum()
    assert (errors[1] < 20 * EPS * np.abs(right) + 4e-16).all()


@pytest.mark.parametrize("n", [64, 65, 70])
def test_many_bodies(n):
    """Up to 64 bodies the masses and pulls of Newton's law are on the stack."""
    rng = np.random.default_rng(n)
    gm, y = np.concatenate([[40.0], rng.uniform(0, 1e-6, n - 1)]), rng.normal(size=6 * n)
    out = np.empty(6 * n)
    library["gravity.rhs"](0.0, y, out, gm)
    by_f, by_law = (orbital_balances(gm, y, newton=newton)[0].rate(0.0, y, out) for newton in (False, True))
    assert np.allclose(by_f, by_law, rtol=0, atol=1e-12 * np.abs(out).max())
    assert np.abs(by_law).max() > 0


def test_the_planets_move_about_the_sun():
    problem = solar_system(years=1)
    assert centres(problem.params, problem.y0).tolist() == [-1] + [0] * 9


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


def test_bodies_of_the_same_mass():
    gm, y = np.ones(3), np.random.default_rng(3).normal(size=18)
    assert centres(gm, y)[0] == -1
    assert np.isfinite(orbital_balances(gm, y)[0].fun(0.0, y)).all()


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ("kepler", ["energy"]),
        (["laplace", "energy", "kepler"], ["energy", "laplace"]),
        (("momentum",), ["momentum"]),
        ((), []),
    ],
)
def test_quantities(given, names):
    gm, y = system(4)
    assert [kept.name for kept in orbital_balances(gm, y, given)] == names


GM, Y = system(5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((GM, Y[:-1]), r"expected \(N,\) and \(6 N,\)"),
        ((GM[:, None], Y), r"expected \(N,\) and \(6 N,\)"),
        (([], []), r"N >= 2"),
        (([1.0], np.ones(6)), r"N >= 2"),
        ((GM * 1j, Y), "gm must be an array of numbers"),
        ((GM, ["x"] * 30), "y0 must be an array of numbers"),
        ((-GM, Y), "gm must hold finite numbers"),
        ((0 * GM, Y), "and at least one > 0"),
        ((GM * np.nan, Y), "gm must hold finite numbers"),
        ((GM, Y * np.inf), "y0 must be finite"),
        ((GM, Y, "enrgy"), "unknown quantity 'enrgy'.*did you mean 'energy'"),
        ((GM, Y, None), "unknown quantity None"),
        ((GM, Y, ["energy", 3]), "unknown quantity 3"),
        ((GM, Y, {"bodies": ["a", "b"]}), "bodies has 2 names, but gm has 5 masses"),
        ((GM, Y, {"newton": 1}), "newton must be True or False"),
    ],
)
def test_wrong_input(arguments, message):
    options = arguments[-1] if isinstance(arguments[-1], dict) else {}
    with pytest.raises(ValueError, match=message):
        orbital_balances(*arguments[: 2 if options else None], **options)


ORBIT = [0.0, 2.0, 0.0, -1.0, 1.0, 1.0]


def forged():
    """Return parameters of three bodies whose second orbit is not an orbit."""
    gm, wrong = [39.0, 1.0, 0.5], []
    for place, value in [(1, 1.0), (1, 4.0), (1, np.nan), (1, np.inf), (1, -3.0), (1, 1e300), (2, -1.0), (2, 3.0)]:
        wrong.append((place, value))
    wrong += [(4, value) for value in (np.nan, np.inf, -np.inf, 1e300, 3.0, -0.5)]
    for place, value in wrong:
        orbit = list(ORBIT)
        orbit[place] = value
        yield [*gm, *ORBIT, *orbit]
        yield [*gm, *orbit, *ORBIT]
    whole = [*gm, *ORBIT, *ORBIT]
    for length in range(4, len(whole)):
        yield whole[:length]


@pytest.mark.parametrize("name", NAMES)
def test_forged_parameters_give_nan_and_read_nothing_beyond(name):
    y = np.random.default_rng(5).normal(size=18)
    f = y[::-1].copy()
    rows = 2 * (1 if ".energy" in name else 3)
    for params in forged():
        function = library[name].bound(params)
        first = (0.0, y, f) if function.takes_f else (0.0, y)
        if function.in_place:
            out = np.zeros(18 * rows + 8)
            function(*first, out[:-8])
            assert np.isnan(out[:-8]).all()
            assert (out[-8:] == 0).all()
        else:
            assert np.isnan(function(*first)).all()
            assert function(*first).shape == (rows,)


def call(function, y, out=()):
    """Call a function of the library, with y in the place of f."""
    return function(0.0, y, *([y] if function.takes_f else []), *([np.zeros(out)] if function.in_place else []))


@pytest.mark.parametrize("name", NAMES)
def test_sizes_that_do_not_fit_are_refused(name):
    function = library[name]
    for size in (0, 6, 11, 17):
        with pytest.raises(ValueError, match="expects positions and velocities"):
            call(function.bound([*GM, *np.ones(10)]), np.zeros(size))
    with pytest.raises(ValueError, match="2 parameters"):
        call(function.bound([1.0, 2.0]), np.zeros(12))
    with pytest.raises(TypeError, match=r"arguments \(t, y.*\); got 1"):
        function.bound([1.0])(0.0)
    if function.in_place:
        with pytest.raises(ValueError, match="out has 1"):
            call(function.bound(np.ones(20)), np.zeros(12), 1)
    elif function.takes_f:
        with pytest.raises(ValueError, match="f has 11 numbers"):
            function.bound(np.ones(20))(0.0, np.zeros(12), np.zeros(11))


def test_balances_are_pickled():
    for balance in orbital_balances(GM, Y, QUANTITIES):
        again = pickle.loads(pickle.dumps(balance))
        assert again.value_names == balance.value_names
        assert np.array_equal(again.fun(0.0, Y), balance.fun(0.0, Y))
        for (components, weights), (found, found_weights) in zip(balance.subspaces, again.subspaces, strict=True):
            assert np.array_equal(components, found)
            assert np.array_equal(weights, found_weights)


def test_ten_bodies_over_a_century():
    """Positions after 100 years; Mercury's error is otherwise that of its energy, which grows quadratically."""
    problem = solar_system(years=100, h=1 / 500)
    names = solar_data.load("de440").bodies
    right = problem.reference(100.0)[:30]
    kept = orbital_balances(problem.params, problem.y0, newton=True, bodies=names)
    plain = integrate(problem, method=EIPGJ14, invariants=())
    run = integrate(problem, method=EIPGJ14, invariants=kept, frame=common_shift(problem.params))
    assert run.trusted
    errors, plain_errors = (np.linalg.norm((y[:30, -1] - right).reshape(10, 3), axis=1) for y in (run.y, plain.y))
    mercury = names.index("Mercury")
    assert plain_errors[mercury] > 1e-10
    assert errors[mercury] < 2e-12
    assert np.delete(errors, mercury).max() < 5e-13
    assert run.invariants.shape[0] == 9
    # Without a frame the balances keep the centre of mass by themselves.
    alone = integrate(problem, method=EIPGJ14, invariants=kept, frame=None)
    assert np.linalg.norm((alone.y[:30, -1] - right).reshape(10, 3), axis=1)[mercury] < 2e-12


def test_the_moon_over_five_years():
    """With the Moon's orbit about the Earth among the balances its error is fifty times smaller."""
    problem = solar_system("de440-moon", years=5)
    kept = orbital_balances(problem.params, problem.y0, newton=True)
    right = integrate(problem, method=EIPDOP853, h=0.0005, invariants=())
    plain, run = (integrate(problem, method=EIPDOP853, h=0.004, invariants=items) for items in ((), kept))
    assert run.trusted

    def error(found):
        earth, moon = (found.y[:33, -1] - right.y[:33, -1]).reshape(11, 3)[[3, 4]]
        return np.linalg.norm(moon - earth)

    assert 20 * error(run) < error(plain)
