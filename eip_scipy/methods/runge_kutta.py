"""Explicit Runge-Kutta tableaux as exact fractions.

User-defined tableaux are checked against the order conditions when they are created; those of the package are checked
by its tests.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from .orders import Ordered, named_constant

__all__ = ["DOP853", "RK1", "RK2", "RK3", "RK4", "RK5", "RK23", "RK45", "Tableau"]

# Bound on rounding errors in tableaux of floats.
FLOAT_TOLERANCE = 1e-12

Number = int | float | str | Fraction
Tree = tuple["Tree", ...]


@cache
def rooted_trees(order: int) -> tuple[Tree, ...]:
    """Return all rooted trees with `order` vertices, each a sorted tuple of its subtrees."""
    return tuple(_forests(order - 1, order - 1))


def _forests(total: int, largest: int) -> Iterator[Tree]:
    """Yield the multisets of trees with `total` vertices in all and at most `largest` vertices per tree."""
    if total == 0:
        yield ()
        return
    for size in range(min(total, largest), 0, -1):
        trees = rooted_trees(size)
        for first, tree in enumerate(trees):
            for rest in _forests(total - size, size):
                if all(_size(sub) < size or trees.index(sub) >= first for sub in rest):
                    yield (tree, *rest)


def _size(tree: Tree) -> int:
    return 1 + sum(map(_size, tree))


def _density(tree: Tree) -> int:
    product = _size(tree)
    for sub in tree:
        product *= _density(sub)
    return product


def _stage_weights(tree: Tree, A: np.ndarray) -> np.ndarray:
    """Return the factor of b_i in the elementary weight of `tree` (Hairer, Norsett & Wanner I, eq. II.2.15)."""
    phi = np.full(A.shape[0], A.dtype.type(1) if A.dtype != object else Fraction(1), dtype=A.dtype)
    for sub in tree:
        phi = phi * A.dot(_stage_weights(sub, A))
    return phi


def order_residuals(A: np.ndarray, b: np.ndarray, order: int) -> Iterator[tuple[Tree, Number]]:
    """Yield (tree, residual) for every order condition up to `order`: sum_i b_i phi_i(tree) - 1 / density(tree)."""
    for vertices in range(1, order + 1):
        for tree in rooted_trees(vertices):
            yield tree, b.dot(_stage_weights(tree, A)) - Fraction(1, _density(tree))


def _exact(name: str, value: Number) -> Fraction | float:
    try:
        exact = value if isinstance(value, float) else Fraction(value)
    except (TypeError, ValueError):
        exact = math.nan
    if not math.isfinite(exact):
        raise ValueError(f"{name}: coefficients must be finite numbers or strings such as '1/3', got {value!r}.")
    return exact


@dataclass(frozen=True, eq=False)
class Tableau(Ordered):
    """Coefficients of an explicit Runge-Kutta method.

    Parameters
    ----------
    name : str
        Name of the method.
    A : sequence of sequences
        Strictly lower triangular stage matrix; row i needs only its first i entries. Entries are int, Fraction,
        strings such as ``"1/3"`` (exact) or floats.
    b : sequence, length s
        Weights of the step.
    order : int
        Order of the step, checked against every order condition: exactly for rational entries, to 1e-12 for floats.
    b_hat : sequence, length s or s + 1, optional
        Weights of the embedded estimate; entry s belongs to f at the new point.
    error_estimator_order : int, optional
        Order of `b_hat`, checked in the same way; required with `b_hat`.
    c : sequence, length s, optional
        Nodes, which must equal the row sums of `A` (default).
    e_low : sequence, length s + 1, optional
        Weights of a second, less accurate error e3 in addition to ``e = b - b_hat`` (e5): the estimate is then
        ``h e5 |e5| / hypot(e5, e3 / 10)``, as in DOP853, and `b_hat` is two orders below `error_estimator_order`.
    P : sequence of sequences, shape (s + 1, q), optional
        Dense output: y(t + theta h) = y + h sum_j theta^(j + 1) (K^T P)_j; the last row is for f at the new point.
    reference : str
        Source of the coefficients, including the equation or table.

    Attributes
    ----------
    A, b, c : ndarray of float64
        (s, s), (s,), (s,).
    e, e_low : ndarray of float64, shape (s + 1,)
        Weights of the error estimate, ``b - b_hat``, and of its second part; zero without an estimate.
    P : ndarray of float64, shape (s + 1, q), or None
        Dense output.
    b_low : ndarray of float64, shape (s,)
        Rounding errors of `b` in double precision, for compensated summation, corrected so that the first quadrature
        moments are exact for the rounded nodes.
    n_stages : int
        Number of stages.
    fsal : bool
        True if the estimate uses f at the new point, that is, `b_hat` has s + 1 entries.

    Raises
    ------
    ValueError
        If the tableau is not explicit, shapes disagree, or an order condition fails.
    """

    name: str
    A: np.ndarray
    b: np.ndarray
    order: int
    b_hat: np.ndarray | None = None
    error_estimator_order: int | None = None
    c: np.ndarray = field(init=False)
    reference: str = ""
    e: np.ndarray = field(init=False)
    e_low: np.ndarray = field(init=False)
    P: np.ndarray | None = field(init=False)
    b_low: np.ndarray = field(init=False)
    n_stages: int = field(init=False)
    fsal: bool = field(init=False)

    def __init__(
        self,
        name: str,
        A: Sequence[Sequence[Number]],
        b: Sequence[Number],
        order: int,
        *,
        b_hat: Sequence[Number] | None = None,
        error_estimator_order: int | None = None,
        c: Sequence[Number] | None = None,
        e_low: Sequence[Number] | None = None,
        P: Sequence[Sequence[Number]] | None = None,
        reference: str = "",
    ) -> None:
        _check_integer(name, "order", order)
        s = len(b)
        exact_A, exact_b = _stage_matrix(name, A, s), _vector(name, b)
        nodes = exact_A.sum(axis=1) if s > 1 else _vector(name, [0])
        if c is not None:
            _check_nodes(name, _vector(name, c), nodes)
            nodes = _vector(name, c)
        self._check_order(name, "b", exact_A, exact_b, order)
        weights_hat = None
        if b_hat is None and error_estimator_order is not None:
            raise ValueError(f"{name}: error_estimator_order was given without b_hat; give both or neither.")
        if b_hat is not None:
            # The combined estimate of a pair of orders 5 and 3 has the order 2 * 5 - 3 = 7.
            fewer = 0 if e_low is None else 2
            weights_hat = self._check_embedded(name, exact_A, exact_b, b_hat, error_estimator_order, fewer)
        e = np.zeros(s + 1)
        if weights_hat is not None:
            e[:] = [float(x) for x in _vector(name, [*exact_b, 0]) - weights_hat]
        values = {
            "name": name,
            "A": exact_A.astype(float),
            "b": exact_b.astype(float),
            "c": nodes.astype(float),
            "b_hat": None if weights_hat is None else weights_hat.astype(float),
            "order": order,
            "error_estimator_order": error_estimator_order if b_hat is not None else None,
            "reference": reference,
            "e": e,
            "e_low": np.zeros(s + 1) if e_low is None else _vector(name, e_low).astype(float),
            "P": None if P is None else np.array([_vector(name, row) for row in P]).astype(float),
            "b_low": _low_parts(exact_b, nodes, [Fraction(1, k + 1) for k in range(order)]),
            "n_stages": s,
            "fsal": b_hat is not None and len(b_hat) == s + 1,
        }
        for key, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)

    def _check_embedded(
        self, name: str, A: np.ndarray, b: np.ndarray, b_hat: Sequence[Number], order_hat: int | None, fewer: int
    ) -> np.ndarray:
        """Return `b_hat` with s + 1 entries after a check that it is of order `order_hat` - `fewer`.

        The derivative f at the new point is the last stage, whose row of the stage matrix is `b`.
        """
        s = len(b)
        if len(b_hat) not in (s, s + 1):
            raise ValueError(
                f"{name}: b_hat has {len(b_hat)} entries; expected {s} or {s + 1} (with f at the new point)."
            )
        if order_hat is None:
            raise ValueError(f"{name}: b_hat was given without error_estimator_order; give the order of b_hat.")
        weights = _vector(name, [*b_hat, *[0] * (s + 1 - len(b_hat))])
        extended = np.full((s + 1, s + 1), Fraction(0), dtype=object)
        extended[:s, :s], extended[s, :s] = A, b
        self._check_order(name, "b_hat", extended, weights, order_hat - fewer)
        return weights

    @staticmethod
    def _check_order(name: str, label: str, A: np.ndarray, b: np.ndarray, order: int) -> None:
        exact = not any(isinstance(v, float) for v in (*A.ravel(), *b))
        if not exact:
            A, b = A.astype(float), b.astype(float)
        for tree, residual in order_residuals(A, b, order):
            if residual != 0 if exact else abs(float(residual)) > FLOAT_TOLERANCE:
                raise ValueError(
                    f"{name}: {label} is not of order {order}: the condition of tree {tree} of order {_size(tree)} "
                    f"is violated by {float(residual):.3g}."
                )

    def __reduce_ex__(self, protocol: Any) -> Any:
        return named_constant(self, globals()) or super().__reduce_ex__(protocol)

    @property
    def paired(self) -> bool:
        """True if the error estimate has two parts, with the weights `e` and `e_low`."""
        return bool(np.any(self.e_low))

    def __repr__(self) -> str:
        estimate = f", estimate of order {self.error_estimator_order}" if self.has_estimate else ""
        return f"<Tableau {self.name}: {self.n_stages} stages, order {self.order}{estimate}>"


def _check_integer(name: str, label: str, value: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name}: {label} must be an integer >= 1, got {value!r}.")


def _vector(name: str, values: Sequence[Number]) -> np.ndarray:
    out = np.empty(len(values), dtype=object)
    out[:] = [_exact(name, v) for v in values]
    return out


def _stage_matrix(name: str, A: Sequence[Sequence[Number]], s: int) -> np.ndarray:
    if len(A) != s:
        raise ValueError(f"{name}: A has {len(A)} rows and b has {s} entries; they must have the same number.")
    full = np.full((s, s), Fraction(0), dtype=object)
    for i, row in enumerate(A):
        entries = [_exact(name, v) for v in row]
        if any(entries[i:]):
            raise ValueError(
                f"{name}: row {i} of A reaches its diagonal; an explicit method needs A strictly lower triangular."
            )
        full[i, : min(i, len(entries))] = entries[:i]
    return full


def _check_nodes(name: str, c: np.ndarray, row_sums: np.ndarray) -> None:
    if len(c) != len(row_sums) or any(abs(float(x - y)) > FLOAT_TOLERANCE for x, y in zip(c, row_sums, strict=True)):
        raise ValueError(
            f"{name}: c = {list(map(str, c))} differs from the row sums of A, {list(map(str, row_sums))}. Correct A or "
            "c, or omit c."
        )


def _low_parts(b: np.ndarray, c: np.ndarray, moments: Sequence[Fraction]) -> np.ndarray:
    """Return the rounding errors of `b`, with the smallest corrections so that sum b c^k = moments[k] for rounded `c`.

    Rounded weights and nodes violate the quadrature moments by about 1e-17, a systematic error that long compensated
    runs would otherwise accumulate. Nodes that differ only by rounding count as one: the number of moments is at most
    the number of nodes, and a correction that uses the difference of two such nodes would be large.
    """
    high = [Fraction(float(x)) for x in b]
    lost = [float(Fraction(x) - y) for x, y in zip(b, high, strict=True)]
    nodes = [Fraction(float(x)) for x in c]
    apart = len(nodes) and 1 + sum(right - left > FLOAT_TOLERANCE for left, right in pairwise(sorted(nodes)))
    weights = [x + Fraction(y) for x, y in zip(high, lost, strict=True)]
    missing = [
        moment - sum(w * x**k for w, x in zip(weights, nodes, strict=True)) for k, moment in enumerate(moments[:apart])
    ]
    corrections = _least_corrections(nodes, missing)
    return np.array([float(Fraction(x) + y) for x, y in zip(lost, corrections, strict=True)])


def _least_corrections(nodes: Sequence[Fraction], missing: Sequence[Fraction]) -> list[Fraction]:
    """Return the smallest x, in the Euclidean norm, with sum_i x_i c_i^k = missing[k] for the nodes c, exactly.

    This x is a polynomial in the nodes, x_i = sum_k a_k c_i^k, whose coefficients solve V V^T a = missing with the
    Vandermonde matrix V. The system is solved in integers, with nodes in units of their last bit, by Bareiss's
    elimination.
    """
    unit = max((x.denominator for x in nodes), default=1)  # nodes are doubles, so that all denominators divide it
    places = [int(x * unit) for x in nodes]
    scale = math.lcm(*(x.denominator for x in missing))
    count = len(missing)
    sums = [sum(x**k for x in places) for k in range(2 * count)]
    rows = [[*sums[k : k + count], int(missing[k] * scale * unit**k)] for k in range(count)]
    last = 1
    for k in range(count):
        pivot = rows[k]
        for row in rows[:k] + rows[k + 1 :]:
            first = row[k]
            row[:] = [(pivot[k] * x - first * y) // last for x, y in zip(row, pivot, strict=True)]
        last = pivot[k]
    return [Fraction(sum(row[-1] * x**k for k, row in enumerate(rows)), last * scale) for x in places]


class _Published(Tableau):
    """A tableau of this package, checked by the tests, because a check would take 40 ms per import."""

    @staticmethod
    def _check_order(name: str, label: str, A: np.ndarray, b: np.ndarray, order: int) -> None:
        pass


_PAPER = "Cai, Gong & Wang, An explicit and practically invariants-preserving method, section 2.1"

RK1 = _Published("RK1", [[]], [1], order=1, reference=f"{_PAPER} (explicit Euler)")
RK2 = _Published(
    "RK2",
    [[], ["1/2"]],
    [0, 1],
    order=2,
    b_hat=[1, 0],
    error_estimator_order=1,
    reference=f"{_PAPER} (explicit midpoint); estimate: explicit Euler",
)
RK3 = _Published(
    "RK3",
    [[], ["1/3"], [0, "2/3"]],
    ["1/4", 0, "3/4"],
    order=3,
    b_hat=[0, "1/2", "1/2"],
    error_estimator_order=2,
    reference=f"{_PAPER} (Heun's third-order method); estimate: the second-order rule on its last two stages",
)
RK4 = _Published(
    "RK4",
    [[], ["1/2"], [0, "1/2"], [0, 0, 1]],
    ["1/6", "1/3", "1/3", "1/6"],
    order=4,
    b_hat=["1/6", "1/3", "1/3", 0, "1/6"],
    error_estimator_order=3,
    reference=f"{_PAPER} (the classical method); estimate: f at the new point instead of the fourth stage",
)
RK5 = _Published(
    "RK5",
    [
        [],
        ["1/4"],
        ["3/32", "9/32"],
        ["1932/2197", "-7200/2197", "7296/2197"],
        ["439/216", -8, "3680/513", "-845/4104"],
        ["-8/27", 2, "-3544/2565", "1859/4104", "-11/40"],
    ],
    ["16/135", 0, "6656/12825", "28561/56430", "-9/50", "2/55"],
    order=5,
    b_hat=["25/216", 0, "1408/2565", "2197/4104", "-1/5", 0],
    error_estimator_order=4,
    reference="Fehlberg's 4(5) pair: Hairer, Norsett & Wanner, Solving ODEs I, table II.5.1",
)

RK23 = _Published(
    "RK23",
    [[], ["1/2"], [0, "3/4"]],
    ["2/9", "1/3", "4/9"],
    order=3,
    b_hat=["7/24", "1/4", "1/3", "1/8"],
    error_estimator_order=2,
    P=[[1, "-4/3", "5/9"], [0, 1, "-2/3"], [0, "4/3", "-8/9"], [0, -1, 1]],
    reference="Bogacki & Shampine, Appl. Math. Lett. 2 (1989) 321; interpolant: cubic Hermite",
)
RK45 = _Published(
    "RK45",
    [
        [],
        ["1/5"],
        ["3/40", "9/40"],
        ["44/45", "-56/15", "32/9"],
        ["19372/6561", "-25360/2187", "64448/6561", "-212/729"],
        ["9017/3168", "-355/33", "46732/5247", "49/176", "-5103/18656"],
    ],
    ["35/384", 0, "500/1113", "125/192", "-2187/6784", "11/84"],
    order=5,
    b_hat=["5179/57600", 0, "7571/16695", "393/640", "-92097/339200", "187/2100", "1/40"],
    error_estimator_order=4,
    P=[
        [1, "-8048581381/2820520608", "8663915743/2820520608", "-12715105075/11282082432"],
        [0, 0, 0, 0],
        [0, "131558114200/32700410799", "-68118460800/10900136933", "87487479700/32700410799"],
        [0, "-1754552775/470086768", "14199869525/1410260304", "-10690763975/1880347072"],
        [0, "127303824393/49829197408", "-318862633887/49829197408", "701980252875/199316789632"],
        [0, "-282668133/205662961", "2019193451/616988883", "-1453857185/822651844"],
        [0, "40617522/29380423", "-110615467/29380423", "69997945/29380423"],
    ],
    reference="Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19; interpolant: Shampine, Math. Comp. 46 (1986) 135",
)


def _dop853() -> Tableau:
    """Return the tableau of DOP853, with the coefficients of SciPy's public class so that they are not copied."""
    import scipy.integrate

    source = scipy.integrate.DOP853
    b = [Fraction(float(x)) for x in source.B]
    return _Published(
        "DOP853",
        [[float(x) for x in row[:i]] for i, row in enumerate(source.A[: len(b), : len(b)])],
        b,
        order=8,
        c=[float(x) for x in source.C[: len(b)]],
        b_hat=[x - Fraction(float(e)) for x, e in zip([*b, Fraction(0)], source.E5, strict=True)],
        error_estimator_order=7,
        e_low=[float(x) for x in source.E3],
        reference="Hairer, Norsett & Wanner, Solving ODEs I, section II.10 (DOP853)",
    )


DOP853 = _dop853()
