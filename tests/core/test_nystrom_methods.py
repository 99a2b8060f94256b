"""Runge-Kutta-Nystrom methods through solve_ivp and integrate: orders, dense output, bits, and refused arguments."""

from fractions import Fraction

import numba
import numpy as np
import pytest
from closed_forms import kepler_state
from orders import observed_order
from scipy.integrate import solve_ivp
from systems import JIT_H, JIT_L, orbit

from eip_scipy import EIPRKN8, EIPRKN12, Diagnostics, eip_method, integrate
from eip_scipy.methods import NystromTableau
from eip_scipy.problems import solar_system

Y0 = np.array([0.8, 0.1, -0.2, 1.1])
both = pytest.mark.parametrize("method", [EIPRKN8, EIPRKN12])


@numba.njit
def acceleration(t, q):
    return -q / (q[0] ** 2 + q[1] ** 2) ** 1.5


@numba.njit
def fill_acceleration(t, q, out):
    w = -1.0 / (q[0] ** 2 + q[1] ** 2) ** 1.5
    out[0], out[1] = w * q[0], w * q[1]


INVARIANTS = [JIT_H, JIT_L]
TAYLOR = NystromTableau("Taylor 2", [[]], ["1/2"], [1], [0], 1, reference="q + h v + h^2 a / 2, v + h a")
KEPT = {"invariants": INVARIANTS, "blocks": 2}


@pytest.fixture(scope="module")
def exact():
    return kepler_state(Y0, 2)


@pytest.mark.parametrize("options", [{"invariants": ()}, KEPT, {**KEPT, "metric": "euclidean"}])
@pytest.mark.parametrize(("method", "n"), [(EIPRKN8, (8, 12)), (EIPRKN12, (4, 5))])
def test_order(method, n, options, exact):
    """The steps of one interval are so large that truncation dominates."""
    given = {"acceleration": acceleration, "t_span": (0, 2), "y0": Y0, "method": method, "compiled": False, **options}
    errors = [np.abs(integrate(h=2 / k, **given).y[:, -1] - exact).max() for k in n]
    assert errors[1] > 3e-14
    assert observed_order(errors, [1 / k for k in n])[0] > method.TABLEAU.order - 1.0


