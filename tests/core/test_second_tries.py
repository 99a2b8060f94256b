"""Corrections that are refused or fail: softer weights, try by try, then one direction less."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import (
    EIPDOP853,
    EIPRK2,
    EIPRK3,
    EIPRK4,
    EIPRK23,
    EIPRK45,
    Balance,
    Diagnostics,
    Invariant,
    eip_method,
    integrate,
    project,
)
from eip_scipy.problems import kepler

EPS = np.finfo(float).eps
RTOL, STEP = 1e-3, 0.5
KAPPA, FLOOR = EIPRK4.TABLEAU.kappa, 1e-7
HEALTHY, TRIES = 5.0, 3


# Softer weights.


class Case:
    """A state at rest, an invariant that moves away from it by `defect` in the step, and an error estimate at will."""

    def __init__(self, slope, bend, defect, err, blocks=None, kind=float):
        self.slope, self.bend, self.defect, self.blocks = np.array(slope), bend, defect, blocks
        self.err, self.y = np.array(err), np.ones(len(slope), dtype=kind)
        self.evaluated = []

    def value(self, t, y):
        self.evaluated.append(y.copy())
        d = (y - self.y).real
        return self.slope @ d + self.bend * d[0] ** 2 + self.defect * t / STEP

    def gradient(self, t, y):
        out = self.slope.astype(self.y.dtype)
        out[0] += 2 * self.bend * (y - self.y)[0]
        return out

    def run(self):
        err = self.err.astype(self.y.dtype)

        class Given:
            order, error_estimator_order = 4, 3

            def one_step(self, t, y, h):
                return y, err

        self.evaluated.clear()
        diagnostics = Diagnostics()
        options = {"h": STEP, "rtol": RTOL, "atol": 0.0, "blocks": self.blocks, "check": False}
        keep = Invariant(self.value, self.gradient)
        options |= {"method": eip_method(Given()), "invariants": keep, "diagnostics": diagnostics}
        sol = solve_ivp(lambda t, y: 0 * y, (0, STEP), self.y, **options)
        return sol, diagnostics

    def lists(self):
        known = [] if self.blocks is None else [list(b) for b in self.blocks]
        used = {i for b in known for i in b}
        return known + [[i] for i in range(self.y.size) if i not in used]

    def tries(self):
        """Return the corrected states, one for each try."""
        lists, alone = self.lists(), self.blocks is None
        scale = np.array([RTOL * np.linalg.norm(self.y[b]) for b in lists])
        estimate = np.array([np.linalg.norm(self.err[b]) for b in lists])
        r = np.hypot(estimate, EPS * scale / RTOL) / scale
        weight = scale * ((r / r.max()) ** KAPPA + FLOOR)
        weight /= weight.max()
        states = []
        for _ in range(1 + TRIES):
            sigma = np.zeros(self.y.size)
            for b, w in zip(lists, weight, strict=True):
                sigma[b] = w
            direction = sigma**2 * self.slope
            move = -self.defect * direction / (self.slope @ direction)
            states.append(self.y + move)
            failed = abs(self.bend) * move[0] ** 2 > abs(self.defect)
            correction = max(np.linalg.norm(move[b]) / s for b, s in zip(lists, scale, strict=True)) / r.max()
            if not failed and not (alone and correction > HEALTHY):
                return states, True
            weight = np.where(estimate > 0, np.sqrt(weight * scale / scale.max()), weight)
        return states, not failed


def check(case, tries, good=True):
    sol, diagnostics = case.run()
    expected, done = case.tries()
    assert (len(expected), done) == (tries, good)
    assert sol.success == good
    after_start = [y for y in case.evaluated if not np.array_equal(y, case.y)]
    assert len(after_start) == tries
    np.testing.assert_allclose(after_start, expected, rtol=0, atol=1e-9 * abs(case.defect))
    assert diagnostics.n_softened == (tries > 1)
    if good:
        np.testing.assert_array_equal(sol.y[:, -1], after_start[-1])


@pytest.mark.parametrize("kind", [float, complex])
@pytest.mark.parametrize(("factor", "tries"), [(0.0049, 1), (0.0053, 2), (1.5, 3), (2.0, 4), (20.0, 4)])
def test_components_alone_soften_until_the_correction_is_healthy(factor, tries, kind):
    """The second component, with nearly all of the gradient, has an estimate a million times smaller."""
    check(Case([1e-3, 1.0], 0.0, factor * 1e-6, [1e-6, 1e-12], kind=kind), tries)


@pytest.mark.parametrize(
    ("bend", "tries", "good"), [(0.4, 1, True), (0.55, 2, True), (1e4, 3, True), (1e5, 4, True), (1e10, 4, False)]
)
def test_blocks_soften_where_the_correction_fails(bend, tries, good):
    """A curved invariant leaves a residual above the previous one."""
    check(Case([1e-3, 0.0, 1.0], bend, 2e-6, [1e-6, 1e-6, 1e-12], blocks=[[0, 1]]), tries, good)


def test_components_without_any_error_keep_their_weight():
    """The third is never touched, by the floor of its weight."""
    case = Case([1e-3, 1.0, 1.0], 0.0, 2e-6, [1e-6, 1e-12, 0.0])
    check(case, 4)
    assert abs(case.run()[0].y[2, -1] - 1) < 1e-15


# One direction less.


def bent(slopes, bend, target, along):
    """I = slopes . y + bend y_along^2."""
    slopes = np.array(slopes)

    def gradient(t, y):
        out = slopes.copy()
        out[along] += 2 * bend * y[along]
        return out

    return Invariant(lambda t, y: slopes @ y + bend * y[along] ** 2, gradient, target=target)


def place(k, bend=0.0):
    """The coordinate k itself."""
    return bent(np.eye(3)[k], bend, 0.0, k)


@pytest.mark.filterwarnings("ignore:the projection left:eip_scipy.ProjectionWarning")  # what is left out stays
@pytest.mark.parametrize(("slope", "bend"), [(1e-3, 1.0), (0.2, 1e3)])
def test_the_last_direction_is_left_out(slope, bend):
    """A step of 5e-4 / slope along y1 increases the second invariant's residual by its curvature: y1 is not moved."""
    nearly = bent([1.0, slope, 0.0], bend, -0.5e-3, along=1)
    result = project([1e-3, 0.0, 0.0], [place(0), nearly])
    assert result.rank == 1
    np.testing.assert_allclose(result.y, 0.0, atol=1e-18)
    np.testing.assert_allclose(result.defect, [0.0, 0.5e-3], atol=1e-18)
    three = project([1e-3, 0.0, 2e-3], [place(0), nearly, place(2)])
    assert three.rank == 2
    np.testing.assert_allclose(three.y, 0.0, atol=1e-18)


