"""The figures of ``eip-scipy solar-system``, made from a `SolarRuns` with `eip_scipy_studies.plotting`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from eip_scipy.plotting import method_styles
from eip_scipy.problems.gravity.solar_data import YEAR_D

from .. import plotting
from ..report import describe_machine
from .cost import ENOUGH_SECONDS, MERCURY, panels
from .errors import SolarRuns, ecliptic, longitude_errors
from .runs import MethodRun, SolarScene

ELLIPSES = 40


def figures(study: SolarRuns, part: slice = slice(None)) -> Iterator[tuple[str, Any]]:
    """Make those `FIGURES` that are in the slice `part` one by one, and yield file names and figures.

    The runs must include the reference run; the last figure also needs the timings.
    """
    # A method has one style in all figures; timed methods come last, so that the runs look the same without them.
    styles = method_styles(dict.fromkeys([*(run.name for run in study.runs), *(item.method for item in study.cost)]))
    for name, figure in list(FIGURES.items())[part]:
        yield name, figure(study, styles)


def jacobi(scene: SolarScene, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of each planet relative to the centre of mass of all bodies before it.

    `y` are states (60, m). The results (9, 3, m) are in AU and AU/yr, in ecliptic axes.
    """
    q, v = y.reshape(2, -1, 3, y.shape[1])
    gm = scene.data.gm[:, None, None]
    inside = np.cumsum(gm, axis=0)[:-1]
    return tuple(ecliptic(scene, x[1:] - np.cumsum(gm * x, axis=0)[:-1] / inside) for x in (q, v))  # type: ignore


def osculating_orbits(scene: SolarScene, y: np.ndarray, n_points: int = 200) -> np.ndarray:
    """Compute the osculating ellipses: the orbit of each planet if all bodies before it were a single one.

    `y` are states (60, m). The result (9, m, 2, n_points) is in AU, in the plane of the ecliptic; nan for a planet that
    is not on an ellipse.
    """
    r, v = (np.moveaxis(x, 1, -1) for x in jacobi(scene, y))
    mu = np.cumsum(scene.data.gm)[1:, None, None] * YEAR_D**2
    momentum = np.cross(r, v)
    perihelion = np.cross(v, momentum) / mu - r / _norm(r)  # as long as the eccentricity
    eccentricity = _norm(perihelion)
    major = 1 / (2 / _norm(r) - np.sum(v * v, axis=-1, keepdims=True) / mu)
    minor = major * np.sqrt(np.where(eccentricity < 1, 1 - eccentricity**2, np.nan))
    across = np.cross(momentum, perihelion)
    E = np.linspace(0, 2 * np.pi, n_points)
    path = (major * perihelion / eccentricity)[..., None] * (np.cos(E) - eccentricity[..., None])
    path += (minor * across / _norm(across))[..., None] * np.sin(E)
    return path[..., :2, :]


def _norm(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def _span(study: SolarRuns) -> str:
    return f"{study.scene.years:g} yr, {study.scene.data.name}"


def _longitudes(study: SolarRuns) -> dict[str, np.ndarray]:
    """Return the errors of longitude (9, m) in rad along each run except the reference, by the name of the run.

    Without a reference run the dictionary is empty.
    """
    tight = study.tight
    if tight is None:
        return {}
    return {run.name: longitude_errors(study.scene, run, tight) for run in study.runs if run is not tight}


def _errors_figure(study: SolarRuns, styles: Any) -> Any:
    longitude = _longitudes(study)
    series = {}
    for run in study.runs:
        mercury = longitude[run.name][MERCURY] if run.name in longitude else np.full(run.t.size, np.nan)
        series[run.name] = plotting.ErrorSeries(run.t, {"H": run.energy_error, "L": run.momentum_error}, mercury)
    return plotting.errors_figure(
        series,
        styles=styles,
        time="time [yr]",
        trajectory=f"|longitude of Mercury - {_reference_name(study)}| [rad]",
        title=f"Preserved invariants do not prove a correct orbit: solar system, {_span(study)}",
    )


def _reference_name(study: SolarRuns) -> str:
    return study.tight.name if study.tight else "reference"


def _longitude_figure(study: SolarRuns, styles: Any) -> Any:
    return plotting.longitude_figure(
        study.tight.t if study.tight else (),
        _longitudes(study),
        study.scene.planets,
        styles=styles,
        time="time [yr]",
        title=f"Error of heliocentric longitude against {_reference_name(study)}: {_span(study)}",
    )


def _shown(study: SolarRuns) -> dict[str, MethodRun]:
    """Return, by title, the runs that the figures of orbits show: Stoermer-Verlet, the chosen method, the reference."""
    verlet = next(run for run in study.runs if run.name == "SV")
    shown = {"Störmer-Verlet": verlet, study.runs[0].name: study.runs[0]}
    if study.tight:
        shown[f"{study.tight.name} (reference)"] = study.tight
    return {f"{name}, ended at {run.t[-1]:.4g} yr" if run.failure else name: run for name, run in shown.items()}


def _sample(run: MethodRun) -> np.ndarray:
    """Return the indices of some saved states.

    They are not equally spaced, because equal spacing could hide a precession with the same period.
    """
    golden = np.arange(1, ELLIPSES) * (np.sqrt(5.0) - 1) / 2 % 1.0
    return np.unique(np.append((golden * run.t.size).astype(int), [0, run.t.size - 1]))


def _orbits_figure(which: slice, title: str, study: SolarRuns, styles: Any) -> Any:
    scene = study.scene
    panels = {}
    for name, run in _shown(study).items():
        orbits = osculating_orbits(scene, run.y[:, _sample(run)])[which]
        panels[name] = plotting.Orbits(orbits, jacobi(scene, run.y[:, -1:])[0][which, :2, 0])
    return plotting.orbits_figure(
        panels,
        scene.planets[which],
        unit="AU",
        title=f"{title}: osculating orbits during {_span(study)}, plane of the ecliptic",
    )


def _mercury_figure(study: SolarRuns, styles: Any) -> Any:
    panels = {}
    for name, run in _shown(study).items():
        sample = _sample(run)
        panels[name] = (run.t[sample], osculating_orbits(study.scene, run.y[:, sample])[MERCURY])
    return plotting.orbit_in_time_figure(
        panels,
        unit="AU",
        time="time [yr]",
        title=f"Mercury's osculating orbit during {_span(study)}, plane of the ecliptic",
    )


def _cost_figure(study: SolarRuns, styles: Any) -> Any:
    assert study.cost_scene is not None
    return plotting.cost_figure(
        panels(study.cost),
        error="error of position [AU]",
        styles=styles,
        title=f"Error against cost: runs of {study.cost_scene.years:g} yr, {study.scene.data.name}",
        footnote=f"{describe_machine()}; one thread, least of {study.repeats} timings, or one above {ENOUGH_SECONDS} s",
    )


FIGURES: dict[str, Callable[[SolarRuns, Any], Any]] = {
    "invariant-errors.png": _errors_figure,
    "longitude-errors.png": _longitude_figure,
    "orbits-outer.png": partial(_orbits_figure, slice(4, 9), "Outer planets and Pluto"),
    "orbits-inner.png": partial(_orbits_figure, slice(0, 4), "Inner planets"),
    "orbit-mercury.png": _mercury_figure,
    "error-against-cost.png": _cost_figure,
}
"""By file name; the last shows the timings, the others the runs."""
