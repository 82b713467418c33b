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

/// Updates the responses (B x 12 x 8 n_cameras) of the bodies to the errors of the cameras, and the parts of
/// P that count these errors as noise (B). `camera` is that of each frame.
void respond(const FramePoses& poses, const WeightedEquations& observed, const FilterSteps& steps,
             const int64_t* camera, size_t n_cameras, double* responses, ErrorMatrix* counted);

/// Writes the covariances P - counted + S L L^T S^T of B bodies with the responses S and the lower triangular
/// factor L (d x d) of the covariance of the cameras.
void consider(const ErrorMatrix* P, const ErrorMatrix* counted, const double* responses, const double* factor,
              size_t n_bodies, size_t d, ErrorMatrix* to);

}  // namespace roundel::fusion
