"""C functions without gradients: accuracy of the differences, and the bits of both ways to compute them."""

import numpy as np
import pytest
from c_compiler import low_level, shared_library
from numba import njit
from systems import pericentre

from eip_scipy import EIPRK4, EIPRK45, Invariant, integrate
from eip_scipy.core.invariant_set import LARGE, InvariantSet

# In C, and in Python for complex steps.
FUNCTIONS = {
    "kepler": (
        "0.5*(y[2]*y[2] + y[3]*y[3]) - 1/sqrt(y[0]*y[0] + y[1]*y[1])",
        lambda y: 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2),
    ),
    "momentum": ("y[0]*y[3] - y[1]*y[2]", lambda y: y[0] * y[3] - y[1] * y[2]),
    "pendulum": ("0.5*y[1]*y[1] - cos(3*y[0])", lambda y: 0.5 * y[1] ** 2 - np.cos(3 * y[0])),
    "lotka_volterra": (
        "y[0] - log(y[0]) + y[1] - 2*log(y[1])",
        lambda y: y[0] - np.log(y[0]) + y[1] - 2 * np.log(y[1]),
    ),
    "lennard_jones": ("pow(y[0], -12) - pow(y[0], -6)", lambda y: y[0] ** -12 - y[0] ** -6),
    "near": ("1/sqrt((y[0] - 1)*(y[0] - 1) + 1e-8)", lambda y: 1 / np.sqrt((y[0] - 1) ** 2 + 1e-8)),
    "moon": ("y[2]*y[3] - 1e-6/fabs(y[0] - y[1])", lambda y: y[2] * y[3] - 1e-6 / (y[0] - y[1])),
}
STATES = {"near": [1.0003, 0.0, 0.0, 0.0], "moon": [1.0026, 1.0, 0.3, 0.2]}
SYSTEM = """
#include <math.h>
int orbit(double t, const double *y, double *out, const double *p) {
    double r2 = y[0]*y[0] + y[1]*y[1], r3 = r2 * sqrt(r2);
    out[0] = y[2]; out[1] = y[3]; out[2] = -y[0]/r3; out[3] = -y[1]/r3; return 0; }
int both(double t, const double *y, double *out, const double *p) {
    out[0] = 0.5*(y[2]*y[2] + y[3]*y[3]) - 1/sqrt(y[0]*y[0] + y[1]*y[1]);
    out[1] = y[0]*y[3] - y[1]*y[2]; return 0; }
int mass(double t, const double *y, double *out, const double *p) {
    out[0] = y[0]*y[0] + y[1]*y[1] + y[2]*y[2] + y[3]*y[3]; return 0; }
int overwrites(double t, double *y, double *out, const double *p) {
    out[0] = y[0]*y[3] - y[1]*y[2]; y[0] = y[1] = y[2] = y[3] = 1e99; return 0; }
int logarithm(double t, const double *y, double *out, const double *p) {
    if (y[0] <= 0) return p[0] > 0 ? 1 : -7;
    out[0] = y[0] - log(y[0]) + y[1] - log(y[1]); return 0; }
"""


@pytest.fixture(scope="module")
def c(tmp_path_factory):
    """Return the C functions by their names, with a new pointer each time."""
    folder = tmp_path_factory.mktemp("differences")
    text = "int {}(double t, const double *y, double *out, const double *p) {{ out[0] = {}; return 0; }}\n"
    source = SYSTEM + "".join(text.format(name, given) for name, (given, _) in FUNCTIONS.items())
    (folder / "functions.c").write_text(source)
    library = shared_library(folder / "functions.so", folder / "functions.c")
    return lambda name: low_level(library, name)


def gradient(invariant, y):
    y = np.asarray(y, float)
    return InvariantSet(invariant, 0.0, y, np.ones_like(y), 0.01).gradients(0.0, y, y)[0]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_accuracy(c, name):
    y = np.array(STATES.get(name, [0.7, 1.1, -0.4, 0.9]))
    _, fun = FUNCTIONS[name]
    exact = np.array([fun(y + 1e-100j * unit).imag / 1e-100 for unit in np.eye(4)])
    np.testing.assert_allclose(gradient(Invariant(c(name)), y), exact, rtol=0, atol=2e-11 * np.abs(exact).max())


ORBIT = {"method": EIPRK4, "h": 0.02}


def by_hand(c):
    def grad(t, y):
        r3 = np.hypot(y[0], y[1]) ** 3
        return np.array([[y[0] / r3, y[1] / r3, y[2], y[3]], [y[3], -y[2], -y[1], y[0]]])

    return Invariant(c("both"), grad, size=2, name="H, L")


@pytest.mark.parametrize(
    "options", [{}, {"metric": "euclidean"}, {"h": 0.1}, {"method": EIPRK45, "h": None, "rtol": 1e-7}]
)
def test_invariants_hold_as_with_gradients(c, options):
    start, options = pericentre(0.5), ORBIT | options
    kept = Invariant(c("both"), size=2, name="H, L")
    run = integrate(c("orbit"), (0, 60), start, invariants=kept, **options)
    expected = integrate(c("orbit"), (0, 60), start, invariants=by_hand(c), **options)
    assert run.compiled
    assert (run.max_residual < 1.1 * expected.max_residual + 1e-14).all()
    np.testing.assert_allclose(run.y[:, -1], expected.y[:, -1], rtol=0, atol=1e-9)


