"""Arguments of the caller take precedence over those of a problem."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from systems import refuse

from eip_scipy import EIPDOP853, EIPRK1, EIPRK4, ensemble, integrate
from eip_scipy.problems import harmonic, kepler

PROBLEM = kepler(0.3, 0.0, t_end=2.0)
BARE = dataclasses.replace(PROBLEM, h=None)

# Each asks for adaptive steps.
ASKED = [{"h": None}, {"rtol": 1e-5}, {"rtol": 1e-3}, {"atol": 1e-8}, {"atol": [1e-8] * 4}]  # 1e-3 is the default
ASKED += [{"rtol": 1e-9, "atol": 1e-12}, {"first_step": 1e-3}, {"max_step": 0.02}]
ASKED += [{"h": None, "rtol": 1e-7, "max_step": 0.1}]


def single(problem, **options):
    run = integrate(problem, save_every=1, compiled=False, **options)
    return run.h, run.t, run.y


def members(problem, **options):
    run = ensemble(problem, None, [problem.y0], t_eval=[0.5, 1.0], compiled=False, **options)
    return run.h, run.nfev, run.y


both = pytest.mark.parametrize("how", [single, members])


def assert_equal(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@both
@pytest.mark.parametrize("method", [EIPRK4, EIPDOP853])
def test_adaptive_where_it_is_asked_for(how, method):
    for options in ASKED:
        h, *found = how(PROBLEM, method=method, **options)
        assert h is None
        assert_equal(found, how(BARE, method=method, **{"h": None, **options})[1:])


@both
def test_a_problem_s_own_step_otherwise(how):
    """None and inf are the defaults of first_step and max_step: they request nothing."""
    expected = how(BARE, method=EIPRK4, h=PROBLEM.h)
    for options in ({}, {"first_step": None}, {"max_step": np.inf}, {"first_step": None, "max_step": np.inf}):
        assert_equal(how(PROBLEM, method=EIPRK4, **options), expected)


@both
def test_a_given_step_is_fixed_and_tolerances_are_of_the_metric(how):
    plain = how(PROBLEM, method=EIPRK4, h=0.02)
    given = how(PROBLEM, method=EIPRK4, h=0.02, rtol=1e-3, atol=1e-6)
    weighed = how(PROBLEM, method=EIPRK4, h=0.02, atol=0.0)
    assert plain[0] == given[0] == weighed[0] == 0.02
    np.testing.assert_array_equal(weighed[-1], plain[-1])  # a step has no use for the default of atol
    assert (given[-1] != plain[-1]).any()
    np.testing.assert_allclose(given[-1], plain[-1], atol=1e-4)
    euclidean = {"metric": "euclidean", "h": 0.02}
    one, other = (how(PROBLEM, method=EIPRK4, **euclidean, **o) for o in ({}, {"atol": 0.0}))
    np.testing.assert_array_equal(one[-1], other[-1])


@both
def test_a_step_and_bounds_of_adaptive_ones_contradict(how):
    for options in ({"first_step": 0.01}, {"max_step": 0.01}):
        with pytest.raises(ValueError, match="h sets a fixed step, but first_step and max_step are for adaptive steps"):
            how(PROBLEM, method=EIPRK4, h=0.02, **options)
    needs = [(given, ValueError, r"EIPRK1 has no error estimate and needs the step h=\.\.\.") for given in ASKED[:4]]
    refuse(partial(how, harmonic(), method=EIPRK1), needs)
    assert how(harmonic(), method=EIPRK1, check=False)[0] == harmonic().h
