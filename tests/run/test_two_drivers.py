"""One table of runs, each in several ways: compiled and interpreted, resumed, as a member, and by solve_ivp."""

from math import sqrt

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from systems import BALANCES, H_USES_F, QUARTIC_PARAMS, QUARTIC_START, pericentre, same, swinging, twice
from systems import JIT_H as H
from systems import JIT_L as L
from systems import jit_energy as energy
from systems import jit_energy_gradient as energy_gradient
from systems import jit_momentum as momentum
from systems import jit_momentum_gradient as momentum_gradient
from systems import jit_orbit as fun

import eip_scipy
from eip_scipy import EIPDOP853, EIPGJ12, EIPGJ14, EIPRK2, EIPRK4, EIPRK5, EIPRK45, EIPRKN12, Invariant, ensemble

pytestmark = pytest.mark.needs_jit

# Kepler: plain, with params, and in place.
both = njit(lambda t, y: np.array([energy(t, y), momentum(t, y)]))
energy_of_params = njit(lambda t, y, p: 0.5 * (y[2] * y[2] + y[3] * y[3]) - p[0] / sqrt(y[0] * y[0] + y[1] * y[1]))
momentum_of_params = njit(lambda t, y, p: y[0] * y[3] - y[1] * y[2])
attraction = njit(lambda t, q: -q / np.sqrt(q[0] * q[0] + q[1] * q[1]) ** 3)
crossing, second = (njit(lambda t, y: y[1]) for _ in range(2))
falling = njit(lambda t, y: y[0])
falling.direction, second.terminal = -1, 1


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
def energy_gradient_in_place(t, y, f, out, p):
    out[0], out[1], out[2], out[3] = -f[2], -f[3], y[2], y[3]


@njit
def momentum_gradient_in_place(t, y, out, p):
    out[0], out[1], out[2], out[3] = y[3], -y[2], -y[1], y[0]


@njit
def attraction_gradient(t, q, dq, out):
    r2, along = q[0] * q[0] + q[1] * q[1], q[0] * dq[0] + q[1] * dq[1]
    for k in range(2):
        out[k] = (3 * q[k] * along / r2 - dq[k]) / r2**1.5


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
def lattice_energy(t, y):
    total, w = 0.0, hop(y)
    for i in range(y.size):
        square = y[i].real ** 2 + y[i].imag ** 2
        total -= (y[i].conjugate() * w[i]).real + 0.5 * square * square
    return total


Z0 = np.exp(1j * np.arange(7.0)) * (1.0 + 0.1 * np.arange(7.0))
MASS = Invariant(mass, twice, name="mass")
ENERGY = Invariant(lattice_energy, njit(lambda t, y, f: 2j * f), uses_f=True, name="energy")
COMPLEX_FRAME = (np.full((1, 7), 1.0 + 0.5j), np.full((7, 1), 0.2 - 0.1j))
Y0 = pericentre(0.6)
H_OF_F = Invariant(energy, njit(H_USES_F.gradient), uses_f=True, name="H")
HL = Invariant(both, both_gradients, name="HL")
WITH_PARAMS = [
    Invariant(energy_of_params, energy_gradient_in_place, in_place=True, uses_f=True, name="H"),
    Invariant(momentum_of_params, momentum_gradient_in_place, in_place=True, name="L"),
]
FRAME = (np.array([[1.0, 2.0, 0.0, 0.0]]), np.array([[0.5], [0.25], [0.0], [0.0]]))
TARGET = Invariant(energy, energy_gradient, target=-0.4, name="H")
USUAL = {"fun": fun, "t_span": (0.0, 6.0), "y0": Y0, "method": EIPRK4, "h": 0.03, "invariants": [H, L], "save_every": 7}
SAMPLED = {"save_every": None, "t_eval": np.sqrt(np.linspace(0.0, 36.0, 57))}
ADAPTIVE = {"method": EIPRK45, "h": None, "rtol": 1e-7, "atol": 1e-10, **SAMPLED}
SECOND_ORDER = {"fun": None, "acceleration": attraction, "h": 0.01}
GROUPS = [[0, 1, 2], [5, 3]]
PARAMS = {"params": [1.0], "invariants": WITH_PARAMS}
BALANCE = {"fun": swinging, "t_span": (0.0, 20.0), "y0": QUARTIC_START, "params": QUARTIC_PARAMS, "h": 0.1}
WAVES = {"fun": lattice, "t_span": (0.0, 2.0), "y0": Z0, "check": False}
RUNS = {
    "no invariants, backward": {"invariants": (), "t_span": (0.0, -6.0)},
    "one of two values": {"invariants": HL},
    "uses f": {"invariants": [H_OF_F, L], "reuse_f": False},
    "weights": {"metric": [1.0, 0.5, 0.25, 0.3]},
    "tolerances": {"rtol": [1e-3, 1e-4, 1e-5, 1e-2], "atol": 0.0},
    "old, two iterations, frame": {
        "invariants": [H_OF_F, L],
        "direction": "old",
        "iterations": 2,
        "linear_invariants": FRAME,
    },
    "midpoint, two iterations, blocks": {"direction": "midpoint", "iterations": 2, "blocks": 4},
    "every seventh, blocks, frame": {"every": 7, "blocks": 2, "linear_invariants": FRAME},
    "compensated, every second": {"invariants": [H_OF_F, L], "compensated": True, "every": 2, "iterations": 2},
    "euclidean, RK2": {"metric": "euclidean", "method": EIPRK2, "h": 0.01},
    "RK5, compensated": {"method": EIPRK5, "compensated": True, "h": 0.0317},
    "DOP853, every auto": {"every": "auto", "method": EIPDOP853, "h": 0.02},
    "projected start": {"invariants": TARGET, "project_initial": True},
    "samples": SAMPLED,
    "adaptive, events": ADAPTIVE | {"events": [falling, crossing]},
    "adaptive, first step": ADAPTIVE | {"method": EIPDOP853, "first_step": 1e-3, "rtol": 1e-11, "atol": 1e-13},
    "an event that ends it": {"events": [crossing, second], "every": 45},
    "Nystrom": SECOND_ORDER | {"method": EIPRKN12, "h": 0.05, "every": "auto", "compensated": True, "save_every": 2},
    "multistep": SECOND_ORDER | {"method": EIPGJ12},
    "multistep, corrected": SECOND_ORDER | {"method": EIPGJ14, "jacobian": attraction_gradient},
    "params": PARAMS | {"fun": fun_of_params, "direction": "old", "iterations": 2},
    "params, in place": PARAMS | {"fun": fun_in_place, "in_place": True},
    "balance": BALANCE | {"invariants": BALANCES["rate"], "method": EIPDOP853},
    "balance by f, multistep": BALANCE | {"invariants": BALANCES["f"], "method": EIPGJ12, "h": 0.025},
    "balance by its gradient, every third": BALANCE | {"invariants": BALANCES["gradient"], "every": 3},
    "balances by values": BALANCE | {"invariants": BALANCES["pair"]},
    "balance, adaptive": BALANCE | ADAPTIVE | {"invariants": BALANCES["values"], "t_eval": np.linspace(0.0, 20.0, 33)},
    "waves": WAVES | {"invariants": [ENERGY, MASS], "metric": np.linspace(0.1, 1.0, 7)},
    "waves, frame": WAVES
    | {"invariants": [MASS, ENERGY], "linear_invariants": COMPLEX_FRAME, "blocks": GROUPS, "every": 4},
    "waves, midpoint": WAVES | {"invariants": [MASS, ENERGY], "direction": "midpoint", "compensated": True},
}
# They compile functions for themselves alone.
SLOW = "balances by", "one of two", "waves", "projected start", "multistep, corrected"
names = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n.startswith(SLOW) else n for n in RUNS]
)


