// Accelerations and multipliers of mechanical systems with constraints:
//
//     M u' + G^T lambda = F,   G u' = -gamma.
//
// By a QR factorisation with pivoting of the constraints' gradients, each scaled to length 1, and the mass matrix on their
// null space. Directions in which the gradients are dependent within a tolerance count as free: u' then violates the
// constraints least, and lambda is the shortest one, in units of the scaled gradients.
#include "../module.hpp"

#include <cmath>
#include <limits>
#include <vector>

#include "../floats.hpp"

namespace eip {
namespace {

// Pivots of the mass matrix on the null space, its rows and columns scaled to a largest element of 1, that count as 0.
constexpr double SINGULAR_MASS = 1e-13;
constexpr int64_t MASS_IS_SINGULAR = -1, NAN_IN_MATRICES = -2, OUT_OF_MEMORY = -3;

// A reflection 1 - factor v v^T, where v is a first element and others that lie elsewhere.
struct Reflection {
    double first, factor;
    const double *others;
    int64_t count;

    void apply(double &x, double *xs) const {
        if (factor == 0.0) return;
        const double along = factor * (first * x + dot(others, xs, count));
        x -= along * first;
        for (int64_t k = 0; k < count; ++k) xs[k] -= along * others[k];
    }
};

// The reflection of (x, others) onto a multiple of the first unit vector, which x becomes.
Reflection onto_first(double &x, const double *others, int64_t count) {
    const double rest = dot(others, others, count), length = std::sqrt(x * x + rest);
    if (rest == 0.0) return {x, 0.0, others, count};
    const double image = x > 0.0 ? -length : length, first = x - image;
    x = image;
    return {first, 2.0 / (first * first + rest), others, count};
}

// The system of n speeds and m constraints, and room to solve it.
class Motion {
  public:
    // `matrices`: M by rows, F, G by rows, gamma.
    Motion(const double *matrices, int64_t n, int64_t m)
        : n_(n),
          m_(m),
          M_(matrices),
          F_(M_ + n * n),
          G_(F_ + n),
          gamma_(G_ + m * n) {
        static thread_local std::vector<double> room;
        static thread_local std::vector<int64_t> places;
        static thread_local std::vector<Reflection> reflections;
        room.resize(m * n + m * m + 2 * n * n + 2 * m + 5 * n);
        places.resize(m + n);
        reflections.resize(2 * std::min(m, n));
        divide(room.data(), A_, m * n, rest_, m * m, null_, n * n, B_, n * n, scale_, m, lambda_, m, x_, n, y_, n, b_,
               n, row_scale_, n, column_scale_, n);
        pivot_ = places.data();
        order_ = pivot_ + m;
        left_ = reflections.data();
        right_ = left_ + std::min(m, n);
    }

    // Returns the rank of the constraints, or MASS_IS_SINGULAR or NAN_IN_MATRICES. `multipliers` may be null.
    int64_t solve(double tolerance, double *acceleration, double *multipliers) {
        if (!all_finite(M_, n_ * n_ + n_ + m_ * n_ + m_)) return NAN_IN_MATRICES;
        factor_gradients(tolerance);
        make_square();
        solve_constraints();
        find_null_space();
        for (int64_t i = 0; i < n_; ++i) y_[i] = F_[i] - dot(M_ + i * n_, x_, n_);
        if (!move_freely(n_ - rank_)) return MASS_IS_SINGULAR;
        copy(x_, acceleration, n_);
        if (multipliers) find_multipliers(multipliers);
        return rank_;
    }

  private:
    template <class... Others>
    static void divide(double *next, double *&part, int64_t size, Others &&...others) {
        part = next;
        if constexpr (sizeof...(others) > 0) divide(next + size, others...);
    }

    double *column(int64_t k) const { return A_ + pivot_[k] * n_; }

