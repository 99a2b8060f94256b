"""Störmer-Verlet against closed forms, and the contract of its driver."""

import ctypes
import signal
import threading

import numpy as np
import pytest
from numba import njit
from systems import energy, pericentre

from eip_scipy_studies.comparators import stormer_verlet
from eip_scipy_studies.comparators.stormer_verlet import FORMS

KDK, DKD = FORMS


@njit
def oscillator(t, q):
    return -q


@njit
def scaled_oscillator(t, q, params):
    return -params[0] * q


@njit
def driven(t, q):
    return np.array([-np.sin(t)])


@njit
def kepler(t, q):
    return -q / (q[0] ** 2 + q[1] ** 2) ** 1.5


KEPLER_Y0 = pericentre(0.5)  # period 2 pi


def end_error(acc, t_end, y0, exact, n, form):
    return np.linalg.norm(stormer_verlet(acc, (0.0, t_end), y0, t_end / n, form=form).y[:, -1] - exact)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("acc", "t_end", "y0", "exact", "n"),
    [
        (oscillator, 10.0, [1.0, 0.0], [np.cos(10.0), -np.sin(10.0)], 1000),
        (driven, 2.0, [0.0, 1.0], [np.sin(2.0), np.cos(2.0)], 100),
        (kepler, 2 * np.pi, KEPLER_Y0, KEPLER_Y0, 4000),
    ],
    ids=["oscillator", "driven", "kepler"],
)
def test_order_two(form, acc, t_end, y0, exact, n):
    coarse, fine = (end_error(acc, t_end, np.array(y0), exact, k, form) for k in (n, 2 * n))
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize("form", FORMS)
def test_reversible_to_round_off(form):
    there = stormer_verlet(kepler, (0.0, 20.0), KEPLER_Y0, 0.01, form=form)
    back = stormer_verlet(kepler, (20.0, 0.0), there.y[:, -1], 0.01, form=form)
    assert np.linalg.norm(there.y[:, -1] - KEPLER_Y0) > 0.1
    np.testing.assert_allclose(back.y[:, -1], KEPLER_Y0, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("form", "other"), [(KDK, DKD), (DKD, KDK)])
def test_each_form_keeps_its_own_quadratic_form(form, other):
    """On the oscillator: (1 - h^2/4) q^2 + v^2 for kick-drift-kick, q^2 + (1 - h^2/4) v^2 for the other, exactly."""
    h = 0.1
    kept = {KDK: np.array([1 - h**2 / 4, 1.0]), DKD: np.array([1.0, 1 - h**2 / 4])}

    def drift(weights):
        y = stormer_verlet(oscillator, (0.0, 100.0), [0.8, -0.6], h, form=form, save_every=1).y
        value = weights @ y**2
        return np.abs(value - value[0]).max()

    assert drift(kept[form]) < 1e-13
    assert drift(kept[other]) > 1e-3


def test_error_constants_differ():
    errors = [end_error(kepler, 2 * np.pi, KEPLER_Y0, KEPLER_Y0, 4000, form) for form in FORMS]
    assert not 0.8 < errors[0] / errors[1] < 1.25


@pytest.mark.parametrize("form", FORMS)
def test_no_energy_drift(form):
    run = stormer_verlet(kepler, (0.0, 2000.0), KEPLER_Y0, 0.01, form=form, save_every=7)
    error = np.abs(energy(0, run.y) - energy(0, KEPLER_Y0))
    tenth = error.size // 10
    assert error[:tenth].max() > 1e-6
    assert error[-tenth:].max() == pytest.approx(error[:tenth].max(), rel=0.05)


@pytest.mark.needs_jit
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("acc", "params"), [(kepler, None), (scaled_oscillator, [2.0])])
def test_compiled_and_interpreted_give_the_same_bits(form, acc, params):
    options = {"form": form, "params": params, "save_every": 3}
    compiled = stormer_verlet(acc, (0.3, 5.0), KEPLER_Y0, 0.07, **options)
    interpreted = stormer_verlet(lambda *args: acc(*args), (0.3, 5.0), KEPLER_Y0, 0.07, **options)
    assert compiled.message == "compiled"
    assert interpreted.message == "interpreted: acc is not a Numba function; decorate it with @numba.njit"
    np.testing.assert_array_equal(compiled.t, interpreted.t)
    np.testing.assert_array_equal(compiled.y, interpreted.y)


