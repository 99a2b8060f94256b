"""`ensemble`: members equal single runs bit for bit, on any number of workers; failures, statistics, stores."""

import contextlib
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from systems import (
    JIT_H,
    JIT_L,
    SQUARE,
    H,
    L,
    jit_energy,
    jit_energy_gradient,
    jit_orbit,
    orbit,
    oscillator,
    pericentre,
)

from eip_scipy import EIPDOP853, EIPRK4, EIPRK5, EIPRK45, EIPRKN8, Invariant, checkpoint, ensemble, integrate
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.ensembles.tasks import Plan, Task, run_members
from eip_scipy.methods.nystrom import RKN1210
from eip_scipy.methods.runge_kutta import RK5
from eip_scipy.problems import Problem, kepler
from eip_scipy.results import EnsembleResult
from eip_scipy.run.prepare import Request

needs_jit = pytest.mark.needs_jit
HL = [JIT_H, JIT_L]
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
        np.testing.assert_array_equal(run.max_defect[k], own.max_defect)
        np.testing.assert_array_equal(run.max_correction[k], own.diagnostics.max_correction)
        assert (run.nfev[k], run.njev[k], run.nlu[k]) == (own.nfev, own.njev, own.nlu)
        if run.trajectories is not None:
            np.testing.assert_array_equal(run.times[: own.t.size], own.t)
            np.testing.assert_array_equal(run.trajectories[k, :, : own.t.size], own.y)
    assert run.names == tuple(own.diagnostics.names)


def same(one, other):
    """Compare two ensembles, number for number."""
    for name in ("y", "t", "status", "message", "max_defect", "max_correction", "nfev", "njev", "nlu", "times"):
        equal_nan = name != "message"
        assert np.array_equal(one[name], other[name], equal_nan=equal_nan), name
    if one.statistics is not None:
        for name in ("count", "mean", "squares", "min", "max"):
            np.testing.assert_array_equal(getattr(one.statistics, name), getattr(other.statistics, name))


# A member is the single run.

CASES = {
    "fixed step": {},
    "saved": {"save_every": 7},
    "t_eval": {"t_eval": np.linspace(0.5, 6.0, 9)},
    "no invariants": {"invariants": ()},
    "blocks, every third": {"blocks": 2, "every": 3},
    "compensated": {"compensated": True, "every": 4, "save_every": 50},
    "midpoint, two iterations": {"direction": "midpoint", "iterations": 2},
    "weights": {"metric": [1.0, 0.5, 0.25, 0.3]},
    "euclidean": {"metric": "euclidean", "method": EIPRK5},
    "last step shorter": {"h": 0.0317},
    "adaptive": {"h": None, "method": EIPRK45, "rtol": 1e-6, "atol": 1e-9},
    "adaptive, first step": {"h": None, "method": EIPDOP853, "first_step": 0.01, "rtol": 1e-8},
    "adaptive, t_eval": {"h": None, "method": EIPRK45, "t_eval": [0.0, 1.0, 6.0]},
}


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("case", CASES)
def test_members_are_single_runs(case):
    options = {"method": EIPRK4, "h": 0.03, "invariants": HL, "compiled": True} | CASES[case]
    y0s = starts(5)
    run = ensemble(jit_orbit, SPAN, y0s, **options)
    same_members(run, lambda k: integrate(jit_orbit, SPAN, y0s[k], **options))
    assert run.success


@pytest.mark.slow
@needs_jit
def test_backward_and_nothing_to_do():
    y0s = starts(3)
    for span in ((6.0, -0.1), (2.0, 2.0)):
        run = ensemble(jit_orbit, span, y0s, invariants=HL, h=0.03)
        same_members(run, lambda k, span=span: integrate(jit_orbit, span, y0s[k], method=EIPRK4, invariants=HL, h=0.03))


@pytest.mark.slow
@needs_jit
def test_problem_with_params_for_each_member():
    problem, params = kepler(), np.linspace(0.0, 0.01, 6)[:, None]
    run = ensemble(problem, SPAN, params=params, save_every=100)
    same_members(run, lambda k: integrate(problem, SPAN, params=params[k], method=EIPRK4, save_every=100))
    assert len({tuple(y) for y in run.y}) == 6


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


@pytest.mark.slow
@needs_jit
def test_one_set_of_params():
    problem = kepler()
    same(ensemble(problem, SPAN, starts(3), params=[0.005]), ensemble(problem, SPAN, starts(3)))


@njit
def _acceleration(t, q):
    return -q / np.sqrt(q[0] * q[0] + q[1] * q[1]) ** 3


@pytest.mark.slow
@needs_jit
def test_nystrom():
    y0s, options = starts(4), {"method": EIPRKN8, "h": 0.05, "invariants": HL}
    run = ensemble(acceleration=_acceleration, t_span=SPAN, y0s=y0s, **options)
    same_members(run, lambda k: integrate(acceleration=_acceleration, t_span=SPAN, y0=y0s[k], **options))


