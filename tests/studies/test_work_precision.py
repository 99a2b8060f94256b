"""Error against cost."""

import numpy as np
import pytest

from eip_scipy_studies.work_precision import WorkPoint, work_precision


def test_work_precision_takes_the_least_time_and_leaves_failures_without_error():
    seconds = iter([3.0, 5.0, 0.4, 1.0, 0.2, 1.5])
    ran = []

    def good(step):
        ran.append(step)
        return next(seconds), np.array([step])

    def bad(step):
        return 0.1, np.array([np.nan])

    ticks = []
    done = work_precision(
        {"good": (good, [2.0, 1.0]), "bad": (bad, [1.0])},
        lambda y: y[0] ** 2,
        repeats=3,
        enough_seconds=4.0,
        callback=lambda: ticks.append(1),
    )
    assert ran == [2.0, 1.0, 2.0, 2.0]  # 1.0 took 5 s, more than enough
    assert done.points[:2] == (WorkPoint("good", 2.0, 0.4, 4.0), WorkPoint("good", 1.0, 5.0, 1.0))
    assert np.isnan(done.points[2].error)
    assert len(ticks) == 9
    assert "Python" in done.machine


def test_work_precision_refuses_no_repeats():
    with pytest.raises(ValueError, match="at least 1"):
        work_precision({}, float, repeats=0)
