"""Runs as labelled tables: xarray's Dataset and pandas' DataFrame, of results of `integrate` and of `solve_ivp`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.problem import component_names as checked

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

__all__ = ["component_names", "dataset", "default_names", "invariant_rows", "of_members", "to_dataframe", "to_xarray"]

TABLES = {"xarray": "xarray", "pandas": "dataframe"}
# Of a result what describes the whole run, in the order of an attribute list.
DESCRIBED = (
    "method", "h", "message", "trusted", "status", "success", "nfev", "njev", "nlu", "wall_time", "compiled", "units",
)  # fmt: skip


def to_xarray(result: Any, names: Any = None) -> Dataset:
    """A run as an `xarray.Dataset`.

    Parameters
    ----------
    result : IntegrationResult, OdeResult or EnsembleResult
        From `integrate`, `scipy.integrate.solve_ivp` or `ensemble`, whose table is that of ``result.to_xarray()``.
    names : sequence of str or str, optional
        Names of the components, as a list or as ``"x y vx vy"``. Default: those of the run's `Problem`, else "y0", "y1"
        and so on.

    Returns
    -------
    xarray.Dataset
        ``y`` (component, t) with the coordinates ``component`` and ``t``: ``data.y.sel(component="x")``. With
        invariants ``invariants`` and ``invariant_errors``, I - target, both (invariant, t), and ``max_defect``. With
        derivatives ``variations`` (t, component, column); a column is named after the component of the initial state or
        the parameter that it is the derivative by, or 0, 1 and so on. Its
        attributes are method, h (nan: adaptive steps), message, trusted (1 or 0) and the like, as far as there are any.

    Raises
    ------
    ImportError
        Without xarray: ``pip install "eip_scipy[xarray]"``.
    ValueError
        When there are not as many names as components, or two are the same.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.results import to_xarray
    >>> from eip_scipy.problems import kepler
    >>> data = to_xarray(integrate(kepler(), (0, 10), method=EIPRK4, save_every=10))
    >>> data.y.dims, data.component.values.tolist(), data.attrs["method"]
    (('component', 't'), ['x', 'y', 'vx', 'vy'], 'EIPRK4')
    """
    if of_members(result):
        return result.to_xarray(names)
    variables: dict[str, Any] = {"y": (("component", "t"), np.asarray(result.y))}
    coordinates: dict[str, Any] = {"t": np.asarray(result.t), "component": list(component_names(result, names))}
    rows = invariant_rows(result)
    if rows:
        coordinates["invariant"] = list(rows)
        both = np.array(list(rows.values()))
        variables["invariants"] = (("invariant", "t"), both[:, 0])
        variables["invariant_errors"] = (("invariant", "t"), both[:, 1])
        variables["max_defect"] = (("invariant",), np.asarray(result.max_defect))
    if "variations" in result:
        coordinates["column"] = column_names(result, coordinates["component"])
        variables["variations"] = (("t", "component", "column"), np.asarray(result.variations))
    attributes = {name: result[name] for name in DESCRIBED if name in result}
    return dataset(variables, coordinates, attributes)


def to_dataframe(result: Any, names: Any = None) -> DataFrame:
    """A run as a `pandas.DataFrame`.

    Parameters
    ----------
    result, names
        As for `to_xarray`.

    Returns
    -------
    pandas.DataFrame
        Indexed by ``t``: a column for each component, then for each invariant its value, "H", and "H error", the value
        less the target. Where a component has the name of an invariant, the latter is "invariant H". Last come
        derivatives, "dx/dvy" of x by the initial vy; see `to_xarray` for the names. Of an ensemble
        indexed by ``member``: a column for each component of the last state, then "t_end", "status", "message",
        "trusted", and "H max_defect" for each invariant.

    Raises
    ------
    ImportError
        Without pandas: ``pip install "eip_scipy[pandas]"``.
    ValueError
        As by `to_xarray`.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 10), method=EIPRK4, save_every=10)
    >>> list(run.to_dataframe().columns)
    ['x', 'y', 'vx', 'vy', 'H', 'H error', 'L', 'L error']
    """
    try:
        import pandas
    except ModuleNotFoundError as error:
        raise _missing("pandas", error) from error
    if of_members(result):
        members = pandas.Index(result.first + np.arange(len(result.y)), name="member")
        return pandas.DataFrame(_member_columns(result, names), index=members)
    columns = dict(zip(component_names(result, names), np.asarray(result.y), strict=True))
    for name, (values, errors) in invariant_rows(result).items():
        label = f"invariant {name}" if name in columns else name
        columns |= {label: values, f"{label} error": errors}
    if "variations" in result:
        components = component_names(result, names)
        for k, by in enumerate(column_names(result, components)):
            columns |= {f"d{name}/d{by}": result.variations[:, i, k] for i, name in enumerate(components)}
    return pandas.DataFrame(columns, index=pandas.Index(result.t, name="t"))


def of_members(result: Any) -> bool:
    """Return whether a result is that of an ensemble, whose states are (members, components)."""
    return "trajectories" in result


def _member_columns(result: Any, names: Any) -> dict[str, np.ndarray]:
    labels = component_names(result, names, result.y.shape[1])
    columns = dict(zip(labels, result.y.T, strict=True))
    columns |= {"t_end": result.t, "status": result.status, "message": result.message, "trusted": result.trusted}
    return columns | {f"{name} max_defect": result.max_defect[:, k] for k, name in enumerate(result.names)}


def invariant_rows(result: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of each invariant of a result the values and the errors at the saved times, (m,) both, by a name of its own."""
    if "invariants" not in result:
        return {}
    rows: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for k, (name, values) in enumerate(zip(result.diagnostics.names, result.invariants, strict=True)):
        rows[f"{name} ({k})" if name in rows else name] = values, values - result.target[k]
    return rows


def column_names(result: Any, components: Sequence[str]) -> list[str]:
    """Return of each column of derivatives what it is by: a component, a parameter, or the column's number."""
    known = result.get("columns", {})
    names = [*(components if known.get("state") else ()), *known.get("names", ())]
    count = result.variations.shape[2]
    return names if len(names) == count else [str(k) for k in range(count)]


def component_names(result: Any, names: Any = None, n: int | None = None) -> tuple[str, ...]:
    """The names given, else a result's own, else "y0", "y1" and so on; `n` of them, default: a row of y for each."""
    n = len(result.y) if n is None else n
    if names is None:
        names = getattr(result, "component_names", None)
    return default_names(n) if names is None else checked(names, n)


def default_names(n: int) -> tuple[str, ...]:
    """y0, y1 and so on."""
    return tuple(f"y{k}" for k in range(n))


def dataset(variables: dict[str, Any], coordinates: dict[str, Any], attributes: dict[str, Any]) -> Dataset:
    """A Dataset, where xarray is there.

    Raises
    ------
    ImportError
        Naming the extra.
    """
    try:
        import xarray
    except ModuleNotFoundError as error:
        raise _missing("xarray", error) from error
    return xarray.Dataset(variables, coordinates, {name: _attribute(value) for name, value in attributes.items()})


def _attribute(value: Any) -> Any:
    """The value as NetCDF and Zarr store it, which have neither None nor booleans among attributes."""
    if value is None:
        return np.nan
    return int(value) if isinstance(value, (bool, np.bool_)) else value


def _missing(library: str, error: ModuleNotFoundError) -> ImportError:
    if error.name != library:
        raise error
    return ImportError(f'to_{TABLES[library]} needs {library}: pip install "eip_scipy[{library}]"', name=library)
