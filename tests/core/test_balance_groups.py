"""Balances in steps, alone and in groups: against states augmented by hand and tight references."""

import numpy as np
import pytest
import scipy.integrate
from systems import Verlet, energy, energy_gradient, momentum, momentum_gradient, orbit, oscillator, pericentre

import eip_scipy
from eip_scipy import EIPDOP853, EIPGJ12, EIPRK4, EIPRK45, Balance, Invariant, ProjectionWarning, integrate, project
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.problems import nbody, orbital_balances

DRAG = 1e-6
# A quartic oscillator whose stiffness varies slowly.
EPSILON, OMEGA = 1e-3, 0.3
FIXED = [
    (eip_scipy.EIPRK1, 0.01),
    (eip_scipy.EIPRK2, 0.05),
    (eip_scipy.EIPRK3, 0.05),
    (EIPRK4, 0.1),
    (eip_scipy.EIPRK5, 0.1),
    (EIPDOP853, 0.4),
]
RUNS = [
    {"method": EIPDOP853, "h": 0.25},
    {"method": EIPRK4, "h": 0.1},
    {"method": EIPDOP853, "rtol": 1e-8, "atol": 1e-10},
    {"method": EIPRK45, "rtol": 1e-8, "atol": 1e-10},
    {"method": eip_scipy.EIPRK23, "rtol": 1e-7, "atol": 1e-10},
    {"method": EIPDOP853, "h": 0.25, "every": 5},
    {"method": EIPRK45, "h": 0.05, "every": "auto"},
    {"method": EIPDOP853, "h": 0.25, "compensated": True},
    {"method": EIPDOP853, "h": 0.25, "direction": "midpoint", "iterations": 2},
    {"method": EIPGJ12, "h": 0.025},
]


def dragged(t, y):
    return orbit(t, y) - DRAG * np.array([0.0, 0.0, y[2], y[3]])


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
        by_root = 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)  # which takes complex steps
        return np.array([by_root, y[0] * y[3] - y[1] * y[2]])

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
    for method in (eip_scipy.EIPRKN8, eip_scipy.EIPRKN12, eip_scipy.eip_method(Verlet())):
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
    assert eip_scipy.check_gradient(SWING, 0.3, START) < 1e-10
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
    record = eip_scipy.Diagnostics()
    energies = [DAMPED, Invariant(lambda t, y: t * 0.0 + 1.0, lambda t, y: np.zeros(2), name="one")]
    integrate(damped, (0, 3000), [1.0, 0.0], method=EIPDOP853, h=0.2, invariants=energies, diagnostics=record)
    # The mean of c v^2 over that of |v q| + |q v| + c v^2.
    assert record.slowness[0] == pytest.approx(1e-4 * 0.5 / (2 / np.pi), rel=0.05)
    assert np.isnan(record.slowness[1])


@pytest.mark.parametrize("solve", [ivp, integrate])
def test_a_fast_balance_is_pointed_out(solve):
    """Also if it is fast only at the end: the energy decays to that of its driving, whose rate is as large."""

    def run(end, damping, force):
        def driven(t, y):
            return np.array([y[1], -y[0] - damping * y[1] + force * np.cos(2 * t)])

        balance = Balance(slow_energy, lambda t, y: -damping * y[1] ** 2 + force * y[1] * np.cos(2 * t), name="E")
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


# Balances with components: each group is projected by itself.

EPS = np.finfo(float).eps
GROUP_RUNS = [
    {"method": EIPDOP853, "h": 0.005},
    {"method": EIPRK4, "h": 0.001, "every": 3},
    {"method": EIPRK45, "rtol": 1e-9, "atol": 1e-12},
    {"method": EIPGJ12, "h": 0.001},
]
# A star, a planet with a moon, and two planets; AU and years.
GM = np.array([39.5, 1e-2, 1e-5, 4e-2, 1e-3])
STAR, PLANET, MOON, SECOND, THIRD = range(5)


def places():
    q, v = np.zeros((2, 5, 3))
    for k, (distance, tilt) in {PLANET: (1.0, 0.02), SECOND: (2.1, 0.0), THIRD: (3.4, 0.1)}.items():
        angle = 1.3 * k
        q[k] = distance * np.array([np.cos(angle), np.sin(angle), tilt])
        v[k] = np.sqrt(GM[0] / distance) * np.array([-np.sin(angle), np.cos(angle), 0.05])
    q[MOON] = q[PLANET] + [0.015, 0, 0.001]
    v[MOON] = v[PLANET] + [0, np.sqrt(1e-2 / 0.015), 0]
    return np.array([x - GM @ x / GM.sum() for x in (q, v)])


