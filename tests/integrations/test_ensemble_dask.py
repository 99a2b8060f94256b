"""Ensembles on Dask: the same bits on any number of workers, lost workers, members that kill workers, permissions."""

import itertools
import os
import signal
import threading
import time
import traceback
from concurrent.futures import CancelledError
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit

from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.problems import kepler

distributed = pytest.importorskip("distributed", reason="needs Dask's distributed")
dask = pytest.importorskip("dask", reason="needs Dask")
psutil = pytest.importorskip("psutil", reason="needs psutil, which comes with distributed")

from eip_scipy.integrations import dask as integration  # noqa: E402
from eip_scipy.integrations.dask import DaskExecutor, local_client, require_secure  # noqa: E402

slow = pytest.mark.slow
SPAN = (0.0, 60.0)


def starts(members):
    y0s = kepler().y0 * (1 + 1e-3 * np.random.default_rng(members).standard_normal((members, 4)))
    y0s[members // 3] = np.nan
    return y0s


def same(one, other):
    for name in ("y", "t", "status", "message", "max_defect", "max_correction", "nfev", "njev", "nlu", "times"):
        assert np.array_equal(one[name], other[name], equal_nan=name != "message"), name
    if one.statistics is not None:
        for name in ("count", "mean", "squares", "min", "max"):
            np.testing.assert_array_equal(getattr(one.statistics, name), getattr(other.statistics, name))


@pytest.fixture(scope="module", params=[1, 2, 4])
def workers(request):
    client = local_client(request.param)
    yield client
    client.close()
    client.cluster.close()


def listening():
    """Return addresses on which this process and its children listen."""
    me = psutil.Process()
    connections = [c for p in (me, *me.children(recursive=True)) for c in p.net_connections("inet")]
    return {c.laddr for c in connections if c.status == psutil.CONN_LISTEN}


@pytest.fixture(scope="module")
def others():
    """Return addresses that were open before: MPI opens some when it is imported."""
    return listening()


@pytest.fixture(scope="module")
def pair(others):
    """Let Dask give up at once a chunk whose worker died: this package has to run it again."""
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        client = local_client(2)
        yield client
        client.close()
        client.cluster.close()


@pytest.mark.nightly
@slow
def test_bits_do_not_depend_on_the_number_of_workers(workers):
    y0s = starts(100)
    for more in ({}, {"save_every": 100, "reduce": "state"}):
        here, there = (ensemble(kepler(), SPAN, y0s, executor=where, **more) for where in (None, workers))
        same(here, there)
        assert here.failed.tolist() == [33]


@pytest.mark.nightly
@pytest.mark.slow
@slow
def test_functions_without_a_module(pair):
    @njit
    def fun(t, y, p):
        return np.array([y[1], -p[0] * y[0]])

    params = np.linspace(1.0, 2.0, 20)[:, None]
    run = ensemble(fun, (0, 3), [1.0, 0.0], params=params, h=0.1, executor=pair, save_every=10)
    for k in (0, 19):
        own = integrate(fun, (0, 3), [1.0, 0.0], params=params[k], method=EIPRK4, h=0.1, save_every=10)
        np.testing.assert_array_equal(run.trajectories[k], own.y)


@pytest.mark.nightly
@slow
@pytest.mark.posix
@pytest.mark.parametrize("allowed_failures", [0, 3])
def test_a_killed_worker_loses_nothing(allowed_failures):
    """One of two workers gets SIGKILL while it computes; its chunks run again, by Dask or, if it gives up, by us."""
    y0s = starts(400)
    here = ensemble(kepler(), SPAN, y0s, chunk=8)
    victims = []

    def kill(part):
        if not victims:
            victims.append(next(iter(client.run(os.getpid).values())))
            os.kill(victims[0], signal.SIGKILL)

    with dask.config.set({"distributed.scheduler.allowed-failures": allowed_failures}):
        client = local_client(2)
    try:
        there = ensemble(kepler(), SPAN, y0s, chunk=8, executor=client, callback=kill)
    finally:
        client.close()
        client.cluster.close()
    same(here, there)
    assert victims


def deadly(t, y):
    if y[0] > 100.0:
        os._exit(1)
    return np.array([y[1], -y[0]])


@pytest.mark.nightly
@slow
def test_a_member_that_kills_its_workers_is_found(pair):
    y0s = np.ones((24, 2))
    y0s[13] = [99.9, 10.0]  # not at the start, which is tried here too
    run = ensemble(deadly, (0, 1), y0s, h=0.1, chunk=8, executor=pair, reduce="state")
    assert run.failed.tolist() == [13]
    assert "its workers died" in run.message[13]
    own = integrate(deadly, (0, 1), y0s[0], method=EIPRK4, h=0.1)
    np.testing.assert_array_equal(np.delete(run.y, 13, axis=0), np.tile(own.y[:, -1], (23, 1)))
    assert run.statistics.count.tolist() == [23]


@pytest.mark.nightly
@slow
def test_a_member_that_kills_its_workers_as_dask_is_set_up():
    """The chunk and each of its parts are tried three times; the workers are new each time."""
    y0s = np.ones((4, 2))
    y0s[2] = [99.9, 10.0]
    client = local_client(1)
    try:
        run = ensemble(deadly, (0, 1), y0s, h=0.1, chunk=2, executor=client)
    finally:
        client.close()
        client.cluster.close()
    assert run.failed.tolist() == [2]


def slow_oscillator(t, y):
    time.sleep(2e-3)
    return np.array([y[1], -y[0]])


@pytest.mark.nightly
@slow
@pytest.mark.posix
def test_all_workers_are_killed_in_the_middle_of_their_tasks(pair):
    y0s = np.random.default_rng(0).standard_normal((12, 2))
    options = {"h": 0.05, "chunk": 3, "compiled": False}
    timer = threading.Timer(1.0, lambda: [os.kill(pid, signal.SIGKILL) for pid in pids])
    pids = list(pair.run(os.getpid).values())
    timer.start()
    there = ensemble(slow_oscillator, (0, 10), y0s, executor=pair, **options)
    timer.join()
    same(ensemble(oscillator, (0, 10), y0s, **options), there)


@pytest.mark.nightly
@slow
def test_workers_that_die_while_they_start(tmp_path):
    (tmp_path / "die.py").write_text("import os; os._exit(3)", encoding="utf-8")
    with (
        dask.config.set({"distributed.worker.preload": [str(tmp_path / "die.py")]}),
        pytest.raises(RuntimeError, match="a Dask worker of this machine died while it started") as info,
    ):
        ensemble(oscillator, (0, 1), np.ones((4, 2)), h=0.1, executor="dask")
    assert info.value.__suppress_context__
    assert info.value.partial.status.tolist() == [-2] * 4


@slow
def test_nothing_listens_beyond_this_machine(pair, others):
    found = listening() - others
    assert found
    assert {address.ip for address in found} <= {"127.0.0.1", "::1"}


@slow
def test_by_name():
    y0s = starts(20)
    same(ensemble(kepler(), SPAN, y0s), ensemble(kepler(), SPAN, y0s, executor="dask"))


@slow
def test_ctrl_c(pair):
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt) as info:
        ensemble(kepler(), (0, 1e5), starts(64), executor=pair)
    assert time.perf_counter() - begin < 10
    assert (info.value.partial.status == -2).any()


