"""Explicit invariants-preserving (EIP) integrators for SciPy.

Public names are imported when they are first asked for (PEP 562), because importing SciPy takes 0.3 s. Numba is
imported only if a function is to be compiled.
"""

from importlib import import_module as _import_module
from pathlib import Path as _Path
from sys import version_info as _python
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import chaos as chaos
    from . import checkpoint as checkpoint
    from . import methods as methods
    from . import problems as problems
    from . import results as results
    from . import solvers as solvers
    from .core.balances import Balance
    from .core.config import show_config
    from .core.invariant_set import check_gradient
    from .core.invariants import Invariant
    from .core.particles import particle_invariants
    from .core.project import project
    from .core.results import Diagnostics
    from .core.solvers import (
        EIPBDF,
        EIPDOP853,
        EIPGJ12,
        EIPGJ14,
        EIPRK1,
        EIPRK2,
        EIPRK3,
        EIPRK4,
        EIPRK5,
        EIPRK23,
        EIPRK45,
        EIPRKN8,
        EIPRKN12,
        EIPRadau,
        eip_method,
    )
    from .engine.trust import ProjectionWarning
    from .ensembles.ensemble import ensemble
    from .problems.invariant_search import find_invariants
    from .problems.symbolic import equations, hamiltonian
    from .run.integrate import integrate
    from .run.recommend import recommend
    from .run.results import load
    from .run.solve_ivp import solve_ivp

    __version__: str

__all__ = [
    "EIPBDF",
    "EIPDOP853",
    "EIPGJ12",
    "EIPGJ14",
    "EIPRK1",
    "EIPRK2",
    "EIPRK3",
    "EIPRK4",
    "EIPRK5",
    "EIPRK23",
    "EIPRK45",
    "EIPRKN8",
    "EIPRKN12",
    "Balance",
    "Diagnostics",
    "EIPRadau",
    "Invariant",
    "ProjectionWarning",
    "check_gradient",
    "eip_method",
    "ensemble",
    "equations",
    "find_invariants",
    "hamiltonian",
    "integrate",
    "load",
    "particle_invariants",
    "project",
    "recommend",
    "show_config",
    "solve_ivp",
]

_HOMES = {  # the module of each of these names, and the modules that are public themselves
    "Balance": "core.balances",
    "Diagnostics": "core.results",
    "Invariant": "core.invariants",
    "ProjectionWarning": "engine.trust",
    "check_gradient": "core.invariant_set",
    "ensemble": "ensembles.ensemble",
    "equations": "problems.symbolic",
    "find_invariants": "problems.invariant_search",
    "hamiltonian": "problems.symbolic",
    "integrate": "run.integrate",
    "load": "run.results",
    "particle_invariants": "core.particles",
    "project": "core.project",
    "recommend": "run.recommend",
    "show_config": "core.config",
    "solve_ivp": "run.solve_ivp",
    **dict.fromkeys((name for name in __all__ if name.startswith("EIP") or name == "eip_method"), "core.solvers"),
}


def _require_main_interpreter() -> None:
    # NumPy would blame the installation. In subinterpreters of the older kind, such as those of mod_wsgi, NumPy only
    # warns, and the engine's types would be shared with the main interpreter.
    try:
        interpreters = _import_module("_interpreters" if _python >= (3, 13) else "_xxsubinterpreters")
    except ImportError:  # a Python without subinterpreters
        return
    if interpreters.get_current() != interpreters.get_main():
        raise ImportError(
            "eip_scipy was imported in a subinterpreter, but works only in the main interpreter of a process, as NumPy "
            "does. Import it there, and use threads or processes (executor= of ensemble) for parallel runs."
        )


_require_main_interpreter()
# In a clone the integrations are next to the package; an installed package contains them.
if not _Path(__file__).with_name("integrations").exists():
    __path__.append(str(_Path(__file__).parents[1]))

_MODULES = ("chaos", "checkpoint", "methods", "problems", "results", "solvers")


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(_import_module(f".{_HOMES[name]}", __name__), name)
    elif name in _MODULES:
        value = _import_module(f".{name}", __name__)
    elif name == "__version__":
        value = _import_module(".core.versions", __name__).VERSION
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES, "__version__"})
