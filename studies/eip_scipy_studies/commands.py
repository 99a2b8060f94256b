"""The commands: by its words where each stands, and what it does; exit statuses. Quick to import, for ``--help``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

__all__ = ["CHECK_FAILED", "COMMANDS", "DONE", "INTERRUPTED", "MOVED", "NOT_PRINTED", "WRONG_USAGE", "Entry", "nearest"]

DONE, CHECK_FAILED, WRONG_USAGE, NOT_PRINTED, INTERRUPTED = 0, 1, 2, 3, 130


class Entry(NamedTuple):
    """A command: "module:class" in `eip_scipy_studies`, and a line for ``--help``."""

    where: str
    summary: str


COMMANDS = {
    "list": Entry("listing:Listing", "list commands, methods, problems and data sets"),
    "doctor": Entry("doctor:Doctor", "what is installed, and a test of it in seconds"),
    "solar-system": Entry(
        "solar.solar_system:SolarSystem",
        "run the solar system and compare with other methods (the paper's Experiment II)",
    ),
    "solar-system frontier": Entry(
        "solar.frontier:Frontier", "error against cost of long runs by methods of high order, and their peers"
    ),
    "solar-system truth": Entry("solar.truth:Truth", "force models against the ephemeris DE440 itself"),
    "charged-particle": Entry(
        "particles.charged_particle:ChargedParticle",
        "charged particles in two fields by several methods (the paper's Experiment III)",
    ),
    "charged-particle uniform": Entry("particles.charged_particle:Uniform", "the uniform field alone"),
    "charged-particle tokamak": Entry("particles.charged_particle:Tokamak", "the tokamak alone, or one orbit of it"),
    "hard-cases": Entry("hard.cases:HardCases", "run 35 hard cases with and without projection"),
    "hard-scenes": Entry(
        "hard.scenes:HardScenes",
        "error against cost on high eccentricities, chaos and close encounters, beside IAS15",
    ),
    "gpe ground-state": Entry(
        "condensates.states:GroundStates", "ground states of the rotating Gross-Pitaevskii equation (Experiment IV)"
    ),
    "gpe ring": Entry("condensates.ring:Ring", "the paper's ring after its trap is tightened"),
    "gpe vortex-lines": Entry("condensates.lines:VortexLines", "the paper's condensate in 3D, turned faster"),
    "work-precision": Entry(
        "kepler.cost:KeplerCost", "error against cost of all methods on the perturbed Kepler problem"
    ),
    "view": Entry("view:View", "a page that plays a saved run"),
    "bench": Entry("bench.command:Bench", "this package beside SciPy, REBOUND, heyoka and others, on this machine"),
    "reproduce": Entry("paper.reproduce:Reproduce", "recompute the paper's tables and figures"),
}
# Options of before, by command, and the command that does it now.
MOVED = {
    ("solar-system", "--frontier"): "solar-system frontier",
    ("solar-system", "--truth"): "solar-system truth",
    ("solar-system", "--forces"): "solar-system truth --forces",
    ("charged-particle", "--field"): "charged-particle uniform, or charged-particle tokamak",
    ("charged-particle", "--orbit"): "charged-particle tokamak --orbit",
}


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``; did you mean ...?`` for the known name that is most like `name`, or nothing."""
    import difflib

    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
