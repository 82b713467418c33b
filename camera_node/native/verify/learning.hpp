// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <functional>
#include <optional>
#include <vector>

#include "fit/photometric_fit.hpp"
#include "numeric/cholesky.hpp"

namespace roundel {

constexpr double kMinMeasured = 12;      // pixels: ratio and blur of smaller roundels are correlated
constexpr size_t kMinWitnesses = 3;      // roundels that show something together, of which one may be wrong
constexpr double kNewFrame = 0.2;        // weight of a new frame in what the camera's frames have shown
constexpr double kMinCurvature = -0.25;  // of the tone curves of cameras

/// Whether a roundel's ratio shows its print and the camera.
inline bool is_measured(const RoundelFit& fit) { return fit.outer.major >= kMinMeasured && !fit.clipped; }

/// The element in the middle of those (at least one) in the order of `key`; reorders them.
template <typename T, typename Key = std::identity>
T median_of(std::vector<T>& values, const Key& key = {}) {
    const auto middle = values.begin() + ptrdiff_t(values.size() / 2);
    std::ranges::nth_element(values, middle, {}, key);
    return *middle;
}

/// A mean over frames.
class FrameMean {
  public:
    explicit FrameMean(double before_the_first = 0) : value_(before_the_first) {}
    void include(double value) {
        value_ += (known_ ? kNewFrame : 1) * (value - value_);
        known_ = true;
    }
    /// Lets the next frame replace the value.
    void forget() { known_ = false; }
    bool is_known() const { return known_; }
    double value() const { return value_; }
    void scale(double factor) { value_ *= factor; }

  private:
    double value_;
    bool known_ = false;
};

/// The normal equations of a weighted linear regression on N unknowns.
template <int N>
struct Regression {
    using Row = Vector<N>;
    struct Estimate {
        Row mean;
        std::array<Row, N> cov;
    };
    std::array<Row, N> information{};  // lower triangle
    Row right{};
    double squares = 0;  // weighted, of the values
    void include(const Row& by, double value, double weight) {
        for (size_t i = 0; i < N; ++i) {
            for (size_t j = 0; j <= i; ++j) information[i][j] += weight * by[i] * by[j];
            right[i] += weight * by[i] * value;
        }
        squares += weight * value * value;
    }
    void forget(double share) {
        for (Row& row : information)
            for (double& value : row) value *= 1 - share;
        for (double& value : right) value *= 1 - share;
        squares *= 1 - share;
    }
    /// The weighted squares that an estimate with priors of mean 0 leaves, of the values and the priors.
    double rest(const Row& mean) const {
        double rest = squares;
        for (size_t i = 0; i < N; ++i) rest -= right[i] * mean[i];
        return rest;
    }
    /// The estimate with priors of this information and mean on the unknowns; none where it is not
    /// determined.
    std::optional<Estimate> solve(const Row& prior, const Row& mean = {}) const {
        Regression all = *this;
        for (size_t i = 0; i < N; ++i) {
            all.information[i][i] += prior[i];
            all.right[i] += prior[i] * mean[i];
        }
        const Cholesky<N> factor(all.information);
        if (!factor.positive()) return std::nullopt;
        return Estimate{factor.solve(all.right), factor.template inverse_tail<N>()};
    }
};

}  // namespace roundel
