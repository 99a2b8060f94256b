"""Members of an ensemble in batches: each gets the bits of a single run, whatever the other members do."""

import math

import numpy as np
import pytest
from numba import njit
from systems import jit_oscillator

from eip_scipy import EIPDOP853, EIPGJ12, EIPGJ14, EIPRK4, EIPRK5, EIPRK45, EIPRKN8, EIPRKN12, ensemble, integrate
from eip_scipy.ensembles import members as running
from eip_scipy.problems import harmonic, kepler, solar_system
from eip_scipy.problems.gravity.nbody import nbody

FIELDS = ("y", "max_residual", "nfev", "njev", "nlu")


def spread_starts(y0, members, size=1e-3, seed=0):
    return y0 * (1 + size * np.random.default_rng(seed).normal(size=(members, y0.size)))


@pytest.fixture(autouse=True)
def _small_ensembles_too(monkeypatch):
    monkeypatch.setattr(running, "LEAST_WORK", 0)


def check_bits(problem, t_span, starts, *, params=None, members=None, **options):
    """Run an ensemble, and compare some of its members with single runs."""
    run = ensemble(problem, t_span, starts, params=params, executor=1, **options)
    saved = run.times.size > 0
    for k in range(len(starts)) if members is None else members:
        own = None if params is None else params[k]
        single = integrate(problem, t_span, starts[k], params=own, check=False, **options)
        assert (single.status, single.message) == (run.status[k], run.message[k])
        np.testing.assert_array_equal(run.y[k], single.y[:, -1])
        assert run.t[k] == single.t[-1]
        if saved and single.success:
            np.testing.assert_array_equal(run.trajectories[k], single.y)
        np.testing.assert_array_equal(run.max_residual[k], single.max_residual)
        assert [run[name][k] for name in FIELDS[2:]] == [single[name] for name in FIELDS[2:]]
        np.testing.assert_array_equal(run.max_correction[k], single.diagnostics.max_correction)
    return run


ROUND = np.stack([kepler(x, relativistic=0.0).y0 for x in (0, 0, 1e-9, 1e-8, 1e-6, 1e-4, 0.02, 0.3, 0, 0.6)])
STRETCHED = spread_starts(np.array([1.0, 0.0, 0.0, 0.85]), 16, size=0.03)
WEIGHTS = np.array([1.0, 2.0, 0.5, 3.0])
FRAME = (np.array([[1.0, 0, 0, 0.5]]), np.array([[1.0], [0], [0], [0]]))
# Times at the start or later, several in one step, at the end of a step, and at the end of the run.
TIMES = np.array([0.0, 0.02, 0.11, 0.12, 0.5, 1.234, 6.1])
CASES = {  # the end of the interval, the starts or their number, options
    "RK4": (15.0, 40, {"h": 0.03}),
    "RK5": (15.0, 40, {"h": 0.03, "method": EIPRK5}),
    "RK45": (15.0, 40, {"h": 0.03, "method": EIPRK45}),
    "DOP853": (15.0, 40, {"h": 0.03, "method": EIPDOP853}),
    "euclidean, backward": (-5.0, 11, {"metric": "euclidean"}),
    "weights, backward": (-5.0, 11, {"metric": WEIGHTS}),
    "every": (6.1, 11, {"every": 3}),
    "reuse_f": (6.1, 11, {"reuse_f": False}),
    "blocks": (6.1, 11, {"blocks": None}),
    "no invariants": (6.1, 11, {"invariants": ()}),
    "save_every": (6.1, 11, {"save_every": 7}),
    "frame": (6.1, 11, {"linear_invariants": FRAME}),
    "cubic": (6.1, 11, {"t_eval": TIMES}),
    "cubic, backward": (-6.1, 9, {"t_eval": -TIMES}),
    "quartic": (6.1, 11, {"t_eval": TIMES, "method": EIPRK45, "every": 3}),
    "seventh": (6.1, 11, {"t_eval": TIMES, "method": EIPDOP853}),
    "seventh, backward": (-6.1, 9, {"t_eval": -TIMES, "method": EIPDOP853}),
    "without invariants": (6.1, 11, {"t_eval": TIMES, "method": EIPRK5, "invariants": ()}),
    # The gradients of H and L are parallel: the rank falls, in some members at some steps.
    "circular orbits": (30.0, ROUND, {"method": EIPRK5}),
    # Steps that are too long make projections that need a second try: more than a batch does.
    "second tries": (60.0, STRETCHED, {"method": EIPRK5, "h": 0.25, "blocks": None, "save_every": 50, "every": 5}),
    **{f"{n} members": (3.0, n, {}) for n in (1, 2, 7, 8, 9, 33, 70)},
}


