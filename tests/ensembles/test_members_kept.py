"""Results of an ensemble in memory and in files have the bits of its members' single runs."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from eip_scipy import EIPDOP853, EIPRK4, Invariant, checkpoint, ensemble, integrate, load
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.problems import kepler
from eip_scipy.results import EnsembleResult, plot, save

PROBLEM = kepler()
FAILING = 5
STARTS = PROBLEM.y0 * (1 + 1e-3 * np.random.default_rng(0).standard_normal((21, 4)))
STARTS[FAILING] = [1e-9, 0, 0, 0]  # its projection fails in the first step
STEPS = {"method": EIPRK4, "h": 0.03}
SPAN = (0.0, 8.0)
SPANS = np.column_stack([np.zeros(len(STARTS)), np.linspace(1.0, 8.0, len(STARTS))])
TIMES = [np.linspace(0.5, end, 2 + k % 4) for k, (_, end) in enumerate(SPANS)]


def crossing(t, y, params):
    return y[1]


def far_out(t, y, params):
    return y[0] + 1.3


far_out.terminal = 2
EVENTS = [crossing, far_out]


def pairs(run, span=SPAN, times=None, **options):
    """Return each member that did not fail, and its single run."""
    for k, start in enumerate(STARTS):
        if k == FAILING:
            assert run.status[k] == -1
            continue
        own = {} if times is None else {"t_eval": times[k]}
        yield k, integrate(PROBLEM, span[k] if np.ndim(span) == 2 else span, start, **options | own)


def assert_rows_are(run, k, alone):
    """The saved rows are those of the single run, and nan after its end."""
    rows = alone.t.size
    np.testing.assert_array_equal(run.trajectories[k, :, :rows], alone.y)
    np.testing.assert_array_equal(run.invariants[k, :, :rows], alone.invariants)
    assert np.isnan(run.trajectories[k, :, rows:]).all()
    assert np.isnan(run.invariants[k, :, rows:]).all()


def assert_same_fields(one, other):
    assert set(one) == set(other)
    for name, value in one.items():
        if name in ("t_events", "y_events") and value is not None:
            for a, b in zip(value, other[name], strict=True):
                for c, d in zip(a, b, strict=True):
                    np.testing.assert_array_equal(c, d)
        elif isinstance(value, np.ndarray):
            np.testing.assert_array_equal(other[name], value)
            assert other[name].dtype == value.dtype
        elif name == "statistics" and value is not None:
            for field, expected in vars(value).items():
                np.testing.assert_array_equal(getattr(other.statistics, field), expected)
        elif name != "wall_time":
            assert other[name] == value


# Values of the invariants.


@pytest.mark.parametrize("options", [STEPS, STEPS | {"compiled": False}], ids=["in vectors", "interpreted"])
def test_invariants_of_last_states(options):
    run = ensemble(PROBLEM, SPAN, STARTS, **options)
    assert bool(run.side_by_side.any()) is (options is STEPS)
    assert run.invariants.shape == run.target.shape == (len(STARTS), 2)
    for k, alone in pairs(run, **options):
        np.testing.assert_array_equal(run.invariants[k], alone.invariants[:, -1])
        np.testing.assert_array_equal(run.target[k], alone.target)


@pytest.mark.parametrize("more", [{"save_every": 40}, {"t_eval": np.linspace(1.0, 7.0, 5)}])
def test_invariants_of_saved_states(more):
    run = ensemble(PROBLEM, SPAN, STARTS, **STEPS, **more)
    assert run.side_by_side.any()
    assert run.invariants.shape == (len(STARTS), 2, run.times.size)
    for k, alone in pairs(run, **STEPS, **more):
        assert_rows_are(run, k, alone)


def test_invariants_with_parameters_for_each_member():
    """The energy has the member's own mass in it: k / 2 for the start (1, 0)."""
    stiffness = np.array([[1.0], [2.0], [5.0]])
    energy = Invariant(lambda t, y, k: 0.5 * (y[1] ** 2 + k[0] * y[0] ** 2), name="H")
    run = ensemble(
        lambda t, y, k: np.array([y[1], -k[0] * y[0]]),
        (0, 1),
        [1.0, 0.0],
        params=stiffness,
        invariants=energy,
        method=EIPRK4,
        h=0.1,
    )
    np.testing.assert_allclose(run.invariants, stiffness / 2, rtol=1e-11)
    np.testing.assert_array_equal(run.target, stiffness / 2)


def test_invariants_that_nobody_asks_for():
    assert ensemble(PROBLEM, SPAN, STARTS, **STEPS, invariants=()).invariants.shape == (len(STARTS), 0)


