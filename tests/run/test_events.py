"""Events of `integrate`: their times, two crossings within one step, and their counts in a run that is continued."""

import math

import numpy as np
import pytest
import scipy.integrate
from numba import njit
from systems import Verlet, oscillator

from eip_scipy import (
    EIPDOP853,
    EIPGJ12,
    EIPRK4,
    EIPRK45,
    EIPRKN12,
    EIPRadau,
    Invariant,
    eip_method,
    ensemble,
    integrate,
    solve_ivp,
)  # fmt: skip
from eip_scipy.problems import Problem

PHASE = 0.3
SPAN = 50.0


def energy(t, y):
    return 0.5 * (y[0] * y[0] + y[1] * y[1])


def energy_gradient(t, y):
    return y.copy()


START = [math.cos(PHASE), -math.sin(PHASE)]
ENERGY = Invariant(energy, grad=energy_gradient)


def passages(level, end=SPAN):
    """Return the times at which cos(t + PHASE) has this level."""
    angle = math.acos(level)
    found = [sign * angle + 2 * math.pi * k - PHASE for k in range(20) for sign in (-1, 1)]
    return np.array(sorted(t for t in found if 0 < t < end))


def reaching(level, direction=0, terminal=None):
    def event(t, y):
        return y[0] - level

    event.direction, event.terminal = direction, terminal
    return event


def compiled(event):
    found = njit(event)
    found.direction, found.terminal = event.direction, event.terminal
    return found


@pytest.mark.parametrize("scale", [1e-15, 1.0, 1e12])
@pytest.mark.parametrize("start", [0.0, -1.0])
def test_times_are_relative_to_the_step(scale, start):
    """The event is at 0.3 of the interval, exactly: y grows by 1 over it."""
    begin = start * scale
    run = integrate(
        lambda t, y: [1 / scale],
        (begin, begin + scale),
        [0.0],
        method=EIPRK45,
        events=lambda t, y: y[0] - 0.3,
        rtol=1e-3,
        atol=1e-6,
    )
    np.testing.assert_allclose(run.t_events[0], [begin + 0.3 * scale], rtol=0, atol=1e-15 * scale)


ACCURATE = {
    "DOP853, adaptive": (EIPDOP853, {"rtol": 1e-12, "atol": 1e-12}, 1e-6),
    "DOP853": (EIPDOP853, {"h": 1.0}, 1e-5),
    "RK4": (EIPRK4, {"h": 0.05}, 1e-3),
    "RK45, few steps": (EIPRK45, {"h": 0.5}, 2e-2),
}


@pytest.mark.parametrize("name", ACCURATE)
def test_both_crossings_of_a_grazing_passage(name):
    """The closed form is cos(t + PHASE) = level; a passage above 1 - 1e-7 takes 9e-4, a thousandth of a step."""
    method, options, error = ACCURATE[name]
    # The errors of the methods of low order are larger than the height of the shortest passages.
    for level in (0.0, 0.9, -0.7, *((0.9999, 1 - 1e-7) if "DOP853" in name else ())):
        kept = {"events": reaching(level), "invariants": ENERGY, "method": method}
        run = integrate(oscillator, (0, SPAN), START, **kept, **options)
        expected = passages(level)
        assert run.t_events[0].size == expected.size
        # An error of the state moves the time by itself over the slope at the passage.
        np.testing.assert_allclose(run.t_events[0], expected, rtol=0, atol=error)
        np.testing.assert_allclose(run.y_events[0][:, 0], level, rtol=0, atol=1e-13)


def test_three_crossings_in_one_step():
    """The event is a cubic of the time with zeros at 0.2, 0.5 and 0.8; the step is from 0 to 1."""
    zeros = np.array([0.2, 0.5, 0.8])
    for direction, expected in ((0, zeros), (1, zeros[::2]), (-1, zeros[1:2])):

        def event(t, y):
            return float(np.prod(y[0] - zeros))

        event.direction = direction
        run = integrate(lambda t, y: [1.0], (0, 1), [0.0], method=EIPRK4, h=1.0, events=event)
        np.testing.assert_allclose(run.t_events[0], expected, rtol=0, atol=1e-15)


