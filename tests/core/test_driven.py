"""EIPRadau and EIPBDF: SciPy's steps, projected; their options, results and errors."""

import copy
import pickle
import re

import numpy as np
import pytest
import scipy.integrate
from scipy.integrate import BDF, LSODA, RK45, Radau
from scipy.sparse import csc_matrix

from eip_scipy import (
    EIPBDF,
    EIPDOP853,
    Balance,
    Diagnostics,
    EIPRadau,
    Invariant,
    ProjectionWarning,
    eip_method,
    ensemble,
    integrate,
    load,
    solve_ivp,
)
from eip_scipy.core import driven
from eip_scipy.problems import Problem, kepler
from eip_scipy.results import save

METHODS = [EIPRadau, EIPBDF]
SCIPY = {EIPRadau: Radau, EIPBDF: BDF}
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


RADIUS = Invariant(lambda t, y: y[0] ** 2 + y[1] ** 2, lambda t, y: np.array([2 * y[0], 2 * y[1], 0, 0]), name="radius")
START = np.array([1.0, 0.0, 0.0, 1.0])
KEEP = {"invariants": RADIUS, **TIGHT}


def radius(y):
    return y[0] ** 2 + y[1] ** 2


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("jac", [None, relaxing_jac, lambda t, y: csc_matrix(relaxing_jac(t, y))])
def test_without_invariants_they_take_scipy_s_steps(method, jac):
    own = scipy.integrate.solve_ivp(relaxing, (0, 10), START, method=method, jac=jac, **TIGHT)
    plain = scipy.integrate.solve_ivp(relaxing, (0, 10), START, method=SCIPY[method], jac=jac, **TIGHT)
    np.testing.assert_array_equal(own.t, plain.t)
    np.testing.assert_array_equal(own.y, plain.y)
    assert (own.nfev, own.njev, own.nlu) == (plain.nfev, plain.njev, plain.nlu)
    run = integrate(relaxing, (0, 10), START, method=method, jac=jac, save_every=1, **TIGHT)
    np.testing.assert_array_equal(run.y, plain.y)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("t_span", [(0, 10), (2e-4, 0)])
def test_the_invariant_holds_at_the_steps_and_between_them(method, t_span):
    record = Diagnostics()
    start = exact(t_span[0])
    options = {"method": method, "dense_output": True, "diagnostics": record, **KEEP}
    sol = scipy.integrate.solve_ivp(relaxing, t_span, start, **options)
    assert sol.success
    assert record.trusted
    times = np.linspace(*t_span, 301)
    assert abs(radius(sol.y) - 1).max() < 1e-11
    assert abs(radius(sol.sol(times)) - 1).max() < 1e-11
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    at_times = scipy.integrate.solve_ivp(relaxing, t_span, start, method=method, t_eval=times, **KEEP)
    np.testing.assert_array_equal(at_times.y, sol.sol(times))


@pytest.mark.parametrize("method", METHODS)
def test_states_between_the_steps_are_as_accurate_as_at_the_steps(method):
    sol = scipy.integrate.solve_ivp(relaxing, (0, 10), START, method=method, dense_output=True, **KEEP)
    times = np.linspace(0, 10, 1001)
    plain = scipy.integrate.solve_ivp(relaxing, (0, 10), START, method=SCIPY[method], dense_output=True, **TIGHT)
    error, known = (abs(s.sol(times)[:2] - exact(times)[:2]).max() for s in (sol, plain))
    assert error < 2 * known
    assert error < 3e-5


