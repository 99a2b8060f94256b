"""User-defined one-step methods: the same projection as for tableaux, and refused methods."""

import numpy as np
import pytest
from orders import observed_order
from scipy.integrate import solve_ivp
from systems import Verlet, oscillator

from eip_scipy import EIPRK4, Diagnostics, Invariant, eip_method, integrate
from eip_scipy.problems import kepler


class RK4:
    """The classical method with the estimate of `EIPRK4`, written out."""

    order = 4

    def __init__(self, fun):
        self.fun = fun

    def one_step(self, t, y, h):
        k1 = self.fun(t, y)
        k2 = self.fun(t + h / 2, y + h / 2 * k1)
        k3 = self.fun(t + h / 2, y + h / 2 * k2)
        self.k4 = self.fun(t + h, y + h * k3)
        return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + self.k4)


class RK43(RK4):
    error_estimator_order = 3
    name = "RK4(3)"

    def one_step(self, t, y, h):
        y_hat = super().one_step(t, y, h)
        return y_hat, h / 6 * (self.k4 - self.fun(t + h, y_hat))


LENGTH = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, name="length")
FORCED = Invariant(lambda t, y: y @ y, lambda t, y, f: np.array([-2 * f[1], 2 * f[0]]), uses_f=True)


def closed(t):
    return np.array([np.cos(t), -np.sin(t)])


def runs(method, **options):
    """Return states at the end of both drivers."""
    sol = solve_ivp(oscillator, (0, 10), [1.0, 0.0], method=method, **options)
    run = integrate(oscillator, (0, 10), [1.0, 0.0], method=method, save_every=1, **options)
    assert sol.success
    assert run.success
    np.testing.assert_array_equal(sol.y[:, -1], run.y[:, -1])
    assert (sol.nfev, sol.njev, sol.nlu) == (run.nfev, run.njev, run.nlu)
    return sol


@pytest.mark.parametrize("invariants", [(), LENGTH, FORCED], ids=["none", "length", "uses f"])
def test_fixed_steps_are_those_of_the_tableau(invariants):
    """Steps agree up to rounding: sums run in another order. The method by hand never evaluates f at a raw result."""
    for options in ({}, {"direction": "old"}, {"direction": "midpoint"}, {"iterations": 3}, {"every": 4}):
        options = {"h": 0.1, "metric": "euclidean", "invariants": invariants, **options}
        ours, tableau = runs(eip_method(RK4(oscillator)), **options), runs(EIPRK4, reuse_f=False, **options)
        np.testing.assert_allclose(ours.y, tableau.y, rtol=0, atol=2e-14)
        assert ours.njev == tableau.njev


@pytest.mark.parametrize("metric", ["error", "euclidean"])
def test_adaptive_steps_are_those_of_the_tableau(metric):
    """The estimate controls the steps and weighs the correction."""
    kepler_ = kepler()
    options = {"rtol": 1e-8, "atol": 1e-8, "metric": metric, "invariants": kepler_.invariants, "reuse_f": False}
    # reuse_f: the tableau's first stage may be f of the raw result, the written-out method takes that of the new state.
    ours, tableau = (
        solve_ivp(kepler_.fun, (0, 5), kepler_.y0, method=method, **options)
        for method in (eip_method(RK43(lambda t, y: np.array(kepler_.fun(t, y)))), EIPRK4)
    )
    assert ours.t.size == tableau.t.size
    np.testing.assert_allclose(ours.t, tableau.t, rtol=1e-8)
    np.testing.assert_allclose(ours.y, tableau.y, rtol=0, atol=1e-8)


def test_order_and_invariant_of_a_method_in_place():
    errors, method = [], eip_method(Verlet())
    for h in (0.1, 0.05):
        diagnostics = Diagnostics()
        sol = runs(method, h=h, invariants=LENGTH, diagnostics=diagnostics)
        assert abs(sol.y[:, -1] @ sol.y[:, -1] - 1) < 1e-7
        errors.append(np.abs(sol.y[:, -1] - closed(10)).max())
    assert observed_order(errors, [0.1, 0.05])[0] == pytest.approx(2, abs=0.1)


def test_dense_output_is_the_cubic_through_both_ends():
    """Between the steps its own error is h^4 / 384 = 2.6e-7; events and t_eval are read from it."""
    times = np.linspace(0, 10, 333)
    reached = 8.5e-6  # by the steps, h^4 t / 120
    for invariants in ((), LENGTH):
        options = {"h": 0.1, "invariants": invariants, "method": eip_method(RK4(oscillator))}
        sol = solve_ivp(oscillator, (0, 10), [1.0, 0.0], t_eval=times, events=lambda t, y: y[0], **options)
        assert np.abs(sol.y - closed(sol.t)).max() < reached + 3e-7
        np.testing.assert_allclose(sol.t_events[0], np.pi * np.arange(0.5, 3), atol=reached)
        run = integrate(oscillator, (0, 10), [1.0, 0.0], t_eval=times, **options)
        np.testing.assert_array_equal(run.y, sol.y)
    assert np.abs((sol.y**2).sum(axis=0) - 1).max() < 1e-13


def test_fun_is_called_only_where_someone_asks():
    """At the start; for gradients that take f; for dense output."""
    for invariants, each in (((), 0), (LENGTH, 0), (FORCED, 1)):
        options = {"method": eip_method(Verlet()), "h": 0.1, "invariants": invariants}
        once, twice = (solve_ivp(oscillator, (0, end), [1.0, 0.0], **options).nfev for end in (1, 2))
        assert twice - once == 10 * each