@pytest.mark.parametrize("own", [RK5, RKN1210], ids=str)
def test_the_method_of_a_problem(own):
    """Without `method` the problem's own steps the members, as in `integrate`; a problem without one has EIPRK4."""
    problem, y0s = replace(kepler(), method=own), starts(3)
    run = ensemble(problem, (0, 1), y0s)
    assert run.method == f"EIP_{own.name}"
    same_members(run, lambda k: integrate(problem, (0, 1), y0s[k]))
    given = ensemble(problem, (0, 1), y0s, method=EIPRK4)
    np.testing.assert_array_equal(given.y, ensemble(kepler(), (0, 1), y0s).y)


@njit
def _rotation(t, y):
    return -1j * y


@njit
def _norm(t, y):
    return np.sum(y.real**2 + y.imag**2)


@njit
def _norm_gradient(t, y):
    return 2 * y


@pytest.mark.slow
@needs_jit
def test_complex_states():
    y0s = np.random.default_rng(0).standard_normal((3, 4)).view(complex)
    options = {"method": EIPRK4, "h": 0.05, "invariants": Invariant(_norm, _norm_gradient, name="N"), "save_every": 9}
    run = ensemble(_rotation, SPAN, y0s, **options)
    same_members(run, lambda k: integrate(_rotation, SPAN, y0s[k], **options))


@njit
def _height(t, y):
    return y[1]


_height.terminal, _height.direction = True, -1


@pytest.mark.slow
@needs_jit
def test_events_end_members():
    y0s = starts(4)
    for more in ({}, {"t_eval": [0.5, 5.9]}):
        options = {"method": EIPRK4, "h": 0.03, "invariants": HL, "events": _height, **more}
        run = ensemble(jit_orbit, SPAN, y0s, **options)
        for k in range(4):
            own = integrate(jit_orbit, SPAN, y0s[k], **options)
            assert (run.status[k], run.t[k]) == (1, own.t_events[0][0])
            np.testing.assert_array_equal(run.y[k], own.y_events[0][0])


@njit
def _second_height(t, y):
    return y[1]


_second_height.terminal, _second_height.direction = 2, -1


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("more", [{"t_eval": np.linspace(0.5, 16.0, 9)}, {"save_every": 7}, {"h": None, "rtol": 1e-6}])
def test_events_that_end_members_at_the_second_time(more):
    """The first time passes within the engine's loop; rows beyond the end are nan."""
    y0s, options = starts(4), {"method": EIPRK45, "h": 0.03, "invariants": HL, "events": _second_height, **more}
    run = ensemble(jit_orbit, (0, 16), y0s, compiled=True, **options)
    for k in range(4):
        own = integrate(jit_orbit, (0, 16), y0s[k], **options)
        assert (run.status[k], run.t[k], run.message[k]) == (1, own.t_events[0][1], own.message)
        np.testing.assert_array_equal(run.y[k], own.y_events[0][1])
        assert (run.nfev[k], run.njev[k], run.nlu[k]) == (own.nfev, own.njev, own.nlu)
        if run.trajectories is not None:
            rows = own.t.size - ("save_every" in more)  # where the last row of the run is that of the event
            np.testing.assert_array_equal(run.trajectories[k, :, :rows], own.y[:, :rows])
            assert np.isnan(run.trajectories[k, :, rows:]).all()


@pytest.mark.slow
@needs_jit
def test_given_target_and_projected_start():
    target = [Invariant(jit_energy, jit_energy_gradient, target=-0.5, name="H")]
    y0s, options = starts(3, spread=1e-4), {"method": EIPRK4, "h": 0.03, "invariants": target}
    run = ensemble(jit_orbit, SPAN, y0s, project_initial=True, **options)
    same_members(run, lambda k: integrate(jit_orbit, SPAN, y0s[k], project_initial=True, **options))
    y0s[0] = pericentre(0.6)
    missed = ensemble(jit_orbit, SPAN, y0s, **options)
    assert missed.failed.tolist() == [1, 2]
    assert "the start violates invariant 'H'" in missed.message[1]


def test_interpreted_members():
    y0s, options = starts(3), {"method": EIPRK4, "h": 0.1, "invariants": [H, L], "save_every": 20}
    run = ensemble(orbit, SPAN, y0s, **options)
    same_members(run, lambda k: integrate(orbit, SPAN, y0s[k], **options))
    assert "(interpreted: " in run.message[0]


# Nothing passes from member to member, nor from worker to worker.


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("options", [{}, {"compensated": True, "every": 3}, {"direction": "old", "iterations": 2}])
def test_no_member_leaves_a_trace(options):
    """The result does not depend on the contents of the buffers."""
    y0s = starts(6)
    shared = {"method": EIPRK4, "h": 0.03, "invariants": HL, **options}
    plan = Plan(Task(Request.of(fun=jit_orbit, t_span=SPAN, y0=y0s[0], **shared))).compile()
    none = np.empty((6, 0))
    before = run_members(plan, y0s, none)
    with plan.driver() as driver:
        run, work = driver.loop.driver, driver.loop.driver.run.work
        for buffer in [*work.arrays().values(), run.state, run.new]:
            buffer.reshape(-1).view(np.int64)[:] = np.array(np.nan).view(np.int64)
    after = run_members(plan, y0s[::-1].copy(), none)
    for name in ("y", "t", "status", "max_defect", "counters", "max_correction"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name)[::-1])


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("more", [{}, {"save_every": 10, "reduce": "state"}])
def test_bits_do_not_depend_on_the_number_of_threads(more):
    y0s = starts(100)
    y0s[17] = np.nan
    runs = [ensemble(kepler(), SPAN, y0s, executor=workers, **more) for workers in (1, 2, 4)]
    runs.append(ensemble(kepler(), SPAN, y0s, **more))
    assert runs[0].chunk == 32
    for run in runs[1:]:
        same(runs[0], run)


