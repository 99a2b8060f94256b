"""Uses of a result: tables, files, figures, continued runs; for integrate, solve_ivp and ensembles."""

import pickle
import sys
import zipfile
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import SQUARE, oscillator, refuse, same_fields

import eip_scipy
from eip_scipy import (
    EIPDOP853,
    EIPGJ12,
    EIPRK4,
    EIPRK23,
    EIPRK45,
    EIPRKN12,
    Invariant,
    ProjectionWarning,
    ensemble,
    integrate,
    load,
)
from eip_scipy.problems import kepler
from eip_scipy.results import IntegrationResult, plot, save, to_dataframe, to_xarray
from eip_scipy_studies.condensates.problems import soliton

Y0 = np.array([1.0, 2.0])
NAMES = ("x", "y", "vx", "vy")


def crossing(t, y, params=None):
    return y[1]


def kepler_run(t_end=3.0, **options):
    return integrate(kepler(), (0, t_end), **{"method": EIPRK4, "save_every": 10, **options})


def of_solve_ivp(**options):
    return solve_ivp(oscillator, (0, 2), Y0, method="RK45", events=crossing, **options)


def failed_run():
    """Return a run with a step that fails, at t = 1."""
    return integrate(lambda t, y: y if t < 1 else np.full(2, np.nan), (0, 2), Y0, method=EIPRK4, h=0.1)


# Names.


def test_component_names():
    assert kepler_run().component_names == NAMES
    assert integrate(oscillator, (0, 1), Y0, method=EIPRK4, h=0.1).component_names == ("y0", "y1")
    run = kepler_run()
    run.component_names = ["a", "b", "c", "d"]
    assert run.component_names == ("a", "b", "c", "d")
    assert run.to_dataframe().columns[0] == "a"


def test_wrong_names():
    for table in (to_xarray, to_dataframe, plot):
        rows = [
            ({"names": ["a", "b"]}, ValueError, "2 names for 4 components"),
            ({"names": "a b b c"}, ValueError, "'b' names two components"),
            ({"names": [1, 2, 3, 4]}, TypeError, "must be strings, got 1"),
            ({"names": 4}, TypeError, "sequence of strings, got 4"),
        ]
        refuse(partial(table, kepler_run()), rows)


# Tables.


def test_to_xarray():
    run = kepler_run()
    data = run.to_xarray()
    assert data.y.dims == ("component", "t")
    np.testing.assert_array_equal(data.y.sel(component="vx"), run.y[2])
    np.testing.assert_array_equal(data.y.sel(t=run.t[3]), run.y[:, 3])
    np.testing.assert_array_equal(data.invariants.sel(invariant="L"), run.invariants[1])
    np.testing.assert_array_equal(data.invariant_errors, run.invariants - run.target[:, None])
    np.testing.assert_array_equal(data.max_residual, run.max_residual)
    for name in ("method", "h", "message", "trusted", "nfev"):
        assert data.attrs[name] == run[name]
    assert to_xarray(run, "a b c d").component.values.tolist() == ["a", "b", "c", "d"]


def test_tables_of_derivatives():
    options = {"method": EIPRK4, "invariants": ()}  # whose derivatives would be compiled
    run = integrate(kepler(), (0, 1), variations=["state", 0], **options)
    data, frame = run.to_xarray("a b c d"), run.to_dataframe()
    np.testing.assert_array_equal(data.variations.sel(component="a", column="d"), run.stm[:, 0, 3])
    np.testing.assert_array_equal(data.variations.sel(column="params[0]"), run.sensitivities[..., 0])
    np.testing.assert_array_equal(frame["dvx/dy"], run.stm[:, 2, 1])
    assert frame.columns[-1] == "dvy/dparams[0]"
    along = integrate(kepler(), (0, 1), variations=np.eye(4)[:, 1:3], **options)
    assert along.to_xarray().column.values.tolist() == ["0", "1"]
    np.testing.assert_array_equal(along.to_dataframe()["dx/d1"], along.variations[:, 0, 1])


@pytest.mark.parametrize("engine", ["scipy", "h5netcdf", "netCDF4"])
def test_xarray_goes_to_netcdf(engine, tmp_path):
    """Runs with fixed and adaptive steps, and an ensemble, through each library."""
    xarray = pytest.importorskip("xarray", reason="needs xarray")
    pytest.importorskip(engine, reason=f"needs {engine}")
    many = ensemble(oscillator, (0, 1), np.ones((3, 2)), h=0.1, save_every=2)
    runs = kepler_run(), integrate(oscillator, (0, 1), Y0, method=EIPRK45), many
    for k, run in enumerate(runs[:1] if engine == "scipy" else runs):
        data = run.to_xarray()
        path = tmp_path / f"{k}.nc"
        data.to_netcdf(path, engine=engine.lower())
        with xarray.open_dataset(path, engine=engine.lower()) as again:
            assert again.attrs["success"] == again.attrs.get("trusted", 1) == 1
            np.testing.assert_array_equal(again.y, data.y)
            assert set(again.variables) == set(data.variables)


