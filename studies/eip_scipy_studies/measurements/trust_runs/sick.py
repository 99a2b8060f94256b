"""Faulty runs, which must be reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eip_scipy import Invariant
from eip_scipy.problems import (
    Grid,
    GrossPitaevskii,
    Problem,
    kepler,
    nbody,
    pythagorean,
    solar_system,
)

from ...condensates.problems import harmonic_trap
from ...hard_cases import (
    boris_2d,
    double_pendulum,
    heisenberg,
    lotka_volterra,
    n_body,
    quaternion,
    rigid_body,
    schwarzschild,
    sir,
    three_wave,
)
from ...report import needed
from . import systems as s
from .late import late_leaks, light_bodies
from .record import Run, runs

njit = needed("numba", '"eip_scipy[numba]"').njit

REST, MOVING, LEAK, GRADIENT, LONG, BLOWN, MEMBER = (
    "no invariant, its rate 0 at the start",
    "no invariant, its rate seen at the start",
    "leak",
    "wrong gradient",
    "step too long",
    "blown-up passage",
    "faulty members among correct ones",
)


def sick_runs() -> list[Run]:
    """Return all faulty runs."""
    every = [with_friction, false_invariants, visible, leaks, late_leaks, gradients, long_steps, light_bodies, blown]
    every += [members, rising_friction]
    return [run for part in every for run in part()]


# --- quantities that are not invariants ---


def driven(t, q, v):
    return -q + 0.5 * np.sin(1.3 * t)


def parametric(t, q, v):
    return -q * (1 + 0.3 * np.sin(2 * t))


def late_friction(t, q, v):
    return -np.sin(q) - 0.3 * v * max(0.0, t - 3.0) / (1 + max(0.0, t - 3.0))


def far_friction(t, q, v):
    return -q - 0.5 * v * np.maximum(0.0, q - 0.5) ** 2


def uniform_on_axis() -> Problem:
    return s.central(lambda t, y: np.array([0.02, 0.0]), [1.0, 0.0, 0.0, 1.1], 20.0, s.turning())


def precessing() -> Problem:
    return s.central(lambda t, y: -0.01 * y[:2] / np.hypot(y[0], y[1]) ** 5, [0.5, 0.0, 0.0, 1.7], 20.0, s.laplace_x())


def losing_mass() -> Problem:
    return s.central(
        lambda t, y: np.sin(0.01 * t) * y[:2] / np.hypot(y[0], y[1]) ** 3, [0.5, 0.0, 0.0, 1.7], 20.0, s.kepler_energy()
    )


def wrong_masses() -> Problem:
    return s.chain(
        lambda d: d, lambda d: d * d / 2, lambda d: d, [1.0, 0.0, 0.0], 20.0, masses=np.array([1.0, 2.0, 3.0])
    )


def spin_in_turning_field() -> Problem:
    def fun(t, y):
        return np.cross(y, np.array([np.sin(t), 0.0, 1.0]))

    return s.claimed(
        fun,
        [0.6, 0.0, 0.8],
        20.0,
        Invariant(lambda t, y: float(y[2]), lambda t, y: np.array([0.0, 0.0, 1.0]), name="S_z"),
    )


def braked_top() -> Problem:
    top = rigid_body(1.0, 2.0, 3.0)
    return s.claimed(
        lambda t, y: top.fun(t, y) - 0.1 * np.array([y[0], 0.0, 0.0]),
        [0.0, 1.0, 1.0],
        20.0,
        Invariant(top.values, top.gradients, name="I"),
    )


def driven_particle() -> Problem:
    system = boris_2d(0.01)

    def fun(t, y):
        return system.fun(t, y) + np.array([0.0, 0.0, 0.1 * np.sin(t), 0.0])

    return s.claimed(
        fun,
        [1.0, 0.0, 0.1, 0.3],
        20.0,
        Invariant(lambda t, y: system.values(t, y)[0], lambda t, y: system.gradients(t, y)[0], name="energy"),
    )


def particle_turning() -> Problem:
    return s.claimed(boris_2d(0.01).fun, [1.0, 0.0, 0.0, 0.3], 3.0, s.turning())


def trap_turning() -> Problem:
    return s.claimed(lambda t, y: np.array([y[2], y[3], -y[0], -2.0 * y[1]]), [1.0, 0.0, 0.0, 0.5], 20.0, s.turning())


def henon_turning() -> Problem:
    hh = s.henon_heiles()
    return replace(hh, y0=np.array([0.0, 0.3, 0.3, 0.0]), invariants=(s.turning(),), t_span=(0.0, 20.0))


def two_false() -> Problem:
    """Return a system with a correct energy and a wrong angular momentum."""
    hh = s.henon_heiles()
    return replace(hh, y0=np.array([0.0, 0.3, 0.3, 0.0]), invariants=(*hh.invariants, s.turning()), t_span=(0.0, 20.0))


def wrong_wave_relation() -> Problem:
    right = three_wave()
    wrong = Invariant(
        lambda t, y: float(abs(y[0]) ** 2 - abs(y[2]) ** 2), lambda t, y: 2 * np.array([y[0], 0, -y[2]]), name="N"
    )
    return s.claimed(right.fun, np.array([1.0, 0.7, 0.4]) + 0j, 10.0, wrong)


def absorbed() -> Problem:
    return s.waves(
        10.0,
        potential=lambda t, x: x**2 / 2 - 0.5j * np.exp(-((x + 5) ** 2)),
        keep=("mass",),
        start=lambda x: np.exp(-((x - 3) ** 2)),
    )


def shaken() -> Problem:
    return s.waves(5.0, potential=lambda t, x: x**2 / 2 + 0.3 * x * np.sin(t))


def half_beta(start: Callable[[np.ndarray], np.ndarray] = lambda x: np.exp(-((x - 1) ** 2) / 2)) -> Problem:
    return s.waves(5.0, beta=5.0, claimed_beta=2.5, start=start)


def other_trap() -> Problem:
    return s.waves(5.0, claimed_potential=lambda x: 0.45 * x**2)


def wrong_joint() -> Problem:
    """Return a condensate that is shaken from t = 0 on, with the mass and energy of one that is not shaken."""
    grid = Grid((16, 16), -4.0, 4.0)
    x, y = grid.mesh()
    psi = np.exp(-((x - 0.5) ** 2 + y**2) / 2)
    resting = GrossPitaevskii(grid, harmonic_trap(1.0, 1.0), beta=10.0).problem(psi, 2.0, 4e-3, name="condensate")
    return replace(resting, fun=lambda t, psi: resting.fun(t, psi) - 1j * np.sin(t) * (x + 0 * y).ravel() * psi)


FALLING = np.array([[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]])


def falling_bodies(third: float = 5.0, softening: float = 0.0) -> Problem:
    """Return three bodies that fall from rest, with the energy for the mass `third` of the third one and no softening.

    In the equations of motion this mass is 5, and `softening` is added to squared distances.
    """
    masses = np.array([3.0, 4.0, 5.0])
    other = n_body([3.0, 4.0, third], 1.0, 2)

    def fun(t, y):
        q = y[:6].reshape(3, 2)
        d = q[:, None] - q[None, :]
        r2 = (d * d).sum(axis=-1) + softening
        np.fill_diagonal(r2, 1.0)
        return np.concatenate([y[6:], -np.einsum("j,ij,ijk->ik", masses, r2**-1.5, d).ravel()])

    return s.claimed(
        fun,
        np.concatenate([FALLING.ravel(), np.zeros(6)]),
        1.5,
        Invariant(lambda t, y: other.values(t, y)[0], lambda t, y: other.gradients(t, y)[0], name="energy"),
    )


def late() -> Problem:
    return s.mechanics(late_friction, lambda q: -np.cos(q[0]), np.sin, 2.0, 0.0, 20.0)


def relativistic_planets() -> Problem:
    """Return planets with post-Newtonian terms, and Newton's energy and angular momentum as invariants."""
    planets = solar_system(years=1.0, forces="1pn")
    masses = solar_system().params
    assert masses is not None
    newton = n_body(masses.tolist(), 1.0, 3)
    energy = Invariant(
        lambda t, y, *_: newton.values(t, y)[0], lambda t, y, *_: newton.gradients(t, y)[0], name="energy"
    )
    return replace(planets, invariants=(energy,), reference=None)


