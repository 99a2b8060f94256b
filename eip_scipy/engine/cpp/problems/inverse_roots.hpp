// Powers of 1/r without square root and division, which are slow in vectors: an estimate from the bits of r^2, a
// polynomial, a correction to full precision. All of it is integer arithmetic, multiplication, addition and fused
// multiply-add: the same bits on every processor, and multiplying all lengths by a power of two stays exact. Distances
// between 1e-100 and 1e150 will do in any unit; bodies at one place give NaN.
#pragma once

#include <limits>

#include "../lanes8.hpp"

namespace eip {

// x^-1/2 to 6.3e-7: y from the bits of x, times a minimax cubic in x y^2. The constant is the one that leaves the least
// range of x y^2, [0.912, 1.040]; the cubic is that of Remez for it.
constexpr uint64_t ESTIMATE = 0x5FE6996542967F58;
constexpr double CUBIC[] = {2.216453840039739, -2.274298221857139, 1.3991927078645605, -0.3413483382980669};

inline Vector root_estimate(Vector x) {
    static_assert(std::numeric_limits<double>::is_iec559 && sizeof(double) == sizeof(uint64_t));
    typedef uint64_t Words __attribute__((vector_size(sizeof(Vector))));
    const Vector y = (Vector)(ESTIMATE - ((Words)x >> 1));
    const Vector c = x * y * y;
    Vector p = spread_vector(CUBIC[3]);
    for (int k = 2; k >= 0; --k) p = fused(p, c, spread_vector(CUBIC[k]));
    return y * p;
}

// x^-1/2, nearly always rounded correctly: y (1 + h/2 + 3/8 h^2), h = 1 - x y^2 without the rounding of y^2. For y near it, y^2
// and 1 - x y^2.
inline Vector over_root(Vector x, Vector y, Vector y2, Vector difference) {
    const Vector h = fused(-x, fused(y, y, -y2), difference);
    return fused(y * h, fused(spread_vector(3.0 / 8.0), h, spread_vector(1.0 / 2.0)), y);
}

inline Vector over_root(Vector x) {
    const Vector y = root_estimate(x), y2 = y * y;
    return over_root(x, y, y2, fused(-x, y2, spread_vector(1.0)));
}

inline Lanes8 over_root(const Lanes8 &x) {
    Lanes8 out;
    for (int v = 0; v < VECTORS; ++v) out.part[v] = over_root(x.part[v]);
    return out;
}

// Parts of x^-3/2 shared by the two bodies of a pair: y and y^2 for y near x^-1/2, h = 1 - x y^2, and 3/2 + 15/8 h.
struct Cube {
    Lanes8 y, y2, h, p;

    explicit Cube(const Lanes8 &x) {
        for (int v = 0; v < VECTORS; ++v) y.part[v] = root_estimate(x.part[v]);
        y2 = y * y;
        h = multiply_add(-x, y2, 1.0);
        p = multiply_add(Lanes8(15.0 / 8.0), h, Lanes8(3.0 / 2.0));
    }

    // m x^-3/2 = m y^3 (1 + 3/2 h + 15/8 h^2).
    Lanes8 times(const Lanes8 &m) const {
        const Lanes8 w = m * y * y2;
        return multiply_add(w * h, p, w);
    }

    // x^-1/2 as by `over_root`.
    Lanes8 root(const Lanes8 &x) const {
        Lanes8 out;
        for (int v = 0; v < VECTORS; ++v) out.part[v] = over_root(x.part[v], y.part[v], y2.part[v], h.part[v]);
        return out;
    }

    // x^-3/2, for products with both masses of a pair.
    Lanes8 alone() const {
        const Lanes8 w = y * y2;
        return multiply_add(w * h, p, w);
    }
};

// m x^-3/2 as by `Cube`.
inline Vector over_cube(Vector x, Vector m) {
    const Vector y = root_estimate(x), y2 = y * y, h = fused(-x, y2, spread_vector(1.0)), w = m * y * y2;
    return fused(w * h, fused(spread_vector(15.0 / 8.0), h, spread_vector(3.0 / 2.0)), w);
}

}  // namespace eip
