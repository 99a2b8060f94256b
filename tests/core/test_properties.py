"""Properties of the projection on random data: invariances, least norms, and what the error metric measures."""

import mpmath
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from reference_step import local_error, runge_kutta
from systems import SQUARE, H, L, orbit, oscillator

from eip_scipy import EIPRK2, EIPRK3, EIPRK4, EIPRK5, Invariant, integrate, project
from eip_scipy.problems import kepler

EPS = np.finfo(float).eps
START = np.array([0.6, 0.3, -0.4, 1.3])
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=60, deadline=None)


class Quadratics:
    """l random invariants y'My/2 + c'y in n dimensions, their values at a random y, and a point off the manifold."""

    def __init__(self, seed, n, rows, offset=1e-3):
        self.rng = np.random.default_rng(seed)
        M = self.rng.standard_normal((rows, n, n))
        self.M, self.c = M + M.transpose(0, 2, 1), self.rng.standard_normal((rows, n))
        self.y = self.rng.standard_normal(n)
        self.target = self.value(0.0, self.y)
        self.y_hat = self.y + offset * self.rng.standard_normal(n)

    def value(self, t, y):
        # einsum with a fixed order of sums: the same bits whatever the memory layout.
        return np.array([0.5 * sum((M @ y) * y) + sum(c * y) for M, c in zip(self.M, self.c, strict=True)])

    def grad(self, t, y):
        return np.array([M @ y + c for M, c in zip(self.M, self.c, strict=True)])

    def invariant(self, factors=1.0):
        factors = np.broadcast_to(factors, len(self.c))
        return Invariant(
            lambda t, y: factors * self.value(t, y),
            lambda t, y: factors[:, None] * self.grad(t, y),
            target=factors * self.target,
        )

    def well_conditioned(self, sigma=1.0):
        rows = self.grad(0.0, self.y_hat) * sigma
        return np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True))[1][-1] > 0.05


sizes = st.tuples(st.integers(2, 9), st.integers(1, 3)).filter(lambda s: s[1] < s[0])


@given(seeds, sizes)
@few
def test_a_state_on_the_manifold_stays_bitwise(seed, size):
    q = Quadratics(seed, *size)
    result = project(q.y, q.invariant(), sigma=q.rng.uniform(0.1, 1, size[0]), iterations=3)
    np.testing.assert_array_equal(result.y, q.y)
    np.testing.assert_array_equal(result.correction, 0.0)
    assert result.rank == 0


@given(seeds, sizes, st.integers(1, 3), st.data())
@few
def test_powers_of_two_in_the_invariants_change_no_bit(seed, size, iterations, data):
    q = Quadratics(seed, *size)
    exponents = data.draw(st.lists(st.integers(-150, 150), min_size=size[1], max_size=size[1]))
    plain = project(q.y_hat, q.invariant(), iterations=iterations)
    scaled = project(q.y_hat, q.invariant(2.0 ** np.array(exponents)), iterations=iterations)
    np.testing.assert_array_equal(scaled.y, plain.y)
    np.testing.assert_array_equal(scaled.residual, plain.residual * 2.0 ** np.array(exponents))
    assert scaled.rank == plain.rank


@given(seeds, sizes, st.integers(1, 2))
@few
def test_order_of_invariants_and_components(seed, size, iterations):
    q = Quadratics(seed, *size)
    n, rows = size
    sigma = 10.0 ** q.rng.uniform(-2, 0, n)
    assume(q.well_conditioned(sigma))
    p, r = q.rng.permutation(n), q.rng.permutation(rows)
    back = np.argsort(p)
    plain = project(q.y_hat, q.invariant(), sigma=sigma, iterations=iterations).y
    shuffled = Invariant(
        lambda t, z: q.value(t, z[back])[r], lambda t, z: q.grad(t, z[back])[r][:, p], target=q.target[r]
    )
    permuted = project(q.y_hat[p], shuffled, sigma=sigma[p], iterations=iterations).y
    np.testing.assert_allclose(permuted[back], plain, rtol=0, atol=1e-11)


