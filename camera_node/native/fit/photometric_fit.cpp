// SPDX-License-Identifier: BSD-3-Clause
#include "fit/photometric_fit.hpp"

#include <algorithm>
#include <cmath>
#include <tuple>

#include "fit/edge_pixels.hpp"
#include "fit/fit_covariance.hpp"
#include "fit/gauss_newton.hpp"
#include "fit/normal_equations.hpp"
#include "fit/plateaus.hpp"
#include "fit/roundel_limits.hpp"

namespace roundel {

namespace {

// Half widths of the bands of pixels around an edge: at least so many pixels, and so many blurs.
constexpr double kNarrow = 1.25, kNarrowBlurs = 1.5;
constexpr double kWide = 2.5, kWideBlurs = 2.5;
constexpr double kSeparateBlurs = 4;  // of wide bands that contain a single edge, and of plateaus
constexpr double kMinCardStep = 0.2;  // of the contrast: a smaller step from card to ground is not fitted

constexpr int kCoarsePixels = 200;
constexpr int kMaxSteps = 12;
constexpr double kConverged = 1;            // remaining distance in standard deviations
constexpr double kVisible = 2.5;            // times the noise: the slope of an edge is 0.4 contrast / blur
constexpr int kResumedPixels = 128;         // of the first iterations from the last frame's model,
constexpr int kMinSampling = 3;             // used if there are so many times as many pixels
constexpr int kMaxResumedSteps = 3;         // from the last frame's model
constexpr double kMaxResumedMisfit = 0.25;  // residuals over the contrast: edges are off by half a blur
constexpr int kEdgeUnknowns = kCount - 3;   // all but the grey levels

constexpr double kScale = 1.06;    // standard deviation of Gaussian noise over that of weighted residuals
constexpr double kNoiseFloor = 1;  // grey levels
constexpr double kStrict = 0.5;    // lower bound of the scale over that of the current residuals, and
constexpr double kSlack = 1.3;     // upper bound: tolerance of a median of few residuals
constexpr double kInitialBlur = 0.8;
constexpr double kRatioPrior = 0.3, kBlurPrior = 1;  // standard deviations
constexpr double kMaxPrintError = 3;                 // standard deviations
constexpr int kMinPlateau = 16;                      // pixels
constexpr double kPlateauVariance = 2;               // factor from that of the residuals at the edges
constexpr double kMaxPlateauError = 3;               // standard deviations
constexpr double kClippedShare = 0.1;  // of a roundel's pixels at 255, from which its paper is clipped
constexpr float kPlateau = 235;        // level that compression leaves of clipped paper
constexpr SanityLimits kLimits{
    .shift = 0.1, .min_size = 0.7, .max_size = 1.4, .blur = 0.1, .underflow = 64, .overflow = 600};

/// Sets bright pixels to the scale's end if many are there, since compression scatters the levels of clipped
/// paper; returns whether it did.
bool restore_clipped(EdgePixels& pixels) {
    float* const end = pixels.level + pixels.count;
    const auto clipped = std::count_if(pixels.level, end, [](float level) { return level > kSaturated; });
    if (double(clipped) < kClippedShare * pixels.used) return false;
    std::replace_if(pixels.level, end, [](float level) { return level > kPlateau; }, 255.0f);
    return true;
}

class PhotometricFitter : GaussNewton<kCount> {
  public:
    PhotometricFitter(const ImageView& image, const InitialGuess& guess)
        : image_(image),
          occlusion_(guess.occlusion),
          resumed_(guess.model.has_value()),
          shading_sigma_(guess.shading_sigma),
          curvature_sigma_(guess.curvature_sigma) {
        pixels_.origin_x = int(std::lround(guess.outer.x));
        pixels_.origin_y = int(std::lround(guess.outer.y));
        p_ = start_ = initial_parameters(guess, pixels_.origin_x, pixels_.origin_y, kInitialBlur);
        prior_ = prior_information(guess.outer.major, kRatioPrior, kBlurPrior);
        if (!resumed_) return;
        p_ = *guess.model, start_[kGround] = p_[kGround], scale_ = guess.noise;
        p_[kX] -= pixels_.origin_x, p_[kY] -= pixels_.origin_y;
    }

    /// Iterates on a subset of the pixels, from an initial guess to near the solution.
    bool approach() {
        // Perspective moves the edges of the hole and of the card away from where the guess has them.
        const double wide = kWide + 0.01 * (start_[kAxx] + start_[kAyy]);
        if (!select({wide, wide, true, wide}, kCoarsePixels)) return false;
        p_[kGround] = start_[kGround] = level_beyond_card(pixels_, p_);
        return iterate(pixels_, 2);
    }

