"""The solar system: Sun, eight planets (or the barycentres of their systems) and Pluto, optionally with the Moon."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import cos, radians, sin

import numpy as np

from ...core.problem import Problem
from .forces import ForceConstants, check_forces
from .nbody import nbody
from .solar_data import AU_KM, DAY_S, YEAR_D, SolarSystemData, load, reference_states

__all__ = ["solar_system"]

# The AU in the unit of length and the day in the unit of time, and the name of the units.
UNITS = {"AU, yr": (1.0, 1.0 / YEAR_D, "AU, Julian year"), "SI": (AU_KM * 1e3, DAY_S, "m, s")}

C_KM_S = 299792.458
# DE440: comments of the kernel. The Sun's pole: IAU Working Group on Cartographic Coordinates (2015), ICRF.
J2_SUN, SUN_RADIUS_KM, EARTH_OVER_MOON = 2.1961391516529825e-07, 696000.0, 81.300568221497215
POLE_RA, POLE_DEC = radians(286.13), radians(63.87)
POLE = cos(POLE_DEC) * cos(POLE_RA), cos(POLE_DEC) * sin(POLE_RA), sin(POLE_DEC)
MOON_ORBIT_KM = 384399.0
OBLIQUITY = radians(84381.448 / 3600)  # IAU 1976, of the axes "ecliptic J2000"


def solar_system(
    data: str | SolarSystemData = "de440",
    *,
    years: float = 2000.0,
    h: float = 0.002,
    units: str = "AU, yr",
    forces: str | Sequence[str] = (),
    balances: str | Sequence[str] | None = None,
) -> Problem:
    """Return the solar system from JPL initial data, by default under Newton's gravitation.

    Parameters
    ----------
    data : str or SolarSystemData
        One of the sets of `solar_data.load`: "de440" (barycentres of the planets' systems at the epoch of Experiment II
        of Cai, Gong & Wang), "de440-j2000", "de440-moon" (with Earth and Moon instead of their barycentre) or "paper"
        (the table of Cai, Gong & Wang); or data for another epoch from `eip_scipy.integrations.jpl.initial_data`.
    years : float
        Length of the run in Julian years; negative to go back in time.
    h : float
        Step in years.
    units : {"AU, yr", "SI"}
        Units of the state, of time and of G m: AU and Julian years, or metres and seconds.
    forces : str or sequence of str, optional
        At most one of "1pn", "eih" and "gr-potential"; in addition "j2" and "moon-quadrupole", see `nbody`. The page
        "Forces" of the documentation shows what each of them contributes.
    balances : str or sequence of str, optional
        "kepler" keeps each planet's energy about the Sun instead of the total energy and angular momentum, see `nbody`.
        With `EIPGJ14` or `EIPDOP853` this is the most accurate choice over thousands of years.

    Returns
    -------
    Problem
        A problem of `nbody` with 60 components (66 with the Moon), named x_Sun, y_Sun and so on. Its `epoch` is that of
        the data. For "de440", or the same data from a kernel, without further forces, its `reference` returns stored
        states at 1, 2, 5, 10 and so on to 10 000 years (computed in extended precision, see `reference_states`).

    Raises
    ------
    ValueError
        If data, units or forces are unknown, "drag" or "radiation" is given, or "moon-quadrupole" is given for data
        without the Earth-Moon barycentre.

    See Also
    --------
    nbody, SolarSystemData, satellite

    Examples
    --------
    >>> from eip_scipy import EIPRKN12, integrate
    >>> from eip_scipy.problems import solar_system
    >>> run = integrate(solar_system(years=1, h=0.01), method=EIPRKN12)
    >>> run.trusted, run.component_names[:3]
    (True, ('x_Sun', 'y_Sun', 'z_Sun'))
    """
    known = load(data) if isinstance(data, str) else data
    chosen = check_forces(forces)
    for name, lacks in (("drag", "an atmosphere; see satellite(...), or nbody"), ("radiation", "beta; see nbody")):
        if name in chosen:
            raise ValueError(f"solar_system: the force {name!r} needs {lacks}.")
    if "moon-quadrupole" in chosen and "EMB" not in known.bodies:
        raise ValueError(
            f"the force 'moon-quadrupole' replaces the Moon in data that contain the Earth-Moon barycentre EMB; "
            f"{known.name!r} does not contain it. Omit this force, or use 'de440'."
        )
    if not isinstance(units, str) or units not in UNITS:
        raise ValueError(f"units must be one of {tuple(UNITS)}, got {units!r}.")
    length, time, name = UNITS[units]
    year = YEAR_D * time
    start = load("de440")  # from which the stored references start; names do not determine epochs
    is_start = np.array_equal(known.gm, start.gm) and np.array_equal(known.y0, start.y0)
    return nbody(
        known.gm * (length**3 / time**2),
        known.position * length,
        known.velocity * (length / time),
        t_span=(0.0, years * year),
        h=h * year,
        forces=chosen,
        balances=balances,
        constants=_constants(known, length, time),
        name="solar-system",
        units=name,
        source=known.source,
        reference=partial(_reference, reference_states() if is_start and not chosen else {}, length, time),
        bodies=known.bodies,
        epoch=(known.epoch_jd_tdb, known.epoch_rest),
    )


def _reference(references: dict[float, np.ndarray], length: float, time: float, t: float) -> np.ndarray | None:
    state = references.get(round(t / (YEAR_D * time), 9))
    return None if state is None else state * np.repeat([length, length / time], state.size // 2)


def _constants(data: SolarSystemData, length: float, time: float) -> ForceConstants:
    """Return the constants of the forces in units in which the AU is `length` and the day is `time`."""
    km, (x, y, z), c, s = length / AU_KM, POLE, cos(OBLIQUITY), sin(OBLIQUITY)
    return ForceConstants(
        c=C_KM_S * DAY_S * km / time,
        j2=J2_SUN * (SUN_RADIUS_KM * km) ** 2,
        pole=POLE if data.axes == "ICRF" else (x, c * y + s * z, c * z - s * y),
        moon_body=data.bodies.index("EMB") if "EMB" in data.bodies else None,
        moon=(MOON_ORBIT_KM * km / (1 + EARTH_OVER_MOON)) ** 2 * EARTH_OVER_MOON / 4,
    )
