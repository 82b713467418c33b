// SPDX-License-Identifier: BSD-3-Clause
#include "verify/light_falloff.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace roundel {

namespace {

constexpr double kLeast = 2e-5;      // of a gradient and of its rest
constexpr double kSlopePrior = 2;    // standard deviation of M over that of the gradient
constexpr int kSteps = 3;            // of the prior's variances
constexpr double kLeastLevel = 0.3;  // of the light in the middle

bool shows_light(const RoundelFit* fit) { return fit->shading.variance > 0; }

double dot(const auto& a, const auto& b) {
    double sum = 0;
    for (size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
    return sum;
}

/// The variance of a gradient beyond that of its measurement, from the median over roundels: the squared
/// length of a vector with independent components has the median 2 ln 2 variances.
template <typename Squared>
double variance_of(const std::vector<const RoundelFit*>& measured, const Squared& squared) {
    std::vector<double> excess;
    for (const RoundelFit* fit : measured)
        excess.push_back(squared(*fit) / (2 * std::numbers::ln2) - fit->shading.variance);
    return std::max(median_of(excess), square(kLeast));
}

}  // namespace

std::pair<LightFalloff::Row, LightFalloff::Row> LightFalloff::rows(double x, double y) const {
    const double u = (x - x_) * per_radius_, v = (y - y_) * per_radius_;
    return {{1, 0, u, v, 0}, {0, 1, 0, u, v}};
}

void LightFalloff::set_size(const ImageView& image) {
    const double x = (image.width - 1) / 2.0, y = (image.height - 1) / 2.0;
    if (x == x_ && y == y_) return;
    *this = {};
    x_ = x;
    y_ = y;
    per_radius_ = 1 / std::hypot(x, y);
}

LightGradient LightFalloff::at(double x, double y) const {
    if (!rest_.is_known()) return {0, 0, kFirst};
    const auto [by_x, by_y] = rows(x, y);
    double variance = 2 * rest_.value();
    for (size_t i = 0; i < kCoefficients; ++i)
        variance += by_x[i] * dot(now_.cov[i], by_x) + by_y[i] * dot(now_.cov[i], by_y);
    const auto [u, v] = expected(x, y);
    return {u, v, std::sqrt(variance / 2)};
}

/// The light over that in the middle of the picture: 1 + a x + x M u / 2, x in pixels.
double LightFalloff::level(double x, double y) const {
    const auto [by_x, by_y] = rows(x, y);
    const double twice = (x - x_) * (dot(by_x, now_.mean) + now_.mean[kAx]) +
                         (y - y_) * (dot(by_y, now_.mean) + now_.mean[kAy]);
    return std::max(kLeastLevel, 1 + twice / 2);
}

std::pair<double, double> LightFalloff::expected(double x, double y) const {
    const auto [by_x, by_y] = rows(x, y);
    const double level = this->level(x, y);
    return {dot(by_x, now_.mean) / level, dot(by_y, now_.mean) / level};
}

void LightFalloff::learn(const std::vector<const RoundelFit*>& fits, const ImageView& image) {
    set_size(image);
    std::vector<const RoundelFit*> measured;
    std::copy_if(fits.begin(), fits.end(), std::back_inserter(measured), shows_light);
    if (measured.empty()) return;
    const double all = variance_of(
        measured, [](const RoundelFit& fit) { return square(fit.shading.x) + square(fit.shading.y); });
    all_.include(all);
    regression_.forget(kNewFrame);
    for (const RoundelFit* fit : measured) include(*fit);
    solve();
    const double rest = variance_of(measured, [this](const RoundelFit& fit) {
        const auto [x, y] = expected(fit.outer.x, fit.outer.y);
        return square(fit.shading.x - x) + square(fit.shading.y - y);
    });
    rest_.include(rest);
}

void LightFalloff::scale(double factor) {
    for (double& value : regression_.right) value *= factor;
    for (double& value : now_.mean) value *= factor;
    all_.scale(square(factor));
    rest_.scale(square(factor));
}

/// Adds a measurement to the normal equations.
void LightFalloff::include(const RoundelFit& fit) {
    const auto [by_x, by_y] = rows(fit.outer.x, fit.outer.y);
    const double level = this->level(fit.outer.x, fit.outer.y),
                 variance = fit.shading.variance + rest_.value();
    double weight = 1 / variance;
    if (rest_.is_known()) {
        const auto [x, y] = expected(fit.outer.x, fit.outer.y);
        weight /=
            1 + (square(fit.shading.x - x) + square(fit.shading.y - y)) / (square(kContradiction) * variance);
    }
    regression_.include(by_x, fit.shading.x * level, weight);
    regression_.include(by_y, fit.shading.y * level, weight);
}

/// Solves the normal equations with a prior whose variances follow from the coefficients themselves
/// (empirical Bayes): a shrunk estimate would be biased alike in all of a corner.
void LightFalloff::solve() {
    for (int k = 0; k < kSteps; ++k) {
        const Row& mean = now_.mean;
        const double slope = (square(mean[kMxx]) + square(mean[kMxy]) + square(mean[kMyy])) / 3;
        const double middle = 1 / std::max(all_.value(), (square(mean[kAx]) + square(mean[kAy])) / 2);
        const double slopes = 1 / (square(kSlopePrior) * std::max(all_.value(), slope));
        const auto estimate = regression_.solve({middle, middle, slopes, slopes, slopes});
        if (!estimate) return;
        now_ = *estimate;
    }
}

}  // namespace roundel
