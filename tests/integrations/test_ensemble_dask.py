"""Ensembles on Dask: the same bits on any number of workers, lost workers, permissions."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from numba import njit
from systems import oscillator, refuse, same_fields

from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.problems import kepler

distributed = pytest.importorskip("distributed", reason="needs Dask's distributed")
dask = pytest.importorskip("dask", reason="needs Dask")
psutil = pytest.importorskip("psutil", reason="needs psutil, which comes with distributed")

from eip_scipy.integrations.dask import LOCAL, require_secure  # noqa: E402

SPAN = (0.0, 60.0)


def starts(members):
    y0s = kepler().y0 * (1 + 1e-3 * np.random.default_rng(members).standard_normal((members, 4)))
    y0s[members // 3] = np.nan
    return y0s


@pytest.fixture(scope="module")
def client():
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, **LOCAL) as cluster,
        distributed.Client(cluster) as found,
    ):
        yield found


@pytest.mark.slow
def test_bits_do_not_depend_on_the_workers(client):
    y0s, options = starts(100), {"h": 0.03, "save_every": 100, "reduce": lambda run: run.y.max(axis=1)}
    here = ensemble(kepler(), SPAN, y0s, **options)
    assert here.failed.tolist() == [33]
    for where in (client, client.get_executor(pure=False)):
        same_fields(here, ensemble(kepler(), SPAN, y0s, executor=where, **options))


@pytest.mark.slow
@pytest.mark.needs_jit
def test_functions_without_a_module(client):
    @njit
    def fun(t, y, p):
        return np.array([y[1], -p[0] * y[0]])

    params = np.linspace(1.0, 2.0, 20)[:, None]
    run = ensemble(fun, (0, 3), [1.0, 0.0], params=params, h=0.1, executor=client, save_every=10)
    for k in (0, 19):
        own = integrate(fun, (0, 3), [1.0, 0.0], params=params[k], method=EIPRK4, h=0.1, save_every=10)
        np.testing.assert_array_equal(run.trajectories[k], own.y)


@pytest.mark.nightly
@pytest.mark.posix
def test_a_killed_worker_loses_nothing(client):
    victims, y0s = list(client.run(os.getpid).values())[:1], starts(400)

    def kill(part):
        while victims:
            os.kill(victims.pop(), signal.SIGKILL)

    there = ensemble(kepler(), SPAN, y0s, chunk=8, executor=client, callback=kill)
    assert not victims
    same_fields(ensemble(kepler(), SPAN, y0s, chunk=8), there)


@pytest.mark.slow
def test_by_name_nothing_listens_beyond_this_machine():
    me, seen = psutil.Process(), set()
    before = {c.laddr for c in me.net_connections("inet")}

    def callback(part):
        connections = [c for p in (me, *me.children(recursive=True)) for c in p.net_connections("inet")]
        seen.update(c.laddr for c in connections if c.status == psutil.CONN_LISTEN)

    same_fields(
        ensemble(kepler(), SPAN, starts(20)), ensemble(kepler(), SPAN, starts(20), executor="dask", callback=callback)
    )
    assert {address.ip for address in seen - before} <= {"127.0.0.1", "::1"} != set()


@pytest.mark.slow
@pytest.mark.posix
def test_ctrl_c(client):
    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt) as info:
        ensemble(
            kepler(), (0, 3e3), starts(4000), chunk=8, executor=client,
            callback=lambda part: None if timer.ident else timer.start(),
        )  # fmt: skip
    assert time.perf_counter() - begin < 10
    assert set(info.value.partial.status) >= {0, -2}


def test_a_closed_client(tmp_path):
    client = distributed.Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None)
    options = {"h": 0.1, "chunk": 1, "compiled": False, "checkpoint": tmp_path / "kept"}
    with pytest.raises((RuntimeError, distributed.client.ClosedClientError)) as info:
        ensemble(oscillator, (0, 1), np.ones((40, 2)), executor=client, callback=lambda part: client.close(), **options)
    assert 1 <= (info.value.partial.status == 0).sum() < 40
    with pytest.raises(RuntimeError, match="the Dask client given as executor= is closed; give an open one"):
        ensemble(oscillator, (0, 1), np.ones((40, 2)), executor=client, resume=True, **options)
    assert ensemble(oscillator, (0, 1), np.ones((40, 2)), resume=True, **options).success


class Cluster:
    """Client with the attributes that `require_secure` reads."""

    status = "running"

    def __init__(self, scheduler, *workers):
        self._found = {"address": scheduler, "workers": dict.fromkeys(workers)}

    def scheduler_info(self, n_workers):
        return self._found


def test_clusters_without_encryption_are_refused():
    for addresses in (
        ("tcp://127.0.0.1:8786", "tcp://127.0.0.1:1", "tcp://[::1]:2"),
        ("tls://10.0.0.1:8786", "wss://10.0.0.2:1"),
        ("inproc://10.0.0.1/1/1", "tcp://localhost:8786"),
    ):
        require_secure(Cluster(*addresses))
    words = r"without encryption.*CVE-2021-42343.*get_executor\(pure=False\)"
    hosts = "tcp://10.0.0.1", "tcp://0.0.0.0", "ws://10.0.0.1", "tcp://head-node", "tcp://127.0.0.1.example.org"
    for addresses in (*((f"{host}:1",) for host in hosts), ("tcp://127.0.0.1:8786", "tcp://192.168.0.2:1")):
        refuse(require_secure, [({"client": Cluster(*addresses)}, PermissionError, words)])
