"""The paper's test of efficiency in full: all runs, on grids of any size (`eip-scipy reproduce fig-efficiency`).

python benchmarks/gpe_efficiency.py [--points N] [--repeats N] [--out FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from eip_scipy.app.condensates import efficiency as gpe_efficiency
from eip_scipy.app.report import write_csv


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("eip_results"))
    parser.add_argument("--points", type=int, default=gpe_efficiency.POINTS)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    trials = gpe_efficiency.study(arguments.points, arguments.repeats, quiet=False)
    print(gpe_efficiency.runs_text(trials))
    print(f"\n{gpe_efficiency.text(trials)}\n")
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(f"wrote {write_csv(arguments.out / f'gpe-efficiency-{arguments.points}.csv', gpe_efficiency.rows(trials))}")
    for _, figure in gpe_efficiency.figures(trials):
        path = arguments.out / f"gpe-efficiency-{arguments.points}.png"
        figure.savefig(path)
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