    // A P = Q R, where A has the scaled gradients as columns. A column holds those of R, its diagonal included, and below a
    // reflection.
    void factor_gradients(double tolerance) {
        for (int64_t i = 0; i < m_; ++i) {
            const double length = norm(G_ + i * n_, n_);
            scale_[i] = length > 0.0 ? 1.0 / length : 0.0;
            for (int64_t j = 0; j < n_; ++j) A_[i * n_ + j] = scale_[i] * G_[i * n_ + j];
            pivot_[i] = i;
        }
        for (rank_ = 0; rank_ < std::min(n_, m_); ++rank_) {
            const int64_t k = rank_;
            int64_t best = k;
            double largest = -1.0;
            for (int64_t j = k; j < m_; ++j) {
                const double square = dot(column(j) + k, column(j) + k, n_ - k);
                if (square > largest) {
                    largest = square;
                    best = j;
                }
            }
            if (!(largest > tolerance * tolerance)) return;
            std::swap(pivot_[k], pivot_[best]);
            left_[k] = onto_first(column(k)[k], column(k) + k + 1, n_ - k - 1);
            for (int64_t j = k + 1; j < m_; ++j) left_[k].apply(column(j)[k], column(j) + k + 1);
        }
    }

    // R = (T 0) Z, T triangular: of dependent constraints the columns beyond the rank, in `rest_` by rows, are reflected into
    // the others.
    void make_square() {
        const int64_t others = m_ - rank_;
        for (int64_t k = 0; k < rank_; ++k)
            for (int64_t j = 0; j < others; ++j) rest_[k * others + j] = column(rank_ + j)[k];
        for (int64_t k = rank_ - 1; k >= 0; --k) {
            right_[k] = onto_first(column(k)[k], rest_ + k * others, others);
            for (int64_t i = 0; i < k; ++i) right_[k].apply(column(k)[i], rest_ + i * others);
        }
    }

    void apply_q(double *x) const {
        for (int64_t k = rank_ - 1; k >= 0; --k) left_[k].apply(x[k], x + k + 1);
    }
    void apply_q_transposed(double *x) const {
        for (int64_t k = 0; k < rank_; ++k) left_[k].apply(x[k], x + k + 1);
    }

    // x: the part of u' that the constraints decide, T^T a = -Z gamma, by least squares where some are dependent.
    void solve_constraints() {
        for (int64_t k = 0; k < m_; ++k) lambda_[k] = -gamma_[pivot_[k]] * scale_[pivot_[k]];
        for (int64_t k = rank_ - 1; k >= 0; --k) right_[k].apply(lambda_[k], lambda_ + rank_);
        fill(x_, 0.0, n_);
        for (int64_t k = 0; k < rank_; ++k) x_[k] = (lambda_[k] - dot(column(k), x_, k)) / column(k)[k];
        apply_q(x_);
    }

    // The null space N of the constraints by rows: the last columns of Q.
    void find_null_space() {
        for (int64_t j = 0; j < n_ - rank_; ++j) {
            double *row = null_ + j * n_;
            fill(row, 0.0, n_);
            row[rank_ + j] = 1.0;
            apply_q(row);
        }
    }

    // Add to x the motion N^T b that the constraints leave free, B b = N y with B = N M N^T; false if B is singular.
    bool move_freely(int64_t free) {
        for (int64_t j = 0; j < free; ++j) {
            for (int64_t i = 0; i < n_; ++i) b_[i] = dot(M_ + i * n_, null_ + j * n_, n_);
            for (int64_t i = 0; i < free; ++i) B_[i * free + j] = dot(null_ + i * n_, b_, n_);
        }
        if (!equilibrate(free)) return false;
        for (int64_t i = 0; i < free; ++i) b_[i] = row_scale_[i] * dot(null_ + i * n_, y_, n_);
        if (!eliminate(free)) return false;
        for (int64_t k = 0; k < free; ++k) {
            const double size = column_scale_[order_[k]] * b_[k], *direction = null_ + order_[k] * n_;
            for (int64_t i = 0; i < n_; ++i) x_[i] += size * direction[i];
        }
        return true;
    }

    // Scale the rows and then the columns of B to a largest element of 1; false where one is 0.
    bool equilibrate(int64_t free) {
        const auto scaled = [&](double *scale, int64_t from_row, int64_t along) {
            for (int64_t i = 0; i < free; ++i) {
                double *first = B_ + i * from_row, largest = 0.0;
                for (int64_t j = 0; j < free; ++j) largest = std::max(largest, std::abs(first[j * along]));
                if (!(largest > std::numeric_limits<double>::min())) return false;
                scale[i] = 1.0 / largest;
                for (int64_t j = 0; j < free; ++j) first[j * along] *= scale[i];
            }
            return true;
        };
        return scaled(row_scale_, free, 1) && scaled(column_scale_, 1, free);
    }