def other_ratio() -> Problem:
    return s.equations(sir(0.5, 0.2), [0.9, 0.1, 0.0], 30.0, sir(0.5, 0.25))


def moving_packet(x: np.ndarray) -> np.ndarray:
    return np.exp(-((x - 1) ** 2) / 2 + 1j * x**2)


def other_norm() -> Problem:
    return s.claimed(
        quaternion(1.0).fun,
        [1.0, 0.2, 0.3, 0.0],
        20.0,
        Invariant(lambda t, y: y @ y - 0.1 * y[1] ** 2, lambda t, y: 2 * y * [1, 0.9, 1, 1], name="norm"),
    )


def spin_sum() -> Problem:
    start = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.8, 0.6]]).ravel()
    return s.claimed(
        heisenberg(0.5).fun,
        start,
        10.0,
        Invariant(lambda t, y: y[::3].sum(), lambda t, y: np.tile([1.0, 0.0, 0.0], 4), name="S_x"),
    )


# --- leaks ---


def dragged(drag: float) -> Problem:
    """Return a satellite that starts at rest relative to the air of a rotating planet: the drag is 0 at first."""

    def extra(t, y):
        return -drag * (y[2:] - 1.2 * np.array([-y[1], y[0]]))

    return s.central(extra, [1.0, 0.0, 0.0, 1.2], 30.0, s.kepler_energy())


