"""Invariants from the vector field alone: combinations of monomials, and of functions given, whose rate is zero."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853

from ..core.inputs import count, is_number, refuse_units, shown
from ..core.invariants import Invariant
from ..core.jitted import compiled_like
from ..core.problem import Problem

__all__ = ["find_invariants"]

Array = np.ndarray
Monomial = tuple[int, ...]  # the variables that it is the product of: (0, 0, 3) is y0**2 y3

LARGEST_BASIS = 2000  # the factorisation takes some ten seconds
SPREADS = (1.0, 0.3, 0.1, 0.03, 0.01)  # of the points, in units of the components' sizes
FRESH = 60
# Of a rate computed in floats, to the sum of its terms, in units of rtol: 1e-12 where rtol is 1e-9.
ROUND_OFF = 1e-3
SMALLEST_PIVOT, INDEPENDENT = 1e-6, 1e-6
NEGLIGIBLE = (1e-6, 1e-8, 1e-10, 0.0)  # coefficients that are left out, if the rest is still kept
LARGEST_DENOMINATOR, LARGEST_INTEGER, RATIONAL = 64, 1000, 1e-8
STEPS, DRIFT = 200, 1e-8
LONGEST_NAME = 200


class Term(NamedTuple):
    """A function of the state that is no monomial."""

    fun: Callable[..., Any]
    grad: Callable[..., Any]
    name: str


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
    """Find what y' = f(t, y) keeps among polynomials of the state and functions given.

    The rate of a sum of monomials is linear in its coefficients: those of an invariant are a null vector of the rates
    at random points. What is found is tried at fresh points and times, and along a trajectory.

    Parameters
    ----------
    fun : callable or Problem
        ``fun(t, y) -> (n,)``, for real states.
    y0 : array_like, shape (n,)
        A state; points are drawn around it, about as far as its components are large. Where `fun` or a term raises an
        error or is not finite, the points come closer.
    degree : int, optional
        Largest degree of the polynomials.
    terms : sequence or mapping, optional
        Further functions of the state that may take part: pairs ``(g, grad)`` with ``g(y) -> float`` and ``grad(y) ->
        (n,)``, or both of (t, y), but not changing with t; their names are those of the functions. Or a mapping of
        names to pairs.
    t : float, optional
        First time at which `fun` may be called; a trajectory goes on from there.
    rtol : float, optional
        Largest rate of what is returned, in units of the sum of its terms, at each fresh point; a thousandth of it in
        units of the sum of all products in it, which is what rounding leaves of zero.
    seed : int, optional
        Of the random points.

    Returns
    -------
    list of Invariant
        Functionally independent ones, the simplest first, with readable names (``"y0*y3 - y1*y2"``), gradients, and
        coefficients that are small fractions where those are kept too; jitted where `fun` is. Empty where there are
        none. Polynomials and other functions of them are left out.

    Raises
    ------
    ValueError
        For wrong arguments, and where `fun` is finite at too few points.

    Notes
    -----
    Invariants that hold on a manifold only (of unit quaternions, say) are none at random points, and not found. A
    quantity whose rate is below 1e-12 of its terms cannot be told from an invariant.

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
    refuse_units(y0=y0, t=t)
    degree = count("find_invariants: degree", degree)
    start = np.array(y0)
    if start.ndim != 1 or start.size == 0 or start.dtype.kind not in "iuf" or not np.isfinite(start).all():
        raise ValueError(f"find_invariants: y0 must be a real, finite state (n,), got {shown(y0)}.")
    for name, value in (("t", t), ("rtol", rtol)):
        if not (is_number(value) and math.isfinite(value)) or (name == "rtol" and not 0 < value < 1):
            raise ValueError(f"find_invariants: {name} has the wrong value {shown(value)}.")
    size = math.comb(start.size + degree, degree) - 1 + len(terms)
    if size > LARGEST_BASIS:
        raise ValueError(
            f"find_invariants: {start.size} components make {size} monomials up to degree {degree}; at most "
            f"{LARGEST_BASIS} are tried. Take a smaller degree, or give what may take part as terms."
        )
    given = terms.items() if isinstance(terms, Mapping) else [(None, item) for item in terms]
    further = [_term(item, k, name) for k, (name, item) in enumerate(given)]
    return Search(fun, start.astype(float), degree, further, t, rtol, seed).found


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
    """A function of y from one of (t, y), or of y."""
    if isinstance(fun, np.ufunc) or len(inspect.signature(fun).parameters) != 2:
        return fun
    return compiled_like(lambda y: fun(0.0, y), fun)


