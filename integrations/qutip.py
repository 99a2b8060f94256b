"""qutip: an integrator for `qutip.sesolve` that keeps norm and energy.

Importing this module registers the integrator: ``qutip.sesolve(H, psi0, tlist, options={"method": "eip"})``.

qutip (J. R. Johansson, P. D. Nation, F. Nori, Computer Physics Communications 183 (2012) 1760-1772) is free software
under the BSD licence.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, Invariant

try:
    from qutip.core.data import Dense, dense
    from qutip.solver.integrator import Integrator, IntegratorException
    from qutip.solver.sesolve import SESolver
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.qutip needs qutip 5: pip install "eip_scipy[qutip]"', name="qutip"
    ) from error

__all__ = ["IntegratorEIP"]


class IntegratorEIP(Integrator):
    """Integrator of qutip that keeps the norm and, if the Hamiltonian is constant, the energy.

    ``SESolver`` knows it under the name "eip". States are kets, or operators such as propagators: for these the sums of
    the squared norms and of the energies of all columns are kept. The attribute ``solver_class``, `EIPDOP853`, is the
    class that makes the steps; a subclass of this integrator with another ``solver_class`` is registered by
    ``qutip.SESolver.add_integrator(Subclass, "name")``.

    Raises
    ------
    ValueError
        If the system is not -i times a Hermitian operator at the start, because norm and energy then change.
    qutip.solver.IntegratorException
        If a step fails.
    """

    integrator_options = {"atol": 1e-8, "rtol": 1e-6, "first_step": 0, "max_step": 0}  # noqa: RUF012
    support_time_dependant = True
    supports_blackbox = False
    method = "eip"
    solver_class: type[Any] = EIPDOP853

    @property
    def options(self) -> dict[str, Any]:
        """Supported options of the method "eip".

        atol, rtol : float, default: 1e-8, 1e-6
            Absolute and relative tolerance.
        first_step, max_step : float, default: 0
            First and longest step; 0: chosen by the method.

        """  # qutip appends this text to that of the solver's options, and needs it
        return self._options

    @options.setter
    def options(self, new_options: dict[str, Any]) -> None:
        Integrator.options.fset(self, new_options)

    def _prepare(self) -> None:
        self.name = self.solver_class.__name__

    def set_state(self, t: float, state0: Any) -> None:
        """Discard the present run, and start from the state `state0` (N, columns) at time `t`."""
        if not (1j * self.system(t)).isherm:
            raise ValueError(
                'method "eip": the system is not -i times a Hermitian operator, so that norm and energy change. Use '
                "another method."
            )
        self._shape = state0.shape
        control = {name: value for name, value in self.options.items() if value}
        y0 = state0.to_array().astype(complex).ravel()
        self.solver = self.solver_class(self._derivative, t, y0, np.inf, invariants=self._invariants(), **control)
        self._t, self._y = float(t), self.solver.y
        self._is_set = True

    def get_state(self, copy: bool = True) -> tuple[float, Any]:
        """Return the present time, and the state as an object of qutip's data layer: a copy if `copy` is true."""
        if not self._is_set:
            raise IntegratorException("The state is not set: call set_state first.")
        return self._t, Dense(self._y.reshape(self._shape), copy=copy)

    def integrate(self, t: float, copy: bool = True) -> tuple[float, Any]:
        """Integrate to `t`, which must not be before the start of the last step; return what `get_state` returns."""
        solver = self.solver
        while solver.t < t:
            message = solver.step()
            if solver.status == "failed":
                raise IntegratorException(message)
        if t < self._t and (solver.t_old is None or t < solver.t_old):
            raise IntegratorException(
                f"t={t} is before the last step, which starts at {solver.t_old} (None: no step yet). Call set_state."
            )
        self._t, self._y = float(t), solver.y if t == solver.t else solver.dense_output()(t)
        return self.get_state(copy)

    def _derivative(self, t: float, y: np.ndarray) -> np.ndarray:
        # The class Dense takes five times as long as the product; the function that qutip's integrators call is quick.
        return self.system.matmul_data(t, dense.fast_from_numpy(y.reshape(self._shape))).as_ndarray().ravel()

    def _invariants(self) -> list[Invariant]:
        norm = Invariant(lambda t, y: np.vdot(y, y).real, lambda t, y: 2 * y, name="norm")
        if not self.system.isconstant:
            return [norm]
        energy = Invariant(
            lambda t, y: -np.vdot(y, self._derivative(t, y)).imag, lambda t, y, f: 2j * f, uses_f=True, name="energy"
        )
        return [norm, energy]


SESolver.add_integrator(IntegratorEIP, "eip")
