"""The stub that type checkers read describes the engine as it is."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytest.importorskip("nanobind", reason="the stub is written by nanobind")


def test_the_stub_is_that_of_the_engine():
    found = runpy.run_path(str(ROOT / ".ci" / "stub"))
    assert found["STUB"].read_text(encoding="utf-8") == found["stub"](), "write it anew by .ci/stub"
