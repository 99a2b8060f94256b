"""Cost of the rotating Gross-Pitaevskii equation: its right-hand side beside transforms alone, steps beside plain RK4.

    python -m eip_scipy_studies.measurements.gpe [--json FILE] [--figure FILE] [--seconds S] [--quick]

Processor time, the least of several; those that are compared are taken in turn, so that other load on the machine
disturbs all alike. One thread. "transforms" are a library's alone, a pair along each axis: x, and then the other axes
together.
"""

from __future__ import annotations

import argparse
import json
import time
from importlib.util import find_spec

import numpy as np
from scipy.integrate import RK45

from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap
from eip_scipy.problems.gross_pitaevskii.transforms import LIBRARIES

from ..report import describe_machine, table

FLAT = tuple((n, n) for n in (64, 128, 256, 512, 1024))
FULL = tuple((n, n, n) for n in (32, 64, 128))
STEPPED = ((256, 256), (64, 64, 64))
SECONDS = 6.0  # for each row
FEWEST = 3
STEPS = 20  # of a run by `integrate`
VARIANTS = {
    "RK4": {"names": ()},
    "EIP-M": {"names": ("mass",)},
    "EIP-E": {"names": ("energy",)},
    "EIP-ME": {"names": ("mass", "energy")},
    "EIP-ME, reuse_f=False": {"names": ("mass", "energy"), "reuse_f": False},
}


def least(functions, seconds):
    """Least result of each function, which times itself; in turn until the seconds are over."""
    best = dict.fromkeys(functions, np.inf)
    end, turns = time.perf_counter() + seconds, 0
    while turns < FEWEST or time.perf_counter() < end:
        for name, function in functions.items():
            best[name] = min(best[name], function())
        turns += 1
    return best


def timed(function):
    """Of short calls several at once: what a call of the clock takes is no part of them."""
    function()  # compiled, planned
    begin = time.perf_counter()
    function()
    calls = max(1, int(2e-3 / max(time.perf_counter() - begin, 1e-6)))

    def run():
        function()  # what another left the memory and the caches in is no part of it either
        begin = time.process_time()
        for _ in range(calls):
            function()
        return (time.process_time() - begin) / calls

    return run


def equation(shape, fft):
    gpe = GrossPitaevskii(Grid(shape, -10, 10), harmonic_trap(*[1.0] * len(shape)), Omega=0.7, beta=400, fft=fft)
    psi = sum(np.exp(-((a - k) ** 2) / 2) for k, a in enumerate(gpe.grid.mesh())) * (1 + 0.5j)
    return gpe, (psi / np.sqrt(gpe.mass(psi))).ravel()


def right_hand_side(shape, seconds):
    """Least times [ms] of f and of its transforms, by each library."""
    functions = {}
    for fft in (name for name in LIBRARIES if find_spec(name) is not None):
        gpe, psi = equation(shape, fft)
        out, field, work = np.empty_like(psi), psi.reshape(shape), np.empty(shape, complex)
        functions[fft, "f"] = timed(lambda gpe=gpe, psi=psi, out=out: gpe.rhs(0.0, psi, out))

        def transforms(gpe=gpe, field=field, work=work):
            for axes in ((0,), tuple(range(1, len(shape)))):
                gpe.transforms.forward(field, axes, work)
                gpe.transforms.backward(work, axes)

        functions[fft, "transforms"] = timed(transforms)
    return {key: 1e3 * t for key, t in least(functions, seconds).items()}


def steps(shape, seconds):
    """Least times [ms] of a step of each variant by `integrate` and in `solve_ivp`, and of SciPy's RK45."""
    gpe, psi = equation(shape, "auto")
    h = 0.2 * gpe.largest_step(psi)
    functions = {}

    def run(kept, count, others):
        begin = time.process_time()
        integrate(gpe.problem(psi, count * h, h), method=EIPRK4, invariants=kept, check=False, **others)
        return time.process_time() - begin

    for name, variant in VARIANTS.items():
        others = {key: value for key, value in variant.items() if key != "names"}
        kept = gpe.invariants(variant["names"])
        solver = EIPRK4(gpe.fun, 0.0, psi, 1e3, h=h, metric="euclidean", invariants=kept, **others)
        functions[name, "solve_ivp"] = timed(solver.step)
        for count in (1, STEPS + 1):
            functions[name, count] = lambda kept=kept, count=count, others=others: run(kept, count, others)
    found = least(functions, seconds)
    # Not in turn with the others: what it leaves behind slows the one after it for tens of steps.
    solver = RK45(gpe.fun, 0.0, psi, 1e3, first_step=h, max_step=h, rtol=1e-2, atol=1.0)
    found |= least({("RK45", "solve_ivp"): timed(solver.step)}, seconds / 5)
    for name in VARIANTS:  # without what a run of a single step takes
        found[name, "integrate"] = (found.pop((name, STEPS + 1)) - found.pop((name, 1))) / STEPS
    return {key: 1e3 * t for key, t in found.items()}


