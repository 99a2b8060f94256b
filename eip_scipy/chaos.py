"""Chaos indicators from the growth of tangent vectors: MEGNO and Lyapunov exponents, of one orbit or of a grid of them.

The orbits are members of an `ensemble` with ``variations=``, which runs in segments. After each of them the vectors are
made orthonormal again, and the logarithms of their lengths are added up.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import OptimizeResult
from tqdm import tqdm

from .core.callers import users_level
from .core.events import as_events
from .core.inputs import count as as_count
from .core.inputs import is_number, reals, shown, states
from .core.step_control import interval
from .engine.trust import ProjectionWarning
from .ensembles.ensemble import ensemble

__all__ = ["ChaosResult", "lyapunov_exponent", "lyapunov_spectrum", "megno"]

Array = np.ndarray
# Vectors that grow apart by more than this factor in a segment are followed through its halves instead: the least
# exponents would otherwise be lost in the rounding of the largest.
LARGEST_RATIO = 1e8
LARGEST_VECTOR = 1e100  # a vector may grow by this factor, since its square must not overflow
MOST_HALVINGS = 40
SEGMENTS, OF_GRID = 100, 10  # of the interval of one orbit, and of those of a grid
OK, FAILED = "ok", "failed"
# Options of `ensemble` that these functions set themselves.
OWN = {"variations", "t_eval", "save_every", "symplectic", "reduce", "callback", "checkpoint", "resume"}


class ChaosResult(OptimizeResult):
    """Result of `megno`, `lyapunov_exponent` and `lyapunov_spectrum`; ``...`` is the shape of the grid.

    Attributes
    ----------
    lyapunov : ndarray, shape (...,)
        Estimate of the largest Lyapunov exponent. For MEGNO: twice the slope of its mean against t, by least squares.
    exponents : ndarray, shape (..., k)
        Of `lyapunov_spectrum`: estimates of all exponents, the largest first.
    megno : ndarray, shape (...,)
        Of `megno`: the mean MEGNO at the end of each orbit, 2 for a regular orbit; for a chaotic one it grows like half
        the largest exponent times t. These three are nan for orbits that failed.
    status : ndarray of str, shape (...,)
        "ok"; the name of the event function that ended an orbit, such as "escaped" or "collided"; or "failed".
    t : ndarray, shape (m, ...)
        Times: the start, and the ends of the segments; nan after the end of an orbit.
    running : ndarray, shape (m, ..., k)
        Estimates of the exponents at these times, in the order of the columns, nan at the start.
    Y, mean : ndarray, shape (m, ...)
        Of `megno`: MEGNO at these times, and its mean from the start to these times.
    y, columns : ndarray, shape (..., n) and (..., n, k)
        States at the ends of the orbits, and the orthonormal tangent vectors there, as columns.
    trusted, message : ndarray of bool and of str, shape (...,)
        Whether an orbit is reliable, as for `integrate`, and the reason for its end.
    success : bool
        True if no orbit failed.

    See Also
    --------
    lyapunov_exponent, lyapunov_spectrum, megno
    """

    def plot(self) -> Any:
        """Draw the indicator of one orbit against time; needs ``pip install "eip_scipy[plot]"``."""
        from .plotting import draw_lines, shown_figure

        if self.t.ndim > 1:
            raise ValueError("plot() draws one orbit; draw a grid by eip_scipy.plotting.map(x, y, result).")
        if "megno" in self:
            curves = {"MEGNO": self.Y, "mean": self.mean}
        else:
            curves = {f"column {k}": values for k, values in enumerate(self.running.T)}
        figure = shown_figure(5.6, 4.0)
        axis = figure.add_subplot(xlabel="t", ylabel="MEGNO" if "megno" in self else "Lyapunov exponents")
        draw_lines(axis, self.t, curves)
        return figure


class _Orbits:
    """Orbits with tangent vectors that grow, from the start of an interval `span` to its end.

    Row j of `y` (m, n), `vectors` (m, n, k), `t`, `log_sizes` (m, k), `status`, `trusted` and `message` belongs to
    orbit j, as far as it has come. `integrals` (m, 3) are the time up to which its first vector has been sampled, if
    there are `samples`, and the integrals of the logarithm of its size and of MEGNO up to there. `halvings` says how
    often it halves segments.
    """

    def __init__(self, fun: Any, t: Any, y0s: Any, options: dict[str, Any]) -> None:
        if wrong := sorted(OWN & options.keys()):
            raise TypeError(f"chaos indicators set the option {wrong[0]!r} of ensemble themselves; omit it.")
        span, start, events = (getattr(fun, name, None) for name in ("t_span", "y0", "events"))  # of a Problem
        self.span = interval((0.0 if span is None else span[0], t) if is_number(t) else span if t is None else t)
        if not 0 < abs(self.span[1] - self.span[0]) < np.inf:
            raise ValueError(f"t must be an end time or a finite interval with two different ends, got {shown(t)}.")
        self.fun, self.options, self.params = fun, options, options.pop("params", None)
        y0s = states("y0s", start if y0s is None else y0s)
        if not y0s.size or not y0s.ndim:
            raise ValueError(f"y0s must have the shape (..., n) and hold one state at least, got {y0s.shape}.")
        self.grid = y0s.shape[:-1] or np.shape(self.params)[:-1]
        self.each = self.grid and np.ndim(self.params) > 1
        if self.each and np.shape(self.params)[:-1] != self.grid:
            raise ValueError(f"params must have the shape (p,) or {(*self.grid, 'p')}, got {np.shape(self.params)}.")
        self.params = np.reshape(self.params, (-1, np.shape(self.params)[-1])) if self.each else self.params
        self.y = np.broadcast_to(y0s, (*self.grid, y0s.shape[-1])).reshape(-1, y0s.shape[-1]).copy()
        m = len(self.y)
        self.t, self.integrals, self.trusted = np.full(m, self.span[0]), np.zeros((m, 3)), np.ones(m, bool)
        self.status, self.message, self.halvings = np.full(m, OK, object), np.full(m, "", object), np.zeros(m, int)
        given = options.get("events")
        events = as_events(events if given is None else given)
        self.names = [getattr(event, "__name__", f"event {k}") for k, event in enumerate(events)]

    def follow(self, vectors: Array, every: Any, progress: bool, samples: int = 0) -> ChaosResult:
        """Follow the orbits with vectors (n, k) or (..., n, k) in segments of the length `every`."""
        shape, length = vectors.shape[-2:], abs(self.span[1] - self.span[0])
        self.vectors = np.broadcast_to(vectors, (*self.grid, *shape)).reshape(-1, *shape).copy()
        self.log_sizes, self.samples = np.zeros((len(self.y), shape[1])), samples
        every = length / (OF_GRID if self.grid else SEGMENTS) if every is None else every
        if not is_number(every) or not 0 < every < np.inf:
            raise ValueError(
                f"every must be a time > 0, after which tangent vectors are made orthonormal again, got {shown(every)}."
            )
        # Times are counted from the start, so that rounding does not add up. A short rest joins the last segment.
        starts = self.span[0] + np.sign(self.span[1] - self.span[0]) * np.arange(0, length - 0.01 * every, every)
        rows = [self._row]
        try:
            for a, b in tqdm(list(zip(starts, [*starts[1:], self.span[1]], strict=True)), disable=not progress):
                if (running := self.status == OK).any():
                    self._halved(np.flatnonzero(running), float(a), float(b), 0)
                    rows.append(np.where(running[:, None], self._row, np.nan))
        except BaseException as error:
            error.partial = self._result(rows)  # type: ignore[attr-defined]
            raise
        doubtful = np.flatnonzero(~self.trusted & (self.status != FAILED))
        if doubtful.size:
            what = f"{doubtful.size} of {self.t.size} orbits are not to be trusted (.trusted, .message), the first: "
            warnings.warn(f"{what}{self.message[doubtful[0]]}", ProjectionWarning, stacklevel=users_level())
        return self._result(rows)

    def _halved(self, k: Array, a: float, b: float, depth: int) -> None:
        """Follow the orbits `k` from the time a to b, or through both halves those that have to halve this segment."""
        if (now := k[self.halvings[k] <= depth]).size:
            self._advance(now, a, b, depth)
        if (rest := k[self.halvings[k] > depth]).size:
            self._halved(rest, a, (a + b) / 2, depth + 1)
            self._halved(rest[self.status[rest] == OK], (a + b) / 2, b, depth + 1)

    def _advance(self, k: Array, a: float, b: float, depth: int) -> None:
        """Integrate the orbits `k` from a to b, and take over those whose vectors do not grow too much."""
        sampled = {"t_eval": np.linspace(a, b, self.samples + 1), "reduce": partial(_sampled, self.span[0])}
        options = self.options | (sampled if self.samples else {})
        params = self.params[k] if self.each else self.params
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ProjectionWarning)  # given once, at the end
            try:
                run = ensemble(self.fun, (a, b), self.y[k], params=params, variations=self.vectors[k], **options)
            except (ValueError, ArithmeticError) as error:
                if a == self.span[0]:
                    raise
                # All of these orbits have come to states from which no run can start.
                self.status[k], self.message[k], self.trusted[k] = FAILED, f"{error}", False
                self.log_sizes[k] = self.integrals[k] = np.nan
                return
        finite, failed = np.isfinite(run.variations).all(axis=(1, 2)), run.status < 0
        Q, R = np.linalg.qr(np.where(finite[:, None, None], run.variations, self.vectors[k]))
        sizes = np.abs(np.diagonal(R, axis1=1, axis2=2))
        largest = sizes.max(axis=1)
        exceeds = ~(finite & (largest <= LARGEST_VECTOR) & (largest <= LARGEST_RATIO * sizes.min(axis=1)))
        halved = exceeds & ~failed & (depth < MOST_HALVINGS)
        self.halvings[k[halved]] = depth + 1
        run.message[exceeds & ~failed] += ", but the tangent vectors grow too fast"
        failed |= exceeds
        j, k = np.flatnonzero(~halved), k[~halved]
        self.y[k], self.t[k] = run.y[j], run.t[j]
        self.message[k] = np.where(self.trusted[k] | failed[j], run.message[j], self.message[k])
        self.trusted[k] &= run.trusted[j] & ~failed[j]
        self.status[k] = [FAILED if failed[i] else self._ended_by(run, i) if run.status[i] == 1 else OK for i in j]
        if self.samples:
            reduced = np.reshape(run["reduced"], (len(failed), -1)) * np.ones(3)  # (m, 1) if all have failed
            (s0, A0, mean), L0, (s, log_integral, rest) = self.integrals[k].T, self.log_sizes[k, 0], reduced[j].T
            # With L the logarithm of the size and A its integral, MEGNO is 2 (L - A / s).
            A = A0 + L0 * (s - s0) + log_integral
            over_s = (A0 - L0 * s0) * np.log(np.where(s0 > 0, s, 1) / np.where(s0 > 0, s0, 1)) + L0 * (s - s0) + rest
            self.integrals[k] = np.transpose([s, A, mean + 2 * (A - A0 - over_s)])
        self.vectors[k] = Q[j]
        self.log_sizes[k] += np.where(failed[j, None], np.nan, np.log(sizes[j]))

    def _ended_by(self, run: Any, member: Any) -> str:
        ended = [times[-1:].tolist() == [run.t[member]] for times in run.t_events[member]]
        return self.names[ended.index(True)]

    @property
    def _row(self) -> Array:
        """Return time, log_sizes and integrals of each orbit, shape (m, 1 + k + 3)."""
        return np.column_stack([self.t, self.log_sizes, self.integrals])

    def _result(self, rows: list[Array]) -> ChaosResult:
        """Return the result from the rows at the start and at the ends of the segments."""
        found = np.array([*rows, self._row]).reshape((-1, *self.grid, rows[0].shape[1]))
        t, logs, (s, A, integral) = found[..., 0], found[..., 1:-3], np.moveaxis(found[..., -3:], -1, 0)
        items = {"y": self.y, "columns": self.vectors, "trusted": self.trusted}
        items |= {"status": self.status.astype(str), "message": self.message.astype(str)}
        end: dict[str, Any] = {name: item.reshape((*self.grid, *item.shape[1:]))[()] for name, item in items.items()}
        end |= {"t": t[:-1], "success": FAILED not in self.status}
        with np.errstate(invalid="ignore"):  # 0 / 0 at the start
            if not self.samples:
                running = logs / np.abs(t - self.span[0])[..., None]
                exponents = np.sort(running[-1])[..., ::-1]
                return ChaosResult(exponents=exponents, lyapunov=exponents[..., 0], running=running[:-1], **end)
            mean, Y = integral / s, 2 * (logs[..., 0] - A / s)
            mean[0] = Y[0] = 0.0
            away = s[:-1] - np.nanmean(s[:-1], axis=0)
            slope = np.nansum(away * mean[:-1], axis=0) / np.nansum(away**2, axis=0) + 0 * mean[-1]
        return ChaosResult(megno=mean[-1], lyapunov=2 * slope, Y=Y[:-1], mean=mean[:-1], **end)


def _sampled(t0: float, result: Any) -> list[float]:
    """Return the last time of a segment, counted from t0, and integrals of log |d| and of its mean; see `_advance`."""
    s, size = np.abs(result.t - t0), np.linalg.norm(result.variations[:, :, 0], axis=1)
    if s.size < 2:
        return [float(s[-1]), 0.0, 0.0]
    integral = CubicSpline(s, np.log(size / size[0])).antiderivative()(s)
    over_s = np.divide(integral, s, out=np.zeros_like(s), where=s > 0)
    return [float(s[-1]), float(integral[-1]), float(CubicSpline(s, over_s).integrate(s[0], s[-1]))]


def _orthonormal(n: int, k: int) -> Array:
    """Return k random orthonormal vectors (n, k), the first of which are the same in each call."""
    return np.linalg.qr(np.random.default_rng(1).standard_normal((k, n)).T)[0]


def lyapunov_exponent(fun: Any, t: Any = None, y0s: Any = None, **options: Any) -> ChaosResult:
    """Compute the largest Lyapunov exponents of many orbits: `lyapunov_spectrum` with ``count=1``.

    See Also
    --------
    lyapunov_spectrum, megno, eip_scipy.plotting.map

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.chaos import lyapunov_exponent
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> lyapunov_exponent(pendulum, 1000, [[0.0, 1.0], [0.5, 1.0]], method=EIPDOP853, h=0.1).lyapunov < 0.02
    array([ True,  True])
    """
    return lyapunov_spectrum(fun, t, y0s, count=1, **options)


def lyapunov_spectrum(
    fun: Any,
    t: Any = None,
    y0s: Any = None,
    *,
    count: int | None = None,
    every: float | None = None,
    progress: bool = False,
    **options: Any,
) -> ChaosResult:
    """Compute Lyapunov exponents from the growth of tangent vectors that are orthonormalised repeatedly [1]_.

    Parameters
    ----------
    fun : callable or Problem
        As for `integrate`.
    t : float or (float, float), optional
        End, or start and end. Default: the interval of the problem.
    y0s : array_like, shape (..., n), optional
        Initial states of a grid of orbits, or of one orbit (n,). Default: the initial state of the problem.
    count : int, optional
        Number of exponents to compute, which are the largest ones. Default: all n.
    every : float, optional
        Time between two orthonormalisations. With a fixed step, choose a multiple of the step. Default: a hundredth of
        the interval, for a grid a tenth. An orbit whose vectors grow apart by a factor above 1e8 halves it.
    progress : bool, optional
        Show a progress bar.
    **options
        Options of `ensemble`: method, steps, invariants, events, executor and so on; `params` may be an array
        (..., p). Name terminal events as their orbits are to be marked, such as ``escaped`` or ``collided``.

    Returns
    -------
    ChaosResult

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, as for `ensemble`. An exception or interruption has the orbits so far as ``partial``.

    See Also
    --------
    lyapunov_exponent, megno

    Notes
    -----
    The estimates converge as 1/t, with fluctuations, which ``running`` shows. In a backward run the exponents are those
    of the reversed flow. The tangent vectors are projected together with the state, so that the pair of zero exponents
    of a Hamiltonian system belongs exactly to the energy and to the direction of the flow.

    References
    ----------
    .. [1] G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Meccanica 15 (1980), 9-20 and 21-30,
       doi:10.1007/BF02128236.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.chaos import lyapunov_spectrum
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> found = lyapunov_spectrum(pendulum, 100, [[0.0, 1.0], [0.5, 1.0]], method=EIPDOP853, h=0.1)
    >>> found.exponents.shape, bool(np.allclose(found.exponents.sum(axis=1), 0, atol=1e-12))
    ((2, 2), True)
    """
    orbits = _Orbits(fun, t, y0s, options)
    n = orbits.y.shape[1]
    k = n if count is None else as_count("count", count)
    if k > n:
        raise ValueError(
            f"count is {k}, but the state has {n} components and as many exponents. Give a smaller count, or omit it "
            "to compute all."
        )
    return orbits.follow(_orthonormal(n, k), every, progress)


def megno(
    fun: Any,
    t: Any = None,
    y0s: Any = None,
    *,
    deviation: Any = None,
    every: float | None = None,
    samples: int = 100,
    progress: bool = False,
    **options: Any,
) -> ChaosResult:
    """Compute MEGNO, the mean exponential growth factor of nearby orbits [1]_, from one tangent vector.

    Parameters
    ----------
    fun, t, y0s, progress, **options
        As for `lyapunov_spectrum`.
    deviation : array_like, shape (n,) or (..., n), optional
        The tangent vector at the start; its length does not matter. Default: a random direction, the same each time.
    every : float, optional
        Time after which the vector is scaled to length 1 again, and MEGNO is returned. Default: a hundredth of the
        interval, for a grid a tenth. An orbit whose vector grows by more than 1e100 in this time halves it.
    samples : int, optional
        Number of samples of the vector in this time. The integrals are those of cubic splines through them.

    Returns
    -------
    ChaosResult

    See Also
    --------
    lyapunov_exponent, eip_scipy.plotting.map

    Notes
    -----
    With the tangent vector d, ``Y(t) = (2/t) int_0^t s (d' . d)/(d . d) ds = 2 (L(t) - (1/t) int_0^t L ds)``, where
    L = log(size of d) and t counts from the start, and the mean is ``(1/t) int_0^t Y ds``. The mean tends to 2 for
    regular orbits (to 0 for a harmonic oscillator), and to half the largest exponent times t for chaotic ones. REBOUND
    returns this mean too [2]_; its ``Simulation.lyapunov()`` is the slope of the mean, half of ``lyapunov`` here.

    References
    ----------
    .. [1] P. M. Cincotta, C. Simó, Astron. Astrophys. Suppl. Ser. 147 (2000), 205-228, eqs. 23 to 25,
       doi:10.1051/aas:2000108.
    .. [2] H. Rein, D. Tamayo, MNRAS 459 (2016), 2275-2285, section 4, doi:10.1093/mnras/stw644.

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, hamiltonian
    >>> from eip_scipy.chaos import megno
    >>> pendulum = hamiltonian("p**2/2 - cos(q)")
    >>> found = megno(pendulum, 2000, [[0.0, 1.0], [0.0, 1.5]], method=EIPDOP853, h=0.1)
    >>> found.megno.round(1), found.status
    (array([2., 2.]), array(['ok', 'ok'], dtype='<U2'))
    """
    orbits = _Orbits(fun, t, y0s, options)
    n = orbits.y.shape[1]
    first = _orthonormal(n, 1)[:, 0] if deviation is None else reals("deviation", deviation)
    if first is None or first.shape not in ((n,), (*orbits.grid, n)) or not np.isfinite(first).all():
        raise ValueError(
            f"deviation must be a finite vector of {n} numbers, or one for each orbit, got {shown(deviation)}."
        )
    size = np.linalg.norm(first, axis=-1, keepdims=True)
    if not size.all():
        raise ValueError(f"deviation must not be 0, got {shown(deviation)}.")
    return orbits.follow((first / size)[..., None], every, progress, as_count("samples", samples))
