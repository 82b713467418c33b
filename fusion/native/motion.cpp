// SPDX-License-Identifier: BSD-3-Clause
#include "motion.hpp"

namespace roundel::fusion {
namespace {

constexpr int kTheta = 0, kPosition = 3, kOmega = 6, kVelocity = 9;

std::array<std::array<double, 3>, 3> entries(const Matrix& A) {
    return {{{A.r0.x, A.r0.y, A.r0.z}, {A.r1.x, A.r1.y, A.r1.z}, {A.r2.x, A.r2.y, A.r2.z}}};
}

/// F P.
void carry_rows(Square& P, const std::array<std::array<double, 3>, 3>& T, double dt) {
    for (int j = 0; j < kErrors; ++j)
        for (int i = 0; i < 3; ++i) {
            P[kTheta + i][j] +=
                T[i][0] * P[kOmega][j] + T[i][1] * P[kOmega + 1][j] + T[i][2] * P[kOmega + 2][j];
            P[kPosition + i][j] += dt * P[kVelocity + i][j];
        }
}

/// P F^T.
void carry_columns(Square& P, const std::array<std::array<double, 3>, 3>& T, double dt) {
    for (Step& row : P)
        for (int i = 0; i < 3; ++i) {
            row[kTheta + i] += T[i][0] * row[kOmega] + T[i][1] * row[kOmega + 1] + T[i][2] * row[kOmega + 2];
            row[kPosition + i] += dt * row[kVelocity + i];
        }
}

/// Q: q [dt^3/3, dt^2/2; dt^2/2, dt], where a turn (body's frame) follows its rate (world) by `to_body`.
void add_noise(Square& P, const std::array<std::array<double, 3>, 3>& to_body, const Drive& drive) {
    const double dt = drive.dt, square = dt * dt / 2, cube = dt * dt * dt / 3;
    for (int i = 0; i < 3; ++i) {
        P[kTheta + i][kTheta + i] += drive.q_turn * cube;
        P[kOmega + i][kOmega + i] += drive.q_turn * dt;
        P[kPosition + i][kPosition + i] += drive.q * cube;
        P[kVelocity + i][kVelocity + i] += drive.q * dt;
        P[kPosition + i][kVelocity + i] += drive.q * square;
        P[kVelocity + i][kPosition + i] += drive.q * square;
        for (int j = 0; j < 3; ++j) {
            P[kTheta + i][kOmega + j] += drive.q_turn * square * to_body[i][j];
            P[kOmega + j][kTheta + i] += drive.q_turn * square * to_body[i][j];
        }
    }
}

}  // namespace

Matrix predict(Body& body, Square& P, const Drive& drive) {
    const Matrix half = turn((drive.dt / 2) * body.omega), R_half = half * body.R;
    const Matrix to_body{R_half.column0(), R_half.column1(), R_half.column2()};
    const Matrix by_rate = (drive.single ? 0 : drive.dt) * to_body;
    carry_rows(P, entries(by_rate), drive.dt);
    carry_columns(P, entries(by_rate), drive.dt);
    add_noise(P, entries(to_body), drive);
    body.R = half * R_half;
    body.p = body.p + drive.dt * body.v;
    return by_rate;
}

}  // namespace roundel::fusion
