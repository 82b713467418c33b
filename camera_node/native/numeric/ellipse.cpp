// SPDX-License-Identifier: BSD-3-Clause
#include "numeric/ellipse.hpp"

#include <cmath>

namespace roundel {

Eigen eigen(const Symmetric& matrix) {
    const double mean = (matrix.xx + matrix.yy) / 2, half = (matrix.xx - matrix.yy) / 2;
    const double spread = std::hypot(half, matrix.xy);
    return {mean + spread, mean - spread, std::atan2(matrix.xy + 0.0, half) / 2};
}

}  // namespace roundel
