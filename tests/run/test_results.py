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
from eip_scipy import EIPDOP853, EIPGJ12, EIPRK4, EIPRK23, EIPRK45, EIPRKN12, Invariant, ensemble, integrate, load
from eip_scipy.problems import centre_time, kepler, nbody, time_transformed
from eip_scipy.results import IntegrationResult, plot, save, to_dataframe, to_xarray
from eip_scipy_studies.condensates.problems import soliton

Y0 = np.array([1.0, 2.0])
NAMES = ("x", "y", "vx", "vy")


def crossing(t, y, params=None):
    return y[1]


def kepler_run(t_end=3.0, **options):
    return integrate(kepler(), (0, t_end), **{"method": EIPRK4, "save_every": 10, **options})


def untrusted_run():
    energy = Invariant(lambda t, y: 0.5 * y[1] ** 2 - np.cos(y[0]), name="E")
    options = {"method": EIPRK45, "rtol": 1e-8, "invariants": energy}
    with pytest.warns(eip_scipy.ProjectionWarning):
        run = integrate(lambda t, y: np.array([y[1], -np.sin(y[0]) - 0.2 * y[1]]), (0, 20), [2.0, 0.0], **options)
    assert not run.trusted
    run.what = {"array": ("a", 1.5), "b": [[np.arange(2), np.ones(0, int)], [np.arange(3), np.arange(4)], []]}
    return run


def test_component_names():
    assert integrate(oscillator, (0, 1), Y0, method=EIPRK4, h=0.1).component_names == ("y0", "y1")
    run = kepler_run()
    assert run.component_names == NAMES
    run.component_names = ["a", "b", "c", "d"]
    assert run.component_names == run.continue_to(4).component_names == ("a", "b", "c", "d")
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
        data, path = run.to_xarray(), tmp_path / f"{k}.nc"
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
    assert list(twice.to_dataframe("S t").columns)[2:4] == ["invariant S", "invariant S error"]


def test_the_time_is_a_component():
    run = integrate(time_transformed(kepler(), 3.0, centre_time), method=EIPRK4, h=0.02, save_every=50)
    frame, data = run.to_dataframe(), run.to_xarray()
    assert frame.index.name == "s"
    np.testing.assert_array_equal(data.t, frame["t"])
    np.testing.assert_array_equal(data.y.sel(s=run.t[1]), run.y[:, 1])
    assert [axis.get_xlabel() for axis in axes_of(run.plot(orbit=False))][:2] == ["s", "s"]


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
    assert data.invariants.dims == ("member", "invariant", "time")
    np.testing.assert_array_equal(data.invariants, result.invariants)
    frame = to_dataframe(result, "a b c d")
    wanted = ["a", "b", "c", "d", "t_end", "status", "message", "trusted", "H max_residual", "L max_residual"]
    assert (list(frame.columns), frame.index.name) == (wanted, "member")
    np.testing.assert_array_equal(frame["b"], result.y[:, 1])
    np.testing.assert_array_equal(frame["L max_residual"], result.max_residual[:, 1])
    last = ensemble(oscillator, (0, 1), np.ones((3, 2)), h=0.1).to_xarray("q p")
    assert "states" not in last
    assert last.end_invariants.dims == ("member", "invariant")
    assert last.component.values.tolist() == ["q", "p"]


@pytest.mark.parametrize(("table", "library"), [("to_xarray", "xarray"), ("to_dataframe", "pandas")])
def test_a_missing_library_is_named_with_its_extra(table, library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf'{table} needs {library}: pip install "eip_scipy\[{library}\]"'):
        getattr(kepler_run(), table)()


def assert_same(one, other):
    same_fields(one, other, but=["diagnostics", "sol", "what"])
    assert repr(one.get("what")) == repr(other.get("what"))
    if "diagnostics" in one:
        assert repr(one.diagnostics) == repr(other.diagnostics)
        assert (one.diagnostics.trusted, one.diagnostics.worst) == (other.diagnostics.trusted, other.diagnostics.worst)
        np.testing.assert_array_equal(one.diagnostics.corrections, other.diagnostics.corrections)


