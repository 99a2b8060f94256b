"""Methods whose unprojected steps are made by SciPy's implicit solvers, Radau and BDF.

A solver of SciPy controls its error and the length of its steps. The engine lets it make a step, projects the result,
and returns the projected state to it before the next step. Some attributes that are used here are private: `PRIVATE`
lists them, and a run raises an error that names those that the installed version of SciPy lacks.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.integrate
from scipy.integrate import DenseOutput, OdeSolver
from scipy.linalg import invpascal
from scipy.sparse import issparse

from ..engine.data import NFEV, NJEV, NLU, POLYNOMIAL, Work
from ..engine.native import BUILD, Hooks
from .base import DenseForm, Method

if TYPE_CHECKING:
    from ..core.runs import Run, Start

__all__ = ["BDF", "RADAU", "Jacobian", "ScipySolverAdapter"]

Array = np.ndarray

# Largest relative shift of a component in SciPy's numerical Jacobian, as in MATLAB's numjac. Without it the shifts
# of components that do not occur in the equations grow tenfold with each Jacobian until they overflow.
LARGEST_SHIFT = 0.1
COUNTERS = {"nfev": NFEV, "njev": NJEV, "nlu": NLU}
# Private attributes of SciPy's solvers.
PRIVATE = {
    scipy.integrate.Radau: ("f", "Z", "h_abs", "solve_lu", "LU_real", "LU_complex", "sol"),
    scipy.integrate.BDF: ("D", "order", "error_const", "h_abs", "LU"),
}
# Nodes of the stages of Radau.
SQRT_6 = 6**0.5
NODES = np.array([(4 - SQRT_6) / 10, (4 + SQRT_6) / 10, 1.0])
MOST_ORDER = 5  # of BDF


class Jacobian(NamedTuple):
    """The arguments `jac` and `jac_sparsity` of SciPy's implicit solvers."""

    jac: Any = None
    jac_sparsity: Any = None