def test_zeros_of_high_multiplicity():
    """Brent's method takes more than a hundred steps there."""
    events = [lambda t, y: y[0] ** 3, lambda t, y: y[0] ** 5, lambda t, y: np.sign(y[0]) * y[0] ** 2]
    for steps in ({"h": 0.01}, {"rtol": 1e-10, "atol": 1e-12}):
        run = integrate(oscillator, (0, 10), [1.0, 0.0], method=EIPDOP853, events=events, **steps)
        for times in run.t_events:
            np.testing.assert_allclose(times, np.pi * (np.arange(3) + 0.5), rtol=0, atol=1e-9)


@pytest.mark.parametrize("x", [1.0, -1.0])
def test_an_event_may_be_nan_in_a_part_of_the_domain(x):
    """log(x + 1/2) is not defined for x < -1/2, where one of the runs starts."""

    def event(t, y):
        return math.log(y[0] + 0.5) if y[0] > -0.5 else math.nan

    run = integrate(oscillator, (0, 12), [x, 0.0], method=EIPDOP853, rtol=1e-9, atol=1e-9, events=event)
    times = np.pi * np.array([1, 5, 7, 11] if x > 0 else [2, 4, 8, 10]) / 3
    np.testing.assert_allclose(run.t_events[0], times, rtol=0, atol=1e-7)


def test_a_passage_that_does_not_reach_zero_is_none():
    for height in (1e-3, 1e-9, 1e-14):
        run = integrate(
            oscillator, (0, SPAN), START, method=EIPDOP853, h=0.5, events=reaching(1 + height), invariants=ENERGY
        )
        assert run.t_events[0].size == 0


def test_directions_and_the_order_in_time_within_one_step():
    """Count of two crossings in a step the one in the direction of the event, and end the run by the second."""
    for direction, first in ((1, 0), (-1, 1)):  # the run begins below the level: the first passage is up
        event = reaching(0.99, direction)
        run = integrate(oscillator, (0, SPAN), START, method=EIPDOP853, h=1.0, events=event, invariants=ENERGY)
        np.testing.assert_allclose(run.t_events[0], passages(0.99)[first::2], rtol=0, atol=1e-5)
    ended = integrate(
        oscillator,
        (0, SPAN),
        START,
        method=EIPDOP853,
        h=1.0,
        events=[reaching(0.995), reaching(0.99, terminal=3)],
        invariants=ENERGY,
        save_every=1,
        dense_output=True,
    )
    assert ended.status == 1
    assert ended.t[-1] == ended.t_events[1][-1] == ended.sol.ts[-1]
    np.testing.assert_array_equal(ended.sol(ended.t[-1]), ended.y_events[1][-1])
    assert ended.t_events[1].size == 3
    np.testing.assert_allclose(ended.t_events[1], passages(0.99)[:3], rtol=0, atol=1e-5)
    # Later events of the step that ends the run do not count.
    assert (ended.t_events[0] < ended.t[-1]).all()


def test_one_step_methods_look_inside_too():
    """Steps of these methods leave no derivative; the event's rate takes one evaluation more."""
    method = eip_method(Verlet())
    run = integrate(oscillator, (0, SPAN), START, method=method, h=0.3, events=reaching(0.97))
    assert run.t_events[0].size == passages(0.97).size


@pytest.mark.parametrize("as_compiled", [False, pytest.param(True, marks=pytest.mark.needs_jit)])
def test_counts_go_on_in_a_continued_run(as_compiled):
    event = reaching(0.9, terminal=5)
    fun = oscillator
    if as_compiled:
        event, fun = compiled(event), njit(oscillator)
    times = passages(0.9)
    run = integrate(fun, (0, times[2] + 0.1), START, method=EIPDOP853, h=0.1, events=event)
    assert run.t_events[0].size == 3
    run = run.continue_to(times[3] + 0.1)
    assert (run.status, run.t_events[0].size) == (0, 4)
    run = run.continue_to(SPAN)
    assert (run.status, run.t_events[0].size) == (1, 5)
    np.testing.assert_allclose(run.t_events[0], times[:5], rtol=0, atol=1e-7)
    # Events that are given anew begin to count at 0.
    other = integrate(fun, (0, times[2] + 0.1), START, method=EIPDOP853, h=0.1, events=event)
    other = other.continue_to(SPAN, events=event)
    assert (other.status, other.t_events[0].size) == (1, 3 + 5)


