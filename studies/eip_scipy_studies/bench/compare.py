"""Times at equal error: our best method compared with each package, with the reason if a package is faster."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ..work_precision import cost_to_reach
from .peers import COMPILED, OWN, PEERS, PYTHON

LEVELS = (1e-6, 1e-9)


class Row(NamedTuple):
    """Result of a method of one package on a problem at one setting, or its failure; a line of the CSV file.

    The fields are the name of the suite, the title of the problem, the kind of function that the method takes (see
    `Peer`), the name of the method, and its relative tolerance or number of steps. `seconds` is the least time of a
    run; in the suite "overhead" the time that is added to each evaluation, in "first-use" the time from the start of
    the process to its first answer. `error` and `drift` are defined by `Scene`. `said` is the first line of an error,
    or another remark.
    """

    suite: str
    scene: str
    takes: str
    peer: str
    setting: float | None = None
    seconds: float | None = None
    error: float | None = None
    drift: float | None = None
    said: str = ""


class Standing(NamedTuple):
    """Comparison of another package's method (`peer`) with our best method at the error `level` of the final state.

    The first four fields are those of `Row`. `seconds` is the time of the other method to reach this error, nan if none
    of its runs did. `best` is the name of our method that is fastest at this error ("none of ours" if none of our runs
    reached it), and `ours` its time in seconds, or inf. `tried` are the seconds of the longest run of the other method.
    `bound` is True if `seconds` is an upper bound, because the method's first run is at least as accurate as `level`.
    """

    suite: str
    scene: str
    takes: str
    peer: str
    level: float
    seconds: float
    best: str
    ours: float
    tried: float = 0.0
    bound: bool = False

    @property
    def ratio(self) -> float:
        """Return the other method's time divided by ours: above 1 if ours is faster."""
        return self.seconds / self.ours

    @property
    def lost(self) -> bool:
        """Return True if the other method is faster."""
        return self.ratio < 1


def groups(rows: Iterable[Row]) -> dict[tuple[str, str, str], dict[str, list[Row]]]:
    """Group the runs that have a time and a finite error.

    The keys are (suite, problem, kind of function); each value holds lists of runs by the name of the method.
    """
    found: dict[tuple[str, str, str], dict[str, list[Row]]] = {}
    for row in rows:
        if row.seconds is not None and row.error is not None and math.isfinite(row.error):
            found.setdefault((row.suite, row.scene, row.takes), {}).setdefault(row.peer, []).append(row)
    return found


def standings(rows: Iterable[Row], levels: Sequence[float] = LEVELS) -> list[Standing]:
    """Compare each method of another package with our best method for the same kind of function, at each of `levels`.

    If none of our methods takes this kind of function, our best one that takes compiled functions is used.
    `levels` are errors of the final state.
    """
    known = groups(rows)
    found = []
    for (suite, scene, takes), peers in known.items():
        others = [name for name in peers if not PEERS[name].ours]
        our_runs = _ours(peers) or _ours(known.get((suite, scene, COMPILED), {}))
        for level in levels:
            costs = {name: _cost(runs, level) for name, runs in our_runs.items()}
            reached = {name: cost for name, cost in costs.items() if math.isfinite(cost)}
            best = min(reached, key=reached.__getitem__, default="none of ours")
            ours = reached.get(best, math.inf)
            for name in others:
                runs = peers[name]
                tried, bound = max(row.seconds or 0.0 for row in runs), (runs[0].error or 0.0) <= level
                found.append(Standing(suite, scene, takes, name, level, _cost(runs, level), best, ours, tried, bound))
    return found


def _ours(peers: dict[str, list[Row]]) -> dict[str, list[Row]]:
    return {name: runs for name, runs in peers.items() if PEERS[name].ours}


def _cost(runs: Sequence[Row], level: float) -> float:
    return cost_to_reach([row.seconds for row in runs], [row.error for row in runs], level)


# Reasons why a package is faster, by the beginnings of suite, problem and package, and the kind of function. The first
# that fits is printed, and only with a measured loss.
CHECKS = "Each call of ours begins with checks of invariants and gradients, a large part of so short a run."
CHEAP = (
    "Its loop is compiled and calls nothing but the function; ours calls the invariants and their gradients too, and "
    "where errors grow as slowly without projection that is not earned back."
)
UNPROJECTED = (
    "The same steps without the projection, whose invariants and gradients are further calls: where errors grow as "
    "slowly without it that is not earned back."
)
PLANETS = (
    "It is made for planets: each orbit around the Sun is followed exactly, and only what the planets do to each other "
    "is stepped over; ours takes any force."
)
TAYLOR = (
    "A Taylor series of high order, whose coefficients are compiled for these very equations and this tolerance; the "
    "equations must be written as its expressions, while ours takes any function."
)
REASONS: tuple[tuple[str, str, str, str, str], ...] = (
    ("solar", "", OWN, "REBOUND WHFast", PLANETS),
    ("", "", OWN, "heyoka", TAYLOR),
    ("solar", "outer", COMPILED, "", CHECKS),
    ("particle", "", COMPILED, "", CHECKS),
    ("", "", PYTHON, "SciPy", UNPROJECTED),
    ("", "", PYTHON, "CyRK", CHEAP),
    ("", "", COMPILED, "", CHEAP),
)


def reason(standing: Standing) -> str:
    """Return why the other method is faster; empty if it is not, or if no reason is known."""
    if not standing.lost:
        return ""
    for suite, scene, takes, peer, why in REASONS:
        if (
            standing.suite.startswith(suite)
            and standing.scene.startswith(scene)
            and takes in ("", standing.takes)
            and standing.peer.startswith(peer)
        ):
            return why
    return ""
