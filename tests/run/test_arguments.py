"""`args` of integrate and ensemble: passed on as SciPy does, natively if they are numbers."""

import numpy as np
import pytest
from c_compiler import low_level, shared_library
from numba import njit
from scipy.integrate import solve_ivp
from systems import refuse

from eip_scipy import EIPRK4, Invariant, integrate
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.problems import kepler

Y0, SPAN, K, M = np.array([1.0, 0.5]), (0.0, 10.0), 2.0, 3


def oscillator(t, y, k, m):
    return np.array([y[1], -k * y[0] / m])


def energy(t, y, k, m):
    return 0.5 * (m * y[1] * y[1] + k * y[0] * y[0])


def energy_gradient(t, y, k, m):
    return np.array([k * y[0], m * y[1]])


def crosses(t, y, k, m):
    return k * y[0]


crosses.terminal, crosses.direction = 1, -1.0
jit_oscillator, jit_energy, jit_gradient = njit(oscillator), njit(energy), njit(energy_gradient)
jit_crosses = njit(crosses)
jit_crosses.terminal, jit_crosses.direction = 1, -1.0
PYTHON = oscillator, Invariant(energy, energy_gradient, name="H"), crosses
JITTED = jit_oscillator, Invariant(jit_energy, jit_gradient, name="H"), jit_crosses
NO_GRADIENT = jit_oscillator, Invariant(jit_energy, name="H"), jit_crosses
OWN = jit_oscillator, Invariant(jit_energy, jit_gradient, args=(K, M), name="H"), jit_crosses
PYTHON_EVENT = jit_oscillator, Invariant(jit_energy, jit_gradient, name="H"), crosses


def run(functions, **options):
    fun, kept, event = functions
    options = {"method": EIPRK4, "h": 0.05, "args": (K, M), "invariants": kept, "events": event} | options
    return integrate(fun, SPAN, Y0, **options)


