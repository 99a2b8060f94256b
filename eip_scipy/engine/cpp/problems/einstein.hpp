// N point masses to first post-Newtonian order: the equations of Einstein, Infeld and Hoffmann, harmonic coordinates.
//
// Accelerations, energy and momenta in the form of Landau & Lifshitz, The Classical Theory of Fields, section 106: with
// n = (q_a - q_b)/r and phi_a the sum of G m_b / r over the others, the terms in 1/c^2 of
//
// - the energy: 3/8 m v^4 of each body, 1/2 m phi^2 of each body, and of each pair
//   G m_a m_b / r [3/2 (v_a^2 + v_b^2) - 7/2 v_a.v_b - 1/2 (n.v_a)(n.v_b)];
// - the momentum p_a: 1/2 m v_a^2 v_a, and of each pair G m_a m_b / r [3 v_a - 7/2 v_b - 1/2 n (n.v_b)]; the angular
//   momentum is the sum of q_a x p_a.
//
// The accelerations are those whose right-hand sides hold Newton's accelerations, hence all of these vary by terms in
// 1/c^4. What is computed is G times energy and momenta.
#pragma once

#include <vector>

#include "duals.hpp"
#include "newton.hpp"

namespace eip {

// Three columns of a matrix (3, n).
struct ThreeColumns {
    double *first;
    int64_t n;

    double &operator()(int row, int column) const { return first[row * n + column]; }

    // Add the matrix of b -> s a x b.
    void add_cross(double s, const Three &a) const {
        (*this)(0, 1) -= s * a[2];
        (*this)(0, 2) += s * a[1];
        (*this)(1, 0) += s * a[2];
        (*this)(1, 2) -= s * a[0];
        (*this)(2, 0) -= s * a[1];
        (*this)(2, 1) += s * a[0];
    }

    // Add s a b^T.
    void add_outer(double s, const Three &a, const Three &b) const {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) (*this)(i, j) += s * a[i] * b[j];
    }
};

// Bodies to this order: `over_c2` is 1/c^2.
template <class T>
struct Einstein {
    const T *q, *v;
    const double *gm;
    int64_t n;
    double over_c2;

    Einstein(const T *y, const double *gm, int64_t bodies, double over_c2)
        : q(y),
          v(y + 3 * bodies),
          gm(gm),
          n(bodies),
          over_c2(over_c2) {}

    // The sum of G m / r over the other bodies, at each.
    std::vector<T> potentials() const {
        using std::sqrt;
        std::vector<T> phi(n);
        for (int64_t i = 0; i < n; ++i)
            for (int64_t j = i + 1; j < n; ++j) {
                const Vec3<T> x = body(q, i) - body(q, j);
                const T u = 1.0 / sqrt(dot(x, x));
                phi[i] += gm[j] * u;
                phi[j] += gm[i] * u;
            }
        return phi;
    }

    // Add the terms in 1/c^2 to out (3 N), which holds Newton's accelerations.
    void add_accelerations(T *out) const {
        using std::sqrt;
        const std::vector<T> newton(out, out + 3 * n), phi = potentials();
        for (int64_t i = 0; i < n; ++i)
            for (int64_t j = i + 1; j < n; ++j) {
                const Vec3<T> x = body(q, i) - body(q, j);
                const T u = 1.0 / sqrt(dot(x, x));
                add_pull(i, j, x, u, phi, newton.data(), out);
                add_pull(j, i, -x, u, phi, newton.data(), out);
            }
    }

    double energy() const {
        double total = 0.0;
        for (int64_t i = 0; i < n; ++i) {
            const Three vi = body(v, i);
            const double v2 = dot(vi, vi);
            double phi = 0.0;
            for (int64_t j = 0; j < n; ++j) {
                if (j == i) continue;
                const Three vj = body(v, j), x = body(q, i) - body(q, j);
                const double u = 1.0 / std::sqrt(dot(x, x));
                phi += gm[j] * u;
                // Half of the pair's, and 3 v_i^2 / 2 in place of the mean.
                const double radial = dot(x, vi) * dot(x, vj) * u * u;
                total += gm[i] * gm[j] * u * (1.5 * v2 - 1.75 * dot(vi, vj) - 0.25 * radial);
            }
            total += gm[i] * (0.375 * v2 * v2 + 0.5 * phi * phi);
        }
        return energy_sum(q, gm, n) + over_c2 * total;
    }

    // The momentum of each body (3 N).
    std::vector<double> momenta() const {
        std::vector<double> p(3 * n);
        for (int64_t i = 0; i < n; ++i) {
            const Three vi = body(v, i);
            add(p.data(), i, gm[i] * (1.0 + 0.5 * over_c2 * dot(vi, vi)), vi);
            for (int64_t j = 0; j < n; ++j) {
                if (j == i) continue;
                const Three vj = body(v, j), x = body(q, i) - body(q, j);
                const double u = 1.0 / std::sqrt(dot(x, x)), w = over_c2 * gm[i] * gm[j] * u;
                add(p.data(), i, w, sum(3.0, vi, -3.5, vj));
                add(p.data(), i, -0.5 * w * u * u * dot(x, vj), x);
            }
        }
        return p;
    }

