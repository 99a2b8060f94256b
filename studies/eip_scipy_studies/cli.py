"""The command line: ``eip-scipy COMMAND`` or ``python -m eip_scipy COMMAND``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields
from importlib import import_module
from inspect import isfunction
from pathlib import Path
from typing import Any

from .commands import CHECK_FAILED, COMMANDS, DONE, INTERRUPTED, WRONG_USAGE

PROGRAM = "eip-scipy"


def main(argv: Sequence[str] | None = None, **settings: Any) -> int:
    """Run one command with the arguments `argv` (default: those of the process), and return the exit status.

    The status is 0 done, 1 a check inside the command failed or a run is not reliable, 2 wrong usage, 130 interrupted.
    `settings` are those of the command, in place of its own defaults.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    longest_first = sorted(COMMANDS, key=lambda name: -name.count(" "))
    name = next((name for name in longest_first if words[: name.count(" ") + 1] == name.split()), None)
    try:
        if name is None:
            return _no_command(words)
        return _run(name, words[name.count(" ") + 1 :], settings)
    except SystemExit as leave:  # argparse, for --help, --version and errors
        return int(leave.code or DONE)


def _no_command(words: list[str]) -> int:
    """Show the help or the version if asked for, otherwise an error: the words name no command."""
    if "--version" in words:
        from eip_scipy import __version__

        print(f"eip_scipy {__version__}")
        return DONE
    parser = argparse.ArgumentParser(
        prog=PROGRAM, usage=f"{PROGRAM} COMMAND [options]", epilog=_listed(list(COMMANDS)),
        description="Explicit invariants-preserving integrators for SciPy.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    _, rest = parser.parse_known_args(words)
    parser.error(f"expected a command first, got {' '.join(rest)!r} (see {PROGRAM} --help)")


def _listed(names: Sequence[str]) -> str:
    width = max(map(len, names))
    return "\n".join(["commands:", *(f"  {name:<{width}}  {COMMANDS[name].summary}" for name in names)])


def _run(name: str, words: Sequence[str], settings: dict[str, Any]) -> int:
    module, _, kind = COMMANDS[name].where.partition(":")
    below = [other for other in COMMANDS if other.startswith(f"{name} ")]
    parser = argparse.ArgumentParser(
        prog=f"{PROGRAM} {name}",
        description=COMMANDS[name].summary,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_listed(below) if below else None,
    )
    from .output import run
    from .report import UsageError

    try:
        command = getattr(import_module(f".{module}", __package__), kind)
    except UsageError as error:  # a package is not installed that the study needs
        parser.error(str(error))
    if isfunction(command):
        return run(name, command, words)
    for item in fields(command):
        if "help" in item.metadata:
            _add_option(parser, item)
    parser.add_argument(
        "--out", type=Path, default=Path("eip_results"), metavar="DIR",
        help="folder of figures and CSV files (default: ./%(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the numbers as JSON, with versions and machine"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.set_defaults(**settings)
    return _conduct(name, command, vars(parser.parse_args(words)))


def _add_option(parser: argparse.ArgumentParser, item: Any) -> None:
    """Add the option of a command that is made by a field of its class."""
    settings, flag = {"default": item.default, **item.metadata}, f"--{item.name.replace('_', '-')}"
    if settings.pop("positional", False):
        flag = item.name
    elif item.default is False:
        settings["action"] = "store_true"
    parser.add_argument(flag, **settings)


def _conduct(name: str, command: Any, given: dict[str, Any]) -> int:
    from eip_scipy import ProjectionWarning
    from eip_scipy.checkpoint.signals import sigterm_as_ctrl_c

    from .report import UsageError, listening, warn
    from .study import Session

    session = Session(name, given.pop("out"), given.pop("json"), given.pop("quiet"))
    with sigterm_as_ctrl_c(), listening(ProjectionWarning) as untrusted:
        try:
            status = command(**given).run(session)
            for line in session.absent:  # at the end, where it is seen
                warn(line)
        except (UsageError, OSError) as error:
            warn(str(error))
            status = WRONG_USAGE
        except KeyboardInterrupt:
            warn("interrupted")
            status = INTERRUPTED
        finally:
            for message in untrusted:
                warn(message)
    return CHECK_FAILED if status == DONE and untrusted else status
