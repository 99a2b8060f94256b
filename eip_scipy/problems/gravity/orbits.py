"""Orbits of N bodies: energies, angular momenta and Laplace vectors as balances, see `Balance`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ...core.balances import Balance
from ...core.inputs import flag, real_array, shown
from ...core.names import nearest
from ...engine.native import library

__all__ = ["QUANTITIES", "balances_of_orbits", "centres", "orbital_balances"]

Array = np.ndarray
QUANTITIES = {"energy": ("",), "momentum": ("_x", "_y", "_z"), "laplace": ("_x", "_y", "_z")}
"""Quantities of an orbit, with the ends of the names of their values."""
KEPLER = {"kepler": "energy"}


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

    See Also
    --------
    nbody, eip_scipy.Balance

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
    masses, state = real_array("gm", gm), real_array("y0", y0)
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
    return balances_of_orbits(masses, state, quantities, names, newton=flag("newton", newton), neutral=True)


def balances_of_orbits(
    gm: Array, y0: Array, quantities: Any, names: Sequence[str], *, newton: bool, neutral: bool
) -> tuple[Balance, ...]:
    """Return the balances of `orbital_balances`; if `neutral`, each correction leaves the centre of mass unchanged.

    That moves all other bodies in the opposite direction. If the linear invariants of a run restore the centre of mass
    by a common shift, which changes no orbit, only the body on an orbit about the heaviest body needs to move.

    The library's parameters of an orbit are its energy at the start, the number of bodies that take part, and the index
    of each and its weight in the relative position.
    """
    chosen, about = _chosen(quantities), centres(gm, y0)
    families = _families(about)
    orbits, entries, subspaces = np.flatnonzero(about >= 0).tolist(), [], []
    for body in orbits:
        centre, group = int(about[body]), families[body]
        total = gm[group].sum()
        shares = gm[group] / total if total > 0 else np.ones(1)
        sides = np.column_stack([[centre, *group], [-1.0, *shares]])
        entries.append(np.array([0.0, len(sides), *sides.ravel()]))
        # The group moves, and the centre with the rest of its family in the opposite direction, so that their common
        # centre of mass stays. No other orbit is then changed.
        alone = not neutral and about[centre] < 0
        moved = group if alone else families[centre]
        moves = np.isin(moved, group) - (0.0 if alone else total / gm[moved].sum())
        relative = [shares @ rows[group] - rows[centre] for rows in y0.reshape(2, -1, 3)]
        lengths = np.linalg.norm(relative, axis=1)
        lengths[lengths == 0] = 1.0
        components = np.arange(y0.size).reshape(2, -1, 3)[:, moved].swapaxes(1, 2).reshape(6, -1)
        subspaces.append((components, np.outer(np.repeat(lengths, 3), moves)))
    start = library["orbits.energy"](0.0, y0, np.concatenate([gm, *entries]))
    for entry, energy in zip(entries, start, strict=True):
        entry[0] = energy
    # Planets of the first body have functions for many of them side by side.
    planets = about[0] < 0 and not about[1:].any()
    found = []
    for quantity in chosen:
        of_planets = planets and quantity == "energy"
        params = np.concatenate([gm, start] if of_planets else [gm, *entries])
        group_name, rate = "planets" if of_planets else "orbits", "_rate_newton" if newton else "_rate"
        functions = (library[f"{group_name}.{quantity}{end}"].bound(params) for end in ("", rate, "_gradient"))
        axes = QUANTITIES[quantity]
        kept = Balance(*functions, size=len(axes) * len(orbits), name=quantity, in_place=True, uses_f=True)
        # Neptune's energy changes at 0.05 of its terms, because the Sun is moved by Jupiter, and helps all the same.
        kept.most_slowness = 0.2
        kept.subspaces = tuple(subspace for subspace in subspaces for _ in axes)
        kept.value_names = tuple(f"{quantity}{axis} of {names[body]}" for body in orbits for axis in axes)
        found.append(kept)
    return tuple(found)


def _chosen(given: Any) -> list[str]:
    """Return the quantities that a name or several names mean, in the order of `QUANTITIES`; "kepler" is "energy"."""
    names = (given,) if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    known = (*KEPLER, *QUANTITIES)
    for name in names:
        if name not in known:
            hint = nearest(str(name), known)
            raise ValueError(
                f"orbital_balances: unknown quantity {shown(name)}; known: {', '.join(map(repr, known))}{hint}"
            )
    return [name for name in QUANTITIES if name in {KEPLER.get(name, name) for name in names}]


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


def _families(about: Array) -> list[list[int]]:
    """Return for each body the indices, in order, of the body and of all that move about it, directly or not."""
    found: list[list[int]] = [[] for _ in about]
    for body in range(about.size):
        above = body
        while above >= 0:
            found[above].append(body)
            above = int(about[above])
    return found
