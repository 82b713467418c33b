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
