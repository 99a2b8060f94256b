"""Values with a unit, and dates, raise a TypeError that names the argument, instead of losing their unit."""

import datetime

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import SQUARE, oscillator

from eip_scipy import EIPRK4, EIPRK45, Invariant, check_gradient, ensemble, integrate, problems, project
from eip_scipy.problems import ForceConstants, Problem, nbody
from eip_scipy_studies.comparators import stormer_verlet

units = pytest.importorskip("astropy.units")
Time = pytest.importorskip("astropy.time").Time

Y0 = [1.0, 2.0]
BODIES = {"gm": [1.0, 1e-3], "position": np.eye(2, 3), "velocity": np.array([[0, 0, 0], [0, 1.0, 0]])}


class PintLike:
    """A number with a unit as pint and unyt spell it; NumPy takes it for a plain one."""

    units = "km"

    def __init__(self, value):
        self.magnitude = np.asarray(value, dtype=float)

    def __array__(self, dtype=None, copy=None):
        return self.magnitude

    def __float__(self):
        return float(self.magnitude)

    def __repr__(self):
        return f"<{self.magnitude} km>"


QUANTITIES = {
    "quantity": lambda x: units.Quantity(x, "AU"),
    "without dimension": lambda x: units.Quantity(x, ""),
    "list of quantities": lambda x: [units.Quantity(v, "AU") for v in x] if np.ndim(x) else units.Quantity(x, "AU"),
    "array of quantities": lambda x: _objects([units.Quantity(v, "AU") for v in x]) if np.ndim(x) == 1 else PintLike(x),
    "pint": PintLike,
}
DATES = {
    "Time": lambda x: Time(2451545.0 + np.asarray(x), format="jd"),
    "TimeDelta": lambda x: Time(2451545.0 + np.asarray(x), format="jd") - Time(2451544.0, format="jd"),
    "datetime": lambda x: [datetime.datetime(2000, 1, 1)] * np.size(x) if np.ndim(x) else datetime.datetime(2000, 1, 1),
    "timedelta": lambda x: datetime.timedelta(days=1),
    "timedelta64": lambda x: np.asarray(x).astype("timedelta64[s]"),
    "datetime64": lambda x: np.asarray(x).astype("datetime64[D]"),
}
KINDS = QUANTITIES | DATES


def _objects(items):
    out = np.empty(len(items), object)
    out[:] = items
    return out


def by_integrate(**options):
    options = {"fun": oscillator, "t_span": (0, 1), "y0": Y0, "method": EIPRK4, "h": 0.1, "compiled": False, **options}
    return integrate(options.pop("fun"), options.pop("t_span"), options.pop("y0"), **options)


def by_adaptive(**options):
    return by_integrate(**{"method": EIPRK45, "h": None, **options})


def by_scipy(**options):
    options = {"method": EIPRK45, **options}
    return solve_ivp(oscillator, (0, 1), options.pop("y0", Y0), **options)


def by_class(**options):
    options = {"t0": 0.0, "y0": Y0, "t_bound": 1.0, "h": 0.1, **options}
    return EIPRK4(oscillator, options.pop("t0"), options.pop("y0"), options.pop("t_bound"), **options)


def by_ensemble(**options):
    options = {"y0s": [Y0, Y0], "method": EIPRK4, "h": 0.1, "compiled": False, **options}
    return ensemble(oscillator, options.pop("t_span", (0, 1)), options.pop("y0s"), **options)


def by_project(**options):
    return project(**{"y_hat": [0.6, 0.81], "invariants": SQUARE, "target": 1.0, **options})


def invariant(**options):
    return Invariant(lambda t, y, *a: y @ y, lambda t, y, *a: 2 * y, **options)


def by_nbody(**options):
    return nbody(**{**BODIES, "t_span": (0, 1), **options})


def problem(**options):
    return Problem(**{"name": "mine", "fun": oscillator, "y0": np.array(Y0), "t_span": (0, 1), **options})


