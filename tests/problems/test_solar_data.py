"""The solar system's initial data: embedded sets, the paper's table, reference states, and the kernel reader."""

import json
from contextlib import contextmanager
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from systems import AU_KM, DAY_S, YEAR_D

from eip_scipy.integrations import jpl
from eip_scipy.problems import nbody, solar_data, solar_system

EPS = np.finfo(float).eps
NAMES = ("de440", "de440-j2000", "paper", "de440-moon")
PAPER_EPOCH = (2456690.5, 20.3 / 24)

# The initial state of the reference integration (heyoka): q in AU, v in AU/day.
REFERENCE_START = {
    "Sun": ([0.0011837989640206819, -0.0019751320625288203, -0.0009627533357508251],
             [5.919466866060189e-06, 2.534786548891469e-06, 9.490901114024805e-07]),
    "Mercury": ([0.10566532764145072, 0.25786427170274223, 0.12700705491725772],
             [-0.0320884478530974, 0.008240231361241931, 0.007728730171212083]),
    "EMB": ([-0.6799288657473626, 0.6516166597956654, 0.2823810429256934],
             [-0.01270907388166279, -0.010965268400595932, -0.004753730096071036]),
    "Jupiter": ([-1.5708001515677827, 4.544032667294449, 1.985854963834807],
             [-0.007285431545104389, -0.0018307762686907642, -0.0006073485570974863]),
    "Pluto": ([6.360917863978618, -29.920450772357672, -11.253771308526709],
             [0.0031396372778564564, 0.000341341610671427, -0.000839441198044002]),
}  # fmt: skip


@pytest.fixture(scope="module")
def planets(kernel):
    """Heliocentric planet centres (where DE440 has them) on ecliptic J2000 axes at the paper's epoch, km and km/s."""
    from jplephem.spk import SPK

    obliquity = np.radians(84381.448 / 3600)
    c, s = np.cos(obliquity), np.sin(obliquity)
    to_ecliptic = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    with SPK.open(kernel) as spk:

        def state(center, target):
            q, v = spk[center, target].compute_and_differentiate(*PAPER_EPOCH)
            return np.array([q, v / DAY_S])

        chains = {"Mercury": (1, 199), "Venus": (2, 299), "Earth": (3, 399), "Mars": (4,), "Jupiter": (5,)}
        return {
            name: (state(0, first) + sum(state(first, centre) for centre in rest) - state(0, 10)) @ to_ecliptic.T
            for name, (first, *rest) in chains.items()
        }


def heliocentric_km(data, body):
    i = data.bodies.index(body)
    q, v = data.position[i] - data.position[0], data.velocity[i] - data.velocity[0]
    return q * AU_KM, v * AU_KM / DAY_S


def test_available_sets_and_their_errors():
    assert solar_data.available() == NAMES
    for call, says in [
        (lambda: solar_data.load("de441"), r"'de441'; available: 'de440', 'de440-j2000', 'paper'"),
        (lambda: solar_data.load("de440", as_printed=True), "as_printed=True is an option of the set 'paper'"),
        (lambda: solar_data.reference_states("paper"), "exist for 'de440' only"),
        (lambda: solar_data.reference_states("de441"), "available: 'de440'"),
    ]:
        with pytest.raises(ValueError, match=says):
            call()


@pytest.mark.parametrize("name", NAMES)
def test_shapes_labels_and_barycentres_at_rest(name):
    data, n = solar_data.load(name), 11 if name == "de440-moon" else 10
    assert (data.name, data.bodies[0], len(data.bodies), data.units) == (name, "Sun", n, "AU, day")
    assert data.gm.shape == (n,)
    assert data.position.shape == data.velocity.shape == (n, 3)
    assert data.epoch_jd_tdb == (2451545.0 if name == "de440-j2000" else sum(PAPER_EPOCH))
    assert data.epoch.endswith(" TDB")
    assert data.axes == ("ecliptic J2000" if name == "paper" else "ICRF")
    np.testing.assert_array_equal(data.y0, np.concatenate([data.position, data.velocity], axis=None))
    for rows in (data.position, data.velocity):
        assert np.all(np.abs(data.gm @ rows) <= 4 * EPS * (data.gm @ np.abs(rows)))
    data.gm[0] = 0.0
    assert solar_data.load(name).gm[0] > 0.0


