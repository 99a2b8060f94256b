"""EIPRadau and EIPBDF: SciPy's steps, projected; their options, results and errors."""

import inspect
import pickle

import numpy as np
import pytest
import scipy.integrate
from scipy.integrate import BDF, LSODA, RK45, Radau
from scipy.sparse import csc_matrix, csr_array

import eip_scipy
from eip_scipy import EIPBDF, Balance, Diagnostics, EIPRadau, Invariant, eip_method, integrate, load, solve_ivp
from eip_scipy.problems import Problem, kepler
from eip_scipy.results import save

SCIPY = {EIPRadau: Radau, EIPBDF: BDF}
both = pytest.mark.parametrize("method", SCIPY)
TIGHT = {"rtol": 1e-6, "atol": 1e-8}


def relaxing(t, y):
    """Motion round the unit circle at the speed 1, and two fast variables, which follow x v and x^2 + v^2."""
    x, v, z, r = y
    return np.array([-v, x, -1e4 * (z - x * v), -1e3 * (r - x * x - v * v)])


def relaxing_jac(t, y):
    x, v = y[:2]
    return np.array([[0, -1, 0, 0], [1, 0, 0, 0], [1e4 * v, 1e4 * x, -1e4, 0], [2e3 * x, 2e3 * v, 0, -1e3]])


def exact(t):
    x, v = np.cos(t), np.sin(t)
    return np.array([x, v, x * v, np.ones_like(t)])  # z lags by 1e-4


def squared_radius(t, y):
    return y[0] ** 2 + y[1] ** 2


def squared_radius_gradient(t, y):
    return np.array([2 * y[0], 2 * y[1], 0, 0])


RADIUS = Invariant(squared_radius, squared_radius_gradient, name="radius")  # which pickles
START = np.array([1.0, 0.0, 0.0, 1.0])
KEEP = {"invariants": RADIUS, **TIGHT}


def ivp(method, end=5.0, fun=relaxing, start=START, **options):
    """Run SciPy's function, from 0 unless two times are given."""
    return scipy.integrate.solve_ivp(fun, end if np.ndim(end) else (0, end), start, method=method, **options)


def off(y):
    """Return the largest error of the radius in states (4, m)."""
    return abs(squared_radius(0, y) - 1).max()


@both
@pytest.mark.parametrize(
    "jac", [None, relaxing_jac, *(lambda t, y, kind=kind: kind(relaxing_jac(t, y)) for kind in (csc_matrix, csr_array))]
)
def test_without_invariants_they_take_scipy_s_steps(method, jac):
    own, plain = (ivp(m, 10, jac=jac, **TIGHT) for m in (method, SCIPY[method]))
    np.testing.assert_array_equal(own.t, plain.t)
    np.testing.assert_array_equal(own.y, plain.y)
    assert (own.nfev, own.njev, own.nlu) == (plain.nfev, plain.njev, plain.nlu)
    run = integrate(relaxing, (0, 10), START, method=method, jac=jac, save_every=1, **TIGHT)
    np.testing.assert_array_equal(run.y, plain.y)


@both
def test_an_end_that_is_moved_does_not_start_scipy_s_steps_again(method):
    """As in programs that step to one event after another; the interpolants are SciPy's too."""
    own, scipy_s = (kind(relaxing, 0.0, START, 0.1, **TIGHT) for kind in (method, SCIPY[method]))
    for solver in (own, scipy_s):
        while solver.t < 2.0:
            if solver.status == "finished":
                solver.t_bound, solver.status = solver.t + 0.1, "running"
            solver.step()
    np.testing.assert_array_equal(own.y, scipy_s.y)
    t = 0.3 * own.t_old + 0.7 * own.t
    np.testing.assert_array_equal(own.dense_output()(t), scipy_s.dense_output()(t))
    assert (own.nfev, own.njev, own.nlu) == (scipy_s.nfev, scipy_s.njev, scipy_s.nlu)


