// The Gross-Pitaevskii equation point by point, and sums over its fields.
//
// Sums are those of blocks of a few hundred points, each in lanes of its own: the same bits on every machine, and the
// error of a sum over a few hundred numbers, not of one over all.
#include "../module.hpp"

#include <nanobind/stl/array.h>

#include <optional>

#include "../sums.hpp"

namespace eip {
namespace {

// An array argument with any number of axes, of floats or, if COMPLEX, of complex numbers. `columns` is the length of its last
// axis.
template <class T, bool COMPLEX>
struct PointsOf {
    static constexpr auto TEXT = nb::detail::const_name<COMPLEX>("numpy.typing.NDArray[numpy.complex128]",
                                                                 "numpy.typing.NDArray[numpy.float64]");
    T *data;
    npy_intp points, columns;

    operator PointsOf<const T, COMPLEX>() const { return {data, points, columns}; }

    bool take(PyObject *object) {
        auto *array = reinterpret_cast<PyArrayObject *>(object);
        if (!PyArray_Check(object) || PyArray_TYPE(array) != (COMPLEX ? NPY_CDOUBLE : NPY_DOUBLE)) return false;
        if (PyArray_NDIM(array) == 0 || !PyArray_ISCARRAY_RO(array)) return false;
        data = static_cast<T *>(PyArray_DATA(array));
        points = PyArray_SIZE(array);
        columns = PyArray_DIM(array, PyArray_NDIM(array) - 1);
        return std::is_const_v<T> || PyArray_ISWRITEABLE(array);
    }
};

using Field = PointsOf<double, true>;
using ConstField = PointsOf<const double, true>;
using ConstReals = PointsOf<const double, false>;

template <class First, class... Others>
void require_one_length(const First &first, const Others &...others) {
    require(((first.points == others.points) && ...), "expected arrays with the same number of points");
}

// Lets other threads run while a large array is worked on.
class [[maybe_unused]] Released {
  public:
    explicit Released(npy_intp points) {
        if (points >= 1 << 14) released_.emplace();
    }

