// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <optional>
#include <vector>

#include "numeric/image.hpp"
#include "numeric/lanes.hpp"
#include "blur/fit.hpp"
#include "settings.hpp"

namespace roundel {

/// Two dark bars side by side with bright between them, which is what a roundel becomes that moves along them
/// by its hole's width or more.
struct Streak {
    float x, y;              // the middle, pixels
    float along_x, along_y;  // direction of the bars, a unit vector
    float width;             // from one bar's outer side to the other's, pixels
};

/// What a streak may be, and how far it is from it: RMS over the contrast.
struct SmearedStart {
    MovingStart start;
    double misfit;
};

/// Compares streaks with roundels of the prints in use, smeared by a few lengths.
///
/// Each appearance is a table of what 63 points around the middle see in the mean of the exposure: paper, ink
/// or ground. Three levels are fitted to it, so a comparison is a linear fit. The place, the direction and
/// the two diameters then descend by turns.
class StreakMatcher {
  public:
    explicit StreakMatcher(const Settings& settings);
    /// The best start; nothing where the streak is not alike on both sides, or nothing comes near.
    std::optional<SmearedStart> match(const ImageView& image, const Streak& streak) const;

  private:
    static constexpr int kAlong = 9, kAcross = 7, kPoints = kAlong * kAcross, kPadded = kPoints + 1;
    struct alignas(4 * kLanes) Column {
        std::array<float, kPadded> at{};
    };
    /// A disc of two diameters, pixels, and its angle.
    struct Place {
        double x, y, angle, along, across;
    };
    struct Appearance {
        double ratio, length;  // of the print; of the motion, diameters
        std::array<Column, 3> share, solve;
        Column weight;
    };
    struct Match {
        Place place;
        const Appearance* appearance;
        double misfit, dark, bright;
    };
    static Appearance make_appearance(double ratio, double length);
    static void sample(const ImageView& image, const Place& place, Column& levels);
    void compare(const Column& levels, const Place& place, size_t stride, Match& best) const;
    bool descend(const ImageView& image, Match& best) const;

    float min_contrast_;
    std::vector<Appearance> appearances_;
};

}  // namespace roundel
