// SPDX-License-Identifier: BSD-3-Clause
#include "fit/photometric_fit.hpp"

#include <algorithm>
#include <cmath>
#include <tuple>

#include "numeric/cholesky.hpp"
#include "fit/edge_pixels.hpp"
#include "fit/normal_equations.hpp"
#include "fit/pose_outputs.hpp"
#include "settings.hpp"
#include "fit/starting_point.hpp"

namespace roundel {

namespace {

constexpr double kNarrow = 1.25,
                 kNarrowBlurs = 1.5;             // pixels on either side of an edge, at the least; and blurs
constexpr double kWide = 2.5, kWideBlurs = 2.5;  // likewise
// Likewise, away from other edges: flat pixels tell the levels, these the size.
constexpr double kApartBlurs = 4;
constexpr double kCardTells = 0.2;  // of the contrast, between card and ground; less is not worth its pixels
constexpr int kCoarsePixels = 200;
constexpr int kMaxSteps = 12;
constexpr double kConverged = 1;           // standard deviations that may be left to go
constexpr double kShows = 2.5;             // times the noise: an edge's slope is 0.4 of contrast over blur
constexpr int kResumedPixels = 128;        // first, if there are
constexpr int kWorthSampling = 3;          // times as many
constexpr int kResumed = 3;                // steps at most from the model of the frame before, and
constexpr double kLost = 0.25;             // the contrast's share in the residuals of edges half a blur off
constexpr int kEdgeUnknowns = kCount - 3;  // all but the levels
constexpr double kScale = 1.06;    // standard deviation of Gaussian noise over that of its weighed residuals
constexpr double kNoiseFloor = 1;  // grey levels
constexpr double kStartBlur = 0.8;
constexpr double kAnyRatio = 0.3, kAnyBlur = 1;  // standard deviations before a pixel is seen
constexpr double kBeyond = 64;     // grey levels off the scale that a small or clipped roundel may need
constexpr double kPrint = 0.002;   // standard deviation of ratios among prints of one kind
constexpr double kOtherPrint = 3;  // standard deviations
constexpr double kStrict = 0.5;    // of it at first, when the model still bends to what it disagrees with
constexpr double kSlack = 1.3;     // of a median of few, over the deviation it stands for

double square(double x) { return x * x; }

/// Gauss-Newton on the pixels near one roundel's edges.
class Fitter {
  public:
    Fitter(const ImageView& image, const Start& start) : image_(image), hidden_(start.hidden) {
        pixels_.origin_x = int(std::lround(start.outer.x));
        pixels_.origin_y = int(std::lround(start.outer.y));
        p = start_ = starting_point(start, pixels_.origin_x, pixels_.origin_y, kStartBlur);
        prior_ = prior_information(start.outer.major, kAnyRatio, kAnyBlur);
        resumed_ = start.model.has_value();
        if (resumed_) {
            p = *start.model, start_[kGround] = p[kGround], scale_ = start.noise;
            p[kX] -= pixels_.origin_x, p[kY] -= pixels_.origin_y;
        }
    }

    /// From the start to near the solution.
    bool approach() {
        // Perspective moves the inner edge and the card's from where the start has them.
        const double wide = kWide + 0.01 * (start_[kAxx] + start_[kAyy]);
        if (!select({wide, wide, true, wide}, kCoarsePixels)) return false;
        p[kGround] = start_[kGround] = level_beyond_card(pixels_, p);
        return iterate(pixels_, 2);
    }

    bool finish() {
        const bool card = std::abs(p[kGround] - p[kBright]) > kCardTells * (p[kBright] - p[kDark]);
        const Band band{std::max(kNarrow, kNarrowBlurs * p[kBlur]), std::max(kWide, kWideBlurs * p[kBlur]),
                        card, std::max(kWide, kApartBlurs * p[kBlur])};
        return select(band, EdgePixels::kMax) && (!resumed_ || resume()) && iterate(pixels_, 1);
    }

    void learn_print(double ratio);
    Fit fit() const;
    Parameters p;

  private:
    bool try_print(double ratio);
    Parameters covariance_with_ratio() const;
    std::array<Vector<kPoseCount>, kPoseCount> pose_covariance() const;

