"""Point masses: Newton's gravitation, and further forces by name."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...core.inputs import is_number, real_array, shown
from ...core.problem import Problem, bind, library_variational
from ...core.step_control import interval
from ...engine.native import library
from . import forces as _forces
from .bodies import body_names
from .forces import ForceConstants
from .orbits import balances_of_orbits, orbital_frequencies

__all__ = ["component_names", "nbody"]

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
        Forces in addition to Newton's gravitation, all from the first body (the Sun) except "eih":

        "1pn"
            First post-Newtonian terms of the Sun's field in harmonic coordinates, in positions and velocities relative
            to the Sun.
        "eih"
            First post-Newtonian terms of all bodies, by Einstein, Infeld and Hoffmann.
        "gr-potential"
            The potential ``-3 (G M)^2 m / (c^2 r^2)``: the right advance of the perihelion, not the right period
            (Nobili and Roxburgh 1986).
        "j2"
            The Sun's oblateness.
        "moon-quadrupole"
            The mean effect of a Moon on a circle around the Earth, for data in which one body stands for both.
        "drag"
            Drag on all other bodies in an atmosphere of the first one, see `satellite`.

        At most one of "1pn", "eih" and "gr-potential" can be given.
    constants : ForceConstants, optional
        The speed of light and the other constants of the forces, in the units of the state.
    name, source : str, optional
        See `Problem`.
    units : str, optional
        Units of length and time, such as "AU, yr" (see `Problem`).
    reference : callable, optional
        See `Problem`.
    bodies : sequence of str, optional
        Names of the bodies, which become part of the components' names: x_Sun, y_Sun, ... Default: x_0, y_0, ...
    epoch : (float, float), optional
        Date of t = 0: a Julian date in TDB, in two parts (see `Problem`).
    G : float, optional
        The constant of gravitation. If it is given, the first argument holds the masses, which are multiplied by it:
        ``nbody([1, 1e-6], ..., G=4 * np.pi**2)`` in AU, years and solar masses. `Problem.G` stores it, so that a
        simulation of REBOUND gets the same masses.
    balances : str or sequence of str, optional
        Keep quantities that each orbit would conserve without the pulls of other bodies, as `Balance` objects, instead
        of the total energy and angular momentum: "kepler" or "energy", "momentum", "laplace", see `orbital_balances`.
        They are made for planetary systems without close encounters over long times, and hold the masses given here: a
        run with other `params` is reported as not to be trusted.

    Returns
    -------
    Problem
        State (q_1, ..., q_N, v_1, ..., v_N), each with 3 components. Invariants: "H", the energy times G, and "L", the
        angular momentum times G (for `forces` see Notes; with `balances`, these replace "H" and "L"). Momentum and
        centre of mass are `linear_invariants`; `blocks` are the bodies' positions and velocities.

    Raises
    ------
    ValueError
        If shapes disagree, a mass is negative, all masses are 0, two bodies have the same position, `G` is not
        positive, or a force is unknown.

    Warns
    -----
    UserWarning
        If all relative speeds are far from orbital speeds, which suggests inconsistent units.

    Notes
    -----
    The invariants do not depend on test particles: their gradients are 0 there, and no correction moves test particles.

    The problem has those invariants that the equations conserve:

    ================================  ======================================================================
    forces                            invariants
    ================================  ======================================================================
    none, "gr-potential",             "H" and "L", exact
    "moon-quadrupole"
    "j2", also with these two         "H" and "L_pole", the component of L along the Sun's pole, exact
    "1pn" alone, two bodies           "H" and "L" of the relative motion, per reduced mass, exact
    "1pn" otherwise                   none, because no exact energy is known for three or more bodies
    "drag"                            none
    "eih"                             "H" and "L" ("L_pole" with "j2") with their terms in 1/c^2. Their error
                                      is of the order of 1/c^4. They are omitted unless it is below 1e-13 at
                                      the start, as in the solar system
    ================================  ======================================================================

    From 128 bodies on the sums over pairs use several threads: as many as the environment variable ``OMP_NUM_THREADS``
    says when the first run begins, or else as many as there are processors, up to 16. ``OMP_NUM_THREADS=1`` turns that
    off. The results have the same bits for any number of threads. Members of an ensemble that run at the same time, and
    processes of `multiprocessing` without that variable, use one thread each.

    Newton's momentum and centre of mass are exact invariants of all forces except "eih", whose momentum has further
    terms in 1/c^2; there the frame only keeps corrections from moving the centre of mass. With "1pn", "eih" and "drag"
    the accelerations depend on velocities: `acc` is None, and Nystrom methods do not apply.
    """
    masses, q, v = _checked(_gravitational(gm, G), position, velocity)
    chosen = _forces.check_forces(forces)
    y0 = np.concatenate([q.ravel(), v.ravel()])
    params = _forces.parameters(masses, chosen, constants) if chosen else masses
    if balances is None:
        kept = _forces.invariants(chosen, params, y0)
    else:
        kept = balances_of_orbits(masses, y0, balances, bodies, not chosen, neutral=False)
    rhs, acc = _forces.equations(chosen)
    return Problem(
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
        component_names=component_names(masses.size, bodies),
        linear_invariants=recoil(masses) if balances is None else common_shift(masses),
        units=units,
        source=source,
        reference=reference,
        jacobian=library["gravity.central"],
        variational=partial(library_variational, "forces.variational" if chosen else "gravity.variational", ()),
        frequencies=partial(orbital_frequencies, masses),
        epoch=epoch,
        G=G,
    )