def lossy() -> Problem:
    return s.waves(
        10.0,
        potential=lambda t, x: x**2 / 2 - 1e-3j * np.maximum(x, 0) ** 2,
        keep=("mass",),
        start=lambda x: np.exp(-((x + 3) ** 2)),
    )


# --- gradients ---


def scaled(factor: float) -> Problem:
    hh = s.henon_heiles(v0=(0.1, 0.2))
    (energy,) = hh.invariants
    return replace(hh, invariants=(Invariant(energy.fun, lambda t, y: factor * energy.grad(t, y), name="energy"),))


def missing(G, k, m):
    G[k] = 0.0


def mirrored(G, k, m):
    G[k] *= -1.0


def tripled(G, k, m):
    G[k] *= 3.0


def permuted(G, k, m):
    G[:] = np.roll(G, 1)


def swapped(G, k, m):
    G[[k, m]] = G[[m, k]]


def spoilt(spoil: Callable[..., None], y0: Any, problem: Problem | None = None, k: int = 1, m: int = 2) -> Problem:
    """Return a problem with a correct energy and a wrong gradient, changed by ``spoil(gradient, k, m)``.

    `k` and `m` are indices of components of the gradient. If `problem` is None, it is the system of Hénon and Heiles
    with the start `y0`; otherwise `y0` is not used.
    """
    problem = problem or replace(s.henon_heiles(), y0=np.array(y0), t_span=(0.0, 10.0))
    (energy,) = problem.invariants

    def gradient(t, y):
        G = np.array(energy.grad(t, y))
        spoil(G, k, m)
        return G

    return replace(problem, invariants=(Invariant(energy.fun, gradient, name="energy"),))


def sleeping(spoil: Callable[..., None], k: Any = 4, m: Any = 10) -> Problem:
    """Return a chain that moves at one end, with a wrong gradient at the other, where y_k = f_k = 0 at first.

    The parameters are those of `spoilt`.
    """
    chain = s.chain(np.expm1, lambda d: np.expm1(d) - d, np.expm1, [0.8, 0.0, 0.0, 0.0, 0.0, 0.0], 20.0)
    return spoilt(spoil, None, chain, k, m)


# Components of the chain that are at rest in 0 at the start, and a start of Henon and Heiles that is at rest nowhere.
SLEEPING = [2, 3, 4, 5, 8, 9, 10, 11]
MOVING_START = (1.0, 0.5, 0.3, 0.2)


def conjugated() -> Problem:
    return respelt(lambda G: np.conj(G))


def doubled() -> Problem:
    return respelt(lambda G: 2 * G)


