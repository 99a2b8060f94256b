// Sums over the pairs of N bodies: Newton's accelerations and the energy, of one state or of eight members.
//
// Of one state a block of 8, 4 or 2 targets meets all bodies as sources. With less than 8 targets the lanes form 2 or 4
// streams, each with its share of the sources, added at the end. The last block overlaps the one before it, so that no
// lane reads past the arrays. Accelerations take every pair twice, once for each body: that costs less than sums across
// lanes for the reactions, and keeps the momentum as well, for r_ij and 1/r_ij^3 are the same in both, bit for bit.
// Sources are added from the last one to the first: where the first is a star, its pull is rounded once.
//
// The energy, in which large terms nearly cancel, is summed with the rounding errors carried along: what a projection
// cannot see it cannot correct.
//
// From MANY bodies on every pair is taken once, for both bodies, and threads share the rows of pairs (PairRows). The energy of
// MANY bodies can be computed together with the accelerations, which takes half as long as alone, with the same bits.
//
// With APART the accelerations come with a second sum, of all pulls but those between a body and the first one, for motion about
// the first body: what is there before its pull is added, which is the last one in its stream, and the reaction in its place.
// So the perturbations take no second pass, and no difference in which the first body's pulls would have to cancel.
#pragma once

#include <algorithm>
#include <memory>
#include <vector>

#include "../threads.hpp"
#include "../two_floats.hpp"
#include "inverse_roots.hpp"

namespace eip {

// x, y and z of as many bodies as a vector has lanes, from (x, y, z, x, y, ...).
#if defined(__AVX__)
inline void load_bodies(const double *a, Vector *xyz) {
    const Vector u = load(a), v = load(a + 4), w = load(a + 8);
    xyz[0] = __builtin_shufflevector(__builtin_shufflevector(u, v, 0, 3, 6, 6), w, 0, 1, 2, 5);
    xyz[1] = __builtin_shufflevector(__builtin_shufflevector(u, v, 1, 4, 7, 7), w, 0, 1, 2, 6);
    xyz[2] = __builtin_shufflevector(__builtin_shufflevector(u, v, 2, 5, 5, 5), w, 0, 1, 4, 7);
}

// The first `count` of them, 2 or 4. In vectors, as they are read: what is read must not wait for two stores.
template <int COUNT>
inline void store_bodies(const Vector *xyz, double *a) {
    const Vector first = __builtin_shufflevector(xyz[0], xyz[1], 0, 4, 1, 5);
    const Vector rest = __builtin_shufflevector(first, xyz[2], 3, 5, 3, 5);
    store(__builtin_shufflevector(first, xyz[2], 0, 1, 4, 2), a);
    if constexpr (COUNT == 2) {
        std::memcpy(a + 4, &rest, 2 * sizeof(double));
    } else {
        const Vector last = __builtin_shufflevector(xyz[0], xyz[1], 2, 6, 3, 7);
        store(__builtin_shufflevector(rest, last, 0, 1, 4, 5), a + 4);
        store(__builtin_shufflevector(last, xyz[2], 6, 2, 3, 7), a + 8);
    }
}

inline Vector swapped_halves(Vector v) { return __builtin_shufflevector(v, v, 2, 3, 0, 1); }
#else
inline void load_bodies(const double *a, Vector *xyz) {
    const Vector u = load(a), v = load(a + 2), w = load(a + 4);
    xyz[0] = Vector{u[0], v[1]};
    xyz[1] = Vector{u[1], w[0]};
    xyz[2] = Vector{v[0], w[1]};
}

template <int COUNT>
inline void store_bodies(const Vector *xyz, double *a) {
    for (int k = 0; k < COUNT; ++k)
        for (int c = 0; c < 3; ++c) a[3 * k + c] = xyz[c][k];
}
#endif

// x, y and z of the bodies `first` to first + TARGETS - 1, that of target k % TARGETS in lane k.
template <int TARGETS>
inline void load_targets(const double *q, int64_t first, Lanes8 *xyz) {
    const double *a = q + 3 * first;
    if constexpr (TARGETS < WIDTH) {
        for (int c = 0; c < 3; ++c)
            for (Vector &part : xyz[c].part)
                for (int k = 0; k < WIDTH; ++k) part[k] = a[3 * (k % TARGETS) + c];
    } else {
        for (int v = 0; v < VECTORS; ++v) {
            Vector parts[3];
            load_bodies(a + 3 * (v * WIDTH % TARGETS), parts);
            for (int c = 0; c < 3; ++c) xyz[c].part[v] = parts[c];
        }
    }
}

// x, y, z and G m of the bodies j, j + 1, ..., those of stream k / TARGETS in lane k.
template <int TARGETS>
inline void load_sources(const double *q, const double *gm, int64_t j, Lanes8 *xyz, Lanes8 &m) {
    const double *a = q + 3 * j;
#if defined(__AVX__)
    if constexpr (TARGETS == 2) {
        Vector of[4];
        load_bodies(a, of);
        of[3] = load(gm + j);
        Lanes8 *out[4] = {xyz, xyz + 1, xyz + 2, &m};
        for (int c = 0; c < 4; ++c) {
            out[c]->part[0] = __builtin_shufflevector(of[c], of[c], 0, 0, 1, 1);
            out[c]->part[1] = __builtin_shufflevector(of[c], of[c], 2, 2, 3, 3);
        }
        return;
    }
#endif
    for (int v = 0; v < VECTORS; ++v) {
        const int stream = v * WIDTH / TARGETS;
        for (int c = 0; c < 3; ++c) xyz[c].part[v] = spread_vector(a[3 * stream + c]);
        m.part[v] = spread_vector(gm[j + stream]);
    }
}

// The streams of each target added by halves, in the first lanes.
template <int TARGETS>
inline Lanes8 folded(Lanes8 sums) {
    for (int width = LANES / 2; width >= std::max(TARGETS, WIDTH); width /= 2)
        for (int v = 0; v < width / WIDTH; ++v) sums.part[v] += sums.part[v + width / WIDTH];
#if defined(__AVX__)
    if constexpr (TARGETS == 2) sums.part[0] += swapped_halves(sums.part[0]);
#endif
    return sums;
}

template <int TARGETS>
inline void store_targets(const Lanes8 *xyz, double *out, int64_t first) {
    Lanes8 sums[3];
    for (int c = 0; c < 3; ++c) sums[c] = folded<TARGETS>(xyz[c]);
    for (int k = 0; k < TARGETS; k += WIDTH) {
        const Vector parts[3] = {sums[0].part[k / WIDTH], sums[1].part[k / WIDTH], sums[2].part[k / WIDTH]};
        store_bodies<std::min(TARGETS, WIDTH)>(parts, out + 3 * (first + k));
    }
}

// Rows of eight lanes of 0 and 1, by number; beyond the ends as at the end.
template <int ROWS>
struct Choices {
    double row[ROWS][LANES];

