"""`ensemble`: members equal single runs bit for bit, on any number of workers; failures, executors."""

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from systems import SQUARE, oscillator, pericentre, refuse, same_fields

from eip_scipy import EIPRK4, EIPRK5, EIPRKN12, Invariant, ProjectionWarning, ensemble, integrate
from eip_scipy.problems import Problem, kepler
from eip_scipy.results import EnsembleResult

needs_jit = pytest.mark.needs_jit
SPAN = (0.0, 6.0)


def starts(members, *, e=0.6, spread=1e-2):
    return pericentre(e) * (1 + spread * np.random.default_rng(members).standard_normal((members, 4)))


def same_members(run, single):
    """Check that every number of each member is that of its single run, `single(k)`."""
    for k in range(len(run.y)):
        own = single(k)
        np.testing.assert_array_equal(run.y[k], own.y[:, -1])
        assert run.t[k] == own.t[-1]
        assert run.status[k] == own.status
        assert run.message[k] == own.message
        np.testing.assert_array_equal(run.max_residual[k], own.max_residual)
        np.testing.assert_array_equal(run.max_correction[k], own.diagnostics.max_correction)
        assert (run.nfev[k], run.njev[k], run.nlu[k]) == (own.nfev, own.njev, own.nlu)
        if run.trajectories is not None:
            np.testing.assert_array_equal(run.times[: own.t.size], own.t)
            np.testing.assert_array_equal(run.trajectories[k, :, : own.t.size], own.y)
    assert run.names == tuple(own.diagnostics.names)


def test_one_number_for_each_member_of_a_problem_with_one_parameter():
    def decay(t, y, out, params):
        out[:] = -params[0] * y

    problem = Problem("decay", lambda t, y: -y, np.ones(2), (0, 1), rhs=decay, params=np.ones(1), h=0.02)
    k = np.array([0.5, 1.0, 2.0])
    for y0s in (None, np.ones((3, 2))):
        run = ensemble(problem, (0, 1), y0s, params=k)
        np.testing.assert_allclose(run.y, np.exp(-k[:, None]) * np.ones(2), rtol=1e-7)
    with pytest.raises(ValueError, match="params has 3 rows for 2 members"):
        ensemble(problem, (0, 1), np.ones((2, 2)), params=k)


@pytest.mark.parametrize("own", [EIPRK5.TABLEAU, EIPRKN12.TABLEAU], ids=str)
def test_the_method_of_a_problem(own):
    """Without `method` the problem's own steps the members, as in `integrate`; a problem without one has EIPRK4."""
    problem, y0s = replace(kepler(), method=own), starts(3)
    run = ensemble(problem, (0, 1), y0s)
    assert run.method == f"EIP_{own.name}"
    same_members(run, lambda k: integrate(problem, (0, 1), y0s[k]))
    given = ensemble(problem, (0, 1), y0s, method=EIPRK4)
    np.testing.assert_array_equal(given.y, ensemble(kepler(), (0, 1), y0s).y)


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("more", [{}, {"save_every": 10, "reduce": lambda run: run.y.max(axis=1)}])
def test_bits_do_not_depend_on_the_number_of_threads(more):
    y0s = starts(100)
    y0s[17] = np.nan
    runs = [ensemble(kepler(), SPAN, y0s, executor=workers, **more) for workers in (1, 2, 4)]
    runs.append(ensemble(kepler(), SPAN, y0s, **more))
    assert runs[0].chunk == 32
    runs.append(ensemble(kepler(), SPAN, y0s, **more, params=[0.005]))  # the problem's own
    for run in runs[1:]:
        same_fields(runs[0], run)
    same_fields(ensemble(kepler(), SPAN, y0s, chunk=7, **more), runs[0], but=["chunk"])


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=[needs_jit, pytest.mark.slow])])
def test_members_that_lose_what_they_keep_are_named(compiled):
    """Friction acts on the second of nine members alone, whose energy is projected all the same."""

    def fun(t, y, params):
        return np.array([y[1], -y[0] - params[0] * y[1]])

    kept = Invariant(lambda t, y, params: y[0] ** 2 + y[1] ** 2, name="E")
    friction = np.where(np.arange(9) == 1, 0.2, 0.0)
    if compiled:
        fun, kept = njit(fun), Invariant(njit(kept.fun), name="E")
    with pytest.warns(ProjectionWarning, match="1 of 9 members are not to be trusted"):
        run = ensemble(
            fun, (0, 10), np.tile([1.0, 0.0], (9, 1)), params=friction[:, None], method=EIPRK4, h=0.1, invariants=kept
        )
    np.testing.assert_array_equal(run.trusted, friction == 0)
    assert "'E'" in run.message[1]


def broken(t, y):
    if y[1] > 0.9:
        raise ValueError("too far")
    if y[0] > 0.8:
        return np.array([np.nan, 0.0])
    return np.array([y[1], -y[0]])


