"""Unreliable and reliable runs: reports to users through the public interface; the runs of ``eip-scipy trust``."""

import itertools
import json
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import systems
from scipy.integrate import solve_ivp

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
    ensemble,
    integrate,
    project,
)
from eip_scipy.problems import kepler, nbody
from eip_scipy_studies.cli import main
from eip_scipy_studies.output import Output
from eip_scipy_studies.trust import command
from eip_scipy_studies.trust.runs import carry_out
from eip_scipy_studies.trust.systems import case, compiled_pendulum, mechanics, two_oscillators
from eip_scipy_studies.trust.table import all_runs

RUNS = all_runs()
EVERY_CLASS = [EIPRK1, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPDOP853, EIPRKN8, EIPRKN12]
SQUARE = Invariant(lambda t, y: 0.5 * float(y @ y), lambda t, y: y, name="square")
REST = (2.0, 0.0)
PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "trust.md"


def by_solve_ivp(problem, **options):
    record = Diagnostics()
    options = {"invariants": problem.invariants, "diagnostics": record} | options
    return solve_ivp(problem.fun, problem.t_span, problem.y0, **options), record


def by_integrate(problem, **options):
    run = integrate(problem, **options)
    assert run.trusted == (run.diagnostics.trusted and run.success)
    assert run.diagnostics.message in run.message
    return run, run.diagnostics


both = pytest.mark.parametrize("driver", [by_solve_ivp, by_integrate], ids=["solve_ivp", "integrate"])


def pendulum(friction=0.0, push="friction", end=20.0, start=REST):
    return mechanics("pendulum", start, end, push=push, strength=friction)


def spring(end, factor=1.0, invariants=SQUARE):
    """Return a spring, or one that is stiffer than its energy says."""
    problem = mechanics("spring", (1.0, 0.3), end)
    return replace(problem, fun=lambda t, y: np.array([y[1], -factor * y[0]]), invariants=(invariants,))


# --- the runs of the study ---


def test_382_faulty_and_679_correct_runs():
    assert sum(bool(run.faulty) for run in RUNS) == 382
    assert len(RUNS) == 382 + 679


@pytest.mark.parametrize("run", [run for run in RUNS if run.way != "ensemble"][3::29], ids=lambda run: run.name)
def test_some_of_the_runs(run):
    outcome = carry_out(run)
    assert bool(outcome.told) == bool(run.faulty), outcome.message


