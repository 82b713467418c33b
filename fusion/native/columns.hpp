// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "numeric/vector3.hpp"

namespace roundel::fusion {

using Vector = Vector3;
using Matrix = Matrix3;

/// A view of N columns of R numbers, stored row after row: a NumPy array (R, N) in C order.
template <int R>
struct Columns {
    const double* data;
    size_t n;

    double at(int row, size_t k) const { return data[row * n + k]; }
    Vector vector(size_t k) const
        requires(R == 3)
    {
        return {at(0, k), at(1, k), at(2, k)};
    }
};

/// The factor L of the covariance L L^T of detection k: a in the first row, b and c in the second.
struct CovarianceFactor {
    double a, b, c;

    CovarianceFactor(const Columns<4>& cov, size_t k, double added = 0)
        : a(std::sqrt(cov.at(0, k) + added)),
          b(cov.at(1, k) / a),
          c(std::sqrt(cov.at(3, k) + added - b * b)) {}
};

}  // namespace roundel::fusion
