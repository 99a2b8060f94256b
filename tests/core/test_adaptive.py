"""Adaptive steps with invariants: the effect of every option, what a step control must do, and failures of runs."""

import math
import warnings

import numpy as np
import pytest
import systems
from scipy.integrate import solve_ivp
from systems import H_USES_F, JIT_SQUARE, SQUARE, VOLTERRA, H, L, energy, lotka_volterra, orbit, oscillator, pericentre

from eip_scipy import EIPDOP853, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, Diagnostics, Invariant, integrate

EPS = np.finfo(float).eps
NIGHTLY = pytest.mark.nightly
METHODS = [EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPDOP853]
second_order = pytest.param(EIPRK2, marks=NIGHTLY)  # in thousands of steps
methods = pytest.mark.parametrize("method", [second_order, *METHODS], ids=lambda m: m.__name__)
E = 0.6
Y0 = pericentre(E)


def run(fun=orbit, t_span=(0.0, 6.0), y0=Y0, **options):
    saved = {} if "t_eval" in options else {"save_every": 1}
    return integrate(fun, t_span, y0, **{"method": EIPRK45, **saved, **options})


@methods
def test_invariants_are_kept(method):
    """No h is needed; residuals of O(h^(2p + 2)) are below the local error, far below the tolerance."""
    for t_span in ((0.0, 10.0), (10.0, 0.0)):
        options = {"t_span": t_span, "method": method, "rtol": 1e-6, "atol": 1e-9}
        found = run(invariants=[H, L], **options)
        d, n = found.diagnostics, len(found.t) - 1
        assert (found.status, found.t[-1]) == (0, t_span[1])
        assert (np.diff(found.t) * np.sign(t_span[1] - t_span[0]) > 0).all()
        assert len(set(np.round(np.diff(found.t), 12))) > 5, "steps of one length"
        at_steps = np.array([[abs(item.fun(0, y) - item.fun(0, Y0)) for item in (H, L)] for y in found.y.T])
        assert at_steps.max() < 1e-9
        np.testing.assert_allclose(d.max_residual, at_steps.max(axis=0), rtol=0, atol=1e-15)
        np.testing.assert_allclose(d.last_residual, at_steps[-1], rtol=0, atol=1e-15)
        assert np.abs(energy(0, run(**options).y[:, -1]) - energy(0, Y0)) > 1e-8
        # The counts of projections.
        assert d.names == ("energy", "momentum")
        assert d.n_projections + d.n_skipped == found.njev == n
        assert d.n_projections > 0.5 * n
        assert d.n_rejected_projections == 0
        assert found.nlu == d.n_projections
        assert 0 < d.max_correction < 1e4
        assert "energy" in repr(d)
    # The largest correction is measured in local errors, which the euclidean metric does not use.
    assert math.isnan(run(invariants=[H, L], metric="euclidean").diagnostics.max_correction)


@methods
def test_error_goes_with_the_tolerance(method):
    """A tolerance of 0.1 rtol needs 10^(1 / (p_hat + 1)) times the steps; the estimate is that of the raw step."""
    exact = solve_ivp(orbit, (0, 10), Y0, method="DOP853", rtol=3e-14, atol=1e-16).y[:, -1]
    # DOP853 needs small tolerances to leave its first steps behind.
    tolerances = (1e-7, 1e-10) if method is EIPDOP853 else (1e-4, 1e-7)
    coarse, fine = (
        run(t_span=(0, 10), method=method, rtol=rtol, atol=rtol * 1e-3, invariants=[H, L], blocks=2)
        for rtol in tolerances
    )
    assert np.abs(fine.y[:, -1] - exact).max() < np.abs(coarse.y[:, -1] - exact).max() / 30
    order = method.TABLEAU.error_estimator_order
    assert math.log(1e3) / math.log(len(fine.t) / len(coarse.t)) == pytest.approx(order + 1, rel=0.25)
    kept, free = (len(run(t_span=(0, 20), method=method, rtol=1e-5, invariants=i).t) for i in ([H, L], ()))
    assert kept == pytest.approx(free, rel=0.2)


