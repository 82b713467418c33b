// SPDX-License-Identifier: BSD-3-Clause
#include "fit/photometric_fit.hpp"

#include <algorithm>
#include <cmath>
#include <tuple>

#include "fit/edge_pixels.hpp"
#include "fit/field_equations.hpp"
#include "fit/gauss_newton.hpp"
#include "fit/normal_equations.hpp"
#include "numeric/cholesky.hpp"

namespace roundel {

namespace {

// 1. Pixels and iterations
// Half widths of the bands of pixels around an edge: at least so many pixels, and so many blurs.
constexpr double kNarrow = 1.25;
constexpr double kNarrowBlurs = 1.5;
constexpr double kWide = 2.5;

constexpr int kCoarsePixels = 200;
constexpr int kMaxSteps = 12;
constexpr double kVisible = 2.5;            // times the noise: the slope of an edge is 0.4 contrast / blur
constexpr int kResumedPixels = 128;         // of the first iterations from the last frame's model,
constexpr int kMinSampling = 3;             // used if there are so many times as many pixels
constexpr double kMaxResumedMisfit = 0.25;  // residuals over the contrast: edges are off by half a blur
constexpr int kEdgeUnknowns = kCount - 3;   // all but the grey levels

constexpr double kScale = 1.06;      // standard deviation of Gaussian noise over that of weighted residuals
constexpr double kNoiseFloor = 1;    // grey levels
constexpr double kEvenGround = 4;    // spread that halves the weight of pixels at the card's edge
constexpr double kReweighed = 0.1;   // of a step that changes the weights of residuals: what is left of it
constexpr double kRatioPrior = 0.3;  // standard deviation
constexpr double kBlurPrior = 1;     // standard deviation

constexpr SanityLimits kFitLimits{
    .shift = 0.1, .min_size = 0.7, .max_size = 1.4, .blur = 0.1, .underflow = 64, .overflow = 600};

// Bounds of the scale of residuals over that of the current ones
constexpr double kStrictScale = 0.5;
constexpr double kSlackScale = 1.3;  // the tolerance of a median of few residuals

constexpr double kSeparateBlurs = 4;  // of wide bands that contain a single edge, and of plateaus

// 2. Fields of light and of bent paper
constexpr int kFieldSteps = 8;
constexpr double kFirstScale = 0.1;   // of the contrast: residuals of the first step
constexpr double kFieldChange = 0.1;  // of a standard deviation: a smaller step ends the iteration
// Standard deviations of the fields:
constexpr double kLightSigma = 0.3;   // light over its mean, and gloss over the contrast, up to second order
constexpr double kCubicSigma = 0.05;  // the same of third order
constexpr double kBendSigma = 0.05;   // height of bent paper over its width, as displacement with three
                                      // periods at a tilt of 45 degrees
constexpr double kLeastTilt = 0.05;
// Residuals from which a fit is no roundel on bent paper, over the contrast. A bend of 2 % leaves 0.14 at 160
// px and residuals grow with bend and size, until edges are a blur away: 0.35 for one of 5 % there.
constexpr double kBentResidual = 0.35 / 160;  // for each pixel of the diameter,
constexpr double kLeastBentResidual = 0.2;    // and at least this
// Standard deviation of the level around a card in uneven light, over the contrast: no function of light is
// as good there as on the print.
constexpr double kUnevenGround = 0.04;

// 3. Levels far from the edges
constexpr double kMinPlateauMajor = 48;  // pixels: smaller ones gain less than a tone curve costs
constexpr double kPlateauVariance = 2;   // factor from that of the residuals at the edges

// 4. The print
constexpr double kOtherPrint = 0.1;  // difference of ratios of another print, however uncertain the ratio is

/// The fields that a fit contains or tests its residuals for.
struct FieldEstimate {
    bool fitted = false;
    Fields in_image;  // in the image's frame
    FieldScores scores{};
    std::array<Parameters, kFields> effect{};    // of each field's error on the parameters
    std::array<Vector<kFields>, kFields> cov{};  // in units of the noise
};

/// The curvature of the tone curve between the levels of ink and paper.
struct ToneEstimate {
    double expected = 0;             // before the print is used
    double sigma = 0;                // of what remains
    double seen = 0;                 // given the print
    Vector<kPoseCount> deviation{};  // its outer product is what the curve adds to the covariance
};

/// What a known print tells of the pose.
struct PrintEstimate {
    double ratio = 0;                // given the print; 0 if no print is known
    Vector<kPoseCount> deviation{};  // its outer product is what the print takes off the covariance
};

/// A linear shading of the roundel, beside the expected one.
struct ShadingEstimate {
    Shading seen;
    PoseCovariance effect{};  // on the covariance, in units of the noise
    double ratio = 0;         // on the ratio's variance, in the same units
};

/// One photometric fit: the state that its stages share. `fit_photometric`, at the end, calls them in order.
class PhotometricFitter : GaussNewton<kCount> {
  public:
    PhotometricFitter(const ImageView& image, const InitialGuess& guess);

