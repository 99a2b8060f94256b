"""N point masses to first post-Newtonian order: the equations of Einstein, Infeld and Hoffmann, harmonic coordinates.

Accelerations, energy and momenta in the form of Landau & Lifshitz, The Classical Theory of Fields, section 106: with
n = (q_a - q_b)/r and phi_a the sum of G m_b / r over the others, the terms in 1/c^2 of

- the energy: 3/8 m v^4 of each body, 1/2 m phi^2 of each body, and of each pair
  G m_a m_b / r [3/2 (v_a^2 + v_b^2) - 7/2 v_a.v_b - 1/2 (n.v_a)(n.v_b)];
- the momentum p_a: 1/2 m v_a^2 v_a, and of each pair G m_a m_b / r [3 v_a - 7/2 v_b - 1/2 n (n.v_b)]; the angular
  momentum is the sum of q_a x p_a.

The accelerations are those whose right-hand sides hold Newton's accelerations, hence all of these vary by terms in
1/c^4. What is computed is G times energy and momenta. params: every G m, any entry, then 1/c^2 (see
`forces.parameters`).
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from ...engine.caching import cached_njit
from . import _newton

__all__ = [
    "add_accelerations",
    "add_cross",
    "add_outer",
    "energy",
    "energy_gradient",
    "linear_momentum",
    "momentum",
    "momentum_gradient",
]

_jit = cached_njit(error_model="numpy", _nrt=False)
_jit_allocating = cached_njit(error_model="numpy")


@_jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_jit
def _body(vectors, i):
    return vectors[3 * i], vectors[3 * i + 1], vectors[3 * i + 2]


@_jit
def _sum(s, a, t, b):
    """The vector s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@_jit
def _add(out, i, s, a):
    out[3 * i] += s * a[0]
    out[3 * i + 1] += s * a[1]
    out[3 * i + 2] += s * a[2]


@_jit
def add_cross(out, column, s, a):
    """Add to three columns of out (3, n) the matrix of b -> s a x b."""
    out[0, column + 1] -= s * a[2]
    out[0, column + 2] += s * a[1]
    out[1, column] += s * a[2]
    out[1, column + 2] -= s * a[0]
    out[2, column] -= s * a[1]
    out[2, column + 1] += s * a[0]


@_jit
def add_outer(out, column, s, a, b):
    """Add to three columns of out (3, n) the matrix s a b^T."""
    for i in range(3):
        for j in range(3):
            out[i, column + j] += s * a[i] * b[j]


@_jit_allocating
def _potentials(q, gm):
    """The sum of G m / r over the other bodies, at each."""
    n = q.size // 3
    phi = np.zeros(n)
    for i in range(n):
        for j in range(i + 1, n):
            x = _sum(1.0, _body(q, i), -1.0, _body(q, j))
            u = 1.0 / sqrt(_dot(x, x))
            phi[i] += gm[j] * u
            phi[j] += gm[i] * u
    return phi


@_jit
def _add_to_one(out, i, w, x, u, phi_i, phi_j, vi, vj, aj):
    """Add body j's post-Newtonian pull on body i; x from j to i, u = 1/r, w = G m_j / c^2, aj by Newton."""
    radial = _dot(x, vj) * u
    along = 4.0 * phi_i + phi_j - _dot(vi, vi) - 2.0 * _dot(vj, vj) + 4.0 * _dot(vi, vj)
    along += 1.5 * radial * radial + 0.5 * _dot(x, aj)
    w3 = w * u * u * u
    _add(out, i, w3 * along, x)
    _add(out, i, w3 * (4.0 * _dot(x, vi) - 3.0 * _dot(x, vj)), _sum(1.0, vi, -1.0, vj))
    _add(out, i, 3.5 * w * u, aj)


@_jit_allocating
def add_accelerations(q, v, params, out):
    """Add the post-Newtonian terms to out (3 N,), which holds Newton's accelerations."""
    n = q.size // 3
    over_c2, newton, phi = params[n + 1], out.copy(), _potentials(q, params)
    for i in range(n):
        for j in range(i + 1, n):
            x = _sum(1.0, _body(q, i), -1.0, _body(q, j))
            minus_x = _sum(-1.0, x, 0.0, x)
            u = 1.0 / sqrt(_dot(x, x))
            vi, vj = _body(v, i), _body(v, j)
            _add_to_one(out, i, over_c2 * params[j], x, u, phi[i], phi[j], vi, vj, _body(newton, j))
            _add_to_one(out, j, over_c2 * params[i], minus_x, u, phi[j], phi[i], vj, vi, _body(newton, i))


@_jit
def energy(t, y, params):
    """G times the energy."""
    half = y.size // 2
    n = half // 3
    q, v = y[:half], y[half:]
    total = 0.0
    for i in range(n):
        vi, phi = _body(v, i), 0.0
        v2 = _dot(vi, vi)
        for j in range(n):
            if j == i:
                continue
            vj, x = _body(v, j), _sum(1.0, _body(q, i), -1.0, _body(q, j))
            u = 1.0 / sqrt(_dot(x, x))
            phi += params[j] * u
            # Half of the pair's, and 3 v_i^2 / 2 in place of the mean.
            radial = _dot(x, vi) * _dot(x, vj) * u * u
            total += params[i] * params[j] * u * (1.5 * v2 - 1.75 * _dot(vi, vj) - 0.25 * radial)
        total += params[i] * (0.375 * v2 * v2 + 0.5 * phi * phi)
    return _newton.energy(t, y, params[:n]) + params[n + 1] * total