    // b = B^-1 b by elimination with complete pivoting, in the order `order_` of the unknowns; false if B is singular.
    bool eliminate(int64_t free) {
        const auto B = [&](int64_t i, int64_t j) -> double & { return B_[i * free + j]; };
        for (int64_t k = 0; k < free; ++k) order_[k] = k;
        for (int64_t k = 0; k < free; ++k) {
            int64_t row = k, place = k;
            for (int64_t i = k; i < free; ++i)
                for (int64_t j = k; j < free; ++j)
                    if (std::abs(B(i, j)) > std::abs(B(row, place))) {
                        row = i;
                        place = j;
                    }
            if (!(std::abs(B(row, place)) > SINGULAR_MASS)) return false;
            for (int64_t j = 0; j < free; ++j) std::swap(B(k, j), B(row, j));
            for (int64_t i = 0; i < free; ++i) std::swap(B(i, k), B(i, place));
            std::swap(b_[k], b_[row]);
            std::swap(order_[k], order_[place]);
            for (int64_t i = k + 1; i < free; ++i) {
                const double ratio = B(i, k) / B(k, k);
                for (int64_t j = k + 1; j < free; ++j) B(i, j) -= ratio * B(k, j);
                b_[i] -= ratio * b_[k];
            }
        }
        for (int64_t k = free - 1; k >= 0; --k) b_[k] = (b_[k] - dot(&B(k, k) + 1, b_ + k + 1, free - k - 1)) / B(k, k);
        return true;
    }

    // The shortest solution of G^T lambda = F - M u', P Z^T (T^-1 c, 0), in units of the gradients that were given.
    void find_multipliers(double *multipliers) {
        for (int64_t i = 0; i < n_; ++i) y_[i] = F_[i] - dot(M_ + i * n_, x_, n_);
        apply_q_transposed(y_);
        fill(lambda_, 0.0, m_);
        for (int64_t k = rank_ - 1; k >= 0; --k) {
            lambda_[k] = y_[k];
            for (int64_t j = k + 1; j < rank_; ++j) lambda_[k] -= column(j)[k] * lambda_[j];
            lambda_[k] /= column(k)[k];
        }
        for (int64_t k = 0; k < rank_; ++k) right_[k].apply(lambda_[k], lambda_ + rank_);
        for (int64_t k = 0; k < m_; ++k) multipliers[pivot_[k]] = lambda_[k] * scale_[pivot_[k]];
    }

    int64_t n_, m_, rank_ = 0;
    const double *M_, *F_, *G_, *gamma_;
    double *A_, *rest_, *null_, *B_, *scale_, *lambda_, *x_, *y_, *b_, *row_scale_, *column_scale_;
    int64_t *pivot_, *order_;
    Reflection *left_, *right_;
};

// For compiled code: fills u' and, unless null, the multipliers; `matrices` holds M, F, G and gamma, one after the other. Returns the rank, or below 0 why there is none.
int64_t solve(const double *matrices, int64_t n, int64_t m, double tolerance, double *acceleration,
              double *multipliers) {
    try {
        const int64_t rank = Motion(matrices, n, m).solve(tolerance, acceleration, multipliers);
        if (rank >= 0) return rank;
        fill(acceleration, std::numeric_limits<double>::quiet_NaN(), n);
        if (multipliers) fill(multipliers, std::numeric_limits<double>::quiet_NaN(), m);
        return rank;
    } catch (const std::bad_alloc &) {
        return OUT_OF_MEMORY;
    }
}

}  // namespace

void add_multibody(Module module) {
    module.def(
        "solve_address", [] { return reinterpret_cast<uintptr_t>(solve); },
        "Return the address of `solve` in multibody.cpp, for compiled code.");
    module.attr("MASS_IS_SINGULAR") = MASS_IS_SINGULAR;
    module.attr("NOT_FINITE") = NAN_IN_MATRICES;
}

}  // namespace eip
