"""Checkpoints of commands that take minutes, and options: methods, metrics and positive numbers."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import eip_scipy
from eip_scipy.solvers import EIPSolver

from .report import UsageError
from .study import option

METRICS = ("error", "euclidean")


@dataclass(frozen=True, kw_only=True)
class Checkpoints:
    """Options of a study whose runs keep checkpoints; among the base classes it must precede `Study`."""

    checkpoint: Path | None = option(
        None, "keep checkpoints of this package's own runs in the folder DIR", type=Path, metavar="DIR"
    )
    resume: bool = option(False, "continue from the checkpoints in the folder of --checkpoint")

    def check_settings(self) -> None:
        """Raise a UsageError if ``--resume`` comes without ``--checkpoint``; make the folder."""
        if self.resume and self.checkpoint is None:
            raise UsageError("--resume needs the folder to resume from: --checkpoint DIR")
        if self.checkpoint is not None:
            self.checkpoint.mkdir(parents=True, exist_ok=True)

    def checkpoint_options(self, name: str) -> dict[str, Any]:
        """Return the options with which `integrate` keeps checkpoints of the run `name` in a separate file.

        The dictionary is empty if no folder for checkpoints is given.
        """
        if self.checkpoint is None:
            return {}
        file = re.sub("[^A-Za-z0-9]+", "-", name).strip("-")
        return {"checkpoint": self.checkpoint / f"{file}.npz", "resume": self.resume}

    def when_interrupted(self) -> str:
        """Return a line that says how to continue, or "" without checkpoints."""
        if self.checkpoint is None:
            return ""
        return f"the same command with --resume goes on from the checkpoints in {str(self.checkpoint)!r}"


def number(what: str, fits: Callable[[Any], bool], convert: Callable[[str], Any] = float) -> Callable[[str], Any]:
    """Make the ``type`` of an option that accepts the numbers that `fits` accepts; `what` names them in messages."""

    def read(text: str) -> Any:
        with suppress(ValueError):
            if fits(value := convert(text)):
                return value
        raise argparse.ArgumentTypeError(f"expected {what}, got {text!r}")

    return read


positive = number("a positive number", lambda value: 0 < value < math.inf)


def fixed_step_methods() -> dict[str, type[EIPSolver]]:
    """Return the solver classes of `eip_scipy` that have a tableau of coefficients, by their names."""
    found = {name: getattr(eip_scipy, name) for name in eip_scipy.__all__ if name.startswith("EIP")}
    return {name: value for name, value in found.items() if hasattr(value, "TABLEAU")}


def named(method: type[EIPSolver], name: str) -> type[EIPSolver]:
    """Return a subclass of the method with this name, which progress bars and messages show."""
    return type(name, (method,), {"__doc__": method.__doc__})
