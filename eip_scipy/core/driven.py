"""SciPy's implicit solvers as makers of the unprojected step: `EIPRadau` and `EIPBDF` drive them and project.

A solver of SciPy controls its error and the length of its steps. The engine lets it make a step, projects the result,
and returns the projected state to it before the next step. Some attributes that are used here are private: `PRIVATE`
lists them, and a run raises an error that names those that the installed version of SciPy lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy
from scipy.integrate import BDF, DenseOutput, OdeSolver, Radau
from scipy.linalg import invpascal
from scipy.sparse import issparse

from ..engine.data import NFEV, NJEV, NLU, Work
from ..engine.native import BUILD
from ..methods.orders import Ordered

if TYPE_CHECKING:
    from .stepping import Stepping

__all__ = ["DRIVEN_BDF", "DRIVEN_RADAU", "Driven", "Jacobian", "Stepper"]

Array = np.ndarray
Derivative = Callable[[float, Array], Array]

# Largest relative shift of a component in SciPy's numerical Jacobian, as in MATLAB's numjac. Without it the shifts
# of components that do not occur in the equations grow tenfold with each Jacobian until they overflow.
LARGEST_SHIFT = 0.1
# Exponent of the relative error estimates in the weights of the projection. On a chain with dampers the errors of Radau
# are 0.03 of those without projection, and 0.09 with weights from the tolerances alone (exponent 0). The errors of BDF
# are the same with both exponents there, and ten times larger with exponent 0 on the flyball governor.
KAPPA = 1.0
COUNTERS = {"nfev": NFEV, "njev": NJEV, "nlu": NLU}
# Private attributes of SciPy's solvers.
PRIVATE = {
    Radau: ("f", "Z", "h_abs", "solve_lu", "LU_real", "LU_complex", "sol"),
    BDF: ("D", "order", "error_const", "h_abs", "LU"),
}
# Coefficients of x, x^2 and x^3, in terms of Radau's stages, of the polynomial through 0 and the stages at the nodes C.
SQRT_6 = 6**0.5
NODES = np.array([(4 - SQRT_6) / 10, (4 + SQRT_6) / 10, 1.0])
MOST_ORDER = 5  # of BDF


class Jacobian(NamedTuple):
    """The arguments `jac` and `jac_sparsity` of SciPy's implicit solvers."""

    jac: Any = None
    jac_sparsity: Any = None


class Driven(Ordered):
    """A method whose steps are made by SciPy's class `solver`; it takes the place of a tableau.

    `stepper` is the subclass of `Stepper` that accesses the private attributes of this solver. Entry (p, j) of
    `polynomials` (k, k) is the coefficient of x^(p + 1), x = (t - t_old) / h, in the interpolant, which multiplies the
    j-th row that `Stepper._describe` fills.
    """

    in_python = True
    drives = True
    kappa = KAPPA

    def __init__(
        self,
        solver: type[OdeSolver],
        stepper: type[Stepper],
        order: int,
        error_estimator_order: int,
        polynomials: Array,
        takes_complex: bool,
    ) -> None:
        self.name, self.solver, self._stepper = solver.__name__, solver, stepper
        self.order, self.error_estimator_order, self.takes_complex = order, error_estimator_order, takes_complex
        # The first and the last row of work.K are the derivatives at both ends of a step.
        self.weights = np.pad(polynomials, ((0, 0), (1, 1)))

    def __repr__(self) -> str:
        return f"<Driven {self.name}>"

    def stepper(self) -> Stepper:
        """Return a new `Stepper`, which makes the steps of one run."""
        return self._stepper(self)


