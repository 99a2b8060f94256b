"""``eip-scipy study gpe``: cost of the rotating Gross-Pitaevskii equation compared with transforms and plain RK4.

Times are processor times on one thread, the least of several. Functions that are compared are called in turn, so that
other load on the machine affects all equally. "transforms" are the Fourier transforms of a library alone: a pair along
x, and a pair along the other axes together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from time import process_time
from typing import Any

import numpy as np
from scipy.integrate import RK45

from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap
from eip_scipy.problems.gross_pitaevskii.transforms import LIBRARIES

from ..report import table
from ..study import Figures, Measurement, Session, option
from ..timing import clocked, least, many_calls

Shape = tuple[int, ...]
Times = dict[tuple[str, str], float]
FLAT: tuple[Shape, ...] = tuple((n, n) for n in (64, 128, 256, 512, 1024))
FULL: tuple[Shape, ...] = tuple((n, n, n) for n in (32, 64, 128))
STEPPED: tuple[Shape, ...] = ((256, 256), (64, 64, 64))
STEPS = 20  # of a run by `integrate`
DRIVERS = ("integrate", "solve_ivp")
VARIANTS: dict[str, dict[str, Any]] = {
    "RK4": {"names": ()},
    "EIP-M": {"names": ("mass",)},
    "EIP-E": {"names": ("energy",)},
    "EIP-ME": {"names": ("mass", "energy")},
    "EIP-ME, reuse_f=False": {"names": ("mass", "energy"), "reuse_f": False},
}


def equation(shape: Shape, fft: str) -> tuple[GrossPitaevskii, np.ndarray]:
    gpe = GrossPitaevskii(Grid(shape, -10, 10), harmonic_trap(*[1.0] * len(shape)), Omega=0.7, beta=400, fft=fft)
    psi = sum(np.exp(-((a - k) ** 2) / 2) for k, a in enumerate(gpe.grid.mesh())) * (1 + 0.5j)
    return gpe, (psi / np.sqrt(gpe.mass(psi))).ravel()


def right_hand_side(shape: Shape, seconds: float) -> Times:
    """Return the least times [ms] of the right-hand side f and of its transforms alone.

    The keys are (library of transforms, "f" or "transforms"); `seconds` is the duration of the measurement.
    """
    functions = {}
    for fft in (name for name in LIBRARIES if find_spec(name) is not None):
        gpe, psi = equation(shape, fft)
        out, field, work = np.empty_like(psi), psi.reshape(shape), np.empty(shape, complex)

        def transforms(gpe: Any = gpe, field: Any = field, work: Any = work) -> None:
            for axes in ((0,), tuple(range(1, len(shape)))):
                gpe.transforms.forward(field, axes, work)
                gpe.transforms.backward(work, axes)

        functions[fft, "f"] = many_calls(partial(gpe.rhs, 0.0, psi, out))
        functions[fft, "transforms"] = many_calls(transforms)
    return {key: 1e3 * t for key, t in least(functions, turns=3, seconds=seconds).items()}


def steps(shape: Shape, seconds: float) -> Times:
    """Return the least times [ms] of a step of each of `VARIANTS`, and of a step of SciPy's RK45 in `solve_ivp`.

    The keys are (variant or "RK45", "integrate" or "solve_ivp"); `seconds` is the duration of the measurement.
    """
    gpe, psi = equation(shape, "auto")
    h = 0.2 * gpe.largest_step(psi)
    functions: dict[Any, Any] = {}

    def run(kept: Any, count: int, others: dict[str, Any]) -> None:
        integrate(gpe.problem(psi, count * h, h), method=EIPRK4, invariants=kept, check=False, **others)

    for name, variant in VARIANTS.items():
        others = {key: value for key, value in variant.items() if key != "names"}
        kept = gpe.invariants(variant["names"])
        solver = EIPRK4(gpe.fun, 0.0, psi, 1e3, h=h, metric="euclidean", invariants=kept, **others)
        functions[name, "solve_ivp"] = many_calls(solver.step)
        for count in (1, STEPS + 1):
            functions[name, count] = clocked(partial(run, kept, count, others), process_time)
    found = least(functions, turns=3, seconds=seconds)
    # Not in turn with the others: it slows the next function for tens of steps.
    scipy = RK45(gpe.fun, 0.0, psi, 1e3, first_step=h, max_step=h, rtol=1e-2, atol=1.0)
    found |= least({("RK45", "solve_ivp"): many_calls(scipy.step)}, turns=3, seconds=seconds / 5)
    for name in VARIANTS:  # without the time of a run of a single step
        found[name, "integrate"] = (found.pop((name, STEPS + 1)) - found.pop((name, 1))) / STEPS
    return {key: 1e3 * t for key, t in found.items()}


def named(shape: Shape) -> str:
    return " x ".join(map(str, shape))


@dataclass(frozen=True, kw_only=True)
class EquationCost(Measurement[dict[str, dict[Shape, Times]]]):
    """Command ``eip-scipy study gpe``."""

    writes_files = True
    seconds: float = option(6.0, "seconds of measurement for each row of the table (default: %(default)s)", type=float)
    quick: bool = option(False, "measure the smallest grids only, a few times")

    def measure(self, session: Session) -> dict[str, dict[Shape, Times]]:
        shapes, stepped, seconds = (*FLAT, *FULL), STEPPED, self.seconds
        if self.quick:
            shapes, stepped, seconds = (FLAT[0], FULL[0]), (FLAT[0],), 0.0
        with session.bar(len(shapes) + len(stepped), "gpe", "grid") as bar:
            found: dict[str, dict[Shape, Times]] = {"rhs": {}, "steps": {}}
            for shape in shapes:
                found["rhs"][shape] = right_hand_side(shape, seconds)
                bar.update()
            for shape in stepped:
                found["steps"][shape] = steps(shape, 5 * seconds)
                bar.update()
        return found

    def table(self, found: dict[str, dict[Shape, Times]]) -> str:
        rhs = found["rhs"]
        keys = list(next(iter(rhs.values())))
        lines = [(named(shape), [f"{row[key]:.3f}" for key in keys]) for shape, row in rhs.items()]
        parts = ["Right-hand side and its parts [ms]", table([list(key) for key in keys], lines)]
        names = [fft for fft, what in keys if what == "f"]
        ratios = [
            (named(s), [f"{row[fft, 'f'] / row[fft, 'transforms']:.2f}" for fft in names]) for s, row in rhs.items()
        ]
        parts += ["f over its transforms alone", table([[fft] for fft in names], ratios)]
        for shape, row in found["steps"].items():
            body = []
            for name in VARIANTS:
                pairs = [(row[name, driver], row[name, driver] / row["RK4", driver]) for driver in DRIVERS]
                body.append((name, [text for ms, ratio in pairs for text in (f"{ms:.3f}", f"{ratio:.2f}")]))
            ours = [row["RK4", driver] / 4 for driver in DRIVERS]
            parts += [
                f"Steps, {named(shape)} [ms], and over RK4",
                table([["integrate"], ["over RK4"], ["solve_ivp"], ["over RK4"]], body),
                f"a stage: RK4 by integrate {ours[0]:.3f} ms, in solve_ivp {ours[1]:.3f} ms; "
                f"SciPy's RK45 {row['RK45', 'solve_ivp'] / 6:.3f} ms",
            ]
        return "\n\n".join(parts)

    def numbers(self, found: dict[str, dict[Shape, Times]]) -> dict[str, Any]:
        return {
            part: {named(shape): {", ".join(key): t for key, t in row.items()} for shape, row in rows.items()}
            for part, rows in found.items()
        }

    def figures(self, found: dict[str, dict[Shape, Times]]) -> Figures:
        """Draw the cost of f against the number N of points, and a curve of N log N."""
        from eip_scipy.plotting import method_styles

        from ..plotting import blank_figure

        rhs = found["rhs"]
        labels = {("ducc0", "f"): "f by ducc0", ("ducc0", "transforms"): "ducc0's transforms alone",
                  ("scipy", "f"): "f by SciPy"}  # fmt: skip
        labels = {key: label for key, label in labels.items() if key in next(iter(rhs.values()))}
        styles = method_styles(labels.values())
        figure = blank_figure(9.5, 4.6)
        axes = figure.subplots(1, 2, sharey=True)
        for axis, dimensions, title in zip(axes, (2, 3), ("two dimensions", "three dimensions"), strict=True):
            shapes = [shape for shape in rhs if len(shape) == dimensions]
            points = np.array([np.prod(shape) for shape in shapes])
            for key, label in labels.items():
                axis.plot(points, [rhs[shape][key] for shape in shapes], ms=5, lw=1.2, **styles[label])
            line = points * np.log2(points)
            line = line * rhs[shapes[0]][next(iter(labels))] / line[0]
            axis.plot(points, line, color="0.4", ls=":", label="N log N, through the first f")
            axis.set(xscale="log", yscale="log", xlabel="grid points N", title=title)
            axis.set_xticks(points, [f"${shape[0]}^{len(shape)}$" for shape in shapes])
            axis.minorticks_off()
            axis.grid(alpha=0.3)
        axes[0].set_ylabel("one evaluation of f [ms]")
        axes[0].legend(fontsize="small", frameon=False)
        yield "gpe-cost.png", figure
