"""Explicit invariants-preserving (EIP) integrators for SciPy."""

from importlib.metadata import version as _version

from . import _source_tree as _source_tree
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

__version__ = _version("eip_scipy")

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
