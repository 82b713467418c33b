// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "image.hpp"
#include "moving_model.hpp"

namespace roundel {

/// Pixels that a moving roundel passes, as columns, in a frame of their own near it. What fills the last
/// eight has level -1 and does not count.
struct MovingPixels {
    static constexpr int kMax = 2048;
    int origin_x = 0, origin_y = 0;  // of the frame, pixels of the image
    int count = 0;                   // whole lanes
    int used = 0;                    // pixels inside the image
    int expected = 0;                // and outside
    alignas(4 * kLanes) float x[kMax], y[kMax], level[kMax];
};

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
