"""Gradients that are made of the components of f: where they hold, where they do not, and what happens after a change.

Energies of chains and other systems are given without a gradient. Runs with gradients by hand, or by dual
numbers, tell what is right.
"""

import copy

import numpy as np
import pytest
from systems import lotka_volterra

from eip_scipy import EIPDOP853, EIPRK4, EIPRKN12, Invariant, check_gradient, integrate, solve_ivp

N = 13  # coordinates of a chain: 26 components, more than two passes of dual numbers
RNG = np.random.default_rng(4)
MASSES = RNG.uniform(0.5, 3.0, N)
CHARGES = np.where(np.arange(N) % 2, -1.0, 1.0) * RNG.uniform(0.5, 1.5, N)
Q0, V0 = 0.4 * RNG.standard_normal(N), 0.4 * RNG.standard_normal(N)
FROM_F = "is made of the components of f"
REFUTED = "until a projection missed"

# Potentials of a chain with fixed ends, as functions of (t, q), and their slopes by hand.
PAIRS = {
    "springs": (lambda d: d**2 / 2, lambda d: d),
    "FPUT": (lambda d: d**2 / 2 + d**4 / 4, lambda d: d + d**3),
    "Toda": (lambda d: np.exp(d) - d - 1, lambda d: np.exp(d) - 1),
    "Morse": (lambda d: (1 - np.exp(-0.5 * d)) ** 2, lambda d: (1 - np.exp(-0.5 * d)) * np.exp(-0.5 * d)),
    "hyperbolic": (lambda d: np.log(np.cosh(d)), lambda d: np.tanh(d)),
    "hard": (lambda d: np.sqrt(1 + d**2), lambda d: d / np.sqrt(1 + d**2)),
}
SITES = {
    "free": (lambda t, q: 0.0 * q, lambda t, q: 0.0 * q),
    "pendulums": (lambda t, q: 1 - np.cos(q), lambda t, q: np.sin(q)),
    "wells": (lambda t, q: q**4 / 4 - q**2 / 2, lambda t, q: q**3 - q),
    "charges": (lambda t, q: 0.3 * CHARGES * q, lambda t, q: 0.3 * CHARGES + 0.0 * q),
}
ONES = np.ones(N)


def chain(pair, site, masses=ONES, momenta=False, factor=1.0, turn=0.0, drag=0.0):
    """f and H of a chain with velocities or momenta; `turn` adds a force at right angles to the velocity."""
    (V, dV), (U, dU) = PAIRS[pair], SITES[site]

    def fun(t, y):
        q, w = y[:N], y[N:]
        d = np.diff(np.concatenate([np.zeros(1), q, np.zeros(1)]))
        force = np.diff(dV(d)) - dU(t, q)
        v = w / masses if momenta else w
        force = force - drag * v
        force[0] += turn * v[1]
        force[1] -= turn * v[0]
        return np.concatenate([v, force if momenta else force / masses])

    def energy(t, y):
        q, w = y[:N], y[N:]
        d = np.diff(np.concatenate([np.zeros(1), q, np.zeros(1)]))
        kinetic = w * w / (2 * masses) if momenta else masses * w * w / 2
        return factor * (kinetic.sum() + V(d).sum() + U(t, q).sum())

    return fun, energy


def start(momenta=False, masses=ONES):
    return np.concatenate([Q0, V0 * masses if momenta else V0])


def run(fun, energy, y0, span=(0.0, 3.0), method=EIPDOP853, **options):
    options = {"rtol": 1e-9, "atol": 1e-11} | options if method is EIPDOP853 else {"h": 0.05} | options
    return integrate(fun, span, y0, method=method, invariants=Invariant(energy, name="H"), **options)


def is_from_f(result):
    return any(FROM_F in text for text in result.diagnostics.remarks)


