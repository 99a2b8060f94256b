"""REBOUND: its simulations as problems, our runs as simulations and archives, and its integrators as references.

What a simulation and a problem share is read by one function and written by one: G m and names by `_masses`, `_names`
and `_new`, units by `_units` and `_unit_names`, states by `_state` and `_set_state`. Forces and limits are only read,
by `_attached` and `exit_events`; `_unsupported` lists what a problem cannot hold.

REBOUND (H. Rein, S.-F. Liu, Astronomy & Astrophysics 537 (2012) A128) is free software under the GPL and is not
distributed with this package; versions 4.6 and 5 are supported.
"""

from __future__ import annotations

import ctypes
import math
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from itertools import pairwise, zip_longest
from time import perf_counter
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult

from eip_scipy.core.callers import users_level
from eip_scipy.core.functions import compilable, jitted
from eip_scipy.core.inputs import count, is_number, real_array, shown
from eip_scipy.core.step_control import saved_steps
from eip_scipy.problems import ForceConstants, Problem, nbody
from eip_scipy.problems.gravity.bodies import bodies_of
from eip_scipy.problems.gravity.nbody import component_names

try:
    import rebound
    from rebound.units import convert_G, lengths_SI, masses_SI, times_SI
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.rebound needs REBOUND: pip install "eip_scipy[rebound]"', name="rebound"
    ) from error

__all__ = [
    "INTEGRATORS", "exit_events", "keep_ctrl_c", "megno", "problem_from_simulation", "read_archive", "run",
    "simulation", "to_archive", "to_simulation",
]  # fmt: skip

# With these options a copy is synchronised when a state is saved, which then does not change the run.
_FAST: dict[str, Any] = {"safe_mode": 0, "keep_unsynchronized": 1}
# REBOUND's names of the integrators, and their options.
_SETTINGS = {
    "whfast": ("whfast", _FAST),
    "whfast-c17": ("whfast", _FAST | {"corrector": 17}),
    "ias15": ("ias15", {}),
    "leapfrog": ("leapfrog", {}),
    "saba(10,6,4)": ("saba", _FAST | {"type": "10,6,4" if hasattr(rebound.Simulation, "ri_saba") else "10_6_4"}),
}
INTEGRATORS = tuple(_SETTINGS)
# Steps between two checks for Ctrl-C, which Python handles only outside of REBOUND's loop. Version 4 counts in 32 bits.
_CHUNK = 100_000
# REBOUNDx's forces and ours.
_FORCES = {"gr": "1pn", "gr_full": "eih", "gr_potential": "gr-potential"}
# Units of lengths and times: the base unit, the names of units here, and REBOUND's.
_METRES = {"AU": 149597870700.0, "m": 1.0, "cm": 0.01, "km": 1e3}
_YEAR = 365.25 * 86400.0
_YEARS = {"yr": _YEAR, "kyr": 1e3 * _YEAR, "Myr": 1e6 * _YEAR, "Gyr": 1e9 * _YEAR}
_UNITS = ("m", _METRES, lengths_SI), ("s", {"s": 1.0, "h": 3600.0, "d": 86400.0, **_YEARS}, times_SI)