@both
@pytest.mark.parametrize("t_span", [(0, 10), (2e-4, 0)])
def test_the_invariant_holds_at_the_steps_and_between_them(method, t_span):
    record, start, times = Diagnostics(), exact(t_span[0]), np.linspace(*t_span, 301)
    sol = ivp(method, t_span, start=start, dense_output=True, diagnostics=record, **KEEP)
    assert sol.success
    assert record.trusted
    assert off(sol.y) < 1e-11
    assert off(sol.sol(times)) < 1e-11
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    np.testing.assert_array_equal(ivp(method, t_span, start=start, t_eval=times, **KEEP).y, sol.sol(times))
    plain = ivp(SCIPY[method], t_span, start=start, dense_output=True, **TIGHT)
    error, known = (abs(s.sol(times)[:2] - exact(times)[:2]).max() for s in (sol, plain))
    assert error < min(2 * known, 3e-5)


@both
def test_events_are_found_on_the_manifold(method):
    crossing = lambda t, y: y[0]  # noqa: E731
    sol = solve_ivp(relaxing, (0, 10), START, method, events=crossing, **KEEP)
    assert abs(sol.t_events[0] - np.pi * np.array([0.5, 1.5, 2.5])).max() < 1e-4
    assert off(sol.y_events[0].T) < 1e-14
    crossing.terminal = True
    run = integrate(relaxing, (0, np.inf), START, method=method, events=crossing, **KEEP)
    assert run.status == 1
    assert run.t[-1] == pytest.approx(sol.t_events[0][0], abs=1e-12)


@both
def test_all_functions_take_the_same_steps(method):
    """Names of SciPy's methods stand for the classes in the typed function, and lists of starts are members."""
    sol = solve_ivp(relaxing, (0, 5), START, method, **KEEP)
    for name in (SCIPY[method], SCIPY[method].__name__):
        np.testing.assert_array_equal(solve_ivp(relaxing, (0, 5), START, name, **KEEP).y, sol.y)
    run = integrate(relaxing, (0, 5), START, method=method, save_every=1, **KEEP)
    np.testing.assert_array_equal(run.y, sol.y)
    assert (run.nfev, run.njev, run.nlu) == (sol.nfev, sol.njev, sol.nlu)
    assert run.trusted
    assert not run.compiled
    assert sol.diagnostics.n_projections > 0
    starts = np.array([START, exact(0.3)])
    members = eip_scipy.ensemble(relaxing, (0, 5), starts, method=method, **KEEP)
    np.testing.assert_array_equal(members.y[0], run.y[:, -1])
    np.testing.assert_array_equal(members.y[1], integrate(relaxing, (0, 5), starts[1], method=method, **KEEP).y[:, -1])


def spring(t, y, k):
    return np.array([y[1], -y[0] - k * y[1]])


@both
def test_they_are_made_as_scipys_classes_are(method):
    """The order of the arguments, and the numbers and the order before the first step."""
    own, plain = (list(inspect.signature(m).parameters) for m in (method, SCIPY[method]))
    assert own[: len(plain) - 1] == plain[:-1]
    own, plain = (m(relaxing, 0.0, START, 5.0, np.inf, 1e-3, 1e-6, relaxing_jac) for m in (method, SCIPY[method]))
    for _ in range(4):
        assert (own.njev, own.nlu) == (plain.njev, plain.nlu)
        assert getattr(own, "order", None) == (getattr(plain, "order", 5))
        own.step()
        plain.step()
        assert own.t == plain.t
    assert method(relaxing, 0.0, START, 0.0).njev == 1


def spring_jac(t, y, k):
    return np.array([[0.0, 1.0], [-1.0, -k]])


@both
def test_jac_gets_the_arguments_of_the_run(method):
    given = {"t_span": (0, 9), "y0": [1, 0], "jac": spring_jac, "args": (1e3,)}
    plain = scipy.integrate.solve_ivp(spring, method=SCIPY[method], **given)
    np.testing.assert_array_equal(solve_ivp(spring, method=method, **given).y, plain.y)
    run = integrate(spring, method=method, rtol=1e-3, **given)
    np.testing.assert_array_equal(run.y[:, -1], plain.y[:, -1])
    assert integrate(spring, method=method, rtol=1e-3, **given | {"jac": spring_jac(0, 0, 1e3)}).success
    fun, jac = (lambda t, y, p, f=f: f(t, y, p[0]) for f in (spring, spring_jac))
    members = eip_scipy.ensemble(fun, (0, 9), [[1, 0]] * 2, params=[[1e3], [2e3]], method=method, rtol=1e-3, jac=jac)
    np.testing.assert_array_equal(members.y[0], plain.y[:, -1])
    with pytest.raises(TypeError, match="jac is the Jacobian for EIPRadau and EIPBDF, but EIPDOP853"):
        integrate(spring, method=eip_scipy.EIPDOP853, rtol=1e-3, **given)


