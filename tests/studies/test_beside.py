"""The second process of a command."""

import os
import time
from functools import partial

import pytest

from eip_scipy_studies.beside import Beside, workers
from eip_scipy_studies.report import UsageError


def test_calls_come_back_one_by_one():
    with Beside() as beside:
        beside.start(os.getpid)
        assert beside.result() != os.getpid()
        beside.start(partial(int, "seven"))
        with pytest.raises(ValueError, match="'seven'"):
            beside.result()
        beside.start(partial(sum, (1, 2)))
        assert beside.result() == 3
        beside.start(partial(os._exit, 1))
        with pytest.raises(UsageError, match="has died"):
            beside.result()
        beside.start(os.getpid)
        with pytest.raises(UsageError, match="has died"):
            beside.result()


def test_who_leaves_does_not_wait():
    begin = time.monotonic()
    with Beside() as beside:
        beside.start(partial(time.sleep, 600))
    assert time.monotonic() - begin < 60


def test_workers_share_calls():
    with workers(2) as start:
        values = [start(pow, 2, k) for k in range(8)]
        failing = start(int, "x")
        assert [value() for value in values] == [2**k for k in range(8)]
        with pytest.raises(ValueError, match="invalid literal"):
            failing()
    begin = time.monotonic()
    with workers(2) as start:
        died = start(os._exit, 1)
        with pytest.raises(UsageError, match="has died"):
            died()
    with workers(1) as start:
        start(time.sleep, 600)
    assert time.monotonic() - begin < 60
