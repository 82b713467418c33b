// SPDX-License-Identifier: BSD-3-Clause
#include "inverse_lens.hpp"

namespace roundel::fusion {
namespace {

struct Polynomial {
    double value, by_s, by_t;
};

Polynomial evaluate(const double* c, double s, double t) {
    const double value = c[0] + s * (c[1] + s * (c[3] + s * c[6])) +
                         t * (c[2] + s * (c[4] + s * c[7]) + t * (c[5] + s * c[8] + t * c[9]));
    return {value, c[1] + t * (c[4] + t * c[8]) + s * (2 * (c[3] + t * c[7]) + 3 * s * c[6]),
            c[2] + s * (c[4] + s * c[7]) + t * (2 * (c[5] + s * c[8]) + 3 * t * c[9])};
}

}  // namespace

const double* InverseLens::cell(double column, double row) const {
    const auto within = [](double place, int64_t n) {  // NaN lies outside
        return int64_t(std::fmax(-1, std::fmin(place, double(n)))) + 1;
    };
    const int64_t x = within(column, columns), y = within(row, rows);
    return coefficients + 20 * (y * (columns + 2) + x);
}

void look_up(const InverseLens& lens, const double* uv, size_t n, double* xy, double* scale) {
    const double per_px = 2 / lens.cell_px;
    for (size_t k = 0; k < n; ++k) {
        const double u = (uv[2 * k] + 0.5) / lens.cell_px, v = (uv[2 * k + 1] + 0.5) / lens.cell_px;
        const double column = std::floor(u), row = std::floor(v);
        const double s = 2 * (u - column) - 1, t = 2 * (v - row) - 1;
        const double* cell = lens.cell(column, row);
        const Polynomial x = evaluate(cell, s, t), y = evaluate(cell + 10, s, t);
        xy[k] = x.value, xy[n + k] = y.value;
        const double per_det = 1 / (per_px * (x.by_s * y.by_t - x.by_t * y.by_s));
        scale[k] = per_det * y.by_t, scale[n + k] = -per_det * x.by_t;
        scale[2 * n + k] = -per_det * y.by_s, scale[3 * n + k] = per_det * x.by_s;
    }
}

}  // namespace roundel::fusion
