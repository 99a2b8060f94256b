"""The paper's test of efficiency in full: all runs, on grids of any size (`eip-scipy reproduce fig-efficiency`).

python -m eip_scipy_studies.measurements.gpe_efficiency [--points N] [--repeats N] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ..condensates.efficiency import Efficiency, Trial, runs_text
from ..study import Session


class RunsToo(Efficiency):
    """With a table of all runs."""

    def text(self, found: dict[str, Trial]) -> str:
        return f"{runs_text(found)}\n\n{super().text(found)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("eip_results"))
    parser.add_argument("--points", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    stem = f"gpe-efficiency-{arguments.points}"
    study = RunsToo(points=arguments.points, repeats=arguments.repeats, stem=stem)
    sys.exit(study.run(Session(stem, arguments.out)))


if __name__ == "__main__":
    main()