    Lanes8 operator()(int64_t k) const { return Lanes8::load(row[std::clamp<int64_t>(k, 0, ROWS - 1)]); }
};

// 1 where source j of the first stream, j + 1 of the next, ... is the target in that lane; by j - first target + STREAMS.
template <int TARGETS, int STREAMS = LANES / TARGETS>
constexpr Choices<TARGETS + STREAMS + 1> ITSELF = [] {
    Choices<TARGETS + STREAMS + 1> rows{};
    for (int r = 0; r < TARGETS + STREAMS + 1; ++r)
        for (int k = 0; k < LANES; ++k) rows.row[r][k] = k % TARGETS == r - STREAMS + k / TARGETS;
    return rows;
}();

// 1 in the streams below r.
template <int TARGETS>
constexpr Choices<LANES / TARGETS + 1> STREAMS_BELOW = [] {
    Choices<LANES / TARGETS + 1> rows{};
    for (int r = 0; r <= LANES / TARGETS; ++r)
        for (int k = 0; k < LANES; ++k) rows.row[r][k] = k / TARGETS < r;
    return rows;
}();

// 1 in the lanes from k on.
constexpr Choices<LANES + 1> LANES_FROM = [] {
    Choices<LANES + 1> rows{};
    for (int r = 0; r <= LANES; ++r)
        for (int k = 0; k < LANES; ++k) rows.row[r][k] = k >= r;
    return rows;
}();

inline Lanes8 squares(const Lanes8 &x, const Lanes8 &y, const Lanes8 &z, const Lanes8 &start) {
    return multiply_add(z, z, multiply_add(y, y, multiply_add(x, x, start)));
}

// G m of the targets, in the first stream.
template <int TARGETS>
inline Lanes8 masses_of_targets(const double *gm, int64_t first) {
    if constexpr (TARGETS == LANES) return Lanes8::load(gm + first);
    Lanes8 m = 0.0;
    for (int k = 0; k < TARGETS; ++k) m.part[k / WIDTH][k % WIDTH] = gm[first + k];
    return m;
}

// Adds to `sums` the pulls of the sources j, j + 1, ..., each times `used`. With APART j is 0, and `apart` becomes the sums with
// the targets' own pulls on the first body, which it is accelerated by, in the place of its pulls.
template <int TARGETS, bool APART = false>
inline void add_sources(const double *q, const double *gm, const Lanes8 *own, int64_t j, int64_t first, Lanes8 *sums,
                        const Lanes8 &used, Lanes8 *apart = nullptr) {
    Lanes8 d[3], m;
    load_sources<TARGETS>(q, gm, j, d, m);
    for (int c = 0; c < 3; ++c) d[c] -= own[c];
    // A body's own pull is 0 / 1.
    const Lanes8 itself = ITSELF<TARGETS>(j - first + LANES / TARGETS);
    const Cube cube(squares(d[0], d[1], d[2], itself));
    if constexpr (APART) {
        const Lanes8 others = m * used * LANES_FROM(TARGETS);
        const Lanes8 w = cube.times(others - masses_of_targets<TARGETS>(gm, first));
        for (int c = 0; c < 3; ++c) apart[c] = multiply_add(w, d[c], sums[c]);
    }
    const Lanes8 w = cube.times(m * used);
    for (int c = 0; c < 3; ++c) sums[c] = multiply_add(w, d[c], sums[c]);
}

// Accelerations of the bodies `first` to first + TARGETS - 1; with APART also their pulls except those of the first body.
template <bool APART, int TARGETS>
inline void accelerate_block(const double *q, const double *gm, int64_t n, int64_t first, double *out, double *pulls) {
    constexpr int STREAMS = LANES / TARGETS;
    Lanes8 own[3], sums[3] = {0.0, 0.0, 0.0}, apart[3];
    load_targets<TARGETS>(q, first, own);
    const int64_t start = n % STREAMS, last = APART && start == 0 ? STREAMS : start;
#pragma GCC unroll 2
    for (int64_t j = n - STREAMS; j >= last; j -= STREAMS) add_sources<TARGETS>(q, gm, own, j, first, sums, 1.0);
    if (APART || start > 0) {
        const Lanes8 used = start > 0 ? STREAMS_BELOW<TARGETS>(start) : Lanes8(1.0);
        add_sources<TARGETS, APART>(q, gm, own, 0, first, sums, used, apart);
    }
    store_targets<TARGETS>(sums, out, first);
    if constexpr (APART) store_targets<TARGETS>(apart, pulls, first);
}

#if defined(__AVX__)
// The last two of 8 k + 2 bodies, by what the blocks of eight have of their pairs: r_ij changes its sign, 1/r_ij^3 is
// the same. Sums in streams, in the order in which accelerate_block<2> adds them, and so the same bits.
struct LastTwo {
    Vector sums[2][3], w[2], d[2][3];  // w and r_ij: of the two sources before those that were added last
    Vector own[2];                     // w of their own pulls on the sources of a block, of which the first counts

