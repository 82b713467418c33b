// SPDX-License-Identifier: BSD-3-Clause
#include "blur/templates.hpp"

#include <cmath>
#include <numbers>

#include "numeric/cholesky.hpp"

namespace roundel {

namespace {

constexpr double kExtent = 1.15;  // of the grid of a known roundel, outer radii
constexpr int kDirections = 6;
constexpr double kLengths[] = {0.35, 0.7};  // of the motion, diameters
constexpr int kTimeSteps = 16;              // of the exposure
constexpr double kGroundVariance = 30;      // of a new roundel's ground, over that of other residuals

/// The numbers of time steps in which a point sees each level.
struct LevelCounts {
    int paper = 0, ink = 0, ground = 0;
};

/// `point` and `motion` are in outer radii of a disc with its centre, at mid-exposure, at the origin.
LevelCounts count_levels(DiscPoint point, DiscPoint motion, double ratio) {
    LevelCounts counts;
    for (int n = 0; n < kTimeSteps; ++n) {
        const double t = (n + 0.5) / kTimeSteps - 0.5;
        const double x = point.x - t * motion.x, y = point.y - t * motion.y, rr = x * x + y * y;
        ++(rr > kCardRatio * kCardRatio   ? counts.ground
           : rr < 1 && rr > ratio * ratio ? counts.ink
                                          : counts.paper);
    }
    return counts;
}

/// The points of the grid, in outer radii.
std::array<DiscPoint, KnownTemplate::kPoints> make_grid() {
    std::array<DiscPoint, KnownTemplate::kPoints> grid;
    constexpr int middle = KnownTemplate::kSide / 2;
    size_t n = 0;
    for (int j = -middle; j <= middle; ++j)
        for (int k = -middle; k <= middle; ++k)
            if (std::abs(j) + std::abs(k) < 2 * middle - 1)
                grid[n++] = {kExtent * k / middle, kExtent * j / middle};
    return grid;
}

/// The coordinate of point `k` of `count` in a row.
constexpr double spread(int k, int count, double reach) { return reach * (k - count / 2) / (count / 2); }

}  // namespace

float KnownTemplate::misfit(const Levels& levels) const {
    float squares = 0, along_ground = 0;
    for (size_t k = 0; k < kPoints; ++k) {
        const float off = levels[k] - level[k];
        squares += off * off;
        along_ground += off * ground[k];
    }
    return (squares - along_ground * along_ground / ground_ground) / kPoints;
}

KnownTemplates::KnownTemplates(const InitialGuess& known) {
    const double c = std::cos(known.outer.angle), s = std::sin(known.outer.angle);
    const double a = known.outer.major / 2, b = known.outer.minor / 2;
    const auto grid = make_grid();
    for (size_t k = 0; k < grid.size(); ++k) {
        const double along = grid[k].x * a, across = grid[k].y * b;
        points_[k] = {c * along - s * across, s * along + c * across};
    }
    const double diameter = std::sqrt(known.outer.major * known.outer.minor);
    for (int k = 0; k < kDirections; ++k)
        for (const double length : kLengths) {
            const double angle = std::numbers::pi * k / kDirections;
            const double x = length * diameter * std::cos(angle), y = length * diameter * std::sin(angle);
            const DiscPoint motion{(c * x + s * y) / a, (c * y - s * x) / b};
            KnownTemplate t{x, y, {}, {}, 1e-6f};
            for (size_t n = 0; n < grid.size(); ++n) {
                const auto counts = count_levels(grid[n], motion, known.ratio);
                t.level[n] = float(known.bright + (known.dark - known.bright) * counts.ink / kTimeSteps);
                t.ground[n] = float(double(counts.ground) / kTimeSteps);
                t.ground_ground += t.ground[n] * t.ground[n];
            }
            templates_.push_back(t);
        }
}

NewTemplate::NewTemplate(double print_ratio, double motion_length)
    : ratio(print_ratio), length(motion_length), share{}, solve{}, weight{} {
    std::array<Vector<3>, 3> H{};
    float weights = 0;
    for (size_t k = 0; k < kPoints; ++k) {
        const DiscPoint point{spread(int(k) % kAlong, kAlong, kReachAlong),
                              spread(int(k) / kAlong, kAcross, kReachAcross)};
        const auto counts = count_levels(point, {2 * length, 0}, ratio);
        const Vector<3> shares{double(counts.paper) / kTimeSteps, double(counts.ink) / kTimeSteps,
                               double(counts.ground) / kTimeSteps};
        const double w = 1 / (1 + kGroundVariance * shares[2] * shares[2]);
        for (size_t i = 0; i < 3; ++i) {
            share[i].at[k] = float(shares[i]);
            for (size_t j = 0; j < 3; ++j) H[i][j] += w * shares[i] * shares[j];
        }
        weight.at[k] = float(w);
        weights += float(w);
    }
    for (size_t i = 0; i < 3; ++i) H[i][i] += 1e-3;  // short motions show some levels nowhere
    const Cholesky<3> factor(H);
    for (size_t k = 0; k < kPoints; ++k) {
        const double w = double(weight.at[k]);
        const auto solved = factor.solve(
            {w * double(share[0].at[k]), w * double(share[1].at[k]), w * double(share[2].at[k])});
        for (size_t i = 0; i < 3; ++i) solve[i].at[k] = float(solved[i]);
        weight.at[k] /= weights;
    }
}

}  // namespace roundel
