// SPDX-License-Identifier: BSD-3-Clause
#include "blur/fit.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <utility>

#include "blur/sums.hpp"
#include "fit/fit_covariance.hpp"
#include "fit/gauss_newton.hpp"

namespace roundel {

namespace {

/// One stage of the iteration: the approximate number of pixels, the spacing of the exposure's time steps in
/// pixels of motion and their maximum number, the maximum number of steps, and the step length in pixels at
/// which it stops.
struct Stage {
    int pixels;
    double spacing, time_steps;
    int max_steps;
    double converged;
    bool is_last;
};
constexpr Stage kCoarse{240, 1.5, 8, 7, 0.1, false}, kFine{1200, 1, 1000, 5, 0.01, true};

constexpr double kInitialBlur = 0.9;
// Prior standard deviations. They are smaller than those of fit_photometric: a motion hides both.
constexpr double kRatioPrior = 0.05;
constexpr double kBlurPrior = 0.5;
constexpr double kMinMotion = 0.1;  // over the minor axis: below it the roundel counts as still
constexpr double kMaxMotion = 4;    // mean radii
// Residuals after the coarse stage:
constexpr double kMaxMisfit = 0.08;      // of the contrast
constexpr double kMaxNoise = 4;          // grey levels
constexpr double kMaxFineMisfit = 0.06;  // before the fine stage: it changes true fits by 0.005
// Residuals over that limit after so many steps, beyond which no true roundel (1.8 and 1.3) reaches it.
constexpr std::pair<int, double> kHopeful[] = {{2, 2.25}, {3, 1.5}};
constexpr double kMinSpread = 0.2;  // standard deviation of the ground, grey levels
constexpr double kMaxSpread = 100;  // standard deviation of the ground, grey levels
constexpr SanityLimits kLimits{
    .shift = 0.6, .min_size = 0.6, .max_size = 1.6, .blur = 0, .underflow = 100, .overflow = 100};

/// A motion followed by the parameters of a still picture.
MovingParameters join(double x, double y, const Parameters& picture) {
    MovingParameters p{};
    p[kMotionX] = x;
    p[kMotionY] = y;
    std::copy(picture.begin(), picture.end(), p.begin() + kStill);
    return p;
}

class MovingFitter : GaussNewton<kMovingCount> {
  public:
    MovingFitter(const ImageView& image, const MovingGuess& guess) : image_(image) {
        pixels_.origin_x = int(std::lround(guess.still.outer.x));
        pixels_.origin_y = int(std::lround(guess.still.outer.y));
        p_ = start_ = join(guess.motion_x, guess.motion_y,
                           initial_parameters(guess.still, pixels_.origin_x, pixels_.origin_y, kInitialBlur));
        prior_ = join(0, 0, prior_information(guess.still.outer.major, kRatioPrior, kBlurPrior));
    }

    bool solve() { return iterate(kCoarse) && noise_ < max_noise(kMaxMisfit) && iterate(kFine); }
    RoundelFit fit() const;

  private:
    bool iterate(const Stage& stage) {
        select_moving(image_, p_, stage.pixels, pixels_);
        if (pixels_.used < 2 * kMovingCount) return false;
        for (int k = 0; k < stage.max_steps; ++k) {
            const double spacing = std::max(stage.spacing, motion() / stage.time_steps);
            sums_ = accumulate(pixels_, p_, spacing, kPatch * square(spread_ / noise_));
            update_noise();
            if (stage.is_last ? k == 0 && noise_ > max_noise(kMaxFineMisfit) : is_hopeless(k)) return false;
            if (!factorize(sums_.system, noise_)) return false;
            const double moved = advance();
            if (!is_sane(kLimits) || motion() >= kMaxMotion * start_radius()) return false;
            if (k > 0 && moved < stage.converged) return true;
        }
        return true;
    }

    bool is_hopeless(int step) const {
        return std::any_of(std::begin(kHopeful), std::end(kHopeful), [&](const auto& limit) {
            return step == limit.first && noise_ > limit.second * max_noise(kMaxMisfit);
        });
    }

    /// Estimates the noise from the pixels that do not see the ground, and the ground's standard deviation
    /// from those that do.
    void update_noise() {
        noise_ = std::max(1.0, std::sqrt(sums_.wrr / std::max(1.0, sums_.w - kMovingCount)));
        const double beyond = sums_.ground_rr - square(noise_) * sums_.ground;
        const double spread = std::sqrt(std::max(0.0, beyond) / std::max(1e-9, sums_.ground_ground));
        spread_ = std::clamp(spread, kMinSpread, kMaxSpread);
    }

    /// Takes a step; its geometric part is at most a quarter of the mean radius long. Returns the length of
    /// the full step: the greatest change of its components, pixels.
    double advance() {
        MovingParameters delta = factor_->solve(sums_.system.g);
        double moved = std::max(std::abs(delta[kMotionX]), std::abs(delta[kMotionY])) / 2;
        for (int i = kX; i <= kAyy; ++i) moved = std::max(moved, std::abs(delta[kStill + i]));
        const double share = std::min(1.0, start_radius() / 4 / moved);
        for (int i = 0; i < kMovingCount; ++i)
            if (i < kStill || i >= kStill + kBlur) delta[i] *= share;
        apply(delta);
        return moved;
    }

    double max_noise(double misfit) const { return std::hypot(misfit * contrast(), kMaxNoise); }
    double motion() const { return std::hypot(p_[kMotionX], p_[kMotionY]); }

    const ImageView& image_;
    MovingPixels pixels_;
    MovingSums sums_;
    double noise_ = 20, spread_ = 40;
};

RoundelFit MovingFitter::fit() const {
    const auto pose = scaled(factor_->inverse_tail<kPoseCount>(), square(noise_));
    RoundelFit fit = make_fit(still(p_), pose, pixels_.origin_x, pixels_.origin_y);
    fit.motion_x = p_[kMotionX];
    fit.motion_y = p_[kMotionY];
    fit.edge_residual = std::sqrt(sums_.ring_rr / sums_.ring);
    fit.noise = noise_;
    fit.support = double(pixels_.used) / pixels_.expected;
    return fit;
}

}  // namespace

std::optional<RoundelFit> fit_moving(const ImageView& image, const MovingGuess& guess) {
    MovingFitter fitter(image, guess);
    if (!fitter.solve()) return std::nullopt;
    const RoundelFit fit = fitter.fit();
    const bool moves = std::hypot(fit.motion_x, fit.motion_y) > kMinMotion * fit.outer.minor;
    return moves ? std::optional(fit) : std::nullopt;
}

}  // namespace roundel
