"""`eip-scipy gpe` on small grids: numbers, files, figures, exit statuses, and mistakes of users."""

import csv
import json
import sys
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from eip_scipy import integrate
from eip_scipy.problems import Grid, GrossPitaevskii
from eip_scipy.run import resume
from eip_scipy_studies.cli import main
from eip_scipy_studies.condensates import lines as gpe_lines
from eip_scipy_studies.condensates import runs as gpe_runs
from eip_scipy_studies.condensates import states as gpe_states
from eip_scipy_studies.condensates.ground_state import GroundState, ground_state, imprint
from eip_scipy_studies.condensates.problems import quartic_trap
from eip_scipy_studies.condensates.vortices import Vortices
from eip_scipy_studies.report import UsageError

PNG = b"\x89PNG\r\n\x1a\n"
GIF = b"GIF89a"


def read(file):
    with open(file, newline="") as stream:
        return list(csv.DictReader(stream))


# Ground states.


@pytest.mark.slow
@pytest.mark.needs_jit
def test_trap(tmp_path, capsys):
    file = tmp_path / "run.json"
    command = ["gpe", "ground-state", "--scene", "trap", "--starts", "2", "--out", str(tmp_path), "--json", str(file)]
    assert main(command, trap_points=64, published={0.0: 3.9459469, 0.65: 3.6506129}) == 0
    out = capsys.readouterr().out
    assert "V = r^2 / 2, beta = 100; lowest of 2 starts" in out
    assert out.count("ok     trap") == 2
    assert max(map(len, out.replace(str(tmp_path), "").splitlines())) <= 110
    content = json.loads(file.read_text())
    assert [check["matched"] for check in content["checks"]] == [True, True]
    assert [state["vortices"] for state in content["states"]] == [0, 3]
    rows = read(tmp_path / "ground-states.csv")
    assert [float(row["published"]) for row in rows] == [3.9459469, 3.6506129]
    assert (tmp_path / "ground-state-trap.png").read_bytes().startswith(PNG)


def found(energy, Omega=0.8, converged=True, points=16):
    gpe = GrossPitaevskii(Grid((points, points), -5, 5), Omega=Omega, beta=100)
    psi = np.exp(-sum(a**2 for a in gpe.grid.mesh())).astype(complex)
    state = GroundState(psi, energy, 1.0, 1e-9, 5, converged, "converged" if converged else "stopped")
    return gpe_states.Found("Omega", gpe, state, gpe_states.PUBLISHED[Omega])


def test_checks_of_the_trap():
    def matched(*args, **kwargs):
        (check,) = gpe_states.GroundStates().checks({"trap": [found(*args, **kwargs)]})
        return check.passed, check.record["note"]

    assert matched(3.1904172 + 9e-6) == (True, "")
    assert matched(3.1904172 + 2e-5) == (False, "")
    assert matched(3.1904172 - 2e-5) == (True, "lower")
    assert matched(3.1904172, converged=False) == (False, "")


def test_a_missed_energy_fails_the_command(tmp_path, monkeypatch, capsys):
    item = found(3.2, converged=False)
    monkeypatch.setitem(sys.modules, "eip_scipy_studies.plotting", None)
    scenes = {"trap": lambda settings, update: [item]}
    assert main(["gpe", "ground-state", "--out", str(tmp_path)], scenes=scenes) == 1
    captured = capsys.readouterr()
    assert "FAILED trap, Omega: E 3.1904172, ours 3.2" in captured.out
    assert "Omega: stopped" in captured.out
    assert "eip-scipy: no figures: " in captured.err
    assert [path.name for path in tmp_path.iterdir()] == ["ground-states.csv"]


def test_cropping_keeps_the_condensate():
    grid = Grid((64, 64), -8, 8)
    x, y = grid.mesh()
    density, ends = gpe_states.cropped(np.exp(-(x**2) - 4 * y**2), grid, (0, 1))
    half = np.sqrt(np.log(1000))  # where exp(-x^2) is 1e-3
    assert half < ends[1] < 1.3 * half
    assert density.shape[0] == density.shape[1] < 64
    assert ends[0] == pytest.approx(-ends[1], abs=2 * grid.spacing[0])


