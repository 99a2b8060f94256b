"""Point masses: Newton's gravitation, and further forces by name."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...core.inputs import is_number, real_array, shown
from ...core.problem import Problem, bind
from ...core.step_control import interval
from ...engine.native import library
from . import forces as _forces
from .approaches import approaches, check_distances
from .bodies import ENTRIES, BodiesProblem, component_names
from .forces import ForceConstants
from .frequencies import orbital_frequencies
from .orbits import balances_of_orbits

__all__ = ["centre_of_mass", "component_names", "nbody"]

# If the relative speeds of all bodies, in units of the escape speed, are beyond these bounds, a warning says that the
# units may be wrong. AU/day in place of AU/yr is a factor of 365; a close flyby reaches 30, and an orbit of
# eccentricity 0.9999 has 1/140 in its apocentre.
TOO_FAST, TOO_SLOW = 80.0, 1 / 150


def nbody(
    gm: Any,
    position: Any,
    velocity: Any,
    *,
    t_span: tuple[float, float],
    h: float | None = None,
    forces: str | Sequence[str] = (),
    constants: ForceConstants | None = None,
    name: str = "nbody",
    units: str = "",
    source: str = "",
    reference: Callable[[float], np.ndarray | None] | None = None,
    bodies: Sequence[str] | None = None,
    epoch: tuple[float, float] | None = None,
    G: float | None = None,
    balances: str | Sequence[str] | None = None,
    encounters: Any = None,
) -> Problem:
    """Return the problem of N point masses under Newton's gravitation, with optional further forces.

    Parameters
    ----------
    gm : array_like, shape (N,)
        G times the masses, in the units of length and time of the state; if `G` is given, the masses. 0 stands for a
        test particle, which is attracted and does not attract.
    position, velocity : array_like, shape (N, 3)
        Initial state. `eip_scipy.integrations.astropy.nbody` accepts quantities of astropy.
    t_span : (float, float)
        Start and end of the run.
    h : float, optional
        Step length.
    forces : str or sequence of str, optional
        Forces in addition to Newton's gravitation: at most one of "1pn", "eih" and "gr-potential", and "j2",
        "j4", "moon-quadrupole", "drag" and "radiation". All act from the first body (the Sun) except "eih". The page
        :doc:`/reference/forces` describes them.
    constants : ForceConstants, optional
        The speed of light and the other constants of the forces, in the units of the state.
    name, source, units, reference, epoch : optional
        See `Problem`; `units` are those of length and time, such as "AU, yr".
    bodies : sequence of str, optional
        Names of the bodies, which become part of the components' names: x_Sun, y_Sun, ... Default: x_0, y_0, ...
    G : float, optional
        The constant of gravitation. If it is given, the first argument holds the masses, which are multiplied by it:
        ``nbody([1, 1e-6], ..., G=4 * np.pi**2)`` in AU, years and solar masses. `Problem.G` stores it, so that a
        simulation of REBOUND gets the same masses.
    balances : str or sequence of str, optional
        Keep quantities that each orbit would conserve without the pulls of other bodies, as `Balance` objects, instead
        of the total energy and angular momentum: "kepler" or "energy", "momentum", "laplace", see `orbital_balances`.
        They are made for planetary systems without close encounters over long times, and hold the masses given here: a
        run with other `params` is reported as not to be trusted.
    encounters : float or array_like, shape (N,), optional
        Find the closest approaches of all pairs of bodies below this distance, or below the sum of their radii, one of
        each body. Runs have them as `run.encounters`, an array (m, 5) with the columns t, i, j, distance and relative
        speed. They are events of the problem: a run with events of its own takes them as ``events=[mine,
        *problem.events]``. The times of all smallest and largest distances are in `run.t_events`.

    Returns
    -------
    Problem
        State (q_1, ..., q_N, v_1, ..., v_N), each with 3 components. Without `forces` and `balances` the invariants are
        "H", the energy times G, and "L", the angular momentum times G. Momentum and centre of mass are
        `linear_invariants`; `blocks` are the bodies' positions and velocities.

    Raises
    ------
    ValueError
        If shapes disagree, a mass is negative, all masses are 0, two bodies have the same position, `G` is not
        positive, or a force is unknown.

    Warns
    -----
    UserWarning
        If all relative speeds are far from orbital speeds, which suggests inconsistent units.

    See Also
    --------
    ForceConstants, orbital_balances, orbital_elements, solar_system, transits

    Notes
    -----
    The invariants do not depend on test particles: their gradients are 0 there, and no correction moves test particles.

    With further forces the problem has those invariants that its equations conserve; the page lists them. Newton's
    momentum and centre of mass are exact invariants of all forces except "eih", whose momentum has further terms in
    1/c^2 (there the frame only keeps corrections from moving the centre of mass), and "radiation" on a body that has a
    mass. With "1pn", "eih", "drag" and "radiation" the accelerations depend on velocities: `acc` is None, and Nystrom
    methods do not apply.

    From 128 bodies on the sums over pairs use several threads: as many as the environment variable ``OMP_NUM_THREADS``
    says when the first run begins, or else as many as there are processors, up to 16; 1 turns that off. The results
    have the same bits for any number of threads. Members of an ensemble that run at the same time, and processes of
    `multiprocessing` without that variable, use one thread each.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPRKN12, integrate
    >>> from eip_scipy.problems import nbody
    >>> gm, a = np.array([4 * np.pi**2, 0.04]), np.array([0.0, 1.0])  # AU and years
    >>> position, velocity = np.outer(a, [1, 0, 0]), np.outer(a, [0, 2 * np.pi, 0])
    >>> run = integrate(nbody(gm, position, velocity, t_span=(0, 10), h=0.02), method=EIPRKN12)
    >>> run.trusted, bool(run.diagnostics.max_residual.max() < 1e-12)
    (True, True)
    """
    masses, q, v = _masses(gm, G), real_array("position", position), real_array("velocity", velocity)
    _check_bodies(masses, q, v)
    chosen = _forces.check_forces(forces)
    y0, params = np.concatenate([q.ravel(), v.ravel()]), _forces.parameters(masses, chosen, constants)
    rhs, acc = _forces.equations(chosen)
    names = component_names(masses.size, bodies)
    labels = tuple(name[2:] for name in names[: q.size : 3])
    if balances is None:  # the recoil from the correction of a planet goes to its star
        kept, shifts = _forces.invariants(chosen, params, y0), masses / masses.sum()
    else:  # shifting all bodies by the same distance changes no orbit
        kept, shifts = balances_of_orbits(masses, y0, balances, labels, newton=not chosen, neutral=False), 1.0
    return BodiesProblem(
        name=name,
        fun=bind(rhs, params),
        rhs=rhs,
        acc=acc,
        y0=y0,
        t_span=interval(t_span),
        h=h,
        params=params,
        invariants=kept,
        blocks=3,
        component_names=names,
        linear_invariants=None if _forces.has_radiating_masses(params, masses.size) else centre_of_mass(masses, shifts),
        units=units,
        source=source,
        reference=reference,
        jacobian=library["gravity.central"],
        variational=partial(_variational, "forces" if chosen else "gravity", masses.size, params),
        frequencies=partial(orbital_frequencies, masses),
        epoch=epoch,
        G=G,
        bodies=labels,
        forces=chosen,
        radii=None if encounters is None else check_distances(encounters, masses.size),
        events=None if encounters is None else approaches(masses.size),
    )


def _variational(group: str, n: int, params: np.ndarray, parameters: Sequence[int]) -> Any:
    """Return the function of the library for `Problem.variational`; a force that is not in use has no derivatives."""
    used, last = params != 0, n + _forces.N_ENTRIES
    used[last:] = used[last:].any()
    used[n + _forces.POLE : n + _forces.MOON_BODY] = used[n + _forces.POLE : n + _forces.MOON_BODY].any()
    used[n + _forces.KIND : n + 1] = used[n + _forces.MOON_BODY : n + _forces.MOON] = False
    for k in parameters:
        if k < n < params.size and params[k] == 0 and params[last + k] != 0:
            raise ValueError(
                f"variations: a derivative by G m of body {k}, which is 0, while radiation acts on it: with a mass the "
                "problem has no invariants. Give the body a small mass."
            )
        if k >= n and not used[k]:
            raise ValueError(
                f"variations: the parameter {(*ENTRIES, *['beta'] * n)[k - n]!r} chooses a force, or belongs to one "
                "that the problem does not have. Choose a mass, or a constant of its forces."
            )
    return library[f"{group}.variational_by_parameters" if parameters else f"{group}.variational"]


def _masses(gm: Any, G: Any) -> np.ndarray:
    """Return G m of the bodies, `gm` itself if `G` is None."""
    if G is None:
        return real_array("gm", gm)
    if not (is_number(G, "G") and 0 < G < np.inf):
        raise ValueError(f"nbody: G must be a positive finite number, got {shown(G)}.")
    return real_array("gm", G * real_array("gm", gm))


def _check_bodies(gm: np.ndarray, q: np.ndarray, v: np.ndarray) -> None:
    """Raise ValueError unless these are bodies at different places; warn if all are far too fast, or far too slow."""
    n = gm.size
    if gm.ndim != 1 or q.shape != (n, 3) or v.shape != (n, 3):
        raise ValueError(
            f"nbody: gm, position and velocity have the shapes {gm.shape}, {q.shape} and {v.shape}; expected (N,), "
            "(N, 3) and (N, 3)."
        )
    if (wrong := ~((gm >= 0) & np.isfinite(gm))).any():
        k = int(np.argmax(wrong))
        raise ValueError(f"nbody: every G m must be positive, or 0 for a test particle; gm[{k}] is {gm[k]}.")
    if not gm.any():
        raise ValueError("nbody: every G m is 0; at least one must be positive.")
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise ValueError("nbody: position and velocity must be finite.")
    ratio = _relative_speeds(gm, q, v)
    if ratio.size and (ratio.min() > TOO_FAST or ratio.max() < TOO_SLOW):
        warnings.warn(
            f"nbody: relative speeds are {ratio.min():.2g} to {ratio.max():.2g} times the escape speed; check that "
            "position, velocity and gm are in the same units of length and time (AU/day taken for AU/yr is a factor of "
            "365).",
            UserWarning,
            stacklevel=3,
        )


def _relative_speeds(gm: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return each body's speed relative to the body that binds it most, in units of the pair's escape speed, if not 0.

    A ValueError is raised if two bodies are at the same place.
    """
    found = []
    for i in range(gm.size):  # one row of distances at a time, because N^2 distances may not fit in memory
        distance = np.linalg.norm(q - q[i], axis=1)
        distance[i] = np.inf
        if (distance == 0).any():
            j = int(np.argmin(distance))
            raise ValueError(
                f"nbody: bodies {i} and {j} are at the same place, {q[i]}. Move one of them, or replace both by one."
            )
        pair = (gm + gm[i]) / distance
        j = int(np.argmax(pair))
        speed = np.linalg.norm(v[i] - v[j])
        if speed > 0 and pair[j] > 0:
            found.append(speed / np.sqrt(2 * pair[j]))
    return np.array(found)


def centre_of_mass(gm: np.ndarray, shifts: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return linear invariants (C, S): position and velocity of the centre of mass, restored by `shifts` of the bodies.

    C (6, 6 N) maps a state to these six numbers, and the columns of S (6 N, 6) are proportional to the shifts, (N,) or
    one number.
    """
    axes, both, column = np.eye(3), np.eye(2), np.broadcast_to(shifts, gm.shape)[:, None]
    return np.kron(both, np.kron(gm / gm.sum(), axes)), np.kron(both, np.kron(column, axes))