@pytest.mark.parametrize("name", CASES)
def test_members_get_the_bits_of_single_runs(name):
    end, starts, options = CASES[name]
    problem = kepler(relativistic=0.0) if starts is ROUND else kepler()
    starts = spread_starts(problem.y0, starts) if isinstance(starts, int) else starts
    run = check_bits(problem, (0.0, end), starts, **{"method": EIPRK4, "h": 0.05} | options)
    if len(starts) > 8:
        assert run.side_by_side.all()
        assert run.one_by_one == ""


def test_nystrom_with_parameters_of_each():
    problem = solar_system(years=100.0)
    starts = spread_starts(problem.y0, 9, size=1e-7)
    check_bits(problem, (0, 3), starts, method=EIPRKN12, h=0.02, every=5, members=[0, 4, 8])
    masses = problem.params * (1 + 1e-3 * np.random.default_rng(3).normal(size=(9, 10)))
    run = check_bits(problem, (0, 1), starts, params=masses, method=EIPRKN8, h=0.02, members=[0, 8])
    assert len(np.unique(run.y[:, 0])) == 9


@njit
def with_a_branch(t, y, out):
    out[0] = y[1]
    out[1] = -y[0] if y[0] > 0 else -4 * y[0]


JITTED = [pytest.mark.slow, pytest.mark.needs_jit]
TWO = np.array([1.0, 0.5])
PLAIN = {"method": EIPRK4, "h": 0.05, "invariants": ()}
ONE_BY_ONE = [
    pytest.param(with_a_branch, TWO, 4, PLAIN | {"in_place": True}, "fun does not compile", marks=JITTED),
    pytest.param(jit_oscillator, TWO, 4, PLAIN | {"in_place": False}, "fun does not compile", marks=JITTED),
    (harmonic(), harmonic().y0, 1, {"method": EIPRK45, "first_step": 0.1}, "steps are adaptive"),
    (kepler(), kepler().y0, 0.2, {"method": EIPGJ14, "h": 0.02},
     "the run has fewer steps than the history of the method"),
]  # fmt: skip


@pytest.mark.parametrize(("fun", "y0", "end", "options", "why"), ONE_BY_ONE)
def test_what_runs_one_by_one(fun, y0, end, options, why):
    run = check_bits(fun, (0, end), spread_starts(y0, 9), **options)
    assert not run.side_by_side.any()
    assert run.one_by_one.startswith(why)


@njit
def explodes(t, y, out):
    out[0] = y[0] * y[0]
    out[1] = -y[1]


@pytest.mark.slow
@pytest.mark.needs_jit
def test_a_member_that_fails_disturbs_no_other():
    starts = np.ones((10, 2))
    starts[:, 0] = 0.1
    starts[3, 0], starts[7, 0] = 2.0, np.nan
    run = check_bits(
        explodes, (0, 5), starts, method=EIPRK4, h=0.01, in_place=True, invariants=(), save_every=100,
        members=[0, 1, 2, 3, 4, 9],
    )  # fmt: skip
    assert list(run.failed) == [3, 7]
    assert "non-finite" in run.message[3] or "no longer finite" in run.message[3]
    assert "nan" in run.message[7].lower() or "finite" in run.message[7]
    assert np.isnan(run.trajectories[3, 0, -1])
    assert not np.isnan(run.trajectories[3, 0, 0])
    assert list(np.flatnonzero(~run.side_by_side)) == [3, 7]


@njit(error_model="numpy")
def all_that_lanes_do(t, y, out):
    a, b, total = y[0], y[1], 0.0
    for i in range(y.size):
        total += y[i]
    out[0] = total - 0.1 * y[0]
    out[1] = 2 * a - b / 3 + (-b)
    out[2] = math.sqrt(abs(a)) + math.fabs(b)
    out[3] = max(a, b) * min(a, 0.5)
    out[4] = math.sin(a) + math.exp(-abs(b)) + math.atan2(a, b) + math.hypot(a, b)
    out[5] = abs(a) ** 1.3 + a**2 - b**3
    out[6] = 1
    out[6] += b
    out[7] = math.log1p(abs(a)) - math.copysign(math.pow(abs(b), 0.5), a)


@pytest.mark.slow
@pytest.mark.needs_jit
def test_lanes_are_floats():
    """All operations of functions of batches give the floats of each lane."""
    starts = np.random.default_rng(11).normal(size=(8, 8))
    run = check_bits(all_that_lanes_do, (0, 0.5), starts, method=EIPRK4, h=0.1, in_place=True, invariants=())
    assert run.side_by_side.all()