@dataclass
class Sample:
    """Rates at points: of each column of the basis the rate, and the sum of its products' sizes; rows of like size."""

    points: Array
    slopes: Array
    rates: Array
    sizes: Array


class Search:
    """One search; `found` are the invariants."""

    def __init__(self, fun: Any, y0: Array, degree: int, terms: list[Term], t: float, rtol: float, seed: int) -> None:
        self.problem = fun if isinstance(fun, Problem) else None
        self.fun = fun.fun if isinstance(fun, Problem) else fun
        self.y0, self.degree, self.terms, self.t, self.rtol = y0, degree, terms, t, rtol
        self.rng = np.random.default_rng(seed)
        self.names = getattr(fun, "component_names", None) or [f"y{k}" for k in range(y0.size)]
        self.basis = [item for d in range(1, degree + 1) for item in combinations_with_replacement(range(y0.size), d)]
        self.column = {item: k for k, item in enumerate(self.basis)}
        self.failure: Exception | None = None
        with np.errstate(all="ignore"):
            self._look_around()
            # What turns a coefficient of y / scale into one of y.
            self.units = np.array([1 / np.prod(self.scale[list(item)]) for item in self.basis] + [1.0] * len(terms))
            enough = len(self.basis) + len(self.terms)
            self.sample, self.fresh = self._draw(enough + enough // 4 + 30), self._draw(FRESH)
            self.trajectory = self._follow()
            self.accepted: list[Array] = []
            for d in range(1, degree + 1):
                self._search([k for k, item in enumerate(self.basis) if len(item) <= d])
            if terms:
                self._search(list(range(enough)))
            self.found = [self._invariant(item) for item in self.accepted]

    # Where to look.

    def _slope(self, t: float, y: Array) -> Array:
        """f, NaN where it cannot be computed."""
        try:
            found = np.asarray(self.fun(t, y.copy()), dtype=float)
        except (ArithmeticError, ValueError) as error:
            self.failure = self.failure or error
            return np.full_like(y, np.nan)
        if found.shape != y.shape:
            raise ValueError(f"find_invariants: fun returned shape {found.shape} for a state of shape {y.shape}.")
        return found

    def _term_gradients(self, y: Array) -> Array:
        try:
            return np.array([item.grad(y.copy()) for item in self.terms], dtype=float).reshape(-1, y.size)
        except (ArithmeticError, ValueError) as error:
            self.failure = self.failure or error
            return np.full((len(self.terms), y.size), np.nan)

    def _look_around(self) -> None:
        """Sizes of the components, and a time in which the state moves by its own size."""
        here, self.scale, self.tau = self.y0, np.abs(self.y0), 0.0
        for _ in range(3):  # a component may start to move only where others have moved
            f = np.abs(self._slope(self.t, here))
            f[~np.isfinite(f)] = 0.0
            if self.tau == 0.0 and f.any():
                self.tau = float(np.max(self.scale, initial=0.0) or 1.0) / float(np.max(f))
            self.scale = np.maximum(self.scale, self.tau * f)
            here = self.y0 + 0.1 * self.scale * self.rng.standard_normal(self.y0.size)
        self.scale[self.scale == 0.0] = np.max(self.scale) or 1.0

    def _draw(self, wanted: int) -> Sample:
        for spread in SPREADS:
            points, slopes, gradients = [], [], []
            for k in range(4 * wanted):
                y = self.y0 + spread * self.scale * self.rng.standard_normal(self.y0.size)
                # What depends on time is to be kept at all times.
                t = self.t + self.tau * self.rng.random() * (k % 2)
                f, g = self._slope(t, y), self._term_gradients(y)
                if np.isfinite(f).all() and np.isfinite(g).all():
                    points.append(y / self.scale)
                    slopes.append(f / self.scale)
                    gradients.append(g * self.scale)
                if len(points) == wanted:
                    return self._rates(np.array(points), np.array(slopes), np.array(gradients))
        raise ValueError(
            f"find_invariants: fun or a term is finite at less than a quarter of the points around y0, even within "
            f"{SPREADS[-1]} of its components' sizes."
        ) from self.failure

    def _rates(self, points: Array, slopes: Array, gradients: Array) -> Sample:
        speed = np.abs(slopes).sum(axis=1, keepdims=True)
        slopes = slopes / np.where(speed == 0, 1.0, speed)
        m = len(points)
        values, rates, sizes = [np.empty((m, len(self.basis))) for _ in range(3)]
        for k, (*rest, last) in enumerate(self.basis):
            z, f = points[:, last], slopes[:, last]
            if not rest:
                values[:, k], rates[:, k], sizes[:, k] = z, f, np.abs(f)
                continue
            j = self.column[tuple(rest)]
            values[:, k] = z * values[:, j]
            rates[:, k] = f * values[:, j] + z * rates[:, j]
            sizes[:, k] = np.abs(f * values[:, j]) + np.abs(z) * sizes[:, j]
        products = gradients * slopes[:, None, :]
        rates = np.hstack([rates, products.sum(axis=2)])
        sizes = np.hstack([sizes, np.abs(products).sum(axis=2)])
        return Sample(points, slopes, rates, sizes)

    def _follow(self) -> Array:
        """States along a trajectory from y0."""
        solver = DOP853(self._slope, self.t, self.y0, self.t + 3 * self.tau, rtol=1e-12, atol=1e-12 * self.scale)
        states = [self.y0]
        while solver.status == "running" and len(states) <= STEPS:
            solver.step()
            if solver.status != "failed":
                states.append(solver.y.copy())
        return np.array(states)

    # What is kept. Coefficients are those of monomials of y / scale.

    def _search(self, columns: list[int]) -> None:
        """Take in what is kept among some columns, and does not depend on what is there already."""
        null = self._null_space(columns)
        known = np.array([self._row(item) for item in self._products(columns)]).reshape(-1, self._width)
        rows = self._reduced(known, null)
        for row in sorted(rows, key=self._simplicity):
            nice = self._nice(row)
            if nice is not None and self._is_new(nice) and self._stays(nice):
                self.accepted.append(nice)

    @property
    def _width(self) -> int:
        return len(self.basis) + len(self.terms)

    def _null_space(self, columns: Any) -> Array:
        """Rows that span it: singular vectors from the smallest on, as long as they are kept at the fresh points."""
        A, columns = self.sample.rates[:, columns], np.asarray(columns)
        weights = np.sqrt(np.mean(self.sample.sizes[:, columns] ** 2, axis=0))
        # What does not move at all is kept; beside columns of that size no rounding is small.
        still = weights == 0
        found = [self._spread(np.ones(1), [k]) for k in columns[still]]
        vectors = np.linalg.svd(np.linalg.qr(A[:, ~still] / weights[~still], mode="r"))[2]
        for vector in vectors[::-1]:
            row = self._spread(vector / weights[~still], columns[~still])
            if not self._is_kept(row):
                break
            found.append(row / np.linalg.norm(row))
        return np.array(found).reshape(-1, self._width)

    def _is_kept(self, row: Array) -> bool:
        """Whether the rate is 0 at the fresh points: relative to the products in it, and to the terms of dI/dy . f."""
        rate = np.abs(self.fresh.rates @ row)
        if np.any(rate > ROUND_OFF * self.rtol * (self.fresh.sizes @ np.abs(row))):
            return False
        gradients = self._gradients(row, self.fresh.points)
        return bool(np.all(rate <= self.rtol * np.abs(gradients * self.fresh.slopes).sum(axis=1)))

    def _gradients(self, row: Array, points: Array, part: Callable[[Array], Array] = np.positive) -> Array:
        """dI/dz at points z (m, n); with `part` np.abs the sizes of what it is the sum of."""
        out = np.zeros_like(points)
        for k in np.flatnonzero(row[: len(self.basis)]):
            item = self.basis[k]
            for place, variable in enumerate(item):
                others = item[:place] + item[place + 1 :]
                out[:, variable] += part(row[k] * points[:, others].prod(axis=1))
        for k in np.flatnonzero(row[len(self.basis) :]):
            grads = [self._term_gradients(z * self.scale)[k] * self.scale for z in points]
            out += part(row[len(self.basis) + k] * np.array(grads))
        return out

    def _products(self, columns: list[int]) -> Iterator[dict[Monomial, float]]:
        """Polynomials of those accepted, up to the degree of the columns."""
        degree = max(len(self.basis[k]) for k in columns if k < len(self.basis))
        polynomials = [self._polynomial(row) for row in self.accepted if not row[len(self.basis) :].any()]
        stack: list[tuple[int, dict[Monomial, float]]] = [(0, {(): 1.0})]
        while stack:
            first, product = stack.pop()
            for k in range(first, len(polynomials)):
                longer = _times(product, polynomials[k])
                if max(map(len, longer)) <= degree:
                    yield longer
                    stack.append((k, longer))

    def _polynomial(self, row: Array) -> dict[Monomial, float]:
        return {item: row[k] for k, item in enumerate(self.basis) if row[k]}

    def _row(self, polynomial: dict[Monomial, float]) -> Array:
        row = np.zeros(self._width)
        for item, coefficient in polynomial.items():
            row[self.column[item]] = coefficient
        return row / np.linalg.norm(row)

    def _reduced(self, known: Array, null: Array) -> list[Array]:
        """Rows of the null space beyond what is known, with as many zeros as elimination makes."""
        # Products of several variables are eliminated first: what is left are squares, as in an energy.
        free = sorted(range(self._width), key=self._mixed)
        reduced: list[tuple[Array, int]] = []
        for source in (known, null):
            rows = [row.copy() for row in source]
            while rows:
                for row, pivot in reduced:
                    rows = [other - other[pivot] * row for other in rows]
                rows = [row for row in rows if np.max(np.abs(row)) > SMALLEST_PIVOT]
                if not rows:
                    break
                pivot = next(k for k in free if max(abs(row[k]) for row in rows) > SMALLEST_PIVOT)
                best = max(range(len(rows)), key=lambda j: abs(rows[j][pivot]))
                row = rows.pop(best)
                row = row / row[pivot]
                reduced = [(other - other[pivot] * row, place) for other, place in reduced] + [(row, pivot)]
                free.remove(pivot)
            if source is known:
                count_known = len(reduced)
        return [row / np.max(np.abs(row)) for row, _ in reduced[count_known:]]

    def _simplicity(self, row: Array) -> tuple[int, int, int, list[int]]:
        """How many terms a row has, how many are differences, as in angular momenta, how many mixed, and which."""
        support = np.flatnonzero(np.abs(row) > NEGLIGIBLE[0]).tolist()
        negative = sum(row[k] < 0 for k in support)
        mixed = sum(k < len(self.basis) and len(set(self.basis[k])) > 1 for k in support)
        return len(support), -int(min(negative, len(support) - negative)), mixed, support

    def _mixed(self, k: int) -> tuple[int, int, int]:
        if k >= len(self.basis):
            return 0, 0, k
        return -len(set(self.basis[k])), -len(self.basis[k]), k

    def _nice(self, row: Array) -> Array | None:
        """The same with few terms and simple coefficients, as far as that is kept; None if it is not kept at all."""
        for bound in NEGLIGIBLE:
            null = self._null_space(np.flatnonzero(np.abs(row) > bound * np.max(np.abs(row))))
            if not len(null):
                continue
            nearest = np.linalg.lstsq(null.T, row)[0] @ null
            if self._is_kept(nearest):
                simple = self._rational(nearest)
                return simple if self._is_kept(simple) else nearest
        return None

    def _spread(self, values: Array, columns: Any) -> Array:
        row = np.zeros(self._width)
        row[columns] = values
        return row

    def _rational(self, row: Array) -> Array:
        """With small fractions for the coefficients of y where all are near to some, in units of one of them."""
        raw = row * self.units
        raw = raw / raw[np.argmax(np.abs(row))]
        for unit in (1.0, np.min(np.abs(raw[raw != 0]))):
            near = [Fraction(float(value)).limit_denominator(LARGEST_DENOMINATOR) for value in raw / unit]
            if all(abs(float(a) - b) <= RATIONAL * abs(b) for a, b in zip(near, raw / unit, strict=True)):
                common = math.lcm(*(fraction.denominator for fraction in near))
                factor = common if max(map(abs, near)) * common <= LARGEST_INTEGER else 1
                raw = np.array([float(fraction * factor) for fraction in near])
                break
        return raw * np.sign(raw[np.flatnonzero(raw)[0]]) / self.units

    def _is_new(self, row: Array) -> bool:
        """Whether its gradient is independent of the others', at some point."""
        points = self.fresh.points[:10]
        own, sizes = self._gradients(row, points), self._gradients(row, points, np.abs)
        others = [self._gradients(item, points) for item in self.accepted]
        for k, gradient in enumerate(own):
            size = np.linalg.norm(gradient)
            if size <= INDEPENDENT * np.linalg.norm(sizes[k]):  # a constant, as y0**2 less a term that is y0**2
                continue
            left = gradient / size
            if others:
                Q = np.linalg.qr(np.array([_unit(item[k]) for item in others]).T)[0]
                left = left - Q @ (Q.T @ left)
            if np.linalg.norm(left) > INDEPENDENT:
                return True
        return False

    def _stays(self, row: Array) -> bool:
        """Whether it is constant along the trajectory."""
        points = self.trajectory / self.scale
        parts = [row[k] * points[:, item].prod(axis=1) for k, item in enumerate(self.basis) if row[k]]
        for term, coefficient in zip(self.terms, row[len(self.basis) :], strict=True):
            if coefficient:
                parts.append(coefficient * np.array([float(term.fun(y.copy())) for y in self.trajectory]))
        values, size = sum(parts), np.max(sum(map(np.abs, parts)))
        return bool(np.all(np.abs(values - values[0]) <= DRIFT * size))

    # What is returned.

    def _invariant(self, row: Array) -> Invariant:
        raw = row * self.units
        items = [(item, float(raw[k])) for k, item in enumerate(self.basis) if raw[k]]
        terms = [(term, float(c)) for term, c in zip(self.terms, raw[len(self.basis) :], strict=True) if c]
        factors = [(_product(item, self.names), c) for item, c in items] + [(term.name, c) for term, c in terms]
        fun, grad = _polynomial_functions(items, self.y0.size)
        likes = [self.fun if self.problem is None else self.problem.rhs or self.fun]
        for term, coefficient in terms:
            fun, grad = _with_term(fun, grad, term, coefficient)
            likes += [term.fun, term.grad]
        return Invariant(compiled_like(fun, *likes), compiled_like(grad, *likes), name=_written(factors))


def _polynomial_functions(items: Sequence[tuple[Monomial, float]], n: int) -> tuple[Callable[..., Any], ...]:
    """Value and gradient of a sum of monomials, for Numba too."""
    coefficients = np.array([coefficient for _, coefficient in items])
    factors = np.array([variable for item, _ in items for variable in item], dtype=np.int64)
    starts = np.cumsum([0, *(len(item) for item, _ in items)])

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

    return value, gradient


def _with_term(
    fun: Callable[..., Any], grad: Callable[..., Any], term: Term, coefficient: float
) -> tuple[Callable[..., Any], ...]:
    """The same with a further function added; for Numba where that and those before are."""
    g, slope = term.fun, term.grad
    fun, grad = compiled_like(fun, g, slope), compiled_like(grad, g, slope)

    def value(t, y):
        return fun(t, y) + coefficient * g(y)

    def gradient(t, y):
        return grad(t, y) + coefficient * slope(y)

    return value, gradient


def _unit(vector: Array) -> Array:
    return vector / (np.linalg.norm(vector) or 1.0)


def _times(a: dict[Monomial, float], b: dict[Monomial, float]) -> dict[Monomial, float]:
    out: dict[Monomial, float] = {}
    for x, u in a.items():
        for y, v in b.items():
            item = tuple(sorted(x + y))
            out[item] = out.get(item, 0.0) + u * v
    return out


def _product(item: Monomial, names: Sequence[str]) -> str:
    powers = {variable: item.count(variable) for variable in item}
    return "*".join(names[k] if power == 1 else f"{names[k]}**{power}" for k, power in powers.items())


def _written(factors: Sequence[tuple[str, float]]) -> str:
    text = ""
    for name, coefficient in factors:
        fraction = Fraction(abs(coefficient)).limit_denominator(LARGEST_DENOMINATOR)
        number = str(fraction) if float(fraction) == abs(coefficient) else f"{abs(coefficient):.6g}"
        sign = "-" if coefficient < 0 else "+"
        text += f" {sign} " if text else ("-" if coefficient < 0 else "")
        text += name if number == "1" else f"{number}*{name}"
    return text if len(text) <= LONGEST_NAME else f"{text[:LONGEST_NAME]}..."
