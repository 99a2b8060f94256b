"""Runs that are stopped after any few steps, and resumed from a checkpoint that holds all that they need."""

import contextlib

import numpy as np
import pytest

from eip_scipy import checkpoint
from eip_scipy.run import integrate as longrun
from eip_scipy.run import resume


@pytest.fixture
def fine(monkeypatch):
    """Return short chunks with a snapshot after each; values that are not in a checkpoint are NaN in a resumed run."""
    monkeypatch.setattr(longrun, "FIRST_CHUNK", 5)
    monkeypatch.setattr(longrun, "CHUNK_SECONDS", 0.0)
    monkeypatch.setattr(resume, "SNAPSHOT_SECONDS", 0.0)
    monkeypatch.setattr(resume, "LEAST_RATIO", 0.0)
    load = longrun.Driver.load

    def poisoned(driver, *rows):
        known = [a.copy() for a in driver.parts().values()]
        w, grid = driver.run.work, driver.schedule
        for buffer in (*w, grid.g_new, driver.new, driver.t, driver.y):
            buffer[...] = np.nan if buffer.dtype.kind in "fc" else 77
        for part, value in zip(driver.parts().values(), known, strict=True):
            part[...] = value
        load(driver, *rows)

    monkeypatch.setattr(longrun.Driver, "load", poisoned)


@pytest.fixture
def stopped(monkeypatch):
    """Return a context in which a run ends, without an exception outside, before the chunk of the given number."""

    @contextlib.contextmanager
    def at(calls):
        advance, left = longrun.Driver.advance, [calls]

        def stop(driver, k_end):
            left[0] -= 1
            if left[0] < 0:
                raise InterruptedError
            return advance(driver, k_end)

        with monkeypatch.context() as patch, contextlib.suppress(InterruptedError):
            patch.setattr(longrun.Driver, "advance", stop)
            yield

    return at


@pytest.fixture
def times_written(monkeypatch):
    """Return a function that notes when a run writes checkpoints, with 200 chunks of 10 ms of a simulated clock."""

    def times(run, path, every, seconds=0.0):
        now, written, advance, write = [0.0], [], longrun.Driver.advance, checkpoint.write

        def tick(driver, k_end):
            now[0] += 0.01
            return advance(driver, min(k_end, driver.step + 1))

        def note(path, header, arrays):
            now[0] += seconds
            written.append((now[0], header["step"], header["status"]))
            write(path, header, arrays)

        with monkeypatch.context() as patch:
            patch.setattr(longrun.Driver, "advance", tick)
            patch.setattr(resume.time, "perf_counter", lambda: now[0])
            patch.setattr(checkpoint, "write", note)
            run(checkpoint=path, checkpoint_every=every)
        return written

    return times
