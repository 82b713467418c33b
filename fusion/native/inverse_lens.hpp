// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "outline.hpp"

namespace roundel::fusion {

/// The table of an inverse lens model: `columns` x `rows` square cells, surrounded by one ring of empty
/// cells.
///
/// In a cell both undistorted coordinates are cubic polynomials of s and t, which run from -1 to 1 across the
/// cell. Each has ten coefficients, of 1, s, t, s^2, st, t^2, s^3, s^2 t, st^2, t^3; NaN in empty cells.
struct InverseLens {
    const double* coefficients;
    int64_t columns, rows;
    double cell_px;

    const double* cell(double column, double row) const;
};

/// Undistorts N pixels (pairs u, v): writes 2 x N coordinates, and 4 x N Jacobians of raw pixels with respect
/// to them.
void look_up(const InverseLens& lens, const double* uv, size_t n, double* xy, double* scale);

}  // namespace roundel::fusion