def test_to_dataframe():
    run = kepler_run()
    frame = run.to_dataframe()
    assert list(frame.columns) == [*NAMES, "H", "H error", "L", "L error"]
    assert frame.index.name == "t"
    np.testing.assert_array_equal(frame.index, run.t)
    np.testing.assert_array_equal(frame["vy"], run.y[3])
    np.testing.assert_array_equal(frame["L error"], run.invariants[1] - run.target[1])
    assert list(to_dataframe(run, "H L a b").columns[4:6]) == ["invariant H", "invariant H error"]
    twice = integrate(oscillator, (0, 1), Y0, method=EIPRK4, h=0.1, invariants=[SQUARE, SQUARE])
    assert list(twice.to_dataframe().columns)[2:] == ["S", "S error", "S (1)", "S (1) error"]


def test_tables_of_ensembles():
    """A row for each member; as many members as components do not confuse them."""
    starts = kepler().y0 * np.linspace(0.99, 1.01, 4)[:, None]
    result = ensemble(kepler(), (0, 3), starts, save_every=50)
    data = result.to_xarray()
    assert data.states.dims == ("member", "component", "time")
    np.testing.assert_array_equal(data.states.sel(component="vy"), result.trajectories[:, 3])
    np.testing.assert_array_equal(data.time, result.times)
    np.testing.assert_array_equal(data.y.sel(member=3), result.y[3])
    np.testing.assert_array_equal(data.y.sel(component="y"), result.y[:, 1])
    np.testing.assert_array_equal(data.t_end, result.t)
    np.testing.assert_array_equal(data.max_residual.sel(invariant="H"), result.max_residual[:, 0])
    assert data.message[3] == result.message[3]
    frame = to_dataframe(result, "a b c d")
    wanted = ["a", "b", "c", "d", "t_end", "status", "message", "trusted", "H max_residual", "L max_residual"]
    assert (list(frame.columns), frame.index.name) == (wanted, "member")
    np.testing.assert_array_equal(frame["b"], result.y[:, 1])
    np.testing.assert_array_equal(frame["L max_residual"], result.max_residual[:, 1])
    last = ensemble(oscillator, (0, 1), np.ones((3, 2)), h=0.1).to_xarray("q p")
    assert "states" not in last
    assert last.component.values.tolist() == ["q", "p"]


@pytest.mark.parametrize(("table", "library"), [("to_xarray", "xarray"), ("to_dataframe", "pandas")])
def test_a_missing_library_is_named_with_its_extra(table, library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf'{table} needs {library}: pip install "eip_scipy\[{library}\]"'):
        getattr(kepler_run(), table)()


# Files.


def assert_same(one, other):
    same_fields(one, other, but=["diagnostics", "sol"])
    if "diagnostics" in one:
        assert repr(one.diagnostics) == repr(other.diagnostics)
        assert (one.diagnostics.trusted, one.diagnostics.worst) == (other.diagnostics.trusted, other.diagnostics.worst)
        np.testing.assert_array_equal(one.diagnostics.corrections, other.diagnostics.corrections)


@pytest.mark.parametrize(
    "run",
    [
        kepler_run,
        failed_run,
        lambda: kepler_run(events=[crossing, lambda t, y, params: y[0] - 9], dense_output=True),
        lambda: integrate(soliton(points=16, length=8.0), (0, 0.01), method=EIPRK4, h=0.001),
        lambda: integrate(kepler(), (0, 3), method=EIPDOP853, rtol=1e-9),
    ],
)
def test_save_and_load(run, tmp_path):
    result = run()
    result.save(tmp_path / "run.npz")
    again = load(tmp_path / "run.npz")
    assert isinstance(again, IntegrationResult)
    assert_same(result, again)
    assert again.component_names == result.component_names


def test_an_untrusted_run_says_so_when_it_is_loaded(tmp_path):
    damped = Invariant(lambda t, y: 0.5 * y[1] ** 2 - np.cos(y[0]), name="E")
    with pytest.warns(ProjectionWarning):
        run = integrate(
            lambda t, y: np.array([y[1], -np.sin(y[0]) - 0.2 * y[1]]),
            (0, 20),
            [2.0, 0.0],
            method=EIPRK45,
            rtol=1e-8,
            invariants=damped,
        )
    run.save(tmp_path / "run.npz")
    again = load(tmp_path / "run.npz")
    assert again.trusted is again.diagnostics.trusted is False
    assert again.diagnostics.message == run.diagnostics.message != ""