@pytest.mark.parametrize(
    ("functions", "kind"),
    [(PYTHON, "python"), (JITTED, "jitted"), (NO_GRADIENT, "jitted"), (OWN, "jitted"), (PYTHON_EVENT, "jitted")],
    ids=["Python", "Numba", "without gradient", "args of the invariant's own", "event in Python"],
)
def test_the_bits_of_solve_ivp(functions, kind):
    kept = Invariant(energy, energy_gradient, args=(K, M))
    expected = solve_ivp(
        oscillator, SPAN, Y0, method=EIPRK4, h=0.05, args=(K, M), events=crosses, invariants=kept, t_eval=None
    )
    result = run(functions)
    assert result.status == 1
    assert result.calls["fun"] == result.calls["H"] == result.calls["gradient of H"] == kind
    np.testing.assert_allclose(result.y[:, -1], expected.y_events[0][-1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(result.t_events[0], expected.t_events[0], rtol=1e-15)
    np.testing.assert_array_equal(
        run(functions, events=None, save_every=1).y,
        solve_ivp(oscillator, SPAN, Y0, method=EIPRK4, h=0.05, args=(K, M), invariants=kept).y,
    )


def test_numbers_keep_their_types():
    @njit
    def fun(t, y, power, weights, backward):
        return -(y**power) * weights if not backward else y[: power - 1] * 1.0

    result = integrate(fun, (0, 1), [1.0, 2.0], method=EIPRK4, h=0.1, args=(2, 0.5, False))
    np.testing.assert_allclose(result.y[:, -1], 1 / (1 / np.array([1.0, 2.0]) + 0.5), rtol=1e-5)
    assert result.compiled


def test_an_integer_that_no_float_holds_is_passed_by_python():
    fun = njit(lambda t, y, k: np.array([1.0 * (k % 2)]))
    for k, compiled in ((2**53 - 1, True), (2**53 + 1, False)):
        result = integrate(fun, (0, 1), [0.0], method=EIPRK4, h=0.5, args=(k,))
        assert (result.y[0, -1], result.compiled) == (pytest.approx(1.0), compiled)


def test_one_array_is_params():
    fun = njit(lambda t, y, p: oscillator_of(t, y, p))
    by_args = integrate(fun, SPAN, Y0, method=EIPRK4, h=0.1, args=(np.array([K, M]),))
    by_params = integrate(fun, SPAN, Y0, method=EIPRK4, h=0.1, params=[K, M])
    assert by_args.compiled
    np.testing.assert_array_equal(by_args.y, by_params.y)


oscillator_of = njit(lambda t, y, p: np.array([y[1], -p[0] * y[0] / p[1]]))
oscillator_of_both = njit(lambda t, y, p, m: np.array([y[1], -p[0] * y[0] / m]))


def test_other_arguments_are_python_s():
    arguments = (np.array([K]), M)
    result = integrate(oscillator_of_both, SPAN, Y0, method=EIPRK4, h=0.05, args=arguments)
    assert not result.compiled
    assert "args are neither numbers nor one array of floats" in result.message
    np.testing.assert_array_equal(result.y, run(JITTED, invariants=(), events=None).y)
    with pytest.raises(TypeError, match="args are neither numbers"):
        integrate(oscillator_of_both, SPAN, Y0, method=EIPRK4, h=0.05, args=arguments, compiled=True)
    seen = []
    by_name = {"k": K}
    integrate(lambda t, y, a: seen.append(a) or -a["k"] * y, SPAN, Y0, method=EIPRK4, h=0.5, args=(by_name,))
    assert all(a is by_name for a in seen)


C_SOURCE = """
int rhs(double t, const double *y, double *out, const double *p) {
    out[0] = y[1]; out[1] = -p[0] * y[0] / p[1]; return 0; }
int energy(double t, const double *y, double *out, const double *p) {
    out[0] = 0.5 * (p[1] * y[1] * y[1] + p[0] * y[0] * y[0]); return 0; }
int gradient(double t, const double *y, const double *f, double *out, const double *p) {
    out[0] = p[0] * y[0]; out[1] = p[1] * y[1]; return 0; }
"""


def test_c_functions_get_numbers_as_params(tmp_path):
    (tmp_path / "oscillator.c").write_text(C_SOURCE)
    library = shared_library(tmp_path / "oscillator.so", tmp_path / "oscillator.c")
    pointers = [low_level(library, name, arrays) for name, arrays in (("rhs", 3), ("energy", 3), ("gradient", 4))]
    functions = pointers[0], Invariant(*pointers[1:], name="H"), None
    expected = run(JITTED, events=None)
    np.testing.assert_array_equal(run(functions).y, expected.y)
    np.testing.assert_array_equal(run(functions, compiled=False).y, expected.y)
    with pytest.raises(TypeError, match="fun is a C function: its arguments after t and y are numbers"):
        run(functions, args=(K, "steel"))


def test_they_belong_to_a_run(tmp_path):
    path = tmp_path / "run"
    whole = run(JITTED, events=None, checkpoint=path)
    np.testing.assert_array_equal(run(JITTED, events=None, checkpoint=path, resume=True).y, whole.y)
    with pytest.raises(CheckpointError, match="params"):
        run(JITTED, events=None, checkpoint=path, resume=True, args=(K, 4))
    half = integrate(jit_oscillator, (0, 5), Y0, method=EIPRK4, h=0.05, args=(K, M)).continue_to(10)
    np.testing.assert_allclose(half.y[:, -1], run(JITTED, events=None, invariants=()).y[:, -1], atol=1e-12)


def test_what_is_refused():
    deaf = Invariant(lambda t, y: y @ y, name="S")
    rows = [
        ({"args": K}, r"args must be a tuple, got 2.0; write args=\(x,\)"),
        ({"params": [K]}, "args or params, not both"),
        ({"fun": kepler(), "y0": None}, "pass params="),
        ({"args": (K,)}, r"fun is called with \(t, y, args\[0\]\): missing a required argument: 'm'"),
        ({"invariants": deaf}, r"'S' is called with \(t, y, args\[0\], args\[1\]\).* then the args of the run"),
        ({"events": lambda t, y: y[0]}, r"event 0 is called with \(t, y, args\[0\], args\[1\]\)"),
    ]
    given = {"fun": oscillator, "t_span": SPAN, "y0": Y0, "method": EIPRK4, "h": 0.1, "args": (K, M)}
    refuse(integrate, [(given | options, TypeError, words) for options, words in rows])
