"""Tableaux: their order conditions, observed orders, refused tableaux, low parts of the weights."""

import math
from fractions import Fraction

import numpy as np
import pytest
from orders import weighted_moments

from eip_scipy import eip_method, integrate
from eip_scipy.methods import Tableau
from eip_scipy.methods.runge_kutta import DOP853, RK1, RK2, RK3, RK4, RK5, RK23, RK45, rooted_trees

EPS = np.finfo(float).eps
CLASSICAL = {"A": [[], ["1/2"], [0, "1/2"], [0, 0, 1]], "b": ["1/6", "1/3", "1/3", "1/6"]}
# Kutta's 3/8 rule, Ralston's rule, and Butcher's method of order 6: none of them in the package.
THREE_EIGHTHS = Tableau("ThreeEighths", [[], ["1/3"], ["-1/3", 1], [1, -1, 1]], ["1/8", "3/8", "3/8", "1/8"], order=4)
RALSTON = Tableau("Ralston", [[], ["2/3"]], ["1/4", "3/4"], order=2, b_hat=[1, 0], error_estimator_order=1)
BUTCHER6 = Tableau(
    "Butcher6",
    [
        [],
        ["1/3"],
        [0, "2/3"],
        ["1/12", "1/3", "-1/12"],
        ["-1/16", "9/8", "-3/16", "-3/8"],
        [0, "9/8", "-3/8", "-3/4", "1/2"],
        ["9/44", "-9/11", "63/44", "18/11", 0, "-16/11"],
    ],
    ["11/120", 0, "27/40", "27/40", "-4/15", "-4/15", "11/120"],
    order=6,
)
METHODS = [RK1, RK2, RK3, RK4, RK5, THREE_EIGHTHS, RALSTON, BUTCHER6]


def name(tableau):
    return tableau.name


def test_the_number_of_conditions():
    """The numbers of rooted trees are those of Hairer, Norsett & Wanner I, section II.2."""
    assert [len(list(rooted_trees(order))) for order in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]


@pytest.mark.parametrize("tableau", [*METHODS, RK23, RK45, DOP853], ids=name)
def test_orders(tableau):
    """A tableau that is made again is checked in all conditions; it has no higher order, nor has its estimate."""
    given = {key: getattr(tableau, key).tolist() for key in ("A", "b")}
    options = {key: getattr(tableau, key) for key in ("b_hat", "error_estimator_order", "c")}
    paired = {"e_low": tableau.e_low} if tableau.paired else {}
    again = Tableau("again", **given, order=tableau.order, **options, **paired)
    assert np.allclose(again.e, tableau.e, rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match=f"b is not of order {tableau.order + 1}"):
        Tableau("higher", **given, order=tableau.order + 1)
    if tableau.has_estimate and not tableau.paired:
        options["error_estimator_order"] += 1
        with pytest.raises(ValueError, match=f"b_hat is not of order {tableau.error_estimator_order + 1}"):
            Tableau("higher", **given, order=tableau.order, **options)


def test_attributes():
    assert [(t.n_stages, t.order, t.fsal) for t in (RK1, RK3, RK4, RK5)] == [
        (1, 1, False), (3, 3, False), (4, 4, True), (6, 5, False),
    ]  # fmt: skip
    assert [t.error_estimator_order for t in (RK1, RK2, RK3, RK4, RK5)] == [None, 1, 2, 3, 4]
    assert [t.metric_exponent for t in (RK1, RK2, RK4)] == [1.0, 1.5, 1.25]
    assert "order 4" in repr(RK4)
    assert list(RK4.e) == [0, 0, 0, 1 / 6, -1 / 6]  # err = (h/6)(k4 - f(new))
    with pytest.raises(ValueError, match="read-only"):
        RK4.b[0] = 1.0


def moment_residuals(tableau):
    count = min(tableau.order, len(set(tableau.c)))
    return weighted_moments(tableau.b, tableau.b_low, tableau.c, count)


@pytest.mark.parametrize("tableau", [*METHODS, RK23, RK45, DOP853], ids=name)
def test_b_low_makes_the_moments_exact(tableau):
    assert max(moment_residuals(tableau)) <= 1
    assert np.abs(tableau.b_low).max() < 3 * EPS * np.abs(tableau.b).max()


@pytest.mark.parametrize("moved", [0.0, 1e-16, -1e-16, 1e-14])
def test_low_parts_of_nodes_that_rounding_tells_apart(moved):
    """Gill's method in floats: its two nodes 1/2 are one, and no low part makes use of their difference."""
    r = math.sqrt(2)
    A = [[], [0.5], [(r - 1) / 2, (2 - r) / 2 + moved], [0, -r / 2, 1 + r / 2]]
    gill = Tableau("Gill", A, [1 / 6, (2 - r) / 6, (2 + r) / 6, 1 / 6], order=4)
    assert (gill.c[1] != gill.c[2]) == (moved != 0)
    assert np.abs(gill.b_low).max() < 10 * EPS + 10 * abs(moved)