    // 1. Pixels and iterations
    /// Iterates on a subset of the pixels, from an initial guess to near the solution.
    bool approach();
    /// Iterates on all pixels until convergence.
    bool finish();
    /// Whether the residuals beyond the card show levels that vary.
    bool sees_clutter() const { return !fields_.fitted && !spread_ && ground_ > kEvenGround; }
    /// Weights the pixels that see the ground as these residuals require, and solves again.
    bool weigh_ground();

    // 2. Fields of light and of bent paper
    /// Tests the residuals for uneven light and for bent paper; whether the guess allows the latter and the
    /// residuals show it.
    bool shows_bend();
    /// Fits the fields with the parameters; false if that does not converge.
    bool fit_fields();
    bool knows_light() const { return fields_.fitted && allowed_ == AllowedFields::kAll; }

    // 3. Levels far from the edges
    /// Conditions the estimate on the levels far from the edges.
    void use_plateaus();

    // 4. The tone curve and the print
    /// Looks up the curvature between the levels of ink and paper; `sigma` is that of what remains.
    void expect_curvature(const ToneRemainder* tone, double sigma);
    /// Conditions the estimate on a print.
    void use_print(const Print& print);
    /// Measured, without the expected effect of the tone curve.
    double ratio() const { return p_[kRatio] - effect_of_curvature(tone_.expected)[kRatio]; }

    // 5. Shading
    /// Includes the two unknowns of a linear shading in the pose, after convergence.
    void allow_shading(const LightGradient& light);

    // 6. The result
    RoundelFit fit() const;

  private:
    bool select(EdgeBand band, int limit);
    bool resume();
    bool iterate(const EdgePixels& pixels, int steps_to_go);
    void linearize(const EdgePixels& pixels);
    bool solve(double scale);
    bool is_converged(double left) const;
    bool is_near(double left) const;
    double edge_scale() const;
    double advance(double scale);
    double level_change(const Parameters& delta) const;
    double edge_information() const;
    void update_noise();
    EdgeBand whole_band() const;

    bool step_with_fields(const Vector<kFields>& prior, double& moved);
    Vector<kFields> field_prior() const;

    bool condition_on_plateau(Parameter level, const Plateau& plateau, Parameters& g);
    bool condition_on_print(const Print& print);
    Parameters covariance_with_ratio() const;
    Parameters effect_of_curvature(double curvature) const;

    PoseCovariance pose_covariance() const;
    void add_fields(PoseCovariance& inverse) const;
    Bend bend() const;

