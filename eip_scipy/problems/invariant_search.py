"""Search for invariants of a vector field: combinations of monomials and given functions whose rate is zero."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from itertools import combinations_with_replacement
from typing import Any, cast

import numpy as np
from scipy.integrate import RK23

from ..core.conserved import reduced_rows
from ..core.derivatives import difference_gradient, unless_error
from ..core.functions import compilable, compiled_like, is_compiled, is_jitted, jitted
from ..core.inputs import count, is_number, reals, shown
from ..core.invariants import Invariant
from ..core.problem import Problem, component_names
from ..engine.data import EPS

__all__ = ["find_invariants"]

Array = np.ndarray
Term = tuple[Callable[..., Any], Callable[..., Any], str]  # a function of y, its gradient, and its name
Point = tuple[Array, Array]  # a state (n,), and f and the gradients of the terms there, (1 + k, n)
Item = tuple[int, ...]  # factors of a product: (0, 0, 3) is y0**2 y3, and (n + k,) is term k

LARGEST_BASIS = 2000  # the factorisation takes some ten seconds
# Least distance of points from the start in units of the components' sizes, and latest time in units of `tau`: what
# drives a system may be much slower than its motion. Times at which a system that is at rest at `t` may move.
NEAREST, LATEST, LATER = 1e-4, 1000.0, (10.0 ** np.arange(-9, 19)).tolist()
# Numbers of points that test a candidate, of those at which gradients are compared, of trajectories and their steps.
FRESH, SOME, TRAJECTORIES, STEPS = 60, 8, 6, 20
# Errors of a correct gradient of a term, relative to its largest component and in roundings of the term.
GRADIENT_ERROR, GRADIENT_ROUNDINGS = 1e-6, 1e4
ROUND_OFF = 1e-3  # bound of a rate relative to the sum of its products, in units of rtol
COMPLEX_STEP, TINY = 1e-100, np.finfo(float).tiny
LEAST_PIVOT, INDEPENDENT = 1e-3, 1e-6
NEGLIGIBLE = 1e-6, 1e-9  # coefficients that are left out, if what is left is conserved
LARGEST_DENOMINATOR, LARGEST_INTEGER, LONGEST_NAME = 64, 1000, 200


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

    The rate of a combination is linear in its coefficients. Therefore the coefficients of an invariant are a null
    vector of the matrix of rates at random points. Each combination that is found is tested at new points and times,
    and along trajectories from `y0` and from points nearby.

    Parameters
    ----------
    fun : callable or Problem
        ``fun(t, y) -> (n,)``, for real states.
    y0 : array_like, shape (n,)
        A state at which `fun` is finite. Random points are drawn around it, at distances of about the sizes of its
        components, or at shorter ones if `fun` or a term raises an error or is not finite at many points.
    degree : int, optional
        Largest degree of the polynomials.
    terms : sequence or mapping, optional
        Further functions of the state that an invariant may contain: pairs ``(g, grad)`` with ``g(y) -> float`` and
        ``grad(y) -> (n,)``, or both functions of (t, y) that do not depend on t; parameters with a default do not
        count. Their names are those of the functions, or the keys of a mapping of names to pairs.
    t : float, optional
        First time at which `fun` may be called. The points are at this time and at later ones, up to about 1000 times
        the time in which the state moves by its own size.
    rtol : float, optional
        The rate of a returned invariant is at most 0.001 `rtol` times the sum of the absolute values of all products
        in it, at each new point. Rounding errors are proportional to that sum.
    seed : int, optional
        Seed of the random points.

    Returns
    -------
    list of Invariant
        Functionally independent invariants, simple ones first, with readable names (``"y0*y3 - y1*y2"``) and
        gradients. Coefficients are small fractions if the combination with these is conserved too. The functions are
        jitted if `fun` and the `terms` that they contain are jitted, and can otherwise be pickled if these terms can.

    Raises
    ------
    ValueError
        If an argument is wrong, `fun` is not finite at (t, y0), `fun` or a term is finite at too few points, or the
        gradient of a term differs from its differences.

    See Also
    --------
    Invariant, particle_invariants, recommend

    Notes
    -----
    Quantities that are conserved on a manifold only (for example of unit quaternions) are not found. A quantity whose
    rate is below the bound cannot be distinguished from an invariant.

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
    field, like = (fun.fun, fun.rhs or fun.fun) if isinstance(fun, Problem) else (fun, fun)
    names = getattr(fun, "component_names", None) or component_names(None, start.size)
    with np.errstate(all="ignore"):  # of points where the field is not defined
        domain = _Domain(field, start.astype(float), further, t, seed)
        return [_invariant(parts, further, names, like) for parts in _Search(domain, degree, rtol).found()]


def _term(item: Any, k: int, name: str | None) -> Term:
    if not (isinstance(item, (tuple, list)) and len(item) == 2 and all(map(callable, item))):
        raise ValueError(
            f"find_invariants: terms[{k if name is None else repr(name)}] must be a pair of functions (g, grad) of y, "
            f"got {shown(item)}."
        )
    own = str(getattr(item[0], "__name__", ""))
    return _of_state(item[0]), _of_state(item[1]), name or (f"{own}(y)" if own.isidentifier() else f"term{k}(y)")


def _of_state(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of y from a function of (t, y) that does not depend on t, or from a function of y."""
    given = () if isinstance(fun, np.ufunc) else inspect.signature(fun).parameters.values()
    if sum(item.default is item.empty and item.kind < item.VAR_POSITIONAL for item in given) != 2:
        return fun
    return compiled_like(lambda y: fun(0.0, y), fun) if is_jitted(fun) else partial(fun, 0.0)


