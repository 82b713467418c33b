// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <array>

namespace roundel {

constexpr double kMaxCurvature = 1.4;  // of a tone curve between ink and paper

/// What linearization leaves of a camera's tone curve: the light at each level of the linearized image.
class ToneRemainder {
  public:
    /// Nothing: light is in proportion to the levels.
    ToneRemainder() = default;
    /// `light` increases with the level.
    explicit ToneRemainder(const std::array<double, 256>& light) : any_(true), light_(light) {}
    bool any() const { return any_; }
    /// The curvature k between two levels: the share s of the light appears as about the share s + k s (1 -
    /// s) of their difference. It is exact at s = 1/2.
    double curvature(double dark, double bright) const {
        dark = std::clamp(dark, 0.0, 255.0);
        bright = std::clamp(bright, 0.0, 255.0);
        if (!any_ || bright <= dark) return 0;
        const double half = (light_at(dark) + light_at(bright)) / 2;
        const auto above = std::upper_bound(light_.begin() + 1, light_.end() - 1, half);
        const double low = *(above - 1), step = *above - low;
        const double level = double(above - 1 - light_.begin()) + (step > 0 ? (half - low) / step : 0);
        const double share = (level - dark) / (bright - dark);
        return std::clamp(4 * (share - 0.5), -kMaxCurvature, kMaxCurvature);
    }

  private:
    double light_at(double level) const {
        const double within = std::clamp(level, 0.0, 254.999);
        const auto below = size_t(within);
        return light_[below] + (within - double(below)) * (light_[below + 1] - light_[below]);
    }

    bool any_ = false;
    std::array<double, 256> light_{};
};

}  // namespace roundel
