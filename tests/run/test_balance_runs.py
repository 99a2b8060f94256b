"""Balances in `integrate` and `ensemble`: compiled and interpreted, checkpoints, continuations, events, C functions."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
from c_compiler import low_level, shared_library
from numba import njit
from systems import BALANCES, QUARTIC_PARAMS, QUARTIC_START, swinging
from systems import quartic_energy as energy
from systems import quartic_rate as rate

from eip_scipy import EIPDOP853, EIPGJ12, EIPRK4, EIPRK45, Balance, Invariant, ProjectionWarning, integrate
from eip_scipy.checkpoint import CheckpointError

RUNS = [
    {"method": EIPDOP853, "h": 0.25},
    {"method": EIPRK4, "h": 0.1, "every": 3},
    {"method": EIPRK45, "rtol": 1e-8, "atol": 1e-10},
    {"method": EIPGJ12, "h": 0.025},
]
PARAMS, START, BALANCE = QUARTIC_PARAMS, QUARTIC_START, BALANCES["rate"]


def run(end=20.0, **options):
    return integrate(swinging, (0, end), START, **{"params": PARAMS, "invariants": BALANCE, **options})


def exact(end):
    def fun(t, y):
        return swinging(t, y, PARAMS)

    return scipy.integrate.solve_ivp(fun, (0, end), START, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]


def test_rates_in_all_ways():
    """The arguments of the balance come first, then those of the run."""

    def swing(t, y, a, w):
        return swinging(t, y, np.array([a, w]))

    of_run = Balance(lambda t, y, *p: energy(t, y, PARAMS), lambda t, y, a, w: rate(t, y, np.array([a, w])), name="H")
    own = Balance(lambda t, y, k, *p: energy(t, y, PARAMS), lambda t, y, k, *p: k / 3 * rate(t, y, PARAMS), args=(3,))
    expected = run(method=EIPDOP853, h=0.25).y[:, -1]
    ways = [(swing, balance, {"args": tuple(PARAMS)}) for balance in (of_run, own)]
    ways += [(swinging, balance, {"params": PARAMS}) for balance in BALANCES.values()]
    for fun, balance, given in ways:
        found = integrate(fun, (0, 20), START, method=EIPDOP853, h=0.25, invariants=balance, **given)
        assert np.abs(found.y[:, -1] - expected).max() < 1e-12
        assert found.trusted


SOURCE = """
#include <math.h>
int fun(double t, const double *y, double *out, const double *p) {
    out[0] = y[1];
    out[1] = -(1 + p[0] * sin(p[1] * t)) * y[0] - y[0] * y[0] * y[0];
    return 0;
}
int energy(double t, const double *y, double *out, const double *p) {
    const double q2 = y[0] * y[0];
    out[0] = 0.5 * y[1] * y[1] + 0.5 * (1 + p[0] * sin(p[1] * t)) * q2 + 0.25 * q2 * q2;
    return 0;
}
int rate(double t, const double *y, const double *f, double *out, const double *p) {
    if (t > p[2]) return -7;
    out[0] = 0.5 * p[0] * p[1] * cos(p[1] * t) * y[0] * y[0];
    return 0;
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("balances")
    source = folder / "functions.c"
    source.write_text(SOURCE, encoding="utf-8")
    path = shared_library(folder / "functions.so", source)
    arrays = {"fun": 3, "energy": 3, "rate": 4}
    return SimpleNamespace(**{name: low_level(path, name, count) for name, count in arrays.items()})


def test_c_functions(library):
    """Without a rate the engine takes gradients and the derivative in time by differences."""
    options = {"params": [*PARAMS, 30.0], "method": EIPDOP853, "h": 0.25}
    for given, compiled in product((True, False), (True, False)):
        balance = Balance(library.energy, library.rate if given else None, name="H")
        found = integrate(library.fun, (0, 20), START, invariants=balance, compiled=compiled, **options)
        assert found.trusted
        assert found.compiled == compiled
        assert found.calls.get("rate of H") == (("pointer" if compiled else "python") if given else None)
        assert np.abs(found.y[:, -1] - run(method=EIPDOP853, h=0.25).y[:, -1]).max() < 1e-11
    with pytest.raises(RuntimeError, match="rate of balance 'H' returned the status -7 at t=10"):
        integrate(library.fun, (0, 20), START, params=[*PARAMS, 10.0], method=EIPRK4, h=0.25,
                  invariants=Balance(library.energy, library.rate, name="H"))  # fmt: skip


def test_a_checkpoint_knows_which_are_balances(tmp_path):
    options = {"method": EIPRK4, "h": 0.1, "end": 5.0, "checkpoint": tmp_path / "run.npz", "check": False}
    run(**options)
    with pytest.raises(CheckpointError, match="balances"):
        run(invariants=Invariant(energy, name="H"), resume=True, **options)


@pytest.mark.parametrize("options", RUNS)
def test_a_run_is_continued(options):
    """Q continues from its value at the end, and starts again in a state between two steps."""

    def third_zero(t, y, p):
        return y[0]

    third_zero.terminal = 3
    right = energy(20.0, exact(20.0), PARAMS)
    loose = 1e-7 if options["method"] is EIPRK4 else 2e-11
    halves = run(end=10.0, **options).continue_to(20.0)
    at_event = run(events=third_zero, **options).continue_to(20.0, events=None)
    for found in (halves, at_event):
        assert found.t[-1] == 20.0
        assert found.trusted
        assert abs(energy(20.0, found.y[:, -1], PARAMS) - right) < loose
        assert np.isfinite(found.diagnostics.slowness).all()


driven = njit(lambda t, y, p: np.array([y[1], -y[0] - 0.02 * y[1] + 0.01 * np.cos(2 * t)]))
plain_energy = njit(lambda t, y, p: 0.5 * (y[0] ** 2 + y[1] ** 2))
power = njit(lambda t, y, p: -0.02 * y[1] ** 2 + 0.01 * y[1] * np.cos(2 * t))


@pytest.mark.filterwarnings("ignore:balance 'E' changes too fast:UserWarning")
@pytest.mark.parametrize("options", RUNS)
def test_a_run_in_two_parts_is_as_slow_as_in_one(options):
    """The energy decays to that of the driving, so that it is slow at the start only."""
    balance = Balance(plain_energy, power, name="E")

    def until(end):
        return integrate(driven, (0, end), START, params=PARAMS, invariants=balance, **options)

    whole, halves = until(1500.0).diagnostics.slowness[0], until(1300.0).continue_to(1500.0).diagnostics.slowness[0]
    assert whole > 0.1
    assert halves == pytest.approx(whole, rel=0.15)
    assert until(200.0).diagnostics.slowness[0] < 0.05


YEAR = 365.25 * 86400.0
LOSS = 1e-5  # of the star's mass, a year


@pytest.mark.parametrize("year", [YEAR, 1.0], ids=["seconds", "years"])
def test_the_unit_of_time_does_not_matter(year):
    """A planet of a star that loses mass, lengths in au.

    SciPy's estimate of the first step is a fraction of a second in seconds: differences in time over it were rounding.
    """
    w, loss = 2 * np.pi / year, LOSS / year
    t_span, y0 = (0.0, 50 * year), [0.8, 0.0, 0.0, w * 1.5**0.5]
    scale = np.array([1.0, 1.0, w, w])

    def pull(t, y):
        return w**2 * np.exp(-loss * t) * (y[0] ** 2 + y[1] ** 2) ** -0.5

    def fun(t, y):
        return np.array([*y[2:], *(-pull(t, y) / (y[0] ** 2 + y[1] ** 2) * y[:2])])

    def energy(t, y):
        return 0.5 * (y[2] ** 2 + y[3] ** 2) - pull(t, y)

    exact = scipy.integrate.solve_ivp(fun, t_span, y0, method="DOP853", rtol=1e-13, atol=scale * 1e-15).y[:2, -1]
    options = {"method": EIPDOP853, "rtol": 1e-9, "atol": scale * 1e-11}

    kept = integrate(fun, t_span, y0, invariants=Balance(energy), **options)
    assert kept.trusted
    assert np.linalg.norm(kept.y[:2, -1] - exact) < 3e-7  # 2.5e-5 without the balance

    with pytest.warns(ProjectionWarning, match="'F' is not an invariant"):
        wrong = integrate(fun, t_span, y0, invariants=Invariant(energy, name="F"), **options)
    assert not wrong.trusted
