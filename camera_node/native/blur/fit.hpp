// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "numeric/image.hpp"
#include "fit/photometric_fit.hpp"

namespace roundel {

/// What the fit of a moving roundel starts from: its picture in mid-exposure, good to an eighth of its
/// diameter, and the way that it moves during the exposure, pixels, good to a third of it.
struct MovingStart {
    Start still;
    double motion_x, motion_y;
};

/// Fits a roundel that moves straight and evenly while it is exposed: `refine`'s model, averaged over the
/// exposure, with two more unknowns. By Gauss-Newton, first on a part of the pixels. The ellipse that it
/// gives is that of mid-exposure, and `dark` and `bright` are the levels of a still picture.
///
/// What lies under the moving card is seen through for a part of the exposure. Of a cluttered ground no more
/// is known than how much it varies, so pixels count less the more of it they saw.
///
/// The covariance is that of the weighted fit, its noise from the residuals, at least one grey level; nothing
/// is widened. Nothing comes back where the fit leaves the start's neighbourhood, or nothing moves.
std::optional<Fit> refine_moving(const ImageView& image, const MovingStart& start);

}  // namespace roundel