def test_earth_and_moon_make_up_their_barycentre():
    one, two = solar_data.load("de440"), solar_data.load("de440-moon")
    assert two.bodies == (*one.bodies[:3], "Earth", "Moon", *one.bodies[4:])
    assert two.gm[3] + two.gm[4] == pytest.approx(one.gm[3], rel=1e-14)
    for a, b in ((one.position, two.position), (one.velocity, two.velocity)):
        assert_allclose(two.gm[3:5] @ b[3:5] / two.gm[3:5].sum(), a[3], rtol=0, atol=1e-14)
        assert_allclose(np.delete(b, [3, 4], 0), np.delete(a, 3, 0), rtol=0, atol=2e-17 + 1e-15 * np.abs(a).max())
    assert 3.56e5 < np.linalg.norm(two.position[4] - two.position[3]) * AU_KM < 4.07e5


def test_default_equals_start_of_reference():
    data = solar_data.load()
    assert data.gm[0] == 0.00029591220828411956
    for body, (q, v) in REFERENCE_START.items():
        i = data.bodies.index(body)
        # The last bits of the Sun depend on how the barycentre is summed; the planets' do not.
        rtol = 4 * EPS if body == "Sun" else 0.0
        assert_allclose(data.position[i], q, rtol=rtol, atol=0)
        assert_allclose(data.velocity[i], v, rtol=rtol, atol=0)


def test_the_exact_epoch_is_that_of_the_calendar():
    data = solar_data.load()
    whole = Fraction(2456690) + Fraction(1, 2) + Fraction(20 * 60 + 18, 24 * 60)
    assert abs(Fraction(data.epoch_jd_tdb) + Fraction(data.epoch_rest) - whole) < 1e-15


@pytest.fixture(scope="module")
def planetary():
    """Return the problem of the set de440, in days."""
    data = solar_data.load("de440")
    return nbody(data.gm, data.position, data.velocity, t_span=(0, YEAR_D), G=1.0)


def test_states_keep_the_invariants_of_the_initial_data(planetary):
    states = solar_data.reference_states("de440")
    assert list(states) == [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0]
    energy, momentum = ((lambda y, item=item: np.array(item.fun(0.0, y))) for item in planetary.invariants)
    problem, y0 = solar_system(), planetary.y0
    pairs = [zip(problem.params, axis, strict=True) for axis in problem.y0[30:].reshape(10, 3).T]
    drift = np.array([float(sum(Fraction(gm) * Fraction(v) for gm, v in axis)) for axis in pairs]) / YEAR_D**2
    for years, y in states.items():
        assert_allclose(energy(y), energy(y0), rtol=2e-15)
        assert_allclose(momentum(y), momentum(y0), rtol=0, atol=1e-15 * np.linalg.norm(momentum(y0)))
        centre = planetary.params @ y[:30].reshape(10, 3) - years * drift  # the momentum is 0 up to rounding
        assert np.max(np.abs(centre)) < 1e-15 * planetary.params[0]


def test_first_year_against_scipy(planetary):
    sol = solve_ivp(planetary.fun, (0, YEAR_D), planetary.y0, method="DOP853", rtol=1e-13, atol=1e-16)
    assert_allclose(sol.y[:, -1], solar_data.reference_states()[1.0], rtol=0, atol=1e-11)


def test_the_papers_sun_is_added():
    data = solar_data.load("paper")
    assert_allclose(data.gm[0], solar_data.load("de440").gm[0], rtol=4 * EPS)
    assert_allclose(heliocentric_km(data, "Mercury")[0][0], 1.563021412664830e7, rtol=0, atol=1e-6)
    assert_allclose(data.gm[1] * AU_KM**3 / DAY_S**2, 2.203209e4, rtol=1e-15)


def test_the_papers_planets_agree_with_de440(planets):
    data = solar_data.load("paper")
    for body, km in [("Mercury", 0.13), ("Venus", 0.11), ("Earth", 0.15), ("Mars", 0.23)]:
        q, v = heliocentric_km(data, body)
        assert np.linalg.norm(q - planets[body][0]) < km
        assert np.linalg.norm(v - planets[body][1]) < 3e-7
    # Jupiter is a planet centre, not the barycentre of its system.
    assert_allclose(np.linalg.norm(heliocentric_km(data, "Jupiter")[0] - planets["Jupiter"][0]), 112, atol=1)


def test_mars_misprint(planets):
    printed, corrected = (
        heliocentric_km(solar_data.load("paper", as_printed=printed), "Mars")[1] for printed in (True, False)
    )
    assert_allclose(printed[2] * 1e3, -3.711433859326417e-02, rtol=1e-12)
    assert_allclose(corrected[2] * 1e3, -3.711433859326417e02, rtol=1e-14)
    assert_allclose(corrected, planets["Mars"][1], rtol=0, atol=1e-7)
    assert_allclose(printed[:2], corrected[:2], rtol=1e-14)


