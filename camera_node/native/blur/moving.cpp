// SPDX-License-Identifier: BSD-3-Clause
#include "blur/moving.hpp"

#include <cmath>

#include "verify/acceptance.hpp"
#include "blur/smear.hpp"

namespace roundel {

namespace {

constexpr double kMisfit = 0.03;     // of the contrast, RMS on the ring's edges
constexpr double kLeastSeen = 0.7;   // share of the way that is in the image
constexpr double kMostMotion = 1.2;  // of the major axis
constexpr double kSureness = 0.05;   // of the minor axis: deviation of the centre, at the most
constexpr double kAlike = 1.3;       // times that contrast and axes may differ from the last frame's
constexpr double kLeastMinor = 12;   // pixels: smaller ones are not told from clutter
constexpr double kReach = 0.75;      // minor axes that are searched around where it is expected, and
constexpr double kChange = 0.5;      // so much of its way from frame to frame more,
constexpr double kMostReach = 2.5;   // at the most

bool is_moving_roundel(const Fit& fit, const Settings& settings, double noise) {
    const Symmetric centre = fit.centre_covariance();
    return has_limits(fit, settings) &&
           fit.edge_residual < std::hypot(1.2 * noise, kMisfit * (fit.bright - fit.dark)) &&
           fit.support > kLeastSeen &&
           std::hypot(fit.motion_x, fit.motion_y) < kMostMotion * fit.outer.major &&
           std::sqrt(centre.xx + centre.yy) < kSureness * fit.outer.minor;
}

bool is_near(double value, double last) { return value < kAlike * last && last < kAlike * value; }

/// From frame to frame neither ink and paper nor the view change much.
bool is_alike(const Fit& fit, const Fit& last) {
    return is_near(fit.bright - fit.dark, last.bright - last.dark) &&
           is_near(fit.outer.major, last.outer.major) && is_near(fit.outer.minor, last.outer.minor);
}

/// The fit of a moving roundel; nothing where it does not pass the gates that end false positives.
std::optional<Fit> fit_again(const ImageView& image, const MovingStart& start, const Fit& last,
                             const Settings& settings, double noise) {
    const auto fit = refine_moving(image, start);
    return fit && is_moving_roundel(*fit, settings, noise) && is_alike(*fit, last) ? fit : std::nullopt;
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
        if (const auto fit = fit_again(image, start, last, settings, noise)) return fit;
    const double speed = std::hypot(expected.vx, expected.vy), minor = last.outer.minor;
    if (minor < kLeastMinor) return std::nullopt;
    const double reach = std::min(kReach * minor + kChange * speed, kMostReach * minor);
    for (const MovingStart& place :
         search_smeared(image, last, start.still.outer.x, start.still.outer.y, reach))
        if (const auto fit = fit_again(image, place, last, settings, noise)) return fit;
    return std::nullopt;
}

}  // namespace roundel
