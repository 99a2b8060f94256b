"""Thresholds of the library that tests of problems change."""

import math

import pytest

from eip_scipy.problems.gravity import forces


@pytest.fixture
def approximate_invariants(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the invariants of the equations of Einstein, Infeld and Hoffmann however little they are kept."""
    monkeypatch.setattr(forces, "KEPT", math.inf)