@both
def test_time_reaches_every_stage(method):
    """q'' = -9 sin 3t from t0 = 0.4: exact q = sin 3t."""
    start, end = (np.array([np.sin(3 * t), 3 * np.cos(3 * t)]) for t in (0.4, 2.4))
    for compensated in (False, True):
        given = {"t_span": (0.4, 2.4), "y0": start, "method": method, "h": 0.05, "compensated": compensated}
        run = integrate(acceleration=lambda t, q: np.array([-9 * np.sin(3 * t)]), **given)
        np.testing.assert_allclose(run.y[:, -1], end, rtol=0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.needs_jit
@both
@pytest.mark.parametrize("options", [{"invariants": ()}, KEPT, {**KEPT, "every": 3}, {**KEPT, "every": "auto"}])
def test_all_ways_give_the_same_bits(method, options):
    span, h = (0, 3), 0.05
    end = solve_ivp(orbit, span, Y0, method=method, h=h, **options).y[:, -1]
    for fun, in_place in ((acceleration, False), (fill_acceleration, True)):
        given = {"method": method, "h": h, "in_place": in_place, **options}
        runs = [
            integrate(acceleration=fun, t_span=span, y0=Y0, compiled=compiled, **given) for compiled in (False, True)
        ]
        np.testing.assert_array_equal(runs[0].y, runs[1].y)
        assert runs[0].nfev == runs[1].nfev
    np.testing.assert_allclose(runs[0].y[:, -1], end, rtol=0, atol=1e-13)


@both
@pytest.mark.parametrize("backward", [False, True])
def test_adaptive(method, backward, exact):
    start, span = (exact, (2, 0)) if backward else (Y0, (0, 2))
    end = Y0 if backward else exact
    diagnostics = Diagnostics()
    sol = solve_ivp(orbit, span, start, method=method, rtol=1e-9, atol=1e-11, diagnostics=diagnostics, **KEPT)
    assert sol.status == 0
    np.testing.assert_allclose(sol.y[:, -1], end, rtol=0, atol=2e-8)
    assert diagnostics.max_residual.max() < 1e-14
    run = integrate(acceleration=acceleration, t_span=span, y0=start, method=method, rtol=1e-9, atol=1e-11, **KEPT)
    assert run.compiled != numba.config.DISABLE_JIT
    np.testing.assert_allclose(run.y[:, -1], sol.y[:, -1], rtol=0, atol=1e-12)


@both
def test_what_is_no_second_order_system(method):
    """The order of the state is wrong, an acceleration depends on the velocity, or the number of components is odd."""
    with pytest.raises(ValueError, match="the first 2 components of fun must be v"):
        solve_ivp(lambda t, y: np.concatenate([acceleration(t, y[2:]), y[:2]]), (0, 1), Y0, method=method, h=0.1)
    with pytest.raises(ValueError, match="accelerations in fun depend on the velocity; use a Runge-Kutta"):
        solve_ivp(lambda t, y: [y[2], y[3], -y[2], -y[3]], (0, 1), Y0, method=method, h=0.1)
    for call in (
        lambda: solve_ivp(lambda t, y: -y, (0, 1), Y0[:3], method=method, h=0.1),
        lambda: integrate(acceleration=acceleration, t_span=(0, 1), y0=Y0[:3], method=method, h=0.1),
    ):
        with pytest.raises(ValueError, match="even number of components, but y0 has 3"):
            call()
    with pytest.raises(ValueError, match=r"acceleration returned shape \(4,\), expected \(2,\)"):
        integrate(acceleration=lambda t, q: np.zeros(4), t_span=(0, 1), y0=Y0, method=method, h=0.1)


@pytest.mark.needs_jit
@pytest.mark.slow
@pytest.mark.parametrize(
    "h", [0.02, *(pytest.param(h, marks=[pytest.mark.nightly, pytest.mark.slow]) for h in (1 / 64, 0.01, 0.005))]
)
def test_spacing_by_itself_never_spoils_a_small_step(h):
    """every="auto" over 1000 years: no planet worse than twice without projection, or 3e-8 AU, at no evaluation."""
    problem = solar_system()
    reference = problem.reference(1000.0)
    plain, kept = (
        integrate(problem, (0, 1000), method=EIPRKN12, h=h, compensated=True, **options)
        for options in ({"invariants": ()}, {"every": "auto"})
    )
    of_plain, of_kept = (
        np.linalg.norm((run.y[:, -1] - reference)[:30].reshape(10, 3), axis=1)[1:] for run in (plain, kept)
    )
    assert np.all(of_kept < np.maximum(2 * of_plain, 3e-8))
    assert kept.nfev == plain.nfev


def test_compensated_sum_of_a_constant_acceleration():
    """There and back in 3000 steps of a length with many bits, against fractions; one stage leaves no sum to round."""
    h, steps, a = 0.1, 3_000, np.array([1 / 3, -0.7])
    v0 = -0.5 * a * (steps * h)
    last = Fraction(steps * h - (steps - 1) * h)
    time = (steps - 1) * Fraction(h) + last
    exact_end = [Fraction(v) * time + Fraction(x) * time**2 / 2 for v, x in zip(v0, a, strict=True)]

    def error(compensated):
        options = {"h": h, "method": eip_method(TAYLOR), "compensated": compensated, "compiled": False}
        y = integrate(acceleration=lambda t, q: a, t_span=(0, steps * h), y0=np.concatenate([0 * v0, v0]), **options).y[
            :2, -1
        ]
        return max(abs(float(Fraction(x) - wanted)) for x, wanted in zip(y, exact_end, strict=True))

    assert error(True) < 1e-14
    assert error(False) > 100 * error(True)


def test_auto_projects_where_it_pays():
    """Large steps are projected one and all; small ones, whose error is below round-off, at the end only."""
    counts = []
    for h in (0.5, 0.005):
        run = integrate(acceleration=acceleration, t_span=(0, 10), y0=Y0, method=EIPRKN12, h=h, every="auto", **KEPT)
        counts.append((run.diagnostics.n_projections + run.diagnostics.n_skipped, round(10 / h)))
    assert counts[0][0] == counts[0][1]
    assert counts[1][0] <= 3
