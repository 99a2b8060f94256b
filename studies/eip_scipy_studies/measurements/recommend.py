"""``eip-scipy study recommend``: accuracy of `recommend` on the 35 hard cases.

The table has the wanted, the expected and the true error of the recommended run; the true one is that of
`recommendation.run()` against the exact final state. Below it are the numbers of cases whose true error is between 0.1
and 10 times the wanted error, at most 10 times the wanted error, and between 0.1 and 10 times the expected error. Times
are those of the search and of the run.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from eip_scipy import recommend

from ..hard_cases import HardCase, hard_cases
from ..report import table
from ..study import Measurement, Session, option

FACTOR = 10.0


def recommended(case: HardCase, wanted: float) -> dict[str, Any]:
    start = time.perf_counter()
    choice = recommend(case.problem, error=wanted)
    searched = time.perf_counter()
    run = choice.run()
    options = {name: value for name, value in choice.options.items() if isinstance(value, (str, float, bool))}
    return {
        "case": case.name,
        "wanted": wanted,
        "expected": choice.error,
        "true": case.error(run.y[:, -1]),
        "method": choice.method.__name__,
        "options": options,
        "trusted": choice.trusted and run.trusted,
        "nfev": run.nfev,
        "trials": len(choice.trials),
        "search_seconds": searched - start,
        "run_seconds": time.perf_counter() - searched,
    }


@dataclass(frozen=True, kw_only=True)
class Recommended(Measurement[list[dict[str, Any]]]):
    """Command ``eip-scipy study recommend``."""

    errors: Sequence[float] = option((1e-6,), "wanted errors (default: 1e-6)", type=float, nargs="+")
    cases: Sequence[str] | None = option(None, "names of the cases to run (default: all)", nargs="+", metavar="NAME")

    def measure(self, session: Session) -> list[dict[str, Any]]:
        found, cases = [], hard_cases(self.cases)
        with session.bar(len(self.errors) * len(cases), "recommend", "case") as bar:
            for wanted in self.errors:
                for case in cases:
                    try:
                        found.append(recommended(case, wanted))
                    except ValueError as error:
                        found.append({"case": case.name, "wanted": wanted, "failed": str(error)})
                    bar.update()
        return found

    def table(self, found: list[dict[str, Any]]) -> str:
        return "\n\n".join(self._table([row for row in found if row["wanted"] == wanted]) for wanted in self.errors)

    @staticmethod
    def _table(found: list[dict[str, Any]]) -> str:
        done, wanted = [row for row in found if "failed" not in row], found[0]["wanted"]
        heads = [
            ["wanted"],
            ["expected"],
            ["true"],
            ["true /", "wanted"],
            ["nfev"],
            ["search", "[s]"],
            ["run [s]"],
            [""],
        ]
        lines = [table(heads, [(row["case"], cells(row)) for row in done])] if done else []
        lines += [f"{row['case']}: {row['failed']}" for row in found if "failed" in row]
        both = sum(1 / FACTOR <= row["true"] / wanted <= FACTOR for row in done)
        above = sum(row["true"] <= FACTOR * wanted for row in done)
        expected = sum(1 / FACTOR <= row["true"] / row["expected"] <= FACTOR for row in done)
        searches, runs = (sum(row[key] for row in done) for key in ("search_seconds", "run_seconds"))
        lines += [
            f"wanted {wanted:g}, {len(found)} cases: true error within a factor of {FACTOR:g} of the wanted one in "
            f"{both}, at most {FACTOR:g} times it in {above}; within that factor of the expected one in {expected}",
            f"{searches:.0f} s for the searches, {runs:.1f} s for the runs",
        ]
        return "\n".join(lines)


def cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of the table for the result of `recommended` in one case."""
    shown = {key: value for key, value in row["options"].items() if key not in ("atol", "compensated")}
    options = ", ".join(f"{k}={v:g}" if isinstance(v, float) else f"{k}={v}" for k, v in shown.items())
    return [
        f"{row['wanted']:.0e}", f"{row['expected']:.1e}", f"{row['true']:.1e}", f"{row['true'] / row['wanted']:.2f}",
        str(row["nfev"]), f"{row['search_seconds']:.2f}", f"{row['run_seconds']:.2f}",
        f"{row['method']} {options}{'' if row['trusted'] else '  NOT TRUSTED'}",
    ]  # fmt: skip