def test_a_method_says_what_it_evaluates():
    """The counts are right in fixed steps and adaptive ones, including rejected steps."""

    class Counted(RK43):
        evaluations = 5

    calls = []
    method = eip_method(Counted(lambda t, y: calls.append(t) or oscillator(t, y)))
    for options in ({"h": 0.1}, {"rtol": 1e-6, "first_step": 3.0}):
        calls.clear()
        sol = runs(method, check=False, **options)
        assert 2 * (sol.nfev - 1) == len(calls)  # of both drivers; the derivative at the start is theirs
    with pytest.raises(ValueError, match=r"evaluations must be an integer >= 0, got -1"):
        eip_method(type("Wrong", (Verlet,), {"evaluations": -1})())


def pendulum(g):
    return lambda t, y: np.array([y[1], -g * np.sin(y[0])])


@pytest.mark.parametrize("lib", [integrate, solve_ivp])
@pytest.mark.parametrize("method", [RK4, RK43])
def test_steps_of_another_equation_are_reported(lib, method):
    for end in (1.0, -1.0):
        options = {"method": eip_method(method(pendulum(1.01))), "h": 0.02, "diagnostics": Diagnostics()}
        words = r"do not solve the equation of fun: .* rate -0\.84988., and fun gives -0\.841471"
        with pytest.warns(UserWarning, match=words):
            lib(pendulum(1.0), (0, end), [1.0, 0.3], **options)
        assert "do not solve the equation" in options["diagnostics"].message
        assert not options["diagnostics"].trusted
        options["diagnostics"] = Diagnostics()
        lib(pendulum(1.0), (0, end), [1.0, 0.3], check=False, **options)
        assert options["diagnostics"].trusted


def test_steps_of_stiff_equations_are_not_reported():
    """An implicit Euler step of y' = -rate (y - z), z' = -z differs from the derivative unless it is very short."""
    for rate in 10.0 ** np.arange(0, 15, 2):

        class Implicit:
            order = 1

            def one_step(self, t, y, h, rate=rate):
                z = y[1] / (1 + h)
                return np.array([(y[0] + h * rate * z) / (1 + h * rate), z])

        def fun(t, y, rate=rate):
            return np.array([-rate * (y[0] - y[1]), -y[1]])

        for away in (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0):
            assert integrate(fun, (0, 0.02), [1 + away, 1.0], method=eip_method(Implicit()), h=0.01).trusted


@pytest.mark.parametrize("force", [1.0, 1e6, 1e12])
def test_steps_where_large_forces_cancel_are_not_reported(force):
    class Kicks:
        """The two forces on each mass act one after the other."""

        order = 1

        def one_step(self, t, y, h):
            y[2:] -= h * force * y[:2]
            y[2:] += h * force * y[1::-1]
            y[:2] += h * y[2:]
            return y

    def fun(t, y):
        return np.concatenate([y[2:], force * (y[1::-1] - y[:2])])

    for q in ([1.0, 1.0], [0.1 + 0.2, 0.3], [1.2, 1.2 + 1e-9]):
        assert integrate(fun, (0, 1e-7), [*q, 0.0, 0.0], method=eip_method(Kicks()), h=1e-7).trusted


def test_an_own_step_runs_interpreted_and_says_so():
    def run(**options):
        return integrate(oscillator, (0, 1), [1.0, 0.0], method=eip_method(Verlet()), h=0.1, **options)

    assert not run().compiled
    assert run().message == "reached the end of the interval (interpreted: Verlet is a one-step method in Python)"
    with pytest.raises(TypeError, match="Verlet is a one-step method in Python"):
        run(compiled=True)
    with pytest.raises(ValueError, match=r"compensated=True .* Verlet is not a tableau"):
        run(compensated=True)
    with pytest.raises(ValueError, match="every='auto' needs an error estimate, and Verlet has none"):
        run(invariants=LENGTH, every="auto")


def returning(value, **attributes):
    return type("Mine", (), {"order": 2, "one_step": lambda self, t, y, h: value, **attributes})()


WRONG_RESULTS = [
    (returning(None), TypeError, "Mine.one_step returned a state: None, expected 2 numbers"),
    (returning([1.0]), ValueError, r"Mine.one_step returned a state: shape \(1,\), expected \(2,\)"),
    (returning([1j, 0.0]), ValueError, "complex values at t=0, but y0 is real"),
    (returning("ab"), TypeError, "'ab', expected 2 numbers"),
    (returning([1.0, 0.0], error_estimator_order=1), TypeError, r"list, expected the pair \(y_hat, err\)"),
    (returning(([1.0, 0.0], 0.0), error_estimator_order=1), ValueError, r"an estimate: shape \(\)"),
]


def test_wrong_results_are_named():
    for method, error, match in WRONG_RESULTS:
        with pytest.raises(error, match=match):
            solve_ivp(oscillator, (0, 1), [1.0, 0.0], method=eip_method(method), h=0.1)


def test_wrong_methods_are_refused():
    for wrong in (Verlet, object(), returning([1.0, 0.0], one_step=3)):
        with pytest.raises(TypeError, match=r"object with one_step\(t, y, h\) and order"):
            eip_method(wrong)
    for name in ("order", "error_estimator_order"):
        with pytest.raises(ValueError, match=f"Mine: {name} must be an integer >= 1, got 0"):
            eip_method(returning([1.0, 0.0], **{name: 0}))
    with pytest.raises(ValueError, match="has no error estimate and needs the step"):
        solve_ivp(oscillator, (0, 1), [1.0, 0.0], method=eip_method(Verlet()))
