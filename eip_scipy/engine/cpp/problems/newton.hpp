// N bodies under Newton's gravitation, with positions q and velocities v as state (q, v); all but the derivative times G.
#pragma once

#include "../library.hpp"
#include "../values.hpp"
#include "pair_sums.hpp"

namespace eip {

template <class T>
inline void newton_rhs(const T *y, const T *gm, int64_t bodies, T *out) {
    std::copy(y + 3 * bodies, y + 6 * bodies, out);
    accelerate(y, gm, bodies, out + 3 * bodies);
}

// The accelerations' derivative along dq, as far as the heaviest body makes it, for the bodies that dq moves; with their
// reactions on that body. Of eight members each may have another heaviest one.
template <class T>
inline void central_jacobian(const T *q, const T *dq, const T *gm, int64_t bodies, T *out) {
    T mass = gm[0], centre = 0.0, place[3], kick[3], reaction[3];
    for (int c = 0; c < 3; ++c) {
        place[c] = q[c];
        kick[c] = dq[c];
        reaction[c] = 0.0;
    }
    for (int64_t k = 1; k < bodies; ++k) {
        const Truth<T> heavier = gm[k] > mass;
        if (!any(heavier)) continue;
        mass = where(heavier, gm[k], mass);
        centre = where(heavier, static_cast<double>(k), centre);
        for (int c = 0; c < 3; ++c) {
            place[c] = where(heavier, q[3 * k + c], place[c]);
            kick[c] = where(heavier, dq[3 * k + c], kick[c]);
        }
    }
    for (int64_t k = 0; k < bodies; ++k) {
        const T *d = dq + 3 * k;
        T *change = out + 3 * k;
        const Truth<T> rests = (d[0] == 0.0) & (d[1] == 0.0) & (d[2] == 0.0);
        const Truth<T> moves = !(rests | (centre == static_cast<double>(k)));
        if (!any(moves)) {
            for (int c = 0; c < 3; ++c) change[c] = 0.0;
            continue;
        }
        T r[3], moved[3], square = 0.0, along = 0.0;
        for (int c = 0; c < 3; ++c) {
            r[c] = q[3 * k + c] - place[c];
            moved[c] = d[c] - kick[c];
            square += r[c] * r[c];
            along += r[c] * moved[c];
        }
        const T tidal = mass / (square * sqrt(square)), radial = 3.0 * along / square;
        for (int c = 0; c < 3; ++c) {
            change[c] = where(moves, tidal * (radial * r[c] - moved[c]), 0.0);
            reaction[c] = where(moves, reaction[c] - gm[k] / mass * change[c], reaction[c]);
        }
    }
    for (int64_t k = 0; k < bodies; ++k) {
        const Truth<T> is_centre = centre == static_cast<double>(k);
        if (!any(is_centre)) continue;
        for (int c = 0; c < 3; ++c) out[3 * k + c] = where(is_centre, reaction[c], out[3 * k + c]);
    }
}

// From the derivative f of the state.
template <class T>
inline void energy_gradient(const T *y, const T *f, const T *gm, int64_t bodies, T *out) {
    const int64_t half = 3 * bodies;
    for (int64_t i = 0; i < half; ++i) {
        out[i] = -gm[i / 3] * f[half + i];
        out[half + i] = gm[i / 3] * y[half + i];
    }
}

template <class T>
inline void angular_momentum(const T *y, const T *gm, int64_t bodies, T *out) {
    T lx = 0.0, ly = 0.0, lz = 0.0;
    for (int64_t i = 0; i < bodies; ++i) {
        const T *q = y + 3 * i, *v = q + 3 * bodies;
        lx += gm[i] * (q[1] * v[2] - q[2] * v[1]);
        ly += gm[i] * (q[2] * v[0] - q[0] * v[2]);
        lz += gm[i] * (q[0] * v[1] - q[1] * v[0]);
    }
    out[0] = lx;
    out[1] = ly;
    out[2] = lz;
}

// Rows (3, 6 N): row c holds the component c of d(q x v), +-gm times the other two components of v and q.
template <class T>
inline void angular_momentum_gradient(const T *y, const T *gm, int64_t bodies, T *out) {
    const int64_t half = 3 * bodies, n = 6 * bodies;
    T *X = out, *Y = out + n, *Z = out + 2 * n;
    for (int64_t i = 0; i < bodies; ++i) {
        const int64_t a = 3 * i, b = half + a;
        const T px = gm[i] * y[b], py = gm[i] * y[b + 1], pz = gm[i] * y[b + 2];
        const T qx = gm[i] * y[a], qy = gm[i] * y[a + 1], qz = gm[i] * y[a + 2];
        X[a] = 0.0, X[a + 1] = pz, X[a + 2] = -py;
        Y[a] = -pz, Y[a + 1] = 0.0, Y[a + 2] = px;
        Z[a] = py, Z[a + 1] = -px, Z[a + 2] = 0.0;
        X[b] = 0.0, X[b + 1] = -qz, X[b + 2] = qy;
        Y[b] = qz, Y[b + 1] = 0.0, Y[b + 2] = -qx;
        Z[b] = -qy, Z[b + 1] = qx, Z[b + 2] = 0.0;
    }
}

}  // namespace eip