    // Begins with the pull of the two on each other; a body's own is 0.
    LastTwo(const double *q, const double *gm, int64_t first) {
        Lanes8 between[3];
        for (int c = 0; c < 3; ++c) between[c] = q[3 * (first + 1) + c] - q[3 * first + c];
        const Cube cube(squares(between[0], between[1], between[2], 0.0));
        for (int t = 0; t < 2; ++t) {
            const auto beside_own = [=](const Lanes8 &v) {
                return t == 0 ? __builtin_shufflevector(v.part[0], Vector{}, 4, 0, 4, 4)
                              : __builtin_shufflevector(v.part[0], Vector{}, 0, 4, 4, 4);
            };
            w[t] = beside_own(cube.times(gm[first + 1 - t]));
            for (int c = 0; c < 3; ++c) {
                d[t][c] = beside_own(t == 0 ? -between[c] : between[c]);
                sums[t][c] = Vector{};
            }
        }
    }

    // Adds the reactions of eight sources to target t, the last blocks first; `w_own` are those of its pulls on the first of them.
    void take(int t, const Lanes8 &reaction, const Lanes8 *distance, Vector w_own) {
        own[t] = w_own;
        const auto across = [](const Lanes8 &v, Vector behind) {
            return __builtin_shufflevector(v.part[1], behind, 2, 3, 4, 5);
        };
        const auto within = [](const Lanes8 &v) { return __builtin_shufflevector(v.part[0], v.part[1], 2, 3, 4, 5); };
        const Vector pull = across(reaction, w[t]);
        for (int c = 0; c < 3; ++c) {
            const Vector first = fused(-pull, across(distance[c], d[t][c]), sums[t][c]);
            sums[t][c] = fused(-within(reaction), within(distance[c]), first);
            d[t][c] = distance[c].part[0];
        }
        w[t] = reaction.part[0];
    }

