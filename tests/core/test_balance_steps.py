"""Balances in the solver classes: against states augmented by hand and tight references."""

import copy
import pickle
import warnings

import numpy as np
import pytest
import scipy.integrate
from systems import energy, energy_gradient, orbit, oscillator, pericentre

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


def reference(fun, t_span, y0, **others):
    return scipy.integrate.solve_ivp(fun, t_span, y0, method="DOP853", rtol=1e-13, atol=1e-15, **others)


def ivp(fun, t_span, y0, **options):
    return scipy.integrate.solve_ivp(fun, t_span, y0, **options)


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


def test_a_planet_with_drag():
    y0, end, h = pericentre(0.2), 60 * PERIOD, PERIOD / 16
    right = reference(dragged, (0, end), y0).y[:2, -1]

    def error(*invariants):
        run = integrate(dragged, (0, end), y0, method=EIPDOP853, h=h, invariants=invariants)
        assert run.trusted
        return np.linalg.norm(run.y[:2, -1] - right)

    assert error() > 1e-3
    given = error(Balance(energy, loss, energy_gradient))
    assert given < 1e-5
    assert error(Balance(energy, grad=energy_gradient)) == pytest.approx(given, rel=1e-4)
    assert error(Balance(smooth_energy)) == pytest.approx(given, rel=1e-4)


@pytest.mark.parametrize("balance", [SWING, SWING_ALONE, Balance(swing_energy)], ids=["rate", "gradient", "values"])
def test_a_slowly_varying_field(balance):
    right = reference(swinging, (0, 500), START).y[:, -1]
    plain = integrate(swinging, (0, 500), START, method=EIPDOP853, h=0.5)
    run = integrate(swinging, (0, 500), START, method=EIPDOP853, h=0.5, invariants=balance)
    assert run.trusted
    assert np.abs(plain.y[:, -1] - right).max() > 1e-2
    assert np.abs(run.y[:, -1] - right).max() < 1e-4


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


@pytest.mark.parametrize("run", RUNS)
def test_backward(run):
    end = reference(swinging, (0, 20), START).y[:, -1]
    back = ivp(swinging, (20, 0), end, invariants=SWING, **run).y[:, -1]
    assert abs(swing_energy(0, back) - swing_energy(0, START)) < 1e-7
    assert np.abs(back - START).max() < 1e-3


def test_a_complex_state():
    g = 1e-4

    def fun(t, y):
        return -1j * np.array([y[0] + abs(y[0]) ** 2 * y[0] + 0.3 * y[1], 2 * y[1] + 0.3 * y[0]]) - g * y

    def mass(t, y):
        return np.vdot(y, y).real

    y0 = np.array([1.0 + 0.2j, 0.5 - 0.1j])
    for rate in (None, lambda t, y: -2 * g * mass(t, y)):
        balance = Balance(mass, rate, lambda t, y: 2 * y)
        run = integrate(fun, (0, 100), y0, method=EIPDOP853, h=0.4, invariants=balance, t_eval=np.linspace(0, 100, 50))
        assert run.trusted
        masses = np.array([mass(0, y) for y in run.y.T])
        assert np.abs(masses - mass(0, y0) * np.exp(-2 * g * run.t)).max() < 1e-8


def test_friction_never_adds_energy():
    """A rate that is never positive and positive weights, as those of RK4, make F monotone."""
    run = integrate(damped, (0, 2000), [1.0, 0.0], method=EIPRK4, h=0.3, invariants=DAMPED, save_every=1)
    assert (np.diff(run.invariants[0]) <= 4 * np.finfo(float).eps).all()
    assert run.invariants[0, -1] == pytest.approx(0.5 * np.exp(-0.2), rel=1e-3)


def test_rejected_steps_leave_the_value_alone():
    def jolted(t, y):
        return damped(t, y) + np.array([0.0, 1e-2 if t > 3 else 0.0])

    def work(t, y):
        return damping(t, y) + (1e-2 if t > 3 else 0.0) * y[1]

    run = integrate(jolted, (0, 10), [1.0, 0.0], method=EIPRK45, rtol=1e-6, invariants=Balance(slow_energy, work))
    plain = integrate(jolted, (0, 10), [1.0, 0.0], method=EIPRK45, rtol=1e-6)
    right = reference(jolted, (3, 10), reference(jolted, (0, 3), [1.0, 0.0]).y[:, -1], max_step=0.1).y[:, -1]
    assert abs(slow_energy(0, run.y[:, -1]) - slow_energy(0, right)) < 1e-5
    assert np.abs(run.y[:, -1] - right).max() < 2 * np.abs(plain.y[:, -1] - right).max()


