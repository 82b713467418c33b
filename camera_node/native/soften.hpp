// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "refine.hpp"

namespace roundel {

/// `refine` on the 3 x 3 binomial mean of the image around `start`. Edges as hard as the pixel grid (drawn,
/// or sharpened by a camera) have no sub-pixel shape for the fit to find until they are softened.
///
/// The mean hides noise and ties neighbours together; the covariance is widened by what it hides, (16/6)^2.
std::optional<Fit> refine_softened(const ImageView& image, const Start& start);

}  // namespace roundel