OFF = Invariant(energy, systems.energy_gradient, target=-0.45)
# The option, whether it changes the states, and the energy that is kept.
OPTIONS = {
    "no invariants": ({"invariants": ()}, True, None),
    "one": ({"invariants": H}, False, -0.5),
    "rtol by component": ({"rtol": [1e-3, 1e-4, 1e-5, 1e-6]}, True, -0.5),
    "atol by component": ({"atol": [1e-3, 1e-4, 1e-5, 1e-6]}, True, -0.5),
    "metric error": ({"metric": "error"}, False, -0.5),
    "metric euclidean": ({"metric": "euclidean"}, True, -0.5),
    "metric weights": ({"metric": [1.0, 1.0, 0.3, 0.3]}, True, -0.5),
    "euclidean, every": ({"metric": "euclidean", "every": 3}, True, -0.5),
    "several": ({"every": 2, "iterations": 2, "blocks": 2, "reuse_f": False, "max_step": 0.5}, True, -0.5),
    "blocks": ({"blocks": 2}, True, -0.5),
    "blocks by index": ({"blocks": [[0, 1], [2, 3]]}, True, -0.5),
    "linear_invariants": ({"linear_invariants": ([[0.0, 0.0, 1.0, 0.0]], [[0.0], [0.0], [1.0], [0.0]])}, True, -0.5),
    "direction old": ({"direction": "old"}, True, -0.5),
    "direction midpoint": ({"direction": "midpoint"}, True, -0.5),
    "iterations": ({"iterations": 4}, True, -0.5),
    "every": ({"every": 5}, True, -0.5),
    "reuse_f": ({"reuse_f": False}, True, -0.5),
    "uses_f": ({"invariants": H_USES_F}, False, -0.5),
    "check": ({"check": False}, False, -0.5),
    "project_initial": ({"invariants": OFF, "project_initial": True}, True, -0.45),
    "first_step": ({"first_step": 0.01}, True, -0.5),
    "max_step": ({"max_step": 0.1}, True, -0.5),
}


@pytest.mark.parametrize("option", OPTIONS)
def test_options_of_both_drivers(option):
    """solve_ivp takes the same steps, bit for bit, and an option has its effect."""
    given, has_effect, kept = OPTIONS[option]
    options = {"rtol": 1e-4, "atol": 1e-6, "invariants": H} | given
    for method in (EIPRK4, EIPDOP853):
        found = run(method=method, **options)
        d = Diagnostics()
        sol = solve_ivp(orbit, (0.0, 6.0), Y0, method=method, diagnostics=d, **options)
        assert found.status == sol.status == 0
        assert (found.nfev, found.njev, found.nlu) == (sol.nfev, sol.njev, sol.nlu)
        assert repr(found.diagnostics) == repr(d)
        if kept is None:  # EIPDOP853 takes SciPy's own steps then
            np.testing.assert_allclose(found.y, sol.y, rtol=0, atol=1e-7)
        else:
            np.testing.assert_array_equal(found.t, sol.t)
            np.testing.assert_array_equal(found.y[:, 1:], sol.y[:, 1:])
            np.testing.assert_array_equal(sol.y[:, 0], Y0)  # as it was given
            assert found.njev > 0
            left = abs(energy(0, sol.y[:, -1]) - (kept if option == "project_initial" else energy(0, Y0)))
            assert d.last_residual[0] == pytest.approx(left, abs=1e-15)
            assert abs(energy(0, found.y[:, -1]) - kept) < 1e-5
            assert energy(0, found.y[:, 0]) == pytest.approx(kept, abs=1e-14)
        bare = run(method=method, rtol=1e-4, atol=1e-6, invariants=H)
        assert np.array_equal(bare.y[:, -1], found.y[:, -1]) != has_effect


def test_zero_length_interval():
    for method in (*METHODS, EIPRK2):
        options = {"method": method, "dense_output": True, "events": lambda t, y: y[0]}
        found = run(t_span=(2.0, 2.0), invariants=[H, L], **options)
        assert found.status == 0
        assert set(found.t.tolist()) == {2.0}
        assert (found.y == Y0[:, None]).all()
        assert found.njev == found.t_events[0].size == 0
        np.testing.assert_array_equal(found.sol(2.0), Y0)


