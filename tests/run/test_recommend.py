"""`recommend`: the recommended run has the wanted error, and reasons against it are reported."""

import itertools
import math
import pickle
import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import pendulum, pendulum_energy, pendulum_gradient, refuse

from eip_scipy import EIPGJ14, Invariant, ProjectionWarning, integrate, recommend
from eip_scipy.problems import kepler, satellite, solar_system
from eip_scipy_studies.hard_cases import hard_cases

FACTOR = 10.0


def error(y, exact):
    """Return the error as `recommend` defines it."""
    return np.abs(y - exact).max() / np.abs(exact).max()


def assert_near(found, wanted):
    assert wanted / FACTOR <= found <= wanted * FACTOR, f"{found:.1e} where {wanted:.0e} was wanted"


def damped(t, y):
    return np.array([y[1], -math.sin(y[0]) - 0.2 * y[1]])


ENERGY = Invariant(pendulum_energy, pendulum_gradient, name="E")
WRONG = Invariant(pendulum_energy, lambda t, y: np.array([np.sin(y[0]), 2 * y[1]]), name="E")


@pytest.mark.parametrize("wanted", [1e-4, 1e-9])
def test_kepler_by_its_closed_form(wanted):
    problem = kepler(0.6, relativistic=0)
    choice = recommend(problem, (0, 50), error=wanted)
    run = choice.run()
    assert_near(error(run.y[:, -1], problem.reference(50)), wanted)
    assert choice.trusted
    assert run.trusted
    assert choice.error <= wanted
    assert run.nfev == choice.nfev
    assert choice.method.__name__.startswith("EIPRKN")  # q'' = a(q)
    same = integrate(choice.problem, **choice.options)
    assert np.array_equal(same.y, run.y)


def test_it_finds_the_multistep_method_for_planets():
    problem = solar_system()
    choice = recommend(problem, (0, 10), error=1e-8)
    assert choice.method is EIPGJ14
    assert error(choice.run().y[:, -1], problem.reference(10)) < 1e-8


def test_a_long_run_is_tried_on_a_part():
    problem, wanted = kepler(0.3, relativistic=0), 1e-6
    choice = recommend(problem, (0, 3000), error=wanted, max_nfev=10_000)
    assert choice.share < 0.2
    assert "extrapolated" in repr(choice)
    assert choice.error <= wanted
    run = choice.run()
    assert_near(error(run.y[:, -1], problem.reference(3000)), choice.error)
    assert run.nfev == pytest.approx(choice.nfev, rel=0.1)
    assert max(trial.nfev * choice.share for trial in choice.trials) < 100_000


