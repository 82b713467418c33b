// SPDX-License-Identifier: BSD-3-Clause
#include "fit/photometric_fit.hpp"

#include <algorithm>
#include <cmath>

#include "fit/fit_covariance.hpp"
#include "fit/photometric_fitter.hpp"
#include "fit/roundel_limits.hpp"

namespace roundel {

namespace {

// Half widths of the bands of pixels around an edge: at least so many pixels, and so many blurs.
constexpr double kNarrow = 1.25;
constexpr double kNarrowBlurs = 1.5;
constexpr double kWide = 2.5;
constexpr double kWideBlurs = 2.5;
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

constexpr double kScale = 1.06;      // standard deviation of Gaussian noise over that of weighted residuals
constexpr double kNoiseFloor = 1;    // grey levels
constexpr double kGroundChance = 4;  // standard deviations of the ground's residuals, by noise
constexpr double kEvenGround = 4;    // spread that halves the weight of pixels at the card's edge
constexpr double kReweighed = 0.1;   // of a step that changes the weights of residuals: what is left of it
constexpr double kInitialBlur = 0.8;
constexpr double kRatioPrior = 0.3;    // standard deviation
constexpr double kBlurPrior = 1;       // standard deviation
constexpr double kClippedShare = 0.1;  // of a roundel's pixels at 255, from which its paper is clipped

/// Sets bright pixels to the scale's end if many are there, since compression scatters the levels of clipped
/// paper; returns whether it did.
bool restore_clipped(EdgePixels& pixels) {
    float* const end = pixels.level + pixels.count;
    const auto clipped = std::count_if(pixels.level, end, [](float level) { return level > kSaturated; });
    if (double(clipped) < kClippedShare * pixels.used) return false;
    std::replace_if(pixels.level, end, [](float level) { return level > kClippedPlateau; }, 255.0f);
    return true;
}

}  // namespace

PhotometricFitter::PhotometricFitter(const ImageView& image, const InitialGuess& guess)
    : image_(image),
      occlusion_(guess.occlusion),
      resumed_(guess.model.has_value()),
      light_(guess.light),
      tone_(guess.tone),
      allowed_(guess.occlusion.any() ? AllowedFields::kNone : guess.fields) {
    pixels_.origin_x = int(std::lround(guess.outer.x));
    pixels_.origin_y = int(std::lround(guess.outer.y));
    p_ = start_ = initial_parameters(guess, pixels_.origin_x, pixels_.origin_y, kInitialBlur);
    prior_ = prior_information(guess.outer.major, kRatioPrior, kBlurPrior);
    if (!resumed_) return;
    p_ = *guess.model;
    start_[kGround] = p_[kGround];
    scale_ = guess.noise;
    spread_ = guess.ground;
    p_[kX] -= pixels_.origin_x;
    p_[kY] -= pixels_.origin_y;
}

/// Iterates on a subset of the pixels, from an initial guess to near the solution.
bool PhotometricFitter::approach() {
    // Perspective moves the edges of the hole and of the card away from where the guess has them.
    const double wide = kWide + 0.01 * (start_[kAxx] + start_[kAyy]);
    if (!select({wide, wide, true, wide}, kCoarsePixels)) return false;
    p_[kGround] = start_[kGround] = level_beyond_card(pixels_, p_);
    return iterate(pixels_, 2);
}

/// Iterates on all pixels until convergence.
bool PhotometricFitter::finish() {
    return select(whole_band(), EdgePixels::kMax) && (!resumed_ || resume()) && iterate(pixels_, 1);
}

EdgeBand PhotometricFitter::whole_band() const {
    const bool card = std::abs(p_[kGround] - p_[kBright]) > kMinCardStep * contrast();
    return {std::max(kNarrow, kNarrowBlurs * p_[kBlur]), std::max(kWide, kWideBlurs * p_[kBlur]), card,
            std::max(kWide, kSeparateBlurs * p_[kBlur])};
}

bool PhotometricFitter::select(EdgeBand band, int limit) {
    if (occlusion_.any()) band.separate = 0;
    select_pixels(image_, p_, band, limit, pixels_);
    if (occlusion_.any()) remove_occluded(occlusion_, start_, pixels_);
    clipped_ = restore_clipped(pixels_);
    if (has_fields_) fields_.remove_from(pixels_);
    return pixels_.used >= 2 * kCount;
}

/// Iterates on a sample of the pixels, from the last frame's model to near the solution.
bool PhotometricFitter::resume() {
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
bool PhotometricFitter::iterate(const EdgePixels& pixels, int steps_to_go) {
    const bool coarse = steps_to_go > 1;
    for (int k = 0; k < kMaxSteps; ++k) {
        equations_.linearize(pixels, p_);
        linearized_at_ = p_;
        const double seen = edge_scale();
        if (resumed_ && coarse && seen < kSlackScale * scale_) return true;
        if (resumed_ && (k == kMaxResumedSteps || seen > kMaxResumedMisfit * contrast())) return false;
        const double used = coarse ? std::min(scale_, kStrictScale * seen)
                                   : std::clamp(scale_, kStrictScale * seen, kSlackScale * seen);
        if (!solve(used)) return false;
        const double left = square(advance(used)) / p_[kBlur];
        if (!is_sane(kFitLimits)) return false;
        if (coarse ? is_near(left) : is_converged(left) && scale_ > 0.7 * used) return true;
    }
    return true;
}

bool PhotometricFitter::solve(double scale) {
    system_ = equations_.accumulate({scale, spread_});
    return factorize(system_, scale);
}

bool PhotometricFitter::is_converged(double left) const {
    return left < kConverged * noise_ / std::sqrt(edge_information());
}

bool PhotometricFitter::sees_clutter() const { return !has_fields_ && !spread_ && ground_ > kEvenGround; }

bool PhotometricFitter::weigh_ground() {
    spread_ = ground_;
    p_ = linearized_at_;
    posterior_ratio_ = 0;
    print_effect_ = curvature_effect_ = {};
    shading_effect_ = {};
    const double scale = scale_;
    if (!solve(scale)) return false;
    const double left = kReweighed * advance(scale);
    return is_sane(kFitLimits) && (is_converged(left) || iterate(pixels_, 1));
}

bool PhotometricFitter::is_near(double left) const {
    return left * contrast() < kVisible * noise_ * p_[kBlur] && is_converged(square(left) / p_[kBlur]);
}

/// Standard deviation of the residuals at the ring's edges: 1.48 times the median absolute residual.
double PhotometricFitter::edge_scale() const {
    const double median = equations_.median_residual();
    return median < 0 ? contrast() / 4 : std::max(kNoiseFloor, 1.48 * median);
}

/// Takes a step and returns the RMS displacement of the edges, pixels. (The unknowns move further: the
/// centre and the perspective are correlated.) A step reduces residuals and so increases their weights;
/// Newton's step is therefore longer by w / psi'.
double PhotometricFitter::advance(double scale) {
    Parameters delta = factor_->solve(system_.g);
    sums_ = equations_.residuals_after(delta, {scale, spread_});
    update_noise();
    for (int i = 0; i < kCount; ++i) delta[i] /= slope_;
    apply(delta);
    return std::sqrt(level_change(delta) / edge_information());
}

/// Sum of squared changes of the grey levels that a step makes by moving the edges.
double PhotometricFitter::level_change(const Parameters& delta) const {
    double sum = 0;
    for (int i = kBlur; i < kCount; ++i) {
        double row = system_.H[i][i] * delta[i];
        for (int j = kBlur; j < i; ++j) row += 2 * system_.H[i][j] * delta[j];
        sum += row * delta[i];
    }
    return sum;
}

/// Sum of the squared slopes of the grey levels.
double PhotometricFitter::edge_information() const { return system_.H[kX][kX] + system_.H[kY][kY]; }

/// Noise of the residuals on the edges; `freedom` is the share of their degrees of freedom that the
/// unknowns leave.
void PhotometricFitter::update_noise() {
    const double freedom = std::max(0.1, 1 - kEdgeUnknowns * sums_.mm / square(sums_.m));
    slope_ = std::clamp(sums_.mpsi / sums_.m, 0.5, 1.0);
    scale_ = std::max(kNoiseFloor, kScale * std::sqrt(sums_.mrr / (sums_.m * freedom)));
    noise_ = std::max(kNoiseFloor, std::sqrt(sums_.mwrr / (sums_.m * freedom)) / slope_);
    const double chance = kGroundChance * std::sqrt(2 * sums_.ground_ground);
    const double beyond = sums_.ground_rr / square(noise_) - sums_.ground - chance;
    ground_ = kPatch * std::max(0.0, beyond) / std::max(sums_.ground_ground, 1e-9);
}

PoseCovariance PhotometricFitter::pose_covariance() const {
    auto inverse = factor_->inverse_tail<kPoseCount>();
    if (has_fields_) add_fields(inverse);
    for (int i = 0; i < kPoseCount; ++i)
        for (int j = 0; j < kPoseCount; ++j)
            inverse[i][j] += shading_effect_[i][j] + curvature_effect_[i] * curvature_effect_[j] -
                             print_effect_[i] * print_effect_[j];
    return scaled(inverse, square(noise_));
}

RoundelFit PhotometricFitter::fit() const {
    Parameters print = p_;
    const Parameters effect = effect_of_curvature(curvature_);
    for (int i = 0; i < kCount; ++i) print[i] -= effect[i];
    RoundelFit fit = make_fit(print, pose_covariance(), pixels_.origin_x, pixels_.origin_y);
    for (const int i : {kAxx, kAyy, kRatio}) fit.p[i] = p_[i];
    if (posterior_ratio_ > 0) fit.p[kRatio] = posterior_ratio_;
    fit.ratio = ratio();
    fit.curvature = expected_curvature_;
    fit.ratio_sigma = std::sqrt(covariance_with_ratio()[kRatio]);
    fit.edge_residual = std::sqrt(sums_.ring_rr / sums_.ring);
    fit.noise = scale_;
    fit.ground = spread_ && ground_ > kEvenGround ? ground_ : 0;
    fit.shading = shading_;
    fit.clipped = clipped_;
    fit.uneven = scores_.light > kUnlikelyField;
    fit.fields = fields_;
    fit.bend = bend();
    fit.support = sums_.agreeing / sums_.ring * pixels_.used / pixels_.expected;
    return fit;
}

/// The iterations; false if they leave the neighbourhood of the guess.
static bool converges(PhotometricFitter& fitter, const InitialGuess& guess) {
    if (guess.fields == AllowedFields::kAll) return fitter.fit_fields();
    if (!(guess.model || fitter.approach()) || !fitter.finish()) return false;
    return !fitter.shows_bend() || fitter.fit_fields();
}

/// The fit at a solution, with what is known of levels, prints and light.
static RoundelFit conclude(PhotometricFitter& fitter, const InitialGuess& guess) {
    fitter.use_plateaus();
    fitter.expect_curvature(guess.curvature_sigma);
    if (!guess.prints.empty()) fitter.use_print(nearest_print(guess.prints, fitter.ratio()));
    if (guess.light.sigma > 0 && !fitter.knows_light()) fitter.allow_shading();
    return fitter.fit();
}

std::optional<RoundelFit> fit_photometric(const ImageView& image, const InitialGuess& guess) {
    PhotometricFitter fitter(image, guess);
    return converges(fitter, guess) ? std::optional(conclude(fitter, guess)) : std::nullopt;
}

std::optional<GroundFits> fit_on_ground(const ImageView& image, const InitialGuess& guess) {
    PhotometricFitter fitter(image, guess);
    if (!converges(fitter, guess)) return std::nullopt;
    GroundFits fits{conclude(fitter, guess), std::nullopt};
    if (fitter.sees_clutter() && fitter.weigh_ground()) fits.weighed = conclude(fitter, guess);
    return fits;
}

}  // namespace roundel
