"""The command line: ``eip-scipy COMMAND`` or ``python -m eip_scipy COMMAND``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from .. import comparators, problems
from ..core.results import ProjectionWarning
from ..core.versions import versions
from ..problems.gravity import solar_data
from . import doctor
from .condensates import gpe
from .hard import cases as hard_cases
from .hard import scenes as hard_scenes
from .kepler import cost as kepler_cost
from .paper import reproduce
from .particles import charged_particle
from .report import UsageError, check_target, document, listening, say, warn, write_json
from .solar import frontier as solar_frontier
from .solar import solar_system
from .solar import truth as solar_truth

__all__ = ["main"]

DONE, CHECK_FAILED, WRONG_USAGE = 0, 1, 2


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, without the usage that argparse puts before it."""
        self.exit(WRONG_USAGE, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; default: those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 1 a check inside the command failed or a run is not to be trusted, 2 wrong usage, 130
        interrupted.
    """
    with listening(ProjectionWarning) as untrusted:
        try:
            status = _run(argv)
        finally:
            for message in untrusted:
                warn(message)
    return CHECK_FAILED if status == DONE and untrusted else status


def _run(argv: Sequence[str] | None) -> int:
    try:
        args = _parser().parse_args(argv)
        args.absent = []
        status = int(args.run(args))
        for line in args.absent:  # at the end, where it is seen
            warn(line)
        return status
    except SystemExit as leave:  # argparse, for --help, --version and errors
        return int(leave.code or DONE)
    except UsageError as error:
        warn(str(error))
        return WRONG_USAGE
    except KeyboardInterrupt:
        warn("interrupted")
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="eip-scipy", description="Explicit invariants-preserving integrators for SciPy.")
    parser.add_argument("--version", action="version", version=f"eip_scipy {versions()['eip_scipy']}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)
    for name, (summary, add_arguments, run) in _commands().items():
        command = commands.add_parser(name, help=summary, description=summary)
        add_arguments(command)
        _add_common(command)
        command.set_defaults(run=run)
    return parser


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, default=Path("eip_results"), metavar="DIR", help="folder of figures and CSV (./%(default)s)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="the numbers as JSON, with versions and machine")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _commands() -> dict[str, tuple[str, Any, Any]]:
    """For each command a summary, what adds its options, and what runs it."""
    return {
        "list": ("list commands, methods, problems and data sets", lambda parser: None, _list),
        "doctor": ("what is installed, and a test of it in seconds", lambda parser: None, doctor.run),
        "solar-system": (
            "run the solar system and compare with other methods (the paper's Experiment II)",
            solar_system.add_arguments,
            _solar_system,
        ),
        "charged-particle": (
            "charged particles in two fields by several methods (the paper's Experiment III)",
            charged_particle.add_arguments,
            charged_particle.run,
        ),
        "hard-cases": (
            "run 35 hard cases with and without projection",
            hard_cases.add_arguments,
            hard_cases.run,
        ),
        "hard-scenes": (
            "error against cost on high eccentricities, chaos and close encounters, beside IAS15",
            hard_scenes.add_arguments,
            lambda args: hard_scenes.run(args, _rebound(args)),
        ),
        "gpe": (
            "rotating Gross-Pitaevskii equation: ground states, the ring, and vortex lines (Experiment IV)",
            gpe.add_arguments,
            gpe.run,
        ),
        "work-precision": (
            "error against cost of all methods on the perturbed Kepler problem",
            kepler_cost.add_arguments,
            kepler_cost.run,
        ),
        "reproduce": (
            "recompute the paper's tables and figures",
            reproduce.add_arguments,
            lambda args: reproduce.run(args, lambda: _runner(_rebound(args))),
        ),
    }


def _rebound(args: argparse.Namespace) -> Any:
    return _peer(args, "rebound", "WHFast and IAS15")


def _peer(args: argparse.Namespace, name: str, methods: str) -> Any:
    """An integration, or None and a line at the end that says how to get it."""
    try:
        return import_module(f"eip_scipy.integrations.{name}")
    except ImportError as error:
        args.absent.append(f"no comparison with {methods}: {error}")
        return None


def _runner(peer: Any) -> Any:
    return None if peer is None else peer.run


def _solar_system(args: argparse.Namespace) -> int:
    if (args.truth or args.frontier) and (args.checkpoint is not None or args.resume):
        raise UsageError("--checkpoint and --resume go with the comparison of methods, not with --truth or --frontier")
    if args.truth:
        return solar_truth.run(args, _ephemeris())
    if args.frontier:
        return solar_frontier.run(args, _runner(_rebound(args)), _runner(_peer(args, "heyoka", "heyoka")))
    return solar_system.run(args, _runner(_rebound(args)), lambda *where: _ephemeris().initial_data(*where))


def _ephemeris() -> solar_truth.Ephemeris:
    """JPL's kernels; what they need is looked for when they are read."""
    from eip_scipy.integrations import jpl

    return solar_truth.Ephemeris(jpl.initial_data, jpl.heliocentric)


def _list(args: argparse.Namespace) -> int:
    content = _listing()
    if not args.quiet:
        for heading, entries in content.items():
            say(f"{heading}:")
            width = max(map(len, entries))
            for name, summary in entries.items():
                say(f"  {name:<{width}}  {summary}".rstrip())
    if args.json is not None:
        check_target(args.json)
        write_json(args.json, document("list", {}, **content))
    return DONE


def _listing() -> dict[str, dict[str, str]]:
    sets = {name: solar_data.load(name) for name in solar_data.available()}
    others = {name: getattr(comparators, name) for name in comparators.__all__}
    scenes = {name: getattr(problems, name) for name in problems.__all__}
    return {
        "commands": {name: summary for name, (summary, _, _) in _commands().items()},
        "methods": {name: _first_line(method) for name, method in solar_system.fixed_step_methods().items()},
        "comparators": {name: _first_line(make) for name, make in others.items() if not isinstance(make, type)},
        "problems": {
            name: _first_line(make)
            for name, make in scenes.items()
            if callable(make) and not isinstance(make, type)  # neither records nor fields
        },
        "data": {name: f"{len(data.bodies)} bodies at {data.epoch}, {data.axes}" for name, data in sets.items()},
    }


def _first_line(item: Any) -> str:
    return (item.__doc__ or "").strip().split("\n")[0].split(". ")[0].rstrip(".")
