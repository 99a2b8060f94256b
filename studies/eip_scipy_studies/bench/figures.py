"""The figures of the report, one for each problem and kind of function."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

from .compare import LEVELS, Row, groups
from .peers import COMPILED, OWN, PEERS, PYTHON
from .suites import SUITES

Where = tuple[str, str, str]
"""Suite, problem and kind of function."""
SHORT = {PYTHON: "python", COMPILED: "compiled", OWN: "own"}


def drawn(rows: list[Row], machine: str) -> Iterator[tuple[Where, str, Any]]:
    """Yield (suite, problem, kind of function), file name and figure of each figure of error against time.

    `suite` is a key of `SUITES`, and the kind of function is `PYTHON`, `COMPILED` or `OWN`. `machine` is the footnote.
    """
    from ..plotting import side_by_side_figure

    known = groups(rows)
    for where, peers in known.items():
        suite, scene, takes = where
        if SUITES[suite].task != "precision":
            continue
        shown = dict(peers)
        if not any(PEERS[name].ours for name in shown):  # compare with the same methods of ours as the tables do
            compiled = known.get((suite, scene, COMPILED), {})
            shown |= {name: runs for name, runs in compiled.items() if PEERS[name].ours}
        series = {name: _arrays(runs) for name, runs in shown.items()}
        figure = side_by_side_figure(
            series,
            ours=[name for name in series if PEERS[name].ours],
            levels=LEVELS,
            title=f"{scene}: {takes}",
            footnote=machine,
        )
        slug = re.sub(r"[^a-z0-9]+", "-", f"{suite} {scene} {SHORT[takes]}".lower()).strip("-")
        yield where, f"bench-{slug}.png", figure


def _arrays(runs: list[Row]) -> dict[str, list[float]]:
    values = {key: [getattr(row, key) for row in runs] for key in ("seconds", "error", "drift")}
    return {key: [math.nan if value is None else value for value in column] for key, column in values.items()}
