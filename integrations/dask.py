"""Ensembles on Dask: members run on the workers of a cluster, from processes of this machine to a supercomputer.

``ensemble(..., executor="dask")`` takes the cluster that Dask's configuration names (``DASK_SCHEDULER_ADDRESS``), or
starts processes on this machine that listen on its loopback interface only. ``executor=client`` takes a
`distributed.Client`. Functions travel by value or by name, as Dask sends them, and are compiled once in each worker.

Needs ``pip install "eip_scipy[distributed]"``.
"""

from __future__ import annotations

import ipaddress
import time
import uuid
import warnings
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from eip_scipy.ensembles.chunks import Chunk, Part, cores, finished, run_elsewhere
from eip_scipy.ensembles.tasks import FAILED, Members, Plan, Task

try:
    import dask
    import distributed
    from distributed.comm.addressing import get_address_host
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.dask needs distributed: pip install "eip_scipy[distributed]"', name="distributed"
    ) from error

__all__ = ["DaskExecutor", "local_client", "pool"]

SAFE = ("tls", "wss", "inproc")  # protocols that encrypt, or stay within a process
RUNNING = "running"
# Seconds between two checks for workers, and before a member is tried that may kill one.
PATIENCE, GRACE = 20.0, 1.0
# Number of times that all workers of this machine may be lost without a result in between.
LOSSES = 3
KEPT = (
    "What was done is in this exception's .partial; with out= or checkpoint= the same call with resume=True continues "
    "from there"
)


class DaskExecutor:
    """Dask client for ``ensemble(..., executor=)``, which may use a network without encryption if this is permitted.

    Parameters
    ----------
    client : distributed.Client
    allow_insecure : bool, optional
        Continue if the cluster is reached over a network without encryption. Anyone who reaches such a scheduler or
        worker can run code on it as you (CVE-2021-42343): use it only if nobody else reaches the network.

    Raises
    ------
    PermissionError
        If the cluster listens beyond this machine without TLS, and `allow_insecure` is false.
    RuntimeError
        If the client is closed, and `allow_insecure` is false.
    """

    def __init__(self, client: distributed.Client, *, allow_insecure: bool = False) -> None:
        self.client = client
        if not allow_insecure:
            require_secure(client)


def local_client(workers: int | None = None) -> distributed.Client:
    """Start worker processes on this machine, one thread each, that listen on its loopback interface only.

    Parameters
    ----------
    workers : int, optional
        Number of processes; default: as many as there are cores.

    Returns
    -------
    distributed.Client
        The client of these workers. Close it and its ``cluster`` after use.

    Raises
    ------
    RuntimeError
        If a process dies while it starts.
    """
    loopback = "127.0.0.1"
    try:
        cluster = distributed.LocalCluster(
            n_workers=cores() if workers is None else workers,
            threads_per_worker=1,
            processes=True,
            host=loopback,
            dashboard_address=f"{loopback}:0",
            worker_dashboard_address=f"{loopback}:0",
        )
    except RuntimeError as error:
        # Dask's own traceback shows a hundred lines of its internals and no further information.
        raise RuntimeError(
            f"a Dask worker of this machine died while it started ({error}): it was killed, there is too little memory "
            "for these workers, or what Dask's configuration loads fails. Try fewer with local_client(workers), or "
            "correct the configuration."
        ) from None
    return distributed.Client(cluster)


def require_secure(client: distributed.Client) -> None:
    """Raise PermissionError if a scheduler or worker listens beyond this machine without TLS, see `DaskExecutor`."""
    _require_open(client)
    information = client.scheduler_info(n_workers=-1)
    for address in (information["address"], *information["workers"]):
        if not _is_secure(address):
            raise PermissionError(
                f"the Dask cluster at {address} is reached over a network without encryption or authentication. "
                "Anyone who reaches it can run code there as you (CVE-2021-42343). Start it with TLS "
                "(distributed.Security), or, on a network that nobody else reaches, pass "
                "executor=DaskExecutor(client, allow_insecure=True)."
            )


def _require_open(client: distributed.Client) -> None:
    if client.status != RUNNING:
        raise RuntimeError(f"the Dask client given as executor= is {client.status}; give an open one.")


def _is_secure(address: str) -> bool:
    protocol, _, rest = address.partition("://")
    if protocol in SAFE:
        return True
    host = get_address_host(address) if rest else address
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def pool(executor: Any, task: Task, key: str) -> DaskPool:
    """Return the pool that runs the chunks of an ensemble, for `eip_scipy.ensemble`.

    `executor` is "dask", a `distributed.Client` or a `DaskExecutor`, `task` the part of the ensemble that all chunks
    share, and `key` the name under which a worker keeps the compiled task for further chunks. Errors are those of
    `DaskExecutor`, and of `local_client` if processes are started.
    """
    if isinstance(executor, DaskExecutor):
        _require_open(executor.client)
        return DaskPool(executor.client, task, key, own=False)
    if isinstance(executor, distributed.Client):
        return DaskPool(DaskExecutor(executor).client, task, key, own=False)
    if dask.config.get("scheduler-address", None):
        return DaskPool(DaskExecutor(distributed.Client()).client, task, key, own=True)
    Plan(task).compile()  # compiled here, so that the workers find it on the disk instead of all compiling the same
    return DaskPool(local_client(), task, key, own=True)


