"""C functions as LowLevelCallable: the bits of Python and Numba, their statuses, refused functions."""

import ctypes
import gc
import math
import pickle
from functools import partial
from pathlib import Path

import cffi
import numpy as np
import pytest
from c_compiler import shared_library
from numba import cfunc, njit
from scipy import LowLevelCallable
from systems import refuse, same

from eip_scipy import EIPRK4, EIPRK45, Invariant, ensemble, integrate
from eip_scipy.problems import Problem

HERE = Path(__file__).parent
KEPLER = HERE.parents[1] / "examples" / "c-functions" / "kepler.c"
NUMBERS = ctypes.POINTER(ctypes.c_double)
VALUE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, NUMBERS, NUMBERS, NUMBERS)
Y0, MU = np.array([1.6, 0.0, 0.0, 0.5]), [1.0]
GRADIENT = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, *[NUMBERS] * 4)


def circle(t, y, out, params):
    out[0], out[1] = y[1], -y[0]
    return 0


def square(t, y, value, params):
    value[0] = y[0] * y[0] + y[1] * y[1]
    return 0


def twice(t, y, f, out, params):
    out[0], out[1] = 2 * y[0], 2 * y[1]
    return 0


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Return the name of the C functions' library."""
    return str(shared_library(tmp_path_factory.mktemp("pointers") / "functions.so", HERE / "pointers.c", KEPLER))


@pytest.fixture(scope="module")
def c(library):
    """Return the C functions as LowLevelCallable, by ctypes; gradients are known by their names."""
    found = ctypes.CDLL(library)

    class Functions:
        def __getattr__(self, name):
            function = found[name]  # a new one each time, without attributes of another test
            arrays = 4 if name.endswith("gradient") else 3
            function.argtypes = [ctypes.c_double, *[NUMBERS] * arrays]
            return LowLevelCallable(function)

    return Functions()


def value(function):
    return LowLevelCallable(VALUE(function))


def gradient(function):
    return LowLevelCallable(GRADIENT(function))


def orbit(t, y, p):
    r2 = y[0] * y[0] + y[1] * y[1]
    r3 = r2 * math.sqrt(r2)
    return np.array([y[2], y[3], -p[0] * y[0] / r3, -p[0] * y[1] / r3])


def energy(t, y, p):
    return 0.5 * (y[2] * y[2] + y[3] * y[3]) - p[0] / math.sqrt(y[0] * y[0] + y[1] * y[1])


def energy_gradient(t, y, f, p):
    return np.array([-f[2], -f[3], y[2], y[3]])


def momentum(t, y, p):
    return y[0] * y[3] - y[1] * y[2]


def momentum_gradient(t, y, p):
    return np.array([y[3], -y[2], -y[1], y[0]])


def turn(t, y, p):
    return y[0] * y[2] + y[1] * y[3]


def kepler_s(fun, H, dH, L, dL, event):
    """Return arguments of `integrate`: Kepler's problem by these functions."""
    invariants = [Invariant(H, dH, name="H", uses_f=True), Invariant(L, dL, name="L")]
    return {"fun": fun, "t_span": (0, 30), "y0": Y0, "params": MU, "invariants": invariants, "events": event}


IN_PYTHON = orbit, energy, energy_gradient, momentum, momentum_gradient, turn


def in_c(c):
    return c.kepler, c.energy, c.energy_gradient, c.momentum, c.momentum_gradient, c.turn


BOTH = [{"h": 0.05, "save_every": 7}, {"rtol": 1e-8, "atol": 1e-8, "t_eval": np.linspace(0, 30, 41), "method": EIPRK45}]
both = pytest.mark.parametrize("options", BOTH, ids=["fixed", "adaptive"])