@pytest.mark.parametrize("more", [{}, {"save_every": 5}])
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=[needs_jit, pytest.mark.slow])])
def test_a_failing_member_is_its_own_affair(compiled, more):
    y0s = np.array([[0.1, 0.2], [-0.5, 0.8], [np.nan, 0.0], [0.0, 0.5], [0.1, 0.85], [0.0, 0.95], [0.2, 0.1]])
    fun = njit(broken) if compiled else broken
    options = {"h": 0.1, "compiled": compiled, "invariants": () if compiled else SQUARE, **more}
    run = ensemble(fun, (0, 3), y0s, executor=1, **options)
    assert run.failed.tolist() == [1, 2, 4, 5]
    assert not run.success
    said = [text.partition(" (interpreted")[0] for text in run.message]
    assert said[1] == said[5] == "ValueError: too far"
    assert said[2] == "ValueError: All components of the initial state `y0` must be finite."
    assert "fun returned a non-finite value at t=" in run.message[4]
    for k in (0, 3, 6):
        own = integrate(fun, (0, 3), y0s[k], method=EIPRK4, **options)
        np.testing.assert_array_equal(run.y[k], own.y[:, -1])
        if more:
            np.testing.assert_array_equal(run.trajectories[k], own.y)
    with pytest.raises(ValueError, match="too far") as info:
        integrate(fun, (0, 3), y0s[1], method=EIPRK4, **options)
    np.testing.assert_array_equal(run.y[1], info.value.partial.y[:, -1])
    if more:
        assert np.isfinite(run.trajectories[1, :, 0]).all()
        assert np.isnan(run.trajectories[[1, 2, 4, 5], :, -1]).all()
    text = repr(run)
    assert "7 members of 2 components, EIPRK4, h = 0.1" in text
    assert "4 failed" in text
    assert "member 1: ValueError: too far" in text


def test_members_in_columns_are_told():
    def unpacked(t, y):
        position, velocity = y
        return [velocity, -position]

    with pytest.raises(ValueError, match="too many values to unpack") as info:
        ensemble(unpacked, (0, 1), np.ones((2, 5)), method=EIPRK4, h=0.1)
    assert info.value.__notes__ == ["ensemble: the rows of y0s are members; y0s has 2 rows of 5 components."]


def test_callback_sees_chunks_in_order_and_stops():
    seen = []

    def callback(part):
        assert isinstance(part, EnsembleResult)
        seen.append((part.first, len(part.y)))
        return part.first >= 6

    run = ensemble(oscillator, (0, 1), np.ones((11, 2)), h=0.1, chunk=3, callback=callback, executor=2)
    assert seen == [(0, 3), (3, 3), (6, 3)]
    assert run.stopped
    assert run.status.tolist() == [0] * 9 + [-2] * 2
    assert not run.success


def test_what_was_there_survives_an_exception():
    def callback(part):
        if part.first == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as info:
        ensemble(oscillator, (0, 1), np.ones((9, 2)), h=0.1, chunk=2, callback=callback)
    assert info.value.partial.status.tolist() == [0] * 6 + [-2] * 3


@pytest.mark.slow
@needs_jit
def test_ctrl_c():
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    ensemble(kepler(), (0, 4e4), starts(8))  # compiled before, for batches of members too
    timer.start()
    with pytest.raises(KeyboardInterrupt) as info:
        ensemble(kepler(), (0, 1e7), starts(8))
    assert info.value.partial.wall_time < 5
    assert (info.value.partial.status == -2).any()


def test_memory_is_refused_before_it_is_taken():
    many = np.broadcast_to([1.0, 0.0], (1000, 2))
    with pytest.raises(MemoryError, match=r"1000 members of 2 components need 0\.0162 GB.*save_every.*reduce="):
        ensemble(oscillator, (0, 1), many, h=0.001, save_every=1, max_bytes=1e7)
    with pytest.raises(MemoryError, match="Run the members in parts"):
        ensemble(oscillator, (0, 1), many, h=0.001, max_bytes=1e4)


def test_progress(capsys):
    ensemble(oscillator, (0, 1), np.ones((4, 2)), h=0.1, progress=True)
    assert "4.00/4.00" in capsys.readouterr().err


