"""Linear invariants of a system, found from values of its right-hand side: constraints that corrections keep."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgeqp3

__all__ = ["LinearInvariants", "confirmed", "found_invariants", "reduced_rows", "undetermined"]

# Diagonal entries of R below NULL times the largest are zero. If one is between NULL and CLEAR, nothing is found.
NULL, CLEAR = 1e-12, 1e-10
# Bound of the residual of rates of the form d y, where d y is an invariant, as for the centre of mass.
NULL_RATE = 1e-9
# Coefficients below this share of the largest one are 0; pivots are larger than LEAST_PIVOT. Others are rounded to BITS
# bits, so that they do not depend on the points. A rate may differ from 0 by HOLDS times the sum of its terms.
NEGLIGIBLE, LEAST_PIVOT, BITS, HOLDS = 1e-9, 1e-4, 32, 1e-8
# A gradient is a combination of the rows of C if its remainder is below SPANNED times the gradient.
SPANNED = 1e-7

Array = np.ndarray


class LinearInvariants(NamedTuple):
    """Quantities C y, with C of shape (k, n), and their rates A C y, with A of shape (k, k)."""

    C: Array
    A: Array

    def only(self, rows: Array) -> LinearInvariants:
        """Return those of the `rows`, a mask (k,), whose rates are 0 or among them too."""
        kept = rows & ~(self.A[:, ~rows] != 0).any(axis=1)
        return LinearInvariants(self.C[kept], self.A[np.ix_(kept, kept)])


def found_invariants(y: Array, f: Array) -> LinearInvariants:
    """Return the quantities c y with c f = 0, and those whose rates are such quantities.

    `f` (m, n) are the derivatives at the states `y` (m, n). The first n states are close to each other, and nothing is
    found if a derivative there is not finite; the others are left out where theirs are not finite.
    """
    n = y.shape[1]
    none, good = LinearInvariants(np.zeros((0, n)), np.zeros((0, 0))), np.isfinite(f).all(axis=1)
    if not good[:n].all():
        return none
    # Rows are in units of the largest rate at their state, and columns in those of the largest rate of a component.
    size = np.abs(f[good]).max(axis=1, keepdims=True)
    size[size == 0] = 1.0
    F = f[good] / size
    units = np.abs(F).max(axis=0)
    units[units == 0] = 1.0
    F /= units
    left, order = dgeqp3(F)[:2]  # the QR decomposition with pivots
    left = np.abs(left.diagonal())
    rank = int(np.count_nonzero(left > NULL * left[0]))
    if not 0 < rank < n or left[rank - 1] < CLEAR * left[0]:
        return none
    pivots, others = order[:rank] - 1, order[rank:] - 1
    Q, R = np.linalg.qr(F[:, pivots])
    momenta, inverse = np.eye(n)[others], np.linalg.inv(R)
    momenta[:, pivots] = -(inverse @ (Q.T @ F[:, others])).T
    momenta = _without_negligible(reduced_rows(momenta, LEAST_PIVOT)) / units
    momenta = _rounded(momenta / np.abs(momenta).max(axis=1, keepdims=True))
    rates = y[good] @ momenta.T / size
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
        free &= (np.abs(shares @ combinations[left < SPANNED].T) < SPANNED).all(axis=1)
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
