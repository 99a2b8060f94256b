"""The package's version, and those of other packages."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

__all__ = ["VERSION", "installed"]

VERSION = "0.4.0"
"""Version of the package. pyproject.toml reads it from here; a test compares CITATION.cff and CHANGELOG.md with it."""


def installed(package: str) -> str | None:
    """Return the version of a package, or None if it is not installed; it is not imported."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
