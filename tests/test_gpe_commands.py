"""`eip-scipy gpe` in small: numbers, files, figures, exit statuses, and what a user may get wrong."""

import csv
import json
import sys

import numpy as np
import pytest

from eip_scipy.cli import main
from eip_scipy.commands import gpe_ring, gpe_states
from eip_scipy.problems.gross_pitaevskii import Grid, GrossPitaevskii, GroundState, Vortices, ring_condensate
from eip_scipy.report import UsageError

PNG = b"\x89PNG\r\n\x1a\n"
GIF = b"GIF89a"


def read(file):
    with open(file, newline="") as stream:
        return list(csv.DictReader(stream))


# Ground states.


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(gpe_states, "TRAP_POINTS", 64)
    monkeypatch.setattr(gpe_states, "PUBLISHED", {0.0: 3.9459469, 0.65: 3.6506129})


@pytest.mark.needs_jit
@pytest.mark.usefixtures("small")
def test_trap(tmp_path, capsys):
    file = tmp_path / "run.json"
    command = ["gpe", "ground-state", "--scene", "trap", "--starts", "2", "--out", str(tmp_path), "--json", str(file)]
    assert main(command) == 0
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
        (check,) = gpe_states.checks({"trap": [found(*args, **kwargs)]})
        return check["matched"], check["note"]

    assert matched(3.1904172 + 9e-6) == (True, "")
    assert matched(3.1904172 + 2e-5) == (False, "")
    assert matched(3.1904172 - 2e-5) == (True, "lower")
    assert matched(3.1904172, converged=False) == (False, "")


def test_a_missed_energy_fails_the_command(tmp_path, monkeypatch, capsys):
    item = found(3.2, converged=False)
    monkeypatch.setitem(gpe_states.SCENES, "trap", lambda args, update: [item])
    monkeypatch.setitem(sys.modules, "eip_scipy.plotting", None)
    assert main(["gpe", "ground-state", "--scene", "trap", "--out", str(tmp_path)]) == 1
    captured = capsys.readouterr()
    assert "FAILED trap, Omega: E 3.1904172, ours 3.2" in captured.out
    assert "Omega: stopped" in captured.out
    assert "eip-scipy: no figures: " in captured.err
    assert [path.name for path in tmp_path.iterdir()] == ["ground-states.csv"]