@given(seeds, st.integers(2, 9), st.integers(1, 3), st.integers(0, 2))
@few
def test_least_norm_in_the_metric_and_neutral_to_the_frame(seed, n, rows, k):
    """The correction agrees with numpy's pseudo-inverse: move = P sigma x, x of least norm with (G P sigma) x = -g."""
    assume(rows + k < n)
    rng = np.random.default_rng(seed)
    G, y_hat, sigma = rng.standard_normal((rows, n)), rng.standard_normal(n), 10.0 ** rng.uniform(-3, 0, n)
    target = G @ y_hat + rng.standard_normal(rows)
    C, S = rng.standard_normal((k, n)), rng.standard_normal((n, k))
    P = np.eye(n) - S @ np.linalg.solve(C @ S, C)
    A = (G @ P) * sigma
    assume(np.linalg.cond(C @ S) < 100 if k else True)
    assume(np.linalg.cond(A / np.linalg.norm(A, axis=1, keepdims=True)) < 1e3)
    x = np.linalg.pinv(A) @ (target - G @ y_hat)
    linear = Invariant(lambda t, y: G @ y, lambda t, y: G, target=target)
    result = project(y_hat, linear, sigma=sigma, linear_invariants=(C, S) if k else None)
    move = P @ (sigma / sigma.max() * x * sigma.max())
    np.testing.assert_allclose(result.correction, move, rtol=0, atol=1e-10 * np.abs(move).max())
    assert result.rank == rows
    if k:
        drift = np.abs(C @ result.correction)
        assert (drift <= 50 * EPS * (np.abs(C) @ (np.abs(result.y) + np.abs(y_hat)))).all()
        unweighted = project(y_hat, linear, sigma=sigma).correction
        assert np.abs(C @ unweighted).max() > 1e-6 * np.abs(unweighted).max()


@given(seeds, st.integers(2, 6), st.integers(1, 3))
@few
def test_dependent_rows_give_the_pseudo_inverse_s_answer(seed, n, rows):
    """A consistent system of deficient rank: exact multiples and sums of rows."""
    assume(rows < n)
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((rows, n))
    assume(np.linalg.cond(base) < 30)
    G = np.concatenate([base, rng.choice([-2.0, -1.0, 1.0, 3.0], (2, rows)) @ base])
    y_hat, wanted = rng.standard_normal(n), rng.standard_normal(n)
    result = project(y_hat, Invariant(lambda t, y: G @ y, lambda t, y: G, target=G @ wanted))
    assert result.rank == rows
    np.testing.assert_allclose(result.correction, np.linalg.pinv(G, rcond=1e-10) @ (G @ (wanted - y_hat)), atol=1e-11)


@pytest.mark.parametrize("angle", [1e-3, 1e-5, 1e-7])
def test_nearly_parallel_rows(angle):
    """Above the tolerance of rank both are met to round-off: one Gram-Schmidt pass would miss by EPS / angle."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        first, other, shift = rng.standard_normal((3, 6))
        G = np.array([first, first + angle * other])
        # After a shift of size one the second residual is proportional to the angle.
        result = project(np.zeros(6), Invariant(lambda t, y, G=G: G @ y, lambda t, y, G=G: G, target=G @ shift))
        assert result.rank == 2
        with mpmath.workdps(40):
            A = mpmath.matrix(G.tolist())
            wanted = A.T * mpmath.lu_solve(A * A.T, mpmath.matrix((G @ shift).tolist()))
        np.testing.assert_allclose(result.correction, np.array(wanted, float), rtol=0, atol=20 * EPS / angle)
        np.testing.assert_allclose(result.residual, 0.0, atol=40 * EPS)


@pytest.mark.filterwarnings("ignore:the projection left:eip_scipy.ProjectionWarning")
def test_project_takes_one_newton_step_at_t_0_unless_told():
    """From y = 2 towards (1 + t) y^2 = 1: 2 - 3/4, for weights of any size."""
    square = Invariant(lambda t, y: (1 + t) * y[0] ** 2, lambda t, y: 2 * (1 + t) * y, target=1.0)
    for sigma in (None, [2.0**1000], [2.0**-1000]):
        np.testing.assert_array_equal(project([2.0], square, sigma=sigma).y, [1.25])


@given(seeds, sizes, st.integers(1, 4))
@few
def test_iterations_are_newton_s(seed, size, iterations):
    """On the fixed directions G(y_hat)' mu the residuals are those of Newton's method written with numpy's solver."""
    q = Quadratics(seed, *size, offset=1e-2)
    assume(q.well_conditioned())
    directions = q.grad(0.0, q.y_hat).T
    y = q.y_hat
    for _ in range(iterations):
        y = y - directions @ np.linalg.solve(q.grad(0.0, y) @ directions, q.value(0.0, y) - q.target)
    result = project(q.y_hat, q.invariant(), iterations=iterations)
    # Convergence squares the distance, so that a simplified Newton would be far off.
    np.testing.assert_allclose(result.y, y, rtol=0, atol=1e-13)