def test_any_number_of_bodies():
    """Every order of summation that the number of bodies brings with it, and frames of bodies."""
    for n in (2, 3, 5, 8, 11):
        rng = np.random.default_rng(n)
        problem = nbody(10.0 ** rng.uniform(-3, 0, n), rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), t_span=(0, 1))
        run = check_bits(problem, (0, 0.05), spread_starts(problem.y0, 9), method=EIPRK4, h=0.005)
        assert run.side_by_side.all()


@pytest.mark.parametrize(
    "options",
    [
        {"every": 7, "save_every": 7},
        {"t_eval": np.array([0.0, 0.001, 0.5, 0.5001, 2.9, 2.9999, 3.0])},
        {"every": 1, "save_every": 50},
        {"invariants": ()},
        {"metric": "euclidean", "kept": [1]},
    ],
    ids=lambda options: "-".join(options) or "defaults",
)
@pytest.mark.parametrize("method", [EIPGJ12, EIPGJ14])
def test_members_of_multistep_methods(method, options):
    problem = solar_system(years=100.0)
    starts = spread_starts(problem.y0, 11, size=1e-7)
    options = dict(options)
    if "kept" in options:
        options["invariants"] = [problem.invariants[k] for k in options.pop("kept")]
    run = check_bits(problem, (0, 3), starts, method=method, h=1 / 620, members=[0, 4, 7, 8, 10], **options)
    assert run.side_by_side.all()
    assert run.one_by_one == ""


def test_multistep_members_with_bodies_of_their_own():
    """Masses of each member, in some of which another body is the heaviest: that is what the Jacobian is of."""
    problem = solar_system(years=100.0)
    masses = problem.params * (1 + 1e-3 * np.random.default_rng(3).normal(size=(9, 10)))
    starts = spread_starts(problem.y0, 9, size=1e-7)
    check_bits(problem, (0, 2), starts, params=masses, method=EIPGJ14, h=1 / 412, members=[0, 4, 8])
    places, speeds = [[-0.5, 0, 0], [0.5, 0, 0], [9, 0, 0]], [[0, -0.7, 0], [0, 0.7, 0], [0, 0.46, 0]]
    pair = nbody([1.0, 0.9, 1e-3], places, speeds, t_span=(0, 40))
    weights = np.tile(pair.params, (8, 1))
    weights[1::2, :2] = weights[1::2, 1::-1]
    run = check_bits(pair, (0, 40), np.tile(pair.y0, (8, 1)), params=weights, method=EIPGJ14, h=0.02)
    assert run.side_by_side.all()


def test_a_multistep_member_that_fails_disturbs_no_other():
    """One starts with NaN, one has its orbit's pericentre where the step is not stable any more."""
    starts = spread_starts(kepler().y0, 10)
    starts[3, 0] = np.nan
    starts[6] = [1.6, 0.0, 0.0, 0.3]
    run = check_bits(
        kepler(), (0, 30), starts, method=EIPGJ14, h=0.02, save_every=100, members=[0, 1, 2, 4, 5, 6, 7, 9]
    )
    assert list(run.failed) == [3, 6]
    assert "not small" in run.message[6] or "projection failed" in run.message[6]
    assert list(np.flatnonzero(~run.side_by_side)) == [3, 6]


def test_multistep_members_tell_a_passage_at_whichever_step_it_comes():
    """No projection is made here: what looks at them in between ends those that it has to."""
    starts = spread_starts(kepler().y0, 16)
    for k in range(0, 16, 2):
        starts[k] = [(1 + k * 0.02) ** (2 / 3), 0.0, 0.0, 0.02]
    run = check_bits(kepler(), (0, 2), starts, method=EIPGJ12, h=0.005, invariants=(), save_every=10)
    assert list(run.failed) == list(range(0, 16, 2))
    assert list(np.flatnonzero(run.side_by_side)) == list(range(1, 16, 2))
    assert "not small" in run.message[0]


@pytest.mark.parametrize("together", [True, False], ids=["side by side", "one by one"])
def test_evaluations_of_multistep_members_do_not_depend_on_how_fast_the_machine_is(monkeypatch, together):
    """Calls of the engine that end anywhere, within the last states too."""
    monkeypatch.setattr(running, "FIRST_STEPS", 3)
    monkeypatch.setattr(running, "CALL_SECONDS", 0.0)
    if not together:
        monkeypatch.setattr(running, "not_batched_because", lambda *_: "a test")
    run = check_bits(kepler(), (0, 3.01), spread_starts(kepler().y0, 9), method=EIPGJ14, h=0.02)
    assert run.side_by_side.all() == together