def verlet(**options):
    arguments = {"t_span": (0, 1), "y0": Y0, "h": 0.1, **options}
    return stormer_verlet(lambda t, q, *p: -q, **arguments)


ARGUMENTS = [
    (by_integrate, "t_span", (0.0, 1.0)),
    *((by_integrate, name, value) for name, value in (("y0", Y0), ("h", 0.1), ("params", [1.0]), ("t_eval", [0.5]))),
    *((by_integrate, name, 1) for name in ("save_every", "every", "iterations", "max_bytes", "checkpoint_every")),
    *((by_integrate, name, value) for name, value in (("metric", Y0), ("rtol", 1e-3), ("atol", [1e-3, 1e-3]))),
    (by_integrate, "blocks", [0, 1]),
    (by_integrate, "frame", (np.ones((1, 2)), np.ones((2, 1)))),
    *((by_adaptive, name, 0.1) for name in ("first_step", "max_step", "rtol", "atol")),
    *((by_scipy, name, value) for name, value in (("y0", Y0), ("first_step", 0.1), ("max_step", 0.1), ("rtol", 1e-3))),
    *((by_class, name, value) for name, value in (("y0", Y0), ("h", 0.1))),
    *((by_ensemble, name, value) for name, value in (("y0s", [Y0, Y0]), ("h", 0.1), ("params", [1.0]))),
    *((by_ensemble, name, value) for name, value in (("t_span", (0.0, 1.0)), ("chunk", 1), ("max_bytes", 1e3))),
    *((by_project, name, value) for name, value in (("y_hat", Y0), ("t", 0.0), ("sigma", Y0), ("f", Y0))),
    (by_project, "target", 1.0),
    *((invariant, name, value) for name, value in (("target", 1.0), ("scale", 1.0))),
    *((by_nbody, name, value) for name, value in (*BODIES.items(), ("t_span", (0.0, 1.0)), ("h", 0.1))),
    *((problem, name, value) for name, value in (("y0", Y0), ("t_span", (0.0, 1.0)), ("h", 0.1), ("params", Y0))),
    *((lambda **o: check_gradient(SQUARE, **{"t": 0.0, "y": Y0, **o}), n, v) for n, v in (("t", 0.0), ("y", Y0))),
    *((verlet, name, value) for name, value in (("t_span", (0.0, 1.0)), ("y0", Y0), ("h", 0.1), ("params", [1.0]))),
    *((problems.kepler, name, 0.5) for name in ("eccentricity", "relativistic", "t_end", "h")),
    *((problems.harmonic, name, 0.5) for name in ("omega", "t_end", "h")),
    *((problems.solar_system, name, 0.5) for name in ("years", "h")),
    *((ForceConstants, name, 1.0) for name in ("c", "j2", "moon")),
    (problems.figure_eight, "periods", 1.0),
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("call", "name", "value"), ARGUMENTS)
def test_units_and_dates_are_refused(call, name, value, kind):
    # Only the first part of a matrix or of a pair of them has a unit.
    pair = isinstance(value, tuple) and np.ndim(value[0])
    given = (KINDS[kind](value[0]), *value[1:]) if pair else KINDS[kind](value)
    with pytest.raises(TypeError, match=f"^{name}: .*(has a unit|is a date or a duration).*expected plain numbers"):
        call(**{name: given})


@pytest.mark.parametrize("kind", QUANTITIES)
def test_of_a_pair_one_is_enough(kind):
    quantity = QUANTITIES[kind](1.0)
    for call, name in ((by_integrate, "t_span"), (by_ensemble, "t_span"), (by_nbody, "t_span")):
        with pytest.raises(TypeError, match=r"^t_span: .* has a unit"):
            call(**{name: (0.0, quantity)})
    with pytest.raises(TypeError, match=r"^y0: .* has a unit"):
        by_integrate(y0=[1.0, quantity])
    with pytest.raises(TypeError, match=r"^args: .* has a unit"):
        invariant(args=(1.0, quantity))
    with pytest.raises(TypeError, match=r"^t_span: .* has a unit"):
        by_class(t_bound=quantity)


