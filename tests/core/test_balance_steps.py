"""Balances in the solver classes: against states augmented by hand and tight references."""

import numpy as np
import pytest
import scipy.integrate
from systems import Verlet, energy, energy_gradient, orbit, oscillator, pericentre

import eip_scipy
from eip_scipy import (
    EIPDOP853,
    EIPGJ12,
    EIPRK1,
    EIPRK2,
    EIPRK3,
    EIPRK4,
    EIPRK5,
    EIPRK23,
    EIPRK45,
    EIPRKN8,
    EIPRKN12,
    Balance,
    Diagnostics,
    Invariant,
    ProjectionWarning,
    check_gradient,
    eip_method,
    integrate,
    project,
)

PERIOD = 2 * np.pi
DRAG = 1e-6
# A quartic oscillator whose stiffness varies slowly.
EPSILON, OMEGA = 1e-3, 0.3
FIXED = [(EIPRK1, 0.01), (EIPRK2, 0.05), (EIPRK3, 0.05), (EIPRK4, 0.1), (EIPRK5, 0.1), (EIPDOP853, 0.4)]
RUNS = [
    {"method": EIPDOP853, "h": 0.25},
    {"method": EIPRK4, "h": 0.1},
    {"method": EIPDOP853, "rtol": 1e-8, "atol": 1e-10},
    {"method": EIPRK45, "rtol": 1e-8, "atol": 1e-10},
    {"method": EIPRK23, "rtol": 1e-7, "atol": 1e-10},
    {"method": EIPDOP853, "h": 0.25, "every": 5},
    {"method": EIPRK45, "h": 0.05, "every": "auto"},
    {"method": EIPDOP853, "h": 0.25, "compensated": True},
    {"method": EIPDOP853, "h": 0.25, "direction": "midpoint", "iterations": 2},
    {"method": EIPGJ12, "h": 0.025},
]


def dragged(t, y):
    return orbit(t, y) - DRAG * np.array([0.0, 0.0, y[2], y[3]])


def smooth_energy(t, y):
    """The energy, by a square root that takes complex steps."""
    return 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)


def loss(t, y):
    return -DRAG * (y[2] ** 2 + y[3] ** 2)


def swinging(t, y):
    return np.array([y[1], -(1 + EPSILON * np.sin(OMEGA * t)) * y[0] - y[0] ** 3])


def swing_energy(t, y):
    return 0.5 * y[1] ** 2 + 0.5 * (1 + EPSILON * np.sin(OMEGA * t)) * y[0] ** 2 + 0.25 * y[0] ** 4


def swing_gradient(t, y):
    return np.array([(1 + EPSILON * np.sin(OMEGA * t)) * y[0] + y[0] ** 3, y[1]])


def swing_rate(t, y):
    return 0.5 * EPSILON * OMEGA * np.cos(OMEGA * t) * y[0] ** 2


def slow_energy(t, y):
    return 0.5 * (y @ y)


def damped(t, y):
    return np.array([y[1], -y[0] - 1e-4 * y[1]])


def damping(t, y):
    return -1e-4 * y[1] ** 2


START = np.array([1.0, 0.3])
SWING = Balance(swing_energy, swing_rate, swing_gradient, name="H")
SWING_ALONE = Balance(swing_energy, grad=swing_gradient, name="H")
DAMPED = Balance(slow_energy, damping, name="E")


ivp = scipy.integrate.solve_ivp


def reference(fun, t_span, y0, **others):
    return ivp(fun, t_span, y0, method="DOP853", rtol=1e-13, atol=1e-15, **others)


@pytest.mark.parametrize(("method", "h"), FIXED)
def test_the_state_is_the_one_that_is_augmented_by_hand(method, h):
    """The carried value is a further component, and F - Q an invariant whose correction leaves Q alone."""
    y0, t_span = pericentre(0.2), (0, 30.0)

    def fun(t, z):
        return np.append(dragged(t, z[:4]), loss(t, z))

    kept = Invariant(lambda t, z: energy(t, z) - z[4], lambda t, z: np.append(energy_gradient(t, z[:4]), -1.0))
    z0 = np.append(y0, energy(0, y0))
    by_hand = ivp(fun, t_span, z0, method=method, h=h, invariants=kept, metric=[1, 1, 1, 1, 0], check=False).y[:4]
    balance = Balance(energy, loss, energy_gradient)
    found = ivp(dragged, t_span, y0, method=method, h=h, invariants=balance, metric=[1, 1, 1, 1], check=False).y
    assert np.abs(found - by_hand).max() < 1e-11


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("balance", [SWING, SWING_ALONE], ids=["rate", "gradient"])
def test_states_between_the_steps_lie_on_the_carried_value(run, balance):
    """F at a state is Q at its time, whose error is that of an integral of the small rate."""
    exact = reference(swinging, (0, 20), START, dense_output=True).sol
    times = np.linspace(0, 20, 301)
    sol = ivp(swinging, (0, 20), START, t_eval=times, events=lambda t, y: y[0], invariants=balance, **run)
    loose = 1e-7 if run["method"] is EIPRK4 else 2e-11
    for t, y in ((sol.t, sol.y), (sol.t_events[0], sol.y_events[0].T)):
        assert len(t) > 5
        assert np.abs(swing_energy(t, y) - swing_energy(t, exact(t))).max() < loose
    dense = ivp(swinging, (0, 20), START, dense_output=True, invariants=balance, **run).sol
    assert np.array_equal(dense(times), sol.y)
    whole = integrate(swinging, (0, 20), START, t_eval=times, invariants=balance, **run)
    if run["method"] is EIPGJ12:  # whose states are centred on the history there
        assert np.abs(swing_energy(times, whole.y) - swing_energy(times, exact(times))).max() < loose
    else:
        assert np.array_equal(whole.y, sol.y)