def problem_from_simulation(
    sim: rebound.Simulation,
    *,
    t_span: tuple[float, float] | None = None,
    h: float | None = None,
    forces: str | Sequence[str] | None = None,
    constants: ForceConstants | None = None,
    names: Sequence[str] | None = None,
    balances: str | Sequence[str] | None = None,
) -> Problem:
    """Build an N-body problem from a REBOUND simulation, which is synchronised, at its present state.

    Parameters
    ----------
    sim : rebound.Simulation
        Particles that attract nothing get mass 0; the distances that end it become terminal events, see `exit_events`.
    t_span, h : tuple of float, float, optional
        Default: from sim.t, where it must start, over 1000 steps sim.dt; the magnitude of sim.dt.
    forces, constants : optional
        The simulation's additional forces, as for `nbody`; () if none matters. Default: that of REBOUNDx, with its c:
        "gr" (here "1pn", which differs by a part in a thousand of the effect), "gr_full" ("eih") or "gr_potential".
    names, balances : optional
        As for `nbody`; default names: those of the particles (REBOUND 5), or numbers. Snapshots of an archive after the
        first may have lost their names.

    Raises
    ------
    TypeError, ValueError
        If `sim` is not a simulation, or has features that the N-body problem lacks: the message says which. A
        UserWarning says that a problem cannot hold a heartbeat.
    """
    if not isinstance(sim, rebound.Simulation):
        advice = "read one from an archive by rebound.Simulation(path)"
        raise TypeError(f"problem_from_simulation: expected a rebound.Simulation, got {shown(sim)}; {advice}")
    for what in _unsupported(sim):
        raise ValueError(f"the simulation has a feature that an N-body problem of eip_scipy does not support: {what}")
    if sim._heartbeat:
        text = "heartbeat is not called by runs of the problem; if they need it, give integrate events= or callback="
        warnings.warn(f"problem_from_simulation: the simulation's {text}", UserWarning, stacklevel=users_level())
    if forces is None and constants is not None:
        raise ValueError("constants= needs forces=..., to which they belong; forces of REBOUNDx have their own.")
    t_span = (sim.t, sim.t + 1000 * sim.dt) if t_span is None else t_span
    if isinstance(t_span[0], int | float) and t_span[0] != sim.t:
        text = f"t_span starts at {t_span[0]:.10g}, but the state is that of t={sim.t:.10g}"
        raise ValueError(f"{text}. Give t_span=({sim.t:.10g}, ...), or set sim.t = {t_span[0]:.10g}.")
    forces, constants = _attached(sim) if forces is None else (forces, constants)
    sim.synchronize()
    problem = nbody(
        _masses(sim),
        *_state(sim).reshape(2, -1, 3),
        t_span=t_span,
        h=abs(sim.dt) if h is None else h,
        forces=forces,
        constants=constants,
        name="rebound",
        units=_units(sim),
        source=f"REBOUND {rebound.__version__} simulation of {sim.N} bodies at t = {sim.t!r}",
        bodies=_names(sim) if names is None else names,
        G=sim.G,
        balances=balances,
    )
    return replace(problem, events=exit_events(sim) or None)


def exit_events(sim: rebound.Simulation) -> list[Any]:
    """Return terminal events for ``sim.exit_max_distance`` (from the origin) and ``sim.exit_min_distance`` (of bodies).

    REBOUND checks them after each step, while an event is located within it. If a distance is exceeded at the start,
    the run ends there.
    """
    given = [(name, float(getattr(sim, name))) for name in ("exit_max_distance", "exit_min_distance")]
    return [_ExitEvent(name, limit) for name, limit in given if limit > 0]


def to_simulation(
    run: Any,
    y: Any = None,
    *,
    row: int | None = None,
    t: float | None = None,
    template: rebound.Simulation | None = None,
) -> rebound.Simulation:
    """Build a REBOUND simulation from a problem of bodies, or from a state of its run.

    Parameters
    ----------
    run : Problem or IntegrationResult
        A problem by `nbody`, `problem_from_simulation` and the like, or a run of one by `integrate`.
    y : array_like, shape (6 N,), optional
        The state (q, v); default: the start of a problem, the `row` of a run.
    row : int, optional
        Index of a saved state of the run; default: -1, the last one.
    t : float, optional
        The simulation's time; default: that of the row or the saved state that equals `y`, or a problem's start.
    template : rebound.Simulation, optional
        A simulation of the same bodies, of which the result is a copy with the state and the time set. Default: G,
        masses, names and units as in the simulation that the problem came from; for other problems masses in solar
        masses if REBOUND knows the problem's units, else G = 1; ``N_active`` excludes trailing bodies without mass.

    Raises
    ------
    TypeError, ValueError
        If `run` is neither a problem of bodies nor a run of one, shapes or masses do not fit, or there is no such row.
        A UserWarning says that forces other than Newton's are to be attached by REBOUNDx.
    """
    bodies = bodies_of(run)
    time, start = _chosen(run, bodies.problem, y, row, t)
    if bodies.forces and template is None:
        theirs = {ours: name for name, ours in _FORCES.items()}
        theirs |= {"j2": "gravitational_harmonics", "radiation": "radiation_forces"}
        given = ", ".join(f"{name} (REBOUNDx: {theirs.get(name, 'none')})" for name in bodies.forces)
        text = f"Newton's gravitation only, but the problem also has {given}; attach it by REBOUNDx if a run needs it."
        warnings.warn(f"to_simulation: the simulation has {text}", UserWarning, stacklevel=users_level())
    if template is None:
        sim = _new(bodies.gm, start, bodies.names, bodies.problem.G, _unit_names(bodies.problem))
    else:
        sim = _like(template, bodies.gm)
        _set_state(sim, start)
    sim.t = time
    return sim