@pytest.mark.slow
@pytest.mark.needs_jit
@both
def test_the_bits_are_those_of_python_and_of_numba(c, options):
    options = {"method": EIPRK4} | options
    jitted = [njit(function) for function in IN_PYTHON]
    runs = [integrate(**kepler_s(*functions), **options) for functions in (IN_PYTHON, jitted, in_c(c))]
    runs.append(integrate(**kepler_s(*in_c(c)), **options, compiled=False))
    same(*runs)
    _, H, _, _, dL, _ = in_c(c)
    mixed = njit(orbit), H, njit(energy_gradient), njit(momentum), dL, njit(turn)
    runs.append(integrate(**kepler_s(*mixed), **options))
    assert list(runs[4].calls.values()) == ["jitted", "pointer", "jitted", "jitted", "pointer", "jitted"]
    same(runs[0], runs[4])
    kinds = [set(run.calls.values()) for run in runs[:4]]
    assert kinds == [{"python"}, {"jitted"}, {"pointer"}, {"python"}]
    assert [run.compiled for run in runs] == [False, True, True, False, True]
    assert list(runs[2].calls) == ["fun", "H", "gradient of H", "L", "gradient of L", "event 0"]
    assert runs[2].t_events[0].size > 5


@both
def test_invariants_of_several_values(c, options):
    """The invariants come from one C function, with two rows of gradients, or from two."""
    options = {"method": EIPRK4} | options
    together = [Invariant(c.kept, c.kept_gradient, size=2, name="HL")]
    one = integrate(c.kepler, (0, 30), Y0, params=MU, invariants=together, **options)
    same(one, integrate(c.kepler, (0, 30), Y0, params=MU, invariants=together, compiled=False, **options))
    apart = integrate(**kepler_s(*in_c(c)) | {"events": None}, **options)
    np.testing.assert_allclose(one.y, apart.y, rtol=1e-7)
    assert one.compiled
    assert one.diagnostics.names == ("HL[0]", "HL[1]")
    assert one.max_residual.max() < 1e-10


def test_all_kinds_of_pointers(c, library):
    options = {"method": EIPRK4, "h": 0.05, "params": MU}
    ffi = cffi.FFI()
    ffi.cdef("int kepler(double, const double *, double *, const double *);")
    opened = ffi.dlopen(library)
    spaced = LowLevelCallable(opened.kepler, signature="int(double,const double*, double  *,double const *)")
    address = ctypes.cast(c.kepler.function, ctypes.c_void_p).value
    kinds = [c.kepler, spaced, LowLevelCallable(opened.kepler), LowLevelCallable(VALUE(address))]
    runs = [integrate(fun, (0, 5), Y0, **options) for fun in kinds]
    same(*runs)
    assert all(run.calls == {"fun": "pointer"} for run in runs)
    same(runs[0], integrate(c.kepler, (0, 5), Y0, in_place=True, **options))
    brought = Problem("two bodies", orbit, Y0, (0, 5), rhs=c.kepler, params=np.array(MU), h=0.05)
    same(runs[0], integrate(brought, method=EIPRK4))


def test_the_run_holds_the_only_reference():
    """The user's references to the function are gone with its ctypes object, or with that of cffi."""
    ffi = cffi.FFI()
    made = {
        "ctypes": lambda: value(circle),
        "cffi": lambda: LowLevelCallable(ffi.callback("int(double, double *, double *, double *)")(circle)),
    }
    plain = integrate(lambda t, y: np.array([y[1], -y[0]]), (0, 2), [1, 2], method=EIPRK4, h=0.1, save_every=1)
    for fun in made.values():
        kept = Invariant(value(square), gradient(twice))
        gc.collect()
        events = [value(square)]
        run = integrate(fun(), (0, 2), [1, 2], method=EIPRK4, h=0.1, save_every=1, invariants=kept, events=events)
        np.testing.assert_allclose(run.y, plain.y, atol=1e-5)
        assert run.compiled
        assert run.max_residual[0] < 1e-14


NAMES = ["fun", "invariant 'S'", "gradient of invariant 'S'", "event 0"]
which = pytest.mark.parametrize("k", range(4), ids=["fun", "value", "gradient", "event"])
native_or_not = pytest.mark.parametrize("compiled", [True, False], ids=["native", "called from Python"])


def ending(c, k, status, **options):
    """Return the oscillator to t = 3, the k-th of its functions with a status after t = 1 (99: it fills nothing)."""
    params = np.zeros(5)
    params[[0, 1 + k]] = 1.0, status
    kept = Invariant(c.ending_square, c.ending_gradient, name="S")
    options = {"method": EIPRK4, "h": 0.1, "save_every": 1, "events": c.ending_event, "params": params} | options
    return integrate(c.ending, (0, 3), [1, 2], invariants=kept, **options)


