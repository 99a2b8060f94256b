"""Report of the installation: versions, the build of the engine, optional packages (extras)."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

from ..engine.native import BUILD
from .inputs import shown
from .versions import VERSION, installed

__all__ = ["show_config"]

REQUIRED = "numpy", "scipy", "filelock", "tqdm"
# Optional packages: the extra that installs each, and its purpose.
EXTRAS = {
    "numba": ("numba", "user-defined jitted functions"),
    "matplotlib": ("plot", "figures"),
    "sympy": ("sympy", "hamiltonian, equations"),
    "rebound": ("rebound", "simulations of REBOUND; WHFast and IAS15 to compare with"),
    "heyoka": ("heyoka", "Taylor series to compare with"),
    "gala": ("gala", "orbits in gala's potentials"),
    "astropy": ("astro", "quantities and times"),
    "jplephem": ("jpl", "JPL's ephemerides"),
    "xarray": ("xarray", "results as datasets"),
    "pandas": ("pandas", "results as data frames"),
    "dask": ("distributed", "ensembles on a cluster"),
    "ducc0": ("fft", "faster Fourier transforms"),
}


def show_config(mode: str = "stdout") -> dict[str, Any] | None:
    """Show versions, the build of the engine and the optional packages, for bug reports, as `numpy.show_config` does.

    Parameters
    ----------
    mode : {"stdout", "dicts"}
        "stdout" prints the report, "dicts" returns it.

    Returns
    -------
    dict or None
        None with "stdout". With "dicts" a dictionary with the keys ``versions`` (of the package, Python and the
        required packages), ``engine`` (its ``build``; ``AVX2 and FMA``, which is True if the engine uses these
        instructions; its ``compiler``), ``extras`` (for each optional module its ``version``, or None if it is not
        installed, the ``extra`` that installs it, and its purpose, ``for``), ``folder`` (of the installed package) and
        ``system``.

    Raises
    ------
    ValueError
        If the mode is unknown.

    See Also
    --------
    numpy.show_config, scipy.show_config

    Notes
    -----
    ``eip-scipy doctor`` shows the same report and runs a test that takes some seconds.

    Examples
    --------
    >>> import eip_scipy
    >>> eip_scipy.show_config("dicts")["extras"]["matplotlib"]["extra"]
    'plot'
    """
    if mode not in ("stdout", "dicts"):
        raise ValueError(f"mode must be 'stdout' or 'dicts', got {shown(mode)}.")
    fast = BUILD.__name__.endswith("_v3")
    versions: dict[str, str | None] = {"eip_scipy": VERSION, "python": platform.python_version()}
    versions |= {package: installed(package) for package in REQUIRED}
    engine = {"build": BUILD.__name__.rpartition(".")[2], "AVX2 and FMA": fast, "compiler": BUILD.COMPILER}
    extras = {name: {"version": installed(name), "extra": extra, "for": what} for name, (extra, what) in EXTRAS.items()}
    places = {
        "folder": str(Path(__file__).parents[1]),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
    }
    if mode == "dicts":
        return {"versions": versions, "engine": engine, "extras": extras, **places}
    kind = "for AVX2 and FMA" if fast else "for any processor"
    rows = {**versions, "engine": f"{engine['build']}, {kind}, by {engine['compiler']}", **places}
    width = max(map(len, (*rows, *extras)))
    lines = [f"{name:<{width}}  {value}" for name, value in rows.items()] + ["", "extras"]
    for name, entry in extras.items():
        state = entry["version"] or f"absent: pip install 'eip_scipy[{entry['extra']}]'"
        lines.append(f"{name:<{width}}  {state:<45}  {entry['for']}")
    print("\n".join(lines))
    return None
