"""``eip-scipy bench``: error against cost with functions of a user, compared with other packages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from ..report import describe_machine
from ..study import Figures, PartlyDone, Rows, Session, Study, one_of, option
from .cases import CASES
from .measure import LEVELS, Measured, everything, seconds_at
from .report import markdown

Found = list[Measured]


@dataclass(frozen=True, kw_only=True)
class Bench(Study[Found]):
    """Command ``eip-scipy bench``.

    A setting is not run again after `enough` seconds, and no finer setting follows a call of more than `patience`.
    """

    case: Sequence[str] = option(
        ("all",),
        f"problems (default: all): all, or some of {', '.join(map(repr, CASES))}",
        nargs="+",
        metavar="CASE",
        type=one_of("problem", ("all", *CASES)),
    )
    solvers: Sequence[str] = option(
        (), "beginnings of the names of solvers (default: all)", nargs="+", metavar="SOLVER"
    )
    enough: float = 0.5
    patience: float = 4.0

    def measure(self, session: Session) -> Found:
        """Run all solvers that fit on all chosen problems, each in a process of its own."""
        found: Found = []
        chosen = tuple(CASES) if "all" in self.case else self.case
        try:
            with session.bar(None, "bench", "solver") as bar:
                for measured in everything(chosen, self.solvers, self.enough, self.patience):
                    found.append(measured)
                    bar.set_postfix_str(f"{measured.case}: {measured.solver}")
                    bar.update()
        except KeyboardInterrupt:
            raise PartlyDone(found) from None
        return found

    def text(self, found: Found) -> str:
        """Return the page, which is readable as text."""
        return markdown(found, f"{describe_machine()}, {datetime.now(UTC):%Y-%m-%d}")

    def numbers(self, found: Found) -> dict[str, Any]:
        """Return all runs."""
        return {"rows": [run._asdict() for each in found for run in each.runs]}

    def tables(self, found: Found) -> dict[str, Rows]:
        """Return the rows of two CSV files: all runs, and the times at equal error."""
        at = [
            {
                "case": each.case, "solver": each.solver, "compilation": each.compilation, "said": each.said,
                **{f"{level:.0e}": seconds_at(each.runs, level)[0] for level in LEVELS},
            }
            for each in found
        ]  # fmt: skip
        return {"bench.csv": self.numbers(found)["rows"], "bench-equal-error.csv": at}

    def figures(self, found: Found) -> Figures:
        """Write the page of the documentation."""
        yield "bench.md", lambda path: path.write_text(self.text(found), encoding="utf-8")
