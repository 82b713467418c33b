// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "disc_view.hpp"
#include "reweighting.hpp"

namespace roundel::fusion {

/// White noise on acceleration over `dt` seconds, with the densities q (rad^2/s^3 and m^2/s^3). The angular
/// velocity of a body with a single marker is not integrated; its normal follows a random walk.
struct MotionInterval {
    double dt, q_angular, q_linear;
    bool single;
};

/// Predicts a body and its covariance P = F P F^T + Q: constant velocities, white noise on acceleration
/// (Bar-Shalom et al. 2001, section 6.2.2). Returns the block T of F: rotation errors grow by T times the
/// errors of the angular velocity.
Matrix predict(Body& body, ErrorMatrix& P, const MotionInterval& interval);

/// The part Q of the covariance of a predicted body, without that of errors which a single marker does not
/// determine.
ErrorMatrix process_noise(const Body& predicted, const MotionInterval& interval);

}  // namespace roundel::fusion
