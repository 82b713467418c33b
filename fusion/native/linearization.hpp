// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "outline.hpp"

/// Linearizes observations about the predicted states; see fusion_filter.md.
namespace roundel::fusion {

// Errors of a state: rotation (body frame), position, angular velocity, velocity (world).
constexpr int kErrors = 12, kTheta = 0, kPosition = 3, kOmega = 6, kVelocity = 9;

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
Equations linearize(const FramePoses& poses, const CentreObservations& observed, size_t k);

constexpr int kCameraErrors = 8;  // rotation and position (camera frame), clock offset, log focal length

/// Derivatives of one whitened centre by the errors of its camera, a row for each coordinate. Both are zero
/// where the disc is not visible.
struct CameraDerivatives {
    double B[2][kCameraErrors];
};

/// Writes the derivatives of N expected centres, times `whiten`. A rotation w and a translation t of the
/// camera in its own frame move points in that frame by p x w - t; a clock offset delays the capture, in
/// seconds; `by_focal` holds the derivatives by the logarithm of the focal length, undistorted coordinates.
void differentiate(const FramePoses& poses, const Discs& discs, Columns<4> whiten, Columns<2> by_focal,
                   CameraDerivatives* to);

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
Equations linearize(const FramePoses& poses, const OutlineObservations& observed, size_t k);

}  // namespace roundel::fusion
