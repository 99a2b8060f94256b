"""`eip-scipy gpe` on small grids: interruptions, and states that do not belong."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from pages import read_rows

from eip_scipy import integrate
from eip_scipy.problems import Grid, GrossPitaevskii
from eip_scipy_studies.cli import main
from eip_scipy_studies.condensates import quench, states
from eip_scipy_studies.condensates.ground_state import ground_state, imprint
from eip_scipy_studies.condensates.problems import quartic_trap
from eip_scipy_studies.output import Output
from eip_scipy_studies.report import UsageError

pytestmark = pytest.mark.needs_jit


def small_ring(kappa=0.3):
    """Return the equation of two vortices in a trap that a coarse grid resolves."""
    return GrossPitaevskii(Grid((32, 32), -4, 4), quartic_trap(0.0, kappa, 1, 1), Omega=1.0, beta=50.0)


@pytest.fixture(scope="module")
def start():
    return ground_state(small_ring(), imprint(small_ring(), [[0.8, 0.1], [-0.8, 0.0]]), tol=1e-4)


def run(out, start, checkpoint=None, resume=False):
    setting = {"h": (5e-3, 5e-3), "saved": 0.05, "snapshots": (0.0, 0.1, 0.2, 7.0), "kept": (1e-14, 1e-12)}
    made = quench.Quench("ring", "Ring", small_ring(0.7), start.psi, 0.2, sense=-1, **setting)
    quench.run_ring(out, made, False, checkpoint, resume)


@pytest.mark.nightly
@pytest.mark.usefixtures("snapshots")
@pytest.mark.parametrize(("broken", "evaluation", "done"), [(0, 207, set()), (2, 93, {"EIP-M"})])
def test_an_interrupted_command_goes_on(broken, evaluation, done, tmp_path, start, capsys, monkeypatch):
    """The interruption is in the reference or a method's run; the numbers are those of an uninterrupted command."""
    run(out := Output(tmp_path / "whole"), start)
    assert out.passed
    assert out.numbers["turned_rad"][-1] == pytest.approx(-0.0038, abs=1e-4)
    runs, calls, folder = count(), count(), tmp_path / "kept"

    def breaking(problem, **options):
        this = next(runs)

        def rhs(t, y, out):
            if this == broken and next(calls) == evaluation:
                raise KeyboardInterrupt
            problem.rhs(t, y, out)

        return integrate(replace(problem, rhs=rhs), **options)

    with monkeypatch.context() as patch:
        patch.setattr(quench, "integrate", breaking)
        run(out := Output(tmp_path / "first"), start, checkpoint=folder)
    assert out.interrupted
    assert "the same command with --resume goes on from the checkpoints" in capsys.readouterr().err
    assert {row["method"] for row in out.numbers.get("errors", ())} == done
    run(Output(tmp_path / "second"), start, checkpoint=folder, resume=True)
    assert {path.stem for path in folder.iterdir()} == {*quench.METHODS, quench.REFERENCE}
    assert read_rows(tmp_path / "second" / "ring.csv") == read_rows(tmp_path / "whole" / "ring.csv")


def test_states_that_do_not_belong(start, tmp_path):
    file, gpe = tmp_path / "state.npz", small_ring()
    states._save(states.Found("", gpe, start), file)
    np.testing.assert_array_equal(states.load_state(file, gpe), start.psi)
    with np.load(file) as stored:
        content = dict(stored)
    for change, message in (
        ({"V": np.zeros((4, 4))}, "its V is not"),
        ({"psi": np.full((32, 32), np.nan + 0j)}, "finite complex field"),
        ({"psi": np.array([None])}, "cannot read a state"),
    ):
        np.savez(file, **content | change)
        with pytest.raises(UsageError, match=message):
            states.load_state(file, gpe)
    file.write_bytes(b"PK\x03\x04 torn")
    assert main(["gpe", "ring", "--start", str(file), "--out", str(tmp_path), "--quiet"]) == 2
