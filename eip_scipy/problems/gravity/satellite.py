"""A satellite about an oblate planet with an atmosphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...core.inputs import is_number, real_array, shown
from ...core.problem import Problem
from .forces import ForceConstants
from .nbody import nbody

__all__ = ["satellite"]

STEPS = 16  # a revolution, of the default step


def satellite(
    position: Any,
    velocity: Any,
    *,
    mu: float,
    radius: float,
    t_span: tuple[float, float],
    h: float | None = None,
    j2: float = 0.0,
    drag: float = 0.0,
    height: float = 0.0,
    scale_height: float | None = None,
    spin: float = 0.0,
    pole: Sequence[float] = (0.0, 0.0, 1.0),
    balances: str | Sequence[str] | None = ("energy", "momentum", "laplace"),
    name: str = "satellite",
    units: str = "",
) -> Problem:
    """Return the problem of a satellite about an oblate planet, with drag in an exponential atmosphere.

    The acceleration is the gradient of ``mu / r (1 - j2 (radius / r)^2 (3 sin(latitude)^2 - 1) / 2)``, and
    ``-drag exp((radius + height - r) / scale_height) |u| u`` with the velocity u relative to the air.

    Parameters
    ----------
    position, velocity : array_like, shape (3,)
        Position and velocity at the start, relative to the planet's centre.
    mu, radius : float
        G m and the equatorial radius of the planet. All arguments have the units of length and time of your choice.
    t_span : (float, float)
    h : float, optional
        Step. Default: 1/16 of the period of the Kepler orbit at the start; none if that orbit is unbound.
    j2 : float, optional
        Oblateness J2, a number without unit.
    drag : float, optional
        Half of the air's density at `height`, times c_D A / m of the satellite. Its unit is one over a length.
    height, scale_height : float, optional
        `drag` holds at the distance `radius` + `height` from the planet's centre. `scale_height`, which must be given
        with `drag`, is the height over which the density falls by a factor of e.
    spin : float, optional
        Angular velocity of the air about the pole, in radians per unit of time.
    pole : sequence of 3 floats, optional
        Axis of the planet.
    balances : str or sequence of str, optional
        Quantities of Kepler's motion to keep, see `orbital_balances`. The default is all of them, which is most
        accurate for nearly circular orbits. "kepler", the energy alone, is more accurate from eccentricities of about
        0.1. If it is None, the problem has no invariants.
    name, units : str, optional
        See `Problem`.

    Returns
    -------
    Problem
        A problem of `nbody`, with the planet at rest in the origin and a satellite of mass 0. The state is (position of
        the planet, position of the satellite, velocity of the planet, velocity of the satellite).

    Raises
    ------
    ValueError
        If a shape is wrong, `mu`, `radius` or `scale_height` is not positive, `j2`, `drag` or `height` is negative, or
        a quantity in `balances` is unknown.

    See Also
    --------
    nbody, orbital_elements

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import satellite
    >>> earth = {"mu": 398600.4418, "radius": 6378.137, "j2": 1.08262668e-3}  # km, s
    >>> air = {"drag": 3.3e-11, "height": 400, "scale_height": 60}
    >>> problem = satellite([6798, 0, 0], [0, 4.756, 6.001], t_span=(0, 86400), **earth, **air)
    >>> run = integrate(problem, method=EIPDOP853)
    >>> run.trusted, problem.component_names[3]
    (True, 'x_satellite')
    """
    x, v = real_array("position", position), real_array("velocity", velocity)
    if x.shape != (3,) or v.shape != (3,):
        raise ValueError(f"satellite: position has shape {x.shape} and velocity {v.shape}; expected (3,) for both.")
    lengths = {"mu": mu, "radius": radius} | ({} if scale_height is None else {"scale_height": scale_height})
    for key, value in {**lengths, "j2": j2, "drag": drag, "height": height}.items():
        if not is_number(value) or not np.isfinite(value) or value < 0 or (key in lengths and value == 0):
            least = "> 0" if key in lengths else ">= 0"
            raise ValueError(f"satellite: {key} must be a finite number {least}, got {shown(value)}.")
    if drag and scale_height is None:
        raise ValueError(
            "satellite: drag needs scale_height, the height over which the density of the air falls by a factor of e; "
            "give it."
        )
    if h is None:
        inverse = 2 / float(np.linalg.norm(x)) - float(v @ v) / mu  # of the semi-major axis
        h = None if inverse <= 0 else 2 * np.pi / STEPS / float(np.sqrt(mu * inverse**3))
    problem = nbody(
        [mu, 0.0],
        [np.zeros(3), x],
        [np.zeros(3), v],
        t_span=t_span,
        h=h,
        forces=[force for force, size in (("j2", j2), ("drag", drag)) if size],
        constants=ForceConstants(
            j2=j2 * radius**2,
            pole=pole,
            drag=drag,
            drag_radius=radius + height,
            scale_height=scale_height,
            spin=spin,
        ),
        balances="kepler" if balances is None else balances,
        name=name,
        units=units,
        bodies=("planet", "satellite"),
        source="exponential atmosphere, drag proportional to the squared speed",
    )
    return problem if balances is not None else replace(problem, invariants=())