def test_the_command_counts_and_its_checks_can_fail(tmp_path, monkeypatch, capsys):
    """The last state of a faulty run is known, and a correct one is compared with one without projection."""
    assert main(["trust", "--only", "fall with drag 0.1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "faulty runs are reported: 3 of 3" in out
    assert re.search(r"\| no invariant, its rate 0 at the start +\| 2 ", (tmp_path / "trust.md").read_text())
    right = next(run for run in RUNS if run.group == "further systems")
    found = command.record(replace(right, faulty=True))
    assert found["first"] == command.SILENT
    assert found["error"] < 0.1
    monkeypatch.setattr(command, "carried_out", lambda numbers: [found])
    monkeypatch.setattr(command, "processes", lambda count: SameProcess())
    output = Output(tmp_path)
    command.trust(output, only=right.name)
    assert [check["passed"] for check in output.numbers["checks"]] == [False, True]


class SameProcess:
    """Pool of no processes."""

    def __enter__(self):
        return self

    def __exit__(self, *about):
        return None

    def submit(self, function, part):
        return type("Future", (), {"result": lambda self: function(part)})()


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_the_page_shows_what_the_command_finds(tmp_path):
    file = tmp_path / "run.json"
    assert main(["trust", "--out", str(tmp_path), "--json", str(file), "--quiet"]) == 0
    rows, page = json.loads(file.read_text())["found"], PAGE.read_text(encoding="utf-8")
    faulty, correct = ([row for row in rows if row["faulty"] == kind] for kind in (True, False))
    reported, prose = sum(bool(row["told"]) for row in faulty), page.replace("\n", " ")
    assert f"makes {len(faulty)} runs that are faulty on purpose and {len(correct)} correct ones" in prose
    assert f"{reported} of the faulty runs are reported" in prose
    late = [row for row in faulty if row["group"] == command.LATE and row["error"] > 10 * row["plain_error"]]
    assert (len(late), all(row["told"] for row in late)) == (120, True)
    assert not any(row["told"] or row["spoilt"] for row in correct)
    shown = [line.split("|")[1:3] for line in page.splitlines() if line.startswith("|")]
    counts = {group.strip(): count.strip() for group, count, *_ in shown}
    for own in (faulty, correct):
        assert all(counts[group] == str(len(some)) for group, some in command.groups(own).items() if group != "all")


# --- what users are told ---


@both
@pytest.mark.parametrize("method", [EIPRK23, EIPRK45, EIPDOP853, EIPRKN8])
def test_an_invariant_whose_rate_is_zero_at_the_start(driver, method):
    """Released from rest, a pendulum with friction, or one that is driven, does not lose energy yet."""
    problem = pendulum(0.3, "sine") if method is EIPRKN8 else pendulum(0.2)
    told = r"(?s)'energy'.*not an invariant of this system.*docs/explanation/trust.md"
    with pytest.warns(ProjectionWarning, match=told) as caught:
        run, record = driver(problem, method=method, rtol=1e-8)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert run.success == (method in (EIPRK23, EIPRK45))  # the others crawl
    assert run.success or "times shorter than the equations need, and it was ended" in run.message
    assert not record.trusted
    name, t, size = record.worst
    assert name == "energy"
    assert 0 < t <= 20
    assert size > 50
    assert record.message in repr(record)


@both
@pytest.mark.parametrize("method", EVERY_CLASS)
@pytest.mark.parametrize("metric", ["error", "euclidean"])
def test_every_class_tells_and_trusts(driver, method, metric):
    options = {"method": method, "h": 0.02, "metric": metric}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run, record = driver(spring(10.0, 2.0), **options)
    assert run.success
    assert not record.trusted
    # Local errors of orders 1 and 2 are nearly as large as the changes of the quantity; the check at the start sees it.
    low = method in (EIPRK1, EIPRK2)
    assert [w.category for w in caught] == ([UserWarning] if low else [UserWarning, ProjectionWarning])
    run, record = driver(spring(10.0), **options)
    assert run.success
    assert (record.trusted, record.message) == (True, "")
    assert record.worst[2] < 50


@both
def test_a_step_that_is_far_too_long(driver):
    """The projection leaves more than the energy itself: the run fails, and keeps its states."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)  # solve_ivp warns at the first step, before the run fails
        run, record = driver(spring(60.0), method=EIPRK4, h=3.0)
    assert run.status == -1
    assert "projection failed" in run.message
    assert "'square'" in run.message
    assert not record.trusted
    assert run.t.size > 1
    with pytest.warns(ProjectionWarning) as caught:
        run, record = driver(spring(60.0), method=EIPRK4, h=2.0)
    assert run.success
    assert not record.trusted
    assert len(caught) == 1
    run = integrate(spring(60.0), method=EIPRK4, h=3.0, check=False)
    assert run.success
    assert run.max_residual[0] > 1e3
    assert (run.diagnostics.worst, run.diagnostics.message) == (None, "")


@both
@pytest.mark.parametrize("rtol", [1e-1, 1.0])
def test_loose_tolerances_leave_small_residuals_or_tell(driver, rtol):
    """Adaptive steps are shortened until the projection leaves less than a hundredth of the terms."""
    options = {"save_every": 1} if driver is by_integrate else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)
        run, record = driver(pendulum(end=50.0), method=EIPRK45, rtol=rtol, atol=rtol, **options)
    assert run.success
    q, v = run.y
    # The step measures the terms at its raw results, which at such tolerances differ from the states by some per cent.
    assert record.max_residual[0] <= 1.05e-2 * np.max(np.abs(np.sin(q) * q) + v**2)


def test_as_an_error_it_carries_the_run():
    with warnings.catch_warnings():
        warnings.simplefilter("error", ProjectionWarning)
        with pytest.raises(ProjectionWarning, match="energy") as caught:
            integrate(pendulum(0.2), method=EIPRK45, rtol=1e-8)
    run = caught.value.partial
    assert (run.status, run.t[-1], run.trusted) == (0, 20, False)


def test_the_worst_invariants_come_first():
    """The three of five damped oscillators with the largest corrections are described, and two are counted."""
    friction = np.array([0.01, 0.02, 0.05, 0.1, 0.2])

    def energy(k):
        return Invariant(lambda t, y: 0.5 * (y[k] ** 2 + y[k + 5] ** 2), name=f"E{k}")

    def fun(t, y):
        return np.concatenate([y[5:], -y[:5] - friction * y[5:]])

    options = {"method": EIPRK4, "h": 0.05, "invariants": [energy(k) for k in range(5)]}
    with pytest.warns(ProjectionWarning):
        run = integrate(fun, (0, 10), np.repeat([1.0, 0.0], 5), **options)
    reasons = run.message.partition("not to be trusted: ")[2].split("; ")
    worst = np.argsort(-run.diagnostics.corrections)[:3]
    assert [reason[:4] for reason in reasons[:3]] == [f"'E{k}'" for k in worst]
    assert worst.tolist() != sorted(worst)
    assert reasons[3] == "2 more invariants exceed the bounds of correct runs"


@both
def test_friction_where_the_gradient_is_computed(driver):
    """At the pericentre, where the energy's terms along the flow vanish: the rate there is -c v^2 = -0.01 * 2^2."""
    problem = mechanics("kepler", (0.4, 0.0, 0.0, 2.0), strength=0.01)
    energy = Invariant(lambda t, y: 0.5 * (y[2] ** 2 + y[3] ** 2) - (y[0] ** 2 + y[1] ** 2) ** -0.5)
    problem = replace(problem, invariants=(energy,))
    with pytest.warns(UserWarning, match="at t=0 it changes at the rate -0.04,"), pytest.warns(ProjectionWarning):
        driver(problem, method=EIPRK45, rtol=1e-6, atol=1e-8)


def test_project_tells_of_what_it_leaves():
    far = Invariant(lambda t, y: float(y @ y), lambda t, y: 2 * y, target=1.0, name="length")
    with pytest.warns(ProjectionWarning, match="left an error of .* in 'length'"):
        project([3.0, 4.0], far)
    assert abs(project([0.6, 0.81], far, iterations=3).residual[0]) < 1e-15


# --- leaks and kinks that the study does not have ---

LATER = "'energy' is not an invariant of this system: at t=-?[0-9]"


@pytest.mark.parametrize(
    "options", [{"every": 10}, {"every": "auto"}, {"compensated": True}, {"direction": "midpoint"}]
)
@pytest.mark.parametrize("steps", [{"method": EIPRK5, "h": 0.02}, {"method": EIPRK45, "rtol": 1e-8}])
@pytest.mark.parametrize("computed", [False, True])
def test_a_leak_that_starts_late(computed, steps, options):
    problem = pendulum(1e-3, "friction_after_5")
    if computed:
        problem = replace(problem, invariants=(Invariant(problem.invariants[0].fun, name="energy"),))
    with pytest.warns(ProjectionWarning, match=LATER):
        run = integrate(problem, **steps, **options)
    assert (run.status, run.trusted) == (0, False)


def test_a_leak_backwards_in_time():
    late = pendulum(1e-3, "friction_after_5")
    back = replace(late, fun=lambda t, y: late.fun(-t, y), t_span=(0.0, -20.0))
    with pytest.warns(ProjectionWarning, match=LATER):
        integrate(back, method=EIPRK4, h=0.02)


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


@pytest.mark.parametrize(("kind", "size"), [("huber", 0.3), ("contact", 100.0), ("backlash", 0.5), ("walls", 120.0)])
@pytest.mark.parametrize(
    ("given", "steps"),
    [
        (True, {"method": EIPRK4, "h": 0.02}),
        (True, {"method": EIPRK4, "h": 0.01, "every": 4}),
        (True, {"method": EIPDOP853, "h": 0.01, "every": "auto"}),
        (False, {"method": EIPRK5, "h": 0.02}),
        (False, {"method": EIPRK45, "rtol": 1e-6}),
    ],
)
@pytest.mark.filterwarnings("ignore:invariant 'energy' has no grad and allows no complex step")
@pytest.mark.filterwarnings("ignore:overflow encountered in scalar power")  # long trial steps in free flight
def test_kinks_are_no_leaks(given, steps, kind, size):
    """Estimates of steps over a kink are too small, so that corrections are many times larger; the energy holds."""
    for start in ([1.0, 0.1], [0.029, -2.3], [0.453, 0.663]):
        problem = mechanics(kind, start, size=size)
        if not given:
            problem = replace(problem, invariants=(Invariant(problem.invariants[0].fun, name="energy"),))
        run = integrate(problem, **steps)
        assert run.trusted, run.message


def test_close_to_a_pericentre_a_right_gradient_is_right():
    for e in (0.9, 1 - 1e-3, 1 - 1e-6, 1 - 1e-9):
        steps = {"method": EIPDOP853, "h": None, "first_step": 1e-12, "rtol": 1e-10, "compiled": False}
        assert integrate(kepler(e, relativistic=0), (0, 2e-3 * math.pi), **steps).trusted


# --- parts that the steps do not resolve ---


def with_planet(mass, start, speed):
    """Return a star, a giant planet at 5.2, and a planet."""
    q, v = [[0, 0, 0], [5.2, 0, 0], [start, 0, 0]], [[0, 0, 0], [0, 5.2**-0.5, 0], [0, speed, 0]]
    return nbody([1.0, 1e-3, mass], q, v, t_span=(0.0, 60.0))


@pytest.mark.parametrize("mass", [1e-9, 0.0])
@pytest.mark.parametrize("method", [EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK45, EIPDOP853, EIPRKN8])
def test_a_step_beyond_the_period_of_a_light_planet(method, mass):
    """The energy of the system does not show that the planet leaves its orbit. Short steps resolve its motion."""
    problem = with_planet(mass, 0.2, 0.2**-0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)
        run = integrate(problem, method=method, h=0.27)
    unresolved = re.search(r"h=0.27 do not resolve the motion of components (6, 7, 8|15, 16, 17) ", run.message)
    assert not run.trusted
    assert unresolved or "projection failed" in run.message
    run = integrate(problem, (0, 10), method=method, h={EIPRK2: 0.005, EIPRK3: 0.01}.get(method, 0.02))
    assert run.trusted, run.message
    assert np.linalg.norm(run.y[6:9, -1] - run.y[:3, -1]) == pytest.approx(0.2, rel=0.02)


@pytest.mark.parametrize("method", [EIPRK3, EIPRK4, EIPRK5, EIPDOP853, EIPRKN8, EIPRKN12])
def test_a_body_that_one_step_throws_out_is_lost(method):
    """A test particle with e = 0.2 whose period is 0.22: after its first step it moves freely, which steps resolve."""
    a, e = 0.108, 0.2
    problem = with_planet(0.0, a * (1 + e), np.sqrt((1 - e) / (1 + e) / a))
    with pytest.warns(ProjectionWarning, match="h=0.344 do not resolve the motion of components "):
        run = integrate(problem, method=method, h=0.344)
    assert np.linalg.norm(run.y[6:9, -1] - run.y[:3, -1]) > 100 * a


def test_a_part_that_the_energy_does_not_know():
    with pytest.warns(ProjectionWarning, match="do not resolve the motion of component [23] "):
        integrate(two_oscillators(), (0, 2), method=EIPRK4, h=0.2)
    assert integrate(two_oscillators(), (0, 2), method=EIPRK4, h=0.01).trusted


def test_examinations_stay_in_the_interval_and_refuse_nothing():
    """The step over the kink is suspect, and functions raise outside the interval and where the run does not go."""
    problem = mechanics("contact", (1.0, 0.0), 3.0, 100.0)
    lowest = integrate(problem, method=EIPRK5, h=0.005, save_every=1).y[0].min()

    def careful(t, y):
        if not (0 <= t <= 3 and y[0] > 1.5 * lowest):
            raise RuntimeError(f"called at {t}, {y}")
        return problem.fun(t, y)

    for method in (EIPRK4, EIPRK5):
        run = integrate(replace(problem, fun=careful), method=method, h=0.02, check=True)
        assert (run.status, run.trusted) == (0, True), run.message
    with pytest.warns(ProjectionWarning, match="do not resolve"):
        integrate(with_planet(0.0, 0.2, 0.2**-0.5), (0, -60), method=EIPRK4, h=0.3)


# --- members, checkpoints, loose tolerances ---


@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize("method", [EIPRK2, EIPRK4, EIPRK5])
@pytest.mark.parametrize("together", [False, True], ids=["one by one", "in vectors"])
def test_each_member_is_judged_by_its_own_checks(method, together, request):
    """Members 1 to 7 have friction of 1e-4 to 0.1; the others, some of them in a vector with these, have none."""
    if together:
        request.getfixturevalue("in_vectors")
    friction = np.zeros((17, 1))
    friction[1:8, 0] = np.geomspace(1e-4, 0.1, 7)
    problem = compiled_pendulum(end=10.0, members=True)
    with pytest.warns(ProjectionWarning, match="7 of 17 members .* the first of them member 1"):
        run = ensemble(problem, params=friction, method=method, h=0.02, executor=1)
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
    problem = compiled_pendulum(end=1.0, members=True)
    with (
        pytest.warns(UserWarning, match="'energy' is not an invariant"),
        pytest.warns(ProjectionWarning, match=f"{2 if differing else 4} of 4 members .* the first of them member 0"),
    ):
        run = ensemble(problem, y0s=starts, params=friction, method=EIPRK4, h=0.05, compiled=False)
    assert run.success
    assert run.trusted.tolist() == [False, False, differing, differing]
    assert ["'energy' is not an invariant" in text for text in run.message] == (~run.trusted).tolist()


def test_what_was_found_before_a_checkpoint_is_known_after_it(tmp_path):
    """The friction acts from t = 5 to 7 only: the second part sees nothing of it, and says what a whole run says."""
    problem, calls = pendulum(), itertools.count()

    def fun(t, y):
        return problem.fun(t, y) - np.array([0, 1e-3 * y[1] * (5 < t < 7)])

    def breaks_off(t, y):
        if next(calls) > 2000:
            raise KeyboardInterrupt
        return fun(t, y)

    steps = {"method": EIPRK4, "h": 0.02, "invariants": problem.invariants}
    with pytest.warns(ProjectionWarning):
        first = integrate(fun, (0, 10), REST, **steps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)
        longer = first.continue_to(20)
    assert (longer.trusted, "not to be trusted: " in longer.message) == (False, True)
    steps |= {"save_every": 10, "callback": lambda t, y, residuals: False}
    kept = {"checkpoint": tmp_path / "run.npz", "checkpoint_every": 1e-9}
    with pytest.warns(ProjectionWarning):
        whole = integrate(fun, (0, 20), REST, **steps)
    with pytest.raises(KeyboardInterrupt):
        integrate(breaks_off, (0, 20), REST, **steps, **kept)
    with pytest.warns(ProjectionWarning):
        resumed = integrate(fun, (0, 20), REST, **steps, **kept, resume=True)
    np.testing.assert_array_equal(resumed.y, whole.y)
    assert resumed.diagnostics.worst == whole.diagnostics.worst
    assert resumed.diagnostics.message == whole.diagnostics.message


@pytest.mark.parametrize("method", [EIPRK23, EIPRK45, EIPDOP853])
@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
@pytest.mark.parametrize(
    ("name", "params", "start", "end"),
    [
        ("rigid_body", (1.0, 2.0, 3.0), (0.0, 1.0, 1.0), 25.0),
        ("rigid_body", (1.0, 2.0, 3.0), (0.5, 0.7, 0.3), 25.0),
        ("sir", (1.0, 0.3), (0.9, 0.1, 0.0), 60.0),
        ("sir", (1.0, 0.3), (0.999, 0.001, 0.0), 60.0),
    ],
)
def test_loose_tolerances_are_no_failure(name, params, start, end, rtol, method):
    """A step may miss an invariant by a few tolerances; the reference is DOP853 at 1e-11."""
    problem = case(name, params, start, end)
    run, record = by_solve_ivp(problem, method=method, rtol=rtol, atol=1e-4)
    plain, _ = by_solve_ivp(problem, method=method, rtol=rtol, atol=1e-4, invariants=())
    truth = solve_ivp(problem.fun, problem.t_span, problem.y0, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
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
    problem = case("lotka_volterra", (), y0, 20.0)
    with np.errstate(invalid="ignore"):  # steps that make a population negative are tried again with a shorter one
        run, record = by_solve_ivp(problem, method=method)
    assert (run.status, record.trusted) == (0, True), record.message
    assert run.y.min() > 0
    kept = np.array([problem.invariants[0].fun(t, y)[0] for t, y in zip(run.t, run.y.T, strict=True)])
    assert np.abs(kept - kept[0]).max() <= 1e-2 * abs(kept[0])


@pytest.mark.filterwarnings("ignore:'norm' is not an invariant", "ignore:.*not to be trusted")
@pytest.mark.parametrize("driver", ["scipy", "integrate", "ensemble"])
def test_a_wrong_invariant_does_not_make_a_run_crawl(driver):
    """The norm of a state that decays: without it the run takes 1226 evaluations."""
    A, loss = np.diag([1.0, 2.0, 3.0]) + 0.3, np.array([0.0, 0.02, 0.05])
    fun, y0 = lambda t, y: -1j * (A @ y) - loss * y, np.ones(3, complex) / 3**0.5
    norm = Invariant(lambda t, y: np.vdot(y, y).real, lambda t, y: 2 * y, name="norm")
    options = {"method": EIPDOP853, "rtol": 1e-8, "atol": 1e-8, "invariants": norm}
    if driver == "ensemble":
        run = ensemble(fun, (0, 20), [y0], **options)
        status, message, nfev = run.status[0], run.message[0], run.nfev[0]
    else:
        run = (solve_ivp if driver == "scipy" else integrate)(fun, (0, 20), y0, **options)
        status, message, nfev = run.status, run.message, run.nfev
    assert status < 0
    assert "times shorter than the equations need, and it was ended" in message
    assert nfev < 2000


def test_a_bound_on_the_number_of_steps(tmp_path):
    options = {"method": EIPDOP853, "rtol": 1e-9, "checkpoint": tmp_path / "run.npz"}
    fun, y0 = lambda t, y: np.array([y[1], -y[0]]), [1.0, 0.0]
    whole = integrate(fun, (0, 20), y0, method=EIPDOP853, rtol=1e-9)
    run = integrate(fun, (0, 20), y0, max_steps=7, **options)
    assert (run.status, run.success) == (-1, False)
    assert run.message.startswith(f"max_steps=7 steps were made, up to t={run.t[-1]:.10g}")
    longer = run.continue_to(20).continue_to(20, max_steps=None)
    assert (run.trusted, longer.trusted) == (False, True)
    assert longer.message.startswith("reached the end of the interval (")
    resumed = integrate(fun, (0, 20), y0, max_steps=1000, resume=True, **options)
    np.testing.assert_array_equal(resumed.y[:, -1], whole.y[:, -1])
    assert "resumed at step 7" in resumed.message
    assert integrate(fun, (0, 1.1), y0, method=EIPRK4, h=0.1, max_steps=11).status == 0
    with pytest.raises(ValueError, match="max_steps must be an integer >= 1"):
        integrate(fun, (0, 20), y0, method=EIPDOP853, max_steps=0)


def test_a_late_and_tiny_loss_is_seen_also_by_a_compiled_gradient():
    """Drag of 1e-8 from t = 20 on: the gradient by dual numbers is as exact as one that is given."""
    njit = pytest.importorskip("numba").njit

    @njit
    def fun(t, y):
        r3, drag = (y[0] ** 2 + y[1] ** 2) ** 1.5, 1e-8 if t > 20 else 0.0
        return np.array([y[2], y[3], -y[0] / r3 - drag * y[2], -y[1] / r3 - drag * y[3]])

    energy = njit(lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2))
    with pytest.warns(ProjectionWarning, match="not an invariant of this system"):
        run = integrate(fun, (0, 60), [0.4, 0.0, 0.0, 2.0], method=EIPRK4, h=0.005, invariants=energy)
    assert not run.trusted
