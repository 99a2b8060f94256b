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
        "particles.charged_particle:ChargedParticle",
        "charged particles in two fields by several methods (the paper's Experiment III)",
    ),
    "charged-particle uniform": Entry("particles.charged_particle:Uniform", "the uniform field alone"),
    "charged-particle tokamak": Entry("particles.charged_particle:Tokamak", "the tokamak alone, or one orbit of it"),
    "hard-cases": Entry("hard.command:hard_cases", "run 35 hard cases with and without projection"),
    "hard-scenes": Entry(
        "hard.scenes:HardScenes",
        "error against cost on high eccentricities, chaos and close encounters, compared with IAS15",
    ),
    "gpe ground-state": Entry(
        "condensates.states:GroundStates", "ground states of the rotating Gross-Pitaevskii equation (Experiment IV)"
    ),
    "gpe ring": Entry("condensates.ring:Ring", "run the paper's ring of vortices after its trap is tightened"),
    "gpe vortex-lines": Entry(
        "condensates.lines:VortexLines", "run the paper's condensate in 3D after its rotation is made faster"
    ),
    "bench": Entry(
        "bench.command:bench", "compare this package with SciPy, REBOUND, heyoka and others, on this machine"
    ),
    "bench metric": Entry("bench.metric:metric", "the default metric against none and euclidean, case by case"),
    "reproduce": Entry("paper.reproduce:reproduce", "recompute the paper's tables and figures"),
    "trust": Entry("trust.command:trust", "whether faulty runs are reported, and correct ones are not"),
    "study bodies": Entry("measurements.bodies:Bodies", "cost against the number of bodies, compared with IAS15"),
    "study charged-particle": Entry(
        "measurements.charged_particle:ParticleCost", "speed of a step, and error against cost, for charged particles"
    ),
    "study exoplanets": Entry(
        "measurements.exoplanets:Exoplanets", "three systems of exoplanets compared with WHFast and IAS15"
    ),
    "study gpe-efficiency": Entry("condensates.efficiency:AllRuns", "the paper's test of efficiency with all its runs"),
    "study long-orbits": Entry(
        "measurements.long_orbits:LongOrbits", "effect of projection and compensated sums over 1000 years"
    ),
    "study multistep": Entry(
        "measurements.multistep:Multistep", "EIPGJ14 and EIPGJ12 against WHFast, IAS15 and heyoka"
    ),
    "study relativity": Entry(
        "measurements.relativity:Relativity", "ten bodies with relativity compared with WHFast and IAS15"
    ),
    "study solar-cloud": Entry(
        "measurements.solar_cloud:SolarCloud", "an ensemble of solar systems compared with REBOUND"
    ),
}