def test_a_float_tableau():
    floats = Tableau("floats", RK4.A, RK4.b, order=4, b_hat=RK4.b_hat, error_estimator_order=3)
    for key in ("A", "b", "c", "b_hat"):
        np.testing.assert_array_equal(getattr(floats, key), getattr(RK4, key))
    np.testing.assert_allclose(floats.e, RK4.e, rtol=0, atol=1e-16)
    assert floats.fsal
    assert max(moment_residuals(Tableau("floats", RK5.A.tolist(), RK5.b.tolist(), order=5))) <= 1
    A = RK4.A.copy()
    A[1, 0] += 1e-11
    with pytest.raises(ValueError, match="not of order 4"):
        Tableau("floats", A, RK4.b, order=4)
    A[1, 0] = RK4.A[1, 0] + 1e-14
    Tableau("floats", A, RK4.b, order=4)


def test_one_wrong_coefficient_is_found():
    """Rational tableaux are checked exactly: an error of 1e-30 in any coefficient fails."""
    for place in (*((i, j) for i in range(4) for j in range(i)), *range(4)):
        A = [[Fraction(x) for x in row] for row in CLASSICAL["A"]]
        b = [Fraction(x) for x in CLASSICAL["b"]]
        if isinstance(place, tuple):
            A[place[0]][place[1]] += Fraction(1, 10**30)
        else:
            b[place] += Fraction(1, 10**30)
        with pytest.raises(ValueError, match=r"bad: b is not of order 4: the condition of tree .* is violated by"):
            Tableau("bad", A, b, order=4)


MIDPOINT = {"A": [[], ["1/2"]], "b": [0, 1], "order": 2}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"order": 3}, r"bad: b is not of order 3: .* is violated by"),
        ({"b": [1, 1]}, r"bad: b is not of order 2"),
        ({"A": [["1/2"], ["1/2"]]}, r"bad: row 0 of A reaches its diagonal"),
        ({"A": [[], ["1/2", "1/2"]]}, r"bad: row 1 of A reaches its diagonal"),
        ({"A": [[0, 1], ["1/2"]]}, r"bad: row 0 of A reaches its diagonal"),
        ({"A": [[]]}, r"bad: A has 1 rows and b has 2 entries"),
        ({"b": [0, 1, 0]}, r"bad: A has 2 rows and b has 3 entries"),
        ({"c": [0, 1]}, r"bad: c = \['0', '1'\] differs from the row sums of A"),
        ({"c": [0]}, r"bad: c = \['0'\] differs from the row sums of A"),
        ({"b_hat": [1, 0]}, r"bad: b_hat was given without error_estimator_order"),
        ({"b_hat": [1], "error_estimator_order": 1}, r"bad: b_hat has 1 entries; expected 2 or 3"),
        ({"b_hat": [1, 0, 0, 0], "error_estimator_order": 1}, r"bad: b_hat has 4 entries"),
        ({"b_hat": [1, 0], "error_estimator_order": 2}, r"bad: b_hat is not of order 2"),
        ({"b_hat": [1, 0, "1/2"], "error_estimator_order": 1}, r"bad: b_hat is not of order 1"),
        ({"error_estimator_order": 1}, "b_hat"),
        *(({"order": order}, "order") for order in (0, -1, 1.5, "2", None)),
        *(({"A": [[], [x]]}, "bad: ") for x in (float("nan"), float("inf"), "abc")),
        *(({"b": [0, x]}, "bad: ") for x in (float("nan"), float("inf"), "abc")),
    ],
)
def test_wrong_tableaux(changes, match):
    with pytest.raises((ValueError, TypeError), match=match):
        Tableau("bad", **{**MIDPOINT, **changes})


@pytest.mark.parametrize("tableau", METHODS, ids=name)
def test_observed_order(tableau):
    """Global error of the raw step on y' = y cos t, which sees the nodes c as well."""

    def error(h):
        run = integrate(lambda t, y: y * np.cos(t), (0, 2), [1.0], method=eip_method(tableau), h=h)
        return abs(run.y[0, -1] - np.exp(np.sin(2.0)))

    h = 1 / 32 if tableau.order > 4 else 1 / 64
    assert np.log2(error(h) / error(h / 2)) == pytest.approx(tableau.order, abs=0.2)
