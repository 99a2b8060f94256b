"""The command line: ``eip-scipy COMMAND`` or ``python -m eip_scipy COMMAND``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from .commands import CHECK_FAILED, COMMANDS, DONE, INTERRUPTED, NOT_PRINTED, WRONG_USAGE, nearest

PROGRAM = "eip-scipy"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Print an error in one line, without the usage that argparse puts before it."""
        self.exit(WRONG_USAGE, f"{self.prog}: {message} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    """Action that reads the version only when it is requested, because reading takes time."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from eip_scipy import __version__

        print(f"eip_scipy {__version__}")
        parser.exit()


def main(argv: Sequence[str] | None = None, **settings: Any) -> int:
    """Run one command with the arguments `argv` (default: those of the process), and return the exit status.

    The status is 0 done, 1 a check inside the command failed or a run is not reliable, 2 wrong usage, 3 the text could
    not be printed, though the files are written, 130 interrupted. `settings` are those of the command, in place of its
    own defaults.
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
    """Report that the words name no command, and exit; ``--help`` and ``--version`` without a command are handled here.

    The first word is then missing, an option, mistyped, or only the first of the two words of a command's name.
    """
    groups = {name.split()[0] for name in COMMANDS if " " in name} - set(COMMANDS)
    group = words.pop(0) if words and words[0] in groups else ""
    known = [name for name in COMMANDS if name.startswith(group)]
    parser = _Parser(
        prog=f"{PROGRAM} {group}".rstrip(),
        usage=f"{PROGRAM} {group or 'COMMAND'} {'TASK ' if group else ''}[options]",
        description="Explicit invariants-preserving integrators for SciPy." if not group else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_listed(known),
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    _, rest = parser.parse_known_args(words)
    what = "TASK" if group else "COMMAND"
    last = list(dict.fromkeys(name.removeprefix(group).split()[0] for name in known))
    if not rest or rest[0].startswith("-"):
        parser.error(f"expected {what} first, one of {', '.join(last)}")
    parser.error(f"unknown {what} {rest[0]!r}, expected one of {', '.join(last)}{nearest(rest[0], last)}")


def _listed(names: Sequence[str]) -> str:
    width = max(map(len, names))
    return "\n".join(["commands:", *(f"  {name:<{width}}  {COMMANDS[name].summary}" for name in names)])


def _run(name: str, words: Sequence[str], settings: dict[str, Any]) -> int:
    module, _, kind = COMMANDS[name].where.partition(":")
    below = [other for other in COMMANDS if other.startswith(f"{name} ")]
    parser = _Parser(
        prog=f"{PROGRAM} {name}",
        description=COMMANDS[name].summary,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_listed(below) if below else None,
    )
    from .report import UsageError

    try:
        command = getattr(import_module(f".{module}", __package__), kind)
    except UsageError as error:  # a package is not installed that the study needs
        parser.exit(WRONG_USAGE, f"{parser.prog}: {error}\n")
    _add_options(parser, command)
    parser.set_defaults(**settings)
    args, rest = parser.parse_known_args(words)
    if rest:
        known = [
            *(text for action in parser._actions for text in action.option_strings),
            *(b.split()[1] for b in below),
        ]
        parser.error(f"unrecognized arguments: {' '.join(rest)}{nearest(rest[0].partition('=')[0], known)}")
    return _conduct(name, command, args)


def _add_options(parser: argparse.ArgumentParser, command: Any) -> None:
    """Add the options of the command, which are its fields, and those of all commands."""
    for item in fields(command):
        if "help" not in item.metadata:
            continue
        settings = {"default": item.default, **item.metadata}
        flag = f"--{item.name.replace('_', '-')}"
        if settings.pop("positional", False):
            flag = item.name
        elif item.default is False:
            settings["action"] = "store_true"
        parser.add_argument(flag, **settings)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("eip_results"),
        metavar="DIR",
        help="folder of figures and CSV files (default: ./%(default)s)",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the numbers as JSON, with versions and machine"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _conduct(name: str, command: Any, args: argparse.Namespace) -> int:
    from eip_scipy import ProjectionWarning

    from .report import UsageError, ended_by_sigterm, listening, printing, warn
    from .study import Session

    session = Session(name, args.out, args.json, args.quiet)
    own = {key: value for key, value in vars(args).items() if key not in ("out", "json", "quiet")}
    with ended_by_sigterm(), listening(ProjectionWarning) as untrusted, printing() as unsaid:
        try:
            status = command(**own).run(session)
            for line in session.absent:  # at the end, where it is seen
                warn(line)
        except UsageError as error:
            warn(str(error))
            status = WRONG_USAGE
        except KeyboardInterrupt:
            warn("interrupted")
            status = INTERRUPTED
        finally:
            for message in untrusted:
                warn(message)
            if unsaid:
                warn(f"cannot print to standard output: {unsaid[0]}. The files of the command are not affected.")
    if status == DONE and untrusted:
        return CHECK_FAILED
    return NOT_PRINTED if status == DONE and unsaid else status