def test_a_field_that_cannot_be_kept(tmp_path):
    run = kepler_run()
    run.what = {1, 2}
    with pytest.raises(TypeError, match="field 'what' is"):
        run.save(tmp_path / "run.npz")
    run.what = np.array([None])
    with pytest.raises(TypeError, match="field 'what' has dtype object"):
        run.save(tmp_path / "run.npz")
    assert not list(tmp_path.iterdir())
    with pytest.raises(TypeError, match="expected a result"):
        save({"t": 1}, tmp_path / "run.npz")


def test_load_refuses_other_files(tmp_path):
    path = tmp_path / "other.npz"
    with pytest.raises(FileNotFoundError):
        load(path)
    np.savez(path, t=np.zeros(2))
    with pytest.raises(ValueError, match="not a result written by save"):
        load(path)
    path.write_text("text")
    with pytest.raises(ValueError, match="not a result written by save"):
        load(path)
    kepler_run(checkpoint=tmp_path / "checkpoint.npz")
    with pytest.raises(
        ValueError, match=r"a checkpoint of 'integrate'; integrate\(\.\.\., checkpoint=.*resume=True\) continues"
    ):
        load(tmp_path / "checkpoint.npz")
    kepler_run().save(path)
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match="damaged"):
        load(path)


def test_a_failed_save_leaves_the_file_that_was_there(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    kepler_run().save(path)
    before = path.read_bytes()

    def full(*arguments, **keywords):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", full)
    with pytest.raises(eip_scipy.checkpoint.CheckpointError, match="no space left"):
        kepler_run(6.0).save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# Pickles.


def test_results_pickle():
    run = kepler_run()
    again = pickle.loads(pickle.dumps(run))
    assert_same(run, again)
    with pytest.raises(ValueError, match="does not know its functions"):
        again.continue_to(10)


# Continued runs.


@pytest.mark.parametrize(
    ("method", "options"), [(EIPRK45, {}), (EIPDOP853, {"rtol": 1e-2}), (EIPRK23, {}), (EIPRK4, {"h": 0.2})]
)
def test_own_end_states_are_starts(method, options):
    """One Newton step at a loose tolerance leaves more of a given target than a start may miss."""

    def pendulum(t, y):
        pull = (y[2:] @ y[2:] - 9.81 * y[1]) / (y[:2] @ y[:2])
        return np.concatenate([y[2:], [0.0, -9.81] - pull * y[:2]])

    rod = Invariant(lambda t, y: y[:2] @ y[:2] - 1, target=0, name="rod")
    along = Invariant(lambda t, y: y[:2] @ y[2:], target=0, name="along")
    options = {"method": method, "invariants": [rod, along], **options}
    y, residuals = np.array([1.0, 0.0, 0.0, 0.0]), []
    for k in range(20):
        run = integrate(pendulum, (0.37 * k, 0.37 * (k + 1)), y, **options)
        assert run.status == 0
        y = run.y[:, -1]
        residuals += [abs(y[:2] @ y[:2] - 1), abs(y[:2] @ y[2:])]
    # Terms of `along` reach 2 g = 20 in the square of the speed.
    assert max(residuals) < 1e-7
    assert (ensemble(pendulum, (0, 0.37), [[1.0, 0, 0, 0], y], **options).status == 0).all()


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (EIPRK4, {}),
        (EIPRKN12, {"every": 7}),
        (EIPRKN12, {"compensated": True}),
        (EIPDOP853, {"rtol": 1e-10, "atol": 1e-12}),
        (EIPGJ12, {"h": 0.01}),
    ],
)
def test_continue_to(method, options):
    whole = kepler_run(6.0, method=method, **options)
    first = kepler_run(method=method, **options)
    joined = first.continue_to(6.0)
    assert joined.t[-1] == 6.0
    assert np.all(np.diff(joined.t) > 0)
    np.testing.assert_array_equal(joined.y[:, : first.t.size], first.y)
    np.testing.assert_allclose(joined.y[:, -1], whole.y[:, -1], rtol=0, atol=3e-6 if method is EIPRK4 else 1e-8)
    # The second run keeps the values of the first start.
    np.testing.assert_array_equal(joined.target, first.target)
    assert np.all(first.max_residual <= joined.max_residual)
    assert np.all(joined.max_residual <= 2 * whole.max_residual + 1e-14)
    assert joined.trusted
    assert joined.nfev > first.nfev
    assert joined.method == first.method
    assert joined.h == first.h