@pytest.mark.parametrize("method", METHODS)
def test_events_are_found_on_the_manifold(method):
    crossing = lambda t, y: y[0]  # noqa: E731
    sol = solve_ivp(relaxing, (0, 10), START, method, events=crossing, **KEEP)
    assert abs(sol.t_events[0] - np.pi * np.array([0.5, 1.5, 2.5])).max() < 1e-4
    assert abs(radius(sol.y_events[0].T) - 1).max() < 1e-14
    crossing.terminal = True
    run = integrate(relaxing, (0, np.inf), START, method=method, events=crossing, **KEEP)
    assert run.status == 1
    assert run.t[-1] == pytest.approx(sol.t_events[0][0], abs=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_integrate_and_ensemble_take_the_same_steps(method):
    sol = solve_ivp(relaxing, (0, 5), START, method, **KEEP)
    run = integrate(relaxing, (0, 5), START, method=method, save_every=1, **KEEP)
    np.testing.assert_array_equal(run.y, sol.y)
    assert (run.nfev, run.njev, run.nlu) == (sol.nfev, sol.njev, sol.nlu)
    assert run.trusted
    assert not run.compiled
    starts = np.array([START, exact(0.3)])
    both = ensemble(relaxing, (0, 5), starts, method=method, **KEEP)
    np.testing.assert_array_equal(both.y[0], run.y[:, -1])
    np.testing.assert_array_equal(both.y[1], integrate(relaxing, (0, 5), starts[1], method=method, **KEEP).y[:, -1])


def spring(t, y, k):
    return np.array([y[1], -y[0] - k * y[1]])


def spring_jac(t, y, k):
    return np.array([[0.0, 1.0], [-1.0, -k]])


@pytest.mark.parametrize("method", METHODS)
def test_jac_gets_the_arguments_of_the_run(method):
    plain = scipy.integrate.solve_ivp(spring, (0, 9), [1, 0], method=SCIPY[method], jac=spring_jac, args=(1e3,))
    sol = solve_ivp(spring, (0, 9), [1, 0], method, jac=spring_jac, args=(1e3,))
    np.testing.assert_array_equal(sol.y, plain.y)
    run = integrate(spring, (0, 9), [1, 0], method=method, jac=spring_jac, args=(1e3,), rtol=1e-3)
    np.testing.assert_array_equal(run.y[:, -1], plain.y[:, -1])
    constant = integrate(spring, (0, 9), [1, 0], method=method, jac=spring_jac(0, 0, 1e3), args=(1e3,), rtol=1e-3)
    assert constant.success
    members = ensemble(
        lambda t, y, p: spring(t, y, p[0]), (0, 9), [[1, 0]] * 2, params=[[1e3], [2e3]], method=method, rtol=1e-3,
        jac=lambda t, y, p: spring_jac(t, y, p[0]),
    )  # fmt: skip
    np.testing.assert_array_equal(members.y[0], plain.y[:, -1])
    with pytest.raises(TypeError, match="jac is the Jacobian for EIPRadau and EIPBDF, but EIPDOP853"):
        integrate(spring, (0, 9), [1, 0], method=EIPDOP853, jac=spring_jac, args=(1e3,), rtol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_a_failed_projection_takes_the_step_back_and_halves_it(method):
    """A gradient that is not finite in one evaluation: the step is made again, shorter, and the run is as good."""
    asked = []

    def gradient(t, y):
        asked.append(t)
        return np.full(4, np.nan) if len(asked) == 40 else RADIUS.grad(t, y)

    once = Invariant(RADIUS.fun, gradient, name="radius")
    record = Diagnostics()
    options = {**KEEP, "invariants": once, "diagnostics": record}
    sol = scipy.integrate.solve_ivp(relaxing, (0, 5), START, method=method, **options)
    assert sol.success
    assert record.n_rejected_projections == 1
    k = int(np.searchsorted(sol.t, asked[39]))  # the step before it is the one that was made again
    again = sol.t[sol.t < asked[39]][-1]
    assert any(abs(asked[39] - start - 2 * (again - start)) < 1e-12 for start in sol.t[k - 3 : k])
    plain = scipy.integrate.solve_ivp(relaxing, (0, 5), START, method=method, **KEEP)
    errors = [abs(s.y[:2, -1] - exact(5.0)[:2]).max() for s in (sol, plain)]
    assert errors[0] < 2 * errors[1] + 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_a_hopeless_projection_ends_the_run(method):
    never = Invariant(lambda t, y: y @ y + 1, lambda t, y: 2 * y, target=0.5, name="never")
    with pytest.raises(ValueError, match="never"):
        scipy.integrate.solve_ivp(relaxing, (0, 5), START, method=method, invariants=never, project_initial=True)
    late = Invariant(RADIUS.fun, lambda t, y: RADIUS.grad(t, y) * (np.nan if t > 1 else 1), name="late")
    sol = scipy.integrate.solve_ivp(relaxing, (0, 5), START, method=method, invariants=late, check=False)
    assert sol.status == -1
    assert "projection failed" in sol.message
    assert 0.9 < sol.t[-1] <= 1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("taken", [0, 25])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_copies_go_on_to_the_same_bits(method, taken, copied):
    solver = method(relaxing, 0.0, START, 5.0, invariants=ANY_RADIUS, **TIGHT)
    for _ in range(taken):
        solver.step()
    other = copied(solver)
    while solver.status == "running":
        solver.step()
        other.step()
        np.testing.assert_array_equal(other.y, solver.y)
    assert other.status == "finished"


def squared_radius(t, y):
    return y[0] ** 2 + y[1] ** 2


def squared_radius_gradient(t, y):
    return np.array([2 * y[0], 2 * y[1], 0, 0])


ANY_RADIUS = Invariant(squared_radius, squared_radius_gradient, name="radius")  # which pickles


@pytest.mark.parametrize("method", METHODS)
def test_what_is_set_between_two_steps_is_taken(method):
    solver = method(relaxing, 0.0, START, 5.0, invariants=RADIUS, **TIGHT)
    for _ in range(20):
        solver.step()
    solver.y = exact(1.0)
    solver.t, solver.t_bound = 1.0, 2.0
    while solver.status == "running":
        solver.step()
    assert solver.t == 2.0
    assert abs(solver.y - exact(2.0))[:2].max() < 1e-4


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("options", [{"every": 3}, {"every": "auto"}, {"iterations": 2}, {"direction": "midpoint"},
                                     {"metric": "euclidean"}, {"blocks": 2}, {"metric": [1, 1, 0, 0]}])  # fmt: skip
def test_options_of_the_projection(method, options):
    record = Diagnostics()
    sol = scipy.integrate.solve_ivp(
        relaxing, (0, 5), START, method=method, diagnostics=record, dense_output=True, **KEEP, **options
    )
    assert record.trusted
    assert abs(radius(sol.y) - 1).max() < 1e-11
    assert abs(radius(sol.sol(np.linspace(0, 5, 50))) - 1).max() < 1e-11
    assert abs(sol.y[:2, -1] - exact(5.0)[:2]).max() < 3e-5


@pytest.mark.parametrize("method", METHODS)
def test_a_start_is_projected_first(method):
    off = Invariant(RADIUS.fun, RADIUS.grad, target=1.0, name="radius")
    sol = solve_ivp(relaxing, (0, 1), 1.001 * START, method, invariants=off, project_initial=True, **TIGHT)
    assert abs(radius(sol.y) - 1).max() < 1e-14
    with pytest.raises(ValueError, match="project_initial=True"):
        solve_ivp(relaxing, (0, 1), 1.001 * START, method, invariants=off, **TIGHT)


@pytest.mark.parametrize("method", METHODS)
def test_what_is_no_invariant_is_reported(method):
    wrong = Invariant(lambda t, y: y[0], lambda t, y: np.array([1.0, 0, 0, 0]), name="x")
    with (
        pytest.warns(ProjectionWarning, match="'x' was corrected by up to"),
        pytest.warns(UserWarning, match="'x' is not an invariant of this system"),
    ):
        sol = solve_ivp(relaxing, (0, 0.01), exact(0.5), method, invariants=wrong, **TIGHT)
    assert not sol.trusted


@pytest.mark.parametrize("method", METHODS)
def test_shifts_of_cyclic_coordinates_are_bounded(method):
    """SciPy's grow tenfold with each numerical Jacobian, as that of the first component does, until they overflow."""

    def turning(t, y):
        return np.array([1.0 + y[1], -50 * (1 + 0.9 * np.sin(20 * t)) * (y[1] ** 3 - np.sin(7 * t))])

    solver = method(turning, 0.0, [0.0, 0.5], 200.0, rtol=1e-6, atol=1e-9)
    plain = SCIPY[method](turning, 0.0, [0.0, 0.5], 200.0, rtol=1e-6, atol=1e-9)
    for each in (solver, plain):
        while each.status == "running" and each.njev < 14:
            each.step()
        assert each.njev == 14
    assert plain.jac_factor[0] > 1e3
    assert solver._run.method.solver.jac_factor.max() <= 10 * driven.LARGEST_SHIFT


def test_private_names_of_scipy(monkeypatch):
    """All used attributes exist, and a version of SciPy that lacks one is named."""
    for method in METHODS:
        inner = method.TABLEAU.solver
        solver = inner(relaxing, 0.0, START, 1.0)
        solver.step()
        assert all(hasattr(solver, name) for name in (*driven.PRIVATE[inner], "jac_factor", "max_step"))
        monkeypatch.setitem(driven.PRIVATE, inner, ("D", "f", "lost"))
        with pytest.raises(NotImplementedError, match=rf"EIP{inner.__name__} uses .*not have: .*lost\. Use another"):
            scipy.integrate.solve_ivp(relaxing, (0, 1), START, method=method)


def test_classes_of_scipy_by_eip_method():
    assert eip_method(Radau) is EIPRadau
    assert eip_method(BDF) is EIPBDF
    assert eip_method(EIPBDF) is EIPBDF
    assert pickle.loads(pickle.dumps(EIPRadau)) is EIPRadau
    for other in (LSODA, type("Mine", (Radau,), {"_step_impl": lambda self: (False, "no")})):
        with pytest.raises(TypeError, match="only SciPy's Radau and BDF can be projected"):
            eip_method(other)
    assert eip_method(RK45).__name__ == "EIPRK45"


@pytest.mark.parametrize(("name", "method"), [("Radau", EIPRadau), ("BDF", EIPBDF), (Radau, EIPRadau), (BDF, EIPBDF)])
def test_the_typed_function_takes_names(name, method):
    one, other = (solve_ivp(relaxing, (0, 2), START, m, jac=relaxing_jac, **KEEP) for m in (name, method))
    np.testing.assert_array_equal(one.y, other.y)
    assert one.trusted
    assert one.diagnostics.n_projections > 0


@pytest.mark.parametrize("method", METHODS)
def test_names_of_the_classes_are_explained(method):
    name = method.__name__
    with pytest.raises(ValueError, match=f"{name.lower()!r} is a name; give the class, as in .* import {name}"):
        solve_ivp(relaxing, (0, 2), START, name.lower(), **KEEP)
    for given in (name, method.TABLEAU.name, method.TABLEAU.solver):
        with pytest.raises(TypeError, match=f"Give the class: from eip_scipy import {name}"):
            integrate(relaxing, (0, 2), START, method=given, **KEEP)


@pytest.mark.parametrize("method", METHODS)
def test_a_run_goes_on_and_is_stored(method, tmp_path):
    run = integrate(relaxing, (0, 1), START, method=method, save_every=1, dense_output=True, **KEEP)
    further = run.continue_to(2.0)
    assert abs(further.y[:2, -1] - exact(2.0)[:2]).max() < 1e-5
    save(run, tmp_path / "run")
    np.testing.assert_array_equal(load(tmp_path / "run").y, run.y)
    assert load(tmp_path / "run").method == method.__name__


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"h": 0.1}, "h=0.1: the steps of EIP.* are those of SciPy's .*Omit h, and give rtol and atol"),
        ({"compensated": True}, "compensated=True is available .* omit compensated"),
        ({"rtol": [1e-3, 1e-4, 1e-3, 1e-3]}, "takes one number. Give atol by component"),
        ({"jac": np.eye(3)}, "`jac` is expected to have shape"),
        ({"invariants": Balance(RADIUS.fun, rate=lambda t, y: 0.0)}, "does not carry a Balance"),
    ],
)
def test_what_they_do_not_take(method, options, message):
    with pytest.raises(ValueError, match=message):
        scipy.integrate.solve_ivp(relaxing, (0, 1), START, method=method, **options)


