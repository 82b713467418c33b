// SPDX-License-Identifier: BSD-3-Clause
#include "inverse_lens.hpp"

#include <utility>

namespace roundel::fusion {
namespace {

constexpr double kMaxShift = 0.3;  // radii, as in camera_node/geometry/outline.py

struct Polynomial {
    double value, by_s, by_t;
};

/// Half of the second derivatives.
struct Curvature {
    double ss, st, tt;

    static Curvature of(const double* c, double s, double t) {
        return {c[3] + 3 * c[6] * s + c[7] * t, (c[4] + 2 * c[7] * s + 2 * c[8] * t) / 2,
                c[5] + c[8] * s + 3 * c[9] * t};
    }
    double operator()(const double (&a)[2], const double (&b)[2]) const {
        return ss * a[0] * b[0] + st * (a[0] * b[1] + a[1] * b[0]) + tt * a[1] * b[1];
    }
};

Polynomial evaluate(const double* c, double s, double t) {
    const double value = c[0] + s * (c[1] + s * (c[3] + s * c[6])) +
                         t * (c[2] + s * (c[4] + s * c[7]) + t * (c[5] + s * c[8] + t * c[9]));
    return {value, c[1] + t * (c[4] + t * c[8]) + s * (2 * (c[3] + t * c[7]) + 3 * s * c[6]),
            c[2] + s * (c[4] + s * c[7]) + t * (2 * (c[5] + s * c[8]) + 3 * t * c[9])};
}

/// The derivatives of both coordinates in a cell, and what they make of an ellipse with half axes a and b.
struct LensAt {
    Polynomial x, y;
    Curvature xx, yy;

    /// Adds to an undistorted centre its distance from the centre of the undistorted ellipse; see
    /// camera_node/geometry/outline.py.
    void move_centre(const double (&a)[2], const double (&b)[2], double& cx, double& cy) const {
        const double m11 = x.by_s * a[0] + x.by_t * a[1], m12 = x.by_s * b[0] + x.by_t * b[1];
        const double m21 = y.by_s * a[0] + y.by_t * a[1], m22 = y.by_s * b[0] + y.by_t * b[1];
        const double per_det = 2 / (m11 * m22 - m12 * m21);
        const auto whiten = [&](double u, double v) {
            return std::pair(per_det * (m22 * u - m12 * v), per_det * (m11 * v - m21 * u));
        };
        const auto [first_aa, second_aa] = whiten(xx(a, a), yy(a, a));
        const auto [first_ab, second_ab] = whiten(xx(a, b), yy(a, b));
        const auto [first_bb, second_bb] = whiten(xx(b, b), yy(b, b));
        const double first = (3 * first_aa + first_bb + 2 * second_ab) / 8;
        const double second = (second_aa + 3 * second_bb + 2 * first_ab) / 8;
        if (!(first * first + second * second < kMaxShift * kMaxShift)) return;  // or an unknown ellipse
        cx += m11 * first + m12 * second;
        cy += m21 * first + m22 * second;
    }
};

}  // namespace

const double* InverseLens::cell(double column, double row) const {
    const auto within = [](double place, int64_t n) {  // NaN lies outside
        return int64_t(std::fmax(-1, std::fmin(place, double(n)))) + 1;
    };
    const int64_t x = within(column, columns), y = within(row, rows);
    return coefficients + 20 * (y * (columns + 2) + x);
}

void look_up(const InverseLens& lens, const Outlines& seen, double* xy, double* scale) {
    const double per_px = 2 / lens.cell_px;
    const size_t n = seen.uv.n;
    for (size_t k = 0; k < n; ++k) {
        const double u = (seen.uv.at(0, k) + 0.5) / lens.cell_px, v = (seen.uv.at(1, k) + 0.5) / lens.cell_px;
        const double column = std::floor(u), row = std::floor(v);
        const double s = 2 * (u - column) - 1, t = 2 * (v - row) - 1;
        const double* cell = lens.cell(column, row);
        const Polynomial x = evaluate(cell, s, t), y = evaluate(cell + 10, s, t);
        xy[k] = x.value;
        xy[n + k] = y.value;
        const double c = per_px * std::cos(seen.angle[k]), d = per_px * std::sin(seen.angle[k]);
        const double a = seen.axes.at(0, k) / 2, b = seen.axes.at(1, k) / 2;
        const LensAt at{x, y, Curvature::of(cell, s, t), Curvature::of(cell + 10, s, t)};
        at.move_centre({c * a, d * a}, {-d * b, c * b}, xy[k], xy[n + k]);
        const double per_det = 1 / (per_px * (x.by_s * y.by_t - x.by_t * y.by_s));
        scale[k] = per_det * y.by_t;
        scale[n + k] = -per_det * x.by_t;
        scale[2 * n + k] = -per_det * y.by_s;
        scale[3 * n + k] = per_det * x.by_s;
    }
}

}  // namespace roundel::fusion
