"""Unreliable and reliable runs: reports to users through the public interface."""

import itertools
import math
import warnings
from contextlib import nullcontext

import numba
import numpy as np
import pytest
import systems
from scipy.integrate import solve_ivp
from systems import oscillator

from eip_scipy import (
    EIPDOP853,
    EIPRK1,
    EIPRK2,
    EIPRK3,
    EIPRK4,
    EIPRK5,
    EIPRK23,
    EIPRK45,
    EIPRKN8,
    EIPRKN12,
    Diagnostics,
    Invariant,
    ProjectionWarning,
    eip_method,
    ensemble,
    integrate,
    project,
)
from eip_scipy.ensembles import tasks
from eip_scipy.problems import Grid, GrossPitaevskii, kepler, nbody, pythagorean
from eip_scipy_studies.hard_cases import lotka_volterra, rigid_body, sir

EVERY_CLASS = [EIPRK1, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPDOP853, EIPRKN8, EIPRKN12]
ADAPTIVE = [EIPRK23, EIPRK45, EIPDOP853, EIPRKN8, EIPRKN12]


def pendulum(friction=0.0):
    return lambda t, y: np.array([y[1], -np.sin(y[0]) - friction * y[1]])


ENERGY = Invariant(systems.pendulum_energy, systems.pendulum_gradient, name="energy")
SQUARE = Invariant(lambda t, y: 0.5 * float(y @ y), lambda t, y: y, name="square")


def stiffer(t, y):
    return np.array([y[1], -2.0 * y[0]])


def by_solve_ivp(fun, t_span, y0, **options):
    record = Diagnostics()
    sol = solve_ivp(fun, t_span, y0, diagnostics=record, **options)
    return sol, record


def by_integrate(fun, t_span, y0, **options):
    run = integrate(fun, t_span, y0, **options)
    assert run.trusted == (run.diagnostics.trusted and run.success)
    assert run.diagnostics.message in run.message
    return run, run.diagnostics


both = pytest.mark.parametrize("driver", [by_solve_ivp, by_integrate], ids=["solve_ivp", "integrate"])


@both
@pytest.mark.parametrize("method", ADAPTIVE)
def test_an_invariant_whose_rate_is_zero_at_the_start(driver, method):
    """Released from rest, a pendulum with friction does not lose energy yet."""
    if method in (EIPRKN8, EIPRKN12):

        def fun(t, y):  # driven, from t = 0 of the force
            return np.array([y[1], -np.sin(y[0]) + 0.3 * np.sin(t)])
    else:
        fun = pendulum(0.2)
    told = r"(?s)'energy'.*not an invariant of this system.*docs/explanation/trust.md"
    with pytest.warns(ProjectionWarning, match=told) as caught:
        run, record = driver(fun, (0, 20), [2.0, 0.0], method=method, rtol=1e-8, invariants=ENERGY)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert run.success
    assert not record.trusted
    name, t, size = record.worst
    assert name == "energy"
    assert 0 < t <= 20
    assert size > 50
    assert "energy" in record.message
    assert record.message in repr(record)


