"""What a benchmark needs besides the package, or the command that brings it."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType

__all__ = ["peer"]


def peer(name: str, install: str = "") -> ModuleType:
    """The module; a line and exit status 1 where it is missing.

    `install`: what ``pip install`` takes; modules of the package say that themselves.
    """
    try:
        return import_module(name)
    except ImportError as error:
        if not install and (error.name or "eip_scipy").startswith("eip_scipy"):
            raise  # ours, and broken
        sys.exit(f"{error}: pip install {install}" if install else str(error))
