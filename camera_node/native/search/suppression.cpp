// SPDX-License-Identifier: BSD-3-Clause
#include "search/suppression.hpp"

#include <algorithm>
#include <cmath>

#include "numeric/image.hpp"

namespace roundel {

namespace {

bool is_inside(const Ellipse& e, double x, double y, double scale = 1) {
    const double dx = (x - e.x) / scale, dy = (y - e.y) / scale;
    if (std::abs(dx) > e.major / 2 || std::abs(dy) > e.major / 2) return false;
    const double c = std::cos(e.angle), s = std::sin(e.angle);
    const double along = (c * dx + s * dy) / e.major, across = (c * dy - s * dx) / e.minor;
    return along * along + across * across < 0.25;
}

}  // namespace

Suppression::Suppression(int width, int height)
    : columns_(width / kTile + 1), rows_(height / kTile + 1), tiles_(size_t(columns_) * size_t(rows_), 0) {}

size_t Suppression::tile(double x, double y) const {
    const int column = std::clamp(int(x) / kTile, 0, columns_ - 1),
              row = std::clamp(int(y) / kTile, 0, rows_ - 1);
    return size_t(row) * size_t(columns_) + size_t(column);
}

void Suppression::add(const Ellipse& e) {
    ellipses_.push_back(e);
    const double reach = e.major / 2;
    for (double y = e.y - reach; y < e.y + reach + kTile; y += kTile) {
        const size_t first = tile(e.x - reach, y), last = tile(e.x + reach, y);
        std::fill(tiles_.begin() + std::ptrdiff_t(first), tiles_.begin() + std::ptrdiff_t(last) + 1,
                  uint16_t(ellipses_.size()));
    }
}

bool Suppression::contains(double x, double y, double scale) const {
    return std::any_of(ellipses_.begin(), ellipses_.end(),
                       [&](const Ellipse& e) { return is_inside(e, x, y, scale); });
}

bool Suppression::contains_fast(double x, double y) const {
    const uint16_t number = tiles_[tile(x, y)];
    return number && is_inside(ellipses_[size_t(number) - 1], x, y);
}

}  // namespace roundel
