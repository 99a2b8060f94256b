"""Chaos indicators from tangent vectors (``variations=`` of `integrate`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from .core.inputs import count as as_count
from .core.inputs import is_number, reals, shown
from .core.names import nearest
from .core.projection import ProjectionOptions
from .core.results import Diagnostics
from .run.continuation import continued
from .run.fields import rows
from .run.integrate import integrate
from .run.prepare import RunArguments, prepared
from .run.results import IntegrationResult

__all__ = ["LyapunovSpectrum", "Megno", "lyapunov_spectrum", "megno"]

Array = np.ndarray
# A segment in which the vectors grow apart by more than this factor is repeated at half its length: the least exponents
# would otherwise be lost in the rounding of the largest.
LARGEST_RATIO = 1e8
LARGEST_VECTOR = 1e100  # a vector may grow by this factor, since its square must not overflow
SHORTEST = 2.0**-40
# Options of `integrate` that these functions set themselves.
OWN = {"variations", "dense_output", "t_eval", "checkpoint", "checkpoint_every", "resume", "save_every", "symplectic"}


@dataclass(frozen=True, eq=False, kw_only=True)
class _AtEnd:
    """Fields at the end of a run, which the docstrings of `LyapunovSpectrum` and `Megno` describe."""

    y: Array = field(repr=False)
    diagnostics: Diagnostics = field(repr=False)
    success: bool
    trusted: bool
    message: str


def _at_end(run: IntegrationResult) -> dict[str, Any]:
    """Return the fields of `_AtEnd`."""
    return {"y": run.y[:, -1], **{name: run[name] for name in ("diagnostics", "success", "trusted", "message")}}


@dataclass(frozen=True, eq=False, kw_only=True)
class LyapunovSpectrum(_AtEnd):
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
    diagnostics, success, trusted, message : Diagnostics, bool, bool, str
        As for `integrate`, of the whole run.
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
class Megno(_AtEnd):
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
    diagnostics, success, trusted, message : Diagnostics, bool, bool, str
        As for `integrate`, of the whole run.
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


def _checked(function: str, arguments: dict[str, Any], every: Any, segments: int) -> tuple[int, float, float, float]:
    """Return the size n of the state, both ends of the interval, and the time between two orthonormalisations.

    `arguments` are those of `integrate`. If `every` is None, this time is 1 / `segments` of the interval, rounded up to
    a whole number of steps if they are equal.
    """
    known = {*RunArguments._fields, *ProjectionOptions.names()} - {*OWN, "projection"}
    for name in sorted(arguments.keys() - known):
        hint = "; it sets this option of integrate itself; omit it." if name in OWN else nearest(name, sorted(known))
        raise TypeError(f"{function}() has no option {name!r}{hint}")
    start = prepared(RunArguments.of(**{"method": None, **arguments}))
    span = start.schedule.span
    h, length = abs(span.h), abs(span.t_bound - span.t0)
    if not 0 < length < np.inf:
        raise ValueError(
            f"{function} computes rates of growth: t_span must be a finite interval with two different ends, got "
            f"({span.t0:g}, {span.t_bound:g})."
        )
    if every is None:
        every = h * np.ceil(length / segments / h) if h else length / segments
    if not is_number(every) or not 0 < every < np.inf:
        raise ValueError(
            f"every must be a time > 0, after which tangent vectors are made orthonormal again, got {shown(every)}."
        )
    return start.tangents.state(start.y0).size, float(span.t0), float(span.t_bound), min(float(every), length)


def _segments(
    arguments: dict[str, Any], t0: float, t_bound: float, every: float, Q: Array
) -> Iterator[tuple[IntegrationResult, Array, Array]]:
    """Yield the segments of a run, each with orthonormal tangent vectors at its start, and the factors Q, R at its end.

    The first row of a segment is its start, where the vectors are `Q`; a segment takes the time `every`. It is repeated
    with half its duration if its vectors become too long, too different in length, or not finite. One that fails for
    another reason is the last.
    """
    total, sign, run = abs(t_bound - t0), np.sign(t_bound - t0), None
    done, length = 0.0, every
    while done < total:
        # Times are counted from the start, so that rounding does not add up. A short rest joins the last segment.
        aim = total if total - done < 1.01 * length else done + length
        bound = t_bound if aim == total else t0 + sign * aim
        if run is None:
            following = integrate(**{**arguments, "t_span": (t0, bound)}, variations=Q)
        else:
            following = continued(run, bound, {"variations": Q})
        found = following.variations[-1]
        finite = bool(np.isfinite(found).all())
        new, R = np.linalg.qr(found) if finite else (Q, np.full((Q.shape[1],) * 2, np.nan))
        sizes = np.abs(np.diag(R))
        exceeds = not finite or sizes.max() > LARGEST_VECTOR or sizes.max() > LARGEST_RATIO * sizes.min()
        if exceeds and length > SHORTEST * every:
            length /= 2
            continue
        run, done, Q = following, aim, new
        yield run, Q, R
        if run.status != 0:
            return
        run.update(rows(run, slice(-1, None)))  # only the last row is needed from here on


def _orthonormal(n: int, k: int) -> Array:
    """Return k random orthonormal vectors (n, k), which are the same in each call."""
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
    """Compute Lyapunov exponents from the growth of tangent vectors that are orthonormalised repeatedly [1]_.

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

    Notes
    -----
    The estimates converge as 1/t, with fluctuations, which ``running`` shows. In a backward run the exponents are those
    of the reversed flow. The tangent vectors are projected together with the state, so that the pair of zero exponents
    of a Hamiltonian system belongs exactly to the energy and to the direction of the flow.

    References
    ----------
    .. [1] G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Meccanica 15 (1980), 9-20 and 21-30.

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.chaos import lyapunov_spectrum
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> found = lyapunov_spectrum(pendulum, (0, 100), [0.0, 1.0], method=EIPDOP853, h=0.1, every=1.0)
    >>> bool(abs(found.exponents.sum()) < 1e-12)
    True
    """
    arguments = {"fun": fun, "t_span": t_span, "y0": y0, **options}
    n, t0, t_bound, length = _checked("lyapunov_spectrum", arguments, every, segments=1000)
    k = n if count is None else as_count("count", count)
    if k > n:
        raise ValueError(
            f"count is {k}, but the state has {n} components and as many exponents. Give a smaller count, or omit it "
            "to compute all."
        )
    times, growth = [], []
    for run, columns, R in _segments(arguments, t0, t_bound, length, _orthonormal(n, k)):
        times.append(run.t[-1])
        growth.append(np.log(np.abs(np.diag(R))))
        end = {"columns": columns, **_at_end(run)}
    t = np.array(times)
    running = np.cumsum(growth, axis=0) / np.abs(t - t0)[:, None]
    return LyapunovSpectrum(exponents=np.sort(running[-1])[::-1], t=t, running=running, **end)


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
    """Compute MEGNO, the mean exponential growth factor of nearby orbits [1]_, from one tangent vector.

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

    Notes
    -----
    With the tangent vector d, ``Y(t) = (2/t) int_0^t s (d' . d)/(d . d) ds = 2 (L(t) - (1/t) int_0^t L ds)``, where
    L = log(size of d) and t counts from the start, and the mean is ``(1/t) int_0^t Y ds``. The error is that of the
    splines, of order 4 in the distance between saved points. The mean tends to 2 for regular orbits (to 0 for a
    harmonic oscillator), and to half the largest exponent times t for chaotic ones. REBOUND returns this mean too [2]_;
    its ``Simulation.lyapunov()`` is the slope of the mean, half of ``lyapunov`` here.

    References
    ----------
    .. [1] P. M. Cincotta, C. Simó, Astron. Astrophys. Suppl. Ser. 147 (2000), 205-228, eqs. 23 to 25.
    .. [2] H. Rein, D. Tamayo, MNRAS 459 (2016), 2275-2285, section 4.

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.chaos import megno
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> found = megno(pendulum, (0, 2000), [0.0, 1.0], method=EIPDOP853, h=0.1)
    >>> round(found.megno, 1)
    2.0
    """
    arguments = {"fun": fun, "t_span": t_span, "y0": y0, **options}
    n, t0, t_bound, length = _checked("megno", arguments, every, segments=100)
    arguments["save_every"] = as_count("save_every", save_every)
    first = _orthonormal(n, 1)[:, 0] if deviation is None else reals("deviation", deviation)
    if first is None or first.shape != (n,) or not np.isfinite(first).all() or not first.any():
        raise ValueError(f"deviation must be a finite vector of {n} numbers, not all 0, got {shown(deviation)}.")
    first = first if deviation is None else first / np.linalg.norm(first)
    times, logs = [np.array([t0])], [np.zeros(1)]
    for run, _, _ in _segments(arguments, t0, t_bound, length, first[:, None]):
        sizes = np.linalg.norm(run.variations[1:, :, 0], axis=1)
        times.append(run.t[1:])
        logs.append(logs[-1][-1] + np.log(sizes))
    t, L = np.concatenate(times), np.concatenate(logs)
    s = np.abs(t - t0)
    Y = 2 * (L - _mean(s, L))
    mean = _mean(s, Y)
    slope = np.polyfit(s, mean, 1)[0] if t.size > 2 else np.nan
    return Megno(megno=float(mean[-1]), lyapunov=float(2 * slope), t=t, Y=Y, mean=mean, log_size=L, **_at_end(run))


def _mean(s: Array, values: Array) -> Array:
    """Return the means of a function from time 0 to the times s (m,), which start at 0, where its value is 0."""
    if s.size < 2:
        return np.zeros(s.size)
    return CubicSpline(s, values).antiderivative()(s) / np.where(s > 0, s, 1.0)
