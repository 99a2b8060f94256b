"""Commands that take minutes: their checkpoints, and the options of `integrate` for them."""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eip_scipy.solvers import EIPSolver

from .report import UsageError, check_folder
from .study import option

__all__ = ["Checkpoints", "named", "positive"]


@dataclass(frozen=True, kw_only=True)
class Checkpoints:
    """Settings of a study whose runs keep checkpoints; a base class that comes before `Study`."""

    checkpoint: Path | None = option(
        None, "keep checkpoints of the runs that this package does in DIR", type=Path, metavar="DIR"
    )
    resume: bool = option(False, "with --checkpoint: go on from those that are in DIR")

    def check_settings(self) -> None:
        """Check that the options go together and that the folder can be written to."""
        if self.resume and self.checkpoint is None:
            raise UsageError("--resume needs the folder to resume from: --checkpoint DIR")
        if self.checkpoint is not None:
            check_folder(self.checkpoint)

    def checkpoint_options(self, name: str) -> dict[str, Any]:
        """Return the options of `integrate` for the checkpoints of the run of that name: one file each."""
        if self.checkpoint is None:
            return {}
        file = re.sub("[^A-Za-z0-9]+", "-", name).strip("-")
        return {"checkpoint": self.checkpoint / f"{file}.npz", "resume": self.resume}

    def when_interrupted(self) -> str:
        """Print the command that continues the run, if there are checkpoints."""
        if self.checkpoint is None:
            return ""
        return f"the same command with --resume goes on from the checkpoints in {str(self.checkpoint)!r}"


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


def named(method: type[EIPSolver], name: str) -> type[EIPSolver]:
    """Rename the method for its progress bar and for messages about the run."""
    return type(name, (method,), {"__doc__": method.__doc__})
