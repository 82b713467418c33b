// SPDX-License-Identifier: BSD-3-Clause
#include "moving.hpp"

#include <cmath>

#include "gates.hpp"

namespace roundel {

namespace {

constexpr double kMisfit = 0.02;                // of the contrast, RMS on the ring's edges
constexpr double kLeastSeen = 0.7;              // share of the way that is in the image
constexpr double kMostMotion = 1.2;             // of the major axis
constexpr double kSureness = 0.05;              // of the minor axis: deviation of the centre, at the most
constexpr double kLeastTracked = 0.1;           // of the minor axis: slower tracks are not smeared
constexpr double kShares[] = {0.5, 0.25, 0.9};  // of the exposure in the time between frames

bool is_moving_roundel(const Fit& fit, const Settings& settings, double noise) {
    const double misfit = std::hypot(1.2 * noise, kMisfit * (fit.bright - fit.dark));
    const Symmetric centre = fit.centre_covariance();
    return has_limits(fit, settings) && fit.edge_residual < misfit && fit.noise < misfit &&
           fit.support > kLeastSeen &&
           std::hypot(fit.motion_x, fit.motion_y) < kMostMotion * fit.outer.major &&
           std::sqrt(centre.xx + centre.yy) < kSureness * fit.outer.minor;
}

}  // namespace

std::optional<Fit> fit_moving(const ImageView& image, const MovingStart& start, const Settings& settings,
                              double noise) {
    const auto fit = refine_moving(image, start);
    return fit && is_moving_roundel(*fit, settings, noise) ? fit : std::nullopt;
}

std::optional<Fit> follow_moving(const ImageView& image, const Tracks::Expected& expected,
                                 const Settings& settings, double noise) {
    const Fit& last = expected.fit;
    MovingStart start{{last.outer, last.ratio, last.dark, last.bright}, last.motion_x, last.motion_y};
    start.still.outer.x += expected.vx, start.still.outer.y += expected.vy;
    if (std::hypot(start.motion_x, start.motion_y) > 0)
        if (const auto fit = fit_moving(image, start, settings, noise)) return fit;
    const double speed = std::hypot(expected.vx, expected.vy);
    if (speed < kLeastTracked * last.outer.minor) return std::nullopt;
    for (const double share : kShares) {
        const double part = std::min(share, 0.8 * last.outer.major / speed);
        start.motion_x = part * expected.vx, start.motion_y = part * expected.vy;
        if (const auto fit = fit_moving(image, start, settings, noise)) return fit;
    }
    return std::nullopt;
}

}  // namespace roundel