@both
def test_a_failed_projection_takes_the_step_back_and_halves_it(method):
    """A gradient that is not finite in one evaluation: the step is made again, shorter, and the run is as good."""
    asked = []

    def gradient(t, y):
        asked.append(t)
        return np.full(4, np.nan) if len(asked) == 40 else RADIUS.grad(t, y)

    record = Diagnostics()
    sol = ivp(method, invariants=Invariant(RADIUS.fun, gradient), diagnostics=record, **TIGHT)
    assert sol.success
    assert record.n_rejected_projections == 1
    k = int(np.searchsorted(sol.t, asked[39]))  # the step before it is the one that was made again
    again = sol.t[sol.t < asked[39]][-1]
    assert any(abs(asked[39] - start - 2 * (again - start)) < 1e-12 for start in sol.t[k - 3 : k])
    errors = [abs(s.y[:2, -1] - exact(5.0)[:2]).max() for s in (sol, ivp(method, **KEEP))]
    assert errors[0] < 2 * errors[1] + 1e-6
    late = Invariant(RADIUS.fun, lambda t, y: RADIUS.grad(t, y) * (np.nan if t > 1 else 1))
    sol = ivp(method, invariants=late, check=False)
    assert sol.status == -1
    assert "projection failed" in sol.message
    assert 0.9 < sol.t[-1] <= 1


@both
def test_options_of_the_projection(method):
    given = [{"every": 3}, {"every": "auto"}, {"iterations": 2}, {"direction": "midpoint"}, {"blocks": 2}]
    for options in (*given, {"metric": "euclidean"}, {"metric": [1, 1, 0, 0]}):
        record = Diagnostics()
        sol = ivp(method, diagnostics=record, dense_output=True, **KEEP, **options)
        assert record.trusted
        assert off(sol.y) < 1e-11
        assert off(sol.sol(np.linspace(0, 5, 50))) < 1e-11
        assert abs(sol.y[:2, -1] - exact(5.0)[:2]).max() < 3e-5
    target = Invariant(RADIUS.fun, RADIUS.grad, target=1.0)
    sol = ivp(method, start=1.001 * START, invariants=target, project_initial=True, **TIGHT)
    assert off(sol.y[:, 1:]) < 1e-11


@both
def test_what_is_no_invariant_is_reported(method):
    wrong = Invariant(lambda t, y: y[0], lambda t, y: np.array([1.0, 0, 0, 0]), name="x")
    with (
        pytest.warns(eip_scipy.ProjectionWarning, match="'x' was corrected by up to"),
        pytest.warns(UserWarning, match="'x' is not an invariant of this system"),
    ):
        sol = solve_ivp(relaxing, (0, 0.01), exact(0.5), method, invariants=wrong, **TIGHT)
    assert not sol.trusted


def test_classes_of_scipy_by_eip_method():
    for given, found in ((Radau, EIPRadau), (BDF, EIPBDF), (EIPBDF, EIPBDF)):
        assert eip_method(given) is found
        assert pickle.loads(pickle.dumps(found)) is found
    for other in (LSODA, type("Mine", (Radau,), {"_step_impl": lambda self: (False, "no")})):
        with pytest.raises(TypeError, match="only SciPy's Radau and BDF can be projected"):
            eip_method(other)
    assert eip_method(RK45).__name__ == "EIPRK45"


@both
def test_a_run_goes_on_and_is_stored(method, tmp_path):
    run = integrate(relaxing, (0, 1), START, method=method, save_every=1, dense_output=True, **KEEP)
    assert abs(run.continue_to(2.0).y[:2, -1] - exact(2.0)[:2]).max() < 1e-5
    save(run, tmp_path / "run")
    np.testing.assert_array_equal(load(tmp_path / "run").y, run.y)
    assert load(tmp_path / "run").method == method.__name__
    with pytest.raises(ValueError, match="checkpoint: a file cannot store the internal state of SciPy's"):
        integrate(relaxing, (0, 1), START, method=method, checkpoint=tmp_path / "file", **KEEP)