@both
@pytest.mark.parametrize("method", EVERY_CLASS)
@pytest.mark.parametrize("metric", ["error", "euclidean"])
def test_every_class_tells(driver, method, metric):
    """A quantity that is not an invariant is reported with fixed steps, in the euclidean metric too."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run, record = driver(stiffer, (0, 10), [1.0, 0.3], method=method, h=0.02, metric=metric, invariants=SQUARE)
    assert run.success
    assert not record.trusted
    # Local errors of orders 1 and 2 are nearly as large as the changes of the quantity; the check at the start reports
    # it.
    low = method in (EIPRK1, EIPRK2)
    assert [w.category for w in caught] == ([UserWarning] if low else [UserWarning, ProjectionWarning])


@both
@pytest.mark.parametrize("method", EVERY_CLASS)
@pytest.mark.parametrize("metric", ["error", "euclidean"])
def test_every_class_trusts(driver, method, metric):
    run, record = driver(oscillator, (0, 10), [1.0, 0.3], method=method, h=0.02, metric=metric, invariants=SQUARE)
    assert run.success
    assert record.trusted
    assert record.message == ""
    assert record.worst[2] < 50


@both
def test_a_step_that_is_far_too_long(driver):
    """The projection leaves more than the energy itself: the run fails, and keeps its states."""
    options = {"method": EIPRK4, "h": 3.0, "invariants": SQUARE}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)  # solve_ivp warns at the first step, before the run fails
        run, record = driver(oscillator, (0, 60), [1.0, 0.0], **options)
    assert run.status == -1
    assert "projection failed" in run.message
    assert "'square'" in run.message
    assert not record.trusted
    assert run.t.size > 1
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run, record = driver(oscillator, (0, 60), [1.0, 0.0], **options | {"h": 2.0})
    assert run.success
    assert not record.trusted
    assert [w.category for w in caught] == [ProjectionWarning]


@pytest.mark.needs_jit
def test_no_success_with_a_defect_of_the_size_of_the_terms():
    fast = numba.njit(lambda t, y: np.array([y[1], -1e8 * y[0]]))
    energy = numba.njit(lambda t, y: 0.5 * (y[1] ** 2 + 1e8 * y[0] ** 2))
    H = Invariant(energy, numba.njit(lambda t, y: np.array([1e8 * y[0], y[1]])), name="H")
    runs = [
        integrate(fast, (0, 10), [1.0, 0.0], method=EIPRK4, h=0.1, invariants=H, compiled=compiled)
        for compiled in (True, False)
    ]
    for run in runs:
        assert run.status == -1
        assert not run.trusted
        assert "'H'" in run.message
    assert runs[0].t.tolist() == runs[1].t.tolist()


@both
@pytest.mark.parametrize("rtol", [1e-1, 1.0])
def test_loose_tolerances_leave_small_defects_or_tell(driver, rtol):
    """Adaptive steps are shortened until the projection leaves less than a hundredth of the terms."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)
        options = {"method": EIPRK45, "rtol": rtol, "atol": rtol, "invariants": ENERGY}
        options |= {"save_every": 1} if driver is by_integrate else {}
        run, record = driver(pendulum(), (0, 50), [2.0, 0.0], **options)
    assert run.success
    q, v = run.y
    # The step measures the terms at its raw results, which at such tolerances differ from the states by some per cent.
    assert record.max_defect[0] <= 1.05e-2 * np.max(np.abs(np.sin(q) * q) + v**2)


def test_a_passage_that_the_step_does_not_resolve():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)
        run = integrate(pythagorean(), (0, 70), method=EIPRKN12, h=0.01)
    assert not run.trusted
    assert not run.success or run.diagnostics.worst[2] > 1e3


def test_without_check_nobody_looks():
    run = integrate(oscillator, (0, 60), [1.0, 0.0], method=EIPRK4, h=3.0, invariants=SQUARE, check=False)
    assert run.success
    assert run.max_defect[0] > 1e3
    assert run.diagnostics.worst is None
    assert run.diagnostics.message == ""


def test_as_an_error_it_carries_the_run():
    with warnings.catch_warnings():
        warnings.simplefilter("error", ProjectionWarning)
        with pytest.raises(ProjectionWarning, match="energy") as caught:
            integrate(pendulum(0.2), (0, 20), [2.0, 0.0], method=EIPRK45, rtol=1e-8, invariants=ENERGY)
    run = caught.value.partial
    assert run.status == 0
    assert run.t[-1] == 20
    assert not run.trusted


def test_a_gradient_that_is_wrong_where_the_start_does_not_show_it():
    """At the start the second mass is at its place of rest and has no velocity."""
    k = 0.7

    def chain(t, y):
        a, b, u, v = y
        return np.array([u, v, -a - k * (a - b), -b - k * (b - a)])

    def energy(t, y):
        a, b, u, v = y
        return 0.5 * (u * u + v * v + a * a + b * b + k * (a - b) ** 2)

    def gradient(t, y):
        a, b, u, v = y
        return np.array([a + k * (a - b), b + k * (b - a), u, 3 * v])

    H = Invariant(energy, gradient, name="H")
    with pytest.warns(ProjectionWarning, match="gradient of invariant 'H' is wrong"):
        run = integrate(chain, (0, 10), [1.0, 0.0, 0.0, 0.0], method=EIPRK45, rtol=1e-8, invariants=H)
    assert not run.trusted


def test_close_to_a_pericentre_a_right_gradient_is_right():
    for e in (0.9, 1 - 1e-3, 1 - 1e-6, 1 - 1e-9):
        problem = kepler(e, relativistic=0)
        period = 2 * math.pi
        run = integrate(
            problem, (0, 1e-3 * period), method=EIPDOP853, h=None, first_step=1e-12, rtol=1e-10, compiled=False
        )
        assert run.success
        assert run.trusted