def respelt(change: Callable[[np.ndarray], np.ndarray]) -> Problem:
    waves = s.waves(2.0, start=lambda x: np.exp(-((x - 1) ** 2) / 2 + 1j * x))
    mass, energy = waves.invariants
    return replace(
        waves, invariants=(mass, Invariant(energy.fun, lambda t, y: change(energy.grad(t, y)), name="energy"))
    )


# --- steps too long, passages that blow up ---


def from_apocentre() -> Problem:
    e = 0.99
    y0 = np.array([-(1 + e), 0.0, 0.0, -np.sqrt((1 - e) / (1 + e))])
    return replace(kepler(e, 0.0, 30.0), y0=y0, reference=None)


def stiff_chain() -> Problem:
    return s.chain(lambda d: 1e4 * d, lambda d: 5e3 * d * d, lambda d: 1e4 * d, [0.1, 0.0, 0.0], 10.0)


def until(make: Callable[[], Problem], end: float) -> Problem:
    return replace(make(), t_span=(0.0, end))


def meeting() -> Problem:
    """Return two bodies that fall together from rest, nearly head on."""
    return nbody(
        [1.0, 1.0], [[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]], [[0.0, 0.02, 0.0], [0.0, -0.02, 0.0]], t_span=(0.0, 3.0)
    )


def other_gravity(g: float) -> Problem:
    return s.equations(double_pendulum(9.81), [2.0, 1.0, 0.0, 0.0], 5.0, double_pendulum(g))


def other_inertia() -> Problem:
    return s.equations(rigid_body(1.0, 2.0, 3.0), [0.0, 1.0, 1.0], 20.0, rigid_body(1.0, 2.0, 2.5))


def other_coefficient() -> Problem:
    """Return predators and prey that start at u = 1, where the rate of the predators is 0, with a wrong invariant.

    The invariant has the coefficient 3 in place of 2.
    """
    return s.claimed(
        lotka_volterra().fun,
        [1.0, 3.0],
        15.0,
        Invariant(
            lambda t, y: np.log(y[0]) - y[0] + 3 * np.log(y[1]) - y[1],
            lambda t, y: np.array([1 / y[0] - 1, 3 / y[1] - 1]),
            name="V",
        ),
    )


def falling_probe() -> Problem:
    """Return a geodesic in Schwarzschild's metric that starts at a turning point, with a wrong mass shell.

    The mass shell is that at 1.1 times the radius.
    """
    shell, scale = schwarzschild(), np.array([1, 1.1, 1, 1, 1, 1])

    def value(t, y):
        return shell.values(t, y * scale)[0]

    def gradient(t, y):
        return scale * shell.gradients(t, y * scale)[0]

    return s.claimed(shell.fun, [0.0, 10.0, 0.0, 0.97, 0.0, 4.0], 300.0, Invariant(value, gradient, name="shell"))


@njit
def leaves(t, y, params):
    return y[0] + 0.99


def turns_back(t: float, y: np.ndarray) -> Any:
    return y[1] - 1e-3


DIRECTIONS: tuple[tuple[Any, float], ...] = ((leaves, -1.0), (turns_back, 1.0))
for event, direction in DIRECTIONS:
    event.terminal, event.direction = True, direction


def with_friction() -> Iterator[Run]:
    at_rest = partial(runs, REST)
    friction = partial(s.pendulum, 0.2), partial(s.compiled_pendulum, 0.2)
    yield from at_rest(
        "pendulum with friction 0.2",
        friction[0],
        "RK45 1e-3, RK45 1e-4, RK45 1e-8, DOP853 1e-6, RK23 1e-5, RK5 1e-6, RK5 h=0.05, RK4 h=0.05, "
        "RK3 h=0.05, RK2 h=0.05, RK1 h=0.01, RK4 h=0.05 metric=euclidean, RK4 h=0.05 every=10, "
        "RK4 h=0.05 every=auto, RK4 h=0.05 direction=old, RK4 h=0.05 iterations=3, "
        "RK4 h=0.05 interpreted",
    )
    yield from at_rest(
        "pendulum with friction 0.2",
        friction[1],
        "RK4 h=0.05 integrate, RK45 1e-6 integrate, RK4 h=0.05 compensated integrate, "
        "RK2 h=0.05 integrate, RK1 h=0.01 integrate",
    )
    yield from at_rest(
        "pendulum with friction 0.2, Verlet's method",
        friction[0],
        "user h=0.02",
        user=s.Verlet(lambda t, q, v: -np.sin(q) - 0.2 * v),
    )
    yield from at_rest(
        "pendulum with friction 0.2, an event ends it",
        friction[0],
        "RK45 1e-8, RK45 1e-8 interpreted",
        events=turns_back,
    )
    yield from at_rest(
        "pendulum with friction 0.2, an event ends it", friction[1], "RK4 h=0.05 integrate", events=leaves
    )


