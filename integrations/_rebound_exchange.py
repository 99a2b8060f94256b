"""Conversion of problems and runs from and to REBOUND's simulations and archives; public in `integrations.rebound`."""

from __future__ import annotations

import ctypes
import math
import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import rebound
from rebound import units as rebound_units
from scipy.optimize import OptimizeResult

from eip_scipy.core.inputs import count, real_array, shown
from eip_scipy.problems.gravity.bodies import Bodies, bodies_of
from eip_scipy.problems.gravity.forces import ForceConstants, check_forces
from eip_scipy.problems.gravity.nbody import component_names, nbody

if TYPE_CHECKING:
    from eip_scipy.core.problem import Problem

# REBOUNDx's forces, by our names.
REBOUNDX = {"gr": "1pn", "gr_full": "eih", "gr_potential": "gr-potential"}
OURS = {ours: theirs for theirs, ours in REBOUNDX.items()} | {"j2": "gravitational_harmonics"}
MAGIC = b"REBOUND Binary File"
UNKNOWN_UNITS = "as in the REBOUND simulation"
UNSUPPORTED = "the simulation has a feature that an N-body problem of eip_scipy does not support"
# Units of `Problem.units` in m and s.
METRES = {"AU": 149597870700.0, "au": 149597870700.0, "m": 1.0, "cm": 0.01, "km": 1e3, "pc": 3.085677581491367e16}
YEAR = 365.25 * 86400.0
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "day": 86400.0, "yr": YEAR, "kyr": 1e3 * YEAR}
SECONDS |= {"Myr": 1e6 * YEAR, "Gyr": 1e9 * YEAR}
# G times a template's mass equals our G m up to the rounding of one product and one quotient.
SAME = 1e-15


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
    """Build an N-body problem from a REBOUND simulation, at its present state.

    Parameters
    ----------
    sim : rebound.Simulation
        Point masses under their mutual gravity. It is synchronised, as before any reading of a simulation.
    t_span : tuple of float, optional
        Start, which is sim.t, and end; default: from sim.t over 1000 steps sim.dt.
    h : float, optional
        A sensible fixed step; default: the magnitude of sim.dt.
    forces : str or sequence of str, optional
        The simulation's additional forces, by the names that `nbody` has for them; () if none of them matters.
        Default: the forces that REBOUNDx has attached, if they are known: "gr" (here "1pn"), "gr_full" ("eih") and
        "gr_potential" ("gr-potential").
    constants : ForceConstants, optional
        As for `nbody`, with `forces`.
    names : sequence of str, optional
        Names of the bodies; default: those of the particles (REBOUND 5), and numbers for others. Snapshots of an
        archive after the first may have lost them.
    balances : str or sequence of str, optional
        As for `nbody`: "kepler" keeps the energy of each orbit in place of the totals.

    Returns
    -------
    Problem
        In the simulation's units of length and time, with params = sim.G times the masses, and `G`. Test particles have
        mass 0. The distances exit_max_distance and exit_min_distance are terminal `events` of the problem.

    Raises
    ------
    TypeError
        If `sim` is not a simulation, for example the path of an archive.
    ValueError
        If `t_span` does not start at the time of the state, if `constants` are given without `forces`, or if the
        simulation has features that the N-body problem lacks (variational particles, softening, forces that are not
        known, collisions, boundaries ...): the message says which and why it is not supported.

    Warns
    -----
    UserWarning
        If the simulation has a heartbeat, which a problem cannot hold.

    Notes
    -----
    Particles from ``sim.N_active`` on attract nothing if ``sim.testparticle_type`` is 0: their masses are dropped,
    which does not change the motion. With 1 they act on the active particles but not on each other. Two or more such
    particles are then accepted only if their masses are 0, because otherwise the energy and the angular momentum are
    those of another system.

    "gr" of REBOUNDx uses positions and velocities in Jacobi coordinates, "1pn" those relative to the Sun. The two
    differ in the planets' masses, by a part in a thousand of the effect.
    """
    if not isinstance(sim, rebound.Simulation):
        raise TypeError(
            f"problem_from_simulation: expected a rebound.Simulation, got {sim!r}; "
            "read one from an archive by rebound.Simulation(path)"
        )
    _refuse_unsupported(sim)
    if sim._heartbeat:
        warnings.warn(
            "problem_from_simulation: the simulation's heartbeat is not called by runs of the problem. If it ends the "
            "simulation or changes particles, give integrate events=... or callback=... in its place.",
            UserWarning,
            stacklevel=2,
        )
    chosen, known = (check_forces(forces), constants) if forces is not None else _attached(sim)
    if forces is None and constants is not None:
        raise ValueError(
            "problem_from_simulation: constants= needs forces=..., the forces to which they belong. Give both, or omit "
            "constants: forces that REBOUNDx has attached have their own."
        )
    if t_span is not None and isinstance(t_span[0], int | float) and t_span[0] != sim.t:
        raise ValueError(
            f"problem_from_simulation: t_span starts at {t_span[0]:.10g}, but the state is that of t={sim.t:.10g}. "
            f"Give t_span=({sim.t:.10g}, ...), or set sim.t = {t_span[0]:.10g}."
        )
    sim.synchronize()
    q, v = state(sim).reshape(2, -1, 3)
    problem = nbody(
        _attracting_masses(sim),
        q,
        v,
        t_span=(sim.t, sim.t + 1000 * sim.dt) if t_span is None else t_span,
        h=abs(sim.dt) if h is None else h,
        forces=chosen,
        constants=known,
        name="rebound",
        units=_units(sim),
        source=f"REBOUND {rebound.__version__} simulation of {sim.N} bodies at t = {sim.t!r}",
        bodies=_names(sim) if names is None else names,
        G=sim.G,
        balances=balances,
    )
    return replace(problem, events=exit_events(sim) or None)


