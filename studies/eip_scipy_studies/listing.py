"""``eip-scipy list``: commands, methods, problems and data sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import eip_scipy
from eip_scipy import problems
from eip_scipy.problems import solar_data
from eip_scipy.solvers import EIPSolver

from . import comparators, hard_cases
from .commands import COMMANDS
from .study import Session, Study

METRICS = ("error", "euclidean")

Found = dict[str, dict[str, str]]


def fixed_step_methods() -> dict[str, type[EIPSolver]]:
    """Return the solver classes of `eip_scipy` that have a tableau of coefficients, by their names."""
    found = {name: getattr(eip_scipy, name) for name in eip_scipy.__all__ if name.startswith("EIP")}
    return {name: value for name, value in found.items() if hasattr(value, "TABLEAU")}


@dataclass(frozen=True, kw_only=True)
class Listing(Study[Found]):
    """Command ``eip-scipy list``."""

    writes_files = False

    def measure(self, session: Session) -> Found:
        """Return, for each heading such as "methods", names with a line of description, mostly from docstrings."""
        sets = {name: solar_data.load(name) for name in solar_data.available()}
        others = {name: getattr(comparators, name) for name in comparators.__all__}
        functions = {name: make for name in problems.__all__ if _is_function(make := getattr(problems, name))}
        functions["hard_cases"] = hard_cases.hard_cases
        return {
            "commands": {name: entry.summary for name, entry in COMMANDS.items()},
            "methods": {name: _first_line(method) for name, method in fixed_step_methods().items()},
            "comparators": {name: _first_line(make) for name, make in others.items() if not isinstance(make, type)},
            "problems": {name: _first_line(make) for name, make in functions.items() if _makes_problems(make)},
            "for problems": {name: _first_line(make) for name, make in functions.items() if not _makes_problems(make)},
            "data": {name: f"{len(data.bodies)} bodies at {data.epoch}, {data.axes}" for name, data in sets.items()},
        }

    def text(self, found: Found) -> str:
        lines = []
        for heading, entries in found.items():
            width = max(map(len, entries))
            lines += [f"{heading}:", *(f"  {name:<{width}}  {text}".rstrip() for name, text in entries.items())]
        return "\n".join(lines)

    def numbers(self, found: Found) -> dict[str, Any]:
        return dict(found)


def _is_function(item: Any) -> bool:
    return callable(item) and not isinstance(item, type)  # neither records nor fields


def _makes_problems(function: Any) -> bool:
    made = str(function.__annotations__.get("return"))  # a time scale has no return type
    return "Problem" in made or "HardCase" in made


def _first_line(item: Any) -> str:
    return (item.__doc__ or "").strip().split("\n")[0].split(". ")[0].rstrip(".")