WRONG = [
    ({"h": 0.1}, "h=0.1: the steps of EIP.* are those of SciPy's .*Omit h, and give rtol and atol"),
    ({"compensated": True}, "compensated=True is available .* omit compensated"),
    ({"rtol": [1e-3, 1e-4, 1e-3, 1e-3]}, "takes one number. Give atol by component"),
    ({"jac": np.eye(3)}, "`jac` is expected to have shape"),
    ({"invariants": Balance(RADIUS.fun, rate=lambda t, y: 0.0)}, "does not carry a Balance"),
    ({"start": 1.001 * START, "invariants": Invariant(RADIUS.fun, RADIUS.grad, target=1.0)}, "project_initial=True"),
]


@both
@pytest.mark.parametrize(("options", "message"), WRONG)
def test_what_they_do_not_take(method, options, message):
    with pytest.raises(ValueError, match=message):
        ivp(method, **options)


def test_complex_states():
    def turning(t, z):
        return np.array([1j * z[0], -1e3 * (z[1] - z[0] ** 2)])

    size = Invariant(lambda t, z: abs(z[0]) ** 2, lambda t, z: np.array([2 * z[0], 0]))
    start = np.array([1.0 + 0j, 1.0 + 0j])
    with pytest.raises(ValueError, match=r"y0 is complex, but SciPy's Radau takes real states only\. Use EIPBDF"):
        ivp(EIPRadau, 3, turning, start)
    sol = ivp(EIPBDF, 3, turning, start, invariants=size, dense_output=True, **TIGHT)
    assert abs(abs(sol.sol(np.linspace(0, 3, 40))[0]) - 1).max() < 1e-14
    assert abs(sol.y[0, -1] - np.exp(3j)) < 1e-4


@both
def test_a_problem_s_own_step_and_balances_are_left_out(method):
    """Implicit steps carry no balances, and a problem brings what it has: its invariants are kept all the same."""
    problem = kepler(0.3, relativistic=0)
    assert problem.h is not None
    run = integrate(problem, (0, 1), method=method, rtol=1e-6, atol=1e-9)
    assert abs(run.y[:, -1] - problem.reference(1.0)).max() < 1e-4
    balance = Balance(lambda t, y: y[2], rate=lambda t, y: relaxing(t, y)[2], name="z")
    problem = Problem("relaxing", relaxing, START, (0, 1), invariants=(RADIUS, balance))
    run = integrate(problem, method=method, **TIGHT)
    assert run.diagnostics.names == ("radius",)
    np.testing.assert_array_equal(problem.solve_ivp(method=method, **TIGHT).y[:, -1], run.y[:, -1])


def leaving(t, y):
    return np.array([1.0, np.sqrt(1 - y[0] ** 2)])  # y[0] = t, and the slopes beyond 1 are not finite


def leaving_jac(t, y):
    return np.array([[0.0, 0.0], [-y[0] / np.sqrt(1 - y[0] ** 2), 0.0]])


ENDED = {
    "time": (lambda t, y: np.array([y[1], -y[0] * (np.nan if t > 1 else 1)]), {}),
    "state": (leaving, {}),
    "jac": (leaving, {"jac": leaving_jac}),
    "sparse": (leaving, {"jac": lambda t, y: csc_matrix(leaving_jac(t, y))}),
}


@pytest.mark.filterwarnings("ignore:invalid value")
@both
@pytest.mark.parametrize("case", ENDED)
def test_a_derivative_that_becomes_nan_ends_the_run(method, case):
    fun, options = ENDED[case]
    options = {"method": method, "rtol": 1e-5, **options}
    sol = solve_ivp(fun, (0, 5), [0.0, 0.5], **options)
    run = integrate(fun, (0, 5), [0.0, 0.5], save_every=1, **options)
    for found in (sol, run):
        assert (found.status, found.trusted) == (-1, False)
        assert found.message.startswith("fun returned a non-finite value at t=1")
        assert found.t.size > 10
        assert found.t[-1] == pytest.approx(1.0)
        assert np.isfinite(found.y).all()
    at_once = ivp(method, fun=lambda t, y: y * np.nan, start=[1.0], jac=[[1.0]])
    assert at_once.status == -1
    assert "non-finite value at t=0" in at_once.message
