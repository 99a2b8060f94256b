"""heyoka's Taylor integrator with projections, against closed forms and heyoka in 80 bits."""

import mpmath
import numpy as np
import pytest

heyoka = pytest.importorskip("heyoka", reason='needs heyoka: pip install "eip_scipy[heyoka]"')

from eip_scipy import ProjectionWarning  # noqa: E402
from eip_scipy.integrations.heyoka import ProjectedTaylor  # noqa: E402

X, Y, U, V = STATE = heyoka.make_vars("x", "y", "u", "v")
GM = heyoka.par[0]
START = np.array([0.5, 0.0, 0.0, 3**0.5])
ENERGY, MOMENTUM = (U * U + V * V) / 2.0 - GM / heyoka.sqrt(X * X + Y * Y), X * V - Y * U
END = 6283.25


def kepler(**options):
    pull = -GM * (X * X + Y * Y) ** -1.5
    options = {"pars": [1.0]} | options
    return heyoka.taylor_adaptive([(X, U), (Y, V), (U, X * pull), (V, Y * pull)], START, **options)


@pytest.fixture(scope="module")
def flow():
    return ProjectedTaylor(kepler(tol=1e-13), {"energy": ENERGY, "momentum": MOMENTUM}, every=128)


@pytest.fixture(autouse=True)
def at_the_start(request):
    if "flow" in request.fixturenames:
        flow = request.getfixturevalue("flow")
        flow.integrator.time, flow.integrator.state[:] = 0.0, START
        flow.targets = flow.values


def position(t):
    """Closed form, from the start as it is rounded."""
    with mpmath.workdps(30):
        r, v = mpmath.mpf(START[0]), mpmath.mpf(START[3])
        a = 1 / (2 / r - v**2)
        e = 1 - r / a
        anomaly = mpmath.findroot(lambda x: x - e * mpmath.sin(x) - mpmath.mpf(t) / a**1.5, float(t))
        return np.array([a * (mpmath.cos(anomaly) - e), a * mpmath.sqrt(1 - e**2) * mpmath.sin(anomaly)], dtype=float)


def error(t, y):
    return np.abs(y[:2] - position(t)).max()


def test_more_accurate_than_alone(flow):
    alone = kepler(tol=1e-13)
    alone.propagate_until(END)
    found = flow.propagate_until(END)
    assert found[0] == heyoka.taylor_outcome.time_limit
    assert found[3] / 128 <= flow.n_projections < found[3] / 128 + 2
    assert error(END, flow.integrator.state) < 0.03 * error(END, alone.state)
    assert np.abs(flow.values - flow.targets).max() < 1e-15
    flow.propagate_until(0.0)
    assert np.abs(flow.integrator.state - START).max() < 1e-9


def test_grid_and_dense_output(flow):
    times = np.linspace(0, 200, 3001)
    *_, rows = flow.propagate_grid(times)
    assert rows.shape == (3001, 4)
    assert max(error(t, y) for t, y in zip(times[::500], rows[::500], strict=True)) < 1e-11
    assert np.ptp(rows[:, 0] * rows[:, 3] - rows[:, 1] * rows[:, 2]) < 1e-15
    flow.propagate_until(0.0)
    flow.integrator.state[:] = START
    output = flow.propagate_until(200.0, c_output=True)[4]
    assert output.bounds == (0.0, 200.0)
    mixed = np.random.default_rng(1).permutation(3001)
    assert np.abs(output(times[mixed]) - rows[mixed]).max() < 1e-12
    assert output(times[7]).shape == (4,)
    back = flow.propagate_until(0.0, c_output=True)[4]
    assert np.abs(back(times) - rows).max() < 1e-11
    with pytest.raises(ValueError, match=r"reaches from 200.* to 0.*got t=201"):
        back(201.0)


def test_events_end_a_run():
    at = heyoka.t_event(Y, direction=heyoka.event_direction.positive)
    flow = ProjectedTaylor(kepler(t_events=[at]), [ENERGY], every=10)
    flow.integrator.propagate_until(0.1)
    outcome = flow.propagate_until(100.0)[0]
    assert int(outcome) == -1  # the event of that index, which ends the run
    assert flow.integrator.time == pytest.approx(2 * np.pi, abs=1e-13)
    rows = flow.propagate_grid([flow.integrator.time, 8.0, 99.0])[-1]
    assert rows.shape == (2, 4)


def test_rank():
    """In three dimensions energy, angular momentum and Laplace's vector are 7 invariants of rank 5."""
    q, v = heyoka.make_vars("x", "y", "z"), heyoka.make_vars("vx", "vy", "vz")
    r = heyoka.sqrt(heyoka.sum([a * a for a in q]))

    def cross(a, b):
        return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]

    momentum = cross(q, v)
    laplace = [a - b / r for a, b in zip(cross(v, momentum), q, strict=True)]
    energy = heyoka.sum([a * a for a in v]) / 2.0 - 1.0 / r
    equations = [*zip(q, v, strict=True), *((b, -a / r**3.0) for a, b in zip(q, v, strict=True))]
    start = [0.5, 0.1, -0.2, -0.3, 1.5, 0.2]
    flow = ProjectedTaylor(heyoka.taylor_adaptive(equations, start, tol=1e-7), [energy, *momentum, *laplace], every=5)
    flow.propagate_until(40.0)
    assert flow.max_residual.max() > 1e-10
    assert np.abs(flow.values - flow.targets).max() < 1e-14


def test_what_is_no_invariant():
    flow = ProjectedTaylor(kepler(), {"x": X})
    with pytest.warns(ProjectionWarning, match="invariant 'x' had errors of up to"):
        flow.propagate_until(30.0)


@pytest.mark.parametrize(
    ("invariants", "options", "message"),
    [
        ([], {}, "at least one invariant"),
        ([heyoka.make_vars("w")], {}, r"invariant 'invariant 0' contains w.*variables are u, v, x, y"),
        ({"I": X + heyoka.par[1]}, {}, "contains p1.*1 parameters"),
        ([X - X - heyoka.log(-X)], {}, "have the values .nan. at the start"),
        ([X * heyoka.time], {}, "depends on time"),
        ([ENERGY], {"every": 0}, "every"),
    ],
)
def test_wrong_arguments(invariants, options, message):
    with pytest.raises(ValueError, match=message):
        ProjectedTaylor(kepler(), invariants, **options)


def test_other_integrators():
    extended = heyoka.taylor_adaptive([(X, -X)], np.array([1], np.longdouble), fp_type=np.longdouble)
    with pytest.raises(TypeError, match="in double precision"):
        ProjectedTaylor(extended, [X])
