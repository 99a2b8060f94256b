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
        "solar.solar_system:SolarSystem",
        "run the solar system and compare with other methods (the paper's Experiment II)",
    ),
    "solar-system frontier": Entry(
        "solar.frontier:Frontier", "error against cost of long runs by methods of high order and by other packages"
    ),
    "solar-system truth": Entry("solar.truth:Truth", "compare force models with the ephemeris DE440 itself"),
    "charged-particle": Entry(
        "particles.charged_particle:charged_particle",
        "charged particles in two fields by several methods (the paper's Experiment III)",
    ),
    "hard-cases": Entry("hard.cases:HardCases", "run 35 hard cases with and without projection"),
    "hard-scenes": Entry(
        "hard.scenes:HardScenes",
        "error against cost on high eccentricities, chaos and close encounters, compared with IAS15",
    ),
    "gpe ground-state": Entry(
        "condensates.states:ground_states", "ground states of the rotating Gross-Pitaevskii equation (Experiment IV)"
    ),
    "gpe ring": Entry("condensates.quench:ring", "run the paper's ring of vortices after its trap is tightened"),
    "gpe vortex-lines": Entry(
        "condensates.quench:vortex_lines", "run the paper's condensate in 3D after its rotation is made faster"
    ),
    "mechanisms": Entry(
        "mechanisms.study:Mechanisms",
        "error against cost on mechanisms with constraints, compared with IDA, LSODA and Radau",
    ),
    "work-precision": Entry(
        "kepler.cost:KeplerCost", "error against cost of all methods on the perturbed Kepler problem"
    ),
    "bench": Entry(
        "bench.command:bench", "compare this package with SciPy, REBOUND, heyoka and others, on this machine"
    ),
    "bench metric": Entry("bench.metric:metric", "the default metric against none and euclidean, case by case"),
    "reproduce": Entry("paper.reproduce:Reproduce", "recompute the paper's tables and figures"),
    "study bodies": Entry("measurements.bodies:Bodies", "cost against the number of bodies, compared with IAS15"),
    "study ensembles": Entry(
        "measurements.ensembles:Ensembles", "ensembles: cost of a member, gain from threads and workers, memory"
    ),
    "study exoplanets": Entry(
        "measurements.exoplanets:Exoplanets", "three systems of exoplanets compared with WHFast and IAS15"
    ),
    "study long-orbits": Entry(
        "measurements.long_orbits:LongOrbits", "effect of projection and compensated sums over 1000 years"
    ),
    "study multistep": Entry(
        "measurements.multistep:Multistep", "EIPGJ14 and EIPGJ12 against WHFast, IAS15 and heyoka"
    ),
    "study recommend": Entry("measurements.recommend:Recommended", "true errors of recommended runs on the hard cases"),
    "study relativity": Entry(
        "measurements.relativity:Relativity", "ten bodies with relativity compared with WHFast and IAS15"
    ),
    "study solar-cloud": Entry(
        "measurements.solar_cloud:SolarCloud", "an ensemble of solar systems compared with REBOUND"
    ),
    "study speed": Entry("measurements.speed:Speed", "speed of the compiled step"),
    "study stiff": Entry("stiff.command:Stiff", "SciPy's implicit methods with and without projection"),
    "study trust": Entry("measurements.trust:Trust", "whether faulty runs are reported, and correct ones are not"),
}