# Events.


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.needs_jit), False])
@pytest.mark.parametrize("steps", [STEPS, {"method": EIPDOP853, "rtol": 1e-8}], ids=["fixed", "adaptive"])
def test_events_of_members_are_those_of_single_runs(compiled, steps):
    events = EVENTS
    if compiled:
        from numba import njit

        events = [njit(event) for event in EVENTS]
        events[1].terminal = 2
    options = steps | {"events": events, "compiled": compiled}
    run = ensemble(PROBLEM, SPAN, STARTS, **options)
    for k, start in enumerate(STARTS):  # also of the member that fails
        alone = integrate(PROBLEM, SPAN, start, **options)
        assert (run.status[k], run.t[k]) == (alone.status, alone.t[-1])
        for i in range(2):
            np.testing.assert_array_equal(run.t_events[k][i], alone.t_events[i])
            np.testing.assert_array_equal(run.y_events[k][i].reshape(-1, 4), alone.y_events[i].reshape(-1, 4))
    assert [t.size for t in run.t_events[0]] == [2, 2]
    assert run.status[0] == 1


@pytest.mark.needs_jit
def test_more_events_than_the_engine_has_room_for():
    from numba import njit

    clock = njit(lambda t, y, params: np.sin(500.0 * t))
    options = STEPS | {"h": 0.005, "events": clock}
    run = ensemble(PROBLEM, SPAN, STARTS[:2], **options)
    for k in range(2):
        alone = integrate(PROBLEM, SPAN, STARTS[k], **options)
        assert alone.t_events[0].size > 1024
        np.testing.assert_array_equal(run.t_events[k][0], alone.t_events[0])


def test_without_events_there_are_none():
    run = ensemble(PROBLEM, SPAN, STARTS[:2], **STEPS)
    assert run.t_events is None
    assert run.y_events is None


# Intervals and times of each member.


def test_intervals_of_members():
    run = ensemble(PROBLEM, SPANS, STARTS, **STEPS)
    assert run.one_by_one == "members have different intervals or times"
    for k, alone in pairs(run, span=SPANS, **STEPS):
        assert run.t[k] == SPANS[k, 1]
        np.testing.assert_array_equal(run.y[k], alone.y[:, -1])
        np.testing.assert_array_equal(run.invariants[k], alone.invariants[:, -1])


@pytest.mark.parametrize("span", [SPAN, SPANS], ids=["one interval", "intervals"])
def test_times_of_members(span):
    run = ensemble(PROBLEM, span, STARTS, t_eval=TIMES, **STEPS)
    assert run.times.shape == (len(STARTS), 5)
    for k, alone in pairs(run, span=span, times=TIMES, **STEPS):
        np.testing.assert_array_equal(run.times[k, : TIMES[k].size], TIMES[k])
        assert np.isnan(run.times[k, TIMES[k].size :]).all()
        assert_rows_are(run, k, alone)


def test_times_as_an_array_and_one_start_for_all():
    ends = np.array([1.0, -2.0, 3.0])
    run = ensemble(PROBLEM, np.column_stack([np.zeros(3), ends]), t_eval=ends[:, None] * [0.5, 1.0], **STEPS)
    assert run.trajectories.shape == (3, 4, 2)
    for k, end in enumerate(ends):
        alone = integrate(PROBLEM, (0.0, end), t_eval=[end / 2, end], **STEPS)
        np.testing.assert_array_equal(run.trajectories[k], alone.y)


def test_common_times_in_intervals_of_members():
    run = ensemble(PROBLEM, SPANS, STARTS, t_eval=[0.25, 0.75], **STEPS)
    for k, alone in pairs(run, span=SPANS, t_eval=[0.25, 0.75], **STEPS):
        assert_rows_are(run, k, alone)


def test_a_member_whose_times_are_outside_its_interval_fails_alone():
    times = [*TIMES[:-1], np.array([0.5, 9.0])]
    run = ensemble(PROBLEM, SPANS, STARTS, t_eval=times, **STEPS)
    assert run.failed.tolist() == [FAILING, len(STARTS) - 1]
    assert "Values in `t_eval` are not within `t_span`" in run.message[-1]


@pytest.mark.parametrize(
    ("span", "more", "match"),
    [
        (SPANS[:4], {}, "t_span has 4 rows for 21 members"),
        (SPANS, {"t_eval": TIMES[:3]}, "t_span has 21 rows and t_eval has 3"),
        (SPAN, {"t_eval": TIMES[:3]}, "t_eval has 3 rows for 21 members"),
        (SPANS, {"save_every": 5}, "save_every needs the same t_span"),
        (SPANS, {"reduce": "state"}, "reduce compares members at the same times"),
        ([[0.0, 1.0, 2.0]] * 21, {}, "must be .start, end., or have the shape .members, 2."),
    ],
)
def test_rows_that_do_not_fit(span, more, match):
    with pytest.raises(ValueError, match=match):
        ensemble(PROBLEM, span, STARTS, **STEPS, **more)


