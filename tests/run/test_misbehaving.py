"""Functions with faults: compiled runs, interpreted ones and solve_ivp give one answer.

They write to the states they are given, leave `out` as it was, or return something else on the way than at the start.
"""

import re
from itertools import product

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from systems import SQUARE, oscillator, refuse

from eip_scipy import EIPRK4, EIPRK45, Invariant, check_gradient, ensemble, integrate, project

Y0 = [1.0, 2.0]
needs_jit = pytest.mark.needs_jit


def square(t, y):
    return y[0] * y[0] + y[1] * y[1]


def square_gradient(t, y):
    return 2 * y


def interpreted(fun=oscillator, invariants=(), **options):
    options = {"method": EIPRK4, "h": 0.1, "save_every": 1, **options}
    return integrate(fun, (0, 1), Y0, invariants=invariants, compiled=False, **options)


def compiled(fun=oscillator, invariants=(), events=None, **options):
    """Return the same run of the same functions, jitted."""
    items = [invariants] if isinstance(invariants, Invariant) else invariants
    kept = [
        Invariant(njit(i.fun), njit(i.grad), name=i.name, in_place=i.in_place, uses_f=i.uses_f, target=i.target)
        for i in items
    ]
    options = {"method": EIPRK4, "h": 0.1, "save_every": 1, **options}
    events = None if events is None else [njit(event) for event in events]
    return integrate(njit(fun), (0, 1), Y0, invariants=kept, events=events, **options)


def scipy_s(fun=oscillator, invariants=(), **options):
    return solve_ivp(fun, (0, 1), Y0, **{"method": EIPRK4, "h": 0.1, "invariants": invariants, **options})


both = pytest.mark.parametrize("how", [interpreted, pytest.param(compiled, marks=needs_jit)])
all_of_them = pytest.mark.parametrize("how", [interpreted, pytest.param(compiled, marks=needs_jit), scipy_s])
KEPT = Invariant(square, square_gradient, name="S")


def writing_now_and_then(t, y):
    if t > 0.55:
        y[:] = 7.0 * y
        return np.array([y[1] / 7, -y[0] / 7])
    return np.array([y[1], -y[0]])


@njit
def scale(a, factor):
    for k in range(a.size):
        a[k] *= factor


def writing_by_a_function(t, y):
    f = np.array([y[1], -y[0]])
    scale(y, 0.0)
    return f


def value_that_writes(t, y):
    value = y[0] * y[0] + y[1] * y[1]
    y[1] = 5.0
    return value


def gradient_that_writes(t, y):
    y[0] *= 2
    y[1] *= 2
    return y


WRITERS = [writing_now_and_then, writing_by_a_function]


@pytest.mark.nightly
@all_of_them
def test_right_hand_sides_that_write(how):
    """Also where SciPy takes the steps, whose own class lets them write to its state."""
    for fun, method in product(WRITERS, (EIPRK4, EIPRK45)):
        options = {"method": method, "h": None if method is EIPRK45 else 0.1}
        np.testing.assert_allclose(how(fun, **options).y, how(**options).y, rtol=1e-14)
        run = how(fun, KEPT, **options)
        np.testing.assert_allclose(run.y, how(invariants=KEPT, **options).y, rtol=1e-14)
        assert how is not compiled or run.compiled


@pytest.mark.parametrize("how", [interpreted, pytest.param(compiled, marks=[needs_jit, pytest.mark.slow]), scipy_s])
def test_invariants_that_write(how):
    writer = Invariant(value_that_writes, gradient_that_writes, name="A")
    run = how(invariants=[writer, KEPT])
    np.testing.assert_array_equal(run.y, how(invariants=[KEPT, KEPT]).y)
    if how is compiled:
        assert run.compiled
        np.testing.assert_allclose(run.invariants, 5.0, rtol=1e-14)


@all_of_them
def test_gradients_that_write_to_f(how):
    """f is the first stage of the step to come."""

    def grad(t, y, f):
        G = np.array([-2 * f[1], 2 * f[0]])
        f[0] = f[1] = 1e9
        return G

    good = Invariant(square, lambda t, y, f: np.array([-2 * f[1], 2 * f[0]]), uses_f=True, name="S")
    np.testing.assert_array_equal(
        how(invariants=Invariant(square, grad, uses_f=True, name="S")).y, how(invariants=good).y
    )


