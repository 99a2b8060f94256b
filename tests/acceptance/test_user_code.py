"""The typed program in tests/typing runs, and uses all public names; mypy checks its types."""

import ast
import importlib.util
from pathlib import Path

import numpy as np
import pytest

import eip_scipy

PROGRAM = Path(__file__).parents[1] / "typing" / "user_code.py"


@pytest.fixture(scope="module")
def program():
    spec = importlib.util.spec_from_file_location("user_code", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_uses_all_public_names():
    used = {node.id for node in ast.walk(ast.parse(PROGRAM.read_text())) if isinstance(node, ast.Name)}
    assert set(eip_scipy.__all__) <= used


def test_it_runs(program, tmp_path):
    assert 0 < program.slow() < 1e-3
    residual, states, message, trusted = program.one_run()
    assert residual < 1e-14
    assert states.shape == (2, 11)
    assert (message, trusted) == ("The solver successfully reached the end of the integration interval.", True)
    assert program.long_run(tmp_path / "run.npz") > 4 * 334
    np.testing.assert_allclose(program.members()[:, 0], [0.600086, 0.277699], atol=1e-4)
    assert program.others() == []  # no polynomial