class _Domain:
    """The surroundings of a state in which f and the gradients of terms are evaluated.

    `scale` (n,) holds the sizes of the components, and `tau` is a time in which the state moves by its own size.
    """

    def __init__(self, fun: Callable[..., Any], y0: Array, terms: Sequence[Term], t: float, seed: int) -> None:
        self.slope, self.y0, self.terms, self.t = partial(self._vector, "fun", fun), y0, terms, t
        self.rng, self.failure = np.random.default_rng(seed), cast(Exception | None, None)
        first = self.slope(t, y0)
        if not np.isfinite(first).all():
            found = f"is {first}" if self.failure is None else f"raised {type(self.failure).__name__}"
            raise ValueError(
                f"find_invariants: fun(t, y0) {found}, expected finite numbers. Choose another y0 or t."
            ) from self.failure
        self.scale, self.tau = self._sizes()

    def _vector(self, name: str, function: Callable[..., Any], *args: Any) -> Array:
        """Return the vector (n,) that a function of y or (t, y) returns; NaN if it raises an error of arithmetic."""
        try:
            found = np.array(function(*args[:-1], args[-1].copy()), dtype=float)
        except (ArithmeticError, ValueError) as error:
            self.failure = self.failure or error
            return np.full_like(self.y0, np.nan)
        if found.shape != self.y0.shape:
            raise ValueError(f"find_invariants: {name} returned shape {found.shape} for y of shape {self.y0.shape}.")
        return found

    def _sizes(self) -> tuple[Array, float]:
        here, scale, tau = self.y0, np.abs(self.y0), np.inf
        for later in (0.0, 0.0, 0.0, *LATER):  # a component may start to move only where others have moved
            if tau <= later or (later == LATER[0] and tau < np.inf):
                break
            f = np.nan_to_num(np.abs(self.slope(self.t + later, here)), posinf=0.0)
            if f.any():  # a start near a fixed point is slow, and its surroundings are not
                tau = min(tau, max(later, float((scale.max() or 1.0) / f.max())))
                scale = np.maximum(scale, tau * f * (later == 0.0))
            else:
                scale[scale == 0] = scale.max() or 1.0
            here = self.y0 + 0.1 * scale * self.rng.standard_normal(scale.size)
        scale[scale == 0] = scale.max() or 1.0
        return scale, tau if tau < np.inf else 1.0

    def _point(self, t: float, y: Array) -> list[Point]:
        """Return the state with what is evaluated there; nothing if a number is not finite."""
        gradients = [self._vector(f"the gradient of {name!r}", grad, y) for _, grad, name in self.terms]
        found = np.array([self.slope(t, y), *gradients])
        return [(y, found)] if np.isfinite(found).all() else []

    def points(self, wanted: int) -> list[Point]:
        """Return random points, half of them at `t` and the others later; the more tries, the nearer they are to y0."""
        found: list[Point] = []
        for k in range(4 * wanted):
            spread, part = NEAREST ** (k / (4 * wanted)) ** 1.5, float(self.rng.random())
            y = self.y0 + spread * self.scale * self.rng.standard_normal(self.y0.size)
            found += self._point(self.t + self.tau * (0.0, part, 0.0, LATEST**part)[k % 4], y)
            if len(found) == wanted:
                return found
        raise ValueError(
            "find_invariants: fun or a term is finite at fewer than 25 % of the random points around y0, even at "
            f"distances of {NEAREST} times the sizes of the components. Choose another y0 or t."
        ) from self.failure

    def trajectory(self, y: Array) -> list[Point]:
        """Return points on the trajectory from a state at `t`, within the time 5 `tau`."""
        found: list[Point] = []
        solver = RK23(self.slope, self.t, y, self.t + 5 * self.tau, max_step=self.tau, rtol=1e-2)
        while solver.status == "running" and len(found) < STEPS:
            found += self._point(solver.t, solver.y.copy())
            solver.step()
        return found


