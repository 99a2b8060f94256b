"""Conversion from and to astropy's quantities (numbers with a unit) and times.

Input: `eip_scipy.problems.nbody` takes masses, positions, velocities, spans and steps with units, and epochs;
`integrate` and `Problem.solve_ivp` take them for ``t_span``, ``t_eval``, ``h``, ``first_step``, ``max_step`` and ``y0``
of a problem that knows its units, and times (`astropy.time.Time`, in any scale) for a problem that has an epoch;
`eip_scipy.integrations.jpl.initial_data` takes a time. This works without importing this module. Elsewhere a value with
a unit raises a TypeError that names the argument: no unit is dropped silently.

Output: `times`, `positions` and `velocities` of a run. `span` makes a ``t_span`` of Julian dates on a stated scale.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from eip_scipy.core.inputs import shown
from eip_scipy.core.units import DAY_S, Unit, is_time
from eip_scipy.core.units import units as known_units

try:
    from astropy import units
    from astropy.time import Time
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.astropy needs astropy: pip install "eip_scipy[astro]"', name="astropy"
    ) from error

__all__ = ["positions", "span", "times", "velocities"]


def span(start: Any, end: Any, *, scale: str | None = None) -> tuple[Time, Time]:
    """Make a ``t_span`` from Julian dates on a stated time scale.

    Parameters
    ----------
    start, end : float or (float, float) or Time or Quantity
        Julian dates, as one number (accurate to 20 microseconds) or as two that are added without loss; or times of
        astropy, which have their own scale; `end` may also be a duration, counted from the start.
    scale : {"tdb", "tt", "tai", "utc", "tcb", "tcg", "ut1"}, optional
        Time scale of the Julian dates; required if there are any.

    Returns
    -------
    (Time, Time)
        Start and end, for ``t_span`` of `eip_scipy.integrate`, which converts them to TDB.

    Raises
    ------
    TypeError
        If a Julian date has no scale.
    ValueError
        If astropy does not know the scale.

    Examples
    --------
    >>> from eip_scipy.integrations.astropy import span
    >>> start, end = span(2456690.5, 2456700.5, scale="utc")
    >>> start.scale, start.tdb.isot, f"{(end.tdb - start.tdb).to_value('s'):.3f} s"
    ('utc', '2014-02-02T00:01:07.185', '864000.000 s')
    """
    first = _time("start", start, scale)
    is_duration = isinstance(end, units.Quantity) or (hasattr(end, "jd1") and not is_time(end))
    return first, first + end if is_duration else _time("end", end, scale)


def times(run: Any, *, scale: str = "tdb") -> Time:
    """Return the saved times of a run as times of astropy.

    Parameters
    ----------
    run : IntegrationResult or OdeResult
        A run by `integrate` or `Problem.solve_ivp` of a `Problem` that has an `epoch`, or loaded from a file.
    scale : str, optional
        "tdb" (the default), "utc" or another that astropy knows.

    Returns
    -------
    Time, shape (m,)

    Raises
    ------
    TypeError
        If the run has no epoch or no unit of time.
    """
    epoch = getattr(run, "epoch", None)
    if epoch is None:
        raise TypeError(
            "times: the run has no epoch, so its times have no dates. Give one to the problem: nbody(..., epoch=...)."
        )
    time = _units(run)[1]
    dates = Time(epoch[0], epoch[1] + np.asarray(run.t) * (time.si / DAY_S), format="jd", scale="tdb")
    return getattr(dates, scale)


def positions(run: Any, unit: Any = None) -> units.Quantity:
    """Return the positions of all bodies of a run, with their unit.

    Parameters
    ----------
    run : IntegrationResult or OdeResult or OptimizeResult
        A run of bodies by `integrate` or `Problem.solve_ivp`, in a problem that knows its units, or the result of
        `eip_scipy.integrations.rebound.read_archive`.
    unit : str or Unit, optional
        Default: that of the problem.

    Returns
    -------
    Quantity, shape (N, 3, m)

    Raises
    ------
    TypeError
        If the run has no units, or is not one of bodies.
    """
    return _part(run, 0, _as_astropy(_units(run)[0]), unit)


def velocities(run: Any, unit: Any = None) -> units.Quantity:
    """Return the velocities of all bodies of a run, with their unit.

    Parameters
    ----------
    run, unit
        As for `positions`.

    Returns
    -------
    Quantity, shape (N, 3, m)

    Raises
    ------
    TypeError
        As for `positions`.
    """
    length, time = map(_as_astropy, _units(run))
    return _part(run, 1, length / time, unit)


def _part(run: Any, part: int, own: Any, unit: Any) -> units.Quantity:
    names = getattr(run, "component_names", None) or ()
    half = len(names) // 2
    if half % 3 or not half or any(f"v{a}" != b for a, b in zip(names[:half], names[half:], strict=False)):
        raise TypeError(
            "the run has no positions and velocities in space: expected a run of bodies, whose components are x_..., "
            "y_..., z_... of each body, and then vx_..., vy_..., vz_..."
        )
    rows = np.asarray(run.y).reshape(2, half // 3, 3, -1)[part]
    return units.Quantity(rows, own).to(own if unit is None else unit)


def _units(run: Any) -> tuple[Unit, Unit]:
    text = getattr(run, "units", "")
    found = known_units(text)
    if found is None:
        raise TypeError(
            f"the run's units are {text!r}, which name no units of length and time; give them to the problem, such as "
            "nbody(..., units='AU, yr')."
        )
    return found


def _as_astropy(unit: Unit) -> Any:
    return units.Unit(unit.name) if unit.scale == 1 else units.Unit(f"{unit.scale!r} {unit.name}")


def _time(name: str, value: Any, scale: str | None) -> Time:
    if is_time(value):
        return value
    if scale is None:
        raise TypeError(
            f"span: {name} is {shown(value)}, a Julian date without a time scale; say scale='tdb', scale='utc' or "
            "another, or give a Time of astropy."
        )
    if scale not in Time.SCALES:
        raise ValueError(f"span: unknown time scale {scale!r}; expected one of {', '.join(sorted(Time.SCALES))}.")
    first, second = value if isinstance(value, tuple | list) else (value, 0.0)
    return Time(first, second, format="jd", scale=scale)
