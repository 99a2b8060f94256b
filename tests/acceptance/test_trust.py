"""Unreliable and reliable runs: reports to users through the public interface; the runs of ``eip-scipy trust``."""

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
)
from eip_scipy.problems import kepler, nbody
from eip_scipy_studies.cli import main
from eip_scipy_studies.trust import command
from eip_scipy_studies.trust.runs import carry_out
from eip_scipy_studies.trust.systems import case, compiled_pendulum, mechanics, two_oscillators
from eip_scipy_studies.trust.table import all_runs

RUNS = all_runs()
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


@pytest.mark.parametrize("run", [run for run in RUNS if run.way != "ensemble"][3::19], ids=lambda run: run.name)
def test_some_of_the_runs(run):
    outcome = carry_out(run)
    assert bool(outcome.told) == bool(run.faulty), outcome.message


def test_the_command_counts(tmp_path, capsys):
    assert main(["trust", "--only", "fall with drag 0.1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "faulty runs are reported: 3 of 3" in out
    assert re.search(r"\| no invariant, its rate 0 at the start +\| 2 ", (tmp_path / "trust.md").read_text())


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


@pytest.mark.parametrize(("kind", "size"), [("contact", 100.0), ("backlash", 0.5), ("walls", 120.0)])
@pytest.mark.filterwarnings("ignore:overflow encountered in scalar power")  # long trial steps in free flight
def test_kinks_are_no_leaks(kind, size):
    """Estimates of steps over a kink are too small, so that corrections are many times larger; the energy holds."""
    for start in ([1.0, 0.1], [0.029, -2.3], [0.453, 0.663]):
        for steps in ({"method": EIPRK4, "h": 0.02}, {"method": EIPDOP853, "h": 0.01, "every": "auto"}):
            run = integrate(mechanics(kind, start, size=size), **steps)
            assert run.trusted, run.message


@pytest.mark.parametrize("options", [{"method": EIPRK4, "h": 0.01}, {"method": EIPDOP853, "rtol": 1e-9, "atol": 1e-9}])
@pytest.mark.parametrize("driver", [integrate, ensemble])
def test_an_energy_that_jumps_where_a_potential_is_cut_off(driver, options):
    """Its rate is 0 on both sides, and the projection moves the jump into the motion."""
    jumps = Invariant(lambda t, y: 0.5 * float(y @ y) + 1e-4 * (y[0] > 1), lambda t, y: y, name="E")
    start = REST if driver is integrate else [REST]
    with pytest.warns(ProjectionWarning, match="'E' jumps by 0.0001 at t=" if driver is integrate else "E"):
        run = driver(systems.oscillator, (0, 20), start, invariants=jumps, **options)
    assert not np.any(run.trusted)


def test_close_to_a_pericentre_a_right_gradient_is_right():
    for e in (0.9, 1 - 1e-3, 1 - 1e-6, 1 - 1e-9):
        steps = {"method": EIPDOP853, "h": None, "first_step": 1e-12, "rtol": 1e-10, "compiled": False}
        assert integrate(kepler(e, relativistic=0), (0, 2e-3 * math.pi), **steps).trusted


# --- parts that the steps do not resolve ---


def with_planet(mass, start, speed):
    """Return a star, a giant planet at 5.2, and a planet."""
    q, v = [[0, 0, 0], [5.2, 0, 0], [start, 0, 0]], [[0, 0, 0], [0, 5.2**-0.5, 0], [0, speed, 0]]
    return nbody([1.0, 1e-3, mass], q, v, t_span=(0.0, 60.0))


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


@pytest.mark.usefixtures("snapshots")
def test_what_was_found_before_a_checkpoint_is_known_after_it(tmp_path):
    """The friction acts from t = 5 to 7 only: the second part sees nothing of it, and says what a whole run says."""
    problem = pendulum()

    def fun(t, y):
        return problem.fun(t, y) - np.array([0, 1e-3 * y[1] * (5 < t < 7)])

    def breaks_off(t, y, residuals):
        if t > 10:
            raise KeyboardInterrupt

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
        integrate(fun, (0, 20), REST, **steps | kept | {"callback": breaks_off})
    with pytest.warns(ProjectionWarning):
        resumed = integrate(fun, (0, 20), REST, **steps, **kept, resume=True)
    assert "resumed at step" in resumed.message
    np.testing.assert_array_equal(resumed.y, whole.y)
    assert resumed.diagnostics.worst == whole.diagnostics.worst
    assert resumed.diagnostics.message == whole.diagnostics.message


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
    options["events"] = lambda t, y: y[0].real - 5
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
