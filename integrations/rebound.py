"""REBOUND: its simulations as problems, our runs as simulations and archives, and its integrators as references.

REBOUND's integrators start from the states of this package, so that a comparison is fair. Masses enter as G m with
G = 1, the Sun first, in the frame of the centre of mass. A run with fixed steps ends after a number of steps, not at a
time: REBOUND's own clock accumulates rounding errors, which at 1000 years exceed WHFast's own error. WHFast and SABA
run without safe mode and are synchronised before each reading of the state, in a way that does not change the run.

REBOUND (H. Rein, S.-F. Liu, Astronomy & Astrophysics 537 (2012) A128) is free software under the GPL and is not
distributed with this package; versions 4.6 and 5 are supported.
"""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np

from eip_scipy.core.inputs import count, is_number, real_array

try:
    import rebound
except ModuleNotFoundError as error:
    raise ImportError(
        'eip_scipy.integrations.rebound needs REBOUND: pip install "eip_scipy[rebound]"', name="rebound"
    ) from error

from ._rebound_exchange import exit_events, problem_from_simulation, read_archive, to_archive, to_simulation
from ._rebound_exchange import state as _state

__all__ = [
    "INTEGRATORS", "ReboundRun", "exit_events", "keep_ctrl_c", "megno",
    "problem_from_simulation", "read_archive", "run", "simulation", "to_archive", "to_simulation",
]  # fmt: skip

INTEGRATORS = ("whfast", "whfast-c17", "ias15", "leapfrog", "saba(10,6,4)")

# Steps between two checks for Ctrl-C, which Python handles only outside of REBOUND's loop. Version 4 counts in 32 bits.
_CHUNK = 100_000


@dataclass(frozen=True)
class ReboundRun:
    """Result of `run`; m saved points, N bodies, n = 6 N.

    Attributes
    ----------
    name : str
        The integrator, as given to `run`.
    version : str
        REBOUND's version.
    t : ndarray, shape (m,)
        Saved times, multiples of `h`, including 0 and the end.
    y : ndarray, shape (n, m)
        States (q, v) at `t`, in the frame of the centre of mass.
    wall_time : float
        Seconds spent in the integration and its synchronisations, without reading states and computing invariants.
    steps : int
        Number of steps; for "ias15" the number of accepted ones.
    energy_error : ndarray, shape (m,)
        ``|E(t) - E(0)| / |E(0)|`` of the Newtonian energy, or ``|E(t) - E(0)|`` if E(0) is 0.
    angular_momentum_error : ndarray, shape (m,)
        ``|L(t) - L(0)| / |L(0)|``, Euclidean norms, or ``|L(t) - L(0)|`` if L(0) is 0.
    """

    name: str
    version: str
    t: np.ndarray
    y: np.ndarray
    wall_time: float
    steps: int
    energy_error: np.ndarray
    angular_momentum_error: np.ndarray


@contextmanager
def keep_ctrl_c() -> Iterator[None]:
    """Give Ctrl-C back to Python after calls of ``Simulation.integrate``.

    REBOUND handles the signal itself from the first such call on, so that Ctrl-C afterwards stops nothing but its own
    integrations. Python can take the signal back in the main thread only; elsewhere this function does nothing.

    Examples
    --------
    >>> with keep_ctrl_c():  # doctest: +SKIP
    ...     sim.integrate(100.0)
    """
    try:
        yield
    finally:
        handler = signal.getsignal(signal.SIGINT)
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)


def simulation(gm: Any, y: Any) -> rebound.Simulation:
    """Build a REBOUND simulation from one of our states.

    Parameters
    ----------
    gm : array_like, shape (N,)
        G times the masses, the central body (the Sun) first.
    y : array_like, shape (6 N,)
        State (q, v): positions (N, 3), then velocities (N, 3), in units that agree with `gm`.

    Returns
    -------
    rebound.Simulation
        A simulation with G = 1, m = gm and t = 0, moved to the frame of the centre of mass.

    Raises
    ------
    ValueError
        If shapes do not fit, a number is not finite, or a mass is not positive.
    """
    gm, y = _check_state(gm, y)
    sim = rebound.Simulation()
    sim.G = 1.0
    q, v = y.reshape(2, -1, 3).tolist()
    for m, (x, y_, z), (vx, vy, vz) in zip(gm.tolist(), q, v, strict=True):
        sim.add(m=m, x=x, y=y_, z=z, vx=vx, vy=vy, vz=vz)
    sim.move_to_com()
    return sim


