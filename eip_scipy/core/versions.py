"""Versions of what a result may depend on."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

__all__ = ["versions"]

PACKAGES = (
    "eip_scipy", "numpy", "scipy", "numba", "tqdm", "rebound", "heyoka", "matplotlib", "astropy", "jplephem", "ducc0",
)  # fmt: skip


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that matter, None for one that is not installed; none is imported."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found