def test_embedded_sets_come_from_the_kernel(kernel, tmp_path):
    out = tmp_path / "solar_system.json"
    jpl.main([str(kernel), "--out", str(out)])
    extracted = json.loads(out.read_text())
    assert tuple(extracted) == NAMES
    for name in ("de440", "de440-j2000", "de440-moon"):
        data, entry = solar_data.load(name), extracted[name]
        assert (tuple(entry["bodies"]), entry["epoch"], entry["axes"]) == (data.bodies, data.epoch, data.axes)
        for key in ("gm", "position", "velocity"):
            assert_allclose(getattr(data, key), entry[key], rtol=4 * EPS, atol=0)


def test_epochs_in_one_or_two_parts(kernel):
    data = jpl.initial_data(2460000.5, kernel)
    assert (data.epoch, data.epoch_jd_tdb, data.axes) == ("2023-02-25 00:00:00 TDB", 2460000.5, "ICRF")
    assert "DE-0440" in data.source
    for rows in (data.position, data.velocity):
        assert np.all(np.abs(data.gm @ rows) <= 4 * EPS * (data.gm @ np.abs(rows)))
    day, fraction = PAPER_EPOCH
    data, single = jpl.initial_data(PAPER_EPOCH), jpl.initial_data(day + fraction, kernel)
    assert_allclose(jpl.initial_data((day - 1000, 1000.0 + fraction), kernel).y0, data.y0, rtol=1e-13)
    assert 1e-13 < np.max(np.abs(single.y0 - data.y0)) < 1e-11
    assert single.epoch == data.epoch == solar_data.load("de440").epoch
    for epoch, text in [(2287184.5, "1549-12-31 00:00:00 TDB"), (2688976.5, "2650-01-25 00:00:00 TDB")]:
        assert jpl.initial_data(epoch, kernel).epoch == text
    for epoch in (2287184.4, 2688976.6, (2688976.5, 0.1)):
        with pytest.raises(ValueError, match=r"JD 2287184\.5 to 2688976\.5 TDB \(1549-12-31 to 2650-01-25\)"):
            jpl.initial_data(epoch, kernel)
    with pytest.raises(ValueError, match="in one or two parts, got nan"):
        jpl.initial_data(float("nan"), kernel)


def test_constants_and_mass_parameters(kernel):
    exact, found = jpl.constants(kernel), jpl.mass_parameters(kernel)
    known = {"AU": AU_KM, "CLIGHT": 299792.458, "EMRAT": 81.300568221497215, "DENUM": 440.0, "GMSDOT": -9e-14}
    known |= {"J2SUN": 2.1961391516529825e-07, "GMS": 2.9591220828411956e-04}
    assert {key: exact[key] for key in known} == known
    assert found["GMS"] == 132712440041.279419
    assert_allclose(found["GM3"] + found["GMM"], found["GMB"], rtol=1e-14)
    for key in ("GMS", "GM1", "GM2", "GMB", "GM4", "GM5", "GM6", "GM7", "GM8", "GM9"):
        assert_allclose(solar_data.gm_from_km3_s2(found[key]), exact[key], rtol=2e-11)


def test_a_kernel_is_closed(kernel, monkeypatch):
    from jplephem.spk import SPK

    opened, original = [], SPK.open
    monkeypatch.setattr(SPK, "open", lambda path: opened.append(original(path)) or opened[-1])
    jpl.initial_data(2451545.0, kernel)
    with pytest.raises(ValueError, match="JD"):
        jpl.initial_data(0.0, kernel)
    assert len(opened) >= 2
    assert all(spk.daf.file.closed for spk in opened)


def test_kernels_of_the_user_and_of_another_kind(tmp_path, monkeypatch):
    path = tmp_path / "own.bsp"
    path.touch()
    assert jpl.kernel_path(str(path)) == path
    with pytest.raises(FileNotFoundError, match="no kernel at"):
        jpl.kernel_path(tmp_path / "other.bsp")

    @contextmanager
    def satellites(path):
        yield SimpleNamespace(pairs={(5, 501): None}, comments=lambda: "JUP365")

    monkeypatch.setattr(jpl, "_open", satellites)
    for call, says in [
        (lambda: jpl.initial_data(2451545.0, path), "no segment for Sun, Mercury"),
        (lambda: jpl.constants(path), "list no constants"),
        (lambda: jpl.mass_parameters(path), "no table of GM"),
    ]:
        with pytest.raises(ValueError, match=says):
            call()