def by_computed_gradient(fun, energy, y0, **options):
    """Return the same run with a gradient by complex steps, given by hand."""

    def gradient(t, y):
        shifted = y + 1e-30j * np.eye(y.size)
        return np.array([energy(t, row).imag for row in shifted]) / 1e-30

    kept = Invariant(energy, gradient, name="H")
    assert check_gradient(kept, 0.0, y0) < 1e-9
    return integrate(fun, (0.0, 3.0), y0, method=EIPDOP853, invariants=kept, rtol=1e-9, atol=1e-11, **options)


HOLDS = [
    *((pair, "free", {}) for pair in PAIRS),
    *(("FPUT", site, {"masses": MASSES}) for site in SITES),
    *(("FPUT", site, {"masses": MASSES, "momenta": True}) for site in SITES),
    *((pair, "pendulums", {"masses": MASSES, "momenta": True, "factor": -2.5}) for pair in PAIRS),
]
FAILS = [
    *((pair, "free", {"turn": 0.4}) for pair in PAIRS),  # a magnetic force: H is kept, but f is not its gradient
    *(("Toda", site, {"turn": 1e-3, "masses": MASSES}) for site in SITES),
]


@pytest.mark.parametrize(("pair", "site", "form"), HOLDS)
def test_energies_whose_gradient_f_has(pair, site, form):
    fun, energy = chain(pair, site, **form)
    y0 = start(form.get("momenta", False), form.get("masses", ONES))
    found = run(fun, energy, y0)
    assert is_from_f(found)
    assert found.trusted
    assert REFUTED not in str(found.diagnostics)
    expected = by_computed_gradient(fun, energy, y0)
    np.testing.assert_allclose(found.y[:, -1], expected.y[:, -1], rtol=0, atol=1e-9)
    assert found.max_residual[0] <= 1e-13 * abs(energy(0, y0)) + 2 * expected.max_residual[0]


@pytest.mark.parametrize(("pair", "site", "form"), FAILS)
def test_energies_whose_gradient_f_does_not_have(pair, site, form):
    fun, energy = chain(pair, site, **form)
    found = run(fun, energy, start())
    assert not is_from_f(found)
    expected = by_computed_gradient(fun, energy, start())
    np.testing.assert_allclose(found.y[:, -1], expected.y[:, -1], rtol=0, atol=1e-12)


# Other systems: (f, H, y0, whether f has the gradient of H).


def magnetic_momenta():
    """A charge in a field along z, by canonical momenta: (-p', q') is the gradient of any Hamiltonian."""
    B = 0.7

    def fun(t, y):
        x, z, p, r = y
        v = p + B * z / 2, r - B * x / 2
        return np.array([v[0], v[1], B / 2 * v[1] - x**3, -B / 2 * v[0] - z])

    return (
        fun,
        lambda t, y: ((y[2] + B * y[1] / 2) ** 2 + (y[3] - B * y[0] / 2) ** 2) / 2 + y[0] ** 4 / 4 + y[1] ** 2 / 2,
    )


def rotating_frame():
    """Jacobi's integral in velocities: Coriolis' force is not in its gradient."""

    def fun(t, y):
        x, z, v, w = y
        r3 = (x * x + z * z) ** 1.5
        return np.array([v, w, 2 * w + x - x / r3, -2 * v + z - z / r3])

    return fun, lambda t, y: (y[2] ** 2 + y[3] ** 2 - y[0] ** 2 - y[1] ** 2) / 2 - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)


def double_pendulum():
    """Velocities with a mass matrix that depends on the angles."""

    def fun(t, y):
        a, b, v, w = y
        c, s = np.cos(a - b), np.sin(a - b)
        det = 2 - c * c
        right = np.array([-s * w * w - 2 * np.sin(a), s * v * v - np.sin(b)])
        return np.array([v, w, (right[0] - c * right[1]) / det, (2 * right[1] - c * right[0]) / det])

    def energy(t, y):
        a, b, v, w = y
        return v * v + w * w / 2 + v * w * np.cos(a - b) - 2 * np.cos(a) - np.cos(b)

    return fun, energy