def megno(gm: Any, y: Any, *, t_end: float, dt: float, seed: int = 1) -> tuple[float, float, np.ndarray]:
    """Compute the chaos indicator MEGNO by WHFast and REBOUND's variational particles.

    Parameters
    ----------
    gm, y : array_like
        As for `simulation`.
    t_end, dt : float
        End of the run from t = 0, and the step.
    seed : int, optional
        Seed of the random tangent vector.

    Returns
    -------
    megno : float
        The mean MEGNO at the end.
    slope : float
        Slope of `megno` against t (``Simulation.lyapunov()``), half of the largest Lyapunov exponent.
    deviation : ndarray, shape (6 N,)
        The tangent vector at the start.
    """
    sim = simulation(gm, y)
    n = sim.N
    sim.integrator, sim.dt = "whfast", dt
    sim.init_megno(seed=seed)
    # Version 4 stores the variational particles after the others.
    varied = list(sim.particles_var) if hasattr(sim, "particles_var") else list(sim.particles)[n:]
    deviation = np.array([*(p.xyz for p in varied), *(p.vxyz for p in varied)]).ravel()
    with keep_ctrl_c():
        sim.integrate(t_end)
    return float(sim.megno()), float(sim.lyapunov()), deviation


def run(
    gm: Any,
    y0: Any,
    integrator: str,
    *,
    h: float,
    n_steps: int | None = None,
    t_end: float | None = None,
    save_every: int | None = None,
    prepare: Callable[[rebound.Simulation], Any] | None = None,
) -> ReboundRun:
    """Integrate N bodies forward from t = 0 with one of REBOUND's integrators.

    Parameters
    ----------
    gm : array_like, shape (N,)
        G times the masses, the central body (the Sun) first.
    y0 : array_like, shape (6 N,)
        Initial state (q, v); its centre of mass is moved to the origin and brought to rest.
    integrator : str
        - "whfast": WHFast in Jacobi coordinates without corrector, REBOUND's default;
        - "whfast-c17": the same with the symplectic corrector of order 17;
        - "saba(10,6,4)": SABA(10,6,4);
        - "leapfrog": Störmer-Verlet of order 2 in its drift-kick-drift form, as
          ``stormer_verlet(..., form="drift-kick-drift")``;
        - "ias15": adaptive of order 15, with REBOUND's own tolerance and first step.
    h : float
        Length of a step. "ias15" chooses its steps itself and ends one on each saved time k h exactly.
    n_steps : int, optional
        Number of steps of length `h`; either this or `t_end`.
    t_end : float, optional
        End, a whole number of steps from 0; the run then ends at round(t_end / h) h.
    save_every : int, optional
        Save every `save_every`-th state in addition to the first and the last; default: only these two.
    prepare : callable, optional
        ``prepare(simulation)`` before the run, for example to set IAS15's tolerance (in version 5
        ``simulation.integrator.epsilon``) or to add forces by REBOUNDx; what it returns is kept alive.
        The errors of the invariants remain those of the Newtonian ones.

    Returns
    -------
    ReboundRun
        States, errors of the invariants, and the time that the run took.

    Raises
    ------
    ValueError
        If the integrator is unknown or a value is wrong; the message says what was expected.

    Notes
    -----
    Saving does not disturb the steps of a fixed-step integrator: the states do not depend on `save_every`. Those of
    "ias15" do, at the level of its round-off, because each saved time cuts a step.

    REBOUND's own warnings are passed on, for example its RuntimeWarning when a step of WHFast, or of its corrector,
    exceeds a period.

    References
    ----------
    H. Rein, D. Tamayo, WHFast, MNRAS 452 (2015) 376-388; H. Rein, D. S. Spiegel, IAS15, MNRAS 446 (2015) 1424-1437;
    H. Rein, D. Tamayo, G. Brown, High-order symplectic integrators for planetary dynamics, MNRAS 489 (2019) 4632-4640.
    """
    gm, y0 = _check_state(gm, y0)
    if integrator not in INTEGRATORS:
        raise ValueError(f"unknown integrator {integrator!r}: expected one of {', '.join(map(repr, INTEGRATORS))}")
    if integrator.startswith(("whfast", "saba")) and gm.argmax() != 0:
        raise ValueError(
            f"{integrator} follows orbits around body 0, which is not the heaviest; put the heaviest body (the Sun) "
            "first"
        )
    steps = _count_steps(h, n_steps, t_end)
    saved = np.append(np.arange(0, steps, steps if save_every is None else count("save_every", save_every)), steps)
    sim = simulation(gm, y0)
    _set_integrator(sim, integrator)
    kept = None if prepare is None else prepare(sim)
    if integrator != "ias15":
        sim.dt = h
    y = np.empty((saved.size, y0.size))
    y[0] = _state(sim)
    wall_time = 0.0
    for row, (first, last) in enumerate(pairwise(saved.tolist()), start=1):
        start = perf_counter()
        if integrator == "ias15":
            with keep_ctrl_c():
                sim.integrate(last * h, exact_finish_time=1)
        else:
            for done in range(first, last, _CHUNK):
                sim.steps(min(_CHUNK, last - done))
        sim.synchronize()
        wall_time += perf_counter() - start
        y[row] = _state(sim)
    del kept
    energy_error, angular_momentum_error = _invariant_errors(gm, y)
    return ReboundRun(
        name=integrator,
        version=rebound.__version__,
        t=saved * h,
        y=y.T,
        wall_time=wall_time,
        steps=int(sim.steps_done),
        energy_error=energy_error,
        angular_momentum_error=angular_momentum_error,
    )


