// SPDX-License-Identifier: BSD-3-Clause
#include <cmath>
#include <tuple>

#include "fit/photometric_fitter.hpp"

namespace roundel {

namespace {

constexpr double kMaxPrintError = 3;  // standard deviations
constexpr double kFirstOrder = 0.5;   // share of an expected curvature's effect that the first order may miss

}  // namespace

Parameters PhotometricFitter::covariance_with_ratio() const {
    Parameters unit{};
    unit[kRatio] = square(noise_);
    Parameters with = factor_->solve(unit);
    if (!has_fields_) return with;
    for (size_t a = 0; a < kFields; ++a)
        for (size_t b = 0; b < kFields; ++b)
            for (size_t i = 0; i < kCount; ++i)
                with[i] += square(noise_) * by_field_[a][i] * field_cov_[a][b] * by_field_[b][kRatio];
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

void PhotometricFitter::expect_curvature(double sigma) {
    expected_curvature_ = curvature_ = tone_ ? tone_->curvature(p_[kDark], p_[kBright]) : 0;
    curvature_sigma_ = std::hypot(sigma, kFirstOrder * expected_curvature_);
    const Parameters bent = effect_of_curvature(curvature_sigma_);
    for (int i = 0; i < kPoseCount; ++i) curvature_effect_[i] = bent[kX + i] / noise_;
}

/// Conditions the Gaussian posterior on the print's ratio; false if that ratio is unlikely. What is left of
/// the tone curve is one more unknown, with a prior: the difference of the ratios shows it. The estimate
/// remains that of the image, which contains the effect of the tone curve.
bool PhotometricFitter::condition_on_print(const Print& print) {
    const Parameters with = covariance_with_ratio(), bent = effect_of_curvature(curvature_sigma_);
    const double seen = print.ratio + effect_of_curvature(expected_curvature_)[kRatio];
    const double off = seen - p_[kRatio];
    const double variance = with[kRatio] + square(bent[kRatio]) + square(print.sigma);
    if (square(off) > square(kMaxPrintError) * variance) return false;
    for (int i = 0; i < kPoseCount; ++i) {
        const double both = with[kX + i] + bent[kX + i] * bent[kRatio];
        curvature_effect_[i] = bent[kX + i] / noise_;
        print_effect_[i] = both / (noise_ * std::sqrt(variance));
    }
    posterior_ratio_ = p_[kRatio] + with[kRatio] * off / variance;
    curvature_ = expected_curvature_ - curvature_sigma_ * bent[kRatio] * off / variance;
    for (int i = 0; i < kCount; ++i)
        if (i != kRatio) p_[i] += with[i] * off / variance;  // the tests need the measured ratio
    return true;
}

/// Conditions the estimate on a print. If its ratio is unlikely, tries again at the constrained estimate: the
/// ratio's variance there and at the free one differ for small and blurred roundels (a score test after
/// Wald's test).
void PhotometricFitter::use_print(const Print& print) {
    if (condition_on_print(print) || has_fields_) return;
    const auto saved = std::tuple(p_, factor_, sums_, noise_, scale_);
    const Parameters with = covariance_with_ratio();
    const double off = print.ratio + effect_of_curvature(expected_curvature_)[kRatio] - p_[kRatio];
    for (int i = 0; i < kCount; ++i) p_[i] += with[i] * off / with[kRatio];
    if (is_sane(kFitLimits)) {
        equations_.linearize(pixels_, p_);
        linearized_at_ = p_;
        if (solve(scale_)) {
            advance(scale_);
            if (is_sane(kFitLimits) && condition_on_print(print)) return;
        }
    }
    std::tie(p_, factor_, sums_, noise_, scale_) = saved;
}

}  // namespace roundel
