"""The method on one page, in plain NumPy: one explicit Runge-Kutta step, then one Newton step onto the invariants.

For reading, and to test the engine against. What rounding, singular gradients or failing functions do is not caught
here, and nothing is fast. Complex states are pairs of floats throughout: Re <a, b> is then the ordinary product.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

EPS = np.finfo(float).eps
FLOOR = 1e-7
MEMORY, LONG_MEMORY = 0.8, 0.999
# A shift in time whose tangent part, squared, is a smaller share is rounding.
LEAST_SHIFT = 1e-12
# The share of its terms that a given target may be missed by without a further Newton step, and their largest number.
MOST_LEFT, FURTHER = 1e-9, 3
Array = np.ndarray


@dataclass
class Step:
    """Ingredients of a step.

    `fun` is f(t, y), `values` I(t, y) and `gradients` G(t, y) (l, n) of all invariants. `blocks` are lists of
    components; `linear_invariants` is (C, S); the metric is "error", "euclidean" or n weights. `remembered` holds what
    the error metric remembers by block: the scale, the error in units of the largest relative one, the lasting share.
    """

    tableau: Any
    fun: Callable[[float, Array], Array]
    values: Callable[[float, Array], Array]
    gradients: Callable[[float, Array], Array]
    target: Array
    rtol: float = 1e-3
    atol: float = 1e-6
    metric: Any = "error"
    blocks: Sequence[Sequence[int]] | None = None
    linear_invariants: tuple[Array, Array] | None = None
    direction: str = "new"
    iterations: int = 1
    remembered: Any = (0.0, 0.0, 0.0)

    def __call__(self, t: float, y: Array, h: float) -> Array:
        """The state at t + h."""
        if hasattr(self.tableau, "b_prime"):
            y_hat, err, f = nystrom(self.tableau, self.fun, t, y, h)
        else:
            y_hat, K = runge_kutta(self.tableau, self.fun, t, y, h)
            err, f = local_error(self.tableau, K, h), flow(self.tableau, K)
        return self.projected(t, y, t + h, y_hat, err, f)

    def projected(self, t_old: float, y: Array, t: float, y_hat: Array, err: Array | None, f: Array) -> Array:
        """y_hat on the invariants' targets; `f` is the derivative there, or nearly so."""
        g = self.residuals(t, y_hat)
        sigma, shares, units = self.weights(y, y_hat, err)
        if not g.any():
            return y_hat
        # Newton's matrix has the gradients at the residuals' state; corrections go along those of the direction.
        along = {"new": (t, y_hat), "old": (t_old, y), "midpoint": ((t_old + t) / 2, (y + y_hat) / 2)}[self.direction]
        Q = sigma * self.neutral(floats(self.gradients(*along)))
        mu, now, shift = np.zeros(len(g)), y_hat, 0.0
        for k in range(self.iterations + FURTHER):
            if k >= self.iterations and self.shares(t, now).max() <= MOST_LEFT:
                break
            B = sigma * self.neutral(floats(self.gradients(t, now)))
            mu += np.linalg.lstsq(B @ Q.T, -self.residuals(t, now), rcond=None)[0]
            move = self.kept(sigma * (Q.T @ mu))
            if k == 0 and shares is not None and self.direction == "new":
                shift = self.shift(move, shares * floats(f) / sigma, B, sigma, units)
            now = states(floats(y_hat) + move - shift, y)
        return now

    def shift(self, move: Array, flow: Array, B: Array, sigma: Array, units: Array) -> Array:
        """The part of a correction that shifts the time, with the `flow` of each block in units of sigma."""
        tangent = flow - np.linalg.lstsq(B, B @ flow, rcond=None)[0]
        if tangent @ tangent <= LEAST_SHIFT * (flow @ flow):
            return np.zeros(len(move))
        shift = self.kept(sigma * tangent)
        return (move @ (units * shift)) / (shift @ (units * shift)) * shift

    def residuals(self, t: float, y: Array) -> Array:
        """I - target, which is given; 0 where all of it is the rounding of four of the invariants' terms."""
        return self.values(t, y) - self.target if (self.shares(t, y) > 4 * EPS).any() else np.zeros(len(self.target))

    def shares(self, t: float, y: Array) -> Array:
        """Return the distances from the targets in units of the invariants' terms."""
        values = self.values(t, y)
        terms = np.abs(floats(self.gradients(t, y)) * floats(y)).sum(axis=1)
        return np.abs(values - self.target) / np.max([np.abs(values), np.abs(self.target), terms], axis=0)

    def weights(self, y: Array, y_hat: Array, err: Array | None) -> tuple[Array, Array | None, Array | None]:
        """Sigma: how far each float may move. By blocks, scale_b (e_b^kappa + floor).

        e_b is what is remembered of the block's relative error, in units of the largest one. For a block that the step
        leaves as it was, without an error, what is remembered does not count. Then the squared shares of the floats in
        the lasting errors, and the weights of the square of a correction; None for other metrics and for larger blocks.
        """
        width = floats(y).size // y.size
        if not isinstance(self.metric, str):
            return np.repeat(self.metric / np.max(self.metric), width), None, None
        if self.metric == "euclidean" or err is None:
            return np.ones(floats(y).size), None, None
        blocks = self.blocks if self.blocks is not None else [[k] for k in range(y.size)]
        places = [np.concatenate([np.arange(width) + width * k for k in block]) for block in blocks]

        def norms(a: Array) -> Array:
            return np.array([np.linalg.norm(floats(a)[place]) for place in places])

        def spread(a: Array) -> Array:
            out = np.zeros(floats(y).size)
            for place, value in zip(places, a, strict=True):
                out[place] = value
            return out

        old, new, error = norms(y), norms(y_hat), norms(err)
        known = norms(np.maximum(np.abs(floats(err)), EPS * np.abs(floats(y_hat))).view(y.dtype))
        scale = self.atol * np.sqrt([len(block) for block in blocks]) + self.rtol * np.maximum(old, new)
        scale = np.maximum(scale, MEMORY * self.remembered[0])
        inverse = np.divide(1.0, scale, where=scale > 0, out=np.zeros(len(scale)))
        now = known * inverse
        now = now / (now.max() or 1.0)
        size, lasting = np.maximum(now * scale, MEMORY * self.remembered[1]), LONG_MEMORY * self.remembered[2]
        self.remembered = scale, size, np.maximum(now, lasting)
        constant = (error == 0.0) & (norms(y_hat - y) == 0.0)
        errors = np.where(constant, now, size * inverse)
        sigma = scale * (errors**self.tableau.metric_exponent + FLOOR) if errors.any() else np.ones(len(scale))
        if len(blocks) < y.size:
            return spread(sigma), None, None
        return spread(sigma), spread(self.remembered[2] ** 2), spread(inverse**2)

    def neutral(self, G: Array) -> Array:
        """Rows G without what C y sees of them: G (1 - M C), M = S (C S)^-1."""
        if self.linear_invariants is None:
            return G
        C, S = self.linear_invariants
        return G - (G @ S) @ np.linalg.solve(C @ S, C)

    def kept(self, move: Array) -> Array:
        """A correction that leaves C y alone: (1 - M C) move."""
        if self.linear_invariants is None:
            return move
        C, S = self.linear_invariants
        return move - S @ np.linalg.solve(C @ S, C @ move)


