// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <optional>

#include "fit/photometric_fit.hpp"
#include "numeric/image.hpp"

namespace roundel {

/// The initial guess of the fit of a moving roundel: its picture at mid-exposure, within an eighth of its
/// diameter, and its motion during the exposure in pixels, within a third of it.
struct MovingGuess {
    InitialGuess still;
    double motion_x, motion_y;
};

/// Fits a roundel that moves in a straight line at constant speed during the exposure. The model is that of
/// fit_photometric averaged over the exposure, with two more parameters. Gauss-Newton, first on a subset of
/// the pixels. The resulting ellipse is that of mid-exposure; `dark` and `bright` are those of a still
/// picture.
///
/// The ground under the moving card is visible for a part of the exposure. Only the variance of its levels is
/// estimated, so pixels have less weight the longer they see it.
///
/// The covariance is that of the weighted fit, with the noise of the residuals, at least one grey level.
/// Returns nothing if the fit leaves the neighbourhood of the guess, or if the roundel does not move.
std::optional<RoundelFit> fit_moving(const ImageView& image, const MovingGuess& guess);

}  // namespace roundel