@pytest.mark.parametrize("true", [True, False])
def test_joint_invariants(true):
    """A field's mass, by the functions that take two passes over it."""
    n = 64
    k = np.fft.fftfreq(n, 1 / n)
    decay = 0.0 if true else 1e-2

    def fun(t, y):
        # A decay that begins slowly: the start check does not see it.
        return -0.5j * np.fft.ifft(k**2 * np.fft.fft(y)) - 1j * np.abs(y) ** 2 * y - decay * t * y

    invariants = GrossPitaevskii(Grid(n, 0, 2 * np.pi), beta=1.0).invariants(["mass"])
    x = 2 * np.pi * np.arange(n) / n
    y0 = 1 + 0.1 * np.exp(1j * x)
    options = {"method": EIPRK4, "h": 1e-3, "metric": "euclidean", "invariants": invariants}
    with nullcontext() if true else pytest.warns(ProjectionWarning, match="mass"):
        run = integrate(fun, (0, 1), y0, **options)
    assert run.trusted is true
    assert not true or run.diagnostics.worst[2] < 50


def test_spaced_and_compensated_runs_are_trusted():
    problem = kepler(0.3, relativistic=0)
    for every in (1, 10, "auto"):
        for compensated in (False, True):
            run = integrate(problem, (0, 100), method=EIPRKN12, h=0.05, every=every, compensated=compensated)
            assert run.trusted, (every, compensated, run.message)


@numba.njit
def damped_in_place(t, y, out, params):
    out[0], out[1] = y[1], -math.sin(y[0]) - params[0] * y[1]


@numba.njit
def energy_in_place(t, y, params):
    return 0.5 * y[1] ** 2 - math.cos(y[0])


@numba.njit
def gradient_in_place(t, y, out, params):
    out[0], out[1] = math.sin(y[0]), y[1]


@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize("method", [EIPRK2, EIPRK4, EIPRK5])
@pytest.mark.parametrize("together", [False, True], ids=["one by one", "in vectors"])
def test_each_member_is_judged_by_its_own_checks(method, together, monkeypatch):
    """Members 1 to 7 have friction of 1e-4 to 0.1; the others, some of them in a vector with these, have none."""
    monkeypatch.setattr(tasks, "LEAST_WORK", 0.0 if together else np.inf)
    friction = np.zeros((17, 1))
    friction[1:8, 0] = np.geomspace(1e-4, 0.1, 7)
    options = {"h": 0.02, "invariants": Invariant(energy_in_place, gradient_in_place, name="energy", in_place=True)}
    options |= {"in_place": True, "params": friction, "executor": 1}
    with pytest.warns(ProjectionWarning, match="7 of 17 members .* the first of them member 1"):
        run = ensemble(damped_in_place, (0, 10), np.tile([2.0, 0.0], (17, 1)), method=method, **options)
    assert run.success
    assert run.side_by_side.all() == together
    assert np.flatnonzero(~run.trusted).tolist() == list(range(1, 8))
    assert all("'energy' is not an invariant" in run.message[k] for k in range(1, 8))


@pytest.mark.parametrize("differing", [False, True])
def test_members_that_the_start_speaks_against(differing):
    """The start of one member is checked: what it shows holds for those with the same parameters."""
    friction = np.full((4, 1), 1e-6)
    friction[2:] *= 1 - differing
    starts = [[2.0, 0.5], [1.9, 0.5], [2.0, 0.5], [1.9, 0.5]]
    energy = Invariant(energy_in_place, gradient_in_place, name="energy", in_place=True)
    options = {"method": EIPRK4, "h": 0.05, "invariants": energy, "compiled": False, "params": friction}
    with (
        pytest.warns(UserWarning, match="'energy' is not an invariant"),
        pytest.warns(ProjectionWarning, match=f"{2 if differing else 4} of 4 members .* the first of them member 0"),
    ):
        run = ensemble(damped_in_place, (0, 1), starts, in_place=True, **options)
    assert run.success
    assert run.trusted.tolist() == [False, False, differing, differing]
    assert ["'energy' is not an invariant" in text for text in run.message] == (~run.trusted).tolist()