def test_bad_input():
    masked = np.ma.array(np.ones((2, 2)), mask=np.eye(2))
    with_args = Invariant(lambda t, y, a: y @ y, lambda t, y, a: 2 * y, args=(1,))
    rows = [
        ({"y0": [[1.0, 0.0]]}, TypeError, r"ensemble\(\) has no option 'y0'; did you mean 'y0s'\?"),
        ({"diagnostics": None}, TypeError, r"ensemble\(\) has no option 'diagnostics'$"),
        ({"y0s": None}, TypeError, "y0s is missing"),
        ({"y0s": [1.0, 2.0]}, ValueError, r"y0s must have the shape \(members, n\), got \(2,\)"),
        ({"y0s": np.zeros((0, 2))}, ValueError, r"got \(0, 2\)"),
        ({"y0s": [["a", "b"]]}, TypeError, "`y0s` must hold numbers"),
        ({"y0s": masked}, ValueError, "masked values in y0s"),
        ({"params": [[1.0], [2.0], [3.0]]}, ValueError, "params has 3 rows for 2 members"),
        ({"params": "abc"}, TypeError, "params must be an array of numbers"),
        ({"params": np.zeros((2, 2, 2))}, ValueError, r"\(p,\) or \(members, p\)"),
        ({"executor": 0}, ValueError, "executor must be an integer >= 1"),
        ({"executor": "slurm"}, TypeError, "executor must be None, a number of threads"),
        ({"chunk": 0}, ValueError, "chunk must be an integer >= 1"),
        ({"save_every": 1, "h": None}, ValueError, "needs fixed steps"),
        ({"resume": True}, ValueError, "resume=True needs a file to resume from"),
        ({"reduce": "state"}, TypeError, r"reduce must be a function reduce\(result\), got 'state'"),
        ({"t_span": [(0, 1), (0, 2)]}, ValueError, "t_span must hold two numbers"),
        ({"checkpoint": 3}, TypeError, "checkpoint must be a path"),
        ({"invariants": with_args, "params": [[1], [2]]}, ValueError, "omit args"),
    ]
    given = {"fun": oscillator, "t_span": (0, 1), "y0s": np.eye(2), "h": 0.1}
    refuse(ensemble, [(given | options, *rest) for options, *rest in rows])


jit_leaves = njit(lambda t, y, params: y[0] + 0.5)
jit_leaves.terminal = True


@pytest.mark.slow
@needs_jit
def test_processes():
    y0s = starts(40)
    y0s[3] = np.nan
    here = ensemble(kepler(), SPAN, y0s, save_every=50)
    until = {"fun": replace(kepler(), events=[jit_leaves]), "t_span": SPAN, "y0s": y0s, "h": 0.05}
    ended = ensemble(**until)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        there = ensemble(kepler(), SPAN, y0s, save_every=50, executor=executor)
        ended_there = ensemble(**until, executor=executor)
    same_fields(here, there)
    assert 1 in ended.status  # jitted events keep their attributes
    np.testing.assert_array_equal(ended.status, ended_there.status)
    np.testing.assert_array_equal(ended.y, ended_there.y)


def ends_its_process(t, y):
    if y[0] > 100.0:
        os.kill(os.getpid(), signal.SIGKILL)
    return np.array([y[1], -y[0]])


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
def test_a_process_that_dies(tmp_path):
    """The executor is broken then; the returned results are kept, and the rest runs on another one."""
    y0s = np.ones((12, 2))
    y0s[7] = [99.9, 10.0]  # dies after its start, which is tried here too
    options = {"h": 0.1, "chunk": 3, "checkpoint": tmp_path / "kept", "compiled": False}
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as executor,
        pytest.raises(
            BrokenProcessPool, match=r"worker of the executor died before members \d to \d+ finished"
        ) as info,
    ):
        ensemble(ends_its_process, (0, 1), y0s, executor=executor, **options)
    done = int((info.value.partial.status == 0).sum())
    assert done in (0, 3, 6)  # those that had come back before
    with pytest.raises(BrokenProcessPool, match=r"died before members .*resume=True and another executor continues"):
        ensemble(ends_its_process, (0, 1), y0s, executor=executor, resume=True, **options)
    y0s[7] = 1.0
    ran = []
    del options["checkpoint"]
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as executor:
        run = ensemble(
            ends_its_process, (0, 1), y0s, executor=executor, callback=lambda part: ran.append(part.first), **options
        )
    assert run.success
    assert ran == [0, 3, 6, 9]


def test_an_executor_that_is_closed_meanwhile(tmp_path):
    """Members that were submitted and still return are kept too."""
    executor = ThreadPoolExecutor(1)
    options = {"h": 0.1, "chunk": 1, "checkpoint": tmp_path / "kept", "compiled": False}
    y0s = np.ones((100, 2))

    def callback(part):
        executor.shutdown(wait=False, cancel_futures=True)

    with pytest.raises(RuntimeError, match=r"the executor given as executor= (is|was) closed") as info:
        ensemble(oscillator, (0, 1), y0s, executor=executor, callback=callback, **options)
    done = int((info.value.partial.status == 0).sum())
    assert 1 <= done < 100
    ran = []
    run = ensemble(oscillator, (0, 1), y0s, resume=True, callback=lambda part: ran.append(part.first), **options)
    assert run.success
    assert ran[0] == done
