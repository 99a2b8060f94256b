"""Explicit Runge-Kutta methods: their tableaux as exact fractions, also from solver classes like those of SciPy.

User-defined tableaux are checked against the order conditions when they are created; those of the package are checked
by its tests.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import cache, cached_property
from itertools import combinations_with_replacement, pairwise
from typing import Any

import numpy as np
import scipy.integrate
from scipy.integrate import OdeSolver

from ..engine import data
from .base import DenseForm, Method

__all__ = ["DOP853", "RK1", "RK2", "RK3", "RK4", "RK5", "RK23", "RK45", "Tableau", "is_same", "tableau_of"]

# Bound on rounding errors in tableaux of floats.
FLOAT_TOLERANCE = 1e-12
# Attributes of SciPy's RungeKutta classes, and the functions that make a step from them.
ATTRIBUTES = ("order", "error_estimator_order", "n_stages", "A", "B", "C", "E", "P", "E3", "E5")
STEP = ("_step_impl", "_estimate_error", "_estimate_error_norm")
# Names of the order of the embedded method, in SciPy and in other packages.
EMBEDDED = ("error_estimator_order", "order_secondary")
WANTED = "a subclass of SciPy's RungeKutta such as RK45, or a class with the same attributes"

Number = int | float | str | Fraction
Tree = tuple["Tree", ...]


@cache
def rooted_trees(order: int) -> tuple[Tree, ...]:
    """Return all rooted trees with `order` vertices, each a tuple of its subtrees."""
    return tuple(forests(order - 1, order - 1, rooted_trees))


def forests(vertices: int, largest: int, trees: Callable[[int], tuple[Tree, ...]]) -> Iterator[Tree]:
    """Yield the multisets of `trees` with `vertices` vertices in all and at most `largest` vertices per tree."""
    if largest == 0:
        if vertices == 0:
            yield ()
        return
    for count in range(vertices // largest + 1):
        for group in combinations_with_replacement(trees(largest), count):
            for rest in forests(vertices - count * largest, largest - 1, trees):
                yield (*group, *rest)


@cache
def size(tree: Tree) -> int:
    """Return the number of vertices of a tree."""
    return 1 + sum(map(size, tree))


@cache
def density(tree: Tree) -> int:
    """Return the density of a tree: 1 / density is the weight of the tree in the exact solution."""
    return size(tree) * math.prod(map(density, tree))


def _stage_weights(tree: Tree, A: np.ndarray) -> np.ndarray:
    """Return the factor of b_i in the elementary weight of `tree` (Hairer, Norsett & Wanner I, eq. II.2.15)."""
    phi = np.ones(len(A), A.dtype)
    for sub in tree:
        phi = phi * A.dot(_stage_weights(sub, A))
    return phi


def order_residuals(A: np.ndarray, b: np.ndarray, order: int) -> Iterator[tuple[Tree, Number]]:
    """Yield (tree, residual) for every order condition up to `order`: sum_i b_i phi_i(tree) - 1 / density(tree)."""
    for vertices in range(1, order + 1):
        for tree in rooted_trees(vertices):
            yield tree, b.dot(_stage_weights(tree, A)) - Fraction(1, density(tree))


class Coefficients(Method):
    """Base class of tableaux. Each attribute is set once, and arrays are read-only."""

    _kind: str
    n_stages: int

    def __setattr__(self, name: str, value: Any) -> None:
        if name in vars(self):
            raise AttributeError(f"cannot assign to {name!r}: the coefficients of a method do not change.")
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        super().__setattr__(name, value)

    def _vector(self, values: Sequence[Number]) -> np.ndarray:
        """Return numbers as an array of fractions, and of floats where floats are given."""
        out = np.empty(len(values), dtype=object)
        for k, value in enumerate(values):
            try:
                out[k] = value if isinstance(value, float) else Fraction(value)
            except (TypeError, ValueError):
                out[k] = math.nan
            if not math.isfinite(out[k]):
                raise ValueError(
                    f"{self.name}: coefficients must be finite numbers or strings such as '1/3', got {value!r}."
                )
        return out

    def _stage_matrix(self, A: Sequence[Sequence[Number]], s: int) -> np.ndarray:
        """Return the stage matrix (s, s) as `_vector` does, after a check that it is strictly lower triangular."""
        if len(A) != s:
            raise ValueError(f"{self.name}: A has {len(A)} rows and b has {s} entries; they must have the same number.")
        full = np.full((s, s), Fraction(0), dtype=object)
        for i, row in enumerate(A):
            entries = self._vector(row)
            if any(entries[i:]):
                raise ValueError(
                    f"{self.name}: row {i} of A reaches its diagonal; an explicit method needs A strictly lower "
                    "triangular."
                )
            full[i, : min(i, len(entries))] = entries[:i]
        return full

    def __repr__(self) -> str:
        estimate = f", estimate of order {self.error_estimator_order}" if self.has_estimate else ""
        return f"<{self._kind} {self.name}: {self.n_stages} stages, order {self.order}{estimate}>"


class Published:
    """Mixin of a tableau of this package, whose order the tests check, because a check would slow down each import."""

    name: str

    def _check_order(self, *args: Any) -> None:
        pass

    def __reduce__(self) -> str:
        return self.name  # of the variable too


class Tableau(Coefficients):
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

    _kind = "Tableau"

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
        order = check_integer(name, "order", order)
        s = len(b)
        self.name, self.order, self.n_stages, self.reference = name, order, s, reference
        exact_A, exact_b = self._stage_matrix(A, s), self._vector(b)
        nodes = exact_A.sum(axis=1) if s > 1 else self._vector([0])
        nodes = nodes if c is None else self._nodes(c, nodes)
        self._check_order("b", exact_A, exact_b, order)
        weights_hat = None
        if b_hat is not None and error_estimator_order is not None:
            # The combined estimate of a pair of orders 5 and 3 has the order 2 * 5 - 3 = 7.
            weights_hat = self._embedded(exact_A, exact_b, b_hat, error_estimator_order - (0 if e_low is None else 2))
        elif b_hat is not None or error_estimator_order is not None:
            given, missing = ("b_hat", "error_estimator_order")[:: 1 if b_hat is not None else -1]
            raise ValueError(f"{name}: {given} was given without {missing}; give both or neither.")
        self.A, self.b, self.c = (values.astype(float) for values in (exact_A, exact_b, nodes))
        self.b_hat = None if weights_hat is None else weights_hat.astype(float)
        self.error_estimator_order = error_estimator_order
        self.fsal = b_hat is not None and len(b_hat) == s + 1
        e = np.zeros(s + 1) if weights_hat is None else self._vector([*exact_b, 0]) - weights_hat
        self.e = e.astype(float)
        self.e_low = np.zeros(s + 1) if e_low is None else self._vector(e_low).astype(float)
        self.P = None if P is None else np.array([self._vector(row) for row in P]).astype(float)
        self.b_low = low_parts(exact_b, nodes, [Fraction(1, k + 1) for k in range(order)])

    def _nodes(self, c: Sequence[Number], row_sums: np.ndarray) -> np.ndarray:
        """Return the nodes `c` after a check that they are the row sums of the stage matrix."""
        nodes = self._vector(c)
        if len(c) != len(row_sums) or (np.abs((nodes - row_sums).astype(float)) > FLOAT_TOLERANCE).any():
            raise ValueError(
                f"{self.name}: c = {list(map(str, nodes))} differs from the row sums of A, "
                f"{list(map(str, row_sums))}. Correct A or c, or omit c."
            )
        return nodes

    def _embedded(self, A: np.ndarray, b: np.ndarray, b_hat: Sequence[Number], order: int) -> np.ndarray:
        """Return `b_hat` with s + 1 entries after a check of its order; the row of f at the new point in A is `b`."""
        s = len(b)
        if len(b_hat) not in (s, s + 1):
            raise ValueError(
                f"{self.name}: b_hat has {len(b_hat)} entries; expected {s} or {s + 1} (with f at the new point)."
            )
        weights = self._vector([*b_hat, *[0] * (s + 1 - len(b_hat))])
        self._check_order("b_hat", self._stage_matrix([*A[:, :-1].tolist(), b.tolist()], s + 1), weights, order)
        return weights

    def _check_order(self, label: str, A: np.ndarray, b: np.ndarray, order: int) -> None:
        exact = not any(isinstance(v, float) for v in (*A.ravel(), *b))
        if not exact:
            A, b = A.astype(float), b.astype(float)
        for tree, residual in order_residuals(A, b, order):
            if residual != 0 if exact else abs(float(residual)) > FLOAT_TOLERANCE:
                raise ValueError(
                    f"{self.name}: {label} is not of order {order}: the condition of tree {tree} of order {size(tree)} "
                    f"is violated by {float(residual):.3g}."
                )

    @property
    def paired(self) -> bool:
        """True if the error estimate has two parts, with the weights `e` and `e_low`."""
        return bool(np.any(self.e_low))

    def class_attributes(self) -> dict[str, Any]:
        found = super().class_attributes() | {"A": self.A, "B": self.b, "C": self.c}
        if self.paired:
            found |= {"E5": self.e, "E3": self.e_low}
        elif self.has_estimate:
            found["E"] = -self.e  # SciPy's are the embedded weights less those of the step
        return found if self.P is None else found | {"P": self.P}

    @cached_property
    def _record(self) -> data.Method:
        none = np.zeros(self.n_stages)
        return data.Method(  # of copies, because the engine only takes arrays that can be written to
            A=self.A.copy(), b=self.b.copy(), b_low=self.b_low.copy(), b_v=none, b_v_low=none, c=self.c.copy(),
            e=self.e.copy(), e_v=none, e_low=self.e_low.copy(), nystrom=False, sees_velocity=False, fsal=self.fsal,
            paired=self.paired, exponent=self.exponent,
        )  # fmt: skip

    def for_engine(self, sees_velocity: bool = False) -> data.Method:
        return self._record

    def dense_form(self, stepper: Any) -> DenseForm:
        return DenseForm(data.CUBIC, 3) if self.P is None else DenseForm(data.POLYNOMIAL, 1 + self.P.shape[1], self.P.T)

    def rated_stages(self) -> np.ndarray:
        stages = (self.b != 0) | (self.b_low != 0)
        if self.P is not None:
            stages |= np.any(self.P[: stages.size] != 0, axis=1)
        stages[0] = True  # interpolants need the rate at the start of a step
        return stages.astype(np.int64)


def check_integer(name: str, label: str, value: Any, least: int = 1) -> int:
    """Return an integer, at least `least`, or raise a ValueError that names the method and the argument."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(f"{name}: {label} must be an integer >= {least}, got {value!r}.")
    return int(value)


