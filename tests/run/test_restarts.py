"""Runs that are restarted with a change: kicks, bounces, other parameters, other equations; also from a file."""

import mpmath
import numpy as np
import pytest
import scipy.integrate
from numba import njit
from systems import momentum, pericentre, refuse

from eip_scipy import (
    EIPDOP853,
    EIPRK4,
    EIPRK45,
    EIPRKN12,
    Invariant,
    ProjectionWarning,
    eip_method,
    hamiltonian,
    integrate,
    load,
)
from eip_scipy.methods import Tableau
from eip_scipy.problems import Problem
from eip_scipy.problems import kepler as ready

G = 9.81
TIGHT = {"method": EIPDOP853, "rtol": 1e-11, "atol": 1e-13}


def falling(t, y, p=None):
    return np.array([y[1], -G + 0 * y[0]])


def ground(t, y, p=None):
    return y[0]


ground.terminal, ground.direction = True, -1
ENERGY = Invariant(lambda t, y: 0.5 * y[1] ** 2 + G * y[0], name="E")


def reloaded(run, path):
    run.save(path / "run.npz")
    return load(path / "run.npz")


def bouncing(e, height, until, path=None, *, most=10**6, **options):
    """Return the run of a ball that falls and bounces until the time is over, with files between if `path` is given."""
    run = integrate(falling, (0, until), [height, 0.0], events=ground, **TIGHT | options)
    given = {"jacobian": np.diag([0.0, -e])} if "variations" in options else {}
    known = {name: options[name] for name in ("invariants",) if path is not None and name in options}
    known |= {"fun": falling, "events": ground} if path is not None else {}
    while run.status == 1 and run.t_events[0].size < most:
        run = run if path is None else reloaded(run, path)
        run = run.continue_to(until, y=lambda y: [0.0, -e * y[1]], **known, **given)
    return run


def bounce_times(e, height, count):
    return np.sqrt(2 * height / G) * (1 + 2 * np.cumsum(np.concatenate([[0], e ** np.arange(1.0, count)])))


@pytest.mark.parametrize(("e", "method"), [(0.999, EIPDOP853), (0.9, EIPRK45), (0.999, EIPRKN12)])
def test_a_thousand_bounces(e, method):
    run = bouncing(e, 1.0, 1e4, method=method, invariants=ENERGY, most=1001)
    np.testing.assert_allclose(run.t_events[0], bounce_times(e, 1.0, 1001), rtol=1e-9)
    assert run.trusted
    assert len(run.restarts) == 1000
    assert run.restarts[7] == (run.t_events[0][7], "y")
    # The states before and after each bounce are saved, with the energy that is kept there.
    np.testing.assert_array_equal(run.t[1:-1:2], run.t[2::2])
    np.testing.assert_allclose(run.targets[0, 2::2], G * e ** (2 * np.arange(1, 1001)), rtol=1e-8, atol=1e-17)
    assert np.abs(run.invariants - run.targets).max() < 1e-11
    assert run.max_residual[0] == run.diagnostics.max_residual[0] < 1e-11
    np.testing.assert_array_equal(run.to_dataframe()["E error"], (run.invariants - run.targets)[0])


@pytest.mark.parametrize("from_file", [False, True])
def test_derivatives_after_bounces_by_the_height(from_file, tmp_path):
    e, height, until = 0.8, 1.3, 3.7
    options = {"invariants": ENERGY, "variations": "state", "dense_output": not from_file}
    run = bouncing(e, height, until, tmp_path if from_file else None, **options)
    times = bounce_times(e, height, run.t_events[0].size)
    assert times.size > 5
    np.testing.assert_allclose(run.time_derivatives[0][:, 0], times / (2 * height), rtol=1e-11)
    since, speed = until - times[-1], e**times.size * np.sqrt(2 * G * height)
    np.testing.assert_allclose(run.y[:, -1], [speed * since - G * since**2 / 2, speed - G * since], rtol=1e-9)
    # dt of the last bounce and dv of its speed by the height; in between only time has passed.
    shift, faster = times[-1] / (2 * height), speed / (2 * height)
    right = [faster * since - (speed - G * since) * shift, faster + G * shift]
    np.testing.assert_allclose(run.stm[-1, :, 0], right, rtol=1e-9)
    if not from_file:
        np.testing.assert_allclose(run.sol(run.t[1:-1:2]), run.y[:, 1:-1:2], rtol=0, atol=1e-12)
        assert run.sol(times[:-1] + 1e-3)[1] == pytest.approx(
            e ** np.arange(1, times.size) * np.sqrt(2 * G * height) - G * 1e-3
        )