class ComplexQuadratic:
    """Hermitian forms y^H M y: the mass |y|^2, and a random one."""

    def __init__(self, seed, n):
        self.rng = np.random.default_rng(seed)
        M = self.rng.standard_normal((n, n)) + 1j * self.rng.standard_normal((n, n))
        self.M = np.array([np.eye(n), 0.5 * (M + M.conj().T)])
        self.y = self.rng.standard_normal(n) + 1j * self.rng.standard_normal(n)
        self.target = self.value(0.0, self.y)
        self.y_hat = self.y + 1e-3 * (self.rng.standard_normal(n) + 1j * self.rng.standard_normal(n))

    def value(self, t, y):
        return np.array([sum((np.conj(y) * (M @ y)).real) for M in self.M])

    def grad(self, t, y):
        return np.array([2 * (M @ y) for M in self.M])


@given(seeds, st.integers(2, 6), st.integers(1, 3))
@few
def test_complex_projection_is_that_of_its_parts_bitwise(seed, n, iterations):
    q = ComplexQuadratic(seed, n)
    result = project(q.y_hat, Invariant(q.value, q.grad, target=q.target), iterations=iterations)
    in_parts = Invariant(
        lambda t, z: q.value(t, z.view(complex)),
        lambda t, z: np.ascontiguousarray(q.grad(t, z.view(complex))).view(float),
        target=q.target,
    )
    parts = project(q.y_hat.view(float), in_parts, iterations=iterations)
    np.testing.assert_array_equal(result.y.view(float), parts.y)
    assert result.y.dtype == complex
    assert result.rank == parts.rank == 2


@given(seeds, st.integers(3, 6))
@few
def test_complex_frame(seed, n):
    q = ComplexQuadratic(seed, n)
    C, S = (q.rng.standard_normal(s) + 1j * q.rng.standard_normal(s) for s in ((1, n), (n, 1)))
    assume(abs((C @ S)[0, 0]) > 0.3)
    rows = np.conj(q.grad(0.0, q.y_hat)) @ (np.eye(n) - S @ C / (C @ S)[0, 0])
    assume(np.linalg.cond(rows.view(float) / np.linalg.norm(rows, axis=1, keepdims=True)) < 20)
    kept = Invariant(q.value, q.grad, target=q.target)
    assert abs(C @ project(q.y_hat, kept, linear_invariants=(C, S), iterations=5).correction) < 1e-13
    assert abs(C @ project(q.y_hat, kept, iterations=5).correction) > 1e-9


# The step: units.


def kepler_in_units(unit, metric="error", atol=0.0, blocks=None, steps=40, eccentricity=0.6, time=1.0):
    """Return Kepler with a unit for each component and for the time, at and between the steps."""
    problem = kepler(eccentricity, 0.005 if eccentricity else 0.0)

    def inner(item, t, z):
        y = z / unit
        f = problem.fun(t, y)
        out = np.empty(4)
        item.grad(t, y, *([f] if item.uses_f else []), out, *item.args)
        return out / unit

    invariants = [
        Invariant(lambda t, z, item=item: item.fun(t, z / unit, *item.args), lambda t, z, item=item: inner(item, t, z))
        for item in problem.invariants
    ]
    options = {"metric": metric, "atol": atol, "blocks": blocks, "invariants": invariants, "method": EIPRK4}
    options |= {"h": 0.03 * time, "t_eval": time * np.linspace(0, 0.03 * steps, 3 * steps + 2)}
    span, rate = (0, 0.03 * steps * time), unit / time
    return integrate(lambda t, z: problem.fun(t / time, z / unit) * rate, span, problem.y0 * unit, **options)


