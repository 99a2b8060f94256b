"""Compiled and interpreted runs of the same jitted functions agree, over a table of options, and with solve_ivp."""

from math import sqrt

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from systems import JIT_H as H
from systems import JIT_L as L
from systems import jit_energy as energy
from systems import jit_energy_gradient as energy_gradient
from systems import jit_momentum as momentum
from systems import jit_momentum_gradient as momentum_gradient
from systems import jit_orbit as fun
from systems import pericentre

from eip_scipy import EIPRK4, EIPRK5, Invariant, integrate
from eip_scipy.problems import nbody

pytestmark = pytest.mark.needs_jit

# Kepler: plain, with params, and in place.


@njit
def energy_gradient_of_f(t, y, f):
    return np.array([-f[2], -f[3], y[2], y[3]])


@njit
def both(t, y):
    return np.array([energy(t, y), momentum(t, y)])


@njit
def both_gradients(t, y):
    out = np.empty((2, 4))
    one, two = energy_gradient(t, y), momentum_gradient(t, y)
    for i in range(4):  # whole rows at once take Numba seconds to compile
        out[0, i], out[1, i] = one[i], two[i]
    return out


@njit
def fun_in_place(t, y, out, p):
    r2 = y[0] * y[0] + y[1] * y[1]
    w = p[0] / (r2 * sqrt(r2))
    out[0], out[1], out[2], out[3] = y[2], y[3], -w * y[0], -w * y[1]


@njit
def fun_of_params(t, y, p):
    out = np.empty(4)
    fun_in_place(t, y, out, p)
    return out


@njit
def energy_of_params(t, y, p):
    return 0.5 * (y[2] * y[2] + y[3] * y[3]) - p[0] / sqrt(y[0] * y[0] + y[1] * y[1])


@njit
def energy_gradient_in_place(t, y, f, out, p):
    out[0], out[1], out[2], out[3] = -f[2], -f[3], y[2], y[3]


@njit
def momentum_of_params(t, y, p):
    return y[0] * y[3] - y[1] * y[2]


@njit
def momentum_gradient_in_place(t, y, out, p):
    out[0], out[1], out[2], out[3] = y[3], -y[2], -y[1], y[0]


Y0 = pericentre(0.6)
H_OF_F = Invariant(energy, energy_gradient_of_f, uses_f=True, name="H")
HL = Invariant(both, both_gradients, name="HL")
WITH_PARAMS = [
    Invariant(energy_of_params, energy_gradient_in_place, in_place=True, uses_f=True, name="H"),
    Invariant(momentum_of_params, momentum_gradient_in_place, in_place=True, name="L"),
]
FRAME = (np.array([[1.0, 2.0, 0.0, 0.0]]), np.array([[0.5], [0.25], [0.0], [0.0]]))


def compare(fun, span, y0, **options):
    options = {"method": EIPRK4, "h": 0.03, "save_every": 1} | options
    compiled, interpreted = (integrate(fun, span, y0, compiled=c, **options) for c in (True, False))
    assert compiled.compiled
    assert not interpreted.compiled
    assert_same(compiled, interpreted)
    return compiled


def assert_same(one, other):
    """Compare to a few roundings: the two drivers take the same steps, and compilers may round differently."""
    for name in ("t", "y", "invariants"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-11, atol=1e-12)
    for name in ("status", "nfev", "njev", "nlu"):
        assert one[name] == other[name]


CASES = {
    "no invariants": {},
    "two": {"invariants": [H, L]},
    "one of two values": {"invariants": HL},
    "uses f": {"invariants": [H_OF_F, L]},
    "weights": {"invariants": [H, L], "metric": [1.0, 0.5, 0.25, 0.3]},
    "tolerances": {"invariants": [H, L], "rtol": [1e-3, 1e-4, 1e-5, 1e-2], "atol": 0.0},
    "old, two iterations, frame": {"invariants": [H_OF_F, L], "direction": "old", "iterations": 2, "frame": FRAME},
    "midpoint, two iterations": {"invariants": [H, L], "direction": "midpoint", "iterations": 2, "blocks": 4},
    "every seventh, blocks, frame": {"invariants": [H, L], "every": 7, "blocks": 2, "frame": FRAME},
    "compensated, every second": {"invariants": [H_OF_F, L], "compensated": True, "every": 2, "iterations": 2},
    "saved now and then": {"invariants": [H, L], "save_every": 7, "h": 0.0317},
    "t_eval": {"invariants": [H, L], "save_every": None, "t_eval": np.sqrt(np.linspace(0.0, 36.0, 57))},
    "RK5, compensated": {"invariants": [H, L], "method": EIPRK5, "compensated": True, "reuse_f": False},
}
# Their invariants are compiled for them alone.
ALONE = ("one of two values",)


def cases(names):
    return [pytest.param(name, marks=pytest.mark.slow) if name in ALONE else name for name in names]


