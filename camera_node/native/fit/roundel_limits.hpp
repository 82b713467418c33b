// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>
#include <vector>

namespace roundel {

/// A kind of print: inner over outer diameter, and the standard deviation of that number. Whether it is in
/// use is given, measured, or only `assumed`.
struct Print {
    static constexpr double kPaper = 0.002;  // standard deviation of printed paper

    double ratio, sigma = kPaper;
    bool assumed = false;
    double spread = 0;  // variance of the ratios of this kind's prints, beyond that of sigma
    bool is_exact() const { return !assumed && sigma <= kPaper; }
};

/// The print (of at least one) whose ratio is nearest to the measured one.
inline const Print& nearest_print(std::span<const Print> prints, double measured) {
    return *std::min_element(prints.begin(), prints.end(), [&](const Print& a, const Print& b) {
        return std::abs(a.ratio - measured) < std::abs(b.ratio - measured);
    });
}

/// The limits within which a ring counts as a roundel.
struct RoundelLimits {
    std::vector<Print> prints{{0.6}, {0.41}};  // in use
    bool any_print = false;                    // other rings may be roundels, too
    double ratio_tolerance = 0.08;
    double min_diameter = 8;    // major axis of the outer ellipse, pixels
    double max_diameter = 400;  // major axis of the outer ellipse, pixels
    double min_contrast = 25;   // bright minus dark level, grey levels of the camera
    double linearized_by = 1;   // exponent that made the levels of fits from those of the camera

    // Prints that are not known in advance: least and greatest ratio, the tolerance of a measured one, and
    // the least diameter, pixels, at which it tells a print from a letter.
    static constexpr std::pair kAnyPrint{0.3, 0.7};
    static constexpr double kAnyTolerance = 0.05, kMinAnyPrint = 14;

    /// The smallest and the largest ratio that a search must find, of `any` print or of those in use.
    std::pair<double, double> ratio_range(bool any) const {
        const auto [low, high] = std::minmax_element(
            prints.begin(), prints.end(), [](const Print& a, const Print& b) { return a.ratio < b.ratio; });
        const double least = low->ratio - ratio_tolerance, most = high->ratio + ratio_tolerance;
        if (!any) return {least, most};
        return {std::min(least, kAnyPrint.first), std::max(most, kAnyPrint.second)};
    }
    /// The contrast of two levels of a fit as the camera shows it.
    double contrast(double dark, double bright) const {
        if (linearized_by == 1) return bright - dark;
        const auto encoded = [&](double level) {
            return 255 * std::pow(std::max(level, 0.0) / 255, 1 / linearized_by);
        };
        return encoded(bright) - encoded(dark);
    }
    /// The difference of a measured ratio from that of the nearest known print, beyond its uncertainty.
    double print_error(double measured) const {
        const Print& print = nearest_print(prints, measured);
        return std::max(0.0, std::abs(print.ratio - measured) - 2 * (print.sigma - Print::kPaper));
    }
    /// Whether a ring may be a print that is not known, which a tone curve enlarges by up to `by_tone`.
    bool may_be_print(double measured, double major, double by_tone = 0) const {
        const auto [least, most] = kAnyPrint;
        return any_print && major >= kMinAnyPrint && measured > least - kAnyTolerance &&
               measured < most + std::max(kAnyTolerance, by_tone);
    }
};

}  // namespace roundel
