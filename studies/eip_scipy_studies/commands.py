"""Table of the commands, with their classes and purposes, and the exit statuses.

This module imports no command, so that ``--help`` is quick.
"""

from __future__ import annotations

from typing import NamedTuple

DONE, CHECK_FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130


class Entry(NamedTuple):
    """Entry of the table of commands: "module:class" in `eip_scipy_studies`, and the line for ``--help``."""

    where: str
    summary: str


COMMANDS = {
    "doctor": Entry("doctor:doctor", "list what is installed, and test in seconds whether it works"),
    "solar-system": Entry(
        "solar.command:solar_system", "run the solar system and compare with other methods (the paper's Experiment II)"
    ),
    "charged-particle": Entry(
        "particles.charged_particle:charged_particle",
        "charged particles in two fields by several methods (the paper's Experiment III)",
    ),
    "hard-cases": Entry("hard.command:hard_cases", "run 35 hard cases with and without projection"),
    "gpe ground-state": Entry(
        "condensates.states:ground_states", "ground states of the rotating Gross-Pitaevskii equation (Experiment IV)"
    ),
    "gpe ring": Entry("condensates.quench:ring", "run the paper's ring of vortices after its trap is tightened"),
    "gpe vortex-lines": Entry(
        "condensates.quench:vortex_lines", "run the paper's condensate in 3D after its rotation is made faster"
    ),
    "bench": Entry(
        "bench.command:bench", "compare this package with SciPy, REBOUND, heyoka and others, on this machine"
    ),
    "bench metric": Entry("bench.metric:metric", "the default metric against none and euclidean, case by case"),
    "reproduce": Entry("paper.reproduce:reproduce", "recompute the paper's tables and figures"),
    "trust": Entry("trust.command:trust", "whether faulty runs are reported, and correct ones are not"),
}