@pytest.mark.parametrize("driver", [run, solve_ivp])
@pytest.mark.parametrize("rtol", [0.0, [1e-3, 1e-20, 1e-3, 1e-3]])
def test_rtol_too_small_warns_as_scipy_s(driver, rtol):
    options = {"t_span": (0, 0.1), "y0": Y0, "invariants": H, "method": EIPRK45}
    with pytest.warns(UserWarning, match=r"At least one element of `rtol` is too small\. Setting `rtol = np") as record:
        found = driver(orbit, rtol=rtol, **options)
    assert len(record) == 1
    assert record[0].filename == __file__ or "scipy" in record[0].filename
    np.testing.assert_array_equal(found.y, driver(orbit, rtol=np.maximum(rtol, 100 * EPS), **options).y)


@pytest.mark.filterwarnings("ignore:.*not to be trusted:eip_scipy.ProjectionWarning")  # nor is it
@pytest.mark.parametrize("method", [EIPRK2, EIPRK23, EIPRK4, EIPRK45], ids=lambda m: m.__name__)
def test_invariant_nan_after_a_trial_step_is_mended_by_shorter_ones(method):
    """A loose first step of 2 takes Lotka-Volterra to u < 0: it is rejected, h x 0.25, and the run continues."""
    options = {"rtol": 0.5, "atol": 5.0, "first_step": 2.0, "invariants": VOLTERRA, "metric": "euclidean"}
    found = run(lotka_volterra, (0, 20), [4.0, 2.0], method=method, **options)
    assert found.status == 0
    assert (found.y > 0).all()
    assert found.diagnostics.n_rejected_projections >= 1
    assert found.t[1] - found.t[0] < 1.0
    assert np.isfinite(found.max_residual).all()
    assert np.ptp([VOLTERRA.fun(0, u) for u in found.y.T]) < 3.0


@pytest.mark.parametrize("driver", [run, solve_ivp])
def test_shorter_and_shorter_at_most_ten_times(driver):
    """An invariant that nothing meets after t = 0: trials of h, h / 4, h / 16 ..., ten retries, then the end."""
    asked = []

    def value(t, y):
        asked.append(t)
        return y @ y if t == 0 else math.nan

    d = Diagnostics()
    options = {"rtol": 0.5, "atol": 1.0, "first_step": 0.5, "check": False, "method": EIPRK45, "diagnostics": d}
    found = driver(oscillator, (0, 1), [1.0, 2.0], invariants=Invariant(value, SQUARE.grad, name="stubborn"), **options)
    assert (found.status, found.success) == (-1, False)
    place = f"projection failed at t={0.5 / 4**10:g}"
    assert found.message.startswith(f"{place}: invariant 'stubborn', residual nan, rank 1 of 1")
    np.testing.assert_array_equal(np.unique([t for t in asked if t > 0])[::-1], 0.5 / 4.0 ** np.arange(11))
    assert d.n_rejected_projections == 11
    np.testing.assert_array_equal(found.t, [0.0])
    np.testing.assert_array_equal(found.y, [[1.0], [2.0]])


def test_failed_projection_counts_only_in_a_row():
    """Occasional failures are recovered each time: many steps are rejected, and the run ends well."""
    asked = []

    def value(t, y):
        asked.append(t)
        return math.nan if len(asked) % 7 == 0 else y @ y

    def cubic(t, y):  # rotation by an angle that goes with the state: no step keeps the radius
        return (1 + y[0] ** 2) * oscillator(t, y)

    flaky = Invariant(value, SQUARE.grad, target=5.0)
    found = run(cubic, (0, 30), [1.0, 2.0], invariants=flaky, check=False, rtol=1e-5)
    assert found.status == 0
    assert found.diagnostics.n_rejected_projections > 11
    np.testing.assert_allclose((found.y**2).sum(axis=0), 5.0, rtol=1e-5)