@pytest.mark.needs_jit
def test_jitted_functions_that_cannot_be_compiled_say_why():
    @njit
    def none_at_times(t, q):
        return -q if t < 5.0 else None

    @njit
    def another_shape(t, q):
        return -q if t < 0.5 else -q[:1]

    @njit
    def failing(t, q):
        if t > 0.5:
            raise ZeroDivisionError("mine")
        return -q

    start = [1.0, 2.0, 0.0, 0.0]
    run = stormer_verlet(none_at_times, (0.0, 1.0), start, 0.1)
    assert run.message == "interpreted: acc returns None in some places, and a number or an array in others"
    with pytest.raises(ValueError, match="acc returned an array of another shape"):
        stormer_verlet(another_shape, (0.0, 1.0), start, 0.1)
    with pytest.raises(ZeroDivisionError, match="mine"):
        stormer_verlet(failing, (0.0, 1.0), start, 0.1)


def test_a_c_function_by_pointer():
    @ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, *[ctypes.POINTER(ctypes.c_double)] * 3)
    def oscillating(t, q, out, params):
        out[0] = -params[0] * q[0]
        return -2 if t > 2.0 else 0

    def by_python(t, q, params):
        return -params[0] * q

    by_pointer, interpreted = (
        stormer_verlet(acc, (0.0, 1.0), [1.0, 0.0], 0.1, params=[4.0]) for acc in (oscillating, by_python)
    )
    assert by_pointer.message == "compiled"
    np.testing.assert_array_equal(by_pointer.y, interpreted.y)
    with pytest.raises(RuntimeError, match=r"acc returned the status -2 at t=2\.1"):
        stormer_verlet(oscillating, (0.0, 3.0), [1.0, 0.0], 0.1, params=[4.0])


@pytest.mark.needs_jit
def test_an_interrupt_ends_a_long_run():
    """The loop of compiled functions does not return to Python, and still an interrupt ends it."""
    timer = threading.Timer(0.3, signal.raise_signal, (signal.SIGINT,))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        stormer_verlet(oscillator, (0.0, 1e9), [1.0, 0.0], 0.01)
    timer.join()


def test_params_reach_the_acceleration():
    run = stormer_verlet(scaled_oscillator, (0.0, 1.0), [1.0, 0.0], 1e-3, params=[9.0])
    assert run.y[0, -1] == pytest.approx(np.cos(3.0), abs=1e-5)


def test_times_are_whole_numbers_of_steps():
    run = stormer_verlet(oscillator, (0.1, 0.1 + 100 * 0.1), [1.0, 0.0], 0.1, save_every=7)
    steps = np.append(np.arange(0, 100, 7), 100)
    np.testing.assert_array_equal(run.t[:-1], 0.1 + steps[:-1] * 0.1)
    assert run.t[-1] == 0.1 + 100 * 0.1
    assert run.y.shape == (2, steps.size)
    assert run.nfev == 101
    every = stormer_verlet(oscillator, (0.1, 0.1 + 100 * 0.1), [1.0, 0.0], 0.1, save_every=1)
    np.testing.assert_array_equal(run.y, every.y[:, steps])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("t_end", [1.0, -1.0])
def test_last_step_is_shortened_to_the_end(form, t_end):
    run = stormer_verlet(oscillator, (0.0, t_end), [1.0, 0.0], 0.3, form=form, save_every=1)
    sign = np.sign(t_end)
    np.testing.assert_array_equal(run.t, [0.0, sign * 0.3, 2 * sign * 0.3, 3 * sign * 0.3, t_end])
    short = stormer_verlet(oscillator, (run.t[3], t_end), run.y[:, 3], abs(t_end - run.t[3]), form=form)
    np.testing.assert_array_equal(run.y[:, -1], short.y[:, -1])
    assert run.y[0, -1] == pytest.approx(np.cos(1.0), abs=0.02)


def test_default_saves_start_and_end():
    run = stormer_verlet(oscillator, (0.0, 1.0), [1.0, 0.0], 0.1)
    assert run.t.tolist() == [0.0, 1.0]
    assert run.y.shape == (2, 2)
    assert run.wall_time > 0