@pytest.mark.parametrize(
    "run",
    [
        kepler_run,
        lambda: integrate(lambda t, y: y if t < 1 else y * np.nan, (0, 2), Y0, method=EIPRK4, h=0.1),  # fails
        untrusted_run,
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


def test_a_field_that_cannot_be_kept(tmp_path):
    run, masked = kepler_run(), np.ma.masked_array([1.0, 999.0], [False, True])
    for value in ({1, 2}, masked, [masked, np.zeros(2)], {"a": masked}, {1: "a"}, 1j, np.array([None])):
        run.what = value
        refuse(run.save, [({"path": tmp_path / "run.npz"}, TypeError, "field 'what")])
    assert not list(tmp_path.iterdir())
    refuse(save, [({"result": {"t": 1}, "path": tmp_path / "run.npz"}, TypeError, "expected a result")])


def test_load_refuses_other_files(tmp_path):
    path = tmp_path / "other.npz"
    refuse(load, [({"path": path}, FileNotFoundError, "No such file")])
    np.savez(path, t=np.zeros(2))
    refuse(load, [({"path": path}, ValueError, "not a result written by save")])
    path.write_text("text")
    refuse(load, [({"path": path}, ValueError, "not a result written by save")])
    kepler_run(checkpoint=tmp_path / "checkpoint.npz")
    words = r"a checkpoint of 'integrate'; integrate\(\.\.\., checkpoint=.*resume=True\) continues"
    refuse(load, [({"path": tmp_path / "checkpoint.npz"}, ValueError, words)])
    kepler_run().save(path)
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(b"EIPRK4")] ^= 1
    path.write_bytes(damaged)
    refuse(load, [({"path": path}, ValueError, "damaged")])


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


def test_results_pickle():
    again = pickle.loads(pickle.dumps(run := kepler_run()))
    assert_same(run, again)
    refuse(again.continue_to, [({"t": 10}, ValueError, "does not know its functions")])


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


TIGHT = {"rtol": 1e-10, "atol": 1e-12}
CONTINUED = [(EIPRK4, {}), (EIPRKN12, {"every": 7, "compensated": True}), (EIPDOP853, TIGHT), (EIPGJ12, {"h": 0.01})]


@pytest.mark.parametrize(("method", "options"), CONTINUED)
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
    assert (joined.method, joined.h) == (first.method, first.h)


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
    assert second.continue_to(12.0).diagnostics.n_projections == 400


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
    for name in ("args", "variations", "jvp", "metric", "every", "dense_output", "linear_invariants"):
        rows.append(({"t": 6.0, name: [1.1]}, ValueError, f"{name} cannot be changed"))
    refuse(kepler_run().continue_to, rows)


def test_values_that_change_between_two_parts():
    """Parameters in an array of the user's, and a number that the functions read from elsewhere."""
    params, stiffness = np.array([1.0]), [1.0]
    options = {"method": EIPRK4, "h": 0.1}
    run = integrate(lambda t, y, p: [y[1], -p[0] * y[0]], (0, 1), Y0, params=params, **options)
    params[0] = 9.0
    np.testing.assert_allclose(run.continue_to(2).y[0, -1], np.cos(2) + 2 * np.sin(2), rtol=1e-5)
    energy = Invariant(lambda t, y: y[1] ** 2 + stiffness[0] * y[0] ** 2, name="E")
    run = integrate(lambda t, y: [y[1], -stiffness[0] * y[0]], (0, 1), Y0, invariants=energy, **options)
    stiffness[0] = 1.1
    with pytest.raises(ValueError, match=r"'E' was 5 at t=1 and is .* in the same state now"):
        run.continue_to(2)


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
    assert "up to t=0.6 did not end regularly: interrupted by Key" in partial.continue_to(3.0).message


def axes_of(figure):
    return [axis for axis in figure.axes if axis.get_visible()]


def test_drawn_numbers_are_those_of_the_table():
    """Two invariants have one name, and errors of 0 have no place on the axis but below all others."""
    names = "$x^$", "_H", "_H (1)"
    kept = [Invariant(lambda t, y, k=k: (y @ y) ** k, name=names[min(k, 2) - 1]) for k in (1, 2, 3)]
    run = integrate(oscillator, (0, 12), Y0, method=EIPRK4, h=0.1, save_every=1, invariants=kept)
    components, errors, corrections = axes_of(run.plot())
    frame = run.to_dataframe()
    for line in components.lines:
        np.testing.assert_array_equal(line.get_xydata(), frame[line.get_label()].reset_index())
    for line, name in zip(errors.lines, names, strict=True):
        table, drawn = np.abs(frame[f"{name} error"].to_numpy()), line.get_ydata()
        np.testing.assert_array_equal(drawn[table > 0], table[table > 0])
        assert np.all(drawn[table == 0] < 1e-13)
    assert (errors.get_yscale(), [text.get_text() for text in errors.texts]) == ("log", ["error 0 "])
    assert [text.get_text() for text in errors.get_legend().get_texts()] == [r"\$x^\$", " _H", " _H (1)"]
    np.testing.assert_array_equal([bar.get_width() for bar in corrections.patches], run.diagnostics.corrections)


def test_plots_of_orbits():
    for velocity, labels in (([0, 0, 1], ("x", "z")), ([0, 0.8, 0.6], ("x (projection along z)", "y"))):
        pair = nbody([1.0, 1e-6], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], velocity], t_span=(0, 6), h=0.05)
        run = integrate(pair, method=EIPRK4, save_every=1)
        axis, *_ = axes_of(run.plot())
        drawn = [run.component_names.index(f"{label[0]}_1") for label in labels]
        np.testing.assert_array_equal(axis.lines[2].get_xydata(), run.y[drawn].T)
        assert (axis.get_xlabel(), axis.get_ylabel()) == labels


def test_plot_of_components():
    assert [line.get_label() for line in axes_of(kepler_run().plot(orbit=False))[0].lines] == list(NAMES)
    sol = solve_ivp(oscillator, (0, 2), Y0, method="RK45", events=crossing)
    (alone,) = axes_of(plot(sol))
    np.testing.assert_array_equal(alone.lines[1].get_ydata(), sol.y[1])
    refuse(plot, [({"result": sol, "orbit": True}, ValueError, "an orbit needs components named x and y")])
    field = integrate(soliton(points=16, length=8.0), (0, 0.01), method=EIPRK4, h=0.001)
    field.component_names = ["x", "y", *"abcdefghijklmn"]  # paths of complex numbers are not drawn
    first, *_ = axes_of(field.plot())
    assert (first.get_title(), first.lines[1].get_label()) == ("the first 9 of 16", "|y|")
    np.testing.assert_array_equal(first.lines[3].get_ydata(), np.abs(field.y[3]))


def test_a_run_prints_what_it_has():
    assert "units" not in repr(integrate(oscillator, (0, 1), Y0, method=EIPRK4, h=0.1))
    assert "units: G M = 1" in repr(kepler_run())
