"""Chaos indicators, periodic orbits and fits, from derivatives of the state (``variations=`` of `integrate`).

Each function here takes a function or a `Problem`, and options of `integrate`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from .core.inputs import count as as_count
from .core.inputs import is_number, reals, shown
from .core.names import nearest
from .core.options import ProjectionOptions
from .core.results import Diagnostics
from .core.states import own_values
from .run.integrate import integrate
from .run.prepare import Prepared, Request, prepared
from .run.results import IntegrationResult
from .run.tables import default_names

__all__ = [
    "LyapunovSpectrum",
    "Megno",
    "PeriodicOrbit",
    "TrajectoryFit",
    "lyapunov_spectrum",
    "megno",
    "periodic_orbit",
]

Array = np.ndarray
# Pieces of a run between two orthonormalisations when the user gives no length.
PIECES, PIECES_OF_ONE = 1000, 100
# A piece in which the columns grow apart by more than this factor is repeated at half its length: the least exponents
# would otherwise be lost in the rounding of the largest.
LARGEST_RATIO = 1e8
# A single column may grow by this factor, since its square must not overflow.
LARGEST_COLUMN = 1e100
SHORTEST = 2.0**-40
# Singular values below this share of the largest belong to directions that the equations leave open: the flow, and the
# gradients of invariants.
RANK = 1e-8
HALVINGS = 8
# How far products of two multipliers may be from 1 for the multipliers to be shown in pairs; the unit pair of a
# Hamiltonian system carries the square root of the rounding.
PAIRED = 1e-3
# A start whose motion |f| T is at most this many times the closure, or at most `STILL` times its size, does not move.
NEAR_CLOSURE, STILL = 10, 1e-12
# Shares of an interval at which a function is called to see whether it depends on t; differences above these shares of
# its size count. A period of the forcing may be given with seven digits.
BETWEEN = (0.382, 0.618)
TINY = np.finfo(float).tiny
DEPENDS, REPEATS = 1e-10, 1e-6
# Options of `integrate` that these functions set themselves.
OWN = ("variations", "dense_output", "t_eval", "checkpoint", "checkpoint_every", "resume")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Followed:
    """Fields that `LyapunovSpectrum` and `Megno` have in common; the docstrings of these classes describe them."""

    y: Array = field(repr=False)
    diagnostics: Diagnostics = field(repr=False)
    success: bool
    trusted: bool
    message: str


def _end_of(run: IntegrationResult) -> dict[str, Any]:
    """Return the fields of `_Followed` at the end of a run."""
    return {"y": run.y[:, -1], **{name: run[name] for name in ("diagnostics", "success", "trusted", "message")}}


@dataclass(frozen=True, eq=False, kw_only=True)
class LyapunovSpectrum(_Followed):
    """Result of `lyapunov_spectrum`.

    Attributes
    ----------
    exponents : ndarray, shape (k,)
        Estimates of the Lyapunov exponents at the end of the run, the largest first.
    t : ndarray, shape (m,)
        Times of the orthonormalisations.
    running : ndarray, shape (m, k)
        Estimates at these times, in the order of the columns.
    columns : ndarray, shape (n, k)
        The orthonormal tangent vectors at the end, as columns.
    y : ndarray, shape (n,)
        The state at the end.
    diagnostics : Diagnostics
        Record of the projections in the whole run.
    success, trusted, message : bool, bool, str
        As for `integrate`.
    """

    exponents: Array
    t: Array
    running: Array
    columns: Array = field(repr=False)

    def plot(self) -> Any:
        """Draw the estimates against time; needs ``pip install "eip_scipy[plot]"``."""
        from .plotting.chaos import indicator_figure

        curves = {f"column {k}": values for k, values in enumerate(self.running.T)}
        return indicator_figure(self.t, curves, ylabel="Lyapunov exponents")


@dataclass(frozen=True, eq=False, kw_only=True)
class Megno(_Followed):
    """Result of `megno`.

    Attributes
    ----------
    megno : float
        The mean MEGNO at the end: 2 for a regular orbit; for a chaotic one it grows like half the largest Lyapunov
        exponent times t.
    lyapunov : float
        Estimate of the largest Lyapunov exponent: twice the slope of the mean MEGNO against t, by least squares.
    t : ndarray, shape (m,)
        Saved times.
    Y, mean : ndarray, shape (m,)
        MEGNO at these times, and its mean from the start to these times.
    log_size : ndarray, shape (m,)
        Logarithm of the size of the tangent vector, 0 at the start.
    y : ndarray, shape (n,)
        The state at the end.
    diagnostics : Diagnostics
        Record of the projections in the whole run.
    success, trusted, message : bool, bool, str
        As for `integrate`.
    """

    megno: float
    lyapunov: float
    t: Array = field(repr=False)
    Y: Array = field(repr=False)
    mean: Array = field(repr=False)
    log_size: Array = field(repr=False)

    def plot(self) -> Any:
        """Draw MEGNO and its mean against time; needs ``pip install "eip_scipy[plot]"``."""
        from .plotting.chaos import REGULAR, indicator_figure

        return indicator_figure(self.t, {"MEGNO": self.Y, "mean": self.mean}, ylabel="MEGNO", level=REGULAR)


@dataclass(frozen=True, eq=False)
class PeriodicOrbit:
    """Result of `periodic_orbit`.

    Attributes
    ----------
    y0 : ndarray, shape (n,)
        A state on the orbit, at which the period starts.
    period : float
    monodromy : ndarray, shape (n, n)
        State-transition matrix M over one period.
    multipliers : ndarray, shape (n,)
        The Floquet multipliers, which are the eigenvalues of M, by decreasing modulus. If they form pairs with the
        product 1, each multiplier is followed by its reciprocal, and the pairs are sorted. The pair of ones of a
        Hamiltonian system belongs to a Jordan block, so that its error is about the square root of the error of M.
    closure : float
        Largest component of ``|y(period) - y0|``, relative to the largest component of ``|y0|``.
    flow_residual : float
        ``|M f - f| / (|M| |f|)`` with the derivative f at the start, in the 2-norm; nan if f is 0. It is 0 for an exact
        M if f does not depend on the time; of a forced system it says nothing.
    invariant_residual : float
        Largest value of ``|g M - g| / (|g| |M|)`` for the gradients g of the invariants at `y0`, in the 2-norm: 0 for
        an exact M; nan without invariants.
    iterations : int
        Number of corrections.
    success : bool
        Whether `closure` is at most `tol`, and the state moves: an equilibrium and a period that shrank to 0 close too,
        but are not periodic orbits.
    message : str
        A description of the closure, or of what was found instead of an orbit.
    run : IntegrationResult
        The run over one period from `y0`.
    """

    y0: Array
    period: float
    monodromy: Array = field(repr=False)
    multipliers: Array
    closure: float
    flow_residual: float
    invariant_residual: float
    iterations: int
    success: bool
    message: str
    run: IntegrationResult = field(repr=False)


class _Piece(NamedTuple):
    """A part of a run between two orthonormalisations."""

    run: IntegrationResult  # ends with the piece; its first row is the start of the piece
    growth: Array  # R of the QR factorisation of the tangent vectors at the end of the piece
    columns: Array  # Q of it


def _refuse(function: str, options: dict[str, Any], also: Sequence[str] = ()) -> None:
    """Raise TypeError if `options` contains an option in `OWN` or `also`, or one that `integrate` does not have."""
    for name in (*OWN, *also):
        if name in options:
            raise TypeError(
                f"{function}() does not take {name!r}, because it sets this option itself or does not support it; "
                "omit it."
            )
    known = {*Request._fields, *ProjectionOptions.names()} - {*OWN, *also, "projection"}
    for name in options:
        if name not in known:
            raise TypeError(f"{function}() has no option {name!r}{nearest(name, sorted(known))}")


def _start(fun: Any, t_span: Any, y0: Any, options: dict[str, Any]) -> Prepared:
    """Return the run that `integrate` prepares from its arguments, before the first step."""
    return prepared(Request.of(**{"method": None, **options, "fun": fun, "t_span": t_span, "y0": y0}))


def _length(every: Any, start: Prepared, pieces: int) -> float:
    """Return the time between two orthonormalisations in the run `start`: `every` after a check of its value.

    If `every` is None, this is 1 / `pieces` of the interval, rounded up to a whole number of steps if they are equal.
    """
    h, (t0, t_bound) = abs(start.schedule.span.h), _ends(start)
    span = abs(t_bound - t0)
    if every is None:
        return min(h * np.ceil(span / pieces / h), span) if h else span / pieces
    if not is_number(every) or not 0 < every < np.inf:
        raise ValueError(
            f"every must be a time > 0, after which tangent vectors are made orthonormal again, got {shown(every)}."
        )
    return min(float(every), span)


def _pieces(fun: Any, y0: Any, t: tuple[float, float], columns: Array, every: float, options: Any) -> Iterator[_Piece]:
    """Yield the pieces of a run from t[0] to t[1], each with orthonormal tangent vectors at its start.

    `columns` are those at t[0], and `every` is the duration of a piece. A piece is repeated with half its duration if
    its vectors become too long, too different in length, or not finite. One that fails for another reason is the last.
    """
    begin, end = t
    now, sign, run = begin, np.sign(end - begin), None
    total, made, length = abs(end - begin), 0.0, every
    while made < total:
        # Times are counted from the start, so that rounding does not add up. A short rest is added to the last piece.
        aim = total if total - made < 1.01 * length else made + length
        bound = end if aim == total else begin + sign * aim
        if run is None:
            following = integrate(fun, (now, bound), y0, variations=columns, **options)
        else:
            following = run.continue_to(bound, variations=columns)
        found = following.variations[-1]
        finite = bool(np.isfinite(found).all())
        Q, R = np.linalg.qr(found) if finite else (columns, np.full((columns.shape[1],) * 2, np.nan))
        sizes = np.abs(np.diag(R))
        apart = not finite or sizes.max() > LARGEST_COLUMN or sizes.max() > LARGEST_RATIO * sizes.min()
        if apart and length > SHORTEST * every:
            length /= 2
            continue
        run, made = following, aim
        yield _Piece(run, R, Q)
        if run.status != 0:
            return
        columns = Q
        for name in ("t", "y", "invariants"):  # only the last row is needed from here on
            run[name] = run[name][..., -1:]
        run["variations"] = run.variations[-1:]


def _orthonormal(n: int, k: int) -> Array:
    """Return k random orthonormal columns (n, k), which are the same in each call."""
    return np.linalg.qr(np.random.default_rng(1).standard_normal((n, k)))[0]


def lyapunov_spectrum(
    fun: Any,
    t_span: Any = None,
    y0: Any = None,
    *,
    count: int | None = None,
    every: float | None = None,
    **options: Any,
) -> LyapunovSpectrum:
    """Compute Lyapunov exponents from the growth of tangent vectors that are orthonormalised repeatedly.

    Parameters
    ----------
    fun, t_span, y0
        As for `integrate`.
    count : int, optional
        Number of exponents to compute, which are the largest ones. Default: all n.
    every : float, optional
        Time between two orthonormalisations. With a fixed step, choose a multiple of the step. Default: a thousandth of
        the interval. The time is halved if the lengths of the tangent vectors grow apart by a factor above 1e8.
    **options
        Options of `integrate`: method, steps, params, invariants, jvp and so on.

    Returns
    -------
    LyapunovSpectrum

    Raises
    ------
    ValueError, TypeError
        If a value is wrong or an option is one that the function sets itself; also the errors of `integrate`.

    Notes
    -----
    The estimates converge as 1/t, with fluctuations, which ``running`` shows. In a backward run the exponents are those
    of the reversed flow. The tangent vectors are projected together with the state, so that the pair of zero exponents
    of a Hamiltonian system belongs exactly to the energy and to the direction of the flow.

    References
    ----------
    G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Meccanica 15 (1980), 9-20 and 21-30.

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.tangent_maps import lyapunov_spectrum
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> found = lyapunov_spectrum(pendulum, (0, 100), [0.0, 1.0], method=EIPDOP853, h=0.1, every=1.0)
    >>> bool(abs(found.exponents.sum()) < 1e-12)
    True
    """
    _refuse("lyapunov_spectrum", options, ("save_every", "symplectic"))
    start = _start(fun, t_span, y0, options)
    n, (t0, t_bound) = start.n, _ends(start)
    k = n if count is None else as_count("count", count)
    if k > n:
        raise ValueError(
            f"count is {k}, but the state has {n} components and as many exponents. Give a smaller count, or omit it "
            "to compute all."
        )
    times, sums, total = [], [], np.zeros(k)
    for piece in _pieces(fun, y0, (t0, t_bound), _orthonormal(n, k), _length(every, start, PIECES), options):
        total = total + np.log(np.abs(np.diag(piece.growth)))
        times.append(piece.run.t[-1])
        sums.append(total)
    t = np.array(times)
    running = np.array(sums) / np.abs(t - t0)[:, None]
    return LyapunovSpectrum(
        exponents=np.sort(running[-1])[::-1], t=t, running=running, columns=piece.columns, **_end_of(piece.run)
    )


def _ends(start: Prepared) -> tuple[float, float]:
    """Return the start and the end of the interval of a run; raise ValueError if it is infinite or has no length."""
    span = start.schedule.span
    if not np.isfinite(span.t_bound):
        raise ValueError("t_span must be a finite interval: lyapunov_spectrum and megno need a run with an end.")
    if span.t_bound == span.t0:
        raise ValueError(
            "t_span must be an interval with two different ends, because lyapunov_spectrum and megno compute rates of "
            f"growth, but both ends are {span.t0:g}. Pass another end."
        )
    return float(span.t0), float(span.t_bound)


def megno(
    fun: Any,
    t_span: Any = None,
    y0: Any = None,
    *,
    deviation: Any = None,
    every: float | None = None,
    save_every: int = 1,
    **options: Any,
) -> Megno:
    """Compute MEGNO, the mean exponential growth factor of nearby orbits, from one tangent vector.

    Parameters
    ----------
    fun, t_span, y0
        As for `integrate`.
    deviation : array_like, shape (n,), optional
        The tangent vector at the start; its length does not matter. Default: a random direction, the same each time.
    every : float, optional
        Time after which the vector is scaled to length 1 again. Default: a hundredth of the interval. The time is
        halved if the vector grows by more than 1e100.
    save_every : int, optional
        Number of steps from one saved point to the next. The integrals are those of cubic splines through these points.
    **options
        Options of `integrate`: method, steps, params, invariants, jvp and so on.

    Returns
    -------
    Megno

    Raises
    ------
    ValueError, TypeError
        If a value is wrong or an option is one that the function sets itself; also the errors of `integrate`.

    Notes
    -----
    With the tangent vector d, ``Y(t) = (2/t) int_0^t s (d' . d)/(d . d) ds``, and the mean is ``(1/t) int_0^t Y ds``,
    with t from the start of the run. Integration by parts gives ``Y = 2 (L(t) - (1/t) int_0^t L ds)`` with
    L = log(size of d), so that no derivative is needed; the error is that of the splines, of order 4 in the distance
    between saved points. The mean tends to 2 for regular orbits (to 0 for a harmonic oscillator), and to half the
    largest exponent times t for chaotic ones. REBOUND returns the mean too, computed from all positions and velocities
    without weighting by the masses; its ``Simulation.lyapunov()`` is the slope of the mean, half of ``lyapunov`` here.

    References
    ----------
    P. M. Cincotta, C. Simó, Astron. Astrophys. Suppl. Ser. 147 (2000), 205-228, eqs. 23 to 25.
    H. Rein, D. Tamayo, MNRAS 459 (2016), 2275-2285, section 4, for REBOUND.

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.tangent_maps import megno
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> found = megno(pendulum, (0, 2000), [0.0, 1.0], method=EIPDOP853, h=0.1)
    >>> round(found.megno, 1)
    2.0
    """
    _refuse("megno", options, ("symplectic",))
    save_every = as_count("save_every", save_every)
    start = _start(fun, t_span, y0, options)
    t0, t_bound = _ends(start)
    first = _unit(deviation, start.n)
    length = _length(every, start, PIECES_OF_ONE)
    times, logs, offset = [np.array([t0])], [np.zeros(1)], 0.0
    options = {**options, "save_every": save_every}
    for piece in _pieces(fun, y0, (t0, t_bound), first, length, options):
        sizes = np.linalg.norm(piece.run.variations[1:, :, 0], axis=1)
        times.append(piece.run.t[1:])
        logs.append(offset + np.log(sizes))
        offset = logs[-1][-1] if sizes.size else offset
    t, L = np.concatenate(times), np.concatenate(logs)
    Y, mean = _indicators(np.abs(t - t0), L)
    slope = np.polyfit(np.abs(t - t0), mean, 1)[0] if t.size > 2 else np.nan
    return Megno(
        megno=float(mean[-1]), lyapunov=float(2 * slope), t=t, Y=Y, mean=mean, log_size=L, **_end_of(piece.run)
    )


def _unit(deviation: Any, n: int) -> Array:
    """Return `deviation`, by default a random direction, as a column (n, 1) of length 1, after a check of its value."""
    if deviation is None:
        return _orthonormal(n, 1)
    given = _numbers("deviation", deviation)
    if given.shape != (n,) or not np.isfinite(given).all() or not given.any():
        raise ValueError(f"deviation must be a finite vector of {n} numbers, not all 0, got {shown(deviation)}.")
    return (given / np.linalg.norm(given))[:, None]


def _numbers(name: str, given: Any) -> Array:
    """Return a value as an array of floats, or an empty array if it does not consist of real numbers."""
    found = reals(name, given)
    return np.zeros(0) if found is None else found


def _indicators(s: Array, L: Array) -> tuple[Array, Array]:
    """Return MEGNO and its mean at the times s (m,), which start at 0, from log(size of the tangent vector), L (m,)."""
    if s.size < 2:
        return np.zeros(s.size), np.zeros(s.size)
    # At the start the integrals are 0, and so are the indicators.
    after = np.where(s > 0, s, 1.0)
    Y = 2 * (L - CubicSpline(s, L).antiderivative()(s) / after)
    Y[0] = 0.0
    mean = CubicSpline(s, Y).antiderivative()(s) / after
    return Y, mean


def periodic_orbit(
    fun: Any,
    y0: Any,
    period: float,
    *,
    fixed: Sequence[str | int] = (),
    symmetry: Any = None,
    tol: float = 1e-10,
    max_iterations: int = 30,
    **options: Any,
) -> PeriodicOrbit:
    """Refine a periodic orbit by differential correction, and return its Floquet multipliers.

    Parameters
    ----------
    fun : callable or Problem
        As for `integrate`. If the equations depend on t, `period` must be the period of the forcing, and ``"period"``
        must be in `fixed`.
    y0 : array_like, shape (n,)
        A state near the orbit.
    period : float
        An estimate of the period of the orbit, > 0.
    fixed : sequence of str or int, optional
        Components of the initial state, by name or index, that the correction does not change, and ``"period"`` if the
        period must not change. They select one orbit of a family. Without them the result is the orbit to which the
        smallest corrections lead.
    symmetry : array_like of ±1, shape (n,), optional
        Sign of each component under a time-reversal symmetry of the equations; (1, -1, 1, -1, 1, -1) for the state
        (x, y, z, vx, vy, vz) of the restricted three-body problem. The components of sign -1 are then 0 at the start,
        and the orbit is corrected so that they are 0 again after half the period. The runs of the corrections are
        therefore only half as long, and the errors of an unstable orbit grow less in them.
    tol : float, optional
        Largest `closure` of a result that counts as a success. Corrections continue below this value as long as they
        reduce the closure.
    max_iterations : int, optional
        Largest number of corrections.
    **options
        Options of `integrate`: method, steps, params, invariants, jvp and so on. A fixed step is shortened so that the
        period is a whole number of steps.

    Returns
    -------
    PeriodicOrbit

    Raises
    ------
    ValueError, TypeError
        If a value is wrong or an option is one that the function sets itself, or if the equations depend on t and
        `period` is not fixed or is not their period; also the errors of `integrate`.
    RuntimeError
        If a run fails.

    Notes
    -----
    Newton's method solves y(T; y0) - y0 = 0 for y0 and T with the state-transition matrix. Each correction is the one
    of smallest norm, because the equations do not determine it along the flow and along a family of orbits. A
    correction that does not reduce the residual is halved.

    The computed states are closed, which with a fixed step are those of a discrete map. `closure` therefore does not
    contain the errors of the steps, and `y0` and `period` differ from those of the orbit by as much as the method errs.
    The result of half the step shows by how much.

    References
    ----------
    K. C. Howell, Celestial Mechanics 32 (1984), 53-71, for the symmetric case.

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.tangent_maps import periodic_orbit
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> orbit = periodic_orbit(pendulum, [1.0, 0.0], 7.0, fixed=["p", "period"], method=EIPDOP853, h=0.05)
    >>> orbit.success, round(float(orbit.y0[0]), 6)
    (True, 1.284567)
    """
    _refuse("periodic_orbit", options, ("t_span", "events", "callback", "save_every"))
    max_iterations = as_count("max_iterations", max_iterations)
    for name, value in (("period", period), ("tol", tol)):
        if not is_number(value) or not 0 < value < np.inf:
            raise ValueError(f"{name} must be a number > 0, got {shown(value)}.")
    start = _start(fun, (0.0, float(period)), y0, options)
    y, T, n = start.run.y0.copy(), float(period), start.n
    names = start.component_names or default_names(n)
    free = np.ones(n + 1, bool)
    for item in [fixed] if isinstance(fixed, str | int) else fixed:
        place = n if item == "period" else _component(item, names)
        if place is None:
            raise ValueError(
                f'fixed: {shown(item)} is neither "period" nor the name or index of one of the components '
                f"{', '.join(names)}."
            )
        free[place] = False
    odd = _odd(symmetry, y)
    free[:n] &= ~odd
    share = 0.5 if odd.any() else 1.0
    shoot = _Shooting(fun, {**options, "dense_output": False}, odd, share)
    reached = shoot(y, T)
    for state in (y, reached.run.y[:, -1].copy()):
        _require_period(start, state, T, bool(free[n]))
    iterations = 0
    while iterations < max_iterations and reached.size > 0:
        move, better = reached.correction(free), None
        # An orbit that closes well enough is only improved by full steps.
        for k in range(1 if reached.size <= tol else HALVINGS):
            step = move * 0.5**k
            trial = shoot(y + step[:n], float(T + step[n])) if T + step[n] > 0 else None
            if trial is not None and trial.size < reached.size:
                better = trial
                break
        if better is None:
            break
        iterations += 1
        y, T, reached = better.y0, better.period, better
    full = reached if share == 1.0 else _Shooting(fun, options, np.zeros(n, bool), 1.0)(y, T)
    return full.result(iterations, tol, float(period))


def _component(item: Any, names: Sequence[str]) -> int | None:
    """Return the index of a component from its name or index; None for anything else."""
    if isinstance(item, str):
        return list(names).index(item) if item in names else None
    is_place = isinstance(item, int | np.integer) and not isinstance(item, bool) and 0 <= item < len(names)
    return int(item) if is_place else None


def _require_period(start: Prepared, y: Array, T: float, free: bool) -> None:
    """Raise ValueError if the equations depend on t, unless the period is not `free` and they have the period T."""

    def change(t: float, later: float) -> float:
        before, after = start.system.derivative(t, y), start.system.derivative(later, y)
        return float(np.abs(after - before).max() / max(np.abs(before).max(), np.abs(after).max(), TINY))

    name = start.system.name
    if free:
        later = max((share * T for share in BETWEEN), key=lambda t: change(0.0, t))
        if change(0.0, later) > DEPENDS:
            raise ValueError(
                f"fixed: the equations depend on t, because {name} differs between t = 0 and t = {later:.6g} for the "
                'same state. Pass the period of the forcing as period, and "period" in fixed.'
            )
    # A force that jumps at t = 0 is compared once more at another time.
    elif change(0.0, T) > REPEATS and change(BETWEEN[0] * T, BETWEEN[0] * T + T) > REPEATS:
        raise ValueError(
            f"period = {T:.10g} is not a period of the equations, because {name} differs between t = 0 and t = {T:.6g} "
            "for the same state. Pass the period of the forcing."
        )


def _odd(symmetry: Any, y: Array) -> Array:
    """Return a mask of the components whose sign in `symmetry` is -1, and set these components of y to 0."""
    if symmetry is None:
        return np.zeros(y.size, bool)
    signs = np.asarray(symmetry)
    if signs.shape != y.shape or not np.isin(signs, (-1, 1)).all():
        raise ValueError(f"symmetry must be {y.size} signs 1 or -1, got {shown(symmetry)}.")
    odd = signs == -1
    if not odd.any():
        raise ValueError("symmetry has no sign -1; give -1 for each component that is 0 at the start.")
    if np.abs(y[odd]).max() > 1e-3 * np.abs(y).max():
        raise ValueError("symmetry: y0 is not symmetric; the components of y0 whose sign is -1 must be 0.")
    y[odd] = 0.0
    return odd


@dataclass(frozen=True)
class _Shooting:
    """Integration from y over `share` * T with the transition matrix; see `_odd` for the mask `odd`."""

    fun: Any
    options: dict[str, Any]
    odd: Array
    share: float

    def __call__(self, y: Array, T: float) -> _Reached:
        options = dict(self.options)
        h: Any = options.get("h")
        end = self.share * T
        if is_number(h) and h > 0:
            options["h"] = end / np.ceil(end / h * (1 - 1e-12))
        run = integrate(self.fun, (0.0, end), y, variations="state", **options)
        if not run.success:
            raise RuntimeError(f"periodic_orbit: the run from t = 0 to {end:.6g} failed: {run.message}")
        return _Reached(self, y, T, run)


@dataclass(frozen=True)
class _Reached:
    """Result of a run from `y0` over one `period`, or over half of it, with its residual and the next correction."""

    shooting: _Shooting
    y0: Array
    period: float
    run: IntegrationResult

    @property
    def residual(self) -> Array:
        """Return the residual: the difference between end and start, or the components that must vanish by symmetry."""
        y, odd = self.run.y[:, -1], self.shooting.odd
        return y[odd] if odd.any() else y - self.y0

    @property
    def size(self) -> float:
        """Return the largest component of the residual relative to that of the start: inf if only the start is 0."""
        with np.errstate(divide="ignore"):
            largest = np.abs(self.residual).max()
            return float(largest / np.abs(self.y0).max()) if largest else 0.0

    def begun_at(self, y: Array) -> Prepared:
        """Return the run that starts at a state, before its first step; it holds the derivative at that state."""
        return _start(self.shooting.fun, (0.0, self.period), y, {**self.shooting.options, "project_initial": False})

    def correction(self, free: Array) -> Array:
        """Return the Newton step (n + 1,) of smallest norm in (y0, T), which is 0 where the mask `free` is False."""
        odd, M = self.shooting.odd, self.run.stm[-1]
        f = self.begun_at(self.run.y[:, -1]).run.start.f
        rows = np.column_stack([M, self.shooting.share * f])
        if odd.any():
            rows = rows[odd]
        else:
            rows[:, :-1] -= np.eye(len(M))
        move = np.zeros(free.size)
        move[free] = np.linalg.lstsq(rows[:, free], -self.residual, rcond=RANK)[0]
        return move

    def instead(self, start: Prepared, guess: float) -> str:
        """Return a text on what was found instead of an orbit, with the first `guess` of the period; "" if y0 moves."""
        still = max(NEAR_CLOSURE * self.size, STILL) * np.abs(self.y0).max()
        # On an orbit of a system with forcing the derivative may be 0 at one time.
        times = (0.0, *(share * self.period for share in BETWEEN))
        speed = max(np.abs(start.system.derivative(t, self.y0)).max() for t in times)
        if speed * self.period > still:
            return ""
        if speed * guess > still:
            found = f"the period shrank from {guess:.6g} to {self.period:.1e}, in which the state hardly moves"
        else:
            found = "the corrections lead to an equilibrium, at which the state does not move"
        return (
            f"no periodic orbit was found: {found}; pass a y0 and a period that are closer to an orbit, or a component "
            'or "period" in fixed'
        )

    def result(self, iterations: int, tol: float, guess: float) -> PeriodicOrbit:
        """Return the result, with the multipliers and residuals of the state-transition matrix."""
        M = self.run.stm[-1]
        begun = self.begun_at(self.y0)
        start = begun.run
        f, G = start.start.f, start.invariants.gradients(0.0, self.y0, start.start.f)
        size = np.linalg.norm(M, 2)
        invariants = [np.linalg.norm(g @ M - g) / (np.linalg.norm(g) * size) for g in G if g.any()]
        closed = self.size <= tol
        found = "the orbit closes" if closed else "the orbit does not close within tol"
        instead = self.instead(begun, guess) if closed else ""
        return PeriodicOrbit(
            y0=self.y0,
            period=self.period,
            monodromy=M,
            multipliers=_in_pairs(np.linalg.eigvals(M)),
            closure=self.size,
            flow_residual=float(np.linalg.norm(M @ f - f) / (size * np.linalg.norm(f))) if f.any() else np.nan,
            invariant_residual=float(max(invariants, default=np.nan)),
            iterations=iterations,
            success=closed and not instead,
            message=instead
            or f"{found}: |y(period) - y0| is {self.size:.1e} of the size of y0 ({iterations} iterations)",
            run=self.run,
        )


def _in_pairs(values: Array) -> Array:
    """Return the multipliers by decreasing modulus, each followed by its reciprocal if all have one."""
    left = sorted(values.astype(complex), key=lambda value: (-abs(value), -value.imag))
    ordered, rest = list(left), list(left)
    pairs = []
    while len(rest) > 1:
        one = rest.pop(0)
        distances = [abs(one * other - 1) for other in rest]
        nearest = int(np.argmin(distances))
        if distances[nearest] > PAIRED:
            return np.array(ordered)
        pairs += [one, rest.pop(nearest)]
    return np.array(ordered if rest else pairs)


class TrajectoryFit:
    """Residuals of a trajectory against data, and their Jacobian, for `scipy.optimize.least_squares`.

    The residuals and the Jacobian come from the same run for each x, the vector of the fitted quantities.

    Parameters
    ----------
    fun : callable or Problem
        As for `integrate`.
    t : array_like, shape (m,)
        Times of the data, all on one side of `t0`, in the order in which a run from `t0` reaches them.
    data : array_like, shape (d, m)
        Data at these times; nan if a value was not measured.
    y0 : array_like, shape (n,), optional
        First guess of the state at `t0`, or its known value. Default: the initial state of the problem.
    free : sequence of str or int, optional
        The quantities to fit: ``"state"`` for the initial state, and names or indices of parameters, as in
        ``variations=`` of `integrate`.
    t0 : float, optional
        Time of `y0`. Default: the first time in `t`.
    observe : sequence of str or int, or (callable, callable), optional
        Components that are measured, by name or index; or a function ``g(t, y) -> (d,)`` and its Jacobian
        ``dg(t, y) -> (d, n)``. Default: all components.
    sigma : array_like, optional
        Standard deviations of the data, of a shape that NumPy broadcasts to that of `data`. Default: 1.
    **options
        Options of `integrate`: method, steps, params, invariants, jvp and so on.

    Attributes
    ----------
    x0 : ndarray
        The first guess: the state, if it is free, and the free parameters in the order of `free`.
    evaluations : int
        Number of integrations up to now.

    Raises
    ------
    ValueError, TypeError
        If a value is wrong or an option is one that the class sets itself; also the errors of `integrate`.

    Notes
    -----
    Between two steps the derivatives come from the method's interpolant. If the data need a higher accuracy, choose
    steps that end at the times of the data.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.optimize import least_squares
    >>> from eip_scipy import EIPDOP853, hamiltonian, integrate
    >>> from eip_scipy.tangent_maps import TrajectoryFit
    >>> pendulum = hamiltonian("p**2/2 - k*cos(q)", params={"k": 1.0})
    >>> t = np.linspace(0, 5, 20)
    >>> options = {"method": EIPDOP853, "rtol": 1e-10, "atol": 1e-10}
    >>> data = integrate(pendulum, (0, 5), [1.0, 0.2], params={"k": 1.3}, t_eval=t, **options).y
    >>> fit = TrajectoryFit(pendulum, t, data, y0=[0.9, 0.0], free=["state", "k"], **options)
    >>> found = least_squares(fit.residuals, fit.x0, jac=fit.jacobian)
    >>> np.allclose(found.x, [1.0, 0.2, 1.3], atol=1e-7)
    True
    """

    def __init__(
        self,
        fun: Any,
        t: Any,
        data: Any,
        *,
        y0: Any = None,
        free: Sequence[str | int] = ("state",),
        t0: float | None = None,
        observe: Any = None,
        sigma: Any = 1.0,
        **options: Any,
    ) -> None:
        _refuse("TrajectoryFit", options, ("t_span", "save_every", "args", "symplectic"))
        self._fun, self._options = fun, options
        self._free = [free] if isinstance(free, str | int) else list(free)
        self._span, self._t, self._from = _times(t, t0)
        asked = {**options, "variations": self._free}
        start = _start(fun, self._span, y0, asked)
        assert start.variations is not None
        columns = start.variations.columns
        self._y0, self._params = start.run.y0[: start.n].copy(), start.system.parameters.copy()
        self._places, self._has_state = list(columns.parameters), columns.is_transition
        self._g, self._dg = _observed(observe, start.component_names or default_names(start.n))
        d = np.asarray(self._g(self._span[0], self._y0)).size
        self._data = _data(data, (d, self._from.size))
        self._kept = np.isfinite(self._data)
        self._sigma = _sigma(sigma, self._data.shape)
        self.x0 = np.concatenate([self._y0 if self._has_state else [], self._params[self._places]])
        self.evaluations = 0
        self._last: tuple[Array, IntegrationResult] | None = None

    def run(self, x: Any) -> IntegrationResult:
        """Return the run with the fitted quantities x, and its derivatives, at the distinct times of the data.

        Raises
        ------
        ValueError
            If x has a wrong shape.
        RuntimeError
            If the run does not reach the time of the last data.
        """
        x = np.array(x, float)
        if x.shape != self.x0.shape:
            raise ValueError(f"x must have the shape {self.x0.shape} of x0, got {x.shape}.")
        if self._last is not None and np.array_equal(self._last[0], x):
            return self._last[1]
        n = self._y0.size if self._has_state else 0
        y, options = x[:n] if self._has_state else self._y0, dict(self._options)
        if self._params.size:
            params = self._params.copy()
            params[self._places] = x[n:]
            options["params"] = params
        run = integrate(self._fun, self._span, y, t_eval=self._t, variations=self._free, **options)
        self.evaluations += 1
        if run.t.size < self._t.size:
            raise RuntimeError(f"TrajectoryFit: the run does not reach the time of the last data: {run.message}")
        self._last = x, run
        return run

    def residuals(self, x: Any) -> Array:
        """Return (model - data) / sigma of the measured values, sorted by measured quantity and then by time."""
        run = self.run(x)
        model = np.array([self._g(t, y) for t, y in zip(run.t, run.y.T, strict=True)]).T[:, self._from]
        found: Array = ((model - self._data) / self._sigma)[self._kept]
        return found

    def jacobian(self, x: Any) -> Array:
        """Return the derivatives of the residuals with respect to x, (residuals, size of x)."""
        run = self.run(x)
        slopes = [self._dg(t, y) @ M for t, y, M in zip(run.t, run.y.T, run.variations, strict=True)]
        by_x = np.array(slopes).transpose(1, 0, 2)[:, self._from] / self._sigma[..., None]
        found: Array = by_x[self._kept]
        return found


def _times(t: Any, t0: Any) -> tuple[tuple[float, float], Array, Array]:
    """Return the interval, the distinct times of the data, and for each column the index of its time among these."""
    times = _numbers("t", t)
    if times.ndim != 1 or times.size == 0 or not np.isfinite(times).all():
        raise ValueError(f"t must be a 1-D array of finite times, one for each column of data, got {shown(t)}.")
    if t0 is not None and not is_number(t0):
        raise ValueError(f"t0 must be the time of y0, got {shown(t0)}.")
    begin, end = float(times[0] if t0 is None else t0), float(times[-1])
    sign = np.sign(end - begin)
    steps = sign * np.diff(times, prepend=begin)
    if sign == 0 or (steps < 0).any():
        raise ValueError(
            f"t must be in order, with all times on one side of t0 = {begin:.10g} and at least one time other than t0."
        )
    distinct, places = np.unique(sign * times, return_inverse=True)
    return (begin, end), sign * distinct, places


def _observed(observe: Any, names: Sequence[str]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the measured quantities as a function g(t, y), and the Jacobian of g."""
    if isinstance(observe, tuple | list) and len(observe) == 2 and all(callable(item) for item in observe):
        return own_values(observe[0]), observe[1]
    if callable(observe):
        raise TypeError("observe: give a function together with its Jacobian, observe=(g, dg).")
    items = range(len(names)) if observe is None else [observe] if isinstance(observe, str | int) else observe
    rows = []
    for item in items:
        place = _component(item, names)
        if place is None:
            raise ValueError(
                f"observe: {shown(item)} is not the name or index of one of the components {', '.join(names)}."
            )
        rows.append(place)
    chosen = np.eye(len(names))[rows]
    return lambda t, y: y[rows], lambda t, y: chosen


def _data(data: Any, shape: tuple[int, int]) -> Array:
    found = _numbers("data", data)
    if found.ndim == 1 and shape[0] == 1:
        found = found[None]
    if found.shape != shape or np.isinf(found).any() or np.isnan(found).all():
        raise ValueError(
            f"data must be an array of shape {shape}, one row for each measured quantity and one column for each time, "
            "of finite numbers, with nan for values that were not measured and at least one value that was, got "
            f"{shown(data)}."
        )
    return found


def _sigma(sigma: Any, shape: tuple[int, ...]) -> Array:
    try:
        found = np.broadcast_to(np.array(sigma, float), shape)
    except (TypeError, ValueError):
        found = np.zeros(shape)
    if not ((found > 0) & np.isfinite(found)).all():
        raise ValueError(
            f"sigma must be standard deviations > 0 that broadcast to the shape {shape} of data, got {shown(sigma)}."
        )
    return found
