"""Derivatives of the times of events and of the states there, against closed forms and complex steps."""

import numpy as np
import pytest
from numba import njit
from scipy.special import ellipe, ellipk

from eip_scipy import EIPDOP853, EIPGJ12, EIPGJ14, EIPRK4, EIPRKN8, EIPRKN12, Invariant, ensemble, integrate, load

TIGHT = {"method": EIPDOP853, "rtol": 1e-10, "atol": 1e-12}


def near(found, right, error):
    """Derivatives are at most 100 times as far from the right ones as the run is."""
    found, right = np.broadcast_arrays(found, right)
    size = np.abs(right).max()
    assert np.abs(found - right).max() < 100 * max(error, 2e-15) * size


def swing(t, y, p):
    return np.array([y[1], -p[0] * np.sin(y[0])])


SWING = Invariant(lambda t, y, p: 0.5 * y[1] ** 2 - p[0] * np.cos(y[0]), name="H")
TURNS = lambda t, y, p: y[1]  # noqa: E731


@pytest.mark.parametrize("options", [TIGHT, {"method": EIPRK4, "h": 0.01}, {"method": EIPDOP853, "h": 0.05}])
def test_half_periods_of_a_pendulum_by_its_angle_and_length(options, tmp_path):
    g_over_l, angle = 1.3, 1.0
    options = options | {"params": [g_over_l], "invariants": SWING, "variations": ["state", 0]}
    run = integrate(swing, (0, 30), [angle, 0.0], events=TURNS, **options)
    m, half = np.sin(angle / 2) ** 2, np.arange(1, 1 + run.t_events[0].size)
    times = half * 2 * ellipk(m) / np.sqrt(g_over_l)
    error = np.abs(run.t_events[0] / times - 1).max()
    slope = (ellipe(m) - (1 - m) * ellipk(m)) / (2 * m * (1 - m))  # of K by m
    dt = run.time_derivatives[0]
    near(dt[:, 0], half * 2 * slope * np.sin(angle) / 2 / np.sqrt(g_over_l), error)
    near(dt[:, 2], -times / (2 * g_over_l), error)
    at_event = run.state_derivatives[0]
    near(at_event[:, :, 0], np.outer((-1.0) ** half, [1.0, 0.0]), error)  # it turns at the angle of the start
    assert at_event.shape == run.tangent_events[0].shape == (half.size, 2, 3)
    run.save(tmp_path / "run.npz")
    np.testing.assert_array_equal(load(tmp_path / "run.npz").state_derivatives[0], at_event)
    many = ensemble(swing, (0, 30), [[angle, 0.0]] * 2, events=TURNS, **options | {"params": [[1.1], [g_over_l]]})
    for name in ("tangent_events", "time_derivatives", "state_derivatives"):
        np.testing.assert_array_equal(many[name][1][0], run[name][0])


def test_members_with_compiled_events_have_those_of_single_runs():
    function, event = njit(lambda t, y: np.array([y[1], -np.sin(y[0])])), njit(lambda t, y: y[1])
    options = {"method": EIPDOP853, "h": 0.05, "variations": "state", "events": event}
    many = ensemble(function, (0, 20), [[1.0, 0.0], [2.0, 0.3]], **options)
    for member, start in enumerate([[1.0, 0.0], [2.0, 0.3]]):
        one = integrate(function, (0, 20), start, **options)
        for name in ("tangent_events", "time_derivatives", "state_derivatives"):
            assert len(one[name][0]) > 3
            np.testing.assert_array_equal(many[name][member][0], one[name][0])


def attracted(t, y, p=(1.0,)):
    return np.concatenate([y[2:], -p[0] * y[:2] * (y[0] ** 2 + y[1] ** 2) ** -1.5])


def pericentre(t, y, p=None):
    return y[0] * y[2] + y[1] * y[3]


pericentre.direction = 1
KEPT = [
    Invariant(lambda t, y, p=(1.0,): 0.5 * (y[2] ** 2 + y[3] ** 2) - p[0] * (y[0] ** 2 + y[1] ** 2) ** -0.5, name="H"),
    Invariant(lambda t, y, p=None: y[0] * y[3] - y[1] * y[2], name="L"),
]


@pytest.mark.parametrize("method", [EIPDOP853, EIPRKN8, EIPRKN12, EIPGJ12, EIPGJ14])
def test_passages_of_pericentre_by_eccentricity_and_mass(method):
    q, e, mu = 0.7, 0.4, 1.2 if method is EIPDOP853 else 1.0
    asked = {"params": [mu], "variations": ["state", 0]} if method is EIPDOP853 else {"variations": "state"}
    v = np.sqrt(mu * (1 + e) / q)
    steps = {"h": 0.015} if method in (EIPGJ12, EIPGJ14) else TIGHT
    options = steps | {"method": method, "invariants": KEPT, "events": pericentre} | asked
    run = integrate(attracted, (0, 40), [q, 0.0, 0.0, v], **options)
    times = 2 * np.pi * (q / (1 - e)) ** 1.5 / np.sqrt(mu) * np.arange(1, 1 + run.t_events[0].size)
    error = max(np.abs(run.t_events[0] / times - 1).max(), np.abs(run.y_events[0] - [q, 0, 0, v]).max())
    dt = run.time_derivatives[0]
    assert times.size > 4
    near(dt[:, 3] * v / (2 * (1 + e)), 1.5 * times / (1 - e), error)
    if method is EIPDOP853:
        near(dt[:, 4] + dt[:, 3] * v / (2 * mu), -times / (2 * mu), error)


