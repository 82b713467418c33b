// SPDX-License-Identifier: BSD-3-Clause
#include "verify/camera_model.hpp"

#include <algorithm>
#include <cmath>

namespace roundel {

namespace {

constexpr double kMaxLogExponent = 0.9;  // in use, 2.5: steeper ones enlarge what compression leaves
constexpr double kSteepest = 3;          // measured, 20: powers of levels remain numbers
constexpr int kSteps = 6;                // of Newton's method
constexpr double kSecondOrder = 0.15;    // error of a measured curvature, over its square
constexpr double kMinLeft = 0.15;    // of a curvature: less is the error of the print, or learned as a spread
constexpr double kMinChange = 0.02;  // of the logarithm
constexpr double kMaxSigma = 0.15;   // of the logarithm, from which it is used
// Of normal variables: the median's standard deviation times the root of their number, over their median
// distance from it, sqrt(pi / 2) times 1.48; and the median square over the variance.
constexpr double kMedianSigma = 1.86;
constexpr double kMedianSquare = 0.455;

/// The logarithm of the exponent that makes a level, at a share of `middle` between `dark` and `bright`, the
/// mean of both; levels of 255. It is the exponent of the power mean of both that is this level.
double log_exponent_of(double dark, double bright, double middle) {
    const double d = std::log(std::max(dark, 1.0) / 255), b = std::log(bright / 255),
                 m = std::log((dark + middle * (bright - dark)) / 255);
    double log_g = 0;
    for (int k = 0; k < kSteps; ++k) {
        const double g = std::exp(log_g), of_dark = std::exp(g * d), of_bright = std::exp(g * b);
        const double off = m - std::log((of_dark + of_bright) / 2) / g;
        const double slope = m - off - (d * of_dark + b * of_bright) / (of_dark + of_bright);
        log_g = std::clamp(log_g - off / slope, -kSteepest, kSteepest);
    }
    return log_g;
}

}  // namespace

CameraModel::CameraModel(std::vector<Print> given, bool any) : prints_(std::move(given)) {
    set_exponent(0);
    if (!any) return;
    ratios_.emplace();
    prints_ = ratios_->prints();
}

std::optional<double> CameraModel::exponent() const {
    return knows_tone_ ? std::optional(std::exp(log_exponent_)) : std::nullopt;
}

ImageView CameraModel::linearize(const ImageView& image) {
    if (log_exponent_ == 0) return image;
    buffer_.resize(size_t(image.width) * size_t(image.height));
    uint8_t* to = buffer_.data();
    for (int y = 0; y < image.height; ++y, to += image.width)
        std::transform(image.row(y), image.row(y) + image.width, to,
                       [&](uint8_t level) { return linear_[level]; });
    return {buffer_.data(), image.width, image.height, image.width};
}

CameraPrior CameraModel::prior_at(double x, double y) const {
    return {prints_, light_.at(x, y), &remainder_, std::sqrt(curvature_.value())};
}

bool CameraModel::observe(const std::vector<Observation>& roundels, const ImageView& image) {
    std::vector<const RoundelFit*> all, lit, whole;
    for (const auto& [fit, track] : roundels) {
        all.push_back(fit);
        if (fit->unoccluded) whole.push_back(fit);
        if (fit->unoccluded || fit->provisional) lit.push_back(fit);
    }
    if (contradicts(roundels)) forget();
    if (ratios_ && ratios_->learn(roundels)) prints_ = ratios_->prints();
    light_.learn(lit, image);
    const bool is_other = learn_response(all);
    bend_.learn(whole, std::max(1.0, correlation_.value()));
    return is_other;
}

/// Learns tone curve and processing. Grey levels of a linear image do not compare with those of another one.
bool CameraModel::learn_response(const std::vector<const RoundelFit*>& fits) {
    learn_edge_noise(fits);
    std::vector<ToneEstimate> measured;
    std::vector<ToneSample> samples;
    for (const RoundelFit* fit : fits)
        if (const auto estimate = measure(*fit)) {
            measured.push_back(estimate->power);
            samples.push_back(estimate->sample);
        }
    learn_curvature(fits);
    if (measured.empty()) return false;
    const double exponent = exponent_in_use();
    const bool had_remainder = remainder_.any();
    const bool changed = learn_tone(std::move(measured));
    is_new_ = false;
    learn_remainder(samples);
    if (!changed) return remainder_.any() != had_remainder;
    last_.clear();
    light_.scale(exponent_in_use() / exponent);
    if (ratios_) ratios_->forget_measurements();
    return true;
}

/// What the difference between the measured ratio and the print's says about the tone curve, beyond what the
/// fit contains of it. A curve that brightens the levels between ink and paper by `curvature` s (1 - s) moves
/// both edges into the ring. None if the roundel shows no curvature that a camera's curve may have.
std::optional<CameraModel::CurvatureSeen> CameraModel::curvature_of(const RoundelFit& fit) const {
    if (!is_measured(fit)) return std::nullopt;
    const Print& print = nearest_print(prints_, fit.ratio);
    const double by_curvature = ratio_by_curvature(fit, print.ratio);
    const double left = (fit.ratio - print.ratio) / by_curvature;
    const double sigma = std::hypot(fit.ratio_sigma, print.sigma) / by_curvature;
    if (std::abs(left + fit.curvature) + sigma > kMaxCurvature) return std::nullopt;
    return CurvatureSeen{print, by_curvature, left, sigma};
}

std::optional<CameraModel::ToneMeasurement> CameraModel::measure(const RoundelFit& fit) const {
    const auto seen = curvature_of(fit);
    if (!seen) return std::nullopt;
    const auto& [print, by_curvature, left, sigma] = *seen;
    const double curvature = left + fit.curvature;
    const bool is_other = left < kMinCurvature && !is_new_;
    if (!print.is_exact() && is_other) return std::nullopt;
    const auto exponent = [&](double k) { return log_exponent_of(fit.dark, fit.bright, 0.5 + k / 4); };
    const double here = exponent(curvature);
    const double middle = fit.dark + (0.5 + curvature / 4) * fit.contrast();
    const double exact = std::hypot(sigma, kSecondOrder * square(curvature));
    const auto share = [&](double level) { return EncodedLevel(encoded(level) / 255); };
    return ToneMeasurement{{log_exponent_ + here, std::abs(exponent(curvature + sigma) - here)},
                           {share(fit.dark), share(middle), share(fit.bright), exact}};
}

/// What the tone curve leaves beside the power, if the power does not describe it.
void CameraModel::learn_remainder(const std::vector<ToneSample>& samples) {
    tone_.learn(samples);
    const double exponent = std::exp(log_exponent_);
    left_.include(left_by_power(exponent, samples));
    const bool is_power = left_.value() < square(kMinLeft);
    if (is_power == remainder_.any() || !sigma_.is_known()) curvature_.forget();
    if (is_power) {
        remainder_ = {};
        return;
    }
    std::array<double, 256> light;
    for (int level = 0; level < 256; ++level)
        light[size_t(level)] = tone_.light(std::pow(level / 255.0, 1 / exponent));
    remainder_ = ToneRemainder(light);
}

void CameraModel::learn_edge_noise(const std::vector<const RoundelFit*>& fits) {
    if (fits.empty()) return;
    const auto median = [&](auto of) {
        std::vector<double> values;
        for (const RoundelFit* fit : fits) values.push_back(fit->*of);
        return median_of(values);
    };
    edge_noise_.include(median(&RoundelFit::edge_residual));
    correlation_.include(median(&RoundelFit::correlation));
}

/// Whether the ratios of the last frame's roundels changed: those of prints do not, so the camera did.
bool CameraModel::contradicts(const std::vector<Observation>& roundels) {
    std::vector<double> scores;
    std::vector<SeenRatio> seen;
    for (const auto& [fit, track] : roundels) {
        if (track < 0 || !is_measured(*fit)) continue;
        const SeenRatio now{track, fit->ratio, square(fit->ratio_sigma) + square(Print::kPaper)};
        const auto last = std::find_if(last_.begin(), last_.end(), [number = track](const SeenRatio& ratio) {
            return ratio.track == number;
        });
        if (last != last_.end())
            scores.push_back(square(now.ratio - last->ratio) / (now.variance + last->variance));
        seen.push_back(now);
    }
    last_ = std::move(seen);
    return scores.size() >= kMinWitnesses && median_of(scores) > square(kContradiction);
}

/// Lets the next frame replace what was measured in levels of another linearization.
void CameraModel::forget_response() {
    for (FrameMean* mean : {&mean_, &sigma_, &left_, &edge_noise_, &correlation_}) mean->forget();
}

/// Lets the next frames teach all but the prints from the start.
void CameraModel::forget() {
    forget_response();
    curvature_.forget();
    knows_tone_ = false;
    tone_ = {};
    remainder_ = {};
    light_ = {};
    bend_ = {};
    is_new_ = true;
    if (ratios_) ratios_->forget_measurements();
}

void CameraModel::claim(RoundelFit& fit) const {
    fit.correlation = std::max({1.0, fit.correlation, correlation_.value()});
    fit.pose_cov = scaled(fit.pose_cov, fit.correlation);
    // Clipped paper hides the part of an edge that would show the tone curve: its prior stays.
    const double unknown = fit.clipped && !knows_tone_ ? square(kCurvaturePrior) : 0;
    fit.widen_size(std::max(surprise_, unknown) * square(kEdgeShift * fit.blur));
    bend_.claim(fit);
}

void CameraModel::take_over(const CameraModel& from) {
    auto prints = std::move(prints_);
    auto ratios = std::move(ratios_);
    *this = from;
    if (ratios && ratios_) return;
    prints_ = std::move(prints);
    ratios_ = std::move(ratios);
}

std::vector<double> CameraModel::recurring() const {
    return ratios_ ? ratios_->recurring() : std::vector<double>();
}

/// The excess of the differences from the prints' ratios over their uncertainty, which counts twice so that
/// chance alone does not widen the claims of a linear camera. A squared normal variable has the median 0.455.
void CameraModel::learn_curvature(const std::vector<const RoundelFit*>& fits) {
    std::vector<double> excess;
    double least = square(kMaxCurvature);  // variance of the exponent's own error, as a curvature
    for (const RoundelFit* fit : fits) {
        const auto seen = curvature_of(*fit);
        if (!seen) continue;
        least = std::min(least, square(seen->sigma));
        excess.push_back(square(seen->left) / kMedianSquare - 2 * square(seen->sigma));
    }
    surprise_ = 0;
    if (excess.empty()) return;
    const double variance = median_of(excess);
    surprise_ = std::max({0.0, variance - curvature_.value(), log_exponent_ == 0 ? 0 : least});
    if (!knows_tone_) return;
    curvature_.include(std::max(0.0, variance));
}

/// Includes the estimates of a frame. The error of the print is common to all, so a frame, and all frames,
/// are as certain as the best roundel, beside what the scatter of the estimates makes of their median.
bool CameraModel::learn_tone(std::vector<ToneEstimate> measured) {
    const double middle = median_of(measured, &ToneEstimate::log_exponent).log_exponent;
    const double exact = std::min_element(measured.begin(), measured.end(), [](const auto& a, const auto& b) {
                             return a.sigma < b.sigma;
                         })->sigma;
    std::vector<double> off;
    for (const ToneEstimate& estimate : measured) off.push_back(std::abs(estimate.log_exponent - middle));
    mean_.include(middle);
    sigma_.include(std::hypot(exact, kMedianSigma * median_of(off) / std::sqrt(double(off.size()))));
    const double mean = std::clamp(mean_.value(), -kMaxLogExponent, kMaxLogExponent);
    const double change = std::abs(mean - log_exponent_);
    const double enough = log_exponent_ == 0 ? std::max(kMinTone, 2 * sigma_.value()) : kMinChange;
    knows_tone_ |= sigma_.value() <= kMaxSigma;
    if (sigma_.value() > kMaxSigma || change < enough) return false;
    // The next frame measures the rest: this one was not linear.
    if (change > kMinTone) forget_response();
    set_exponent(std::abs(mean) < kMinTone / 2 ? 0 : mean);
    return true;
}

void CameraModel::set_exponent(double log_exponent) {
    log_exponent_ = log_exponent;
    for (int level = 0; level < 256; ++level) linear_[size_t(level)] = uint8_t(std::lround(linear(level)));
}

}  // namespace roundel
