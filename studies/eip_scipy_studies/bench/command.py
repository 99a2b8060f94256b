"""``eip-scipy bench``: error against cost with functions of a user, compared with other packages."""

from __future__ import annotations

from datetime import UTC, datetime

from ..output import Output
from ..report import UsageError, describe_machine
from .cases import CASES
from .measure import LEVELS, Measured, everything, seconds_at
from .report import markdown


def bench(
    out: Output,
    case: tuple[str, ...] = ("all",),
    *,
    solvers: tuple[str, ...] = (),
    enough: float = 0.5,
    patience: float = 4.0,
) -> None:
    """Compare this package, with functions as a user writes them, with SciPy, REBOUND, heyoka and others.

    Each solver runs each problem in a process of its own, with finer and finer settings.

    Parameters
    ----------
    case : tuple of str
        problems (default: all)
    solvers : tuple of str
        beginnings of the names of solvers (default: all)
    enough : float
        seconds after which a setting is not repeated (default: 0.5)
    patience : float
        seconds of a call after which no finer setting follows (default: 4)
    """
    chosen = tuple(CASES) if "all" in case else case
    if unknown := [name for name in chosen if name not in CASES]:
        raise UsageError(f"unknown problems {unknown}; expected all, or some of {list(CASES)}")
    found: list[Measured] = []
    with out.keep(), out.bar(None, "bench", unit="solver") as bar:
        for measured in everything(chosen, solvers, enough, patience):
            found.append(measured)
            bar.set_postfix_str(f"{measured.case}: {measured.solver}")
            bar.update()
    at = [
        {
            "case": each.case, "solver": each.solver, "compilation": each.compilation, "said": each.said,
            **{f"{level:.0e}": seconds_at(each.runs, level)[0] for level in LEVELS},
        }
        for each in found
    ]  # fmt: skip
    out.numbers["rows"] = [run._asdict() for each in found for run in each.runs]
    out.rows("bench.csv", out.numbers["rows"])
    out.rows("bench-equal-error.csv", at)
    page = markdown(found, f"{describe_machine()}, {datetime.now(UTC):%Y-%m-%d}")
    out.file("bench.md", lambda path: path.write_text(page, encoding="utf-8"))
    out.text(page)
