// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>
#include <vector>

namespace roundel {

/// The ratio of the print that a measured ratio is nearest to; there is one at least.
inline double nearest_ratio(std::span<const double> prints, double measured) {
    return *std::min_element(prints.begin(), prints.end(), [&](double a, double b) {
        return std::abs(a - measured) < std::abs(b - measured);
    });
}

/// What counts as a roundel.
struct Settings {
    std::vector<double> inner_ratios{0.6, 0.41};  // inner over outer diameter of the prints in use
    double ratio_tolerance = 0.08;
    double min_diameter = 8, max_diameter = 400;  // of the outer ellipse's major axis, pixels
    double min_contrast = 25;                     // bright less dark, grey levels
    double search_share = 1;                      // of a frame's rows that are searched for new roundels
    bool by_paper = false;                        // search by the paper's segments instead of chords

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
