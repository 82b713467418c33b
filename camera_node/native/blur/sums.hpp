// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "numeric/image.hpp"
#include "blur/model.hpp"
#include "fit/pixel_columns.hpp"

namespace roundel {

/// Pixels that a moving roundel passes.
using MovingPixels = PixelColumns<2048>;

/// Fills `pixels` by about `limit` of those that the disc passes, and a margin around its way.
void select_moving(const ImageView& image, const MovingParameters& p, int limit, MovingPixels& pixels);

/// Sums over pixels at one point of the parameters. The weight of a pixel is 1 / (1 + spread g^2), g being
/// the share of the exposure in which it saw the ground.
struct MovingSums {
    std::array<MovingParameters, kMovingCount> H;  // J^T W J, the lower triangle
    MovingParameters g;                            // J^T W r
    double w, wrr;
    double ring, ring_rr;                     // weighed squared slopes, and times squared residuals
    double ground, ground_rr, ground_ground;  // g^2, g^2 r^2 and g^4
};

/// `spread`: variance of the ground's levels over that of the noise.
MovingSums accumulate(const MovingPixels& pixels, const MovingParameters& p, double spacing, double spread);

}  // namespace roundel
