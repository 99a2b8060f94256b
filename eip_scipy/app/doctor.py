"""``eip-scipy doctor``: what is installed, and whether it computes what it must, in seconds."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from ..core.solvers import EIPRK4, EIPRKN12
from ..core.versions import versions
from ..engine.native import BUILD
from ..ensembles.ensemble import ensemble
from ..problems import kepler, solar_system
from ..run.integrate import integrate
from .report import check_target, compact, describe_machine, document, say, table, warn, write_json

__all__ = ["run"]

# What a package that is not needed brings: module, its extra, and for what.
EXTRAS = (
    ("numba", "numba", "jitted functions of your own"),
    ("matplotlib", "plot", "figures"),
    ("sympy", "sympy", "hamiltonian, equations"),
    ("rebound", "rebound", "simulations of REBOUND; WHFast and IAS15 to compare with"),
    ("heyoka", "heyoka", "Taylor series to compare with"),
    ("astropy", "astro", "quantities and times"),
    ("jplephem", "jpl", "JPL's ephemerides"),
    ("xarray", "xarray", "results as datasets"),
    ("pandas", "pandas", "results as data frames"),
    ("zarr", "zarr", "ensembles on disk"),
    ("dask", "distributed", "ensembles on a cluster"),
    ("mpi4py", "mpi", "states over many processes"),
    ("ducc0", "fft", "faster Fourier transforms"),
)
DEFECT, DISTANCE, PLANETS = 1e-13, 1e-11, 1e-7


class Check(NamedTuple):
    """What was looked at, the number found and the largest that will do."""

    name: str
    found: float
    bound: float
    seconds: float

    @property
    def passed(self) -> bool:
        return bool(self.found <= self.bound)

    def cells(self) -> tuple[str, ...]:
        verdict = "ok" if self.passed else "FAILED"
        return compact(self.found), compact(self.bound), f"{self.seconds:.2f}", verdict


def run(args: argparse.Namespace) -> int:
    """Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        With ``json`` (Path or None) and ``quiet``.

    Returns
    -------
    int
        Exit status: 0 all is well, 1 a check failed.
    """
    if args.json is not None:
        check_target(args.json)
    installed, extras = _installed(), _extras()
    checks = [_timed(name, bound, measure) for name, bound, measure in CHECKS]
    failed = [check.name for check in checks if not check.passed]
    if not args.quiet:
        say(_text(installed, extras, checks))
    if args.json is not None:
        found = [{**check._asdict(), "passed": check.passed} for check in checks]
        write_json(args.json, document("doctor", {}, installation=installed, extras=extras, checks=found))
    if failed:
        warn(f"failed: {', '.join(failed)}. This installation computes something else than it must; install it anew.")
    return 1 if failed else 0


def _installed() -> dict[str, str]:
    found = versions()
    names = ("eip_scipy", "python", "numpy", "scipy", "tqdm")
    return {
        **{name: str(found[name]) for name in names},
        "engine": f"{BUILD.__name__.rsplit('.', 1)[-1]} ({'AVX2 and FMA' if BUILD.HAS_V3 else 'any processor'} here)",
        "folder": str(Path(__file__).parents[1]),
        "machine": describe_machine(),
    }


def _extras() -> dict[str, dict[str, Any]]:
    return {
        module: {"installed": find_spec(module) is not None, "extra": extra, "for": what}
        for module, extra, what in EXTRAS
    }


def _timed(name: str, bound: float, measure: Callable[[], float]) -> Check:
    begin = perf_counter()
    try:
        found = measure()
    except Exception as error:  # a part that does not even run is what the command looks for
        warn(f"{name}: {type(error).__name__}: {error}")
        found = math.nan
    return Check(name, found, bound, perf_counter() - begin)


def _defects() -> float:
    """How far energy and angular momentum, by their formulas, go from their values at the start."""
    problem = kepler(relativistic=0.0)
    run = solve_ivp(problem.fun, (0, 20), problem.y0, method=EIPRK4, h=0.02, invariants=problem.invariants)
    x, y, vx, vy = run.y
    values = (vx**2 + vy**2) / 2 - 1 / np.hypot(x, y), x * vy - y * vx
    return max(float(np.abs(value - value[0]).max()) for value in values)


def _bits() -> float:
    """Functions in Python and native ones: the largest difference of states, which must be none."""
    problem = kepler()
    runs = problem.solve_ivp((0, 20), method=EIPRK4, h=0.02), integrate(problem, (0, 20), method=EIPRK4, h=0.02)
    return float(np.abs(runs[0].y[:, -1] - runs[1].y[:, -1]).max())


def _orbit() -> float:
    problem = kepler(relativistic=0.0)
    assert problem.reference is not None
    run = integrate(problem, (0, 20), method=EIPRKN12, h=0.1)
    return float(np.abs(run.y[:, -1] - problem.reference(run.t[-1])).max())


def _planets() -> float:
    """A year of the solar system by two methods: the largest difference of places, in AU."""
    problem = solar_system()
    runs = [integrate(problem, (0, 1), method=method, h=1 / n) for method, n in ((EIPRKN12, 64), (EIPRK4, 2000))]
    half = problem.y0.size // 2
    return float(np.abs(runs[0].y[:half, -1] - runs[1].y[:half, -1]).max())


def _members() -> float:
    """Members of an ensemble and their single runs: the largest difference, which must be none."""
    problem = kepler()
    starts = problem.y0 * np.linspace(0.9, 1.1, 16)[:, None]
    together = ensemble(problem, (0, 5), starts, method=EIPRK4, h=0.05, progress=False)
    alone = [integrate(problem, (0, 5), start, method=EIPRK4, h=0.05).y[:, -1] for start in starts]
    return float(np.abs(together.y - alone).max())


CHECKS = (
    ("solve_ivp keeps H and L", DEFECT, _defects),
    ("Python and native functions: the same bits", 0.0, _bits),
    ("Kepler's orbit: the closed form", DISTANCE, _orbit),
    ("a year of the planets by two methods, AU", PLANETS, _planets),
    ("members of an ensemble: the bits of single runs", 0.0, _members),
)


def _text(installed: dict[str, str], extras: dict[str, dict[str, Any]], checks: list[Check]) -> str:
    width = max(map(len, (*installed, *extras)))
    lines = [f"{name:<{width}}  {value}" for name, value in installed.items()]
    lines += ["", "extras"]
    for module, entry in extras.items():
        state = "installed" if entry["installed"] else f"absent: pip install 'eip_scipy[{entry['extra']}]'"
        lines.append(f"{module:<{width}}  {state:<45}  {entry['for']}")
    head = (("found",), ("at most",), ("s",), ("",))
    return "\n".join((*lines, "", table(head, [(check.name, check.cells()) for check in checks])))
