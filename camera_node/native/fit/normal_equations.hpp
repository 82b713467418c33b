// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>
#include <span>

#include "fit/edge_ellipse.hpp"
#include "fit/edge_pixels.hpp"
#include "fit/roundel_model.hpp"

namespace roundel {

/// Of weighted least squares, J being the derivatives of the levels, r the residuals and W Tukey's weights.
struct NormalEquations {
    Matrix H;      // J^T W J, the lower triangle
    Parameters g;  // J^T W r
};

/// Sums over residuals r - J delta, which a step of delta leaves to first order.
struct Leftover {
    double ring, agreeing;  // squared slopes of the ring's edges, and weighed
    double ring_rr;         // squared residuals times these slopes
    /// Sums of w m and w m^2, m being the squared slope of the level: what a pixel tells of the edges. And of
    /// w m r^2, w^2 m r^2 and m psi', where psi = w r.
    double m, mm, mrr, mwrr, mpsi;
};

/// Tukey's biweight: (1 - (r / c)^2)^2 within c = 6 scales, and nothing beyond.
constexpr float kTukey = 6;

/// The model's levels near one point of the parameters: linear in a step from there, at every pixel.
class Linearisation {
  public:
    void evaluate(const EdgePixels& pixels, const Parameters& p);

    /// The median absolute residual where the ring's edges are steep, of a sample; negative where there are
    /// fewer than eight.
    double median_residual() const;
    NormalEquations accumulate(double scale) const;
    Leftover after(const Parameters& delta, double scale) const;

  private:
    /// Chunks of pixels of one edge, or of all.
    struct Part {
        Edge edge;
        int lanes;
        const Gradient* chunks;
        EdgeEllipse::Moves moves;  // of that edge's ellipse
    };
    std::span<const Part> parts() const { return {parts_.data(), size_t(part_count_)}; }

    static constexpr int kChunks = EdgePixels::kMax / (kChunk * kLanes) + kEdges;
    std::array<Part, kEdges> parts_;
    int part_count_ = 0;
    Gradient chunks_[kChunks];
};

}  // namespace roundel