# The dynamics.


def small_ring(kappa=0.3, points=32):
    """Return two vortices in a trap that a coarse grid resolves."""
    grid = Grid((points, points), -4, 4)
    return GrossPitaevskii(grid, quartic_trap(0.0, kappa, 1, 1), Omega=1.0, beta=50.0)


SHORT = {
    "condensate": small_ring,
    "points": 32,
    "t_end": 0.2,
    "step": 5e-3,
    "reference_step": 5e-3,
    "saved": 0.05,
    "snapshots": (0.0, 0.1, 0.2, 7.0),
    "sense": -1,  # two vortices near the centre do not form a ring
}


@pytest.fixture
def start(tmp_path):
    """Write a stationary state to a file as `ground-state` does."""
    gpe = small_ring()
    state = ground_state(gpe, imprint(gpe, [[0.8, 0.1], [-0.8, 0.0]]), tol=1e-4)
    return gpe_states.save_state(tmp_path / "start.npz", gpe_states.Found("", gpe, state))


@pytest.mark.nightly
@pytest.mark.slow
def test_ring(tmp_path, start, capsys):
    out, file = tmp_path / "out", tmp_path / "ring.json"
    command = ["gpe", "ring", "--start", str(start), "--movie", "--out", str(out), "--json", str(file)]
    assert main(command, **SHORT) == 0
    text = capsys.readouterr().out
    assert "Ring, kappa = 0.3 -> 0.7, RK4, h = 0.005, to t = 0.2" in text
    assert "ok     vortices in the snapshots: [2, 2, 2]" in text
    assert "ok     vortices turn clockwise, angle at t = 0.2 [rad]: -0.0038" in text
    assert text.count("\nok ") == 6
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 110
    rows = read(out / "ring.csv")
    last = {row["method"]: row for row in rows}
    assert float(last["EIP-M"]["mass_error"]) < 1e-14 < float(last["RK4"]["mass_error"])
    assert float(last["EIP-E"]["energy_error"]) < 1e-12 < float(last["EIP-M"]["energy_error"])
    # Neither invariant makes the field right: its error is that of RK4.
    errors = [float(row["field_error"]) for row in last.values()]
    assert max(errors) < 3 * min(errors)
    content = json.loads(file.read_text())
    assert content["vortices"] == [2, 2, 2, 2, 2]
    assert len(content["turned_rad"]) == 5
    assert (out / "ring.gif").read_bytes().startswith(GIF)
    assert all((out / name).read_bytes().startswith(PNG) for name in ("ring-snapshots.png", "ring-errors.png"))


@pytest.mark.slow
@pytest.mark.usefixtures("no_plotting")
def test_the_other_sense_fails_the_command(tmp_path, start, capsys, monkeypatch):
    command = ["gpe", "ring", "--start", str(start), "--out", str(tmp_path)]
    assert main(command, **{**SHORT, "sense": 1}) == 1
    assert "FAILED vortices turn anticlockwise" in capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.slow
def test_another_end(tmp_path, start, capsys):
    """Snapshots and movie are those of the times that the run has."""
    command = ["gpe", "ring", "--start", str(start), "--t-end", "0.12", "--movie", "--out", str(tmp_path / "out")]
    assert main(command, **SHORT) == 0
    text = capsys.readouterr().out
    assert "to t = 0.12" in text
    assert "vortices in the snapshots: [2, 2]" in text
    times = [float(row["t"]) for row in read(tmp_path / "out" / "ring.csv") if row["method"] == "RK4"]
    np.testing.assert_allclose(times, [0, 0.05, 0.1, 0.12], atol=1e-15)
    assert all(
        (tmp_path / "out" / name).read_bytes().startswith(PNG) for name in ("ring-snapshots.png", "ring-errors.png")
    )
    assert (tmp_path / "out" / "ring.gif").read_bytes().startswith(GIF)


