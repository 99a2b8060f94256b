"""The right-hand side on arrays of other libraries: that of the equation, to round-off."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from test_docs import BLOCK

from eip_scipy import EIPRK4
from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap
from eip_scipy.problems.gross_pitaevskii import ArrayGrossPitaevskii

TESTS = Path(__file__).parent
needs_jax = pytest.mark.skipif(find_spec("jax") is None, reason="needs jax")
GRIDS = (Grid(24, -3, 4), Grid((16, 15), -3, 4), Grid((8, 9, 10), -3, 4))


def compare(xp, compiled=lambda fun: fun):
    """With and without rotation, in one to three dimensions, both treatments of the Nyquist mode."""
    for grid in GRIDS:
        for Omega in (0.0, 0.7)[: grid.dim]:
            for nyquist in ("true", "zero"):
                gpe = GrossPitaevskii(grid, harmonic_trap(*[1.2] * grid.dim), Omega=Omega, beta=3.0, nyquist=nyquist)
                y = np.random.default_rng(7).standard_normal(2 * grid.size).view(complex)
                found = compiled(ArrayGrossPitaevskii(gpe, xp).fun)(0.0, xp.asarray(y))
                assert found.__array_namespace__() is xp
                expected = gpe.fun(0.0, y)
                np.testing.assert_allclose(np.asarray(found), expected, rtol=0, atol=1e-14 * np.abs(expected).max())


def test_numpy():
    compare(np)


def test_the_standard():
    """A library that has nothing but what the standard says."""
    compare(pytest.importorskip("array_api_strict"))


def with_jax(code, **environment):
    """In a process of its own: the precision is a switch of the process, and JAX's threads do not go with forks."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=TESTS, env=os.environ | {"JAX_PLATFORMS": "cpu"} | environment,
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_jax
def test_jax_on_the_cpu():
    with_jax("import jax, test_array_api; test_array_api.compare(jax.numpy, jax.jit)", JAX_ENABLE_X64="1")


@needs_jax
def test_the_page():
    code, printed = (text for _, text in BLOCK.findall((TESTS.parent / "docs" / "gpu.md").read_text(encoding="utf-8")))
    assert with_jax(code) == printed


def test_single_precision_is_refused():
    single = SimpleNamespace(asarray=np.float32, float64=np.float64, __name__="single")
    with pytest.raises(ValueError, match=r"single made float32 of float64.*jax_enable_x64"):
        ArrayGrossPitaevskii(GrossPitaevskii(GRIDS[0]), single)


def test_steps():
    gpe = GrossPitaevskii(Grid((24, 24), -6, 6), harmonic_trap(1, 1), Omega=0.5, beta=10)
    x, y = gpe.grid.mesh()
    psi = ((x + 1j * y) * np.exp(-(x**2 + y**2) / 2)).ravel()
    options = {"method": EIPRK4, "h": 0.01, "metric": "euclidean", "invariants": gpe.invariants()}
    ends = [solve_ivp(fun, (0, 0.1), psi, **options).y[:, -1] for fun in (gpe.fun, ArrayGrossPitaevskii(gpe, np).fun)]
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-13)
