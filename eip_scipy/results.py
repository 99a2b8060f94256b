"""Results of runs, ensembles and projections, and functions that make tables, files and figures of them."""

from .core.results import Diagnostics, Multipliers, ProjectionResult
from .ensembles.ensemble import EnsembleResult
from .run.fields import to_dataframe, to_xarray
from .run.recommend import Recommendation
from .run.results import IntegrationResult, load, plot, save
from .run.solve_ivp import OdeResult

__all__ = [
    "Diagnostics",
    "EnsembleResult",
    "IntegrationResult",
    "Multipliers",
    "OdeResult",
    "ProjectionResult",
    "Recommendation",
    "load",
    "plot",
    "save",
    "to_dataframe",
    "to_xarray",
]
