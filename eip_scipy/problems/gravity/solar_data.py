"""Initial data and reference states of the solar system that are contained in the package.

The package contains four sets: ``"de440"``, the Sun and the nine system barycentres of JPL's DE440 at
2014-02-02 20:18:00 TDB, the epoch of Cai, Gong and Wang; ``"de440-j2000"``, the same bodies at JD 2451545.0 TDB;
``"de440-moon"``, the first set with Earth and Moon in place of their barycentre; and ``"paper"``, the table in
Appendix A of Cai, Gong and Wang. `eip_scipy.integrations.jpl.initial_data` returns data for any other epoch.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

__all__ = [
    "AU_KM",
    "DAY_S",
    "YEAR_D",
    "SolarSystemData",
    "available",
    "exact_sum",
    "gm_from_km3_s2",
    "load",
    "reference_states",
    "to_barycentre",
]

AU_KM = 149597870.7
"""The astronomical unit in km (IAU 2012, exact)."""
DAY_S = 86400.0
"""The day in seconds."""
YEAR_D = 365.25
"""The Julian year in days."""

SOLAR_SYSTEM_JSON = "solar_system.json"
_REFERENCE_JSON = "solar_reference.json"


@dataclass(frozen=True, eq=False)
class SolarSystemData:
    """Masses, positions and velocities of N bodies at one epoch; their barycentre is at rest at the origin.

    Attributes
    ----------
    name : str
        Name of the set.
    bodies : tuple of str
        Names of the N bodies, the Sun first.
    gm : ndarray, shape (N,)
        Masses times the constant of gravitation, in AU^3/day^2.
    position : ndarray, shape (N, 3)
        Positions in AU.
    velocity : ndarray, shape (N, 3)
        Velocities in AU/day.
    epoch_jd_tdb : float
        Epoch as a Julian date in TDB. A float64 resolves 40 microseconds; the states belong to the exact epoch, which
        is `epoch_jd_tdb` + `epoch_rest`.
    epoch : str
        The epoch as a date of the (proleptic) Gregorian calendar.
    axes : str
        Axes of the positions and velocities: "ICRF" or "ecliptic J2000".
    source : str
        Source of the numbers.
    units : str
        Units of length and time of the arrays: "AU, day".
    epoch_rest : float
        The part of the exact epoch, in days, that rounding removes from `epoch_jd_tdb`.
    """

    name: str
    bodies: tuple[str, ...]
    gm: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    epoch_jd_tdb: float
    epoch: str
    axes: str
    source: str
    units: str = "AU, day"
    epoch_rest: float = 0.0

    @property
    def y0(self) -> np.ndarray:
        """The state (q of all bodies, v of all bodies), shape (6 N,)."""
        return np.concatenate([self.position.ravel(), self.velocity.ravel()])


def exact_sum(a: float, b: float) -> tuple[float, float]:
    """Return the rounded sum of a and b, and the exact sum minus the rounded one."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def available() -> tuple[str, ...]:
    """Return the names of the data sets that `load` knows."""
    return tuple(read(SOLAR_SYSTEM_JSON))


def load(name: str = "de440", *, as_printed: bool = False) -> SolarSystemData:
    """Load initial data of the solar system from the package.

    Parameters
    ----------
    name : {"de440", "de440-j2000", "de440-moon", "paper"}
        ``"de440"``: Sun and nine system barycentres, ICRF axes, at 2014-02-02 20:18:00 TDB, the initial state of
        `reference_states`. ``"de440-j2000"``: the same bodies at JD 2451545.0 TDB. ``"de440-moon"``: the first set with
        Earth and Moon in place of their barycentre. ``"paper"``: the table of Cai, Gong and Wang at the first of these
        epochs, on ecliptic J2000 axes, with the Sun added. The table combines the centres of planets with masses
        without satellites (Jupiter is 112 km from the barycentre of its system, Earth lacks the Moon). It is therefore
        suitable for reproducing the paper, and not for predicting planets: Earth is 42 degrees off DE440 after 100 yr.
    as_printed : bool, optional
        Only with ``"paper"``: keep Mars's v_z = -3.71e-02 m/s as printed. This is a misprint for -3.71e+02 m/s, which
        puts Mars 6.4 degrees off after 100 yr.

    Returns
    -------
    SolarSystemData
        New arrays in AU and days, with the barycentre at rest at the origin.

    Raises
    ------
    ValueError
        If the name is unknown, or `as_printed` is True for a set other than ``"paper"``.

    Notes
    -----
    DE440: R. S. Park, W. M. Folkner, J. G. Williams and D. H. Boggs, The JPL planetary and lunar ephemerides DE440 and
    DE441, Astron. J. 161 (2021) 105, doi:10.3847/1538-3881/abd414.
    """
    sets = read(SOLAR_SYSTEM_JSON)
    if name not in sets:
        raise ValueError(_unknown(name, tuple(sets)))
    if as_printed and name != "paper":
        raise ValueError(f"as_printed=True is an option of the set 'paper' only, got name={name!r}; omit it")
    entry = sets[name]
    gm, position, velocity = _with_sun(entry, as_printed) if name == "paper" else _arrays(entry)
    epoch, rest = exact_sum(*entry["epoch_jd_tdb"])
    return SolarSystemData(
        name=name,
        bodies=("Sun", *entry["bodies"]) if name == "paper" else tuple(entry["bodies"]),
        gm=gm,
        position=position,
        velocity=velocity,
        epoch_jd_tdb=epoch,
        epoch=entry["epoch"],
        axes=entry["axes"],
        source=entry["source"],
        epoch_rest=rest,
    )