    // Adds the rest, and stores both accelerations, or their pulls except those of the first body.
    template <bool APART>
    void store(int64_t first, double *out) const {
        Vector streams[6];
        const auto begin = [](Vector v) { return __builtin_shufflevector(v, Vector{}, 0, 1, 4, 5); };
        for (int t = 0; t < 2; ++t) {
            Vector last = -begin(w[t]);
            if constexpr (APART) last = __builtin_shufflevector(last, own[t], 4, 1, 2, 3);
            for (int c = 0; c < 3; ++c) streams[3 * t + c] = fused(last, begin(d[t][c]), sums[t][c]);
        }
        // (s[0] + s[2]) + (s[1] + s[3]) of each; stored in vectors, as they are read.
        const auto halves = [&](int k) {
            const Vector u = streams[k], v = streams[k + 1];
            return __builtin_shufflevector(u, v, 0, 1, 4, 5) + __builtin_shufflevector(u, v, 2, 3, 6, 7);
        };
        const Vector a = halves(0), b = halves(2), c = halves(4);
        eip::store(__builtin_shufflevector(a, b, 0, 2, 4, 6) + __builtin_shufflevector(a, b, 1, 3, 5, 7),
                   out + 3 * first);
        const Vector rest = c + __builtin_shufflevector(c, c, 1, 0, 3, 2);
        out[3 * first + 4] = rest[0];
        out[3 * first + 5] = rest[2];
    }
};

template <bool APART>
inline void accelerate_block(const double *q, const double *gm, int64_t n, int64_t first, double *out, double *pulls,
                             LastTwo &last) {
    Lanes8 own[3], sums[3] = {0.0, 0.0, 0.0}, apart[3];
    load_targets<LANES>(q, first, own);
    for (int t = 1; t >= 0; --t) {
        Lanes8 d[3], m;
        load_sources<LANES>(q, gm, n - 2 + t, d, m);
        for (int c = 0; c < 3; ++c) d[c] -= own[c];
        const Cube cube(squares(d[0], d[1], d[2], 0.0));
        const Lanes8 w = cube.times(m);
        for (int c = 0; c < 3; ++c) sums[c] = multiply_add(w, d[c], sums[c]);
        last.take(t, cube.times(Lanes8::load(gm + first)), d, w.part[0]);
    }
#pragma GCC unroll 2
    for (int64_t j = n - 3; j >= (APART ? 1 : 0); --j) add_sources<LANES>(q, gm, own, j, first, sums, 1.0);
    if constexpr (APART) add_sources<LANES, true>(q, gm, own, 0, first, sums, 1.0, apart);
    store_targets<LANES>(sums, out, first);
    if constexpr (APART) store_targets<LANES>(apart, pulls, first);
}
#endif

// Every pair once, with its reaction: for less than four bodies.
template <bool APART = false, class T>
inline void accelerate_few(const T *q, const T *gm, int64_t n, T *out, T *pulls = nullptr) {
    using std::sqrt;
    for (int64_t i = 0; i < 3 * n; ++i) out[i] = 0.0;
    for (int64_t i = n - 1; i > 0; --i) {
        T ax = out[3 * i], ay = out[3 * i + 1], az = out[3 * i + 2];
        for (int64_t j = i - 1; j >= 0; --j) {
            const T dx = q[3 * j] - q[3 * i], dy = q[3 * j + 1] - q[3 * i + 1], dz = q[3 * j + 2] - q[3 * i + 2];
            const T r2 = dx * dx + dy * dy + dz * dz;
            const T w = 1.0 / (r2 * sqrt(r2));
            const T wi = w * gm[j], wj = w * gm[i];
            if (APART && j == 0) {
                pulls[3 * i] = ax - wj * dx;
                pulls[3 * i + 1] = ay - wj * dy;
                pulls[3 * i + 2] = az - wj * dz;
            }
            ax += wi * dx;
            ay += wi * dy;
            az += wi * dz;
            out[3 * j] -= wj * dx;
            out[3 * j + 1] -= wj * dy;
            out[3 * j + 2] -= wj * dz;
        }
        out[3 * i] = ax;
        out[3 * i + 1] = ay;
        out[3 * i + 2] = az;
    }
    if constexpr (APART) std::copy(out, out + 3, pulls);
}

// A number and what its rounding left.
struct Carried {
    Lanes8 total = 0.0, carry = 0.0;

