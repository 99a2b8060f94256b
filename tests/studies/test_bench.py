"""`eip-scipy bench`: errors against closed forms, reports on failures of packages, and the report."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj

from eip_scipy_studies.bench import compare, figures, page, process, suites
from eip_scipy_studies.bench.command import Bench
from eip_scipy_studies.bench.compare import Row, standings
from eip_scipy_studies.bench.equations import EQUATIONS, scene_from
from eip_scipy_studies.bench.peers import COMPILED, PEERS, PYTHON
from eip_scipy_studies.cli import main
from eip_scipy_studies.report import UsageError
from eip_scipy_studies.study import Session

CIRCLE = suites._record("circle", "kepler", [1.0, 0, 0, 1], [-1.0, 0, 0, -1], math.pi, {"EIPRKN12": [20, 30]})


def tiny(peer):
    return suites._for(peer, [CIRCLE], (1e-5, 1e-8))


def bench(tmp_path, peers, **settings):
    own = {"suites": {"kepler": suites.Suite("kepler", "Kepler", "precision", lambda: tiny, "a note")}}
    own |= {"field_of_peers": {name: PEERS[name] for name in peers}, "limit": 20.0, "repeats": 1}
    return Bench(**own | settings), Session("bench", tmp_path, quiet=True)


def lines(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def worker_of(tmp_path, monkeypatch, text):
    """A worker in its stead, for `ask`."""
    (tmp_path / "stand_in.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return partial(process.ask, worker="stand_in")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    command, session = bench(tmp_path_factory.mktemp("bench"), ["EIPDOP853", "SciPy DOP853"])
    assert command.run(session) == 0
    return session.out


def test_errors_are_those_of_the_closed_form(measured):
    rows = lines(measured / "bench.csv")
    assert [row["peer"] for row in rows] == ["EIPDOP853"] * 2 + ["SciPy DOP853"] * 2
    fun = scene_from(CIRCLE).plain().fun
    for row in rows[2:]:
        tolerance = float(row["setting"])
        y = solve_ivp(fun, (0, math.pi), CIRCLE["y0"], method=row["peer"][6:], rtol=tolerance, atol=1e-3 * tolerance).y[
            :, -1
        ]
        assert float(row["error"]) == pytest.approx(np.max(np.abs(y - CIRCLE["end"])), rel=1e-12)
        assert float(row["seconds"]) > 0
    assert float(rows[1]["drift"]) < 1e-14 < float(rows[3]["drift"])


def test_report_holds_all_it_shows(measured):
    html = (measured / "bench.html").read_text()
    assert html.count("data:image/png;base64,") == 1
    assert "http" not in html
    assert "SciPy DOP853" in html
    text = (measured / "bench.md").read_text()
    assert "](bench-kepler-circle-python.png)" in text
    assert (measured / "bench-kepler-circle-python.png").stat().st_size > 1000
    assert len(lines(measured / "bench-equal-error.csv")) == 2


def test_a_peer_that_is_not_installed_is_named(tmp_path, monkeypatch):
    (tmp_path / "extensisq.py").write_text("raise ModuleNotFoundError(\"No module named 'extensisq'\")")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    command, session = bench(tmp_path, ["extensisq Pr9", "extensisq SWAG"])
    found = command.measure(session)
    assert found.absent == {"extensisq": "ModuleNotFoundError: No module named 'extensisq'"}
    assert "extensisq did not run: ModuleNotFoundError: No module named 'extensisq'" in command.text(found)
    assert not found.rows


def test_a_crash_and_a_late_worker_keep_what_they_had(tmp_path, monkeypatch):
    line = "import sys, time, os; sys.stdin.read(); print('{\"error\": 1}', flush=True);"
    crash = worker_of(tmp_path, monkeypatch, f"{line} print('oh dear', file=sys.stderr, flush=True); os._exit(3)")
    reply = crash({}, 20.0)
    assert reply.answers == [{"error": 1}]
    assert reply.failed == "the process ended with status 3: oh dear"
    late = worker_of(tmp_path, monkeypatch, f"{line} time.sleep(60)")
    reply = late({}, 2.0)
    assert reply.answers == [{"error": 1}]
    assert reply.failed == "not done after 2 s, and ended"


def test_a_peer_that_fails_is_named_with_what_it_said(tmp_path):
    wave = {**suites.asking()[0], "settings": {}}
    suite = suites.Suite("asked", "Asked", "asked", lambda: lambda peer: suites._for(peer, [wave], (1e-6,)), "")
    command, session = bench(tmp_path, ["SciPy LSODA"], suites={"asked": suite})
    said = {row.peer: row.said for row in command.measure(session).rows}
    assert said["SciPy LSODA"].startswith("ValueError: ")


def rows_of(peer, *pairs, takes=PYTHON, scene="orbit"):
    return [Row("kepler", scene, takes, peer, 1.0, seconds, error, 0.0) for seconds, error in pairs]


def test_cost_at_equal_error_is_interpolated_and_divided_by_our_best():
    rows = [
        *rows_of("EIPDOP853", (2.0, 1e-4), (8.0, 1e-10)),
        *rows_of("EIPRKN12", (1.0, 1e-5), (3.0, 1e-7)),
        *rows_of("SciPy DOP853", (10.0, 1e-5), (1000.0, 1e-7)),
    ]
    near, far = standings(rows)
    assert not near.bound
    assert far.tried == 1000.0
    assert (near.best, near.ours) == ("EIPRKN12", pytest.approx(math.sqrt(3)))
    assert near.seconds == pytest.approx(100.0)
    assert far.best == "EIPDOP853"
    assert math.isnan(far.ratio)
    assert not far.lost


def test_other_forms_stand_beside_our_compiled_methods():
    rows = rows_of("heyoka", (1.0, 1e-10), takes=PEERS["heyoka"].takes)
    rows += rows_of("EIPDOP853 (jitted)", (4.0, 1e-10), takes=COMPILED)
    (near, _) = standings(rows)
    assert (near.peer, near.ratio) == ("heyoka", 0.25)


def test_an_error_that_we_do_not_reach_is_a_loss():
    rows = [*rows_of("EIPDOP853", (2.0, 1e-7)), *rows_of("SciPy DOP853", (1.0, 1e-7), (9.0, 1e-10))]
    _, far = standings(rows)
    assert far.lost
    assert "SciPy DOP853 is the only one that arrives at 1e-9." in page.text(page.Found("here", "today", rows))


def test_a_reason_is_printed_only_where_the_peer_won(monkeypatch):
    monkeypatch.setattr(compare, "REASONS", (("kepler", "orbit", "", "SciPy", "It is clever."),))
    ahead = [*rows_of("EIPDOP853", (2.0, 1e-10)), *rows_of("SciPy DOP853", (1.0, 1e-10))]
    behind = [*rows_of("EIPDOP853", (1.0, 1e-10)), *rows_of("SciPy DOP853", (2.0, 1e-10))]
    texts = [page.text(page.Found("here", "today", rows)) for rows in (ahead, behind)]
    assert "SciPy DOP853 is ahead by 2 at 1e-6; SciPy DOP853 is ahead by 2 at 1e-9. It is clever." in texts[0]
    assert "clever" not in texts[1]


def test_stored_ends_of_the_rigid_body_are_elliptic_functions():
    a, _, d = suites.kepler()[2]["y0"]
    for t_end, end in suites.RIGID_BODY.items():
        sn, cn, dn, _ = ellipj(d / math.sqrt(2) * t_end, (a / d) ** 2)
        np.testing.assert_allclose(end, [a * cn, -math.sqrt(2) * a * sn, d * dn], atol=1e-11)


@pytest.mark.parametrize("name", EQUATIONS)
def test_gradients_and_accelerations_belong_to_the_functions(name):
    functions = EQUATIONS[name](math.sqrt)
    y = np.array([0.3, 0.5, 0.7, 0.2][: 3 if name == "rigid_body" else 4])
    rate = np.array(functions.gradients(0.0, y)) @ np.array(functions.fun(0.0, y))
    np.testing.assert_allclose(rate, 0.0, atol=1e-14)
    if functions.acc is not None:
        np.testing.assert_array_equal(functions.acc(0.0, y[:2]), functions.fun(0.0, y)[2:])


def test_the_field_keeps_its_invariants():
    scene = scene_from(suites.field()[0])
    functions, y = scene.plain(), scene.y0
    rate = np.real(np.conj(functions.gradients(0.0, y)) @ functions.fun(0.0, y))
    np.testing.assert_allclose(rate, 0.0, atol=1e-12)
    assert functions.values(0.0, scene.end) == pytest.approx(functions.values(0.0, y), rel=1e-9)


def test_unknown_names_are_refused(capsys):
    assert main(["bench", "--suite", "sollar"]) == 2
    assert "unknown suite 'sollar', expected one of all, kepler, solar, " in capsys.readouterr().err
    with pytest.raises(UsageError, match="package 'nobody' is not known; expected some of CyRK"):
        Bench(peers=["nobody"]).check_settings()


def test_all_suites_have_work_for_us_and_for_a_peer():
    for suite in suites.SUITES.values():
        make = suite.make()
        asked = [peer for peer in PEERS.values() if make(peer)]
        assert any(peer.ours for peer in asked)
        assert not all(peer.ours for peer in asked)
        json.dumps([make(peer) for peer in asked])


def test_interrupted_keeps_what_it_had(tmp_path, monkeypatch):
    command, session = bench(tmp_path, ["SciPy RK45", "SciPy DOP853"])
    command = replace(command, limit=21.0)
    asked = []

    def ask(request, limit):
        asked.append(request["peer"])
        if len(asked) == 2:
            raise KeyboardInterrupt
        return process.Reply([{"scene": "circle", "seconds": 1.0, "error": 1e-7}], "1.0", 1.0, "")

    monkeypatch.setattr("eip_scipy_studies.bench.command.ask", ask)
    assert command.run(session) == 130
    assert [row["peer"] for row in lines(tmp_path / "bench.csv")] == ["SciPy RK45"]


def test_figures_leave_out_what_has_no_error():
    rows = [*rows_of("EIPDOP853", (1.0, 1e-6)), Row("kepler", "orbit", PYTHON, "SciPy RK45", said="no")]
    ((where, name, _),) = figures.drawn(rows, "here")
    assert (where, name) == (("kepler", "orbit", PYTHON), "bench-kepler-orbit-python.png")


@pytest.mark.slow
@pytest.mark.needs_jit
def test_metric_of_contacts(tmp_path):
    """Beads in contact and a ball: the default metric is never worse than the better of none and euclidean."""
    assert main(["bench", "metric", "--only", "Hertz", "--out", str(tmp_path), "--quiet"]) == 0
    with open(tmp_path / "metric.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 48
    assert sum(float(row["ratio"]) > 1.5 for row in rows) < 8
    assert np.median([float(row["default"]) / float(row["none"]) for row in rows]) < 0.2
