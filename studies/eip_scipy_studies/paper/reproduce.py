"""``eip-scipy reproduce table1 ... table5 fig-kepler ... all``: the paper's tables and figures, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from ..commands import DONE, INTERRUPTED
from ..condensates.efficiency import Efficiency
from ..kepler.figures import KeplerFigures
from ..output import run
from ..particles.charged_particle import ChargedParticle
from ..report import document, write_json
from ..solar.command import solar_system
from ..study import Command, Session, option, perform
from .tables import TABLES, PaperTable

Make = Callable[..., Any]
STUDIES: dict[str, Make] = {
    **{name: partial(PaperTable, name=name) for name in TABLES},
    "fig-kepler": KeplerFigures,
    "fig-solar": partial(run, "solar-system", solar_system),
    "fig-particle": partial(ChargedParticle, scenes=("uniform",), paper_only=True, stem="fig-particle"),
    "fig-tokamak": partial(
        ChargedParticle, scenes=("tokamak-banana", "tokamak-transit"), paper_only=True, stem="fig-tokamak"
    ),
    "fig-efficiency": Efficiency,
}


@dataclass(frozen=True, kw_only=True)
class Reproduce(Command):
    """Command ``eip-scipy reproduce``."""

    table: Sequence[str] = option(
        (),
        f"{', '.join(STUDIES)} or all; several may be given",
        positional=True,
        nargs="+",
        choices=(*STUDIES, "all"),
        metavar="WHAT",
    )
    studies: Mapping[str, Make] = field(default_factory=lambda: STUDIES)

    def run(self, session: Session) -> int:
        """Run the studies of the chosen tables and figures in turn, and return the exit status.

        If a JSON file is wanted, it is one for all; its lists `cells` and `orders` hold the numbers of all tables.
        """
        session.out.mkdir(parents=True, exist_ok=True)
        wanted = list(dict.fromkeys(self.studies if "all" in self.table else self.table))
        content: dict[str, Any] = {"cells": [], "orders": []}
        status = DONE
        for k, name in enumerate(wanted):
            if k > 0:
                session.say()
            own = Session(name, session.out, None, session.quiet, session.absent)
            if name == "fig-solar":  # a separate command, which leaves its numbers
                words = ["--cost", "--out", str(session.out), "--json", str(session.out / "solar-system.json")]
                status = max(status, self.studies[name]([*words, *["--quiet"] * session.quiet]))
                continue
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
