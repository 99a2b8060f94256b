"""Data files of the package."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

__all__ = ["read", "stored"]


@cache
def read(file: str) -> dict[str, Any]:
    """Return the content of a JSON file of this folder; it is shared, and must not be changed."""
    content: dict[str, Any] = json.loads(files(__name__).joinpath(file).read_text(encoding="utf-8"))
    return content


def stored(file: str, name: str, t: float) -> dict[str, Any] | None:
    """Return what a file of reference states has of the problem `name` at the time `t`; None if it has nothing."""
    rows = read(file)["states"][name]
    return next((row for row in rows if abs(t - row["t"]) <= 1e-14 * abs(row["t"])), None)