    bool select(Band band, int limit) {
        if (hidden_.any()) band.apart = 0;
        select_pixels(image_, p, band, limit, pixels_);
        if (hidden_.any()) leave_out(hidden_, start_, pixels_);
        return pixels_.used >= 2 * kCount;
    }

    /// From the model of the frame before to near the solution, on few of many pixels.
    bool resume() {
        const int one_in = pixels_.count / kResumedPixels;
        if (one_in < kWorthSampling) return true;
        pixels_.sample(one_in, few_);
        return iterate(few_, 2);
    }

    /// Steps until what is left, of the order of one's square over the blur, is small against the standard
    /// deviation, or, a step ahead of that, will be and shows less than the noise. The model of the frame
    /// before has to be near enough for a step or a few; ahead, none where what is seen differs from it by no
    /// more than noise.
    bool iterate(const EdgePixels& pixels, int ahead) {
        for (int k = 0; k < kMaxSteps; ++k) {
            model_.evaluate(pixels, p);
            const double seen = edge_scale();
            if (resumed_ && ahead > 1 && seen < kSlack * scale_) return true;
            if (resumed_ && (k == kResumed || seen > kLost * (p[kBright] - p[kDark]))) return false;
            const double used = ahead > 1 ? std::min(scale_, kStrict * seen)
                                          : std::clamp(scale_, kStrict * seen, kSlack * seen);
            if (!factorise(used)) return false;
            const double left = square(advance(used)) / p[kBlur];
            if (!is_sane()) return false;
            if (ahead > 1 ? is_near(left) : is_there(left) && scale_ > 0.7 * used) return true;
        }
        return true;
    }

    bool factorise(double scale) {
        equations_ = model_.accumulate(scale);
        add_prior(scale);
        factor_.emplace(equations_.H);
        return factor_->positive();
    }

    bool is_there(double left) const { return left < kConverged * noise_ / std::sqrt(edge_information()); }
    bool is_near(double left) const {
        return left * (p[kBright] - p[kDark]) < kShows * noise_ * p[kBlur] &&
               is_there(square(left) / p[kBlur]);
    }

    /// Of the residuals at the ring's edges (1.48 of their median is a standard deviation).
    double edge_scale() const {
        const double median = model_.median_residual();
        return median < 0 ? (p[kBright] - p[kDark]) / 4 : std::max(kNoiseFloor, 1.48 * median);
    }

    void add_prior(double noise) {
        for (int i = 0; i < kCount; ++i) {
            const double information = noise * noise * prior_[i];
            equations_.H[i][i] += information;
            equations_.g[i] += information * (start_[i] - p[i]);
        }
    }

    /// Takes a step, and gives how far it moves the edges, pixels RMS. (Its unknowns go further: the centre
    /// and the perspective may trade places.) Weights fall with the residuals that a step takes away, and
    /// make it shorter than Newton's by psi' over w.
    double advance(double scale) {
        Parameters delta = factor_->solve(equations_.g);
        left_ = model_.after(delta, scale);
        update_noise();
        for (int i = 0; i < kCount; ++i) delta[i] /= slope_, p[i] += delta[i];
        p[kBlur] = std::max(p[kBlur], kMinBlur);
        return std::sqrt(change(delta) / edge_information());
    }

    /// The sum of squared changes of the levels that a step brings about by its edges.
    double change(const Parameters& delta) const {
        double sum = 0;
        for (int i = kBlur; i < kCount; ++i) {
            double row = equations_.H[i][i] * delta[i];
            for (int j = kBlur; j < i; ++j) row += 2 * equations_.H[i][j] * delta[j];
            sum += row * delta[i];
        }
        return sum;
    }

    /// Sum of the levels' squared slopes.
    double edge_information() const { return equations_.H[kX][kX] + equations_.H[kY][kY]; }

    /// Of residuals on the edges; `freedom` is the share of them that the unknowns do not follow.
    void update_noise() {
        const double freedom = std::max(0.1, 1 - kEdgeUnknowns * left_.mm / square(left_.m));
        slope_ = std::clamp(left_.mpsi / left_.m, 0.5, 1.0);
        scale_ = std::max(kNoiseFloor, kScale * std::sqrt(left_.mrr / (left_.m * freedom)));
        noise_ = std::max(kNoiseFloor, std::sqrt(left_.mwrr / (left_.m * freedom)) / slope_);
    }

