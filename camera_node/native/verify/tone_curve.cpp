// SPDX-License-Identifier: BSD-3-Clause
#include "verify/tone_curve.hpp"

#include <algorithm>
#include <cmath>

#include "fit/roundel_model.hpp"

namespace roundel {

namespace {

constexpr int kSteps = 3;
constexpr double kModelSigma = 0.05;    // of a curvature: what the family leaves
constexpr double kHuber = 1.5;          // standard deviations
constexpr double kExponentSigma = 0.8;  // standard deviation of the prior
constexpr double kShoulderSigma = 4;

}  // namespace

EncodedLevel::EncodedLevel(double share) {
    const double v = std::clamp(share, 1 / 255.0, 1.0), cube = v * v * v;
    by_exponent = std::log(v);
    by_shoulder = (cube * cube - 1) / 6;
}

double ToneCurve::light(const EncodedLevel& level) const {
    return std::exp(exponent_ * level.by_exponent + shoulder_ * level.by_shoulder);
}

double ToneCurve::light(double share) const { return light(EncodedLevel(share)); }

/// Gauss-Newton with Huber's weights on the curvatures that the curve leaves in the samples, 4 (s - 1/2) with
/// s = (L_middle - L_dark) / (L_bright - L_dark).
void ToneCurve::learn(const std::vector<ToneSample>& samples) {
    regression_.forget(kNewFrame);
    const Regression<2> earlier = regression_;
    for (int k = 0; k < kSteps; ++k) {
        regression_ = earlier;
        for (const ToneSample& sample : samples) {
            const double dark = light(sample.dark), middle = light(sample.middle),
                         bright = light(sample.bright), range = bright - dark;
            if (range <= 0) continue;
            const double share = (middle - dark) / range;
            const auto slope = [&](double EncodedLevel::* by) {
                const double d = dark * sample.dark.*by, m = middle * sample.middle.*by,
                             b = bright * sample.bright.*by;
                return 4 * (m - d - share * (b - d)) / range;
            };
            const double off = -4 * (share - 0.5), sigma = std::hypot(sample.sigma, kModelSigma);
            const double weight = std::min(1.0, kHuber * sigma / std::abs(off)) / square(sigma);
            const Vector<2> by{slope(&EncodedLevel::by_exponent), slope(&EncodedLevel::by_shoulder)};
            regression_.include(by, off + by[0] * exponent_ + by[1] * shoulder_, weight);
        }
        const auto estimate =
            regression_.solve({1 / square(kExponentSigma), 1 / square(kShoulderSigma)}, {kPriorExponent, 0});
        if (!estimate) return;
        exponent_ = estimate->mean[0];
        shoulder_ = estimate->mean[1];
    }
}

double left_by_power(double exponent, const std::vector<ToneSample>& samples) {
    double sum = 0, weights = 0;
    for (const ToneSample& sample : samples) {
        const auto power = [&](const EncodedLevel& level) { return std::exp(exponent * level.by_exponent); };
        const double dark = power(sample.dark), range = power(sample.bright) - dark;
        if (range <= 0) continue;
        const double left = 4 * ((power(sample.middle) - dark) / range - 0.5);
        const double variance = square(sample.sigma) + square(kModelSigma);
        sum += square(left) / variance - 1;
        weights += 1 / variance;
    }
    return weights > 0 ? sum / weights : 0;
}

}  // namespace roundel