    // Given
    const ImageView& image_;
    OcclusionMask occlusion_;
    AllowedFields allowed_;
    bool resumed_;  // from the last frame's model
    bool known_clipped_;
    // The pixels, and the last linearization
    EdgePixels pixels_;
    EdgePixels sample_;
    bool clipped_ = false;
    NormalEquations equations_;
    Parameters linearized_at_{};
    GaussNewtonSystem<kCount> system_;
    ResidualSums sums_;
    // The residuals
    double scale_ = 255;  // standard deviation, grey levels
    double noise_ = 0;    // the same, as it counts for the covariance
    double slope_ = 1;    // mean psi' over mean w
    double spread_ = 0;   // of the ground, in the last solution
    double ground_ = 0;   // of the ground, as the residuals show
    // The stages
    FieldEstimate fields_;
    ToneEstimate tone_;
    PrintEstimate print_;
    ShadingEstimate shading_;
};

PhotometricFitter::PhotometricFitter(const ImageView& image, const InitialGuess& guess)
    : image_(image),
      occlusion_(guess.occlusion),
      allowed_(guess.occlusion.any() ? AllowedFields::kNone : guess.fields),
      resumed_(guess.model.has_value()),
      known_clipped_(guess.clipped) {
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

// 1. Pixels and iterations

/// Iterates on a subset of the pixels, from an initial guess to near the solution.
bool PhotometricFitter::approach() {
    // Perspective moves the edges of the hole and of the card away from where the guess has them.
    const double wide = kWide + 0.01 * (start_[kAxx] + start_[kAyy]);
    if (!select({wide, wide, true, wide}, kCoarsePixels)) return false;
    p_[kGround] = start_[kGround] = level_beyond_card(pixels_, p_);
    return iterate(pixels_, 2);
}

/// Iterates on all pixels until convergence.
bool PhotometricFitter::finish() { return select(whole_band(), EdgePixels::kMax) && iterate(pixels_, 1); }

EdgeBand PhotometricFitter::whole_band() const {
    const bool card = std::abs(p_[kGround] - p_[kBright]) > kMinCardStep * contrast();
    return {std::max(kNarrow, kNarrowBlurs * p_[kBlur]), kWide * std::max(1.0, p_[kBlur]), card,
            std::max(kWide, kSeparateBlurs * p_[kBlur])};
}

bool PhotometricFitter::select(EdgeBand band, int limit) {
    if (occlusion_.any()) band.separate = 0;
    select_pixels(image_, p_, band, limit, pixels_);
    if (occlusion_.any()) remove_occluded(occlusion_, start_, pixels_);
    clipped_ = mark_clipped(p_[kBright], known_clipped_, pixels_);
    if (fields_.fitted) fields_.in_image.remove_from(pixels_);
    return pixels_.used >= 2 * kCount;
}

/// Iterates on a sample of the pixels, from the last frame's model to near the solution.
bool PhotometricFitter::resume() {
    pixels_.sample(pixels_.count / kResumedPixels, sample_);
    return iterate(sample_, 2);
}

/// Iterates until the remaining error, of the order of a step's square over the blur, is small against
/// the standard deviation. With `steps_to_go` = 2 it stops one step earlier: when the next step will
/// reach that and the remaining error is below the noise.
///
/// Fails if the last frame's model is not within a few steps of the solution. Only if its residuals are
/// larger than the noise, steps on a sample precede those on all pixels.
bool PhotometricFitter::iterate(const EdgePixels& pixels, int steps_to_go) {
    const bool coarse = steps_to_go > 1;
    for (int k = 0; k < kMaxSteps; ++k) {
        linearize(pixels);
        const double seen = edge_scale();
        if (resumed_ && seen > kMaxResumedMisfit * contrast()) return false;
        if (resumed_ && !coarse && !k && seen > kSlackScale * scale_ &&
            pixels_.count >= kMinSampling * kResumedPixels) {
            if (!resume()) return false;
            continue;
        }
        const double used = coarse ? std::min(scale_, kStrictScale * seen)
                                   : std::clamp(scale_, kStrictScale * seen, kSlackScale * seen);
        if (!solve(used)) return false;
        const double left = square(advance(used)) / p_[kBlur];
        if (!is_sane(kFitLimits)) return false;
        if (coarse ? is_near(left) : is_converged(left) && scale_ > 0.7 * used) return true;
    }
    return true;
}

void PhotometricFitter::linearize(const EdgePixels& pixels) {
    equations_.linearize(pixels, p_);
    linearized_at_ = p_;
}

bool PhotometricFitter::solve(double scale) {
    system_ = equations_.accumulate({scale, spread_});
    return factorize(system_, scale);
}

bool PhotometricFitter::is_converged(double left) const {
    return left < noise_ / std::sqrt(edge_information());
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
    const double chance = kUnlikely * std::sqrt(2 * sums_.ground_ground);
    const double beyond = sums_.ground_rr / square(noise_) - sums_.ground - chance;
    ground_ = kPatch * std::max(0.0, beyond) / std::max(sums_.ground_ground, 1e-9);
}

bool PhotometricFitter::weigh_ground() {
    spread_ = ground_;
    p_ = linearized_at_;
    print_.ratio = 0;
    print_.deviation = tone_.deviation = {};
    shading_.effect = {};
    const double scale = scale_;
    if (!solve(scale)) return false;
    const double left = kReweighed * advance(scale);
    return is_sane(kFitLimits) && (is_converged(left) || iterate(pixels_, 1));
}

// 2. Fields of light and of bent paper

bool PhotometricFitter::shows_bend() {
    if (occlusion_.any()) return false;
    Parameters step = p_;
    for (int i = 0; i < kCount; ++i) step[i] -= linearized_at_[i];
    fields_.scores = score_fields(equations_, pixels_, FieldFrame(p_), step, {scale_, spread_});
    for (double* score : {&fields_.scores.bend, &fields_.scores.light}) *score /= square(noise_);
    const double most = std::max(kLeastBentResidual, kBentResidual * (p_[kAxx] + p_[kAyy]));
    return allowed_ == AllowedFields::kBend && fields_.scores.bend > kUnlikelySquare &&
           scale_ < most * contrast();
}

/// The prior information on each field.
Vector<kFields> PhotometricFitter::field_prior() const {
    const auto from_sigma = [](double sigma) { return 1 / square(sigma); };
    const bool light = allowed_ == AllowedFields::kAll;
    constexpr double kNever = 1e-9;
    Vector<kFields> prior;
    for (int i = 0; i < kLightFields; ++i) {
        const double sigma = !light ? kNever : i < kCubic ? kLightSigma : kCubicSigma;
        prior[size_t(kLight + i)] = from_sigma(sigma);
        prior[size_t(kGloss + i)] = from_sigma(sigma * contrast());
    }
    prior[kBend] = prior[kBend + 1] =
        from_sigma(kBendSigma * std::max(kLeastTilt, fields_.in_image.frame.tilt()));
    return prior;
}

/// Gauss-Newton steps of the parameters and the fields. The pixels are selected again for each, since the
/// fields change their places and levels.
bool PhotometricFitter::fit_fields() {
    fields_.in_image = {FieldFrame(p_), {}};
    fields_.fitted = true;
    fields_.in_image.frame.x += pixels_.origin_x;
    fields_.in_image.frame.y += pixels_.origin_y;
    const Vector<kFields> prior = field_prior();
    const double ground = spread_;  // that the fit in even light shows
    for (int k = 0; k < kFieldSteps; ++k) {
        if (!select(whole_band(), EdgePixels::kMax)) return false;
        linearize(pixels_);
        const double seen = edge_scale();
        // The first step weights all pixels: what the fields explain shall not count as outliers.
        scale_ = k ? std::clamp(scale_, kStrictScale * seen, kSlackScale * seen)
                   : std::max(seen, kFirstScale * contrast());
        if (allowed_ == AllowedFields::kAll)
            spread_ = std::max(ground, kPatch * square(kUnevenGround * contrast() / scale_));
        if (!solve(scale_)) return false;
        double moved = 0;
        if (!step_with_fields(prior, moved) || !is_sane(kFitLimits)) return false;
        if (k > 1 && moved < kFieldChange * noise_) break;
    }
    return true;
}

/// With C the products of the fields' columns with those of the parameters, D their own, e their residuals
/// and L their prior, eliminates the parameters:
///   S = D + L - C^T H^-1 C,  fields <- fields + S^-1 (e - C^T step - L fields),
/// and the parameters' step decreases by H^-1 C times that change.
bool PhotometricFitter::step_with_fields(const Vector<kFields>& prior, double& moved) {
    Parameters step = factor_->solve(system_.g);
    FieldFrame frame = fields_.in_image.frame;
    frame.x -= pixels_.origin_x;
    frame.y -= pixels_.origin_y;
    const auto products = field_products(equations_, pixels_, frame, {scale_, spread_});
    std::array<Vector<kFields>, kFields> S = products.own;
    std::array<Parameters, kFields> half;
    Vector<kFields> right = products.residuals;
    for (size_t a = 0; a < kFields; ++a) {
        half[a] = factor_->halfway(products.parameters[a]);
        for (size_t b = 0; b <= a; ++b)
            for (size_t i = 0; i < kCount; ++i) S[a][b] -= half[a][i] * half[b][i];
        S[a][a] += square(scale_) * prior[a];
        right[a] -= square(scale_) * prior[a] * fields_.in_image.of[a];
        for (size_t i = 0; i < kCount; ++i) right[a] -= products.parameters[a][i] * step[i];
    }
    const Cholesky<kFields> factor(S);
    if (!factor.positive()) return false;
    Vector<kFields> change = factor.solve(right);
    if (allowed_ != AllowedFields::kAll)
        std::fill_n(change.begin(), size_t(kBend), 0.0);  // the prior forbids it
    for (size_t a = 0; a < kFields; ++a) {
        fields_.effect[a] = factor_->solve_tail<kCount>(half[a]);
        for (size_t i = 0; i < kCount; ++i) step[i] -= fields_.effect[a][i] * change[a];
    }
    fields_.cov = factor.inverse_tail<kFields>();
    sums_ = equations_.residuals_after(step, {scale_, spread_});
    update_noise();
    for (size_t a = 0; a < kFields; ++a) fields_.in_image.of[a] += change[a];
    apply(step);
    moved = std::sqrt(level_change(step) / double(std::max(1, pixels_.used)));
    return true;
}

// 3. Levels far from the edges

/// Adds the level of a plateau to the system, and its residual to `g`; false if that level is not the one at
/// the edges: where cameras sharpen, in uneven light, or for writing on the paper. Its noise must be that of
/// the edges, too, which a tone curve and compression change.
bool PhotometricFitter::condition_on_plateau(Parameter level, const Plateau& plateau, Parameters& g) {
    if (plateau.count == 0 || plateau.variance > kPlateauVariance * square(noise_) ||
        plateau.variance < square(noise_) / kPlateauVariance)
        return false;
    if (plateau.mean < 2 * noise_ || plateau.mean > double(kClipped)) return false;  // the scale's ends
    Parameters unit{};
    unit[level] = 1;
    double variance = 1.0 / plateau.count;  // in units of the noise: of the plateau, and of the fit's level
    for (const double x : factor_->halfway(unit)) variance += square(x);
    const double off = plateau.mean - p_[level], n = plateau.count;
    if (square(off) > square(kContradiction * noise_) * variance) return false;
    system_.H[level][level] += n;
    g[level] = n * off;
    return true;
}

/// Conditions the estimate on the levels far from the edges. They are most of the pixels of a large roundel,
/// and its size depends on the level half way between them.
void PhotometricFitter::use_plateaus() {
    const double major = p_[kAxx] + p_[kAyy] + std::hypot(p_[kAxx] - p_[kAyy], 2 * p_[kAxy]);
    if (occlusion_.any() || clipped_ || fields_.fitted || major < kMinPlateauMajor) return;
    const Plateaus plateaus =
        read_plateaus(image_, p_, pixels_.origin_x, pixels_.origin_y, kSeparateBlurs * p_[kBlur]);
    Parameters g{};
    const bool ring = condition_on_plateau(kDark, plateaus.ring, g);
    if (!condition_on_plateau(kBright, plateaus.hole, g) && !ring) return;
    factor_.emplace(system_.H);
    apply(factor_->solve(g));
}

// 4. The tone curve and the print

Parameters PhotometricFitter::covariance_with_ratio() const {
    Parameters unit{};
    unit[kRatio] = square(noise_);
    Parameters with = factor_->solve(unit);
    if (!fields_.fitted) return with;
    for (size_t a = 0; a < kFields; ++a)
        for (size_t b = 0; b < kFields; ++b)
            for (size_t i = 0; i < kCount; ++i)
                with[i] +=
                    square(noise_) * fields_.effect[a][i] * fields_.cov[a][b] * fields_.effect[b][kRatio];
    return with;
}

/// The displacement of the estimate in the image by a curvature of the tone curve: both edges move into the
/// ring.
Parameters PhotometricFitter::effect_of_curvature(double curvature) const {
    const double shift = curvature * kEdgeShift * p_[kBlur];
    const double radius = std::sqrt(p_[kAxx] * p_[kAyy] - square(p_[kAxy]));
    Parameters effect{};
    effect[kAxx] = effect[kAyy] = -shift;
    effect[kRatio] = shift * (1 + p_[kRatio]) / radius;
    return effect;
}

void PhotometricFitter::expect_curvature(const ToneRemainder* tone, double sigma) {
    tone_.expected = tone_.seen = tone ? tone->curvature(p_[kDark], p_[kBright]) : 0;
    tone_.sigma = std::hypot(sigma, tone_.expected);
    const Parameters bent = effect_of_curvature(tone_.sigma);
    for (int i = 0; i < kPoseCount; ++i) tone_.deviation[i] = bent[kX + i] / noise_;
}

/// Conditions the Gaussian posterior on the print's ratio; false if that ratio is unlikely. What is left of
/// the tone curve is one more unknown, with a prior: the difference of the ratios shows it. The estimate
/// remains that of the image, which contains the effect of the tone curve.
bool PhotometricFitter::condition_on_print(const Print& print) {
    const Parameters with = covariance_with_ratio(), bent = effect_of_curvature(tone_.sigma);
    const double seen = print.ratio + effect_of_curvature(tone_.expected)[kRatio];
    const double off = seen - p_[kRatio];
    const double variance = with[kRatio] + square(bent[kRatio]) + square(print.sigma) + print.spread;
    if (square(off) > square(kContradiction) * variance) return false;
    for (int i = 0; i < kPoseCount; ++i) {
        const double both = with[kX + i] + bent[kX + i] * bent[kRatio];
        tone_.deviation[i] = bent[kX + i] / noise_;
        print_.deviation[i] = both / (noise_ * std::sqrt(variance));
    }
    print_.ratio = p_[kRatio] + with[kRatio] * off / variance;
    tone_.seen = tone_.expected - tone_.sigma * bent[kRatio] * off / variance;
    for (int i = 0; i < kCount; ++i)
        if (i != kRatio) p_[i] += with[i] * off / variance;  // the tests need the measured ratio
    return true;
}

/// Conditions the estimate on a print. If its ratio is unlikely, tries again at the constrained estimate: the
/// ratio's variance there and at the free one differ for small and blurred roundels (a score test after
/// Wald's test).
void PhotometricFitter::use_print(const Print& print) {
    if (condition_on_print(print) || fields_.fitted) return;
    const auto saved = std::tuple(p_, factor_, sums_, noise_, scale_);
    const Parameters with = covariance_with_ratio();
    const double off = print.ratio + effect_of_curvature(tone_.expected)[kRatio] - p_[kRatio];
    if (std::abs(off) > kOtherPrint) return;
    for (int i = 0; i < kCount; ++i) p_[i] += with[i] * off / with[kRatio];
    if (is_sane(kFitLimits)) {
        linearize(pixels_);
        if (solve(scale_)) {
            advance(scale_);
            if (is_sane(kFitLimits) && condition_on_print(print)) return;
        }
    }
    std::tie(p_, factor_, sums_, noise_, scale_) = saved;
}

// 5. Shading

/// Includes the two unknowns of a linear shading in the pose, after convergence: with C the products of their
/// columns with those of the parameters, D their own, e their residuals, and L and m the information and the
/// mean of the prior,
///   S = D + L - C^T H^-1 C,  shading = S^-1 (e - C^T step + L m),  pose <- pose - (H^-1 C shading)_pose.
/// The covariance grows by H^-1 C S^-1 C^T H^-1. So do the measured ratio and its variance, which the light
/// displaces where a part of the ring is covered. The shading is relative to the level at the pixels' origin.
void PhotometricFitter::allow_shading(const LightGradient& light) {
    const auto products = shading_products(equations_, pixels_, {scale_, spread_});
    const auto& [Cx, Cy] = products.parameters;
    const Parameters yx = factor_->halfway(Cx), yy = factor_->halfway(Cy);
    Symmetric S{products.own[0][0], products.own[1][0], products.own[1][1]};
    double ex = products.residuals[0] / slope_, ey = products.residuals[1] / slope_;
    for (int i = 0; i < kCount; ++i) {
        const double step = p_[i] - linearized_at_[i];
        ex -= Cx[i] * step;
        ey -= Cy[i] * step;
        S.xx -= yx[i] * yx[i];
        S.xy -= yx[i] * yy[i];
        S.yy -= yy[i] * yy[i];
    }
    if (!(S.det() > 0 && S.xx > 0)) return;
    shading_.seen = {(S.yy * ex - S.xy * ey) / S.det(), (S.xx * ey - S.xy * ex) / S.det(),
                     square(noise_) * (S.xx + S.yy) / (2 * S.det())};
    const double prior = square(noise_ / light.sigma);
    S.xx += prior;
    S.yy += prior;
    ex += prior * light.x;
    ey += prior * light.y;
    const double det = S.det();
    const double sx = (S.yy * ex - S.xy * ey) / det, sy = (S.xx * ey - S.xy * ex) / det;
    const double left_x = shading_.seen.x - sx, left_y = shading_.seen.y - sy;
    const bool contradicts =
        square(left_x) + square(left_y) > kUnlikelySquare * (shading_.seen.variance + square(light.sigma));
    const Parameters by_x = factor_->solve_tail<kCount>(yx), by_y = factor_->solve_tail<kCount>(yy);
    const double* Kx = &by_x[kX];
    const double* Ky = &by_y[kX];
    const auto covariance = [&](double ix, double iy, double jx, double jy) {
        return (S.yy * ix * jx - S.xy * (ix * jy + iy * jx) + S.xx * iy * jy) / det;
    };
    // Around a whole ring the displacements of opposite sides cancel; what a covered one itself shows may be
    // its cover.
    if (occlusion_.any()) {
        p_[kRatio] -= by_x[kRatio] * light.x + by_y[kRatio] * light.y;
        shading_.ratio = (square(by_x[kRatio]) + square(by_y[kRatio])) / prior;
    }
    Vector<kPoseCount>
        left{};  // the shift by what the prior does not allow of the shading seen, over the noise
    for (int i = 0; i < kPoseCount; ++i) {
        p_[kX + i] -= Kx[i] * sx + Ky[i] * sy;
        if (contradicts) left[i] = (Kx[i] * left_x + Ky[i] * left_y) / noise_;
    }
    for (int i = 0; i < kPoseCount; ++i)
        for (int j = 0; j < kPoseCount; ++j)
            shading_.effect[i][j] = left[i] * left[j] + covariance(Kx[i], Ky[i], Kx[j], Ky[j]);
}

// 6. The result

/// Adds what the errors of the fields contribute to the covariance, in units of the noise.
void PhotometricFitter::add_fields(PoseCovariance& inverse) const {
    for (size_t a = 0; a < kFields; ++a)
        for (size_t b = 0; b < kFields; ++b)
            for (size_t i = 0; i < kPoseCount; ++i)
                for (size_t j = 0; j < kPoseCount; ++j)
                    inverse[i][j] +=
                        fields_.effect[a][kX + i] * fields_.cov[a][b] * fields_.effect[b][kX + j];
}

/// The bend that the fit contains, or what the residuals show of one that it does not.
Bend PhotometricFitter::bend() const {
    if (fields_.fitted)
        return {square(fields_.in_image.bend()),
                square(noise_) * (fields_.cov[kBend][kBend] + fields_.cov[kBend + 1][kBend + 1]) / 2};
    if (!(fields_.scores.bend_information > 0)) return {};
    const double variance = square(noise_) / fields_.scores.bend_information;
    return {fields_.scores.bend * variance, variance};
}

PoseCovariance PhotometricFitter::pose_covariance() const {
    auto inverse = factor_->inverse_tail<kPoseCount>();
    if (fields_.fitted) add_fields(inverse);
    for (int i = 0; i < kPoseCount; ++i)
        for (int j = 0; j < kPoseCount; ++j)
            inverse[i][j] += shading_.effect[i][j] + tone_.deviation[i] * tone_.deviation[j] -
                             print_.deviation[i] * print_.deviation[j];
    return scaled(inverse, square(noise_));
}

RoundelFit PhotometricFitter::fit() const {
    Parameters print = p_;
    const Parameters effect = effect_of_curvature(tone_.seen);
    for (int i = 0; i < kCount; ++i) print[i] -= effect[i];
    RoundelFit fit = make_fit(print, pose_covariance(), pixels_.origin_x, pixels_.origin_y);
    for (const int i : {kAxx, kAyy, kRatio}) fit.p[i] = p_[i];
    if (print_.ratio > 0) fit.p[kRatio] = print_.ratio;
    fit.ratio = ratio();
    fit.curvature = tone_.expected;
    fit.ratio_sigma = std::sqrt(covariance_with_ratio()[kRatio] + square(noise_) * shading_.ratio);
    fit.edge_residual = std::sqrt(sums_.ring_rr / sums_.ring);
    fit.noise = scale_;
    fit.ground = spread_ && ground_ > kEvenGround ? ground_ : 0;
    fit.shading = shading_.seen;
    fit.clipped = clipped_;
    fit.uneven = fields_.scores.light > kUnlikelySquare;
    fit.fields = fields_.in_image;
    fit.bend = bend();
    fit.support = sums_.agreeing / sums_.ring * pixels_.used / pixels_.expected;
    return fit;
}

/// The Jacobian of the outputs (centre e = c - A g of the outer ellipse, its shape A, and the offset c - e of
/// the disc's centre) with respect to the model's pose (c, A, g), to first order in g.
PoseCovariance output_jacobian(const Parameters& p) {
    const double gx = p[kGx], gy = p[kGy];
    const Vector<kPoseCount> hx{0, 0, gx, gy, 0, p[kAxx], p[kAxy]}, hy{0, 0, 0, gx, gy, p[kAxy], p[kAyy]};
    PoseCovariance J{};
    for (int k = 0; k < kPoseCount; ++k) {
        J[0][k] = -hx[k];
        J[1][k] = -hy[k];
        J[5][k] = hx[k];
        J[6][k] = hy[k];
    }
    for (int k = 0; k < 5; ++k) J[k][k] += 1;
    return J;
}

/// J pose J^T.
PoseCovariance propagate(const PoseCovariance& J, const PoseCovariance& pose) {
    PoseCovariance half{}, whole{};
    for (int a = 0; a < kPoseCount; ++a)
        for (int i = 0; i < kPoseCount; ++i)
            for (int j = 0; j < kPoseCount; ++j) half[a][j] += J[a][i] * pose[i][j];
    for (int a = 0; a < kPoseCount; ++a)
        for (int b = 0; b < kPoseCount; ++b)
            for (int j = 0; j < kPoseCount; ++j) whole[a][b] += half[a][j] * J[b][j];
    return whole;
}

/// Iterates to the solution; false if the iterations leave the neighbourhood of the guess.
bool converges(PhotometricFitter& fitter, const InitialGuess& guess) {
    if (guess.fields == AllowedFields::kAll) return fitter.fit_fields();
    if (!guess.model && !fitter.approach()) return false;
    if (!fitter.finish()) return false;
    return !fitter.shows_bend() || fitter.fit_fields();
}

/// The fit at a solution, with what is known of levels, tone curve, print and light.
RoundelFit conclude(PhotometricFitter& fitter, const InitialGuess& guess) {
    fitter.use_plateaus();
    const CameraPrior& camera = guess.camera;
    fitter.expect_curvature(camera.tone, camera.curvature_sigma);
    if (!camera.prints.empty()) fitter.use_print(nearest_print(camera.prints, fitter.ratio()));
    if (camera.light.sigma > 0 && !fitter.knows_light()) fitter.allow_shading(camera.light);
    return fitter.fit();
}

}  // namespace

RoundelFit make_fit(const Parameters& p, const PoseCovariance& pose, int origin_x, int origin_y) {
    const CircleImage outer = circle_image(p, 1);
    const Eigen axes = eigen(outer.shape);
    RoundelFit fit{};
    fit.outer = {outer.x + origin_x, outer.y + origin_y, 2 * std::sqrt(axes.first),
                 2 * std::sqrt(axes.second), axes.angle};
    fit.offset_x = p[kX] - outer.x;
    fit.offset_y = p[kY] - outer.y;
    fit.pose_cov = propagate(output_jacobian(p), pose);
    fit.ratio = p[kRatio];
    fit.dark = p[kDark];
    fit.bright = p[kBright];
    fit.blur = p[kBlur];
    fit.p = p;
    fit.p[kX] += origin_x;
    fit.p[kY] += origin_y;
    return fit;
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
