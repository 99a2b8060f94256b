"""Search for what a system conserves in addition to the given invariants: linear invariants, momenta of particles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg.lapack import dgeqp3

from ..engine.native import BUILD, LibraryFunction
from ..methods.base import PROJECTION_ONLY
from .derivatives import NumericalGradient, time_of_motion, typical_sizes, unless_error
from .invariants import Invariant
from .particles import LinearInvariants
from .problem import component_names

if TYPE_CHECKING:
    from .runs import Run

__all__ = [
    "NEAR_DISTANCE", "NOTHING", "Conserved", "confirmed", "conserved", "missing_linear", "reduced_rows", "states_near",
]  # fmt: skip

# Largest state whose linear invariants are searched for: the time grows with the cube of the number of components.
MOST_COMPONENTS = 300
# Number of points near the start if no invariants are searched for, and those at which gradients are computed; number
# of points far from it.
NEAR, FAR = 3, 5
# Distances of the points from the start, in units of the components' sizes.
NEAR_DISTANCE, FAR_DISTANCE = 1e-2, 0.5
# Diagonal entries of R below NULL times the largest are zero. If one is between NULL and CLEAR, nothing is found.
NULL, CLEAR = 1e-12, 1e-10
# Bound of the residual of rates of the form d y, where d y is an invariant, as for the centre of mass.
NULL_RATE = 1e-9
# Coefficients below this share of the largest one are 0; pivots are larger than LEAST_PIVOT. Others are rounded to BITS
# bits, so that they do not depend on the points. A rate may differ from 0 by HOLDS times the sum of its terms.
NEGLIGIBLE, LEAST_PIVOT, BITS, HOLDS = 1e-9, 1e-4, 32, 1e-8
# Compiled gradients of states with more components are made of f where they can be: for fewer, dual numbers take little
# more time than f.
FEW = 24
# A vector is a combination of others if its remainder is below this share of it.
REMAINDER = 1e-7
# The largest share of their terms that total forces and torques, and changes of a mass between states, may have.
SMALL = 1e-9

Array = np.ndarray


class Particles(NamedTuple):
    """Masses (N,) of particles with this number of coordinates, whose momentum or angular momentum no run keeps yet."""

    masses: Array
    dimension: int

    def __str__(self) -> str:
        given = "masses" if self.dimension == 3 else "masses, dimension=2"
        return (
            "momentum and angular momentum of the particles are conserved too, and the run does not keep all of them, "
            "without which keeping the energy can make the motion less accurate. Write "
            f"invariants=[H, *particle_invariants({given})], with the masses of the energy H"
        )


class Conserved(NamedTuple):
    """Linear invariants that the corrections of a run leave unchanged, and particles whose momenta it does not keep.

    `found` is the number of linear invariants with those that the given invariants determine, None if they were not
    looked for, and `calls` the number of evaluations. `masses`, (l, n / 2) or empty, has a row M for each value whose
    gradient is (-M a, M v), where f = (v, a), and NaN for the others; `rows_from_f` are the indices of the former.
    """

    linear: LinearInvariants = LinearInvariants(np.zeros((0, 0)), np.zeros((0, 0)))
    found: int | None = None
    calls: int = 0
    missing: Particles | None = None
    masses: Array = np.zeros((0, 0))

    @property
    def rows_from_f(self) -> list[int]:
        """Return the indices of the values whose gradients are made of f."""
        return np.flatnonzero(np.isfinite(self.masses[:, :1])).tolist() if self.masses.size else []

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return sentences for `Diagnostics`."""
        missing = () if self.missing is None else (str(self.missing),)
        if not self.found:
            return missing
        kept = len(self.linear.C)
        rest = "" if kept == self.found else "; the given invariants determine the others"
        text = f"linear invariants: {self.found} found by {self.calls} evaluations (not in nfev), {kept} kept{rest}"
        return (text, *missing)


NOTHING = Conserved()