def _require_gradient(term: Term, points: Sequence[Point], scale: Array) -> None:
    """Raise ValueError if the gradient of a term is wrong at most points; it need not be smooth at all of them."""
    fun, grad, name = term

    def error(y: Array) -> Any:
        own = np.array(grad(y.copy()))
        difference = own - difference_gradient(lambda x: float(fun(x.copy())), y, 1e-3 * scale)
        bound = GRADIENT_ERROR * np.abs(own * scale).max() + GRADIENT_ROUNDINGS * EPS * abs(fun(y.copy()))
        return np.max(np.abs(difference) * scale) / bound

    errors = np.array([unless_error(error, y) for y, _ in points], dtype=float)
    if 2 * np.count_nonzero(errors > 1) > np.count_nonzero(np.isfinite(errors)):
        raise ValueError(
            f"find_invariants: the second function of the term {name!r} is not the gradient of the first, for example "
            f"at y = {shown(points[int(np.nanargmax(errors))][0])}. Correct it."
        )


class _Search:
    """The matrix of rates at random points, and the search for simple vectors in its null space.

    A candidate is a row of coefficients of `items`, first monomials of z = y / scale and then terms, each in units of
    the size of its rate. `matrix` has their rates at the points that determine candidates, `rates` those at the points
    that test them, `sizes` the sums of the absolute values of the products in `rates`, and `partials` (k, n, m) the
    derivatives of the items by z at some of these points.
    """

    def __init__(self, domain: _Domain, degree: int, rtol: float) -> None:
        self.n, self.terms, self.rtol, s = domain.y0.size, len(domain.terms), rtol, domain.scale
        self.monomials = [c for d in range(1, degree + 1) for c in combinations_with_replacement(range(self.n), d)]
        self.items: list[Item] = [*self.monomials, *((self.n + k,) for k in range(self.terms))]
        self.variables = np.array([len(set(c)) for c in self.monomials] + [0] * self.terms)
        fit = len(self.items) + len(self.items) // 4 + 30
        points = domain.points(fit + FRESH)
        for term in domain.terms:
            _require_gradient(term, points[:SOME], s)
        for y in (domain.y0, *(y for y, _ in points[:TRAJECTORIES])):
            points += domain.trajectory(y)
        states, derivatives = map(np.array, zip(*points, strict=True))
        slopes, z, gradients = derivatives[:, 0] / s, states / s, derivatives[:, 1:] * s
        slopes /= np.maximum(np.abs(slopes).sum(axis=1, keepdims=True), TINY)
        rates, sizes = self._along(slopes, z, gradients), self._along(*map(np.abs, (slopes, z, gradients)))
        weights = np.sqrt(np.mean(sizes[:, :fit] ** 2, axis=1, keepdims=True))
        weights[weights == 0] = 1.0
        rates, sizes = rates / weights, sizes / weights
        self.matrix, self.rates, self.sizes = rates[:, :fit].T, rates[:, fit:], sizes[:, fit:]
        some = np.tile(np.arange(fit, fit + SOME), self.n)
        partials = self._along(np.repeat(np.eye(self.n), SOME, axis=0), z[some], gradients[some])
        self.partials = (partials / weights).reshape(-1, self.n, SOME)
        s = np.append(s, np.ones(self.terms))
        self.units = weights[:, 0] * [np.prod(s[list(item)]) for item in self.items]

    def _along(self, slopes: Array, z: Array, gradients: Array) -> Array:
        """Return the derivatives (k, m) of the items along the vectors `slopes` (m, n), by complex steps."""
        x, values = (z + 1j * COMPLEX_STEP * slopes).T, cast(dict[Item, Any], {(): 1.0})
        for item in self.monomials:
            values[item] = x[item[-1]] * values[item[:-1]]
        of_terms = (gradients * slopes[:, None]).sum(axis=2).T
        return np.array([*(values[item].imag / COMPLEX_STEP for item in self.monomials), *of_terms])

    def found(self) -> list[dict[Item, float]]:
        """Return independent invariants: coefficients of monomials of y and of terms."""
        accepted: list[Array] = []
        # Products of several variables are eliminated first: what is left are squares, as in an energy.
        order = sorted(range(len(self.items)), key=lambda k: (-self.variables[k], -len(self.items[k]), k))
        lengths = np.array([len(item) for item in self.monomials] + [len(self.monomials[-1]) + 1] * self.terms)
        for d in range(1, lengths[-1] + 1):
            null = self._null_space(np.flatnonzero(lengths <= d))
            for row in sorted(reduced_rows(null[:, order], LEAST_PIVOT)[:, np.argsort(order)], key=self._simplicity):
                simple = self._simplified(row)
                if self._is_kept(simple) and self._is_new(simple, accepted):
                    accepted.append(simple)
        return [{item: float(c) for item, c in zip(self.items, row / self.units, strict=True) if c} for row in accepted]

    def _simplicity(self, row: Array) -> tuple[Any, ...]:
        """Return the key that sorts rows: fewest terms; two with both signs, as of momenta; squares, as in energies."""
        support = np.flatnonzero(np.abs(row) > NEGLIGIBLE[0] * np.abs(row).max()).tolist()
        negative = np.count_nonzero(row[support] < 0)
        mixed = np.count_nonzero(self.variables[support] > 1)
        return len(support), mixed * (len(support) > 2), -min(negative, len(support) - negative), mixed, support

    def _null_space(self, columns: Array) -> Array:
        """Return orthonormal combinations of some items whose rates are 0 up to rounding."""
        _, values, vectors = np.linalg.svd(np.linalg.qr(self.matrix[:, columns], mode="r"))
        vectors = vectors[values <= ROUND_OFF * self.rtol * math.sqrt(len(self.matrix))]
        rows = np.zeros((len(vectors), len(self.items)))
        rows[:, columns] = vectors
        return rows

    def _is_kept(self, row: Array) -> bool:
        """Return True if the rate of a candidate is 0 up to rounding at the points that did not determine it."""
        return bool((np.abs(row @ self.rates) <= ROUND_OFF * self.rtol * (np.abs(row) @ self.sizes)).all())

    def _is_new(self, row: Array, accepted: Sequence[Array]) -> bool:
        """Return True if a candidate's gradient is independent of those of the accepted invariants at some point."""
        rows = np.array([*accepted, row])
        sizes = np.einsum("rk,kim->mr", np.abs(rows), np.abs(self.partials))  # all terms of a constant cancel
        gradients = np.einsum("rk,kim->mri", rows, self.partials) / np.maximum(sizes, TINY)[..., None]
        return len(rows) in np.linalg.matrix_rank(gradients, tol=INDEPENDENT)

    def _simplified(self, row: Array) -> Array:
        """Return the nearest conserved row without negligible coefficients, with simple fractions if possible."""
        for bound in NEGLIGIBLE:
            null = self._null_space(np.flatnonzero(np.abs(row) > bound * np.abs(row).max()))
            if len(null):
                break
        nearest = row @ null.T @ null / self.units
        if not nearest.any():
            return nearest
        used = nearest[nearest != 0]
        nearest /= np.abs(used).min() * np.sign(used[0])
        near = [Fraction(value).limit_denominator(LARGEST_DENOMINATOR) for value in nearest.tolist()]
        common = math.lcm(*(value.denominator for value in near))
        common = common if max(map(abs, near)) * common <= LARGEST_INTEGER else 1
        simple = self.units * [float(value * common) for value in near]
        return simple if self._is_kept(simple) else nearest * self.units


