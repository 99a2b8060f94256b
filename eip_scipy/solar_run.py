"""The solar system run by several methods, and how far each is from the truth: the numbers of ``solar-system``.

Nothing is printed or written here. REBOUND comes in as a function (`Judge`), so that this module needs no extra.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ._setup import check_fixed_step
from .comparators import StormerVerletResult, stormer_verlet
from .diagnostics import invariants_along
from .longrun import integrate
from .problems import Problem, SolarSystemData, solar_system
from .problems.solar_data import YEAR_D, load
from .solvers import EIPRK4, EIPRK5, EIPSolver
from .work_precision import Runner, WorkPrecision, work_precision

__all__ = [
    "Check",
    "Judge",
    "MethodRun",
    "PointErrors",
    "Scene",
    "Task",
    "checks",
    "cost",
    "cost_methods",
    "errors_at",
    "jacobi",
    "longitude_errors",
    "make_scene",
    "osculating_orbits",
    "plan",
    "report_times",
]

Judge = Callable[..., Any]
"""`eip_scipy.integrations.rebound.run`."""

OBLIQUITY = math.radians(84381.448 / 3600)  # IAU 1976, as the paper's data: from the axes of the ICRF to the ecliptic
MERCURY = 0  # of the planets, which start behind the Sun
WHFAST_DAYS = 5.0
MOST_SAVES = 20_000
REPEATS = 3
# A turn is counted right if the longitude error changes by less than half a turn between saved states. Two ellipses as
# eccentric as Mercury's, out of phase, contribute up to 1.6 rad; a change above this bound means that counting is lost.
COUNTABLE_CHANGE = 2.5
ROUND_OFF = 1e-13
FASTEST = 40.0  # rad/yr: Mercury at its perihelion
TIGHT_POSITION = {"IAS15": 1e-8}


@dataclass(frozen=True, eq=False)
class Scene:
    """What all methods share: the problem, its data, and the times at which states are saved.

    Attributes
    ----------
    problem : Problem
        In AU and Julian years; its `h` divides the time between saves.
    data : SolarSystemData
    years, h : float
    n_saves : int
        States saved after the start, equally spaced.
    every : int
        Steps between them.
    """

    problem: Problem
    data: SolarSystemData
    years: float
    h: float
    n_saves: int
    every: int

    @property
    def interval(self) -> float:
        """Years between saved states."""
        return self.years / self.n_saves

    @property
    def planets(self) -> tuple[str, ...]:
        """Names of the bodies without the Sun."""
        return self.data.bodies[1:]


@dataclass(frozen=True, eq=False)
class MethodRun:
    """One method's run; states that are not finite are left out.

    Attributes
    ----------
    name : str
    head : tuple of str
        The name on the lines of a table's head.
    step : float or None
        Years; None where the method chooses its steps.
    wall_time : float
        Seconds, compilation and the reading of states left out.
    t : ndarray, shape (m,)
    y : ndarray, shape (60, m)
    energy_error, momentum_error : ndarray, shape (m,)
        |H - H(0)| / |H(0)| and |L - L(0)| / |L(0)|.
    failure : str
        Why the run did not reach its end, or empty.
    """

    name: str
    head: tuple[str, ...]
    step: float | None
    wall_time: float
    t: np.ndarray
    y: np.ndarray
    energy_error: np.ndarray
    momentum_error: np.ndarray
    failure: str = ""


class Task(NamedTuple):
    """A run still to be done: ``start(progress)``; `has_bar`: whether it shows a progress bar by itself."""

    name: str
    start: Callable[[bool], MethodRun]
    has_bar: bool


class PointErrors(NamedTuple):
    """Errors of one run at one time; longitudes with their sign, in rad, nan where turns cannot be counted."""

    year: float
    reference: str
    longitude: np.ndarray
    position: np.ndarray


class Check(NamedTuple):
    """A condition that a sound run meets."""

    passed: bool
    text: str


def make_scene(name: str, years: float, h: float) -> Scene:
    """Set the scene for a run of so many years.

    Parameters
    ----------
    name : str
        One of `eip_scipy.problems.solar_data.available()`.
    years : float
        Length of the run in Julian years, > 0.
    h : float
        Upper bound of the step in years; the step divides the time between saved states and is shortened where need be.

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        For a step that does not fit into the span or is below the spacing of numbers there, or for unknown data.
    """
    check_fixed_step(h, 0.0, years)
    n_saves = _ceil(years / max(_save_interval(years), h))
    every = _ceil(years / (n_saves * h))
    step = years / (n_saves * every)
    data = load(name)
    return Scene(solar_system(data, years=years, h=step), data, years, step, n_saves, every)


def _save_interval(years: float) -> float:
    """Dense enough to count turns, some hundred points for a curve, and 1, 10, 100 ... years among them."""
    for least_years, interval in ((200.0, 1.0), (100.0, 0.5), (40.0, 0.2), (1.0, 0.1)):
        if years >= least_years:
            return max(interval, years / MOST_SAVES)
    return years / 10


def _ceil(ratio: float) -> int:
    """Round the ratio up, unless it is a whole number to rounding."""
    nearest = round(ratio)
    return max(1, nearest if abs(ratio - nearest) <= 1e-9 * ratio else math.ceil(ratio))


def plan(scene: Scene, method: type[EIPSolver], metric: str, judge: Judge | None) -> list[Task]:
    """List the runs of the comparison: first the method asked for, last the tightest, which serves as reference.

    Parameters
    ----------
    scene : Scene
    method : type
        `EIPRK1` ... `EIPRK5` or another fixed-step class.
    metric : {"error", "euclidean"}
    judge : callable or None
        REBOUND, if it is there.

    Returns
    -------
    list of Task
    """
    metrics = {_metric(method, metric), _metric(method, "error"), "euclidean"}
    ordered = sorted(metrics, key=lambda m: m != _metric(method, metric))
    tasks = [Task(_eip_name(method, m), partial(_eip, scene, method, m), True) for m in ordered]
    tasks.append(Task(method.TABLEAU.name, partial(_plain, scene, method), True))
    tasks.append(Task("SV", lambda progress: _verlet(scene), False))
    if judge is None:
        tasks.append(Task("EIPRK5 (tight)", partial(_tight, scene), True))
        return tasks
    per_save = max(1, round(scene.interval * YEAR_D / WHFAST_DAYS))
    for name, integrator, steps in (("WHFast", "whfast", per_save), ("WHFast (c17)", "whfast-c17", per_save)):
        tasks.append(Task(name, partial(_rebound, scene, judge, name, integrator, steps), False))
    tasks.append(Task("IAS15", partial(_rebound, scene, judge, "IAS15", "ias15", 1), False))
    return tasks


def _metric(method: type[EIPSolver], metric: str) -> str:
    """Return the metric that a method really has: euclidean without an error estimate."""
    return metric if method.TABLEAU.has_estimate else "euclidean"


def _eip_name(method: type[EIPSolver], metric: str) -> str:
    return f"{method.__name__} ({metric})"


def _named(method: type[EIPSolver], name: str) -> type[EIPSolver]:
    """Put the method under another name, for its progress bar."""
    return type(name, (method,), {"__doc__": method.__doc__})


def _eip(scene: Scene, method: type[EIPSolver], metric: str, progress: bool) -> MethodRun:
    name = _eip_name(method, metric)
    head = (method.__name__, "euclid." if metric == "euclidean" else metric)
    result = integrate(
        scene.problem, method=_named(method, name), metric=metric, save_every=scene.every, progress=progress
    )
    return _finished(scene, name, head, scene.h, result, "" if result.success else result.message)


def _plain(scene: Scene, method: type[EIPSolver], progress: bool) -> MethodRun:
    name = method.TABLEAU.name
    result = integrate(
        scene.problem, method=_named(method, name), invariants=(), save_every=scene.every, progress=progress
    )
    return _finished(scene, name, (name, "alone"), scene.h, result, "" if result.success else result.message)


def _tight(scene: Scene, progress: bool) -> MethodRun:
    """Run the tightest at hand without REBOUND: EIPRK5, a quarter of the step, compensated."""
    name = "EIPRK5 (tight)"
    result = integrate(
        scene.problem,
        method=_named(EIPRK5, name),
        h=scene.h / 4,
        save_every=4 * scene.every,
        compensated=True,
        progress=progress,
    )
    return _finished(scene, name, ("EIPRK5", "tight"), scene.h / 4, result, "" if result.success else result.message)


def _verlet(scene: Scene) -> MethodRun:
    result = _leapfrog(scene, scene.h, scene.every)
    failure = "" if np.isfinite(result.y).all() else result.message
    return _finished(scene, "SV", ("SV",), scene.h, result, failure)


def _leapfrog(scene: Scene, step: float, save_every: int | None) -> StormerVerletResult:
    problem = scene.problem
    assert problem.acc is not None  # N bodies have accelerations
    return stormer_verlet(problem.acc, problem.t_span, problem.y0, step, params=problem.params, save_every=save_every)


def _rebound(scene: Scene, judge: Judge, name: str, integrator: str, per_save: int, progress: bool) -> MethodRun:
    """Run REBOUND; with fixed steps timed in a run without saves, each of which costs a synchronisation."""
    step = scene.interval / per_save
    run = partial(judge, scene.problem.params, scene.problem.y0, integrator, h=step, n_steps=scene.n_saves * per_save)
    result = run(save_every=per_save)
    fixed = integrator != "ias15"
    wall_time = run().wall_time if fixed else result.wall_time
    head = tuple(name.replace("(", "").replace(")", "").split())
    return _finished(scene, name, head, step if fixed else None, result, "", wall_time)


def _finished(
    scene: Scene,
    name: str,
    head: tuple[str, ...],
    step: float | None,
    result: Any,
    failure: str,
    wall_time: float | None = None,
) -> MethodRun:
    finite = np.isfinite(result.y).all(axis=0)
    t, y = result.t[finite], result.y[:, finite]
    values = invariants_along(scene.problem.invariants, t, y)
    start = values[:, :1]
    return MethodRun(
        name=name,
        head=head,
        step=step,
        wall_time=result.wall_time if wall_time is None else wall_time,
        t=t,
        y=y,
        energy_error=np.abs(values[0] / start[0] - 1),
        momentum_error=np.linalg.norm((values - start)[1:], axis=0) / np.linalg.norm(start[1:]),
        failure=failure,
    )


def jacobi(scene: Scene, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of the planets relative to the centre of mass of all bodies further in.

    Parameters
    ----------
    scene : Scene
    y : ndarray, shape (60, m)

    Returns
    -------
    position, velocity : ndarray, shape (9, 3, m)
        AU and AU/yr, ecliptic axes.
    """
    q, v = y.reshape(2, -1, 3, y.shape[1])
    gm = scene.data.gm[:, None, None]
    inside = np.cumsum(gm, axis=0)[:-1]
    return tuple(_ecliptic(scene, x[1:] - np.cumsum(gm * x, axis=0)[:-1] / inside) for x in (q, v))  # type: ignore


