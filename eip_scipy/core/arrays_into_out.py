"""The array that a user's jitted function returns becomes the array that the step owns.

``return np.array([a, b])`` and ``out = np.empty(n); ...; return out`` allocate an array in each call, which takes more
time than the rest of a small function. `into_out` makes a copy of the function with a further argument, which takes the
place of the new array. A function that returns anything else does not compile in this form.
"""

from __future__ import annotations

import inspect
import types as python_types
from collections.abc import Iterator
from typing import Any

import numpy as np
from numba import njit, types
from numba.core import ir
from numba.core.caching import NullCache
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.errors import UnsupportedError
from numba.core.ir_utils import build_definitions, get_definition, guard
from numba.core.untyped_passes import IRProcessing
from numba.extending import overload

__all__ = ["into_out"]

OUT = "_out_of_the_step"
# A function whose compilation takes longer, in seconds, or that is read from a cache, is not compiled again.
LONGEST = 1.5
# Options of Numba that a copy takes over, because they change its results or its speed.
KEPT = ("fastmath", "error_model", "boundscheck")


def into_out(fun: Any) -> Any:
    """Return a copy of a jitted function that takes an array as its last argument, and writes its value there.

    Its values have the bits of those of `fun`. It compiles if each value of `fun` is a new array of one dimension and
    of the type of that argument, and raises ValueError in a call if it has another size.
    """
    source = fun.py_func
    if not isinstance(fun._cache, NullCache) or any(_seconds(known) > LONGEST for known in fun.overloads.values()):
        raise UnsupportedError("another copy would have to be compiled for too long")
    parameters = list(inspect.signature(source).parameters.values())
    if any(item.kind is not item.POSITIONAL_OR_KEYWORD or item.default is not item.empty for item in parameters):
        raise UnsupportedError("arguments with defaults")
    copied = python_types.FunctionType(source.__code__, source.__globals__, source.__name__, None, source.__closure__)
    further = inspect.Parameter(OUT, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    copied.__signature__ = inspect.Signature([*parameters, further])  # type: ignore[attr-defined]
    options = {name: fun.targetoptions[name] for name in KEPT if name in fun.targetoptions}
    return njit(copied, pipeline_class=_Compiler, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def _seconds(compiled: Any) -> float:
    """Return the time that the compilation of a function took."""
    return float((compiled.metadata or {}).get("timers", {}).get("compiler_lock", 0.0))


class _Compiler(CompilerBase):
    """Numba's compiler with the pass `_IntoOut` before all others on its intermediate representation (IR)."""

    def define_pipelines(self) -> list[Any]:
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.add_pass_after(_IntoOut, IRProcessing)
        manager.finalize()
        return [manager]


@register_pass(mutates_CFG=False, analysis_only=False)
class _IntoOut(FunctionPass):
    """Pass that replaces the new arrays that a function returns by its last argument."""

    _name = "arrays_into_out"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        function = state.func_ir
        function._definitions = build_definitions(function.blocks)
        ends = [block.terminator for block in function.blocks.values() if isinstance(block.terminator, ir.Return)]
        calls = [_returned_array(function, end) for end in ends]
        _require_alone(function, calls)
        for block in function.blocks.values():
            block.body = list(_replaced(function, block, calls))
        function._definitions = build_definitions(function.blocks)
        return True


def _returned_array(function: Any, end: Any) -> Any:
    """Return the call that makes the array that the statement `end` returns."""
    found = guard(get_definition, function, end.value)
    if isinstance(found, ir.Expr) and found.op == "cast":
        found = guard(get_definition, function, found.value)
    if _maker(function, found) is None:
        raise UnsupportedError("the function returns something else than a new array")
    return found


def _maker(function: Any, call: Any) -> Any:
    """Return the function of this module that replaces NumPy's in a call that makes an array; None for other values."""
    if not (isinstance(call, ir.Expr) and call.op == "call" and call.args and call.vararg is None):
        return None
    made = _value(function, call.func)
    by_dtype = len(call.args) == 2 or [name for name, _ in call.kws] == ["dtype"]
    if len(call.args) + len(call.kws) > 1 + by_dtype:
        return None
    if made in (np.empty, np.zeros):
        return empty_at if made is np.empty else zeros_at
    if made in (np.empty_like, np.zeros_like) and not by_dtype:
        return like_at if made is np.empty_like else zeros_like_at
    listed = guard(get_definition, function, call.args[0]) if made is np.array else None
    return empty_at if isinstance(listed, ir.Expr) and listed.op in ("build_list", "build_tuple") else None


def _value(function: Any, variable: Any) -> Any:
    """Return the object that a variable of the IR stands for: a global, a free variable, or a part of a module."""
    found = guard(get_definition, function, variable)
    if isinstance(found, ir.Global | ir.FreeVar):
        return found.value
    if isinstance(found, ir.Expr) and found.op == "getattr":
        module = _value(function, found.value)
        return getattr(module, found.attr, None) if isinstance(module, python_types.ModuleType) else None
    return None


def _require_alone(function: Any, calls: list[Any]) -> None:
    """Raise an error if more than one of the arrays may be made in a call of the function, as in a loop."""
    labels = [
        label
        for label, block in function.blocks.items()
        for statement in block.find_insts(ir.Assign)
        if any(statement.value is call for call in calls)
    ]
    after = [_reached(function.blocks, label) for label in labels]
    if len(set(labels)) < len(labels) or any(label in found for label in labels for found in after):
        raise UnsupportedError("more than one array may be made in a call")


def _reached(blocks: dict[int, Any], label: int) -> set[int]:
    """Return the labels of the blocks that may follow a block; its own if it is in a loop."""
    found: set[int] = set()
    waiting = list(blocks[label].terminator.get_targets())
    while waiting:
        follower = waiting.pop()
        if follower not in found:
            found.add(follower)
            waiting += blocks[follower].terminator.get_targets()
    return found


def _replaced(function: Any, block: Any, calls: list[Any]) -> Iterator[Any]:
    """Yield the statements of a block in which `calls` are replaced.

    The array is still returned: without a use of it Numba would leave out all that is written to it.
    """
    of_lists = [call for call in calls if _value(function, call.func) is np.array]
    lists = [guard(get_definition, function, call.args[0]) for call in of_lists]
    for statement in block.body:
        loc, value = statement.loc, getattr(statement, "value", None)
        if isinstance(value, ir.Expr) and any(value is known for known in calls):
            yield from _in_place(function, statement)
        elif isinstance(value, ir.Expr) and any(value is known for known in lists):
            yield ir.Assign(ir.Const(None, loc), statement.target, loc)
        else:
            yield statement


def _assigned(scope: Any, item: Any) -> Any:
    """Return a statement that assigns an item to a new variable."""
    return ir.Assign(item, scope.redefine("$into", item.loc), item.loc)


def _in_place(function: Any, statement: Any) -> Iterator[Any]:
    """Yield the statements that write to the last argument what the call in `statement` writes to a new array."""
    call, scope, loc, items = statement.value, statement.target.scope, statement.loc, list[Any]()
    maker, given = _maker(function, call), [*call.args, *(variable for _, variable in call.kws)]
    made = [_assigned(scope, ir.Global(maker.__name__, maker, loc))]
    if _value(function, call.func) is np.array:
        items = guard(get_definition, function, call.args[0]).items
        made.append(_assigned(scope, ir.Const(len(items), loc)))
        given[0] = made[-1].target
    if maker in (empty_at, zeros_at) and len(given) == 1:
        made.append(_assigned(scope, ir.Global("float64", np.float64, loc)))
        given.append(made[-1].target)
    yield from made
    yield ir.Assign(ir.Expr.call(made[0].target, [*given, scope.get(OUT)], (), loc), statement.target, loc)
    for k, item in enumerate(items):
        place = _assigned(scope, ir.Const(k, loc))
        yield from (place, ir.SetItem(statement.target, place.target, item, loc))


def empty_at(shape, dtype, out):
    """Return `out` as ``np.empty(shape, dtype)``; for compiled code only."""


def zeros_at(shape, dtype, out):
    """Return `out`, filled with zeros, as ``np.zeros(shape, dtype)``; for compiled code only."""


def like_at(a, out):
    """Return `out` as ``np.empty_like(a)``; for compiled code only."""


def zeros_like_at(a, out):
    """Return `out`, filled with zeros, as ``np.zeros_like(a)``; for compiled code only."""


@njit
def _of_size(size, out):
    if size != out.size:
        raise ValueError("an array of another size")
    return out


@njit
def _zeroed(out):
    for i in range(out.size):
        out[i] = 0.0
    return out


def _is_of(out: Any, dtype: Any) -> bool:
    return isinstance(out, types.Array) and out.ndim == 1 and out.dtype == dtype


@overload(empty_at)
def _empty_at(shape, dtype, out):
    if not _is_of(out, getattr(dtype, "dtype", None)):
        return None
    if isinstance(shape, types.UniTuple) and shape.count == 1:
        return lambda shape, dtype, out: _of_size(shape[0], out)
    return (lambda shape, dtype, out: _of_size(shape, out)) if isinstance(shape, types.Integer) else None


@overload(zeros_at)
def _zeros_at(shape, dtype, out):
    return lambda shape, dtype, out: _zeroed(empty_at(shape, dtype, out))


@overload(like_at)
def _like_at(a, out):
    known = isinstance(a, types.Array) and a.ndim == 1 and _is_of(out, a.dtype)
    return (lambda a, out: _of_size(a.size, out)) if known else None


@overload(zeros_like_at)
def _zeros_like_at(a, out):
    return lambda a, out: _zeroed(like_at(a, out))
