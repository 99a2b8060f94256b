"""The command line: ``eip-scipy COMMAND`` or ``python -m eip_scipy COMMAND``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

PROGRAM = "eip-scipy"
COMMANDS = {  # the study, as module:function, and what --help says of it
    "solar-system": ("solar.command:solar_system", "the solar system by several methods (the paper's Experiment II)"),
    "charged-particle": ("particles.charged_particle:charged_particle", "charges in two fields (Experiment III)"),
    "gpe ground-state": ("condensates.states:ground_states", "states of the Gross-Pitaevskii equation (Experiment IV)"),
    "gpe ring": ("condensates.quench:ring", "a ring of vortices after its trap is tightened"),
    "gpe vortex-lines": ("condensates.quench:vortex_lines", "a condensate in 3D after its rotation is made faster"),
    "hard-cases": ("hard.command:hard_cases", "35 hard cases with and without projection"),
    "reproduce": ("paper.reproduce:reproduce", "the paper's tables and figures"),
    "bench": ("bench.command:bench", "error against cost of this package, SciPy, REBOUND, heyoka and others"),
    "bench metric": ("bench.metric:metric", "the default metric against none and euclidean, case by case"),
    "trust": ("trust.command:trust", "whether faulty runs are reported, and correct ones are not"),
    "transits": ("transits:transit_times", "transit times and derivatives against heyoka in 80 bits and REBOUND"),
    "doctor": ("doctor:doctor", "what is installed, and in seconds whether it works"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command with the arguments `argv` (default: those of the process), and return the exit status.

    The status is 0 done, 1 a check inside the command failed or a run is not reliable, 2 wrong usage, 130 interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    longest_first = sorted(COMMANDS, key=lambda name: -name.count(" "))
    name = next((name for name in longest_first if words[: name.count(" ") + 1] == name.split()), None)
    try:
        if name is None:
            return no_command(words)
        from .output import run
        from .report import UsageError, warn

        module, _, function = COMMANDS[name][0].partition(":")
        try:
            study = getattr(import_module(f".{module}", __package__), function)
        except UsageError as error:  # a package is not installed that the study needs
            warn(str(error))
            return 2
        return run(name, study, words[name.count(" ") + 1 :])
    except SystemExit as leave:  # argparse, for --help, --version and errors
        return int(leave.code or 0)


def no_command(words: Sequence[str]) -> int:
    """Show the help or the version if asked for, otherwise an error: the words name no command."""
    if "--version" in words:
        from eip_scipy import __version__

        print(f"eip_scipy {__version__}")
        return 0
    width = max(map(len, COMMANDS))
    parser = argparse.ArgumentParser(
        prog=PROGRAM, usage=f"{PROGRAM} COMMAND [options]",
        epilog="\n".join(["commands:", *(f"  {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items())]),
        description="Explicit invariants-preserving integrators for SciPy.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    _, rest = parser.parse_known_args(words)
    parser.error(f"expected a command first, got {' '.join(rest)!r} (see {PROGRAM} --help)")