@native_or_not
@which
def test_a_negative_status_ends_the_run(c, k, compiled):
    with pytest.raises(RuntimeError) as caught:
        ending(c, k, -7, compiled=compiled)
    told = str(caught.value)
    assert told.startswith(f"{NAMES[k]} returned the status -7 at t=1.")
    partial = caught.value.partial
    assert 0.9 < partial.t[-1] < 1.2
    assert partial.status == -1
    whole = ending(c, k, 0)
    np.testing.assert_array_equal(partial.y, whole.y[:, : partial.t.size])
    params = [-1.0, *np.where(np.arange(4) == k, -3.0, 0.0)]  # from the start on
    with pytest.raises(RuntimeError, match=f"{NAMES[k]} returned the status -3 at t=0") as caught:
        ending(c, k, 0, compiled=compiled, params=params)
    assert caught.value.partial.t.tolist() == [0.0]


@native_or_not
@which
def test_no_value(c, k, compiled):
    """At fixed steps a step without values is the last one; an event without a value has no sign."""
    for status in (1, 99):  # no value, and nothing filled
        run = ending(c, k, status, compiled=compiled)
        if k == 3:
            assert run.status == 0
            assert (run.t_events[0] < 1.2).all()
            continue
        assert run.status == -1
        assert 0.9 < run.t[-1] < 1.2
        assert np.isfinite(run.y).all()
        assert "t=1" in run.message
        assert ("if its status is above 0" in run.message) == (k == 0)


@native_or_not
def test_a_negative_status_between_the_steps(compiled):
    """The function is called when dense output is evaluated, after the run."""
    status = 0
    kept = Invariant(value(lambda *given: square(*given) or status), gradient(twice), name="S")
    options = {"method": EIPRK4, "h": 0.1, "dense_output": True, "compiled": compiled}
    run = integrate(value(circle), (0, 1), [1, 2], invariants=kept, **options)
    assert run.compiled == compiled
    assert np.isfinite(run.sol(0.55)).all()
    status = -2
    with pytest.raises(RuntimeError, match=r"^invariant 'S' returned the status -2 at t=0\.[67]"):
        run.sol(0.65)


@native_or_not
def test_a_shorter_step_may_have_a_value(c, compiled):
    options = {"method": EIPRK45, "rtol": 1e-6, "first_step": 1.0, "compiled": compiled, "save_every": 1}
    run = integrate(c.decay, (0, 1), [1.0], **options)
    assert run.success
    assert run.t[1] < 0.1
    np.testing.assert_allclose(run.y[0], np.exp(-50 * run.t), atol=1e-5)
    same(run, integrate(c.decay, (0, 1), [1.0], **options | {"compiled": not compiled}))


@cfunc("intc(f8, CPointer(f8), CPointer(f8), CPointer(f8))")
def decay(t, y, out, params):
    out[0] = -y[0]
    return 0


def test_refused_functions(c):
    arrays = [NUMBERS] * 3
    double = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double, *arrays)(lambda *arguments: 0.0)
    anything = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, *[ctypes.c_void_p] * 3)(lambda *a: 0)
    plain = c.kepler.function
    ffi = cffi.FFI()
    refused = [
        (plain, r"is a bare C function, .*; wrap it: scipy\.LowLevelCallable\(pointer\)"),
        (ctypes.CDLL(None).sin, "is a bare C function"),
        (ffi.callback("int(double, double *)")(lambda *a: 0), "is a bare C function"),
        (decay, r"is a bare C function, .*decay'>; wrap it: scipy\.LowLevelCallable\(decay\.ctypes\)"),
        (LowLevelCallable(double), r"'double \(double, double \*, double \*, double \*\)', expected int \("),
        (LowLevelCallable(anything), r"'int \(double, void \*, void \*, void \*\)'"),
        (c.kept_gradient, r"'int \(double, double \*, double \*, double \*, double \*\)'"),
        (LowLevelCallable(plain, signature="int (double)"), r"'int \(double\)'"),
        (LowLevelCallable(plain, ctypes.c_void_p(1)), "LowLevelCallable with user_data"),
        (ctypes.cast(plain, ctypes.c_void_p).value, "must be callable"),
    ]
    for fun, reason in refused:
        with pytest.raises(TypeError, match=reason):
            integrate(fun, (0, 1), Y0, method=EIPRK4, h=0.1, params=MU)
        for wrap in (lambda f: Invariant(f, c.kept_gradient), lambda f: Invariant(c.kept, c.kept, name="H")):
            with pytest.raises(TypeError):
                wrap(fun)
        with pytest.raises(TypeError, match="event"):
            integrate(c.kepler, (0, 1), Y0, method=EIPRK4, h=0.1, params=MU, events=[fun])