def to_archive(run: Any, path: str | os.PathLike[str], *, template: rebound.Simulation | None = None) -> None:
    """Write all saved states of a run of bodies as the snapshots of a new REBOUND Simulationarchive.

    `run` and `template` are as for `to_simulation`, and so are errors and warnings. A FileExistsError is raised if
    `path` exists, because REBOUND would append to it.
    """
    place = os.fspath(path)
    if os.path.lexists(place):
        raise FileExistsError(f"to_archive: {place} is there already; give a new path.")
    if not (hasattr(run, "t") and hasattr(run, "y")):
        raise TypeError(f"to_archive: expected a run by integrate, got {shown(run)}.")
    sim = to_simulation(run, row=0, template=template)
    for t, y in zip(run.t, run.y.T, strict=True):
        sim.t = t
        _set_state(sim, y)
        sim.save_to_file(place)


def read_archive(path: str | os.PathLike[str], *, every: int = 1, names: Sequence[str] | None = None) -> OptimizeResult:
    """Read every `every`-th snapshot of a REBOUND Simulationarchive as one run.

    The result has times ``t`` (m,), states (q, v) ``y`` (6 N, m), ``gm`` (N,), ``component_names`` (of `names`, or as
    in `problem_from_simulation`), ``units`` and ``message``; `eip_scipy.results.to_xarray`, `orbital_elements` and
    similar functions accept it. A single snapshot is ``rebound.Simulation(path, snapshot=k)``.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such file, REBOUND cannot read it, or bodies or masses change from one snapshot to another.
    """
    place, every = os.fspath(path), count("every", every)
    if not os.path.isfile(place):
        raise FileNotFoundError(f"read_archive: no file at {place}")
    with open(place, "rb") as file:
        if not file.read(32).startswith(b"REBOUND Binary File"):
            raise ValueError(f"read_archive: {place} is not an archive of REBOUND.")
    times, states = [], []
    with warnings.catch_warnings():
        # A file never contains functions of a simulation, and nothing is integrated here.
        warnings.filterwarnings("ignore", "You have to reset function pointers", RuntimeWarning)
        try:
            archive = rebound.Simulationarchive(place)
        except RuntimeError as error:
            raise ValueError(f"read_archive: REBOUND cannot read {place}: {error}") from error
        # REBOUND 5.2 finds names by the addresses that they had when they were written, and mixes up two of them if one
        # has the old address of the other now. Copies that exist at the same time have different addresses.
        copies = [archive[0] for _ in range(4)]
        first = max(copies, key=lambda copy: len({getattr(particle, "name", None) for particle in copy.particles}))
        gm = first.G * _masses(first)
        for k in range(0, len(archive), every):
            sim = archive[k]
            sim.synchronize()
            if not np.array_equal(sim.G * _masses(sim), gm):
                text = f"bodies or masses in snapshot {k} of {place} differ from those in the first one"
                raise ValueError(f"read_archive: {text}. Read it by rebound.Simulation(path, snapshot={k}).")
            times.append(sim.t)
            states.append(_state(sim))
    names, message = _names(first) if names is None else names, f"{len(times)} snapshots of a REBOUND archive"
    return _result(times, states, gm, message, names, _units(first))


@contextmanager
def keep_ctrl_c() -> Iterator[None]:
    """Give Ctrl-C back to Python after calls of ``Simulation.integrate``: ``with keep_ctrl_c(): sim.integrate(100)``.

    REBOUND handles the signal itself from the first such call on, so that Ctrl-C afterwards stops nothing but its own
    integrations. Python can take the signal back in the main thread only; elsewhere this function does nothing.
    """
    try:
        yield
    finally:
        handler = signal.getsignal(signal.SIGINT)
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)


