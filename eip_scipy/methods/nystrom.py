"""Explicit Runge-Kutta-Nystrom methods for q'' = a(t, q): their tableaux as exact fractions, and their interpolants.

User-defined tableaux are checked against the order conditions when they are created; those of the package are checked
by its tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import cache, cached_property
from itertools import chain, product
from typing import TYPE_CHECKING, Any

import numpy as np

from ..engine import data
from .base import DenseForm
from .runge_kutta import (
    FLOAT_TOLERANCE,
    Coefficients,
    Number,
    Published,
    Tree,
    check_integer,
    density,
    forests,
    low_parts,
    read,
    size,
)

if TYPE_CHECKING:
    from ..core.runs import Run, Start

__all__ = ["RKN86", "RKN1210", "NystromTableau", "check_halves", "depends_on_velocity"]

# Order conditions are summed in decimals of this many digits, because fractions would accumulate the denominators of
# all stages.
DIGITS = 77
# The published fractions of RKN1210 miss the conditions by 2e-54; floats by 1e-16 times the size of the coefficients.
TOLERANCE = 1e-50
# With more than seven moments the corrections would exceed the rounding errors, and a step would not resolve them.
MOMENTS = 7
# Methods of lower order are interpolated by the quintic through positions, velocities and accelerations at both ends.
LEAST_ORDER = 6
# Number of stages in a group that precedes the others, and how often groups are added.
GROUP, MOST_GROUPS = 6, 3
# Number of Newton iterations for a node, and their precision in bits.
ITERATIONS, BITS = 12, 120
# A condition is dependent on others if its residual relative to its size is below the first number, and met if it is
# below the second.
DEPENDENT, MET = 1e-10, 1e-11

Array = np.ndarray


@cache
def nystrom_trees(order: int) -> tuple[Tree, ...]:
    """Return all special Nystrom trees with `order` vertices (Hairer, Norsett & Wanner I, section II.14).

    The root is an acceleration. Its subtrees are velocities, and those have an acceleration as only subtree, or none.
    """
    return tuple(forests(order - 1, order - 1, _velocity_trees))


def _velocity_trees(order: int) -> tuple[Tree, ...]:
    return ((),) if order == 1 else tuple((tree,) for tree in nystrom_trees(order - 1))


def stage_factors(A: Array, c: Array) -> Callable[[Tree], Array]:
    """Return the function phi(tree) -> (s,) of the factors of the stages in the order condition of a Nystrom tree.

    phi_i is c_i for each velocity without a subtree, times sum_j A_ij phi_j(subtree) for each other velocity.
    """

    @cache
    def phi(tree: Tree) -> Array:
        leaves = tree.count(())
        factors = c**leaves if leaves else np.ones_like(c)
        for velocity in tree:
            if velocity:
                factors = factors * (A.T * phi(velocity[0])[:, None]).sum(axis=0)
        return factors

    return phi


def _decimals(values: Array) -> Array:
    exact = (Fraction(value) for value in values.ravel())
    found = [Decimal(value.numerator) / value.denominator for value in exact]
    return np.array(found, dtype=object).reshape(values.shape)


class NystromTableau(Coefficients):
    """Coefficients of an explicit Runge-Kutta-Nystrom method for q'' = a(t, q).

    With the accelerations k_i = a(t + c_i h, Q_i) at the stages Q_i = q + c_i h v + h^2 sum_j A_ij k_j, a step is
    q + h v + h^2 sum_i b_i k_i and v + h sum_i b'_i k_i.

    Parameters
    ----------
    name : str
        Name of the method.
    A : sequence of sequences
        Strictly lower triangular stage matrix; row i needs only its first i entries. Entries are int, Fraction,
        strings such as ``"1/3"`` (exact) or floats.
    b, b_prime : sequence, length s
        Weights of the position and of the velocity.
    c : sequence, length s
        Nodes.
    order : int
        Order of the step, checked against every order condition: to 1e-50 for rational entries, to 1e-12 for floats.
    b_hat, b_prime_hat : sequence, length s, optional
        Weights of the embedded estimate; both or none. (In the papers the hat denotes the step, not the estimate.)
    error_estimator_order : int, optional
        Order of the estimate, checked in the same way; required with `b_hat`.
    reference : str
        Source of the coefficients, including the table.

    Attributes
    ----------
    A, b, b_prime, c : ndarray of float64
        (s, s), (s,), (s,), (s,).
    b_hat, b_prime_hat : ndarray of float64, shape (s,), or None
    e, e_prime : ndarray of float64, shape (s,)
        Weights of the error estimate, ``b - b_hat`` and ``b_prime - b_prime_hat``; zero without an estimate.
    b_low, b_prime_low : ndarray of float64, shape (s,)
        Rounding errors of `b` and `b_prime` in double precision, for compensated summation, corrected as follows. The
        step uses rounded nodes, with which even exact weights violate the quadrature conditions by 1e-17, with the same
        sign in each step; therefore the low parts make the first moments exact for the rounded nodes. The number of
        these moments is at most seven, at most `order`, and at most the number of distinct nodes whose weights are not
        zero. Weights of zero stay zero.
    exact : mapping from str to ndarray of object
        A, b, b_prime, c and, if given, b_hat and b_prime_hat, as fractions (floats where floats were given).
    n_stages : int
        Number of stages.
    fsal : bool
        True if the last stage is only used by the error estimate, and is the first stage of the next step.

    Raises
    ------
    ValueError
        If the tableau is not explicit, its first stage is not at the start of the step, shapes disagree, or an order
        condition fails.
    """

    _kind = "NystromTableau"
    of_second_order = True

    def __init__(
        self,
        name: str,
        A: Sequence[Sequence[Number]],
        b: Sequence[Number],
        b_prime: Sequence[Number],
        c: Sequence[Number],
        order: int,
        *,
        b_hat: Sequence[Number] | None = None,
        b_prime_hat: Sequence[Number] | None = None,
        error_estimator_order: int | None = None,
        reference: str = "",
    ) -> None:
        order, s = check_integer(name, "order", order), len(b)
        given = {"b": b, "b_prime": b_prime, "c": c}
        if b_hat is not None and b_prime_hat is not None and error_estimator_order is not None:
            error_estimator_order = check_integer(name, "error_estimator_order", error_estimator_order)
            given |= {"b_hat": b_hat, "b_prime_hat": b_prime_hat}
        elif any(value is not None for value in (b_hat, b_prime_hat, error_estimator_order)):
            raise ValueError(
                f"{name}: give all or none of b_hat, b_prime_hat and error_estimator_order; some are missing."
            )
        self.name, self.order, self.n_stages, self.reference = name, order, s, reference
        self.error_estimator_order = error_estimator_order
        exact = {"A": self._stage_matrix(A, s), **{key: self._row(key, row) for key, row in given.items()}}
        if exact["c"][0] != 0:
            raise ValueError(
                f"{name}: the first node is {exact['c'][0]}, expected 0: the first stage is at the start of the step."
            )
        self._check_order(exact)
        # The last stage may be at the new position and time, without being used by the step.
        unused = exact["c"][-1] == 1 and exact["b"][-1] == 0 and exact["b_prime"][-1] == 0
        self.fsal = bool(unused and np.array_equal(exact["A"][-1], exact["b"]))
        self.A, self.b, self.b_prime, self.c = (exact[key].astype(float) for key in ("A", "b", "b_prime", "c"))
        self.b_hat, self.b_prime_hat = (
            exact[key].astype(float) if key in exact else None for key in ("b_hat", "b_prime_hat")
        )
        self.e, self.e_prime = _difference(exact, "b"), _difference(exact, "b_prime")
        # Values that a method of this order requires of sum_i b_i c_i^k and of sum_i b'_i c_i^k, k = 0, 1, ...
        positions = [Fraction(1, (k + 1) * (k + 2)) for k in range(min(order - 1, MOMENTS))]
        velocities = [Fraction(1, k + 1) for k in range(min(order, MOMENTS))]
        self.b_low = _low_parts_of_used(exact["b"], exact["c"], positions)
        self.b_prime_low = _low_parts_of_used(exact["b_prime"], exact["c"], velocities)
        for values in exact.values():
            values.setflags(write=False)
        self.exact: Mapping[str, Array] = exact

    def _row(self, label: str, values: Sequence[Number]) -> Array:
        if len(values) != self.n_stages:
            raise ValueError(
                f"{self.name}: {label} has {len(values)} entries and b has {self.n_stages}; they must have the same "
                "number."
            )
        return self._vector(values)

    def _check_order(self, exact: Mapping[str, Array]) -> None:
        """Raise ValueError if weights miss a condition of their order.

        For a velocity the residuals are sum_i b'_i phi_i(tree) - 1 / density(tree), for trees of up to `order`
        vertices. For a position they are sum_i b_i phi_i(tree) - 1 / ((vertices + 1) density(tree)), for trees of up to
        one vertex less. For phi see `stage_factors`.
        """
        orders = {"b": self.order, "b_prime": self.order}
        if self.error_estimator_order is not None:
            orders |= {"b_hat": self.error_estimator_order, "b_prime_hat": self.error_estimator_order}
        floats = any(isinstance(value, float) for values in exact.values() for value in values.ravel())
        tolerance = FLOAT_TOLERANCE if floats else TOLERANCE
        with localcontext(prec=DIGITS):
            values = {key: _decimals(row) for key, row in exact.items()}
            phi = stage_factors(values["A"], values["c"])
            trees = chain.from_iterable(map(nystrom_trees, range(1, max(orders.values()) + 1)))
            for tree, (key, order) in product(trees, orders.items()):
                position, vertices = "prime" not in key, size(tree)
                if vertices + position > order:
                    continue
                right = Decimal(1) / (density(tree) * (1 + vertices * position))
                residual = values[key].dot(phi(tree)) - right
                if abs(residual) > tolerance:
                    raise ValueError(
                        f"{self.name}: {key} is not of order {order}: a condition of order {vertices + position} is "
                        f"violated by {float(residual):.3g}."
                    )

    def checked(self, run: Run, start: Start) -> NystromTableau:
        if depends_on_velocity(run, start):
            raise ValueError(
                f"{run.name} integrates q'' = a(t, q), but the accelerations in fun depend on the velocity; use a "
                "Runge-Kutta method such as EIPDOP853."
            )
        return self

    @cached_property
    def _record(self) -> data.Method:
        # If the last stage is the first stage of the next step, it is f at the new point and is evaluated after the
        # step.
        s = self.n_stages - self.fsal
        e, e_v = (np.concatenate([e, np.zeros(s + 1 - e.size)]) for e in (self.e, self.e_prime))
        return data.Method(  # of copies, because the engine only takes arrays that can be written to
            A=self.A[:s, :s].copy(), b=self.b[:s].copy(), b_low=self.b_low[:s].copy(), b_v=self.b_prime[:s].copy(),
            b_v_low=self.b_prime_low[:s].copy(), c=self.c[:s].copy(), e=e, e_v=e_v, e_low=np.zeros(s + 1),
            nystrom=True, sees_velocity=False, fsal=bool(e[-1] != 0.0 or e_v[-1] != 0.0), paired=False,
            exponent=self.exponent,
        )  # fmt: skip

    def for_engine(self, sees_velocity: bool = False) -> data.Method:
        return self._record._replace(sees_velocity=True) if sees_velocity else self._record

    def dense_form(self, stepper: Any) -> DenseForm:
        return DenseForm(data.QUINTIC, 3) if self.order < LEAST_ORDER else interpolant(self)


def _difference(exact: Mapping[str, Array], key: str) -> Array:
    """Return the weights `key` minus those of the estimate, rounded once; 0 without an estimate."""
    if f"{key}_hat" not in exact:
        return np.zeros(len(exact[key]))
    pairs = zip(exact[key], exact[f"{key}_hat"], strict=True)
    return np.array([float(Fraction(x) - Fraction(y)) for x, y in pairs])


def _low_parts_of_used(b: Array, c: Array, moments: Sequence[Fraction]) -> Array:
    """Return the output of `low_parts` for those weights `b` that are not zero, and 0 for the others."""
    used, low = b != 0, np.zeros(len(b))
    low[used] = low_parts(b[used], c[used], moments)
    return low


def check_halves(n: int) -> None:
    """Raise a ValueError if a state of n components cannot be (q, v), because n is odd."""
    if n % 2:
        raise ValueError(
            "a Nystrom or Gauss-Jackson method needs the state (q, v) with an even number of components, but y0 has "
            f"{n}. Use a Runge-Kutta method such as EIPDOP853."
        )


def depends_on_velocity(run: Run, start: Start) -> bool:
    """Return True if accelerations depend on v at the start; raise ValueError if the state is not (q, v).

    The right-hand side is evaluated once more, with other velocities.
    """
    t0, y0, f0, _ = start
    check_halves(y0.size)
    half = y0.size // 2
    other = y0.copy()
    other[half:] = 1.5 * y0[half:] + 1.0
    f = run.problem.derivative(t0, other)
    if not (np.array_equal(f0[:half], y0[half:]) and np.array_equal(f[:half], other[half:])):
        raise ValueError(
            f"{run.name} integrates q'' = a(t, q) with the state (q, v): the first {half} components of fun must be "
            "v, the second half of the state, but are not. Use a Runge-Kutta method such as EIPDOP853, or, if the "
            "system is of second order, write it with the velocities as the second half of the state"
            f"{run.problem.hint()}."
        )
    return not np.array_equal(f[half:], f0[half:], equal_nan=True)


@cache
def interpolant(tableau: NystromTableau) -> DenseForm:
    """Return the form of the interpolants of a tableau whose order p is at least `LEAST_ORDER`.

    The velocity of a step is interpolated by the integral of the polynomial through accelerations at Gauss-Lobatto
    nodes, and the position by the integral of the velocity. If the error of the position at such a node is O(h^s), the
    velocity between the nodes has an error of O(h^(s + 1)). Groups of stages at equidistant nodes are therefore
    inserted before the stages at Gauss-Lobatto nodes, until s is at least p - 1 or no further group helps.

    The rows of accelerations are those of the stages of the method, the one at the end of the step, and those of the
    further stages, in this order. The form has the nodes `c` of the further stages, the weights `A` of their positions
    over the preceding rows, and the `weights` (k, rows) of the coefficients of the polynomial of degree k - 1 through
    the accelerations at both ends and at the last k - 2 further stages, in Legendre polynomials of 2 theta - 1.
    """
    s = tableau.n_stages - tableau.fsal
    A, c = np.zeros((s + 1, s + 1)), np.ones(s + 1)
    A[:s, :s], A[s, :s], c[:s] = tableau.A[:s, :s], tableau.b[:s], tableau.c[:s]
    nodes = _lobatto_nodes(tableau.order - 3)
    reached, weights = _stages(A, c, nodes, tableau.order)
    for k in range(1, MOST_GROUPS + 1):
        if reached >= tableau.order - 1:
            break
        group = np.arange(1, GROUP * k + 1) / (GROUP * k + 1)
        longer = _extended(A, c, group, _stages(A, c, group, tableau.order)[1])
        better, further = _stages(*longer, nodes, tableau.order)
        if better <= reached:
            break
        (A, c), reached, weights = longer, better, further
    A, c = _extended(A, c, nodes, weights)
    used = np.array([0, *range(c.size - nodes.size, c.size), s])
    legendre = np.zeros((used.size, c.size))
    legendre[:, used] = _legendre_weights(c[used])
    return DenseForm(data.NYSTROM, (used.size + 1) // 2 + 1, legendre, A[s + 1 :], c[s + 1 :])


def _extended(A: Array, c: Array, nodes: Array, weights: Array) -> tuple[Array, Array]:
    """Return `A` and `c` with further stages at `nodes`, whose rows of `A` are `weights` (nodes, stages)."""
    return np.pad(np.vstack([A, weights]), ((0, 0), (0, nodes.size))), np.concatenate([c, nodes])


def _stages(A: Array, c: Array, nodes: Array, order: int) -> tuple[int, Array]:
    """Return the order of the error of positions at `nodes`, at most `order`, and the weights (nodes, stages).

    The weights meet the order conditions of all trees with up to k vertices, for the largest k for which this is
    possible at all nodes, and among such weights they have the smallest norm. The conditions are made orthonormal one
    after the other by sums over columns, because a library's solver would give other bits on another processor.
    """
    rows, met, phi = np.zeros((c.size, 0)), np.zeros((0, nodes.size)), stage_factors(A, c)
    power = 2
    for vertices in range(1, order - 1):
        before = rows.shape[1]
        for tree in nystrom_trees(vertices):
            factors = phi(tree)
            length = float(np.sqrt((factors * factors).sum())) or 1.0
            row, right = factors / length, nodes ** (vertices + 1) / ((vertices + 1) * density(tree) * length)
            for _ in range(2):
                products = (rows * row[:, None]).sum(axis=0)
                row, right = row - (rows * products).sum(axis=1), right - (products[:, None] * met).sum(axis=0)
            length = float(np.sqrt((row * row).sum()))
            if length >= DEPENDENT:
                rows, met = np.column_stack([rows, row / length]), np.vstack([met, right / length])
            elif np.abs(right).max() >= MET:
                return power, _smallest(rows[:, :before], met[:before])
        power = vertices + 2
    return power, _smallest(rows, met)


def _smallest(rows: Array, met: Array) -> Array:
    """Return the weights of smallest norm (nodes, stages) that meet orthonormal conditions: weights @ rows = met.T."""
    return np.array([(rows * column).sum(axis=1) for column in met.T])


def _lobatto_nodes(interior: int) -> Array:
    """Return the k = `interior` Gauss-Lobatto nodes inside the interval from 0 to 1, correctly rounded.

    They are the zeros of the derivative of the Legendre polynomial P_(k + 1), moved from [-1, 1] to [0, 1].
    """
    n = interior + 1
    nodes = []
    for i in range(n - 1, 0, -1):
        x = Fraction(math.cos(math.pi * i / n))
        for _ in range(ITERATIONS):
            values = _legendre(n, x)
            slope = n * (values[n - 1] - x * values[n]) / (1 - x * x)
            x -= slope * (1 - x * x) / (2 * x * slope - n * (n + 1) * values[n])
            x = Fraction(round(x * 2**BITS), 2**BITS)
        nodes.append(float((x + 1) / 2))
    return np.array(nodes)


def _legendre(degree: int, x: Any) -> list[Any]:
    """Return the Legendre polynomials of degrees 0 to `degree` at x."""
    values = [x * 0 + 1, x]
    for j in range(1, degree):
        values.append(((2 * j + 1) * x * values[j] - j * values[j - 1]) / (j + 1))
    return values


def _legendre_weights(nodes: Array) -> Array:
    """Return the weights (k, k) of Legendre coefficients over values at k Gauss-Lobatto nodes of [0, 1]."""
    k = nodes.size
    values = np.array(_legendre(k - 1, 2.0 * nodes - 1.0))
    factors = np.arange(k) + 0.5
    factors[-1] = 0.5 * (k - 1)
    return factors[:, None] * values * (2.0 / (k * (k - 1) * values[-1] ** 2))


class _Published(Published, NystromTableau):
    """A tableau of this package, from a text with the rows of A, then b, b_prime, c, b_hat and b_prime_hat."""

    def __init__(self, name: str, text: str, **given: Any) -> None:
        *A, b, b_prime, c, b_hat, b_prime_hat = read(text)
        super().__init__(name, A, b, b_prime, c, b_hat=b_hat, b_prime_hat=b_prime_hat, **given)


RKN86 = _Published(
    "RKN86",
    """
        ; 1/800; 1/600 1/300; 9/200 -9/100 9/100; -66701/197352 28325/32892 -2665/5482 2170/24669;
        227015747/304251000 -54897451/30425100 12942349/10141700 -9499/304251 539/9250;
        -1131891597/901789000 41964921/12882700 -6663147/3220675 270954/644135 -108/5875 114/1645;
        13836959/3667458 -17731450/1833729 1063919505/156478208 -33213845/39119552 13335/28544 -705/14272 1645/57088;
        223/7938 0 1175/8064 925/6048 41/448 925/14112 1175/72576;
        223/7938 0 1175/8064 925/6048 41/448 925/14112 1175/72576 0 0;
        223/7938 0 5875/36288 4625/21168 41/224 4625/21168 5875/36288 223/7938 0;
        0 1/20 1/10 3/10 1/2 7/10 9/10 1 1;
        7987313/109941300 0 1610737/44674560 10023263/33505920 -497221/12409600 10023263/78180480 1610737/402071040 0 0;
        7987313/109941300 0 1610737/40207104 10023263/23454144 -497221/6204800 10023263/23454144 1610737/40207104
        -4251941/54970650 3/20
    """,
    order=8,
    error_estimator_order=6,
    reference="Dormand, El-Mikkawy & Prince, IMA J. Numer. Anal. 7 (1987) 423, doi:10.1093/imanum/7.4.423, "
    "table 1, RKN8(6)9FM; corrigendum: IMA J. Numer. Anal. 11 (1991) 297",
)
# The paper offers these numbers on request only. Some of the longest integers are truncated in the available copies:
# with ...125 as the last digits of the numerator of A[13, 5] the conditions on that row hold exactly. All order
# conditions hold to 2e-54.
RKN1210 = _Published(
    "RKN1210",
    """
        ; 1/5000; 1/3750 1/1875; 7/2400 -1/240 1/160; 2/1215 0 4/729 32/18225;
        152/78125 0 1408/196875 2048/703125 432/546875; 29/51200 0 341/387072 -151/345600 243/716800 -11/110592;
        37/12000 0 0 2/1125 27/10000 5/3168 224/20625;
        100467472123373/27511470744477696 0 101066550784375/25488568483854336 49478218404275/15475202293768704
        21990175014231/2674726322379776 -3576386017671875/2723635603703291904 16163228153/1654104722787 38747524076705/
        10316801529179136;
        62178936641284701329/16772293867250014666848 0 46108564356250/9072835168325103 1522561724950/1296119309760729
        -45978886013453735443/2174186242050927827184 299403512366617849203125/4981371278573254356053856
        15571226634087127616/774466927638876610083 -133736375367792139885/4717207650164066625051 7461389216/
        501451974639;
        501256914705531962342417557181/14270506505142656332600844507392 0 -1143766215625/132752960853408 -6864570325/
        1185294293334 194348369382310456605879163404183/99893545535998594328205911551744
        -94634958447010580589908066176109375/27549212808177898050085930321520256 -17006472665356285286219618514/
        155584463413110817059022733377 33530528814694461893884349656345/14270506505142656332600844507392
        -13439782155791134368/17777268379678341919 1441341768767571/13159456712985856;
        105854110734231079069010159870911189747853/5156624149476760916008179453333467046288864 0 -144579793509250000/
        19842290513127000261 -101935644099967250/48188419817594143491 1585474394319811696785932424388196965/
        1709257457318830856936350991091849456 -843499776333774172853009613469456309715703125/
        510505790798199330684809765880013237582597536 -15057703799298260121553794369056896088480/
        714327132646734138085088291809720015274157 1749840442221344572962864758990584360232600/
        1450300542040339007627300471250037606768743 -11255775246405733991656178432768/27206626483067760480757659602193
        669010348769579696/7368057640845834597 4598083098752/858563707934367;
        -1639758773684715326849438048667467886824967397/11447568726280607813664651120965112496134881280 0 3942453384375/
        314673684985856 11737114158175/1719466921529856 -23710715033675876683332701739887457/
        4940189888325748664958546898558976 498150575499633273684774666731162498301909124515625/
        87415924307623977386706008889913792042985180430336 64881557768202140428371179540010005713998551/
        85896810580242200654071863296887242202224768 -2336309182318568698279006266321563486172654055/
        18316109962048972501863441793544179993815810048 -493399374030747471036018890494175/
        251658285736841065236836942273664 418285003077108927126515545155/455369916679568501838710898688
        -15171723902781457/63532954684873728 1501203688494867/9434957026426880;
        34188549803371802849576690267872548602326398788953/42496542183406636759747616530102745233754251202880 0
        -18971246281693750/1138830954584356089 -59230464334542700/2765732318276293359
        5147939981309774383134903239728881770043/305929030949718561059100251282184099064
        -3625720213550267723370658302114678215563058405229078120/324512095420929759624784749347170583153994213035432256
        -60305503318319653518547439098565661266182518307816/17856872599361492097414471889911176856851308259643
        -1036461878759982363277481306266144563833492657780645/67994467493450618815596186448164392374006801924608
        128398681100219349205889126776607047000/7473801441221286756994805323613917077 -49156374556350058671822606102117/
        9039888303968618912866414995904 12253036339964386945/8828680926314891943 -647188390508758231059/
        1092148506009694282240 10915833599872/368729913707897;
        -4939337286263213195547765488387521892799075623007291241961609516532/
        5408250052307451520718178852915698257207815452080611897685945761264 0 7588799849596321243074032368290625/
        3147217749590114939838670370597819616 16870665568420512953501332587233725/955405388268427749593882076788623812
        -808642515918378014850308582271476014669568437579087796060/
        54447992506702009927986632715967769032585338753056786562
        4610328329649866588704236006423149172472141907645890762410296050212/
        2135428689710103309390449198881479603148467934048051598947383737508
        4159963831215576225909381034291748993887819834160487158570788681/
        1040533184037697645660563795162185415624171583014576682740416336
        7381392142124351279433801934148706553542137071890521365664606664449580/
        259596002510757672994472584939953516345975141699869371088925396540699
        -3336834334584052813468828675971359774694437229547862706920/
        132102862435303266640535426836147775872819092781208127980
        426619379967412086875039012957475466130081426048213491790/
        55162410119399855550108207148248549410926885937244965785 -630755628691078947314733435975762542732598947/
        333503232300511886435069380727586592765317456 1522350657470125698997653827133798314909646891/
        1520094067152619944607524353149267399623188480 305575414262755427083262606101825880/
        65839748482572312891297405431209259829 256624643108055110568255672032710477795/
        22874609758516552135947898572671559986304;
        -571597862947184314270186718640978947715678864684269066846/
        2077055064880303907616135969012720011907767004397744786340 0 66981514290625/1829501741761029 43495576635800/
        4443075658562499 -127865248353371207265315478623656127/10401415428935853634424440540325344
        1316565142658075739557231574080234814338066993483960326560/
        92668695535091962564795912774190176478892159517481612467
        3881494143728609118531066904799685950051960514138645179820/
        2446349095978358868919950548516272963929118212742344026549
        162922667049680755852592453758428194006198229544701786842910/
        66288722243155885736983218667976563740242178853010092663614 -43986024977384568043684084266385512680544563954/
        4922783599524658241955780540171948284522386185 285912200202585226675651763671663063668290787/
        65371192072964016939690070594254881767827200 -6776815256667778089672518929/3693654613173093729492918708
        398946554885847045598775476868169/344154261237450078839899047372800 -76630698033396272/4432017119727044925
        28401702316003037/1469612686944417840 66049942462586341419969330578128801/
        12691068622536592094919763114637498325;
        83940754497395557520874219603241359529066454343054832302344735/
        64192596456995578553872477759926464976144474354415663868673233 0 892543892035485503125/51401651664490002607536
        -12732238157949399705325/686579204375687891972088 5290376174838819557032232941734928484252549/
        357179779572898187570048915214361602000384 26873229338017506937199991804717456666650215387938173031932210/
        2863980005760296740624015421425947092438943496681472214589916
        -1976497866818803305857417297961598735637414137241493515492778650/
        378029217824623393200881653405474359138017953416246216408422692
        -1002860756304839757040188283199900676042073362417943601440986856950/
        20486915674765670626893195919603679319429068544972409068469849579
        87398661196965758104117684348440686081062878816711392590/2282122412587168891929052689609009868137678763277087160
        -7922242431969626895355493632206885458496418610471389/748272134517487495468365669337985635214015258726400
        2777643183645212014464950387658055285/1141545470045611737197667093465955392
        -1372659703515496442825084239977218110461/1313121960368535725613950174847107891200 6144417902699179309851023/
        85608793932459282773805825 140294243355138853053241/64884622846351585391642880
        168671028523891369934964082754523881107337/24062875279623260368388427013982199424119600;
        63818747/5262156900 0 0 0 0 0 22555300000000/261366897038247 1696514453125/6717619827072 -45359872/229764843
        19174962087/94371046000 -19310468/929468925 16089185487681/146694672924800 1592709632/41841694125
        52675701958271/4527711056573100 12540904472870916741199505796420811396/2692319557780977037279406889319526430375
        0 0;
        63818747/5262156900 0 0 0 0 0 451106000000000/4965971043726693 8482572265625/26870479308288 -181439488/689294529
        57524886261/188742092000 -38620936/929468925 144802669389129/586778691699200 6370838528/41841694125
        368729913707897/4527711056573100 111940113324845802831946788738852162520696/
        1316544263754897771229629968877248424453375 -113178587/12362232960 1/40;
        0 1/50 1/25 1/10 2/15 4/25 1/20 1/5 1/4 1/3 1/2 5/9 3/4 6/7 8437/8926 1 1;
        27121957/1594593000 0 0 0 0 0 4006163300000/55441463008113 9466403125/25445529648 -163199648/406149975 23359833/
        69636250 -18491714/140828625 11052304606701/58344472186000 1191129152/44377554375 2033811086741/124730332137000
        3616943474975740389660406409450169802/951830146690244407118982233597812374375 0 0;
        27121957/1594593000 0 0 0 0 0 4217014000000/55441463008113 47332015625/101782118592 -652798592/1218449925
        70079499/139272500 -36983428/140828625 99470741460309/233377888744000 4764516608/44377554375 14236677607187/
        124730332137000 198066487470143918516004831967805004004/2855490440070733221356946700793437123125 1/50 0
    """,
    order=12,
    error_estimator_order=10,
    reference="Dormand, El-Mikkawy & Prince, IMA J. Numer. Anal. 7 (1987) 423, doi:10.1093/imanum/7.4.423, "
    "RKN12(10), 17 stages; fractions: Brankin, Gladwell, Dormand, Prince & Seward, ACM Trans. Math. Softw. 15 (1989) "
    "31 (Algorithm 670)",
)