def test_invariants_say_their_size(c):
    sized = partial(Invariant, c.kept, c.kept_gradient)
    refuse(sized, [({"size": size}, ValueError, "size") for size in (0, 1.5, "2")])
    wrong = Invariant(lambda t, y: y[:2], lambda t, y: np.eye(2), size=3, name="I")
    with pytest.raises(ValueError, match="invariant 'I' returned 2 values, but has size=3"):
        integrate(lambda t, y: np.zeros(2), (0, 1), [1, 2], method=EIPRK4, h=0.1, invariants=wrong)


def test_they_do_not_pickle(c):
    kept = Invariant(c.energy, energy_gradient, name="H", uses_f=True)
    with pytest.raises(TypeError, match=r"invariant 'H' is a C function by pointer, which cannot be pickled.*Dask"):
        pickle.dumps(kept)


nearest = partial(turn)
nearest.direction, nearest.terminal = 1, 3


class Nearest(LowLevelCallable):
    direction, terminal = 1, 3


def test_events_carry_their_attributes(c):
    """The attributes are those of a subclass, or of the function of ctypes."""
    turn_of_ctypes = c.turn
    turn_of_ctypes.function.direction, turn_of_ctypes.function.terminal = 1, 3
    ends = []
    for event in (turn_of_ctypes, Nearest(c.turn.function), nearest, [nearest, c.turn], [c.turn, nearest]):
        for compiled in (None, False):
            run = integrate(
                c.kepler, (0, np.inf), Y0, method=EIPRK4, h=0.05, params=MU, events=event, compiled=compiled
            )
            assert run.status == 1
            ends.append((run.t[-1], *run.y[:, -1]))
    assert len(set(ends)) == 1


@pytest.mark.needs_jit  # else the JIT is to blame
@both
@pytest.mark.parametrize("alone", [True, False], ids=["alone", "next to one in C"])
def test_events_in_python_beside_native_functions(c, options, alone):
    options = {"method": EIPRK4, "dense_output": True} | options
    events = [turn] if alone else [c.turn, turn]
    given = kepler_s(*in_c(c)) | {"events": events}
    run, other = integrate(**given, **options), integrate(**given, **options, compiled=False)
    same(run, other)
    np.testing.assert_array_equal(run.sol(np.linspace(0, 30, 77)), other.sol(np.linspace(0, 30, 77)))
    assert not run.compiled
    assert "(events are called from Python: event " in run.message
    assert "interpreted" not in run.message
    kinds = dict(run.calls)
    assert [kinds.pop(f"event {k}") for k in range(len(events))] == ["python"] * len(events)
    assert set(kinds.values()) == {"pointer"}
    with pytest.raises(TypeError, match="is not a Numba function"):
        integrate(**given, **options, compiled=True)


def test_members_are_single_runs(c):
    starts = Y0 * np.linspace(0.9, 1.1, 5)[:, None]
    masses = np.linspace(0.9, 1.1, 5)[:, None]
    invariants = kepler_s(*in_c(c))["invariants"]
    event = c.turn
    event.function.terminal = 2
    options = {"method": EIPRK45, "h": 0.05, "invariants": invariants, "events": event}
    run = ensemble(c.kepler, (0, 10), starts, params=masses, executor=2, **options)
    for k in range(5):
        alone = integrate(c.kepler, (0, 10), starts[k], params=masses[k], **options)
        np.testing.assert_array_equal(run.y[k], alone.y[:, -1])
        assert (run.status[k], run.t[k], run.nfev[k]) == (1, alone.t_events[0][-1], alone.nfev)
    assert not any("interpreted" in message for message in run.message)
    assert run.one_by_one == "events may end members at different times"
    plain = ensemble(c.kepler, (0, 1), starts, params=masses, h=0.05)
    assert plain.one_by_one == "fun is a C function, which is called for one member at a time"
    with pytest.raises(TypeError, match="fun is a C function by pointer, which cannot be pickled"):
        ensemble(c.kepler, (0, 10), starts, params=masses, executor="dask", **options)