def false_invariants() -> Iterator[Run]:
    at_rest = partial(runs, REST)
    wrong_sign = partial(s.pendulum, 0.0, -1.0)
    yield from at_rest("pendulum, sign of the potential", wrong_sign, "RK45 1e-6, RK4 h=0.05")
    yield from at_rest("Duffing without its quartic term", partial(s.duffing, 0.0), "RK45 1e-6")
    yield from at_rest("Duffing, quartic term 5 % off", partial(s.duffing, 1.05, end=5.0), "DOP853 1e-8")
    yield from at_rest("Henon-Heiles without its cubic terms", partial(s.henon_heiles, 0.0), "RK45 1e-6")
    yield from at_rest("driven spring", partial(s.spring, driven, 1.0, 0.3), "RK45 1e-6, RK23 1e-4")
    pushed = partial(s.compiled_spring, force=0.5, frequency=1.3, y0=(1.0, 0.3))
    yield from at_rest(
        "driven spring",
        pushed,
        "RK4 h=0.05 integrate, RKN12 h=0.1 integrate, RKN12 h=0.05 every=10 compensated integrate, "
        "RKN8 h=0.05 every=auto integrate",
    )
    yield from at_rest(
        "spring of changing stiffness",
        partial(s.spring, parametric),
        "RK45 1e-6, RKN12 h=0.3, RKN12 h=0.1 every=10, RKN8 1e-6",
    )
    yield from at_rest("friction from t = 3 on", late, "RK45 1e-6, RK4 h=0.02")
    yield from at_rest("friction on one side only", partial(s.spring, far_friction, 0.0, 1.5), "RK45 1e-6")
    yield from at_rest("fall with drag 0.1", partial(s.falling, 0.1), "RK45 1e-6, RK3 h=0.1")
    yield from at_rest("L in an anisotropic trap", trap_turning, "RK45 1e-6, RK4 h=0.05, RKN8 1e-6")
    yield from at_rest(
        "L in an anisotropic trap",
        partial(s.compiled_trap, 2.0),
        "RK45 1e-6 integrate, RKN12 h=0.1 integrate, RK4 h=0.02 integrate",
    )
    yield from at_rest("L of Henon-Heiles, started at x = 0", henon_turning, "DOP853 1e-6")
    yield from at_rest("L of Henon-Heiles and its energy", two_false, "RK45 1e-6")
    yield from at_rest("L in a uniform field, started on its axis", uniform_on_axis, "RK45 1e-6")
    yield from at_rest("Laplace's vector of a precessing orbit", precessing, "RK45 1e-6, RK4 h=0.01")
    yield from at_rest("energy while the centre loses mass", losing_mass, "RK45 1e-7")
    yield from at_rest("springs with wrong masses", wrong_masses, "RK45 1e-6")
    yield from at_rest("Toda lattice, harmonic energy", partial(s.toda, True), "RK45 1e-6, RK4 h=0.05")
    yield from at_rest("FPUT chain, another alpha", partial(s.fput, 0.25, 0.5), "RK45 1e-6")
    yield from at_rest("sine-Gordon, another coupling", partial(s.sine_gordon, 0.9, 32, 5.0), "DOP853 1e-6")
    yield from at_rest("spin in a turning field, S_z", spin_in_turning_field, "RK45 1e-6")
    yield from at_rest("braked top", braked_top, "RK45 1e-6")
    yield from at_rest("particle in a field that is switched on", driven_particle, "RK4 h=0.02")
    yield from at_rest("particle, L without the field's part", particle_turning, "RK45 1e-5, RK4 h=0.02")
    yield from at_rest("three waves, a relation's sign", wrong_wave_relation, "RK45 1e-6, RK4 h=0.02")
    yield from at_rest("Schroedinger, absorbing wall", absorbed, "RK45 1e-6")
    yield from at_rest("Schroedinger, shaken trap", shaken, "RK45 1e-6, RK4 h=4e-3")
    yield from at_rest("Schroedinger, another trap's energy", other_trap, "RK45 1e-6")
    yield from at_rest("condensate, half the interaction", half_beta, "DOP853 1e-6, RK4 h=4e-3 metric=euclidean")
    yield from at_rest("condensate, shaken, joint invariants", wrong_joint, "RK4 interpreted, RK45 1e-6")
    yield from at_rest("falling bodies, a wrong mass", partial(falling_bodies, 5.5), "RK45 1e-6")
    yield from at_rest(
        "softened bodies, energy without softening",
        partial(falling_bodies, 5.0, 0.09),
        "RK45 1e-6, RKN12 h=0.02 every=10",
    )
    yield from at_rest("double pendulum, g = 9 for 9.81", partial(other_gravity, 9.0), "RK45 1e-6")
    yield from at_rest("top with another inertia", other_inertia, "RK45 1e-6")
    yield from at_rest("Lotka-Volterra, another coefficient", other_coefficient, "RK45 1e-6")
    yield from at_rest("geodesic with a wrong mass", falling_probe, "RK45 1e-6")


