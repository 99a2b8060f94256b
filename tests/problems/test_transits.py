"""Encounters against dense output of SciPy, and transits against closed forms, REBOUND, and heyoka in 80 bits."""

import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

from eip_scipy import EIPDOP853, EIPRKN12, ensemble, integrate, load
from eip_scipy.problems import kepler, nbody, transits

GM = [1.0, 1e-3, 1e-3, 0.0]
PLACES = np.array([[0, 0, 0], [1, 0, 0], [0, -1.1, 0], [-0.9, 0.3, 0.01]], float)
SPEEDS = np.array([[0, 0, 0], [0, 1, 0], [1.05, 0.2, 0], [-0.3, -0.9, 0]], float)
TIGHT = {"method": EIPDOP853, "rtol": 1e-12, "atol": 1e-14}
PAIRS = [(i, j) for i in range(4) for j in range(i + 1, 4)]


def watched(end=40.0, encounters=0.4, gm=GM):
    return nbody(gm, PLACES, SPEEDS, t_span=(0.0, end), encounters=encounters)


def minima(problem, distance):
    """Return t, i, j, distance, speed of all smallest distances of pairs, from a fine grid of SciPy's dense output."""
    found, end = [], problem.t_span[1]
    sol = solve_ivp(problem.fun, (0, end), problem.y0, method="DOP853", rtol=1e-12, atol=1e-14, dense_output=True).sol

    def way(t, i, j):
        q, v = np.moveaxis(sol(t).reshape(2, 4, 3, *np.shape(t)), 2, -1)
        return np.linalg.norm(q[j] - q[i], axis=-1), np.linalg.norm(v[j] - v[i], axis=-1)

    grid = np.linspace(0, end, 20_001)
    for i, j in PAIRS:
        r = way(grid, i, j)[0]
        for k in np.flatnonzero((r[1:-1] < r[:-2]) & (r[1:-1] < r[2:])) + 1:
            t = minimize_scalar(
                lambda t, i=i, j=j: way(t, i, j)[0],
                bounds=(grid[k - 1], grid[k + 1]),
                method="bounded",
                options={"xatol": 1e-9},
            ).x
            r_min, speed = way(t, i, j)
            if r_min < distance[i, j]:
                found.append((t, i, j, r_min, speed))
    return np.array(sorted(found))


RADII = np.array([0.1, 0.2, 0.3, 0.25])


