"""Definition of a command (settings, a measurement, and its output), and the runner that all commands share.

A new command is a file with a subclass of `Study`, and a line in `eip_scipy_studies.commands`.
"""

from __future__ import annotations

import argparse
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from eip_scipy.checkpoint import CheckpointError

from .commands import CHECK_FAILED, DONE, INTERRUPTED
from .report import (
    UsageError,
    describe_machine,
    document,
    say,
    warn,
    write_csv,
    write_file,
    write_json,
)

# Packages whose comparison is not among the integrations.
PEERS = {"heyoka": "heyoka"}

Found = TypeVar("Found")
Rows = Sequence[Mapping[str, Any]]
"""The lines of a CSV file, each with its columns' names."""
Figures = Iterable[tuple[str, Any]]
"""File names, and figures of matplotlib or functions that write to a path."""


def option(default: Any, text: str, **settings: Any) -> Any:
    """Make a field of a command that is an option of the command line, ``--its-name``.

    The default False makes a flag. `text` is that of ``--help``, and `settings` are as for
    `argparse.ArgumentParser.add_argument`; ``positional=True`` makes it a positional argument.
    """
    return field(default=default, metadata={"help": text, **settings})


def one_of(what: str, known: Collection[str]) -> Callable[[str], str]:
    """Make the ``type`` of an option that accepts one of the `known` names; `what` is their kind, for messages."""

    def read(text: str) -> str:
        if text in known:
            return text
        raise argparse.ArgumentTypeError(f"unknown {what} {text!r}, expected one of {', '.join(known)}")

    return read


def some_of(what: str, known: Collection[str]) -> Any:
    """Make a field for an option that may be repeated, each time with one of the `known` names; None means all.

    `what` is the kind of the names.
    """
    text = f"one {what}, may be repeated; default: all ({', '.join(known)})"
    return option(None, text, action="append", type=one_of(what, known), metavar="NAME")


class Check(NamedTuple):
    """Check of a command: its text, whether it holds, and its entry in the JSON file, if that has more than these."""

    text: str
    passed: bool
    record: Mapping[str, Any] = {}

    @property
    def line(self) -> str:
        """Return the check as a line of text."""
        return f"{'ok' if self.passed else 'FAILED':<6} {self.text}"

    @property
    def entry(self) -> dict[str, Any]:
        """Return the entry for the JSON file."""
        return dict(self.record) or {"text": self.text, "passed": self.passed}


class PartlyDone(KeyboardInterrupt):
    """Exception after an interrupt by the user in a measurement that has partial results (`found`)."""

    def __init__(self, found: Any) -> None:
        super().__init__()
        self.found = found


@dataclass
class Session:
    """Context of a command: folder of its files, its output, and the packages for comparison.

    `name` is that of the command, such as "gpe ring", and `out` the folder of figures and CSV files. The result of
    `Study.numbers` is written to `json`, if there is one. With `quiet` only errors are printed. `absent` has lines
    about packages that are not installed, printed at the end; `written` has the files that were made, and `unnamed`
    those of them whose names have not been printed yet. `open` has what is to be closed when the command ends.
    """

    name: str
    out: Path = Path("eip_results")
    json: Path | None = None
    quiet: bool = False
    absent: list[str] = field(default_factory=list)
    written: set[Path] = field(default_factory=set)
    unnamed: list[Path] = field(default_factory=list)
    open: ExitStack = field(default_factory=ExitStack)

    @property
    def shown(self) -> bool:
        """Return whether progress is shown: only on a terminal, because it would fill a file."""
        return not self.quiet and sys.stderr is not None and sys.stderr.isatty()

    def bar(self, total: int | None, what: str, unit: str = "run", **settings: Any) -> Any:
        """Make a progress bar of tqdm with the label `what`, to be used in a ``with``.

        `total` and `unit` are the number and the name of the items that the bar counts; `settings` are other arguments
        of tqdm.
        """
        from tqdm import tqdm

        return tqdm(total=total, desc=what, unit=unit, disable=not self.shown, **{"leave": False, **settings})

    def peer(self, name: str, methods: str) -> Any:
        """Import the adapter to another package: its module in `PEERS`, or else the integration with this name.

        If the package is missing, return None, and print a line at the end of the command which says that `methods` are
        missing from the comparison.
        """
        try:
            return import_module(PEERS.get(name, f"eip_scipy.integrations.{name}"))
        except ImportError as error:
            line = f"no comparison with {methods}: {error}"
            if line not in self.absent:
                self.absent.append(line)
            return None

    def say(self, text: str = "") -> None:
        """Print `text`, unless `quiet` is set."""
        if not self.quiet:
            say(text)

    def wrote(self, path: Path) -> None:
        """Record that a file was written; `name_files` prints its name once."""
        if path not in self.written:
            self.unnamed.append(path)
        self.written.add(path)

    def name_files(self) -> None:
        """Print the names of the files that have not been named yet, with an empty line before the first of all."""
        first = len(self.unnamed) == len(self.written)
        for k, path in enumerate(self.unnamed):
            self.say(f"\nwrote {path}" if first and k == 0 else f"wrote {path}")
        self.unnamed.clear()


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """Base class of commands, whose fields are the settings.

    Fields made by `option` are options of the command line; the others are changed by tests and other commands only.
    """

    @abstractmethod
    def run(self, session: Session) -> int:
        """Run the command, and return the exit status."""

    def arguments(self) -> dict[str, Any]:
        """Return the user's settings, for the JSON file."""
        return {item.name: getattr(self, item.name) for item in fields(self) if "help" in item.metadata}