@_jit_allocating
def _momenta(y, params):
    """G times the momentum of each body (3 N,)."""
    half = y.size // 2
    n = half // 3
    over_c2, q, v, p = params[n + 1], y[:half], y[half:], np.zeros(half)
    for i in range(n):
        vi = _body(v, i)
        _add(p, i, params[i] * (1.0 + 0.5 * over_c2 * _dot(vi, vi)), vi)
        for j in range(n):
            if j == i:
                continue
            vj, x = _body(v, j), _sum(1.0, _body(q, i), -1.0, _body(q, j))
            u = 1.0 / sqrt(_dot(x, x))
            w = over_c2 * params[i] * params[j] * u
            _add(p, i, w, _sum(3.0, vi, -3.5, vj))
            _add(p, i, -0.5 * w * u * u * _dot(x, vj), x)
    return p


@_jit_allocating
def energy_gradient(t, y, out, params):
    """out (6 N,). By a velocity: the momentum and m v^2 v / c^2."""
    half = y.size // 2
    n = half // 3
    over_c2, q, v, phi = params[n + 1], y[:half], y[half:], _potentials(y[:half], params)
    by_q, by_v = out[:half], out[half:]
    by_q[:] = 0.0
    by_v[:] = _momenta(y, params)
    for i in range(n):
        vi = _body(v, i)
        _add(by_v, i, over_c2 * params[i] * _dot(vi, vi), vi)
        for j in range(i + 1, n):
            vj, x = _body(v, j), _sum(1.0, _body(q, i), -1.0, _body(q, j))
            u2 = 1.0 / _dot(x, x)
            w = params[i] * params[j] * u2 * sqrt(u2)
            xi, xj = _dot(x, vi), _dot(x, vj)
            even = phi[i] + phi[j] + 1.5 * (_dot(vi, vi) + _dot(vj, vj)) - 3.5 * _dot(vi, vj) - 1.5 * xi * xj * u2
            force = _sum(w * (1.0 - over_c2 * even), x, 0.0, x)
            force = _sum(1.0, force, -0.5 * over_c2 * w, _sum(xj, vi, xi, vj))
            _add(by_q, i, 1.0, force)
            _add(by_q, j, -1.0, force)


@_jit_allocating
def linear_momentum(t, y, params):
    """G times the momentum, three numbers."""
    p, half = _momenta(y, params), y.size // 2
    return p[0:half:3].sum(), p[1:half:3].sum(), p[2:half:3].sum()


@_jit_allocating
def momentum(t, y, params):
    """G times the angular momentum, three numbers."""
    p = _momenta(y, params)
    lx = ly = lz = 0.0
    for i in range(y.size // 6):
        a, b, c = _cross(_body(y, i), _body(p, i))
        lx, ly, lz = lx + a, ly + b, lz + c
    return lx, ly, lz


@_jit
def _add_pair_momentum(out, a, b, half, w, qa, qb, va, vb):
    """Add one pair's rows, of w {A/r - (qb x qa) s / (2 r^3)}.

    A = qa x (3 va - 7/2 vb) + qb x (3 vb - 7/2 va), s = (qa - qb).(va + vb).
    """
    x, both = _sum(1.0, qa, -1.0, qb), _sum(1.0, va, 1.0, vb)
    u2 = 1.0 / _dot(x, x)
    u, s, c = sqrt(u2), _dot(x, both), _cross(qb, qa)
    w3 = w * u * u2
    alpha, beta = _sum(3.0, va, -3.5, vb), _sum(3.0, vb, -3.5, va)
    A = _sum(1.0, _cross(qa, alpha), 1.0, _cross(qb, beta))
    # By the position: d qa x alpha = -alpha x d qa, and dc = qb x d qa - qa x d qb.
    add_cross(out, a, -w * u, alpha)
    add_cross(out, b, -w * u, beta)
    add_cross(out, a, -0.5 * w3 * s, qb)
    add_cross(out, b, 0.5 * w3 * s, qa)
    by_r = _sum(-w3, A, 1.5 * w3 * u2 * s, c)
    for column, sign in ((a, 1.0), (b, -1.0)):
        add_outer(out, column, sign, by_r, x)
        add_outer(out, column, -0.5 * sign * w3, c, both)
    for column, own, other in ((half + a, qa, qb), (half + b, qb, qa)):
        add_cross(out, column, w * u, _sum(3.0, own, -3.5, other))
        add_outer(out, column, -0.5 * w3, c, x)


@_jit
def momentum_gradient(t, y, out, params):
    """out (3, 6 N)."""
    half = y.size // 2
    n = half // 3
    over_c2, q, v = params[n + 1], y[:half], y[half:]
    out[:] = 0.0
    for i in range(n):
        a, qi, vi = 3 * i, _body(q, i), _body(v, i)
        m = params[i] * (1.0 + 0.5 * over_c2 * _dot(vi, vi))
        add_cross(out, a, -m, vi)
        add_cross(out, half + a, m, qi)
        add_outer(out, half + a, over_c2 * params[i], _cross(qi, vi), vi)
        for j in range(i + 1, n):
            w = over_c2 * params[i] * params[j]
            _add_pair_momentum(out, a, 3 * j, half, w, qi, _body(q, j), vi, _body(v, j))
