// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <type_traits>

#include "fit/edge_ellipse.hpp"
#include "fit/roundel_model.hpp"
#include "numeric/gram.hpp"

namespace roundel {

/// Tukey's biweight is (1 - (r / c)^2)^2 for |r| < c = 6 scales and 0 beyond.
constexpr float kTukey = 6;
constexpr int kLevels = 3;  // columns of a single edge before those of its ellipse

/// The parameters of a part's gradient: all, or those of a single edge, with its ellipse last.
template <Edge edge>
constexpr auto kBy = [] {
    if constexpr (edge == kAnyEdge)
        return std::array{kBright, kDark, kGround, kBlur, kRatio, kCard, kX, kY, kAxx, kAxy, kAyy, kGx, kGy};
    else
        return std::array{kSidesOf[edge].inside, kSidesOf[edge].outside, kBlur, kX, kY, kAxx, kAxy, kAyy};
}();
template <Edge edge>
constexpr int kUnknowns = int(kBy<edge>.size());
template <Edge edge>
using GramOf = Gram<kUnknowns<edge> + 1>;  // and the residual

/// Calls `work` with a part's edge as a compile-time constant. All calls within must be inlined, as in every
/// function that is compiled for several targets (see simd.hpp).
template <typename Work>
ROUNDEL_INLINE void with_edge(Edge edge, const Work& work) {
    switch (edge) {
        case kOuterEdge:
            return work(std::integral_constant<Edge, kOuterEdge>());
        case kInnerEdge:
            return work(std::integral_constant<Edge, kInnerEdge>());
        case kCardEdge:
            return work(std::integral_constant<Edge, kCardEdge>());
        case kAnyEdge:
            return work(std::integral_constant<Edge, kAnyEdge>());
    }
}

/// The square root of Tukey's weight for residuals of `t` cutoffs.
ROUNDEL_INLINE Lanes root_weight(const Lanes& t) {
    const Lanes left = 1.0f - t * t;
    return left > 0.0f ? left : all(0);
}

/// The weights of residuals: Tukey's, and less for pixels that see the ground, of which little is known.
struct Weighting {
    float per_cut;  // 1 / Tukey's cutoff
    float spread;   // variance of the ground's levels over that of the noise, times the pixels of a patch
    Weighting(double scale, double ground) : per_cut(float(1 / (kTukey * scale))), spread(float(ground)) {}
};

/// The weight of a pixel by what it sees of the ground.
template <Edge edge>
ROUNDEL_INLINE Lanes ground_weight(const Gradient& at, int k, float spread) {
    if constexpr (edge == kOuterEdge || edge == kInnerEdge) return all(1);
    if (spread == 0) return all(1);
    return 1.0f / (1.0f + spread * at.by[kGround][k] * at.by[kGround][k]);
}

/// The square root of the weight of a residual: Tukey's, and less for pixels that see the ground.
template <Edge edge>
ROUNDEL_INLINE Lanes root_weight(const Gradient& at, int k, const Lanes& residual, const Weighting& by) {
    const Lanes tukey = root_weight(residual * by.per_cut);
    if constexpr (edge == kOuterEdge || edge == kInnerEdge) return tukey;
    if (by.spread == 0) return tukey;
    return tukey * inverse_sqrt(1.0f + by.spread * at.by[kGround][k] * at.by[kGround][k]);
}

/// The linearized model at the pixels of one edge, or of all edges.
struct LinearPart {
    Edge edge;
    int lanes;
    int begin;  // in the pixels
    const Gradient* chunks;
    EdgeEllipse::Jacobian jacobian;  // of a single edge's ellipse
};

/// Transforms a step of all parameters to one of the parameters of a part's gradient.
inline std::array<float, kCount> step_of(const Parameters& delta, Edge edge, const EdgeEllipse::Jacobian& J) {
    std::array<float, kCount> step{};
    for (size_t i = 0; i < kCount; ++i) step[i] = float(delta[i]);
    if (edge == kAnyEdge) return step;
    for (int i = 0; i < EdgeEllipse::kShape; ++i) {
        double shape = J[i][kPoseCount] * delta[edge == kInnerEdge ? kRatio : kCard];  // or 0
        for (int m = 0; m < kPoseCount; ++m) shape += J[i][m] * delta[kX + m];
        step[size_t(kX + i)] = float(shape);
    }
    return step;
}

}  // namespace roundel