def test_zero_length_interval_is_the_start():
    run = stormer_verlet(oscillator, (1.0, 1.0), [1.0, 0.5], 0.1, save_every=2)
    assert run.t.tolist() == [1.0]
    assert run.y.tolist() == [[1.0], [0.5]]


def test_y0_is_left_alone():
    y0 = np.array([1.0, 0.0])
    stormer_verlet(oscillator, (0.0, 1.0), y0, 0.1)
    assert y0.tolist() == [1.0, 0.0]


def test_an_acceleration_may_reuse_its_buffer():
    buffer = np.empty(1)

    def reused(t, q):
        buffer[:] = -q
        return buffer

    honest = stormer_verlet(lambda t, q: -q, (0.0, 1.0), [1.0, 0.0], 0.1)
    np.testing.assert_array_equal(stormer_verlet(reused, (0.0, 1.0), [1.0, 0.0], 0.1).y, honest.y)


@pytest.mark.parametrize("form", FORMS)
def test_an_acceleration_may_return_a_constant_that_is_not_to_be_written(form):
    gravity = np.array([-9.81])
    gravity.flags.writeable = False
    run = stormer_verlet(lambda t, q: gravity, (0.0, 2.0), [0.0, 0.0], 0.5, form=form)
    np.testing.assert_allclose(run.y[:, -1], [-2 * 9.81, -2 * 9.81], rtol=1e-15)


def test_non_finite_states_are_reported():
    run = stormer_verlet(
        lambda t, q: np.array([np.nan if t > 0.45 else 0.0]), (0.0, 1.0), [1.0, 0.0], 0.1, save_every=1
    )
    assert run.message.endswith("the saved states from t=0.5 on are not finite")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"h": 0.0}, ValueError, "`h` must be positive"),
        ({"h": -0.1}, ValueError, "`h` must be positive"),
        ({"h": np.nan}, ValueError, "`h` must be positive"),
        ({"h": 2.0}, ValueError, "`h` exceeds bounds"),
        ({"h": 1e-20, "t_span": (5.0, 6.0)}, ValueError, "spacings of t"),
        ({"t_span": (0.0, np.inf)}, ValueError, "two finite numbers"),
        ({"t_span": (0.0, 1.0, 2.0)}, ValueError, "two finite numbers"),
        ({"y0": [1.0, 0.0, 2.0]}, ValueError, "even number"),
        ({"y0": []}, ValueError, "even number"),
        ({"y0": [[1.0, 0.0]]}, ValueError, "1-dimensional"),
        ({"y0": [np.nan, 0.0]}, ValueError, "must be finite"),
        ({"y0": np.ma.array([1.0, 2.0], mask=[0, 1])}, ValueError, "masked"),
        ({"y0": [1j, 0.0]}, TypeError, "must be real"),
        ({"params": [[1.0]]}, ValueError, "params must be 1-dimensional"),
        ({"form": "kick-kick"}, ValueError, "'kick-drift-kick', 'drift-kick-drift'"),
        ({"save_every": 0}, ValueError, "positive integer"),
        ({"save_every": 1.5}, ValueError, "positive integer"),
        ({"acc": lambda t, q: None}, TypeError, "returned None, expected 1"),
        ({"acc": lambda t, q: 1.0}, ValueError, r"shape \(\), expected \(1,\)"),
        ({"acc": lambda t, q: [1.0, 2.0]}, ValueError, r"shape \(2,\), expected \(1,\)"),
        ({"acc": lambda t, q: 1j * q}, TypeError, "complex"),
        ({"acc": lambda t, q: q if t < 0.5 else 0.0}, ValueError, r"shape \(\), expected \(1,\)"),
    ],
)
def test_bad_input_is_named(changes, error, message):
    call = {"acc": lambda t, q: -q, "t_span": (0.0, 1.0), "y0": [1.0, 0.0], "h": 0.1} | changes
    with pytest.raises(error, match=message):
        stormer_verlet(**call)


def test_exceptions_of_the_user_propagate():
    def fails(t, q):
        if t > 0.5:
            raise ZeroDivisionError("mine")
        return -q

    with pytest.raises(ZeroDivisionError, match="mine"):
        stormer_verlet(fails, (0.0, 1.0), [1.0, 0.0], 0.1)
