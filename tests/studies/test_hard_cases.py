"""The hard cases: gradients, invariance, the bars of ``eip-scipy hard-cases``; the paper's figures; work, precision."""

import csv
import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import Invariant, check_gradient
from eip_scipy_studies.cli import main
from eip_scipy_studies.hard import cases as command
from eip_scipy_studies.hard_cases import EQUATIONS, hard_cases
from eip_scipy_studies.paper import reproduce
from eip_scipy_studies.study import Check, Study
from eip_scipy_studies.work_precision import cost_to_reach

CASES = hard_cases()
PNG = b"\x89PNG\r\n\x1a\n"
FEW = ("euler_detest", "kepler_e00", "three_wave")


def states(case):
    """Return states on the solution and off it."""
    rng = np.random.default_rng(7)
    y = case.problem.y0
    noise = 0.01 * (np.abs(y) + 0.01 * np.abs(y).max()) * rng.standard_normal(y.size)
    return {"start": y, "end": case.end, "off": y + noise}


def named(cases):
    return pytest.mark.parametrize("case", cases, ids=lambda case: case.name)


# --- the cases ---


def test_there_are_35_and_each_family_serves():
    assert len(CASES) == len({case.name for case in CASES}) == 35
    assert len(EQUATIONS) == 27


@named(CASES)
def test_case_is_whole(case):
    problem = case.problem
    n, rows = problem.y0.size, len(case.invariant_names)
    assert problem.y0.shape == case.end.shape == problem.fun(0.0, problem.y0).shape == (n,)
    assert problem.y0.dtype == case.end.dtype == problem.fun(0.0, problem.y0).dtype
    assert problem.invariants[0].fun(0.0, problem.y0).shape == (rows,)
    assert problem.invariants[0].grad(0.0, problem.y0).shape == (rows, n)
    assert set(case.weak) <= set(case.invariant_names)
    assert case.title
    assert problem.source
    assert np.array_equal(problem.reference(problem.t_span[1]), case.end)
    assert problem.reference(0.5 * problem.t_span[1]) is None


@named(CASES)
def test_gradient(case):
    where = {"away": np.array([0.5, 0.6, 0.1, -0.3])}  # the orbit's ends are so near the Moon that differences pass it
    for y in (where if case.name == "arenstorf" else states(case)).values():
        assert check_gradient(case.problem.invariants[0], 0.3, y, case.problem.fun) < 1e-7


@named(CASES)
def test_invariance(case):
    """Strong invariants are constant along the flow from any state, weak ones on their manifold."""
    (invariant,), fun = case.problem.invariants, case.problem.fun
    strong = np.array([name not in case.weak for name in case.invariant_names])
    for where, y in states(case).items():
        products = np.conj(invariant.grad(0.3, y)) * fun(0.3, y)
        rates, terms = np.abs(products.real.sum(axis=1)), np.abs(products).sum(axis=1)
        noise = 1e-13 * (terms + terms.max())
        kept = strong if where == "off" else np.ones_like(strong)
        assert (rates[kept] <= noise[kept]).all()
        if where == "off" and case.weak:
            assert (rates[~strong] > 1e3 * noise[~strong]).all()


@named(CASES)
def test_end_lies_on_the_manifold(case):
    assert case.drift(np.stack([case.problem.y0, case.end], axis=1)) < 1e-10


@named([case for case in CASES if case.growth < 100])
def test_end_is_the_solutions(case):
    """SciPy's DOP853 at a tight tolerance, without any code of the package, reaches the same end."""
    sol = solve_ivp(case.problem.fun, case.problem.t_span, case.problem.y0, method="DOP853", rtol=1e-11, atol=1e-13)
    assert case.error(sol.y[:, -1]) < 1e-7


def test_unknown_name():
    with pytest.raises(ValueError, match="no hard case 'kepler'; there are kepler_e00, "):
        hard_cases(["kepler"])


def test_drift_is_relative_and_sees_the_largest_change():
    (case,) = hard_cases(["euler_detest"])
    moved = case.problem.y0 * 1.001
    assert case.drift(np.stack([case.problem.y0, moved, case.problem.y0], axis=1)) == pytest.approx(0.002001, rel=1e-6)


# --- the bars ---


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("method", "rtol"), [("EIPRK45", 1e-6), ("EIPDOP853", 1e-9)])
def test_bars(method, rtol):
    results = command.compare(CASES, command.adaptive_methods()[method], rtol, "error")
    checks = command.bars(results, method, rtol, "error")
    assert len(checks) == 5
    assert [check.text for check in checks if not check.passed] == []
    assert {result.case.name for result in results if result.gain < 0.5} <= set(command.CAUSES)


