"""What the adapters share: the record of a peer, and how packages are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from ..equations import Scene

__all__ = ["ATOL", "COMPILED", "OWN", "PYTHON", "Peer", "package", "plain_fun"]

PYTHON, COMPILED, OWN = "plain Python function", "function compiled by Numba", "equations in the package's own form"
ATOL = 1e-3  # absolute tolerance by the relative one, for all

Solve = Callable[[float], np.ndarray]
"""``solve(setting) -> y`` at the end."""


@dataclass(frozen=True)
class Peer:
    """One way to solve a scene.

    Attributes
    ----------
    name : str
    distribution : str
        What pip calls it.
    takes : str
        `PYTHON`, `COMPILED` or `OWN`.
    prepare : callable
        ``prepare(scene, **extra) -> solve``: imports the package, and builds what it needs once; `extra` goes to the
        package's own call.
    steps : bool
        Whether the setting is a number of steps, not a tolerance.
    scenes : tuple of str
        Equations that it is asked for; empty: all.
    warm : bool
        Whether each setting compiles code of its own, so that a run goes before those that count.
    projects : bool
        Whether it, too, gets the scene's invariants.
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
        """Whether it always gets the scene's invariants."""
        return self.ours or self.projects

    @property
    def ours(self) -> bool:
        """Whether it is a method of this package."""
        return self.distribution == "eip_scipy"


def package(name: str) -> Any:
    """A peer's package, in the process that runs it: nothing else of this one imports it."""
    return import_module(name)


def plain_fun(scene: Scene) -> Any:
    """The user's function for all peers that take plain Python."""
    return scene.plain().fun
