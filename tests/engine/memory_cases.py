"""Calls of the engine in which test_failing_memory.py lets each allocation of C++ fail, one after the other.

As a script it takes the preloaded library and that of the C functions, and prints in JSON what each case has raised
for each of its allocations.
"""

import ctypes
import json
import sys

import numpy as np
from scipy import LowLevelCallable

from eip_scipy import EIPGJ12, EIPRK4, EIPRK45, EIPRKN12, Invariant, ensemble, integrate
from eip_scipy.core.functions import jitted_call
from eip_scipy.engine.native import BUILD, library
from eip_scipy.problems import ForceConstants, kepler, nbody

Y0 = [1.6, 0.0, 0.0, 0.5]
DOUBLES = ctypes.POINTER(ctypes.c_double)


def functions_of(path):
    """The C functions that the cases use."""
    c = ctypes.CDLL(path)
    found = {name: c[name] for name in ("kepler", "energy", "energy_gradient", "turn", "decay", "momentum")}
    for name, function in found.items():
        function.argtypes = [ctypes.c_double, *[DOUBLES] * (4 if name.endswith("gradient") else 3)]
    return {name: LowLevelCallable(function) for name, function in found.items()}


def cases(c):
    """Names, functions that return arrays, and whether the engine runs them without the GIL."""
    kept = [Invariant(c["energy"], c["energy_gradient"], uses_f=True), Invariant(c["momentum"])]
    problem = kepler(0.6)
    square = Invariant(lambda t, y: y[0] ** 2 + y[1] ** 2)
    places, speeds = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    bodies = nbody([1.0, 1e-3], places, speeds, t_span=(0, 1), forces="eih", h=0.1, constants=ForceConstants(c=100.0))

    def pointers(**options):
        run = integrate(c["kepler"], (0, 2), Y0, params=[1.0], invariants=kept, **options)
        return np.concatenate([run.y.ravel(), *(run.t_events or [])])

    def turning(t, y):
        return [y[1], -y[0]]

    compiled, fixed = jitted_call(library["eih.momentum"]), {"method": EIPRK4, "h": 0.1}
    return {
        "pointers, fixed": (lambda: pointers(method=EIPRK4, h=0.02), True),
        "pointers, events": (lambda: pointers(method=EIPRK45, rtol=1e-8, events=c["turn"]), True),
        "pointers, status 1": (
            lambda: integrate(c["decay"], (0, 1), [1.0], method=EIPRK45, params=[0.0], first_step=0.5).y, True,
        ),
        "Python": (lambda: integrate(turning, (0, 1), [1.0, 0.0], method=EIPRK45, invariants=square).y, False),
        "Python, samples": (
            lambda: integrate(turning, (0, 1), [1.0, 0.0], t_eval=[0.15, 0.3], invariants=square, **fixed).y, False,
        ),
        "multistep": (lambda: integrate(problem, (0, 2), method=EIPGJ12, h=0.005, t_eval=[0.301, 0.7017]).y, True),
        "Nystrom": (lambda: integrate(problem, (0, 2), method=EIPRKN12, h=0.05, t_eval=[0.301, 0.7017]).y, True),
        "eih": (lambda: integrate(bodies, method=EIPRK4).y, True),
        "batches": (lambda: ensemble(problem, (0, 1), np.tile(problem.y0, (16, 1)), method=EIPRK4, h=0.05).y, True),
        "library": (lambda: np.atleast_1d(library["eih.momentum"](0.0, bodies.y0, bodies.params)), False),
        "compiled": (lambda: compiled(0.0, bodies.y0, bodies.params), True),
        "stepped by hand": (lambda: stepped(turning, square), False),
        "complex step": (
            lambda: BUILD.gradients.complex_step(lambda t, y: y @ y, 0.0, np.array([1.0, 2.0]), (), 1e-20), False,
        ),
    }  # fmt: skip


def stepped(fun, kept):
    """Every state of a solver of `solve_ivp`; a step that fails for want of memory is made again."""
    solver, found, failed = EIPRK45(fun, 0.0, [1.0, 0.0], 2.0, invariants=kept), [], None
    while solver.status == "running":
        try:
            solver.step()
            found.append(solver.y)
        except MemoryError as error:
            failed = error
    if failed is not None:
        np.testing.assert_array_equal(found, stepped(fun, kept))
        raise failed
    return np.array(found)


def failures(arm, call):
    """Return what `call` raises for each allocation that fails; its value stays the same, as every fifth time shows."""
    for _ in range(3):  # tables that grow in the first calls allocate nothing afterwards
        arm(0)
        expected = call()
    found, count = [], arm(0)
    for n in range(1, count + 1):
        arm(n)
        try:
            call()
            found.append("nothing")
        except Exception as error:
            found.append(type(error).__name__)
        arm(0)
        if n % 5 == 0 or n == count:
            np.testing.assert_array_equal(call(), expected)
    return found


def main(preloaded, functions):
    arm = ctypes.CDLL(preloaded).arm
    arm.argtypes, arm.restype = [ctypes.c_long], ctypes.c_long
    found = {}
    for name, (call, released) in cases(functions_of(functions)).items():
        found[name] = released, failures(arm, call)
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
