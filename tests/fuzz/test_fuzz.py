"""A short part of `python -m tests.fuzz.systems` and of `python -m tests.fuzz.kills`, always the same."""

import pytest

from . import kills, systems

pytestmark = pytest.mark.needs_jit  # interpreted kernels would take minutes


@pytest.mark.slow
@pytest.mark.parametrize("seed", [12, 16, *(pytest.param(k, marks=pytest.mark.nightly) for k in (0, 4, 8))])
def test_random_systems(seed, capsys):
    assert systems.main(["--seed", str(seed), "--count", "4"]) == 0, capsys.readouterr().out


@pytest.mark.posix
@pytest.mark.slow
def test_runs_are_killed(capsys):
    """Some of each of the five kinds."""
    assert kills.main(["--kills", "6"]) == 0, capsys.readouterr().out