@pytest.mark.slow
@needs_jit
def test_members_do_not_depend_on_the_chunk():
    same(ensemble(kepler(), SPAN, starts(40), chunk=3), ensemble(kepler(), SPAN, starts(40), chunk=40))


def test_what_the_engine_gets_is_looked_at():
    """Arrays of other shapes, places outside the members, rows without room: refused before they are used."""
    y0s = starts(9)
    plan = Plan(Task(Request.of(fun=kepler(), t_span=SPAN, y0=y0s[0], method=EIPRK4, save_every=10))).compile()
    out = plan.empty(9)
    with plan.driver() as sweeper:
        driver = sweeper.loop.driver
        members = sweeper._each(plan, y0s, np.zeros((9, 1)), out)
        for advance in (driver.sweep, driver.sweep_octets):
            for wrong, message in (
                ({"starts": y0s[:, :3].copy()}, "starts is float64 of shape"),
                ({"params": np.zeros((9, 2))}, "params is float64 of shape"),
                ({"y": out.y[:4]}, "y is float64 of shape"),
                ({"counters": out.counters.astype(float)}, "counters is float64"),
                ({"where": np.array([10, 0])}, "where is outside the members"),
            ):
                with pytest.raises(ValueError, match=message):
                    advance(members._replace(**wrong), 10)
            with pytest.raises(ValueError, match="`steps` must be at least 1"):
                advance(members, 0)
        driver.t = driver.t[:5].copy()
        with pytest.raises(ValueError, match="a row for each saved state"):
            driver.sweep_octets(members._replace(rows=np.zeros((9, 5, 4))), 10)


# Failures.


def broken(t, y):
    if y[1] > 0.9:
        raise ZeroDivisionError("too far")
    return oscillator(t, y) if y[0] < 0.8 else np.array([np.nan, 0.0])


def test_a_failing_member_is_its_own_affair():
    y0s = np.array([[0.1, 0.2], [-0.5, 0.8], [np.nan, 0.0], [0.0, 0.5], [0.1, 0.85]])
    run = ensemble(broken, (0, 3), y0s, h=0.1, invariants=SQUARE, save_every=5)
    assert run.failed.tolist() == [1, 2, 4]
    assert not run.success
    assert run.message[1].startswith("ZeroDivisionError: too far")
    assert run.message[2] == "ValueError: All components of the initial state `y0` must be finite."
    assert "fun returned a non-finite value at t=" in run.message[4]
    for k in (0, 3):
        own = integrate(broken, (0, 3), y0s[k], method=EIPRK4, h=0.1, invariants=SQUARE)
        np.testing.assert_array_equal(run.y[k], own.y[:, -1])
    with pytest.raises(ZeroDivisionError) as info:
        integrate(broken, (0, 3), y0s[1], method=EIPRK4, h=0.1, invariants=SQUARE)
    np.testing.assert_array_equal(run.y[1], info.value.partial.y[:, -1])
    assert np.isfinite(run.trajectories[1, :, 0]).all()
    assert np.isnan(run.trajectories[1, :, -1]).all()
    text = repr(run)
    assert "5 members of 2 components, EIPRK4, h = 0.1" in text
    assert "3 failed" in text
    assert "member 1: ZeroDivisionError: too far" in text


@njit
def jit_broken(t, y):
    if y[1] > 0.9:
        raise ValueError("too far")
    if y[0] > 0.8:
        return np.array([np.nan, 0.0])
    return np.array([y[1], -y[0]])


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("more", [{}, {"save_every": 5}])
def test_a_failing_member_of_compiled_functions(more):
    y0s = np.array([[0.1, 0.2], [-0.5, 0.8], [np.nan, 0.0], [0.0, 0.5], [0.1, 0.85], [0.0, 0.95], [0.2, 0.1]])
    run = ensemble(jit_broken, (0, 3), y0s, h=0.1, compiled=True, executor=1, **more)
    assert run.failed.tolist() == [1, 2, 4, 5]
    assert run.message[1] == run.message[5] == "ValueError: too far"
    assert "must be finite" in run.message[2]
    assert "fun returned a non-finite value at t=" in run.message[4]
    for k in (0, 3, 6):
        own = integrate(jit_broken, (0, 3), y0s[k], method=EIPRK4, h=0.1, **more)
        np.testing.assert_array_equal(run.y[k], own.y[:, -1])
        if more:
            np.testing.assert_array_equal(run.trajectories[k], own.y)
    if more:
        assert np.isfinite(run.trajectories[1, :, 0]).all()
        assert np.isnan(run.trajectories[[1, 2, 4, 5], :, -1]).all()


