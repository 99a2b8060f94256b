"""Conversion of results of `integrate` and `solve_ivp` to labelled tables: xarray's Dataset and pandas' DataFrame."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.results import Multipliers
from .fields import FIELDS, Field, component_names, label, labels, time_name

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

__all__ = ["dataset", "invariant_errors", "to_dataframe", "to_xarray"]


def to_xarray(result: Any, names: Any = None) -> Dataset:
    """Return a run as an `xarray.Dataset`.

    Parameters
    ----------
    result : IntegrationResult, OdeResult or EnsembleResult
        Result of `integrate`, `scipy.integrate.solve_ivp` or `ensemble`; for the last see `EnsembleResult.to_xarray`.
    names : sequence of str or str, optional
        Names of the components, as a list or as ``"x y vx vy"``. Default: those of the `Problem`, else "y0", "y1" and
        so on.

    Returns
    -------
    xarray.Dataset
        ``y`` (component, t) with the coordinates ``component`` and ``t``: ``data.y.sel(component="x")``. If the run has
        invariants, also ``invariants``, ``invariant_errors`` (I - target), both (invariant, t), and ``max_residual``.
        If it has derivatives, also ``variations`` (t, component, column); a column is named after the component of the
        initial state or the parameter with respect to which it is the derivative, or 0, 1 and so on. A mechanical
        system adds ``outputs`` (output, t), ``multipliers`` (constraint, t) and ``constraint_rank`` (t,). Attributes
        are method, h (nan for adaptive steps), message, trusted (1 or 0) and others that the result has. If a component
        is the time "t", as in `time_transformed`, the dimension of the saved states is "s", and ``t`` (s,) is the time.

    Raises
    ------
    ImportError
        If xarray is missing: ``pip install "eip_scipy[xarray]"``.
    ValueError
        If the number of names differs from the number of components, or two names are equal.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.results import to_xarray
    >>> from eip_scipy.problems import kepler
    >>> data = to_xarray(integrate(kepler(), (0, 10), method=EIPRK4, save_every=10))
    >>> data.y.dims, data.component.values.tolist(), data.attrs["method"]
    (('component', 't'), ['x', 'y', 'vx', 'vy'], 'EIPRK4')
    """
    if hasattr(result, "trajectories"):
        return result.to_xarray(names)
    known = labels(result, names)
    time = time_name(known["component"])
    data = dataset(result, FIELDS, {"t": np.asarray(result.t), **known})
    if "invariant" in known:
        data["invariant_errors"] = ("invariant", "t"), invariant_errors(result)
    if "constraint" in known:
        data["constraint_rank"] = ("t",), result.multipliers.rank
    if time != "t":
        data = data.rename(t=time)
        data["t"] = (time,), data.y.sel(component="t").values
    return data


def to_dataframe(result: Any, names: Any = None) -> DataFrame:
    """Return a run as a `pandas.DataFrame`.

    Parameters
    ----------
    result, names
        As for `to_xarray`.

    Returns
    -------
    pandas.DataFrame
        Table indexed by ``t`` (by "s" if a component is named "t"), with a column for each component, then two for each
        invariant: for one named H, its value "H" and its error "H error" (the value minus the target). If a component
        is also named H, the columns are "invariant H" and "invariant H error". Columns of derivatives follow, such as
        "dx/dvy" of x with respect to the initial vy; see `to_xarray` for the names. A mechanical system adds its
        outputs, "output x" if there is a column x, and its multipliers, such as "multiplier g1'". Names that would
        still be equal get a number. The table of an ensemble is indexed by ``member``: a column for each component of
        the last state, then "t_end", "status", "message", "trusted", and "H max_residual" for each invariant.

    Raises
    ------
    ImportError
        If pandas is missing: ``pip install "eip_scipy[pandas]"``.
    ValueError
        As for `to_xarray`.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 10), method=EIPRK4, save_every=10)
    >>> list(run.to_dataframe().columns)
    ['x', 'y', 'vx', 'vy', 'H', 'H error', 'L', 'L error']
    """
    pandas = _library("pandas", "to_dataframe")
    of_members = hasattr(result, "trajectories")
    known = {"component": component_names(result, names, result.y.shape[1])} if of_members else labels(result, names)
    components = known["component"]
    time = time_name(components)
    columns: dict[str, Any] = dict(zip(components, result.y.T if of_members else np.asarray(result.y), strict=True))
    used = {time, *components}

    def add(name: str, values: Any, kind: str = "") -> str:
        columns[found := label(name, used, kind)] = values
        used.add(found)
        return found

    if of_members:
        add(f"{time}_end", result.t, "member")
        for name in ("status", "message", "trusted"):
            add(name, result[name], "member")
        for name, values in zip(result.names, result.max_residual.T, strict=True):
            add(f"{name} max_residual", values)
        return pandas.DataFrame(columns, pandas.Index(result.first + np.arange(len(result.y)), name="member"))
    if "invariant" in known:
        for name, values, errors in zip(known["invariant"], result.invariants, invariant_errors(result), strict=True):
            add(f"{add(name, values, 'invariant')} error", errors)
    for k, by in enumerate(known.get("column", ())):
        for i, name in enumerate(components):
            add(f"d{name}/d{by}", result.variations[:, i, k])
    for name in known.get("output", ()):
        add(name, result.outputs[name], "output")
    for k, name in enumerate(known.get("constraint", ())):
        add(f"multiplier {name}", result.multipliers.values[k])
    return pandas.DataFrame(columns, pandas.Index(result.t, name=time))


def invariant_errors(result: Any) -> np.ndarray:
    """Return the errors (l, m) of the invariants at the saved times; NaN for a `Balance`."""
    return result.invariants - np.asarray(result.target)[:, None]


def dataset(result: Any, fields: Mapping[str, Field], coordinates: dict[str, Any]) -> Dataset:
    """Return the `xarray.Dataset` of a result with `fields`, for the dimensions that have `coordinates`.

    If xarray is missing, ImportError says how to install it.
    """
    variables, attributes = {}, {}
    for name, field in fields.items():
        if field.dims and name not in coordinates and coordinates.keys() >= set(field.dims):
            if (value := getattr(result, name, None)) is not None:
                variables[field.table or name] = field.dims, _array(value)
        elif field.dims == () and name in result:
            value = result[name]  # NetCDF stores neither None nor booleans
            attributes[name] = np.nan if value is None else int(value) if isinstance(value, bool | np.bool_) else value
    return _library("xarray", "to_xarray").Dataset(variables, coordinates, attributes)


def _array(value: Any) -> np.ndarray:
    """Return the numbers or texts of a field as one array."""
    if isinstance(value, Multipliers):
        return value.values
    found = np.array(list(value.values())) if isinstance(value, dict) else np.asarray(value)
    return found.astype(str) if found.dtype == object else found


def _library(name: str, table: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ImportError(f'{table} needs {name}: pip install "eip_scipy[{name}]"', name=name) from error
