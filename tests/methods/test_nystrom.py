"""Nystrom tableaux: their order conditions, wrong coefficients, low parts, one step by hand."""

from fractions import Fraction

import numpy as np
import pytest
from orders import weighted_moments

from eip_scipy.methods.nystrom import RKN86, RKN1210, NystromTableau, nystrom_trees

# None is in the package: kick-drift-kick leapfrog, whose last stage is the next first; Nystrom's method of order 4.
LEAPFROG = {"A": [[], ["1/2"]], "b": ["1/2", 0], "b_prime": ["1/2", "1/2"], "c": [0, 1], "order": 2}
NYSTROM4 = {"A": [[], ["1/8"], [0, "1/2"]], "b": ["1/6", "1/3", 0], "b_prime": ["1/6", "2/3", "1/6"]}
NYSTROM4 |= {"c": [0, "1/2", 1], "order": 4}
PAIR = {**LEAPFROG, "b_hat": ["1/2", 0], "b_prime_hat": [1, 0], "error_estimator_order": 1}
HIGH = [RKN86, RKN1210]
# The position weights satisfy only the first moment.
QUARTERS = NystromTableau("quarters", **{**LEAPFROG, "b": ["1/4", "1/4"]})
METHODS = [NystromTableau("leapfrog", **PAIR), NystromTableau("nystrom4", **NYSTROM4), QUARTERS, *HIGH]


def name(tableau):
    return tableau.name


@pytest.mark.parametrize("tableau", HIGH, ids=name)
def test_stage_positions_are_of_second_order(tableau):
    """The pair satisfies Sum_j A_ij = c_i^2 / 2, which the constructor does not require."""
    for row, node in zip(tableau.exact["A"], tableau.exact["c"], strict=True):
        assert abs(sum(row) - node**2 / 2) < Fraction(1, 10**50)


def arguments(tableau):
    """Return the arguments that make the same tableau again, with entries that may be changed."""
    values = {key: value.tolist() for key, value in tableau.exact.items()}
    return {**values, "order": tableau.order, "error_estimator_order": tableau.error_estimator_order}


def test_the_number_of_conditions():
    """The numbers of trees are those of Hairer, Norsett & Wanner I, section II.14."""
    counts = [1, 1, 2, 3, 6, 10, 20, 36, 72, 137, 275]
    assert [len(nystrom_trees(k)) for k in range(1, 12)] == counts


@pytest.mark.parametrize("tableau", HIGH, ids=name)
def test_orders(tableau):
    """A tableau that is made again is checked in all conditions; it has no higher order, nor has its estimate."""
    assert repr(RKN86) == "<NystromTableau RKN86: 9 stages, order 8, estimate of order 6>"
    assert (RKN1210.n_stages, RKN1210.order, RKN1210.error_estimator_order, RKN1210.fsal) == (17, 12, 10, False)
    assert NystromTableau("again", **arguments(tableau)).order == tableau.order
    with pytest.raises(AttributeError, match="cannot assign"):
        tableau.order = 9
    for key in ("order", "error_estimator_order"):
        with pytest.raises(ValueError, match="is not of order"):
            NystromTableau("higher", **arguments(tableau) | {key: arguments(tableau)[key] + 1})


def places(tableau):
    for key, values in tableau.exact.items():
        for place, value in np.ndenumerate(values):
            if value != 0:
                yield key, place


def changed(tableau, key, place, change):
    values = arguments(tableau)
    row = values[key] if len(place) == 1 else values[key][place[0]]
    row[place[-1]] += change
    return values


@pytest.mark.parametrize(("tableau", "stride"), [(RKN86, 2), (RKN1210, 18)], ids=["RKN86", "RKN12(10)"])
def test_one_wrong_coefficient_is_found(tableau, stride):
    for key, place in list(places(tableau))[::stride]:
        with pytest.raises(ValueError, match=r"bad: b\w* is not of order (6|8|10|12): a condition of order"):
            NystromTableau("bad", **changed(tableau, key, place, Fraction(1, 10**40)))


def moment_residuals(tableau, key):
    b, c = getattr(tableau, key), tableau.c
    count = min(7, tableau.order - (key == "b"), len({x for x, w in zip(c, b, strict=True) if w}))
    return weighted_moments(b, getattr(tableau, f"{key}_low"), c, count, key == "b")


@pytest.mark.parametrize("tableau", METHODS, ids=name)
def test_low_parts_make_the_moments_exact(tableau):
    for key in ("b", "b_prime"):
        assert max(moment_residuals(tableau, key)) <= 1
        low = getattr(tableau, f"{key}_low")
        assert np.abs(low).max() < 1e-16
        assert not low[getattr(tableau, key) == 0].any()
    for key, values in tableau.exact.items():
        np.testing.assert_array_equal(getattr(tableau, key), values.astype(float))
        for array in (getattr(tableau, key), values):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1


def test_low_parts_of_a_float_tableau():
    values = {key: getattr(RKN86, key).tolist() for key in ("A", "b", "b_prime", "c", "b_hat", "b_prime_hat")}
    floats = NystromTableau("floats", **values, order=8, error_estimator_order=6)
    assert max(moment_residuals(floats, "b_prime")) <= 1
    assert floats.fsal
    values["A"][3][1] += 1e-10
    with pytest.raises(ValueError, match="floats: b is not of order 8"):
        NystromTableau("floats", **values, order=8, error_estimator_order=6)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"order": 3}, r"bad: b is not of order 3: a condition of order 3 is violated by -0\.167"),
        ({"b": ["1/3", 0]}, r"bad: b is not of order 2"),
        ({"b_prime": ["1/2", "1/3"]}, r"bad: b_prime is not of order 2"),
        ({"b_prime_hat": ["1/2", "1/3"]}, r"bad: b_prime_hat is not of order 1"),
        ({"error_estimator_order": 2}, r"bad: b_prime_hat is not of order 2"),
        ({"A": [["1/2"], ["1/2"]]}, r"bad: row 0 of A reaches its diagonal"),
        ({"A": [[]]}, r"bad: A has 1 rows and b has 2 entries"),
        ({"c": [0]}, r"bad: c has 1 entries and b has 2; they must have"),
        ({"b_prime": ["1/2", "1/2", 0]}, r"bad: b_prime has 3 entries and b has 2"),
        ({"b_hat": [1]}, r"bad: b_hat has 1 entries and b has 2"),
        ({"b_prime_hat": None}, r"bad: give all or none of b_hat, b_prime_hat and error_estimator_order"),
        ({"error_estimator_order": None}, r"bad: give all or none of b_hat, b_prime_hat and error_estimator_order"),
        ({"order": 0}, r"bad: order must be an integer >= 1, got 0"),
        ({"order": True}, r"bad: order must be an integer >= 1, got True"),
        ({"error_estimator_order": 1.0}, r"bad: error_estimator_order must be an integer >= 1, got 1\.0"),
        ({"c": [0, float("nan")]}, r"bad: coefficients must be finite numbers"),
        ({"c": ["1/2", 1]}, "bad: the first node is 1/2, expected 0"),
    ],
)
def test_wrong_tableaux(changes, match):
    with pytest.raises(ValueError, match=match):
        NystromTableau("bad", **{**PAIR, **changes})
