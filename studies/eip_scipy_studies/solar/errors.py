"""Errors of the runs of the solar system against the reference, and the checks of the command."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..study import Check
from .cost import TimedRun
from .runs import TIGHT, MethodRun, SolarScene, report_times, stored_state

OBLIQUITY = math.radians(84381.448 / 3600)  # IAU 1976, as the paper's data: from the axes of the ICRF to the ecliptic
# A turn is counted right if the longitude error changes by less than half a turn between saved states. Two ellipses as
# eccentric as Mercury's, out of phase, contribute up to 1.6 rad; a change above this bound means that counting is lost.
COUNTABLE_CHANGE = 2.5
ROUND_OFF = 1e-13
FASTEST = 40.0  # rad/yr: Mercury at its perihelion
TIGHT_POSITION = {"IAS15": 1e-8, TIGHT: 1e-7}  # AU, after 2000 years


class PointErrors(NamedTuple):
    """Errors (9,) of the planets in one run at one time, and the name of the reference to which they are relative.

    Errors of longitude are signed, in rad, and nan if whole turns cannot be counted. Errors of position are distances
    in AU.
    """

    year: float
    reference: str
    longitude: np.ndarray
    position: np.ndarray


@dataclass
class SolarRuns:
    """The completed runs and their results, which can also be used after an interruption.

    `order` is that of the method asked for, and `tight` the most accurate run, with which the others are compared.
    `cost` has the timed runs of the figure of error against cost, and `cost_scene` their problem, which may be shorter
    than `scene`.
    """

    scene: SolarScene
    order: int
    runs: list[MethodRun] = field(default_factory=list)
    tight: MethodRun | None = None
    cost: list[TimedRun] = field(default_factory=list)
    cost_scene: SolarScene | None = None
    repeats: int = 3
    """Number of timed runs of each method in `cost`; the least time counts."""
    beside: str = ""
    """Name of the run that another core did in parallel; empty if all runs were done one after the other."""

    def errors(self, year: float) -> dict[str, PointErrors]:
        """Return, by name, the errors of those runs whose errors at the time `year` are known."""
        found = {run.name: errors_at(self.scene, run, year, self.tight) for run in self.runs}
        return {name: errors for name, errors in found.items() if errors is not None}

    def checks(self) -> list[Check]:
        """Return the command's checks for the runs that are completed."""
        return checks(self.scene, self.order, self.runs[0], self.tight) if self.runs else []


