"""Systems of ``eip-scipy bench metric``: rigid bodies, orbits, spins, a molecule, users' functions, random systems."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, EIPRK23, EIPRK45, EIPRKN12, EIPRadau, Invariant, particle_invariants
from eip_scipy.problems import uniform_field
from eip_scipy.problems.gravity.nbody import centre_of_mass

from .cases import CASES
from .families import FAMILIES, System
from .metric_cases import Case, at, njit

STEP, TOLERANCES, LOOSE = (0.1,), (1e-4, 1e-6, 1e-8), (1e-3, 1e-5)
BODIES_NEAR, BODIES, RANDOM, MASSES = 40, 10, 200, np.repeat([16.0, 1.0, 1.0], 3)


def named(**functions: Callable[..., Any]) -> tuple[Invariant, ...]:
    """Return invariants without gradients, as a user gives them."""
    return tuple(Invariant(function, name=name) for name, function in functions.items())


def ways(case: Case, steps: tuple[float, ...], tolerances: tuple[float, ...]) -> Iterator[Case]:
    """Yield a case with fixed steps by EIPRK4 and EIPRK45, and with tolerances by EIPRK45 and EIPDOP853."""
    if steps:
        yield replace(case, steps=steps, methods=(EIPRK4, EIPRK45))
    yield replace(case, name=f"{case.name}, adaptive", steps=tolerances, methods=(EIPRK45, EIPDOP853), adaptive=True)


@njit
def euler(t, y, params):  # type: ignore[no-untyped-def]
    """Return the derivative of the angular momentum of a free body with the moments of inertia `params`."""
    a, b, c = 1 / params
    return np.array([(c - b) * y[1] * y[2], (a - c) * y[2] * y[0], (b - a) * y[0] * y[1]])


def rigid_bodies() -> Iterator[Case]:
    """Yield free bodies that turn near an axis, with their derivatives by the start, and others."""
    kept = named(C=njit(lambda t, y, params: (y * y).sum()), E=njit(lambda t, y, params: (y * y / params).sum()))
    rng = np.random.default_rng(5)
    for k in range(BODIES_NEAR + BODIES):
        near, inertia = k < BODIES_NEAR, np.sort(rng.uniform(0.3, 3.0, 3))
        y0 = rng.permutation([1.0, 0.1, 0.1] * rng.uniform(0.5, 1.5, 3)) if near else rng.standard_normal(3)
        group = "rigid body near an axis" if near else "rigid body"
        options: dict[str, Any] = {"params": inertia}
        case = Case(group, f"{k}", euler, kept, y0, 25.0, (), options=options)
        yield from ways(case, STEP, TOLERANCES)
        if near:
            options = options | {"variations": "state"}
            measured = lambda run: run.stm[-1].ravel()  # noqa: E731
            case = replace(case, group=f"{group}, derivatives", options=options, measured=measured)
            yield from ways(case, STEP, TOLERANCES)


def orbits() -> Iterator[Case]:
    """Yield Kepler's problem in four orientations, Hénon and Heiles's, and Mercury with Jupiter in a plane."""
    functions = CASES["Kepler members"].jitted
    for e, steps in ((0.05, (0.1,)), (0.6, (0.03,)), (0.9, ())):
        for angle in (0.0, 0.4, 0.8, 1.2):
            c, s, v = np.cos(angle), np.sin(angle), np.sqrt((1 + e) / (1 - e))
            y0 = np.array([(1 - e) * c, (1 - e) * s, -v * s, v * c])
            case = Case("Kepler", f"e = {e}, angle {angle}", functions.fun, named(**functions.invariants), y0, 60.0, ())
            yield from ways(case, steps, TOLERANCES)
    functions = CASES["Hénon-Heiles"].jitted
    for q in (-0.2, -0.1, 0.05, 0.2):
        y0 = np.array([0.0, q, np.sqrt(0.16 - q * q + 2 * q**3 / 3), 0.0])
        case = Case("Hénon-Heiles", f"E = 0.08, y = {q}", functions.fun, named(**functions.invariants), y0, 100.0, ())
        yield from ways(case, STEP, TOLERANCES)
    heavy, light = 1e-3, 1e-7

    @njit
    def pulls(t, y):  # type: ignore[no-untyped-def]
        a, b = y[:2], y[2:4]
        d, r3, s3 = a - b, (a @ a) ** 1.5, (b @ b) ** 1.5
        d3 = (d @ d) ** 1.5
        return np.concatenate((y[4:], -a / r3 - heavy * d / d3, -b / s3 + light * d / d3))

    @njit
    def energy(t, y):  # type: ignore[no-untyped-def]
        a, b, u, v = y[:2], y[2:4], y[4:6], y[6:]
        own = light * (0.5 * (u @ u) - 1 / np.sqrt(a @ a)) + heavy * (0.5 * (v @ v) - 1 / np.sqrt(b @ b))
        return own - light * heavy / np.sqrt((a - b) @ (a - b))

    @njit
    def momentum(t, y):  # type: ignore[no-untyped-def]
        return light * (y[0] * y[5] - y[1] * y[4]) + heavy * (y[2] * y[7] - y[3] * y[6])

    for angle in (0.0, 0.4, 0.8, 1.2):
        inner, outer = np.exp(1j * angle), np.exp(2j * angle)
        parts = 0.31 * inner, 5.2 * outer, 1.97j * inner, 0.438j * outer
        y0 = np.array([(z.real, z.imag) for z in parts]).ravel()
        case = Case("Mercury and Jupiter", f"angle {angle}", pulls, named(H=energy, L=momentum), y0, 60.0, ())
        yield from ways(replace(case, measured=at(slice(2))), (0.02,), TOLERANCES)


def eigenstates() -> Iterator[Case]:
    """Yield superpositions of two eigenstates of a chain of five spins, whose norm is kept."""
    J = 0.5 * (np.eye(5, k=1) + np.eye(5, k=-1))
    energies, states = np.linalg.eigh(J)
    rng = np.random.default_rng(3)
    for k in range(8):
        pair = rng.choice(5, 2, replace=False)
        y0, known = (states[:, pair] @ np.exp(-1j * energies[pair] * t) / np.sqrt(2) for t in (0.0, 20.0))
        kept = named(norm=lambda t, y: np.vdot(y, y).real)
        case = Case("eigenstates", f"{k}", lambda t, y: -1j * (J @ y), kept, y0, 20.0, (), known=known)
        yield from ways(case, (), LOOSE)


@njit
def springs(q):  # type: ignore[no-untyped-def]
    """Return the potential and the forces of three atoms on two springs with an angle."""
    a, b = q[3:6] - q[:3], q[6:9] - q[:3]
    r, s = np.sqrt(a @ a), np.sqrt(b @ b)
    cosine = a @ b / (r * s) + 0.25
    bend = cosine - 0.25
    f = 100 * (r - 1) * a / r + 20 * cosine * (b / (r * s) - bend * a / r**2)
    g = 100 * (s - 1) * b / s + 20 * cosine * (a / (r * s) - bend * b / s**2)
    return 50 * (r - 1) ** 2 + 50 * (s - 1) ** 2 + 10 * cosine**2, np.concatenate((f + g, -f, -g))


def molecules() -> Iterator[Case]:
    """Yield three atoms on springs with their energy, or with energy and angular momentum.

    The linear invariants, momentum and centre of mass, are found in both cases.
    """
    masses = MASSES.copy()

    @njit
    def motion(t, y):  # type: ignore[no-untyped-def]
        return np.concatenate((y[9:], springs(y[:9])[1] / masses))

    @njit
    def energy(t, y):  # type: ignore[no-untyped-def]
        return 0.5 * (masses * y[9:] ** 2).sum() + springs(y[:9])[0]

    angular = particle_invariants(MASSES[::3])
    for seed in range(5):
        v = np.random.default_rng(seed).standard_normal(9) * 0.3
        y0 = np.array([0, 0, 0, 1.05, 0, 0, -0.25, 0.95, 0, *v])
        case = Case("molecule", f"E, start {seed}", motion, named(H=energy), y0, 60.0, ())
        yield from ways(case, (), (1e-6, 1e-9))
        kept = (*named(H=energy), *angular)
        yield from ways(replace(case, group="molecule, L", name=f"E and L, start {seed}", kept=kept), (), (1e-6, 1e-9))


def of_users() -> Iterator[Case]:
    """Yield problems of the bench with a user's functions: the paper's particle, kinetics, Mercury, atoms, and more."""
    case = CASES["charged particle"]
    x, y, px, py = uniform_field().reference(case.t_end)[[0, 1, 3, 4]]  # type: ignore[index, misc]
    x, y, u, v = x, y, px + y / 2, py - x / 2

    def centre(y: Any) -> np.ndarray:
        return np.array([y[0] + y[3], y[1] - y[2]])

    def of(name: str, steps: tuple[float, ...], methods: tuple[Any, ...], adaptive: bool = False, **more: Any) -> Case:
        own = CASES[name]
        functions = own.jitted
        kept = named(**functions.invariants)
        given: dict[str, Any] = {"known": own.end, "measured": at(slice(own.end.size))} | more
        return Case("users' functions", name, functions.fun, kept, own.y0, own.t_end, steps, methods, adaptive, **given)

    known = centre([x, y, u, v])
    yield of("charged particle", (np.pi / 10,), (EIPRK4,), known=known, measured=lambda run: centre(run.y[:, -1]))
    yield of("Robertson", (1e-3, 1e-5), (EIPRadau,), True, options={"atol": 1e-6})
    bodies = CASES["ten bodies, 100 years"]
    options: dict[str, Any] = {"every": 10, "blocks": 3, "linear_invariants": centre_of_mass(bodies.gm, 1.0)}
    seen: dict[str, Any] = {"known": bodies.end[3:6], "measured": at(slice(3, 6))}
    yield of(bodies.name, (0.02,), (EIPRKN12,), options=options, **seen)
    for name in ("perturbed Kepler", "Hénon-Heiles", "double pendulum", "halo orbit", "rigid body"):
        yield of(name, TOLERANCES, (EIPRK45, EIPDOP853), True)


def at_random() -> Iterator[Case]:
    """Yield random systems, each with some of what it keeps, a method, and a tolerance or a step."""
    for seed in range(RANDOM):
        rng = np.random.default_rng([22, seed])
        system: System = FAMILIES[rng.integers(len(FAMILIES))](rng)
        chosen = [kept for kept in system.kept if rng.random() < 0.6] or [system.kept[0]]
        kept = tuple(Invariant(item.fun, item.grad, name=item.name) for item in chosen)
        end = 10.0
        known = system.exact(end) if system.exact else None
        method = (EIPRK4, EIPRK23, EIPRK45, EIPDOP853)[rng.integers(4)]
        step = 0.03 if method is EIPRK4 else 10 ** -rng.uniform(3, 5 if method is EIPRK23 else 8)
        name = f"{seed}: {system.name}, {' '.join(item.name for item in chosen)}"
        adaptive = method is not EIPRK4
        yield Case("random", name, system.fun, kept, system.y0, end, (step,), (method,), adaptive, known=known)


def cases() -> Iterator[Case]:
    """Yield all cases of this module."""
    for group in (rigid_bodies, orbits, eigenstates, molecules, of_users, at_random):
        yield from group()
