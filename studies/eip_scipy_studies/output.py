"""A study is a function: its keywords are the options of its command, its docstring is the help.

``run(name, study, argv)`` reads the options, calls ``study(out, ...)``, and returns the exit status: 0 done, 1 a check
failed or a run is not reliable, 2 wrong usage, 130 interrupted. The study hands text, tables, figures and checks to
`Output`.
"""

from __future__ import annotations

import argparse
import inspect
import multiprocessing
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from eip_scipy import ProjectionWarning
from eip_scipy.checkpoint import CheckpointError, sigterm_as_ctrl_c

from .report import UsageError, document, say, warn, write_csv, write_file, write_json

OUT = Path("eip_results")
DONE, CHECK_FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses of a command."""


class Output:
    """Where a study puts its text, tables, figures and checks; a file replaces an older one only when it is complete.

    `numbers` is what the study wants in the JSON file. The files `inputs` are never replaced.
    """

    def __init__(self, folder: Path = OUT, *, quiet: bool = False, inputs: Sequence[Path] = ()) -> None:
        self.folder, self.quiet, self._inputs = folder, quiet, inputs
        self.numbers: dict[str, Any] = {}
        self.passed, self.interrupted = True, False
        self._absent: dict[str, None] = {}

    @property
    def shows_progress(self) -> bool:
        """Return True on a terminal, unless the study is quiet."""
        return not self.quiet and sys.stderr is not None and sys.stderr.isatty()

    def text(self, text: str = "") -> None:
        """Print `text`, unless the study is quiet."""
        if not self.quiet:
            say(text)

    def bar(self, items: Any = None, what: str = "", **settings: Any) -> Any:
        """Make a progress bar of tqdm, which iterates over `items`; it is shown on a terminal only."""
        from tqdm import tqdm

        return tqdm(items, desc=what, disable=not self.shows_progress, **{"leave": False, **settings})

    def check(self, text: str, passed: bool, **record: Any) -> None:
        """Print a check, which decides on the exit status, and keep it with `record` for the JSON file."""
        self.text(f"{'ok' if passed else 'FAILED':<6} {text}")
        self.passed &= bool(passed)
        self.numbers.setdefault("checks", []).append({"text": text, "passed": bool(passed), **record})

    def rows(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the lines of a CSV file, each with its columns' names."""
        self._write(write_csv, self.folder / name, rows)

    def figure(self, name: str, where: str, *arguments: Any) -> None:
        """Write the figure or what else the function `where`, "module:function", makes of the arguments.

        Its module is imported here, because it needs matplotlib. Without matplotlib, say so.
        """
        try:
            import matplotlib  # noqa: F401
        except ImportError:
            self.missing('no figures without matplotlib: pip install "eip_scipy[plot]"')
            return
        module, _, function = where.partition(":")
        made = getattr(import_module(f".{module}", __package__), function)(*arguments)
        self.file(name, getattr(made, "savefig", made))

    def file(self, name: str, write: Callable[[Path], Any]) -> None:
        """Let `write` fill a temporary file, which then replaces the file `name`."""
        self._write(write_file, self.folder / name, write)

    def missing(self, line: str) -> None:
        """Print a line at the end of the command about what a package that is not installed would have added."""
        self._absent[line] = None

    @contextmanager
    def keep(self, checkpoint: Path | None = None) -> Iterator[None]:
        """Let Ctrl-C end the block instead of the study, so that what was computed so far is written.

        `checkpoint` is the folder from which the same command can resume, if there is one.
        """
        try:
            yield
        except KeyboardInterrupt:
            self.interrupted = True
            warn("interrupted; what was computed before is in the table and the files")
            if checkpoint is not None:
                warn(f"the same command with --resume goes on from the checkpoints in {str(checkpoint)!r}")

    def end(self) -> None:
        """Print what is missing."""
        for line in self._absent:
            warn(line)

    def require_other(self, path: Path) -> None:
        """Raise a UsageError if the file `path` is an input of the command."""
        if path.exists() and any(known.exists() and path.samefile(known) for known in self._inputs):
            raise UsageError(f"{str(path)!r} is an input of this command, and is not replaced; choose another output")

    def _write(self, write: Callable[[Path, Any], Path], path: Path, content: Any) -> None:
        self.require_other(path)
        self.text(f"wrote {write(path, content)}")


def run(name: str, study: Callable[..., None], argv: Sequence[str]) -> int:
    """Run a study with the arguments `argv` of its command `name`, and return the exit status."""
    given = vars(parser(name, study).parse_args(argv))
    folder, quiet, target = (given.pop(option) for option in ("out", "quiet", "json"))
    out = Output(folder, quiet=quiet, inputs=[value for value in given.values() if isinstance(value, Path)])
    untrusted: list[str] = []
    try:
        for folder in (out.folder if out.folder != OUT else None, target and target.parent):
            if folder is not None:
                check_folder(folder)
        if target:
            out.require_other(target)
        with sigterm_as_ctrl_c(), listening(untrusted):
            study(out, **given)
    except (UsageError, OSError, MemoryError, CheckpointError) as error:
        warn(str(error) or "not enough memory")
        return WRONG_USAGE
    except BrokenProcessPool:
        warn("a process of this command died: it was killed, or memory ran out. Free memory and repeat the command.")
        return WRONG_USAGE
    except KeyboardInterrupt:
        warn("interrupted")
        out.interrupted = True
    finally:
        if target and out.numbers:
            out._write(write_json, target, document(name, given, trusted=not untrusted, **out.numbers))
        for line in untrusted:
            warn(line)
        out.end()
    return INTERRUPTED if out.interrupted else DONE if out.passed and not untrusted else CHECK_FAILED