def ecliptic(scene: SolarScene, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors (k, 3, m) of k bodies at m times from ``scene.data.axes`` to the axes of the ecliptic."""
    if scene.data.axes != "ICRF":
        return vectors
    c, s = math.cos(OBLIQUITY), math.sin(OBLIQUITY)
    x, y, z = np.moveaxis(vectors, 1, 0)
    return np.stack([x, c * y + s * z, c * z - s * y], axis=1)


def longitude_errors(scene: SolarScene, run: MethodRun, truth: MethodRun) -> np.ndarray:
    """Return the errors (9, m) in rad of the heliocentric ecliptic longitude along a run, with whole turns counted.

    They are those at the times of `truth`, with which the run is compared; nan after the end of a run, and as soon as
    its longitude error changes too fast between saved states for its turns to be counted. The difference of two
    longitudes changes slowly even if the longitudes do not: the difference is made continuous in time.
    """
    n = _common_saves(run, truth)
    error = np.full((len(scene.planets), truth.t.size), np.nan)
    difference = _longitudes(scene, run.y[:, :n]) - _longitudes(scene, truth.y[:, :n])
    error[:, :n] = np.unwrap(_wrap(difference), axis=1)
    too_fast = np.abs(np.diff(error[:, :n], axis=1)) > COUNTABLE_CHANGE
    lost = np.logical_or.accumulate(too_fast, axis=1)
    error[:, 1:n][lost] = np.nan
    return error


def _common_saves(run: MethodRun, truth: MethodRun) -> int:
    n = min(run.t.size, truth.t.size)
    same = np.isclose(run.t[:n], truth.t[:n], rtol=1e-9, atol=1e-12)
    return n if same.all() else int(np.argmin(same))


def _longitudes(scene: SolarScene, y: np.ndarray) -> np.ndarray:
    q = y[: len(y) // 2].reshape(-1, 3, y.shape[1])
    heliocentric = ecliptic(scene, q[1:] - q[0])
    return np.arctan2(heliocentric[:, 1], heliocentric[:, 0])


def _wrap(angle: np.ndarray) -> np.ndarray:
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def errors_at(scene: SolarScene, run: MethodRun, year: float, tight: MethodRun | None) -> PointErrors | None:
    """Return the errors of a run at one of the `report_times`, or None if they are not known.

    They are not known if there is no reference at that time, the run is the reference itself, or the run ended before.
    Whole turns are counted along the run `tight`, which is also the reference if no reference state is stored; without
    it longitudes are nan. Positions are relative to the centre of mass.
    """
    state, source = stored_state(scene, year), "stored states"
    if state is None and tight is not None and tight is not run:
        state, source = _state_at(tight, year), tight.name
    own = _state_at(run, year)
    if state is None or own is None:
        return None
    position = np.linalg.norm((own - state)[: own.size // 2].reshape(-1, 3)[1:], axis=1)
    wrapped = _wrap(_longitudes(scene, own[:, None]) - _longitudes(scene, state[:, None]))[:, 0]
    return PointErrors(year, source, wrapped + _turns(scene, run, year, tight, wrapped), position)


def _turns(scene: SolarScene, run: MethodRun, year: float, tight: MethodRun | None, wrapped: np.ndarray) -> np.ndarray:
    """Return the whole turns (9,), as angles, to be added to the errors of longitude `wrapped`, in [-pi, pi).

    The turns are counted along the run `tight`; they are nan if `tight` is None or has no state at `year`.
    """
    if tight is None or _state_at(tight, year) is None:
        return np.full_like(wrapped, np.nan)
    counted = longitude_errors(scene, run, tight)[:, _index(tight, year)]
    return 2 * np.pi * np.round((counted - wrapped) / (2 * np.pi))


def _index(run: MethodRun, year: float) -> int:
    return int(np.argmin(np.abs(run.t - year)))


def _state_at(run: MethodRun, year: float) -> np.ndarray | None:
    k = _index(run, year)
    return run.y[:, k] if math.isclose(run.t[k], year, rel_tol=1e-9) else None


def checks(scene: SolarScene, order: int, main: MethodRun, tight: MethodRun | None) -> list[Check]:
    """Return checks that hold for any sensible settings; if one fails, the results are not reliable.

    They are that the runs reached the end, that `main`, the run of the method of order `order`, keeps H and L, and that
    `tight`, the most accurate run, agrees with stored states.
    """
    done = [Check(f"{main.name} reached the end", not main.failure)]
    # Residuals are O(h^(2p + 2)): round-off for small steps; for large ones the factor is measured, with a margin of
    # 10.
    bound = max(ROUND_OFF, 1e-3 * (FASTEST * scene.h) ** (2 * order + 2))
    for name, series in (("H", main.energy_error), ("L", main.momentum_error)):
        value = float(series.max())
        done.append(Check(f"{main.name} keeps {name}: relative error {value:.1e} (bound {bound:.1e})", value <= bound))
    if tight is not None:
        done += _reference_checks(scene, tight)
    return done


def _reference_checks(scene: SolarScene, tight: MethodRun) -> list[Check]:
    """Return, as a list, a check that the run `tight` agrees with the last stored state.

    If there is no stored state, or the run ended before it, the check is that the run reached the end.
    """
    stored = [year for year in report_times(scene) if stored_state(scene, year) is not None]
    at_end = errors_at(scene, tight, stored[-1], tight) if stored else None
    if at_end is None:
        return [Check(f"{tight.name} reached the end", not tight.failure)]
    worst, bound = float(at_end.position.max()), TIGHT_POSITION[tight.name]
    text = f"{tight.name} agrees with the stored states at {stored[-1]:g} yr to {worst:.1e} AU (bound {bound:g})"
    return [Check(text, worst <= bound)]