    /// Iterates on all pixels until convergence.
    bool finish() {
        const bool card = std::abs(p_[kGround] - p_[kBright]) > kMinCardStep * contrast();
        const EdgeBand band{std::max(kNarrow, kNarrowBlurs * p_[kBlur]),
                            std::max(kWide, kWideBlurs * p_[kBlur]), card,
                            std::max(kWide, kSeparateBlurs * p_[kBlur])};
        return select(band, EdgePixels::kMax) && (!resumed_ || resume()) && iterate(pixels_, 1);
    }

    double ratio() const { return p_[kRatio]; }
    void use_plateaus();
    void use_print(const Print& print);
    void allow_shading();
    RoundelFit fit() const;

  private:
    bool condition_on_plateau(Parameter level, const Plateau& plateau, Parameters& g);
    bool condition_on_print(const Print& print);
    Parameters covariance_with_ratio() const;
    Parameters effect_of_curvature() const;
    PoseCovariance pose_covariance() const;

    bool select(EdgeBand band, int limit) {
        if (occlusion_.any()) band.separate = 0;
        select_pixels(image_, p_, band, limit, pixels_);
        if (occlusion_.any()) remove_occluded(occlusion_, start_, pixels_);
        clipped_ = restore_clipped(pixels_);
        return pixels_.used >= 2 * kCount;
    }

    /// Iterates on a sample of the pixels, from the last frame's model to near the solution.
    bool resume() {
        const int one_in = pixels_.count / kResumedPixels;
        if (one_in < kMinSampling) return true;
        pixels_.sample(one_in, sample_);
        return iterate(sample_, 2);
    }

    /// Iterates until the remaining error, of the order of a step's square over the blur, is small against
    /// the standard deviation. With `steps_to_go` = 2 it stops one step earlier: when the next step will
    /// reach that and the remaining error is below the noise.
    ///
    /// Fails if the last frame's model is not within a few steps of the solution. No step is taken on the
    /// sample if its residuals are no larger than the noise.
    bool iterate(const EdgePixels& pixels, int steps_to_go) {
        const bool coarse = steps_to_go > 1;
        for (int k = 0; k < kMaxSteps; ++k) {
            equations_.linearize(pixels, p_), linearized_at_ = p_;
            const double seen = edge_scale();
            if (resumed_ && coarse && seen < kSlack * scale_) return true;
            if (resumed_ && (k == kMaxResumedSteps || seen > kMaxResumedMisfit * contrast())) return false;
            const double used =
                coarse ? std::min(scale_, kStrict * seen) : std::clamp(scale_, kStrict * seen, kSlack * seen);
            if (!solve(used)) return false;
            const double left = square(advance(used)) / p_[kBlur];
            if (!is_sane(kLimits)) return false;
            if (coarse ? is_near(left) : is_converged(left) && scale_ > 0.7 * used) return true;
        }
        return true;
    }

    bool solve(double scale) {
        system_ = equations_.accumulate(scale);
        return factorize(system_, scale);
    }

    bool is_converged(double left) const {
        return left < kConverged * noise_ / std::sqrt(edge_information());
    }
    bool is_near(double left) const {
        return left * contrast() < kVisible * noise_ * p_[kBlur] && is_converged(square(left) / p_[kBlur]);
    }

    /// Standard deviation of the residuals at the ring's edges: 1.48 times the median absolute residual.
    double edge_scale() const {
        const double median = equations_.median_residual();
        return median < 0 ? contrast() / 4 : std::max(kNoiseFloor, 1.48 * median);
    }

    /// Takes a step and returns the RMS displacement of the edges, pixels. (The unknowns move further: the
    /// centre and the perspective are correlated.) A step reduces residuals and so increases their weights;
    /// Newton's step is therefore longer by w / psi'.
    double advance(double scale) {
        Parameters delta = factor_->solve(system_.g);
        sums_ = equations_.residuals_after(delta, scale);
        update_noise();
        for (int i = 0; i < kCount; ++i) delta[i] /= slope_;
        apply(delta);
        return std::sqrt(level_change(delta) / edge_information());
    }

    /// Sum of squared changes of the grey levels that a step makes by moving the edges.
    double level_change(const Parameters& delta) const {
        double sum = 0;
        for (int i = kBlur; i < kCount; ++i) {
            double row = system_.H[i][i] * delta[i];
            for (int j = kBlur; j < i; ++j) row += 2 * system_.H[i][j] * delta[j];
            sum += row * delta[i];
        }
        return sum;
    }

    /// Sum of the squared slopes of the grey levels.
    double edge_information() const { return system_.H[kX][kX] + system_.H[kY][kY]; }

