"""Choice of the C++ compiler of a build: one that is installed, or else the clang in the package ziglang."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

from .targets import target

__all__ = ["Compiler", "chosen", "required"]

# Names the command of a compiler, or "zig", in place of the one that is found.
VARIABLE = "EIP_SCIPY_COMPILER"
ZIG = "zig"
PACKAGE = "ziglang>=0.17"
# g++ 12 and clang 15 compile this, older ones do not.
PROBE = """\
#include <bit>
typedef double Four __attribute__((vector_size(32)));
Four turned(Four x) { return __builtin_shufflevector(x, x, 1, 0, 3, 2); }
static_assert(std::bit_ceil(5u) == 8);
"""


class Compiler(NamedTuple):
    """The command that compiles the engine, and its flags.

    Attributes
    ----------
    command : tuple of str
    own : bool
        True if setuptools calls this command anyway, with the flags that Python was built with.
    every : tuple of str
        Flags for code that has to run on all processors of the target's kind.
    v3 : tuple of str
        Flags for x86-64 processors with AVX2 and FMA.
    """

    command: tuple[str, ...]
    own: bool = False
    every: tuple[str, ...] = ()
    v3: tuple[str, ...] = ("-march=x86-64-v3",)

    @property
    def executables(self) -> dict[str, list[str]]:
        """Return compiling and linking commands by the names under which setuptools stores them; empty if `own`."""
        if self.own:
            return {}
        system = target().system
        common = ["-DNDEBUG", "-fwrapv", *(() if system == "win32" else ("-fPIC",))]
        shared = ["-shared", "-Wl,-s", *(("-undefined", "dynamic_lookup") if system == "darwin" else ())]
        compiling = [*self.command, *common, *shlex.split(os.environ.get("CXXFLAGS", ""))]
        linking = [*self.command, *shared, *shlex.split(os.environ.get("LDFLAGS", ""))]
        return {
            "compiler_cxx": [*self.command],
            "linker_exe": [*self.command],
            "linker_exe_cxx": [*self.command],
            "compiler_so": compiling,
            "compiler_so_cxx": compiling,
            "linker_so": linking,
            "linker_so_cxx": linking,
        }


@cache
def chosen() -> Compiler:
    """Return the compiler of this build: the command in EIP_SCIPY_COMPILER, else an installed one, else zig."""
    given, triple = os.environ.get(VARIABLE, ""), target().triple
    if given and given != ZIG:
        return Compiler(tuple(shlex.split(given)))
    # Microsoft's compiler does not know the vectors that g++ and clang have in common.
    if given != ZIG and not triple and target().system != "win32":
        usual = os.environ.get("CXX") or sysconfig.get_config_var("CXX")
        for command in (usual, "g++", "clang++", "c++"):
            if command and _compiles(tuple(shlex.split(command))):
                return Compiler(tuple(shlex.split(command)), own=command == usual)
    # Without these flags zig builds for the processor of this machine, and traps where an integer overflows.
    elsewhere = ("-target", triple) if triple else ()
    zig = (sys.executable, "-m", "ziglang", "c++", *elsewhere, "-fno-sanitize=undefined")
    return Compiler(zig, every=("-mcpu=baseline",), v3=("-mcpu=x86_64_v3",))


def required() -> list[str]:
    """Return the further packages that the build needs: ziglang if zig compiles the engine, otherwise none."""
    return [PACKAGE] if "ziglang" in chosen().command else []


def _compiles(command: tuple[str, ...]) -> bool:
    """Return whether a command compiles C++20 and the vector extensions that g++ 12 and clang 15 have in common."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "probe.cpp")
        source.write_text(PROBE)
        call = [*command, "-std=c++20", "-c", str(source), "-o", str(source.with_suffix(".o"))]
        try:
            return subprocess.run(call, capture_output=True, check=False).returncode == 0
        except OSError:
            return False