def relativistic_momentum():
    return (
        lambda t, y: np.array([y[1] / np.sqrt(1 + y[1] ** 2), -y[0]]),
        lambda t, y: np.sqrt(1 + y[1] ** 2) + y[0] ** 2 / 2,
    )


def vortices():
    """Point vortices: the strengths are what the masses are for particles."""
    strength = np.array([1.0, -0.5, 2.0])

    def both(y):
        x, z = y[:3], y[3:]
        dx, dz = x[:, None] - x, z[:, None] - z
        return dx, dz, dx * dx + dz * dz + np.eye(3)

    def fun(t, y):
        dx, dz, r2 = both(y)
        return np.concatenate([-(strength * dz / r2).sum(axis=1), (strength * dx / r2).sum(axis=1)])

    def energy(t, y):
        return -(strength[:, None] * strength * np.log(both(y)[2])).sum() / 4

    return fun, energy


def in_turn(t, y):
    """(q1, p1, q2, p2): the halves of the state are not coordinates and momenta."""
    return np.array([y[1], -y[0] - y[0] * y[2] ** 2, y[3], -y[2] - y[2] * y[0] ** 2])


def crystal():
    """Atoms on a ring at equal distances: forces cancel up to rounding at the start."""

    def both(y):
        return np.diff(1.3 * np.arange(31) + np.append(y[:30], y[0]))

    def fun(t, y):
        pull = 24 * (both(y) ** -7 - 2 * both(y) ** -13)
        return np.concatenate([y[30:], pull - np.roll(pull, 1)])

    def energy(t, y):
        return (y[30:] ** 2).sum() / 2 + 4 * (both(y) ** -12 - both(y) ** -6).sum()

    return fun, energy


def energy_squared():
    fun, energy = magnetic_momenta()
    return fun, lambda t, y: energy(t, y) ** 2


OTHERS = [
    (magnetic_momenta, [0.5, 0.1, -0.2, 0.6], True),
    (rotating_frame, [0.5, 0.1, 0.0, 1.1], False),
    (double_pendulum, [0.5, -0.3, 0.2, 0.1], False),
    (relativistic_momentum, [0.3, 0.5], True),
    (vortices, [0.0, 1.0, 0.3, 0.2, -0.4, 0.9], True),
    (lambda: (in_turn, lambda t, y: (y @ y + y[0] ** 2 * y[2] ** 2) / 2), [0.3, 0.5, -0.2, 0.1], False),
    (lambda: (lotka_volterra, lambda t, y: (y - np.log(y)).sum()), [0.5, 0.8], False),
    (energy_squared, [0.5, 0.1, -0.2, 0.6], False),
    (crystal, [*np.zeros(30), *0.1 * np.sin(np.arange(30.0) ** 2)], True),
]


@pytest.mark.parametrize(("system", "y0", "holds"), OTHERS)
def test_other_systems(system, y0, holds):
    fun, energy = system()
    found = run(fun, energy, y0)
    assert is_from_f(found) == holds
    assert found.trusted
    expected = by_computed_gradient(fun, energy, np.array(y0))
    np.testing.assert_allclose(found.y[:, -1], expected.y[:, -1], rtol=0, atol=1e-8)


def changing(what, since=1.0):
    """A chain with something that begins at the time `since`: f, H, and whether H is kept."""
    fun, energy = chain("FPUT", "pendulums")
    other = chain("FPUT", "pendulums", **what)[0]
    return (lambda t, y: fun(t, y) if t < since else other(t, y)), energy


@pytest.mark.parametrize("method", [EIPDOP853, EIPRK4, EIPRKN12])
def test_a_change_that_keeps_the_energy_drops_the_gradient_from_f(method):
    fun, energy = changing({"turn": 3.0})
    found = run(fun, energy, start(), method=method)
    if method is not EIPRKN12:  # which refuses forces that depend on the velocity
        assert REFUTED in str(found.diagnostics)
        assert found.trusted
        assert found.max_residual[0] < 1e-9 * abs(energy(0, start()))
    else:
        assert found.status == -1