class ScipySolverAdapter(Method):
    """A method whose steps are made by the class `solver` of SciPy.

    Entry (p, j) of `polynomials` (k, k) is the coefficient of x^(p + 1), x = (t - t_old) / h, in the interpolant, which
    multiplies the j-th row that `_describe` fills. `scipy_solver` is the solver of a run, which `begin` makes.
    `start_calls` is the number of evaluations that it took, for a Jacobian. `not_finite_at` is a time at which the
    right-hand side had a value that is not finite in the last step, or None. The engine reads `b`, `c`, `exponent` and
    `multistep`, as those of a tableau; the array work.K has one row more than `b` has entries.
    """

    in_python = drives = True
    # Exponent of the relative error estimates in the weights of the projection. On a chain with dampers the errors of
    # Radau are 0.03 of those without projection, and 0.09 with weights from the tolerances alone (exponent 0). The
    # errors of BDF are the same with both exponents there, and ten times larger with exponent 0 on a flyball governor.
    metric_exponent = 1.0
    exponent = 0.0
    multistep = None
    solver: type[OdeSolver]
    polynomials: Array
    takes_complex: bool

    def __init__(self) -> None:
        self.name = self.solver.__name__
        self.b = self.c = np.zeros(len(self.polynomials) + 1)
        self.not_finite_at: float | None = None
        self.scipy_solver: Any
        self.start_calls = 0
        self._before: dict[str, Any] = {}
        self._counted = dict.fromkeys(COUNTERS, 0)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}>"

    def for_engine(self, sees_velocity: bool = False) -> ScipySolverAdapter:
        return type(self)()  # whose attributes change in the run

    def hooks(self, stepper: Any, work: Work) -> Hooks:
        return Hooks(one_step=partial(stepper.fill, work), estimates=True, drives=True)

    def dense_form(self, stepper: Any) -> DenseForm:
        # The first and the last row of work.K are the derivatives at both ends of a step.
        return DenseForm(POLYNOMIAL, 1 + len(self.polynomials), np.pad(self.polynomials, ((0, 0), (1, 1))))

    def begin(self, run: Run, start: Start) -> None:
        run.stepper._begin(run, start)

    def _begin(self, run: Run, start: Start) -> None:
        (t, y, f, length), rtol, span = start, run.stepping.rtol, run.stepping.span
        if y.dtype.kind == "c" and not self.takes_complex:
            raise ValueError(
                f"y0 is complex, but SciPy's {self.name} takes real states only. Use EIPBDF, or write the state in "
                "real and imaginary parts."
            )
        if rtol.size and np.ptp(rtol) > 0:
            raise ValueError(f"rtol={rtol}: SciPy's {self.name} takes one number. Give atol by component instead.")
        known, calls = [f], [0]  # the solver's first call asks for this derivative

        def fun(t: float, y: Array) -> Array:
            calls[0] += not known
            found = known.pop() if known else run.problem.derivative(t, y)
            if not BUILD.are_finite(found.view(float)):
                self.not_finite_at = t
            return found

        make: Any = self.solver
        jacobian = run.problem.jacobian_for(self)
        self.scipy_solver = solver = make(
            fun, t, y, span.t_bound, max_step=span.max_step, rtol=float(rtol[0]) if rtol.size else 1e-3,
            atol=run.stepping.atol, first_step=min(length, abs(span.t_bound - t)) or None, **jacobian._asdict(),
        )  # fmt: skip
        self.start_calls = calls[0]
        run.problem.count -= self.start_calls
        solver.nfev = 0
        self._counted = dict.fromkeys(COUNTERS, 0)
        lacking = [name for name in PRIVATE[self.solver] if not hasattr(solver, name)]
        if lacking:
            raise NotImplementedError(
                f"EIP{self.name} uses attributes of scipy.integrate.{self.name} that SciPy {scipy.__version__} does "
                f"not have: {', '.join(lacking)}. Use another version of SciPy."
            )
        self._keep_finite(solver)
        self._watch(solver)

    def _watch(self, solver: Any) -> None:
        """Change the solver so that it keeps values of a step that `_error` needs."""

    def _keep_finite(self, solver: Any) -> None:
        """Let the solver keep its last Jacobian where a new one is not finite, because `fun` is not.

        The factorisation of such a Jacobian would raise an error. With the last one the iteration fails, and the step
        is shortened.
        """
        jac = solver.jac

        def finite(*args: Any) -> Any:
            found = jac(*args)
            return found if np.isfinite(found.data if issparse(found) else found).all() else solver.J

        if jac is not None:
            solver.jac = finite

    def fill(self, w: Work, t: float, y: Array, again: bool) -> tuple[float, float] | None:
        """Make a step from (t, y), and write the state, its error estimate and the interpolant to the buffers `w`.

        With `again` the step replaces the last one, whose projection has failed, and is at most half as long. The
        function returns the time at the end of the step and the length of the next step, or None if the solver of SciPy
        fails because the step would become too short.
        """
        self.not_finite_at = None
        solver = self.scipy_solver
        longest = solver.max_step
        if again:
            # SciPy's solver returns to the state before the last step, and must make its factorisations again.
            half = 0.5 * abs(solver.t - self._before["t"])
            vars(solver).update(self._before | dict.fromkeys(self._factors(), None) | {"max_step": half})
        else:
            if not np.array_equal(y, solver.y):
                self._move(y)
            self._before = self._kept()
        if solver.jac_factor is not None:
            solver.jac_factor = np.minimum(solver.jac_factor, LARGEST_SHIFT)
        solver.step()
        solver.max_step = longest
        self.count(w)
        if solver.status == "failed":
            return None
        h = solver.t - t
        w.y_hat[:] = solver.y
        w.err[:] = self._error(h).view(float)
        self._describe(h, w.K[1:-1], w.K[-1])
        return float(solver.t), float(solver.h_abs)

    def count(self, w: Work) -> None:
        """Add the evaluations and factorisations since the last call to the counters of the run."""
        for name, place in COUNTERS.items():
            found = getattr(self.scipy_solver, name)
            w.counters[place] += found - self._counted[name]
            self._counted[name] = found

    def _kept(self) -> dict[str, Any]:
        """Return the attributes of SciPy's solver that take it back to the state before a step."""
        return {name: value for name, value in vars(self.scipy_solver).items() if name not in (*COUNTERS, "jac_factor")}

    def _factors(self) -> list[str]:
        return [name for name in vars(self.scipy_solver) if name.startswith("LU")]

    def state(self) -> dict[str, Any]:
        """Return the values from which another object continues with the same bits."""
        own = vars(self.scipy_solver)
        values = {name: value for name, value in own.items() if isinstance(value, DenseOutput) or not callable(value)}
        # Sparse factorisations cannot be copied; the solver makes them again.
        return values | {name: None for name in self._factors() if not isinstance(values[name], tuple)}

    def resume(self, values: dict[str, Any]) -> None:
        """Continue from the `state` of another object; `begin` must have been called before."""
        vars(self.scipy_solver).update(values)
        self._counted = {name: getattr(self.scipy_solver, name) for name in COUNTERS}

    def _move(self, y: Array) -> None:
        """Set the state of SciPy's solver to the projected state y."""
        raise NotImplementedError

    def _error(self, h: float) -> Array:
        """Return the error estimate of each component in the last step, of length h."""
        raise NotImplementedError

    def _describe(self, h: float, rows: Array, slope: Array) -> None:
        """Fill `rows` with the vectors that `polynomials` combine, and `slope` with the derivative after the step."""
        raise NotImplementedError


