// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include "disc_view.hpp"
#include "normal_equations.hpp"

namespace roundel::fusion {

/// How a body is driven for `dt` seconds: by white angular and linear acceleration of densities q (rad^2/s^3,
/// m^2/s^3); of a body of one marker no turning rate is claimed, its normal wanders.
struct Drive {
    double dt, q_turn, q;
    bool single;
};

/// Carries a body and its covariance P = F P F^T + Q: constant rates, white noise on acceleration
/// (Bar-Shalom et al. 2001, section 6.2.2). Returns T of F: errors of the turn grow by T times those of the
/// rate.
Matrix predict(Body& body, Square& P, const Drive& drive);

}  // namespace roundel::fusion
