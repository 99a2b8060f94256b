"""The integrator "eip" of qutip against closed forms, exact diagonalisation and qutip's own methods."""

import numpy as np
import pytest

qutip = pytest.importorskip("qutip", minversion="5.1.1", reason='needs qutip: pip install "eip_scipy[qutip]"')

from eip_scipy import EIPRK45  # noqa: E402
from eip_scipy.integrations.qutip import IntegratorEIP  # noqa: E402

X, Y, Z = qutip.sigmax(), qutip.sigmay(), qutip.sigmaz()
UP = qutip.basis(2, 0)
QUIET = {"progress_bar": "", "normalize_output": False, "store_states": True}


def options(method, **more):
    return QUIET | {"method": method} | more


def spin_chain(n):
    def at(operator, site):
        return qutip.tensor([operator if k == site else qutip.qeye(2) for k in range(n)])

    bonds = sum(at(s, k) * at(s, k + 1) for k in range(n - 1) for s in (X, Y, Z))
    return 0.5 * bonds + sum(0.3 * k * at(Z, k) for k in range(n))


def errors(H, result):
    """Largest errors of the norm and of the energy."""
    norms, energies = [state.norm() for state in result.states], qutip.expect(H, result.states)
    return np.ptp(norms), np.ptp(energies)


def test_rabi_oscillations():
    """A driven spin: its population in closed form; norm and energy are kept where qutip's methods lose them."""
    drive, detuning = 1.3, 0.7
    H, times = (drive * X + detuning * Z) / 2, np.linspace(0, 100, 41)
    Omega = np.hypot(drive, detuning)
    exact = 1 - (drive / Omega * np.sin(Omega * times / 2)) ** 2
    found = {
        method: qutip.sesolve(H, UP, times, e_ops=[UP.proj()], options=options(method, rtol=1e-7, atol=1e-7))
        for method in ("eip", "dop853")
    }
    assert np.abs(found["eip"].expect[0] - exact).max() < 5e-6
    assert max(errors(H, found["eip"])) < 1e-13
    assert min(errors(H, found["dop853"])) > 1e-7
    assert found["eip"].stats["method"] == "EIPDOP853"


def test_spin_chain():
    H, n = spin_chain(4), 4
    start = qutip.tensor([qutip.basis(2, k % 2) for k in range(n)])
    values, vectors = np.linalg.eigh(H.full())
    exact = vectors @ (np.exp(-10j * values) * (vectors.conj().T @ start.full().ravel()))
    result = qutip.sesolve(H, start, np.linspace(0, 10, 11), options=options("eip", rtol=1e-10, atol=1e-10))
    assert np.abs(result.states[-1].full().ravel() - exact).max() < 1e-8
    assert max(errors(H, result)) < 1e-13


def test_what_depends_on_time_keeps_the_norm():
    """A field that rotates about z: in its frame it is constant."""
    w, b = 0.8, 0.5
    system = qutip.QobjEvo(
        [[X, lambda t, w, b: b * np.cos(w * t)], [Y, lambda t, w, b: b * np.sin(w * t)]], args={"w": w, "b": b}
    )
    solver = qutip.SESolver(system, options=options("eip", rtol=1e-9, atol=1e-9))
    for args in ({}, {"b": 0.2}):
        result = solver.run(UP, np.linspace(0, 50, 6), e_ops=[Z], args=args)
        field = 2 * args.get("b", b)
        Omega = np.hypot(w, field)
        exact = 1 - 2 * (field / Omega * np.sin(Omega * np.linspace(0, 50, 6) / 2)) ** 2
        assert np.abs(result.expect[0] - exact).max() < 1e-6
        assert np.ptp([state.norm() for state in result.states]) < 1e-13


def test_propagators_and_steps():
    solver = qutip.SESolver(X, options=options("eip", rtol=1e-8, atol=1e-8))
    solver.start(qutip.qeye(2), 0.0)
    propagator = solver.step(3.0)
    assert np.abs((propagator - (-3j * X).expm()).full()).max() < 1e-6
    steps = solver._integrator
    assert steps.mcstep(4.0)[0] == 4.0
    t, state = steps.mcstep(3.5)  # back into the last call
    assert t == 3.5
    assert np.abs(state.to_array() - (-3.5j * X).expm().full()).max() < 1e-6
    with pytest.raises(qutip.solver.IntegratorException, match=r"t=-1 is before the last step"):
        steps.integrate(-1)


def test_another_method():
    class IntegratorRK45(IntegratorEIP):
        solver_class = EIPRK45

    qutip.SESolver.add_integrator(IntegratorRK45, "eip-rk45")
    result = qutip.sesolve(Z, (UP + qutip.basis(2, 1)).unit(), [0, 10], options=options("eip-rk45", max_step=0.5))
    assert result.stats["method"] == "EIPRK45"
    assert max(errors(Z, result)) < 1e-13


def test_systems_that_lose_their_norm_are_refused():
    with pytest.raises(ValueError, match="not -i times a Hermitian operator"):
        qutip.sesolve(Z - 0.1j * UP.proj(), UP, [0, 1], options=options("eip"))
