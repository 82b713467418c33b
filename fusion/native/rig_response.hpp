// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "motion_model.hpp"

/// How errors of the cameras displace the states that a filter estimates with cameras held fixed (consider
/// parameters, Schmidt 1966); see fusion_filter.md.
namespace roundel::fusion {

/// N weighted equations of the last linearization of a frame set. `rig_share` is the part of each variance
/// that the filter counts for the cameras; `xy` and `whiten` as in `CentreObservations`.
struct WeightedEquations {
    EquationSystem system;
    const double *weights, *rig_share;
    const int64_t* frame;
    Columns<2> xy;
    Columns<4> whiten;
};

/// The filter's step of B bodies: information of the prediction, covariance after the update, and the
/// transition before it (`predict`).
struct FilterSteps {
    const ErrorMatrix *information, *P;
    const double* T;
    const double* dt;
};

/// The columns of one camera in a response.
using CameraBlock = std::array<std::array<double, kCameraErrors>, kErrors>;

/// Updates the responses of the bodies to the errors of the cameras (a block of each body and camera), and
/// the parts of P that count these errors as noise, of each body. `camera` is that of each frame.
void respond(const FramePoses& poses, const WeightedEquations& observed, const FilterSteps& steps,
             const int64_t* camera, size_t n_cameras, CameraBlock* responses, ErrorMatrix* counted);

/// What claims consider of a body beside its filter's P: the part that counts cameras as noise, the responses
/// to `n_cameras` of them, its rotation, and the covariance of its own frame (rotation and position, body
/// frame) by errors of the places of its markers.
struct Considered {
    const ErrorMatrix* counted;
    const CameraBlock* responses;
    const double *R, *frame;
};

/// Writes P - counted + S L L^T S^T + T frame T^T of B bodies, with the lower triangular factor L of the
/// covariance of the cameras and T that turns the frame into the world.
void consider(const ErrorMatrix* P, const Considered& bodies, const double* factor, size_t n_bodies,
              size_t n_cameras, ErrorMatrix* to);

}  // namespace roundel::fusion
