"""The paper's figures 1 and 2: perturbed Kepler orbits, errors of the invariants, and beside them that of the orbit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.solvers import EIPDOP853, EIPRK2, EIPRK4, EIPRK5, EIPSolver
from ...problems import kepler
from ...run.integrate import integrate
from ..report import compact, table

__all__ = ["KeplerRun", "KeplerStudy", "checks", "figures", "rows", "study", "text"]

STEP, T_END = 0.03, 2000.0
ORBIT_END = 100.0
REFINEMENT = 6  # steps of the reference in one
# check=False: the paper's RK2 keeps both invariants and loses the orbit, which is what the figure shows.
PAPER_SETTING: dict[str, Any] = {"metric": "euclidean", "reuse_f": False, "check": False}
FIGURES: dict[str, tuple[str, dict[str, tuple[type[EIPSolver], str]]]] = {
    "fig-kepler-1.png": (
        "Perturbed Kepler problem, e = 0.6, RK4, h = 0.03 (the paper's figure 1)",
        {"EIP-H": (EIPRK4, "H"), "EIP-L": (EIPRK4, "L"), "EIP-HL": (EIPRK4, "HL")},
    ),
    "fig-kepler-2.png": (
        "Perturbed Kepler problem, e = 0.6, EIP-HL with RK2 and RK5, h = 0.03 (the paper's figure 2)",
        {"EIP-HL, RK2": (EIPRK2, "HL"), "EIP-HL, RK5": (EIPRK5, "HL")},
    ),
}
# Known values, to two digits: at t = 2000 ("end") or along the run ("max").
KNOWN = (
    ("EIP-H", "momentum_error", "|L - L0| at t = 2000", "end", "1.5e-4"),
    ("EIP-L", "energy_error", "|H - H0| at t = 2000", "end", "4.8e-4"),
    ("EIP-HL, RK2", "energy_error", "max |H - H0|", "max", "8.5e-8"),
    ("EIP-HL, RK2", "momentum_error", "max |L - L0|", "max", "8.8e-9"),
)


@dataclass(frozen=True, eq=False)
class KeplerRun:
    """One method's run, saved at each step.

    Attributes
    ----------
    t : ndarray, shape (m,)
    y : ndarray, shape (4, m)
    energy_error, momentum_error, position_error : ndarray, shape (m,)
        Absolute, the last against the reference.
    """

    t: np.ndarray
    y: np.ndarray
    energy_error: np.ndarray
    momentum_error: np.ndarray
    position_error: np.ndarray


KeplerStudy = dict[str, KeplerRun]


def study(t_end: float = T_END) -> KeplerStudy:
    """Run the methods of both figures and the reference, in the paper's setting.

    Parameters
    ----------
    t_end : float, optional

    Returns
    -------
    dict of str to KeplerRun
        By the names in the figures.

    Notes
    -----
    The reference is EIPDOP853 with a sixth of the step, compensated; with a third it differs by 1e-11 at t = 2000.
    """
    problem = kepler()
    span = (0.0, round(t_end / STEP) * STEP)
    tight = integrate(problem, span, method=EIPDOP853, h=STEP / REFINEMENT, save_every=REFINEMENT, compensated=True).y
    return {
        name: _line(method, kept, problem, span, tight)
        for _, methods in FIGURES.values()
        for name, (method, kept) in methods.items()
    }


def _line(method: type[EIPSolver], kept: str, problem: Any, span: tuple[float, float], tight: np.ndarray) -> KeplerRun:
    chosen = [item for item in problem.invariants if item.name in kept]
    run = integrate(problem, span, method=method, h=STEP, save_every=1, invariants=chosen, **PAPER_SETTING)
    q, v = run.y[:2], run.y[2:]
    r = np.hypot(*q)
    energy = 0.5 * (v * v).sum(axis=0) - 1 / r - 0.5 * problem.params[0] / r**3
    momentum = q[0] * v[1] - q[1] * v[0]
    position_error = np.hypot(*(q - tight[:2]))
    return KeplerRun(run.t, run.y, np.abs(energy - energy[0]), np.abs(momentum - momentum[0]), position_error)


def checks(lines: KeplerStudy) -> list[dict[str, Any]]:
    """Compare with the known values, to their two digits.

    Returns
    -------
    list of dict
        With `method`, `quantity`, `known`, `ours` and `matched`.
    """
    found = []
    for name, error, quantity, kind, known in KNOWN:
        line = lines[name]
        values = getattr(line, error)
        at = int(np.searchsorted(line.t, T_END)) if kind == "end" else slice(None)
        ours = float(np.max(values[at])) if line.t[-1] >= T_END * (1 - 1e-12) else float("nan")
        record = {"method": name, "quantity": quantity, "known": float(known), "ours": ours}
        found.append({**record, "matched": compact(ours) == known})
    return found


def text(lines: KeplerStudy) -> str:
    """Lay out the errors and the known values."""
    t_end = next(iter(lines.values())).t[-1]
    head = [["error of", "H"], ["error of", "L"], ["error of", "position"]]
    body = [
        (name, [compact(float(e.max())) for e in (line.energy_error, line.momentum_error, line.position_error)])
        for name, line in lines.items()
    ]
    known = [
        f"{'ok' if c['matched'] else 'FAILED':<6} {c['method']}, {c['quantity']}: {compact(c['ours'])}, "
        f"known {compact(c['known'])}"
        for c in checks(lines)
    ]
    title = f"Figures 1 and 2: perturbed Kepler problem, h = {STEP:g}, t = 0 ... {t_end:.5g}; largest absolute errors"
    return "\n".join([title, "", table(head, body), "", *known])


def rows(lines: KeplerStudy) -> list[dict[str, Any]]:
    """Make the lines of the CSV file, at every 50th step."""
    return [
        {
            "method": name,
            "t": line.t[k],
            "q1": line.y[0, k],
            "q2": line.y[1, k],
            "energy_error": line.energy_error[k],
            "momentum_error": line.momentum_error[k],
            "position_error": line.position_error[k],
        }
        for name, line in lines.items()
        for k in range(0, line.t.size, 50)
    ]


def figures(lines: KeplerStudy) -> Iterator[tuple[str, Any]]:
    """Make the figures one by one.

    Yields
    ------
    (str, Figure)
        File name and figure.

    Raises
    ------
    ImportError
        Without matplotlib.
    """
    from ...plotting import KeplerRun, paper_kepler_figure

    for file, (title, methods) in FIGURES.items():
        runs = {}
        for name in methods:
            line = lines[name]
            shown = line.t <= ORBIT_END
            runs[name] = KeplerRun(
                line.t, line.energy_error, line.momentum_error, line.position_error, line.y[:2, shown]
            )
        yield file, paper_kepler_figure(runs, title=title)