@pytest.mark.slow
@pytest.mark.usefixtures("no_plotting")
@pytest.mark.parametrize("end", ["0.05", "0.005"])
def test_an_end_before_the_vortices_have_turned(end, tmp_path, start, capsys):
    """Checks that cannot be made are reported, and do not fail."""
    assert main(["gpe", "ring", "--start", str(start), "--t-end", end, "--out", str(tmp_path / "out")], **SHORT) == 0
    text = capsys.readouterr().out
    assert "-      not checked: in which sense the vortices turn, for the run ends before t = 0.1\n" in text
    assert "FAILED" not in text


def test_an_end_before_the_first_step(tmp_path, start, capsys):
    assert (
        main(["gpe", "ring", "--start", str(start), "--t-end", "0.004", "--out", str(tmp_path / "out")], **SHORT) == 2
    )
    assert "--t-end: expected at least 0.005, the reference's step, got 0.004" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("no_plotting")
def test_a_stationary_state(start, tmp_path, monkeypatch):
    """Without a quench the gradients are parallel: that is counted, and nothing is nan."""
    gpe = small_ring()
    state = ground_state(gpe, gpe_states.load_state(start, gpe), tol=1e-11)
    assert state.converged
    gpe_states.save_state(start, gpe_states.Found("", gpe, state))
    file = tmp_path / "ring.json"
    command = ["gpe", "ring", "--start", str(start), "--out", str(tmp_path), "--json", str(file), "--quiet"]
    main(command, **SHORT, kappas=(0.3, 0.3))
    content = json.loads(file.read_text())
    assert max(map(abs, content["turned_rad"])) < 1e-8  # so that the sense, and with it the status, is chance
    assert content["rank_reduced"].pop("EIP-ME") > 0  # until the steps' own error has led away by 1e-8
    assert content["rank_reduced"] == {"EIP-M": 0, "EIP-E": 0, "RK4": 0}
    assert all(row["field_error"] < 1e-6 for row in content["errors"])  # null, were it not finite


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("run", "evaluation", "done"), [(0, 207, []), (2, 93, ["EIP-M"])])
def test_an_interrupted_command_goes_on(run, evaluation, done, tmp_path, start, capsys, monkeypatch):
    """The interruption is in the reference or a method's run; the numbers are those of an uninterrupted command."""
    folder = tmp_path / "kept"
    command = ["gpe", "ring", "--start", str(start), "--checkpoint", str(folder)]
    assert main(["gpe", "ring", "--start", str(start), "--out", str(tmp_path / "whole"), "--quiet"], **SHORT) == 0
    runs, calls = count(), count()

    def breaking(problem, **options):
        this = next(runs)

        def rhs(t, y, out):
            if this == run and next(calls) == evaluation:
                raise KeyboardInterrupt
            problem.rhs(t, y, out)

        return integrate(replace(problem, rhs=rhs), **options)

    with monkeypatch.context() as patch:
        patch.setattr(gpe_runs, "integrate", breaking)
        patch.setattr(resume, "SNAPSHOT_SECONDS", 0.0)
        assert main([*command, "--out", str(tmp_path / "first")], **SHORT) == 130
    captured = capsys.readouterr()
    assert f"the same command with --resume goes on from the checkpoints in '{folder}'" in captured.err
    assert [line.split()[0] for line in captured.out.splitlines() if line.startswith(("EIP", "RK4"))] == done
    assert main([*command, "--out", str(tmp_path / "again")], **SHORT) == 2
    assert "exists. Pass resume=True to continue the run that it holds" in capsys.readouterr().err
    assert main([*command, "--out", str(tmp_path / "second"), "--resume", "--quiet"], **SHORT) == 0
    assert {path.stem for path in folder.iterdir()} == {*gpe_runs.METHODS, gpe_runs.REFERENCE}
    assert read(tmp_path / "second" / "ring.csv") == read(tmp_path / "whole" / "ring.csv")
    assert main([*command, "--out", str(tmp_path / "third"), "--resume", "--t-end", "0.1"], **SHORT) == 2
    assert "belongs to another run: t_span is" in capsys.readouterr().err


