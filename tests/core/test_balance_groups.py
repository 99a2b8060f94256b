"""Balances with components: each group is projected by itself."""

import numpy as np
import pytest
import scipy.integrate
from systems import energy, energy_gradient, momentum, momentum_gradient, orbit, pericentre

from eip_scipy import (
    EIPDOP853,
    EIPGJ12,
    EIPRK4,
    EIPRK45,
    Balance,
    Invariant,
    ProjectionWarning,
    integrate,
    project,
)
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.problems import nbody, orbital_balances

EPS = np.finfo(float).eps
DRAG = 1e-6
RUNS = [
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


def dragged(t, y):
    return orbit(t, y) - DRAG * np.array([0.0, 0.0, y[2], y[3]])


def loss(t, y):
    return -DRAG * (y[2] ** 2 + y[3] ** 2)


def braked(t, y):
    return -DRAG * momentum(t, y)


def pair(**how):
    return [
        Balance(energy, loss, energy_gradient, name="E", **how),
        Balance(momentum, braked, momentum_gradient, name="L", **how),
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
    right = scipy.integrate.solve_ivp(dragged, (0, 200), pericentre(0.2), method="DOP853", rtol=1e-13, atol=1e-15)
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
    return scipy.integrate.solve_ivp(derivative, (0, 0.25), Y0, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=times).y


def energies(states):
    return np.array([KEPT[0].fun(0.0, y) for y in states.T])


TIMES = np.linspace(0, 0.25, 41)


@pytest.mark.parametrize("options", RUNS)
@pytest.mark.parametrize("kept", [KEPT, ALL], ids=["E", "E, h, e"])
def test_compiled_runs_have_the_bits_of_interpreted_ones(options, kept):
    compiled, interpreted = (run(kept, compiled=c, t_eval=TIMES, **options) for c in (True, False))
    assert compiled.compiled
    assert not interpreted.compiled
    assert np.array_equal(compiled.y, interpreted.y)
    assert compiled.trusted
    assert compiled.diagnostics.names == tuple(name for balance in kept for name in balance.value_names)
    right = exact(TIMES)
    assert np.abs(compiled.y - right).max() < (2e-4 if options["method"] is EIPRK4 else 1e-6)
    assert np.isfinite(compiled.diagnostics.slowness).all()


@pytest.mark.parametrize("options", RUNS)
def test_states_between_the_steps_and_of_continued_runs_are_on_the_targets(options):
    right = energies(exact(TIMES))
    loose = 1e-5 if options["method"] is EIPRK4 else 2e-8
    given = {
        "fun": derivative,
        "t_span": (0, 0.25),
        "y0": Y0,
        "invariants": KEPT,
        "linear_invariants": UNIFORM,
        **options,
    }
    sol = scipy.integrate.solve_ivp(t_eval=TIMES, **given)
    assert np.array_equal(scipy.integrate.solve_ivp(dense_output=True, **given).sol(TIMES), sol.y)
    found, halves = run(t_eval=TIMES, **options), run(t_span=(0, 0.125), **options).continue_to(0.25)
    assert np.abs(energies(sol.y) - right).max() < loose
    assert np.abs(energies(found.y) - right).max() < loose
    assert np.abs(energies(halves.y)[-1] - right[-1]).max() < loose
    for more in ({"project_initial": True}, {"check": False}):  # which change nothing here
        assert np.array_equal(run(t_eval=TIMES, **more, **options).y, found.y)


def test_a_checkpoint_knows_the_components(tmp_path):
    file = tmp_path / "run.npz"

    def drag(how, **more):
        return integrate(
            dragged, (0, 5), pericentre(0.2), method=EIPRK4, h=0.1, invariants=pair(**how), checkpoint=file, **more
        )

    drag({"components": range(4)})
    for other in (
        {"components": range(3)},
        {"components": range(4), "weights": [1, 1, 2, 2]},
        {"components": [[0, 1], [2, 3]]},
    ):
        with pytest.raises(CheckpointError, match="components"):
            drag(other, resume=True)


@pytest.mark.parametrize("options", [{"method": EIPDOP853, "h": 0.2}, {"method": EIPGJ12, "h": 0.04}])
def test_a_wrong_rate_is_named(options):
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


@pytest.mark.parametrize("solve", [scipy.integrate.solve_ivp, integrate])
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
