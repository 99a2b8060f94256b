// Newton's gravitation of a state with columns of derivatives behind it.
//
// A column moves body i by the sum over the others of G m_j (dx / r^3 - 3 (x . dx) x / r^5), x = q_j - q_i and dx its
// change. As in pair_sums.hpp blocks of targets meet all bodies as sources, and the state's accelerations are added by the
// same operations in the same order: they have the same bits. What belongs to a pair is computed once for all columns.
#pragma once

#include <vector>

#include "newton.hpp"

namespace eip {

// The terms of one source, or of one in each stream, at a block of targets: q_j - q_i, G m / r^3 and 3 G m / r^5.
struct Tide {
    Lanes8 way[3], pull, radial;

    // The change of the targets' accelerations by that of the way to the source.
    void add(const Lanes8 *change, Lanes8 *sums) const {
        const Lanes8 along =
            radial * multiply_add(way[2], change[2], multiply_add(way[1], change[1], way[0] * change[0]));
        for (int c = 0; c < 3; ++c) sums[c] = multiply_add(-along, way[c], multiply_add(pull, change[c], sums[c]));
    }
};

// From q_j - q_i of both; `itself` is 1 where the source is the target.
inline Tide tide_of(const Lanes8 *way, const Lanes8 &m, const Lanes8 &itself) {
    const Cube cube(squares(way[0], way[1], way[2], itself));
    Tide tide{{way[0], way[1], way[2]}, cube.times(m), {}};
    // 1/r^2 = y^2 / (1 - h) = y^2 (1 + h + h^2), to the last bit: h is below 2e-6.
    const Lanes8 over_square = multiply_add(cube.y2 * cube.h, cube.h + 1.0, cube.y2);
    tide.radial = 3.0 * tide.pull * over_square;
    return tide;
}

// The sources j of a block of targets in the order of accelerate_block: visit(j, what of each stream is used).
template <int TARGETS, class Visit>
inline void for_sources(int64_t n, const Visit &visit) {
    constexpr int STREAMS = LANES / TARGETS;
    const int64_t start = n % STREAMS;
    for (int64_t j = n - STREAMS; j >= start; j -= STREAMS) visit(j, Lanes8(1.0));
    if (start > 0) visit(0, STREAMS_BELOW<TARGETS>(start));
}

// Accelerations of the bodies `first` to first + TARGETS - 1, and their derivatives along the columns. `tides` holds as
// many as there are bodies.
template <int TARGETS>
inline void tidal_block(const double *y, const double *gm, int64_t n, int64_t first, int64_t columns, double *out,
                        Tide *tides) {
    Lanes8 own[3], sums[3] = {0.0, 0.0, 0.0}, d[3], m;
    load_targets<TARGETS>(y, first, own);
    Tide *tide = tides;
    for_sources<TARGETS>(n, [&](int64_t j, const Lanes8 &used) {
        load_sources<TARGETS>(y, gm, j, d, m);
        for (int c = 0; c < 3; ++c) d[c] -= own[c];
        *tide = tide_of(d, m * used, ITSELF<TARGETS>(j - first + LANES / TARGETS));
        for (int c = 0; c < 3; ++c) sums[c] = multiply_add(tide->pull, d[c], sums[c]);
        ++tide;
    });
    store_targets<TARGETS>(sums, out + 3 * n, first);
    for (int64_t k = 1; k <= columns; ++k) {
        const double *column = y + 6 * n * k;
        load_targets<TARGETS>(column, first, own);
        for (Lanes8 &sum : sums) sum = 0.0;
        tide = tides;
        for_sources<TARGETS>(n, [&](int64_t j, const Lanes8 &) {
            load_sources<TARGETS>(column, gm, j, d, m);
            for (int c = 0; c < 3; ++c) d[c] -= own[c];
            tide++->add(d, sums);
        });
        store_targets<TARGETS>(sums, out + 6 * n * k + 3 * n, first);
    }
}

// Computes accelerations and their derivatives along the columns for fewer than four bodies.
template <class T>
inline void tides_of_few(const T *y, const T *gm, int64_t n, int64_t columns, T *out) {
    using std::sqrt;
    const int64_t half = 3 * n, size = 6 * n;
    accelerate_few(y, gm, n, out + half);
    for (int64_t k = 1; k <= columns; ++k) std::fill(out + size * k + half, out + size * (k + 1), T(0.0));
    for (int64_t i = 1; i < n; ++i)
        for (int64_t j = 0; j < i; ++j) {
            T x[3], r2 = 0.0;
            for (int c = 0; c < 3; ++c) {
                x[c] = y[3 * j + c] - y[3 * i + c];
                r2 += x[c] * x[c];
            }
            const T inverse = 1.0 / r2, w = inverse * sqrt(inverse), radial = 3.0 * w * inverse;
            for (int64_t k = 1; k <= columns; ++k) {
                const T *a = y + size * k + 3 * i, *b = y + size * k + 3 * j;
                T *onto_a = out + size * k + half + 3 * i, *onto_b = out + size * k + half + 3 * j;
                const T d[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
                const T along = radial * (x[0] * d[0] + x[1] * d[1] + x[2] * d[2]);
                for (int c = 0; c < 3; ++c) {
                    const T change = w * d[c] - along * x[c];
                    onto_a[c] += gm[j] * change;
                    onto_b[c] -= gm[i] * change;
                }
            }
        }
}

[[gnu::flatten, gnu::noinline]] inline void tides_of_many(const double *y, const double *gm, int64_t n, int64_t columns,
                                                          double *out, Tide *tides) {
    in_targets(n, [&]<int TARGETS>(int64_t first) { tidal_block<TARGETS>(y, gm, n, first, columns, out, tides); });
}

// out = (f, Df times each column) of y = (state, columns), 6 n numbers each.
inline void newton_variational(const double *y, const double *gm, int64_t n, int64_t columns, double *out) {
    for (int64_t k = 0; k <= columns; ++k) std::copy(y + 6 * n * k + 3 * n, y + 6 * n * (k + 1), out + 6 * n * k);
    constexpr int64_t FEW = 16;
    if (n < 4) {
        tides_of_few(y, gm, n, columns, out);
    } else if (n <= FEW) {
        Tide tides[FEW];
        tides_of_many(y, gm, n, columns, out, tides);
    } else {
        std::vector<Tide> tides(n);
        tides_of_many(y, gm, n, columns, out, tides.data());
    }
}

// Does so for eight members: in vectors for few bodies, otherwise one after the other.
inline void newton_variational(const Lanes8 *y, const Lanes8 *gm, int64_t n, int64_t columns, Lanes8 *out) {
    if (n < 4) {
        for (int64_t k = 0; k <= columns; ++k) std::copy(y + 6 * n * k + 3 * n, y + 6 * n * (k + 1), out + 6 * n * k);
        return tides_of_few(y, gm, n, columns, out);
    }
    const int64_t size = 6 * n * (1 + columns);
    std::vector<double> own(size), masses(n), found(size);
    for (int lane = 0; lane < LANES; ++lane) {
        for (int64_t i = 0; i < size; ++i) own[i] = y[i].lane(lane);
        for (int64_t i = 0; i < n; ++i) masses[i] = gm[i].lane(lane);
        newton_variational(own.data(), masses.data(), n, columns, found.data());
        for (int64_t i = 0; i < size; ++i) reinterpret_cast<double *>(out + i)[lane] = found[i];
    }
}

}  // namespace eip