    bool is_sane() const {
        const double size = start_[kAxx] * start_[kAyy] - square(start_[kAxy]);
        const double area = (p[kAxx] * p[kAyy] - square(p[kAxy])) / size;
        return std::hypot(p[kX] - start_[kX], p[kY] - start_[kY]) < 1 + 0.1 * std::sqrt(size) &&
               p[kAxx] > 0 && area > square(0.7) && area < square(1.4) && p[kRatio] > 0.1 &&
               p[kRatio] < 0.95 && p[kBlur] < 3 + 0.1 * std::sqrt(size) && p[kCard] > 1 &&
               p[kDark] > -kBeyond && p[kBright] < 255 + kBeyond &&
               square(p[kGx]) + square(p[kGy]) < square(0.5 / p[kCard]);
    }

    const ImageView& image_;
    Hidden hidden_;
    EdgePixels pixels_, few_;
    Parameters start_, prior_;
    Linearisation model_;
    NormalEquations equations_;
    Leftover left_;
    std::optional<Cholesky<kCount>> factor_;
    Vector<kPoseCount> known_{};  // known_ known_^T is what the print took off the covariance
    double print_ = 0;            // the ratio that the rest of `p` goes with; 0 where no print is known
    double scale_ = 255, noise_ = 0, slope_ = 1;
    bool resumed_;
};

Parameters Fitter::covariance_with_ratio() const {
    Parameters unit{};
    unit[kRatio] = square(noise_);
    return factor_->solve(unit);
}

/// The Gaussian posterior of the fit, given that the ratio is `ratio` to within what prints differ by;
/// whether that is likely.
bool Fitter::try_print(double ratio) {
    const Parameters with = covariance_with_ratio();
    const double off = ratio - p[kRatio], variance = with[kRatio] + square(kPrint);
    if (square(off) > square(kOtherPrint) * variance) return false;
    for (int i = 0; i < kCount; ++i)
        if (i != kRatio) p[i] += with[i] * off / variance;  // what was measured stays to be judged
    for (int i = 0; i < kPoseCount; ++i) known_[i] = with[kX + i] / (noise_ * std::sqrt(variance));
    print_ = ratio;
    return true;
}

/// Where the print seems to be another one, by a step from where the fit would be if it were not: of a small
/// and blurred roundel the ratio's variance there and at the fit differ (a score test after Wald's).
void Fitter::learn_print(double ratio) {
    if (try_print(ratio)) return;
    const auto found = std::tuple(p, factor_, left_, noise_, scale_);
    const Parameters with = covariance_with_ratio();
    const double off = ratio - p[kRatio];
    for (int i = 0; i < kCount; ++i) p[i] += with[i] * off / with[kRatio];
    if (is_sane()) {
        model_.evaluate(pixels_, p);
        if (factorise(scale_) && (advance(scale_), is_sane()) && try_print(ratio)) return;
    }
    std::tie(p, factor_, left_, noise_, scale_) = found;
}

std::array<Vector<kPoseCount>, kPoseCount> Fitter::pose_covariance() const {
    auto inverse = factor_->inverse_tail<kPoseCount>();
    for (int i = 0; i < kPoseCount; ++i)
        for (int j = 0; j < kPoseCount; ++j) inverse[i][j] -= known_[i] * known_[j];
    for (auto& row : inverse)
        for (double& value : row) value *= square(noise_);
    return inverse;
}

Fit Fitter::fit() const {
    Fit fit = fit_of(p, pose_covariance(), pixels_.origin_x, pixels_.origin_y);
    if (print_ > 0) fit.p[kRatio] = print_;
    fit.ratio_sigma = std::sqrt(covariance_with_ratio()[kRatio]);
    fit.edge_residual = std::sqrt(left_.ring_rr / left_.ring);
    fit.noise = scale_;
    fit.support = left_.agreeing / left_.ring * pixels_.used / pixels_.expected;
    return fit;
}

}  // namespace

std::optional<Fit> refine(const ImageView& image, const Start& start) {
    Fitter fitter(image, start);
    if (!(start.model || fitter.approach()) || !fitter.finish()) return std::nullopt;
    if (!start.prints.empty()) fitter.learn_print(nearest_ratio(start.prints, fitter.p[kRatio]));
    return fitter.fit();
}

}  // namespace roundel
