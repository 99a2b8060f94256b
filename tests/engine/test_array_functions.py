"""The engine's functions of whole arrays give the same bits in both builds."""

from importlib import import_module

import numpy as np
import pytest

from eip_scipy.engine.native import BUILD

CALLS = {  # z: complex and written, w: complex, V: real, n: real and written
    "condensates.derivative": ("w", "w", "V", 0.7, "z"),
    "condensates.derivative_at_once": ("w", "V", 0.7, "z"),
    "condensates.expansion": ("w", "w", "w"),
    "condensates.moments": ("w", "w"),
    "condensates.multiply": ("z", "V"),
    "condensates.shifted": ("w", "w", 0.1, 0.2, "z"),
    "condensates.total_mass": ("w",),
    "condensates.turn": ("w", 0.3, "z"),
    "condensates.weighted_square": ("w", "V"),
}


def functions(build):
    return {f"condensates.{name}": value for name, value in vars(build.condensates).items() if callable(value)}


def arguments(kinds, n):
    rng = np.random.default_rng(11)
    made = {"z": lambda: rng.standard_normal(2 * n).view(complex), "n": lambda: rng.standard_normal(n)}
    return [made["z" if kind in "zw" else "n"]() if isinstance(kind, str) else kind for kind in kinds]


def test_every_function_is_listed_here():
    names = {name for name, value in functions(BUILD).items() if not name.rpartition(".")[2].startswith("__")}
    assert names == set(CALLS)


@pytest.mark.skipif(not BUILD.HAS_V3, reason="needs a processor with AVX2 and FMA")
@pytest.mark.parametrize("name", CALLS)
def test_both_builds_give_the_same_bits(name):
    for n in (1, 7, 64, 1027):
        found = []
        for build in ("_native", "_native_v3"):
            given = arguments(CALLS[name], n)
            value = functions(import_module(f"eip_scipy.engine.{build}"))[name](*given)
            found.append([() if value is None else value, *given])
        for plain, fast in zip(*found, strict=True):
            np.testing.assert_array_equal(plain, fast)
