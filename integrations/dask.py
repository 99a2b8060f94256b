"""Ensembles on Dask: ``ensemble(..., executor="dask")``, or ``executor=client`` with a `distributed.Client`.

"dask" is the cluster of Dask's configuration (``DASK_SCHEDULER_ADDRESS``), or processes on this machine that listen on
its loopback interface only. Needs ``pip install "eip_scipy[distributed]"``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

try:
    import dask
    import distributed
    from distributed.comm.addressing import get_address_host
except ModuleNotFoundError as error:
    raise ImportError('executor="dask" needs: pip install "eip_scipy[distributed]"', name="distributed") from error

__all__ = ["connected", "require_secure"]

SAFE, LOOPBACK = ("tls:", "wss:", "inproc:"), re.compile(r"localhost|::1|127(\.\d+){3}")
LOCAL = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}


def connected(executor: Any) -> tuple[Any, Callable[[], int], Callable[[], None]]:
    """Return an executor for "dask" or a client, the function that counts its workers, and the one that closes it."""
    own = not isinstance(executor, distributed.Client)
    local = own and not dask.config.get("scheduler-address", None)
    cluster = distributed.LocalCluster(threads_per_worker=1, processes=True, **LOCAL) if local else None
    client = distributed.Client(cluster) if own else executor

    def end() -> None:
        for item in filter(None, (client, cluster) if own else ()):
            item.close()

    try:
        require_secure(client)
    except BaseException:
        end()
        raise

    def workers() -> int:
        return max(1, sum(client.nthreads().values())) if client.status == "running" else 1

    return client.get_executor(pure=False), workers, end


def require_secure(client: distributed.Client) -> None:
    """Raise PermissionError if a scheduler or worker listens beyond this machine without TLS."""
    if client.status != "running":
        raise RuntimeError(f"the Dask client given as executor= is {client.status}; give an open one.")
    found = client.scheduler_info(n_workers=-1)
    for address in (found["address"], *found["workers"]):
        if address.startswith(SAFE) or LOOPBACK.fullmatch(get_address_host(address)):
            continue
        raise PermissionError(
            f"the Dask cluster at {address} is reached without encryption, so that others can run code as you "
            "(CVE-2021-42343). Use TLS, or in a private network pass executor=client.get_executor(pure=False)."
        )