@pytest.mark.slow
@needs_jit
def test_projection_fails_in_one_member():
    y0s = starts(20)
    y0s[9] = [1e-9, 0.0, 0.0, 0.0]
    run = ensemble(kepler(), SPAN, y0s)
    assert run.failed.tolist() == [9]
    own = integrate(kepler(), SPAN, y0s[9], method=EIPRK4)
    assert run.message[9] == own.message
    assert (run.t[9], *run.y[9]) == (own.t[-1], *own.y[:, -1])


# Statistics.


def test_statistics_are_those_of_the_trajectories():
    y0s = starts(30)
    y0s[4] = np.nan
    options = {"h": 0.1, "invariants": [H, L], "save_every": 15, "chunk": 7}
    kept = ensemble(orbit, SPAN, y0s, **options).trajectories
    run = ensemble(orbit, SPAN, y0s, reduce="state", **options)
    assert run.trajectories is None
    found = run.statistics
    np.testing.assert_array_equal(found.t, run.times)
    np.testing.assert_array_equal(found.count, 29)
    np.testing.assert_allclose(found.mean, np.nanmean(kept, axis=0), atol=1e-15)
    np.testing.assert_allclose(found.var, np.nanvar(kept, axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.std, np.nanstd(kept, axis=0), rtol=1e-12)
    np.testing.assert_array_equal(found.min, np.nanmin(kept, axis=0))
    np.testing.assert_array_equal(found.max, np.nanmax(kept, axis=0))
    assert repr(found).startswith(f"Statistics of 29 members at {len(run.times)} times, {y0s.shape[1]} quantities")


def test_statistics_of_a_function_of_the_last_states():
    run = ensemble(oscillator, (0, 1), np.eye(2), h=0.1, reduce=lambda t, y: t * (y @ y))
    assert run.statistics.mean.shape == (1, 1)
    np.testing.assert_allclose(run.statistics.mean, [[1.0]], rtol=1e-5)
    assert run.statistics.count.tolist() == [2]


def test_members_in_columns_are_told():
    def unpacked(t, y):
        position, velocity = y
        return [velocity, -position]

    with pytest.raises(ValueError, match="too many values to unpack") as info:
        ensemble(unpacked, (0, 1), np.ones((2, 5)), method=EIPRK4, h=0.1)
    assert info.value.__notes__ == ["ensemble: the rows of y0s are members; y0s has 2 rows of 5 components."]


def test_wrong_statistics():
    with pytest.raises(ValueError, match="reduce must be 'state' or a function"):
        ensemble(oscillator, (0, 1), np.eye(2), h=0.1, reduce="mean")
    with pytest.raises(TypeError, match="expected a number or a 1-D array"):
        ensemble(oscillator, (0, 1), np.eye(2), h=0.1, reduce=lambda t, y: np.eye(2))
    with pytest.raises(TypeError, match="expected real numbers"):
        ensemble(lambda t, y: -1j * y, (0, 1), 1j * np.eye(2), h=0.1, reduce="state")


def test_statistics_far_from_zero_do_not_cancel():
    """The variance of numbers near 1e8, whose squares differ in the last digits only."""
    y0s = 1e8 + np.random.default_rng(0).standard_normal((200, 1))
    run = ensemble(lambda t, y: np.zeros(1), (0, 1), y0s, h=1.0, reduce="state", chunk=8)
    np.testing.assert_allclose(run.statistics.var[0, 0], np.var(y0s), rtol=1e-6)


# Chunks: callbacks, interruption, memory.


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
def test_ctrl_c_within_a_second():
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    ensemble(kepler(), (0, 4e4), starts(8))  # compiled before, for batches of members too
    timer.start()
    with pytest.raises(KeyboardInterrupt) as info:
        ensemble(kepler(), (0, 3e6), starts(8))
    assert info.value.partial.wall_time < 5
    assert (info.value.partial.status == -2).any()


def test_memory_is_refused_before_it_is_taken():
    many = np.broadcast_to([1.0, 0.0], (1000, 2))
    with pytest.raises(MemoryError, match=r"1000 members of 2 components need 0\.0162 GB.*save_every.*reduce=.*out="):
        ensemble(oscillator, (0, 1), many, h=0.001, save_every=1, max_bytes=1e7)
    with pytest.raises(MemoryError, match="Run the members in parts"):
        ensemble(oscillator, (0, 1), many, h=0.001, max_bytes=1e4)


def test_progress(capsys):
    ensemble(oscillator, (0, 1), np.ones((4, 2)), h=0.1, progress=True)
    assert "4.00/4.00" in capsys.readouterr().err


# Bad input.


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"metrik": "error"}, TypeError, r"ensemble\(\) has no option 'metrik'; did you mean 'metric'\?"),
        ({"y0": [[1.0, 0.0]]}, TypeError, r"ensemble\(\) has no option 'y0'; did you mean 'y0s'\?"),
        ({"diagnostics": None}, TypeError, r"ensemble\(\) has no option 'diagnostics'$"),
        ({"y0s": None}, TypeError, "y0s is missing"),
        ({"y0s": [1.0, 2.0]}, ValueError, r"y0s must have the shape \(members, n\), got \(2,\)"),
        ({"y0s": np.zeros((0, 2))}, ValueError, r"got \(0, 2\)"),
        ({"y0s": [["a", "b"]]}, TypeError, "`y0s` must hold numbers"),
        ({"y0s": np.ma.array(np.ones((2, 2)), mask=np.eye(2))}, ValueError, "masked values in y0s"),
        ({"params": [[1.0], [2.0], [3.0]]}, ValueError, "params has 3 rows for 2 members"),
        ({"params": "abc"}, TypeError, "params must be an array of numbers"),
        ({"params": np.zeros((2, 2, 2))}, ValueError, r"\(p,\) or \(members, p\)"),
        ({"h": -1.0}, ValueError, "`h` must be positive"),
        ({"executor": 0}, ValueError, "executor must be an integer >= 1"),
        ({"executor": "slurm"}, TypeError, "executor must be None, a number of threads"),
        ({"chunk": 0}, ValueError, "chunk must be an integer >= 1"),
        ({"save_every": 0}, ValueError, "save_every must be an integer >= 1"),
        ({"save_every": 1, "h": None}, ValueError, "needs fixed steps"),
        ({"resume": True}, ValueError, "resume=True needs a place to resume from"),
        ({"out": "a", "checkpoint": "b"}, ValueError, "got both out= and checkpoint=; omit checkpoint"),
        ({"checkpoint": 3}, TypeError, "checkpoint must be a path"),
        ({"checkpoint": "a", "checkpoint_every": 0}, ValueError, "checkpoint_every must be a number of seconds"),
        ({"invariants": Invariant(lambda t, y, a: y @ y, lambda t, y, a: 2 * y, args=(1,)), "params": [[1], [2]]},
         ValueError, "omit args"),
    ],
)  # fmt: skip
def test_bad_input(options, error, match):
    with pytest.raises(error, match=match):
        ensemble(oscillator, (0, 1), **({"y0s": np.eye(2), "h": 0.1} | options))