def simulation(gm: Any, y: Any) -> rebound.Simulation:
    """Build a REBOUND simulation with G = 1, in the frame of the centre of mass.

    `gm` (N,) are the masses, all positive, and `y` (6 N,) is the state (q, v), positions of all bodies and then
    velocities, in the same units. A ValueError is raised for other values.
    """
    gm, y = real_array("gm", gm), real_array("y", y)
    if gm.ndim != 1 or gm.size < 2:
        raise ValueError(f"gm must hold at least two bodies in one dimension, got shape {gm.shape}")
    if y.shape != (6 * gm.size,):
        raise ValueError(f"the state of {gm.size} bodies has shape ({6 * gm.size},), got {y.shape}")
    if not (np.isfinite(gm).all() and np.isfinite(y).all()):
        raise ValueError("gm and the state must be finite")
    if not (gm > 0).all():
        raise ValueError(f"gm must be positive (test particles are not supported), got {gm.min()!r}")
    sim = _new(gm, y)
    sim.move_to_com()
    return sim


def megno(gm: Any, y: Any, *, t_end: float, dt: float, seed: int = 1) -> tuple[float, float, np.ndarray]:
    """Compute the chaos indicator MEGNO by WHFast and REBOUND's variational particles.

    `gm` and `y` are as for `simulation`. The run from t = 0 to `t_end` has steps `dt`, and `seed` is that of the random
    tangent vector. Return the mean MEGNO at the end, its slope against t, which is half of the largest Lyapunov
    exponent, and the tangent vector (6 N,) at the start.
    """
    sim = simulation(gm, y)
    n = sim.N
    sim.integrator, sim.dt = "whfast", dt
    sim.init_megno(seed=seed)
    # Version 4 stores the variational particles after the others.
    varied = list(sim.particles_var) if hasattr(sim, "particles_var") else list(sim.particles)[n:]
    deviation = np.array([*(p.xyz for p in varied), *(p.vxyz for p in varied)]).ravel()
    with keep_ctrl_c():
        sim.integrate(t_end)
    return float(sim.megno()), float(sim.lyapunov()), deviation


def run(
    gm: Any,
    y0: Any,
    integrator: str,
    *,
    h: float,
    n_steps: int | None = None,
    t_end: float | None = None,
    save_every: int | None = None,
    prepare: Callable[[rebound.Simulation], Any] | None = None,
) -> OptimizeResult:
    """Integrate N bodies forward from t = 0 with one of REBOUND's integrators.

    Parameters
    ----------
    gm, y0 : array_like
        As for `simulation`; for "whfast" and "saba" the central body (the Sun) first.
    integrator : str
        "whfast" (Jacobi coordinates, no corrector), "whfast-c17" (symplectic corrector of order 17), "saba(10,6,4)",
        "leapfrog" (Störmer-Verlet, drift-kick-drift), or "ias15" (adaptive, order 15).
    h : float
        Length of a step. "ias15" chooses its steps itself and ends one on each saved time k h exactly.
    n_steps, t_end : int, float, optional
        One of the two: the number of steps, or the end, a whole number of steps from 0. Steps are counted: REBOUND's
        clock accumulates rounding errors, which at 1000 years exceed WHFast's own error.
    save_every : int, optional
        Save every `save_every`-th state in addition to the first and the last; default: only these two. It changes
        nothing but round-off of "ias15", of which a saved time cuts a step.
    prepare : callable, optional
        ``prepare(simulation)`` before the run, for example to set IAS15's tolerance (in version 5
        ``simulation.integrator.epsilon``) or to add forces by REBOUNDx; what it returns is kept alive.

    Returns
    -------
    OptimizeResult
        Saved times ``t`` (m,), states ``y`` (6 N, m), ``gm``, ``wall_time`` without reading states, ``steps``
        (accepted ones), ``name``, ``version`` of REBOUND, and ``energy_error`` and ``angular_momentum_error`` (m,),
        relative to the Newtonian values at the start if these are not 0.

    References
    ----------
    H. Rein, D. Tamayo, WHFast, MNRAS 452 (2015) 376-388; H. Rein, D. S. Spiegel, IAS15, MNRAS 446 (2015) 1424-1437;
    H. Rein, D. Tamayo, G. Brown, High-order symplectic integrators for planetary dynamics, MNRAS 489 (2019) 4632-4640.
    """
    sim = simulation(gm, y0)
    if integrator not in INTEGRATORS:
        raise ValueError(f"unknown integrator {integrator!r}: expected one of {', '.join(map(repr, INTEGRATORS))}")
    family, options = _SETTINGS[integrator]
    sim.integrator = family
    if options and _masses(sim).argmax() != 0:
        text = f"{integrator} follows orbits around body 0, which is not the heaviest"
        raise ValueError(f"{text}; put the heaviest body (the Sun) first")
    own = getattr(sim, f"ri_{family}", sim.integrator)  # version 4 keeps the options in Simulation.ri_<name>
    for key, value in options.items():
        setattr(own, key, value)
    saved = saved_steps(_count_steps(h, n_steps, t_end), 0 if save_every is None else count("save_every", save_every))
    _kept = None if prepare is None else prepare(sim)  # until the end of the run
    if integrator != "ias15":
        sim.dt = h
    rows, wall_time = [(_state(sim), [sim.energy()], sim.angular_momentum())], 0.0
    for first, last in pairwise(saved.tolist()):
        start = perf_counter()
        if integrator == "ias15":
            with keep_ctrl_c():
                sim.integrate(last * h, exact_finish_time=1)
        else:
            for done in range(first, last, _CHUNK):
                sim.steps(min(_CHUNK, last - done))
        sim.synchronize()
        wall_time += perf_counter() - start
        rows.append((_state(sim), [sim.energy()], sim.angular_momentum()))
    y, *conserved = map(np.array, zip(*rows, strict=True))
    errors = [np.linalg.norm(values - values[0], axis=1) / (np.linalg.norm(values[0]) or 1.0) for values in conserved]
    more = {"name": integrator, "version": rebound.__version__, "wall_time": wall_time, "steps": int(sim.steps_done)}
    more |= {"energy_error": errors[0], "angular_momentum_error": errors[1]}
    return _result(saved * h, y, _masses(sim), f"{integrator} of REBOUND", **more)