def runge_kutta(
    tableau: Any, fun: Callable[[float, Array], Array], t: float, y: Array, h: float
) -> tuple[Array, Array]:
    """The raw result, and f at the stages and there."""
    K = []
    for a, c in zip(tableau.A, tableau.c, strict=True):
        K.append(fun(t + c * h, y + h * sum((a_j * k for a_j, k in zip(a, K, strict=False)), 0 * y)))
    y_hat = y + h * (np.array(K).T @ tableau.b)
    return y_hat, np.array([*K, fun(t + h, y_hat)])


def flow(tableau: Any, K: Sequence[Array]) -> Array:
    """f at the raw result: the last of K if the estimate takes it, else what two stages make of it."""
    if tableau.fsal or tableau.c[-1] == 0:
        return K[-1]
    return K[-2] + (1 / tableau.c[-1] - 1) * (K[-2] - K[0])


def nystrom(
    tableau: Any, fun: Callable[[float, Array], Array], t: float, y: Array, h: float
) -> tuple[Array, Array | None, Array]:
    """For y = (q, v) and q'' = a(t, q): the raw result, its estimated error, and its derivative by the last stage."""
    q, v = np.split(y, 2)
    accelerations: list[Array] = []
    for row, c in zip(tableau.A, tableau.c, strict=True):
        pulled = sum((a_j * a for a_j, a in zip(row, accelerations, strict=False)), 0 * q)
        accelerations.append(np.split(fun(t + c * h, np.concatenate([q + c * h * v + h * h * pulled, v])), 2)[1])
    a = np.array(accelerations).T
    y_hat = np.concatenate([q + h * v + h * h * (a @ tableau.b), v + h * (a @ tableau.b_prime)])
    f = np.concatenate([np.split(y_hat, 2)[1], flow(tableau, [*accelerations, accelerations[-1]])])
    if tableau.error_estimator_order is None:
        return y_hat, None, f
    return y_hat, np.concatenate([h * h * (a @ tableau.e), h * (a @ tableau.e_prime)]), f


def local_error(tableau: Any, K: Array, h: float) -> Array | None:
    """The estimate; DOP853 damps its own by the other one of its pair."""
    if tableau.error_estimator_order is None:
        return None
    e = np.asarray(tableau.e)
    err = h * (K[: e.size].T @ e)
    if tableau.paired:
        low = h * (K[: e.size].T @ np.asarray(tableau.e_low))
        size = np.hypot(np.abs(err), 0.1 * np.abs(low))
        err = np.where(size > 0, err * np.abs(err) / np.where(size > 0, size, 1.0), 0.0)
    return err


def floats(a: Array) -> Array:
    """Return numbers as floats, real and imaginary parts next to each other."""
    return np.ascontiguousarray(a).view(float)


def states(a: Array, like: Array) -> Array:
    """Floats as numbers of that kind."""
    return np.ascontiguousarray(a).view(like.dtype)
