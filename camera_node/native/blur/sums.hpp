// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "blur/model.hpp"
#include "fit/edge_pixels.hpp"
#include "fit/gauss_newton.hpp"
#include "numeric/image.hpp"

namespace roundel {

/// The pixels over which a roundel moves.
using MovingPixels = PixelColumns<2048>;

/// Selects about `limit` of the pixels over which the disc moves, with a margin.
void select_moving(const ImageView& image, const MovingParameters& p, int limit, MovingPixels& pixels);

/// Sums over pixels at one point of the parameters. The weight of a pixel is 1 / (1 + spread g^2); g is the
/// share of the exposure in which it sees the ground.
struct MovingSums {
    GaussNewtonSystem<kMovingCount> system;
    double w, wrr;
    double ring;           // weighted squared slopes
    double ring_rr;        // weighted squared slopes times squared residuals
    double ground;         // g^2
    double ground_rr;      // g^2 r^2
    double ground_ground;  // g^4
};

/// `spread`: variance of the ground's levels over that of the noise.
MovingSums accumulate(const MovingPixels& pixels, const MovingParameters& p, double spacing, double spread);

}  // namespace roundel
