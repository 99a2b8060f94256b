"""``eip-scipy bench``: comparison of this package with other packages, each in its own process."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from time import perf_counter
from typing import Any

from eip_scipy import __version__

from ..report import UsageError, describe_machine
from ..study import Figures, PartlyDone, Rows, Session, Study, one_of, option
from .compare import Row, standings
from .figures import drawn
from .page import Found, html, markdown, text
from .peers import PEERS, Peer
from .process import ask
from .suites import SUITES, Suite


@dataclass(frozen=True, kw_only=True)
class Bench(Study[Found]):
    """Command ``eip-scipy bench``.

    There are at most `repeats` timed runs at each setting, of which the least time counts, and none after `enough`
    seconds in all. After a run longer than `patience` seconds finer settings of the same method and problem are left
    out, and after `limit` seconds the process of a method is stopped. The option ``suite`` chooses from `suites`, and
    ``peers`` from `field_of_peers`, all methods of all packages; those of this package are always run.
    """

    suite: Sequence[str] = option(
        ("all",),
        f"what to run (default: all): all, or some of {', '.join(SUITES)}",
        nargs="+",
        metavar="SUITE",
        type=one_of("suite", ("all", *SUITES)),
    )
    peers: Sequence[str] | None = option(
        None,
        "what to compare with: names of packages with pip, or beginnings of names of methods (default: all)",
        nargs="+",
        metavar="PEER",
    )
    repeats: int = 16
    enough: float = 0.12
    patience: float = 0.4
    limit: float = 90.0
    suites: Mapping[str, Suite] = field(default_factory=lambda: SUITES)
    field_of_peers: Mapping[str, Peer] = field(default_factory=lambda: PEERS)

    def check_settings(self) -> None:
        """Raise a UsageError if an entry of `peers` is neither a package nor the beginning of the name of a method."""
        for name in self.peers or ():
            if not any(_is(peer, name) for peer in PEERS.values()):
                known = sorted({peer.distribution for peer in PEERS.values() if not peer.ours})
                raise UsageError(
                    f"the package {name!r} is not known; expected some of {', '.join(known)}, or beginnings of the "
                    "names of methods"
                )

    def measure(self, session: Session) -> Found:
        """Run all chosen methods on the problems of all chosen suites, one after the other, each in its own process."""
        found = Found(describe_machine(), datetime.now(UTC).strftime("%Y-%m-%d"))
        found.versions["eip_scipy"] = __version__
        asked = [
            (self.suites[name], peer, scenes)
            for name in (self.suites if "all" in self.suite else self.suite)
            for make in [self.suites[name].make()]
            for peer in self.field_of_peers.values()
            if self._chosen(peer) and (scenes := make(peer))
        ]
        try:
            with session.bar(len(asked), "bench", "peer") as bar:
                for suite, peer, scenes in asked:
                    bar.set_postfix_str(f"{suite.name}: {peer.name}")
                    if peer.distribution not in found.absent:
                        begin = perf_counter()
                        self._ask(found, suite.name, suite.task, peer, scenes)
                        found.took[suite.name, peer.name] = perf_counter() - begin
                    bar.update()
        except KeyboardInterrupt:
            raise PartlyDone(found) from None
        return found

    def _chosen(self, peer: Peer) -> bool:
        return peer.ours or self.peers is None or any(_is(peer, name) for name in self.peers)

    def _ask(self, found: Found, suite: str, task: str, peer: Peer, scenes: list[dict[str, Any]]) -> None:
        request = {
            "peer": peer.name, "task": task, "scenes": scenes, "repeats": self.repeats, "enough": self.enough,
            "patience": self.patience,
        }  # fmt: skip
        reply = ask(request, self.limit)
        if task == "first" and not reply.failed:  # the first process may have written bytecode
            reply = min(reply, ask(request, self.limit), key=lambda each: each.first or math.inf)
        if reply.version is not None:
            found.versions[peer.distribution] = reply.version
        missing = [answer["absent"] for answer in reply.answers if "absent" in answer]
        if missing:
            found.absent[peer.distribution] = missing[0]
            return
        rows = [_row(suite, peer, answer) for answer in reply.answers]
        if task == "first":
            rows = [row._replace(seconds=reply.first) if row.error is not None else row for row in rows]
        found.rows += rows
        if reply.failed:
            found.rows.append(Row(suite, scenes[-1]["title"], peer.takes, peer.name, said=reply.failed))

    def text(self, found: Found) -> str:
        """Return the report for the terminal: the tables of all suites, and the failures."""
        return text(found)

    def tables(self, found: Found) -> dict[str, Rows]:
        """Return the rows of two CSV files: the runs at all settings, and the comparison at equal error."""
        compared = [
            {**each._asdict(), "ratio": each.ratio if math.isfinite(each.ratio) else None}
            for each in standings(found.rows)
        ]
        return {"bench.csv": [row._asdict() for row in found.rows], "bench-equal-error.csv": compared}

    def numbers(self, found: Found) -> dict[str, Any]:
        """Return the runs at all settings, the versions of the packages, and the reasons why others did not run."""
        return {
            "rows": [row._asdict() for row in found.rows],
            "versions_of_peers": found.versions,
            "absent": found.absent,
        }

    def figures(self, found: Found) -> Figures:
        """Draw a figure for each problem and kind of function, and write the report that contains them."""
        pictures, names = {}, {}
        for where, name, figure in drawn(found.rows, found.machine):
            yield name, figure
            pictures[where], names[where] = figure, name
        yield "bench.html", lambda path: path.write_text(html(found, pictures), encoding="utf-8")
        yield "bench.md", lambda path: path.write_text(markdown(found, names), encoding="utf-8")


def _is(peer: Peer, name: str) -> bool:
    return name.lower() == peer.distribution.lower() or peer.name.lower().startswith(name.lower())


def _row(suite: str, peer: Peer, answer: dict[str, Any]) -> Row:
    known = {name: value for name, value in answer.items() if name in Row._fields}
    return Row(suite, known.pop("scene", ""), peer.takes, peer.name, **known)
