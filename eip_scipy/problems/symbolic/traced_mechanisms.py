"""Construction of the parts of a mechanism from functions that are converted to expressions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import sympy

from ..multibody.numerical import outputs_as_given
from ..multibody.parts import Given, Parts
from ..multibody.start import Names
from .constrained import Constrained, conservative, cyclic, own_speed, parts_of
from .parser import symbol
from .traced import NotTraceableError, traced

__all__ = ["traced_parts"]

# Relative bound for the difference between a traced function and the function itself at the start.
AGREES = 1e-9


def traced_parts(given: Given, names: Names, t: float, q: np.ndarray, u: np.ndarray) -> Parts:
    """Return the `Parts` of a mechanism, made from expressions for the functions that `mechanism` was given.

    NotTraceableError is raised if a function cannot be converted, or its expression has another value at the start.
    """
    by_name = {"t": ("t", t), "q": (names.coordinates, q), "u": (names.speeds, u)}

    def expressions(what: str, arguments: str) -> tuple[Any, ...]:
        fun = getattr(given, what)
        if fun is None:
            return ()
        symbols, numbers = zip(*(by_name[letter] for letter in arguments), strict=True)
        found = traced(what, fun, *symbols).ravel()
        _require_agreement(what, found, fun(*numbers), names, (t, q, u))
        return tuple(found)

    speeds = [symbol(name) for name in names.speeds]
    system = Constrained(
        names.coordinates,
        names.speeds,
        (),
        expressions("kinematics", "tqu") or tuple(speeds),
        expressions("mass", "q"),
        expressions("forces", "tqu"),
        expressions("constraints", "tq"),
        expressions("velocity_constraints", "tqu"),
    ).with_velocities()
    power = (expressions("power", "tqu") or (None,))[0]
    energies = []
    M, column = sympy.Matrix(len(speeds), len(speeds), system.mass), sympy.Matrix(speeds)
    kinetic = (column.T * M * column)[0] / 2
    if given.energy is not None:
        energies.append(("energy", expressions("energy", "tqu")[0], power))
    elif given.potential is not None:
        energies.append(("u M u / 2 + potential", kinetic + expressions("potential", "tq")[0], power))
    elif (potential := conservative(system, system.forces, partial(own_speed, system))) is not None:
        energies.append(("u M u / 2 + the potential of the forces", kinetic + potential, power))
    parts = parts_of(system, energies, tuple(_momenta(system)), _outputs(given, by_name))
    called = given.outputs and parts.outputs is None
    return parts._replace(outputs=outputs_as_given(given, q.size, u.size)) if called else parts


def _momenta(system: Constrained) -> Iterator[tuple[str, Any]]:
    """Yield the name and the expression of the momentum of each coordinate that may be cyclic."""
    n = len(system.speeds)
    momenta = sympy.Matrix(n, n, system.mass) * sympy.Matrix([symbol(name) for name in system.speeds])
    for k in cyclic(system, partial(own_speed, system)):
        yield f"p_{system.coordinates[k]}", sympy.Matrix([own_speed(system, k)]).dot(momenta)


def _outputs(given: Given, by_name: Any) -> list[tuple[str, Any]]:
    """Return the name and the expression of each output; [] if one cannot be converted, or differs at the start."""
    symbols, numbers = zip(*(by_name[letter] for letter in "tqu"), strict=True)
    names = Names(by_name["q"][0], by_name["u"][0], (), ())
    found = []
    for name, fun in given.outputs.items():
        try:
            item = traced(name, fun, *symbols).ravel()
            _require_agreement(name, item, fun(*numbers), names, numbers)
        except NotTraceableError:
            return []
        found.append((name, item[0]))
    return found


def _require_agreement(what: str, found: Any, value: Any, names: Names, numbers: Any) -> None:
    """Raise NotTraceableError if the expressions `found` do not have the `value` of the function at the start."""
    t, q, u = numbers
    values = {symbol("t"): t, **{symbol(k): x for k, x in zip(names.state, (*q, *u), strict=True)}}
    wanted = np.asarray(value, float).ravel()
    own = np.array([float(sympy.sympify(item).xreplace(values)) for item in found])
    if not np.allclose(own, wanted, rtol=AGREES, atol=AGREES * max(1.0, np.abs(wanted).max(initial=0.0))):
        raise NotTraceableError(f"{what}: its value depends on more than its arguments")
