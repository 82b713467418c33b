// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <cstddef>
#include <cstdint>

#include "geometry.hpp"

namespace roundel::fusion {

/// Somebody else's N columns of R numbers each, row after row in memory: numpy's (R, N) in C order.
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
    Matrix matrix(size_t k) const
        requires(R == 9)
    {
        return {
            {at(0, k), at(1, k), at(2, k)}, {at(3, k), at(4, k), at(5, k)}, {at(6, k), at(7, k), at(8, k)}};
    }
};

}  // namespace roundel::fusion
