"""``eip-scipy study stiff``: SciPy's Radau and BDF compared with `EIPRadau` and `EIPBDF`.

1. A plane chain of three links with rotational dampers of 1e4 N m s between them, 20 s, from five starts at rest, with
   its constraints kept; the absolute tolerance equals the relative one.
2. The flyball governor of the multibody benchmark library, 10 s, with constraints and angular momentum kept; the error
   is that of the slider's height.
3. Ten stiff problems with invariants, and one whose invariant alone increases the error (the satellite, whose energy
   changes slowly and is not kept). In 2 and 3 absolute tolerances are 0.01 of the relative one, times the components'
   sizes.

References are runs in angles for the mechanisms, and runs by Radau at small tolerances for the others. Calls are all
evaluations of the right-hand side, those for numerical Jacobians included. Means are geometric.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPBDF, EIPRadau

from ..report import table
from ..study import Check, Rows, Session, Study, option
from .cases import CASES, Case, chain_case, governor_case

METHODS = {"Radau": EIPRadau, "BDF": EIPBDF}
STARTS = ((1.2, 0.9, 0.5), (0.8, 0.3, 1.0), (1.5, 1.4, 1.0), (-0.7, 0.4, 0.9), (2.0, 1.6, 1.9))
COUNTEREXAMPLE = "satellite"
# Bounds on a mean error and on mean calls, by method; on the governor's error; on the ten problems.
CHAIN = {"Radau": (1 / 5, 1.25), "BDF": (1 / 3, 1.4)}
GOVERNOR, WORST = 1 / 30, 2.0

Found = dict[str, list[dict[str, Any]]]


def compared(name: str, case: Case, rtol: float, share: float) -> Iterable[dict[str, Any]]:
    """Yield a row for each method: errors and calls without and with projection; `share` is that of `Case.error`."""
    for base, own in METHODS.items():
        error, calls = case.error(base, rtol, share)
        kept_error, kept_calls = case.error(own, rtol, share, invariants=case.invariants)
        yield {
            "problem": name, "method": base, "rtol": rtol, "error": error, "projected": kept_error, "calls": calls,
            "projected calls": kept_calls,
        }  # fmt: skip


def mean(rows: Sequence[dict[str, Any]], *names: str) -> float:
    """Return the geometric mean of one named column, or of the ratio of the first of two named ones to the second."""
    values = np.array([[row[name] for name in names] for row in rows], float)
    logs = np.log(np.maximum(values, 1e-16))
    return float(np.exp(np.mean(logs[:, 0] - (logs[:, 1] if len(names) > 1 else 0.0))))


def of(rows: Sequence[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    """Return the rows in which each column named in `wanted` has the value given there."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


@dataclass(frozen=True, kw_only=True)
class Stiff(Study[Found]):
    """Command ``eip-scipy study stiff``."""

    quick: bool = option(False, "a trial: one start of the chain, 2 s of each mechanism, two problems, one tolerance")

    def measure(self, session: Session) -> Found:
        tolerances = (1e-5,) if self.quick else (1e-4, 1e-5, 1e-6, 1e-7)
        starts = STARTS[:1] if self.quick else STARTS
        chains = [chain_case(start, 2.0 if self.quick else 20.0) for start in starts]
        governor = governor_case(2.0 if self.quick else 10.0)
        chosen = ("Robertson", "magnet") if self.quick else tuple(CASES)
        halves = (1e-5,) if self.quick else tuple(10.0 ** -np.arange(3, 7.1, 0.5))
        found: Found = {"chain": [], "governor": [], "problems": []}
        total = len(tolerances) * (len(chains) + 1) + len(halves) * len(chosen)
        with session.bar(total, "stiff", "comparison") as bar:
            for rtol in tolerances:
                for k, case in enumerate(chains):
                    found["chain"] += compared(f"start {k + 1}", case, rtol, 1.0)
                    bar.update()
                found["governor"] += compared("governor", governor, rtol, 1e-2)
                bar.update()
            for name in chosen:
                case = CASES[name]()
                for rtol in halves:
                    found["problems"] += compared(name, case, rtol, 1e-2)
                    bar.update()
        return found

    def text(self, found: Found) -> str:
        heads = [[""], ["rtol"], ["error"], ["projected"], ["ratio"], ["calls"], ["ratio"]]
        parts = []
        for name in ("chain", "governor"):
            body = []
            for method in METHODS:
                for rtol in sorted({row["rtol"] for row in found[name]}, reverse=True):
                    rows = of(found[name], method=method, rtol=rtol)
                    errors = [f"{mean(rows, 'error'):.1e}", f"{mean(rows, 'projected'):.1e}"]
                    body.append((method, [f"{rtol:g}", *errors, *_ratios(rows, mean(rows, "calls"))]))
            parts.append(f"{name}\n\n{table(heads[1:], body)}")
        body = []
        for name in dict.fromkeys(row["problem"] for row in found["problems"]):
            for method in METHODS:
                rows = of(found["problems"], problem=name, method=method)
                largest = max(row["projected"] / max(row["error"], 1e-16) for row in rows)
                body.append((f"{name}, {method}", [*_ratios(rows), f"{largest:.2g}"]))
        heads = [["ratio of", "errors"], ["of calls"], ["largest of", "errors"]]
        parts.append(f"problems, means over the tolerances\n\n{table(heads, body)}")
        lines = "\n".join(check.line for check in self.checks(found))
        return "\n\n".join([*parts, lines] if lines else parts)

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"found": found}

    def tables(self, found: Found) -> dict[str, Rows]:
        return {f"stiff_{name}.csv": rows for name, rows in found.items()}

    def checks(self, found: Found) -> Sequence[Check]:
        if self.quick:
            return ()  # the bounds apply to means over starts and tolerances
        checks = []
        for method, (error, calls) in CHAIN.items():
            rows = of(found["chain"], method=method)
            ratio, cost = mean(rows, "projected", "error"), mean(rows, "projected calls", "calls")
            text = f"chain, {method}: error times {ratio:.2g} (at most {error:.2g}), calls times {cost:.3g} ({calls:g})"
            checks.append(Check(text, ratio <= error and cost <= calls))
        for row in of(found["governor"], method="Radau"):
            if row["rtol"] < 1e-6:
                continue  # both errors are near those of the reference
            gain = row["error"] / row["projected"]
            text = f"governor, Radau, {row['rtol']:g}: {gain:.3g} times nearer (at least {1 / GOVERNOR:.3g})"
            checks.append(Check(text, gain * GOVERNOR >= 1))
        for name in dict.fromkeys(row["problem"] for row in found["problems"]):
            ratios = [mean(of(found["problems"], problem=name, method=m), "projected", "error") for m in METHODS]
            if name != COUNTEREXAMPLE:
                text = f"{name}: mean errors times {ratios[0]:.2g} and {ratios[1]:.2g} (at most {WORST:g})"
                checks.append(Check(text, max(ratios) <= WORST))
        return checks


def _ratios(rows: Sequence[dict[str, Any]], calls: float | None = None) -> list[str]:
    """Return cells of a table: the mean ratio of errors, `calls` if it is given, and the mean ratio of calls.

    `calls` is the mean number of calls without projection. Each ratio is the number with projection divided by that
    without.
    """
    shown = [] if calls is None else [f"{calls:.0f}"]
    return [f"{mean(rows, 'projected', 'error'):.2g}", *shown, f"{mean(rows, 'projected calls', 'calls'):.2f}"]
