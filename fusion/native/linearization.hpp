// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "outline.hpp"

/// Linearizes observations about the predicted states; see fusion_filter.md.
namespace roundel::fusion {

constexpr int kErrors =
    12;  // of a state: rotation (body frame), position, angular velocity, velocity (world)

/// Two whitened linear equations A delta = b of the error of one body, each stored as its row of A and then
/// b. Both are zero where the disc is not visible.
struct Equations {
    double A[2][kErrors + 1];
};

/// N detected centres in undistorted coordinates. `whiten` scales their errors to unit covariance.
struct CentreObservations {
    Discs discs;
    Columns<2> xy;
    Columns<4> whiten;
    const bool* single;  // by body: has one marker, so its angular velocity would only fit noise
};
void linearize(const FramePoses& poses, const CentreObservations& observed, Equations* to);

/// N detected outlines: full axes, direction of the major axis, and the standard deviation of a shear.
///
/// Their shears determine the normal of a body with few visible markers. Their sizes are not used because
/// blur changes them.
struct OutlineObservations {
    Discs discs;
    Columns<2> axes;
    const double* angle;
    Columns<4> scale;
    const double* sigma;
};
void linearize(const FramePoses& poses, const OutlineObservations& observed, Equations* to);

}  // namespace roundel::fusion
