// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "fit/photometric_fit.hpp"
#include "fit/roundel_model.hpp"

namespace roundel {

/// The result of a fit, in the image's frame. `p` are its parameters in a frame with its origin at pixel
/// (origin_x, origin_y), and `pose` is the covariance of their last kPoseCount.
RoundelFit make_fit(const Parameters& p, const PoseCovariance& pose, int origin_x, int origin_y);

}  // namespace roundel