def _invariant(parts: dict[Item, float], terms: Sequence[Term], names: Sequence[str], like: Any) -> Invariant:
    """Return a sum of monomials and terms, with a name such as "y0*y3 - y1*y2"."""
    n, text, every = len(names), "", [*names, *(name for _, _, name in terms)]
    for item, c in parts.items():
        powers = {every[i]: item.count(i) for i in item}
        factor = "*".join(name if power == 1 else f"{name}**{power}" for name, power in powers.items())
        fraction = Fraction(abs(c)).limit_denominator(LARGEST_DENOMINATOR)
        number = str(fraction) if float(fraction) == abs(c) else f"{abs(c):.6g}"
        text += (" - " if text else "-") if c < 0 else " + " if text else ""
        text += factor if number == "1" else f"{number}*{factor}"
    used = [(*terms[item[0] - n], c) for item, c in parts.items() if item[0] >= n]
    arguments = {item: c for item, c in parts.items() if item[0] < n}, used, n
    functions: list[Any] = [_Function(arguments, which) for which in (0, 1)]
    if is_compiled(like) and all(is_jitted(function) for fun, grad, *_ in used for function in (fun, grad)):
        functions = _functions(lambda f: jitted(compilable(f)), *arguments)
    return Invariant(*functions, name=text if len(text) <= LONGEST_NAME else f"{text[:LONGEST_NAME]}...")


