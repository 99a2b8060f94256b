"""Stiff systems by SciPy's Radau and by EIPRadau: what keeping a length and constraints changes.

    python examples/stiff_systems.py

Prints the errors at the end and the calls of the right-hand side (those for Jacobians included) at rtol = 1e-5,
compared with SciPy's LSODA at rtol = 1e-11.
"""

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRadau, Invariant
from eip_scipy.problems import mechanism


def magnet(t, y):
    """Return the rate of a magnetic moment in a rotating field, with strong damping (Landau and Lifshitz)."""
    turn = np.cross(y, 1e3 * np.array([np.cos(t), np.sin(t), 0.5 + y[2]]))
    return -turn - 5.0 * np.cross(y, turn)


def lengths(t, q):
    """Return the constraints of a chain of three links of 1 m from the origin."""
    links = q.reshape(3, 2) - np.concatenate([np.zeros((1, 2)), q.reshape(3, 2)[:2]])
    return ((links**2).sum(axis=1) - 1) / 2


def forces(t, q, u):
    """Return the forces on its ends, of 1 kg: weight, and dampers of 1e4 N m s between the links."""
    steps = [np.concatenate([np.zeros((1, 2)), x.reshape(3, 2)]) for x in (q, u)]
    along, moving = (np.diff(x, axis=0) for x in steps)
    turned = np.column_stack([-along[:, 1], along[:, 0]]) / (along**2).sum(axis=1)[:, None]
    damping = np.append(1e4 * np.diff((turned * moving).sum(axis=1)), 0.0)
    torques = (damping - np.concatenate([np.zeros(1), damping[:2]]))[:, None] * turned
    return (torques - np.concatenate([torques[1:], np.zeros((1, 2))])).ravel() + np.tile([0.0, -9.81], 3)


ANGLES = np.array([1.2, 0.9, 0.5])
START = np.cumsum(np.column_stack([np.sin(ANGLES), -np.cos(ANGLES)]), axis=0).ravel()
chain = mechanism(np.ones(6), forces, lengths, q0=START, u0=np.zeros(6), t_span=(0, 2))
SYSTEMS = {  # right-hand side, end, start, invariants
    "magnet": (magnet, 5, [0.6, 0.0, 0.8], [lambda t, y: y @ y]),
    "chain": (chain.fun, 2, chain.y0, chain.constraints),
}

if __name__ == "__main__":
    print(f"{'':10}{'error':>10}{'kept':>10}{'calls':>8}{'kept':>8}")
    for name, (fun, end, y0, kept) in SYSTEMS.items():
        invariants = [item if isinstance(item, Invariant) else Invariant(item) for item in kept]
        exact = solve_ivp(fun, (0, end), y0, method="LSODA", rtol=1e-11, atol=1e-12).y[:, -1]
        cells = []
        for method, more in (("Radau", {}), (EIPRadau, {"invariants": invariants})):
            run = solve_ivp(fun, (0, end), y0, method=method, rtol=1e-5, atol=1e-7, **more)
            cells.append((np.abs(run.y[:, -1] - exact).max(), run.nfev))
        (error, calls), (small, more_calls) = cells
        print(f"{name:10}{error:10.1e}{small:10.1e}{calls:8}{more_calls:8}")
