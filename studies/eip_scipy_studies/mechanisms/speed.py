"""Processor time of the four-bar linkage's right-hand side, and from a SymPy model to its first result."""

from __future__ import annotations

import time
from typing import NamedTuple

from ..beside import workers
from ..timing import least, many_calls
from .examples import four_bar, four_bar_model
from .ways import kept, lambdified

TURNS, TOLERANCE = 10, 1e-10


class Speed(NamedTuple):
    """Processor time: microseconds of a right-hand side, and seconds from a model to its first result.

    `compiled` is the time of a run without projection, divided by its calls; `lambdified` is that of the right-hand
    side as users write it, with lambdify(cse=True) and numpy.linalg.solve. `first` is the time from a SymPy model whose
    equations are derived to the last state of a run, in a new process.
    """

    compiled: float
    lambdified: float
    first: float


def speed() -> Speed:
    """Measure the three times of `Speed`, and return them."""
    problem = four_bar()
    kept(problem, (), TOLERANCE)  # compiles
    state, plain = problem.y0, lambdified(problem, 0.0)

    def compiled() -> float:
        began = time.process_time()
        calls = kept(problem, (), TOLERANCE).nfev
        return (time.process_time() - began) / calls

    times = least({"compiled": compiled, "lambdified": many_calls(lambda: plain(0.0, state))}, turns=TURNS)
    with workers(1) as start:
        first = start(first_result)()
    return Speed(1e6 * times["compiled"], 1e6 * times["lambdified"], first)


def first_result() -> float:
    """Return the processor time in seconds from a SymPy model whose equations are derived to the first result.

    Call this function in a new process, in which nothing was compiled or imported before.
    """
    four_bar_model()
    began = time.process_time()
    problem = four_bar()
    run = kept(problem, problem.invariants, 1e-8)
    assert run.success
    return time.process_time() - began