class DaskPool:
    """Pool that runs the chunks of an ensemble as tasks of Dask, which repeats the tasks of lost workers on others.

    `task` and `key` are as for `pool`. If `own` is True, `close` closes the client and its cluster.
    """

    def __init__(self, client: distributed.Client, task: Task, key: str, *, own: bool) -> None:
        self._client, self._task, self._key, self._own = client, task, key, own
        self._open: set[distributed.Future] = set()
        self._losses = 0
        self._warned = False

    def capacity(self) -> int:
        """Return the number of threads of the present workers; at least 1, because workers may still be starting."""
        with self._connected():
            return max(1, sum(self._client.nthreads().values()))

    def submit(self, chunk: Chunk) -> distributed.Future:
        return self._submit(self._task, chunk)

    def collect(self, chunk: Chunk, ticket: distributed.Future) -> Part:
        try:
            return self._result(ticket)
        except distributed.KilledWorker as error:
            plan = Plan(self._task)
            members = self._one_by_one(replace(self._task, reduce=None, keep=True), plan, chunk, error)
            return finished(self._task, plan, members)

    def close(self) -> None:
        if self._client.status == RUNNING:
            self._client.cancel(list(self._open))
        if self._own:
            cluster = self._client.cluster
            self._client.close()
            if cluster is not None:
                cluster.close()

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """Replace an error in the block by a RuntimeError with advice if the client, cluster or tasks are lost."""
        try:
            yield
        except Exception as error:
            if self._client.status != RUNNING:
                what = "the Dask client was closed, or lost its scheduler,"
            elif isinstance(error, CancelledError):
                what = "the tasks on the Dask cluster were cancelled"
            else:
                raise
            raise RuntimeError(f"{what} while members ran. {KEPT}, with an open client.") from error

    def _submit(self, task: Task, chunk: Chunk) -> distributed.Future:
        name = f"eip-ensemble-{chunk.first}-{uuid.uuid4().hex}"
        key = self._key if task is self._task else f"{self._key}-again"
        with self._connected():
            future = self._client.submit(run_elsewhere, task, key, chunk, key=name, pure=False)
        self._open.add(future)
        return future

    def _result(self, future: distributed.Future) -> Part:
        try:
            with self._connected():
                while True:
                    try:
                        part: Part = future.result(timeout=PATIENCE)
                    except TimeoutError:
                        self._look_after_workers()
                    else:
                        self._losses = 0
                        return part
        finally:
            self._open.discard(future)

    def _look_after_workers(self) -> None:
        """Start new processes if all those of this machine are gone; warn once if a cluster elsewhere has no workers.

        Dask's supervisor of a worker (its "nanny") gives up on a process that dies while it starts, and Dask then waits
        without end. RuntimeError is raised if the processes were lost more than `LOSSES` times without a result.
        """
        if self._client.nthreads():
            return
        cluster = self._client.cluster
        if not isinstance(cluster, distributed.LocalCluster):
            if not self._warned:
                self._warned = True
                warnings.warn(
                    "the Dask cluster has no workers; waiting for some. Start workers that connect to its scheduler.",
                    RuntimeWarning,
                    stacklevel=2,
                )
            return
        self._losses += 1
        if self._losses > LOSSES:
            raise RuntimeError(
                f"all Dask workers of this machine died, {self._losses} times in a row: while they started, or by "
                f"the members that they ran. {KEPT}, for example with fewer workers: executor=local_client(workers)."
            )
        workers = len(cluster.worker_spec)
        cluster.scale(0)
        until = time.monotonic() + PATIENCE
        while cluster.workers and time.monotonic() < until:
            time.sleep(0.1)
        cluster.scale(workers)

    def _wait_for_workers(self) -> None:
        """Wait until there is a worker; if none appears, see `_look_after_workers`."""
        until = time.monotonic() + PATIENCE
        while not self._client.nthreads():
            if time.monotonic() > until:
                self._look_after_workers()
                until = time.monotonic() + PATIENCE
            time.sleep(0.1)
        time.sleep(GRACE)

    def _one_by_one(self, task: Task, plan: Plan, chunk: Chunk, error: Exception) -> Members:
        """Run a chunk that killed its workers, with `error`, in halves, again and again, by `task`.

        The status of a member that kills its workers alone is `FAILED`; `plan` makes its result.
        """
        m = len(chunk.y0s)
        if m == 1:
            members = plan.empty(1)
            members.y[:], members.t[:], members.status[:] = chunk.y0s, plan.t0, FAILED
            members.message[0] = f"its workers died, one after the other: {error}"
            return members
        found = []
        for first, last in ((0, m // 2), (m // 2, m)):
            with self._connected():
                self._wait_for_workers()
            half = chunk.part(first, last)
            try:
                found.append(self._result(self._submit(task, half)).members)
            except distributed.KilledWorker as again:
                found.append(self._one_by_one(task, plan, half, again))
        return Members.joined(found)
