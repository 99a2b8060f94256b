"""Forces other than Newton's: against independent formulas in NumPy and mpmath, and against observations."""

import math
import warnings
from dataclasses import replace
from itertools import combinations, permutations

import mpmath
import numpy as np
import pytest
from closed_forms import kepler_state
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from systems import AU_KM, DAY_S

from eip_scipy import EIPDOP853, EIPRK5, EIPRKN12, check_gradient, integrate
from eip_scipy.problems import ForceConstants, figure_eight, nbody, pythagorean, solar_data, solar_system

OVER_C2, OBLATENESS, POLE_ENTRY, MOON_BODY, MOON_ENTRY = 1, 2, 3, 6, 7  # entries of the parameters behind the masses
GM = np.array([1.0, 0.3, 0.02, 0.4])
POSITION = np.array([[0.1, 0.2, -0.1], [1.3, 0.4, 0.2], [-0.6, 1.1, 0.5], [-1.2, -0.9, 0.8]])
VELOCITY = np.array([[0.1, -0.2, 0.05], [-0.2, 0.6, 0.1], [-0.5, -0.3, 0.2], [0.3, -0.3, -0.1]])
POLE = np.array([1.0, 2.0, 3.0]) / math.sqrt(14)
CONSTANTS = ForceConstants(c=10.0, j2=0.02, pole=3 * POLE, moon_body=2, moon=0.03)
C_AU_YR = 299792.458 * DAY_S * 365.25 / AU_KM
MERCURY = {"a": 0.38709893, "e": 0.20563069}  # J2000
GM_SUN = (0.01720209895 * 365.25) ** 2  # Gauss
CENTURY = 100.0


def problem(forces, constants=CONSTANTS, gm=GM, position=POSITION, velocity=VELOCITY, **options):
    return nbody(gm, position, velocity, t_span=(0.0, 1.0), forces=forces, constants=constants, **options)