    /// Noise of the residuals on the edges; `freedom` is the share of their degrees of freedom that the
    /// unknowns leave.
    void update_noise() {
        const double freedom = std::max(0.1, 1 - kEdgeUnknowns * sums_.mm / square(sums_.m));
        slope_ = std::clamp(sums_.mpsi / sums_.m, 0.5, 1.0);
        scale_ = std::max(kNoiseFloor, kScale * std::sqrt(sums_.mrr / (sums_.m * freedom)));
        noise_ = std::max(kNoiseFloor, std::sqrt(sums_.mwrr / (sums_.m * freedom)) / slope_);
    }

    const ImageView& image_;
    OcclusionMask occlusion_;
    EdgePixels pixels_, sample_;
    NormalEquations equations_;
    GaussNewtonSystem<kCount> system_;
    ResidualSums sums_;
    Parameters linearized_at_{};
    PoseCovariance shading_effect_{};    // on the covariance, in units of the noise
    Vector<kPoseCount> print_effect_{};  // its outer product is what the print takes off the covariance
    double posterior_ratio_ = 0;         // given the print; 0 if no print is known
    double scale_ = 255, noise_ = 0, slope_ = 1;
    bool resumed_, clipped_ = false;
    double shading_sigma_, curvature_sigma_;
    Vector<kPoseCount>
        curvature_effect_{};  // its outer product is what the tone curve adds to the covariance
    Shading shading_;
};

/// Adds the level of a plateau to the system, and its residual to `g`; false if that level is not the one at
/// the edges: where cameras sharpen, in uneven light, or for writing on the paper. Its noise must be that of
/// the edges, too, which a tone curve and compression change.
bool PhotometricFitter::condition_on_plateau(Parameter level, const Plateau& plateau, Parameters& g) {
    if (plateau.count < kMinPlateau || plateau.variance > kPlateauVariance * square(noise_) ||
        plateau.variance < square(noise_) / kPlateauVariance)
        return false;
    if (plateau.mean < 2 * noise_ || plateau.mean > kPlateau) return false;  // the scale's ends
    Parameters unit{};
    unit[level] = 1;
    double variance = 1.0 / plateau.count;  // in units of the noise: of the plateau, and of the fit's level
    for (const double x : factor_->halfway(unit)) variance += square(x);
    const double off = plateau.mean - p_[level], n = plateau.count;
    if (square(off) > square(kMaxPlateauError * noise_) * variance) return false;
    system_.H[level][level] += n, g[level] = n * off;
    return true;
}

/// Conditions the estimate on the levels far from the edges. They are most of the pixels of a large roundel,
/// and its size depends on the level half way between them.
void PhotometricFitter::use_plateaus() {
    if (occlusion_.any() || clipped_) return;
    const Plateaus plateaus =
        read_plateaus(image_, p_, pixels_.origin_x, pixels_.origin_y, kSeparateBlurs * p_[kBlur]);
    Parameters g{};
    const bool ring = condition_on_plateau(kDark, plateaus.ring, g);
    if (!condition_on_plateau(kBright, plateaus.hole, g) && !ring) return;
    factor_.emplace(system_.H);
    apply(factor_->solve(g));
}

Parameters PhotometricFitter::covariance_with_ratio() const {
    Parameters unit{};
    unit[kRatio] = square(noise_);
    return factor_->solve(unit);
}

/// The displacement of the estimate by one standard deviation of the curvature that is left in the camera's
/// tone curve: both edges move into the ring.
Parameters PhotometricFitter::effect_of_curvature() const {
    const double shift = curvature_sigma_ * kEdgeShift * p_[kBlur];
    const double radius = std::sqrt(p_[kAxx] * p_[kAyy] - square(p_[kAxy]));
    Parameters effect{};
    effect[kAxx] = effect[kAyy] = -shift, effect[kRatio] = shift * (1 + p_[kRatio]) / radius;
    return effect;
}

/// Conditions the Gaussian posterior on the print's ratio; false if that ratio is unlikely. What is left of
/// the tone curve is one more unknown, with a prior: the difference of the ratios shows it.
bool PhotometricFitter::condition_on_print(const Print& print) {
    Parameters with = covariance_with_ratio();
    const Parameters bent = effect_of_curvature();
    for (int i = 0; i < kCount; ++i) with[i] += bent[i] * bent[kRatio];
    const double off = print.ratio - p_[kRatio], variance = with[kRatio] + square(print.sigma);
    if (square(off) > square(kMaxPrintError) * variance) return false;
    for (int i = 0; i < kCount; ++i)
        if (i != kRatio) p_[i] += with[i] * off / variance;  // the measured ratio is kept for the tests
    for (int i = 0; i < kPoseCount; ++i) curvature_effect_[i] = bent[kX + i] / noise_;
    for (int i = 0; i < kPoseCount; ++i) print_effect_[i] = with[kX + i] / (noise_ * std::sqrt(variance));
    posterior_ratio_ = p_[kRatio] + with[kRatio] * off / variance;
    return true;
}

/// Conditions the estimate on a print. If its ratio is unlikely, tries again at the constrained estimate: the
/// ratio's variance there and at the free one differ for small and blurred roundels (a score test after
/// Wald's test).
void PhotometricFitter::use_print(const Print& print) {
    if (condition_on_print(print)) return;
    const auto saved = std::tuple(p_, factor_, sums_, noise_, scale_);
    const Parameters with = covariance_with_ratio();
    const double off = print.ratio - p_[kRatio];
    for (int i = 0; i < kCount; ++i) p_[i] += with[i] * off / with[kRatio];
    if (is_sane(kLimits)) {
        equations_.linearize(pixels_, p_), linearized_at_ = p_;
        if (solve(scale_) && (advance(scale_), is_sane(kLimits)) && condition_on_print(print)) return;
    }
    std::tie(p_, factor_, sums_, noise_, scale_) = saved;
}

/// Includes the two unknowns of a linear shading in the pose, after convergence: with C the products of their
/// columns with those of the parameters, D their own and e their residuals,
///   S = D + prior - C^T H^-1 C,  shading = S^-1 (e - C^T step),  pose <- pose - (H^-1 C shading)_pose.
/// The covariance grows by H^-1 C S^-1 C^T H^-1. The shading is relative to the level at the pixels' origin.
void PhotometricFitter::allow_shading() {
    const ShadingProducts products = equations_.shading(pixels_, scale_);
    const auto& [Cx, Cy] = products.parameters;
    const Parameters yx = factor_->halfway(Cx), yy = factor_->halfway(Cy);
    Symmetric S = products.own;
    auto [ex, ey] = products.residuals;
    for (int i = 0; i < kCount; ++i) {
        const double step = p_[i] - linearized_at_[i];
        ex -= Cx[i] * step, ey -= Cy[i] * step;
        S.xx -= yx[i] * yx[i], S.xy -= yx[i] * yy[i], S.yy -= yy[i] * yy[i];
    }
    if (!(S.det() > 0 && S.xx > 0)) return;
    shading_ = {(square(S.yy * ex - S.xy * ey) + square(S.xx * ey - S.xy * ex)) / square(S.det()),
                square(noise_) * (S.xx + S.yy) / (2 * S.det())};
    const double prior = square(noise_ / shading_sigma_);
    S.xx += prior, S.yy += prior;
    const double det = S.det();
    const double sx = (S.yy * ex - S.xy * ey) / det, sy = (S.xx * ey - S.xy * ex) / det;
    const auto Kx = factor_->solve_tail<kPoseCount>(yx), Ky = factor_->solve_tail<kPoseCount>(yy);
    for (int i = 0; i < kPoseCount; ++i) p_[kX + i] -= Kx[i] * sx + Ky[i] * sy;
    for (int i = 0; i < kPoseCount; ++i)
        for (int j = 0; j < kPoseCount; ++j)
            shading_effect_[i][j] =
                (S.yy * Kx[i] * Kx[j] - S.xy * (Kx[i] * Ky[j] + Ky[i] * Kx[j]) + S.xx * Ky[i] * Ky[j]) / det;
}

PoseCovariance PhotometricFitter::pose_covariance() const {
    auto inverse = factor_->inverse_tail<kPoseCount>();
    for (int i = 0; i < kPoseCount; ++i)
        for (int j = 0; j < kPoseCount; ++j)
            inverse[i][j] += shading_effect_[i][j] + curvature_effect_[i] * curvature_effect_[j] -
                             print_effect_[i] * print_effect_[j];
    return scaled(inverse, square(noise_));
}

RoundelFit PhotometricFitter::fit() const {
    RoundelFit fit = make_fit(p_, pose_covariance(), pixels_.origin_x, pixels_.origin_y);
    if (posterior_ratio_ > 0) fit.p[kRatio] = posterior_ratio_;
    fit.ratio_sigma = std::sqrt(covariance_with_ratio()[kRatio]);
    fit.edge_residual = std::sqrt(sums_.ring_rr / sums_.ring);
    fit.noise = scale_, fit.shading = shading_, fit.clipped = clipped_;
    fit.support = sums_.agreeing / sums_.ring * pixels_.used / pixels_.expected;
    return fit;
}

}  // namespace

std::optional<RoundelFit> fit_photometric(const ImageView& image, const InitialGuess& guess) {
    PhotometricFitter fitter(image, guess);
    if (!(guess.model || fitter.approach()) || !fitter.finish()) return std::nullopt;
    fitter.use_plateaus();
    if (!guess.prints.empty()) fitter.use_print(nearest_print(guess.prints, fitter.ratio()));
    if (guess.shading_sigma > 0) fitter.allow_shading();
    return fitter.fit();
}

}  // namespace roundel
