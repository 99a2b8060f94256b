"""Results of an ensemble in memory, in files and reduced have the bits of its members' single runs."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numba import njit
from systems import same_fields

from eip_scipy import EIPDOP853, EIPRK4, Invariant, ensemble, integrate, load
from eip_scipy.problems import kepler, nbody
from eip_scipy.results import EnsembleResult, plot, save

PROBLEM = kepler()
FAILING = 5
STARTS = PROBLEM.y0 * (1 + 1e-3 * np.random.default_rng(0).standard_normal((21, 4)))
STARTS[FAILING] = [1e-9, 0, 0, 0]  # its projection fails in the first step
STEPS = {"method": EIPRK4, "h": 0.03}
SPAN = (0.0, 8.0)


def far_out(t, y, params):
    return y[0] + 1.3


far_out.terminal = 2
EVENTS = [lambda t, y, params: y[1], far_out]


def pairs(run, **options):
    """Return each member that did not fail, and its single run."""
    for k, start in enumerate(STARTS):
        if k == FAILING:
            assert run.status[k] == -1
        else:
            yield k, integrate(PROBLEM, SPAN, start, **options)


def seen(run):
    """Return numbers from all fields of a result that do not need the run itself, for ``reduce=``."""
    counts = [run.nfev, run.njev, run.nlu, run.status, run.success, run.trusted, run.t.size]
    events = [] if run.t_events is None else [t.size for t in run.t_events] + [t.sum() for t in run.t_events]
    sums = [run.t.sum(), *run.y.sum(axis=1), *run.invariants.sum(axis=1), *run.target, *run.max_residual]
    return np.array([*counts, *events, *sums, run.t[-1], *run.y[:, -1], *run.y.max(axis=1), len(run.message)])


JITTED = [njit(event) for event in EVENTS]
JITTED[1].terminal = 2
TIMES, ADAPTIVE = {"t_eval": np.linspace(1.0, 7.0, 5)}, {"method": EIPDOP853, "rtol": 1e-8}
MEMBERS = {
    "in vectors": STEPS,
    "interpreted": STEPS | {"compiled": False},
    "steps": STEPS | {"save_every": 40},
    "times": STEPS | TIMES,
    "adaptive": ADAPTIVE | TIMES,
    "events": STEPS | {"events": EVENTS, "compiled": False},
    "adaptive, events": ADAPTIVE | {"events": EVENTS, "compiled": False},
    "events and times": STEPS | TIMES | {"events": EVENTS},
    "jitted events": STEPS | {"events": JITTED},
    "adaptive, jitted events": ADAPTIVE | {"events": JITTED},
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.needs_jit if "jit" in name else ()) for name in MEMBERS]
)
def test_members_and_what_reduce_gets_are_single_runs(name):
    options = MEMBERS[name]
    run = ensemble(PROBLEM, SPAN, STARTS, **options)
    reduced = ensemble(PROBLEM, SPAN, STARTS, reduce=seen, chunk=8, **options)
    assert run.side_by_side.any() == (name in ("in vectors", "steps", "times"))
    assert reduced.trajectories is None
    assert np.isnan(reduced.reduced[FAILING]).all()
    saved = run.times.size > 0
    for k, alone in pairs(run, **options):
        np.testing.assert_array_equal(reduced.reduced[k], seen(alone))
        assert (run.status[k], run.t[k]) == (alone.status, alone.t_events[1][-1] if alone.status else SPAN[1])
        np.testing.assert_array_equal(run.target[k], alone.target)
        rows = alone.t.size
        for found, own in ((run.trajectories, alone.y), (run.invariants, alone.invariants)) if saved else ():
            np.testing.assert_array_equal(found[k, :, :rows], own)
            assert np.isnan(found[k, :, rows:]).all()
        if not saved:
            np.testing.assert_array_equal(run.y[k], alone.y[:, -1])
            np.testing.assert_array_equal(run.invariants[k], alone.invariants[:, -1])
        for found, own in (
            ((run.t_events, alone.t_events), (run.y_events, alone.y_events)) if "events" in options else ()
        ):
            for i in range(2):
                np.testing.assert_array_equal(found[k][i].ravel(), own[i].ravel())
    if "events" in options:
        assert ([t.size for t in run.t_events[0]], run.status[0]) == ([1, 2], 1)


def test_invariants_with_parameters_for_each_member():
    """The energy has the member's own mass in it: k / 2 for the start (1, 0)."""
    stiffness = np.array([[1.0], [2.0], [5.0]])
    energy = Invariant(lambda t, y, k: 0.5 * (y[1] ** 2 + k[0] * y[0] ** 2), name="H")
    options = {"params": stiffness, "invariants": energy, "method": EIPRK4, "h": 0.1}
    run = ensemble(lambda t, y, k: np.array([y[1], -k[0] * y[0]]), (0, 1), [1.0, 0.0], **options)
    np.testing.assert_allclose(run.invariants, stiffness / 2, rtol=1e-11)
    np.testing.assert_array_equal(run.target, stiffness / 2)