def visible() -> Iterator[Run]:
    seen = partial(runs, MOVING)
    yield from seen("pendulum with friction 0.2", partial(s.pendulum, 0.2, v0=1.0), "RK45 1e-6, RK4 h=0.05")
    yield from seen(
        "pendulum with friction 0.2", partial(s.compiled_pendulum, 0.2, y0=(2.0, 1.0)), "RK4 h=0.05 integrate"
    )
    yield from seen("fall with drag 0.1", partial(s.falling, 0.1, -1.0), "RK45 1e-6")
    yield from seen("Toda lattice, harmonic energy", partial(s.toda, True, moving=True), "DOP853 1e-6")
    yield from seen("epidemic, another ratio", other_ratio, "RK45 1e-6")
    yield from seen("attitude, another norm", other_norm, "RK45 1e-6")
    yield from seen("spins, S_x across the axis", spin_sum, "RK45 1e-6")
    yield from seen("condensate, half the interaction", partial(half_beta, moving_packet), "RK45 1e-6")


def leaks() -> Iterator[Run]:
    leak = partial(runs, LEAK)
    ways = {
        1e-2: "RK45 1e-4 atol=1e-4, RK45 1e-5, RK23 1e-4",
        1e-3: "RK45 1e-6, RK45 1e-7, DOP853 1e-6, RK23 1e-6, RK5 1e-6, RK4 h=0.02, RK4 h=0.02 every=10",
        1e-4: "RK45 1e-8, DOP853 1e-8, RK4 h=0.02",
        1e-5: "RK45 1e-9, DOP853 1e-9",
        1e-6: "DOP853 1e-10",
    }
    for friction, how in ways.items():
        yield from leak(f"pendulum with friction {friction:g}", partial(s.pendulum, friction), how)
    yield from leak(
        "pendulum with friction 0.001",
        partial(s.compiled_pendulum, 1e-3, 50.0),
        "RK45 1e-6 integrate, DOP853 1e-8 integrate, RK4 h=0.02 integrate, RK4 h=0.02 compensated every=10 integrate",
    )
    yield from leak(
        "spring with friction 1e-5", partial(s.compiled_spring, friction=1e-5, end=2000.0), "RK4 h=0.01 integrate"
    )
    yield from leak("fall with drag 0.01", partial(s.falling, 1e-2), "RK45 1e-5")
    pushed = partial(s.compiled_spring, force=1e-4, frequency=1.0, end=100.0)
    yield from leak(
        "spring pushed by 1e-4",
        pushed,
        "RKN12 h=0.1 integrate, RKN12 h=0.1 every=10 compensated integrate, RKN8 1e-8 integrate",
    )
    yield from leak("satellite with drag 0.001", partial(dragged, 1e-3), "RK45 1e-6, DOP853 1e-8")
    yield from leak("satellite with drag 1e-5", partial(dragged, 1e-5), "DOP853 1e-9")
    yield from leak(
        "post-Newtonian planets, Newton's energy", relativistic_planets, "DOP853 1e-10, DOP853 h=0.01 integrate"
    )
    yield from leak("Schroedinger, loss of 0.001", lossy, "RK45 1e-6")
    yield from leak("sine-Gordon with friction 0.001", partial(s.sine_gordon, friction=1e-3), "RK45 1e-6")