def test_balances_beside_invariants_and_several_at_once():
    def both(t, y):
        return np.array([smooth_energy(t, y), y[0] * y[3] - y[1] * y[2]])

    def rates(t, y, f):
        return np.array([loss(t, y), y[0] * f[3] - y[1] * f[2]])

    y0, t_span = pericentre(0.2), (0, 50.0)
    right = reference(dragged, t_span, y0).y[:, -1]

    def fun(t, z):
        return np.append(dragged(t, z[:4]), 1.0)

    clock = Invariant(lambda t, z: z[4] - t, lambda t, z: np.array([0.0, 0.0, 0.0, 0.0, 1.0]), name="clock", scale=1.0)
    pair = Balance(lambda t, z: both(t, z[:4]), lambda t, z, f: rates(t, z, f), size=2, name="both", uses_f=True)
    run = integrate(fun, t_span, np.append(y0, 0.0), method=EIPDOP853, h=0.4, invariants=[pair], check=False)
    mixed = integrate(fun, t_span, np.append(y0, 0.0), method=EIPDOP853, h=0.4, invariants=[clock, pair], check=False)
    for found in (run, mixed):
        assert np.abs(both(0, found.y[:, -1]) - both(0, right)).max() < 1e-9
    assert run.diagnostics.names == ("both[0]", "both[1]")
    assert np.isnan(mixed.target).tolist() == [False, True, True]
    assert np.isnan(mixed.diagnostics.slowness).all()  # without checks nothing is measured


def test_a_dependence_on_time_is_differentiated():
    """F of time alone: the carried value is its integral, which begins and ends within the interval."""
    asked = []

    def value(t, y):
        asked.append(t)
        return y[0] + np.exp(np.sin(3 * t))

    run = integrate(
        lambda t, y: np.array([1e-3 * np.cos(t), 0.0]) - [3 * np.cos(3 * t) * np.exp(np.sin(3 * t)), 0.0],
        (0, 2),
        [1.0, 0.0],
        method=EIPDOP853,
        h=0.1,
        invariants=Balance(value, grad=lambda t, y: np.array([1.0, 0.0])),
        check=False,
    )
    assert min(asked) >= 0
    assert max(asked) <= 2
    assert run.invariants[0, -1] - run.invariants[0, 0] == pytest.approx(1e-3 * np.sin(2), abs=1e-12)


def test_copies_go_on_to_the_same_bits():
    for balance, runs in ((SWING, RUNS), (SWING_ALONE, RUNS[::3])):
        for options in runs:
            options = dict(options)
            method = options.pop("method")
            whole = method(swinging, 0, START, 20, invariants=balance, **options)
            parts = method(swinging, 0, START, 20, invariants=balance, **options)
            for _ in range(7):
                parts.step()
            copies = [parts, copy.deepcopy(parts), pickle.loads(pickle.dumps(parts))]
            for solver in (whole, *copies):
                while solver.status == "running":
                    solver.step()
                assert np.array_equal(solver.y, whole.y)
            assert copies[0].dense_output()(19.99) == pytest.approx(copies[1].dense_output()(19.99), abs=0)


def test_a_state_that_is_set_is_a_new_start():
    solver = EIPDOP853(swinging, 0, START, 20, h=0.1, invariants=SWING)
    for _ in range(20):
        solver.step()
    solver.y = 1.1 * solver.y
    t, y = solver.t, solver.y.copy()
    for _ in range(20):
        solver.step()
    right = reference(swinging, (t, solver.t), y).y[:, -1]
    assert abs(swing_energy(solver.t, solver.y) - swing_energy(solver.t, right)) < 1e-12


def test_other_tolerances_leave_the_value_alone():
    solver = EIPDOP853(swinging, 0, START, 20, rtol=1e-8, atol=1e-10, invariants=SWING)
    for _ in range(5):
        solver.step()
    solver.rtol = 1e-9
    while solver.status == "running":
        solver.step()
    right = reference(swinging, (0, 20), START).y[:, -1]
    assert abs(swing_energy(20, solver.y) - swing_energy(20, right)) < 1e-11


