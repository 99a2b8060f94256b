"""Cost of the rotating Gross-Pitaevskii equation: its right-hand side beside its transforms, steps beside plain RK4.

    python benchmarks/gpe.py [--json FILE]

Every time is the least of several, and those that are compared are taken in turn, so that other load on the machine
disturbs all alike; of steps, processor time. One thread.
"""

from __future__ import annotations

import argparse
import json
import time
from importlib.util import find_spec

import numpy as np
from scipy.integrate import RK45

from eip_scipy import EIPRK4
from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap
from eip_scipy.problems.gross_pitaevskii.transforms import LIBRARIES
from eip_scipy.report import describe_machine, table

SHAPES = ((64, 64), (128, 128), (256, 256), (512, 512), (32, 32, 32), (64, 64, 64), (128, 128, 128))
STEPPED = ((256, 256), (64, 64, 64))
SECONDS = 4.0  # for each row
VARIANTS = {
    "RK4": {"names": ()},
    "EIP-M": {"names": ("mass",)},
    "EIP-E": {"names": ("energy",)},
    "EIP-ME": {"names": ("mass", "energy")},
    "EIP-ME, reuse_f=False": {"names": ("mass", "energy"), "reuse_f": False},
}


def least(functions, seconds=SECONDS):
    """Least result of each function, which times itself; in turn until the seconds are over."""
    best = dict.fromkeys(functions, np.inf)
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        for name, function in functions.items():
            best[name] = min(best[name], function())
    return best


def timed(function, clock=time.perf_counter):
    def run():
        begin = clock()
        function()
        return clock() - begin

    return run


def equation(shape, fft):
    gpe = GrossPitaevskii(Grid(shape, -10, 10), harmonic_trap(*[1.0] * len(shape)), Omega=0.7, beta=400, fft=fft)
    psi = sum(np.exp(-((a - k) ** 2) / 2) for k, a in enumerate(gpe.grid.mesh())) * (1 + 0.5j)
    return gpe, (psi / np.sqrt(gpe.mass(psi))).ravel()


def right_hand_side(shape, fft):
    """Least times [ms] of f, of its transforms alone, and of the energy."""
    gpe, psi = equation(shape, fft)
    out, field, work = np.empty_like(psi), psi.reshape(shape), np.empty(shape, complex)

    def transforms():
        for axes in ((0,), tuple(range(1, len(shape)))):
            gpe.transforms.forward(field, axes, work)
            gpe.transforms.backward(work, axes)

    functions = {"f": lambda: gpe.rhs(0.0, psi, out), "transforms": transforms, "energy": lambda: gpe.energy(psi)}
    return {name: 1e3 * t for name, t in least({k: timed(f) for k, f in functions.items()}).items()}


def steps(shape):
    """Least times [ms] of a step of each variant, and of SciPy's RK45, which has six stages."""
    gpe, psi = equation(shape, "auto")
    h = 0.2 * gpe.largest_step(psi)

    def ours(names, **options):
        options["metric"] = "euclidean"
        return EIPRK4(gpe.fun, 0.0, psi, 1e3, h=h, invariants=gpe.invariants(names), **options)

    solvers = {name: ours(**variant) for name, variant in VARIANTS.items()}
    solvers["RK45"] = RK45(gpe.fun, 0.0, psi, 1e3, first_step=h, max_step=h, rtol=1e-2, atol=1.0)
    functions = {name: timed(solver.step, time.process_time) for name, solver in solvers.items()}
    return {name: 1e3 * t for name, t in least(functions, 5 * SECONDS).items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    print(describe_machine())
    results: dict = {"rhs": {}, "steps": {}}
    lines = []
    for shape in SHAPES:
        for fft in LIBRARIES:
            if find_spec(fft) is None:
                continue
            name = f"{' x '.join(map(str, shape))}, {fft}"
            row = results["rhs"][name] = right_hand_side(shape, fft)
            numbers = [f"{row[k]:.3f}" for k in ("f", "transforms")] + [f"{row['f'] / row['transforms']:.2f}"]
            lines.append((name, [*numbers, f"{row['energy']:.3f}", f"{1e6 * row['f'] / np.prod(shape):.1f}"]))
    print("\nRight-hand side [ms]\n")
    print(table([["f"], ["transforms"], ["ratio"], ["energy"], ["f, ns per", "point"]], lines))
    for shape in STEPPED:
        row = results["steps"][" x ".join(map(str, shape))] = steps(shape)
        body = [(name, [f"{row[name]:.3f}", f"{row[name] / row['RK4']:.2f}"]) for name in VARIANTS]
        print(f"\nSteps, {' x '.join(map(str, shape))}, {equation(shape, 'auto')[0].fft}\n")
        print(table([["ms per step"], ["over RK4"]], body))
        print(f"an evaluation of f in a step: RK4 {row['RK4'] / 4:.3f} ms, SciPy's RK45 {row['RK45'] / 6:.3f} ms")
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main()
