"""Commands that take minutes: their options, and what `integrate` and the user are told of checkpoints."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import Any

from ..checkpoint import CheckpointError
from ..core.solvers import EIPSolver
from .report import UsageError, check_folder, warn

__all__ = ["add_arguments", "check", "checkpoint_options", "named", "positive", "tell_how_to_resume", "unusable"]


def add_arguments(parser: Any, runs: str) -> None:
    """Add ``--checkpoint DIR`` and ``--resume``.

    Parameters
    ----------
    parser : argparse.ArgumentParser or a group of it
    runs : str
        Whose checkpoints they are, for the help.
    """
    parser.add_argument("--checkpoint", type=Path, metavar="DIR", help=f"keep checkpoints of {runs} in DIR")
    parser.add_argument("--resume", action="store_true", help="with --checkpoint: go on from those that are in DIR")


def positive(text: str) -> float:
    """Read a finite number > 0.

    Raises
    ------
    ArgumentTypeError
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


def check(args: argparse.Namespace) -> None:
    """See that the options go together and the folder can be written to.

    Raises
    ------
    UsageError
    """
    if args.resume and args.checkpoint is None:
        raise UsageError("--resume needs the folder to resume from: --checkpoint DIR")
    if args.checkpoint is not None:
        check_folder(args.checkpoint)


def checkpoint_options(args: argparse.Namespace, name: str) -> dict[str, Any]:
    """Options of `integrate` for the checkpoints of the run of that name: one file each."""
    if args.checkpoint is None:
        return {}
    file = re.sub("[^A-Za-z0-9]+", "-", name).strip("-")
    return {"checkpoint": args.checkpoint / f"{file}.npz", "resume": args.resume}


def named(method: type[EIPSolver], name: str) -> type[EIPSolver]:
    """Put the method under another name, for its progress bar and for what is said of the run."""
    return type(name, (method,), {"__doc__": method.__doc__})


def tell_how_to_resume(args: argparse.Namespace) -> None:
    """After an interruption: say which command goes on, if there are checkpoints."""
    if args.checkpoint is not None:
        warn(f"the same command with --resume goes on from the checkpoints in {str(args.checkpoint)!r}")


def unusable(error: MemoryError | CheckpointError) -> UsageError:
    """What `integrate` refuses, as the command line says it."""
    if isinstance(error, MemoryError):
        return UsageError(f"not enough memory: {error}")
    return UsageError(f"{error} On the command line, resume=True is --resume.")