@pytest.mark.parametrize("task", ["ground-state", "ring"])
def test_interrupted(task, tmp_path, monkeypatch, capsys):
    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setitem(gpe_states.SCENES, "trap", stop)
    monkeypatch.setattr(gpe_ring, "search_ring", stop)
    assert main(["gpe", task, "--out", str(tmp_path), "--quiet"]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_cropping_keeps_the_condensate():
    grid = Grid((64, 64), -8, 8)
    x, y = grid.mesh()
    density, ends = gpe_states.cropped(np.exp(-(x**2) - 4 * y**2), grid, (0, 1))
    half = np.sqrt(np.log(1000))  # where exp(-x^2) is 1e-3
    assert half < ends[1] < 1.3 * half
    assert density.shape[0] == density.shape[1] < 64
    assert ends[0] == pytest.approx(-ends[1], abs=2 * grid.spacing[0])


# The ring.


@pytest.fixture
def short(monkeypatch):
    """A few steps on a grid that barely shows the ring."""
    monkeypatch.setattr(gpe_ring, "POINTS", 32)
    monkeypatch.setattr(gpe_ring, "T_END", 0.004)
    monkeypatch.setattr(gpe_ring, "STEP", 2.5e-4)
    monkeypatch.setattr(gpe_ring, "REFERENCE_STEP", 2.5e-4)
    monkeypatch.setattr(gpe_ring, "SAVED", 0.001)
    monkeypatch.setattr(gpe_ring, "SNAPSHOTS", (0.0, 0.002, 0.004))
    monkeypatch.setattr(gpe_ring, "ENERGY_KEPT", 1e-10)


@pytest.fixture
def start(tmp_path):
    """A soft lump in place of the ring's ground state, in a file as `ground-state` writes it."""
    gpe = ring_condensate(points=32)
    x, y = gpe.grid.mesh()
    psi = (np.exp(-((np.hypot(x, y) - 5) ** 2) / 2) * np.exp(2j * np.arctan2(y, x))).astype(complex)
    psi /= np.sqrt(gpe.mass(psi))
    state = GroundState(psi, gpe.energy(psi), 0.0, 0.0, 0, True, "converged")
    return gpe_states.save_state(tmp_path / "start.npz", gpe_states.Found("", gpe, state))


@pytest.mark.usefixtures("short")
def test_ring(tmp_path, start, capsys):
    out, file = tmp_path / "out", tmp_path / "ring.json"
    command = ["gpe", "ring", "--start", str(start), "--movie", "--out", str(out), "--json", str(file)]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "Ring, kappa = 0.3 -> 0.7" in text
    assert text.count("\nok ") == 5
    assert max(map(len, text.replace(str(tmp_path), "").splitlines())) <= 110
    rows = read(out / "ring.csv")
    last = {row["method"]: row for row in rows}
    assert float(last["EIP-M"]["mass_error"]) < 1e-14 < float(last["RK4"]["mass_error"])
    assert float(last["EIP-E"]["energy_error"]) < 1e-10 < float(last["EIP-M"]["energy_error"])
    # Neither invariant makes the field right: its error is that of RK4.
    errors = [float(row["field_error"]) for row in last.values()]
    assert max(errors) < 3 * min(errors)
    content = json.loads(file.read_text())
    assert len(content["vortices"]) == len(content["turned_rad"]) == 5
    assert (out / "ring.gif").read_bytes().startswith(GIF)
    assert all((out / name).read_bytes().startswith(PNG) for name in ("ring-snapshots.png", "ring-errors.png"))


def test_vortices_are_followed_by_where_they_were_going():
    """Turns of more than half the distance between two vortices, once they have got so fast little by little."""
    count = 38
    turns = np.cumsum([0.01, 0.03, 0.05, 0.07, 0.09, 0.1])
    gpe = ring_condensate(points=32)
    line = gpe_ring.Line(np.arange(7.0), np.zeros((32 * 32, 7), complex), *[np.zeros(7)] * 3, 0.0, 0)
    places = iter([0.0, *turns])

    def at(*args):
        angle = next(places) + 2 * np.pi * np.arange(count) / count
        return Vortices(5 * np.column_stack([np.cos(angle), np.sin(angle)]), np.ones(count, int))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpe_ring, "vortices", at)
        moved = gpe_ring.motion(gpe, line)
    np.testing.assert_allclose(moved.angle, [0, *turns], atol=1e-12)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content.pop("psi"), "cannot read a state"),
        (lambda content: content.update(Omega=3.0), "its Omega differs"),
        (lambda content: content.update(V=np.zeros((4, 4))), "its V differs"),
        (lambda content: content.update(psi=np.zeros((16, 16))), "finite complex field"),
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
        gpe_states.load_state(start, ring_condensate(points=32))


def test_start_that_is_no_state(tmp_path, capsys):
    file = tmp_path / "start.npz"
    for content in (b"", b"PK\x03\x04 torn", b"text"):
        file.write_bytes(content)
        assert main(["gpe", "ring", "--start", str(file), "--out", str(tmp_path), "--quiet"]) == 2
        assert "cannot read a state from" in capsys.readouterr().err
    assert main(["gpe", "ring", "--start", str(tmp_path / "none.npz"), "--out", str(tmp_path), "--quiet"]) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["gpe", "states"], "invalid choice: 'states'"),
        (["gpe", "ground-state", "--scene", "rings"], "did you mean 'ring'"),
        (["gpe", "ground-state", "--starts", "0"], "expected an integer >= 1, got '0'"),
        (["gpe"], "required: TASK"),
    ],
)
def test_wrong_usage(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
