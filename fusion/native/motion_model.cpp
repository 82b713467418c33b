// SPDX-License-Identifier: BSD-3-Clause
#include "motion_model.hpp"

namespace roundel::fusion {
namespace {

using Block = std::array<std::array<double, 3>, 3>;

Block block_of(const Matrix& A) {
    return {{{A.r0.x, A.r0.y, A.r0.z}, {A.r1.x, A.r1.y, A.r1.z}, {A.r2.x, A.r2.y, A.r2.z}}};
}

/// F P.
void multiply_left(ErrorMatrix& P, const Block& T, double dt) {
    for (int j = 0; j < kErrors; ++j)
        for (int i = 0; i < 3; ++i) {
            P[kTheta + i][j] +=
                T[i][0] * P[kOmega][j] + T[i][1] * P[kOmega + 1][j] + T[i][2] * P[kOmega + 2][j];
            P[kPosition + i][j] += dt * P[kVelocity + i][j];
        }
}

/// P F^T.
void multiply_right(ErrorMatrix& P, const Block& T, double dt) {
    for (ErrorVector& row : P)
        for (int i = 0; i < 3; ++i) {
            row[kTheta + i] += T[i][0] * row[kOmega] + T[i][1] * row[kOmega + 1] + T[i][2] * row[kOmega + 2];
            row[kPosition + i] += dt * row[kVelocity + i];
        }
}

/// Adds Q = q [dt^3/3, dt^2/2; dt^2/2, dt]. `to_body` turns angular velocities (world) into the body frame.
void add_noise(ErrorMatrix& P, const Block& to_body, const MotionInterval& interval) {
    const double dt = interval.dt, square = dt * dt / 2, cube = dt * dt * dt / 3;
    for (int i = 0; i < 3; ++i) {
        P[kTheta + i][kTheta + i] += interval.q_angular * cube;
        P[kOmega + i][kOmega + i] += interval.q_angular * dt;
        P[kPosition + i][kPosition + i] += interval.q_linear * cube;
        P[kVelocity + i][kVelocity + i] += interval.q_linear * dt;
        P[kPosition + i][kVelocity + i] += interval.q_linear * square;
        P[kVelocity + i][kPosition + i] += interval.q_linear * square;
        for (int j = 0; j < 3; ++j) {
            P[kTheta + i][kOmega + j] += interval.q_angular * square * to_body[i][j];
            P[kOmega + j][kTheta + i] += interval.q_angular * square * to_body[i][j];
        }
    }
}

}  // namespace

Matrix predict(Body& body, ErrorMatrix& P, const MotionInterval& interval) {
    const Matrix half = rotation_from_vector((interval.dt / 2) * body.omega), R_half = half * body.R;
    const Matrix to_body = transposed(R_half);
    const Matrix by_rate = (interval.single ? 0 : interval.dt) * to_body;
    multiply_left(P, block_of(by_rate), interval.dt);
    multiply_right(P, block_of(by_rate), interval.dt);
    add_noise(P, block_of(to_body), interval);
    body.R = half * R_half;
    body.p = body.p + interval.dt * body.v;
    return by_rate;
}

ErrorMatrix process_noise(const Body& predicted, const MotionInterval& interval) {
    const Matrix half = rotation_from_vector((interval.dt / 2) * predicted.omega);
    ErrorMatrix Q{};
    add_noise(Q, block_of(transposed(transposed(half) * predicted.R)), interval);
    if (interval.single)
        for (const int unknown : {kTheta + 2, kOmega, kOmega + 1, kOmega + 2})
            for (int j = 0; j < kErrors; ++j) Q[unknown][j] = Q[j][unknown] = 0;
    return Q;
}

}  // namespace roundel::fusion
