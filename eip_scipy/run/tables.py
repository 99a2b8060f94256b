"""Conversion of results of `integrate` and `solve_ivp` to labelled tables: xarray's Dataset and pandas' DataFrame."""

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
# Fields that describe the whole run, in the order of the attributes.
DESCRIBED = (
    "method", "h", "message", "trusted", "status", "success", "nfev", "njev", "nlu", "wall_time", "compiled", "units",
)  # fmt: skip


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
        invariants, also ``invariants`` and ``invariant_errors`` (I - target), both (invariant, t), and ``max_residual``.
        If it has derivatives, also ``variations`` (t, component, column); a column is named after the component of the
        initial state or the parameter with respect to which it is the derivative, or 0, 1 and so on. A mechanical
        system adds ``outputs`` (output, t), ``multipliers`` (constraint, t) and ``constraint_rank`` (t,). Attributes
        are method, h (nan for adaptive steps), message, trusted (1 or 0) and others that the result has.

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
        variables["max_residual"] = (("invariant",), np.asarray(result.max_residual))
    if "variations" in result:
        coordinates["column"] = column_names(result, coordinates["component"])
        variables["variations"] = (("t", "component", "column"), np.asarray(result.variations))
    outputs, multipliers = getattr(result, "outputs", None), getattr(result, "multipliers", None)
    if outputs is not None:
        coordinates["output"] = list(outputs)
        variables["outputs"] = (("output", "t"), np.array(list(outputs.values())))
    if multipliers is not None:
        coordinates["constraint"] = list(multipliers.names)
        variables["multipliers"] = (("constraint", "t"), multipliers.values)
        variables["constraint_rank"] = (("t",), multipliers.rank)
    attributes = {name: result[name] for name in DESCRIBED if name in result}
    return dataset(variables, coordinates, attributes)


def to_dataframe(result: Any, names: Any = None) -> DataFrame:
    """Return a run as a `pandas.DataFrame`.

    Parameters
    ----------
    result, names
        As for `to_xarray`.

    Returns
    -------
    pandas.DataFrame
        Table indexed by ``t``, with a column for each component, then two for each invariant: for one named H, its
        value "H" and its error "H error" (the value minus the target). If a component is also named H, the columns are
        "invariant H" and "invariant H error". Columns of derivatives follow, such as "dx/dvy" of x with respect to the
        initial vy; see `to_xarray` for the names. A mechanical system adds its outputs, "output x" if there is a column
        x, and its multipliers, such as "multiplier g1'". The table of an ensemble is indexed by ``member``: a column
        for each component of the last state, then "t_end", "status", "message", "trusted", and "H max_residual" for each
        invariant.

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
    try:
        import pandas
    except ModuleNotFoundError as error:
        raise _missing("pandas", error) from error
    if of_members(result):
        columns = dict(zip(component_names(result, names, result.y.shape[1]), result.y.T, strict=True))
        columns |= {"t_end": result.t, "status": result.status, "message": result.message, "trusted": result.trusted}
        columns |= {f"{name} max_residual": result.max_residual[:, k] for k, name in enumerate(result.names)}
        members = pandas.Index(result.first + np.arange(len(result.y)), name="member")
        return pandas.DataFrame(columns, index=members)
    columns = dict(zip(component_names(result, names), np.asarray(result.y), strict=True))
    for name, (values, errors) in invariant_rows(result).items():
        label = f"invariant {name}" if name in columns else name
        columns |= {label: values, f"{label} error": errors}
    if "variations" in result:
        components = component_names(result, names)
        for k, by in enumerate(column_names(result, components)):
            columns |= {f"d{name}/d{by}": result.variations[:, i, k] for i, name in enumerate(components)}
    for name, row in (getattr(result, "outputs", None) or {}).items():
        columns[f"output {name}" if name in columns else name] = row
    if (multipliers := getattr(result, "multipliers", None)) is not None:
        columns |= {f"multiplier {name}": row for name, row in zip(multipliers.names, multipliers.values, strict=True)}
    return pandas.DataFrame(columns, index=pandas.Index(result.t, name="t"))


def of_members(result: Any) -> bool:
    """Return True if a result is that of an ensemble, whose states are (members, components)."""
    return "trajectories" in result


def invariant_rows(result: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return values and errors (m,) of each invariant at the saved times; the keys are distinct names."""
    if "invariants" not in result:
        return {}
    rows: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for k, (name, values) in enumerate(zip(result.diagnostics.names, result.invariants, strict=True)):
        rows[f"{name} ({k})" if name in rows else name] = values, values - result.target[k]
    return rows


def column_names(result: Any, components: Sequence[str]) -> list[str]:
    """Return the name of each column of derivatives: a component, a parameter, or the column's number."""
    known = result.get("columns", {})
    names = [*(components if known.get("state") else ()), *known.get("names", ())]
    count = result.variations.shape[2]
    return names if len(names) == count else [str(k) for k in range(count)]


def component_names(result: Any, names: Any = None, n: int | None = None) -> tuple[str, ...]:
    """Return the `n` names of components: `names`, by default those of the result, else "y0", "y1" and so on.

    By default `n` is len(result.y). ValueError is raised if `names` are not `n` different names.
    """
    n = len(result.y) if n is None else n
    if names is None:
        names = getattr(result, "component_names", None)
    return default_names(n) if names is None else checked(names, n)


def default_names(n: int) -> tuple[str, ...]:
    """Return the names y0, y1 and so on."""
    return tuple(f"y{k}" for k in range(n))


def dataset(variables: dict[str, Any], coordinates: dict[str, Any], attributes: dict[str, Any]) -> Dataset:
    """Return an `xarray.Dataset`; if xarray is missing, raise ImportError that says how to install it."""
    try:
        import xarray
    except ModuleNotFoundError as error:
        raise _missing("xarray", error) from error
    return xarray.Dataset(variables, coordinates, {name: _attribute(value) for name, value in attributes.items()})


def _attribute(value: Any) -> Any:
    """Return an attribute in a form that NetCDF can store: NaN for None, and 1 or 0 for a boolean."""
    if value is None:
        return np.nan
    return int(value) if isinstance(value, (bool, np.bool_)) else value


def _missing(library: str, error: ModuleNotFoundError) -> ImportError:
    if error.name != library:
        raise error
    return ImportError(f'to_{TABLES[library]} needs {library}: pip install "eip_scipy[{library}]"', name=library)