def component_names(n: int, bodies: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the 6 n components, x_0, y_0, ... then vx_0, ..., with `bodies` in place of the numbers."""
    names = tuple(map(str, range(n))) if bodies is None else body_names(bodies, n)
    return tuple(f"{axis}_{body}" for axes in (("x", "y", "z"), ("vx", "vy", "vz")) for body in names for axis in axes)


def _gravitational(masses: Any, G: Any) -> Any:
    """Return `G` times `masses`; if `G` is None, return `masses` unchanged."""
    if G is None:
        return masses
    if not (is_number(G, "G") and 0 < G < np.inf):
        raise ValueError(f"nbody: G must be a positive finite number, got {shown(G)}.")
    return G * real_array("gm", masses)


def _checked(gm: Any, position: Any, velocity: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gm, position and velocity as arrays (N,), (N, 3), (N, 3); raise an error, or warn of unlikely speeds."""
    masses, q, v = real_array("gm", gm), real_array("position", position), real_array("velocity", velocity)
    n = masses.size
    if masses.ndim != 1 or q.shape != (n, 3) or v.shape != (n, 3):
        raise ValueError(
            f"nbody: gm, position and velocity have the shapes {masses.shape}, {q.shape} and {v.shape}; expected (N,), "
            "(N, 3) and (N, 3)."
        )
    if not (np.all(masses >= 0) and np.isfinite(masses).all()):
        k = int(np.argmax(~(np.isfinite(masses) & (masses >= 0))))
        raise ValueError(f"nbody: every G m must be positive, or 0 for a test particle; gm[{k}] is {masses[k]}.")
    if not masses.any():
        raise ValueError("nbody: every G m is 0; at least one must be positive.")
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise ValueError("nbody: position and velocity must be finite.")
    _check_speeds(_relative_speeds(masses, q, v))
    return masses, q, v


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


def _check_speeds(ratio: np.ndarray) -> None:
    """Warn if every body is far too fast, or every body far too slow, which suggests inconsistent units."""
    if ratio.size and (ratio.min() > TOO_FAST or ratio.max() < TOO_SLOW):
        warnings.warn(
            f"nbody: relative speeds are {ratio.min():.2g} to {ratio.max():.2g} times the escape speed; check that "
            "position, velocity and gm are in the same units of length and time (AU/day taken for AU/yr is a factor of "
            "365).",
            UserWarning,
            stacklevel=4,
        )


def recoil(gm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (C, S) of centre of mass and momentum, with shifts of bodies proportional to their masses.

    C (6, 6 N) maps a state to position and velocity of the centre of mass, and the columns of S (6 N, 6) are the shifts
    that restore it. The recoil from the correction of a planet then goes to its star.
    """
    axes = np.eye(3)
    share = gm / gm.sum()
    C = np.kron(np.eye(2), np.kron(share, axes))
    S = np.kron(np.eye(2), np.kron(share[:, None], axes))
    return C, S


def common_shift(gm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (C, S) of centre of mass and momentum, whose shifts move all bodies by the same distance."""
    C, _ = recoil(gm)
    return C, np.kron(np.eye(2), np.kron(np.ones((gm.size, 1)), np.eye(3)))