    void add_product(const Lanes8 &a, const Lanes8 &b) {
        const Lanes8 sum = multiply_add(a, b, total);
        carry += multiply_add(a, b, total - sum);
        total = sum;
    }
};

// gm (square / 2 - potential) with its carry.
inline Carried energy_of(const Lanes8 &gm, const Carried &square, const Carried &potential) {
    const PairOf<Lanes8> energy = two_sum<Lanes8>(0.5 * square.total, -potential.total);
    Carried out;
    out.add_product(gm, energy.value);
    out.carry = multiply_add(gm, energy.rest + (0.5 * square.carry - potential.carry), out.carry);
    return out;
}

// All lanes of total + carry, added by halves.
inline double carried_fold(const Carried &sum) {
    double total[LANES], carry[LANES];
    sum.total.store(total);
    sum.carry.store(carry);
    for (int width = LANES / 2; width > 0; width /= 2)
        for (int k = 0; k < width; ++k) {
            const Pair sum = two_sum(total[k], total[k + width]);
            total[k] = sum.value;
            carry[k] = (carry[k] + carry[k + width]) + sum.rest;
        }
    return total[0] + carry[0];
}

// Adds to `potential` what source j makes of it at the bodies x, each times `mass`; `start` is 1 where that is 0.
inline void add_potential(const double *q, int64_t j, const Lanes8 *x, const Lanes8 &mass, const Lanes8 &start,
                          Carried &potential) {
    Lanes8 d[3];
    for (int c = 0; c < 3; ++c) d[c] = Lanes8(q[3 * j + c]) - x[c];
    potential.add_product(mass, over_root(squares(d[0], d[1], d[2], start)));
}

// The pairs of the bodies first + skip ... first + 7, which are at x, with each other.
inline void add_own_pairs(const double *q, const double *gm, int64_t first, int64_t skip, const Lanes8 *x,
                          Carried &potential) {
    for (int64_t j = first + skip + 1; j < first + LANES; ++j) {
        // Not the body itself, nor those after it in the block, which meet this one as a source.
        const Lanes8 done = LANES_FROM(j - first);
        add_potential(q, j, x, multiply_add(Lanes8(-gm[j]), done, Lanes8(gm[j])), done, potential);
    }
}

// Their energy, with this potential.
inline double energy_of_block(const double *v, const double *gm, int64_t first, int64_t skip,
                              const Carried &potential) {
    Lanes8 u[3];
    Carried square;
    load_targets<LANES>(v, first, u);
    for (const Lanes8 &part : u) square.add_product(part, part);
    return carried_fold(energy_of(Lanes8::load(gm + first) * LANES_FROM(skip), square, potential));
}

// Their energy, with the pairs that they make with the bodies j, j + STEP, ... before `end`.
template <int STEP>
[[gnu::flatten, gnu::noinline]] inline double energy_with(const double *q, const double *v, const double *gm,
                                                          int64_t first, int64_t skip, int64_t j, int64_t end) {
    Lanes8 x[3];
    Carried potential;
    load_targets<LANES>(q, first, x);
    add_own_pairs(q, gm, first, skip, x, potential);
    for (; j != end; j += STEP) add_potential(q, j, x, gm[j], 0.0, potential);
    return energy_of_block(v, gm, first, skip, potential);
}

// The energy of 8 bodies or more, in blocks.
inline double energy_in_blocks(const double *q, const double *v, const double *gm, int64_t n) {
    double total = 0.0;
    for (int64_t block = 0; block < n; block += LANES) {
        const int64_t first = std::min(block, n - LANES);
        total += energy_with<1>(q, v, gm, first, block - first, first + LANES, n);
    }
    return total;
}

// Number of bodies from which every pair is taken once and threads share the work: with fewer bodies it does not pay.
constexpr int64_t MANY = 128;
constexpr int64_t TILE = 32;  // sources whose reactions stay in the fastest cache

// Number of the first bodies of n, MANY or more: their pulls are the last terms of all sums.
inline int64_t first_ones(int64_t n) { return LANES + n % LANES; }

// Results in addition to the accelerations: none, the pulls except those of the first body, or the energy.
enum class Also { NOTHING, PULLS, ENERGY };

// Accelerations of many bodies. The targets, in blocks of eight, form rows. A row takes its pairs with all bodies before
// them: the pulls stay with the targets, and the reactions are stored for each row. They are added afterwards, always in
// one order. The first bodies, 8 to 15, meet every body twice instead, so that their pulls, which may be the largest, are
// the last terms of all sums. The energies of the blocks are those of `energy_sum`, with the terms in its order.
template <Also ALSO>
struct PairRows {
    static constexpr bool APART = ALSO == Also::PULLS, ENERGY = ALSO == Also::ENERGY;
    const double *q, *v, *gm;  // v: for the energy
    int64_t n, first = first_ones(n);
    double *out, *pulls;
    int64_t length = ((n - first - 1) / (16 * TILE) + 1) * TILE,
            count = (n - first - 1) / length + 1;                    // at most 16 rows
    std::unique_ptr<double[]> reactions{new double[3 * n * count]};  // of every row on all bodies
    int64_t blocks = ENERGY ? (n - first) / LANES : 0;
    std::unique_ptr<Carried[]> potentials{new Carried[blocks]};
    std::unique_ptr<double[]> energies{new double[blocks]};

    // Computes all that is asked for.
    void fill() const {
        share(count + 1, [this](int64_t k) { k == 0 ? first_bodies() : take(k - 1); });
        share(count, [this](int64_t k) { finish(k); });
    }

  private:
    int64_t start(int64_t row) const { return std::min(first + row * length, n); }
    Carried &potential_of(int64_t block) const { return potentials[(block - first) / LANES]; }

    [[gnu::flatten, gnu::noinline]] void first_bodies() const {
        accelerate_block<APART, LANES>(q, gm, n, 0, out, pulls);
        accelerate_block<APART, LANES>(q, gm, n, first - LANES, out, pulls);
    }

    [[gnu::flatten, gnu::noinline]] void take(int64_t row) const {
        for (int64_t block = start(row); block < start(row + 1); block += LANES) {
            Lanes8 own[3], sums[3] = {0.0, 0.0, 0.0};
            load_targets<LANES>(q, block, own);
            for (int64_t j = block + LANES - 1; j >= block; --j) add_sources<LANES>(q, gm, own, j, block, sums, 1.0);
            store_targets<LANES>(sums, out, block);
            if constexpr (ENERGY) add_own_pairs(q, gm, block, 0, own, potential_of(block));
        }
        for (int64_t tile = start(row + 1) - 1 - (start(row + 1) - 1 - first) % TILE; tile >= first; tile -= TILE)
            meet(row, tile);
    }

