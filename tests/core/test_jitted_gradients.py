"""Gradients that are not given: compiled ones of jitted invariants against mpmath, and in runs; quadratic forms."""

import math
import re

import mpmath
import numpy as np
import pytest
from systems import jit_energy as energy
from systems import jit_momentum as momentum
from systems import jit_orbit as fun

from eip_scipy import EIPDOP853, EIPRK4, Invariant, integrate
from eip_scipy.core.invariant_set import InvariantSet

numba = pytest.importorskip("numba")
njit = numba.njit
pytestmark = pytest.mark.needs_jit

Y = np.array([0.7, -0.4, 1.3, 0.2])
FUNCTIONS, NAMES = {}, []
NIGHTLY = [pytest.mark.nightly, pytest.mark.slow]


def case(exact, shape=(), gate=False):
    """Return a jitted function and its mpmath counterpart, of four numbers, or for a tuple of them.

    Each takes some seconds to compile: in the gate there is one of each kind.
    """

    def add(fun):
        FUNCTIONS[fun.__name__] = njit(fun), exact, shape
        NAMES.append(fun.__name__ if gate else pytest.param(fun.__name__, marks=NIGHTLY))

    return add


@case(lambda a, b, c, d: a ** mpmath.mpf(1.5) + c**-3 + b**3 + 2**a + a**c)
def powers(t, y):
    return y[0] ** 1.5 + y[2] ** -3 + math.pow(y[1], 3.0) + 2.0 ** y[0] + y[0] ** y[2]


@case(lambda a, b, c, d: (c**2 + d**2) / 2 - 1 / mpmath.sqrt(a**2 + b**2), gate=True)
def kepler_by_arrays(t, y):
    return 0.5 * np.sum(y[2:] ** 2) - 1.0 / np.sqrt(y[:2] @ y[:2])


@case(
    lambda a, b, c, d: mpmath.exp(-a * b) + mpmath.expm1(c) * mpmath.tanh(d) + mpmath.log(c) + mpmath.log1p(a),
    gate=True,
)
def exponentials(t, y):
    return math.exp(-y[0] * y[1]) + np.expm1(y[2]) * math.tanh(y[3]) + math.log(y[2]) + np.log1p(y[0])


@case(lambda a, b, c, d: mpmath.cos(a) * mpmath.tan(d) + mpmath.asin(b) + mpmath.acos(a) + mpmath.atan2(d, b))
def trigonometric(t, y):
    return np.cos(y[0]) * math.tan(y[3]) + math.asin(y[1]) + np.arccos(y[0]) + math.atan2(y[3], y[1])


@case(
    lambda a, b, c, d: mpmath.sinh(a) / mpmath.cosh(b) + mpmath.asinh(c) + mpmath.acosh(c) + mpmath.atanh(d), gate=True
)
def hyperbolic(t, y):
    return math.sinh(y[0]) / np.cosh(y[1]) + math.asinh(y[2]) + math.acosh(y[2]) + math.atanh(y[3])


@case(lambda a, b, c, d: 1 + d**2, gate=True)
def branch_of_another_type(t, y):
    total = y[0] if y[0] < 0.0 else 1.0
    return total + y[3] ** 2


@case(lambda a, b, c, d: c * a + b + mpmath.erf(a) * abs(b) / d + mpmath.log10(d) + mpmath.atan(c))
def extremes(t, y):
    total = max(y[0], y[2]) * np.maximum(y[0], y[3]) + min(y[1], 0.5)
    if y[0] > 0.5 and y[1] < 0:
        total += math.erf(y[0]) * abs(y[1]) / y[3] + math.log10(y[3]) + math.atan(y[2])
    return total


@case(lambda a, b, c, d: (a * d - b * c, mpmath.sqrt(a**2 + c**2), b * d), shape=(3,))
def tuple_of_three(t, y):
    return y[0] * y[3] - y[1] * y[2], np.linalg.norm(y[::2]), np.cross(y[:3], np.array([0.0, 0.0, 1.0]))[0] * y[3]


@njit
def products(y, scale=2.0):
    out = np.zeros(3)
    for i in range(3):
        out[i] = scale * y[i] * y[i + 1]
    return out


@case(lambda a, b, c, d: (2 * a * b, 2 * b * c, 2 * c * d), shape=(3,), gate=True)
def array_filled_in_another_function(t, y):
    return products(y)


def computed(fun, y, extra=()):
    return InvariantSet(Invariant(fun), 0.0, y, np.ones_like(y), 1.0, extra).gradients(0.0, y, y)


@case(lambda a, b, c, d: (a / c - b / c + c * a + c - b * d / 2) ** 2 + ((a + c / 2 - 3) * b / c) ** 2, gate=True)
def arrays_and_a_number_that_varies(t, y):
    q = y[:2] * 1.0
    one, two, three = -q / y[2], y[2] * q, y[2] - q * y[3] / 2.0
    q += y[2:] / 2.0
    q -= 3.0
    q /= y[2:]
    q *= y[1]
    return (two[0] + three[1] + one[1] - one[0]) ** 2 + q[0] ** 2