def _count_steps(h: float, n_steps: int | None, t_end: float | None) -> int:
    for name, value in (("h", h), ("t_end", 1.0 if t_end is None else t_end)):
        if not (is_number(value, name) and 0 < value < math.inf):
            raise ValueError(f"{name} must be positive and finite, got {value!r}")
    if (n_steps is None) == (t_end is None):
        raise ValueError("give either n_steps or t_end, and not both")
    if t_end is None:
        return count("n_steps", n_steps)
    n_steps = round(t_end / h)
    # The looser bound is for long runs, in which the rounding of h alone moves t_end / h away from an integer.
    if n_steps < 1 or abs(t_end / h - n_steps) > max(1e-9, 8 * np.finfo(float).eps * n_steps):
        text = "expected a whole number of steps, because a shortened step would spoil a symplectic method"
        raise ValueError(f"t_end = {t_end!r} is {t_end / h!r} steps of h = {h!r}: {text}. Change h or t_end")
    return n_steps


def _result(t: Any, y: Any, gm: Any, message: str, names: Any = None, units: str = "", **own: Any) -> OptimizeResult:
    """Return a run of REBOUND as a result that `to_xarray`, `orbital_elements` and similar functions accept."""
    known = {"gm": gm, "component_names": component_names(gm.size, names), "units": units, "message": message}
    return OptimizeResult(t=np.array(t), y=np.array(y).T, success=True, status=0, **known, **own)


class _ExitEvent:
    """Terminal event of a distance that ends a simulation; its value is negative beyond the limit.

    Native runs call `jitted`. It is not the event itself, because Numba functions that are sent to other processes lose
    their attributes.
    """

    terminal, direction = True, -math.inf  # a limit, which also counts at the start

    def __init__(self, name: str, limit: float) -> None:
        self.__name__, self._limit = name, limit

    def __call__(self, t: float, y: np.ndarray, *_: Any) -> float:
        return float(_exit_function(self.__name__, self._limit)(t, y))

    @property
    def jitted(self) -> Any:
        return jitted(_exit_function(self.__name__, self._limit))