class _Function:
    """Value (0) or gradient (1) in Python; pickles contain the arguments of `_functions`."""

    def __init__(self, arguments: tuple[Any, ...], which: int) -> None:
        self._arguments, self._function = (arguments, which), _functions(lambda f: f, *arguments)[which]

    def __call__(self, t: float, y: Array) -> Any:
        return self._function(t, y)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._arguments


def _functions(finish: Callable[..., Any], polynomial: dict[Item, float], terms: Sequence[Any], n: int) -> list[Any]:
    """Return the value and the gradient of a polynomial of n variables plus multiples of terms, each finished."""
    coefficients, starts = np.array(list(polynomial.values())), np.cumsum([0, *map(len, polynomial)])
    factors = np.array([i for item in polynomial for i in item], dtype=np.int64)

    def value(t, y):
        total = 0.0
        for k in range(coefficients.size):
            product = coefficients[k]
            for i in range(starts[k], starts[k + 1]):
                product *= y[factors[i]]
            total += product
        return total

    def gradient(t, y):
        out = np.zeros(n)
        for k in range(coefficients.size):
            for j in range(starts[k], starts[k + 1]):
                product = coefficients[k]
                for i in range(starts[k], starts[k + 1]):
                    if i != j:
                        product *= y[factors[i]]
                out[factors[j]] += product
        return out

    def plus(f: Callable[..., Any], g: Callable[..., Any], c: float) -> Any:
        return finish(lambda t, y: f(t, y) + c * g(y))

    found = [finish(value), finish(gradient)]
    for fun, grad, _, c in terms:
        found = [plus(found[0], fun, c), plus(found[1], grad, c)]
    return found