# Executors, stores, files.

CASES = {
    "last states": (SPAN, {}),
    "rows": (SPAN, {"save_every": 50}),
    "events": (SPAN, {"events": EVENTS}),
    "own times and events": (SPANS, {"t_eval": TIMES, "events": EVENTS}),
    "statistics": (SPAN, {"save_every": 50, "reduce": "state"}),
}
cases = pytest.mark.parametrize("case", CASES)


@cases
def test_an_executor_returns_the_same(case):
    span, more = CASES[case]
    whole = ensemble(PROBLEM, span, STARTS, **STEPS, **more)
    with ThreadPoolExecutor(2) as executor:
        assert_same_fields(whole, ensemble(PROBLEM, span, STARTS, executor=executor, **STEPS, **more))


@cases
def test_saved_and_loaded(case, tmp_path):
    span, more = CASES[case]
    run = ensemble(PROBLEM, span, STARTS, **STEPS, **more)
    run.save(tmp_path / "run.npz")
    again = load(tmp_path / "run.npz")
    assert type(again) is EnsembleResult
    assert_same_fields(run, again)
    assert repr(again) == repr(run)
    save(again, tmp_path / "again.npz")
    assert_same_fields(run, load(tmp_path / "again.npz"))
    with np.load(tmp_path / "run.npz", allow_pickle=False) as file:  # no pickle
        np.testing.assert_array_equal(file["y"], run.y)


@cases
@pytest.mark.parametrize("where", ["out", "checkpoint"])
def test_stores_keep_all_of_it_and_resume(case, where, tmp_path):
    pytest.importorskip("zarr")
    span, more = CASES[case]
    options = STEPS | more | {"chunk": 8}
    whole = ensemble(PROBLEM, span, STARTS, **options)
    place = {where: tmp_path / "store"}
    ensemble(PROBLEM, span, STARTS, callback=lambda part: part.first == 8, **place, **options)
    again = ensemble(PROBLEM, span, STARTS, resume=True, **place, **options)
    if where == "out":
        for name in ("trajectories", "invariants"):
            again[name] = None if again[name] is None else np.asarray(again[name])
        if case == "statistics":  # whose trajectories `out` keeps
            whole = EnsembleResult(whole | {name: again[name] for name in ("trajectories", "invariants")})
    assert_same_fields(whole, again)
    other = SPANS * 0.5 if np.ndim(span) == 2 else (0.0, 4.0)
    with pytest.raises(CheckpointError, match="t_span"):
        ensemble(PROBLEM, other, STARTS, resume=True, **place, **STEPS | {"chunk": 8})


def test_a_file_of_an_ensemble_whose_rows_are_in_a_store(tmp_path):
    pytest.importorskip("zarr")
    run = ensemble(PROBLEM, SPAN, STARTS, save_every=50, out=tmp_path / "rows.zarr", **STEPS)
    run.save(tmp_path / "run.npz")
    again = load(tmp_path / "run.npz")
    assert again.trajectories is None
    np.testing.assert_array_equal(again.invariants, ensemble(PROBLEM, SPAN, STARTS, **STEPS).invariants)


def test_a_chunk_whose_events_were_written_before_its_status(tmp_path):
    """Write the events of the chunk again, in place of those that a killed writer has left."""
    zarr = pytest.importorskip("zarr")
    options = STEPS | {"events": EVENTS, "chunk": 8, "out": tmp_path / "rows.zarr"}
    whole = ensemble(PROBLEM, SPAN, STARTS, **options)
    zarr.open_group(str(tmp_path / "rows.zarr"), mode="r+")["status"][8:] = -2
    assert_same_fields(whole, ensemble(PROBLEM, SPAN, STARTS, resume=True, **options))


@pytest.mark.parametrize("where", ["out", "checkpoint"])
def test_a_store_without_what_is_kept_now(where, tmp_path):
    """Refuse what an earlier version has written, by the name of what it lacks."""
    options = STEPS | {"chunk": 8, where: tmp_path / "store"}
    ensemble(PROBLEM, SPAN, STARTS, **options)
    if where == "out":
        group = pytest.importorskip("zarr").open_group(str(tmp_path / "store"), mode="r+")
        del group["target"]
    else:
        header, arrays = checkpoint.read(tmp_path / "store")
        del arrays["members_target"]
        checkpoint.write(tmp_path / "store", header, arrays)
    with pytest.raises(CheckpointError, match=r"earlier version of eip_scipy: '(members_)?target' is missing"):
        ensemble(PROBLEM, SPAN, STARTS, resume=True, **options)