def test_what_fails_in_every_member_is_raised():
    with pytest.raises(ValueError, match="must be finite"):
        ensemble(oscillator, (0, 1), np.full((3, 2), np.nan), h=0.1)
    with pytest.raises(TypeError, match="fun returned None"):
        ensemble(lambda t, y: None, (0, 1), np.eye(2), h=0.1)


# Executors of concurrent.futures.


@pytest.mark.slow
@needs_jit
def test_processes():
    y0s = starts(40)
    y0s[3] = np.nan
    here = ensemble(kepler(), SPAN, y0s, save_every=50)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        there = ensemble(kepler(), SPAN, y0s, save_every=50, executor=executor)
    same(here, there)
    np.testing.assert_array_equal(here.trajectories, there.trajectories)


def test_threads_of_the_user():
    with ThreadPoolExecutor(2) as executor:
        run = ensemble(oscillator, (0, 1), np.ones((9, 2)), h=0.1, executor=executor, chunk=2)
    same(run, ensemble(oscillator, (0, 1), np.ones((9, 2)), h=0.1))


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


def test_a_closed_executor():
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(RuntimeError, match=r"the executor given as executor= is closed \(cannot schedule") as info:
        ensemble(oscillator, (0, 1), np.ones((4, 2)), h=0.1, executor=executor)
    assert info.value.partial.status.tolist() == [-2] * 4


@pytest.mark.parametrize("cancel", [True, False])
def test_an_executor_that_is_closed_meanwhile(cancel, tmp_path):
    """Members that were submitted and still return are kept too."""
    executor = ThreadPoolExecutor(1)
    options = {"h": 0.1, "chunk": 1, "checkpoint": tmp_path / "kept", "compiled": False}
    y0s = np.ones((100, 2))

    def callback(part):
        executor.shutdown(wait=False, cancel_futures=cancel)

    with pytest.raises(RuntimeError, match=r"the executor given as executor= (is|was) closed") as info:
        ensemble(oscillator, (0, 1), y0s, executor=executor, callback=callback, **options)
    done = int((info.value.partial.status == 0).sum())
    assert 1 <= done < 100
    ran = []
    run = ensemble(oscillator, (0, 1), y0s, resume=True, callback=lambda part: ran.append(part.first), **options)
    assert run.success
    assert ran[0] == done


# Stores.

STORED = {"h": 0.1, "invariants": SQUARE, "save_every": 4, "chunk": 3}


ZARR = pytest.param("out", marks=pytest.mark.skipif(find_spec("zarr") is None, reason="needs zarr"))
both_stores = pytest.mark.parametrize("where", [ZARR, "checkpoint"])


def stored(fun=oscillator, **options):
    y0s = np.random.default_rng(3).standard_normal((11, 2))
    y0s[5] = np.nan
    return ensemble(fun, (0, 1), y0s, **STORED | options)


