"""Corrections that fail are tried again with one direction less."""

import numpy as np
import pytest

from eip_scipy import (
    EIPDOP853,
    EIPRK2,
    EIPRK3,
    EIPRK23,
    EIPRK45,
    Balance,
    Invariant,
    integrate,
    project,
)
from eip_scipy.problems import kepler

EPS = np.finfo(float).eps


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
    np.testing.assert_allclose(result.residual, [0.0, 0.5e-3], atol=1e-18)
    three = project([1e-3, 0.0, 2e-3], [place(0), nearly, place(2)])
    assert three.rank == 2
    np.testing.assert_allclose(three.y, 0.0, atol=1e-18)


@pytest.mark.filterwarnings("ignore:the projection left:eip_scipy.ProjectionWarning")
def test_what_is_left_may_not_exceed_the_residuals_of_all():
    """Residuals of 1.0e-3 and 1.5e-3: the second may become 5.0e-3, twice their sum. It is 0.5e-3 + rise 1e-6."""

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
    assert (run.max_residual < 2e-6).all()


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
