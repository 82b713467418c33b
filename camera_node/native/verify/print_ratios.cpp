// SPDX-License-Identifier: BSD-3-Clause
#include "verify/print_ratios.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "verify/learning.hpp"

namespace roundel {

namespace {

constexpr double kModelSigma = 0.003;  // of the print and of the model, common to all views of a roundel
constexpr double kSecondOrder = 0.1;   // share of the tone curve's effect that the model leaves out
constexpr double kSameKind = 0.04;     // difference of ratios from the regression
constexpr size_t kMaxKinds = 8;
constexpr int kMaxCount = 512;     // measurements that a regression remembers
constexpr double kMinZoom = 0.05;  // relative change of the distance after which a roundel counts again
// Standard deviation of the ratio of a usual print: ink that spreads by 0.25 mm over both edges of 100 mm.
constexpr double kDotGain = 0.008;
constexpr double kSharper = 0.7;    // factor of the standard deviation at which an estimate replaces the last
constexpr double kExact = 0.01;     // standard deviation, from which an assigned print may change
constexpr double kReplaced = 0.15;  // distance at which a print that recurs replaces a usual one
const std::vector<Print> kUsual{{0.6}, {0.41}};

std::vector<Print> assumed_prints() {
    std::vector<Print> prints = kUsual;
    for (Print& print : prints) print.assumed = true;
    return prints;
}

}  // namespace

Regression<2>::Estimate PrintRatios::Kind::estimate() const {
    return regression.solve({0, 1 / square(kCurvaturePrior)}).value();
}

double PrintRatios::Kind::curvature_with(double print_ratio) const {
    const auto& [information, right, squares] = regression;
    return (right[1] - information[1][0] * print_ratio) / (information[1][1] + 1 / square(kCurvaturePrior));
}

/// By moments (DerSimonian and Laird): what n measurements and the prior leave, n - 1 expected, beyond their
/// variance, of which `kModelSigma` is a part.
double PrintRatios::Kind::spread(const Regression<2>::Estimate& estimate) const {
    const double excess = regression.rest(estimate.mean) - (count - 1);
    return std::max(0.0, square(kModelSigma) + excess / regression.information[0][0]);
}

void PrintRatios::Kind::include(double ratio, double by_curvature, double sigma) {
    regression.include({1, by_curvature}, ratio, 1 / square(sigma));
    if (++count <= kMaxCount) return;
    count /= 2;
    regression.forget(0.5);
}

PrintRatios::PrintRatios() : prints_(assumed_prints()) {}

/// The kind whose regression is nearest to a measurement; a new one, in place of the rarest, if none is near.
PrintRatios::Kind& PrintRatios::kind_of(double ratio, double by_curvature) {
    Kind* best = nullptr;
    double least = kSameKind;
    for (Kind& kind : kinds_) {
        double expected = kind.first_ratio;
        if (kind.count) {
            const auto [print, curvature] = kind.estimate().mean;
            expected = print + curvature * by_curvature;
        }
        if (const double off = std::abs(expected - ratio); off < least) {
            least = off;
            best = &kind;
        }
    }
    if (best) return *best;
    if (kinds_.size() < kMaxKinds) return kinds_.emplace_back(Kind{ratio});
    const auto rarest = std::min_element(kinds_.begin(), kinds_.end(), [](const Kind& a, const Kind& b) {
        return std::pair(a.recurs, a.count) < std::pair(b.recurs, b.count);
    });
    return *rarest = Kind{ratio};
}

/// Whether a roundel was not measured yet, or not at this distance.
bool PrintRatios::is_new(int track, double by_curvature) {
    if (track < 0) return true;
    const auto used =
        std::find_if(used_.begin(), used_.end(), [&](const Used& u) { return u.track == track; });
    if (used != used_.end()) {
        if (std::abs(by_curvature / used->by_curvature - 1) < kMinZoom) return false;
        used->by_curvature = by_curvature;
        return true;
    }
    used_.push_back({track, by_curvature});
    return true;
}

/// Chooses the print of a kind that recurs: a usual one unless the regression contradicts it.
void PrintRatios::assign(Kind& kind) {
    const auto estimate = kind.estimate();
    const double measured = estimate.mean[0], sigma = std::max(Print::kPaper, std::sqrt(estimate.cov[0][0]));
    if (kind.assigned && sigma > kExact) return;
    const Print& usual = nearest_print(kUsual, measured);
    const double curvature = kind.curvature_with(usual.ratio);
    const double both = std::hypot(sigma, kDotGain), off = usual.ratio - measured;
    const bool contradicts =
        std::abs(off) > kContradiction * both || curvature < kMinCurvature || curvature > kMaxCurvature;
    Print print = contradicts ? Print{measured, sigma}
                              : Print{measured + off * square(sigma / both),
                                      std::max(Print::kPaper, sigma * kDotGain / both)};
    print.spread = kind.spread(estimate);
    if (!kind.assigned || std::abs(print.ratio - kind.assigned->ratio) > print.sigma ||
        print.sigma < kSharper * kind.assigned->sigma)
        kind.assigned = print;
}

/// Collects the prints in use; returns whether they changed.
bool PrintRatios::collect() {
    std::vector<Print> prints;
    const auto is_new = [&](const Print& print) {
        return std::none_of(prints.begin(), prints.end(),
                            [&](const Print& p) { return p.ratio == print.ratio; });
    };
    for (const Kind& kind : kinds_)
        if (kind.assigned && is_new(*kind.assigned)) prints.push_back(*kind.assigned);
    std::vector<Print> own;
    std::copy_if(prints.begin(), prints.end(), std::back_inserter(own),
                 [](const Print& print) { return nearest_print(kUsual, print.ratio).ratio != print.ratio; });
    for (const Print& usual : kUsual)
        if (is_new(usual) &&
            (own.empty() || std::abs(nearest_print(own, usual.ratio).ratio - usual.ratio) > kReplaced))
            prints.push_back({usual.ratio, usual.sigma, true});
    const auto is_equal = [](const Print& a, const Print& b) {
        return a.ratio == b.ratio && a.assumed == b.assumed;
    };
    const bool same =
        std::is_permutation(prints.begin(), prints.end(), prints_.begin(), prints_.end(), is_equal);
    prints_ = std::move(prints);
    return !same;
}

bool PrintRatios::learn(const std::vector<Observation>& roundels) {
    std::erase_if(used_, [&](const Used& used) {
        return std::ranges::none_of(roundels,
                                    [&](const Observation& now) { return now.track == used.track; });
    });
    std::array<size_t, kMaxKinds> seen{};
    for (const auto& [fit, track] : roundels) {
        if (!is_measured(*fit)) continue;
        const double by_curvature = ratio_by_curvature(*fit, fit->ratio);
        Kind& kind = kind_of(fit->ratio, by_curvature);
        ++seen[size_t(&kind - kinds_.data())];
        if (is_new(track, by_curvature))
            kind.include(fit->ratio, by_curvature,
                         std::hypot(fit->ratio_sigma, kModelSigma, kSecondOrder * by_curvature));
    }
    for (size_t k = 0; k < kinds_.size(); ++k) {
        kinds_[k].recurs |= seen[k] >= kMinWitnesses;
        if (kinds_[k].recurs && kinds_[k].count) assign(kinds_[k]);
    }
    return collect();
}

std::vector<double> PrintRatios::recurring() const {
    std::vector<double> ratios;
    for (const Print& print : prints_)
        for (const Kind& kind : kinds_)
            if (kind.assigned && kind.assigned->ratio == print.ratio) {
                ratios.push_back(print.ratio);
                break;
            }
    return ratios;
}

void PrintRatios::forget_measurements() {
    for (Kind& kind : kinds_)
        kind = {kind.assigned ? kind.assigned->ratio : kind.first_ratio, {}, 0, kind.recurs, kind.assigned};
    used_.clear();
}

}  // namespace roundel
