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

/// Detected ellipses, raw pixels: centres, full axes and directions of the first axis; NaN where the axes are
/// unknown.
struct Outlines {
    Columns<2> uv, axes;
    const double* angle;
};

/// Undistorts N ellipses: writes 2 x N centres of the undistorted ellipses (the undistorted centres where the
/// axes are unknown), and 4 x N Jacobians of raw pixels with respect to undistorted coordinates at the
/// detected centres.
void look_up(const InverseLens& lens, const Outlines& seen, double* xy, double* scale);

}  // namespace roundel::fusion
