"""`eip_scipy.solve_ivp`: SciPy's function to the last bit, with arguments for invariants and a judged result."""

import copy
import pickle
import re

import numpy as np
import pytest
import scipy.integrate
from systems import refuse

import eip_scipy
from eip_scipy import EIPDOP853, EIPGJ14, EIPRK4, EIPRK45, EIPRKN12, Invariant, eip_method, integrate, solve_ivp
from eip_scipy.problems import kepler
from eip_scipy.results import OdeResult

K = 2.0
SciPyResult = type(scipy.integrate.solve_ivp(lambda t, y: y, (0, 0), [1.0]))


def spring(t, y, k):
    return np.array([y[1], -k * y[0]])


def energy(t, y, k):
    return 0.5 * (y[1] ** 2 + k * y[0] ** 2)


def gradient(t, y, k):
    return np.array([k * y[0], y[1]])


def crossing(t, y, k):
    return y[0]


def second_fall(t, y, k):
    return y[0] + 0.1


def norm(t, y, k):
    return np.sum(np.abs(y) ** 2)


def twice(t, y, k):
    return 2 * y


second_fall.terminal, second_fall.direction = 2, -1
ENERGY = Invariant(energy, gradient, name="energy")
BOUND = Invariant(energy, gradient, args=(K,), name="energy")
CASES = {
    "method": {"method": EIPDOP853, "rtol": 1e-9, "atol": [1e-12, 1e-10]},
    "t_eval": {"t_eval": [0.0, 0.1, 3.0, 7.0]},
    "dense": {"dense_output": True, "t_eval": np.linspace(0, 7, 5)},
    "events": {"events": [crossing, second_fall], "dense_output": True},
    "bounds": {"first_step": 1e-3, "max_step": 0.2},
    "fixed": {"method": EIPRK4, "h": 0.05, "every": 3},
    "options": {"metric": "euclidean", "iterations": 2, "direction": "old", "blocks": 1, "compensated": True},
    "backward": {"t_span": (7, -1), "t_eval": [6, 0, -1]},
    "zero sampled": {"t_span": (2, 2), "t_eval": [2], "dense_output": True},
    "vectorized, lists": {"vectorized": True, "t_span": [0, 7], "y0": (1, 0), "args": [K]},
    "multistep": {"method": EIPGJ14, "h": 0.05},
    "complex": {"fun": lambda t, y, k: 1j * k * y, "y0": [1.0, 1j], "invariants": Invariant(norm, twice, name="norm")},
}


def jacobian(t, q, dq, out, k):
    out[:] = -k * dq


def assert_same(one, other):
    """Assert that two results agree to the last bit, messages and counts included."""
    for name in ("t", "y", "nfev", "njev", "nlu", "status", "success", "message"):
        np.testing.assert_array_equal(one[name], other[name], name)
    for name in ("t_events", "y_events"):
        assert (one[name] is None) == (other[name] is None)
        for a, b in zip(one[name] or [], other[name] or [], strict=True):
            np.testing.assert_array_equal(a, b)
    assert (one["sol"] is None) == (other["sol"] is None)
    if one["sol"] is not None:
        times = np.linspace(one["sol"].t_min, one["sol"].t_max, 7)
        np.testing.assert_array_equal(one["sol"](times), other["sol"](times))


@pytest.mark.parametrize("name", CASES)
def test_the_same_bits_as_through_scipy(name):
    """The invariants take their arguments from the call in one run, and as their own in the other."""
    given = {"fun": spring, "t_span": (0, 7), "y0": [1.0, 0.0], "method": EIPRK45, "args": (K,), "invariants": ENERGY}
    given |= CASES[name]
    own = {**given, "invariants": Invariant(norm, twice, args=(K,), name="norm") if name == "complex" else BOUND}
    if name == "multistep":
        given["jacobian"], own["jacobian"] = jacobian, lambda t, q, dq, out: jacobian(t, q, dq, out, K)
    typed, plain = solve_ivp(**given), scipy.integrate.solve_ivp(**own)
    assert_same(typed, plain)
    assert isinstance(typed, OdeResult)
    assert isinstance(typed, SciPyResult)
    assert typed.trusted
    assert set(typed) == {*plain, "trusted", "diagnostics"}
    assert typed.diagnostics.names == (given["invariants"].name,)