def gradients() -> Iterator[Run]:
    wrong = partial(runs, GRADIENT)
    for factor in (2.0, -1.0, 0.9):
        yield from wrong(f"times {factor:g}", partial(scaled, factor), "RK45 1e-6")
    yield from wrong("times 2", s.spring_of_doubled_gradient, "RK4 h=0.02 integrate")
    yield from wrong("a component missing", partial(spoilt, missing, MOVING_START), "RK45 1e-6")
    yield from wrong("a component's sign", partial(spoilt, mirrored, MOVING_START), "RK45 1e-6, RK4 h=0.02")
    yield from wrong("components permuted", partial(spoilt, permuted, MOVING_START), "RK45 1e-6")
    yield from wrong("complex, the conjugate", conjugated, "RK45 1e-6")
    yield from wrong("complex, times 2", doubled, "RK4 h=4e-3")
    for what, spoil in (("missing", missing), ("of the wrong sign", mirrored), ("times 3", tripled)):
        yield from wrong(
            f"a component {what}, 0 at the start", partial(sleeping, spoil), "RK45 1e-6, RK4 h=0.05, DOP853 1e-8"
        )
    for what, spoil in (("of the wrong sign", mirrored), ("times 3", tripled)):
        yield from wrong(
            f"most of them {what}, 0 at the start", partial(sleeping, spoil, SLEEPING), "RK45 1e-4, RK4 h=0.1"
        )
    yield from wrong("components swapped, 0 at the start", partial(sleeping, swapped), "RK45 1e-6")


def long_steps() -> Iterator[Run]:
    too_long = partial(runs, LONG)
    yield from too_long(
        "y'' = -y",
        partial(s.compiled_spring, end=60.0),
        "RK4 h=3, RK4 h=2.5, RK4 h=3 integrate, RK3 h=2, RK2 h=1.5, RK1 h=1, RK5 h=3, "
        "RK4 h=3 metric=euclidean, RK4 h=3 every=10, RKN8 h=5, RKN12 h=8 integrate",
    )
    yield from too_long(
        "a spring of frequency 1e4",
        partial(s.compiled_spring, 1e8, end=2.0),
        "RK4 h=0.1 integrate, RK4 h=1e-3 integrate, RK4 h=4e-4 integrate, RKN12 h=0.01 integrate, "
        "RK4 h=0.1 compensated integrate, RK4 h=0.01 interpreted",
        truth=False,
    )
    yield from too_long("pendulum", partial(s.pendulum, end=100.0), "RK45 1 atol=1, RK4 h=2.5")
    yield from too_long(
        "Kepler, e = 0.6",
        partial(kepler, 0.6, 0.0, 60.0),
        "RK45 1 atol=1, DOP853 1 atol=1 integrate, RK4 h=1, RKN12 h=2",
    )
    yield from too_long(
        "Kepler, e = 0.99, over the pericentre",
        partial(kepler, 0.99, 0.0, 30.0),
        "RK4 h=0.1, RK4 h=0.03, RK5 h=0.05 integrate, RKN12 h=0.05, RKN12 h=0.2 every=10",
    )
    yield from too_long(
        "Kepler, e = 0.99, from the apocentre", from_apocentre, "RK4 h=0.1, RK4 h=0.3, RKN12 h=0.1 integrate"
    )
    yield from too_long("stiff chain", stiff_chain, "RK4 h=0.05, RK45 10 atol=10", truth=False)
    yield from too_long(
        "Schroedinger, beyond stability", partial(s.waves, 2.0), "RK4 h=0.05, RK4 h=0.05 metric=euclidean"
    )


