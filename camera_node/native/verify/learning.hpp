// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <vector>

#include "fit/photometric_fit.hpp"

namespace roundel {

constexpr double kMinMeasured = 12;   // pixels: ratio and blur of smaller roundels are correlated
constexpr size_t kMinWitnesses = 3;   // roundels that show something together, of which one may be wrong
constexpr double kNewFrame = 0.2;     // weight of a new frame in what the camera's frames have shown
constexpr double kContradiction = 3;  // standard deviations of a difference that is no chance

/// Whether a roundel's ratio shows its print and the camera.
inline bool is_measured(const RoundelFit& fit) { return fit.outer.major >= kMinMeasured && !fit.clipped; }

/// The element in the middle of those (at least one) in the order of `key`; reorders them.
template <typename T, typename Key = std::identity>
T median_of(std::vector<T>& values, const Key& key = {}) {
    const auto middle = values.begin() + ptrdiff_t(values.size() / 2);
    std::ranges::nth_element(values, middle, {}, key);
    return *middle;
}

/// Moves a mean over frames towards the value of a new one, or to it if it is the first.
inline void include_frame(double& mean, double value, bool first) {
    mean += (first ? 1 : kNewFrame) * (value - mean);
}

}  // namespace roundel