def test_scipys_methods_are_scipys():
    for method in ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA", scipy.integrate.Radau):
        options = {"method": method, "events": crossing, "args": (K,), "dense_output": True, "rtol": 1e-6}
        if method in ("Radau", "BDF"):
            options["jac"] = lambda t, y, k: np.array([[0.0, 1.0], [-k, 0.0]])
        typed, plain = (f(spring, (0, 3), [1.0, 0.0], **options) for f in (solve_ivp, scipy.integrate.solve_ivp))
        assert_same(typed, plain)
        assert typed.trusted
        assert typed.diagnostics.names == ()


def test_methods_of_scipy_with_invariants():
    stand_for = {"RK45": EIPRK45, "DOP853": EIPDOP853, scipy.integrate.RK23: eip_scipy.EIPRK23}
    for method, own in (stand_for | {eip_method(EIPRK4.TABLEAU): EIPRK4}).items():
        options = {"args": (K,), "invariants": energy, **({"h": 0.05} if own is EIPRK4 else {})}
        one, other = (solve_ivp(spring, (0, 3), [1.0, 0.0], m, **options) for m in (method, own))
        assert_same(one, other)
        assert one.diagnostics.names == ("energy",)
    fixed = solve_ivp(spring, (0, 3), [1.0, 0.0], "RK45", args=(K,), h=0.5)
    np.testing.assert_allclose(np.diff(fixed.t), 0.5)
    for method in ("LSODA", scipy.integrate.LSODA):
        with pytest.raises(TypeError, match="solve_ivp: the method LSODA takes no invariants; give an EIP method"):
            solve_ivp(spring, (0, 3), [1.0, 0.0], method, args=(K,), invariants=energy)
        assert solve_ivp(spring, (0, 3), [1.0, 0.0], method, args=(K,), invariants=()).success


BAD = {
    "method": ["RK4", int],
    "args": [2.0],
    "t_eval": [[0, 9], [1, 0.5], [[0, 1]]],
    "t_span": [(0, 1, 2)],
    "y0": [[[1.0, 0.0]], [np.nan, 0.0], ["a", 0.0]],
    "rtol": [[1e-3, 1e-3, 1e-3]],
    "first_step": [-1, 100],
    "max_step": [0],
    "metric": ["taxicab"],
    "diagnostics": [1],
}


def test_the_same_errors_as_through_scipy():
    for name, value in ((name, value) for name, values in BAD.items() for value in values):
        given = {"fun": spring, "t_span": (0, 7), "y0": [1.0, 0.0], "method": EIPRK45, "args": (K,)} | {name: value}
        with pytest.raises((TypeError, ValueError)) as through_scipy:
            scipy.integrate.solve_ivp(**given)
        with pytest.raises(through_scipy.type, match=f"^{re.escape(str(through_scipy.value))}$"):
            solve_ivp(**given)


def test_what_is_missing():
    rows = [
        ({}, TypeError, "fun is missing"),
        ({"fun": spring}, TypeError, "t_span is missing"),
        ({"fun": spring, "t_span": (0, 1)}, TypeError, "y0 is missing"),
        ({"fun": spring, "acceleration": spring}, TypeError, "fun or acceleration, not both"),
        ({"fun": kepler()}, TypeError, r"fun must be callable, got .*problem\.solve_ivp"),
    ]
    refuse(solve_ivp, rows)
    with pytest.raises(ValueError, match="'EIPDOP853' is a name; give the class, as in `from eip_scipy"):
        solve_ivp(spring, (0, 1), [1.0, 0.0], method="EIPDOP853")


def test_warnings_name_the_line_of_the_call():
    with pytest.warns(UserWarning, match="no effect for a chosen solver: `hh`. `hh`: did you mean 'h'") as found:
        solve_ivp(spring, (0, 1), [1.0, 0.0], args=(K,), hh=0.1)
    with pytest.warns(UserWarning, match="`rtol` is too small") as low:
        solve_ivp(spring, (0, 1), [1.0, 0.0], args=(K,), rtol=1e-20, invariants=energy)
    with pytest.warns(UserWarning, match="no effect for a chosen solver: `min_step`.$") as other:
        solve_ivp(spring, (0, 1), [1.0, 0.0], args=(K,), min_step=0.1)  # of SciPy's LSODA, and no misspelling
    assert {item.filename for item in [*found, *low, *other]} == {__file__}


