"""Problems of mechanical systems with constraints, made from functions of arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ...core.derivatives import time_of_motion
from ...core.inputs import real_array, shown
from ...core.problem import component_names
from .differentiated import TAKES, difference, of_state, parts_of_functions
from .energies import states_near
from .motion import plain
from .parts import Parts, required_outputs
from .problem import MechanicsProblem, mechanics_problem
from .start import Names

__all__ = ["RANK_TOLERANCE", "mechanism"]

# Distance within which gradients of constraints, each scaled to length 1, count as dependent.
RANK_TOLERANCE = 1e-5
# Bound for rounding, relative to the values or terms: of functions that must be linear, masses and kinetic energies.
ROUNDING = 1e-9
# Bound for the errors of given derivatives, relative to the computed ones or, if they are larger, to the speeds.
DERIVED = 1e-6


def mechanism(
    mass: Any,
    forces: Any,
    constraints: Any = None,
    *,
    q0: Any,
    u0: Any,
    t_span: tuple[float, float] | None = None,
    velocity_constraints: Any = None,
    kinematics: Any = None,
    jacobian: Any = None,
    gamma: Any = None,
    energy: Any = None,
    potential_energy: Any = None,
    power: Any = None,
    outputs: Any = None,
    independent: Iterable[str] | None = None,
    coordinates: Any = None,
    speeds: Any = None,
    constraint_names: Any = None,
    rank_tolerance: float = RANK_TOLERANCE,
    name: str = "mechanism",
    **others: Any,
) -> MechanicsProblem:
    """Return the problem of a mechanical system with constraints, from functions of arrays.

    The state is (q, u), and the equations are ``q' = u``, ``M u' + G^T lambda = F``, ``G u' = -gamma``, where
    G u + ... = 0 are the constraints on velocities: the derivatives of those on positions, and those given by
    `velocity_constraints`. A run keeps all constraints, the norms of quaternions, and the energy if it is known and
    constant, or changes slowly.

    Parameters
    ----------
    mass : array_like or callable
        The mass matrix M, (n, n) or its diagonal (n,), or ``mass(q)``. It must be symmetric, and positive for motions
        that the constraints allow; massless parts may have zeros in it.
    forces : array_like or callable
        The generalised forces F, (n,), or ``forces(t, q, u)``: all terms of the equations except M u' and the forces
        of the constraints.
    constraints : callable, optional
        ``constraints(t, q)``, (m,), the expressions that the constraints on positions set to 0.
    q0, u0 : array_like or mapping
        Coordinates and speeds at the start, in order, or by name if `coordinates` and `speeds` are given. They must
        meet the constraints, see `independent`.
    t_span : tuple of float, optional
        Start and end of the interval. If it is omitted, the start is at t = 0.
    velocity_constraints : callable, optional
        ``velocity_constraints(t, q, u)``, (k,), linear in u, the expressions that further constraints set to 0, which
        are not derivatives of `constraints`, such as those of rolling wheels.
    kinematics : callable, optional
        ``kinematics(t, q, u)``, the derivatives q', linear in u. Default: q' = u.
    jacobian, gamma : callable, optional
        ``jacobian(t, q)``, the derivatives (m, n) of `constraints` with respect to q, and ``gamma(t, q, u)``, (m + k,),
        the second time derivatives of `constraints` and the first ones of `velocity_constraints` for u' = 0. Default:
        computed. Given ones are compared with differences near the start.
    energy, potential_energy : callable, optional
        ``energy(t, q, u)``, the total energy, or ``potential_energy(t, q)`` for u M u / 2 + potential_energy. Without
        one of them the energy is not known.
    power : callable, optional
        ``power(t, q, u)``, the rate of change of the energy, which then becomes a `Balance`. Default: it is computed.
    outputs : mapping, optional
        Functions ``f(t, q, u)``, by name, of quantities that are computed at saved states; see ``run.outputs``.
    independent : iterable of str, optional
        Names of the coordinates and speeds whose values in `q0` and `u0` are kept. All others are guesses, from which
        the start is computed. Default: all values are kept.
    coordinates, speeds, constraint_names : optional
        Names, as text such as ``"q1 q2"`` or a sequence of strings. The names of `velocity_constraints` follow those of
        `constraints`. Default: q1, q2, ..., u1, u2, ..., g1, g2, ...
    rank_tolerance : float, optional
        Distance within which gradients of constraints, each scaled to length 1, count as dependent.
    name : str, optional
    **others
        Further attributes of the `Problem`, such as ``units``, ``h``, ``source`` and ``reference``.

    Returns
    -------
    MechanicsProblem

    Raises
    ------
    ValueError
        If shapes do not fit, a function that must be linear in u is not, the start does not meet the constraints, the
        mass matrix is not symmetric or not positive, or a given derivative or power is wrong.

    See Also
    --------
    mechanics, MechanicsProblem

    Notes
    -----
    If all functions are jitted by Numba (except those of `outputs`), the whole problem is compiled, and first
    derivatives come from dual numbers; arrays and numbers from outside have the values of the time of compilation.
    Plain Python functions are called from Python, which takes much longer; first derivatives then come from complex
    steps, or from differences. Second derivatives, such as `gamma`, are differences of the first ones. Next to a
    singular position, at which gradients of constraints are dependent, their rounding is magnified: pass `gamma` if a
    run passes through such positions.

    Examples
    --------
    A pendulum in Cartesian coordinates:

    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import mechanism
    >>> pendulum = mechanism([1, 1], [0, -9.81], lambda t, q: [q[0] ** 2 + q[1] ** 2 - 1], q0=[1, 0], u0=[0, 0],
    ...                      potential_energy=lambda t, q: 9.81 * q[1])
    >>> run = integrate(pendulum, (0, 10), method=EIPDOP853, rtol=1e-8, atol=1e-8)
    >>> bool(abs(run.y[0] ** 2 + run.y[1] ** 2 - 1).max() < 1e-14)
    True
    """
    given = {
        "mass": mass, "forces": forces, "constraints": constraints, "velocity_constraints": velocity_constraints,
        "kinematics": kinematics, "jacobian": jacobian, "gamma": gamma, "energy": energy,
        "potential_energy": potential_energy, "power": power,
    }  # fmt: skip
    given = {what: _checked(what, item) for what, item in given.items() if item is not None}
    t, interval = (0.0, np.inf) if t_span is None else (float(t_span[0]), abs(float(t_span[1]) - float(t_span[0])))
    (of_q, q), (of_u, u) = _named("q0", q0, coordinates, "q"), _named("u0", u0, speeds, "u")
    of, y = {what: of_state(item, TAKES[what], q.size) for what, item in given.items()}, np.append(q, u)
    m, k = (np.size(of[what](t, y)) if what in of else 0 for what in ("constraints", "velocity_constraints"))
    _require_shapes(of, t, y, (q.size, u.size, m, k))
    _require_linear(of, t, q, u.size)
    g = _numbered(constraint_names, "g", m + k)
    names = Names(of_q, of_u, g[:m], (*(f"{item}'" for item in g[:m]), *g[m:]))
    if "t" in names.state:
        raise ValueError("mechanism: t is the time; give the coordinate or speed of this name another one.")
    # Constraints may depend on time. Differences over more time than this would be wrong while little moves.
    if not 0 < (longest := interval) < np.inf:
        moving = time_of_motion(q, np.asarray(of["kinematics"](t, y), float) if "kinematics" in of else u)
        longest = max(1.0, moving) if moving < np.inf else 1.0
    parts = parts_of_functions(given, _checked_outputs(outputs, names, t, y), names, (t, y), longest)
    problem = mechanics_problem(
        name, parts, names, t, (q0, u0), None, independent, rank_tolerance, t_span=t_span, **others
    )
    _require_derivatives(of, parts, problem, t, longest)
    _require_masses(parts, names, t, problem.y0, rank_tolerance)
    return problem


def _checked(what: str, item: Any) -> Any:
    """Return a function, or mass and forces as arrays; raise TypeError if another argument is not a function."""
    if callable(item):
        return item
    if what not in ("mass", "forces"):
        raise TypeError(f"mechanism: {what} must be a function, got {shown(item)}.")
    values = np.atleast_1d(real_array(what, item))
    return np.diag(values) if what == "mass" and values.ndim == 1 else values


def _checked_outputs(outputs: Any, names: Names, t: float, y: np.ndarray) -> dict[str, Callable[..., Any]]:
    """Return the functions of the outputs by name, after a check that they return numbers at the start."""
    found = required_outputs("mechanism", outputs, names.state)
    for name, item in found.items():
        if not callable(item):
            raise TypeError(f"mechanism: the output {name!r} must be a function f(t, q, u), got {shown(item)}.")
        if np.shape(value := of_state(item, "tqu", len(names.coordinates))(t, y)) != ():
            raise ValueError(
                f"mechanism: the output {name!r} has the shape {np.shape(value)}; expected a number. Give each "
                "component a name of its own."
            )
    return found


def _named(what: str, given: Any, names: Any, letter: str) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of the components in `given`, and values for first calls of functions, by default 0."""
    if isinstance(given, Mapping):
        if names is None:
            raise TypeError(f"{what} is a mapping, which needs names; give coordinates= and speeds=, or an array.")
        names = component_names(names, None)
        return names, np.array([float(given.get(name, 0.0)) for name in names])
    values = np.atleast_1d(real_array(what, given)).astype(float)
    return _numbered(names, letter, values.size), values