def test_helpers_keep_what_they_are_given():
    writer = Invariant(value_that_writes, gradient_that_writes, target=5.1, name="S")
    y = np.array(Y0)
    result = project(y, writer, f=writing_by_a_function)
    np.testing.assert_array_equal(y, Y0)
    np.testing.assert_array_equal(result.y, project(y, Invariant(square, square_gradient, target=5.1)).y)
    assert check_gradient(writer, 0.0, y, writing_by_a_function) < 1e-9
    np.testing.assert_array_equal(y, Y0)


def half(t, y, out):
    out[0] = y[1]


def adding(t, y, out):
    out[0] += y[1]
    out[1] = -y[0]


NOT_FILLING = [
    (lambda t, y, out: np.array([y[1], -y[0]]), TypeError, r"returned array\(.*must fill its argument out"),
    (half, ValueError, "does not fill all of its argument out, in component 1"),
    (lambda t, y, out: None, ValueError, "does not fill all of its argument out, in component 0"),
    (adding, ValueError, "reads its argument out, whose content is arbitrary, before filling it, in component 0"),
]


@both
def test_functions_that_do_not_fill(how):
    for fun, error, match in NOT_FILLING:
        wrong = Invariant(square, fun, name="S", in_place=True)
        refuse(how, [({"fun": fun, "in_place": True}, error, f"^fun {match}")])
        refuse(how, [({"invariants": wrong}, error, f"gradient of invariant 'S' {match}")])


@both
def test_functions_that_stop_filling(how):
    def fun(t, y, out):
        out[0] = y[1]
        if t < 0.5:
            out[1] = -y[0]

    run = how(fun, in_place=True)
    assert run.status == -1
    assert run.message.startswith("fun returned a non-finite value at t=0.5 (component 1 is NaN; with in_place=True")
    np.testing.assert_array_equal(run.y, interpreted().y[:, : run.t.size])


@both
def test_an_invariant_that_raises_ends_the_run_with_its_error(how):
    def late_error(t, y):
        if t > 0.55:
            raise ZeroDivisionError("late")
        return y[0] * y[0] + y[1] * y[1]

    with pytest.raises(ZeroDivisionError, match="late") as caught:
        how(invariants=Invariant(late_error, square_gradient, name="S"), check=False)
    assert 0.4 <= caught.value.partial.t[-1] <= 0.6


CHANGES = {
    "complex": (lambda y: y + 0j, "complex"),
    "text": (lambda y: "1.0", "'1.0'"),
    "None": (lambda y: None, "None"),
    "shape": (lambda y: np.ones((3, 1)), r"shape \(3, 1\)"),
    "ragged": (lambda y: [1.0, [2.0, 3.0]], r"\[1.0, \[2.0, 3.0\]\]"),
}


def late(good, change):
    return lambda t, y: good(t, y) if t < 0.5 else change(y)


def test_values_that_change():
    """The error names the time, and computed results are kept."""
    for change, match in CHANGES.values():
        calls = [(how, {"fun": late(oscillator, change)}, f"fun returned .*{match}") for how in (interpreted, scipy_s)]
        for functions in ((late(square, change), square_gradient), (square, late(square_gradient, change))):
            calls.append((interpreted, {"invariants": Invariant(*functions, name="S")}, "'S' (returned|has|is)"))
        for how, options, words in calls:
            with pytest.raises((TypeError, ValueError), match=words) as info:
                how(**options)
            assert re.search(r"at t=0\.5\b", str(info.value))
            assert how is scipy_s or info.value.partial.t[-1] == 0.4


class MineError(Exception):
    pass


def raising(*args):
    raise MineError


def test_exceptions_at_the_start_keep_the_start():
    wrong = [Invariant(raising, square_gradient), Invariant(square, raising)]
    for options in ({"fun": raising}, *({"invariants": i} for i in wrong), {"events": raising}, {"callback": raising}):
        with pytest.raises(MineError) as info:
            interpreted(**options)
        partial = info.value.partial
        assert partial.t.tolist() == [0.0]
        np.testing.assert_array_equal(partial.y, np.array(Y0)[:, None])
        assert (partial.status, partial.success) == (-1, False)
        assert "interrupted by MineError" in partial.message
    with pytest.raises(MineError) as info:
        ensemble(raising, (0, 1), [Y0, Y0], method=EIPRK4, h=0.1, invariants=SQUARE)
    assert not hasattr(info.value, "partial")