def test_events_of_other_functions_are_not_joined():
    """Also not those of the same functions in another order."""
    one, two = reaching(0.9), reaching(0.2)
    first = integrate(oscillator, (0, SPAN / 2), START, method=EIPDOP853, h=0.1, events=[one, two])
    for events, levels in (([two, one], (0.2, 0.9)), ([one, two], (0.9, 0.2)), (two, (0.2,))):
        run = first.continue_to(SPAN, events=events)
        begin = 0.0 if levels == (0.9, 0.2) else SPAN / 2
        for level, found in zip(levels, run.t_events, strict=True):
            times = passages(level)
            np.testing.assert_allclose(found, times[(times > begin) & (times < SPAN)], rtol=0, atol=1e-7)


def test_counts_go_on_from_a_checkpoint_of_a_continued_run(tmp_path):
    event, times = reaching(0.9, terminal=5), passages(0.9)
    first = integrate(oscillator, (0, times[1] + 0.1), START, method=EIPDOP853, h=0.1, events=event)
    path, stopped = tmp_path / "run", []

    def stop(t, y, residuals):
        if t > times[3] + 0.1 and not stopped:
            stopped.append(t)
            raise RuntimeError("broken off")

    options = {"checkpoint": path, "resume": True, "save_every": 1, "callback": stop}
    with pytest.raises(RuntimeError, match="broken off"):
        first.continue_to(SPAN, **options)
    run = first.continue_to(SPAN, **options)
    assert (run.status, run.t_events[0].size) == (1, 5)
    np.testing.assert_allclose(run.t_events[0], times[:5], rtol=0, atol=1e-7)


def from_event_to_event(way, end, **options):
    """Return the times at which runs end, each of which begins where the last one has ended: three."""
    t, y, times, run = 0.0, START, [], None
    for _ in range(3):
        if way is ensemble:
            run = ensemble(oscillator, (t, end), [y], executor=1, **options)
            t, y = run.t[0], run.y[0]
        else:
            solve = integrate if way is None else way
            run = run.continue_to(end) if run and way is None else solve(oscillator, (t, end), y, **options)
            t, y = run.t[-1], run.y[:, -1]
        assert np.all(run.status == 1)
        times.append(t)
    return np.array(times)


@pytest.mark.parametrize("way", [integrate, ensemble, solve_ivp, None], ids=["integrate", "ensemble", "scipy", "on"])
@pytest.mark.parametrize("method", [EIPRK4, EIPRK45, EIPDOP853, EIPRKN12, EIPGJ12, EIPRadau])
def test_a_run_goes_on_from_event_to_event(way, method):
    """The state at an event is exact, or off by rounding to either side; each zero is found once."""
    step = {"h": 0.05} if method in (EIPRK4, EIPGJ12) else {"rtol": 1e-7, "atol": 1e-7}
    for level, end in ((0.0, 20), (0.3, -20), (0.5, 20)):
        options = {"method": method, "events": reaching(level, terminal=True), "invariants": ENERGY, **step}
        times = from_event_to_event(way, end, **options)
        expected = passages(level, 20) if end > 0 else -(passages(level, 20 + 2 * PHASE) + 2 * PHASE)
        assert (np.abs(np.diff(times)) > 0.1).all()
        np.testing.assert_allclose(np.diff(times), np.diff(expected)[:2], rtol=0, atol=1e-3)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_zeros_near_the_start(scale):
    """The event is at 1e-6 of the first step, which counts, or at 1e-14, which is rounding: of the time, of terms."""
    for begin, level in ((0.0, 0.0), (1e3 * scale, 0.0), (0.0, 1e3)):
        for part, count in ((1e-6, 1), (1e-14, 0), (0.0, 0)):
            run = integrate(
                lambda t, y: [1 / scale], (begin, begin + scale), [level - 0.1 * part], method=EIPRK4, h=0.1 * scale,
                events=lambda t, y, level=level: y[0] - level,
            )  # fmt: skip
            assert run.t_events[0].size == count, (begin, level, part)