def test_complex_states():
    def turning(t, z):
        return np.array([1j * z[0], -1e3 * (z[1] - z[0] ** 2)])

    size = Invariant(lambda t, z: abs(z[0]) ** 2, lambda t, z: np.array([2 * z[0], 0]), name="size")
    start = np.array([1.0 + 0j, 1.0 + 0j])
    with pytest.raises(ValueError, match=r"y0 is complex, but SciPy's Radau takes real states only\. Use EIPBDF"):
        scipy.integrate.solve_ivp(turning, (0, 3), start, method=EIPRadau)
    sol = scipy.integrate.solve_ivp(turning, (0, 3), start, method=EIPBDF, invariants=size, dense_output=True, **TIGHT)
    assert abs(abs(sol.sol(np.linspace(0, 3, 40))[0]) - 1).max() < 1e-14
    assert abs(sol.y[0, -1] - np.exp(3j)) < 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_a_problem_s_own_step_is_left_out(method):
    problem = kepler(0.3, relativistic=0)
    assert problem.h is not None
    run = integrate(problem, (0, 1), method=method, rtol=1e-6, atol=1e-9)
    assert abs(run.y[:, -1] - problem.reference(1.0)).max() < 1e-4
    assert integrate(problem, (0, 1), method=method).success
    assert problem.solve_ivp((0, 1), method=method).success