def test_store_holds_what_memory_does(tmp_path):
    pytest.importorskip("zarr", reason="needs zarr")
    plain, kept = stored(), stored(out=tmp_path / "run.zarr")
    same(plain, kept)
    np.testing.assert_array_equal(kept.trajectories[:], plain.trajectories)
    xarray = pytest.importorskip("xarray", reason="needs xarray")
    with xarray.open_zarr(tmp_path / "run.zarr", consolidated=False) as data:
        assert data.states.dims == ("member", "component", "time")
        np.testing.assert_array_equal(data.time, plain.times)
        np.testing.assert_array_equal(data.states.sel(time=plain.times[1]), plain.trajectories[:, :, 1])
        np.testing.assert_array_equal(data.status, plain.status)
        assert data.message.values[5] == plain.message[5]
        assert data.attrs["eip_scipy_ensemble"]["settings"]["h"] == 0.1


@both_stores
@pytest.mark.parametrize("more", [{}, {"reduce": "state"}, {"save_every": None}])
def test_resume_runs_what_is_missing(where, tmp_path, more):
    def broken_off(part):
        if part.first == 3:
            raise KeyboardInterrupt

    def ran_on(part):
        ran.append(part.first)

    ran = []
    options = {where: tmp_path / "kept", **more}
    whole = stored(**more)
    with pytest.raises(KeyboardInterrupt):
        stored(callback=broken_off, **options)
    resumed = stored(resume=True, callback=ran_on, **options)
    assert ran == [6, 9]
    same(whole, resumed)
    again = stored(resume=True, callback=ran_on, **options)
    assert ran == [6, 9]
    same(whole, again)
    if again.trajectories is not None:
        np.testing.assert_array_equal(again.trajectories[:], stored().trajectories)


@pytest.mark.parametrize(("first", "then"), [(0, 1), (0, "state"), ("state", 0), ("state", None), (None, 1)])
def test_statistics_of_two_quantities_are_not_mixed(first, then, tmp_path):
    """A checkpoint keeps the statistics of the members so far; `out` keeps the states."""

    def broken_off(part):
        if part.first == 3:
            raise KeyboardInterrupt

    of = {0: lambda t, y: y[0], 1: lambda t, y: 2 * y[0], "state": "state", None: None}
    with pytest.raises(KeyboardInterrupt):
        stored(callback=broken_off, reduce=of[first], checkpoint=tmp_path / "kept")
    with pytest.raises(CheckpointError, match="reduce"):
        stored(resume=True, reduce=of[then], checkpoint=tmp_path / "kept")
    same(stored(reduce=of[first]), stored(resume=True, reduce=of[first], checkpoint=tmp_path / "kept"))


@both_stores
def test_resume_starts_where_there_is_nothing(where, tmp_path):
    same(stored(), stored(resume=True, **{where: tmp_path / "kept"}))


@both_stores
def test_a_store_is_not_overwritten_nor_mixed_up(where, tmp_path):
    place = {where: tmp_path / "kept"}
    stored(**place)
    with pytest.raises(CheckpointError, match="Pass resume=True to continue the ensemble"):
        stored(**place)
    with pytest.raises(CheckpointError, match=r"another run: h is 0\.1 in the checkpoint and 0\.2 in this run"):
        stored(resume=True, h=0.2, **place)
    with pytest.raises(CheckpointError, match="y0 differs"):
        ensemble(oscillator, (0, 1), np.ones((11, 2)), resume=True, **place, **STORED)
    with pytest.raises(CheckpointError, match=r"at the start \(stored: [-0-9., e]*; now: [-0-9., e]*\)"):
        stored(lambda t, y: 2 * oscillator(t, y), resume=True, **place)
    with pytest.raises(CheckpointError, match="chunk is 3 in the checkpoint and 4 in this run"):
        stored(resume=True, chunk=4, **place)


@both_stores
def test_another_machine_is_a_warning(where, tmp_path, monkeypatch):
    place = {where: tmp_path / "kept"}
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "_machine", lambda: "another machine")
        whole = stored(**place)
    with pytest.warns(UserWarning, match="machine another machine, here") as seen:
        same(whole, stored(resume=True, **place))
    assert seen[0].filename == __file__


@both_stores
def test_what_is_no_store(where, tmp_path):
    place = tmp_path / "other"
    place.write_text("something") if where == "checkpoint" else place.mkdir()
    with pytest.raises(CheckpointError, match=r"is not an ensemble of eip_scipy|not a checkpoint of eip_scipy"):
        stored(resume=True, **{where: place})


def test_a_chunk_without_its_status_runs_again(tmp_path):
    """Imitate a kill between the arrays of a chunk."""
    zarr = pytest.importorskip("zarr", reason="needs zarr")
    path = tmp_path / "run.zarr"
    whole = stored(out=path)
    group = zarr.open_group(path, mode="r+")
    group["status"][6:9] = -2
    group["y"][6:9] = 1e9
    ran = []
    same(whole, stored(out=path, resume=True, callback=lambda part: ran.append(part.first)))
    assert ran == [6, 9]


