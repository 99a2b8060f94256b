"""Arguments and values of functions become plain numbers: no unit is dropped silently, other numbers are converted."""

import datetime
from fractions import Fraction

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import SQUARE, oscillator

from eip_scipy import EIPRK4, EIPRK45, Invariant, ensemble, integrate, project
from eip_scipy.problems import nbody

units = pytest.importorskip("astropy.units")
mpmath, sympy = pytest.importorskip("mpmath"), pytest.importorskip("sympy")
Time = pytest.importorskip("astropy.time").Time
Y0 = [1.0, 2.0]
BODIES = {"gm": [1.0, 1e-3], "position": np.eye(2, 3), "velocity": np.eye(2, 3), "t_span": (0, 1)}


class PintLike:
    """A number with a unit as pint and unyt spell it; NumPy takes it for a plain one."""

    units = "km"

    def __array__(self, dtype=None, copy=None):
        return np.array(1.0)

    def __float__(self):
        return 1.0


def by_integrate(**options):
    options = {"fun": oscillator, "t_span": (0, 1), "y0": Y0, "method": EIPRK4, "h": 0.1, "compiled": False, **options}
    return integrate(options.pop("fun"), options.pop("t_span"), options.pop("y0"), **options)


def by_scipy(**options):
    options = {"method": EIPRK45, "t_span": (0, 1), "y0": Y0, **options}
    return solve_ivp(oscillator, options.pop("t_span"), options.pop("y0"), **options)


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        (by_integrate, "y0", Y0 * units.AU),
        (by_integrate, "y0", [1.0, 2.0 * units.AU]),
        (by_integrate, "y0", [1.0, PintLike()]),
        (by_integrate, "t_span", (0, Time(2451545.0, format="jd"))),
        (by_integrate, "t_span", np.array([0, 1], "datetime64[D]")),
        (by_integrate, "h", 0.1 * units.s),
        (by_integrate, "h", PintLike()),
        (by_integrate, "h", np.timedelta64(1, "s")),
        (by_integrate, "t_eval", [datetime.datetime(2000, 1, 1)]),
        (by_integrate, "params", [1] * units.kg),
        (by_integrate, "rtol", 1e-3 * units.AU),
        (by_scipy, "y0", Y0 * units.AU),
        (by_scipy, "first_step", 0.1 * units.s),
        (lambda y0s: ensemble(oscillator, (0, 1), y0s, method=EIPRK4, h=0.1), "y0s", [Y0, Y0] * units.AU),
        (lambda y_hat: project(y_hat, SQUARE, target=1.0), "y_hat", Y0 * units.AU),
        (lambda gm: nbody(**BODIES | {"gm": gm}), "gm", [1, 2] * units.kg),
        (lambda epoch: nbody(**BODIES, epoch=epoch), "epoch", Time(2451545.0, format="jd")),
        (lambda position: nbody(**BODIES | {"position": position}), "position", np.eye(2, 3) * units.AU),
    ],
)
def test_units_and_dates_are_refused(call, name, value):
    with pytest.raises(TypeError, match=f"^{name}: .* has a unit or is a date; expected plain numbers"):
        call(**{name: value})


@pytest.mark.parametrize("what", ["fun", "invariant 'S'", "gradient of invariant 'S'", "event 0"])
def test_functions_that_return_units(what):
    functions = {"fun": oscillator, "invariant 'S'": SQUARE.fun, "gradient of invariant 'S'": SQUARE.grad}
    functions["event 0"] = lambda t, y: y[0]
    plain = functions[what]
    functions[what] = lambda t, y: plain(t, y) * units.AU
    fun, value, gradient, event = functions.values()
    with pytest.raises(TypeError, match=f"^{what} returned: .* has a unit"):
        by_integrate(fun=fun, invariants=Invariant(value, gradient, name="S"), events=event)


@pytest.mark.parametrize(
    "kind",
    [
        lambda y: np.array(y, object),
        lambda y: [Fraction(float(v)) for v in y],
        lambda y: [mpmath.mpf(float(v)) for v in y],
        lambda y: np.array([sympy.Float(float(v), 17) for v in y]),
        lambda y: units.Quantity(y, ""),
        lambda y: [4.0 * v * units.Unit(0.25) for v in y],
        tuple,
    ],
)
def test_numbers_of_all_kinds(kind):
    """SciPy converts them too, as states and as values of the right-hand side."""
    plain = by_integrate(compiled=False)
    np.testing.assert_array_equal(by_integrate(y0=kind(Y0)).y, plain.y)
    np.testing.assert_array_equal(by_integrate(fun=lambda t, y: kind(oscillator(t, y))).y, plain.y)


def test_complex_objects():
    found = by_integrate(fun=lambda t, y: [mpmath.mpc(1j * v) for v in y], y0=[mpmath.mpc(1, 2)])
    np.testing.assert_allclose(found.y[0, -1], (1 + 2j) * np.exp(1j), rtol=1e-5)
