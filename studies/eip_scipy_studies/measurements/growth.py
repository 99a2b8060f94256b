"""``eip-scipy study growth``: growth of the position error over 10 000 years, compared with Brouwer's law.

Ten bodies from DE440, Newtonian, by EIPGJ14, EIPRKN12, IAS15 and WHFast, against the packaged reference states. An
error of longitude that comes from round-off alone grows as t^(3/2) (Brouwer 1937), one from a drift of the energy as
t^2, one of a method that keeps the energy's error bounded as t.

Each run is one sample of its rounding errors. EIPGJ14 with balances (it keeps each planet's energy about the Sun
instead of the totals) is therefore also run in all six orders of the coordinate axes, which change the rounding of the
steps, but, unlike rotations, no bit of the start and of the references.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12, integrate
from eip_scipy.problems import Problem, solar_system
from eip_scipy.problems.gravity.solar_data import load, reference_states

from ..long_runs import positive
from ..report import UsageError, needed, table
from ..solar.runs import orbits_kept
from ..study import Figures, Measurement, Rows, Session, option
from .orbits import ORDERS, rebound_states, reordered

BODIES = {"Mercury": 1, "Earth-Moon": 3, "Jupiter": 5}
NYSTROM = {"method": EIPRKN12, "h": 1 / 64}
ORDER_STEPS = 512, 1024  # steps per year, in all orders of the axes


def ways() -> dict[str, dict[str, Any]]:
    """Return, by name, the options of `integrate` for each run of this package."""
    return {
        "EIPRKN12, every 10, compensated": {**NYSTROM, "every": 10, "compensated": True},
        "EIPRKN12, every 10": {**NYSTROM, "every": 10},
        "RKN12, compensated": {**NYSTROM, "invariants": (), "compensated": True},
        "EIPGJ14": {"method": EIPGJ14, "h": 1 / 600},
        # A power of two, so that all times are exact: the rounding of 1/600 alone moves the Earth by 4e-12 AU
        # by the end.
        "EIPGJ14, balances": {"method": EIPGJ14, "h": 1 / 512, **orbits_kept()},
    }


def slope(times: np.ndarray, errors: np.ndarray) -> float:
    """Return the exponent p of a fit of errors ~ times^p, both of shape (m,), without errors that are 0.

    The result is nan if fewer than two errors are left.
    """
    known = errors > 0
    return float(np.polyfit(np.log(times[known]), np.log(errors[known]), 1)[0]) if known.sum() > 1 else float("nan")


def spread(values: np.ndarray) -> list[str]:
    """Return two cells of a table: the median of `values`, and their smallest and largest one."""
    digits = ".1e" if np.max(values) < 0.01 else ".2f"
    return [f"{np.median(values):{digits}}", f"{np.min(values):{digits}} ... {np.max(values):{digits}}"]


class Found(NamedTuple):
    """Times (m,) in years, and for each method the seconds of the run and the position errors (m, 10) in AU.

    `orders` has, for each number of steps per year, the position errors (6, m, 10) of EIPGJ14 with balances in the six
    orders of the axes.
    """

    times: np.ndarray
    seconds: dict[str, float]
    errors: dict[str, np.ndarray]
    orders: dict[int, np.ndarray]


def distances(states: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the distances (m, 10) in AU between the positions of the ten bodies in two series of states (60, m)."""
    return np.linalg.norm((states - truth)[:30].reshape(10, 3, -1), axis=1).T


def in_orders(problem: Problem, times: np.ndarray, truth: np.ndarray, steps: int) -> np.ndarray:
    """Return position errors (6, m, 10) in AU of EIPGJ14 with balances, in six orders of the axes.

    `steps` is the number of steps per year, and `truth` (60, m) are the true states at `times` (m,).
    """
    found = []
    for axes in ORDERS:
        start = replace(problem, y0=reordered(problem.y0, axes))
        run = integrate(start, (0.0, times[-1]), t_eval=times, method=EIPGJ14, h=1 / steps, **orbits_kept())
        found.append(distances(run.y, reordered(truth, axes)))
    return np.array(found)