@pytest.mark.parametrize("method", [EIPDOP853, EIPRK4])
@pytest.mark.parametrize("drag", [1.0, 1e-3, 1e-5])
def test_a_run_whose_energy_is_lost_later_is_not_trusted(method, drag):
    fun, energy = changing({"drag": drag})
    with pytest.warns(RuntimeWarning, match="not to be trusted"):
        found = run(fun, energy, start(), (0.0, 12.0), method=method)
    assert not found.trusted
    assert "changes" in found.message


@pytest.mark.parametrize("since", [0.35, 99.0])
def test_resumed_runs_and_copies_have_the_same_bits(tmp_path, since):
    """Also where the gradient from f is dropped before or after the checkpoint."""
    fun, energy = changing({"turn": 3.0}, since)
    options = {"method": EIPRK4, "h": 0.05, "invariants": Invariant(energy, name="H")}
    whole = integrate(fun, (0.0, 2.0), start(), **options)
    assert (REFUTED in str(whole.diagnostics)) == (since < 2)

    def stop(t, y, residuals):
        if t > 1.0:
            raise KeyboardInterrupt

    kept = {"checkpoint": tmp_path / "run.npz", "save_every": 1}
    with pytest.raises(KeyboardInterrupt):
        integrate(fun, (0.0, 2.0), start(), callback=stop, **kept, **options)
    resumed = integrate(fun, (0.0, 2.0), start(), resume=True, **kept, **options)
    np.testing.assert_array_equal(resumed.y[:, -1], whole.y[:, -1])
    assert resumed.diagnostics.remarks == whole.diagnostics.remarks
    solver = EIPRK4(fun, 0.0, start(), 2.0, h=0.05, invariants=Invariant(energy, name="H"))
    for _ in range(15):
        solver.step()
    other = copy.copy(solver)
    while other.status == "running":
        other.step()
    np.testing.assert_array_equal(other.y, whole.y[:, -1])


def test_dense_output_and_evaluations():
    """Samples are projected by computed gradients; f at the raw result serves the next step too."""
    fun, energy = chain("FPUT", "wells")
    options = {"method": EIPRK4, "h": 0.05, "t_eval": np.linspace(0, 3, 7)}
    result = solve_ivp(fun, (0.0, 3.0), start(), invariants=[energy], **options)
    np.testing.assert_allclose([energy(0, y) for y in result.y.T], energy(0, start()), rtol=1e-12)
    given = Invariant(energy, lambda t, y: np.concatenate([-fun(t, y)[N:], y[N:]]))
    assert result.nfev == solve_ivp(fun, (0.0, 3.0), start(), invariants=[given], **options).nfev


def test_a_function_that_is_set_between_two_steps():
    """Nothing is known of its components."""
    fun, energy = chain("FPUT", "wells")
    solver = EIPRK4(fun, 0.0, start(), 3.0, h=0.05, invariants=Invariant(energy, name="H"))
    solver.step()
    assert FROM_F in str(solver.diagnostics)
    solver.fun = chain("FPUT", "wells", turn=0.4)[0]
    solver.step()
    assert REFUTED in str(solver.diagnostics)
    while solver.status == "running":
        solver.step()
    assert solver.diagnostics.trusted


def test_massless_particles_and_components_at_rest():
    def fun(t, y):  # q0 moves q1, which has no mass, and q2 rests
        return np.array([y[3], y[4], 0.0, -(y[0] ** 3), y[0] - y[1], 0.0])

    found = run(fun, lambda t, y: y[3] ** 2 / 2 + y[0] ** 4 / 4, [1.0, 0.5, 0.2, 0.0, 0.3, 0.0])
    assert is_from_f(found)
    assert found.trusted