def _ecliptic(scene: Scene, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors (k, 3, m) from the data's axes to those of the ecliptic."""
    if scene.data.axes != "ICRF":
        return vectors
    c, s = math.cos(OBLIQUITY), math.sin(OBLIQUITY)
    x, y, z = np.moveaxis(vectors, 1, 0)
    return np.stack([x, c * y + s * z, c * z - s * y], axis=1)


def osculating_orbits(scene: Scene, y: np.ndarray, n_points: int = 200) -> np.ndarray:
    """Compute the ellipses that the planets would follow around the bodies further in, if those were one.

    Parameters
    ----------
    scene : Scene
    y : ndarray, shape (60, m)
    n_points : int, optional
        Points on an ellipse.

    Returns
    -------
    ndarray, shape (9, m, 2, n_points)
        AU, in the plane of the ecliptic; nan for a planet that is not on an ellipse.
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


def longitude_errors(scene: Scene, run: MethodRun, truth: MethodRun) -> np.ndarray:
    """Errors of the heliocentric ecliptic longitude along a run, with whole turns counted.

    Parameters
    ----------
    scene : Scene
    run, truth : MethodRun
        The run, and the one it is compared with.

    Returns
    -------
    ndarray, shape (9, m)
        rad, at the times of `truth`. nan after the end of a run, and from where its longitude error changes too fast
        between saved states for its turns to be counted.

    Notes
    -----
    The difference of two longitudes changes slowly where the longitudes themselves do not: it is what is made
    continuous in time.
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


def _longitudes(scene: Scene, y: np.ndarray) -> np.ndarray:
    q = y[: len(y) // 2].reshape(-1, 3, y.shape[1])
    heliocentric = _ecliptic(scene, q[1:] - q[0])
    return np.arctan2(heliocentric[:, 1], heliocentric[:, 0])


def _wrap(angle: np.ndarray) -> np.ndarray:
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def stored_state(scene: Scene, year: float) -> np.ndarray | None:
    """Return the reference state that the package carries for a time, if there is one."""
    known = scene.problem.reference
    return None if known is None else known(round(float(year), 9))


def report_times(scene: Scene) -> list[float]:
    """Years at which errors are reported: those with a stored reference state that were saved, and the end."""
    times = np.linspace(0.0, scene.years, scene.n_saves + 1)[1:]
    stored = [round(float(t), 9) for t in times if stored_state(scene, t) is not None]
    return sorted({*stored, float(scene.years)})


def errors_at(scene: Scene, run: MethodRun, year: float, tight: MethodRun | None) -> PointErrors | None:
    """Errors of a run at one of the `report_times`.

    Parameters
    ----------
    scene : Scene
    run : MethodRun
    year : float
    tight : MethodRun or None
        The run that counts the turns, and the reference where no state is stored.

    Returns
    -------
    PointErrors or None
        None where nothing is known: no reference at that time, the run is that reference, or it ended before.
        Longitudes are nan without `tight`. Positions are relative to the centre of mass.
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


def _turns(
    scene: Scene, run: MethodRun, year: float, tight: MethodRun | None, wrapped: np.ndarray
) -> np.ndarray:
    """Whole turns to be added to an error in (-pi, pi], as counted along the tightest run."""
    if tight is None:
        return np.full_like(wrapped, np.nan)
    counted = longitude_errors(scene, run, tight)[:, _index(tight, year)]
    return 2 * np.pi * np.round((counted - wrapped) / (2 * np.pi))


def _index(run: MethodRun, year: float) -> int:
    return int(np.argmin(np.abs(run.t - year)))


def _state_at(run: MethodRun, year: float) -> np.ndarray | None:
    k = _index(run, year)
    return run.y[:, k] if math.isclose(run.t[k], year, rel_tol=1e-9) else None


def checks(scene: Scene, order: int, main: MethodRun, tight: MethodRun | None) -> list[Check]:
    """Conditions that hold for any sensible arguments; one that fails says that the numbers are not to be trusted.

    Parameters
    ----------
    scene : Scene
    order : int
        Order of the method asked for.
    main : MethodRun
        Its run.
    tight : MethodRun or None
        The tightest run.

    Returns
    -------
    list of Check
    """
    done = [Check(not main.failure, f"{main.name} reached the end")]
    # Defects are O(h^(2p + 2)): round-off for small steps; for large ones the factor is measured, with room of 10.
    bound = max(ROUND_OFF, 1e-3 * (FASTEST * scene.h) ** (2 * order + 2))
    for name, series in (("H", main.energy_error), ("L", main.momentum_error)):
        value = float(series.max())
        done.append(Check(value <= bound, f"{main.name} keeps {name}: relative error {value:.1e} (bound {bound:.1e})"))
    if tight is not None:
        done += _reference_checks(scene, tight)
    return done


def _reference_checks(scene: Scene, tight: MethodRun) -> list[Check]:
    """Whether the run that counts turns follows the stored states, at the last of them."""
    stored = [year for year in report_times(scene) if stored_state(scene, year) is not None]
    at_end = errors_at(scene, tight, stored[-1], tight) if stored else None
    if at_end is None:
        return [Check(not tight.failure, f"{tight.name} reached the end")]
    if tight.name in TIGHT_POSITION:
        worst, bound, unit = float(at_end.position.max()), TIGHT_POSITION[tight.name], "AU"
    else:
        worst, bound, unit = float(np.abs(at_end.longitude).max()), 0.5, "rad"
    text = f"{tight.name} agrees with the stored states at {stored[-1]:g} yr to {worst:.1e} {unit} (bound {bound:g})"
    return [Check(worst <= bound, text)]


def cost(
    scene: Scene,
    methods: Mapping[str, tuple[Runner, Sequence[float]]],
    judge: Judge | None,
    callback: Callable[[], Any] | None = None,
) -> WorkPrecision:
    """Mercury's final position error against the time of the run, for several methods and steps.

    Parameters
    ----------
    scene : Scene
        Of the span to be timed.
    methods : mapping
        From `cost_methods`.
    judge : callable or None
        REBOUND, if it is there.
    callback : callable, optional
        ``callback()`` after each run; there are `REPEATS` of each method and step.

    Returns
    -------
    WorkPrecision
    """
    truth = stored_state(scene, scene.years)
    if truth is None:
        truth = (_tight(scene, False) if judge is None else _rebound(scene, judge, "IAS15", "ias15", 1, False)).y[:, -1]
    half = truth.size // 2

    def error(y: np.ndarray) -> float:
        return float(np.linalg.norm((y - truth)[:half].reshape(-1, 3)[1 + MERCURY]))

    return work_precision(methods, error, repeats=REPEATS, callback=callback)


def cost_methods(
    scene: Scene, method: type[EIPSolver], metric: str, judge: Judge | None
) -> dict[str, tuple[Runner, Sequence[float]]]:
    """List what `cost` times, with the steps.

    Parameters
    ----------
    scene : Scene
    method : type
        With its projection, and without; and beside it EIPRK5 (EIPRK4 beside EIPRK5).
    metric : {"error", "euclidean"}
    judge : callable or None

    Returns
    -------
    dict
        As `work_precision` takes it.
    """
    other = EIPRK4 if method is EIPRK5 else EIPRK5
    own = _metric(method, metric)
    steps = _steps(scene, [scene.h * factor for factor in (4, 2, 1, 0.5)])
    methods: dict[str, tuple[Runner, Sequence[float]]] = {
        _eip_name(method, own): (partial(_time_eip, scene, method, {"metric": own}), steps),
        method.TABLEAU.name: (partial(_time_eip, scene, method, {"invariants": ()}), steps),
        _eip_name(other, metric): (partial(_time_eip, scene, other, {"metric": metric}), steps),
        "SV": (partial(_time_verlet, scene), _steps(scene, [scene.h * f for f in (2, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)])),
    }
    if judge is None:
        return methods
    days = _steps(scene, [d / YEAR_D for d in (10.0, 5.0, 2.5, 1.25)])
    methods["WHFast"] = (partial(_time_rebound, scene, judge, "whfast"), days)
    methods["WHFast (c17)"] = (partial(_time_rebound, scene, judge, "whfast-c17"), days)
    if stored_state(scene, scene.years) is not None:  # otherwise it is the reference
        methods["IAS15"] = (partial(_time_rebound, scene, judge, "ias15"), [scene.years])
    return methods


def _steps(scene: Scene, wanted: Sequence[float]) -> list[float]:
    """Shorten steps to divide the span: a shortened last one would spoil a symplectic method."""
    return sorted({scene.years / _ceil(scene.years / h) for h in wanted}, reverse=True)


def _time_eip(
    scene: Scene, method: type[EIPSolver], options: dict[str, Any], step: float
) -> tuple[float, np.ndarray]:
    result = integrate(scene.problem, method=method, h=step, **options)
    return result.wall_time, result.y[:, -1] if result.success else np.full_like(scene.problem.y0, np.nan)


def _time_verlet(scene: Scene, step: float) -> tuple[float, np.ndarray]:
    result = _leapfrog(scene, step, None)
    return result.wall_time, result.y[:, -1]


def _time_rebound(scene: Scene, judge: Judge, integrator: str, step: float) -> tuple[float, np.ndarray]:
    n_steps = _ceil(scene.years / step)
    result = judge(scene.problem.params, scene.problem.y0, integrator, h=scene.years / n_steps, n_steps=n_steps)
    return result.wall_time, result.y[:, -1]
