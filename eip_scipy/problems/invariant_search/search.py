"""Search for simple and independent invariants in the null space of the rates.

The rates are those of monomials and of further functions, at random points around a state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853

from ...core.derivatives import difference_gradient, unless_error
from ...core.inputs import shown
from ...engine.data import EPS
from .polynomials import LARGEST_DENOMINATOR, Monomial, Polynomial, Term, product_of

__all__ = ["Sample", "Search", "Surroundings"]

Array = np.ndarray

SPREADS = (1.0, 0.3, 0.1, 0.03, 0.01)  # of the points, in units of the components' sizes
STEPS = 200
# Largest time of the points in units of `tau`: what drives a system may be much slower than its motion.
LATEST = 1000.0
# A trajectory that moves by less than this part of the components' sizes tests nothing.
AT_REST = 1e-3
# Number of points with each of the SPREADS at which the gradients of given functions are compared with differences, and
# the largest error of a correct one, relative to the largest component and in roundings of the function.
POINTS, GRADIENT_ERROR, GRADIENT_ROUNDINGS = 3, 1e-6, 1e4
# Times after `t`, in any unit, at which a system is looked at that does not move at `t` from any state.
LATER = 10.0 ** np.arange(-9, 19)


class Sample(NamedTuple):
    """Values at m random points, one row for each point.

    `points` are z = y / scale, and `slopes` are dz/dt divided by the sum of its absolute values. `rates` (m, k) are the
    rates dI/dz . slopes of k functions I: the monomials of a basis, then the given functions. `sizes` (m, k) are the
    sums of the absolute values of the products in the rates, with one product for each factor of a monomial.
    """

    points: Array
    slopes: Array
    rates: Array
    sizes: Array


class Surroundings:
    """The region around a state in which invariants are searched, and random points in it.

    `terms` are the given functions. `scale` (n,) holds the sizes of the components of the state, `tau` is a time in
    which the state moves by its own size, and `trajectory` (m, n) holds states on the trajectory from y0, or from
    nearby if that from y0 tests nothing. A ValueError is raised if the vector field is not finite at y0.
    """

    def __init__(self, fun: Callable[..., Any], y0: Array, terms: Sequence[Term], t: float, seed: int) -> None:
        self.fun, self.y0, self.terms, self.t = fun, y0, terms, t
        self.rng = np.random.default_rng(seed)
        self.failure: Exception | None = None
        self._look_around()
        for item in terms:
            self._require_gradient(item, seed)
        self.trajectory = self._follow()

    def _slope(self, t: float, y: Array) -> Array:
        """Return the derivative f(t, y), shape (n,); all NaN if `fun` raises an ArithmeticError or ValueError."""
        try:
            found = np.array(self.fun(t, y.copy()), dtype=float)
        except (ArithmeticError, ValueError) as error:
            self.failure = self.failure or error
            return np.full_like(y, np.nan)
        if found.shape != y.shape:
            raise ValueError(f"find_invariants: fun returned shape {found.shape} for a state of shape {y.shape}.")
        return found

    def term_gradients(self, y: Array) -> Array:
        """Return the gradients (k, n) of the given functions (`terms`); all NaN if one of them cannot be computed."""
        try:
            found = [np.array(item.grad(y.copy()), dtype=float) for item in self.terms]
            return np.array(found).reshape(-1, y.size)
        except (ArithmeticError, ValueError) as error:
            self.failure = self.failure or error
            return np.full((len(self.terms), y.size), np.nan)

    def term_values(self, y: Array) -> Array:
        """Return the values (k,) of the given functions (`terms`); all NaN if one of them cannot be computed."""
        try:
            return np.array([item.fun(y.copy()) for item in self.terms], dtype=float)
        except (ArithmeticError, ValueError):
            return np.full(len(self.terms), np.nan)

    def _require_gradient(self, item: Term, seed: int) -> None:
        """Raise ValueError if the gradient of a given function is wrong at most of the random points where it is known.

        At single points a correct one may differ from the differences, because the function is not smooth there.
        """
        rng, found = np.random.default_rng(seed), []
        for spread in np.repeat(SPREADS, POINTS):
            y = self.y0 + spread * self.scale * rng.standard_normal(self.y0.size)
            look = unless_error(_compared, item, y, self.scale)
            found += [] if look is None else [look]
        wrong = [text for text in found if text]
        if 2 * len(wrong) > len(found):
            raise ValueError(
                f"find_invariants: the second function of the term {item.name!r} is not the gradient of the first: "
                f"{wrong[0]}. Correct it."
            )

    def _look_around(self) -> None:
        """Set `scale`, the sizes of the components, and `tau`, a time in which the state moves by its own size."""
        first = self._slope(self.t, self.y0)
        if not np.isfinite(first).all():
            found = f"is {first}" if self.failure is None else f"raised {type(self.failure).__name__}"
            raise ValueError(
                f"find_invariants: fun(t, y0) {found}, expected finite numbers. Choose another y0 or t."
            ) from self.failure
        here, self.scale, self.tau = self.y0, np.abs(self.y0), 0.0
        for _ in range(3):  # a component may start to move only where others have moved
            f = self._speeds(self.t, here)
            if f.any():  # a start near a fixed point is slow, and its surroundings are not
                tau = float(np.max(self.scale, initial=0.0) or 1.0) / float(np.max(f))
                self.tau = min(self.tau or tau, tau)
            self.scale = np.maximum(self.scale, self.tau * f)
            here = self.y0 + 0.1 * self.scale * self.rng.standard_normal(self.y0.size)
        self.scale[self.scale == 0.0] = np.max(self.scale) or 1.0
        if self.tau == 0.0:
            self.tau = self._time_of_a_start_at_rest()

    def _speeds(self, t: float, y: Array) -> Array:
        """Return the absolute values of the derivative (n,), with 0 for those that are not finite."""
        f = np.abs(self._slope(t, y))
        f[~np.isfinite(f)] = 0.0
        return f

    def _time_of_a_start_at_rest(self) -> float:
        """Return a time in which displaced states around y0 move by their size, at `t` or later; 0 if nothing moves."""
        if speed := self._speed_around(self.t):
            return 1.0 / speed
        tau = 0.0
        for later in LATER.tolist():
            if speed := self._speed_around(self.t + later):
                tau = later
            if later * speed >= 1.0:
                break
        return tau

    def _speed_around(self, t: float) -> float:
        y = self._near(t)
        return float(np.max(self._speeds(t, y) / self.scale))

    def _near(self, t: float) -> Array:
        """Return a random state near y0 at which all functions are finite at `t`; y0 if none is found."""
        for spread in SPREADS:
            y = self.y0 + spread * self.scale * self.rng.standard_normal(self.y0.size)
            if self._is_defined(t, y):
                return y
        return self.y0

    def _is_defined(self, t: float, y: Array) -> bool:
        return bool(np.isfinite(self._slope(t, y)).all() and np.isfinite(self.term_gradients(y)).all())

    def sample(self, wanted: int, basis: Sequence[Monomial]) -> Sample:
        """Return `wanted` random points, with the rates of the monomials `basis` and of the given functions there.

        A ValueError is raised if the vector field, or the gradient of a given function, is finite at too few points.
        """
        for spread in SPREADS:
            points, slopes, gradients = [], [], []
            for k in range(4 * wanted):
                y = self.y0 + spread * self.scale * self.rng.standard_normal(self.y0.size)
                t = self.t + self.tau * self._later(k)
                f, g = self._slope(t, y), self.term_gradients(y)
                if np.isfinite(f).all() and np.isfinite(g).all():
                    points.append(y / self.scale)
                    slopes.append(f / self.scale)
                    gradients.append(g * self.scale)
                if len(points) == wanted:
                    return _rates(np.array(points), np.array(slopes), np.array(gradients), basis)
        raise ValueError(
            f"find_invariants: fun or a term is finite at fewer than 25 % of the random points around y0, even at "
            f"distances of {SPREADS[-1]} times the sizes of the components. Choose another y0 or t."
        ) from self.failure

    def _later(self, k: int) -> float:
        """Return the time of point k after `t`, in units of `tau`: 0, a number below 1, or one up to `LATEST`.

        Half of the points are at `t`, because `fun` may be undefined later.
        """
        part = float(self.rng.random())
        return part if k % 4 == 1 else LATEST**part if k % 4 == 3 else 0.0

    def _follow(self) -> Array:
        """Return states (m, n) on a trajectory from y0, or from nearby if that from y0 would test nothing."""
        if self._is_defined(self.t, self.y0):
            states = self._states_from(self.y0)
            if np.any(np.abs(states - self.y0) > AT_REST * self.scale):
                return states
        return self._states_from(self._near(self.t))

    def _states_from(self, start: Array) -> Array:
        """Return the states (m, n) of at most 200 steps from `start`, within the time 3 `tau`."""
        solver = DOP853(self._slope, self.t, start, self.t + 3 * self.tau, rtol=1e-12, atol=1e-16 * self.scale)
        states = [start]
        while solver.status == "running" and len(states) <= STEPS:
            solver.step()
            if solver.status != "failed":
                states.append(solver.y.copy())
        return np.array(states)


def _compared(item: Term, y: Array, scale: Array) -> str | None:
    """Return a clause about a gradient that is wrong at y, "" if it is correct, and None if it is not finite."""
    own = np.array(item.grad(y.copy()), dtype=float).reshape(y.shape)
    differences = difference_gradient(lambda x: float(item.fun(x.copy())), y, 1e-3 * scale)
    if not (np.isfinite(own).all() and np.isfinite(differences).all()):
        return None
    largest = np.maximum(np.abs(own), np.abs(differences)) * scale
    wrong = np.abs(own - differences) * scale
    k = int(np.argmax(wrong))
    if wrong[k] <= GRADIENT_ERROR * largest.max() + GRADIENT_ROUNDINGS * EPS * abs(float(item.fun(y.copy()))):
        return ""
    return f"at y = {shown(y)} component {k} is {own[k]:.6g}, and {differences[k]:.6g} by differences"


def _rates(points: Array, slopes: Array, gradients: Array, basis: Sequence[Monomial]) -> Sample:
    speed = np.abs(slopes).sum(axis=1, keepdims=True)
    slopes = slopes / np.where(speed == 0, 1.0, speed)
    m, column = len(points), {item: k for k, item in enumerate(basis)}
    values, rates, sizes = [np.empty((m, len(basis))) for _ in range(3)]
    for k, (*rest, last) in enumerate(basis):
        z, f = points[:, last], slopes[:, last]
        if not rest:
            values[:, k], rates[:, k], sizes[:, k] = z, f, np.abs(f)
            continue
        j = column[tuple(rest)]
        values[:, k] = z * values[:, j]
        rates[:, k] = f * values[:, j] + z * rates[:, j]
        sizes[:, k] = np.abs(f * values[:, j]) + np.abs(z) * sizes[:, j]
    products = gradients * slopes[:, None, :]
    rates = np.hstack([rates, products.sum(axis=2)])
    sizes = np.hstack([sizes, np.abs(products).sum(axis=2)])
    return Sample(points, slopes, rates, sizes)


FRESH = 60
# Bound of a computed rate relative to the sum of its products, in units of rtol: 1e-12 for rtol = 1e-9.
ROUND_OFF = 1e-3
FAIR_PIVOT, INDEPENDENT = 1e-2, 1e-6
NEGLIGIBLE = (1e-6, 1e-8, 1e-10, 0.0)  # coefficients that are left out, if the rest is still kept
LARGEST_INTEGER, RATIONAL = 1000, 1e-8
DRIFT = 1e-8
RELATIVE, ABSOLUTE = 1e-10, 1e-14  # how far a trajectory's states may be off, relative and in units of the scale
APART = 1e3  # the least singular value that is not 0, in units of rounding


class Search:
    """A search for invariants, which is made when the object is created; `found` has the result.

    A candidate is a row of coefficients: first those of the monomials of z = y / scale, up to `degree`, then those of
    the given functions. `columns` are indices in such a row. `rtol` is the tolerance of `_is_kept`.
    """

    def __init__(self, around: Surroundings, degree: int, rtol: float) -> None:
        self.around, self.terms, self.rtol = around, around.terms, rtol
        variables = range(around.y0.size)
        self.basis = [item for d in range(1, degree + 1) for item in combinations_with_replacement(variables, d)]
        self.column = {item: k for k, item in enumerate(self.basis)}
        # Factor that converts a coefficient of z into one of y.
        of_monomials = [1 / np.prod(around.scale[list(item)]) for item in self.basis]
        self.units = np.array([*of_monomials, *(1.0 for _ in self.terms)])
        self.sample = around.sample(self._width + self._width // 4 + 30, self.basis)
        self.fresh = around.sample(FRESH, self.basis)
        self.accepted: list[Array] = []
        for d in range(1, degree + 1):
            self._search([k for k, item in enumerate(self.basis) if len(item) <= d])
        if self.terms:
            self._search(list(range(self._width)))

    @property
    def found(self) -> list[tuple[Polynomial, list[tuple[Term, float]]]]:
        """Return the invariants as pairs: a polynomial of y, and a list of given functions with their coefficients."""
        rows = [row * self.units for row in self.accepted]
        of_terms = [zip(self.terms, row[len(self.basis) :].tolist(), strict=True) for row in rows]
        return [
            (self._polynomial(row), [(term, c) for term, c in terms if c])
            for row, terms in zip(rows, of_terms, strict=True)
        ]

    def _search(self, columns: list[int]) -> None:
        """Accept conserved combinations of the functions in `columns` that are independent of those accepted before."""
        null, numerical = self._null_space(columns), self._numerical_null_space(columns)
        # The larger space first: a row alone of a smaller one is any combination of what spans the larger.
        if len(numerical) > len(null):
            self._take(numerical, columns)
        self._take(null, columns)

    def _take(self, null: Array, columns: list[int]) -> None:
        """Accept simple forms of those rows of a null space that are conserved and independent of accepted rows."""
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
        """Return the constant functions and those singular vectors, smallest values first, that are conserved."""
        # A component that does not move is conserved; relative to such columns no rounding error is small.
        still, _, rows = self._singular(columns)
        found = [self._spread(np.ones(1), [k]) for k in still]
        for row in rows[::-1]:
            if not self._is_kept(row):
                break
            found.append(row / np.linalg.norm(row))
        return np.array(found).reshape(-1, self._width)

    def _numerical_null_space(self, columns: Any) -> Array:
        """Return the constant functions and the singular vectors of singular values that are 0 up to rounding, as rows.

        There are none if no singular value is above rounding, or the smallest one above is less than `APART` times as
        large. The rows are not tested by `_is_kept`: because of rounding they contain small multiples of all columns,
        which exceed the terms of the invariant near points at which all of these vanish, as those of y1**2 + y0**4/2
        near y0 = 0.
        """
        still, values, rows = self._singular(columns)
        if not values.size:
            return np.empty((0, self._width))
        rounding = np.finfo(float).eps * values[0] * len(self.sample.points)
        zero = values <= rounding
        if zero.all() or values[~zero].min() < APART * rounding:
            return np.empty((0, self._width))
        found = [self._spread(np.ones(1), [k]) for k in still] + [row / np.linalg.norm(row) for row in rows[zero]]
        return np.array(found).reshape(-1, self._width)

    def _singular(self, columns: Any) -> tuple[Array, Array, Array]:
        """Return constant functions in `columns`, and the singular values and right vectors of the others' rates."""
        A, columns = self.sample.rates[:, columns], np.asarray(columns)
        weights = np.sqrt(np.mean(self.sample.sizes[:, columns] ** 2, axis=0))
        still, moving = columns[weights == 0], columns[weights > 0]
        scaled = A[:, weights > 0] / weights[weights > 0]
        values, vectors = np.linalg.svd(np.linalg.qr(scaled, mode="r"))[1:]
        rows = np.array([self._spread(vector / weights[weights > 0], moving) for vector in vectors])
        return still, values, rows.reshape(-1, self._width)

    def _is_kept(self, row: Array) -> bool:
        """Return True if the rate of a candidate is 0 up to rounding at points that did not determine it.

        It must be below `rtol` times the sum of the absolute values of its terms ``dI/dz_i dz_i/dt``, and below
        `ROUND_OFF` `rtol` times that sum without cancellation within the terms (the `sizes` of `Sample`).
        """
        rate = np.abs(self.fresh.rates @ row)
        if np.any(rate > ROUND_OFF * self.rtol * (self.fresh.sizes @ np.abs(row))):
            return False
        gradients = self._gradients(row, self.fresh.points)
        return bool(np.all(rate <= self.rtol * np.abs(gradients * self.fresh.slopes).sum(axis=1)))

    def _gradients(self, row: Array, points: Array, part: Callable[[Array], Array] = np.positive) -> Array:
        """Return the gradients dI/dz (m, n) of a candidate at m points; `part` is applied to each contribution."""
        out = np.zeros_like(points)
        for k in np.flatnonzero(row[: len(self.basis)]):
            item = self.basis[k]
            for place, variable in enumerate(item):
                others = item[:place] + item[place + 1 :]
                out[:, variable] += part(row[k] * points[:, others].prod(axis=1))
        for k in np.flatnonzero(row[len(self.basis) :]):
            grads = [self.around.term_gradients(z * self.around.scale)[k] * self.around.scale for z in points]
            out += part(row[len(self.basis) + k] * np.array(grads))
        return out

    def _products(self, columns: list[int]) -> Iterator[Polynomial]:
        """Yield the products of accepted polynomials that consist of functions in `columns`."""
        degree = max(len(self.basis[k]) for k in columns if k < len(self.basis))
        polynomials = [self._polynomial(row) for row in self.accepted if not row[len(self.basis) :].any()]
        stack: list[tuple[int, Polynomial]] = [(0, {(): 1.0})]
        while stack:
            first, product = stack.pop()
            for k in range(first, len(polynomials)):
                longer = product_of(product, polynomials[k])
                if max(map(len, longer)) <= degree:
                    yield longer
                    stack.append((k, longer))

    def _polynomial(self, row: Array) -> Polynomial:
        return {item: float(row[k]) for k, item in enumerate(self.basis) if row[k]}

    def _row(self, polynomial: Polynomial) -> Array:
        row = np.zeros(self._width)
        for item, coefficient in polynomial.items():
            row[self.column[item]] = coefficient
        return row / np.linalg.norm(row)

    def _reduced(self, known: Array, null: Array) -> list[Array]:
        """Return the rows of `null` that are independent of `known`, with as many zeros as elimination produces."""
        # Products of several variables are eliminated first: what is left are squares, as in an energy.
        free = sorted(range(self._width), key=self._mixed)
        reduced: list[tuple[Array, int]] = []
        for source in (known, null):
            rows = [row.copy() for row in source]
            while rows:
                for row, pivot in reduced:
                    rows = [other - other[pivot] * row for other in rows]
                rows = [row for row in rows if np.max(np.abs(row)) > NEGLIGIBLE[0]]
                if not rows:
                    break
                largest = np.max(np.abs(rows), axis=0)
                pivot = next(k for k in free if largest[k] > FAIR_PIVOT * largest.max())
                best = max(range(len(rows)), key=lambda j: abs(rows[j][pivot]))
                row = rows.pop(best)
                row = row / row[pivot]
                reduced = [(other - other[pivot] * row, place) for other, place in reduced] + [(row, pivot)]
                free.remove(pivot)
            if source is known:
                count_known = len(reduced)
        return [row / np.max(np.abs(row)) for row, _ in reduced[count_known:]]

    def _simplicity(self, row: Array) -> tuple[int, int, int, list[int]]:
        """Return the key that sorts rows by simplicity; both signs count as simple, as in angular momenta."""
        support = np.flatnonzero(np.abs(row) > NEGLIGIBLE[0]).tolist()
        negative = sum(row[k] < 0 for k in support)
        mixed = sum(k < len(self.basis) and len(set(self.basis[k])) > 1 for k in support)
        return len(support), -int(min(negative, len(support) - negative)), mixed, support

    def _mixed(self, k: int) -> tuple[int, int, int]:
        if k >= len(self.basis):
            return 0, 0, k
        return -len(set(self.basis[k])), -len(self.basis[k]), k

    def _nice(self, row: Array) -> Array | None:
        """Return a conserved version of a row with few, and if possible simple, coefficients; None if there is none."""
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
        """Return a multiple of the row that begins with a positive number, of simple fractions if they are near."""
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
        """Return True if a candidate's gradient is independent of those of the accepted invariants at some point."""
        points = self.fresh.points[:10]
        own, sizes = self._gradients(row, points), self._gradients(row, points, np.abs)
        others = [self._gradients(item, points) for item in self.accepted]
        for k, gradient in enumerate(own):
            size = np.linalg.norm(gradient)
            if size <= INDEPENDENT * np.linalg.norm(sizes[k]):  # a constant, as y0**2 less a term that is y0**2
                continue
            left = gradient / size
            if others:
                Q = np.linalg.qr(np.array([item[k] / (np.linalg.norm(item[k]) or 1.0) for item in others]).T)[0]
                left = left - Q @ (Q.T @ left)
            if np.linalg.norm(left) > INDEPENDENT:
                return True
        return False

    def _stays(self, row: Array) -> bool:
        """Return True if a candidate is constant along the trajectory, up to the errors of the states."""
        states, coefficients = self.around.trajectory, row[len(self.basis) :]
        points = states / self.around.scale
        parts = [row[k] * points[:, item].prod(axis=1) for k, item in enumerate(self.basis) if row[k]]
        if coefficients.any():
            parts += list((coefficients * np.array([self.around.term_values(y) for y in states])).T)
        values, sizes = sum(parts), sum(map(np.abs, parts))
        bound = DRIFT * np.fmax.accumulate(sizes)
        # If the argument of a logarithm is nearly 0, errors of the trajectory dominate from there on.
        errors = RELATIVE * np.abs(points) + ABSOLUTE
        sure = ((np.abs(self._gradients(row, points)) * errors).sum(axis=1) <= bound) & np.isfinite(values)
        end = sure.size if sure.all() else int(np.argmin(sure))
        return bool(np.all(np.abs(values - values[0])[:end] <= bound[:end]))
