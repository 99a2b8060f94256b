"""Reference states of the ten-body solar system: Taylor's method of heyoka in 80-bit arithmetic.

    python -m eip_scipy_studies.measurements.solar_reference [--years 1 10 100 1000 2000] [--tolerance 1e-24] [--json FILE]

Newtonian, from the packaged "de440" data. Where the package holds a reference state it prints the largest difference
of a position from it [AU]; the states go to FILE, in AU and AU/day. heyoka is no dependency: ``pip install heyoka``.

`growth_reference.json`, beside this file, comes from

    python -m eip_scipy_studies.measurements.solar_reference --years 1 2 5 10 20 50 100 200 500 1000 2000 5000 10000 \
        --json benchmarks/growth_reference.json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence

import numpy as np

from eip_scipy.problems.gravity.solar_data import YEAR_D, SolarSystemData, load, reference_states

from .installed import peer

heyoka = peer("heyoka", '"eip_scipy[heyoka]"')

FLOAT = np.longdouble


def by_body(data: SolarSystemData) -> np.ndarray:
    """The state as heyoka orders it: x, y, z, v_x, v_y, v_z of one body after the other."""
    return np.concatenate([data.position, data.velocity], axis=1).ravel().astype(FLOAT)


def by_kind(state: np.ndarray) -> np.ndarray:
    """The state as the package orders it: all positions, then all velocities."""
    return state.reshape(-1, 2, 3).swapaxes(0, 1).ravel()


def states(data: SolarSystemData, years: Sequence[float], tolerance: float) -> list[np.ndarray]:
    """States (6 N,) in AU and AU/day at times in ascending order."""
    equations = heyoka.model.nbody(len(data.bodies), masses=list(data.gm.astype(FLOAT)), Gconst=FLOAT(1))
    integrator = heyoka.taylor_adaptive(
        equations, by_body(data), fp_type=FLOAT, tol=FLOAT(tolerance), high_accuracy=True, compact_mode=True
    )
    found = []
    for t in years:
        outcome = integrator.propagate_until(FLOAT(t) * FLOAT(YEAR_D))[0]
        if outcome != heyoka.taylor_outcome.time_limit:
            raise SystemExit(f"heyoka stopped before {t:g} yr: {outcome}")
        found.append(by_kind(integrator.state.copy()))
    return found


def largest_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Largest distance of a body's two positions."""
    return float(np.max(np.linalg.norm((a - b)[: a.size // 2].astype(float).reshape(-1, 3), axis=1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, nargs="+", default=[1, 10, 100, 1000, 2000])
    parser.add_argument("--tolerance", type=float, default=1e-24)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    years, known = sorted(args.years), reference_states()
    begin = time.perf_counter()
    found = states(load("de440"), years, args.tolerance)
    print(f"heyoka {heyoka.__version__}, tolerance {args.tolerance:g}: {time.perf_counter() - begin:.1f} s")
    for t, state in zip(years, found, strict=True):
        if t in known:
            print(f"{t:8g} yr: {largest_distance(state, known[t].astype(FLOAT)):.1e} AU from the packaged state")
    if args.json:
        rows = {
            f"{t:g}": [np.format_float_scientific(x, precision=19) for x in y]
            for t, y in zip(years, found, strict=True)
        }
        content = {
            "about": "Newtonian ten-body solar system from the data set de440: all positions [AU], then all velocities "
            "[AU/day], by time in Julian years",
            "made by": f"solar_reference.py, heyoka {heyoka.__version__}, 80 bits, tolerance {args.tolerance:g}",
            "states": rows,
        }
        with open(args.json, "w") as file:
            json.dump(content, file, indent=1)


if __name__ == "__main__":
    main()