def accelerations(given):
    out = np.empty_like(given.y0)
    given.rhs(0.0, given.y0, out, given.params)
    np.testing.assert_array_equal(out[: out.size // 2], given.y0[out.size // 2 :])
    return out[out.size // 2 :].reshape(-1, 3)


def added(forces, **options):
    """Return the accelerations that the forces add to Newton's."""
    return accelerations(problem(forces, **options)) - accelerations(problem(()))


def gradient(invariant, given):
    """Return the rows (k, 6 N) of the gradient at the start."""
    f, k = given.fun(0.0, given.y0), np.size(invariant.fun(0.0, given.y0, given.params))
    out = np.empty((k, given.y0.size) if k > 1 else given.y0.size)
    invariant.grad(0.0, given.y0, *([f] if invariant.uses_f else []), out, given.params)
    return np.atleast_2d(out)


def rate(invariant, given):
    """Return |dI/dt| in units of its terms."""
    G, f = gradient(invariant, given), given.fun(0.0, given.y0)
    return np.max(np.abs(G @ f) / (np.abs(G) @ np.abs(f)))


# --- the accelerations ---


def test_newton_alone_is_untouched():
    plain, chosen = nbody(GM, POSITION, VELOCITY, t_span=(0.0, 1.0)), problem(())
    assert (chosen.rhs, chosen.acc) == (plain.rhs, plain.acc)
    np.testing.assert_array_equal(plain.params, GM)


def potential(name, q):
    """Return the potential energies times G, in mpmath."""
    total = mpmath.mpf(0)
    for i in range(1, 4):
        x = [q[3 * i + c] - q[c] for c in range(3)]
        r = mpmath.sqrt(sum(a * a for a in x))
        if name == "gr-potential":
            total += -3 * mpmath.mpf(GM[0]) ** 2 * GM[i] / (mpmath.mpf(CONSTANTS.c) ** 2 * r**2)
        elif name == "j2":
            sine = sum(mpmath.mpf(p) * a for p, a in zip(POLE, x, strict=True)) / r
            total += GM[0] * GM[i] * CONSTANTS.j2 / r**3 * (3 * sine**2 - 1) / 2
        elif i == CONSTANTS.moon_body:
            total += -CONSTANTS.moon * GM[0] * GM[i] / r**3
    return total


@pytest.mark.parametrize("name", ["gr-potential", "j2", "moon-quadrupole"])
def test_accelerations_come_from_the_potential(name):
    found, q = added((name,)), POSITION.ravel()
    with mpmath.workdps(40):
        for k in range(12):
            step = mpmath.mpf(10) ** -12
            ends = [[mpmath.mpf(x) + (s * step if j == k else 0) for j, x in enumerate(q)] for s in (1, -1)]
            force = -(potential(name, ends[0]) - potential(name, ends[1])) / (2 * step)
            assert found.ravel()[k] == pytest.approx(float(force / mpmath.mpf(GM[k // 3])), rel=1e-12, abs=1e-15)
    given = problem((name,))
    newton = problem(())
    more = given.invariants[0].fun(0.0, given.y0, given.params) - newton.invariants[0].fun(0.0, newton.y0, GM)
    assert more == pytest.approx(float(potential(name, [mpmath.mpf(x) for x in q])), rel=1e-12)
    np.testing.assert_allclose(given.acc(0.0, given.y0[:12], given.params), accelerations(given).ravel(), rtol=1e-15)


def test_the_suns_post_newtonian_pull():
    """Return the formula of the IERS conventions (10.12) with beta = gamma = 1, and the reaction on the Sun."""
    expected = np.zeros((4, 3))
    for i in (1, 2, 3):
        r, v = POSITION[i] - POSITION[0], VELOCITY[i] - VELOCITY[0]
        d = np.linalg.norm(r)
        expected[i] = GM[0] / (CONSTANTS.c**2 * d**3) * ((4 * GM[0] / d - v @ v) * r + 4 * (r @ v) * v)
    expected[0] = -(GM[1:] @ expected[1:]) / GM[0]
    np.testing.assert_allclose(added("1pn"), expected, rtol=1e-12, atol=1e-15)


def einstein_infeld_hoffmann(q, v, gm, c):
    """Return what relativity adds to Newton's accelerations, as printed by Moyer (2003), equation 4-26."""
    d = {(i, j): q[j] - q[i] for i, j in permutations(range(len(gm)), 2)}
    r = {pair: np.linalg.norm(x) for pair, x in d.items()}
    newton = [sum(gm[j] * d[i, j] / r[i, j] ** 3 for j in range(len(gm)) if j != i) for i in range(len(gm))]
    depth = [sum(gm[j] / r[i, j] for j in range(len(gm)) if j != i) for i in range(len(gm))]
    added = np.zeros_like(q)
    for i, j in d:
        x, w = d[i, j], v[i] - v[j]
        size = -4 * depth[i] - depth[j] + v[i] @ v[i] + 2 * v[j] @ v[j] - 4 * v[i] @ v[j]
        size += -1.5 * (x @ v[j] / r[i, j]) ** 2 + 0.5 * x @ newton[j]
        added[i] += gm[j] / r[i, j] ** 3 * (size * x - x @ (4 * v[i] - 3 * v[j]) * w)
        added[i] += 3.5 * gm[j] / r[i, j] * newton[j]
    return added / c**2


def test_eih_accelerations_are_those_that_were_printed():
    expected = einstein_infeld_hoffmann(POSITION, VELOCITY, GM, CONSTANTS.c)
    np.testing.assert_allclose(added("eih"), expected, rtol=0, atol=1e-14 * np.abs(expected).max())


def test_eih_of_a_test_particle_is_the_suns_pull():
    gm = np.array([1.0, 0.0])
    two = {"gm": gm, "position": POSITION[:2], "velocity": np.vstack([np.zeros(3), VELOCITY[1]])}
    np.testing.assert_allclose(
        accelerations(problem("eih", **two)), accelerations(problem("1pn", **two)), rtol=1e-14, atol=1e-16
    )


# --- invariants ---


ALONE = ("gr-potential", "j2", "moon-quadrupole")


@pytest.mark.parametrize("forces", [*((name,) for name in ALONE), ALONE], ids="+".join)
def test_exact_invariants(forces):
    given = problem(forces)
    assert [item.name for item in given.invariants] == ["H", "L_pole" if "j2" in forces else "L"]
    for item in given.invariants:
        assert rate(item, given) < 1e-15
        assert check_gradient(item, 0.0, given.y0, given.fun) < 1e-7


def test_oblateness_breaks_the_other_components():
    given, newton = problem("j2"), problem(())
    torque = gradient(newton.invariants[1], newton) @ given.fun(0.0, given.y0)
    assert np.linalg.norm(torque) > 1e-4
    assert abs(torque @ POLE) < 1e-14


@pytest.mark.parametrize("c", [3.0, 100.0, 1e4])
def test_two_bodies_have_exact_invariants_with_1pn_and_three_none(c):
    for mass in (0.0, 1e-3, 0.7):
        given = problem("1pn", ForceConstants(c=c), np.array([1.0, mass]), POSITION[:2], VELOCITY[:2])
        assert [item.name for item in given.invariants] == ["H", "L"]
        for item in given.invariants:
            assert rate(item, given) < 3e-15
            assert check_gradient(item, 0.0, given.y0, given.fun) < 1e-6
    assert problem("1pn", CONSTANTS, GM[:3], POSITION[:3], VELOCITY[:3]).invariants == ()


@pytest.mark.parametrize("forces", [("eih",), ("eih", "j2", "moon-quadrupole")])
def test_what_eih_leaves_falls_with_the_fourth_power_of_c(forces, monkeypatch):
    monkeypatch.setattr("eip_scipy.problems.gravity.forces.KEPT", math.inf)  # offered however little they are kept
    rates = []
    for c in (100.0, 1000.0):
        given = problem(forces, ForceConstants(c=c, j2=1e-9, pole=POLE, moon_body=2, moon=1e-9))
        assert [item.name for item in given.invariants] == ["H", "L_pole" if "j2" in forces else "L"]
        assert all(check_gradient(item, 0.0, given.y0, given.fun) < 1e-6 for item in given.invariants)
        rates.append([rate(item, given) for item in given.invariants])
    np.testing.assert_array_less(rates[0], 1e-6)
    np.testing.assert_array_less(1e-15, rates[0])
    np.testing.assert_allclose(np.divide(*rates), 1e4, rtol=0.2)


@pytest.mark.slow
def test_eih_offers_invariants_only_where_they_are_kept():
    assert problem("eih", ForceConstants(c=100.0)).invariants == ()
    assert len(problem("eih", ForceConstants(c=1e5)).invariants) == 2
    solar = solar_system(forces=("eih", "j2"))
    assert [item.name for item in solar.invariants] == ["H", "L_pole"]
    assert max(rate(item, solar) for item in solar.invariants) < 1e-13


@pytest.mark.parametrize("forces", ["1pn", "eih", *ALONE])
def test_momentum_is_newtons_and_space_has_no_directions(forces):
    found = accelerations(problem(forces))
    if forces != "eih":
        assert np.abs((GM[:, None] * found).sum(axis=0)).max() < 1e-15 * np.abs(GM[:, None] * found).sum()
    turn = Rotation.random(None, np.random.default_rng(3)).as_matrix()
    turned = problem(forces, replace(CONSTANTS, pole=turn @ POLE), GM, POSITION @ turn.T, VELOCITY @ turn.T)
    np.testing.assert_allclose(accelerations(turned), found @ turn.T, rtol=0, atol=3e-15)


# --- runs ---


def mercury(forces, mass=0.0, h=0.001, years=10.0):
    """Return Mercury alone around the Sun, from its perihelion."""
    a, e = MERCURY["a"], MERCURY["e"]
    q, v = [a * (1 - e), 0, 0], [0, math.sqrt(GM_SUN * (1 + e) / (a * (1 - e))), 0]
    options = {"t_span": (0.0, years), "h": h, "forces": forces, "constants": ForceConstants(c=C_AU_YR)}
    return nbody([GM_SUN, mass], [[0, 0, 0], q], [[0, 0, 0], v], **options)


@pytest.mark.needs_jit
@pytest.mark.parametrize("forces", ["1pn", "eih", "gr-potential"])
def test_perihelion_of_mercury_advances_as_it_should(forces):
    """The advance is 42.98 arcsec a century: the slope of the eccentricity vector's angle, without periodic terms."""
    run = integrate(mercury(forces), method=EIPDOP853, save_every=10, invariants=())
    x, w = run.y[3:6] - run.y[:3], run.y[9:12] - run.y[6:9]
    r = np.linalg.norm(x, axis=0)
    e = (np.sum(w * w, axis=0) / GM_SUN - 1 / r) * x - np.sum(x * w, axis=0) / GM_SUN * w
    phase = math.sqrt(GM_SUN / MERCURY["a"] ** 3) * run.t
    periodic = [g(k * phase) for k in range(1, 13) for g in (np.cos, np.sin)]
    terms = np.stack([run.t, np.ones_like(run.t), *periodic], axis=1)
    slope = np.linalg.lstsq(terms, np.arctan2(e[1], e[0]), rcond=None)[0][0]
    assert math.degrees(slope) * 3600 * CENTURY == pytest.approx(42.98, abs=0.01)


@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize(("years", "options"), [(5.0, {"invariants": ()}), (100.0, {})])
def test_known_energy_and_momentum_of_a_test_particle(years, options):
    """The first-order forms, to 2e-14 and 6e-15: without projection, and over 100 yr on the package's exact ones."""
    given = mercury("1pn", h=1 / 1024, years=years)
    run = integrate(given, method=EIPDOP853, save_every=64, compensated=True, **options)
    x, v = run.y[3:6] - run.y[:3], run.y[9:12] - run.y[6:9]
    r, v2 = np.linalg.norm(x, axis=0), np.sum(v * v, axis=0)
    second = (3 / 8 * v2**2 + 1.5 * GM_SUN * v2 / r + 0.5 * (GM_SUN / r) ** 2) / C_AU_YR**2
    E = v2 / 2 - GM_SUN / r + second
    J = (x[0] * v[1] - x[1] * v[0]) * (1 + (v2 / 2 + 3 * GM_SUN / r) / C_AU_YR**2)
    # The deviation is from the mean: neglected terms in 1/c^4 vary with the phase by 1.9e-14 and 4.9e-15.
    assert np.abs(E / E.mean() - 1).max() < 2e-14
    assert np.abs(J / J.mean() - 1).max() < 6e-15


def test_nystrom_methods_say_why_they_cannot():
    for forces in ("1pn", "eih"):
        with pytest.raises(ValueError, match="accelerations in fun depend on the velocity; use a Runge-Kutta method"):
            integrate(mercury(forces), method=EIPRKN12)


# --- radiation ---


def dust(beta, c, e, t):
    """Return a particle that starts from the pericentre of the orbit that it has by pressure alone, with G M = 1."""
    v = math.sqrt((1 - beta) * (1 + e))
    constants = ForceConstants(c=c, beta=[0, beta])
    sun, particle = (np.zeros(3), np.zeros(3)), ([1, 0, 0], [0, v, 0])
    return nbody([1, 0], *zip(sun, particle, strict=True), t_span=(0.0, t), forces="radiation", constants=constants)


def test_pressure_weakens_the_suns_attraction_and_drag_shrinks_the_orbit():
    beta, e, t = 0.3, 0.4, 20.0
    run = integrate(dust(beta, math.inf, e, t), method=EIPDOP853, rtol=1e-12, atol=1e-13)
    scale = math.sqrt(1 - beta)
    x, y, u, v = kepler_state([1, 0, 0, math.sqrt(1 + e)], scale * t)
    np.testing.assert_allclose(run.y[[3, 4, 9, 10], -1], [x, y, scale * u, scale * v], rtol=1e-9)
    c, t = 1e4, 300.0  # a^2 falls by 4 beta G M / c in a unit of time
    y = integrate(dust(beta, c, 0.0, t), method=EIPDOP853, rtol=1e-12, atol=1e-13).y[:, -1]
    a = (1 - beta) / (2 * (1 - beta) / np.linalg.norm(y[3:6]) - y[9:] @ y[9:])
    assert 1 - a**2 == pytest.approx(4 * beta * t / c, rel=1e-5)


@pytest.mark.parametrize("mass", [0.0, 0.02])
def test_radiation_on_a_third_body_is_that_of_scipy(mass):
    """Light comes from the first body, and has no reaction on it: with a mass, momentum and energy are lost."""
    gm, beta, c = np.array([1.0, 0.3, mass]), np.array([0.0, 0.0, 0.25]), 10.0
    given = problem("radiation", ForceConstants(c=c, beta=beta), gm, POSITION[:3], VELOCITY[:3])

    def rhs(t, y):
        q, v = y.reshape(2, 3, 3)
        d = q[None] - q[:, None]
        r3 = (np.sum(d**2, axis=2) + np.eye(3)) ** 1.5
        a = np.sum(gm[None, :, None] * d / r3[..., None], axis=1)
        x, w = q[2] - q[0], v[2] - v[0]
        r = np.linalg.norm(x)
        a[2] += beta[2] * gm[0] / r**2 * ((1 - x @ w / (r * c)) * x / r - w / c)
        return np.concatenate([v, a]).ravel()

    assert [item.name for item in given.invariants] == ([] if mass else ["H", "L"])
    assert (given.linear_invariants is None) == (mass > 0)
    run = integrate(given, (0, 3), method=EIPDOP853, rtol=1e-11, atol=1e-12)
    exact = solve_ivp(rhs, (0, 3), given.y0, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(run.y[:, -1], exact, atol=1e-9)
    assert run.trusted
    assert all(rate(item, given) < 1e-15 for item in given.invariants)


# --- the solar system's constants ---


@pytest.mark.parametrize(("units", "length", "time"), [("AU, yr", 1.0, 1 / 365.25), ("SI", AU_KM * 1e3, DAY_S)])
def test_solar_system_constants(units, length, time):
    entries = solar_system(units=units, forces=("1pn", "j2", "moon-quadrupole")).params[10:]
    km, mass_ratio = length / AU_KM, 398600.435507 * 4902.800118 / 403503.235625**2
    assert entries[OVER_C2] ** -0.5 == pytest.approx(299792.458 * DAY_S * km / time)
    assert entries[OBLATENESS] == pytest.approx(2.1961391516529825e-07 * (696000 * km) ** 2)
    assert entries[MOON_BODY] == 3
    assert entries[MOON_ENTRY] == pytest.approx((384399 * km) ** 2 * mass_ratio / 4, rel=1e-9)


def test_the_pole_turns_with_the_axes():
    """The Sun's equator is inclined by 7.25 deg to the ecliptic (Carrington)."""
    ecliptic, icrf = (solar_system(name, forces="j2").params[10 + POLE_ENTRY :][:3] for name in ("paper", "de440"))
    assert math.degrees(math.acos(ecliptic[2])) == pytest.approx(7.25, abs=0.01)
    assert math.degrees(math.asin(icrf[2])) == pytest.approx(63.87)
    assert ecliptic[0] == icrf[0]


def test_sets_and_references_that_forces_do_not_have():
    for name in ("de440-moon", "paper"):
        with pytest.raises(ValueError, match=f"'{name}' does not"):
            solar_system(name, forces="moon-quadrupole")
    assert solar_system().reference(1.0) is not None
    assert solar_system(forces="1pn").reference(1.0) is None


# --- bad input ---


MOON, ONLY_J2 = ForceConstants(moon_body=0, moon=1.0), ForceConstants(j2=1.0)
WRONG = [
    ("1PN", CONSTANTS, {}, "unknown force '1PN'.*did you mean '1pn'"),
    (("eih", "1pn"), CONSTANTS, {}, "'1pn' and 'eih' all describe relativity"),
    ("1pn", None, {}, "'1pn' needs constants=ForceConstants\\(c="),
    ("j2", ONLY_J2, {}, "pole=..."),
    *(("1pn", ForceConstants(c=c), {}, "c must be a finite positive number") for c in (-1.0, math.nan)),
    ("j2", replace(ONLY_J2, pole=(0, 0, 0)), {}, "pole must be three finite numbers, not all 0"),
    *(("moon-quadrupole", replace(MOON, moon_body=k), {}, "moon_body must be an index from 1 to 3") for k in (0, 4)),
    (None, CONSTANTS, {}, "must be a name or a sequence of names, got None"),
    ("1pn", CONSTANTS, {"gm": [0.0, 1.0, 1.0, 1.0]}, "the first body must be the one that exerts the forces"),
    *(((), None, {"gm": [1.0, gm, 0, 0]}, r"gm\[1\] is") for gm in (-1.0, math.nan, math.inf)),
    ("radiation", CONSTANTS, {}, r"'radiation' needs constants=ForceConstants\(beta="),
    ("radiation", ForceConstants(c=0.0), {}, "c must be a positive number, or numpy.inf for the pressure alone"),
    *(("radiation", replace(CONSTANTS, beta=beta), {}, "beta must be 4 numbers that are not negative")
      for beta in (0.1, [0, 0.1], [0.1, 0, 0, 0], [0, 0, -0.1, 0], [0, 0, math.nan, 0])),
    ((), None, {"gm": np.zeros(4)}, "every G m is 0"),
    ((), None, {"position": POSITION * np.nan}, "must be finite"),
    *(((), None, {"position": POSITION[[k if k != j else i for k in range(4)]]}, f"bodies {i} and {j} are at the same")
      for i, j in combinations(range(4), 2)),
    *(((), None, {"G": G}, "nbody: G must be a positive finite number, got") for G in (0.0, -1.0, np.nan, "1", True)),
]  # fmt: skip


def test_bad_input():
    for forces, constants, options, message in WRONG:
        with pytest.raises(TypeError if forces is None else ValueError, match=message):
            problem(forces, constants, **options)


# --- N bodies: masses, places, speeds ---


def test_test_particles_are_moved_by_no_correction():
    data = solar_data.load("de440")
    year = 365.25
    gm = np.append(data.gm, 0.0) * year**2
    q = np.vstack([data.position, [2.5, 0.3, 0.1]])
    v = np.vstack([data.velocity * year, [0.1, 4.0, 0.2]])
    given = nbody(gm, q, v, t_span=(0.0, 10.0), h=0.01)
    for item in given.invariants:
        assert not gradient(item, given)[:, [30, 31, 32, 63, 64, 65]].any()
    run = integrate(given, method=EIPRK5, save_every=100)
    assert run.success
    assert run.diagnostics.n_projections > 0
    assert np.abs(run.invariants[0] / run.invariants[0, 0] - 1).max() < 1e-12
    # The light body keeps its own energy about as well as a heavy asteroid would, and its orbit.
    small = nbody(np.append(gm[:-1], 1e-15), q, v, t_span=(0.0, 10.0), h=0.01)
    other = integrate(small, method=EIPRK5)
    np.testing.assert_allclose(run.y[30:33, -1], other.y[30:33, -1], atol=1e-6)


def test_mixed_units_are_noticed():
    data = solar_data.load("de440")
    for factor in (365.25, 1 / 365.25, 86400.0, 1 / 86400.0):
        with pytest.warns(UserWarning, match="times the escape speed; check that position, velocity and gm"):
            nbody(data.gm, data.position, data.velocity * factor, t_span=(0.0, 1.0))


def two_bodies(e, side=1, mass=1e-3):
    """Return two bodies in the pericentre (side 1) or apocentre (-1) of an orbit."""
    speed = math.sqrt((1 + mass) * (1 + side * e) / (1 - side * e))
    return [1.0, mass], [[0, 0, 0], [1 - side * e, 0, 0]], [[0, 0, 0], [0, speed, 0]]


FLYBY = [-30 * math.sqrt(0.4 / 1.044), 0, 0]  # at 30 times the escape speed, far from the other body


def test_no_false_alarms():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure_eight()
        pythagorean()
        for bodies in [
            two_bodies(0.0),
            two_bodies(0.999),
            two_bodies(0.999, -1),
            ([1.0, 1.0], [[0, 0, 0], [10.0, 3.0, 0]], [[0, 0, 0], FLYBY]),
            ([1.0], [[0, 0, 0]], [[1e9, 0, 0]]),
            ([1.0, 0.0, 0.0], np.eye(3), np.eye(3)[::-1]),
        ]:
            nbody(*bodies, t_span=(0.0, 1.0))
