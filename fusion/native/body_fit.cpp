// SPDX-License-Identifier: BSD-3-Clause
#include "body_fit.hpp"

#include <algorithm>

namespace roundel::fusion {
namespace {

constexpr double kRejected = 100;  // squared residual, in standard deviations, that a detection far away has

std::vector<size_t> rows_of(const bool* mask, size_t n) {
    std::vector<size_t> rows;
    for (size_t k = 0; k < n; ++k)
        if (mask[k]) rows.push_back(k);
    return rows;
}

/// The bodies of all discs, then of some of them.
std::vector<int64_t> owners(const Discs& discs, const std::vector<size_t>& shaped,
                            const std::vector<size_t>& turned) {
    std::vector<int64_t> all(discs.body, discs.body + discs.size());
    for (const auto* rows : {&shaped, &turned})
        for (const size_t k : *rows) all.push_back(discs.body[k]);
    return all;
}

Vector part(const ErrorVector& delta, int first) {
    return {delta[first], delta[first + 1], delta[first + 2]};
}

Body displaced(const Body& body, const ErrorVector& delta) {
    return {body.R * rotation_from_vector(part(delta, 0)), body.p + part(delta, 3),
            body.omega + part(delta, 6), body.v + part(delta, 9)};
}

}  // namespace

BodyFit::BodyFit(const std::vector<Body>& predicted, const std::vector<Exposure>& exposures,
                 const FitObservations& observed, const ErrorMatrix* information)
    : predicted_(predicted),
      estimates_(predicted),
      exposures_(exposures),
      observed_(observed),
      prior_(information),
      shaped_(rows_of(observed.shaped, observed.centres.discs.size())),
      turned_(rows_of(observed.turned, observed.centres.discs.size())),
      owner_(owners(observed.centres.discs, shaped_, turned_)),
      of_({nullptr, owner_.data(), owner_.size(), predicted.size()}),
      delta_(predicted.size()),
      sums_(predicted.size()),
      equations_(owner_.size()),
      weights_(owner_.size(), 1.0),
      residuals_(owner_.size()) {
    for (size_t b = 0; b < predicted.size(); ++b)
        if (of_.first[b] < of_.first[b + 1]) moving_.push_back(int64_t(b));
}

Equations BodyFit::equations_at(const FramePoses& poses, size_t k, const Equations* headings) const {
    const size_t n = observed_.centres.discs.size(), n_outlines = shaped_.size();
    if (k < n && !is_displaced_) return observed_.predicted[k];
    if (k < n) return roundel::fusion::linearize(poses, observed_.centres, k);
    if (k >= n + n_outlines) return headings[k - n - n_outlines];
    return roundel::fusion::linearize(poses, observed_.outlines, shaped_[k - n]);
}

void BodyFit::linearize(const Equations* headings) {
    const FramePoses poses(estimates_, exposures_);
    H_.clear();
    g_.clear();
    rows_.clear();
    row_.clear();
    body_.clear();
    std::vector<double> weights;
    for (const int64_t b : moving_) {
        for (size_t at = of_.first[b]; at < of_.first[b + 1]; ++at) {
            const size_t k = of_.indices[at];
            rows_.push_back(equations_at(poses, k, headings));
            row_.push_back(k);
            body_.push_back(int64_t(H_.size()));
            weights.push_back(weights_[k]);
        }
        ErrorVector right{};
        for (int i = 0; i < kErrors; ++i)
            for (int j = 0; j < kErrors; ++j) right[i] -= prior_[b][i][j] * delta_[b][j];
        H_.push_back(prior_[b]);
        g_.push_back(right);
    }
    reweigh({rows_.data(), body_.data(), rows_.size(), H_.size()}, H_.data(), g_.data(), weights.data());
    for (size_t k = 0; k < rows_.size(); ++k) {
        equations_[row_[k]] = rows_[k];
        weights_[row_[k]] = weights[k];
    }
}

bool BodyFit::step(const ErrorVector* steps, double small) {
    const size_t n = rows_.size();
    std::vector<double> rest(2 * n);
    roundel::fusion::residuals({rows_.data(), body_.data(), n, H_.size()}, steps->data(), rest.data());
    for (size_t k = 0; k < n; ++k) residuals_[row_[k]] = {rest[k], rest[n + k]};
    std::vector<int64_t> moving;
    for (size_t i = 0; i < moving_.size(); ++i) {
        const int64_t b = moving_[i];
        for (int j = 0; j < kErrors; ++j) delta_[b][j] += steps[i][j];
        estimates_[b] = displaced(predicted_[b], delta_[b]);
        sums_[b] = H_[i];
        const auto is_large = [&](double error) { return std::abs(error) >= small; };
        if (std::any_of(steps[i].begin(), steps[i].begin() + 6, is_large)) moving.push_back(b);
    }
    moving_ = std::move(moving);
    is_displaced_ = true;
    return !moving_.empty();
}

void BodyFit::write_costs(const double* squared, double* costs) const {
    for (size_t b = 0; b < predicted_.size(); ++b) {
        costs[b] = 0;
        for (int i = 0; i < kErrors; ++i)
            for (int j = 0; j < kErrors; ++j) costs[b] += delta_[b][i] * prior_[b][i][j] * delta_[b][j];
    }
    for (size_t k = 0; k < observed_.centres.discs.size(); ++k) {
        const double bounded = squared[k] < kRejected ? squared[k] : kRejected;  // also of NaN
        costs[owner_[k]] += kCauchy * kCauchy * std::log1p(bounded / (kCauchy * kCauchy));
    }
}

void BodyFit::write_covariances(ErrorMatrix* P) const {
    for (size_t b = 0; b < predicted_.size(); ++b)
        if (of_.first[b] < of_.first[b + 1])
            if (const auto inverted = inverse_if_positive(sums_[b])) P[b] = *inverted;
}

}  // namespace roundel::fusion
