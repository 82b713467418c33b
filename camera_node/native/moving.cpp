// SPDX-License-Identifier: BSD-3-Clause
#include "moving.hpp"

#include <cmath>

#include "gates.hpp"
#include "smear.hpp"

namespace roundel {

namespace {

constexpr double kMisfit = 0.02;     // of the contrast, RMS on the ring's edges
constexpr double kLeastSeen = 0.7;   // share of the way that is in the image
constexpr double kMostMotion = 1.2;  // of the major axis
constexpr double kSureness = 0.05;   // of the minor axis: deviation of the centre, at the most
constexpr double kLeastMinor = 12;   // pixels: smaller ones are not told from clutter
constexpr double kReach = 0.75;      // minor axes that are searched around where it is expected, and
constexpr double kChange = 0.5;      // so much of its way from frame to frame more,
constexpr double kMostReach = 2.5;   // at the most

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
    const double speed = std::hypot(expected.vx, expected.vy), minor = last.outer.minor;
    if (minor < kLeastMinor) return std::nullopt;
    const double reach = std::min(kReach * minor + kChange * speed, kMostReach * minor);
    for (const MovingStart& place :
         search_smeared(image, last, start.still.outer.x, start.still.outer.y, reach))
        if (const auto fit = fit_moving(image, place, settings, noise)) return fit;
    return std::nullopt;
}

}  // namespace roundel