def test_a_store_that_was_not_begun_yet(tmp_path):
    """Imitate a kill between the creation of the group and that of its arrays."""
    zarr = pytest.importorskip("zarr", reason="needs zarr")
    zarr.open_group(tmp_path / "run.zarr", mode="w", attributes={"eip_scipy_ensemble": None})
    same(stored(), stored(out=tmp_path / "run.zarr", resume=True))


class Trap:
    """Object that makes a folder when it is unpickled."""

    def __init__(self, path):
        self._path = path

    def __reduce__(self):
        return os.mkdir, (str(self._path),)


def trapped(path, trap, zarr_format):
    """Put a status whose codec unpickles, in a format that can name it, in the place of the store's own."""
    zarr, numcodecs = pytest.importorskip("zarr"), pytest.importorskip("numcodecs")
    attributes = dict(zarr.open_group(path, mode="r").attrs)
    group = zarr.open_group(path, mode="w", zarr_format=zarr_format, attributes=attributes)
    where = path
    if zarr_format == 3:  # a group of format 3 with an array of format 2 in it
        where = path / "status"
        (path / "y").mkdir()
    else:
        group.create_array("y", shape=(11, 2), chunks=(3, 2), dtype=float)
        where = path / "status"
    where.mkdir(exist_ok=True)
    described = {
        "zarr_format": 2, "shape": [11], "chunks": [3], "dtype": "|O", "compressor": None, "fill_value": None,
        "order": "C",
        "filters": [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 4}],
    }  # fmt: skip
    (where / ".zarray").write_text(json.dumps(described))
    (where / ".zattrs").write_text("{}")
    for chunk in range(4):
        (where / str(chunk)).write_bytes(pickle.dumps(Trap(trap)))
    if zarr_format == 3:
        found = json.loads((path / "zarr.json").read_text())
        found["consolidated_metadata"] = {
            "kind": "inline", "must_understand": False, "metadata": {"status": described | {"attributes": {}}},
        }  # fmt: skip
        (path / "zarr.json").write_text(json.dumps(found))
    return numcodecs


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_a_strangers_store_runs_no_code(zarr_format, tmp_path, monkeypatch):
    """The codec that unpickles is allowed to, as in numcodecs and Zarr before they refused it."""
    zarr = pytest.importorskip("zarr")
    path, trap = tmp_path / "run.zarr", tmp_path / "sprung"
    stored(out=path)
    numcodecs = trapped(path, trap, zarr_format)
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    with zarr.config.set({"array.allow_unsafe_pickle_decode": True}):
        with pytest.raises(CheckpointError, match="is not an ensemble of eip_scipy") as refused:
            stored(out=path, resume=True)
        assert not trap.exists()
        if zarr_format == 2:
            assert "it is a Zarr group of format 2, whose metadata may name code to run" in str(refused.value)
            with contextlib.suppress(Exception):
                zarr.open_group(path, mode="r")["status"][:]
            assert trap.exists()  # so the trap works


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr version 3 specification")
def test_a_codec_from_elsewhere_is_refused_in_each_array(tmp_path):
    pytest.importorskip("zarr")
    path = tmp_path / "run.zarr"
    options = {"save_every": 2, "events": lambda t, y: y[0]}
    stored(out=path, **options)
    described = sorted(path.glob("*/zarr.json"))
    assert {"y", "target", "end_invariants", "invariants", "event_t"} <= {item.parent.name for item in described}
    for item in described:
        text, name = item.read_text(), item.parent.name
        changed = json.loads(text)
        changed["codecs"].append({"name": "numcodecs.zlib", "configuration": {"level": 1}})
        item.write_text(json.dumps(changed))
        with pytest.raises(CheckpointError, match=rf"its array '{name}' is stored with numcodecs\.zlib; expected "):
            stored(out=path, resume=True, **options)
        item.write_text(text)
    stored(out=path, resume=True, **options)


@pytest.mark.parametrize("what", ["shape", "chunks"])
def test_a_forged_size_is_refused_in_each_array(what, tmp_path):
    """Reading it would take any amount of memory."""
    pytest.importorskip("zarr")
    path = tmp_path / "run.zarr"
    options = {"save_every": 2, "events": lambda t, y: y[0]}
    stored(out=path, **options)
    for item in sorted(path.glob("*/zarr.json")):
        text, name = item.read_text(), item.parent.name
        changed = json.loads(text)
        sizes = changed["shape"] if what == "shape" else changed["chunk_grid"]["configuration"]["chunk_shape"]
        if (name, what) in (("time", "chunks"), ("event_t", "shape")):
            continue  # not read; one entry for each event that the counts have
        sizes[-1] = 10**12
        item.write_text(json.dumps(changed))
        with pytest.raises(CheckpointError, match=rf"is damaged: its array '{name}' has the shape"):
            stored(out=path, resume=True, **options)
        item.write_text(text)
    same(stored(**options), stored(out=path, resume=True, **options))