  private:
    std::optional<WithoutLock> released_;
};

constexpr npy_intp BLOCK = 512;  // floats

// Pointwise terms.

// True if a real factor stands for each row, (rows, 1), false for one of each point.
bool is_by_rows(ConstField field, ConstReals factor, const char *otherwise) {
    const bool by_rows = factor.columns == 1 && factor.points * field.columns == field.points;
    require(by_rows || factor.points == field.points, otherwise);
    return by_rows;
}

// Times real factors.
void multiply(Field field, ConstReals factor) {
    const npy_intp columns = field.columns;
    const bool by_rows = is_by_rows(field, factor, "multiply: expected a factor for each point, or row");
    const Released released(field.points);
    double *z = field.data;
    if (!by_rows) {
        for (npy_intp i = 0; i < field.points; ++i) {
            z[2 * i] *= factor.data[i];
            z[2 * i + 1] *= factor.data[i];
        }
        return;
    }
    for (npy_intp r = 0; r < factor.points; ++r, z += 2 * columns)
        for (npy_intp i = 0; i < 2 * columns; ++i) z[i] *= factor.data[r];
}

// out = -i (out + (V + beta |psi|^2) psi), where `whole` adds to a float of out what else belongs to it.
template <class Whole>
void turned_derivative(ConstField psi, ConstReals V, double beta, Field out, Whole whole) {
    const Released released(psi.points);
    for (npy_intp i = 0; i < psi.points; ++i) {
        const double a = psi.data[2 * i], b = psi.data[2 * i + 1];
        const double v = V.data[i] + beta * (a * a + b * b);
        const double re = whole(2 * i) + v * a, im = whole(2 * i + 1) + v * b;
        out.data[2 * i] = im;
        out.data[2 * i + 1] = -re;
    }
}

// out = -i (out + rest + (V + beta |psi|^2) psi).
void derivative(ConstField rest, ConstField psi, ConstReals V, double beta, Field out) {
    require_one_length(rest, psi, V, out);
    turned_derivative(psi, V, beta, out, [&](npy_intp i) { return out.data[i] + rest.data[i]; });
}

// out = -i (out + (V + beta |psi|^2) psi).
void derivative_at_once(ConstField psi, ConstReals V, double beta, Field out) {
    require_one_length(psi, V, out);
    turned_derivative(psi, V, beta, out, [&](npy_intp i) { return out.data[i]; });
}

// out = i factor f.
void turn(ConstField f, double factor, Field out) {
    require_one_length(f, out);
    const Released released(f.points);
    for (npy_intp i = 0; i < f.points; ++i) {
        const double re = f.data[2 * i], im = f.data[2 * i + 1];
        out.data[2 * i] = -factor * im;
        out.data[2 * i + 1] = factor * re;
    }
}

// Sums. Complex numbers in vectors are pairs of floats.
//
// Products are written so because GCC 12 and later fuse the two halves of a loop over a c - b d and a d + b c into one
// operation (vfmaddsub) in spite of -ffp-contract=off: other bits where the processor has it.

// With their parts exchanged.
inline Vector swapped(Vector z) {
    Vector w{};
    for (int k = 0; k < WIDTH; ++k) w[k] = z[k ^ 1];
    return w;
}

// (-s, s, -s, s): i s z is this times z with its parts exchanged.
inline Vector turning(double s) {
    Vector v;
    for (int k = 0; k < WIDTH; ++k) v[k] = k % 2 ? s : -s;
    return v;
}

// Version for one block or more.
template <class Part>
auto sum_blocks(npy_intp floats, Part part) {
    decltype(part(0, 0)) total{};
    for (npy_intp begin = 0; begin < floats; begin += BLOCK) {
        const auto sums = part(begin, std::min(begin + BLOCK, floats));
        for (std::size_t k = 0; k < sums.size(); ++k) total[k] += sums[k];
    }
    return total;
}

// The sum over the imaginary parts, the odd lanes, less that over the real ones.
inline double odd_less_even(const Lanes &lanes) {
    double lane[LANES];
    std::memcpy(lane, lanes.part, sizeof lane);
    return ((lane[1] + lane[5]) + (lane[3] + lane[7])) - ((lane[0] + lane[4]) + (lane[2] + lane[6]));
}

// The last floats of a field, filled up with zeros, whose terms are 0.
struct Tail {
    double of[LANES] = {};
    Tail(npy_intp count, const double *from) { std::copy_n(from, count, of); }
};

// The sums over blocks of `Sums`, whose `add` takes eight floats of each field, and `sums` what a block comes to. `add`
// receives the position of these floats and how many of them are valid: fewer than eight at the end.
template <class Sums, class... Fields>
auto lane_sums(npy_intp floats, Sums begin, Fields... fields) {
    return sum_blocks(floats, [&](npy_intp first, npy_intp end) {
        Sums block = begin;
        npy_intp i = first;
        for (; i + LANES <= end; i += LANES) block.add(i, LANES, fields + i...);
        if (i < end) {
            const auto filled_up = [&](const double *from) { return Tail(end - i, from + i); };
            block.add(i, end - i, filled_up(fields).of...);
        }
        return block.sums();
    });
}

struct MomentSums {
    Lanes mass, along, square, quartic, sizes;

    void add(npy_intp, npy_intp, const double *psi, const double *f) {
        for (int k = 0; k < VECTORS; ++k) {
            const Vector z = load(psi + k * WIDTH), g = load(f + k * WIDTH);
            const Vector squares = z * z, density = squares + swapped(squares), crossed = z * swapped(g);
            mass.part[k] += squares;
            square.part[k] += g * g;
            quartic.part[k] += density * density;
            along.part[k] += crossed;
            sizes.part[k] += absolute(crossed);
        }
    }

    // Each |psi|^4 stands in two lanes.
    std::array<double, 5> sums() const {
        return {mass.sum(), odd_less_even(along), square.sum(), 0.5 * quartic.sum(), sizes.sum()};
    }
};

// Sums for psi and f = -i H psi: of |psi|^2, Re(conj(psi) H psi), |H psi|^2 and |psi|^4, and of the sizes of the second
// one's terms.
std::array<double, 5> moments(ConstField psi, ConstField f) {
    require_one_length(psi, f);
    const Released released(psi.points);
    return lane_sums(2 * psi.points, MomentSums{}, psi.data, f.data);
}

// The sum of |psi|^2.
double total_mass(ConstField psi) {
    const Released released(psi.points);
    const auto part = [&](npy_intp begin, npy_intp end) {
        return std::array{dot(psi.data + begin, psi.data + begin, end - begin)};
    };
    return sum_blocks(2 * psi.points, part)[0];
}

struct ExpansionSums {
    Lanes square, slope;