def test_figures_of_both_runs():
    first = kepler_run(events=crossing, dense_output=True)
    second = first.continue_to(9.0)
    assert second.diagnostics.n_projections == 300
    assert second.diagnostics.max_correction >= first.diagnostics.max_correction
    np.testing.assert_array_equal(second.max_residual, second.diagnostics.max_residual)
    assert second.t_events[0].size == second.y_events[0].shape[0] > first.t_events[0].size
    assert np.all(np.diff(second.t_events[0]) > 0)
    assert (second.sol.t_min, second.sol.t_max) == (0.0, 9.0)
    np.testing.assert_allclose(second.sol(second.t), second.y, rtol=0, atol=1e-14)
    third = second.continue_to(12.0)
    assert third.t[-1] == 12.0
    assert third.diagnostics.n_projections == 400


def test_from_the_last_state_though_it_was_not_saved():
    whole = integrate(kepler(), (0, 6), method=EIPRK4, t_eval=[1.0, 4.0, 5.0])
    first = integrate(kepler(), (0, 3), method=EIPRK4, t_eval=[1.0])
    joined = first.continue_to(6.0, t_eval=[4.0, 5.0])
    np.testing.assert_array_equal(joined.t, whole.t)
    np.testing.assert_allclose(joined.y, whole.y, rtol=0, atol=1e-9)  # the metric's memory of errors starts anew
    np.testing.assert_array_equal(first.continue_to(6.0).t, [1.0, 3.0, 6.0])
    np.testing.assert_array_equal(kepler_run().continue_to(6.0, t_eval=[5.0]).t[-2:], [3.0, 5.0])
    np.testing.assert_array_equal(integrate(oscillator, (0, -1), Y0, method=EIPRK4).continue_to(-2.0).t[-1], -2.0)


def test_what_cannot_be_continued():
    beyond = "must lie beyond the end of the run, 3, got"
    rows = [
        *(({"t": t}, ValueError, beyond) for t in (3.0, 1.0, float("nan"), "6")),
        ({"t": 6.0, "y0": [1.0]}, TypeError, "y0 cannot be changed"),
        ({"t": 6.0, "mehtod": EIPRK4}, TypeError, "no option 'mehtod'"),
    ]
    refuse(kepler_run().continue_to, rows)


def test_an_interrupted_run_goes_on_and_what_breaks_it_off_again_keeps_both():
    calls = []

    def broken(t, y, residuals):
        calls.append(t)
        if len(calls) in (3, 6):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        kepler_run(callback=broken)
    partial = caught.value.partial
    with pytest.raises(KeyboardInterrupt) as caught:
        partial.continue_to(6.0)
    both = caught.value.partial
    assert both.t.size > partial.t.size
    assert np.all(np.diff(both.t) > 0)
    np.testing.assert_array_equal(both.y[:, : partial.t.size], partial.y)
    assert not both.trusted


# Figures.


def axes_of(figure):
    return [axis for axis in figure.axes if axis.get_visible()]


def test_plot_of_an_orbit():
    run = kepler_run(12.0, save_every=1)
    orbit, errors, corrections = axes_of(run.plot())
    np.testing.assert_array_equal(orbit.lines[0].get_xydata(), run.y[:2].T)
    assert errors.get_yscale() == "log"
    assert [line.get_label() for line in errors.lines] == ["H", "L"]
    shown = errors.lines[0].get_ydata()
    wanted = np.abs(run.invariants[0] - run.target[0])
    np.testing.assert_array_equal(shown[wanted > 0], wanted[wanted > 0])
    assert np.all(shown > 0)
    sizes = [bar.get_width() for bar in corrections.patches]
    np.testing.assert_array_equal(sizes, run.diagnostics.corrections)


def test_plot_of_components():
    run = kepler_run()
    components, *_ = axes_of(run.plot(orbit=False))
    assert [line.get_label() for line in components.lines] == list(NAMES)
    sol = of_solve_ivp()
    (alone,) = axes_of(plot(sol))
    np.testing.assert_array_equal(alone.lines[1].get_ydata(), sol.y[1])
    with pytest.raises(ValueError, match="an orbit needs components named x and y"):
        plot(sol, orbit=True)
    field = integrate(soliton(points=16, length=8.0), (0, 0.01), method=EIPRK4, h=0.001)
    first, *_ = axes_of(field.plot())
    assert first.get_title() == "the first 9 of 16"
    np.testing.assert_array_equal(first.lines[3].get_ydata(), np.abs(field.y[3]))


def test_a_run_prints_what_it_has():
    assert "units" not in repr(integrate(oscillator, (0, 1), Y0, method=EIPRK4, h=0.1))
    assert "units: G M = 1" in repr(kepler_run())