def test_what_is_no_invariant_is_left_out_and_told():
    exact = solve_ivp(damped, (0, 20), [2.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    with pytest.warns(ProjectionWarning, match="invariants are left out.*'E'"):
        choice = recommend(damped, (0, 20), [2.0, 0.0], invariants=ENERGY)
    assert choice.options["invariants"] == ()
    assert not choice.trusted
    assert "'E'" in choice.message
    assert choice.message in repr(choice)
    assert_near(error(choice.run().y[:, -1], exact), 1e-6)
    assert not any(trial.good for trial in choice.trials if "invariants" not in trial.options)


def test_errors_that_cannot_be_reached():
    with pytest.raises(ValueError, match=r"error of 1e-15 cannot be reached.*Pass error=\de-1[34] or more"):
        recommend(kepler(0.6, relativistic=0), (0, 50), error=1e-15)

    def lorenz(t, y):
        return np.array([10 * (y[1] - y[0]), y[0] * (28 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]])

    with pytest.raises(ValueError, match=r"chaotic\. Shorten the interval"):
        recommend(lorenz, (0, 60), [1.0, 1.0, 1.0])


ROBERTSON = np.array([[-0.04, 1e4, 0], [0.04, -1e4, -3e7], [0, 0, 3e7]])
RATES = 10.0 ** np.random.default_rng(4).uniform(-2, 5, (2, 39))  # of a chain of reactions
STIFF = {
    "relaxation": (lambda t, y: np.array([-2000 * (y[0] - math.cos(t))]), 2, [1.0], ()),
    "van der Pol": (lambda t, y: np.array([y[1], 1000 * (1 - y[0] ** 2) * y[1] - y[0]]), 500, [2.0, 0.0], ()),
    "Robertson": (lambda t, y: ROBERTSON @ [y[0], y[1] * y[2], y[1] ** 2], 4e5, [1.0, 0.0, 0.0], lambda t, y: y.sum()),
    "40 species": (lambda t, y: -np.diff(np.pad(RATES[0] * y[:-1] - RATES[1] * y[1:] ** 2, 1)), 1e3, np.eye(40)[0], ()),
}


@pytest.mark.parametrize("name", STIFF)
def test_stiff_equations_get_an_implicit_method(name):
    """The method is run over the whole interval, and all of its evaluations are counted."""
    fun, end, y0, kept = STIFF[name]
    calls = itertools.count()
    choice = recommend(lambda t, y: fun(t, y) if next(calls) < 2e5 else None, (0, end), y0, invariants=kept, error=1e-4)
    assert choice.stiff
    assert choice.share == 1
    assert "The equations are stiff: stability limits the steps" in choice.reason
    before = next(calls)
    run = choice.run()
    assert next(calls) - before - 1 == choice.nfev < 2000
    exact = solve_ivp(fun, (0, end), y0, method="Radau", rtol=1e-10, atol=1e-14).y[:, -1]
    assert error(run.y[:, -1], exact) <= 1.02 * choice.error <= 1.02e-4


SYSTEMS = ("kepler_e00", "kepler_e03", "oscillator", "euler_top_tennis", "lotka_volterra", "sir", "heisenberg",
           "three_wave", "brockett")  # fmt: skip


@pytest.mark.parametrize("name", SYSTEMS)
def test_stated_evaluations_are_those_of_the_run(name):
    (case,) = hard_cases([name])
    choice = recommend(case.problem, error=1e-5, max_nfev=20_000)  # some are tried on a part of the interval
    assert not choice.stiff
    assert choice.nfev == pytest.approx(choice.run().nfev, rel=0.0 if choice.share == 1 else 0.5)


def sir(t, y):
    return np.array([-2 * y[0] * y[1], 2 * y[0] * y[1] - y[1], y[1]])


MISSING = {  # momenta are found by the energy; without invariants to keep there is no projection to change linear ones
    "SIR": (sir, [0.9, 0.1, 0.0], lambda t, y: y[2] + np.log(y[0]) / 2, ["y0 + y1 + y2"]),
    "SIR alone": (sir, [0.9, 0.1, 0.0], (), ["y0 + y1 + y2"]),
    "pendulum": (pendulum, [1.0, 0.5], ENERGY, []),
}


@pytest.mark.parametrize("name", MISSING)
def test_invariants_that_are_missing(name):
    fun, y0, given, names = MISSING[name]
    choice = recommend(fun, (0, 10), y0, invariants=given)
    assert [item.name for item in choice.missing] == names
    run = choice.run(save_every=1)
    for item in choice.missing:
        values = np.array([item.fun(t, y) for t, y in zip(run.t, run.y.T, strict=True)])
        assert np.abs(values - values[0]).max() < 1e-12
        assert ("kept too" in choice.reason) is (given != ())


def test_a_projection_that_does_not_pay():
    """The invariant takes much longer to evaluate than the right-hand side."""
    slow = Invariant(lambda t, y: (time.sleep(1e-4), pendulum_energy(t, y))[1], pendulum_gradient, name="E")
    choice = recommend(pendulum, (0, 5), [1.0, 0.5], invariants=slow)
    assert 0 < choice.pays < 0.5
    assert "The projection does not pay" in choice.reason


def test_what_is_printed():
    choice = recommend(pendulum, (0, 20), [1.0, 0.5], invariants=ENERGY, error=1e-6)
    again = pickle.loads(pickle.dumps(choice))
    assert repr(again) == repr(choice)
    assert choice.run(t_eval=[5.0, 10.0]).t.tolist() == again.run(t_eval=[5.0, 10.0]).t.tolist() == [5.0, 10.0]
    lines = repr(choice).splitlines()
    assert lines[0] == "pendulum: error 1e-06 at the end of t from 0 to 20"
    assert lines[1].startswith(f"  run(): integrate(problem, method={choice.method.__name__}, ")
    assert f"{choice.nfev} evaluations" in lines[2]
    assert sum(line.startswith("  -> ") for line in lines) == 1
    assert any("invariants=()" in line for line in lines)  # what the projection does is shown
    assert lines[-1].strip() == choice.reason
    assert "Without the projection the error is" in choice.reason


def test_arguments():
    rows = [
        ({"error": 0}, ValueError, "error must be a number between 0 and 1, got 0"),
        ({"error": math.nan}, ValueError, "error must be"),
        ({"max_nfev": 10}, ValueError, "max_nfev must be at least 1000, got 10"),
        ({"rtol": 1e-3}, TypeError, "no option 'rtol'"),
        ({"metrik": "euclidean"}, TypeError, "did you mean 'metric'"),
        ({"t_span": (0, math.inf)}, ValueError, "finite length"),
        ({"t_span": (1, 1)}, ValueError, "finite length"),
        ({"t_span": None}, TypeError, "t_span is missing"),
        ({"y0": None}, TypeError, "y0 is missing"),
        ({"fun": 3}, TypeError, "callable or a Problem, got 3"),
        ({"fun": lambda t, y: y * math.nan}, ValueError, r"trial by EIPDOP853.*non-finite value at t=0"),
        ({"fun": lambda t, y: {}["broken"]}, KeyError, "broken"),
        ({"invariants": WRONG}, ValueError, "gradient of invariant 'E' is wrong"),
        ({"t_eval": [0.5, 6.0]}, ValueError, "not within `t_span`"),
    ]
    given = {"fun": pendulum, "t_span": (0, 1), "y0": [1.0, 0.5]}
    refuse(recommend, [(given | options, *rest) for options, *rest in rows])


def test_states_between_steps_count():
    """The expected evaluations are those of the run that saves states at the wanted times."""
    times = np.linspace(0, 50, 501)
    choice = recommend(kepler(0.3, relativistic=0), (0, 50), error=1e-6, t_eval=times)
    run = choice.run()
    np.testing.assert_array_equal(run.t, times)
    assert run.nfev == choice.nfev > recommend(kepler(0.3, relativistic=0), (0, 50), error=1e-6).nfev


def test_the_metric_of_balances_of_components_is_their_own():
    problem = satellite([7000.0, 0, 0], [0, 7.5, 1.0], mu=398600.4418, radius=6378.137, j2=1.08e-3, t_span=(0, 20_000))
    choice = recommend(problem, error=1e-6)
    assert all("metric" not in trial.options for trial in choice.trials)