@pytest.mark.parametrize("method", METHODS)
def test_a_problem_s_balances_are_left_out(method):
    """Implicit steps carry no balances, and a problem brings what it has: its invariants are kept all the same."""
    balance = Balance(lambda t, y: y[2], rate=lambda t, y: relaxing(t, y)[2], name="z")
    problem = Problem("relaxing", relaxing, START, (0, 1), invariants=(RADIUS, balance))
    run = integrate(problem, method=method, **TIGHT)
    assert run.diagnostics.names == ("radius",)
    np.testing.assert_array_equal(problem.solve_ivp(method=method, **TIGHT).y[:, -1], run.y[:, -1])


@pytest.mark.parametrize("method", METHODS)
def test_no_checkpoint(method, tmp_path):
    with pytest.raises(ValueError, match=re.escape("checkpoint: a file cannot store the internal state of SciPy's")):
        integrate(relaxing, (0, 1), START, method=method, checkpoint=tmp_path / "file", **KEEP)


@pytest.mark.parametrize("method", METHODS)
def test_values_that_are_not_finite_end_the_run(method):
    sol = scipy.integrate.solve_ivp(lambda t, y: y * np.nan, (0, 1), [1.0], method=method, jac=[[1.0]])
    assert sol.status == -1
    assert "non-finite value at t=0" in sol.message