@given(seeds, st.booleans(), st.sampled_from([0.0, 0.6]))
@settings(max_examples=30, deadline=None)
def test_units_of_the_state_with_the_error_metric(seed, blocks, eccentricity):
    """Steps with atol=0: any units of the components, or blocks, over 24 decades; also where gradients are parallel."""
    rng = np.random.default_rng(seed)
    unit = 10.0 ** (np.repeat(rng.uniform(-12, 12, 2), 2) if blocks else rng.uniform(-12, 12, 4))
    options = {"blocks": 2 if blocks else None, "eccentricity": eccentricity}
    time = 2.0 ** rng.integers(-40, 40)
    plain, scaled = kepler_in_units(np.ones(4), **options), kepler_in_units(unit, time=time, **options)
    np.testing.assert_allclose(scaled.y / unit[:, None], plain.y, rtol=0, atol=1e-11)
    assert scaled.diagnostics.n_rank_reduced == plain.diagnostics.n_rank_reduced


# The error metric; tests/engine/test_reference.py has it written out.


@pytest.mark.parametrize("method", [EIPRK2, EIPRK3, EIPRK4, EIPRK5])
@pytest.mark.parametrize("every", [1, 2])
def test_corrections_are_measured_in_errors(method, every):
    """In one block of all components the largest correction is that in units of what the estimates have gathered."""
    h, y, squares = 0.2, START, 0.0
    options = {"h": h, "blocks": 4, "every": every, "invariants": [H, L]}
    run = integrate(orbit, (0, every * h), START, method=method, **options)
    for k in range(every):
        y, K = runge_kutta(method.TABLEAU, orbit, k * h, y, h)
        squares = squares + local_error(method.TABLEAU, K, h) ** 2
    largest = np.linalg.norm(run.y[:, -1] - y) / np.sqrt(squares.sum())
    assert run.diagnostics.max_correction == pytest.approx(largest, rel=1e-6)
    assert run.diagnostics.n_projections == 1


@pytest.mark.parametrize(("compensated", "move"), [(False, [0.25 / 9.25, 3 / 9.25]), (True, [0.1, 0.3])])
def test_rounding_is_an_error_unless_it_is_carried(compensated, move):
    """f = 0: what errs is the rounding of the state, in proportion to its size; or nothing, the metric is euclidean."""
    keep = Invariant(lambda t, y: y[0] + 3 * y[1] + t, lambda t, y: np.array([1.0, 3.0]))
    options = {"method": EIPRK4, "h": 1.0, "invariants": keep, "check": False, "atol": 0.0, "compensated": compensated}
    run = integrate(lambda t, y: np.zeros(2), (0, 1), [1.0, 2.0], **options)
    np.testing.assert_allclose(run.y[:, -1] - [1.0, 2.0], np.negative(move), rtol=1e-6)


def test_given_weights_and_components_without_error():
    start, options = np.array([1.0, 2.0]), {"method": EIPRK4, "h": 0.5}
    run = integrate(oscillator, (0, 0.5), start, metric=[3.0, 0.0], invariants=SQUARE, **options)
    y_hat, _ = runge_kutta(EIPRK4.TABLEAU, oscillator, 0.0, start, 0.5)
    assert run.y[1, -1] == pytest.approx(y_hat[1], rel=2 * EPS)
    assert run.y[0, -1] - y_hat[0] == pytest.approx((5 - y_hat @ y_hat) / (2 * y_hat[0]), rel=1e-9)
    # A component that the estimate sees exactly moves by the floor of its weight only.
    keep = Invariant(lambda t, y: y[0] + y[1], lambda t, y: np.ones(2))
    options |= {"invariants": keep, "check": False}
    run = integrate(lambda t, y: np.array([np.sin(5 * y[0]), 0.0]), (0, 0.5), [1.0, 1.0], **options)
    assert run.max_residual[0] <= 4 * EPS
    assert abs(run.y[1, -1] - 1.0) < 1e-12