def test_derivatives_by_the_restitution():
    """T2: a parameter of the bounce alone, whose column the Jacobian has behind those of the state."""
    e = 0.8
    fall = lambda t, y, p: np.array([y[1], -p[0] + 0 * y[0]])  # noqa: E731
    run = integrate(fall, (0, 9), [1.0, 0.0], params=[G, e], variations=[1], events=ground, **TIGHT)
    for _ in range(4):
        jacobian = lambda y: [[0.0, 0.0, 0.0], [0.0, -e, -y[1]]]  # noqa: E731
        run = run.continue_to(9, y=lambda y: [0.0, -e * y[1]], jacobian=jacobian)
    k = np.arange(5)
    np.testing.assert_allclose(
        run.time_derivatives[0][:, 0], 2 * np.sqrt(2 / G) * np.cumsum(k * e ** (k - 1.0)), rtol=1e-11
    )
    np.testing.assert_allclose(run.state_derivatives[0][1:, 1, 0], (k * run.y_events[0][:, 1] / e)[1:], rtol=1e-11)


def test_results_of_one_run_continued_twice_are_independent():
    first = bouncing(0.9, 1.0, 9.0, most=3, dense_output=True)
    ahead = first.continue_to(9.0, y=lambda y: [0.0, -y[1]])
    rows = ahead.y.copy()
    other = first.continue_to(9.0, y=lambda y: [0.0, -0.5 * y[1]])
    for run in (ahead, other):
        np.testing.assert_array_equal(run.y[:, : first.t.size], first.y)
        assert (run.t.size, run.t_events[0].size) == (first.t.size + 2, 4)
        np.testing.assert_allclose(run.sol(run.t[-1] - 0.01)[1], run.y[1, -1] + 0.01 * G)
    assert ahead.t_events[0][-1] - first.t[-1] == pytest.approx(2 * (other.t_events[0][-1] - first.t[-1]))
    np.testing.assert_array_equal(ahead.y, rows)
    assert len(first.restarts) == 2
    assert np.shares_memory(first.y, ahead.y)  # so that a loop of restarts does not copy all rows each time