@case(
    lambda a, b, c, d: (a - 0.6) ** 2 * b + (c - 4) ** 3 + b * mpmath.mpf(1.3)
    + (a - 0.5) ** 2 + (b + 0.5) ** 2 + (c - 1.5) ** 2 + d**2, gate=True
)  # fmt: skip
def nearest_images(t, y):
    one = (y[0] - 0.3 * round(y[0] / 0.3)) ** 2 * y[1] + (y[2] - np.rint(3 * y[2])) ** 3 + np.around(y[2], 1) * y[1]
    return one + y[3] * (int(4 * y[0]) + np.trunc(7 * y[1])) + np.sum((y - 0.5 * np.round(y / 0.5)) ** 2)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_exact_to_rounding(name):
    fun, exact, shape = FUNCTIONS[name]
    with mpmath.workdps(40):
        y = [mpmath.mpf(float(x)) for x in Y]
        rows = range(shape[0]) if shape else [None]
        expected = [
            [
                float(mpmath.diff(lambda *x, j=j: exact(*x) if j is None else exact(*x)[j], y, orders))
                for orders in np.eye(4, dtype=int).tolist()
            ]
            for j in rows
        ]
    found = computed(fun, Y)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.max(np.abs(expected)))


@pytest.mark.parametrize("n", [13, *(pytest.param(n, marks=NIGHTLY) for n in (1, 7, 12, 70))])
def test_any_number_of_components(n):
    y, weights, params = np.linspace(0.5, 1.5, n), np.arange(1.0, n + 1), np.array([3.0, 4.0])
    found = computed(njit(lambda t, y, p: np.sum(y**3 * weights) * p[0] + p[1] * t), y, (params,))
    np.testing.assert_allclose(found[0], 9 * y**2 * weights, rtol=1e-15)


def energy_in_python(t, y):
    return 0.5 * (y[2] ** 2 + y[3] ** 2) - 1.0 / np.sqrt(y[0] ** 2 + y[1] ** 2)


START = [0.5, 0.0, 0.0, math.sqrt(3.0)]
BOTH = [Invariant(energy, name="H"), Invariant(momentum, name="L")]


def run(invariants=BOTH, span=(0, 20), **options):
    return integrate(fun, span, START, **{"method": EIPDOP853, "rtol": 1e-9, "invariants": invariants} | options)


def test_the_run_is_compiled_and_its_bits_are_those_of_the_interpreted_one():
    result, interpreted = run(compiled=True), run(compiled=False)
    assert result.compiled
    assert result.calls["gradient of H"] == result.calls["gradient of L"] == "jitted"
    assert BOTH[0].grad is None  # the invariant of the user is left as it was
    assert np.max(result.max_residual) < 1e-11
    np.testing.assert_array_equal(result.y, interpreted.y)


def test_a_function_that_dual_numbers_cannot_take_runs_interpreted_and_says_so():
    @njit
    def value(t, y):
        return (y[0] * y[3] - y[1] * y[2]) ** 2 * math.hypot(1, 0 * y[0]) * np.prod(np.ones(2) + 0 * y[:2])

    kept = Invariant(value, name="L")
    with pytest.warns(UserWarning, match="'L' has no grad and allows no complex step"):
        result = run([kept])
    assert not result.compiled
    assert "invariant 'L' has no grad, and it does not compile for dual numbers: No implementation" in result.message
    assert "prod" in result.message
    assert "give it one that is jitted too, Invariant(fun, grad=...)" in result.message


@pytest.mark.parametrize(("body", "says"), [("y.astype(np.float32)[0]", "astype"), ("np.median(y)", "median")])
def test_what_dual_numbers_cannot_do_is_named_with_tangent_vectors_too(body, says):
    names = {"np": np}
    exec(f"def value(t, y):\n    return y[0] ** 2 + y[1] ** 2 + 0 * {body}", names)
    kept = Invariant(njit(names["value"]), name="E")
    turning = njit(lambda t, y: np.array([y[1], -y[0]]))
    options = {"method": EIPRK4, "h": 0.1, "invariants": kept, "variations": "state"}
    found = integrate(turning, (0, 1), [1.0, 0.0], **options).message
    assert re.search(f"'E' has no grad, and it does not compile for dual numbers: .*{says}.*; give it one", found)


def test_a_slow_run_warns_once_that_its_invariant_is_not_jitted(monkeypatch):
    """It does not where interpreting is meant, and not in a short run; warnings are errors."""
    plain = [Invariant(energy_in_python, name="H")]
    run(plain)
    monkeypatch.setattr("eip_scipy.run.integrate.SLOW_SECONDS", 0.0)
    with pytest.warns(
        UserWarning, match="many times faster, but it is interpreted: invariant 'H' is not a Numba"
    ) as got:
        run(plain, span=(0, 200))
    assert len(got) == 1
    run(plain, compiled=False)
    run()


# Gradients of functions that are not jitted.


def test_a_quadratic_form_that_holds_near_the_start_alone():
    """Differences replace the gradient at states where the function is another one."""

    def value(t, y):
        r2 = np.vdot(y, y).real
        return r2 if r2 < 1.6 else r2 + (r2 - 1.6) ** 2

    def slope(t, y):
        r2 = np.vdot(y, y).real
        return 2 * y if r2 < 1.6 else 2 * y * (1 + 2 * (r2 - 1.6))

    kept = Invariant(value)
    y0 = np.array([1.0 + 0j, 0.5])
    for y in (y0, 1.5 * y0, np.array([0.3j, 2.0])):
        computed = InvariantSet(kept, 0.0, y0, y0, 1.0).gradients(0.0, y, y)
        np.testing.assert_allclose(computed[0], slope(0.0, y), rtol=0, atol=1e-9)