def outcome(error=1e-8, drift=1e-13, failure=""):
    return command.CaseOutcome(math.nan if failure else error, drift, 10, 70, failure)


def made_up(**projected):
    """Return 35 comparisons in which projection gains 100, except for one."""
    good = [command.Comparison(case, outcome(1e-6), outcome()) for case in CASES]
    return [command.Comparison(CASES[0], outcome(1e-8), outcome(**projected)), *good[1:]]


@pytest.mark.parametrize(
    ("method", "rtol", "results", "missed"),
    [
        ("EIPRK45", 1e-6, made_up(), []),
        ("EIPRK45", 1e-6, made_up(failure="boom"), ["every run", "no error more than 3 times"]),
        ("EIPRK45", 1e-6, made_up(error=4e-8), ["no error more than 3 times"]),
        ("EIPDOP853", 1e-9, made_up(error=1.1e-7), ["no error above 1e-7"]),
        ("EIPDOP853", 1e-9, made_up(error=4e-8), []),
        ("EIPRK23", 1e-6, made_up(error=1.0, drift=1.0), []),
    ],
)
def test_each_bar_can_fail(method, rtol, results, missed):
    found = [check.text for check in command.bars(results, method, rtol, "error") if not check.passed]
    assert len(found) == len(missed)
    assert all(text.startswith(start) for text, start in zip(found, missed, strict=True))


def test_bars_on_drift_and_mean_can_fail():
    worse = [replace(r, projected=outcome(1e-7, 2e-9)) for r in made_up()]
    found = [check.passed for check in command.bars(worse, "EIPRK45", 1e-6, "error")]
    assert found == [True, False, False, False, False]
    assert [c.passed for c in command.bars(worse, "EIPRK45", 1e-6, "euclidean")] == [True, False, False]


def test_a_case_that_raises_is_an_outcome():
    (case,) = hard_cases(["oscillator"])

    def bad(t, y):
        raise RuntimeError("no such state")

    broken = replace(case, problem=replace(case.problem, fun=bad))
    result = command.solve(broken, command.adaptive_methods()["EIPRK45"], 1e-6, "error")
    assert result.failure == "RuntimeError: no such state"
    assert math.isnan(result.error)


@pytest.mark.filterwarnings("ignore:.*not to be trusted:eip_scipy.ProjectionWarning")
def test_projection_on_a_wrong_invariant_shows():
    """The comparison measures what it claims: a false invariant makes the error worse."""
    (case,) = hard_cases(["oscillator"])
    wrong = Invariant(lambda t, y: np.array([y[0] ** 2 + 2 * y[1] ** 2]), lambda t, y: np.array([[2 * y[0], 4 * y[1]]]))
    case = replace(case, problem=replace(case.problem, invariants=(wrong,)))
    (result,) = command.compare([case], command.adaptive_methods()["EIPRK45"], 1e-6, "error")
    assert result.gain < 1e-3
    assert len(result.nearby) == 3


# --- the command ---