# The paper's condensate on a grid that is good for three digits, and a few steps.
COARSE = {
    "points": 40,
    "energies_known": 1e-3,
    "turn_known": 0.03,
    "t_end": 0.2,
    "saved": 0.1,
    "snapshots": (0.0, 0.2),
}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_vortex_lines(tmp_path, capsys, monkeypatch):
    out, file, folder = tmp_path / "out", tmp_path / "lines.json", tmp_path / "kept"
    command = ["gpe", "vortex-lines", "--out", str(out), "--json", str(file), "--checkpoint", str(folder)]
    assert main(command, **COARSE) == 0
    text = capsys.readouterr().out
    assert "Vortex lines, Omega = 0.7 -> 0.9, RK4, h = 0.005, to t = 0.2" in text
    assert "Start: 4 lines, E = 3.329" in text
    assert "goes on to 2 lines, E = 3.302" in text
    assert "ok     vortices in the snapshots: [4, 4]" in text
    assert "ok     vortices turn clockwise, angle at t = 0.2 [rad]: -0.0" in text
    assert text.count("\nok ") == 11
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 110
    names = {"vortex-lines.csv", *(f"vortex-lines-{name}.png" for name in ("slices", "surfaces", "errors"))}
    assert {path.name for path in out.iterdir()} == names
    before = read(out / "vortex-lines.csv")
    # All is done; without scikit-image the surfaces are missing, and nothing else.
    (out / "vortex-lines-surfaces.png").unlink()
    monkeypatch.setattr(gpe_lines, "search_saddle", None)
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    assert main([*command, "--resume"], **COARSE) == 0
    assert 'no surfaces: surfaces of equal density need scikit-image: pip install "eip_scipy[surfaces]"' in (
        capsys.readouterr().err
    )
    assert not (out / "vortex-lines-surfaces.png").exists()
    assert read(out / "vortex-lines.csv") == before


def test_vortices_are_followed_by_where_they_were_going(monkeypatch):
    """Turns of more than half the distance between two vortices, once they have got so fast little by little."""
    total = 38
    turns = np.cumsum([0.01, 0.03, 0.05, 0.07, 0.09, 0.1])
    places = iter([0.0, *turns])

    def at(*args):
        angle = next(places) + 2 * np.pi * np.arange(total) / total
        return Vortices(5 * np.column_stack([np.cos(angle), np.sin(angle)]), np.ones(total, int))

    monkeypatch.setattr(gpe_runs, "vortices", at)
    moved = gpe_runs.motion(small_ring(), np.arange(7.0), np.zeros((32 * 32, 7), complex))
    np.testing.assert_allclose(moved.angle, [0, *turns], atol=1e-12)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content.pop("psi"), "cannot read a state"),
        (lambda content: content.update(Omega=3.0), "its Omega differs"),
        (lambda content: content.update(V=np.zeros((4, 4))), "its V differs"),
        (lambda content: content.update(psi=np.zeros((16, 16), complex)), "finite complex field"),
        (lambda content: content.update(psi=np.full((32, 32), np.nan + 0j)), "finite complex field"),
        (lambda content: content.update(psi=np.array([None])), "cannot read a state"),
    ],
)
def test_states_that_do_not_belong(start, damage, message):
    with np.load(start) as file:
        content = dict(file)
    damage(content)
    np.savez(start, **content)
    with pytest.raises(UsageError, match=message):
        gpe_states.load_state(start, small_ring())


def test_start_that_is_no_state(tmp_path, capsys):
    file = tmp_path / "start.npz"
    for content in (b"", b"PK\x03\x04 torn", b"text"):
        file.write_bytes(content)
        assert main(["gpe", "ring", "--start", str(file), "--out", str(tmp_path), "--quiet"]) == 2
        assert "cannot read a state from" in capsys.readouterr().err
    assert main(["gpe", "ring", "--start", str(tmp_path / "none.npz"), "--out", str(tmp_path), "--quiet"]) == 2
