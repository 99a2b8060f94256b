"""The fields of results: their dimensions, how two parts of a run are joined, their labels, and tables of them."""

from __future__ import annotations

import operator
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from importlib import import_module
from itertools import chain, count
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.integrate import OdeSolution

from ..core.event_derivatives import EVENT_DERIVATIVES
from ..core.problem import component_names as checked
from ..core.results import Diagnostics, Multipliers
from ..core.tangent_vectors import StateSolution

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

__all__ = [
    "FIELDS", "OBSERVED", "OF_EVENTS", "Field", "component_names", "dataset", "distinct", "invariant_errors", "joined",
    "labels", "rows", "time_name", "to_dataframe", "to_xarray",
]  # fmt: skip


OF_EVENTS = ("t_events", "y_events", *EVENT_DERIVATIVES)
OBSERVED = ("outputs", "multipliers")  # computed when they are first requested


class Growing:
    """An array that grows along its first axis; `used` rows belong to results.

    The results of a loop of continued runs are views of the same array, so that the loop takes linear time.
    """

    def __init__(self, rows: int, like: np.ndarray, dtype: Any) -> None:
        self.array, self.used = np.empty((rows, *like.shape[1:]), dtype), 0

    def ends_with(self, view: np.ndarray, rows: int, like: np.ndarray) -> bool:
        """Return True if `view` is all that is used, and there is room for `rows` rows like those of `like`."""
        own, other = self.array, view.__array_interface__["data"][0]
        fits = own.shape[1:] == like.shape[1:] == view.shape[1:] and own.dtype == np.result_type(view, like)
        is_view = own.__array_interface__["data"][0] == other and own.strides == view.strides
        return fits and is_view and self.used == len(view) and self.used + rows <= len(own)

    def append(self, rows: np.ndarray) -> None:
        """Append rows, for which there is room."""
        self.array[self.used : self.used + len(rows)] = rows
        self.used += len(rows)


