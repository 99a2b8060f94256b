"""The processes of a command."""

import os
import time

import pytest

from eip_scipy_studies.beside import workers
from eip_scipy_studies.report import UsageError


def test_workers_share_calls():
    with workers(2) as start:
        assert start(os.getpid)() != os.getpid()
        values = [start(pow, 2, k) for k in range(8)]
        failing = start(int, "x")
        assert [value() for value in values] == [2**k for k in range(8)]
        with pytest.raises(ValueError, match="invalid literal"):
            failing()
    begin = time.monotonic()
    with workers(2) as start:
        died = start(os._exit, 1)
        with pytest.raises(UsageError, match="a process of this command has died"):
            died()
    with workers(1) as start:
        failing = start(int, "seven")
        with pytest.raises(ValueError, match="'seven'"):
            failing()
        assert start(sum, (1, 2))() == 3
        died = start(os._exit, 1)
        with pytest.raises(UsageError, match="the second process of this command has died"):
            died()
    with workers(1) as start:
        start(time.sleep, 600)
    assert time.monotonic() - begin < 60
