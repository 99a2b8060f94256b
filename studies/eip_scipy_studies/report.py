"""Common functions of the commands: machine and versions, numbers and tables as text, and writing of files."""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy import show_config
from eip_scipy.solvers import EIPSolver


class UsageError(Exception):
    """Error of the user's input; the message is one line that says what to do. Exit status 2."""


def machine() -> dict[str, Any]:
    """Describe the machine: processor, architecture, number of processors and system."""
    return {
        "processor": _processor(),
        "architecture": platform.machine(),
        "cpus": os.cpu_count(),
        "system": f"{platform.system()} {platform.release()}",
    }


def describe_machine() -> str:
    """Describe the machine in one line, for the titles of timings."""
    known = machine()
    plural = "" if known["cpus"] == 1 else "s"
    return f"{known['processor']}, {known['cpus']} CPU{plural}, {platform.system()}, Python {platform.python_version()}"


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return " ".join(line.split(":", 1)[1].split())
    except OSError:
        pass
    return platform.processor() or platform.machine() or "unknown processor"


def needed(module: str, install: str = "") -> Any:
    """Import and return a module that a study needs.

    `install` is the argument of ``pip install``; it may be omitted if the error of the import says what to install, as
    those of the package's integrations do. If the module is not installed, a UsageError says how to install it; if a
    part of this package cannot be imported, which is a fault of the package, the ImportError is raised.
    """
    try:
        return import_module(module)
    except ImportError as error:
        if not install and (error.name or "eip_scipy").startswith("eip_scipy"):
            raise  # the package itself is faulty
        raise UsageError(f"{error}: pip install {install}" if install else str(error)) from error


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def named(method: type[EIPSolver], name: str) -> type[EIPSolver]:
    """Return a subclass of the method with this name, which bars and messages show."""
    return type(name, (method,), {"__doc__": method.__doc__})


def versions() -> dict[str, str | None]:
    """Return the versions of Python, of eip_scipy, of its dependencies and extras; None for those that are absent."""
    found = show_config("dicts") or {}
    return {**found["versions"], **{name: extra["version"] for name, extra in found["extras"].items()}}


def document(command: str, arguments: Mapping[str, Any], **content: Any) -> dict[str, Any]:
    """Return a command's numbers for `write_json`, with the options, the date, the versions and the machine.

    `arguments` are the options of the command, and `content` its numbers, both by the names that they have in the file.
    """
    return {
        "command": command,
        "arguments": dict(arguments),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "machine": machine(),
        **content,
    }


def compact(value: float | None, digits: int = 2) -> str:
    """Format a number with `digits` significant digits in at most ``digits + 6`` characters.

    The result is "-" for None and for values that are not finite.

    Examples
    --------
    >>> [compact(x) for x in (0.0, 71.2, -0.8939, 0.0011, -3.6e-9, 123456.0, None)]
    ['0', '71', '-0.89', '1.1e-3', '-3.6e-9', '1.2e5', '-']
    """
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -2 <= power <= 2:
        return f"{float(f'{mantissa}e{power}'):.{max(digits - 1 - power, 0)}f}"
    return f"{mantissa}e{power}"


def table(head: Sequence[Sequence[str]], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Lay out a table with one column of labels and right-aligned cells, without a newline at the end.

    `head` has the lines of each column's head, one sequence for each column. `rows` are pairs (label, cells); a row
    without cells is a heading.
    """
    body = list(rows)
    first = max(len(label) for label, cells in body if cells)
    widths = [max(map(len, lines)) for lines in head]
    for _, cells in body:
        widths = [max(width, len(cell)) for width, cell in zip(widths, cells, strict=True)] if cells else widths
    height = max(map(len, head))
    columns = [[*lines, *[""] * (height - len(lines))] for lines in head]
    lines = [("", [column[k] for column in columns]) for k in range(height)]
    rule = "-" * (first + sum(width + 1 for width in widths))
    text = [_line(label, cells, first, widths) for label, cells in lines]
    text += [rule, *(_line(label, cells, first, widths) for label, cells in body)]
    return "\n".join(text)


def _line(label: str, cells: Sequence[str], first: int, widths: Sequence[int]) -> str:
    if not cells:
        return label
    text = f"{label:<{first}}" + "".join(f" {cell:>{width}}" for cell, width in zip(cells, widths, strict=True))
    return text.rstrip()


def say(text: str = "") -> None:
    """Print on stdout, in the characters that it has."""
    encoding = sys.stdout.encoding or "utf-8"
    print(text.encode(encoding, "replace").decode(encoding), flush=True)


def warn(message: str) -> None:
    """Print one line for the user on stderr."""
    print(f"eip-scipy: {message}", file=sys.stderr, flush=True)


def write_file(path: Path, write: Callable[[Path], Any]) -> Path:
    """Let `write` fill a temporary file that then replaces `path`, and return `path`.

    ``write(temporary_path)`` gets a path with the suffix of `path`. An interruption leaves no incomplete file.
    """
    temporary = path.with_name(f".{path.stem}-{os.getpid()}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def write_json(path: Path, content: Any) -> Path:
    """Write `content` as JSON; arrays become lists, and numbers that are not finite null, since JSON has no NaN."""
    text = json.dumps(_plain(content), indent=1, allow_nan=False) + "\n"
    return write_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write rows as CSV; the header has the names of the first row's entries. An empty cell is a missing number."""

    def write(temporary: Path) -> None:
        with open(temporary, "w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(rows[0]) if rows else [])
            writer.writeheader()
            writer.writerows(_plain(row) for row in rows)

    return write_file(path, write)


def _plain(value: Any) -> Any:
    """Convert `value` to types that JSON has, with None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)
