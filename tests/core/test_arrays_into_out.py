"""New arrays that jitted functions return become the array of the step: with equal bits, or not at all."""

import linecache

import numpy as np
import pytest

from eip_scipy import EIPRK4, Invariant, integrate

numba = pytest.importorskip("numba")
from eip_scipy.core.arrays_into_out import into_out  # noqa: E402 # loads Numba

pytestmark = pytest.mark.needs_jit
NAMES = {"np": np, "numba": numba, "array": np.array, "zeros": np.zeros, "math": __import__("math")}
Y = np.array([0.3, -0.7, 1.1, 0.4])


def jitted(body, number, **options):
    """Return a jitted function of (t, y) of the lines of its body."""
    name = f"<function {number}>"
    text = "def fun(t, y):\n    " + body.replace("\n", "\n    ") + "\n"
    linecache.cache[name] = len(text), None, text.splitlines(True), name
    names = dict(NAMES)
    exec(compile(text, name, "exec"), names)
    return numba.njit(names["fun"], **options)


def called(fun):
    """Return what a function by `into_out` writes; None if it does not compile."""

    @numba.njit
    def call(t, y, out):
        into(t, y, out)

    into, out = None, np.full(4, np.nan)
    try:
        into = into_out(fun)
        call(0.5, Y, out)
    except numba.core.errors.NumbaError:
        return None
    return out


NEW = [
    "return np.array([{}, {}, {}, {}])",
    "return array(({}, {}, {}, {}))",
    "return np.array([{}, {}, {}, {}], dtype=np.float64)",
    "out = np.empty(4)\nout[0], out[1], out[2], out[3] = {}, {}, {}, {}\nreturn out",
    "out = np.empty_like(y)\nfor i in range(2):\n    out[i], out[2 + i] = {}, {}\nout[1] += {} - {}\nreturn out",
    "out = zeros(y.size, np.float64)\nout[:2] = {}\nout[2] = {}\nout[3] += {} + {}\nreturn out",
    "out = np.zeros_like(y)\nif {} > 0.1:\n    out[0] = {}\nelse:\n    out[3] = {}\nout[1] = {}\nreturn out",
    "if {} > 0.2:\n    return np.array([y[0], {}, 0.0, 1.0])\nreturn np.array([{}, y[3], 2.0, {}])",
    "out = np.zeros((4,))\nfor i in range(0, 4, 3):\n    out[i] = i * {} - {}\nout[2] = {} + {}\nreturn out",
    "scale = lambda a: 2 * a\nout = np.zeros(4)\nout[0] = scale({})\nout[1] = {} + {}\nout[3] = scale({})\nreturn out",
    "most = max([abs(a) for a in y])\nout = np.empty(4)\nout[:] = most\nout[1] = {} + {}\nout[2] -= {}\nreturn out",
]
STAYS = [
    "return y * {} + {} + {} * {}",
    "a, b = np.empty(4), np.empty(4)\na[:] = {}\nb[:] = {}\nreturn a if {} > {} else b",
    "out = np.empty(4)\nout[:] = {}\nout = out * {}\nreturn out + {} * {}",
    "out = np.empty(6)\nout[:] = {} + {} * {} - {}\nreturn out[1:5]",
    "for k in range(3):\n    out = np.empty(4)\n    out[:] = {}\n    if k > 1:\n        return out\n"
    "return np.array([{}, {}, {}])",
    "out = np.empty(4, np.complex128)\nout[:] = {} + {} * {} - {}\nreturn out",
    "if {} > {}:\n    return y\nreturn np.array([{}, {}, 1.0, 2.0])",
    "for k in range(3):\n    out = np.empty(4)\n    out[:] = {}\n    if k > 1:\n        return out\nreturn y * {}",
    "keep = np.array([{}, {}, {}, {}])\nother = keep\nkeep = np.zeros(4)\nreturn other if t < 0 else keep",
]
TERMS = ["y[0]", "y[1] * y[2]", "y[3] - t", "math.sin(y[1])", "y[2] ** 2"]
TERMS += ["1.0 / (1.0 + y[0] ** 2)", "-y[3]", "np.exp(y[1])"]


def terms(rng):
    """Return four sums of two terms."""
    return [f"({' + '.join(rng.choice(TERMS, 2))})" for _ in range(4)]


def check(number):
    rng = np.random.default_rng(number)
    kinds = NEW + STAYS
    kind = kinds[number % len(kinds)]
    options = {"error_model": str(rng.choice(["python", "numpy"])), "fastmath": bool(rng.integers(2))}
    fun = jitted(kind.format(*terms(rng)), number, **options)
    found = called(fun)
    assert (found is None) == (kind in STAYS)
    if found is not None:
        np.testing.assert_array_equal(found, fun(0.5, Y))


@pytest.mark.parametrize("number", range(len(NEW + STAYS)))
def test_generated_functions(number):
    check(number)


def test_sizes_errors_and_caches(tmp_path):
    assert called(jitted("return np.array([1.0, 2.0, 3.0, 4])", -1)).tolist() == [1.0, 2.0, 3.0, 4.0]
    with pytest.raises(ValueError, match="an array of another size"):
        called(jitted("return np.empty(5)", -2))
    default = numba.njit(lambda t, y, k=2.0: np.array([k, k, k, k]))
    assert called(default) is None
    fun = jitted("if t > 0.3:\n    raise ArithmeticError('late')\nreturn np.array([y[1], -y[0]])", -3)
    with pytest.raises(ArithmeticError, match="late"):
        integrate(fun, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.01)
    grows = jitted("return np.zeros(2) if t < 0.3 else np.zeros(3)", -4)
    with pytest.raises(ValueError, match="returned an array of another shape than at the start"):
        integrate(grows, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.01)


def test_runs_have_the_bits_of_functions_that_stay(monkeypatch):
    fun = jitted("return np.array([y[1], -math.sin(y[0])])", -5)
    slope = jitted("out = np.empty(2)\nout[0], out[1] = math.sin(y[0]), y[1]\nreturn out", -6)
    value = jitted("return y[1] ** 2 / 2 - math.cos(y[0])", -7)
    options = {"method": EIPRK4, "h": 0.01, "invariants": Invariant(value, slope)}
    found = integrate(fun, (0, 5), [1.0, 0.3], **options)
    monkeypatch.setattr("eip_scipy.core.arrays_into_out.LONGEST", -1.0)  # every function stays as it is
    others = [numba.njit(item.py_func) for item in (fun, value, slope)]
    options["invariants"] = Invariant(*others[1:])
    expected = integrate(others[0], (0, 5), [1.0, 0.3], **options)
    assert found.compiled
    assert expected.compiled
    np.testing.assert_array_equal(found.y, expected.y)
