"""The engine's binding: refused arguments, and the same bits from both of its builds."""

import gc
import os
import platform
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
from systems import SPIN_NORM, SPIN_START, H, orbit, pericentre, spin

from eip_scipy import EIPDOP853, EIPRK4, EIPRKN12
from eip_scipy.core.dense import Interpolants
from eip_scipy.engine import native
from eip_scipy.engine.native import BUILD, Engine
from eip_scipy.run.prepare import RunArguments, prepared

Y0 = pericentre(0.6)


def parts(method=EIPRK4, **options):
    """Return arguments of an engine that is ready to step."""
    fun, y0 = orbit, Y0
    if options.pop("dtype", None):
        fun, y0 = spin, SPIN_START
    ready = prepared(RunArguments.of(fun=fun, t_span=(0, 1), y0=y0, method=method, compiled=False, **options))
    functions, _ = ready.problem.functions(ready, False)
    given = {name: getattr(ready, name) for name in ("options", "work", "schedule")}
    return given | {"method": ready.stepper, "functions": functions}


def arrays(record, path=()):
    """Yield paths of all arrays in records of records."""
    for name, value in record._asdict().items():
        if isinstance(value, np.ndarray):
            yield (*path, name)
        elif hasattr(value, "_asdict") and name != "owner":
            yield from arrays(value, (*path, name))


def replaced(record, path, value):
    """Return the record with another array at that path."""
    name, *rest = path
    return record._replace(**{name: replaced(getattr(record, name), rest, value) if rest else value})


def spoilt(a):
    """Yield arrays that are not accepted."""
    yield a.tolist()
    yield None
    yield a.astype(np.float32 if a.dtype.kind == "f" else np.complex64 if a.dtype.kind == "c" else np.int32)
    yield a.astype(a.dtype.newbyteorder())
    yield np.zeros((*a.shape, 1), a.dtype)
    yield np.zeros(tuple(2 * n + 3 for n in a.shape), a.dtype)[tuple(slice(None, None, 2) for _ in a.shape)]
    if len(a) > 1 and a.size:
        yield np.zeros_like(a)[::-1]
    if a.size:
        still = a.copy()
        still.flags.writeable = False
        yield still
        odd = np.frombuffer(bytearray(a.nbytes + 1), np.uint8, a.nbytes, 1)
        yield odd.view(a.dtype).reshape(a.shape) if a.flags.c_contiguous else None


CASES = {
    "kepler": {"h": 0.1, "invariants": H, "blocks": [[0, 1]], "linear_invariants": (np.eye(4)[2:], np.eye(4)[:, 2:])},
    "nystrom": {"h": 0.1, "invariants": H, "method": EIPRKN12},
    "adaptive": {"rtol": 1e-3, "invariants": H, "method": EIPDOP853},
    "complex": {"h": 0.1, "dtype": complex, "invariants": SPIN_NORM},
}


@pytest.mark.parametrize("case", CASES)
def test_arrays_that_do_not_fit_are_refused(case):
    given = parts(**CASES[case])
    engine, refused = Engine(**given), 0
    records = [(given[part], part) for part in ("method", "options", "schedule")]
    if case in ("kepler", "adaptive"):
        ready = prepared(RunArguments.of(fun=orbit, t_span=(0, 1), y0=Y0, **{"method": EIPRK4, **CASES[case]}))
        records += [(Interpolants(ready, engine).record, "dense output")]
    for record, part in records:
        for path in arrays(record):
            right = record
            for name in path:
                right = getattr(right, name)
            for wrong in spoilt(right):
                if path[-1] in ("t_eval", "e_low", "e", "e_v") and getattr(wrong, "ndim", 0) == 1:
                    continue  # may have other lengths
                changed = replaced(record, path, wrong)
                with pytest.raises((TypeError, ValueError), match="engine: "):
                    engine.sample(changed) if part == "dense output" else Engine(**given | {part: changed})
                refused += 1
    assert refused > (455 if len(records) > 3 else 240)


def test_a_run_is_not_stepped_from_its_own_functions():
    engines = []

    def fun(t, y):
        if engines:
            engines[0].step(0, 0.0, y, y)
        return orbit(t, y)

    given = parts(h=0.1, invariants=H)
    functions = given["functions"]
    engines.append(Engine(**given | {"functions": functions._replace(rhs=functions.rhs._replace(fun=fun))}))
    with pytest.raises(RuntimeError, match="own functions"):
        engines[0].step(0, 0.0, Y0, Y0)


def test_an_engine_and_what_it_holds_are_freed():
    class Fun:
        def __call__(self, t, y):
            return -y

    fun = Fun()
    given = parts(h=0.1, invariants=H)
    functions = given["functions"]
    fun.engine = Engine(**given | {"functions": functions._replace(rhs=functions.rhs._replace(fun=fun))})
    gone = weakref.ref(fun)
    del fun
    gc.collect()
    assert gone() is None


RUNS = """
    import hashlib
    import numpy as np
    from eip_scipy import *
    from eip_scipy.engine.native import BUILD
    from eip_scipy.problems import figure_eight, kepler
    seen = hashlib.sha256()
    problem, bodies = kepler(t_end=20.0), figure_eight()
    weights = np.array([1.0, 0.5, 0.2, 1.0])
    for options in (
        {"h": 0.05}, {"rtol": 1e-7, "method": EIPDOP853}, {"h": 0.05, "every": "auto", "compensated": True},
        {"h": 0.05, "metric": weights, "direction": "old", "iterations": 2}, {"h": 0.05, "method": EIPRKN12},
    ):
        given = {"method": EIPRK4, "compiled": False} | options
        fun = {"fun": problem.fun}
        if given["method"] is EIPRKN12:
            fun = {"acceleration": lambda t, q: -q / np.hypot(*q) ** 3}
        more = {"invariants": problem.invariants} if given["method"] is not EIPRKN12 else {}
        run = integrate(**fun, t_span=(0, 20), y0=problem.y0, **given, **more)
        seen.update(run.y.tobytes() + run.max_residual.tobytes())
    run = integrate(bodies, (0, 2.0), method=EIPRK4, compiled=False, h=0.01)
    seen.update(run.y.tobytes() + run.max_residual.tobytes())
    print(BUILD.__name__.rpartition(".")[2], seen.hexdigest())
"""


def test_the_builds_give_the_same_bits():
    def run(build):
        environment = os.environ | {native.VARIABLE: build}
        code = "\n".join(line.removeprefix("    ") for line in RUNS.splitlines())
        return subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code], env=environment, capture_output=True, text=True, check=True
        ).stdout.split()

    if native.BUILD.__name__.endswith("_native"):
        pytest.skip("the processor takes one build only")
    (plain, bits), (fast, same) = run("_native"), run("_native_v3")
    assert (plain, fast) == ("_native", "_native_v3")
    assert bits == same


@pytest.mark.skipif(
    platform.machine().lower() not in ("x86_64", "amd64") or not Path("/proc/cpuinfo").exists(),
    reason="needs an x86-64 processor, and a system that lists what it has",
)
def test_the_processor_is_asked_right():
    """The library behind a builtin of the compiler answered False in builds by zig."""
    words = set(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())
    assert ({"avx2", "bmi2", "fma", "xsave"} <= words) == BUILD.HAS_V3


def test_a_missing_or_an_old_build_is_told():
    with pytest.raises(ImportError, match="have changed since the engine was built"):
        native._require_current(type("Old", (), {"SOURCES": "0" * 64}))
    with pytest.raises(ImportError, match="not built for Python"):
        native._build("_native_v9")