def late_friction(t, y):
    return np.array([y[1], -np.sin(y[0]) - 1e-3 * y[1] * (t > 5)])


def kicked(t, y):
    return np.array([y[1], -np.sin(y[0]) + 0.05 * np.exp(-(((t - 7.3) / 0.1) ** 2))])


LATE = [(late_friction, method) for method in (EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPDOP853)]
LATE += [(kicked, method) for method in (EIPRK3, EIPRK4, EIPRK5, EIPRK45, EIPDOP853, EIPRKN8, EIPRKN12)]


@both
@pytest.mark.parametrize(("fun", "method"), LATE)
def test_leaks_that_start_late(driver, fun, method):
    """The energy is conserved until t = 5 or 7, and the end is off by more than 10 times the error without it."""
    steps = {"h": 0.02} if method in (EIPRK2, EIPRK3, EIPRK4, EIPRK5) else {"rtol": 1e-8, "atol": 1e-10}
    with pytest.warns(ProjectionWarning, match="'energy' is not an invariant of this system: at t="):
        run, record = driver(fun, (0, 20), [2.0, 0.0], method=method, invariants=ENERGY, **steps)
    assert run.status == 0
    assert not record.trusted


def near_pericentre(t, y):
    """Drag at r < 0.42, for 10 % of each turn: not at the start, nor at the end."""
    return systems.orbit(t, y) - (1e-2 if np.hypot(y[0], y[1]) < 0.42 else 0.0) * np.array([0, 0, y[2], y[3]])


class Leapfrog:
    """Velocity Verlet for a pendulum with or without friction."""

    order = 2

    def __init__(self, friction):
        self.force = lambda q, v: -np.sin(q) - friction * v

    def one_step(self, t, y, h):
        q, v = y
        v = v + h / 2 * self.force(q, v)
        q = q + h * v
        return [q, v + h / 2 * self.force(q, v)]


LEVELS = np.diag([1.0, 2.0, 4.0]) + 0.3 * np.ones((3, 3))
LOSS = np.array([0.0, 1e-2, 0.0])
MASS = Invariant(lambda t, y: float(np.vdot(y, y).real), lambda t, y: 2 * y, name="mass")
COMPUTED = Invariant(ENERGY.fun, name="energy")
LATER = "is not an invariant of this system: at t="
REST, ORBIT, ATOM = [2.0, 0.0], [1.6, 0.0, 0.0, 0.5], np.array([1.0, 0.0, 0.2j])
TIGHT = {"rtol": 1e-8, "invariants": ENERGY}
FIXED = {"h": 0.02, "invariants": ENERGY}
LEAKS = [
    # From a start at which the energy's rate is almost zero.
    *((pendulum(1e-3), 30, REST, {"method": m, "rtol": 1e-6, "invariants": ENERGY}, "energy")
      for m in (EIPRK23, EIPRK45, EIPDOP853)),
    (lambda t, y: -1j * (LEVELS @ y) - LOSS * y, 5, ATOM, {"method": EIPRK45, **TIGHT, "invariants": MASS}, "mass"),
    (pendulum(0.2), 20, REST, {"method": eip_method(Leapfrog(0.2)), **FIXED}, "energy"),
    *((near_pericentre, 19, ORBIT, {"method": m, **steps, "invariants": systems.H}, "'energy' is not an invariant")
      for m, steps in ((EIPRK4, {"h": 0.01}), (EIPRK5, {"h": 0.01}), (EIPRK45, {"rtol": 1e-8}))),
    *((late_friction, 20, REST, {"method": m, **steps, **more}, LATER)
      for m, steps in ((EIPRK5, FIXED), (EIPRK45, TIGHT))
      for more in ({"every": 10}, {"every": "auto"}, {"compensated": True}, {"metric": "euclidean"},
                   {"direction": "midpoint"})),
    *((late_friction, 20, REST, {"method": m, **steps, "invariants": COMPUTED}, LATER)
      for m, steps in ((EIPRK4, FIXED), (EIPRK5, FIXED), (EIPRK45, TIGHT), (EIPDOP853, TIGHT))),
    (lambda t, y: late_friction(-t, y), -20, REST, {"method": EIPRK4, **FIXED}, LATER + "-"),
]  # fmt: skip


