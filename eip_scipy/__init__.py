"""Explicit invariants-preserving (EIP) integrators for SciPy.

Public names are imported when they are first asked for (PEP 562), because SciPy takes 0.3 s. Numba is imported only if
a function is to be compiled.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING, Any

from .core import moved as moved
from .core import source_tree as source_tree

if TYPE_CHECKING:
    from . import checkpoint as checkpoint
    from . import problems as problems
    from .checkpoint import CheckpointError
    from .core.config import show_config
    from .core.invariants import Invariant, JointInvariants, check_gradient
    from .core.one_step import OneStepMethod
    from .core.pointers import CFunctions
    from .core.project import project
    from .core.results import Diagnostics, ProjectionResult, ProjectionWarning
    from .core.solvers import (
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
        EIPSolver,
        eip_method,
    )
    from .ensembles.ensemble import EnsembleResult, ensemble
    from .methods.multistep import GaussJackson
    from .methods.nystrom import NystromTableau
    from .methods.runge_kutta import Tableau
    from .problems.invariant_search import find_invariants
    from .problems.symbolic import equations, hamiltonian
    from .run.figures import plot
    from .run.integrate import integrate
    from .run.recommend import recommend
    from .run.recommendation import Recommendation
    from .run.results import IntegrationResult
    from .run.saving import load, save
    from .run.solve_ivp import OdeResult, solve_ivp
    from .run.tables import to_dataframe, to_xarray
    from .run.view import view

    __version__: str

__all__ = [
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
    "CFunctions",
    "CheckpointError",
    "Diagnostics",
    "EIPSolver",
    "EnsembleResult",
    "GaussJackson",
    "IntegrationResult",
    "Invariant",
    "JointInvariants",
    "NystromTableau",
    "OdeResult",
    "OneStepMethod",
    "ProjectionResult",
    "ProjectionWarning",
    "Recommendation",
    "Tableau",
    "check_gradient",
    "eip_method",
    "ensemble",
    "equations",
    "find_invariants",
    "hamiltonian",
    "integrate",
    "load",
    "plot",
    "project",
    "recommend",
    "save",
    "show_config",
    "solve_ivp",
    "to_dataframe",
    "to_xarray",
    "view",
]

_HOMES = {  # the module of each of these names, and the modules that are public themselves
    "CFunctions": "core.pointers",
    "CheckpointError": "checkpoint",
    "Diagnostics": "core.results",
    "EnsembleResult": "ensembles.ensemble",
    "GaussJackson": "methods.multistep",
    "IntegrationResult": "run.results",
    "Invariant": "core.invariants",
    "JointInvariants": "core.invariants",
    "NystromTableau": "methods.nystrom",
    "OdeResult": "run.solve_ivp",
    "OneStepMethod": "core.one_step",
    "ProjectionResult": "core.results",
    "ProjectionWarning": "core.results",
    "Recommendation": "run.recommendation",
    "Tableau": "methods.runge_kutta",
    "check_gradient": "core.invariants",
    "ensemble": "ensembles.ensemble",
    "equations": "problems.symbolic",
    "find_invariants": "problems.invariant_search",
    "hamiltonian": "problems.symbolic",
    "integrate": "run.integrate",
    "load": "run.saving",
    "plot": "run.figures",
    "project": "core.project",
    "recommend": "run.recommend",
    "save": "run.saving",
    "show_config": "core.config",
    "solve_ivp": "run.solve_ivp",
    "to_dataframe": "run.tables",
    "to_xarray": "run.tables",
    "view": "run.view",
    **dict.fromkeys((name for name in __all__ if name.startswith("EIP") or name == "eip_method"), "core.solvers"),
}
_MODULES = ("checkpoint", "problems")


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
