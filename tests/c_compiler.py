"""The C compiler for tests of C functions: the one that builds the package, or that of the package ziglang."""

import ctypes
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from importlib.util import find_spec

import pytest
from scipy import LowLevelCallable

FLAGS = ["-O2", "-ffp-contract=off", "-shared", "-fPIC"]


def compiler():
    """Return the words of its command, or skip the test if there is none."""
    command = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    if shutil.which(command[0]):
        return command
    if find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    pytest.skip(f"needs a C compiler, {command[0]} or ziglang: python -m pip install ziglang")


def shared_library(path, *sources):
    """The library of C sources at `path`."""
    subprocess.run([*compiler(), *FLAGS, "-o", str(path), *map(str, sources), "-lm"], check=True)
    return path


def low_level(library, name, arrays=3):
    """Return the function `name` of a library (a path) that takes a double and pointers to arrays of doubles."""
    function = ctypes.CDLL(str(library))[name]
    function.argtypes = [ctypes.c_double, *[ctypes.POINTER(ctypes.c_double)] * arrays]
    return LowLevelCallable(function)
