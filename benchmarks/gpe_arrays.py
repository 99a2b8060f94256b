"""The Gross-Pitaevskii equation's right-hand side on arrays of other libraries, beside the one that steps use.

    python benchmarks/gpe_arrays.py [--json FILE]

Least processor times, taken in turn, so that other load disturbs all alike. JAX on the CPU, asked for one thread,
compiled, from and to NumPy's arrays as in `solve_ivp`, and without.
"""

from __future__ import annotations

import os

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ["JAX_ENABLE_X64"] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"

import argparse
import json
import time
from importlib.util import find_spec

import jax
import numpy as np

from eip_scipy.problems import Grid, GrossPitaevskii, harmonic_trap
from eip_scipy.problems.gross_pitaevskii import ArrayGrossPitaevskii
from eip_scipy.problems.gross_pitaevskii.transforms import LIBRARIES
from eip_scipy.report import describe_machine, table

SHAPES = ((256, 256), (64, 64, 64), (128, 128, 128))
SECONDS = 20.0  # for each shape


def measure(shape):
    """{name: (ms, largest relative difference from the first)}."""
    grid, trap = Grid(shape, -10, 10), harmonic_trap(*[1.0] * len(shape))
    y = np.random.default_rng(7).standard_normal(2 * grid.size).view(complex)
    functions = {}
    for fft in ("auto", *LIBRARIES):
        if fft == "auto" or find_spec(fft):
            gpe = GrossPitaevskii(grid, trap, Omega=0.7, beta=400, fft=fft)
            functions["the equation" if fft == "auto" else f"with {fft}"] = lambda gpe=gpe: gpe.fun(0.0, y)
    arrays = ArrayGrossPitaevskii(gpe, np)
    compiled, there = jax.jit(ArrayGrossPitaevskii(gpe, jax.numpy).fun), jax.numpy.asarray(y)
    functions["arrays of NumPy"] = lambda: arrays.fun(0.0, y)
    functions["arrays of JAX"] = lambda: compiled(0.0, there).block_until_ready()
    functions["NumPy to JAX and back"] = lambda: np.asarray(compiled(0.0, jax.numpy.asarray(y)))
    results = {name: np.asarray(function()) for name, function in functions.items()}
    best = dict.fromkeys(functions, np.inf)
    end = time.perf_counter() + SECONDS
    while time.perf_counter() < end:
        for name, function in functions.items():
            begin = time.process_time()
            function()
            best[name] = min(best[name], time.process_time() - begin)
    first = results["the equation"]
    return {
        name: (1e3 * best[name], float(np.abs(result - first).max() / np.abs(first).max()))
        for name, result in results.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    print(f"{describe_machine()}, JAX {jax.__version__}")
    results = {}
    for shape in SHAPES:
        name = " x ".join(map(str, shape))
        rows = results[name] = measure(shape)
        least = rows["the equation"][0]
        body = [(row, [f"{ms:.2f}", f"{ms / least:.2f}", f"{error:.0e}"]) for row, (ms, error) in rows.items()]
        print(f"\n{name}\n")
        print(table([["ms"], ["over the", "equation"], ["difference"]], body), flush=True)
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main()
