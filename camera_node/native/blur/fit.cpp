// SPDX-License-Identifier: BSD-3-Clause
#include "blur/fit.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <numbers>
#include <utility>

#include "blur/model.hpp"
#include "fit/edge_pixels.hpp"
#include "fit/gauss_newton.hpp"
#include "numeric/gram.hpp"
#include "numeric/simd.hpp"

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

/// The pixels over which a roundel moves.
using MovingPixels = PixelColumns<2048>;

constexpr int kColumns = kMovingCount + 1;  // the gradient and the residual
constexpr double kMargin = 2.5;             // pixels around the disc's path

struct LaneSums {
    Gram<kColumns> gram;
    Lanes w, ring, ring_rr, ground, ground_rr, ground_ground;
};

ROUNDEL_INLINE void weigh(const MovingGradient& model, const Lanes& level, float spread, int k,
                          Columns<kColumns>& columns, LaneSums& sums) {
    const Lanes r = level - model.level[k], share = model.by[kStill + kGround][k], gg = share * share;
    const Bits counts = ~is_uninformative(level, model.level[k]);
    const Lanes w = counts ? 1.0f / (1.0f + spread * gg) : all(0);
    const Lanes root = w > 0.0f ? w * inverse_sqrt(w > 0.0f ? w : all(1)) : all(0);
    const Lanes &bx = model.by[kStill + kX][k], &by = model.by[kStill + kY][k];
    const Lanes slope = w * (bx * bx + by * by), seen = counts ? gg : all(0);
    for (int i = 0; i < kMovingCount; ++i) columns[i][k] = root * model.by[i][k];
    columns[kMovingCount][k] = root * r;
    sums.w += w;
    sums.ring += slope;
    sums.ring_rr += slope * r * r;
    sums.ground += seen;
    sums.ground_rr += seen * r * r;
    sums.ground_ground += seen * gg;
}

ROUNDEL_CLONES void add_up(const MovingPixels& pixels, const MovingModel& model, float spread,
                           LaneSums& sums) {
    MovingGradient gradient;
    Columns<kColumns> columns;
    for (int begin = 0; begin < pixels.count; begin += kChunk * kLanes) {
        const int count = std::min(kChunk, (pixels.count - begin) / kLanes);
        model.evaluate(pixels.x + begin, pixels.y + begin, count, gradient);
        for (int k = 0; k < count; ++k)
            weigh(gradient, load(pixels.level + begin + k * kLanes), spread, k, columns, sums);
        multiply_all<kColumns>(columns, count, sums.gram);
    }
}

/// The path of a disc's centre, for distances of points from it in radii of the disc.
class DiscPath {
  public:
    explicit DiscPath(const MovingParameters& p) : p_(still(p)) {
        det_ = p_[kAxx] * p_[kAyy] - p_[kAxy] * p_[kAxy];
        to_radii(p[kMotionX], p[kMotionY], u_, v_);
        length_ = u_ * u_ + v_ * v_ + 1e-12;
    }
    /// Square of the distance.
    double distance2(double x, double y) const {
        double u, v;
        to_radii(x - p_[kX], y - p_[kY], u, v);
        const double t = std::clamp((u * u_ + v * v_) / length_, -0.5, 0.5);
        return square(u - t * u_) + square(v - t * v_);
    }

  private:
    void to_radii(double x, double y, double& u, double& v) const {
        u = (p_[kAyy] * x - p_[kAxy] * y) / det_;
        v = (p_[kAxx] * y - p_[kAxy] * x) / det_;
    }
    Parameters p_;
    double det_, u_, v_, length_;
};

void append(const ImageView& image, int x, int y, MovingPixels& to) {
    const int u = x + to.origin_x, v = y + to.origin_y;
    ++to.expected;
    if (u < 0 || v < 0 || u >= image.width || v >= image.height || to.used == MovingPixels::kMax) return;
    to.x[to.used] = float(x);
    to.y[to.used] = float(y);
    to.level[to.used++] = float(image.row(v)[u]);
}

/// Sums over pixels at one point of the parameters. The weight of a pixel is 1 / (1 + spread g^2); g is the
/// share of the exposure in which it sees the ground.
struct MovingSums {
    GaussNewtonSystem<kMovingCount> system;
    double w, wrr;
    double ring;           // weighted squared slopes
    double ring_rr;        // weighted squared slopes times squared residuals
    double ground;         // g^2
    double ground_rr;      // g^2 r^2
    double ground_ground;  // g^4
};

/// Selects about `limit` of the pixels over which the disc moves, with a margin.
void select_moving(const ImageView& image, const MovingParameters& p, int limit, MovingPixels& pixels) {
    const DiscPath path(p);
    const Eigen axes = eigen(circle_image(still(p), 1).shape);
    const double a = std::sqrt(axes.first), b = std::sqrt(axes.second);
    const double reach = 1 + kMargin / b, x0 = p[kStill + kX], y0 = p[kStill + kY];
    const double half_w = a * reach + std::abs(p[kMotionX]) / 2,
                 half_h = a * reach + std::abs(p[kMotionY]) / 2;
    const double area = reach * b * (std::numbers::pi * a * reach + 2 * std::hypot(p[kMotionX], p[kMotionY]));
    const int step = std::max(1, int(std::lround(std::sqrt(area / limit))));
    pixels.used = pixels.expected = 0;
    for (int y = int(y0 - half_h); y <= int(y0 + half_h); y += step)
        for (int x = int(x0 - half_w); x <= int(x0 + half_w); x += step)
            if (path.distance2(x, y) < reach * reach) append(image, x, y, pixels);
    pixels.pad();
}

/// `spread`: variance of the ground's levels over that of the noise.
MovingSums accumulate(const MovingPixels& pixels, const MovingParameters& p, double spacing, double spread) {
    LaneSums sums{};
    add_up(pixels, MovingModel(p, spacing), float(spread), sums);
    MovingSums e;
    auto& [H, g] = e.system;
    for (int i = 0; i < kMovingCount; ++i) {
        for (int j = 0; j <= i; ++j) H[i][j] = sum(sums.gram[j][i]);
        g[i] = sum(sums.gram[i][kMovingCount]);
    }
    e.wrr = sum(sums.gram[kMovingCount][kMovingCount]);
    e.w = sum(sums.w);
    e.ring = sum(sums.ring);
    e.ring_rr = sum(sums.ring_rr);
    e.ground = sum(sums.ground);
    e.ground_rr = sum(sums.ground_rr);
    e.ground_ground = sum(sums.ground_ground);
    return e;
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
