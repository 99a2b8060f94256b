"""The package's version, and those of other packages."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

__all__ = ["VERSION", "installed"]

VERSION = "0.2.0"
"""The package's own: the one place where it stands (pyproject.toml reads it)."""


def installed(package: str) -> str | None:
    """Return the version of a package, None where it is not installed; it is not imported."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
