"""Names that have moved to `eip_scipy_studies`: for this version they are found in their old places, with a warning.

The table `MOVED` is the only place that knows them. Modules of the library whose names have moved take their
``__getattr__`` from `moved_names`; a module that has moved is found by `MovedModules`. Neither loads the studies before
an old name is used.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

__all__ = ["MOVED", "moved_names"]

STUDIES = "eip_scipy_studies"
FIGURES = (
    "CostPanel", "Curves", "ErrorSeries", "FieldPanel", "Orbits", "ParticleRow", "SurfacePanel", "cost_figure",
    "errors_figure", "fields_figure", "fields_movie", "gains_figure", "longitude_figure", "orbit_in_time_figure",
    "orbits_figure", "paper_kepler_figure", "particle_figure", "surfaces_figure",
)  # fmt: skip
MOVED = {  # old name of a module, or of what is in one, and the module that has it now
    "eip_scipy.comparators": f"{STUDIES}.comparators",
    "eip_scipy.problems.HardCase": f"{STUDIES}.hard_cases",
    "eip_scipy.problems.hard_cases": f"{STUDIES}.hard_cases",
    **{f"eip_scipy.plotting.{name}": f"{STUDIES}.plotting" for name in FIGURES},
}
MODULES = ("eip_scipy.comparators", "eip_scipy.problems.hard_cases")


def moved_names(module: str) -> Callable[[str], Any]:
    """Make the ``__getattr__`` of a module some of whose names have moved.

    Parameters
    ----------
    module : str

    Returns
    -------
    callable
    """

    def look_up(name: str) -> Any:
        home = MOVED.get(f"{module}.{name}")
        if home is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(f"{module}.{name}", f"{home}.{name}")
        return getattr(import_module(home), name)

    return look_up


class MovedModule(ModuleType):
    """Module in an old place. It can be called where its name is that of a function as well."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the function that the old package had under the module's name."""
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **options)


class MovedModules:
    """Finder and loader of modules that have moved; Python asks it after all other finders."""

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """See `importlib.abc.MetaPathFinder`."""
        return ModuleSpec(name, cls) if name in MODULES else None  # type: ignore[arg-type]

    @staticmethod
    def create_module(spec: ModuleSpec) -> ModuleType:
        """See `importlib.abc.Loader`."""
        return MovedModule(spec.name)

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        """Fill the module with the names of the one that replaces it."""
        home = import_module(MOVED[module.__name__])
        _warn(module.__name__, home.__name__)
        own = {name: value for name, value in vars(home).items() if not name.startswith("__")}
        module.__dict__.update(own, __all__=home.__all__, __doc__=home.__doc__)


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old} is now {new}; the old name will be removed.", DeprecationWarning, stacklevel=3)


sys.meta_path.append(MovedModules)