@pytest.mark.parametrize("where", ["out", "checkpoint"])
@pytest.mark.parametrize("span", [SPAN, SPAN[::-1]])
def test_other_events_are_not_mixed(where, span, tmp_path):
    """They are recognised at both ends of a member, also where a value is not finite."""
    pytest.importorskip("zarr")
    options = STEPS | {"chunk": 8, where: tmp_path / "store"}

    def nowhere(t, y, params):
        return 0.5 if t == span[0] else np.nan

    def at_first(t, y, params):
        return y[1] + (t == span[0])

    def at_last(t, y, params):
        return y[1] + (t == span[1])

    ensemble(PROBLEM, span, STARTS, events=[crossing, nowhere], callback=lambda part: part.first == 8, **options)
    says = "fun, an invariant or an event had other values at the end of a member from number 8 on"
    for events in ([nowhere, crossing], [at_first, nowhere], [at_last, nowhere]):
        with pytest.raises(CheckpointError, match=says):
            ensemble(PROBLEM, span, STARTS, events=events, resume=True, **options)
    again = ensemble(PROBLEM, span, STARTS, events=[crossing, nowhere], resume=True, **options)
    assert (again.status >= 0).sum() == len(STARTS) - 1


@pytest.mark.parametrize("where", ["out", "checkpoint"])
def test_a_store_without_values_of_events(where, tmp_path):
    """Continue what an earlier version has written."""
    options = STEPS | {"chunk": 8, "events": EVENTS, where: tmp_path / "store"}
    whole = ensemble(PROBLEM, SPAN, STARTS, **STEPS, events=EVENTS, chunk=8)
    ensemble(PROBLEM, SPAN, STARTS, callback=lambda part: part.first == 8, **options)
    if where == "out":
        group = pytest.importorskip("zarr").open_group(str(tmp_path / "store"), mode="r+")
        del group["known_events"]
    else:
        header, arrays = checkpoint.read(tmp_path / "store")
        arrays["known_by"] = arrays["known_by"][: -2 * len(EVENTS)]
        checkpoint.write(tmp_path / "store", header, arrays)
    assert_same_fields(whole, ensemble(PROBLEM, SPAN, STARTS, resume=True, **options))


def test_datasets_hold_the_invariants():
    pytest.importorskip("xarray")
    run = ensemble(PROBLEM, SPAN, STARTS, save_every=50, **STEPS)
    data = run.to_xarray()
    assert data.invariants.dims == ("member", "invariant", "time")
    np.testing.assert_array_equal(data.invariants, run.invariants)
    own = ensemble(PROBLEM, SPANS, STARTS, t_eval=TIMES, **STEPS).to_xarray()
    assert own.states.dims == ("member", "component", "row")
    assert own.times.dims == ("member", "row")
    assert ensemble(PROBLEM, SPAN, STARTS, **STEPS).to_xarray().end_invariants.dims == ("member", "invariant")


# Figures.


def drawn(run, **options):
    return [axis for axis in run.plot(**options).axes if axis.get_visible()]


def test_a_figure_of_members_in_time(tmp_path):
    run = ensemble(PROBLEM, SPAN, STARTS, save_every=20, **STEPS)
    *fans, errors, counts = drawn(run)
    assert [axis.get_ylabel() for axis in fans] == ["x", "y", "vx", "vy"]
    median = np.nanmedian(run.trajectories[:, 0], axis=0)
    np.testing.assert_allclose(fans[0].lines[0].get_ydata(), median, rtol=1e-15)
    assert [line.get_label() for line in errors.lines] == ["H", "L", "failed"]
    ran = np.arange(len(STARTS)) != FAILING
    np.testing.assert_array_equal(errors.lines[0].get_ydata(), run.max_defect[ran, 0])
    np.testing.assert_array_equal(errors.lines[-1].get_xdata(), [FAILING])
    ends = dict(zip([label.get_text() for label in counts.get_yticklabels()], counts.patches, strict=True))
    assert {name: bar.get_width() for name, bar in ends.items()} == {"reached the end": 20, "failed": 1}
    plot(run).savefig(tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes()[:4] == b"\x89PNG"


def test_a_figure_of_last_states():
    run = ensemble(PROBLEM, SPANS, STARTS, t_eval=TIMES, events=far_out, **STEPS)
    states, errors, counts = drawn(run, names="q1 q2 p1 p2")
    assert [label.get_text() for label in states.get_xticklabels()] == ["q1", "q2", "p1", "p2"]
    assert states.get_ylabel() == "last states"
    assert errors.get_yscale() == "log"
    assert sum(bar.get_width() for bar in counts.patches) == len(STARTS)


def test_a_figure_without_invariants_and_of_many_components():
    starts = np.random.default_rng(1).standard_normal((9, 10))
    run = ensemble(lambda t, y: -y, (0, 1), starts, method=EIPRK4, h=0.1, save_every=1)
    *fans, counts = drawn(run)
    assert fans[0].get_title() == "the first 6 of 10 components"
    assert len(fans) == 6
    assert counts.get_xlabel() == "members"
