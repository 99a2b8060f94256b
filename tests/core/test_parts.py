"""A state in parts: on two threads that exchange numbers, as processes do by messages."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from eip_scipy import EIPRK4, Invariant
from eip_scipy.core.parts import SolverOfParts

START = np.array([0.5, 0.0, 0.0, 3**0.5])
H = 0.02


class Processes:
    """Two of them; what they `gather` lies in the order of their numbers."""

    def __init__(self):
        self.barrier, self.board = threading.Barrier(2, timeout=60), [None, None]

    def gather(self, rank, a):
        self.board[rank] = np.array(a, dtype=float)
        self.barrier.wait()
        found = np.array(self.board)
        self.barrier.wait()
        return found

    def run(self, work):
        with ThreadPoolExecutor(2) as pool:
            return list(pool.map(work, range(2)))


def fun(y):
    return np.append(y[2:], -y[:2] / np.hypot(*y[:2]) ** 3)


def energy(y):
    return y[2:] @ y[2:] / 2 - 1 / np.hypot(*y[:2])


def energy_gradient(y):
    return np.append(y[:2] / np.hypot(*y[:2]) ** 3, y[2:])


def momentum(y):
    return y[0] * y[3] - y[1] * y[2]


def momentum_gradient(y):
    return np.array([y[3], -y[2], -y[1], y[0]])


def both(y):
    return np.array([momentum(y), 2 * momentum(y)])


def both_gradients(y):
    return np.array([momentum_gradient(y), 2 * momentum_gradient(y)])


def steps(solver, count):
    message = None
    while message is None and count:
        message, count = solver.step(), count - 1
    return solver.y, (solver.nfev, solver.njev), message


def whole(kept, count, **options):
    invariants = [Invariant(lambda t, y, f=f: f(y), lambda t, y, g=g: g(y)) for f, g in kept]
    solver = EIPRK4(lambda t, y: fun(y), 0.0, START, 10.0, h=H, metric="euclidean", check=False,
                    invariants=invariants, **options)  # fmt: skip
    return steps(solver, count)


def in_parts(kept, count, fun=fun, **options):
    processes = Processes()

    def work(rank):
        part = slice(2 * rank, 2 * rank + 2)

        def join(y):
            return processes.gather(rank, y).reshape(-1)

        class Method(SolverOfParts, EIPRK4):
            place = rank, 2

            def gathered(self, a):
                return processes.gather(rank, a)

        invariants = [Invariant(lambda t, y, f=f: f(join(y)), lambda t, y, g=g: g(join(y))[..., part]) for f, g in kept]
        solver = Method(lambda t, y: fun(join(y))[part], 0.0, START[part], 10.0, h=H, metric="euclidean", check=False,
                        invariants=invariants, **options)  # fmt: skip
        return steps(solver, count)

    (first, counts, message), (second, same, other) = processes.run(work)
    assert counts == same
    assert (message is None) == (other is None)
    return np.append(first, second), counts, [message, other]


@pytest.mark.parametrize("options", [{}, {"iterations": 2}, {"every": 3}], ids=str)
@pytest.mark.parametrize(
    "kept",
    [
        [],
        [(energy, energy_gradient)],
        [(energy, energy_gradient), (momentum, momentum_gradient)],
        [(energy, energy_gradient), (both, both_gradients)],
    ],
    ids=["none", "energy", "two", "dependent"],
)
def test_parts_step_as_the_whole_does(kept, options):
    y, counts, message = whole(kept, 99, **options)
    found, same, messages = in_parts(kept, 99, **options)
    np.testing.assert_allclose(found, y, rtol=0, atol=1e-13)
    assert (same, messages) == (counts, [message] * 2)
    for value, _ in kept:
        np.testing.assert_allclose(value(found), value(START), rtol=0, atol=1e-13)


def test_a_part_that_is_not_finite_fails_all():
    """One process detects the failure, and both report it; neither waits for the other in a sum."""

    def overflowing(y):
        f = fun(y)
        f[3] = np.inf if y[1] > 0.1 else f[3]
        return f

    found, _, (there, here) = in_parts([(energy, energy_gradient)], 5, overflowing)
    assert np.isfinite(found).all()
    assert here == "fun returned a non-finite value at t=0.06"
    assert there == "the state is no longer finite on another process, in the step from t=0.04"


def test_a_gradient_that_is_not_finite_fails_the_projection():
    def broken(y):
        return energy_gradient(y) * (np.nan if y[1] > 0.1 else 1.0)

    _, _, messages = in_parts([(energy, broken)], 5)
    assert all("projection failed" in message for message in messages)


def test_the_seam_is_to_be_filled_in():
    class Method(SolverOfParts, EIPRK4):
        pass

    with pytest.raises(NotImplementedError):
        Method(lambda t, y: -y, 0.0, np.ones(2), 1.0, h=0.1)
