// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "reweighting.hpp"

/// Normal equations of cameras, from which the bodies are eliminated (Schur complement); see rig_graph.md.
namespace roundel::fusion {

/// One observed centre: two whitened rows, each the derivatives by the error of its body, then by the errors
/// of its camera, then the residual.
struct JointEquations {
    double D[2][kErrors + kCameraErrors + 1];
};

/// N weighted observations of `n_bodies` bodies by `n_cameras` cameras.
struct JointSystem {
    const JointEquations* equations;
    const double* weights;
    const int64_t *body, *camera;
    size_t n_equations, n_bodies, n_cameras;
};

/// Information about the errors of each body and the right side beside the observations, diagonal; the
/// information of the observations is enlarged by the share `damping` of its diagonal (Marquardt 1963).
struct BodyPriors {
    const ErrorVector *information, *right;
    double damping;
};

/// Eliminates the bodies. With d = 8 n_cameras, `reduced` takes d x (d + 1): the information about the
/// cameras and its right side; `by_body` takes n_bodies x 12 x (d + 1): the inverse of the block of each body
/// times its border and its right side. Throws std::runtime_error where a block is not positive definite.
void eliminate(const JointSystem& system, const BodyPriors& priors, double* reduced, double* by_body);

}  // namespace roundel::fusion