@pytest.mark.parametrize("case", cases(CASES))
def test_real(case):
    run = compare(fun, (0.0, 6.0), Y0, **CASES[case])
    assert run.status == 0
    if "invariants" in CASES[case]:
        assert run.diagnostics.n_projections > 0


def test_params_and_in_place():
    for rhs, in_place in ((fun_of_params, False), (fun_in_place, True)):
        options = {"in_place": in_place, "invariants": WITH_PARAMS, "direction": "old", "iterations": 2 - in_place}
        run = compare(rhs, (0, 6), Y0, params=[1.0], **options)
        other = integrate(rhs, (0, 6), Y0, params=[1.1], method=EIPRK4, h=0.03, compiled=False, **options)
        assert (run.y[:, -1] != other.y[:, -1]).any()


def test_n_bodies():
    """Return a vector-valued invariant in place, blocks and a frame."""
    rng = np.random.default_rng(1)
    gm, q = np.array([1.0, 1e-3, 2e-4]), np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0.1]])
    v = np.array([[0.0, 0, 0], [0, 1.0, 0.1], [-0.7, 0, 0]]) + 1e-3 * rng.standard_normal((3, 3))
    problem = nbody(gm, q, v, t_span=(0.0, 20.0), h=0.05)
    for options in ({}, {"every": 5, "compensated": True}):
        compiled, interpreted = (
            integrate(problem, method=EIPRK4, save_every=1, compiled=c, **options) for c in (True, False)
        )
        assert_same(compiled, interpreted)


# A nonlinear Schroedinger lattice.


@njit
def hop(y):
    out = np.empty_like(y)
    n = y.size
    for i in range(n):
        out[i] = y[(i + 1) % n] + y[i - 1]
    return out


@njit
def lattice(t, y):
    w = hop(y)
    for i in range(y.size):
        w[i] = 1j * (w[i] + (y[i].real ** 2 + y[i].imag ** 2) * y[i])
    return w


@njit
def mass(t, y):
    total = 0.0
    for z in y:
        total += z.real**2 + z.imag**2
    return total


@njit
def mass_gradient(t, y):
    return 2.0 * y


@njit
def lattice_energy(t, y):
    total, w = 0.0, hop(y)
    for i in range(y.size):
        square = y[i].real ** 2 + y[i].imag ** 2
        total -= (y[i].conjugate() * w[i]).real + 0.5 * square * square
    return total


@njit
def lattice_energy_gradient(t, y, f):
    return 2j * f


Z0 = np.exp(1j * np.arange(7.0)) * (1.0 + 0.1 * np.arange(7.0))
MASS = Invariant(mass, mass_gradient, name="mass")
ENERGY = Invariant(lattice_energy, lattice_energy_gradient, uses_f=True, name="energy")
COMPLEX_FRAME = (np.full((1, 7), 1.0 + 0.5j), np.full((7, 1), 0.2 - 0.1j))
COMPLEX_CASES = {
    "weights": {"invariants": [ENERGY, MASS], "metric": np.linspace(0.1, 1.0, 7)},
    "frame, blocks, every": {
        "invariants": [MASS, ENERGY],
        "frame": COMPLEX_FRAME,
        "blocks": [[0, 1, 2], [5, 3]],
        "every": 4,
    },
    "midpoint, compensated": {"invariants": [MASS, ENERGY], "direction": "midpoint", "compensated": True},
}


@pytest.mark.slow
@pytest.mark.parametrize("case", COMPLEX_CASES)
def test_complex(case):
    run = compare(lattice, (0.0, 2.0), Z0, check=False, **COMPLEX_CASES[case])
    assert run.status == 0
    assert run.y.dtype == complex


# solve_ivp takes the same steps.


IVP_CASES = [name for name, options in CASES.items() if not {"compensated", "save_every"} & options.keys()]


@pytest.mark.parametrize("case", cases(IVP_CASES))
def test_solve_ivp_is_the_same_step(case):
    options = {"method": EIPRK4, "h": 0.03} | CASES[case]
    run = integrate(fun, (0, -6), Y0, save_every=1, compiled=False, **options)
    sol = solve_ivp(fun, (0, -6), Y0, **options)
    np.testing.assert_array_equal(sol.t, run.t)
    projected = [*range(0, len(run.t), options.get("every", 1)), -1]  # in between integrate saves projected copies
    np.testing.assert_array_equal(sol.y[:, projected], run.y[:, projected])
    assert (sol.nfev, sol.njev, sol.nlu) == (run.nfev, run.njev, run.nlu)


def test_results_do_not_depend_on_what_is_saved():
    """The steps are the same whatever is saved, interpolated or called back, and again in a second run."""
    options = {"method": EIPRK4, "h": 0.03, "invariants": [H, L], "compiled": True}
    end = integrate(fun, (0, 6), Y0, **options).y[:, -1]
    for more in ({"save_every": 1}, {"t_eval": [0.5, 6.0], "callback": lambda t, y, d: None}):
        np.testing.assert_array_equal(integrate(fun, (0, 6), Y0, **options, **more).y[:, -1], end)