def conserved(run: Run, y: Array, f: Array, names: bool) -> Conserved:
    """Return what the system of a run conserves; nothing if the run cannot keep it.

    The run has evaluated its invariants at the start. `y` is the state there, without tangent vectors, and `f` its
    derivative. Particles are looked for if `names`, but not in ready problems. A user's one-step method need not keep
    linear invariants, and none are looked for.
    """
    invariants, method, n, half = run.invariants, run.method, y.size, y.size // 2
    plain = y.dtype.kind == "f" and not invariants.balances.items and method is not PROJECTION_ONLY
    if not plain or invariants.size == 0 or hasattr(invariants.items, "shift"):  # fields have their own projection
        return NOTHING
    known, is_searched = None, False
    if run.projection.given_linear_invariants is None and (not method.in_python or method.drives):
        is_searched = run.projection.linear_invariants is not None and n <= MOST_COMPONENTS
        known = next((item.linear for item in invariants.items if item.linear is not None), None)
        known = None if is_searched or known is None or known.C.shape[1] != n else known
    names = (
        names
        and n >= 8 and n % 2 == 0 and np.array_equal(f[:half], y[half:])
        and not (n > MOST_COMPONENTS and invariants.by_values.any())  # gradients by differences take long
        and not all(isinstance(item.function, LibraryFunction) for item in invariants.items)
    )  # fmt: skip
    rows = []
    if n % 2 == 0 and not (run.tangents.count or method.in_python):
        own = (
            invariants.given_gradients if n > FEW else [not isinstance(g, NumericalGradient) for g in invariants.grads]
        )
        of_items = zip(pairwise(invariants.starts), own, strict=True)  # an item is evaluated as a whole
        rows = [first for (first, end), is_exact in of_items if end == first + 1 and not is_exact]
    if not (is_searched or known or names or rows):
        return NOTHING
    samples = _Samples(run, y, f, is_searched)
    with np.errstate(all="ignore"):
        found = unless_error(_found, samples, known, names) or NOTHING
        masses = unless_error(_masses_from_f, samples, rows) if rows else None
    return found._replace(calls=samples.calls, masses=NOTHING.masses if masses is None else masses)


def missing_linear(run: Run) -> list[Invariant]:
    """Return linear invariants of the equations that a run neither keeps by its corrections nor has among its own."""
    y, n = run.begin.y, run.begin.y.size
    if y.dtype.kind == "c" or n > MOST_COMPONENTS or run.projection.given_linear_invariants is not None:
        return []
    samples = _Samples(run, y, run.begin.f, True)
    with np.errstate(all="ignore"):
        found = unless_error(found_invariants, *samples.points) or NOTHING.linear
        C = found.C[~found.A.any(axis=1)]
        if len(C) and (run.invariants.size or len(run.conserved.linear.C)):
            kept = np.broadcast_to(run.conserved.linear.C.reshape(-1, n), (NEAR, len(run.conserved.linear.C), n))
            known = samples.gradients if run.invariants.size else kept
            C = C[undetermined(C, np.concatenate([known, kept], axis=1), samples.sizes)]
    names = component_names(run.problem.component_names, n)
    return [_linear_invariant(row / row[np.flatnonzero(row)[0]], names) for row in C]


def _linear_invariant(c: Array, names: Sequence[str]) -> Invariant:
    """Return the invariant c y, with a name such as "y0 - 2*y1"."""
    terms = [(value, name) for value, name in zip(c.tolist(), names, strict=True) if value]
    text = " ".join(f"{'-' if x < 0 else '+'} {'' if abs(x) == 1 else f'{abs(x):g}*'}{name}" for x, name in terms)
    return Invariant(lambda t, y, *_: float(c @ y), lambda t, y, *_: c, name=text.removeprefix("+ "))