def oscillator(t, y):
    return np.array([y[1], -y[0]])


def test_a_short_error_for_workers_that_die_while_they_start(monkeypatch):
    def cluster(**options):
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr(integration.distributed, "LocalCluster", cluster)
    with pytest.raises(RuntimeError, match=r"died while it started \(Nanny failed to start\.\).*Try fewer") as info:
        local_client(2)
    assert "\n" not in "".join(traceback.format_exception_only(info.value)).strip()
    assert info.value.__suppress_context__


def test_a_closed_client(tmp_path):
    client = distributed.Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None)
    executor, y0s = DaskExecutor(client), np.ones((40, 2))
    options = {"h": 0.1, "chunk": 1, "compiled": False, "checkpoint": tmp_path / "kept"}
    with pytest.raises(RuntimeError, match="the Dask client was closed, or lost its scheduler, while members") as info:
        ensemble(oscillator, (0, 1), y0s, executor=client, callback=lambda part: client.close(), **options)
    done = int((info.value.partial.status == 0).sum())
    assert 1 <= done < 40
    for closed in (client, executor):
        with pytest.raises(
            RuntimeError, match="the Dask client given as executor= is closed; give an open one"
        ) as info:
            ensemble(oscillator, (0, 1), y0s, executor=closed, resume=True, **options)
        assert (info.value.partial.status == 0).sum() == done
    ran = []
    assert ensemble(
        oscillator, (0, 1), y0s, resume=True, callback=lambda part: ran.append(part.first), **options
    ).success
    assert ran[0] == done


def test_workers_in_this_process():
    y0s = np.random.default_rng(0).standard_normal((20, 2))
    y0s[7] = np.nan
    client = distributed.Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None)
    try:
        runs = [
            ensemble(oscillator, (0, 1), y0s, h=0.1, save_every=3, reduce="state", chunk=4, executor=where)
            for where in (None, client, DaskExecutor(client))
        ]
    finally:
        client.close()
    same(runs[0], runs[1])
    same(runs[0], runs[2])


class Asked:
    """A future."""

    def __init__(self, result):
        self.result = result


class Lost:
    """A client whose workers die of the member 13 only; results arrive at the second request."""

    cluster, status = None, "running"

    def submit(self, function, task, plan, chunk, *, key, pure):
        late = []

        def result(timeout):
            if not late:
                late.append(timeout)
                raise TimeoutError
            if (chunk.y0s[:, 0] == 13).any():
                raise distributed.KilledWorker(key, SimpleNamespace(address="tcp://127.0.0.1:1"), 3)
            return function(task, plan, chunk)

        return Asked(result)

    def nthreads(self):
        return {"tcp://127.0.0.1:1": 1}

    def cancel(self, futures):
        assert not futures


