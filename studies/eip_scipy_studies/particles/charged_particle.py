"""``eip-scipy charged-particle``: the paper's Experiment III by several methods, numbers, checks and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from eip_scipy.problems.particles.charged_particle import ORBITS

from ..report import warn
from ..study import Check, Figures, Rows, Session, Study, option
from . import report
from .runs import METHODS, PAPER_METHODS, SCENES, ParticleStudy, study

Found = dict[str, ParticleStudy]


@dataclass(frozen=True, kw_only=True)
class ChargedParticle(Study[Found]):
    """Command ``eip-scipy charged-particle``: runs in the uniform field and in the tokamak.

    `paper_only`: do only the runs of the paper's figures, and name the files as in ``eip-scipy reproduce``.
    """

    scenes: Sequence[str] = SCENES
    paper_only: bool = False
    stem: str = "charged-particle"

    def chosen(self) -> Sequence[str]:
        """Return the names of the problems to run, some of `SCENES`."""
        return self.scenes

    def measure(self, session: Session) -> Found:
        if find_spec("numba") is None:
            warn(
                "Numba is not installed, so the runs take hours in Python; they take about a minute after "
                'pip install "eip_scipy[numba]"'
            )
        runs = len(self.chosen()) * (1 + (len(PAPER_METHODS) if self.paper_only else len(METHODS) + 1))
        with session.bar(runs, "charged particle") as bar:
            return {name: study(name, paper_only=self.paper_only, callback=bar.update) for name in self.chosen()}

    def text(self, found: Found) -> str:
        return "\n\n".join(report.text(scene) for scene in found.values())

    def checks(self, found: Found) -> list[Check]:
        return [check for scene in found.values() for check in report.checks(scene)]

    def numbers(self, found: Found) -> dict[str, Any]:
        checks = self.checks(found)
        return {
            "scenes": {name: scene.numbers for name, scene in found.items()},
            "checks": [check.entry for check in checks],
            "passed": all(check.passed for check in checks),
        }

    def tables(self, found: Found) -> dict[str, Rows]:
        return {f"{self.stem}.csv": [row for scene in found.values() for row in report.rows(scene)]}

    def figures(self, found: Found) -> Figures:
        """Yield a file name and a figure for each field (uniform, tokamak), as in the paper."""
        for name, figure in report.figures(found, paper_only=self.paper_only):
            yield f"{self.stem}.png" if self.paper_only else f"{self.stem}-{name}.png", figure


@dataclass(frozen=True, kw_only=True)
class Uniform(ChargedParticle):
    """Command ``eip-scipy charged-particle uniform``."""

    scenes: Sequence[str] = SCENES[:1]


@dataclass(frozen=True, kw_only=True)
class Tokamak(ChargedParticle):
    """Command ``eip-scipy charged-particle tokamak``."""

    scenes: Sequence[str] = SCENES[1:]
    orbit: str | None = option(None, "run only this orbit; default: both", choices=tuple(ORBITS))

    def chosen(self) -> Sequence[str]:
        """Return the names of the tokamak problems to run: that of `orbit`, or both if it is None."""
        return [name for name in self.scenes if self.orbit in (None, name.removeprefix("tokamak-"))]