@dataclass(frozen=True, kw_only=True)
class Growth(Measurement[Found]):
    """Command ``eip-scipy study growth``."""

    writes_files = True
    years: float = option(10_000.0, "length of the runs in Julian years (default: %(default)s)", type=positive)

    def measure(self, session: Session) -> Found:
        needed("eip_scipy.integrations.rebound")  # checked before runs that take minutes
        reference = reference_states()
        known = {t: y for t, y in reference.items() if t <= self.years}
        if not known:
            raise UsageError(
                f"--years must be at least {min(reference):g}, where the reference begins, got {self.years:g}"
            )
        times, truth = np.array(list(known)), np.array(list(known.values())).T
        problem = solar_system(years=times[-1])
        seconds, states = {}, {}
        own = ways()
        with session.bar(len(own) + 2 + len(ORDER_STEPS), "growth") as bar:
            for name, options in own.items():
                result = integrate(problem, (0.0, times[-1]), t_eval=times, **options)
                seconds[name], states[name] = result.wall_time, result.y
                bar.update()
            for name, integrator in (("WHFast (c17), 1 d", "whfast-c17"), ("IAS15", "ias15")):
                seconds[name], states[name] = rebound_states(problem, integrator, times)
                bar.update()
            orders = {}
            for steps in ORDER_STEPS:
                orders[steps] = in_orders(problem, times, truth, steps)
                bar.update()
        return Found(times, seconds, {name: distances(y, truth) for name, y in states.items()}, orders)

    def table(self, found: Found) -> str:
        late = found.times >= 10
        body = []
        for name, own in found.errors.items():
            cells = [f"{found.seconds[name]:.1f}"]
            for k in BODIES.values():
                cells += [f"{own[-1, k]:.1e}", f"{slope(found.times[late], own[late, k]):.1f}"]
            body.append((name, cells))
        heads = [["time [s]"], *(head for body in BODIES for head in ([body, "[AU]"], ["slope"]))]
        orders = []
        for steps, own in found.orders.items():
            for k, planet in list(enumerate(load("de440").bodies))[1:]:
                slopes = np.array([slope(found.times[late], one[late, k]) for one in own])
                orders.append((f"{planet}, 1/{steps} yr", [*spread(own[:, -1, k]), *spread(slopes)]))
        return (
            f"After {found.times[-1]:g} years, and the exponents of the growth from 10 years on\n\n{table(heads, body)}"
            "\n\nEIPGJ14, balances, in six orders of the axes\n\n"
            + table([["[AU]", "median"], ["", "range"], ["slope", "median"], ["", "range"]], orders)
        )

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"seconds": found.seconds, "orders": {str(steps): own.tolist() for steps, own in found.orders.items()}}

    def tables(self, found: Found) -> dict[str, Rows]:
        rows = [
            {"method": name, "years": t, **{body: own[j, k] for body, k in BODIES.items()}}
            for name, own in found.errors.items()
            for j, t in enumerate(found.times)
        ]
        return {"growth.csv": rows}

    def figures(self, found: Found) -> Figures:
        from eip_scipy.plotting import method_styles

        from ..plotting import blank_figure

        styles = method_styles(found.errors)
        figure = blank_figure(12, 5, "Ten bodies, Newton: growth of the error of position")
        axes = figure.subplots(1, len(BODIES), sharex=True, sharey=True)
        for axis, (body, k) in zip(axes, BODIES.items(), strict=True):
            for name, own in found.errors.items():
                axis.loglog(found.times, np.where(own[:, k] > 0, own[:, k], np.nan), ms=4, **styles[name])
            start = np.median([own[0, k] for own in found.errors.values()])
            law = 0.1 * start * (found.times / found.times[0]) ** 1.5
            axis.loglog(found.times, law, color="0.5", ls=":", label="slope 3/2 (Brouwer)")
            axis.set_title(body)
            axis.set_xlabel("time [yr]")
            axis.grid(alpha=0.3)
        axes[0].set_ylabel("error of position [AU]")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
        yield "growth.png", figure
