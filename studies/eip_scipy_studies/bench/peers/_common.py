"""Common part of the adapters: the record of a method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

PYTHON, COMPILED, OWN = "plain Python function", "function compiled by Numba", "equations in the package's own form"
ATOL = 1e-3  # ratio of the absolute tolerance to the relative one, for all

Solve = Callable[[float], np.ndarray]
"""``solve(setting) -> y`` at the end."""


@dataclass(frozen=True)
class Peer:
    """A method of a package with the kind of function that it takes: `PYTHON`, `COMPILED` or `OWN`.

    `name` is that of the method in tables, and `distribution` that of the package with pip. ``prepare(scene, **extra)``
    imports the package, does the work that is needed once, and returns ``solve(setting)``, which returns the state at
    the end (n,); `extra` are further arguments of the package's own call. `steps` is True if the setting is a number of
    steps, not a tolerance. The method is run for the values of `Scene.equations` in `scenes`; if it is empty, for all
    except "members". `warm` is True if each setting compiles its own code, so that an uncounted run comes first.
    `projects` is True for a method of another package that is given the problem's invariants too.
    """

    name: str
    distribution: str
    takes: str
    prepare: Callable[..., Solve]
    steps: bool = False
    scenes: tuple[str, ...] = ()
    warm: bool = False
    projects: bool = False

    @property
    def keeps(self) -> bool:
        """Return True if the method is always given the problem's invariants."""
        return self.ours or self.projects

    @property
    def ours(self) -> bool:
        """Return True if the method belongs to this package."""
        return self.distribution == "eip_scipy"
