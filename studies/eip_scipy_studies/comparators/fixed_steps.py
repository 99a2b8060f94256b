"""Methods with fixed steps for ordinary differential equations: Störmer-Verlet, the Boris pusher, implicit midpoint."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ._steps import FixedSteps, Result, add, check_state, drive, inlined, njit

FORMS = ("kick-drift-kick", "drift-kick-drift")
MOST_ITERATIONS = 100
SOLVED = 1e-12  # relative change below which an iteration that no longer improves is done


def stormer_verlet(
    acc: Callable[..., Any], t_span: tuple[float, float], y0: Any, h: float,
    *, form: str = FORMS[0], params: Any = None, save_every: int | None = None,
) -> Result:  # fmt: skip
    """Integrate q'' = a(t, q) by Störmer-Verlet with a fixed step.

    Both forms are symplectic (as long as all steps are equal), reversible and of order 2, with one evaluation per step;
    their error constants differ. REBOUND's "leapfrog" is the drift-kick-drift form. See E. Hairer, C. Lubich, G.
    Wanner, Acta Numerica 12 (2003) 399-450.

    Parameters
    ----------
    acc : callable
        ``acc(t, q[, params]) -> (n/2,)``. A function jitted by Numba runs compiled, any other callable interpreted.
    t_span : tuple of float
        Start and end; a smaller end integrates backward.
    y0 : array_like, shape (n,)
        Initial state (q, v), real.
    h : float
        Length of a step, positive in both directions; the last one is shortened if `h` does not divide the interval.
    form : {"kick-drift-kick", "drift-kick-drift"}
        Order of the updates within a step: v first and last (velocity Verlet), or q first and last.
    params : array_like, shape (p,), optional
        Passed to `acc` as a float64 array when given.
    save_every : int, optional
        Save every `save_every`-th state in addition to the first and the last; default: only these two.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy_studies.comparators import stormer_verlet
    >>> run = stormer_verlet(lambda t, q: -q, (0.0, 10.0), [1.0, 0.0], 0.01)
    >>> bool(abs(run.y[0, -1] - np.cos(10.0)) < 1e-4)
    True
    """
    steps, y = FixedSteps.of(t_span, h, save_every), check_state(y0)
    half = y.size // 2
    if y.size == 0 or y.size % 2:
        raise ValueError(f"y0 must hold q and v, an even number of components, got {y.size}")
    if form not in FORMS:
        raise ValueError(f"unknown form {form!r}: expected one of {', '.join(map(repr, FORMS))}")
    extra = () if params is None else (check_state(params, "params"),)
    value = acc(steps.t0, y[:half].copy(), *extra)
    if np.iscomplexobj(value) or np.shape(value) != (half,):
        raise ValueError(f"acc returned {value!r}, expected an array of {half} real numbers")
    step, kicks = (_kick_drift_kick, True) if form == FORMS[0] else (_drift_kick_drift, False)
    return drive(step, acc, steps, y, params, takes=half, fills=half, returns=True, start=kicks)


@inlined
def _kick_drift_kick(fun, t, h, q, v, params, constant, a, work):  # type: ignore[no-untyped-def]
    add(v, 0.5 * h, a)
    add(q, h, v)
    fun(t + h, q, a, *params)
    add(v, 0.5 * h, a)
    return 1


@inlined
def _drift_kick_drift(fun, t, h, q, v, params, constant, a, work):  # type: ignore[no-untyped-def]
    add(q, 0.5 * h, v)
    fun(t + 0.5 * h, q, a, *params)
    add(v, h, a)
    add(q, 0.5 * h, v)
    return 1


def boris(
    fields: Callable[..., None], t_span: tuple[float, float], y0: Any, h: float,
    *, mass: float = 1.0, charge: float = 1.0, params: Any = None, save_every: int | None = None,
) -> Result:  # fmt: skip
    """Integrate m x'' = q (E + x' x B) by the Boris pusher with a fixed step.

    A step consists of half a step along the velocity, half of the electric kick, a rotation around B, the other half of
    the kick, and half a step along the velocity, with one evaluation of the fields. The method is reversible, of order
    2 and keeps phase-space volume, but is not symplectic; the rotation alone keeps the kinetic energy exactly if E is
    0. See J. P. Boris, Proc. 4th Conf. on Numerical Simulation of Plasmas (1970) 3-67; H. Qin et al., Physics of
    Plasmas 20 (2013) 084503.

    The function ``fields(t, x, out[, params])`` fills out[:3] with E and out[3:] with B; see `ParticleField.fill`. The
    state is (x, v), and other parameters are those of `stormer_verlet`.
    """
    y = check_state(y0)
    if y.size != 6:
        raise ValueError(f"y0 must hold position and velocity, 6 components, got {y.size}")
    if not (mass > 0 and math.isfinite(mass) and math.isfinite(charge)):
        raise ValueError(f"mass must be positive and finite, and charge finite, got {mass!r} and {charge!r}")
    steps = FixedSteps.of(t_span, h, save_every)
    return drive(_push, fields, steps, y, params, takes=3, fills=6, constant=charge / mass)


@inlined
def _push(fun, t, h, x, v, params, constant, f, work):  # type: ignore[no-untyped-def]
    half, kick = 0.5 * h, constant * 0.5 * h
    add(x, half, v)
    fun(t + half, x, f, *params)
    u, w, z = v[0] + kick * f[0], v[1] + kick * f[1], v[2] + kick * f[2]
    a, b, c = kick * f[3], kick * f[4], kick * f[5]
    s = 2.0 / (1.0 + a * a + b * b + c * c)
    # v' = v + v x t, then v + v' x s.
    p, q, r = u + w * c - z * b, w + z * a - u * c, z + u * b - w * a
    v[0] = u + s * (q * c - r * b) + kick * f[0]
    v[1] = w + s * (r * a - p * c) + kick * f[1]
    v[2] = z + s * (p * b - q * a) + kick * f[2]
    add(x, half, v)
    return 1


def implicit_midpoint(
    rhs: Callable[..., None], t_span: tuple[float, float], y0: Any, h: float,
    *, params: Any = None, save_every: int | None = None,
) -> Result:  # fmt: skip
    """Integrate y' = f(t, y) by the implicit midpoint rule with a fixed step.

    y_new = y + h k, k = f(t + h / 2, y + h k / 2). The rule is symplectic for canonical equations. It keeps linear and
    quadratic invariants, such as x p_y - y p_x, but in general no others. The equation for k is solved to round-off by
    fixed-point iteration, which starts from an extrapolation of the last two steps, and converges if h times the norm
    of the Jacobian of f is below about 2; otherwise the run ends, and the states from there on are nan. See E. Hairer,
    C. Lubich, G. Wanner, Geometric Numerical Integration (2006), theorems IV.2.1 and VI.4.2 and section VIII.6.

    The function ``rhs(t, y, out[, params])`` fills out; other parameters are those of `stormer_verlet`.
    """
    y = check_state(y0)
    steps = FixedSteps.of(t_span, h, save_every)
    return drive(_midpoint, rhs, steps, y, params, takes=y.size, fills=y.size)


@inlined
def _midpoint(fun, t, h, y, v, params, constant, f, work):  # type: ignore[no-untyped-def]
    n = y.size
    stage, k, before = work[0], work[1], work[2]
    for i in range(n):
        k[i], before[i] = 2.0 * k[i] - before[i], k[i]
    last = math.inf
    for iteration in range(1, MOST_ITERATIONS + 1):
        for i in range(n):
            stage[i] = y[i] + 0.5 * h * k[i]
        fun(t + 0.5 * h, stage, f, *params)
        change = size = 0.0
        for i in range(n):
            change, size = max(change, abs(f[i] - k[i])), max(size, abs(f[i]))
            k[i] = f[i]
        if change == 0.0 or (change >= last and change <= SOLVED * size):
            for i in range(n):
                y[i] += h * k[i]
            return iteration
        last = change
    return -MOST_ITERATIONS


@njit(error_model="numpy")
def newton(t, q, gm):  # type: ignore[no-untyped-def]
    """Return the accelerations (3 N,) of N bodies under their mutual gravity; `gm` (N,) is G times the masses."""
    n, k = gm.size, 0
    out, pulls = np.zeros(3 * n), np.empty(n * (n - 1) // 2)  # r^-3 of the pairs, in a loop that vectors can take
    for i in range(1, n):
        for j in range(i):
            x, y, z = q[3 * j] - q[3 * i], q[3 * j + 1] - q[3 * i + 1], q[3 * j + 2] - q[3 * i + 2]
            pulls[k] = x * x + y * y + z * z
            k += 1
    for k in range(pulls.size):
        pulls[k] = 1.0 / (pulls[k] * np.sqrt(pulls[k]))
    k = 0
    for i in range(1, n):
        ax = ay = az = 0.0
        for j in range(i):
            x, y, z = q[3 * j] - q[3 * i], q[3 * j + 1] - q[3 * i + 1], q[3 * j + 2] - q[3 * i + 2]
            a, b = gm[j] * pulls[k], gm[i] * pulls[k]
            k += 1
            ax, ay, az = ax + a * x, ay + a * y, az + a * z
            out[3 * j] -= b * x
            out[3 * j + 1] -= b * y
            out[3 * j + 2] -= b * z
        out[3 * i] += ax
        out[3 * i + 1] += ay
        out[3 * i + 2] += az
    return out