def test_command_prints_and_writes(tmp_path, capsys):
    arguments = ["--method", "EIPDOP853", "--out", str(tmp_path), "--json", str(tmp_path / "run.json")]
    status = main(["hard-cases", *arguments], cases=hard_cases(FEW))
    out = capsys.readouterr().out
    assert max(map(len, out.replace(str(tmp_path), "").splitlines())) <= 79
    assert "kepler_e00" in out
    assert "Cases that get worse, and why:" in out
    assert "phase lag" in out
    assert status == 1  # of these three the geometric mean is below the bar
    assert "FAILED geometric mean" in out
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["arguments"] == {"method": "EIPDOP853", "rtol": 1e-9, "atol": pytest.approx(1e-12), "metric": "error"}
    assert [line["case"] for line in run["cases"]] == list(FEW)
    assert [check["passed"] for check in run["checks"]] == [True, True, True, False, True]
    with open(tmp_path / "hard-cases-EIPDOP853-error.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[1]["gain"]) == run["cases"][1]["gain"] < 1
    assert run["cases"][1]["rank_reduced"] > 100
    assert (tmp_path / "hard-cases-EIPDOP853-error.png").read_bytes().startswith(PNG)


def test_a_case_without_known_cause_is_judged_by_its_neighbours():
    case = next(case for case in CASES if case.name not in command.CAUSES)
    plain, projected = (command.CaseOutcome(error, drift=0.0, steps=1, nfev=1) for error in (1e-6, 2e-6))
    worse = command.Comparison(case, plain, projected, nearby=(1.5, 1.5, 0.1))
    assert "scatter" in command.cause(worse)  # 0.5 * 1.5 * 1.5 > 1; the third is the euclidean metric's
    assert "not known" in command.cause(replace(worse, nearby=(1.5, 1.2, 9.0)))


def test_other_settings_have_no_bars_but_success(tmp_path, capsys):
    arguments = ["--method", "EIPRK23", "--rtol", "1e-4", "--metric", "euclidean", "--out", str(tmp_path)]
    assert main(["hard-cases", *arguments], cases=hard_cases(FEW)) == 0
    out = capsys.readouterr().out
    assert out.count("\nok     ") == 1
    assert "rtol = 0.0001, atol = 1e-07" in out


@pytest.mark.parametrize("rtol", ["0", "-1", "nan", "one", "1e-20"])
def test_wrong_rtol(rtol, capsys):
    assert main(["hard-cases", f"--rtol={rtol}"]) == 2
    assert "expected a number from 1e-13 to 0.1" in capsys.readouterr().err


# --- the paper's figures, work and precision ---


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_figures_of_the_kepler_problem(tmp_path, capsys):
    status = main(["reproduce", "fig-kepler", "--out", str(tmp_path), "--json", str(tmp_path / "run.json")])
    assert status == 0
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["passed"]
    assert [check["matched"] for check in run["fig-kepler"]["checks"]] == [True] * 4
    for name in ("fig-kepler-1.png", "fig-kepler-2.png"):
        assert (tmp_path / name).read_bytes().startswith(PNG)
    assert capsys.readouterr().out.count("\nok     ") == 4
    with open(tmp_path / "fig-kepler.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    last = {row["method"]: row for row in rows}
    # Kept invariants prove nothing about the orbit: RK2's is lost, RK5's is not.
    assert float(last["EIP-HL, RK2"]["position_error"]) > 0.5
    assert float(last["EIP-HL, RK5"]["position_error"]) < 1e-3
    assert float(last["EIP-HL, RK2"]["energy_error"]) < 1e-7


@dataclass(frozen=True, kw_only=True)
class Noted(Study):
    """Study in place of a long one; it records where it ran."""

    seen: list
    passed: bool = True

    def measure(self, session):
        self.seen.append((session.name, session.out, session.json))

    def text(self, found):
        return "a table"

    def numbers(self, found):
        return {"cells": [], "orders": [], "checks": ["one"]}

    def checks(self, found):
        return [Check("one", self.passed)]


def test_solar_figures_come_from_the_command(tmp_path):
    seen = []
    studies = {"fig-solar": lambda words: seen.append(words) or 1}
    assert main(["reproduce", "fig-solar", "--out", str(tmp_path), "--quiet"], studies=studies) == 1
    assert seen == [["--cost", "--out", str(tmp_path), "--json", str(tmp_path / "solar-system.json"), "--quiet"]]


def test_all_means_all(tmp_path):
    seen = []
    studies = dict.fromkeys(reproduce.STUDIES, lambda: Noted(seen=seen)) | {"fig-solar": lambda words: 0}
    assert main(["reproduce", "all", "--out", str(tmp_path), "--quiet"], studies=studies) == 0
    assert [name for name, *_ in seen] == [n for n in reproduce.STUDIES if n != "fig-solar"]


def test_cost_to_reach():
    errors = np.array([1, 1e-2, 1e-4])
    assert cost_to_reach([1e3, 1e4, 1e5], errors, 1e-3) == pytest.approx(10**4.5)
    assert cost_to_reach([0.1, 1.0, 10.0], errors, 2.0) == 0.1
    assert math.isnan(cost_to_reach([1e3, 1e4, 1e5], errors, 1e-5))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_work_precision(tmp_path, capsys):
    assert main(["work-precision", "--out", str(tmp_path), "--json", str(tmp_path / "run.json")], repeats=1) == 0
    points = json.loads((tmp_path / "run.json").read_text())["points"]
    assert {point["method"] for point in points} >= {"EIPRK2", "EIPRK5", "EIPRK23", "EIPDOP853"}
    best = {point["method"]: point["position_error"] for point in points}
    assert best["EIPRK4"] < 1e-7 < best["EIPRK2"]  # 100000 steps against a million
    work = [point["nfev"] for point in points if point["method"] == "EIPRK4"]
    assert work == sorted(work)
    out = capsys.readouterr().out
    assert "cheapest with fixed step" in out
    assert max(map(len, out.replace(str(tmp_path), "").splitlines())) <= 79
    assert (tmp_path / "work-precision.png").read_bytes().startswith(PNG)
