"""``eip-scipy solar-system``: the paper's Experiment II as a table, figures and files."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from eip_scipy.problems import SolarSystemData
from eip_scipy.problems.gravity.solar_data import available, load

from ..beside import workers
from ..long_runs import METRICS, Checkpoints, fixed_step_methods, positive
from ..report import UsageError, cores
from ..study import Check, Figures, PartlyDone, Rows, Session, Study, option
from . import report
from .cost import cost, cost_methods
from .epoch import AnyEpoch, kernels, one_line
from .errors import SolarRuns
from .runs import MethodRun, Peer, make_scene, plan

DATA = "de440"
TEN_BODIES = [
    name for name in available() if len(load(name).bodies) == 10
]  # sets for which the tables and figures are made
COST_YEARS = 100.0
Start = Callable[..., Callable[[], Any]]  # from `workers`
BESIDE_FIGURES, OWN_FIGURES = (
    slice(None, 4),
    slice(4, None),
)  # both parts take about as long as the timings and the other figures


@dataclass
class Found:
    """Results of the command.

    `peer` is the function `run` of `eip_scipy.integrations.rebound`, or None if REBOUND is not installed. `beside`
    starts calls in the second process, which does the longest run and draws figures; it is None if there is none.
    `drawn` waits for the figures that it draws.
    """

    runs: SolarRuns
    peer: Peer | None
    beside: Start | None
    drawn: Callable[[], dict[str, bytes]] = dict


@dataclass(frozen=True, kw_only=True)
class SolarSystem(Checkpoints, AnyEpoch, Study[Found]):
    """Command ``eip-scipy solar-system``.

    From a length of `beside_years` on, a second process does the longest run; in shorter runs it costs more than it
    gains. For the error against cost, ``timed_methods(scene, method, metric, peer)`` returns the methods and steps as
    `cost_methods` does, and each is timed at most `repeats` times.
    """

    years: float = option(2000.0, "length in Julian years (default: %(default)g)", type=positive)
    h: float = option(0.002, "step in years, shortened to divide the run (default: %(default)s)", type=positive)
    method: str = option("EIPRK4", "method to show (default: %(default)s)", choices=list(fixed_step_methods()))
    metric: str = option("error", "metric of its projection (default: %(default)s)", choices=METRICS)
    data: str | None = option(None, f"initial data that the package carries (default: {DATA})", choices=TEN_BODIES)
    repeats: int = 3
    beside_years: float = 200.0
    timed_methods: Callable[..., Mapping[str, Any]] = cost_methods

    def check_settings(self) -> None:
        if self.data is not None and self.epoch is not None:
            raise UsageError("argument --epoch: not allowed with argument --data")
        if self.kernel is not None and self.epoch is None:
            raise UsageError(
                "--kernel goes with --epoch, which is missing: give the time in the kernel at which to start"
            )
        super().check_settings()

    def arguments(self) -> dict[str, Any]:
        known = {key: getattr(self, key) for key in ("years", "h", "method", "metric")}
        start = {"data": self.data or DATA} if self.epoch is None else {"epoch": self.epoch, "kernel": self.kernel}
        return known | start

    def measure(self, session: Session) -> Found:
        """Do the runs; if the user interrupts, the completed ones are kept."""
        method = fixed_step_methods()[self.method]
        with one_line():
            runs = SolarRuns(make_scene(self._start(), self.years, self.h), method.TABLEAU.order, repeats=self.repeats)
        rebound = session.peer("rebound", "WHFast and IAS15")
        peer = None if rebound is None else rebound.run
        alone = peer is None or self.years < self.beside_years or cores() < 2
        beside = None if alone else session.open.enter_context(workers(1))
        try:
            self._integrate(runs, session, peer, beside)
        except KeyboardInterrupt:
            if not runs.runs:
                raise
            raise PartlyDone(Found(runs, peer, beside)) from None
        return Found(runs, peer, beside)

    def _start(self) -> SolarSystemData:
        if self.epoch is None:
            return load(self.data or DATA)
        data: SolarSystemData = kernels().initial_data(self.epoch, self.kernel)
        return data

    def _integrate(self, runs: SolarRuns, session: Session, peer: Peer | None, beside: Start | None) -> None:
        """Do the runs and add them to `runs`; the last one is done in the second process, `beside`, if there is one."""
        method = fixed_step_methods()[self.method]
        tasks = plan(runs.scene, method, self.metric, peer, self.checkpoint_options)
        starts: list[Callable[[], MethodRun]] = [partial(task.start, session.shown) for task in tasks]
        if beside is not None:
            starts[-1], runs.beside = beside(tasks[-1].start, False), tasks[-1].name
        for task, start in zip(tasks, starts, strict=True):
            if task.has_bar:
                runs.runs.append(start())
            else:  # the current run, and its time
                with session.bar(1, task.name, bar_format="{desc}: {elapsed}", leave=True) as bar:
                    runs.runs.append(start())
                    bar.update()
        runs.tight = runs.runs[-1]

    def refine(self, found: Found, session: Session) -> bool:
        """Measure the times of several methods and steps, while the second process draws."""
        runs = found.runs
        if found.beside is not None:
            found.drawn = found.beside(images, runs, BESIDE_FIGURES)
        years = min(self.years, COST_YEARS)
        scene = runs.scene if years == self.years else make_scene(runs.scene.data, years, min(self.h, years))
        methods = self.timed_methods(scene, fixed_step_methods()[self.method], self.metric, found.peer)
        total = self.repeats * sum(len(steps) for _, steps in methods.values())
        with session.bar(total, "error against cost", leave=True) as bar:
            runs.cost = cost(scene, methods, found.peer, repeats=self.repeats, callback=bar.update)
        runs.cost_scene = scene
        return True

    def text(self, found: Found) -> str:
        return report.text(found.runs, self)

    def checks(self, found: Found) -> list[Check]:
        """Return checks of the run of the chosen method, and of the reference run."""
        return found.runs.checks()

    def tables(self, found: Found) -> dict[str, Rows]:
        timed = {"error-against-cost.csv": report.cost_rows(found.runs)} if found.runs.cost else {}
        return {"solar-system.csv": report.csv_rows(found.runs), **timed}

    def numbers(self, found: Found) -> dict[str, Any]:
        return report.json_content(found.runs)

    def figures(self, found: Found) -> Figures:
        """Yield figures as PNG files: those that the second process has drawn, and the others."""
        own = images(found.runs, slice(None) if found.beside is None else OWN_FIGURES)
        for name, image in (found.drawn() | own).items():
            yield name, partial(Path.write_bytes, data=image)


def images(runs: SolarRuns, part: slice) -> dict[str, bytes]:
    """Return the contents of PNG files by their names, for the figures in the slice `part` of `FIGURES`."""
    from .figures import figures

    found = {}
    for name, figure in figures(runs, part):
        stream = io.BytesIO()
        figure.savefig(stream, format="png")
        found[name] = stream.getvalue()
    return found
