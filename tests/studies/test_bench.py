"""`eip-scipy bench`: equations against each other and closed forms, references, times at equal error, the report."""

from __future__ import annotations

import csv
import math
from importlib.util import find_spec

import mpmath
import numpy as np
import pytest
from pages import printed_tables
from scipy.integrate import solve_ivp

from eip_scipy_studies.bench.cases import CASES, INERTIA
from eip_scipy_studies.bench.measure import Measured, Run, everything, measure, seconds_at
from eip_scipy_studies.bench.report import markdown
from eip_scipy_studies.bench.solvers import SOLVERS
from eip_scipy_studies.cli import main

SINGLE = [case for case in CASES.values() if not case.members and not case.mechanism]
BY_NAME = {solver.name: solver for solver in SOLVERS}


@pytest.mark.parametrize("case", SINGLE, ids=lambda case: case.name)
def test_invariants_are_kept_by_the_equations(case):
    """grad I . f = 0 at the start and at the reference's end, by differences along f."""
    for y in (case.y0, case.end):
        f = case.plain.fun(0.0, y)
        step = 1e-6 / max(1.0, np.abs(f).max())
        for name, invariant in case.plain.invariants.items():
            values = [np.asarray(invariant(0.0, y + sign * step * f)) for sign in (1, -1)]
            assert np.abs(values[0] - values[1]).max() <= 1e-9 * (1 + np.abs(values[0]).max()), name


@pytest.mark.parametrize("case", [case for case in SINGLE if case.plain.acceleration], ids=lambda case: case.name)
def test_acceleration_is_that_of_the_equations(case):
    half = case.y0.size // 2
    np.testing.assert_allclose(case.plain.acceleration(0.0, case.y0[:half]), case.plain.fun(0.0, case.y0)[half:])


@pytest.mark.parametrize("case", SINGLE, ids=lambda case: case.name)
def test_reference_keeps_the_invariants(case):
    for invariant in case.plain.invariants.values():
        first, last = invariant(0.0, case.y0), invariant(0.0, case.end)
        np.testing.assert_allclose(last, first, rtol=1e-12, atol=1e-14)


def test_rigid_body_against_elliptic_functions():
    """Jacobi's solution in 30 digits, for L = (A, 0, C) with A < C and inverse inertias 1/2, 1, 3/2."""
    case = CASES["rigid body"]
    assert 1 / np.array(INERTIA) == pytest.approx([0.5, 1.0, 1.5])
    with mpmath.workdps(30):
        A, _, C = (mpmath.mpf(value) for value in case.y0)
        u, m = C * mpmath.mpf(case.t_end) / mpmath.sqrt(2), (A / C) ** 2
        sn, cn, dn = (mpmath.ellipfun(name, u, m=m) for name in ("sn", "cn", "dn"))
        exact = [float(value) for value in (A * cn, -mpmath.sqrt(2) * A * sn, C * dn)]
    np.testing.assert_allclose(case.end, exact, atol=3e-13)


@pytest.mark.parametrize("name", ["Hénon-Heiles", "double pendulum", "halo orbit", "Robertson", "magnet"])
def test_references_against_scipy(name):
    case = CASES[name]
    method, rtol, near = ("Radau", 1e-10, 1e-8) if case.stiff else ("DOP853", 1e-13, 3e-9)
    found = solve_ivp(case.plain.fun, (0, case.t_end), case.y0, method=method, rtol=rtol, atol=rtol * 1e-4)
    assert case.error(found.y[:, -1]) < near


def test_linkage_is_closed_at_its_reference():
    angles = np.cumsum(CASES["four-bar"].end)
    ends = np.array([0.8, 2.0, 1.0]) @ np.column_stack([np.cos(angles), np.sin(angles)])
    np.testing.assert_allclose(ends, [2.0, 0.0], atol=1e-13)


@pytest.mark.parametrize("case", [case for case in SINGLE if case.ready], ids=lambda case: case.name)
def test_ready_problems_are_the_same_equations(case):
    problem = case.ready()
    np.testing.assert_allclose(case.to_own(problem.y0), case.y0, rtol=1e-14, atol=1e-300)
    np.testing.assert_allclose(
        case.to_own(problem.fun(0.0, problem.y0)), case.plain.fun(0.0, case.y0), rtol=1e-12, atol=1e-14
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["EIPDOP853", "EIPRKN12", "EIPDOP853, hamiltonian", "EIPDOP853 in solve_ivp"])
def test_solvers_reach_the_reference(name):
    case = CASES["Hénon-Heiles"]
    setting = 1500 if BY_NAME[name].steps else 1e-11
    assert case.error(BY_NAME[name].prepare(case)(setting)) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("name", ["heyoka", "CyRK Vern8", "numbalsoda dop853", "diffrax Dopri8", "extensisq Pr9"])
def test_other_packages_reach_the_reference(name):
    """They run in a process of their own, as in the bench: JAX forbids this one to fork later."""
    if find_spec(name.split()[0]) is None:
        pytest.skip(f"needs {name.split()[0]}")
    (found,) = everything(("double pendulum",), (name,), 0.01, 2.0)
    assert min(run.error for run in found.runs) < 1e-8, found.said


@pytest.mark.parametrize("name", ["REBOUND IAS15", "REBOUND WHFast c17", "REBOUND TRACE", "REBOUND MERCURIUS"])
def test_rebound_follows_the_planets(name):
    case = CASES["ten bodies, 100 years"]
    setting = 8000 if BY_NAME[name].steps else 1e-9
    near = {"REBOUND IAS15": 1e-9, "REBOUND WHFast c17": 1e-7}.get(name, 1e-2)
    assert case.error(BY_NAME[name].prepare(case)(setting)) < near


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
@pytest.mark.slow
def test_command_writes_runs_and_page(tmp_path):
    assert main(["bench", "double pendulum", "--solvers", "SciPy DOP853", "--out", str(tmp_path), "--quiet"]) == 0
    rows = list(csv.DictReader((tmp_path / "bench.csv").read_text(encoding="utf-8").splitlines()))
    errors = [float(row["error"]) for row in rows]
    assert errors[0] > 1e-6
    assert errors[-1] < 1e-9
    assert "SciPy DOP853" in (tmp_path / "bench.md").read_text(encoding="utf-8")


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("group", ["eigenstates", "Hénon-Heiles", "Huber"])
def test_metric_on_the_page(group, tmp_path):
    (printed,) = (table[group] for table in printed_tables("explanation/metric.md") if group in table)
    assert main(["bench", "metric", "--only", group, "--out", str(tmp_path), "--quiet"]) == 0
    rows = list(csv.DictReader((tmp_path / "metric.csv").read_text(encoding="utf-8").splitlines()))
    own = [
        {key: float(row[key]) for key in ("none", "euclidean", "default", "ratio")}
        for row in rows
        if row["group"] == group
    ]
    assert int(printed[0]) == len(own)
    for key, cell in zip(("none", "euclidean", "default"), printed[1:4], strict=True):
        assert float(cell) == pytest.approx(math.exp(np.mean([math.log(row[key]) for row in own])), rel=0.1)
    ratios = np.array([row["ratio"] for row in own])
    assert float(printed[4]) == pytest.approx(ratios.max(), rel=0.3)
    assert [abs(int(cell) - (ratios > bar).sum()) <= 2 for cell, bar in zip(printed[5:], (1.5, 5), strict=True)] == [
        True,
        True,
    ]
