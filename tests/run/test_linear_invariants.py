"""Linear invariants that are found and kept, momenta of particles that are missing, and times far from 0."""

import numpy as np
import pytest
from numba import njit

from eip_scipy import (
    EIPDOP853,
    EIPRK4,
    EIPRK45,
    EIPRadau,
    Invariant,
    check_gradient,
    ensemble,
    integrate,
    particle_invariants,
    recommend,
    solve_ivp,
)

MASSES = np.array([3.0, 1.0, 2.0])
START = np.array([0, 0, 1.1, 0, -0.2, 0.9, 0.3, -0.1, 0.2, 0.4, -0.3, 0.1])


@njit
def forces(q, out):
    """Write the forces of three springs between particles in a plane to out, and return their energy."""
    out[:], energy = 0.0, 0.0
    for i in range(3):
        for j in range(i):
            d = q[2 * i : 2 * i + 2] - q[2 * j : 2 * j + 2]
            r = np.sqrt(d @ d)
            energy += 5 * (r - 1) ** 2
            out[2 * i : 2 * i + 2] -= 10 * (r - 1) / r * d
            out[2 * j : 2 * j + 2] += 10 * (r - 1) / r * d
    return energy


@njit
def springs(t, y, m):
    out = np.empty(12)
    forces(y[:6], out[6:])
    for i in range(6):
        out[i], out[6 + i] = y[6 + i], out[6 + i] / m[i // 2]
    return out


@njit
def energy(t, y, m):
    kinetic = 0.0
    for i in range(6):
        kinetic += 0.5 * m[i // 2] * y[6 + i] ** 2
    return kinetic + forces(y[:6], np.empty(6))


@njit
def slope(t, y, f, out, m):
    for i in range(6):
        out[i], out[6 + i] = -m[i // 2] * f[6 + i], m[i // 2] * y[6 + i]


@njit
def momentum_slope(t, y, m):
    out = np.zeros((2, 12))
    for i in range(6):
        out[i % 2, 6 + i] = m[i // 2]
    return out


@njit
def momentum(t, y, m):
    return momentum_slope(t, y, m) @ y


H = Invariant(energy, slope, in_place=True, uses_f=True, name="H")
P = Invariant(momentum, momentum_slope, name="P")
L = particle_invariants(MASSES, 2)
FIXED = {"method": EIPRK4, "h": 0.05, "params": MASSES}
OFF = {"linear_invariants": None}


def drift(y, masses=MASSES):
    """Return the largest change of the total momentum between the first and the last of the states y (12, m)."""
    return np.abs(momentum(0.0, y[:, -1], masses) - momentum(0.0, y[:, 0], masses)).max()


def plain(t, y):
    return springs(t, y, MASSES)


ENERGY = Invariant(lambda t, y: energy(t, y, MASSES), lambda t, y: slope_of(y), name="H")


def slope_of(y):
    out = np.empty(12)
    slope(0.0, y, plain(0.0, y), out, MASSES)
    return out


def in_trap(t, y):
    return plain(t, y) - np.concatenate([np.zeros(6), y[:6]])


WEIGHT = np.append(np.repeat(MASSES, 2), np.zeros(6))
TRAPPED = Invariant(
    lambda t, y: ENERGY.fun(t, y) + 0.5 * WEIGHT @ y**2, lambda t, y: ENERGY.grad(t, y) + WEIGHT * y, name="H"
)


def test_momentum_and_centre_of_mass_are_found_and_kept():
    """The corrections for the energy change neither the momentum nor the number of counted evaluations."""
    run, without = (integrate(springs, (0, 20), START, invariants=H, **FIXED, **more) for more in ({}, OFF))
    assert drift(run.y) < 1e-13 < 1e-9 < drift(without.y)
    centre = np.repeat(MASSES, 2).reshape(3, 2) * (run.y[:6, -1] - START[:6] - 20 * START[6:]).reshape(3, 2)
    assert np.abs(centre.sum(axis=0)).max() < 1e-12
    assert run.diagnostics.remarks[0].startswith("linear invariants: 4 found by 22 evaluations (not in nfev), 4 kept")
    assert "linear invariants: 4" in repr(run.diagnostics)
    assert run.nfev == without.nfev
    assert without.diagnostics.remarks[0].startswith("momentum and angular momentum")


@pytest.mark.parametrize("kept", [(H, P), (H, *L, P)], ids=["H and P", "H, L and P"])
def test_given_momentum_is_projected(kept):
    """Corrections may change a linear invariant that is given, and a quantity whose rate it is."""
    run, without = (integrate(springs, (0, 5), START, invariants=kept, **FIXED, **more) for more in ({}, OFF))
    np.testing.assert_array_equal(run.y, without.y)
    assert "4 found" in run.diagnostics.remarks[0]
    assert "0 kept" in run.diagnostics.remarks[0]


def test_mass_of_robertson_is_projected():
    """An implicit method with the mass as its invariant makes the same steps as without the search."""
    robertson = njit(
        lambda t, y: np.array(
            [1e4 * y[1] * y[2] - 0.04 * y[0], 0.04 * y[0] - 1e4 * y[1] * y[2] - 3e7 * y[1] ** 2, 3e7 * y[1] ** 2]
        )
    )
    options = {"method": EIPRadau, "invariants": Invariant(njit(lambda t, y: y.sum())), "rtol": 1e-4, "atol": 1e-8}
    run, without = (integrate(robertson, (0, 1e4), [1.0, 0, 0], **options, **more) for more in ({}, OFF))
    np.testing.assert_array_equal(run.y, without.y)
    assert run.diagnostics.remarks[0].startswith("linear invariants: 1 found by 13 evaluations (not in nfev), 0 kept")


def test_free_flight_has_no_constraints():
    """If each velocity is constant, the energy must be able to change all of them."""
    free = njit(lambda t, y: np.concatenate((y[2:], np.zeros(2))))
    options = {"method": EIPRK4, "h": 0.1, "invariants": Invariant(njit(lambda t, y: 0.5 * (y[2:] @ y[2:])))}
    assert "0 kept" in integrate(free, (0, 1), [1.0, 2, 3, 4], **options).diagnostics.remarks[0]


def test_nothing_is_found():
    """Functions in Python and runs with a given frame are not searched; a value that is not finite ends a search."""
    C = np.kron(np.eye(2), np.kron(MASSES, np.eye(2)))
    given = integrate(springs, (0, 1), START, invariants=[H, *L], linear_invariants=(C, C.T), **FIXED)
    same = integrate(springs, (0, 1), START, invariants=[H, *L], linear_invariants=(C, C.T), **FIXED)
    assert given.diagnostics.remarks == same.diagnostics.remarks == ()
    np.testing.assert_array_equal(given.y, same.y)
    unstable = njit(lambda t, y: np.array([y[0] + np.log(y[1] - 1.0), -y[0] - np.log(y[1] - 1.0)]))
    options = {"method": EIPRK4, "h": 0.01, "check": False, "invariants": Invariant(njit(lambda t, y: y[0]))}
    assert integrate(unstable, (0, 0.01), [0.1, 1.0 + 1e-9], **options).diagnostics.remarks == ()
    for wrong in ("all", 3.0, (C,)):
        with pytest.raises(ValueError, match="linear_invariants must be 'auto', 'given', a pair"):
            integrate(springs, (0, 1), START, invariants=H, linear_invariants=wrong, **FIXED)


def test_members_and_resumed_runs_have_the_same_bits(fine, stopped, tmp_path):
    """The points of the search are the same in each run; an ensemble keeps what holds for all of its members."""
    starts = START * np.linspace(0.9, 1.1, 9)[:, None]
    options = FIXED | {"invariants": [H, *L]}
    alone = [integrate(springs, (0, 2), start, **options) for start in starts]
    np.testing.assert_array_equal(ensemble(springs, (0, 2), starts, **options).y, [run.y[:, -1] for run in alone])
    with stopped(2):
        integrate(springs, (0, 2), START, checkpoint=tmp_path / "run", **options)
    resumed = integrate(springs, (0, 2), START, checkpoint=tmp_path / "run", resume=True, **options)
    np.testing.assert_array_equal(resumed.y, integrate(springs, (0, 2), START, **options).y)
    continued = integrate(springs, (0, 1), START, **options).continue_to(2)
    assert drift(continued.y) < 1e-13
    assert continued.diagnostics.remarks == resumed.diagnostics.remarks
    masses = MASSES * np.linspace(0.9, 1.1, 9)[:, None] ** [1, 2, 3]
    options = FIXED | {"invariants": H}
    found = ensemble(springs, (0, 2), starts, **options | {"params": masses}).y
    alone = [
        integrate(springs, (0, 2), start, **options | OFF | {"params": m}).y[:, -1]
        for start, m in zip(starts, masses, strict=True)
    ]
    np.testing.assert_array_equal(found, alone)


@pytest.mark.parametrize("dimension", [2, 3])
def test_particle_invariants_are_angular_momenta(dimension):
    rng = np.random.default_rng(1)
    q, v, about = (
        rng.standard_normal((3, dimension)),
        rng.standard_normal((3, dimension)),
        np.arange(1.0, 1 + dimension),
    )
    (item,) = particle_invariants(MASSES, dimension, about=about)
    y = np.concatenate([q.ravel(), v.ravel()])
    pad = [(0, 0), (0, 3 - dimension)]
    expected = (MASSES[:, None] * np.cross(np.pad(q - about, pad), np.pad(v, pad))).sum(axis=0)
    np.testing.assert_allclose(item.fun(0.0, y), expected[2] if dimension == 2 else expected, rtol=1e-14)

    def gradient(t, y):
        out = np.empty((3, y.size) if dimension == 3 else y.size)
        item.grad(t, y, out)
        return out

    assert check_gradient(Invariant(item.fun, gradient), 0.0, y) < 1e-10


def test_particle_invariants_keep_momentum_in_each_interface():
    """Momentum is kept also for functions in Python, and not where the system does not keep it, as in a trap."""
    kept = {"invariants": [ENERGY, *L], "rtol": 1e-6, "atol": 1e-9}
    sol = solve_ivp(plain, (0, 20), START, EIPDOP853, **kept)
    run = integrate(plain, (0, 20), START, method=EIPDOP853, **kept)
    alone = integrate(plain, (0, 20), START, method=EIPDOP853, **kept | {"invariants": ENERGY})
    assert max(drift(sol.y), drift(run.y)) < 1e-12 < 1e-8 < drift(alone.y)
    trapped = solve_ivp(in_trap, (0, 2), START, EIPRK45, invariants=[TRAPPED, *L], rtol=1e-8, atol=1e-10)
    assert trapped.trusted
    assert trapped.diagnostics.remarks == ()
    centre = (np.repeat(MASSES, 2)[:, None] * trapped.y[:6]).reshape(3, 2, -1).sum(axis=0)
    speed = momentum(0.0, START, MASSES)
    np.testing.assert_allclose(centre[:, -1], np.cos(2.0) * centre[:, 0] + np.sin(2.0) * speed, atol=1e-6)


@pytest.mark.parametrize(
    ("masses", "options", "match"),
    [
        ([1.0, -1.0], {}, "masses must be finite numbers >= 0"),
        ([1.0], {"dimension": 4}, "dimension must be 2 or 3"),
        ([1.0], {"about": [0.0, 0.0]}, "about must be a point with 3 finite"),
    ],
)
def test_wrong_particles_are_refused(masses, options, match):
    with pytest.raises(ValueError, match=match):
        particle_invariants(masses, **options)


def test_missing_momenta_are_named_once():
    """The line to write is in the message, unless it has been followed or the system does not keep them."""
    line = "invariants=[H, *particle_invariants(masses, dimension=2)]"
    options = {"method": EIPRK4, "h": 0.05}
    assert line in integrate(plain, (0, 1), START, invariants=ENERGY, **options).message
    assert line in solve_ivp(plain, (0, 1), START, EIPRK4, h=0.05, invariants=ENERGY).message
    assert "particle_inv" not in integrate(plain, (0, 1), START, invariants=[ENERGY, *L], **options).message
    assert "particle_inv" not in integrate(in_trap, (0, 1), START, invariants=TRAPPED, **options).message
    choice = recommend(springs, (0, 2), START, invariants=H, params=MASSES, error=1e-4)
    assert [item.name for item in choice.options["invariants"]] == ["H", "L"]


@pytest.mark.parametrize("driver", ["integrate", "solve_ivp"])
def test_time_far_from_zero(driver):
    """The rounding of t, by which an invariant that depends on t changes, is not projected onto the state."""
    w, t0 = 2.0, 1e8

    def forced(t):
        return np.array([np.cos(w * t), -w * np.sin(w * t)]) / (1 - w * w)

    def fun(t, y):
        return np.array([y[1], -y[0] + np.cos(w * t)])

    kept = Invariant(lambda t, y: ((y - forced(t)) @ (y - forced(t))) / 2, name="rest")
    c, s = np.cos(50.0), np.sin(50.0)
    exact = forced(t0 + 50) + np.array([[c, s], [-s, c]]) @ (np.array([1.0, 0.0]) - forced(t0))
    call = {"integrate": integrate, "solve_ivp": solve_ivp}[driver]
    runs = [call(fun, (t0, t0 + 50), [1.0, 0.0], method=EIPRK4, h=0.02, invariants=k) for k in ([kept], [])]
    found, without = (np.abs(run.y[:, -1] - exact).max() for run in runs)
    assert found < 1.2 * without < 1e-7
    assert runs[0].trusted