def save_figure(found, path):
    """Draw the cost of f against the number of points, and N log N beside it."""
    from matplotlib.figure import Figure

    from eip_scipy.plotting import method_styles

    labels = {("ducc0", "f"): "f by ducc0", ("ducc0", "transforms"): "ducc0's transforms alone",
              ("scipy", "f"): "f by SciPy"}  # fmt: skip
    labels = {key: label for key, label in labels.items() if key in found[FLAT[0]]}
    styles = method_styles(labels.values())
    sides = [[shape for shape in found if len(shape) == dimensions] for dimensions in (2, 3)]
    figure = Figure(figsize=(9.5, 4.6), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, shapes, title in zip(axes, sides, ("two dimensions", "three dimensions"), strict=True):
        points = np.array([np.prod(shape) for shape in shapes])
        for key, label in labels.items():
            axis.plot(points, [found[shape][key] for shape in shapes], ms=5, lw=1.2, **styles[label])
        line = points * np.log2(points)
        line = line * found[shapes[0]][next(iter(labels))] / line[0]
        axis.plot(points, line, color="0.4", ls=":", label="N log N, through the first f")
        axis.set(xscale="log", yscale="log", xlabel="grid points N", title=title)
        axis.set_xticks(points, [f"${shape[0]}^{len(shape)}$" for shape in shapes])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("one evaluation of f [ms]")
    axes[0].legend(fontsize="small", frameon=False)
    figure.savefig(path, dpi=160)
    print(f"wrote {path}")


def named(shape):
    return " x ".join(map(str, shape))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="for each row")
    parser.add_argument("--quick", action="store_true", help="the smallest grids only, a few turns")
    arguments = parser.parse_args()
    print(describe_machine())
    shapes, stepped_shapes, seconds = (*FLAT, *FULL), STEPPED, arguments.seconds
    if arguments.quick:
        shapes, stepped_shapes, seconds = (FLAT[0], FULL[0]), (FLAT[0],), 0.0
    found = {shape: right_hand_side(shape, seconds) for shape in shapes}
    keys = list(found[shapes[0]])
    lines = [(named(shape), [f"{row[key]:.3f}" for key in keys]) for shape, row in found.items()]
    print("\nRight-hand side and its parts [ms]\n")
    print(table([list(key) for key in keys], lines))
    print("\nf over its transforms alone\n")
    names = [fft for fft, what in keys if what == "f"]
    ratios = {s: [f"{row[fft, 'f'] / row[fft, 'transforms']:.2f}" for fft in names] for s, row in found.items()}
    print(table([[fft] for fft in names], [(named(shape), row) for shape, row in ratios.items()]))
    stepped = {shape: steps(shape, 5 * seconds) for shape in stepped_shapes}
    for shape, row in stepped.items():
        body = []
        for name in VARIANTS:
            numbers = []
            for driver in ("integrate", "solve_ivp"):
                numbers += [f"{row[name, driver]:.3f}", f"{row[name, driver] / row['RK4', driver]:.2f}"]
            body.append((name, numbers))
        print(f"\nSteps, {named(shape)} [ms], and over RK4\n")
        print(table([["integrate"], ["over RK4"], ["solve_ivp"], ["over RK4"]], body))
        ours = [row["RK4", driver] / 4 for driver in ("integrate", "solve_ivp")]
        print(
            f"a stage: RK4 by integrate {ours[0]:.3f} ms, in solve_ivp {ours[1]:.3f} ms; "
            f"SciPy's RK45 {row['RK45', 'solve_ivp'] / 6:.3f} ms"
        )
    if arguments.json:
        results = {"rhs": found, "steps": stepped}
        plain = {
            k: {named(s): {", ".join(key): t for key, t in row.items()} for s, row in part.items()}
            for k, part in results.items()
        }
        with open(arguments.json, "w") as file:
            json.dump(plain, file, indent=1)
    if arguments.figure:
        save_figure(found, arguments.figure)


if __name__ == "__main__":
    main()