@cache  # so that it is compiled once
def _exit_function(name: str, limit: float) -> Any:
    # Loops, because Numba compiles reductions of arrays for seconds.
    def exit_max_distance(t: float, y: np.ndarray, *_: Any) -> float:
        largest = 0.0
        for k in range(0, y.size // 2, 3):
            largest = max(largest, y[k] ** 2 + y[k + 1] ** 2 + y[k + 2] ** 2)
        return limit - math.sqrt(largest)

    def exit_min_distance(t: float, y: np.ndarray, *_: Any) -> float:
        least = math.inf
        for k in range(0, y.size // 2, 3):
            for j in range(0, k, 3):
                least = min(least, (y[k] - y[j]) ** 2 + (y[k + 1] - y[j + 1]) ** 2 + (y[k + 2] - y[j + 2]) ** 2)
        return math.sqrt(least) - limit

    return compilable(exit_max_distance if name == "exit_max_distance" else exit_min_distance)


def _state(sim: rebound.Simulation) -> np.ndarray:
    """Return the state (q, v) of all particles, shape (6 N,)."""
    y = np.empty((2, sim.N, 3))
    sim.serialize_particle_data(xyz=y[0], vxvyvz=y[1])
    return y.ravel()


def _set_state(sim: rebound.Simulation, y: np.ndarray) -> None:
    """Set the state (q, v), shape (6 N,), of all particles."""
    q, v = np.ascontiguousarray(y, dtype=float).reshape(2, -1, 3)
    sim.set_serialized_particle_data(xyz=q, vxvyvz=v)


def _active(sim: rebound.Simulation) -> int:
    """Return the number of leading particles that attract the others."""
    # If all do, N_active is -1, or, in versions in which it is unsigned, larger than N.
    return int(sim.N_active) if 0 <= sim.N_active < sim.N else int(sim.N)


def _masses(sim: rebound.Simulation) -> np.ndarray:
    """Return the masses with which the particles attract the others."""
    masses = np.array([particle.m for particle in sim.particles][: sim.N], dtype=float)
    if sim.testparticle_type == 0:
        masses[_active(sim) :] = 0.0
    return masses


def _names(sim: rebound.Simulation) -> tuple[str, ...]:
    """Return the particles' names, with the index of a particle in place of a name that is missing or not unique."""
    given = [getattr(particle, "name", None) for particle in sim.particles][: sim.N]
    return tuple(name if name is not None and given.count(name) == 1 else str(k) for k, name in enumerate(given))


def _units(sim: rebound.Simulation) -> str:
    """Return the simulation's units of length and time in the form of `Problem.units`."""
    given = sim.units["length"], sim.units["time"]
    if None in given:
        return "as in the REBOUND simulation"
    parts = [(float(theirs[name]), ours, base) for name, (base, ours, theirs) in zip(given, _UNITS, strict=True)]
    return ", ".join(next((name for name in ours if ours[name] == si), f"{si!r} {base}") for si, ours, base in parts)


def _unit_names(problem: Problem) -> tuple[str, ...]:
    """Return REBOUND's names of the problem's units; () if it has none. The unit of mass follows from G, or is msun."""
    found: list[str] = []
    for part, (_, ours, theirs) in zip(problem.units.replace("Julian year", "yr").split(","), _UNITS, strict=False):
        number, _, name = part.strip().rpartition(" ")
        with suppress(KeyError, ValueError):  # which are not units
            si = float(number or 1) * (theirs | ours)[name]
            found += [name for name in theirs if math.isclose(theirs[name], si, rel_tol=1e-9)][:1]
    if len(found) < 2 or problem.G is None:
        return (*found, "msun") if len(found) == 2 else ()
    units = ((*found, mass) for mass in masses_SI)
    return next((names for names in units if math.isclose(convert_G(names), problem.G, rel_tol=1e-12)), ())


def _attached(sim: rebound.Simulation) -> tuple[tuple[str, ...], ForceConstants | None]:
    """Return the name that `nbody` has for the force that REBOUNDx has attached, and its constants."""
    if not sim._additional_forces:
        return (), None
    advice = "Name those that nbody has: forces='gr-potential', constants=ForceConstants(c=...), or () for none."
    if (extras := getattr(sim, "_extras_ref", None)) is None:
        raise ValueError(f"the simulation has additional forces that are not REBOUNDx's. {advice}")
    import reboundx

    attached, node = [], extras._additional_forces  # a list in C, because no function of REBOUNDx returns the forces
    while node:
        attached.append(ctypes.cast(node.contents.object, ctypes.POINTER(reboundx.Force)).contents)
        node = node.contents.next
    names = [force.name.decode() for force in attached]
    if len(names) > 1 or not set(names) <= _FORCES.keys():
        raise ValueError(f"REBOUNDx's forces {', '.join(names)}: expected one of {', '.join(_FORCES)}. {advice}")
    parameters: dict[str, Any] = {}
    for key, things in {"c": attached, "gr_source": sim.particles[1 : sim.N] if names else []}.items():
        for thing in things:
            with suppress(AttributeError):  # if it is not set
                parameters[key] = thing.params[key]
    if "gr_source" in parameters:
        raise ValueError(f"REBOUNDx's {names[0]}: its source (gr_source) must be the first particle.")
    return tuple(_FORCES[name] for name in names), ForceConstants(c=parameters.get("c"))


def _unsupported(sim: rebound.Simulation) -> Iterator[str]:
    """Yield what the simulation has and a problem of `nbody` cannot hold."""
    passive = [particle.m for particle in sim.particles][_active(sim) : sim.N]
    acting = sim.testparticle_type != 0 and len(passive) > 1 and any(passive)
    advice = "set their masses to 0, or testparticle_type to 0"
    found = {
        "variational particles: they are not bodies": sim.N_var > 0,
        f"{sim.N} particles: gravity needs at least two": sim.N < 2,
        f"test particles with masses that act on active ones only (testparticle_type 1): {advice}": acting,
        "modifications before or after a step": sim._pre_timestep_modifications or sim._post_timestep_modifications,
        "further differential equations": sim._N_odes > 0,
        "softened gravity: the problem's potential is 1/r": sim.softening != 0,
        f"gravity {sim.gravity!r}: the problem sums 1/r over all pairs": sim.gravity in ("none", "tree", "custom"),
        "collisions: they change the number of bodies or the invariants": sim.collision != "none",
        "boundaries or a shearing sheet": sim.boundary != "none" or str(sim.integrator) == "sei",
    }
    return (what for what, present in found.items() if present)


def _chosen(run: Any, problem: Problem, y: Any, row: int | None, t: float | None) -> tuple[float, np.ndarray]:
    """Return the time and the state that the arguments of `to_simulation` select."""
    is_run = run is not problem
    times, states = (run.t, run.y) if is_run else (problem.t_span[:1], problem.y0[:, None])
    if row is not None and (y is not None or not is_run):
        raise ValueError("to_simulation: row selects a state of a run, in place of y. Give y or row, not both.")
    k = -1 if row is None else row
    if not -len(times) <= k < len(times):
        raise ValueError(f"to_simulation: no row {row}, the run has {len(times)} saved states.")
    if y is not None:
        y, n = real_array("y", y), problem.y0.size
        if y.shape != (n,):
            raise ValueError(f"to_simulation: y has the shape {y.shape}; expected ({n},) for {n // 6} bodies.")
        equal = (states == y[:, None]).all(axis=0)
        if is_run and t is None and not equal.any():
            raise ValueError("to_simulation: y is not a saved state of the run. Give its time: t=...")
        k = int(np.argmax(equal))
    return float(times[k] if t is None else t), states[:, k] if y is None else y


def _new(
    gm: np.ndarray, y: np.ndarray, names: Sequence[str] = (), G: float | None = None, units: tuple[str, ...] = ()
) -> rebound.Simulation:
    """Return a simulation of bodies; those whose name is their number remain without a name."""
    sim = rebound.Simulation()
    if units:
        sim.units = units
    if G is not None:
        sim.G = G
    label = "name" if hasattr(rebound.Particle, "name") else "hash"
    for k, (m, name) in enumerate(zip_longest((gm / sim.G).tolist(), names)):
        sim.add(m=m, **({} if name in (None, str(k)) else {label: name}))
    if gm[-1] == 0:
        sim.N_active = int(np.flatnonzero(gm)[-1]) + 1
    _set_state(sim, y)
    return sim


def _like(template: rebound.Simulation, gm: np.ndarray) -> rebound.Simulation:
    """Return a copy of the template, after checking that its G times the masses are `gm`."""
    if not isinstance(template, rebound.Simulation):
        raise TypeError(f"to_simulation: template must be a rebound.Simulation, got {shown(template)}.")
    own = template.G * _masses(template)
    # They are equal up to the rounding of one product and one quotient.
    if own.shape != gm.shape or not np.allclose(own, gm, rtol=1e-15, atol=0):
        text = f"its G times the masses are {shown(own)}, those of the problem {shown(gm)}"
        raise ValueError(f"to_simulation: the template has other bodies: {text}.")
    return template.copy()
