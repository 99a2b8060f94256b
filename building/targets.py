"""Choice of the platform that the engine is built for: this machine, or another one for which zig compiles."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path
from typing import NamedTuple

__all__ = ["PLATFORMS", "Target", "target"]

# The tag of the wheel to build, such as cp312-abi3-win_amd64.
VARIABLE = "EIP_SCIPY_TARGET"
# The folder with the headers that this wheel needs; building/wheels.py makes it.
HEADERS = "EIP_SCIPY_HEADERS"


class Platform(NamedTuple):
    """Names of a kind of machine: its `sys.platform`, its processor, and its target triple for zig."""

    system: str
    machine: str
    triple: str


# The oldest systems are part of the names: glibc 2.28 of 2018, macOS 12 of 2021.
PLATFORMS = {
    "manylinux_2_28_x86_64": Platform("linux", "x86_64", "x86_64-linux-gnu.2.28"),
    "manylinux_2_28_aarch64": Platform("linux", "aarch64", "aarch64-linux-gnu.2.28"),
    "macosx_12_0_x86_64": Platform("darwin", "x86_64", "x86_64-macos.12.0"),
    "macosx_12_0_arm64": Platform("darwin", "arm64", "aarch64-macos.12.0"),
    "win_amd64": Platform("win32", "x86_64", "x86_64-windows-gnu"),
}


class Target(NamedTuple):
    """Platform of a build.

    Attributes
    ----------
    system : str
        As in `sys.platform`.
    machine : str
        The processor: x86_64, aarch64 or arm64 among others.
    tag : tuple of str or None
        The three parts of the wheel's tag: Python, binary interface, platform. None for a build for this machine.
    triple : str
        The target triple for zig; empty for a build for this machine.
    headers : Path or None
        The folder with the headers of the platform's Python (`python`) and NumPy (`numpy`), and for Windows with
        Python's import library (`libs`). None: the build uses the headers of the Python that runs it.
    """

    system: str
    machine: str
    tag: tuple[str, str, str] | None = None
    triple: str = ""
    headers: Path | None = None

    @property
    def stable(self) -> bool:
        """Return whether the build is restricted to Python's stable binary interface."""
        return self.tag is not None and self.tag[1] == "abi3"

    @property
    def suffix(self) -> str | None:
        """Return the suffix of the file of an extension module, or None for a build for this machine."""
        if self.tag is None:
            return None
        python = self.tag[0]
        if self.system == "win32":
            return ".pyd" if self.stable else f".{python}-win_amd64.pyd"
        if self.stable:
            return ".abi3.so"
        platforms = {"darwin": "darwin", "linux": f"{self.machine}-linux-gnu"}
        return f".cpython-{python.removeprefix('cp')}-{platforms[self.system]}.so"


def target() -> Target:
    """Return the target named by the environment variable EIP_SCIPY_TARGET, a wheel's tag; default: this machine."""
    if tag := os.environ.get(VARIABLE):
        python, abi, name = tag.split("-")
        if name not in PLATFORMS:
            raise SystemExit(f"{VARIABLE} names an unknown platform, {name!r}; expected one of {', '.join(PLATFORMS)}")
        system, machine, triple = PLATFORMS[name]
        return Target(system, machine, (python, abi, name), triple, Path(os.environ[HEADERS]))
    machine = platform.machine().lower()
    return Target(sys.platform, {"amd64": "x86_64"}.get(machine, machine))
