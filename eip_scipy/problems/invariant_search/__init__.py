"""Search for invariants of a vector field: combinations of monomials and given functions whose rate is zero."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...core.functions import compiled_like, is_jitted
from ...core.inputs import count, is_number, reals, shown
from ...core.invariants import Invariant
from ...core.problem import Problem, component_names
from .polynomials import Term, functions, written
from .search import Search, Surroundings

__all__ = ["find_invariants"]

LARGEST_BASIS = 2000  # the factorisation takes some ten seconds


def find_invariants(
    fun: Callable[..., Any] | Problem,
    y0: Any,
    *,
    degree: int = 2,
    terms: Sequence[Any] | Mapping[str, Any] = (),
    t: float = 0.0,
    rtol: float = 1e-9,
    seed: int = 0,
) -> list[Invariant]:
    """Find invariants of y' = f(t, y) among combinations of polynomials of the state and given functions.

    The rate of a sum of monomials is linear in its coefficients. Therefore the coefficients of an invariant are a null
    vector of the matrix of rates at random points. Each combination that is found is tested at new points and times,
    and along a trajectory: that from `y0`, or from a point nearby if `y0` is an equilibrium or a term is
    not finite there.

    Parameters
    ----------
    fun : callable or Problem
        ``fun(t, y) -> (n,)``, for real states.
    y0 : array_like, shape (n,)
        A state at which `fun` is finite. Random points are drawn around it, at distances of about the sizes of its
        components. If `fun` or a term raises an error or is not finite at too many points, points nearer to the state
        are drawn.
    degree : int, optional
        Largest degree of the polynomials.
    terms : sequence or mapping, optional
        Further functions of the state that an invariant may contain: pairs ``(g, grad)`` with ``g(y) -> float`` and
        ``grad(y) -> (n,)``, or both functions of (t, y) that do not depend on t. Their names are those of the
        functions, or the keys of a mapping of names to pairs.
    t : float, optional
        First time at which `fun` may be called. The trajectory starts at this time. The points are at this time and at
        later ones, up to about 1000 times the time in which the state moves by its own size.
    rtol : float, optional
        Largest rate of a returned invariant at each new point, relative to the sum of the absolute values of the terms
        ``dI/dy_i dy_i/dt``. In addition the rate must be below 0.001 `rtol` relative to the sum of the absolute values
        of all products in these terms, because rounding errors are proportional to that sum.
    seed : int, optional
        Seed of the random points.

    Returns
    -------
    list of Invariant
        Functionally independent invariants, the simplest first, with readable names (``"y0*y3 - y1*y2"``) and
        gradients. Coefficients are replaced by small fractions if the combination with these fractions is conserved
        too. The functions are jitted if `fun` and the `terms` that they contain are jitted, and can otherwise be
        pickled if these terms can. Polynomials and other functions of the returned invariants are left out. The list is
        empty if no invariant is found.

    Raises
    ------
    ValueError
        If an argument is wrong, `fun` is not finite at (t, y0), `fun` or a term is finite at too few points, or the
        gradient of a term differs from its differences.

    Notes
    -----
    Quantities that are conserved on a manifold only (for example of unit quaternions) are not conserved at random
    points, and are not found. A quantity whose rate is below both bounds of `rtol` cannot be distinguished from an
    invariant; by default the second bound is 1e-12 of the sum of the absolute values of all products in the rate.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import find_invariants
    >>> def kepler(t, y):
    ...     r = np.hypot(y[0], y[1])
    ...     return np.array([y[2], y[3], -y[0] / r**3, -y[1] / r**3])
    >>> find_invariants(kepler, [1.0, 0.0, 0.0, 1.2])
    [Invariant(y0*y3 - y1*y2)]
    """
    degree = count("find_invariants: degree", degree)
    start = reals("y0", y0)
    if start is None or start.ndim != 1 or start.size == 0 or not np.isfinite(start).all():
        raise ValueError(f"find_invariants: y0 must be a real, finite state (n,), got {shown(y0)}.")
    for name, value in (("t", t), ("rtol", rtol)):
        if not (is_number(value, name) and math.isfinite(value)) or (name == "rtol" and not 0 < value < 1):
            expected = "a finite number" if name == "t" else "a number between 0 and 1"
            raise ValueError(f"find_invariants: {name} must be {expected}, got {shown(value)}.")
    size = math.comb(start.size + degree, degree) - 1 + len(terms)
    if size > LARGEST_BASIS:
        raise ValueError(
            f"find_invariants: {start.size} components make {size} functions, monomials up to degree {degree} and "
            f"terms; at most {LARGEST_BASIS} can be tried. Use a smaller degree or fewer terms; functions of higher "
            "degree can be given as terms."
        )
    given = terms.items() if isinstance(terms, Mapping) else [(None, item) for item in terms]
    further = [_term(item, k, name) for k, (name, item) in enumerate(given)]
    field = fun.fun if isinstance(fun, Problem) else fun
    like = fun.rhs or field if isinstance(fun, Problem) else fun
    names = getattr(fun, "component_names", None) or component_names(None, start.size)
    with np.errstate(all="ignore"):  # of points where the field is not defined
        found = Search(Surroundings(field, start.astype(float), further, t, seed), degree, rtol).found
    return [
        Invariant(*functions(polynomial, terms, start.size, like), name=written(polynomial, terms, names))
        for polynomial, terms in found
    ]


def _term(item: Any, k: int, name: str | None) -> Term:
    if not (isinstance(item, (tuple, list)) and len(item) == 2 and all(map(callable, item))):
        raise ValueError(
            f"find_invariants: terms[{k if name is None else repr(name)}] must be a pair of functions (g, grad) of y, "
            f"got {shown(item)}."
        )
    own = str(getattr(item[0], "__name__", ""))
    name = name or (f"{own}(y)" if own.isidentifier() else f"term{k}(y)")
    return Term(_of_state(item[0]), _of_state(item[1]), name)


def _of_state(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of y from a function of (t, y) that does not depend on t, or from a function of y."""
    if isinstance(fun, np.ufunc) or len(inspect.signature(fun).parameters) != 2:
        return fun
    return compiled_like(lambda y: fun(0.0, y), fun) if is_jitted(fun) else partial(fun, 0.0)
