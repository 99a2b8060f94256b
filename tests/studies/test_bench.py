"""`eip-scipy bench`: equations against each other and closed forms, references, times at equal error, the report."""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
import pytest
from pages import printed_tables, read_rows
from scipy.integrate import solve_ivp

from eip_scipy_studies.bench.cases import CASES
from eip_scipy_studies.bench.measure import Measured, Run, everything, measure, seconds_at
from eip_scipy_studies.bench.report import markdown
from eip_scipy_studies.bench.solvers import SOLVERS
from eip_scipy_studies.cli import main

SINGLE = [case for case in CASES.values() if not case.members and not case.mechanism]
BY_NAME = {solver.name: solver for solver in SOLVERS}
SLOW = pytest.mark.slow


@pytest.mark.parametrize("case", SINGLE, ids=lambda case: case.name)
def test_a_case_is_one_system_in_all_its_forms(case):
    """Its invariants are constant along f, by differences, and at the reference's end."""
    plain, y0 = case.plain, case.y0
    for name, invariant in plain.invariants.items():
        np.testing.assert_allclose(invariant(0.0, case.end), invariant(0.0, y0), rtol=1e-12, atol=1e-14)
        for y in (y0, case.end):
            f = plain.fun(0.0, y)
            step = 1e-6 / max(1.0, np.abs(f).max())
            values = [np.asarray(invariant(0.0, y + sign * step * f)) for sign in (1, -1)]
            assert np.abs(values[0] - values[1]).max() <= 1e-9 * (1 + np.abs(values[0]).max()), name
    if plain.acceleration:
        half = y0.size // 2
        np.testing.assert_allclose(plain.acceleration(0.0, y0[:half]), plain.fun(0.0, y0)[half:])
    if case.ready:
        problem = case.ready()
        np.testing.assert_allclose(case.to_own(problem.y0), y0, rtol=1e-14, atol=1e-300)
        f = case.to_own(problem.fun(0.0, problem.y0))
        np.testing.assert_allclose(f, plain.fun(0.0, y0), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ["Hénon-Heiles", "rigid body", "double pendulum", "halo orbit", "Robertson", "magnet"])
def test_references_against_scipy(name):
    case = CASES[name]
    method, rtol, near = ("Radau", 1e-10, 1e-8) if case.stiff else ("DOP853", 1e-13, 3e-9)
    found = solve_ivp(case.plain.fun, (0, case.t_end), case.y0, method=method, rtol=rtol, atol=rtol * 1e-4)
    assert case.error(found.y[:, -1]) < near


@pytest.mark.parametrize(
    ("case", "name", "setting", "near"),
    [
        pytest.param("Hénon-Heiles", "EIPDOP853", 1e-11, 1e-8, marks=SLOW),
        pytest.param("Hénon-Heiles", "EIPRKN12", 1500, 1e-8, marks=SLOW),
        pytest.param("Hénon-Heiles", "EIPDOP853, hamiltonian", 1e-11, 1e-8, marks=SLOW),
        pytest.param("Hénon-Heiles", "EIPDOP853 in solve_ivp", 1e-11, 1e-8, marks=SLOW),
        ("ten bodies, 100 years", "REBOUND IAS15", 1e-9, 1e-9),
        ("ten bodies, 100 years", "REBOUND WHFast c17", 8000, 1e-7),
        ("ten bodies, 100 years", "REBOUND TRACE", 8000, 1e-2),
        ("ten bodies, 100 years", "REBOUND MERCURIUS", 8000, 1e-2),
    ],
)
def test_solvers_reach_the_reference(case, name, setting, near):
    assert CASES[case].error(BY_NAME[name].prepare(CASES[case])(setting)) < near


@pytest.mark.slow
@pytest.mark.parametrize("name", ["heyoka", "CyRK Vern8", "numbalsoda dop853", "diffrax Dopri8", "extensisq Pr9"])
def test_other_packages_reach_the_reference(name):
    """They run in a process of their own, as in the bench: JAX forbids this one to fork later."""
    if find_spec(name.split()[0]) is None:
        pytest.skip(f"needs {name.split()[0]}")
    (found,) = everything(("double pendulum",), (name,), 0.01, 2.0)
    assert min(run.error for run in found.runs) < 1e-8, found.said


def test_seconds_at_equal_error():
    runs = [Run("", "", 0, 1.0, 1e-4), Run("", "", 0, 4.0, 1e-8)]
    assert seconds_at(runs, 1e-6) == (pytest.approx(2.0), False)
    assert seconds_at(runs, 1e-3) == (1.0, True)
    assert math.isnan(seconds_at(runs, 1e-9)[0])
    assert seconds_at([Run("", "", 0, 1.0, math.inf), runs[1]], 1e-6) == (4.0, True)


def test_first_come_the_losses():
    def made(solver, *seconds, said=""):
        runs = [Run("Hénon-Heiles", solver, 1, s, e) for s, e in zip(seconds, (2e-6, 1e-6, 1e-9), strict=False)]
        return Measured("Hénon-Heiles", solver, "1.0", 0.5, runs, said)

    page = markdown(
        [made("EIPDOP853", 1, 1, 2), made("heyoka", 0.4, 0.5, 0.5), made("SciPy RK45", 9, 9, said="Error: why")], "here"
    )
    lost = page.index("error 1e-09: heyoka is 4 times faster")
    assert lost < page.index("error 1e-06: heyoka is 2 times faster") < page.index("## Hénon-Heiles")
    assert "- SciPy RK45: Error: why" in page


def test_a_package_that_fails_is_a_row():
    """heyoka gets a system that it does not take: its error is the answer."""
    found = measure("Lennard-Jones", "heyoka", 0.1, 0.1)
    assert found.runs == []
    assert found.said


@pytest.mark.nightly
def test_command_writes_runs_and_page(tmp_path):
    assert main(["bench", "double pendulum", "--solvers", "SciPy DOP853", "--out", str(tmp_path), "--quiet"]) == 0
    rows = read_rows(tmp_path / "bench.csv")
    errors = [float(row["error"]) for row in rows]
    assert errors[0] > 1e-6
    assert errors[-1] < 1e-9
    assert "SciPy DOP853" in (tmp_path / "bench.md").read_text(encoding="utf-8")


@pytest.mark.nightly
@pytest.mark.parametrize("group", ["eigenstates", "Hénon-Heiles", "Huber"])
def test_metric_on_the_page(group, tmp_path):
    (printed,) = (table[group] for table in printed_tables("explanation/metric.md") if group in table)
    assert main(["bench", "metric", "--only", group, "--out", str(tmp_path), "--quiet"]) == 0
    own = [row for row in read_rows(tmp_path / "metric.csv") if row["group"] == group]
    assert int(printed[0]) == len(own)
    *means, ratios = (np.array([float(row[key]) for row in own]) for key in ("none", "euclidean", "default", "ratio"))
    assert [float(x) for x in printed[1:4]] == pytest.approx([np.exp(np.log(x).mean()) for x in means], rel=0.1)
    assert float(printed[4]) == pytest.approx(ratios.max(), rel=0.3)
    assert all(abs(int(cell) - (ratios > bar).sum()) <= 2 for cell, bar in zip(printed[5:], (1.5, 5), strict=True))