def low_parts(b: np.ndarray, c: np.ndarray, moments: Sequence[Fraction]) -> np.ndarray:
    """Return the rounding errors of `b`, with the smallest corrections so that sum b c^k = moments[k] for rounded `c`.

    Rounded weights and nodes violate the quadrature moments by about 1e-17, a systematic error that long compensated
    runs would otherwise accumulate. Nodes that differ only by rounding count as one: the number of moments is at most
    the number of nodes, and a correction that uses the difference of two such nodes would be large.
    """
    lost = [float(Fraction(x) - Fraction(float(x))) for x in b]
    weights = [Fraction(float(x)) + Fraction(y) for x, y in zip(b, lost, strict=True)]
    nodes = [Fraction(float(x)) for x in c]
    distinct = len(nodes) and 1 + sum(right - left > FLOAT_TOLERANCE for left, right in pairwise(sorted(nodes)))
    missing = [
        moment - sum(w * x**k for w, x in zip(weights, nodes, strict=True))
        for k, moment in enumerate(moments[:distinct])
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


def tableau_of(solver: type[OdeSolver]) -> Tableau:
    """Return a tableau with the coefficients of a solver class of another package, without its step control."""
    name = solver.__name__
    A, b, c, E, P = (_array(solver, attribute) for attribute in "ABCEP")
    order = getattr(solver, "order", None)
    if A is None or b is None or c is None or not isinstance(order, int):
        raise TypeError(
            f"eip_method: {name} has no coefficients A, B, C and order, which define an explicit Runge-Kutta method. "
            "Of the other solvers only SciPy's Radau and BDF can be projected, as EIPRadau and EIPBDF. Use one "
            f"of these two, or give {WANTED}, or a Tableau."
        )
    _require_plain_steps(solver)
    given: dict[str, Any] = {"c": _floats(c), "reference": f"the class {solver.__module__}.{solver.__qualname__}"}
    if E is not None:
        b_hat = np.append(b, np.zeros(E.size - b.size)) + E
        given["b_hat"] = _floats(b_hat if E[-1] != 0 else b_hat[: b.size])
        orders = (getattr(solver, attribute, None) for attribute in EMBEDDED)
        given["error_estimator_order"] = next((found for found in orders if isinstance(found, int)), None)
    if P is not None and P.shape[0] == b.size + 1:  # other rows belong to further stages; the default is a cubic
        given["P"] = _floats(P)
    found = Tableau(name, _floats(A), _floats(b), order, **given)
    if found.P is not None:
        _check_dense_output(found, found.P)
    return found


def is_same(solver: type[OdeSolver], own: type[OdeSolver]) -> bool:
    """Return True if `solver` is a subclass of `own` with the same coefficients and the same methods in `STEP`."""
    if not issubclass(solver, own) or _own_functions(solver, own):
        return False
    pairs: Any = ((getattr(solver, name, None), getattr(own, name, None)) for name in ATTRIBUTES)
    return all(one is other or np.array_equal(one, other) for one, other in pairs)


def _array(solver: type, name: str) -> np.ndarray | None:
    value = getattr(solver, name, None)
    return value if isinstance(value, np.ndarray) and value.size else None


def _floats(values: np.ndarray) -> Any:
    return values.astype(float).tolist()


def _require_plain_steps(solver: type[OdeSolver]) -> None:
    """Raise TypeError if the steps of a class do not follow from its coefficients A, B, C and E alone."""
    name, weights = solver.__name__, _array(solver, "E")
    if _array(solver, "Bp") is not None:
        raise TypeError(f"eip_method: {name} is a Runge-Kutta-Nystrom method; give its coefficients as NystromTableau.")
    base: Any = scipy.integrate.RK45.__bases__[0]
    has_parts = _array(solver, "E5") is not None
    own = _own_functions(solver, base) if issubclass(solver, base) and not has_parts else []
    if own:
        raise TypeError(
            f"eip_method: {name} has its own {own[0]}, but eip_method reads only the coefficients, so that its steps "
            "would differ from those of the class. Give a Tableau, or an object with one_step(t, y, h) and order."
        )
    if weights is None and has_parts:
        raise TypeError(
            f"eip_method: the estimate of {name} has two parts, E5 and E3, as that of SciPy's DOP853. Use EIPDOP853 "
            "for DOP853, and give other coefficients as Tableau(..., b_hat=..., e_low=...)."
        )
    if weights is not None and not weights.any():
        raise TypeError(
            f"eip_method: the error weights E of {name} are all 0, so {name} does not compute its error estimate "
            "from E. Give a Tableau with the weights b_hat of the embedded method."
        )


def _own_functions(solver: type[OdeSolver], base: type[OdeSolver]) -> list[str]:
    return [name for name in STEP if getattr(solver, name, None) is not getattr(base, name, None)]


def _check_dense_output(tableau: Tableau, P: np.ndarray) -> None:
    """Raise ValueError unless `P` gives the step's result at its end, and has order 2 inside it.

    That is, the weights b_i(theta) = sum_j P_ij theta^(j + 1) have the sum theta, and with the nodes theta^2 / 2.
    """
    powers, nodes = np.eye(P.shape[1], 2), np.append(tableau.c, 1.0)
    missed = P.sum(axis=1) - np.append(tableau.b, 0.0), P.sum(axis=0) - powers[:, 0], nodes @ P - 0.5 * powers[:, 1]
    worst = float(np.abs(np.concatenate(missed)).max())
    if worst > np.sqrt(FLOAT_TOLERANCE):
        raise ValueError(
            f"eip_method: the dense output P of {tableau.name} does not belong to its steps. Each row of P must sum "
            "to the weight of its stage in B (0 for the last row), and inside the step P must meet the order "
            f"conditions; the largest error is {worst:.3g}. Correct P."
        )


def read(text: str) -> list[list[str]]:
    """Return the rows of coefficients of a text, between semicolons; a line may be broken after a slash."""
    return [row.split() for row in re.sub(r"/\s+", "/", text).split(";")]


class _DOP853(Published, Tableau):
    """The tableau of DOP853, with the coefficients of SciPy's public class so that they are not copied."""

    def __init__(self) -> None:
        source = scipy.integrate.DOP853
        b = [Fraction(float(x)) for x in source.B]
        super().__init__(
            "DOP853",
            [[float(x) for x in row[:i]] for i, row in enumerate(source.A[: len(b), : len(b)])],
            b,
            order=8,
            c=[float(x) for x in source.C[: len(b)]],
            b_hat=[x - Fraction(float(e)) for x, e in zip([*b, Fraction(0)], source.E5, strict=True)],
            error_estimator_order=7,
            e_low=[float(x) for x in source.E3],
            reference="Hairer, Norsett & Wanner, Solving ODEs I, section II.10 (DOP853), doi:10.1007/978-3-540-78862-1",
        )

    def dense_form(self, stepper: Any) -> DenseForm:
        source = scipy.integrate.DOP853  # whose dense output has three further stages
        return DenseForm(data.SEVENTH, 3 + len(source.D), source.D, source.A_EXTRA, source.C_EXTRA)


class _Published(Published, Tableau):
    """A tableau of this package, from a text with the rows of A, then b, and b_hat if it has an estimate."""

    def __init__(
        self, name: str, text: str, order: int, error_estimator_order: int | None = None, **given: Any
    ) -> None:
        rows = read(text)
        b_hat = None if error_estimator_order is None else rows.pop()
        *A, b = rows
        super().__init__(name, A, b, order, b_hat=b_hat, error_estimator_order=error_estimator_order, **given)


_PAPER = "Cai, Gong & Wang, An explicit and practically invariants-preserving method, section 2.1"

RK1 = _Published("RK1", "; 1", 1, reference=f"{_PAPER} (explicit Euler)")
RK2 = _Published("RK2", "; 1/2; 0 1; 1 0", 2, 1, reference=f"{_PAPER} (explicit midpoint); estimate: explicit Euler")
RK3 = _Published(
    "RK3", "; 1/3; 0 2/3; 1/4 0 3/4; 0 1/2 1/2", 3, 2,
    reference=f"{_PAPER} (Heun's third-order method); estimate: the second-order rule on its last two stages",
)  # fmt: skip
RK4 = _Published(
    "RK4", "; 1/2; 0 1/2; 0 0 1; 1/6 1/3 1/3 1/6; 1/6 1/3 1/3 0 1/6", 4, 3,
    reference=f"{_PAPER} (the classical method); estimate: f at the new point instead of the fourth stage",
)  # fmt: skip
RK5 = _Published(
    "RK5",
    """
        ; 1/4; 3/32 9/32; 1932/2197 -7200/2197 7296/2197; 439/216 -8 3680/513 -845/4104;
        -8/27 2 -3544/2565 1859/4104 -11/40;
        16/135 0 6656/12825 28561/56430 -9/50 2/55;
        25/216 0 1408/2565 2197/4104 -1/5 0
    """,
    5, 4,
    reference="Fehlberg's 4(5) pair: Hairer, Norsett & Wanner, Solving ODEs I, table II.5.1, doi:10.1007/978-3-540-"
    "78862-1",
)  # fmt: skip
RK23 = _Published(
    "RK23", "; 1/2; 0 3/4; 2/9 1/3 4/9; 7/24 1/4 1/3 1/8", 3, 2,
    P=read("1 -4/3 5/9; 0 1 -2/3; 0 4/3 -8/9; 0 -1 1"),
    reference="Bogacki & Shampine, Appl. Math. Lett. 2 (1989) 321, doi:10.1016/0893-9659(89)90079-7; interpolant: "
    "cubic Hermite",
)  # fmt: skip
RK45 = _Published(
    "RK45",
    """
        ; 1/5; 3/40 9/40; 44/45 -56/15 32/9; 19372/6561 -25360/2187 64448/6561 -212/729;
        9017/3168 -355/33 46732/5247 49/176 -5103/18656;
        35/384 0 500/1113 125/192 -2187/6784 11/84;
        5179/57600 0 7571/16695 393/640 -92097/339200 187/2100 1/40
    """,
    5, 4,
    P=read("""
        1 -8048581381/2820520608 8663915743/2820520608 -12715105075/11282082432; 0 0 0 0;
        0 131558114200/32700410799 -68118460800/10900136933 87487479700/32700410799;
        0 -1754552775/470086768 14199869525/1410260304 -10690763975/1880347072;
        0 127303824393/49829197408 -318862633887/49829197408 701980252875/199316789632;
        0 -282668133/205662961 2019193451/616988883 -1453857185/822651844;
        0 40617522/29380423 -110615467/29380423 69997945/29380423
    """),
    reference="Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19, doi:10.1016/0771-050X(80)90013-3; interpolant: "
    "Shampine, Math. Comp. 46 (1986) 135",
)  # fmt: skip
DOP853 = _DOP853()