def test_arguments_of_invariants():
    """Arguments come after the invariant's own; equal ones are not given twice; a function without any is an error."""

    def scaled(t, y, factor, k):
        return factor * energy(t, y, k)

    sol = solve_ivp(spring, (0, 5), [1.0, 0.0], args=(K,), invariants=[Invariant(scaled, args=(3.0,)), BOUND])
    assert sol.trusted
    assert BOUND.args == (K,)
    with pytest.raises(TypeError, match=r"'invariant 0' is called with \(t, y, args\[0\]\).*those of the call"):
        solve_ivp(spring, (0, 5), [1.0, 0.0], args=(K,), invariants=lambda t, y: y @ y)


def test_accelerations():
    """q'' = -k q by an acceleration, against its closed form."""
    options = {"method": EIPRKN12, "args": (K,), "rtol": 1e-11, "atol": 1e-12, "invariants": energy}
    sol = solve_ivp(acceleration=lambda t, q, k: -k * q, t_span=(0, 5), y0=[1.0, 0.0], **options)
    np.testing.assert_allclose(sol.y[0], np.cos(np.sqrt(K) * sol.t), atol=1e-10)
    assert_same(sol, solve_ivp(spring, (0, 5), [1.0, 0.0], **options))


TARGET = Invariant(energy, gradient, target=K / 2 * 1.1**2, name="energy")


def test_the_projected_start_is_the_first_state():
    """From (1, 0) the energy of (1.1, 0) is reached along its gradient, (k, 0); y0 itself stays what it was."""
    given = {"t_span": (0, 3), "args": (K,), "invariants": TARGET, "project_initial": True}
    y0 = np.array([1.0, 0.0])
    for more in ({"y0": [1, 0]}, {"t_eval": [0, 1]}, {"dense_output": True}, {"t_span": (0, 0)}):
        sol = solve_ivp(spring, **{"y0": y0, **given, **more})
        np.testing.assert_allclose(sol.y[:, 0], [1.1, 0.0], rtol=1e-15)
        assert sol.y.dtype == float
        if sol.sol is not None:
            np.testing.assert_array_equal(sol.sol(0.0), sol.y[:, 0])
    np.testing.assert_array_equal(y0, [1, 0])


@pytest.mark.parametrize("solve", [solve_ivp, integrate], ids=lambda solve: solve.__name__)
def test_a_start_that_was_moved_is_reported(solve):
    """A start off by 0.1 is reported; one that is off by less than a target may be missed by is not."""
    given = {"t_span": (0, 1), "args": (K,), "invariants": TARGET, "project_initial": True, "method": EIPRK45}
    sol = solve(spring, y0=[1.0, 0.0], **given)
    moved = "project_initial moved 1 of 2 components of y0, most of all y0[0], from 1 to 1.1"
    assert moved in sol.message
    assert sol.diagnostics.moved == moved
    assert moved in repr(sol.diagnostics)
    assert sol.trusted
    derived = solve(spring, y0=[1.0, 0.0], variations="state", **given)
    assert derived.diagnostics.moved == moved  # derivatives behind the state are no components of y0
    near = solve(spring, y0=[1.1 * (1 + 1e-10), 0.0], **given)
    assert "moved" not in near.message
    assert near.diagnostics.moved == ""


def test_events_are_evaluated_at_the_projected_start():
    """An event between the given start and the projected one does not happen; y = 1.1 cos(sqrt(2) t) is 1.05 later."""
    given = {"args": (K,), "invariants": TARGET, "project_initial": True, "events": lambda t, y, k: y[0] - 1.05}
    sol = solve_ivp(spring, (0, 0.3), [1, 0], **given)
    np.testing.assert_allclose(sol.t_events[0], [np.arccos(1.05 / 1.1) / np.sqrt(K)], rtol=1e-4)


