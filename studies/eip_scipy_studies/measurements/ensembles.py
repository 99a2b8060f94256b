"""``eip-scipy study ensembles``: cost of a member of an ensemble, and the gain from more cores and workers.

Kepler's problem with H and L, EIPRK4, fixed step. Runs that are compared take turns, and the least times count. Next to
the wall time is the processor time of the same work, which other load on the machine hardly affects.

1. One thread against the loop of single runs that are already set up (their `wall_time`), per step.
2. Two threads against one; two Dask workers on the loopback interface against one.
3. Peak memory of processes with `members`, a tenth and ten times as many, their trajectories reduced; not on Windows.
4. The whole job, `members` of `steps` steps each, on all cores.
5. Time against the number of members, 1e2 to the largest, with `curve_steps` steps each.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.problems import kepler

from ..report import needed, table
from ..study import Figures, Measurement, Rows, Session, option

H = 0.03
PEAK_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes in a unit of ru_maxrss
MEMORY = """
import resource
from eip_scipy import ensemble
from eip_scipy.problems import kepler
from eip_scipy_studies.measurements.ensembles import starts
members = {members}
y0s = starts(members)
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
run = ensemble(kepler(), (0, 300 * {h}), y0s, h={h}, save_every=3, reduce=lambda run: run.y.max())
assert run.success and run.reduced.shape == (members,)
print(base, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def starts(members: int) -> np.ndarray:
    return kepler().y0 * (1 + 1e-3 * np.random.default_rng(1).standard_normal((members, 4)))


def seconds(members: int, steps: int, executor: Any) -> float:
    """Return the wall time in seconds of an ensemble of Kepler orbits, from call to result.

    `executor` is that of `ensemble`: a number of threads or a client of Dask.
    """
    y0s = starts(members)
    begin = time.perf_counter()
    run = ensemble(kepler(), (0.0, steps * H), y0s, h=H, executor=executor)
    elapsed = time.perf_counter() - begin
    assert run.success
    return elapsed


def single(members: int, steps: int) -> float:
    """Return the total wall time in seconds of `members` single runs, without the time before their steps."""
    problem, y0s = kepler(), starts(members)
    return sum(integrate(problem, (0.0, steps * H), y0, method=EIPRK4, h=H, check=False).wall_time for y0 in y0s)


def in_turns(
    actions: Mapping[str, tuple[Callable[[], float], Callable[[], float]]], repeats: int
) -> dict[str, dict[str, float]]:
    """Return the least wall and processor time in seconds of each action, by the name of the action.

    An action is a pair: a clock of the processor time of its workers, and a function that returns the seconds it took.
    The actions take turns, `repeats` times.
    """
    found = {name: {"wall": np.inf, "processor": np.inf} for name in actions}
    for _ in range(repeats):
        for name, (clock, action) in actions.items():
            begin = clock()
            row = found[name]
            row["wall"] = min(row["wall"], action())
            row["processor"] = min(row["processor"], clock() - begin)
    return found


def threads(members: int, steps: int, repeats: int) -> dict[str, dict[str, float]]:
    """Return the times, as from `in_turns`, of single runs, an ensemble on one thread, and one on two threads."""
    ways = {
        "single runs, loop only": lambda: single(members, steps),
        "one thread": lambda: seconds(members, steps, 1),
        "two threads": lambda: seconds(members, steps, 2),
    }
    return in_turns({name: (time.process_time, way) for name, way in ways.items()}, repeats)


def workers(members: int, steps: int, repeats: int) -> dict[str, dict[str, float]]:
    """Return the times, as from `in_turns`, of an ensemble on one worker of Dask, and on two."""
    distributed = needed("distributed", '"eip_scipy[distributed]"')
    here = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    clients = {
        name: distributed.Client(distributed.LocalCluster(n_workers=count, **here))
        for count, name in enumerate(("one Dask worker", "two Dask workers"), 1)
    }
    try:
        for client in clients.values():
            seconds(members, 10, client)  # exclude the one-time work of a worker
        actions = {
            name: (lambda c=c: sum(c.run(time.process_time).values()), lambda c=c: seconds(members, steps, c))
            for name, c in clients.items()
        }
        return in_turns(actions, repeats)
    finally:
        for client in clients.values():
            client.close()
            client.cluster.close()


def memory(members: int) -> dict[str, float]:
    """Return the memory of a process that runs an ensemble, with the number of members.

    It is given as the size that all states would have if they were stored ("states", in units of 1e6 bytes), the peak
    of the process ("peak") and the peak less the memory after the imports and the making of the starts ("above"; these
    two in units of 2^20 bytes).
    """
    code = MEMORY.format(members=members, h=H)
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    base, peak = (int(text) * PEAK_UNIT / 2**20 for text in printed.split())
    return {"members": members, "states": members * 101 * 32 / 1e6, "peak": peak, "above": peak - base}


@dataclass(frozen=True, kw_only=True)
class Ensembles(Measurement[dict[str, Any]]):
    """Command ``eip-scipy study ensembles``."""

    writes_files = True
    members: int = option(10_000, "members of the whole job on all cores (default: %(default)s)", type=int)
    steps: int = option(10_000, "steps of each of these members (default: %(default)s)", type=int)
    repeats: int = option(5, "number of times that each comparison is repeated (default: %(default)s)", type=int)
    largest: int = option(
        1_000_000, "largest number of members in the curve of time against members (default: %(default)s)", type=int
    )
    curve_steps: int = option(200, "steps of each member in this curve (default: %(default)s)", type=int)

    def measure(self, session: Session) -> dict[str, Any]:
        seconds(16, self.steps, None)  # compile before the measurement
        few = max(16, self.members // 10)
        compared = threads(few, self.steps, self.repeats) | workers(few, self.steps, self.repeats)
        return {
            "compared": compared,
            "memory": [memory(count) for count in self._sizes()],
            "whole": seconds(self.members, self.steps, None),
            "curve": [self._point(count) for count in self._counts()],
        }

    def _sizes(self) -> list[int]:
        # The module resource, which knows the peak, is missing on Windows.
        return [self.members // 10, self.members, 10 * self.members] if find_spec("resource") else []

    def _counts(self) -> list[int]:
        return [10**k for k in range(2, 10) if 10**k <= self.largest] or [self.largest]

    def _point(self, count: int) -> dict[str, float]:
        repeats = self.repeats if count < 10**5 else 1
        best = min(seconds(count, self.curve_steps, None) for _ in range(repeats))
        return {"members": count, "steps": self.curve_steps, "seconds": best, "us per member": 1e6 * best / count}

    def table(self, found: dict[str, Any]) -> str:
        few = max(16, self.members // 10)
        scale = 1e6 / (few * self.steps)
        body = [
            (name, [f"{row['wall'] * scale:.3f}", f"{row['processor'] * scale:.3f}"])
            for name, row in found["compared"].items()
        ]
        parts = [
            f"{few} members x {self.steps} steps\n\n"
            + table([["wall time", "[us per step]"], ["processor", "[us per step]"]], body),
            *(
                f"{row['members']} members, 101 states each ({row['states']:.0f} MB) reduced: peak "
                f"{row['peak']:.0f} MB, {row['above']:.0f} MB above the imports and starts"
                for row in found["memory"]
            ),
            f"{self.members} members x {self.steps} steps on all cores: {found['whole']:.1f} s",
        ]
        curve = [
            (str(row["members"]), [f"{row['seconds']:.3f}", f"{row['us per member']:.1f}"]) for row in found["curve"]
        ]
        head = [["[s]"], ["us per", "member"]]
        return "\n\n".join([*parts, f"Members of {self.curve_steps} steps on all cores\n\n{table(head, curve)}"])

    def tables(self, found: dict[str, Any]) -> dict[str, Rows]:
        return {"ensembles.csv": found["curve"]}

    def figures(self, found: dict[str, Any]) -> Figures:
        """Draw the total time against the number of members, with a line of slope 1, and the time per member."""
        from eip_scipy.plotting import PALETTE

        from ..plotting import blank_figure

        members, wall = (np.array([row[name] for row in found["curve"]]) for name in ("members", "seconds"))
        figure = blank_figure(10, 4.4, f"Kepler, EIPRK4 with H and L, {self.curve_steps} steps a member, all cores")
        left, right = figure.subplots(1, 2, sharex=True)
        left.loglog(members, wall, color=PALETTE[0], marker="o", label="ensemble")
        left.loglog(members, wall[-1] * members / members[-1], color="0.5", ls=":", label="slope 1")
        left.set_ylabel("wall time [s]")
        left.legend(frameon=False)
        right.semilogx(members, 1e6 * wall / members, color=PALETTE[0], marker="o")
        right.set_ylim(bottom=0)
        right.set_ylabel("wall time of a member [µs]")
        for axis in (left, right):
            axis.set_xlabel("members")
            axis.grid(alpha=0.3)
        yield "ensembles.png", figure