class Join(NamedTuple):
    """The way in which two parts of a run are joined.

    The first `skip` rows of the second part, the state where both meet, are left out. `grown` has the arrays of the
    first result that grow, and gets those of the joined one. `rows` are the numbers of rows of both parts.
    """

    skip: int
    grown: dict[str, Growing]
    rows: tuple[int, int]

    def along(self, key: str, one: np.ndarray, two: np.ndarray, axis: int = 0, skip: int | None = None) -> np.ndarray:
        """Return two arrays concatenated along an axis; `key` names the array that grows."""
        one, two = one.swapaxes(0, axis), two.swapaxes(0, axis)[self.skip if skip is None else skip :]
        found = self.grown.get(key)
        if found is None or not found.ends_with(one, len(two), two):
            count = len(one) + len(two)
            found = self.grown[key] = Growing(8 + count + count // 2, two, np.result_type(one, two))
            found.append(one)
        found.append(two)
        return found.array[: found.used].swapaxes(0, axis)


JoinFunction = Callable[[str, Any, Any, Join], Any]


def _last(name: str, one: Any, two: Any, join: Join) -> Any:
    return two


def _by(function: Callable[[Any, Any], Any]) -> JoinFunction:
    return lambda name, one, two, join: function(one, two)


def _rows(axis: int) -> JoinFunction:
    return lambda name, one, two, join: join.along(name, one, two, axis)


def _by_event(name: str, one: Any, two: Any, join: Join) -> Any:
    """Return what was recorded for each event; an array without events may have another shape."""
    if one is None or two is None:
        return two
    pairs = enumerate(zip(one, two, strict=True))
    return [join.along(f"{name} {k}", a, b, skip=0) if a.size and b.size else b if b.size else a for k, (a, b) in pairs]


def _outputs(name: str, one: dict[str, Any], two: dict[str, Any], join: Join) -> Any:
    """Return the outputs of both parts, which are NaN in a part that does not have them."""

    def of(part: dict[str, Any], key: str, rows: int) -> Any:
        return part[key] if key in part else np.full(rows, np.nan)

    ends, keys = join.rows, dict.fromkeys([*one, *two])
    return {key: join.along(f"{name} {key}", of(one, key, ends[0]), of(two, key, ends[1])) for key in keys}


def _multipliers(name: str, one: Multipliers, two: Multipliers, join: Join) -> Any:
    first, second = (dict(zip(distinct(part.names), part.values, strict=True)) for part in (one, two))
    values = _outputs(name, first, second, join)
    return Multipliers(tuple(values), np.array([*values.values()]), join.along(f"{name} rank", one.rank, two.rank))


def _solution(name: str, one: OdeSolution | None, two: OdeSolution | None, join: Join) -> OdeSolution | None:
    if one is None or two is None:
        return None
    if one.t_min == one.t_max:  # a part without steps
        return two
    known, count = one.interpolants, len(one.ts) - 1
    if type(known) is not list or len(known) > count:
        known = [*known[:count]]
    known.extend(two.interpolants)  # `one` does not see interpolants beyond its own times
    both = OdeSolution(join.along(name, one.ts, two.ts, skip=1), known)
    return StateSolution(both, two.tangents) if isinstance(two, StateSolution) else both


class Field(NamedTuple):
    """The declaration of a field of a result.

    `dims` are its dimensions in tables, () for a number or text that describes the whole run, None if tables leave it
    out. ``join(name, one, two, how)`` returns the field of a run and its continuation, by default that of the
    continuation. `table` is the name in tables, if it is another one, and `unset` the value for a member of an ensemble
    that did not run. A field of each invariant is `absent` in a part of a run that does not have this invariant.
    """

    dims: tuple[str, ...] | None = None
    join: JoinFunction = _last
    table: str = ""
    unset: Any = None
    absent: float | None = None


def _target(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    return np.where(np.isnan(two), one, two)


FIELDS = {
    "t": Field(("t",), _rows(0)),
    "y": Field(("component", "t"), _rows(1)),
    "invariants": Field(("invariant", "t"), _rows(1), absent=np.nan),
    "targets": Field(("invariant", "t"), _rows(1), absent=np.nan),
    "target": Field(None, _by(_target), absent=np.nan),
    "max_residual": Field(("invariant",), _by(np.fmax), absent=0.0),
    "variations": Field(("t", "component", "column"), _rows(0)),
    "encounters": Field(None, _by(lambda one, two: np.concatenate([one, two]))),
    "outputs": Field(("output", "t"), _outputs),
    "multipliers": Field(("constraint", "t"), _multipliers),
    **dict.fromkeys(("method", "h", "message", "status", "success", "units"), Field(())),
    **dict.fromkeys(("trusted", "compiled"), Field((), _by(operator.and_))),
    **dict.fromkeys(("nfev", "njev", "nlu", "wall_time"), Field((), _by(operator.add))),
    **dict.fromkeys(OF_EVENTS, Field(None, _by_event)),
    **dict.fromkeys(("calls", "columns", "epoch"), Field(None)),
    "component_names": Field(None, lambda name, one, two, join: one),  # the user may have assigned others
    "sol": Field(None, _solution),
    "diagnostics": Field(None, _by(Diagnostics.followed_by)),
    "restarts": Field(None, _by(operator.add)),
}
# Axis of t of the fields along t that a run always has.
ALONG = {
    name: field.dims.index("t") for name, field in FIELDS.items()
    if field.dims and "t" in field.dims and field.join not in (_outputs, _multipliers)
}  # fmt: skip


def rows(result: Any, part: slice) -> dict[str, np.ndarray]:
    """Return the fields along t of a result, with the saved times in `part` only."""
    return {name: result[name][(slice(None),) * axis + (part,)] for name, axis in ALONG.items() if name in result}


def joined(one: Any, two: Any, grown: dict[str, Growing], *, apart: bool, but: Sequence[str] = ()) -> dict[str, Any]:
    """Return the fields of a run and its continuation together; those in `but` are of the continuation alone.

    The state where both meet is stored once, or twice if the parts are `apart`, because something has changed there.
    """
    assert two.keys() <= FIELDS.keys()  # a field that is not declared would be that of the continuation alone
    one, two = _with_all_invariants(dict(one), dict(two))
    if "targets" in one or not np.array_equal(one["target"], two["target"], equal_nan=True):
        for part in (one, two):
            part.setdefault("targets", np.broadcast_to(part["target"][:, None], part["invariants"].shape))
    meet = not apart and one["t"].size and two["t"].size and two["t"][0] == one["t"][-1]
    how = Join(int(bool(meet)), grown, (one["t"].size, two["t"].size))
    for part, other in ((one, two), (two, one)):  # systems of different kinds
        if "outputs" in other:
            part.setdefault("outputs", {})
        if "multipliers" in other:
            rows = part["t"].size
            part.setdefault("multipliers", Multipliers((), np.zeros((0, rows)), np.zeros(rows, int)))
    found = {name: value for name, value in two.items() if name in but or name not in one}
    return found | {name: FIELDS[name].join(name, one[name], two[name], how) for name in two.keys() - found.keys()}


def _with_all_invariants(one: dict[str, Any], two: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the fields of two parts of a run with the invariants of both, those of the first part first."""
    known = [distinct(part["diagnostics"].names) for part in (one, two)]
    if known[0] == known[1]:
        return one, two
    names = list(dict.fromkeys(known[0] + known[1]))
    for part, own in zip((one, two), known, strict=True):
        places = [names.index(name) for name in own]
        for name, field in FIELDS.items():
            if field.absent is not None and name in part:
                whole = np.full((len(names), *part[name].shape[1:]), field.absent)
                whole[places] = part[name]
                part[name] = whole
        part["diagnostics"] = part["diagnostics"].spread(names, places)
    return one, two


# Labels.


def label(name: str, used: Container[str], kind: str = "") -> str:
    """Return `name`, or if it is `used` already, the name behind its `kind` or with a number."""
    longer = [f"{kind} {name}"] if kind else []
    return next(text for text in chain([name], longer, (f"{name} ({k})" for k in count(1))) if text not in used)


def distinct(names: Iterable[str]) -> list[str]:
    """Return labels for names, of which some may be equal."""
    found: dict[str, None] = {}
    for name in names:
        found[label(name, found)] = None
    return list(found)


def time_name(components: Container[str]) -> str:
    """Return the label of the independent variable: "t", or "s" if a component of the state is the time "t"."""
    return label("s" if "t" in components else "t", components)


def component_names(result: Any, names: Any = None, n: int | None = None) -> tuple[str, ...]:
    """Return the `n` names of components: `names`, by default those of the result, else "y0", "y1" and so on.

    By default `n` is len(result.y). ValueError is raised if `names` are not `n` different names.
    """
    n = len(result.y) if n is None else n
    return checked(getattr(result, "component_names", None) if names is None else names, n)


def labels(result: Any, names: Any = None) -> dict[str, list[str]]:
    """Return distinct labels along each dimension of a run except t; `names` are those of the components."""
    components = list(component_names(result, names))
    found = {"component": components}
    if "invariants" in result and len(result.invariants):
        found["invariant"] = distinct(result.diagnostics.names)
    if "variations" in result:
        known = result.get("columns", {})
        columns = [*(components if known.get("state") else ()), *known.get("names", ())]
        count = result.variations.shape[2]
        found["column"] = distinct(columns) if len(columns) == count else [str(k) for k in range(count)]
    if (outputs := getattr(result, "outputs", None)) is not None:
        found["output"] = list(outputs)
    if (multipliers := getattr(result, "multipliers", None)) is not None:
        found["constraint"] = distinct(multipliers.names)
    return found


# Tables.


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

    See Also
    --------
    to_dataframe, save

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

    See Also
    --------
    to_xarray, save

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
    return result.invariants - (result["targets"] if "targets" in result else np.asarray(result.target)[:, None])


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
