"""Orbits of N bodies: energies, angular momenta and Laplace vectors as balances, see `Balance`, and frequencies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...core.balances import Balance
from ...core.inputs import flag, real_array, shown
from ...core.names import nearest
from ...engine.native import library

__all__ = [
    "QUANTITIES",
    "balances_of_orbits",
    "centres",
    "chosen_quantities",
    "orbital_balances",
    "orbital_frequencies",
]

Array = np.ndarray
QUANTITIES = ("energy", "momentum", "laplace")
# Least pericentre, in units of a pair's present distance: nearer, a radial orbit ends in a collision or is perturbed.
LEAST_PERICENTRE = 1e-3
# Least eccentricity of a pair whose time to the pericentre is considered, and halvings that solve Kepler's equation.
LEAST_ECCENTRICITY, HALVINGS = 0.5, 30
# Place of the energy at the start among the entries of an orbit, see engine/cpp/problems/orbits.cpp.
ENERGY = 0


class _Orbit(NamedTuple):
    """Orbit of the body with the index `body`, or of this body together with those that move about it.

    `entries` are its parameters for the library: the energy at the start (0 until it is known), the number of bodies
    that take part, and the index of each and its weight in the relative position. A correction moves the `components`
    (6, k) of the state by multiples of `weights` (6, k).
    """

    body: int
    entries: Array
    components: Array
    weights: Array


def orbital_balances(
    gm: Any,
    y0: Any,
    quantities: str | Sequence[str] = "kepler",
    *,
    bodies: Sequence[str] | None = None,
    newton: bool = False,
) -> tuple[Balance, ...]:
    """Return balances of the quantities that Kepler's motion conserves, for the orbit of each body except the heaviest.

    A planet moves about its star, and a moon about its planet. A planet with moons moves as their common barycentre.
    The perturbing acceleration is that of the right-hand side minus the attraction between the two sides of the orbit,
    so that the rates hold for all forces.

    Parameters
    ----------
    gm : array_like, shape (N,)
        G m of each body, at least two.
    y0 : array_like, shape (6 N,)
        The start (q_1, ..., q_N, v_1, ..., v_N), from which the orbits are found.
    quantities : str or sequence of str, optional
        Quantities of each orbit: "energy", "momentum" (angular momentum) and "laplace" (Laplace's vector), all per
        reduced mass. "kepler" is the energy alone, which is enough for eccentricities below 0.3.
    bodies : sequence of str, optional
        Names of the bodies, for the names of the values. Default: the numbers 0, 1, ...
    newton : bool, optional
        True if no forces act except Newton's gravitation. The rates are then sums of the perturbing attractions instead
        of differences of the accelerations, which reduces rounding errors about a hundredfold for orbits about the
        heaviest body.

    Returns
    -------
    tuple of Balance
        One balance for each quantity, in the order energy, momentum, laplace; its values are those of the N - 1 orbits.
        The value for an energy is its difference from the energy at the start.

    Raises
    ------
    ValueError
        If a quantity is unknown, masses or states are wrong, or sizes disagree.

    Notes
    -----
    These balances replace the total energy and angular momentum as the invariants of a run. The totals remain an
    independent check; do not list them with these balances.

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import orbital_balances, solar_system
    >>> problem = solar_system(years=1)
    >>> kept = orbital_balances(problem.params, problem.y0)
    >>> run = integrate(problem, method=EIPDOP853, h=0.004, invariants=kept)
    >>> run.invariants.shape[0], run.trusted
    (9, True)
    """
    return balances_of_orbits(gm, y0, quantities, bodies, newton, neutral=True)


def balances_of_orbits(
    gm: Any, y0: Any, quantities: Any, bodies: Sequence[str] | None, newton: bool, *, neutral: bool
) -> tuple[Balance, ...]:
    """Return the balances of `orbital_balances`; if `neutral`, each correction leaves the centre of mass unchanged.

    That moves all other bodies in the opposite direction. If the linear invariants of a run restore the centre of mass
    by a common shift, which changes no orbit, only the body on an orbit about the heaviest body needs to move.
    """
    masses, state = real_array("gm", gm), real_array("y0", y0)
    newton = flag("newton", newton)
    if masses.ndim != 1 or masses.size < 2 or state.shape != (6 * masses.size,):
        raise ValueError(
            f"orbital_balances: gm has shape {masses.shape} and y0 {state.shape}; expected (N,) and (6 N,), N >= 2."
        )
    if not (np.isfinite(masses).all() and masses.min() >= 0 and masses.max() > 0):
        raise ValueError(f"gm must hold finite numbers >= 0, and at least one > 0, got {shown(gm)}.")
    if not np.isfinite(state).all():
        raise ValueError(f"y0 must be finite, got {shown(y0)}.")
    names = tuple(map(str, range(masses.size))) if bodies is None else tuple(bodies)
    if len(names) != masses.size:
        raise ValueError(
            f"bodies has {len(names)} names, but gm has {masses.size} masses; give one name for each mass."
        )
    about = centres(masses, state)
    orbits = [_orbit(masses, state, about, body, neutral) for body in np.flatnonzero(about >= 0).tolist()]
    entries = np.concatenate([masses, *(orbit.entries for orbit in orbits)])
    start = library["orbits.energy"](0.0, state, entries)
    place = masses.size + ENERGY
    for orbit, energy in zip(orbits, start.tolist(), strict=True):
        entries[place] = energy
        place += orbit.entries.size
    end = "_rate_newton" if newton else "_rate"
    # Planets of the first body have functions for many of them side by side.
    planets = about[0] < 0 and not about[1:].any()
    own = {"energy": ("planets", np.concatenate([masses, start]))} if planets else {}
    return tuple(
        _balance(quantity, *own.get(quantity, ("orbits", entries)), orbits, names, end)
        for quantity in chosen_quantities(quantities)
    )


def chosen_quantities(given: Any) -> tuple[str, ...]:
    """Return the quantities that a name or several names mean, in the order of `QUANTITIES`; "kepler" is "energy"."""
    names = (given,) if isinstance(given, str) else tuple(given) if isinstance(given, Iterable) else (given,)
    for name in names:
        if name not in (*QUANTITIES, "kepler"):
            known = ", ".join(map(repr, ("kepler", *QUANTITIES)))
            hint = nearest(str(name), ("kepler", *QUANTITIES))
            raise ValueError(f"orbital_balances: unknown quantity {shown(name)}; known: {known}{hint}")
    wanted = {"energy" if name == "kepler" else name for name in names}
    return tuple(name for name in QUANTITIES if name in wanted)


def centres(gm: Array, y0: Array) -> Array:
    """Return the indices (N,) of the bodies that the bodies move about at the start, -1 for the heaviest body.

    Each moves about the heavier body with the smallest Hill sphere that it is in and bound to, or about the heaviest.
    """
    q, v = y0.reshape(2, -1, 3)
    order = np.argsort(-gm, kind="stable").tolist()
    about, hill = np.full(gm.size, -1), np.zeros(gm.size)
    hill[order[0]] = np.inf
    for place, body in enumerate(order[1:], 1):
        best = order[0]
        for other in order[1:place]:
            distance, speed = np.linalg.norm(q[body] - q[other]), np.linalg.norm(v[body] - v[other])
            bound = speed**2 * distance < 2 * (gm[body] + gm[other])
            if bound and distance < hill[other] < hill[best]:
                best = other
        about[body] = best
        hill[body] = np.linalg.norm(q[body] - q[best]) * np.cbrt(gm[body] / (3 * gm[best]))
    return about


def _is_below(about: Array, body: int, top: int) -> bool:
    """Return True if `body` moves about `top`, directly or through other bodies; `about` is the array of `centres`."""
    while body >= 0:
        body = int(about[body])
        if body == top:
            return True
    return False


def _orbit(gm: Array, y0: Array, about: Array, body: int, neutral: bool) -> _Orbit:
    """Return the orbit of `body`, together with all bodies that move about it, about the body ``about[body]``.

    If `neutral`, or if it is not the heaviest body, the other side moves too, so that the centre of mass stays.
    """
    centre = int(about[body])
    group = [k for k in range(gm.size) if k == body or _is_below(about, k, body)]
    total = float(gm[group].sum())
    shares = gm[group] / total if total > 0 else np.ones(1)
    pairs = [(float(centre), -1.0), *((float(k), share) for k, share in zip(group, shares.tolist(), strict=True))]
    q, v = y0.reshape(2, -1, 3)
    sizes = [float(np.linalg.norm(shares @ a[group] - a[centre])) or 1.0 for a in (q, v)]
    # The group moves, and the centre with the rest of what belongs to it moves in the opposite direction, so that their
    # common centre of mass stays. No other orbit is then changed. A frame does the same for all bodies together.
    by_itself = not neutral and about[centre] < 0
    those = group if by_itself else [k for k in range(gm.size) if k == centre or _is_below(about, k, centre)]
    floats = np.arange(y0.size).reshape(2, -1, 3)[:, those].swapaxes(1, 2).reshape(6, -1)
    moves = np.isin(those, group) - (0.0 if by_itself else total / gm[those].sum())
    entries = np.array([0.0, len(pairs), *np.ravel(pairs)])
    return _Orbit(body, entries, floats, np.outer(np.repeat(sizes, 3), moves))


def _balance(
    quantity: str, group: str, entries: Array, orbits: list[_Orbit], names: tuple[str, ...], end: str
) -> Balance:
    """Return the balance of one quantity for all orbits, by the functions "group.quantity" of the library."""
    fun, grad, rate = (library[f"{group}.{quantity}{part}"].bound(entries) for part in ("", "_gradient", end))
    each = 1 if quantity == "energy" else 3
    kept = Balance(fun, rate, grad, size=each * len(orbits), name=quantity, in_place=True, uses_f=True)
    # Neptune's energy changes at 0.05 of its terms, because the Sun is moved by Jupiter, and helps all the same.
    kept.most_slowness = 0.2
    kept.subspaces = tuple((orbit.components, orbit.weights) for orbit in orbits for _ in range(each))
    axes = ("",) if each == 1 else ("_x", "_y", "_z")
    kept.value_names = tuple(f"{quantity}{axis} of {names[orbit.body]}" for orbit in orbits for axis in axes)
    return kept


def orbital_frequencies(gm: np.ndarray, y: np.ndarray, duration: float = np.inf) -> tuple[np.ndarray, float]:
    """Return an angular frequency for each orbit about the heaviest body, and the largest one of the other pairs.

    `gm` (N,) are G times the masses, `y` (6 N,) positions and velocities, and `duration` is the length of the run,
    negative if it goes back in time. The frequencies (N,) are in radians per unit of time, 0 for the heaviest body. The
    other pairs are those, such as a planet and its moon, for which the sum of both G m divided by the cube of the
    distance is larger than it is for the heaviest body and one body of the pair; without such pairs the second result
    is 0.

    The frequency of a bound pair is computed from its osculating orbit. It is the geometric mean of the mean motion n
    and the frequency in the pericentre, n (1 - e)^(-3/2), because this mean determines the stability of a multistep
    method, as was measured with Mercury (e = 0.2). If the eccentricity of a bound pair is above 0.5, and the pair does
    not reach its pericentre within the run, its least distance within the run takes the place of the pericentre. If
    other bodies change the motion of a pair more than its own attraction does, or if the pair flies apart for good, the
    frequency is that of its attraction at the present distance. Therefore the frequency of a pair without angular
    momentum is finite.
    """
    n, centre = len(gm), int(np.argmax(gm))
    pulls = np.empty_like(y)
    library["gravity.rhs"](0.0, y, pulls, gm)
    q, v, a = y[: 3 * n].reshape(n, 3), y[3 * n :].reshape(n, 3), pulls[3 * n :].reshape(n, 3)
    with np.errstate(all="ignore"):  # of a body and itself, and of massless pairs
        about = _pair_frequencies(gm + gm[centre], q - q[centre], v - v[centre], a - a[centre], duration)
        others = 0.0
        to_centre = (gm + gm[centre]) / np.linalg.norm(q - q[centre], axis=1) ** 3
        for i in range(n):
            near = (gm + gm[i]) / np.linalg.norm(q - q[i], axis=1) ** 3 > to_centre
            near[[i, centre]] = False
            if i != centre and near.any():
                pairs = q[near] - q[i], v[near] - v[i], a[near] - a[i]
                others = max(others, _pair_frequencies(gm[near] + gm[i], *pairs, duration).max())
    about[centre] = 0.0
    return about, float(others)


def _pair_frequencies(mass: Array, r: Array, u: Array, pull: Array, duration: float) -> Array:
    """Return the frequencies (k,) of pairs of this `mass`, with relative positions, velocities and pulls (k, 3)."""
    distance, along = np.linalg.norm(r, axis=1), np.sum(r * u, axis=1)
    own = mass / distance**3
    inverse_axis = 2.0 / distance - np.sum(u * u, axis=1) / mass
    momentum = np.sum(np.cross(r, u) ** 2, axis=1) / mass
    eccentricity = np.sqrt(np.maximum(0.0, 1.0 - momentum * inverse_axis))
    pericentre = np.maximum(momentum / (1.0 + eccentricity), LEAST_PERICENTRE * distance)
    approaches = along * np.copysign(1.0, duration) < 0.0
    least = _nearest(mass, distance, inverse_axis, eccentricity, approaches, abs(duration))
    fastest = np.sqrt(mass / np.maximum(pericentre, least) ** 3)
    mean = np.sqrt(mass * np.maximum(inverse_axis, 0.0) ** 3)
    alone = np.linalg.norm(pull + own[:, None] * r, axis=1) < mass / distance**2
    bound = inverse_axis > 0.0
    of_orbit = np.where(bound, np.sqrt(mean * fastest), fastest)
    found = np.where(alone & (bound | ~(along > 0.0)), of_orbit, np.sqrt(own))
    return np.where((mass > 0.0) & ~np.isnan(found), found, 0.0)


def _nearest(mass: Array, distance: Array, inverse_axis: Array, e: Array, approaches: Array, duration: float) -> Array:
    """Return the least distances (k,) in the run of bound pairs whose pericentre comes after its end, 0 for others."""
    a = 1.0 / inverse_axis
    anomaly = np.arccos(np.clip((1.0 - distance / a) / e, -1.0, 1.0))
    until = anomaly - e * np.sin(anomaly)  # the mean anomaly left
    left = np.where(approaches, until, 2 * np.pi - until) - duration * np.sqrt(mass / a**3)
    wanted = np.minimum(left, 2 * np.pi - left)  # the same distance before and after the apocentre
    low, high = np.zeros_like(a), np.full_like(a, np.pi)
    for _ in range(HALVINGS):  # of Kepler's equation
        middle = 0.5 * (low + high)
        below = middle - e * np.sin(middle) < wanted
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    # Circles have no pericentre to wait for.
    later = (inverse_axis > 0.0) & (e > LEAST_ECCENTRICITY) & (left > 0.0)
    return np.where(later, np.minimum(distance, a * (1.0 - e * np.cos(low))), 0.0)