def blown() -> Iterator[Run]:
    far = partial(runs, BLOWN)
    yield from far(
        "Pythagorean bodies",
        pythagorean,
        "RKN12 h=0.01 integrate, RK4 h=1e-3 integrate, RKN12 h=0.01 every=10 compensated integrate, "
        "RK4 h=5e-3 metric=euclidean integrate",
    )
    yield from far(
        "Pythagorean bodies", partial(until, pythagorean, 20.0), "RKN12 h=0.01, RKN8 h=5e-3, RK45 0.1 atol=0.1"
    )
    yield from far("two bodies that meet", meeting, "RK4 h=0.01, RKN12 h=0.02 integrate, RK4 h=0.01 metric=euclidean")
    yield from far(
        "solar system, steps of 5 and 13 weeks",
        partial(solar_system, years=100.0),
        "RK4 h=0.1 integrate, RKN12 h=0.25 integrate",
    )


def members() -> Iterator[Run]:
    one = partial(runs, MEMBER)
    friction, many, squares = np.zeros((20, 1)), np.zeros((2000, 1)), np.tile([1.0, 0.0, 0.0, 1.0], (10, 1))
    friction[7], many[[3, 1000, 1999]], squares[4, 0] = 0.2, 0.2, 1e8
    yield from one(
        "one with friction of 20",
        s.bare_pendulum,
        "RK4 h=0.05 ensemble, RK45 1e-6 ensemble",
        sick=(7,),
        params=friction,
    )
    yield from one(
        "one with friction of 20, interpreted",
        s.bare_pendulum,
        "RK4 h=0.05 ensemble",
        sick=(7,),
        params=friction,
        compiled=False,
    )
    yield from one(
        "three with friction of 2000, in vectors",
        partial(s.bare_pendulum, 200.0),
        "RK4 h=0.02 ensemble",
        sick=(3, 1000, 1999),
        params=many,
    )
    yield from one(
        "one too stiff of 10",
        s.bare_spring,
        "RK4 h=0.05 ensemble",
        sick=(4,),
        params=squares,
        y0s=np.linspace([0.9, 0.0], [1.1, 0.0], 10),
    )
    orbits, crowd = (kepler(0.3, 0.0).y0 * (1 + 1e-5 * np.arange(count)[:, None]) for count in (10, 2000))
    orbits[6] = crowd[[5, 1500]] = kepler(0.99, 0.0).y0
    yield from one(
        "one with e = 0.99 of 10", partial(kepler, 0.3, 0.0, 60.0), "RK4 h=0.05 ensemble", sick=(6,), y0s=orbits
    )
    yield from one(
        "two with e = 0.99 of 2000, in vectors",
        partial(kepler, 0.3, 0.0, 200.0),
        "RK4 h=0.05 ensemble",
        sick=(5, 1500),
        y0s=crowd,
    )


def rising_friction() -> Iterator[Run]:
    one = partial(runs, MEMBER)
    rising = np.zeros((8, 1))
    rising[1:, 0] = np.geomspace(1e-4, 0.1, 7)
    yield from one(
        "all but the first, with friction from 1e-4 to 0.1",
        s.bare_pendulum,
        "RK2 h=0.02 ensemble, RK4 h=0.02 ensemble, RK5 h=0.02 ensemble, RK45 1e-6 ensemble",
        sick=tuple(range(1, 8)),
        params=rising,
    )
    yield from one(
        "the same among 20000, in vectors",
        s.bare_pendulum,
        "RK2 h=0.02 ensemble, RK4 h=0.02 ensemble",
        sick=tuple(range(1, 8)),
        params=np.concatenate([rising, np.zeros((19992, 1))]),
    )
    yield from one(
        "all of 10 with friction 0.001",
        s.bare_pendulum,
        "RK45 1e-7 ensemble",
        sick=tuple(range(10)),
        params=np.full((10, 1), 1e-3),
        y0s=np.linspace([1.0, 0.0], [2.0, 0.0], 10),
    )