RETURNED = [
    ("fun", lambda q: {"fun": lambda t, y: q([y[1], -y[0]])}),
    ("fun", lambda q: {"fun": lambda t, y: oscillator(t, y) if t < 0.5 else q([y[1], -y[0]])}),
    ("invariant 'S'", lambda q: {"invariants": Invariant(lambda t, y: q(y @ y), lambda t, y: 2 * y, name="S")}),
    ("gradient of invariant 'S'", lambda q: {"invariants": Invariant(SQUARE.fun, lambda t, y: q(2 * y), name="S")}),
    ("event 0", lambda q: {"events": lambda t, y: q(y[0])}),
]


@pytest.mark.parametrize("kind", QUANTITIES)
@pytest.mark.parametrize(("what", "options"), RETURNED)
def test_functions_that_return_units(what, options, kind):
    options = options(QUANTITIES[kind])
    with pytest.raises(TypeError, match=f"^{what} returned: .* has a unit"):
        by_integrate(**options)
    if what not in ("fun", "event 0"):
        with pytest.raises(TypeError, match=f"^{what} returned: .* has a unit"):
            by_scipy(**options)


def test_solve_ivp_of_functions_that_return_units():
    for vectorized in (False, True):
        with pytest.raises(TypeError, match=r"^fun returned: .* has a unit"):
            solve_ivp(
                lambda t, y: units.Quantity([y[1], -y[0]], "km"),
                (0, 1),
                Y0,
                method=EIPRK4,
                h=0.1,
                vectorized=vectorized,
            )


@pytest.mark.parametrize("kind", KINDS)
def test_times_of_dense_output(kind):
    solver = EIPRK45(oscillator, 0.0, Y0, 1.0, invariants=SQUARE)
    solver.step()
    with pytest.raises(TypeError, match=r"^t: "):
        solver.dense_output()(KINDS[kind](0.01))


def test_epochs_of_kernels():
    pytest.importorskip("jplephem")
    from eip_scipy.integrations import jpl

    with pytest.raises(ValueError, match=r"epoch_jd_tdb: expected one moment, got times of shape \(2,\)"):
        jpl.initial_data(Time(["2014-02-02", "2014-02-03"]))
    with pytest.raises(TypeError, match=r"epoch_jd_tdb: .* is a date or a duration"):
        jpl.initial_data(datetime.date(2014, 2, 2))
    with pytest.raises(TypeError, match=r"^epoch_jd_tdb: .* has a unit"):
        jpl.initial_data(2456690.5 * units.day)
    with pytest.raises(TypeError, match=r"^days: .* has a unit"):
        jpl.heliocentric(2456690.5, np.arange(3) * units.day)


def test_states_for_rebound():
    rebound = pytest.importorskip("eip_scipy.integrations.rebound", exc_type=ImportError)
    y = np.arange(12.0)
    with pytest.raises(TypeError, match=r"^gm: .* has a unit"):
        rebound.simulation([1, 2] * units.kg, y)
    with pytest.raises(TypeError, match=r"^h: .* has a unit"):
        rebound.run([1, 2], y, "ias15", h=1 * units.day, n_steps=1)


def test_plain_numbers_of_all_kinds_are_taken():
    """Numbers of arrays that could have a unit are accepted, and objects with such a name that are not numbers."""
    from fractions import Fraction

    plain = by_integrate()
    for h in (np.float64(0.1), np.float32(0.5), 1):
        assert by_integrate(h=h).status == 0
    for y0 in (np.array(Y0, object), [Fraction(1), Fraction(2)], np.ma.array(Y0), tuple(Y0)):
        np.testing.assert_array_equal(by_integrate(y0=y0).y, plain.y)

    class Settings:
        unit = "km"

    kept = Invariant(lambda t, y, s: y @ y, lambda t, y, s: 2 * y, args=(Settings(),))
    assert by_integrate(invariants=kept).status == 0