def leapfrog():
    class Leapfrog:
        order = 2

        def one_step(self, t, y, h):
            return [y[0] + h * y[1], y[1] - h * y[0]]

    return eip_method(Leapfrog())


@pytest.mark.parametrize("method", [EIPRKN8, EIPRKN12, leapfrog()])
@pytest.mark.parametrize("solve", [ivp, integrate])
def test_methods_that_carry_no_balance(method, solve):
    with pytest.raises(ValueError, match=r"does not carry a Balance.*EIPRK4, EIPDOP853"):
        solve(oscillator, (0, 1), [1.0, 0.0], method=method, h=0.01, invariants=Balance(slow_energy, damping))


@pytest.mark.parametrize("solve", [ivp, integrate])
def test_a_history_that_is_longer_than_the_run(solve):
    with pytest.raises(ValueError, match=r"EIPGJ12 carries a Balance in its history.* more than 12 steps.* has 10"):
        solve(swinging, (0, 0.1), START, method=EIPGJ12, h=0.01, invariants=SWING)


@pytest.mark.parametrize("solve", [ivp, integrate])
def test_an_interval_without_steps_needs_no_history(solve):
    """The result is the start, as with SciPy's methods."""
    found = solve(swinging, (0, 0), START, method=EIPGJ12, h=0.01, invariants=SWING)
    assert found.status == 0
    np.testing.assert_array_equal(found.y[:, -1], START)


def test_project_needs_a_target():
    for given in ({}, {"start": [1.0, 0.0]}):
        with pytest.raises(ValueError, match=r"balance 'E' changes and has no value to keep\. Pass .* target="):
            project([1.0, 0.1], DAMPED, **given)
    assert abs(project([1.0, 0.1], DAMPED, target=0.5, iterations=5).defect[0]) < 1e-15


def test_what_balances_are_made_of():
    assert repr(DAMPED) == "Balance(E)"
    assert DAMPED.rate is damping
    with_args = Balance(lambda t, y, k: k * (y @ y), lambda t, y, k: k, args=(2.0,))
    assert with_args.rate(0, START) == 2.0
    assert Balance(with_args.fun, with_args.rate).args == (2.0,)
    assert check_gradient(SWING, 0.3, START) < 1e-10
    with pytest.raises(TypeError, match="target"):
        Balance(slow_energy, target=1.0)
    with pytest.raises(TypeError, match="Balance: rate must be callable or None, got 3"):
        Balance(slow_energy, 3)
    with pytest.raises(ValueError, match="uses_f describes rate and grad"):
        Balance(slow_energy, uses_f=True)
    with pytest.raises(ValueError, match="Balance: in_place and uses_f describe grad"):
        Balance(slow_energy, damping, in_place=True)
    with pytest.raises(TypeError, match="Balance: args must be a tuple"):
        Balance(slow_energy, args=3)


@pytest.mark.parametrize(
    ("rate", "error", "said"),
    [
        (lambda t, y: "much", TypeError, "rate of balance 'E' returned 'much'"),
        (lambda t, y: np.zeros(2), ValueError, r"rate of balance 'E' returned shape \(2,\)"),
        (lambda t, y: 1j, ValueError, "rate of balance 'E' returned complex values"),
        (lambda t, y: np.nan, ValueError, "rate of balance 'E' is not finite at y0"),
    ],
)
def test_rates_of_another_kind(rate, error, said):
    with pytest.raises(error, match=said):
        integrate(damped, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.1, invariants=Balance(slow_energy, rate, name="E"))


# Checks.


def gradient(t, y):
    return y.copy()


@pytest.mark.parametrize("by", [gradient, None], ids=["gradient", "complex step"])
@pytest.mark.parametrize("wrong", [1e-3, -1.0, 100.0])
def test_a_wrong_rate_is_named(by, wrong):
    """A rate of 1e-6 of its terms that is wrong by 1e-3 is wrong by 1e-9 of the terms."""

    def fun(t, y):
        return np.array([y[1], -y[0] - 1e-6 * y[1]])

    def rate(t, y):
        return -1e-6 * (1 + wrong) * y[1] ** 2

    balance = Balance(slow_energy, rate, by, name="E")
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


