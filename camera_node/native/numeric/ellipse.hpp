// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>

namespace roundel {

/// An ellipse in pixels: its centre, its full axes, and the direction of the major axis from +x towards +y in
/// (-pi/2, pi/2].
struct Ellipse {
    double x, y, major, minor, angle;
};

/// A symmetric 2 x 2 matrix.
struct Symmetric {
    double xx, xy, yy;
    double det() const { return xx * yy - xy * xy; }
};

/// An ellipse: its centre, and its points centre + S^(1/2) u, |u| = 1.
struct EllipseShape {
    double x, y;
    Symmetric shape;
};

/// A linear map of the plane: rows (xx, xy) and (yx, yy).
struct LinearMap {
    double xx, xy, yx, yy;
    double det() const { return xx * yy - xy * yx; }
    LinearMap inverse() const {
        const double d = det();
        return {yy / d, -xy / d, -yx / d, xx / d};
    }
};

/// L S L^T: the shape S of an ellipse after a linear map.
inline Symmetric mapped(const LinearMap& L, const Symmetric& S) {
    const auto product = [&](double ux, double uy, double vx, double vy) {
        return ux * S.xx * vx + S.xy * (ux * vy + uy * vx) + uy * S.yy * vy;
    };
    return {product(L.xx, L.xy, L.xx, L.xy), product(L.xx, L.xy, L.yx, L.yy),
            product(L.yx, L.yy, L.yx, L.yy)};
}

/// The matrix with the eigenvalue `a` in the direction `angle`, and `b` across it.
inline Symmetric from_eigenvalues(double a, double b, double angle) {
    const double c = std::cos(angle), s = std::sin(angle);
    return {a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c};
}

/// Eigenvalues, the larger one first, and the direction of its eigenvector in (-pi/2, pi/2].
struct Eigen {
    double first, second, angle;
};

inline Eigen eigen(const Symmetric& matrix) {
    const double mean = (matrix.xx + matrix.yy) / 2, half = (matrix.xx - matrix.yy) / 2;
    const double spread = std::hypot(half, matrix.xy);
    return {mean + spread, mean - spread, std::atan2(matrix.xy + 0.0, half) / 2};
}

}  // namespace roundel