@pytest.mark.parametrize(("fun", "end", "y0", "options", "match"), LEAKS)
def test_leaks_are_found(fun, end, y0, options, match):
    with pytest.warns(ProjectionWarning, match=match):
        run = integrate(fun, (0, end), y0, **options)
    assert run.status == 0
    assert not run.trusted


def test_an_event_that_ends_the_run_early_does_not_keep_it_silent():
    def turned(t, y):
        return y[1] + 0.5

    turned.terminal = True
    with pytest.warns(ProjectionWarning):
        sol = solve_ivp(pendulum(0.2), (0, 1000), REST, method=EIPRK45, events=turned, **TIGHT)
    assert sol.status == 1


@pytest.mark.parametrize(
    ("fun", "end", "y0", "options"),
    [
        (lambda t, y: -1j * (LEVELS @ y), 5, ATOM, {"method": EIPRK45, **TIGHT, "invariants": MASS}),
        (pendulum(), 20, REST, {"method": eip_method(Leapfrog(0.0)), **FIXED}),
    ],
)
def test_the_same_without_a_leak(fun, end, y0, options):
    assert integrate(fun, (0, end), y0, **options).trusted


def kinked(kind):
    """Return a force, its energy and a gradient with kinks, along which the energy is conserved."""
    slopes = {
        "Huber": lambda q: min(max(q, -0.3), 0.3),
        "contact": lambda q: 1 + 100 * min(q, 0.0),
        "dead zone": lambda q: min(q + 0.5, 0.0) + max(q - 0.5, 0.0),
        "cubic wall": lambda q: 30 * (max(q - 1, 0.0) ** 3 - max(-1 - q, 0.0) ** 3),
    }
    potentials = {
        "Huber": lambda q: 0.5 * q * q if abs(q) < 0.3 else 0.3 * (abs(q) - 0.15),
        "contact": lambda q: q + 50 * min(q, 0.0) ** 2,
        "dead zone": lambda q: 0.5 * max(abs(q) - 0.5, 0.0) ** 2,
        "cubic wall": lambda q: 7.5 * max(abs(q) - 1, 0.0) ** 4,
    }
    slope, potential = slopes[kind], potentials[kind]
    energy = Invariant(
        lambda t, y: 0.5 * y[1] ** 2 + potential(y[0]), lambda t, y: np.array([slope(y[0]), y[1]]), name="energy"
    )
    return lambda t, y: np.array([y[1], -slope(y[0])]), energy


@pytest.mark.parametrize("kind", ["Huber", "contact", "dead zone", "cubic wall"])
@pytest.mark.parametrize(
    ("method", "given"),
    [*((method, True) for method in (EIPRK4, EIPRK5, EIPRK45, EIPDOP853)), (EIPRK5, False), (EIPRK45, False)],
)
@pytest.mark.filterwarnings("ignore:invariant 'energy' has no grad and allows no complex step")
@pytest.mark.filterwarnings("ignore:overflow encountered in scalar power")  # long trial steps in free flight
def test_kinks_are_no_leaks(kind, method, given):
    """Estimates of steps over a kink are too small, so that corrections are many times larger; the energy holds."""
    fun, energy = kinked(kind)
    if not given:
        energy = Invariant(energy.fun, name="energy")
    every = [{"h": 0.02}, {"h": 0.01}] if method in (EIPRK4, EIPRK5) else [{"rtol": 1e-6}, {"rtol": 1e-9}]
    for steps in every if given else every[:1]:
        for start in ([1.0, 0.1], [0.029, -2.3], [0.453, 0.663]):
            run = integrate(fun, (0, 20), start, method=method, invariants=energy, **steps)
            assert run.trusted, run.message


@pytest.mark.parametrize(("method", "every"), [(EIPRK4, 4), (EIPDOP853, "auto")])
@pytest.mark.parametrize("kind", ["Huber", "contact", "dead zone", "cubic wall"])
def test_kinks_are_no_leaks_between_projections(every, kind, method):
    fun, energy = kinked(kind)
    for start in ([1.0, 0.1], [0.029, -2.3], [0.453, 0.663]):
        run = integrate(fun, (0, 20), start, method=method, h=0.01, invariants=energy, every=every)
        assert run.trusted, run.message


