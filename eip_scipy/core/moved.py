"""Names that have moved in 0.3: their old places still work, with a warning that names the new place."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

__all__ = ["MOVED", "REMOVED_IN", "moved_names"]

REMOVED_IN = "0.4"
STUDIES = "eip_scipy_studies"
RESULTS = (
    "EnsembleResult", "IntegrationResult", "OdeResult", "ProjectionResult", "Recommendation", "plot", "save",
    "to_dataframe", "to_xarray", "view",
)  # fmt: skip
FIGURES = (
    "CostPanel", "Curves", "ErrorSeries", "FieldPanel", "Orbits", "ParticleRow", "SurfacePanel", "cost_figure",
    "errors_figure", "fields_figure", "fields_movie", "gains_figure", "longitude_figure", "orbit_in_time_figure",
    "orbits_figure", "paper_kepler_figure", "particle_figure", "surfaces_figure",
)  # fmt: skip
MOVED = {  # a module: its old names, or "*" for all of them, and the modules that have them now
    "eip_scipy": {
        **dict.fromkeys(RESULTS, "eip_scipy.results"),
        **dict.fromkeys(("GaussJackson", "NystromTableau", "Tableau"), "eip_scipy.methods"),
        **dict.fromkeys(("EIPSolver", "OneStepMethod"), "eip_scipy.solvers"),
        "CFunctions": "eip_scipy.problems",
        "CheckpointError": "eip_scipy.checkpoint",
    },
    "eip_scipy.comparators": {"*": f"{STUDIES}.comparators"},
    "eip_scipy.plotting": dict.fromkeys(FIGURES, f"{STUDIES}.plotting"),
    "eip_scipy.problems.hard_cases": {"*": f"{STUDIES}.hard_cases"},
    "eip_scipy.problems": dict.fromkeys(("HardCase", "hard_cases"), f"{STUDIES}.hard_cases"),
}


def moved_names(module: str, stacklevel: int = 2) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a module from which names have moved; it imports their modules when used."""
    homes = MOVED[module]

    def look_up(name: str) -> Any:
        home = homes.get(name, homes.get("*"))
        if home is None or name.startswith("__"):
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        value = getattr(import_module(home), name)
        warnings.warn(
            f"{module}.{name} is now {home}.{name}; the old name works in 0.3 and will be removed in {REMOVED_IN}.",
            DeprecationWarning,
            stacklevel,
        )
        return value

    return look_up