def _check_state(gm: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    gm, y = real_array("gm", gm), real_array("y", y)
    if gm.ndim != 1 or gm.size < 2:
        raise ValueError(f"gm must hold at least two bodies in one dimension, got shape {gm.shape}")
    if y.shape != (6 * gm.size,):
        raise ValueError(f"the state of {gm.size} bodies has shape ({6 * gm.size},), got {y.shape}")
    if not (np.isfinite(gm).all() and np.isfinite(y).all()):
        raise ValueError("gm and the state must be finite")
    if not (gm > 0).all():
        raise ValueError(f"gm must be positive (test particles are not supported), got {gm.min()!r}")
    return gm, y


def _count_steps(h: float, n_steps: int | None, t_end: float | None) -> int:
    if not (is_number(h, "h") and h > 0 and math.isfinite(h)):
        raise ValueError(f"h must be positive and finite, got {h!r}")
    if (n_steps is None) == (t_end is None):
        raise ValueError("give either n_steps or t_end, and not both")
    if t_end is None:
        return count("n_steps", n_steps)
    if not (t_end > 0 and math.isfinite(t_end)):
        raise ValueError(f"t_end must be positive and finite, got {t_end!r}")
    n_steps = round(t_end / h)
    # The looser bound is for long runs, in which the rounding of h alone moves t_end / h away from an integer.
    if n_steps < 1 or abs(t_end / h - n_steps) > max(1e-9, 8 * np.finfo(float).eps * n_steps):
        raise ValueError(
            f"t_end = {t_end!r} is {t_end / h!r} steps of h = {h!r}: expected a whole number of steps, "
            "because a shortened step would spoil a symplectic method. Change h or t_end"
        )
    return n_steps


def _set_integrator(sim: rebound.Simulation, name: str) -> None:
    family = name.removesuffix("-c17").removesuffix("(10,6,4)")
    sim.integrator = family
    # Version 4 keeps an integrator's options in sim.ri_<family>, version 5 in sim.integrator.
    version_4 = hasattr(sim, "ri_whfast")
    options = getattr(sim, f"ri_{family}") if version_4 else sim.integrator
    if family in ("whfast", "saba"):
        options.safe_mode = 0
        # A copy is synchronised, so that a saved point does not change the run.
        options.keep_unsynchronized = 1
    if family == "saba":
        options.type = "10,6,4" if version_4 else "10_6_4"
    if name == "whfast-c17":
        options.corrector = 17


def _invariant_errors(gm: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors (m,) of energy and angular momentum along y (m, 6 N), as `ReboundRun` defines them."""
    q, v = np.moveaxis(y.reshape(len(y), 2, -1, 3), 1, 0)
    energy = 0.5 * (v**2).sum(axis=2) @ gm
    for i in range(gm.size - 1):
        energy -= gm[i] * (1 / np.linalg.norm(q[:, i + 1 :] - q[:, i : i + 1], axis=2) @ gm[i + 1 :])
    momentum = (gm[:, None] * np.cross(q, v)).sum(axis=1)
    energy_error = np.abs(energy - energy[0])
    momentum_error = np.linalg.norm(momentum - momentum[0], axis=1)
    return energy_error / (abs(energy[0]) or 1.0), momentum_error / (np.linalg.norm(momentum[0]) or 1.0)