def _numbered(names: Any, letter: str, count: int) -> tuple[str, ...]:
    return component_names([f"{letter}{j + 1}" for j in range(count)] if names is None else names, count)


def _require_shapes(of: Mapping[str, Any], t: float, y: np.ndarray, sizes: Sequence[int]) -> None:
    """Raise ValueError if a function returns an array of the wrong shape; those in `of` take (t, y)."""
    nq, n, m, k = sizes
    if "kinematics" not in of and nq != n:
        raise ValueError(
            f"mechanism: q0 has {nq} coordinates, but u0 has {n} speeds. Give as many speeds as coordinates, or "
            "kinematics=, which computes q' from the speeds."
        )
    shapes: dict[str, tuple[int, ...]] = {
        "mass": (n, n), "forces": (n,), "constraints": (m,), "velocity_constraints": (k,), "kinematics": (nq,),
        "jacobian": (m, nq), "gamma": (m + k,), "energy": (), "potential_energy": (), "power": (),
    }  # fmt: skip
    for what, fun in of.items():
        if (has := np.shape(fun(t, y))) != shapes[what]:
            raise ValueError(
                f"mechanism: {what} has the shape {has}; expected {shapes[what]} for {nq} coordinates, {n} speeds and "
                f"{m + k} constraints."
            )


