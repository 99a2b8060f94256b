"""The report as text for the terminal, as one page of HTML, and as Markdown for the documentation."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

from ..report import compact, table
from .compare import LEVELS, Row, Standing, reason, standings
from .figures import Where
from .peers import PEERS
from .suites import SUITES


@dataclass
class Found:
    """Everything that was measured on one machine at a date, year-month-day: runs and failures of all methods.

    `versions` of the packages, including ours, and `absent`, the reasons why packages did not run, are by their names
    with pip; `took` has the seconds that each method took, by suite and name of the method.
    """

    machine: str
    date: str
    rows: list[Row] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)
    took: dict[tuple[str, str], float] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """Table of the report: a heading, the heads of its columns, rows of cells, and lines below.

    `where` is the suite, the problem and the kind of function (`Row.takes`) of a table at equal error, and None for
    other tables.
    """

    title: str
    head: list[str]
    rows: list[list[str]]
    notes: list[str] = field(default_factory=list)
    where: Where | None = None


def _seconds(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if value * factor >= 1:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e6:.3g} us"


def _ratio(standing: Standing) -> str:
    if math.isfinite(standing.seconds):
        return ("< " if standing.bound else "") + _times(standing.ratio)
    least = standing.tried / standing.ours
    return f"> {_times(least)}" if least > 1 else "not reached"


def _times(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _equal_error(found: Found, suite: str) -> list[Table]:
    """Make a table for each problem and kind of function (`Row.takes`) of a suite.

    The tables contain the run time of each method at each error in `LEVELS`, and its ratio to that of our best method.
    """
    known = [each for each in standings(found.rows) if each.suite == suite]
    tables = []
    for where in dict.fromkeys((each.suite, each.scene, each.takes) for each in known):
        group = [each for each in known if (each.suite, each.scene, each.takes) == where]
        levels = [level for level in LEVELS if any(each.level == level for each in group)]
        head = [where[2]]
        ours, names = ["**ours**"], []
        for level in levels:
            best = next(each for each in group if each.level == level)
            head += [f"error {compact(level, 1)}", "by ours"]
            ours += [_seconds(best.ours), "1"]
            names.append(f"{best.best} at {compact(level, 1)}")
        rows = [ours]
        for peer in dict.fromkeys(each.peer for each in group):
            row = [peer]
            for level in levels:
                (each,) = [each for each in group if each.peer == peer and each.level == level]
                row += [("< " if each.bound else "") + _seconds(each.seconds), _ratio(each)]
            rows.append(row)
        notes = [f"Ours: {', '.join(names)}.", *_losses(group)]
        tables.append(Table(where[1], head, rows, notes, where))
    return tables


def _factor(value: float) -> str:
    """Format a ratio above 1 with enough digits not to read 1."""
    return f"{value:.3g}" if value < 1.1 else f"{value:.2g}"


def _losses(group: list[Standing]) -> list[str]:
    """Make a line for each reason why methods in `group` are faster than ours.

    The line lists these methods, each with the ratio of run times and the error at which they are compared.
    """
    by_reason: dict[str, list[str]] = {}
    for each in group:
        if each.lost:
            ahead = f"ahead by {_factor(1 / each.ratio)}" if each.ratio else "the only one that arrives"
            told = by_reason.setdefault(reason(each), [])
            told.append(f"{each.peer} is {ahead} at {compact(each.level, 1)}")
    return [f"{'; '.join(told)}. {why}".strip() for why, told in by_reason.items()]


def _first(found: Found) -> list[Table]:
    rows = sorted(
        (row for row in found.rows if row.suite == "first-use" and row.seconds), key=lambda row: row.seconds or 0
    )
    cells = [[row.peer, row.takes, _seconds(row.seconds), compact(row.error, 1)] for row in rows]
    return [Table("", ["", "takes", "whole process", "error"], cells)] if cells else []


def _overhead(found: Found) -> list[Table]:
    rows = [row for row in found.rows if row.suite == "overhead" and row.seconds is not None]
    rows.sort(key=lambda row: row.seconds or 0.0)
    cells = [[row.peer, _seconds(row.seconds), row.said, compact(row.error, 1)] for row in rows]
    return [Table("", ["", "beyond the function, each", "", "error"], cells)] if cells else []


def _asked(found: Found) -> list[Table]:
    rows = [row for row in found.rows if row.suite == "asked" and row.said]
    tables = []
    for what in dict.fromkeys(row.scene for row in rows):
        tables.append(Table(what, ["", "what happened"], [[row.peer, row.said] for row in rows if row.scene == what]))
    return tables


OTHERS = {"first": _first, "overhead": _overhead, "asked": _asked}


def _tables(found: Found, suite: str) -> list[Table]:
    task = SUITES[suite].task
    return OTHERS[task](found) if task in OTHERS else _equal_error(found, suite)


def _failures(found: Found, suite: str) -> list[str]:
    """Return a line with the first error of each method on each problem of a suite; none for the suite "asked"."""
    if SUITES[suite].task == "asked":
        return []
    said: dict[str, str] = {}
    for row in found.rows:
        if row.suite == suite and row.said and row.seconds is None:
            said.setdefault(f"{row.peer}, {row.scene}", row.said)
    return [f"{who}: {what}" for who, what in said.items()]


def _field(found: Found) -> Table:
    """Make the table of the packages: version, and the functions they take or the reason why they did not run."""
    rows = []
    for name in dict.fromkeys(peer.distribution for peer in PEERS.values()):
        if name in found.versions or name in found.absent:
            takes = "; ".join(dict.fromkeys(peer.takes for peer in PEERS.values() if peer.distribution == name))
            rows.append([name, found.versions.get(name, "did not run"), found.absent.get(name, takes)])
    return Table("The field", ["package", "version", "takes, or why it did not run"], rows)


def _suites(found: Found) -> list[str]:
    return [name for name in SUITES if any(row.suite == name for row in found.rows)]


HOW = (
    "Each package runs in its own process, one after the other, with one thread. The error of the trajectory is the "
    "largest component of the difference to the exact final state, relative to its largest component; exact states are "
    "closed forms, or come from arithmetic of more digits. The time is that of a whole call, the least of several, "
    'without imports and compilation, interpolated to the error; "by ours" is the time divided by that of our cheapest '
    'method. Absolute tolerances are 0.001 of the relative ones, for all. "<": the cheapest run is more '
    'accurate than that. ">": no run was as accurate, and the ratio is that of the longest run; longer ones '
    "were not tried."
)


def text(found: Found) -> str:
    """Return all tables and failures as text for a terminal."""
    parts = [f"Side by side with the field, {found.date}", found.machine]
    for suite in _suites(found):
        parts += ["", f"=== {SUITES[suite].title} ===", SUITES[suite].note]
        for each in _tables(found, suite):
            body = [(row[0].strip("*"), row[1:]) for row in each.rows]
            parts += ["", each.title, table([[name] for name in each.head[1:]], body), *each.notes]
        parts += _failures(found, suite)
    if found.took:
        longest = max(found.took, key=found.took.__getitem__)
        all_of_it = (
            f"{sum(found.took.values()):.0f} s, the longest {found.took[longest]:.0f} s for {': '.join(longest)}"
        )
        parts += ["", f"{len(found.took)} times a package was asked, in {all_of_it}."]
    parts += ["", *(f"{name} did not run: {why}" for name, why in found.absent.items())]
    return "\n".join(parts).rstrip()


def markdown(found: Found, names: Mapping[Where, str]) -> str:
    """Return all tables and failures as Markdown, with links to the files `names` of the figures."""

    def cell(value: str) -> str:
        return value.replace("|", "\\|").replace("<", "&lt;").replace("__", "\\_\\_")

    def lay(each: Table, level: int) -> list[str]:
        # One problem has a table for each kind of function.
        title = each.title if each.where is None else f"{each.title}: {each.head[0]}"
        lines = [f"{'#' * level} {title}", ""] if title else []
        if each.where is not None and each.where in names:
            lines += [f"![{each.title}: error against time]({names[each.where]})", ""]
        lines += [f"| {' | '.join(map(cell, row))} |" for row in (each.head,)]
        lines += [f"|{'---|' * len(each.head)}"]
        lines += [f"| {' | '.join(map(cell, row))} |" for row in each.rows]
        return [*lines, "", *(f"- {note}" for note in each.notes), ""]

    parts = [f"Measured on {found.date}: {found.machine}.", "", HOW, "", *lay(_field(found), 2)]
    for suite in _suites(found):
        parts += [f"## {SUITES[suite].title}", "", SUITES[suite].note, ""]
        for each in _tables(found, suite):
            parts += lay(each, 3)
        parts += [*(f"- {line}" for line in _failures(found, suite)), ""]
    return "\n".join(parts)


STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 0 auto; max-width: 76rem;
  padding: 1rem; }
h1 { font-size: 1.7rem; margin: .5rem 0; } h2 { border-top: 2px solid #0072b2; padding-top: .6rem; margin-top: 2.5rem; }
h3 { margin-bottom: .3rem; } .kind, .meta { color: #555; font-weight: normal; }
nav a { margin-right: 1rem; white-space: nowrap; } a { color: #0060a0; }
.problem { display: grid; grid-template-columns: minmax(0, 26rem) minmax(0, 1fr); gap: 0 1.5rem; align-items: start; }
.problem.plain { grid-template-columns: minmax(0, 1fr); } .plain td, .plain th { text-align: left; }
img { width: 100%; height: auto; } .wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .86rem; } td, th { padding: .22rem .6rem; text-align: right;
  border-bottom: 1px solid #ddd; white-space: nowrap; } td:first-child, th:first-child { text-align: left; }
td.words { text-align: left; white-space: normal; min-width: 14rem; }
tr.ours td { background: #e8f2fa; font-weight: 600; }
td.lost { background: #fbe6d9; } ul { padding-left: 1.2rem; } li { font-size: .9rem; }
@media (max-width: 52rem) { .problem { grid-template-columns: minmax(0, 1fr); } body { padding: .6rem; } }
"""


