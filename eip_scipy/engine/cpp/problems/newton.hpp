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

// The change of a body's pull towards a centre of this mass, at the distance r, by `moved`.
template <class V>
inline void tidal_change(const V &mass, const V *r, const V *moved, V *change) {
    const V square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
    const V along = r[0] * moved[0] + r[1] * moved[1] + r[2] * moved[2];
    const V tidal = mass / (square * sqrt(square)), radial = 3.0 * along / square;
    for (int c = 0; c < 3; ++c) change[c] = tidal * (radial * r[c] - moved[c]);
}

// The accelerations' derivative along dq, as far as the heaviest body makes it, for the bodies that dq moves; with their
// reactions on that body. Of eight members each may have another heaviest one.
template <class T>
inline void central_one_by_one(const T *q, const T *dq, const T *gm, int64_t bodies, T *out) {
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
        const Truth<T> rests = (d[0] == 0.0) & (d[1] == 0.0) & (d[2] == 0.0);
        const Truth<T> moves = !(rests | (centre == static_cast<double>(k)));
        if (!any(moves)) {
            std::fill(out + 3 * k, out + 3 * k + 3, T(0.0));
            continue;
        }
        T r[3], moved[3], change[3];
        for (int c = 0; c < 3; ++c) {
            r[c] = q[3 * k + c] - place[c];
            moved[c] = d[c] - kick[c];
        }
        tidal_change(mass, r, moved, change);
        for (int c = 0; c < 3; ++c) {
            out[3 * k + c] = where(moves, change[c], 0.0);
            reaction[c] = where(moves, reaction[c] - gm[k] / mass * change[c], reaction[c]);
        }
    }
    for (int64_t k = 0; k < bodies; ++k) {
        const Truth<T> is_centre = centre == static_cast<double>(k);
        if (!any(is_centre)) continue;
        for (int c = 0; c < 3; ++c) out[3 * k + c] = where(is_centre, reaction[c], out[3 * k + c]);
    }
}

inline void central_jacobian(const Lanes8 *q, const Lanes8 *dq, const Lanes8 *gm, int64_t bodies, Lanes8 *out) {
    central_one_by_one(q, dq, gm, bodies, out);
}

// Does the same for one state. A vector holds as many bodies as it has lanes, the last one several times.
inline void central_jacobian(const double *q, const double *dq, const double *gm, int64_t bodies, double *out) {
    if (bodies <= 2) return central_one_by_one(q, dq, gm, bodies, out);
    const int64_t centre = std::max_element(gm, gm + bodies) - gm;
    const Vector mass = spread_vector(gm[centre]);
    double reaction[3] = {}, changes[3][WIDTH], reactions[3][WIDTH];
    for (int64_t first = 0; first < bodies; first += WIDTH) {
        Vector r[3], d[3], moved[3], change[3], share, index;
        for (int lane = 0; lane < WIDTH; ++lane) {
            const int64_t k = std::min(first + lane, bodies - 1);
            share[lane] = gm[k];
            index[lane] = static_cast<double>(first + lane);
            for (int c = 0; c < 3; ++c) r[c][lane] = q[3 * k + c], d[c][lane] = dq[3 * k + c];
        }
        const Bits moves = ((d[0] != 0.0) | (d[1] != 0.0) | (d[2] != 0.0)) & (index != static_cast<double>(centre)) &
                           (index < static_cast<double>(bodies));
        for (int c = 0; c < 3; ++c) {
            r[c] -= q[3 * centre + c];
            moved[c] = d[c] - dq[3 * centre + c];
        }
        tidal_change(mass, r, moved, change);
        for (int c = 0; c < 3; ++c) {
            const Vector own = moves ? change[c] : Vector{};
            store(own, changes[c]);
            store(share / mass * own, reactions[c]);
        }
        for (int lane = 0; lane < WIDTH; ++lane)
            for (int c = 0; c < 3; ++c) {
                reaction[c] -= reactions[c][lane];
                if (first + lane < bodies) out[3 * (first + lane) + c] = changes[c][lane];
            }
    }
    std::copy(reaction, reaction + 3, out + 3 * centre);
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
