"""Numbers of the page on condensates, computed again: some eight minutes on an idle machine.

The ring to t = 10 and the vortex lines to t = 20 take longer: they run to t = 1 and t = 0.4 here, and times are not
checked.
"""

import numpy as np
import pytest
from pages import PAGES, assert_printed, printed_tables, read_rows

from eip_scipy_studies.cli import main
from eip_scipy_studies.comparators import crank_nicolson, linearly_implicit
from eip_scipy_studies.condensates import efficiency, quench, states
from eip_scipy_studies.output import Output

pytestmark = [pytest.mark.nightly, pytest.mark.needs_jit]
PAGE = "results/gross-pitaevskii.md"
TRAP, RING, LINES, EFFICIENCY = 1, 2, 4, 6  # numbers of the tables
TEXT = " ".join((PAGES / PAGE).read_text(encoding="utf-8").split())


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """Run the command, and return its folder and the lines of its table."""
    out = Output(tmp_path_factory.mktemp("ground"), quiet=True)
    states.ground_states(out)
    assert out.passed
    return out.folder, out.numbers["states"]


def test_ground_states(ground):
    rows = {scene: [row for row in ground[1] if row["scene"] == scene] for scene in ("trap", "ring", "lines")}
    for (Omega, (energy, published, _, vortices)), row in zip(
        printed_tables(PAGE)[TRAP].items(), rows["trap"], strict=True
    ):
        assert float(Omega) == row["Omega"]
        assert_printed(energy, row["energy"])
        assert_printed(published, row["published"])
        assert_printed(vortices, row["vortices"])
    (ring,) = rows["ring"]
    assert f"E = {ring['energy']:.6f}, μ = {ring['mu']:.6f}, {ring['vortices']} vortices" in TEXT
    assert ring["start"] == "38 around 123"
    energies = {n: min(row["energy"] for row in rows["lines"] if row["vortices"] == n) for n in (1, 2, 3)}
    saddle = rows["lines"][-1]["energy"]
    assert (
        f"two vortex lines, E = {energies[2]:.6f}. Three lines have {energies[3]:.5f}, one has {energies[1]:.5f}"
        in TEXT
    )
    assert f"a saddle at {saddle:.6f}" in TEXT
    assert f"saddle of the energy, {saddle - energies[2]:.4f} above" in TEXT


def test_ring(ground, tmp_path):
    quench.ring(out := Output(tmp_path, quiet=True), start=ground[0] / "ring.npz")
    assert out.passed
    errors = out.numbers["errors"]
    for name, (_, *cells) in printed_tables(PAGE)[RING].items():
        for key, cell in zip(("mass_error", "energy_error", "field_error"), cells, strict=True):
            assert_printed(cell, max(row[key] for row in errors if row["method"] == name), round_off=1e-12)
    assert out.numbers["vortices"][0] == 38  # and in all snapshots, by the command's check
    assert f"by {out.numbers['turned_rad'][-1]:.2f} rad to t = 1" in TEXT


def test_vortex_lines(tmp_path):
    """To t = 0.4 the energies of the two states, the four lines, their sense and angle are checked by the command."""
    assert main(["gpe", "vortex-lines", "--t-end", "0.4", "--out", str(tmp_path), "--quiet"]) == 0
    names = {"vortex-lines.csv", *(f"vortex-lines-{name}.png" for name in ("slices", "surfaces", "errors"))}
    assert {path.name for path in tmp_path.iterdir()} == names
    rows = read_rows(tmp_path / "vortex-lines.csv")
    for name, (_, _, _, whole) in printed_tables(PAGE)[LINES].items():
        assert max(float(row["field_error"]) for row in rows if row["method"] == name) < float(whole)


def test_efficiency(tmp_path):
    out = Output(tmp_path, quiet=True)
    efficiency.efficiency(out, repeats=1)
    assert out.passed, out.numbers["checks"]
    rows = [row for row in read_rows(tmp_path / "fig-efficiency.csv") if row["wave"] == "modulated wave"]
    assert any("rank 1" in row["remark"] for row in rows if row["method"] == "EIP-ME")
    for name, (h, error, mass, energy, pairs, _) in printed_tables(PAGE)[EFFICIENCY].items():
        row = min((row for row in rows if row["method"] == name), key=lambda row: abs(float(row["h"]) - float(h)))
        assert_printed(h, float(row["h"]))
        assert_printed(error, float(row["error_max"]))
        assert_printed(mass, float(row["error_mass"]), round_off=1e-12)
        assert_printed(energy, float(row["error_energy"]), round_off=1e-12)
        assert_printed(pairs, float(row["h"]) * float(row["pairs"]))
    trial = efficiency.trials(64)["modulated wave"]
    for scheme in (crank_nicolson, linearly_implicit):
        tight, loose = (
            scheme(trial.problem.equation, (0, 1), trial.problem.y0, 0.01, tol=tol) for tol in (1e-12, 1e-8)
        )
        assert loose.nfev < 0.6 * tight.nfev
        errors = [np.abs(run.y[:, -1] - trial.exact).max() for run in (tight, loose)]
        assert errors[1] == pytest.approx(errors[0], rel=1e-3)
        if scheme is crank_nicolson:
            mass, energy = (
                abs(f(loose.y[:, 1]) / f(loose.y[:, 0]) - 1)
                for f in (trial.problem.equation.mass, trial.problem.equation.energy)
            )
            assert f"kept to {mass:.0e} and {energy:.0e}".replace("e-0", "e-") in TEXT