@pytest.mark.parametrize("encounters", [0.4, RADII], ids=["distance", "radii"])
def test_encounters_are_those_of_dense_output(encounters):
    distance = np.full((4, 4), 0.4) if np.ndim(encounters) == 0 else np.add.outer(RADII, RADII)
    run, expected = integrate(watched(encounters=encounters), **TIGHT), minima(watched(), distance)
    assert len(expected) > 4
    assert run.compiled
    np.testing.assert_array_equal(run.encounters[:, 1:3], expected[:, 1:3])
    np.testing.assert_allclose(run.encounters[:, 0], expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(run.encounters[:, 3], expected[:, 3], rtol=1e-7)
    np.testing.assert_allclose(run.encounters[:, 4], expected[:, 4], rtol=1e-5)


def test_encounters_backwards_continued_stored_and_with_other_events(tmp_path):
    problem = watched()
    run = integrate(problem, **TIGHT)
    half = integrate(problem, (0, 20), **TIGHT).continue_to(40)
    np.testing.assert_allclose(half.encounters, run.encounters, rtol=1e-8)
    assert [len(times) for times in half.t_events] == [len(times) for times in run.t_events]
    back = integrate(problem, (40, 0), run.y[:, -1], **TIGHT)
    np.testing.assert_allclose(back.encounters, run.encounters, rtol=1e-5)
    run.save(tmp_path / "run.npz")
    np.testing.assert_array_equal(load(tmp_path / "run.npz").encounters, run.encounters)
    both = integrate(problem, events=[lambda t, y, p: y[3], *problem.events], **TIGHT)
    np.testing.assert_allclose(both.encounters, run.encounters, rtol=1e-12)
    wide = integrate(problem, variations=np.eye(24)[:, :1], **TIGHT)
    np.testing.assert_allclose(wide.encounters, run.encounters, rtol=1e-12)
    alone = integrate(problem, events=lambda t, y, p: y[3], **TIGHT)
    with pytest.raises(AttributeError, match=r"no encounters; .* events=\[mine, \*problem.events\]"):
        alone.encounters  # noqa: B018
    assert integrate(watched(encounters=1e-9), **TIGHT).encounters.shape == (0, 5)


def test_members_of_ensembles_have_the_encounters_of_single_runs():
    problem, params = watched(), np.outer([1.0, 0.8], GM)
    y0s = problem.y0 + 1e-3 * np.random.default_rng(0).standard_normal((2, 24))
    many = ensemble(problem, y0s=y0s, params=params, **TIGHT)
    times = ensemble(problem, y0s=y0s, params=params, reduce=lambda run: run.encounters[:, 0].sum(), **TIGHT).reduced
    for k, found in enumerate(many.encounters):
        alone = integrate(problem, y0=y0s[k], params=params[k], **TIGHT).encounters
        assert len(alone) > 0
        np.testing.assert_allclose(found, alone, rtol=1e-7)
        assert times[k] == pytest.approx(alone[:, 0].sum(), rel=1e-7)


@pytest.mark.parametrize("wrong", [-1.0, 0.0, np.inf, [1.0, 2.0], [0.0] * 4])
def test_wrong_distances(wrong):
    with pytest.raises(ValueError, match="encounters must be a positive distance, or 4 radii"):
        watched(encounters=wrong)


# --- transits ---


def exact_time(x, z, u, w, gm):
    """Return the first time at which a planet on an ellipse in the plane (x, z) transits, seen along z, by Kepler."""
    r, h = mpmath.hypot(x, z), z * u - x * w
    e_vector = (
        (u * (x * u + z * w) - x * (u**2 + w**2) + gm * x / r) / -gm,
        (w * (x * u + z * w) - z * (u**2 + w**2) + gm * z / r) / -gm,
    )
    a, e, side = 1 / (2 / r - (u**2 + w**2) / gm), mpmath.hypot(*e_vector), mpmath.sign(h)

    def mean(x, z):
        true = side * (mpmath.atan2(x, z) - mpmath.atan2(*e_vector))
        E = 2 * mpmath.atan2(mpmath.sqrt(1 - e) * mpmath.sin(true / 2), mpmath.sqrt(1 + e) * mpmath.cos(true / 2))
        return E - e * mpmath.sin(E)

    period = 2 * mpmath.pi * mpmath.sqrt(a**3 / gm)
    return (mean(mpmath.mpf(0), mpmath.mpf(1)) - mean(x, z)) / (2 * mpmath.pi) * period % period


def test_times_and_derivatives_of_an_ellipse():
    start, gm = [0.7, -0.4, 0.5, 0.9], 1.1
    x, z, u, w = start
    problem = nbody([gm, 0.0], [[0, 0, 0], [x, 0, z]], [[0, 0, 0], [u, 0, w]], t_span=(0.0, 12.0))
    found = transits(integrate(problem, variations=["state", "gm_0"], **TIGHT))
    with mpmath.workdps(40):
        assert abs(found.times[0] - exact_time(*map(mpmath.mpf, start), mpmath.mpf(gm))) < 1e-10
        for k, place in enumerate([3, 5, 9, 11, 12]):  # x, z, vx, vz of the planet, and G m of the star
            order = tuple(int(m == k) for m in range(5))
            slope = mpmath.diff(exact_time, (*start, gm), order)
            assert abs(found.derivatives[0, place] - slope) < 1e-8 * abs(slope)
    assert found.planet.tolist() == [1] * len(found.times)
    assert transits(integrate(problem, **TIGHT)).derivatives is None
    above = transits(integrate(problem, **TIGHT), axis=(0, 0, -5)).times  # from the other side
    assert len(above) > 0
    assert not np.isclose(above[:, None], found.times).any()


def test_two_planets_as_rebound():
    """Times and derivatives of a system like Kepler-36 by IAS15 with its variational equations."""
    pytest.importorskip("rebound")
    study = pytest.importorskip("eip_scipy_studies.transits")
    problem = study.system("Kepler-36", 100.0)
    run = integrate(problem, variations=["state", *range(3)], **TIGHT)
    times, planets, slopes = transits(run, axis=study.AXIS)
    assert sorted(set(planets)) == [1, 2]
    names = [("x", 1), ("vy", 2), ("m", 0), ("m", 1), ("m", 2)]
    places = [3, 9 + 7, 18, 19, 20]
    sim = study.ias15(problem)
    variations = [sim.add_variation() for _ in names]
    for variation, (name, k) in zip(variations, names, strict=True):
        setattr(variation.particles[k], name, 1.0)
    for t, j, row in zip(times, planets, slopes, strict=True):
        sim.integrate(t)
        q, v = (
            np.array([[getattr(p, c) for c in axes] for p in sim.particles[:3]]) for axes in (("y", "z"), ("vy", "vz"))
        )
        a = np.array([[p.ay, p.az] for p in sim.particles[:3]])
        x, u, b = q[j] - q[0], v[j] - v[0], a[j] - a[0]
        rate = u @ u + x @ b
        assert abs(x @ u / rate) < 1e-9
        for variation, place in zip(variations, places, strict=True):
            ways = [np.array([[p.y, p.z], [p.vy, p.vz]]) for p in (variation.particles[int(j)], variation.particles[0])]
            dx, du = ways[0] - ways[1]
            assert row[place] == pytest.approx(
                -(dx @ u + x @ du) / rate, rel=1e-6, abs=1e-8 * np.abs(slopes[:, place]).max()
            )


def test_any_star_and_axis_and_repeated_runs():
    """Bodies in another order and frame have the same transits; saved states do not matter."""
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    plain = integrate(nbody(GM, PLACES, SPEEDS, t_span=(0.0, 10.0), h=0.05), method=EIPRKN12)
    order = [2, 0, 3, 1]
    other = nbody(
        np.array(GM)[order], (PLACES @ turn.T)[order], (SPEEDS @ turn.T)[order], t_span=(0.0, 10.0), bodies=list("cabd")
    )
    run = integrate(other, method=EIPRKN12, h=0.05, save_every=7, dense_output=True)
    one, two = transits(plain, axis=(0.3, 0.9, 0.1)), transits(run, "a", turn @ [0.3, 0.9, 0.1])
    assert len(one.times) > 3
    np.testing.assert_allclose(two.times, one.times, atol=1e-9)
    np.testing.assert_array_equal(np.array(order)[two.planet], one.planet)
    back = integrate(nbody(GM, PLACES, SPEEDS, t_span=(0.0, 10.0)), (10, 0), plain.y[:, -1], **TIGHT)
    np.testing.assert_allclose(transits(back, axis=(0.3, 0.9, 0.1)).times, one.times, atol=1e-7)


def test_wrong_arguments():
    problem = nbody(GM, PLACES, SPEEDS, t_span=(0.0, 1.0))
    run = integrate(problem, **TIGHT)
    for error, says, arguments in [
        (TypeError, "expected a result of integrate, got a problem", (problem,)),
        (TypeError, "expected a problem of bodies", (integrate(kepler(), method=EIPDOP853),)),
        (ValueError, "star must be an index below 4 or one of", (run, 4)),
        (ValueError, "star must be an index below 4 or one of", (run, "Sun")),
        (ValueError, "axis must be three finite numbers, not all 0", (run, 0, (0, 0, 0))),
        (ValueError, r"continued at t=1. Pass a run of integrate\(problem, \(0, 2\), ...\)", (run.continue_to(2),)),
        (ValueError, "saves its start: omit t_eval", (integrate(problem, t_eval=[0.5], **TIGHT),)),
    ]:
        with pytest.raises(error, match=says):
            transits(*arguments)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Kepler-36", "seven planets"])
def test_times_in_extended_precision(name):
    study = pytest.importorskip("eip_scipy_studies.transits")
    pytest.importorskip("heyoka")
    problem = study.system(name, 365.25)
    reference = study.Reference(problem.params.size)
    for method in (EIPRKN12, EIPDOP853):
        found = transits(integrate(problem, method=method, rtol=1e-13, atol=1e-16), axis=study.AXIS)
        start = np.append(problem.y0, problem.params)
        assert np.abs(reference.offsets(problem, start, found.times, found.planet)).max() < 1e-9


def test_command(tmp_path):
    pytest.importorskip("heyoka")
    pytest.importorskip("rebound")
    from eip_scipy_studies.cli import main

    assert main(["transits", "--years", "0.1", "--out", str(tmp_path), "--quiet"]) == 0
    assert len((tmp_path / "transits.csv").read_text().splitlines()) == 7
