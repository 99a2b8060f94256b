"""The record itself: how it prints, pickles, names its components, and goes through SciPy."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from eip_scipy import EIPRK4, EIPRK45, Balance, Invariant, integrate
from eip_scipy.problems import Problem, centre_time, comet, harmonic, kepler, nbody, pythagorean, time_transformed
from eip_scipy_studies.condensates.problems import plane_wave, rotating_packet, soliton
from eip_scipy_studies.hard_cases import hard_cases

MADE = [kepler(), kepler(relativistic=0), harmonic(), pythagorean(), comet(), soliton(), plane_wave((8, 8))]
PACKET = rotating_packet(points=8)


def test_problems_print_in_five_lines_and_pickle():
    for problem in (*MADE, PACKET, *(case.problem for case in hard_cases())):
        lines = repr(problem).splitlines()
        assert len(lines) == 5, problem.name
        assert lines[0].startswith(f"{problem.name}: y = (")
        again = pickle.loads(pickle.dumps(problem))
        assert repr(again) == repr(problem)
        t, y = problem.t_span[0], problem.y0
        np.testing.assert_array_equal(again.y0, y)
        np.testing.assert_array_equal(again.fun(t, y), problem.fun(t, y))
        if problem.reference is not None and (known := problem.reference(t)) is not None:
            np.testing.assert_allclose(known, y, rtol=0, atol=1e-14)
        for one, other in zip(problem.invariants, again.invariants, strict=True):
            np.testing.assert_array_equal(one.fun(t, y, *one.args), other.fun(t, y, *other.args))
        if problem.reference is not None:
            np.testing.assert_array_equal(again.reference(problem.t_span[1]), problem.reference(problem.t_span[1]))
    runs = [integrate(p, (0, 0.01), method=EIPRK4, h=0.002) for p in (PACKET, pickle.loads(pickle.dumps(PACKET)))]
    np.testing.assert_array_equal(*(run.y for run in runs))


def test_repr():
    assert repr(kepler()) == (
        "kepler: y = (x, y, vx, vy), 4 components, float64\n"
        "  interval    t from 0 to 200, h = 0.03; G M = 1, semi-major axis 1: period 2 pi\n"
        "  invariants  H, L\n"
        "  functions   fun, rhs, acc, jacobian; options blocks\n"
        "  source      Cai, Gong & Wang, section 3.1 (eq. 3.2, with L = q1 p2 - q2 p1)"
    )
    own = Problem("own", lambda t, y: -y, np.ones(20), (0.0, 1.0), invariants=(Invariant(lambda t, y: y[0]),))
    assert "y9, y10, y11, ...), 20 components" in repr(own)
    assert "invariants  one without a name" in repr(own)


def test_a_copy_has_no_other_params():
    """The functions of the copy would keep the old ones."""
    assert replace(kepler(), params=kepler().params.copy()).params == kepler().params
    with pytest.raises(ValueError, match="contain other parameters"):
        replace(kepler(), params=[0.05])


def test_component_names():
    assert harmonic().component_names == ("q", "p")
    body = nbody([1.0, 1e-3], np.eye(3)[:2], np.eye(3)[1:] * 0.9, t_span=(0, 1))
    assert body.component_names[:6] == ("x_0", "y_0", "z_0", "x_1", "y_1", "z_1")
    assert body.component_names[6:9] == ("vx_0", "vy_0", "vz_0")
    assert soliton().component_names is None
    assert replace(kepler(), component_names="a b c d").component_names == ("a", "b", "c", "d")
    with pytest.raises(ValueError, match="2 names for 4 components"):
        replace(kepler(), component_names=["a", "b"])
    with pytest.raises(ValueError, match="'a' names two components"):
        replace(kepler(), component_names="a b a c")


def test_solve_ivp():
    problem = kepler()
    sol = problem.solve_ivp((0, 3), method=EIPRK4)
    run = integrate(problem, (0, 3), method=EIPRK4, save_every=1)
    np.testing.assert_array_equal(sol.t, run.t)
    np.testing.assert_array_equal(sol.y, run.y)
    assert sol.component_names == problem.component_names
    adaptive = problem.solve_ivp((0, 3), method=EIPRK45, rtol=1e-9, t_eval=[1.0, 3.0])
    assert np.all(np.abs(adaptive.y[:, -1] - sol.y[:, -1]) < 1e-4)
    assert adaptive.t.tolist() == [1.0, 3.0]
    short = problem.solve_ivp((0, 3), method=EIPRK45, max_step=0.01)
    assert 0 < np.diff(short.t).max() <= 0.01 + 1e-15
    with pytest.raises(TypeError, match="no y0"):
        replace(problem, y0=None).solve_ivp(method=EIPRK4)
    # A method of SciPy gets no options of ours.
    sol = harmonic().solve_ivp((0, 1), method="DOP853", rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(sol.y[:, -1], harmonic().reference(1.0), rtol=1e-9)


@pytest.mark.needs_jit
def test_what_is_written_in_another_time():
    """x - t is constant for x' = 1; its gradient with respect to x is right, but says nothing about t."""

    @njit
    def rhs(t, y, out, params):
        out[0], out[1] = 1.0, 0.0

    g = njit(lambda y, params: 2.0)
    # The gradient is (1, 0), as the derivative is.
    kept = Invariant(njit(lambda t, y, params: y[0] - t), rhs, in_place=True, name="X")
    problem = Problem("drift", lambda t, y: np.array([1.0, 0.0]), np.zeros(2), (0, 1), rhs=rhs, invariants=(kept,))
    with pytest.raises(ValueError, match=r"Invariant\(X\) depends on t, but the gradient"):
        time_transformed(problem, 1.0, g)
    balance = Balance(lambda t, y: y @ y, lambda t, y: 0.0, lambda t, y: 2 * y, name="B")
    with pytest.raises(ValueError, match=r"Balance\(B\) is a Balance, whose rate is a derivative with respect to time"):
        time_transformed(replace(kepler(), invariants=(balance,)), 1.0, centre_time)
    assert time_transformed(kepler(), 1.0, centre_time).component_names == ("x", "y", "vx", "vy", "t")
    run = integrate(time_transformed(replace(problem, invariants=()), 1.0, g), method=EIPRK4, h=0.1)
    np.testing.assert_allclose(run.y[:, -1], [2.0, 0.0, 2.0], rtol=1e-14)