def test_balances_beside_invariants_and_several_at_once():
    def both(t, y):
        return np.array([smooth_energy(t, y), y[0] * y[3] - y[1] * y[2]])

    def rates(t, y, f):
        return np.array([loss(t, y), y[0] * f[3] - y[1] * f[2]])

    def fun(t, z):
        return np.append(dragged(t, z[:4]), 1.0)

    right = reference(dragged, (0, 50), pericentre(0.2)).y[:, -1]
    clock = Invariant(lambda t, z: z[4] - t, lambda t, z: np.eye(5)[4], scale=1.0)
    pair = Balance(lambda t, z: both(t, z[:4]), rates, size=2, name="both", uses_f=True)
    for kept in ([pair], [clock, pair]):
        options = {"method": EIPDOP853, "h": 0.4, "invariants": kept, "check": False}
        run = integrate(fun, (0, 50.0), np.append(pericentre(0.2), 0.0), **options)
        assert np.abs(both(0, run.y[:, -1]) - both(0, right)).max() < 1e-9
        assert run.diagnostics.names[-2:] == ("both[0]", "both[1]")
        assert np.isnan(run.target).tolist() == [item is pair for item in kept for _ in range(1 + (item is pair))]
        assert np.isnan(run.diagnostics.slowness).all()  # without checks nothing is measured


def test_a_dependence_on_time_is_differentiated():
    """F of time alone: the carried value is its integral, which begins and ends within the interval."""
    asked = []

    def value(t, y):
        asked.append(t)
        return y[0] + np.exp(np.sin(3 * t))

    def fun(t, y):
        return np.array([1e-3 * np.cos(t) - 3 * np.cos(3 * t) * np.exp(np.sin(3 * t)), 0.0])

    balance = Balance(value, grad=lambda t, y: np.array([1.0, 0.0]))
    run = integrate(fun, (0, 2), [1.0, 0.0], method=EIPDOP853, h=0.1, invariants=balance, check=False)
    assert 0 <= min(asked) < max(asked) <= 2
    assert run.invariants[0, -1] - run.invariants[0, 0] == pytest.approx(1e-3 * np.sin(2), abs=1e-12)


@pytest.mark.parametrize("solve", [ivp, integrate])
def test_methods_that_carry_no_balance(solve):
    for method in (EIPRKN8, EIPRKN12, eip_method(Verlet())):
        with pytest.raises(ValueError, match=r"does not carry a Balance.*EIPRK4, EIPDOP853"):
            solve(oscillator, (0, 1), [1.0, 0.0], method=method, h=0.01, invariants=DAMPED)
    with pytest.raises(ValueError, match=r"EIPGJ12 carries a Balance in its history.* more than 12 steps.* has 10"):
        solve(swinging, (0, 0.1), START, method=EIPGJ12, h=0.01, invariants=SWING)


def test_project_needs_a_target():
    for given in ({}, {"start": [1.0, 0.0]}):
        with pytest.raises(ValueError, match=r"balance 'E' changes and has no value to keep\. Pass .* target="):
            project([1.0, 0.1], DAMPED, **given)
    assert abs(project([1.0, 0.1], DAMPED, target=0.5, iterations=5).residual[0]) < 1e-15


def test_what_balances_are_made_of():
    assert repr(DAMPED) == "Balance(E)"
    assert DAMPED.rate is damping
    with_args = Balance(lambda t, y, k: k * (y @ y), lambda t, y, k: k, args=(2.0,))
    assert with_args.rate(0, START) == 2.0
    assert Balance(with_args.fun, with_args.rate).args == (2.0,)
    assert check_gradient(SWING, 0.3, START) < 1e-10
    wrong = [
        ({"target": 1.0}, TypeError, "target"),
        ({"rate": 3}, TypeError, "Balance: rate must be callable or None, got 3"),
        ({"uses_f": True}, ValueError, "uses_f describes rate and grad"),
        ({"rate": damping, "in_place": True}, ValueError, "Balance: in_place and uses_f describe grad"),
        ({"args": 3}, TypeError, "Balance: args must be a tuple"),
    ]
    for options, error, match in wrong:
        with pytest.raises(error, match=match):
            Balance(slow_energy, **options)


