// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "reweighting.hpp"

/// Normal equations of cameras, from which robots are eliminated (Schur complement); see rig_graph.md.
namespace roundel::fusion {

constexpr int kPlaceErrors = 3;  // of a marker on its robot (body frame)
constexpr int kSharedErrors = kCameraErrors + kPlaceErrors;

/// One observed centre: two whitened rows, each the derivatives by the error of its body, then by the errors
/// of its camera and of the place of its marker, then the residual.
struct JointEquations {
    double D[2][kErrors + kSharedErrors + 1];
};

/// N weighted observations of the markers of `n_bodies` bodies by `n_cameras` cameras. A body is a robot at
/// one time; the place of a marker on its robot is the same at all times. The markers are in the order of
/// their robots, `owner`.
struct JointSystem {
    const JointEquations* equations;
    const double* weights;
    const int64_t *body, *camera, *marker, *robot, *owner;
    size_t n_equations, n_bodies, n_cameras, n_markers;
};

/// Information about the errors of each body and marker and the right sides beside the observations,
/// diagonal; the information of the observations is enlarged by the share `damping` of its diagonal
/// (Marquardt 1963).
struct RobotPriors {
    const ErrorVector *information, *right;
    const std::array<double, kPlaceErrors>*of_places, *right_of_places;
    double damping;
};

/// Where the results are written. With d = 8 n_cameras, `reduced` takes d x (d + 1): the information about
/// the cameras and its right side; `by_body` takes n_bodies x 12 x (d + 1) and `by_marker` n_markers x 3 x
/// (d + 1): the errors of bodies and markers are the last column less the others times those of the cameras.
/// `of_places` takes 3 n_markers x 3 n_markers: the information about places with the cameras as they are, 0
/// between the markers of two robots.
struct Eliminated {
    double *reduced, *by_body, *by_marker, *of_places;
};

/// Eliminates the bodies and the places of their markers. Throws std::runtime_error where a body or a marker
/// is not determined.
void eliminate(const JointSystem& system, const RobotPriors& priors, const Eliminated& to);

}  // namespace roundel::fusion
