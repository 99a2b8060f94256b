"""How well `recommend` does on the 35 hard cases: wanted, expected and true error of the recommended run.

    python -m eip_scipy_studies.measurements.recommend [--errors 1e-6 ...] [--json FILE]

The true error is that of `recommendation.run()` against the exact final state. Two counts: true errors between a tenth
of the wanted one and ten times it, and those that are at most ten times it. Times: of the search, and of the run.
"""

from __future__ import annotations

import argparse
import json
import time

from eip_scipy import recommend

from ..hard_cases import hard_cases

FACTOR = 10.0
HEAD = (
    f"{'case':<21} {'wanted':>7} {'expected':>9} {'true':>9} {'true/wanted':>11} {'nfev':>7} {'search':>8} {'run':>7}"
)


def measure(case, wanted: float) -> dict:
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


def line(row: dict) -> str:
    told = ", ".join(
        f"{k}={v:g}" if isinstance(v, float) else f"{k}={v}"
        for k, v in row["options"].items()
        if k not in ("atol", "compensated")
    )
    return (
        f"{row['case']:<21} {row['wanted']:7.0e} {row['expected']:9.1e} {row['true']:9.1e} "
        f"{row['true'] / row['wanted']:11.2f} {row['nfev']:7d} {row['search_seconds']:6.2f} s "
        f"{row['run_seconds']:5.2f} s  {row['method']} {told}{'' if row['trusted'] else '  NOT TRUSTED'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--errors", type=float, nargs="+", default=[1e-6])
    parser.add_argument("--cases", nargs="+", help="names of some")
    parser.add_argument("--json", help="write the numbers to this file")
    arguments = parser.parse_args()
    rows = []
    for wanted in arguments.errors:
        print(HEAD)
        found = []
        cases = hard_cases(arguments.cases)
        for case in cases:
            try:
                found.append(measure(case, wanted))
            except ValueError as error:
                print(f"{case.name:<21} {wanted:7.0e} {error}")
                continue
            print(line(found[-1]), flush=True)
        both = sum(1 / FACTOR <= row["true"] / wanted <= FACTOR for row in found)
        above = sum(row["true"] <= FACTOR * wanted for row in found)
        expected = sum(1 / FACTOR <= row["true"] / row["expected"] <= FACTOR for row in found)
        print(
            f"wanted {wanted:g}, {len(cases)} cases: true error within a factor of {FACTOR:g} of the wanted one in "
            f"{both}, at most {FACTOR:g} times it in {above}; within that factor of the expected one in {expected}"
        )
        print(
            f"in all {sum(row['search_seconds'] for row in found):.0f} s for the searches, "
            f"{sum(row['run_seconds'] for row in found):.1f} s for the runs\n"
        )
        rows += found
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