@pytest.mark.parametrize("driver", [run, solve_ivp])
@pytest.mark.parametrize("invariants", [(), [H]], ids=["plain", "projected"])
@pytest.mark.parametrize("since", [0.0, 1.0])
def test_rhs_not_finite(driver, invariants, since):
    """The step shrinks towards the time, then status -1 that names it; everything before is kept."""
    for bad in (math.nan, math.inf):
        calls = []

        def fun(t, y, calls=calls, bad=bad):
            calls.append(t)
            assert len(calls) < 2000, "it hangs, as SciPy does"
            return orbit(t, y) if t < since else np.full(4, bad)

        options = {"t_span": (0, 2), "y0": Y0, "invariants": invariants, "check": False, "method": EIPRK45}
        with np.errstate(all="ignore"):
            found = driver(fun, **options)
        assert found.status == -1
        assert found.message.startswith(f"fun returned a non-finite value at t={since:g}")
        assert since * 0.99 <= found.t[-1] <= since
        assert np.isfinite(found.y).all()
        clean = driver(orbit, **options)
        first = np.count_nonzero(clean.t < 0.5 * since) + (since == 0)
        np.testing.assert_array_equal(found.y[:, :first], clean.y[:, :first])


@pytest.mark.parametrize("driver", [run, solve_ivp])
def test_overflow_without_a_flood_of_warnings(driver):
    """y' = 1e200 y: a handful of warnings at most, none of them of the package's own lines, and a clean end."""
    for method in METHODS:
        for invariants in ((), Invariant(lambda t, y: 1.0, lambda t, y: np.zeros(1))):
            options = {"method": method, "invariants": invariants, "check": False}
            with warnings.catch_warnings(record=True) as record:
                warnings.simplefilter("default")  # one per line of code, as users see them
                found = driver(lambda t, y: 1e200 * y, (0, 2), [1.0], **options)
            assert found.status == -1
            assert np.isfinite(found.y).all()
            assert not [w for w in record if "eip_scipy" in w.filename and not w.filename.startswith(__file__)]
            assert len(record) <= 10


@pytest.mark.parametrize("driver", [run, solve_ivp])
def test_nfev_is_the_number_of_calls(driver):
    for method in METHODS:
        for options in ({}, {"invariants": [H, L]}, {"invariants": [H_USES_F], "reuse_f": False}, {"every": 3}):
            calls = []

            def fun(t, y, calls=calls):
                calls.append(t)
                return orbit(t, y)

            check = {"check": False} if "invariants" in options else {}
            found = driver(fun, (0, 6), Y0, method=method, **options, **check)
            assert found.nfev == len(calls), (method, options)


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.needs_jit), False])
def test_memory_bound_of_an_adaptive_run(compiled):
    """The number of steps is not known before: the run ends when the rows would outgrow the bound, with all of them."""
    options = {"fun": systems.jit_oscillator, "t_span": (0, 1e4), "y0": [1.0, 2.0], "invariants": JIT_SQUARE}
    options |= {"compiled": compiled, "max_bytes": 8 * 4 * 3000}  # a row: time, two components, one invariant
    with pytest.raises(MemoryError, match="increase save_every or max_bytes") as caught:
        run(max_step=0.01, **options)
    partial = caught.value.partial
    assert partial.status == -1
    assert 1000 <= len(partial.t) <= 3000
    steps = np.diff(partial.t)
    assert 0 < steps.min() < steps.max() <= 0.01 + 1e-12
    np.testing.assert_allclose((partial.y**2).sum(axis=0), 5.0, rtol=1e-12)
    assert partial.invariants.shape == (1, len(partial.t))
    assert run(max_step=1.0, save_every=1000, **options).status == 0


def test_rows_grow_beyond_the_first_thousand():
    options = {"t_span": (0, 12), "method": EIPRK23, "rtol": 1e-8, "atol": 1e-10, "invariants": H}
    found = run(**options)
    assert len(found.t) > 2100
    assert (np.diff(found.t) > 0).all()
    seldom = run(**options, save_every=1000)
    np.testing.assert_array_equal(seldom.y, found.y[:, [*range(0, len(found.t) - 1, 1000), -1]])
