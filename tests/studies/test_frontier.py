"""``eip-scipy solar-system frontier`` and the integration of heyoka."""

import csv
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from eip_scipy.problems import nbody, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D
from eip_scipy_studies.cli import main
from eip_scipy_studies.solar import frontier as solar_frontier
from eip_scipy_studies.study import Session


@pytest.fixture
def two_methods(monkeypatch):
    """Time less than the command would: the reference itself, moved by 1e-7 AU, and a run that fails."""
    everything = solar_frontier.methods

    def few(problem, years, judge, heyoka):
        assert set(everything(problem, years, judge, heyoka)) >= {"EIPRKN12", "EIPGJ14", "EIPDOP853", "SV"}

        def near(step):
            return step, problem.reference(years) + 1e-7 * (np.arange(60) < 30)

        return {"near": (near, [0.01, 0.02]), "failed": (lambda step: (1.0, np.full(60, np.nan)), [0.01])}

    monkeypatch.setattr(solar_frontier, "methods", few)


def test_the_frontier_names_errors_and_times(two_methods, tmp_path, capsys):
    arguments = ["--years", "1", "--out", str(tmp_path), "--json", str(tmp_path / "r.json")]
    assert main(["solar-system", "frontier", *arguments]) == 0
    printed = capsys.readouterr().out
    assert "1.7e-7" in printed
    assert "Seconds for an error" in printed
    rows = list(csv.DictReader((tmp_path / "frontier.csv").read_text().splitlines()))
    assert [row["method"] for row in rows] == ["near", "near", "failed"]
    assert float(rows[0]["Mercury_au"]) == pytest.approx(np.sqrt(3) * 1e-7, rel=1e-6)
    assert float(rows[1]["wall_time_s"]) == 0.02
    assert rows[0]["setting"] == f"{0.01 * YEAR_D:.4g} d"
    assert len(json.loads((tmp_path / "r.json").read_text())["runs"]) == 3
    assert (tmp_path / "frontier.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["eip_scipy.integrations.rebound", "eip_scipy_studies.heyoka_runs"])
def test_a_missing_peer_is_told_at_the_end(name, two_methods, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    assert main(["solar-system", "frontier", "--years", "1", "--out", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert any(
        line.startswith("eip-scipy: no comparison with") and name.rpartition(".")[2].removesuffix("_runs") in line
        for line in captured.err.splitlines()
    )


@pytest.mark.needs_jit
@pytest.mark.slow
def test_methods_of_the_frontier_run(monkeypatch):
    """One run of each of the package's own methods; the high orders come within 1e-9 AU after a year."""
    monkeypatch.setattr(Session, "peer", lambda *names: None)
    runs = solar_frontier.Frontier(years=1.0, repeats=1).measure(Session("frontier", quiet=True)).runs
    best = {run.method: min(r.errors.max() for r in runs if r.method == run.method) for run in runs}
    assert max(best[name] for name in ("EIPRKN12", "EIPRKN8", "EIPDOP853", "RKN12, no projection")) < 1e-9
    assert max(best[name] for name in ("EIPRKN12", "EIPGJ12", "EIPGJ14")) < 1e-12
    assert best["EIPRK4"] < 1e-5


def test_peers_of_the_frontier_are_called():
    """Each with its name and steps that divide the span."""
    problem, called = solar_system(years=1.0), []

    def peer(gm, y0, name, *, h, n_steps):
        called.append((name, h * n_steps))
        return SimpleNamespace(wall_time=0.5, y=np.stack([y0, y0 + 1], axis=1))

    methods = solar_frontier.methods(problem, 1.0, peer, None)
    for name in ("WHFast (c17)", "SABA(10,6,4)", "IAS15"):
        run, steps = methods[name]
        seconds, y = run(steps[-1])
        assert seconds == 0.5
        assert np.array_equal(y, problem.y0 + 1)
    assert called == [("whfast-c17", 1.0), ("saba(10,6,4)", 1.0), ("ias15", 1.0)]


def test_heyoka_on_our_states():
    heyoka = pytest.importorskip("eip_scipy_studies.heyoka_runs", exc_type=ImportError)
    problem = solar_system(years=1.0)
    result = heyoka.run(problem.params, problem.y0, t_end=1.0)
    assert np.linalg.norm((result.y - problem.reference(1.0))[:30].reshape(10, 3), axis=1).max() < 1e-12
    assert result.steps > 10
    assert result.wall_time > 0


def test_heyoka_says_where_it_stopped():
    """Two bodies fall into each other, which stops heyoka."""
    heyoka = pytest.importorskip("eip_scipy_studies.heyoka_runs", exc_type=ImportError)
    problem = nbody([1.0, 1.0], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]], t_span=(0, 3))
    with pytest.raises(ValueError, match="heyoka stopped at"):
        heyoka.run(problem.params, problem.y0, t_end=3.0)