def run(name, **more):
    return eip_scipy.integrate(**USUAL | RUNS[name] | more)


@names
def test_compiled_and_interpreted(name):
    """They differ by a few roundings: the two drivers take the same steps, and compilers may round differently."""
    compiled, interpreted = (run(name, compiled=c) for c in (True, False))
    assert (compiled.compiled, interpreted.compiled) == (True, False)
    assert compiled.status == (1 if "ends" in name else 0)
    assert compiled.diagnostics.n_projections + compiled.diagnostics.n_skipped > 0 or not compiled.max_residual.size
    for key in ("t", "y", "invariants"):
        np.testing.assert_allclose(compiled[key], interpreted[key], rtol=1e-11, atol=1e-12)
    for key in ("status", "nfev", "njev", "nlu"):
        assert compiled[key] == interpreted[key]


@names
def test_members_of_ensembles(name):
    options = USUAL | RUNS[name]
    y0 = options.pop("y0")
    many = ensemble(y0s=np.array([0.999 * y0, y0, 1.001 * y0]), executor=1, **options)
    alone = run(name)
    end = (alone.t_events[1][-1], alone.y_events[1][-1]) if alone.status else (alone.t[-1], alone.y[:, -1])
    assert (many.t[1], many.status[1], many.message[1]) == (end[0], alone.status, alone.message)
    np.testing.assert_array_equal(many.y[1], end[1])
    rows = alone.t.size - ("save_every" in options and alone.status)  # where the run's last row is that of the event
    np.testing.assert_array_equal(many.trajectories[1, :, :rows], alone.y[:, :rows])
    assert np.isnan(many.trajectories[1, :, rows:]).all()
    np.testing.assert_array_equal(many.max_residual[1], alone.max_residual)
    np.testing.assert_array_equal(many.max_correction[1], alone.diagnostics.max_correction)
    assert [many[key][1] for key in ("nfev", "njev", "nlu")] == [alone[key] for key in ("nfev", "njev", "nlu")]
    for found, times in zip(many.t_events[1] if many.t_events else (), alone.t_events or (), strict=True):
        np.testing.assert_array_equal(found, times)


@names
@pytest.mark.usefixtures("fine")
def test_resumed_runs(name, tmp_path, stopped):
    """The run is stopped after every few chunks, and changes on the way from interpreted to compiled steps."""
    whole, options = run(name), {"checkpoint": tmp_path / "run", "resume": True}
    for k in range(1000):
        with stopped(7 if k == 0 else 9):
            found = run(name, compiled=None if k > 1 else False, **options)
            break
    assert k >= 4
    same(whole, found)


BY_SCIPY = [
    name
    for name, options in RUNS.items()
    if not {"compensated", "params", "acceleration", "t_eval", "events", "project_initial"} & options.keys()
]


@pytest.mark.parametrize("name", [name for name in BY_SCIPY if not name.startswith(SLOW)])
def test_solve_ivp_is_the_same_step(name):
    found = run(name, save_every=1, compiled=False)
    options = USUAL | RUNS[name]
    del options["save_every"]
    sol = solve_ivp(**options)
    every = options.get("every", 1)
    np.testing.assert_array_equal(sol.t, found.t)
    # In between integrate saves projected copies.
    projected = [*range(0, len(found.t), every), -1] if isinstance(every, int) else [0]
    np.testing.assert_array_equal(sol.y[:, projected], found.y[:, projected])
    assert (sol.nfev, sol.njev, sol.nlu) == (found.nfev, found.njev, found.nlu)
