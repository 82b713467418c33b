// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "outline.hpp"

namespace roundel::fusion {

/// A lens's inverse: an image of `columns` x `rows` square cells, and a ring of empty ones around it. In a
/// cell both undistorted coordinates are polynomials of the third degree in s and t, which run from -1 to 1
/// across it: ten coefficients each, of 1, s, t, s^2, st, t^2, s^3, s^2 t, st^2, t^3. They are NaN where the
/// cell is empty.
struct InverseLens {
    const double* coefficients;
    int64_t columns, rows;
    double cell_px;

    const double* cell(double column, double row) const;
};

/// Of N pixels (u, v side by side): 2 x N undistorted coordinates, and 4 x N the derivative of raw pixels by
/// these.
void look_up(const InverseLens& lens, const double* uv, size_t n, double* xy, double* scale);

}  // namespace roundel::fusion
