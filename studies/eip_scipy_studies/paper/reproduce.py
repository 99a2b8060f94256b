"""``eip-scipy reproduce table1 ... table5 fig-kepler ... all``: the paper's tables and figures, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from ..condensates.efficiency import efficiency
from ..output import Output
from ..particles.charged_particle import paper_figure
from ..solar.command import solar_system
from .orbits import kepler_figures
from .tables import table

Name = Literal[
    "table1", "table2", "table3", "table4", "table5",
    "fig-kepler", "fig-solar", "fig-particle", "fig-tokamak", "fig-efficiency", "all",
]  # fmt: skip
FIGURES: dict[str, Callable[[Output], None]] = {
    "fig-kepler": kepler_figures,
    "fig-solar": partial(solar_system, cost=True),
    "fig-particle": partial(paper_figure, name="fig-particle"),
    "fig-tokamak": partial(paper_figure, name="fig-tokamak"),
    "fig-efficiency": efficiency,
}
PARTS: dict[str, Callable[[Output], None]] = {
    **{f"table{number}": partial(table, number=number) for number in range(1, 6)},
    **FIGURES,
}


def reproduce(out: Output, what: tuple[Name, ...]) -> None:
    """Recompute the paper's tables and figures, and compare with the printed numbers.

    The lists "cells" and "orders" of the JSON file have the numbers of all tables.

    Parameters
    ----------
    what : tuple of str
        table1 to table5, fig-kepler, fig-solar, fig-particle, fig-tokamak, fig-efficiency, or all
    """
    for k, name in enumerate(PARTS if "all" in what else dict.fromkeys(what)):
        if k:
            out.text()
        if name in FIGURES:
            part = Output(out.folder, quiet=out.quiet)
            PARTS[name](part)
            part.end()
            out.numbers[name], out.passed = part.numbers, out.passed and part.passed
            out.interrupted |= part.interrupted
        else:
            PARTS[name](out)
    out.numbers["passed"] = out.passed
