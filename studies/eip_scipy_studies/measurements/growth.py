"""Growth of the error of position over 10 000 years: EIPGJ14, EIPRKN12, IAS15, WHFast, beside Brouwer's law.

    python -m eip_scipy_studies.measurements.growth [--years 10000] [--out DIR]

Ten bodies from DE440, Newtonian, against growth_reference.json (see solar_reference.py). An error of longitude that
comes from round-off alone grows as t^(3/2) (Brouwer 1937), one from a drift of the energy as t^2, one of a method that
keeps the energy's error bounded as t. Writes DIR/growth.png and DIR/growth.csv.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12, integrate
from eip_scipy.problems import solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import describe_machine, write_csv
from .installed import peer

rebound = peer("eip_scipy.integrations.rebound")

BODIES = {"Mercury": 1, "Earth-Moon": 3, "Jupiter": 5}
COLOURS = {
    "EIPRKN12, every 10, compensated": "#0072B2", "EIPRKN12, every 10": "#56B4E9",
    "RKN12, compensated": "#E69F00", "EIPGJ14": "#009E73", "WHFast (c17), 1 d": "#000000", "IAS15": "#D55E00",
}  # fmt: skip
MARKERS = ("o", "v", "s", "P", "X", "D")


def reference(years: float) -> dict[float, np.ndarray]:
    """States (60,) in AU and AU/day by time, up to `years`."""
    content = json.loads((Path(__file__).parent / "growth_reference.json").read_text())
    return {float(t): np.array(y, dtype=float) for t, y in content["states"].items() if float(t) <= years}


def distances(y: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of each body [AU]."""
    return np.linalg.norm((y - truth)[:30].reshape(10, 3), axis=1)


def slope(times: np.ndarray, errors: np.ndarray) -> float:
    """The exponent of the growth; nan of a single time."""
    return float(np.polyfit(np.log(times), np.log(errors), 1)[0]) if times.size > 1 else float("nan")


def runs(times: np.ndarray) -> dict[str, np.ndarray]:
    """For each method the states (60, m) at the times."""
    problem = solar_system(years=times[-1])
    nystrom = {"method": EIPRKN12, "h": 1 / 64}
    ways: dict[str, dict[str, Any]] = {
        "EIPRKN12, every 10, compensated": {**nystrom, "every": 10, "compensated": True},
        "EIPRKN12, every 10": {**nystrom, "every": 10},
        "RKN12, compensated": {**nystrom, "invariants": (), "compensated": True},
        "EIPGJ14": {"method": EIPGJ14, "h": 1 / 600},
    }
    found = {}
    for name, options in ways.items():
        result = integrate(problem, (0.0, times[-1]), t_eval=times, **options)
        print(f"{name}: {result.wall_time:.1f} s", flush=True)
        found[name] = result.y
    for name, integrator in (("WHFast (c17), 1 d", "whfast-c17"), ("IAS15", "ias15")):
        columns, wall = [], 0.0
        # From the start to each time: a saved time would cut a step of IAS15.
        for t in times:
            n = 1 if integrator == "ias15" else round(t * YEAR_D)
            result = rebound.run(problem.params, problem.y0, integrator, h=t / n, n_steps=n)
            columns.append(result.y[:, -1])
            wall = result.wall_time
        print(f"{name}: {wall:.1f} s", flush=True)
        found[name] = np.array(columns).T
    return found


def figure(times: np.ndarray, errors: dict[str, np.ndarray]) -> Any:
    """One panel for each body."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(12, 5), layout="constrained", dpi=160)
    page.suptitle("Ten bodies, Newton: growth of the error of position")
    axes = page.subplots(1, len(BODIES), sharex=True, sharey=True)
    for axis, (body, k) in zip(axes, BODIES.items(), strict=True):
        for (name, own), marker in zip(errors.items(), MARKERS, strict=True):
            shown = np.where(own[:, k] > 0, own[:, k], np.nan)
            axis.loglog(times, shown, color=COLOURS[name], marker=marker, ms=4, label=name)
        start = np.median([own[0, k] for own in errors.values()])
        axis.loglog(times, 0.1 * start * (times / times[0]) ** 1.5, color="0.5", ls=":", label="slope 3/2 (Brouwer)")
        axis.set_title(body)
        axis.set_xlabel("time [yr]")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("error of position [AU]")
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, default=10_000.0)
    parser.add_argument("--out", type=Path, default=Path("eip_results"))
    args = parser.parse_args()
    known = reference(args.years)
    times = np.array(list(known))
    print(describe_machine())
    errors = {
        name: np.array([distances(y[:, k], known[t]) for k, t in enumerate(times)]) for name, y in runs(times).items()
    }
    late = times >= 10
    for name, own in errors.items():
        slopes = [slope(times[late], own[late, k]) for k in BODIES.values()]
        last = ", ".join(
            f"{body} {own[-1, k]:.1e} AU (slope {exponent:.1f})"
            for (body, k), exponent in zip(BODIES.items(), slopes, strict=True)
        )
        print(f"{name}: after {times[-1]:g} yr {last}")
    args.out.mkdir(parents=True, exist_ok=True)
    rows = [
        {"method": name, "years": t, **{body: own[j, k] for body, k in BODIES.items()}}
        for name, own in errors.items()
        for j, t in enumerate(times)
    ]
    print(f"wrote {write_csv(args.out / 'growth.csv', rows)}")
    figure(times, errors).savefig(args.out / "growth.png")
    print(f"wrote {args.out / 'growth.png'}")


if __name__ == "__main__":
    main()
