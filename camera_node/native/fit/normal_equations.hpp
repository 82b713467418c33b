// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <span>

#include "fit/edge_ellipse.hpp"
#include "fit/edge_pixels.hpp"
#include "fit/gauss_newton.hpp"
#include "fit/linear_parts.hpp"
#include "fit/roundel_model.hpp"

namespace roundel {

/// Sums over the residuals r - J delta that a step delta leaves to first order.
struct ResidualSums {
    double ring;      // of squared slopes of the ring's edges, unweighted
    double agreeing;  // of squared slopes of the ring's edges, weighted
    double ring_rr;   // of squared residuals times these slopes
    // Below, m is the squared slope of the level (a pixel's information on the edges), w Tukey's weight,
    // psi = w r, and g the share of the ground in a pixel.
    double m;              // w m
    double mm;             // w m^2
    double mrr;            // w m r^2
    double mwrr;           // w^2 m r^2
    double mpsi;           // m psi'
    double ground;         // g^2
    double ground_rr;      // g^2 r^2
    double ground_ground;  // g^4
};

/// The normal equations of weighted least squares: the model's levels at all pixels, linearized at one point
/// of the parameters.
class NormalEquations {
  public:
    void linearize(const EdgePixels& pixels, const Parameters& p);

    /// The median absolute residual of a sample of the pixels on steep parts of the ring's edges; negative if
    /// there are fewer than eight.
    double median_residual() const;
    /// J^T W J and J^T W r.
    GaussNewtonSystem<kCount> accumulate(const Weighting& by) const;
    ResidualSums residuals_after(const Parameters& delta, const Weighting& by) const;
    std::span<const LinearPart> parts() const { return {parts_.data(), size_t(part_count_)}; }

  private:
    static constexpr int kChunks = EdgePixels::kMax / (kChunk * kLanes) + kEdges;
    std::array<LinearPart, kEdges> parts_;
    int part_count_ = 0;
    Gradient chunks_[kChunks];
};

}  // namespace roundel
