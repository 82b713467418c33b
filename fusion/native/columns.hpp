// SPDX-License-Identifier: BSD-3-Clause
#pragma once
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

}  // namespace roundel::fusion
