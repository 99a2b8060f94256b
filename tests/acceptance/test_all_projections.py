"""Each place that projects reports a run whose invariant is wrong: there is one judge of corrections, and all call it.

The spring of the oscillator is stiffer around t = 8, so that no check at the start can find that its energy changes.
"""

import numpy as np
import pytest
import scipy.integrate
from numba import njit

import eip_scipy
from eip_scipy import EIPDOP853, EIPRK4, Invariant, ProjectionWarning, eip_method, ensemble, integrate, project
from eip_scipy.problems import Grid, GrossPitaevskii, Problem

Y0, SPAN = [1.0, 0.0], (0.0, 20.0)
FIXED, ADAPTIVE = "RK1 RK2 RK3 RK4 RK5 GJ12 GJ14", "RK23 RK45 DOP853 RKN8 RKN12 Radau BDF"
METHODS = [(name, {"h": 0.02}) for name in FIXED.split()] + [(name, {"rtol": 1e-6}) for name in ADAPTIVE.split()]


def stiffening(t, y):
    return np.array([y[1], -(1.0 + 0.5 * np.exp(-0.5 * (t - 8.0) ** 2)) * y[0]])


def energy(t, y):
    return 0.5 * (y[0] * y[0] + y[1] * y[1])


def gradient(t, y):
    return y.copy()


class Verlet:
    order = 2

    def one_step(self, t, y, h):
        y[0] += h / 2 * y[1]
        y[1] += h * stiffening(t + h / 2, y)[1]
        y[0] += h / 2 * y[1]
        return y


H = Invariant(energy, gradient, name="H")
NATIVE = njit(stiffening), Invariant(njit(energy), njit(gradient), name="H")
PROBLEM = Problem("stiffening", stiffening, y0=np.array(Y0), t_span=SPAN, invariants=(H,))
GIVEN = {"method": EIPDOP853, "rtol": 1e-6}


def by_fields():
    """The functions of the invariants project a field jointly, without gradients."""
    gpe = GrossPitaevskii(Grid(32, -8, 8), lambda x: 0.5 * x**2, beta=10.0)
    fun = lambda t, psi: gpe.fun(t, psi) - 1e-3 * max(0.0, t - 0.5) * psi  # noqa: E731
    psi = np.exp(-(gpe.grid.points(0) ** 2)) + 0j
    return integrate(fun, (0, 2), psi, method=EIPRK4, h=0.002, invariants=gpe.invariants())


def by_dense_output():
    """Between the steps the gradient leads away from the required value."""
    turn = lambda t, y: np.array([-y[1], y[0]])  # noqa: E731
    norm = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y if t % 0.5 == 0 else -0.2 * y, name="norm")
    return integrate(turn, (0, 1), Y0, method=EIPRK4, h=0.5, invariants=norm, check=False, t_eval=[0.25, 0.75])


PLACES = {
    "compiled": lambda: integrate(NATIVE[0], SPAN, Y0, invariants=NATIVE[1], **GIVEN),
    "scipy.integrate.solve_ivp": lambda: scipy.integrate.solve_ivp(stiffening, SPAN, Y0, invariants=H, **GIVEN),
    "solve_ivp": lambda: eip_scipy.solve_ivp(stiffening, SPAN, Y0, invariants=H, **GIVEN),
    "Problem.solve_ivp": lambda: PROBLEM.solve_ivp(**GIVEN),
    "every": lambda: integrate(PROBLEM, method=EIPRK4, h=0.02, every=5),
    "iterations": lambda: integrate(PROBLEM, iterations=3, direction="midpoint", **GIVEN),
    "blocks": lambda: integrate(PROBLEM, blocks=2, metric="euclidean", **GIVEN),
    "one-step method": lambda: integrate(PROBLEM, method=eip_method(Verlet()), h=0.02),
    "variations": lambda: integrate(PROBLEM, variations="state", **GIVEN),
    "continue_to": lambda: integrate(PROBLEM, (0, 2.0), **GIVEN).continue_to(20.0),
    "fields": by_fields,
    "dense output": by_dense_output,
    "project": lambda: project([3.0, 0.0], H, target=0.5),
}
PLACES |= {m: lambda m=m, o=o: integrate(PROBLEM, method=getattr(eip_scipy, f"EIP{m}"), **o) for m, o in METHODS}


@pytest.mark.parametrize("place", PLACES)
def test_whoever_projects_reports_a_wrong_invariant(place):
    with pytest.warns(RuntimeWarning, match=r"'(H|mass)'|^dense output"):
        run = PLACES[place]()
    assert not getattr(run, "trusted", False) or place == "dense output"


@pytest.mark.parametrize("how", ["compiled", "interpreted", "eight at once"])
def test_ensembles_report_each_member(how, request):
    if how == "eight at once":
        request.getfixturevalue("in_vectors")
    fun, kept = (stiffening, H) if how == "interpreted" else NATIVE
    with pytest.warns(ProjectionWarning, match="9 of 9 members"):
        many = ensemble(fun, SPAN, np.full((9, 2), Y0), method=EIPRK4, h=0.02, invariants=kept, executor=1)
    assert not many.trusted.any()
    assert all("'H'" in message for message in many.message)