@pytest.mark.parametrize("stopped", [False, True], ids=["to the end", "by an event"])
def test_runs_that_are_not_reliable(stopped):
    """The message says so, a warning comes once, and a given record is the result's.

    SciPy ends a run at an event without the solver's knowledge: after three steps nothing has been checked before.
    """
    record = eip_scipy.Diagnostics()

    def event(t, y, k):
        return t - 0.12

    event.terminal = True
    options = {"args": (K,), "diagnostics": record, "h": 0.05, "method": EIPRK4}
    damped = lambda t, y, k: spring(t, y, k) - [0.0, 0.5 * y[1]]  # noqa: E731
    with pytest.warns(eip_scipy.ProjectionWarning, match="'energy' is not an invariant of this system") as found:
        sol = solve_ivp(damped, (0, 20), [1.0, 0.0], invariants=ENERGY, events=event if stopped else None, **options)
    assert len(found) == 1
    assert (sol.status, sol.success, sol.trusted) == (int(stopped), True, False)
    assert sol.diagnostics is record
    assert sol.message.endswith(f"; {record.message}")
    assert "'energy'" in record.message


def test_results_pickle_copy_and_print():
    sol = solve_ivp(
        spring, (0, 3), [1.0, 0.0], args=(K,), invariants=ENERGY, dense_output=True, events=crossing, rtol=1e-6
    )
    pickled = pickle.loads(pickle.dumps(sol))
    np.testing.assert_array_equal(pickled.sol(sol.t), sol.y)
    for other in (pickled, copy.deepcopy(sol), copy.copy(sol)):
        assert type(other) is OdeResult
        assert_same(other | {"sol": None}, sol | {"sol": None})
        assert other.trusted is True
        np.testing.assert_array_equal(other.diagnostics.max_residual, sol.diagnostics.max_residual)
    assert "trusted: True" in repr(sol)
    assert "energy" in repr(sol)


@pytest.mark.parametrize("method", [EIPRK45, EIPRKN12, "DOP853", "BDF", "LSODA"])
@pytest.mark.parametrize("saved", [{}, {"t_eval": [0, 2, 4, 4.01, 9]}, {"dense_output": True}])
def test_a_callback_stops_the_run_and_gets_each_saved_point(method, saved, capsys):
    """The points are those of the run without it, up to the one where it returns True."""
    points = []

    def stop(t, y, residuals):
        points.append((t, *y))
        assert (abs(residuals) < 1e-13).all()
        return t >= 4

    options = {"method": method, "args": (K,), "rtol": 1e-6, **saved}
    options |= {} if isinstance(method, str) else {"invariants": ENERGY}
    whole = solve_ivp(spring, (0, 9), [1.0, 0.0], **options)
    sol = solve_ivp(spring, (0, 9), [1.0, 0.0], **options, callback=stop, progress=True, max_steps=10**6)
    assert (sol.status, sol.success, sol.message) == (1, True, "stopped by the callback")
    np.testing.assert_array_equal(sol.t, whole.t[: sol.t.size])
    np.testing.assert_array_equal(sol.y, whole.y[:, : sol.t.size])
    np.testing.assert_array_equal(np.array(points).T, [sol.t, *sol.y])
    assert sol.t[-2] < 4 <= sol.t[-1]
    assert "/9.00" in capsys.readouterr().err
    if "dense_output" in saved:
        np.testing.assert_array_equal(sol.sol(sol.t[:-1]), whole.sol(sol.t[:-1]))
    few = solve_ivp(spring, (0, 9), [1.0, 0.0], **options, max_steps=3)
    assert (few.status, few.success, few.trusted) == (-1, False, False)
    assert "max_steps=3 steps were made, up to t=" in few.message


def test_a_callback_gets_the_event_that_ends_the_run():
    points = []
    sol = solve_ivp(spring, (0, 9), [1.0, 0.0], args=(K,), events=second_fall, variations="state",
                    callback=lambda t, y, residuals: points.append((t, *y)))  # fmt: skip
    np.testing.assert_array_equal(np.array(points).T, [sol.t, *sol.y])
    assert sol.t[-1] == sol.t_events[0][-1]
    given = {"fun": spring, "t_span": (0, 1), "y0": [1.0, 0.0], "args": (K,)}
    wrong = [({"callback": 3}, TypeError, "callback must be"), ({"progress": "x"}, ValueError, "progress"),
             ({"max_steps": 0}, ValueError, "max_steps")]  # fmt: skip
    refuse(solve_ivp, [(given | options, *rest) for options, *rest in wrong])