    // out (6 N). By a velocity: the momentum and m v^2 v / c^2.
    void energy_gradient(double *out) const {
        double *by_q = out, *by_v = out + 3 * n;
        const std::vector<double> phi = potentials(), p = momenta();
        std::fill(by_q, by_v, 0.0);
        std::copy(p.begin(), p.end(), by_v);
        for (int64_t i = 0; i < n; ++i) {
            const Three vi = body(v, i);
            add(by_v, i, over_c2 * gm[i] * dot(vi, vi), vi);
            for (int64_t j = i + 1; j < n; ++j) {
                const Three force = pair_force(i, j, phi[i] + phi[j]);
                add(by_q, i, 1.0, force);
                add(by_q, j, -1.0, force);
            }
        }
    }

    Three momentum() const {
        const std::vector<double> p = momenta();
        Three total{};
        for (int64_t i = 0; i < n; ++i) {
            const Three L = cross(body(q, i), body(p.data(), i));
            for (int c = 0; c < 3; ++c) total[c] += L[c];
        }
        return total;
    }

    // out (3, 6 N).
    void momentum_gradient(double *out) const {
        std::fill(out, out + 18 * n, 0.0);
        for (int64_t i = 0; i < n; ++i) {
            const Three qi = body(q, i), vi = body(v, i);
            const double m = gm[i] * (1.0 + 0.5 * over_c2 * dot(vi, vi));
            by_position(out, i).add_cross(-m, vi);
            by_velocity(out, i).add_cross(m, qi);
            by_velocity(out, i).add_outer(over_c2 * gm[i], cross(qi, vi), vi);
            for (int64_t j = i + 1; j < n; ++j) add_pair_momentum(out, i, j);
        }
    }

  private:
    ThreeColumns by_position(double *out, int64_t i) const { return {out + 3 * i, 6 * n}; }
    ThreeColumns by_velocity(double *out, int64_t i) const { return {out + 3 * (n + i), 6 * n}; }

    // Add body j's pull on body i; x from j to i, u = 1/r.
    void add_pull(int64_t i, int64_t j, const Vec3<T> &x, const T &u, const std::vector<T> &phi, const T *newton,
                  T *out) const {
        const Vec3<T> vi = body(v, i), vj = body(v, j), aj = body(newton, j);
        const T radial = dot(x, vj) * u;
        T along = 4.0 * phi[i] + phi[j] - dot(vi, vi) - 2.0 * dot(vj, vj) + 4.0 * dot(vi, vj);
        along += 1.5 * radial * radial + 0.5 * dot(x, aj);
        const T across = 4.0 * dot(x, vi) - 3.0 * dot(x, vj);
        const double mass = over_c2 * gm[j];
        const T w = mass * u, w3 = w * u * u;
        add(out, i, w3 * along, x);
        add(out, i, w3 * across, vi - vj);
        add(out, i, 3.5 * mass * u, aj);
    }

    // Force that pulls body j towards i, as in the energy.
    Three pair_force(int64_t i, int64_t j, double phi) const {
        const Three vi = body(v, i), vj = body(v, j), x = body(q, i) - body(q, j);
        const double u2 = 1.0 / dot(x, x), w = gm[i] * gm[j] * u2 * std::sqrt(u2), xi = dot(x, vi), xj = dot(x, vj);
        const double even = phi + 1.5 * (dot(vi, vi) + dot(vj, vj)) - 3.5 * dot(vi, vj) - 1.5 * xi * xj * u2;
        return sum(w * (1.0 - over_c2 * even), x, -0.5 * over_c2 * w, sum(xj, vi, xi, vj));
    }

    // One pair's rows, of w {A/r - (qb x qa) s / (2 r^3)}: A = qa x (3 va - 7/2 vb) + qb x (3 vb - 7/2 va),
    // s = (qa - qb).(va + vb).
    void add_pair_momentum(double *out, int64_t a, int64_t b) const {
        const Three qa = body(q, a), qb = body(q, b), va = body(v, a), vb = body(v, b);
        const Three x = qa - qb, both = sum(1.0, va, 1.0, vb), c = cross(qb, qa);
        const double w = over_c2 * gm[a] * gm[b], u2 = 1.0 / dot(x, x), u = std::sqrt(u2), s = dot(x, both);
        const double w3 = w * u * u2;
        const Three alpha = sum(3.0, va, -3.5, vb), beta = sum(3.0, vb, -3.5, va);
        const Three A = sum(1.0, cross(qa, alpha), 1.0, cross(qb, beta));
        // Derivative by the position: d qa x alpha = -alpha x d qa, and dc = qb x d qa - qa x d qb.
        by_position(out, a).add_cross(-w * u, alpha);
        by_position(out, b).add_cross(-w * u, beta);
        by_position(out, a).add_cross(-0.5 * w3 * s, qb);
        by_position(out, b).add_cross(0.5 * w3 * s, qa);
        const Three by_r = sum(-w3, A, 1.5 * w3 * u2 * s, c);
        by_position(out, a).add_outer(1.0, by_r, x);
        by_position(out, a).add_outer(-0.5 * w3, c, both);
        by_position(out, b).add_outer(-1.0, by_r, x);
        by_position(out, b).add_outer(0.5 * w3, c, both);
        by_velocity(out, a).add_cross(w * u, sum(3.0, qa, -3.5, qb));
        by_velocity(out, a).add_outer(-0.5 * w3, c, x);
        by_velocity(out, b).add_cross(w * u, sum(3.0, qb, -3.5, qa));
        by_velocity(out, b).add_outer(-0.5 * w3, c, x);
    }
};

}  // namespace eip
