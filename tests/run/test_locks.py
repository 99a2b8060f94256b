"""The lock of a checkpoint has one holder at any time."""

import contextlib
import threading
import time

import pytest

from eip_scipy.checkpoint import CheckpointError, held


@pytest.mark.slow
def test_one_holder_at_any_time(tmp_path):
    """Each run removes the lock's file when it ends: others that have it open detect that."""
    inside, most, taken, end = [0], [0], [0], time.monotonic() + 2.0

    def compete():
        while time.monotonic() < end:
            with contextlib.suppress(CheckpointError), held(tmp_path / "kept", "integrate", "run", False):
                inside[0] += 1
                most[0] = max(most[0], inside[0])
                taken[0] += 1
                time.sleep(0)
                inside[0] -= 1

    threads = [threading.Thread(target=compete) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
    assert taken[0] > 10
    assert list(tmp_path.iterdir()) == []