def test_rates_of_another_kind():
    wrong = [
        (lambda t, y: "much", TypeError, "returned 'much'"),
        (lambda t, y: np.zeros(2), ValueError, r"returned shape \(2,\)"),
        (lambda t, y: 1j, ValueError, "returned complex values"),
        (lambda t, y: np.nan, ValueError, "is not finite at y0"),
    ]
    for rate, error, said in wrong:
        balance = Balance(slow_energy, rate, name="E")
        with pytest.raises(error, match=f"rate of balance 'E' {said}"):
            integrate(damped, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.1, invariants=balance)


# Checks.


@pytest.mark.parametrize("by", [lambda t, y: y.copy(), None], ids=["gradient", "complex step"])
@pytest.mark.parametrize("wrong", [1e-3, -1.0, 100.0])
def test_a_wrong_rate_is_named(by, wrong):
    """A rate of 1e-6 of its terms that is wrong by 1e-3 is wrong by 1e-9 of the terms."""

    def fun(t, y):
        return np.array([y[1], -y[0] - 1e-6 * y[1]])

    balance = Balance(slow_energy, lambda t, y: -1e-6 * (1 + wrong) * y[1] ** 2, by, name="E")
    with pytest.warns(ProjectionWarning, match="the rate of balance 'E' is wrong: at t=0 rate returned"):
        run = integrate(fun, (0, 50), [1.0, 1.0], method=EIPDOP853, h=0.2, invariants=balance)
    assert not run.trusted
    assert "the rate of balance 'E' is wrong" in run.message


@pytest.mark.parametrize("solve", [eip_scipy.solve_ivp, integrate])
@pytest.mark.parametrize("options", [{"method": EIPDOP853, "h": 0.2}, {"method": EIPRK45, "rtol": 1e-8}])
def test_a_rate_that_goes_wrong_later_is_named(solve, options):
    def late(t, y):
        return damping(t, y) * (1.0 if t < 20 else 1.01)

    with pytest.warns(ProjectionWarning, match="the rate of balance 'E' is wrong"):
        run = solve(damped, (0, 150), [1.0, 0.0], invariants=Balance(slow_energy, late, name="E"), **options)
    assert not run.trusted


def test_slowness():
    record = Diagnostics()
    energies = [DAMPED, Invariant(lambda t, y: t * 0.0 + 1.0, lambda t, y: np.zeros(2), name="one")]
    integrate(damped, (0, 3000), [1.0, 0.0], method=EIPDOP853, h=0.2, invariants=energies, diagnostics=record)
    # The mean of c v^2 over that of |v q| + |q v| + c v^2.
    assert record.slowness[0] == pytest.approx(1e-4 * 0.5 / (2 / np.pi), rel=0.05)
    assert np.isnan(record.slowness[1])


@pytest.mark.parametrize("solve", [ivp, integrate])
def test_a_fast_balance_is_pointed_out(solve):
    """Also if it is fast only at the end: the energy decays to that of its driving, whose rate is as large."""

    def run(end, damping, force):
        def power(t, y):
            return -damping * y[1] ** 2 + force * y[1] * np.cos(2 * t)

        def driven(t, y):
            return np.array([y[1], -y[0] - damping * y[1] + force * np.cos(2 * t)])

        balance = Balance(slow_energy, power, name="E")
        return solve(driven, (0, end), [1.0, 0.3], method=EIPDOP853, h=0.3, invariants=balance)

    run(200, 0.02, 0.01)  # warnings are errors
    for given in ((50, 0.0, 0.5), (1500, 0.02, 0.01)):
        with pytest.warns(UserWarning, match=r"balance 'E' changes too fast .* rate is 0\.\d+ of the sum") as told:
            assert getattr(run(*given), "trusted", True)
        assert len(told) == 1


@pytest.mark.filterwarnings("ignore:balance 'energy' changes too fast:UserWarning")
def test_a_right_rate_late_in_time_is_not_accused():
    """The phase omega t of a function of time is rounded, by more the later it is; differences in time see that."""

    def field(t, phase=1):
        wave = 0.1 * phase * np.exp(-1.1j * t)
        return np.array([[0, wave], [np.conj(wave), 0]])

    def matrix(t):
        return field(t) + np.diag([0.5, -0.5])

    def run(factor):
        balance = Balance(
            lambda t, psi: np.vdot(psi, matrix(t) @ psi).real,
            lambda t, psi: factor * np.vdot(psi, field(t, -1.1j) @ psi).real,
            lambda t, psi: 2 * (matrix(t) @ psi),
            name="energy",
        )
        start, options = np.array([1, 0], complex), {"method": EIPDOP853, "rtol": 1e-6, "atol": 1e-6}
        return integrate(lambda t, psi: -1j * (matrix(t) @ psi), (290, 310), start, invariants=balance, **options)

    assert run(1.0).trusted
    with pytest.warns(ProjectionWarning, match="rate of balance 'energy' is wrong"):
        run(1 + 1e-7)