def stopping(t, y):
    return np.array([y[1], -y[0] * (np.nan if t > 1 else 1)])


def leaving(t, y):
    return np.array([1.0, np.sqrt(1 - y[0] ** 2)])  # y[0] = t, and the slopes beyond 1 are not finite


def leaving_jac(t, y):
    return np.array([[0.0, 0.0], [-y[0] / np.sqrt(1 - y[0] ** 2), 0.0]])


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("fun", "options"),
    [
        (stopping, {}),
        (leaving, {}),
        (leaving, {"jac": leaving_jac}),
        (leaving, {"jac": lambda t, y: csc_matrix(leaving_jac(t, y))}),
    ],
    ids=["time", "state", "jac", "sparse"],
)
def test_a_derivative_that_becomes_nan_ends_the_run(method, fun, options):
    options = {"method": method, "rtol": 1e-5, **options}
    sol = solve_ivp(fun, (0, 5), [0.0, 0.5], **options)
    run = integrate(fun, (0, 5), [0.0, 0.5], save_every=1, **options)
    for found in (sol, run):
        assert found.status == -1
        assert not found.trusted
        assert found.message.startswith("fun returned a non-finite value at t=1")
        assert found.t.size > 10
        assert found.t[-1] == pytest.approx(1.0)
        assert np.isfinite(found.y).all()
    members = ensemble(fun, (0, 5), [[0.0, 0.5]], **options)
    assert members.status.tolist() == [-1]
    assert "non-finite value at t=1" in members.message[0]


@pytest.mark.parametrize("method", METHODS)
def test_errors_of_the_right_hand_side_are_raised(method):
    def fun(t, y):
        if t > 1:
            raise ValueError("array must not contain infs or NaNs")
        return -y

    with pytest.raises(ValueError, match="array must not contain") as info:
        integrate(fun, (0, 5), [1.0], method=method)
    assert info.value.partial.t[-1] > 0.1