# Crossings of sections, by complex steps through small steps of the method and Newton's method for the last one.


def crossing(f, g, y, t, h=1 / 128):
    """Return time and state of a zero of g near t, of the orbit from y at t = 0, which may be complex."""
    A, b = (np.asarray(getattr(EIPDOP853.TABLEAU, name)) for name in "Ab")

    def step(y, h):
        K = []
        for row in A:
            K.append(f(0.0, y + h * sum((a * k for a, k in zip(row, K, strict=False)), 0 * y)))
        return y + h * sum(w * k for w, k in zip(b, K, strict=True))

    for _ in range(int(t / h)):
        y = step(y, h)
    last = t - int(t / h) * h
    for _ in range(5):
        end = step(y, last)
        last = last - g(0.0, end) / (g(0.0, end.real + 1e-20j * f(0.0, end.real)).imag / 1e-20)
    return int(t / h) * h + last, step(y, last)


def henon_heiles(t, y):
    return np.array([y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 + y[1] ** 2])


def lorenz(t, y):
    return np.array([10 * (y[1] - y[0]), 28 * y[0] - y[1] - y[0] * y[2], y[0] * y[1] - 8 / 3 * y[2]])


@pytest.mark.parametrize(
    ("fun", "start", "event"),
    [
        (henon_heiles, [0.0, 0.1, 0.35, 0.1], lambda t, y: y[0]),
        (lorenz, [1.0, 2.0, 20.0], lambda t, y: y[2] - 27.0),
        (lorenz, [1.0, 2.0, 20.0], lambda t, y: y[0] * y[1] - y[2] * 8 / 3),
    ],
)
@pytest.mark.parametrize("options", [TIGHT, {"method": EIPDOP853, "h": 0.01}])
def test_crossings_of_sections(fun, start, event, options):
    run = integrate(fun, (0, 5), start, variations="state", events=event, **options)
    (times,), (states,) = run.t_events, run.y_events
    for k in range(0, times.size, 3):
        ends = [crossing(fun, event, np.array(start) + 1e-20j * row, times[k]) for row in np.eye(len(start))]
        t, y = ends[0][0].real, ends[0][1].real
        error = max(abs(times[k] / t - 1), np.abs(states[k] - y).max() / np.abs(y).max())
        near(run.time_derivatives[0][k], [end[0].imag / 1e-20 for end in ends], error)
        near(run.state_derivatives[0][k], np.array([end[1].imag / 1e-20 for end in ends]).T, error)


def test_an_event_of_time_and_parameters():
    """y = y0 exp(a t) meets b cos(t). A start beyond a limit is its event, and so it is for all neighbouring starts."""
    event = lambda t, y, p: y[0] - p[1] * np.cos(t)  # noqa: E731
    options = TIGHT | {"params": [-0.1, 0.9], "variations": ["state", 0, 1]}
    run = integrate(lambda t, y, p: p[0] * y, (0, 2), [0.5], events=event, **options)
    (t,), (row,) = run.t_events[0], run.time_derivatives[0]
    rate = -0.1 * 0.5 * np.exp(-0.1 * t) + 0.9 * np.sin(t)
    near(row, -np.array([np.exp(-0.1 * t), 0.5 * t * np.exp(-0.1 * t), -np.cos(t)]) / rate, 1e-12)
    event = lambda t, y: y[0] - 0.2  # noqa: E731
    event.terminal, event.direction = True, np.inf
    run = integrate(lambda t, y: y, (0, 2), [0.5], events=event, variations="state", **TIGHT)
    assert (run.time_derivatives[0].tolist(), run.state_derivatives[0].tolist()) == ([[0.0]], [[[1.0]]])


def test_events_without_derivatives():
    def on_the_circle_only(t, y):
        if abs(y @ y - 1) > 1e-4:
            raise ArithmeticError("off the circle")
        return y[1]

    options = {"method": EIPDOP853, "h": 0.1, "variations": "state"}
    events = [lambda t, y: y[0] - (1 - 1e-14), lambda t, y: y[1], on_the_circle_only]
    run = integrate(lambda t, y: [y[1], -y[0]], (0, 3.5), [0.0, 1.0], events=events, **options)
    assert run.success
    assert run.t_events[0].size
    for k in (0, 2):
        assert np.isnan(run.time_derivatives[k]).all()
        assert np.isnan(run.state_derivatives[k]).all()
        assert np.isfinite(run.tangent_events[k]).all()
    assert np.isfinite(run.time_derivatives[1]).all()
    assert "event 0 has no derivatives at t=1.57" in run.message
    assert "because ArithmeticError was raised: off the circle" in run.message
    with pytest.raises(AttributeError, match=r"give it variations=... and events="):
        _ = integrate(lambda t, y: y, (0, 1), [1.0], method=EIPRK4, h=0.1).time_derivatives
