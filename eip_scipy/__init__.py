"""Explicit invariants-preserving (EIP) integrators for SciPy.

Public names are imported when they are first asked for (PEP 562): what makes steps brings Numba, .3 s.
"""

import sys
from importlib import import_module as _import_module
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING, Any

from . import _source_tree as _source_tree

if TYPE_CHECKING:
    from . import checkpoint as checkpoint
    from . import problems as problems
    from .checkpoint import CheckpointError
    from .ensemble import EnsembleResult, ensemble
    from .invariants import Invariant, JointInvariants, check_gradient
    from .longrun import integrate
    from .nystrom import NystromTableau
    from .one_step import OneStepMethod
    from .projection import project
    from .result import Diagnostics, IntegrationResult, ProjectionResult, ProjectionWarning
    from .solvers import (
        EIPDOP853,
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
    from .tableaux import Tableau

    __version__: str

__all__ = [
    "EIPDOP853",
    "EIPRK1",
    "EIPRK2",
    "EIPRK3",
    "EIPRK4",
    "EIPRK5",
    "EIPRK23",
    "EIPRK45",
    "EIPRKN8",
    "EIPRKN12",
    "CheckpointError",
    "Diagnostics",
    "EIPSolver",
    "EnsembleResult",
    "IntegrationResult",
    "Invariant",
    "JointInvariants",
    "NystromTableau",
    "OneStepMethod",
    "ProjectionResult",
    "ProjectionWarning",
    "Tableau",
    "check_gradient",
    "eip_method",
    "ensemble",
    "integrate",
    "project",
]

_HOMES = {  # the module of each of these names, and the modules that are public themselves
    "CheckpointError": "checkpoint",
    "Diagnostics": "result",
    "EnsembleResult": "ensemble",
    "IntegrationResult": "result",
    "Invariant": "invariants",
    "JointInvariants": "invariants",
    "NystromTableau": "nystrom",
    "OneStepMethod": "one_step",
    "ProjectionResult": "result",
    "ProjectionWarning": "result",
    "Tableau": "tableaux",
    "check_gradient": "invariants",
    "ensemble": "ensemble",
    "integrate": "longrun",
    "project": "projection",
    **dict.fromkeys((name for name in __all__ if name.startswith("EIP") or name == "eip_method"), "solvers"),
}
_MODULES = ("checkpoint", "problems")


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(_import_module(f".{_HOMES[name]}", __name__), name)
    elif name in _MODULES:
        value = _import_module(f".{name}", __name__)
    elif name == "__version__":
        from importlib.metadata import version

        value = version("eip_scipy")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES, "__version__"})


class _Package(_ModuleType):
    """The package, in which a public name stays what it is when the module of the same name is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _HOMES or not isinstance(value, _ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