def test_an_event_where_two_parts_of_a_run_meet_happens_once():
    """The first part ends at the event, or up to ten roundings next to it."""
    for shift in range(-10, 11):
        middle = math.pi / 2 - PHASE + shift * 2e-16
        run = integrate(oscillator, (0, middle), START, method=EIPDOP853, rtol=1e-13, atol=1e-15, events=reaching(0.0))
        assert run.continue_to(3.0).t_events[0].size == 1


def beyond(direction):
    def event(t, y):
        return 0.5 - y[0] if direction < 0 else y[0] - 0.5

    event.terminal, event.direction = True, direction
    return event


@pytest.mark.parametrize("direction", [math.inf, -math.inf])
@pytest.mark.parametrize("native", [False, pytest.param(True, marks=pytest.mark.needs_jit)])
def test_a_run_that_starts_beyond_a_limit_ends_there(direction, native):
    event = compiled(beyond(direction)) if native else beyond(direction)
    options = {"method": EIPDOP853, "rtol": 1e-6, "events": event}
    fun = njit(oscillator) if native else oscillator
    one, other = np.array([0.6, 0.1]), np.array([0.4, 0.0])
    for t_span in ((0, 9), (9, 0)):
        for solve in (integrate, solve_ivp):
            run = solve(fun, t_span, one, dense_output=True, **options)
            np.testing.assert_array_equal(run.sol(t_span[0]), one)
            assert (run.status, run.t[-1], run.t_events[0].tolist()) == (1, t_span[0], [t_span[0]])
            np.testing.assert_array_equal(run.y[:, -1], one)
        many = ensemble(fun, t_span, [one, other], executor=1, **options)
        assert many.t[0] == t_span[0]
        assert many.status.tolist() == [1, 0]
        sol = Problem("oscillator", oscillator, y0=one, t_span=t_span).solve_ivp(**options)
        assert sol.t_events[0].tolist() == [t_span[0]]
    ended = integrate(fun, (0, 9), one, **options).continue_to(9)  # goes on, and ends when it is beyond again
    assert 5 < ended.t[-1] < 2 * math.pi


@pytest.mark.parametrize("value", [[0.5], np.ones(1), np.ones(2), 0.5j, np.complex128(1), None, "1", True, np.True_])
@pytest.mark.parametrize("late", [-1.0, 0.5])
def test_an_event_returns_a_real_number(value, late):
    """Without the check CPython raises SystemError, without a word of the event."""
    event = lambda t, y: y[0] if t < late else value  # noqa: E731
    for solve in (solve_ivp, integrate, lambda fun, *given, **more: Problem("", fun, *given).solve_ivp(**more)):
        y0, t_span = (START, (0, 3)) if solve not in (solve_ivp, integrate) else ((0, 3), START)
        with pytest.raises(TypeError, match=r"event 0 returned .* at t=.*, expected a real number"):
            solve(oscillator, y0, t_span, method=EIPRK45, events=event)


def test_a_zero_at_the_start_is_that_of_scipy_with_its_steps():
    event = reaching(0.0, terminal=True)
    for method, options, time in ((EIPRK45, {}, 0.0), (EIPRK4, {"h": 0.1}, math.pi), (EIPRK45, {"h": 0.1}, math.pi)):
        sol = solve_ivp(oscillator, (0, 9), [0.0, 1.0], method, events=event, **options)
        assert sol.t[-1] == pytest.approx(time, abs=1e-4)
    scipys = scipy.integrate.solve_ivp(oscillator, (0, 9), [0.0, 1.0], events=event)
    assert scipys.t[-1] == 0.0


def test_zeros_at_steps_count_once_and_at_the_start_not_at_all():
    def event(t, y):
        return (t - 0.25) * (t - 0.5) * (t - 0.75)

    event.terminal = 3
    for h in (0.125, 0.12):
        run = integrate(oscillator, (0, 2), [1.0, 0.0], method=EIPRK4, h=h, events=event)
        np.testing.assert_allclose(run.t_events[0], [0.25, 0.5, 0.75], rtol=1e-14)
    for end, time, count in ((8.0, 0.0, 0), (8.0, 5.0, 1), (-8.0, 0.0, 0), (-8.0, -5.0, 1)):
        run = integrate(oscillator, (0, end), [1.0, 0.0], method=EIPRK4, h=0.01, events=lambda t, y, s=time: t - s)
        np.testing.assert_allclose(run.t_events[0], [time] * count, atol=1e-14)