def test_bits_and_what_is_said(c):
    start, kept = pericentre(0.5), Invariant(c("both"), size=2, name="H, L")
    native = integrate(c("orbit"), (0, 30), start, invariants=kept, save_every=1, **ORBIT)
    interpreted = integrate(c("orbit"), (0, 30), start, invariants=kept, save_every=1, compiled=False, **ORBIT)
    np.testing.assert_array_equal(native.y, interpreted.y)
    assert (native.nfev, native.njev) == (interpreted.nfev, interpreted.njev)
    assert native.calls == {"fun": "pointer", "H, L": "pointer", "gradient of H, L": "differences"}
    for run in (native, interpreted):
        assert "the gradient of 'H, L' is computed by differences" in run.message


def test_complex_states(c):
    def fun(t, y):
        return 1j * np.abs(y) ** 2 * y

    start, options = np.array([1 + 1j, 0.5]), {"method": EIPRK4, "h": 0.05}
    native = integrate(njit(fun), (0, 5), start, invariants=Invariant(c("mass")), **options)
    by_python = integrate(fun, (0, 5), start, invariants=Invariant(c("mass")), **options)
    expected = integrate(fun, (0, 5), start, invariants=Invariant(c("mass"), lambda t, y: 2 * y), **options)
    assert native.compiled
    np.testing.assert_allclose(native.y, by_python.y, rtol=0, atol=1e-14)
    np.testing.assert_allclose(native.y, expected.y, rtol=0, atol=1e-13)


def test_a_status_where_a_shift_leaves_the_domain(c):
    # 5e-3 of the first component's floor reaches beyond 0, where there is no logarithm.
    fun = njit(lambda t, y, p: np.array([y[0] * (y[1] - 1), y[1] * (1 - y[0])]))
    start = np.array([3.0, 1e-4])
    options = {"method": EIPRK45, "rtol": 1e-8, "atol": 1e-12}
    kept = Invariant(c("logarithm"), name="V")
    run = integrate(fun, (0, 40), start, invariants=kept, params=[1.0], **options)
    assert run.success
    assert run.max_residual[0] < 1e-13
    other = Invariant(c("logarithm"), name="V")
    with pytest.raises(RuntimeError, match="invariant 'V' returned the status -7"):
        integrate(fun, (0, 40), np.array([1e-4, 3.0]), invariants=other, params=[-1.0], method=EIPRK4, h=1.5)


# Cost of differences.


def chain(t, y):
    """A field on a ring: q'' = q_xx - sin(q)."""
    n, out = y.size // 2, np.empty(y.size)
    for k in range(n):
        out[k] = y[n + k]
        out[n + k] = y[(k - 1) % n] - 2 * y[k] + y[(k + 1) % n] - np.sin(y[k])
    return out


def chain_energy(t, y):
    n, total = y.size // 2, 0.0
    for k in range(n):
        total += y[n + k] ** 2 / 2 + (y[(k + 1) % n] - y[k]) ** 2 / 2 + 1 - np.cos(y[k])
    return total


def pulse(m):
    return np.concatenate([np.exp(-(np.linspace(-4, 4, m) ** 2)), np.zeros(m)])


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [False, True])
def test_gradients_of_a_large_grid_are_made_of_f_or_their_cost_is_told(compiled):
    """An energy needs no evaluation of its gradient; for a mass the warning appears once, with what to write."""
    m = LARGE // 2
    fun, energy, mass = (njit(g) if compiled else g for g in (chain, chain_energy, lambda t, y: np.sum(y**2)))
    options = {"method": EIPRK4, "h": 0.05}
    run = integrate(fun, (0, 0.1), pulse(m), invariants=Invariant(energy, name="H"), **options)
    assert run.compiled == compiled
    assert "the gradient of 'H' is made of the components of f" in run.diagnostics.remarks
    told = pytest.warns(UserWarning, match=rf"no grad is given for 'B': .* {2 * m} evaluations .* 2 \* w \* y")
    with told as found:
        other = integrate(fun, (0, 0.1), pulse(m), invariants=Invariant(mass, name="B"), check=False, **options)
    assert len(found) == 1
    assert other.compiled == compiled
    mended = Invariant(chain_energy, lambda t, y, f: np.concatenate([-f[m:], f[:m]]), uses_f=True, name="H")
    other = integrate(chain, (0, 0.1), pulse(m), method=EIPRK4, h=0.05, invariants=mended)
    np.testing.assert_allclose(run.y, other.y, rtol=0, atol=1e-13)
    few = pulse(m - 1)
    integrate(fun, (0, 0.1), few, method=EIPRK4, h=0.05, invariants=Invariant(energy, name="H"))
