// SPDX-License-Identifier: BSD-3-Clause
#include "blur/fit.hpp"

#include <algorithm>
#include <cmath>

#include "numeric/cholesky.hpp"
#include "blur/sums.hpp"
#include "fit/pose_outputs.hpp"
#include "fit/starting_point.hpp"

namespace roundel {

namespace {

constexpr int kCoarsePixels = 240, kFinePixels = 1200;
constexpr double kCoarseSpacing = 1.5, kFineSpacing = 1;  // of the exposure's instants, pixels
constexpr int kCoarseSteps = 14, kFineSteps = 5;
constexpr double kArrived = 0.1, kDone = 0.01;  // greatest moves of a step, pixels
constexpr double kStartBlur = 0.9;
// Standard deviations before a pixel is seen: less than in `refine`, as a motion hides both.
constexpr double kAnyRatio = 0.05, kAnyBlur = 0.5;
constexpr double kLeastMotion = 0.1;  // of the minor axis: what moves less is still
constexpr double kHopeless = 0.15;    // residuals over the contrast that no more steps will mend
constexpr double kBeyond = 100;       // grey levels off the scale
constexpr double kLeastSpread = 0.2;  // of the ground, grey levels
constexpr double kMostSpread = 100;
constexpr double kPatch = 64;  // pixels of the ground that are off together

double square(double x) { return x * x; }

/// A motion and a still picture's parameters.
MovingParameters join(double x, double y, const Parameters& picture) {
    MovingParameters p{};
    p[kMotionX] = x, p[kMotionY] = y;
    std::copy(picture.begin(), picture.end(), p.begin() + kStill);
    return p;
}

/// Gauss-Newton on the pixels that a moving roundel passes.
class MovingFitter {
  public:
    MovingFitter(const ImageView& image, const MovingStart& start) : image_(image) {
        pixels_.origin_x = int(std::lround(start.still.outer.x));
        pixels_.origin_y = int(std::lround(start.still.outer.y));
        p_ = start_ = join(start.motion_x, start.motion_y,
                           starting_point(start.still, pixels_.origin_x, pixels_.origin_y, kStartBlur));
        prior_ = join(0, 0, prior_information(start.still.outer.major, kAnyRatio, kAnyBlur));
    }

    bool solve() {
        return iterate(kCoarsePixels, kCoarseSpacing, kCoarseSteps, kArrived) &&
               noise_ < kHopeless * contrast() && iterate(kFinePixels, kFineSpacing, kFineSteps, kDone);
    }
    Fit fit() const;

  private:
    bool iterate(int limit, double spacing, int steps, double enough) {
        select_moving(image_, p_, limit, pixels_);
        if (pixels_.used < 2 * kMovingCount) return false;
        for (int k = 0; k < steps; ++k) {
            sums_ = accumulate(pixels_, p_, spacing, kPatch * square(spread_ / noise_));
            learn_noise();
            add_prior();
            factor_.emplace(sums_.H);
            if (!factor_->positive()) return false;
            const double moved = advance();
            if (!is_sane()) return false;
            if (k > 0 && moved < enough) return true;
        }
        return true;
    }

    /// The noise where no ground was seen, and how much the ground varies where it was.
    void learn_noise() {
        noise_ = std::max(1.0, std::sqrt(sums_.wrr / std::max(1.0, sums_.w - kMovingCount)));
        const double beyond = sums_.ground_rr - square(noise_) * sums_.ground;
        const double spread = std::sqrt(std::max(0.0, beyond) / std::max(1e-9, sums_.ground_ground));
        spread_ = std::clamp(spread, kLeastSpread, kMostSpread);
    }

    void add_prior() {
        for (int i = 0; i < kMovingCount; ++i) {
            const double information = square(noise_) * prior_[size_t(i)];
            sums_.H[i][i] += information;
            sums_.g[i] += information * (start_[i] - p_[i]);
        }
    }

    /// Takes a step, at most a quarter of the minor axis long; gives its greatest move in pixels.
    double advance() {
        const MovingParameters delta = factor_->solve(sums_.g);
        double moved = std::max(std::abs(delta[kMotionX]), std::abs(delta[kMotionY])) / 2;
        for (int i = kX; i <= kAyy; ++i) moved = std::max(moved, std::abs(delta[kStill + i]));
        const double longest = std::sqrt(size(start_)) / 4, share = std::min(1.0, longest / moved);
        for (int i = 0; i < kMovingCount; ++i)
            p_[i] += (i < kStill || i >= kStill + kBlur ? share : 1) * delta[i];
        p_[kStill + kBlur] = std::max(p_[kStill + kBlur], kMinBlur);
        return moved;
    }

    double contrast() const { return p_[kStill + kBright] - p_[kStill + kDark]; }

    static double size(const MovingParameters& p) {
        return p[kStill + kAxx] * p[kStill + kAyy] - square(p[kStill + kAxy]);
    }

    bool is_sane() const {
        const double area = size(p_) / size(start_), radius = std::sqrt(size(start_));
        const Parameters p = still(p_), s = still(start_);
        return std::hypot(p[kX] - s[kX], p[kY] - s[kY]) < 1 + 0.6 * radius && p[kAxx] > 0 &&
               area > square(0.6) && area < square(1.6) && p[kRatio] > 0.1 && p[kRatio] < 0.95 &&
               p[kBlur] < 3 && p[kCard] > 1 && p[kDark] > -kBeyond && p[kBright] < 255 + kBeyond &&
               square(p[kGx]) + square(p[kGy]) < square(0.5 / p[kCard]) &&
               std::hypot(p_[kMotionX], p_[kMotionY]) < 4 * radius;
    }

    const ImageView& image_;
    MovingPixels pixels_;
    MovingParameters p_, start_, prior_;
    MovingSums sums_;
    std::optional<Cholesky<kMovingCount>> factor_;
    double noise_ = 20, spread_ = 40;
};

Fit MovingFitter::fit() const {
    auto pose = factor_->inverse_tail<kPoseCount>();
    for (auto& row : pose)
        for (double& value : row) value *= square(noise_);
    Fit fit = fit_of(still(p_), pose, pixels_.origin_x, pixels_.origin_y);
    fit.motion_x = p_[kMotionX], fit.motion_y = p_[kMotionY];
    fit.edge_residual = std::sqrt(sums_.ring_rr / sums_.ring);
    fit.noise = noise_;
    fit.support = double(pixels_.used) / pixels_.expected;
    return fit;
}

}  // namespace

std::optional<Fit> refine_moving(const ImageView& image, const MovingStart& start) {
    MovingFitter fitter(image, start);
    if (!fitter.solve()) return std::nullopt;
    const Fit fit = fitter.fit();
    return std::hypot(fit.motion_x, fit.motion_y) > kLeastMotion * fit.outer.minor ? std::optional(fit)
                                                                                   : std::nullopt;
}

}  // namespace roundel