@pytest.mark.parametrize("every", [5, 10, 20])
@pytest.mark.parametrize("driver", ["integrate", "ensemble"])
def test_a_leak_shorter_than_the_spacing_is_found(every, driver):
    """Drag in two steps of a hundred, which the steps that are projected seldom see."""

    def fun(t, y):
        return systems.orbit(t, y) - 0.1 * (0.03 < t % 1 < 0.05) * np.array([0, 0, y[2], y[3]])

    energy = Invariant(lambda t, y: 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2), name="energy")
    options = {"method": EIPRK4, "h": 0.01, "invariants": energy, "every": every}
    run, y0 = (integrate, [0.4, 0.0, 0.0, 2.0]) if driver == "integrate" else (ensemble, [[0.4, 0.0, 0.0, 2.0]])
    with pytest.warns(ProjectionWarning, match="'energy' (is not an invariant|was corrected)"):
        run(fun, (0, 20), y0, **options)


def light_planet(mass):
    """Return a star, a giant planet at 5.2, and a planet at 0.2, whose period is 0.56."""
    distances = np.array([5.2, 0.2])
    q = [[0.0, 0.0, 0.0], *([r, 0.0, 0.0] for r in distances)]
    v = [[0.0, 0.0, 0.0], *([0.0, r**-0.5, 0.0] for r in distances)]
    return nbody([1.0, 1e-3, mass], q, v, t_span=(0.0, 60.0))


@pytest.mark.parametrize("mass", [1e-9, 0.0])
@pytest.mark.parametrize("method", [EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK45, EIPDOP853, EIPRKN8])
def test_a_step_beyond_the_period_of_a_light_planet(method, mass):
    """The energy of the system does not show that the planet leaves its orbit. Short steps resolve its motion."""
    with pytest.warns(ProjectionWarning, match=r"h=0.3 do not resolve the motion of components (6, 7, 8|15, 16, 17) "):
        run = integrate(light_planet(mass), method=method, h=0.3)
    assert run.status == 0
    short = {EIPRK2: 0.005, EIPRK3: 0.01}.get(method, 0.02)
    run = integrate(light_planet(mass), (0, 10), method=method, h=short)
    assert run.trusted, run.message
    assert np.linalg.norm(run.y[6:9, -1] - run.y[:3, -1]) == pytest.approx(0.2, rel=0.02)


@pytest.mark.parametrize("method", [EIPRK3, EIPRK4, EIPRK5, EIPDOP853, EIPRKN8, EIPRKN12])
def test_a_body_that_one_step_throws_out_is_lost(method):
    """A test particle with e = 0.2 whose period is 0.22: after its first step it moves freely, which steps resolve."""
    a, e = 0.108, 0.2
    q = [[0.0, 0.0, 0.0], [5.2, 0.0, 0.0], [a * (1 + e), 0.0, 0.0]]
    v = [[0.0, 0.0, 0.0], [0.0, 5.2**-0.5, 0.0], [0.0, np.sqrt((1 - e) / (1 + e) / a), 0.0]]
    problem = nbody([1.0, 1e-3, 0.0], q, v, t_span=(0.0, 60.0))
    with pytest.warns(ProjectionWarning, match="h=0.344 do not resolve the motion of components "):
        run = integrate(problem, method=method, h=0.344)
    assert np.linalg.norm(run.y[6:9, -1] - run.y[:3, -1]) > 100 * a


def test_a_body_that_a_plain_function_integrates_is_looked_at():
    """Two oscillators in one state, of which the energy knows one; the step is 5 radians of the other."""
    fast = 25.0

    def fun(t, y):
        return np.array([y[1], -y[0], y[3], -(fast**2) * y[2]])

    slow = Invariant(lambda t, y: 0.5 * (y[0] ** 2 + y[1] ** 2), lambda t, y: np.array([y[0], y[1], 0, 0]), name="slow")
    with pytest.warns(ProjectionWarning, match="do not resolve the motion of component [23] "):
        integrate(fun, (0, 2), [1.0, 0.0, 1.0, 0.0], method=EIPRK4, h=0.2, invariants=slow)
    assert integrate(fun, (0, 2), [1.0, 0.0, 1.0, 0.0], method=EIPRK4, h=0.01, invariants=slow).trusted


