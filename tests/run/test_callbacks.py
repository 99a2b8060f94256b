"""Runs with a callback at every step: of any length, with any end, and on endless intervals."""

import itertools
import math

import numpy as np
import pytest
from numba import njit
from systems import SQUARE, oscillator

from eip_scipy import EIPRK4, EIPRK45, Invariant, integrate

Y0 = [1.0, 2.0]
# Beyond a thousand doublings of a number of steps, where no float holds it any more.
MANY = 1200


@njit
def passage(t, y):
    return y[0]


FUNCTIONS = {
    "interpreted": {"fun": oscillator, "invariants": SQUARE},
    "compiled": {"fun": njit(oscillator), "invariants": Invariant(njit(SQUARE.fun), njit(SQUARE.grad), name="S")},
}
STEPS = {"fixed": {"method": EIPRK4, "h": 0.01}, "adaptive": {"method": EIPRK45, "max_step": 0.01, "rtol": 1e-3}}


def run(steps, how="interpreted", n=MANY, **options):
    options = {**FUNCTIONS[how], **STEPS[steps], "save_every": 1, **options}
    return integrate(options.pop("fun"), (0.0, 0.01 * n), Y0, **options)


def many(steps, how, n, tmp_path, **options):
    """Run n steps with a callback at each, at once and resumed half way; return the number of calls in each."""
    calls = itertools.count()
    plain = run(steps, how, n, callback=lambda t, y, d: next(calls) and None, **options)
    assert plain.status == 0
    assert plain.t.size >= n
    assert next(calls) == plain.t.size

    class StopError(Exception):
        pass

    def stop(t, y, d):
        if t > 0.005 * n:
            raise StopError

    path = tmp_path / f"{steps}.npz"
    with pytest.raises(StopError):
        run(steps, how, n, callback=stop, checkpoint=path, **options)
    calls = itertools.count()
    resumed = run(steps, how, n, callback=lambda t, y, d: next(calls) and None, checkpoint=path, resume=True, **options)
    assert resumed.status == 0
    assert next(calls) >= 0.4 * n
    np.testing.assert_array_equal(resumed.t, plain.t)
    np.testing.assert_array_equal(resumed.y, plain.y)
    return plain


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("how", [pytest.param("compiled", marks=pytest.mark.needs_jit), "interpreted"])
def test_a_callback_at_every_step(steps, how, tmp_path):
    found = many(steps, how, MANY, tmp_path, events=passage)
    np.testing.assert_allclose(np.diff(found.t_events[0]), math.pi, rtol=1e-6)
    assert found.t_events[0].size == int((0.01 * MANY + math.atan2(1, 2)) / math.pi)


@pytest.mark.parametrize("steps", STEPS)
def test_endless_until_a_callback_stops_it(steps):
    options = STEPS[steps] | {"invariants": SQUARE, "compiled": False}
    found = integrate(oscillator, (0, math.inf), Y0, save_every=5, callback=lambda t, y, d: t > 3, **options)
    assert found.status == 1
    assert found.message.startswith("stopped by the callback")
    assert 3 < found.t[-1] <= 3.06
    np.testing.assert_allclose(found.y[0], np.cos(found.t) + 2 * np.sin(found.t), atol=1e-3)


def test_endless_needs_a_callback_at_saved_steps():
    """Without them it would not be called after the start, or not after the last of the times."""
    callback = {"callback": lambda t, y, d: t > 3}
    for options in (callback, callback | {"t_eval": [1.0, 2.0]}, {"save_every": 1}):
        with pytest.raises(ValueError, match=r"t_span must be finite unless .*callback.*save_every"):
            integrate(oscillator, (0, math.inf), Y0, method=EIPRK4, h=0.1, **options)
