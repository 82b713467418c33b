// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "motion_model.hpp"

/// Bayesian choice among motion models that differ in the density of accelerations; see fusion_filter.md.
namespace roundel::fusion {

/// B predicted bodies: states, covariances by the declared densities, the intervals that they were predicted
/// by, and the linearized centres of their detections; of each the camera and the share of its variance that
/// counts the errors of the camera.
struct PredictedBodies {
    const Body* bodies;
    const ErrorMatrix* P;
    const MotionInterval* intervals;
    EquationSystem observed;
    const int64_t* camera;
    const double* rig_share;
};

constexpr int kModels = 4;
using ModelNumbers = std::array<double, kModels>;

/// Weighs the models of the bodies that two cameras or more observe by their shares of the declared
/// densities: `probabilities` (B x 4) become those given the observations, `P` and `information` those by the
/// geometric mean of the densities. They stay as declared where rounding leaves no likelihood. Returns
/// the bodies whose models were weighed.
std::vector<size_t> weigh_motions(const PredictedBodies& predicted, const ModelNumbers& shares,
                                  double* probabilities, ErrorMatrix* P, ErrorMatrix* information);

}  // namespace roundel::fusion