def _masses_from_f(samples: _Samples, rows: list[int]) -> Array | None:
    """Return `Conserved.masses` for gradients with the indices `rows`; None if none of them is made of f.

    For q'' = a(t, q) and H = T + V, and for canonical (q, p), the gradient of the energy has the components of f, up to
    constant factors M. They are found and compared at the start and at the first points.
    """
    _, f, G = map(np.array, zip(*samples.states(), strict=True))
    v, a = np.split(f, 2, axis=1)
    masses = np.full((G.shape[1], v.shape[1]), np.nan)
    for k in rows:
        by_q, by_v = np.split(G[:, k], 2, axis=1)
        moving = (v * v + a * a).sum(axis=0)
        M = _rounded((by_v * v - by_q * a).sum(axis=0) / np.where(moving == 0, 1.0, moving))
        errors, sizes = np.abs([by_q + M * a, by_v - M * v]), np.abs([by_q, by_v])
        # Forces may cancel at the start, as in a crystal. The comparison is also False if a number is not finite.
        if (errors <= HOLDS * sizes.max(axis=(1, 2), keepdims=True)).all():
            masses[k] = M
    return None if np.isnan(masses).all() else masses


def _found(samples: _Samples, known: LinearInvariants | None, names: bool) -> Conserved:
    """Return what is found among all linear invariants if the samples are wide, else among the `known` ones."""
    found, count, missing = NOTHING.linear, None, None
    if samples.is_wide:
        found = found_invariants(*samples.points)
        count = len(found.C)
    elif known is not None:
        found = known.only(confirmed(*samples.points, known))
        count = len(found.C)
    if count:
        found = found.only(undetermined(found.C, samples.gradients, samples.sizes))
    if names and (count or not samples.is_wide):  # momentum is among what a search finds
        given = samples.run.projection.given_linear_invariants
        C = found.C.reshape(-1, samples.y.size) if given is None else np.atleast_2d(given[0])
        missing = _missing_particles(samples, C)
    return Conserved(found, count, samples.calls, missing)


class _Samples:
    """States around the start of a run and their derivatives. The states are the same in each run that starts there.

    The first ones are near the start, at its time; if `is_wide`, there are others at larger distances, at times up to
    the end. Of a state with tangent vectors only the state itself, `y` at the start, is varied. `calls` counts the
    evaluations of the right-hand side, which the problem does not count.
    """

    def __init__(self, run: Run, y: Array, f: Array, is_wide: bool) -> None:
        self.run, self.y, self.f, self.is_wide, self.calls = run, y, f, is_wide, 0

    @cached_property
    def sizes(self) -> Array:
        """Return the sizes (n,) of the components."""
        tau = min(self.run.invariants.tau, time_of_motion(self.y, self.f))
        return np.abs(self.y) + typical_sizes(self.y, self.f, tau)

    @cached_property
    def points(self) -> tuple[Array, Array]:
        """Return states (m, n) and derivatives, which are NaN where the function fails."""
        near, far = (max(self.y.size, NEAR), FAR) if self.is_wide else (NEAR, 0)
        y = states_near(self.y, self.sizes, near * (NEAR_DISTANCE,) + far * (FAR_DISTANCE,))
        t0, t_bound = self.run.invariants.t_span
        span = t_bound - t0 if np.isfinite(t_bound) else 0.0
        self.calls += near + far
        times = np.array([t0] * near + [t0 + span * k / (FAR - 1) for k in range(far)])
        start, tangents = self.run.begin.y, self.run.tangents
        states = np.array([tangents.with_state(start, state) for state in y]) if tangents.count else y
        return y, tangents.state(self.run.problem.evaluate.derivatives(times, states))

    @cached_property
    def gradients(self) -> Array:
        """Return the gradients (NEAR, l, n) of the invariants at the first points."""
        self.calls += NEAR
        (t, start, *_), tangents = self.run.begin, self.run.tangents
        states = [tangents.with_state(start, y) for y in self.points[0][:NEAR]]
        slopes = [self.run.problem.evaluate(t, y) for y in states]
        gradients = [self.run.invariants.gradients(t, y, f) for y, f in zip(states, slopes, strict=True)]
        return tangents.state(np.array(gradients))

    def states(self) -> Iterator[tuple[Array, Array, Array]]:
        """Return the state, the derivative and the gradients (l, n) at the start, and then at the first points."""
        yield self.y, self.f, self.run.tangents.state(self.run.invariants.start_gradients)
        yield from zip(*self.points, self.gradients, strict=False)