class Stepper:
    """Maker of the steps of one run, by a solver of SciPy, the attribute `solver`, which `begin` creates.

    `not_finite_at` is a time at which the right-hand side
    had a value that is not finite in the last step, or None. `b`, `c`, `exponent` and `multistep` are attributes of a
    tableau that the engine reads. The array work.K has one row more than `b` has entries.
    """

    multistep = None
    exponent = 0.0

    def __init__(self, method: Driven) -> None:
        self.method = method
        self.b = self.c = np.zeros(method.weights.shape[1] - 1)
        self.solver: Any
        self.not_finite_at: float | None = None
        self._before: dict[str, Any] = {}
        self._counted = dict.fromkeys(COUNTERS, 0)

    def begin(self, rhs: Derivative, start: Any, stepping: Stepping, jacobian: Jacobian | None) -> None:
        """Make the solver of a run; `start` consists of t, y, f and the length of the first step."""
        (t, y, f, length), name, rtol = start, self.method.name, stepping.rtol
        if y.dtype.kind == "c" and not self.method.takes_complex:
            raise ValueError(
                f"y0 is complex, but SciPy's {name} takes real states only. Use EIPBDF, or write the state in real and "
                "imaginary parts."
            )
        if rtol.size and np.ptp(rtol) > 0:
            raise ValueError(f"rtol={rtol}: SciPy's {name} takes one number. Give atol by component instead.")
        known = [f]  # the solver's first call asks for this derivative

        def fun(t: float, y: Array) -> Array:
            found = known.pop() if known else rhs(t, y)
            if not BUILD.are_finite(found.view(float)):
                self.not_finite_at = t
            return found

        make: Any = self.method.solver
        self.solver = solver = make(
            fun, t, y, stepping.span.t_bound, max_step=stepping.span.max_step,
            rtol=float(rtol.max(initial=0.0)), atol=stepping.atol, first_step=length or None,
            **(jacobian or Jacobian())._asdict(),
        )  # fmt: skip
        solver.nfev = 0  # without the evaluations for the Jacobian
        self._counted = dict.fromkeys(COUNTERS, 0)
        lacking = [name for name in PRIVATE[self.method.solver] if not hasattr(solver, name)]
        if lacking:
            raise NotImplementedError(
                f"EIP{self.method.name} uses attributes of scipy.integrate.{self.method.name} that SciPy "
                f"{scipy.__version__} does not have: {', '.join(lacking)}. Use another version of SciPy."
            )
        self._keep_finite(solver)
        self._watch(solver)

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
        solver = self.solver
        longest = solver.max_step
        if again:
            solver.max_step = 0.5 * abs(solver.t - self._before["t"])
            self._restore()
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
        self._describe(h, w.K[1:-1])
        w.K[-1] = self._slope(w.K[1:-1])
        return float(solver.t), float(solver.h_abs)

    def count(self, w: Work) -> None:
        """Add the evaluations and factorisations since the last call to the counters of the run."""
        for name, place in COUNTERS.items():
            found = getattr(self.solver, name)
            w.counters[place] += found - self._counted[name]
            self._counted[name] = found

    def _kept(self) -> dict[str, Any]:
        """Return the attributes of SciPy's solver that `_restore` sets to take it back to the state before a step."""
        return {name: value for name, value in vars(self.solver).items() if name not in (*COUNTERS, "jac_factor")}

    def _restore(self) -> None:
        """Take SciPy's solver back to the state before the last step; it must compute its LU factorisations again."""
        vars(self.solver).update(
            self._before | dict.fromkeys(self._factors(), None) | {"max_step": self.solver.max_step}
        )

    def _factors(self) -> list[str]:
        return [name for name in vars(self.solver) if name.startswith("LU")]

    def state(self) -> dict[str, Any]:
        """Return the values from which another stepper continues with the same bits."""
        own = vars(self.solver)
        values = {name: value for name, value in own.items() if isinstance(value, DenseOutput) or not callable(value)}
        # Sparse factorisations cannot be copied; the solver makes them again.
        return values | {name: None for name in self._factors() if not isinstance(values[name], tuple)}

    def resume(self, values: dict[str, Any]) -> None:
        """Continue from the `state` of another stepper; `begin` must have been called before."""
        vars(self.solver).update(values)
        self._counted = {name: getattr(self.solver, name) for name in COUNTERS}

    def _watch(self, solver: Any) -> None:
        """Change the solver so that it keeps values of a step that `_error` needs."""

    def _move(self, y: Array) -> None:
        """Set the state of SciPy's solver to the projected state y."""
        raise NotImplementedError

    def _error(self, h: float) -> Array:
        """Return the error estimate of each component in the last step, of length h."""
        raise NotImplementedError

    def _describe(self, h: float, rows: Array) -> None:
        """Fill `rows` with the vectors that the `polynomials` of `Driven` combine into the last step's interpolant."""
        raise NotImplementedError

    def _slope(self, rows: Array) -> Array:
        """Return the derivative (n,) of the state at the end of the step; `_describe` has filled the `rows` before."""
        raise NotImplementedError