def html(found: Found, figures: Mapping[Where, Any]) -> str:
    """Return one self-contained page: figures are inside, and no network is needed."""
    suites = _suites(found)
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width, initial-scale=1">',
        f"<title>eip_scipy compared with other packages</title><style>{STYLE}</style>",
        "<h1>Side by side with the field</h1>",
        f"<p class=meta>{escape(found.date)}, {escape(found.machine)}</p><p>{escape(HOW)}</p>",
        "<nav>" + " ".join(f'<a href="#{name}">{escape(SUITES[name].title)}</a>' for name in suites) + "</nav>",
        f"<section>{_scene(_field(found), figures)}</section>",
    ]
    for name in suites:
        said = "".join(f"<li>{escape(line)}" for line in _failures(found, name))
        scenes = "".join(_scene(each, figures) for each in _tables(found, name))
        parts.append(
            f'<section id="{name}"><h2>{escape(SUITES[name].title)}</h2><p>{escape(SUITES[name].note)}</p>{scenes}'
            f"{f'<ul>{said}</ul>' if said else ''}</section>"
        )
    return "\n".join(parts) + "</html>\n"


def _scene(each: Table, figures: Mapping[Where, Any]) -> str:
    picture = ""
    if each.where is not None and each.where in figures:
        data = io.BytesIO()
        figures[each.where].savefig(data, format="png", dpi=110)
        source = base64.b64encode(data.getvalue()).decode("ascii")
        picture = (
            f'<div><img alt="{escape(each.title)}: error against time" src="data:image/png;base64,{source}"></div>'
        )
    kind = f" <span class=kind>{escape(each.where[2])}</span>" if each.where else ""
    title = f"<h3>{escape(each.title)}{kind}</h3>" if each.title else ""
    rows = "".join(_line(row, each.head) for row in each.rows)
    notes = "".join(f"<li>{escape(note)}" for note in each.notes)
    head = "".join(f"<th>{escape(name)}" for name in each.head)
    return (
        f"{title}<div class='problem{'' if picture else ' plain'}'>{picture}<div><div class=wide><table><tr>{head}</tr>"
        f"{rows}</table></div>{f'<ul>{notes}</ul>' if notes else ''}</div></div>"
    )


def _line(row: list[str], head: list[str]) -> str:
    kind = " class=ours" if row[0] == "**ours**" else ""
    return f"<tr{kind}>" + "".join(_cell(value, name) for value, name in zip(row, head, strict=True)) + "</tr>"


def _cell(value: str, head: str) -> str:
    kind = " class=words" if len(value) > 40 else ""
    if head == "by ours" and value.lstrip("< ")[0].isdigit() and float(value.lstrip("< ")) < 1:
        kind = " class=lost"
    return f"<td{kind}>{escape(value.strip('*'))}"