def _require_masses(parts: Parts, names: Names, t: float, y: np.ndarray, tolerance: float) -> None:
    """Raise ValueError if the mass matrix M is not symmetric, or u M u / 2 < 0 for speeds that the constraints allow.

    Directions of speeds count as allowed up to `tolerance`, the ``rank_tolerance`` of the problem.
    """
    M, _, G, _, _ = parts.matrices(names, t, y)
    wrong = np.abs(M - M.T)
    if (wrong > ROUNDING * np.abs(M).max(initial=0.0)).any():
        i, j = np.unravel_index(np.argmax(wrong), M.shape)
        raise ValueError(
            f"mechanism: mass must be a symmetric matrix, but at the start its entries [{i}, {j}] and [{j}, {i}] are "
            f"{M[i, j]:.6g} and {M[j, i]:.6g}. Correct one of them, or give only the diagonal of a diagonal matrix."
        )
    sizes = np.linalg.norm(G, axis=1, keepdims=True)
    _, found, directions = np.linalg.svd(G / np.where(sizes > 0, sizes, 1.0))
    allowed = directions[np.count_nonzero(found > tolerance) :].T
    energies = np.diag(allowed.T @ M @ allowed)
    # In these units the signs do not depend on those of the masses.
    allowed = allowed / np.sqrt(np.where(energies != 0, np.abs(energies), 1.0))
    for u in (allowed @ np.linalg.eigh(allowed.T @ M @ allowed)[1]).T:
        if u @ M @ u < -ROUNDING * (np.abs(u) @ np.abs(M) @ np.abs(u)):
            u = u / u[np.argmax(np.abs(u))]
            shown_speeds = ", ".join(f"{name} = {value:.3g}" for name, value in zip(names.speeds, u, strict=True))
            raise ValueError(
                "mechanism: mass must be positive for motions that the constraints allow, but at the start the kinetic "
                f"energy u M u / 2 is {u @ M @ u / 2:.3g} for {shown_speeds}. Correct the signs of the masses."
            )


def _require_linear(of: Mapping[str, Any], t: float, q: np.ndarray, n: int) -> None:
    """Raise ValueError if a function that must be linear in the speeds is not; those in `of` take (t, y)."""
    one, two = np.random.default_rng(7).uniform(0.5, 1.5, (2, n))
    for what in of.keys() & {"kinematics", "velocity_constraints"}:
        values = [np.asarray(of[what](t, np.append(q, u)), float) for u in (0 * one, one, two, one + two)]
        wrong = np.abs(values[3] - values[1] - values[2] + values[0])
        if not (wrong <= ROUNDING * np.abs(values).max(initial=0.0)).all():
            raise ValueError(
                f"mechanism: {what} must be linear in the speeds, but component {np.argmax(wrong)} of its value is "
                "not. Write it so that the factors of the speeds depend on t and q only."
            )


def _require_derivatives(
    of: Mapping[str, Any], parts: Parts, problem: MechanicsProblem, t: float, longest: float
) -> None:
    """Raise ValueError if a given jacobian or gamma is wrong at a state near the start that meets the constraints.

    The functions in `of` take (t, y). The jacobian is compared along one direction.
    """
    names, values = problem.names, plain(parts.values)
    nq, m, t_end = len(names.coordinates), len(names.positions), None if problem.t_span is None else problem.t_span[1]
    way, found = np.random.default_rng(11).uniform(0.5, 1.5, nq), np.empty(m + len(names.velocities))
    derivatives = {
        "jacobian": (0.0, lambda t, y: way, slice(m), lambda value: value @ way),
        "gamma": (1.0, lambda t, y: parts.matrices(names, t, y)[-1], slice(m, None), lambda value: value),
    }
    for what in of.keys() & derivatives.keys():
        dt, direction, rows, along = derivatives[what]
        for time, y in states_near(t, problem.y0, problem.constraints, problem.fun, nq, t_end):
            difference(values, time, y, dt, direction(time, y), longest, found)
            right = found[rows]
            wrong = np.abs(along(np.asarray(of[what](time, y), float)) - right).max(initial=0.0)
            if not wrong <= DERIVED * max(np.abs(right).max(initial=0.0), np.abs(y[nq:]).max(initial=1e-300)):
                raise ValueError(
                    f"mechanism: {what} differs from the derivatives of the constraints by {wrong:.3g} at a state near "
                    "the start. Correct it, or omit it to have it computed."
                )