class RadauStepper(Stepper):
    """Stepper for SciPy's Radau.

    The derivative is evaluated again at a projected state, because the error estimate needs it. The predictor of the
    next step extrapolates the unprojected polynomial of the last step.
    """

    _solved: Array

    def _watch(self, solver: Any) -> None:
        solve = solver.solve_lu

        def solve_lu(factors: Any, b: Array) -> Array:
            self._solved = solve(factors, b)
            return self._solved

        solver.solve_lu = solve_lu

    def _move(self, y: Array) -> None:
        self.solver.y = y
        self.solver.f = self.solver.fun(self.solver.t, y)

    def _error(self, h: float) -> Array:
        return self._solved  # an accepted step ends with the linear system whose solution is the error estimate

    def _describe(self, h: float, rows: Array) -> None:
        np.divide(self.solver.Z, h, out=rows)

    def _slope(self, rows: Array) -> Array:
        return self.solver.f


class BDFStepper(Stepper):
    """Stepper for SciPy's BDF, whose history consists of backward differences D of states at equal distances in time.

    A projection shifts all states of the history by the same vector, so that the differences stay unchanged. On a
    chain with dampers the errors are 0.23 of those without projection, with 1.33 times the evaluations. To shift only
    the last state, and thereby change all differences, would give about the same: 0.20 of the errors without projection
    with 1.35 times the evaluations.
    """

    def _kept(self) -> dict[str, Any]:
        return super()._kept() | {"D": self.solver.D.copy()}

    def _move(self, y: Array) -> None:
        self.solver.y = y
        self.solver.D[0] = y

    def _error(self, h: float) -> Array:
        solver, order = self.solver, self._before["order"]
        difference = solver.D[order + 1]
        if solver.order > order:  # then this difference has been scaled to the next step's length
            difference = difference / (solver.h_abs / abs(h)) ** (order + 1)
        return solver.error_const[order] * difference

    def _describe(self, h: float, rows: Array) -> None:
        """Fill `rows` with the coefficients of x, x^2, ... in the interpolant, divided by h, where x = (t - t_old) / h.

        The solver has already changed its differences D to the length of the next step. Therefore x - 1 is scaled
        by the ratio of the two lengths.
        """
        order = self.solver.order
        ratio = (abs(h) / self.solver.h_abs) ** np.arange(MOST_ORDER + 1)
        powers = (SHIFTED * ratio) @ NEWTON[:, : order + 1]
        np.divide(powers[1:] @ self.solver.D[: order + 1], h, out=rows)

    def _slope(self, rows: Array) -> Array:
        return np.arange(1, MOST_ORDER + 1) @ rows


def _newton() -> Array:
    """Return an array whose column k contains the coefficients of 1, s, s^2, ... in s (s + 1) ... (s + k - 1) / k!."""
    out = np.zeros((MOST_ORDER + 1, MOST_ORDER + 1))
    out[0, 0] = 1.0
    for k in range(1, MOST_ORDER + 1):
        out[1:, k] = out[:-1, k - 1]
        out[:, k] += (k - 1) * out[:, k - 1]
        out[:, k] /= k
    return out


NEWTON = _newton()
# Column j contains the coefficients of 1, x, x^2, ... in (x - 1)^j.
SHIFTED = invpascal(MOST_ORDER + 1, "upper").astype(float)
DRIVEN_RADAU = Driven(Radau, RadauStepper, 5, 3, np.linalg.inv(NODES[:, None] ** np.arange(1, 4)), takes_complex=False)
DRIVEN_BDF = Driven(BDF, BDFStepper, 1, 1, np.eye(MOST_ORDER), takes_complex=True)
