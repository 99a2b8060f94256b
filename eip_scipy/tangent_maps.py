"""Chaos indicators from derivatives of the state (``variations=`` of `integrate`).

Each function here takes a function or a `Problem`, and options of `integrate`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from .core.inputs import count as as_count
from .core.inputs import is_number, reals, shown
from .core.names import nearest
from .core.options import ProjectionOptions
from .core.results import Diagnostics
from .run.continuation import continued
from .run.fields import rows
from .run.integrate import integrate
from .run.prepare import Prepared, Request, prepared
from .run.results import IntegrationResult

__all__ = ["LyapunovSpectrum", "Megno", "lyapunov_spectrum", "megno"]

Array = np.ndarray
# Pieces of a run between two orthonormalisations when the user gives no length.
PIECES, PIECES_OF_ONE = 1000, 100
# A piece in which the columns grow apart by more than this factor is repeated at half its length: the least exponents
# would otherwise be lost in the rounding of the largest.
LARGEST_RATIO = 1e8
# A single column may grow by this factor, since its square must not overflow.
LARGEST_COLUMN = 1e100
SHORTEST = 2.0**-40
# Options of `integrate` that these functions set themselves.
OWN = ("variations", "dense_output", "t_eval", "checkpoint", "checkpoint_every", "resume", "symplectic")


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


class _Piece(NamedTuple):
    """A part of a run between two orthonormalisations."""

    run: IntegrationResult  # ends with the piece; its first row is the start of the piece
    growth: Array  # R of the QR factorisation of the tangent vectors at the end of the piece
    columns: Array  # Q of it


def _refuse(function: str, options: dict[str, Any], also: tuple[str, ...] = ()) -> None:
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
            following = continued(run, bound, {"variations": columns})
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
        run.update(rows(run, slice(-1, None)))  # only the last row is needed from here on


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
    _refuse("lyapunov_spectrum", options, ("save_every",))
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
    _refuse("megno", options)
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
    given = reals("deviation", deviation)
    if given is None or given.shape != (n,) or not np.isfinite(given).all() or not given.any():
        raise ValueError(f"deviation must be a finite vector of {n} numbers, not all 0, got {shown(deviation)}.")
    return (given / np.linalg.norm(given))[:, None]


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