PROBLEM = nbody(GM, *places(), t_span=(0, 0.25), h=0.002, units="AU, yr")
Y0 = PROBLEM.y0
BODIES = np.arange(30).reshape(2, 5, 3)
UNIFORM = (PROBLEM.linear_invariants[0], np.kron(np.eye(2), np.kron(np.ones((5, 1)), np.eye(3))))
KEPT = orbital_balances(GM, Y0)
ALL = orbital_balances(GM, Y0, ("energy", "momentum", "laplace"))


def derivative(t, y):
    out = np.empty(30)
    PROBLEM.rhs(t, y, out, GM)
    return out


def run(balances=KEPT, **options):
    options.setdefault("linear_invariants", UNIFORM)
    return integrate(PROBLEM, invariants=balances, **options)


def pair(**how):
    return [
        Balance(energy, loss, energy_gradient, name="E", **how),
        Balance(momentum, lambda t, y: -DRAG * momentum(t, y), momentum_gradient, name="L", **how),
    ]


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("options", [{"method": EIPDOP853, "h": 0.25}, {"method": EIPRK4, "h": 0.05}])
def test_one_group_of_all_components_is_the_euclidean_projection(count, options):
    grouped, plain = (
        integrate(dragged, (0, 20), pericentre(0.2), invariants=items[:count], save_every=1, **more, **options).y
        for items, more in ((pair(components=range(4)), {}), (pair(), {"metric": "euclidean"}))
    )
    assert np.abs(grouped[:, 1] - plain[:, 1]).max() < 4 * EPS
    assert np.abs(grouped - plain).max() < 1e-12
    by_history = {"method": EIPGJ12, "h": 0.04, "invariants": pair(components=range(4), weights=[1, 1, 2, 2])}
    found = integrate(dragged, (0, 200), pericentre(0.2), **by_history)
    right = ivp(dragged, (0, 200), pericentre(0.2), method="DOP853", rtol=1e-13, atol=1e-15)
    assert found.trusted
    assert np.abs(found.y[:, -1] - right.y[:, -1]).max() < 1e-9


def test_weights_and_rows():
    """The correction is the shortest in units of the weights; the components of a row move alike."""
    rng = np.random.default_rng(0)
    g, y, weights = rng.normal(size=6), rng.normal(size=6), np.array([2.0, 0.5])

    def plane(**how):
        return Balance(lambda t, y: g @ y, lambda t, y: 0.0, lambda t, y: g, **how)

    moved = project(y, plane(components=[[4, 1], [0, 3]], weights=weights), target=g @ y + 1e-3).correction
    slope = weights * [g[4] + g[1], g[0] + g[3]]
    steps = weights * slope / (slope @ slope) * 1e-3
    assert np.allclose(moved, [steps[1], steps[0], 0, steps[1], steps[0], 0], rtol=1e-10, atol=0)
    assert np.allclose(project(y, plane(components=[2]), target=g @ y + 1e-3).correction[2], 1e-3 / g[2], rtol=1e-10)


@pytest.mark.parametrize(
    ("kept", "frame"), [(KEPT, None), (KEPT, UNIFORM), (ALL, UNIFORM), (ALL, PROBLEM.linear_invariants)]
)
def test_a_group_does_not_disturb_the_others(kept, frame):
    """A planet that is off, with its moon, is brought back without a change of any other relative motion."""
    f = derivative(0.0, Y0)
    target = np.concatenate([np.ravel(balance.fun(0.0, Y0)) for balance in kept])
    off = Y0.copy()
    off[BODIES[1, [PLANET, MOON]]] += [1e-7, -2e-7, 5e-8]
    found = project(off, kept, target=target, f=f, linear_invariants=frame)
    q, v = found.y.reshape(2, 5, 3)
    q0, v0 = off.reshape(2, 5, 3)
    loose = 4 * EPS
    for body, centre in [(SECOND, STAR), (THIRD, STAR), (MOON, PLANET)]:
        assert np.abs((q[body] - q[centre]) - (q0[body] - q0[centre])).max() <= loose
        assert np.abs((v[body] - v[centre]) - (v0[body] - v0[centre])).max() <= 4 * loose
    after = np.concatenate([np.ravel(balance.fun(0.0, found.y)) for balance in kept])
    before = np.concatenate([np.ravel(balance.fun(0.0, off)) for balance in kept])
    assert np.abs(after - target).max() < 1e-5 * np.abs(before - target).max()
    moved = PROBLEM.linear_invariants[0] @ found.correction  # centre of mass and momentum
    assert (np.abs(moved) <= EPS * np.abs(PROBLEM.linear_invariants[0]) @ np.abs(off)).all()
    assert found.rank == (4 if kept is KEPT else 4 * 5)


