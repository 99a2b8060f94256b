"""Conversion from and to astropy's quantities (numbers with a unit) and times.

The rest of the package computes with plain numbers and refuses everything else: `plain` converts the arguments of a run
to plain numbers in the units of a problem, and `nbody` makes a problem from quantities. `times`, `positions` and
`velocities` convert a run back.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from eip_scipy.core.inputs import shown
from eip_scipy.core.problem import Problem
from eip_scipy.problems import nbody as plain_nbody

try:
    from astropy import constants, units
    from astropy.time import Time, TimeDelta
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.astropy needs astropy: pip install "eip_scipy[astro]"', name="astropy"
    ) from error

__all__ = ["julian_date", "nbody", "plain", "positions", "span", "times", "velocities"]

MOMENTS, DURATIONS = ("t_span", "t_eval", "t"), ("h", "first_step", "max_step")
# Starting times that differ by less are equal, because a Julian date in one float has errors of up to 20 microseconds.
SAME = 1e-4 * units.s

Epoch = tuple[float, float]


def plain(problem: Problem, **arguments: Any) -> dict[str, Any]:
    """Convert arguments of a run to plain numbers in the units of a problem.

    Parameters
    ----------
    problem : Problem
        A problem whose `units` name a length and a time, such as "AU, yr".
    **arguments
        Any of ``t_span``, ``t_eval``, ``t``: durations, or times of astropy in any scale if the problem has an `epoch`;
        ``h``, ``first_step``, ``max_step``: durations; ``y0``: a pair (positions, velocities). Plain numbers stay as
        they are.

    Returns
    -------
    dict
        The converted arguments, with the same names, for `integrate`, `ensemble`, `Problem.solve_ivp` or `continue_to`.

    Raises
    ------
    TypeError
        For other arguments, or if the problem lacks the units or the epoch that a conversion needs.
    UnitConversionError
        If a quantity has another dimension.
    ValueError
        If `t_span` starts at a date at which the problem's initial state is not known, and `y0` is not given.

    Examples
    --------
    >>> from astropy import units as u
    >>> from eip_scipy import EIPRKN12, integrate
    >>> from eip_scipy.integrations.astropy import plain
    >>> from eip_scipy.problems import solar_system
    >>> problem = solar_system()
    >>> run = integrate(problem, method=EIPRKN12, **plain(problem, t_span=(0, 30) * u.day, h=6 * u.h))
    >>> f"{run.t[-1] * 365.25:.6f}"
    '30.000000'
    """
    length, time = _units(problem)
    out = {}
    for name, value in arguments.items():
        if name == "y0":
            out[name] = _state(problem, value, length, time)
        elif name in (*MOMENTS, *DURATIONS):
            out[name] = _number(name, value, time, problem.epoch if name in MOMENTS else None)
        else:
            raise TypeError(f"plain: unexpected argument {name!r}; expected {', '.join((*MOMENTS, *DURATIONS))} or y0.")
    start = _first(arguments.get("t_span"))
    if isinstance(start, Time) and problem.epoch and problem.t_span and arguments.get("y0") is None:
        own = problem.t_span[0]
        if abs(out["t_span"][0] - own) * time > SAME:
            date = Time(*problem.epoch, format="jd", scale="tdb") + own * time
            raise ValueError(
                f"t_span: the run starts at {shown(start)}, but the initial state of the problem {problem.name!r} is "
                f"that of {date.isot} TDB. Start at that date, or give the state at the start as y0."
            )
        out["t_span"] = (own, out["t_span"][1])
    return out


def nbody(
    gm: Any,
    position: Any,
    velocity: Any,
    *,
    t_span: Any,
    h: Any = None,
    units: str = "AU, d",
    epoch: Any = None,
    **options: Any,
) -> Problem:
    """Make the problem of `eip_scipy.problems.nbody` from quantities.

    Parameters
    ----------
    gm : Quantity, shape (N,)
        G times the masses, or the masses.
    position, velocity : Quantity, shape (N, 3)
        Initial state.
    t_span : (Quantity, Quantity) or (Time, Time)
        Start and end: durations, or times in any scale.
    h : Quantity, optional
        Step length.
    units : str, optional
        Units of length and time of the problem, by names of astropy.
    epoch : Time or (float, float), optional
        Date of t = 0, see `julian_date`. Default: the start of `t_span` if that is a time.
    **options
        Further options of `eip_scipy.problems.nbody`, as plain numbers.

    Returns
    -------
    Problem
        A problem in plain numbers.

    Raises
    ------
    TypeError, UnitConversionError
        If an argument has no unit, or one of another dimension.

    Examples
    --------
    >>> from astropy import units as u
    >>> from eip_scipy.integrations.astropy import nbody
    >>> problem = nbody([1, 1e-3] * u.Msun, [[0, 0, 0], [5, 0, 0]] * u.AU, [[0, 0, 0], [0, 13, 0]] * u.km / u.s,
    ...                 t_span=(0, 12) * u.yr, h=10 * u.d)
    >>> problem.units, problem.h, problem.t_span
    ('AU, d', 10.0, (0.0, 4383.0))
    """
    length, time = _parsed(units)
    if isinstance(start := _first(t_span), Time) and epoch is None:
        epoch = start
    epoch = julian_date(epoch) if isinstance(epoch, Time) else epoch
    given = {"gm": _quantity("gm", gm), "position": _quantity("position", position)}
    given["velocity"] = _quantity("velocity", velocity)
    if given["gm"].unit.physical_type == "mass":
        given["gm"] = constants.G * given["gm"]
    wanted = length**3 / time**2, length, length / time
    state = [_number(name, value, unit) for (name, value), unit in zip(given.items(), wanted, strict=True)]
    t0, t_end = _number("t_span", t_span, time, epoch)
    return plain_nbody(
        *state, t_span=(float(t0), float(t_end)), h=_number("h", h, time), units=units, epoch=epoch, **options
    )


def julian_date(time: Time) -> Epoch:
    """Return a time in any scale as a Julian date in TDB, in two parts, as `Problem.epoch` and `jpl` use it."""
    if np.shape(time) != ():
        raise ValueError(f"julian_date: expected one moment, got times of shape {np.shape(time)}.")
    return float(time.tdb.jd1), float(time.tdb.jd2)


def span(start: Any, end: Any, *, scale: str | None = None) -> tuple[Time, Time]:
    """Return two times of astropy, for the ``t_span`` of `plain` and `nbody`, from Julian dates on a stated scale.

    Parameters
    ----------
    start, end : float or (float, float) or Time or Quantity
        Julian dates, as one number (accurate to 20 microseconds) or as two that are added without loss; or times of
        astropy, which have their own scale; `end` may also be a duration, counted from the start.
    scale : {"tdb", "tt", "tai", "utc", "tcb", "tcg", "ut1"}, optional
        Time scale of the Julian dates; required if there are any.

    Examples
    --------
    >>> from eip_scipy.integrations.astropy import span
    >>> start, end = span(2456690.5, 2456700.5, scale="utc")
    >>> start.scale, start.tdb.isot, f"{(end.tdb - start.tdb).to_value('s'):.3f} s"
    ('utc', '2014-02-02T00:01:07.185', '864000.000 s')
    """

    def date(name: str, value: Any) -> Time:
        if isinstance(value, Time):
            return value
        if scale is None:
            raise TypeError(
                f"span: {name} is {shown(value)}, a Julian date without a time scale; give scale='tdb', scale='utc' or "
                "another, or a Time of astropy."
            )
        return Time(*(value if isinstance(value, tuple | list) else (value, 0.0)), format="jd", scale=scale)

    first = date("start", start)
    return first, first + end if isinstance(end, units.Quantity | TimeDelta) else date("end", end)


def times(run: Any, *, scale: str = "tdb") -> Time:
    """Return the saved times (m,) of a run as times of astropy, in a time scale such as "tdb" or "utc".

    The run is one by `integrate` or `Problem.solve_ivp` of a problem with an epoch, also after saving and loading. A
    TypeError is raised if it has no epoch, or no unit of time.
    """
    if getattr(run, "epoch", None) is None:
        raise TypeError("times: the run has no epoch, so its times have no dates. Give one: nbody(..., epoch=...).")
    days = (np.asarray(run.t) * _units(run)[1]).to_value(units.day)
    return getattr(Time(run.epoch[0], run.epoch[1] + days, format="jd", scale="tdb"), scale)


def positions(run: Any, unit: Any = None) -> units.Quantity:
    """Return the positions (N, 3, m) of all bodies of a run, by default in the problem's unit of length.

    The run is one of bodies, by `integrate` or `Problem.solve_ivp`, or the result of
    `eip_scipy.integrations.rebound.read_archive`. A TypeError is raised for other runs, and if there are no units.
    """
    return _part(run, 0, _units(run)[0], unit)


def velocities(run: Any, unit: Any = None) -> units.Quantity:
    """Return the velocities (N, 3, m) of all bodies of a run; see `positions`."""
    length, time = _units(run)
    return _part(run, 1, length / time, unit)


def _part(run: Any, part: int, own: Any, unit: Any) -> units.Quantity:
    rows = np.asarray(run.y).reshape(2, _bodies(run), 3, -1)[part]
    return units.Quantity(rows, own).to(own if unit is None else unit)


def _bodies(run: Any) -> int:
    """Return the number of bodies of a run or problem; TypeError if it is not one of bodies."""
    names = getattr(run, "component_names", None) or ()
    half = len(names) // 2
    if half % 3 or not half or any(f"v{a}" != b for a, b in zip(names[:half], names[half:], strict=False)):
        raise TypeError("expected bodies, whose components are x_..., y_..., z_... of each, and then vx_..., vy_...")
    return half // 3


def _units(run: Any) -> tuple[Any, Any]:
    """Return the units of length and time of a run or problem."""
    return _parsed(getattr(run, "units", ""))


def _parsed(text: str) -> tuple[Any, Any]:
    """Return the units of length and time in a text such as "AU, yr" or "km, 5022642.9 s"."""
    try:
        length, time = (units.Unit(part) for part in text.replace("Julian year", "yr").split(","))
    except ValueError:
        length = time = units.dimensionless_unscaled
    if length.physical_type != "length" or time.physical_type != "time":
        raise TypeError(f"units: {text!r} does not name units of length and time; expected for instance 'AU, yr'.")
    return length, time


def _state(problem: Problem, y0: Any, length: Any, time: Any) -> Any:
    """Return the state (n,) from a pair (positions, velocities) of quantities; plain numbers are returned unchanged."""
    if not (isinstance(y0, tuple | list) and len(y0) == 2 and any(isinstance(part, units.Quantity) for part in y0)):
        return y0
    q, v = (_number("y0", _quantity("y0", part), unit) for part, unit in zip(y0, (length, length / time), strict=True))
    if not np.size(q) == np.size(v) == 3 * _bodies(problem):
        raise ValueError(f"y0: {np.size(q)} and {np.size(v)} numbers; expected {3 * _bodies(problem)} of each.")
    return np.concatenate([np.ravel(q), np.ravel(v)])


def _first(span: Any) -> Any:
    """Return the first item of a list, a tuple or an array; None for anything else."""
    return span[0] if isinstance(span, tuple | list | Time | np.ndarray) and len(span) else None


def _quantity(name: str, value: Any) -> units.Quantity:
    try:
        found = units.Quantity(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: {shown(value)} is not a quantity: {error}.") from None
    if found.unit == units.dimensionless_unscaled:
        raise TypeError(f"{name}: {shown(value)} has no unit; expected a quantity of astropy.")
    return found


def _number(name: str, value: Any, unit: Any, epoch: Epoch | None = None) -> Any:
    """Return quantities, times after the `epoch`, or lists of them, in a unit; plain numbers are returned unchanged."""
    if isinstance(value, tuple | list):
        return type(value)(_number(name, item, unit, epoch) for item in value)
    if isinstance(value, Time):
        if epoch is None:
            raise TypeError(
                f"{name}: {shown(value)} is a date, but there is no date of t = 0. Give a duration, or make the "
                "problem with epoch=..., such as nbody(..., epoch=...)."
            )
        days = (value.tdb.jd1 - epoch[0]) + (value.tdb.jd2 - epoch[1])
        value = days * units.day
    if not isinstance(value, units.Quantity | TimeDelta):
        return value
    try:
        found = value.to_value(unit)
    except units.UnitConversionError as error:
        raise units.UnitConversionError(f"{name}: {shown(value)} is not in units of {unit}: {error}.") from None
    return float(found) if np.ndim(found) == 0 else found
