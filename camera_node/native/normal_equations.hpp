// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "edge_pixels.hpp"
#include "roundel_model.hpp"

namespace roundel {

/// Sums over pixels at one point of the parameters, w being Tukey's weights and r the residuals.
struct NormalEquations {
    Matrix H;      // J^T W J, the lower triangle
    Parameters g;  // J^T W r
    double w, wrr;
    double ring, agreeing;  // squared slopes of the ring's edges, and weighed
    double ring_rr;         // squared residuals times these slopes
    /// Sums of w m and w m^2, m being the squared slope of the level: what a pixel tells of the edges. And of
    /// w m r^2, w^2 m r^2 and m psi', where psi = w r.
    double m, mm, mrr, mwrr, mpsi;
};

/// Tukey's biweight: (1 - (r / c)^2)^2 within c = 6 scales, and nothing beyond.
constexpr float kTukey = 6;

NormalEquations accumulate(const EdgePixels& pixels, const Parameters& p, double scale);

constexpr int kSample = 192;

/// Absolute residuals where the ring's edges are steep, of about kSample pixels spread over all; gives their
/// number. There is room for kSample and eight.
int sample_residuals(const EdgePixels& pixels, const Parameters& p, float* residuals);

}  // namespace roundel
