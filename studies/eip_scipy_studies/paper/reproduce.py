"""``eip-scipy reproduce table1 ... table5 fig-kepler ... all``: the paper's tables and figures, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from ..commands import CHECK_FAILED, DONE, INTERRUPTED
from ..condensates.efficiency import efficiency
from ..kepler.figures import KeplerFigures
from ..output import Output
from ..particles.charged_particle import paper_figure
from ..report import document, write_json
from ..solar.solar_system import SolarSystem
from ..study import Command, Session, Study, option, perform
from .tables import TABLES, PaperTable

Make = Callable[[], Study[Any]]
STUDIES: dict[str, Make] = {
    **{name: partial(PaperTable, name=name) for name in TABLES},
    "fig-kepler": KeplerFigures,
    "fig-solar": SolarSystem,
}
FIGURES: dict[str, Callable[[Output], None]] = {
    "fig-particle": partial(paper_figure, name="fig-particle"),
    "fig-tokamak": partial(paper_figure, name="fig-tokamak"),
    "fig-efficiency": efficiency,
}


@dataclass(frozen=True, kw_only=True)
class Reproduce(Command):
    """Command ``eip-scipy reproduce``."""

    table: Sequence[str] = option(
        (),
        f"{', '.join([*STUDIES, *FIGURES])} or all; several may be given",
        positional=True,
        nargs="+",
        choices=(*STUDIES, *FIGURES, "all"),
        metavar="WHAT",
    )
    studies: Mapping[str, Make] = field(default_factory=lambda: STUDIES)

    def run(self, session: Session) -> int:
        """Run the studies of the chosen tables and figures in turn, and return the exit status.

        If a JSON file is wanted, it is one for all; its lists `cells` and `orders` hold the numbers of all tables.
        """
        session.out.mkdir(parents=True, exist_ok=True)
        wanted = list(dict.fromkeys([*self.studies, *FIGURES] if "all" in self.table else self.table))
        content: dict[str, Any] = {"cells": [], "orders": []}
        status = DONE
        for k, name in enumerate(wanted):
            if k > 0:
                session.say()
            own = Session(name, session.out, None, session.quiet, session.absent)
            if name == "fig-solar":  # a separate command, which leaves its numbers
                own.name, own.json = "solar-system", session.out / "solar-system.json"
            if name in FIGURES:
                out = Output(own.out, quiet=own.quiet)
                FIGURES[name](out)
                judged, numbers = DONE if out.passed else CHECK_FAILED, out.numbers
            else:
                judged, numbers = perform(self.studies[name](), own)
            if judged == INTERRUPTED:
                return INTERRUPTED
            status = max(status, judged)
            if name in TABLES:
                content = {**content, **{kind: content[kind] + numbers[kind] for kind in ("cells", "orders")}}
            else:
                content[name] = numbers
        content["passed"] = status == DONE
        if session.json is not None:
            session.wrote(write_json(session.json, document(session.name, {"table": wanted}, **content)))
            session.name_files()
        return status