def test_what_is_no_store_is_named(tmp_path):
    """A group in place of an array, codecs in a wrong order, and a label that is not a mapping."""
    pytest.importorskip("zarr")
    path = tmp_path / "run.zarr"
    stored(out=path)
    where = path / "status" / "zarr.json"
    text = where.read_text()
    where.write_text(json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {}}))
    with pytest.raises(CheckpointError, match="is not an ensemble of eip_scipy: its 'status' is not an array"):
        stored(out=path, resume=True)
    changed = json.loads(text)
    changed["codecs"].append(changed["codecs"][0])
    where.write_text(json.dumps(changed))
    with pytest.raises(CheckpointError, match="is not an ensemble of eip_scipy"):
        stored(out=path, resume=True)
    where.write_text(text)
    own = json.loads((path / "zarr.json").read_text())
    own["attributes"]["eip_scipy_ensemble"] = [1, 2]
    (path / "zarr.json").write_text(json.dumps(own))
    with pytest.raises(CheckpointError, match=r"its attribute 'eip_scipy_ensemble' is \[1, 2\], not a mapping"):
        stored(out=path, resume=True)


@pytest.mark.parametrize("array", ["y", "states"])
@pytest.mark.parametrize("how", ["lost", "cut", "overwritten"])
def test_a_damaged_file_of_finished_members(how, array, tmp_path):
    """Name the members whose states cannot be read."""
    pytest.importorskip("zarr", reason="needs zarr")
    path = tmp_path / "run.zarr"
    stored(out=path)
    chunk = path / array / "c" / "/".join("200" if array == "states" else "20")
    if how == "lost":
        chunk.unlink()
    else:
        chunk.write_bytes(chunk.read_bytes()[:10] if how == "cut" else b"something else" * 20)
    says = "member 6 is marked as finished, but its states are missing"
    if how != "lost":
        says = "the results of the members 6 to 8 cannot be read: "
    with pytest.raises(CheckpointError, match=rf"run\.zarr' is damaged: {says}.*\. Restore a copy of the group, or"):
        stored(out=path, resume=True)


def test_a_damaged_file_of_the_status(tmp_path):
    """Name what cannot be read; a lost file makes its members run again."""
    pytest.importorskip("zarr", reason="needs zarr")
    path = tmp_path / "run.zarr"
    whole = stored(out=path)
    chunk = path / "status" / "c" / "2"
    chunk.write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"run\.zarr' is damaged: the status of the members cannot be read"):
        stored(out=path, resume=True)
    chunk.unlink()
    same(whole, stored(out=path, resume=True))


def test_members_that_end_before_their_first_saved_state(tmp_path):
    """Their rows are NaN, and nothing is missing."""
    pytest.importorskip("zarr", reason="needs zarr")

    def early(t, y):
        return t - 0.2

    early.terminal = True
    options = {"out": tmp_path / "run.zarr", "events": early, "save_every": None, "t_eval": [0.5, 1.0]}
    whole = stored(**options)
    assert (whole.status == 1).sum() == 10
    same(whole, stored(resume=True, **options))


def test_checkpoints_in_time(tmp_path):
    """Each chunk, where the seconds are over; and a file in use is whole."""
    path, seen = tmp_path / "kept", []

    def callback(part):
        seen.append(checkpoint.read(path, "ensemble")[0]["finished"])

    stored(checkpoint=path, checkpoint_every=1e-9, callback=callback)
    assert seen[0] == 3
    assert sorted(seen) == seen


def test_a_full_disk_is_a_warning(tmp_path, monkeypatch):
    """The result exists all the same, and so does the former file."""
    path, write = tmp_path / "kept", checkpoint.write

    def full(*arguments):
        if path.exists():
            raise CheckpointError("cannot write the checkpoint: no space left on device")
        write(*arguments)

    monkeypatch.setattr(checkpoint, "write", full)
    with pytest.warns(RuntimeWarning, match="no space left on device; the previous checkpoint is kept"):
        same(stored(), stored(checkpoint=path))
    assert checkpoint.read(path, "ensemble")[0]["finished"] == 0


def test_without_zarr(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r'out= needs zarr: pip install "eip_scipy\[zarr\]"'):
        stored(out=tmp_path / "run.zarr")


KILLED = """
import os, signal, sys, numpy as np
sys.path.insert(0, {tests!r})
from systems import SQUARE, oscillator
from eip_scipy import ensemble
def callback(part):
    if part.first == 3:
        os.kill(os.getpid(), signal.SIGKILL)
y0s = np.random.default_rng(3).standard_normal((11, 2))
y0s[5] = np.nan
ensemble(oscillator, (0, 1), y0s, h=0.1, invariants=SQUARE, save_every=4, chunk=3, {where}={path!r}, callback=callback,
         checkpoint_every=1e-9)
"""


@pytest.mark.posix
@both_stores
def test_a_killed_run_goes_on(where, tmp_path):
    path = str(tmp_path / "kept")
    code = KILLED.format(tests=str(Path(__file__).parents[1]), where=where, path=path)
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
    ran = []
    same(stored(), stored(resume=True, callback=lambda part: ran.append(part.first), **{where: path}))
    assert ran[-2:] == [6, 9]
    assert ran[0] > 0