def states_near(y: Array, sizes: Array, distances: tuple[float, ...]) -> Array:
    """Return states (m, n) at these distances from y, in units of the sizes of its components: the same in each run.

    Components that are 0 at y may have to stay nonnegative, as concentrations, and do so.
    """
    return BUILD.states_near(y, sizes, _ways(distances, y.size))


@lru_cache(maxsize=8)
def _ways(distances: tuple[float, ...], n: int) -> Array:
    ways = np.tanh(np.random.default_rng(20220).standard_normal((len(distances), n)))
    return np.asarray(ways * np.array(distances)[:, None])


def found_invariants(y: Array, f: Array) -> LinearInvariants:
    """Return the quantities c y with c f = 0, and those whose rates are such quantities.

    `f` (m, n) are the derivatives at the states `y` (m, n). The first n states are close to each other, and nothing is
    found if a derivative there is not finite; the others are left out where theirs are not finite.
    """
    n = y.shape[1]
    if BUILD.are_independent(f) or not BUILD.are_finite(f[:n]):
        return NOTHING.linear
    if not BUILD.are_finite(f):
        good = np.isfinite(f).all(axis=1)
        y, f = y[good], f[good]
    # Rows are in units of the largest rate at their state, and columns in those of the largest rate of a component.
    size = np.abs(f).max(axis=1, keepdims=True)
    size[size == 0] = 1.0
    F = f / size
    units = np.abs(F).max(axis=0)
    units[units == 0] = 1.0
    F /= units
    left, order = dgeqp3(F)[:2]  # the QR decomposition with pivots
    left = np.abs(left.diagonal())
    rank = int(np.count_nonzero(left > NULL * left[0]))
    if not 0 < rank < n or left[rank - 1] < CLEAR * left[0]:
        return NOTHING.linear
    pivots, others = order[:rank] - 1, order[rank:] - 1
    Q, R = np.linalg.qr(F[:, pivots])
    momenta, inverse = np.eye(n)[others], np.linalg.inv(R)
    momenta[:, pivots] = -(inverse @ (Q.T @ F[:, others])).T
    momenta = _without_negligible(reduced_rows(momenta, LEAST_PIVOT)) / units
    momenta = _rounded(momenta / np.abs(momenta).max(axis=1, keepdims=True))
    rates = y @ momenta.T / size
    shares = Q.T @ rates
    paired = np.linalg.norm(rates - Q @ shares, axis=0) <= NULL_RATE * np.linalg.norm(rates, axis=0)
    centres = np.zeros((np.count_nonzero(paired), n))
    centres[:, pivots] = (inverse @ shares[:, paired]).T
    C = np.concatenate([_rounded(_without_negligible(centres) / units), momenta])
    A = np.zeros((len(C), len(C)))
    A[: len(centres), len(centres) :][:, paired] = np.eye(len(centres))
    return LinearInvariants(C, A)


def confirmed(y: Array, f: Array, given: LinearInvariants) -> Array:
    """Return a mask (k,) of the rows of `given` whose rates agree with the derivatives f (m, n) at the states y."""
    C, R = given.C.T, (given.A @ given.C).T
    return (np.abs(f @ C - y @ R) <= HOLDS * (np.abs(f) @ np.abs(C) + np.abs(y) @ np.abs(R))).all(axis=0)


