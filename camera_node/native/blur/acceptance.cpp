// SPDX-License-Identifier: BSD-3-Clause
#include "blur/acceptance.hpp"

#include <algorithm>
#include <cmath>

namespace roundel {

namespace {

constexpr double kMisfit = 0.03;    // of the contrast: RMS residual on the ring's edges
constexpr double kMaxMotion = 1.2;  // major axes
// Standard deviation of the centre, minor axes. Models of clutter are blurred or long until few pixels
// determine them: 0.010 to 0.030, and roundels 0.003 at most.
constexpr double kMaxSigma = 0.05;      // of a roundel of the last frame
constexpr double kMaxNewSigma = 0.008;  // of a new one
constexpr double kMinMinor = 12;        // pixels: smaller ones cannot be distinguished from clutter
constexpr double kReach = 0.75;         // minor axes searched around the predicted position, plus
constexpr double kReachPerSpeed = 0.5;  // so many frames of motion,
constexpr double kMaxReach = 2.5;       // at most so many minor axes

/// `noise` explains a part of the residuals, grey levels.
bool is_accepted(const RoundelFit& fit, const AcceptanceContext& context, double noise, double max_sigma) {
    const Symmetric centre = fit.centre_covariance();
    return is_within_limits(fit, context.limits) && fit.is_explained(noise, kMisfit) &&
           std::hypot(fit.motion_x, fit.motion_y) < kMaxMotion * fit.outer.major &&
           std::sqrt(centre.xx + centre.yy) < max_sigma * fit.outer.minor;
}

}  // namespace

std::optional<RoundelFit> fit_new_moving(const ImageView& image, const MovingGuess& guess,
                                         const AcceptanceContext& context) {
    const auto fit = fit_moving(image, guess);
    return fit && is_accepted(*fit, context, context.noise, kMaxNewSigma) ? fit : std::nullopt;
}

std::optional<RoundelFit> fit_known_moving(const ImageView& image, const KnownRoundel& known,
                                           const AcceptanceContext& context) {
    const RoundelFit& last = known.last;
    const double noise =
        std::max(context.noise, context.camera.edge_noise());  // with what processing leaves at edges
    const auto fit_from = [&](const MovingGuess& guess) {
        const auto fit = fit_moving(image, guess);
        return fit && is_accepted(*fit, context, noise, kMaxSigma) ? fit : std::nullopt;
    };
    MovingGuess predicted{{last.outer, last.ratio, last.dark, last.bright}, last.motion_x, last.motion_y};
    predicted.still.outer.x += known.vx;
    predicted.still.outer.y += known.vy;
    if (std::hypot(last.motion_x, last.motion_y) > 0)
        if (const auto fit = fit_from(predicted)) return fit;
    const double minor = last.outer.minor;
    if (minor < kMinMinor) return std::nullopt;
    const double speed = std::hypot(known.vx, known.vy);
    const double reach = std::min(kReach * minor + kReachPerSpeed * speed, kMaxReach * minor);
    for (const MovingMatch& match : MotionBlurMatcher::match_known(image, predicted.still, reach))
        if (const auto fit = fit_from(match.guess)) return fit;
    return std::nullopt;
}

}  // namespace roundel