def test_reduce_gets_derivatives_and_a_projected_start():
    options = STEPS | {"variations": "state", "invariants": PROBLEM.invariants[:1], "project_initial": True}
    run = ensemble(PROBLEM, SPAN, STARTS, reduce=lambda run: [run.stm[-1], run.stm[0]], **options)
    assert run.reduced.shape == (len(STARTS), 2, 4, 4)
    for k, alone in pairs(run, **options):
        np.testing.assert_array_equal(run.reduced[k], alone.stm[[-1, 0]])


# Three bodies in vectors, five of which each lane is computed by itself, and members one after the other.
COLUMN_CASES = [(3, STEPS, True), (5, STEPS, True), (3, {"method": EIPDOP853, "rtol": 1e-8, "atol": 1e-9}, False)]


@pytest.mark.parametrize(("bodies", "options", "in_vectors"), COLUMN_CASES, ids=["3", "5", "adaptive"])
@pytest.mark.parametrize("projected", [False, True])
def test_each_member_has_columns_of_its_own(bodies, options, in_vectors, projected):
    rng = np.random.default_rng(bodies)
    angle, radius = 2.4 * np.arange(bodies), np.arange(bodies)[:, None]
    q = radius * np.transpose([np.cos(angle), np.sin(angle), 0.1 * np.sin(3 * angle)])
    v = np.transpose([-np.sin(angle), np.cos(angle), 0 * angle]) * (radius > 0) / np.sqrt(np.maximum(radius, 1))
    problem = nbody([1.0, *[1e-3] * (bodies - 1)], q, v, t_span=(0, 3))
    kept = {} if projected else {"invariants": ()}
    starts = problem.y0 + 1e-3 * rng.standard_normal((11, 6 * bodies))
    columns = rng.standard_normal((11, 6 * bodies, 2))
    run = ensemble(problem, (0, 3), starts, variations=columns, t_eval=[1.0, 2.0, 3.0], **options, **kept)
    assert run.side_by_side.all() == (in_vectors and not projected)
    assert run.side_by_side.any() == (in_vectors and not projected)
    for k in range(11):
        alone = integrate(problem, (0, 3), starts[k], variations=columns[k], t_eval=[1, 2, 3], **options, **kept)
        np.testing.assert_array_equal(run.trajectories[k], alone.y)
        np.testing.assert_array_equal(run.variations[k], alone.variations)
        assert (run.trusted[k], run.nfev[k]) == (alone.trusted, alone.nfev)
    with pytest.raises(ValueError, match=r"\(11, \d+, k\), got float64 \(10, "):
        ensemble(problem, (0, 3), starts, variations=columns[1:], **options)