class _Exit:
    """Terminal event at the distance `name` that ends a simulation: a limit, beyond which its value is negative."""

    terminal, direction = True, -math.inf

    def __init__(self, name: str, limit: float) -> None:
        self.__name__, self._limit = name, limit

    def __call__(self, t: float, y: np.ndarray, *args: Any) -> float:
        q = np.asarray(y)[: len(y) // 2].reshape(-1, 3)
        if self.__name__ == "exit_max_distance":
            return self._limit - float(np.linalg.norm(q, axis=1).max())
        pairs = (np.linalg.norm(q[k + 1 :] - q[k], axis=1).min() for k in range(len(q) - 1))
        return float(min(pairs)) - self._limit


def exit_events(sim: rebound.Simulation) -> list[_Exit]:
    """Return terminal events for the distances at which a simulation ends.

    Parameters
    ----------
    sim : rebound.Simulation

    Returns
    -------
    list of callable
        The events that `problem_from_simulation` sets, to be combined with further events: one for a particle whose
        distance from the origin reaches ``sim.exit_max_distance``, and one for two particles that come as near as
        ``sim.exit_min_distance``, if these are set. REBOUND checks the distances after each step, while an event is
        located within the step. If a distance is exceeded at the start, the run ends there.
    """
    given = {name: float(getattr(sim, name)) for name in ("exit_max_distance", "exit_min_distance")}
    return [_Exit(name, limit) for name, limit in given.items() if limit > 0]


def to_simulation(
    run: Any,
    y: Any = None,
    *,
    row: int | None = None,
    t: float | None = None,
    template: rebound.Simulation | None = None,
) -> rebound.Simulation:
    """Build a REBOUND simulation from a problem of bodies or a row of its run.

    Parameters
    ----------
    run : Problem or IntegrationResult
        A problem by `nbody`, `solar_system`, `problem_from_simulation` and the like, or a run of one by `integrate`.
    y : array_like, shape (6 N,), optional
        The state (q, v); default: the start of a problem, the `row` of a run.
    row : int, optional
        Index of a saved state of the run; default: -1, the last one.
    t : float, optional
        The simulation's time; default: that of the row, or the start of the problem. If `y` is a state of a run, the
        default is the time of the row that equals it.
    template : rebound.Simulation, optional
        A simulation of the same bodies. The result is a copy of it with the state and the time set; it keeps the
        template's integrator, step, units, names, radii, and masses of test particles.

    Returns
    -------
    rebound.Simulation
        A simulation whose particles have the bodies' names (REBOUND 5; hashes before). Without a `template`, G and the
        masses are those of the simulation that the problem came from, if it came from one. For other problems masses
        are in solar masses if REBOUND knows the problem's units, and otherwise G is 1 and masses are G m. ``N_active``
        excludes trailing bodies without mass. The centre of mass is not moved.

    Raises
    ------
    TypeError
        If `run` is neither a problem of bodies nor a run of one.
    ValueError
        If shapes or masses do not fit, or there is no such row.

    Warns
    -----
    UserWarning
        If the problem has forces other than Newton's, which a simulation gets from REBOUNDx only: attach them there.
    """
    bodies = bodies_of(run)
    at, start = _chosen(run, bodies, y, row, t)
    if bodies.forces and template is None:
        theirs = ", ".join(f"{name} (REBOUNDx: {OURS.get(name, 'none')})" for name in bodies.forces)
        warnings.warn(
            f"to_simulation: the simulation has Newton's gravitation only, but the problem also has {theirs}. If a run "
            "needs these forces, attach them to the simulation by REBOUNDx.",
            UserWarning,
            stacklevel=2,
        )
    sim = _new(bodies) if template is None else _like(template, bodies)
    sim.t = at
    _set_state(sim, start)
    return sim


def to_archive(run: Any, path: str | os.PathLike[str], *, template: rebound.Simulation | None = None) -> None:
    """Write the saved states of a run as the snapshots of a REBOUND Simulationarchive.

    Parameters
    ----------
    run : IntegrationResult
        A run of a problem of bodies. All saved states are written: choose them by `save_every` or `t_eval`.
    path : path-like
        A new file; an existing one is not replaced.
    template : rebound.Simulation, optional
        As for `to_simulation`.

    Raises
    ------
    FileExistsError
        If `path` exists.
    TypeError, ValueError
        As for `to_simulation`.

    Notes
    -----
    ``rebound.Simulationarchive(path)[k]`` is row k, from which REBOUND can continue; `read_archive` reads all of them
    at once.
    """
    place = os.fspath(path)
    if os.path.lexists(place):
        raise FileExistsError(f"to_archive: {place} is there already, and REBOUND would append to it. Give a new path.")
    if not (hasattr(run, "t") and hasattr(run, "y")):
        raise TypeError(f"to_archive: expected a run by integrate, got {shown(run)}.")
    sim = to_simulation(run, row=0, template=template)
    for t, y in zip(run.t, run.y.T, strict=True):
        sim.t = t
        _set_state(sim, y)
        sim.save_to_file(place)


def read_archive(path: str | os.PathLike[str], *, every: int = 1, names: Sequence[str] | None = None) -> OptimizeResult:
    """Read the snapshots of a REBOUND Simulationarchive as one run.

    Parameters
    ----------
    path : path-like
    every : int, optional
        Read every `every`-th snapshot.
    names : sequence of str, optional
        Names of the bodies; default: those of the particles in the first snapshot (REBOUND 5), or their numbers.

    Returns
    -------
    OptimizeResult
        Times ``t`` (m,), states (q, v) ``y`` (6 N, m), ``gm`` (N,), ``component_names``, ``units`` and ``message``;
        `eip_scipy.results.to_xarray`, `eip_scipy.results.plot`, `orbital_elements` and similar functions accept it. One
        snapshot with all of its settings is ``rebound.Simulation(path, snapshot=k)``, which `problem_from_simulation`
        takes.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If REBOUND cannot read it, or if bodies or masses change from one snapshot to another.
    """
    place, every = os.fspath(path), count("every", every)
    if not os.path.isfile(place):
        raise FileNotFoundError(f"read_archive: no file at {place}")
    with open(place, "rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError(f"read_archive: {place} is not an archive of REBOUND.")
    times, states = [], []
    with warnings.catch_warnings():
        # A file never contains functions of a simulation, and nothing is integrated here.
        warnings.filterwarnings("ignore", "You have to reset function pointers", RuntimeWarning)
        try:
            archive = rebound.Simulationarchive(place)
        except RuntimeError as error:
            raise ValueError(f"read_archive: REBOUND cannot read {place}: {error}") from error
        first = _first_snapshot(archive)
        gm = first.G * _attracting_masses(first)
        for k in range(0, len(archive), every):
            sim = archive[k]
            sim.synchronize()
            if not np.array_equal(sim.G * _attracting_masses(sim), gm):
                raise ValueError(
                    f"read_archive: bodies or masses in snapshot {k} of {place} differ from those in the first one. "
                    "Read single snapshots by rebound.Simulation(path, snapshot=k)."
                )
            times.append(sim.t)
            states.append(state(sim))
    return OptimizeResult(
        t=np.array(times),
        y=np.array(states).T,
        gm=gm,
        component_names=component_names(gm.size, _names(first) if names is None else names),
        units=_units(first),
        message=f"{len(times)} snapshots of a REBOUND archive",
        success=True,
        status=0,
    )


def state(sim: rebound.Simulation) -> np.ndarray:
    """Return the state (q, v) of all particles, shape (6 N,)."""
    y = np.empty((2, sim.N, 3))
    sim.serialize_particle_data(xyz=y[0], vxvyvz=y[1])
    return y.ravel()


def _set_state(sim: rebound.Simulation, y: np.ndarray) -> None:
    q, v = np.ascontiguousarray(y, dtype=float).reshape(2, -1, 3)
    sim.set_serialized_particle_data(xyz=q, vxvyvz=v)


def _active(sim: rebound.Simulation) -> int:
    """Return the number of leading particles that attract the others."""
    # If all do, N_active is -1, or, in versions in which it is unsigned, larger than N.
    return int(sim.N_active) if 0 <= sim.N_active < sim.N else int(sim.N)


def _attracting_masses(sim: rebound.Simulation) -> np.ndarray:
    masses = np.array([particle.m for particle in sim.particles][: sim.N], dtype=float)
    if sim.testparticle_type == 0:
        masses[_active(sim) :] = 0.0
    return masses


def _names(sim: rebound.Simulation) -> tuple[str, ...]:
    """Return the particles' names, with the index of a particle in place of a name that is missing or not unique."""
    given = [getattr(particle, "name", None) for particle in sim.particles][: sim.N]
    return tuple(name if name is not None and given.count(name) == 1 else str(k) for k, name in enumerate(given))


def _first_snapshot(archive: rebound.Simulationarchive) -> rebound.Simulation:
    """Return the first snapshot, which is read until no name occurs twice, at most four times.

    REBOUND 5.2 identifies names by their memory addresses in the process that wrote the archive, and mixes up two names
    if one is read to the old address of the other. Each copy is kept, so that the next one gets other addresses.
    """
    held = [archive[0]]
    while len(held) < 4:
        named = [name for particle in held[-1].particles if (name := getattr(particle, "name", None)) is not None]
        if len(set(named)) == len(named):
            break
        held.append(archive[0])
    return held[-1]


def _units(sim: rebound.Simulation) -> str:
    """Return the simulation's units of length and time in the form of `Problem.units`."""
    names = sim.units
    if names["length"] is None or names["time"] is None:
        return UNKNOWN_UNITS
    length, time = float(rebound_units.lengths_SI[names["length"]]), float(rebound_units.times_SI[names["time"]])
    parts = (length, METRES, "m"), (time, SECONDS, "s")
    return ", ".join(next((n for n, own in known.items() if own == si), f"{si!r} {base}") for si, known, base in parts)


def _in_si(text: str) -> list[float]:
    """Return the units of length and time in a text such as "AU, yr" or "km, 5022642.9 s", in m and s, or []."""
    parts, found = text.replace("Julian year", "yr").split(","), []
    for part, known in zip(parts, (METRES, SECONDS), strict=False):
        number, _, name = part.strip().rpartition(" ")
        try:
            found.append(float(number or 1) * known[name])
        except (KeyError, ValueError):
            return []
    return found if len(parts) == 2 else []


def _attached(sim: rebound.Simulation) -> tuple[tuple[str, ...], ForceConstants | None]:
    """Return the names that `nbody` has for the forces that REBOUNDx has attached, and their constants, or None."""
    if not sim._additional_forces:
        return (), None
    extras = getattr(sim, "_extras_ref", None)
    if extras is None:
        raise ValueError(
            f"{UNSUPPORTED}: additional forces that are not REBOUNDx's, whose invariants are unknown. If nbody has "
            "these forces, name them: forces='gr-potential', constants=ForceConstants(c=...); forces=() leaves them "
            "out."
        )
    names = _force_names(extras)
    if len(names) > 1 or not set(names) <= REBOUNDX.keys():
        raise ValueError(
            f"{UNSUPPORTED}: REBOUNDx's additional forces {', '.join(names)}; expected one of {', '.join(REBOUNDX)}. "
            "Give forces=... to replace them."
        )
    if not names:
        return (), None

    def parameter(thing: Any, name: str) -> Any:  # of a particle or a force; None if it is not set
        with suppress(AttributeError):
            return thing.params[name]

    for k in range(1, sim.N):
        if parameter(sim.particles[k], "gr_source") is not None:
            raise ValueError(
                f"REBOUNDx's {names[0]}: particle {k} is its source (gr_source); only the first particle is supported "
                "as a source. Make the source the first particle."
            )
    return (REBOUNDX[names[0]],), ForceConstants(c=parameter(extras.get_force(names[0]), "c"))


def _force_names(extras: Any) -> list[str]:
    """Return the names of the forces that are attached to a simulation by `extras`, its `reboundx.Extras` object."""
    import reboundx

    names, node = [], extras._additional_forces  # a list in C, because no function of REBOUNDx returns the names
    while node:
        force = ctypes.cast(node.contents.object, ctypes.POINTER(reboundx.Force)).contents
        names.append(force.name.decode())
        node = node.contents.next
    return names


def _chosen(run: Any, bodies: Bodies, y: Any, row: int | None, t: float | None) -> tuple[float, np.ndarray]:
    """Return the time and the state that the arguments of `to_simulation` select."""
    problem = bodies.problem
    rows = 0 if run is problem else len(run.t)
    if row is not None and y is not None:
        raise ValueError("to_simulation: give y or row, not both.")
    if row is not None and run is problem:
        raise ValueError("to_simulation: row selects a state of a run, but a problem has only its start; omit row.")
    if row is not None and not -rows <= row < rows:
        raise ValueError(f"to_simulation: no row {row}, the run has {rows} saved states.")
    k: Any = -1 if row is None else row
    if y is None:
        y = problem.y0 if run is problem else run.y[:, k]
    elif t is None and run is not problem:
        equal = (run.y == np.reshape(y, (-1, 1))).all(axis=0)
        if not equal.any():
            raise ValueError("to_simulation: y is not a saved state of the run. Give its time: t=...")
        k = np.argmax(equal)
    if t is None:
        t = problem.t_span[0] if run is problem else run.t[k]
    y, n = real_array("y", y), bodies.gm.size
    if y.shape != (6 * n,):
        raise ValueError(f"to_simulation: y has the shape {y.shape}; expected ({6 * n},) for {n} bodies.")
    return float(t), y


def _new(bodies: Bodies) -> rebound.Simulation:
    """Return a simulation of particles with the masses and names of the bodies, all at rest in the origin."""
    sim, n = rebound.Simulation(), bodies.gm.size
    G = bodies.problem.G
    if names := _rebound_units(bodies.problem, G):
        sim.units = names
    if G is not None:
        sim.G = G
    labels = bodies.names if len(bodies.names) == n else tuple(map(str, range(n)))
    label = "name" if hasattr(rebound.Particle, "name") else "hash"
    for k, (m, name) in enumerate(zip((bodies.gm / sim.G).tolist(), labels, strict=True)):
        sim.add(m=m, **({} if name == str(k) else {label: name}))
    if bodies.gm[-1] == 0:
        sim.N_active = int(np.flatnonzero(bodies.gm)[-1]) + 1
    return sim


def _rebound_units(problem: Problem, G: float | None) -> tuple[str, str, str] | None:
    """Return REBOUND's names of the problem's units of length and time, and of a unit of mass.

    The unit of mass is one in which the gravitational constant has the value `G`, and "msun" if `G` is None. Return
    None if the problem has no units of length and time, or if REBOUND has no name for one of the three units.
    """
    tables, found = (rebound_units.lengths_SI, rebound_units.times_SI), []
    for table, unit in zip(tables, _in_si(problem.units), strict=False):
        found += [name for name, si in table.items() if math.isclose(si, unit, rel_tol=1e-9)][:1]
    if len(found) < 2:
        return None
    length, time = found
    for mass in ["msun"] if G is None else rebound_units.masses_SI:
        if G is None or math.isclose(rebound_units.convert_G((length, time, mass)), G, rel_tol=1e-12):
            return length, time, mass
    return None


def _like(template: rebound.Simulation, bodies: Bodies) -> rebound.Simulation:
    """Return a copy of the template, after checking that its G times the masses equal those of the bodies."""
    if not isinstance(template, rebound.Simulation):
        raise TypeError(f"to_simulation: template must be a rebound.Simulation, got {shown(template)}.")
    own = template.G * _attracting_masses(template)
    if own.shape != bodies.gm.shape or not np.allclose(own, bodies.gm, rtol=SAME, atol=0):
        raise ValueError(
            f"to_simulation: the template has other bodies: its G times the masses are {shown(own)}, those of the "
            f"problem {shown(bodies.gm)}. Give a template with the bodies of the problem, or omit template."
        )
    return template.copy()


def _refuse_unsupported(sim: rebound.Simulation) -> None:
    passive = [particle.m for particle in sim.particles][_active(sim) : sim.N]
    obstacles = (
        (sim.N_var > 0, "variational particles: they are not bodies, and our state cannot hold them"),
        (sim.N < 2, f"{sim.N} particles: gravity needs at least two"),
        (
            sim.testparticle_type != 0 and len(passive) > 1 and any(passive),
            "test particles with masses that act on active ones and not on each other (testparticle_type 1): the "
            "invariants are those of another system. Set their masses to 0, or testparticle_type to 0",
        ),
        (
            any(map(bool, (sim._pre_timestep_modifications, sim._post_timestep_modifications))),
            "modifications before or after a step: the invariants of the modified motion are unknown",
        ),
        (sim._N_odes > 0, "further differential equations: our state has no place for them"),
        (sim.softening != 0, "softened gravity: the problem's potential is 1/r"),
        (sim.gravity in ("none", "tree", "custom"), f"gravity {sim.gravity!r}: the problem sums 1/r over all pairs"),
        (sim.collision != "none", "collisions: they change the number of bodies or the invariants"),
        (
            sim.boundary != "none" or str(sim.integrator) == "sei",
            "boundaries or a shearing sheet: the problem's space is open and inertial",
        ),
    )
    for present, what in obstacles:
        if present:
            raise ValueError(f"{UNSUPPORTED}: {what}")
