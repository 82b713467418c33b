// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <array>

#include "vector3.hpp"

namespace roundel {

/// The unit quaternion w >= 0, x, y, z of a rotation. Divides by its largest component (Shepperd 1978).
inline std::array<double, 4> quaternion(const Matrix3& R) {
    const auto& [r0, r1, r2] = R;
    const double trace = r0.x + r1.y + r2.z;
    const std::array squares{1 + trace, 1 + (2 * r0.x - trace), 1 + (2 * r1.y - trace),
                             1 + (2 * r2.z - trace)};  // 4 w^2 to 4 z^2
    const auto& [w, x, y, z] = squares;
    const double a = r2.y - r1.z, b = r0.z - r2.x, c = r1.x - r0.y;
    const double d = r1.x + r0.y, e = r0.z + r2.x, f = r2.y + r1.z;
    const std::array<double, 4> rows[4] = {{w, a, b, c}, {a, x, d, e}, {b, d, y, f}, {c, e, f, z}};
    std::array<double, 4> q = rows[std::max_element(squares.begin(), squares.end()) - squares.begin()];
    const double length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double divisor = q[0] < 0 ? -length : length;
    for (double& part : q) part /= divisor;
    return q;
}

}  // namespace roundel