class Study(Command, Generic[Found]):
    """Base class of commands that measure something.

    Subclasses must define `measure` and `text`, and may define the other methods. `found` is the result of `measure`.
    `writes_files` is False for a command without CSV files and figures.
    """

    writes_files = True

    @abstractmethod
    def measure(self, session: Session) -> Found:
        """Compute and return the results.

        After an interrupt by the user, `PartlyDone` may be raised with the results so far.
        """

    @abstractmethod
    def text(self, found: Found) -> str:
        """Return the text to be printed."""

    def numbers(self, found: Found) -> dict[str, Any]:
        """Return the results for the JSON file."""
        return {}

    def tables(self, found: Found) -> Mapping[str, Rows]:
        """Return the rows of CSV files, by the names of the files."""
        return {}

    def checks(self, found: Found) -> Sequence[Check]:
        """Return the checks that decide on the exit status."""
        return ()

    def figures(self, found: Found) -> Figures:
        """Yield pairs of a file name and a figure, or a function that writes the file.

        If matplotlib is missing, the ImportError is printed as a warning.
        """
        return ()

    def refine(self, found: Found, session: Session) -> bool:
        """Add measurements that take long to `found`, after the first results are printed and their files are written.

        Return True if the CSV and JSON files must be written again.
        """
        return False

    def when_interrupted(self) -> str:
        """Return a text for the user on how to continue after an interrupt, or ""."""
        return ""

    def check_settings(self) -> None:
        """Raise a UsageError if settings are wrong or do not go together."""

    def run(self, session: Session) -> int:
        """Check the settings, make the folders, and then do what `perform` does; return the exit status."""
        self.check_settings()
        for folder in (session.out if self.writes_files else None, session.json and session.json.parent):
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
        return perform(self, session)[0]


class Measurement(Study[Found]):
    """Base class of studies that measure run times.

    The result of `measure` is the content of the JSON file. The text is the description of the machine and `table`.
    """

    writes_files = False

    @abstractmethod
    def table(self, found: Found) -> str:
        """Return the measurements as a table of text."""

    def text(self, found: Found) -> str:
        return f"{describe_machine()}\n\n{self.table(found)}"

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"found": found}


def perform(study: Study[Any], session: Session) -> tuple[int, dict[str, Any]]:
    """Measure, print, write, check: the common part of all commands.

    Return the exit status (0 done, 1 a check failed, 130 interrupted) and the result of `study.numbers`.
    """
    with session.open:
        interrupted = ""
        try:
            found = study.measure(session)
        except PartlyDone as stop:
            found, interrupted = stop.found, "interrupted; the runs that were done are in the table and the files"
        except KeyboardInterrupt:
            _tell(study.when_interrupted(), "interrupted; nothing was written")
            return INTERRUPTED, {}
        except MemoryError as error:
            raise UsageError(f"not enough memory: {error}") from error
        except CheckpointError as error:
            raise UsageError(f"{error} On the command line, resume=True is --resume.") from error
        try:  # files before text: a closed stdout then loses no file, and a full disk no text
            numbers = _write_numbers(study, found, session)
        finally:
            session.say(study.text(found))
            session.name_files()
        try:
            if not interrupted and study.refine(found, session):
                numbers = _write_numbers(study, found, session)
                session.name_files()
        except KeyboardInterrupt:
            interrupted = "interrupted; the table is complete, what is measured after it and the figures are missing"
        if interrupted:
            _tell(study.when_interrupted(), interrupted)
            return INTERRUPTED, numbers
        _write_figures(study, found, session)
    return DONE if all(check.passed for check in study.checks(found)) else CHECK_FAILED, numbers


def _writer(figure: Any) -> Callable[[Path], Any]:
    write: Callable[[Path], Any] = figure.savefig if hasattr(figure, "savefig") else figure
    return write


def _tell(*lines: str) -> None:
    for line in filter(None, lines):
        warn(line)


def _write_numbers(study: Study[Any], found: Any, session: Session) -> dict[str, Any]:
    for name, rows in study.tables(found).items():
        session.wrote(write_csv(session.out / name, rows))
    numbers = study.numbers(found)
    if session.json is not None:
        session.wrote(write_json(session.json, document(session.name, study.arguments(), **numbers)))
    return numbers


def _write_figures(study: Study[Any], found: Any, session: Session) -> None:
    try:
        for name, figure in study.figures(found):
            session.wrote(write_file(session.out / name, _writer(figure)))
            session.name_files()
    except ImportError as error:
        warn(f"no figures: {error}")