@pytest.mark.parametrize("options", RUNS[::3])
@pytest.mark.parametrize("rate", [swing_rate, None], ids=["rate", "no rate"])
def test_right_rates_are_not_accused(options, rate):
    """Gradients are computed here; with given ones no test of this file warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = integrate(swinging, (0, 100), START, invariants=Balance(swing_energy, rate), **options)
    assert run.trusted


def test_gradients_by_differences_accuse_no_rate():
    """An absolute value allows no complex step."""
    balance = Balance(lambda t, y: abs(energy(t, y)), lambda t, y: -loss(t, y), name="E")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "invariant 'E' has no grad", UserWarning)
        run = integrate(dragged, (0, 100), pericentre(0.2), method=EIPDOP853, h=0.3, invariants=balance)
    assert run.trusted


def test_slowness():
    record = Diagnostics()
    energies = [DAMPED, Invariant(lambda t, y: t * 0.0 + 1.0, lambda t, y: np.zeros(2), name="one")]
    integrate(damped, (0, 3000), [1.0, 0.0], method=EIPDOP853, h=0.2, invariants=energies, diagnostics=record)
    # The mean of c v^2 over that of |v q| + |q v| + c v^2.
    assert record.slowness[0] == pytest.approx(1e-4 * 0.5 / (2 / np.pi), rel=0.05)
    assert np.isnan(record.slowness[1])


@pytest.mark.parametrize("solve", [ivp, eip_scipy.solve_ivp, integrate])
def test_a_fast_balance_is_pointed_out(solve):
    def driven(t, y):
        return np.array([y[1], -y[0] + 0.5 * np.cos(1.7 * t)])

    balance = Balance(slow_energy, lambda t, y: 0.5 * np.cos(1.7 * t) * y[1], name="E")
    with pytest.warns(UserWarning, match=r"balance 'E' changes too fast .* rate is 0\.\d+ of the sum") as told:
        run = solve(driven, (0, 50), [1.0, 0.0], method=EIPDOP853, h=0.2, invariants=balance)
    assert len(told) == 1
    assert getattr(run, "trusted", True)


@pytest.mark.parametrize("solve", [ivp, eip_scipy.solve_ivp, integrate])
def test_a_balance_that_is_fast_only_at_the_end_is_pointed_out(solve):
    """The energy of an oscillator decays to that of its driving, where its rate is as large as its terms."""

    def driven(t, y):
        return np.array([y[1], -y[0] - 0.02 * y[1] + 0.01 * np.cos(2 * t)])

    def power(t, y):
        return -0.02 * y[1] ** 2 + 0.01 * y[1] * np.cos(2 * t)

    balance = Balance(slow_energy, power, name="E")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solve(driven, (0, 200), [1.0, 0.3], method=EIPDOP853, h=0.3, invariants=balance)
    with pytest.warns(UserWarning, match=r"balance 'E' changes too fast .* rate is 0\.\d+ of the sum"):
        solve(driven, (0, 1500), [1.0, 0.3], method=EIPDOP853, h=0.3, invariants=balance)


@pytest.mark.filterwarnings("ignore:balance 'energy' changes too fast:UserWarning")
def test_a_right_rate_late_in_time_is_not_accused():
    """The phase omega t of a function of time is rounded, by more the later it is; differences in time see that."""
    frequency, strength = 1.1, 0.2

    def field(t, phase=1):
        wave = 0.5 * strength * phase * np.exp(-1j * frequency * t)
        return np.array([[0, wave], [np.conj(wave), 0]])

    def matrix(t):
        return field(t) + np.diag([0.5, -0.5])

    def energy(t, psi):
        return np.vdot(psi, matrix(t) @ psi).real

    def rate(t, psi, factor=1.0):
        return factor * np.vdot(psi, field(t, -1j * frequency) @ psi).real

    def run(rate):
        balance = Balance(energy, rate, lambda t, psi: 2 * (matrix(t) @ psi), name="energy")
        start, options = np.array([1, 0], complex), {"method": EIPDOP853, "rtol": 1e-6, "atol": 1e-6}
        return integrate(lambda t, psi: -1j * (matrix(t) @ psi), (290, 310), start, invariants=balance, **options)

    assert run(rate).trusted
    with pytest.warns(ProjectionWarning, match="rate of balance 'energy' is wrong"):
        run(lambda t, psi: rate(t, psi, 1 + 1e-7))
