// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "fit/photometric_fit.hpp"

namespace roundel {

/// `refine` on the 3 x 3 binomial mean of the image around `start`. Edges that are ragged at the scale of a
/// pixel (drawn, sharpened by a camera, badly printed) fit no model until they are softened.
///
/// The mean hides noise and ties neighbours together; the covariance is widened by what it hides, (16/6)^2.
std::optional<Fit> refine_softened(const ImageView& image, const Start& start);

}  // namespace roundel