def test_a_pendulum_whose_gravity_changes():
    """T3: the energy gets a new target, with the parameters that a mapping names."""
    pendulum = hamiltonian("p**2/(2*m) - g*m*cos(q)", params={"g": 9.81, "m": 1.2})
    other = hamiltonian("p**2/2 - k*cos(q)", params={"k": 1.0})
    by_mass = integrate(pendulum, (0, 1), [1.0, 0.0], variations=["m"], **TIGHT)
    refuse(
        by_mass.continue_to,
        [
            ({"t": 2, "fun": other}, ValueError, r"fun has others, \['k'\], than before, \['g', 'm'\]"),
            ({"t": 2, "params": [1.0]}, ValueError, "params has 1 values, and the run had 2"),
        ],
    )
    run = integrate(pendulum, (0, 1), [1.0, 0.0], params={"m": 0.7}, **TIGHT).continue_to(3, params={"g": 1.62})
    y = [1.0, 0.0]
    for g, span in ((9.81, (0, 1)), (1.62, (1, 3))):
        rhs = lambda t, y, g=g: [y[1] / 0.7, -g * 0.7 * np.sin(y[0])]  # noqa: E731
        y = scipy.integrate.solve_ivp(rhs, span, y, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(run.y[:, -1], y, rtol=0, atol=1e-9)
    assert run.restarts == [(1.0, "params")]
    np.testing.assert_allclose(
        run.targets[0],
        -0.7 * np.array([9.81, 9.81, 1.62, 1.62]) * np.cos([1, 1, *run.y[0, 1:2], *run.y[0, 1:2]])
        + np.array([0, 0, 1, 1]) * run.y[1, 1] ** 2 / 1.4,
        rtol=1e-9,
    )


# Burns.


def kepler(t, y):
    return np.concatenate([y[2:], -y[:2] * (y[0] ** 2 + y[1] ** 2) ** -1.5])


KEPT = [
    Invariant(lambda t, y: 0.5 * (y[2] ** 2 + y[3] ** 2) - (y[0] ** 2 + y[1] ** 2) ** -0.5, name="H"),
    Invariant(momentum, name="L"),
]


def apsis(t, y):
    return y[:2] @ y[2:]


apsis.terminal = True


@pytest.mark.parametrize("from_file", [False, True])
def test_a_transfer_with_three_burns(from_file, tmp_path):
    """A bielliptic transfer between circles, against the formulas of conics."""
    inner, outer, far = 1.0, 4.0, 9.0
    speed = lambda r, a: np.sqrt(2 / r - 1 / a)  # noqa: E731
    legs = [(inner, (inner + far) / 2), (far, (outer + far) / 2), (outer, outer)]
    run = integrate(kepler, (0, 1.0), [inner, 0.0, 0.0, 1.0], invariants=KEPT, **TIGHT)
    times = [1.0]
    for r, a in legs:
        known = {"fun": kepler, "invariants": KEPT} if from_file else {}
        if from_file:
            run = reloaded(run, tmp_path)
        burn = lambda y, r=r, a=a: np.concatenate([y[:2], y[2:] / np.hypot(*y[2:]) * speed(r, a)])  # noqa: E731
        run = run.continue_to(run.t[-1] + 60, y=burn, events=apsis if r != outer else None, **known)
        times.append(times[-1] + np.pi * a**1.5)
        r_now = np.hypot(*run.y[:2, -1])
        assert run.trusted
        assert abs(r_now / (2 * a - r) - 1) < 1e-9
        assert run.t[-1] == pytest.approx(times[-1] if r != outer else times[-2] + 60, rel=1e-9)
    assert run.target == pytest.approx([-1 / (2 * outer), np.sqrt(outer)], rel=1e-9)
    assert [what for _, what in run.restarts] == ["y, events", "y" if from_file else "y, events", "y, events"]
    assert np.abs(run.invariants - run.targets).max() < 1e-13


def test_what_a_kick_leaves_keeps_its_target():
    """A radial kick changes H alone; a target that the user gave stays, so that a kick must not violate it."""
    start = pericentre(0.3)
    run = integrate(kepler, (0, 3), start, method=EIPRK4, h=0.05, invariants=KEPT)
    kicked = run.continue_to(6, y=lambda y: [*y[:2], *(y[2:] + 0.1 * y[:2])])
    assert kicked.target[1] == run.target[1] == start[0] * start[3]
    assert kicked.target[0] != run.target[0]
    given = [KEPT[0], Invariant(momentum, target=run.target[1], name="L")]
    run = integrate(kepler, (0, 3), start, method=EIPRK4, h=0.05, invariants=given)
    assert run.continue_to(6, y=lambda y: [*y[:2], *(y[2:] + 0.1 * y[:2])]).trusted
    refuse(run.continue_to, [({"t": 6, "y": lambda y: 1.1 * y}, ValueError, "start violates invariant 'L'")])


# A clutch: two wheels slip, and turn together once their speeds are equal.

J1, J2, TORQUE, FRICTION = 2.0, 3.0, 0.4, 1.5


def slips(t, y):
    return np.array([y[2], y[3], (TORQUE - FRICTION) / J1 + 0 * y[0], FRICTION / J2 + 0 * y[0]])


def sticks(t, y):
    return np.array([y[2], y[3], TORQUE / (J1 + J2) + 0 * y[0], TORQUE / (J1 + J2) + 0 * y[0]])


def equal_speeds(t, y):
    return y[2] - y[3]


equal_speeds.terminal = True
MOMENTUM = Invariant(lambda t, y: J1 * y[2] + J2 * y[3] - TORQUE * t, name="L")
TOGETHER = Invariant(equal_speeds, target=0.0, name="slip")


def clutch(first, second, until):
    """Return the state in closed form."""
    t = (first - second) / ((FRICTION - TORQUE) / J1 + FRICTION / J2)
    a, b = (TORQUE - FRICTION) / J1, FRICTION / J2
    rate, v, rest = TORQUE / (J1 + J2), second + b * t, until - t
    angles = np.array([first * t + a * t**2 / 2, second * t + b * t**2 / 2]) + v * rest + rate * rest**2 / 2
    return np.array([*angles, v + rate * rest, v + rate * rest])


@pytest.mark.parametrize("from_file", [False, True])
def test_a_clutch(from_file, tmp_path):
    run = integrate(
        slips, (0, 2), [0, 0, 6.0, 1.0], invariants=MOMENTUM, events=equal_speeds, variations="state", **TIGHT
    )
    if from_file:
        run = reloaded(run, tmp_path).continue_to(9, fun=slips, invariants=MOMENTUM, events=equal_speeds)
    else:
        run = run.continue_to(9)
    run = run.continue_to(9, fun=sticks, invariants=[MOMENTUM, TOGETHER], events=None)
    if from_file:
        run = reloaded(run, tmp_path).continue_to(12, fun=sticks, invariants=[MOMENTUM, TOGETHER])
    else:
        run = run.continue_to(12)
    assert run.trusted
    np.testing.assert_allclose(run.y[:, -1], clutch(6.0, 1.0, 12), rtol=1e-12)
    right = [clutch(6.0 + 1e-30j, 1.0, 12).imag / 1e-30, clutch(6.0, 1.0 + 1e-30j, 12).imag / 1e-30]
    np.testing.assert_allclose(run.stm[-1][:, 2:].T, right, rtol=1e-10)
    assert [what for _, what in run.restarts] == ["fun, invariants, events"]
    assert run.diagnostics.names == ("L", "slip")
    assert np.isnan(run.invariants[1, run.t < run.restarts[0][0]]).all()
    assert np.nanmax(np.abs(run.invariants - run.targets)) < 1e-13
    assert list(run.to_dataframe().columns[4:8]) == ["L", "L error", "slip", "slip error"]
    assert "L   " in repr(run.diagnostics)


# A mass that sticks to an oscillator when it passes its rest.


@pytest.mark.parametrize("from_file", [False, True])
def test_a_mass_that_changes_at_an_event(from_file, tmp_path):
    k, m, more = 2.0, 1.0, 1.7
    spring = lambda t, y, p: np.array([y[1] / p[0], -k * y[0]])  # noqa: E731 # (x, momentum)
    energy = Invariant(lambda t, y, p: y[1] ** 2 / (2 * p[0]) + k * y[0] ** 2 / 2, name="E")
    rest = lambda t, y, p: y[0]  # noqa: E731
    rest.terminal = True
    options = {"params": [m], "invariants": energy, "variations": ["state", 0], "events": rest}
    run = integrate(spring, (0, 9), [0.8, 0.0], **options, **TIGHT)
    known = {"fun": spring, "invariants": energy} if from_file else {}
    run = (reloaded(run, tmp_path) if from_file else run).continue_to(5, params=[m + more], events=None, **known)

    def state(x, m):  # a quarter of a period, and then with the momentum that it had
        w, w2, t = np.sqrt(k / m), np.sqrt(k / (m + more)), 5 - np.pi / 2 / np.sqrt(k / m)
        p = -m * w * x
        return np.array([p / ((m + more) * w2) * np.sin(w2 * t), p * np.cos(w2 * t)])

    np.testing.assert_allclose(run.y[:, -1], state(0.8, m), rtol=1e-9)
    np.testing.assert_allclose(run.stm[-1][:, 0], state(0.8, m) / 0.8, rtol=1e-9)
    np.testing.assert_allclose(run.sensitivities[-1][:, 0], state(0.8, m + 1e-30j).imag / 1e-30, rtol=1e-9)
    assert run.target[0] == pytest.approx((k * m * 0.8**2) / (2 * (m + more)), rel=1e-9)
    assert run.trusted


@pytest.mark.needs_jit
def test_landing_of_a_ball_with_drag_by_its_speed_and_drag():
    """T1: the drag -c v abs(v) has a kink at the top, where the run is restarted."""

    @njit
    def thrown(t, y, p):
        return np.array([y[1], -9.81 - p[0] * y[1] * abs(y[1])])

    def top(t, y, p):
        return y[1]

    top.terminal = True
    run = integrate(thrown, (0, 9), [0.0, 12.0], params=[0.02], variations=["state", 0], events=top, **TIGHT)
    run = run.continue_to(9, events=ground)

    def lands(v, c):  # up by tan, down by tanh
        limit = mpmath.sqrt(mpmath.mpf("9.81") / c)
        return limit / mpmath.mpf("9.81") * (mpmath.atan(v / limit) + mpmath.acosh(mpmath.sqrt(1 + (v / limit) ** 2)))

    assert run.t[-1] == pytest.approx(float(lands(12.0, 0.02)), rel=1e-10)
    right = [float(mpmath.diff(lands, (12.0, 0.02), order)) for order in ((1, 0), (0, 1))]
    np.testing.assert_allclose(run.time_derivatives[0][0, 1:], right, rtol=1e-8)


def test_a_wall_moves_the_state_away_from_its_event():
    """Periodic walls: the event is not zero where the run continues, and happens again after the whole way."""

    def wall(t, y):
        return y[0] - 1

    wall.terminal, wall.direction = True, 1
    free = Problem("free", lambda t, y: [y[1], 0.0], y0=[0.25, 0.5], t_span=(0, 9), events=wall)
    run = integrate(free, method=EIPRK4, h=3.0)  # the event lies inside the first step
    for _ in range(3):
        run = run.continue_to(9, y=lambda y: y - [1, 0])
    np.testing.assert_allclose(run.t_events[0], [1.5, 3.5, 5.5, 7.5], rtol=1e-13)


def test_refuses():
    options = {"method": EIPRK4, "h": 0.1, "invariants": ENERGY}
    run, wide = (integrate(falling, (0, 1), [9.0, 0.0], **options, **more) for more in ({}, {"variations": "state"}))
    turn = lambda y: -y  # noqa: E731
    rows = [
        ({"y": [1.0]}, ValueError, "y has 1 components, but the state has 2"),
        ({"y": [1.0, np.nan]}, ValueError, "y"),
        ({"jacobian": np.eye(2)}, ValueError, "jacobian is the derivative of the change y=..., which is missing"),
        ({"y": turn, "jacobian": -np.eye(2)}, ValueError, "jacobian belongs to a run with derivatives"),
        ({"fun": falling, "acceleration": falling}, TypeError, "give fun or acceleration, not both"),
    ]
    refuse(run.continue_to, [({"t": 2.0} | given, *rest) for given, *rest in rows])
    with pytest.warns((UserWarning, ProjectionWarning), match="'E' is not an invariant of this system"):
        assert not run.continue_to(1.5, fun=lambda t, y: [y[1], -5.0]).trusted
    rows = [
        ({"y": turn}, ValueError, r"by jacobian=..., the derivative \(2, 2\)"),
        ({"y": turn, "jacobian": np.eye(3)}, ValueError, r"jacobian has shape \(3, 3\)"),
        ({"y": turn, "jacobian": np.eye(2)}, ValueError, r"jacobian is not the derivative of y\(state\)"),
        ({"fun": falling, "jacobian": np.eye(2)}, ValueError, "Give both"),
    ]
    refuse(wide.continue_to, [({"t": 2.0} | given, *rest) for given, *rest in rows])
    top = lambda t, y: y[0] - (1 - 1e-14)  # noqa: E731
    top.terminal = True
    grazes = integrate(
        lambda t, y: [y[1], -y[0]], (0, 9), [0.0, 1.0], method=EIPDOP853, h=0.1, events=top, variations="state"
    )
    given = {"t": 9.0, "y": turn, "jacobian": -np.eye(2)}
    refuse(grazes.continue_to, [(given, ValueError, "event 0, at which the run ended, has no derivatives")])
    turned = wide.continue_to(2.0, y=turn, jacobian=lambda y: -np.eye(2))
    np.testing.assert_allclose(turned.stm[-1], [[-1, -2], [0, -1]], atol=1e-12)


def test_problems(tmp_path):
    """A loaded run goes on with the same bits; a function in place of a problem keeps its step, not its invariants."""
    run = integrate(ready(), (0, 5), method=EIPRK4, variations="state")
    longer, again = run.continue_to(9), reloaded(run, tmp_path).continue_to(9, fun=ready())
    np.testing.assert_array_equal(again.y, longer.y)
    np.testing.assert_array_equal(again.stm, longer.stm)
    assert again.restarts == longer.restarts == []
    assert (longer.target == longer.targets.T).all()
    other = integrate(ready(), (0, 5), method=EIPRK4).continue_to(9, fun=lambda t, y: ready().fun(t, y))
    assert (other.h, other.restarts, other.diagnostics.names) == (0.03, [(5.0, "fun")], ("H", "L"))
    np.testing.assert_allclose(other.y[:, -1], longer.y[:, -1], rtol=0, atol=1e-4)
    heavier = other.continue_to(12, fun=ready(), params=[0.02])
    assert heavier.targets[0, 0] == run.target[0] > heavier.target[0]
    assert heavier.target[1] == pytest.approx(run.target[1], rel=1e-4)
    assert np.isnan(heavier.invariants[:, 2:4]).all()
    assert heavier.trusted


def test_a_loaded_run_takes_the_functions_that_it_had(tmp_path):
    options = {"h": 0.1, "method": EIPRK4, "events": ground, "invariants": ENERGY}
    run = reloaded(integrate(falling, (0, 9), [9.0, 0.0], **options), tmp_path)
    given = {"t": 9.0, "y": lambda y: -y, "fun": falling, "invariants": ENERGY, "events": ground}
    other = Invariant(lambda t, y: y[1] ** 2 + G * y[0], name="E")
    rows = [
        ({"fun": None}, ValueError, "a file does not hold functions"),
        ({"events": "left out"}, ValueError, "could not hold its events"),
        ({"invariants": None}, ValueError, r"the run had invariants with 1 values \(E\), and those given have 0"),
        ({"invariants": other}, ValueError, "the invariant 'E' was 88.29"),
        ({"fun": lambda t, y: [y[1], -9.8]}, ValueError, "fun was -9.81 at t=1.354"),
    ]
    for change, *rest in rows:
        refuse(run.continue_to, [({name: v for name, v in (given | change).items() if not isinstance(v, str)}, *rest)])
    longer = run.continue_to(**given)
    assert longer.t_events[0].size == 2
    again = reloaded(run, tmp_path).continue_to(**given)
    np.testing.assert_array_equal(again.y, longer.y)
    assert run.continue_to(**given | {"events": ()}).t[-1] == 9.0
    own = eip_method(Tableau("Heun", A=[[0, 0], [1, 0]], b=[0.5, 0.5], order=2, reference="Heun 1900"))
    run = reloaded(integrate(falling, (0, 1), [9.0, 0.0], h=0.1, method=own), tmp_path)
    refuse(run.continue_to, [({"t": 2.0, "fun": falling}, ValueError, "could not hold its method")])
    assert run.continue_to(2.0, fun=falling, method=own).t[-1] == 2.0
