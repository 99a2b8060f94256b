"""Versions of what a result may depend on."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

__all__ = ["VERSION", "installed", "versions"]

VERSION = "0.2.0"
"""The package's own: the one place where it stands (pyproject.toml reads it)."""
PACKAGES = "numpy", "scipy", "numba", "tqdm", "rebound", "heyoka", "matplotlib", "astropy", "jplephem", "ducc0"


def installed(package: str) -> str | None:
    """The version of a package, None where it is not installed; it is not imported."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def versions() -> dict[str, str | None]:
    """Versions of Python, of eip_scipy and of the packages that matter."""
    own = {"python": platform.python_version(), "eip_scipy": VERSION}
    return {**own, **{package: installed(package) for package in PACKAGES}}