def check_folder(folder: Path) -> None:
    """Raise an OSError before the work if no file could be written to `folder` after it."""
    nearest = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    if not nearest.is_dir():
        raise NotADirectoryError(f"{str(folder)!r} cannot be made: {str(nearest)!r} is not a folder")
    if not os.access(nearest, os.W_OK):
        raise PermissionError(f"{str(nearest)!r} cannot be written to; choose another folder")


def parser(name: str, study: Callable[..., None]) -> argparse.ArgumentParser:
    """Make the parser of a command: arguments before the ``*`` of the study are positional, those after it options."""
    text = inspect.getdoc(study) or ""
    said = {key: " ".join(about.split()) for key, about in re.findall(r"^(\w+) : .*\n((?: {4}.*\n?)+)", text, re.M)}
    made = argparse.ArgumentParser(
        prog=f"eip-scipy {name}",
        description=text.split("\n\nParameters\n")[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for item in list(inspect.signature(study, eval_str=True).parameters.values())[1:]:
        positional = item.kind is not item.KEYWORD_ONLY
        flag = item.name if positional else f"--{item.name.replace('_', '-')}"
        settings = option(item.annotation, item.default) | ({"metavar": item.name.upper()} if positional else {})
        made.add_argument(flag, default=item.default, help=said[item.name].replace("%", "%%"), **settings)
    made.add_argument("--out", type=Path, default=OUT, metavar="DIR",
                      help="folder of figures and CSV files (default: ./%(default)s)")  # fmt: skip
    made.add_argument("--json", type=Path, metavar="FILE", help="write the numbers as JSON, with versions and machine")
    made.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return made


def option(kind: Any, default: Any) -> dict[str, Any]:
    """Return how argparse reads an argument annotated with `kind`: bool is a flag, a tuple some values, Literal one."""
    if kind is bool:
        return {"action": "store_true"}
    kinds = [part for part in get_args(kind) or (kind,) if part not in (type(None), ...)]
    if get_origin(kind) is tuple:
        return {"nargs": "*" if default else "+", **option(kinds[0], None)}
    if get_origin(kind) is Literal:
        return {"type": one_of(kinds), "metavar": "{" + ",".join(kinds) + "}"}
    if get_origin(kinds[0]) in (tuple, Literal):
        return option(kinds[0], default)
    return {"type": kinds[0], "metavar": {int: "N", float: "X", Path: "PATH"}.get(kinds[0], "NAME")}


def one_of(known: Sequence[str]) -> Callable[[str], str]:
    """Make the type of an option that accepts the `known` names."""

    def read(text: str) -> str:
        if text in known:
            return text
        raise argparse.ArgumentTypeError(f"unknown name {text!r}, expected one of {', '.join(known)}")

    return read


def require_positive(**values: float | None) -> None:
    """Raise a UsageError that names the option if a value is given and not a positive number."""
    for name, value in values.items():
        if value is not None and not 0 < value < float("inf"):
            raise UsageError(f"--{name.replace('_', '-')}: expected a positive number, got {value}")


def checkpoint_options(folder: Path | None, resume: bool, name: str) -> dict[str, Any]:
    """Return the options with which `integrate` keeps checkpoints of the run `name` in `folder`; none without it."""
    if folder is None:
        if resume:
            raise UsageError("--resume needs the folder to resume from: --checkpoint DIR")
        return {}
    folder.mkdir(parents=True, exist_ok=True)
    return {"checkpoint": folder / f"{re.sub('[^A-Za-z0-9]+', '-', name).strip('-')}.npz", "resume": resume}


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes that ignore Ctrl-C, which a terminal sends to all of them; leaving the context kills them.

    They are spawned, not forked, because a fork copies locks that other threads hold.
    """
    others, context = set(multiprocessing.active_children()), multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, context, signal.signal, (signal.SIGINT, signal.SIG_IGN))
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.kill()


@contextmanager
def listening(texts: list[str]) -> Iterator[None]:
    """Collect the warnings about unreliable runs in `texts`, each once; other warnings are shown as always."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", ProjectionWarning)
        show = warnings.showwarning

        def listen(message: Any, category: Any, *rest: Any, **more: Any) -> None:
            if not issubclass(category, ProjectionWarning):
                show(message, category, *rest, **more)
            elif str(message) not in texts:
                texts.append(str(message))

        warnings.showwarning = listen
        yield
