// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <vector>

#include "fit/photometric_fit.hpp"
#include "numeric/lanes.hpp"

namespace roundel {

/// The appearance of moving roundels at a grid of points, for the matcher. The mean of the exposure at a
/// point is a linear function of the levels of paper, ink and ground: its coefficients are the shares of the
/// exposure in which the point sees each of them.

/// A point, or a motion, in the frame of a disc: outer radii, or pixels.
struct DiscPoint {
    double x, y;
};

/// A moving roundel of known shape, grey levels and ratio, at 37 points. Only the ground's level is free.
struct KnownTemplate {
    static constexpr int kSide = 7;                     // of a square grid, points
    static constexpr int kPoints = kSide * kSide - 12;  // of the grid without its corners
    using Levels = std::array<float, kPoints>;

    double motion_x;      // pixels
    double motion_y;      // pixels
    Levels level;         // without the ground
    Levels ground;        // the ground's shares
    float ground_ground;  // sum of the squared shares

    /// Mean squared residual with the best level of the ground.
    float misfit(const Levels& levels) const;
};

/// Templates of one known roundel, for six directions and two lengths of its motion.
class KnownTemplates {
  public:
    explicit KnownTemplates(const InitialGuess& known);
    const std::array<DiscPoint, KnownTemplate::kPoints>& points() const { return points_; }
    const std::vector<KnownTemplate>& all() const { return templates_; }

  private:
    std::array<DiscPoint, KnownTemplate::kPoints> points_;  // relative to the centre, pixels of the image
    std::vector<KnownTemplate> templates_;
};

/// A moving roundel of unknown levels, at 9 x 7 points along and across its motion. All three levels are
/// free: `solve` holds the rows of their weighted least-squares solution.
struct NewTemplate {
    static constexpr int kAlong = 9, kAcross = 7, kPoints = kAlong * kAcross, kPadded = kPoints + 1;
    static constexpr double kReachAlong = 2;     // of the points, radii
    static constexpr double kReachAcross = 1.2;  // of the points, radii
    struct alignas(4 * kLanes) Column {
        std::array<float, kPadded> at{};
    };

    double ratio;                 // of the print
    double length;                // of the motion, diameters
    std::array<Column, 3> share;  // of paper, ink and ground
    std::array<Column, 3> solve;  // of paper, ink and ground
    Column weight;

    NewTemplate(double print_ratio, double motion_length);
};

}  // namespace roundel