def test_a_leak_found_before_a_checkpoint_is_known_after_it(tmp_path):
    """The friction acts from t = 5 to 7 only. The first call ends at t = 10, and the second one sees nothing of it."""

    def fun(t, y):
        return np.array([y[1], -np.sin(y[0]) - 1e-3 * y[1] * (5 < t < 7)])

    steps = {"method": EIPRK4, "h": 0.02, "invariants": ENERGY}
    with pytest.warns(ProjectionWarning):
        first = integrate(fun, (0, 10), [2.0, 0.0], **steps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)
        assert not first.continue_to(20).trusted

    calls = itertools.count()

    def breaks_off(t, y):
        if next(calls) > 2000:
            raise KeyboardInterrupt
        return fun(t, y)

    path = tmp_path / "run.npz"
    steps |= {"checkpoint": path, "checkpoint_every": 1e-9, "save_every": 10, "callback": lambda t, y, residuals: False}
    with pytest.raises(KeyboardInterrupt):
        integrate(breaks_off, (0, 20), [2.0, 0.0], **steps)
    with pytest.warns(ProjectionWarning):
        assert not integrate(fun, (0, 20), [2.0, 0.0], **steps, resume=True).trusted


def test_examinations_stay_in_the_interval_and_refuse_nothing():
    """The step over the kink is suspect, and functions raise outside the interval and where the run does not go."""
    fun, energy = kinked("contact")
    lowest = integrate(fun, (0, 3), [1.0, 0.0], method=EIPRK5, h=0.005, invariants=energy, save_every=1).y[0].min()

    def careful(t, y):
        if not (0 <= t <= 3 and y[0] > 1.5 * lowest):
            raise RuntimeError(f"called at {t}, {y}")
        return fun(t, y)

    for method in (EIPRK4, EIPRK5):
        run = integrate(careful, (0, 3), [1.0, 0.0], method=method, h=0.02, invariants=energy, check=True)
        assert (run.status, run.trusted) == (0, True), run.message
    with pytest.warns(ProjectionWarning, match="do not resolve"):
        integrate(light_planet(0.0), (0, -60), method=EIPRK4, h=0.3)


def loose_runs():
    """Return systems whose invariants change by per cents in single steps at loose tolerances."""
    top, epidemic = rigid_body(1.0, 2.0, 3.0), sir(1.0, 0.3)
    yield top, [0.0, 1.0, 1.0], 25.0
    yield top, [0.5, 0.7, 0.3], 25.0
    yield epidemic, [0.9, 0.1, 0.0], 60.0
    yield epidemic, [0.999, 0.001, 0.0], 60.0