def test_halves_of_halves(monkeypatch):
    monkeypatch.setattr(integration, "GRACE", 0.0)
    y0s = np.column_stack([np.arange(20.0), np.zeros(20)])
    run = ensemble(
        oscillator, (0, 1), y0s, h=0.1, chunk=7, reduce="state", executor=DaskExecutor(Lost(), allow_insecure=True)
    )
    whole = ensemble(oscillator, (0, 1), y0s, h=0.1, chunk=7)
    assert run.failed.tolist() == [13]
    assert "its workers died" in run.message[13]
    np.testing.assert_array_equal(run.y[13], y0s[13])
    np.testing.assert_array_equal(np.delete(run.y, 13, axis=0), np.delete(whole.y, 13, axis=0))
    assert run.statistics.count.tolist() == [19]


class Cluster:
    """A local cluster whose workers are gone for good; it counts how often they were requested."""

    worker_spec, workers = (0, 1), ()

    def __init__(self):
        self.scaled = []

    def scale(self, workers):
        self.scaled.append(workers)


class Deserted:
    """A client without workers, whose results take a while."""

    status = "running"

    def __init__(self, cluster, results):
        self.cluster, self._results, self._first = cluster, results, True

    def submit(self, function, task, plan, chunk, *, key, pure):
        def result(timeout):
            answer = next(self._results)
            if isinstance(answer, Exception):
                raise answer
            return function(task, plan, chunk)

        return Asked(result)

    def nthreads(self):
        return {}

    def cancel(self, futures):
        pass


def in_turn(*answers):
    return itertools.chain(answers, itertools.repeat(None))


def deserted(cluster, *answers):
    return ensemble(
        oscillator, (0, 1), np.ones((4, 2)), h=0.1, chunk=2, compiled=False,
        executor=DaskExecutor(Deserted(cluster, in_turn(*answers)), allow_insecure=True),
    )  # fmt: skip


def test_workers_that_do_not_come_back(monkeypatch):
    monkeypatch.setattr(integration.distributed, "LocalCluster", Cluster)
    cluster = Cluster()
    with pytest.raises(RuntimeError, match="all Dask workers of this machine died, 4 times in a row") as info:
        deserted(cluster, *[TimeoutError()] * 10)
    assert cluster.scaled == [0, 2] * 3
    assert info.value.partial.status.tolist() == [-2] * 4
    assert deserted(Cluster(), *[TimeoutError()] * 3).success
    assert deserted(Cluster(), *[TimeoutError()] * 3, None, *[TimeoutError()] * 3).success


def test_a_cluster_without_workers_is_waited_for():
    """A cluster whose jobs have not started yet is waited for, which is reported once."""
    with pytest.warns(RuntimeWarning, match="the Dask cluster has no workers; waiting for some") as record:
        assert deserted(None, *[TimeoutError()] * 10).success
    assert len(record) == 1


def test_tasks_that_are_cancelled():
    with pytest.raises(RuntimeError, match="the tasks on the Dask cluster were cancelled while members ran") as info:
        deserted(None, None, CancelledError("by the user"))
    assert info.value.partial.status.tolist() == [0, 0, -2, -2]


def test_other_errors_stay_what_they_are():
    with pytest.raises(TypeError, match="a number"):
        deserted(None, TypeError("expected a number"))


class Client:
    """Client with the attributes that `require_secure` reads."""

    status = "running"

    def __init__(self, scheduler, *workers):
        self._found = {"address": scheduler, "workers": dict.fromkeys(workers)}

    def scheduler_info(self, n_workers):
        assert n_workers == -1
        return self._found


@pytest.mark.parametrize(
    "addresses",
    [
        ("tcp://127.0.0.1:8786", "tcp://127.0.0.1:1", "tcp://[::1]:2"),
        ("tls://10.0.0.1:8786", "tls://10.0.0.2:1"),
        ("wss://example.org:8786", "tls://10.0.0.2:1"),
        ("inproc://10.0.0.1/1/1", "inproc://10.0.0.1/1/3"),
        ("tcp://localhost:8786",),
    ],
)
def test_secure_clusters(addresses):
    require_secure(Client(*addresses))


@pytest.mark.parametrize(
    "addresses",
    [
        ("tcp://10.0.0.1:8786",),
        ("tcp://0.0.0.0:8786",),
        ("tcp://127.0.0.1:8786", "tcp://192.168.0.2:1"),
        ("ws://10.0.0.1:8786",),
        ("tcp://head-node:8786",),
        ("tls://10.0.0.1:8786", "tcp://10.0.0.2:1"),
    ],
)
def test_insecure_clusters_are_refused(addresses):
    with pytest.raises(PermissionError, match=r"without encryption.*CVE-2021-42343.*allow_insecure=True"):
        require_secure(Client(*addresses))
    assert DaskExecutor(Client(*addresses), allow_insecure=True).client
