"""Coefficients as class attributes, as in SciPy's RungeKutta: set on EIP classes, read from those of other packages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.integrate import RK45, OdeSolver

from ..methods.runge_kutta import FLOAT_TOLERANCE, Tableau, order_residuals

__all__ = ["NAMES", "attributes_of", "is_same", "tableau_of"]

NAMES = ("order", "error_estimator_order", "n_stages", "A", "B", "C", "E", "P", "E3", "E5")
# Names of the order of the embedded method, in SciPy and in other packages.
EMBEDDED = ("error_estimator_order", "order_secondary")
# The methods that make a step of SciPy's classes from their coefficients.
STEP = ("_step_impl", "_estimate_error", "_estimate_error_norm")
WANTED = "a subclass of SciPy's RungeKutta such as RK45, or a class with the same attributes"
LEAST_ORDER = 2  # of dense output


def attributes_of(method: Any, scipy_class: type[OdeSolver] | None) -> dict[str, Any]:
    """Return a method's attributes of SciPy's RungeKutta by name, those of `scipy_class` if given."""
    if scipy_class is not None:
        return {name: getattr(scipy_class, name, NotImplemented) for name in NAMES}
    found: dict[str, Any] = dict.fromkeys(NAMES, NotImplemented)
    for name in ("order", "error_estimator_order", "n_stages"):
        value = getattr(method, name, None)
        if value is not None:
            found[name] = value
    if method.of_second_order or method.in_python:
        return found
    found |= {"A": method.A, "B": method.b, "C": method.c}
    if method.paired:
        found |= {"E5": method.e, "E3": method.e_low}
    elif method.has_estimate:
        found["E"] = -method.e  # SciPy's are the embedded weights less those of the step
    if method.P is not None:
        found["P"] = method.P
    return found


def tableau_of(solver: type[OdeSolver]) -> Tableau:
    """Return a tableau with the coefficients of a solver class of another package, without its step control."""
    name = solver.__name__
    A, b, c = (_array(solver, attribute) for attribute in "ABC")
    order = getattr(solver, "order", None)
    if A is None or b is None or c is None or not isinstance(order, int):
        raise TypeError(
            f"eip_method: {name} has no coefficients A, B, C and order, which define an explicit Runge-Kutta method. "
            "Of the other solvers only SciPy's Radau and BDF can be projected, as EIPRadau and EIPBDF. Use one "
            f"of these two, or give {WANTED}, or a Tableau."
        )
    if _array(solver, "Bp") is not None:
        raise TypeError(f"eip_method: {name} is a Runge-Kutta-Nystrom method; give its coefficients as NystromTableau.")
    _require_plain_steps(solver)
    weights, reference = _array(solver, "E"), f"the class {solver.__module__}.{solver.__qualname__}"
    given: dict[str, Any] = {"c": _floats(c), "reference": reference}
    if weights is None and _array(solver, "E5") is not None:
        raise TypeError(
            f"eip_method: the estimate of {name} has two parts, E5 and E3, as that of SciPy's DOP853. Use EIPDOP853 "
            "for DOP853, and give other coefficients as Tableau(..., b_hat=..., e_low=...)."
        )
    if weights is not None:
        if not weights.any():
            raise TypeError(
                f"eip_method: the error weights E of {name} are all 0, so {name} does not compute its error estimate "
                "from E. Give a Tableau with the weights b_hat of the embedded method."
            )
        b_hat = np.append(b, np.zeros(weights.size - b.size)) + weights
        given["b_hat"] = _floats(b_hat if weights[-1] != 0 else b_hat[: b.size])
        orders = (getattr(solver, attribute, None) for attribute in EMBEDDED)
        given["error_estimator_order"] = next((found for found in orders if isinstance(found, int)), None)
    found = Tableau(name, _floats(A), _floats(b), order, **given)
    P = _array(solver, "P")
    if P is None or P.shape[0] != b.size + 1:  # other rows belong to further stages; the default is a cubic
        return found
    _check_dense_output(found, P)
    return Tableau(name, _floats(A), _floats(b), order, P=_floats(P), **given)


def is_same(solver: type[OdeSolver], own: type[OdeSolver]) -> bool:
    """Return True if `solver` is a subclass of `own` with the same coefficients and the same methods in `STEP`."""
    if not issubclass(solver, own) or _own_functions(solver, own):
        return False
    pairs: Any = ((getattr(solver, name, None), getattr(own, name, None)) for name in NAMES)
    return all(one is other or np.array_equal(one, other) for one, other in pairs)


def _array(solver: type, name: str) -> np.ndarray | None:
    value = getattr(solver, name, None)
    return value if isinstance(value, np.ndarray) and value.size else None


def _floats(values: np.ndarray) -> Any:
    return values.astype(float).tolist()


def _require_plain_steps(solver: type[OdeSolver]) -> None:
    """Raise TypeError if a subclass of SciPy's RungeKutta, without `E5`, has its own method of those in `STEP`."""
    base: Any = RK45.__bases__[0]
    own = _own_functions(solver, base) if issubclass(solver, base) and _array(solver, "E5") is None else []
    if own:
        raise TypeError(
            f"eip_method: {solver.__name__} has its own {own[0]}, but eip_method reads only the coefficients, so that "
            "its steps would differ from those of the class. Give a Tableau, or an object with one_step(t, y, h) and "
            "order."
        )


def _own_functions(solver: type[OdeSolver], base: type[OdeSolver]) -> list[str]:
    return [name for name in STEP if getattr(solver, name, None) is not getattr(base, name, None)]


def _check_dense_output(tableau: Tableau, P: np.ndarray) -> None:
    """Raise ValueError unless `P` gives the step's result at its end, and has order `LEAST_ORDER` inside it."""
    if max(_misses(tableau, P)) > np.sqrt(FLOAT_TOLERANCE):
        raise ValueError(
            f"eip_method: the dense output P of {tableau.name} does not belong to its steps. Each row of P must sum "
            "to the weight of its stage in B (0 for the last row), and inside the step P must meet the order "
            f"conditions; the largest error is {max(_misses(tableau, P)):.3g}. Correct P."
        )


def _misses(tableau: Tableau, P: np.ndarray) -> Iterator[float]:
    s = tableau.n_stages
    A = np.zeros((s + 1, s + 1))
    A[:s, :s], A[s, :s] = tableau.A, tableau.b
    yield float(np.abs(P.sum(axis=1) - np.append(tableau.b, 0.0)).max())
    for theta in (0.25, 0.5, 0.75):
        weights = P @ theta ** np.arange(1, P.shape[1] + 1)
        for tree, residual in order_residuals(A, weights, LEAST_ORDER):
            # sum_i b_i(theta) phi_i is to be theta^k / density for a tree of k vertices.
            vertices = 1 + len(tree)
            yield abs(float(residual) + (1 - theta**vertices) / vertices)