def reference_states(name: str = "de440") -> dict[float, np.ndarray]:
    """Return accurate states of the Newtonian ten-body problem ``solar_system("de440")``.

    Parameters
    ----------
    name : {"de440"}
        Name of the data set from which the states start.

    Returns
    -------
    dict of float to ndarray, shape (60,)
        The states (q of all bodies, v of all bodies) in AU and AU/day, on the axes of ``load("de440")``, by the time
        since the epoch in Julian years (1, 2, 5, 10 and so on to 10 000).

    Raises
    ------
    ValueError
        If there are no reference states for this data set.

    Notes
    -----
    The states were integrated in 80-bit arithmetic by a summed multistep method of order 14, from the state of
    ``solar_system("de440")`` in AU and Julian years (`tools/solar_reference.py`). After 10 000 years a run with
    another step differs by 6e-12 AU for Mercury and by 2e-13 AU for the other bodies. A start in other units is rounded
    differently, which changes the position of Mercury by 2e-11 AU after this time.
    """
    if name != "de440":
        known = available()
        raise ValueError(
            f"reference states exist for 'de440' only, got {name!r}" if name in known else _unknown(name, known)
        )
    states = {float(year): np.array(y, dtype=float) for year, y in read(_REFERENCE_JSON)["states"].items()}
    for y in states.values():
        y[y.size // 2 :] /= YEAR_D
    return states


def gm_from_km3_s2(gm: Any) -> np.ndarray:
    """Convert GM from km^3/s^2 to AU^3/day^2, in an array of any shape."""
    return np.asarray(gm, dtype=float) * DAY_S**2 / AU_KM**3


def to_barycentre(gm: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions and velocities relative to the centre of mass.

    Parameters
    ----------
    gm : ndarray, shape (N,)
        Masses, in any unit.
    position, velocity : ndarray, shape (N, 3)
        Positions and velocities, in any units.

    Returns
    -------
    position, velocity : ndarray, shape (N, 3)
        New arrays whose centre of mass rests at the origin, to the rounding of their elements.
    """
    return position - _centre(gm, position), velocity - _centre(gm, velocity)


def _centre(gm: np.ndarray, rows: np.ndarray) -> np.ndarray:
    # fsum and no matrix product: the sum must not depend on the order in which some BLAS adds.
    return np.array([math.fsum(gm * column) for column in rows.T]) / math.fsum(gm)


_Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]


def _arrays(entry: dict[str, Any]) -> _Arrays:
    gm, position, velocity = (np.array(entry[key], dtype=float) for key in ("gm", "position", "velocity"))
    return gm, position, velocity


def _with_sun(entry: dict[str, Any], as_printed: bool) -> _Arrays:
    """Return G m, positions and velocities of the paper's table in AU and days, with the Sun added as first body."""
    gm, position, velocity = _arrays(entry)
    if not as_printed:
        misprint = entry["misprint"]
        row = entry["bodies"].index(misprint["body"])
        velocity[row, "xyz".index(misprint["component"])] = float(misprint["corrected"])
    gm = gm_from_km3_s2(np.insert(gm, 0, float(entry["gm_sun"])) / 1e9)
    position = np.insert(position / 1e3 / AU_KM, 0, 0.0, axis=0)
    velocity = np.insert(velocity / 1e3 * DAY_S / AU_KM, 0, 0.0, axis=0)
    return gm, *to_barycentre(gm, position, velocity)


def read(file: str) -> dict[str, Any]:
    """Return the content of a JSON file of the package's data."""
    return json.loads(files("eip_scipy.data").joinpath(file).read_text(encoding="utf-8"))


def _unknown(name: object, known: tuple[str, ...]) -> str:
    return f"unknown solar system data {name!r}; available: {', '.join(map(repr, known))}"