    // The targets of a row with the sources of a tile before them. Of the reactions four lanes are kept.
    void meet(int64_t row, int64_t tile) const {
        constexpr int KEPT = VECTORS / 2;
        Vector kept[TILE][3][KEPT] = {};
        for (int64_t block = std::max(start(row), tile); block < start(row + 1); block += LANES) {
            Lanes8 own[3], sums[3];
            Carried potential;
            load_targets<LANES>(q, block, own);
            load_targets<LANES>(out, block, sums);
            if constexpr (ENERGY) potential = potential_of(block);
            const Lanes8 masses = -Lanes8::load(gm + block);
            for (int64_t j = std::min(tile + TILE, block) - 1; j >= tile; --j) {
                Lanes8 d[3];
                for (int c = 0; c < 3; ++c) d[c] = Lanes8(q[3 * j + c]) - own[c];
                const Lanes8 r2 = squares(d[0], d[1], d[2], 0.0);
                const Cube powers(r2);
                if constexpr (ENERGY) potential.add_product(gm[j], powers.root(r2));
                const Lanes8 cube = powers.alone(), w = cube * gm[j], back = cube * masses;
                for (int c = 0; c < 3; ++c) {
                    sums[c] = multiply_add(w, d[c], sums[c]);
                    Vector *sum = kept[j - tile][c];
                    for (int v = 0; v < VECTORS; ++v) sum[v % KEPT] = fused(back.part[v], d[c].part[v], sum[v % KEPT]);
                }
            }
            store_targets<LANES>(sums, out, block);
            if constexpr (ENERGY) potential_of(block) = potential;
        }
        for (int64_t j = tile; j < std::min(tile + TILE, n); ++j)
            for (int c = 0; c < 3; ++c) {
                double lane[4];
                std::memcpy(lane, kept[j - tile][c], sizeof lane);
                reactions[3 * (n * row + j) + c] = (lane[0] + lane[2]) + (lane[1] + lane[3]);
            }
    }

    // Adds the reactions of the later bodies and the pulls of the first ones.
    [[gnu::flatten, gnu::noinline]] void finish(int64_t row) const {
        for (int64_t block = start(row); block < start(row + 1); block += LANES) {
            Lanes8 own[3], sums[3], apart[3];
            for (int64_t k = count - 1; k >= row; --k)
                for (int64_t i = 3 * block; i < 3 * (block + LANES); ++i) out[i] += reactions[3 * n * k + i];
            load_targets<LANES>(q, block, own);
            load_targets<LANES>(out, block, sums);
            for (int64_t j = first - 1; j >= (APART ? 1 : 0); --j) add_sources<LANES>(q, gm, own, j, block, sums, 1.0);
            if constexpr (APART) add_sources<LANES, true>(q, gm, own, 0, block, sums, 1.0, apart);
            store_targets<LANES>(sums, out, block);
            if constexpr (APART) store_targets<LANES>(apart, pulls, block);
            if constexpr (ENERGY) {
                Carried &potential = potential_of(block);
                for (int64_t j = first - 1; j >= 0; --j) add_potential(q, j, own, gm[j], 0.0, potential);
                energies[(block - first) / LANES] = energy_of_block(v, gm, block, 0, potential);
            }
        }
    }
};

template <bool APART>
[[gnu::noinline]] inline void accelerate_many(const double *q, const double *gm, int64_t n, double *out,
                                              double *pulls) {
    PairRows<APART ? Also::PULLS : Also::NOTHING>{.q = q, .gm = gm, .n = n, .out = out, .pulls = pulls}.fill();
}

// Calls visit<TARGETS>(first) for blocks of targets that cover 4 bodies or more; a block may overlap the one before it.
template <class Visit>
[[gnu::always_inline]] inline void in_targets(int64_t n, const Visit &visit) {
    if (n < 8) {
        visit.template operator()<4>(0);
        if (n > 4) visit.template operator()<4>(n - 4);
        return;
    }
    const int64_t rest = n % 8;
    for (int64_t k = 0; k < n / 8 + (rest > 4); ++k) visit.template operator()<8>(std::min(8 * k, n - 8));
    if (2 < rest && rest <= 4)
        visit.template operator()<4>(n - 4);
    else if (0 < rest && rest <= 2)
        visit.template operator()<2>(n - 2);
}

template <bool APART>
inline void accelerate_all(const double *q, const double *gm, int64_t n, double *out, double *pulls) {
    if (n >= MANY) return accelerate_many<APART>(q, gm, n, out, pulls);
    if (n < 4) return accelerate_few<APART>(q, gm, n, out, pulls);
#if defined(__AVX__)
    if (n >= 8 && n % 8 == 2) {
        LastTwo last(q, gm, n - 2);
        for (int64_t first = n - 10; first >= 0; first -= 8) accelerate_block<APART>(q, gm, n, first, out, pulls, last);
        last.store<false>(n - 2, out);
        if constexpr (APART) last.store<true>(n - 2, pulls);
        return;
    }
#endif
    in_targets(n, [&]<int TARGETS>(int64_t first) { accelerate_block<APART, TARGETS>(q, gm, n, first, out, pulls); });
}

// out (3 n) = sum over the other bodies of gm_j (q_j - q_i) / r^3.
// As one function: of those that it calls the compiler would leave some by themselves, and their sums in memory.
[[gnu::flatten, gnu::noinline]] inline void accelerate(const double *q, const double *gm, int64_t n, double *out) {
    accelerate_all<false>(q, gm, n, out, nullptr);
}

// Computes the accelerations of `accelerate`, bit for bit, and pulls (3 n): for the first body its acceleration; for
// any other body the pulls of all bodies except the first, plus the acceleration of the first body by this one. The
// difference of both is what perturbs the motion about the first body.
[[gnu::flatten, gnu::noinline]] inline void accelerate_apart(const double *q, const double *gm, int64_t n, double *out,
                                                             double *pulls) {
    accelerate_all<true>(q, gm, n, out, pulls);
}

// Index of the first body whose sources `accelerate` takes in streams, and the number of streams.
struct Streams {
    int64_t first, count;

