// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>
#include <vector>

namespace roundel {

/// The element of `ratios` (at least one) that is nearest to `measured`.
inline double nearest_ratio(std::span<const double> ratios, double measured) {
    return *std::min_element(ratios.begin(), ratios.end(), [&](double a, double b) {
        return std::abs(a - measured) < std::abs(b - measured);
    });
}

/// The limits within which a ring counts as a roundel.
struct RoundelLimits {
    std::vector<double> inner_ratios{0.6, 0.41};  // inner over outer diameter of the prints in use
    double ratio_tolerance = 0.08;
    double min_diameter = 8, max_diameter = 400;  // major axis of the outer ellipse, pixels
    double min_contrast = 25;                     // bright minus dark level, grey levels

    /// The smallest and the largest ratio of the prints in use.
    std::pair<double, double> ratio_range() const {
        const auto [low, high] = std::minmax_element(inner_ratios.begin(), inner_ratios.end());
        return {*low, *high};
    }
    double ratio_error(double measured) const {
        return std::abs(nearest_ratio(inner_ratios, measured) - measured);
    }
};

}  // namespace roundel