@pytest.mark.parametrize("method", [EIPRK23, EIPRK45, EIPDOP853])
@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
@pytest.mark.parametrize("number", range(4))
def test_loose_tolerances_are_no_failure(number, rtol, method):
    """A step may miss an invariant by a few tolerances; the reference is DOP853 at 1e-11."""
    system, y0, end = list(loose_runs())[number]
    invariant = Invariant(system.values, system.gradients, name="I")
    record = Diagnostics()
    span, options = (0, end), {"rtol": rtol, "atol": 1e-4}
    run = solve_ivp(system.fun, span, y0, method=method, invariants=invariant, diagnostics=record, **options)
    plain = solve_ivp(system.fun, span, y0, method=method, **options)
    truth = solve_ivp(system.fun, span, y0, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    assert (run.status, record.trusted) == (0, True), record.message
    assert np.abs(run.y[:, -1] - truth).max() <= 3 * np.abs(plain.y[:, -1] - truth).max() + 10 * rtol


@pytest.mark.parametrize("method", [EIPRK23, EIPRK45, EIPDOP853])
def test_constraints_at_loose_tolerances_in_pieces(method):
    """The estimate of a component may vanish in a step in which only this component matters."""
    length = Invariant(lambda t, y: y[0] ** 2 + y[1] ** 2, lambda t, y: [2 * y[0], 2 * y[1], 0, 0], target=1.0)
    speed = Invariant(lambda t, y: y[0] * y[2] + y[1] * y[3], lambda t, y: [y[2], y[3], y[0], y[1]], target=0.0)

    def fun(t, y):
        tension = (y[2] ** 2 + y[3] ** 2 - 9.81 * y[1]) / (y[0] ** 2 + y[1] ** 2)
        return np.array([y[2], y[3], -tension * y[0], -9.81 - tension * y[1]])

    y = np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(40):
        run = integrate(fun, (2.3 * k, 2.3 * (k + 1)), y, method=method, invariants=[length, speed])
        y = run.y[:, -1]
        assert run.trusted, run.message
        np.testing.assert_allclose([y[:2] @ y[:2], y[:2] @ y[2:]], [1.0, 0.0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("method", [EIPRK23, EIPRK45, EIPDOP853])
@pytest.mark.parametrize("y0", [(400.0, 1.0), (1.0, 400.0)])
def test_populations_that_nearly_die_out_stay_positive(y0, method):
    """Logarithms keep a population positive that becomes as small as 1e-80; residuals stay below 1 % of the terms."""
    system = lotka_volterra()
    invariant = Invariant(system.values, system.gradients, name="V")
    record = Diagnostics()
    with np.errstate(invalid="ignore"):  # steps that make a population negative are tried again with a shorter one
        run = solve_ivp(system.fun, (0, 20), y0, method=method, invariants=invariant, diagnostics=record)
    assert (run.status, record.trusted) == (0, True), record.message
    assert run.y.min() > 0
    kept = np.array([system.values(t, y)[0] for t, y in zip(run.t, run.y.T, strict=True)])
    assert np.abs(kept - kept[0]).max() <= 1e-2 * abs(kept[0])


def test_project_tells_of_what_it_leaves():
    far = Invariant(lambda t, y: float(y @ y), lambda t, y: 2 * y, target=1.0, name="length")
    with pytest.warns(ProjectionWarning, match="left an error of .* in 'length'"):
        project([3.0, 4.0], far)
    assert abs(project([0.6, 0.81], far, iterations=3).defect[0]) < 1e-15


def test_what_a_resumed_run_says_is_what_a_whole_one_says(tmp_path):
    def stop(t, y, defects):
        if t > 5:
            raise KeyboardInterrupt

    options = {"method": EIPRK4, "h": 0.05, "invariants": ENERGY, "save_every": 10}
    with pytest.warns(ProjectionWarning):
        whole = integrate(pendulum(0.2), (0, 20), [2.0, 0.0], **options)
    with pytest.raises(KeyboardInterrupt):
        integrate(pendulum(0.2), (0, 20), [2.0, 0.0], checkpoint=tmp_path / "run.npz", callback=stop, **options)
    with pytest.warns(ProjectionWarning):
        resumed = integrate(pendulum(0.2), (0, 20), [2.0, 0.0], checkpoint=tmp_path / "run.npz", resume=True, **options)
    np.testing.assert_array_equal(resumed.y, whole.y)
    assert resumed.diagnostics.worst == whole.diagnostics.worst
    assert resumed.diagnostics.message == whole.diagnostics.message


def test_the_worst_invariants_come_first():
    """The three of five damped oscillators with the largest corrections are described, and two are counted."""
    friction = np.array([0.01, 0.02, 0.05, 0.1, 0.2])

    def damped(t, y):
        return np.concatenate([y[5:], -y[:5] - friction * y[5:]])

    def energy(k):
        return Invariant(lambda t, y: 0.5 * (y[k] ** 2 + y[k + 5] ** 2), name=f"E{k}")

    with pytest.warns(ProjectionWarning):
        run = integrate(
            damped, (0, 10), np.repeat([1.0, 0.0], 5), method=EIPRK4, h=0.05, invariants=[energy(k) for k in range(5)]
        )
    reasons = run.message.partition("not to be trusted: ")[2].split("; ")
    worst = np.argsort(-run.diagnostics.corrections)[:3]
    assert [reason[:4] for reason in reasons[:3]] == [f"'E{k}'" for k in worst]
    assert worst.tolist() != sorted(worst)
    assert reasons[3] == "2 more invariants exceed the bounds of correct runs"


@both
def test_friction_is_told_where_the_gradient_is_computed(driver):
    """At the pericentre, where the energy's terms along the flow vanish: the rate there is -c v^2 = -0.01 * 2^2."""
    energy = Invariant(lambda t, y: 0.5 * (y[2] ** 2 + y[3] ** 2) - (y[0] ** 2 + y[1] ** 2) ** -0.5)

    def damped(t, y):
        r3 = np.hypot(y[0], y[1]) ** 3
        return np.array([y[2], y[3], -y[0] / r3 - 0.01 * y[2], -y[1] / r3 - 0.01 * y[3]])

    with pytest.warns(UserWarning, match="at t=0 it changes at the rate -0.04,"), pytest.warns(ProjectionWarning):
        driver(damped, (0, 20), [0.4, 0.0, 0.0, 2.0], method=EIPRK45, rtol=1e-6, atol=1e-8, invariants=energy)