    explicit Streams(int64_t n) : first(n), count(1) {
        const int64_t rest = n % 8;
        if (n < 8)
            first = 0, count = 2;
        else if (2 < rest && rest <= 4)
            first = n - 4, count = 2;
        else if (0 < rest && rest <= 2)
            first = n - 2, count = 4;
    }
};

inline void add_pull(const Lanes8 &w, const Lanes8 *d, Lanes8 *out) {
    for (int c = 0; c < 3; ++c) out[c] = multiply_add(w, d[c], out[c]);
}

inline Lanes8 difference(const Lanes8 *q, int64_t i, int64_t j, Lanes8 *d) {
    for (int c = 0; c < 3; ++c) d[c] = q[3 * j + c] - q[3 * i + c];
    return multiply_add(d[2], d[2], multiply_add(d[1], d[1], d[0] * d[0]));
}

// Many bodies of eight members, one member after the other: a vector holds eight bodies of one member then. one(state, masses,
// result) fills `results` numbers from a state of `size`.
template <class One>
inline void one_by_one(const Lanes8 *y, int64_t size, const Lanes8 *gm, int64_t n, Lanes8 *out, int64_t results,
                       const One &one) {
    std::vector<double> own(size + n + results);
    double *state = own.data(), *mass = state + size, *result = mass + n;
    const auto *states = reinterpret_cast<const double *>(y), *masses = reinterpret_cast<const double *>(gm);
    for (int64_t lane = 0; lane < LANES; ++lane) {
        for (int64_t i = 0; i < size; ++i) state[i] = states[LANES * i + lane];
        for (int64_t i = 0; i < n; ++i) mass[i] = masses[LANES * i + lane];
        one(state, mass, result);
        for (int64_t i = 0; i < results; ++i) reinterpret_cast<double *>(out)[LANES * i + lane] = result[i];
    }
}

[[gnu::noinline]] inline void accelerate_each(const Lanes8 *q, const Lanes8 *gm, int64_t n, Lanes8 *out) {
    one_by_one(q, 3 * n, gm, n, out, 3 * n,
               [n](const double *place, const double *mass, double *pull) { accelerate(place, mass, n, pull); });
}

// Computes the accelerations for eight members: every pair once, and sums in the same order as for one state. Bodies
// that are in the last block of one state get their sums in streams: the sums of body i begin at index 3 streams (i -
// first) of `sums`.
inline void accelerate(const Lanes8 *q, const Lanes8 *gm, int64_t n, Lanes8 *out) {
    if (n >= MANY) return accelerate_each(q, gm, n, out);
    if (n < 4) return accelerate_few(q, gm, n, out);
    const Streams streams(n);
    const int64_t start = n % streams.count;
    Lanes8 sums[3 * 2 * 7];  // in streams, at seven bodies
    const auto place = [&](int64_t body, int64_t other) {
        if (body < streams.first) return out + 3 * body;
        const int64_t stream = other < start ? other : (other - start) % streams.count;
        return sums + 3 * (streams.count * (body - streams.first) + stream);
    };
    std::fill(out, out + 3 * n, 0.0);
    std::fill(sums, sums + 3 * streams.count * (n - streams.first), 0.0);
    for (int64_t i = n - 1; i > 0; --i)
        for (int64_t j = i - 1; j >= 0; --j) {
            Lanes8 d[3];
            const Cube cube(difference(q, i, j, d));
            add_pull(cube.times(gm[j]), d, place(i, j));
            add_pull(-cube.times(gm[i]), d, place(j, i));
        }
    for (int64_t i = streams.first; i < n; ++i)
        for (int c = 0; c < 3; ++c) {
            const Lanes8 *s = sums + 3 * streams.count * (i - streams.first) + c;
            out[3 * i + c] = streams.count == 4 ? (s[0] + s[6]) + (s[3] + s[9]) : s[0] + s[3];
        }
}

template <class T>
inline T energy_of_few(const T *y, const T *gm, int64_t n) {
    using std::sqrt;
    const T *v = y + 3 * n;
    T kinetic = 0.0, potential = 0.0;
    for (int64_t i = 0; i < n; ++i) {
        const T vx = v[3 * i], vy = v[3 * i + 1], vz = v[3 * i + 2];
        kinetic += gm[i] * (vx * vx + vy * vy + vz * vz);
        T partial = 0.0;
        for (int64_t j = i + 1; j < n; ++j) {
            const T dx = y[3 * j] - y[3 * i], dy = y[3 * j + 1] - y[3 * i + 1], dz = y[3 * j + 2] - y[3 * i + 2];
            partial += gm[j] / sqrt(dx * dx + dy * dy + dz * dz);
        }
        potential += gm[i] * partial;
    }
    return 0.5 * kinetic - potential;
}

// The energy of many bodies: that of the first ones, and of the others in blocks, which are added in one order, whatever threads
// find them.
inline double total_energy(const double *q, const double *v, const double *gm, int64_t first, const double *energies,
                           int64_t blocks) {
    double total = energy_in_blocks(q, v, gm, first);
    for (int64_t k = 0; k < blocks; ++k) total += energies[k];
    return total;
}

// G times the energy.
inline double energy_sum(const double *y, const double *gm, int64_t n) {
    const double *v = y + 3 * n;
    if (n < 8) return energy_of_few(y, gm, n);
    if (n < MANY) return energy_in_blocks(y, v, gm, n);
    const int64_t first = first_ones(n), blocks = (n - first) / LANES, parts = (blocks + 3) / 4;
    std::vector<double> energies(blocks);
    share(parts, [&](int64_t k) {  // the last blocks have most pairs, and the last parts begin first
        for (int64_t block = 4 * k; block < std::min(4 * k + 4, blocks); ++block)
            energies[block] = energy_with<-1>(y, v, gm, first + LANES * block, 0, first + LANES * block - 1, -1);
    });
    return total_energy(y, v, gm, first, energies.data(), blocks);
}

// Computes the accelerations of `accelerate`, bit for bit, for MANY bodies or more. Returns what `energy_sum` does, bit for bit.
inline double accelerate_with_energy(const double *y, const double *gm, int64_t n, double *out) {
    const double *v = y + 3 * n;
    const PairRows<Also::ENERGY> rows{.q = y, .v = v, .gm = gm, .n = n, .out = out};
    rows.fill();
    return total_energy(y, v, gm, rows.first, rows.energies.get(), rows.blocks);
}

// Returns the energy of body i with its later partners, for eight members. The bodies' energies are added in the order
// in which the code for one state adds its lanes.
inline Carried energy_of_body(const Lanes8 *y, const Lanes8 *gm, int64_t n, int64_t i) {
    Carried square, potential;
    for (int64_t j = i + 1; j < n; ++j) {
        Lanes8 d[3];
        const Lanes8 r2 = difference(y, i, j, d);
        potential.add_product(gm[j], over_root(r2));
    }
    for (int64_t k = 3 * (n + i); k < 3 * (n + i) + 3; ++k) square.add_product(y[k], y[k]);
    return energy_of(gm[i], square, potential);
}

// Bodies k, k + stride, ... of a block of eight, added by halves.
inline Carried energy_of_some(const Lanes8 *y, const Lanes8 *gm, int64_t n, int64_t first, int64_t skip, int k,
                              int stride) {
    if (stride == LANES) return k >= skip ? energy_of_body(y, gm, n, first + k) : Carried{};
    const Carried a = energy_of_some(y, gm, n, first, skip, k, 2 * stride);
    const Carried b = energy_of_some(y, gm, n, first, skip, k + stride, 2 * stride);
    const PairOf<Lanes8> sum = two_sum(a.total, b.total);
    return {sum.value, (a.carry + b.carry) + sum.rest};
}

inline Lanes8 energy_sum(const Lanes8 *y, const Lanes8 *gm, int64_t n) {
    if (n < 8) return energy_of_few(y, gm, n);
    Lanes8 total = 0.0;
    if (n >= MANY) {
        one_by_one(y, 6 * n, gm, n, &total, 1, [n](const double *state, const double *mass, double *energy) {
            *energy = energy_sum(state, mass, n);
        });
        return total;
    }
    const auto block = [&](int64_t first, int64_t skip) {
        const Carried sum = energy_of_some(y, gm, n, first, skip, 0, 1);
        total += sum.total + sum.carry;
    };
    for (int64_t first = 0; first < n - 7; first += 8) block(first, 0);
    if (n % 8 > 0) block(n - 8, 8 - n % 8);
    return total;
}

}  // namespace eip
