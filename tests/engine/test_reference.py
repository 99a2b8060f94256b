"""The engine compared with the method in plain NumPy, `reference_step`."""

import numpy as np
import pytest
from reference_step import Step

from eip_scipy import EIPDOP853, EIPRK1, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPRKN8, EIPRKN12, Invariant

NYSTROM = [EIPRKN8, EIPRKN12]
CLASSES = [EIPRK1, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPDOP853, *NYSTROM]
Y0 = np.array([0.7, 0.1, -0.3, 1.2, -0.2, 0.4])
SPINS = np.array([0.6 + 0.2j, -0.3 + 0.5j, 0.4 - 0.1j])


def pull(t, y):
    """A body in three dimensions under a force towards the origin."""
    return np.concatenate([y[3:], -y[:3] / (y[:3] @ y[:3]) ** 1.5])


ENERGY = (
    lambda t, y: 0.5 * y[3:] @ y[3:] - 1 / np.sqrt(y[:3] @ y[:3]),
    lambda t, y: np.concatenate([y[:3] / (y[:3] @ y[:3]) ** 1.5, y[3:]]),
)
MOMENTUM = (
    lambda t, y: np.cross(y[:3], y[3:]),
    lambda t, y: np.hstack([np.cross(np.eye(3), y[3:]).T, np.cross(y[:3], np.eye(3)).T]),
)


def precess(t, y):
    return -1j * (np.array([1.0, 2.0, 3.5]) * y + 0.5 * np.abs(y) ** 2 * y)


REAL = pull, [ENERGY, MOMENTUM], Y0
COMPLEX = precess, [(lambda t, y: np.vdot(y, y).real, lambda t, y: 2 * y)], SPINS
FRAME = np.eye(6)[:1], np.eye(6)[:, :1] + 0.25 * np.eye(6)[:, 1:2]


def length(cls):
    """Return the length of a step, whose error exceeds the offset of the targets from the start's values."""
    return 0.5 if cls in (EIPDOP853, EIPRKN8, EIPRKN12) else 0.05


def both(cls, problem, y0, steps=1, **options):
    """Make steps from y0 by the engine and by the reference; the targets differ a little from the start's values."""
    (fun, pairs, _), h = problem, length(cls)
    invariants, first = [], []
    for value, gradient in pairs:
        target = np.asarray(value(0.0, y0)) * (1 + 1e-9)
        first.append(np.atleast_1d(target))
        invariants.append(Invariant(value, gradient, target=target))
    given = {"rtol": 1e-3, "atol": 1e-6} | options
    solver = cls(fun, 0.0, y0.copy(), 10.0, h=h, invariants=invariants, check=False, **given)
    for _ in range(steps):
        assert solver.step() is None

    def values(t, y):
        return np.concatenate([np.atleast_1d(value(t, y)) for value, _ in pairs])

    def gradients(t, y):
        return np.concatenate([np.atleast_2d(gradient(t, y)) for _, gradient in pairs])

    given = {name: value for name, value in given.items() if name not in ("every", "compensated", "reuse_f")}
    step = Step(cls.TABLEAU, fun, values, gradients, np.concatenate(first), **given)
    y = y0
    for k in range(steps):
        y = step(k * h, y, h)
    return solver.y, y, step


OPTIONS = [
    {},
    {"metric": "euclidean"},
    {"metric": np.array([1.0, 0.5, 0.2, 0.7, 0.9, 0.3])},
    {"blocks": [[0, 1, 2], [3, 4, 5]]},
    {"blocks": [[0, 3], [1, 4], [2, 5]], "rtol": 1e-5, "atol": 1e-9},
    {"direction": "old"},
    {"direction": "midpoint"},
    {"iterations": 3},
    {"direction": "midpoint", "iterations": 2, "blocks": [[0, 1, 2], [3, 4, 5]]},
    {"linear_invariants": FRAME},
    {"linear_invariants": FRAME, "blocks": [[0, 1, 2], [3, 4, 5]], "iterations": 2},
]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda o: "-".join(o) or "plain")
def test_a_step_is_that_of_the_method(options):
    for cls in CLASSES:
        more = {"every": 1, "compensated": False} if cls in NYSTROM else {}
        found, expected, step = both(cls, REAL, Y0, **more, **options)
        moved = np.abs(expected - Y0).max()
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14 * moved + 3e-16, err_msg=cls.__name__)
        if options.get("iterations", 1) > 2:
            assert np.abs(step.residuals(length(cls), found)).max() <= 1e-15


@pytest.mark.parametrize("options", [{}, {"blocks": [[0, 3], [1, 4], [2, 5]]}, {"blocks": 3}, {"atol": 0.0}])
@pytest.mark.parametrize("cls", [EIPRK4, EIPRK45, EIPDOP853])
def test_errors_of_earlier_steps_are_remembered(cls, options):
    given = {"blocks": [[0, 1, 2], [3, 4, 5]]} if options.get("blocks") == 3 else options
    found, expected, step = both(cls, REAL, Y0, steps=6, **given, reuse_f=False)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    forgetful = both(cls, REAL, Y0, **given)[2]
    assert not np.array_equal(step.remembered, forgetful.remembered)


@pytest.mark.parametrize("options", [{}, {"metric": "euclidean"}, {"blocks": [[0, 2], [1]]}, {"direction": "old"}])
def test_complex_states_too(options):
    for cls in CLASSES[:8]:
        found, expected, _ = both(cls, COMPLEX, SPINS, **options)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15, err_msg=cls.__name__)