def test_what_reduce_returns():
    run = ensemble(PROBLEM, SPAN, STARTS, reduce=lambda run: run.status, **STEPS)
    assert (run.reduced.shape, run.reduced.dtype) == (run.t.shape, float)
    turned = ensemble(
        PROBLEM, SPAN, STARTS, reduce=lambda run: run.y[0, -1] * (1j if run.y[0, 0] > 0.4 else 1), **STEPS
    )
    np.testing.assert_array_equal(np.abs(turned.reduced)[6:], np.abs(turned.y[6:, 0]))
    assert np.isnan(ensemble(PROBLEM, SPAN, STARTS[[FAILING] * 2], reduce=seen, **STEPS).reduced).tolist() == [True] * 2


def test_a_wrong_reduce():
    given = {"t_eval": [1, 3.5, 7], "events": far_out, "chunk": 8, **STEPS}
    rows = [
        (lambda run: None, TypeError, "reduce returned None; expected a number or an array of numbers"),
        (lambda run: np.zeros(run.t.size), ValueError, r"arrays of shape \(\d,\) and \(\d,\) for different members"),
        (lambda run: 1 / (run.t.size - 1), ZeroDivisionError, "by zero"),
    ]
    for reduce, error, match in rows:
        with pytest.raises(error, match=match) as info:
            ensemble(PROBLEM, SPAN, STARTS, reduce=reduce, **given)
        assert info.value.partial.status.shape == (len(STARTS),)


CASES = {
    "last states": {},
    "rows": {"save_every": 50},
    "events": {"events": EVENTS},
    "reduced": {"save_every": 50, "reduce": seen},
}


class Elsewhere(ThreadPoolExecutor):
    """Threads whose arrays are read-only and not aligned, as those may be that come from another process."""

    def submit(self, run, chunk):
        def sent(a):
            return np.frombuffer(b"-" + a.tobytes(), a.dtype, offset=1).reshape(a.shape)

        return super().submit(run, chunk._replace(y0s=sent(chunk.y0s), params=sent(chunk.params)))


@pytest.mark.parametrize("case", CASES)
def test_saved_and_loaded_and_run_elsewhere(case, tmp_path):
    more = CASES[case]
    run = ensemble(PROBLEM, SPAN, STARTS, **STEPS, **more)
    with Elsewhere(2) as executor:
        same_fields(run, ensemble(PROBLEM, SPAN, STARTS, executor=executor, **STEPS, **more))
    run.save(tmp_path / "run.npz")
    again = load(tmp_path / "run.npz")
    assert type(again) is EnsembleResult
    same_fields(run, again)
    assert repr(again) == repr(run)
    save(again, tmp_path / "again.npz")
    same_fields(run, load(tmp_path / "again.npz"))
    with np.load(tmp_path / "run.npz", allow_pickle=False) as file:  # no pickle
        np.testing.assert_array_equal(file["y"], run.y)


def test_a_figure_of_members_in_time(tmp_path):
    run = ensemble(PROBLEM, SPAN, STARTS, save_every=20, **STEPS)
    *fans, errors, counts = (axis for axis in run.plot().axes if axis.get_visible())
    assert [axis.get_ylabel() for axis in fans] == ["x", "y", "vx", "vy"]
    assert fans[0].get_legend().get_title().get_text() == "of members still running: at least 20 of 21"
    median = np.nanmedian(run.trajectories[:, 0], axis=0)
    np.testing.assert_allclose(fans[0].lines[0].get_ydata(), median, rtol=1e-15)
    assert [line.get_label() for line in errors.lines] == ["H", "L", "failed"]
    ran = np.arange(len(STARTS)) != FAILING
    np.testing.assert_array_equal(errors.lines[0].get_ydata(), run.max_residual[ran, 0])
    np.testing.assert_array_equal(errors.lines[-1].get_xdata(), [FAILING])
    ends = dict(zip([label.get_text() for label in counts.get_yticklabels()], counts.patches, strict=True))
    assert {name: bar.get_width() for name, bar in ends.items()} == {"reached the end": 20, "failed": 1}
    plot(run).savefig(tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes()[:4] == b"\x89PNG"
