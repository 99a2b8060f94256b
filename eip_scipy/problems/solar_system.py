"""The solar system: Sun, eight planets (or their systems' barycentres) and Pluto."""

from __future__ import annotations

import numpy as np

from ._problem import Problem
from .nbody import nbody
from .solar_data import AU_KM, DAY_S, YEAR_D, SolarSystemData, load, reference_states

__all__ = ["solar_system"]

UNITS = ("AU, yr", "SI")


def solar_system(
    data: str | SolarSystemData = "de440", *, years: float = 2000.0, h: float = 0.002, units: str = "AU, yr"
) -> Problem:
    """The Newtonian solar system from JPL initial data (the paper's Experiment II).

    Parameters
    ----------
    data : str or SolarSystemData
        "de440" (system barycentres at the paper's epoch), "de440-j2000", "paper" (the paper's own table), or data
        for another epoch from `eip_scipy.integrations.jpl.initial_data`.
    years : float
        Length of the run in Julian years; negative to go back in time.
    h : float
        Step in years.
    units : {"AU, yr", "SI"}
        Units of the state, of time and of G m: AU and Julian years, or metres and seconds.

    Returns
    -------
    Problem
        Of 60 components, see `nbody`. With "de440", or the same data from a kernel, its `reference` gives stored states
        at 1, 10, 100, 1000 and 2000 years (Taylor integration in extended precision).

    Raises
    ------
    ValueError
        For unknown data or units.
    """
    known = load(data) if isinstance(data, str) else data
    length, time = _units(units)
    year = YEAR_D * time

    def reference(t: float) -> np.ndarray | None:
        state = references.get(round(t / year, 9))
        if state is None:
            return None
        half = state.size // 2
        return np.concatenate([state[:half] * length, state[half:] * (length / time)])

    references = reference_states() if _starts_as_references(known) else {}
    return nbody(
        known.gm * (length**3 / time**2),
        known.position * length,
        known.velocity * (length / time),
        t_span=(0.0, years * year),
        h=h * year,
        name="solar-system",
        units="AU, Julian year" if units == "AU, yr" else "m, s",
        source=known.source,
        reference=reference,
    )


def _starts_as_references(data: SolarSystemData) -> bool:
    """Whether these are the masses and states that the stored states start from; a name tells nothing of the epoch."""
    start = load("de440")
    return np.array_equal(data.gm, start.gm) and np.array_equal(data.y0, start.y0)


def _units(units: str) -> tuple[float, float]:
    """One AU and one day in the given units."""
    if units == "AU, yr":
        return 1.0, 1.0 / YEAR_D
    if units == "SI":
        return AU_KM * 1e3, DAY_S
    raise ValueError(f"units must be one of {UNITS}, got {units!r}.")
