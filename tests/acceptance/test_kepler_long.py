"""The perturbed Kepler problem with h = 0.03 to t = 1e5 (16 000 revolutions, 3.3 million steps): no drift."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import linregress

from eip_scipy import EIPRK4, EIPRK5, integrate
from eip_scipy.problems import kepler

pytestmark = [pytest.mark.nightly, pytest.mark.needs_jit]
PROBLEM = kepler()
T, H = 1e5, 0.03
SAVE_EVERY = 97  # 34 000 states; no common factor with the 209 steps of a revolution
SETTINGS = {"paper": {"metric": "euclidean", "reuse_f": False}, "default": {}}


@cache
def run(method, setting, kept="HL"):
    options = {"method": method, "h": H, "save_every": SAVE_EVERY, **SETTINGS[setting]}
    invariants = [item for item in PROBLEM.invariants if item.name in kept]
    return integrate(PROBLEM, (0, T), invariants=invariants, **options)


def values(result):
    """Return H and L at the saved states, also if they are not kept."""
    q1, q2, p1, p2 = result.y
    r = np.hypot(q1, q2)
    return np.array([0.5 * (p1**2 + p2**2) - 1 / r - 0.0025 / r**3, q1 * p2 - q2 * p1])


# Largest residuals of H and L over all steps. RK4's are the truncation error O(h^10) at the pericentre, and as such
# reproducible; RK5's in the paper's metric are round-off. The first and the third line are the figures to be met.
@pytest.mark.parametrize(
    ("method", "setting", "largest"),
    [
        (EIPRK4, "paper", (9.4e-13, 3.4e-14)),
        (EIPRK4, "default", (1.06e-12, 2.8e-14)),
        (EIPRK5, "paper", (5.8e-15, 1.8e-15)),
        (EIPRK5, "default", (2.0e-15, 1.8e-15)),
    ],
)
def test_residuals_are_stationary(method, setting, largest):
    """There is no slope within 3 standard errors, and its possible sum over the run is below the residuals' spread."""
    result = run(method, setting)
    assert result.compiled
    assert result.diagnostics.n_rank_reduced == 0
    roundings = 4 * np.finfo(float).eps  # one more or less of those that remain
    assert result.max_residual == pytest.approx(largest, rel=0.05, abs=roundings)
    residuals = result.invariants - result.invariants[:, :1]
    fits = [linregress(result.t, row) for row in residuals]
    slope, stderr = (np.array([getattr(fit, name) for fit in fits]) for name in ("slope", "stderr"))
    assert (np.abs(slope) < 3 * stderr).all()
    assert ((np.abs(slope) + 3 * stderr) * T < 0.5 * residuals.std(axis=1)).all()


@pytest.mark.parametrize(("kept", "other"), [("H", 1), ("L", 0)])
def test_the_invariant_that_is_not_kept_drifts(kept, other):
    """The check for drift is meaningful: the paper's EIP-H and EIP-L fail the same test by orders of magnitude."""
    result = run(EIPRK4, "paper", kept=kept)
    residuals = values(result)
    residuals = residuals - residuals[:, :1]
    fit = linregress(result.t, residuals[other])
    assert abs(fit.slope) > 50 * fit.stderr
    assert abs(fit.slope) * T > 1e6 * np.abs(residuals[1 - other]).max()
