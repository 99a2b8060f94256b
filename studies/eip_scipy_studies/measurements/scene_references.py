"""Reference states of the hard scenes, by Taylor's method in extended precision (heyoka, ``pip install heyoka``).

    python -m eip_scipy_studies.measurements.scene_references [--bits 160] [--out FILE]

writes ``scene_references.json`` anew, with the largest difference of a position from the same run in 113 bits, and,
where REBOUND is installed, from IAS15. The order of the Taylor series and the tolerance follow the precision. The
differences say how far a scene can be known: 64 bits are not enough for the three bodies of Burrau at t = 70.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eip_scipy.problems import Problem, comet, figure_eight, pythagorean

from .installed import peer

heyoka = peer("heyoka", '"eip_scipy[heyoka]"')

TARGET = Path(__file__).parents[1] / "eip_scipy" / "data" / "scene_references.json"
BITS, CHECK_BITS = 160, 113


def scenes() -> list[tuple[Problem, list[float]]]:
    """The scenes without a closed form, with the times of the states to store."""
    return [
        (pythagorean(), [10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0]),
        (figure_eight(), [figure_eight(n).t_span[1] for n in (1, 10, 100)]),
        (comet(), [20.0]),
    ]


def states(problem: Problem, times: Sequence[float], bits: int) -> np.ndarray:
    """States (q, v) at `times` in rows, rounded from numbers of `bits` bits."""

    def real(x: float) -> heyoka.real:
        return heyoka.real(float(x), bits)

    assert problem.params is not None
    n = problem.params.size
    system = heyoka.model.nbody(n, masses=[real(m) for m in problem.params])
    # heyoka's state is body by body.
    start = [real(x) for x in problem.y0.reshape(2, n, 3).swapaxes(0, 1).ravel()]
    integrator = heyoka.taylor_adaptive(system, start, fp_type=heyoka.real)
    rows = []
    for t in times:
        integrator.propagate_until(real(t))
        rows.append(np.array([float(x) for x in integrator.state]).reshape(n, 2, 3).swapaxes(0, 1).ravel())
    return np.array(rows)


def ias15(problem: Problem, times: Sequence[float]) -> np.ndarray | None:
    """The same by IAS15 in double precision."""
    try:
        from eip_scipy.integrations import rebound
    except ImportError as error:
        print(f"no comparison with IAS15: {error}", file=sys.stderr)
        return None
    return np.array([rebound.run(problem.params, problem.y0, "ias15", h=t, n_steps=1).y[:, -1] for t in times])


def difference(a: np.ndarray, b: np.ndarray) -> list[float]:
    """The largest distance of a body from itself in rows of states."""
    positions = (a - b)[:, : a.shape[1] // 2].reshape(len(a), -1, 3)
    return [float(x) for x in np.linalg.norm(positions, axis=2).max(axis=1)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bits", type=int, default=BITS)
    parser.add_argument("--out", type=Path, default=TARGET)
    args = parser.parse_args()
    stored = {}
    for problem, times in scenes():
        rows, fewer, double = (
            states(problem, times, args.bits),
            states(problem, times, CHECK_BITS),
            ias15(problem, times),
        )
        stored[problem.name] = [{"t": t, "state": row.tolist()} for t, row in zip(times, rows, strict=True)]
        apart = difference(rows, fewer)
        others = [float("nan")] * len(times) if double is None else difference(rows, double)
        for t, a, b in zip(times, apart, others, strict=True):
            print(f"{problem.name:14} t = {t:<12.6g} from {CHECK_BITS} bits: {a:.1e}   from IAS15: {b:.1e}", flush=True)
    about = (
        f"Final states (q of all bodies, v of all bodies) of the scenes in problems/scenes.py: heyoka "
        f"{heyoka.__version__}, Taylor, {args.bits}-bit arithmetic; made by benchmarks/scene_references.py."
    )
    args.out.write_text(json.dumps({"about": about, "states": stored}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