    void add(npy_intp, npy_intp, const double *psi, const double *from, const double *f) {
        for (int k = 0; k < VECTORS; ++k) {
            const Vector d = load(psi + k * WIDTH) - load(from + k * WIDTH);
            square.part[k] += d * d;
            slope.part[k] += d * swapped(load(f + k * WIDTH));
        }
    }
    std::array<double, 2> sums() const { return {square.sum(), odd_less_even(slope)}; }
};

// Sums of |d|^2 and Re(conj(i f) d) for d = psi - from.
std::array<double, 2> expansion(ConstField psi, ConstField from, ConstField f) {
    require_one_length(psi, from, f);
    const Released released(psi.points);
    return lane_sums(2 * psi.points, ExpansionSums{}, psi.data, from.data, f.data);
}

struct ShiftSums {
    double a;
    Vector b;
    double *out;
    Lanes mass, square, slope;

    void add(npy_intp i, npy_intp count, const double *psi, const double *f) {
        double last[LANES], *to = count == LANES ? out + i : last;
        for (int k = 0; k < VECTORS; ++k) {
            const Vector z = load(psi + k * WIDTH), turned = swapped(load(f + k * WIDTH));
            const Vector d = a * z + b * turned, there = z + d;
            store(there, to + k * WIDTH);
            mass.part[k] += there * there;
            square.part[k] += d * d;
            slope.part[k] += d * turned;
        }
        if (count < LANES) std::copy_n(last, count, out + i);
    }
    std::array<double, 3> sums() const { return {mass.sum(), square.sum(), odd_less_even(slope)}; }
};

// out = psi + a psi + b i f; the sums of |out|^2, and of |d|^2 and Re(conj(i f) d) for the difference d from psi.
std::array<double, 3> shifted(ConstField psi, ConstField f, double a, double b, Field out) {
    require_one_length(psi, f, out);
    const Released released(psi.points);
    return lane_sums(2 * psi.points, ShiftSums{a, turning(b), out.data, {}, {}, {}}, psi.data, f.data);
}

// Sum of weight |field|^2; a weight for each point or, (rows, 1), for each row.
double weighted_square(ConstField field, ConstReals weight) {
    const npy_intp columns = field.columns;
    const bool by_rows = is_by_rows(field, weight, "weighted_square: expected a weight for each point, or row");
    const Released released(field.points);
    const double *z = field.data, *w = weight.data;
    if (by_rows) {
        double total = 0.0;
        for (npy_intp r = 0; r < weight.points; ++r, z += 2 * columns) total += w[r] * dot(z, z, 2 * columns);
        return total;
    }
    const auto term = [=](npy_intp i) { return w[i] * (z[2 * i] * z[2 * i] + z[2 * i + 1] * z[2 * i + 1]); };
    const auto part = [&](npy_intp begin, npy_intp end) {
        double a = 0.0, b = 0.0, c = 0.0, d = 0.0;
        npy_intp i = begin;
        for (; i + 4 <= end; i += 4) {
            a += term(i);
            b += term(i + 1);
            c += term(i + 2);
            d += term(i + 3);
        }
        for (; i < end; ++i) a += term(i);
        return std::array{(a + b) + (c + d)};
    };
    return sum_blocks(field.points, part)[0];
}

}  // namespace
}  // namespace eip

namespace nanobind::detail {

template <class T, bool COMPLEX>
struct type_caster<eip::PointsOf<T, COMPLEX>> {
    using Points = eip::PointsOf<T, COMPLEX>;
    NB_TYPE_CASTER(Points, Points::TEXT)
    bool from_python(handle object, uint32_t, cleanup_list *) noexcept { return value.take(object.ptr()); }
};

}  // namespace nanobind::detail

namespace eip {

void add_condensates(Module module) {
    module.def("multiply", multiply, "field"_a, "factor"_a);
    module.def("derivative", derivative, "rest"_a, "psi"_a, "V"_a, "beta"_a, "out"_a);
    module.def("derivative_at_once", derivative_at_once, "psi"_a, "V"_a, "beta"_a, "out"_a);
    module.def("turn", turn, "f"_a, "factor"_a, "out"_a);
    module.def("moments", moments, "psi"_a, "f"_a);
    module.def("total_mass", total_mass, "psi"_a);
    module.def("expansion", expansion, "psi"_a, "near"_a, "f"_a);
    module.def("shifted", shifted, "psi"_a, "f"_a, "a"_a, "b"_a, "out"_a);
    module.def("weighted_square", weighted_square, "field"_a, "weight"_a);
}

}  // namespace eip