@pytest.mark.filterwarnings("ignore:the projection left:eip_scipy.ProjectionWarning")
def test_what_is_left_may_not_exceed_the_defects_of_all():
    """Defects of 1.0e-3 and 1.5e-3: the second may become 5.0e-3, twice their sum. It is 0.5e-3 + rise 1e-6."""

    def nearly(rise):
        return Invariant(
            lambda t, y: y[0] + 1e-3 * y[1] + y[1] ** 2 + rise * (y[0] - 1e-3) ** 2,
            lambda t, y: np.array([1.0 + 2 * rise * (y[0] - 1e-3), 1e-3 + 2 * y[1], 0.0]),
            target=-0.5e-3,
        )

    assert project([1e-3, 0.0, 0.0], [place(0), nearly(4.4e3)]).rank == 1
    with pytest.raises(ValueError, match=r"invariant 'invariant 1', residual 0\.0051, rank 1 of 2"):
        project([1e-3, 0.0, 0.0], [place(0), nearly(4.6e3)])
    with pytest.raises(ValueError, match="rank 1 of 1"):  # a single direction is not left out
        project(np.zeros(3), bent([1e-3, 0.0, 0.0], 1e3, 1.0, along=0))


# All options together.


@pytest.mark.parametrize("method", [EIPRK2, EIPRK3, EIPRK23])
@pytest.mark.parametrize(
    "options",
    [
        {"compensated": True, "iterations": 2, "rtol": 1e-5, "atol": 1e-5},
        {"compensated": True, "iterations": 2, "h": 0.03},
        {"compensated": True, "h": 0.03},
        {"direction": "old", "h": 0.03},
        {"direction": "midpoint", "h": 0.03},
    ],
)
def test_a_circular_orbit_is_followed_with_other_options_too(method, options):
    problem = kepler(0.0, relativistic=0.0)
    run = integrate(problem, (0, 20), method=method, **({"blocks": 1} if "compensated" in options else {}), **options)
    assert (run.status, run.trusted) == (0, True)
    assert np.abs(run.y[:, -1] - problem.reference(20.0)).max() < 5e-3
    assert (run.max_defect < 2e-6).all()


@pytest.mark.parametrize("method", [EIPRK23, EIPRK45, EIPDOP853])
def test_targets_that_contradict_each_other_end_the_run(method):
    """With drag an orbit of this angular momentum has no such energy; steps of 1e-12 would stay near the targets."""
    drag, problem = 1e-3, kepler(0.0, relativistic=0.0)

    def fun(t, y):
        return problem.fun(t, y) - drag * np.concatenate([[0, 0], y[2:]])

    def energy(t, y):
        return 0.5 * (y[2:] @ y[2:]) - 1 / np.sqrt(y[:2] @ y[:2])

    kept = [Balance(energy, lambda t, y: -drag * (y[2:] @ y[2:])), problem.invariants[1]]
    with pytest.warns(UserWarning, match="not an invariant of this system"):
        run = integrate(fun, (0, 100), problem.y0, method=method, rtol=1e-7, atol=1e-8, invariants=kept)
    assert run.status == -1
    assert "projection failed" in run.message
    assert run.nfev < 100_000