def undetermined(C: Array, gradients: Array, sizes: Array) -> Array:
    """Return a mask (k,) of the rows of C (k, n) that do not occur in a combination of the gradients.

    `gradients` (m, l, n) are those of the invariants at m states, and `sizes` (n,) those of the components. If the rows
    were kept whose combination is a combination of the gradients, no correction could change that combination of the
    invariants, such as a momentum that is an invariant.
    """
    rows, free = (C * sizes).T, np.ones(len(C), bool)
    rows /= np.linalg.norm(rows, axis=0)
    for G in np.swapaxes(gradients * sizes, 1, 2):
        slopes = G / np.maximum(np.linalg.norm(G, axis=0), np.finfo(float).tiny)
        shares = np.linalg.lstsq(rows, slopes)[0]
        _, left, combinations = np.linalg.svd(slopes - rows @ shares, full_matrices=False)
        free &= (np.abs(shares @ combinations[left < REMAINDER].T) < REMAINDER).all(axis=1)
    return free


def reduced_rows(rows: Array, least: float) -> Array:
    """Return the reduced row echelon form of independent rows; pivots are larger than `least`."""
    rows, done = rows.copy(), 0
    for column in range(rows.shape[1]):
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < least:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        others = np.arange(len(rows)) != done
        rows[others] -= np.outer(rows[others, column], rows[done])
        done += 1
    return rows


def _without_negligible(rows: Array) -> Array:
    return np.where(np.abs(rows) < NEGLIGIBLE * np.abs(rows).max(axis=1, keepdims=True, initial=0.0), 0.0, rows)


def _rounded(rows: Array) -> Array:
    mantissa, exponent = np.frexp(rows)
    return np.ldexp(np.round(np.ldexp(mantissa, BITS)), exponent - BITS)


def _missing_particles(samples: _Samples, C: Array) -> Particles | None:
    """Return the particles of a state (q, v) whose momentum and angular momentum the run does not keep; else None.

    One of the invariants is the energy, whose gradient gives the masses, and `C` (k, n) are the linear invariants that
    the corrections leave unchanged.
    """
    half = samples.y.size // 2
    for d, row in product((3, 2), range(samples.run.invariants.size)):
        if half % d or half < 2 * d or (masses := _masses(samples.states(), row, d)) is None:
            continue
        wanted = _momenta(masses, d, samples.points[0][0]).T
        known = np.concatenate([samples.gradients[0], C]).T
        known /= np.maximum(np.linalg.norm(known, axis=0), np.finfo(float).tiny)
        rest = wanted - known @ np.linalg.lstsq(known, wanted, rcond=SMALL)[0]
        if (np.linalg.norm(rest, axis=0) > REMAINDER * np.linalg.norm(wanted, axis=0)).any():
            return Particles(masses, d)
    return None


def _masses(states: Iterator[tuple[Array, Array, Array]], row: int, d: int) -> Array | None:
    """Return masses (N,) for which a row of the gradients has the momenta, and momentum and angular momentum are kept.

    Return None if there are none. The mass of a particle at rest is unknown, and its state is not examined.
    """
    masses = None
    for y, f, G in states:
        v, p = (x.reshape(2, -1, d)[1] for x in (y, G[row]))
        m: Array = (p * v).sum(axis=1) / (v * v).sum(axis=1)
        if np.isnan(m).any():
            continue
        fits = (np.abs(p - m[:, None] * v) <= SMALL * np.abs(p).max(axis=1, keepdims=True)).all() and (m > 0).all()
        if not fits or (masses is not None and (np.abs(m - masses) > SMALL * masses).any()):
            return None
        masses, rows = m, _momenta(m, d, y)
        if not (np.abs(rows @ f) <= SMALL * (np.abs(rows) @ np.abs(f))).all():
            return None
    return masses


def _momenta(masses: Array, d: int, y: Array) -> Array:
    """Return the gradients of the momentum and the angular momentum of particles at the state y."""
    planes = list(combinations(range(d), 2))
    m_q, m_v = masses[:, None] * y.reshape(2, -1, d)
    rows = np.zeros((d + len(planes), 2, masses.size, d))
    for a in range(d):
        rows[a, 1, :, a] = masses
    for row, (a, b) in zip(rows[d:], planes, strict=True):
        row[0, :, a], row[0, :, b], row[1, :, b], row[1, :, a] = m_v[:, b], -m_v[:, a], m_q[:, a], -m_q[:, b]
    return rows.reshape(len(rows), -1)
