// SPDX-License-Identifier: BSD-3-Clause
#pragma once
#include <array>

#include "linearisation.hpp"

namespace roundel::fusion {

constexpr double kCauchy = 4.0;  // whitened distance at which an observation's weight is halved
/// Mean Cauchy weight of Gaussian noise in two dimensions, E[1 / (1 + chi2_2 / kCauchy^2)]: divided by it,
/// such noise keeps its information.
constexpr double kNominalWeight = 0.8983;

using Step = std::array<double, kErrors>;
using Square = std::array<Step, kErrors>;

/// N rows, each of one of K bodies.
struct System {
    const Rows* rows;
    const int64_t* body;
    size_t n_rows, n_bodies;
};

/// Adds up priors and equations, these by weights that follow from what the solution leaves of them:
/// iteratively reweighted least squares (Holland and Welsch 1977) with Cauchy's weights, until those of a
/// body settle.
///
/// K matrices H and right sides g hold the priors before, and the sums by the last weights afterwards; N
/// `weights` those to start with before, and the last ones afterwards. A body whose sums have no solution is
/// left where it is: who eliminates them will see it.
void reweigh(const System& system, Square* H, Step* g, double* weights);

/// 2 x N whitened: what steps (K x 12) leave of the right sides.
void remain(const System& system, const double* steps, double* to);

/// The inverse of a positive definite matrix. Throws std::runtime_error if it is not.
Square inverse(const Square& H);

}  // namespace roundel::fusion
