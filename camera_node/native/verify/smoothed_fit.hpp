// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "fit/photometric_fit.hpp"

namespace roundel {

/// Fits the 3 x 3 binomial mean of the image around the guess. The model describes edges that are ragged at
/// the scale of a pixel (drawn, sharpened by a camera, badly printed) only after they are smoothed.
///
/// Smoothing reduces the noise and correlates adjacent pixels; the covariance is inflated by (16/6)^2.
std::optional<RoundelFit> fit_smoothed(const ImageView& image, const InitialGuess& guess);

}  // namespace roundel
