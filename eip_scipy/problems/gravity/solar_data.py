"""Initial data of the solar system: sets in the package, in AU and days.

`eip_scipy.integrations.jpl.initial_data` returns data for any other epoch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...data import read

__all__ = [
    "AU_KM", "DAY_S", "YEAR_D", "SolarSystemData", "available", "exact_sum", "gm_from_km3_s2", "load",
    "reference_states", "to_barycentre",
]  # fmt: skip

AU_KM = 149597870.7
"""The astronomical unit in km (IAU 2012, exact)."""
DAY_S = 86400.0
"""The day in seconds."""
YEAR_D = 365.25
"""The Julian year in days."""

SOLAR_SYSTEM_JSON = "solar_system.json"


@dataclass(frozen=True, eq=False)
class SolarSystemData:
    """Masses, positions and velocities of N bodies at one epoch; their barycentre is at rest at the origin.

    Attributes
    ----------
    name, source : str
        Name of the set and source of the numbers.
    bodies : tuple of str
        Names of the N bodies, the Sun first.
    gm : ndarray, shape (N,)
        Masses times the constant of gravitation, in AU^3/day^2.
    position, velocity : ndarray, shape (N, 3)
        In AU and AU/day.
    epoch_jd_tdb, epoch_rest : float
        Epoch as a Julian date in TDB, and the part of the exact epoch, in days, that rounding removes from it: a
        float64 resolves 40 microseconds.
    epoch : str
        The epoch as a date of the (proleptic) Gregorian calendar.
    axes : str
        Axes of the positions and velocities: "ICRF" or "ecliptic J2000".
    units : str
        Units of length and time of the arrays: "AU, day".

    See Also
    --------
    solar_system

    Examples
    --------
    >>> from eip_scipy.problems import solar_data
    >>> data = solar_data.load("de440")
    >>> data.bodies[3], data.position.shape
    ('EMB', (10, 3))
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
        raise ValueError(f"unknown solar system data {name!r}; available: {', '.join(map(repr, sets))}")
    if as_printed and name != "paper":
        raise ValueError(f"as_printed=True is an option of the set 'paper' only, got name={name!r}; omit it")
    entry = sets[name]
    bodies = tuple(entry["bodies"])
    gm, position, velocity = (np.array(entry[key], dtype=float) for key in ("gm", "position", "velocity"))
    if name == "paper":  # in m and s, without the Sun
        if not as_printed:
            misprint = entry["misprint"]
            velocity[bodies.index(misprint["body"]), "xyz".index(misprint["component"])] = float(misprint["corrected"])
        bodies = ("Sun", *bodies)
        gm = gm_from_km3_s2(np.insert(gm, 0, float(entry["gm_sun"])) / 1e9)
        position = np.insert(position / 1e3 / AU_KM, 0, 0.0, axis=0)
        velocity = np.insert(velocity / 1e3 * DAY_S / AU_KM, 0, 0.0, axis=0)
        position, velocity = to_barycentre(gm, position, velocity)
    epoch, rest = exact_sum(*entry["epoch_jd_tdb"])
    return SolarSystemData(
        name, bodies, gm, position, velocity, epoch, entry["epoch"], entry["axes"], entry["source"], epoch_rest=rest
    )


def reference_states(name: str = "de440") -> dict[float, np.ndarray]:
    """Return accurate states of the Newtonian ten-body problem ``solar_system("de440")``; `name` must be "de440".

    Returns
    -------
    dict of float to ndarray, shape (60,)
        The states (q of all bodies, v of all bodies) in AU and AU/day, on the axes of ``load("de440")``, by the time
        since the epoch in Julian years (1, 2, 5, 10 and so on to 10 000).

    Notes
    -----
    The states were integrated in 80-bit arithmetic by a summed multistep method of order 14, from the state of
    ``solar_system("de440")`` in AU and Julian years (`tools/solar_reference.py`). After 10 000 years a run with
    another step differs by 6e-12 AU for Mercury and by 2e-13 AU for the other bodies. A start in other units is rounded
    differently, which changes the position of Mercury by 2e-11 AU after this time.
    """
    if name != "de440":
        raise ValueError(f"reference states exist for 'de440' only, got {name!r}; available: 'de440'")
    states = {float(year): np.array(y, dtype=float) for year, y in read("solar_reference.json")["states"].items()}
    for y in states.values():
        y[y.size // 2 :] /= YEAR_D
    return states


def gm_from_km3_s2(gm: Any) -> np.ndarray:
    """Convert GM from km^3/s^2 to AU^3/day^2, in an array of any shape."""
    return np.asarray(gm, dtype=float) * DAY_S**2 / AU_KM**3


def to_barycentre(gm: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (N, 3) relative to the centre of mass of N bodies, in any units."""

    def centre(rows: np.ndarray) -> np.ndarray:
        # fsum and no matrix product: the sum must not depend on the order in which some BLAS adds.
        return np.array([math.fsum(gm * column) for column in rows.T]) / math.fsum(gm)

    return position - centre(position), velocity - centre(velocity)


def exact_sum(a: float, b: float) -> tuple[float, float]:
    """Return the rounded sum of a and b, and the exact sum minus the rounded one."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)