class _Radau(ScipySolverAdapter):
    """Adapter of SciPy's Radau.

    The derivative is evaluated again at a projected state, because the error estimate needs it. The predictor of the
    next step extrapolates the unprojected polynomial of the last step.
    """

    solver, order, error_estimator_order, takes_complex = scipy.integrate.Radau, 5, 3, False
    reference = "Hairer & Wanner, Solving ODEs II, section IV.8, doi:10.1007/978-3-642-05221-7; SciPy's Radau"
    # Coefficients of x, x^2 and x^3, in terms of Radau's stages, of the polynomial through 0 and the stages.
    polynomials = np.linalg.inv(NODES[:, None] ** np.arange(1, 4))
    _solved: Array

    def _watch(self, solver: Any) -> None:
        solve = solver.solve_lu

        def solve_lu(factors: Any, b: Array) -> Array:
            self._solved = solve(factors, b)
            return self._solved

        solver.solve_lu = solve_lu

    def _move(self, y: Array) -> None:
        self.scipy_solver.y = y
        self.scipy_solver.f = self.scipy_solver.fun(self.scipy_solver.t, y)

    def _error(self, h: float) -> Array:
        return self._solved  # an accepted step ends with the linear system whose solution is the error estimate

    def _describe(self, h: float, rows: Array, slope: Array) -> None:
        np.divide(self.scipy_solver.Z, h, out=rows)
        slope[:] = self.scipy_solver.f


class _BDF(ScipySolverAdapter):
    """Adapter of SciPy's BDF, whose history consists of backward differences D of states at equal distances in time.

    A projection shifts all states of the history by the same vector, so that the differences stay unchanged. On a
    chain with dampers the errors are 0.23 of those without projection, with 1.33 times the evaluations. To shift only
    the last state, and thereby change all differences, would give about the same: 0.20 of the errors without projection
    with 1.35 times the evaluations.
    """

    solver, order, error_estimator_order, takes_complex = scipy.integrate.BDF, 1, 1, True
    reference = "Shampine & Reichelt, SIAM J. Sci. Comput. 18 (1997) 1, doi:10.1137/S1064827594276424; SciPy's BDF"
    polynomials = np.eye(MOST_ORDER)

    def _kept(self) -> dict[str, Any]:
        return super()._kept() | {"D": self.scipy_solver.D.copy()}

    def _move(self, y: Array) -> None:
        self.scipy_solver.y = y
        self.scipy_solver.D[0] = y

    def _error(self, h: float) -> Array:
        solver, order = self.scipy_solver, self._before["order"]
        difference = solver.D[order + 1]
        if solver.order > order:  # then this difference has been scaled to the next step's length
            difference = difference / (solver.h_abs / abs(h)) ** (order + 1)
        return np.asarray(solver.error_const[order] * difference)

    def _describe(self, h: float, rows: Array, slope: Array) -> None:
        """Fill `rows` with the coefficients of x, x^2, ... in the interpolant, divided by h, where x = (t - t_old) / h.

        The solver has already changed its differences D to the length of the next step. Therefore x - 1 is scaled
        by the ratio of the two lengths.
        """
        order = self.scipy_solver.order
        ratio = (abs(h) / self.scipy_solver.h_abs) ** np.arange(MOST_ORDER + 1)
        powers = (SHIFTED * ratio) @ NEWTON[:, : order + 1]
        np.divide(powers[1:] @ self.scipy_solver.D[: order + 1], h, out=rows)
        slope[:] = np.arange(1, MOST_ORDER + 1) @ rows


# Column k contains the coefficients of 1, s, s^2, ... in s (s + 1) ... (s + k - 1) / k!.
NEWTON = np.eye(MOST_ORDER + 1)
for k in range(1, MOST_ORDER + 1):
    NEWTON[: k + 1, k] = np.convolve(NEWTON[:k, k - 1], [k - 1, 1]) / k
# Column j contains the coefficients of 1, x, x^2, ... in (x - 1)^j.
SHIFTED = invpascal(MOST_ORDER + 1, "upper").astype(float)
RADAU, BDF = _Radau(), _BDF()