def exact(times):
    return ivp(derivative, (0, 0.25), Y0, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=times).y


TIMES = np.linspace(0, 0.25, 41)


@pytest.mark.parametrize("options", GROUP_RUNS)
@pytest.mark.parametrize("kept", [KEPT, ALL], ids=["E", "E, h, e"])
def test_compiled_runs_have_the_bits_of_interpreted_ones(options, kept):
    compiled, interpreted = (run(kept, compiled=c, t_eval=TIMES, **options) for c in (True, False))
    assert compiled.compiled
    assert not interpreted.compiled
    assert np.array_equal(compiled.y, interpreted.y)
    assert compiled.trusted
    assert compiled.diagnostics.names == tuple(name for balance in kept for name in balance.value_names)
    right, loose = exact(TIMES), (2e-4, 1e-5) if options["method"] is EIPRK4 else (1e-6, 2e-8)
    sol = ivp(derivative, (0, 0.25), Y0, invariants=kept, linear_invariants=UNIFORM, t_eval=TIMES, **options)
    for states in (compiled.y, sol.y):
        assert np.abs(states - right).max() < loose[0]
        energies = [[KEPT[0].fun(0.0, y) for y in some.T] for some in (states, right)]
        assert np.abs(np.subtract(*energies)).max() < loose[1]
    assert np.isfinite(compiled.diagnostics.slowness).all()


def test_a_checkpoint_knows_the_components(tmp_path):
    file = tmp_path / "run.npz"

    def drag(how, **more):
        return integrate(
            dragged, (0, 5), pericentre(0.2), method=EIPRK4, h=0.1, invariants=pair(**how), checkpoint=file, **more
        )

    drag({"components": range(4)})
    for other in ({"components": range(3)}, {"components": range(4), "weights": [1, 1, 2, 2]}):
        with pytest.raises(CheckpointError, match="components"):
            drag(other, resume=True)


@pytest.mark.parametrize("options", [{"method": EIPDOP853, "h": 0.2}, {"method": EIPGJ12, "h": 0.04}])
def test_a_wrong_rate_of_a_group_is_named(options):
    wrong = Balance(energy, lambda t, y: 100 * loss(t, y), energy_gradient, name="E", components=range(4))
    with pytest.warns(ProjectionWarning, match="the rate of balance 'E' is wrong"):
        assert not integrate(dragged, (0, 50), pericentre(0.2), invariants=wrong, **options).trusted


WRONG = [
    (None, [1.0], "weights are given without components"),
    *((components, None, "must be integers of shape") for components in ([], [0.5], [1j], [[0, 1], [2]])),
    *((components, None, "different indices >= 0") for components in ([-1], [[0, 1], [1, 2]])),
    *(([0, 1], weights, "weights must be 2 positive numbers") for weights in ([1.0], [1.0, 0.0], [1.0, np.nan])),
]


def test_wrong_components_and_weights():
    for components, weights, message in WRONG:
        with pytest.raises(ValueError, match=message):
            Balance(energy, loss, components=components, weights=weights)
    mass = Balance(lambda t, y: np.vdot(y, y).real, lambda t, y: 0.0, lambda t, y: 2 * y, components=[0])
    with pytest.raises(ValueError, match="but the state is complex"):
        integrate(lambda t, y: -1j * y, (0, 1), [1 + 0j, 1j], method=EIPRK4, h=0.1, invariants=mass)


PLAIN = Invariant(momentum, momentum_gradient, name="L")


@pytest.mark.parametrize("solve", [ivp, integrate])
@pytest.mark.parametrize(
    ("items", "more", "message"),
    [
        (pair(components=[4]), {}, r"outside the state, which has 4 components"),
        ([*pair(components=[0]), PLAIN], {}, "'L' has no components, but others have"),
        ([*pair(components=range(4))[:1], pair()[1]], {}, "'L' has no components, but others have"),
        (pair(components=[0]), {"metric": [1, 1, 1, 1]}, "metric, direction and iterations do not apply"),
        (pair(components=[0]), {"iterations": 2}, "metric, direction and iterations do not apply"),
        (pair(components=[0]), {"direction": "old"}, "metric, direction and iterations do not apply"),
    ],
)
def test_what_does_not_go_together(solve, items, more, message):
    with pytest.raises(ValueError, match=message):
        solve(dragged, (0, 1), pericentre(0.2), method=EIPDOP853, h=0.1, invariants=items, **more)
    for given in ({"iterations": 3}, {"sigma": [1, 1, 1, 1]}):
        with pytest.raises(ValueError, match="do not apply to balances with components"):
            project(pericentre(0.2), pair(components=range(4)), target=[-0.5, 1.0], **given)
